"""Diagnose: which physical effect does a model lack? Add it, settle it, watch the error fall.

Only where a model fails (as `compare` judges) are candidates tried: every registered effect that it lacks, every
listed number at another value, every map (`candidates`). A few simulated recordings tell what each would change; those
that come closest are settled (`search`), the best is added, everything is settled anew, and so on until nothing is
left. What the set-up explains is no matter of the sensor (`setups`).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ..effects import Mimic
from ..errors import UNABLE, why
from ..factory import pool
from ..measurement import Measurement
from ..sensor import Sensor
from . import advice, blocks, chance, checks, limits, recordings, setups
from . import compare as comparing
from .answer import Diagnosis, Step, Value, plain, title
from .candidates import Change
from .course import (
    LEAST_GAIN,
    Course,
    accept,
    begun,
    drop_mimics,
    drop_needless,
    in_vain,
    open_ends,
    settle_exactly,
    widen,
)
from .findings import mimicked, nuisances, remainder, traces
from .fit import RATES, Bench, State, square
from .ladder import Rung, placebo_of
from .refining import refine
from .search import Search, alike, gain_beside
from .tried import Tried, at_end

_QUICK = 32  # recordings of each capture by which `quick` judges
_TRACE = 4e-3  # p-value of a trace that is followed where no check fails by itself: less than what checks alarm by
_MAYBE, _CLOSER = 100.0, recordings.REPLICATES  # times as likely by chance: worth so many recordings
_PLAIN = 1e-6  # p-value of a check that needs no closer look
_NAMED = 4  # alternatives of a step
_ALMOST = 0.8  # of the gain of what lies at the end of its range: another law may be the right one
_LATER_TRACE = 5e-4  # the same beside steps that explain all that failed


def diagnose(
    sensor: Sensor,
    measurement: Measurement,
    seed: int = 0,
    max_steps: int = 4,
    quick: bool = False,
    jobs: int = 2,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Find what a model lacks. quick: fewer simulations. progress: told what is being done.

    Raises InputError where sensor and measurement do not belong together.
    """
    say = progress or (lambda what: None)
    with pool(jobs) as parallel:
        bench = Bench(sensor, measurement, seed, parallel, _QUICK if quick else recordings.REPLICATES, say)
        short = setups.stopped_early(bench)
        if short:
            exposures = {id: bench.seen[id].capture.conditions.exposure * share for id, (share, _) in short.items()}
            bench = Bench(sensor, measurement, seed, parallel, bench.replicates, say, exposures)
        return _diagnosed(bench, measurement, max_steps, quick, short)


@dataclass
class _Beside:
    """What a diagnosis says beside its steps.

    explained: is what fails in the totals the set-up's? bent: or that of a nonlinearity that no effect here has? tried:
    candidates as they were last looked at. looked: the model beside which they were looked at in all captures.
    """

    setup: list[dict[str, Any]]
    explained: bool = False
    bent: bool = False
    advice: list[dict[str, Any]] = field(default_factory=list)
    rival: Tried | None = None
    placebo: Rung | None = None
    tried: list[Tried] = field(default_factory=list)
    looked: State | None = None


def _diagnosed(
    bench: Bench, measurement: Measurement, max_steps: int, quick: bool, short: Mapping[str, tuple[float, float]]
) -> Diagnosis:
    course = begun(bench)
    start, beside = course.state, _Beside(_too_short(short))
    while len(course.steps) < max_steps and not in_vain(course, not beside.explained) and _possible(course, beside):
        pass
    if course.steps:
        with _or_as_before(course, "taking out what is needless"):
            drop_needless(course)
        with _or_as_before(course, "taking out what only looks alike"):
            drop_mimics(course, start, not beside.explained)
    if course.steps and not short:
        with _or_as_before(course, "settling by likelihood"):
            settle_exactly(course, measurement)
    with _or_as_before(course, "the intervals"):
        widen(course)
    with _or_as_before(course, "the intervals"):
        open_ends(course)
    if course.steps:
        with _or_as_before(course, "the last comparison"):
            course.last_rung()
    left = course.failed
    if left and beside.explained and all(b.cell[0] == "" for b in left):
        left = []
    verdict = _verdict(course, left, beside)
    if not course.steps:
        course.state, course.settled, course.values = start, None, {}
        course.ladder = course.ladder[:1] if verdict != "unexplained" else course.ladder
    rungs = [course.ladder[0], *([beside.placebo] if beside.placebo else []), *course.ladder[1:]]
    usual = _measured(course, rungs)
    after = (course.ladder[-1] if course.steps else course.ladder[0]).misfit
    if verdict == "explained":
        verdict = _or_confused(course, beside)
    if beside.rival is not None:
        course.steps.append(_rival_step(course, beside.rival))
    for step in course.steps:
        for other in step.alternatives:
            other.pop("confused", None)
            other.pop("tried", None)
    excluded: list[dict[str, Any]] = []
    invisible: list[dict[str, Any]] = []
    unlimited: list[dict[str, Any]] = []
    if verdict == "adequate" or (verdict == "explained" and not quick):
        bench.say("what would have been seen")
        if beside.looked is not course.state:  # the last step was the last one allowed, or its numbers have moved
            beside.tried = course.search.scan(course.state, everywhere=True, known=beside.tried)
        with _or_as_before(course, "the upper limits"):
            excluded, invisible, unlimited = limits.upper_limits(course.search, course.state, beside.tried)
    remains = verdict in ("unexplained", "partly_explained") or (verdict == "confused" and not course.steps)
    return Diagnosis(
        bench.start.name,
        measurement.name,
        verdict,
        rungs[0].misfit,
        after,
        usual,
        nuisances(bench, course.state),
        course.steps,
        beside.setup,
        remainder(bench, course.state, course.state.residuals) if remains else [],
        [rung.row for rung in rungs],
        beside.advice,
        excluded,
        invisible,
        unlimited,
        traces(bench, start, course.state),
        course.values,
        None,
        bench.simulations,
        bench.dark,
        str(bench.start.window) if bench.start.window else None,
        untried=course.search.untried,
    )


@contextlib.contextmanager
def _or_as_before(course: Course, where: str) -> Iterator[None]:
    """What is done to the steps, or the steps as they were, where that needs a model that cannot be simulated."""
    before, told = course.kept(), [(step, dict(step.values)) for step in course.steps]
    try:
        yield
    except UNABLE as error:
        course.back_to(before)
        for step, values in told:
            step.values = values
        for change in [step.change for step in course.steps[-1:]]:
            course.search.not_tried(change.kind, change.effect, change.parameter, where, why(error))


def _measured(course: Course, rungs: Sequence[Rung]) -> float:
    """As `blocks.measure`; where halves of a capture cannot be simulated, all rungs are judged by the whole."""
    before = [(rung, rung.left, rung.misfit) for rung in rungs]
    with _or_as_before(course, "the last comparison"):
        return blocks.measure(course.bench, rungs)
    for rung, left, misfit in before:
        rung.left, rung.misfit = left, misfit
        for step in rung.steps:
            step.misfit = misfit
    return checks.usual_misfit(rungs[0].state.own)


# --- a step ------------------------------------------------------------------------------------------------------


def _possible(course: Course, beside: _Beside) -> bool:
    """As `_another`; none, where the steps so far cannot be simulated as often as that takes."""
    before = course.kept()
    try:
        return _another(course, beside)
    except UNABLE as error:
        if not course.steps:
            raise
        course.back_to(before)
        last = course.steps[-1].change
        course.search.not_tried(last.kind, last.effect, last.parameter, "another step", why(error))
        return False


def _another(course: Course, beside: _Beside) -> bool:
    """Is there a step more, after which another one may come? Takes it."""
    bench, search, failed = course.bench, course.search, course.failed
    number = len(course.steps) + 1
    if failed and not course.steps and min(b.p for b in failed) > _PLAIN and _few(course):
        course.state = _closer(course)  # lest the scatter of few recordings decide
        failed = course.failed
    if not failed:
        # no check fails by itself: does any candidate's whole trace stand out?
        bench.say(f"step {number}: no check fails; looking for the trace of every candidate")
        beside.tried = search.scan(course.state, everywhere=True, known=beside.tried)
        before = beside.looked = course.state
        trace = _LATER_TRACE if course.steps else _TRACE
        if _stands_out(course, beside.tried, trace):
            closer = course.state
            if closer is not before:  # which may show lines that the few recordings did not
                beside.tried = search.scan(closer, everywhere=True, known=beside.tried)
            if _added(course, beside, failed, trace):
                return True
            if course.state is not closer:
                return False
        course.state = before  # by which no check fails: so nothing is left
        return False
    if search.only_rates(course.state) and _by_setup(course, beside):
        return False
    first = ", ".join(" of ".join(b.cell[::-1]).removesuffix(" of ") for b in failed[:4])
    bench.say(f"step {number}: {len(failed)} checks fail ({first}); trying every candidate")
    beside.tried = search.scan(course.state, known=beside.tried)
    return _added(course, beside, failed)


class _NoCandidate(Exception):
    """The best candidate cannot be simulated: it is none."""


def _added(
    course: Course, beside: _Beside, failed: Sequence[checks.Block], least: float = comparing.FALSE_ALARM
) -> bool:
    """Is the best of the candidates a step after which another one may come? Adds it, if it is one.

    least: the p-value that it must have. One that turns out to be none makes room for the next best.
    """
    while True:
        before = course.kept()
        try:
            return _best_added(course, beside, failed, least)
        except _NoCandidate as none:
            names = none.args[0]
        except UNABLE as error:  # between candidates, and it is not known of which: the one that promises most
            most = max(beside.tried, key=lambda t: t.gain, default=None)
            if most is None:
                raise
            course.search.exclude(most.change, "choosing the best", why(error))
            names = {most.change.name}
        course.back_to(before)
        beside.tried = [t for t in beside.tried if t.change.name not in names]


@contextlib.contextmanager
def _needed(course: Course, changes: Sequence[Change], where: str) -> Iterator[None]:
    """Without this the candidate is none: then it is excluded, and raises _NoCandidate."""
    try:
        yield
    except UNABLE as error:
        for change in changes:
            course.search.exclude(change, where, why(error))
        raise _NoCandidate({change.name for change in changes}) from error


def _best_added(course: Course, beside: _Beside, failed: Sequence[checks.Block], least: float) -> bool:
    bench, search, faint = course.bench, course.search, not failed
    number = len(course.steps) + 1
    # what a step has set is settled anew with every other one: no finding of its own
    beside.tried = [t for t in beside.tried if t.change.kind != "set" or course.values.keys().isdisjoint(t.values)]
    bench.say(f"step {number}: the best of them on all captures")
    second = search.structured(course.state, search.again(course.state, course.values, beside.tried, faint))
    if not second:
        return False
    worth = search.worth(second)
    bench.say(f"step {number}: settling " + ", ".join(title(t.change) for t in worth))
    refined = []
    for one in worth:
        with search.if_possible(one.change, "settling its numbers"):
            refined.append(refine(bench, course.state, one))
    if not refined:
        raise _NoCandidate({one.change.name for one in worth})
    if not faint:
        search.weigh(course.state, refined)
    judged = {id(one): chance.of_best(bench, course.state, beside.tried, one, not faint) for one in refined}
    if faint:
        for one in refined:
            one.gain = judged[id(one)][0] ** 2
        refined = [one for one in refined if chance.helps(bench, course.state, one)]
        if not refined:
            return False
        best, significance, p = search.least_likely(course.state, refined, lambda t: judged[id(t)])
    else:
        with _needed(course, [one.change for one in refined if one.scatters], "comparing the best"):
            best = search.preferred(refined, lambda t: t.gain)
        significance, p = judged[id(best)]
    # small differences of many pixels, or codes, are no matter of squares: their chance is known by itself
    if p > least or (best.gain < LEAST_GAIN and not faint):
        if faint or not _few(course):
            return False
        course.state = _closer(course)  # something is wrong: too few recordings may be all that hides what it is
        return True
    before, earlier, fell = course.state, course.kept(), course.misfit
    with _needed(course, best.changes, "settling all numbers together"):
        new = accept(course, best, significance)
    if best.maps is None and not best.phases:
        with _or_as_before(course, "looking for what looks alike"):
            unseen = search.scattered(before, course.values, best, faint)
            refined, second = refined + unseen, second + unseen
    new[0].alternatives = _alternatives(search, before, best, refined, second)
    named = {s.change.effect for s in course.steps} | {a["effect"] for a in new[0].alternatives}
    if beside.placebo is None:
        with contextlib.suppress(*UNABLE):  # no answer hangs on it
            beside.placebo = placebo_of(bench, before, beside.tried, best, named)
    if not failed and course.failed and _few(course):
        with _needed(course, best.changes, "a closer look"):
            course.state = _closer(course)  # as close as the model without it was looked at
    if not failed and course.failed:
        course.back_to(earlier)  # nothing was wrong before, now something is
        return False
    # totals are no part of the misfit: where fewer checks fail it is a step, whatever chance makes of the rest
    if len(course.failed) >= max(len(failed), 1) and fell - course.misfit < 0.05 * (fell - 1):
        if course.misfit > fell:
            course.back_to(earlier)
        return False
    return True


def _stands_out(course: Course, tried: Sequence[Tried], trace: float) -> bool:
    """Do the data resemble the trace of any candidate more than chance would have it?

    Where they may, the model is simulated more often, lest too few recordings of it decide.
    """
    p = chance.of_any(course.bench, course.state, tried, course.values, course.search.lines(course.state))
    if p >= min(_MAYBE * trace, 1.0):
        return False
    if _few(course):
        course.state = _closer(course)
        p = chance.of_any(course.bench, course.state, tried, course.values, course.search.lines(course.state))
    return p <= trace


def _few(course: Course) -> bool:
    """Has the model been simulated so seldom that a closer look would tell more?"""
    return len(course.state.own[RATES]) < _CLOSER


def _closer(course: Course) -> State:
    """The model as it is, simulated more often."""
    course.bench.say("a closer look at what may be there")
    return course.bench.state(course.state.values, course.state.sensors, _CLOSER, course.state)


# --- the verdict -------------------------------------------------------------------------------------------------


def _verdict(course: Course, left: Sequence[checks.Block], beside: _Beside) -> str:
    if beside.rival is not None:
        return "confused"
    if left:
        return "partly_explained" if course.steps else "unexplained"
    if course.steps:
        return "explained"
    if beside.bent:
        return "confused"
    return "setup" if beside.setup else "adequate"


def _or_confused(course: Course, beside: _Beside) -> str:
    """The verdict on steps that leave nothing: does something else do as well? Adds what would tell."""
    verdict = "explained"
    near = [(s.change, a["tried"]) for s in course.steps for a in s.alternatives if a.get("confused")]
    if near:
        verdict = "confused"
        with _or_as_before(course, "advice"):
            beside.advice += advice.between(course.search, course.state, *near[-1])
    for step in course.steps:
        unlisted = mimicked(step)
        if unlisted is not None:
            verdict = "confused"
            step.alternatives.insert(0, _outside(unlisted, course.ladder[-1].misfit))
            beside.advice.append(advice.on_mimic(step, unlisted))
    return verdict


def _too_short(short: Mapping[str, tuple[float, float]]) -> list[dict[str, Any]]:
    """Entries of captures that stopped early: (share that was exposed, its standard deviation)."""
    out = []
    for id, (share, error) in short.items():
        told = {"value": plain(share), "low": plain(share - 1.96 * error), "high": plain(share + 1.96 * error)}
        out.append({"capture": id, "quantity": "exposure", "factor": told, "confused": False})
    return out


def _by_setup(course: Course, beside: _Beside) -> bool:
    """Does the set-up explain the totals that fail? Says what of it, and which change of the sensor would as well."""
    bench, state = course.bench, course.state
    likely = setups.explanations(bench, state)
    cost = likely[0].cost if likely else float(state.residuals[RATES] @ state.residuals[RATES])
    others = setups.rivals(course.search, state, cost)
    own = others[0].cost(state) if others else math.inf
    if not likely or own < cost - setups.ALIKE:
        return False  # the sensor explains it better
    near = [e for e in likely if e.cost < cost + setups.ALIKE and len(e.factors) == len(likely[0].factors)]
    found = setups.entries(bench, state, near)
    if not found:
        return False
    if own < cost + setups.ALIKE:
        found = [{**entry, "confused": True} for entry in found]
        beside.rival = others[0]
        with course.search.if_possible(others[0].change, "advice", wholly=False):
            beside.advice += advice.between_totals(course.search, state, likely[0], others[0])
    else:
        beside.advice += advice.on_setup(bench, state, found)
        bright = setups.brightest(bench, likely[0])
        if bright is not None:
            beside.bent = True
            beside.advice.append(advice.on_brightest(bench, state, likely[0], found[0]))
    beside.setup = found + beside.setup
    beside.explained = True
    return True


def _rival_step(course: Course, rival: Tried) -> Step:
    dial = rival.change.strengths[0]
    low, high = rival.intervals.get(dial.key, (None, None))
    value = Value(float(rival.values[dial.key]), low, high, dial.unit)
    left = checks.misfit(course.state.own, rival.residuals or course.state.residuals)
    return Step(rival.change, {dial.parameter: value}, left, math.sqrt(max(rival.gain, 0.0)), "all rates alike")


def _outside(mimic: Mimic, misfit: float) -> dict[str, Any]:
    """What is not in the catalogue, as an alternative."""
    return {"change": "unknown", "effect": None, "parameter": None, "misfit": plain(misfit), "what": mimic.what}


def _alternatives(
    search: Search, state: State, best: Tried, refined: Sequence[Tried], second: Sequence[Tried]
) -> list[dict[str, Any]]:
    """The other candidates, with the misfit that each leaves: first those that would do as well."""
    out: list[dict[str, Any]] = []
    for one in second:
        if one is best or one.change in best.changes or any(o["tried"].change.name == one.change.name for o in out):
            continue
        with search.if_possible(one.change, "comparing it with the best", wholly=False):
            out.append(_alternative(search.bench, state, best, one))
    return sorted(out, key=lambda other: not other["confused"])[:_NAMED]


def _alternative(bench: Bench, state: State, best: Tried, one: Tried) -> dict[str, Any]:
    residuals = one.residuals or bench.residuals(state, one.moved, one.times, noisy=True)
    judged, left = state, residuals
    if one.scatters and one.state is not None:
        judged, left = one.state, one.state.residuals
    failed = checks.failing(checks.blocks(bench, judged, left))
    most, gain = gain_beside(best, one), gain_beside(one, best)
    if one.chips and judged is not state:  # by the law of scatter a few odd pixels may gain little
        gain = max(gain, square(state.residuals) - square(residuals))
    near = most - gain < alike(most) or (at_end(best) and gain > _ALMOST * most)
    return {
        "change": one.change.kind,
        "effect": one.change.effect,
        "parameter": one.change.parameter,
        "misfit": plain(checks.misfit(state.own, residuals)),
        "confused": one.residuals is not None and near and not failed,
        "tried": one,
    }
