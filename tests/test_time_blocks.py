"""Halves of a capture by alternating blocks of time: what is fitted to one is judged by the other."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from labs import CROSSTALK, Lab, bench_of, change_of, labs, taken
from test_maps_of_pixels import CAPTURES, SENSOR, SIDE

from spadmnist import config, recording, twin
from spadmnist import measurement as measurements
from spadmnist.effects import Conditions
from spadmnist.events import Events, Layout
from spadmnist.inference.candidates import candidates, with_values
from spadmnist.inference.checks import block_checks, failing
from spadmnist.inference.error_budget import Rung, placebo_of
from spadmnist.inference.evaluation import evaluate
from spadmnist.inference.held_out import captures_needed, leave_one_capture_out
from spadmnist.inference.model_path import ModelPath, accept, begin
from spadmnist.inference.models import Model
from spadmnist.inference.reduction import halves_of
from spadmnist.inference.signature import Signature, signatures
from spadmnist.inference.time_blocks import jacobian_of_halves, measure, same_places
from spadmnist.inference.trial import Trial
from spadmnist.recording import COMMON_PERIOD, Capture, Light, Recording
from spadmnist.statistics import Summary

ODD, EVEN = halves_of("dark")


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return labs(tmp_path)


def stamps(exposure: float, tick: float | None, seed: int = 1, n: int = 4000) -> Recording:
    """Two pixels' time stamps, whole ticks or any times."""
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0, exposure, (2, n)), axis=1).ravel()
    offsets = np.array([0, n, 2 * n])
    whole = None if tick is None else np.floor(times / tick).astype(np.uint64)
    events = Events(times if tick is None else None, offsets, 2, whole, tick, end=exposure)
    capture = Capture("flat", "tr", Light(), Conditions(exposure, 1, exposure, exposure, None))
    return Recording(capture, Layout(1, 2, 1e-10, 1.0), events, None, tick)


@pytest.mark.parametrize(("exposure", "tick"), [(0.1, 1e-10), (4e-3, 1e-10), (3e-6, 1e-9), (0.1, None)])
def test_the_halves_of_time_stamps_are_all_of_them_in_turn(exposure: float, tick: float | None) -> None:
    """Put back where they were, they are the stamps of the capture, but for those at its very end."""
    whole = stamps(exposure, tick)
    assert whole.events is not None
    if tick is None:
        count, length = 16, exposure / 16
    else:
        count, ticks = recording._in_ticks(exposure / tick)
        length = ticks * tick
    found: list[np.ndarray] = []
    for second in (False, True):
        half = whole.every_other(second)
        assert half is not None and half.events is not None and half.events.problem(half.conditions.exposure) is None
        assert half.conditions.exposure == pytest.approx(count / 2 * length, rel=1e-9)
        assert half.conditions.exposure == half.conditions.frame_time == half.events.end
        assert half.tick == tick and half.capture.id == "flat"
        place = np.floor(half.events.times / length + 1e-9)
        back = half.events.times + (place + second) * length
        found.append(np.stack([half.events.rows, np.round(back / 1e-10)], axis=1))
    rejoined = np.concatenate(found)
    rejoined = rejoined[np.lexsort(rejoined.T[::-1])]
    kept = whole.events.times < count * length - 1e-12
    assert np.mean(kept) > 0.9 - 0.02
    all_ = np.stack([whole.events.rows[kept], np.round(whole.events.times[kept] / 1e-10)], axis=1)
    assert np.array_equal(rejoined, all_[np.lexsort(all_.T[::-1])])


def test_a_converter_keeps_its_phase_where_the_capture_is_long_enough() -> None:
    for exposure, blocks_, kept in ((0.1, 16, True), (4e-3, 8, True), (0.29e-3, 4, True), (0.2e-3, 16, False)):
        count, length = recording._in_ticks(exposure / 1e-10)
        assert count == blocks_ and (length % COMMON_PERIOD == 0) == kept
    whole = stamps(0.1, 1e-10)
    assert whole.events is not None and whole.events.ticks is not None
    coarse = Events(None, whole.events.offsets, 2, whole.events.ticks // 140 * 140, 1e-10, end=0.1)
    for second in (False, True):
        half = replace(whole, events=coarse, _kept={}).every_other(second)
        assert half is not None and half.events is not None and half.events.ticks is not None
        assert len(half.events) > 3000 and not np.any(half.events.ticks % 140)


@pytest.mark.parametrize("modality", ["qis", "str", "counts"])
@pytest.mark.parametrize("frames", [1, 3, 7, 16, 31, 100])
def test_the_halves_of_frames_are_all_of_them_in_turn(modality: str, frames: int) -> None:
    numbered = np.arange(frames, dtype=np.uint8 if modality == "qis" else np.uint32)[:, None, None] + np.zeros(
        (1, 2, 3), np.uint8 if modality == "qis" else np.uint32
    )
    summed = 255 if modality == "counts" else 1
    conditions = Conditions(frames * summed * 2e-6, frames * summed, 1e-6, 2e-6, None, 8 * (summed > 1))
    capture = Capture("flat", modality, Light(), conditions)
    whole = Recording(capture, Layout(2, 3, 1e-10, 1.0), None, numbered, 1e-9 if modality == "str" else None)
    halves = [whole.every_other(second) for second in (False, True)]
    if frames == 1:
        assert halves == [None, None]
        return
    read = []
    for half in halves:
        assert half is not None and half.frames is not None
        assert (
            half.frames.shape == np.asarray(half.frames[:]).shape and half.conditions.frames == summed * half.n_frames
        )
        assert half.conditions.exposure == pytest.approx(half.conditions.frames * 2e-6)
        piece = np.concatenate([np.asarray(half.frames[k : k + 2]) for k in range(0, half.n_frames, 2)])
        assert np.array_equal(piece, half.frames[:])
        read.append(piece[:, 0, 0].tolist())
    length = {3: 1, 7: 1, 16: 1, 31: 7, 100: 6}[frames]
    assert (len(read[0]) == len(read[1]) and 2 * len(read[0]) > 0.9 * frames) or frames < 9
    assert sorted(read[0] + read[1]) == list(range(2 * len(read[0])))
    assert all(k // length % 2 == 0 for k in read[0]) and all(k // length % 2 == 1 for k in read[1])


def test_a_capture_too_short_for_blocks_has_no_halves() -> None:
    assert stamps(1e-9, 1e-10, n=5).every_other(False) is None


@pytest.mark.slow
def test_the_halves_of_a_right_model_are_as_wide_as_its_own(lab) -> None:
    """Every cell of both halves, beside the model that made the data; false alarm 1e-6 by Holm over all checks."""
    replicates = bench_of(lab(side=4), 32)
    half = replicates.halves(["flat"])
    assert list(half.seen) == list(halves_of("flat"))
    assert sum(seen.total for seen in half.seen.values()) == pytest.approx(replicates.seen["flat"].total, rel=0.1)
    sensors = Model.same(replicates.start).under(lambda name: "flat")
    evaluation = evaluate(half, {}, sensors)
    assert not failing(block_checks(half, evaluation, evaluation.residuals), 1e-6)
    wrong = evaluate(half, {}, Model.same(with_values(replicates.start, {CROSSTALK: 0.05})).under(lambda name: "flat"))
    assert failing(block_checks(half, wrong, wrong.residuals), 1e-6)
    # both are cut from the same recordings of the whole capture
    odd, even = (evaluation.made[name].totals for name in half.seen)
    alone = evaluate(replicates, {}).made["flat"].totals[: len(odd)]
    assert np.all(odd + even <= alone) and np.all(odd + even > 0.9 * alone) and not np.array_equal(odd, even)


def test_a_number_of_one_capture_is_judged_by_its_other_half(lab) -> None:
    """What odd blocks want more of, even ones want less of: each is as far from what the other says as both are."""
    replicates = bench_of(lab())
    half = replicates.halves(["flat"])
    statistic = "pixel_map"
    cells = len(replicates.seen["flat"].summaries[statistic].values)
    whole = np.linspace(1.0, 2.0, cells)[:, None]
    found = jacobian_of_halves(replicates, half, {("flat", statistic): whole, ("dark", statistic): whole}, {"flat"})
    odd, even = ((name, statistic) for name in halves_of("flat"))
    assert found.keys() == {odd, even}
    for cell in (odd, even):
        share = half.seen[cell[0]].total / replicates.seen["flat"].total
        assert found[cell] == pytest.approx(whole * math.sqrt(share), rel=1e-12)
    spectrum = np.ones((len(replicates.seen["flat"].summaries["spectrum"].values), 1))
    other = jacobian_of_halves(replicates, half, {("flat", "spectrum"): spectrum}, {"flat"})
    assert len(other) == 2 and not any(x.any() for x in other.values())  # it has other frequencies
    first, second = found[odd][:, 0], found[even][:, 0]
    back = 2 * float(first @ first) / float(second @ second)
    left = leave_one_capture_out({odd: 2 * first, even: -back * second}, found)
    assert left[odd] == pytest.approx((2 + back) * first, rel=1e-6)
    assert left[even] == pytest.approx(-(2 + back) * second, rel=1e-6)


def test_cells_that_look_elsewhere_follow_nothing() -> None:
    """Of a shorter capture there are fewer windows; a spectrum has other frequencies, and none is taken for another."""

    def summary(axis: list[float] | None, n: int = 0) -> Summary:
        values = np.zeros(n if axis is None else len(axis))
        return Summary(values, "normal", str, lambda *_: ("", 0.0), axis=None if axis is None else np.array(axis))

    here, there = same_places(summary([1.0, 2.0, 4.0]), summary([1.01, 2.0, 4.5, 9.0]))
    assert here.tolist() == [0, 1] and there.tolist() == [0, 1]
    here, there = same_places(summary([5.0, 6.0]), summary([1.0, 2.0]))  # as many: trends, maps
    assert here.tolist() == there.tolist() == [0, 1]
    for a, b in ((summary(None, 3), summary([1.0, 2.0])), (summary([1.0]), summary(None, 4))):
        assert not len(same_places(a, b)[0])


def mapped(tmp_path: Path) -> tuple[ModelPath, Rung]:
    """A map of dark count rates, of the one dark capture that there is; (the course, its last rung)."""
    (tmp_path / "plan.yaml").write_text(CAPTURES)
    (tmp_path / "sensor.yaml").write_text(SENSOR.replace("200 Hz", "2 kHz"))
    sensor = config.read_sensor(tmp_path / "sensor.yaml").resolved()
    rates = 2000 * np.exp(0.3 * np.random.default_rng(4).standard_normal(SIDE**2))
    truth = with_values(sensor, {("dark_counts", "rate"): rates})
    plan = measurements.open(tmp_path / "plan.yaml", planned=True)
    data = measurements.open(twin.simulate(truth, plan, tmp_path / "lab", 5))
    path = begin(bench_of((sensor, data), 32))
    candidate = next(c for c in candidates(sensor) if c.name == "per_pixel dark_counts.rate")
    accept(path, Trial(candidate, {}, Signature({}, {}, {}), 0.0, 1.0, maps={}, p_value=1e-9), 1.0)
    return path, path.ladder[-1]


@pytest.mark.slow
def test_a_map_that_one_capture_tells_is_judged_by_the_other_half_of_it(tmp_path: Path) -> None:
    """Settled to all of it the map leaves nothing of 400 pixels; beside the other half they scatter as they should.

    Squares of 800 normal cells: 1 +- 0.05; five times that, and a tenth for 16 recordings and a prior of pixels.
    """
    path, rung = mapped(tmp_path)
    cell = ("dark", "pixel_map")
    assert float(np.mean(rung.left[cell] ** 2)) < 0.4
    step, before = path.steps[0], path.ladder[0].misfit
    usual = measure(path.replicates, path.ladder)
    assert {key[0] for key in rung.left} - {""} == {ODD, EVEN} == {key[0] for key in path.ladder[0].left} - {""}
    both = np.concatenate([rung.left[name, "pixel_map"] for name in (ODD, EVEN)])
    assert float(np.mean(both**2)) == pytest.approx(1.0, abs=0.35)
    assert path.ladder[0].misfit > 2 * rung.misfit and path.ladder[0].misfit != before
    assert step.misfit == rung.misfit and 1 < usual < 1.5


def test_captures_that_others_judge_stay_as_they_are(lab) -> None:
    """No number, or two captures that tell it alike: nothing is cut, and nothing simulated for it."""
    path = begin(bench_of(lab()))
    misfit, simulations = path.ladder[0].misfit, path.replicates.simulations
    usual = measure(path.replicates, path.ladder)
    assert path.ladder[0].misfit == misfit and path.replicates.simulations == simulations and usual > 0.5
    rng = np.random.default_rng(3)
    z = {(id, "x"): rng.standard_normal(9) for id in "ab"}
    alike = {cell: np.ones((9, 1)) for cell in z}
    assert captures_needed(z, alike) == set()
    assert captures_needed(z, {**alike, ("a", "x"): np.full((9, 1), 3.0)}) == {"a"}
    assert captures_needed(z, {cell: np.zeros((9, 1)) for cell in z}) == set()


def test_a_placebo_is_as_strong_in_halves_as_in_the_whole(lab) -> None:
    """Of directions side by side, too: the one that was tried is not set back to none."""
    replicates = bench_of(lab(side=4))
    evaluation = evaluate(replicates, {})
    gradient, crosstalk = (change_of(replicates, f"add {name}") for name in ("illumination_gradient", "crosstalk"))
    x, other = ("illumination_gradient", "x"), ("illumination_gradient", "y")
    values = {**dict(gradient.fixed), x: 0.1}
    (signature,) = signatures(replicates, evaluation, [evaluation.sensors.changed(values)])
    assert isinstance(signature, Signature)
    tried = Trial(gradient, values, signature, 5.0, 0.5)
    best = Trial(crosstalk, {CROSSTALK: 0.01}, signature, 9.0, 1.0)
    rung = placebo_of(replicates, evaluation, [tried], best, {"crosstalk"})
    assert rung is not None and rung.placebo is not None and rung.row["placebo"]
    assert rung.placebo[x] == pytest.approx(0.05) and rung.placebo[other] == 0
    tried.fall = -1.0  # what only makes it worse is added with no strength at all
    idle = placebo_of(replicates, evaluation, [tried], best, {"crosstalk"})
    assert idle is not None and idle.placebo == {} and idle.row["placebo"]


@pytest.mark.slow
def test_the_ladder_of_a_number_that_one_capture_tells(lab) -> None:
    path = begin(bench_of(lab("    crosstalk: {probability: 3 %}\n", side=4)))
    taken(path, "add crosstalk", {CROSSTALK: 0.03})
    first, last = path.ladder
    whole = last.misfit
    measure(path.replicates, path.ladder)
    cut = {key[0] for key in last.left} - {"", "dark", "flat"}
    assert {key[0] for key in first.left} == {key[0] for key in last.left}  # the same cells
    assert cut and path.steps[0].misfit == last.misfit != whole
    assert first.misfit > 2 > 1.5 > last.misfit
