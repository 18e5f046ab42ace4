"""A model that lacks several effects at once: what one step has simulated, the next one uses again."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from labs import CROSSTALK, DURATION, LIFETIME, PROBABILITY, bench_of, change_of, given, labs, names, quiet, taken

from spadmnist.inference.candidates import candidates
from spadmnist.inference.capture_replicates import CannotSimulate
from spadmnist.inference.conclusion import Notes
from spadmnist.inference.coordinates import is_edge
from spadmnist.inference.earlier_trials import has_changed
from spadmnist.inference.elimination import drop_needless, drop_unless_missed
from spadmnist.inference.evaluation import evaluate
from spadmnist.inference.evidence import competing, leads
from spadmnist.inference.forward_step import added_from, best_of_scan_added
from spadmnist.inference.joint_fit import complete_fit, with_own_errors
from spadmnist.inference.map_fits import bounds_of
from spadmnist.inference.map_trials import map_trials_of
from spadmnist.inference.model_path import ModelPath, accept, begin, keys_of, rests_on
from spadmnist.inference.model_selection import another_step
from spadmnist.inference.replicates import TOTALS
from spadmnist.inference.scan import Scan
from spadmnist.inference.signature import signatures, size_of
from spadmnist.inference.trial import Trial

BOTH = "    afterpulsing: {probability: 5 %, lifetime: 60 ns}\n    crosstalk: {probability: 3 %}\n"
FLICKER = "    flicker: {amplitude: 0.3, frequency: 500 Hz, phase: 0.7 rad}\n"


@pytest.fixture
def lab(tmp_path):
    return labs(tmp_path)


def both_added(path: ModelPath) -> None:
    taken(path, "add afterpulsing", {PROBABILITY: 0.04, LIFETIME: 6e-8})
    taken(path, "add crosstalk", {CROSSTALK: 0.02})


@pytest.mark.slow
def test_the_fit_of_a_later_step_uses_the_columns_that_are_known(lab) -> None:
    """With as many simulations as the squares need; once all steps are there, the Jacobian is simulated with all."""
    path = begin(bench_of(lab(BOTH), 32))
    both_added(path)
    assert names(path) == ["add afterpulsing", "add crosstalk"] and path.approximate
    assert path.fit is not None
    first, kept = path.fit, path.kept()
    with_own_errors(path)  # where the budget ends here
    own = path.fit
    assert np.array_equal(own.point, [d.coordinate(path.values[d.key]) for d in own.coordinates])
    step = path.steps[0].values["probability"]
    assert step.low is not None and step.high is not None
    i = [d.key for d in own.coordinates].index(PROBABILITY)
    half = own.coordinates[i].error(step.low, step.high)
    assert half == pytest.approx(np.sqrt(own.covariance[i, i]), rel=0.01)
    path.back_to(kept)
    done = path.replicates.simulations
    complete_fit(path)
    assert not path.approximate and path.fit is not None
    assert path.replicates.simulations - done >= 2 * len(first.coordinates) * 8  # of one capture at least
    # the values and their errors are nearly those of the whole fit
    error = np.sqrt(np.diag(path.fit.covariance))
    for i, coordinate in enumerate(path.fit.coordinates):
        if coordinate.key in (PROBABILITY, CROSSTALK, LIFETIME):
            assert abs(first.point[i] - path.fit.point[i]) < 2 * error[i]
            # borrowed columns hold the noise of their fits, and seem to inform a probability more than they do
            assert np.sqrt(first.covariance[i, i]) / error[i] < (0.6 if coordinate.key == PROBABILITY else 1.6)
            # of few replicates the Jacobian lacks what may be noise: errors are too large rather than too small
            assert 0.75 < np.sqrt(own.covariance[i, i]) / error[i] < 2.5
            truth = {PROBABILITY: 0.05, CROSSTALK: 0.03, LIFETIME: 6e-8}[coordinate.key]
            assert abs(path.fit.point[i] - coordinate.coordinate(truth)) < 4 * error[i]
    done = path.replicates.simulations
    complete_fit(path)  # nothing is left to do
    assert path.replicates.simulations == done
    path.back_to(kept)
    assert path.approximate and path.fit is first


@pytest.mark.slow
def test_columns_of_another_model_do_not_end_a_fit(lab) -> None:
    """Where the squares do not fall as the known columns say, the Jacobian is simulated."""
    path = begin(bench_of(lab(BOTH), 16))
    taken(path, "add afterpulsing", {PROBABILITY: 0.04, LIFETIME: 6e-8})
    best = given(path, "add crosstalk", {CROSSTALK: 0.02}, fitted=True)
    assert best.fit is not None
    wrong = {cell: -x for cell, x in best.fit.jacobian.items()}  # it leads away from the data
    far = {**best.values, CROSSTALK: 0.005}
    sensors = path.evaluation.sensors.changed(far)
    accept(path, replace(best, fit=replace(best.fit, jacobian=wrong), values=far, sensors=sensors), 1.0)
    assert not path.approximate
    assert path.values[CROSSTALK] == pytest.approx(0.03, rel=0.3)


@pytest.mark.slow
def test_only_what_explains_the_same_is_fitted_beside_each_other(lab) -> None:
    """A dead time and a slow recovery compete for one edge; neighbours that trigger each other have nothing to do
    with it, and are found by the next step."""
    path = begin(bench_of(lab("    crosstalk: {probability: 10 %}\n", dead=60, light=1000), 16))
    recovery = change_of(path.replicates, "add slow_recovery")
    edge = given(path, "set dead_time.duration", {DURATION: 60e-9}, fitted=False)
    slow = given(path, "add slow_recovery", {d.key: 1.5e-8 for d in recovery.coordinates}, fitted=False)
    cross = given(path, "add crosstalk", {CROSSTALK: 0.1}, fitted=False)
    assert is_edge(edge.candidate.strengths[0])
    groups = competing(path.replicates, path.evaluation, [edge, cross, slow])
    assert [[t.candidate.name for t in group] for group in groups] == [
        ["set dead_time.duration", "add slow_recovery"],
        ["add crosstalk"],
    ]
    # random odd pixels have more scatter: what they explain, the squares do not say
    chips = replace(cross, chips=True)
    assert competing(path.replicates, path.evaluation, [edge, chips]) == [[edge, chips]]
    assert competing(path.replicates, path.evaluation, []) == []
    # what competes with two that do not compete with each other brings them together
    assert competing(path.replicates, path.evaluation, [edge, cross, replace(slow, chips=True)])[0][:2] == [edge, cross]
    # the better one of two groups may be the one whose squares promise less
    assert leads(replace(edge, evidence=40.0), [[replace(cross, fall=90.0)], [replace(slow, fall=10.0)]])
    assert not leads(replace(edge, evidence=30.0), [[replace(cross, fall=90.0)]])
    assert leads(replace(edge, evidence=30.0), [])


@pytest.mark.parametrize("helps", [False, True])
def test_where_the_first_group_leads_nowhere_the_next_one_is_fitted(lab, monkeypatch, helps: bool) -> None:
    """A step that helps too little to go on from stays only where no other one does better."""
    path, asked = begin(bench_of(lab("    crosstalk: {probability: 10 %}\n", dead=60, light=1000), 16)), []
    edge = given(path, "set dead_time.duration", {DURATION: 60e-9}, fitted=False)
    cross = given(path, "add crosstalk", {CROSSTALK: 0.1}, fitted=False)
    trials = [replace(edge, fall=500.0), replace(cross, fall=400.0)]
    module = "spadmnist.inference.forward_step."

    def taken_or_not(path: ModelPath, notes, failed, second, best, significance) -> bool:
        asked.append(best.candidate.name)
        path.steps.append(SimpleNamespace(name=best.candidate.name, values={}, map=None))  # type: ignore[arg-type]
        return helps and best.candidate.effect == "crosstalk"

    def fitted(path, worth, faint):
        return [replace(t, evidence=t.fall) for t in worth]

    monkeypatch.setattr(module + "fitted_trials", fitted)
    monkeypatch.setattr(module + "_taken", taken_or_not)
    monkeypatch.setattr(module + "p_of_best", lambda *_: (9.0, 1e-20))
    monkeypatch.setattr(module + "patterns_first", lambda scan, evaluation, second: second)
    monkeypatch.setattr(path.scan, "again", lambda *_: trials)
    assert best_of_scan_added(path, Notes([], False), path.failed, 0.01) is helps
    assert asked == ["set dead_time.duration", "add crosstalk"]
    assert [step.name for step in path.steps] == [asked[1] if helps else asked[0]]
    # a group of which the squares promise far more is fitted before one of little evidence is taken
    path.steps.clear()
    asked.clear()
    trials[1].fall = 2000.0
    best_of_scan_added(path, Notes([], False), path.failed, 0.01)
    assert asked[0] == "add crosstalk"


@pytest.mark.slow
@pytest.mark.parametrize("apart", [False, True])
def test_a_trace_that_nothing_explains_forbids_no_step_of_another_one(lab, monkeypatch, apart: bool) -> None:
    """The second look has the largest trace alone; its best candidate explains nothing when it is fitted."""
    path, asked = begin(bench_of(lab("    crosstalk: {probability: 10 %}\n", dead=60, light=1000), 16)), []
    edge = given(path, "set dead_time.duration", {DURATION: 60e-9}, fitted=False)
    cross = given(path, "add crosstalk", {CROSSTALK: 0.1}, fitted=False)
    rival = given(path, "add slow_recovery", {("slow_recovery", "time_constant"): 1e-8}, fitted=False)
    trials = [replace(edge, fall=4000.0), replace(rival, fall=300.0), *([replace(cross, fall=200.0)] if apart else [])]
    module = "spadmnist.inference.forward_step."

    def fitted(path, worth, faint):
        asked.append([t.candidate.name for t in worth])
        return [replace(t, evidence=t.fall if t.candidate.effect == "crosstalk" else -2.0) for t in worth]

    monkeypatch.setattr(module + "fitted_trials", fitted)
    monkeypatch.setattr(module + "_taken", lambda path, notes, failed, second, best, significance: True)
    monkeypatch.setattr(module + "p_of_best", lambda *_: (9.0, 1e-20))
    monkeypatch.setattr(module + "patterns_first", lambda scan, evaluation, second: second)
    monkeypatch.setattr(path.scan, "again", lambda evaluation, values, tried, faint=False: tried[:1])
    notes = Notes([], False)
    notes.tried = trials
    assert best_of_scan_added(path, notes, path.failed, 0.01) is True
    # what competes with that candidate is no other trace
    assert asked == ([["set dead_time.duration"], ["add crosstalk"]] if apart else [["set dead_time.duration"]])
    assert apart or len(path.evaluation.replicate_residuals[TOTALS]) > 16  # then more replicates are made


@pytest.mark.slow
def test_signatures_of_the_first_look_are_used_again(lab) -> None:
    """Those of the effect that was added are not, nor those whose cells scatter in another way now."""
    replicates = bench_of(lab(BOTH), 16)
    path = begin(replicates)
    some = ("add afterpulsing", "add crosstalk", "set dead_time.duration", "add jitter")
    path.scan.candidates = lambda sensor: [c for c in candidates(sensor) if c.name in some]  # type: ignore[method-assign]
    first = path.scan.scan(path.evaluation)
    taken(path, "add afterpulsing", {PROBABILITY: 0.05, LIFETIME: 6e-8})
    path.scan.accepted = [c for c in candidates(replicates.start) if c.name == "add afterpulsing"]
    done = replicates.simulations
    again = path.scan.scan(path.evaluation, known=first)
    used = replicates.simulations - done
    done = replicates.simulations
    anew = path.scan.scan(path.evaluation)
    assert used < 0.5 * (replicates.simulations - done)
    best = [next(t for t in found if t.candidate.name == "add crosstalk") for found in (again, anew)]
    assert best[0].fall == pytest.approx(best[1].fall, rel=0.2) and best[0].fall > 100
    assert again[0].candidate.name == anew[0].candidate.name == "add crosstalk"
    # of another size: the same trial is simulated anew
    known = next(t for t in first if t.candidate.name == "add crosstalk")
    now = size_of(replicates, path.evaluation, known.signature)
    assert not has_changed(path.scan, path.evaluation, replace(known, size=now * 1.1))
    assert has_changed(path.scan, path.evaluation, replace(known, size=now * 1.3))
    path.scan.accepted = [known.candidate]
    assert has_changed(path.scan, path.evaluation, known)


@pytest.mark.slow
def test_a_periodic_signature_is_simulated_once_for_a_line(lab) -> None:
    replicates = bench_of(lab(FLICKER, light=400), 16)
    look, evaluation = quiet(replicates), evaluate(replicates, {})
    candidate = change_of(replicates, "add flicker")
    (line, *_) = look.lines(evaluation)
    assert line.frequency == pytest.approx(500, abs=3 * line.error)
    tries = look.begun(evaluation, candidate)
    first = look.looked_at(evaluation, candidate, tries)
    done = replicates.simulations
    again = look.looked_at(evaluation, candidate, tries)
    assert replicates.simulations == done and [t.fall for t in again] == [t.fall for t in first]
    key = ("flicker", "frequency")
    near = replace(line, frequency=line.frequency + 0.5 * line.error)
    look._lines = evaluation, [near]  # the line under another model: the trial is at its frequency
    found = look.looked_at(evaluation, candidate, [{**tries[0], key: near.frequency}])
    assert replicates.simulations == done and [t.values[key] for t in found] == [near.frequency]
    # another periodic effect, and another frequency, have another signature
    other = replace(candidate, effect="other", kind="add")
    known = look._periodic
    assert other.name != candidate.name
    known._known = [("add other", {("other", "rate"): 1.0}, *known._known[0][2:]), *known._known]
    far = {**tries[0], key: line.frequency + 2 * line.error}
    assert not isinstance(known.signature(replicates, evaluation, candidate, far, line), str)
    assert replicates.simulations > done


@pytest.mark.slow
def test_a_map_that_is_clearly_needed_stays_without_another_fit(lab) -> None:
    extra = "    afterpulsing: {probability: 5 %, lifetime: 60 ns}\n"
    sensor, data = lab(extra, light=400, side=4)
    hot = np.where(np.arange(16) == 5, 20.0, 1.0)
    stated = sensor.with_values({"dark_counts.rate": 100.0 * hot})
    from spadmnist import simulate

    data = simulate(stated.with_effect(_afterpulsing()), data, seed=3)
    replicates = bench_of((sensor, data), 16)
    path = begin(replicates)
    (one,) = [
        t
        for t in _with_signatures(path.scan, map_trials_of(path.scan, path.evaluation, path.values))
        if t.candidate.name == "per_pixel dark_counts.rate" and not t.more
    ]
    accept(path, one, 10.0)
    taken(path, "add afterpulsing", {PROBABILITY: 0.05, LIFETIME: 6e-8})
    done, before = replicates.simulations, path.evaluation
    drop_unless_missed(path, path.steps[0])
    assert names(path) == ["per_pixel dark_counts.rate", "add afterpulsing"] and path.evaluation is before
    assert replicates.simulations - done == 16 * len(replicates.seen)  # one evaluation, no Jacobian


def _afterpulsing():
    from spadmnist import effects

    return effects.Afterpulsing(probability=0.05, lifetime=60e-9)


def _with_signatures(scan: Scan, trials: list[Trial]) -> list[Trial]:
    found = signatures(scan.replicates, begin(scan.replicates).evaluation, [t.sensors for t in trials if t.sensors])
    return [replace(t, signature=s) for t, s in zip(trials, found, strict=True) if not isinstance(s, CannotSimulate)]


def test_a_map_makes_no_cascade_that_does_not_end() -> None:
    """A pixel without light has any probability of afterpulses: at 1, its recording has 50 million events."""
    assert bounds_of(PROBABILITY) == (0.0, 0.9)
    assert bounds_of(("detection", "pdp")) == (0.0, 1.0)


@pytest.mark.slow
def test_what_does_not_compete_is_added_without_another_scan(lab, monkeypatch) -> None:
    """Its signature is that of the second look; a new scan would find the same trial."""
    path = begin(bench_of(lab(BOTH + FLICKER, light=400), 16))
    notes, scans = Notes([], False), []
    scan = Scan.scan
    monkeypatch.setattr(Scan, "scan", lambda self, *a, **k: (scans.append(len(path.steps)), scan(self, *a, **k))[1])
    while len(path.steps) < 3 and another_step(path, notes):
        pass
    assert sorted(names(path)) == ["add afterpulsing", "add crosstalk", "add flicker"]
    assert len(scans) < 3


@pytest.mark.slow
def test_a_step_stays_while_another_one_changes_a_number_of_its_effect(lab) -> None:
    """Without the effect, the number is that of none."""
    path = begin(bench_of(lab("    jitter: {sigma: 2 ns, tail_weight: 0.3, tail: 4 ns}\n", light=400), 16))
    sigma, weight, tail = (("jitter", name) for name in ("sigma", "tail_weight", "tail"))
    taken(path, "add jitter", {sigma: 2e-9, tail: 4e-9})
    taken(path, "set jitter.tail_weight", {weight: 0.3})
    first, second = path.steps
    assert rests_on(second, first, path) and not rests_on(first, second, path)
    assert sigma in keys_of(first.candidate, path) and weight not in keys_of(first.candidate, path)
    path.values = {**path.values, sigma: 5e-12}  # it explains nothing any more
    path.evaluation = evaluate(path.replicates, path.values)
    drop_needless(path)
    assert path.steps[0] is first


def test_a_group_that_waited_is_fitted_with_what_competes_with_it_now(lab, monkeypatch) -> None:
    """A rival with a small fall was not worth a fit in the second look; with the new step in the model it is."""
    path, asked = begin(bench_of(lab("    crosstalk: {probability: 10 %}\n", dead=60, light=1000), 16)), []
    recovery = change_of(path.replicates, "add slow_recovery")
    edge = given(path, "set dead_time.duration", {DURATION: 60e-9}, fitted=False)
    slow = given(path, "add slow_recovery", {d.key: 1.5e-8 for d in recovery.coordinates}, fitted=False)
    monkeypatch.setattr(
        "spadmnist.inference.forward_step.fitted_trials", lambda path, group, faint: asked.append(group) or []
    )
    notes = Notes([], False)
    notes.second = [edge, slow]
    assert not added_from(path, notes, path.failed, [[edge]])
    assert [sorted(t.candidate.name for t in group) for group in asked] == [
        ["add slow_recovery", "set dead_time.duration"]
    ]
    # what has a scatter of its own is predicted by no earlier signature: a scan is needed
    asked.clear()
    notes.second = [edge, replace(slow, chips=True)]
    assert not added_from(path, notes, path.failed, [[edge]]) and not asked
