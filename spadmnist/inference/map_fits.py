"""Fits of maps: the value of a parameter in each pixel, by empirical Bayes, from the counts of every capture.

The closed forms of the effects give the rate of a pixel as a function of the parameter. Maps of several parameters
are fitted together, pixel by pixel, by Newton's method on logarithms relative to the array. The width of the prior is
that of the pixels' differences. It has long tails, so that odd pixels stay odd; its middle is the value of most
pixels. Dead times are fitted from the shortest intervals (`blind_times`), widths of codes from their frequencies.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from ..effects import Effect
from ..errors import SpadError
from ..sensor import Sensor
from ..statistics import informant
from . import blind_times
from .candidates import Candidate, with_values
from .coordinates import Key, Values
from .count_model import CountModel
from .hit_pixels import beside_maps
from .levels import LEAST_P
from .pixel_maps import (
    GRID,
    INFORMED,
    LEAST_WIDTH,
    MOST,
    ODD,
    ROUNDS,
    TAILS,
    TURNS,
    WIDE,
    PixelMap,
    acts_on_light,
    by_counts,
    code_periods,
    groups_of,
    mean_of,
    median_of,
    outside_bulk,
    shape_of,
)
from .point_process import blur_of
from .replicates import Replicates
from .statistic_maps import fit_by_statistic

# Logarithms of a parameter relative to the array, unless another unit is named. Those of an iteration decide how fast a
# fit moves, not where it ends. All but `_MANY` are rules of thumb: no measurement that is kept chose them.
_FIRST_WIDTH = 0.3  # of a prior before its width is estimated
_FIRST_PRECISION = 1e-6  # of that prior: no pixel is held before the width is estimated
_WIDTHS = (1e-4, 3.0)  # bounds of the width of a prior: none to speak of, a factor of 20
_DIFFERENCE = 0.02  # by which derivatives are taken: counts are smooth on a scale of 1
_LARGEST_STEP = 0.7  # of an estimate in an iteration: a factor of 2, beyond which a linear model says little
_LARGEST_FREE_STEP = 2.0  # the same without a prior, for which little holds an estimate back
_LARGEST_SHIFT = 0.5  # of the mean of all pixels in an iteration
_LEVEL_STEP = 2.0  # factor: the most that a light level changes in an iteration
# probability of a child of an avalanche, at most: at 1 a cascade does not end, here it has ten avalanches in the mean
_CASCADE_ENDS = 0.9
_MANY = 128  # values, the median of whose distances gives their width within 10 % (normal law); fewer are clipped
_CLIPPED = 3  # how often odd ones of fewer values are left out, each time by the width of the rest
_FREE_TURNS = 2  # iterations before the prior's width is estimated, so that the maps have their shape by then


def base_of(sensor: Sensor, candidate: Candidate) -> float:
    """The value that a map is relative to: the array's own mean, or `off` of an effect that the sensor lacks."""
    assert candidate.carrier is not None
    effect = sensor.effect(candidate.carrier[0])
    if effect is not None:
        return float(np.mean(np.asarray(getattr(effect, candidate.carrier[1]), float)))
    off = Effect.registry.find(candidate.carrier[0]).parameters[candidate.carrier[1]].off
    return float(off if off is not None else 1.0)


def bounds_of(carrier: Key) -> tuple[float, float]:
    """The least and the largest value of a parameter in a map, SI."""
    effect = Effect.registry.find(carrier[0])
    low, high = effect.parameters[carrier[1]].bounds
    if effect.has_children and high == 1:
        high = _CASCADE_ENDS
    return 0.0 if low is None else low, math.inf if high is None else high


@dataclass
class _Fitted:
    """One of the maps that are fitted together: logarithms relative to `base`, each with a normal prior.

    Attributes:
        group: (pixels,) the group that each pixel belongs to.
        low: smallest value that the parameter may have.
        high: largest value.
        of_light: the map acts on the light, so that its mean is that of the light level.
        dark: a capture without light informs it. Without one most pixels keep the listed value: a common change is
            confused with the light level.
        logs: (groups,) estimates.
        variance: (groups,) of the estimates.
        raw: (groups,) estimates without the prior.
        raw_variance: (groups,) of these.
        middle: of the prior, that of most pixels.
        sigma: width of the prior.
        precision: (groups,) of the prior: smaller for odd pixels.
        shape: (rows, columns) of a map of pixels.
        moved: (groups,) the last step of the estimates.
    """

    candidate: Candidate
    base: float
    group: np.ndarray
    low: float
    high: float
    of_light: bool
    dark: bool
    logs: np.ndarray
    variance: np.ndarray
    raw: np.ndarray
    raw_variance: np.ndarray
    precision: np.ndarray
    moved: np.ndarray
    shape: tuple[int, int] | None
    middle: float = 0.0
    sigma: float = _FIRST_WIDTH

    @classmethod
    def of(cls, start: Sensor, candidate: Candidate, dark: bool) -> _Fitted:
        """The map before its first iteration; `dark` as the attribute."""
        assert candidate.carrier is not None
        declared = Effect.registry.find(candidate.carrier[0]).parameters[candidate.carrier[1]]
        base, group = base_of(start, candidate), groups_of(start, candidate.per)
        low, high = bounds_of(candidate.carrier)
        size = int(group.max()) + 1
        return cls(
            candidate=candidate,
            base=base if base > 0 else float((declared.search or (1e-3, 1))[0]),
            group=group,
            low=low,
            high=high,
            of_light=acts_on_light(start, candidate),
            dark=dark,
            logs=np.zeros(size),
            variance=np.ones(size),
            raw=np.zeros(size),
            raw_variance=np.zeros(size),
            precision=np.full(size, _FIRST_PRECISION),
            moved=np.zeros(size),
            shape=shape_of(start, candidate.per),
        )

    def sums(self, pixels: np.ndarray, weight: np.ndarray | float = 1.0) -> np.ndarray:
        """(groups,) sums of (pixels,) numbers over the groups, weighted."""
        return np.asarray(weight * np.bincount(self.group, pixels, self.logs.size))

    def value(self, logs: np.ndarray) -> np.ndarray:
        """(groups,) values of the parameter, SI."""
        return np.asarray(np.clip(self.base * np.exp(np.clip(logs, -MOST, MOST)), self.low, self.high))

    def move(self, by: np.ndarray) -> None:
        """Move the estimates, by a step that is not too large."""
        before = self.logs
        self.logs = np.clip(before + np.clip(by, -_LARGEST_STEP, _LARGEST_STEP), -MOST, MOST)
        self.moved = self.logs - before

    def move_alone(self, normal: np.ndarray, score: np.ndarray) -> None:
        """A Newton step of this map, with the others as they are.

        Args:
            normal: (pixels,) information of the counts.
            score: (pixels,) derivatives of their log-likelihood.
        """
        information, gradient = self.sums(normal), self.sums(score)
        self.move((gradient - self.precision * (self.logs - self.middle)) / (information + self.precision))
        self.variance = 1 / (information + self.precision)
        own = np.maximum(information, 1e-12)
        self.raw, self.raw_variance = self.logs + gradient / own, 1 / own

    def renew_prior(self, normal: np.ndarray, score: np.ndarray, left: np.ndarray) -> None:
        """Middle and width of the prior from the pixels' differences beyond their noise, robust against odd pixels.

        Args:
            normal: (pixels,) information of the counts.
            score: (pixels,) derivatives of their log-likelihood before the last step.
            left: (pixels,) the derivatives behind it, by the linear model.
        """
        weight = (TAILS + 1) / (TAILS + (self.logs - self.middle) ** 2 / self.sigma**2)
        if self.of_light:
            self.logs = self.logs - math.log(float(np.mean(np.exp(self.logs))))
        elif not self.dark:
            self.logs = self.logs - float(np.average(self.logs, weights=weight))
            self.middle = 0.0
        else:  # the mean of all pixels, which no pixel by itself may inform
            own, rest = self.sums(normal, weight), self.sums(left, weight)
            shift = float(np.clip(rest.sum() / max(float(own.sum()), 1e-12), -_LARGEST_SHIFT, _LARGEST_SHIFT))
            self.logs = self.logs + shift
            self.middle = float(np.average(self.logs, weights=weight))
        square = float(np.mean(weight * (self.logs - median_of(self.logs)) ** 2 + self.variance))
        self.sigma = min(max(math.sqrt(square), _WIDTHS[0]), _WIDTHS[1])
        noise = float(np.median(self.raw_variance))
        if noise < INFORMED**2:
            # of most pixels, beyond their noise; an iteration towards a width of 0 would be slow
            self.sigma = math.sqrt(max(width_of_most(self.raw, noise) ** 2 - noise, LEAST_WIDTH**2))
        apart = self.logs - self.middle
        odd = outside_bulk(apart, self.sigma**2 + self.variance)
        if noise >= INFORMED**2:
            self.sigma = self._width_of_few(normal, score, apart, odd)
        self.precision = np.where(
            odd,
            WIDE**-2,  # odd pixels are of another kind, on which the prior holds no information
            (TAILS + 1) / (TAILS * self.sigma**2 + apart**2),
        )

    def _width_of_few(self, normal: np.ndarray, score: np.ndarray, apart: np.ndarray, odd: np.ndarray) -> float:
        """The width from the scatter of the counts beyond noise, by moments.

        The estimates of poorly informed pixels say little.

        Args:
            apart: (groups,) estimates relative to the middle.
            odd: (groups,) pixels that are left out.
        """
        fitted = np.maximum(self.sums(normal), 1e-9)
        counted = fitted + self.sums(score)
        # the expectation with the middle's value: the estimate must not weight itself
        null_counts = fitted * np.exp(-apart)
        counted, null_counts = counted[~odd], null_counts[~odd]
        # about the mean of the counts
        null_counts = np.maximum(
            null_counts * max(float(counted.sum()), 1e-9) / max(float(null_counts.sum()), 1e-9), 1e-9
        )
        square = max(float((null_counts**2).sum()), 1e-12)  # the noise of a single odd pixel is left out
        # relative variance of the counts; that of the logarithms is smaller
        relative = float(((counted - null_counts) ** 2 - null_counts).sum()) / square
        return min(math.sqrt(max(math.log1p(max(relative, 0.0)), LEAST_WIDTH**2)), _WIDTHS[1])

    def map(self, of_scene: bool) -> PixelMap:
        """The map as fitted."""
        assert self.candidate.carrier is not None
        own = np.maximum(1 / np.maximum(self.variance, 1e-30) - self.precision, 1e-12)  # of counts and other maps
        return PixelMap(
            carrier=self.candidate.carrier,
            base=self.base,
            held=self.precision / own,
            group=self.group,
            estimate=self.logs,
            error=np.sqrt(np.maximum(self.variance, 0)),
            raw=self.raw,
            raw_error=np.sqrt(self.raw_variance),
            sigma=self.sigma,
            low=self.low,
            high=self.high,
            shape=self.shape,
            of_scene=of_scene,
        )


def width_of_most(raw: np.ndarray, noise: float) -> float:
    """The standard deviation of most values.

    The median of their distances needs many: that of 32 rows is off by 20 %, the mean square of those that are not odd
    by 13 %.

    Args:
        raw: (groups,) logarithms.
        noise: the variance of their noise.
    """
    apart = raw - median_of(raw)
    width = 1.4826 * median_of(np.abs(apart))
    if raw.size >= _MANY:
        return width
    for _ in range(_CLIPPED):  # a median that is too small by chance cuts off values that are not odd
        rest = apart[~outside_bulk(apart, np.full(raw.size, max(width**2, noise)))]
        width = float(np.std(rest, ddof=1)) if rest.size > 1 else width
    return width


def fit_maps(
    replicates: Replicates,
    values: Values,
    wanted: Sequence[Candidate],
    levels: dict[str, float],
    use: Sequence[str] = (),
) -> dict[Key, PixelMap]:
    """The maps of some parameters, by empirical Bayes, by carrier.

    The mean rate of the array informs the light level in lit captures, so that these inform the differences of the
    pixels only.

    Args:
        values: the other values of the model, SI.
        wanted: candidates with a carrier.
        levels: light level by capture; lit ones are adjusted to the maps.
        use: the captures that are used; all where it is empty.
    Raises:
        SpadError: where no capture informs a map.
    """
    out = {c.carrier: fit_codes(replicates, c, use) for c in wanted if c.per == "code" and c.carrier is not None}
    out |= {
        c.carrier: fit_blind_times(replicates, values, c, use) for c in wanted if c.blinds and c.carrier is not None
    }
    for c in wanted:
        if c.informed_by and c.carrier is not None:
            start = with_values(replicates.start, {k: v for k, v in values.items() if k != c.carrier})
            bounds = bounds_of(c.carrier)
            out[c.carrier] = fit_by_statistic(replicates, values, c, base_of(start, c), bounds, use)
    wanted = [c for c in wanted if by_counts(c)]
    if not wanted:
        return out
    values = beside_maps(replicates, values, {c.carrier for c in wanted if c.carrier is not None}, levels)
    start = with_values(replicates.start, {k: v for k, v in values.items() if k not in {c.carrier for c in wanted}})
    lines = [
        CountModel(replicates, id, levels[id])
        for id, s in replicates.seen.items()
        if s.counts is not None and (not use or id in use)
    ]
    dark = any(line.seen.capture.light.dark for line in lines)
    fitted = [_Fitted.of(start, candidate, dark) for candidate in wanted]

    def model(logs: Sequence[np.ndarray]) -> Sensor:
        maps = {one.candidate.carrier: one.value(own) for one, own in zip(fitted, logs, strict=True)}
        return with_values(replicates.start, {**values, **maps})  # type: ignore[dict-item]

    none, groups = [one.logs for one in fitted], [one.group for one in fitted]
    for one, begun in zip(fitted, _begun(lines, model, groups, none, _DIFFERENCE), strict=True):
        one.logs = begun
    together = all(c.per == "pixel" for c in wanted)  # otherwise one map after the other
    for turn in range(TURNS):
        normal, score = _normal_equations(lines, model, fitted, replicates.dead)
        if together:
            _move_together(fitted, normal, score)
        for i, one in enumerate(fitted):
            if not together:
                one.move_alone(normal[:, i, i], score[:, i])
        if turn >= _FREE_TURNS:
            moved = np.stack([one.moved[one.group] for one in fitted], axis=1)
            left = score - (normal @ moved[:, :, None])[:, :, 0]
            for i, one in enumerate(fitted):
                one.renew_prior(normal[:, i, i], score[:, i], left[:, i])
    scene = any(replicates.of_scene(line.id) for line in lines)
    for i, one in enumerate(fitted):
        assert one.candidate.carrier is not None
        map_ = one.map(one.of_light and scene)
        if not one.of_light and float(np.median(one.raw_variance)) >= INFORMED**2:

            def at(log: float, i: int = i) -> Sensor:
                return model([np.full(o.logs.size, log) if j == i else o.logs for j, o in enumerate(fitted)])

            map_ = _of_few_counts(map_, lines, at, model([o.logs for o in fitted]))
        out[one.candidate.carrier] = map_
    return out


def _normal_equations(
    lines: Sequence[CountModel],
    model: Callable[[Sequence[np.ndarray]], Sensor],
    fitted: Sequence[_Fitted],
    dead: float,
) -> tuple[np.ndarray, np.ndarray]:
    """(information (pixels, maps, maps), derivatives of the log-likelihood (pixels, maps)) of all counts.

    The light level of each lit capture is moved towards that of these maps.

    Args:
        model: (groups,) logarithms of each map -> sensor.
        dead: dead time, s.
    """
    logs = [one.logs for one in fitted]
    now = model(logs)
    other = [model([d + (_DIFFERENCE if j == i else 0) for j, d in enumerate(logs)]) for i in range(len(logs))]
    pixels, k = len(fitted[0].group), len(fitted)
    normal, score = np.zeros((pixels, k, k)), np.zeros((pixels, k))
    for line in lines:
        counts = line.seen.counts
        assert counts is not None
        expected = line.expected(now)
        scale = 1.0 if line.seen.capture.light.dark else counts.sum() / expected.sum()
        # until the level is that of these maps, and no factor is needed
        line.level *= min(max(scale, 1 / _LEVEL_STEP), _LEVEL_STEP)
        alone = line.alone(now)  # of a pixel's own value: what its neighbours cause there is that of their values
        jacobian = np.stack([(line.alone(o) - alone) / _DIFFERENCE for o in other], axis=1)
        expected = expected * scale
        variance = line.variance(np.maximum(expected, 0.5), dead)
        normal += jacobian[:, :, None] * jacobian[:, None, :] / variance[:, None, None]
        score += jacobian * ((counts - expected) / variance)[:, None]
    return normal, score


def _move_together(fitted: Sequence[_Fitted], normal: np.ndarray, score: np.ndarray) -> None:
    """A Newton step of all maps, pixel by pixel.

    Args:
        normal: (pixels, maps, maps) information of the counts.
        score: (pixels, maps) derivatives of their log-likelihood.
    """
    k = len(fitted)
    prior = np.stack([one.precision for one in fitted], axis=1)
    whole = normal + np.eye(k) * prior[:, None, :]
    middle = np.array([one.middle for one in fitted])
    pull = score - prior * (np.stack([one.logs for one in fitted], axis=1) - middle)
    solved = np.linalg.solve(whole, pull[:, :, None])[:, :, 0]
    inverse = np.linalg.inv(whole)
    bare = normal + 1e-9 * np.eye(k)
    free = np.linalg.solve(bare, score[:, :, None])[:, :, 0]  # without the prior; the other maps are free
    variance_free = np.linalg.inv(bare)
    for i, one in enumerate(fitted):
        one.raw, one.raw_variance = (
            one.logs + np.clip(free[:, i], -_LARGEST_FREE_STEP, _LARGEST_FREE_STEP),
            variance_free[:, i, i],
        )
        one.move(solved[:, i])
        one.variance = inverse[:, i, i]


def _of_few_counts(
    map_: PixelMap, lines: Sequence[CountModel], model: Callable[[float], Sensor], fitted: Sensor
) -> PixelMap:
    """The map of pixels with few counts, with a nonparametric prior that all of them inform together.

    Args:
        lines: the count model of each capture.
        model: log value of all pixels -> sensor.
        fitted: the sensor with the map so far, by which neighbours cause counts.
    """
    received = [line.expected(fitted) - line.alone(fitted) for line in lines]
    centre, size = float(np.median(map_.estimate)), map_.estimate.size
    grid = centre + np.linspace(*GRID)
    logs = np.stack(
        [
            np.bincount(
                map_.group,
                sum(line.log_likelihood(line.alone(sensor) + more) for line, more in zip(lines, received, strict=True)),
                size,
            )
            for sensor in map(model, grid.tolist())
        ],
        axis=1,
    )
    weights, prior = _by_their_law(np.exp(logs - logs.max(axis=1, keepdims=True)))
    mean, error = mean_of(weights, grid)
    informed = map_.raw_error < INFORMED
    estimate, error = np.where(informed, map_.estimate, mean), np.where(informed, map_.error, error)
    alone = np.maximum(np.minimum(map_.raw_error**2, MOST) / np.maximum(error**2, 1e-30) - 1, 0.0)
    held = alone if map_.held is None else np.where(informed, map_.held, alone)
    return replace(map_, estimate=estimate, error=error, likely=(grid, weights), prior=prior, held=held)


def _by_their_law(likely: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((groups, grid) posterior weights of each value under the common law of all pixels, (grid,) that law).

    The law is the nonparametric maximum-likelihood estimate by expectation and maximization (Laird, JASA 73, 1978),
    stopped while it is smooth.

    Args:
        likely: (groups, grid) likelihoods.
    """
    law = np.full(likely.shape[1], 1 / likely.shape[1])
    for _ in range(ROUNDS):
        prior, weights = law, likely * law
        weights /= weights.sum(axis=1, keepdims=True)
        law = weights.mean(axis=0)
    return weights, prior


def _begun(
    lines: Sequence[CountModel],
    model: Callable[[Sequence[np.ndarray]], Sensor],
    groups: Sequence[np.ndarray],
    none: Sequence[np.ndarray],
    step: float,
) -> list[np.ndarray]:
    """The start of a map fit: 0, but for odd pixels, whose estimate is from the capture with the most information."""
    now, out = model(none), []
    for i, group in enumerate(groups):
        other = model([d + (step if j == i else 0) for j, d in enumerate(none)])
        most, best = 0.0, np.zeros(none[i].size)
        for line in lines:
            counts, expected = line.seen.counts, line.expected(now)
            assert counts is not None
            slope = (line.alone(other) - line.alone(now)) / step
            informative = float((slope**2 / line.variance(np.maximum(expected, 0.5), 0.0)).sum())
            if informative > most and not line.saturated(counts):
                scale = 1.0 if line.seen.capture.light.dark else counts.sum() / expected.sum()
                measured = np.bincount(group, counts, none[i].size)
                null_counts = np.bincount(group, expected * scale, none[i].size)
                elasticity = max(float(slope.sum() / expected.sum()), 0.3)
                logs = np.clip(np.log((measured + 0.5) / (null_counts + 0.5)) / elasticity, -MOST / 2, MOST / 2)
                odd = np.abs(measured - null_counts) > ODD * np.sqrt(line.variance(null_counts, 0.0) + 1)
                most, best = informative, np.where(odd, logs, 0.0)
        out.append(best)
    return out


def _score_of_square(square: float, freedom: int) -> float:
    """The normal score of the upper tail of a chi square; of a tail that is 0, by Wilson and Hilferty's cube root."""
    p = float(stats.chi2.sf(square, freedom))
    if p > LEAST_P:
        return float(stats.norm.isf(p))
    spread = 2 / (9 * freedom)
    return float((np.cbrt(square / freedom) - 1 + spread) / math.sqrt(spread))


def fit_codes(replicates: Replicates, candidate: Candidate, use: Sequence[str] = ()) -> PixelMap:
    """The map of a converter's code widths from the frequency of each code.

    Its period is that with the smallest p-value, by its normal score: of many detections all p-values may be 0.

    Args:
        use: the captures that are used; all where it is empty.
    Raises:
        SpadError: where no capture has codes.
    """
    folded: dict[int, np.ndarray] = {}
    for id, seen in replicates.seen.items():
        summary = seen.summaries.get(informant("codes"))
        if summary is None or (use and id not in use):
            continue
        for period, part in code_periods(len(summary.values)).items():
            folded[period] = folded.get(period, 0.0) + summary.values[part]
    assert candidate.carrier is not None
    found: PixelMap | None = None
    most = -math.inf
    for period, counts in folded.items():
        mean = max(float(counts.mean()), 1.0)
        score = _score_of_square(float(((counts - mean) ** 2).sum()) / mean, period - 1)
        if score <= most:
            continue
        most, raw, noise = score, np.maximum(counts, 0.5) / mean - 1, 1 / mean
        sigma = math.sqrt(max(float(np.mean(raw**2)) - noise, 1e-8))
        share = sigma**2 / (sigma**2 + noise)
        logs = np.log(np.maximum(1 + raw * share, 1e-3))
        error = np.full(period, math.sqrt(noise * share))
        spread = np.full(period, math.sqrt(noise))
        found = PixelMap(
            carrier=candidate.carrier,
            base=1.0,
            group=np.arange(period),
            estimate=logs,
            error=error,
            raw=np.log1p(raw),
            raw_error=spread,
            sigma=sigma,
        )
    if found is None:
        raise SpadError("no capture has stamps with codes")
    return found


def fit_blind_times(replicates: Replicates, values: Values, candidate: Candidate, use: Sequence[str] = ()) -> PixelMap:
    """The map of the pixels' dead times from their shortest intervals.

    Args:
        use: the captures that are used; all where it is empty.
    Raises:
        SpadError: where no capture informs it, or the blur of the edges is not normal in the model.
    """
    assert candidate.carrier is not None
    start = with_values(replicates.start, {k: v for k, v in values.items() if k != candidate.carrier})
    base = base_of(start, candidate)
    captures = [s.shortest for id, s in replicates.seen.items() if s.shortest is not None and (not use or id in use)]
    blur = blur_of(start)
    if blur is None or start.soft:
        raise SpadError("dead times by pixel are not estimated where stamps or the recovery blur them by other laws")
    found = blind_times.likelihoods(captures, blur, base) if captures and base > 0 else None
    if found is None:
        raise SpadError("no capture has intervals short enough to estimate the dead time of each pixel")
    grid, likely = found
    width = blind_times.width_of(grid, likely)
    weights = likely * width.prior.astype(np.float32)
    weights /= weights.sum(axis=1, keepdims=True)
    estimate, error = mean_of(weights, grid)
    raw, raw_error = mean_of(likely, grid)
    low, high = bounds_of(candidate.carrier)
    map_ = PixelMap(
        carrier=candidate.carrier,
        base=base,
        group=groups_of(start, candidate.per),
        estimate=estimate,
        error=error,
        raw=raw,
        raw_error=raw_error,
        sigma=width.sigma,
    )
    shape = shape_of(start, candidate.per)
    return replace(map_, low=low, high=high, shape=shape, likely=(grid, weights), certain=0.0, width=width)
