"""Slow changes: the capture cut into blocks of time."""

# mypy: disable-error-code="no-untyped-def"
# numba takes the types from the calls; the docstrings give them.

from __future__ import annotations

import numpy as np

from ..kernels import jit
from ..units import show
from . import Recording, Statistic, Summary
from ._counting import per_cent, span
from ._frames import as_words, bits, by_pixel, frame_sums, in_equal_times, pixel_sums
from ._scores import minority, number_at, pair_scores, pairs_law, poisson_score, pooled_score, shares
from ._series import has_data, slots_of_frame, stamps
from .maps import place_of

_ALL = ("tr", "str", "qis", "counts")
_BLOCKS = 32
_LENGTHS = (128, 32, 8)  # blocks of the capture
_HOTTEST = (0.02, 0.05, 0.1, 0.2)  # of the pixels
_FEWEST = 10  # pixels
_COURSES = ("a rise or a fall over the capture", "a bend over the capture", "a turn over the capture")


@jit
def block_counts(stamps, offsets, factor, levels):
    """Pairs of events within a block and events within all blocks of each row, and events of all rows by block.

    Blocks of several lengths: each is four of the one before. factor: blocks of the shortest length per unit of the
    stamps; of the longest there are 8. Stamps behind the last block are left out. Returns (pairs (levels, rows),
    inside (rows,), sums (shortest blocks,)), int64.
    """
    rows = offsets.size - 1
    blocks = np.int64(2) << np.int64(2 * levels)
    pairs = np.zeros((levels, rows), np.int64)
    inside = np.zeros(rows, np.int64)
    sums = np.zeros(blocks, np.int64)
    own = np.empty(blocks, np.int64)
    for row in range(rows):
        own[:] = 0
        for i in range(offsets[row], offsets[row + 1]):
            block = np.int64(stamps[i] * factor)
            if block < blocks:
                own[block] += 1
                inside[row] += 1
        sums += own
        size = blocks
        for level in range(levels):
            total = np.int64(0)
            for k in range(size):
                total += own[k] * (own[k] - 1)
            pairs[level, row] = total // 2
            size //= 4
            for k in range(size):
                own[k] = own[4 * k] + own[4 * k + 1] + own[4 * k + 2] + own[4 * k + 3]
    return pairs, inside, sums


def blocks_of(recording: Recording) -> int:
    """How many blocks a capture is cut into, 0 where it has too few frames."""
    if recording.events is not None:
        return _BLOCKS
    return next((blocks for blocks in (_BLOCKS, _BLOCKS // 2) if recording.n_frames >= 4 * blocks), 0)


def _of_events(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`block_counts` of a recording of times, in `_LENGTHS` blocks."""

    def make() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        assert recording.events is not None
        found, unit = stamps(recording)
        factor = unit * _LENGTHS[0] / recording.conditions.exposure
        return block_counts(found, recording.events.offsets, factor, len(_LENGTHS))

    return recording.kept("block counts", make)


def _of_frames(recording: Recording, blocks: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """As `block_counts`, of frames: (pairs (levels, pixels), inside (pixels,)), int64.

    blocks: how many there are, of equally many frames each; every number is a divisor of the first. The frames left
    over are left out.
    """
    size = recording.n_frames // blocks[0]
    each = blocks[0] // np.array(blocks)  # of the shortest
    counting = recording.modality == "counts"
    held = pairs = inside = np.zeros((0, 0, 0), np.int64)
    shape: tuple[int, ...] = ()
    for first, part in recording.chunks() if counting else bits(recording):
        part = np.ascontiguousarray(part)
        cells = part.reshape(len(part), -1, 1) if counting else as_words(part)
        if not shape:
            shape = part.shape[1:]
            held = np.zeros((len(blocks), cells.shape[1], 1 if counting else 64), np.int64)
            pairs, inside = np.zeros_like(held), np.zeros_like(held[0])
        for start in range(-(first % size), len(cells), size):  # of a block of frames, all that is in this part
            if first + start >= blocks[0] * size:
                break
            some = cells[max(start, 0) : start + size]
            if counting:
                held[0] += some.sum(axis=0, dtype=np.int64)
            else:
                pixel_sums(some, held[0])
            if start + size <= len(cells):
                _end_of_block((first + start) // size + 1, each, held, pairs, inside)
    if counting:
        return pairs[..., 0], inside[..., 0]
    columns = recording.layout.columns
    return np.stack([by_pixel(one, shape, columns) for one in pairs]), by_pixel(inside, shape, columns)


@jit
def _end_of_block(number, each, held, pairs, inside):
    """One of the shortest blocks, the first of `held` (levels, ...), is full: on to the longer ones.

    number: of blocks that there were; each: of them make one of each level. Adds to pairs (levels, ...), inside (...).
    """
    inside += held[0]
    for level in range(each.size - 1, -1, -1):
        now = held[level]
        if level > 0:
            now += held[0]
        if number % each[level] == 0:
            for i in range(now.shape[0]):
                for j in range(now.shape[1]):
                    pairs[level, i, j] += now[i, j] * (now[i, j] - 1) // 2
            now[:] = 0


def _block_time(recording: Recording, blocks: int) -> float:
    """s from the start of a block to that of the next."""
    conditions = recording.conditions
    if recording.events is not None:
        return conditions.exposure / blocks
    merged = conditions.frames / max(1, recording.n_frames)  # counts may be sums over frames
    return conditions.frame_period * merged * (recording.n_frames // blocks)


def slow_courses(blocks: int) -> np.ndarray:
    """A rise, a bend and a turn over the blocks, (patterns, blocks): Legendre polynomials, orthonormal."""
    powers = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, blocks), len(_COURSES))
    return np.asarray(np.linalg.qr(powers)[0].T[1:])


def _of_blocks(series: np.ndarray, blocks: int) -> np.ndarray:
    """(blocks,) sums of a series over frames (frames,); those left over are left out."""
    size = len(series) // blocks
    return np.asarray(series[: blocks * size].reshape(blocks, size).sum(axis=1))


class Trend(Statistic):
    """Detections of the array in 32 blocks of the capture, relative to their mean.

    Captures with few frames have 16 blocks. First stamps: detections for equal times of waiting (see `pixel_map`).
    Law: normal, as scores of Poisson counts given their total; all blocks have the same spread. A rise, a bend and a
    turn over all blocks are tested by themselves.
    Shows: a light source that drifts, slow flicker, warming up, a readout that stops for a while.
    """

    modalities = _ALL
    specific = 0
    pools = ("spectrum",)
    among = "array"
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        blocks = blocks_of(recording)
        if not has_data(recording) or not blocks:
            return None
        length = _block_time(recording, blocks)
        slots = np.inf
        if recording.events is not None:
            sums = _of_events(recording)[2].reshape(blocks, -1).sum(axis=1)
        else:
            size = recording.n_frames // blocks
            sums = _of_blocks(frame_sums(recording), blocks)
            if recording.waited is not None:
                sums = in_equal_times(sums, _of_blocks(recording.waited[1], blocks))
            else:
                slots = slots_of_frame(recording) * size * recording.pixels
        total = float(sums.sum())
        # slots that are free scatter like those that are taken; where they are fewer, they are the ones to count
        free = total > blocks * slots / 2
        mean = slots - total / blocks if free else total / blocks
        share = shares(sums, blocks)
        scores = -poisson_score(slots - sums, mean, share) if free else poisson_score(sums, mean, share)

        def relative(score: float) -> float:
            number = number_at(-score if free else score, lambda n, part: float(poisson_score(n, mean, part)), mean)
            return (mean - number if free else number - mean) / max(1.0, total / blocks)

        def size_of(cell: int, measured: float, expected: float) -> tuple[str, float]:
            found, wanted = relative(measured), relative(expected)
            text = f"{per_cent(found)} from the mean rate, {per_cent(wanted)} expected"
            return text, float(found - wanted)

        return Summary(
            scores,
            "normal",
            lambda cell: f"{span(cell * length, (cell + 1) * length)} of the capture",
            size_of,
            scale=np.ones(blocks),
            axis=(np.arange(blocks) + 0.5) * length,
            label="time, s",
            contrasts=slow_courses(blocks),
            contrast_words=_COURSES,
        )


class SlowSeries(Statistic):
    """Steadiness of each pixel: the scatter of its counts in 32 blocks of the capture (or 16).

    Law: normal, as the score of the variance of the counts (chi-square) given the number of detections of the pixel;
    exact for few. A dead time makes the variance smaller in bright light, in the model as well.
    Shows: pixels that blink (telegraph noise of dark counts), a drift of all pixels, pixels that stop or start.
    Source: random telegraph signals in SPADs, Karami et al., IEEE Trans. Electron Devices 61 (2014); index of
    dispersion, Fisher, Biometrics 6 (1950).
    """

    modalities = _ALL
    pools = ("trend", "spectrum", "autocorrelation")
    among = "pixel"
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        blocks = blocks_of(recording)
        if not has_data(recording) or not blocks:
            return None
        layout, length = recording.layout, _block_time(recording, blocks)
        slots = np.inf
        if recording.events is not None:
            by_length, inside, _ = _of_events(recording)
            pairs = by_length[_LENGTHS.index(blocks)]
        else:
            slots = slots_of_frame(recording) * (recording.n_frames // blocks)
            (pairs,), inside = _of_frames(recording, (blocks,))
        scores, _ = pair_scores(pairs, inside, blocks, slots, shares(inside, recording.pixels))
        few = minority(0, inside, blocks, slots)[1]

        def fano(cell: int, score: float) -> float:
            """Variance of the blocks' counts over what it is at a steady rate."""
            if few[cell] < 2:  # there are no pairs, whatever the score
                return steady(few[cell], blocks, slots, 0.0)
            one = np.array([few[cell]])
            mean = float(pairs_law(one, blocks, slots).mean[0])

            def scored(number: float, part: float) -> float:
                return float(pair_scores(np.array([number]), one, blocks, slots, np.array([part]))[0][0])

            return steady(few[cell], blocks, slots, number_at(score, scored, mean) - mean)

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            was, wanted = max(0.0, fano(cell, measured)), max(0.0, fano(cell, expected))
            text = f"variance in blocks of {show(length, 's')} {was:.3g} times that of a steady rate"
            # as a fluctuation of the pixel's rate, which adds its square times the counts
            change = (was - wanted) * blocks / max(1.0, float(inside[cell]))
            return f"{text}, {wanted:.3g} expected", float(np.copysign(np.sqrt(abs(change)), change))

        return Summary(
            scores,
            "normal",
            lambda cell: place_of(layout, cell),
            size,
            axis=np.arange(layout.pixels, dtype=np.float64),
            label="pixel",
            shape=layout.shape if layout.positions is None else None,
        )


class HotSeries(Statistic):
    """Steadiness of the pixels with the most detections: the scatter of their counts in blocks.

    Cells: the 2, 5, 10 and 20 % of the pixels with the most detections (at least two), together; 8, 32 and 128 blocks
    of the capture, of 4 frames or more. `slow_series` has a cell for each pixel, so that a small excess of a few pixels
    is hidden by all others.
    Law: normal, as the score of the pairs of detections within a block, given the number of each pixel, so that the
    choice of the pixels changes nothing; Poisson where there are few pairs.
    Shows: hot pixels that blink (telegraph noise of dark counts). A map shows only their mean.
    Source: random telegraph signals in SPADs, Karami et al., IEEE Trans. Electron Devices 61 (2014); index of
    dispersion, Fisher, Biometrics 6 (1950).
    """

    modalities = _ALL
    specific = 2
    pools = ("slow_series",)
    among = "pixel"
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        if not has_data(recording) or not blocks_of(recording) or recording.pixels < _FEWEST:
            return None
        slots = np.inf
        if recording.events is not None:
            blocks: tuple[int, ...] = _LENGTHS
            pairs, inside, _ = _of_events(recording)
        else:
            blocks = tuple(n for n in _LENGTHS if recording.n_frames >= 4 * n)
            slots = slots_of_frame(recording) * (recording.n_frames // blocks[0])
            pairs, inside = _of_frames(recording, blocks)
        times = _block_time(recording, blocks[0]) * blocks[0] / np.array(blocks)
        order = np.argsort(-inside, kind="stable")
        groups = {max(2, round(part * recording.pixels)): part for part in _HOTTEST}
        cells = [(size, level) for size in groups for level in range(len(blocks))]
        share = shares(np.append(pairs, inside), len(cells))
        scores, laws = [], []
        for k, (size, level) in enumerate(cells):
            hot, n = order[:size], blocks[level]
            number, few = minority(pairs[level, hot], inside[hot], n, slots * blocks[0] / n)
            laws.append(pairs_law(few, n, slots * blocks[0] / n).pooled(np.ones(size)))
            scores.append(pooled_score(float(number.sum()), laws[-1], share[k]))

        def fano(cell: int, score: float) -> float:
            """Variance of the blocks' counts over what it is at steady rates."""
            (size, level), law = cells[cell], laws[cell]
            number = number_at(score, lambda count, part: pooled_score(count, law, part), float(law.mean))
            n = blocks[level]
            return steady(inside[order[:size]], n, slots * blocks[0] / n, number - float(law.mean))

        def size_of(cell: int, measured: float, expected: float) -> tuple[str, float]:
            was, wanted = max(0.0, fano(cell, measured)), max(0.0, fano(cell, expected))
            text = f"variance {was:.3g} times that of a steady rate, {wanted:.3g} expected"
            size, level = cells[cell]
            # as a fluctuation of the pixels' rates
            change = (was - wanted) * blocks[level] * size / max(1.0, float(inside[order[:size]].sum()))
            return text, float(np.copysign(np.sqrt(abs(change)), change))

        def where(cell: int) -> str:
            size, level = cells[cell]
            part = per_cent(groups[size])
            return f"the {part} of pixels with the most detections, in blocks of {show(times[level], 's')}"

        return Summary(np.array(scores), "normal", where, size_of)


def steady(detections: np.ndarray | float, boxes: int, slots: float, excess: float) -> float:
    """Variance over that of a steady rate, from pairs in excess of those that steady rates have; of all pixels."""
    squares = float(np.sum(detections * (1.0 - detections / (boxes * slots)))) * (1.0 - 1.0 / boxes)
    return 1.0 + 2.0 * excess / squares if squares > 0 else 1.0
