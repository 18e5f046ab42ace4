"""Flux images of a measurement: one for each capture and method, from what was recorded.

The formulas are those of `reconstruct`, which sees sums of each pixel. Here stands how a recording gives these sums,
which methods it allows, and what they are told of it. Counts of frames are taken as detections N.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import disk, pictures, reconstruct, units
from .errors import InputError, SpadError
from .factory import Progress
from .importers.captures import safe_name
from .look import light_text
from .measurement import Measurement
from .readout import Recorded, summarised
from .reconstruct import Settings
from .recording import Capture, Recording
from .sensor import Sensor

SHEET = "sheet.png"
_LARGEST = 1 << 30  # bytes of a file that is compared with what would be written there
_MOST_CAPTURES = 16  # of the sheet
_CELL = 4.0, 3.3  # inches of the sheet for an image, its scale and its words
_NAMED = 12  # captures in a sentence
# modality -> the readout whose methods it allows, and what it gives of `Recorded`
_GIVES: dict[str, tuple[str, tuple[str, ...]]] = {
    "tr": ("tr", ("counts", "span")),
    "str": ("str", ("ones", "waited")),
    "qis": ("qis", ("ones",)),
    "counts": ("tr", ("counts",)),
}


@dataclass(frozen=True)
class Flux:
    """The image of a capture by one method.

    values: (rows, columns) float32; unit: photons/s, detections/s where the PDP is not told, or that of the method;
    saturated: pixels in which a rule of the method stands in for its formula; settings: what the method was told.
    """

    capture: Capture
    method: str
    unit: str
    values: np.ndarray
    saturated: int
    settings: Settings


@dataclass(frozen=True)
class Fluxes:
    """The images of a measurement, capture after capture. notes: what was left out or assumed, each a sentence."""

    measurement: Measurement
    images: tuple[Flux, ...]
    notes: tuple[str, ...]

    @property
    def names(self) -> list[str]:
        """A file's name for each image, `<capture>.<method>.npy`; no two the same, whatever the case."""
        stems: dict[str, str] = {}
        for image in self.images:
            if image.capture.id not in stems:
                stems[image.capture.id] = safe_name(image.capture.id, list(stems.values()))
        return [f"{stems[image.capture.id]}.{image.method}.npy" for image in self.images]

    def rows(self) -> list[dict[str, Any]]:
        """Numbers of each image. pdp: q; dead_time: s; time: T, s; the others over the pixels, in `unit`."""
        return [
            {
                "capture": image.capture.id,
                "modality": image.capture.modality,
                "method": image.method,
                "unit": image.unit,
                "mean": _number(image.values.mean(dtype=np.float64)),
                "median": _number(np.median(image.values)),
                "min": _number(image.values.min()),
                "max": _number(image.values.max()),
                "saturated_pixels": image.saturated,
                "pdp": image.settings.pdp,
                "dead_time": image.settings.dead_time,
                "time": image.settings.exposure,
                "file": name,
            }
            for image, name in zip(self.images, self.names, strict=True)
        ]


def _number(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None


# --- the images ---------------------------------------------------------------------------------------------------


def allowed(modality: str) -> list[str]:
    """The methods that captures of a modality allow."""
    readout, columns = _GIVES[modality]
    methods = {name: reconstruct.find(name) for name in reconstruct.Method.registry}
    return [n for n, m in methods.items() if m.readouts() == (readout,) and set(m.columns) <= set(columns)]


def of_measurement(
    measurement: Measurement,
    methods: Sequence[str] = (),
    sensor: Sensor | None = None,
    progress: Progress | None = None,
) -> Fluxes:
    """Flux images of all captures that have data.

    methods: by name; without them all that a capture's modality allows. sensor: whose nominal PDP at the capture's
    wavelength and nominal dead time the methods are told; without one they are 1 and 0 s. A dark capture has no
    wavelength: its PDP is 1. Raises InputError with a sentence: for a method that no capture allows, for a sensor with
    other pixels, and where its PDP is not known at a wavelength, or 0; KeyError for a method that is not there.
    """
    with_data = [capture for capture in measurement.captures if capture.mean is None]
    if not with_data:
        raise InputError(f"{measurement.source}: of its captures only means are known, of which no image can be made")
    chosen, notes = _chosen(measurement, with_data, tuple(dict.fromkeys(methods)))
    if sensor is not None:
        sensor = sensor.resolved()
        measurement.check_sensor(sensor)
    told = {capture.id: _pdp(measurement, capture, sensor) for capture, _ in chosen}
    progress = progress or Progress()
    progress.start("reconstructing", len(chosen), 0.0)
    images = []
    for capture, names in chosen:

        def read(share: float, id: str = capture.id) -> None:
            progress.advance(share, id)

        recorded = measurement.recording(capture.id, sensor)
        settings = _settings(recorded, told[capture.id], sensor)
        sums = _sums(recorded.watched(read))
        if recorded.frames is None:
            read(1.0)
        for name in names:
            method = reconstruct.find(name)
            values, saturated = method.image(sums, settings)
            unit = method.unit
            if unit == "1/s":
                unit = "detections/s" if sensor is None or capture.light.dark else "photons/s"
            shaped = values.reshape(measurement.layout.shape)
            images.append(Flux(capture, name, unit, shaped, saturated, settings))
    progress.stop()
    notes += _assumed(images, sensor)
    return Fluxes(measurement, tuple(images), tuple(notes))


def _chosen(
    measurement: Measurement, captures: Sequence[Capture], methods: Sequence[str]
) -> tuple[list[tuple[Capture, list[str]]], list[str]]:
    """(the captures with the methods of each, what is left out)."""
    possible = {modality: allowed(modality) for modality in dict.fromkeys(c.modality for c in captures)}
    known = "; ".join(f"{modality} captures allow {', '.join(names)}" for modality, names in possible.items())
    notes = []
    without = [c.id for c in measurement.captures if c.mean is not None]
    if without:
        notes.append(f"left out, for only the mean is known: {_listed(without)}")
    for name in methods:
        reconstruct.find(name)
        other = [c for c in captures if name not in possible[c.modality]]
        if len(other) == len(captures):
            raise InputError(f"{measurement.source}: no capture allows {name}; {known}")
        if other:
            modalities = ", ".join(dict.fromkeys(c.modality for c in other))
            notes.append(f"left out for {name}, for {modalities} does not allow it: {_listed([c.id for c in other])}")
    chosen = [(c, [n for n in methods or possible[c.modality] if n in possible[c.modality]]) for c in captures]
    return [(capture, names) for capture, names in chosen if names], notes


def _pdp(measurement: Measurement, capture: Capture, sensor: Sensor | None) -> float:
    wavelength = capture.light.wavelength
    if sensor is None or wavelength is None:
        return 1.0
    pdp = sensor.nominal_pdp(wavelength)
    if pdp <= 0:
        raise InputError(
            f"{measurement.place(capture.id)}: the sensor's PDP at {units.show(wavelength, 'm')} is 0, and no "
            "detection tells of photons; correct it, or leave the sensor out"
        )
    return pdp


def _settings(recorded: Recording, pdp: float, sensor: Sensor | None) -> Settings:
    c = recorded.conditions
    time = c.exposure if recorded.modality == "tr" else c.frames * c.frame_time
    dead_time = 0.0 if sensor is None else sensor.nominal_dead_time
    return Settings(pdp, time, dead_time, recorded.tick or 0.0, c.frames, c.frame_time)


def _sums(recorded: Recording) -> Recorded:
    """The sums of each pixel that methods see, and no streams."""
    pixels = recorded.pixels
    if recorded.events is not None:
        made = summarised(pixels, recorded.events, None)
        return Recorded(pixels, counts=made.counts, span=made.span)
    if recorded.modality == "counts":
        return Recorded(pixels, counts=recorded.totals)
    if recorded.modality == "qis":
        return Recorded(pixels, ones=recorded.totals)
    c, none = recorded.conditions, recorded.none
    assert recorded.tick is not None
    ones, ticks = np.zeros(pixels, np.int64), np.zeros(pixels, np.int64)
    for _, part in recorded.chunks():
        stamps = part.reshape(len(part), -1)
        seen = stamps < none
        ones += seen.sum(axis=0)
        ticks += np.where(seen, stamps, 0).sum(axis=0, dtype=np.int64)
    return Recorded(pixels, ones=ones, waited=ticks * recorded.tick + (c.frames - ones) * c.frame_time)


def _assumed(images: Sequence[Flux], sensor: Sensor | None) -> list[str]:
    rates = [image for image in images if image.unit == "detections/s"]
    if sensor is None:
        return ["no sensor was given: q is 1, the dead time 0, and rates are detections/s"] if rates else []
    dark = list(dict.fromkeys(image.capture.id for image in rates))
    return [f"no light fell on the sensor, so q is 1 and rates are detections/s: {_listed(dark)}"] if dark else []


def _listed(ids: Sequence[str]) -> str:
    return ", ".join(ids[:_NAMED]) + (f" and {len(ids) - _NAMED} more" if len(ids) > _NAMED else "")


# --- files --------------------------------------------------------------------------------------------------------


def place_of(measurement: Measurement) -> Path:
    """The folder of the images where none is named: in the current one, after the measurement."""
    return Path(f"{safe_name(measurement.name)}-flux")


def check_place(folder: Path) -> None:
    """Raise SpadError with a sentence where no images may be put, so that it can be said before the work is done."""
    if folder.exists() and not folder.is_dir():
        raise SpadError(f"{folder} is a file, but images need a folder; choose another name with -o")
    disk.check_outside(folder / SHEET)


def write(found: Fluxes, folder: Path) -> Path:
    """Write the images, one file each, and their sheet into a folder, made if it is not there; the folder.

    Every file is there as a whole or not at all. One that is there with the same bytes stays; where one has others,
    nothing is written at all. Raises SpadError then, as `check_place` does, and where a file cannot be written.
    """
    check_place(folder)
    files = {}
    for name, image in zip(found.names, found.images, strict=True):
        buffer = io.BytesIO()
        np.save(buffer, image.values)
        files[name] = buffer.getvalue()
    files[SHEET] = sheet(found)
    missing = [name for name, data in files.items() if not _is_there(folder / name, data)]
    for name in missing:
        disk.put_file(folder / name, files[name])
    return folder


def _is_there(path: Path, data: bytes) -> bool:
    """Does a file have these bytes already? Raises SpadError where it has others."""
    if not (path.is_symlink() or path.exists()):
        return False
    try:
        same = disk.read_file(path, _LARGEST) == data
    except OSError:
        same = False
    if not same:
        raise SpadError(
            f"{path}: is there already and is another image; nothing was written: choose another folder with -o, or "
            "remove it"
        )
    return True


def sheet(found: Fluxes) -> bytes:
    """A PNG with a row for each capture (the first 16) and a column for each method.

    Grey from 0, black, to the largest value or, where hot pixels would leave the rest in the dark, to less.
    """
    captures = list({image.capture.id: image.capture for image in found.images}.values())
    methods = list(dict.fromkeys(image.method for image in found.images))
    shown = captures[:_MOST_CAPTURES]
    width, height = 0.5 + _CELL[0] * len(methods), 0.6 + _CELL[1] * len(shown)
    room = {"left": 0.6 / width, "right": 1 - 0.5 / width, "bottom": 0.6 / height, "top": 1 - 1.0 / height}
    by_place = {(image.capture.id, image.method): image for image in found.images}

    def draw(figure: Any) -> None:
        rest = f", {len(shown)} of {len(captures)} captures" if len(shown) < len(captures) else ""
        figure.set_facecolor(pictures.PAGE)
        figure.suptitle(
            f"{pictures.words(found.measurement.name[:80])}: flux images{rest}", fontsize=13, y=1 - 0.2 / height
        )
        cells = figure.subplots(
            len(shown), len(methods), squeeze=False, gridspec_kw={**room, "wspace": 0.3, "hspace": 0.4}
        )
        for row, capture in zip(cells, shown, strict=True):
            for axes, method in zip(row, methods, strict=True):
                if (image := by_place.get((capture.id, method))) is None:
                    axes.set_axis_off()
                else:
                    _draw(axes, found.measurement, image)

    return pictures.png(width, height, draw, fitted=False)


def _draw(axes: Any, measurement: Measurement, image: Flux) -> None:
    values = image.values.ravel().astype(np.float64)
    white, brighter = pictures.white_of(measurement.layout, values)
    id = image.capture.id
    words = (
        f"{pictures.words(id if len(id) <= 32 else f'{id[:29]}...')}: {image.method}\n{light_text(image.capture.light)}"
    )
    if brighter:
        largest = values.max()
        words += f"; brighter: {brighter:,}, up to {largest:{',.0f' if largest >= 1000 else '.4g'}}"
    axes.set_title(words, loc="left")
    # of a number without a unit, what it counts
    what = image.unit if image.unit != "1" else reconstruct.find(image.method).summary().partition(":")[0].strip(".")
    pictures.draw_map(axes, measurement.layout, values, 0.0, white, what[:1].lower() + what[1:], "gray")
    axes.set_facecolor(pictures.PAGE)
