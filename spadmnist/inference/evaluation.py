"""The evaluation of a model: residuals of the data, likelihood ratio, misfit."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..errors import UNABLE, SpadError, why
from ..statistics import Summary
from . import replicate_cache
from .candidates import with_values
from .capture_replicates import CannotSimulate, CaptureReplicates, joined
from .closed_forms import most_detections
from .coordinates import Key, Values
from .light_levels import (
    CaptureNull,
    central_level,
    law_of,
    levels_about,
    matched_light,
    own_totals,
    totals_residuals,
    whole_of,
)
from .mean_alone import of_mean
from .models import Model
from .null_distribution import Judgement, Null, learn, replicate_residuals, scatter_of
from .replicates import FEW, TOTALS, Cell, Replicates, T, no_size

# turns: the golden ratio, by which each next light level of the replicates falls into the widest gap, for any number
_GOLDEN = (math.sqrt(5) - 1) / 2
# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
_PIECES = 4  # tasks of one capture, at most: the number of workers that share it
# sum of squares of a signature in one statistic, in variances, above which its cells count in the likelihood ratio: a
# smaller one is less than the noise of one number
_MOVED = 1.0
# expected detections of a capture, least, of which more than the total is compared. Scores of 0.1 expected detections
# alarmed 3000 times too often (p < 1e-6), of 2 up to 300 times, of 30 rightly
_FEW_DETECTIONS = 5.0
_WIDEST = 2.3  # of the log of the ratio of two scatters: the most that counts, a factor of 10
# standard errors of that log: a cell beyond has another scatter and counts; by the normal law 3 of 1000 do by chance
_OTHER_SCATTER = 3.0
_NOISE = 3.0  # standard deviations of a mean total: the light level is moved for what is beyond it, which is no noise
# replicates at the stated rates where pixels blink; standard deviations of their totals within which a total is one of
# them, so that the capture is simulated at these rates
_BLINKING, _SCATTERS = 16, 4.0
_PILOTS = 5  # rounds of a few replicates in which the level is found that gives the measured total, at most
# of a log: totals that differ by less are the same, far below the noise of any capture, and replicates are borrowed
_SAME_TOTAL = 1e-5
# factor on the scatter of totals beyond which the light fluctuates: a step is then judged by its scatter
_FLUCTUATES = 3.0


@dataclass
class Evaluation:
    """The evaluation of a model: null distributions, residuals of the data and of the model's replicates.

    Attributes:
        values: parameters that the model sets, SI.
        sensors: the model.
        made: the replicates, by capture.
        nulls: null distributions, by (capture, statistic).
        rates: null distributions of the totals, by capture.
        factors: (replicates,) on the light level, by capture.
        residuals: (cells,) standard deviations; `TOTALS` is a block of its own.
        replicate_residuals: (replicates, cells), the same of the replicates.
        judgements: p-values and more, by (capture, statistic).
        borrowed: captures whose replicates are those of another model, from which this one hardly differs there.
    """

    values: dict[Key, Any]
    sensors: Model
    made: dict[str, CaptureReplicates]
    nulls: dict[Cell, Null]
    rates: dict[str, CaptureNull]
    factors: dict[str, np.ndarray]
    residuals: dict[Cell, np.ndarray]
    replicate_residuals: dict[Cell, np.ndarray]
    judgements: dict[Cell, Judgement]
    space: tuple[list[str], np.ndarray, np.ndarray, np.ndarray] | None = None  # see `totals_space`
    borrowed: frozenset[str] = frozenset()
    _kept: dict[tuple[Any, ...], Any] = field(default_factory=dict, init=False, repr=False)  # see `once`

    def before(self, cell: Cell, few: int) -> tuple[np.ndarray, np.ndarray]:
        """((few, cells) deviations of the first replicates from the expectation, (cells,) scatter)."""

        def make() -> tuple[np.ndarray, np.ndarray]:
            null, made = self.nulls[cell], self.made[cell[0]]
            beyond = made.values[cell[1]][:few] - null.expected_all(made.totals[:few])[0]
            return beyond, scatter_of(null, made)

        return self.once(("before", cell, few), make)

    @property
    def exact(self) -> list[Cell]:
        """Statistics of law "exact" whose measured value is not that of the replicates."""
        return [cell for cell, found in self.judgements.items() if self.nulls[cell].law.exact and found.p_value < 0.5]

    @property
    def fluctuates(self) -> bool:
        """Whether the light fluctuates: the totals of the replicates scatter far more than counts alone do."""
        simulated = (self.rates[id] for id in self.made)
        return any(far_wider(r.scatter, 1 / math.sqrt(max(r.expected(r.level), 1.0))) for r in simulated)

    def expected(self, cell: Cell, total: float) -> tuple[np.ndarray, float]:
        """((cells,) expectation of a statistic for this total, its relative variance), once; see `Null.expected`.

        Args:
            cell: (capture, statistic).
            total: detections of the capture.
        """
        return self.once(("expected", cell, total), lambda: self.nulls[cell].expected(total))

    def without_replicates(self) -> Evaluation:
        """The evaluation of a model from which the search has gone on: without its replicates and null distributions.

        They take tens of MB. Its residuals, and those of its replicates, are what a row of the error budget needs.
        """
        return replace(self, made={}, nulls={})

    def square(self, cell: Cell) -> float:
        """The sum of squared residuals of the data in one statistic."""
        return self.once(("square", cell), lambda: float(self.residuals[cell] @ self.residuals[cell]))

    def once(self, name: tuple[Any, ...], make: Callable[[], T]) -> T:
        """The result of `make`, which is called once for each name and then kept."""
        if name not in self._kept:
            self._kept[name] = make()
        found: T = self._kept[name]
        return found


def evaluate(
    replicates: Replicates,
    values: Values,
    sensors: Model | None = None,
    number: int | None = None,
    known: Evaluation | None = None,
    remember: bool = False,
    near: tuple[Evaluation, Collection[str]] | None = None,
) -> Evaluation:
    """The evaluation of a model: null distributions of all captures, residuals of the data and of the replicates.

    Args:
        values: parameters that the model sets, SI.
        sensors: the model, where it is more than these.
        number: of replicates of each capture; by default that of `replicates`.
        known: an evaluation of the same model by fewer replicates, which are the first of these.
        remember: the cache on disk is read and written.
        near: the evaluation of another model, and the captures in which this one differs from it. The replicates of the
            other captures are borrowed from it, where every effect states its mean and a level gives the same total.
    Raises:
        SpadError: where the model cannot be simulated.
    """
    try:
        return _evaluate(replicates, values, sensors, number, known, remember, near)
    except SpadError:
        raise
    except UNABLE as error:
        raise SpadError(why(error)) from error


def _evaluate(
    replicates: Replicates,
    values: Values,
    sensors: Model | None,
    number: int | None,
    known: Evaluation | None,
    remember: bool,
    near: tuple[Evaluation, Collection[str]] | None,
) -> Evaluation:
    sensors = sensors or Model.same(with_values(replicates.start, values))
    n = number or replicates.number
    # evenly spread for any number of them, for the first of them, and for every fourth
    spread = 2 * np.modf((np.arange(n) + 0.5) * _GOLDEN)[0] - 1
    about, wanted, entries = {}, [], dict[str, str | None]()
    before = {id: made for id, made in known.made.items() if id not in known.borrowed} if known else {}
    same = _same_level(replicates, sensors, n, *near) if near else {}
    evaluation = Evaluation(
        values=dict(values),
        sensors=sensors,
        made={},
        nulls={},
        rates={},
        factors={},
        residuals={},
        replicate_residuals={},
        judgements={},
        borrowed=frozenset(same),
    )
    centres = _centres(replicates, sensors, same)
    for id, seen in replicates.seen.items():
        if seen.counts is None:
            evaluation.rates[id], evaluation.factors[id] = of_mean(sensors.mean_sensor(id), seen.capture, seen.total, n)
            continue
        if near and id in same:
            about[id] = *same[id], near[0].factors[id][:n]
            before[id] = near[0].made[id].first(n)
            continue
        centre, stated, expected, half = centres[id]
        factors = np.exp(half * spread)
        about[id] = centre, stated, expected, factors
        # the entry does not depend on the data, but for the ticks that count
        if remember and sensors.alike and centre == stated and id not in before:
            sensor = sensors.of(id, 0)
            cells = sorted((name, summary.values.size) for name, summary in seen.summaries.items())
            rest = half, replicates.seed, replicates.dead, seen.early, cells
            entries[id] = replicate_cache.entry_name(sensor, seen.capture, *rest)
            found = replicate_cache.recall(entries[id])
            # a statistic that only a later replicate lacks is in none of a longer entry
            if found is not None and (len(found.numbers) <= n or seen.summaries.keys() <= found.values.keys()):
                before[id] = found.first(n)
                replicates.charge(sensor, id, len(before[id].numbers))
        here = len(before[id].numbers) if id in before else 0
        if here < n:
            wanted.append((sensors, id, centre * factors[here:], np.arange(here, n, dtype=np.uint64)))
    results = dict(zip((id for _, id, _, _ in wanted), replicates.simulate(wanted, pieces=_PIECES), strict=True))
    for id, (centre, stated, expected, factors) in about.items():
        more = results.get(id)
        if isinstance(more, CannotSimulate):
            raise SpadError(f"{id}: {more}")
        made = before[id] if more is None else joined([before[id], more]) if id in before else more
        if id in entries and more is not None:
            replicate_cache.keep(entries[id], made)
        evaluation.made[id] = made
        law, scatter = law_of(made.totals, np.array([expected(float(centre * f)) for f in factors]))
        most = most_detections(replicates.seen[id].counted, sensors.one.layout.pixels)
        evaluation.rates[id] = CaptureNull(
            level=centre, stated=stated, totals=made.totals, expected=expected, law=law, scatter=scatter, most=most
        )
        evaluation.factors[id] = factors
        if whole_of(replicates, id) in faint_captures(replicates):
            continue  # replicates without a detection are all alike: one detection would be any number of sigma
        for name, summary in replicates.seen[id].summaries.items():
            if name not in made.values:
                continue
            kind, scale = made.laws[name]
            summaries = [Summary(v, kind, str, no_size, scale) for v in made.values[name]]
            null = learn(summaries, made.totals, summary.contrasts)
            cell = id, name
            evaluation.nulls[cell] = null
            evaluation.judgements[cell] = judged = null.judge(summary.values, replicates.seen[id].total)
            if not null.law.exact:
                evaluation.residuals[cell] = judged.residuals
                evaluation.replicate_residuals[cell] = replicate_residuals(null, made, made.values[name])
    if any(id in entries for id in results):
        replicate_cache.make_room()
    _compare_totals(replicates, evaluation, n)
    return evaluation


def faint_captures(replicates: Replicates) -> frozenset[str]:
    """The captures of which the stated model expects so few detections that the total alone is compared.

    They are the same for all models that are compared with the stated one. Many detections are as many replicates.
    """
    if replicates.faint is None:
        start = Model.same(replicates.start)
        reduced = {id: seen for id, seen in replicates.seen.items() if seen.summaries}
        levels = {id: central_level(replicates, start.mean_sensor(id), seen) for id, seen in reduced.items()}
        found = (id for id, (level, _, expected, _) in levels.items() if expected(level) < _FEW_DETECTIONS)
        replicates.faint = frozenset(whole_of(replicates, id) for id in found)
    return replicates.faint


def _compare_totals(replicates: Replicates, evaluation: Evaluation, number: int) -> None:
    """Write the residuals of the totals, and those of so many replicates."""
    evaluation.residuals[TOTALS] = totals_residuals(
        replicates, evaluation, {id: math.log(max(s.total, 0.5)) for id, s in replicates.seen.items()}
    )
    draws = np.random.Generator(np.random.Philox(key=replicates.seed + 1)).standard_normal(number)
    evaluation.replicate_residuals[TOTALS] = np.stack(
        [own_totals(replicates, evaluation, k, float(draws[k])) for k in range(number)]
    )


def with_totals_anew(replicates: Replicates, evaluation: Evaluation) -> Evaluation:
    """The evaluation with its totals compared anew, where `Replicates.unstated` has changed."""
    again = replace(
        evaluation,
        residuals=dict(evaluation.residuals),
        replicate_residuals=dict(evaluation.replicate_residuals),
        space=None,
    )
    _compare_totals(replicates, again, len(again.replicate_residuals[TOTALS]))
    return again


def as_compared(replicates: Replicates, evaluation: Evaluation) -> Evaluation:
    """The evaluation without the totals of captures whose level is free now."""
    return with_totals_anew(replicates, evaluation) if replicates.unstated else evaluation


_Centre = tuple[float, float | None, Callable[[float], float], float]  # see `central_level`


def _same_level(
    replicates: Replicates, sensors: Model, number: int, near: Evaluation, differs: Collection[str]
) -> dict[str, tuple[float, float | None, Callable[[float], float]]]:
    """(level, stated level, level -> detections) of each capture whose replicates can be borrowed.

    At that level the model gives as many detections as the other one gave at its own level.

    Args:
        number: of replicates.
        near: the evaluation of the other model.
        differs: the captures in which the two differ.
    """
    out = {}
    for id, made in near.made.items():
        sensor, null = sensors.mean_sensor(id), near.rates[id]
        if id in differs or len(made.numbers) < number or not sensor.states_mean:
            continue
        level = null.level * matched_light(replicates, near, sensor, id)
        _, stated, expected, _ = central_level(replicates, sensor, replicates.seen[id])
        if abs(math.log(expected(level) / null.expected(null.level))) < _SAME_TOTAL:
            out[id] = level, stated, expected
    return out


def _centres(replicates: Replicates, sensors: Model, without: Collection[str] = ()) -> dict[str, _Centre]:
    """Of each capture that is simulated, the result of `central_level`.

    Where an effect does not say what it does to the mean, a few replicates do: at another brightness than the measured
    one, every expectation would be extrapolated to the measured total.
    """
    out = {
        id: central_level(replicates, sensors.mean_sensor(id), seen)
        for id, seen in replicates.seen.items()
        if seen.counts is not None and id not in without
    }
    some = [id for id in out if not sensors.mean_sensor(id).states_mean]
    numbers = np.arange(FEW, dtype=np.uint64)
    closed = dict(out)
    # where pixels blink by themselves a total may be far from its mean, at the stated rates
    own = [
        id for id in out if any(e.acts_on == "own" for e in sensors.mean_sensor(id).effects) and out[id][1] is not None
    ]
    many = np.arange(_BLINKING, dtype=np.uint64)
    asked = [(sensors, id, np.full(_BLINKING, out[id][1]), many) for id in own if out[id][0] != out[id][1]]
    for (_, id, _, _), made in zip(asked, replicates.simulate(asked) if asked else [], strict=True):
        if not isinstance(made, CannotSimulate):
            logs = np.log(np.maximum(made.totals, 0.5))
            reach = _SCATTERS * float(np.std(logs, ddof=1)) * math.sqrt(1 + 1 / _BLINKING)
            if abs(math.log(max(replicates.seen[id].total, 0.5)) - float(logs.mean())) < reach:
                _, stated, expected, half = out[id]
                out[id] = closed[id] = float(stated or 1.0), stated, expected, half
    # a loss that grows with the light is that of the stated light, if this gives as many
    at = {id: out[id][0] if out[id][1] is None else float(out[id][1] or 0.0) for id in some}
    for _ in range(_PILOTS):
        pilots = replicates.simulate([(sensors, id, np.full(FEW, at[id]), numbers) for id in at]) if at else []
        for id, made in zip(list(at), pilots, strict=True):
            level = at.pop(id)
            if isinstance(made, CannotSimulate):
                continue  # the replicates themselves will say so
            start, stated, expected, half = closed[id]
            logs = np.log(np.maximum(made.totals, 0.5))
            noise = _NOISE * float(np.std(logs, ddof=1)) / math.sqrt(FEW)
            off = float(logs.mean()) - math.log(expected(level))
            if abs(off) > half + noise:
                seen = replicates.seen[id]
                most = most_detections(seen.counted, sensors.one.layout.pixels)
                # the total at which the closed form would have to be, for the measured one to come out
                start, half = levels_about(expected, seen.total / math.exp(off), stated, seen.counted, most)
            out[id] = start, stated, expected, half
            if abs(math.log(start / level)) > half + noise:
                at[id] = start
    return out


def far_wider(scatter: float, expected: float) -> bool:
    """Whether totals with this scatter are those of a light that fluctuates.

    Args:
        scatter, expected: standard deviation of the log of the totals, and that without fluctuations.
    """
    return scatter > _FLUCTUATES * expected


def square(residuals: Mapping[Cell, np.ndarray]) -> float:
    """The sum of all squared residuals."""
    return sum(float(z @ z) for z in residuals.values())


def log_likelihood_ratio(evaluation: Evaluation, other: Evaluation, template: Mapping[Cell, np.ndarray]) -> float:
    """Twice the log quasi-likelihood ratio of another model to this one, each cell by its own model's scatter.

            sum z^2 - z'^2 - 2 log(s' / s)

    z, s: residual and scatter of a cell under this model; z', s': under the other. A model with more scatter has
    smaller squares even if it is wrong; the log of the scatter is the price. The totals count, and the cells that the
    other model moves, or whose scatter is another one: the noise of thousands of other cells would decide.

    Args:
        evaluation, other: of the two models.
        template: of the other model (`template_of`); a statistic without a signature is not moved.
    """
    out = 0.0
    for cell in other.residuals.keys() & evaluation.residuals.keys():
        z, there = evaluation.residuals[cell], other.residuals[cell]
        if cell not in other.nulls or cell not in evaluation.nulls:  # the totals
            out += float(z @ z - there @ there)
            continue
        null, new = evaluation.nulls[cell], other.nulls[cell]
        fall, wider = null.law.likelihood_ratio(z, there, (null.breadth, new.breadth), (null.factor, new.factor))
        wider = np.broadcast_to(wider, z.shape)
        error = null.law.error_of_scatter(z.size, min(len(null.replicate_squares), len(new.replicate_squares)))
        moved = (template[cell] != 0) & (float(template[cell] @ template[cell]) > _MOVED)
        other_scatter = np.abs(wider) > _OTHER_SCATTER * error
        # a cell that never varies has no scatter: the log of its ratio is bounded
        evidence = fall - 2 * np.clip(wider, -_WIDEST, _WIDEST)
        out += float(np.sum(evidence[moved | other_scatter]))
    if evaluation.space is None or other.space is None or evaluation.space[0] != other.space[0]:
        return out  # of other totals the scatters are not compared
    return out + 2 * (_log_precision(*other.space[1:3]) - _log_precision(*evaluation.space[1:3]))


def _log_precision(elasticity: np.ndarray, root: np.ndarray) -> float:
    """The log determinant of the inverse root of the covariance of the log totals; see `totals_space`."""
    return float(np.linalg.slogdet(root)[1] - np.sum(np.log(elasticity)))


def stacked(blocks: Mapping[Cell, np.ndarray], keys: Sequence[Cell]) -> np.ndarray:
    """The cells of several blocks in one vector, (cells,), in the order of `keys`."""
    return np.concatenate([blocks[k] for k in keys]) if keys else np.zeros(0)


def misfits(replicate_residuals: Mapping[Cell, np.ndarray], residuals: Mapping[Cell, np.ndarray]) -> dict[Cell, float]:
    """The mean squared residual of each block, relative to that of the model's replicates.

    Args:
        replicate_residuals: (replicates, cells) residuals of the replicates, by block.
        residuals: (cells,) by block.
    """
    return {
        cell: float(np.mean(z**2)) / max(float(np.mean(replicate_residuals[cell] ** 2)), 0.05)
        for cell, z in residuals.items()
        if cell != TOTALS and len(z)
    }


def mean_misfit(replicate_residuals: Mapping[Cell, np.ndarray], residuals: Mapping[Cell, np.ndarray]) -> float:
    """The mean misfit over the blocks; where only means were measured, that of the totals.

    Args:
        replicate_residuals, residuals: as in `misfits`.
    """
    all_ = list(misfits(replicate_residuals, residuals).values())
    if not all_ and len(residuals[TOTALS]):
        return float(np.mean(residuals[TOTALS] ** 2))
    return float(np.mean(all_)) if all_ else 1.0


def misfit_null_95(replicate_residuals: Mapping[Cell, np.ndarray]) -> float:
    """The 95 % quantile of the mean misfit under the null.

    Args:
        replicate_residuals: as in `misfits`; the number of replicates that all blocks have is used.
    """
    squares = [np.mean(z**2, axis=1) for cell, z in replicate_residuals.items() if cell != TOTALS]
    if not squares:
        return 1.2
    n = min(map(len, squares))
    return float(np.quantile(np.mean([x[:n] / max(x[:n].mean(), 1e-30) for x in squares], axis=0), 0.95))
