"""Slow changes: the capture cut into blocks of time."""

# mypy: disable-error-code="no-untyped-def"
# numba takes the types from the calls; the docstrings give them.

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..kernels import jit
from ..units import show
from . import Recording, Statistic, Summary
from ._counting import per_cent, span
from ._frames import add_pixels, bits, frame_sums
from ._scores import minority, number_at, pair_scores, pairs_law, poisson_score, shares
from ._series import has_data, slots_of_frame, stamps
from .maps import place_of

_ALL = ("tr", "str", "qis", "counts")
_BLOCKS = 32


@jit
def block_counts(stamps, offsets, factor, blocks):
    """Pairs of events within a block and events within all blocks of each row, and events of all rows by block.

    factor: blocks per unit of the stamps. Stamps behind the last block are left out. Returns (pairs (rows,),
    inside (rows,), sums (blocks,)), int64.
    """
    rows = offsets.size - 1
    pairs = np.zeros(rows, np.int64)
    inside = np.zeros(rows, np.int64)
    sums = np.zeros(blocks, np.int64)
    own = np.zeros(blocks, np.int64)
    for row in range(rows):
        for i in range(offsets[row], offsets[row + 1]):
            block = np.int64(stamps[i] * factor)
            if block < blocks:
                pairs[row] += own[block]
                inside[row] += 1
                sums[block] += 1
                own[block] += 1
        for i in range(offsets[row], offsets[row + 1]):
            block = np.int64(stamps[i] * factor)
            if block < blocks:
                own[block] = 0
    return pairs, inside, sums


def blocks_of(recording: Recording) -> int:
    """How many blocks a capture is cut into, 0 where it has too few frames."""
    if recording.events is not None:
        return _BLOCKS
    return next((blocks for blocks in (_BLOCKS, _BLOCKS // 2) if recording.n_frames >= 4 * blocks), 0)


def _of_events(recording: Recording, blocks: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`block_counts` of a recording of times."""
    known = recording._kept.get("block counts")
    if known is None:
        assert recording.events is not None
        found, unit = stamps(recording)
        factor = unit * blocks / recording.conditions.exposure
        known = recording._kept["block counts"] = block_counts(found, recording.events.offsets, factor, blocks)
    return known  # type: ignore[return-value]


def _counts_by_block(recording: Recording, blocks: int) -> Iterator[np.ndarray]:
    """(pixels,) int64 detections in each block of equally many frames; the frames left over are left out."""
    size = recording.n_frames // blocks
    counts, held, done = np.zeros(recording.pixels, np.int64), 0, 0
    for _, part in recording.chunks() if recording.modality == "counts" else bits(recording):
        part = np.ascontiguousarray(part)
        while len(part) and done < blocks:
            taken, part = part[: size - held], part[size - held :]
            held += len(taken)
            if recording.modality == "counts":
                counts += taken.reshape(len(taken), -1).sum(axis=0, dtype=np.int64)
            else:
                add_pixels(taken, recording.layout.columns, counts)
            if held == size:
                yield counts
                counts, held, done = np.zeros_like(counts), 0, done + 1


def _block_time(recording: Recording, blocks: int) -> float:
    """s from the start of a block to that of the next."""
    conditions = recording.conditions
    if recording.events is not None:
        return conditions.exposure / blocks
    merged = conditions.frames / max(1, recording.n_frames)  # counts may be sums over frames
    return conditions.frame_period * merged * (recording.n_frames // blocks)


class Trend(Statistic):
    """The array's detections in 32 blocks of the capture (16 where there are few frames), relative to their mean.

    Law: normal, as scores of Poisson counts among those of the whole capture; all blocks with the same spread.
    Shows: a light source that drifts, slow flicker, warming up, readout that stops for a while.
    """

    modalities = _ALL
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        blocks = blocks_of(recording)
        if not has_data(recording) or not blocks:
            return None
        length = _block_time(recording, blocks)
        slots = np.inf
        if recording.events is not None:
            sums = _of_events(recording, blocks)[2]
        else:
            size = recording.n_frames // blocks
            sums = frame_sums(recording)[: blocks * size].reshape(blocks, size).sum(axis=1)
            slots = slots_of_frame(recording) * size * recording.pixels
        total = int(sums.sum())
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
        )


class SlowSeries(Statistic):
    """Of each pixel, whether its rate is steady: the scatter of its counts in 32 blocks of the capture (or 16).

    Law: normal, as the score of the counts' variance (chi-square) given the pixel's number of detections, exact for
    few. A dead time makes it smaller in bright light, in the model as well.
    Shows: pixels that blink (telegraph noise of dark counts), a drift of all pixels, pixels that die or wake up.
    Source: random telegraph signals in SPADs, Karami et al., IEEE Trans. Electron Devices 61 (2014); index of
    dispersion, Fisher, Biometrics 6 (1950).
    """

    modalities = _ALL
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        blocks = blocks_of(recording)
        if not has_data(recording) or not blocks:
            return None
        layout, length = recording.layout, _block_time(recording, blocks)
        slots = np.inf
        if recording.events is not None:
            pairs, inside, _ = _of_events(recording, blocks)
        else:
            slots = slots_of_frame(recording) * (recording.n_frames // blocks)
            pairs, inside = np.zeros(recording.pixels, np.int64), np.zeros(recording.pixels, np.int64)
            for counts in _counts_by_block(recording, blocks):
                pairs += counts * (counts - 1) // 2
                inside += counts
        scores, _ = pair_scores(pairs, inside, blocks, slots, shares(inside, recording.pixels))
        few = minority(0, inside, blocks, slots)[1]

        def fano(cell: int, score: float) -> float:
            """Variance of the blocks' counts over what it is at a steady rate."""
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


def steady(detections: float, boxes: int, slots: float, excess: float) -> float:
    """Variance over that of a steady rate, from pairs in excess of those that a steady rate has."""
    squares = detections * (1.0 - detections / (boxes * slots)) * (1.0 - 1.0 / boxes)
    return 1.0 + 2.0 * excess / squares if squares > 0 else 1.0
