"""Tables of detections as text."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .. import image_files, units
from ..errors import InputError
from . import MOST_CHANNELS, PICOSECOND, Format, Found, Said, damaged

_AT_ONCE = 1 << 24  # characters
_LONGEST_LINE = 1000


class Table(Format):
    """A table of detections: a line `pixel,time (ps)` (or ns, us, s), then a line for each of them.

    Times are rounded to ticks of --tick, 1 ps without it.
    """

    about = "CSV of pixel and time"
    ends = (".csv", ".txt")

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """The two columns may stand in either order."""
        tick = said.tick or PICOSECOND
        channels, ticks = [np.zeros(0, np.uint32)], [np.zeros(0, np.uint64)]
        try:
            with open(path, encoding="utf-8-sig") as file:
                head = [cell.strip().lower() for cell in file.readline(_LONGEST_LINE).split(",")]
                unit = [m[1] for cell in head if (m := re.fullmatch(r"time\s*\((\w+)\)", cell))]
                if len(head) != 2 or len(unit) != 1 or "pixel" not in head:
                    raise InputError(f"{path}:1: {','.join(head)[:60]!r} is no header; write pixel,time (ps)")
                try:
                    scale = float(units.parse(f"1 {unit[0]}", "s"))
                except ValueError as error:
                    raise InputError(f"{path}:1: {error}") from None
                for line, table in _pieces(file, path):
                    pixel, time = table.T if head[0] == "pixel" else table.T[::-1]
                    whole = np.rint(time * (scale / tick))
                    fine = (pixel >= 0) & (pixel < MOST_CHANNELS) & (pixel == np.floor(pixel))
                    fine &= (time >= 0) & (whole < 2**53)
                    if not fine.all():
                        row = int(fine.argmin())
                        raise InputError(
                            f"{path}:{line + row}: {pixel[row]:g} at {time[row]:g} {unit[0]} is no pixel (0, 1, ...) "
                            "and a time from 0 on, below 2^53 ticks; correct it, or give a longer --tick"
                        )
                    channels.append(pixel.astype(np.uint32))
                    ticks.append(whole.astype(np.uint64))
        except UnicodeDecodeError as error:
            raise damaged(path, error) from None
        return Found({"tick": tick}, np.concatenate(channels), np.concatenate(ticks))


def _pieces(file: Any, path: Path) -> Iterator[tuple[int, np.ndarray]]:
    """(number of its first line, (lines, 2) numbers), piece by piece."""
    line, rest, more = 2, "", True
    while more:
        text = file.read(_AT_ONCE)
        more = bool(text)
        text, _, rest = (rest + text).rpartition("\n") if more else (rest, "", "")
        if len(rest) > _LONGEST_LINE:
            raise InputError(f"{path}: has a line of more than {_LONGEST_LINE} characters; is it a table?")
        lines = text.splitlines()
        if text.strip():
            try:
                table = np.loadtxt(lines, delimiter=",", ndmin=2, comments=None)
            except ValueError as error:
                raise InputError(
                    f"{path}: {image_files.reason(error)}, from line {line} on; a line is 3,1250"
                ) from None
            if table.shape[1] != 2:
                raise InputError(f"{path}:{line}: has {table.shape[1]} columns; a line is a pixel and a time")
            yield line, table
        line += len(lines)
