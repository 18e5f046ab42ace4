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
from ._frames import at_ends, frame_sums, moments, ones_of, some_frames
from ._walk import Near, lag_edges, latest, near, walk

_PARTS = 64  # of a frame, in which the times of first stamps are counted


class Neighbours(Statistic):
    """Detections of neighbouring pixels that come together, by direction, distance and the time between them.

    Directions: side by side, one above the other, both diagonals; then 2 and 3 pitches. Where pixels have positions:
    the nearest, then 2 and 3 pitches. Time stamps: up to 1, 3, 10, 30 and 100 ns apart, whichever is the first, and
    for each direction one cell for the second one being later. Frames: the same frame, and the next. First stamps of
    frames (STR): both.
    Each cell is the normal score of the pairs beyond those that chance makes of the pixels' totals. Given these, their
    variance is the number by chance (of frames: (1 - p)(1 - p') times it, p the share of frames with a detection), and
    their law Poisson's. Light that spreads from pixel to pixel shows here and not in `far_pairs`: an excess, per
    detection the same at every light level and in the dark.
    Source: Ingargiola et al., bioRxiv 207118 (2017), for coincidences by distance.
    """

    modalities = ("tr", "str", "qis", "counts")
    unit = "standard deviations"

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
    """Detections of different pixels anywhere on the array that come together: what the whole array has in common.

    All pairs of pixels more than 3 pitches apart. Time stamps: up to 1, 3, 10, 30 and 100 ns apart; frames: the same
    frame, and the next (there of all pairs of different pixels).
    Each cell is the normal score of the pairs beyond those that chance makes of the pixels' totals. Given these, their
    variance is the number by chance (of frames: (1 - p)(1 - p') times it), and their law Poisson's; from frames they
    are found as the variance of the array's sums less that of each pixel. A source that fluctuates, flickers or drifts
    shows here as it does between neighbours; so do bursts over the array, and a readout that loses detections when
    many come (too few).
    """

    modalities = ("tr", "str", "qis", "counts")
    unit = "standard deviations"

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
            text = f"coincidences {_signed(found)} beside chance, {_signed(usual)} expected"
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
    return rows


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
            before = np.zeros(0, np.uint64)
            for first, part in recording.bits():
                words = _row_words(part, columns)
                same += _common_words(words, before if first else words[:0].ravel(), rows, near_by.steps, out)
                before = words[-1].copy()
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
    for _, part in recording.bits():
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


def _row_words(packed: np.ndarray, columns: int) -> np.ndarray:
    """(frames, words) of packed frames: a row's first column is the highest bit of its first word.

    Behind each row stands an empty word, and one more behind each frame, so that rows can be shifted.
    """
    frames, rows, width = packed.shape
    words = -(-columns // 64)
    padded = np.zeros((frames, rows, words + 1, 8), np.uint8)
    padded.reshape(frames, rows, -1)[:, :, :width] = packed
    out = np.zeros((frames, rows * (words + 1) + 1), np.uint64)
    out[:, :-1] = padded.view(">u8").reshape(frames, -1)
    return out


@jit
def _common_words(words, before, rows, steps, out):
    """Add the pairs of ones of frames, as `_row_words` gives them; before: the frame in front of them, or nothing.

    steps: (directions, 3) class, columns and rows to go. Returns the ones that a frame has in common with the last.
    """
    width = (words.shape[1] - 1) // rows
    same = np.int64(0)
    for f in range(words.shape[0]):
        now = words[f]
        last = words[f - 1] if f > 0 else before
        if last.size:
            same += _meet(now, last, 0, 0, now.size - 1, 0)
        for k in range(steps.shape[0]):
            kind, dx, dy = steps[k, 0], steps[k, 1], steps[k, 2]
            # the row whose columns are moved to the left, and the other one; which of them holds the first pixel?
            moved, fixed = (dy, 0) if dx >= 0 else (0, dy)
            count = (rows - dy) * width
            out[kind, 0] += _meet(now, now, fixed * width, moved * width, count, abs(dx))
            if last.size:
                of_moved = _meet(last, now, fixed * width, moved * width, count, abs(dx))  # those that are later
                of_fixed = _meet(now, last, fixed * width, moved * width, count, abs(dx))
                out[kind, 1] += of_moved if dx >= 0 else of_fixed
                out[kind, 2] += of_fixed if dx >= 0 else of_moved
    return same


@jit
def _meet(a, b, i, j, count, shift):
    """Ones that words of `a` from i on have in common with those of `b` from j on, moved to the left by `shift`."""
    still, here, there = a[i : i + count], b[j : j + count], b[j + 1 : j + 1 + count]
    total = np.uint64(0)
    left, right = np.uint64(shift), np.uint64(63 - shift)
    for k in range(count):
        total += ones_of(still[k] & ((here[k] << left) | ((there[k] >> np.uint64(1)) >> right)))
    return np.int64(total)


def _near_first(recording: Recording, near_by: Near) -> list[_Row]:
    """Pairs of first stamps of the same frame by lag."""
    tick = tick_of(recording)
    edges = lag_edges(tick)
    number = np.zeros((len(near_by.names), edges.size), np.int64)
    times = np.zeros(_PARTS, np.int64)
    for _, part in recording.chunks():
        values = np.ascontiguousarray(part.reshape(len(part), -1))
        _when(values, recording.none, times)
        for kind, first, second in near_by.pairs:
            _close(values, recording.none, first, second, edges, number[kind])
    n = recording.totals.astype(np.float64)
    # by chance: both in the same frame, and so near if each comes at any time of those at which detections do
    density = times / max(1, times.sum())
    both = near_by.sums(n, n) / recording.n_frames * (density @ density) * _PARTS / recording.none
    seconds = np.concatenate([[0.0], edges * tick])
    return [
        (f"{name}, {span(seconds[b], seconds[b + 1])}", float(number[k, b]), both[k] * lags, both[k] * lags)
        for k, name in enumerate(near_by.names)
        for b, lags in enumerate(_lags_in(edges))
    ]


@jit
def _when(stamps, none, times):
    per_part = times.size / none
    for f in range(stamps.shape[0]):
        for p in range(stamps.shape[1]):
            if stamps[f, p] < none:
                times[min(np.int64(stamps[f, p] * per_part), times.size - 1)] += 1


@jit
def _close(stamps, none, first, second, edges, out):
    last = edges[edges.size - 1]
    for f in range(stamps.shape[0]):
        for p in range(first.size):
            a, b = np.int64(stamps[f, first[p]]), np.int64(stamps[f, second[p]])
            lag = abs(a - b)
            if lag < last and a < none and b < none:
                k = 0
                while edges[k] <= lag:
                    k += 1
                out[k] += 1
