"""Shifts: what of the difference between a few recordings of two models is more than chance."""

from __future__ import annotations

import functools
import math

import numpy as np
from scipy import stats

from .nulls import Null, poisson_scores

_CHANCE, _CHANCE_CELL = 1e-4, 4e-8  # p-values of shifts that are none: of a block, of any of its cells by itself
_FEW_COUNTS = 20.0  # of a cell in some recordings: normal enough
_LEAST_LINE = 100.0  # in variances, of a line of a spectrum


def difference(new: np.ndarray, old: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, float, float]:
    """(mean of new less what chance made of it, as `old` tells; variance of that relative to a recording's; beta).

    beta: how much of what chance did to `old` it did to `new`, from 0 to 1.
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
    """The shift where it is one: of the whole block, or of the cells that stand out by themselves, or none.

    noise: variance of what chance makes of it, relative to that of a recording, as `few` recordings tell it: of small
    blocks not well. sure: either this, with its freedom, or the scatter of whole recordings must then be exceeded.
    """
    n = len(shift)
    most = 1 / few + 3.0 / null.recordings  # as if the recordings had nothing in common
    square = (shift / spread) ** 2
    noise = max(noise, 1e-12)
    if null.law == "exponential":
        return np.where(square > noise * _line_beyond(few, null.recordings, n), shift, 0.0)
    if not sure:
        _, by_own, _, one = _beyond(n, 1)
        return shift if float(square.mean()) > noise * by_own else np.where(square > noise * one, shift, 0.0)
    mean, variance = float(null.own.mean()), float(null.own.var()) * (1 + math.sqrt(5 / null.recordings))
    together = round(min(n, max(1.0, 2 * mean**2 / max(variance, 1e-30))))  # cells that move by themselves
    # what is another thing in every recording, as random light is, scatters by more than the model's own recordings do
    most = max(most, noise / _least_ratio((few - 1) * together))
    by_own, by_null, one_by_own, one_by_null = _beyond(together, (few - 1) * together)
    mean = float(square.mean())
    if mean > noise * by_own or mean > most * by_null:
        return shift
    out = (square > noise * one_by_own) | (square > most * one_by_null)
    if null.law == "poisson":  # a count or two where there is usually none
        usual = few * np.maximum(expected, 0.5 / null.recordings)
        score = poisson_scores(np.maximum(usual + few * shift, 0.0), usual) / math.sqrt(1 + few / null.recordings)
        out &= (usual > _FEW_COUNTS) | (np.abs(score) > -stats.norm.ppf(_CHANCE / n))
    return np.where(out, shift, 0.0)


@functools.cache
def _beyond(cells: int, freedom: int) -> tuple[float, ...]:
    """What chance hardly exceeds: mean squares and single ones; of a variance with such freedom, and of a known one."""
    free = max(freedom, 1)
    return (
        1.2 * float(stats.f.isf(_CHANCE, cells, free)),
        1.2 * float(stats.chi2.isf(_CHANCE, cells)) / cells,
        float(stats.f.isf(_CHANCE_CELL, 1, free)),
        float(stats.chi2.isf(_CHANCE_CELL, 1)),
    )


@functools.cache
def _least_ratio(freedom: int) -> float:
    """By how much a variance of such freedom is too large once in a hundred times."""
    return float(stats.chi2.isf(0.01, max(freedom, 1))) / max(freedom, 1)


@functools.cache
def _line_beyond(few: int, recordings: int, cells: int) -> float:
    """Square, in variances, beyond which chance hardly lifts one of so many powers: a mean of few over one of many."""
    far = float(stats.f.isf(_CHANCE / cells, 2 * few, 2 * recordings)) - 1
    return max(far**2 / (1 / few + 1 / recordings), _LEAST_LINE)
