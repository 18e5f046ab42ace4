"""`measurement.yaml`: what is read is what it says, and every mistake is told with its line."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from measured import (
    CASES,
    CHALLENGE,
    FORMAT,
    QIS,
    TICK,
    TR,
    described,
    device,
    events,
    refused,
    stored,
)

from spadmnist import config, measurement, twin
from spadmnist.effects import Conditions
from spadmnist.errors import ConfigError
from spadmnist.events import Layout
from spadmnist.recording import Light

# --- the measurements of the challenge ----------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
def test_the_challenge_is_read_as_a_few_lines_of_h5py_read_it(case: str) -> None:
    opened = measurement.open(CHALLENGE / case)
    sensor = config.read_sensor(CHALLENGE / case / "sensor.yaml")
    assert opened.name == case and opened.layout.shape == sensor.layout.shape
    for capture in opened.captures:
        recorded = opened.recording(capture.id, sensor)
        assert recorded.dead_time == sensor.nominal_dead_time and not opened.notes[capture.id]
        with h5py.File(CHALLENGE / case / f"{capture.id}.h5") as file:
            if capture.modality == "tr":
                time, pixel = file["time"][:], file["pixel"][:]
                order = np.argsort(pixel, kind="stable")
                assert recorded.events is not None and recorded.tick == 1e-10
                assert np.array_equal(recorded.events.ticks, time[order])
                assert np.array_equal(recorded.totals, np.bincount(pixel, minlength=recorded.pixels))
                continue
            frames = file["frames"][:]
        assert recorded.n_frames == capture.conditions.frames == len(frames)
        dense = frames < recorded.none
        if capture.modality == "qis":
            dense = np.unpackbits(frames, axis=2, count=recorded.layout.columns)
        assert np.array_equal(recorded.totals, dense.sum(axis=0, dtype=np.int64).ravel())
        assert np.array_equal(np.concatenate([part for _, part in recorded.chunks()]), frames)


@pytest.mark.skipif(not CASES, reason="the challenge is not at hand")
def test_light_and_clock_of_the_challenge() -> None:
    opened = measurement.open(CHALLENGE / "open-tr-null" / "measurement.yaml")
    capture = opened.capture("flat-20k")
    assert capture.light == Light(500e-9, 0.000756741, "irradiance", 0.015, 0.0)
    assert capture.conditions == Conditions(0.06, 1, 0.06, 0.06, 500e-9)
    assert opened.capture("dark").light.dark and opened.capture("dark").conditions.dark
    framed = measurement.open(CHALLENGE / "open-str-null").capture("flat-low").conditions
    assert framed == Conditions(4000 * 10e-6, 4000, 10e-6, 10e-6, 500e-9)


# --- measurement.yaml ---------------------------------------------------------------------------------------------


def test_every_mistake_is_told_at_once_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "measurement.yaml").write_text(
        """format: spadmnist-measurement/2
naem: x
layout: {rows: 0, columns: 16}
captures:
  - id: dark
    file: ../dark.h5
    modality: qsi
    light: {kind: dark, wavelength: 500 nm}
    exposure: 100
  - id: dark
    file: b.h5
    modality: qis
    light: {kind: flat, irradiance: 5 mlux, relative_uncertainty: 3}
    frames: 10
    frame_tme: 10 us
    exposre: 1 ms
  - id: c
    modality: tr
    light: {kind: flat, wavelength: 500 nm, irradiance: 1 nW/cm^2, lux: 1 lux}
    exposure: -1 ms
    frames: 10
  - 7
"""
    )
    with pytest.raises(ConfigError) as caught:
        measurement.open(tmp_path)
    problems = [p.removeprefix(f"{tmp_path}/") for p in caught.value.problems]
    expected = [
        ":1: format: 'spadmnist-measurement/2' is not a format that this program reads",
        ":2: naem is not an entry here. Did you mean name?",
        ":3: layout.rows: 0 is not possible",
        ":6: captures[0].file: '../dark.h5' leads out of the measurement's folder",
        ":7: captures[0].modality: 'qsi' is not one of tr, str, qis, counts. Did you mean qis?",
        ":8: captures[0].light.wavelength: belongs to the kind flat or image, and this is dark; take it out",
        ":10: captures[1].id: dark is that of captures[0]",
        ":13: captures[1].light.irradiance: '5 mlux' is not an irradiance",
        ":13: captures[1].light.relative_uncertainty: 3 is not possible",
        ":13: captures[1].light: wavelength is missing",
        ":15: captures[1].frame_tme is not an entry here. Did you mean frame_time?",
        ":16: captures[1].exposre is not an entry here. Did you mean exposure?",
        ":10: captures[1]: frame_time is missing; write for example frame_time: 10 us",
        ":17: captures[2]: has no file yet; record it, then: spadmnist import FILE -o ",
        ":19: captures[2].light: has both irradiance and lux",
        ":20: captures[2].exposure: -1 ms is not possible",
        ":21: captures[2].frames: belongs to the modality str, qis or counts, and this is tr; take it out",
        ":22: captures[3]: 7 is not possible; it must be a group of entries",
    ]
    for one in expected:
        assert any(p.startswith(f"measurement.yaml{one}") for p in problems), one
    assert len(problems) == len(expected), problems


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("seed: 1\nscene: {}\n", "is not a measurement; it begins with format"),
        ("[1, 2]\n", "is not a measurement"),
        (
            f"{FORMAT}\nlayout: {{rows: 1, columns: 1}}\ncaptures: []\n",
            "[] is not possible; it must have at least one entry",
        ),
        (f"{FORMAT}\nlayout: {{rows: 1, columns: 1}}\ncaptures: {TR}\n", "it must be a list"),
        (f"{FORMAT}\nlayout: {{rows: 1}}\ncaptures: [{TR}]\n", "columns is missing"),
        (f"{FORMAT}\nlayout: {{rows: 90000, columns: 90000}}\ncaptures: [{TR}]\n", "more than the 16,777,216"),
        (f"{FORMAT}\nlayout: {{positions: /etc/passwd}}\ncaptures: [{TR}]\n", "leads out of"),
        (f"{FORMAT}\nlayout: {{rows: 1, columns: 1}}\ncaptures:\n  - &x {TR}\n  - *x\n", "aliases"),
        (f"{FORMAT}\nname: 7\nlayout: {{rows: 1, columns: 1}}\ncaptures: [{TR}]\n", 'write "7"'),
    ],
)
def test_what_is_no_measurement(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "measurement.yaml").write_text(text)
    with pytest.raises(ConfigError, match=words.replace("[", r"\[")) as caught:
        measurement.open(tmp_path)
    assert len(caught.value.problems) == 1


@pytest.mark.parametrize("name", ["/etc/passwd", "../a.h5", "x/../../a.h5", "C:a.h5", "..\\a.h5", "", "a\nb.h5"])
def test_a_file_stays_in_the_folder(tmp_path: Path, name: str) -> None:
    described(tmp_path, TR.replace("a.h5", json.dumps(name)))
    with pytest.raises(ConfigError, match=r"captures\[0\]\.file"):
        measurement.open(tmp_path)


def test_a_link_out_of_the_folder_is_not_followed(tmp_path: Path) -> None:
    time, pixel = events()
    stored(tmp_path / "outside.h5", {"tick": TICK}, time=time, pixel=pixel)
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "a.h5").symlink_to(tmp_path / "outside.h5")
    with pytest.raises(ConfigError, match="link that leads out"):
        measurement.open(described(tmp_path / "lab", TR))
    (tmp_path / "lab" / "a.h5").unlink()
    (tmp_path / "lab" / "raw").mkdir()
    (tmp_path / "outside.h5").rename(tmp_path / "lab" / "raw" / "b.h5")
    (tmp_path / "lab" / "a.h5").symlink_to(tmp_path / "lab" / "raw" / "b.h5")
    measurement.open(tmp_path / "lab")


def test_free_levels_lux_means_and_uncertainties(tmp_path: Path) -> None:
    opened = measurement.open(
        described(
            tmp_path,
            "{id: free, mean: 470, modality: qis, light: {kind: flat, wavelength: 700 nm}, frames: 1000,"
            " frame_time: 1 us, frame_period: 2 us, exposure: 2 ms}",
            "{id: lux, mean: 0, modality: tr, light: {kind: flat, lux: 5 mlux, relative_uncertainty: 2 %,"
            " own_uncertainty: 0.01}, exposure: 1 s}",
            "{id: counts, mean: 3.5, modality: counts, light: {kind: dark, relative_uncertainty: 0.1}, frames: 30,"
            " frame_time: 1 us, bits: 4}",
        )
    )
    free, lux, counts = opened.captures
    assert free.mean == 470 and free.light.level is None and free.light.wavelength == 700e-9
    assert free.conditions.frame_period == 2e-6 and free.conditions.exposure == 2e-3
    assert lux.light == Light(555e-9, 5e-3, "lux", 0.02, 0.01) and lux.mean == 0
    assert counts.conditions.bits == 4 and counts.conditions.count_frames == 2
    refused(lambda: opened.recording("free"), "only the mean is known")
    refused(lambda: opened.recording("fre"), "Did you mean free?")
    refused(lambda: opened.recording("free", Layout(4, 10, 1e-12, 1.0)), "3 x 10", "4 x 10")


def test_an_exposure_of_frames_must_be_their_sum(tmp_path: Path) -> None:
    described(tmp_path, QIS.replace("frames: 20", "exposure: 1 s, frames: 20"))
    with pytest.raises(ConfigError, match="not frames x frame_period, 200 us"):
        measurement.open(tmp_path)


def test_positions_count_as_one_row(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("x,y\n0,0\n10,0\n5,8.66\n")
    time, pixel = events(pixels=3)
    stored(tmp_path / "a.h5", {"tick": TICK}, time=time, pixel=pixel)
    opened = measurement.open(described(tmp_path, TR, layout="{positions: p.csv}"))
    assert (opened.rows, opened.columns) == (1, 3)
    assert opened.recording("a").layout.neighbours(1).first is not None
    other = Layout(1, 3, 1e-12, 1.0, np.array([[0, 0], [1e-5, 0], [2e-5, 0]]))
    refused(lambda: opened.recording("a", other), "positions are not those of the sensor")
    with pytest.raises(ConfigError, match="3 positions count as 1 x 3, not as 3 x 1"):
        measurement.open(described(tmp_path, TR, layout="{positions: p.csv, rows: 3, columns: 1}"))


HERE = "{id: a, mean: 3, modality: MODALITY, light: {kind: KIND}, CLOCK}"


@pytest.mark.parametrize(
    ("modality", "kind", "clock", "says"),
    [
        ("tr", "dark", "exposure: 1 ms, bits: 3", ".bits: belongs to the modality counts, and this is tr"),
        ("qis", "dark", "frames: 9, frame_time: 1 us, counting: counter", ".counting: belongs to the modality counts"),
        ("counts", "dark", "frames: 9, frame_time: 1 us", ": bits is missing; write for example bits: 8"),
        ("counts", "dark", "frames: 9, frame_time: 1 us, bits: 17", ".bits: 17 is not possible; it must be at most 16"),
        ("counts", "dark", "frames: 8, frame_time: 1 us, bits: 3", ".frames: 8 binary frames do not fill"),
        ("counts", "dark", "frames: 8, frame_time: 1 us, bits: 3, counting: count",
         ".counting: 'count' is not one of frames, counter. Did you mean counter?"),
        ("qis", "dark", "frames: 2, frame_time: 1 us", ".mean: 3 is not possible; it must be at least 0 and at most 2"),
        ("qis", "dark", "frames: 0, frame_time: 1 us", ".frames: 0 is not possible; it must be at least 1"),
        ("qis", "dark", "frames: 2.5, frame_time: 1 us", ".frames: 2.5 is not possible; it must be a whole number"),
        ("str", "dark", "frames: 9, frame_time: 3 us, frame_period: 2 us",
         ".frame_time: 3 us does not fit into the frame period of 2 us"),
        ("str", "dark", "frames: 9, frame_time: 3, frame_period: 4 us", ".frame_time: 3 has no unit"),
        ("tr", "dark, 5: 1", "exposure: 1 ms", ".light[5] is not an entry here. Allowed are"),
        ("tr", "drak", "exposure: 1 ms", ".light.kind: 'drak' is not one of dark, flat, image. Did you mean dark?"),
        ("tr", "flat, lux: 1 lux, irradiance: 1 nW/cm^2", "exposure: 1 ms", ".light: has both irradiance and lux"),
        ("tr", "flat", "exposure: 1 ms", ".light: wavelength is missing; write for example wavelength: 500 nm"),
        ("tr", "flat, lux: 0 lux", "exposure: 1 ms", ".light.lux: 0 lux is not possible; it must be more than 0"),
        ("tr", "dark, own_uncertainty: 101 %", "exposure: 1 ms",
         ".light.own_uncertainty: 101 % is not possible; it must be at least 0 and at most 1 (100 %)"),
        ("tr", "dark", "exposure: 1 ms, file: a.h5", ": has both file and mean; keep one"),
        ("tr", "dark", "exposure: 1e300 s", ".exposure: 1e300 s is not possible; it must be more than 0 and at most"),
        ("tr", "dark", "exposure: 1e-20 s", ".exposure: 1e-20 s is not possible; it must be at least 1e-18 s"),
        ("qis", "dark", "frames: 100, frame_time: 1e17 s", ".frames: frames x frame_period is 1e+19 s; it is at most"),
        ("tr", "dark", "exposure: null", ".exposure: None is not a time"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_capture_is_one_sentence(
    tmp_path: Path, modality: str, kind: str, clock: str, says: str
) -> None:
    described(tmp_path, HERE.replace("MODALITY", modality).replace("KIND", kind).replace("CLOCK", clock))
    with pytest.raises(ConfigError) as caught:
        measurement.open(tmp_path)
    (problem,) = caught.value.problems
    assert problem.startswith(f"{tmp_path / 'measurement.yaml'}:5: captures[0]{says}")


def test_who_does_not_say_the_modality_is_told_the_rest_too(tmp_path: Path) -> None:
    """What is the same for all modalities, or belongs to some alone, can be judged without it."""
    described(
        tmp_path,
        "{file: ../a.h5, light: {lux: 5 lx, wavelenght: 5 nm}, frames: 0, bits: 3, exposure: 1, exposre: 1 ms}",
    )
    with pytest.raises(ConfigError) as caught:
        measurement.open(tmp_path)
    place = f"{tmp_path / 'measurement.yaml'}:5: captures[0]"
    expected = [
        " needs a modality: one of tr, str, qis, counts",
        ": id is missing; write for example id: dark",
        ".file: '../a.h5' leads out",
        ".light needs a kind: one of dark, flat",
        ".light.lux: '5 lx' is not an illuminance",
        ".light.wavelenght is not an entry here. Did you mean wavelength?",
        ".frames: 0 is not possible",
        ".exposre is not an entry here. Did you mean exposure?",
    ]
    for one in expected:
        assert len([p for p in caught.value.problems if p.startswith(place + one)]) == 1, one
    assert len(caught.value.problems) == len(expected), caught.value.problems


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    """Who opens a pipe waits for one who writes."""
    described(tmp_path, TR)
    os.mkfifo(tmp_path / "a.h5")
    refused(lambda: measurement.open(tmp_path), "a.h5: is no file")
    (tmp_path / "a.h5").unlink()
    (tmp_path / "a.h5").symlink_to("a.h5")
    refused(lambda: measurement.open(tmp_path), "a.h5")
    os.mkfifo(tmp_path / "p.csv")
    with pytest.raises(ConfigError, match=r"layout\.positions: .*p\.csv: is no file"):
        measurement.open(described(tmp_path, TR, layout="{positions: p.csv}"))
    (tmp_path / "measurement.yaml").unlink()
    os.mkfifo(tmp_path / "measurement.yaml")
    refused(lambda: measurement.open(tmp_path), "measurement.yaml is no file")


# --- plans --------------------------------------------------------------------------------------------------------

TO_COME = (
    "{id: dark, modality: tr, light: {kind: dark}, exposure: 1 ms}",
    "{id: the lamp, file: , modality: qis, light: {kind: flat, lux: 5 mlux}, frames: 20, frame_time: 10 us}",
    "{id: named, file: named.h5, modality: str, light: {kind: dark}, frames: 20, frame_time: 10 us}",
    "{id: mean, mean: 3, modality: qis, light: {kind: dark}, frames: 20, frame_time: 10 us}",
    "{id: sums, modality: counts, light: {kind: dark}, frames: 30, frame_time: 10 us, bits: 4}",
    TR,
)


def test_a_plan_knows_what_is_to_be_recorded(tmp_path: Path) -> None:
    time, pixel = events()
    stored(tmp_path / "a.h5", {"tick": TICK}, time=time, pixel=pixel)
    plan = measurement.open(described(tmp_path, *TO_COME), planned=True)
    assert plan.missing == ("dark", "the lamp", "named", "sums")
    assert (plan.folder, plan.file) == (tmp_path, tmp_path / "measurement.yaml")
    assert [c.mean for c in plan.captures] == [None, None, None, 3.0, None, None]
    assert plan.capture("sums").conditions.count_frames == 2 and plan.recording("a").totals.sum() == 500
    text = refused(lambda: plan.recording("the lamp"), "captures[1]: has no file yet; record it, then: ")
    assert text.endswith(f"spadmnist import FILE -o {tmp_path} --capture 'the lamp'")
    refused(lambda: plan.recording("named"), "named.h5: no such file")
    (tmp_path / "named.h5").touch()
    assert plan.missing == ("dark", "the lamp", "sums")
    refused(lambda: measurement.open(tmp_path, planned=True), "named.h5: is not an HDF5 file")


def test_a_plan_is_no_measurement_yet(tmp_path: Path) -> None:
    """All that has yet to be recorded is told at once, each with the command that takes it in."""
    described(tmp_path, *TO_COME)
    with pytest.raises(ConfigError) as caught:
        measurement.open(tmp_path)
    place, command = f"{tmp_path / 'measurement.yaml'}:", f"spadmnist import FILE -o {tmp_path} --capture"
    assert caught.value.problems == tuple(
        f"{place}{line}: captures[{line - 5}]: has no file yet; record it, then: {command} {name}"
        for line, name in ((5, "dark"), (6, "'the lamp'"), (9, "sums"))
    )
    (tmp_path / "measurement.yaml").rename(tmp_path / "plan.yaml")  # which is not what its folder opens as
    with pytest.raises(ConfigError, match=f"-o {tmp_path / 'plan.yaml'} --capture dark"):
        measurement.open(tmp_path / "plan.yaml")


@pytest.mark.parametrize("file", ["", ", file: a.h5"])
def test_planned_counts_state_what_a_count_is(tmp_path: Path, file: str) -> None:
    """The file would say it, which is not there yet."""
    clock = "{id: a, modality: counts, light: {kind: dark}, frames: 20, frame_time: 10 us"
    described(tmp_path, f"{clock}{file}}}")
    with pytest.raises(ConfigError, match=r"captures\[0\]: bits is missing; write for example bits: 8"):
        measurement.open(tmp_path, planned=True)
    opened = measurement.open(described(tmp_path, f"{clock}, bits: 4, counting: counter{file}}}"), planned=True)
    assert opened.capture("a").conditions.count_frames == 20 and opened.missing == ("a",)


def test_a_plan_is_simulated(tmp_path: Path) -> None:
    plan = measurement.open(described(tmp_path, *TO_COME[:1], *TO_COME[3:5]), planned=True)
    made = measurement.open(twin.simulate(device(rows=3), plan, tmp_path / "twin", 1))
    assert [replace(c, mean=None) for c in made.captures] == [replace(c, mean=None) for c in plan.captures]
    assert made.missing == () and made.recording("dark").totals.sum() > 0
