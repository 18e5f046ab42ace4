"""Likelihood: numbers settled by the probability of the data themselves, where it has a closed form.

- Time stamps (TR): a pixel is a point process. After a detection it is blind for the dead time; then its hazard is its
  rate and, of every kind of trap, what earlier detections left there: of the last detection exactly, of those before it
  to first order in the probability. The edge at the end of the dead time is as wide as a tick and the jitter make it.
- Bits (QIS) of frames that stand alone: binomial in every pixel.

Where the numbers in question change no rate, each pixel of each capture has a rate of its own, which is maximised; so
no map has to be known. Otherwise rates follow from the model, and the light's level has the uncertainty that the
measurement states. Intervals are profiles: twice the log-likelihood falls by so much, all else maximised again.
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import kernels, twin
from ..effects import Effect
from ..effects._traps import Traps
from ..events import Events
from ..recording import Capture, Recording
from ..sensor import Sensor
from ..streams import Draws
from . import recordings
from .candidates import Change, Dial, Key, templates, with_values
from .maxima import climbed, profile, topped

FALL = 3.84  # of twice the log-likelihood, at the ends of an interval of 95 %
EDGE_FALL = 5.99  # of an edge that is sharper than intervals are dense: an exponential law, not a normal one
_DENSE = 4.0  # intervals within the width of an edge, from which on it is a matter of the normal law
_LEAST = 1e-9  # of the chance that an interval ends before the dead time does: a wrong stamp is not impossible
_PROBES = 4096
_LONG = 20.0  # lifetimes after which a trap is empty
_FOLLOWS, _LAST = 1, 2  # kinds of gaps: after another that may be short; to the end of the exposure
_FAR = 100.0  # of the log-likelihood, by which a start is below the top: it is none
_HIGHER = 0.05  # of the log-likelihood, by which what was seen elsewhere says that a top is none
_ROUGH = 0.3, 0.5  # for `climbed`: near enough for a parabola
_SHARP = 0.1  # of a lifetime: stamps must be so exact


@dataclass(frozen=True)
class Exact:
    """Numbers that maximise the likelihood, with intervals of 95 %; gains: of twice its logarithm, of each change.

    correlations: (n, n) of the numbers `free`, by the curvature of the likelihood at its maximum.
    """

    values: dict[Key, float]
    intervals: dict[Key, tuple[float, float]]
    gains: list[float]
    free: tuple[Key, ...]
    correlations: np.ndarray


# --- what has a likelihood ---------------------------------------------------------------------------------------


def unknown(sensor: Sensor, capture: Capture) -> str:
    """What of a sensor the likelihood of a capture does not know, in a word; "" where it knows all that matters."""
    if capture.mean is not None or capture.modality not in ("tr", "qis"):
        return f"{capture.modality} of {capture.id}" if capture.mean is None else f"the mean of {capture.id}"
    stamped = capture.modality == "tr"
    conditions = capture.conditions
    for effect in sensor.effects:
        known = {
            "light": True,
            "detection": True,
            "dark": True,
            "arrival": False,
            "gate": not stamped and conditions.frame_time == conditions.frame_period,
            "correlated": stamped and sensor.rules == "device" and getattr(type(effect), "spawn", None) is Traps.spawn,
            "dead_time": not (hasattr(effect, "sensitivity") or getattr(effect, "extends", False))
            if stamped
            else not (hasattr(effect, "carried") and effect.carried() > 0),
            "timing": True,
            "readout": not hasattr(effect, "apply"),
        }[effect.stage]
        if not (known or _idle(effect)):
            return effect.name
    if not stamped:
        return ""
    blur = blur_of(sensor)
    if blur is None:
        return "the stamps"
    width = math.hypot(sensor.tick / math.sqrt(6), blur)
    traps = [e for e in sensor.at("correlated") if isinstance(e, Traps)]
    return next((e.name for e in traps if width > _SHARP * float(e.lifetime)), "")


def _idle(effect: Effect) -> bool:
    """Is it listed, but at the value at which it does nothing?"""
    offs = [np.all(np.asarray(getattr(effect, n)) == p.off) for n, p in effect.parameters.items() if p.off is not None]
    return bool(offs) and all(offs)


def blur_of(sensor: Sensor) -> float | None:
    """s, by which jitter widens an interval (1 sigma): found by stamping a few events. None: it is not normal."""
    sensor = sensor.chip or sensor  # effects are made for the whole of a chip
    pixels = sensor.layout.pixels
    each = -(-_PROBES // pixels)
    offsets = np.arange(pixels + 1, dtype=np.int64) * each
    true = np.tile((1 + np.arange(each)) * 1.000123e-5, pixels)
    events = Events(true, offsets, pixels, end=1.0)
    rng = Draws(np.zeros(3, np.uint64), np.zeros(1, np.uint64))
    square = 0.0
    for effect in sensor.at("timing"):
        if not effect.counted:
            return None
        after = effect.apply(Events(true, offsets, pixels, end=1.0), rng)  # type: ignore[attr-defined]
        if len(after) != len(events):
            return None
        late = after.times - true
        late = late - late.mean()
        width = float(np.ptp(late))
        if hasattr(effect, "converter"):
            tick = effect.converter()[0]
            if width > tick * (1 + 1e-4) and width > 1e-15:
                return None  # ticks of unequal length
        elif width > 0:
            sigma = float(late.std())
            if np.abs(late).max() > 6 * sigma:
                return None
            square += 2 * sigma**2
    return math.sqrt(square)


# (pixels,) rates -> (log-likelihood, its derivative by the rate, about minus the second one) of each pixel
Law = Callable[[np.ndarray], tuple[np.ndarray, ...]]

# --- the laws ------------------------------------------------------------------------------------------------------


@kernels.inline
def _risen(x, tick, sigma):
    """Chance that an interval has reached an edge which it is beyond by x s: both stamps rounded, and jittered."""
    if sigma == 0.0:
        if tick == 0.0 or abs(x) >= tick:
            return 1.0 if x > 0 else 0.0
        y = x / tick
        return 0.5 * (1 + y) * (1 + y) if y < 0 else 1 - 0.5 * (1 - y) * (1 - y)
    if x > tick + 8 * sigma:
        return 1.0
    total = 0.0
    if tick < 0.05 * sigma:
        return 0.5 * math.erfc(-x / (sigma * 1.4142135623730951))
    for k in range(8):  # the mean over the triangle, by its own quantiles
        q = (k + 0.5) / 16
        e = tick * (1 - math.sqrt(2 * q))
        total += math.erfc(-(x - e) / (sigma * 1.4142135623730951)) + math.erfc(-(x + e) / (sigma * 1.4142135623730951))
    return total / 32


@kernels.jit
def _followed(gaps, kinds, offsets, counts, end, dead, chance, lifetime, rate, tick, sigma, hazard, used):
    """(log of the chance of all that does not depend on the rate, s awake) of each pixel.

    gaps, kinds, offsets: the gaps that may be short, as `_Stamps.near` gives them; counts: (pixels,) of events; chance:
    (traps, pixels); lifetime: (traps,) s; rate: (pixels,) 1/s, about, to tell who may have caused what. Of the hazard
    (gaps,) of traps at events the first `used` (pixels,) from the offset of a pixel on are set; elsewhere it is 0.
    """
    pixels, traps = counts.size, lifetime.size
    base, awake = np.zeros(pixels), np.zeros(pixels)
    full, old, own, emptied, blind = np.zeros((5, traps))
    for i in range(pixels):
        # as if all gaps were long, and every trap empty at their ends; what is not so is set right below
        awake[i] = end - counts[i] * dead[i]
        used[i] = 0
        for k in range(traps):
            full[k] = chance[k, i]  # chance that the trap of the last detection is full; old: sum of those before
            emptied[k], blind[k] = math.log1p(-chance[k, i]), math.exp(-dead[i] / lifetime[k])
            base[i] += counts[i] * emptied[k]
            old[k] = 0.0
        none = 1.0  # a product, for logarithms take long
        for m in range(offsets[i], offsets[i + 1]):
            if not kinds[m] & _FOLLOWS:
                for k in range(traps):
                    base[i] -= old[k]
                    old[k] = 0.0
            v = gaps[m] - dead[i]
            last = kinds[m] & _LAST
            if not last and dead[i] > 0.0 and v < tick + 8 * sigma:
                base[i] += math.log(max(_risen(v, tick, sigma), _LEAST))
            if v < 0.0:
                awake[i] -= v
                v = 0.0
            here = 0.0
            for k in range(traps):
                if v > _LONG * lifetime[k]:
                    base[i] -= old[k]
                    own[k] = old[k] = 0.0
                    continue
                left = math.exp(-v / lifetime[k])
                still = 1.0 - full[k] * (1.0 - left)
                none *= still
                base[i] -= emptied[k] + old[k] * (1.0 - left)
                own[k] = full[k] * left / still
                old[k] *= left
                here += (own[k] + old[k]) / lifetime[k]
            if none < 1e-200:
                base[i] += math.log(none)
                none = 1.0
            if last:
                old[:] = 0.0  # nobody asks when they leave
                break
            if here > 0.0:
                hazard[offsets[i] + used[i]] = here
                used[i] += 1
            for k in range(traps):
                # unless it was that one that fired; what leaves while the pixel is blind is lost
                kept = own[k] * (1.0 - own[k] / (lifetime[k] * (rate[i] + here)))
                old[k] = (old[k] + kept) * blind[k]
        base[i] += math.log(none)
        for k in range(traps):
            base[i] -= old[k]
    return base, awake


@kernels.inline
def _of_rate(hazard, start, used, count, awake, rate):
    """(log-likelihood, its derivative by the rate, minus the second one) of a pixel with `count` events.

    hazard: of those where there is one, `used` from `start` on.
    """
    unit = 1.0 / rate
    value, product = count * math.log(rate) - rate * awake, 1.0
    first = second = np.float64(count - used)
    for j in range(start, start + used):
        more = 1.0 + hazard[j] * unit
        product *= more
        if product > 1e200:
            value += math.log(product)
            product = 1.0
        share = 1.0 / more
        first += share
        second += share * share
    return value + math.log(product), first * unit - awake, second * unit * unit


@kernels.jit
def _of_rates(hazard, offsets, used, counts, awake, rate):
    """(log-likelihood, its derivative by the rate, minus the second one) of each pixel, (pixels,)."""
    value, first, second = np.zeros((3, counts.size))
    for i in range(counts.size):
        value[i], first[i], second[i] = _of_rate(hazard, offsets[i], used[i], counts[i], awake[i], rate[i])
    return value, first, second


@kernels.jit
def _at_best(hazard, offsets, used, counts, awake, rate):
    """The log-likelihood of all pixels at the rates that maximise it, which is concave: by Newton's steps.

    rate: (pixels,) from where they begin, 0 for anywhere; overwritten by the best ones.
    """
    total = 0.0
    for i in range(counts.size):
        if counts[i] == 0:
            continue
        if rate[i] <= 0.0 or used[i] == 0:
            rate[i] = counts[i] / awake[i]
        for _ in range(60):
            value, first, second = _of_rate(hazard, offsets[i], used[i], counts[i], awake[i], rate[i])
            step = first / second
            gain = 0.5 * first * step  # by a last step
            rate[i] = max(rate[i] + step, 0.2 * rate[i])
            if gain < 1e-7:
                break
        total += value + gain
    return total


class _Stamps:
    """Law of the time stamps of a capture."""

    def __init__(self, recording: Recording):
        assert recording.events is not None
        self.capture = recording.capture
        times, offsets = recording.events.times, recording.events.offsets.astype(np.int64)
        self.tick = recording.tick or 0.0
        self.counts = np.diff(offsets)
        pixels = len(self.counts)
        # of each pixel the gaps between its events and then the one to the end; before its first nothing has happened
        lit = np.flatnonzero(self.counts)
        self.gaps = np.diff(np.append(times, 0.0))
        self.gaps[offsets[lit + 1] - 1] = self.capture.conditions.exposure - times[offsets[lit + 1] - 1]
        self.last = np.zeros(len(times), bool)
        self.last[offsets[lit + 1] - 1] = True
        self.first = np.zeros(len(times), bool)
        self.first[offsets[lit]] = True
        self.offsets = offsets
        self.reach, self.near = -1.0, (np.zeros(0), np.zeros(0, np.uint8), np.zeros(pixels + 1, np.int64))
        self.hazard, self.used = np.zeros(0), np.zeros(pixels, np.int64)
        self.best = np.zeros(pixels)
        self.given: list[np.ndarray] = []
        self.parts = np.zeros((2, pixels))

    def rates(self, sensor: Sensor, level: float) -> np.ndarray:
        """(pixels,) 1/s."""
        return sensor.rates(np.full((1, sensor.layout.pixels), level), self.capture.conditions)[0][0]

    def _look(self, reach: float) -> None:
        """See to it that `near` has the gaps of at most `reach` s, and not many more.

        near: (s, kind, (pixels + 1,) where the gaps of a pixel begin) of each gap.
        """
        if reach <= self.reach < 3 * reach:
            return
        self.reach = 1.5 * reach
        short = self.gaps <= self.reach
        kinds = np.where(self.last, _LAST, 0).astype(np.uint8)
        kinds[1:] |= np.where(short[:-1] & ~self.first[1:], _FOLLOWS, 0).astype(np.uint8)
        kept = np.append(0, np.cumsum(short))
        self.near = self.gaps[short], kinds[short], kept[self.offsets]
        self.hazard = np.zeros(len(self.near[0]))

    def of(self, sensor: Sensor, blur: float, own: bool) -> tuple[float, Law]:
        """(log-likelihood without what depends on the rates, the rest as a law of the rates).

        own: with the rest at each pixel's best rate.
        """
        dead = np.ascontiguousarray(np.broadcast_to(sensor.dead_times, len(self.counts)), np.float64)
        end = self.capture.conditions.exposure
        chances = [(e, -np.expm1(-e.hazards(len(dead)))) for e in sensor.at("correlated") if isinstance(e, Traps)]
        filled = [(float(e.lifetime), p) for e, p in chances if p.any()]
        chance = np.array([p for _, p in filled]).reshape(len(filled), len(dead))
        lifetime = np.array([x for x, _ in filled])
        given = [dead, chance, lifetime, np.array([blur])]
        if not (self.given and all(np.array_equal(a, b) for a, b in zip(given, self.given, strict=True))):
            self._look(float(dead.max(initial=0.0)) + max(_LONG * lifetime.max(initial=0.0), self.tick + 8 * blur))
            about = np.maximum(self.counts, 0.5) / np.maximum(end - self.counts * dead, 0.01 * end)
            what = self.counts, end, dead, chance, lifetime, about, self.tick, blur
            self.parts = np.array(_followed(*self.near, *what, self.hazard, self.used))
            self.given = given
        base, awake = self.parts
        rest = self.hazard, self.near[2], self.used, self.counts, awake

        def law(rate: np.ndarray) -> tuple[np.ndarray, ...]:
            return _of_rates(*rest, np.maximum(rate, 1e-12))

        whole = float(base.sum())
        return whole + (_at_best(*rest, self.best) if own else 0.0), law

    def near_edge(self, dead: np.ndarray, blur: float) -> int:
        """Intervals within the width of the edge at the end of the dead time."""
        beyond = self.gaps - np.repeat(dead, self.counts)
        return int(np.count_nonzero(np.abs(beyond[~self.last]) <= self.tick + 2 * blur))


class _Bits:
    """Law of the bits of a capture: of each pixel, the number of frames with a detection."""

    tick = 0.0

    def __init__(self, recording: Recording):
        self.capture = recording.capture
        self.ones = recording.totals.astype(np.float64)
        self.frames = recording.n_frames

    def rates(self, sensor: Sensor, level: float) -> np.ndarray:
        """(pixels,) what could fire a pixel in a frame."""
        c = self.capture.conditions
        candidates = sensor.expected(np.full((1, sensor.layout.pixels), level), c)[0][0]
        return candidates / c.frames * (c.frame_time / c.frame_period)

    def of(self, sensor: Sensor, blur: float, own: bool) -> tuple[float, Law]:
        """As of `_Stamps`; own: nothing but rates is in it, so nothing is left."""

        def law(mean: np.ndarray) -> tuple[np.ndarray, ...]:
            mean = np.maximum(mean, 1e-12)
            share, none = -np.expm1(-mean), self.frames - self.ones
            odds = np.exp(-mean) / share
            value = self.ones * np.log(share) - none * mean
            return value, self.ones * odds - none, self.frames * odds

        return 0.0, law

    def near_edge(self, dead: np.ndarray, blur: float) -> int:
        """There are no intervals."""
        return 0


class Likelihood:
    """The log-likelihood of a measurement as a function of some dials' coordinates, all that is unknown maximised.

    blur: s, as `blur_of`; own: every pixel of every capture has a rate of its own.
    """

    def __init__(self, sensor: Sensor, data: Sequence[Recording], dials: Sequence[Dial], fixed: Mapping[Key, Any]):
        self.sensor, self.dials, self.fixed = sensor, tuple(dials), dict(fixed)
        self.laws = [_Stamps(r) if r.modality == "tr" else _Bits(r) for r in data]
        captures = [r.capture for r in data]
        self.levels, columns, precision = [], [], []
        common = np.zeros(len(data))
        for i, capture in enumerate(captures):
            light = capture.light
            stated = twin.photons_at(capture, sensor.layout)
            if stated is None:
                total = float(data[i].totals.sum())
                stated = recordings.level_for(recordings.closed_form(sensor, capture), total, None)
                columns.append(np.eye(len(data))[i])
                precision.append(1e-9)
            elif not light.dark:
                common[i] = light.relative_uncertainty
                if light.own_uncertainty:
                    columns.append(light.own_uncertainty * np.eye(len(data))[i])
                    precision.append(1.0)
            self.levels.append(stated)
        if common.any():
            columns.append(common)
            precision.append(1.0)
        # (captures, nuisances): how the logs of the levels follow what is not known of the light, in its own sigmas
        self.light = np.array(columns).reshape(-1, len(data)).T
        self.precision = np.array(precision)
        self.shifts = np.zeros(len(precision))
        self.highest = -math.inf, np.zeros(len(dials))  # seen so far

    def sensor_at(self, u: np.ndarray) -> Sensor:
        """The sensor with the dials at some coordinates."""
        turned = {d.key: d.value(float(x)) for d, x in zip(self.dials, u, strict=True)}
        return with_values(self.sensor, {**self.fixed, **turned})

    def begin(self, u: np.ndarray) -> None:
        """See from where the search begins what has to be followed: do the dials change rates, the jitter?"""
        points = [u, *(u + h * np.eye(len(u))[i] for i in range(len(u)) for h in (-0.3, 0.3))]
        sensors = [self.sensor_at(p) for p in points]
        rates = [[law.rates(s, x) for law, x in zip(self.laws, self.levels, strict=True)] for s in sensors]
        self.own = all(np.array_equal(a, b) for one in rates for a, b in zip(one, rates[0], strict=True))
        self.blur = blur_of(sensors[0]) or 0.0
        self.jittered = any(blur_of(s) != self.blur for s in sensors)
        self.edges = [
            any(not np.array_equal(s.dead_times, sensors[0].dead_times) for s in sensors[1 + 2 * i : 3 + 2 * i])
            for i in range(len(u))
        ]

    def fall(self, i: int, u: np.ndarray) -> float:
        """By how much twice the log-likelihood falls at the ends of a dial's interval.

        Where intervals are not dense enough to see how steep the edge is, it is the law of the shortest one.
        """
        if not self.edges[i]:
            return FALL
        dead = self.sensor_at(u).dead_times
        return FALL if sum(law.near_edge(dead, self.blur) for law in self.laws) > _DENSE else EDGE_FALL

    def __call__(self, u: np.ndarray) -> float:
        sensor = self.sensor_at(u)
        blur = (blur_of(sensor) or 0.0) if self.jittered else self.blur
        parts = [law.of(sensor, blur, self.own) for law in self.laws]
        value = sum(value for value, _ in parts)
        value = value if self.own else value + self._lit(sensor, [law for _, law in parts])
        if value > self.highest[0]:
            self.highest = value, u.copy()
        return value

    def _lit(self, sensor: Sensor, laws: Sequence[Law]) -> float:
        """What depends on the rates, the light being as the data and its uncertainty want it: by Newton's steps."""
        step, z = 1e-4, self.shifts
        for _ in range(30):
            values, first, second = np.zeros((3, len(laws)))
            for i, (data, law) in enumerate(zip(self.laws, laws, strict=True)):
                x = float(self.light[i] @ z)
                rate, more = (data.rates(sensor, self.levels[i] * math.exp(y)) for y in (x, x + step))
                slope = (more - rate) / step
                value, by_rate, curvature = law(rate)
                values[i] = value.sum()
                first[i], second[i] = by_rate @ slope, curvature @ slope**2
            total = float(values.sum() - 0.5 * self.precision @ z**2)
            if not len(z):
                break
            gradient = self.light.T @ first - self.precision * z
            move = np.linalg.solve(self.light.T @ (second[:, None] * self.light) + np.diag(self.precision), gradient)
            if gradient @ move < 1e-4:
                total += 0.5 * float(gradient @ move)
                break
            z = z + move * min(1.0, 1.0 / float(np.abs(self.light @ move).max()))
        self.shifts = z
        return total


# --- settling ------------------------------------------------------------------------------------------------------


def settled(
    sensor: Sensor,
    data: Sequence[Recording],
    changes: Sequence[Change],
    *,
    start: Mapping[Key, float] | None = None,
    errors: Mapping[Key, float] | None = None,
    mapped: bool = False,
) -> Exact | str:
    """What some changes' numbers are, by the likelihood of these recordings; in a word what stands in the way of it.

    mapped: pixels have rates of their own that are not exactly known. Then no number that changes a rate is settled.

    start: values of their dials that are nearly right; without them places are tried. errors: of coordinates of dials,
    about (1 sigma). A dial that nothing follows has the interval in which it is looked for.
    """
    dials = tuple(d for change in changes for d in change.dials)
    fixed = {key: value for change in changes for key, value in change.fixed}
    if not dials or any(change.carrier or change.phases or not change.dials for change in changes):
        return "a map, a phase or a switch"
    values = {**fixed}
    for change in changes:
        for key, value in templates(change)[0].items():
            listed = sensor.effect(key[0])
            values[key] = value if listed is None else getattr(listed, key[1])
    changed = with_values(sensor, values)
    # at its start a listed number may be where its effect does nothing; what is asked for is what it does
    elsewhere = with_values(sensor, {**values, **{key: v for c in changes for key, v in templates(c)[0].items()}})
    for one in data:
        for model in (changed, elsewhere):
            if word := unknown(model, one.capture):
                return word
    function = Likelihood(sensor, data, dials, fixed)
    ends = np.array([d.ends for d in dials]).T
    given = {d.key: float(values[d.key]) for d in dials}
    widths = {d.key: 0.3 if d.log else 0.1 * (d.ends[1] - d.ends[0]) for d in dials}

    def placed(there: Mapping[Key, float]) -> np.ndarray:
        return np.clip([d.coordinate(there[d.key]) for d in dials], *ends)

    function.begin(placed({**given, **(start or {})}))
    if mapped and not function.own:
        return "maps beside what changes the rates"
    top = None
    if start is not None:
        u, scales = placed({**given, **start}), {**widths, **(errors or {})}
        top = topped(function, u, np.array([scales[d.key] for d in dials]), ends, _FAR)
    if top is None:
        u, scale = placed(given), np.array([widths[d.key] for d in dials])
        function.begin(u)
        for change in changes:
            if change.kind == "add":
                there = {d.key: d.value(x) for d, x in zip(dials, u, strict=True)}
                u = max((placed({**there, **template}) for template in templates(change)), key=function)
        _, u = climbed(function, u, scale, ends, _ROUGH)
        top = topped(function, u, scale, ends)
        assert top is not None
    for _ in range(3):
        profiles = [
            [profile(function, top, i, sign, function.fall(i, top.u), ends) for sign in (-1, 1)]
            if top.tells[i]
            else list(map(float, ends[:, i]))
            for i in range(len(dials))
        ]
        if function.highest[0] < top.value + _HIGHER:
            break
        # that was not the top
        top = topped(function, function.highest[1], top.spreads, ends)
        assert top is not None
    best, u = top.value, top.u
    intervals = {d.key: d.interval(*profile) for d, profile in zip(dials, profiles, strict=True)}
    found = {d.key: d.value(float(x)) for d, x in zip(dials, u, strict=True)}
    gains = []
    for change in changes:
        # the others as they are
        own = {*dict(change.fixed), *(d.key for d in change.dials)}
        rest = {key: value for key, value in {**fixed, **found}.items() if key not in own}
        without = Likelihood(sensor, data, (), rest)
        without.begin(np.zeros(0))
        without.own = function.own
        gains.append(2 * (best - without(np.zeros(0))))
    inverse = np.linalg.inv(top.curved)
    spread = np.sqrt(np.diag(inverse))
    return Exact({**fixed, **found}, intervals, gains, tuple(found), inverse / np.outer(spread, spread))
