"""Maps: what each pixel's own value of a parameter is, from how many detections it has in every capture.

How long a pixel is blind its shortest intervals tell (`edges`), how long codes are, how often each occurs.

The closed forms of the effects say how a pixel's rate follows a parameter, in every capture. Maps of several parameters
are settled together, pixel by pixel, by Newton's method on the logarithms of their values relative to the array's; a
prior as wide as the pixels turn out to differ keeps noise out, and one with long tails lets odd pixels be odd. Its
middle is what most pixels have: the listed value may be the mean of a few hot ones.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import special, stats

from ..effects import Effect
from ..errors import SpadError
from ..sensor import Sensor
from . import edges
from .candidates import Change, Key, Values, with_values
from .fit import Bench, Sensors
from .likelihood import blur_of
from .recordings import InTheDark, in_frames

_TAILS = 3.0  # degrees of freedom of the prior
_ALONE = 0.6  # share of what is known of a map, in the mean over its pixels: then a capture is needed to settle it
_TELLING, _LEAST_WIDTH = 0.2, 1e-3  # noise of a logarithm below which pixels tell how wide they lie; no narrower
_DOUBT = 2.34  # of the variance of many pixels by the median of their distances: relative error, times the root of them
_TURNS = 16
_MOST = 10.0  # of a logarithm
_ODD, _WIDE = 3.5, 2.0  # standard deviations of a pixel that is odd; of a logarithm, how wide these lie
CODES = "codes"
_PERIODS = (256, 140, 100)  # as `statistics.codes` folds them
_GRID, _ROUNDS = (-4.0, 8.0, 97), 100  # logarithms about the middle that pixels of few counts may have
_FAR_OFF = 4.0  # standard deviations from most pixels, beyond which it does not matter how far
_NEEDED = 1e-4  # p-value of a map that is needed beside others
NOTHING = 3.0  # standard deviations of a logarithm, from which on nothing is known of it


@dataclass(frozen=True)
class Map:
    """A map in logarithms: values are base * exp(estimate). error: standard deviation; raw, raw_error: without prior.

    group: (pixels,) which of the values each pixel has (rows and columns share one).
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
    likely: tuple[np.ndarray, np.ndarray] | None = None  # (grid,) logarithms, (groups, grid) how likely each is
    certain: float = _TELLING  # raw_error, below which a value is the estimate, whatever the others are
    width: edges.Width | None = None  # where the likelihood of all pixels tells it
    of_scene: bool = False  # and so no light falls on some pixels, and nothing tells how much of it they detect

    @property
    def told(self) -> np.ndarray:
        """(groups,) bool: which values anything is known of."""
        return self.raw_error < NOTHING if self.of_scene else np.ones(self.raw.size, bool)

    @property
    def price(self) -> float:
        """How much less twice the log likelihood of values that scatter by sigma rises than the squares fall, if each
        is put where its estimate is.
        """
        # how wide they are thought to lie: an odd one has a prior of its own
        ratio = 1 / np.maximum(self._pulled, (np.minimum(self.raw_error, _MOST) / _WIDE) ** 2)
        return float(np.sum(ratio / (1 + ratio) + np.log1p(ratio)))

    @property
    def _pulled(self) -> np.ndarray:
        """(groups,) what the prior knows of each beside what its counts tell, both as inverse squares."""
        return np.maximum(np.minimum(self.raw_error**2, _MOST) / np.maximum(self.error**2, 1e-30) - 1, 0.0)

    def values(self, draw: np.ndarray | None = None, width: float = 0.0) -> np.ndarray:
        """(groups,) values; draw, width: standard normal numbers, for one of the maps that may be true."""
        logs = self.estimate
        if draw is not None:
            scale, middle = self._as_wide(width), _middle(self.estimate)
            error = self.error * np.sqrt(scale)
            # a draw of the logarithm has the mean of the estimate in the value itself
            logs = middle + (self.estimate - middle) * scale + draw * error - error**2 / 2
        relative = np.exp(np.clip(logs, -_MOST, _MOST))
        if self.likely is not None:  # a pixel that says much by itself is where it says
            relative = np.where(self.raw_error < self.certain, relative, self._one_of(draw))
        return np.clip(self.base * relative, self.low, self.high)

    def _as_wide(self, draw: float) -> np.ndarray:
        """(groups,) by how much less noise is kept out, if the width is another one that the pixels bear with.

        Of an estimate and of its variance alike: both are what the prior's width leaves of them.
        """
        noise = np.minimum(self.raw_error**2, _MOST)
        usual = float(np.median(noise))
        if usual >= _TELLING**2:
            return np.ones(noise.size)  # these have a law of their own
        doubt = _DOUBT / math.sqrt(noise.size) * (self.sigma**2 + usual)
        other = max(self.sigma**2 + draw * doubt, min(_LEAST_WIDTH, self.sigma) ** 2)
        # by what the prior has done to each: an odd one is none of those whose width is in doubt
        pulled = self._pulled
        return np.asarray((1 + pulled) / (1 + pulled * self.sigma**2 / other))

    @functools.cached_property
    def _running(self) -> np.ndarray:
        """(groups, grid) how probable a value is up to each point."""
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
    """(pixels,) which value of a map over pixels, rows or columns each pixel has."""
    pixels = np.arange(sensor.layout.pixels)
    if per == "row":
        return pixels // sensor.layout.columns
    if per == "column":
        return pixels % sensor.layout.columns
    return pixels


class Line:
    """Expected detections of each pixel in one capture, for maps: of first stamps in the time that it waited."""

    def __init__(self, bench: Bench, id: str, level: float):
        self.seen, self.id, self.level = bench.seen[id], id, level
        self.conditions = self.seen.capture.conditions
        self.waited = self.seen.waited
        self.frames = not self.seen.capture.counts_events and self.waited is None

    def expected(self, sensor: Sensor) -> np.ndarray:
        if self.seen.capture.light.dark:
            sensor = InTheDark.of(sensor)
        light = np.full((1, sensor.layout.pixels), self.level)
        if self.seen.capture.counts_events:
            return np.maximum(sensor.expected(light, self.conditions)[1][0], 1e-9)
        share = in_frames(sensor, light, self.conditions)[0]
        if self.waited is None:
            return np.maximum(self.conditions.frames * share, 1e-9)
        return np.asarray(np.maximum(self.waited * -np.log1p(-np.minimum(share, 1 - 1e-15)), 1e-9))

    def log_likelihood(self, expected: np.ndarray) -> np.ndarray:
        """(pixels,) of the counts that were measured."""
        counts = self.seen.counts
        assert counts is not None
        if not self.frames:
            return np.asarray(counts * np.log(expected) - expected)
        share = np.clip(expected / self.conditions.frames, 1e-12, 1 - 1e-9)
        return np.asarray(counts * np.log(share) + (self.conditions.frames - counts) * np.log1p(-share))

    def saturated(self, counts: np.ndarray) -> bool:
        """Have half of the pixels hardly a frame left?"""
        return self.frames and float(np.median(counts)) > 0.9 * self.conditions.frames

    def variance(self, n: np.ndarray, dead: float) -> np.ndarray:
        if self.waited is not None:
            return np.maximum(n, 0.25)
        if self.frames:
            return np.maximum(n * (1 - np.minimum(n / self.conditions.frames, 1 - 1e-4)), 0.25)
        return np.maximum(n * (1 - np.minimum(n * dead / self.conditions.exposure, 0.99)) ** 2, 0.25)


def _base_of(sensor: Sensor, change: Change) -> float:
    """What a map's values are relative to: the array's own mean, or where the effect vanishes."""
    assert change.carrier is not None
    effect = sensor.effect(change.carrier[0])
    if effect is not None:
        return float(np.mean(np.asarray(getattr(effect, change.carrier[1]), float)))
    off = Effect.registry.find(change.carrier[0]).parameters[change.carrier[1]].off
    return float(off if off is not None else 1.0)


def _bounds_of(carrier: Key) -> tuple[float, float]:
    low, high = Effect.registry.find(carrier[0]).parameters[carrier[1]].bounds
    return 0.0 if low is None else low, math.inf if high is None else high


def settle_maps(
    bench: Bench, values: Values, wanted: Sequence[Change], levels: dict[str, float], use: Sequence[str] = ()
) -> dict[Key, Map]:
    """Maps of some parameters, from the captures in `use` (all).

    The array's own mean rate is the light's matter in lit captures, so they tell the pixels' differences only.
    """
    others = {c.carrier: settle_codes(bench, c, use) for c in wanted if c.per == "code" and c.carrier is not None}
    others |= {c.carrier: settle_edges(bench, values, c, use) for c in wanted if c.blinds and c.carrier is not None}
    wanted = [c for c in wanted if by_counts(c)]
    if not wanted:
        return others
    start = with_values(bench.start, {k: v for k, v in values.items() if k not in {c.carrier for c in wanted}})
    lines = [
        Line(bench, id, levels[id]) for id, s in bench.seen.items() if s.counts is not None and (not use or id in use)
    ]
    bases, groups, bounds = [], [], []
    for change in wanted:
        assert change.carrier is not None
        declared = Effect.registry.find(change.carrier[0]).parameters[change.carrier[1]]
        base = _base_of(start, change)
        bases.append(base if base > 0 else float((declared.search or (1e-3, 1))[0]))
        bounds.append(_bounds_of(change.carrier))
        groups.append(groups_of(start, change.per))
    sizes = [int(g.max()) + 1 for g in groups]
    delta = [np.zeros(n) for n in sizes]
    middle = [0.0 for _ in wanted]
    sigma = [0.3 for _ in wanted]
    precision = [np.full(n, 1e-6) for n in sizes]
    post: list[np.ndarray] = [np.ones(n) for n in sizes]
    raw: list[tuple[np.ndarray, np.ndarray]] = [(d, d) for d in delta]

    def model(deltas: Sequence[np.ndarray]) -> Sensor:
        given = dict(values)
        for change, base, d, (low, high) in zip(wanted, bases, deltas, bounds, strict=True):
            map_ = np.clip(base * np.exp(np.clip(d, -_MOST, _MOST)), low, high)
            given[change.carrier] = map_  # type: ignore[index]
        return with_values(bench.start, given)

    step = 0.02
    delta = _begun(lines, model, groups, delta, step)
    for turn in range(_TURNS):
        now = model(delta)
        other = [model([d + (step if j == i else 0) for j, d in enumerate(delta)]) for i in range(len(wanted))]
        k = len(wanted)
        pixels = start.layout.pixels
        normal = np.zeros((pixels, k, k))
        score = np.zeros((pixels, k))
        for line in lines:
            counts = line.seen.counts
            assert counts is not None
            expected = line.expected(now)
            scale = 1.0 if line.seen.capture.light.dark else counts.sum() / expected.sum()
            line.level *= min(max(scale, 0.5), 2.0)  # until it is the light of these maps, and no factor is needed
            slopes = np.stack([(line.expected(o) - expected) / step for o in other], axis=1) * scale
            expected = expected * scale
            variance = line.variance(np.maximum(expected, 0.5), bench.dead)
            normal += slopes[:, :, None] * slopes[:, None, :] / variance[:, None, None]
            score += slopes * ((counts - expected) / variance)[:, None]
        # one after the other where groups are not pixels; together where all are
        if all(c.per == "pixel" for c in wanted):
            prior = np.stack(precision, axis=1)
            whole = normal + np.eye(k) * prior[:, None, :]
            pull = score - prior * (np.stack(delta, axis=1) - np.array(middle))
            solved = np.linalg.solve(whole, pull[:, :, None])[:, :, 0]
            inverse = np.linalg.inv(whole)
            bare = normal + 1e-9 * np.eye(k)
            free = np.linalg.solve(bare, score[:, :, None])[:, :, 0]
            variance_free = np.linalg.inv(bare)
            for i in range(k):
                # without the prior, the other maps being free
                raw[i] = delta[i] + np.clip(free[:, i], -2, 2), variance_free[:, i, i]
                delta[i] = np.clip(delta[i] + np.clip(solved[:, i], -0.7, 0.7), -_MOST, _MOST)
                post[i] = inverse[:, i, i]
        else:
            for i, group in enumerate(groups):
                information = np.bincount(group, normal[:, i, i], sizes[i])
                gradient = np.bincount(group, score[:, i], sizes[i])
                move = (gradient - precision[i] * (delta[i] - middle[i])) / (information + precision[i])
                delta[i] = np.clip(delta[i] + np.clip(move, -0.7, 0.7), -_MOST, _MOST)
                post[i] = 1 / (information + precision[i])
                own = np.maximum(information, 1e-12)
                raw[i] = delta[i] + gradient / own, 1 / own
        for i in range(k):
            if turn < 2:
                continue
            # as wide as the pixels differ beyond their noise; robustly, for a few may be quite other
            weight = (_TAILS + 1) / (_TAILS + (delta[i] - middle[i]) ** 2 / sigma[i] ** 2)
            if bench_light_only(start, wanted[i]):
                delta[i] = delta[i] - math.log(float(np.mean(np.exp(delta[i]))))
            else:  # all together, which no pixel by itself may tell
                own = weight * np.bincount(groups[i], normal[:, i, i], sizes[i])
                left = weight * np.bincount(groups[i], score[:, i], sizes[i])
                shift = float(np.clip(left.sum() / max(float(own.sum()), 1e-12), -0.5, 0.5))
                delta[i] = delta[i] + shift
                middle[i] = float(np.average(delta[i], weights=weight))
            square = float(np.mean(weight * (delta[i] - _middle(delta[i])) ** 2 + post[i]))
            sigma[i] = min(max(math.sqrt(square), 1e-4), 3.0)
            own_raw, own_variance = raw[i]
            noise = float(np.median(own_variance))
            if noise < _TELLING**2:
                # of the bulk, beyond its noise: what creeps towards none would take long to arrive
                width = 1.4826 * _middle(np.abs(own_raw - _middle(own_raw)))
                sigma[i] = math.sqrt(max(width**2 - noise, _LEAST_WIDTH**2))
            apart = delta[i] - middle[i]
            odd = _odd(apart, sigma[i] ** 2 + post[i])
            if noise >= _TELLING**2:
                # by how much their counts scatter beyond chance: where each says little, so would its own best value
                told = np.maximum(np.bincount(groups[i], normal[:, i, i], sizes[i]), 1e-9)
                counted = told + np.bincount(groups[i], score[:, i], sizes[i])
                usual = told * np.exp(-apart)  # what the middle would have, lest what is seen weighs itself
                counted, usual = counted[~odd], usual[~odd]
                # about their mean, not the middle
                usual = np.maximum(usual * max(float(counted.sum()), 1e-9) / max(float(usual.sum()), 1e-9), 1e-9)
                square = max(float((usual**2).sum()), 1e-12)  # of one pixel that is odd nothing is left
                relative = float(((counted - usual) ** 2 - usual).sum()) / square  # of logarithms it is less
                sigma[i] = math.sqrt(max(math.log1p(max(relative, 0.0)), _LEAST_WIDTH**2))
            precision[i] = np.where(
                odd,
                _WIDE**-2,  # they are of another kind, about which the others say nothing
                (_TAILS + 1) / (_TAILS * sigma[i] ** 2 + apart**2),
            )
    out = others
    for i, change in enumerate(wanted):
        assert change.carrier is not None
        error = np.sqrt(np.maximum(post[i], 0))
        r, v = raw[i]
        scene = bench_light_only(start, change) and any(bench.of_scene(line.id) for line in lines)
        map_ = Map(change.carrier, bases[i], groups[i], delta[i], error, r, np.sqrt(v), sigma[i], *bounds[i])
        map_ = replace(map_, of_scene=scene)
        if not bench_light_only(start, change) and float(np.median(v)) >= _TELLING**2:

            def at(log: float, i: int = i) -> Sensor:
                return model([np.full(d.size, log) if j == i else d for j, d in enumerate(delta)])

            map_ = _of_few_counts(map_, lines, at)
        out[change.carrier] = map_
    return out


def _of_few_counts(map_: Map, lines: Sequence[Line], model: Callable[[float], Sensor]) -> Map:
    """A map of pixels that say little each: all together tell the law of their values, without a form for it.

    model: with this logarithm in all pixels.
    """
    centre, size = float(np.median(map_.estimate)), map_.estimate.size
    grid = centre + np.linspace(*_GRID)
    logs = np.stack(
        [
            np.bincount(map_.group, sum(line.log_likelihood(line.expected(sensor)) for line in lines), size)
            for sensor in map(model, grid.tolist())
        ],
        axis=1,
    )
    weights = _by_their_law(np.exp(logs - logs.max(axis=1, keepdims=True)))
    mean, error = _mean_of(weights, grid)
    told = map_.raw_error < _TELLING
    estimate, error = np.where(told, map_.estimate, mean), np.where(told, map_.error, error)
    return replace(map_, estimate=estimate, error=error, likely=(grid, weights))


def _by_their_law(likely: np.ndarray) -> np.ndarray:
    """(groups, grid) how probable each value is, by what each pixel says and by the law of all of them.

    That law is the nonparametric maximum of the likelihood, by expectation and maximization (Laird, JASA 73, 1978),
    stopped while it is smooth; the rest is Bayes's. likely: (groups, grid).
    """
    prior = np.full(likely.shape[1], 1 / likely.shape[1])
    for _ in range(_ROUNDS):
        weights = likely * prior
        weights /= weights.sum(axis=1, keepdims=True)
        prior = weights.mean(axis=0)
    return weights


def _mean_of(weights: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(mean, standard deviation) of each row of weights over a grid."""
    weights = weights / weights.sum(axis=1, keepdims=True)
    mean = weights @ grid
    return mean, np.sqrt(np.maximum(weights @ grid**2 - mean**2, 0.0))


def _odd(apart: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Which of some logarithms are none of the bulk's, which are normal with this variance about 0, but of any size."""
    usual = np.exp(-(apart**2) / (2 * variance)) / np.sqrt(2 * math.pi * variance)
    share = 0.01
    for _ in range(5):
        odd = share / (2 * _MOST) > (1 - share) * usual
        share = (float(odd.sum()) + 1) / (odd.size + 2)
    return np.asarray(odd)


def _begun(
    lines: Sequence[Line],
    model: Callable[[Sequence[np.ndarray]], Sensor],
    groups: Sequence[np.ndarray],
    none: Sequence[np.ndarray],
    step: float,
) -> list[np.ndarray]:
    """Where to begin: in the middle, but for odd pixels, not to be found from there; by the capture that tells most."""
    now, out = model(none), []
    for i, group in enumerate(groups):
        other = model([d + (step if j == i else 0) for j, d in enumerate(none)])
        most, best = 0.0, np.zeros(none[i].size)
        for line in lines:
            counts, expected = line.seen.counts, line.expected(now)
            assert counts is not None
            slope = (line.expected(other) - expected) / step
            told = float((slope**2 / line.variance(np.maximum(expected, 0.5), 0.0)).sum())
            if told > most and not line.saturated(counts):
                scale = 1.0 if line.seen.capture.light.dark else counts.sum() / expected.sum()
                measured = np.bincount(group, counts, none[i].size)
                usual = np.bincount(group, expected * scale, none[i].size)
                elasticity = max(float(slope.sum() / expected.sum()), 0.3)
                logs = np.clip(np.log((measured + 0.5) / (usual + 0.5)) / elasticity, -_MOST / 2, _MOST / 2)
                odd = np.abs(measured - usual) > _ODD * np.sqrt(line.variance(usual, 0.0) + 1)
                most, best = told, np.where(odd, logs, 0.0)
        out.append(best)
    return out


def _middle(x: np.ndarray) -> float:
    return float(np.median(x))


def bench_light_only(sensor: Sensor, change: Change) -> bool:
    """Does the parameter act on the light alone? Then its mean is the light level's matter."""
    kind = Effect.registry.find(change.effect)
    return getattr(kind, "stage", "") in ("light", "detection")


def expected(bench: Bench, id: str, state: Any, values: Mapping[Key, Any]) -> np.ndarray:
    """(pixels,) detections that a model with these values changed expects in a capture.

    Of first stamps in the time that each pixel waited, so that there, too, the light is what they are in proportion to.
    """
    return Line(bench, id, state.rates[id].level).expected(with_values(state.sensors.usual(id), values))


def levels_of(bench: Bench, state: Any) -> dict[str, float]:
    """The level (dark: 1, the rates as they are) of each capture."""
    return {id: 1.0 if s.capture.light.dark else state.rates[id].level for id, s in bench.seen.items()}


def settle_codes(bench: Bench, change: Change, use: Sequence[str] = ()) -> Map:
    """Lengths of a converter's codes from how often each occurs, in the captures in `use` (all).

    Their period is the one in which they differ most clearly. Raises SpadError where no capture has codes.
    """
    folded: dict[int, np.ndarray] = {}
    for id, seen in bench.seen.items():
        summary = seen.summaries.get(CODES)
        if summary is None or (use and id not in use):
            continue
        for period, part in code_periods(len(summary.values)).items():
            folded[period] = folded.get(period, 0.0) + summary.values[part]
    assert change.carrier is not None
    found: Map | None = None
    least = 2.0
    for period, counts in folded.items():
        mean = max(float(counts.mean()), 1.0)
        p = float(stats.chi2.sf(float(((counts - mean) ** 2).sum()) / mean, period - 1))
        if p >= least:
            continue
        least, raw, noise = p, np.maximum(counts, 0.5) / mean - 1, 1 / mean
        sigma = math.sqrt(max(float(np.mean(raw**2)) - noise, 1e-8))
        share = sigma**2 / (sigma**2 + noise)
        logs = np.log(np.maximum(1 + raw * share, 1e-3))
        error = np.full(period, math.sqrt(noise * share))
        spread = np.full(period, math.sqrt(noise))
        found = Map(change.carrier, 1.0, np.arange(period), logs, error, np.log1p(raw), spread, sigma)
    if found is None:
        raise SpadError("no capture has stamps with codes")
    return found


def settle_edges(bench: Bench, values: Values, change: Change, use: Sequence[str] = ()) -> Map:
    """How long each pixel is blind, from its shortest intervals in the captures in `use` (all).

    Raises SpadError where no capture tells, and where the model blurs the edges in another way than a normal law's.
    """
    assert change.carrier is not None
    start = with_values(bench.start, {k: v for k, v in values.items() if k != change.carrier})
    base = _base_of(start, change)
    captures = [s.shortest for id, s in bench.seen.items() if s.shortest is not None and (not use or id in use)]
    blur = blur_of(start)
    if blur is None or any(hasattr(e, "sensitivity") for e in start.at("dead_time")):
        raise SpadError("how long each pixel is blind is not told where stamps or the recovery blur it by other laws")
    found = edges.likely(captures, blur, base) if captures and base > 0 else None
    if found is None:
        raise SpadError("no capture has intervals short enough to tell how long each pixel is blind")
    grid, says = found
    width = edges.width_of(grid, says)
    weights = says * width.prior.astype(np.float32)
    weights /= weights.sum(axis=1, keepdims=True)
    estimate, error = _mean_of(weights, grid)
    raw, raw_error = _mean_of(says, grid)
    low, high = _bounds_of(change.carrier)
    map_ = Map(change.carrier, base, groups_of(start, change.per), estimate, error, raw, raw_error, width.sigma)
    return replace(map_, low=low, high=high, likely=(grid, weights), certain=0.0, width=width)


def by_counts(change: Change) -> bool:
    """Is it how many detections pixels have that tells a map?"""
    return change.per != "code" and not change.blinds


def code_periods(cells: int) -> dict[int, slice]:
    """Where the statistic `codes` has the codes of each period."""
    out: dict[int, slice] = {}
    start = 0
    for period in _PERIODS:
        if start + period <= cells:
            out[period] = slice(start, start + period)
            start += period
    return out


def information(bench: Bench, values: Values, change: Change, levels: dict[str, float]) -> dict[str, np.ndarray]:
    """(pixels,) how much each capture tells of a map: squared slopes over variances."""
    if change.per == "code":
        return {id: np.array([seen.total * (CODES in seen.summaries)]) for id, seen in bench.seen.items()}
    assert change.carrier is not None
    pixels = bench.start.layout.pixels
    if change.blinds:
        base = _base_of(with_values(bench.start, {k: v for k, v in values.items() if k != change.carrier}), change)
        told = {id: seen.shortest for id, seen in bench.seen.items()}
        return {
            id: np.zeros(pixels) if s is None else np.where(s.tells(base), base * s.density, 0.0) ** 2
            for id, s in told.items()
        }
    effect = with_values(bench.start, values).effect(change.carrier[0])
    if effect is None:
        now = np.full(int(groups_of(bench.start, change.per).max()) + 1, _base_of(bench.start, change))
    else:
        now = np.asarray(getattr(effect, change.carrier[1]), np.float64)
        if change.per == "pixel":
            now = np.broadcast_to(now, (pixels,))
    start = with_values(bench.start, {**values, change.carrier: now})
    other = with_values(bench.start, {**values, change.carrier: now * 1.02})
    out = {}
    for id, seen in bench.seen.items():
        if seen.counts is None:
            out[id] = np.zeros(pixels)
            continue
        line = Line(bench, id, levels[id])
        a, b = line.expected(start), line.expected(other)
        slope = (b - a) / 0.02
        out[id] = slope**2 / line.variance(np.maximum(a, 0.5), bench.dead)
    return out


def alone(bench: Bench, values: Values, wanted: Sequence[Change], levels: dict[str, float]) -> set[str]:
    """Captures without which one of the maps is hardly told."""
    needed = [information(bench, values, change, levels) for change in wanted]
    shares = [{id: one / np.maximum(sum(told.values()), 1e-12) for id, one in told.items()} for told in needed]
    return {id for id in bench.seen if any(float(np.mean(share[id])) > _ALONE for share in shares)}


def sensors_with(
    bench: Bench, values: Values, wanted: Sequence[Change], levels: dict[str, float], unseen: bool = True
) -> tuple[Sensors, dict[Key, Map], dict[Key, Any]]:
    """(a model for each capture, its maps fitted without it; the maps fitted to all; the values with these maps).

    Where one capture alone shows a parameter, it is used all the same. Every recording has one of the maps that may
    be true.
    """
    whole = settle_maps(bench, values, wanted, levels)
    final = {**values, **{key: m.values() for key, m in whole.items()}}
    needed = alone(bench, final, wanted, levels)
    maps: dict[str, dict[Key, Map]] = {}
    for id, seen in bench.seen.items():
        if seen.counts is None or id in needed or not unseen or len(bench.seen) < 2:
            maps[id] = whole
        else:
            others = [i for i in bench.seen if i != id]
            try:
                maps[id] = settle_maps(bench, values, wanted, levels, others)
            except SpadError:  # the others tell nothing of one of the maps
                maps[id] = whole

    def of(id: str, number: int) -> Sensor:
        rng = np.random.Generator(np.random.Philox(key=[bench.seed + 7, number]))
        drawn = {}
        for key, m in maps[id].items():
            drawn[key] = m.values(rng.standard_normal(len(m.estimate)), float(rng.standard_normal()))
        return with_values(bench.start, {**values, **drawn})

    def typical(id: str) -> Sensor:
        return with_values(bench.start, {**values, **{key: m.values() for key, m in maps[id].items()}})

    return Sensors(of, with_values(bench.start, final), alike=False, typical=typical), whole, final


def needed(
    bench: Bench, values: Values, held: Sequence[Change], wanted: Sequence[Change], levels: dict[str, float]
) -> list[Change]:
    """Those of some maps whose pixels differ beyond their noise when all are settled together, the clearest first."""
    kept = list(wanted)
    while kept:
        found = settle_maps(bench, values, [*held, *kept], levels)
        clear = {c: _spread_p(found[c.carrier]) for c in kept}  # type: ignore[index]
        least = max(kept, key=lambda c: clear[c])
        if clear[least] < _NEEDED:
            return sorted(kept, key=lambda c: clear[c])
        kept.remove(least)
    return []


def _spread_p(map_: Map) -> float:
    """p-value of pixels that are all alike."""
    told = map_.raw_error < NOTHING
    if told.sum() < 3 or float(np.std(map_.estimate)) < _LEAST_WIDTH:  # all at a bound: they do not differ
        return 1.0
    r, weight = map_.raw[told], 1 / map_.raw_error[told] ** 2
    z = (r - float(np.average(r, weights=weight))) ** 2 * weight
    return float(stats.chi2.sf(float(z.sum()), int(told.sum()) - 1))


def odd(map_: Map) -> tuple[np.ndarray, np.ndarray]:
    """(groups,) bool: which are far below all others, and which far above."""
    inner = map_.estimate - _middle(map_.estimate)
    # of the bulk: beyond its noise, without the odd pixels
    raw = map_.raw[map_.told]
    width = 1.4826 * float(np.median(np.abs(raw - np.median(raw)))) if raw.size else 0.0
    noise = float(np.median(map_.raw_error[map_.told])) if raw.size else NOTHING
    bulk = math.sqrt(max(width**2 - noise**2, 0.0))
    beyond = np.maximum(4 * np.sqrt(bulk**2 + map_.raw_error**2), 0.15)
    return inner < -beyond, inner > beyond


def low_ratio(map_: Map) -> tuple[float, float]:
    """(mean of the values that are far below all others, relative to the middle; its standard deviation); 1, inf
    without any."""
    low, _ = odd(map_)
    if not low.any():
        return 1.0, math.inf
    # by themselves, as far as they tell: what keeps noise out pulls them to the others
    told = map_.raw_error < _TELLING
    logs = np.where(told, map_.raw, map_.estimate)[low] - _middle(map_.estimate)
    own = float(np.mean(np.where(told, map_.raw_error, map_.error)[low] ** 2))
    apart = float(np.var(logs, ddof=1)) if low.sum() > 1 else 0.0
    mean = float(np.exp(logs).mean())
    return mean, mean * math.sqrt(max(own, apart) / int(low.sum()))


def summary(map_: Map) -> dict[str, float]:
    """sigma, low_fraction, low_ratio, high_fraction of a map."""
    low, high = odd(map_)
    rest = ~(low | high) & map_.told
    spread = np.var(map_.raw[rest]) - np.mean(map_.raw_error[rest] ** 2) if rest.sum() > 3 else 0.0
    return {
        "sigma": math.sqrt(max(float(spread), 0.0)),
        "low_fraction": float(low.mean()),
        "low_ratio": low_ratio(map_)[0],
        "high_fraction": float(high.mean()),
    }


def patterned(map_: Map, designs: dict[str, np.ndarray]) -> dict[str, tuple[float, float]]:
    """(p-value of each pattern in a map of pixels, against the scatter of what it leaves (F test); what it leaves, and
    what its numbers cost, by which patterns compare that are all beyond doubt (Schwarz, Ann. Statist. 6, 1978)).

    designs: (pixels, k) columns, without the mean.
    """
    y = np.exp(np.clip(map_.raw[map_.told], -_MOST, _MOST))
    if y.size < 3:
        return dict.fromkeys(designs, (1.0, 0.0))
    middle, width = _middle(y), 1.4826 * _middle(np.abs(y - _middle(y)))
    y = np.clip(y, middle - _FAR_OFF * width, middle + _FAR_OFF * width)  # odd pixels do not make a pattern
    out = {}
    ones = np.ones((len(y), 1))
    for name, design in designs.items():
        design = design[map_.told]
        full = np.linalg.lstsq(np.hstack([ones, design]), y, rcond=None)[0]
        left = y - np.hstack([ones, design]) @ full
        k = np.linalg.matrix_rank(np.hstack([ones, design])) - 1
        free = max(len(y) - k - 1, 1)
        explained = float(((y - y.mean()) ** 2).sum() - (left**2).sum())
        square = max(float((left**2).sum()), 1e-30)
        p = float(stats.f.sf(explained / max(k, 1) / (square / free), k, free))
        out[name] = p, len(y) * math.log(square) + k * math.log(len(y))
    return out


def explained(before: np.ndarray, after: np.ndarray, told: np.ndarray, sigma: float, numbers: int) -> float:
    """p-value of what so many numbers take from the pixels' residuals, against the scatter that they leave (F test).

    Of pixels that differ by themselves, by `sigma` of a logarithm, the same in all captures: residuals are first
    brought to where these scatter as chance does. before, after: (captures, pixels) residuals; told: of that shape, the
    squared slope of a residual on the logarithm of its pixel's value.
    """
    z, left = (_beside_pixels(x, np.sqrt(told), sigma).ravel() for x in (before, after))
    free = z.size - numbers
    if free < 1:
        return 1.0
    middle = _middle(z)
    far = _FAR_OFF * max(1.4826 * _middle(np.abs(z - middle)), 1.0)
    z, left = (np.clip(x, middle - far, middle + far) for x in (z, left))  # as of odd pixels in `patterned`
    square = max(float(left @ left), 1e-30)
    return float(stats.f.sf((float(z @ z) - square) / numbers / (square / free), numbers, free))


def _beside_pixels(z: np.ndarray, slopes: np.ndarray, sigma: float) -> np.ndarray:
    """(captures, pixels) residuals, 1 wide and independent where each pixel differs by `sigma`, times its slopes."""
    square = (slopes**2).sum(axis=0)
    along = (slopes * z).sum(axis=0) / np.maximum(square, 1e-300)
    return np.asarray(z - slopes * along * (1 - 1 / np.sqrt(1 + sigma**2 * square)))
