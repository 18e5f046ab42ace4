"""The type: captures of one array of pixels, whose data are read when they are asked for."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .. import units
from ..document import path_of
from ..errors import InputError, did_you_mean
from ..events import Layout
from ..foreign import html_table, quoted
from ..plugins import ByWavelength
from ..recording import Capture, Recording
from ..sensor import Sensor
from .arrays import Data, measurement_of
from .entries import FILE


@dataclass(repr=False, eq=False)
class Measurement:
    """Captures of one array of pixels. `measurement["flat"]` is the data of one; iteration gives their names.

    Attributes:
        name: of the measurement.
        layout: rows, columns and places of the pixels; their area is the sensor's to say, and not a number here.
        captures: how each was made, in the file's order.
        source: the file or folder, for messages.
        folder, file: where it was read from; file is None for a dataset.
        notes: by capture, what was found odd in its data as they were read.
    """

    name: str
    layout: Layout
    captures: tuple[Capture, ...]
    source: str
    _read: Callable[[int, Layout, float], tuple[Recording, list[str]]]
    _places: tuple[str, ...] = ()
    folder: Path | None = None
    file: Path | None = None
    _paths: tuple[Path | None, ...] = ()  # of the captures' files; none of a dataset
    notes: dict[str, list[str]] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Measurement({self.name}: {_size(self.layout)} pixels; {_row([c.id for c in self.captures])})"

    @classmethod
    def from_arrays(cls, layout: Layout, arrays: Mapping[Capture, Any], name: str = "measurement") -> Measurement:
        """A measurement of arrays in memory.

        Args:
            layout: of the sensor, `sensor.layout`.
            arrays: the data of each `spadmnist.Capture`. QIS, STR and counts: (M, rows, columns); QIS 0 or 1, counts
                unsigned, STR seconds (float; not a number, or the frame time: no detection) or ticks (integers). TR:
                (times, pixels), both (detections,), in any order: seconds (float) or ticks (integers), and pixels
                counted row by row.
            name: of the measurement.

        Raises:
            InputError: where the arrays are not what their captures say.
        """
        return measurement_of(layout, arrays, name)

    def save(self, folder: str | Path) -> Path:
        """Write it as `measurement.yaml` and a file for each capture; the folder. Raises SpadError as `write` does."""
        from .writer import write

        folder = path_of(folder, "the folder to write to")
        data = (c if c.mean is not None else self.recording(c.id) for c in self.captures)
        return write(folder, self.name, self.layout, data, self.captures)

    def __getitem__(self, id: str) -> Data:
        """The data of a capture. Raises InputError as `recording` does."""
        return Data(self.recording(id))

    def __iter__(self) -> Iterator[str]:
        """The names of the captures."""
        return iter([capture.id for capture in self.captures])

    def __len__(self) -> int:
        return len(self.captures)

    def _repr_html_(self) -> str:
        rows = [[c.id, c.modality, _light_of(c), units.show(c.conditions.exposure, "s")] for c in self.captures]
        head = ["capture", "modality", "light", "exposure"]
        return html_table(f"{self.name}: {_size(self.layout)} pixels", head, rows)

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
        """Rows of pixels."""
        return self.layout.rows

    @property
    def columns(self) -> int:
        """Columns of pixels."""
        return self.layout.columns

    @property
    def missing(self) -> tuple[str, ...]:
        """The captures of a plan that have yet to be recorded: neither their data are there nor a mean."""
        pairs = zip(self.captures, self._paths, strict=False)
        return tuple(c.id for c, path in pairs if c.mean is None and not (path and os.path.exists(path)))

    def file_name(self, id: str) -> str | None:
        """The name of a capture's file in the folder, as the YAML says it; None where it says none."""
        path = self._paths[self._index(id)] if self._paths else None
        return None if path is None or self.folder is None else path.relative_to(self.folder).as_posix()

    def recording(self, id: str, of: Sensor | Layout | None = None, dead_time: float = 0.0) -> Recording:
        """The data of a capture. of: the sensor, or its layout and nominal dead time (s), for statistics to know.

        Times that have no ticks of their own are put on those of the sensor's converter, else on those of a file.

        Raises InputError where the file cannot be used, where the sensor has other pixels, and for a capture of which
        only the mean is known, or nothing yet.
        """
        if isinstance(of, Sensor):
            layout, dead_time = of.layout, of.nominal_dead_time
        else:
            layout = of or self.layout
        self.check_layout(layout)
        if self.capture(id).mean is not None:
            raise InputError(f"{self.place(id)}: of {id} only the mean is known, there are no data; name its file")
        if self.file is not None and self._paths[self._index(id)] is None:
            raise InputError(f"{self.place(id)}: {without_file(self.file, id)}")
        found, self.notes[id] = self._read(self._index(id), layout, dead_time)
        return found.by_clock(of.tick) if isinstance(of, Sensor) else found

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
                rows, columns = f"0:{mine.rows}", f"0:{mine.columns}"
                part = (
                    f", or, where a part of the sensor was measured, say which to simulate, compare, diagnose or fit: "
                    f"--crop {rows},{columns} (in Python sensor.cropped; the corner 0,0 is a guess: write yours)"
                )
            if mine.rows == 1 and mine.pixels == layout.pixels:
                part = f", or import its files again with --rows {layout.rows} --columns {layout.columns}"
            raise InputError(
                f"{self.source}: layout has {_size(mine)} pixels, but the sensor {_size(layout)}; correct one of "
                f"them, or name the sensor that recorded it{part}"
            )
        theirs = layout.positions
        if mine.positions is not None and theirs is not None and not np.allclose(theirs, mine.positions, 0, 1e-9):
            raise InputError(f"{self.source}: layout.positions are not those of the sensor; correct one of them")


def _light_of(capture: Capture) -> str:
    light = capture.light
    if light.wavelength is None:
        return "dark"
    level = "level free"
    if light.level is not None:
        level = units.show(light.level, "lux" if light.kind_of_level == "lux" else "W/m^2")
    return f"{units.show(light.wavelength, 'm')}, {level}"


def _size(layout: Layout) -> str:
    return f"{layout.rows} x {layout.columns}"


def _row(names: Sequence[str]) -> str:
    return ", ".join(names[:12]) + (f", ... ({len(names)} in all)" if len(names) > 12 else "")


def without_file(file: Path, id: Any) -> str:
    """What is said of a capture that has yet to be recorded. file: the YAML file of its measurement."""
    plan = file.parent if file.name == FILE else file
    name = quoted(id) if isinstance(id, str) and id else "ID"
    return f"has no file yet; record it, then: spadmnist import FILE -o {quoted(plan)} --capture {name}"
