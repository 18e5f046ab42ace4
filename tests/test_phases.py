"""What swings, at any phase and strength, from what it does at a few phases."""

from __future__ import annotations

import math

import numpy as np
import pytest
from labs import bench_of, change_of

from spadmnist.inference.candidates import with_values
from spadmnist.inference.evaluation import evaluate, square
from spadmnist.inference.evidence import evidence_of
from spadmnist.inference.model_path import begin
from spadmnist.inference.phases import PeriodicSignature, choose_phase, simulate_phases
from spadmnist.inference.signature import Signature, residuals_at
from spadmnist.inference.trial import Trial
from spadmnist.inference.trial_fits import fit_trial

EIGHT = 2 * np.pi * np.arange(8) / 8
FLICKER = "    flicker: {amplitude: %s, frequency: 100 Hz, phase: 0.7 rad}\n"
AMPLITUDE, FREQUENCY, PHASE = (("flicker", name) for name in ("amplitude", "frequency", "phase"))


def literal(x: float, p: float) -> np.ndarray:
    """A swing through a trend (its sign), a power (whatever its sign) and a sum over half a turn (both)."""
    s = x * math.sin(0.3 + p)
    return np.array([3 * x * math.cos(p), 5 * x**2, 2 * s + s**2])


@pytest.mark.parametrize("strength", [-0.7, 0.1, 1.0, 2.5])
def test_phases_all_round_tell_every_phase_and_strength(strength: float) -> None:
    cell = "flat", "trend"
    turned = [Signature({cell: literal(1.0, p)}, {cell: 0.8}, {"flat": 2 * math.sin(p)}) for p in EIGHT]
    swing = PeriodicSignature.of(turned, EIGHT)
    for p in (0.0, 1.1, 4.0):
        signature = swing.at({"flat": p}).at(strength)
        assert signature.shifts[cell] == pytest.approx(literal(strength, p), abs=1e-12)
        assert signature.logs["flat"] == pytest.approx(2 * strength * math.sin(p), abs=1e-12)
        assert signature.noise[cell] == pytest.approx(0.1 * strength**2)  # eight say it


def test_a_cell_that_some_phases_leave_alone() -> None:
    cell = "flat", "trend"
    turned = [Signature({cell: np.array([max(0.0, math.cos(p))])} if math.cos(p) > 0.1 else {}, {}, {}) for p in EIGHT]
    found = PeriodicSignature.of(turned, EIGHT).at({"flat": 0.0}).at(1.0).shifts[cell]
    assert 0.8 < found[0] < 1.2


@pytest.mark.parametrize(("amplitude", "seed"), [pytest.param(0.3, 0, marks=pytest.mark.slow), (0.12, 1)])
def test_strength_and_phase_are_fitted(lab, amplitude: float, seed: int) -> None:
    """By a trace eight times as strong, or half: 20 ms of 100 Hz, about 18,000 detections of 10,000 a pixel and s.

    A known sine tells its amplitude to root(2 / n) and its phase to that / amplitude; six standard deviations are
    allowed (false alarms: 1e-8 each), for statistics do not hold all of it.
    """
    replicates = bench_of(lab(FLICKER % amplitude, seed=seed, light=400), 32)
    evaluation = evaluate(replicates, {})
    candidate = change_of(replicates, "add flicker")
    values = {AMPLITUDE: 0.06 if amplitude > 0.2 else 0.24, FREQUENCY: 100.0}
    swing = simulate_phases(replicates, evaluation, [PHASE], values, 6)
    assert isinstance(swing, PeriodicSignature)
    gain, times, phases = swing.best_fit(replicates, evaluation)
    one = Trial(candidate, values, swing.at(phases), gain, times, phases={(id, PHASE): p for id, p in phases.items()})
    found = fit_trial(replicates, evaluation, one)
    error = math.sqrt(2 / replicates.seen["flat"].total)
    assert found.fall > 0.3 * (amplitude / error) ** 2
    assert found.values[AMPLITUDE] == pytest.approx(amplitude, abs=6 * error)
    off = (found.phases["flat", PHASE] - 0.7 + math.pi) % (2 * math.pi) - math.pi
    assert abs(off) < 6 * error / amplitude + math.radians(2)
    assert found.times == 1 and found.scaled() == found.values  # what it does is what it does at these values
    again = residuals_at(replicates, evaluation, found.signature)
    assert found.fall == pytest.approx(square(evaluation.residuals) - square(again))
    evidence = evidence_of(replicates, evaluation, found)  # two in chi square for the amplitude and each phase
    assert evidence == pytest.approx(found.fall - 2 * len(found.phases) - 2)
    assert found.fit is not None
    _, low, high = found.fit.interval(0)
    assert low < found.values[AMPLITUDE] < high and high - low < 12 * error


def test_the_other_phase_with_the_same_total() -> None:
    """Of sin(p) it is pi - p; where it is the largest there is no other."""
    swing = PeriodicSignature({}, {}, {"flat": np.array([0.0, 1.0, 0.0, 0.0, 0.0])})
    for phase in (0.5, 2.0, 3.5, 5.9):
        apart = (swing.mirror_phase("flat", phase, 0.3) - (math.pi - phase)) % (2 * math.pi)
        assert min(apart, 2 * math.pi - apart) < 2 * math.pi / 360
    assert swing.mirror_phase("flat", math.pi / 2, 0.3) == math.pi / 2


@pytest.mark.slow
@pytest.mark.parametrize("phase", [0.3, math.pi - 0.3])
def test_a_capture_shorter_than_a_swing_rises_or_falls(lab, monkeypatch, phase: float) -> None:
    """A tenth of a period: its total is the same for both phases, and no single cell of a few recordings tells."""
    values = {("flicker", "amplitude"): 0.2, ("flicker", "frequency"): 5.0}
    truth = f"    flicker: {{amplitude: 0.2, frequency: 5 Hz, phase: {phase} rad}}\n"
    sensor, measured = lab(truth, light=1000)
    replicates = bench_of((sensor, measured))
    evaluation = evaluate(replicates, {})
    right, wrong = {"dark": 0.0, "flat": phase}, {"dark": 0.0, "flat": math.pi - phase}
    for first, other in ((right, wrong), (wrong, right)):
        assert choose_phase(replicates, evaluation, [PHASE], values, first, other) == right
    assert choose_phase(replicates, evaluation, [PHASE], values, right, right) == right
    # and where the sensor is known to swing so, whichever is found first; the mean phase is that of the middle
    known = bench_of((with_values(sensor, values), measured))
    swept = 2 * math.pi * 5.0 * 0.02
    for first in (phase, (math.pi - phase - swept) % (2 * math.pi)):
        monkeypatch.setattr(
            PeriodicSignature, "best_fit", lambda *a, first=first: (0.0, 1.0, {"dark": 0.0, "flat": first})
        )
        off = (begin(known).scan.phases["flat", PHASE] - phase + math.pi) % (2 * math.pi) - math.pi
        assert abs(off) < 0.2
