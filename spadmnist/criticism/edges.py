"""Edges: a time that each pixel has of its own, from the shortest of its intervals.

Counts hardly tell how long a pixel is blind, for it is blind to little. Its shortest interval does: it lies behind the
end of the blindness by as much as the pixel takes to fire at all. Intervals that end soon behind an edge are a Poisson
process, so that the shortest of them is later than t with the chance exp(-density * time behind the edge), an edge
that stamps blur being passed by and by.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from ..recording import Recording

_SOON, _TICKS = 0.1, 10.0  # of the dead time, and in ticks: so near behind the shortest, others are as dense as it is
_USUAL = 4.0  # intervals that the array's own density is worth, beside the pixel's
_GRID = 257  # of logarithms
_NEARLY = 0.2  # of the shortest interval, by which it may be late and still says where the edge is
_WIDTHS, _FALL = 120, 3.84  # that are tried; of twice the log-likelihood, at the ends of 95 %
_FAR = 6.0  # times the blur, by which an edge may be later than the shortest interval


@dataclass(frozen=True)
class Shortest:
    """The shortest interval of each pixel of a capture, (pixels,) s, infinite where there is none.

    density: (pixels,) 1/s, of the intervals that end soon behind it; tick: s.
    """

    intervals: np.ndarray
    density: np.ndarray
    tick: float

    @classmethod
    def of(cls, recording: Recording) -> Shortest | None:
        """Of a capture of time stamps; None without any, and where no pixel is ever blind."""
        if recording.modality != "tr" or recording.events is None or not recording.dead_time > 0:
            return None
        times, offsets = recording.events.times, recording.events.offsets.astype(np.int64)
        number = np.maximum(np.diff(offsets) - 1, 0)
        found, soon = np.full(len(number), math.inf), np.zeros(len(number))
        some = np.flatnonzero(number)
        tick = recording.tick or 0.0
        reach = max(_SOON * recording.dead_time, _TICKS * tick)
        if not some.size:
            return cls(found, soon, tick)
        gaps = np.append(np.diff(times), math.inf)
        gaps[offsets[1:][number + 1 == np.diff(offsets)] - 1] = math.inf  # from a pixel's last to the next one's first
        found[some] = np.minimum.reduceat(gaps, offsets[some])
        behind = gaps - np.repeat(np.where(number > 0, found, 0.0), np.diff(offsets))
        soon[some] = np.add.reduceat((behind > 0.5 * tick) & (behind < reach + 0.5 * tick), offsets[some])
        # in proportion to the pixel's rate, and so to the square of its detections; afterpulses make it its own
        square = number.astype(np.float64) ** 2
        usual = np.maximum(square * float(soon.sum()) / float(square.sum()), 1e-12)
        return cls(found, (soon + _USUAL) / (1 + _USUAL / usual) / reach, tick)


def likely(captures: Sequence[Shortest], blur: float, base: float) -> tuple[np.ndarray, np.ndarray] | None:
    """((grid,) logarithms, relative to `base`, (pixels, grid) how likely each is the pixel's edge), the most likely 1.

    blur: s, by which jitter widens an interval. None where no pixel tells its edge.
    """
    least = np.min([c.intervals for c in captures], axis=0)
    density = np.sum([c.density for c in captures], axis=0)
    told = (density * least * _NEARLY > 1) & np.isfinite(least)
    if not told.any():
        return None
    width = math.hypot(max(c.tick for c in captures) / math.sqrt(6), blur)
    last = float(least[told].max()) + _FAR * width
    first = min(max(float((least - 3 / np.maximum(density, 1e-30))[told].min()) - _FAR * width, 0.2 * last), 0.9 * last)
    grid = np.linspace(math.log(first / base), math.log(last / base), _GRID)
    edges = base * np.exp(grid)
    width = math.hypot(width, last * (grid[1] - grid[0]) / 2)  # no edge lies between two points unseen
    likely = np.zeros((least.size, grid.size))
    for capture in captures:
        some = np.isfinite(capture.intervals)
        x = (capture.intervals[some, None] - edges) / width
        passed = x * special.ndtr(x) + np.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)
        likely[some] += special.log_ndtr(x) - capture.density[some, None] * width * passed
    return grid, np.exp(likely - likely.max(axis=1, keepdims=True)).astype(np.float32)


def width(grid: np.ndarray, likely: np.ndarray) -> tuple[float, float, float]:
    """(standard deviation of the pixels' logarithms if their law is normal, low, high of 95 % by profile).

    By the likelihood of all pixels together: each by itself may tell far less. grid, likely: as of `likely`.
    """
    step = float(grid[1] - grid[0])
    sigmas = np.geomspace(step / 4, (grid[-1] - grid[0]) / 2, _WIDTHS)
    ends = np.append(grid - step / 2, grid[-1] + step / 2)

    def at(sigma: float, middle: float) -> float:
        law = np.diff(special.ndtr((ends - middle) / sigma))
        return float(np.log(np.maximum(likely @ law, 1e-300)).sum())

    bounds = float(grid[0]), float(grid[-1])
    tops = [
        -float(optimize.minimize_scalar(lambda m, s=s: -at(s, m), bounds=bounds, method="bounded").fun)
        for s in sigmas.tolist()
    ]
    best = int(np.argmax(tops))
    inside = np.flatnonzero(np.array(tops) > tops[best] - _FALL / 2)
    low, high = sigmas[inside[0]], sigmas[inside[-1]]
    return float(sigmas[best]), 0.0 if inside[0] == 0 else float(low), float(high)
