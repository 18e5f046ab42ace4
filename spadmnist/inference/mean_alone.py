"""The null distribution of a capture of which the mean alone is known: by closed forms, corrected for fluctuations."""

from __future__ import annotations

import decimal
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from .. import twin
from ..effects import Effect
from ..recording import Capture
from ..sensor import Sensor
from .closed_forms import CLOSED, closed_form, error_by_causes, events_in_frames, level_for
from .light_levels import CaptureNull
from .models import InTheDark
from .replicates import simulated

# events of each of so many recordings of frames, by which the closed form of their mean is corrected: together they
# have the noise of 1e6 counts, 0.1 %, in some tenths of a second
_SHORT, _RECORDINGS = 1.25e5, 8
_MOMENTS, _PIXELS = 1024, 1024  # moments and pixels over which a curve of the rate is averaged, at most


def of_mean(sensor: Sensor, capture: Capture, total: float, replicates: int) -> tuple[CaptureNull, np.ndarray]:
    """(null distribution of a capture whose mean alone is known, (replicates,) factors on its level).

    It is by the closed forms of the effects, corrected for rates that fluctuate where the capture has frames. Its
    scatter is that of the counts, of the last digit of the mean, of the closed forms, and of that correction.

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
    apart, unsure = (
        (0.0, 0.0) if capture.counts_events or not sensor.at("arrival") else _of_fluctuations(sensor, capture, level)
    )
    scatter = math.sqrt(share / mean + rounding**2 + CLOSED**2 + caused**2 + unsure**2)
    normal = stats.norm.ppf((np.arange(replicates) + 0.5) / replicates)
    order = np.random.Generator(np.random.SFC64(replicates)).permutation(replicates)
    totals = mean * np.exp(apart + scatter * normal[order])
    return CaptureNull(
        level=level, stated=stated, totals=totals, expected=expected, law=(apart, 1.0), scatter=scatter
    ), np.ones(replicates)


def _of_fluctuations(sensor: Sensor, capture: Capture, level: float) -> tuple[float, float]:
    """(log of the share of frames with a detection over that of a steady rate, its standard error).

    Of a rate that follows a curve it is the mean over the exposure; of one that is drawn, that of short recordings.
    """
    sensor = InTheDark.of(sensor) if capture.light.dark else sensor
    curves = [effect for effect in sensor.at("arrival") if hasattr(effect, "factor")]
    drawn = [effect for effect in sensor.at("arrival") if not hasattr(effect, "factor")]
    apart, c = _of_curves(sensor, curves, capture, level), capture.conditions
    if not drawn:
        return apart, 0.0
    steady = sensor.changed(effects=[effect for effect in sensor.effects if effect not in curves])
    steady = InTheDark.of(steady) if capture.light.dark else steady
    events = float(steady.expected(np.full((1, sensor.layout.pixels), level), c)[0].sum())
    frames = max(math.ceil(c.frames * min(_SHORT / max(events, 1.0), 1.0)), 1)
    clock = replace(c, frames=frames, exposure=frames * c.frame_period, bits=0)
    short = replace(capture, modality="qis", mean=None, conditions=clock)  # a sum of frames has as many
    numbers = np.arange(_RECORDINGS, dtype=np.uint64)
    made = simulated(steady, short, np.full(_RECORDINGS, level), numbers, 0)
    logs = np.log([max(float(recording.totals.sum()), 0.5) for recording in made])
    apart += float(logs.mean()) - math.log(closed_form(steady, short)(level))
    return apart, float(np.std(logs, ddof=1)) / math.sqrt(_RECORDINGS)


def _of_curves(sensor: Sensor, curves: Sequence[Effect], capture: Capture, level: float) -> float:
    """The log of the share of frames with a detection over that of the mean rate, where the rate follows curves."""
    if not curves:
        return 0.0
    light: np.ndarray = np.full((1, sensor.layout.pixels), level)
    some = slice(None, None, -(-sensor.layout.pixels // _PIXELS))
    rate, lit = (part[0, some] for part in sensor.rates(light, capture.conditions))
    events = events_in_frames(sensor, light, capture.conditions)[0, some]
    times = capture.conditions.within_frames.moments(_MOMENTS)
    swing = np.zeros((_MOMENTS, 1))
    for effect in curves:
        factor: np.ndarray = np.ravel(effect.factor(times, capture.conditions))[:, None]  # type: ignore[attr-defined]
        share = lit / np.maximum(rate, 1e-300) if effect.acts_on == "light" else 1.0
        swing = swing + share * (factor / factor.mean() - 1)
    there = -np.expm1(-events * np.maximum(1 + swing, 0.0))
    return math.log(float(there.mean(axis=0).sum()) / float(-np.expm1(-events).sum()))


def last_digit(value: float) -> float:
    """The last decimal place of a number as written: 0.1 of 2.6, 1 of 470."""
    return 10.0 ** int(decimal.Decimal(f"{value:.10g}").as_tuple().exponent)
