"""Tables of detections as text."""

from __future__ import annotations

import contextlib
import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, DecimalException
from pathlib import Path
from typing import Any

import numpy as np

from .. import image_files, units
from ..errors import InputError
from . import LASER_PULSES, MOST_CHANNELS, PICOSECOND, Format, Found, Said
from .detections import Detections, Pieces

_AT_ONCE = 1 << 22  # characters
_LONGEST_LINE = 1000  # characters
_MOST_TICKS = 2**53  # up to which a number with a decimal point is exact
_HOW = "write pixel,time (ps) (or x,y,time (ns)) into the first line"

# what the columns of other programs are called
_PIXEL, _X, _Y = ("pixel", "channel", "detector", "ch", "pixel_id"), ("x", "column", "col"), ("y", "row")
_TIME, _FINE = ("time", "timestamp", "t", "arrival_time", "time_tag", "timetag"), ("fine", "fine_time")
_FROM_A_PULSE = ("nanotime", "nanotimes", "microtime", "dtime", "tcspc")


@dataclass(frozen=True)
class _Head:
    """What the columns are: the numbers of the columns of `pixel`, or of x and y, and (column, s) of each time."""

    separator: str | None  # None: any white space
    columns: int
    pixel: int | None
    x: int | None
    y: int | None
    times: tuple[tuple[int, float, str], ...]

    @property
    def alone(self) -> bool:
        """Does no column say the pixel? Then there is one."""
        return self.pixel is None and self.x is None


class Table(Format):
    """A table of detections: a line `pixel,time (ps)` (or ns, us, s), then a line for each of them.

    The columns may stand in any order, between commas, semicolons (numbers may then have a decimal comma), tabs or
    spaces; `x,y,time (ps)` instead of a pixel's number, with --rows and --columns; `fine (ps)` is added to the time.
    A table of times alone, `time (ps)`, is of one pixel.
    Times are rounded to ticks of --tick, 1 ps without it.
    """

    about = "CSV of pixel and time"
    ends = (".csv", ".txt", ".tsv")
    modalities = ("tr",)

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """Times are read as they are written, and rounded to ticks once: exact below 2^53 of them."""
        tick = said.tick or PICOSECOND
        with _text(path) as file:
            head = _head(file.readline(_LONGEST_LINE), path)
            shape = _shape(head, said, path)
        facts = {"tick": tick} | ({} if shape is None else {"rows": shape[0], "columns": shape[1]})
        source = "--tick" if said.tick is not None else "a table's times are rounded to it"
        detections = Detections(path, lambda: _detections(path, shape, tick))
        notes = ("has no column of pixels; all its detections are taken as of one pixel",) * head.alone
        return Found(facts, detections, notes=notes, sources={"tick": source})


@contextlib.contextmanager
def _text(path: Path) -> Iterator[Any]:
    """The table, open. Raises InputError where it is no text."""
    try:
        with open(path, encoding="utf-8-sig") as file:
            yield file
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text (byte {error.start}); store the table as UTF-8") from None


def _detections(path: Path, shape: tuple[int, int] | None, tick: float) -> Pieces:
    """(channel, ticks) of the lines of a table, piece after piece."""
    with _text(path) as file:
        head = _head(file.readline(_LONGEST_LINE), path)
        for line, lines, table in _pieces(file, path, head):
            channel, where = _channels(head, table, shape)
            time = sum((table[:, i] * _ratio(scale, tick) for i, scale, _ in head.times), np.zeros(len(table)))
            if time.max(initial=0) >= _ROUNDED:
                time = _exact(lines, head, tick, time)
            whole = np.rint(time)
            fine = (channel >= 0) & (channel < MOST_CHANNELS) & (channel == np.floor(channel))
            fine &= (time >= 0) & (whole < _MOST_TICKS)
            if not fine.all():
                row = int(fine.argmin())
                at, unit = table[row, head.times[0][0]], head.times[0][2]
                line = [n for n, text in enumerate(lines, line) if text.strip()][row]
                raise InputError(
                    f"{path}:{line}: {where(row)} at {at:.15g} {unit} is no pixel (0, 1, ...) and a time "
                    "from 0 on, below 2^53 ticks; correct it, or give a longer --tick"
                )
            yield channel.astype(np.uint32), whole.astype(np.uint64)


_ROUNDED = 2.0**49  # ticks from which on a double may round a decimal to another tick


def _exact(lines: Sequence[str], head: _Head, tick: float, rough: np.ndarray) -> np.ndarray:
    """(lines that are not empty,) times in ticks, rounded once, from the decimals as they are written.

    rough: the same as doubles give them; they stay where an exponent is beyond what decimals can have.
    """
    found = rough.copy()
    for row, line in enumerate(filter(str.strip, lines)):
        cells = line.split(head.separator)
        with contextlib.suppress(DecimalException):
            time = sum(Decimal(cells[i].strip()) * Decimal(repr(scale)) for i, scale, _ in head.times)
            found[row] = float((Decimal(time) / Decimal(repr(tick))).to_integral_value())
    return found


def _head(text: str, path: Path) -> _Head:
    """The columns that the first line names. Raises InputError with the line to write."""
    line = text.strip().lstrip("#").strip()
    separator = next((mark for mark in (";", ",", "\t") if mark in line), None)
    cells = line.split(separator) if separator else re.findall(r"[^\s(\[]+(?:\s*[(\[][^)\]]*[)\]])?", line)
    cells = [cell.strip().strip('"').lower() for cell in cells]
    if separator is None and _named(line.strip('"').lower())[0] in _TIME:  # one column, `arrival time (ps)`
        cells = [line.strip('"').lower()]
    shown = f"{line[:60]!r}"
    if cells and all(re.fullmatch(r"[-+.\d,]+(e[-+]?\d+)?", cell) for cell in cells):
        raise InputError(f"{path}:1: {shown} is a line of numbers, and a header is missing; {_HOW}")
    pixel, x, y, times, strange = None, None, None, [], []
    for i, cell in enumerate(cells):
        name, unit = _named(cell)
        if name in _FROM_A_PULSE:
            raise InputError(f"{path}:1: {cell!r}: {LASER_PULSES}")
        if name in (*_TIME, *_FINE) and unit:
            try:
                times.append((name in _FINE, i, float(units.parse(f"1 {unit}", "s")), unit))
            except ValueError as error:
                raise InputError(f"{path}:1: {error}") from None
        elif name in _PIXEL and pixel is None:
            pixel = i
        elif name in _X and x is None:
            x = i
        elif name in _Y and y is None:
            y = i
        else:
            strange.append(cell)
    coarse = [one for one in times if not one[0]]
    placed = (x is None) == (y is None) and (pixel is None or x is None)
    if strange or len(coarse) != 1 or len(times) > 2 or not placed:
        bare = [cell for cell in strange if cell in _TIME]
        why = f"{bare[0]!r} has no unit" if bare else "is no header"
        raise InputError(f"{path}:1: {shown} {why}; {_HOW}" if not bare else f"{path}:1: in {shown} {why}; {_HOW}")
    order = tuple((i, scale, unit) for _, i, scale, unit in sorted(times))
    return _Head(separator, len(cells), pixel, x, y, order)


def _named(cell: str) -> tuple[str, str]:
    """(name, unit) of a column: `time (ps)`, `time [ps]`, `time_ps`, `pixel`."""
    found = re.fullmatch(r"(\w[\w ]*?)\s*[(\[]\s*([^\W\d_]+)\s*[)\]]", cell)
    if found is None and (spelt := re.fullmatch(r"(\w+?)_(s|ms|us|µs|μs|ns|ps)", cell)):
        found = spelt
    name, unit = (found[1], found[2]) if found else (cell, "")
    return re.sub(r"\s+", "_", name), unit


def _shape(head: _Head, said: Said, path: Path) -> tuple[int, int] | None:
    """Rows and columns, which x and y need; 1 x 1 where no column says the pixel."""
    if head.alone:
        rows, columns = said.rows or 1, said.columns or 1
        if rows * columns != 1:
            raise InputError(
                f"{path}: has no column of pixels, so it is of one pixel, not of {rows} x {columns}; leave --rows and "
                f"--columns out, or name a pixel in every line: {_HOW}"
            )
        return 1, 1
    if head.x is None:
        return None
    if said.rows is None or said.columns is None:
        raise InputError(f"{path}: names pixels by x and y; say how many there are with --rows and --columns")
    return said.rows, said.columns


def _channels(head: _Head, table: np.ndarray, shape: tuple[int, int] | None) -> tuple[np.ndarray, Any]:
    """(the pixel of each line, 0 in a table of one pixel, -1 where there is none; how the file names it, by line)."""
    if head.pixel is not None:
        number = table[:, head.pixel]
        return number, lambda row: f"{number[row]:g}"
    if head.alone:
        return np.zeros(len(table)), lambda row: "the detection"
    assert shape is not None and head.x is not None and head.y is not None
    x, y = table[:, head.x], table[:, head.y]
    inside = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0]) & (x == np.floor(x)) & (y == np.floor(y))
    return np.where(inside, y * shape[1] + x, -1.0), lambda row: f"x = {x[row]:g}, y = {y[row]:g}"


def _ratio(scale: float, tick: float) -> float:
    """Ticks in a unit of time, to the last digit where they are a whole number, as 1000 ps in 1 ns."""
    ratio = scale / tick
    return float(round(ratio)) if abs(ratio - round(ratio)) < 1e-12 * ratio else ratio


def _pieces(file: Any, path: Path, head: _Head) -> Iterator[tuple[int, list[str], np.ndarray]]:
    """(number of the first line, lines, (lines that are not empty, columns) numbers), piece by piece."""
    line, rest, more = 2, "", True
    while more:
        text = file.read(_AT_ONCE)
        more = bool(text)
        text, end, rest = (rest + text).rpartition("\n") if more else (rest, "", "")
        if len(rest) > _LONGEST_LINE:
            raise InputError(f"{path}: has a line of more than {_LONGEST_LINE} characters; is it a table?")
        lines = text.split("\n") if text or end else []
        if head.separator == ";":
            lines = [one.replace(",", ".") for one in lines]
        if text.strip():
            yield line, lines, _numbers(lines, line, path, head)
        line += len(lines)


def _numbers(lines: Sequence[str], line: int, path: Path, head: _Head) -> np.ndarray:
    """(lines that are not empty, columns) their numbers. Raises InputError with the first line that has others."""
    hint = "; numbers may have a decimal comma where semicolons separate them" if head.separator == "," else ""
    try:
        table = np.loadtxt(lines, delimiter=head.separator, ndmin=2, comments=None)
    except ValueError as error:
        like = "1250" if head.alone else "3,1250"
        for number, text in enumerate(lines, line):
            cells = text.strip().split(head.separator) if text.strip() else ["0"] * head.columns
            if (count := len(cells)) != head.columns:
                raise InputError(
                    f"{path}:{number}: has {count} column{'s' * (count != 1)}, and the lines before {head.columns}; a "
                    f"line is {like}{hint if count > head.columns else ''}"
                ) from None
            for cell in itertools.filterfalse(_is_number, cells):
                why = "; write a decimal point, or separate the columns by semicolons" if "," in cell else ""
                why = "; take the quotes out" if '"' in cell or "'" in cell else why
                raise InputError(
                    f"{path}:{number}: could not convert {cell.strip()[:40]!r} to a number; a line is {like}{why}"
                ) from None
        raise InputError(f"{path}: {image_files.reason(error)}, from line {line} on; a line is {like}") from None
    if table.shape[1] != head.columns:
        what = "a pixel and a time" if head.columns == 2 else f"{head.columns} numbers, as the first line says"
        more = hint if table.shape[1] > head.columns else ""
        raise InputError(f"{path}:{line}: has {table.shape[1]} columns; a line is {what}{more}")
    return table


def _is_number(cell: str) -> bool:
    """Is it one for a table's reader?"""
    try:
        float(cell)
    except ValueError:
        return False
    return cell.isascii() and "_" not in cell
