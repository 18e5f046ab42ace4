"""Pairs of detections of the same pixel, by the time between them."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ..kernels import inline, jit
from . import Recording, Statistic, Summary
from ._counting import Surplus, exposure_in, of_pairs, span, whole_ticks
from ._frames import as_words, at_ends, bits, count_ones, moments

_SHORTEST, _LONGEST = 10e-9, 10e-3  # s
_LAGS = (1, 2, 3, 5, 10, 20, 50, 100)  # frames
_PER_OCTAVE = 4
_BOXES, _NARROW = 4096, 724  # boxes whose products fit into 32 bits together, up to what number in a box
_SPARSE = 1.5  # stamps in a window of 8 boxes, up to which pairs are looked up one by one


class Autocorrelation(Statistic):
    """Pairs of detections of the same pixel by the time between them, successive or not.

    Cells of time stamps: lags from the dead time to 10 ms, four cells to an octave, by a multiple-tau correlator: lags
    of 4 to 8 boxes of time are products of the counts in boxes 4, 5, 6 and 7 apart, then of boxes twice as long. Cells
    of frames: products of a pixel's frames 1, 2, 3, 5, 10, 20, 50 and 100 apart. Pooled over the pixels.
    Law: normal, as the score of the pairs beyond chance, given the total of each pixel. The number of pairs is Poisson.
    Its variance is the number by chance; for frames it is (1 - p)^2 times that, with p the share of frames with a
    detection. Neither the light level nor a map of the pixels changes the score.
    Shows: slow traps, source noise, flicker and blinking; in frames also what one frame leaves to the next.
    Source: Schätzel, Quantum Opt. 2 (1990) 287, for the correlator.
    """

    modalities = ("tr", "str", "qis", "counts")
    specific = 2
    pools = ("intervals", "spectrum")
    among = "pixel"
    unit = "standard deviations"

    def reduce(self, recording: Recording) -> Summary | None:
        """Scores of pairs beyond chance."""
        return self._stamps(recording) if recording.events is not None else self._frames(recording)

    def _stamps(self, recording: Recording) -> Summary | None:
        stamps, tick = whole_ticks(recording)
        end = exposure_in(recording, tick)
        box = max(1, math.ceil(max(recording.dead_time, _SHORTEST) / tick / 3 - 1e-6))
        longest = min(round(_LONGEST / tick), end // 4)
        levels = int(math.log2(longest / box)) - 2 if longest >= 8 * box else 0
        if levels < 1:
            return None
        assert recording.events is not None
        # as many boxes as make whole ones at all levels
        boxes = end // box >> (levels - 1) << (levels - 1)
        pairs = np.zeros((levels, _PER_OCTAVE), np.int64)
        chance, variance = np.zeros(pairs.shape), np.zeros(pairs.shape)
        _correlate(stamps, recording.events.offsets, 1.0 / box, boxes, pairs, chance, variance)
        lags = (np.arange(4, 8) * box * tick) * 2.0 ** np.arange(levels)[:, None]
        width = (lags / np.arange(4, 8)).ravel()
        lags = lags.ravel()

        def where(cell: int) -> str:
            # detections in boxes that are so many apart: half a box less or more, most of them
            return f"the same pixel, {span(lags[cell] - width[cell] / 2, lags[cell] + width[cell] / 2)} later"

        return _summary(recording, Surplus(pairs.ravel(), chance.ravel(), variance.ravel()), where, lags, "lag (s)")

    def _frames(self, recording: Recording) -> Summary | None:
        frames = recording.n_frames
        lags = np.array([lag for lag in _LAGS if 2 * lag <= frames])
        if not lags.size:
            return None
        pairs = _products(recording, lags)
        n, _, variance = moments(recording)
        mean = n / frames
        first, last = at_ends(recording, mean, int(lags[-1]))
        lone = np.cumsum(first + last)[lags - 1]  # frames at the ends have one partner instead of two
        chance = 2 * (n @ mean) - lone - (frames - lags) * (mean @ mean + variance.sum() / frames)
        # squared variances, which few detections, or few frames without, overestimate by one in their number
        squared = variance**2 * np.maximum(n - 1, 0) / np.maximum(n, 1)
        if recording.modality != "counts":
            squared *= np.maximum(frames - n - 1, 0) / np.maximum(frames - n, 1)
        spread = squared.sum() * (frames - lags)

        def where(cell: int) -> str:
            return "the same pixel, the next frame" if lags[cell] == 1 else f"the same pixel, {lags[cell]} frames later"

        return _summary(recording, Surplus(pairs, chance, spread), where, lags.astype(np.float64), "lag (frames)")


def _summary(
    recording: Recording, pairs: Surplus, where: Callable[[int], str], axis: np.ndarray, label: str
) -> Summary:
    totals = recording.totals
    size = of_pairs(pairs, float(totals.sum()))
    return Summary(pairs.scores(totals), "normal", where, size, axis=axis, label=label, log=True)


@jit
def _correlate(stamps, offsets, per_box, boxes, pairs, chance, variance):
    """Add up the pairs of the same row (levels, 4) that are 4 to 7 boxes apart; a level's boxes are twice as long.

    per_box: boxes of the first level in a tick; boxes: of the first level, what is later is left out. chance: pairs
    expected of the row's total and of what lies at the ends, where boxes have one partner instead of two.
    While a window of 8 boxes holds few stamps pairs are looked up one by one, then all boxes are filled.
    """
    levels = pairs.shape[0]
    most = 0
    for row in range(offsets.size - 1):
        most = max(most, offsets[row + 1] - offsets[row])
    box = np.empty(most, np.int64)
    inside = np.empty(most, np.int64)
    filled = np.empty(0, np.int32)
    held = np.empty((levels + 1, 16), np.int64)
    for row in range(offsets.size - 1):
        n = 0
        total = 0
        for i in range(offsets[row], offsets[row + 1]):
            # half a tick off the edges, so that rounding is of no matter
            b = np.int64((np.float64(stamps[i]) + 0.5) * per_box)
            if b >= boxes:
                break
            total += 1
            if n > 0 and b == box[n - 1]:
                inside[n - 1] += 1
            else:
                box[n] = b
                inside[n] = 1
                n += 1
        if n == 0:
            continue
        _by_chance(box[:n], inside[:n], total, boxes, chance, variance)
        if n == 1:
            continue
        sparse = 0
        while sparse < levels and n * np.float64(8 << sparse) < _SPARSE * boxes:
            sparse += 1
        if sparse > 0:
            _few(box[:n], inside[:n], sparse, held, pairs)
        if sparse < levels:
            size = boxes >> sparse
            if filled.size < size:
                filled = np.empty(size + size // 4, np.int32)
            filled[:size] = 0
            for i in range(n):
                filled[box[i] >> sparse] += np.int32(inside[i])
            _many(filled, size, sparse, pairs)


@jit
def _by_chance(box, inside, total, boxes, chance, variance):
    """Add what chance makes of a row: of its total, and of the boxes at its ends, which are gone through inwards."""
    head, tail = 0, box.size - 1
    lone = 0
    for level in range(chance.shape[0]):
        n = np.float64(boxes >> level)
        mean = total / n
        for d in range(4, 8):
            reach = d << level
            while head < box.size and box[head] < reach:
                lone += inside[head]
                head += 1
            while tail >= 0 and box[tail] >= boxes - reach:
                lone += inside[tail]
                tail -= 1
            # the last term: boxes that share a given total are a little opposed to each other
            chance[level, d - 4] += mean * (2 * total - lone) - (n - d) * mean * (mean + 1.0 / n)
            variance[level, d - 4] += total * (total - 1.0) * (n - d) / (n * n)


@jit
def _few(box, inside, levels, held, out):
    """The pairs of the first levels, one by one. held: (levels + 1, 16), a buffer."""
    held[: levels + 1] = 0
    window = np.int64(8) << (levels - 1)
    for i in range(1, box.size):
        here = box[i]
        # the pair with the last one always, wherever it belongs: no branch that a processor could guess wrong
        _add_pair(here, box[i - 1], inside[i] * inside[i - 1], levels, held)
        k = i - 2
        while k >= 0 and here - box[k] < window:
            _add_pair(here, box[k], inside[i] * inside[k], levels, held)
            k -= 1
    for level in range(levels):
        for d in range(4, 8):
            out[level, d - 4] += held[level, d]


@inline
def _add_pair(here, there, weight, levels, held):
    """Add a pair at the level at which it is 4 to 8 boxes apart and at the next; beyond all levels stands the last."""
    level = max((np.float64(here - there).view(np.int64) >> 52) - 1023 - 2, 0)
    at = min(level, levels)
    held[at, ((here >> level) - (there >> level)) & 15] += weight
    level += 1
    at = min(level, levels)
    held[at, ((here >> level) - (there >> level)) & 15] += weight


@jit
def _many(filled, size, level, out):
    """The products of boxes for all levels from `level` on; the boxes are added up in place."""
    while level < out.shape[0]:
        most = np.int32(0)
        for i in range(size):
            most = max(most, filled[i])
        for first in range(0, size, _BOXES):
            _add_products(filled[first : min(first + _BOXES + 7, size)], most, out[level])
        size >>= 1
        for i in range(size):
            filled[i] = filled[2 * i] + filled[2 * i + 1]
        level += 1


@jit
def _add_products(boxes, most, out):
    """Add the products of the first `_BOXES` boxes with those 4 to 7 further on. most: in any box."""
    if most <= _NARROW:  # sums of narrow numbers, of which a processor takes more at a time
        for d in range(4, 8):
            total = np.int32(0)
            for i in range(min(_BOXES, boxes.size - d)):
                total = np.int32(total + np.int32(boxes[i] * boxes[i + d]))
            out[d - 4] += total
        return
    for d in range(4, 8):
        wide = np.int64(0)
        for i in range(min(_BOXES, boxes.size - d)):
            wide += np.int64(boxes[i]) * np.int64(boxes[i + d])
        out[d - 4] += wide


def _products(recording: Recording, lags: np.ndarray) -> np.ndarray:
    """(lags,) sums over pixels and frames of the products of a frame and the one so much later."""
    out = np.zeros(lags.size, np.int64)
    longest = int(lags[-1])
    if recording.modality == "counts":
        before = np.zeros((longest, recording.pixels), np.uint16)
        for first, part in recording.chunks():
            both = np.concatenate([before, part.reshape(len(part), -1)])
            _multiply(both, longest, first, lags, out)
            before = both[-longest:]
        return out
    before = np.zeros((longest, 0), np.uint64)
    for first, part in bits(recording):
        words = as_words(part)
        if before.shape[1] != words.shape[1]:
            before = np.zeros((longest, words.shape[1]), np.uint64)
        _coincide(words, before, first, lags, out)
        before = np.concatenate([before, words[-longest:]])[-longest:]
    return out


@jit
def _coincide(words, before, first, lags, out):
    """Add the ones that words (frames, words) have in common with those so many frames earlier.

    before: the frames in front of them; first: the number of the first frame, before which there is nothing.
    """
    for f in range(words.shape[0]):
        for k in range(lags.size):
            earlier = f - lags[k]
            if earlier >= 0:
                out[k] += count_ones(words[f], words[earlier])
            elif first + earlier >= 0:
                out[k] += count_ones(words[f], before[before.shape[0] + earlier])


@jit
def _multiply(frames, behind, first, lags, out):
    """The same for counts (frames, pixels), of which the first `behind` are the earlier ones."""
    for f in range(behind, frames.shape[0]):
        for k in range(lags.size):
            if first + f - behind - lags[k] >= 0:
                now, earlier = frames[f], frames[f - lags[k]]
                total = np.int64(0)
                for i in range(now.size):
                    total += np.int64(now[i]) * np.int64(earlier[i])
                out[k] += total
