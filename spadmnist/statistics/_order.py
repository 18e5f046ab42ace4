"""The detections of the whole array in the order of time, sorted once for all statistics that go through them."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..kernels import jit
from ..recording import Recording
from ._counting import exposure_in, sort_ticks, whole_ticks

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
        ticks, tick = whole_ticks(recording)
        bits = max(1, (recording.pixels - 1).bit_length())
        return TimeOrder(_ordered(ticks, recording.events.offsets, exposure_in(recording, tick), bits), bits)

    return recording.kept("time order", make)


@jit
def _ordered(stamps, offsets, end, bits):
    """All rows' stamps with their rows in the lower bits, in order: a slab of time after the other."""
    rows = offsets.size - 1
    total = offsets[rows]
    out = np.empty(total, np.int64)
    slabs = 1 + total // max(_AT_ONCE, 2 * rows)
    width = end // slabs + 1
    top = (np.int64(1) << (62 - bits)) - 1
    position = offsets[:-1].copy()
    raw = np.empty(2 * total // slabs + 1024, np.int64)
    used = 0
    ordered = True
    for slab in range(slabs):
        stop = (slab + 1) * width if slab < slabs - 1 else top
        before = position.copy()
        count = _gather(stamps, offsets, position, stop, bits, raw)
        while count < 0:
            raw = np.empty(2 * raw.size, np.int64)
            position[:] = before
            count = _gather(stamps, offsets, position, stop, bits, raw)
        sort_ticks(raw, count, (slab * width) << bits, width << bits, out, used)
        if 0 < used < used + count and out[used] < out[used - 1]:
            ordered = False
        used += count
    if not ordered:  # a row is not
        out[:used].sort()
    return out[:used]


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
