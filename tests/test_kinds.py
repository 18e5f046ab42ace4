"""One thing in the place of another: a data file, the arguments in the wrong order, a dataset, a sensor file."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import spadmnist as sp
from spadmnist import cli, kinds

SENSOR = """sensor:
  layout: {rows: 4, columns: 4, pixel_area: 100 um^2, fill_factor: 0.5}
  effects:
    detection: {pdp: 0.4}
    dark_counts: {rate: 1 kHz}
"""
PLACES = {
    kinds.SENSOR_KIND: "sensor.yaml",
    kinds.MEASUREMENT_KIND: "lab/measurement.yaml",
    kinds.CONFIG_KIND: "config.yaml",
    "": "steady.csv",
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("kinds")
    (home / "sensor.yaml").write_text(SENSOR)
    (home / "config.yaml").write_text("seed: 1\nscene: {}\nsensor: sensor.yaml\n")
    (home / "steady.csv").write_text("channel,time (ps)\n0,12345\n")
    np.save(home / "dark.npy", np.zeros((3, 4, 4), np.uint8))
    sp.simulate(home / "sensor.yaml", [sp.Capture("dark", "tr", dark=True, exposure=1e-3)], folder=home / "lab")
    (home / "empty").mkdir()
    (home / "out").mkdir()
    (home / "out" / kinds.MANIFEST).write_text("{}")
    return home


@pytest.fixture
def bench(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(made, tmp_path / "bench")
    monkeypatch.chdir(tmp_path / "bench")
    return tmp_path / "bench"


def refused(*words: str) -> str:
    done = CliRunner().invoke(cli.cli, words)
    assert isinstance(done.exception, sp.SpadError), done.output
    return str(done.exception)


def test_what_lies_at_a_path(made: Path) -> None:
    for kind, place in PLACES.items():
        assert kinds.at(made / place) == kind
    assert kinds.at(made / "lab") == kinds.MEASUREMENT_KIND and kinds.at(made / "out") == kinds.DATASET_KIND
    assert not kinds.at(made / "empty") and not kinds.at(made / "nothing") and not kinds.is_data(made / "nothing")
    assert [kinds.is_data(made / name) for name in ("dark.npy", "steady.csv", "sensor.yaml", "lab")] == [1, 1, 0, 0]


@pytest.mark.parametrize("file", ["steady.csv", "dark.npy"])
def test_a_data_file_is_imported_first(file: str, bench: Path) -> None:
    for words in (("compare", "sensor.yaml", file), ("inspect", file)):
        assert f"spadmnist import {file} -o lab" in refused(*words)


def test_of_a_file_of_a_measurement_the_folder_is_named(bench: Path) -> None:
    for words in (("compare", "sensor.yaml", "lab/dark.h5"), ("inspect", "lab/dark.h5")):
        assert "lab/dark.h5" in refused(*words) and "name the folder, lab" in refused(*words)


@pytest.mark.parametrize("verb", ["compare", "diagnose", "fit", "simulate"])
def test_arguments_in_the_wrong_order(verb: str, bench: Path) -> None:
    more = ["-o", "next.yaml"] if verb in ("fit", "simulate") else []
    for lab in ("lab", "lab/measurement.yaml", "out"):
        said = refused(verb, lab, "sensor.yaml", *more)
        assert f"the order is SENSOR MEASUREMENT; did you mean: spadmnist {verb} sensor.yaml {lab}" in said


def test_a_measurement_is_not_verified(bench: Path) -> None:
    assert "lab is a measurement and not a dataset" in refused("verify", "lab")
    assert "spadmnist inspect lab" in refused("verify", "lab")


def test_a_folder_of_neither_names_both_files(bench: Path) -> None:
    said = refused("inspect", "empty")
    assert kinds.MANIFEST in said and kinds.MEASUREMENT in said


def test_a_sensor_file_is_no_measurement(bench: Path) -> None:
    (bench / "bare.yaml").write_text(SENSOR.replace("sensor:\n", "").replace("\n  ", "\n")[2:])
    for file in ("sensor.yaml", "bare.yaml"):
        said = refused("inspect", file)
        assert "begins with format: spadmnist-measurement/1, and this is a sensor file" in said and "\n" not in said
    assert "sensor.yaml is a sensor file, and no folder" in refused("verify", "sensor.yaml")
