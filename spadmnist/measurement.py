"""Measurements: captures of one sensor under known light, read from a folder, simulated, and written.

A measurement is a folder with `measurement.yaml` and one HDF5 file per capture (`capture_files`). What a model says of
it is a measurement too: the same captures, simulated. A dataset of uniform images opens as one: every image is a
capture of its own, a repetition of the others at its light level.
"""

from __future__ import annotations

import contextlib
import fcntl
import filecmp
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from . import capture_files, config, dataset, disk, document, recording, units
from .document import Document
from .effects import Conditions
from .errors import ConfigError, InputError, SpadError, did_you_mean
from .events import Events, Layout
from .images import Uniform
from .plugins import ByWavelength
from .readout import Recorded
from .recording import MODALITIES, Capture, Light, Recording
from .sensor import Sensor

FORMAT = "spadmnist-measurement/1"
FILE = "measurement.yaml"

_MOST_PIXELS = 1 << 24
_LONGEST = 100  # characters of a name
_DEFAULT_WAVELENGTH = "555 nm"  # where a level is given in lux, which mean light of this colour


@dataclass(repr=False, eq=False)
class Measurement:
    """Captures of one array of pixels.

    layout: rows, columns and places of the pixels; their area is the sensor's to say, and not a number here. captures:
    in the file's order; source: the file or folder, for messages; notes: by capture, what was found odd in its data
    as they were read.
    """

    name: str
    layout: Layout
    captures: tuple[Capture, ...]
    source: str
    _read: Callable[[int, Layout, float], tuple[Recording, list[str]]]
    _places: tuple[str, ...] = ()
    notes: dict[str, list[str]] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Measurement({self.name}: {_size(self.layout)} pixels; {_row([c.id for c in self.captures])})"

    def capture(self, id: str) -> Capture:
        """The capture of that name. Raises InputError with a sentence."""
        return self.captures[self._index(id)]

    def place(self, id: str) -> str:
        """Where a capture is described: `measurement.yaml:7: captures[0]`."""
        index = self._index(id)
        return self._places[index] if self._places else f"{self.source}: {id}"

    def _index(self, id: str) -> int:
        known = [capture.id for capture in self.captures]
        if id not in known:
            raise InputError(f"{self.source}: has no capture {id!r}.{did_you_mean(id, known)} It has {_row(known)}")
        return known.index(id)

    @property
    def rows(self) -> int:
        return self.layout.rows

    @property
    def columns(self) -> int:
        return self.layout.columns

    def recording(self, id: str, of: Sensor | Layout | None = None, dead_time: float = 0.0) -> Recording:
        """The data of a capture. of: the sensor, or its layout and nominal dead time (s), for statistics to know.

        Raises InputError where the file cannot be used, where the sensor has other pixels, and for a capture of which
        only the mean is known.
        """
        if isinstance(of, Sensor):
            layout, dead_time = of.layout, of.nominal_dead_time
        else:
            layout = of or self.layout
        self.check_layout(layout)
        if self.capture(id).mean is not None:
            raise InputError(f"{self.place(id)}: of {id} only the mean is known, there are no data; name its file")
        found, self.notes[id] = self._read(self._index(id), layout, dead_time)
        return found

    def check_sensor(self, sensor: Sensor) -> None:
        """Raise InputError where a sensor has other pixels, or says nothing of a capture's wavelength."""
        self.check_layout(sensor.layout)
        every = {(e.name, name): getattr(e, name) for e in sensor.effects for name in e.parameters}
        tables = {key: value for key, value in every.items() if isinstance(value, ByWavelength)}
        for capture in self.captures:
            for (effect, name), table in tables.items():
                try:
                    if capture.light.wavelength is not None:
                        table.at(capture.light.wavelength)
                except InputError as error:
                    raise InputError(f"{self.place(capture.id)}: {effect}.{name}: {error}") from None

    def check_layout(self, layout: Layout) -> None:
        """Raise InputError where a sensor has other pixels."""
        mine = self.layout
        if layout.shape != mine.shape:
            part = ""
            if mine.rows <= layout.rows and mine.columns <= layout.columns:
                part = (
                    f", or, where a part of the sensor was measured, say which: --crop 0:{mine.rows},0:{mine.columns} "
                    "if it begins at the first row and column (its corner must be put right)"
                )
            raise InputError(
                f"{self.source}: layout has {_size(mine)} pixels, but the sensor {_size(layout)}; correct one of "
                f"them{part}"
            )
        theirs = layout.positions
        if mine.positions is not None and theirs is not None and not np.allclose(theirs, mine.positions, 0, 1e-9):
            raise InputError(f"{self.source}: layout.positions are not those of the sensor; correct one of them")


def _size(layout: Layout) -> str:
    return f"{layout.rows} x {layout.columns}"


def _row(names: Sequence[str]) -> str:
    return ", ".join(names[:12]) + (f", ... ({len(names)} in all)" if len(names) > 12 else "")


def is_measurement(path: str | Path) -> bool:
    """Does a path lead to a measurement's folder or file, rather than to a dataset?"""
    path = Path(path)
    return (path / FILE).exists() if path.is_dir() else path.suffix.lower() in (".yaml", ".yml")


def open(path: str | Path, readout: str | None = None, planned: bool = False) -> Measurement:
    """Open a measurement: its folder, its YAML file, or the folder of a dataset whose source is `uniform`.

    readout: of a dataset, which one to take (`tr`, `str`, `qis` or `counts`), for all of one image show the same
    events; without it the first of them that was recorded. planned: captures whose files are not there yet will do,
    for a simulation asks for their conditions alone (but for those of counts, whose bits the file knows). The headers
    of all files are checked here, data are read when they are asked for. Raises ConfigError with every mistake of the
    YAML, InputError for a file that cannot be used.
    """
    path = Path(path)
    if path.is_dir() and not (path / FILE).exists():
        if (path / dataset.MANIFEST).exists():
            return _of_dataset(path, readout)
        raise InputError(
            f"{path} is not a measurement: it has no {FILE} (spadmnist import makes one of files of other programs)"
        )
    source = document.read(path / FILE if path.is_dir() else path)
    return _Reader(source, path if path.is_dir() else path.parent, planned).measurement()


open_measurement = open  # its name in the package


# --- measurement.yaml ---------------------------------------------------------------------------------------------

Path_ = tuple[Any, ...]

_CLOCK = ("frames", "frame_time", "frame_period")
_EXAMPLES = {
    "format": f"format: {FORMAT}",
    "layout": "layout: {rows: 16, columns: 16}",
    "rows": "rows: 16",
    "columns": "columns: 16",
    "captures": "captures: [{id: dark, file: dark.h5, modality: tr, light: {kind: dark}, exposure: 100 ms}]",
    "id": "id: dark",
    "modality": "modality: tr",
    "light": "light: {kind: dark}",
    "kind": "kind: flat",
    "wavelength": "wavelength: 500 nm",
    "exposure": "exposure: 100 ms",
    "frames": "frames: 1000",
    "frame_time": "frame_time: 10 us",
    "bits": "bits: 8",
}
_UNITS = {"wavelength": "m", "irradiance": "W/m^2", "lux": "lux"}


@dataclass
class _Reader:
    """Reads `measurement.yaml`; every mistake goes to `problems`. base: the folder that files lie in."""

    source: Document
    base: Path
    planned: bool = False
    problems: list[str] = field(default_factory=list)

    def say(self, path: Path_, sentence: str) -> None:
        self.problems.append(f"{self.source.place(path)}: {sentence}")

    def measurement(self) -> Measurement:
        raw = self.source.value
        if not isinstance(raw, Mapping) or not {"format", "captures", "layout"} & set(raw):
            raise ConfigError([f"{self.source.name}: is not a measurement; it begins with {_EXAMPLES['format']}"])
        top = self.group((), raw, ("format", "name", "layout", "captures"), ("format", "layout", "captures"))
        if "format" in top and top["format"] != FORMAT:
            self.say(("format",), f"{_brief(top['format'])} is not a format that this program reads; write {FORMAT}")
        name = self.text(("name",), top.get("name", self.base.resolve().name or "measurement"))
        layout = self.layout(top["layout"]) if "layout" in top else None
        captures = self.captures(top["captures"]) if "captures" in top else []
        if self.problems or layout is None or name is None:
            raise ConfigError(self.problems)
        return self.checked(name, layout, captures)

    def checked(self, name: str, layout: Layout, captures: list[tuple[Capture, Path | None]]) -> Measurement:
        """With what only the files know. The first of them that cannot be used is told in full, others are named."""
        known, wrong = [], []
        for capture, path in captures:
            if path is None or (self.planned and capture.modality != "counts" and not path.exists()):
                known.append(capture)
                continue
            try:
                known.append(capture_files.examine(path, capture, layout.shape))
            except InputError as error:
                wrong.append((path, error))
        if wrong:
            more = ", ".join(path.name for path, _ in wrong[1:4])
            if len(wrong) > 4:
                more += f" and {len(wrong) - 4} more"
            raise InputError(f"{wrong[0][1]}{f'. Nor can {more} be used' if more else ''}")
        paths = [path for _, path in captures]

        def read(index: int, layout: Layout, dead_time: float) -> tuple[Recording, list[str]]:
            path = paths[index]
            assert path is not None
            return capture_files.read(path, captures[index][0], layout, dead_time)

        places = tuple(self.source.place(("captures", i)) for i in range(len(captures)))
        return Measurement(name, layout, tuple(known), self.source.name, read, places)

    # --- parts

    def group(
        self, path: Path_, raw: Any, allowed: Sequence[str], needed: Sequence[str], of: str = ""
    ) -> dict[str, Any]:
        """The entries of a group that may stand there; those that may not, and those that lack, are told."""
        if not isinstance(raw, Mapping):
            self.say(path, f"{_brief(raw)} is not possible; it must be a group of entries ({', '.join(allowed)})")
            return {}
        for key in raw:
            if key not in allowed:
                self.problems.append(
                    f"{self.source.place((*path, key))} is not an entry{of or ' here'}."
                    f"{did_you_mean(str(key), allowed)} Allowed are {', '.join(allowed)}"
                )
        for key in needed:
            if raw.get(key) is None:
                self.say(path, f"{key} is missing; write for example {_EXAMPLES[key]}")
        return {key: value for key, value in raw.items() if key in allowed and value is not None}

    def text(self, path: Path_, raw: Any) -> str | None:
        if isinstance(raw, str) and 0 < len(raw) <= _LONGEST and raw.isprintable() and raw == raw.strip():
            return raw
        hint = f'; write "{raw}"' if isinstance(raw, (int, float)) and not isinstance(raw, bool) else ""
        self.say(path, f"{_brief(raw)} is not a name: a line of 1 to {_LONGEST} characters{hint}")
        return None

    def whole(self, path: Path_, raw: Any, most: int) -> int | None:
        if isinstance(raw, int) and not isinstance(raw, bool) and 1 <= raw <= most:
            return raw
        self.say(path, f"{_brief(raw)} is not possible; it must be a whole number from 1 to {most}")
        return None

    def quantity(self, path: Path_, raw: Any, unit: str, zero: bool = False, most: float = np.inf) -> float | None:
        """A number in SI, more than 0 or, with `zero`, at least 0."""
        try:
            value = units.parse(raw, unit)
        except ValueError as error:
            self.say(path, str(error))
            return None
        if 0 < value <= most or (zero and value == 0):
            return float(value)
        upper = "" if most == np.inf else f" and at most {most:g}"
        self.say(path, f"{value} is not possible; it must be {'at least' if zero else 'more than'} 0{upper}")
        return None

    def layout(self, raw: Any) -> Layout | None:
        path = ("layout",)
        parts = self.group(path, raw, ("rows", "columns", "positions"), ())
        positions = None
        if "positions" in parts:
            file = self.file((*path, "positions"), parts["positions"])
            if file is None:
                return None
            try:
                positions = config.read_positions(file)
            except InputError as error:
                self.say((*path, "positions"), str(error))
                return None
        for key in ("rows", "columns"):
            if key not in parts and positions is None and isinstance(raw, Mapping):
                self.say(path, f"{key} is missing; write for example {_EXAMPLES[key]}")
        sizes = [self.whole((*path, key), parts[key], 100_000) for key in ("rows", "columns") if key in parts]
        if None in sizes or (positions is None and len(sizes) < 2):
            return None
        if positions is not None:
            listed = (1, len(positions))
            given = parts.get("rows", listed[0]), parts.get("columns", listed[1])
            if given != listed:
                self.say(path, f"{len(positions)} positions count as 1 x {len(positions)}, not as {_by(given)} pixels")
                return None
            return Layout(1, len(positions), np.nan, np.nan, positions)
        rows, columns = (int(size) for size in sizes if size is not None)
        if rows * columns > _MOST_PIXELS:
            self.say(path, f"{rows} x {columns} pixels are more than the {_MOST_PIXELS:,} that can be held")
            return None
        return Layout(rows, columns, np.nan, np.nan)

    def captures(self, raw: Any) -> list[tuple[Capture, Path | None]]:
        if not isinstance(raw, list) or not raw:
            self.say(("captures",), f"{_brief(raw)} is not possible; it must be a list with at least one capture")
            return []
        found = [self.capture(("captures", i), one) for i, one in enumerate(raw)]
        for what, key in (("id", "a name"), ("file", "a file")):
            first: dict[Any, int] = {}
            for i, one in enumerate(raw):
                name = one.get(what) if isinstance(one, Mapping) else None
                if isinstance(name, str) and first.setdefault(name, i) != i:
                    self.say(("captures", i, what), f"{name} is that of captures[{first[name]}]; give each {key} once")
        return [one for one in found if one is not None]

    def capture(self, path: Path_, raw: Any) -> tuple[Capture, Path | None] | None:
        before = len(self.problems)
        allowed = ("id", "file", "mean", "modality", "light", "exposure", *_CLOCK, "bits", "counting")
        parts = self.group(path, raw, allowed, ("id", "modality", "light"), " of a capture")
        if not isinstance(raw, Mapping):
            return None
        id = self.text((*path, "id"), parts["id"]) if "id" in parts else None
        modality = parts.get("modality")
        if modality is not None and modality not in MODALITIES:
            hint = did_you_mean(str(modality), MODALITIES)
            self.say((*path, "modality"), f"{_brief(modality)} is not one of {', '.join(MODALITIES)}.{hint}")
            modality = None
        lit = self.light((*path, "light"), parts["light"]) if "light" in parts else None
        file = self.file((*path, "file"), parts["file"]) if "file" in parts else None
        if ("file" in parts) == ("mean" in parts):
            have = "both file and mean" if "file" in parts else "neither file nor mean"
            self.say(path, f"has {have}; write file: NAME.h5, or, where only that is known, mean: 470")
        if modality is None:
            return None
        conditions = self.conditions(path, parts, modality, lit)
        mean = self.mean(path, parts["mean"], modality, conditions) if "mean" in parts and conditions else None
        if len(self.problems) > before:
            return None
        assert id is not None and lit is not None and conditions is not None
        return Capture(id, modality, lit, conditions, mean), file

    def file(self, path: Path_, raw: Any) -> Path | None:
        """A file in the measurement's folder, never one outside."""
        if not isinstance(raw, str) or not raw.strip() or len(raw) > 255 or not raw.isprintable():
            self.say(path, f"{_brief(raw)} is not the name of a file")
            return None
        name = PurePosixPath(raw)
        if name.is_absolute() or ".." in name.parts or "\\" in raw or re.match(r"[A-Za-z]:", raw):
            self.say(
                path, f"{_brief(raw)} leads out of the measurement's folder; put the file there and write its name"
            )
            return None
        found = self.base / name
        if not found.resolve().is_relative_to(self.base.resolve()):
            self.say(path, f"{_brief(raw)} is a link that leads out of the measurement's folder; put the file there")
            return None
        return found

    def light(self, path: Path_, raw: Any) -> Light | None:
        before = len(self.problems)
        uncertain = ("relative_uncertainty", "own_uncertainty")
        lit = ("wavelength", "irradiance", "lux")
        parts = self.group(path, raw, ("kind", *lit, *uncertain), ("kind",))
        kind = parts.get("kind")
        if kind is not None and kind not in ("dark", "flat"):
            hint = did_you_mean(str(kind), ("dark", "flat"))
            self.say((*path, "kind"), f"{_brief(kind)} is not one of dark, flat.{hint}")
        values = {key: self.quantity((*path, key), parts[key], _UNITS[key]) for key in lit if key in parts}
        shares = [self.quantity((*path, k), parts[k], "", True, 1.0) if k in parts else 0.0 for k in uncertain]
        if kind == "dark":
            for key in values:
                self.say((*path, key), "belongs to light, and this capture is dark; take it out, or write kind: flat")
        if "irradiance" in values and "lux" in values:
            self.say(path, "has both irradiance and lux; keep one")
        if kind == "flat" and "wavelength" not in parts and "lux" not in parts:
            self.say(path, f"wavelength is missing; write for example {_EXAMPLES['wavelength']}")
        if len(self.problems) > before or kind is None:
            return None
        relative, own = (float(share or 0.0) for share in shares)
        if kind == "dark":
            return Light(None, None, "irradiance", relative, own)
        wavelength = values.get("wavelength") or float(units.parse(_DEFAULT_WAVELENGTH, "m"))
        level = "lux" if "lux" in values else "irradiance"
        return Light(wavelength, values.get(level), level, relative, own)

    def conditions(self, path: Path_, parts: Mapping[str, Any], modality: str, lit: Light | None) -> Conditions | None:
        before = len(self.problems)
        wavelength = None if lit is None else lit.wavelength
        times = {
            key: self.quantity((*path, key), parts[key], "s")
            for key in ("exposure", "frame_time", "frame_period")
            if key in parts
        }
        if modality == "tr":
            for key in (*_CLOCK, "bits", "counting"):
                if key in parts:
                    self.say((*path, key), "belongs to frames; a tr capture has an exposure")
            if "exposure" not in parts:
                self.say(path, f"exposure is missing; write for example {_EXAMPLES['exposure']}")
            exposure = times.get("exposure")
            if len(self.problems) > before or exposure is None:
                return None
            return Conditions(exposure, 1, exposure, exposure, wavelength)
        for key in ("frames", "frame_time"):
            if key not in parts:
                self.say(path, f"{key} is missing; write for example {_EXAMPLES[key]}")
        frames = self.whole((*path, "frames"), parts["frames"], 10**9) if "frames" in parts else None
        bits, counting = self.counting(path, parts, modality)
        frame_time = times.get("frame_time")
        if len(self.problems) > before or frame_time is None or frames is None:
            return None
        period = times.get("frame_period") or frame_time
        if frame_time > period * (1 + 1e-12):
            self.say(
                (*path, "frame_time"),
                f"{units.show(frame_time, 's')} does not fit into the frame period of {units.show(period, 's')}",
            )
        exposure = times.get("exposure")
        if exposure is not None and abs(exposure - frames * period) > 1e-9 * exposure:
            self.say(
                (*path, "exposure"),
                f"{parts['exposure']} is not frames x frame_period, {units.show(frames * period, 's')}; take it out",
            )
        if bits and counting == "frames" and "mean" in parts and frames % (2**bits - 1):
            self.say((*path, "frames"), f"{frames} binary frames do not fill count frames of {2**bits - 1} each")
        return Conditions(frames * period, frames, frame_time, period, wavelength, bits, counting)

    def counting(self, path: Path_, parts: Mapping[str, Any], modality: str) -> tuple[int, str]:
        """(bits, what a count is), which a file of counts says itself."""
        bits, counting = 0, parts.get("counting", "frames")
        if modality != "counts":
            for key in ("bits", "counting"):
                if key in parts:
                    self.say((*path, key), f"belongs to counts; this is a {modality} capture")
            return 0, "frames"
        if counting not in ("frames", "counter"):
            self.say((*path, "counting"), f"{_brief(counting)} is not one of frames, counter")
        if "bits" in parts:
            bits = self.whole((*path, "bits"), parts["bits"], 16) or 0
        elif "mean" in parts or "counting" in parts:
            self.say(path, f"bits is missing; write for example {_EXAMPLES['bits']}")
        return bits, str(counting)

    def mean(self, path: Path_, raw: Any, modality: str, conditions: Conditions) -> float | None:
        most = np.inf
        if modality in ("qis", "str"):
            most = conditions.frames
        elif modality == "counts":
            most = conditions.count_frames * conditions.largest_count
        return self.quantity((*path, "mean"), raw, "", True, most)


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _by(shape: Iterable[int]) -> str:
    return " x ".join(str(n) for n in shape)


# --- a dataset ----------------------------------------------------------------------------------------------------


def _of_dataset(root: Path, readout: str | None) -> Measurement:
    """Every image of every level is a capture: `5 mlux`, or `5 mlux #0`, `5 mlux #1`, ... where there are several."""
    manifest = dataset.intact_manifest(root)
    experiment = config.build(Document(str(root), manifest["config"]), root)
    uniform = experiment.source
    if not isinstance(uniform, Uniform):
        raise InputError(
            f"{root}: is a dataset of {uniform.describe()}; only one whose source is uniform is a measurement"
        )
    if readout is not None and readout not in experiment.readouts:
        raise InputError(f"{root}: {readout} was not recorded; there are {', '.join(experiment.readouts)}")
    chosen = readout or next(name for name in MODALITIES if name in experiment.readouts)
    stored = dataset.stored(root)
    images = [(level, split, i) for level in experiment.levels for split in stored.splits for i in _each(stored, split)]
    repeated = len(images) > len(experiment.levels)
    conditions = experiment.conditions
    if chosen != "counts":
        conditions = replace(conditions, bits=0, counting="frames")
    if chosen == "tr":
        exposure = conditions.exposure
        conditions = replace(conditions, frames=1, frame_time=exposure, frame_period=exposure)
    captures = []
    for level, _, i in images:
        lit = Light(conditions.wavelength, level.value * uniform.grey / 255, level.kind) if uniform.grey else Light()
        id = f"{level.text} #{i}" if repeated else level.text
        captures.append(Capture(id, chosen, lit, replace(conditions, wavelength=lit.wavelength)))

    def read(index: int, layout: Layout, dead_time: float) -> tuple[Recording, list[str]]:
        level, split, i = images[index]
        part = stored[level.text, split]
        pixels = layout.pixels
        if chosen == "tr":
            recorded = Recorded(pixels, part.tr[i : i + 1])
        elif chosen == "counts":
            tally = part.counts[i]
            recorded = Recorded(pixels, tally=tally.reshape(len(tally), -1).T)
        else:
            recorded = Recorded(pixels, frames=part.frames[i : i + 1])
        return recording.of_image(recorded, 0, captures[index], layout, dead_time), []

    theirs = experiment.sensor.layout
    layout = Layout(theirs.rows, theirs.columns, np.nan, np.nan, theirs.positions)
    return Measurement(experiment.sensor.name or root.name, layout, tuple(captures), str(root), read)


def _each(stored: dataset.Dataset, split: str) -> range:
    return range(len(stored[stored.levels[0], split]))


# --- writing ------------------------------------------------------------------------------------------------------


def write(
    path: str | Path,
    name: str,
    layout: Layout,
    recordings: Iterable[Recording | Capture],
    captures: Sequence[Capture] = (),
) -> Path:
    """Write a measurement: `measurement.yaml` and a file for each recording; its folder.

    recordings: taken one after the other, so that they may be made as they are wanted; a `Capture` with a mean stands
    for itself. captures: those of `recordings`, where they are known beforehand: then the place is looked at before the
    first recording is asked for.

    Every file appears by one rename, `measurement.yaml` last. A file that is there and has the same bytes stays; a
    folder that holds anything else is refused. Raises SpadError where it cannot be written, and for a capture that
    could not be opened again.
    """
    root = Path(path)
    for capture in captures:
        _check_counts(capture)
    if root.exists() and not root.is_dir():
        raise SpadError(f"{root} is a file; choose another place with -o")
    with disk.writing(root, 0):
        root.mkdir(parents=True, exist_ok=True)
    with _alone(root):
        _check_place(root, captures, layout)
        disk.sweep(disk.temporary(root))
        done: list[Capture] = []
        for one in recordings:
            done.append(one if isinstance(one, Capture) else one.capture)
            _check_counts(done[-1])
            if isinstance(one, Recording):
                _commit_recording(root, _files(done)[-1], one)
        if layout.positions is not None:
            _commit(root, _POSITIONS, config.positions_text(layout.positions).encode())
        _check_place(root, done, layout)
        _commit(root, FILE, _yaml(name, layout, done).encode())
        for folder in (disk.temporary(root), disk.temporary(root).parent):
            with contextlib.suppress(OSError):
                folder.rmdir()
    return root


_POSITIONS = "positions.csv"


def _files(captures: Sequence[Capture]) -> list[str]:
    """A file's name for each capture, made from its id; no two the same, whatever the file system thinks of case."""
    names: list[str] = []
    taken: set[str] = set()
    for capture in captures:
        stem = re.sub(r"[^A-Za-z0-9.+-]+", "_", capture.id).strip("_.") or "capture"
        name, n = f"{stem}.h5", 1
        while name.lower() in taken:
            n += 1
            name = f"{stem}-{n}.h5"
        taken.add(name.lower())
        names.append(name)
    return names


@contextlib.contextmanager
def _alone(root: Path) -> Iterator[None]:
    """Hold the folder for writing; the system lets go of it where the process is killed."""
    with disk.writing(root, 0):
        handle = os.open(root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SpadError(f"{root}: another run is writing there; wait for it, or choose another folder") from None
        yield
    finally:
        os.close(handle)


def _check_place(root: Path, captures: Sequence[Capture], layout: Layout) -> None:
    """Refuse a folder that holds anything but parts of this measurement. captures: all of them; none: not known yet."""
    own = disk.temporary(root).parent
    there = set(os.listdir(root)) - {FILE, own.name}
    if own.is_dir():  # a dataset that was begun keeps more there
        there |= {f"{own.name}/{name}" for name in os.listdir(own)} - {f"{own.name}/{disk.temporary(root).name}"}
    if layout.positions is not None:
        there.discard(_POSITIONS)
    known = set(_files(captures))
    strange = sorted(name for name in there if (name not in known if captures else not name.endswith(".h5")))
    if strange:
        raise SpadError(f"{root} is not empty (there is {strange[0]}); choose another folder with -o, or remove it")


def _check_counts(capture: Capture) -> None:
    """Raise InputError where a part of the exposure would be in no count: a count sums 2^bits - 1 binary frames."""
    c = capture.conditions
    if capture.modality == "counts" and c.counting == "frames" and c.frames % c.largest_count:
        raise InputError(
            f"{capture.id}: {c.frames} binary frames do not fill count frames of {c.bits} bits, each the sum of "
            f"{c.largest_count}; take {c.count_frames * c.largest_count or c.largest_count}"
        )


def _commit(root: Path, name: str, data: bytes) -> None:
    final = root / name
    if final.exists():
        if not final.is_file() or final.stat().st_size != len(data) or final.read_bytes() != data:
            raise _another(final)
        return
    disk.commit_file(final, data, disk.temporary(root))


def _commit_recording(root: Path, name: str, one: Recording) -> None:
    """Like `_commit`, written piece by piece."""
    final = root / name
    with disk.writing(final, capture_files.size(one)), disk.workspace(disk.temporary(root)) as work:
        new = work / name
        with new.open("x+b") as file:
            capture_files.write(one, file)
            file.flush()
            os.fsync(file.fileno())
        if not final.exists():
            disk.install(new, final, work / "aside")
        elif not final.is_file() or not filecmp.cmp(new, final, shallow=False):
            raise _another(final)


def _another(final: Path) -> SpadError:
    return SpadError(
        f"{final}: belongs to another measurement, or was made from another sensor or seed; choose another folder "
        f"with -o, or remove {final.parent}"
    )


def _yaml(name: str, layout: Layout, captures: Sequence[Capture]) -> str:
    array: dict[str, Any] = {"rows": layout.rows, "columns": layout.columns}
    if layout.positions is not None:
        array = {"positions": _POSITIONS}
    lines = document.dump({"format": FORMAT, "name": name, "layout": array}) + "captures:\n"
    for capture, file in zip(captures, _files(captures), strict=True):
        entry = document.dump(_entry(capture, file)).splitlines()
        lines += "".join(f"{'    ' if i else '  - '}{line}\n" for i, line in enumerate(entry))
    return lines


def _entry(capture: Capture, file: str) -> dict[str, Any]:
    lit, c = capture.light, capture.conditions
    shown: dict[str, Any] = {"kind": "dark" if lit.dark else "flat"}
    if lit.wavelength is not None:
        shown["wavelength"] = _written(lit.wavelength, "m")
        if lit.level is not None:
            shown[lit.kind_of_level] = _written(lit.level, "lux" if lit.kind_of_level == "lux" else "W/m^2")
    for key in ("relative_uncertainty", "own_uncertainty"):
        if getattr(lit, key):
            shown[key] = getattr(lit, key)
    entry: dict[str, Any] = {"id": capture.id}
    entry |= {"file": file} if capture.mean is None else {"mean": float(capture.mean)}
    entry |= {"modality": capture.modality, "light": shown}
    if capture.modality == "tr":
        return entry | {"exposure": _written(c.exposure, "s")}
    entry |= {"frames": c.frames}
    entry |= {"frame_time": _written(c.frame_time, "s"), "frame_period": _written(c.frame_period, "s")}
    if capture.modality == "counts" and capture.mean is not None:
        entry |= {"bits": c.bits, "counting": c.counting}
    return entry


def _written(value: float, unit: str) -> str:
    """The shortest text that is read back as exactly this number."""
    for digits in (6, 9, 12, 15, 17):
        text = units.show(value, unit, digits)
        if "e" not in text.split()[0] and units.parse(text, unit) == value:
            return text
    return f"{value!r} {unit}"


# --- a first look -------------------------------------------------------------------------------------------------


def intervals(events: Events) -> Iterator[np.ndarray]:
    """s between the detections of a pixel, in pieces."""
    stamps = events.times if events.ticks is None else events.ticks
    tick = events.tick or 1.0
    piece = 1 << 20
    for start in range(0, len(stamps) - 1, piece):
        apart = np.diff(stamps[start : start + piece + 1])
        inside = np.ones(len(apart), bool)
        firsts = events.offsets[np.searchsorted(events.offsets, start + 1) :]
        inside[firsts[firsts <= start + len(apart)] - start - 1] = False
        yield apart[inside] * tick


def look(measurement: Measurement, capture: Capture, recorded: Recording | None) -> dict[str, Any]:
    """Numbers of a capture, for the table and the picture. recorded: its data, None where only the mean is known.

    live: s in which detections could be made; rates: 1/s of live time, as they are recorded. hot: pixels with more than
    five times the median, beyond noise; dead: without a detection where the median pixel has 20 or more (None where
    that cannot be told). shortest_interval: s, within a pixel (TR). ones_share: of a pixel's frames.
    """
    c = capture.conditions
    counted = capture.modality == "counts"
    row: dict[str, Any] = {
        "capture": capture.id,
        "modality": capture.modality,
        "light": _light_text(capture.light),
        "exposure": c.exposure,
        "frames": None if capture.modality == "tr" else c.count_frames if counted else c.frames,
        "frame_time": None if capture.modality == "tr" else c.frame_time,
        "live": c.exposure if capture.modality == "tr" else c.frames * c.frame_time,
        "pixels": measurement.layout.pixels,
        "mean": capture.mean,
        **dict.fromkeys(("detections", "rate_median", "rate_mean", "rate_min", "rate_max", "empty_pixels")),
        **dict.fromkeys(("hot_pixels", "dead_pixels", "ones_share", "shortest_interval")),
        "notes": list(measurement.notes.get(capture.id, [])),
    }
    frames = capture.modality in ("qis", "str")
    if capture.mean is not None:
        row |= {"rate_mean": capture.mean / row["live"], "ones_share": capture.mean / c.frames if frames else None}
    if recorded is None:
        return row
    totals = recorded.totals
    median = float(np.median(totals))
    largest = 5 * median
    rates = np.array([median, totals.mean(), totals.min(), totals.max()]) / row["live"]
    row |= {
        "mean": float(totals.mean()),
        "detections": int(totals.sum()),
        **dict(zip(("rate_median", "rate_mean", "rate_min", "rate_max"), map(float, rates), strict=True)),
        "empty_pixels": int((totals == 0).sum()),
        "hot_pixels": int((totals > largest + 5 * np.sqrt(largest) + 10).sum()),
        "dead_pixels": int((totals == 0).sum()) if median >= 20 else None,
    }
    if frames:
        row["ones_share"] = float(totals.mean() / c.frames)
    if recorded.events is not None:
        shortest = [float(piece.min()) for piece in intervals(recorded.events) if len(piece)]
        row["shortest_interval"] = min(shortest, default=None)
    return row


def _light_text(lit: Light) -> str:
    if lit.wavelength is None:
        return "dark"
    unit = "lux" if lit.kind_of_level == "lux" else "W/m^2"
    level = "level free" if lit.level is None else units.show(lit.level, unit)
    return f"{units.show(lit.wavelength, 'm')}, {level}"
