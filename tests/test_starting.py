"""`init`: what it writes is explained line by line, runs as it is, and is filled by `import`."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner, Result
from PIL import Image

from spadmnist import config, measurement, schema
from spadmnist.cli import cli

SENSORS = ["spad23", "spad512", "spad_mnist"]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*words: str) -> Result:
    return CliRunner().invoke(cli, list(words))


def begin(*words: str) -> list[Path]:
    done = run("init", *words)
    assert done.exit_code == 0, done.output
    return [Path(line) for line in done.stdout.splitlines()]


def photos(folder: Path) -> None:
    """Of several sizes and kinds, in classes, one of them turned by its camera."""
    exif = Image.Exif()
    exif[0x0112] = 6
    for name, shape in (("ant/a.jpg", (40, 60, 3)), ("bee/b.png", (90, 30)), ("bee/c.png", (20, 20, 4))):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        picture = np.full(shape, 150, np.uint8)
        Image.fromarray(picture).save(folder / name, **({"exif": exif} if name.endswith("jpg") else {}))


def check_explained(path: Path) -> None:
    for line in path.read_text().splitlines():
        assert not line or "# " in line or line == "#", f"{path}: {line}"


@pytest.mark.parametrize("own", [False, True], ids=["", "photos"])
@pytest.mark.parametrize("sensor", SENSORS)
def test_a_config_runs_as_it_is(sensor: str, own: bool, here: Path) -> None:
    if own:
        photos(Path("photos"))
    files = begin("my", "--sensor", sensor, *(["--images", "photos"] if own else []))
    assert {"config.yaml", "sensor.yaml", "config.schema.json"} <= {path.name for path in files}
    assert all(path.is_file() for path in files)
    for name in ("config.yaml", "sensor.yaml"):
        check_explained(Path("my", name))
        first = Path("my", name).read_text().splitlines()[0]
        assert first.startswith("# yaml-language-server: $schema=") and Path("my", first.partition("=")[2]).is_file()
    read = config.read("my/config.yaml")
    assert read.sensor.name.replace("-", "_").lower() == sensor
    # workers stay in the folder where they were begun: the place is named in full
    done = run("generate", "my/config.yaml", "--lux", read.levels[0].text, "--limit", "1", "-o", str(here / "out"))
    assert done.exit_code == 0, done.output
    manifest = json.loads(Path("out/manifest.json").read_text())
    assert tuple(manifest["images"]["shape"]) == read.sensor.layout.shape
    if own:
        assert "0 ant, 1 bee" in done.output
        held = manifest["config"]["scene"]["images"]
        assert held["gamma"] == "srgb" and held["exif"] is True and held["grey"] is True
        assert manifest["images"]["splits"]["train"]["images"] == 1


def test_the_config_is_filled_in_for_the_photos() -> None:
    photos(Path("elsewhere", "my photos"))
    begin("my", "--images", "elsewhere/my photos", "--sensor", "spad512")
    text = Path("my/config.yaml").read_text()
    assert 'path: "../elsewhere/my photos"' in text and "resize: [512, 512]" in text
    assert "3 pictures, the first 60 x 40 pixels" in text  # as the camera was held


@pytest.mark.parametrize("sensor", SENSORS)
def test_a_plan_is_one(sensor: str) -> None:
    begin("bench", "--measurement", "--sensor", sensor)
    check_explained(Path("bench/measurement.yaml"))
    plan = measurement.open("bench", planned=True)
    assert [capture.light.dark for capture in plan.captures] == [True, False, False]
    assert plan.layout.shape == config.read_sensor(config.shipped(_file(sensor))).layout.shape


def _file(sensor: str) -> str:
    return "spad_mnist.yaml" if sensor == "spad_mnist" else f"{sensor}_sensor.yaml"


def test_import_fills_a_plan() -> None:
    begin("bench", "--measurement", "--sensor", "spad23")
    time, pixel = np.arange(1000, dtype=np.uint32), np.arange(1000, dtype=np.uint16) % 23
    for name in ("dark", "flat-dim", "flat-bright"):
        np.savez(f"{name}.npz", time=time, pixel=pixel, tick=1e-6, exposure=0.1)
    done = run("import", "dark.npz", "flat-dim.npz", "-o", "bench")
    assert done.exit_code == 0 and "Still missing: flat-bright" in done.output, done.output
    done = run("import", "flat-bright.npz", "-o", "bench")
    assert done.exit_code == 0, done.output
    lab = measurement.open("bench")
    assert [len(lab.recording(c.id).events or ()) for c in lab.captures] == [1000] * 3
    assert "# the cap is on" in Path("bench/measurement.yaml").read_text()


def test_nothing_is_written_over() -> None:
    first = begin("my")
    before = {path: path.read_bytes() for path in first}
    assert begin("my") == first  # the same again is no harm
    Path("my/sensor.yaml").write_text("mine")
    for path in (Path("my/config.yaml"), Path("my/config.schema.json")):
        path.unlink()
    done = run("init", "my")
    assert done.exit_code == 2 or isinstance(done.exception, Exception)
    assert Path("my/sensor.yaml").read_text() == "mine" and not Path("my/config.yaml").exists()
    assert before


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["my", "--images", "nowhere"], ["nowhere", "no such folder"]),
        (["my", "--images", "empty"], ["empty", "no picture"]),
        (["my", "--images", "empty", "--measurement"], ["--images", "belongs to a config"]),
        (["file"], ["file", "is a file", "name a folder"]),
        (["my"], ["my/sensor.yaml", "is there already", "not written over"]),
    ],
)
def test_mistakes(words: list[str], parts: list[str]) -> None:
    os.mkdir("empty")
    Path("file").write_text("")
    Path("my").mkdir()
    Path("my/sensor.yaml").write_text("mine")
    done = run("init", *words)
    assert done.exception is not None and not Path("my/config.yaml").exists()
    for part in parts:
        assert part in str(done.exception), done.exception


def test_what_it_writes_keeps_the_schema_beside_it() -> None:
    jsonschema = pytest.importorskip("jsonschema")
    begin("my", "--sensor", "spad512")
    begin("bench", "--measurement")
    for path in (Path("my/config.yaml"), Path("my/sensor.yaml"), Path("bench/measurement.yaml")):
        beside = path.with_name(schema.file_of(path.stem))
        jsonschema.validate(yaml.safe_load(path.read_text()), json.loads(beside.read_text()))


def test_the_examples_are_written_where_the_documentation_names_them(here: Path) -> None:
    missing = run("generate", "configs/quick.yaml", "-o", "out")
    assert "spadmnist init configs --examples" in str(missing.exception)
    files = begin("configs", "--examples")
    shipped = config.shipped("quick.yaml").parent
    assert {path.read_bytes() for path in files} == {path.read_bytes() for path in config.examples().values()}
    assert Path("configs/tutorial/plan/measurement.yaml") in files and Path("configs/tutorial/secret.py") in files
    assert len(files) == sum(p.is_file() and "__pycache__" not in p.parts for p in shipped.rglob("*"))
    for path in files:  # those that are named by others are found
        if path.suffix == ".yaml" and path.name not in ("measurement.yaml", "truth.yaml"):
            config.read_sensor(path)
    begin("configs", "--examples")  # again: they are there


def test_examples_are_asked_for_alone(here: Path) -> None:
    done = run("init", "configs", "--examples", "--measurement")
    assert "--examples" in str(done.exception) and not Path("configs").exists()
