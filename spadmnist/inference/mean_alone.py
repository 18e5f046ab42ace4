"""The null distribution of a capture of which the mean alone is known: by closed forms, corrected by simulation."""

from __future__ import annotations

import decimal
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from .. import hooks, twin
from ..effects import Conditions, Effect
from ..recording import Capture
from ..sensor import Sensor, factor
from .closed_forms import CLOSED, closed_form, error_by_causes, events_in_frames, level_for
from .light_levels import CaptureNull
from .models import InTheDark
from .replicates import simulated

# events of each of so many recordings of frames, by which the closed form of their mean is corrected: together they
# have the noise of 1e6 counts, 0.1 %, in some tenths of a second
_SHORT, _RECORDINGS = 1.25e5, 8
_MOST = 20.0  # as many times as many are still simulated, where one frame holds them; some seconds, a rule of thumb
_STAMPS = 300  # of a pixel: the first one comes too early by up to a dead time, 0.04 % of all counts at most
_MOMENTS, _PIXELS = 1024, 1024  # moments and pixels over which a curve of the rate is averaged, at most
_FEWEST = 16  # moments of an array that has too many pixels for the others


def of_mean(sensor: Sensor, capture: Capture, total: float, replicates: int) -> tuple[CaptureNull, np.ndarray]:
    """(null distribution of a capture whose mean alone is known, (replicates,) factors on its level).

    It is by the closed forms of the effects, corrected for rates that fluctuate and for effects that do not say what
    they do to the mean. Its scatter is that of the counts, of the last digit of the mean, of the closed forms, and of
    that correction.

    Args:
        total: detections of the whole array.
        replicates: their number.
    """
    dark = capture.light.dark
    stated = 1.0 if dark else twin.photons_at(capture, sensor.layout)
    expected = closed_form(InTheDark.of(sensor) if dark else sensor, capture)
    level = stated if stated is not None else level_for(expected, total, None)
    mean = max(expected(level), 1e-9)
    share = 1.0 if capture.counts_events else 1 - min(mean / sensor.layout.pixels / capture.conditions.frames, 1.0)
    digits, expected_mean = total / sensor.layout.pixels, mean / sensor.layout.pixels
    rounding = last_digit(digits) / math.sqrt(12) / max(digits, expected_mean)
    caused = error_by_causes(sensor, capture)
    apart, unsure = _of_fluctuations(sensor, capture, level) if _is_bent(sensor, capture, level) else (0.0, 0.0)
    scatter = math.sqrt(share / mean + rounding**2 + CLOSED**2 + caused**2 + unsure**2)
    normal = stats.norm.ppf((np.arange(replicates) + 0.5) / replicates)
    order = np.random.Generator(np.random.SFC64(replicates)).permutation(replicates)
    totals = mean * np.exp(apart + scatter * normal[order])
    return CaptureNull(
        level=level, stated=stated, totals=totals, expected=expected, law=(apart, 1.0), scatter=scatter
    ), np.ones(replicates)


def _is_bent(sensor: Sensor, capture: Capture, level: float) -> bool:
    """Whether the closed form of the mean may be wrong.

    Where all detections are counted, the mean rate alone matters, unless a dead time loses a part of them.
    """
    sensor = InTheDark.of(sensor) if capture.light.dark else sensor
    if not sensor.at("arrival") and sensor.states_mean:
        return False
    if not capture.counts_events:
        return True
    return _lost(sensor, capture, level) > CLOSED


def _of_fluctuations(sensor: Sensor, capture: Capture, level: float) -> tuple[float, float]:
    """(log of the mean over that of the closed form, its standard error).

    Of a rate that follows a curve it is the mean over the exposure. Of one that is drawn, and of an effect that does
    not say what it does to the mean, it is that of short recordings.
    """
    sensor = InTheDark.of(sensor) if capture.light.dark else sensor
    curves = [effect for effect in sensor.at("arrival") if hasattr(effect, "factor")]
    apart, c = _of_curves(sensor, curves, capture, level), capture.conditions
    steady = sensor.changed(effects=[effect for effect in sensor.effects if effect not in curves])
    if not steady.at("arrival") and steady.states_mean:
        return apart, 0.0
    if steady.layout.pixels > _PIXELS and c.scene is None:
        steady = _part(steady)
    steady = InTheDark.of(steady) if capture.light.dark else steady
    events = float(steady.expected(np.full((1, steady.layout.pixels), level), c)[0].sum())
    # a pixel begins without a dead time, which must matter to none of many stamps
    least = _SHORT if capture.modality != "tr" else max(_SHORT, _STAMPS * steady.layout.pixels)
    share = min(least / max(events, 1.0), 1.0)
    frames = max(math.ceil(c.frames * share), 1)
    clock = replace(c, frames=frames, exposure=frames * c.frame_period)
    if capture.modality == "tr":
        time = c.exposure * share
        clock = replace(c, exposure=time, frame_time=time, frame_period=time)
    short = replace(capture, mean=None, conditions=clock)
    if not capture.counts_events:  # a sum of frames has as many
        short = replace(short, modality="qis", conditions=replace(clock, bits=0))
    numbers = np.arange(_RECORDINGS, dtype=np.uint64)
    if events * (share if capture.modality == "tr" else frames / c.frames) > _MOST * _SHORT:  # one frame holds so many
        return apart, _lost(steady, capture, level)
    made = simulated(steady, short, np.full(_RECORDINGS, level), numbers, 0)
    logs = np.log([max(float(recording.totals.sum()), 0.5) for recording in made])
    apart += float(logs.mean()) - math.log(closed_form(steady, short)(level))
    return apart, float(np.std(logs, ddof=1)) / math.sqrt(_RECORDINGS)


def _part(sensor: Sensor) -> Sensor:
    """About so many pixels of a sensor as are simulated: whole rows, or a part of the first one."""
    rows, columns = sensor.layout.shape
    some = max(_PIXELS // columns, 1)
    return sensor.cropped(slice(0, min(some, rows)), slice(0, min(columns, _PIXELS)))


def _lost(sensor: Sensor, capture: Capture, level: float) -> float:
    """The share of the events that are not detected: no correction is larger."""
    light = np.full((1, sensor.layout.pixels), level)
    events, counted = (float(part.sum()) for part in sensor.expected(light, capture.conditions, stamped=False))
    return max(1 - counted / max(events, 1.0), 0.0)


def _of_curves(sensor: Sensor, curves: Sequence[Effect], capture: Capture, level: float) -> float:
    """The log of the mean over that of the mean rate, where the rate follows curves."""
    if not curves:
        return 0.0
    c, pixels = capture.conditions.within_frames, sensor.layout.pixels
    light: np.ndarray = np.full((1, pixels), level)
    # hooks of dead times want all pixels
    some, moments = slice(None, None, -(-pixels // _PIXELS)), _MOMENTS
    if capture.counts_events:
        some, moments = slice(None), max(min(_MOMENTS, _MOMENTS * _PIXELS // pixels), _FEWEST)
    rate, lit = (part[0, some] for part in sensor.rates(light, capture.conditions))
    times = sensor.open_moments(c, moments)
    lit_share = lit / np.maximum(rate, 1e-300)
    swing = np.zeros((len(times), 1))
    for kind, share in (("light", lit_share), ("dark", 1 - lit_share)):
        own = [factor(effect, times, capture.conditions) for effect in curves if effect.acts_on == kind]
        if own:
            product = np.prod(own, axis=0)[:, None]
            swing = swing + share * (product / max(product.mean(), 1e-300) - 1)
    factors = np.maximum(1 + swing, 0.0)
    if capture.counts_events:
        # what share of the time a gate is open is the same for both
        open_ = sensor.changed(effects=[effect for effect in sensor.effects if effect not in sensor.at("gate")])
        steady = open_.expected(light, c, stamped=False)[0] / c.live_time
        there, mean = (_counted(sensor, steady * by, c) for by in (factors, np.ones((1, 1))))
    else:
        events = events_in_frames(sensor, light, capture.conditions)[0, some]
        there, mean = -np.expm1(-events * factors), -np.expm1(-events)[None]
    return math.log(float(there.mean(axis=0).sum()) / float(mean.sum()))


def _counted(sensor: Sensor, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
    """The rates behind the dead time, 1/s, in the shape of those before it, (moments, pixels)."""
    for effect in sensor.at("dead_time"):
        rate = hooks.expected(effect, rate, conditions)
    return rate


def last_digit(value: float) -> float:
    """The last decimal place of a number as written: 0.1 of 2.6, 1 of 470."""
    return 10.0 ** int(decimal.Decimal(f"{value:.10g}").as_tuple().exponent)
