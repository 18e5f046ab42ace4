"""Edges: how long each pixel is blind, from the shortest of its intervals.

Counts hardly tell how long a pixel is blind, for it is blind to little. Its shortest interval does: it lies behind the
end of the blindness by as much as the pixel takes to fire at all. Intervals that end soon behind an edge are a Poisson
process, so that the shortest of them is later than t with the chance exp(-density * time behind the edge), an edge
that rounding and jitter blur being passed by and by.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from ..recording import Recording

# of the dead time, in ticks and in s: so far behind the shortest interval no blur is left, and soon behind that others
# are as dense as they are at the edge
_BEHIND, _TICKS, _BLURRED = 0.1, 10.0, 1e-9
_LONG = 3.0  # times as far they are counted
_USUAL = 4.0  # intervals that the array's own density is worth, beside the pixel's
_FINE, _ROUGH = 257, 40  # points, where most edges lie, and to each side where a few do
_MOST = (0.02, 0.98)  # shares of the pixels between which most lie
_LEAST, _HIGHEST = 0.05, 20.0  # of the listed time, where no edge is looked for
_NEARLY = 0.2  # of the listed time, by which a shortest interval may be late and still says where the edge is
_FAR = 6.0  # times the blur, by which an edge may be later than the shortest interval
_OTHERS = 0.001  # of the pixels, that may be of another kind: more would take the tails of the others
_WIDTHS, _FALL = 60, 3.84  # that are tried; of twice the log-likelihood, at the ends of 95 %


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
        """Of a capture of time stamps; None of any other, and where no pixel is ever blind."""
        if recording.modality != "tr" or recording.events is None or not recording.dead_time > 0:
            return None
        times, offsets = recording.events.times, recording.events.offsets.astype(np.int64)
        events = np.diff(offsets)
        number = np.maximum(events - 1, 0)
        found, soon = np.full(len(number), math.inf), np.zeros(len(number))
        tick = recording.tick or 0.0
        behind = max(_BEHIND * recording.dead_time, _TICKS * tick, _BLURRED)
        reach = _LONG * behind
        some = np.flatnonzero(number)
        if not some.size:
            return cls(found, soon, tick)
        gaps = np.append(np.diff(times), math.inf)
        gaps[offsets[1:][events > 0] - 1] = math.inf  # from a pixel's last to the next one's first
        found[some] = np.minimum.reduceat(gaps, offsets[some])
        late = gaps - np.repeat(np.where(number > 0, found, 0.0), events) - behind
        soon[some] = np.add.reduceat((late > -0.5 * tick) & (late < reach - 0.5 * tick), offsets[some])
        # afterpulses in proportion to the pixel's rate, all else to its square
        scale = 1 / np.sqrt(np.maximum(number, 1.0))
        design = np.stack([number, number.astype(np.float64) ** 2], axis=1)
        usual = np.maximum(design @ optimize.nnls(design * scale[:, None], soon * scale)[0], 1e-12)
        return cls(found, np.where(number > 0, (soon + _USUAL) / (1 + _USUAL / usual) / reach, 0.0), tick)

    def tells(self, listed: float) -> np.ndarray:
        """(pixels,) bool: is an interval seen so soon behind an edge near the listed time that it tells the edge?"""
        return np.isfinite(self.intervals) & (self.density * listed * _NEARLY > 1)


def likely(captures: Sequence[Shortest], blur: float, listed: float) -> tuple[np.ndarray, np.ndarray] | None:
    """((grid,) logarithms, relative to `listed`, (pixels, grid) how likely each is the edge), the most likely one 1.

    blur: s, by which jitter widens an interval; listed: s. None where hardly a pixel tells its edge.
    """
    least = np.min([c.intervals for c in captures], axis=0)
    density = np.sum([c.density for c in captures], axis=0)
    told = np.any([c.tells(listed) for c in captures], axis=0)
    if told.sum() < 2:
        return None
    tick = max(c.tick for c in captures)
    # two stamps are rounded, each to a tick: a ramp of a tick's length about the middle between two whole ones
    width = math.hypot(tick / math.sqrt(12), blur)
    early, late = least[told] - 3 / density[told] - _FAR * width, least[told] + _FAR * width
    bounds = _LEAST * listed, _HIGHEST * listed
    ends = np.clip([early.min(), np.quantile(early, _MOST[0]), np.quantile(late, _MOST[1]), late.max()], *bounds)
    first, low, high, last = np.log(ends / listed).tolist()
    grid = np.linspace(low, max(high, low + 1e-3), _FINE)
    width = math.hypot(width, listed * math.exp(high) * (grid[1] - grid[0]) / 2)  # no edge lies between two unseen
    before, after = np.linspace(first, low, _ROUGH + 1)[:-1], np.linspace(grid[-1], last, _ROUGH + 1)[1:]
    grid = np.concatenate([before[before < low], grid, after[after > grid[-1]]])
    edges = listed * np.exp(grid)
    logs = np.zeros((least.size, grid.size), np.float32)
    half = max(tick / 2, 1e-3 * width)

    def passed(x: np.ndarray) -> np.ndarray:
        """Time behind a blurred edge at a time x behind it."""
        y = x / width
        return np.asarray(width * (y * special.ndtr(y) + np.exp(-(y**2) / 2) / math.sqrt(2 * math.pi)))

    for capture in captures:
        some = np.flatnonzero(np.isfinite(capture.intervals))
        for part in np.array_split(some, max(1, len(some) // 4096)):
            x = capture.intervals[part, None] - edges
            before_it = capture.density[part, None] * passed(x - half)
            within = capture.density[part, None] * passed(x + half) - before_it
            logs[part] += np.log(np.maximum(-np.expm1(-within), 1e-300)) - before_it
    return grid, np.exp(logs - logs.max(axis=1, keepdims=True))


def _law(grid: np.ndarray, sigma: float, middle: float) -> np.ndarray:
    """(grid,) shares of pixels whose logarithms are normal, but for a few that may be anywhere."""
    ends = np.concatenate([grid[:1], (grid[1:] + grid[:-1]) / 2, grid[-1:]])
    normal = np.diff(special.ndtr((ends - middle) / sigma))
    return np.asarray((1 - _OTHERS) * normal + _OTHERS * np.diff(ends) / (ends[-1] - ends[0]))


def _log_likelihood(grid: np.ndarray, likely: np.ndarray, sigma: float, middle: float) -> float:
    return float(np.log(np.maximum(likely @ _law(grid, sigma, middle), 1e-300)).sum())


def _at_best(grid: np.ndarray, likely: np.ndarray, sigma: float, about: float) -> tuple[float, float]:
    """(largest log-likelihood at this width, where the middle is then)."""
    reach = 3 * sigma + 0.02
    found = optimize.minimize_scalar(
        lambda m: -_log_likelihood(grid, likely, sigma, m), bounds=(about - reach, about + reach), method="bounded"
    )
    return -float(found.fun), float(found.x)


@dataclass(frozen=True)
class Width:
    """The law of the pixels' logarithms: its standard deviation, with 95 % by profile, its middle; a few are others.

    gain: of twice the log-likelihood over pixels that are all alike. prior: (grid,) that law.
    """

    sigma: float
    low: float
    high: float
    middle: float
    gain: float
    prior: np.ndarray


def width_of(grid: np.ndarray, likely: np.ndarray) -> Width:
    """By the likelihood of all pixels together: each by itself may tell far less. grid, likely: as of `likely`."""
    steps = np.diff(grid)
    sigmas = np.geomspace(float(steps.min()) / 4, float(grid[-1] - grid[0]) / 2, _WIDTHS)
    about = float(np.average(grid, weights=likely.sum(axis=0)))
    about = _at_best(grid, likely, float(sigmas[_WIDTHS // 2]), about)[1]
    tops = np.array([_at_best(grid, likely, float(s), about) for s in sigmas])
    best = int(np.argmax(tops[:, 0]))
    fine = np.geomspace(sigmas[max(best - 1, 0)], sigmas[min(best + 1, _WIDTHS - 1)], 9)
    found = max((*_at_best(grid, likely, float(s), float(tops[best, 1])), float(s)) for s in fine)
    top, middle, sigma = found
    wanted = top - _FALL / 2
    inside = np.flatnonzero(tops[:, 0] > wanted)
    low, high = (int(inside[0]), int(inside[-1])) if inside.size else (best, best)

    def between(k: int, j: int) -> float:
        """Where the log-likelihood falls to what is wanted, between a width inside and one outside."""
        if not 0 <= j < _WIDTHS:
            return 0.0 if j < 0 else float(sigmas[k])
        share = (tops[k, 0] - wanted) / max(tops[k, 0] - tops[j, 0], 1e-12)
        return float(sigmas[k] * (sigmas[j] / sigmas[k]) ** min(max(share, 0.0), 1.0))

    ends = min(between(low, low - 1), sigma), max(between(high, high + 1), sigma)
    gain = max(2 * (top - float(tops[0, 0])), 0.0)
    return Width(sigma, *ends, middle, gain, _law(grid, sigma, middle))
