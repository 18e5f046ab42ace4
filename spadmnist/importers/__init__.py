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
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from .. import disk, image_files
from ..errors import InputError
from ..foreign import quoted
from ..import_options import Said, ask
from ..recording import MODALITIES
from ..units import LONGEST, SHORTEST, WAVELENGTHS
from .lights import light

if TYPE_CHECKING:
    from .detections import Detections

__all__ = ["Format", "Found", "Said", "Stack", "ask", "light"]

MOST_CHANNELS = 1 << 24
MOST_EVENTS = 1 << 29  # of a file
LARGEST_PIECE = 1 << 28  # bytes that a file may make one take at once
PICOSECOND = 1e-12
LASER_PULSES = (
    "was recorded in T3 mode, or alike: its times count from the last laser pulse; record in T2 mode, or export the "
    "times since the start to CSV"
)


# --- what a file holds --------------------------------------------------------------------------------------------

# what a file may say of itself by these names: numbers in SI. counter: 1 where counts are those of a counter
FACTS = (
    *("rows", "columns", "exposure", "frame_time", "frame_period", "tick", "bits", "counter", "width"),
    *("wavelength", "irradiance", "lux", "relative_uncertainty", "own_uncertainty"),
)
WORDS = {"modality": MODALITIES, "counting": ("frames", "counter")}  # and in these words
_WHOLE = ("rows", "columns", "bits", "counter", "width")
_SHARES = ("counter", "relative_uncertainty", "own_uncertainty")  # from 0 to 1
# what is said of a number that is none of these; else it is a number of seconds
_WANTED = {
    "counter": "it is 0 or 1",
    "wavelength": "it is in m, 500e-9 for 500 nm",
    "irradiance": f"it is a number of W/m^2 from {SHORTEST:g} to {LONGEST:g}",
    "lux": f"it is a number of lux from {SHORTEST:g} to {LONGEST:g}",
    **dict.fromkeys(("relative_uncertainty", "own_uncertainty"), "it is a number from 0 to 1, 0.05 for 5 %"),
    **dict.fromkeys(("rows", "columns", "bits", "width"), "it is a whole number, 1 or more"),
}
_SECONDS = f"it is a number of seconds from {SHORTEST:g} to {LONGEST:g}, 1e-9 for example"


def facts(path: Path, get: Callable[[str], Any]) -> dict[str, Any]:
    """What a file says of itself (`get` by name, None where not), if that is possible; `counter` as `counting`."""
    found: dict[str, Any] = {}
    for name in FACTS:
        value = get(name)
        if value is None:
            continue
        low, high = (0, 1) if name in _SHARES else WAVELENGTHS if name == "wavelength" else (SHORTEST, LONGEST)
        fine = not isinstance(value, str) and low <= value <= high
        if not fine or (name in _WHOLE and value != int(value)):
            wanted = _WANTED.get(name, _SECONDS)
            raise InputError(
                f"{path}: says that its {name} is {_shown(value)}, which is not possible; {wanted}; correct it"
            )
        found[name] = int(value) if name in _WHOLE else float(value)
    if "counter" in found:
        found["counting"] = "counter" if found.pop("counter") else "frames"
    return found


def in_words(path: Path, get: Callable[[str], Any], detections: bool, known: Mapping[str, Any]) -> dict[str, str]:
    """Further facts: the `WORDS` that a file says of itself. get: by name, None where it does not; known: its `facts`.

    Raises InputError for another word, and where the file says otherwise elsewhere, or holds something else.
    """
    found = {name: get(name) for name in WORDS if get(name) is not None}
    for name, word in found.items():
        if word not in (allowed := WORDS[name]):
            listed = f"{'one of ' * (len(allowed) > 2)}{' or '.join([', '.join(allowed[:-1]), allowed[-1]])}"
            raise InputError(f"{path}: says that its {name} is {_shown(word)}; it is {listed}")
        if known.get(name, word) != word:
            raise InputError(f"{path}: says that its {name} is {word}, and that it is {known[name]}; keep one of them")
    modality = found.get("modality")
    if modality is not None and (modality == "tr") != detections:
        held = "time stamps (tr)" if detections else "frames"
        raise InputError(f"{path}: says that its modality is {modality}, but holds {held}; correct it")
    return found


def _shown(value: Any) -> str:
    return repr(value[:40]) if isinstance(value, str) else f"{value}"


@dataclass(frozen=True)
class Stack:
    """Frames that are read when they are asked for: (frames, rows, columns), or packed bytes in place of columns.

    piece: bytes of frames, as they are stored, that are best read at once.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    get: Callable[[int, int], np.ndarray]
    piece: int = 1 << 24

    def __getitem__(self, part: slice) -> np.ndarray:
        start, stop, _ = part.indices(self.shape[0])
        return self.get(start, stop)

    @property
    def step(self) -> int:
        """Frames in a piece."""
        return max(1, self.piece // max(1, math.prod(self.shape[1:]) * self.dtype.itemsize))

    def pieces(self) -> Iterator[tuple[int, np.ndarray]]:
        """(number of its first frame, frames) piece by piece."""
        for start in range(0, self.shape[0], self.step):
            yield start, self[start : start + self.step]


@dataclass(frozen=True)
class Found:
    """What a file holds: detections, or frames.

    detections: in any order, which input and when, in `facts["tick"]` since the start; frames: a stack of them.
    pixels: the channels that are pixels, in the pixels' order, silent ones too; None where the file does not say.
    names: channels that the file does not call by their number. bits: each number of the frames is a bit, and they are
    `packed` where eight columns are a byte; arranged: the kind of file says which axis is which. facts: what the file
    says of itself, see `FACTS` and `WORDS`; sources: where, by the name of the fact. notes: what is to be known of it;
    left_out: what of the file is no detection of a pixel.
    """

    facts: Mapping[str, Any] = field(default_factory=dict)
    detections: Detections | None = None
    frames: Stack | None = None
    bits: bool = False
    packed: bool = False
    arranged: bool = False
    notes: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    pixels: Sequence[int] | None = None
    names: Mapping[int, str] = field(default_factory=dict)
    sources: Mapping[str, str] = field(default_factory=dict)


class Format:
    """Reads one kind of file. A class is found by being defined; the first that fits a file reads it.

    about: its name; begins: what such a file begins with; ends: the suffixes of what has no such mark. modalities: what
    it may hold; takes: the options of its own that it uses (`Option.own`).
    """

    every: ClassVar[list[type[Format]]] = []
    about: ClassVar[str]
    begins: ClassVar[tuple[bytes, ...]] = ()
    ends: ClassVar[tuple[str, ...]] = ()
    modalities: ClassVar[tuple[str, ...]] = MODALITIES
    takes: ClassVar[tuple[str, ...]] = ()
    binary: ClassVar[bool] = False  # its content may begin with anything

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
        with disk.opened(path) as file:
            head = _head(file)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); name another file") from None
    if not head:
        raise InputError(f"{path}: the file is empty; copy it again from where it was made")
    kinds = formats()
    if head.startswith(GZIP) and not any(path.suffix.lower() in kind.ends for kind in kinds if kind.binary):
        name = quoted(path.name)
        raise InputError(f"{path}: is packed by gzip; unpack it (gunzip -k {name}) and import what comes out")
    for kind in kinds:
        if kind.fits(path, head):
            return kind
    if head.startswith(_OLD_MATLAB):
        raise InputError(f"{path}: is a MATLAB file older than 7.3; save it again with save(..., '-v7.3')")
    known = ", ".join(sorted(kind.about for kind in kinds))
    raise InputError(f"{path}: this is {image_files.looks_like(head)}; what can be imported is {known}")


GZIP = b"\x1f\x8b\x08"
_OLD_MATLAB = b"MATLAB 5.0"
HDF5 = b"\x89HDF\r\n\x1a\n"


def _head(file: Any) -> bytes:
    """The first bytes; of HDF5 those from its signature on, which may stand at 0, 512 (MATLAB), 1024, 2048, ..."""
    head: bytes = file.read(16)
    size, at = file.seek(0, 2), 512
    while at < size:
        file.seek(at)
        found: bytes = file.read(16)
        if found.startswith(HDF5):
            return found
        at *= 2
    return head


# --- for the classes ----------------------------------------------------------------------------------------------


# data sets and columns of times that count from a laser pulse, or that are a part of a time that lies elsewhere
_FINE_TIMES = ("nanotimes", "nanotime", "microtimes", "microtime", "dtime", "fine", "fine_time")


def refuse_fine_times(path: Path, names: Collection[str]) -> None:
    """Raise InputError where the times of a file are only a part of what was measured."""
    for name in _FINE_TIMES:
        if name in names:
            raise InputError(f"{path}: has {name} beside its times: {LASER_PULSES}")


def whole(numbers: np.ndarray, name: str, path: Path, start: int = 0) -> np.ndarray:
    """Numbers that are whole, as integers: MATLAB stores most of them as doubles. Raises InputError for others.

    start: which number the first of them is.
    """
    if numbers.dtype.kind != "f":
        return numbers
    fine = are_whole(numbers)
    if not fine.all():
        at = int(fine.argmin())
        why = no_whole(numbers[at])
        raise InputError(
            f"{path}: {name}[{start + at}] is {numbers[at]:.15g}, {why}; store ticks and pixels as integers"
        )
    return numbers.astype(np.int64)


def are_whole(numbers: np.ndarray) -> np.ndarray:
    """Which floats are whole numbers, and small enough that theirs is a number of its own: 2^24 of single precision."""
    return (np.rint(numbers) == numbers) & (np.abs(numbers) <= 2.0 ** (np.finfo(numbers.dtype).nmant + 1))


def no_whole(number: np.floating[Any]) -> str:
    """What to say of a float that `are_whole` excludes."""
    large = np.isfinite(number) and np.rint(number) == number
    return f"which {number.dtype} does not tell from the next whole number" if large else "which is no whole number"


def one_axis(numbers: np.ndarray, name: str, path: Path) -> np.ndarray:
    """(n,) numbers that are stored so, or as a line of a matrix, as MATLAB does it. Raises InputError."""
    if numbers.ndim != 1 and not (numbers.ndim == 2 and 1 in numbers.shape):
        raise InputError(f"{path}: {name} has the shape {numbers.shape}; store a number for each detection")
    return numbers.ravel()


def is_packed(path: Path, shape: tuple[int, ...], known: Mapping[str, Any], said: Said) -> bool:
    """Does a stack hold packed bits, as the user or the width of a row says? A file may also say that of numbers.

    Raises InputError for a width that contradicts the columns.
    """
    width = known.get("width")
    if width is not None and known.get("columns", width) != width:
        raise InputError(f"{path}: says that it has {known['columns']} columns and a width of {width}; correct it")
    if width is not None and said.columns not in (None, width):
        raise InputError(f"{path}: its rows have {width} columns, not {said.columns}; leave out --columns")
    return said.packed or (width is not None and (shape[2] != width or width == 1))


def holds_detections(path: Path, names: Collection[str], frames: bool, modality: str | None) -> bool:
    """Does a file of arrays hold detections, rather than frames? names: of the arrays; frames: are there frames?
    modality: as the user says it, else the file; None where neither does.

    Raises InputError where it holds both and nobody says which are meant.
    """
    if not {"time", "pixel"} <= set(names):
        return "time" in names and not frames
    if frames and modality is None:
        raise InputError(f"{path}: holds detections (time, pixel) and frames; say with --modality which are meant")
    return not frames or modality == "tr"


def damaged(path: Path, error: Exception) -> InputError:
    """What to say of a file that another library cannot read."""
    reason = image_files.reason(error)
    if "Python objects" in reason:
        return InputError(f"{path}: holds Python objects, which are not read; store whole numbers (uint8) or bool")
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
    if not each:
        raise InputError(f"{path}: its frames are {' x '.join(map(str, shape[1:]))}; store frames that have pixels")

    def get(start: int, stop: int) -> np.ndarray:
        try:
            data = np.fromfile(path, kind, (stop - start) * each, offset=at + start * each * kind.itemsize)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror or error}); name another file") from None
        if len(data) != (stop - start) * each:
            raise InputError(f"{path}: became shorter while it was read; copy it again")
        return data.reshape(-1, *shape[1:])

    return Stack(shape, kind, get)
