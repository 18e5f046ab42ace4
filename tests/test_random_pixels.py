"""Effects that hit pixels at random: their shape and their numbers are found by their own scatter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tinylab import bench_of, change_of, quiet

import spadmnist
from spadmnist import config, measurement, twin
from spadmnist.inference import random_pixels
from spadmnist.inference.candidates import with_values
from spadmnist.inference.comparison import comparison_with
from spadmnist.inference.evaluation import block_checks, evaluate, failing
from spadmnist.inference.trial_fits import fit_trial
from spadmnist.measurement import Measurement
from spadmnist.sensor import Sensor

SENSOR = """sensor:
  name: camera
  rules: device
  layout: {rows: 16, columns: 16, pixel_area: 100 um^2, fill_factor: 0.5}
  effects:
    detection: {pdp: 0.4}
    dark_counts: {rate: 100 Hz}
"""
BLINKS = "    blinking_dark_counts: {amplitude: 5 kHz, rate_on: 100 Hz, rate_off: 100 Hz, fraction: 0.08}\n"
PLAN = """format: spadmnist-measurement/1
name: lab
layout: {rows: 16, columns: 16}
captures:
  - {id: dark, modality: qis, light: {kind: dark}, frames: 10000, frame_time: 10 us, frame_period: 10 us}
  - {id: lit, modality: qis, frames: 10000, frame_time: 10 us, frame_period: 10 us,
     light: {kind: flat, wavelength: 500 nm, irradiance: 5 nW/cm^2, relative_uncertainty: 0.02}}
"""
CHIP = 77
TRUTH = {"amplitude": 5000.0, "rate_on": 100.0, "rate_off": 100.0, "fraction": 0.08}


def camera(folder: Path, seed: int = 3) -> tuple[Sensor, Measurement]:
    """(the sensor without what blinks, data of a chip with it)."""
    for name, text in (("plan", PLAN), ("model", SENSOR), ("truth", SENSOR + BLINKS)):
        (folder / f"{name}.yaml").write_text(text)
    plan = measurement.open(folder / "plan.yaml", planned=True)
    truth = config.read_sensor(folder / "truth.yaml").changed(chip_seed=CHIP)
    return config.read_sensor(folder / "model.yaml"), measurement.open(twin.simulate(truth, plan, folder / "lab", seed))


def hit_in_truth(folder: Path) -> np.ndarray:
    truth = config.read_sensor(folder / "truth.yaml").changed(chip_seed=CHIP).resolved()
    return np.asarray(truth.effect("blinking_dark_counts").added(None) > 0)  # type: ignore[union-attr, arg-type]


def test_an_effect_says_how_it_is_in_given_pixels(tmp_path: Path) -> None:
    """One that does not keeps the pixels that are drawn."""
    (tmp_path / "sensor.yaml").write_text(SENSOR + BLINKS)
    sensor, hit = config.read_sensor(tmp_path / "sensor.yaml"), np.arange(256) % 9 == 0
    own = with_values(sensor, random_pixels.of_pixels(sensor, "blinking_dark_counts", hit))
    assert np.array_equal(own.resolved().effect("blinking_dark_counts").added(None) > 0, hit)
    assert random_pixels.of_pixels(sensor, "dark_counts", hit) == {}


@pytest.mark.slow
def test_what_blinks_is_fitted_by_its_own_scatter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The squares of the pixels that are hit lead elsewhere; the other shapes are tried, and the likelihood decides."""
    replicates = bench_of(camera(tmp_path), 16)
    look, evaluation = quiet(replicates), evaluate(replicates, {})
    candidate = change_of(replicates, "add blinking_dark_counts")
    tried = sorted(look.looked_at(evaluation, candidate, look.begun(evaluation, candidate)), key=lambda one: -one.fall)
    (odd,) = [one for one in look.again(evaluation, {}, tried) if one.chips]
    assert len(odd.others) > 3  # shapes
    with monkeypatch.context() as patch:
        patch.setattr("spadmnist.inference.trial_fits.fit_by_own_scatter", lambda replicates, evaluation, one: one)
        by_squares = fit_trial(replicates, evaluation, odd)
    wrong = evaluate(replicates, {}, by_squares.sensors)
    assert failing(block_checks(replicates, wrong, wrong.residuals))
    found = random_pixels.fit_by_own_scatter(replicates, evaluation, by_squares)
    assert found.evaluation is not None and found.fit is not None
    assert not failing(block_checks(replicates, found.evaluation, found.evaluation.residuals))
    for i, coordinate in enumerate(found.fit.coordinates):
        # five standard errors of each (false alarms of the four: 2e-6), which are a half at most
        value, low, high = found.fit.interval(i)
        error = abs(coordinate.coordinate(high) - coordinate.coordinate(low)) / (2 * 1.96)
        true = TRUTH[coordinate.parameter]
        assert abs(coordinate.coordinate(value) - coordinate.coordinate(true)) < 5 * error < 2.5, coordinate
    # the sensor of the data has it in the pixels that its counts show, which are those of the chip
    values = {**found.values}
    hit = random_pixels.pixels_hit(replicates, found.evaluation, values, "blinking_dark_counts")
    assert hit is not None and np.array_equal(hit, hit_in_truth(tmp_path))
    drawn = with_values(replicates.start, values)
    own = random_pixels.of_pixels(drawn, "blinking_dark_counts", hit)
    assert comparison_with(replicates, {**values, **own}).verdict == "adequate"
    assert comparison_with(replicates, values).verdict == "fails"  # other pixels blink


@pytest.mark.slow
@pytest.mark.long
def test_what_blinks_is_named_and_not_a_map_of_it(tmp_path: Path) -> None:
    model, data = camera(tmp_path)
    found = spadmnist.diagnose(model, data, quick=True, within="none")
    assert found.verdict == "explained" and [s.candidate.name for s in found.steps] == ["add blinking_dark_counts"]
    for name, value in found.steps[0].values.items():
        assert value.low is not None and value.high is not None
        assert value.low / 1.2 < TRUTH[name] < value.high * 1.2, (name, value)
    hit = hit_in_truth(tmp_path)
    assert found.steps[0].where == f"seen in {hit.sum()} of 256 pixels, which the sensor file has"
    assert found.steps[0].where in " ".join(str(found).split())
    assert spadmnist.compare(found.model, data).verdict == "adequate"
