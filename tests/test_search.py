"""Search: what candidates are compared by, and how faint ones and those of either sign are settled."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tinylab import CROSSTALK, LIFETIME, PROBABILITY, bench_of, change_of, given, quiet, taken

from spadmnist import plugins
from spadmnist.criticism import chance, checks, recordings, refining, settling
from spadmnist.criticism import course as course_of
from spadmnist.criticism.answer import Value
from spadmnist.criticism.candidates import Dial, first_strengths
from spadmnist.criticism.chance import along
from spadmnist.criticism.fit import Bench, Moved, likelier
from spadmnist.criticism.nulls import learn
from spadmnist.criticism.search import Search
from spadmnist.criticism.tried import Tried
from spadmnist.effects import Effect
from spadmnist.recording import Capture, Light
from spadmnist.statistics import Summary

CELL, OTHER = ("flat", "a"), ("flat", "b")


# --- signs -------------------------------------------------------------------------------------------------------


def test_what_both_signs_do_is_told_apart() -> None:
    up = Moved({CELL: np.array([5.0, 1.0]), OTHER: np.array([2.0])}, {CELL: 0.1}, {"flat": 0.3})
    down = Moved({CELL: np.array([-3.0, 1.0])}, {CELL: 0.3}, {"flat": -0.1})
    both = Moved.both(up, down)
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
    up = Moved({chance: np.array([114.0, 0.0]), line: 21.0 * there, CELL: np.array([5.0])}, {}, {})
    down = Moved({chance: np.array([86.0, 0.0]), line: -19.0 * there, CELL: np.array([-3.0])}, {}, {})
    both = Moved.both(up, down, {chance: np.ones(2), line: 1.0 + 100.0 * there}, 2)
    assert both.shifts[chance].tolist() == [0.0, 0.0] and both.shifts[line].tolist() == (20.0 * there).tolist()
    # where there is fifty times the power, chance does more, and takes away as well
    noisy = Moved.both(up, down, {line: np.full(9, 50.0)}, 2)
    assert not noisy.shifts[line].any()
    assert both.at(0.1).shifts[chance] == pytest.approx([1.0, 0.0])
    assert both.shifts[CELL].tolist() == [4.0]
    assert Moved.both(up, down).shifts[chance].tolist() == [14.0, 0.0]


@pytest.mark.slow
def test_a_faint_drift_resembles_the_trend_and_not_what_chance_makes_of_spectra(lab) -> None:
    """The trace of 1 % is not much more than its trend: in a spectrum it is the square that is there."""
    bench = bench_of(lab("    source_drift: {slope: 0}\n", light=900, side=8))
    state, look = bench.state({}), quiet(bench)
    change = change_of(bench, "add source_drift")
    (one,) = look.looked_at(state, change, look.begun(state, change))
    faint = one.moved.at(0.1)
    trend = float(np.linalg.norm(bench.template(state, faint)["flat", "trend"]))
    whole = along(bench, state, faint)
    assert trend > 2 and whole.size * whole.spread < 1.25 * trend
    spectrum = one.moved.shifts["flat", "spectrum"]
    assert not spectrum.any() and one.moved.even is not None and one.moved.even.shifts["flat", "spectrum"].any()


def test_a_gate_that_takes_most_of_the_light_is_tried_where_it_does(lab) -> None:
    """It lacks 0.6; in proportion to what 0.18 take, or 0.0018, it would lack more than all."""
    bench = bench_of(lab("    short_gate: {fraction: 0.4}\n", light=20, side=8))
    state, look = bench.state({}), quiet(bench)
    change = change_of(bench, "add short_gate")
    tried = look._by_totals(state, [(change, values) for values in look.begun(state, change)])
    best = max(tried, key=lambda one: one.gain)
    # the next strengths that are tried are a sixth away
    assert best.times == 1 and best.values["short_gate", "fraction"] == pytest.approx(0.4, abs=0.1)
    linear = bench.told(state, state.sensors.changed({("short_gate", "fraction"): 0.82}))
    times = look.line_search(state, linear, False)[1]
    assert change.strengths[0].scaled(0.82, times) < best.values["short_gate", "fraction"] - 0.05


@pytest.mark.slow
def test_a_drift_is_looked_at_with_both_signs(lab) -> None:
    """Its trend has a sign, the variance of the counts has none."""
    bench = bench_of(lab("    source_drift: {slope: -0.3}\n", light=900, side=8))
    state, look = bench.state({}), quiet(bench)
    change = change_of(bench, "add source_drift")
    (one,) = look.looked_at(state, change, look.begun(state, change))
    assert one.moved.even is not None and one.gain > 100
    # so many detections in a ramp tell the slope to root(12 / n)
    assert one.values["source_drift", "slope"] * one.times == pytest.approx(-0.3, abs=0.1)


def test_less_of_what_can_only_be_there_is_no_mark(lab) -> None:
    """Crosstalk cannot be negative, a drift can."""
    bench = bench_of(lab())
    state = bench.state({})
    cell = ("flat", "fine_intervals")
    moved = Moved({cell: np.full(len(state.residuals[cell]), 1.0)}, {}, {})
    trace = bench.template(state, moved)[cell]
    for name, signed in (("add crosstalk", False), ("add source_drift", True)):
        change = change_of(bench, name)
        one = Tried(change, {d.key: d.low for d in change.dials}, moved, 0.0, 1.0)
        p = []
        for sign in (1, -1):
            state.residuals[cell] = sign * 10.0 * trace / math.sqrt(float(trace @ trace))
            p.append(chance._of_traces(bench, state, [one])[0][0])
        assert p[0] < 1e-3 and p[1] == (pytest.approx(p[0]) if signed else 1.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_belongs_to_either_sign_speaks_for_the_one_that_is_there(lab, sign: float) -> None:
    """A ramp and a spectrum of four standard deviations each: together 5.7, whichever way the light drifts."""
    bench = bench_of(lab())
    state = bench.state({})
    ramp, power = ("flat", "trend"), ("flat", "fine_intervals")
    up, down = (
        Moved({cell: np.full(len(state.residuals[cell]), x) for cell, x in ((ramp, odd), (power, 5.0))}, {}, {})
        for odd in (5.0, -5.0)
    )
    change = change_of(bench, "add source_drift")
    one = Tried(change, {d.key: 0.1 for d in change.dials}, Moved.both(up, down), 0.0, 1.0)
    trace = bench.template(state, one.moved)
    for cell, side in ((ramp, sign), (power, 1.0)):
        t = trace[cell]
        state.residuals[cell] = side * 4.0 * t / math.sqrt(float(t @ t))
    _, found, times = chance.nearest_face(bench, state, one)
    assert times * sign > 0
    there = along(bench, state, one.moved.at(times))
    assert found.data == there.data > along(bench, state, one.moved.at(-times)).data + 1
    marked = quiet(bench)._marked(state, one)
    assert marked.gain == found.data**2 and marked.times * sign > 0
    # less than nothing of what both signs do is neither
    told = dict(state.residuals)
    state.residuals[ramp], state.residuals[power] = 0.0 * told[ramp], -told[power]
    assert quiet(bench)._marked(state, one).gain == 0
    state.residuals.update(told)
    # settled as strong as it is seen, it helps, and the opposite does not
    strong = min((0.02 * k for k in range(1, 50)), key=lambda x: abs(along(bench, state, one.moved.at(x)).size - 5.0))
    one.there = one.moved.at(sign * strong)
    assert chance.helps(bench, state, one)
    one.there = one.moved.at(-sign * strong)
    assert not chance.helps(bench, state, one)
    one.there = None
    # and chance is asked of this one
    mark, p = chance.of_best(bench, state, [one], one, large=False)
    assert mark == found.data and p < 0.01


def test_of_directions_side_by_side_all_together_are_asked(lab) -> None:
    """Two of 6.4 standard deviations each are together 9: what is settled has both, though each was tried alone."""
    bench = bench_of(lab())
    state = bench.state({})
    cell, change = ("flat", "pixel_map"), change_of(bench, "add illumination_gradient")
    rng = np.random.default_rng(2)
    shifts = np.linalg.qr(rng.standard_normal((len(state.residuals[cell]), 2)))[0].T
    keys = [("illumination_gradient", name) for name in ("x", "y", "vignette")]
    one, other = (
        Tried(change, {k: 0.1 * (i == j) for j, k in enumerate(keys)}, Moved({cell: 50 * shift}, {}, {}), 0.0, 1.0)
        for i, shift in enumerate(shifts)
    )
    traces = [bench.template(state, t.moved)[cell] for t in (one, other)]
    state.residuals.update({key: 0.0 * z for key, z in state.residuals.items()})
    state.residuals[cell] = sum(6.4 * t / math.sqrt(float(t @ t)) for t in traces)
    alone, both = (chance.of_best(bench, state, tried, one, large=False) for tried in ([one], [one, other]))
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
    bench = bench_of(lab(light=900, side=4))
    state = bench.state({})
    (moved,) = bench.moved(state, [state.sensors.changed(values)], 2, kept="sure")
    assert isinstance(moved, Moved)
    boost, found = refining._boost(
        bench, state, Tried(change_of(bench, f"add {name}"), values, moved, 0.0, 1.0), values
    )
    assert boost > 2 and round(found) == power


@pytest.mark.slow
def test_a_faint_effect_is_settled_at_its_own_strength(lab) -> None:
    """Afterpulsing of 0.4 % in 19,000 detections a second: what a stronger one does only says what it looks like."""
    made = lab("    afterpulsing: {probability: 0.6 %, lifetime: 40 ns}\n", light=900, side=4)
    course = course_of.begun(bench_of(made))
    taken(course, "add afterpulsing", {PROBABILITY: 0.002, LIFETIME: 80e-9})
    step = course.steps[0]
    assert step.slopes  # it was faint
    for name, truth in (("probability", 0.006), ("lifetime", 40e-9)):
        value = step.values[name]
        assert value.low is not None and value.high is not None
        half = math.log(value.high / value.low) / 2 / 1.96
        assert abs(math.log(value.value / truth)) < 4 * half < 2.0


def test_an_end_of_the_range_that_the_data_leave_open_is_in_the_interval(lab, monkeypatch) -> None:
    """Of a shape; a strength's ends are seen by its slope."""
    delay = ("crosstalk", "delay")
    course = course_of.begun(bench_of(lab()))
    taken(course, "add crosstalk", {CROSSTALK: 0.02, delay: 1e-9}, settle=False)
    step, bench = course.steps[0], course.bench
    step.dials = tuple(d for d in step.change.dials if d.key in course.values)
    told = {"probability": Value(0.02, 0.019, 0.021), "delay": Value(1e-9, 0.9e-9, 1.1e-9, "s")}
    step.values = dict(told)
    dial = next(d for d in step.change.shapes if d.key == delay)
    nothing = Moved({}, {}, {})
    worse = Moved({}, {}, dict.fromkeys(bench.seen, 10.0))
    for low, high in ((nothing, worse), (worse, nothing), (worse, worse)):
        monkeypatch.setattr(Bench, "moved", lambda self, state, models, few, ends=(low, high), **_: list(ends))
        step.values = dict(told)
        course_of.open_ends(course)
        value = step.values["delay"]
        assert value.low == (dial.low if low is nothing else 0.9e-9)
        assert value.high == (dial.high if high is nothing else 1.1e-9)
        assert step.values["probability"] == told["probability"]


@pytest.mark.slow
def test_numbers_that_have_a_likelihood_get_their_intervals_from_it(lab) -> None:
    made = lab("    afterpulsing: {probability: 2 %, lifetime: 40 ns}\n", light=900)
    course = course_of.begun(bench_of(made))
    taken(course, "add afterpulsing", {PROBABILITY: 0.01, LIFETIME: 60e-9})
    course_of.settle_exactly(course, made[1])
    for name, truth in (("probability", 0.02), ("lifetime", 40e-9)):
        value = course.steps[0].values[name]
        assert value.method == "likelihood" and value.low is not None and value.high is not None
        wide = (value.high - value.low) / 2  # twice the interval of 95 %: 1e-4
        assert value.low - wide < truth < value.high + wide
        assert course.values["afterpulsing", name] == value.value
    # noise of the source has none
    other = course_of.begun(bench_of(lab()))
    taken(other, "add source_noise", {("source_noise", "contrast"): 0.1, ("source_noise", "coherence_time"): 1e-4})
    before = dict(other.steps[0].values)
    course_of.settle_exactly(other, lab()[1])
    assert other.steps[0].values == before


# --- levels ------------------------------------------------------------------------------------------------------


def test_the_recordings_of_a_model_reach_as_far_as_the_data() -> None:
    """Of few detections nothing is extrapolated, wherever chance puts them; of many, no farther than chance goes."""
    light = Light("flat", relative_uncertainty=0.02)
    capture = Capture("flat", "tr", light, None)  # type: ignore[arg-type]
    for mean in (30.0, 2000.0, 1e7):
        for total in (mean * 0.9, mean, mean * 1.08, mean + 3.5 * math.sqrt(mean), mean * 3):
            centre, half = recordings.levels_about(lambda level, m=mean: m * level, total, 1.0, capture)
            assert abs(math.log(total / mean / centre)) <= half + 4 / math.sqrt(mean)
            assert abs(math.log(total / mean / centre)) <= half or mean > 6400
            assert half < 0.06 + 0.01 + 4 / math.sqrt(mean)
    # what chance may do is a matter of the model: the same recordings serve every measurement of it
    places = {recordings.levels_about(lambda level: 2000 * level, t, 1.0, capture) for t in (1900, 2000, 2100)}
    assert len(places) == 1


# --- patterns and chance -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("joined", [False, True])
def test_p_values_of_values_that_differ(joined: bool) -> None:
    """Of 2000 right models: p < 1 % in at most 2 %, which is 6 sigma beyond 1 %; joined: all move together a little."""
    rng = np.random.default_rng(3)
    chances = []
    for _ in range(2000):
        values = rng.standard_normal((33, 16))
        if joined:
            values = values * np.exp(0.05 * rng.standard_normal((33, 1)))
        chances.append(chance.of_spread(values[0], values[1:]))
    assert np.mean(np.array(chances) < 0.01) < 0.02
    # and columns of which an oracle sees 5.7 sigma are seen in most of 200 arrays
    far = math.sqrt(5.7**2 / 16)
    shifted = [
        chance.of_spread(rng.standard_normal(16) + far * rng.choice([-1, 1], 16), rng.standard_normal((32, 16)))
        for _ in range(200)
    ]
    assert np.mean(np.array(shifted) < 1e-2) > 0.6


@dataclass
class _Model:
    """A state as far as `preferred` looks at it."""

    left: int
    residuals: dict[Any, Any] = field(default_factory=dict)


def test_a_map_and_chance_are_told_by_what_they_leave(lab, monkeypatch) -> None:
    bench = bench_of(lab())
    look = quiet(bench)
    monkeypatch.setattr(checks, "blocks", lambda bench, state, residuals: [None] * state.left)
    monkeypatch.setattr(checks, "failing", lambda checks: checks)
    nothing = Moved({}, {}, {})
    map_ = Tried(change_of(bench, "per_pixel dark_counts.rate"), {}, nothing, 90.0, 1.0, maps={})
    map_ = replace(map_, maps={("dark_counts", "rate"): None})  # type: ignore[dict-item]
    chance = Tried(change_of(bench, "add blinking_dark_counts"), {}, nothing, 100.0, 1.0, chips=True)
    third = Tried(change_of(bench, "add crosstalk"), {}, nothing, 120.0, 1.0)

    def better(left_by_map: int, left_by_chance: int, *more: Tried) -> str:
        pair = [replace(map_, state=_Model(left_by_map)), replace(chance, state=_Model(left_by_chance))]  # type: ignore[arg-type]
        return look.preferred([*pair, *more], lambda t: t.gain).change.effect

    assert better(0, 0) == "dark_counts"
    assert better(1, 0) == "blinking_dark_counts"
    assert better(0, 1) == "dark_counts"
    assert better(0, 0, third) == "crosstalk"


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
        made = [Summary(x, kind, str, recordings.no_size, scale) for x in drawn(times, 64)]
        null = learn(made, np.full(64, mean))
        return SimpleNamespace(nulls={CELL: null}, residuals={CELL: null.judge(data, mean).residuals})

    for truth in (1.0, 2.0):
        data = drawn(truth)
        z = (data - mean) / own
        exact = float(z @ z) * (1 - 1 / 4) - 2 * cells * math.log(2)
        if law == "exponential":
            exact = float(np.sum(data / mean)) - 2 * cells * math.log(2)
        found = likelier(state_of(1.0, data), state_of(2.0, data))
        assert found == pytest.approx(exact, rel=0.25, abs=30), (law, truth)
        assert (found > 0) == (truth == 2.0)


def test_where_a_model_has_no_trace_chance_does_not_speak_for_it() -> None:
    """A thousand cells in which it does nothing happen to lie nearer to it; in the one where it does, data lie away."""
    null = SimpleNamespace(breadth=1.0, law="normal")
    now, there = (
        SimpleNamespace(nulls={CELL: null, OTHER: null}, residuals={CELL: np.array([x]), OTHER: np.full(1000, y)})
        for x, y in ((1.0, 1.1), (3.0, 1.0))
    )
    trace = {CELL: np.array([2.0]), OTHER: np.full(1000, 0.01)}
    assert likelier(now, there, trace) == pytest.approx(-8.0)  # type: ignore[arg-type]
    assert likelier(now, there) == pytest.approx(210.0 - 8.0)  # type: ignore[arg-type]


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
    bench = bench_of(lab())
    state, said = bench.state({}), []
    look = Search(bench, said.append)
    assert said == ["not tried: nowhere (none of its parameters says where to look for it; give one off= and search=)"]
    change = change_of(bench, "add boom")
    for _ in range(2):
        assert not look.looked_at(state, change, look.begun(state, change))
    assert (
        len(said) == 2 and said[1].startswith("not tried: boom (") and "boom.py:10: the effect boom failed" in said[1]
    )


def test_beside_what_chance_makes_of_pixels_a_map_of_them_is_settled(lab) -> None:
    bench = bench_of(lab())
    look, nothing = quiet(bench), Moved({}, {}, {})
    chance = Tried(change_of(bench, "add blinking_dark_counts"), {}, nothing, 100.0, 1.0, chips=True, fell=100.0)
    other = Tried(change_of(bench, "add crosstalk"), {}, nothing, 90.0, 1.0)
    map_ = Tried(change_of(bench, "per_pixel dark_counts.rate"), {}, nothing, 10.0, 1.0)
    map_ = replace(map_, maps={("dark_counts", "rate"): None})  # type: ignore[dict-item]
    assert [t.change.name for t in look.worth([chance, other, map_])] == [t.change.name for t in (chance, other, map_)]
    assert look.worth([other, map_]) == [other]
    # and beside a map what chance makes, where there is something in it
    clear = replace(map_, gain=1000.0)
    assert look.worth([clear, other, chance]) == [clear, chance]
    assert look.worth([clear, replace(chance, gain=20.0, fell=20.0)]) == [clear]
    # as the squares say: until its number is settled, how it scatters may tell against it
    assert [t.chips for t in look.worth([clear, replace(chance, gain=-50.0)])] == [False, True]


def test_the_template_nearest_to_where_it_suits_is_looked_at_again(lab, monkeypatch) -> None:
    bench = bench_of(lab())
    state, look = bench.state({}), quiet(bench)
    change = change_of(bench, "add crosstalk")
    nothing = Moved({}, {}, {"flat": 1.0})
    far, near = (
        Tried(change, {CROSSTALK: x}, nothing, gain, t) for x, gain, t in ((0.1, 50.0, 0.03), (0.004, 45.0, 0.8))
    )
    seen: list[Tried] = []
    monkeypatch.setattr(Search, "_simulated", lambda self, state, tried, few, only=(): seen.extend(tried) or [])
    asked: list[float] = []
    monkeypatch.setattr(Search, "maps", lambda self, state, values, least: asked.append(least) or [])
    look.again(state, {}, [far, near])
    assert [one.values[CROSSTALK] for one in seen] == [pytest.approx(0.004 * max(0.8, 1.0), rel=0.3)]
    look.again(state, {}, [far, replace(near, change=change_of(bench, "add blinking_dark_counts"), chips=True)])
    # of what is faint the trace decides which are looked at again, and how strong they are
    clear = replace(near, moved=Moved({}, {}, {"flat": 2.0}), gain=0.0)
    weak = replace(far, change=change_of(bench, "add afterpulsing"), moved=Moved({}, {}, {"flat": 3.0}))
    traces = {id(clear.moved): 4.5, id(weak.moved): 1.0}
    monkeypatch.setattr(
        chance, "along", lambda bench, state, moved: chance.Likeness(9.0, traces[id(moved)], np.zeros(16), 1.0, 15.0)
    )
    seen.clear()
    look.again(state, {}, [weak, clear], faint=True)
    assert [one.change.name for one in seen] == ["add crosstalk"]
    # what hardly shows is simulated up to three times as strong, where nothing is plainly wrong
    dim = replace(near, moved=Moved({}, {}, {"flat": 0.1}), gain=45.0, times=0.8)
    traces[id(dim.moved)] = 4.5
    for faint, times in ((False, 1.0), (True, 3.0)):
        seen.clear()
        look.again(state, {}, [dim], faint=faint)
        assert seen[0].values[CROSSTALK] == pytest.approx(0.004 * times)
    assert asked[:2] == [1e-3, 0.05]  # maps beside what chance makes of pixels are tried where they would not be alone


def test_only_edges_are_followed_close_by(lab) -> None:
    """A slope of a drift that is known to 0.003 was told by what 0.02 do, of which chance hides nearly all."""
    bench = bench_of(lab())
    drift, gate = (change_of(bench, f"add {name}").strengths[0] for name in ("source_drift", "short_gate"))
    known = Value(0.5, 0.49, 0.51, "")
    steps = [SimpleNamespace(dials=(d,), values={d.parameter: known}) for d in (drift, gate)]
    course: Any = SimpleNamespace(steps=steps)
    assert list(course_of.errors_known(course)) == [gate.key]
    settled: Any = SimpleNamespace(dials=(drift, gate), covariance=np.diag([0.01, 0.04]))
    assert course_of.errors_known(course, settled) == {gate.key: pytest.approx(0.2)}


def test_a_number_that_a_step_settles_is_no_map(lab) -> None:
    """It cannot be both: a measurement of pixels whose dark counts blink ended with a fault of the program."""
    bench = bench_of(lab())
    look, change = quiet(bench), change_of(bench, "add blinking_dark_counts")
    state = bench.state({("blinking_dark_counts", "amplitude"): 300.0, ("blinking_dark_counts", "fraction"): 0.1})
    carrier = ("blinking_dark_counts", "amplitude")
    before = look.mappable(state)
    look.accepted.append(change)
    left = look.mappable(state)
    assert [c for c in before if c not in left] == [c for c in before if c.carrier == carrier] != []


def test_a_signed_bench_is_not_simulated_twice_where_there_is_no_sign(lab) -> None:
    bench: Bench = bench_of(lab())
    state, look = bench.state({}), quiet(bench)
    before = bench.simulations
    change = change_of(bench, "add crosstalk")
    (one,) = look.looked_at(state, change, [{CROSSTALK: 0.01}])
    assert one.moved.even is None and bench.simulations - before == 2 * len(bench.seen)


# --- whole numbers, templates, and candidates that are told apart by chance -------------------------------------


@pytest.mark.parametrize(("truth", "first"), [(4, 8), (64, 8), (1, 32), (5, 2)])
def test_a_whole_number_is_settled_by_its_neighbours(truth: int, first: int) -> None:
    """The other number follows it along a narrow valley; from afar the valley's floor is not reached at once."""
    dial = Dial("bus", "queue", "", 1.0, 256.0, None, whole=True)

    def settled(values: dict[Any, Any]) -> settling.Settled:
        queue = float(values[dial.key])
        square = 1000.0 + 40.0 * math.log(queue / truth) ** 2 * truth
        return settling.Settled((), np.zeros(0), np.zeros((0, 0)), {}, {}, square, dict(values))

    found, ends = refining._counted(settled({dial.key: float(first)}), dial, settled)
    low, high = ends[dial.key]
    assert low <= truth <= high and abs(math.log(found.values[dial.key] / truth)) < 0.15
    assert low >= 1 and (low, high) == (round(low), round(high))
    if truth < 10:
        assert found.values[dial.key] == truth


@pytest.mark.parametrize(("dependent", "reach", "alone"), [(1.0, 0.45, True), (9.0, 0.8, False)])
def test_a_whole_number_that_was_settled_from_afar_is_settled_again(
    dependent: float, reach: float, alone: bool
) -> None:
    """The time that suits 4 places is far from the one that suits 8; what is settled in one go does not get there.

    Then 4 is known to be it, and the time with it; or where cells depend on each other 3 and 5 are not excluded, and
    what the time is with these is not either.
    """
    places = Dial("bus", "queue", "", 1.0, 256.0, None, whole=True)
    time = Dial("bus", "time", "s", 1e-9, 1e-6, None)

    def best(queue: float) -> float:
        return 2.0 * math.log(queue)

    def settled(values: dict[Any, Any]) -> settling.Settled:
        queue = float(values[places.key])
        to = best(queue) - math.log(values[time.key] / 1e-8)
        point = math.log(values[time.key]) + max(-reach, min(reach, to))
        left = best(queue) - (point - math.log(1e-8))
        square = 1000.0 + 500.0 * math.log(queue / 4) ** 2 + 400.0 * left**2
        slopes = {("flat", "cells"): np.full((1, 1), 50.0)}
        covariance = np.full((1, 1), dependent / 2500)
        new = {**values, time.key: math.exp(point)}
        return settling.Settled((time,), np.array([point]), covariance, {}, slopes, square, new)

    first = settled({places.key: 8.0, time.key: 1e-8 * math.exp(best(8))})
    found, ends = refining._counted(first, places, settled)
    assert found.values[places.key] == 4 and found.values[time.key] == pytest.approx(1e-8 * math.exp(best(4)), rel=0.05)
    assert ends[places.key] == ((4, 4) if alone else (3, 5)) and (time.key in ends) != alone
    if not alone:
        low, high = ends[time.key]
        assert low < 1e-8 * math.exp(best(3)) < 1e-8 * math.exp(best(5)) < high
        assert low > 1e-8 * math.exp(best(3) - 0.3) and high < 1e-8 * math.exp(best(5) + 0.3)


def test_a_template_of_another_strength_does_not_hide_one_that_promises(lab) -> None:
    """What is known of a strong one is no reason not to look at a weak one again."""
    bench = bench_of(lab())
    state, look = bench.state({}), quiet(bench)
    change = change_of(bench, "add crosstalk")
    strengths = (1e-3, 1e-1)
    tries = [(change, {CROSSTALK: x}) for x in strengths]
    cell = ("flat", "fine_intervals")
    like = Moved({cell: -state.residuals[cell]}, {}, {})
    weak, strong = (Tried(change, v, m, 0.0, 1.0) for (_, v), m in zip(tries, (like, Moved({}, {}, {})), strict=True))
    assert [t.values for t in look._still(state, tries, [strong])] == [strong.values]
    cells = len(state.residuals[cell])
    state.residuals[cell] = np.full(cells, 4.0)
    usual = np.maximum(state.nulls[cell].expected(bench.seen["flat"].total)[0], 1.0)
    weak.moved = Moved({cell: 4.0 * np.sqrt(usual)}, {}, {})
    weak.gain, _ = look.line_search(state, weak.moved, weak.signed)
    assert weak.gain > 25
    assert look._still(state, tries, [weak, strong]) == []


def test_near_rivals_are_compared_by_what_each_leaves_of_the_cells_that_they_move(lab) -> None:
    bench = bench_of(lab())
    state, look = bench.state({}), quiet(bench)
    cell, other = ("flat", "fine_intervals"), ("flat", "spectrum")
    cells = len(state.residuals[cell])
    state.residuals[cell] = np.full(cells, 3.0)
    nothing, moves = Moved({}, {}, {}), cells // 2

    def tried(name: str, gain: float, left: float, beside: float, **more: Any) -> Tried:
        there = _Model(0, {**state.residuals, cell: np.full(cells, left), other: state.residuals[other] + beside})
        settled = {**state.residuals, cell: state.residuals[cell] - 1.0 * (np.arange(cells) < moves)}
        one = Tried(change_of(bench, name), {}, nothing, gain, 1.0, state.sensors, residuals=settled, **more)
        one.state = there  # type: ignore[assignment]
        return one

    # the first leaves less of what it moves, the second of what neither does
    first, second = tried("add crosstalk", 300.0, 0.5, 0.0), tried("add jitter", 305.0, 1.0, -9.0)
    far, map_ = tried("add source_drift", 100.0, 0.0, 0.0), tried("add source_noise", 301.0, 0.0, 0.0, maps={})
    look.weigh(state, [first, second, far, map_])
    assert first.gain == 300.0 and second.gain == pytest.approx(300.0 - moves * (1.0 - 0.25))
    assert (far.gain, map_.gain) == (100.0, 301.0)
    alone = tried("add crosstalk", 300.0, 0.5, 0.0)
    look.weigh(state, [alone, far])
    assert alone.gain == 300.0


def test_a_time_is_tried_short_and_long(lab) -> None:
    """Part of what a long one does is not what a short one does; of what is no time, one strength is enough."""
    bench = bench_of(lab())
    recovery = change_of(bench, "add slow_recovery").strengths[0]
    usual, short = first_strengths(recovery)
    assert usual == pytest.approx(math.sqrt(recovery.low * recovery.high)) and recovery.low < short < usual / 5
    (crosstalk,) = first_strengths(change_of(bench, "add crosstalk").strengths[0])
    assert 0 < crosstalk < 1


def test_an_edge_that_is_thought_to_be_far_off_is_tried_where_it_was_seen_too(lab) -> None:
    """What moves an edge does not grow in proportion: a line search may lead to where nothing of it is left."""
    sensor, data = lab("    slow_recovery: {time_constant: 5 ns}\n", light=900, side=4)
    course = course_of.begun(bench_of((sensor, data)))
    key = ("slow_recovery", "time_constant")
    seen = given(course, "add slow_recovery", {key: 5e-9}, settle=False)
    far = replace(seen, gain=1000.0, times=30.0)
    (found,) = course.search.again(course.state, {}, [far])
    assert found.values[key] == pytest.approx(5e-9) and found.gain > 25
    # near by it goes where it is led
    (found,) = course.search.again(course.state, {}, [replace(seen, gain=1000.0, times=1.2)])
    assert found.values[key] == pytest.approx(6e-9)
