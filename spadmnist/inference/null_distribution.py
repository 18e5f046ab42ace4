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

if TYPE_CHECKING:
    from .replicates import CaptureReplicates

_LEAST = 1e-300  # in place of 0 in a denominator or a tail probability
_FEW = 20.0  # expected counts: below it, a cell does not determine its own dependence on the light
_LEAST_RATIO = 1e-3  # of a power relative to its mean: a smaller one is rounded up to this
LEAST_POWER = 0.3  # of the mean of a power in a spectrum: the least that a shift may leave
_MANY = 200.0  # expected counts beyond which Anscombe's residual is normal enough


@dataclass(frozen=True)
class Judgement:
    """The residuals of a measured summary, and its p-value.

    Attributes:
        p_value: of the check.
        misfit: mean squared residual relative to that of the model's replicates (1 is expected).
        residuals: (cells,) standard deviations.
        expected, spread: (cells,) expectation and its scatter, in the summary's unit.
        worst: the cell with the largest residual.
    """

    p_value: float
    misfit: float
    residuals: np.ndarray
    expected: np.ndarray
    spread: np.ndarray
    worst: int


@dataclass(frozen=True)
class Null:
    """The null distribution of a statistic of one capture.

    Attributes:
        law: as in `Summary`.
        middle: the mean total of the replicates, detections.
        coefficients: (terms, cells) of the regression on x, the total relative to `middle`, less 1.
        inverse: (terms, terms) inverse of its normal equations.
        spread: (cells,) standard deviation of "normal" cells.
        recordings: number of replicates.
        factor: the factor by which standardized residuals are too large, from the replicates.
        tail: the same for the largest residuals.
        own: (replicates,) mean squared residual of each replicate.
        scaled: the summary states the scatter of its cells.
    """

    law: str
    middle: float
    coefficients: np.ndarray
    inverse: np.ndarray
    spread: np.ndarray
    recordings: int
    factor: float
    tail: float
    own: np.ndarray
    scaled: bool

    def expected(self, total: float) -> tuple[np.ndarray, float]:
        """((cells,) expectation for a capture with this total of detections, its variance relative to the scatter)."""
        expected, leverage = self.expected_all(np.array([total]))
        return expected[0], float(leverage[0])

    def expected_all(self, totals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `expected`, for several totals (captures,): ((captures, cells), (captures,))."""
        terms = _terms(totals / self.middle - 1.0, len(self.coefficients))
        expected = terms @ self.coefficients
        if self.law == "poisson":
            # a cell that was empty in every replicate may still have a count
            expected = np.maximum(expected, 0.5 / self.recordings)
        return expected, np.einsum("ij,jk,ik->i", terms, self.inverse, terms)

    def judge(self, values: np.ndarray, total: float) -> Judgement:
        """The residuals and the p-value of a measured summary.

        Args:
            values: (cells,) of the summary.
            total: detections of its capture.
        """
        expected, leverage = self.expected(total)
        z = _standardized(self.law, values, expected, self.spread, leverage, self.recordings, self.scaled)
        z = z / self.factor
        spread = self.spread_at(expected)
        if self.law == "exact":
            wrong = values != expected
            worst = int(np.argmax(wrong))
            p = 1e-12 if wrong.any() else 1.0
            return Judgement(p, float(wrong.any()) * 1e3, np.where(wrong, 40.0, 0.0), expected, spread, worst)
        p, worst = self.chance(z)
        mean = max(float(self.own.mean()), 0.05)
        return Judgement(p, float(np.mean(z**2)) / mean, z, expected, spread, worst)

    def chance(self, z: np.ndarray) -> tuple[float, int]:
        """(p-value of residuals, the cell of the largest one).

        The p-value is twice the smaller of that of the sum of squares and that of the largest residual.

        Args:
            z: (cells,) residuals.
        """
        square = float(np.mean(z**2))
        mean, variance = max(float(self.own.mean()), 0.05), float(self.own.var(ddof=1))
        # cells that are empty in every replicate have no scatter: without this, one count would be impossible
        if self.law == "poisson":
            variance = max(variance, 1 / z.size)
        # the sample variance may be too small by about its standard error; rare values would then look too rare
        variance *= 1 + math.sqrt(5 / self.recordings)
        shape = mean**2 / max(variance, 1e-12 * mean**2 + _LEAST)
        p_sum = float(stats.gamma.sf(square, shape, scale=mean / shape)) if square > mean else 1.0
        worst = int(np.argmax(np.abs(z)))
        largest = abs(float(z[worst])) / self.tail
        p_cell = min(1.0, z.size * 2 * float(special.ndtr(-largest)))
        return min(1.0, 2 * min(p_sum, p_cell)), worst

    @property
    def breadth(self) -> np.ndarray | float:
        """The scatter of the cells, in units that another model shares: one number for all, or (cells,)."""
        if self.law == "normal" and not self.scaled:
            return np.asarray(self.spread)
        return self.factor

    def spread_at(self, expected: np.ndarray) -> np.ndarray:
        """The standard deviation of the cells at an expectation, (cells,), in the summary's unit."""
        if self.law == "poisson":
            return np.asarray(np.sqrt(np.maximum(expected, 0.0)) * self.factor)
        if self.law == "exponential":
            return np.maximum(expected, 0.0)
        return self.spread * self.factor


def learn(summaries: Sequence[Summary], totals: np.ndarray) -> Null:
    """The null distribution of one statistic, from the model's replicates.

    Args:
        summaries: one for each replicate.
        totals: (replicates,) detections of the whole array.
    """
    first = summaries[0]
    law = first.law
    values = np.stack([s.values for s in summaries]).astype(np.float64)
    n = len(values)
    middle = float(totals.mean()) or 1.0
    x = totals / middle - 1.0
    if law == "exact":
        coefficients = np.median(values, axis=0, keepdims=True)
        return Null(
            law, middle, coefficients, np.ones((1, 1)), np.zeros(values.shape[1]), n, 1.0, 1.0, np.zeros(n), False
        )
    follows = law in ("poisson", "normal") and bool(np.ptp(x) > 0)
    design = _terms(x, 3 if follows else 1)
    inverse = np.linalg.pinv(design.T @ design)
    coefficients = inverse @ design.T @ values
    if law == "poisson" and follows:
        _alike_where_few(values, x, coefficients)
    fitted = design @ coefficients
    hat = np.einsum("ij,jk,ik->i", design, inverse, design)
    scaled = first.scale is not None
    scale = np.ones(values.shape[1])
    if law == "normal":
        freedom = max(1, n - len(coefficients))
        sample = np.sqrt(np.sum((values - fitted) ** 2, axis=0) / freedom)
        if scaled:
            scale = np.mean([s.scale for s in summaries if s.scale is not None], axis=0)
        else:
            # a cell that never varies has no scatter: the rounding of its value takes that place
            scale = np.maximum(sample, 1e-12 * np.maximum(np.abs(fitted).max(axis=0), 1e-30))
    z = _of_their_own(law, values, fitted, scale, hat[:, None], len(coefficients), scaled)
    factor = 1.0
    if law == "poisson":
        factor = max(float(np.sqrt(np.mean(z**2))), 1.0)  # in their middle, scores of few counts scatter less than 1
    elif law == "normal" and scaled:
        factor = max(float(np.sqrt(np.mean(z**2))), 1e-6)
    z = z / factor
    return Null(law, middle, coefficients, inverse, scale, n, factor, _tail(z), np.mean(z**2, axis=1), scaled)


def _of_their_own(
    law: str, values: np.ndarray, fitted: np.ndarray, spread: np.ndarray, hat: np.ndarray, terms: int, scaled: bool
) -> np.ndarray:
    """The residuals of the replicates, each as if it were a new one, (replicates, cells).

    The regression follows each replicate; its influence on its own expectation is removed.
    """
    n = len(values)
    if law == "exponential":
        return _standardized(law, values, (n * fitted - values) / (n - 1), spread, 0.0, n - 1, scaled)
    if law == "normal" and not scaled:
        inner = (values - fitted) / (spread * np.sqrt(np.maximum(1 - hat, 1e-6)))
        freedom = max(1, n - terms - 1)
        outer = inner * np.sqrt(freedom / np.maximum(n - terms - inner**2, 1e-9))
        return _normal_of_t(outer, freedom)
    # the residual of a regression is smaller than the scatter by the leverage of its replicate
    return _standardized(law, values, fitted, spread, -hat, n, scaled)


def _alike_where_few(values: np.ndarray, x: np.ndarray, coefficients: np.ndarray) -> None:
    """Set the regression of cells with few counts, in place: they follow the total by one common elasticity."""
    mean = values.mean(axis=0)
    few = mean < _FEW
    if few.any():
        together = values[:, few].sum(axis=1)
        design = _terms(x, 2)
        level, slope = np.linalg.lstsq(design, together, rcond=None)[0]
        elasticity = float(np.clip(slope / level, -1.0, 4.0)) if level > 0 else 1.0
        coefficients[:, few] = 0.0
        coefficients[0, few] = mean[few] / max(float(np.mean(1 + elasticity * x)), 0.1)
        coefficients[1, few] = coefficients[0, few] * elasticity


def _terms(x: np.ndarray, terms: int) -> np.ndarray:
    return np.stack([x**k for k in range(terms)], axis=1)


def _tail(z: np.ndarray) -> float:
    """The factor by which the largest residuals exceed those of a normal law; at least 1."""
    magnitudes = np.sort(np.abs(z).ravel())
    beyond = 10 if magnitudes.size > 1000 else 3
    place = magnitudes[-beyond]
    normal = -float(special.ndtri((beyond - 0.5) / magnitudes.size / 2))
    return max(1.0, float(place) / normal)


def _standardized(
    law: str,
    values: np.ndarray,
    expected: np.ndarray,
    spread: np.ndarray,
    leverage: float | np.ndarray,
    recordings: int,
    scaled: bool,
) -> np.ndarray:
    """Residuals that are standard normal if the model is right, in the shape of `values`.

    Args:
        leverage: variance of the expectation relative to the scatter; negative for the residuals of the regression
            itself.
    """
    widened = np.sqrt(np.maximum(1.0 + np.asarray(leverage), 1e-6))
    if law == "poisson":
        return np.asarray(poisson_scores(values, np.maximum(expected, 0.5 / recordings)) / widened)
    if law == "exponential":
        ratio = values / np.maximum(expected, _LEAST)
        # the mean is an average over the replicates. The sum at a simple fraction of the clock may be exactly 0 for
        # few detections, so that a very small power is rounded up
        log_tail = -recordings * np.log1p(np.maximum(ratio, _LEAST_RATIO) / recordings)
        return _score_of_tail(log_tail)
    z = (values - expected) / np.where(spread > 0, spread, 1.0) / widened
    if scaled:
        return np.asarray(z)
    return _normal_of_t(z, max(1, recordings - 3))


def poisson_scores(n: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Normal scores of counts: of the mid-p value where they are few, Anscombe's residual where they are many.

    Args:
        n: counts; mean: their expectation; the shapes broadcast.
    """
    n, mean = np.broadcast_arrays(np.asarray(n, np.float64), np.asarray(mean, np.float64))
    # E n^(2/3) is m^(2/3) - m^(-1/3) / 9, its standard deviation 2/3 m^(1/6)
    root = np.cbrt(mean)
    out = np.array(1.5 * (np.cbrt(np.maximum(n, 0.0)) ** 2 - root**2 + 1 / (9 * root)) / np.sqrt(root))
    few = mean <= _MANY
    if few.any():
        k, m = np.maximum(n[few], 0.0), mean[few]
        half = 0.5 * np.exp(special.xlogy(k, m) - m - special.gammaln(k + 1))
        above = special.gammainc(k + 1, m) + half
        below = special.gammaincc(k + 1, m) - half
        tail = np.clip(np.where(k > m, above, below), _LEAST, 1.0)
        out[few] = np.where(k > m, -1.0, 1.0) * special.ndtri(tail)
    return out


def scores_of_powers(more: np.ndarray) -> np.ndarray:
    """The rise of the normal score of a power that is larger by `more` of its mean; the large ones rise by little.

    The score of a power p is about the root of 2 p.
    """
    return np.asarray(_score_of_tail(-np.maximum(1.0 + more, LEAST_POWER)) - _score_of_tail(np.array(-1.0)))


def powers_of(scores: np.ndarray) -> np.ndarray:
    """The powers, in units of their mean, that have these normal scores."""
    return np.asarray(np.maximum(-special.log_ndtr(-scores), _LEAST_RATIO))


def _score_of_tail(log_tail: np.ndarray) -> np.ndarray:
    """The normal score whose upper tail has this logarithm."""
    tail = np.exp(np.maximum(log_tail, -700.0))
    score = -special.ndtri(np.clip(tail, _LEAST, 1 - 1e-16))
    # beyond the range of a double, by the asymptotic tail of the normal law
    far = log_tail < -690
    return np.asarray(np.where(far, np.sqrt(np.maximum(-2 * log_tail - math.log(2 * math.pi), 0.0)), score))


def _normal_of_t(t: np.ndarray, freedom: int) -> np.ndarray:
    """The normal score of a Student's t."""
    log_tail = stats.t.logsf(np.abs(t), freedom)
    return np.asarray(np.sign(t) * _score_of_tail(log_tail))


def replicate_residuals(null: Null, made: CaptureReplicates, values: np.ndarray) -> np.ndarray:
    """The residuals of the model's own replicates, (replicates, cells).

    Args:
        null: their null distribution.
        made: the replicates.
        values: (replicates, cells) of the statistic.
    """
    expected, leverage = null.expected_all(made.totals)
    close = -np.minimum(leverage, 0.9)[:, None]
    z = _standardized(null.law, values, expected, null.spread, close, null.recordings, null.scaled)
    return np.asarray(z / null.factor)


def scatter_of(null: Null, made: CaptureReplicates) -> np.ndarray:
    """The scatter of the cells at the mean total of the replicates, (cells,), in the summary's unit."""
    expected = null.expected(float(made.totals.mean()))[0]
    return np.maximum(null.spread_at(expected), 0.3 if null.law == "poisson" else 1e-30)


def residuals_of(
    null: Null, values: np.ndarray, unshifted: tuple[np.ndarray, float], shift: np.ndarray, noise: float
) -> np.ndarray:
    """The residuals of a summary if the expectation of its cells were shifted, (cells,).

    Args:
        values: (cells,) of the measured summary.
        unshifted: (expectation (cells,), its relative variance), see `Null.expected`.
        shift: (cells,) of the expectation.
        noise: relative variance of the shift.
    """
    expected, leverage = unshifted[0] + shift, unshifted[1]
    if null.law in ("poisson", "exponential"):
        expected = np.maximum(expected, 0.5 / null.recordings)
    if null.law == "exponential":  # random detections keep their power, whatever else changes
        expected = np.maximum(expected, LEAST_POWER * unshifted[0])
    z = _standardized(null.law, values, expected, null.spread, leverage + noise, null.recordings, null.scaled)
    return np.asarray(z / null.factor)
