"""Blocks of pixels that share a part of the readout: pairs within a block, and blocks that are silent for long."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import itertools

import numpy as np

from .. import units
from ..kernels import jit
from . import Recording, Statistic, Summary
from ._counting import Surplus, exposure_in, span, tick_of, whole
from ._order import in_time_order
from ._walk import REACH

# s, edges of the lags of pairs. Crosstalk is mostly below the first one. The shared converter of LinoSPAD2 is blind for
# 7 ns, between the last two.
_LAGS = (1e-9, 3e-9, 10e-9)
# detections of the array within the longest lag: with more no pairs are counted, because the work grows with their
# square (a rule of thumb)
_CROWDED = 64.0
_LEVELS = 6  # the largest block has 2^6 = 64 pixels; a converter of LinoSPAD2 serves 4 (a rule of thumb)
# long silences of all blocks of one size that steady light gives: they set what is long. A full converter of LinoSPAD2
# adds ten times as many.
_EXPECTED = 5.0
_LEAST = 10  # detections: a block with fewer has no silences, because its rate is not known (a rule of thumb)
_SHORTEST = 3.0  # mean intervals: a shorter silence is never long (a rule of thumb)
_ROW, _COLUMN = _LEVELS + 1, _LEVELS + 2  # classes of pairs behind those of the blocks


def _levels(pixels: int) -> int:
    """How many sizes of blocks there are, 2, 4, 8, ... pixels; the largest may be the whole array."""
    return min(_LEVELS, max(pixels - 1, 0).bit_length())


class Blocks(Statistic):
    """Coincident detections of different pixels that may share a part of the readout.

    Classes: pixels 2k and 2k + 1; others of 4k to 4k + 3; others of 8k to 8k + 7; and so on to 64, in the order of
    read-out; on a grid those of one row, or of one column, that are more than 3 pitches apart. 1 to 3 and 3 to 10 ns
    apart in either order: what is nearer is crosstalk's, which `neighbours` shows.
    Law: normal, as the score of the pairs beyond chance, given the total of each pixel. The number of pairs is Poisson.
    Shows: a converter that several pixels share and that is blind while it works (a deficit in its blocks alone).
    Source: measured in a LinoSPAD2, four pixels to a converter, no two within 6.9 ns.
    """

    modalities = ("tr",)
    specific = 3
    pools = ("neighbours", "far_pairs")
    among = "neighbours"
    unit = "standard deviations"
    costly = True

    def reduce(self, recording: Recording) -> Summary | None:
        """Scores of pairs beyond chance."""
        layout, tick = recording.layout, tick_of(recording)
        levels = _levels(layout.pixels)
        if not levels:
            return None
        names = {1: "pixels 2k and 2k + 1"}
        names |= {k: f"pixels {2**k}k to {2**k}k + {2**k - 1}, not of one half" for k in range(2, levels + 1)}
        grid = layout.positions is None and layout.rows > 1 and layout.columns > 1
        if grid and layout.columns > REACH + 1:
            names[_ROW] = f"pixels of one row, more than {REACH} pitches apart"
        if grid and layout.rows > REACH + 1:
            names[_COLUMN] = f"pixels of one column, more than {REACH} pitches apart"
        edges = np.unique([max(1, round(lag / tick)) for lag in _LAGS])
        if edges.size < len(_LAGS) or recording.totals.sum() * edges[-1] > _CROWDED * exposure_in(recording, tick):
            return None
        found = np.zeros((_COLUMN + 1, edges.size - 1), np.int64)
        for words, bits, new in in_time_order(recording, int(edges[-1])):
            _close(words, bits, new, edges, layout.columns if grid else 0, found)
        by_chance = _by_chance(recording.totals.astype(np.float64), layout.shape, levels, grid)
        lags = np.diff(2.0 * edges) / exposure_in(recording, tick)
        kinds = sorted(names)
        chance = np.array([by_chance[k] * lags for k in kinds]).ravel()
        pairs = Surplus(found[kinds].ravel().astype(np.float64), chance, chance)
        spans = [span(a, b) for a, b in itertools.pairwise(edges * tick)]
        where = [f"{names[k]}, {apart}" for k in kinds for apart in spans]
        total = max(float(recording.totals.sum()), 1.0)

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            beyond = pairs.beyond(cell, float(expected))
            text = f"{whole(pairs.number[cell])} pairs, {whole(max(pairs.chance[cell] + beyond, 0.0))} expected"
            return text, float(pairs.number[cell] - pairs.chance[cell] - beyond) / total

        return Summary(pairs.scores(recording.totals), "normal", lambda cell: where[cell], size)


class Silences(Statistic):
    """Long silences of blocks of pixels: 1, 2, 4, ... pixels that follow each other in the order of read-out.

    A silence counts where it is so long that steady light of the same total would give about 5 of all blocks of that
    size. The times before the first detection and after the last one are silences, too.
    Law: Poisson, for counts.
    Shows: a converter that is full, or a readout that stops, for some of the pixels; pixels that blink.
    """

    modalities = ("tr",)
    specific = 2
    pools = ("autocorrelation", "spectrum")
    among = "pixel"
    unit = "silences"
    costly = True

    def reduce(self, recording: Recording) -> Summary | None:
        """Counts of long silences."""
        layout, tick = recording.layout, tick_of(recording)
        end, levels = exposure_in(recording, tick), _levels(layout.pixels)
        each, share_of_time = [], []
        for level in range(levels + 1):
            n = _of_blocks(recording.totals, level)
            known = n >= _LEAST
            intervals = np.maximum(np.log(np.maximum(n, 1.0) * max(known.sum(), 1) / _EXPECTED), _SHORTEST)
            times = np.where(known, intervals * end / np.maximum(n, 1.0), 2.0**62)
            each.append(np.minimum(times, 2.0**62).astype(np.int64))
            share_of_time.append(float(times[known].mean() / end / known.sum()) if known.any() else 0.0)
        # the blocks of all sizes, one size after the other
        begins, longest = np.concatenate([[0], np.cumsum([len(x) for x in each])]), np.concatenate(each)
        last = np.zeros(longest.size, np.int64)
        counts, clearest = np.zeros(levels + 1, np.int64), np.zeros((levels + 1, 3), np.int64)
        for words, bits, new in in_time_order(recording):
            _silent(words, bits, new, begins, longest, last, counts, clearest)
        _silent_to_the_end(end, begins, longest, last, counts, clearest)

        def where(cell: int) -> str:
            size, (block, begun, stop) = 2**cell, clearest[cell]
            first, final = size * block, min(size * (block + 1), layout.pixels) - 1
            which = f"pixel {first}" if first == final else f"pixels {first} to {final}"
            if not counts[cell]:
                return f"silences of blocks of {size}" if size > 1 else "silences of single pixels"
            times = " to ".join(units.show(x * tick, "s", 4) for x in (begun, stop))
            return f"{which} silent, the longest of blocks of {size}: from {times}"

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            share = float(measured - expected) * share_of_time[cell]
            return f"{whole(measured)} long silences, {whole(expected)} expected", share

        return Summary(counts.astype(np.float64), "poisson", where, size)


def _of_blocks(totals: np.ndarray, level: int) -> np.ndarray:
    """(blocks,) detections of blocks of 2^level pixels."""
    return np.add.reduceat(totals.astype(np.float64), np.arange(0, len(totals), 1 << level))


def _by_chance(n: np.ndarray, shape: tuple[int, int], levels: int, grid: bool) -> dict[int, float]:
    """Sums of n n' over the pairs of each class. n: (pixels,) detections."""
    squares = [float(np.sum(_of_blocks(n, k) ** 2)) for k in range(levels + 1)]
    out = {k: (squares[k] - squares[k - 1]) / 2 for k in range(1, levels + 1)}
    if grid:
        out |= {_ROW: _far_in_line(n.reshape(shape)), _COLUMN: _far_in_line(n.reshape(shape).T)}
    return out


def _far_in_line(n: np.ndarray) -> float:
    """The sum of n n' over the pairs of a line more than the reach apart. n: (lines, places)."""
    near = sum(float(np.sum(n[:, d:] * n[:, :-d])) for d in range(1, min(REACH + 1, n.shape[1])))
    return float(np.sum(n.sum(axis=1) ** 2) - np.sum(n**2)) / 2 - near


@jit
def _close(words, bits, new, edges, columns, out):
    """Add the pairs of different pixels to their classes and the bins of their lags.

    words, bits, new: see `TimeOrder`; columns: of a grid, 0 where rows and columns mean nothing.
    """
    mask = (np.int64(1) << bits) - 1
    longest = edges[edges.size - 1]
    for i in range(new, words.size):
        now, pixel = words[i] >> bits, words[i] & mask
        j = i - 1
        while j >= 0 and now - (words[j] >> bits) < longest:
            other, lag = words[j] & mask, now - (words[j] >> bits)
            if other != pixel and lag >= edges[0]:
                b = 0
                while edges[b + 1] <= lag:
                    b += 1
                apart = pixel ^ other
                level = 0
                while apart > 0 and level <= _LEVELS:
                    apart >>= 1
                    level += 1
                if apart == 0 and level <= _LEVELS:
                    out[level, b] += 1
                if columns > 0:
                    across = abs(pixel % columns - other % columns)
                    down = abs(pixel // columns - other // columns)
                    if down == 0 and across > REACH:
                        out[_ROW, b] += 1
                    elif across == 0 and down > REACH:
                        out[_COLUMN, b] += 1
            j -= 1


@jit
def _silent(words, bits, new, begins, longest, last, counts, clearest):
    """Count the long silences of blocks of each size.

    begins: (sizes + 1,) where the blocks of a size begin; longest: (blocks,) ticks beyond which a silence is long;
    last: (blocks,) the last detection; clearest: (sizes, 3) block, begin and end of the longest one, as a multiple of
    what is long.
    """
    mask = (np.int64(1) << bits) - 1
    for i in range(new, words.size):
        now, pixel = words[i] >> bits, words[i] & mask
        for level in range(counts.size):
            block = begins[level] + (pixel >> level)
            if now - last[block] > longest[block]:
                _count(level, block, now, begins[level], longest, last, counts, clearest)
            last[block] = now


@jit
def _silent_to_the_end(end, begins, longest, last, counts, clearest):
    for level in range(counts.size):
        for block in range(begins[level], begins[level + 1]):
            if end - last[block] > longest[block]:
                _count(level, block, end, begins[level], longest, last, counts, clearest)


@jit
def _count(level, block, now, begin, longest, last, counts, clearest):
    counts[level] += 1
    before, begun, stop = clearest[level]
    ratio = (now - last[block]) / longest[block]
    if counts[level] == 1 or ratio > (stop - begun) / longest[begin + before]:
        clearest[level, 0], clearest[level, 1], clearest[level, 2] = block - begin, last[block], now
