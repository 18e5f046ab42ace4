"""Configs: every mistake is one line with its place and what to do; what is right stays as it was written."""

from __future__ import annotations

import dataclasses
import importlib.util
import re
import shutil
import tokenize
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from spadmnist import config, document, factory, plugins, reference, units
from spadmnist.effects import Effect
from spadmnist.errors import ConfigError, InputError
from spadmnist.light import photons_from_irradiance, photons_from_lux

ROOT = Path(__file__).parents[1]
FILES = sorted(p.name for p in (ROOT / "configs").glob("*.yaml"))
SHIPPED = [name for name in FILES if "\nscene:" in (ROOT / "configs" / name).read_text()]  # the others are sensors

BASE = """\
seed: 1
scene:
  images: {source: digits, train: 4, test: 2}
  wavelength: 555 nm
  lux: [5 mlux, 2560 mlux]
recording:
  exposure: 1 ms
  frames: 100
  frame_time: 10 us
  frame_period: 10 us
  readouts: [tr, str, qis]
reconstruct: [counts, qis_linear]
sensor:
  name: test
  rules: paper
  chip_seed: 1
  layout:
    rows: 28
    columns: 28
    pixel_area: 25 um^2
    fill_factor: 1.0
  effects:
    detection: {pdp: 0.5}
    dark_counts: {rate: 100 Hz}
    afterpulsing: {probability: 0.5 %, lifetime: 25 ns}
    dead_time: {duration: 50 ns}
    tdc: {resolution: 10 ps}
output: {format: zarr}
"""
EFFECTS = BASE[BASE.index("  effects:") : BASE.index("output:")]
SCENE = BASE[BASE.index("scene:") : BASE.index("recording:")]
SENSOR = BASE[BASE.index("sensor:") : BASE.index("output:")]
RATE = "rate: 100 Hz"


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """A warning is no way to talk to a user."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def changed(old: str, new: str) -> tuple[str, int]:
    """The base config with one change, and the line of the change."""
    assert old in BASE
    return BASE.replace(old, new, 1), BASE[: BASE.index(old)].count("\n") + 1


def build(text: str, base: Path = ROOT) -> config.Experiment:
    return config.build(document.parse(text, "lab.yaml"), base)


def mistakes(text: str, base: Path = ROOT) -> tuple[str, ...]:
    """Every mistake, one line each, in words of the project."""
    with pytest.raises(ConfigError) as caught:
        build(text, base)
    for problem in caught.value.problems:
        assert problem.startswith("lab.yaml") or str(base) in problem
        assert "\n" not in problem and len(problem) < 400
    return caught.value.problems


def test_the_base_is_right() -> None:
    experiment = build(BASE)
    assert [level.text for level in experiment.levels] == ["5 mlux", "2560 mlux"]
    assert experiment.levels[0].value == 0.005
    assert experiment.readouts == ("tr", "str", "qis") and experiment.methods == ("counts", "qis_linear")
    assert [e.name for e in experiment.sensor.effects] == [
        "detection",
        "dark_counts",
        "afterpulsing",
        "dead_time",
        "tdc",
    ]


# --- one mistake: (what stands there, what is written instead, path, what the line says) -----------------------------

NORMAL = "normal: {mean: 9 Hz, sigma: 1 Hz}"
SHORT = {"DC.": "sensor.effects.dark_counts.", "SE.": "sensor.effects.", "SL.": "sensor.layout."}
MISTAKES = [
    ("seed: 1", "seed: -1", "seed", "-1|0"),
    ("seed: 1", "seed: 1.5", "seed", "1.5|whole number"),
    ("seed: 1", "seed: true", "seed", "True|whole number"),
    ("seed: 1", "seed: '1'", "seed", "'1'|whole number"),
    ("seed: 1", "seed: .nan", "seed", "nan|whole number"),
    ("seed: 1", f"seed: {2**63}", "seed", f"{2**63}"),
    ("seed: 1", f"seed: 1{'0' * 400}", "seed", "can be held"),
    ("seed: 1", "limit: 0\nseed: 1", "limit", "0|1"),
    ("digits, train", "digit, train", "scene.images.source",
     "'digit'|mnist, idx, folder, array, digits, uniform|mean digits?"),
    ("source: digits, train: 4", "train: 4", "scene.images", "source|mnist, idx, folder, array, digits, uniform"),
    ("train: 4", "train: -4", "scene.images.train", "-4|1"),
    ("train: 4", "train: 4.5", "scene.images.train", "4.5|whole number"),
    ("555 nm", "555", "scene.wavelength", "555 has no unit|length|555 nm"),
    ("555 nm", "555 Hz", "scene.wavelength", "'555 Hz'|length|nm|555 nm"),
    ("555 nm", "0 nm", "scene.wavelength", "0 nm|more than 0"),
    ("555 nm", "-555 nm", "scene.wavelength", "-555 nm|more than 0"),
    ("555 nm", "nan nm", "scene.wavelength", "'nan nm'|length"),
    ("555 nm", ".nan", "scene.wavelength", "nan|length|555 nm"),
    ("555 nm", "null", "scene.wavelength", "None|length"),
    ("555 nm", "[555 nm]", "scene.wavelength", "length|555 nm"),
    ("[5 mlux,", "[5,", "scene.lux[0]", "5 has no unit|illuminance|mlux"),
    ("2560 mlux]", "2560 mlx]", "scene.lux[1]", "'2560 mlx'|illuminance|mlux"),
    ("2560 mlux]", "5 nW/cm^2]", "scene.lux[1]", "'5 nW/cm^2'|illuminance"),
    ("2560 mlux]", "-1 mlux]", "scene.lux[1]", "-1 mlux|more than 0"),
    ("2560 mlux]", "0 mlux]", "scene.lux[1]", "0 mlux|more than 0"),
    ("2560 mlux]", "0.005 lux]", "scene.lux[1]", "0.005 lux|5 mlux again|once"),
    ("2560 mlux]", "5.0 mlux]", "scene.lux[1]", "5.0 mlux|5 mlux again|once"),
    ("2560 mlux]", "5e3 ulux]", "scene.lux[1]", "5e3 ulux|5 mlux again|once"),
    ("lux: [5 mlux, 2560 mlux]", "irradiance: [10 uW/cm^2, 0.1 W/m^2]", "scene.irradiance[1]",
     "10 uW/cm^2 again"),
    ("lux: [5 mlux, 2560 mlux]", "irradiance: [5 mlux]", "scene.irradiance[0]", "'5 mlux'|irradiance|nW/cm^2"),
    ("exposure: 1 ms", "exposure: 2 ms", "recording.exposure", "2 ms|frames x frame_period|100 x 10 us = 1 ms"),
    ("exposure: 1 ms", "exposure: 1", "recording.exposure", "1 has no unit|time|ms"),
    ("exposure: 1 ms", "exposure: -1 ms", "recording.exposure", "-1 ms|more than 0"),
    ("frames: 100", "frames: 0", "recording.frames", "0|1"),
    ("frames: 100", "frames: 1e2", "recording.frames", "100.0|whole number"),
    ("frames: 100", "frames: 10000000000", "recording.frames", "10000000000"),
    ("frame_time: 10 us", "frame_time: 11 us", "recording.frame_time", "11 us|frame period of 10 us"),
    ("frame_time: 10 us", "frame_time: 0 us", "recording.frame_time", "0 us|more than 0"),
    ("[tr, str, qis]", "[tr, str, qsi]", "recording.readouts[2]", "'qsi'|tr, str, qis|mean qis?"),
    ("[counts, qis_linear]", "[count]", "reconstruct[0]", "count |mean counts?|spadmnist methods"),
    ("[counts, qis_linear]", "[counts, counts]", "reconstruct[1]", "counts|twice"),
    ("rules: paper", "rules: papers", "sensor.rules", "'papers'|paper, device|mean paper?"),
    ("rules: paper", "rules: true", "sensor.rules", "True|paper, device"),
    ("chip_seed: 1", "chip_seed: x", "sensor.chip_seed", "'x'|whole number"),
    ("rows: 28", "rows: 0", "SL.rows", "0|1"),
    ("rows: 28", "rows: 28 px", "SL.rows", "'28 px'|whole number"),
    ("25 um^2", "25", "SL.pixel_area", "25 has no unit|area|25 um^2"),
    ("25 um^2", "25 um", "SL.pixel_area", "'25 um'|area|um^2"),
    ("25 um^2", "0 um^2", "SL.pixel_area", "0 um^2|more than 0"),
    ("fill_factor: 1.0", "fill_factor: 1.5", "SL.fill_factor", "1.5|at most 1"),
    ("fill_factor: 1.0", "fill_factor: 0", "SL.fill_factor", "0|more than 0"),
    ("fill_factor: 1.0", "fill_factor: .nan", "SL.fill_factor", "nan|number"),
    ("fill_factor: 1.0", "fill_factor: true", "SL.fill_factor", "True|number"),
    ("dead_time: {", "dead_tme: {", "SE.dead_tme", "not an effect|mean dead_time?|spadmnist effects"),
    ("dead_time: {duration: 50 ns}", "dead_time: 50 ns", "SE.dead_time", "'50 ns'|parameters"),
    ("duration: 50", "duraton: 50", "SE.dead_time.duraton", "not a parameter of dead_time|mean duration?"),
    ("duration: 50 ns", "duration: 50", "SE.dead_time.duration", "50 has no unit|time|ns|50 ns"),
    ("duration: 50 ns", "duration: 50 nS", "SE.dead_time.duration", "'50 nS'|time|ns"),
    ("duration: 50 ns", "duration: 50 parsecs", "SE.dead_time.duration", "'50 parsecs'|time|ns"),
    ("duration: 50 ns", "duration: -50 ns", "SE.dead_time.duration", "-50 ns|at least 0 s"),
    ("duration: 50 ns", "duration: null", "SE.dead_time.duration", "None|time|ns"),
    ("duration: 50 ns", "duration: true", "SE.dead_time.duration", "True|time|ns"),
    ("duration: 50 ns", "duration: 9**9**9", "SE.dead_time.duration", "'9**9**9'|time|ns"),
    ("duration: 50 ns", "duration: 1e999 s", "SE.dead_time.duration", "'1e999 s'|too large"),
    ("lifetime: 25 ns", "lifetime: 0 ns", "SE.afterpulsing.lifetime", "more than 0 s"),
    ("lifetime: 25 ns", "lifetime: {file: a.npy}", "SE.afterpulsing.lifetime", "one number"),
    ("lifetime: 25 ns", "lifetime: {normal: {mean: 1 ns, sigma: 1 ns}}", "SE.afterpulsing.lifetime", "one number"),
    ("0.5 %", "50 Hz", "SE.afterpulsing.probability", "'50 Hz'|number|0.5 %"),
    ("0.5 %", "150 %", "SE.afterpulsing.probability", "150 %|between 0 and 1"),
    ("0.5 %", ".nan", "SE.afterpulsing.probability", "nan|number"),
    ("pdp: 0.5", "pdp: 1.5", "SE.detection.pdp", "1.5|between 0 and 1"),
    ("pdp: 0.5", "pdp: 0", "SE.detection.pdp", "0|more than 0"),
    ("pdp: 0.5", "pdp: {}", "SE.detection.pdp", "empty|500 nm: 0.42"),
    ("pdp: 0.5", "pdp: {400 nm: 0.1, 500 nm: 0.5}", "SE.detection.pdp", "555 nm|outside|400 nm to 500 nm|add"),
    ("pdp: 0.5", "pdp: {500 nm: 0.1, 0.5 um: 0.5, 600 nm: 0.2}", "SE.detection.pdp", "twice"),
    ("pdp: 0.5", "pdp: {500: 0.1, 600 nm: 0.2}", "SE.detection.pdp", "500 has no unit|wavelength|555 nm"),
    ("pdp: 0.5", "pdp: {500 nm: 0.1, 600 nm: 2}", "SE.detection.pdp.600 nm", "2|between 0 and 1"),
    ("pdp: 0.5", "pdp: {500 nm: .nan, 600 nm: 0.2}", "SE.detection.pdp.500 nm", "nan|number"),
    ("10 ps", "20 us", "SE.tdc.resolution", "20 us|10 us|STR"),
    ("10 ps}", "10 ps, rounding: flor}", "SE.tdc.rounding", "'flor'|nearest or floor. Did you mean floor?"),
    ("10 ps}", "10 ps, rounding: 1}", "SE.tdc.rounding", "1 is|nearest or floor"),
    ("10 ps}", "10 ps, rounding: {file: a.npy}}", "SE.tdc.rounding", "nearest or floor"),
    ("10 ps", "1e-30 s", "SE.tdc.resolution", "ticks|coarser"),
    (RATE, "rate: {}", "DC.rate", "forms|{file: map.npy}|normal|lognormal|mixture"),
    (RATE, "rate: {fil: a.npy}", "DC.rate", "fil|forms|{file: map.npy}"),
    (RATE, "rate: {file: 5}", "DC.rate.file", "5|file name"),
    (RATE, "rate: {normal: {mean: 100 Hz}}", "DC.rate.normal", "mean and sigma"),
    (RATE, "rate: {normal: 5}", "DC.rate.normal", "5|mean and sigma"),
    (RATE, "rate: {normal: {mean: 9 Hz, sigma: 1}}", "DC.rate.normal.sigma", "1 has no unit|Hz"),
    (RATE, "rate: {normal: {mean: 9 Hz, sigma: -1 Hz}}", "DC.rate.normal.sigma", "-1 Hz|at least 0"),
    (RATE, "rate: {normal: {mean: -9 Hz, sigma: 1 Hz}}", "DC.rate.normal.mean", "-9 Hz|at least 0"),
    (RATE, "rate: {lognormal: {median: 9 Hz, sigma: -1}}", "DC.rate.lognormal.sigma", "-1|at least 0"),
    (RATE, "rate: {lognormal: {median: 9 Hz, sigma: 1 Hz}}", "DC.rate.lognormal.sigma", "'1 Hz'|number"),
    (RATE, "rate: {lognormal: {mean: 9 Hz, sigma: 1}}", "DC.rate.lognormal", "median and sigma"),
    (RATE, "rate: {mixture: []}", "DC.rate.mixture", "list|share"),
    (RATE, "rate: {mixture: [{normal: {mean: 9 Hz, sigma: 1 Hz}}]}", "DC.rate.mixture[0]", "share"),
    (RATE, f"rate: {{mixture: [{{share: 0.9, {NORMAL}}}]}}", "DC.rate.mixture", "0.9|not to 1"),
    (RATE, f"rate: {{mixture: [{{share: 2, {NORMAL}}}, {{share: -1, {NORMAL}}}]}}", "DC.rate.mixture[0].share",
     "2|between 0 and 1"),
    (RATE, "rate: {normal: {mean: 9 Hz, sigma: 1 Hz}, lognormal: {median: 9 Hz, sigma: 1}}", "DC.rate",
     "one of normal, lognormal, mixture"),
    ("format: zarr", "format: zar", "output.format", "'zar'|zarr, hdf5|mean zarr?"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "path", "says"), MISTAKES, ids=[f"{m[2]}: {m[1]}"[:60] for m in MISTAKES])
def test_a_mistake_is_one_line_with_its_place(old: str, new: str, path: str, says: str) -> None:
    text, line = changed(old, new)
    (problem,) = mistakes(text)
    path = SHORT.get(path[:3], path[:3]) + path[3:]
    assert problem.startswith(f"lab.yaml:{line}: {path}")
    for part in says.split("|"):
        assert part in problem


TYPOS = [
    ("scene:", "scenes:", "scene"),
    ("  exposure:", "  expsure:", "exposure"),
    ("train: 4", "trian: 4", "train"),
    ("wavelength:", "wavelenght:", "wavelength"),
    ("frames:", "frame:", "frames"),
    ("rules:", "rule:", "rules"),
    ("chip_seed:", "chip_sed:", "chip_seed"),
    ("    rows:", "    row:", "rows"),
    ("pixel_area:", "pixel_aera:", "pixel_area"),
    ("  effects:", "  effect:", "effects"),
    ("format:", "fromat:", "format"),
    ("probability:", "probabilty:", "probability"),
]


@pytest.mark.parametrize(("old", "new", "meant"), TYPOS)
def test_a_typo_is_told_what_was_meant(old: str, new: str, meant: str) -> None:
    text, line = changed(old, new)
    found = [p for p in mistakes(text) if p.startswith(f"lab.yaml:{line}: ")]
    assert len([p for p in found if f"Did you mean {meant}?" in p]) == 1


@pytest.mark.parametrize("entry", ["seed: 1\n", SCENE, "  exposure: 1 ms\n", SENSOR, "    rows: 28\n", EFFECTS])
def test_what_is_missing_is_named(entry: str) -> None:
    name = entry.split(":")[0].strip()
    assert any(re.search(rf"\b{name} is missing", p) for p in mistakes(BASE.replace(entry, "")))


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        ("  lux: [5 mlux, 2560 mlux]\n", "lux: [5 mlux, ...]|irradiance:"),
        ("  frames: 100\n", "str|qis|frames"),
        ("  frame_time: 10 us\n", "str|qis|frame_time"),
    ],
)
def test_what_is_needed_here_is_named(entry: str, says: str) -> None:
    (problem,) = mistakes(BASE.replace(entry, ""))
    assert all(part in problem for part in says.split("|"))


def test_light_is_given_once() -> None:
    text, _ = changed("  lux:", "  irradiance: [1 nW/cm^2]\n  lux:")
    (problem,) = mistakes(text)
    assert "once" in problem and "lux" in problem and "irradiance" in problem


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (SCENE, "scene: 5\n"),
        (SCENE, "scene:\n"),
        (SCENE, "scene: [1]\n"),
        ("{source: digits, train: 4, test: 2}", "digits"),
        ("[5 mlux, 2560 mlux]", "5 mlux"),
        ("[5 mlux, 2560 mlux]", "[]"),
        ("[tr, str, qis]", "tr"),
        ("[tr, str, qis]", "[]"),
        ("[counts, qis_linear]", "counts"),
        ("[counts, qis_linear]", "[null]"),
        (EFFECTS, "  effects:\n"),
        (EFFECTS, "  effects: [detection]\n"),
        ("{format: zarr}", "zarr"),
        ("{format: zarr}", ""),
        (SENSOR, "sensor: 5\n"),
        (SENSOR, "sensor: [1]\n"),
    ],
)
def test_a_wrong_shape_is_told_in_words_of_the_config(old: str, new: str) -> None:
    """Not in those of the library that checks it: no class of ours, no dictionary, no validation."""
    text, line = changed(old, new)
    (problem,) = mistakes(text)
    assert problem.startswith(f"lab.yaml:{line}: ")
    assert not re.search(r"instance of|\b_[A-Z]|dictionary|validation|object to extract|fields", problem)


@pytest.mark.parametrize("text", ["", "# nothing\n", "5\n", "- 1\n", "[]\n", "words\n"])
def test_what_is_no_config_at_all(text: str) -> None:
    (problem,) = mistakes(text)
    assert "config" in problem and "scene" in problem


def test_a_level_that_stands_three_times_is_told_once_each() -> None:
    text, _ = changed("2560 mlux]", "5.0 mlux, 0.005 lux]")
    found = mistakes(text)
    assert [p.split(": ")[1] for p in found] == ["scene.lux[1]", "scene.lux[2]"]


def test_a_readout_that_stands_twice_is_refused() -> None:
    text, line = changed("[tr, str, qis]", "[tr, tr, qis]")
    (problem,) = mistakes(text)
    assert problem.startswith(f"lab.yaml:{line}: recording.readouts[1]") and "twice" in problem


def test_a_method_without_its_readout_is_refused() -> None:
    text, line = changed("[tr, str, qis]", "[tr]")
    (problem,) = mistakes(text)
    assert problem.startswith(f"lab.yaml:{line + 1}: reconstruct[1]: qis_linear needs qis")


def test_a_key_that_stands_twice_is_refused_with_both_lines() -> None:
    text, line = changed("    columns: 28\n", "    columns: 28\n    rows: 27\n")
    (problem,) = mistakes(text)
    assert problem.startswith(f"lab.yaml:{line + 1}: ") and f"line {line - 1}" in problem


# --- all at once ---------------------------------------------------------------------------------------------------


def test_all_mistakes_are_told_at_once() -> None:
    text = BASE
    for old, new in [
        ("seed: 1", "seed: -1"),
        ("source: digits", "source: digit"),
        ("[5 mlux,", "[5,"),
        ("frames: 100", "frames: 0"),
        ("[tr, str", "[tr, st"),
        ("rows: 28", "rows: 0"),
        ("25 um^2", "25 um"),
        ("dead_time: {", "dead_tme: {"),
        (RATE, "rte: 100 Hz"),
        ("lifetime: 25 ns", "lifetime: 25"),
        ("format: zarr", "format: zar"),
    ]:
        text = text.replace(old, new, 1)
    found = mistakes(text)
    assert len(found) == 11
    for path in (
        "seed", "scene.images.source", "scene.lux[0]", "recording.frames", "recording.readouts[1]",
        "sensor.layout.rows",
        "sensor.layout.pixel_area", "sensor.effects.dead_tme", "sensor.effects.dark_counts.rte",
        "sensor.effects.afterpulsing.lifetime", "output.format",
    ):  # fmt: skip
        assert len([p for p in found if re.match(rf"lab\.yaml:\d+: {re.escape(path)}(?![\w.])", p)]) == 1


CROSS = [
    ("2560 mlux]", "0.005 lux]", "scene.lux[1]"),
    ("exposure: 1 ms", "exposure: 2 ms", "recording.exposure"),
    ("[counts, qis_linear]", "[counts, conts]", "reconstruct[1]"),
    ("pdp: 0.5", "pdp: {400 nm: 0.1, 500 nm: 0.5}", "sensor.effects.detection.pdp"),
    (RATE, "rate: {file: missing.npy}", "sensor.effects.dark_counts.rate"),
    ("10 ps", "20 us", "sensor.effects.tdc.resolution"),
]


@pytest.mark.parametrize(("old", "new", "path"), CROSS, ids=[c[2] for c in CROSS])
def test_a_typo_elsewhere_hides_no_other_mistake(old: str, new: str, path: str, tmp_path: Path) -> None:
    """All errors of a config are listed at once, also those that are found by looking at several entries."""
    text = changed(old, new)[0].replace("format: zarr", "fromat: zarr")
    found = mistakes(text, tmp_path)
    assert len(found) == 2
    assert any(path in p for p in found) and any("output.fromat" in p for p in found)


def test_the_mistakes_that_need_several_entries_are_told_together(tmp_path: Path) -> None:
    text = BASE
    for old, new, _ in CROSS:
        text = text.replace(old, new, 1)
    found = mistakes(text, tmp_path)
    for _, _, path in CROSS:
        assert any(path in p for p in found), path


# --- maps ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def maps(tmp_path: Path) -> Path:
    good = np.linspace(10, 1000, 784)
    nan, negative = good.copy(), good.copy()
    nan[7], negative[7] = np.nan, -1.0
    for name, array in {
        "flat": good, "square": good.reshape(28, 28), "whole": np.arange(784), "nan": nan,
        "negative": negative,
        "infinite": np.where(good > 999, np.inf, good), "small": good[:-1], "twisted": good.reshape(14, 56),
        "cube": good.reshape(28, 28, 1), "complex": good * 1j, "text": good.astype(str), "bool": good > 50,
        "one": np.float64(5),
    }.items():  # fmt: skip
        np.save(tmp_path / f"{name}.npy", array)
    np.save(tmp_path / "pickle.npy", np.array([Bomb()] * 784, object), allow_pickle=True)
    np.savez(tmp_path / "zip.npy", a=good)
    (tmp_path / "zip.npy.npz").rename(tmp_path / "zip.npy")
    (tmp_path / "words.npy").write_text("10, 20, 30\n")
    (tmp_path / "empty.npy").write_bytes(b"")
    whole = (tmp_path / "flat.npy").read_bytes()
    (tmp_path / "cut.npy").write_bytes(whole[:-100])
    (tmp_path / "torn.npy").write_bytes(whole.replace(b"}", b" "))  # of the header, which is a Python literal
    (tmp_path / "folder.npy").mkdir()
    return tmp_path


class Bomb:
    """What a pickle would run."""

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return pytest.fail, ("a map was unpickled",)


@pytest.mark.parametrize("name", ["flat", "square", "whole"])
def test_a_map_is_read(name: str, maps: Path) -> None:
    experiment = build(changed(RATE, f"rate: {{file: {name}.npy}}")[0], maps)
    effect: Any = experiment.sensor.effect("dark_counts")
    assert np.array_equal(effect.rate, np.load(maps / f"{name}.npy").ravel())


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("missing", "no such file"), ("nan", "entry 7|nan|finite"), ("infinite", "inf|finite"),
        ("negative", "entry 7|-1 Hz|at least 0"),
        ("small", "(783,)|(28, 28)"), ("twisted", "(14, 56)"), ("cube", "(28, 28, 1)"), ("complex", "complex"),
        ("text", "<U"),
        ("bool", "bool"), ("one", "(28, 28)"), ("pickle", "numpy.save"), ("zip", "archive"),
        ("words", "numpy.save"),
        ("empty", "numpy.save"), ("cut", "numpy.save"), ("torn", "numpy.save"), ("folder", "older"),
    ],
)  # fmt: skip
def test_a_map_that_cannot_be_used_is_refused(name: str, says: str, maps: Path) -> None:
    text, line = changed(RATE, f"rate: {{file: {name}.npy}}")
    (problem,) = mistakes(text, maps)
    assert problem.startswith(f"lab.yaml:{line}: sensor.effects.dark_counts.rate")
    assert f"{name}.npy" in problem and not re.search("allow_pickle|unsafely", problem)
    assert all(part in problem for part in says.split("|"))


def test_a_map_of_another_array_is_refused(maps: Path) -> None:
    """A map of as many pixels, but with rows and columns exchanged, would lie on the wrong pixels."""
    np.save(maps / "turned.npy", np.full((14, 56), 5.0))
    text = BASE.replace("rows: 28", "rows: 56").replace("columns: 28", "columns: 14")
    (problem,) = mistakes(text.replace(RATE, "rate: {file: turned.npy}"), maps)
    assert "(14, 56)" in problem


PER = '''
from spadmnist import Effect, parameter


class Weights(Effect, stage="light"):
    """A weight for each of what there is."""

    rows = parameter(1.0, "", "of a row", per="row", bounds=(0, None), off=1.0)
    columns = parameter(1.0, "", "of a column", per="column", bounds=(0, None), off=1.0)
    codes = parameter(1.0, "", "of a code", per="code", bounds=(0, None), off=1.0)
    period = parameter(8, "", "codes", bounds=(1, None))
    pixels = parameter(1.0, "", "of a pixel", per="pixel", bounds=(0, None), off=1.0)
    extra = parameter(None, "", "may be left out", per="pixel")

    def apply(self, rate, conditions):
        return rate * self.pixels
'''
WEIGHTS = BASE.replace("rows: 28", "rows: 4").replace("columns: 28", "columns: 6")
WEIGHTS = WEIGHTS.replace("    detection:", "    weights: {VALUES}\n    detection:")


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """A folder, and an effect with a map for each of what a map can be for."""
    (tmp_path / "weights.py").write_text(PER)
    plugins.load_file(tmp_path / "weights.py")
    return tmp_path


@pytest.mark.parametrize(
    ("key", "shape", "says"),
    [
        ("rows", (6,), "each row: (4,)"),
        ("columns", (4,), "each column: (6,)"),
        ("columns", (4, 6), "each column: (6,)"),
        ("codes", (4, 6), "each code: (8,) or (n,) or (24, n)"),
        ("codes", (0,), "each code: (8,)"),
        ("pixels", (6, 4), "each pixel: (4, 6) or (24,)"),
    ],
)
def test_a_map_of_the_wrong_shape_is_told(key: str, shape: tuple[int, ...], says: str, weights: Path) -> None:
    np.save(weights / "map.npy", np.ones(shape))
    (problem,) = mistakes(WEIGHTS.replace("VALUES", f"{key}: {{file: map.npy}}"), weights)
    assert problem.startswith(f"lab.yaml:23: sensor.effects.weights.{key}: {weights / 'map.npy'}: is float64 of shape")
    assert str(shape) in problem and says in problem


def test_what_has_no_default_stays_left_out(weights: Path) -> None:
    first = build(WEIGHTS.replace("VALUES", "pixels: 0.5"), weights)
    assert "extra" not in first.resolved["sensor"]["effects"]["weights"]
    again = build(document.dump(first.resolved), weights).sensor.effect("weights")
    assert getattr(again, "extra") is None and getattr(again, "pixels") == 0.5  # noqa: B009
    assert "extra:" not in reference.effect_page("weights")


def test_maps_of_all_kinds_travel(weights: Path, tmp_path: Path) -> None:
    """The files of a dataset hold each map in its own shape, and its config reads them back."""
    shapes = {"rows": (4,), "columns": (6,), "codes": (24, 3), "pixels": (24,)}
    for key, shape in shapes.items():
        np.save(weights / f"{key}.npy", np.arange(1.0, np.prod(shape) + 1).reshape(shape))
    listed = ", ".join(f"{key}: {{file: {key}.npy}}" for key in shapes)
    first = build(WEIGHTS.replace("VALUES", listed), weights)
    resolved, files = factory.portable(first)
    assert sorted(files) == sorted(f"maps/weights.{key}.npy" for key in shapes)
    (tmp_path / "apart" / "maps").mkdir(parents=True)
    for name, data in files.items():
        (tmp_path / "apart" / name).write_bytes(data)
    again = config.build(document.parse(document.dump(resolved), "again.yaml"), tmp_path / "apart")
    one, other = first.sensor.effect("weights"), again.sensor.effect("weights")
    for key, shape in shapes.items():
        assert getattr(one, key).shape == shape and np.array_equal(getattr(one, key), getattr(other, key))
    assert np.load(tmp_path / "apart" / "maps" / "weights.pixels.npy").shape == (4, 6)
    assert factory.portable(again)[1] == files


# --- every effect that there is --------------------------------------------------------------------------------------


def declared() -> Iterator[tuple[str, str, plugins.Parameter]]:
    for name in Effect.registry:
        for key, parameter in Effect.registry.find(name).parameters.items():
            yield name, key, parameter


def beyond(parameter: plugins.Parameter) -> Iterator[float]:
    """Values that are not possible, in SI."""
    low, high = parameter.bounds
    if low is not None:
        yield float(low - max(abs(low), 1.0))
        if parameter.open_bounds:
            yield float(low)
    if high is not None:
        yield float(high + max(abs(high), 1.0))


OUTSIDE = [
    (name, key, f"{value!r} {p.unit}" if p.unit else repr(value))
    for name, key, p in declared()
    if p.unit != "bool" and not p.choices
    for value in beyond(p)
]
ALONE = BASE[: BASE.index("    detection:")] + "    NAME: {KEY: VALUE}\n"


@pytest.mark.parametrize(("name", "key", "value"), OUTSIDE)
def test_a_value_that_is_not_possible_names_effect_parameter_and_line(name: str, key: str, value: str) -> None:
    """A probability above 1, a lifetime of nothing, ...: whatever the effects declare."""
    text = ALONE.replace("NAME", name).replace("KEY", key).replace("VALUE", value)
    found = [p for p in mistakes(text) if p.startswith(f"lab.yaml:23: sensor.effects.{name}.{key}: {value} is not")]
    assert len(found) == 1 and f"{key} is " in found[0]


def test_there_are_such_values() -> None:
    assert len(OUTSIDE) > 5 and any(value.startswith("2.0") for _, _, value in OUTSIDE)


@pytest.mark.parametrize(("name", "key"), [(name, key) for name, key, p in declared() if p.per])
def test_a_map_of_no_shape_at_all_names_effect_parameter_and_file(name: str, key: str, tmp_path: Path) -> None:
    np.save(tmp_path / "map.npy", np.ones((3, 5, 7)))
    text = ALONE.replace("NAME", name).replace("KEY", key).replace("VALUE", "{file: map.npy}")
    found = [p for p in mistakes(text, tmp_path) if f"sensor.effects.{name}.{key}: {tmp_path / 'map.npy'}" in p]
    assert len(found) == 1 and "(3, 5, 7)" in found[0]


@pytest.mark.parametrize(("name", "key", "word"), [(n, k, w) for n, k, p in declared() for w in p.choices])
def test_words_are_read_and_resolved(name: str, key: str, word: str) -> None:
    text = ALONE.replace("NAME", name).replace("KEY", key)
    experiment = build(text.replace("VALUE", word))
    assert experiment.resolved["sensor"]["effects"][name][key] == word
    again = build(document.dump(experiment.resolved))
    assert getattr(again.sensor.effect(name), key) == word
    (problem,) = mistakes(text.replace("VALUE", word[:-1] + "_"))
    assert problem.endswith(f"Did you mean {word}?") and f"sensor.effects.{name}.{key}: " in problem


@pytest.mark.parametrize("name", list(Effect.registry))
def test_the_defaults_of_an_effect_are_resolved_to_what_they_are(name: str) -> None:
    kind = Effect.registry.find(name)
    if any(p.required for p in kind.parameters.values()):
        pytest.skip("it has values without a default")
    first = build(ALONE.replace("{KEY: VALUE}", "{}").replace("NAME", name))
    again = build(document.dump(first.resolved))
    for key, parameter in kind.parameters.items():
        assert getattr(again.sensor.effect(name), key) == parameter.default
    assert again.resolved == first.resolved


def test_several_bad_maps_are_told_at_once(maps: Path) -> None:
    text = BASE.replace(RATE, "rate: {file: nan.npy}").replace("50 ns}", "{file: missing.npy}}")
    assert len(mistakes(text, maps)) == 2


# --- distributions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "form",
    [
        "{normal: {mean: 100 Hz, sigma: 0 Hz}}",
        "{lognormal: {median: 0.1 kHz, sigma: 0}}",
        "{mixture: [{share: 97 %, normal: {mean: 100 Hz, sigma: 0 Hz}}, "
        "{share: 3 %, lognormal: {median: 100 Hz, sigma: 0}}]}",
    ],
)
def test_a_distribution_without_a_width_is_its_centre(form: str) -> None:
    effect: Any = build(changed(RATE, f"rate: {form}")[0]).sensor.effect("dark_counts")
    assert effect.rate.shape == (784,) and np.allclose(effect.rate, 100.0, rtol=1e-15)


def test_a_distribution_is_drawn_from_the_chip_seed() -> None:
    form = "rate: {lognormal: {median: 20 Hz, sigma: 2.27}}"

    def rates(text: str) -> np.ndarray:
        effect: Any = build(text).sensor.effect("dark_counts")
        return effect.rate

    text = changed(RATE, form)[0]
    one = rates(text)
    assert len(np.unique(one)) == 784 and one.min() > 0
    assert np.array_equal(one, rates(text.replace("seed: 1\nscene", "seed: 2\nscene")))  # the chip is the same
    assert np.array_equal(one, rates(text.replace("    tdc: {resolution: 10 ps}\n", "")))
    assert not np.array_equal(one, rates(text.replace("chip_seed: 1", "chip_seed: 2")))


def test_what_is_drawn_stays_within_bounds() -> None:
    effect: Any = build(changed("pdp: 0.5", "pdp: {normal: {mean: 0.5, sigma: 2}}")[0]).sensor.effect("detection")
    assert effect.pdp.min() == 0.0 and effect.pdp.max() == 1.0


def test_a_distribution_beyond_all_numbers_is_refused() -> None:
    text, line = changed(RATE, "rate: {lognormal: {median: 20 Hz, sigma: 1000}}")
    (problem,) = mistakes(text)
    assert problem.startswith(f"lab.yaml:{line}: sensor.effects.dark_counts.rate")


# --- what is allowed -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("output: {format: zarr}\n", ""),
        ("  wavelength: 555 nm\n", ""),
        ("reconstruct: [counts, qis_linear]\n", ""),
        ("[counts, qis_linear]", "[]"),
        ("  frame_period: 10 us\n", ""),
        ("  chip_seed: 1\n", ""),
        ("    fill_factor: 1.0\n", ""),
        ("fill_factor: 1.0", "fill_factor: 13 %"),
        ("{duration: 50 ns}", ""),
        ("{duration: 50 ns}", "{}"),
        (EFFECTS, "  effects: {}\n"),
        ("pdp: 0.5", "pdp: {555 nm: 0.4}"),
        ("pdp: 0.5", "pdp: {700 nm: 0.2, 500 nm: 0.4}"),
        ("    tdc: {resolution: 10 ps}\n", ""),
        ("10 ps", "0 s"),
        ("frame_time: 10 us", "frame_time: 9 us"),
    ],
)
def test_what_may_be_left_out_or_written_otherwise(old: str, new: str) -> None:
    build(changed(old, new)[0])


def test_str_without_a_converter_is_exact() -> None:
    experiment = build(changed("    tdc: {resolution: 10 ps}\n", "")[0])
    splits = experiment.load_images()
    recorded = experiment.simulate(experiment.level("2560 mlux"), "train", splits["train"], 0, 2)
    assert recorded.tr is not None and recorded.tr.ticks is None and recorded.tr.tick is None
    assert recorded.frames is not None
    stamps = recorded.frames.stamps()
    assert ((stamps < 10e-6) == recorded.frames.unpacked()).all()
    assert experiment.settings.tick == 0.0


def test_a_table_is_interpolated() -> None:
    text = changed("pdp: 0.5", "pdp: {700 nm: 0.2, 500 nm: 0.4}")[0]
    assert build(text).settings.pdp == pytest.approx(0.4 - 0.2 * 55 / 200)


def test_light_that_is_not_green_is_noted() -> None:
    (note,) = build(changed("555 nm", "500 nm")[0]).notes
    assert note.startswith("lab.yaml:4: scene.wavelength") and "683" in note and "irradiance" in note
    assert build(BASE).notes == ()


def test_levels_are_found_in_any_spelling() -> None:
    experiment = build(BASE)
    assert experiment.level("0.005 lux") is experiment.levels[0]
    assert experiment.levels[0].key == build(changed("5 mlux", "0.005 lux")[0]).levels[0].key
    with pytest.raises(KeyError, match="5 mlux, 2560 mlux"):
        experiment.level("6 mlux")


def test_white_is_the_level() -> None:
    experiment = build(BASE)
    assert experiment.white(experiment.levels[1]) == photons_from_lux(2.56, 25e-12, 555e-9)
    assert experiment.white(experiment.levels[1]) == pytest.approx(2.618e5, rel=1e-4)
    grey = experiment.photons(experiment.levels[1], np.array([[[0, 51, 255]]], np.uint8), 255.0)
    assert grey.ravel() == pytest.approx(experiment.white(experiment.levels[1]) * np.array([0, 0.2, 1]), rel=1e-15)
    radiometric = build(changed("lux: [5 mlux, 2560 mlux]", "irradiance: [120 nW/cm^2]")[0])
    assert radiometric.white(radiometric.levels[0]) == photons_from_irradiance(1.2e-3, 25e-12, 555e-9)


def test_too_much_light_is_refused_with_what_to_do() -> None:
    experiment = build(changed("2560 mlux]", "1e15 lux]")[0])
    with pytest.raises(InputError, match=r"lab\.yaml: .*1e15 lux.* events .*lower the light"):
        experiment.check_volume(0.1, 1)


# --- a sensor in a file of its own ---------------------------------------------------------------------------------


def sensor_file(folder: Path, text: str, wrapped: bool = True) -> str:
    """A config that names a sensor file with this text in its own folder."""
    (folder / "sensors").mkdir(exist_ok=True)
    lines = text.splitlines()
    if not wrapped:
        lines = [line[2:] for line in lines[1:]]
    (folder / "sensors" / "lab.yaml").write_text("\n".join(lines) + "\n")
    return BASE.replace(SENSOR, "sensor: sensors/lab.yaml\n")


@pytest.mark.parametrize("wrapped", [True, False])
def test_a_sensor_file_is_the_same_sensor(wrapped: bool, tmp_path: Path) -> None:
    assert build(sensor_file(tmp_path, SENSOR, wrapped), tmp_path).resolved == build(BASE).resolved


@pytest.mark.parametrize("wrapped", [True, False])
def test_a_mistake_in_a_sensor_file_is_placed_in_that_file(wrapped: bool, tmp_path: Path) -> None:
    text = SENSOR.replace("duration: 50 ns", "duration: 50").replace("rows: 28", "rows: 0")
    config_text = sensor_file(tmp_path, text, wrapped).replace("seed: 1", "seed: -1")
    found = mistakes(config_text, tmp_path)
    first = 1 if wrapped else 0
    file = tmp_path / "sensors" / "lab.yaml"
    prefix = "sensor." if wrapped else ""
    assert sorted(p.split(" ")[0] + " " + p.split(" ")[1] for p in found) == sorted(
        [
            "lab.yaml:1: seed:",
            f"{file}:{first + 5}: {prefix}layout.rows:",
            f"{file}:{first + 13}: {prefix}effects.dead_time.duration:",
        ]
    )


def test_sensor_files_that_cannot_be_used(tmp_path: Path) -> None:
    text = BASE.replace(SENSOR, "sensor: sensors/lab.yaml\n")
    (problem,) = mistakes(text, tmp_path)
    assert problem.startswith("lab.yaml:13: sensor: ") and "sensors/lab.yaml: no such file" in problem
    sensor_file(tmp_path, SENSOR.replace("rows: 28", "rows: 28\n    rows: 28"))
    (problem,) = mistakes(text, tmp_path)
    assert "sensors/lab.yaml:7: rows" in problem
    sensor_file(tmp_path, SENSOR + "seed: 1")
    (problem,) = mistakes(text, tmp_path)
    assert "seed" in problem and "sensors/lab.yaml:16" in problem
    (tmp_path / "sensors" / "lab.yaml").write_text("5\n")
    (problem,) = mistakes(text, tmp_path)
    assert "sensors/lab.yaml" in problem


def test_the_map_of_a_sensor_file_lies_beside_it(tmp_path: Path) -> None:
    text = sensor_file(tmp_path, SENSOR.replace(RATE, "rate: {file: dcr.npy}"))
    np.save(tmp_path / "sensors" / "dcr.npy", np.arange(784.0))
    effect: Any = build(text, tmp_path).sensor.effect("dark_counts")
    assert np.array_equal(effect.rate, np.arange(784.0))


def test_a_mistake_that_a_map_shows_is_placed_in_the_sensor_file(tmp_path: Path) -> None:
    text = sensor_file(tmp_path, SENSOR.replace(RATE, "rate: {file: dcr.npy}"))
    (problem,) = mistakes(text, tmp_path)
    assert problem.startswith(f"{tmp_path / 'sensors' / 'lab.yaml'}:12: sensor.effects.dark_counts.rate")


# --- the shipped configs -------------------------------------------------------------------------------------------


def without_base(experiment: config.Experiment) -> dict[str, Any]:
    fields = {f.name: getattr(experiment, f.name) for f in dataclasses.fields(experiment)}
    for name in ("name", "base", "sensor", "_photons"):
        del fields[name]
    return fields


@pytest.mark.parametrize("name", SHIPPED)
def test_the_resolved_config_is_the_same_experiment(name: str, tmp_path: Path) -> None:
    first = config.read(ROOT / "configs" / name)
    for file in (ROOT / "configs").glob("*.csv"):
        shutil.copy(file, tmp_path)  # of positions
    text = document.dump(first.resolved)
    again = config.build(document.parse(text, "again.yaml"), tmp_path)
    assert again.resolved == first.resolved and document.dump(again.resolved) == text
    assert without_base(again) == without_base(first)
    one, other = first.sensor, again.sensor
    assert (one.layout, one.rules, one.chip_seed, one.name) == (other.layout, other.rules, other.chip_seed, other.name)
    assert np.array_equal(one.layout.places, other.layout.places)
    assert np.array_equal(one.layout.places, other.layout.places)
    assert [type(e) for e in one.effects] == [type(e) for e in other.effects]
    for mine, theirs in zip(one.effects, other.effects, strict=True):
        for key in mine.parameters:
            a, b = getattr(mine, key), getattr(theirs, key)
            assert type(a) is type(b) and np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b


@pytest.mark.parametrize("format_", ["zarr", "hdf5"])
def test_what_the_command_line_changes_is_resolved(format_: str) -> None:
    experiment = config.read(
        ROOT / "configs" / "quick.yaml", seed=9, format=format_, lux=("2.56 lux", "5 mlux"), limit=3
    )
    assert experiment.resolved["seed"] == 9 and experiment.resolved["limit"] == 3
    assert experiment.resolved["output"]["format"] == format_
    assert experiment.resolved["scene"]["lux"] == ["5 mlux", "2560 mlux"]
    with pytest.raises(ConfigError, match=r"--lux: '7 mlux' .* 5 mlux, 20 mlux, 160 mlux, 2560 mlux"):
        config.read(ROOT / "configs" / "quick.yaml", lux=("7 mlux",))


def test_quick_is_the_sensor_of_the_paper_and_stands_in_one_file() -> None:
    quick, full = (config.read(ROOT / "configs" / n).resolved for n in ("quick.yaml", "spad_mnist.yaml"))
    for part in ("sensor", "recording", "reconstruct", "output"):
        assert quick[part] == full[part]
    assert full["scene"]["lux"] == [f"{5 * 2**i} mlux" for i in range(10)]
    assert full["sensor"]["effects"] == {
        "detection": {"pdp": 0.5, "relative": 1.0},
        "dark_counts": {"rate": "100 Hz"},
        "afterpulsing": {"probability": "0.5 %", "lifetime": "25 ns"},
        "dead_time": {"duration": "50 ns", "paralyzable": False},
        "tdc": {"resolution": "10 ps", "rounding": "nearest"},
    }


def uncommented(lines: list[str]) -> Iterator[str]:
    """Lines with a number and no comment: on them, on the line above, or so on what they stand below."""
    above: list[tuple[int, bool]] = []  # (indent, has a comment) of the entries around the line
    before = ""
    for number, line in enumerate(lines, 1):
        content, _, comment = line.partition("#")
        if content.strip() and not content.lstrip().startswith("name:"):
            indent = len(content) - len(content.lstrip())
            above = [entry for entry in above if entry[0] < indent]
            above.append((indent, bool(comment) or before.startswith("#")))
            if re.search(r"\d", content) and not any(commented for _, commented in above):
                yield f"{number}: {line}"
        before = line.strip()


@pytest.mark.parametrize("name", FILES)
def test_every_number_has_a_comment(name: str) -> None:
    assert not list(uncommented((ROOT / "configs" / name).read_text().splitlines()))


def paper_numbers() -> ModuleType:
    spec = importlib.util.spec_from_file_location("paper_numbers", ROOT / "scripts" / "paper_numbers.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def shipped(name: str) -> dict[str, Any]:
    return config.read(ROOT / "configs" / name).resolved


def as_written(solved: float, text: str) -> bool:
    """Is `solved` (W/m^2) what `text` (nW/cm^2) says, to the digits it gives?"""
    digits = len(text.partition(".")[2])
    return f"{solved / 1e-5:.{digits}f}" == text


def test_the_irradiances_are_solved_from_the_paper_s_means() -> None:
    numbers = paper_numbers()
    comments = {n: (ROOT / "configs" / n).read_text() for n in ("spad23.yaml", "spad512.yaml")}
    small = shipped("spad23.yaml")
    parts = small["sensor"]["effects"]["dark_counts"]["rate"]["mixture"]
    dark = sum(
        p["share"] * units.parse(p["lognormal"]["median"], "Hz") * np.exp(p["lognormal"]["sigma"] ** 2 / 2)
        for p in parts
    )
    for mean, wavelength, pde in ((17.0e3, 500e-9, 0.422), (2.27e3, 700e-9, 0.162)):
        solved = numbers.spad23(mean, wavelength, pde, dark)
        text = f"{solved / 1e-5:.3f}"
        assert text in comments["spad23.yaml"]
    (level,) = small["scene"]["irradiance"]
    assert as_written(numbers.spad23(17.0e3, 500e-9, 0.422, dark), level.removesuffix(" nW/cm^2"))
    (level,) = shipped("spad512.yaml")["scene"]["irradiance"]
    assert as_written(numbers.spad512(457, 500e-9, 0.444, 1e-6), level.removesuffix(" nW/cm^2"))
    for mean, wavelength, pdp, time, text in (
        (60, 700e-9, 0.207, 1e-6, "21.93"),
        (9740, 500e-9, 0.444, 10e-6, "906.5"),
        (4184, 700e-9, 0.207, 10e-6, "205.5"),
    ):
        assert as_written(numbers.spad512(mean, wavelength, pdp, time), text) and text in comments["spad512.yaml"]


def test_the_sensors_expect_the_paper_s_means() -> None:
    """From the configs alone, with the chip that they draw: within the scatter of its pixels' dark counts."""
    experiment = config.read(ROOT / "configs" / "spad512.yaml")
    photons = np.full((1, experiment.sensor.layout.pixels), experiment.white(experiment.levels[0]))
    rate, _ = experiment.sensor.rates(photons, experiment.conditions)
    ones = -np.expm1(-rate * experiment.conditions.frame_time)
    scatter = 10_000 * ones.std() / 512
    assert abs(10_000 * ones.mean() - 457) < 4.9 * scatter  # false-alarm rate 1e-6
    small = config.read(ROOT / "configs" / "spad23.yaml")
    photons = np.full((1, 23), small.white(small.levels[0]))
    _, recorded = small.sensor.expected(photons, small.conditions)
    hot = np.sort(recorded.ravel() / 0.1)
    assert np.median(hot) == pytest.approx(17.0e3, rel=0.02) and hot[-1] > hot[-2] + 1000


@pytest.mark.parametrize(
    ("name", "mean"), [("spad512_700nm_low", 54.9), ("spad512_500nm_high", 9920), ("spad512_700nm_high", 4100)]
)
def test_what_the_printed_levels_of_the_spad512_give(name: str, mean: float) -> None:
    """The mean count of 10,000 frames, from the config alone, within the scatter of the chip's dark counts."""
    experiment = config.read(ROOT / "configs" / f"{name}.yaml")
    assert experiment.sensor.layout.shape == (512, 512) and experiment.resolved["sensor"] == sensor_of("spad512.yaml")
    photons = np.full((1, experiment.sensor.layout.pixels), experiment.white(experiment.levels[0]))
    rate, _ = experiment.sensor.rates(photons, experiment.conditions)
    ones = -np.expm1(-rate * experiment.conditions.frame_time)
    rounded = 0.5 * 10.0 ** np.floor(np.log10(mean) - 2 if mean < 100 else 0)  # half a unit of the last digit
    assert experiment.conditions.frames == 10_000
    assert abs(10_000 * ones.mean() - mean) < rounded + 4.9 * 10_000 * ones.std() / 512  # false-alarm rate 1e-6
    assert f"{mean:g}" in (ROOT / "configs" / f"{name}.yaml").read_text()


def test_what_the_printed_level_of_the_spad23_gives() -> None:
    """2.27 kcps, with the mean of the mixture that its dark counts are drawn from."""
    experiment = config.read(ROOT / "configs" / "spad23_700nm.yaml")
    assert experiment.resolved["sensor"] == sensor_of("spad23.yaml") and len(experiment.levels) == 1
    detected = experiment.white(experiment.levels[0]) * experiment.sensor.nominal_pdp(700e-9)
    dark = 0.957 * 40 * np.exp(0.5**2 / 2) + 0.043 * 3000 * np.exp(0.3**2 / 2)
    assert (detected + dark) / 1e3 == pytest.approx(2.27, abs=0.005)


def sensor_of(name: str) -> Any:
    return shipped(name)["sensor"]


def test_numbers_of_the_configs_stand_in_no_code() -> None:
    """The solved numbers are worked out by the script, not written down in it."""
    with open(ROOT / "scripts" / "paper_numbers.py", "rb") as file:
        numbers = {t.string for t in tokenize.tokenize(file.readline) if t.type == tokenize.NUMBER}
    assert not numbers & {"3.457", "115.62", "21.93", "906.5", "205.5", "0.799"}
