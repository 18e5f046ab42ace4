"""Diagnose: the open cases of the challenge, a null, a user's own effect, and the file that is written.

The cases were made by another simulator; they are skipped where they are not at hand.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import spadmnist as sp
from spadmnist import config, measurement, plugins, sensor_file
from spadmnist.effects import Effect
from spadmnist.inference.candidates import candidates
from spadmnist.inference.model_selection import diagnose

CASES = Path(__file__).resolve().parents[2] / "shared" / "challenge"

SENSOR = """# what the datasheet says
sensor:
  name: small
  rules: device
  layout: {rows: 8, columns: 8, pixel_area: 25 um^2, fill_factor: 1.0}
  effects:
    detection: {pdp: 0.42}   # at 500 nm
    dark_counts: {rate: 100 Hz}
    dead_time: {duration: 50 ns}
    tdc: {resolution: 100 ps}
"""

ECHO = '''
import numpy as np
from spadmnist.effects import Effect, parameter
from spadmnist.events import Children


class Echo(Effect, stage="correlated"):
    """A detection echoes in its own pixel, always equally late."""

    share = parameter(0.02, "", "detections that echo", bounds=(0, 1), off=0.0, search=(1e-4, 0.2))
    delay = parameter(150e-9, "s", "how late, after the dead time", bounds=(0, None), search=(20e-9, 2e-6))

    def spawn(self, events, rng):
        parent = np.flatnonzero(rng.random(len(events)) < self.share)
        return Children(parent, np.full(len(parent), self.delay))
'''


def case(name: str):
    folder = CASES / name
    if not folder.is_dir():
        pytest.skip("the challenge's cases are not here")
    truth = json.loads((CASES / f"{name}.truth.json").read_text())
    return config.read_sensor(folder / "sensor.yaml"), measurement.open(folder), truth


def found_in(name: str, **keywords):
    sensor, data, truth = case(name)
    return diagnose(sensor, data, quick=True, **keywords), truth


@pytest.mark.slow
def test_a_right_model_is_adequate():
    found, _ = found_in("open-qis-null")
    assert found.verdict == "adequate" and not found.steps


@pytest.mark.slow
@pytest.mark.long
def test_a_short_gate_is_found_by_its_trace_in_the_dark():
    found, truth = found_in("open-qis-gate")
    assert found.verdict == "explained"
    assert [s.candidate.effect for s in found.steps] == ["short_gate"]
    value = found.steps[0].values["fraction"]
    assert value.low <= truth["hidden"]["gate_fraction"] <= value.high


@pytest.mark.slow
@pytest.mark.long  # another effect of the same simulator is found by the test before
def test_crosstalk_is_found():
    found, truth = found_in("open-tr-crosstalk")
    assert found.steps[0].candidate.effect == "crosstalk"
    value = found.steps[0].values["probability"]
    assert value.low <= truth["hidden"]["crosstalk"][0] <= value.high
    assert found.after < 1.3 < found.before


@pytest.mark.slow
@pytest.mark.long
def test_two_populations_of_traps_are_two_steps():
    """A sensor with two populations of traps: each is a step of its own, and all intervals cover the truth."""
    effects = [
        sp.effects.Detection(pdp=0.5),
        sp.effects.DarkCounts(rate=200.0),
        sp.effects.DeadTime(duration=50e-9),
        sp.effects.Tdc(resolution=1e-10),
    ]
    hidden = {
        "afterpulsing": {"probability": 0.02, "lifetime": 40e-9},
        "slow_afterpulsing": {"probability": 0.02, "lifetime": 4e-6},
    }
    sensor = sp.Sensor(sp.Layout(4, 4, 25e-12, 1.0), effects, rules="device")
    more = [Effect.registry.find(name)(**values) for name, values in hidden.items()]
    photon = 6.62607015e-34 * 299792458.0 / 500e-9  # J
    lit = {"wavelength": 500e-9, "relative_uncertainty": 0.02}
    captures = [
        sp.Capture("dark", "tr", dark=True, exposure=2.0),
        sp.Capture("dim", "tr", exposure=0.5, irradiance=2e4 * photon / 25e-12, **lit),
        sp.Capture("lit", "tr", exposure=0.2, irradiance=1e5 * photon / 25e-12, **lit),
        sp.Capture("bright", "tr", exposure=0.03, irradiance=6e5 * photon / 25e-12, **lit),
    ]
    data = sp.simulate(sensor.changed(effects=[*effects, *more]), captures, seed=3)
    found = diagnose(sensor, data, quick=True)
    assert found.verdict == "explained" and found.after < 1.1 < 1.4 < found.steps[0].misfit < found.before
    assert {step.candidate.name for step in found.steps} == {f"add {name}" for name in hidden}
    for step in found.steps:
        for parameter, value in hidden[step.candidate.effect].items():
            assert step.values[parameter].low < value < step.values[parameter].high


def test_candidates_come_from_the_registry(tmp_path):
    file = tmp_path / "sensor.yaml"
    file.write_text(SENSOR)
    sensor = config.read_sensor(file)
    names = {candidate.name for candidate in candidates(sensor)}
    assert {"add crosstalk", "add flicker", "set dead_time.duration", "per_pixel detection.pdp"} <= names
    assert {"add row_pattern", "set dead_time.paralyzable", "per_pixel dark_counts.rate"} <= names
    # a common factor on the light is the set-up's, and what is listed is not added
    assert not names & {"set detection.pdp", "add dead_time"}
    for name in Effect.registry:
        if name not in {e.name for e in sensor.effects}:
            kind = Effect.registry.find(name)
            can = [p for p in kind.parameters.values() if p.off is not None and p.search is not None]
            assert bool(can and not kind.of_scene) == (f"add {name}" in names), name


def test_a_number_that_needs_another_one_comes_with_it() -> None:
    """The reach of crosstalk matters where it has a far part: both are one candidate, and none of an added effect."""

    def of(*more: Effect) -> dict[str, list[str]]:
        effects = [sp.effects.Detection(pdp=0.3), *more]
        sensor = sp.Sensor(sp.Layout(4, 4, 25e-12, 1.0), effects, rules="device").resolved()
        return {c.name: [d.parameter for d in c.coordinates] for c in candidates(sensor)}

    assert of()["add crosstalk"] == ["probability", "diagonal_ratio", "delay"]
    near, far = of(sp.effects.Crosstalk()), of(sp.effects.Crosstalk(reach=5.0, far_ratio=0.1))
    assert near["set crosstalk.far_ratio"] == ["far_ratio", "reach"] and near["set crosstalk.reach"] == ["reach"]
    assert far["set crosstalk.far_ratio"] == ["far_ratio"] and far["set crosstalk.reach"] == ["reach"]
    assert of(sp.effects.Jitter())["set jitter.tail_weight"] == ["tail_weight", "tail"]


def test_the_next_sensor_is_the_users_own_file(tmp_path):
    file = tmp_path / "sensor.yaml"
    file.write_text(SENSOR)
    values = {
        ("crosstalk", "probability"): 0.005,
        ("dead_time", "duration"): 52e-9,
        ("detection", "relative"): np.linspace(0.9, 1.1, 64),
    }
    out = sensor_file.write(
        sensor_file.original(file),
        tmp_path / "next" / "sensor.yaml",
        values,
        {("crosstalk", "probability"): "from lab"},
    )
    text = out.read_text()
    assert "# what the datasheet says" in text and "# at 500 nm" in text and "# from lab" in text
    read = config.read_sensor(out)
    assert read.effect("crosstalk").probability == pytest.approx(0.005)
    assert read.effect("dead_time").duration == pytest.approx(52e-9)
    assert read.effect("detection").relative == pytest.approx(np.linspace(0.9, 1.1, 64))


def test_the_next_of_the_next_sensor_leaves_its_maps_alone(tmp_path):
    """Both lie in one folder; the second has the first line once, whichever way it was written."""
    first, second = tmp_path / "next.yaml", tmp_path / "next2.yaml"
    (tmp_path / "sensor.yaml").write_text(SENSOR)
    key = ("detection", "relative")
    sensor_file.write(sensor_file.original(tmp_path / "sensor.yaml"), first, {key: np.linspace(0.9, 1.1, 64)}, {})
    sensor_file.write(sensor_file.original(first), second, {key: np.linspace(0.5, 1.5, 64)}, {})
    for file, low in ((first, 0.9), (second, 0.5)):
        assert config.read_sensor(file).effect("detection").relative[0] == pytest.approx(low)
        assert file.read_text().count("Written by spadmnist") == 1
        sensor_file.check_place(tmp_path / "sensor.yaml", file)
    lines = SENSOR.replace(
        "dead_time: {duration: 50 ns}", "dead_time:\n      duration:\n        normal: {mean: 50 ns, sigma: 1 ns}"
    )
    (tmp_path / "lines.yaml").write_text(lines)
    out = sensor_file.write(
        sensor_file.original(tmp_path / "lines.yaml"), tmp_path / "third.yaml", {("dead_time", "duration"): 55e-9}, {}
    )
    sensor_file.check_place(tmp_path / "lines.yaml", out)


def test_a_users_own_effect_is_a_candidate(tmp_path):
    plugin = tmp_path / "echo.py"
    plugin.write_text(ECHO)
    file = tmp_path / "sensor.yaml"
    file.write_text(SENSOR)
    plugins.load_file(plugin)
    try:
        names = {candidate.name for candidate in candidates(config.read_sensor(file))}
        assert "add echo" in names
    finally:
        plugins._loaded.pop(plugin.resolve(), None)
        Effect.registry.classes.pop("echo", None)
