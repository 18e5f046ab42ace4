"""A dataset is a measurement, too; looks at captures, and the command line."""

from __future__ import annotations

import contextlib
import itertools
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from measured import (
    CAPTURES,
    QIS,
    described,
    device,
    recordings,
    refused,
)

import spadmnist
from spadmnist import config, document, factory, look, measurement, report
from spadmnist.cli import _terminal, cli, main
from spadmnist.effects import Conditions
from spadmnist.errors import ConfigError, SpadError
from spadmnist.measurement import Measurement

# --- datasets -----------------------------------------------------------------------------------------------------

CONFIG = """
seed: 3
scene: {{images: {images}, wavelength: 500 nm, irradiance: [1 uW/cm^2, 20 uW/cm^2]}}
recording: {{exposure: 630 us, frames: 63, frame_time: 10 us, readouts: [tr, str, qis, counts], bits: 3}}
sensor:
  name: chip
  layout: {{rows: 3, columns: 5, pixel_area: 25 um^2}}
  effects: {{detection: {{pdp: 0.5}}, dark_counts: {{rate: 1 kHz}}, tdc: {{resolution: 1 ns}}}}
"""


def dataset_of(root: Path, images: str) -> Path:
    experiment = config.build(document.parse(CONFIG.format(images=images), "test"), root.parent)
    factory.generate(experiment, experiment.load_images(), root, 1)
    return root


def test_a_dataset_of_uniform_images_is_a_measurement(tmp_path: Path) -> None:
    root = dataset_of(tmp_path / "ds", "{source: uniform, repetitions: 2, grey: 51}")
    stored_images = spadmnist.open(root)
    opened = measurement.open(root)
    assert [c.id for c in opened.captures] == [f"{level} uW/cm^2 #{i}" for level in (1, 20) for i in (0, 1)]
    first = opened.captures[0]
    assert first.modality == "tr" and first.light.level == pytest.approx(0.01 * 51 / 255)
    assert first.conditions == Conditions(630e-6, 1, 630e-6, 630e-6, 500e-9)
    part = stored_images["20 uW/cm^2", "train"]
    read = opened.recording("20 uW/cm^2 #1").events
    assert read is not None and np.array_equal(read.ticks, part.tr[1].ticks)  # type: ignore[arg-type]
    qis = measurement.open(root, "qis").recording("20 uW/cm^2 #1")
    assert np.array_equal(np.unpackbits(qis.frames[:], axis=2, count=5), part.qis[1])  # type: ignore[index]
    stamps = measurement.open(root, "str").recording("20 uW/cm^2 #1")
    assert np.allclose(stamps.frames[:] * 1e-9, part.str[1])  # type: ignore[index]
    counts = measurement.open(root, "counts").recording("20 uW/cm^2 #1")
    assert np.array_equal(counts.frames[:], part.counts[1]) and counts.conditions.bits == 3  # type: ignore[index]
    assert opened.recording("1 uW/cm^2 #0", config.read_sensor(root / "config.yaml")).layout.pixels == 15


def test_a_dataset_without_light_is_dark_and_one_of_digits_is_none(tmp_path: Path) -> None:
    dark = measurement.open(dataset_of(tmp_path / "dark", "{source: uniform, repetitions: 1, grey: 0}"))
    assert [c.id for c in dark.captures] == ["1 uW/cm^2", "20 uW/cm^2"]
    assert all(c.light.dark and c.conditions.dark for c in dark.captures)
    text = CONFIG.replace("rows: 3, columns: 5", "rows: 28, columns: 28")
    images = "{source: digits, train: 2, test: 1}"
    experiment = config.build(document.parse(text.format(images=images), "test"), tmp_path)
    factory.generate(experiment, experiment.load_images(), tmp_path / "digits", 1)
    refused(lambda: measurement.open(tmp_path / "digits"), "only one whose source is uniform")
    refused(lambda: measurement.open(tmp_path / "dark", "int"), "int was not recorded")


# --- sensors, looks and the command line --------------------------------------------------------------------------

SENSOR = """
sensor:
  name: chip
  rules: device
  layout: {rows: 4, columns: 10, pixel_area: 25 um^2}
  effects: {detection: {pdp: 0.4}, dark_counts: {rate: 1 kHz}, dead_time: {duration: 50 ns}, tdc: {resolution: 1 ns}}
"""


def test_a_sensor_is_read_from_its_file_or_from_a_config(tmp_path: Path) -> None:
    (tmp_path / "sensor.yaml").write_text(SENSOR)
    (tmp_path / "bare.yaml").write_text("\n".join(line[2:] for line in SENSOR.splitlines()[2:]) + "\n")
    (tmp_path / "config.yaml").write_text("seed: 1\nscene: {images: {source: mnist}}\nsensor: sensor.yaml\n")
    for name in ("sensor", "bare", "config"):
        sensor = config.read_sensor(tmp_path / f"{name}.yaml")
        assert (sensor.name, sensor.rules, sensor.layout.shape) == ("chip", "device", (4, 10))
        assert sensor.nominal_dead_time == 50e-9
    (tmp_path / "wrong.yaml").write_text(SENSOR.replace("pdp: 0.4", "pdp: 2").replace("50 ns", "50") + "sed: 1\n")
    with pytest.raises(ConfigError) as caught:
        config.read_sensor(tmp_path / "wrong.yaml")
    assert len(caught.value.problems) == 3 and any("Did you mean seed?" in p for p in caught.value.problems)
    (tmp_path / "other.yaml").write_text("a: 1\n")
    with pytest.raises(ConfigError, match="describes no sensor"):
        config.read_sensor(tmp_path / "other.yaml")


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    sensor = device()
    return measurement.write(tmp_path / "lab", "lab", sensor.layout, recordings(sensor))


def test_a_look_counts_what_is_odd(lab: Path) -> None:
    opened = measurement.open(lab)
    recorded = opened.recording("tr flat")
    row = look.look(opened, recorded.capture, recorded)
    assert row["detections"] == recorded.totals.sum() and row["hot_pixels"] == 0 and row["dead_pixels"] == 0
    assert 50e-9 <= row["shortest_interval"] < 1e-6 and row["rate_max"] > row["rate_median"] > row["rate_min"]
    assert recorded.events is not None
    found = np.concatenate(list(look.intervals(recorded.events)))
    rows = [np.diff(recorded.events.times[a:b]) for a, b in itertools.pairwise(recorded.events.offsets)]
    assert np.allclose(found, np.concatenate(rows))
    odd = recorded.totals.copy()
    odd[3], odd[4] = 0, 20 * odd[4]
    recorded._kept["totals"] = odd
    row = look.look(opened, recorded.capture, recorded)
    assert (row["hot_pixels"], row["dead_pixels"], row["empty_pixels"]) == (1, 1, 1)


@pytest.mark.slow
def test_inspect_prints_and_draws(lab: Path, tmp_path: Path) -> None:
    png = tmp_path / "sheet.png"
    result = CliRunner().invoke(cli, ["inspect", str(lab), "--plot", str(png)])
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert max(map(len, lines)) <= 100
    for capture in CAPTURES:
        assert any(line.startswith(capture.id) for line in lines), capture.id
    assert png.read_bytes()[:4] == b"\x89PNG" and png.stat().st_size > 50_000
    first = png.read_bytes()
    opened = measurement.open(lab)
    report.capture_sheet(opened, report.looks(opened, True), png)
    assert png.read_bytes() == first
    found = json.loads(CliRunner().invoke(cli, ["inspect", str(lab / "measurement.yaml"), "--json"]).stdout)
    assert [row["capture"] for row in found["captures"]] == [c.id for c in CAPTURES]
    assert found["captures"][6]["mean"] == 17.25 and found["captures"][6]["detections"] is None


def test_a_sheet_of_means_alone_cannot_be_drawn(tmp_path: Path) -> None:
    opened = measurement.open(described(tmp_path, QIS.replace("file: a.h5", "mean: 3")))
    with pytest.raises(SpadError, match="only means are known"):
        report.capture_sheet(opened, report.looks(opened, True), tmp_path / "x.png")
    assert "3.000" in report.capture_table(opened, report.looks(opened, False))


PAPER = """
format: spadmnist-measurement/1
layout: {rows: 8, columns: 8}
captures:
  - {id: dark, mean: 2.6, modality: qis, light: {kind: dark}, frames: 10000, frame_time: 1 us}
  - {id: 500 low, mean: 470, modality: qis, light: {kind: flat, wavelength: 500 nm, irradiance: 120 nW/cm^2},
     frames: 10000, frame_time: 1 us}
  - {id: 700 low, mean: 62, modality: qis, light: {kind: flat, wavelength: 700 nm, irradiance: 20 nW/cm^2},
     frames: 10000, frame_time: 1 us}
  - {id: dark long, mean: 26, modality: qis, light: {kind: dark}, frames: 10000, frame_time: 10 us}
  - {id: 500 high, mean: 9715, modality: qis, light: {kind: flat, wavelength: 500 nm, irradiance: 885 nW/cm^2},
     frames: 10000, frame_time: 10 us}
  - {id: 700 high, mean: 4011, modality: qis, light: {kind: flat, wavelength: 700 nm, irradiance: 195 nW/cm^2},
     frames: 10000, frame_time: 10 us}
"""
SPAD512 = """
sensor:
  name: SPAD512
  layout: {rows: 8, columns: 8, pixel_area: 36 um^2, fill_factor: 1.0}
  effects: {detection: {pdp: {500 nm: 0.444, 700 nm: 0.207}}, dark_counts: {rate: 260 Hz}}
"""


def test_the_published_means_are_a_measurement(tmp_path: Path) -> None:
    """Only means are known: they are said, and simulated."""
    lab, out = tmp_path / "lab", tmp_path / "twin"
    lab.mkdir()
    (lab / "measurement.yaml").write_text(PAPER)
    (tmp_path / "sensor.yaml").write_text(SPAD512)
    result = CliRunner().invoke(cli, ["inspect", str(lab), "--json"], catch_exceptions=False)
    rows = {row["capture"]: row for row in json.loads(result.stdout)["captures"]}
    assert (rows["500 low"]["ones_share"], rows["500 low"]["rate_mean"]) == pytest.approx((0.047, 47_000))
    assert rows["dark"]["rate_mean"] == pytest.approx(260) and rows["dark"]["detections"] is None
    said = CliRunner().invoke(cli, ["inspect", str(lab)], catch_exceptions=False).stdout
    assert "9,715" in said and "97.2%" in said.replace(" %", "%")
    result = CliRunner().invoke(
        cli, ["simulate", str(tmp_path / "sensor.yaml"), str(lab), "-o", str(out)], catch_exceptions=False
    )
    assert result.exit_code == 0 and [path.name for path in out.iterdir()] == ["measurement.yaml"]
    means = {c.id: c.mean for c in measurement.open(out).captures}
    assert means.pop("dark") == pytest.approx(2.6, rel=0.4)  # 8 x 8 pixels scatter by 8 %
    expected = {"500 low": 472, "700 low": 55, "dark long": 26, "500 high": 9715, "700 high": 4020}
    assert means == pytest.approx(expected, rel=0.12)


def test_simulate_from_the_command_line(
    lab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sensor.yaml").write_text(SENSOR)
    arguments = ["simulate", str(tmp_path / "sensor.yaml"), str(lab), "-o", str(tmp_path / "twin"), "--seed", "5"]
    result = CliRunner().invoke(cli, [*arguments, "--json"])
    assert result.exit_code == 0 and json.loads(result.stdout)["captures"] == [c.id for c in CAPTURES]
    opened, made = measurement.open(lab), measurement.open(tmp_path / "twin")
    assert [replace(c, mean=None) for c in made.captures] == [replace(c, mean=None) for c in opened.captures]
    a, b = (int(m.recording("qis flat").totals.sum()) for m in (opened, made))
    assert a != b and abs(a - b) < 5 * np.sqrt(a + b)
    totals: list[float] = []
    steps: list[float] = []
    progress = factory.Progress(
        lambda what, total, done: totals.append(total), lambda work, note: steps.append(work), lambda: None
    )
    monkeypatch.setattr(_terminal, "progress", lambda: contextlib.nullcontext(progress))
    arguments[4] = str(tmp_path / "again")
    assert CliRunner().invoke(cli, arguments).exit_code == 0
    assert len(totals) == 1 and sum(steps) == pytest.approx(totals[0]) and len(steps) > len(CAPTURES)
    arguments[4], arguments[-1] = str(tmp_path / "twin"), "6"
    for wrong, words in (
        (arguments, "another sensor or seed"),
        (["simulate", "x.yaml", str(lab), "-o", "y"], "no such file"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(wrong)
        said = capsys.readouterr().err
        assert stop.value.code == 2 and words in said and "Traceback" not in said


def test_the_package_opens_measurements() -> None:
    code = "import spadmnist, sys; spadmnist.open_measurement; print('h5py' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "False", done.stderr
    assert spadmnist.Measurement is Measurement
