"""Outlook: which capture would tell, what would have been seen; and what becomes of steps that are none."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from labs import CROSSTALK, DURATION, LIFETIME, PROBABILITY, bench_of, change_of, given, names, quiet, taken
from scipy import stats

import spadmnist as sp
from spadmnist.inference import conclusion
from spadmnist.inference.alternatives import alternatives
from spadmnist.inference.candidates import candidates
from spadmnist.inference.comparison import compare
from spadmnist.inference.conclusion import Notes, verdict_of
from spadmnist.inference.coordinates import Key
from spadmnist.inference.elimination import drop_needless, drop_unexplaining, no_step_explains
from spadmnist.inference.error_budget import from_the_others, rms_beyond_noise
from spadmnist.inference.evaluation import Evaluation, evaluate, square
from spadmnist.inference.evidence import evidence_of
from spadmnist.inference.experiment_design import between, between_totals, expected_significance
from spadmnist.inference.gauss_newton import Fit
from spadmnist.inference.map_trials import random_map_trials
from spadmnist.inference.model_path import begin
from spadmnist.inference.model_selection import diagnose
from spadmnist.inference.replicates import TOTALS, Execution, Replicates
from spadmnist.inference.results import Step, canonical
from spadmnist.inference.score_test import ScoreTest, p_of_best, score_test
from spadmnist.inference.setups import Factor, SetupExplanation
from spadmnist.inference.signature import Signature, captures_showing, residuals_at, signatures, template_of
from spadmnist.inference.trial import Trial, tie
from spadmnist.inference.upper_limits import share_beside, upper_limits
from spadmnist.workers import Serial

# --- which capture would tell ------------------------------------------------------------------------------------


def advised(replicates: Replicates, found: str, values: dict[Key, Any]) -> tuple[dict[str, Any], float]:
    """(the advice on the sensor as it is against one with these values, the square of what tells them now)."""
    evaluation, look = evaluate(replicates, {}), quiet(replicates)
    other = evaluation.sensors.changed(values)
    (signature,) = signatures(replicates, evaluation, [other])
    assert isinstance(signature, Signature)
    residuals = residuals_at(replicates, evaluation, signature)
    rival = Trial(change_of(replicates, "add afterpulsing"), values, signature, 0.0, 1.0, other, residuals=residuals)
    (told,) = between(look, evaluation, change_of(replicates, found), rival)
    return told, square(residuals) - square(evaluation.residuals)


@pytest.mark.slow
def test_dark_rates_are_told_by_a_long_dark_capture(lab):
    """130 Hz for 100 Hz in 4 pixels and 100 s: log 1.3 beside 1 / root of 40,000 detections."""
    told, now = advised(bench_of(lab()), "set dark_counts.rate", {("dark_counts", "rate"): 130.0})
    assert told["capture"] == "dark, 100 s"
    assert told["separates"] == ["dark_counts", "afterpulsing"]
    assert now > 0 and told["significance_now"] == pytest.approx(math.sqrt(now), rel=1e-4)
    more = told["significance_then"] ** 2 - now
    # sixteen recordings know their scatter to a fifth
    assert math.sqrt(more) == pytest.approx(math.log(1.3) * math.sqrt(40_000), rel=0.4)


def test_dead_times_are_told_by_a_brighter_flat_field(lab):
    """Intervals of 50 to 60 ns are as many as rate^2 x exposure x 10 ns: 16 times here, ten times in a longer one.

    They show in some statistics at once, so that all together tell more than their number.
    """
    replicates = bench_of(lab())
    told, now = advised(replicates, "set dead_time.duration", {DURATION: 60e-9})
    assert told["capture"] == "a flat field 4 times as bright as flat"
    assert now > 0 and told["significance_now"] == pytest.approx(math.sqrt(now), rel=1e-4)
    alive = replicates.seen["flat"].total / (4 * 20e-3)
    rate = 4 * alive / (1 - alive * 50e-9)
    missing = 4 * rate**2 / (1 + rate * 50e-9) * 20e-3 * 10e-9
    assert 0.9 * missing < told["significance_then"] ** 2 - now < 2.0 * missing


# --- what would have been seen -----------------------------------------------------------------------------------


def limit_of(replicates: Replicates, name: str) -> tuple[float, list[float]]:
    """(upper limit of an effect, standard deviations of each of its shapes' traces that the data have)."""
    evaluation, look = evaluate(replicates, {}), quiet(replicates)
    candidate = change_of(replicates, f"add {name}")
    tried = look.looked_at(evaluation, candidate, look.begun(evaluation, candidate))
    assert tried and all(isinstance(t, Trial) for t in tried)
    swings = change_of(replicates, "add flicker")
    line = Trial(swings, look.begun(evaluation, swings)[0], Signature({}, {}, {}), 0.0, 1.0)
    found, hidden, others = upper_limits(look, evaluation, [*tried, line])
    assert others == [{"effect": "flicker"}]  # of what was not tried nothing is said
    assert [e["effect"] for e in [*found, *hidden]] == [name]
    limit = found[0]["upper_limit_95"] if found else math.inf
    return limit, [score_test(replicates, evaluation, t.signature).data for t in tried]


def test_what_would_have_been_seen_is_seen(lab):
    """Twice the limit stands out beyond what a right model shows by chance, and the limit is no longer so low."""
    usual, along = limit_of(bench_of(lab()), "crosstalk")
    assert 0 < usual < 0.05 and max(along) < 3  # of six shapes of a trace
    for seed in (1, 2):
        replicates = bench_of(lab(f"    crosstalk: {{probability: {2 * usual}}}\n", seed=seed))
        limit, along = limit_of(replicates, "crosstalk")
        assert max(along) > 4 and limit > usual


def test_the_limit_of_a_drift_is_what_a_ramp_of_so_many_detections_tells(lab):
    """A strong drift is told by its square, a weak one by its sign: to root(12 / n), and 1.6 times that is excluded."""
    replicates = bench_of(lab(light=800, side=4))
    limit, _ = limit_of(replicates, "source_drift")
    error = math.sqrt(12 / replicates.seen["flat"].total)
    assert 1.2 * error < limit < 5 * error


# --- steps that are none -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_step_that_later_ones_make_needless_is_taken_out(lab):
    path = begin(bench_of(lab("    crosstalk: {probability: 3 %}\n")))
    taken(path, "add afterpulsing", {PROBABILITY: 1e-4, LIFETIME: 50e-9}, fitted=False)
    taken(path, "add crosstalk", {CROSSTALK: 0.03}, fitted=False)
    drop_needless(path)
    assert names(path) == ["add crosstalk"] and set(path.values) == {CROSSTALK}
    assert [c.name for c in path.scan.accepted] == ["add crosstalk"]
    assert path.ladder[-1].model == "- afterpulsing"


@pytest.mark.slow
def test_what_was_fitted_beside_a_needless_step_is_fitted_from_its_own_templates(lab):
    """A lifetime of 450 ns has no gradient that leads to the true one of 25 ns."""
    path = begin(bench_of(lab("    afterpulsing: {probability: 5 %, lifetime: 25 ns}\n", seed=1)))
    taken(path, "add crosstalk", {CROSSTALK: 1e-4}, fitted=False)
    taken(path, "add afterpulsing", {PROBABILITY: 2e-3, LIFETIME: 450e-9}, fitted=False)
    drop_needless(path)
    assert names(path) == ["add afterpulsing"]
    assert path.values[LIFETIME] == pytest.approx(25e-9, rel=0.3)
    assert path.values[PROBABILITY] == pytest.approx(0.05, rel=0.3)


@pytest.mark.slow
def test_going_back_restores_the_values_of_the_steps_before(lab):
    path = begin(bench_of(lab("    crosstalk: {probability: 3 %}\n")))
    taken(path, "add crosstalk", {CROSSTALK: 0.03})
    kept, values = path.kept(), dict(path.steps[0].values)
    taken(path, "add afterpulsing", {PROBABILITY: 1e-3, LIFETIME: 50e-9})
    assert path.steps[0].values != values  # all steps are fitted together
    path.back_to(kept)
    assert names(path) == ["add crosstalk"] and path.steps[0].values == values


def test_a_step_that_is_needed_stays(lab):
    path = begin(bench_of(lab("    crosstalk: {probability: 3 %}\n    afterpulsing: {probability: 5 %}\n")))
    taken(path, "add afterpulsing", {PROBABILITY: 0.05, LIFETIME: 25e-9}, fitted=False)
    taken(path, "add crosstalk", {CROSSTALK: 0.03}, fitted=False)
    values, rungs = dict(path.values), len(path.ladder)
    drop_needless(path)
    assert names(path) == ["add afterpulsing", "add crosstalk"] and path.values == values
    assert len(path.ladder) == rungs


STEADY = (
    "    blinking_dark_counts: {amplitude: 100 Hz, fraction: 30 %, rate_on: 10 kHz, rate_off: 10 Hz}\n"  # hot pixels
)


@pytest.mark.parametrize(("extra", "stays"), [("", False), pytest.param(STEADY, True, marks=pytest.mark.slow)])
def test_a_map_is_taken_out_unless_some_check_fails_without_it(lab, extra: str, stays: bool):
    path = begin(bench_of(lab("    crosstalk: {probability: 3 %}\n" + extra, side=4)))
    candidate = change_of(path.replicates, "per_pixel dark_counts.rate")
    path.scan.accepted.append(candidate)
    path.steps.append(Step(candidate, {}, 0.0, 9.0, ""))
    taken(path, "add crosstalk", {CROSSTALK: 0.03}, fitted=False)
    assert not path.failed
    drop_needless(path)
    wanted = ["per_pixel dark_counts.rate", "add crosstalk"]
    assert names(path) == (wanted if stays else wanted[1:]) and not path.failed
    assert [c.name for c in path.scan.accepted] == names(path)
    assert (path.ladder[-1].model == "- dark_counts.rate per pixel") is not stays


def with_residuals(evaluation: Evaluation, sizes: dict[str, float]) -> Evaluation:
    """It with residuals as large as that in the cells of these statistics of the flat field, 0 elsewhere."""
    own = {cell: np.full(len(z), sizes.get(cell[1], 0.0)) for cell, z in evaluation.residuals.items()}
    return replace(evaluation, residuals=own, judgements={})


def test_what_only_looks_alike_is_taken_out(lab, monkeypatch):
    """A step's own cells must be in order; another one that explains its own stays, whatever remains elsewhere."""
    path = begin(bench_of(lab()))
    start = with_residuals(path.evaluation, {"neighbours": 10.0, "intervals": 10.0})
    end = with_residuals(path.evaluation, {"intervals": 9.0})
    taken(path, "add crosstalk", {CROSSTALK: 0.03}, fitted=False)
    taken(path, "add afterpulsing", {PROBABILITY: 0.05, LIFETIME: 25e-9}, fitted=False)
    path.evaluation, path.fit = end, None
    for step, name in zip(path.steps, ("neighbours", "intervals"), strict=True):
        step.before = dict(start.residuals)
        step.template = {c: np.full(len(z), float(c[1] == name)) for c, z in end.residuals.items()}
    monkeypatch.setattr("spadmnist.inference.elimination.fit_all", lambda path, fit=None: None)
    assert path.failed
    drop_unexplaining(path, start, True)
    assert names(path) == ["add crosstalk"] and set(path.values) == {CROSSTALK}
    # what remains unexplained lists the dropped step as the nearest candidate
    monkeypatch.setattr(conclusion, "remainder", lambda *_: [{"statistic": "intervals"}])
    (rest,) = conclusion.unexplained_by(path)
    assert [(e["effect"], e["nearest"]) for e in rest["alternatives"]] == [("afterpulsing", True)]
    # what is left is kept if it explains nearly all, whatever its own cells have
    foul = with_residuals(end, {"neighbours": 5.0})
    path.evaluation = foul
    drop_unexplaining(path, with_residuals(end, {"neighbours": 10.0, "intervals": 100.0}), True)
    assert names(path) == ["add crosstalk"]
    # and nothing is left of steps that made all of it worse
    path.evaluation = with_residuals(end, {"intervals": 30.0})
    drop_unexplaining(path, start, True)
    assert not path.steps and not path.values and path.evaluation is start


def test_two_steps_that_only_look_alike_are_the_last(lab):
    """One may be half of two effects; and a step that explains its own is no reason to stop."""
    path = begin(bench_of(lab()))
    start = with_residuals(path.evaluation, {"neighbours": 10.0, "intervals": 10.0})
    end = with_residuals(path.evaluation, {"neighbours": 9.0, "intervals": 9.0})
    for candidate, values in (("add crosstalk", {CROSSTALK: 0.03}), ("add afterpulsing", {PROBABILITY: 0.05})):
        assert not no_step_explains(path, True)
        taken(path, candidate, values, fitted=False)
        path.evaluation = end
        path.steps[-1].before = dict(start.residuals)
        name = "neighbours" if candidate == "add crosstalk" else "intervals"
        path.steps[-1].template = {c: np.full(len(z), float(c[1] == name)) for c, z in end.residuals.items()}
    assert path.failed and no_step_explains(path, True)
    path.evaluation = with_residuals(path.evaluation, {"intervals": 9.0})
    assert path.failed and not no_step_explains(path, True)


@pytest.mark.parametrize("totals", [True, False])
def test_totals_that_the_set_up_explains_take_no_step_away(lab, totals):
    """Where nothing but totals fails; and what swings takes its phases with it when it goes."""
    path = begin(bench_of(lab()))
    start = with_residuals(path.evaluation, {"neighbours": 10.0, "intervals": 20.0})
    taken(path, "add crosstalk", {CROSSTALK: 0.03}, fitted=False)
    step = path.steps[0]
    step.before = dict(start.residuals)
    step.template = {c: np.full(len(z), 5.0 * (c == TOTALS)) for c, z in start.residuals.items()}
    step.template["flat", "neighbours"][:] = 1.0
    path.evaluation = with_residuals(path.evaluation, {"intervals": 15.0})
    path.evaluation.residuals[TOTALS][:] = 20.0
    path.scan.phases = {("flat", ("flicker", "phase")): 1.0}
    assert path.failed
    drop_unexplaining(path, start, totals)
    assert names(path) == ([] if totals else ["add crosstalk"])
    assert path.scan.phases == ({} if totals else {("flat", ("flicker", "phase")): 1.0})


def test_means_alone_have_limits_too(lab) -> None:
    """Nothing was simulated, so no capture shows a trace."""
    replicates = bench_of(lab())
    evaluation = replace(evaluate(replicates, {}), made={})
    assert captures_showing(template_of(replicates, evaluation, Signature({}, {}, {})), 0.1) == []


def test_a_light_that_is_not_stated_is_the_one_that_fits(lab) -> None:
    """A longer capture of it has as many detections in a second, not those of the dark."""
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    flat = replicates.seen["flat"].capture
    free = replace(flat, light=replace(flat.light, level=None))
    other = evaluation.sensors.changed({CROSSTALK: 0.3})
    stated, found = (expected_significance(replicates, evaluation, other, one, "flat") for one in (flat, free))
    assert found == pytest.approx(stated, rel=0.3) and found > 1


# --- two that look the same --------------------------------------------------------------------------------------


def test_alternatives_are_confused_where_they_leave_nothing_and_are_as_near(lab):
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    clean, foul = with_residuals(evaluation, {}).residuals, with_residuals(evaluation, {"intervals": 10.0}).residuals
    kinds = [change_of(replicates, f"add {name}") for name in ("afterpulsing", "slow_afterpulsing", "crosstalk")]
    best, near, third = (
        Trial(c, {}, Signature({}, {}, {}), 100.0, 1.0, residuals=clean, evidence=100.0) for c in kinds
    )

    def told(**other: Any) -> list[tuple[str, bool]]:
        found = alternatives(quiet(replicates), evaluation, best, [best, replace(near, **other)])
        return [(a["effect"], a["confused"]) for a in found]

    assert told(evidence=93.0) == [("slow_afterpulsing", True)]
    assert told(evidence=88.0) == [("slow_afterpulsing", False)]
    assert told(residuals=foul) == [("slow_afterpulsing", False)]
    assert told(evidence=-math.inf) == [("slow_afterpulsing", False)]  # never fitted
    many = alternatives(quiet(replicates), evaluation, best, [best, near, near, third])
    assert [a["effect"] for a in many] == ["slow_afterpulsing", "crosstalk"]  # each once
    # where chance makes pixels odd, by that model's own scatter
    own = with_residuals(evaluation, {})
    assert told(residuals=foul, chips=True, evaluation=own) == [("slow_afterpulsing", True)]
    assert told(chips=True, evaluation=with_residuals(evaluation, {"intervals": 10.0})) == [
        ("slow_afterpulsing", False)
    ]
    # whose squares fall as much, though the law of its scatter gains little
    for fall, alike in ((100.0, True), (10.0, False)):
        assert told(fall=fall, evidence=-50.0, chips=True, evaluation=own) == [("slow_afterpulsing", alike)]
    # at the end of where it is looked for no law is quite right: what nearly does as well may be
    for lifetime, alike in ((499e-9, False), (500e-9, True), (5e-9, True)):
        best.values = {("afterpulsing", "lifetime"): lifetime}
        assert told(evidence=82.0) == [("slow_afterpulsing", alike)]
        assert told(evidence=78.0) == told(evidence=99.0, residuals=foul) == [("slow_afterpulsing", False)]
    # another value and a map of it are two things
    two = [
        replace(near, candidate=change_of(replicates, f"{kind} dead_time.duration")) for kind in ("set", "per_pixel")
    ]
    assert [a["change"] for a in alternatives(quiet(replicates), evaluation, best, [best, *two])] == [
        "set",
        "per_pixel",
    ]


BLURRED = "jitter: {sigma: 1 ns, tail: 0 s}", "add jitter", {("jitter", "sigma"): 1e-9}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("truth", "name", "values", "unseen", "alike"),
    [
        (
            "jitter: {sigma: 1 ns, tail: 0 s}",
            "add jitter",
            {("jitter", "sigma"): 1e-9},
            "early_intervals",
            ["dead_time"],
        ),
        pytest.param(
            "jitter: {sigma: 1 ns, tail: 0 s}",
            "add jitter",
            {("jitter", "sigma"): 1e-9},
            "",
            [],
            marks=pytest.mark.long,
        ),
        pytest.param(
            "crosstalk: {probability: 2 %}", "add crosstalk", {CROSSTALK: 0.02}, "", [], marks=pytest.mark.long
        ),
    ],
)
def test_pixels_whose_dead_time_differs_unseen_are_a_look_alike_of_jitter(lab, truth, name, values, unseen, alike):
    """Both blur the edge of the intervals; what tells them apart is how many short ones each pixel has, where these are
    many. Of pixels so few and dim their counts say nothing.
    """
    path = begin(bench_of(lab(f"    {truth}\n", light=900, side=8)))
    seen = {cell: z for cell, z in path.evaluation.residuals.items() if cell[1] != unseen}
    assert (len(seen) < len(path.evaluation.residuals)) == bool(unseen)
    path.evaluation = replace(path.evaluation, residuals=seen)
    one = given(path, name, values, fitted=True)
    one.evidence = evidence_of(path.replicates, path.evaluation, one)
    found = random_map_trials(path.scan, path.evaluation, {}, one)
    assert [t.candidate.effect for t in found if t.candidate.name == "per_pixel dead_time.duration"] == alike
    assert one.evidence > 100 and all(t.evidence > one.evidence - tie(one.evidence) for t in found)


def test_verdicts(lab):
    path = begin(bench_of(lab()))
    step, some = object(), [object()]

    def verdict(left: Any, setup: bool = False, rival: Trial | None = None) -> str:
        return verdict_of(path, left, Notes([{}] * setup, setup, rival=rival))

    assert verdict([]) == "adequate"
    assert verdict([], setup=True) == "setup"
    assert verdict(some) == "unexplained"
    path.steps.append(step)  # type: ignore[arg-type]
    assert verdict([]) == "explained"
    assert verdict(some) == "partly_explained"
    assert verdict([], setup=True, rival=given(path, "add crosstalk", {}, False)) == "confused"


@pytest.mark.slow
def test_the_same_seed_gives_the_same_answer(lab, monkeypatch):
    kinds = ("add afterpulsing", "add crosstalk")
    few = [c for c in candidates(lab()[0].resolved()) if c.name in kinds]
    monkeypatch.setattr(Replicates, "candidates", lambda self, sensor: few)
    made = lab("    afterpulsing: {probability: 5 %, lifetime: 60 ns}\n")
    one, same = (diagnose(*made, quick=True, jobs=1, max_steps=1) for _ in range(2))
    assert [step.candidate.name for step in one.steps] == ["add afterpulsing"]
    assert canonical(one) == canonical(same)


def test_no_chance_is_none_at_all(lab):
    """However wrong a model is: p-values have logarithms, and JSON has no infinite numbers."""
    sensor, data = lab("    afterpulsing: {probability: 40 %, lifetime: 50 ns}\n")
    checks = json.loads(json.dumps(compare(sensor, data, jobs=1, replicates=16).as_data(), allow_nan=False))
    p = [check["p_value"] for check in checks["checks"]]
    assert min(p) < 1e-100 and all(0 < x <= 1 for x in p)
    path = begin(bench_of((sensor, data)))
    one = given(path, "add afterpulsing", {PROBABILITY: 0.4, LIFETIME: 50e-9}, False)
    significance, p = p_of_best(path.replicates, path.evaluation, [one], replace(one, evidence=1e18))
    assert 0 < p < 1e-100 and math.isfinite(significance)


def test_of_what_is_faint_the_trace_decides_and_not_the_squares(lab):
    """Chance moves the squares of all cells by more than a faint effect does."""
    path = begin(bench_of(lab()))
    one = given(path, "add afterpulsing", {PROBABILITY: 0.02, LIFETIME: 50e-9}, False)
    much, none = (replace(one, evidence=evidence) for evidence in (400.0, 0.0))
    assert p_of_best(path.replicates, path.evaluation, [one], much)[1] < 1e-8  # as where something is plainly wrong
    of_trace = p_of_best(path.replicates, path.evaluation, [one], none, False)
    assert p_of_best(path.replicates, path.evaluation, [one], much, False) == of_trace and of_trace[1] > 1e-6


@pytest.mark.parametrize("order", [1, -1])
def test_of_several_strengths_the_clearest_tells_the_limit(lab, monkeypatch, order: int) -> None:
    """One that is so weak that it does nothing says nothing of what can be seen."""
    replicates = bench_of(lab())
    evaluation, candidate = evaluate(replicates, {}), change_of(replicates, "add slow_recovery")
    key, loud, silent = candidate.strengths[0].key, Signature({}, {}, {"flat": 1.0}), Signature({}, {}, {}, True)
    tried = [Trial(candidate, {key: 5e-9}, loud, 0.0, 1.0), Trial(candidate, {key: 5e-10}, silent, 0.0, 1.0)]

    def scored(replicates: Replicates, evaluation: Evaluation, signature: Signature) -> ScoreTest:
        return ScoreTest(20.0 if signature is loud else 0.0, 0.0, np.zeros(16), 1.0, 15.0)

    monkeypatch.setattr("spadmnist.inference.upper_limits.score_test", scored)
    (excluded,), hidden, _ = upper_limits(quiet(replicates), evaluation, tried[::order])
    quantile = stats.t.isf(0.05, 15)
    assert not hidden and excluded["upper_limit_95"] == pytest.approx(quantile / 20 * 5e-9, rel=1e-6)


@pytest.mark.parametrize("score", [-3.0, 0.0, 3.0])
def test_the_limit_of_either_sign_is_that_of_the_farther_side(lab, monkeypatch, score: float) -> None:
    replicates = bench_of(lab())
    evaluation, candidate = evaluate(replicates, {}), change_of(replicates, "add source_drift")
    tried = [Trial(candidate, {candidate.strengths[0].key: 0.1}, Signature({}, {}, {"flat": 1.0}), 0.0, 1.0)]
    monkeypatch.setattr(
        "spadmnist.inference.upper_limits.score_test", lambda *_: ScoreTest(20.0, score, np.zeros(16), 1.0, 15.0)
    )
    (excluded,), hidden, _ = upper_limits(quiet(replicates), evaluation, tried)
    wanted = (abs(score) + stats.t.isf(0.025, 15)) / 20 * 0.1
    assert not hidden and excluded["upper_limit_95"] == pytest.approx(wanted, rel=1e-4)


def test_a_limit_beside_a_fit_is_profiled_over_its_numbers(lab) -> None:
    """A fitted number whose signature has the cosine 0.9 with an effect's: the limit is twice as large."""
    replicates = bench_of(lab())
    evaluation, look, candidate = evaluate(replicates, {}), quiet(replicates), change_of(replicates, "add crosstalk")
    tried = look.looked_at(evaluation, candidate, look.begun(evaluation, candidate)[:1])
    template = template_of(replicates, evaluation, tried[0].signature)
    keys = list(evaluation.residuals)
    t = np.concatenate([template.get(k, np.zeros(len(evaluation.residuals[k]))) for k in keys])
    other = np.random.default_rng(1).standard_normal(t.size)
    other -= t * (t @ other) / (t @ t)
    column = 0.9 * t / np.linalg.norm(t) + math.sqrt(1 - 0.9**2) * other / np.linalg.norm(other)
    ends = np.cumsum([len(evaluation.residuals[k]) for k in keys])[:-1]
    jacobian = {k: x[:, None] for k, x in zip(keys, np.split(column, ends), strict=True)}
    known = change_of(replicates, "set dead_time.duration").coordinates
    fit = Fit(known, np.zeros(1), np.eye(1), evaluation.residuals, jacobian, 0.0, {})
    assert share_beside(fit, evaluation, template) == pytest.approx(math.sqrt(1 - 0.9**2), rel=1e-6)
    none = replace(fit, jacobian={k: 0 * x for k, x in jacobian.items()})  # of a number that moves nothing
    limits = [upper_limits(look, evaluation, tried, one)[0][0]["upper_limit_95"] for one in (None, none, fit)]
    assert limits[1] == limits[0] and limits[2] > 1.5 * limits[0]
    same = replace(fit, jacobian={k: template.get(k, np.zeros(len(evaluation.residuals[k])))[:, None] for k in keys})
    excluded, hidden, _ = upper_limits(look, evaluation, tried, same)
    assert not excluded and hidden == [{"effect": "crosstalk"}]  # these captures cannot tell the two


# --- physical errors -------------------------------------------------------------------------------------------------


def test_two_lit_captures_differ_by_all_of_their_difference() -> None:
    assert np.abs(from_the_others(np.array([0.0, 0.02]))).tolist() == pytest.approx([0.02, 0.02])
    assert from_the_others(np.array([0.0, 0.02, 0.5]))[2] == pytest.approx(0.49)


def test_noise_is_no_error_of_a_rate() -> None:
    assert rms_beyond_noise(np.array([0.3, 0.0]), np.array([0.4, 0.0])) == 0.0
    assert rms_beyond_noise(np.array([0.5, 0.5]), np.array([0.3, 0.3])) == pytest.approx(0.4)


def test_the_capture_that_is_advised_separates_light_from_a_gate() -> None:
    """Ten times brighter, all frames are full in either case; in the dark a gate takes a fifth of the counts."""
    effects = [sp.effects.Detection(pdp=0.4), sp.effects.DarkCounts(rate=20.0)]
    sensor = sp.Sensor(sp.Layout(4, 4, 25e-12, 1.0), effects, rules="device")
    clock: dict[str, Any] = {"frames": 1000, "frame_time": 10e-6}
    light: dict[str, Any] = {"wavelength": 555e-9, "relative_uncertainty": 0.01}
    flat = [sp.Capture(f"f{k}", "qis", irradiance=x, **light, **clock) for k, x in enumerate((0.001, 0.006))]
    lab = sp.simulate(sensor, [sp.Capture("dark", "qis", dark=True, **clock), *flat], seed=3)
    replicates = Replicates(sensor, lab, 0, Execution(Serial()), 8)
    evaluation = evaluate(replicates, {})
    key = "short_gate", "fraction"
    gate = Trial(change_of(replicates, "add short_gate"), {key: 0.8}, Signature({}, {}, {}), 0.0, 1.0)
    gate.sensors = evaluation.sensors.changed({key: 0.8})
    log = np.array([math.log(0.8)])
    weaker = SetupExplanation((Factor("light", ("f0", "f1"), True),), log, np.array([0.01]), np.zeros(2))
    (told,) = between_totals(quiet(replicates), evaluation, weaker, gate)
    # 20 Hz in 16 pixels for 100 s: 32,000 counts, of which the gate takes 6,400
    assert told["capture"] == "dark, 100 s" and told["significance_then"] == pytest.approx(35.8, rel=0.05)
    assert set(told["separates"]) == {"light", "short_gate"}
