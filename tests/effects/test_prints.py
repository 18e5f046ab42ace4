"""What a printed chart does to the light of a scene, against closed forms; and where a diagnosis looks for it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import laws
import numpy as np
import pytest
from scipy import special

from spadmnist import config, measurement, twin
from spadmnist.effects import Conditions, Effect, in_order
from spadmnist.effects.column_pattern import ColumnPattern
from spadmnist.effects.dark_counts import DarkCounts
from spadmnist.effects.detection import Detection
from spadmnist.effects.flicker import Flicker
from spadmnist.effects.print_blur import PrintBlur
from spadmnist.effects.print_contrast import PrintContrast
from spadmnist.effects.print_tilt import PrintTilt
from spadmnist.events import Layout
from spadmnist.inference.candidates import candidates
from spadmnist.inference.models import phase_parameters
from spadmnist.inference.named_fit import fit_named
from spadmnist.recording import Capture, Light
from spadmnist.scene import Scene
from spadmnist.sensor import Sensor
from spadmnist.streams import Streams

LIT = Conditions(1e-3, 100, 1e-5, 1e-5, 555e-9)
PRINTS: list[Effect] = [PrintBlur(radius=1.3), PrintContrast(black=0.2), PrintTilt(angle=0.3)]


def seen(effect: Effect, image: np.ndarray, layout: Layout | None = None) -> np.ndarray:
    """(rows, columns) light behind an effect, of an image of it."""
    layout = layout or Layout(*image.shape, 25e-12, 1.0)
    light, _ = Sensor(layout, [effect]).resolved().rates(image.reshape(1, -1).astype(float), LIT)
    return light.reshape(image.shape)


# --- the laws -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("effect", PRINTS, ids=lambda e: e.name)
@pytest.mark.parametrize("shape", [(9, 12), (1, 1), (1, 5)])
def test_light_that_is_the_same_everywhere_stays_so(effect: Effect, shape: tuple[int, int]) -> None:
    assert np.allclose(seen(effect, np.full(shape, 3e5)), 3e5, rtol=1e-14)
    assert not seen(effect, np.zeros(shape)).any()


@pytest.mark.parametrize("effect", [*PRINTS[:2], PrintTilt(angle=3.0)], ids=lambda e: e.name)
def test_a_scene_of_places_that_are_no_grid(effect: Effect) -> None:
    places = np.array([[0, 0], [1, 0], [0.5, 0.2], [2, 0.5]]) * 25e-6
    layout = Layout(1, 4, 625e-12, 1.0, places)
    light = seen(effect, np.array([[1e5, 0, 0, 5e4]]), layout)
    assert light.min() >= 0 and light.max() <= 1e5 and not np.array_equal(light, [[1e5, 0, 0, 5e4]])
    assert np.allclose(seen(effect, np.full((1, 4), 7.0), layout), 7, rtol=1e-14)


@pytest.mark.parametrize("radius", [0.1, 0.7, 2.0, 5.0])
def test_a_blurred_edge_is_the_integral_of_the_gaussian(radius: float) -> None:
    """As much as lies beyond 4 radii is left out, 6e-5; a radius that is 2 % larger is told from it."""
    image = np.zeros((9, 121))
    image[:, 61:] = 1e5
    edge = seen(PrintBlur(radius=radius), image)

    def upto(x: np.ndarray) -> np.ndarray:
        return x * special.ndtr(x / radius) + radius * np.exp(-((x / radius) ** 2) / 2) / math.sqrt(2 * math.pi)

    law = 1e5 * (upto(np.arange(121) - 60.0) - upto(np.arange(121) - 61.0))
    assert np.abs(edge - law).max() < 1e-4 * 1e5
    assert np.array_equal(edge, np.broadcast_to(edge[:1], edge.shape))
    assert np.abs(seen(PrintBlur(radius=1.02 * radius), image) - law).max() > 5e-4 * 1e5
    # a point: the same to all sides, and nothing is lost
    point = np.zeros((81, 81))
    point[40, 40] = 1.0
    spot = seen(PrintBlur(radius=radius), point)
    assert np.allclose(spot, spot.T, atol=1e-16) and np.allclose(spot, spot[::-1], atol=1e-16)
    squared = (np.arange(81) - 40.0) ** 2
    assert spot.sum() == pytest.approx(1, rel=1e-12)
    if radius > 0.5:  # a sixth is the variance of what two pixels share
        assert (spot.sum(axis=0) * squared).sum() == pytest.approx(radius**2 + 1 / 6, rel=2e-3)


def test_black_reflects_its_share_of_the_brightest_place() -> None:
    image = np.array([[0.0, 200.0, 800.0], [100.0, 0.0, 400.0]])
    assert np.allclose(seen(PrintContrast(black=0.1), image), 80 + 0.9 * image, rtol=1e-15)
    light, _ = Sensor(Layout(2, 3, 25e-12, 1.0), [PrintContrast(black=0.1)]).rates(np.stack([image.ravel()] * 2), LIT)
    assert np.array_equal(light[0], light[1])
    assert np.allclose(seen(PrintContrast(black=1.0), image), 800.0)


@pytest.mark.parametrize("angle", [0.05, -0.4, math.pi / 2])
def test_a_slope_is_turned_as_it_is(angle: float) -> None:
    """Bilinear values of what is linear are exact, but at the edges; a quarter of a turn takes columns to rows."""
    x, y = np.meshgrid(np.arange(31) - 15.0, np.arange(31) - 15.0)
    slope = seen(PrintTilt(angle=angle), 100 + 3 * x + y)
    across, down = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
    inside = np.maximum(abs(across), abs(down)) <= 15
    assert inside.mean() > 0.6 and np.allclose(slope[inside], (100 + 3 * across + down)[inside], rtol=1e-12)
    wrong = (100 + 3 * (x * math.cos(angle) - y * math.sin(angle)) + down)[inside]
    assert np.abs(slope[inside] - wrong).max() > 1


def test_a_quarter_of_a_turn_of_a_square_is_exact() -> None:
    image = np.random.Generator(np.random.PCG64(2)).random((7, 7))
    assert np.allclose(seen(PrintTilt(angle=math.pi / 2), image), np.rot90(image, -1), rtol=1e-12)


def test_the_print_comes_before_the_sensor() -> None:
    gains = np.linspace(0.5, 1.5, 6)
    effects: list[Effect] = [ColumnPattern(gain=gains), *PRINTS]
    names = [effect.name for effect in in_order(effects)]
    assert names == ["print_contrast", "print_tilt", "print_blur", "column_pattern"]
    assert [e.name for e in in_order([PRINTS[0], PRINTS[1]])] == [
        "print_contrast",
        "print_blur",
    ]  # without what stands between
    sensor = Sensor(Layout(4, 6, 25e-12, 1.0), effects).resolved()
    assert np.allclose(sensor.rates(np.full((1, 24), 10.0), LIT)[0].reshape(4, 6), 10 * gains)


def test_detections_of_black_are_those_of_its_light() -> None:
    """A chart of two halves, one white; false-alarm rate 1e-6, and 3 % more black are seen."""
    image = np.zeros((8, 8))
    image[:, 4:] = 1.0
    sensor = Sensor(Layout(8, 8, 25e-12, 1.0), [Detection(pdp=0.5), DarkCounts(rate=100.0), PrintContrast(black=0.1)])
    conditions = replace(LIT, scene=Scene("chart.npy", image))
    images = np.arange(400, dtype=np.uint64)
    made = sensor.expose(np.full((400, 64), 1e6), conditions, Streams(1, "x", "y", images), ("tr",))
    assert made.counts is not None
    black = int(made.counts.reshape(400, 8, 8)[:, :, :4].sum())
    mean = 400 * 32 * 1e-3 * (0.5 * 0.1 * 1e6 + 100)
    laws.poisson_mean(black, mean)
    with pytest.raises(AssertionError):
        laws.poisson_mean(black, 1.03 * mean)


# --- where they are looked for ------------------------------------------------------------------------------------


def captures(shown: Scene | None) -> list[Capture]:
    lit = Light(555e-9, 1.0, "lux", scene=shown)
    return [Capture("dark", "tr", Light(), replace(LIT, wavelength=None)), Capture("a", "tr", lit, LIT)]


def test_prints_are_candidates_where_a_capture_is_of_a_scene_and_only_there() -> None:
    sensor = Sensor(Layout(4, 6, 25e-12, 1.0), [Detection(pdp=0.5)]).resolved()
    flat = {c.name for c in candidates(sensor, captures(None))}
    scene = {c.name for c in candidates(sensor, captures(Scene("chart.npy", np.eye(4, 6))))}
    assert scene - flat == {f"add {e.name}" for e in PRINTS} and not flat - scene
    assert flat == {c.name for c in candidates(sensor)}
    listed = Sensor(Layout(4, 6, 25e-12, 1.0), [Detection(pdp=0.5), *PRINTS]).resolved()
    settable = {c.name for c in candidates(listed, captures(Scene("chart.npy", np.eye(4, 6)))) if c.kind == "set"}
    assert {n for n in settable if "print" in n} == {
        "set print_blur.radius",
        "set print_contrast.black",
        "set print_tilt.angle",
    }
    assert not [c for c in candidates(listed, captures(None)) if "print" in c.name]


def test_the_angle_of_a_print_is_no_phase() -> None:
    """A phase is another one in every capture; a chart hangs as it hangs."""
    sensor = Sensor(Layout(4, 6, 25e-12, 1.0), [PrintTilt(angle=0.1), Flicker(amplitude=0.1)]).resolved()
    assert phase_parameters(sensor) == [("flicker", "phase")]
    (tilt,) = (c for c in candidates(Sensor(sensor.layout, []).resolved(), captures(Scene("c.npy", np.eye(4, 6))))
               if c.effect == "print_tilt")  # fmt: skip
    assert not tilt.phases and [coordinate.parameter for coordinate in tilt.strengths] == ["angle"]


SENSOR = """sensor:
  rules: device
  layout: {rows: 12, columns: 12, pixel_area: 100 um^2, fill_factor: 1.0}
  effects:
    detection: {pdp: 0.4}
    dark_counts: {rate: 100 Hz}
"""
PLAN = """format: spadmnist-measurement/1
name: lab
layout: {rows: 12, columns: 12}
captures:
  - {id: a, file: a.h5, modality: qis, light: {kind: image, file: chart.npy, lux: 500 mlux},
     frames: 2000, frame_time: 10 us}
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "name"),
    [
        ("print_blur: {radius: 0.8}", "radius"),
        ("print_contrast: {black: 6 %}", "black"),
        ("print_tilt: {angle: 0.08 rad}", "angle"),
    ],
)
def test_a_print_is_fitted_by_a_capture_of_its_scene(
    hidden: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The 95 % interval holds the hidden value, with this seed; without a scene it is no candidate."""
    monkeypatch.setenv("SPADMNIST_CACHE", str(tmp_path / "cache"))
    (tmp_path / "sensor.yaml").write_text(SENSOR)
    (tmp_path / "truth.yaml").write_text(f"{SENSOR}    {hidden}\n")
    (tmp_path / "plan").mkdir()
    chart = np.kron(np.random.Generator(np.random.PCG64(3)).integers(0, 2, (4, 4)), np.full((3, 3), 255)).astype(
        np.uint8
    )
    np.save(tmp_path / "plan" / "chart.npy", chart)
    (tmp_path / "plan" / "measurement.yaml").write_text(PLAN)
    truth = config.read_sensor(tmp_path / "truth.yaml")
    twin.simulate(truth, measurement.open(tmp_path / "plan", planned=True), tmp_path / "lab", seed=2)
    effect = hidden.partition(":")[0]
    found: Any = fit_named(
        config.read_sensor(tmp_path / "sensor.yaml"), measurement.open(tmp_path / "lab"), add=[effect], jobs=1
    )
    value = found.steps[-1].values[name]
    true = getattr(truth.resolved().effect(effect), name)
    assert value.low <= true <= value.high and value.high - value.low < 0.5 * true
