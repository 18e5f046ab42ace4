"""Effects that hit pixels at random: their shape and their numbers are found by their own scatter."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from labs import bench_of, change_of, quiet

import spadmnist
from spadmnist import config, measurement, twin
from spadmnist.errors import UNABLE, SpadError
from spadmnist.inference import hit_pixels, random_pixels
from spadmnist.inference.candidates import with_values
from spadmnist.inference.checks import block_checks, failing
from spadmnist.inference.comparison import comparison_with
from spadmnist.inference.count_model import light_levels_of
from spadmnist.inference.evaluation import evaluate
from spadmnist.inference.intervals import fit_where_hit
from spadmnist.inference.map_models import models_with_maps
from spadmnist.inference.model_path import ModelPath, accept
from spadmnist.inference.models import Model
from spadmnist.inference.pixel_maps import summary
from spadmnist.inference.replicates import Execution, Replicates
from spadmnist.inference.trial_fits import fit_trial
from spadmnist.measurement import Measurement
from spadmnist.sensor import Sensor
from spadmnist.workers import Serial

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
CHIP, NAME = 77, "blinking_dark_counts"
TRUTH = {"amplitude": 5000.0, "rate_on": 100.0, "rate_off": 100.0, "fraction": 0.08}


def camera(folder: Path, seed: int = 3, brighter: float = 1.0) -> tuple[Sensor, Measurement]:
    """(the sensor without what blinks, data of a chip with it). brighter: the light, relative to what is stated."""
    shown = PLAN.replace("5 nW", f"{5 * brighter:g} nW")
    for name, text in (("plan", shown), ("model", SENSOR), ("truth", SENSOR + BLINKS)):
        (folder / f"{name}.yaml").write_text(text)
    plan = measurement.open(folder / "plan.yaml", planned=True)
    truth = config.read_sensor(folder / "truth.yaml").changed(chip_seed=CHIP)
    made = twin.simulate(truth, plan, folder / "lab", seed)
    stated = made / "measurement.yaml"
    stated.write_text(re.sub(r"irradiance: \S+ nW", "irradiance: 5 nW", stated.read_text()))
    return config.read_sensor(folder / "model.yaml"), measurement.open(made)


def hit_in_truth(folder: Path) -> np.ndarray:
    truth = config.read_sensor(folder / "truth.yaml").changed(chip_seed=CHIP).resolved()
    return np.asarray(truth.effect(NAME).added(None) > 0)  # type: ignore[union-attr, arg-type]


def test_an_effect_says_how_it_is_in_given_pixels(tmp_path: Path) -> None:
    """One that does not keeps the pixels that are drawn."""
    (tmp_path / "sensor.yaml").write_text(SENSOR + BLINKS)
    sensor, hit = config.read_sensor(tmp_path / "sensor.yaml"), np.arange(256) % 9 == 0
    own = with_values(sensor, hit_pixels.of_pixels(sensor, NAME, hit))
    assert np.array_equal(own.resolved().effect(NAME).added(None) > 0, hit)
    assert hit_pixels.of_pixels(sensor, "dark_counts", hit) == {}


@pytest.mark.parametrize("brighter", [1.0, 1.05])
def test_the_pixels_that_are_hit_are_known_whatever_the_light(tmp_path: Path, brighter: float) -> None:
    """By their counts. The level of the replicates is the stated one, and their chip another than that of the data."""
    replicates = bench_of(camera(tmp_path, brighter=brighter), 4)
    values = {(NAME, name): value for name, value in TRUTH.items()}
    evaluation = evaluate(replicates, {}, Model.same(replicates.start).changed(values, chips=True))
    seen = hit_pixels.pixels_hit(replicates, light_levels_of(replicates, evaluation), values, NAME)
    assert seen is not None and np.array_equal(seen.hit, hit_in_truth(tmp_path))
    # 20 Hz in many of the pixels are seen in all of them together, and in no one of them
    faint = {**values, (NAME, "amplitude"): 20.0, (NAME, "fraction"): 0.4}
    assert hit_pixels.pixels_hit(replicates, light_levels_of(replicates, evaluation), faint, NAME) is None
    assert hit_pixels.pixels_hit(replicates, light_levels_of(replicates, evaluation), values, "dark_counts") is None


@pytest.mark.parametrize(
    ("said", "wrong"),
    [
        ({"amplitud": 1.0}, "of_pixels must be a dict of parameters, amplitude"),
        ({1: 2.0}, "of_pixels must be a dict"),
        (None, "of_pixels must be a dict"),
        ({"amplitude": float("nan")}, "amplitude"),
        ({"amplitude": np.full(256, -1.0)}, "amplitude"),
        ({"fraction": 2.0}, "fraction"),
    ],
)
def test_pixels_that_cannot_be_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: object, wrong: str
) -> None:
    (tmp_path / "sensor.yaml").write_text(SENSOR + BLINKS)
    sensor = config.read_sensor(tmp_path / "sensor.yaml")
    monkeypatch.setattr(type(sensor.effect(NAME)), "of_pixels", lambda self, hit: said)
    with pytest.raises(UNABLE, match=wrong):
        hit_pixels.of_pixels(sensor, NAME, np.zeros(256, bool))


@pytest.mark.slow
@pytest.mark.long
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
    seen = hit_pixels.pixels_hit(replicates, light_levels_of(replicates, found.evaluation), found.values, NAME)
    assert seen is not None and np.array_equal(seen.hit, hit_in_truth(tmp_path))
    assert comparison_with(replicates, {**found.values, **seen.values}).verdict == "adequate"
    assert comparison_with(replicates, found.values).verdict == "fails"  # other pixels blink

    # in these pixels its numbers are known better; and none is taken that is worse, or that cannot be simulated
    path = ModelPath(replicates, look, evaluation, {}, [], [])
    (step,) = accept(path, found, 100.0)
    values, kept, far = dict(path.values), dict(step.values), path.evaluation

    def fails(path: ModelPath) -> None:
        path.values, path.evaluation = {}, wrong

    def breaks(path: ModelPath) -> None:
        path.values = {}
        raise SpadError("not today")

    with monkeypatch.context() as patch:
        patch.setattr("spadmnist.inference.intervals.fit_all", fails)
        assert not fit_where_hit(path)
        patch.setattr("spadmnist.inference.intervals.fit_all", breaks)
        with pytest.raises(SpadError, match="not today"):
            fit_where_hit(path)
    assert (path.values, step.values, path.evaluation, path.located) == (values, kept, far, {})
    assert fit_where_hit(path) and np.array_equal(path.located[NAME], seen.hit)
    assert {d.parameter for d in path.free} == {"amplitude", "rate_on", "rate_off"}
    widths = [math.log(v.high / v.low) for v in (kept["amplitude"], step.values["amplitude"])]  # type: ignore[operator]
    # five standard errors
    assert abs(math.log(step.values["amplitude"].value / 5000)) < 5 / 3.92 * widths[1] < 5 / 3.92 * 0.9 * widths[0]
    assert not failing(block_checks(replicates, path.evaluation, path.evaluation.residuals))


def test_a_map_beside_what_blinks_leaves_the_pixels_of_another_chip_alone() -> None:
    """A model has drawn other pixels. A map took the effect away there: 0 to 0.1 Hz of 70 to 180."""
    rates = 100 * np.exp(0.3 * np.random.default_rng(5).standard_normal(256))
    blinks = spadmnist.effects.BlinkingDarkCounts(amplitude=1000.0, rate_on=10.0, rate_off=10.0, fraction=0.05)
    model, truth = (
        spadmnist.Sensor(
            spadmnist.Layout(16, 16, 25e-12, 1.0),
            [spadmnist.effects.Detection(pdp=0.5), spadmnist.effects.DarkCounts(rate=rate), *more],
            rules="device",
            chip_seed=chip,
        )
        for rate, more, chip in ((100.0, [], 0), (rates, [blinks], 99))
    )
    dark = spadmnist.Capture("dark", "tr", dark=True, exposure=10.0, tick=1e-9)
    replicates = Replicates(model, spadmnist.simulate(truth, [dark], seed=3), 0, Execution(Serial()), 8)
    values = {(NAME, name): getattr(blinks, name) for name in ("amplitude", "rate_on", "rate_off", "fraction")}
    assert hit_pixels.drawn_effects(replicates, {}) == [] and hit_pixels.drawn_effects(replicates, values) == [NAME]
    (one,) = (c for c in replicates.candidates(replicates.start) if c.name == "per_pixel dark_counts.rate")
    _, maps, final = models_with_maps(replicates, values, [one], {"dark": 1.0})
    map_ = maps[one.carrier]  # type: ignore[index]
    hit = np.asarray(truth.resolved().effect(NAME).added(None) > 0)  # type: ignore[union-attr, arg-type]
    drawn = np.asarray(with_values(replicates.start, values).resolved().effect(NAME).added(None) > 0)  # type: ignore[union-attr, arg-type]
    apart = np.log(map_.values() / rates)[drawn & ~hit]
    assert np.abs(apart).max() < 5 / math.sqrt(10 * rates.min())
    assert summary(map_)["sigma"] == pytest.approx(0.3, rel=0.2)
    seen = hit_pixels.pixels_hit(replicates, {"dark": 1.0}, final, NAME)
    assert seen is not None and not (seen.hit & drawn & ~hit).any() and (seen.hit & hit).sum() >= hit.sum() - 1
    # where the pixels differ so much that the hottest resemble those that are hit, none is taken as hit
    hot = np.exp(1.0 * np.random.default_rng(5).standard_normal(256)) * 100
    counts = np.random.default_rng(6).poisson(10 * hot).astype(float)
    replicates.seen["dark"] = replace(replicates.seen["dark"], counts=counts)
    assert hit_pixels.pixels_hit(replicates, {"dark": 1.0}, values, NAME) is not None
    assert hit_pixels.pixels_hit(replicates, {"dark": 1.0}, values, NAME, differ=True) is None
    own = hit_pixels.of_pixels(with_values(replicates.start, values), NAME, hit)  # which were hit is known
    assert hit_pixels.drawn_effects(replicates, {**values, **own}) == []


@pytest.mark.slow
@pytest.mark.long
def test_what_blinks_is_named_and_not_a_map_of_it(tmp_path: Path) -> None:
    model, data = camera(tmp_path)
    found = spadmnist.diagnose(model, data, quick=True, within="none")
    assert found.verdict == "explained" and [s.candidate.name for s in found.steps] == ["add blinking_dark_counts"]
    for name, value in found.steps[0].values.items():
        assert value.low is not None and value.high is not None
        assert value.low / 1.2 < TRUTH[name] < value.high * 1.2, (name, value)
    # in the pixels of this chip the numbers are fitted once more; their share keeps its interval
    assert found.steps[0].values["fraction"].high < 0.2
    hit = hit_in_truth(tmp_path)
    assert found.steps[0].where == f"detected in {hit.sum()} of 256 pixels, which the sensor file contains"
    assert found.steps[0].where in " ".join(str(found).split())
    assert spadmnist.compare(found.model, data).verdict == "adequate"
