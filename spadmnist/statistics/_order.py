"""The detections of the whole array in the order of time, for all statistics that go through them.

They are sorted once and held, 8 bytes each. Of more than are held, each statistic has them piece by piece.
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..kernels import jit, rows_upto
from ..recording import Recording
from ._counting import exposure_in, sort_ticks, tick_of, whole_ticks

_MOST_HELD = 1 << 24  # detections whose order is held, 134 MB: more take no more memory, and are sorted anew each time
_PIECE = 1 << 22  # detections in a piece of more
_AT_ONCE = 16384  # events that are sorted together: they fit into the cache


class TimeOrder(NamedTuple):
    """Detections in the order of time; of those at the same tick the lower pixel first.

    words: (events,) int64, the tick above the lowest `bits` bits, which are the pixel.
    """

    words: np.ndarray
    bits: int


def time_order(recording: Recording) -> TimeOrder:
    """The detections of a recording of time stamps, in order; ticks of more than 62 bits less `bits` are left out."""

    def make() -> TimeOrder:
        assert recording.events is not None
        bits = max(1, (recording.pixels - 1).bit_length())
        ticks, _ = whole_ticks(recording)
        return TimeOrder(_in_order(ticks, recording.events.offsets, _slabs(recording, bits), bits), bits)

    return recording.kept("time order", make)


def is_held(recording: Recording) -> bool:
    """Does the order of all detections lie in memory, in one piece?"""
    return recording.events is not None and len(recording.events) <= _MOST_HELD


def in_time_order(recording: Recording, reach: int = 0, least: int = 0) -> Iterator[tuple[np.ndarray, int, int]]:
    """(words, bits, new) of the detections in order, see `TimeOrder`, piece by piece; those before `new` came before.

    Of these there are as many as lie within `reach` ticks of the first new one, and at least the `least` latest.
    """
    assert recording.events is not None
    offsets = recording.events.offsets
    if is_held(recording):
        yield *time_order(recording), 0
        return
    ticks, _ = whole_ticks(recording)
    bits = max(1, (recording.pixels - 1).bit_length())
    plan = _slabs(recording, bits)
    if not _rise(ticks, offsets):
        yield _in_order(ticks, offsets, plan, bits), bits, 0
        return
    position, slab, many = offsets[:-1].copy(), 0, max(1, plan.number * _PIECE // len(ticks))
    before = np.empty(0, np.int64)
    while slab < plan.number:
        stop = min(slab + many, plan.number)
        count = int((rows_upto(ticks, offsets, position, np.uint64(plan.end_of(stop))) - position).sum())
        if count > 2 * _PIECE and many > 1:
            many //= 2
            continue
        words = np.empty(len(before) + count, np.int64)
        words[: len(before)] = before
        _sort_slabs(ticks, offsets, position, (slab, stop), plan, bits, words, len(before))
        if count:
            yield words, bits, len(before)
        slab, many = stop, many * 2 if count < _PIECE // 2 else many
        next_one = np.int64(plan.width * slab) << bits
        near = int(np.searchsorted(words, next_one - (np.int64(reach) << bits)))
        before = words[max(0, min(near, len(words) - least)) :].copy()


class _Plan(NamedTuple):
    """Slabs of time that are sorted by themselves. number: of them; width: of one, ticks; top: where the last ends."""

    number: int
    width: int
    top: int

    def end_of(self, slabs: int) -> int:
        """The tick at which so many slabs end."""
        return self.width * slabs if slabs < self.number else self.top


def _slabs(recording: Recording, bits: int) -> _Plan:
    """The plan of slabs of about as many detections as fit into the cache."""
    assert recording.events is not None
    number = 1 + len(recording.events) // max(_AT_ONCE, 2 * recording.pixels)
    return _Plan(number, exposure_in(recording, tick_of(recording)) // number + 1, (1 << (62 - bits)) - 1)


@jit
def _rise(stamps, offsets):
    """Are the stamps of each row in order?"""
    for row in range(offsets.size - 1):
        for i in range(offsets[row] + 1, offsets[row + 1]):
            if stamps[i] < stamps[i - 1]:
                return False
    return True


def _in_order(stamps: np.ndarray, offsets: np.ndarray, plan: _Plan, bits: int) -> np.ndarray:
    """All rows' stamps with their rows in the lower bits, in order: a slab of time after the other."""
    out = np.empty(offsets[-1], np.int64)
    used, ordered = _sort_slabs(stamps, offsets, offsets[:-1].copy(), (0, plan.number), plan, bits, out, 0)
    if not ordered:  # a row is not
        out[:used].sort()
    return out[:used]


@jit
def _sort_slabs(stamps, offsets, position, some, plan, bits, out, used):
    """Put the stamps of some slabs (first, behind the last) into `out` from `used` on; moves `position` on.

    Returns (how far `out` is used, are they in order? Where a row is not they may not be).
    """
    raw = np.empty(2 * offsets[offsets.size - 1] // plan.number + 1024, np.int64)
    ordered = True
    for slab in range(some[0], some[1]):
        stop = (slab + 1) * plan.width if slab < plan.number - 1 else plan.top
        before = position.copy()
        count = _gather(stamps, offsets, position, stop, bits, raw)
        while count < 0:
            raw = np.empty(2 * raw.size, np.int64)
            position[:] = before
            count = _gather(stamps, offsets, position, stop, bits, raw)
        sort_ticks(raw, count, (slab * plan.width) << bits, plan.width << bits, out, used)
        if 0 < used < used + count and out[used] < out[used - 1]:
            ordered = False
        used += count
    return used, ordered


@jit
def _gather(stamps, offsets, position, stop, bits, raw):
    """The stamps before `stop`, with their rows in the lower bits; moves `position` on. -1 where there is no room."""
    count = np.uint64(0)
    for row in range(offsets.size - 1):
        i = np.uint64(position[row])
        end = min(np.uint64(offsets[row + 1]), i + np.uint64(raw.size) - count)
        while i < end and np.int64(stamps[i]) < stop:
            raw[count] = (np.int64(stamps[i]) << bits) | row
            count += np.uint64(1)
            i += np.uint64(1)
        if count == np.uint64(raw.size) and i < np.uint64(offsets[row + 1]):
            return -1
        position[row] = i
    return np.int64(count)
