"""A new effect from the template: it works at once, at every stage, and its name is one that can be used."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spadmnist
from spadmnist import config, plugins, reference, template
from spadmnist.effects import STAGES, Effect
from spadmnist.errors import InputError, SpadError

RUFF = Path(sys.executable).with_name("ruff")
CONFIG = """\
seed: 5
scene: {images: {source: uniform, repetitions: 40}, lux: [2560 mlux]}
recording: {exposure: 1 ms, frames: 10, frame_time: 100 us, readouts: [tr, str, qis]}
reconstruct: []
sensor:
  rules: RULES
  layout: {rows: 4, columns: 4, pixel_area: 25 um^2}
  effects:
    detection: {pdp: 0.5}
    tdc: {resolution: 100 ps}
"""


def load(stage: str, folder: Path, name: str = "light_leak") -> type[Effect]:
    plugins.load_file(template.create(name, stage, folder))
    return Effect.registry.find(name)


def opened(folder: Path, rules: str, more: str = "") -> spadmnist.Part:
    (folder / "c.yaml").write_text(CONFIG.replace("RULES", rules) + more)
    return spadmnist.open(folder / "c.yaml")["2560 mlux", "train"]


def streams(part: spadmnist.Part) -> tuple[np.ndarray, ...]:
    tr, n = part.tr[0 : len(part)], len(part)
    return tr.ticks, tr.offsets, part.str[0:n], part.qis[0:n]  # type: ignore[return-value]


@pytest.mark.parametrize("stage", STAGES)
def test_a_new_effect_is_known_and_explained(stage: str, tmp_path: Path) -> None:
    cls = load(stage, tmp_path)
    assert cls.stage == stage and cls.name == "light_leak" and cls.summary().endswith(".")
    assert "light_leak" in reference.effect_list()
    page = reference.effect_page("light_leak")
    (parameter,) = cls.parameters.values()
    assert f"file: {tmp_path / 'light_leak.py'}" in page and parameter.name in page and "Source:" in page
    assert parameter.off == 0.0 and parameter.search and parameter.default and None not in parameter.search
    low, high = parameter.search
    assert low < parameter.default < high
    for value in (parameter.off, parameter.default, low, high):
        parameter.check(value)
    if "expected_rate" in vars(cls):
        assert f"Mean rate after the effect: {reference.mean_law(cls)}" in page and reference.mean_law(cls).startswith(
            "r = "
        )


@pytest.mark.parametrize("rules", ["paper", "device"])
@pytest.mark.parametrize("stage", STAGES)
def test_a_new_effect_works_in_a_config(stage: str, rules: str, tmp_path: Path) -> None:
    """As it comes it changes what is recorded; where it vanishes it changes no byte."""
    (key,) = load(stage, tmp_path).parameters
    plain = streams(opened(tmp_path, rules))
    off = streams(opened(tmp_path, rules, f"    light_leak: {{{key}: {zero(key)}}}\n"))
    assert all(np.array_equal(a, b) for a, b in zip(plain, off, strict=True))
    yaml = "\n".join(line[2:] for line in reference.effect_yaml(Effect.registry.find("light_leak"))[2:]) + "\n"
    part = opened(tmp_path, rules, yaml)
    on = streams(part)
    assert len(on[0]) > 1000 and not np.array_equal(plain[0], on[0])
    # an image alone, and among others
    assert np.array_equal(part.tr[7].ticks, part.tr[5:9].images(2, 3).ticks)


def zero(key: str) -> str:
    (declared,) = (p for p in Effect.registry.find("light_leak").parameters.values() if p.name == key)
    return f"0 {declared.unit}".strip()


@pytest.mark.parametrize("stage", STAGES)
def test_a_new_effect_s_mean_is_the_one_it_states(stage: str, tmp_path: Path) -> None:
    """About 80,000 detections of 16 pixels in 40 images, 6 standard errors (false-alarm rate below 1e-6)."""
    load(stage, tmp_path)
    yaml = "\n".join(line[2:] for line in reference.effect_yaml(Effect.registry.find("light_leak"))[2:]) + "\n"
    part = opened(tmp_path, "paper", yaml)
    experiment = config.read(tmp_path / "c.yaml")
    photons = np.full((1, 16), experiment.white(experiment.levels[0]))
    _, expected = experiment.sensor.expected(photons, experiment.conditions)
    wanted = expected.sum() * 40
    assert abs(len(part.tr[0:40]) - wanted) < 6 * np.sqrt(1.1 * wanted)


@pytest.mark.skipif(not RUFF.exists(), reason="ruff is not installed")
def test_new_files_are_clean(tmp_path: Path) -> None:
    for stage in STAGES:
        template.create(f"effect_of_{stage}", stage, tmp_path)
        template.create("l" * 40 if stage == "light" else f"long_{'n' * 20}_{stage}", stage, tmp_path)
    settings = str(Path(__file__).parents[1] / "pyproject.toml")
    for arguments in (["check", "--select", "E,F,W,I,B,UP,C4,SIM,RUF,NPY,D300,N"], ["format", "--check"]):
        done = subprocess.run(
            [RUFF, *arguments, "--no-cache", "--config", settings, tmp_path], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stdout + done.stderr


NAMES = [
    ("LightLeak", "small letters with _"),
    ("light-leak", "small letters with _"),
    ("light leak", "small letters with _"),
    ("_leak", "small letters with _"),
    ("leak_", "small letters with _"),
    ("light__leak", "small letters with _"),
    ("2_leaks", "small letters with _"),
    ("", "small letters with _"),
    ("größe", "small letters with _"),
    ("leak.py", "small letters with _"),
    ("../leak", "small letters with _"),
    ("l" * 41, "at most 40 letters"),
    ("x_ray", "single letter"),
    ("leak_2d", "begins with a letter"),
    ("dead_time", "dead_time is an effect already, in .*dead_time.py; choose another name"),
    ("effect", "builds on; choose another name"),
    ("random", "hide the Python module random"),
    ("lambda", "a word of Python's own"),
    ("class", "a word of Python's own"),
    ("numpy", "hide the Python module numpy"),
    ("spadmnist", "hide the Python module spadmnist"),
]


@pytest.mark.parametrize(("name", "says"), NAMES, ids=[n[:12] for n, _ in NAMES])
def test_a_name_that_cannot_be(name: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=says) as caught:
        template.create(name, "dark", tmp_path)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir()) and not (tmp_path.parent / "leak.py").exists()


@pytest.mark.parametrize("name", ["leak", "light_leak", "leak2", "mode_a", "l" * 40])
def test_a_name_that_can_be(name: str, tmp_path: Path) -> None:
    assert load("dark", tmp_path, name).name == name


def test_a_class_that_the_file_builds_on_is_no_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Children"):
        template.create("children", "correlated", tmp_path)


def test_a_name_of_a_plug_in_is_taken(tmp_path: Path) -> None:
    load("dark", tmp_path)
    (tmp_path / "other").mkdir()
    with pytest.raises(InputError, match=rf"light_leak is an effect already, in {tmp_path}"):
        template.create("light_leak", "light", tmp_path / "other")


def test_an_unknown_stage_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'ligth' is not a stage\. Did you mean light\? The stages are light, "):
        template.create("light_leak", "ligth", tmp_path)
    assert not list(tmp_path.iterdir())


def folder(path: Path) -> None:
    path.mkdir()


def text(path: Path) -> None:
    path.write_text("mine")


def dangling(path: Path) -> None:
    path.symlink_to("nowhere")


def _unchanged(path: Path) -> tuple[int, ...]:
    """What a file keeps while it is only read (its time of access moves)."""
    state = os.lstat(path)
    return state.st_mode, state.st_ino, state.st_size, state.st_mtime_ns


@pytest.mark.parametrize("there", [folder, text, dangling])
def test_nothing_is_overwritten(there: Callable[[Path], Any], tmp_path: Path) -> None:
    path = tmp_path / "light_leak.py"
    there(path)
    before = _unchanged(path)
    with pytest.raises(InputError, match=r"light_leak\.py is there already; choose another name, or remove it"):
        template.create("light_leak", "dark", tmp_path)
    assert _unchanged(path) == before and not (tmp_path / "nowhere").exists()


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(SpadError, match=r"light_leak\.py: cannot be written"):
        template.create("light_leak", "dark", tmp_path / "none")
