"""Is it chance? How often a right model would look as much as the data do like one that lacks something."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

from ..errors import SpadError
from . import mapping
from .candidates import Change, Key, changes
from .fit import RATES, Bench, Moved, State, stacked
from .lines import Line
from .tried import Tried

LEAST_P = 1e-300
_MAP, _LAWS = "pixel_map", ("spread", "tails", "outliers")  # of the pixels' numbers: each, and their law
_SURER, _JOINED = 1.1, 1.6  # of a variance of squares: to be sure, and from where on values move together


def of_any(bench: Bench, state: State, tried: Sequence[Tried], values: dict[Key, Any], lines: Sequence[Line]) -> float:
    """p-value of what resembles the trace of any candidate most, maps among them, if the model is right."""
    marks, largest = marks_of(bench, state, tried)
    p = _gumbel_tail(largest, float(marks.max())) if marks.any() else 1.0
    levels = mapping.levels_of(bench, state)
    maps = [of_map(bench, state, c, values, levels) for c in changes(state.sensors.one) if c.carrier]
    swings = [line.p for line in lines]
    return min(1.0, 3 * min([p, *swings, *(q * len(maps) for q in maps)]))


def of_best(bench: Bench, state: State, tried: Sequence[Tried], best: Tried) -> tuple[float, float]:
    """(significance of the best in standard deviations, p-value of the largest of all candidates')."""
    if best.chance is not None:
        return float(stats.norm.isf(max(best.chance, LEAST_P) / 2)), best.chance
    marks, largest = marks_of(bench, state, [best, *tried])
    # what is far outside is no matter of the linear law: the gain itself, in the same measure
    keys = list(state.residuals)
    t = stacked(bench.template(state, best.moved), keys)
    own = np.concatenate([state.own[k] for k in keys], axis=1) @ t
    typical = float(np.mean(own**2) / max(float(t @ t), 1e-12))
    score = max(float(marks[0]), math.sqrt(max(best.gain, 0.0) / max(typical, 0.5))) if t.any() else 0.0
    return score, max(_gumbel_tail(largest, score), LEAST_P)


def marks_of(bench: Bench, state: State, tried: Sequence[Tried]) -> tuple[np.ndarray, np.ndarray]:
    """((candidates,) how much the data resemble the trace of each, (recordings,) the most that the model's own do).

    In standard deviations of the latter; 0 of a candidate without a trace.
    """
    marks, largest = np.zeros(len(tried)), np.zeros(len(state.own[RATES]))
    for n, one in enumerate(tried):
        _, data, own = along(bench, state, one.moved)
        if one.signed:
            data, own = abs(data), np.abs(own)
        largest = np.maximum(largest, own)
        marks[n] = max(data, 0.0)  # less of it than nothing is none of what can only be there
    return marks, largest


def along(bench: Bench, state: State, moved: Moved) -> tuple[float, float, np.ndarray]:
    """(size of a model's trace, how much of it the data have, (recordings,) the model's own), in standard deviations.

    Of what the model's own recordings have of it. All 0 where there is no trace.
    """
    keys = list(state.residuals)
    t = stacked(bench.template(state, moved), keys)
    own = np.concatenate([state.own[k] for k in keys], axis=1)
    norm = math.sqrt(float(t @ t))
    if norm <= 0:
        return 0.0, 0.0, np.zeros(len(own))
    own = own @ t / norm
    # many cells may scatter less together than they would by themselves; the score of a single one is what it is, even
    # where chance fills it so seldom that it hardly scatters
    cells = norm**4 / float(np.sum(t**4))
    spread = max(float(own.std()), 0.5 + 0.5 / math.sqrt(cells))
    return norm / spread, float(stacked(state.residuals, keys) @ t) / norm / spread, own / spread


def of_map(bench: Bench, state: State, change: Change, values: dict[Key, Any], levels: dict[str, float]) -> float:
    """p-value of a map: pixels (rows, columns) that differ alike in all captures that could show it."""
    try:
        told = mapping.information(bench, values, change, levels)
    except (SpadError, np.linalg.LinAlgError):
        return 1.0
    name = mapping.CODES if change.per == "code" else _MAP
    tells = {id: float(x.sum()) for id, x in told.items()}
    cells = [(id, name) for id in tells if tells[id] > 0 and (id, name) in state.residuals]
    if cells:
        size = max(len(state.residuals[cell]) for cell in cells)
        cells = [cell for cell in cells if len(state.residuals[cell]) == size]
    if not cells:
        return 1.0
    weight = np.sqrt([tells[id] for id, _ in cells])
    weight /= math.sqrt(float(weight @ weight))
    z = sum(w * state.residuals[cell] for w, cell in zip(weight, cells, strict=True))
    own = sum(w * state.own[cell] for w, cell in zip(weight, cells, strict=True))
    if change.per == "code":
        parts = mapping.code_periods(size)
        return min(1.0, len(parts) * min(of_spread(z[part], own[:, part]) for part in parts.values()))
    groups = mapping.groups_of(state.sensors.one, change.per)
    count = np.sqrt(np.bincount(groups))
    data = np.bincount(groups, z) / count
    usual = np.stack([np.bincount(groups, row) / count for row in own])
    chance = of_spread(data, usual)
    if change.per != "pixel":
        return chance
    # few detections in most pixels: then the law of their numbers tells more than the scores of each
    best = max(tells, key=lambda id: tells[id])
    laws = [(best, name) for name in _LAWS if (best, name) in state.residuals]
    others = [state.nulls[cell].chance(state.residuals[cell])[0] for cell in laws]
    return min(1.0, 2 * min([chance, *(len(laws) * p for p in others)]))


def _gumbel_tail(largest: np.ndarray, mark: float) -> float:
    """p-value of a mark as the largest of many; largest: (recordings,) those of the model itself."""
    location, scale = stats.gumbel_r.fit(largest) if np.ptp(largest) > 0 else (3.0, 0.5)
    return float(stats.gumbel_r.sf(mark, location, max(scale, 0.25)))


def of_spread(data: np.ndarray, usual: np.ndarray) -> float:
    """p-value of values that differ; usual: (recordings, values) those of the model itself."""
    square, squares = float(np.mean(data**2)), np.mean(usual**2, axis=1)
    mean, variance = float(squares.mean()), float(squares.var(ddof=1))
    apart = 2 * mean**2 / data.size  # of values that have nothing to do with each other
    # a few recordings tell a variance badly: where they do not contradict, it is that of such values
    variance = _SURER * apart if variance < _JOINED * apart else variance * (1 + math.sqrt(5 / len(squares)))
    shape = mean**2 / max(variance, 1e-12)
    p_sum = float(stats.gamma.sf(square, shape, scale=mean / shape))
    wide = max(1.0, float(np.sqrt(mean)))
    p_cell = min(1.0, 2 * data.size * float(stats.norm.sf(float(np.max(np.abs(data))) / wide)))
    return min(1.0, 2 * min(p_sum, p_cell))
