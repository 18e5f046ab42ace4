"""Search: what candidates are compared by, and how faint ones and those of either sign are fitted."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import laws
import numpy as np
import pytest
from labs import CROSSTALK, LIFETIME, PROBABILITY, bench_of, change_of, given, labs, quiet, taken, wrong_numbers
from scipy import stats

import spadmnist as sp
from spadmnist import plugins
from spadmnist.effects import Effect
from spadmnist.inference.candidates import first_strengths
from spadmnist.inference.coordinates import Coordinate
from spadmnist.inference.earlier_trials import still_valid
from spadmnist.inference.evaluation import evaluate, log_likelihood_ratio, square
from spadmnist.inference.evidence import best_of, evidence_of, worth_fitting
from spadmnist.inference.gauss_newton import Fit
from spadmnist.inference.intervals import open_ends, sharpen
from spadmnist.inference.joint_fit import edge_errors
from spadmnist.inference.laws import Law
from spadmnist.inference.light_levels import levels_about
from spadmnist.inference.map_trials import candidate_maps
from spadmnist.inference.model_path import begin
from spadmnist.inference.null_distribution import learn
from spadmnist.inference.replicates import Replicates, no_size
from spadmnist.inference.results import Value
from spadmnist.inference.scan import Scan
from spadmnist.inference.score_test import (
    ScoreTest,
    best_direction,
    explains_its_signature,
    p_of_best,
    p_of_spread,
    p_values,
    score_test,
)
from spadmnist.inference.signature import Sampling, Signature, signature_of_totals, signatures, template_of
from spadmnist.inference.trial import Trial
from spadmnist.inference.trial_fits import boost_of, fit_whole_number
from spadmnist.recording import Capture, Light
from spadmnist.statistics import Summary

CELL, OTHER = ("flat", "a"), ("flat", "b")


# --- signs -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_small_number_that_is_listed_wrong_has_a_signature() -> None:
    """Crosstalk of 0.2 % that is 0.6 %: a tenth more of it, which is tried first, is nothing among noise."""
    listed = sp.effects.Crosstalk(probability=2e-3, delay=1e-9)
    path = begin(bench_of(wrong_numbers(listed, {"crosstalk.probability": 6e-3}, 0.1), 16))
    found = [t for t in path.scan.scan(path.evaluation) if t.candidate.name == "set crosstalk.probability"]
    best = max(found, key=lambda t: t.fall)
    assert best.fall > 25 and best.scaled()["crosstalk", "probability"] == pytest.approx(6e-3, rel=0.4)


@pytest.mark.slow
def test_what_cannot_be_tried_stronger_stays_as_it_was() -> None:
    """Near the end of its range, and without a signature in so few data."""
    listed = sp.effects.Crosstalk(probability=0.04, delay=1e-9)
    path = begin(bench_of(wrong_numbers(listed, {}, 1e-3), 16))
    found = [t for t in path.scan.scan(path.evaluation) if t.candidate.name == "set crosstalk.probability"]
    (one,) = found
    assert one.size < 6 and one.values["crosstalk", "probability"] == 0.05
    assert not [entry for entry in path.scan.untried if entry["effect"] == "crosstalk"]


def test_what_both_signs_do_is_told_apart() -> None:
    up = Signature({CELL: np.array([5.0, 1.0]), OTHER: np.array([2.0])}, {CELL: 0.1}, {"flat": 0.3})
    down = Signature({CELL: np.array([-3.0, 1.0])}, {CELL: 0.3}, {"flat": -0.1})
    both = Signature.both(up, down)
    for times, one in ((1.0, up), (-1.0, down)):
        there = both.at(times)
        assert there.logs["flat"] == pytest.approx(one.logs["flat"])
        for cell in (CELL, OTHER):
            assert there.shifts[cell] == pytest.approx(one.shifts.get(cell, np.zeros(1)))
    # half as strong: half of the odd part, a quarter of the even one
    assert both.at(0.5).shifts[CELL] == pytest.approx([0.5 * 4 + 0.25 * 1, 0.25 * 1])


def test_what_chance_does_to_a_power_is_no_sign() -> None:
    """(n + 10)^2 and (n - 10)^2 differ by 40 n: chance, if n is. A line that was there, (10 + 1)^2, has a sign."""
    chance, line = ("flat", "spectrum"), ("bright", "spectrum")
    there = np.arange(9) == 4
    up = Signature({chance: np.array([114.0, 0.0]), line: 21.0 * there, CELL: np.array([5.0])}, {}, {})
    down = Signature({chance: np.array([86.0, 0.0]), line: -19.0 * there, CELL: np.array([-3.0])}, {}, {})
    both = Signature.both(up, down, {chance: np.ones(2), line: 1.0 + 100.0 * there}, 2)
    assert both.shifts[chance].tolist() == [0.0, 0.0] and both.shifts[line].tolist() == (20.0 * there).tolist()
    # where there is fifty times the power, chance does more, and takes away as well
    noisy = Signature.both(up, down, {line: np.full(9, 50.0)}, 2)
    assert not noisy.shifts[line].any()
    assert both.at(0.1).shifts[chance] == pytest.approx([1.0, 0.0])
    assert both.shifts[CELL].tolist() == [4.0]
    assert Signature.both(up, down).shifts[chance].tolist() == [14.0, 0.0]


@pytest.mark.slow
def test_a_faint_drift_resembles_the_trend_and_not_what_chance_makes_of_spectra(lab) -> None:
    """The trace of 1 % is not much more than its trend: in a spectrum it is the square that is there."""
    replicates = bench_of(lab("    source_drift: {slope: 0}\n", light=900, side=8))
    evaluation, look = evaluate(replicates, {}), quiet(replicates)
    candidate = change_of(replicates, "add source_drift")
    (one,) = look.looked_at(evaluation, candidate, look.begun(evaluation, candidate))
    faint = one.signature.at(0.1)
    trend = float(np.linalg.norm(template_of(replicates, evaluation, faint)["flat", "trend"]))
    whole = score_test(replicates, evaluation, faint)
    assert trend > 2 and whole.size * whole.spread < 1.25 * trend
    spectrum = one.signature.shifts["flat", "spectrum"]
    assert not spectrum.any() and one.signature.even is not None and one.signature.even.shifts["flat", "spectrum"].any()


def test_a_gate_that_takes_most_of_the_light_is_tried_where_it_does(lab) -> None:
    """It lacks 0.6; in proportion to what 0.18 take, or 0.0018, it would lack more than all."""
    replicates = bench_of(lab("    short_gate: {fraction: 0.4}\n", light=20, side=8))
    evaluation, look = evaluate(replicates, {}), quiet(replicates)
    candidate = change_of(replicates, "add short_gate")
    tried = look.trials_by_totals(evaluation, [(candidate, values) for values in look.begun(evaluation, candidate)])
    best = max(tried, key=lambda one: one.fall)
    # the next strengths that are tried are a sixth away
    assert best.times == 1 and best.values["short_gate", "fraction"] == pytest.approx(0.4, abs=0.1)
    linear = signature_of_totals(replicates, evaluation, evaluation.sensors.changed({("short_gate", "fraction"): 0.82}))
    times = look.line_search(evaluation, linear, False)[1]
    assert candidate.strengths[0].scaled(0.82, times) < best.values["short_gate", "fraction"] - 0.05


@pytest.mark.slow
def test_a_drift_is_looked_at_with_both_signs(lab) -> None:
    """Its trend has a sign, the variance of the counts has none."""
    replicates = bench_of(lab("    source_drift: {slope: -0.3}\n", light=900, side=8))
    evaluation, look = evaluate(replicates, {}), quiet(replicates)
    candidate = change_of(replicates, "add source_drift")
    (one,) = look.looked_at(evaluation, candidate, look.begun(evaluation, candidate))
    assert one.signature.even is not None and one.fall > 100
    # so many detections in a ramp tell the slope to root(12 / n)
    assert one.values["source_drift", "slope"] * one.times == pytest.approx(-0.3, abs=0.1)


def test_less_of_what_can_only_be_there_is_no_mark(lab) -> None:
    """Crosstalk cannot be negative, a drift can."""
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    cell = ("flat", "fine_intervals")
    signature = Signature({cell: np.full(len(evaluation.residuals[cell]), 1.0)}, {}, {})
    trace = template_of(replicates, evaluation, signature)[cell]
    for name, signed in (("add crosstalk", False), ("add source_drift", True)):
        candidate = change_of(replicates, name)
        one = Trial(candidate, {d.key: d.low for d in candidate.coordinates}, signature, 0.0, 1.0)
        p = []
        for sign in (1, -1):
            evaluation.residuals[cell] = sign * 10.0 * trace / math.sqrt(float(trace @ trace))
            p.append(p_values(replicates, evaluation, [one])[0][0])
        assert p[0] < 1e-3 and p[1] == (pytest.approx(p[0]) if signed else 1.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_belongs_to_either_sign_speaks_for_the_one_that_is_there(lab, sign: float) -> None:
    """A ramp and a spectrum of four standard deviations each: together 5.7, whichever way the light drifts."""
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    ramp, power = ("flat", "trend"), ("flat", "fine_intervals")
    up, down = (
        Signature(
            {cell: np.full(len(evaluation.residuals[cell]), x) for cell, x in ((ramp, odd), (power, 5.0))}, {}, {}
        )
        for odd in (5.0, -5.0)
    )
    candidate = change_of(replicates, "add source_drift")
    one = Trial(candidate, {d.key: 0.1 for d in candidate.coordinates}, Signature.both(up, down), 0.0, 1.0)
    trace = template_of(replicates, evaluation, one.signature)
    for cell, side in ((ramp, sign), (power, 1.0)):
        t = trace[cell]
        evaluation.residuals[cell] = side * 4.0 * t / math.sqrt(float(t @ t))
    _, found, times = best_direction(replicates, evaluation, one)
    assert times * sign > 0
    there = score_test(replicates, evaluation, one.signature.at(times))
    assert found.data == there.data > score_test(replicates, evaluation, one.signature.at(-times)).data + 1
    marked = quiet(replicates)._with_score(evaluation, one)
    assert marked.fall == found.data**2 and marked.times * sign > 0
    # less than nothing of what both signs do is neither
    told = dict(evaluation.residuals)
    evaluation.residuals[ramp], evaluation.residuals[power] = 0.0 * told[ramp], -told[power]
    assert quiet(replicates)._with_score(evaluation, one).fall == 0
    evaluation.residuals.update(told)
    # fitted as strong as it is seen, it helps, and the opposite does not
    strong = min(
        (0.02 * k for k in range(1, 50)),
        key=lambda x: abs(score_test(replicates, evaluation, one.signature.at(x)).size - 5.0),
    )
    one.there = one.signature.at(sign * strong)
    assert explains_its_signature(replicates, evaluation, one)
    one.there = one.signature.at(-sign * strong)
    assert not explains_its_signature(replicates, evaluation, one)
    one.there = None
    # and chance is asked of this one
    mark, p = p_of_best(replicates, evaluation, [one], one, large=False)
    assert mark == found.data and p < 0.01


def test_of_directions_side_by_side_all_together_are_asked(lab) -> None:
    """Two of 6.4 standard deviations each are together 9: what is fitted has both, though each was tried alone."""
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    cell, candidate = ("flat", "pixel_map"), change_of(replicates, "add illumination_gradient")
    rng = np.random.default_rng(2)
    shifts = np.linalg.qr(rng.standard_normal((len(evaluation.residuals[cell]), 2)))[0].T
    keys = [("illumination_gradient", name) for name in ("x", "y", "vignette")]
    one, other = (
        Trial(
            candidate, {k: 0.1 * (i == j) for j, k in enumerate(keys)}, Signature({cell: 50 * shift}, {}, {}), 0.0, 1.0
        )
        for i, shift in enumerate(shifts)
    )
    traces = [template_of(replicates, evaluation, t.signature)[cell] for t in (one, other)]
    evaluation.residuals.update({key: 0.0 * z for key, z in evaluation.residuals.items()})
    evaluation.residuals[cell] = sum(6.4 * t / math.sqrt(float(t @ t)) for t in traces)
    alone, both = (p_of_best(replicates, evaluation, tried, one, large=False) for tried in ([one], [one, other]))
    # by the recordings' own chance 7.1 and 7.7, for they are 16; each asked as one of three directions, p were 2e-4
    assert alone[0] + 0.3 < both[0] and both[1] < 1e-5


# --- faint effects -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "values", "power"),
    [
        ("afterpulsing", {PROBABILITY: 1e-3, LIFETIME: 40e-9}, 1.0),
        pytest.param("crosstalk", {CROSSTALK: 2e-4}, 1.0, marks=pytest.mark.slow),
        ("source_noise", {("source_noise", "contrast"): 0.03, ("source_noise", "coherence_time"): 1e-4}, 2.0),
    ],
)
def test_the_power_with_which_a_trace_grows(lab, name: str, values: dict[Any, Any], power: float) -> None:
    """Probabilities in proportion, fluctuations with the square: whatever chance hides of a faint trace."""
    replicates = bench_of(lab(light=900, side=4))
    evaluation = evaluate(replicates, {})
    (signature,) = signatures(
        replicates, evaluation, [evaluation.sensors.changed(values)], Sampling(few=2, kept="sure")
    )
    assert isinstance(signature, Signature)
    boost, found = boost_of(
        replicates, evaluation, Trial(change_of(replicates, f"add {name}"), values, signature, 0.0, 1.0), values
    )
    assert boost > 2 and round(found) == power


@pytest.mark.slow
def test_a_faint_effect_is_fitted_at_its_own_strength(lab) -> None:
    """Afterpulsing of 0.4 % in 19,000 detections a second: what a stronger one does only says what it looks like."""
    made = lab("    afterpulsing: {probability: 0.6 %, lifetime: 40 ns}\n", light=900, side=4)
    path = begin(bench_of(made))
    taken(path, "add afterpulsing", {PROBABILITY: 0.002, LIFETIME: 80e-9})
    step = path.steps[0]
    assert step.jacobian  # it was faint
    for name, truth in (("probability", 0.006), ("lifetime", 40e-9)):
        value = step.values[name]
        assert value.low is not None and value.high is not None
        half = math.log(value.high / value.low) / 2 / 1.96
        assert abs(math.log(value.value / truth)) < 4 * half < 2.0


def test_an_end_of_the_range_that_the_data_leave_open_is_in_the_interval(lab, monkeypatch) -> None:
    """Of a shape; a strength's ends are seen by its slope."""
    delay = ("crosstalk", "delay")
    path = begin(bench_of(lab()))
    taken(path, "add crosstalk", {CROSSTALK: 0.02, delay: 1e-9}, fitted=False)
    step, replicates = path.steps[0], path.replicates
    step.coordinates = tuple(d for d in step.candidate.coordinates if d.key in path.values)
    told = {"probability": Value(0.02, 0.019, 0.021), "delay": Value(1e-9, 0.9e-9, 1.1e-9, "s")}
    step.values = dict(told)
    coordinate = next(d for d in step.candidate.shapes if d.key == delay)
    nothing = Signature({}, {}, {})
    worse = Signature({}, {}, dict.fromkeys(replicates.seen, 10.0))
    for low, high in ((nothing, worse), (worse, nothing), (worse, worse)):
        monkeypatch.setattr("spadmnist.inference.intervals.signatures", lambda *_, ends=(low, high), **__: list(ends))
        step.values = dict(told)
        open_ends(path)
        value = step.values["delay"]
        assert value.low == (coordinate.low if low is nothing else 0.9e-9)
        assert value.high == (coordinate.high if high is nothing else 1.1e-9)
        assert step.values["probability"] == told["probability"]


@pytest.mark.slow
def test_numbers_that_have_a_likelihood_get_their_intervals_from_it(lab) -> None:
    made = lab("    afterpulsing: {probability: 2 %, lifetime: 40 ns}\n", light=900)
    path = begin(bench_of(made))
    taken(path, "add afterpulsing", {PROBABILITY: 0.01, LIFETIME: 60e-9})
    sharpen(path, made[1])
    for name, truth in (("probability", 0.02), ("lifetime", 40e-9)):
        value = path.steps[0].values[name]
        assert value.method == "likelihood" and value.low is not None and value.high is not None
        wide = (value.high - value.low) / 2  # twice the interval of 95 %: 1e-4
        assert value.low - wide < truth < value.high + wide
        assert path.values["afterpulsing", name] == value.value
    # noise of the source has none
    other = begin(bench_of(lab()))
    taken(other, "add source_noise", {("source_noise", "contrast"): 0.1, ("source_noise", "coherence_time"): 1e-4})
    before = dict(other.steps[0].values)
    sharpen(other, lab()[1])
    assert other.steps[0].values == before


# --- levels ------------------------------------------------------------------------------------------------------


def test_the_recordings_of_a_model_reach_as_far_as_the_data() -> None:
    """Of few detections nothing is extrapolated, wherever chance puts them; of many, no farther than chance goes."""
    light = Light("flat", relative_uncertainty=0.02)
    capture = Capture("flat", "tr", light, None)  # type: ignore[arg-type]
    for mean in (30.0, 2000.0, 1e7):
        for total in (mean * 0.9, mean, mean * 1.08, mean + 3.5 * math.sqrt(mean), mean * 3):
            centre, half = levels_about(lambda level, m=mean: m * level, total, 1.0, capture, math.inf)
            assert abs(math.log(total / mean / centre)) <= half + 4 / math.sqrt(mean)
            assert abs(math.log(total / mean / centre)) <= half or mean > 6400
            assert half < 0.06 + 0.01 + 4 / math.sqrt(mean)
    # what chance may do is a matter of the model: the same recordings serve every measurement of it
    places = {levels_about(lambda level: 2000 * level, t, 1.0, capture, math.inf) for t in (1900, 2000, 2100)}
    assert len(places) == 1


# --- patterns and chance -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("joined", [False, True])
def test_p_values_of_values_that_differ(joined: bool) -> None:
    """Of 2000 right models: p < 1 % in at most 44, more once in a million; joined: all move together a little."""
    rng = np.random.default_rng(3)
    chances = []
    for _ in range(2000):
        values = rng.standard_normal((33, 16))
        if joined:
            values = values * np.exp(0.05 * rng.standard_normal((33, 1)))
        chances.append(p_of_spread(values[0], values[1:]))
    assert np.sum(np.array(chances) < 0.01) <= stats.binom.isf(laws.FALSE_ALARM, 2000, 0.01) == 44
    # and columns of which an oracle sees 5.7 sigma are seen in most of 200 arrays
    far = math.sqrt(5.7**2 / 16)
    shifted = [
        p_of_spread(rng.standard_normal(16) + far * rng.choice([-1, 1], 16), rng.standard_normal((32, 16)))
        for _ in range(200)
    ]
    assert np.mean(np.array(shifted) < 1e-2) > 0.6


def test_the_best_candidate_has_the_most_evidence(lab) -> None:
    """A pattern in a map comes before what explains more; of equals a map of pixels is the best."""
    replicates = bench_of(lab())
    maps: Any = {("dark_counts", "rate"): None}

    def trial(name: str, evidence: float, **more: Any) -> Trial:
        return Trial(change_of(replicates, name), {}, Signature({}, {}, {}), 0.0, 1.0, evidence=evidence, **more)

    map_, odd = trial("per_pixel dark_counts.rate", 90.0, maps=maps), trial("add blinking_dark_counts", 90.0)
    third, rows = trial("add crosstalk", 120.0), trial("add row_pattern", 20.0)

    def best(*fitted: Trial, pattern: Trial | None = None) -> Trial:
        return best_of(fitted, lambda one: one.evidence, pattern)

    assert best(odd, map_) is map_ and best(odd, map_, third) is third
    assert best(map_, rows, pattern=rows) is rows and best(rows, map_) is map_
    assert best(map_, pattern=rows) is map_  # it could not be fitted
    # in a tie a map is the first before random odd pixels, and before nothing else
    more = trial("add blinking_dark_counts", 95.0, chips=True)

    def within(margin: float, *fitted: Trial) -> Trial:
        return best_of(fitted, lambda one: one.evidence, margin=lambda most: margin)

    assert within(10.0, more, map_) is map_ and within(4.0, more, map_) is more
    assert within(10.0, replace(more, chips=False), map_) is not map_
    assert within(10.0, more, replace(rows, evidence=94.0)) is more


@pytest.mark.slow
def test_a_light_that_fluctuates_makes_squares_fall_and_has_no_evidence(lab) -> None:
    """The data are those of a steady light, which each of the fluctuating ones surrounds at some distance."""
    replicates = bench_of(lab(light=900, side=4), 32)
    evaluation = evaluate(replicates, {})
    values = {("source_noise", "contrast"): 0.2, ("source_noise", "coherence_time"): 2.0}
    sensors = evaluation.sensors.changed(values)
    (signature,) = signatures(replicates, evaluation, [sensors], Sampling(few=8, kept="sure"))
    assert isinstance(signature, Signature)
    one = Trial(change_of(replicates, "add source_noise"), values, signature, 0.0, 1.0, sensors)
    found = evidence_of(replicates, evaluation, one)
    assert one.evaluation is not None
    assert square(one.evaluation.residuals) < square(evaluation.residuals) and found < -100.0
    # what is faint changes no scatter, and is not simulated: the squares fall as its signature says
    faint = Trial(change_of(replicates, "add crosstalk"), {}, Signature({}, {}, {}), 17.0, 1.0, sensors, faint=True)
    assert evidence_of(replicates, evaluation, faint) == 17.0 and faint.evaluation is None


@pytest.mark.parametrize("law", ["normal", "scaled", "poisson", "exponential"])
def test_a_model_that_scatters_more_is_not_likelier_for_that(law: str) -> None:
    """Twice the exact logarithm of the likelihood ratio of 400 cells, one model scattering twice as much.

    It is -254 or 645 on average, with a spread of 21 or 85, of powers -155 or 245 with one of 20 or 40: none comes near
    0. Without the logarithm of the scatter it would be 300 of data of the narrower one.
    """
    rng = np.random.default_rng(11)
    cells, mean = 400, 900.0
    own = math.sqrt(mean) if law == "poisson" else 1.0

    def drawn(times: float, *size: int) -> np.ndarray:
        if law == "exponential":
            return times * mean * rng.exponential(size=(*size, cells))
        return mean + times * own * rng.standard_normal((*size, cells))

    def state_of(times: float, data: np.ndarray) -> Any:
        scale = np.ones(cells) if law == "scaled" else None
        kind = "normal" if law == "scaled" else law
        made = [Summary(x, kind, str, no_size, scale) for x in drawn(times, 64)]
        null = learn(made, np.full(64, mean))
        return SimpleNamespace(nulls={CELL: null}, residuals={CELL: null.judge(data, mean).residuals}, space=None)

    for truth in (1.0, 2.0):
        data = drawn(truth)
        z = (data - mean) / own
        exact = float(z @ z) * (1 - 1 / 4) - 2 * cells * math.log(2)
        if law == "exponential":
            exact = float(np.sum(data / mean)) - 2 * cells * math.log(2)
        trace = {CELL: np.ones(cells)}
        found = log_likelihood_ratio(state_of(1.0, data), state_of(2.0, data), trace)
        assert found == pytest.approx(exact, rel=0.25, abs=30), (law, truth)
        assert (found > 0) == (truth == 2.0)


def test_where_a_model_has_no_trace_chance_does_not_speak_for_it() -> None:
    """A thousand cells in which it does nothing happen to lie nearer to it; in the one where it does, data lie away."""
    null = SimpleNamespace(breadth=1.0, factor=1.0, law=Law(), replicate_squares=np.ones(32))
    now, there = (
        SimpleNamespace(
            nulls={CELL: null, OTHER: null}, residuals={CELL: np.array([x]), OTHER: np.full(1000, y)}, space=None
        )
        for x, y in ((1.0, 1.1), (3.0, 1.0))
    )
    trace = {CELL: np.array([2.0]), OTHER: np.full(1000, 0.01)}
    assert log_likelihood_ratio(now, there, trace) == pytest.approx(-8.0)  # type: ignore[arg-type]
    everywhere = {CELL: np.array([2.0]), OTHER: np.ones(1000)}
    assert log_likelihood_ratio(now, there, everywhere) == pytest.approx(210.0 - 8.0)  # type: ignore[arg-type]


BOOM = """from spadmnist import Effect, parameter


class Boom(Effect, stage="light"):
    "Fails."

    share = parameter(0.1, "", "share", bounds=(0, 1), off=0.0, search=(0.01, 0.9))

    def apply(self, rate, conditions):
        raise ValueError("inside")


class Nowhere(Effect, stage="light"):
    "Nobody knows where to look."

    share = parameter(0.1, "", "share", bounds=(0, 1), off=0.0)

    def apply(self, rate, conditions):
        return rate * (1 - self.share)
"""


def test_a_users_effect_that_cannot_be_tried_is_told(lab, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(Effect.registry, "classes", dict(Effect.registry.classes))
    monkeypatch.setattr(plugins, "_loaded", dict(plugins._loaded))
    file = tmp_path / "boom.py"
    file.write_text(BOOM)
    plugins.load_file(file)
    replicates = bench_of(lab())
    evaluation, said = evaluate(replicates, {}), []
    look = Scan(replicates, said.append)
    assert said == ["not tried: nowhere (none of its parameters says where to look for it; give one off= and search=)"]
    candidate = change_of(replicates, "add boom")
    for _ in range(2):
        assert not look.looked_at(evaluation, candidate, look.begun(evaluation, candidate))
    assert (
        len(said) == 2 and said[1].startswith("not tried: boom (") and "boom.py:10: the effect boom failed" in said[1]
    )


def test_beside_what_chance_makes_of_pixels_a_map_of_them_is_fitted(lab) -> None:
    replicates = bench_of(lab())
    nothing = Signature({}, {}, {})
    chance = Trial(change_of(replicates, "add blinking_dark_counts"), {}, nothing, 100.0, 1.0, chips=True)
    other = Trial(change_of(replicates, "add crosstalk"), {}, nothing, 90.0, 1.0)
    map_ = Trial(change_of(replicates, "per_pixel dark_counts.rate"), {}, nothing, 10.0, 1.0)
    map_ = replace(map_, maps={("dark_counts", "rate"): None})  # type: ignore[dict-item]
    assert worth_fitting([chance, other, map_]) == [other, chance, map_]
    assert worth_fitting([other, map_]) == [other]
    # and beside a map what chance makes, where there is something in it
    clear = replace(map_, fall=1000.0)
    assert worth_fitting([clear, other, chance]) == [clear, chance]
    assert worth_fitting([clear, replace(chance, fall=20.0)]) == [clear]
    # what its squares promise crowds nobody out: it may scatter more
    assert worth_fitting([replace(chance, fall=1e6), other, map_]) == [other, replace(chance, fall=1e6), map_]
    # there is always one to fit, or the search would look for the same for ever
    assert worth_fitting([replace(chance, fall=20.0)]) == [replace(chance, fall=20.0)] and worth_fitting([]) == []
    # where no check fails, squares of scores are compared, which no scatter makes larger
    dim = replace(chance, fall=14.0)
    assert worth_fitting([dim, replace(other, fall=4.0)], faint=True) == [dim]
    assert worth_fitting([dim, replace(map_, fall=4.0)], faint=True) == [dim, replace(map_, fall=4.0)]


def test_the_template_nearest_to_where_it_suits_is_looked_at_again(lab, monkeypatch) -> None:
    replicates = bench_of(lab())
    evaluation, look = evaluate(replicates, {}), quiet(replicates)
    candidate = change_of(replicates, "add crosstalk")
    nothing = Signature({}, {}, {"flat": 1.0})
    far, near = (
        Trial(candidate, {CROSSTALK: x}, nothing, gain, t) for x, gain, t in ((0.1, 50.0, 0.03), (0.004, 45.0, 0.8))
    )
    seen: list[Trial] = []
    monkeypatch.setattr(Scan, "simulated", lambda self, evaluation, tried, *_, **__: seen.extend(tried) or [])
    asked: list[float] = []
    monkeypatch.setattr(
        "spadmnist.inference.scan.map_trials_of", lambda scan, evaluation, values, least: asked.append(least) or []
    )
    look.again(evaluation, {}, [far, near])
    assert [one.values[CROSSTALK] for one in seen] == [pytest.approx(0.004 * max(0.8, 1.0), rel=0.3)]
    look.again(
        evaluation, {}, [far, replace(near, candidate=change_of(replicates, "add blinking_dark_counts"), chips=True)]
    )
    # of what is faint the trace decides which are looked at again, and how strong they are
    clear = replace(near, signature=Signature({}, {}, {"flat": 2.0}), fall=0.0)
    weak = replace(far, candidate=change_of(replicates, "add afterpulsing"), signature=Signature({}, {}, {"flat": 3.0}))
    traces = {id(clear.signature): 4.5, id(weak.signature): 1.0}
    monkeypatch.setattr(
        "spadmnist.inference.score_test.score_test",
        lambda replicates, evaluation, signature: ScoreTest(9.0, traces[id(signature)], np.zeros(16), 1.0, 15.0),
    )
    seen.clear()
    look.again(evaluation, {}, [weak, clear], faint=True)
    assert [one.candidate.name for one in seen] == ["add crosstalk"]
    # what hardly shows is simulated up to three times as strong, where nothing is plainly wrong
    dim = replace(near, signature=Signature({}, {}, {"flat": 0.1}), fall=45.0, times=0.8)
    traces[id(dim.signature)] = 4.5
    for faint, times in ((False, 1.0), (True, 3.0)):
        seen.clear()
        look.again(evaluation, {}, [dim], faint=faint)
        assert seen[0].values[CROSSTALK] == pytest.approx(0.004 * times)
    assert asked[:2] == [1e-3, 0.05]  # maps beside what chance makes of pixels are tried where they would not be alone


def test_a_faint_template_of_another_shape_is_looked_at_beside_a_strong_one(lab, monkeypatch) -> None:
    """Noise hides a part of what it would show at its best strength, so that the two are not comparable yet."""
    replicates = bench_of(lab())
    evaluation, look = evaluate(replicates, {}), quiet(replicates)
    candidate, delay = change_of(replicates, "add crosstalk"), ("crosstalk", "delay")
    nothing = Signature({}, {}, {"flat": 1.0})
    strong, faint, near = (
        Trial(candidate, {CROSSTALK: p, delay: t}, nothing, gain, times)
        for p, t, gain, times in ((0.0085, 3e-7, 74.0, 1.7), (7e-4, 8e-11, 50.0, 7.2), (7e-4, 2e-8, 49.0, 1.5))
    )
    seen: list[Trial] = []
    monkeypatch.setattr(Scan, "simulated", lambda self, evaluation, tried, *_, **__: seen.extend(tried) or [])
    monkeypatch.setattr("spadmnist.inference.scan.map_trials_of", lambda scan, evaluation, values, least: [])
    look.again(evaluation, {}, [strong, faint, near])
    assert [one.values[delay] for one in seen] == [3e-7, 8e-11]


def test_only_edges_are_followed_close_by(lab) -> None:
    """A slope of a drift that is known to 0.003 was told by what 0.02 do, of which chance hides nearly all."""
    replicates = bench_of(lab())
    drift, gate = (change_of(replicates, f"add {name}").strengths[0] for name in ("source_drift", "short_gate"))
    known = Value(0.5, 0.49, 0.51, "")
    steps = [SimpleNamespace(coordinates=(d,), values={d.parameter: known}) for d in (drift, gate)]
    path: Any = SimpleNamespace(steps=steps)
    assert list(edge_errors(path)) == [gate.key]
    fit: Any = SimpleNamespace(coordinates=(drift, gate), covariance=np.diag([0.01, 0.04]))
    assert edge_errors(path, fit) == {gate.key: pytest.approx(0.2)}


def test_a_number_that_a_step_fits_is_no_map(lab) -> None:
    """It cannot be both: a measurement of pixels whose dark counts blink ended with a fault of the program."""
    replicates = bench_of(lab())
    look, candidate = quiet(replicates), change_of(replicates, "add blinking_dark_counts")
    evaluation = evaluate(
        replicates, {("blinking_dark_counts", "amplitude"): 300.0, ("blinking_dark_counts", "fraction"): 0.1}
    )
    carrier = ("blinking_dark_counts", "amplitude")
    before = candidate_maps(look, evaluation)
    look.accepted.append(candidate)
    left = candidate_maps(look, evaluation)
    assert [c for c in before if c not in left] == [c for c in before if c.carrier == carrier] != []


def test_a_signed_bench_is_not_simulated_twice_where_there_is_no_sign(lab) -> None:
    replicates: Replicates = bench_of(lab())
    evaluation, look = evaluate(replicates, {}), quiet(replicates)
    before = replicates.simulations
    candidate = change_of(replicates, "add crosstalk")
    (one,) = look.looked_at(evaluation, candidate, [{CROSSTALK: 0.01}])
    assert one.signature.even is None and replicates.simulations - before == 2 * len(replicates.seen)


# --- whole numbers, templates, and candidates that are told apart by chance -------------------------------------


@pytest.mark.parametrize(("truth", "first"), [(4, 8), (64, 8), (1, 32), (5, 2)])
def test_a_whole_number_is_fitted_by_its_neighbours(truth: int, first: int) -> None:
    """The other number follows it along a narrow valley; from afar the valley's floor is not reached at once."""
    coordinate = Coordinate("bus", "queue", "", 1.0, 256.0, None, "count")

    def fit(values: dict[Any, Any]) -> Fit:
        queue = float(values[coordinate.key])
        square = 1000.0 + 40.0 * math.log(queue / truth) ** 2 * truth
        return Fit((), np.zeros(0), np.zeros((0, 0)), {}, {}, square, dict(values))

    found, ends = fit_whole_number(fit({coordinate.key: float(first)}), coordinate, fit)
    low, high = ends[coordinate.key]
    assert low <= truth <= high and abs(math.log(found.values[coordinate.key] / truth)) < 0.15
    assert low >= 1 and (low, high) == (round(low), round(high))
    if truth < 10:
        assert found.values[coordinate.key] == truth


@pytest.mark.parametrize(("dependent", "reach", "alone"), [(1.0, 0.45, True), (9.0, 0.8, False)])
def test_a_whole_number_that_was_fitted_from_afar_is_fitted_again(dependent: float, reach: float, alone: bool) -> None:
    """The time that suits 4 places is far from the one that suits 8; what is fitted in one go does not get there.

    Then 4 is known to be it, and the time with it; or where cells depend on each other 3 and 5 are not excluded, and
    what the time is with these is not either.
    """
    places = Coordinate("bus", "queue", "", 1.0, 256.0, None, "count")
    time = Coordinate("bus", "time", "s", 1e-9, 1e-6, None, "time")

    def best(queue: float) -> float:
        return 2.0 * math.log(queue)

    def fit(values: dict[Any, Any]) -> Fit:
        queue = float(values[places.key])
        to = best(queue) - math.log(values[time.key] / 1e-8)
        point = math.log(values[time.key]) + max(-reach, min(reach, to))
        left = best(queue) - (point - math.log(1e-8))
        square = 1000.0 + 500.0 * math.log(queue / 4) ** 2 + 400.0 * left**2
        jacobian = {("flat", "cells"): np.full((1, 1), 50.0)}
        covariance = np.full((1, 1), dependent / 2500)
        new = {**values, time.key: math.exp(point)}
        return Fit((time,), np.array([point]), covariance, {}, jacobian, square, new)

    first = fit({places.key: 8.0, time.key: 1e-8 * math.exp(best(8))})
    found, ends = fit_whole_number(first, places, fit)
    assert found.values[places.key] == 4 and found.values[time.key] == pytest.approx(1e-8 * math.exp(best(4)), rel=0.05)
    assert ends[places.key] == ((4, 4) if alone else (3, 5)) and (time.key in ends) != alone
    if not alone:
        low, high = ends[time.key]
        assert low < 1e-8 * math.exp(best(3)) < 1e-8 * math.exp(best(5)) < high
        assert low > 1e-8 * math.exp(best(3) - 0.3) and high < 1e-8 * math.exp(best(5) + 0.3)


def test_a_template_of_another_strength_does_not_hide_one_that_promises(lab) -> None:
    """What is known of a strong one is no reason not to look at a weak one again."""
    replicates = bench_of(lab())
    evaluation, look = evaluate(replicates, {}), quiet(replicates)
    candidate = change_of(replicates, "add crosstalk")
    strengths = (1e-3, 1e-1)
    tries = [(candidate, {CROSSTALK: x}) for x in strengths]
    cell = ("flat", "fine_intervals")
    like = Signature({cell: -evaluation.residuals[cell]}, {}, {})
    weak, strong = (
        Trial(candidate, v, m, 0.0, 1.0) for (_, v), m in zip(tries, (like, Signature({}, {}, {})), strict=True)
    )
    assert [t.values for t in still_valid(look, evaluation, tries, [strong], True)] == [strong.values]
    cells = len(evaluation.residuals[cell])
    evaluation.residuals[cell] = np.full(cells, 4.0)
    usual = np.maximum(evaluation.nulls[cell].expected(replicates.seen["flat"].total)[0], 1.0)
    weak.signature = Signature({cell: 4.0 * np.sqrt(usual)}, {}, {})
    weak.fall, _ = look.line_search(evaluation, weak.signature, weak.signed)
    assert weak.fall > 25
    assert still_valid(look, evaluation, tries, [weak, strong], True) == []


def test_a_time_is_tried_short_and_long(lab) -> None:
    """Part of what a long one does is not what a short one does; of what is no time, one strength is enough."""
    replicates = bench_of(lab())
    recovery = change_of(replicates, "add slow_recovery").strengths[0]
    usual, short = first_strengths(recovery)
    assert usual == pytest.approx(math.sqrt(recovery.low * recovery.high)) and recovery.low < short < usual / 5
    (crosstalk,) = first_strengths(change_of(replicates, "add crosstalk").strengths[0])
    assert 0 < crosstalk < 1


@pytest.mark.slow
def test_an_edge_that_is_thought_to_be_far_off_is_tried_where_it_was_seen_too(lab) -> None:
    """What moves an edge does not grow in proportion: a line search may lead to where nothing of it is left."""
    sensor, data = lab("    slow_recovery: {time_constant: 5 ns}\n", light=900, side=4)
    path = begin(bench_of((sensor, data)))
    key = ("slow_recovery", "time_constant")
    seen = given(path, "add slow_recovery", {key: 5e-9}, fitted=False)
    far = replace(seen, fall=1000.0, times=30.0)
    (found,) = path.scan.again(path.evaluation, {}, [far])
    assert found.values[key] == pytest.approx(5e-9) and found.fall > 25
    # near by it goes where it is led
    (found,) = path.scan.again(path.evaluation, {}, [replace(seen, fall=1000.0, times=1.2)])
    assert found.values[key] == pytest.approx(6e-9)


# --- another measurement of the plan -----------------------------------------------------------------------------


@pytest.mark.slow
def test_another_measurement_of_the_plan_finds_what_the_first_one_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What candidates of the stated model are tried first does not depend on the data. A cache changes no answer."""
    lab = labs(tmp_path)

    def looked(seed: int, cache: str) -> tuple[list[tuple[str, float]], float, float]:
        monkeypatch.setenv("SPADMNIST_CACHE", str(tmp_path / cache))
        replicates = bench_of(lab("    afterpulsing: {probability: 1 %, lifetime: 30 ns}\n", seed=seed), 16)
        path = begin(replicates)
        before = replicates.budget.spent, replicates.budget.remembered
        found = [(one.candidate.name, one.fall) for one in path.scan.scan(path.evaluation)]
        return found, replicates.budget.spent - before[0], replicates.budget.remembered - before[1]

    _, work, remembered = looked(1, "kept")
    assert work > 0 and remembered == 0
    found, work, remembered = looked(2, "kept")
    assert remembered > 0.8 * work
    assert looked(2, "anew") == (found, work, 0.0)
    assert not list((tmp_path / "kept").rglob("*.part"))
