"""Variance over mean of the counts in windows of time (Fano factor), from 1 us to a twentieth of the capture."""

# mypy: disable-error-code="no-untyped-def"
# numba takes the types from the calls; the docstrings give them.

from __future__ import annotations

import numpy as np

from ..kernels import jit
from ..units import show
from . import Recording, Statistic, Summary
from ._counting import tick_of
from ._frames import as_words, bits, count_ones, frame_sums
from ._order import in_time_order, is_held
from ._scores import Pairs, minority, nested, number_at, pair_scores, pairs_law, pooled_score, shares
from ._series import has_data, slots_of_frame, stamps

_ALL = ("tr", "str", "qis", "counts")
_WINDOWS = 20  # of the longest kind
_SHORTEST = 1e-6  # s
_MOST = 2**22  # windows of the array sum that are held at a time
_GROUP = 6  # up to 2^6 frames, counts are bits of different weight in different words
_AT_ONCE = 2**14  # words (of 64 pixels) that are counted at a time: they fit into the cache


@jit
def event_pairs(stamps, offsets, factor, levels):
    """Pairs of events of the same row within windows of 1, 2, 4, ... of the shortest windows.

    factor: shortest windows per unit of the stamps; the longest window is 2^(levels - 1) of them, of which there are
    20. Returns (pairs (levels,), inside (rows,) events within all windows), int64. While there are more than four
    windows to an event pairs are looked up one by one, from there on windows are filled.
    """
    end = np.int64(20) << np.int64(levels - 1)
    pairs = np.zeros(levels, np.int64)
    inside = np.zeros(offsets.size - 1, np.int64)
    sums = np.empty(0, np.int32)
    for row in range(offsets.size - 1):
        some = stamps[offsets[row] : offsets[row + 1]]
        while some.size > 0 and np.int64(some[some.size - 1] * factor) >= end:
            some = some[: some.size - 1]
        n = inside[row] = some.size
        if n < 2:
            continue
        sparse = 0
        while sparse < levels - 1 and end >> sparse > 4 * n:
            sparse += 1
        if sparse > 0 and not _few(some, factor, sparse, pairs):
            _many(some, factor, sparse, pairs)
        size = end >> sparse
        if sums.size < size:
            sums = np.empty(size, np.int32)
        sums[:size] = 0
        for i in range(n):
            sums[np.int64(some[i] * factor) >> sparse] += np.int32(1)
        pairs[sparse:] += pairs_in_windows(sums[:size], levels - sparse)
    return pairs, inside


@jit
def _few(stamps, factor, levels, pairs):
    """Add the pairs of the first levels, one by one; false, and nothing is added, where they turn out to be many."""
    lowest = np.zeros(levels, np.int64)  # the pairs that share a window from this level on
    left = 16 * stamps.size
    for i in range(1, stamps.size):
        window = np.int64(stamps[i] * factor)
        k = i - 1
        while k >= 0:
            apart = window ^ np.int64(stamps[k] * factor)
            if apart >> (levels - 1):
                break
            # so many bits are different
            lowest[0 if apart == 0 else (np.float64(apart).view(np.int64) >> 52) - 1022] += 1
            k -= 1
        left -= i - 1 - k
        if left < 0:
            return False
    so_far = np.int64(0)
    for level in range(levels):
        so_far += lowest[level]
        pairs[level] += so_far
    return True


@jit
def _many(stamps, factor, levels, pairs):
    """Add the pairs of the first levels: of each window those of the detections in it, which follow each other."""
    for level in range(levels):
        window, number = np.int64(-1), np.int64(0)
        for i in range(stamps.size):
            here = np.int64(stamps[i] * factor) >> level
            number = number + 1 if here == window else 0
            window = here
            pairs[level] += number


@jit
def _fill(words, bits, factor, sums):
    """Add detections to the windows (windows,) that they lie in; how many lie in one. words, bits: see `TimeOrder`."""
    inside = 0
    for i in range(words.size):
        window = np.int64((words[i] >> bits) * factor)
        if window < sums.size:
            sums[window] += np.int32(1)
            inside += 1
    return inside


@jit
def pairs_in_windows(sums, levels):
    """(levels,) int64 pairs of detections within windows of 1, 2, 4, ... of the shortest. sums: (windows,), used up."""
    pairs = np.zeros(levels, np.int64)
    windows = sums.size
    for level in range(levels):
        total = np.int64(0)
        for k in range(windows):
            total += np.int64(sums[k]) * (np.int64(sums[k]) - 1)
        pairs[level] = total // 2
        windows //= 2
        for k in range(windows):
            sums[k] = sums[2 * k] + sums[2 * k + 1]
    return pairs


@jit
def group_squares(frames, levels, squares, counts):
    """Squares of the pixels' counts in windows of 2, 4, ... 2^levels frames, summed over pixels and groups of frames.

    frames: (groups * 2^levels, words) uint64, a bit for each pixel. squares: (levels + 1,) int64, added to. counts:
    (groups, 64 words) int32, the counts of each group. The counts of 64 pixels stand in several words, one for each
    binary digit. Frames are put in order so that the two halves of every window stand in the two halves of the array:
    then words are added many at a time.
    """
    groups, words = frames.shape[0] >> levels, frames.shape[1]
    each = groups * words
    size = each << levels
    digits = np.empty((levels + 1, size), np.uint64)
    carry = np.empty(size // 2, np.uint64)
    for f in range(1 << levels):
        place = 0
        for bit in range(levels):
            place |= ((f >> bit) & 1) << (levels - 1 - bit)
        for group in range(groups):
            at = place * each + group * words
            digits[0, at : at + words] = frames[(group << levels) + f]
    for level in range(1, levels + 1):
        size //= 2
        carry[:size] = np.uint64(0)
        for digit in range(level):
            _add_digit(digits[digit, :size], digits[digit, size : 2 * size], carry[:size])
        digits[level, :size] = carry[:size]
        total = np.int64(0)
        for i in range(level + 1):
            for j in range(i, level + 1):
                both = count_ones(digits[i, :size], digits[j, :size])
                total += both << (i + j + (1 if j > i else 0))
        squares[level] += total
    for group in range(groups):
        for w in range(words):
            of_word = counts[group, 64 * w : 64 * w + 64]
            of_word[:] = 0
            for digit in range(levels + 1):
                word = digits[digit, group * words + w]
                for bit in range(64):
                    of_word[bit] += np.int32((word >> np.uint64(bit)) & np.uint64(1)) << np.int32(digit)


@jit
def _add_digit(a, b, carry):
    """Add one binary digit of many numbers: a becomes that of the sum."""
    for i in range(a.size):
        different = a[i] ^ b[i]
        both = a[i] & b[i]
        a[i] = different ^ carry[i]
        carry[i] = both | (carry[i] & different)


@jit
def add_window(counts, number, held, squares, totals):
    """One more window of the shortest kind, for all pixels: it is added as in a binary counter.

    counts: (pixels,) of any type; number: of the window, from 0; held: (levels, pixels) int64, first halves of longer
    windows; squares: (levels,) int64, sums over pixels of the squared counts at each length, added to; totals:
    (pixels,) int64, added to.
    """
    levels, pixels = held.shape
    now = np.empty(pixels, np.int64)
    for p in range(pixels):
        now[p] = np.int64(counts[p])
        totals[p] += now[p]
    squares[0] += _sum_of_squares(now)
    level = 1
    while level < levels and (number >> (level - 1)) & 1:  # so many lengths end with this window
        now += held[level - 1]
        squares[level] += _sum_of_squares(now)
        level += 1
    held[level - 1] = now


@jit
def _sum_of_squares(counts):
    total = np.int64(0)
    for p in range(counts.size):
        total += counts[p] * counts[p]
    return total


def _levels(shortest: int) -> int:
    """How many doublings there are from one of `shortest` windows to a twentieth of them."""
    return int(np.log2(max(1.0, shortest / _WINDOWS)) + 1e-9) + 1


def _exact_lengths(exposure: float, most: float = np.inf) -> tuple[int, float]:
    """(lengths, shortest length s) for times: the exposure is 20, 40, 80, ... windows, down to 1 us."""
    shortest = max(_SHORTEST, exposure / most)
    levels = _levels(int(exposure / shortest * (1 + 1e-9)))
    return levels, exposure / (_WINDOWS * 2 ** (levels - 1))


def frame_pairs(recording: Recording) -> tuple[np.ndarray, np.ndarray, int]:
    """For windows of 1, 2, 4, ... frames: (pairs of detections of one pixel in a window, the pixels' detections,
    frames that are looked at: whole windows of the longest kind).
    """
    levels = _levels(recording.n_frames)
    used = recording.n_frames >> (levels - 1) << (levels - 1)
    squares = np.zeros(levels, np.int64)
    if recording.modality == "counts":
        totals = np.zeros(recording.pixels, np.int64)
        held = np.zeros((levels, recording.pixels), np.int64)
        for start, part in recording.chunks():
            for number, frame in enumerate(part[: max(0, used - start)], start):
                add_window(np.ascontiguousarray(frame).ravel(), number, held, squares, totals)
        return (squares - totals.sum()) // 2, totals, used
    step = min(_GROUP, levels - 1)
    words = -(-recording.layout.rows * -(-recording.layout.columns // 8) // 8)
    totals = np.zeros(64 * words, np.int64)  # of the pixels, in the order of their bits
    held = np.zeros((levels - step, 64 * words), np.int64)
    groups = max(1, _AT_ONCE // (words << step))
    counts = np.zeros((groups, 64 * words), np.int32)
    below, above = np.zeros(step + 1, np.int64), np.zeros(levels - step, np.int64)
    left, number = np.zeros((0, words), np.uint64), 0
    for start, part in bits(recording):
        if start >= used:
            break
        flat = as_words(part[: used - start])
        flat = np.concatenate([left, flat]) if len(left) else flat
        whole = len(flat) >> step << step
        for first in range(0, whole, groups << step):
            some = flat[first : min(first + (groups << step), whole)]
            group_squares(some, step, below, counts)
            for group in range(len(some) >> step):
                add_window(counts[group], number, held, above, totals)
                number += 1
        left = flat[len(flat) >> step << step :].copy()
    squares[: step + 1] = below
    squares[step:] = above
    squares[0] = totals.sum()
    return (squares - totals.sum()) // 2, totals, used


def _summary(
    scores: list[float],
    laws: list[Pairs],
    lengths: np.ndarray,
    noise: np.ndarray,
    counts: np.ndarray,
    of: str,
) -> Summary:
    """The scores with their lengths (s). noise: sum of squares that steady rates have; counts: mean in a window."""

    def factor(cell: int, score: float) -> float:
        if not noise[cell] > 0:
            return 1.0
        law = laws[cell]
        pairs = number_at(score, lambda number, share: pooled_score(number, law, share), float(law.mean))
        return 1.0 + 2.0 * (pairs - float(law.mean)) / float(noise[cell])

    def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
        found, wanted = factor(cell, measured), factor(cell, expected)
        change = found - wanted
        # either detections that come in pairs, or a rate that fluctuates: what takes less of it
        share = min(abs(change) / 2.0, np.sqrt(abs(change) / max(counts[cell], 1e-12)))
        text = f"variance {found:.5g} times that of a steady rate, {wanted:.5g} expected"
        return text, float(np.copysign(share, change))

    return Summary(
        np.array(scores),
        "normal",
        lambda cell: f"counts of {of} in {show(lengths[cell], 's')}",
        size,
        axis=lengths,
        label="window, s",
        log=True,
        nested=nested(laws),
    )


class PixelFano(Statistic):
    """Variance over mean of a pixel's counts in windows of time, all pixels together.

    Windows of time stamps: the exposure over 20, 40, 80, ... down to 1 us. Windows of frames: 1, 2, 4, ... up to a
    twentieth of them. Values are relative to steady rates: 1 for time stamps, 1 - p for frames of one bit.
    Law: normal, as the score of the pairs of detections within a window, given the number of each pixel; Poisson where
    there are few pairs.
    Shows: afterpulsing (an excess in all windows), another dead time (a deficit), source noise, flicker, drift and
    blinking (an excess that grows with the window).
    Source: Fano, Phys. Rev. 72 (1947); dead time: Mueller, Nucl. Instr. Meth. 112 (1973).
    """

    modalities = _ALL
    pools = ("autocorrelation",)
    among = "pixel"
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        if not has_data(recording):
            return None
        slots = np.inf
        conditions = recording.conditions
        if recording.events is not None:
            levels, shortest = _exact_lengths(conditions.exposure)
            found, unit = stamps(recording)
            pairs, detections = event_pairs(found, recording.events.offsets, unit / shortest, levels)
            boxes = _WINDOWS << np.arange(levels)[::-1]
            lengths = shortest * 2.0 ** np.arange(levels)
        else:
            slots = slots_of_frame(recording)
            if recording.n_frames < (2 * _WINDOWS if slots == 1 else _WINDOWS):
                return None
            pairs, detections, used = frame_pairs(recording)
            boxes = used >> np.arange(len(pairs))
            lengths = _frame_length(recording) * 2.0 ** np.arange(len(pairs))
        share = shares(np.append(pairs, detections), len(pairs))
        detections, times = np.unique(detections, return_counts=True)
        total = float((detections * times).sum())
        scores, laws, noise = [], [], []
        first = 1 if slots == 1 else 0  # a frame of one bit has no variance of its own
        for level in range(first, len(pairs)):
            n, places = int(boxes[level]), slots * 2.0**level
            offset, few = minority(0.0, detections, n, places)
            law = pairs_law(few, n, places).pooled(times)
            scores.append(pooled_score(float(pairs[level] + (offset * times).sum()), law, share[level]))
            laws.append(law)
            left = 1.0 - detections / (n * places)
            noise.append((detections * left * times).sum() * (1.0 - 1.0 / n) * _drawn(n * places))
        counts = total / (boxes[first:] * recording.pixels)
        return _summary(scores, laws, lengths[first:], np.array(noise), counts, "a pixel")


class ArrayFano(Statistic):
    """Variance over mean of the counts of the whole array in windows of time, relative to steady rates.

    Windows: as in `pixel_fano`. In a long exposure of time stamps the shortest window is a four millionth of it.
    Law: normal, as the score of the pairs of detections within a window, given their total number.
    Shows: what many pixels do at once. Flicker, source noise and drift: an excess that grows with the window. Crosstalk
    and bursts: an excess in all windows. A readout that loses events at high rates: a deficit.
    Source: Fano, Phys. Rev. 72 (1947).
    """

    modalities = _ALL
    pools = ("pixel_fano", "far_pairs", "neighbours", "spectrum")
    among = "array"
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        if not has_data(recording) or recording.pixels == 1:  # of one pixel it says nothing else
            return None
        conditions = recording.conditions
        if recording.events is not None:
            levels, shortest = _exact_lengths(conditions.exposure, _MOST)
            # as if all were of one pixel
            factor, pairs, total = tick_of(recording) / shortest, np.zeros(levels, np.int64), 0
            sums = np.zeros(0 if is_held(recording) else _WINDOWS << (levels - 1), np.int32)
            for words, bits, new in in_time_order(recording):
                if len(sums):
                    total += _fill(words[new:], bits, factor, sums)
                else:
                    ticks = (words >> bits).view(np.uint64)  # as those of each pixel are where they are widened
                    pairs, (total,) = event_pairs(ticks, np.array([0, len(words)]), factor, levels)
            if len(sums):
                pairs = pairs_in_windows(sums, levels)
            slots, total, scatter = np.inf, int(total), 0.0
            detections, windows = float(total), _WINDOWS << (levels - 1)
            lengths = shortest * 2.0 ** np.arange(levels)
        else:
            if recording.n_frames < _WINDOWS:
                return None
            levels = _levels(recording.n_frames)
            sums = frame_sums(recording)[: recording.n_frames >> (levels - 1) << (levels - 1)].copy()
            slots = slots_of_frame(recording)
            lengths = _frame_length(recording) * 2.0 ** np.arange(levels)
            total, scatter = int(sums.sum()), 0.0
            if np.isfinite(slots):
                # a pixel's number is binomial, the array's the sum of different ones
                places = recording.n_frames * slots
                taken = recording.totals / places
                scatter = float((taken * (1.0 - taken)).sum()) * slots * _drawn(places)
                if total > slots * recording.pixels / 2.0 * len(sums):  # free slots scatter like those that are taken
                    sums = int(slots) * recording.pixels - sums
            detections, windows = float(sums.sum()), len(sums)
            pairs = pairs_in_windows(sums, levels)
        share = shares(np.append(recording.totals, levels), levels)
        scores, laws, noises = [], [], []
        for level in range(levels):
            n = windows >> level
            number = float(pairs[level])
            if np.isfinite(slots):
                one = scatter * 2.0**level
                noise = n * one * (1.0 - 1.0 / n)
                variance = (n - 1) * one**2 / 2.0 * max(0.0, 1.0 - 1.0 / max(1.0, detections))
                mean = (noise + detections**2 / n - detections) / 2.0
                clumps = max(1.0 - 4.0 / n + 2.0 * one, 1e-3)
                law = Pairs(*(np.asarray(part) for part in (max(mean, 0.0), variance, variance * clumps)))
            else:
                law = pairs_law(np.asarray(detections), n)
                noise = detections * (1.0 - 1.0 / n)
            scores.append(_array_score(number, detections, n, law, share[level]))
            laws.append(law)
            noises.append(noise)
        boxes = windows >> np.arange(levels)
        return _summary(scores, laws, lengths, np.array(noises), total / boxes, "the array")


def _drawn(places: float) -> float:
    """Of a finite number of slots, the detections that are known in all leave a little less of them free to vary."""
    return places / (places - 1.0) if 1.0 < places < np.inf else 1.0


def _array_score(number: float, detections: float, boxes: int, law: Pairs, share: float) -> float:
    """By the exact law where there are few detections in few windows, otherwise as a pooled number of pairs."""
    if detections <= 128 and boxes <= 4 * _WINDOWS:
        arrays = (np.array([number]), np.array([detections]))
        return float(pair_scores(*arrays, boxes, np.inf, np.array([share]))[0][0])
    return pooled_score(number, law, share)


def _frame_length(recording: Recording) -> float:
    """s from one frame of the readout to the next."""
    conditions = recording.conditions
    return conditions.frame_period * conditions.frames / max(1, recording.n_frames)
