"""Is it chance? How often a right model would look as much as the data do like one that lacks something."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from ..errors import SpadError
from . import mapping
from .candidates import Change, Key
from .fit import FEW, RATES, Bench, Cell, Moved, State, stacked
from .lines import Line
from .nulls import scores_of_powers
from .tried import Tried, shape_of

LEAST_P = 1e-300
PIXELS, _LAWS = "pixel_map", ("spread", "tails", "outliers")  # of the pixels' numbers: each, and their law
_EDGES = "early_intervals"  # how unlike the pixels are in how long they are blind
_BY_CHANCE = 0.25  # of what the data have of a trace: as much a few recordings may have of it by chance
_LITTLE = 0.1  # times as strong: what grows with the square is no matter there
_HELD = 0.9  # of what directions of a candidate have in common, by few recordings
_SMALL, _FOLDS = 32, 4  # cells of a statistic of which it can be told how they go together; parts of the recordings
_LEAST_VARIANCE = 0.3  # of a cell
_TOGETHER, _FEWEST = 1.25, 3.0  # standard deviations of a sum of cells that go together; degrees of freedom it has
_EVENTS = 25.0  # in a cell that is as good as normal
_SURER, _JOINED = 1.1, 1.6  # of a variance of squares: to be sure, and from where on values move together


@dataclass(frozen=True)
class Likeness:
    """How much of a model's trace the data have, in standard deviations of what the model's own recordings have of it.

    size: of the whole trace. own: (recordings,) theirs. spread: of these, if all cells were independent 1. freedom:
    degrees, of the t distribution that they follow.
    """

    size: float
    data: float
    own: np.ndarray
    spread: float
    freedom: float


def of_any(bench: Bench, state: State, tried: Sequence[Tried], values: dict[Key, Any], lines: Sequence[Line]) -> float:
    """p-value of what resembles the trace of any candidate most, maps among them, if the model is right."""
    data, own = _of_traces(bench, state, tried)
    p = _of_least(own, min(data, default=1.0))
    levels = mapping.levels_of(bench, state)
    maps = [of_map(bench, state, c, values, levels) for c in bench.changes(state.sensors.one) if c.carrier]
    swings = [line.p for line in lines]
    return min(1.0, 3 * min([p, *swings, *(q * len(maps) for q in maps)]))


def of_best(bench: Bench, state: State, tried: Sequence[Tried], best: Tried, large: bool = True) -> tuple[float, float]:
    """(significance of the best in standard deviations, p-value of the largest of all candidates').

    large: is something plainly wrong, so that it may be more than its trace says?
    """
    if best.chance is not None:
        others = sum(c.carrier is not None for c in bench.changes(state.sensors.one)) if best.maps else 1
        return float(stats.norm.isf(max(best.chance, LEAST_P) / 2)), min(1.0, best.chance * max(others, 1))
    directions = [t for t in tried if _sided(best) and _kin(t) == _kin(best)]
    _, own = _of_traces(bench, state, tried if directions else [best, *tried])
    mark, found, _ = nearest_face(bench, state, best)
    if found.size <= 0:
        return 0.0, 1.0
    sides = max(len(best.change.strengths) if _sided(best) else 1, 1)
    # of several directions it may be none by itself that the data resemble, but all of them together
    together = min((p for p, _ in _of_group(bench, state, directions)), default=1.0)
    mark = max(mark, float(stats.t.isf(max(together, LEAST_P) / 2, found.freedom)))
    if large:  # what is far outside is no matter of the linear law: the gain itself, in the same measure
        mark = max(mark, math.sqrt(max(best.gain, 0.0) / max(found.spread**2, 0.5)))
    one = float(_chance_of(mark**2, sides, found.freedom)) / (1 if _two_sided(best) else 2)
    return mark, max(_of_least(own, min(one, together)), LEAST_P)


def helps(bench: Bench, state: State, one: Tried) -> bool:
    """Does a settled candidate bring the data nearer along its own trace? Half as much as its numbers say would do.

    The trace is that of the strength at which it was tried: where it is settled, chance may be more than all of it.
    """
    if one.chance is not None or one.there is None:
        return True
    _, found, times = nearest_face(bench, state, one)
    keys, least = list(state.residuals), 0.0
    trace, there = (stacked(bench.template(state, moved), keys) for moved in (one.moved.at(times), one.there))
    if one.sensors is not None and not trace @ there:
        # so faint that all of it may be chance in each cell, and is left out of it: not so along the whole trace
        (whole,) = bench.moved(state, [one.sensors], 2 * FEW, kept="all")
        if not isinstance(whole, str):
            there = stacked(bench.template(state, whole), keys)
            least = _BY_CHANCE
    settled = found.size * float(trace @ there) / max(float(trace @ trace), 1e-300)
    return abs(settled - found.data) < (1 - least) * abs(found.data)


def _of_traces(bench: Bench, state: State, tried: Sequence[Tried]) -> tuple[list[float], np.ndarray]:
    """(p-value of the trace of each candidate in the data, (recordings,) the least of them in the model's own).

    Directions of one candidate are judged together. 1 of a candidate without a trace.
    """
    groups: dict[tuple[Any, ...], list[Tried]] = {}
    for n, one in enumerate(tried):
        groups.setdefault(_kin(one) if _sided(one) else (n,), []).append(one)
    data: list[float] = []
    least = np.ones(len(state.own[RATES]))
    for group in groups.values():
        for p, own in _of_group(bench, state, group):
            data.append(p)
            least = np.minimum(least, own)
    return data, least


def _of_group(bench: Bench, state: State, group: Sequence[Tried]) -> Iterator[tuple[float, np.ndarray]]:
    """As `_of_traces`, of a candidate or of all directions of one; for each strength at which its trace is another."""
    for times in _looks(group[0]) if group else ():
        found = [along(bench, state, one.moved.at(times)) for one in group]
        found = [x for x in found if x.size > 0]
        if found:
            yield _together(found, _two_sided(group[0]))


def _kin(one: Tried) -> tuple[Any, ...]:
    """What the directions of a candidate have in common."""
    return one.change.name, shape_of(one)


def _sided(one: Tried) -> bool:
    """Is it one of several directions?"""
    return one.change.kind == "add" and one.signed and len(one.change.strengths) > 1


def _two_sided(one: Tried) -> bool:
    """Is its opposite what it does with the other sign, and either a find?

    Some of a drift, a spectrum say, grows with the square and belongs to either sign alike: each is judged by itself.
    """
    return one.signed and (one.moved.even is None or _sided(one))


def _looks(one: Tried) -> Sequence[float]:
    """Times its strength, at which its trace is another: where a sign matters and more looks otherwise, little, too."""
    if one.moved.even is None:
        return (1.0,)
    return (1.0, _LITTLE) if _two_sided(one) or not one.signed else (1.0, -1.0, _LITTLE, -_LITTLE)


def nearest_face(bench: Bench, state: State, one: Tried) -> tuple[float, Likeness, float]:
    """Where the data resemble a candidate's trace most: (by how much, in standard deviations and never less than 0; the
    likeness; times the strength at which it does so).
    """
    looks = [(along(bench, state, one.moved.at(x)), x) for x in _looks(one)]
    marks = [abs(found.data) if _two_sided(one) else max(found.data, 0.0) for found, _ in looks]
    best = max(range(len(looks)), key=lambda k: (marks[k], looks[k][0].data))
    return marks[best], *looks[best]


def _together(found: Sequence[Likeness], signed: bool) -> tuple[float, np.ndarray]:
    """(p-value of several directions' likenesses, (recordings,) of the model's own): Hotelling's."""
    own = np.stack([x.own for x in found], axis=1)
    alike = own.T @ own / len(own)
    alike = _HELD * alike + (1 - _HELD) * np.diag(np.diag(alike))
    np.fill_diagonal(alike, np.maximum(np.diag(alike), 1.0))
    all_ = np.vstack([[x.data for x in found], own])
    square = np.einsum("ri,ij,rj->r", all_, np.linalg.inv(alike), all_)
    p = _chance_of(square, len(found), min(x.freedom for x in found))
    if not signed:  # less of it than nothing is none of what can only be there
        p = np.where(all_[:, 0] > 0, p / 2, 1.0)
    return float(p[0]), p[1:]


def _chance_of(square: np.ndarray | float, directions: int, freedom: float) -> np.ndarray:
    """p-value of the square of a likeness: Hotelling's, of the t distribution for one direction."""
    second = max(freedom - directions + 1, 1.0)
    return np.asarray(stats.f.sf(np.asarray(square) * second / (directions * freedom), directions, second))


def _of_least(own: np.ndarray, least: float) -> float:
    """p-value of the least of many p-values; own: (recordings,) the least of those of the model itself."""
    number = max(1 / max(float(own.mean()), 1e-6) - 1, 1.0)  # so many that have nothing to do with each other
    return float(-np.expm1(number * np.log1p(-min(least, 1 - 1e-12))))


def along(bench: Bench, state: State, moved: Moved) -> Likeness:
    """How much the data resemble a model's trace. All 0 where there is no trace.

    Cells that scatter together are weighed accordingly, as far as the model's recordings tell how they do.
    """
    template = bench.template(state, moved)
    keys = [k for k, t in template.items() if t.any()]
    many = len(state.own[RATES])
    usual = float(many - 1)
    if not keys:
        return Likeness(0.0, 0.0, np.zeros(many), 1.0, usual)
    own = np.zeros(many)
    size = data = norm = fourth = wild = 0.0
    for key in keys:
        whole, *parts = _weights(state, key)
        t, null = template[key], state.nulls.get(key)
        if null is not None and null.law == "exponential":
            t = scores_of_powers(t)
        w = whole(t)
        for part, weigh in zip(_folds(many), parts, strict=True):
            own[part] += state.own[key][part] @ weigh(t)
        size, data = size + float(t @ w), data + float(state.residuals[key] @ w)
        norm, fourth = norm + float(w @ w), fourth + float(np.sum(w**4))
        wild += float(np.sum(w[~_many(bench, state, key)] ** 4))
    norm = math.sqrt(norm)
    # many cells may scatter less together than they would by themselves; the score of a single one is what it is, even
    # where chance fills it so seldom that it hardly scatters
    cells = norm**4 / fourth
    spread = max(float(own.std()) / norm, 0.5 + 0.5 / math.sqrt(cells))
    # cells that go together may all be far out together: their tails are those of few
    few = 2 * norm**4 / max(wild, 1e-300) / spread**2
    freedom = usual if spread < _TOGETHER else min(max(few, _FEWEST), usual)
    return Likeness(size / norm / spread, data / norm / spread, own / norm / spread, spread, freedom)


def _many(bench: Bench, state: State, key: Cell) -> np.ndarray:
    """(cells,) bool: which are numbers of so many events that they are as good as normal."""
    null = state.nulls.get(key)
    if null is None or null.law != "poisson":
        return np.zeros(len(state.residuals[key]), bool)
    # events that come in bursts are as many as there are bursts
    return np.asarray(null.expected(bench.seen[key[0]].total)[0] >= _EVENTS * max(null.factor, 1.0) ** 2)


_Weigh = Callable[[np.ndarray], np.ndarray]


def _folds(recordings: int) -> list[slice]:
    """Parts of the recordings, each of which is judged by what the others tell."""
    return [slice(k, None, _FOLDS) for k in range(_FOLDS)]


def _weights(state: State, key: Cell) -> list[_Weigh]:
    """Trace -> weights of the cells of a statistic, by all of the model's recordings and by those outside each fold."""
    own = state.own[key]
    many, cells = own.shape
    if key == RATES or not 1 < cells <= _SMALL:
        return [lambda t: t] * (_FOLDS + 1)

    def made() -> list[_Weigh]:
        rests = [np.delete(own, np.arange(many)[part], axis=0) for part in _folds(many)]
        return [_weighing(x) for x in [own, *rests]]

    return state.once(("weights", key), made)


def _weighing(own: np.ndarray) -> _Weigh:
    """Trace -> weights. own: (recordings, cells); how these scatter together is believed as far as it is no chance.

    Source: Schaefer and Strimmer, Stat. Appl. Genet. Mol. Biol. 4 (2005) 32, for correlations.
    """
    together = own.T @ own / len(own)
    alone = np.maximum(np.diag(together), _LEAST_VARIANCE)
    alike = together / np.sqrt(np.outer(alone, alone))
    np.fill_diagonal(alike, 0.0)
    square, pairs = float(np.sum(alike**2)), len(alike) * (len(alike) - 1)
    by_chance = (pairs - square) / len(own)
    together *= min(max(0.0, 1 - by_chance / max(square, 1e-30)), 1 - 1 / len(own))
    np.fill_diagonal(together, alone)
    inverse = np.linalg.inv(together)
    return lambda t: np.asarray(inverse @ t)


def of_map(bench: Bench, state: State, change: Change, values: dict[Key, Any], levels: dict[str, float]) -> float:
    """p-value of a map: pixels (rows, columns) that differ alike in all captures that could show it."""
    try:
        told = mapping.information(bench, values, change, levels)
    except (SpadError, np.linalg.LinAlgError):
        return 1.0
    if change.blinds:
        return _of_edges(bench, state, change, values, told)
    name = mapping.CODES if change.per == "code" else PIXELS
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
    if any(bench.of_scene(id) for id, _ in cells):
        slopes = np.sqrt([told[id] for id, _ in cells])
        z, *own = (
            _as_told([x[cell] for cell in cells], slopes, groups)
            for x in (state.residuals, *({cell: state.own[cell][k] for cell in cells} for k in range(len(own))))
        )
        chance = of_spread(z, np.stack(own)) if z.size else 1.0
    else:
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


def _as_told(residuals: Sequence[np.ndarray], slopes: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Residuals (captures, pixels) of each group's value, 1 wide, of those groups of which anything is told.

    slopes: (captures, pixels) of a residual on the logarithm of the value: where a scene is black there are none.
    """
    told = np.bincount(groups, (slopes**2).sum(axis=0))
    score = np.bincount(groups, (slopes * residuals).sum(axis=0))
    some = told > mapping.NOTHING**-2
    return np.asarray(score[some] / np.sqrt(told[some]))


def _of_edges(bench: Bench, state: State, change: Change, values: dict[Key, Any], told: dict[str, np.ndarray]) -> float:
    """p-value of pixels that are blind for unlike times.

    By the shortest intervals themselves, which jitter may scatter as well, and by pairs of short ones in one pixel,
    which afterpulses of some pixels may make as well: the larger of the two.
    """
    cells = [(id, _EDGES) for id, x in told.items() if x.any() and (id, _EDGES) in state.residuals]
    if not cells:
        return 1.0
    try:
        width = mapping.settle_edges(bench, values, change).width
    except SpadError:
        return 1.0
    assert width is not None
    by_edges = float(stats.chi2.sf(width.gain, 1)) / 2 if width.low > 0 else 1.0
    z = np.concatenate([state.residuals[cell] for cell in cells])
    by_pairs = min(1.0, z.size * float(stats.norm.sf(float(z.max()))))
    return max(by_edges, by_pairs)


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
