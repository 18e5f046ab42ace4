"""The laws of cells: how each one scatters about its expectation if the model is right.

A statistic names its law (`Summary.law`); everything that depends on it is a method here. A law is chosen by `law_of`.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from scipy import special, stats

# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
_LEAST = 1e-300  # in place of 0 in a denominator or a tail probability: near the least number of a double
# of a power relative to its mean: a smaller one is rounded up to this. Few detections may have a power of exactly 0
_LEAST_RATIO = 1e-3
# of the mean of a power in a spectrum: the least that a shift may leave, because random detections keep their power
_LEAST_POWER = 0.3
# least variance of the squared score of one power, an eighth of that of independent ones (2): the mean of several has
# at least this over their number. Without a detection all replicates have the same powers, and right models had failed
_LEAST_OF_SQUARES = 0.25
# expected counts beyond which Anscombe's residual is normal enough; the score of fewer is that of their mid-p value
_MANY = 200.0
# expected counts: below it, a cell does not determine its own dependence on the light, and shares one with all such
# cells; nor is a shift in it taken without a test of its own
_FEW = 20.0
# expected independent events from which on a count is nearly normal: the cells below decide the tails of a score
_EVENTS = 25.0
_LEAST_COUNT = 0.5  # counts: the least scatter of a cell to which a template is set in proportion, for empty cells
# of Student's t: a smaller tail is computed as its logarithm. It is above `_LEAST`, by which tails are cut off
_FAR_TAIL = 1e-290
# the largest t, and minus the largest logarithm of a tail, that are used: the square of the first and twice the second
# are within the range of a double
_LARGEST_T, _LARGEST_LOG = 1e150, 1e300
_LEAST_SCATTER = 0.3  # counts: the least scatter of a cell in which a shift is judged, for empty cells
_LEAST_FREE = 1e-30  # the same for cells that are no counts: never divides by 0

_Both = tuple[np.ndarray | float, np.ndarray | float]  # of this model and of the other


class Law:
    """A normal law with a scatter of its own for each cell, which the replicates show.

    The base of the others. Everywhere `expected` and `spread` are (cells,) or (captures, cells), in the unit of the
    summary; n is the number of replicates.
    """

    exact: ClassVar[bool] = False  # the cells have one possible value
    spectrum: ClassVar[bool] = False  # the cells are powers at frequencies
    terms: ClassVar[int] = 3  # of the regression on the total of the capture

    def least(self, n: int) -> float:
        """The least expectation of a cell."""
        return -math.inf

    def shifted(self, expected: np.ndarray, shift: np.ndarray, n: int) -> np.ndarray:
        """The expectation of cells that are shifted, in the shape of the shift: (cells,) or (shifts, cells)."""
        return np.asarray(expected + shift)

    def regression(self, values: np.ndarray, x: np.ndarray, coefficients: np.ndarray) -> None:
        """Correct the coefficients of the regression of the replicates on x, in place."""

    def spread(self, values: np.ndarray, fitted: np.ndarray, terms: int, scale: np.ndarray | None) -> np.ndarray:
        """The scatter of the replicates about their regression, (cells,)."""
        sample = np.sqrt(np.sum((values - fitted) ** 2, axis=0) / max(1, len(values) - terms))
        # a cell that never varies has no scatter: the rounding of its value takes that place
        return np.asarray(np.maximum(sample, 1e-12 * np.maximum(np.abs(fitted).max(axis=0), 1e-30)))

    def factor(self, z: np.ndarray) -> float:
        """The factor by which standardized residuals of the replicates, (replicates, cells), are too large."""
        return 1.0

    def standardized(
        self, values: np.ndarray, expected: np.ndarray, spread: np.ndarray, leverage: float | np.ndarray, n: int
    ) -> np.ndarray:
        """Residuals that are standard normal if the model is right, in the shape of `values`.

        Args:
            leverage: variance of the expectation relative to the scatter; negative for the residuals of the regression
                itself.
        """
        return _normal_of_t(_in_scatters(values, expected, spread, leverage), max(1, n - 3))

    def of_their_own(
        self, values: np.ndarray, fitted: np.ndarray, spread: np.ndarray, hat: np.ndarray, terms: int
    ) -> np.ndarray:
        """The residuals of the replicates, each as if it were a new one, (replicates, cells).

        The regression follows each replicate; its influence on its own expectation is removed.
        """
        n = len(values)
        inner = (values - fitted) / (spread * np.sqrt(np.maximum(1 - hat, 1e-6)))
        freedom = max(1, n - terms - 1)
        outer = inner * np.sqrt(freedom / np.maximum(n - terms - inner**2, 1e-9))
        return _normal_of_t(outer, freedom)

    def spread_at(self, expected: np.ndarray, spread: np.ndarray, factor: float) -> np.ndarray:
        """The standard deviation of the cells at an expectation, (cells,)."""
        return spread * factor

    def scatter_at(self, expected: np.ndarray, spread: np.ndarray, factor: float) -> np.ndarray:
        """The same, never too small to divide by."""
        return np.maximum(self.spread_at(expected, spread, factor), _LEAST_FREE)

    def variance_of_squares(self, variance: float, cells: int) -> float:
        """The variance of the mean squared residual, from that of the replicates."""
        return variance

    def breadth(self, spread: np.ndarray, factor: float) -> np.ndarray | float:
        """The scatter of the cells, in units that another model shares: one number for all, or (cells,)."""
        return np.asarray(spread)

    def error_of_scatter(self, cells: int, n: int) -> float:
        """The standard error of the log of the ratio of two scatters, each of n replicates of as many cells."""
        return 1 / math.sqrt(max(n - 1, 1))

    def template(self, shift: np.ndarray, expected: np.ndarray, spread: np.ndarray, factor: float) -> np.ndarray:
        """A shift in standard deviations, (cells,)."""
        return np.asarray(shift / np.maximum(self.spread_at(expected, spread, factor), _LEAST_FREE))

    def scores(self, template: np.ndarray) -> np.ndarray:
        """The rise of the normal scores that a template means, (cells,)."""
        return template

    def likelihood_ratio(
        self, z: np.ndarray, other: np.ndarray, breadths: _Both, factors: tuple[float, float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """The two terms of twice the log likelihood ratio of another model to this one.

        Args:
            z, other: residuals under this model and under the other, (cells,).
            breadths, factors: `Null.breadth` and `Null.factor` of both.
        Returns:
            (fall of the squared residuals (cells,), log of the ratio of the scatters, (cells,) or a number); twice the
                second is subtracted from the first.
        """
        return np.asarray(z**2 - other**2), np.asarray(np.log(breadths[1] / breadths[0]))

    def nearly_normal(self, expected: np.ndarray, factor: float) -> np.ndarray:
        """Which cells are counts of so many events that they are nearly normal, (cells,) bool."""
        return np.zeros(len(expected), bool)

    def resolved(self, shift: np.ndarray, expected: np.ndarray, few: int, n: int, p: float) -> np.ndarray:
        """Which shifts, of `few` replicates, are significant against the noise of small counts, (cells,) bool.

        Args:
            p: familywise p-value.
        """
        return np.ones(len(shift), bool)


class Scaled(Law):
    """A normal law whose scatter the summary states: the replicates determine one factor for all cells."""

    def spread(self, values: np.ndarray, fitted: np.ndarray, terms: int, scale: np.ndarray | None) -> np.ndarray:
        """The stated scatter."""
        return np.ones(values.shape[1]) if scale is None else scale

    def factor(self, z: np.ndarray) -> float:
        """The root mean square of the cells that vary: those without enough data in any replicate are all 0."""
        live = z.any(axis=0)
        return max(float(np.sqrt(np.mean(z[:, live] ** 2))), 1e-6) if live.any() else 1.0

    def standardized(
        self, values: np.ndarray, expected: np.ndarray, spread: np.ndarray, leverage: float | np.ndarray, n: int
    ) -> np.ndarray:
        """In units of the stated scatter."""
        return _in_scatters(values, expected, spread, leverage)

    def of_their_own(
        self, values: np.ndarray, fitted: np.ndarray, spread: np.ndarray, hat: np.ndarray, terms: int
    ) -> np.ndarray:
        """The residual of a regression is smaller than the scatter by the leverage of its replicate."""
        return self.standardized(values, fitted, spread, -hat, len(values))

    def breadth(self, spread: np.ndarray, factor: float) -> np.ndarray | float:
        """One factor for all cells."""
        return factor

    def error_of_scatter(self, cells: int, n: int) -> float:
        """All cells inform the factor; that of dependent ones is known less well than this."""
        return 1 / math.sqrt(max(n * cells - 1, 1))


class Poisson(Scaled):
    """Counts. One factor for all cells says by how much they scatter more than independent events."""

    def least(self, n: int) -> float:
        """A cell that was empty in every replicate may still have a count."""
        return 0.5 / n

    def shifted(self, expected: np.ndarray, shift: np.ndarray, n: int) -> np.ndarray:
        """Never below `least`."""
        return np.maximum(expected + shift, self.least(n))

    def regression(self, values: np.ndarray, x: np.ndarray, coefficients: np.ndarray) -> None:
        """Cells with few counts follow the total by one common elasticity."""
        mean = values.mean(axis=0)
        few = mean < _FEW
        if few.any():
            together = values[:, few].sum(axis=1)
            level, slope = np.linalg.lstsq(np.stack([x**0, x], axis=1), together, rcond=None)[0]
            elasticity = float(np.clip(slope / level, -1.0, 4.0)) if level > 0 else 1.0
            coefficients[:, few] = 0.0
            coefficients[0, few] = mean[few] / max(float(np.mean(1 + elasticity * x)), 0.1)
            coefficients[1, few] = coefficients[0, few] * elasticity

    def factor(self, z: np.ndarray) -> float:
        """At least 1: in their middle, scores of few counts scatter less."""
        return max(float(np.sqrt(np.mean(z**2))), 1.0)

    def standardized(
        self, values: np.ndarray, expected: np.ndarray, spread: np.ndarray, leverage: float | np.ndarray, n: int
    ) -> np.ndarray:
        """Normal scores of the counts."""
        return np.asarray(poisson_scores(values, np.maximum(expected, self.least(n))) / _widened(leverage))

    def of_their_own(
        self, values: np.ndarray, fitted: np.ndarray, spread: np.ndarray, hat: np.ndarray, terms: int
    ) -> np.ndarray:
        """Each about the expectation that the others give: a rare count makes a part of its own expectation."""
        n = len(values)
        hat = np.where(values.mean(axis=0) < _FEW, 1 / n, np.minimum(hat, 0.9))  # few follow the mean, see `regression`
        others = (fitted - hat * values) / (1 - hat)
        return self.standardized(values, others, spread, hat / (1 - hat), n - 1)

    def spread_at(self, expected: np.ndarray, spread: np.ndarray, factor: float) -> np.ndarray:
        """The root of the expectation, times the factor."""
        return np.asarray(np.sqrt(np.maximum(expected, 0.0)) * factor)

    def scatter_at(self, expected: np.ndarray, spread: np.ndarray, factor: float) -> np.ndarray:
        """At least a fraction of a count."""
        return np.maximum(self.spread_at(expected, spread, factor), _LEAST_SCATTER)

    def variance_of_squares(self, variance: float, cells: int) -> float:
        """Cells that are empty in every replicate have no scatter: without this, one count would be impossible."""
        return max(variance, 1 / cells)

    def template(self, shift: np.ndarray, expected: np.ndarray, spread: np.ndarray, factor: float) -> np.ndarray:
        """In units of the scatter, or of half a count."""
        return np.asarray(shift / np.maximum(self.spread_at(expected, spread, factor), _LEAST_COUNT))

    def nearly_normal(self, expected: np.ndarray, factor: float) -> np.ndarray:
        """By the number of independent events, which is that of the bursts."""
        return np.asarray(expected >= _EVENTS * max(factor, 1.0) ** 2)

    def resolved(self, shift: np.ndarray, expected: np.ndarray, few: int, n: int, p: float) -> np.ndarray:
        """All where there are some counts; a count or two in cells that are mostly empty is no shift."""
        counts = few * np.maximum(expected, self.least(n))
        score = poisson_scores(np.maximum(counts + few * shift, 0.0), counts) / math.sqrt(1 + few / n)
        return np.asarray((counts > _FEW) | (np.abs(score) > -stats.norm.ppf(p / len(shift))))


class Exponential(Scaled):
    """Powers of a spectrum: each scatters as much as its mean, which does not follow the total of the capture."""

    spectrum = True
    terms = 1

    def shifted(self, expected: np.ndarray, shift: np.ndarray, n: int) -> np.ndarray:
        """Random detections keep their power, whatever else changes."""
        return np.maximum(np.maximum(expected + shift, 0.5 / n), _LEAST_POWER * expected)

    def factor(self, z: np.ndarray) -> float:
        """None is needed."""
        return 1.0

    def error_of_scatter(self, cells: int, n: int) -> float:
        """The mean of n exponential powers in each cell."""
        return math.sqrt(2 / n)

    def standardized(
        self, values: np.ndarray, expected: np.ndarray, spread: np.ndarray, leverage: float | np.ndarray, n: int
    ) -> np.ndarray:
        """Scores of the tail of a power whose mean is an average over the replicates.

        The power at a simple fraction of the clock may be exactly 0 for few detections, so that a very small one is
        rounded up.
        """
        ratio = values / np.maximum(np.maximum(expected, values * _LEAST), _LEAST)
        return _score_of_tail(-n * np.log1p(np.maximum(ratio, _LEAST_RATIO) / n))

    def of_their_own(
        self, values: np.ndarray, fitted: np.ndarray, spread: np.ndarray, hat: np.ndarray, terms: int
    ) -> np.ndarray:
        """Each relative to the mean of the others."""
        n = len(values)
        return self.standardized(values, (n * fitted - values) / (n - 1), spread, 0.0, n - 1)

    def variance_of_squares(self, variance: float, cells: int) -> float:
        """At least an eighth of that of independent powers: without a detection all replicates have the same ones."""
        return max(variance, _LEAST_OF_SQUARES / cells)

    def spread_at(self, expected: np.ndarray, spread: np.ndarray, factor: float) -> np.ndarray:
        """The expectation."""
        return np.maximum(expected, 0.0)

    def template(self, shift: np.ndarray, expected: np.ndarray, spread: np.ndarray, factor: float) -> np.ndarray:
        """Relative to the expectation."""
        return np.asarray(shift / np.maximum(expected, 1e-9))

    def scores(self, template: np.ndarray) -> np.ndarray:
        """A power that is larger by a part of its mean: the scores of large ones rise by little.

        The score of a power p is about the root of 2 p.
        """
        return _score_of_tail(-np.maximum(1.0 + template, _LEAST_POWER)) - _score_of_tail(np.array(-1.0))

    def likelihood_ratio(
        self, z: np.ndarray, other: np.ndarray, breadths: _Both, factors: tuple[float, float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """By the powers in units of their means: the scatter of a power is its mean."""
        power, its = _powers_of(z * factors[0]), _powers_of(other * factors[1])
        return 2 * (power - its), np.asarray(np.log(power / its))


class Exact(Law):
    """The one value that every replicate has."""

    exact = True
    terms = 1


_LAWS = {"poisson": Poisson(), "exponential": Exponential(), "exact": Exact()}


def law_of(name: str, scaled: bool) -> Law:
    """The law of a summary. scaled: it states the scatter of its cells."""
    return _LAWS.get(name) or (Scaled() if scaled else Law())


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


def _in_scatters(
    values: np.ndarray, expected: np.ndarray, spread: np.ndarray, leverage: float | np.ndarray
) -> np.ndarray:
    return np.asarray((values - expected) / np.where(spread > 0, spread, 1.0) / _widened(leverage))


def _widened(leverage: float | np.ndarray) -> np.ndarray:
    """The root of the variance of a residual relative to the scatter."""
    return np.asarray(np.sqrt(np.maximum(1.0 + np.asarray(leverage), 1e-6)))


def _powers_of(scores: np.ndarray) -> np.ndarray:
    """The powers, in units of their mean, that have these normal scores."""
    return np.asarray(np.maximum(-special.log_ndtr(-scores), _LEAST_RATIO))


def _score_of_tail(log_tail: np.ndarray) -> np.ndarray:
    """The normal score whose upper tail has this logarithm."""
    tail = np.exp(np.maximum(log_tail, -700.0))
    score = np.array(-special.ndtri(np.clip(tail, _LEAST, 1 - 1e-16)))
    # beyond the range of a double, by the asymptotic tail of the normal law
    far = log_tail < -690
    if far.any():
        square = -2 * np.maximum(log_tail[far], -_LARGEST_LOG) - math.log(2 * math.pi)
        score[far] = np.sqrt(square - np.log(square))
    return score


def _normal_of_t(t: np.ndarray, freedom: int) -> np.ndarray:
    """The normal score of a Student's t."""
    t = np.asarray(t, np.float64)
    # the tail of `scipy.stats.t.sf`, at a tenth of its cost for some cells
    tail = special.stdtr(freedom, -np.abs(t))
    score = np.array(-special.ndtri(np.maximum(tail, _LEAST)))
    far = tail < _FAR_TAIL
    if far.any():  # the first term of the incomplete beta function, with its limit for many degrees of freedom
        a, x = freedom / 2, freedom / (freedom + np.minimum(np.abs(t[far]), _LARGEST_T) ** 2)
        log_tail = a * np.log(x) - 0.5 * np.log1p(-x) - math.log(2 * a) - special.betaln(a, 0.5)
        score[far] = _score_of_tail(log_tail)
    return np.asarray(np.sign(t) * score)
