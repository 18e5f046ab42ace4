"""Set-up against sensor: totals that the laboratory explains, and what the paper's own means say."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import spadmnist as sp
from spadmnist import cli, config, sensor_file, twin
from spadmnist import measurement as measurements
from spadmnist.cli import comparing
from spadmnist.effects import BackgroundLight
from spadmnist.errors import InputError
from spadmnist.inference import setups
from spadmnist.inference.closed_forms import closed_form
from spadmnist.inference.comparison import compare
from spadmnist.inference.light_checks import ratios_between_wavelengths
from spadmnist.inference.model_selection import diagnose
from spadmnist.inference.models import InTheDark
from spadmnist.inference.replicates import Execution, Replicates
from spadmnist.inference.results import NONLINEARITY, sentence, table
from spadmnist.measurement import Measurement
from spadmnist.sensor import Sensor
from spadmnist.workers import Serial

SENSOR = """sensor:
  name: SPAD512
  rules: paper
  layout: {rows: 16, columns: 16, pixel_area: 276.923 um^2, fill_factor: 0.13}
  effects:
    detection: {pdp: {500 nm: 0.444, 700 nm: 0.207}}
    dark_counts: {rate: 265 Hz}
"""

CAPTURE = (
    "  - {{id: {id}, modality: qis, light: {light}, frames: 10000, frame_time: {t}, frame_period: {t}, mean: {mean}}}\n"
)
LIGHT = "{{kind: flat, wavelength: {wave}, irradiance: {level} nW/cm^2, relative_uncertainty: {error}}}"


def measured(folder: Path, means: dict[str, tuple[str, float | None, str, float]], error: float = 0.015) -> Measurement:
    """means: by id, (wavelength, nW/cm^2 or None in the dark, frame time, mean)."""
    folder.mkdir(exist_ok=True)
    text = "format: spadmnist-measurement/1\nname: means\nlayout: {rows: 16, columns: 16}\ncaptures:\n"
    for id, (wave, level, t, mean) in means.items():
        light = "{kind: dark}" if level is None else LIGHT.format(wave=wave, level=level, error=error)
        text += CAPTURE.format(id=id, light=light, t=t, mean=mean)
    (folder / "measurement.yaml").write_text(text)
    (folder / "sensor.yaml").write_text(SENSOR)
    return measurements.open(folder)


# Levels at which this sensor has the means that the paper simulated (457, 60, 9740, 4184): the means that it measured
# are 470, 62, 9715 and 4011. Suonsivu et al., captions of the SPAD512 figures.
PAPER = {
    "dark": ("", None, "1 us", 2.6),
    "low-500": ("500 nm", 115.7, "1 us", 470),
    "low-700": ("700 nm", 21.95, "1 us", 62),
    "high-500": ("500 nm", 906.6, "10 us", 9715),
    "high-700": ("700 nm", 205.4, "10 us", 4011),
}


def test_the_papers_means_are_a_matter_of_the_set_up(tmp_path):
    data = measured(tmp_path, PAPER)
    sensor = config.read_sensor(tmp_path / "sensor.yaml")
    assert compare(sensor, data, jobs=1).verdict == "fails"
    found = diagnose(sensor, data, quick=True, jobs=1)
    assert found.verdict == "setup" and not found.steps
    # opposite signs at low and high light: light or exposure, which these captures cannot tell apart
    assert {e["quantity"] for e in found.setup} == {"light", "exposure"} and all(e["confused"] for e in found.setup)
    factors = {e["capture"]: e["factor"]["value"] for e in found.setup}
    low = [f for id, f in factors.items() if id.startswith("low")] or [1.0]
    high = [f for id, f in factors.items() if id.startswith("high")] or [1.0]
    assert max(high) < min(low)
    # the same light with the other frame time would tell
    (wanted,) = found.advice
    assert wanted["separates"] == ["light", "exposure"] and "frame time of" in wanted["capture"]
    assert wanted["significance_then"] > 5 > wanted["significance_now"]


def test_means_that_the_model_has_are_adequate(tmp_path):
    means = {"low-500": 457, "low-700": 60, "high-500": 9740, "high-700": 4184, "dark": 2.65}
    data = measured(tmp_path, {id: (*PAPER[id][:3], mean) for id, mean in means.items()})
    sensor = config.read_sensor(tmp_path / "sensor.yaml")
    assert compare(sensor, data, jobs=1).verdict == "adequate"
    assert diagnose(sensor, data, quick=True, jobs=1).verdict == "adequate"


def test_a_light_level_that_is_near_that_of_another_wavelength_is_none(tmp_path):
    """Three quarters of the light: at 700 nm it would give 0.653, and 5 % of uncertainty are no reason to name that."""
    means = {id: (*PAPER[id][:3], mean) for id, mean in {"low-500": 457, "low-700": 60, "high-700": 4184}.items()}
    means["high-500"] = (PAPER["high-500"][0], 200.0, "10 us", 0.0)
    right = measured(tmp_path, means)
    sensor = config.read_sensor(tmp_path / "sensor.yaml")
    expected = closed_form(sensor, right.capture("high-500"))
    level = twin.photons_at(right.capture("high-500"), sensor.layout)
    means["high-500"] = (*means["high-500"][:3], round(expected(0.75 * level) / 256, 1))
    found = diagnose(sensor, measured(tmp_path, {"dark": PAPER["dark"], **means}, 0.05), quick=True, jobs=1)
    named = {e["quantity"] for e in found.setup if e["capture"] == "high-500"}
    assert named == {"light", "exposure"} and all(e["confused"] for e in found.setup), found.setup


@pytest.mark.parametrize("factor", [1.08, 0.92])
def test_a_light_level_beyond_its_uncertainty_is_no_pdp(tmp_path, factor):
    means = {id: (*PAPER[id][:3], mean) for id, mean in {"low-500": 457, "low-700": 60, "high-700": 4184}.items()}
    scaled = {id: (wave, level / factor, t, mean) for id, (wave, level, t, mean) in means.items()}
    data = measured(tmp_path, {"dark": PAPER["dark"], **scaled})
    found = diagnose(config.read_sensor(tmp_path / "sensor.yaml"), data, quick=True, jobs=1)
    assert found.verdict in ("setup", "confused")  # a dark capture of 2.6 counts hardly tells a shorter gate
    named = [e for e in found.setup if e["quantity"] == "light"]
    assert len(named) == 3 and all(e["factor"]["value"] == pytest.approx(factor, rel=0.03) for e in named)
    assert not any(s.candidate.effect == "detection" for s in found.steps)


def test_a_capture_at_another_wavelength_is_named(tmp_path):
    # 700 nm noted, 500 nm in truth: more detections by what the photons' energy and the PDP do
    ratio = (500 / 700) * 0.444 / 0.207
    means = {
        "dark": PAPER["dark"],
        "low-500": ("500 nm", 115.7, "1 us", 457),
        "high-500": ("500 nm", 906.6, "10 us", 9740),
    }
    means["low-700"] = ("700 nm", 21.95 / ratio, "1 us", 60)
    data = measured(tmp_path, means)
    found = diagnose(config.read_sensor(tmp_path / "sensor.yaml"), data, quick=True, jobs=1)
    assert found.verdict == "setup"
    (entry,) = found.setup
    assert (entry["capture"], entry["quantity"], entry["confused"]) == ("low-700", "wavelength", False)
    assert entry["factor"]["low"] < ratio < entry["factor"]["high"]


@pytest.mark.parametrize(("odd", "mean", "verdict"), [("high-500", 9626, "confused"), ("low-500", 423, "setup")])
def test_the_brightest_capture_alone_may_be_a_nonlinearity(tmp_path, odd, mean, verdict):
    """A mistake at any other level is the laboratory's: no sensor answers less at a level between two others."""
    means = {"low-500": 457, "low-700": 60, "high-500": 9740, "high-700": 4184, "dark": 2.65, odd: mean}
    data = measured(tmp_path, {id: (*PAPER[id][:3], mean) for id, mean in means.items()})
    found = diagnose(config.read_sensor(tmp_path / "sensor.yaml"), data, quick=True, jobs=1)
    assert found.verdict == verdict and not found.steps
    assert {e["capture"] for e in found.setup} == {odd}
    doubted = [a for a in found.advice if NONLINEARITY in a["separates"]]
    assert bool(doubted) == bool(found.unexplained) == (verdict == "confused")
    assert (NONLINEARITY in table(found)) == (verdict == "confused")
    assert all(odd in a["capture"] and a["significance_then"] > a["significance_now"] for a in doubted)


TR = """sensor:
  name: small
  rules: device
  layout: {rows: 8, columns: 8, pixel_area: 25 um^2, fill_factor: 1.0}
  effects:
    detection: {pdp: 0.42}
    dark_counts: {rate: 100 Hz}
    dead_time: {duration: 50 ns}
    tdc: {resolution: 100 ps}
"""

LAB = """format: spadmnist-measurement/1
name: lab
layout: {rows: 8, columns: 8}
captures:
  - {id: dark, file: dark.h5, modality: tr, light: {kind: dark}, exposure: 1 s}
  - {id: dim, file: dim.h5, modality: tr, exposure: 400 ms,
     light: {kind: flat, wavelength: 500 nm, irradiance: 0.8 nW/cm^2, relative_uncertainty: 0.02}}
  - {id: flat, file: flat.h5, modality: tr, exposure: 20 ms,
     light: {kind: flat, wavelength: 500 nm, irradiance: 20 nW/cm^2, relative_uncertainty: 0.02}}
"""


def lab(folder: Path, extra: str = "", plan: str = LAB, seed: int = 0) -> Measurement:
    """A measurement of the small sensor with an effect more, made from a plan without any file."""
    from spadmnist import twin

    folder.mkdir(exist_ok=True)
    (folder / "plan.yaml").write_text(plan)
    (folder / "sensor.yaml").write_text(TR)
    (folder / "truth.yaml").write_text(TR + extra)
    plan_ = measurements.open(folder / "plan.yaml", planned=True)
    return measurements.open(twin.simulate(config.read_sensor(folder / "truth.yaml"), plan_, folder / "lab", seed))


def with_background(folder: Path) -> tuple[Sensor, Measurement]:
    """Means of a sensor with background light, of which the level of the brightest capture is wrong by 8 %."""
    (folder / "sensor.yaml").write_text(SENSOR)
    sensor = config.read_sensor(folder / "sensor.yaml")
    real = sensor.changed(effects=[*sensor.effects, BackgroundLight(rate=300.0)]).resolved()
    levels = {"dark": None, "low": 11.0, "mid": 115.7, "middle": 300.0, "high": 600.0}
    plan = measured(folder / "plan", {id: ("500 nm", level, "1 us", 1.0) for id, level in levels.items()})
    means = {}
    for capture in plan.captures:
        photons = twin.photons_at(capture, sensor.layout) or 1.0  # the dark level is a factor
        model = InTheDark.of(real) if capture.light.dark else real
        mean = closed_form(model, capture)(photons * (1.08 if capture.id == "high" else 1.0)) / 256
        means[capture.id] = ("500 nm", levels[capture.id], "1 us", mean)
    return sensor, measured(folder / "data", means)


def test_background_light_beside_one_wrong_level_is_a_tie_with_two_wrong_levels(tmp_path):
    """Neither a change of the sensor nor one level explains the totals: two numbers do, and these are two pairs."""
    found = diagnose(*with_background(tmp_path), quick=True, jobs=1)
    assert found.verdict == "confused"
    assert [step.candidate.name for step in found.steps] == ["add background_light"]
    assert [other["what"] for other in found.steps[0].alternatives] == ["the set-up of low and high"]
    assert "the sensor file does not have it" in found.steps[0].material
    value = found.steps[0].values["rate"]
    assert value.value == pytest.approx(300, rel=0.5)
    assert {e["capture"] for e in found.setup} == {"low", "high"} and all(e["confused"] for e in found.setup)
    said = "the set-up of low and high, or background_light with the set-up of high: each explains the totals"
    assert sentence(found).startswith(said)


def test_a_change_that_needs_the_set_up_is_a_tie_however_well_it_fits(tmp_path, monkeypatch):
    """Of itself it does not explain the totals: it cannot hide that a level is wrong."""
    known = setups.rivals_with_a_factor

    def fitting(*given):
        out = known(*given)
        for rival, _ in out:
            rival.cost = lambda evaluation: -1e3
        return out

    monkeypatch.setattr(setups, "rivals_with_a_factor", fitting)
    found = diagnose(*with_background(tmp_path), quick=True, jobs=1)
    assert found.verdict == "confused" and {e["capture"] for e in found.setup} == {"low", "high"}
    assert [step.candidate.name for step in found.steps] == ["add background_light"]


@pytest.mark.slow
def test_a_capture_that_stopped_early_is_told_with_its_length(tmp_path):
    data = lab(tmp_path, plan=LAB.replace("400 ms", "360 ms"))
    text = (tmp_path / "lab" / "measurement.yaml").read_text()
    assert "360 ms" in text
    (tmp_path / "lab" / "measurement.yaml").write_text(text.replace("360 ms", "400 ms"))
    data = measurements.open(tmp_path / "lab")
    found = diagnose(config.read_sensor(tmp_path / "sensor.yaml"), data, quick=True, jobs=1)
    assert found.verdict == "setup"
    (entry,) = found.setup
    assert (entry["capture"], entry["quantity"]) == ("dim", "exposure")
    assert entry["factor"]["low"] <= 0.9 <= entry["factor"]["high"]


@pytest.mark.slow
@pytest.mark.long
def test_what_swings_is_found_with_its_frequency_and_its_phases(tmp_path):
    data = lab(tmp_path, "    flicker: {amplitude: 0.4, frequency: 120 Hz, phase: 1 rad}\n")
    sensor = config.read_sensor(tmp_path / "sensor.yaml")
    assert compare(sensor, data, jobs=1, replicates=48).verdict == "fails"
    found = diagnose(sensor, data, quick=True, jobs=1)
    assert [s.candidate.name for s in found.steps] == ["add flicker"] and found.verdict == "explained"
    values = found.steps[0].values
    assert values["amplitude"].value == pytest.approx(0.4, rel=0.15)
    assert values["frequency"].low < 120 < values["frequency"].high


@pytest.mark.slow
def test_a_model_that_swings_is_not_wrong_for_its_phase(tmp_path):
    """Nobody knows where a lamp's phase is when a capture begins."""
    data = lab(tmp_path, "    flicker: {amplitude: 0.4, frequency: 120 Hz, phase: 2.5 rad}\n")
    other = TR + "    flicker: {amplitude: 0.4, frequency: 120 Hz}\n"
    (tmp_path / "other.yaml").write_text(other)
    sensor = config.read_sensor(tmp_path / "other.yaml")
    assert compare(sensor, data, jobs=1, replicates=64).verdict == "adequate"


def test_pixels_that_differ_at_one_wavelength_alone(tmp_path):
    """The ratio of the maps tells, and only where there are two wavelengths."""
    data = lab(tmp_path)
    sensor = config.read_sensor(tmp_path / "sensor.yaml")
    known = compare(sensor, data, jobs=1, replicates=32)
    assert not [c for c in known.checks if c.statistic == "wavelength_ratio"]
    (map_,) = [c for c in known.checks if c.statistic == "pixel_map" and c.capture == "flat"]
    (dim,) = [c for c in known.checks if c.statistic == "pixel_map" and c.capture == "dim"]
    captures = [c for c in data.captures if c.id != "dark"]
    red = replace(captures[0], light=replace(captures[0].light, wavelength=700e-9))
    rng = np.random.default_rng(5)
    own = {(c.id, "pixel_map"): rng.standard_normal((96, 64)) for c in captures}
    (check,) = ratios_between_wavelengths([red, captures[1]], [map_, dim], own)
    assert check.p_value > 1e-3
    shifted = replace(dim.judgement, residuals=dim.judgement.residuals + np.where(np.arange(64) == 17, 8.0, 0.0))
    other = replace(dim, judgement=shifted)
    (check,) = ratios_between_wavelengths([red, captures[1]], [map_, other], own)
    assert check.p_value < 1e-6 and "row 2, column 1" in check.where
    # a pixel of which hardly anything is expected is left out, and the others are compared all the same
    expected = np.where(np.arange(64) == 40, 0.0, map_.judgement.expected)
    dead = replace(map_, judgement=replace(map_.judgement, expected=expected))
    (check,) = ratios_between_wavelengths([red, captures[1]], [dead, other], own)
    assert check.p_value < 1e-6 and "row 2, column 1" in check.where
    # where the pixels of a right model scatter unequally, the largest is judged by theirs
    wide = np.where(np.arange(64) < 4, 4.0, 1.0)
    ps = []
    for _ in range(40):
        drawn = [
            replace(c, judgement=replace(c.judgement, residuals=wide * rng.standard_normal(64))) for c in (map_, dim)
        ]
        unequal = {key: wide * rng.standard_normal((96, 64)) for key in own}
        ps += [one.p_value for one in ratios_between_wavelengths([red, captures[1]], drawn, unequal)]
    # a sum of four squares has more of a tail than the gamma law: more than 5 of 40 would be a wrong law
    assert np.sum(np.array(ps) < 1e-3) <= 5, np.sort(ps)[:6]


def test_a_spread_of_the_pixels_alike_at_both_wavelengths_leaves_their_ratio() -> None:
    """Of frames that are full at one of them: what is in proportion are the rates, not the detections."""
    layout = sp.Layout(16, 16, 25e-12, 1.0)
    pdp = sp.effects.ByWavelength((500e-9, 700e-9), (0.4, 0.2))
    model = sp.Sensor(layout, [sp.effects.Detection(pdp=pdp)], rules="device")
    spread = 1 + 0.05 * np.random.default_rng(4).standard_normal(256)
    truth = model.with_values({"detection.relative": spread})
    photon = 6.62607015e-34 * 299792458.0
    plan = [
        sp.Capture(
            name,
            "qis",
            wavelength=wave,
            frames=6000,
            frame_time=10e-6,
            irradiance=events / 10e-6 / q * photon / wave / layout.pixel_area,
        )
        for name, wave, q, events in (("green", 500e-9, 0.4, 2.3), ("red", 700e-9, 0.2, 0.36))
    ]
    found = compare(model, sp.simulate(truth, plan, seed=1), jobs=1, replicates=48)
    checks = {c.statistic: c.p_value for c in found.checks if c.capture in (None, "green")}
    assert checks["pixel_map"] < 1e-6 and checks["wavelength_ratio"] > 1e-3, checks


def test_a_full_pixel_leaves_the_ratios_of_the_others() -> None:
    """The full pixel says nothing of its rate. Another pixel differs at one wavelength alone."""
    layout = sp.Layout(8, 8, 25e-12, 1.0)
    rate = np.where(np.arange(64) == 3, 5e6, 10.0)
    pdp = sp.effects.ByWavelength((500e-9, 700e-9), (0.4, 0.2))
    model = sp.Sensor(layout, [sp.effects.Detection(pdp=pdp), sp.effects.DarkCounts(rate=rate)], rules="device")
    photon = 6.62607015e-34 * 299792458.0
    clock = {"frames": 600_000, "frame_time": 10e-6}
    plan = [
        sp.Capture(
            name, "qis", wavelength=wave, irradiance=0.05 / 10e-6 / q * photon / wave / layout.pixel_area, **clock
        )
        for name, wave, q in (("green", 500e-9, 0.4), ("red", 700e-9, 0.2))
    ]
    truth = model.with_values({"detection.relative": np.where(np.arange(64) == 17, 1.05, 1.0)})
    green, red = (sp.simulate(one, [capture], seed=1) for one, capture in zip((truth, model), plan, strict=True))
    data = sp.Measurement.from_arrays(layout, {plan[0]: green["green"].frames, plan[1]: red["red"].frames})
    found = compare(model, data, jobs=1, replicates=24)
    (check,) = [c for c in found.checks if c.statistic == "wavelength_ratio"]
    assert check.p_value < 1e-6 and "row 2, column 1" in check.where and math.isfinite(check.relative)


def test_the_next_sensor_does_not_take_the_place_of_the_first(tmp_path):
    file = tmp_path / "sensor.yaml"
    file.write_text(TR)
    with pytest.raises(InputError, match="stays as it is"):
        sensor_file.check_place(file, tmp_path / "." / "sensor.yaml")
    sensor_file.check_place(file, tmp_path / "next" / "sensor.yaml")


def test_a_sensor_file_that_nobody_made_here_is_left_alone(tmp_path):
    file = tmp_path / "sensor.yaml"
    file.write_text(TR)
    own = tmp_path / "own.yaml"
    own.write_text(TR + "# typical; from data sheet, 2024-05-01\n")
    with pytest.raises(InputError, match="it is left alone"):
        sensor_file.check_place(file, own)
    with pytest.raises(InputError, match="is a folder"):
        sensor_file.check_place(file, tmp_path)
    key = ("dead_time", "duration")
    made = sensor_file.write(
        sensor_file.original(file), tmp_path / "next.yaml", {key: 55e-9}, {key: "from lab, 2026-11-23: duration (95 %)"}
    )
    sensor_file.check_place(file, made)
    made.write_text(made.read_text().partition("\n")[2])  # the line that says so
    with pytest.raises(InputError, match="it is left alone"):
        sensor_file.check_place(file, made)
    sensor_file.check_place(file, tmp_path / "new.yaml")


def test_an_answer_takes_the_place_of_nothing_but_an_answer(tmp_path):
    data, answer = tmp_path / "flat.h5", tmp_path / "answer.json"
    data.write_bytes(b"\x89HDF\r\n" * 100)
    with pytest.raises(InputError, match="it is left alone"):
        comparing._check_answer(data)
    with pytest.raises(InputError, match="is a folder"):
        comparing._check_answer(tmp_path)
    with pytest.raises(InputError, match="is the place of -o, too"):
        comparing._check_answer(tmp_path / "new", tmp_path / "." / "new")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(answer)
    answer.write_text('{"format": "spadmnist-fit/1"}')
    for place in ("pipe", "link"):
        with pytest.raises(InputError, match="a link, a pipe or a device, and is left alone; name a file"):
            comparing._check_answer(tmp_path / place)
    answer.write_text('{\n "format": "spadmnist-diagnosis/1"}')
    for free in (answer, tmp_path / "new.json", None):
        comparing._check_answer(free)
    done = CliRunner().invoke(cli.cli, ["compare", str(tmp_path / "s.yaml"), str(tmp_path), "--json", str(data)])
    assert done.exit_code != 0 and data.read_bytes().startswith(b"\x89HDF")


def test_the_next_command_of_a_sensor_in_next_names_another_folder(tmp_path: Path, monkeypatch) -> None:
    """It would take the place of the sensor file, and is refused."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "next").mkdir()
    text = "sensor:\n  layout: {rows: 2, columns: 2, pixel_area: 25 um^2}\n  effects:\n    dark_counts: {rate: %s}\n"
    for name, rate in (("s.yaml", "10 kHz"), ("next/sensor.yaml", "90 kHz")):
        (tmp_path / name).write_text(text % rate)
    sp.simulate("s.yaml", [sp.Capture("dark", "tr", dark=True, exposure=5e-3)], folder="lab")
    for name, folder in (("next/sensor.yaml", "next-2"), ("s.yaml", "next")):
        done = CliRunner().invoke(cli.cli, ["compare", name, "lab", "--jobs", "1"])
        assert done.exit_code == (1 if folder == "next-2" else 0), done.output
        assert f"diagnose {name} lab" in done.output
        assert (f"-o {folder} finds what the model lacks" in done.output) == (folder == "next-2")


GATED = sp.effects.ShortGate(fraction=0.9)
NOISY = sp.effects.SourceNoise(contrast=1.0, coherence_time=1e-3)


@pytest.mark.parametrize("which", ["a listed gate", "light that goes out"])
def test_a_capture_that_ends_as_its_model_or_its_bursts_do_did_not_stop_early(which: str) -> None:
    """A gate that the sensor lists is closed at the end; a lamp that goes out for a while may be out at the end."""
    photon = 6.62607015e-34 * 299792458.0 / 500e-9
    plain = [sp.effects.Detection(pdp=0.3), sp.effects.DeadTime(duration=50e-9), sp.effects.DarkCounts(rate=100.0)]
    layout = sp.Layout(2, 2, 25e-12, 1.0)
    made = sp.Sensor(layout, [*plain, GATED if which == "a listed gate" else NOISY], rules="device")
    stated = made if which == "a listed gate" else sp.Sensor(layout, plain, rules="device")
    light = {"wavelength": 500e-9, "irradiance": 2.5e4 / 0.3 * photon / 25e-12, "relative_uncertainty": 0.02}
    flat = sp.Capture("flat", "tr", exposure=0.2, **light)
    missing = 0
    for seed in range(8):
        replicates = Replicates(stated, sp.simulate(made, [flat], seed=seed), 0, Execution(Serial()), 2, reduced=False)
        seen = replicates.seen["flat"]
        assert seen.last is not None
        missing += seen.total * (0.2 - seen.last) / seen.last > 20
        assert setups.stopped_early(replicates) == {}
    assert missing > 0  # by its rate alone it would have
