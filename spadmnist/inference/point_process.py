# mypy: disable-error-code="no-untyped-def"
"""Exact likelihoods of captures: the point process of time stamps (TR), the binomial law of single frames (QIS).

After a detection a pixel is blind for the dead time. Then its hazard is its rate plus, for every kind of trap, the
release of what earlier detections left there: of the last detection exactly, of those before it to first order in the
probability. The tick and the jitter blur the edge at the end of the dead time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from .. import kernels, plugins
from ..events import Events
from ..recording import Recording
from ..sensor import Sensor
from ..streams import Draws

# intervals within the width of an edge, beyond which its estimate is normal; with fewer its interval is that of an
# exponential law (`exact_likelihood.EDGE_FALL`). A rule of thumb
DENSE = 4.0
# the least probability that an interval ends before the dead time: a wrong stamp is not impossible, and costs 20.7 of
# the log-likelihood; a rule of thumb
_LEAST = 1e-9
# events that are stamped to measure the blur, at least: by the normal law their standard deviation is known to 1.1 %
_PROBES = 4096
# stamps of a pixel, below which it is left out where pixels have rates of their own: what few stamps say of a trap
# depends on how the rates of the pixels are distributed. A rule of thumb: the next term of Laplace's method is 1/MANY^2
MANY = 30
_LONG = 20.0  # lifetimes after which a trap is empty: 2e-9 of its content is left
_PIECE = 1 << 20  # gaps that are looked at together: memory against time, and no result depends on it; a rule of thumb
# of a gap that may be short: itself, its hazard, its kind; and itself once more while the pieces are put together.
# Plain meaning: they decide how many gaps have room
BYTES_OF_A_GAP = 8 + 8 + 1 + 8
FOLLOWS, LAST = 1, 2  # kinds of gaps: after another short one; to the end of the exposure
# (pixels,) rates -> (log-likelihood, its derivative by the rate, minus about the second one), (pixels,) each
Law = Callable[[np.ndarray], tuple[np.ndarray, ...]]


def blur_of(sensor: Sensor) -> float | None:
    """The blur of an interval by jitter, s, one standard deviation; None if it is not normal.

    A few events are stamped for it.
    """
    sensor = sensor.chip or sensor  # the effects are made for the whole chip
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


def hazards_of(sensor: Sensor, pixels: int) -> dict[str, tuple[np.ndarray, float]]:
    """What a detection leaves in its own pixel, by the effect's name; see `Effect.hazard`."""
    found = {}
    for effect in sensor.at("correlated"):
        with plugins.blaming(type(effect)):
            if (left := effect.hazard(pixels)) is not None:
                hazard, time = left
                found[effect.name] = np.broadcast_to(np.asarray(hazard, np.float64), pixels), float(time)
    return found


@kernels.inline
def _risen(x, tick, sigma):
    """The probability that an interval x s beyond an edge has reached it, both stamps rounded and jittered."""
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
    for k in range(8):  # the mean over the triangular law, at its quantiles
        q = (k + 0.5) / 16
        e = tick * (1 - math.sqrt(2 * q))
        total += math.erfc(-(x - e) / (sigma * 1.4142135623730951)) + math.erfc(-(x + e) / (sigma * 1.4142135623730951))
    return total / 32


@kernels.jit
def followed_gaps(near, seen, pixel, stamps, out):
    """(log-probability of all that does not depend on the rate, time awake in s), (pixels,) each.

    Args:
        near: (gaps, kinds, offsets) of the gaps that may be short, as `Stamps.near` has them.
        seen: (counts, end): (pixels,) events; exposure, s.
        pixel: (dead, probability, lifetime, rate): (pixels,) dead time, s; (traps, pixels) probability that a detection
            fills a trap; (traps,) s; (pixels,) 1/s, approximate, for the probability that a trap caused an event.
        stamps: (tick, sigma), s.
        out: (hazard, used): (gaps,) the hazard of traps at events, 1/s, from a pixel's offset on, the first `used`;
            (pixels,) the number of those.
    """
    gaps, kinds, offsets = near
    counts, end = seen
    dead, probability, lifetime, rate = pixel
    tick, sigma = stamps
    hazard, used = out
    pixels, traps = counts.size, lifetime.size
    base, awake = np.zeros(pixels), np.zeros(pixels)
    full, old, own, emptied, blind = np.zeros((5, traps))
    for i in range(pixels):
        # as if all gaps were long, and every trap empty at their ends; the short ones are corrected below
        awake[i] = end - counts[i] * dead[i]
        used[i] = 0
        for k in range(traps):
            # full: probability that the last detection has filled the trap; old: the sum over those before
            full[k] = probability[k, i]
            emptied[k], blind[k] = math.log1p(-probability[k, i]), math.exp(-dead[i] / lifetime[k])
            base[i] += counts[i] * emptied[k]
            old[k] = 0.0
        none = 1.0  # a product, because logarithms are slow
        for m in range(offsets[i], offsets[i + 1]):
            if not kinds[m] & FOLLOWS:
                for k in range(traps):
                    base[i] -= old[k]
                    old[k] = 0.0
            v = gaps[m] - dead[i]
            last = kinds[m] & LAST
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
                old[:] = 0.0  # no later event depends on it
                break
            if here > 0.0:
                hazard[offsets[i] + used[i]] = here
                used[i] += 1
            for k in range(traps):
                # unless this trap fired; a release during the dead time is lost
                kept = own[k] * (1.0 - own[k] / (lifetime[k] * (rate[i] + here)))
                old[k] = (old[k] + kept) * blind[k]
        base[i] += math.log(none)
        for k in range(traps):
            base[i] -= old[k]
    return base, awake


@kernels.inline
def _of_rate(hazard, start, used, count, awake, rate):
    """(log-likelihood, its derivative by the rate, minus the second one) of a pixel with `count` events.

    Args:
        hazard: of traps at events, 1/s; `used` of them from `start` on.
        awake: s.
        rate: 1/s.
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
def likelihood_of_rates(hazard, offsets, used, counts, awake, rate):
    """(log-likelihood, its derivative by the rate, minus the second one), (pixels,) each."""
    value, first, second = np.zeros((3, counts.size))
    for i in range(counts.size):
        value[i], first[i], second[i] = _of_rate(hazard, offsets[i], used[i], counts[i], awake[i], rate[i])
    return value, first, second


@kernels.jit
def _of_any_rate(hazard, offsets, used, counts, awake, rate):
    """The log-likelihood of the pixels with `MANY` events, integrated over the log of each one's rate.

    By Laplace's method to second order about the peak of the integrand, found by Newton steps. At the
    maximum-likelihood rates, each pixel's rate would take its share of the events that a trap has caused: of many
    pixels a probability of afterpulses came out too low by several standard errors. A constant is left out.
    Source: Neyman and Scott, Econometrica 16 (1948) 1; Kalbfleisch and Sprott, J. R. Stat. Soc. B 32 (1970) 175;
    Tierney and Kadane, J. Am. Stat. Assoc. 81 (1986) 82.

    Args:
        rate: (pixels,) 1/s, the start, 0 for any; overwritten by the peak.
    """
    total = 0.0
    for i in range(counts.size):
        if counts[i] < MANY:
            continue
        if rate[i] <= 0.0:
            rate[i] = counts[i] / awake[i]
        value = second = third = fourth = 0.0
        for _ in range(60):
            value, product = counts[i] * math.log(rate[i]) - rate[i] * awake[i], 1.0
            first = counts[i] - rate[i] * awake[i]
            second = third = fourth = -rate[i] * awake[i]
            for j in range(offsets[i], offsets[i] + used[i]):
                more = 1.0 + hazard[j] / rate[i]
                product *= more
                if product > 1e200:
                    value += math.log(product)
                    product = 1.0
                share = 1.0 - 1.0 / more
                both = share * (1.0 - share)
                first -= share
                second += both
                third -= both * (1.0 - 2.0 * share)
                fourth += both * (1.0 - 6.0 * both)
            value += math.log(product)
            if second >= 0.0:  # too far below the peak, above which the integrand is concave
                rate[i] = counts[i] / awake[i]
                continue
            step = -first / second
            rate[i] *= math.exp(min(max(step, -1.0), 1.0))
            if abs(first * step) < 1e-7:
                break
        total += value + 0.5 * first * step - 0.5 * math.log(-second)
        total += fourth / (8.0 * second * second) - 5.0 * third * third / (24.0 * second * second * second)
    return total


class TooManyGaps(Exception):
    """A law would hold more gaps than it may."""


def _joined(pieces: list[np.ndarray], dtype: Any) -> np.ndarray:
    """The pieces one after the other; none of them is there any more."""
    out, at = np.empty(sum(map(len, pieces)), dtype), 0
    for k, piece in enumerate(pieces):
        out[at : at + len(piece)] = piece
        at += len(piece)
        pieces[k] = out[:0]
    return out


class Stamps:
    """The law of the time stamps of a capture."""

    def __init__(self, recording: Recording, most: float = math.inf):
        """The law of a recording, which is held: 4 or 8 bytes of each stamp.

        Args:
            most: gaps that may be held as well, `BYTES_OF_A_GAP` each.
        """
        assert recording.events is not None
        self.capture, self.events, self.most = recording.capture, recording.events, most
        self.offsets = recording.events.offsets.astype(np.int64)
        self.tick = recording.tick or 0.0
        self.counts = np.diff(self.offsets)
        pixels = len(self.counts)
        self.reach, self.near = -1.0, (np.zeros(0), np.zeros(0, np.uint8), np.zeros(pixels + 1, np.int64))
        self.hazard, self.used = np.zeros(0), np.zeros(pixels, np.int64)
        self.best = np.zeros(pixels)
        self.given: list[np.ndarray] = []
        self.parts = np.zeros((2, pixels))

    def _gaps(self) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """(which events, the gaps behind them, s, whether each is the last of its pixel) piece by piece.

        A pixel's last gap reaches to the end of the exposure; before its first event nothing has happened.
        """
        count, ends = int(self.offsets[-1]), self.offsets[1:][self.counts > 0] - 1
        for start in range(0, count, _PIECE):
            part = slice(start, min(start + _PIECE, count))
            times = self.events.times_of(slice(part.start, part.stop + 1))
            number = part.stop - part.start
            gaps = np.diff(times if len(times) > number else np.append(times, 0.0))
            at = ends[np.searchsorted(ends, part.start) : np.searchsorted(ends, part.stop)] - part.start
            last = np.zeros(number, bool)
            last[at] = True
            gaps[at] = self.capture.conditions.exposure - times[at]
            yield part, gaps, last

    def rates(self, sensor: Sensor, level: float) -> np.ndarray:
        """The rates of the pixels at a light level, (pixels,), 1/s."""
        return sensor.rates(np.full((1, sensor.layout.pixels), level), self.capture.conditions)[0][0]

    def _look(self, reach: float) -> None:
        """Set `near` to the gaps of at most `reach` s, and not many more.

        near: (gaps in s, kinds, (pixels + 1,) offsets of the pixels).
        """
        if reach <= self.reach < 3 * reach:
            return
        self.reach = 1.5 * reach
        short, all_kinds = [], []
        before, held = False, 0  # is the gap before the piece a short one, and not the last of its pixel?
        kept = np.zeros(len(self.counts) + 1, np.int64)
        for part, gaps, last in self._gaps():
            near = gaps <= self.reach
            follows = np.append(before, (near & ~last)[:-1])
            before = bool(near[-1] and not last[-1])
            kinds = np.where(last, LAST, 0) | np.where(follows, FOLLOWS, 0)
            short.append(gaps[near])
            all_kinds.append(kinds[near].astype(np.uint8))
            inside = slice(*np.searchsorted(self.offsets, (part.start, part.stop)))
            kept[inside] = held + np.append(0, np.cumsum(near))[self.offsets[inside] - part.start]
            held += len(short[-1])
            if held > self.most:
                raise TooManyGaps
        kept[self.offsets >= self.offsets[-1]] = held
        self.near = _joined(short, np.float64), _joined(all_kinds, np.uint8), kept
        self.hazard = np.zeros(held)

    def of(self, sensor: Sensor, blur: float, own: bool) -> tuple[float, Law]:
        """(log-likelihood without what depends on the rates, the rest as a law of the rates).

        Args:
            blur: s, of an interval.
            own: the first number includes the rest, integrated over the rate of each pixel with `MANY` stamps; the
                others are left out.
        """
        dead = np.ascontiguousarray(np.broadcast_to(sensor.dead_times, len(self.counts)), np.float64)
        end = self.capture.conditions.exposure
        traps = [(-np.expm1(-h), lifetime) for h, lifetime in hazards_of(sensor, len(dead)).values()]
        filled = [(lifetime, p) for p, lifetime in traps if p.any()]
        probability = np.array([p for _, p in filled]).reshape(len(filled), len(dead))
        lifetime = np.array([x for x, _ in filled])
        given = [dead, probability, lifetime, np.array([blur])]
        if not (self.given and all(np.array_equal(a, b) for a, b in zip(given, self.given, strict=True))):
            self._look(float(dead.max(initial=0.0)) + max(_LONG * lifetime.max(initial=0.0), self.tick + 8 * blur))
            about = np.maximum(self.counts, 0.5) / np.maximum(end - self.counts * dead, 0.01 * end)
            pixel = dead, probability, lifetime, about
            out = self.hazard, self.used
            self.parts = np.array(followed_gaps(self.near, (self.counts, end), pixel, (self.tick, blur), out))
            self.given = given
        base, awake = self.parts
        rest = self.hazard, self.near[2], self.used, self.counts, awake

        def law(rate: np.ndarray) -> tuple[np.ndarray, ...]:
            return likelihood_of_rates(*rest, np.maximum(rate, 1e-12))

        if own:
            return float(base[self.counts >= MANY].sum()) + _of_any_rate(*rest, self.best), law
        return float(base.sum()), law

    def near_edge(self, dead: np.ndarray, blur: float) -> int:
        """The number of intervals within the width of the edge at the end of the dead time.

        Args:
            dead: (pixels,) s.
            blur: s.
        """
        dead, number = np.broadcast_to(dead, len(self.counts)), 0
        for part, gaps, last in self._gaps():
            pixel = np.searchsorted(self.offsets, np.arange(part.start, part.stop), "right") - 1
            beyond = gaps - dead[pixel]
            number += int(np.count_nonzero(np.abs(beyond[~last]) <= self.tick + 2 * blur))
        return number


class Bits:
    """The law of the bits of a capture: for each pixel, the number of frames with a detection."""

    tick = 0.0

    def __init__(self, recording: Recording):
        self.capture = recording.capture
        self.ones = recording.totals.astype(np.float64)
        self.frames = recording.n_frames

    def rates(self, sensor: Sensor, level: float) -> np.ndarray:
        """The expected number of candidates for a detection in a frame, (pixels,)."""
        c = self.capture.conditions
        candidates = sensor.expected(np.full((1, sensor.layout.pixels), level), c)[0][0]
        return candidates / c.frames * (c.frame_time / c.frame_period)

    def of(self, sensor: Sensor, blur: float, own: bool) -> tuple[float, Law]:
        """As `Stamps.of`; the first number is 0, because all depends on the rates."""

        def law(mean: np.ndarray) -> tuple[np.ndarray, ...]:
            mean = np.maximum(mean, 1e-12)
            share, none = -np.expm1(-mean), self.frames - self.ones
            odds = np.exp(-mean) / share
            value = self.ones * np.log(share) - none * mean
            return value, self.ones * odds - none, self.frames * odds

        return 0.0, law

    def near_edge(self, dead: np.ndarray, blur: float) -> int:
        """The number of intervals near an edge: 0, there are none."""
        return 0
