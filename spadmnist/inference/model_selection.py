"""Model selection: which physical effect does a model lack? Forward selection, then backward elimination.

Candidates are tried only where a model fails (as `compare` judges): every registered effect that it lacks, every
listed parameter at another value, every map (`candidates`). The best ones of the scan are fitted, and the best of
these is added, until nothing significant is left. While checks fail plainly, the numbers of earlier steps are fitted
roughly; all numbers are fitted together before anything fainter is decided, and at the end. What the set-up explains
is not attributed to the sensor (`setups`).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from .. import golden
from ..errors import UNABLE, InputError, why
from ..measurement import Measurement
from ..sensor import Sensor
from ..workers import Executor, executor
from . import experiment_design, setups, time_blocks, upper_limits
from .budget import ERRORS, FITS, STEPS, Budget, OutOfBudget, clock
from .checks import block_checks, failing
from .comparison import Comparison, comparison_of, comparison_with, nothing_to_compare
from .conclusion import LastLook, Limits, Notes, answer, left_over, outside, rival_step, so_far, too_short, verdict_of
from .elimination import drop_needless, drop_unexplaining, no_step_explains
from .error_budget import Rung
from .evaluation import Evaluation, as_compared, misfit_null_95, with_totals_anew
from .findings import mimicked
from .forward_step import (
    added_from,
    best_added,
    complete,
    has_few_replicates,
    look_closer,
    or_as_before,
    record_end,
)
from .intervals import fit_where_hit, open_ends, scale_errors, sharpen
from .joint_fit import completed, with_own_errors
from .journal import Journal
from .levels import CLEARLY, COST_OF_A_PARAMETER
from .model_path import ModelPath, begin
from .replicates import REPLICATES, TOTALS, Execution, Replicates
from .results import Diagnosis
from .score_test import p_of_any
from .sharper_tests import sharper

MAX_STEPS = 12  # of one diagnosis, by default: the search ends; a rule of thumb
_QUICK = 32  # replicates of each capture in a quick diagnosis: its time against its noise; a rule of thumb
# p-value of a signature that is followed where no check fails. It is below the false-alarm rate of the checks: followed
# up to that one, one of 16 right models was called crosstalk, at 3e-3 with fewer replicates. Else a rule of thumb
_P_SCORE = 4e-3
# times that p-value: worth more replicates, lest a few decide; a rule of thumb
_MAYBE = 100.0
# times that p-value: worth sharper tests, which raise an expected score of 3.2 to 4.5, a p-value 100 times smaller
_NEARLY = 50.0
# the p-value of a signature that is followed after steps that explain all that failed; a rule of thumb
_P_LATER_SCORE = 5e-4


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
        given = sensor, measurement, seed, Execution(workers, say, budget=budget, journal=journal), number
        replicates = Replicates(*given)
        short = setups.stopped_early(replicates)
        if short:
            exposures = {
                id: replicates.seen[id].capture.conditions.exposure * share for id, (share, _) in short.items()
            }
            replicates = Replicates(*given, exposures)
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
    notes = Notes(too_short(short))
    replicates.budget.until = STEPS
    while len(path.steps) < max_steps and not _in_vain(path, notes) and _possible(path, notes):
        if path.steps or notes.explained:
            keep(so_far(path, notes))
    replicates.budget.until, stopped = FITS, len(path.steps) >= max_steps
    if path.steps:
        with or_as_before(path, "the fit of all numbers together"):
            complete(path)
            if is_as_stated(path, notes):
                complete(path)
        if path.evaluation.borrowed:  # the budget has ended it: the steps are still judged by replicates of their own
            replicates.budget.until = math.inf
            with or_as_before(path, "the last comparison"):
                path.evaluation = completed(replicates, path.evaluation)
                path.last_rung()
            replicates.budget.until = FITS
        if not path.approximate:
            with or_as_before(path, "dropping the steps that are no longer needed"):
                drop_needless(path)
        with or_as_before(path, "dropping the steps that explain too little of their own cells"):
            drop_unexplaining(path, path.start, not notes.explained)
        take_setup_again(path, notes)
        if path.approximate:
            replicates.budget.until = ERRORS
            with or_as_before(path, "the errors of all numbers: their intervals may be several times too narrow"):
                with_own_errors(path)
            replicates.budget.until = FITS
    if path.steps and not short and not notes.explained:  # the rates follow from the stated light
        with or_as_before(path, "the fit by likelihood"):
            sharpen(path, replicates.measurement)
    with or_as_before(path, "the fit in the pixels that were hit"):
        fit_where_hit(path)
    with or_as_before(path, "the intervals"):
        scale_errors(path)
    with or_as_before(path, "the intervals"):
        open_ends(path)
    replicates.budget.until = math.inf
    with or_as_before(path, "the last comparison"):
        path.evaluation = completed(replicates, path.evaluation)  # where the budget has ended the fit of all numbers
        if path.steps:
            path.last_rung()
    with or_as_before(path, "the set-up by the last model"):
        _renew_setup(path, notes)
    in_sample = _compared(path, notes)
    verdict = _as_compared(verdict_of(path, left_over(path, notes), notes), notes, in_sample)
    if not path.steps:
        # what a nonlinearity may explain as well is not excused
        path.evaluation = path.start if notes.bent else as_compared(replicates, path.start)
        path.fit, path.values = None, {}
        path.ladder = path.ladder[:1] if verdict != "unexplained" else path.ladder
    rungs = [path.ladder[0], *([notes.placebo] if notes.placebo else []), *path.ladder[1:]]
    null_95 = _measured(path, rungs)
    if verdict in ("explained", "partly_explained"):
        replicates.budget.until = 1.0
        verdict = or_confused(path, notes, verdict)
    if notes.rival is not None:
        path.steps.append(rival_step(path, notes.rival, notes.faulty))
    for step in path.steps:
        for other in step.alternatives:
            other.pop("confused", None)
            other.pop("tried", None)
    limits: Limits = ([], [], [])
    replicates.budget.until = 1.0
    if verdict == "adequate" or (verdict == "explained" and not quick):
        replicates.say("upper limits of the effects that were not found")
        with or_as_before(path, "the upper limits"):
            if notes.looked is not path.evaluation:  # the last step was the last one allowed, or its values have moved
                notes.tried = path.scan.scan(path.evaluation, everywhere=True, known=notes.tried)
            limits = upper_limits.upper_limits(path.scan, path.evaluation, notes.tried, path.fit)
    replicates.budget.until = math.inf
    replicates.unstated = frozenset()  # measurement.yaml is as it was
    last = LastLook(rungs=rungs, null_95=null_95, limits=limits, in_sample=in_sample)
    found = answer(path, notes, verdict, last)
    found.stopped, found.or_setup = stopped and verdict == "partly_explained", notes.rival is not None
    found.shared, found.bent = notes.shared, notes.bent
    found.faulty = notes.faulty if notes.explained else ""
    return found


def _compared(path: ModelPath, notes: Notes) -> Comparison | None:
    """The comparison of the model with its steps, as `compare` compares the next sensor file; None where it cannot be.

    Few replicates fail no model: where they do, it is simulated as often as by `compare`, unless the set-up explains
    what fails.
    """
    replicates = path.replicates
    replicates.say("the comparison of the model with its steps")
    unstated, replicates.unstated = replicates.unstated, frozenset()  # measurement.yaml is as it was
    found: Comparison | None = None
    try:
        with or_as_before(path, "the last comparison"):
            if not path.steps:
                found = comparison_of(replicates, path.start)
                if found.verdict == "fails" and not (path.failed or notes.setup) and has_few_replicates(path):
                    look_closer(path)
                    found = comparison_of(replicates, path.start)
                return found
            found = comparison_with(replicates, path.sensor_values)
            few = found.replicates < REPLICATES
            if found.verdict == "fails" and few and not (path.failed or notes.setup):
                found = comparison_with(replicates, path.sensor_values, REPLICATES)
    finally:
        replicates.unstated = unstated
    return found


def _as_compared(verdict: str, notes: Notes, in_sample: Comparison | None) -> str:
    """The verdict, where `compare` finds the model wrong of which no check is left here: its file has other pixels."""
    if in_sample is None or in_sample.verdict == "adequate" or notes.setup:
        return verdict
    return {"adequate": "unexplained", "explained": "partly_explained"}.get(verdict, verdict)


def _measured(path: ModelPath, rungs: Sequence[Rung]) -> float:
    """As `time_blocks.measure`; where halves cannot be simulated, all rows are judged by whole captures."""
    before = [(rung, rung.left, rung.misfit) for rung in rungs]
    with or_as_before(path, "the last comparison"):
        return time_blocks.measure(path.replicates, rungs)
    for rung, left, misfit in before:
        rung.left, rung.misfit = left, misfit
        for step in rung.steps:
            step.misfit = misfit
    return misfit_null_95(rungs[0].evaluation.replicate_residuals)


def _in_vain(path: ModelPath, notes: Notes) -> bool:
    """As `no_step_explains`, by the fit of all numbers."""
    if not no_step_explains(path, not notes.explained):
        return False
    with or_as_before(path, "the fit of all numbers together"):
        complete(path)
    return no_step_explains(path, not notes.explained)


def _possible(path: ModelPath, notes: Notes) -> bool:
    """As `another_step`; False where the steps so far cannot be simulated often enough."""
    before = path.kept()
    try:
        return another_step(path, notes)
    except OutOfBudget:
        path.back_to(before)
        record_end(path, f"step {len(path.steps) + 1}")
        return False
    except UNABLE as error:
        if not path.steps:
            raise
        path.back_to(before)
        last = path.steps[-1].candidate
        path.scan.not_tried(last.kind, last.effect, last.parameter, "another step", why(error))
        return False


def another_step(path: ModelPath, notes: Notes) -> bool:
    """Whether a step was added, or the model was simulated more often, so that another step may follow."""
    replicates, scan = path.replicates, path.scan
    if all(block.p > CLEARLY for block in path.failed) or scan.only_rates(path.evaluation):
        complete(path)  # what no check shows plainly, and what the set-up may explain, is decided by the whole fit
    if is_as_stated(path, notes):
        complete(path)
    failed, number = path.failed, len(path.steps) + 1
    waiting, notes.waiting = notes.waiting, []
    plainly = any(block.p <= CLEARLY for block in failed) and not scan.only_rates(path.evaluation)
    if waiting and plainly and added_from(path, notes, failed, waiting):
        return True
    if failed and not path.steps and min(b.p for b in failed) > CLEARLY and has_few_replicates(path):
        look_closer(path)  # lest the scatter of few replicates decide
        failed = path.failed
    if not failed:
        # no check fails: a score test along each signature
        replicates.say(f"step {number}: no check fails; a score test of every candidate")
        notes.tried = scan.scan(path.evaluation, everywhere=True, known=notes.tried)
        before = notes.looked = path.evaluation
        largest_p = _P_LATER_SCORE if path.steps else _P_SCORE
        if stands_out(path, notes, largest_p):
            closer = path.evaluation
            if closer is not before:  # more replicates may show lines that few did not
                sharp = [one for one in notes.tried if one.sharp]
                rest = [one for one in notes.tried if not one.sharp]
                notes.tried = scan.scan(closer, everywhere=True, known=rest) + sharp
            if best_added(path, notes, failed, largest_p):
                return True
            if path.evaluation is not closer:
                return False
        return path.evaluation is not before and bool(path.failed)  # by more replicates: the next turn has it
    asked = notes.explained or notes.taken_back is not None
    if not asked and scan.only_rates(path.evaluation) and explained_by_setup(path, notes):
        return is_freed(path, notes)
    clearest = dict.fromkeys(f"{b.shown[1]} of {b.shown[0]}" if b.shown[0] else "the rates" for b in failed)
    first = ", ".join(list(clearest)[:4])
    replicates.say(f"step {number}: {len(failed)} checks fail ({first}); trying every candidate")
    notes.tried = scan.scan(path.evaluation, known=notes.tried)
    steps = len(path.steps)
    # where nothing explains what a rough fit leaves, the whole fit may leave something else
    return best_added(path, notes, failed) or (len(path.steps) == steps and complete(path))


def stands_out(path: ModelPath, notes: Notes, largest_p: float) -> bool:
    """Whether the score of any candidate is significant.

    Where it may be, the model is simulated more often, so that a few replicates do not decide; and the most significant
    candidates are, so that the noise of their templates does not.

    Args:
        notes: its trials are completed by sharper ones.
        largest_p: the largest p-value that is followed.
    """

    def p_now() -> float:
        lines = path.scan.lines(path.evaluation)
        return p_of_any(path.replicates, path.evaluation, notes.tried, path.values, lines)

    p = p_now()
    if p >= min(_MAYBE * largest_p, 1.0):
        return False
    if has_few_replicates(path):
        look_closer(path)
        p = p_now()
    if largest_p < p < _NEARLY * largest_p:
        path.replicates.say("more replicates of the candidates with the best scores")
        with contextlib.suppress(OutOfBudget):  # without them nothing stands out
            notes.tried = notes.tried + sharper(path.scan, path.evaluation, notes.tried)
            p = p_now()
    return p <= largest_p


def or_confused(path: ModelPath, notes: Notes, verdict: str) -> str:
    """The verdict on steps, "confused" where they leave nothing and something else is a tie.

    The mimics of steps, which no effect describes, stand under their alternatives in any case. The advice is added.

    Args:
        verdict: "explained" or "partly_explained".
    """
    whole = verdict == "explained"
    near = [(s.candidate, a["tried"]) for s in path.steps for a in s.alternatives if whole and a.get("confused")]
    if near:
        verdict = "confused"
        with or_as_before(path, "advice"):
            known, other = near[-1]
            if path.located and other.sensors is not None:  # it was tried with the pixels of other chips
                other = replace(other, sensors=other.sensors.changed(path.where(path.values)))
            notes.advice += experiment_design.between(path.scan, path.evaluation, known, other)
    for step in path.steps:
        unlisted = mimicked(step, [seen.capture for seen in path.replicates.seen.values()])
        if unlisted is not None:
            verdict = "confused" if whole else verdict
            step.alternatives.insert(0, outside(unlisted, path.ladder[-1].misfit))
            notes.advice.append(experiment_design.on_mimic(step, unlisted))
    return verdict


def explained_by_setup(path: ModelPath, notes: Notes) -> bool:
    """Whether the set-up explains the totals that fail; adds its entries, a rival of the sensor, and the advice."""
    replicates, evaluation = path.replicates, path.evaluation
    likely = setups.explanations(replicates, evaluation)
    cost = likely[0].cost if likely else float(evaluation.residuals[TOTALS] @ evaluation.residuals[TOTALS])
    others = setups.rivals(path.scan, evaluation, cost)
    own = others[0].cost(evaluation) if others else math.inf
    contested = likely[:1]
    shared: tuple[str, ...] = ()
    if likely and not others:
        with contextlib.suppress(OutOfBudget):  # the set-up explains the totals
            for rival, factor in setups.rivals_with_a_factor(path.scan, evaluation, likely[0])[:1]:
                others, shared = [rival], factor.captures
                own = max(
                    rival.cost(evaluation) + COST_OF_A_PARAMETER * len(shared), cost - setups.TIE
                )  # a tie at best
                contested = [likely[0].without(factor)]
    if not likely or own < cost - setups.TIE:
        return False  # the sensor explains it better
    near = [e for e in likely if e.cost < cost + setups.TIE and len(e.factors) == len(likely[0].factors)]
    found = setups.entries(replicates, evaluation, near)
    if not found:
        return False
    notes.faulty = setups.captures_of(likely[:1] if shared else near)
    if own < cost + setups.TIE:
        found = [{**entry, "confused": entry["confused"] or entry["capture"] not in shared} for entry in found]
        notes.rival, notes.shared = others[0], shared
        with path.scan.if_possible(others[0].candidate, "advice", wholly=False):
            notes.advice += experiment_design.between_totals(path.scan, evaluation, contested[0], others[0])
    else:
        notes.advice += experiment_design.on_setup(replicates, evaluation, found)
        bright = setups.brightest(replicates, likely[0])
        if bright is not None:
            notes.bent = True
            notes.advice.append(experiment_design.on_brightest(replicates, evaluation, likely[0], found[0]))
    notes.setup, notes.by_totals = found + notes.setup, found
    notes.explained = True
    return True


def is_freed(path: ModelPath, notes: Notes) -> bool:
    """Whether the levels that the set-up explains are free now, for a score test of what other statistics show.

    They stay where a change of the sensor is a tie. Steps are fitted anew, without these totals.
    """
    if notes.rival is not None:
        return False
    path.replicates.unstated = frozenset(entry["capture"] for entry in notes.by_totals)
    path.evaluation = with_totals_anew(path.replicates, path.evaluation)
    if path.fit is not None:
        path.approximate = True
        complete(path)
    return True


def is_as_stated(path: ModelPath, notes: Notes) -> bool:
    """Whether the steps explain the totals of freed levels, so that the set-up need not; its entries are then removed.

    Light that fluctuates slowly gives a capture another total, and so may another light level.
    """
    replicates, free = path.replicates, path.replicates.unstated
    if not free or not path.steps:
        return False
    explained = False
    replicates.unstated = frozenset()
    try:
        stated = with_totals_anew(replicates, path.evaluation)
        explained = not _totals_fail(replicates, stated)
    finally:
        replicates.unstated = frozenset() if explained else free
    if explained:
        path.evaluation = stated
        path.approximate = path.approximate or path.fit is not None  # the totals are no part of its fit
        notes.taken_back = notes.bent, notes.advice
        notes.setup = [entry for entry in notes.setup if all(entry is not one for one in notes.by_totals)]
        notes.explained, notes.bent, notes.advice = False, False, []
    return explained


def take_setup_again(path: ModelPath, notes: Notes) -> None:
    """Put the entries of the set-up back where the step that explained the totals was dropped."""
    if notes.taken_back is None or notes.explained:
        return
    if path.replicates.unstated:  # the budget has ended what followed
        path.replicates.unstated = frozenset()
        path.evaluation = with_totals_anew(path.replicates, path.evaluation)
    if _totals_fail(path.replicates, path.evaluation):
        notes.setup, notes.explained = notes.by_totals + notes.setup, True
        notes.bent, notes.advice = notes.taken_back


def _renew_setup(path: ModelPath, notes: Notes) -> None:
    """Write the entries of the set-up by the model with its steps, under which the totals may scatter more."""
    replicates, free = path.replicates, path.replicates.unstated
    if not path.steps or not free:
        return
    replicates.unstated = frozenset()
    try:
        stated = with_totals_anew(replicates, path.evaluation)
        likely = setups.explanations(replicates, stated)
        near = [e for e in likely if e.cost < likely[0].cost + setups.TIE and len(e.factors) == len(likely[0].factors)]
        if found := setups.entries(replicates, stated, near):
            others = [entry for entry in notes.setup if all(entry is not one for one in notes.by_totals)]
            notes.setup, notes.by_totals, notes.faulty = found + others, found, setups.captures_of(near)
    finally:
        replicates.unstated = free


def _totals_fail(replicates: Replicates, evaluation: Evaluation) -> bool:
    failed = failing(block_checks(replicates, evaluation, evaluation.residuals))
    return any(block.cell[0] == "" for block in failed)
