"""What a search does with a candidate between its first look and its place in the model."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from labs import CROSSTALK, DURATION, bench_of, change_of, given, quiet

from spadmnist.inference.candidates import candidates, templates, with_values
from spadmnist.inference.elimination import drop_needless
from spadmnist.inference.evaluation import evaluate, square
from spadmnist.inference.evidence import evaluation_of, optimism
from spadmnist.inference.gauss_newton import Fit
from spadmnist.inference.joint_fit import variances_by_pixels
from spadmnist.inference.map_trials import patterns_first
from spadmnist.inference.mixed_model import PatternEvidence
from spadmnist.inference.model_path import ModelPath, accept, begin
from spadmnist.inference.replicates import TOTALS
from spadmnist.inference.results import Step
from spadmnist.inference.scan import Scan
from spadmnist.inference.signature import IGNORED, Signature, captures_showing, residuals_at
from spadmnist.inference.trial import Trial
from spadmnist.inference.trial_fits import fails_own_checks, fit_by_probes

NOTHING = Signature({}, {}, {})
SERVICE = ("readout_loss", "service_time")


def test_a_scan_tries_weaker_edges_beside_one_that_drowns_all_else(lab, monkeypatch) -> None:
    replicates = bench_of(lab())
    evaluation, look = evaluate(replicates, {}), quiet(replicates)
    candidate = change_of(replicates, "add readout_loss")
    least = candidate.strengths[0].low
    first = {SERVICE: 1e4 * least, ("readout_loss", "queue"): 8.0}

    def looked_at(self: Scan, evaluation: Any, tries: Any, only: Any = ()) -> list[Trial]:
        return [Trial(one, values, Signature({}, {}, {"size": values[SERVICE]}), 1.0, 1.0) for one, values in tries]

    monkeypatch.setattr(replicates, "candidates", lambda sensor: [candidate])
    monkeypatch.setattr(Scan, "begun", lambda self, evaluation, candidate: [first])
    monkeypatch.setattr(Scan, "only_rates", lambda self, evaluation: False)
    monkeypatch.setattr(Scan, "_looked_at", looked_at)
    # 600 standard deviations, then 60, which are enough to see and few enough to tell
    monkeypatch.setattr(
        "spadmnist.inference.scan.size_of",
        lambda replicates, evaluation, signature: 600.0 * math.sqrt(signature.logs["size"] / first[SERVICE]),
    )
    found = sorted(one.values[SERVICE] / least for one in look.scan(evaluation))
    assert found == [pytest.approx(1e2), pytest.approx(1e4)]


def test_an_edge_is_probed_to_some_ten_picoseconds(monkeypatch) -> None:
    """A cusp: no slope leads to it, and a probe that is three times as far as it misses it."""
    truth = 50e-9
    coordinate = SimpleNamespace(
        key=DURATION, log=True, lacks=False, kind="edge", off=50e-9, coordinate=math.log, value=math.exp
    )

    def cost(values: dict[Any, float]) -> dict[Any, np.ndarray]:
        return {("flat", "edge"): np.array([math.sqrt(2e4 * abs(math.log(values[DURATION] / truth)))])}

    monkeypatch.setattr(
        "spadmnist.inference.trial_fits.signatures", lambda replicates, evaluation, models, sampling: models
    )
    monkeypatch.setattr(
        "spadmnist.inference.trial_fits.residuals_at", lambda replicates, evaluation, values: cost(values)
    )
    evaluation: Any = SimpleNamespace(sensors=SimpleNamespace(changed=lambda values, phases, chips: values))
    one: Any = SimpleNamespace(candidate=SimpleNamespace(coordinates=(coordinate,), shapes=()), phases={}, chips=False)
    start = {DURATION: truth * math.exp(0.0022)}
    square = float(cost(start)["flat", "edge"][0]) ** 2
    found = Fit((coordinate,), np.log([start[DURATION]]), np.eye(1), {}, {}, square, start)  # type: ignore[arg-type]
    found = fit_by_probes(None, evaluation, one, found, [])  # type: ignore[arg-type]
    assert abs(found.values[DURATION] - truth) < 10e-12
    assert found.covariance[0, 0] < 1e-6


@pytest.mark.parametrize(("size", "asked"), [(0.0, False), (0.5, False), (3.0, True)])
def test_probes_are_for_checks_that_the_candidate_moves(lab, monkeypatch, size: float, asked: bool) -> None:
    """What fails is where the candidate leaves no trace: no number of it would mend that."""
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    cell = "flat", "spectrum"
    residuals = {**evaluation.residuals, cell: evaluation.residuals[cell] + 1e3}
    trace = {c: np.zeros(len(z)) for c, z in evaluation.residuals.items()}
    trace[cell][0] = size
    trace["dark", "intervals"][:] = 10.0  # where nothing fails
    monkeypatch.setattr("spadmnist.inference.trial_fits.template_of", lambda replicates, evaluation, signature: trace)
    one = Trial(change_of(replicates, "add crosstalk"), {}, NOTHING, 0.0, 1.0)
    found: Any = SimpleNamespace(residuals=residuals)
    assert fails_own_checks(replicates, evaluation, one, found, ["dark", "flat"]) == asked
    trace[cell][0], trace[TOTALS][:] = 0.0, size
    found.residuals = {**evaluation.residuals, TOTALS: np.full(len(evaluation.residuals[TOTALS]), 20.0)}
    assert fails_own_checks(replicates, evaluation, one, found, ["dark", "flat"]) == asked


def test_captures_that_show_hardly_anything_of_it_are_left_out() -> None:
    """By their share of a faint trace, and by their size beside a strong one; totals are known anyway."""
    trace = {("dark", "intervals"): np.array([10.0, 0.0]), ("flat", "intervals"): np.array([0.5])}
    trace[TOTALS] = np.full(2, 9.0)
    few = IGNORED
    assert captures_showing(trace, *few) == ["dark"]
    trace["flat", "intervals"][0] = 1.1
    assert captures_showing(trace, *few) == ["flat", "dark"]
    trace["flat", "intervals"][0], trace["dark", "intervals"][1] = 2.1, 1000.0
    assert captures_showing(trace, *few) == ["flat", "dark"]
    trace["flat", "intervals"][0] = 1.9
    assert captures_showing(trace, *few) == ["dark"]


def test_a_pattern_that_is_first_gives_way_to_one_that_says_more_with_fewer_numbers(lab, monkeypatch) -> None:
    """Rows follow a gradient along the columns, each with a number of its own."""
    replicates = bench_of(lab())
    evaluation, look = evaluate(replicates, {}), quiet(replicates)
    rows, gradient, map_ = (
        Trial(change_of(replicates, name), {}, NOTHING, gain, 1.0)
        for name, gain in (
            ("add row_pattern", 900.0),
            ("add illumination_gradient", 800.0),
            ("per_pixel detection.pdp", 700.0),
        )
    )
    map_.maps = {map_.candidate.carrier: None}  # type: ignore[dict-item]
    monkeypatch.setattr("spadmnist.inference.pixel_maps.acts_on_light", lambda sensor, candidate: True)
    told = {
        rows.candidate.name: PatternEvidence(40.0, 40.0, 0.0),
        gradient.candidate.name: PatternEvidence(60.0, 60.0, 0.0),
    }
    monkeypatch.setattr("spadmnist.inference.pixel_maps.evidence_of_patterns", lambda free, designs: told)
    assert patterns_first(look, evaluation, [rows, gradient, map_]) == [gradient, rows, map_]
    told[gradient.candidate.name] = PatternEvidence(3.0, 3.0, 0.0)  # pixels that differ by chance have as much of it
    assert patterns_first(look, evaluation, [rows, gradient, map_]) == [rows, map_]
    other = Trial(change_of(replicates, "add crosstalk"), {}, NOTHING, 1000.0, 1.0)
    assert patterns_first(look, evaluation, [other, rows, map_]) == [other, rows, map_]
    # a little of rows is none where the map itself is far beyond chance: a few odd pixels
    told[rows.candidate.name], map_.p_value = PatternEvidence(8.0, 8.0, 0.0), 6e-10
    assert patterns_first(look, evaluation, [rows, gradient, map_]) == [map_]
    map_.p_value = 1e-4  # a map that rows make has no more evidence than they
    assert patterns_first(look, evaluation, [rows, gradient, map_]) == [rows, map_]
    told[rows.candidate.name], map_.p_value = PatternEvidence(18.0, 18.0, 0.0), 1e-30  # pixels that differ, and rows
    assert patterns_first(look, evaluation, [rows, gradient, map_]) == [rows, map_]


@pytest.mark.parametrize(("without", "kept"), [(0, False), (1, False), (2, True)])
def test_a_map_goes_unless_a_check_fails_without_it(lab, monkeypatch, without: int, kept: bool) -> None:
    path = begin(bench_of(lab()))
    map_, last = (
        Step(change_of(path.replicates, name), {}, 1.0, 9.0, "")
        for name in ("per_pixel dark_counts.rate", "add blinking_dark_counts")
    )
    path.steps, path.scan.accepted = [map_, last], [map_.candidate, last.candidate]
    monkeypatch.setattr("spadmnist.inference.elimination.fit_all", lambda path, known=None: None)
    monkeypatch.setattr(
        ModelPath, "failed", property(lambda self: ["a check"] * (1 if map_ in self.steps else without))
    )
    drop_needless(path)
    assert path.steps == ([map_, last] if kept else [last])
    assert path.scan.accepted == [step.candidate for step in path.steps]
    assert (path.ladder[-1].model == "start") == kept


@pytest.mark.slow
def test_a_model_that_was_simulated_to_be_weighed_is_not_simulated_again(lab) -> None:
    """The same answer, by fewer recordings."""
    made = lab("    crosstalk: {probability: 3 %}\n")
    courses = [begin(bench_of(made)) for _ in range(2)]
    for path, weighed in zip(courses, (False, True), strict=True):
        one = given(path, "add crosstalk", {CROSSTALK: 0.03}, fitted=True)
        before = path.replicates.simulations
        if weighed:
            evaluation_of(path.replicates, path.evaluation, one)
            assert path.replicates.simulations - before == 2 * 16
            before = path.replicates.simulations
        accept(path, one, 1.0)
        path.replicates.simulations -= before
    plain, known = courses
    assert plain.replicates.simulations - known.replicates.simulations == 2 * 16
    assert known.values == plain.values and known.steps[0].values == plain.steps[0].values
    assert known.evaluation.values == plain.evaluation.values and known.misfit == plain.misfit
    for cell, z in plain.evaluation.residuals.items():
        assert np.array_equal(known.evaluation.residuals[cell], z)


def test_numbers_that_were_fitted_since_do_not_move_twice(lab, monkeypatch) -> None:
    """The last step of a number is not simulated: a model that was has it where it was before that step."""
    path = begin(bench_of(lab()))
    before = path.evaluation = replace(path.evaluation, values={CROSSTALK: 0.02})
    path.values = {CROSSTALK: 0.025}
    duration = change_of(path.replicates, "set dead_time.duration")
    one = Trial(duration, {DURATION: 60e-9}, NOTHING, 20.0, 1.0, before.sensors)
    seen = []
    monkeypatch.setattr(
        "spadmnist.inference.model_path.fit_all", lambda path, fit, known, *_, **__: seen.append((path.values, known))
    )
    accept(path, replace(one, maps={}), 1.0)  # the maps are fitted anew, so that the model is simulated anew
    path.values, path.steps, path.scan.accepted = {CROSSTALK: 0.025}, [], []
    accept(path, replace(one, evaluation=before), 1.0)
    assert seen == [
        ({CROSSTALK: 0.025, DURATION: 60e-9}, None),
        ({CROSSTALK: 0.02, DURATION: 60e-9}, before),
    ]


def test_a_look_at_all_captures_is_one_at_those_that_were_left_out(lab, monkeypatch) -> None:
    """What is known of some captures is kept, what the others show is added; of totals alone nothing is known."""
    replicates = bench_of(lab())
    evaluation, look = evaluate(replicates, {}), quiet(replicates)
    candidate = change_of(replicates, "add crosstalk")
    monkeypatch.setattr(replicates, "candidates", lambda sensor: [candidate])
    monkeypatch.setattr(Scan, "begun", lambda self, evaluation, candidate: [{CROSSTALK: 0.05}])
    flat, dark = ("flat", "neighbours"), ("dark", "neighbours")
    size = len(evaluation.residuals[flat])
    known = Trial(candidate, {CROSSTALK: 0.05}, Signature({flat: np.full(size, 3.0)}, {}, {}), 0.0, 1.0, seen={"flat"})
    asked: list[Any] = []

    def simulated(self: Scan, evaluation: Any, tried: Any, few: int = 2, only: Any = (), **_: Any) -> list[Trial]:
        asked.append(list(only))
        for one in tried:
            one.signature = Signature(
                {cell: np.full(size, 7.0) for cell in (flat, dark)}, {}, {"flat": 1.0, "dark": 2.0}
            )
        return list(tried)

    monkeypatch.setattr(Scan, "simulated", simulated)
    monkeypatch.setattr(Scan, "_raised", lambda self, evaluation, tried, some: tried)
    monkeypatch.setattr(Scan, "_lowered", lambda self, evaluation, tried, some: [])
    (one,) = (t for t in look.scan(evaluation, everywhere=True, known=[known]))
    assert [only for only in asked if only] == [["dark"]]
    assert one.signature.shifts[flat][0] == 3.0 and one.signature.shifts[dark][0] == 7.0
    assert one.signature.logs == {"dark": 2.0} and one.seen == {"flat", "dark"}
    asked.clear()
    totals = replace(known, signature=Signature({}, {}, {"flat": 0.1, "dark": 0.1}), seen=set())
    (one,) = look.scan(evaluation, everywhere=True, known=[totals])
    assert [] in asked and one.signature.shifts[flat][0] == 7.0


def test_a_gradient_beside_pixels_that_differ_is_known_no_better_than_they_allow(lab) -> None:
    """N of them that differ by sigma have a slope of sigma / root(sum u^2) of their own."""
    path = begin(bench_of(lab(side=8)))
    gradient, map_ = (change_of(path.replicates, n) for n in ("add illumination_gradient", "per_pixel detection.pdp"))
    x, y = ("illumination_gradient", "x"), ("illumination_gradient", "y")
    path.values = {x: 0.05, y: 0.0}
    coordinates = tuple(d for d in gradient.strengths if d.key in (x, y))
    step = Step(gradient, {}, 1.0, 9.0, "", coordinates=coordinates)
    pixels = np.arange(64)
    assert map_.carrier is not None
    maps: Any = {map_.carrier: SimpleNamespace(sigma=0.02)}
    assert not variances_by_pixels(path, step, maps).any()  # no map is held
    path.scan.accepted = [gradient, map_]
    u = (pixels % 8 - 3.5) / 7
    span = path.replicates.start.layout.centred[:, 0]
    assert np.ptp(span) == pytest.approx(np.ptp(u), rel=0.2)
    found = np.sqrt(variances_by_pixels(path, step, maps))
    assert found == pytest.approx(np.full(2, 0.02 / math.sqrt(float(span @ span))), rel=0.1)
    other = Step(change_of(path.replicates, "add crosstalk"), {}, 1.0, 9.0, "", coordinates=coordinates)
    assert not variances_by_pixels(path, other, maps).any()


def test_what_is_fitted_is_looked_at_everywhere(lab, monkeypatch) -> None:
    """Also where its first values did nothing, so that nobody looked there while it was fitted."""
    path = begin(bench_of(lab(dead=55)))
    replicates, evaluation = path.replicates, path.evaluation
    monkeypatch.setattr("spadmnist.inference.trial_fits.captures_informing", lambda *_: ["dark"])
    one = given(path, "set dead_time.duration", {DURATION: 55e-9}, True)
    assert one.there is not None and one.fit is not None and one.residuals is not None
    assert ("flat", "edge_intervals") in one.there.shifts
    again = residuals_at(replicates, evaluation, one.there)
    for cell, z in again.items():
        np.testing.assert_array_equal(one.residuals[cell], z)
    assert one.fit.square == pytest.approx(square(again))
    assert one.fall == pytest.approx(square(evaluation.residuals) - square(again))
    assert optimism(one) == pytest.approx(2.0)  # of one number


@pytest.mark.parametrize(("stated", "tried"), [(4, [2.0, 6.0]), (2, [1.0, 3.0]), (1, [2.0])])
def test_a_stated_whole_number_is_tried_at_other_whole_numbers(lab, stated: int, tried: list[float]) -> None:
    key = ("readout_loss", "queue")
    sensor, _ = lab()
    values = {("readout_loss", "service_time"): 1e-7, key: stated}
    candidate = next(c for c in candidates(with_values(sensor, values)) if c.name == "set readout_loss.queue")
    assert [template[key] for template in templates(candidate)] == tried
    (coordinate,) = candidate.coordinates
    assert coordinate.whole
    assert all(coordinate.scaled(tried[-1], x) == round(coordinate.scaled(tried[-1], x)) for x in (0.2, 0.7, 1.6))


@pytest.mark.slow
def test_a_stated_queue_that_is_another_one_is_found(lab) -> None:
    """It has no slope, and there is no other number beside it."""
    sensor, data = lab("    readout_loss: {service_time: 100 ns, queue: 2}\n", light=1000)
    stated = with_values(sensor, {("readout_loss", "service_time"): 1e-7, ("readout_loss", "queue"): 4})
    path = begin(bench_of((stated, data)))
    one = given(path, "set readout_loss.queue", {("readout_loss", "queue"): 3.0}, fitted=True)
    assert one.values == {("readout_loss", "queue"): 2.0}
    assert one.fall > 100
    accept(path, one, 10.0)
    assert path.steps[0].values["queue"].value == 2
