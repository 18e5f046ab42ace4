"""Detections of distant pixels that follow each other by a fixed time."""

# mypy: disable-error-code="no-untyped-def"
# numba takes the types from the calls; the docstrings give them.

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from ..kernels import jit
from ..units import show
from . import Recording, Statistic, Summary
from ._counting import exposure_in, span, tick_of, whole
from ._order import in_time_order
from ._scores import largest_score, shares
from ._walk import REACH

_STEP, _LONGEST = 1e-9, 300e-9  # s, between delays; the longest
_MOST_STEPS = 4096  # from one pixel to another, of a grid
_PAIRS = 1_500_000  # that are looked at, about
_LEAST_CHANCE = 1e-6  # of pairs that chance makes


class Delays(Statistic):
    """Pairs of detections of distant pixels by delay and step: the largest number in any ns, for each step.

    Steps: more than 3 pitches from the earlier to the later detection, in columns and rows, and in pixels in the order
    of the readout, which is cyclic. Delays: up to 300 ns in steps of 1 ns. Of very many detections the first 1.5
    million pairs are taken. Grids of up to about 32 x 32 pixels only.
    Law: normal, as the score of the largest of so many Poisson counts, with the mean from the totals of the pixels.
    Shows: a second detection elsewhere: a reflection from pixel to pixel, wires and converters that two pixels share,
    mixed addresses. `far_pairs` has all steps and delays together, so that one step is too faint there.
    """

    modalities = ("tr",)
    specific = 2
    among = "far"
    unit = "standard deviations"
    costly = True

    def reduce(self, recording: Recording) -> Summary | None:
        """Scores, of each step."""
        rows, columns = recording.layout.shape
        if recording.layout.positions is not None or (2 * columns - 1) * (2 * rows - 1) > _MOST_STEPS:
            return None
        steps = _steps(rows, columns)
        if not steps.names:
            return None
        assert recording.events is not None
        tick = tick_of(recording)
        step = max(1, round(_STEP / tick))
        delays = max(1, round(_LONGEST / tick) // step)
        exposure, detections = exposure_in(recording, tick), len(recording.events)
        looked_at = exposure
        if detections:
            by_chance = detections**2 * step * delays / exposure
            looked_at = math.ceil(exposure * min(1.0, _PAIRS / max(by_chance, 1.0)))
        counts = np.zeros((steps.number, delays), np.int32)
        n, detections = np.zeros(recording.pixels), 0
        for words, bits, new in in_time_order(recording, step * delays):
            some = words[: np.searchsorted(words, looked_at << bits)]
            if len(some) <= new and len(words):
                break
            _count(some, new, bits, steps.place, step, counts)
            n += np.bincount(some[new:] & ((1 << bits) - 1), minlength=recording.pixels)
            detections += len(some) - new
        counts = steps.joined(counts)
        most = counts.max(axis=1)
        chance = steps.joined(_meeting(n.reshape(rows, columns)).ravel()) * step / looked_at
        scores = largest_score(most, np.maximum(chance, _LEAST_CHANCE), delays, shares(most, most.size))

        def where(cell: int) -> str:
            k = int(counts[cell].argmax())
            return f"{steps.names[cell]}, {span(k * step * tick, (k + 1) * step * tick)} later"

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            found, mean = int(most[cell]), float(chance[cell])
            text = f"{found} pairs within {show(step * tick, 's')}, {whole(mean)} by chance"
            return text, (found - mean) / max(1, detections)

        return Summary(scores, "normal", where, size, scale=np.ones(scores.size))


@lru_cache(maxsize=4)
def _steps(rows: int, columns: int) -> _Steps:
    return _Steps(rows, columns)


class _Steps:
    """Steps from one pixel to another that is more than 3 pitches away: names of those over the grid, then of those in
    the order of read-out. number: of all over the grid, those that are not so far among them. place: of each pixel, on
    a grid so wide that the way from one to another is their difference.
    """

    def __init__(self, rows: int, columns: int):
        width = 2 * columns - 1
        self.number = width * (2 * rows - 1)
        row, column = np.divmod(np.arange(rows * columns), columns)
        self.place = row * width + column
        down, right = np.divmod(np.arange(self.number), width)
        down, right = down - (rows - 1), right - (columns - 1)
        self.far = np.flatnonzero(down**2 + right**2 > REACH**2)
        down, right = down[self.far], right[self.far]
        further, self.kind = np.unique((down * columns + right) % (rows * columns), return_inverse=True)
        self.names = [_over_the_grid(int(x), int(y)) for x, y in zip(right, down, strict=True)]
        self.names += [f"{int(x)} pixels further on in the order of read-out" for x in further]

    def joined(self, counts: np.ndarray) -> np.ndarray:
        """Of each step by name what `counts` (steps over the grid, ...) has of it."""
        of_grid = counts[self.far]
        by_kind = np.argsort(self.kind, kind="stable")
        first = np.flatnonzero(np.diff(self.kind[by_kind], prepend=-1))
        return np.concatenate([of_grid, np.add.reduceat(of_grid[by_kind], first)])


def _over_the_grid(right: int, down: int) -> str:
    ways = [f"{abs(x)} {name}" for x, name in ((right, _SIDES[right > 0]), (down, _ENDS[down > 0])) if x]
    return f"a pixel {' and '.join(ways)}"


_SIDES = ("to the left", "to the right")
_ENDS = ("up", "down")


@jit
def _count(words, new, bits, place, step, counts):
    """Add the pairs whose later one is new to counts (steps over the grid, delays).

    words, bits: see `TimeOrder`; new: the first of the new ones; place: (pixels,) of each.
    """
    mask = (np.int64(1) << bits) - 1
    of_lag = np.arange(step * counts.shape[1]) // step
    zero = counts.shape[0] // 2  # no way at all
    for i in range(words.size):
        at, here = words[i] >> bits, place[words[i] & mask] - zero
        for j in range(max(i + 1, new), words.size):
            lag = (words[j] >> bits) - at
            if lag >= of_lag.size:
                break
            counts[place[words[j] & mask] - here, of_lag[lag]] += 1


def _meeting(n: np.ndarray) -> np.ndarray:
    """(2 rows - 1, 2 columns - 1) sums over pixels of n times n so many rows and columns on; n: (rows, columns)."""
    from scipy import signal

    return np.maximum(signal.correlate(n, n, method="fft"), 0.0)
