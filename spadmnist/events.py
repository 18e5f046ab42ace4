"""Events: a ragged batch of time stamps; Layout: the array of pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from . import kernels
from .errors import InputError, SpadError

MOST_PIXELS = 1 << 24  # of an array: each map takes 8 bytes of each, 128 MiB
_BINS = 1 << 21  # of time that are looked at together: 16 bytes each
_MOST_PAIRS = 1 << 24  # of pixels, in a list of who lies near whom: 24 bytes each, 400 MB


@dataclass(frozen=True)
class Layout:
    """The array of pixels: a grid, or a list of places, which counts as 1 row x n columns.

    pixel_area: total area of one pixel, m^2; fill_factor: its photosensitive share.
    positions: (pixels, 2) m, the centres (x, y) of the pixels, no two the same; None on a grid.
    """

    rows: int
    columns: int
    pixel_area: float
    fill_factor: float
    positions: np.ndarray | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        for name in ("rows", "columns"):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 1:
                raise InputError(f"{name} is {value!r}; it is a whole number of pixels, 1 or more")
        # a measurement does not know its area: nan
        number = isinstance(self.pixel_area, int | float | np.number) and isinstance(
            self.fill_factor, int | float | np.number
        )
        if not number or self.pixel_area <= 0 or math.isinf(self.pixel_area):
            raise InputError(f"pixel_area is {self.pixel_area!r}; it is in m^2 and more than 0, 25e-12 for 25 um^2")
        if not (math.isnan(self.fill_factor) or 0 < self.fill_factor <= 1):
            raise InputError(
                f"fill_factor is {self.fill_factor!r}; it is a share, more than 0 and at most 1, 0.45 for 45 %"
            )
        if self.positions is not None and np.shape(self.positions) != (self.pixels, 2):
            raise InputError(
                f"positions have shape {np.shape(self.positions)}; they are (pixels, 2) in m, here ({self.pixels}, 2)"
            )
        if self.positions is not None and self.rows != 1:
            raise InputError(f"pixels with positions are one row, Layout(1, {self.pixels}, ...), not {self.rows} rows")

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

    @cached_property
    def places(self) -> np.ndarray:
        """(pixels, 2) centres (x, y) of the pixels in units of the pitch, the distance of side neighbours."""
        if self.positions is None:
            y, x = np.divmod(np.arange(self.pixels), self.columns)
            return np.stack([x, y], axis=1).astype(np.float64)
        if self.pixels == 1:
            return np.zeros((1, 2))
        from scipy.spatial import cKDTree  # takes longer to import than all the rest

        nearest = cKDTree(self.positions).query(self.positions, k=2)[0][:, 1]
        return np.asarray(self.positions / nearest.min())

    @cached_property
    def centred(self) -> np.ndarray:
        """(pixels, 2) places (x, y) with the middle of the array at 0 and its edges' pixels at -0.5 and 0.5."""
        low, high = self.places.min(axis=0), self.places.max(axis=0)
        extent = np.where(high > low, high - low, 1.0)
        return np.asarray((self.places - (low + high) / 2) / extent)

    def neighbours(self, reach: float) -> Neighbours:
        """Every pixel's neighbours up to a distance of `reach` pitches (a little rounding allowed)."""
        reach = reach * (1 + 1e-3)
        if self.positions is None:
            # none lies farther than the array is large
            y, x = (int(min(reach, size - 1)) for size in self.shape)
            _check_pairs((2 * y + 1) * (2 * x + 1), reach)
            dy, dx = (a.ravel() for a in np.mgrid[-y : y + 1, -x : x + 1])
            distance = np.hypot(dx, dy)
            near = (distance <= reach) & (distance > 0)
            near &= (np.abs(dy) < self.rows) & (np.abs(dx) < self.columns)
            order = np.argsort(distance[near], kind="stable")
            return Neighbours(self, distance[near][order], np.stack([dx[near], dy[near]], axis=1)[order], None)
        from scipy.spatial import cKDTree

        tree = cKDTree(self.places)
        _check_pairs(int(tree.count_neighbors(tree, reach)), reach)
        pairs = tree.query_pairs(reach, output_type="ndarray")
        both = np.concatenate([pairs, pairs[:, ::-1]]).astype(np.int64).reshape(-1, 2)
        distance = np.hypot(*(self.places[both[:, 0]] - self.places[both[:, 1]]).T)
        order = np.lexsort((both[:, 1], np.round(distance, 9), both[:, 0]))
        first = np.searchsorted(both[order, 0], np.arange(self.pixels + 1))
        return Neighbours(self, distance[order], both[order, 1], first)


def _check_pairs(count: int, reach: float) -> None:
    if count > _MOST_PAIRS:
        raise InputError(
            f"a reach of {reach:.4g} pitches has {count:,} neighbours, more than the {_MOST_PAIRS:,} that can be held; "
            "shorten it"
        )


@dataclass(frozen=True)
class Neighbours:
    """Who lies near whom.

    On a grid (`first` is None) all pixels have the same ones: distance (k,) in pitches, step (k, 2) columns and rows
    to go; a step may lead out of the array. Otherwise pixel p has the entries first[p] to first[p + 1]: step (k,) is
    the neighbour itself.
    """

    layout: Layout
    distance: np.ndarray
    step: np.ndarray
    first: np.ndarray | None


class Events:
    """Time stamps of many rows, a row being one pixel of one image, in one flat array.

    times: (events,) float64, s since the start of the exposure (or of the frame, in STR), ascending within a row.
    offsets: (rows + 1,) int64; row r holds `times[offsets[r]:offsets[r + 1]]`; rows are image-major, then row-major
        over the pixels.
    ticks: (events,) unsigned, whole ticks of the converter; tick: their length, s. Both None without a converter;
        otherwise `times` is `ticks * tick`.
    pixels: rows per image.
    row_pixel: (rows,) the pixel of each row where a row is no whole pixel (STR: a row holds one frame's stamp);
        otherwise None. image_offsets: (images + 1,) where each image's events begin.
    end: s, where the exposure (in STR: the frame) ends that the stamps count from; every time is less.
    cause: (events,) uint8, what made each event, a number of `Sensor.causes`; parent: (events,) int64, the event of
        this batch that caused it, -1 where none did, -2 where that one was not recorded. Both None where the causes
        were not asked for.
    """

    __slots__ = (
        "_image_offsets", "_times", "cause", "end", "offsets", "parent", "pixels", "row_pixel", "tick", "ticks"
    )  # fmt: skip

    def __init__(
        self,
        times: np.ndarray | None,
        offsets: np.ndarray,
        pixels: int,
        ticks: np.ndarray | None = None,
        tick: float | None = None,
        row_pixel: np.ndarray | None = None,
        end: float | None = None,
        cause: np.ndarray | None = None,
        parent: np.ndarray | None = None,
        image_offsets: np.ndarray | None = None,
    ):
        self._times = times
        self._image_offsets = image_offsets
        self.row_pixel = row_pixel
        self.end = end
        self.cause = cause
        self.parent = parent
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

    @property
    def stamps(self) -> tuple[np.ndarray, float]:
        """((events,) ticks, s of one), or times and 1.0 where there is no converter; no memory is taken."""
        if self.ticks is None or self.tick is None:
            return self.times, 1.0
        return self.ticks, self.tick

    def times_of(self, part: slice) -> np.ndarray:
        """s, of some events; nothing is kept."""
        if self.ticks is None or self.tick is None:
            return self.times[part]
        return self.ticks[part] * self.tick

    def __len__(self) -> int:
        """Number of events."""
        return int(self.offsets[-1])

    def __repr__(self) -> str:
        return f"Events({len(self)} events in {len(self.offsets) - 1} rows)"

    @property
    def image_offsets(self) -> np.ndarray:
        """(images + 1,) where each image's events begin, and the end."""
        return self.offsets[:: self.pixels] if self._image_offsets is None else self._image_offsets

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

    def rows_of(self, start: int, stop: int) -> np.ndarray:
        """(stop - start,) the rows of some events, one after the other."""
        first, last = (int(np.searchsorted(self.offsets, place, "right")) - 1 for place in (start, stop - 1))
        ends = self.offsets[first : last + 2].clip(start, stop)
        return np.repeat(np.arange(first, last + 1), np.diff(ends))

    def in_time_order(self, most: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """(stamps, rows) of all events in the order of time, and of their rows where stamps are the same.

        In pieces of about `most` events: ticks, or times where there are none. All that are at the same tick are in one
        piece.
        """
        stamps: np.ndarray = self.times if self.ticks is None else self.ticks
        if not len(stamps):
            return
        place, left = self.offsets[:-1].copy(), len(stamps)
        begin, last = float(stamps.min()), float(stamps.max())
        least = max(0.0 if self.ticks is None else 1.0, float(np.spacing(last)))  # what tells two stamps apart
        width = (last - begin) * most / left
        while left:
            width = max(width, least)
            ends = kernels.rows_upto(stamps, self.offsets, place, np.inf if begin + width > last else begin + width)
            count = int((ends - place).sum())
            if count > most and width > least:
                width /= 2
                continue
            rows = np.repeat(np.arange(len(place)), ends - place)
            piece = kernels.between(stamps, place, ends, count)
            order = np.argsort(piece, kind="stable")
            yield piece[order], rows[order]
            left, place, begin = left - count, ends, begin + width
            width *= 2 if count < most // 4 else 1

    def row(self, index: int) -> np.ndarray:
        """The times of one row, s."""
        return self.times[self.offsets[index] : self.offsets[index + 1]]

    def keep(self, mask: np.ndarray) -> Events:
        """The events for which `mask` (events,) is true."""
        cause = parent = None
        if self.cause is not None and self.parent is not None:
            cause, parent = self.cause[mask], self.parent[mask]
            known = parent >= 0
            running = np.cumsum(mask)
            parent[known] = np.where(mask[parent[known]], running[parent[known]] - 1, -2)
        offsets = kernels.kept_offsets(mask, self.offsets)
        images = None if self._image_offsets is None else kernels.kept_offsets(mask, self._image_offsets)
        ticks = None if self.ticks is None else kernels.kept(self.ticks, mask)
        times = None if ticks is not None else kernels.kept(self.times, mask)
        return Events(times, offsets, self.pixels, ticks, self.tick, self.row_pixel, self.end, cause, parent, images)

    def moved(self, times: np.ndarray) -> Events:
        """The same events at other times (s), brought into order within their rows, and into [0, `end`).

        times: (events,) float64, finite.
        """
        end = np.inf if self.end is None else self.end
        order = np.empty(len(times) if self.cause is not None else 0, np.int64)
        ordered = kernels.sort_rows(times, self.offsets, np.nextafter(end, 0.0), order)
        cause = parent = None
        if self.cause is not None and self.parent is not None:
            place = np.empty(len(order), np.int64)
            place[order] = np.arange(len(order))
            cause, parent = self.cause[order], self.parent[order]
            known = parent >= 0
            parent[known] = place[parent[known]]
        images = self._image_offsets
        return Events(ordered, self.offsets, self.pixels, None, None, self.row_pixel, self.end, cause, parent, images)

    def stamped(self, ticks: np.ndarray, tick: float) -> Events:
        """The same events with whole ticks (events,) of a converter in place of their times."""
        images = self._image_offsets
        return Events(
            None, self.offsets, self.pixels, ticks, tick, self.row_pixel, self.end, self.cause, self.parent, images
        )

    def images(self, start: int, stop: int) -> Events:
        """The images `start` to `stop` alone, with offsets from 0."""
        offsets = self.offsets[start * self.pixels : stop * self.pixels + 1]
        part = slice(int(offsets[0]), int(offsets[-1]))
        ticks = None if self.ticks is None else self.ticks[part]
        times = None if self._times is None else self._times[part]
        cause = None if self.cause is None else self.cause[part]
        parent = None if self.parent is None else _shifted(self.parent[part], -offsets[0])
        return Events(times, offsets - offsets[0], self.pixels, ticks, self.tick, None, self.end, cause, parent)

    def take(self, images: np.ndarray) -> Events:
        """Some images, in any order, repeated or not, with offsets from 0."""
        starts, images = self.image_offsets, np.asarray(images)
        rows = (images[:, None] * self.pixels + np.arange(self.pixels)).reshape(-1)
        offsets = np.concatenate([[0], np.cumsum(self.counts[rows])])
        pieces = [slice(a, b) for a, b in zip(starts[images].tolist(), starts[images + 1].tolist(), strict=True)]

        def taken(values: np.ndarray | None) -> np.ndarray | None:
            return None if values is None else np.concatenate([values[:0], *(values[piece] for piece in pieces)])

        parent = taken(self.parent)
        if parent is not None:
            moved = offsets[:: self.pixels][:-1] - starts[images]
            parent = _shifted(parent, np.repeat(moved, starts[images + 1] - starts[images]))
        times = taken(self._times) if self.ticks is None else None
        cause = taken(self.cause)
        return Events(times, offsets, self.pixels, taken(self.ticks), self.tick, None, self.end, cause, parent)

    def of_rows(self, rows: np.ndarray, pixels: int) -> Events:
        """Some rows (ascending) alone, `pixels` of them to an image."""
        among = np.zeros(len(self.offsets) - 1, bool)
        among[rows] = True
        kept = self.keep(np.repeat(among, self.counts))
        offsets = np.concatenate([[0], np.cumsum(kept.counts[among])])
        return Events(kept._times, offsets, pixels, kept.ticks, kept.tick, None, kept.end, kept.cause, kept.parent)

    def regrouped(self, pixels: int) -> Events:
        """The same rows with another number of them to an image."""
        return Events(self._times, self.offsets, pixels, self.ticks, self.tick, None, self.end, self.cause, self.parent)

    @staticmethod
    def join(parts: list[Events]) -> Events:
        """Several batches, one after the other."""
        if len(parts) == 1:
            return parts[0]
        if len({(p.tick, p.pixels) for p in parts}) > 1:
            raise SpadError("streams of other ticks or of another number of pixels cannot be joined; read them apart")
        starts = np.cumsum([0] + [len(p) for p in parts])
        offsets = np.concatenate([[0], *(p.offsets[1:] + s for p, s in zip(parts, starts, strict=False))])
        first = parts[0]
        ticks = None if first.ticks is None else np.concatenate([p.ticks for p in parts])
        times = None if ticks is not None else np.concatenate([p.times for p in parts])
        cause = parent = None
        if first.cause is not None:
            cause = np.concatenate([p.cause for p in parts])
            parent = np.concatenate([_shifted(p.parent, s) for p, s in zip(parts, starts, strict=False)])
        return Events(times, offsets, first.pixels, ticks, first.tick, None, first.end, cause, parent)

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


def read_only(array: np.ndarray) -> np.ndarray:
    """The same array, which cannot be written through what is returned."""
    view = array.view()
    view.flags.writeable = False
    return view


class SealedEvents(Events):
    """Events as somebody else's code gets them: neither they nor their arrays can be changed.

    What is made of them can be: `keep`, `moved` and `stamped` are those of the events themselves.

    whole: the events themselves.
    """

    __slots__ = ("whole",)

    def __new__(cls, *given: Any, **named: Any) -> Any:
        """`type(events)(times, offsets, pixels)` makes events of somebody's own, which are not sealed."""
        sealed = len(given) == 1 and isinstance(given[0], Events)
        return object.__new__(cls) if sealed else Events(*given, **named)

    def __init__(self, whole: Events):
        own = (whole.offsets, whole.ticks, whole.row_pixel, whole.cause, whole.parent, whole._image_offsets)
        offsets, ticks, row_pixel, cause, parent, images = (None if a is None else read_only(a) for a in own)
        assert offsets is not None
        super().__init__(
            None, offsets, whole.pixels, ticks, whole.tick, row_pixel, whole.end, cause, parent, image_offsets=images
        )
        self.whole = whole

    def __setattr__(self, name: str, value: object) -> None:
        if hasattr(self, "whole"):
            raise AttributeError(f"the {name} of these events cannot be set")
        object.__setattr__(self, name, value)

    @property
    def times(self) -> np.ndarray:
        """(events,) s."""
        return read_only(self.whole.times)

    def keep(self, mask: np.ndarray) -> Events:
        """The events for which `mask` (events,) is true."""
        return self.whole.keep(mask)

    def moved(self, times: np.ndarray) -> Events:
        """The same events at other times (s), see `Events.moved`."""
        return self.whole.moved(times)

    def stamped(self, ticks: np.ndarray, tick: float) -> Events:
        """The same events with whole ticks (events,) of a converter in place of their times."""
        return self.whole.stamped(ticks, tick)


def longest_gap(stamps: np.ndarray, start: float, end: float) -> tuple[float, int]:
    """(the longest gap between neighbours of all stamps, in any order, with start and end; how many are before `end`).

    No stamp is before `start`.
    """
    if not end > start:
        return 0.0, 0
    gap, count, hidden = kernels.longest_gap(stamps, start, end, max(1, len(stamps) // 8), _BINS)
    if hidden:  # as good as never: the longest gap is shorter than eight mean ones, but never than a mean one
        gap, _, _ = kernels.longest_gap(stamps, start, end, 2 * (count + 1), _BINS)
    return float(gap), int(count)


def _shifted(parent: np.ndarray | None, by: int | np.ndarray) -> np.ndarray:
    """Indices moved by so much; what is negative stays."""
    assert parent is not None
    return np.where(parent >= 0, parent + by, parent)


@dataclass(frozen=True)
class Children:
    """What a correlated effect adds: events that other events may cause.

    parent: (children,) int64, index of the event that may cause it; delay: (children,) s, not negative, counted from
    the moment at which the cause acts; row: (children,) the row in which it falls, None: its parent's own.
    """

    parent: np.ndarray
    delay: np.ndarray
    row: np.ndarray | None = None
