"""Recordings of real sensors, in the files that instruments and other programs write, as a measurement.

One class reads one kind of file (`Format`); lying in this folder is its registration. It says what the file holds
(`Found`): detections with the channel of each, or frames that are read piece by piece. All that follows is the same for
every kind (`captures`): which pixel a channel is, how it was recorded, and a question for what no file says.

Files come from anywhere: nothing is unpickled, no link is followed, sizes are compared with what the file can hold
before memory is taken for them, and whatever a file contains, the outcome is a measurement or one sentence.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import math
import pkgutil
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from .. import image_files, units
from ..errors import InputError, SpadError
from ..recording import Light

MOST_CHANNELS = 1 << 24
MOST_EVENTS = 1 << 29  # of a file
LARGEST_PIECE = 1 << 28  # bytes that a file may make one take at once
PICOSECOND = 1e-12


# --- what the user says -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Said:
    """What the user says of the files, in SI. None where nothing was said: then the file is asked."""

    rows: int | None = None
    columns: int | None = None
    positions: Path | None = None
    modality: str | None = None
    exposure: float | None = None
    frames: int | None = None
    frame_time: float | None = None
    frame_period: float | None = None
    tick: float | None = None
    bits: int | None = None
    counting: str | None = None
    relative_uncertainty: float | None = None
    packed: bool = False
    bit_order: str = "big"
    dataset: str | None = None
    tdc: Path | None = None
    offsets: Path | None = None
    firmware: str | None = None
    timestamps: int | None = None
    cycle: float | None = None

    @staticmethod
    def of(**given: Any) -> Said:
        """From the words of a command line: times with their units. Raises SpadError with the option."""
        for name in ("exposure", "frame_time", "frame_period", "tick", "cycle", "relative_uncertainty"):
            if given.get(name) is None:
                continue
            share = name == "relative_uncertainty"
            try:
                value = float(units.parse(given[name], "" if share else "s"))
            except ValueError as error:
                raise SpadError(f"{_option(name)}: {error}") from None
            if not (0 <= value <= 1 if share else value > 0):
                allowed = "from 0 to 1" if share else "more than 0"
                raise SpadError(f"{_option(name)}: {given[name]} is not possible; it must be {allowed}")
            given[name] = value
        return Said(**given)


# what only the user can say where the file does not: (what it is, an example)
_ASKED = {
    "exposure": ("how long was recorded", '"100 ms"'),
    "frame_time": ("how long a frame looks", '"10 us"'),
    "frame_period": ("the time from one frame to the next", '"10 us"'),
    "tick": ("the length of a tick", '"100 ps"'),
    "bits": ("how many bits a count has", "8"),
    "light": ("what fell on the sensor", 'dark (or "500 nm 75.67 nW/cm^2")'),
    "firmware": ("the firmware, which decides what pixel an address is", "2212b"),
    "timestamps": ("how many words a converter has in a cycle", "512"),
    "cycle": ("how long a cycle is", '"4 ms"'),
}


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def ask(path: Path, names: Sequence[str]) -> InputError:
    """One sentence that asks for everything that is missing."""
    what = ", nor ".join(_ASKED[name][0] for name in names)
    return InputError(f"{path}: does not say {what}; add {' '.join(f'{_option(n)} {_ASKED[n][1]}' for n in names)}")


_LIGHT = 'dark, free, "500 nm free", "500 nm 75.67 nW/cm^2" or "500 nm 5 mlux"'
_PLAIN_COLOUR = 555e-9  # m, where only lux are given, or nothing


def light(text: str) -> Light:
    """What fell on the sensor, as the command line says it: `dark`, `free`, `500 nm 75.67 nW/cm^2`.

    A level that is free is unknown; where no wavelength is given either, 555 nm stands for it. Raises SpadError.
    """
    words = " ".join(text.split())
    if words == "dark":
        return Light()
    found: dict[str, float] = {}
    for part in re.findall(r"free|[-+.0-9][-+.0-9eE]*\s?[^\s0-9]\S*|\S+", words) or [""]:
        if part == "free":
            continue
        for unit in ("m", "W/m^2", "lux"):
            try:
                value = float(units.parse(part, unit))
            except ValueError:
                continue
            if value > 0 and unit not in found:
                found[unit] = value
                break
        else:
            raise SpadError(f"--light: {text!r} is no light; write {_LIGHT}")
    levels = found.keys() - {"m"}
    if len(levels) + words.count("free") > 1 or ("W/m^2" in found and "m" not in found):
        raise SpadError(f"--light: {text!r} needs a wavelength and one level; write {_LIGHT}")
    level = found.get("W/m^2", found.get("lux"))
    return Light(found.get("m", _PLAIN_COLOUR), level, "lux" if "lux" in found else "irradiance")


# --- what a file holds --------------------------------------------------------------------------------------------

# what a file may say of itself by these names: numbers in SI. counter: 1 where counts are those of a counter
FACTS = (
    *("rows", "columns", "exposure", "frame_time", "frame_period", "tick", "bits", "counter", "width"),
    *("wavelength", "irradiance", "lux", "relative_uncertainty", "own_uncertainty"),
)
_WHOLE = ("rows", "columns", "bits", "counter", "width")
_MAY_BE_ZERO = ("counter", "relative_uncertainty", "own_uncertainty")


def facts(path: Path, get: Callable[[str], Any]) -> dict[str, Any]:
    """What a file says of itself (`get` by name, None where it does not), if that is possible."""
    found = {}
    for name in FACTS:
        value = get(name)
        if value is None:
            continue
        fine = not isinstance(value, str) and (0 < value < 1e18 or (value == 0 and name in _MAY_BE_ZERO))
        if not fine or (name in _WHOLE and value != int(value)):
            raise InputError(f"{path}: says that its {name} is {str(value)[:40]!r}, which is not possible; correct it")
        found[name] = int(value) if name in _WHOLE else float(value)
    return found


@dataclass(frozen=True)
class Stack:
    """Frames that are read when they are asked for: (frames, rows, columns), or packed bytes in place of columns."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    get: Callable[[int, int], np.ndarray]

    def __getitem__(self, part: slice) -> np.ndarray:
        start, stop, _ = part.indices(self.shape[0])
        return self.get(start, stop)


@dataclass(frozen=True)
class Found:
    """What a file holds: detections, or frames.

    channel, ticks: (detections,) integers in any order, which input and when, in `facts["tick"]` since the start.
    bits: each number of the frames is a bit, and they are `packed` where eight columns are a byte. facts: what the file
    says of itself, see `FACTS`; notes: what is to be known of it.
    """

    facts: Mapping[str, Any] = field(default_factory=dict)
    channel: np.ndarray | None = None
    ticks: np.ndarray | None = None
    frames: Stack | None = None
    bits: bool = False
    packed: bool = False
    notes: tuple[str, ...] = ()


class Format:
    """Reads one kind of file. A class is found by being defined; the first that fits a file reads it.

    about: its name; begins: what such a file begins with; ends: the suffixes of what has no such mark.
    """

    every: ClassVar[list[type[Format]]] = []
    about: ClassVar[str]
    begins: ClassVar[tuple[bytes, ...]] = ()
    ends: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls) -> None:
        Format.every.append(cls)

    @classmethod
    def fits(cls, path: Path, head: bytes) -> bool:
        """Is it a file of this kind? head: its first bytes."""
        return head.startswith(cls.begins) if cls.begins else path.suffix.lower() in cls.ends

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """What the file holds. Raises InputError with a sentence."""
        raise NotImplementedError


def formats() -> list[type[Format]]:
    """Every kind of file, those that are known by their content first."""
    for module in sorted(info.name for info in pkgutil.iter_modules(__path__)):
        importlib.import_module(f"{__name__}.{module}")
    return sorted(Format.every, key=lambda kind: not kind.begins)


def recognise(path: Path) -> type[Format]:
    """The kind of a file, by its content, or by its name where the content has no mark."""
    try:
        if not path.is_file():
            raise InputError(f"{path}: {'is no file' if path.exists() else 'no such file'}; name a file to import")
        with open(path, "rb") as file:
            head = file.read(16)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); name another file") from None
    if not head:
        raise InputError(f"{path}: the file is empty; copy it again from where it was made")
    kinds = formats()
    for kind in kinds:
        if kind.fits(path, head):
            return kind
    known = ", ".join(sorted(kind.about for kind in kinds))
    raise InputError(f"{path}: this is {image_files.looks_like(head)}; what can be imported is {known}")


# --- for the classes ----------------------------------------------------------------------------------------------


def damaged(path: Path, error: Exception) -> InputError:
    """What to say of a file that another library cannot read."""
    reason = image_files.reason(error)
    return InputError(f"{path}: is damaged or cut short ({reason}); copy it again from where it was made")


def library(path: Path, name: str, extra: str) -> Any:
    """A package that not everybody needs. Raises InputError that says how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(
            f"{path}: is read by the package {name}, which is not installed; pip install 'spadmnist[{extra}]'"
        ) from None


@contextlib.contextmanager
def heard(name: str) -> Iterator[None]:
    """What a package only logs as an error, a page that is not there for example, is raised as a ValueError."""
    said: list[str] = []
    ear, logger = logging.Handler(logging.ERROR), logging.getLogger(name)
    ear.emit = lambda record: said.append(record.getMessage())  # type: ignore[method-assign]
    before = logger.propagate
    logger.addHandler(ear)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(ear)
        logger.propagate = before
    if said:
        raise ValueError(said[0])


def frames_in_file(path: Path, at: int, dtype: Any, shape: tuple[int, ...]) -> Stack:
    """Frames that lie in a file as they are in memory, from byte `at` on."""
    kind, each = np.dtype(dtype), math.prod(shape[1:])

    def get(start: int, stop: int) -> np.ndarray:
        try:
            data = np.fromfile(path, kind, (stop - start) * each, offset=at + start * each * kind.itemsize)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror or error}); name another file") from None
        if len(data) != (stop - start) * each:
            raise InputError(f"{path}: became shorter while it was read; copy it again")
        return data.reshape(-1, *shape[1:])

    return Stack(shape, kind, get)
