"""The model's twin of a measurement: the same captures, as a sensor would have recorded them.

A capture is one image of uniform light. What is too large for the memory is simulated in stretches of frames where
that is exact: where frames do not depend on each other. Others are simulated some pixels after the others, where
nothing ties these together.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from . import bit_planes, light, recording, standing, system, units
from .effects import Conditions
from .errors import InputError
from .events import Layout
from .measurement import Measurement, write
from .readout import Recorded
from .recording import Capture, Recording
from .sensor import Sensor
from .streams import Streams

if TYPE_CHECKING:
    from .factory import Progress

_AT_ONCE = 3e7  # expected events of a capture that is simulated in one go; a larger one in parts, where that is exact
_MOST = 2e9  # in parts


def photons_at(capture: Capture, layout: Layout) -> float | None:
    """Photons/s on a pixel's active area as a capture states its light; 0 in the dark, None where the level is free."""
    lit = capture.light
    if lit.wavelength is None:
        return 0.0
    if lit.level is None:
        return None
    convert = light.photons_from_lux if lit.kind_of_level == "lux" else light.photons_from_irradiance
    return convert(lit.level, layout.active_area, lit.wavelength)


def model_recordings(
    sensor: Sensor,
    capture: Capture,
    photons: float | np.ndarray,
    streams: Streams,
    images: np.ndarray,
    direct: bool = False,
    told: Callable[[float], None] = lambda share: None,
) -> list[Recording]:
    """What the sensor would record in a capture, once for each of `images`.

    photons: photons/s on each pixel's active area: one number, one for each image, or (images, pixels). streams: whose
    draws are taken; images: (n,) uint64, their numbers, one after the other. A capture that would take more memory than
    there should be is simulated in parts where that is exact, and refused where it is not (InputError). direct: draw
    the bits of frames that stand alone without their events, which is faster. told: which share of an image is made,
    each time.
    """
    sensor = sensor.resolved()
    pixels, wanted = sensor.layout.pixels, len(images)
    flux = np.asarray(photons, np.float64)
    flux = np.broadcast_to(flux[:, None] if flux.ndim == 1 else flux, (wanted, pixels))
    if capture.modality == "str" and not sensor.tick:
        raise InputError(f"{capture.id}: STR stamps are whole ticks, and the sensor has no converter; add tdc to it")
    divided = {"str": capture.conditions.frame_time, "tr": capture.conditions.exposure}.get(capture.modality)
    if divided is not None and sensor.tick > divided * (1 + 1e-9):
        raise InputError(
            f"{capture.id}: the ticks of the sensor, {units.show(sensor.tick, 's')}, are longer than the "
            f"{units.show(divided, 's')} that they divide; shorten tdc.resolution, or make the "
            f"{'frame time' if capture.modality == 'str' else 'exposure'} longer"
        )
    if not wanted:
        return []
    brightest = flux[[int(np.argmax(flux.mean(axis=1)))]]
    events = sensor.drawn(brightest, capture.conditions, (capture.modality,))
    large = events > _AT_ONCE or (direct and capture.modality == "qis")
    if large and (whole := _in_parts(sensor, capture, events)):
        return [whole(flux[i], streams.of(images[i : i + 1]), told) for i in range(wanted)]
    if excess := sensor.excess(brightest, capture.conditions, (capture.modality,)):
        raise InputError(
            f"{capture.id}: would hold {excess}; shorten it, or lower its light (frames that do not depend on each "
            "other may be more)"
        )
    # where an effect draws by blocks of images, from the beginning of the block
    before = int(images[0]) % sensor.block
    numbers = np.arange(int(images[0]) - before, int(images[0]) + wanted, dtype=np.uint64)
    around = flux[np.maximum(np.arange(len(numbers)) - before, 0)]
    made = sensor.expose(around, capture.conditions, streams.of(numbers), (capture.modality,))
    told(wanted)
    return [_recording(sensor, made, before + i, capture) for i in range(wanted)]


def _recording(sensor: Sensor, made: Recorded, image: int, capture: Capture) -> Recording:
    return recording.of_image(made, image, capture, sensor.layout, sensor.nominal_dead_time)


def draws_bits(sensor: Sensor, capture: Capture, frames: int = 1) -> bool:
    """Whether the bits of a capture's frames may be drawn without their events; frames: of a stretch of them."""
    return capture.modality == "qis" and standing.by_bits(sensor, capture.conditions, _stretch(capture, frames))


def _stretch(capture: Capture, frames: int) -> Conditions:
    """The conditions of so many of a capture's frames."""
    return replace(capture.conditions, frames=frames, exposure=frames * capture.conditions.frame_period)


_Told = Callable[[float], None]  # which share is made
_Part = Callable[[np.ndarray, Streams, _Told], Recording]


def _in_parts(sensor: Sensor, capture: Capture, events: float) -> _Part | None:
    """How to simulate a large capture part by part; None where its frames depend on each other."""
    c = capture.conditions
    each = c.largest_count if capture.modality == "counts" and c.counting == "frames" else 1
    frames = max(1, int(c.frames // each * _AT_ONCE / max(events, 1.0) / 2)) * each
    if draws_bits(sensor, capture, frames):
        return lambda flux, streams, told: _by_bits(sensor, capture, flux, streams, told)
    if capture.modality == "tr" or events > _MOST or standing.tying(sensor, c, _stretch(capture, frames)):
        return None
    return lambda flux, streams, told: _by_stretches(sensor, capture, flux, streams, frames, told)


def _by_stretches(
    sensor: Sensor, capture: Capture, flux: np.ndarray, streams: Streams, frames: int, told: _Told
) -> Recording:
    """Frames that stand alone, a stretch of them at a time."""
    c, at, tick = capture.conditions, 0, None
    whole = np.empty(0)
    for n, start in enumerate(range(0, c.frames, frames)):
        count = min(frames, c.frames - start)
        part = replace(c, frames=count, exposure=count * c.frame_period)
        own = Streams(streams.seed, f"{streams.level}/stretch {n}", streams.split, streams.images)
        made = sensor.expose(flux[None], part, own, (capture.modality,))
        found = _recording(sensor, made, 0, replace(capture, conditions=part))
        assert found.frames is not None
        stretch = np.asarray(found.frames[:])
        if not start:
            number = c.count_frames if capture.modality == "counts" else c.frames
            whole, tick = np.empty((number, *stretch.shape[1:]), stretch.dtype), found.tick
        whole[at : at + len(stretch)] = stretch
        at += len(stretch)
        told(count / c.frames)
    return Recording(capture, sensor.layout, None, whole, tick, sensor.nominal_dead_time)


def _by_bits(sensor: Sensor, capture: Capture, flux: np.ndarray, streams: Streams, told: _Told) -> Recording:
    """Frames that stand alone and are not stamped."""
    c, (rows, columns) = capture.conditions, sensor.layout.shape
    shape = c.frames, rows, -(-columns // 8)
    if math.prod(shape) > system.memory():
        raise InputError(
            f"{capture.id}: its {c.frames:,} frames of {rows} x {columns} pixels take "
            f"{math.prod(shape) / 2**30:,.0f} GiB, more memory than there is; shorten it"
        )
    out = np.empty(shape, np.uint8)
    for row, bits in standing.bits(sensor, c, flux, streams):
        count = len(bits) // columns
        out[:, row : row + count] = bit_planes.frames_first(bits, c.frames, count, columns)
        told(count / rows)
    return Recording(capture, sensor.layout, None, out, None, sensor.nominal_dead_time)


def twin(
    sensor: Sensor, measurement: Measurement, seed: int = 0, progress: Progress | None = None
) -> Iterator[Recording | Capture]:
    """The measurement's captures as the sensor would have recorded them, one after the other; a mean for a mean.

    Every capture draws numbers of its own, named by its id: it is the same whichever others there are. Raises
    InputError before the first one where the sensor has other pixels or a light level is free.
    """
    sensor = sensor.resolved()
    measurement.check_sensor(sensor)
    fluxes = []
    for capture in measurement.captures:
        flux = photons_at(capture, sensor.layout)
        if flux is None:
            raise InputError(
                f"{measurement.place(capture.id)}: the light level of {capture.id} is free; to simulate it, write one "
                "in light, for example irradiance: 120 nW/cm^2"
            )
        fluxes.append(flux)
    return _twins(sensor, measurement, fluxes, seed, progress)


def _twins(
    sensor: Sensor, measurement: Measurement, fluxes: list[float], seed: int, progress: Progress | None
) -> Iterator[Recording | Capture]:
    images = np.zeros(1, np.uint64)
    work = [_work(sensor, *one) for one in zip(measurement.captures, fluxes, strict=True)]
    if progress is not None:
        progress.start("simulating", sum(map(sum, work)), 0.0)
    for capture, flux, (drawing, writing) in zip(measurement.captures, fluxes, work, strict=True):

        def told(work: float, share: float, id: str = capture.id) -> None:
            if progress is not None:
                progress.advance(work * share, id)

        streams = Streams(seed, f"capture/{capture.id}", "simulate", images)
        drawn, written = functools.partial(told, drawing), functools.partial(told, writing)
        (made,) = model_recordings(sensor, capture, flux, streams, images, told=drawn)
        if capture.mean is not None:
            yield replace(capture, mean=float(made.totals.mean()))
        elif made.frames is not None:
            yield made.watched(written)
        else:
            yield made
            written(1.0)


def _work(sensor: Sensor, capture: Capture, flux: float) -> tuple[float, float]:
    """About how long it takes to draw a capture, and to write it: as long as so many events take to be drawn.

    Measured: an event is packed as fast as it is drawn, and so are four bytes of frames, or four bits that are drawn by
    themselves.
    """
    c, pixels = capture.conditions, sensor.layout.pixels
    drawn = written = float(sensor.expected(np.full((1, pixels), flux), c)[0].sum())
    if capture.modality != "tr":
        size = {"qis": c.frames / 8, "str": 4.0 * c.frames}.get(capture.modality, c.count_frames)
        written = pixels * size / 4
    if capture.modality == "qis" and drawn > _AT_ONCE:
        ones = -np.expm1(-drawn / (pixels * c.frames))
        drawn = pixels * c.frames * min(ones, 1 - ones) / 4
    return drawn, 0.0 if capture.mean is not None else written


def simulate(
    sensor: Sensor, measurement: Measurement, out: str | Path, seed: int = 0, progress: Progress | None = None
) -> Path:
    """Write the model's twin of a measurement: the same captures, simulated."""
    made = twin(sensor, measurement, seed, progress)
    return write(out, measurement.name, sensor.layout, made, measurement.captures)
