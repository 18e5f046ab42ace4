"""Null distributions: the statistics of a capture if the model is right, from the model's replicates.

A capture is simulated many times, its light level varied a little about the stated one. Every cell of every statistic
is regressed on the capture's total number of detections, so that the light level, a nuisance parameter, drops out.
`Null.judge` gives the residuals of a measured summary and its p-value.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import special, stats

from ..statistics import Summary
from .contrasts import Contrasts
from .laws import Law, law_of

if TYPE_CHECKING:
    from .capture_replicates import CaptureReplicates

# of the range of the replicates' totals: how far beyond it they inform expectations. Farther off, where wrong models
# had been called right, the expectation is that of the end; a rule of thumb
_BEYOND = 1.0
# factor on scores that are normal by themselves, least. Of one: where few detections cut its lower tail off, the
# replicates scatter less, and the upper tail is as long as ever. Of many, some of which tell nothing; a rule of thumb
_LEAST_OF_ONE, _LEAST_OF_SCORES = 1.0, 0.5
# safety factor on the variance of independent squares; the ratio to it from which on values are dependent
_SURER, _JOINED = 1.1, 1.6
_LEAST = 1e-300  # in place of a variance of 0: near the least number of a double


@dataclass(frozen=True)
class Judgement:
    """The residuals of a measured summary, and its p-value.

    Attributes:
        p_value: of the check.
        misfit: mean squared residual relative to that of the model's replicates (1 is expected).
        residuals: (cells,) standard deviations.
        expected, spread: (cells,) expectation and its scatter, in the summary's unit.
        worst: the cell that shows the deviation most; contrast: the index of the contrast, where one decides.
    """

    p_value: float
    misfit: float
    residuals: np.ndarray
    expected: np.ndarray
    spread: np.ndarray
    worst: int
    contrast: int | None = None


@dataclass(frozen=True)
class Null:
    """The null distribution of a statistic of one capture.

    Attributes:
        law: how its cells scatter.
        middle: the mean total of the replicates, detections.
        coefficients: (terms, cells) of the regression on x, the total relative to `middle`, less 1.
        inverse: (terms, terms) inverse of its normal equations.
        spread: (cells,) standard deviation of "normal" cells.
        recordings: number of replicates.
        factor: the factor by which standardized residuals are too large, from the replicates.
        tail: the same for the largest residuals.
        replicate_squares: (replicates,) mean squared residual of each replicate.
        reach: (least, most) total relative to `middle`, less 1, to which the regression is extrapolated.
        contrasts: patterns of all cells that are tested by themselves; None without any.
    """

    law: Law
    middle: float
    coefficients: np.ndarray
    inverse: np.ndarray
    spread: np.ndarray
    recordings: int
    factor: float
    tail: float
    replicate_squares: np.ndarray
    reach: tuple[float, float] = (-math.inf, math.inf)
    contrasts: Contrasts | None = None

    def expected(self, total: float) -> tuple[np.ndarray, float]:
        """((cells,) expectation for a capture with this total of detections, its variance relative to the scatter)."""
        expected, leverage = self.expected_all(np.array([total]))
        return expected[0], float(leverage[0])

    def expected_all(self, totals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `expected`, for several totals (captures,): ((captures, cells), (captures,))."""
        # far from the totals of the replicates the regression says nothing
        terms = _terms(np.clip(totals / self.middle - 1.0, *self.reach), len(self.coefficients))
        expected = np.maximum(terms @ self.coefficients, self.law.least(self.recordings))
        return expected, np.einsum("ij,jk,ik->i", terms, self.inverse, terms)

    def judge(self, values: np.ndarray, total: float) -> Judgement:
        """The residuals and the p-value of a measured summary.

        Args:
            values: (cells,) of the summary.
            total: detections of its capture.
        """
        expected, leverage = self.expected(total)
        spread = self.spread_at(expected)
        if self.law.exact:
            wrong = values != expected
            worst = int(np.argmax(wrong))
            p = 1e-12 if wrong.any() else 1.0
            return Judgement(
                p_value=p,
                misfit=float(wrong.any()) * 1e3,
                residuals=np.where(wrong, 40.0, 0.0),
                expected=expected,
                spread=spread,
                worst=worst,
            )
        z = self.residuals(values, expected, leverage)
        p, worst, contrast = self.p_value(z)
        mean = max(float(self.replicate_squares.mean()), 0.05)
        return Judgement(
            p_value=p,
            misfit=float(np.mean(z**2)) / mean,
            residuals=z,
            expected=expected,
            spread=spread,
            worst=worst,
            contrast=contrast,
        )

    def p_value(self, z: np.ndarray) -> tuple[float, int, int | None]:
        """(p-value of residuals, the cell that shows the deviation most, the contrast if one decides).

        The p-value is twice the smaller of that of the sum of squares and that of the largest residual. Where there are
        contrasts, the sum is of what they do not describe, and the p-value is three times the smallest.

        Args:
            z: (cells,) residuals.
        """
        rest, squares = z, self.replicate_squares
        if self.contrasts is not None:
            rest, squares = self.contrasts.without(z), self.contrasts.squares
        p_sum = p_of_squares(float(np.mean(rest**2)), *self._moments(squares, z.size))
        worst = int(np.argmax(np.abs(z)))
        largest = abs(float(z[worst])) / self.tail
        p_cell = min(1.0, z.size * 2 * float(special.ndtr(-largest)))
        if self.contrasts is None:
            return min(1.0, 2 * min(p_sum, p_cell)), worst, None
        contrast = self.contrasts.clearest(z)
        if contrast.p < min(p_sum, p_cell):
            return min(1.0, 3 * contrast.p), contrast.worst, contrast.index
        return min(1.0, 3 * min(p_sum, p_cell)), worst, None

    def moments_of_squares(self, cells: int) -> tuple[float, float]:
        """(mean, variance) of the mean squared residual of so many cells."""
        return self._moments(self.replicate_squares, cells)

    def _moments(self, squares: np.ndarray, cells: int) -> tuple[float, float]:
        mean = max(float(squares.mean()), 0.05)
        variance = self.law.variance_of_squares(float(squares.var(ddof=1)), cells)
        return mean, variance * widening(self.recordings)

    def residuals(self, values: np.ndarray, expected: np.ndarray, leverage: float | np.ndarray) -> np.ndarray:
        """Residuals of values about an expectation, standard normal if the model is right, in the shape of `values`.

        Args:
            leverage: variance of the expectation relative to the scatter.
        """
        return np.asarray(self.law.standardized(values, expected, self.spread, leverage, self.recordings) / self.factor)

    @property
    def breadth(self) -> np.ndarray | float:
        """The scatter of the cells, in units that another model shares: one number for all, or (cells,)."""
        return self.law.breadth(self.spread, self.factor)

    def spread_at(self, expected: np.ndarray) -> np.ndarray:
        """The standard deviation of the cells at an expectation, (cells,), in the summary's unit."""
        return self.law.spread_at(expected, self.spread, self.factor)


def learn(summaries: Sequence[Summary], totals: np.ndarray, contrasts: np.ndarray | None = None) -> Null:
    """The null distribution of one statistic, from the model's replicates.

    Args:
        summaries: one for each replicate.
        totals: (replicates,) detections of the whole array.
        contrasts: (patterns, cells) of the measured summary.
    """
    first = summaries[0]
    law = law_of(first.law, first.scale is not None)
    values = np.stack([s.values for s in summaries]).astype(np.float64)
    n = len(values)
    middle = float(totals.mean()) or 1.0
    x = totals / middle - 1.0
    whole = bool(np.all((values >= 0) & (values == np.rint(values))))
    if law.exact and whole and np.ptp(values, axis=0).any():
        law = law_of("poisson", False)  # of this model it is a rare event: its light goes out, its frames repeat
    if law.exact:
        coefficients = np.median(values, axis=0, keepdims=True)
        return Null(
            law=law,
            middle=middle,
            coefficients=coefficients,
            inverse=np.ones((1, 1)),
            spread=np.zeros(values.shape[1]),
            recordings=n,
            factor=1.0,
            tail=1.0,
            replicate_squares=np.zeros(n),
        )
    follows = law.terms > 1 and bool(np.ptp(x) > 0)
    design = _terms(x, law.terms if follows else 1)
    inverse = np.linalg.pinv(design.T @ design)
    coefficients = inverse @ design.T @ values
    if follows:
        law.regression(values, x, coefficients)
    fitted = design @ coefficients
    hat = np.einsum("ij,jk,ik->i", design, inverse, design)
    scales = [s.scale for s in summaries if s.scale is not None]
    spread = law.spread(values, fitted, len(coefficients), np.mean(scales, axis=0) if scales else None)
    z = law.of_their_own(values, fitted, spread, hat[:, None], len(coefficients))
    factor = law.factor(z)
    if first.law == "normal" and first.scale is not None and np.all(np.asarray(first.scale) == 1.0):
        factor = max(factor, _LEAST_OF_ONE if values.shape[1] == 1 else _LEAST_OF_SCORES)
    z = z / factor
    low, high = float(x.min()), float(x.max())
    reach = low - _BEYOND * (high - low), high + _BEYOND * (high - low)
    known = None if contrasts is None else Contrasts.learnt(contrasts, z, n - len(coefficients))
    return Null(
        law=law,
        middle=middle,
        coefficients=coefficients,
        inverse=inverse,
        spread=spread,
        recordings=n,
        factor=factor,
        tail=tail_of(z),
        replicate_squares=np.mean(z**2, axis=1),
        reach=reach,
        contrasts=known,
    )


def _terms(x: np.ndarray, terms: int) -> np.ndarray:
    return np.stack([x**k for k in range(terms)], axis=1)


def widening(recordings: int) -> float:
    """The factor on a sample variance: too small by its standard error, it would make rare values look too rare."""
    return 1 + math.sqrt(5 / recordings)


def p_of_squares(square: float, mean: float, variance: float) -> float:
    """The one-sided p-value of a sum of squares, by the gamma law with this mean and variance."""
    shape = mean**2 / max(variance, 1e-12 * mean**2 + _LEAST)
    return float(stats.gamma.sf(square, shape, scale=mean / shape)) if square > mean else 1.0


def p_of_scatter(square: float, squares: np.ndarray, number: int) -> float:
    """The p-value of so many values whose mean square is larger than those of the replicates.

    Args:
        square: of the data; squares: (replicates,).
    """
    mean, variance = float(squares.mean()), float(squares.var(ddof=1))
    apart = 2 * mean**2 / number  # variance of the mean square of independent values
    # a few replicates give a poor variance: where they do not contradict it, that of independent values holds
    variance = _SURER * apart if variance < _JOINED * apart else variance * (1 + math.sqrt(5 / len(squares)))
    shape = mean**2 / max(variance, 1e-12)
    return float(stats.gamma.sf(square, shape, scale=mean / shape))


def p_of_largest(z: np.ndarray, own: np.ndarray) -> float:
    """The p-value of the largest of some values, whose scatter, and its tail, are those of the replicates.

    Args:
        z: (values,); own: (replicates, values).
    """
    wide = max(1.0, float(np.sqrt(np.mean(own**2))))
    wide *= tail_of(own / wide)
    return min(1.0, 2 * z.size * float(stats.norm.sf(float(np.max(np.abs(z))) / wide)))


def tail_of(z: np.ndarray) -> float:
    """The factor by which the largest residuals of replicates exceed those of a normal law; at least 1."""
    live = z.any(axis=0)  # cells without enough data are 0 in all replicates
    magnitudes = np.abs(z[:, live] if live.any() else z).ravel()
    beyond = 10 if magnitudes.size > 1000 else 3
    place = np.partition(magnitudes, -beyond)[-beyond]
    normal = -float(special.ndtri((beyond - 0.5) / magnitudes.size / 2))
    return max(1.0, float(place) / normal)


def replicate_residuals(null: Null, made: CaptureReplicates, values: np.ndarray) -> np.ndarray:
    """The residuals of the model's own replicates, each as if it were new data, (replicates, cells).

    Args:
        null: their null distribution.
        made: the replicates.
        values: (replicates, cells) of the statistic.
    """
    expected, leverage = null.expected_all(made.totals)
    hat, terms = np.minimum(leverage, 0.9)[:, None], len(null.coefficients)
    return np.asarray(null.law.of_their_own(values, expected, null.spread, hat, terms) / null.factor)


def scatter_of(null: Null, made: CaptureReplicates) -> np.ndarray:
    """The scatter of the cells at the mean total of the replicates, (cells,), in the summary's unit."""
    expected = null.expected(float(made.totals.mean()))[0]
    return null.law.scatter_at(expected, null.spread, null.factor)


def residuals_of(
    null: Null, values: np.ndarray, unshifted: tuple[np.ndarray, float], shift: np.ndarray, noise: float
) -> np.ndarray:
    """The residuals of a summary if the expectation of its cells were shifted, in the shape of the shift.

    Args:
        values: (cells,) of the measured summary.
        unshifted: (expectation (cells,), its relative variance), see `Null.expected`.
        shift: (cells,) of the expectation, or (shifts, cells).
        noise: relative variance of the shift.
    """
    expected = null.law.shifted(unshifted[0], shift, null.recordings)
    return null.residuals(values, expected, unshifted[1] + noise)
