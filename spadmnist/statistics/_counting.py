"""What several statistics share: whole ticks, logarithmic bins, counts of pairs beyond chance, and words for sizes."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from .. import units
from ..kernels import inline, jit
from ..recording import Recording
from ._scores import poisson_score, shares, wilson_hilferty

_FREE_RUNNING = 1e-11  # s: the tick that stands in where stamps are seconds
_OCTAVE = 16  # entries of a guide for each octave


def whole_ticks(recording: Recording) -> tuple[np.ndarray, float]:
    """((events,) unsigned ticks of a TR recording, their length in s)."""
    events = recording.events
    assert events is not None
    if events.ticks is not None and recording.tick is not None:
        return events.ticks, recording.tick
    return np.rint(events.times / _FREE_RUNNING).astype(np.uint64), _FREE_RUNNING


def tick_of(recording: Recording) -> float:
    """s; the length of the ticks that `whole_ticks` gives."""
    return recording.tick or _FREE_RUNNING


def exposure_in(recording: Recording, tick: float) -> int:
    """The exposure in ticks."""
    return max(1, round(recording.conditions.exposure / tick))


@lru_cache(maxsize=64)
def logarithmic(first: int, last: int, per_decade: int) -> np.ndarray:
    """Whole edges from `first` to `last`, evenly spaced on a logarithmic scale where they are not too narrow for it."""
    first, last = max(1, first), max(1, first, last)
    steps = max(1, round(per_decade * math.log10(last / first)))
    edges = np.unique(np.rint(np.geomspace(first, last, steps + 1)).astype(np.int64))
    edges.setflags(write=False)
    return edges


@lru_cache(maxsize=64)
def _guide(edges: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    keys = np.arange(53 * _OCTAVE, dtype=np.int64)
    least = ((keys + (1023 << 4)) << 48).view(np.float64)  # the smallest number with these leading bits
    start = np.searchsorted(np.array(edges), np.ceil(least), side="right") - 1
    if edges[0] < 1 or np.diff(start).max() > 1:
        raise ValueError("these edges are too close to each other")
    return np.array([*edges, np.iinfo(np.int64).max]), start


def guide(edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(edges with one beyond everything, where to start): what `place` needs to find the bin of a number at once.

    edges: whole numbers from 1 on, more than a sixteenth of an octave apart.
    """
    return _guide(tuple(edges.tolist()))


@inline
def place(value, edges, start):
    """The bin of a whole number: k for edges[k] <= value < edges[k + 1], -1 below the first edge.

    edges, start: see `guide`. At most one edge lies within the numbers that have the same leading bits.
    """
    if value < edges[0]:
        return np.int64(-1)
    k = start[(np.float64(value).view(np.int64) >> 48) - (1023 << 4)]
    return k + (edges[k + 1] <= value)


_DIGIT = 2048


@jit
def sort_ticks(raw, count, low, span, out, first):
    """Put `raw[:count]` in order into `out[first:]`: whole numbers, most of them between low and low + span, evenly.

    By the upper 22 bits of their place in two turns; what has the same ones, or lies outside, is put right at the end.
    """
    if count < _DIGIT // 4:
        out[first : first + count] = raw[:count]
        out[first : first + count].sort()
        return
    scale = _DIGIT * np.float64(_DIGIT) / max(span, 1)
    most = np.int64(_DIGIT * _DIGIT - 1)
    keys = np.empty(count, np.uint32)
    for i in range(count):
        keys[i] = min(max(np.int64((raw[i] - low) * scale), 0), most)
    lower = np.zeros(_DIGIT + 1, np.uint32)
    upper = np.zeros(_DIGIT + 1, np.uint32)
    for i in range(np.uint64(count)):
        lower[np.uint64(keys[i] & np.uint32(2047)) + np.uint64(1)] += np.uint32(1)
        upper[np.uint64(keys[i] >> np.uint32(11)) + np.uint64(1)] += np.uint32(1)
    for b in range(_DIGIT):
        lower[b + 1] += lower[b]
        upper[b + 1] += upper[b]
    spare = np.empty(count, np.int64)
    left = np.empty(count, np.uint16)
    for i in range(np.uint64(count)):
        digit = np.uint64(keys[i] & np.uint32(2047))
        at = np.uint64(lower[digit])
        spare[at] = raw[i]
        left[at] = keys[i] >> np.uint32(11)
        lower[digit] += np.uint32(1)
    for i in range(np.uint64(count)):
        digit = np.uint64(left[i])
        out[np.uint64(first) + np.uint64(upper[digit])] = spare[i]
        upper[digit] += np.uint32(1)
    moves = 0
    for i in range(first + 1, first + count):
        value = out[i]
        k = i
        while k > first and out[k - 1] > value:
            out[k] = out[k - 1]
            k -= 1
        out[k] = value
        moves += i - k
        if moves > 8 * count:  # they do not lie evenly at all
            out[first : first + count].sort()
            break


class Surplus(NamedTuple):
    """Numbers of pairs, cell by cell; how many of them chance makes of the pixels' totals, and its variance."""

    number: np.ndarray
    chance: np.ndarray
    variance: np.ndarray

    def scores(self, totals: np.ndarray) -> np.ndarray:
        """(cells,) normal scores of what is beyond chance, given the pixels' totals.

        Neither the light level nor a map of the pixels changes them, and they have the same law whether many pairs
        are expected or none: see `_scores`.
        """
        # a little above 0, for where no pairs are possible
        mean = np.maximum(self.variance, 1e-6)
        count = np.maximum(self.number - self.chance + mean, 0.0)
        # few are whole numbers, but for a little that chance and its variance differ by
        count = np.where(mean < 100.0, np.rint(count), count)
        share = shares(np.append(totals, len(mean)), len(mean))
        return poisson_score(count, mean, share)

    def beyond(self, cell: int, score: float) -> float:
        """The pairs beyond chance that this score of a cell means."""
        mean = max(float(self.variance[cell]), 1e-6)
        low, high = 0.0, 10.0 * (mean + score * score + 10.0)
        for _ in range(100):
            middle = (low + high) / 2
            if wilson_hilferty(middle + 0.5, mean) < score:
                low = middle
            else:
                high = middle
        return high - mean


def whole(count: float) -> str:
    """A count or its expectation as text: a whole number from 10 on, otherwise three digits."""
    return f"{count:.0f}" if abs(count) >= 10 else f"{count:.3g}"


def per_cent(share: float) -> str:
    """A share in per cent with three digits: 0.82 %, +1.5e-05 %."""
    return f"{100 * share:.3g} %"


def root_of(variance: float) -> float:
    """The square root with the sign of the variance: what is beyond noise may be less than nothing."""
    return float(np.copysign(np.sqrt(abs(variance)), variance))


def of_detections(total: float) -> Callable[[int, float, float], tuple[str, float]]:
    """The `size` of cells that count detections, of which there are `total`."""

    def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
        share = float(measured - expected) / max(float(total), 1.0)
        return f"{'excess' if share >= 0 else 'deficit'} of {per_cent(abs(share))} of detections", share

    return size


def of_pairs(pairs: Surplus, total: float) -> Callable[[int, float, float], tuple[str, float]]:
    """The `size` of cells that are scores of pairs, as a share of the `total` detections."""

    def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
        found = float(pairs.number[cell] - pairs.chance[cell]) / max(float(total), 1.0)
        usual = pairs.beyond(cell, expected) / max(float(total), 1.0)
        return f"{per_cent(found)} of detections beyond chance, {per_cent(usual)} expected", float(found - usual)

    return size


@lru_cache(maxsize=4096)  # each recording of a capture asks for the same ones
def span(low: float, high: float, unit: str = "s") -> str:
    """Two quantities with a unit: 10 to 30 ns, or 300 ns to 1 us."""
    a, b = units.show(low, unit), units.show(high, unit)
    if low == 0:
        a = f"0 {b.partition(' ')[2]}"
    number, _, name = a.partition(" ")
    return f"{number} to {b}" if name == b.partition(" ")[2] else f"{a} to {b}"
