"""Model selection: which physical effect does a model lack? Forward selection, then backward elimination.

Candidates are tried only where a model fails (as `compare` judges): every registered effect that it lacks, every
listed parameter at another value, every map (`candidates`). The best ones of the scan are fitted, the best of these
is added, and everything is fitted anew, until nothing significant is left. What the set-up explains is not attributed
to the sensor (`setups`).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from .. import golden
from ..errors import UNABLE, InputError, why
from ..measurement import Measurement
from ..sensor import Sensor
from ..workers import Executor, executor
from . import experiment_design, setups, time_blocks, upper_limits
from .alternatives import alternatives
from .budget import FITS, STEPS, Budget, OutOfBudget, clock
from .candidates import Candidate
from .comparison import Comparison, comparison_of, comparison_with, nothing_to_compare
from .conclusion import Limits, Notes, answer, left_over, not_done, outside, rival_step, so_far, too_short, verdict_of
from .elimination import drop_needless, drop_unexplaining, left_in_own_cells, no_step_explains
from .error_budget import Rung, placebo_of
from .evaluation import BlockCheck, Evaluation, evaluate, misfit_null_95
from .evidence import best_of, competing, evidence_of, judge_maps_by_odd_pixels, leads, worth_fitting
from .findings import mimicked
from .intervals import fit_where_hit, open_ends, scale_errors, sharpen
from .joint_fit import complete_fit, completed
from .journal import Journal
from .levels import FALSE_ALARM, LEAST_EVIDENCE
from .map_trials import patterns_first, random_map_trials
from .model_path import ModelPath, accept, begin
from .replicates import REPLICATES, TOTALS, Replicates
from .results import Diagnosis, title
from .score_test import explains_its_signature, p_of_any, p_of_best
from .trial import Trial, is_pattern, tie
from .trial_fits import fit_trial

MAX_STEPS = 12  # of one diagnosis, by default
_QUICK = 32  # replicates of each capture in a quick diagnosis
# p-value of a signature that is followed where no check fails. It is below the false-alarm rate of the checks; at 3e-3
# with fewer replicates one of 16 right models was called crosstalk
_P_SCORE = 4e-3
_MAYBE, _CLOSER = 100.0, REPLICATES  # times that p-value: worth more replicates; their number
_PLAIN = 1e-6  # p-value of a check that needs no closer look
_P_LATER_SCORE = 5e-4  # the p-value of a signature that is followed after steps that explain all that failed


def diagnose(
    sensor: Sensor,
    measurement: Measurement,
    seed: int = 0,
    max_steps: int = MAX_STEPS,
    quick: bool = False,
    jobs: int | Executor = 2,
    progress: Callable[[str], None] | None = None,
    within: float = math.inf,
    keep: Callable[[Diagnosis], None] | None = None,
    journal: Journal | None = None,
) -> Diagnosis:
    """The diagnosis of a model: the effects, values and maps that it lacks, added one by one.

    Args:
        sensor: the model.
        seed: of the replicates.
        max_steps: the largest number of steps.
        quick: fewer replicates.
        jobs: number of workers of this machine, or an executor.
        progress: called with a line about what is being done.
        within: the budget of the search, s of two idle cores, see `budget`.
        keep: called with the diagnosis so far after each step; its verdict and misfits are those of that moment.
        journal: of an earlier search that was stopped; it goes on from there.
    Raises:
        InputError: where sensor and measurement do not belong together.
    """
    report, budget = progress or (lambda what: None), Budget(within)

    def say(what: str) -> None:
        left = budget.left
        report(what if budget.spent == 0 or left in (0, math.inf) else f"{what} (at most {clock(left)} of steps left)")

    with executor(jobs) as workers:
        workers.greet(golden.answer, None)
        number = _QUICK if quick else REPLICATES
        given = sensor, measurement, seed, workers, number, say
        replicates = Replicates(*given, budget=budget, journal=journal)
        short = setups.stopped_early(replicates)
        if short:
            exposures = {
                id: replicates.seen[id].capture.conditions.exposure * share for id, (share, _) in short.items()
            }
            replicates = Replicates(*given, exposures, budget=budget, journal=journal)
        return _diagnosed(replicates, max_steps, quick, short, keep or (lambda found: None))


def _diagnosed(
    replicates: Replicates,
    max_steps: int,
    quick: bool,
    short: Mapping[str, tuple[float, float]],
    keep: Callable[[Diagnosis], None],
) -> Diagnosis:
    path = begin(replicates)
    if not any(z.size for z in path.evaluation.residuals.values()):
        raise InputError(nothing_to_compare(replicates))
    start, notes = path.evaluation, Notes(too_short(short))
    replicates.budget.until = STEPS
    while len(path.steps) < max_steps and not no_step_explains(path, not notes.explained) and _possible(path, notes):
        if path.steps:
            keep(so_far(path, start, notes))
    replicates.budget.until = FITS
    if path.steps:
        with _or_as_before(path, "the fit of all numbers together"):
            complete_fit(path)
        with _or_as_before(path, "dropping the steps that are no longer needed"):
            drop_needless(path)
        with _or_as_before(path, "dropping the steps that explain too little of their own cells"):
            drop_unexplaining(path, start, not notes.explained)
    if path.steps and not short:
        with _or_as_before(path, "the fit by likelihood"):
            sharpen(path, replicates.measurement)
    with _or_as_before(path, "the fit in the pixels that were hit"):
        fit_where_hit(path)
    with _or_as_before(path, "the intervals"):
        scale_errors(path)
    with _or_as_before(path, "the intervals"):
        open_ends(path)
    replicates.budget.until = math.inf
    with _or_as_before(path, "the last comparison"):
        path.evaluation = completed(replicates, path.evaluation)  # where the budget has ended the fit of all numbers
        if path.steps:
            path.last_rung()
    verdict = verdict_of(path, left_over(path, notes), notes)
    if not path.steps:
        path.evaluation, path.fit, path.values = start, None, {}
        path.ladder = path.ladder[:1] if verdict != "unexplained" else path.ladder
    rungs = [path.ladder[0], *([notes.placebo] if notes.placebo else []), *path.ladder[1:]]
    null_95 = _measured(path, rungs)
    if verdict == "explained":
        replicates.budget.until = 1.0
        verdict = _or_confused(path, notes)
    if notes.rival is not None:
        path.steps.append(rival_step(path, notes.rival))
    for step in path.steps:
        for other in step.alternatives:
            other.pop("confused", None)
            other.pop("tried", None)
    limits: Limits = ([], [], [])
    replicates.budget.until = 1.0
    if verdict == "adequate" or (verdict == "explained" and not quick):
        replicates.say("upper limits of the effects that were not found")
        with _or_as_before(path, "the upper limits"):
            if notes.looked is not path.evaluation:  # the last step was the last one allowed, or its values have moved
                notes.tried = path.scan.scan(path.evaluation, everywhere=True, known=notes.tried)
            limits = upper_limits.upper_limits(path.scan, path.evaluation, notes.tried)
    replicates.budget.until = math.inf
    in_sample: Comparison | None = None
    with _or_as_before(path, "the last comparison"):
        replicates.say("the comparison of the model with its steps")
        own = None if path.steps else path.evaluation
        in_sample = (
            comparison_of(replicates, own) if own else comparison_with(replicates, path.sensor_values, path.scan.phases)
        )
    return answer(path, start, notes, verdict, rungs, null_95, limits, in_sample)


@contextlib.contextmanager
def _or_as_before(path: ModelPath, where: str) -> Iterator[None]:
    """A context that restores the steps where a model in it cannot be simulated, or the budget is spent."""
    before = path.kept()
    try:
        yield
    except OutOfBudget:
        path.back_to(before)
        _end(path, where)
    except UNABLE as error:
        path.back_to(before)
        for candidate in [step.candidate for step in path.steps[-1:]]:
            path.scan.not_tried(candidate.kind, candidate.effect, candidate.parameter, where, why(error))


def _end(path: ModelPath, where: str) -> None:
    """Record what the budget has ended."""
    path.finished = False
    path.scan.untried.append(not_done(where, "the budget of work was spent; give a longer --within, or none"))


def _measured(path: ModelPath, rungs: Sequence[Rung]) -> float:
    """As `time_blocks.measure`; where halves cannot be simulated, all rows are judged by whole captures."""
    before = [(rung, rung.left, rung.misfit) for rung in rungs]
    with _or_as_before(path, "the last comparison"):
        return time_blocks.measure(path.replicates, rungs)
    for rung, left, misfit in before:
        rung.left, rung.misfit = left, misfit
        for step in rung.steps:
            step.misfit = misfit
    return misfit_null_95(rungs[0].evaluation.replicate_residuals)


def _possible(path: ModelPath, notes: Notes) -> bool:
    """As `_another`; False where the steps so far cannot be simulated often enough."""
    before = path.kept()
    try:
        return _another(path, notes)
    except OutOfBudget:
        path.back_to(before)
        _end(path, f"step {len(path.steps) + 1}")
        return False
    except UNABLE as error:
        if not path.steps:
            raise
        path.back_to(before)
        last = path.steps[-1].candidate
        path.scan.not_tried(last.kind, last.effect, last.parameter, "another step", why(error))
        return False


def _another(path: ModelPath, notes: Notes) -> bool:
    """Whether a step was added, or the model was simulated more often, so that another step may follow."""
    replicates, scan = path.replicates, path.scan
    if all(block.p > _PLAIN for block in path.failed):
        complete_fit(path)  # what no check shows plainly is decided by the fit of all numbers
    failed, number = path.failed, len(path.steps) + 1
    if failed and not path.steps and min(b.p for b in failed) > _PLAIN and _few(path):
        path.evaluation = _closer(path)  # lest the scatter of few replicates decide
        failed = path.failed
    if not failed:
        # no check fails: a score test along each signature
        replicates.say(f"step {number}: no check fails; a score test of every candidate")
        notes.tried = scan.scan(path.evaluation, everywhere=True, known=notes.tried)
        before = notes.looked = path.evaluation
        largest_p = _P_LATER_SCORE if path.steps else _P_SCORE
        if _stands_out(path, notes.tried, largest_p):
            closer = path.evaluation
            if closer is not before:  # more replicates may show lines that few did not
                notes.tried = scan.scan(closer, everywhere=True, known=notes.tried)
            if _added(path, notes, failed, largest_p):
                return True
            if path.evaluation is not closer:
                return False
        path.evaluation = before  # under this evaluation no check fails: nothing is left
        return False
    if scan.only_rates(path.evaluation) and _by_setup(path, notes):
        return False
    clearest = dict.fromkeys(f"{b.cell[1]} of {b.cell[0]}" if b.cell[0] else "the rates" for b in failed)
    first = ", ".join(list(clearest)[:4])
    replicates.say(f"step {number}: {len(failed)} checks fail ({first}); trying every candidate")
    notes.tried = scan.scan(path.evaluation, known=notes.tried)
    return _added(path, notes, failed)


class _NoCandidate(Exception):
    """The best candidate cannot be simulated, so that it is excluded."""


def _added(path: ModelPath, notes: Notes, failed: Sequence[BlockCheck], least: float = FALSE_ALARM) -> bool:
    """Whether the best candidate was added, or another attempt is worth it.

    A candidate that cannot be simulated makes room for the next best.

    Args:
        failed: the checks that fail.
        least: the largest p-value of a step.
    """
    while True:
        before = path.kept()
        try:
            return _best_added(path, notes, failed, least)
        except _NoCandidate as none:
            names = none.args[0]
        except UNABLE as error:  # not attributable to one candidate: the one with the largest fall is excluded
            most = max(notes.tried, key=lambda t: t.fall, default=None)
            if most is None:
                raise
            path.scan.exclude(most.candidate, "choosing the best", why(error))
            names = {most.candidate.name}
        path.back_to(before)
        notes.tried = [t for t in notes.tried if t.candidate.name not in names]


@contextlib.contextmanager
def _needed(path: ModelPath, candidates: Sequence[Candidate], where: str) -> Iterator[None]:
    """A context without which candidates are excluded.

    Raises:
        _NoCandidate: where they cannot be simulated.
    """
    try:
        yield
    except UNABLE as error:
        for candidate in candidates:
            path.scan.exclude(candidate, where, why(error))
        raise _NoCandidate({candidate.name for candidate in candidates}) from error


def _best_added(path: ModelPath, notes: Notes, failed: Sequence[BlockCheck], least: float) -> bool:
    replicates, scan, faint = path.replicates, path.scan, not failed
    # a value that a step has set is fitted anew with every other one: it is no finding of its own
    notes.tried = [t for t in notes.tried if t.candidate.kind != "set" or path.values.keys().isdisjoint(t.values)]
    replicates.say(f"step {len(path.steps) + 1}: the best of them on all captures")
    second = patterns_first(scan, path.evaluation, scan.again(path.evaluation, path.values, notes.tried, faint))
    if not second:
        return False
    worth = worth_fitting(second, faint)
    groups = [worth] if faint else competing(replicates, path.evaluation, worth)
    fitted: list[Trial] = []
    doubtful: tuple[Any, ...] | None = None  # the path with a step that helps too little to go on from
    refused = False
    for k, group in enumerate(groups):
        fitted += _fitted(path, group, faint)
        found = _best_of(path, notes, second, fitted, faint)
        if found is None:
            continue
        best, significance, p = found
        # squares do not show small differences of many pixels or codes: their p-value is that of a test of their own
        if p > least or (best.evidence < LEAST_EVIDENCE and not faint) or not leads(best, groups[k + 1 :]):
            continue
        earlier = path.kept()
        if _taken(path, notes, failed, second, best, significance):
            return True
        refused = True
        fitted = [one for one in fitted if one is not best]
        if len(path.steps) > len(earlier[2]):
            doubtful = doubtful or path.kept()
            path.back_to(earlier)
    if not fitted and not refused:
        raise _NoCandidate({one.candidate.name for one in worth})
    if doubtful is not None:
        path.back_to(doubtful)
    elif not (faint or refused) and _few(path):
        path.evaluation = _closer(path)  # something is wrong: too few replicates may be what hides it
        return True
    return False


def _fitted(path: ModelPath, worth: Sequence[Trial], faint: bool) -> list[Trial]:
    """The trials with their coordinates fitted and their evidence, without those that cannot be simulated."""
    path.replicates.say(f"step {len(path.steps) + 1}: fitting " + ", ".join(title(t.candidate) for t in worth))
    fitted = []
    for one in worth:
        with path.scan.if_possible(one.candidate, "fitting its numbers"):
            one = fit_trial(path.replicates, path.evaluation, one)
            if not faint:
                one.evidence = evidence_of(path.replicates, path.evaluation, one)
            fitted.append(one)
    return fitted


def _best_of(
    path: ModelPath, notes: Notes, second: Sequence[Trial], fitted: Sequence[Trial], faint: bool
) -> tuple[Trial, float, float] | None:
    """(best of the fitted trials, its significance, its p-value); None where there is none."""
    replicates = path.replicates
    judged = {id(one): p_of_best(replicates, path.evaluation, notes.tried, one, not faint) for one in fitted}
    if faint:
        judge_maps_by_odd_pixels(replicates, path.evaluation, fitted, judged)
        for one in fitted:
            one.evidence = judged[id(one)][0] ** 2
        fitted = [one for one in fitted if explains_its_signature(replicates, path.evaluation, one)]
    if not fitted:
        return None
    pattern = second[0] if is_pattern(second[0]) and (faint or second[0].evidence >= LEAST_EVIDENCE) else None
    if faint:
        best = best_of(fitted, lambda t: -judged[id(t)][1], pattern)
    else:
        best = best_of(fitted, lambda t: t.evidence, pattern, tie)
    return best, *judged[id(best)]


def _taken(
    path: ModelPath,
    notes: Notes,
    failed: Sequence[BlockCheck],
    second: list[Trial],
    best: Trial,
    significance: float,
) -> bool:
    """Whether the model with the best trial is better, so that the search goes on from there.

    The path is as it was where the model is worse. A step that helps too little to go on from stays in it.
    """
    scan, faint = path.scan, not failed
    before, earlier, fell = path.evaluation, path.kept(), path.misfit
    with _needed(path, best.candidates, "fitting all numbers together"):
        new = accept(path, best, significance)
    if best.maps is None and not best.phases:
        with _or_as_before(path, "trying random maps with the same signature"):
            random_maps = random_map_trials(scan, before, path.values, best, faint)
            second = second + random_maps
    new[0].alternatives = alternatives(scan, before, best, second)
    named = {s.candidate.effect for s in path.steps} | {a["effect"] for a in new[0].alternatives}
    if notes.placebo is None:
        with contextlib.suppress(*UNABLE):  # no result depends on it
            notes.placebo = placebo_of(path.replicates, before, notes.tried, best, named)
    if not failed and path.failed and _few(path):
        with _needed(path, best.candidates, "a closer look"):
            path.evaluation = _closer(path)  # with as many replicates as the model without the step
    if not failed and path.failed:
        path.back_to(earlier)  # no check failed before, now one does
        return False
    # the totals are no part of the misfit: with fewer failing checks it is a step, whatever noise does to the rest
    explains = all(left_in_own_cells(step, path.held_out, not notes.explained) < 1 for step in new)
    if not explains and len(path.failed) >= max(len(failed), 1) and fell - path.misfit < 0.05 * (fell - 1):
        if path.misfit > fell:
            path.back_to(earlier)
        return False
    return True


def _stands_out(path: ModelPath, tried: Sequence[Trial], largest_p: float) -> bool:
    """Whether the score of any candidate is significant.

    Where it may be, the model is simulated more often, so that a few replicates do not decide.

    Args:
        largest_p: the largest p-value that is followed.
    """
    p = p_of_any(path.replicates, path.evaluation, tried, path.values, path.scan.lines(path.evaluation))
    if p >= min(_MAYBE * largest_p, 1.0):
        return False
    if _few(path):
        path.evaluation = _closer(path)
        p = p_of_any(path.replicates, path.evaluation, tried, path.values, path.scan.lines(path.evaluation))
    return p <= largest_p


def _few(path: ModelPath) -> bool:
    """Whether the model has fewer replicates than a closer look."""
    return len(path.evaluation.replicate_residuals[TOTALS]) < _CLOSER


def _closer(path: ModelPath) -> Evaluation:
    """The evaluation of the model with more replicates."""
    path.replicates.say(f"more replicates of the model: {_CLOSER} of each capture")
    return evaluate(path.replicates, path.evaluation.values, path.evaluation.sensors, _CLOSER, path.evaluation)


def _or_confused(path: ModelPath, notes: Notes) -> str:
    """The verdict on steps that leave nothing: "explained", or "confused" where something else is a tie.

    The advice is added.
    """
    verdict = "explained"
    near = [(s.candidate, a["tried"]) for s in path.steps for a in s.alternatives if a.get("confused")]
    if near:
        verdict = "confused"
        with _or_as_before(path, "advice"):
            known, other = near[-1]
            if path.located and other.sensors is not None:  # it was tried with the pixels of other chips
                other = replace(other, sensors=other.sensors.changed(path.where(path.values)))
            notes.advice += experiment_design.between(path.scan, path.evaluation, known, other)
    for step in path.steps:
        unlisted = mimicked(step)
        if unlisted is not None:
            verdict = "confused"
            step.alternatives.insert(0, outside(unlisted, path.ladder[-1].misfit))
            notes.advice.append(experiment_design.on_mimic(step, unlisted))
    return verdict


def _by_setup(path: ModelPath, notes: Notes) -> bool:
    """Whether the set-up explains the totals that fail; adds its entries, a rival of the sensor, and the advice."""
    replicates, evaluation = path.replicates, path.evaluation
    likely = setups.explanations(replicates, evaluation)
    cost = likely[0].cost if likely else float(evaluation.residuals[TOTALS] @ evaluation.residuals[TOTALS])
    others = setups.rivals(path.scan, evaluation, cost)
    own = others[0].cost(evaluation) if others else math.inf
    if not likely or own < cost - setups.TIE:
        return False  # the sensor explains it better
    near = [e for e in likely if e.cost < cost + setups.TIE and len(e.factors) == len(likely[0].factors)]
    found = setups.entries(replicates, evaluation, near)
    if not found:
        return False
    if own < cost + setups.TIE:
        found = [{**entry, "confused": True} for entry in found]
        notes.rival = others[0]
        with path.scan.if_possible(others[0].candidate, "advice", wholly=False):
            notes.advice += experiment_design.between_totals(path.scan, evaluation, likely[0], others[0])
    else:
        notes.advice += experiment_design.on_setup(replicates, evaluation, found)
        bright = setups.brightest(replicates, likely[0])
        if bright is not None:
            notes.bent = True
            notes.advice.append(experiment_design.on_brightest(replicates, evaluation, likely[0], found[0]))
    notes.setup = found + notes.setup
    notes.explained = True
    return True
