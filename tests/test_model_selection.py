"""The course of a diagnosis: closer looks, what becomes of them, and what looks the same as what was found."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from labs import CROSSTALK, DURATION, bench_of, change_of, quiet, taken

from spadmnist.inference.alternatives import alternatives
from spadmnist.inference.candidates import candidates
from spadmnist.inference.capture_replicates import CannotSimulate
from spadmnist.inference.conclusion import Notes
from spadmnist.inference.coordinates import point_of
from spadmnist.inference.elimination import left_in_own_cells
from spadmnist.inference.evaluation import Evaluation, evaluate, square
from spadmnist.inference.evidence import best_of, evidence_of, judge_maps_by_odd_pixels, share_of_counts
from spadmnist.inference.exact_likelihood import MaximumLikelihood
from spadmnist.inference.findings import mimicked
from spadmnist.inference.forward_step import best_added
from spadmnist.inference.gauss_newton import Fit
from spadmnist.inference.intervals import sharpen
from spadmnist.inference.joint_fit import bounded
from spadmnist.inference.model_path import ModelPath, begin
from spadmnist.inference.model_selection import another_step, or_confused
from spadmnist.inference.pixel_maps import PixelMap
from spadmnist.inference.replicates import TOTALS
from spadmnist.inference.results import Step, mimic
from spadmnist.inference.score_test import ScoreTest, explains_its_signature
from spadmnist.inference.signature import Sampling, Signature, fall_of, residuals_at, signatures
from spadmnist.inference.spectral_lines import Line
from spadmnist.inference.trial import Trial, weaker


@pytest.mark.slow
def test_a_closer_look_only_adds_recordings(lab):
    """And so it is the same as if they had been made at once; half of the work."""
    replicates = bench_of(lab(), 16)
    few = evaluate(replicates, {})
    done = replicates.simulations
    more = evaluate(replicates, {}, few.sensors, 32, few)
    assert replicates.simulations - done == 2 * 16  # of two captures
    whole = evaluate(bench_of(lab(), 32), {})
    assert more.residuals.keys() == whole.residuals.keys()
    for cell, z in whole.residuals.items():
        np.testing.assert_array_equal(more.residuals[cell], z)
        np.testing.assert_array_equal(more.replicate_residuals[cell], whole.replicate_residuals[cell])
    for id, made in whole.made.items():
        np.testing.assert_array_equal(more.made[id].totals, made.totals)


@pytest.mark.slow
def test_levels_are_evenly_spread_however_many_they_are(lab):
    """So that the first recordings are a fair sample of all, and every fourth of them is, too."""
    for number in (16, 32, 96):
        factors = np.log(evaluate(bench_of(lab(), number), {}).factors["flat"])
        for some in (factors, factors[: number // 2], factors[::4]):
            place = np.sort(some) / factors.max()
            gaps = np.diff(place, prepend=-1.0, append=1.0)
            assert gaps.max() < 2.7 * 2 / len(some)


def test_models_may_be_looked_at_in_captures_of_their_own(lab):
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    models = [evaluation.sensors.changed({CROSSTALK: x}) for x in (0.05, 0.1)]
    mixed = signatures(replicates, evaluation, models, only_of=[["flat"], ["dark"]])
    for signature, model, id in zip(mixed, models, ("flat", "dark"), strict=True):
        (alone,) = signatures(replicates, evaluation, [model], Sampling(only=[id]))
        assert isinstance(signature, Signature) and isinstance(alone, Signature)
        assert signature.shifts.keys() == alone.shifts.keys() and {cell[0] for cell in signature.shifts} == {id}
        for cell, shift in alone.shifts.items():
            np.testing.assert_array_equal(signature.shifts[cell], shift)
        assert signature.logs == alone.logs
        assert signature.only([id]).shifts.keys() == signature.shifts.keys() and not signature.only([]).shifts


def test_totals_are_no_matter_of_the_set_up_where_a_line_may_move_them(lab, monkeypatch):
    """A capture shorter than a period of the lamp has more light than stated, or less, and no clock was misread."""
    replicates = bench_of(lab())
    evaluation, look = evaluate(replicates, {}), quiet(replicates)
    residuals = {cell: np.full(len(z), 10.0 if cell == TOTALS else 0.0) for cell, z in evaluation.residuals.items()}
    evaluation = replace(evaluation, residuals=residuals, judgements={})
    assert look.only_rates(evaluation)
    monkeypatch.setattr(look, "lines", lambda evaluation: [Line(100.0, 1.0, -20.0)])
    assert not look.only_rates(evaluation)
    path = ModelPath(replicates, look, evaluation, {}, [], [])
    monkeypatch.setattr(
        "spadmnist.inference.model_selection.explained_by_setup", lambda *_: pytest.fail("the set-up was asked")
    )
    monkeypatch.setattr(look, "scan", lambda *_, **__: [])
    monkeypatch.setattr("spadmnist.inference.model_selection.best_added", lambda *_: False)
    assert not another_step(path, Notes([], False))


def test_an_edge_that_drowns_all_else_is_tried_weaker(lab):
    """A readout that takes 30 ns loses nearly all of what comes every 3 ns: nothing is told of one that takes 2 ns."""
    replicates = bench_of(lab())
    nothing = Signature({}, {}, {})
    service, jitter = ("readout_loss", "service_time"), ("jitter", "sigma")
    candidate = change_of(replicates, "add readout_loss")
    least = candidate.strengths[0].low
    down = weaker(Trial(candidate, {service: 100 * least, ("readout_loss", "queue"): 8.0}, nothing, 0.0, 1.0))
    assert down == {service: pytest.approx(10 * least), ("readout_loss", "queue"): 8.0}
    assert weaker(Trial(candidate, {service: least}, nothing, 0.0, 1.0)) is None
    assert weaker(Trial(change_of(replicates, "add crosstalk"), {CROSSTALK: 0.1}, nothing, 0.0, 1.0)) is None
    assert weaker(Trial(change_of(replicates, "set dead_time.duration"), {jitter: 1e-8}, nothing, 0.0, 1.0)) is None


def test_an_edge_of_which_the_data_want_more_is_tried_further_off(lab, monkeypatch):
    """A blur of 3 ns is not twenty times one of 0.15 ns: it is followed while the data want more."""
    replicates = bench_of(lab())
    look, evaluation = quiet(replicates), evaluate(replicates, {})
    jitter, candidate = ("jitter", "sigma"), change_of(replicates, "add jitter")
    high = candidate.strengths[0].high
    asked: list[float] = []

    def looked_at(evaluation: Any, tries: Any, some: Any = ()) -> list[Trial]:
        asked.extend(tried[jitter] for _, tried in tries)
        return [Trial(c, tried, Signature({}, {}, {}), *found.pop(0)) for c, tried in tries]

    monkeypatch.setattr(look, "_looked_at", looked_at)
    one = Trial(candidate, {jitter: high / 16}, Signature({}, {}, {}), 100.0, 1.7)
    # what it is thought to gain at several times its strength is no bound for what it gains there
    found = [(90.0, 1.7), (200.0, 0.8)]
    further = look.stronger_trials(evaluation, [one], [])
    assert asked == pytest.approx([high / 4, high / 2]) and [t.fall for t in further] == [90.0, 200.0]
    asked.clear()
    assert not look.stronger_trials(evaluation, [replace(one, times=0.7)], [])  # less of it would do
    assert not look.stronger_trials(evaluation, [replace(one, fall=20.0)], [])  # nor is it worth it
    assert not look.stronger_trials(evaluation, [replace(one, values={jitter: high})], [])
    assert not asked


def test_beside_chance_a_map_pays_for_its_numbers(lab):
    """The price against twice the exact logarithms of the likelihood of 400 values: 1e-6 would be 5 of its spread."""
    rng = np.random.default_rng(5)
    error, sigma = np.full(400, 0.5), 0.4
    raw = np.hypot(error, sigma) * rng.standard_normal(400)
    shrunk = raw * sigma**2 / (sigma**2 + error**2)
    known = 1 / np.sqrt(1 / error**2 + 1 / sigma**2)
    map_ = PixelMap(("dark_counts", "rate"), 1.0, np.arange(400), shrunk, known, raw, error, sigma)
    squares = float(np.sum((raw / error) ** 2) - np.sum(((raw - shrunk) / error) ** 2))
    wide = error**2 + sigma**2
    exact = float(np.sum(raw**2 / error**2 + np.log(error**2) - raw**2 / wide - np.log(wide)))
    assert squares - map_.price == pytest.approx(exact, abs=0.1 * map_.price)
    # an odd pixel, of which the others say nothing, costs as much as a prior of its own width says
    odd = np.where(np.arange(400) < 10, 1 / np.sqrt(1 / error**2 + 1 / 2.0**2), known)
    ratio = np.array([2.0, sigma]) ** 2 / 0.5**2
    each = ratio / (1 + ratio) + np.log1p(ratio)
    assert replace(map_, error=odd).price - map_.price == pytest.approx(10 * (each[0] - each[1]))
    replicates = bench_of(lab())
    candidate = change_of(replicates, "per_pixel dark_counts.rate")
    maps = {("dark_counts", "rate"): map_}
    evaluation = evaluate(replicates, {})
    told = Trial(candidate, {}, Signature({}, {}, {}), squares, 1.0, maps=maps, p_value=1e-9)
    found = evidence_of(replicates, evaluation, told)
    assert found == pytest.approx(max(squares - map_.price, 6.1**2), rel=0.01) and found < squares
    # the squares hardly show small differences of many pixels
    assert evidence_of(replicates, evaluation, replace(told, fall=20.0)) == pytest.approx(6.1**2, rel=0.01)


def test_expectations_of_many_captures_are_those_of_each(lab):
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    for cell, null in evaluation.nulls.items():
        totals = evaluation.made[cell[0]].totals[:3]
        expected, leverage = null.expected_all(totals)
        for k, total in enumerate(totals):
            terms = (total / null.middle - 1) ** np.arange(len(null.coefficients))
            least = null.law.least(null.recordings)
            np.testing.assert_allclose(expected[k], np.maximum(terms @ null.coefficients, least), rtol=1e-9)
            assert leverage[k] == pytest.approx(terms @ null.inverse @ terms)
            np.testing.assert_allclose(null.expected(float(total))[0], expected[k], rtol=1e-9)


def test_a_fall_is_what_the_squares_fall_by(lab):
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    (signature,) = signatures(replicates, evaluation, [evaluation.sensors.changed({CROSSTALK: 0.05})])
    for times in (0.1, 1.0):
        fall = square(evaluation.residuals) - square(residuals_at(replicates, evaluation, signature, times))
        assert fall_of(replicates, evaluation, signature, times) == pytest.approx(fall, rel=1e-9, abs=1e-6)


# --- what becomes of a closer look -------------------------------------------------------------------------------


def with_residuals(evaluation: Evaluation, size: float) -> Evaluation:
    return replace(evaluation, residuals={cell: np.full(len(z), size) for cell, z in evaluation.residuals.items()})


def looked_closer(path: ModelPath, monkeypatch: pytest.MonkeyPatch, added: Any) -> tuple[Evaluation, Evaluation, bool]:
    """(the evaluation before, the closer one, is there another step?), where something stands out by a closer look."""
    before, closer = path.evaluation, replace(path.evaluation)

    def stands_out(path: ModelPath, tried: Any, level: float) -> bool:
        path.evaluation = closer
        return True

    monkeypatch.setattr("spadmnist.inference.model_selection.stands_out", stands_out)
    monkeypatch.setattr("spadmnist.inference.model_selection.best_added", added)
    monkeypatch.setattr(path.scan, "scan", lambda *_, **__: [])
    return before, closer, another_step(path, Notes([], False))


def test_a_closer_look_stays_and_what_fails_by_it_is_looked_for(lab, monkeypatch):
    """`compare` simulates as often: what it would fail is not called adequate by fewer replicates."""
    path = begin(bench_of(lab()))
    assert not path.failed
    _, closer, another = looked_closer(path, monkeypatch, lambda *_: False)
    assert not another and path.evaluation is closer
    wrong = with_residuals(path.evaluation, 30.0)
    monkeypatch.setattr("spadmnist.inference.model_selection.stands_out", lambda *_: setattr(path, "evaluation", wrong))
    assert another_step(path, Notes([], False)) and path.failed


@pytest.mark.slow
def test_what_a_step_leaves_stays(lab, monkeypatch):
    path = begin(bench_of(lab()))
    new = replace(path.evaluation)

    def last(path: ModelPath, *_: Any) -> bool:
        path.evaluation = new
        return False

    _, closer, another = looked_closer(path, monkeypatch, lambda *_: True)
    assert another and path.evaluation is closer
    _, _, another = looked_closer(path, monkeypatch, last)
    assert not another and path.evaluation is new


# --- own cells ----------------------------------------------------------------------------------------------------


def test_a_step_is_judged_by_its_own_cells_alone(lab):
    """Where the step that explained other cells has gone, these rise: the map still explains its own."""
    own, other = ("flat", "pixel_map"), ("flat", "codes")
    step = Step(
        candidate=next(c for c in candidates(lab()[0]) if c.name == "per_pixel detection.pdp"),
        values={},
        misfit=1.0,
        significance=20.0,
        material="",
        template={own: np.array([20.0, 20.0]), other: np.full(50, 0.01)},
        before={own: np.array([21.0, 19.0]), other: np.zeros(50)},
    )
    risen = np.full(50, 30.0)
    assert left_in_own_cells(step, {own: np.array([0.5, -0.5]), other: risen}, True) < 0
    assert left_in_own_cells(step, {own: np.array([10.0, 10.0]), other: risen}, True) == pytest.approx(0.82, abs=0.01)
    assert left_in_own_cells(step, {own: np.array([21.0, 19.0]), other: risen}, True) == math.inf
    # a fall that is not in its own cells alone counts as well
    faint = replace(step, before={own: np.array([3.0, 0.0]), other: np.ones(50)})
    assert left_in_own_cells(faint, {own: np.array([0.0, 0.0]), other: np.full(50, 0.9)}, True) < 0


def test_what_fails_in_other_captures_takes_no_step_of_totals_away(lab):
    """A total is judged as other cells are where nothing else fails in its capture; else that may be its cause."""
    step = Step(
        candidate=next(c for c in candidates(lab()[0]) if c.name == "set dark_counts.rate"),
        values={},
        misfit=1.0,
        significance=26.0,
        material="",
        template={TOTALS: np.array([26.0, 0.0]), ("flat", "pixel_map"): np.full(4, 0.1)},
        before={TOTALS: np.array([26.2, 0.3]), ("flat", "pixel_map"): np.full(4, 8.0)},
    )
    after = {TOTALS: np.array([0.1, 0.3]), ("flat", "pixel_map"): np.full(4, 8.0)}
    assert left_in_own_cells(step, after, True, totals_alone=True) < 0
    assert left_in_own_cells(step, after, True, totals_alone=False) == math.inf
    assert left_in_own_cells(step, step.before, True, totals_alone=True) == math.inf  # it explains nothing


# --- what looks the same -----------------------------------------------------------------------------------------


def of(name: str, evaluation: Evaluation, replicates: Any, **sizes: float) -> Step:
    """A step whose trace has such sizes, each in one cell of a statistic of the flat field."""
    trace = {cell: np.zeros(len(z)) for cell, z in evaluation.residuals.items()}
    trace[TOTALS][:] = 7.0  # of totals, which anything may move
    for statistic, size in sizes.items():
        trace["flat", statistic][0] = size
    return Step(change_of(replicates, f"add {name}"), {}, 1.0, 20.0, "", template=trace)


def test_jitter_is_confused_where_only_intervals_tell(lab):
    """A dead time drawn anew for every detection blurs the same edge; what neighbours share it does not blur."""
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    found = mimicked(of("jitter", evaluation, replicates, intervals=30.0, edge_intervals=30.0, neighbours=3.9), [])
    assert found is not None and found.what == "a dead time that differs from event to event"
    assert mimicked(of("jitter", evaluation, replicates, intervals=30.0, neighbours=4.1), []) is None
    assert mimicked(of("crosstalk", evaluation, replicates, intervals=30.0), []) is None


def test_a_map_of_one_lit_capture_is_confused_with_one_of_the_light(lab):
    """Either explains what differs from pixel to pixel; two lit captures may have the lamp elsewhere."""
    replicates = bench_of(lab())
    step = Step(change_of(replicates, "per_pixel detection.pdp"), {}, 1.0, 20.0, "")
    (flat,) = (seen.capture for seen in replicates.seen.values() if not seen.capture.light.dark)
    dark = replace(flat, id="dark", light=replace(flat.light, wavelength=None, level=None))
    assert dark.light.dark
    found = mimicked(step, [flat, dark])
    assert found is not None and found.what == "light that is not uniform"
    assert mimicked(step, [flat, replace(flat, id="again"), dark]) is None
    assert mimicked(Step(change_of(replicates, "per_pixel dark_counts.rate"), {}, 1.0, 20.0, ""), [flat, dark]) is None


def test_what_looks_the_same_is_named_with_what_tells(lab):
    path = begin(bench_of(lab()))
    step = of("jitter", path.evaluation, path.replicates, intervals=30.0)
    path.steps.append(step)
    beside = Notes([], False)
    assert or_confused(path, beside, "explained") == "confused"
    assert step.alternatives[0]["what"] == "a dead time that differs from event to event"
    (told,) = beside.advice
    assert told["capture"] == "a pulsed source" and told["significance_then"] == 20.0
    assert told["separates"] == ["jitter", step.alternatives[0]["what"]]
    assert mimic(step.candidate) is not None
    path.steps = [of("crosstalk", path.evaluation, path.replicates, intervals=30.0)]
    assert or_confused(path, Notes([], False), "explained") == "explained"


def test_a_last_step_that_loses_a_line_is_not_taken(lab, monkeypatch):
    """Slopes do not know that an echo's line falls into the next bin."""
    path = begin(bench_of(lab()))
    candidate = change_of(path.replicates, "add crosstalk")
    coordinates = candidate.strengths
    path.values = {CROSSTALK: 0.01}
    further = point_of(coordinates, {CROSSTALK: 0.02})
    fit = Fit(coordinates, further, np.eye(1), {}, {}, 0.0, {CROSSTALK: 0.02})
    now = square(path.evaluation.residuals)
    for there, point in ((now + 1e3, 0.01), (now + 1.0, 0.02)):
        monkeypatch.setattr("spadmnist.inference.joint_fit.signatures", lambda *_, **__: [Signature({}, {}, {})])
        monkeypatch.setattr(
            "spadmnist.inference.joint_fit.square", lambda z, s=there: now if z is path.evaluation.residuals else s
        )
        held = bounded(path, fit)
        assert coordinates[0].value(float(held.point[0])) == pytest.approx(point)
    monkeypatch.setattr("spadmnist.inference.joint_fit.signatures", lambda *_, **__: [CannotSimulate("beyond")])
    assert coordinates[0].value(float(bounded(path, fit).point[0])) == pytest.approx(0.01)


@pytest.mark.slow
@pytest.mark.parametrize("fails", [True, False])
def test_where_something_is_wrong_few_recordings_do_not_hide_what_it_is(lab, monkeypatch, fails):
    """A candidate that could be chance by few recordings is looked at by many before the answer is that none fits."""
    path = begin(bench_of(lab()))
    one = Trial(change_of(path.replicates, "add crosstalk"), {CROSSTALK: 0.01}, Signature({}, {}, {}), 50.0, 1.0)
    monkeypatch.setattr(path.scan, "again", lambda *_: [one])
    monkeypatch.setattr("spadmnist.inference.forward_step.worth_fitting", lambda *_: [one])
    monkeypatch.setattr("spadmnist.inference.forward_step.evidence_of", lambda *_: 50.0)
    monkeypatch.setattr("spadmnist.inference.forward_step.patterns_first", lambda scan, evaluation, tried: tried)
    monkeypatch.setattr("spadmnist.inference.forward_step.fit_trial", lambda replicates, evaluation, one: one)
    monkeypatch.setattr("spadmnist.inference.forward_step.p_of_best", lambda *_: (3.0, 0.2))
    failed: Any = [object()] if fails else []
    beside = Notes([], False)
    assert best_added(path, beside, failed) == fails
    assert (len(path.evaluation.replicate_residuals[TOTALS]) > 16) == fails
    assert not best_added(path, beside, failed)  # and not again and again
    assert not path.steps


def test_of_what_is_faint_the_least_likely_is_chosen_and_not_the_largest(lab, monkeypatch):
    path = begin(bench_of(lab()))
    map_, other = (
        Trial(change_of(path.replicates, name), {}, Signature({}, {}, {}), gain, 1.0)
        for name, gain in (("per_pixel dark_counts.rate", -3.0), ("add slow_afterpulsing", 37.0))
    )
    monkeypatch.setattr("spadmnist.inference.forward_step.evidence_of", lambda replicates, evaluation, one: one.fall)
    monkeypatch.setattr(path.scan, "again", lambda *_: [map_, other])
    monkeypatch.setattr("spadmnist.inference.forward_step.worth_fitting", lambda *_: [map_, other])
    monkeypatch.setattr("spadmnist.inference.forward_step.patterns_first", lambda scan, evaluation, tried: tried)
    monkeypatch.setattr("spadmnist.inference.forward_step.fit_trial", lambda replicates, evaluation, one: one)
    monkeypatch.setattr(
        "spadmnist.inference.forward_step.p_of_best",
        lambda replicates, evaluation, tried, one, large: (4.0, 1e-5 if one is map_ else 1e-3),
    )
    taken: list[Trial] = []

    def accept(path: Any, best: Trial, significance: float) -> Any:
        taken.append(best)
        raise StopIteration

    monkeypatch.setattr("spadmnist.inference.forward_step.accept", accept)
    for failed in ([object()], []):
        with pytest.raises(StopIteration):
            best_added(path, Notes([], False), failed)  # type: ignore[arg-type]
    assert taken == [other, map_]
    assert map_.evidence == 16.0  # the square of its score, however the squares fall


@pytest.mark.parametrize(
    ("odd", "numbers", "first"),
    [(True, 0.9, "per_pixel dark_counts.rate"), (True, 0.2, "add blinking"), (False, 0.9, "add blinking")],
)
def test_a_map_of_pixels_that_chance_made_odd_is_as_unlikely_as_they_are(
    lab, monkeypatch, odd: bool, numbers: float, first: str
) -> None:
    """But only where it is their numbers that tell, and not as unlikely as what has nothing to do with pixels."""
    replicates = bench_of(lab())
    map_, codes, other = (
        Trial(change_of(replicates, name), {}, Signature({}, {}, {}), 50.0, 1.0)
        for name in ("per_pixel dark_counts.rate", "add tdc_nonlinearity", "add blinking_dark_counts")
    )
    map_.maps, codes.maps, other.chips = {(): None}, {(): None}, odd  # type: ignore[dict-item]
    monkeypatch.setattr("spadmnist.inference.evidence.share_of_counts", lambda *_: numbers)
    judged = {id(map_): (2.0, 0.02), id(codes): (2.1, 0.015), id(other): (4.0, 1e-4)}
    judge_maps_by_odd_pixels(replicates, evaluate(replicates, {}), [codes, map_, other], judged)
    best = best_of([codes, map_, other], lambda one: -judged[id(one)][1])
    assert best.candidate.name.startswith(first) and judged[id(best)] == (4.0, 1e-4)


def test_what_would_do_as_well_is_named_before_what_would_not(lab, monkeypatch) -> None:
    """However many of these there are: the maps that no count tells come last of all that is tried."""
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    names = ("crosstalk", "slow_afterpulsing", "source_noise", "flicker", "background_light", "blinking_dark_counts")
    best, *others = (
        Trial(change_of(replicates, f"add {name}"), {}, Signature({}, {}, {}), 0.0, 1.0, evidence=evidence)
        for name, evidence in zip(names, (100.0, 50.0, 40.0, 30.0, 20.0, 99.0), strict=True)
    )
    monkeypatch.setattr("spadmnist.inference.alternatives.failing", lambda *_: [])
    found = alternatives(quiet(replicates), evaluation, best, others)
    assert [(a["effect"], a["confused"]) for a in found] == [
        ("blinking_dark_counts", True),
        *((name, False) for name in names[1:4]),
    ]


def test_what_counts_and_what_sets_beside_each_other_is_told_apart(lab) -> None:
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    for name, low, high in (("per_pixel dark_counts.rate", 0.7, 1.0), ("add crosstalk", 0.0, 0.3)):
        candidate = change_of(replicates, name)
        if name.startswith("per_pixel"):
            rng = np.random.default_rng(1)
            usual = float(np.mean(evaluation.sensors.one.effect("dark_counts").rate))
            values = {
                ("dark_counts", "rate"): usual * np.exp(1.5 * rng.standard_normal(replicates.start.layout.pixels))
            }
        else:
            values = {CROSSTALK: 0.05}
        (signature,) = signatures(replicates, evaluation, [evaluation.sensors.changed(values)])
        assert isinstance(signature, Signature) and candidate.effect
        assert low <= share_of_counts(replicates, evaluation, signature) <= high, name


@pytest.mark.slow
def test_a_faint_step_must_help_along_its_own_trace(lab, monkeypatch) -> None:
    """Settled by chance at twice its strength and more, or with the other sign, it does not."""
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    one = Trial(change_of(replicates, "add crosstalk"), {CROSSTALK: 0.01}, Signature({}, {}, {}), 50.0, 1.0)
    (usual, much, less) = signatures(
        replicates, evaluation, [evaluation.sensors.changed({CROSSTALK: x}) for x in (0.02, 0.06, 0.01)]
    )
    one.signature = usual  # type: ignore[assignment]
    for data, there, good in ((4.0, usual, True), (4.0, much, False), (4.0, less, True), (-4.0, less, False)):
        found = ScoreTest(4.0, data, np.zeros(16), 1.0, 15.0)
        monkeypatch.setattr("spadmnist.inference.score_test.score_test", lambda *_, found=found: found)
        one.there = there  # type: ignore[assignment]
        assert explains_its_signature(replicates, evaluation, one) == good
    assert explains_its_signature(replicates, evaluation, replace(one, there=None)) and explains_its_signature(
        replicates, evaluation, replace(one, p_value=0.1)
    )
    # where few recordings show nothing of it beyond chance, all that they show is looked at
    monkeypatch.setattr(
        "spadmnist.inference.score_test.score_test", lambda *_: ScoreTest(4.0, 4.0, np.zeros(16), 1.0, 15.0)
    )
    unseen = replace(one, there=Signature({}, {}, {}))
    for fit, good in ((0.02, True), (0.06, False), (0.0, False), (0.003, False)):  # the last may be chance
        assert (
            explains_its_signature(
                replicates, evaluation, replace(unseen, sensors=evaluation.sensors.changed({CROSSTALK: fit}))
            )
            == good
        )


@pytest.mark.parametrize("rival", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_likelihood_of_one_of_two_laws_that_are_as_good_decides_nothing(lab, monkeypatch, rival: bool) -> None:
    """It moves the dead time to where checks fail: without a rival that is said, with one what was fitted stays."""
    sensor, data = lab(dead=55)
    path = begin(bench_of((sensor, data)))
    taken(path, "set dead_time.duration", {DURATION: 55e-9})
    (step,), evaluation = path.steps, path.evaluation
    step.alternatives = [{"confused": rival}]
    path.rung("+ another dead time")
    rows = [(rung.model, rung.misfit) for rung in path.ladder]
    usual, fit = dict(step.values), path.values[DURATION]
    check = SimpleNamespace(cell=("flat", "edge_intervals"))
    monkeypatch.setattr(ModelPath, "failed", property(lambda self: [] if self.evaluation is evaluation else [check]))
    exact = MaximumLikelihood({DURATION: 50e-9}, {DURATION: (49e-9, 51e-9)}, 0.0, False, (DURATION,), np.eye(1))
    monkeypatch.setattr("spadmnist.inference.intervals.maximise", lambda *_, **__: exact)
    sharpen(path, data)
    assert bool(path.failed) != rival and (path.evaluation is evaluation) == rival
    assert (step.values == usual) == rival
    assert path.values[DURATION] == (fit if rival else 50e-9) and fit != 50e-9
    path.last_rung()  # and the ladder ends with the model as it is now
    assert ([(rung.model, rung.misfit) for rung in path.ladder] == rows) == rival and len(path.ladder) == len(rows)
    assert path.ladder[-1].model == "+ another dead time" and path.ladder[-1].misfit == path.misfit
