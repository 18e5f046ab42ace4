"""Dead time of each pixel, from the shortest of its intervals.

The counts of a pixel hardly depend on its dead time. Its shortest interval does: it exceeds the dead time by the time
that the pixel takes to fire again. Intervals that end soon after the dead time are a Poisson process. The shortest
one is later than t with probability exp(-density * (t - dead time)). Rounding and jitter blur that edge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from .. import kernels
from ..recording import Recording
from .levels import FALL_95

# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
# of the dead time, in ticks, and in s: the largest of them is the delay after the shortest interval beyond which no
# blur is left and other intervals are as dense as at the edge; they are counted from there on
_BEHIND, _TICKS, _BLURRED = 0.1, 10.0, 1e-9
# times that delay: the width of the window in which later intervals are counted; a wider one has more of them, farther
# from the edge
_LONG = 3.0
# intervals: the weight of the array's own density in that of a pixel; it decides for pixels with few intervals
_PRIOR_INTERVALS = 4.0
# grid points in the middle range, where most edges lie, and in each of the two outer ranges: resolution against time
_FINE, _ROUGH = 257, 40
_MOST = (0.02, 0.98)  # quantiles of the pixels between which the middle range lies: the fine grid covers it
_LEAST, _HIGHEST = 0.05, 20.0  # of the listed dead time: no edge is looked for below and above
# of the listed dead time: the mean delay of a shortest interval below which it informs the edge; the other pixels are
# left out of the map
_NEARLY = 0.2
# times the blur: how far the grid reaches beyond the shortest intervals; a normal law has 1e-9 beyond it
_FAR = 6.0
# share of pixels of any dead time in the prior: a larger one would hold the tails of the normal part, a smaller one
# would pull odd pixels to the others
_OTHERS = 0.001
_WIDTHS = 60  # widths of the pixels' law that are tried before the best one is refined: resolution against time


@dataclass(frozen=True)
class ShortestIntervals:
    """The shortest interval of each pixel of a capture.

    Attributes:
        intervals: (pixels,) s, infinite where a pixel has none.
        density: (pixels,) 1/s, of the intervals that end soon after the edge.
        tick: s.
    """

    intervals: np.ndarray
    density: np.ndarray
    tick: float

    @classmethod
    def of(cls, recording: Recording) -> ShortestIntervals | None:
        """The shortest intervals of a recording; None without time stamps or without dead time."""
        if recording.modality != "tr" or recording.events is None or not recording.dead_time > 0:
            return None
        offsets = recording.events.offsets.astype(np.int64)
        number = np.maximum(np.diff(offsets) - 1, 0)
        found, soon = np.full(len(number), math.inf), np.zeros(len(number))
        tick = recording.tick or 0.0
        behind = max(_BEHIND * recording.dead_time, _TICKS * tick, _BLURRED)
        reach = _LONG * behind
        if not number.any():
            return cls(found, soon, tick)
        edges = behind, -0.5 * tick, reach - 0.5 * tick
        _shortest(*recording.events.stamps, offsets, *edges, found, soon)
        # afterpulses are proportional to the pixel's rate, all else to its square
        scale = 1 / np.sqrt(np.maximum(number, 1.0))
        design = np.stack([number, number.astype(np.float64) ** 2], axis=1)
        typical = np.maximum(design @ optimize.nnls(design * scale[:, None], soon * scale)[0], 1e-12)
        return cls(
            found, np.where(number > 0, (soon + _PRIOR_INTERVALS) / (1 + _PRIOR_INTERVALS / typical) / reach, 0.0), tick
        )

    def informs(self, listed: float) -> np.ndarray:
        """Whether a pixel's shortest interval informs its edge, (pixels,) bool.

        Args:
            listed: the dead time about which the edge lies, s.
        """
        return np.isfinite(self.intervals) & (self.density * listed * _NEARLY > 1)


@kernels.jit
def _shortest(stamps, unit, offsets, behind, low, high, shortest, soon):  # type: ignore[no-untyped-def]
    """Find the shortest interval of each row, s, and how many are longer than it by `behind` and by low to high, s.

    unit: s of a stamp. shortest: (rows,), infinite; soon: (rows,), 0.
    """
    for row in range(offsets.size - 1):
        first, last = offsets[row], offsets[row + 1]
        for i in range(first + 1, last):
            shortest[row] = min(shortest[row], stamps[i] * unit - stamps[i - 1] * unit)
        for i in range(first + 1, last):
            late = stamps[i] * unit - stamps[i - 1] * unit - shortest[row] - behind
            soon[row] += low < late and late < high


def likelihoods(
    captures: Sequence[ShortestIntervals], blur: float, listed: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """The likelihood of each pixel's dead time on a common grid.

    Args:
        captures: the shortest intervals of each capture.
        blur: the jitter of an interval, s, one standard deviation.
        listed: the dead time of the model, s.
    Returns:
        (log of the dead time relative to `listed`, (grid,); likelihood (pixels, grid), its maximum 1); None where
            fewer than two pixels are informed.
    """
    least = np.min([c.intervals for c in captures], axis=0)
    density = np.sum([c.density for c in captures], axis=0)
    informed = np.any([c.informs(listed) for c in captures], axis=0)
    if informed.sum() < 2:
        return None
    tick = max(c.tick for c in captures)
    # two stamps are rounded to a tick each: the edge is a ramp one tick long about the middle between two ticks
    width = math.hypot(tick / math.sqrt(12), blur)
    early, late = least[informed] - 3 / density[informed] - _FAR * width, least[informed] + _FAR * width
    bounds = _LEAST * listed, _HIGHEST * listed
    ends = np.clip([early.min(), np.quantile(early, _MOST[0]), np.quantile(late, _MOST[1]), late.max()], *bounds)
    first, low, high, last = np.log(ends / listed).tolist()
    grid = np.linspace(low, max(high, low + 1e-3), _FINE)
    # the blur covers the grid, so that no edge is missed between two points
    width = math.hypot(width, listed * math.exp(high) * (grid[1] - grid[0]) / 2)
    before, after = np.linspace(first, low, _ROUGH + 1)[:-1], np.linspace(grid[-1], last, _ROUGH + 1)[1:]
    grid = np.concatenate([before[before < low], grid, after[after > grid[-1]]])
    edges = listed * np.exp(grid)
    logs = np.zeros((least.size, grid.size), np.float32)
    half = max(tick / 2, 1e-3 * width)

    def passed(x: np.ndarray) -> np.ndarray:
        """Expected time after a blurred edge, s, at a time x after its centre."""
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


def _law(grid: np.ndarray, sigma: float, middle: float, others: float = _OTHERS) -> np.ndarray:
    """Prior of the logarithms, (grid,): normal, with a small uniform share for pixels of any value."""
    ends = np.concatenate([grid[:1], (grid[1:] + grid[:-1]) / 2, grid[-1:]])
    normal = np.diff(special.ndtr((ends - middle) / sigma))
    return np.asarray((1 - others) * normal + others * np.diff(ends) / (ends[-1] - ends[0]))


def _log_likelihood(grid: np.ndarray, likely: np.ndarray, sigma: float, middle: float, others: float) -> float:
    return float(np.log(np.maximum(likely @ _law(grid, sigma, middle, others), 1e-300)).sum())


def _at_best(grid: np.ndarray, likely: np.ndarray, sigma: float, about: float, others: float) -> tuple[float, float]:
    """(largest log-likelihood at this width, the mean at which it is found)."""
    reach = 3 * sigma + 0.02
    found = optimize.minimize_scalar(
        lambda m: -_log_likelihood(grid, likely, sigma, m, others),
        bounds=(about - reach, about + reach),
        method="bounded",
    )
    return -float(found.fun), float(found.x)


@dataclass(frozen=True)
class Width:
    """The distribution of the pixels' log dead times: a normal law with a small uniform share.

    Attributes:
        sigma: its standard deviation; low, high: the 95 % interval by profile likelihood.
        middle: its mean.
        likelihood_ratio: twice the log-likelihood ratio to equal dead times.
        prior: (grid,) the law itself.
        log_likelihood: of all pixels at the maximum, but for a constant.
    """

    sigma: float
    low: float
    high: float
    middle: float
    likelihood_ratio: float
    prior: np.ndarray
    log_likelihood: float


def width_of(grid: np.ndarray, likely: np.ndarray, others: float = _OTHERS) -> Width:
    """The maximum-likelihood width of the pixels' log dead times, from the likelihood of all pixels together.

    Args:
        grid, likely: as `likelihoods` returns them.
        others: the uniform share of the law.
    """
    steps = np.diff(grid)
    sigmas = np.geomspace(float(steps.min()) / 4, float(grid[-1] - grid[0]) / 2, _WIDTHS)
    about = float(np.average(grid, weights=likely.sum(axis=0)))
    about = _at_best(grid, likely, float(sigmas[_WIDTHS // 2]), about, others)[1]
    tops = np.array([_at_best(grid, likely, float(s), about, others) for s in sigmas])
    best = int(np.argmax(tops[:, 0]))
    fine = np.geomspace(sigmas[max(best - 1, 0)], sigmas[min(best + 1, _WIDTHS - 1)], 9)
    found = max((*_at_best(grid, likely, float(s), float(tops[best, 1]), others), float(s)) for s in fine)
    top, middle, sigma = found
    wanted = top - FALL_95 / 2
    inside = np.flatnonzero(tops[:, 0] > wanted)
    low, high = (int(inside[0]), int(inside[-1])) if inside.size else (best, best)

    def between(k: int, j: int) -> float:
        """The width at which the log-likelihood falls to `wanted`, between a width inside and one outside."""
        if not 0 <= j < _WIDTHS:
            return 0.0 if j < 0 else float(sigmas[k])
        share = (tops[k, 0] - wanted) / max(tops[k, 0] - tops[j, 0], 1e-12)
        return float(sigmas[k] * (sigmas[j] / sigmas[k]) ** min(max(share, 0.0), 1.0))

    return Width(
        sigma=sigma,
        low=min(between(low, low - 1), sigma),
        high=max(between(high, high + 1), sigma),
        middle=middle,
        likelihood_ratio=max(2 * (top - float(tops[0, 0])), 0.0),
        prior=_law(grid, sigma, middle, others),
        log_likelihood=top,
    )
