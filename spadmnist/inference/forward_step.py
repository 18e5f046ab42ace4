"""A step of the forward selection: the best trial of a scan is fitted, and added where the model is better with it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from ..errors import UNABLE, SpadError, why
from .alternatives import alternatives
from .budget import OutOfBudget
from .candidates import Candidate
from .checks import BlockCheck
from .conclusion import Notes, not_done
from .elimination import left_by
from .error_budget import placebo_of
from .evaluation import evaluate
from .evidence import NEAR, apart_from, best_of, competing, evidence_of, judge_maps_by_odd_pixels, leads, worth_fitting
from .joint_fit import complete_fit
from .levels import FALSE_ALARM, LEAST_EVIDENCE, PROMISING
from .map_trials import patterns_first, random_map_trials
from .model_path import ModelPath, accept
from .replicates import REPLICATES, TOTALS
from .results import title
from .score_test import explains_its_signature, p_of_best
from .trial import Trial, is_pattern, tie
from .trial_fits import fit_trial
from .whole_numbers import refit_whole_numbers

CLOSER = REPLICATES  # replicates of each capture for a closer look: as many as without `quick`
# of the excess misfit: a step that leaves as many failing checks, and does not explain its own cells, falls short
# below, and the search does not go on from it; a rule of thumb
_LEAST_FALL_OF_MISFIT = 0.05


@contextlib.contextmanager
def or_as_before(path: ModelPath, where: str) -> Iterator[None]:
    """A context that restores the steps where a model in it cannot be simulated, or the budget is spent."""
    before = path.kept()
    try:
        yield
    except OutOfBudget:
        path.back_to(before)
        record_end(path, where)
    except UNABLE as error:
        path.back_to(before)
        for candidate in [step.candidate for step in path.steps[-1:]]:
            path.scan.not_tried(candidate.kind, candidate.effect, candidate.parameter, where, why(error))


def record_end(path: ModelPath, where: str) -> None:
    """Record what the budget has ended."""
    path.finished = False
    path.scan.untried.append(not_done(where, "the budget of work was spent; give a longer --within, or none"))


class _NoCandidate(Exception):
    """Candidates cannot be simulated.

    Args:
        candidates: are to be excluded from the model that they were added to.
        where, why: as in `Scan.exclude`.
    """

    def __init__(self, candidates: Sequence[Candidate], where: str = "", why: str = ""):
        super().__init__(why)
        self.candidates, self.where, self.why = tuple(candidates), where, why

    def exclude_from(self, path: ModelPath, before: Any) -> None:
        """Restore the path as it was before the candidates were steps, and exclude them from that model."""
        path.back_to(before)
        for candidate in self.candidates if self.where else ():
            path.scan.exclude(candidate, self.where, self.why)


def best_added(path: ModelPath, notes: Notes, failed: Sequence[BlockCheck], least: float = FALSE_ALARM) -> bool:
    """Whether the best candidate was added, or another attempt is worth it.

    A candidate that cannot be simulated makes room for the next best.

    Args:
        failed: the checks that fail.
        least: the largest p-value of a step.
    """
    while True:
        before = path.kept()
        try:
            return best_of_scan_added(path, notes, failed, least)
        except _NoCandidate as one:
            none = one
        except UNABLE as error:  # not attributable to one candidate: the one with the largest fall is excluded
            most = max(notes.tried, key=lambda t: t.fall, default=None)
            if most is None:
                raise
            none = _NoCandidate([most.candidate], "choosing the best", why(error))
        none.exclude_from(path, before)
        names = {candidate.name for candidate in none.candidates}
        notes.tried = [t for t in notes.tried if t.candidate.name not in names]


@contextlib.contextmanager
def _needed(candidates: Sequence[Candidate], where: str) -> Iterator[None]:
    """A context without which candidates are to be excluded.

    Raises:
        _NoCandidate: where they cannot be simulated.
    """
    try:
        yield
    except UNABLE as error:
        raise _NoCandidate(candidates, where, why(error)) from error


def best_of_scan_added(path: ModelPath, notes: Notes, failed: Sequence[BlockCheck], least: float) -> bool:
    """Whether the best of the scan was added to the path.

    Args:
        failed: the checks that fail; without any, the scores alone are judged.
        least: the largest p-value of a step.
    """
    replicates, scan, faint = path.replicates, path.scan, not failed
    notes.waiting = []
    # a value that a step has set is fitted anew with every other one: it is no finding of its own
    notes.tried = [t for t in notes.tried if t.candidate.kind != "set" or not _is_set(path, t)]
    replicates.say(f"step {len(path.steps) + 1}: the best of them on all captures")
    second = patterns_first(scan, path.evaluation, scan.again(path.evaluation, path.values, notes.tried, faint))
    notes.second = [replace(one, intervals=dict(one.intervals)) for one in second]  # a fit writes into a trial
    if not second:
        return False
    worth = worth_fitting(second, faint)
    seen, groups = list(worth), [worth] if faint else competing(replicates, path.evaluation, worth)
    fitted: list[Trial] = []
    doubtful: tuple[Any, ...] | None = None  # the path with a step that helps too little to go on from
    refused, able, k = False, False, -1
    try:
        while k + 1 < len(groups):
            k += 1
            fitted += fitted_trials(path, groups[k], faint)
            able = able or bool(fitted)
            while found := _best_of(path, notes, second[0], fitted, faint):
                best, significance, p = found
                # squares do not show small differences of many pixels or codes: their p-value is that of their own test
                if p > least or (best.evidence < LEAST_EVIDENCE and not faint) or not leads(best, groups[k + 1 :]):
                    break
                earlier = path.kept()
                # a map and random pixels fit by their scatter, which an earlier signature does not predict
                notes.waiting = [
                    g for g in groups[k + 1 :] if not (faint or any(t.maps or t.chips or t.fluctuates for t in g))
                ]
                if _taken(path, notes, failed, second, best, significance):
                    return True
                notes.waiting, refused = [], True
                fitted = [one for one in fitted if one is not best]
                if len(path.steps) > len(earlier[2]):
                    doubtful = doubtful or path.kept()
                    path.back_to(earlier)
            if k + 1 == len(groups) and not faint:  # a trace that nothing explains forbids no step of another one
                further = _of_other_traces(path, notes, seen)
                second, worth, fitted = second + further, worth_fitting(further) if further else [], []
                groups += competing(replicates, path.evaluation, worth)
                seen += worth
    except OutOfBudget:
        if doubtful is None:
            raise
        path.back_to(doubtful)
        record_end(path, f"step {len(path.steps) + 1}")
        return False
    if not able and not refused:
        raise _NoCandidate([one.candidate for one in seen])  # each was excluded when it was tried
    if doubtful is not None:
        path.back_to(doubtful)
    elif not (faint or refused) and has_few_replicates(path):
        look_closer(path)  # something is wrong: too few replicates may be what hides it
        return True
    return False


def _of_other_traces(path: ModelPath, notes: Notes, seen: Sequence[Trial]) -> list[Trial]:
    """The best trials on all captures that explain other traces than those that were fitted and not taken."""
    names = {one.candidate.name for one in seen}
    left = apart_from(path.replicates, path.evaluation, seen, [t for t in notes.tried if t.candidate.name not in names])
    if not left:
        return []
    again = patterns_first(path.scan, path.evaluation, path.scan.again(path.evaluation, path.values, left))
    return apart_from(path.replicates, path.evaluation, seen, again)


def added_from(path: ModelPath, notes: Notes, failed: Sequence[BlockCheck], waiting: Sequence[list[Trial]]) -> bool:
    """Whether a step was added from groups of trials that do not compete with the last step, without a new scan.

    Their signatures are those of the model before that step.
    """
    groups = [group for one in waiting if (group := _still_promising(path, one))]
    groups.sort(key=lambda group: -group[0].fall)
    waited = {trial.candidate.name for one in waiting for trial in one}
    others = [one for one in notes.second if one.candidate.name not in waited]
    for k, group in enumerate(groups):
        earlier, notes.waiting = path.kept(), groups[k + 1 :]
        group = _with_rivals(path, group, others)
        if not group:
            break
        try:
            found = _best_of(path, notes, None, fitted_trials(path, group, False), False)
            if found is not None and found[2] <= FALSE_ALARM and found[0].evidence >= LEAST_EVIDENCE:
                best, significance, _ = found
                if leads(best, notes.waiting) and _taken(path, notes, failed, group, best, significance):
                    return True
        except _NoCandidate as none:
            none.exclude_from(path, earlier)
        except UNABLE:  # the scan that follows records what cannot be simulated
            pass
        path.back_to(earlier)
    notes.waiting = []
    return False


def _with_rivals(path: ModelPath, group: list[Trial], others: Sequence[Trial]) -> list[Trial]:
    """The trials of a group that are worth fitting, with the other trials that compete with them under this model.

    It is empty where a new scan is needed: a trial that does not compete with them promises far more, or one with a map
    or a scatter of its own, which an earlier signature does not predict, promises much.

    Args:
        others: the trials of the same second look that are in no group.
    """
    plain = [one for one in others if not (one.maps or one.chips or one.fluctuates)]
    rest = [one for one in others if one.maps or one.chips or one.fluctuates]
    first, *further = competing(path.replicates, path.evaluation, [*group, *_still_promising(path, plain)])
    apart = max((one.fall for members in further for one in members), default=0.0)
    falls = [path.scan.line_search(path.evaluation, one.signature, one.signed)[0] for one in rest]
    if NEAR * apart > group[0].fall or max(falls, default=0.0) > NEAR * group[0].fall:
        return []
    return worth_fitting(sorted(first, key=lambda one: -one.fall))


def _still_promising(path: ModelPath, group: Sequence[Trial]) -> list[Trial]:
    """The trials of an earlier model at their best strength under this one; none where the data resemble none of them.

    What a step has set or added is no candidate any more.
    """
    evaluation, added = path.evaluation, {step.candidate.effect for step in path.steps}
    out = []
    for one in group:
        line = path.scan.line_at(evaluation, one.candidate, one.values) if one.phases else None
        if one.candidate.effect in added or path.scan.is_excluded(one.candidate) or (one.phases and line is None):
            continue
        anew: dict[str, Any] = {"evaluation": None, "fit": None, "there": None, "residuals": None}
        now = replace(one, p_value=line.p if line else one.p_value, evidence=-math.inf, **anew)
        now.fall, now.times = path.scan.line_search(evaluation, one.signature, one.signed)
        now.fall -= 2 * len(one.phases)
        with contextlib.suppress(SpadError):  # the scan that follows records what cannot be set in this model
            now.sensors = evaluation.sensors.changed(one.values, one.phases, one.chips)
            out.append(now)
    out.sort(key=lambda t: -t.fall)
    return out if out and out[0].fall > PROMISING else []


def _is_set(path: ModelPath, one: Trial) -> bool:
    """Whether a step has set the parameter that names a trial."""
    strengths = {d.key for d in one.candidate.strengths} | {key for key, _ in one.candidate.fixed}
    return not path.values.keys().isdisjoint(strengths)


def fitted_trials(path: ModelPath, worth: Sequence[Trial], faint: bool) -> list[Trial]:
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
    path: ModelPath, notes: Notes, first: Trial | None, fitted: Sequence[Trial], faint: bool
) -> tuple[Trial, float, float] | None:
    """(best of the fitted trials, its significance, its p-value); None where there is none.

    Args:
        first: of the second look, where `patterns_first` had a say.
    """
    replicates = path.replicates
    judged = {id(one): p_of_best(replicates, path.evaluation, notes.tried, one, not faint) for one in fitted}
    if faint:
        judge_maps_by_odd_pixels(replicates, path.evaluation, fitted, judged)
        for one in fitted:
            one.evidence = judged[id(one)][0] ** 2
        fitted = [one for one in fitted if explains_its_signature(replicates, path.evaluation, one)]
    if not fitted:
        return None
    pattern = first if first and is_pattern(first) and (faint or first.evidence >= LEAST_EVIDENCE) else None
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
    with _needed(best.candidates, "fitting all numbers together"):
        new = accept(path, best, significance)
    if best.maps is None and not best.phases:
        with or_as_before(path, "trying random maps with the same signature"):
            random_maps = random_map_trials(scan, before, path.values, best, faint)
            second = second + random_maps
    new[0].alternatives = alternatives(scan, before, best, second)
    named = {s.candidate.effect for s in path.steps} | {a["effect"] for a in new[0].alternatives}
    if notes.placebo is None:
        with contextlib.suppress(*UNABLE):  # no result depends on it
            notes.placebo = placebo_of(path.replicates, before, notes.tried, best, named)
    if faint:
        with _needed(best.candidates, "fitting all numbers together"):
            complete(path)  # what no check shows is decided by the fit of all numbers
    if not failed and path.failed and has_few_replicates(path):
        with _needed(best.candidates, "a closer look"):
            look_closer(path)  # with as many replicates as the model without the step
    if not failed and path.failed:
        path.back_to(earlier)  # no check failed before, now one does
        return False

    # the totals are no part of the misfit: with fewer failing checks it is a step, whatever noise does to the rest
    def helps_too_little() -> bool:
        explains = all(left_by(step, path, not notes.explained) < 1 for step in new)
        more = len(path.failed) >= max(len(failed), 1)
        return not explains and more and fell - path.misfit < _LEAST_FALL_OF_MISFIT * (fell - 1)

    if helps_too_little():
        with _needed(best.candidates, "fitting all numbers together"):
            complete(path)  # a rough fit may be all that is wrong with it
        if helps_too_little():
            if path.misfit > fell:
                path.back_to(earlier)
            return False
    return True


def complete(path: ModelPath) -> bool:
    """Fit all numbers together where the last fit was a rough one, and renew the last row of the error budget.

    Returns:
        Whether that was done; not where it was done before, or the model cannot be simulated around its values.
    """
    if not path.is_rough:
        return False
    if path.not_completed is path.evaluation:
        return False
    complete_fit(path)
    refit_whole_numbers(path)
    if path.steps:
        path.last_rung()
    return not path.is_rough


def has_few_replicates(path: ModelPath) -> bool:
    """Whether the model has fewer replicates than a closer look."""
    return len(path.evaluation.replicate_residuals[TOTALS]) < CLOSER


def look_closer(path: ModelPath) -> None:
    """Evaluate the model with more replicates; without steps it is the stated model that later ones are judged by."""
    path.replicates.say(f"more replicates of the model: {CLOSER} of each capture")
    own = path.evaluation
    path.evaluation = evaluate(path.replicates, own.values, own.sensors, CLOSER, own)
    if not path.steps:
        path.ladder.clear()
        path.rung("start")
