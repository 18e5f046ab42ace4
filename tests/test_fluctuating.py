"""Light that is another in every recording: what a few of them tell of it, and how it is judged."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from labs import CROSSTALK, bench_of, change_of, names, taken

from spadmnist.inference.candidates import with_values
from spadmnist.inference.elimination import drop_needless
from spadmnist.inference.evaluation import evaluate, log_likelihood_ratio
from spadmnist.inference.evidence import evidence_of
from spadmnist.inference.gauss_newton import gauss_newton_step
from spadmnist.inference.joint_fit import bounded, repeated_steps
from spadmnist.inference.laws import Law
from spadmnist.inference.model_path import begin
from spadmnist.inference.replicates import TOTALS
from spadmnist.inference.signature import Sampling, Signature, mean_deviation, signatures
from spadmnist.inference.trial import Trial
from spadmnist.inference.trial_fits import fit_trial

CONTRAST, COHERENCE = ("source_noise", "contrast"), ("source_noise", "coherence_time")
STEADY = 1 + 0.1 * np.random.Generator(np.random.PCG64(1)).standard_normal(32)  # mean squares of replicates
TREND, MANY = ("flat", "trend"), ("flat", "fine_intervals")


def test_totals_that_go_the_same_way_in_two_recordings_are_chance(lab) -> None:
    """The power is 1 in the mean, whatever it is in the two recordings that a first look has."""
    replicates = bench_of(lab(light=1000))
    evaluation = evaluate(replicates, {})
    coherence = [1e-3, 3e-3, 1e-2, 3e-2]  # of an exposure of 20 ms
    models = [evaluation.sensors.changed({CONTRAST: 0.1, COHERENCE: x}) for x in coherence]
    for signature in signatures(replicates, evaluation, models, Sampling(few=2, kept="sure")):
        assert isinstance(signature, Signature)
        assert signature.fluctuates
        assert all(abs(log) < 1e-6 for log in signature.logs.values())
    # nor are four of them sure of it, of which a slope is made: they are far less alike than the model's own
    for signature in signatures(replicates, evaluation, models, Sampling(few=4)):
        assert isinstance(signature, Signature)
        assert all(abs(log) < 1e-6 for log in signature.logs.values())
    # what adds detections in every recording is none of these
    (signature,) = signatures(
        replicates, evaluation, [evaluation.sensors.changed({("afterpulsing", "probability"): 0.1})], Sampling(few=4)
    )
    assert isinstance(signature, Signature)
    assert not signature.fluctuates


@pytest.mark.parametrize(
    ("apart", "believed"),
    [
        ([0.03, 0.035], False),  # two: their mean scatters by 0.007 as the model's own do; 1.5 times as much is alike
        ([0.04, 0.045], True),
        ([0.04, 0.05, 0.06, 0.05], True),  # as alike as the model's own, and far from 0
        ([0.00, 0.10, 0.02, 0.08], False),  # the mean is 0.05 as well, but of light that is another one in each
        ([0.05, 0.10, 0.02, 0.08, 0.07, 0.04, 0.01, 0.09], False),  # 5.5 standard errors: of eight 1 in 1000
        ([0.25, 0.30, 0.22, 0.28, 0.27, 0.24, 0.21, 0.29], True),  # it fluctuates, and there is more of it
    ],
)
def test_what_a_few_totals_share(apart: list[float], believed: bool) -> None:
    """Their scatter in the model's own recordings: 1 %."""
    shared = mean_deviation(np.array(apart), 0.01)
    assert shared == (pytest.approx(np.mean(apart)) if believed else 0.0)


def test_a_lamp_is_seen_to_fluctuate_beside_a_chip_that_is_not_known_exactly(lab) -> None:
    replicates = bench_of(lab(light=1000))
    sensors = evaluate(replicates, {}).sensors.changed({}, chips=True)
    evaluation = evaluate(replicates, {}, sensors)
    for contrast in (0.1, 1e-4):
        (signature,) = signatures(
            replicates, evaluation, [sensors.changed({CONTRAST: contrast, COHERENCE: 3e-3})], Sampling(few=4)
        )
        assert isinstance(signature, Signature)
        assert signature.fluctuates == (contrast > 0.01)


def test_what_fluctuates_is_judged_by_how_wide_it_is() -> None:
    """Six numbers and three totals that are three times as wide: -2 log 3 for each, if they are as wide as stated.

    Of a thousand cells that it neither moves nor widens none counts.
    """
    z, totals = np.array([3.0, -4.0, 2.0, 3.5, -2.0, 1.0]), np.array([4.0, -3.0, 2.0])

    def evaluation(width: float, other: float) -> Any:
        null = {
            TREND: SimpleNamespace(breadth=width, factor=1.0, law=Law(), replicate_squares=STEADY),
            MANY: SimpleNamespace(breadth=1.0, factor=1.0, law=Law(), replicate_squares=STEADY),
        }
        left = {TREND: z / width, MANY: np.full(1000, other), TOTALS: totals / width}
        return SimpleNamespace(nulls=null, residuals=left, space=([], np.ones(3), np.eye(3) / width, np.zeros(3)))

    trace = {TREND: np.zeros(6), MANY: np.zeros(1000), TOTALS: np.zeros(3)}
    now, there = evaluation(1.0, 1.2), evaluation(3.0, 1.0)
    exact = float(z @ z + totals @ totals) * (1 - 1 / 9) - 2 * 9 * math.log(3)
    assert log_likelihood_ratio(now, there, trace) == pytest.approx(exact)
    # data that are no wider than the model's own do not speak for it
    quiet_now, quiet_there = evaluation(1.0, 1.0), evaluation(3.0, 1.0)
    for one, width in ((quiet_now, 1.0), (quiet_there, 3.0)):
        one.residuals = {TREND: np.ones(6) / width, MANY: np.ones(1000), TOTALS: np.ones(3) / width}
    assert log_likelihood_ratio(quiet_now, quiet_there, trace) == pytest.approx(9 * (8 / 9 - 2 * math.log(3)))


@pytest.mark.slow
def test_a_lamp_that_drifts_about_for_long_is_judged_by_its_totals_too(lab) -> None:
    """Its coherence time is the exposure: most that one recording has of it is another total, which no trace has."""
    noise = "    source_noise: {contrast: 0.2, coherence_time: 40 ms}\n"
    replicates = bench_of(lab(noise, light=1000, seed=3))
    evaluation = evaluate(replicates, {})
    assert float(np.max(np.abs(evaluation.residuals[TOTALS]))) > 4.0
    values = {CONTRAST: 0.15, COHERENCE: 30e-3}
    (signature,) = signatures(
        replicates, evaluation, [evaluation.sensors.changed(values)], Sampling(few=8, kept="sure")
    )
    assert isinstance(signature, Signature)
    one = fit_trial(
        replicates, evaluation, Trial(change_of(replicates, "add source_noise"), values, signature, 0.0, 1.0)
    )
    squares = sum(float(z @ z) for z in evaluation.residuals.values())
    fall = squares - sum(float(z @ z) for z in (one.residuals or {}).values())
    assert evidence_of(replicates, evaluation, one) > fall + 8.0
    assert one.fluctuates


@pytest.mark.slow
@pytest.mark.parametrize("contrast", [0.2, 0.0])
def test_a_lamp_is_missed_where_it_made_the_totals_wider(lab, contrast: float) -> None:
    """Beside later steps: judged by how wide it makes them itself, nothing would ever be missed without it."""
    noise = f"    source_noise: {{contrast: {contrast}, coherence_time: 2 s}}\n" if contrast else ""
    path = begin(bench_of(lab("    crosstalk: {probability: 3 %}\n" + noise, light=1000, seed=2)))
    taken(path, "add source_noise", {CONTRAST: 0.2, COHERENCE: 2.0}, fitted=False)
    taken(path, "add crosstalk", {CROSSTALK: 0.03}, fitted=False)
    drop_needless(path)
    assert names(path) == ["add source_noise", "add crosstalk"][0 if contrast else 1 :]


@pytest.mark.slow
def test_numbers_of_a_lamp_that_fluctuates_are_followed_by_many_recordings(lab, monkeypatch) -> None:
    """Of any other model a few recordings tell how the cells follow its numbers: they are the same in each.

    Whether the sensor has such a lamp from the start or was given it is no matter.
    """
    many: list[int] = []
    step, simulated = gauss_newton_step, signatures
    monkeypatch.setattr("spadmnist.inference.joint_fit.gauss_newton_step", lambda *a: many.append(a[5].few) or step(*a))
    for noise, lamp, replicates in [(False, False, 40), (False, True, 40), (False, True, 16), (True, True, 40)]:
        stated = f"    source_noise: {{contrast: {0.2 if lamp else 0.0}, coherence_time: 20 ms}}\n"
        sensor, data = lab(stated if lamp else "", light=1000)
        if noise:
            sensor = with_values(sensor, {CONTRAST: 0.2, COHERENCE: 20e-3})
        path = begin(bench_of((sensor, data), replicates))
        if lamp and not noise:
            path.evaluation = evaluate(path.replicates, {CONTRAST: 0.2, COHERENCE: 20e-3})
        held: list[int] = []
        with monkeypatch.context() as patch:
            patch.setattr("spadmnist.inference.joint_fit.signatures", lambda *a: held.append(a[3].few) or simulated(*a))  # noqa: B023
            coordinates = tuple(change_of(path.replicates, "add crosstalk").coordinates[:1])
            path.values[CROSSTALK] = 0.01
            found, _, _ = repeated_steps(path, path.evaluation, {}, coordinates)
            assert found is not None
            held.clear()
            bounded(path, found)
        wanted = min(replicates, 32) if lamp else 8
        assert many[-1] == held[0] == wanted
