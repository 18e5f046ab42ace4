"""Fits of maps: the value of a parameter in each pixel, by empirical Bayes, from the counts of every capture.

The closed forms of the effects give the rate of a pixel as a function of the parameter. Maps of several parameters
are fitted together, pixel by pixel, by Newton's method on logarithms relative to the array. The width of the prior is
that of the pixels' differences. It has long tails, so that odd pixels stay odd; its middle is the value of most
pixels. Dead times are fitted from the shortest intervals (`blind_times`), widths of codes from their frequencies.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import stats

from ..effects import Effect
from ..errors import SpadError
from ..sensor import Sensor
from . import blind_times
from .candidates import Candidate, with_values
from .coordinates import Key, Values
from .light_levels import in_frames
from .pixel_maps import (
    ALONE,
    CODES,
    GRID,
    LEAST_WIDTH,
    MOST,
    ODD,
    ROUNDS,
    TAILS,
    TELLING,
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
    spread_p,
)
from .point_process import blur_of
from .replicates import InTheDark, Model, Replicates

_NEEDED = 1e-4  # p-value of a map that is needed in addition to others


class CountModel:
    """The expected detections of each pixel in one capture, for maps.

    Of first stamps, they are those in the time that the pixel waited.
    """

    def __init__(self, replicates: Replicates, id: str, level: float):
        self.seen, self.id, self.level = replicates.seen[id], id, level
        self.conditions = self.seen.capture.conditions
        self.waited = self.seen.waited
        self.frames = not self.seen.capture.counts_events and self.waited is None

    def expected(self, sensor: Sensor) -> np.ndarray:
        """The expected detections of each pixel, (pixels,)."""
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
        """The log-likelihood of the measured counts, (pixels,), up to a constant.

        Args:
            expected: (pixels,) detections.
        """
        counts = self.seen.counts
        assert counts is not None
        if not self.frames:
            return np.asarray(counts * np.log(expected) - expected)
        share = np.clip(expected / self.conditions.frames, 1e-12, 1 - 1e-9)
        return np.asarray(counts * np.log(share) + (self.conditions.frames - counts) * np.log1p(-share))

    def saturated(self, counts: np.ndarray) -> bool:
        """Whether half of the pixels have a detection in nearly every frame.

        Args:
            counts: (pixels,) detections.
        """
        return self.frames and float(np.median(counts)) > 0.9 * self.conditions.frames

    def variance(self, n: np.ndarray, dead: float) -> np.ndarray:
        """The variance of the counts, (pixels,).

        Args:
            n: (pixels,) expected detections.
            dead: dead time, s.
        """
        if self.waited is not None:
            return np.maximum(n, 0.25)
        if self.frames:
            return np.maximum(n * (1 - np.minimum(n / self.conditions.frames, 1 - 1e-4)), 0.25)
        return np.maximum(n * (1 - np.minimum(n * dead / self.conditions.exposure, 0.99)) ** 2, 0.25)


def _base_of(sensor: Sensor, candidate: Candidate) -> float:
    """The value that a map is relative to: the array's own mean, or `off` of an effect that the sensor lacks."""
    assert candidate.carrier is not None
    effect = sensor.effect(candidate.carrier[0])
    if effect is not None:
        return float(np.mean(np.asarray(getattr(effect, candidate.carrier[1]), float)))
    off = Effect.registry.find(candidate.carrier[0]).parameters[candidate.carrier[1]].off
    return float(off if off is not None else 1.0)


def _bounds_of(carrier: Key) -> tuple[float, float]:
    low, high = Effect.registry.find(carrier[0]).parameters[carrier[1]].bounds
    return 0.0 if low is None else low, math.inf if high is None else high


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
    others = {c.carrier: fit_codes(replicates, c, use) for c in wanted if c.per == "code" and c.carrier is not None}
    others |= {
        c.carrier: fit_blind_times(replicates, values, c, use) for c in wanted if c.blinds and c.carrier is not None
    }
    wanted = [c for c in wanted if by_counts(c)]
    if not wanted:
        return others
    start = with_values(replicates.start, {k: v for k, v in values.items() if k not in {c.carrier for c in wanted}})
    lines = [
        CountModel(replicates, id, levels[id])
        for id, s in replicates.seen.items()
        if s.counts is not None and (not use or id in use)
    ]
    bases, groups, bounds = [], [], []
    for candidate in wanted:
        assert candidate.carrier is not None
        declared = Effect.registry.find(candidate.carrier[0]).parameters[candidate.carrier[1]]
        base = _base_of(start, candidate)
        bases.append(base if base > 0 else float((declared.scan or (1e-3, 1))[0]))
        bounds.append(_bounds_of(candidate.carrier))
        groups.append(groups_of(start, candidate.per))
    sizes = [int(g.max()) + 1 for g in groups]
    delta = [np.zeros(n) for n in sizes]
    middle = [0.0 for _ in wanted]
    sigma = [0.3 for _ in wanted]
    precision = [np.full(n, 1e-6) for n in sizes]
    post: list[np.ndarray] = [np.ones(n) for n in sizes]
    raw: list[tuple[np.ndarray, np.ndarray]] = [(d, d) for d in delta]

    def model(deltas: Sequence[np.ndarray]) -> Sensor:
        given = dict(values)
        for candidate, base, d, (low, high) in zip(wanted, bases, deltas, bounds, strict=True):
            map_ = np.clip(base * np.exp(np.clip(d, -MOST, MOST)), low, high)
            given[candidate.carrier] = map_  # type: ignore[index]
        return with_values(replicates.start, given)

    step = 0.02
    delta = _begun(lines, model, groups, delta, step)
    for turn in range(TURNS):
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
            line.level *= min(max(scale, 0.5), 2.0)  # until the level is that of these maps and no factor is needed
            jacobian = np.stack([(line.expected(o) - expected) / step for o in other], axis=1) * scale
            expected = expected * scale
            variance = line.variance(np.maximum(expected, 0.5), replicates.dead)
            normal += jacobian[:, :, None] * jacobian[:, None, :] / variance[:, None, None]
            score += jacobian * ((counts - expected) / variance)[:, None]
        # one map after the other where some groups are no pixels; together where all are
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
                # without the prior; the other maps are free
                raw[i] = delta[i] + np.clip(free[:, i], -2, 2), variance_free[:, i, i]
                delta[i] = np.clip(delta[i] + np.clip(solved[:, i], -0.7, 0.7), -MOST, MOST)
                post[i] = inverse[:, i, i]
        else:
            for i, group in enumerate(groups):
                information = np.bincount(group, normal[:, i, i], sizes[i])
                gradient = np.bincount(group, score[:, i], sizes[i])
                move = (gradient - precision[i] * (delta[i] - middle[i])) / (information + precision[i])
                delta[i] = np.clip(delta[i] + np.clip(move, -0.7, 0.7), -MOST, MOST)
                post[i] = 1 / (information + precision[i])
                own = np.maximum(information, 1e-12)
                raw[i] = delta[i] + gradient / own, 1 / own
        for i in range(k):
            if turn < 2:
                continue
            # the width of the pixels' differences beyond their noise, robust against odd pixels
            weight = (TAILS + 1) / (TAILS + (delta[i] - middle[i]) ** 2 / sigma[i] ** 2)
            if acts_on_light(start, wanted[i]):
                delta[i] = delta[i] - math.log(float(np.mean(np.exp(delta[i]))))
            else:  # the mean of all pixels, which no pixel by itself may inform
                own = weight * np.bincount(groups[i], normal[:, i, i], sizes[i])
                left = weight * np.bincount(groups[i], score[:, i], sizes[i])
                shift = float(np.clip(left.sum() / max(float(own.sum()), 1e-12), -0.5, 0.5))
                delta[i] = delta[i] + shift
                middle[i] = float(np.average(delta[i], weights=weight))
            square = float(np.mean(weight * (delta[i] - median_of(delta[i])) ** 2 + post[i]))
            sigma[i] = min(max(math.sqrt(square), 1e-4), 3.0)
            own_raw, own_variance = raw[i]
            noise = float(np.median(own_variance))
            if noise < TELLING**2:
                # of most pixels, beyond their noise; an iteration towards a width of 0 would be slow
                width = 1.4826 * median_of(np.abs(own_raw - median_of(own_raw)))
                sigma[i] = math.sqrt(max(width**2 - noise, LEAST_WIDTH**2))
            apart = delta[i] - middle[i]
            odd = outside_bulk(apart, sigma[i] ** 2 + post[i])
            if noise >= TELLING**2:
                # the scatter of the counts beyond noise, by moments: the estimates of poorly informed pixels say
                # little
                fitted = np.maximum(np.bincount(groups[i], normal[:, i, i], sizes[i]), 1e-9)
                counted = fitted + np.bincount(groups[i], score[:, i], sizes[i])
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
                sigma[i] = math.sqrt(max(math.log1p(max(relative, 0.0)), LEAST_WIDTH**2))
            precision[i] = np.where(
                odd,
                WIDE**-2,  # odd pixels are of another kind, on which the prior holds no information
                (TAILS + 1) / (TAILS * sigma[i] ** 2 + apart**2),
            )
    out = others
    for i, candidate in enumerate(wanted):
        assert candidate.carrier is not None
        error = np.sqrt(np.maximum(post[i], 0))
        r, v = raw[i]
        map_ = PixelMap(candidate.carrier, bases[i], groups[i], delta[i], error, r, np.sqrt(v), sigma[i], *bounds[i])
        scene = acts_on_light(start, candidate) and any(replicates.of_scene(line.id) for line in lines)
        map_ = replace(map_, of_scene=scene)
        if not acts_on_light(start, candidate) and float(np.median(v)) >= TELLING**2:

            def at(log: float, i: int = i) -> Sensor:
                return model([np.full(d.size, log) if j == i else d for j, d in enumerate(delta)])

            map_ = _of_few_counts(map_, lines, at)
        out[candidate.carrier] = map_
    return out


def _of_few_counts(map_: PixelMap, lines: Sequence[CountModel], model: Callable[[float], Sensor]) -> PixelMap:
    """The map of pixels with few counts, with a nonparametric prior that all of them inform together.

    Args:
        lines: the count model of each capture.
        model: log value of all pixels -> sensor.
    """
    centre, size = float(np.median(map_.estimate)), map_.estimate.size
    grid = centre + np.linspace(*GRID)
    logs = np.stack(
        [
            np.bincount(map_.group, sum(line.log_likelihood(line.expected(sensor)) for line in lines), size)
            for sensor in map(model, grid.tolist())
        ],
        axis=1,
    )
    weights = _by_their_law(np.exp(logs - logs.max(axis=1, keepdims=True)))
    mean, error = mean_of(weights, grid)
    informed = map_.raw_error < TELLING
    estimate, error = np.where(informed, map_.estimate, mean), np.where(informed, map_.error, error)
    return replace(map_, estimate=estimate, error=error, likely=(grid, weights))


def _by_their_law(likely: np.ndarray) -> np.ndarray:
    """(groups, grid) posterior weights of each value under the common law of all pixels.

    The law is the nonparametric maximum-likelihood estimate by expectation and maximization (Laird, JASA 73, 1978),
    stopped while it is smooth.

    Args:
        likely: (groups, grid) likelihoods.
    """
    prior = np.full(likely.shape[1], 1 / likely.shape[1])
    for _ in range(ROUNDS):
        weights = likely * prior
        weights /= weights.sum(axis=1, keepdims=True)
        prior = weights.mean(axis=0)
    return weights


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
            slope = (line.expected(other) - expected) / step
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


def expected_counts(replicates: Replicates, id: str, evaluation: Any, values: Mapping[Key, Any]) -> np.ndarray:
    """The expected counts of each pixel in a capture with some values changed, (pixels,).

    Of first stamps, in the time that each pixel waited: so they are proportional to the light, too.

    Args:
        values: by (effect, parameter), SI.
    """
    return CountModel(replicates, id, evaluation.rates[id].level).expected(
        with_values(evaluation.sensors.usual(id), values)
    )


def light_levels_of(replicates: Replicates, evaluation: Any) -> dict[str, float]:
    """The level of each capture; in the dark 1, for the rates as they are."""
    return {id: 1.0 if s.capture.light.dark else evaluation.rates[id].level for id, s in replicates.seen.items()}


def fit_codes(replicates: Replicates, candidate: Candidate, use: Sequence[str] = ()) -> PixelMap:
    """The map of a converter's code widths from the frequency of each code.

    Its period is that with the smallest p-value.

    Args:
        use: the captures that are used; all where it is empty.
    Raises:
        SpadError: where no capture has codes.
    """
    folded: dict[int, np.ndarray] = {}
    for id, seen in replicates.seen.items():
        summary = seen.summaries.get(CODES)
        if summary is None or (use and id not in use):
            continue
        for period, part in code_periods(len(summary.values)).items():
            folded[period] = folded.get(period, 0.0) + summary.values[part]
    assert candidate.carrier is not None
    found: PixelMap | None = None
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
        found = PixelMap(candidate.carrier, 1.0, np.arange(period), logs, error, np.log1p(raw), spread, sigma)
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
    base = _base_of(start, candidate)
    captures = [s.shortest for id, s in replicates.seen.items() if s.shortest is not None and (not use or id in use)]
    blur = blur_of(start)
    if blur is None or any(hasattr(e, "sensitivity") for e in start.at("dead_time")):
        raise SpadError("how long each pixel is blind is not told where stamps or the recovery blur it by other laws")
    found = blind_times.likelihoods(captures, blur, base) if captures and base > 0 else None
    if found is None:
        raise SpadError("no capture has intervals short enough to tell how long each pixel is blind")
    grid, likely = found
    width = blind_times.width_of(grid, likely)
    weights = likely * width.prior.astype(np.float32)
    weights /= weights.sum(axis=1, keepdims=True)
    estimate, error = mean_of(weights, grid)
    raw, raw_error = mean_of(likely, grid)
    low, high = _bounds_of(candidate.carrier)
    map_ = PixelMap(
        candidate.carrier, base, groups_of(start, candidate.per), estimate, error, raw, raw_error, width.sigma
    )
    return replace(map_, low=low, high=high, likely=(grid, weights), certain=0.0, width=width)


def information(
    replicates: Replicates, values: Values, candidate: Candidate, levels: dict[str, float]
) -> dict[str, np.ndarray]:
    """The information of each capture on a map: squared derivatives over variances, (pixels,) or (1,), by capture.

    Args:
        values: the values of the model, SI.
        levels: light level by capture.
    """
    if candidate.per == "code":
        return {id: np.array([seen.total * (CODES in seen.summaries)]) for id, seen in replicates.seen.items()}
    assert candidate.carrier is not None
    pixels = replicates.start.layout.pixels
    if candidate.blinds:
        base = _base_of(
            with_values(replicates.start, {k: v for k, v in values.items() if k != candidate.carrier}), candidate
        )
        shortest = {id: seen.shortest for id, seen in replicates.seen.items()}
        return {
            id: np.zeros(pixels) if s is None else np.where(s.tells(base), base * s.density, 0.0) ** 2
            for id, s in shortest.items()
        }
    effect = with_values(replicates.start, values).effect(candidate.carrier[0])
    if effect is None:
        now = np.full(int(groups_of(replicates.start, candidate.per).max()) + 1, _base_of(replicates.start, candidate))
    else:
        now = np.asarray(getattr(effect, candidate.carrier[1]), np.float64)
        if candidate.per == "pixel":
            now = np.broadcast_to(now, (pixels,))
    start = with_values(replicates.start, {**values, candidate.carrier: now})
    other = with_values(replicates.start, {**values, candidate.carrier: now * 1.02})
    out = {}
    for id, seen in replicates.seen.items():
        if seen.counts is None:
            out[id] = np.zeros(pixels)
            continue
        line = CountModel(replicates, id, levels[id])
        a, b = line.expected(start), line.expected(other)
        slope = (b - a) / 0.02
        out[id] = slope**2 / line.variance(np.maximum(a, 0.5), replicates.dead)
    return out


def captures_needed(
    replicates: Replicates, values: Values, wanted: Sequence[Candidate], levels: dict[str, float]
) -> set[str]:
    """The captures without which one of the maps is hardly informed.

    Args:
        wanted: candidates with a carrier.
        levels: light level by capture.
    """
    needed = [information(replicates, values, candidate, levels) for candidate in wanted]
    shares = [
        {id: one / np.maximum(sum(by_capture.values()), 1e-12) for id, one in by_capture.items()}
        for by_capture in needed
    ]
    return {id for id in replicates.seen if any(float(np.mean(share[id])) > ALONE for share in shares)}


def models_with_maps(
    replicates: Replicates, values: Values, wanted: Sequence[Candidate], levels: dict[str, float], unseen: bool = True
) -> tuple[Model, dict[Key, PixelMap], dict[Key, Any]]:
    """(model with maps, the maps fitted to all captures, the values with these maps).

    The model of each capture has maps that are fitted without it; where it alone informs a parameter, it is used all
    the same. Every replicate has a draw of the posterior of the maps.

    Args:
        wanted: candidates with a carrier.
        levels: light level by capture.
        unseen: each capture is left out; otherwise all have the same maps.
    """
    whole = fit_maps(replicates, values, wanted, levels)
    final = {**values, **{key: m.values() for key, m in whole.items()}}
    needed = captures_needed(replicates, final, wanted, levels)
    maps: dict[str, dict[Key, PixelMap]] = {}
    for id, seen in replicates.seen.items():
        if seen.counts is None or id in needed or not unseen or len(replicates.seen) < 2:
            maps[id] = whole
        else:
            others = [i for i in replicates.seen if i != id]
            try:
                maps[id] = fit_maps(replicates, values, wanted, levels, others)
            except SpadError:  # the other captures do not inform one of the maps
                maps[id] = whole

    def of(id: str, number: int) -> Sensor:
        rng = np.random.Generator(np.random.Philox(key=[replicates.seed + 7, number]))
        drawn = {}
        for key, m in maps[id].items():
            drawn[key] = m.values(rng.standard_normal(len(m.estimate)), float(rng.standard_normal()))
        return with_values(replicates.start, {**values, **drawn})

    def typical(id: str) -> Sensor:
        return with_values(replicates.start, {**values, **{key: m.values() for key, m in maps[id].items()}})

    return Model(of, with_values(replicates.start, final), alike=False, typical=typical), whole, final


def maps_needed(
    replicates: Replicates,
    values: Values,
    held: Sequence[Candidate],
    wanted: Sequence[Candidate],
    levels: dict[str, float],
) -> list[Candidate]:
    """The maps whose pixels differ beyond their noise when all are fitted together, by p-value.

    Args:
        held: maps that the model has already.
        wanted: maps to test.
        levels: light level by capture.
    """
    kept = list(wanted)
    while kept:
        found = fit_maps(replicates, values, [*held, *kept], levels)
        clear = {c: spread_p(found[c.carrier]) for c in kept}  # type: ignore[index]
        least = max(kept, key=lambda c: clear[c])
        if clear[least] < _NEEDED:
            return sorted(kept, key=lambda c: clear[c])
        kept.remove(least)
    return []
