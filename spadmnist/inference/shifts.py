"""Shifts of summaries between the replicates of two models, separated from noise."""

from __future__ import annotations

import functools
import math

import numpy as np
from scipy import stats

from .null_distribution import Null

# p-values below which a shift is significant: by the mean square of a block, and by one cell (5.5 sigma, two-sided).
# Others count as 0: right models had resembled a loss of the readout at 6 to 8 sigma, by templates that were noise of
# two replicates. How small they are is a rule of thumb
_P_BLOCK, _P_CELL = 1e-4, 4e-8
# in variances: the least square of a shift in one cell of a spectrum; a smaller one counts as 0, lest noise of a few
# replicates be a line. A rule of thumb
_LEAST_LINE = 100.0


def mean_shift(new: np.ndarray, old: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, float, float]:
    """(shift of the mean from `old` to `new`, its variance relative to a replicate's, beta).

    The noise that both share is removed as a control variate.

    Args:
        new, old: (replicates, cells) with the same random numbers; old: less its known expectation.
        spread: (cells,) scatter.
    Returns:
        The shift (cells,); its relative variance; beta, the regression of the noise of `new` on that of `old`, 0 to
            1.
    """
    n = len(new)
    a, b = (new - new.mean(axis=0)) / spread, (old - old.mean(axis=0)) / spread
    square = float((b * b).sum())
    beta = float(np.clip((a * b).sum() / square, 0.0, 1.0)) if square > 0 and n > 1 else 0.0
    shift = new.mean(axis=0) - beta * old.mean(axis=0)
    left = float(((a - beta * b) ** 2).sum()) / max(1, (n - 1) * a.shape[1]) if n > 1 else 2.0
    return shift, left / n, beta


def beyond_noise(
    shift: np.ndarray, spread: np.ndarray, noise: float, null: Null, expected: np.ndarray, few: int, sure: bool
) -> np.ndarray:
    """The shift where it is significant, (cells,): as a whole block, or in cells by themselves; else 0.

    Args:
        shift, spread: (cells,) shift and scatter of the cells.
        noise: variance of the shift relative to that of a replicate, estimated from `few` replicates; it is poorly
            known for small blocks.
        null, expected: the null distribution and its expectation, (cells,).
        sure: the shift must exceed either this noise, with its degrees of freedom, or the scatter of whole
            replicates.
    """
    n = len(shift)
    most = 1 / few + 3.0 / null.recordings  # the variance of replicates with no common noise
    square = (shift / spread) ** 2
    noise = max(noise, 1e-12)
    if null.law.spectrum:
        return np.where(square > noise * _line_beyond(few, null.recordings, n), shift, 0.0)
    if not sure:
        _, by_own, _, one = _beyond(n, 1)
        return shift if float(square.mean()) > noise * by_own else np.where(square > noise * one, shift, 0.0)
    mean = float(null.replicate_squares.mean())
    variance = float(null.replicate_squares.var()) * (1 + math.sqrt(5 / null.recordings))
    together = round(min(n, max(1.0, 2 * mean**2 / max(variance, 1e-30))))  # effective number of independent cells
    # a fluctuating light differs in every replicate: its noise exceeds the scatter of the model's own replicates
    most = max(most, noise / _least_ratio((few - 1) * together))
    by_own, by_null, one_by_own, one_by_null = _beyond(together, (few - 1) * together)
    mean = float(square.mean())
    if mean > noise * by_own or mean > most * by_null:
        return shift
    out = (square > noise * one_by_own) | (square > most * one_by_null)
    out &= null.law.resolved(shift, expected, few, null.recordings, _P_BLOCK)
    return np.where(out, shift, 0.0)


@functools.cache
def _beyond(cells: int, freedom: int) -> tuple[float, ...]:
    """The limits that noise hardly exceeds, as variance ratios.

    Returns:
        (mean square and single square, each against an estimated variance with `freedom` degrees of freedom and
            against a known one), in the order (mean, estimated), (mean, known), (single, estimated), (single, known).
    """
    free = max(freedom, 1)
    return (
        1.2 * float(stats.f.isf(_P_BLOCK, cells, free)),
        1.2 * float(stats.chi2.isf(_P_BLOCK, cells)) / cells,
        float(stats.f.isf(_P_CELL, 1, free)),
        float(stats.chi2.isf(_P_CELL, 1)),
    )


@functools.cache
def _least_ratio(freedom: int) -> float:
    """The upper 1 % quantile of an estimated variance with this freedom, relative to the true one."""
    return float(stats.chi2.isf(0.01, max(freedom, 1))) / max(freedom, 1)


@functools.cache
def _line_beyond(few: int, recordings: int, cells: int) -> float:
    """The limit of the square of a shift of powers, in variances, that noise hardly exceeds.

    The ratio of the mean of a few exponential powers to that of many follows an F distribution.
    """
    far = float(stats.f.isf(_P_BLOCK / cells, 2 * few, 2 * recordings)) - 1
    return max(far**2 / (1 / few + 1 / recordings), _LEAST_LINE)
