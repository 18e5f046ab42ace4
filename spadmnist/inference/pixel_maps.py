"""Maps of a parameter over pixels, rows, columns or codes: estimates, odd pixels, tests for patterns."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, special, stats

from ..effects import Effect
from ..sensor import Sensor
from ..statistics import Statistic, informant
from . import blind_times, mixed_model
from .candidates import Candidate
from .coordinates import Key
from .levels import HALF_95
from .mixed_model import PatternEvidence
from .results import Value

# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
# degrees of freedom of the prior, a Student t: few, so that odd pixels do not widen it
TAILS = 3.0
# of the information on a map, in the mean over its pixels: a capture with a larger share is needed to fit it, and is
# not judged by a map that is fitted without it
ALONE = 0.6
# of a logarithm: the noise of an estimate below which a pixel is informed by itself; the least width of the prior
INFORMED, LEAST_WIDTH = 0.2, 1e-3
# relative standard error of the variance of many pixels by the median of their distances, times the root of their
# number: about twice that of the width, 1.166 for a normal law
DOUBT = 2.34
# shares of hot pixels that are tried for the width of pixels with few counts; the likeliest is taken
_HOT = (0.001, 0.01, 0.03, 0.1)
# pixels whose likelihood gives the width of their law: drawn at random from more, to save time
_MOST_FOR_WIDTH = 16_384
TURNS = 16  # iterations of a fit of maps: the last ones decide how near to its end it comes
# of a logarithm: the most that a value deviates from that of the array, a factor of 22,000; and the largest variance of
# an estimate that counts. Hot pixels are thousands of times as hot
MOST = 10.0
# standard deviations beyond which a pixel is odd where a fit begins; of a logarithm, the width of odd pixels' prior
ODD, WIDE = 3.5, 2.0
# the grid of log values about the middle for pixels with few counts (from, to, points): a law of width 2.3, as of dark
# rates, is not cut off (from -4 on it was 1.9); the iterations for their law, which ends while it is smooth
GRID, ROUNDS = (-8.0, 8.0, 129), 100
# reliability, the share of the variance of values that their estimates have: above the first a value is known well, its
# spread being too small by 1 %; below the second it spreads as if it had so much, lest noise be blown up five times
RELIABLE, LEAST_RELIABLE = 0.98, 0.04
# standard deviations of a logarithm, from which on nothing is known of it: of a scene, such a pixel is left out
NOTHING = 3.0
# pixels along a line, or along each side of a square, whose median a pixel is compared with besides that of all, lest
# light that rises along the array hide a hot one. The median of 25 widens the distance by 3 % for a normal law
_LINE, _SQUARE = 25, 5
# standard deviations from all pixels, and from those around it, beyond which a pixel is odd; and the least distance. Of
# normal pixels these are 6e-5 and at most 2e-5
_BEYOND, _BEYOND_NEAR, _LEAST_BEYOND = 4.0, 5.0, 0.15


@dataclass(frozen=True)
class PixelMap:
    """A map in logarithms: its values are base * exp(estimate), as random effects with an empirical prior.

    Attributes:
        carrier: the parameter that holds the map.
        base: the value that the logarithms are relative to, SI.
        group: (pixels,) the index of each pixel's value (the pixels of a row or column share one).
        estimate, error: (groups,) mean and standard deviation under the prior.
        raw, raw_error: (groups,) the same without the prior.
        sigma: width of the prior.
        low, high: bounds of the values.
        held: (groups,) the ratio of the prior's information on each value to that of its data, where other maps were
            fitted with it: their priors inform the estimate, too, and not the one without a prior. None: by the errors.
        shape: (rows, columns) of the pixels, where each has a value of its own; None of rows, columns, codes.
    """

    carrier: Key
    base: float
    group: np.ndarray
    estimate: np.ndarray
    error: np.ndarray
    raw: np.ndarray
    raw_error: np.ndarray
    sigma: float
    low: float = 0.0
    high: float = math.inf
    likely: tuple[np.ndarray, np.ndarray] | None = None  # (grid,) logarithms, (groups, grid) posterior weights
    prior: np.ndarray | None = None  # (grid,) the common law of pixels with few counts, in those weights
    certain: float = INFORMED  # raw_error below which a value is the estimate, whatever the others are
    width: blind_times.Width | None = None  # where the likelihood of all pixels gives it
    shape: tuple[int, int] | None = None
    held: np.ndarray | None = None
    of_scene: bool = False  # no light falls on some pixels, and nothing says how much of it they detect

    @property
    def informed(self) -> np.ndarray:
        """(groups,) bool: the values that anything is known of."""
        return self.raw_error < NOTHING if self.of_scene else np.ones(self.raw.size, bool)

    @functools.cached_property
    def around(self) -> np.ndarray:
        """(groups,) the median logarithm of the pixels around each; NaN near an end, and of maps without places.

        They lie alike on both sides of the pixel, so that a slope does not matter.
        """
        out = np.full(self.estimate.size, np.nan)
        if self.shape is None or self.of_scene:
            return out
        if min(self.shape) >= 2 * _SQUARE:
            window = (_SQUARE, _SQUARE)
        elif max(self.shape) >= 2 * _LINE:
            window = (1, _LINE) if self.shape[1] > self.shape[0] else (_LINE, 1)
        else:
            return out
        medians = ndimage.median_filter(self.estimate.reshape(self.shape), size=window)
        inner = tuple(slice(n // 2, size - n // 2) for n, size in zip(window, self.shape, strict=True))
        out.reshape(self.shape)[inner] = medians[inner]
        return out

    @functools.cached_property
    def odd(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """((groups,) bool far below, (groups,) bool far above, (groups,) the logarithm that each is compared with).

        A pixel is far from all others, or from those around it; the latter counts where the former does not hold.
        """
        level = np.full(self.estimate.size, median_of(self.estimate))
        far = np.abs(self.estimate - level) > self._far(level, _BEYOND)
        around = self.around
        some = np.isfinite(around) & ~far
        near = np.zeros(far.size, bool)
        if some.any():
            near = some & (np.abs(self.estimate - around) > self._far(around, _BEYOND_NEAR))
        level = np.where(near, around, level)
        beyond = self.estimate - level
        return (far | near) & (beyond < 0), (far | near) & (beyond > 0), level

    def _far(self, level: np.ndarray, times: float) -> np.ndarray:
        """(groups,) the distance from a level beyond which a value is odd: that of most pixels beyond their noise."""
        known = self.informed & np.isfinite(level)
        raw = self.raw[known] - level[known]
        width = 1.4826 * float(np.median(np.abs(raw - np.median(raw)))) if raw.size else 0.0
        noise = float(np.median(self.raw_error[known])) if raw.size else NOTHING
        bulk = math.sqrt(max(width**2 - noise**2, 0.0))
        return np.maximum(times * np.sqrt(bulk**2 + self._noise_below(level, noise) ** 2), _LEAST_BEYOND)

    def _noise_below(self, level: np.ndarray, usual: float) -> np.ndarray:
        """(groups,) the noise of each estimate against a level, so that their distance over it is a normal score.

        The error at the estimate of a dead pixel is as large as its distance: nearly nothing was counted there. At the
        level it would be small. The root of the deviance of a Poisson count says how far below the level it is.

        Args:
            usual: the error of most pixels, below which it is that of none: others than counts may inform a map.
        """
        below = np.minimum(np.nan_to_num(self.estimate - level), 0.0)
        error = np.minimum(self.raw_error, MOST)
        ratio = np.exp(below)
        # expected counts at the level that inform as the estimate's do, and the deviance, as differences of logarithms
        deviance = 2 * np.maximum(1 - ratio + ratio * below, 0.0) / (error**2 * ratio)
        noise = np.maximum(-below / np.sqrt(np.maximum(deviance, 1e-30)), usual)
        return np.where(below < -_LEAST_BEYOND, np.minimum(noise, self.raw_error), self.raw_error)

    @property
    def price(self) -> float:
        """The fall of the squares with the values at their estimates, less that of -2 log L of a random effect."""
        # an odd value has the wider prior of its own
        ratio = 1 / np.maximum(self._pulled, (np.minimum(self.raw_error, MOST) / WIDE) ** 2)
        return float(np.sum(ratio / (1 + ratio) + np.log1p(ratio)))

    @property
    def _pulled(self) -> np.ndarray:
        """(groups,) the ratio of the prior's information on each value to that of its data."""
        if self.held is not None:
            return self.held
        return np.maximum(np.minimum(self.raw_error**2, MOST) / np.maximum(self.error**2, 1e-30) - 1, 0.0)

    def values(self, draw: np.ndarray | None = None, width: float = 0.0) -> np.ndarray:
        """The values of the map, (groups,), SI; or a draw of the posterior.

        Args:
            draw: (groups,) standard normal numbers of the values; None for the estimate.
            width: a standard normal number of the prior's width.
        """
        logs = self.estimate
        if draw is not None:
            scale, middle = self._as_wide(width), median_of(self.estimate)
            error = self.error * np.sqrt(scale)
            # the mean of the drawn values is the estimate in the value itself
            logs = middle + (self.estimate - middle) * scale + draw * error - error**2 / 2
        relative = np.exp(np.clip(logs, -MOST, MOST))
        if self.likely is not None:  # a pixel that is informed by itself has its own estimate
            relative = np.where(self.raw_error < self.certain, relative, self._one_of(draw))
        return np.clip(self.base * relative, self.low, self.high)

    def spread_values(self) -> np.ndarray:
        """Values that differ from each other as the values of the chip do, (groups,), SI; for one sensor with the map.

        The means of the posterior, `values`, are the nearest to each true value, and differ less than these do: what is
        known poorly lies near the middle. Here the deviations of these from the middle are larger by the inverse root
        of the reliability of their estimates, and their sum stays. What is known well stays as it is.
        Source: Louis, J. Am. Stat. Assoc. 79 (1984) 393, "Estimating a population of parameter values".
        """
        logs, reliability, most = self.estimate, 1 / (1 + self._pulled), np.full(self.estimate.size, MOST)
        if self.likely is not None:  # a law of any shape, so that a hot one is moved within its own error at most
            own, error = mean_of(self.likely[1], self.likely[0])
            alone = self.raw_error >= self.certain
            apart = float(np.var(own[alone])) if alone.any() else 0.0
            logs, most = np.where(alone, own, logs), np.where(alone, error, most)
            reliability = np.where(alone, apart / np.maximum(apart + error**2, 1e-30), reliability)
        beyond = (logs - median_of(logs)) * (1 / np.sqrt(np.maximum(reliability, LEAST_RELIABLE)) - 1)
        means, poor = self.values(), reliability < RELIABLE
        factor = np.where(poor, np.exp(np.clip(beyond, -most, most)), 1.0)
        if poor.any():
            factor[poor] *= means[poor].sum() / (means[poor] @ factor[poor])
        return np.clip(means * factor, self.low, self.high)

    def _as_wide(self, draw: float) -> np.ndarray:
        """(groups,) factor on the deviation and the variance of each estimate, if the prior had another width.

        Args:
            draw: a standard normal number, for a width within its standard error.
        """
        noise = np.minimum(self.raw_error**2, MOST)
        typical = float(np.median(noise))
        if typical >= INFORMED**2:
            return np.ones(noise.size)  # these have a law of their own
        doubt = DOUBT / math.sqrt(noise.size) * (self.sigma**2 + typical)
        other = max(self.sigma**2 + draw * doubt, min(LEAST_WIDTH, self.sigma) ** 2)
        # by the prior's influence on each value: an odd one has none
        pulled = self._pulled
        return np.asarray((1 + pulled) / (1 + pulled * self.sigma**2 / other))

    @functools.cached_property
    def _running(self) -> np.ndarray:
        """(groups, grid) the cumulative posterior of each value."""
        assert self.likely is not None
        return np.asarray(np.cumsum(self.likely[1], axis=1))

    def _one_of(self, draw: np.ndarray | None) -> np.ndarray:
        assert self.likely is not None
        grid, weights = self.likely
        if draw is None:
            return np.asarray(weights @ np.exp(grid))
        place = (self._running < special.ndtr(draw).astype(weights.dtype)[:, None]).sum(axis=1)
        return np.asarray(np.exp(grid[np.minimum(place, grid.size - 1)]))


def groups_of(sensor: Sensor, per: str) -> np.ndarray:
    """The index of each pixel's value in a map over pixels, rows or columns, (pixels,)."""
    pixels = np.arange(sensor.layout.pixels)
    if per == "row":
        return pixels // sensor.layout.columns
    if per == "column":
        return pixels % sensor.layout.columns
    return pixels


def shape_of(sensor: Sensor, per: str) -> tuple[int, int] | None:
    """(rows, columns) of a map in which each pixel has a value of its own, None of other maps."""
    return (sensor.layout.rows, sensor.layout.columns) if per == "pixel" else None


def mean_of(weights: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(mean, standard deviation) of each row of weights (rows, grid) over a grid, (rows,) each."""
    weights = weights / weights.sum(axis=1, keepdims=True)
    mean = weights @ grid
    return mean, np.sqrt(np.maximum(weights @ grid**2 - mean**2, 0.0))


def outside_bulk(apart: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Which logarithms are outliers of a normal law, (groups,) bool, by a mixture with a uniform law.

    Args:
        apart: (groups,) deviations from the middle.
        variance: (groups,) of the normal law.
    """
    density = np.exp(-(apart**2) / (2 * variance)) / np.sqrt(2 * math.pi * variance)
    share = 0.01
    for _ in range(5):
        odd = share / (2 * MOST) > (1 - share) * density
        share = (float(odd.sum()) + 1) / (odd.size + 2)
    return np.asarray(odd)


def median_of(x: np.ndarray) -> float:
    """The median of an array."""
    return float(np.median(x))


def odd_pixels(map_: PixelMap) -> tuple[np.ndarray, np.ndarray]:
    """((groups,) bool far below all others or those around them, (groups,) bool far above)."""
    low, high, _ = map_.odd
    return low, high


def low_ratio(map_: PixelMap) -> tuple[float, float]:
    """(mean of the low values, each relative to what it is compared with, its standard deviation).

    It is (1, inf) if there are none.
    """
    low, _, level = map_.odd
    if not low.any():
        return 1.0, math.inf
    # pixels that are informed by themselves: the prior pulls an estimate to the others
    informed = map_.raw_error < INFORMED
    logs = np.where(informed, map_.raw, map_.estimate)[low] - level[low]
    own = float(np.mean(np.where(informed, map_.raw_error, map_.error)[low] ** 2))
    apart = float(np.var(logs, ddof=1)) if low.sum() > 1 else 0.0
    mean = float(np.exp(logs).mean())
    return mean, mean * math.sqrt(max(own, apart) / int(low.sum()))


def summary(map_: PixelMap) -> dict[str, float]:
    """The statistics of a map by name: sigma, low_fraction, low_ratio, high_fraction."""
    low, high = odd_pixels(map_)
    _, spread, noise = _spread(map_)
    return {
        "sigma": math.sqrt(max(spread - noise, 0.0)),
        "low_fraction": float(low.mean()),
        "low_ratio": low_ratio(map_)[0],
        "high_fraction": float(high.mean()),
    }


def _spread(map_: PixelMap) -> tuple[int, float, float]:
    """(number, variance, part of it that is noise) of the values that are not odd; one value has no variance."""
    low, high = odd_pixels(map_)
    rest = ~(low | high) & map_.informed & (map_.raw_error < NOTHING)  # a hit hides what a pixel has by itself
    number = int(rest.sum())
    if number < 2:
        return number, 0.0, 0.0
    return number, float(np.var(map_.raw[rest], ddof=1)), float(np.mean(map_.raw_error[rest] ** 2))


def interval_of_sigma(number: int, variance: float, noise: float) -> tuple[float, float]:
    """The 95 % interval of the standard deviation of the law of normal values beside noise: chi square of all of it.

    Args:
        number: of values, at least 2.
        variance: of the values with their noise, unbiased.
        noise: the mean variance of the noise.
    """
    free = number - 1
    ends = (free * variance / float(stats.chi2.ppf(q, free)) - noise for q in (0.975, 0.025))
    low, high = (math.sqrt(max(end, 0.0)) for end in ends)
    return low, high


def evidence_of_patterns(map_: PixelMap, patterns: dict[str, np.ndarray]) -> dict[str, PatternEvidence]:
    """The evidence for each pattern in a map over pixels, by name; see `mixed_model`.

    Args:
        patterns: (pixels, shapes), or the group of each pixel, (pixels,).
    """
    some = map_.informed
    y = np.exp(np.clip(map_.raw[some], -MOST, MOST))
    error = map_.raw_error[some] * np.exp(np.clip(map_.estimate[some], -MOST, MOST))
    return mixed_model.evidence_of_patterns(y, error, {name: x[some] for name, x in patterns.items()})


def spread_p(map_: PixelMap) -> float:
    """The p-value of a map under the null that all pixels are alike."""
    informed = map_.raw_error < NOTHING  # pixels without information are left out
    if informed.sum() < 3 or float(np.std(map_.estimate)) < LEAST_WIDTH:  # all at a bound: no differences
        return 1.0
    r, weight = map_.raw[informed], 1 / map_.raw_error[informed] ** 2
    z = (r - float(np.average(r, weights=weight))) ** 2 * weight
    return float(stats.chi2.sf(float(z.sum()), int(informed.sum()) - 1))


def code_periods(cells: int) -> dict[int, slice]:
    """The cells of the statistic of the codes that hold each period."""
    out: dict[int, slice] = {}
    start = 0
    for period in Statistic.registry.find(informant("codes")).periods:
        if start + period <= cells:
            out[period] = slice(start, start + period)
            start += period
    return out


def by_counts(candidate: Candidate) -> bool:
    """Whether the counts of the pixels inform a map."""
    return candidate.per != "code" and not candidate.blinds and not candidate.informed_by


def acts_on_light(sensor: Sensor, candidate: Candidate) -> bool:
    """Whether a parameter acts on the light alone; its mean is then confused with the light level."""
    return Effect.registry.find(candidate.effect).on_light


def _width_of_few(map_: PixelMap) -> blind_times.Width | None:
    """The width of the pixels' law by the likelihood of all of them; None for many counts.

    The estimate of a pixel with few counts is no normal number, so that its variance is not that of the noise and more.
    Hot pixels are a uniform share of the law, the one of a few that is most likely.
    """
    if map_.likely is None or map_.prior is None or float(np.median(map_.raw_error)) < map_.certain:
        return None
    rest = np.flatnonzero(map_.informed)
    if rest.size > _MOST_FOR_WIDTH:
        rest = np.sort(np.random.Generator(np.random.SFC64(rest.size)).permutation(rest)[:_MOST_FOR_WIDTH])
    grid, weights = map_.likely
    known = map_.prior > 0
    likely = weights[rest][:, known] / map_.prior[known]
    widths = [blind_times.width_of(grid[known], likely, share) for share in _HOT] if rest.size > 3 else []
    return max(widths, key=lambda width: width.log_likelihood, default=None)


def map_values(map_: PixelMap) -> dict[str, Value]:
    """The results of a map by name, with 95 % intervals."""
    results = {name: Value(number, None, None) for name, number in summary(map_).items()}
    number, variance, noise = _spread(map_)
    if number > 1:
        results["sigma"] = Value(results["sigma"].value, *interval_of_sigma(number, variance, noise))
    width = map_.width or _width_of_few(map_)
    if width is not None:
        results["sigma"] = Value(width.sigma, width.low, width.high)
    for name in ("low_fraction", "high_fraction"):
        n, k = len(map_.raw), results[name].value * len(map_.raw)
        low = float(stats.beta.ppf(0.025, k, n - k + 1)) if k > 0 else 0.0
        high = float(stats.beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
        results[name] = Value(results[name].value, low, high)
    ratio, error = low_ratio(map_)
    if math.isfinite(error):  # without low pixels there is no ratio
        results["low_ratio"] = Value(ratio, max(ratio - HALF_95 * error, 0.0), ratio + HALF_95 * error)
    return results
