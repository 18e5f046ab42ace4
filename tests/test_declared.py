"""What a user's effect or statistic declares, a diagnosis does with it as with a built-in one."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from tinylab import bench_of, change_of, quiet

from spadmnist import plugins
from spadmnist.errors import EffectError
from spadmnist.inference import pixel_maps
from spadmnist.inference.error_budget import physical_errors
from spadmnist.inference.evaluation import evaluate
from spadmnist.inference.map_trials import patterns_first
from spadmnist.inference.mixed_model import PatternEvidence
from spadmnist.inference.replicates import Replicates
from spadmnist.inference.signature import Signature
from spadmnist.inference.trial import Trial

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
