"""Where pixels lie that are no grid: a CSV file of x and y, in and out."""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import os
import re
from decimal import Decimal
from pathlib import Path

import numpy as np

from . import disk, units
from .errors import InputError
from .validated import brief

_HEADERS = (["x", "y"], ["x(um)", "y(um)"])
_MOST_POSITIONS = 100_000
LARGEST_POSITIONS = 1 << 24  # bytes
_FARTHEST = 1.0  # m
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?", re.ASCII)


def read_positions(path: Path) -> np.ndarray:
    """(pixels, 2) m, the centres of pixels, from a CSV file of x and y in um below a line `x,y`.

    Raises InputError with the line.
    """
    return positions_in(_read(path), str(path))


def positions_in(raw: bytes, path: str) -> np.ndarray:
    """(pixels, 2) m, the positions that such a file holds; path: its name in errors."""
    rows = csv.reader(io.StringIO(_text_of(raw, path), newline=""), strict=True)
    found: list[tuple[float, float]] = []
    first_of: dict[tuple[int, int], int] = {}
    headed = False
    try:
        for cells in rows:
            place = f"{path}:{rows.line_num}"
            if not any(cell.strip() for cell in cells):
                continue
            if not headed:
                if [re.sub(r"\s", "", units.plain(cell)).lower() for cell in cells] not in _HEADERS:
                    raise InputError(f"{place}: {brief(','.join(cells))} is no header; the first line is x,y (in um)")
                headed = True
                continue
            if len(cells) != 2:
                many = f"{len(cells)} column{'s' * (len(cells) != 1)}"
                raise InputError(f"{place}: has {many}; a line is the x and the y of one pixel, as in 23.0,-11.5")
            x, y = (_micrometres(cell.strip(), place) for cell in cells)
            # two pixels do not lie within a nanometre of each other
            line = first_of.setdefault((round(x * 1e9), round(y * 1e9)), rows.line_num)
            if line != rows.line_num:
                raise InputError(f"{place}: the pixel of line {line} lies at the same place; keep one of the two")
            found.append((x, y))
            if len(found) > _MOST_POSITIONS:
                raise InputError(
                    f"{place}: there are more than {_MOST_POSITIONS} pixels; give fewer, or rows and columns"
                )
    except csv.Error as error:
        raise InputError(
            f"{path}:{rows.line_num}: is not well-formed CSV ({error}); write lines such as 23.0,-11.5"
        ) from None
    if not found:
        raise InputError(f"{path}: names no pixel; write x,y in the first line, and below it a line for each pixel")
    return np.array(found)


def _read(path: Path) -> bytes:
    try:
        return disk.read_file(os.path.realpath(path), LARGEST_POSITIONS)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; the positions of the pixels are read from there") from None
    except OSError as error:
        if error.errno == errno.EFBIG:
            most = f"{LARGEST_POSITIONS >> 20} MiB; give at most {_MOST_POSITIONS} pixels"
            raise InputError(f"{path}: is larger than {most}") from None
        if error.errno in (errno.EINVAL, errno.EISDIR):
            raise InputError(f"{path}: is no file; positions is the name of a CSV file") from None
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError:
        raise InputError(f"{brief(str(path))} is not the name of a file; positions names a CSV file") from None


def _text_of(raw: bytes, path: str) -> str:
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text (byte {error.start}); write a CSV file with x,y in um") from None


def _micrometres(text: str, place: str) -> float:
    """m; exact decimal arithmetic, so that `positions_text` comes back to the same double."""
    if not _NUMBER.fullmatch(text) or len(text) > 60:
        with contextlib.suppress(ValueError):
            if not np.isfinite(float(text)):
                raise InputError(f"{place}: {brief(text)} is not possible; every pixel needs a finite place")
        raise InputError(f"{place}: {brief(text)} is not a number; write x and y in um, as in 23.0,-11.5")
    value = float(Decimal(text).scaleb(-6)) + 0.0
    if abs(value) > _FARTHEST:
        raise InputError(f"{place}: {text} um is not possible; a pixel lies within {_FARTHEST:g} m of the middle")
    return value


def positions_text(positions: np.ndarray) -> str:
    """The CSV file of (pixels, 2) m: the same text for the same numbers, and `read_positions` gives them back."""
    lines = [",".join(format(Decimal(repr(float(v))).scaleb(6).normalize(), "f") for v in row) for row in positions]
    return "\n".join(["x (um),y (um)", *lines]) + "\n"
