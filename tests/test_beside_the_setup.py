"""Effects beside a fault of the set-up: totals that it explains do not hide what the other statistics show."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from labs import bench_of, labs

import spadmnist as sp
from spadmnist.inference.conclusion import Notes, left_over
from spadmnist.inference.evaluation import as_compared
from spadmnist.inference.levels import HALF_95
from spadmnist.inference.model_path import begin
from spadmnist.inference.model_selection import diagnose, is_as_stated, is_freed, take_setup_again
from spadmnist.inference.next_step import after_diagnosis
from spadmnist.inference.replicates import TOTALS
from spadmnist.inference.results import Step, sentence
from spadmnist.inference.setups import Factor, SetupExplanation, captures_of
from spadmnist.inference.trial import Trial
from spadmnist.measurement import Measurement, in_memory

PHOTON = 6.62607015e-34 * 299792458.0 / 500e-9  # J
ENTRY = {"capture": "flat", "quantity": "light", "factor": {"value": 1.1, "low": 1.0, "high": 1.2}, "confused": True}


def stated_at(data: Measurement, sensor: sp.Sensor, id: str, factor: float) -> Measurement:
    """The same recordings, the light of one of which is stated wrong by this factor."""
    made = []
    for capture in data.captures:
        recording = data.recording(capture.id, sensor)
        if capture.id == id:
            assert capture.light.level is not None
            light = replace(recording.capture.light, level=capture.light.level * factor)
            recording = replace(recording, capture=replace(recording.capture, light=light))
        made.append(recording)
    return in_memory("lab", sensor.layout, made)


@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_a_set_up_fault_stays_unless_the_steps_explain_the_totals(factor: float, tmp_path: Path) -> None:
    sensor, data = labs(tmp_path)()
    path = begin(bench_of((sensor, stated_at(data, sensor, "flat", factor))))
    stated, errors = path.evaluation, path.ladder[0].errors
    short = {**ENTRY, "quantity": "exposure"}  # it stopped early, whatever the totals say
    notes = Notes([entry := dict(ENTRY), short], explained=True, by_totals=[entry])
    kept = path.kept()
    assert is_freed(path, notes) and path.replicates.unstated == {"flat"}
    free = path.evaluation
    assert len(free.residuals[TOTALS]) == 1 < len(stated.residuals[TOTALS]) == 2
    assert free.replicate_residuals[TOTALS].shape == (16, 1) and free.residuals.keys() == stated.residuals.keys()
    path.rung("the same")
    assert path.ladder[1].errors == pytest.approx(errors)  # whether they are compared or not
    assert not is_as_stated(path, notes)  # without a step
    path.steps = [cast(Step, object())]
    as_stated = factor == 1
    assert is_as_stated(path, notes) is as_stated
    assert notes.explained is not as_stated and notes.setup == ([short] if as_stated else [entry, short])
    assert path.replicates.unstated == (frozenset() if as_stated else {"flat"})
    assert len(path.evaluation.residuals[TOTALS]) == (2 if as_stated else 1)
    path.back_to(kept)
    assert path.replicates.unstated == frozenset() and path.evaluation is stated
    assert as_compared(path.replicates, stated) is stated
    path.replicates.unstated = frozenset({"flat"})  # a model without steps is compared without this total as well
    assert len(as_compared(path.replicates, stated).residuals[TOTALS]) == 1
    path.back_to(kept)
    take_setup_again(path, notes)  # the step is gone
    assert notes.explained is not as_stated and notes.setup == ([short] if as_stated else [entry, short])


def test_the_set_up_excuses_the_totals_that_it_explains_and_no_others() -> None:
    totals, other = (SimpleNamespace(cell=cell) for cell in (TOTALS, ("flat", "spacing")))
    path: Any = SimpleNamespace(failed=[totals], replicates=SimpleNamespace(unstated=frozenset()))
    explained = Notes([dict(ENTRY)], explained=True)
    assert left_over(path, explained) == [] and left_over(path, Notes([])) == [totals]
    path.replicates.unstated = frozenset({"flat"})  # whose level is free: the total of another capture fails
    assert left_over(path, explained) == [totals]
    path.failed, path.replicates.unstated = [totals, other], frozenset()
    assert left_over(path, explained) == [totals, other]
    path.failed = []
    assert left_over(path, explained) == []


def test_levels_are_not_freed_where_a_change_of_the_sensor_is_a_tie(tmp_path: Path) -> None:
    path = begin(bench_of(labs(tmp_path)()))
    notes = Notes([dict(ENTRY)], explained=True, by_totals=[dict(ENTRY)], rival=cast(Trial, object()))
    assert not is_freed(path, notes) and path.replicates.unstated == frozenset()
    notes.rival = None
    assert is_freed(path, notes) and path.replicates.unstated == {"flat"}


def test_explanations_of_the_totals_in_words_and_in_parts() -> None:
    low, high, all_ = (Factor("light", ids, len(ids) > 1) for ids in (("low",), ("high",), ("low", "high")))
    both = SetupExplanation((low, high), np.array([0.1, 0.2]), np.array([0.01, 0.02]), np.array([1.0, 2.0]))
    one = SetupExplanation((all_,), np.array([0.1]), np.array([0.01]), np.array([3.0, 1.0]))
    other = SetupExplanation((low,), np.array([0.1]), np.array([0.01]), np.array([3.0, 1.0]))
    assert captures_of([both]) == captures_of([both, one]) == "low and high"  # all of one are needed
    assert captures_of([both, other]) == "low and high or low"
    left = both.without(low)
    assert left.factors == (high,) and left.logs.tolist() == [0.2] and left.errors.tolist() == [0.02]
    assert left.cost == pytest.approx(both.cost - 9) == 14


def test_the_next_step_beside_a_fault_of_the_set_up_corrects_the_measurement() -> None:
    step = SimpleNamespace(candidate=SimpleNamespace(kind="add", effect="flicker", parameter=None))
    found: Any = SimpleNamespace(
        finished=True, asked="diagnose", verdict="explained", steps=[step], faulty="low", advice=[]
    )
    said = after_diagnosis(found)
    assert said.startswith("measure the light of low again, correct measurement.yaml, and type spadmnist compare")
    found.faulty, found.stopped = "", False
    assert "measurement.yaml" not in after_diagnosis(found)


@pytest.mark.slow
@pytest.mark.long
def test_a_noisy_lamp_is_found_beside_a_wrong_light_level() -> None:
    """No check fails but a total. A scan that ended there would miss the lamp."""
    effects = [
        sp.effects.Detection(pdp=0.5),
        sp.effects.DeadTime(duration=50e-9),
        sp.effects.DarkCounts(rate=100.0),
        sp.effects.Tdc(resolution=1e-10),
    ]
    sensor, real = (
        sp.Sensor(sp.Layout(4, 4, 25e-12, 1.0), [*effects, *more], rules="device")
        for more in ([], [sp.effects.SourceNoise(contrast=0.015, coherence_time=1e-3)])
    )
    captures = [sp.Capture("dark", "tr", exposure=1.0, dark=True)]
    for id, photons in (("low", 2e5), ("mid", 6e5), ("high", 1e6)):
        light = {"wavelength": 500e-9, "irradiance": photons * PHOTON / 25e-12, "relative_uncertainty": 0.02}
        captures.append(sp.Capture(id, "tr", exposure=0.03, **light))
    found = diagnose(sensor, stated_at(sp.simulate(real, captures, seed=2), sensor, "low", 1.1), quick=True, jobs=2)
    assert found.verdict == "explained" and [step.candidate.name for step in found.steps] == ["add source_noise"]
    value = found.steps[0].values["coherence_time"]
    assert value.low is not None and value.high is not None and value.low / 2 < 1e-3 < 2 * value.high
    assert {entry["capture"] for entry in found.setup} == {"low"}
    assert sentence(found).endswith("of the model, and the set-up of low those of the totals.")
    for factor in (
        entry["factor"] for entry in found.setup
    ):  # 2.5 and 2.6 standard errors; without the noise of the lamp in them, 2.9 and 3.1
        assert abs(math.log(1.1 * factor["value"])) < 3 * math.log(factor["high"] / factor["low"]) / (2 * HALF_95)
