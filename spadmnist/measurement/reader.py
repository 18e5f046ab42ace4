"""Reads `measurement.yaml`: every mistake at once, each with its line; then what the files of its captures declare."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from .. import capture_files, disk, document, kinds, manifest, manifest_file, scene, tiles, units
from ..document import Document, Path_, path_of
from ..effects import Conditions
from ..errors import ConfigError, InputError
from ..events import MOST_PIXELS, Layout
from ..foreign import from_json
from ..positions import read_positions
from ..recording import Capture, Light, Recording
from ..scene import Scene
from ..tiles import Tiles
from ..validated import Reader
from .entries import EXAMPLES, FILE, SECTIONS, Array, Counts, Dark, Entry, Flat, Frames, Image, Stamps
from .of_dataset import of_dataset
from .type import Measurement, without_file

_LARGEST_TILES = 1 << 26  # bytes of a file of tiles: a million of them
_DEFAULT_WAVELENGTH = "555 nm"  # of a scene, and where a level is given in lux, which mean light of this colour


def is_measurement(path: str | Path) -> bool:
    """Does a path lead to a measurement's folder or file, rather than to a dataset?"""
    path = Path(path)
    return (path / FILE).exists() if path.is_dir() else path.suffix.lower() in (".yaml", ".yml")


def open(path: str | Path, readout: str | None = None, planned: bool = False) -> Measurement:
    """Open a measurement: its folder, its YAML file, or the folder of a dataset of uniform light or a chart.

    readout: of a dataset, which one to take (`tr`, `str`, `qis` or `counts`), for all of one image show the same
    events; without it the first of them that was recorded. planned: captures that have no file yet will do, whether
    they name one or not, for a simulation asks for their conditions alone; counts then state their bits. The headers of
    all files are checked here, data are read when they are asked for. Raises ConfigError with every mistake of the
    YAML, InputError for a file that cannot be used.
    """
    path = path_of(path, "a measurement")
    folder, file = (path, path / FILE) if path.is_dir() else (path.parent, path)
    if path.is_dir() and not file.exists():
        if (path / manifest_file.MANIFEST).exists():
            return of_dataset(path, readout)
        raise InputError(
            f"{path} is not a measurement: it has no {FILE} (spadmnist import makes one of files of other programs)"
        )
    if path.is_dir() and not file.is_file():
        raise InputError(f"{file} is no file; a measurement is described in a YAML file of that name")
    if kinds.is_data(file):
        raise InputError(f"{file} is no measurement: {kinds.of_data(file)}")
    return _Reader(document.read(file), folder, [], file, planned).measurement()


@dataclass
class _Reader(Reader):
    """Reads `measurement.yaml`. base: the folder that files lie in; file: itself."""

    file: Path = Path(FILE)
    planned: bool = False

    examples: ClassVar[Mapping[str, str]] = EXAMPLES

    def measurement(self) -> Measurement:
        raw = self.source.value
        kind = kinds.described(raw)
        if kind != kinds.MEASUREMENT_KIND and not (not kind and isinstance(raw, Mapping) and "layout" in raw):
            this = f", and this is {kind}; name the folder or the YAML file of a measurement" if kind else ""
            raise ConfigError([f"{self.source.name}: is not a measurement; it begins with {EXAMPLES['format']}{this}"])
        raw = {key: value for key, value in raw.items() if value is not None or key not in SECTIONS}
        parts = self.sections(raw, SECTIONS, {"name": self.base.resolve().name or "measurement"})
        layout = self.layout(parts.get("layout"), raw.get("layout"))
        captures = self.captures(parts.get("captures", []), layout)
        if self.problems or layout is None:
            raise ConfigError(self.problems)
        return self.checked(parts["name"], layout, captures)

    def checked(self, name: str, layout: Layout, captures: list[tuple[Capture, Path | None]]) -> Measurement:
        """With what only the files know. The first of them that cannot be used is told in full, others are named."""
        known, wrong = [], []
        for capture, path in captures:
            if path is None or (self.planned and not os.path.exists(path)):
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
            text = f"{wrong[0][1]}{f'. Nor can {more} be used' if more else ''}"
            absent = [capture.id for capture, path in captures if path is not None and not os.path.lexists(path)]
            if absent:
                fill = f"spadmnist import FILE --capture {absent[0]} -o {shlex.quote(str(self.base))}"
                text += f". What is not there yet is imported by:  {fill}"
            raise InputError(text)
        paths = tuple(path for _, path in captures)

        def read(index: int, layout: Layout, dead_time: float) -> tuple[Recording, list[str]]:
            path = paths[index]
            assert path is not None
            return capture_files.read(path, captures[index][0], layout, dead_time)

        places = tuple(self.source.place(("captures", i)) for i in range(len(captures)))
        return Measurement(name, layout, tuple(known), self.source.name, read, places, self.base, self.file, paths)

    # --- parts

    def layout(self, array: Array | None, raw: Any) -> Layout | None:
        path = ("layout",)
        if isinstance(raw, Mapping) and raw.get("positions") is None:
            for key in ("rows", "columns"):
                if raw.get(key) is None:
                    self.say(path, self.missing(key))
        if array is None:
            return None
        if array.positions is not None:
            try:
                positions = read_positions(self.base / array.positions)
            except InputError as error:
                self.say((*path, "positions"), str(error))
                return None
            listed = 1, len(positions)
            if (given := (array.rows or 1, array.columns or len(positions))) != listed:
                size = f"{_by(listed)}, not as {_by(given)} pixels; take rows and columns out"
                self.say(path, f"{len(positions)} positions count as {size}")
            return Layout(*listed, np.nan, np.nan, positions)
        if array.rows is None or array.columns is None:
            return None
        if array.rows * array.columns > MOST_PIXELS:
            size = _by((array.rows, array.columns))
            self.say(path, f"{size} pixels are more than the {MOST_PIXELS:,} that can be held; give fewer")
        return Layout(array.rows, array.columns, np.nan, np.nan)

    def captures(self, raw: list[Any], layout: Layout | None) -> list[tuple[Capture, Path | None]]:
        found = [self.capture(("captures", i), one, layout) for i, one in enumerate(raw)]
        for what, key in (("id", "a name"), ("file", "a file")):
            first: dict[Any, int] = {}
            for i, one in enumerate(raw):
                name = one.get(what) if isinstance(one, Mapping) else None
                if not isinstance(name, str):
                    continue
                same = disk.identity(self.base / name) if what == "file" and name.isprintable() else name
                if (at := first.setdefault(same, i)) != i:
                    is_file = "" if raw[at][what] == name else f"the same file as {raw[at][what]}, "
                    self.say(("captures", i, what), f"{name} is {is_file}that of captures[{at}]; give each {key} once")
        return [one for one in found if one is not None]

    def capture(self, path: Path_, raw: Any, layout: Layout | None) -> tuple[Capture, Path | None] | None:
        """A capture and its file, or None after its mistakes were noted."""
        before = len(self.problems)
        entry = self.valid(Entry, raw, path)
        if isinstance(raw, Mapping):
            self.check_parts(path, {key: value for key, value in raw.items() if value is not None})
        if entry is None:
            return None
        lit = _light(entry.light)
        if isinstance(entry.light, Image):
            lit = replace(lit, scene=self.scene((*path, "light"), entry.light, layout))
        conditions = replace(_conditions(entry, lit.wavelength), scene=lit.scene)
        self.check_clock(path, entry, conditions)
        if len(self.problems) > before:
            return None
        mean = None if entry.mean is None else float(entry.mean)
        return Capture(entry.id, entry.modality, lit, conditions, mean), entry.file and self.base / entry.file

    def scene(self, path: Path_, entry: Image, layout: Layout | None) -> Scene | None:
        """The scene of a file in the folder, with its tiles; None after its mistakes were noted."""
        try:
            found = scene.read(self.base / entry.file)
        except InputError as error:
            self.say((*path, "file"), str(error))
            return None
        if layout is not None and found.shape != layout.shape:
            has = f"{_by(found.shape)} pixels, but the layout {_by(layout.shape)}"
            self.say((*path, "file"), f"the scene {entry.file} has {has}; give an image of the sensor's size")
        return found if entry.tiles is None else replace(found, tiles=self.tiles(path, entry.tiles, found.shape))

    def tiles(self, path: Path_, name: str, shape: tuple[int, int]) -> Tiles | None:
        """The tiles of a file in the folder, on a chart of `shape`; None after its mistakes were noted."""
        file = self.base / name
        try:
            facts = from_json(disk.read_file(file, _LARGEST_TILES))
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            self.say((*path, "tiles"), f"{file}: cannot be read ({reason}); the tiles of a chart are a JSON file")
            return None
        told = Reader(Document(str(file), facts), self.base)
        if told.valid(manifest.TileFacts, facts, ()) is not None:
            manifest.check_tiles(facts, shape, (), told)
        self.problems += told.problems
        return None if told.problems else tiles.of_facts(facts, shape)

    def check_parts(self, path: Path_, raw: Mapping[str, Any]) -> None:
        """Which entries stand beside each other, whatever they say."""
        file = raw.get("file")
        if "file" in raw and "mean" in raw:
            self.say(path, "has both file and mean; keep one")
        elif file is None and "mean" not in raw and not self.planned:
            self.say(path, without_file(self.file, raw.get("id")))
        if raw.get("modality") == "counts" and "bits" not in raw:
            coming = self.planned and not (isinstance(file, str) and os.path.exists(self.base / file))
            if {"mean", "counting"} & set(raw) or coming:
                self.say(path, self.missing("bits"))
        lit = raw.get("light")
        if not isinstance(lit, Mapping) or lit.get("kind") not in ("flat", "image"):
            return
        has = {key for key in ("wavelength", "irradiance", "lux") if lit.get(key) is not None}
        if {"irradiance", "lux"} <= has:
            self.say((*path, "light"), "has both irradiance and lux; keep one")
        if lit["kind"] == "flat" and not {"wavelength", "lux"} & has:
            self.say((*path, "light"), self.missing("wavelength"))

    def check_clock(self, path: Path_, entry: Stamps | Frames | Counts, conditions: Conditions) -> None:
        """What can only be said of several numbers together."""
        c, most = conditions, np.inf
        if isinstance(entry, Frames | Counts):
            if c.frame_time > c.frame_period * (1 + 1e-12):
                period = units.show(c.frame_period, "s")
                self.say(
                    (*path, "frame_time"),
                    f"{entry.frame_time} does not fit into the frame period of {period}; shorten it",
                )
            if entry.exposure is not None and abs(entry.exposure - c.exposure) > 1e-9 * entry.exposure:
                whole = units.show(c.exposure, "s")
                self.say((*path, "exposure"), f"{entry.exposure} is not frames x frame_period, {whole}; take it out")
            if c.exposure > units.LONGEST:
                whole = f"{c.exposure:g} s"
                self.say((*path, "frames"), f"frames x frame_period is {whole}; it is at most {units.LONGEST:g} s")
            most = c.frames
        if isinstance(entry, Counts):
            # a file says itself whether its frames are counted, or those that they sum
            if entry.file is None and c.bits and c.counting == "frames" and c.frames % c.largest_count:
                whole = f"take {c.count_frames * c.largest_count or c.largest_count}"
                sums = f"{c.frames} binary frames do not fill count frames of {c.largest_count} each; {whole}"
                self.say((*path, "frames"), sums)
            most = c.count_frames * c.largest_count if c.bits else np.inf
        if entry.mean is not None and entry.mean > most:
            self.say((*path, "mean"), f"{entry.mean} is not possible; it must be at least 0 and at most {most:g}")


def _light(lit: Dark | Flat | Image) -> Light:
    uncertain = float(lit.relative_uncertainty or 0.0), float(lit.own_uncertainty or 0.0)
    if isinstance(lit, Dark):
        return Light(None, None, "irradiance", *uncertain)
    wavelength = float(lit.wavelength or units.parse(_DEFAULT_WAVELENGTH, "m"))
    if lit.lux is not None:
        return Light(wavelength, float(lit.lux), "lux", *uncertain)
    return Light(wavelength, None if lit.irradiance is None else float(lit.irradiance), "irradiance", *uncertain)


def _conditions(entry: Stamps | Frames | Counts, wavelength: float | None) -> Conditions:
    if isinstance(entry, Stamps):
        exposure = float(entry.exposure)
        return Conditions(exposure, 1, exposure, exposure, wavelength)
    frame_time = float(entry.frame_time)
    period = float(entry.frame_period or frame_time)
    clock = entry.frames * period, entry.frames, frame_time, period, wavelength
    if isinstance(entry, Counts):
        return Conditions(*clock, entry.bits or 0, entry.counting or "frames")
    return Conditions(*clock)


def _by(shape: Iterable[int]) -> str:
    return " x ".join(str(n) for n in shape)
