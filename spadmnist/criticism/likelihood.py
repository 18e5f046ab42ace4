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
from scipy import optimize

from .. import kernels, twin
from ..effects import Effect
from ..effects._traps import Traps
from ..events import Events
from ..recording import Capture, Recording
from ..sensor import Sensor
from ..streams import Draws
from . import recordings
from .candidates import Change, Dial, Key, templates, with_values

FALL = 3.84  # of twice the log-likelihood, at the ends of an interval of 95 %
EDGE_FALL = 5.99  # of an edge that is sharper than intervals are dense: an exponential law, not a normal one
_DENSE = 4.0  # intervals within the width of an edge, from which on it is a matter of the normal law
_LEAST = 1e-9  # of the chance that an interval ends before the dead time does: a wrong stamp is not impossible
_PROBES = 4096
_LONG = 30.0  # lifetimes after which a trap is empty
_SHARP = 0.1  # of a lifetime: stamps must be so exact


@dataclass(frozen=True)
class Exact:
    """Numbers that maximise the likelihood, with intervals of 95 %; gains: of twice its logarithm, of each change."""

    values: dict[Key, float]
    intervals: dict[Key, tuple[float, float]]
    gains: list[float]


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
def _followed(times, offsets, end, dead, chance, lifetime, rate, tick, sigma, hazard):
    """(log of the chance of all that does not depend on the rate, s awake) of each pixel; hazard (events,): of traps.

    chance: (traps, pixels); lifetime: (traps,) s; rate: (pixels,) 1/s, about, to tell who may have caused what.
    """
    pixels, traps = offsets.size - 1, lifetime.size
    base, awake = np.zeros(pixels), np.zeros(pixels)
    full, old, own, emptied, blind = np.zeros((5, traps))
    for i in range(pixels):
        for k in range(traps):
            emptied[k], blind[k] = math.log1p(-chance[k, i]), math.exp(-dead[i] / lifetime[k])
        full[:] = 0.0  # chance that the trap of the last detection is still full; old: the sum of those before
        old[:] = 0.0
        since = 0.0
        stop = offsets[i + 1]
        for j in range(offsets[i], stop + 1):
            v = (times[j] if j < stop else end) - since
            if j < stop and j > offsets[i] and dead[i] > 0.0 and v < tick + 8 * sigma:
                base[i] += math.log(max(_risen(v, tick, sigma), _LEAST))
            v = max(v, 0.0)
            awake[i] += v
            here = 0.0
            for k in range(traps):
                if v > _LONG * lifetime[k]:  # as most are
                    base[i] += (emptied[k] if j > offsets[i] else 0.0) - old[k]
                    own[k] = old[k] = 0.0
                    continue
                left = math.exp(-v / lifetime[k])
                none = 1.0 - full[k] * (1.0 - left)
                base[i] += math.log(none) - old[k] * (1.0 - left)
                own[k] = full[k] * left / none
                old[k] *= left
                here += (own[k] + old[k]) / lifetime[k]
            if j == stop:
                break
            hazard[j] = here
            for k in range(traps):
                # unless it was that one that fired; what leaves while the pixel is blind is lost
                kept = own[k] * (1.0 - own[k] / lifetime[k] / (rate[i] + here))
                old[k] = (old[k] + kept) * blind[k]
                full[k] = chance[k, i]
            since = times[j] + dead[i]
    return base, awake


@kernels.jit
def _of_rates(hazard, offsets, awake, rate):
    """(log-likelihood, its derivative by the rate, minus the second one) of each pixel, (pixels,)."""
    pixels = offsets.size - 1
    value, first, second = np.zeros(pixels), np.zeros(pixels), np.zeros(pixels)
    for i in range(pixels):
        value[i], first[i] = -rate[i] * awake[i], -awake[i]
        alone = 0
        for j in range(offsets[i], offsets[i + 1]):
            if hazard[j] == 0.0:
                alone += 1
                continue
            inverse = 1.0 / (rate[i] + hazard[j])
            value[i] -= math.log(inverse)
            first[i] += inverse
            second[i] += inverse * inverse
        value[i] += alone * math.log(rate[i])
        first[i] += alone / rate[i]
        second[i] += alone / rate[i] ** 2
    return value, first, second


@kernels.jit
def _best_rates(hazard, offsets, awake):
    """(pixels,) the rates that maximise `_of_rates`, which is concave: by Newton's steps."""
    pixels = offsets.size - 1
    out = np.zeros(pixels)
    for i in range(pixels):
        count = offsets[i + 1] - offsets[i]
        if count == 0:
            continue
        with_trap = np.nonzero(hazard[offsets[i] : offsets[i + 1]])[0] + offsets[i]
        alone, rate = count - with_trap.size, count / awake[i]
        for _ in range(60):
            first, second = alone / rate - awake[i], alone / rate**2
            for j in with_trap:
                inverse = 1.0 / (rate + hazard[j])
                first += inverse
                second += inverse * inverse
            step = first / second
            rate = rate + step if rate + step > 0.2 * rate else 0.2 * rate
            if abs(step) < 1e-7 * rate:
                break
        out[i] = rate
    return out


class _Stamps:
    """Law of the time stamps of a capture."""

    def __init__(self, recording: Recording):
        assert recording.events is not None
        self.capture = recording.capture
        self.times, self.offsets = recording.events.times, recording.events.offsets.astype(np.int64)
        self.tick = recording.tick or 0.0
        self.counts = np.diff(self.offsets)
        self.hazard = np.zeros(len(self.times))

    def rates(self, sensor: Sensor, level: float) -> np.ndarray:
        """(pixels,) 1/s."""
        return sensor.rates(np.full((1, sensor.layout.pixels), level), self.capture.conditions)[0][0]

    def of(self, sensor: Sensor, blur: float, own: bool) -> tuple[float, Law]:
        """(log-likelihood without what depends on the rates, the rest as a law of the rates).

        own: with the rest at each pixel's best rate.
        """
        dead = np.ascontiguousarray(np.broadcast_to(sensor.dead_times, len(self.counts)), np.float64)
        end = self.capture.conditions.exposure
        traps = [e for e in sensor.at("correlated") if isinstance(e, Traps)]
        chance = np.array([-np.expm1(-e.hazards(len(dead))) for e in traps]).reshape(len(traps), len(dead))
        lifetime = np.array([float(e.lifetime) for e in traps])
        about = np.maximum(self.counts, 0.5) / np.maximum(end - self.counts * dead, 0.01 * end)
        given = self.offsets, end, dead, chance, lifetime, about, self.tick, blur
        base, awake = _followed(self.times, *given, self.hazard)

        def law(rate: np.ndarray) -> tuple[np.ndarray, ...]:
            return _of_rates(self.hazard, self.offsets, awake, np.maximum(rate, 1e-12))

        whole = float(base.sum())
        return whole + float(law(_best_rates(self.hazard, self.offsets, awake))[0].sum()) if own else whole, law

    def near_edge(self, dead: np.ndarray, blur: float) -> int:
        """Intervals within the width of the edge at the end of the dead time."""
        pixel = np.repeat(np.arange(len(self.counts)), self.counts)
        same = pixel[1:] == pixel[:-1]
        beyond = (np.diff(self.times) - dead[pixel[1:]])[same]
        return int(np.count_nonzero(np.abs(beyond) <= self.tick + 2 * blur))


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
        fixed = sum(value for value, _ in parts)
        return fixed if self.own else fixed + self._lit(sensor, [law for _, law in parts])

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


def _climbed(
    function: Callable[[np.ndarray], float], start: np.ndarray, scales: np.ndarray, ends: np.ndarray
) -> tuple[float, np.ndarray]:
    """(largest value, where) of a function, by a simplex that begins as large as `scales`; ends: (2, n) bounds."""
    if not len(start):
        return function(start), start
    units = 1 / scales
    inward = np.where(start + scales > ends[1], -scales, scales)
    corners = np.clip(np.vstack([start, start + np.diag(inward)]), *ends)
    found = optimize.minimize(
        lambda u: -function(u / units),
        start * units,
        method="Nelder-Mead",
        bounds=(ends * units).T,
        options={"initial_simplex": corners * units, "xatol": 0.02, "fatol": 0.003, "maxfev": 200 * len(start)},
    )
    return -float(found.fun), np.asarray(found.x) / units


def _spreads(function: Callable[[np.ndarray], float], u: np.ndarray, best: float, ends: np.ndarray) -> np.ndarray:
    """How far each coordinate goes until the logarithm has fallen by 1/2, the others staying; at most its range."""
    out = np.zeros(len(u))
    for i in range(len(u)):
        reached = []
        for sign in (-1, 1):
            room = abs(ends[(sign + 1) // 2, i] - u[i])
            low, high = 1e-12, max(room, 1e-9)
            for _ in range(24):
                middle = math.sqrt(low * high)
                there = u.copy()
                there[i] += sign * middle
                low, high = (middle, high) if best - function(there) < 0.5 else (low, middle)
            reached.append(high)
        out[i] = math.sqrt(reached[0] * reached[1]) if min(reached) > 1e-8 else max(reached)
    return out


def _profile(
    function: Callable[[np.ndarray], float],
    best: float,
    u: np.ndarray,
    i: int,
    sign: int,
    fall: float,
    scales: np.ndarray,
    ends: np.ndarray,
) -> float:
    """Coordinate at which twice the logarithm has fallen by so much, all others maximised anew; at most the bound."""
    others = np.arange(len(u)) != i
    state = {"u": u.copy()}

    def root(x: float) -> float:
        """Of the fall, less that of the wanted one."""

        def free(rest: np.ndarray) -> float:
            there = np.full(len(u), x)
            there[others] = rest
            return function(there)

        value, rest = _climbed(free, state["u"][others], 0.3 * scales[others], ends[:, others])
        state["u"][others] = rest
        return math.sqrt(max(2 * (best - value), 0.0)) - math.sqrt(fall)

    inside, bound = float(u[i]), float(ends[(sign + 1) // 2, i])
    reach = 2 * float(scales[i])
    while True:
        outside = u[i] + sign * reach
        if sign * (outside - bound) >= 0:
            outside = bound
        if root(outside) >= 0:
            break
        if outside == bound:
            return bound
        inside, reach = outside, 2 * reach
    at_inside = {inside: -math.sqrt(fall)} if inside == u[i] else {}
    return float(
        optimize.brentq(lambda x: at_inside[x] if x in at_inside else root(x), inside, outside, xtol=0.02 * scales[i])
    )


def settled(sensor: Sensor, data: Sequence[Recording], changes: Sequence[Change]) -> Exact | str:
    """What some changes' numbers are, by the likelihood of these recordings; in a word what stands in the way of it."""
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
    u = np.array([d.coordinate(float(values[d.key])) for d in dials])
    function.begin(u)
    for change in changes:
        if change.kind == "add":
            places = []
            for template in templates(change):
                there = {**{d.key: d.value(x) for d, x in zip(dials, u, strict=True)}, **template}
                places.append(np.array([d.coordinate(float(there[d.key])) for d in dials]))
            u = max(places, key=function)
    scales = np.where([d.log for d in dials], 0.3, 0.1 * (ends[1] - ends[0]))
    best, u = _climbed(function, u, scales, ends)
    for _ in range(5):
        scales = np.maximum(_spreads(function, u, best, ends), 1e-9)
        higher, u = _climbed(function, u, scales, ends)
        gained, best = higher - best, max(higher, best)
        if gained < 0.01:
            break
    intervals = {}
    for i, dial in enumerate(dials):
        low, high = (_profile(function, best, u, i, sign, function.fall(i, u), scales, ends) for sign in (-1, 1))
        intervals[dial.key] = dial.value(low), dial.value(high)
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
    return Exact({**fixed, **found}, intervals, gains)
