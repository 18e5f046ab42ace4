"""What a user's effect or statistic declares, a diagnosis does with it as with a built-in one."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from labs import bench_of, change_of, quiet
from scipy import stats

from spadmnist import measurement, plugins, twin
from spadmnist.effects import Conditions, Effect, parameter
from spadmnist.effects.dark_counts import DarkCounts
from spadmnist.effects.detection import Detection
from spadmnist.errors import EffectError
from spadmnist.events import Layout
from spadmnist.inference import pixel_maps
from spadmnist.inference.error_budget import physical_errors
from spadmnist.inference.evaluation import evaluate
from spadmnist.inference.map_trials import patterns_first
from spadmnist.inference.mixed_model import PatternEvidence
from spadmnist.inference.replicates import Replicates
from spadmnist.inference.signature import Signature
from spadmnist.inference.trial import Trial
from spadmnist.inference.trial_fits import fit_trial
from spadmnist.recording import Capture, Light
from spadmnist.sensor import Sensor
from spadmnist.statistics import Statistic

HALVES = """import numpy as np

from spadmnist.statistics import Statistic, Summary


class Halves(Statistic):
    "Detections in the first and in the second half."

    modalities = ("tr",)
    error = "halves"

    @classmethod
    def physical_error(cls, measured, expected, residuals, detections):
        return RETURNED

    def reduce(self, recording):
        late = int((recording.events.times >= recording.conditions.exposure / 2).sum())
        values = np.array([len(recording.events) - late, late], np.float64)
        return Summary(values, "poisson", lambda cell: "a half", lambda cell, measured, expected: ("", 0.0))
"""
STRIPES = """import numpy as np

from spadmnist import Effect, parameter


class Stripes(Effect, stage="light"):
    "Every other pixel sees less light."

    share = parameter(0.0, "", "what is lost", bounds=(0, 1), off=0.0, search=(0.01, 0.9))

    @classmethod
    def light_pattern(cls, layout):
        return (np.arange(layout.pixels) % 2.0)[:, None]

    def apply(self, rate, conditions):
        return rate * (1 - self.share * (np.arange(rate.shape[1]) % 2))
"""
WAVE = """import numpy as np

from spadmnist import Effect, parameter
from spadmnist.statistics import Statistic, Summary


class Wave(Effect, stage="arrival"):
    "The light of a pixel is brighter in the first half of an exposure than in the second."

    depth = parameter(
        0.2, "", "by what share", bounds=(0, 1), off=0.0, search=(0.01, 0.9), per_pixel=True, informed_by="NAMED"
    )

    def maximum(self, conditions):
        return 1 + float(np.max(self.depth))

    def modulate(self, events, conditions, rng):
        depth = np.broadcast_to(self.depth, events.pixels)[events.rows % events.pixels]
        return 1 + depth * np.where(events.times < conditions.exposure / 2, 1, -1)

    def expected_rate(self, rate, conditions):
        return rate


class HalvesOfPixels(Statistic):
    "Detections of each pixel in the first half of an exposure and in the second."

    modalities = ("tr",)

    def halves(self, recording):
        events, pixels = recording.events, recording.layout.pixels
        early = events.times < recording.conditions.exposure / 2
        return [np.bincount(events.rows[some] % pixels, minlength=pixels) for some in (early, ~early)]

    def reduce(self, recording):
        early, late = self.halves(recording)
        values = (early - late) / np.sqrt(np.maximum(early + late, 1))
        return Summary(values, "normal", lambda cell: f"pixel {cell}", lambda cell, measured, expected: ("", 0.0))

    def unit_likelihood(self, recording, sensors):
        early, late = self.halves(recording)
        depths = [np.broadcast_to(sensor.effect("wave").depth, early.size) for sensor in sensors]
        return RETURNED
"""
RIGHT = "np.stack([early * np.log1p(depth) + late * np.log1p(-depth) for depth in depths], axis=1)"


def load(folder: Path, text: str, name: str) -> None:
    (folder / name).write_text(text)
    plugins.load_file(folder / name)


def patterns_and_a_map(replicates: Replicates) -> list[Trial]:
    """Trials of the stripes, of rows, and of a map of the pixels."""
    falls = {"add stripes": 90.0, "add row_pattern": 80.0, "per_pixel detection.pdp": 70.0}
    made = [Trial(change_of(replicates, name), {}, Signature({}, {}, {}), fall, 1.0) for name, fall in falls.items()]
    made[2].maps = {made[2].candidate.carrier: None}  # type: ignore[dict-item]
    return made


def test_the_error_budget_has_a_column_of_a_users_statistic(lab, tmp_path) -> None:
    load(tmp_path, HALVES.replace("RETURNED", "abs(measured[1] - expected[1]) / detections"), "halves.py")
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    errors = physical_errors(replicates, evaluation, evaluation.residuals)
    assert {"mean_rate", "map", "intervals", "neighbours", "halves"} == errors.keys()
    # a Poisson count of half of about a thousand detections: 5 standard deviations of them
    least = min(seen.total for seen in replicates.seen.values())
    assert 0 < errors["halves"] < 5 * np.sqrt(least / 2) / least


def test_a_statistic_that_fails_there_is_blamed_with_its_line(lab, tmp_path) -> None:
    load(tmp_path, HALVES.replace("RETURNED", "1 / 0"), "halves.py")
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    with pytest.raises(EffectError, match=r"halves\.py:14: the statistic halves failed: ZeroDivisionError"):
        physical_errors(replicates, evaluation, evaluation.residuals, strict=True)


def test_a_map_is_tested_for_the_shapes_that_a_users_pattern_declares(lab, tmp_path, monkeypatch) -> None:
    load(tmp_path, STRIPES, "stripes.py")
    replicates = bench_of(lab(side=4))
    look, (stripes, rows, map_) = quiet(replicates), patterns_and_a_map(replicates)
    monkeypatch.setattr(pixel_maps, "acts_on_light", lambda sensor, candidate: True)
    asked: dict[str, np.ndarray] = {}

    def evidence(free: object, patterns: dict[str, np.ndarray]) -> dict[str, PatternEvidence]:
        asked.update(patterns)
        return {name: PatternEvidence(90.0 - pattern.max(), 0.0, 0.0) for name, pattern in patterns.items()}

    monkeypatch.setattr(pixel_maps, "evidence_of_patterns", evidence)
    assert patterns_first(look, evaluate(replicates, {}), [stripes, rows, map_]) == [stripes, rows, map_]
    np.testing.assert_array_equal(asked["add stripes"], np.tile([[0.0], [1.0]], (8, 1)))
    np.testing.assert_array_equal(asked["add row_pattern"], np.repeat(np.arange(4), 4))  # the row of each pixel


@pytest.mark.parametrize(
    ("returned", "says"),
    [
        ("np.arange(layout.pixels) % 2.0", r"finite and \(16, shapes\), not \(16,\)"),
        ("np.full((layout.pixels, 1), np.nan)", "finite"),
        ("1 / 0", "ZeroDivisionError"),
    ],
)
def test_a_pattern_with_wrong_shapes_is_left_out_alone(lab, tmp_path, monkeypatch, returned: str, says: str) -> None:
    load(tmp_path, STRIPES.replace("(np.arange(layout.pixels) % 2.0)[:, None]", returned), "stripes.py")
    replicates = bench_of(lab(side=4))
    look, (stripes, rows, map_) = quiet(replicates), patterns_and_a_map(replicates)
    monkeypatch.setattr(pixel_maps, "acts_on_light", lambda sensor, candidate: True)
    clear = PatternEvidence(90.0, 90.0, 0.0)
    monkeypatch.setattr(pixel_maps, "evidence_of_patterns", lambda free, patterns: dict.fromkeys(patterns, clear))
    assert patterns_first(look, evaluate(replicates, {}), [stripes, rows, map_]) == [rows, map_]
    (entry,) = look.untried
    assert entry["effect"] == "stripes" and re.search(says, entry["why"]) and "stripes.py" in entry["why"]


@pytest.mark.parametrize(
    ("line", "says"),
    [('error = "linearity"', "take another name"), ('error = "halves"\n    physical_error = None', "must define")],
)
def test_an_error_that_cannot_be_is_refused_when_the_class_is_made(tmp_path, line: str, says: str) -> None:
    text = HALVES.replace('    error = "halves"\n', f"    {line.partition(chr(10))[0]}\n")
    if "physical_error" in line:
        text = text.replace("def physical_error(", "def another(")
    with pytest.raises(EffectError, match=says):
        load(tmp_path, text, "halves.py")


def test_an_error_that_is_no_number_is_told_at_first_and_left_out_later(lab, tmp_path) -> None:
    load(tmp_path, HALVES.replace("RETURNED", "float('nan')"), "halves.py")
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    with pytest.raises(EffectError, match="finite number"):
        physical_errors(replicates, evaluation, evaluation.residuals, strict=True)
    assert "halves" not in physical_errors(replicates, evaluation, evaluation.residuals)


# --- a map that a statistic of the user's tells -------------------------------------------------------------------

DEPTH = ("wave", "depth")


def waves(
    folder: Path, named: str = "halves_of_pixels", returned: str = RIGHT, spread: float = 0.4
) -> tuple[Replicates, np.ndarray]:
    """(data of a sensor whose pixels have other depths, beside a sensor whose pixels are alike; their depths)."""
    load(folder, WAVE.replace("NAMED", named).replace("RETURNED", returned), "wave.py")
    layout, wave = Layout(6, 6, 100e-12, 1.0), Effect.registry.find("wave")
    depth = 0.2 * np.exp(spread * np.random.Generator(np.random.PCG64(4)).standard_normal(36))

    def sensor(depth: float | np.ndarray) -> Sensor:
        own = [Detection(pdp=0.4), DarkCounts(rate=100.0), wave(depth=depth)]
        return Sensor(layout, own, "device", name="lab").resolved()

    clock = (0.05, 1, 0.05, 0.05)
    lit = Light(500e-9, 1e-3, "W/m^2", 0.02)
    captures = [
        Capture("lit", "tr", lit, Conditions(*clock, 500e-9), tick=1e-9),
        Capture("dark", "tr", Light(), Conditions(*clock, None), tick=1e-9),
    ]
    data = twin.twin(sensor(depth), measurement.in_memory("lab", layout, captures), 3)
    return bench_of((sensor(0.2), measurement.in_memory("lab", layout, list(data))), 16), depth


@pytest.mark.slow
def test_a_map_is_fitted_by_the_statistic_that_a_user_declares(tmp_path) -> None:
    """Counts say nothing of it. The fall and the rise of a pixel do, by the binomial law of its two halves."""
    replicates, depth = waves(tmp_path)
    evaluation, look = evaluate(replicates, {}), quiet(replicates)
    (one,) = [t for t in look.again(evaluation, {}, []) if t.candidate.carrier == DEPTH]
    assert one.p_value is not None and one.p_value < 1e-6 and one.maps is not None
    early, late = Statistic.registry.find("halves_of_pixels")().halves(replicates.recording("lit"))
    error = np.sqrt((1 - depth**2) / (early + late)) / depth  # of a logarithm, by the binomial law
    apart = (one.maps[DEPTH].raw - np.log(depth / 0.2)) / error
    # chi square of 36 pixels (false alarms: 1e-6 on either side); the dark capture says next to nothing
    assert stats.chi2.ppf(1e-6, 36) < float(apart @ apart) < stats.chi2.isf(1e-6, 36)
    assert np.median(one.maps[DEPTH].raw_error / error) == pytest.approx(1.0, abs=0.1)
    width = one.maps[DEPTH].width
    assert width is not None and width.low < np.std(np.log(depth)) * 1.2 and width.high > np.std(np.log(depth)) / 1.2
    assert fit_trial(replicates, evaluation, one).fall > 100
    # where the pixels are alike there is no such map
    replicates, _ = waves(tmp_path, spread=0.0)
    assert not [t for t in quiet(replicates).again(evaluate(replicates, {}), {}, []) if t.candidate.carrier == DEPTH]


@pytest.mark.parametrize(
    ("named", "returned", "says"),
    [
        ("halves_of_pixel", RIGHT, "informed_by names no statistic that is loaded, 'halves_of_pixel'; there are"),
        ("pixel_fano", RIGHT, "the statistic pixel_fano defines no unit_likelihood"),
        ("halves_of_pixels", f"({RIGHT}).T", r"unit_likelihood must be \(36, \d+\) without nan, not \(\d+, 36\)"),
        ("halves_of_pixels", f"0 * ({RIGHT})", "informs depth of fewer than two pixels"),
        ("halves_of_pixels", "1 / 0", r"wave\.py:\d+: the statistic halves_of_pixels failed: ZeroDivisionError"),
    ],
)
def test_a_statistic_that_tells_no_map_is_named(tmp_path, named: str, returned: str, says: str) -> None:
    replicates, _ = waves(tmp_path, named, returned)
    look = quiet(replicates)
    assert not [t for t in look.again(evaluate(replicates, {}), {}, []) if t.candidate.carrier == DEPTH]
    assert any(entry["effect"] == "wave" and re.search(says, entry["why"]) for entry in look.untried), look.untried


def test_only_a_map_over_pixels_is_informed_by_a_statistic() -> None:
    with pytest.raises(TypeError, match="informed_by is of maps over pixels: give per_pixel=True"):
        parameter(0.2, "", "of each row", per="row", informed_by="pixel_fano")
