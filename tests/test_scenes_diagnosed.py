"""Diagnosis of captures of a scene: what a print does is told from pixels that differ, and from what looks like it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labs import bench_of, quiet

from spadmnist import measurement, twin
from spadmnist.digits import draw_digit
from spadmnist.effects import Conditions
from spadmnist.effects.background_light import BackgroundLight
from spadmnist.effects.crosstalk import Crosstalk
from spadmnist.effects.dark_counts import DarkCounts
from spadmnist.effects.dead_time import DeadTime
from spadmnist.effects.detection import Detection
from spadmnist.effects.print_blur import PrintBlur
from spadmnist.effects.print_contrast import PrintContrast
from spadmnist.effects.print_tilt import PrintTilt
from spadmnist.effects.tdc import Tdc
from spadmnist.events import Layout
from spadmnist.inference.comparison import compare
from spadmnist.inference.count_model import light_levels_of
from spadmnist.inference.evaluation import evaluate
from spadmnist.inference.map_trials import patterns_first
from spadmnist.inference.model_selection import diagnose
from spadmnist.inference.score_test import p_of_map
from spadmnist.inference.trial import Trial
from spadmnist.measurement import Measurement
from spadmnist.recording import Capture, Light
from spadmnist.scene import Scene
from spadmnist.sensor import Sensor

SIDE, TILE = 16, 8
PRINTS = (PrintBlur(radius=0.5), PrintContrast(black=0.05), PrintTilt(angle=0.03))
OTHERS = (Crosstalk(probability=0.02), BackgroundLight(rate=500.0))
Lab = tuple[Sensor, Measurement]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPADMNIST_CACHE", str(tmp_path / "cache"))


def chart(black: int = 0) -> Scene:
    """Four digits. black: their grey level of black."""
    seen = np.zeros((SIDE, SIDE))
    for n in range(4):
        row, column = TILE * (n // 2), TILE * (n % 2)
        seen[row : row + TILE, column : column + TILE] = draw_digit(n, (1, 0, n), TILE, TILE)
    return Scene("chart.npy", (black + seen * (255 - black) / 255).astype(np.uint8))


def plan(modality: str, frames: int, black: int) -> Iterator[Capture]:
    """A capture in the dark, and one of the chart at each of two levels."""
    shown, exposure = chart(black), frames * 1e-5
    for id, level in (("dark", 0.0), ("bright", 1.0), ("dim", 0.3)):
        lit = Light(555e-9, level, "lux", 0.02, scene=shown) if level else Light()
        clock = (exposure, 1, exposure, exposure) if modality == "tr" else (exposure, frames, 1e-5, 1e-5)
        tick = 1e-10 if modality == "tr" else None
        yield Capture(id, modality, lit, Conditions(*clock, lit.wavelength, scene=lit.scene), tick=tick)


def lab(*hidden: Any, seed: int = 1, modality: str = "qis", frames: int = 4000, black: int = 0) -> Lab:
    """(the sensor as stated, what one with hidden effects, which take the place of its own, records of the chart)."""
    stated: list[Any] = [Detection(pdp=0.4), DarkCounts(rate=100.0), DeadTime(duration=50e-9)]
    stated += [Tdc(resolution=1e-10)] if modality == "tr" else []
    layout = Layout(SIDE, SIDE, 25e-12, 1.0)

    def sensor(*effects: Any) -> Sensor:
        own = {effect.name: effect for effect in (*stated, *effects)}
        return Sensor(layout, list(own.values()), "device", name="lab").resolved()

    captures = measurement.in_memory("lab", layout, list(plan(modality, frames, black)))
    made = measurement.in_memory("lab", layout, list(twin.twin(sensor(*hidden), captures, seed)))
    return sensor(), made


def looked_at(made: Lab, effects: Sequence[str]) -> list[Trial]:
    """The candidates and maps, in the order in which they are fitted."""
    replicates = bench_of(made)
    scan, evaluation = quiet(replicates), evaluate(replicates, {})
    tried: list[Trial] = []
    for candidate in replicates.candidates(replicates.start):
        if candidate.effect in effects and candidate.kind == "add":
            tried += scan.looked_at(evaluation, candidate, scan.begun(evaluation, candidate))
    return patterns_first(scan, evaluation, scan.again(evaluation, {}, sorted(tried, key=lambda t: -t.fall)))


# --- a print beside maps of pixels --------------------------------------------------------------------------------


@pytest.mark.parametrize("hidden", PRINTS, ids=lambda effect: effect.name)
def test_a_print_comes_before_maps_of_pixels(hidden: Any) -> None:
    """Its shape is the scene's, and no gradient over the array."""
    found = looked_at(lab(hidden, frames=1000), [hidden.name])
    assert any(one.maps is not None and one.candidate.per == "pixel" for one in found)
    assert found[0].candidate.name == f"add {hidden.name}"


def test_pixels_that_differ_are_no_print() -> None:
    """Each print fits them a little, and none beyond chance, but for once in ten thousand times; the seed is fixed."""
    spread = np.exp(0.3 * np.random.Generator(np.random.PCG64(7)).standard_normal(SIDE * SIDE))
    made = lab(Detection(pdp=0.4, relative=spread), frames=1000, black=100)
    found = looked_at(made, [one.name for one in PRINTS])
    assert found[0].candidate.name == "per_pixel detection.pdp"
    assert not {one.candidate.effect for one in found} & {one.name for one in PRINTS}


def test_what_happens_where_no_light_falls_is_no_pattern_of_the_light() -> None:
    """A column of hot pixels in the black of the chart is one of dark counts; p-values of a fixed seed."""
    unlit = np.flatnonzero(chart().share.reshape(SIDE, SIDE).sum(axis=0) == 0)
    assert unlit.size
    rate = np.where(np.arange(SIDE * SIDE) % SIDE == unlit[0], 600.0, 100.0)
    replicates = bench_of(lab(DarkCounts(rate=rate), frames=4000))
    evaluation = evaluate(replicates, {})
    levels = light_levels_of(replicates, evaluation)
    some = [c for c in replicates.candidates(replicates.start) if c.carrier]
    maps = {c.name: p_of_map(replicates, evaluation, c, {}, levels) for c in some}
    assert maps["add column_pattern"] > 1e-3 and maps["per_pixel detection.pdp"] > 1e-3
    assert maps["per_pixel dark_counts.rate"] < 1e-6


# --- whole diagnoses ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "modality"),
    [  # a print; `long`: all effects, in both readouts
        pytest.param(one, modality, marks=pytest.mark.long if n + k else ())
        for k, modality in enumerate(("qis", "tr"))
        for n, one in enumerate((*PRINTS, *OTHERS))
    ],
)
def test_what_is_hidden_in_a_scene_is_named(hidden: Any, modality: str) -> None:
    """By its own name; of a print with an interval of 95 % that holds its value, with this seed."""
    frames = 4000 if modality == "qis" else 1500
    found = diagnose(*lab(hidden, modality=modality, frames=frames), quick=True)
    assert found.verdict == "explained" and [step.candidate.name for step in found.steps] == [f"add {hidden.name}"]
    ((name, declared),) = [(n, p) for n, p in hidden.parameters.items() if p.off not in (None, p.default)]
    value, true = found.steps[0].values[name], getattr(hidden, name)
    assert abs(value.value - true) < 0.2 * abs(true), declared
    if hidden in PRINTS:
        assert value.low is not None and value.high is not None and value.low <= true <= value.high


@pytest.mark.slow
@pytest.mark.parametrize("modality", ["qis", pytest.param("tr", marks=pytest.mark.long)])
def test_a_right_model_of_a_scene_is_quiet(modality: str) -> None:
    """Of 20 comparisons with a right model, each wrong once in a hundred times, 6 are wrong once in 30 million."""
    verdicts = [compare(*lab(seed=seed, modality=modality, frames=1500), jobs=2).verdict for seed in range(20)]
    assert verdicts.count("fails") < 6
