"""Measurements in memory: captures described in SI units, and their data from arrays.

flat = Capture("flat", "qis", wavelength=500e-9, irradiance=0.75, frames=4000, frame_time=10e-6)
real = Measurement.from_arrays(sensor.layout, {flat: frames})
real["flat"].frames
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import recording as recordings
from .. import units
from ..effects import Conditions
from ..errors import InputError, did_you_mean
from ..events import Events, Layout
from ..readout import no_detection, unsigned_for
from ..recording import MODALITIES, Light, Recording
from ..tiles import Tiles
from .entries import MOST_FRAMES, check_name

if TYPE_CHECKING:
    from .type import Measurement

_LUX_WAVELENGTH = 555e-9  # m, of light in lux where no wavelength is stated
_FINE = 1e-12  # s: times in single precision that are known so well are taken where no tick is stated
_WHOLE = 0.01  # ticks by which a time may miss a whole one: what is lost in a double, with room
_MOST_BITS = 16  # of a count


def Capture(
    id: str,
    modality: str,
    *,
    wavelength: float | None = None,
    irradiance: float | None = None,
    lux: float | None = None,
    dark: bool = False,
    exposure: float | None = None,
    frames: int | None = None,
    frame_time: float | None = None,
    frame_period: float | None = None,
    tick: float | None = None,
    bits: int | None = None,
    counting: str = "frames",
    relative_uncertainty: float = 0.0,
    own_uncertainty: float = 0.0,
) -> recordings.Capture:
    """A capture: its light and its clock. SI units.

    Args:
        id: its name.
        modality: `"tr"` (needs `exposure`), `"str"`, `"qis"` or `"counts"` (need `frames` and `frame_time`; counts
            need `bits`).
        wavelength: m. irradiance: W/m^2 on the sensor; or lux (555 nm unless the wavelength is stated). Without either
            the level is free. dark: no light falls on the sensor.
        exposure, frame_time, frame_period: s; the period is the frame time unless it is stated.
        tick: s, of the time stamps. bits: of a count, 1 to 16. counting: `"frames"` (a count is the sum of 2^bits - 1
            binary frames, which `frames` counts) or `"counter"` (of detections).
        relative_uncertainty, own_uncertainty: standard deviation of the light's calibration, common to all captures,
            and of this one (relative).

    Raises:
        InputError: what is missing, contradicts itself or is no such number, in one sentence.
    """
    if modality not in MODALITIES:
        raise _wrong(id, f"{modality!r} is not a modality; those are {', '.join(MODALITIES)}.", modality, MODALITIES)
    check_name(id, "Capture")
    if not isinstance(dark, bool | np.bool_):
        raise _wrong(id, f"dark is {dark!r}; it is True or False")
    if modality != "counts" and counting != "frames":
        raise _wrong(id, f"counting means nothing for {modality.upper()}; leave it out")
    if modality in ("qis", "counts"):
        _none(id, modality, tick=tick)
    times = {"exposure": exposure, "frame_time": frame_time, "frame_period": frame_period, "tick": tick}
    for name, value in {"wavelength": wavelength, **times}.items():
        if value is not None and not (_number(value) and value > 0):
            raise _wrong(id, f"{name} is {value!r}; it is more than 0, in {'m' if name == 'wavelength' else 's'}")
    for name, value in times.items():
        _check_time(id, name, value)
    shares = {"relative_uncertainty": relative_uncertainty, "own_uncertainty": own_uncertainty}
    for name, value in {"irradiance": irradiance, "lux": lux}.items():
        if value is not None and not (_number(value) and value > 0):
            raise _wrong(id, f"{name} is {value!r}; it is more than 0; a capture without light has dark=True")
    for name, value in shares.items():
        if not (_number(value) and 0 <= value < 1):
            raise _wrong(id, f"{name} is {value!r}; it is a share from 0 to less than 1, 0.05 for 5 %")
    if wavelength is not None and not units.WAVELENGTHS[0] <= wavelength <= units.WAVELENGTHS[1]:
        raise _wrong(id, f"wavelength is {wavelength!r} m; give it in m, 500e-9 for 500 nm")
    light = _light(id, wavelength, irradiance, lux, dark, relative_uncertainty, own_uncertainty)
    if modality == "tr":
        _none(id, modality, frames=frames, frame_time=frame_time, frame_period=frame_period, bits=bits)
        if exposure is None:
            raise _wrong(id, "a TR capture needs its exposure, in s; give exposure=0.1")
        clock = exposure, 1, exposure, exposure, light.wavelength
        return recordings.Capture(id, modality, light, Conditions(*clock), tick=tick)
    if frames is None or frame_time is None:
        raise _wrong(id, f"{modality.upper()} needs frames and frame_time (s); give frames=1000, frame_time=10e-6")
    if not _number(frames) or int(frames) != frames or not 0 < frames <= MOST_FRAMES:
        raise _wrong(id, f"frames is {frames!r}; it is a whole number from 1 to {MOST_FRAMES:g}")
    period = frame_time if frame_period is None else frame_period
    if frame_time > period * (1 + 1e-12):
        raise _wrong(id, f"frame_time {frame_time!r} s does not fit into the frame_period {period!r} s")
    whole = int(frames) * period
    _check_time(id, "frames x frame_period", whole)
    if exposure is not None and abs(exposure - whole) > 1e-9 * whole:
        raise _wrong(id, f"exposure {exposure!r} s is not frames x frame_period, {whole:g} s; leave it out")
    clock = whole, int(frames), frame_time, period, light.wavelength
    if modality != "counts":
        _none(id, modality, bits=bits)
        return recordings.Capture(id, modality, light, Conditions(*clock), tick=tick if modality == "str" else None)
    if bits is None or not _number(bits) or int(bits) != bits or not 1 <= bits <= _MOST_BITS:
        raise _wrong(id, f"bits is {bits!r}; of a count it is a whole number from 1 to {_MOST_BITS}")
    if counting not in ("frames", "counter"):
        raise _wrong(id, f"counting is {counting!r}; it is 'frames' or 'counter'")
    conditions = Conditions(*clock, int(bits), counting)
    if counting == "frames" and conditions.frames % conditions.largest_count:
        raise _wrong(
            id,
            f"{frames} binary frames do not fill count frames of {conditions.largest_count} each; take "
            f"{conditions.count_frames * conditions.largest_count or conditions.largest_count}",
        )
    return recordings.Capture(id, modality, light, conditions)


def _light(
    id: str,
    wavelength: float | None,
    irradiance: float | None,
    lux: float | None,
    dark: bool,
    common: float,
    own: float,
) -> Light:
    lit = {"wavelength": wavelength, "irradiance": irradiance, "lux": lux}
    given = [name for name, value in lit.items() if value is not None]
    if dark:
        if given:
            raise _wrong(id, f"has both dark and {given[0]}; keep one")
        return Light(None, None, "irradiance", common, own)
    if irradiance is not None and lux is not None:
        raise _wrong(id, "has both irradiance and lux; keep one")
    if not given:
        raise _wrong(
            id,
            "says nothing of its light; give dark=True, wavelength (m) and irradiance (W/m^2), or "
            "wavelength alone where the level is not known",
        )
    if wavelength is None and lux is None:
        raise _wrong(id, "has an irradiance and no wavelength; give wavelength=500e-9 (m)")
    colour = _LUX_WAVELENGTH if wavelength is None else float(wavelength)
    if lux is not None:
        return Light(colour, float(lux), "lux", common, own)
    return Light(colour, None if irradiance is None else float(irradiance), "irradiance", common, own)


def _check_time(id: str, name: str, value: float | None) -> None:
    if value is not None and not units.SHORTEST <= value <= units.LONGEST:
        raise _wrong(id, f"{name} is {value!r} s; a time is from {units.SHORTEST:g} s to {units.LONGEST:g} s")


def _none(id: str, modality: str, **given: Any) -> None:
    for name, value in given.items():
        if value is not None:
            raise _wrong(id, f"{name} means nothing for {modality.upper()}; leave it out")


def _number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and math.isfinite(value)


def _wrong(id: object, text: str, word: str = "", known: Sequence[str] = ()) -> InputError:
    hint = did_you_mean(word, known) if known else ""
    return InputError(f"Capture {id!r}: {text}{hint}")


# ---- data -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, repr=False)
class Data:
    """What one capture recorded: `events` of TR, `frames` of QIS, STR and counts.

    Attributes:
        recording: the same as the statistics see it, its QIS frames packed.
    """

    recording: Recording

    @property
    def capture(self) -> recordings.Capture:
        """How it was made: modality, light, conditions."""
        return self.recording.capture

    @property
    def events(self) -> Events:
        """TR: the detections, `spadmnist.Events` with a row a pixel and times in s. Raises InputError for frames."""
        if self.recording.events is None:
            raise InputError(f"{self.capture.id}: holds frames, not events; read .frames")
        return self.recording.events

    @cached_property
    def frames(self) -> np.ndarray:
        """(M, rows, columns): QIS 0 or 1 (uint8), counts (unsigned), STR ticks (unsigned, `none` for no detection).

        Raises InputError for TR.
        """
        if self.recording.frames is None:
            raise InputError(f"{self.capture.id}: holds events, not frames; read .events")
        stored = np.asarray(self.recording.frames[:])
        if self.recording.modality != "qis":
            return stored
        return np.unpackbits(stored, axis=2, count=self.recording.layout.columns)

    @property
    def none(self) -> int:
        """The tick of an STR frame without a detection."""
        return self.recording.none

    @property
    def counts(self) -> np.ndarray:
        """(rows, columns) detections of each pixel over the capture (of frames: those that have one)."""
        return self.recording.totals.reshape(self.recording.layout.shape)

    @property
    def tiles(self) -> Tiles:
        """The tiles of the chart that was seen: `.tiles.cut(image)`, `.tiles.labels`. Raises InputError without any."""
        shown = self.capture.light.scene
        if shown is None or shown.tiles is None:
            raise InputError(
                f"{self.capture.id}: says nothing of tiles; a capture of a chart names their file, light: {{kind: "
                "image, file: chart.npy, tiles: chart.json}, and simulate writes it of a chart's dataset"
            )
        return shown.tiles

    def __repr__(self) -> str:
        c, total = self.recording.conditions, int(self.recording.totals.sum())
        frames = "" if self.recording.frames is None else f"{self.recording.n_frames} frames, "
        rows, columns = self.recording.layout.shape
        return (
            f"{self.capture.id}: {self.capture.modality.upper()}, {rows} x {columns} pixels, {frames}"
            f"{units.show(c.exposure, 's')}, {total} detections"
        )


def measurement_of(layout: Layout, arrays: Mapping[recordings.Capture, Any], name: str) -> Measurement:
    """See `Measurement.from_arrays`."""
    check_name(name, "name")
    if not isinstance(layout, Layout):
        raise InputError(f"layout is {_kind(layout)}; it is a spadmnist.Layout, that of a sensor: sensor.layout")
    if not isinstance(arrays, Mapping):
        raise InputError(f"arrays is {_kind(arrays)}; it is a dictionary, {{Capture(...): frames}}")
    made: list[Recording] = []
    for capture, data in arrays.items():
        if not isinstance(capture, recordings.Capture):
            raise InputError(f"{capture!r} is not a capture; the keys are spadmnist.Capture(...)")
        if capture.id in [one.capture.id for one in made]:
            raise _wrong(capture.id, "is there twice; give each capture a name of its own")
        made.append(_recorded(capture, layout, data))
    if not made:
        raise InputError("a measurement needs a capture; give {Capture(...): frames}")
    return in_memory(name, layout, made)


def in_memory(name: str, layout: Layout, made: Sequence[Recording | recordings.Capture]) -> Measurement:
    """A measurement of recordings that lie in memory; a capture with a mean stands for itself."""
    from .type import Measurement

    captures = tuple(one if isinstance(one, recordings.Capture) else one.capture for one in made)

    def read(index: int, layout: Layout, dead_time: float) -> tuple[Recording, list[str]]:
        one = made[index]
        assert isinstance(one, Recording)
        return dataclasses.replace(one, layout=layout).beside(dead_time), []

    return Measurement(name, layout, captures, name, read)


def _recorded(capture: recordings.Capture, layout: Layout, data: Any) -> Recording:
    if capture.modality == "tr":
        return _stamps(capture, layout, data)
    frames, (rows, columns) = _array(capture.id, data), layout.shape
    c = capture.conditions
    many = c.count_frames if capture.modality == "counts" else c.frames
    if frames.shape != (many, rows, columns):
        raise _wrong(
            capture.id,
            f"has an array of shape {frames.shape}, not (frames, rows, columns), ({many}, {rows}, {columns}) by its "
            "Capture",
        )
    if capture.modality == "qis":
        if frames.dtype.kind not in "buif" or not np.all((frames == 0) | (frames == 1)):
            raise _wrong(capture.id, "holds values other than 0 and 1; binary frames are 0 or 1")
        return Recording(capture, layout, None, np.packbits(frames.astype(np.uint8), axis=2))
    if capture.modality == "counts":
        if frames.dtype.kind not in "uif" or not np.all((frames >= 0) & (frames <= c.largest_count)):
            raise _wrong(capture.id, f"holds values that are no counts of {c.bits} bits, 0 to {c.largest_count}")
        if frames.dtype.kind == "f" and np.any(frames != np.rint(frames)):
            raise _wrong(capture.id, "holds counts that are no whole numbers")
        return Recording(capture, layout, None, frames.astype(np.uint16 if c.largest_count > 255 else np.uint8))
    return _first_stamps(capture, layout, frames)


def _array(id: str, data: Any) -> np.ndarray:
    if np.ma.is_masked(data):
        raise _wrong(id, "has masked entries, which are no data; leave them out, or fill them (array.filled)")
    try:
        found = np.asarray(data)
        return found.astype(found.dtype.newbyteorder("="), copy=False)  # as kernels are compiled for
    except ValueError:
        raise _wrong(id, "has lists of several lengths; give an array") from None


def _kind(value: object) -> str:
    return f"of type {type(value).__name__}"


def _first_stamps(capture: recordings.Capture, layout: Layout, frames: np.ndarray) -> Recording:
    if capture.tick is None:
        raise _wrong(capture.id, "first stamps are whole ticks; give the Capture its tick (s)")
    time, tick = capture.conditions.frame_time, capture.tick
    none = no_detection(time, tick)
    if frames.dtype.kind == "f":
        late = np.isneginf(frames) | (np.isfinite(frames) & (frames > time * (1 + 1e-9)))
        if late.any():
            raise _wrong(
                capture.id,
                f"has stamps of {frames[late][0]:g} s, and a frame takes {time:g} s; give seconds (float) or ticks "
                f"(integers); {time:g} s, nan or inf is no detection",
            )
        absent = ~np.isfinite(frames) | (frames >= time * (1 - 1e-12))
        ticks = np.where(absent, none, _ticks(capture.id, np.where(absent, 0.0, frames), tick))
    elif frames.dtype.kind in "ui":
        ticks = frames.astype(np.int64)
    else:
        raise _wrong(capture.id, f"has an array of {frames.dtype}; give seconds (float) or ticks (integers)")
    if ticks.size and not 0 <= ticks.min() <= ticks.max() <= none:
        raise _wrong(capture.id, f"has stamps outside a frame, 0 to {none} ticks of {tick:g} s ({none}: none)")
    return Recording(capture, layout, None, ticks.astype(unsigned_for(none, "time stamps")), tick)


def _stamps(capture: recordings.Capture, layout: Layout, data: Any) -> Recording:
    if not (isinstance(data, tuple | list) and len(data) == 2):
        raise _wrong(capture.id, "a TR capture needs (times, pixels): two arrays of the same length")
    times, pixels = (_array(capture.id, part) for part in data)
    if times.ndim != 1 or pixels.shape != times.shape:
        raise _wrong(capture.id, f"times have shape {times.shape}, pixels {pixels.shape}; both are (detections,)")
    if pixels.dtype.kind not in "ui" and pixels.size:
        raise _wrong(capture.id, f"pixels are {pixels.dtype}; they are whole numbers, row by row")
    if not pixels.size:  # of an empty list numpy makes floats
        pixels = pixels.astype(np.int64)
    if pixels.size and not 0 <= pixels.min() <= pixels.max() < layout.pixels:
        raise _wrong(capture.id, f"has pixels {pixels.min()} to {pixels.max()}; there are 0 to {layout.pixels - 1}")
    end, tick, whole = capture.conditions.exposure, capture.tick, times.dtype.kind in "ui"
    if not whole and times.dtype.kind != "f":
        raise _wrong(capture.id, f"times are {times.dtype}; give seconds (float) or ticks (integers)")
    if whole and tick is None:
        raise _wrong(capture.id, "times are whole ticks; give the Capture its tick (s), or times in s (float)")
    if not whole and times.dtype.itemsize < 8:
        coarse = float(np.spacing(np.abs(times).max())) if times.size else 0.0
        if coarse > (tick or _FINE) / 2:
            least = units.show(coarse, "s", 2)
            raise _wrong(capture.id, f"times are {times.dtype}, which says no less than {least} apart; give float64")
    times = times if whole else times.astype(np.float64, copy=False)
    seconds = times * float(tick or 1.0) if whole else times
    if times.size and not (np.isfinite(seconds).all() and seconds.min() >= 0 and seconds.max() < end):
        first, last = units.show(float(seconds.min()), "s"), units.show(float(seconds.max()), "s")
        raise _wrong(
            capture.id, f"has times from {first} to {last}, outside the exposure of {units.show(end, 's')}; times are s"
        )
    ticks = times if whole else None if tick is None else _ticks(capture.id, times, tick)
    order = np.lexsort((seconds, pixels))
    offsets = np.concatenate([[0], np.cumsum(np.bincount(pixels, minlength=layout.pixels))]).astype(np.int64)
    if ticks is None:
        return Recording(capture, layout, Events(seconds[order], offsets, layout.pixels, end=end))
    stored = ticks[order].astype(unsigned_for(no_detection(end, float(tick or 1.0)), "time stamps"))
    return Recording(capture, layout, Events(None, offsets, layout.pixels, stored, tick, end=end), None, tick)


def _ticks(id: str, seconds: np.ndarray, tick: float) -> np.ndarray:
    exact = seconds / tick
    ticks = np.rint(exact)
    if ticks.size and np.abs(exact - ticks).max() > _WHOLE + 4 * float(np.spacing(np.abs(exact)).max()):
        raise _wrong(id, f"has times that are no whole ticks of {tick:g} s; give the tick that they have, or none")
    return ticks.astype(np.int64)
