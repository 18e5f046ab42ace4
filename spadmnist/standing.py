"""Frames that stand alone: where no frame depends on another, their bits are drawn without the avalanches.

A frame has a detection with the chance 1 - exp(-rate * frame time), in each pixel and frame independently.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from . import hooks, kernels
from .readout import Frames, Recorded, summarised
from .streams import Streams, beginning

if TYPE_CHECKING:
    from .effects import Conditions, Effect
    from .sensor import Sensor

_DRAWS_AT_ONCE = 4e6  # expected draws of the rows that are drawn together: 70 MB


def tying(sensor: Sensor, conditions: Conditions, part: Conditions) -> str | None:
    """What ties the frames together, so that no stretch of them may be simulated by itself; None where nothing does.

    conditions: of all frames; part: of a stretch of them. Frames are also tied where they are not alike.
    """
    carrying = [e for e in sensor.at("dead_time") if hasattr(e, "carried") and e.carried() > 0]
    blinding = _blinding(sensor, conditions)
    for effect in (*sensor.at("arrival"), *sensor.at("correlated"), *carrying, *blinding, *sensor.uncounted):
        return effect.name
    one = np.ones((1, sensor.layout.pixels))
    both = zip(sensor.rates(one, conditions), sensor.rates(one, part), strict=True)
    if not all(np.array_equal(*rates) for rates in both):
        return "a rate that depends on the exposure"
    # a gate must open in each frame as in the first
    n = 4096
    within = (np.arange(n) * 0.6180339887498949 % 1) * conditions.frame_period
    frame = np.arange(n) * conditions.frames // n
    times = frame * conditions.frame_period + within
    gates: list[Any] = list(sensor.at("gate"))
    return next((e.name for e in gates if not np.array_equal(e.open(within, part), e.open(times, conditions))), None)


def _blinding(sensor: Sensor, conditions: Conditions) -> list[Effect]:
    """The effects that leave a pixel blind, or half awake, from one frame of a counter to the next.

    A counter is read at the end of a frame, and its pixel goes on. Where the rules let nothing fire between frames, it
    is awake again in the next one if the gap is as long as all that lasts.
    """
    if conditions.counting != "counter" or not conditions.bits:
        return []
    lasting = {e: hooks.awake_after(e) for e in sensor.soft}
    longest = float(sensor.dead_times.max(initial=0.0))
    gap = conditions.frame_period - conditions.frame_time if sensor.rules == "device" else 0.0
    if gap >= longest + max(lasting.values(), default=0.0):
        return []
    pixels = sensor.layout.pixels
    blind = [e for e in sensor.at("dead_time") if hasattr(e, "blind_time") and np.any(hooks.blind_time(e, pixels) > 0)]
    return [*blind, *(e for e, time in lasting.items() if time > 0)]


def by_bits(sensor: Sensor, conditions: Conditions, part: Conditions) -> bool:
    """Whether the bits of frames may be drawn without their events: nothing ties the frames, and each is live whole.

    Args:
        conditions: of all frames.
        part: of a stretch of them.
    """
    return not sensor.at("gate") and tying(sensor, conditions, part) is None


def bits(
    sensor: Sensor, conditions: Conditions, photons: np.ndarray, streams: Streams
) -> Iterator[tuple[int, np.ndarray]]:
    """(first row, (pixels of some rows, ceil(frames / 8)) uint8, most significant bit first) of one image.

    photons: (pixels,) photons/s; streams: of the image. The frames with a detection are those in which a Poisson
    process has an event; where most have one, those without are drawn in the same way.
    """
    c, (rows, columns) = conditions, sensor.layout.shape
    mean = sensor.rates(photons[None], c)[0][0] * c.frame_time  # detections of a frame
    dense = mean > np.log(2)
    mean[dense] = -np.log1p(-np.exp(-mean[dense]))
    step = max(1, int(rows * _DRAWS_AT_ONCE / (mean.sum() * c.frames + 1)))
    for row in range(0, rows, step):
        some = slice(row * columns, min(row + step, rows) * columns)
        key = streams.key(f"bits/row {row}")
        one = mean[None, some].copy()
        times, offsets = kernels.arrivals(one, float(c.frames), streams.images, key, beginning(1))
        found, _ = kernels.frame_readout(times, offsets, c.frames, 1.0, 1.0, np.empty(len(times) + 1))
        found[dense[some]] ^= np.uint8(0xFF)
        if c.frames % 8:
            found[:, -1] &= np.uint8(0xFF << (8 - c.frames % 8) & 0xFF)
        yield row, found


def recorded(sensor: Sensor, conditions: Conditions, photons: np.ndarray, streams: Streams) -> Recorded:
    """One image whose only readout is QIS; see `bits`."""
    c, (rows, columns) = conditions, sensor.layout.shape
    out = np.empty((rows * columns, -(-c.frames // 8)), np.uint8)
    for row, found in bits(sensor, c, photons, streams):
        out[row * columns : row * columns + len(found)] = found
    frames = Frames(out, None, c.frames, c.frame_time, rows * columns)
    return summarised(rows * columns, None, frames)
