"""A window: the rows and columns of a chip that are read out, and what of the whole chip's belongs to them."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from .errors import InputError
from .events import Layout
from .plugins import Parameter, Plugin

P = TypeVar("P", bound=Plugin)

_RANGE = r"\s*(-?\d+)?\s*:\s*(-?\d+)?\s*"
_ROUNDING = 1 + 1e-3  # as `Layout.neighbours` allows for


def parse(text: str) -> tuple[slice, slice]:
    """(rows, columns) of `100:150,200:250`, as Python writes slices. Raises InputError where it is nothing like it."""
    found = re.fullmatch(f"{_RANGE},{_RANGE}", text)
    if found is None:
        raise InputError(
            f"--crop {text}: names no part of a sensor; write ROW:ROW,COLUMN:COLUMN, for example 100:150,200:250 (the "
            "stops are excluded; an open end, as in :16,8:, is that of the sensor)"
        )
    ends = [None if end is None else int(end) for end in found.groups()]
    return slice(*ends[:2]), slice(*ends[2:])


@dataclass(frozen=True)
class Window:
    """Rows `top` to `bottom` and columns `left` to `right` of a chip, the last ones excluded.

    whole: (rows, columns) of the chip. On a chip whose pixels are listed one by one there is one row.
    """

    top: int
    bottom: int
    left: int
    right: int
    whole: tuple[int, int]

    @staticmethod
    def of(whole: tuple[int, int], rows: slice, columns: slice) -> Window:
        """These rows and columns of a chip of so many. Raises InputError where there is nothing, or none of that."""
        for name, part in (("rows", rows), ("columns", columns)):
            if not isinstance(part, slice):
                raise InputError(f"{name}: {part!r:.80} is no slice; give slice(100, 150) for the {name} 100 to 149")
        text = f"crop {_shown(rows)},{_shown(columns)}"
        return Window(*_ends(rows, whole[0], "row", text), *_ends(columns, whole[1], "column", text), whole)

    def __str__(self) -> str:
        return f"{self.top}:{self.bottom},{self.left}:{self.right}"

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the window."""
        return self.bottom - self.top, self.right - self.left

    @cached_property
    def pixels(self) -> np.ndarray:
        """(pixels,) the numbers on the chip of the window's pixels, in their order."""
        number = np.arange(np.prod(self.whole)).reshape(self.whole)
        return number[self.top : self.bottom, self.left : self.right].ravel()

    def pieces(self, weight: np.ndarray, most: float) -> Iterator[Window]:
        """The same pixels in their order, some at a time, which weigh together at most so much, or are one.

        weight: (pixels,) not negative. Whole rows, or a part of one that is too heavy.
        """
        rows, columns = self.shape
        by_row = weight.reshape(rows, columns).sum(axis=1)
        for top, bottom in _runs(by_row, most):
            if bottom - top > 1 or by_row[top] <= most:
                ends = [(0, columns)]
            else:
                ends = list(_runs(weight[top * columns : bottom * columns], most))
            for left, right in ends:
                yield Window(top, bottom, left, right, self.shape).within(self)

    def within(self, outer: Window) -> Window:
        """The same part of the whole chip, where this one counts from the corner of another window."""
        down, right = outer.top, outer.left
        return Window(self.top + down, self.bottom + down, self.left + right, self.right + right, outer.whole)

    # --- from the chip to the window

    def layout(self, chip: Layout) -> Layout:
        """The array of the window's pixels."""
        positions = None if chip.positions is None else chip.positions[self.pixels]
        return replace(chip, rows=self.shape[0], columns=self.shape[1], positions=positions)

    def cut(self, declared: Parameter, value: Any) -> Any:
        """A parameter's value in the window; value: on the chip."""
        return value[self._places(declared, value)[0]] if np.ndim(value) else value

    def effect(self, made: P) -> P:
        """An effect as it was made for the chip, its parameters those of the window.

        Its hooks still want rates and events of the whole chip, so that it need not know of windows; the sensor calls
        them so. What hooks make of parameters alone is the window's.
        """
        one = copy.copy(made)
        for name, declared in made.parameters.items():
            setattr(one, name, self.cut(declared, getattr(made, name)))
        return one

    # --- from the window to the chip

    def filled(self, declared: Parameter, value: Any, outside: Any) -> Any:
        """A parameter's value on the chip; value: in the window, a number or a map.

        outside: what the chip has elsewhere, a number or a map of it all. Where that is nothing that fits (None), the
        median of the window's map stands there.
        """
        if not np.ndim(value):
            return value
        places, size = self._places(declared, value)
        shape = (size, *value.shape[1:])
        known = np.asarray(outside)
        fits = known.dtype.kind in "fiu" and known.ndim <= len(shape)
        fits = fits and all(a in (1, b) for a, b in zip(known.shape[::-1], shape[::-1], strict=False))
        whole = np.array(np.broadcast_to(known if fits else np.median(value, axis=0), shape), np.float64)
        whole[places] = value
        return whole

    def spread(self, photons: np.ndarray) -> np.ndarray:
        """(images, pixels of the chip) photons/s from those of the window: its light goes on beyond its edges."""
        return photons[:, self._nearest]

    @cached_property
    def _nearest(self) -> np.ndarray:
        """(pixels of the chip,) the pixel of the window in the nearest row and column."""
        rows = np.clip(np.arange(self.whole[0]), self.top, self.bottom - 1) - self.top
        columns = np.clip(np.arange(self.whole[1]), self.left, self.right - 1) - self.left
        return (rows[:, None] * self.shape[1] + columns).ravel()

    def around(self, chip: Layout, reach: float) -> np.ndarray:
        """(pixels of the chip,) bool: the window's, and those that lie no more than `reach` pitches from them."""
        if chip.positions is None:
            far = int(min(reach * _ROUNDING, max(self.whole)))
            near = np.zeros(self.whole, bool)
            near[max(self.top - far, 0) : self.bottom + far, max(self.left - far, 0) : self.right + far] = True
            return near.ravel()
        from scipy.spatial import cKDTree  # takes longer to import than all the rest

        return np.asarray(cKDTree(chip.places[self.pixels]).query(chip.places)[0] <= reach * _ROUNDING)

    def rows(self, images: int) -> np.ndarray:
        """(images * pixels,) the window's rows among those of a batch of whole chips."""
        return (np.arange(images)[:, None] * np.prod(self.whole) + self.pixels).ravel()

    def _places(self, declared: Parameter, value: np.ndarray) -> tuple[Any, int]:
        """(where the window's entries stand in a map of the chip, how many of them the chip has)."""
        if declared.per == "row":
            return slice(self.top, self.bottom), self.whole[0]
        if declared.per == "column":
            return slice(self.left, self.right), self.whole[1]
        if declared.per == "pixel" or value.ndim == 2:
            return self.pixels, int(np.prod(self.whole))
        return slice(None), len(value)  # codes that all pixels share


def _runs(weight: np.ndarray, most: float) -> Iterator[tuple[int, int]]:
    """(start, stop) of entries one after the other that weigh at most so much together, or are one."""
    start, total = 0, 0.0
    for i, one in enumerate(weight.tolist()):
        if i > start and total + one > most:
            yield start, i
            start, total = i, 0.0
        total += one
    yield start, len(weight)


def _shown(part: slice) -> str:
    ends = [part.start, part.stop] if part.step is None else [part.start, part.stop, part.step]
    return ":".join("" if end is None else str(end) for end in ends)


def _ends(part: slice, size: int, what: str, text: str) -> tuple[int, int]:
    """(first, one behind the last) of so many rows or columns."""
    if part.step not in (None, 1):
        raise InputError(f"{text}: the {what}s {_shown(part)} leave some out; a window has all between its ends")
    given = [size if part.stop is None else part.stop, part.start or 0]
    stop, start = (end + size if end < 0 else end for end in given)
    if not (0 <= start <= size and 0 <= stop <= size):
        have = f"{size} {what}{'' if size == 1 else 's'}"
        raise InputError(
            f"{text}: the {what}s {_shown(part)} reach beyond the sensor's {have}; name a part of 0:{size}"
        )
    if start >= stop:
        negative = any(end < 0 for end in given)
        from_the_end = f" (a negative end counts from the last one: here {start}:{stop})" if negative else ""
        raise InputError(
            f"{text}: between the {what}s {_shown(part)} lies none; the first end must be less than the second, which "
            f"is excluded, for example 0:{size}{from_the_end}"
        )
    return start, stop
