"""Which pixel a channel is, and detections as rows of pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from .. import capture_files, units
from ..errors import InputError
from ..events import Events, Layout
from ..import_options import MOST_ROWS
from ..readout import no_detection, stamps_for
from ..recording import Capture, Recording
from . import MOST_CHANNELS, Found, Said
from .detections import Detections, Pieces

_NO_PIXEL = -1
_MOST_NAMED = 20  # channels that a sentence lists


@dataclass(frozen=True)
class Array:
    """The pixels of a measurement.

    channels: (pixels,) the channel that each pixel is; None where a channel's number is that of its pixel.
    """

    layout: Layout
    channels: tuple[int, ...] | None = None


class Channels:
    """The channels of several files: which are in use, how they are called, which the files say are pixels."""

    def __init__(self) -> None:
        self.used = np.zeros(0, bool)
        self.numbered = np.zeros(0, bool)  # those in use that some file knows by their number alone
        self.names: dict[int, str] = {}
        self.declared: np.ndarray | None = None  # each once, in the order in which the files name them
        self.where: Path | None = None  # the first file with detections

    def add(self, path: Path, found: Found) -> None:
        """Take in what a file holds."""
        assert found.detections is not None
        here = found.detections.counts > 0
        self.where = self.where or path
        self.used = _either(self.used, here)
        here[[c for c in found.names if c < len(here)]] = False
        self.numbered = _either(self.numbered, here)
        self.names |= found.names
        for channel, name in self.names.items():
            if channel < len(self.numbered) and self.numbered[channel]:
                raise InputError(
                    f"{path}: some files call the channel {channel} {name}, others do not; import these by themselves"
                )
        if found.pixels is not None:
            numbers = np.asarray(found.pixels, np.int64)
            before = np.zeros(0, np.int64) if self.declared is None else self.declared
            self.declared = np.concatenate([before, numbers[~np.isin(numbers, before)]])

    @property
    def in_use(self) -> list[int]:
        """Channels with a detection; those with a name come first."""
        return sorted(map(int, np.flatnonzero(self.used)), key=lambda c: (c not in self.names, c))

    def as_pixels(self, path: Path) -> tuple[int, ...]:
        """The channels that become pixels where nobody says which: those that the files declare, or those in use.

        path: the first file, for messages. Raises InputError where they are more than can be held.
        """
        in_use = self.in_use
        if self.declared is None:
            return tuple(in_use)
        rest = np.asarray(in_use, np.int64)
        rest = rest[~np.isin(rest, self.declared)]
        _check_size(path, 1, len(self.declared) + len(rest))
        return (*map(int, self.declared), *map(int, rest))

    def chosen(self, names: Sequence[str]) -> tuple[int, ...]:
        """The channels that are called so. Raises InputError where none of them has a detection."""
        known = {name: channel for channel, name in self.names.items()}
        there = self.called(self.in_use) or "none"
        for name in names:
            is_number = name.isdigit() and int(name) < MOST_CHANNELS and int(name) not in self.names
            if name not in known and not is_number:
                raise InputError(f"{self.where}: has no channel {name!r}; --channels names some of {there}")
        found = tuple(known[name] if name in known else int(name) for name in names)
        if not set(found) & set(self.in_use):
            raise InputError(
                f"{self.where}: has no detection of {', '.join(names)}; --channels names some of those in use: {there}"
            )
        return found

    def called(self, channels: Sequence[int]) -> str:
        """Channels as the file calls them, in a row."""
        shown = ", ".join(self.names.get(c, str(c)) for c in channels[:_MOST_NAMED])
        return shown + (", ..." if len(channels) > _MOST_NAMED else "")


def _check_size(path: Path, rows: int, columns: int) -> None:
    """Raise InputError for more pixels than can be held."""
    if rows * columns > MOST_CHANNELS or max(rows, columns) > MOST_ROWS:
        raise InputError(
            f"{path}: {rows} x {columns} pixels are more than the {MOST_CHANNELS:,}, and {MOST_ROWS:,} in a row or "
            "column, that can be held; give other --rows and --columns"
        )


def _either(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """One or the other, as long as the longer."""
    out = np.zeros(max(len(one), len(two)), bool)
    out[: len(one)] |= one
    out[: len(two)] |= two
    return out


def array(
    path: Path, said: Said, shapes: Sequence[tuple[int, int]], channels: Channels, positions: np.ndarray | None
) -> Array:
    """The pixels of some files.

    path: the first file, for messages; shapes: rows and columns as far as user, file or plan say them, all alike;
    positions: (pixels, 2) m, where they are no grid. Raises InputError with a sentence.
    """
    shape = shapes[0] if shapes else None
    if positions is not None:
        if shape is not None and shape != (1, len(positions)):
            named = "the plan" if said.positions is None else said.positions
            raise InputError(
                f"{named}: names {len(positions)} pixels, but {path} has {_by(shape)}; correct one of them"
            )
        shape = (1, len(positions))
    numbers = None
    if said.channels is not None:
        numbers = channels.chosen(said.channels)
        if shape is not None and shape[0] * shape[1] != len(numbers):
            raise InputError(
                f"--channels: {len(numbers)} channels are no {_by(shape)} pixels; name a channel for each pixel"
            )
    elif shape is None:
        numbers = channels.as_pixels(path)
    rows, columns = shape or (1, len(numbers or ()))
    if rows * columns == 0:
        raise InputError(f"{path}: holds no detection at all; give --rows and --columns to import it nevertheless")
    _check_size(path, rows, columns)
    if positions is not None:
        return Array(Layout(1, len(positions), np.nan, np.nan, positions), numbers)
    return Array(Layout(rows, columns, np.nan, np.nan), numbers)


@dataclass(frozen=True)
class Placed:
    """Detections of a capture as rows of pixels, in time order. notes, left_out: as in `Found`."""

    recording: Recording
    notes: tuple[str, ...]
    left_out: tuple[str, ...]


def events(path: Path, found: Found, said: Said, capture: Capture, array: Array, channels: Channels) -> Placed:
    """The detections of a file. Raises InputError for a channel that is no pixel and a time outside the exposure."""
    detections, exposure = found.detections, capture.conditions.exposure
    tick = found.facts.get("tick", said.tick)
    assert detections is not None and tick is not None
    notes, left_out = [], []
    if path == channels.where and said.channels is not None and array.channels is not None:
        used = channels.in_use
        if silent := [c for c in array.channels if c not in used]:
            is_of = f"s {channels.called(silent)} have" if len(silent) > 1 else f" {channels.called(silent)} has"
            notes.append(f"the channel{is_of} no detection in any file")
    pixel_of = _pixels(path, detections.counts, array, channels)
    outside = np.flatnonzero((pixel_of == _NO_PIXEL) & (detections.counts > 0))
    if len(outside):
        which = f"the channel{'s' * (len(outside) > 1)} {channels.called(list(map(int, outside)))}"
        left_out.append(f"{int(detections.counts[outside].sum()):,} detections of {which} (--channels)")
    some = _Chosen(detections, pixel_of, bool(len(outside)))
    counts = np.zeros(array.layout.pixels, np.int64)
    counts[pixel_of[pixel_of != _NO_PIXEL]] = detections.counts[pixel_of != _NO_PIXEL]
    start, number = 0, int(counts.sum())
    low, high = some.ends
    if said.subtract_start and number:
        start = low
        notes.append(f"its clock is counted from the first detection, at {units.show(float(start) * tick, 's', 12)}")
    end = _check_times(path, number, low - start, high - start, tick, exposure, said)
    kind = np.dtype(stamps_for(end, f"{path}: time stamps"))
    capture_files.check_number(path, number, kind)
    in_use = int(np.count_nonzero(counts))
    _check_wrapped(path, some, number, in_use, start, high - start, tick, exposure)
    rows = capture_files.Rows(counts, kind)
    for pixel, ticks in some.pieces():
        rows.put(pixel, ticks - ticks.dtype.type(start))
    if rows.late:
        back = units.show(float(rows.back) * tick, "s")
        notes.append(f"its times fall back {rows.late:,} times within a pixel, by up to {back}; they were sorted")
    placed = Events(None, rows.offsets, array.layout.pixels, rows.ordered(), tick, end=exposure)
    return Placed(Recording(capture, array.layout, placed, None, tick), tuple(notes), tuple(left_out))


def _pixels(path: Path, counts: np.ndarray, array: Array, channels: Channels) -> np.ndarray:
    """The pixel of each channel; `_NO_PIXEL` where it is of none. counts: (channels,) detections of the file."""
    if array.channels is None:
        used = channels.in_use
        unnumbered = [c for c in used if c in channels.names]
        beyond = [c for c in used if c not in channels.names and c >= array.layout.pixels]
        wrong = [c for c in [*unnumbered, *beyond] if c < len(counts) and counts[c] > 0]
        if wrong:
            why = "has no number" if wrong[0] in channels.names else f"lies beyond the {_by(array.layout.shape)} pixels"
            listed = channels.called(used).replace(" ", "")
            raise InputError(
                f"{path}: the channel {channels.called(wrong[:1])} {why}; say with --channels {listed} which channels "
                "the pixels are, in their order, or give other --rows and --columns"
            )
        return np.arange(len(counts), dtype=np.int32)
    pixel_of = np.full(max(len(counts) - 1, 0, *array.channels) + 1, _NO_PIXEL, np.int32)
    pixel_of[list(array.channels)] = np.arange(len(array.channels))
    return pixel_of[: len(counts)]


@dataclass(frozen=True)
class _Chosen:
    """The detections of a file that are of pixels. pixel_of: (channels,); others: are there other ones?"""

    detections: Detections
    pixel_of: np.ndarray
    others: bool

    def pieces(self) -> Pieces:
        """(pixel, ticks) piece after piece."""
        for channel, ticks in self.detections.pieces():
            pixel = self.pixel_of[channel]
            if self.others:
                kept = pixel != _NO_PIXEL
                pixel, ticks = pixel[kept], ticks[kept]
            if len(pixel):
                yield pixel, ticks

    @cached_property
    def ends(self) -> tuple[int, int]:
        """The first and the last tick; 0 where there is none."""
        if not self.others:
            return self.detections.first, self.detections.last
        found = [int(end) for _, ticks in self.pieces() for end in (ticks.min(), ticks.max())] or [0]
        return min(found), max(found)


_COUNTERS = (16, 24, 32, 40, 48)  # bits of counters of time, as converters have them
_FEW = 30  # detections below which an order in the file tells nothing of a counter
_FILLED = 15  # mean intervals that the last time may lie below the counter's end: by chance it lies lower in e^-15


def _check_wrapped(
    path: Path, some: _Chosen, number: int, in_use: int, start: int, most: int, tick: float, exposure: float
) -> None:
    """Raise InputError where the times, in the order of the file, look like those of a counter that began anew.

    It counts less far than the exposure lasts, the times fill it, and where they fall back by more than a hundredth of
    it, they nearly always fall back by more than half. In a file that is in the order of its pixels, times fall back
    from one pixel to the next. number: of detections, in_use: of pixels with one; start: the tick that is 0, most: the
    last one since then.
    """
    if number < _FEW:
        return
    bits = next((bits for bits in _COUNTERS if most < 1 << bits), None)
    if bits is None or exposure / tick <= 1 << bits or most < (1 << bits) * (1 - _FILLED / number):
        return
    falls = [_Falls(), _Falls()]  # of all detections, and of those of the same pixel
    changes = 0
    before: tuple[np.ndarray, np.ndarray] | None = None
    for pixel, ticks in some.pieces():
        if before is not None:
            pixel, ticks = (np.concatenate([a[-1:], b]) for a, b in zip(before, (pixel, ticks), strict=True))
        before = pixel, ticks
        fall = np.where(ticks[:-1] > ticks[1:], ticks[:-1] - ticks[1:], 0)
        other = pixel[1:] != pixel[:-1]
        changes += int(np.count_nonzero(other))
        falls[0].add(fall, ticks, bits)
        falls[1].add(np.where(other, 0, fall), ticks, bits)
    found = falls[changes < in_use]
    if found.far and found.far >= 0.9 * found.wide:
        times = [units.show(float(int(t) - start) * tick, "s") for t in found.first]
        raise InputError(
            f"{path}: its times fall back {found.far:,} times by more than half of what {bits} bits count (first "
            f"from {times[0]} to {times[1]}): the counter began anew; store times that go on, in 64 bits, or, where "
            "the recording was no longer than them, sort them"
        )


@dataclass
class _Falls:
    """How often times fall back: by more than a hundredth of a counter (wide), by more than half of it (far); the first
    such pair of ticks.
    """

    wide: int = 0
    far: int = 0
    first: tuple[int, int] = (0, 0)

    def add(self, fall: np.ndarray, ticks: np.ndarray, bits: int) -> None:
        """Take in some detections. fall: (n - 1,) by how much each time is less than the one before; ticks: (n,)."""
        self.wide += int(np.count_nonzero(fall > (1 << bits) // 100))
        far = fall > 1 << (bits - 1)
        if not self.far and far.any():
            at = int(far.argmax())
            self.first = int(ticks[at]), int(ticks[at + 1])
        self.far += int(np.count_nonzero(far))


def _check_times(path: Path, number: int, low: int, high: int, tick: float, exposure: float, said: Said) -> int:
    """The last tick of the exposure. Raises InputError where a stamp lies outside: number of them, from low to high."""
    if tick > exposure:
        times = units.show(tick, "s", 9), units.show(exposure, "s", 9)
        raise InputError(f"{path}: its ticks of {times[0]} are longer than the exposure of {times[1]}; correct one")
    end = no_detection(exposure, tick)
    if not number or (low >= 0 and high <= end):
        return end
    # as many digits as tell the last time from the exposure
    digits = next(
        (n for n in (9, 12, 15) if units.show(float(high) * tick, "s", n) != units.show(exposure, "s", n)), 17
    )
    first, last = (units.show(float(t) * tick, "s", digits) for t in (low, high))
    advice = "give another --exposure"
    if 0 <= high - low <= end and not said.subtract_start:
        advice = "if its clock does not start at 0, give --subtract-start, otherwise another --exposure"
    raise InputError(
        f"{path}: its times, in ticks of {units.show(tick, 's')}, reach from {first} to {last}, outside the exposure "
        f"of {units.show(exposure, 's', digits)}; {advice}"
    )


def _by(shape: Sequence[int]) -> str:
    return " x ".join(map(str, shape))
