"""Fitted: settle what the caller names, by the exact likelihood where there is one, or by simulation."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from ..effects import Effect
from ..errors import InputError, did_you_mean
from ..factory import pool
from ..measurement import Measurement
from ..sensor import Sensor
from . import blocks, counted, fit, likelihood, mapping, recordings, settling
from .answer import Diagnosis, Step, Value, title
from .candidates import Change, Key, changes
from .chance import LEAST_P, of_map
from .course import Course, accept, begun, errors_known, material, settle_all, widen
from .findings import nuisances, remainder, traces
from .fit import Bench, Moved, likelier
from .refining import refine, state_of
from .settling import Settled
from .tried import Tried


def fitted(
    sensor: Sensor,
    measurement: Measurement,
    add: Sequence[str] = (),
    free: Sequence[str] = (),
    per_pixel: Sequence[str] = (),
    seed: int = 0,
    jobs: int = 2,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Settle what the caller names: whole effects (`add`), "effect.parameter" (`free`), and maps (`per_pixel`).

    A map of the dark by the pixels' counts, where captures without light tell it (`counted`); else by the exact
    likelihood where all that is asked for and all that the sensor has is in it; otherwise by simulation.
    Raises InputError where there is no such effect or parameter.
    """
    say = progress or (lambda what: None)
    every, listed = changes(sensor.settled(), measurement.captures), {e.name for e in sensor.effects}
    wanted = [
        *(_named(every, listed, "add", name, None) for name in add),
        *(_named(every, listed, "set", *_halves(name)) for name in free),
        *(_named(every, listed, "per_pixel", *_halves(name)) for name in per_pixel),
    ]
    if not wanted:
        raise InputError("nothing is to be settled; name --add EFFECT, --free EFFECT.PARAMETER or --per-pixel ...")
    with pool(jobs) as parallel:
        if counted.may_settle(sensor.settled(), wanted):
            bench = Bench(sensor, measurement, seed, parallel, recordings.REPLICATES, say, reduced=False)
            answer = counted.settled(bench, measurement, wanted[0])
            if not isinstance(answer, str):
                say("by the counts in the dark alone; compare sets all else beside the new model")
                return answer
            say(f"not by counts in the dark alone, for there is {answer}")
        bench = Bench(sensor, measurement, seed, parallel, recordings.REPLICATES, say)
        course = begun(bench)
        start, wrong = course.state, bool(course.failed)
        say("settling " + ", ".join(title(change) for change in wanted))
        data = [measurement.recording(c.id, bench.start) for c in measurement.captures if c.mean is None]
        exact = likelihood.settled(bench.start, data, wanted) if len(data) == len(bench.seen) else "a mean alone"
        if isinstance(exact, str):
            say(f"by simulation, for there is no likelihood of {exact}")
            _by_simulation(course, wanted)
        else:
            _by_likelihood(course, wanted, exact)
        widen(course)
        usual = blocks.measure(bench, course.ladder)
        right = "explained" if wrong else "adequate"
        return Diagnosis(
            bench.start.name,
            measurement.name,
            "partly_explained" if course.failed else right,
            course.ladder[0].misfit,
            course.ladder[-1].misfit,
            usual,
            nuisances(bench, course.state),
            course.steps,
            [],
            remainder(bench, course.state, course.state.residuals),
            [rung.row for rung in course.ladder],
            [],
            [],
            [],
            [],
            traces(bench, start, course.state),
            course.values,
            None,
            bench.simulations,
            bench.dark,
            str(bench.start.window) if bench.start.window else None,
            covariance=_covariance(course, exact),
            asked="fit",
        )


def _covariance(course: Course, exact: likelihood.Exact | str) -> tuple[list[str], np.ndarray]:
    """("effect.parameter" of the fitted numbers, their covariance in SI).

    Its diagonal is that of the 95 % intervals, taken as symmetric; the correlations are those of the likelihood, or of
    the last fit by simulation.
    """
    free: tuple[Key, ...] = ()
    correlations = np.zeros((0, 0))
    if not isinstance(exact, str):
        free, correlations = exact.free, exact.correlations
    elif course.settled is not None:
        free, matrix = tuple(dial.key for dial in course.settled.dials), course.settled.covariance
        spread = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        correlations = matrix / np.outer(spread, spread)
    told = {(s.change.effect, name): v for s in course.steps if not s.change.carrier for name, v in s.values.items()}
    at, errors = [], []
    for i, key in enumerate(free):
        value = told.get(key)
        if value is not None and value.low is not None and value.high is not None:
            at.append(i)
            errors.append((value.high - value.low) / (2 * 1.96))
    return [".".join(free[i]) for i in at], correlations[np.ix_(at, at)] * np.outer(errors, errors)


def _by_likelihood(course: Course, wanted: Sequence[Change], exact: likelihood.Exact) -> None:
    """Steps with these numbers; their misfit is found as that of all others."""
    bench, before = course.bench, course.state
    for change, gain in zip(wanted, exact.gains, strict=True):
        intervals = {d.key: exact.intervals[d.key] for d in change.dials}
        own = {**dict(change.fixed), **{key: exact.values[key] for key in intervals}}
        moved = bench.told(before, before.sensors.changed(own))
        told = material(Tried(change, own, moved, gain, 1.0))
        step = Step(change, {}, 0.0, math.sqrt(max(gain, 0.0)), told, intervals=intervals)
        step.template, step.before = bench.template(before, moved), dict(before.residuals)
        course.steps.append(step)
    course.search.accepted += wanted
    course.values = {**course.values, **exact.values}
    settle_all(course)
    for step in course.steps:
        step.values = {name: replace(v, method="likelihood") for name, v in step.values.items()}
    course.rung("+ " + " + ".join(title(change) for change in wanted), course.steps)


def _by_simulation(course: Course, wanted: Sequence[Change]) -> None:
    """A step for each, maps last; then the intervals of all numbers by profile."""
    bench = course.bench
    for change in sorted(wanted, key=lambda c: bool(c.carrier)):
        if change.carrier:
            p = of_map(bench, course.state, change, course.values, mapping.levels_of(bench, course.state))
            best = Tried(change, {}, Moved({}, {}, {}), 0.0, 1.0, maps={}, chance=p)
            accept(course, best, float(stats.norm.isf(max(p, LEAST_P) / 2)))
            continue
        best = refine(bench, course.state, _started(course, change), 5)
        if not change.dials:  # a switch, which may be as it should be
            best.gain = likelier(course.state, state_of(bench, best), bench.template(course.state, best.moved))
            if best.gain <= 0:
                _kept(course, change)
                continue
        accept(course, best, math.sqrt(max(best.gain, 0.0)))
    ends: dict[Key, tuple[float, float]] = {}
    dials = tuple(d for step in course.steps for d in step.dials)
    if dials:
        bench.say("intervals")
        # the state's own numbers, from which the settled ones are one step away
        here = {d.key: course.state.values.get(d.key, course.values[d.key]) for d in dials}
        sensors, few = course.state.sensors.changed, 2 * fit.FEW
        settled = settling.follow(bench, course.state, dials, here, sensors, few, errors_known(course))
        if isinstance(settled, Settled):
            settled = replace(settled, point=settling.point_of(dials, course.values))
            ends = settling.profiled(bench, course.state, settled, sensors, few)
    for step in course.steps:
        for name, value in step.values.items():
            low, high = ends.get((step.change.effect, name), (value.low, value.high))
            how = "simulation"
            if step.change.carrier:
                how = "intervals" if step.change.blinds else "counts"
            step.values[name] = replace(value, low=low, high=high, method=how)


def _kept(course: Course, change: Change) -> None:
    """A switch that the data want as it is listed."""
    told: dict[str, Value] = {}
    for (effect, name), _ in change.fixed:
        told[name] = Value(float(getattr(course.bench.start.effect(effect), name)), None, None)
    course.steps.append(Step(change, told, course.misfit, 0.0, "mean rate +0.00%"))
    course.rung(f"{title(change)} as it was", course.steps[-1:])


def _started(course: Course, change: Change) -> Tried:
    """The template of a change that comes nearest, at the strength that suits it."""
    found = course.search.looked_at(course.state, change, course.search.begun(course.state, change))
    if not found:
        raise InputError(f"{title(change)} cannot be simulated in these captures")
    return max(found, key=lambda t: t.gain)


def _halves(name: str) -> tuple[str, str]:
    effect, dot, parameter = name.partition(".")
    if not dot or not parameter:
        raise InputError(f"{name!r} is not EFFECT.PARAMETER, for example dead_time.duration")
    return effect, parameter


def _named(every: Sequence[Change], known: Collection[str], kind: str, effect: str, parameter: str | None) -> Change:
    listed = effect in known
    for change in every:
        if (change.kind, change.effect) == (kind, effect) and (kind == "add" or change.parameter == parameter):
            return change
    name = effect + (f".{parameter}" if parameter else "")
    if kind == "add" and listed:
        raise InputError(f"--add {name}: the sensor lists it already; settle its numbers, --free {effect}.PARAMETER")
    if kind == "set" and not listed and effect in Effect.registry:
        raise InputError(f"--free {name}: the sensor does not list {effect}; --add {effect} adds it and settles it")
    able = sorted({c.effect + (f".{c.parameter}" if c.parameter else "") for c in every if c.kind == kind})
    raise InputError(f"{name} cannot be settled here; those that can: {', '.join(able)}.{did_you_mean(name, able)}")
