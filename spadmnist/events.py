"""Events: a ragged batch of time stamps; Layout: the array of pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Layout:
    """A rectangular array of pixels.

    pixel_area: total area of one pixel, m^2; fill_factor: its photosensitive share.
    """

    rows: int
    columns: int
    pixel_area: float
    fill_factor: float

    @property
    def pixels(self) -> int:
        """Number of pixels, counted row by row."""
        return self.rows * self.columns

    @property
    def active_area(self) -> float:
        """Photosensitive area of one pixel, m^2 (paper, below eq. 2)."""
        return self.fill_factor * self.pixel_area

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns


class Events:
    """Time stamps of many rows, a row being one pixel of one image, in one flat array.

    times: (events,) float64, s since the start of the exposure (or of the frame, in STR), ascending within a row.
    offsets: (rows + 1,) int64; row r holds `times[offsets[r]:offsets[r + 1]]`; rows are image-major, then row-major
        over the pixels.
    ticks: (events,) unsigned, whole ticks of the converter; tick: their length, s. Both None without a converter;
        otherwise `times` is `ticks * tick`.
    pixels: rows per image.
    row_pixel: (rows,) the pixel of each row where a row is no whole pixel (STR: a row holds one frame's stamp).
    """

    __slots__ = ("_times", "offsets", "pixels", "row_pixel", "tick", "ticks")

    def __init__(
        self,
        times: np.ndarray | None,
        offsets: np.ndarray,
        pixels: int,
        ticks: np.ndarray | None = None,
        tick: float | None = None,
        row_pixel: np.ndarray | None = None,
    ):
        self._times = times
        self.row_pixel = row_pixel
        self.offsets = offsets
        self.pixels = pixels
        self.ticks = ticks
        self.tick = tick

    @property
    def times(self) -> np.ndarray:
        """(events,) s."""
        if self._times is None:
            assert self.ticks is not None and self.tick is not None
            self._times = self.ticks * self.tick
        return self._times

    def __len__(self) -> int:
        """Number of events."""
        return int(self.offsets[-1])

    def __repr__(self) -> str:
        return f"Events({len(self)} events in {len(self.offsets) - 1} rows)"

    @property
    def counts(self) -> np.ndarray:
        """(rows,) events per row."""
        return np.diff(self.offsets)

    @property
    def rows(self) -> np.ndarray:
        """(events,) the row of each event."""
        return np.repeat(np.arange(len(self.offsets) - 1), self.counts)

    @property
    def pixel(self) -> np.ndarray:
        """(events,) the pixel, within its image, of each event."""
        return self.rows % self.pixels if self.row_pixel is None else self.row_pixel[self.rows]

    def row(self, index: int) -> np.ndarray:
        """The times of one row, s."""
        return self.times[self.offsets[index] : self.offsets[index + 1]]

    def keep(self, mask: np.ndarray) -> Events:
        """The events for which `mask` (events,) is true."""
        running = np.concatenate([[0], np.cumsum(mask)])
        offsets = running[self.offsets].astype(np.int64)
        ticks = None if self.ticks is None else self.ticks[mask]
        return Events(None if ticks is not None else self.times[mask], offsets, self.pixels, ticks, self.tick)

    def images(self, start: int, stop: int) -> Events:
        """The images `start` to `stop` alone, with offsets from 0."""
        offsets = self.offsets[start * self.pixels : stop * self.pixels + 1]
        part = slice(int(offsets[0]), int(offsets[-1]))
        ticks = None if self.ticks is None else self.ticks[part]
        times = None if self._times is None else self._times[part]
        return Events(times, offsets - offsets[0], self.pixels, ticks, self.tick)

    def regrouped(self, pixels: int) -> Events:
        """The same rows with another number of them to an image."""
        return Events(self._times, self.offsets, pixels, self.ticks, self.tick)

    @staticmethod
    def join(parts: list[Events]) -> Events:
        """Several batches, one after the other."""
        if len(parts) == 1:
            return parts[0]
        starts = np.cumsum([0] + [len(p) for p in parts])
        offsets = np.concatenate([[0], *(p.offsets[1:] + s for p, s in zip(parts, starts, strict=False))])
        first = parts[0]
        if first.ticks is not None:
            ticks = np.concatenate([p.ticks for p in parts])
            return Events(None, offsets, first.pixels, ticks, first.tick)
        return Events(np.concatenate([p.times for p in parts]), offsets, first.pixels)

    def problem(self, end: float | None = None) -> str | None:
        """What is wrong with the batch, or None: the invariants of the class docstring, and times in [0, end)."""
        offsets = self.offsets
        if offsets.dtype != np.int64 or offsets.ndim != 1 or len(offsets) < 1 or offsets[0] != 0:
            return "offsets are not int64 from 0 on"
        if np.any(np.diff(offsets) < 0):
            return "offsets decrease"
        times = self.times
        if times.dtype != np.float64 or times.ndim != 1 or len(times) != offsets[-1]:
            return f"there are {times.shape} times of type {times.dtype}, but offsets for {offsets[-1]} float64"
        if not np.all(np.isfinite(times)):
            return "a time is not finite"
        later = np.diff(times) < 0
        starts = offsets[1:-1]
        later[starts[(starts > 0) & (starts < len(times))] - 1] = False
        if np.any(later):
            event = int(np.flatnonzero(later)[0]) + 1
            return f"times are not in order within their row (event {event})"
        if len(times) and (times.min() < 0 or (end is not None and times.max() >= end)):
            return f"times reach from {times.min():g} s to {times.max():g} s, outside the exposure"
        return None


@dataclass(frozen=True)
class Children:
    """What a correlated effect adds: events that other events may cause.

    parent: (children,) int64, index of the event that may cause it; delay: (children,) s, not negative, counted from
    the moment at which the cause acts; row: (children,) the row in which it falls, None: its parent's own.
    """

    parent: np.ndarray
    delay: np.ndarray
    row: np.ndarray | None = None
