"""Blocks of time: where one capture alone tells a number, one half of it is judged by what the other half settles.

The halves are alternating blocks of time (`Recording.every_other`), of the data and of the model's recordings alike.
Every rung of a ladder is judged in the same cells, so that what falls from one to the next is no other measure.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from ..statistics import Summary
from . import checks, mapping, settling
from .fit import Bench, Cell, State, halves_of
from .ladder import Rung

_SAME_PLACE = 0.02  # relative, on the axis: cells of two captures that look at the same
_FEWER = 2  # times fewer recordings for a half than for a whole capture, but at least so many
_LEAST = 16


def measure(bench: Bench, rungs: Sequence[Rung]) -> float:
    """Judge all rungs in the same cells, theirs and their steps' misfits with it; the 95 % of a right model's.

    Captures are as they were measured, but those that alone tell a number of some rung: these are two halves.
    """
    ids = set().union(*(_alone(bench, rung) for rung in rungs))
    half = bench.halves(ids) if ids else None
    if half is None or not half.seen:
        _tell(rungs)
        return checks.usual_misfit(rungs[0].state.own)
    bench.say("the misfit in blocks of time of " + ", ".join(id for id in bench.seen if halves_of(id)[0] in half.seen))
    apart = {id for id in ids if halves_of(id)[0] in half.seen}
    begun = half.simulations
    known: dict[int, State] = {}
    first: dict[Cell, np.ndarray] = {}
    for rung in rungs:
        name = id(rung.state)
        if name not in known:
            known[name] = _state(bench, half, rung, apart)
        there = known[name]
        residuals = there.residuals
        if rung.placebo is not None:
            (moved,) = half.moved(there, [there.sensors.changed(rung.placebo)])
            residuals = there.residuals if isinstance(moved, str) else half.residuals(there, moved)
        own = _beside(rung.state.own, there.own, apart)
        left = _beside(rung.left, residuals, apart)
        if rung.settled is not None:
            slopes = _beside(rung.settled.slopes, _slopes(bench, half, rung.settled.slopes, apart), apart)
            left = settling.unseen(_beside(rung.state.residuals, residuals, apart), slopes)
        rung.left, rung.misfit = left, checks.misfit(own, left)
        first = first or own
    bench.simulations += half.simulations - begun
    _tell(rungs)
    return checks.usual_misfit(first)


def _tell(rungs: Sequence[Rung]) -> None:
    for rung in rungs:
        for step in rung.steps:
            step.misfit = rung.misfit


def _alone(bench: Bench, rung: Rung) -> set[str]:
    """Captures that alone tell a number of a rung, or a map."""
    out: set[str] = set()
    if rung.settled is not None:
        out |= settling.alone(rung.state.residuals, rung.settled.slopes)
    if rung.maps is not None:
        out |= mapping.alone(bench, rung.maps.values, rung.maps.held, mapping.levels_of(bench, rung.state))
    return out


def _state(bench: Bench, half: Bench, rung: Rung, apart: Collection[str]) -> State:
    """The model of a rung beside the halves, its maps settled without the one that they are beside."""
    whole_of = {name: id for id in apart for name in halves_of(id)}
    sensors = rung.state.sensors.under(lambda name: whole_of.get(name, name))
    if rung.maps is not None:
        all_ = copy.copy(half)
        all_.seen = {**{id: seen for id, seen in bench.seen.items() if id not in apart}, **half.seen}
        usual = mapping.levels_of(bench, rung.state)
        levels = {name: usual[whole_of.get(name, name)] for name in all_.seen}
        phases = {(name, key): x for (id, key), x in rung.maps.phases.items() for name in (id, *halves_of(id))}
        sensors, _, _ = mapping.sensors_with(all_, rung.maps.values, rung.maps.held, levels)
        sensors = sensors.changed({}, phases, rung.maps.chips)
    return half.state(rung.state.values, sensors, max(half.replicates // _FEWER, _LEAST))


def _beside(
    whole: Mapping[Cell, np.ndarray], halves: Mapping[Cell, np.ndarray], apart: Collection[str]
) -> dict[Cell, np.ndarray]:
    """The cells of captures as a whole, and those of halves in place of some; the totals are those of all captures."""
    return {
        **{cell: x for cell, x in whole.items() if cell[0] not in apart},
        **{cell: x for cell, x in halves.items() if cell[0]},
    }


def _slopes(
    bench: Bench, half: Bench, slopes: Mapping[Cell, np.ndarray], apart: Collection[str]
) -> dict[Cell, np.ndarray]:
    """(cells, dials) how halves follow the numbers: as the same cells of the whole do, as surely as they are long.

    The cells of a spectrum are others; they are thousands, and what a number takes away of them is nothing.
    """
    out = {}
    for (id, statistic), whole in slopes.items():
        for name in halves_of(id) if id in apart else ():
            there, here = bench.seen[id].summaries[statistic], half.seen[name].summaries.get(statistic)
            if here is None:
                continue
            out[name, statistic] = new = np.zeros((len(here.values), whole.shape[1]))
            if here.law != "exponential":
                mine, its = _same_places(here, there)
                share = half.seen[name].total / max(bench.seen[id].total, 1.0)
                new[mine] = whole[its] * math.sqrt(share)
    return out


def _same_places(here: Summary, there: Summary) -> tuple[np.ndarray, np.ndarray]:
    """(cells here, cells there) that look at the same thing."""
    if len(here.values) == len(there.values):
        return np.arange(len(here.values)), np.arange(len(here.values))
    if here.axis is None or there.axis is None:
        return np.zeros(0, int), np.zeros(0, int)
    nearest = np.argmin(np.abs(here.axis[:, None] - there.axis[None, :]), axis=1)
    close = np.isclose(here.axis, there.axis[nearest], rtol=_SAME_PLACE, atol=0.0)
    return np.flatnonzero(close), nearest[close]
