"""Maps of a parameter that a statistic informs and the counts do not: its likelihood in each pixel.

A parameter declares the statistic (`informed_by`), the statistic the likelihood (`unit_likelihood`). All pixels inform
the law of the values together, as for dead times (`blind_times.width_of`); each then has its posterior under that law.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace

import numpy as np
from scipy import stats

from .. import plugins
from ..errors import SpadError
from ..statistics import Statistic
from .blind_times import width_of
from .candidates import Candidate, with_values
from .coordinates import Values
from .pixel_maps import PixelMap, groups_of, mean_of, shape_of
from .replicates import Replicates

# logarithms of the value relative to the array: the grid on which all pixels are looked for, and how many points cover
# those that are found; a factor of 20 to both sides, 40 points to the width of a typical posterior; rules
# of thumb
_GRID, _FINE = np.linspace(-3.0, 3.0, 61), 121
# of the standard deviation of a flat prior on the grid: a pixel with a smaller error is informed, and the fine grid
# covers it; a rule of thumb
_INFORMED = 0.8
# standard errors beyond the outermost pixels that the fine grid covers: a normal law has 3e-5 beyond, on each side
_BEYOND = 4.0


def fit_by_statistic(
    replicates: Replicates,
    values: Values,
    candidate: Candidate,
    base: float,
    bounds: tuple[float, float],
    use: Collection[str] = (),
) -> PixelMap:
    """The map of a parameter by the likelihood that its statistic declares.

    Args:
        values: the other values of the model, SI.
        candidate: with `informed_by`.
        base: the value that the map is relative to, SI.
        bounds: the least and the largest value, SI.
        use: the captures that are used; all where it is empty.
    Raises:
        SpadError: where no capture informs it, or a user's statistic fails.
    """
    assert candidate.carrier is not None
    grid, of_captures = _likelihoods(replicates, values, candidate, base, bounds, use)
    likely = _relative(sum(of_captures.values()))
    raw, raw_error = mean_of(likely, grid)
    width = width_of(grid, likely)
    weights = likely * width.prior
    weights /= weights.sum(axis=1, keepdims=True)
    estimate, error = mean_of(weights, grid)
    group = groups_of(replicates.start, candidate.per)
    map_ = PixelMap(
        carrier=candidate.carrier,
        base=base,
        group=group,
        estimate=estimate,
        error=error,
        raw=raw,
        raw_error=raw_error,
        sigma=width.sigma,
    )
    low, high = bounds
    shape = shape_of(replicates.start, candidate.per)
    return replace(map_, low=low, high=high, shape=shape, likely=(grid, weights), certain=0.0, width=width)


def p_of_width(map_: PixelMap) -> float:
    """The p-value of a map under the null that all pixels are alike, by the likelihood of their width."""
    assert map_.width is not None
    # a width is no less than nothing: half of the law
    return float(stats.chi2.sf(map_.width.likelihood_ratio, 1)) / 2 if map_.width.low > 0 else 1.0


def information(
    replicates: Replicates, values: Values, candidate: Candidate, base: float, bounds: tuple[float, float]
) -> dict[str, np.ndarray]:
    """The information of each capture on a map, in inverse variances of the logarithm, (pixels,), by capture."""
    grid, of_captures = _likelihoods(replicates, values, candidate, base, bounds)
    # what the grid itself says is no information
    prior = float(np.var(grid))
    out = {id: np.zeros(replicates.start.layout.pixels) for id in replicates.seen}
    for id, logs in of_captures.items():
        error = np.maximum(mean_of(_relative(logs), grid)[1], float(grid[1] - grid[0]) / math.sqrt(12))
        out[id] = np.maximum(1 / error**2 - 1 / prior, 0.0)
    return out


def _likelihoods(
    replicates: Replicates,
    values: Values,
    candidate: Candidate,
    base: float,
    bounds: tuple[float, float],
    use: Collection[str] = (),
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """(grid of logarithms, log-likelihoods (pixels, grid) by capture)."""
    carrier = candidate.carrier
    assert carrier is not None
    if not base > 0:
        raise SpadError(f"a map of {carrier[1]} is relative to its listed value, which is {base:g}: list one above 0")
    if candidate.informed_by not in Statistic.registry:
        raise SpadError(
            f"{candidate.effect}.{candidate.parameter}: informed_by names no statistic that is loaded, "
            f"{candidate.informed_by!r}; there are {', '.join(Statistic.registry)}"
        )
    statistic = Statistic.registry.find(candidate.informed_by)()
    if type(statistic).unit_likelihood is Statistic.unit_likelihood:
        raise SpadError(f"the statistic {statistic.name} defines no unit_likelihood, so that it informs no map")
    ids = [id for id, seen in replicates.seen.items() if statistic.name in seen.summaries and (not use or id in use)]
    recordings = {id: replicates.recording(id) for id in ids}
    if not recordings:
        raise SpadError(f"no capture has the statistic {statistic.name}, which informs {carrier[1]} by pixel")
    pixels = replicates.start.layout.pixels

    def at(grid: np.ndarray) -> dict[str, np.ndarray]:
        models, out = [], {}
        for value in (base * np.exp(grid)).tolist():
            models.append(with_values(replicates.start, {**values, carrier: np.full(pixels, value)}).resolved())
        for id, recording in recordings.items():
            with plugins.blaming(type(statistic)):
                logs = np.asarray(statistic.unit_likelihood(recording, models), np.float64)
                if logs.shape != (pixels, len(grid)) or np.isnan(logs).any():
                    raise ValueError(f"unit_likelihood must be ({pixels}, {len(grid)}) without nan, not {logs.shape}")
            out[id] = logs
        return out

    inside = (base * np.exp(_GRID) > bounds[0]) & (base * np.exp(_GRID) < bounds[1])
    wide = _GRID[inside]
    middle, error = mean_of(_relative(sum(at(wide).values())), wide)
    informed = error < _INFORMED * float(np.std(wide))
    if informed.sum() < 2:
        raise SpadError(f"the statistic {statistic.name} informs {carrier[1]} of fewer than two pixels")
    wider = _BEYOND * np.maximum(error, float(wide[1] - wide[0]))  # a sharper value lies between two of the grid
    ends = (middle - wider)[informed].min(), (middle + wider)[informed].max()
    grid = np.linspace(max(ends[0], wide[0]), min(ends[1], wide[-1]), _FINE)
    return grid, at(grid)


def _relative(logs: np.ndarray | float) -> np.ndarray:
    """Likelihoods relative to the largest of each pixel, (pixels, grid)."""
    logs = np.asarray(logs)
    return np.asarray(np.exp(logs - logs.max(axis=1, keepdims=True)))
