"""A plan: captures that are described first and recorded later. Files fill it, and nothing of it is lost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import commands
import h5py
import numpy as np
import pytest
from importfiles import ptu, refusal_of, save, t2

from spadmnist import exporters, measurement
from spadmnist.errors import ConfigError
from spadmnist.importers import Said
from spadmnist.importers.captures import Imported, import_files
from spadmnist.recording import Light

PLAN = """\
# a bench, on a Monday
format: spadmnist-measurement/1
name: "bench: monday"
layout: {rows: 4, columns: 8}   # the measured part
captures:
  - id: dark
    modality: qis      # bits
    light: {kind: dark}
    frames: 20
    frame_time: 10 us
    frame_period: 12 us
  - {id: flat 1, modality: qis, frames: 20,
     light: {kind: flat, wavelength: 500 nm, irradiance: 75 nW/cm^2, relative_uncertainty: 0.015},
     frame_time: 10 us, frame_period: 12 us}
  - id: counts
    modality: counts
    light: {kind: flat, wavelength: 500 nm}
    bits: 4
    frames: 90
    frame_time: 10 us
  # the last one
  - id: tags
    file: data/tags.h5
    modality: tr
    light: {kind: flat, lux: 5 mlux}
    exposure: 2 s
"""


def plan(folder: Path, text: str = PLAN) -> Path:
    """A folder with a plan."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "measurement.yaml").write_text(text, newline="")
    return folder


def bits(n: int = 20, seed: int = 1) -> np.ndarray:
    return np.random.Generator(np.random.Philox(seed)).random((n, 4, 8)) < 0.3


NOTHING = Said()


def fill(files: Path | list[Path], lab: Path, *ids: str, said: Said = NOTHING, **more: Any) -> Imported:
    return import_files(files if isinstance(files, list) else [files], lab, said, ids=ids, **more)


def test_a_plan_is_filled_file_by_file(tmp_path: Path) -> None:
    lab = plan(tmp_path / "lab")
    with pytest.raises(ConfigError, match=r"captures\[0\]: has no file yet.*spadmnist import FILE") as caught:
        measurement.open(lab)
    assert "mean: 470" not in str(caught.value)
    dark, flat = bits(seed=1), bits(seed=2)
    counts = np.random.Generator(np.random.Philox(3)).integers(0, 16, (6, 4, 8)).astype(np.uint8)
    made = fill(save(tmp_path / "dark.npy", dark), lab)
    assert made.missing == ("flat 1", "counts", "tags") and [one.id for one in made.captures] == ["dark"]
    text = (lab / "measurement.yaml").read_text()
    assert text == PLAN.replace("  - id: dark\n", "  - id: dark\n    file: dark.h5\n")
    # two by name, though in another order; the name of a file is made safe as that of a capture is
    made = fill([save(tmp_path / "counts.npy", counts), save(tmp_path / "flat_1.npy", flat)], lab)
    assert made.missing == ("tags",) and [one.id for one in made.captures] == ["counts", "flat 1"]
    text = text.replace("{id: flat 1,", "{id: flat 1, file: flat_1.h5,").replace(
        "- id: counts\n", "- id: counts\n    file: counts.h5\n"
    )
    assert (lab / "measurement.yaml").read_text() == text
    # the last one is what is left
    pytest.importorskip("ptufile")
    made = fill(ptu(tmp_path / "x.ptu", [t2(3, 5), t2(31, 9)]), lab)
    assert made.missing == () and (lab / "data" / "tags.h5").is_file()
    assert (lab / "measurement.yaml").read_text() == text  # its file was named already
    whole = measurement.open(lab)
    for id, array in (("dark", dark), ("flat 1", flat)):
        one = whole.recording(id)
        assert np.array_equal(one.frames[:], np.packbits(array, axis=2))  # type: ignore[index]
        assert (one.conditions.frames, one.conditions.frame_time, one.conditions.frame_period) == (20, 10e-6, 12e-6)
    assert whole.capture("flat 1").light == Light(500e-9, 75e-5, "irradiance", 0.015)
    one = whole.recording("counts")
    assert np.array_equal(one.frames[:], counts)  # type: ignore[index]
    assert (
        one.conditions.frames == 90 and one.conditions.frame_time == pytest.approx(10e-6) and one.conditions.bits == 4
    )
    assert list(np.flatnonzero(whole.recording("tags").totals)) == [3, 31]
    assert whole.recording("tags").conditions.exposure == 2.0


def test_a_plan_is_filled_in_order_or_by_capture(tmp_path: Path) -> None:
    arrays = [bits(seed=seed) for seed in (1, 2)]
    files = [save(tmp_path / f"00{i}.npy", array) for i, array in enumerate(arrays)]
    for name, ids, order in (("by", ("flat 1", "dark"), (1, 0)), ("in", (), (0, 1))):
        text = PLAN[: PLAN.index("  - id: counts")]
        lab = plan(tmp_path / name, text)
        fill(files, lab, *ids)
        for id, i in zip(("dark", "flat 1"), order, strict=True):
            frames = measurement.open(lab).recording(id).frames
            assert np.array_equal(frames[:], np.packbits(arrays[i], axis=2))  # type: ignore[index]
    lab = plan(tmp_path / "many")
    for said, ids in (
        ("000.npy, 001.npy: not named as a capture is, and 4 captures are missing (dark, flat 1, counts, tags)", ()),
        ("--capture: 1 for 2 files", ("dark",)),
        ("has no capture 'drak'", ("drak", "flat 1")),
    ):
        assert said in refusal_of(fill, files, lab, *ids)
    fill(files[0], lab, "dark")
    assert "--capture: dark has its data already" in refusal_of(fill, files[1], lab, "dark")
    assert "is no plan" in refusal_of(fill, files[1], tmp_path / "new", "dark")


CLOCK = Said(frame_time=10e-6)


@pytest.mark.parametrize(
    ("change", "said", "lights", "says"),
    [
        ({}, Said(frame_time=11e-6), (), "captures[0]: frame_time is 10 us, but --frame-time says 11 us"),
        ({}, Said(rows=5), (), "rows is 4, but --rows says 5"),
        ({}, Said(frames=7), (), "frames is 20, but --frames says 7"),
        ({}, Said(modality="str"), (), "modality is qis, but --modality says str"),
        ({}, Said(bits=4), (), "--bits does not apply to qis"),
        ({}, Said(relative_uncertainty=0.1), (), "the plan says it"),
        ({}, Said(), (Light(),), "the plan says what fell on the sensor"),
        ({"frames": np.zeros((19, 4, 8), bool)}, Said(), (), "captures[0]: frames is 20, but"),
        ({"frames": np.zeros((20, 4, 9), bool)}, Said(), (), "not 4 x 8 pixels"),
        ({"attributes": {"frame_time": 9e-6}}, Said(), (), "frame_time is 10 us, but"),
        ({"attributes": {"wavelength": 500e-9}}, Said(), (), "was recorded in light"),
        ({"time": np.array([1]), "pixel": np.array([1])}, Said(), (), "modality is qis, but"),
    ],
)
def test_a_contradiction_is_an_error(
    tmp_path: Path, change: dict[str, Any], said: Said, lights: Any, says: str
) -> None:
    lab = plan(tmp_path / "lab")
    with h5py.File(tmp_path / "dark.h5", "w") as file:
        attributes = change.pop("attributes", {})
        for name, value in (change or {"frames": bits()}).items():
            file[name] = value
        file.attrs.update(attributes)
    text = refusal_of(fill, tmp_path / "dark.h5", lab, said=said, lights=lights)
    assert says in text, text
    assert (lab / "measurement.yaml").read_text() == PLAN and not (lab / "dark.h5").exists()


def test_who_says_what_the_plan_says_is_right(tmp_path: Path) -> None:
    """Also against a file: the header of an instrument may name a time that was not recorded."""
    pytest.importorskip("ptufile")
    file = ptu(tmp_path / "tags.ptu", [t2(0, 5)])  # its header says 2 s
    lab = plan(tmp_path / "lab", PLAN.replace("exposure: 2 s", "exposure: 1 s"))
    assert "TTResult_StopAfter" in refusal_of(fill, file, lab)
    assert '--exposure "1 s"' in refusal_of(fill, file, lab)
    fill(file, lab, said=Said(exposure=1.0))
    assert measurement.open(lab, planned=True).recording("tags").conditions.exposure == 1.0


def test_what_is_exported_fills_its_own_plan(tmp_path: Path) -> None:
    lab = plan(tmp_path / "lab", PLAN[: PLAN.index("  - id: counts")])
    fill([save(tmp_path / "dark.npy", bits(seed=1)), save(tmp_path / "flat 1.npy", bits(seed=2))], lab)
    paths = exporters.export(measurement.open(lab), tmp_path / "out", "hdf5")
    again = plan(tmp_path / "again", PLAN[: PLAN.index("  - id: counts")])
    fill(list(paths), again)
    for name in ("dark.h5", "flat_1.h5"):
        assert (lab / name).read_bytes() == (again / name).read_bytes()


def test_a_plan_survives_a_file_that_fails(tmp_path: Path) -> None:
    """The second of two files cannot be read: the first is there as a whole, and the same command goes on."""
    lab = plan(tmp_path / "lab", PLAN[: PLAN.index("  - id: counts")])
    good, bad = save(tmp_path / "dark.npy", bits()), bits(seed=2).astype(np.uint8)
    bad[15] = 7
    files = [good, save(tmp_path / "flat_1.npy", bad)]
    assert "on hold 7" in refusal_of(fill, files, lab)
    assert measurement.open(lab, planned=True).missing in (("flat 1",), ("dark", "flat 1"))
    save(files[1], bits(seed=2))
    left = [path for path in files if path.stem.replace("_", " ") in measurement.open(lab, planned=True).missing]
    assert fill(left, lab).missing == ()
    assert sorted(path.name for path in lab.iterdir()) == ["dark.h5", "flat_1.h5", "measurement.yaml"]


def test_a_plan_keeps_its_line_ends_and_positions(tmp_path: Path) -> None:
    text = (
        PLAN[: PLAN.index("  - {id: flat 1")]
        .replace("\n", "\r\n")
        .replace("{rows: 4, columns: 8}", "{positions: p.csv}")
    )
    lab = plan(tmp_path / "lab", text)
    (lab / "p.csv").write_text("x,y\n" + "".join(f"{i},{i % 2}\n" for i in range(32)))
    fill(save(tmp_path / "dark.npy", bits().reshape(20, 1, 32)), lab)
    written = (lab / "measurement.yaml").read_bytes().decode()
    assert written == text.replace("- id: dark\r\n", "- id: dark\r\n    file: dark.h5\r\n")
    assert measurement.open(lab).recording("dark").layout.positions is not None


@pytest.mark.slow
def test_the_verb(tmp_path: Path) -> None:
    lab = plan(tmp_path / "my lab", PLAN[: PLAN.index("  - id: counts")])
    save(tmp_path / "a.npy", bits())
    said = commands.run("import", "a.npy", "-o", "my lab", cwd=tmp_path)
    assert said.returncode == 2 and "--capture" in said.stderr and "dark, flat 1" in said.stderr
    said = commands.run("import", "a.npy", "-o", "my lab", "--capture", "flat 1", "--json", cwd=tmp_path)
    assert said.returncode == 0 and json.loads(said.stdout)["missing"] == ["dark"]
    assert json.loads(said.stdout)["captures"][0]["sources"]["frame_time"] == "the plan"
    assert "Still missing: dark" in said.stderr
    # the plan may be named by its file, too
    said = commands.run("import", "a.npy", "-o", lab / "measurement.yaml", cwd=tmp_path)
    assert said.returncode == 0, said.stderr
    assert measurement.open(lab).missing == ()


@pytest.mark.slow
def test_a_plan_is_inspected_as_far_as_it_is_recorded(tmp_path: Path) -> None:
    lab = plan(tmp_path / "lab")
    fill(save(tmp_path / "dark.npy", bits()), lab)
    said = commands.run("inspect", lab, "--plot", tmp_path / "a.png")
    assert (
        said.returncode == 0
        and "Not recorded yet: flat 1, counts, tags. Next:  spadmnist import FILE -o" in said.stderr
    )
    assert "dark" in said.stdout and (tmp_path / "a.png").stat().st_size > 5000
    found = json.loads(commands.run("inspect", lab, "--json").stdout)
    assert found["missing"] == ["flat 1", "counts", "tags"] and found["captures"][0]["detections"] == int(bits().sum())
    assert found["captures"][1]["detections"] is None
