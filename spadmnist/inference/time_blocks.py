"""Alternating blocks of time: where one capture alone informs a coordinate, one half is judged by a fit to the other.

The halves are blocks of the data and of the model's replicates alike (`Recording.every_other`). Every row of an error
budget is judged in the same cells.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from ..statistics import Summary
from . import count_model, held_out, map_models
from .capture_replicates import CannotSimulate
from .error_budget import Rung
from .evaluation import Evaluation, evaluate, mean_misfit, misfit_null_95
from .laws import law_of
from .reduction import halves_of
from .replicates import Cell, Replicates
from .signature import residuals_at, signatures

# relative, on the axis: cells of two captures at the same place, whose Jacobian is the same but for the detections; a
# rule of thumb
_SAME_PLACE = 0.02
# the number of replicates of a half is that of a whole capture over this, but not below the least: two halves
# then take about as long as the whole. A rule of thumb
_FEWER = 2
_LEAST = 16  # replicates of a half, at least: the noise of its null distribution; a rule of thumb


def measure(replicates: Replicates, rungs: Sequence[Rung]) -> float:
    """The 95 % quantile of the misfit under the null; the misfits of all rows and of their steps are set.

    All rows are judged in the same cells. A capture that alone informs a coordinate of some row is split into two
    halves; every other capture stays whole.
    """
    ids = set().union(*(_captures_needed(replicates, rung) for rung in rungs))
    half = replicates.halves(ids) if ids else None
    if half is None or not half.seen:
        _set_misfits(rungs)
        return misfit_null_95(rungs[0].evaluation.replicate_residuals)
    replicates.say(
        "the misfit in blocks of time of " + ", ".join(id for id in replicates.seen if halves_of(id)[0] in half.seen)
    )
    apart = {id for id in ids if halves_of(id)[0] in half.seen}
    begun = half.simulations
    known: dict[int, Evaluation] = {}
    first: dict[Cell, np.ndarray] = {}
    for rung in rungs:
        name = id(rung.evaluation)
        if name not in known:
            known[name] = _evaluation(replicates, half, rung, apart)
        there = known[name]
        residuals = there.residuals
        if rung.placebo is not None:
            (signature,) = signatures(half, there, [there.sensors.changed(rung.placebo)])
            if not isinstance(signature, CannotSimulate):
                residuals = residuals_at(half, there, signature)
        replicate_residuals = _with_halves(rung.evaluation.replicate_residuals, there.replicate_residuals, apart)
        left = _with_halves(rung.left, residuals, apart)
        if rung.fit is not None:
            jacobian = _with_halves(
                rung.fit.jacobian, jacobian_of_halves(replicates, half, rung.fit.jacobian, apart), apart
            )
            left = held_out.leave_one_capture_out(_with_halves(rung.evaluation.residuals, residuals, apart), jacobian)
        rung.left, rung.misfit = left, mean_misfit(replicate_residuals, left)
        first = first or replicate_residuals
    replicates.simulations += half.simulations - begun
    _set_misfits(rungs)
    return misfit_null_95(first)


def _set_misfits(rungs: Sequence[Rung]) -> None:
    for rung in rungs:
        for step in rung.steps:
            step.misfit = rung.misfit


def _captures_needed(replicates: Replicates, rung: Rung) -> set[str]:
    """The captures that alone inform a coordinate or a map of a row."""
    out: set[str] = set()
    if rung.fit is not None:
        out |= held_out.captures_needed(rung.evaluation.residuals, rung.fit.jacobian)
    if rung.maps is not None:
        out |= map_models.captures_needed(
            replicates, rung.maps.values, rung.maps.held, count_model.light_levels_of(replicates, rung.evaluation)
        )
    return out


def _evaluation(replicates: Replicates, half: Replicates, rung: Rung, apart: Collection[str]) -> Evaluation:
    """The evaluation of a row's model on the halves, its maps fitted without the half that is judged."""
    whole_of = {name: id for id in apart for name in halves_of(id)}
    sensors = rung.evaluation.sensors.under(lambda name: whole_of.get(name, name))
    if rung.maps is not None:
        all_ = copy.copy(half)
        all_.seen = {**{id: seen for id, seen in replicates.seen.items() if id not in apart}, **half.seen}
        levels_of_whole = count_model.light_levels_of(replicates, rung.evaluation)
        levels = {name: levels_of_whole[whole_of.get(name, name)] for name in all_.seen}
        phases = {(name, key): x for (id, key), x in rung.maps.phases.items() for name in (id, *halves_of(id))}
        sensors, _, _ = map_models.models_with_maps(all_, rung.maps.values, rung.maps.held, levels)
        sensors = sensors.changed({}, phases, rung.maps.chips)
    return evaluate(half, rung.evaluation.values, sensors, max(half.number // _FEWER, _LEAST))


def _with_halves(
    whole: Mapping[Cell, np.ndarray], halves: Mapping[Cell, np.ndarray], apart: Collection[str]
) -> dict[Cell, np.ndarray]:
    """The cells of whole captures, with those of halves in place of some; the totals are those of all captures."""
    return {
        **{cell: x for cell, x in whole.items() if cell[0] not in apart},
        **{cell: x for cell, x in halves.items() if cell[0]},
    }


def jacobian_of_halves(
    replicates: Replicates, half: Replicates, jacobian: Mapping[Cell, np.ndarray], apart: Collection[str]
) -> dict[Cell, np.ndarray]:
    """The Jacobian of the halves, (cells, coordinates) by block.

    It is that of the same cells of the whole capture, times the root of the share of its detections. The cells of a
    spectrum are others: there are thousands, and the optimism of a coordinate in them is negligible.
    """
    out = {}
    for (id, statistic), whole in jacobian.items():
        for name in halves_of(id) if id in apart else ():
            there, here = replicates.seen[id].summaries[statistic], half.seen[name].summaries.get(statistic)
            if here is None:
                continue
            out[name, statistic] = new = np.zeros((len(here.values), whole.shape[1]))
            if not law_of(here.law, here.scale is not None).spectrum:
                mine, its = same_places(here, there)
                share = half.seen[name].detections / max(replicates.seen[id].detections, 1.0)
                new[mine] = whole[its] * math.sqrt(share)
    return out


def same_places(here: Summary, there: Summary) -> tuple[np.ndarray, np.ndarray]:
    """(cells here, cells there) at the same place on the axis."""
    if len(here.values) == len(there.values):
        return np.arange(len(here.values)), np.arange(len(here.values))
    if here.axis is None or there.axis is None:
        return np.zeros(0, int), np.zeros(0, int)
    nearest = np.argmin(np.abs(here.axis[:, None] - there.axis[None, :]), axis=1)
    close = np.isclose(here.axis, there.axis[nearest], rtol=_SAME_PLACE, atol=0.0)
    return np.flatnonzero(close), nearest[close]
