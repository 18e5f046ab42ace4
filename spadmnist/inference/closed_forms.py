"""Closed forms: the detections that a capture has on average, as a function of the light, and the light by them."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import optimize, special, stats

from ..effects import Conditions
from ..recording import Capture
from ..sensor import Sensor

# A value without another reason is a rule of thumb: no measurement that is kept chose it.
CLOSED = 5e-4  # relative error of the closed forms, at most: it adds to the scatter where the mean alone is known
# of the square of what is caused, the error of the closed form of a cascade: 0.16 at most in simulations of a tenth and
# three tenths of afterpulses, of lifetimes from a fifth to three dead times, at 0.3 to 3 events a dead time
_CLUSTERED = 0.2
_POISSON = 1e-9  # relative: less than Poisson by so little is Poisson, to the precision of the binomial
_BEATS = 9  # harmonics of the beat of frame and dead time: the rest is 1 % of a count's variance
_COARSE, _FLAT = 37, 1e-6  # levels among which the largest total is looked for; relative: a fall that is none


def error_by_causes(sensor: Sensor, capture: Capture) -> float:
    """The relative error of the closed form of the mean, by what events cause; at most.

    An afterpulse in the frame of its parent is no further detection, and by the closed form it may be one. Where all
    detections are counted, the closed form lacks those that are caused by a caused one; by a device's rules it has
    them, and what a cluster of them loses to a dead time is left.
    """
    caused = sum(sensor.caused().values())
    if not capture.counts_events:
        return caused
    solved = sensor.rules == "device" and all(effect.mean_delay() is not None for effect in sensor.at("correlated"))
    return caused**2 * (_CLUSTERED if solved else 1.0)


def closed_form(sensor: Sensor, capture: Capture) -> Callable[[float], float]:
    """The function level -> detections of the whole array, by the effects' closed forms."""
    counts = pixel_counts(sensor, capture)

    @functools.lru_cache(maxsize=4096)
    def detections(level: float) -> float:
        return max(float(counts(level).sum()), 1e-9)

    return detections


def pixel_counts(sensor: Sensor, capture: Capture) -> Callable[[float], np.ndarray]:
    """The function level -> (pixels,) expected detections of each pixel, by the effects' closed forms.

    Nothing is recorded in gaps between frames, and no counter counts beyond its largest count.
    """
    conditions = capture.conditions

    def counts(level: float) -> np.ndarray:
        light = np.full((1, sensor.layout.pixels), level)
        if capture.counts_events:
            candidates, found = sensor.expected(light, conditions.within_frames, capture.modality == "tr")
            made, awake = found[0], np.clip(found[0] / np.maximum(candidates[0], 1e-300), 0.0, 1.0)
        else:
            made = conditions.frames * in_frames(sensor, light, conditions)[0]
        if full is not None:
            mean = made / conditions.count_frames
            if np.any(mean + 10 * np.sqrt(mean) + 10 > full):  # otherwise none is full
                narrowed = None if conditions.counting == "frames" else variance(mean, awake, sensor.extends)
                made = in_counters(mean, full, slots, narrowed) * conditions.count_frames
        return np.asarray(made)

    full, slots = None, math.inf
    if capture.modality == "counts":
        full = sensor.full_counts(conditions)
        if conditions.counting == "frames":
            slots = float(conditions.largest_count)
            full = full if np.any(full < slots) else None  # by itself a sum of binary frames does not pile up
    return counts


def variance(mean: np.ndarray, awake: np.ndarray, extends: bool) -> np.ndarray:
    """The variance of the counts of a pixel with a dead time, (pixels,), in a frame that begins at any time.

    Of a frame of many dead times. Source: Cox, Renewal Theory (1962), ch. 4, with the constant term, and with the beat
    of the frame and the dead time; where events extend this, by the pair correlation of the detections, which is exact.

    Args:
        mean: (pixels,) detections in a frame.
        awake: (pixels,) share of the events that are detected.
        extends: an event within a dead time begins it anew.
    """
    if extends:
        lost = -awake * np.log(np.maximum(awake, 1e-300))  # detections in a dead time
        out = mean * (1 - 2 * lost) + lost**2
    else:
        long = mean * awake**2
        out = long + 1 / 6 + awake**4 / 2 - 2 * awake**3 / 3
        for k in range(1, _BEATS):  # what is nearly periodic has one of two counts
            out = out - np.cos(2 * math.pi * k * mean) / (math.pi * k) ** 2 * np.exp(-2 * (math.pi * k) ** 2 * long)
    part = np.mod(mean, 1.0)
    return np.asarray(np.clip(out, part * (1 - part), mean))  # no whole numbers scatter less


def in_counters(mean: np.ndarray, full: np.ndarray, slots: float, variance: np.ndarray | None = None) -> np.ndarray:
    """The expected counts of counters that stop, E[min(N, full)], (pixels,).

    N is binomial, or Poisson where the slots have no end. With a dead time it scatters less, and is taken as binomial
    with so many slots, broken ones too, that it has its variance.

    Args:
        mean: (pixels,) events in a count frame.
        full: (pixels,) the largest count.
        slots: binary frames in a count frame; inf for a counter.
        variance: (pixels,) of the events in a count frame of a counter; None: Poisson.
    """
    if math.isinf(slots) and variance is not None:
        share = np.clip(1 - variance / np.maximum(mean, 1e-300), _POISSON, 1 - 1e-12)
        number = np.maximum(mean / share, full + 1e-9)
        never = mean / share <= full
        below = np.where(never, 1.0, special.betaincc(full, number - full, share))
        beyond = np.where(never, 0.0, special.betainc(full + 1, number - full, share))
    elif math.isinf(slots):
        below, beyond = special.pdtr(full - 1, mean), special.pdtrc(full, mean)
    else:
        share, never = np.minimum(mean / slots, 1.0), full >= slots
        below = np.where(never, 1.0, stats.binom.cdf(full - 1, slots - 1, share))
        beyond = np.where(never, 0.0, stats.binom.sf(full, slots, share))
    return np.asarray(mean * below + full * beyond)


def in_frames(sensor: Sensor, light: np.ndarray, conditions: Conditions) -> np.ndarray:
    """The expected share of frames with a detection, (images, pixels).

    Args:
        light: (images, pixels) photons/s.
    """
    return np.asarray(-np.expm1(-events_in_frames(sensor, light, conditions)))


def events_in_frames(sensor: Sensor, light: np.ndarray, conditions: Conditions) -> np.ndarray:
    """The expected events in a frame, of which the first is detected, (images, pixels).

    Args:
        light: (images, pixels) photons/s.
        conditions: of so many ticks of each frame, these begin where the sensor's converter counts them from.
    """
    within = conditions.within_frames
    if conditions.live is not None:
        within = replace(conditions, live=max(conditions.live + sensor.origin, 0.0))
    return np.asarray(sensor.expected(light, within, first=True)[0] / conditions.frames)


def most_detections(capture: Capture, pixels: int) -> float:
    """The detections that a capture can hold; inf for time stamps."""
    if capture.modality == "tr":
        return math.inf
    c = capture.conditions
    return float(pixels * (c.count_frames * c.largest_count if capture.modality == "counts" else c.frames))


def level_for(expected: Callable[[float], float], total: float, stated: float | None) -> float:
    """The level at which this total is expected; the stated one where there is none."""
    found = bisection(expected, total, 1e-6, rising_until(expected, 1e-6, 1e12))
    return found if 1e-5 < found < 1e11 else stated or 1.0


def bisection(expected: Callable[[float], float], total: float, low: float, high: float) -> float:
    """The level between `low` and `high` at which this total is expected, to the last digit of a double."""
    middle = math.sqrt(low * high)
    while low < middle < high:
        low, high = (middle, high) if expected(middle) < total else (low, middle)
        middle = math.sqrt(low * high)
    return middle


def rising_until(expected: Callable[[float], float], low: float, high: float) -> float:
    """The level up to which the expected detections rise: `high`, or where they are largest below it."""
    levels = np.geomspace(low, high, _COARSE)
    values = [expected(float(level)) for level in levels]
    top = int(np.argmax(values))
    if values[-1] >= values[top] * (1 - _FLAT):
        return high
    found = optimize.minimize_scalar(
        lambda x: -expected(math.exp(x)),
        bounds=(math.log(levels[max(top - 1, 0)]), math.log(levels[top + 1])),
        method="bounded",
    )
    return math.exp(float(found.x))
