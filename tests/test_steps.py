"""The course of a diagnosis: closer looks, what becomes of them, and what looks the same as what was found."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tinylab import CROSSTALK, DURATION, bench_of, change_of, quiet, taken

from spadmnist.criticism import answer, chance, diagnose, findings, fit, likelihood, mapping, settling
from spadmnist.criticism import course as course_of
from spadmnist.criticism.answer import Step
from spadmnist.criticism.fit import RATES, Moved, State
from spadmnist.criticism.lines import Line
from spadmnist.criticism.search import gain_beside
from spadmnist.criticism.tried import Tried, weaker


def test_a_closer_look_only_adds_recordings(lab):
    """And so it is the same as if they had been made at once; half of the work."""
    bench = bench_of(lab(), 16)
    few = bench.state({})
    done = bench.simulations
    more = bench.state({}, few.sensors, 32, few)
    assert bench.simulations - done == 2 * 16  # of two captures
    whole = bench_of(lab(), 32).state({})
    assert more.residuals.keys() == whole.residuals.keys()
    for cell, z in whole.residuals.items():
        np.testing.assert_array_equal(more.residuals[cell], z)
        np.testing.assert_array_equal(more.own[cell], whole.own[cell])
    for id, made in whole.made.items():
        np.testing.assert_array_equal(more.made[id].totals, made.totals)


@pytest.mark.slow
def test_levels_are_evenly_spread_however_many_they_are(lab):
    """So that the first recordings are a fair sample of all, and every fourth of them is, too."""
    for number in (16, 32, 96):
        factors = np.log(bench_of(lab(), number).state({}).factors["flat"])
        for some in (factors, factors[: number // 2], factors[::4]):
            place = np.sort(some) / factors.max()
            gaps = np.diff(place, prepend=-1.0, append=1.0)
            assert gaps.max() < 2.7 * 2 / len(some)


def test_models_may_be_looked_at_in_captures_of_their_own(lab):
    bench = bench_of(lab())
    state = bench.state({})
    models = [state.sensors.changed({CROSSTALK: x}) for x in (0.05, 0.1)]
    mixed = bench.moved(state, models, only_of=[["flat"], ["dark"]])
    for moved, model, id in zip(mixed, models, ("flat", "dark"), strict=True):
        (alone,) = bench.moved(state, [model], only=[id])
        assert not isinstance(moved, str) and not isinstance(alone, str)
        assert moved.shifts.keys() == alone.shifts.keys() and {cell[0] for cell in moved.shifts} == {id}
        for cell, shift in alone.shifts.items():
            np.testing.assert_array_equal(moved.shifts[cell], shift)
        assert moved.logs == alone.logs
        assert moved.only([id]).shifts.keys() == moved.shifts.keys() and not moved.only([]).shifts


def test_totals_are_no_matter_of_the_set_up_where_a_line_may_move_them(lab, monkeypatch):
    """A capture shorter than a period of the lamp has more light than stated, or less, and no clock was misread."""
    bench = bench_of(lab())
    state, look = bench.state({}), quiet(bench)
    residuals = {cell: np.full(len(z), 10.0 if cell == RATES else 0.0) for cell, z in state.residuals.items()}
    state = replace(state, residuals=residuals, exact=[])
    assert look.only_rates(state)
    monkeypatch.setattr(look, "lines", lambda state: [Line(100.0, 1.0, -20.0)])
    assert not look.only_rates(state)
    course = course_of.Course(bench, look, state, {}, [], [])
    monkeypatch.setattr(diagnose, "_by_setup", lambda *_: pytest.fail("the set-up was asked"))
    monkeypatch.setattr(look, "scan", lambda *_, **__: [])
    monkeypatch.setattr(diagnose, "_added", lambda *_: False)
    assert not diagnose._another(course, diagnose._Beside([], False))


def test_an_edge_that_drowns_all_else_is_tried_weaker(lab):
    """A readout that takes 30 ns loses nearly all of what comes every 3 ns: nothing is told of one that takes 2 ns."""
    bench = bench_of(lab())
    nothing = Moved({}, {}, {})
    service, jitter = ("readout_loss", "service_time"), ("jitter", "sigma")
    change = change_of(bench, "add readout_loss")
    least = change.strengths[0].low
    down = weaker(Tried(change, {service: 100 * least, ("readout_loss", "queue"): 8.0}, nothing, 0.0, 1.0))
    assert down == {service: pytest.approx(10 * least), ("readout_loss", "queue"): 8.0}
    assert weaker(Tried(change, {service: least}, nothing, 0.0, 1.0)) is None
    assert weaker(Tried(change_of(bench, "add crosstalk"), {CROSSTALK: 0.1}, nothing, 0.0, 1.0)) is None
    assert weaker(Tried(change_of(bench, "set dead_time.duration"), {jitter: 1e-8}, nothing, 0.0, 1.0)) is None


def test_an_edge_of_which_the_data_want_more_is_tried_further_off(lab, monkeypatch):
    """A blur of 3 ns is not twenty times one of 0.15 ns: it is followed while the data want more."""
    bench = bench_of(lab())
    look, state = quiet(bench), bench.state({})
    jitter, change = ("jitter", "sigma"), change_of(bench, "add jitter")
    high = change.strengths[0].high
    asked: list[float] = []

    def looked_at(state: Any, tries: Any, some: Any = ()) -> list[Tried]:
        asked.extend(tried[jitter] for _, tried in tries)
        return [Tried(c, tried, Moved({}, {}, {}), *found.pop(0)) for c, tried in tries]

    monkeypatch.setattr(look, "_looked_at", looked_at)
    one = Tried(change, {jitter: high / 16}, Moved({}, {}, {}), 100.0, 1.7)
    # what it is thought to gain at several times its strength is no bound for what it gains there
    found = [(90.0, 1.7), (200.0, 0.8)]
    further = look._further(state, [one], [])
    assert asked == pytest.approx([high / 4, high / 2]) and [t.gain for t in further] == [90.0, 200.0]
    asked.clear()
    assert not look._further(state, [replace(one, times=0.7)], [])  # less of it would do
    assert not look._further(state, [replace(one, gain=20.0)], [])  # nor is it worth it
    assert not look._further(state, [replace(one, values={jitter: high})], [])
    assert not asked


def test_beside_chance_a_map_pays_for_its_numbers(lab):
    """The price against twice the exact logarithms of the likelihood of 400 values: 1e-6 would be 5 of its spread."""
    rng = np.random.default_rng(5)
    error, sigma = np.full(400, 0.5), 0.4
    raw = np.hypot(error, sigma) * rng.standard_normal(400)
    shrunk = raw * sigma**2 / (sigma**2 + error**2)
    known = 1 / np.sqrt(1 / error**2 + 1 / sigma**2)
    map_ = mapping.Map(("dark_counts", "rate"), 1.0, np.arange(400), shrunk, known, raw, error, sigma)
    squares = float(np.sum((raw / error) ** 2) - np.sum(((raw - shrunk) / error) ** 2))
    wide = error**2 + sigma**2
    exact = float(np.sum(raw**2 / error**2 + np.log(error**2) - raw**2 / wide - np.log(wide)))
    assert squares - map_.price == pytest.approx(exact, abs=0.1 * map_.price)
    # an odd pixel, of which the others say nothing, costs as much as a prior of its own width says
    odd = np.where(np.arange(400) < 10, 1 / np.sqrt(1 / error**2 + 1 / 2.0**2), known)
    ratio = np.array([2.0, sigma]) ** 2 / 0.5**2
    each = ratio / (1 + ratio) + np.log1p(ratio)
    assert replace(map_, error=odd).price - map_.price == pytest.approx(10 * (each[0] - each[1]))
    bench = bench_of(lab())
    change = change_of(bench, "per_pixel dark_counts.rate")
    maps = {("dark_counts", "rate"): map_}
    told = Tried(change, {}, Moved({}, {}, {}), squares, 1.0, maps=maps, chance=1e-9)
    chips = Tried(change_of(bench, "add blinking_dark_counts"), {}, Moved({}, {}, {}), 90.0, 1.0, chips=True)
    assert gain_beside(told, told) == squares and gain_beside(chips, told) == 90.0
    assert gain_beside(told, chips) == pytest.approx(max(squares - map_.price, 6.1**2), rel=0.01)
    assert gain_beside(replace(told, gain=20.0), chips) == 20.0  # never more than it gains


def test_expectations_of_many_captures_are_those_of_each(lab):
    bench = bench_of(lab())
    state = bench.state({})
    for cell, null in state.nulls.items():
        totals = state.made[cell[0]].totals[:3]
        expected, leverage = null.expected_all(totals)
        for k, total in enumerate(totals):
            terms = (total / null.middle - 1) ** np.arange(len(null.coefficients))
            least = 0.5 / null.recordings if null.law == "poisson" else -np.inf
            np.testing.assert_allclose(expected[k], np.maximum(terms @ null.coefficients, least), rtol=1e-9)
            assert leverage[k] == pytest.approx(terms @ null.inverse @ terms)
            np.testing.assert_allclose(null.expected(float(total))[0], expected[k], rtol=1e-9)


def test_a_gain_is_what_the_squares_fall_by(lab):
    bench = bench_of(lab())
    state = bench.state({})
    (moved,) = bench.moved(state, [state.sensors.changed({CROSSTALK: 0.05})])
    for times in (0.1, 1.0):
        fall = fit.square(state.residuals) - fit.square(bench.residuals(state, moved, times))
        assert bench.gain(state, moved, times) == pytest.approx(fall, rel=1e-9, abs=1e-6)


# --- what becomes of a closer look -------------------------------------------------------------------------------


def looked_closer(course: course_of.Course, monkeypatch: pytest.MonkeyPatch, added: Any) -> tuple[State, State, bool]:
    """(the state before, the closer one, is there another step?), where something stands out by a closer look."""
    before, closer = course.state, replace(course.state)

    def stands_out(course: course_of.Course, tried: Any, level: float) -> bool:
        course.state = closer
        return True

    monkeypatch.setattr(diagnose, "_stands_out", stands_out)
    monkeypatch.setattr(diagnose, "_added", added)
    monkeypatch.setattr(course.search, "scan", lambda *_, **__: [])
    return before, closer, diagnose._another(course, diagnose._Beside([], False))


def test_after_a_closer_look_that_led_to_nothing_the_model_is_as_it_was(lab, monkeypatch):
    """By which no check fails; by the closer one some might, and nobody would say of what."""
    course = course_of.begun(bench_of(lab()))
    assert not course.failed
    before, _, another = looked_closer(course, monkeypatch, lambda *_: False)
    assert not another and course.state is before


@pytest.mark.slow
def test_what_a_step_leaves_stays(lab, monkeypatch):
    course = course_of.begun(bench_of(lab()))
    new = replace(course.state)

    def last(course: course_of.Course, *_: Any) -> bool:
        course.state = new
        return False

    _, closer, another = looked_closer(course, monkeypatch, lambda *_: True)
    assert another and course.state is closer
    _, _, another = looked_closer(course, monkeypatch, last)
    assert not another and course.state is new


# --- what looks the same -----------------------------------------------------------------------------------------


def of(name: str, state: State, bench: Any, **sizes: float) -> Step:
    """A step whose trace has such sizes, each in one cell of a statistic of the flat field."""
    trace = {cell: np.zeros(len(z)) for cell, z in state.residuals.items()}
    trace[RATES][:] = 7.0  # of totals, which anything may move
    for statistic, size in sizes.items():
        trace["flat", statistic][0] = size
    return Step(change_of(bench, f"add {name}"), {}, 1.0, 20.0, "", template=trace)


def test_jitter_is_confused_where_only_intervals_tell(lab):
    """A dead time drawn anew for every detection blurs the same edge; what neighbours share it does not blur."""
    bench = bench_of(lab())
    state = bench.state({})
    found = findings.mimicked(of("jitter", state, bench, intervals=30.0, edge_intervals=30.0, neighbours=3.9))
    assert found is not None and found.what == "a dead time that differs from event to event"
    assert findings.mimicked(of("jitter", state, bench, intervals=30.0, neighbours=4.1)) is None
    assert findings.mimicked(of("crosstalk", state, bench, intervals=30.0)) is None


def test_what_looks_the_same_is_named_with_what_tells(lab):
    course = course_of.begun(bench_of(lab()))
    step = of("jitter", course.state, course.bench, intervals=30.0)
    course.steps.append(step)
    beside = diagnose._Beside([], False)
    assert diagnose._or_confused(course, beside) == "confused"
    assert step.alternatives[0]["what"] == "a dead time that differs from event to event"
    (told,) = beside.advice
    assert told["capture"] == "a pulsed source" and told["significance_then"] == 20.0
    assert told["separates"] == ["jitter", step.alternatives[0]["what"]]
    assert answer.mimic(step.change) is not None
    course.steps = [of("crosstalk", course.state, course.bench, intervals=30.0)]
    assert diagnose._or_confused(course, diagnose._Beside([], False)) == "explained"


def test_a_last_step_that_loses_a_line_is_not_taken(lab, monkeypatch):
    """Slopes do not know that an echo's line falls into the next bin."""
    course = course_of.begun(bench_of(lab()))
    change = change_of(course.bench, "add crosstalk")
    dials = change.strengths
    course.values = {CROSSTALK: 0.01}
    further = settling.point_of(dials, {CROSSTALK: 0.02})
    settled = settling.Settled(dials, further, np.eye(1), {}, {}, 0.0, {CROSSTALK: 0.02})
    now = fit.square(course.state.residuals)
    for square, point in ((now + 1e3, 0.01), (now + 1.0, 0.02)):
        monkeypatch.setattr(course.bench, "moved", lambda *_, **__: [Moved({}, {}, {})])
        monkeypatch.setattr(course_of, "square", lambda z, s=square: now if z is course.state.residuals else s)
        held = course_of._held(course, settled)
        assert dials[0].value(float(held.point[0])) == pytest.approx(point)
    monkeypatch.setattr(course.bench, "moved", lambda *_, **__: ["beyond what can be simulated"])
    assert dials[0].value(float(course_of._held(course, settled).point[0])) == pytest.approx(0.01)


@pytest.mark.slow
@pytest.mark.parametrize("fails", [True, False])
def test_where_something_is_wrong_few_recordings_do_not_hide_what_it_is(lab, monkeypatch, fails):
    """A candidate that could be chance by few recordings is looked at by many before the answer is that none fits."""
    course = course_of.begun(bench_of(lab()))
    one = Tried(change_of(course.bench, "add crosstalk"), {CROSSTALK: 0.01}, Moved({}, {}, {}), 50.0, 1.0)
    for name in ("again", "worth"):
        monkeypatch.setattr(course.search, name, lambda *_: [one])
    monkeypatch.setattr(course.search, "structured", lambda state, tried: tried)
    monkeypatch.setattr(diagnose, "refine", lambda bench, state, one: one)
    monkeypatch.setattr(diagnose.chance, "of_best", lambda *_: (3.0, 0.2))
    failed: Any = [object()] if fails else []
    beside = diagnose._Beside([], False)
    assert diagnose._added(course, beside, failed) == fails
    assert (len(course.state.own[RATES]) > 16) == fails
    assert not diagnose._added(course, beside, failed)  # and not again and again
    assert not course.steps


def test_of_what_is_faint_the_least_likely_is_chosen_and_not_the_largest(lab, monkeypatch):
    course = course_of.begun(bench_of(lab()))
    map_, other = (
        Tried(change_of(course.bench, name), {}, Moved({}, {}, {}), gain, 1.0)
        for name, gain in (("per_pixel dark_counts.rate", -3.0), ("add slow_afterpulsing", 37.0))
    )
    for name in ("again", "worth"):
        monkeypatch.setattr(course.search, name, lambda *_: [map_, other])
    monkeypatch.setattr(course.search, "structured", lambda state, tried: tried)
    monkeypatch.setattr(diagnose, "refine", lambda bench, state, one: one)
    monkeypatch.setattr(
        diagnose.chance, "of_best", lambda bench, state, tried, one, large: (4.0, 1e-5 if one is map_ else 1e-3)
    )
    taken: list[Tried] = []

    def accept(course: Any, best: Tried, significance: float) -> Any:
        taken.append(best)
        raise StopIteration

    monkeypatch.setattr(diagnose, "accept", accept)
    for failed in ([object()], []):
        with pytest.raises(StopIteration):
            diagnose._added(course, diagnose._Beside([], False), failed)  # type: ignore[arg-type]
    assert taken == [other, map_] and map_.gain == 16.0  # the square of its trace's, whatever all cells have gained


@pytest.mark.parametrize(
    ("odd", "numbers", "first"),
    [(True, 0.9, "per_pixel dark_counts.rate"), (True, 0.2, "add blinking"), (False, 0.9, "add blinking")],
)
def test_a_map_of_pixels_that_chance_made_odd_is_as_unlikely_as_they_are(
    lab, monkeypatch, odd: bool, numbers: float, first: str
) -> None:
    """But only where it is their numbers that tell, and not as unlikely as what has nothing to do with pixels."""
    bench = bench_of(lab())
    look = quiet(bench)
    map_, codes, other = (
        Tried(change_of(bench, name), {}, Moved({}, {}, {}), 50.0, 1.0)
        for name in ("per_pixel dark_counts.rate", "add tdc_nonlinearity", "add blinking_dark_counts")
    )
    map_.maps, codes.maps, other.chips = {(): None}, {(): None}, odd  # type: ignore[dict-item]
    monkeypatch.setattr(look, "_of_numbers", lambda *_: numbers)
    judged = {id(map_): (2.0, 0.02), id(codes): (2.1, 0.015), id(other): (4.0, 1e-4)}
    best, significance, p = look.least_likely(bench.state({}), [codes, map_, other], lambda t: judged[id(t)])
    assert best.change.name.startswith(first) and (significance, p) == (4.0, 1e-4)


def test_what_would_do_as_well_is_named_before_what_would_not(lab, monkeypatch) -> None:
    """However many of these there are: the maps that no count tells come last of all that is tried."""
    bench = bench_of(lab())
    state = bench.state({})
    names = ("crosstalk", "slow_afterpulsing", "source_noise", "flicker", "background_light", "blinking_dark_counts")
    best, *others = (
        Tried(change_of(bench, f"add {name}"), {}, Moved({}, {}, {}), gain, 1.0, residuals=state.residuals)
        for name, gain in zip(names, (100.0, 50.0, 40.0, 30.0, 20.0, 99.0), strict=True)
    )
    monkeypatch.setattr(diagnose.checks, "failing", lambda *_: [])
    found = diagnose._alternatives(quiet(bench), state, best, [best], others)
    assert [(a["effect"], a["confused"]) for a in found] == [
        ("blinking_dark_counts", True),
        *((name, False) for name in names[1:4]),
    ]


def test_what_counts_and_what_sets_beside_each_other_is_told_apart(lab) -> None:
    bench = bench_of(lab())
    state, look = bench.state({}), quiet(bench)
    for name, low, high in (("per_pixel dark_counts.rate", 0.7, 1.0), ("add crosstalk", 0.0, 0.3)):
        change = change_of(bench, name)
        if name.startswith("per_pixel"):
            rng = np.random.default_rng(1)
            usual = float(np.mean(state.sensors.one.effect("dark_counts").rate))
            values = {("dark_counts", "rate"): usual * np.exp(1.5 * rng.standard_normal(bench.start.layout.pixels))}
        else:
            values = {CROSSTALK: 0.05}
        (moved,) = bench.moved(state, [state.sensors.changed(values)])
        assert not isinstance(moved, str) and change.effect
        assert low <= look._of_numbers(state, moved) <= high, name


def test_a_faint_step_must_help_along_its_own_trace(lab, monkeypatch) -> None:
    """Settled by chance at twice its strength and more, or with the other sign, it does not."""
    bench = bench_of(lab())
    state = bench.state({})
    one = Tried(change_of(bench, "add crosstalk"), {CROSSTALK: 0.01}, Moved({}, {}, {}), 50.0, 1.0)
    (usual, much, less) = bench.moved(state, [state.sensors.changed({CROSSTALK: x}) for x in (0.02, 0.06, 0.01)])
    one.moved = usual  # type: ignore[assignment]
    for data, there, good in ((4.0, usual, True), (4.0, much, False), (4.0, less, True), (-4.0, less, False)):
        found = chance.Likeness(4.0, data, np.zeros(16), 1.0, 15.0)
        monkeypatch.setattr(chance, "along", lambda *_, found=found: found)
        one.there = there  # type: ignore[assignment]
        assert chance.helps(bench, state, one) == good
    assert chance.helps(bench, state, replace(one, there=None)) and chance.helps(bench, state, replace(one, chance=0.1))
    # where few recordings show nothing of it beyond chance, all that they show is looked at
    monkeypatch.setattr(chance, "along", lambda *_: chance.Likeness(4.0, 4.0, np.zeros(16), 1.0, 15.0))
    unseen = replace(one, there=Moved({}, {}, {}))
    for settled, good in ((0.02, True), (0.06, False), (0.0, False), (0.003, False)):  # the last may be chance
        assert chance.helps(bench, state, replace(unseen, sensors=state.sensors.changed({CROSSTALK: settled}))) == good


@pytest.mark.parametrize("rival", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_likelihood_of_one_of_two_laws_that_are_as_good_decides_nothing(lab, monkeypatch, rival: bool) -> None:
    """It moves the dead time to where checks fail: without a rival that is said, with one what was settled stays."""
    sensor, data = lab(dead=55)
    course = course_of.begun(bench_of((sensor, data)))
    taken(course, "set dead_time.duration", {DURATION: 55e-9})
    (step,), state = course.steps, course.state
    step.alternatives = [{"confused": rival}]
    course.rung("+ another dead time")
    rows = [rung.row for rung in course.ladder]
    usual, settled = dict(step.values), course.values[DURATION]
    check = SimpleNamespace(cell=("flat", "edge_intervals"))
    monkeypatch.setattr(course_of.Course, "failed", property(lambda self: [] if self.state is state else [check]))
    exact = likelihood.Exact({DURATION: 50e-9}, {DURATION: (49e-9, 51e-9)}, [1.0], (DURATION,), np.eye(1))
    monkeypatch.setattr(likelihood, "settled", lambda *_, **__: exact)
    course_of.settle_exactly(course, data)
    assert bool(course.failed) != rival and (course.state is state) == rival
    assert (step.values == usual) == rival
    assert course.values[DURATION] == (settled if rival else 50e-9) and settled != 50e-9
    course.last_rung()  # and the ladder ends with the model as it is now
    assert ([rung.row for rung in course.ladder] == rows) == rival and len(course.ladder) == len(rows)
    assert course.ladder[-1].model == "+ another dead time" and course.ladder[-1].misfit == course.misfit
