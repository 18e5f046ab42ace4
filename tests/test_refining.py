"""What a search does with a candidate between its first look and its place in the model."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tinylab import CROSSTALK, DURATION, bench_of, change_of, given, quiet

from spadmnist.criticism import candidates, fit, refining, search, settling
from spadmnist.criticism import course as course_of
from spadmnist.criticism.answer import Step
from spadmnist.criticism.candidates import with_values
from spadmnist.criticism.fit import RATES, Moved
from spadmnist.criticism.search import Search
from spadmnist.criticism.showing import captures_showing
from spadmnist.criticism.tried import Tried

NOTHING = Moved({}, {}, {})
SERVICE = ("readout_loss", "service_time")


def test_a_scan_tries_weaker_edges_beside_one_that_drowns_all_else(lab, monkeypatch) -> None:
    bench = bench_of(lab())
    state, look = bench.state({}), quiet(bench)
    change = change_of(bench, "add readout_loss")
    least = change.strengths[0].low
    first = {SERVICE: 1e4 * least, ("readout_loss", "queue"): 8.0}

    def looked_at(self: Search, state: Any, tries: Any, only: Any = ()) -> list[Tried]:
        return [Tried(one, values, Moved({}, {}, {"size": values[SERVICE]}), 1.0, 1.0) for one, values in tries]

    monkeypatch.setattr(bench, "changes", lambda sensor: [change])
    monkeypatch.setattr(Search, "begun", lambda self, state, change: [first])
    monkeypatch.setattr(Search, "only_rates", lambda self, state: False)
    monkeypatch.setattr(Search, "_looked_at", looked_at)
    # 600 standard deviations, then 60, which are enough to see and few enough to tell
    monkeypatch.setattr(bench, "size", lambda state, moved: 600.0 * math.sqrt(moved.logs["size"] / first[SERVICE]))
    found = sorted(one.values[SERVICE] / least for one in look.scan(state))
    assert found == [pytest.approx(1e2), pytest.approx(1e4)]


def test_an_edge_is_probed_to_some_ten_picoseconds() -> None:
    """A cusp: no slope leads to it, and a probe that is three times as far as it misses it."""
    truth = 50e-9
    dial = SimpleNamespace(
        key=DURATION, log=True, lacks=False, unit="s", off=50e-9, coordinate=math.log, value=math.exp
    )

    def cost(values: dict[Any, float]) -> dict[Any, np.ndarray]:
        return {("flat", "edge"): np.array([math.sqrt(2e4 * abs(math.log(values[DURATION] / truth)))])}

    bench: Any = SimpleNamespace(
        moved=lambda state, models, few, only: models, residuals=lambda state, moved: cost(moved)
    )
    state: Any = SimpleNamespace(sensors=SimpleNamespace(changed=lambda values, phases, chips: values))
    one: Any = SimpleNamespace(change=SimpleNamespace(dials=(dial,), shapes=()), phases={}, chips=False)
    start = {DURATION: truth * math.exp(0.0022)}
    square = float(cost(start)["flat", "edge"][0]) ** 2
    found = settling.Settled((dial,), np.log([start[DURATION]]), np.eye(1), {}, {}, square, start)  # type: ignore[arg-type]
    found = refining._probed(bench, state, one, found, [])
    assert abs(found.values[DURATION] - truth) < 10e-12
    assert found.covariance[0, 0] < 1e-6


@pytest.mark.parametrize(("size", "asked"), [(0.0, False), (0.5, False), (3.0, True)])
def test_probes_are_for_checks_that_the_candidate_moves(lab, monkeypatch, size: float, asked: bool) -> None:
    """What fails is where the candidate leaves no trace: no number of it would mend that."""
    bench = bench_of(lab())
    state = bench.state({})
    cell = "flat", "spectrum"
    residuals = {**state.residuals, cell: state.residuals[cell] + 1e3}
    trace = {c: np.zeros(len(z)) for c, z in state.residuals.items()}
    trace[cell][0] = size
    trace["dark", "intervals"][:] = 10.0  # where nothing fails
    monkeypatch.setattr(bench, "template", lambda state, moved: trace)
    one = Tried(change_of(bench, "add crosstalk"), {}, NOTHING, 0.0, 1.0)
    found: Any = SimpleNamespace(residuals=residuals)
    assert refining._fails_its_own(bench, state, one, found) == asked
    trace[cell][0], trace[RATES][:] = 0.0, size
    found.residuals = {**state.residuals, RATES: np.full(len(state.residuals[RATES]), 20.0)}
    assert refining._fails_its_own(bench, state, one, found) == asked


def test_captures_that_show_hardly_anything_of_it_are_left_out() -> None:
    """By their share of a faint trace, and by their size beside a strong one; totals are known anyway."""
    trace = {("dark", "intervals"): np.array([10.0, 0.0]), ("flat", "intervals"): np.array([0.5])}
    trace[RATES] = np.full(2, 9.0)
    few = refining.UNSEEN
    assert captures_showing(trace, *few) == ["dark"]
    trace["flat", "intervals"][0] = 1.1
    assert captures_showing(trace, *few) == ["flat", "dark"]
    trace["flat", "intervals"][0], trace["dark", "intervals"][1] = 2.1, 1000.0
    assert captures_showing(trace, *few) == ["flat", "dark"]
    trace["flat", "intervals"][0] = 1.9
    assert captures_showing(trace, *few) == ["dark"]


def test_a_pattern_that_is_first_gives_way_to_one_that_says_more_with_fewer_numbers(lab, monkeypatch) -> None:
    """Rows follow a gradient along the columns, each with a number of its own."""
    bench = bench_of(lab())
    state, look = bench.state({}), quiet(bench)
    rows, gradient, map_ = (
        Tried(change_of(bench, name), {}, NOTHING, gain, 1.0)
        for name, gain in (
            ("add row_pattern", 900.0),
            ("add illumination_gradient", 800.0),
            ("per_pixel detection.pdp", 700.0),
        )
    )
    map_.maps = {map_.change.carrier: None}  # type: ignore[dict-item]
    monkeypatch.setattr(search.mapping, "bench_light_only", lambda sensor, change: True)
    told = {rows.change.name: (1e-9, 40.0), gradient.change.name: (1e-9, 10.0)}
    monkeypatch.setattr(search.mapping, "patterned", lambda free, designs: told)
    assert look.structured(state, [rows, gradient, map_]) == [gradient, rows, map_]
    told[gradient.change.name] = (0.5, 10.0)  # it does not stand out of the map's scatter
    assert look.structured(state, [rows, gradient, map_]) == [rows, map_]
    other = Tried(change_of(bench, "add crosstalk"), {}, NOTHING, 1000.0, 1.0)
    assert look.structured(state, [other, rows, map_]) == [other, rows, map_]
    # what one map in a thousand has of rows is none where the map itself is far beyond chance: a few odd pixels
    told[rows.change.name], map_.chance = (9e-4, 40.0), 6e-10
    assert look.structured(state, [rows, gradient, map_]) == [map_]
    map_.chance = 1e-4  # a map that rows make is no more likely than they
    assert look.structured(state, [rows, gradient, map_]) == [rows, map_]
    told[rows.change.name], map_.chance = (1e-5, 40.0), 1e-30  # pixels that differ, and rows
    assert look.structured(state, [rows, gradient, map_]) == [rows, map_]


@pytest.mark.parametrize(("without", "kept"), [(0, False), (1, False), (2, True)])
def test_a_map_goes_unless_a_check_fails_without_it(lab, monkeypatch, without: int, kept: bool) -> None:
    course = course_of.begun(bench_of(lab()))
    map_, last = (
        Step(change_of(course.bench, name), {}, 1.0, 9.0, "")
        for name in ("per_pixel dark_counts.rate", "add blinking_dark_counts")
    )
    course.steps, course.search.accepted = [map_, last], [map_.change, last.change]
    monkeypatch.setattr(course_of, "settle_all", lambda course: None)
    monkeypatch.setattr(
        course_of.Course, "failed", property(lambda self: ["a check"] * (1 if map_ in self.steps else without))
    )
    course_of.drop_needless(course)
    assert course.steps == ([map_, last] if kept else [last])
    assert course.search.accepted == [step.change for step in course.steps]
    assert (course.ladder[-1].model == "start") == kept


@pytest.mark.slow
def test_a_model_that_was_simulated_to_be_weighed_is_not_simulated_again(lab) -> None:
    """The same answer, by fewer recordings."""
    made = lab("    crosstalk: {probability: 3 %}\n")
    courses = [course_of.begun(bench_of(made)) for _ in range(2)]
    for course, weighed in zip(courses, (False, True), strict=True):
        one = given(course, "add crosstalk", {CROSSTALK: 0.03}, settle=True)
        before = course.bench.simulations
        if weighed:
            refining.state_of(course.bench, one)
            assert course.bench.simulations - before == 2 * 16
            before = course.bench.simulations
        course_of.accept(course, one, 1.0)
        course.bench.simulations -= before
    plain, known = courses
    assert plain.bench.simulations - known.bench.simulations == 2 * 16
    assert known.values == plain.values and known.steps[0].values == plain.steps[0].values
    assert known.state.values == plain.state.values and known.misfit == plain.misfit
    for cell, z in plain.state.residuals.items():
        assert np.array_equal(known.state.residuals[cell], z)


def test_numbers_that_were_settled_since_do_not_move_twice(lab, monkeypatch) -> None:
    """The last step of a number is not simulated: a model that was has it where it was before that step."""
    course = course_of.begun(bench_of(lab()))
    before = course.state = replace(course.state, values={CROSSTALK: 0.02})
    course.values = {CROSSTALK: 0.025}
    duration = change_of(course.bench, "set dead_time.duration")
    one = Tried(duration, {DURATION: 60e-9}, NOTHING, 20.0, 1.0, before.sensors)
    seen = []
    monkeypatch.setattr(course_of, "settle_all", lambda course, settled, known: seen.append((course.values, known)))
    course_of.accept(course, one, 1.0)
    course.values, course.steps, course.search.accepted = {CROSSTALK: 0.025}, [], []
    course_of.accept(course, replace(one, state=before), 1.0)
    assert seen == [
        ({CROSSTALK: 0.025, DURATION: 60e-9}, None),
        ({CROSSTALK: 0.02, DURATION: 60e-9}, before),
    ]


def test_a_look_at_all_captures_is_one_at_those_that_were_left_out(lab, monkeypatch) -> None:
    """What is known of some captures is kept, what the others show is added; of totals alone nothing is known."""
    bench = bench_of(lab())
    state, look = bench.state({}), quiet(bench)
    change = change_of(bench, "add crosstalk")
    monkeypatch.setattr(bench, "changes", lambda sensor: [change])
    monkeypatch.setattr(Search, "begun", lambda self, state, change: [{CROSSTALK: 0.05}])
    flat, dark = ("flat", "neighbours"), ("dark", "neighbours")
    size = len(state.residuals[flat])
    known = Tried(change, {CROSSTALK: 0.05}, Moved({flat: np.full(size, 3.0)}, {}, {}), 0.0, 1.0, seen={"flat"})
    asked: list[Any] = []

    def simulated(self: Search, state: Any, tried: Any, few: int, only: Any = ()) -> list[Tried]:
        asked.append(list(only))
        for one in tried:
            one.moved = Moved({cell: np.full(size, 7.0) for cell in (flat, dark)}, {}, {"flat": 1.0, "dark": 2.0})
        return list(tried)

    monkeypatch.setattr(Search, "_simulated", simulated)
    monkeypatch.setattr(Search, "_raised", lambda self, state, tried, some: tried)
    monkeypatch.setattr(Search, "_lowered", lambda self, state, tried, some: [])
    (one,) = (t for t in look.scan(state, everywhere=True, known=[known]))
    assert [only for only in asked if only] == [["dark"]]
    assert one.moved.shifts[flat][0] == 3.0 and one.moved.shifts[dark][0] == 7.0
    assert one.moved.logs == {"dark": 2.0} and one.seen == {"flat", "dark"}
    asked.clear()
    totals = replace(known, moved=Moved({}, {}, {"flat": 0.1, "dark": 0.1}), seen=set())
    (one,) = look.scan(state, everywhere=True, known=[totals])
    assert [] in asked and one.moved.shifts[flat][0] == 7.0


def test_a_gradient_beside_pixels_that_differ_is_known_no_better_than_they_allow(lab) -> None:
    """N of them that differ by sigma have a slope of sigma / root(sum u^2) of their own."""
    course = course_of.begun(bench_of(lab(side=8)))
    gradient, map_ = (change_of(course.bench, n) for n in ("add illumination_gradient", "per_pixel detection.pdp"))
    x, y = ("illumination_gradient", "x"), ("illumination_gradient", "y")
    course.values = {x: 0.05, y: 0.0}
    dials = tuple(d for d in gradient.strengths if d.key in (x, y))
    step = Step(gradient, {}, 1.0, 9.0, "", dials=dials)
    pixels = np.arange(64)
    assert map_.carrier is not None
    maps: Any = {map_.carrier: SimpleNamespace(sigma=0.02)}
    assert not course_of._of_pixels(course, step, maps).any()  # no map is held
    course.search.accepted = [gradient, map_]
    u = (pixels % 8 - 3.5) / 7
    span = course.bench.start.layout.centred[:, 0]
    assert np.ptp(span) == pytest.approx(np.ptp(u), rel=0.2)
    found = np.sqrt(course_of._of_pixels(course, step, maps))
    assert found == pytest.approx(np.full(2, 0.02 / math.sqrt(float(span @ span))), rel=0.1)
    other = Step(change_of(course.bench, "add crosstalk"), {}, 1.0, 9.0, "", dials=dials)
    assert not course_of._of_pixels(course, other, maps).any()


def test_what_is_settled_is_looked_at_everywhere(lab, monkeypatch) -> None:
    """Also where its first values did nothing, so that nobody looked there while it was settled."""
    course = course_of.begun(bench_of(lab(dead=55)))
    bench, state = course.bench, course.state
    monkeypatch.setattr(refining, "captures_showing", lambda *_: ["dark"])
    one = given(course, "set dead_time.duration", {DURATION: 55e-9}, True)
    assert one.there is not None and one.settled is not None and one.residuals is not None
    assert ("flat", "edge_intervals") in one.there.shifts
    again = bench.residuals(state, one.there)
    for cell, z in again.items():
        np.testing.assert_array_equal(one.residuals[cell], z)
    assert one.settled.square == pytest.approx(fit.square(again))
    assert one.gain == pytest.approx(fit.square(state.residuals) - fit.square(again) - 2.0)  # of one number


@pytest.mark.parametrize(("stated", "tried"), [(4, [2.0, 6.0]), (2, [1.0, 3.0]), (1, [2.0])])
def test_a_stated_whole_number_is_tried_at_other_whole_numbers(lab, stated: int, tried: list[float]) -> None:
    key = ("readout_loss", "queue")
    sensor, _ = lab()
    values = {("readout_loss", "service_time"): 1e-7, key: stated}
    change = next(c for c in candidates.changes(with_values(sensor, values)) if c.name == "set readout_loss.queue")
    assert [template[key] for template in candidates.templates(change)] == tried
    (dial,) = change.dials
    assert dial.whole
    assert all(dial.scaled(tried[-1], x) == round(dial.scaled(tried[-1], x)) for x in (0.2, 0.7, 1.6))


def test_a_stated_queue_that_is_another_one_is_found(lab) -> None:
    """It has no slope, and there is no other number beside it."""
    sensor, data = lab("    readout_loss: {service_time: 100 ns, queue: 2}\n", light=1000)
    stated = with_values(sensor, {("readout_loss", "service_time"): 1e-7, ("readout_loss", "queue"): 4})
    course = course_of.begun(bench_of((stated, data)))
    one = given(course, "set readout_loss.queue", {("readout_loss", "queue"): 3.0}, settle=True)
    assert one.values == {("readout_loss", "queue"): 2.0}
    assert one.gain > 100
    course_of.accept(course, one, 10.0)
    assert course.steps[0].values["queue"].value == 2
