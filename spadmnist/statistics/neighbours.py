"""Detections of different pixels that come together: of neighbours, and of the whole array."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np

from ..kernels import jit
from . import Recording, Statistic, Summary
from ._counting import Surplus, exposure_in, of_pairs, per_cent, span, tick_of
from ._frames import at_ends, bits, count_ones, first_stamps, frame_sums, moments, ones_of, some_frames
from ._walk import REACH, SIDES, Near, around, lag_edges, latest, near, walk

_CLEAR = 3.5  # standard deviations beyond which a single cell is an error of the model; of 100, one in 20 by chance
_CROWDED = 24  # places for each stamp, up to which all places of a frame are gone through
_SPOTS = 512  # places that are looked at together
# s: side neighbours are taken together up to this lag: crosstalk comes within a few ns, and chance grows with the lag
_CLOSE = 10e-9
_BLOCK = 4096  # words that are looked at together: they stay in the cache
_PARTS = 64  # of a frame, in which the times of first stamps are counted


class Neighbours(Statistic):
    """Coincident detections of neighbouring pixels, by direction, distance and the time between them.

    Directions: horizontal, vertical, both diagonals; then 2 and 3 pitches. In a layout with positions: the nearest
    pixels, then 2 and 3 pitches. Time stamps: up to 1, 3, 10, 30 and 100 ns apart in either order, and for each
    direction one cell for the order of the two. Frames: the same frame, and the next one. First stamps of frames (STR):
    both. Side neighbours in both directions together have cells up to 10 ns, or for the same frame: of a few pairs no
    direction by itself shows much.
    Law: normal, as the score of the pairs beyond chance, given the total of each pixel. The number of pairs is Poisson.
    Its variance is the number by chance; for frames it is (1 - p)(1 - p') times that, with p the share of frames with a
    detection.
    Shows: crosstalk, which `far_pairs` does not show: an excess per detection that is the same at every light level and
    in the dark.
    Source: Ingargiola et al., bioRxiv 207118 (2017), for coincidences by distance.
    """

    modalities = ("tr", "str", "qis", "counts")
    specific = 3
    pools = ("far_pairs",)
    among = "neighbours"
    unit = "standard deviations"

    error = "neighbours"

    @classmethod
    def physical_error(
        cls, measured: np.ndarray, expected: np.ndarray, residuals: np.ndarray, detections: float
    ) -> float:
        """The share of the detections whose neighbours fire too often or too seldom, where that is clearest."""
        k = int(np.argmax(np.abs(residuals)))
        far = abs(float(measured[k] - expected[k])) if abs(residuals[k]) > _CLEAR else 0.0
        return far / max(detections, 1.0)

    def reduce(self, recording: Recording) -> Summary | None:
        """Scores of pairs beyond chance."""
        near_by = near(recording.layout)
        if not near_by.names:
            return None
        parts = [_near_stamps(recording, near_by)] if recording.modality == "tr" else [_near_frames(recording, near_by)]
        if recording.modality == "str":
            parts.append(_near_first(recording, near_by))
        rows = [row for part in parts for row in part]
        pairs = Surplus(*np.array([row[1:] for row in rows]).T)
        size = of_pairs(pairs, float(recording.totals.sum()))
        return Summary(pairs.scores(recording.totals), "normal", lambda cell: rows[cell][0], size)


_Row = tuple[str, float, float, float]  # where, pairs, of these by chance, their variance


class FarPairs(Statistic):
    """Coincident detections of pixels far apart: what the whole array has in common.

    Cells: all pairs of pixels more than 3 pitches apart. Time stamps: up to 1, 3, 10, 30 and 100 ns apart. Frames: the
    same frame, and the next one (there all pairs of different pixels).
    Law: normal, as the score of the pairs beyond chance, given the total of each pixel. The number of pairs is Poisson.
    Its variance is the number by chance; for frames it is (1 - p)(1 - p') times that. Pairs in frames are counted as
    the variance of the array's sums less that of each pixel.
    Shows: a source that fluctuates, flickers or drifts (as much as between neighbours), bursts over the array, and a
    readout that loses detections at high rates (a deficit).
    """

    modalities = ("tr", "str", "qis", "counts")
    specific = 2
    pools = ("spectrum", "delays")
    among = "far"
    unit = "standard deviations"
    costly = True

    def reduce(self, recording: Recording) -> Summary | None:
        """Scores of pairs beyond chance."""
        near_by = near(recording.layout)
        if recording.pixels * (recording.pixels - 1) // 2 == near_by.number:
            return None
        n = recording.totals.astype(np.float64)
        far = (n.sum() ** 2 - n @ n) / 2 - near_by.sums(n, n).sum()
        if recording.modality == "tr":
            tick = tick_of(recording)
            edges = lag_edges(tick)
            counted = walk(recording)
            chance = far * _lags_in(edges) / exposure_in(recording, tick)
            pairs = Surplus(counted.pairs - counted.same - counted.near.sum(axis=0), chance, chance)
            seconds = np.concatenate([[0.0], edges * tick])
            names = [f"pixels more than 3 pitches apart, {span(a, b)}" for a, b in itertools.pairwise(seconds)]
        else:
            pairs = _far_frames(recording, near_by, far)
            names = ["pixels more than 3 pitches apart, the same frame", "different pixels, the next frame"]

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            part = max(float(pairs.chance[cell]), 1.0)
            found = float(pairs.number[cell] - pairs.chance[cell]) / part
            usual = pairs.beyond(cell, float(expected)) / part
            rate = math.sqrt(abs(found - usual))
            text = f"coincidences {_signed(found)} relative to chance, {_signed(usual)} expected"
            if 0 < found - usual < 1:
                text += f"; as of a light that fluctuates by {per_cent(rate)}"
            return text, math.copysign(rate, found - usual)

        return Summary(pairs.scores(recording.totals), "normal", lambda cell: names[cell], size)


def _signed(share: float) -> str:
    return f"{'+' if share >= 0 else ''}{per_cent(share)}"


# --- time stamps ------------------------------------------------------------------------------------------------


def _lags_in(edges: np.ndarray) -> np.ndarray:
    """(bins,) whole lags, of both signs, in each bin."""
    return np.diff(2.0 * edges - 1.0, prepend=0.0)


def _near_stamps(recording: Recording, near_by: Near) -> list[_Row]:
    tick = tick_of(recording)
    edges = lag_edges(tick)
    counted = walk(recording)
    n = recording.totals.astype(np.float64)
    both = near_by.sums(n, n) / exposure_in(recording, tick)
    rows: list[_Row] = []
    for k, name in enumerate(near_by.names):
        low = 0
        for b, lags in enumerate(_lags_in(edges)):
            where = f"{name}, {span(low * tick, edges[b] * tick)}"
            rows.append((where, float(counted.near[k, b]), both[k] * lags, both[k] * lags))
            low = edges[b]
        if near_by.second[k]:
            until = latest(tick)
            where = f"{name}, {near_by.second[k]} later by up to {span(0, until * tick).partition(' to ')[2]}"
            rows.append((where, float(counted.later[k]), both[k] * (until - 1), both[k] * (until - 1)))
    return rows + _together(near_by, counted.near, both, edges, tick)


def _together(near_by: Near, number: np.ndarray, both: np.ndarray, edges: np.ndarray, tick: float) -> list[_Row]:
    """Pairs of side neighbours in both directions, by the shorter lags; none where there is one direction.

    Args:
        number: (classes, bins) pairs.
        both: (classes,) of these by chance at each lag.
        edges: (bins,) ticks, each `tick` s long.
    """
    some = list(near_by.sides)
    if len(some) < 2:
        return []
    found, chance = number[some].sum(axis=0), both[some].sum() * _lags_in(edges)
    ends = np.concatenate([[0.0], edges * tick])
    close = [b for b in range(edges.size) if ends[b + 1] < 1.01 * _CLOSE]
    where = [f"{SIDES}, {span(ends[b], ends[b + 1])}" for b in close]
    return [(words, float(found[b]), float(chance[b]), float(chance[b])) for words, b in zip(where, close, strict=True)]


# --- frames -----------------------------------------------------------------------------------------------------


def _near_frames(recording: Recording, near_by: Near) -> list[_Row]:
    frames = recording.n_frames
    pairs, _ = _near_common(recording, near_by)
    n, _, variance = moments(recording)
    mean = n / frames
    first = some_frames(recording, 0, 1)[0].astype(np.float64)
    last = some_frames(recording, frames - 1, frames)[0].astype(np.float64)
    both, spread = near_by.sums(n, mean), near_by.sums(variance, variance)
    rows: list[_Row] = []
    for k, name in enumerate(near_by.names):
        rows.append((f"{name}, the same frame", float(pairs[k, 0]), both[k], spread[k] * frames))
    if len(some := list(near_by.sides)) > 1:
        same = float(pairs[some, 0].sum()), float(both[some].sum()), float(spread[some].sum()) * frames
        rows.append((f"{SIDES}, the same frame", *same))
    # the first frame has none before it, the last none behind
    most = both / frames * (frames - 1)
    later = near_by.sums(n - last, mean) + near_by.sums(mean, n - first) - most
    earlier = near_by.sums(n - first, mean) + near_by.sums(mean, n - last) - most
    spread = spread * (frames - 1)
    for k, name in enumerate(near_by.names):
        if near_by.second[k]:
            rows.append((f"{name}, {near_by.second[k]} a frame later", float(pairs[k, 1]), later[k], spread[k]))
            rows.append((f"{name}, {near_by.second[k]} a frame earlier", float(pairs[k, 2]), earlier[k], spread[k]))
        else:
            both_ways = float(pairs[k, 1:].sum())
            rows.append((f"{name}, the next frame", both_ways, later[k] + earlier[k], 2 * spread[k]))
    return rows


def _far_frames(recording: Recording, near_by: Near, far: float) -> Surplus:
    frames = recording.n_frames
    sums = frame_sums(recording).astype(np.float64)
    n, squares, variance = moments(recording)
    mean = n / frames
    common, same = _near_common(recording, near_by)
    pairs = np.array([(sums @ sums - squares.sum()) / 2 - common[:, 0].sum(), sums[1:] @ sums[:-1] - same])
    # of all pixels with all, less each with itself; the first and the last frame have one partner instead of two
    all_mean = mean.sum()
    of_all = all_mean * (2 * n.sum() - sums[0] - sums[-1]) - (frames - 1) * all_mean**2
    of_own = 2 * (n @ mean) - float(np.sum(at_ends(recording, mean, 1))) - (frames - 1) * (mean @ mean)
    chance = np.array([far / frames, of_all - of_own])
    spread = variance.sum() ** 2 - variance @ variance
    far_spread = (spread / 2 - near_by.sums(variance, variance).sum()) * frames
    return Surplus(pairs, chance, np.maximum([far_spread, spread * (frames - 1)], 0.0))


def _near_common(recording: Recording, near_by: Near) -> tuple[np.ndarray, int]:
    """((classes, 3) products of the same frame, of the second pixel's next, of the first's next; of the same pixel)."""
    known = recording._kept.get("near_common")
    if known is None:
        out = np.zeros((len(near_by.names), 3), np.int64)
        same = 0
        rows, columns = recording.layout.shape
        if recording.modality != "counts" and near_by.steps is not None:
            stride = columns + REACH
            steps = np.stack([near_by.steps[:, 0], near_by.steps[:, 1] + stride * near_by.steps[:, 2]], axis=1)
            size = -(-(rows * stride + int(steps[:, 1].max())) // 64)
            before = np.zeros(size, np.uint64)
            for _, part in bits(recording):
                words = np.zeros((len(part) + 2, size), np.uint64)  # the last one is for what lies beyond the end
                words[0] = before
                used = _with_margins(part, columns, stride, words)
                same += _common_words(words.ravel(), used * size, size, steps, out)
                before = words[used - 1].copy()
        else:
            last: np.ndarray | None = None
            for values in _values(recording):
                for kind, a, b in near_by.pairs:
                    _common_values(values, values[:1] if last is None else last, last is not None, a, b, out[kind])
                pixel = np.arange(recording.pixels, dtype=np.int32)
                own = np.zeros(3, np.int64)
                _common_values(values, values[:1] if last is None else last, last is not None, pixel, pixel, own)
                same += int(own[1])
                last = values[-1:].copy()
        known = recording._kept["near_common"] = out, same
    return known  # type: ignore[return-value]


def _values(recording: Recording) -> Iterator[np.ndarray]:
    """(frames, pixels) counts, or 0 and 1, some frames at a time."""
    if recording.modality == "counts":
        for _, part in recording.chunks():
            yield np.ascontiguousarray(part.reshape(len(part), -1))
        return
    columns = recording.layout.columns
    for _, part in bits(recording):
        for k in range(0, len(part), 4096):
            yield np.unpackbits(part[k : k + 4096], axis=2, count=columns).reshape(-1, recording.pixels)


@jit
def _common_values(values, last, has_last, first, second, out):
    """Add products of frames (frames, pixels) for pairs of pixels; last: the frame before them."""
    for f in range(values.shape[0]):
        now = values[f]
        total = np.int64(0)
        for p in range(first.size):
            total += np.int64(now[first[p]]) * np.int64(now[second[p]])
        out[0] += total
        if f > 0 or has_last:
            before = values[f - 1] if f > 0 else last[0]
            later, earlier = np.int64(0), np.int64(0)
            for p in range(first.size):
                later += np.int64(before[first[p]]) * np.int64(now[second[p]])
                earlier += np.int64(now[first[p]]) * np.int64(before[second[p]])
            out[1] += later
            out[2] += earlier


@jit
def _with_margins(packed, columns, stride, out):
    """Put packed frames (frames, rows, bytes) behind the first of `out` (frames, words), the lowest bits first.

    stride: bits from a row to the next, more than columns, so that a step beside a row leads to an empty place. Of
    several empty frames in a row, one is enough. Returns the frames that there are then.
    """
    frames, rows, width = packed.shape
    spread = np.empty(256, np.uint64)  # a byte the other way round
    for byte in range(256):
        spread[byte] = np.uint64(0)
        for bit in range(8):
            spread[byte] |= np.uint64((byte >> (7 - bit)) & 1) << np.uint64(bit)
    used = 1
    for f in range(frames):
        ones = np.uint64(0)
        for row in range(rows):
            for k in range(width):
                byte = spread[packed[f, row, k]]
                ones |= byte
                place = row * stride + 8 * k
                word, shift = place >> 6, np.uint64(place & 63)
                out[used, word] |= byte << shift
                if shift > 56:
                    out[used, word + 1] |= byte >> (np.uint64(64) - shift)
        if ones == 0:
            taken = False
            for word in range(out.shape[1]):
                taken |= out[used - 1, word] != 0
            if not taken:
                continue
        used += 1
    out[used] = np.uint64(0)
    return used


@jit
def _common_words(words, end, size, steps, out):
    """Add the pairs of ones of frames, as `_with_margins` gives them, one behind the other up to `end`.

    size: words of a frame, the first of which was counted before; steps: (directions, 2) class, bits to go. Returns
    the ones that a frame shares with the last.
    """
    same = np.int64(0)
    for first in range(size, end, _BLOCK):
        last = min(first + _BLOCK, end)
        for k in range(steps.shape[0]):
            kind = steps[k, 0]
            here, later, earlier = _meet(words, first, last, size, steps[k, 1])
            out[kind, 0] += here
            out[kind, 1] += later
            out[kind, 2] += earlier
        same += count_ones(words[first:last], words[first - size : last - size])
    return same


@jit
def _meet(words, first, last, size, step):
    """How many ones have one so many bits further on in the same frame; those of a frame in the next; the reverse.

    Of the words from `first` to `last`; size: words from one frame to the next.
    """
    skip, right = step >> 6, np.uint64(step & 63)
    left = np.uint64(63) - right
    here, later, earlier = np.uint64(0), np.uint64(0), np.uint64(0)
    count = last - first
    # parts of the array with the same index in each: so a processor takes several words at a time
    nows, befores = words[first:last], words[first - size : last - size]
    low, high = words[first + skip :][:count], words[first + skip + 1 :][:count]
    low_before, high_before = words[first + skip - size :][:count], words[first + skip + 1 - size :][:count]
    for i in range(count):
        now_moved = (low[i] >> right) | ((high[i] << np.uint64(1)) << left)
        before_moved = (low_before[i] >> right) | ((high_before[i] << np.uint64(1)) << left)
        here += ones_of(nows[i] & now_moved)
        later += ones_of(befores[i] & now_moved)
        earlier += ones_of(nows[i] & before_moved)
    return np.int64(here), np.int64(later), np.int64(earlier)


def _near_first(recording: Recording, near_by: Near) -> list[_Row]:
    """Pairs of first stamps of the same frame by lag."""
    tick = tick_of(recording)
    edges = lag_edges(tick)
    number = np.zeros((len(near_by.names), edges.size), np.int64)
    times = np.zeros(_PARTS, np.int64)
    spot, stride, begins, step, kind, _ = around(recording.layout, near_by)
    # each pair from one of its ends
    one_way = step > (0 if stride else np.repeat(spot, np.diff(begins)))
    begins = np.concatenate([[0], np.cumsum(one_way)])[begins]
    margin = (REACH + 1) * (stride + 1)
    far = np.int32(-(1 << 29)) if recording.none < 1 << 29 else np.int64(-(1 << 61))
    for _, found in first_stamps(recording):
        _when(found.stamps, recording.none, times)
        _close(
            *found,
            edges,
            spot,
            stride,
            begins,
            step[one_way],
            kind[one_way],
            np.full((2, spot.max() + margin), far),
            number,
        )
    n = recording.totals.astype(np.float64)
    # by chance: both in the same frame, and so near if each comes at any time of those at which detections do
    density = times / max(1, times.sum())
    both = near_by.sums(n, n) / recording.n_frames * (density @ density) * _PARTS / recording.none
    seconds = np.concatenate([[0.0], edges * tick])
    return [
        (f"{name}, {span(seconds[b], seconds[b + 1])}", float(number[k, b]), both[k] * lags, both[k] * lags)
        for k, name in enumerate(near_by.names)
        for b, lags in enumerate(_lags_in(edges))
    ] + _together(near_by, number, both, edges, tick)


@jit
def _when(stamps, none, times):
    per_part = times.size / none
    for i in range(stamps.size):
        times[min(np.int64(stamps[i] * per_part), times.size - 1)] += 1


@jit
def _close(offsets, stamps, pixels, edges, spot, stride, begins, step, kind, held, out):
    """Add pairs of first stamps to the bins of their lags. offsets, stamps, pixels: see `FirstStamps`.

    spot, ..., kind: see `around`, each pair once. held: (2, spots) a buffer, which holds what is long before any frame;
    where there is no stamp, the second one's is longer ago, so that it is not near that in the first one.
    """
    one, other = held[0], held[1]
    far = one[0]
    further = far + far
    for k in range(other.size):
        other[k] = further
    last = edges[edges.size - 1]
    begin, end = np.int64(0), np.int64(step.size)
    for f in range(offsets.size - 1):
        number = offsets[f + 1] - offsets[f]
        for i in range(offsets[f], offsets[f + 1]):
            one[spot[pixels[i]]] = stamps[i]
            other[spot[pixels[i]]] = stamps[i]
        if stride > 0 and number * _CROWDED > spot.size:
            low, high = spot[0], spot[spot.size - 1] + 1
            for e in range(step.size):
                for at in range(low, high, _SPOTS):
                    until = min(at + _SPOTS, high)
                    for b in range(edges.size - 1, -1, -1):
                        pairs = _within(one[at:until], other[at + step[e] : until + step[e]], edges[b])
                        if pairs == 0:  # as it is of most
                            break
                        out[kind[e], b] += pairs
                        if b + 1 < edges.size:
                            out[kind[e], b + 1] -= pairs
        elif number > 1:
            for i in range(offsets[f], offsets[f + 1]):
                here, now = spot[pixels[i]], np.int64(stamps[i])
                base = here
                if stride == 0:
                    base = 0
                    begin, end = begins[here], begins[here + 1]
                for e in range(begin, end):
                    lag = abs(other[base + step[e]] - now)
                    if lag < last:
                        b = 0
                        while edges[b] <= lag:
                            b += 1
                        out[kind[e], b] += 1
        for i in range(offsets[f], offsets[f + 1]):
            one[spot[pixels[i]]] = far
            other[spot[pixels[i]]] = further


@jit
def _within(one, other, edge):
    """How many of two arrays of the same type are less than `edge` apart."""
    number = np.int64(0)
    low, high = one.dtype.type(-edge), one.dtype.type(edge)
    for p in range(one.size):
        apart = one.dtype.type(one[p] - other[p])
        number += (low < apart) & (apart < high)
    return number
