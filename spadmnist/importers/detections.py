"""Detections of a file, read piece by piece as often as they are asked for: they need not fit into the memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ..errors import InputError
from . import MOST_CHANNELS

_KEPT = 1 << 28  # bytes: pieces that are no more than this together are kept, so that the file is read once
_PIECE = 1 << 20  # detections that are looked at together

Pieces = Iterator[tuple[np.ndarray, np.ndarray]]


class Detections:
    """Which input had a detection, and when, in the order of the file.

    counts: (channels,) int64, detections of each channel; first, last: the earliest and the latest tick, both 0 where
    there is no detection.
    """

    def __init__(self, path: Path, read: Callable[[], Pieces]):
        """read: gives (channel, ticks), (n,) whole numbers each, piece after piece, anew at each call. All are looked
        at here, once. Raises InputError for a channel that cannot be one.
        """
        self._kept: list[tuple[np.ndarray, np.ndarray]] | None = []
        self.counts = np.zeros(0, np.int64)
        self.first = self.last = 0
        low, high, size, ends = 0, -1, 0, list[int]()
        for channel, ticks in _cut(read()):
            low, high = min(low, int(channel.min())), max(high, int(channel.max()))
            if low < 0 or high >= MOST_CHANNELS:
                continue
            here = _narrow(channel, high), _plain(ticks)
            self._count(np.bincount(here[0]))
            ends = [*ends, int(ticks.min()), int(ticks.max())]
            self.first, self.last = ends = [min(ends), max(ends)]
            size += sum(part.nbytes for part in here)
            if self._kept is not None:
                self._kept.append(here)
            if size > _KEPT:
                self._kept = None
        self._read = read if self._kept is None else lambda: iter(())
        if low < 0 or high >= MOST_CHANNELS:
            wrong = low if low < 0 else high
            raise InputError(f"{path}: has a channel {wrong}; channels are 0 to {MOST_CHANNELS - 1}: correct the file")

    @classmethod
    def of(cls, path: Path, channel: np.ndarray, ticks: np.ndarray) -> Detections:
        """Detections that lie in memory. channel, ticks: (n,). Raises InputError where these are not as many."""
        check_lengths(path, len(ticks), len(channel))
        return cls(path, lambda: iter([(channel, ticks)]))

    def _count(self, here: np.ndarray) -> None:
        if len(here) > len(self.counts):
            self.counts = np.concatenate([self.counts, np.zeros(len(here) - len(self.counts), np.int64)])
        self.counts[: len(here)] += here

    def __len__(self) -> int:
        """Number of detections."""
        return int(self.counts.sum())

    def pieces(self) -> Pieces:
        """(channel, ticks), (n,) each: unsigned and signed or unsigned 64-bit integers."""
        for channel, ticks in _cut(self._read() if self._kept is None else iter(self._kept)):
            yield _narrow(channel, MOST_CHANNELS - 1), ticks.astype(_wide(ticks), copy=False)


def check_lengths(path: Path, times: int, pixels: int) -> None:
    """Raise InputError where not every detection has a time and a pixel."""
    if times != pixels:
        raise InputError(f"{path}: has {times:,} times and {pixels:,} pixels; it needs as many of both")


def _cut(pieces: Pieces) -> Pieces:
    """The same in pieces of no more than a few detections, and none of nothing."""
    for channel, ticks in pieces:
        for start in range(0, len(channel), _PIECE):
            yield channel[start : start + _PIECE], ticks[start : start + _PIECE]


def _narrow(channel: np.ndarray, most: int) -> np.ndarray:
    """Channels in few bytes, as what can be an index."""
    if channel.dtype.kind == "u" and channel.dtype.isnative and channel.dtype.itemsize <= 4:
        return channel
    return channel.astype(np.uint8 if most < 1 << 8 else np.uint16 if most < 1 << 16 else np.uint32)


def _plain(ticks: np.ndarray) -> np.ndarray:
    return ticks.astype(ticks.dtype.newbyteorder("="), copy=False)


def _wide(ticks: np.ndarray) -> type[np.signedinteger | np.unsignedinteger]:
    return np.int64 if ticks.dtype.kind == "i" else np.uint64
