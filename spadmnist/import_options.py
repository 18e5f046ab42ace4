"""What the user says of the files: every option of `import`, declared once.

A field of `Said` is an option. What stands beside it makes the help of the command line, the check of its value, and
the check that it has an effect on a file: an option that a file cannot use is a mistake, never ignored.
"""

# ruff: noqa: RUF009 - a function declares the fields

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Protocol

from . import units
from .errors import InputError, SpadError
from .units import LONGEST, SHORTEST

MODALITIES = ("tr", "str", "qis", "counts")
MOST_ROWS = 100_000  # and columns, of a measurement
# what options are for that only some kinds of files use
BITS, STACKS = "frames of bits", "stacks of numbers (.npy, .npz, TIFF, HDF5)"
PLAIN_HDF5, LINOSPAD2 = "plain HDF5", "LinoSPAD2"
UNCERTAIN = 0.05  # relative standard deviation of a light level of which none is given


class Kind(Protocol):
    """A kind of file: its name, and the options of its own that it uses (`Option.own`)."""

    about: str
    takes: tuple[str, ...]


@dataclass(frozen=True)
class Option:
    """An option of `import`.

    about: its help. unit: the SI unit of a quantity, `""` for a share. modalities: what it says something of. own: what
    it is for, where only some kinds of files use it (their `takes`). ask: what is asked for where it is missing, and an
    example. whole, choices, flag, path: what a value is; metavar: how the help calls it; names: further words for it.
    instead: what is so where it does not apply.
    """

    about: str
    modalities: tuple[str, ...] = MODALITIES
    own: str = ""
    unit: str | None = None
    whole: tuple[int, int] | None = None
    choices: tuple[str, ...] = ()
    flag: bool = False
    path: bool = False
    metavar: str | None = None
    names: tuple[str, ...] = ()
    instead: str = ""
    ask: tuple[str, str] | None = None


def _option(about: str, default: Any = None, **more: Any) -> Any:
    return field(default=default, metadata={"option": Option(about, **more)})


_TIMES, _FRAMES = ("tr",), ("qis", "str", "counts")


@dataclass(frozen=True)
class Said:
    """What the user says of the files, in SI. None where nothing was said: then the file is asked."""

    relative_uncertainty: float | None = _option(
        f"Standard uncertainty of the light's calibration: 1.5 %.  [default: {100 * UNCERTAIN:.0f} %]",
        unit="",
        metavar="SHARE",
    )
    rows: int | None = _option(
        "Rows of pixels. The channels fill them in order.  [default: 1 x channels in use; raw frames 512 x 512]",
        whole=(1, MOST_ROWS),
        names=("height",),
    )
    columns: int | None = _option("Columns of pixels.", whole=(1, MOST_ROWS), names=("width",))
    positions: Path | None = _option("Positions x,y (um) of pixels that are not a grid.", path=True, metavar="FILE.csv")
    channels: tuple[str, ...] | None = _option(
        "Channels that are pixels, in the order of the pixels: 0,1,sync. Others are left out.",
        modalities=_TIMES,
        metavar="LIST",
    )
    exposure: float | None = _option(
        "Exposure.",
        modalities=_TIMES,
        unit="s",
        instead="frames last their number x --frame-period",
        ask=("how long was recorded", '"100 ms"'),
    )
    subtract_start: bool = _option(
        "Subtract the time of the first detection, for a clock with another zero.",
        False,
        modalities=_TIMES,
        flag=True,
    )
    tick: float | None = _option(
        "Length of a tick, if the file does not contain it; 1 ps for a table.",
        modalities=("tr", "str"),
        unit="s",
        ask=("the length of a tick", '"100 ps"'),
    )
    modality: str | None = _option("Modality of a stack of numbers.", choices=MODALITIES)
    axes: str | None = _option(
        "Axes of a stack: MHW (frames, rows, columns) or HWM (rows, columns, frames).  [default: MHW; MATLAB: HWM]",
        modalities=_FRAMES,
        own=STACKS,
        choices=("MHW", "HWM"),
    )
    frames: int | None = _option("Number of frames; the file must agree.", modalities=_FRAMES, whole=(1, 10**9))
    frame_time: float | None = _option(
        "Frame time: how long a frame is live.", modalities=_FRAMES, unit="s", ask=("how long a frame looks", '"10 us"')
    )
    frame_period: float | None = _option(
        "Frame period: time from one frame to the next.",
        modalities=_FRAMES,
        unit="s",
        ask=("the time from one frame to the next", '"10 us"'),
    )
    bits: int | None = _option(
        "Bits of a count. Raw counts are one byte each, two above 8 bits.",
        modalities=("counts",),
        whole=(1, 16),
        ask=("how many bits a count has", "8"),
    )
    counting: str | None = _option(
        "What a count is: the sum of 2^bits - 1 binary frames (default), or a counter in each frame.",
        modalities=("counts",),
        choices=("frames", "counter"),
    )
    packed: bool = _option("A byte is eight columns of bits.", False, modalities=("qis",), own=BITS, flag=True)
    bit_order: str | None = _option(
        "Bit of a packed byte that is the left column: the highest (big) or the lowest.  [default: big]",
        modalities=("qis",),
        own=BITS,
        choices=("big", "little"),
    )
    dataset: str | None = _option(
        "Data set of the frames, or group that holds time and pixel.  [default: frames]", own=PLAIN_HDF5, metavar="PATH"
    )
    tdc: Path | None = _option(
        "Ends of the converter's codes, ps.", modalities=_TIMES, own=LINOSPAD2, path=True, metavar="FILE.csv"
    )
    offsets: Path | None = _option(
        "Time offsets of the pixels, ps.", modalities=_TIMES, own=LINOSPAD2, path=True, metavar="FILE.npy"
    )
    firmware: str | None = _option(
        "Firmware, which defines the pixel of an address.",
        modalities=_TIMES,
        own=LINOSPAD2,
        choices=("2212b", "2212s", "2208"),
        ask=("the firmware, which decides what pixel an address is", "2212b"),
    )
    timestamps: int | None = _option(
        "Time stamps of a converter in a cycle.",
        modalities=_TIMES,
        own=LINOSPAD2,
        whole=(1, 2**20),
        ask=("how many words a converter has in a cycle", "512"),
    )
    cycle: float | None = _option(
        "Length of a cycle.", modalities=_TIMES, own=LINOSPAD2, unit="s", ask=("how long a cycle is", '"4 ms"')
    )

    @staticmethod
    def of(**given: Any) -> Said:
        """From the words of a command line: times with their units. Raises SpadError with the option."""
        for name, option in options().items():
            if option.unit is not None and given.get(name) is not None:
                given[name] = _number(name, option.unit, given[name])
        if given.get("channels") is not None:
            given["channels"] = _names(given["channels"])
        return Said(**given)

    @property
    def given(self) -> list[str]:
        """The names of the options that were given."""
        return [one.name for one in fields(self) if getattr(self, one.name) != one.default]


def options() -> dict[str, Option]:
    """Every option by its name, in the order of the help."""
    return {one.name: one.metadata["option"] for one in fields(Said)}


def word(name: str) -> str:
    """How an option is written: `frame_time` -> `--frame-time`."""
    return "--" + name.replace("_", "-")


def about(option: Option) -> str:
    """The help of an option; what only some kinds of files use says so."""
    return f"{option.own[0].upper()}{option.own[1:]}: {option.about}" if option.own else option.about


def _number(name: str, unit: str, text: str) -> float:
    share = not unit
    try:
        value = float(units.parse(text, unit))
    except ValueError as error:
        raise SpadError(f"{word(name)}: {error}") from None
    if not (0 <= value <= 1 if share else SHORTEST <= value <= LONGEST):
        allowed = "from 0 to 1" if share else f"from {SHORTEST:g} s to {LONGEST:g} s"
        raise SpadError(f"{word(name)}: {text} is not possible; it must be {allowed}")
    return value


def _names(text: str) -> tuple[str, ...]:
    names = tuple(part.strip().lower() for part in text.split(","))
    wrong = [name for name in names if not re.fullmatch(r"\d{1,8}|[a-z]\w*", name)]
    if wrong:
        raise SpadError(f"--channels: {wrong[0]!r} is no channel; write them as the file names them, as in 0,1,sync")
    names = tuple(str(int(name)) if name.isdigit() else name for name in names)
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise SpadError(f"--channels: {twice[0]} stands there twice; each channel is one pixel")
    return names


# --- does an option have an effect? ---------------------------------------------------------------------------------


def without_effect(
    said: Said, kind: Kind | type[Kind], modalities: Iterable[str], packed: bool | None = None
) -> str | None:
    """Why the first option that says nothing of a file does so; None where all have an effect.

    kind: of the file; modalities: what it may hold; packed: are its frames packed bits? None: not known yet.
    """
    held = set(modalities)
    for name in said.given:
        option = options()[name]
        of = _words(option, kind, name)
        if option.own and option.own not in kind.takes:
            return f"{word(name)} does not apply to {kind.about}, only to {of}; leave it out"
        if not held & set(option.modalities):
            what = "frames" if len(held) > 1 else next(iter(held))
            instead = f" ({option.instead})" if option.instead else ""
            return f"{word(name)} does not apply to {what}{instead}, only to {of}; leave it out"
        if name == "bit_order" and packed is False:
            return f"{word(name)} does not apply to numbers, only to packed bits; leave it out"
        if name == "axes" and packed:
            return f"{word(name)} does not apply to packed bits, whose columns are the last axis; leave it out"
    return None


def _words(option: Option, kind: Kind | type[Kind], name: str) -> str:
    """What an option is for."""
    if option.own and option.own not in kind.takes:
        return option.own
    return {
        _TIMES: "time stamps (tr)",
        _FRAMES: "frames",
        ("qis",): "packed bits (qis)",
        ("tr", "str"): "time stamps (tr, str)",
    }.get(option.modalities, " and ".join(option.modalities))


def ask(path: Path, names: Sequence[str]) -> InputError:
    """One sentence that asks for everything that is missing."""
    known = {name: option.ask for name, option in options().items() if option.ask}
    known["light"] = ("what fell on the sensor", 'dark (or "500 nm 75.67 nW/cm^2")')
    asked = [(name, known[name]) for name in names]
    what = ", nor ".join(told[0] for _, told in asked if told)
    write = " ".join(f"{word(name)} {told[1]}" for name, told in asked if told)
    return InputError(f"{path}: does not say {what}; add {write}")
