"""Totals: how far from what is expected, where detections are few and where the light is faint."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from labs import bench_of
from scipy import stats

import spadmnist as sp
from spadmnist.effects import Conditions
from spadmnist.effects.afterpulsing import Afterpulsing
from spadmnist.inference.checks import BlockCheck, failing
from spadmnist.inference.count_model import CountModel
from spadmnist.inference.evaluation import Evaluation, evaluate
from spadmnist.inference.findings import nuisances
from spadmnist.inference.levels import FALSE_ALARM, SHARES
from spadmnist.inference.light_levels import CaptureNull, level_error, log_levels, totals_space
from spadmnist.inference.mean_alone import of_mean
from spadmnist.inference.replicates import TOTALS, Execution, Replicates
from spadmnist.recording import Capture, Light
from spadmnist.sensor import Sensor
from spadmnist.workers import Serial


def null_of(expected: Any, scatter: float) -> Any:
    """A capture's law: level -> detections, known without error."""
    draws = 1000
    return CaptureNull(1.0, 1.0, np.ones(draws), expected, (0.0, 1.0), scatter)


def score_of(replicates: Replicates, evaluation: Evaluation, id: str, total: float) -> float:
    """Standard deviations of a total, as the checks have it."""
    seen = replicates.seen[id]
    replicates.seen[id] = replace(seen, total=total)
    evaluation = replace(evaluation, space=None)
    x = log_levels(replicates, evaluation, [id], {id: math.log(max(total, 0.5))})[0]
    z = x / level_error(replicates, evaluation, id)
    replicates.seen[id] = seen
    return float(z)


@pytest.mark.slow
@pytest.mark.parametrize("mean", [5.6, 8.0, 15.0, 31.0, 100.0, 1000.0])
def test_few_dark_counts_alarm_as_often_as_they_should(lab, mean: float) -> None:
    """All totals that Poisson's law has, each with its probability: twice the level is allowed, for it is discrete."""
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    evaluation.rates["dark"] = null_of(lambda level: mean * level, 1 / math.sqrt(mean))
    totals = np.arange(int(mean + 12 * math.sqrt(mean)))
    z = np.array([score_of(replicates, evaluation, "dark", float(n)) for n in totals])
    assert np.all(np.diff(z) > 0)
    for level in (1e-2, 1e-3):
        p = stats.poisson.pmf(totals, mean)[2 * stats.norm.sf(np.abs(z)) < level].sum()
        assert p < 2 * level


def test_a_light_beside_which_the_dark_is_bright_is_judged_where_it_is_stated(lab) -> None:
    """10,000 dark counts and 200 of the light: their sum is normal, the logarithm of the light's level is not."""
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    spread = 1 / math.sqrt(10_200)
    evaluation.rates["flat"] = null_of(lambda level: 10_000 + 200 * level, spread)
    for z in (-1.5, 1.0, 2.0, 3.0, 4.0):
        total = 10_200 * math.exp(z * spread)
        assert score_of(replicates, evaluation, "flat", total) == pytest.approx(z, rel=0.02)


def test_a_leak_where_hardly_anything_is_expected_is_a_total(lab) -> None:
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    for expected, total, told in ((4.0, 400.0, True), (4.0, 3.0, False), (0.1, 400.0, False), (6.0, 0.0, True)):
        evaluation.rates["dark"] = null_of(lambda level, n=expected: n * level, 0.5)
        replicates.seen["dark"] = replace(replicates.seen["dark"], total=total)
        assert ("dark" in totals_space(replicates, replace(evaluation, space=None))[0]) == told


def test_a_sensor_without_dark_counts_is_not_judged_by_how_many_there_are(lab) -> None:
    """Nothing is expected, and no factor on nothing is more: what adds some is found by all else."""
    sensor, data = lab()
    bare = Sensor(sensor.layout, [e for e in sensor.effects if e.name != "dark_counts"], sensor.rules)
    replicates = Replicates(bare, data, 0, Execution(Serial()), 16)
    evaluation = evaluate(replicates, {})
    assert replicates.seen["dark"].total > 300 and totals_space(replicates, evaluation)[0] == ["flat"]
    assert np.all(np.isfinite(evaluation.residuals[TOTALS]))


class Unsaid(Afterpulsing, stage="correlated", abstract=True):
    """Afterpulsing that does not say how many detections it adds."""

    name = "unsaid"
    states_mean = False

    def expected_rate(self, rate, conditions):
        return rate


def test_an_effect_that_does_not_say_what_it_adds_is_simulated_as_bright_as_the_data(lab) -> None:
    """A quarter more detections: the replicates have the measured total, and nothing is extrapolated to it."""
    sensor, _ = lab()
    own = Sensor(sensor.layout, [*sensor.effects, Unsaid(probability=0.2, lifetime=200e-9)], sensor.rules)
    flat = sp.Capture("flat", "tr", wavelength=500e-9, irradiance=1e-3, relative_uncertainty=0.02, exposure=20e-3)
    data = sp.simulate(own, [flat], seed=1)
    replicates = Replicates(own, data, 0, Execution(Serial()), 16)
    evaluation = evaluate(replicates, {})
    made, total = evaluation.made["flat"].totals, replicates.seen["flat"].total
    assert made.min() < total < made.max()
    assert evaluation.rates["flat"].level == pytest.approx(evaluation.rates["flat"].stated)


def test_totals_have_the_share_of_false_alarms_that_compare_gives_them() -> None:
    def block(name: str, p: float) -> BlockCheck:
        return BlockCheck(("", name) if name in ("light", "rate 0", "rate 1") else (name, "map"), p, 0, 0.0)

    others = [block("flat", 0.5) for _ in range(50)]
    for kind, many in (("light", 1), ("rate 0", 2)):
        share = SHARES[kind.split()[0]] * FALSE_ALARM / many
        for p, fails in ((0.9 * share, True), (1.1 * share, False)):
            totals = [block(name, p if name == kind else 0.5) for name in ("light", "rate 0", "rate 1")]
            assert [b.p for b in failing([*totals, *others])] == ([p] if fails else [])
    for p, fails in ((0.9, True), (1.1, False)):  # without totals all of it is for the others
        one = block("flat", p * FALSE_ALARM / 51)
        assert failing([one, *others]) == ([one] if fails else [])
    # false alarms of 3 totals and 50 others, all independent: of 4000 sets 40 are expected, 76 at most (1e-6)
    rng, kinds = np.random.default_rng(1), ["light", "rate 0", "rate 1", *["flat"] * 50]
    sets = rng.uniform(size=(4000, 53))
    alarms = sum(bool(failing([block(k, float(p)) for k, p in zip(kinds, row, strict=True)])) for row in sets)
    assert 14 < alarms < 76


def test_a_capture_without_a_detection_says_nothing_of_the_light(lab) -> None:
    """Neither a traceback nor a light of a millionth."""
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    replicates.seen["flat"] = replace(replicates.seen["flat"], total=0.0)
    evaluation.rates["flat"] = null_of(lambda level: 6.0 + level, 0.4)
    assert nuisances(replicates, evaluation) == []


def counter(frames: int) -> Capture:
    conditions = Conditions(frames * 1e-4, frames, 1e-4, 1e-4, 500e-9, 12, "counter")
    return Capture("flat", "counts", Light(500e-9, 1.0, "irradiance", 0.0), conditions, 500.0)


def test_a_counter_has_more_than_one_detection_in_a_frame() -> None:
    """Poisson's scatter, not that of frames which are full."""
    seen = SimpleNamespace(capture=counter(100), counts=np.full(4, 500.0), waited=None)
    line = CountModel(SimpleNamespace(seen={"flat": seen}), "flat", 1.0)  # type: ignore[arg-type]
    assert line.variance(np.array([500.0]), 0.0)[0] == pytest.approx(500.0)
    assert not line.saturated(np.full(4, 500.0))
    expected = np.array([450.0, 500.0, 550.0])
    fit_ = [line.log_likelihood(np.full(4, x)).sum() for x in expected]
    assert fit_[1] > max(fit_[0], fit_[2])


def test_the_mean_of_a_counter_scatters_as_its_detections(lab, monkeypatch) -> None:
    replicates = bench_of(lab())
    monkeypatch.setattr("spadmnist.inference.mean_alone.closed_form", lambda sensor, capture: lambda level: 500.0 * 256)
    monkeypatch.setattr("spadmnist.twin.photons_at", lambda capture, layout: 1.0)
    null, _ = of_mean(replicates.start, counter(100), 500.0 * 256, 16)
    assert null.scatter == pytest.approx(1 / math.sqrt(500 * 256), rel=0.1)
