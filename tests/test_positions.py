"""Pixels at positions: read from a CSV file, told where it is wrong, and carried along in a dataset."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spadmnist
from spadmnist import config, document, factory, verify
from spadmnist.effects import Effect
from spadmnist.errors import ConfigError, InputError, SpadError
from spadmnist.positions import positions_text, read_positions

ROOT = Path(__file__).parents[1]
TEXT = """\
seed: 7
scene:
  images: {source: uniform, repetitions: 5}
  lux: [100 mlux, 2560 mlux]
recording: {exposure: 1 ms, frames: 10, frame_time: 100 us, readouts: [tr, str, qis]}
reconstruct: [counts]
sensor:
  layout:
    positions: places.csv
    pixel_area: 25 um^2
  effects:
    detection: {pdp: 0.5}
    dark_counts: {rate: {lognormal: {median: 20 Hz, sigma: 1}}}
    tdc: {resolution: 100 ps}
"""
PLACES = "x,y\n0,0\n5.0,0\n2.5,4.33\n-2.5,4.33\n-5,0\n"
LINE = TEXT[: TEXT.index("positions:")].count("\n") + 1


def folder_of(path: Path, places: str | bytes = PLACES) -> Path:
    """A folder with the config and its positions."""
    path.mkdir(exist_ok=True)
    (path / "c.yaml").write_text(TEXT)
    (path / "places.csv").write_bytes(places if isinstance(places, bytes) else places.encode())
    return path


def made(file: Path, root: Path, **changes: Any) -> factory.Outcome:
    experiment = config.read(file, **changes)
    return factory.generate(experiment, experiment.load_images(), root, 1)


def tree(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


# --- reading -------------------------------------------------------------------------------------------------------


def test_positions_become_a_layout_in_metres(tmp_path: Path) -> None:
    experiment = config.read(folder_of(tmp_path) / "c.yaml")
    layout = experiment.sensor.layout
    assert layout.shape == (1, 5) and layout.positions is not None
    # the nearest doubles, not the product of two rounded ones
    assert layout.positions.tolist() == [[0, 0], [5e-6, 0], [2.5e-6, 4.33e-6], [-2.5e-6, 4.33e-6], [-5e-6, 0]]
    assert experiment.resolved["sensor"]["layout"] == {
        "positions": "places.csv",
        "pixel_area": "25 um^2",
        "fill_factor": 1.0,
    }
    images = experiment.load_images()
    assert images["train"].pixels.shape == (5, 1, 5)
    assert experiment.sensor.effect("dark_counts").rate.shape == (5,)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    "text",
    [
        PLACES.replace("x,y", "x (um),y (um)"),
        PLACES.replace("x,y", " X , Y "),
        PLACES.replace("x,y", "x(um),y(um)"),
        "\ufeff" + PLACES,
        PLACES.replace("\n", "\r\n"),
        "\n" + PLACES.replace("\n", "\n\n"),
        PLACES.rstrip("\n"),
        PLACES.replace("5.0,0", '"5.0", 0 '),
        PLACES.replace("5.0,0", "+.5e1,-0"),
    ],
)
def test_spellings_of_the_same_file(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(text.encode())
    (tmp_path / "b.csv").write_text(PLACES)
    one, other = read_positions(tmp_path / "a.csv"), read_positions(tmp_path / "b.csv")
    assert one.dtype == np.float64 and one.tobytes() == other.tobytes()


def test_what_is_written_is_read_back_to_the_bit(tmp_path: Path) -> None:
    rng = np.random.Generator(np.random.Philox(1))
    places = rng.normal(0, 1e-4, (2000, 2)) * 10.0 ** rng.integers(-1, 3, (2000, 2))
    text = positions_text(places)
    (tmp_path / "a.csv").write_text(text)
    again = read_positions(tmp_path / "a.csv")
    assert again.tobytes() == places.tobytes() and positions_text(again) == text
    assert positions_text(np.array([[2.3e-5, -0.0], [1e-12, 0.5]])) == ("x (um),y (um)\n23,-0\n0.000001,500000\n")


MISTAKES = [
    ("x,y\n0,0\n5,a\n", 3, "'a' is not a number"),
    ("x,y\n0,0\n5,\n", 3, "'' is not a number"),
    ("x,y\n0,0\n5 um,1\n", 3, "'5 um' is not a number|um"),
    ("x,y\n0,0\n1_0,1\n", 3, "'1_0' is not a number"),
    ("x,y\n0,0\n0x10,1\n", 3, "'0x10' is not a number"),
    ("x,y\n0,0\n٣,1\n", 3, "is not a number"),
    ("x,y\n0,0\n9**9**9,1\n", 3, "is not a number"),
    ("x,y\n0,nan\n", 2, "'nan'|finite"),
    ("x,y\n0,-inf\n", 2, "'-inf'|finite"),
    ("x,y\n0,1e999\n", 2, "1e999"),
    ("x,y\n0,1000001\n", 2, "1000001 um|within 1 m"),
    ("x,y\n0,0\n1,2,3\n", 3, "3 columns|x and the y"),
    ("x,y\n0,0\n1\n", 3, "1 column;"),
    ("x,y\n0;0\n", 2, "1 column;"),
    ("x,y\n0,0\n\n1,1\n0.0,-0\n", 5, "line 2|same place"),
    ("x,y\n0,0\n1,1\n0.0001,0\n", 4, "line 2|same place"),
    ("0,0\n1,1\n", 1, "'0,0' is no header|x,y"),
    ("x,y,z\n0,0,0\n", 1, "'x,y,z' is no header|x,y"),
    ("x [mm],y [mm]\n0,0\n", 1, "is no header|um"),
    ('x,y\n"0,0\n1,1\n', None, "not well-formed CSV"),
    ("", None, "names no pixel"),
    ("\n\n", None, "names no pixel"),
    ("x,y\n", None, "names no pixel"),
    (b"x,y\n0,\xff\xfe\n", None, "UTF-8"),
    (b"\x89PNG\r\n\x1a\n\0\0", None, "UTF-8"),
    (b"x,y\n0,\0\n", 2, "is not a number"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "line", "says"), MISTAKES, ids=[repr(m[0])[:40] for m in MISTAKES])
def test_a_mistake_is_one_sentence_with_file_and_line(
    text: str | bytes, line: int | None, says: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError) as caught:
        config.read(folder_of(tmp_path, text) / "c.yaml")
    (problem,) = caught.value.problems
    place = f"{tmp_path / 'places.csv'}" + (f":{line}: " if line else ":")
    assert problem.startswith(f"{tmp_path / 'c.yaml'}:{LINE}: sensor.layout.positions: {place}")
    assert "\n" not in problem and len(problem.removeprefix(str(tmp_path))) < 300
    assert all(part in problem for part in says.split("|"))


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    folder_of(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "large.csv").write_bytes(b"x,y\n" + b"0" * (1 << 24))
    os.mkfifo(tmp_path / "pipe.csv")  # who opens it for reading waits for a writer
    (tmp_path / "loop.csv").symlink_to("loop.csv")
    for name, says in (
        ("missing.csv", "no such file"),
        ("folder", "is no file"),
        ("large.csv", "larger than 16 MiB"),
        ("pipe.csv", "is no file"),
        ("loop.csv", "cannot be read"),
    ):
        with pytest.raises(InputError, match=f"{name}: .*{says}"):
            read_positions(tmp_path / name)
    with pytest.raises(InputError, match="is not the name of a file"):
        read_positions(tmp_path / "a\0.csv")
    (tmp_path / "link.csv").symlink_to("places.csv")
    assert len(read_positions(tmp_path / "link.csv")) == 5


def test_at_most_so_many_pixels(tmp_path: Path) -> None:
    lines = [f"{i % 400},{i // 400}" for i in range(100_001)]
    (tmp_path / "a.csv").write_text("\n".join(["x,y", *lines]))
    with pytest.raises(InputError, match=r"a\.csv:100002: there are more than 100000 pixels"):
        read_positions(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text("\n".join(["x,y", *lines[:-1]]))
    assert read_positions(tmp_path / "a.csv").shape == (100_000, 2)


@pytest.mark.parametrize(
    ("layout", "says"),
    [
        ("{positions: places.csv, rows: 1, columns: 5, pixel_area: 25 um^2}", "instead of rows and columns|the other"),
        ("{positions: places.csv, columns: 5, pixel_area: 25 um^2}", "instead of rows and columns"),
        ("{pixel_area: 25 um^2}", "rows is missing|columns|positions: FILE.csv"),
        ("{columns: 5, pixel_area: 25 um^2}", "rows is missing; write for example rows: 28"),
        ("{rows: 5, pixel_area: 25 um^2}", "columns is missing"),
        ("{rows: null, columns: 3, pixel_area: 25 um^2}", "rows is missing"),
        ("{positions: {file: places.csv}, pixel_area: 25 um^2}", "positions|text"),
        ("{positions: 5, pixel_area: 25 um^2}", "positions|text"),
        ("{position: places.csv, rows: 1, columns: 5, pixel_area: 25 um^2}", "Did you mean positions?"),
    ],
)
def test_where_the_pixels_are_is_said_once(layout: str, says: str, tmp_path: Path) -> None:
    folder_of(tmp_path)
    text = TEXT.replace("layout:\n    positions: places.csv\n    pixel_area: 25 um^2", f"layout: {layout}")
    with pytest.raises(ConfigError) as caught:
        config.build(document.parse(text, "lab.yaml"), tmp_path)
    (problem,) = caught.value.problems
    assert problem.startswith("lab.yaml:8: sensor.layout") and all(part in problem for part in says.split("|"))


@pytest.mark.parametrize("shape", [(5,), (1, 5)])
def test_a_map_of_pixels_at_positions(shape: tuple[int, ...], tmp_path: Path) -> None:
    folder_of(tmp_path)
    np.save(tmp_path / "dcr.npy", np.arange(5.0).reshape(shape))
    text = TEXT.replace("{lognormal: {median: 20 Hz, sigma: 1}}", "{file: dcr.npy}")
    sensor = config.build(document.parse(text, "lab.yaml"), tmp_path).sensor
    assert np.array_equal(sensor.effect("dark_counts").rate, np.arange(5.0))  # type: ignore[union-attr]


@pytest.mark.parametrize("rules", ["paper", "device"])
@pytest.mark.parametrize("name", list(Effect.registry))
def test_every_effect_has_its_place_at_positions(name: str, rules: str, tmp_path: Path) -> None:
    """With neighbours that lie where the file says, and all in one row."""
    folder_of(tmp_path)
    if any(p.required for p in Effect.registry.find(name).parameters.values()):
        pytest.skip("it has values without a default")
    entry = "" if f"    {name}:" in TEXT else f"    {name}: {{}}\n"
    text = TEXT.replace("sensor:\n", f"sensor:\n  rules: {rules}\n") + entry
    experiment = config.build(document.parse(text, "lab.yaml"), tmp_path)
    recorded = experiment.simulate(experiment.level("2560 mlux"), "train", experiment.load_images()["train"], 1, 4)
    assert recorded.tr is not None and recorded.tr.counts.shape == (15,) and len(recorded.tr) > 0


# --- in a dataset --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = folder_of(tmp_path_factory.mktemp("positions"))
    made(home / "c.yaml", home / "out")
    return home / "out"


@pytest.fixture
def root(dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(dataset, tmp_path / "out"))


def test_positions_travel(dataset: Path, tmp_path: Path) -> None:
    """Twice the same bytes, from the config, from another spelling of it and from the config inside the dataset."""
    home = folder_of(tmp_path / "other", PLACES.replace("x,y", "x (um),y (um)").replace("5.0", "5"))
    made(home / "c.yaml", home / "out")
    assert tree(home / "out") == tree(dataset)
    assert (dataset / "maps/layout.positions.csv").read_text() == (
        "x (um),y (um)\n0,0\n5,0\n2.5,4.33\n-2.5,4.33\n-5,0\n"
    )
    assert "positions: maps/layout.positions.csv" in (dataset / "config.yaml").read_text()
    made(dataset / "config.yaml", tmp_path / "again")
    assert tree(tmp_path / "again") == tree(dataset)
    assert str(dataset.parent) not in (dataset / "manifest.json").read_text()
    stored, live = (spadmnist.open(p)["2560 mlux", "train"] for p in (dataset, dataset / "config.yaml"))
    assert np.array_equal(stored.tr[:].ticks, live.tr[:].ticks) and stored.tr[0].counts.shape == (5,)


def test_a_changed_position_is_another_dataset(dataset: Path, tmp_path: Path) -> None:
    home = folder_of(tmp_path / "moved", PLACES.replace("5.0,0", "5.1,0"))
    with pytest.raises(SpadError, match=r"holds another dataset: maps\.maps/layout\.positions\.csv"):
        made(home / "c.yaml", dataset)


def test_a_changed_position_is_noticed_by_a_run_that_goes_on(dataset: Path, tmp_path: Path) -> None:
    home = folder_of(tmp_path / "home")
    experiment = config.read(home / "c.yaml")
    splits = experiment.load_images()

    class Stopped(Exception):
        pass

    def stop(work: float, note: str) -> None:
        raise Stopped

    with pytest.raises(Stopped):
        factory.generate(experiment, splits, home / "out", 1, factory.Progress(advance=stop))
    (home / "places.csv").write_text(PLACES.replace("-5,0", "-5,0.1"))
    with pytest.raises(SpadError, match="holds another dataset: maps"):
        made(home / "c.yaml", home / "out")
    (home / "places.csv").write_text(PLACES)
    made(home / "c.yaml", home / "out")
    assert tree(home / "out") == tree(dataset)


def delete(path: Path) -> None:
    path.unlink()


def move_a_pixel(path: Path) -> None:
    path.write_text(path.read_text().replace("2.5,4.33", "2.5,4.34", 1))


def no_text(path: Path) -> None:
    path.write_bytes(b"\xff\0")


def a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize("damage", [delete, move_a_pixel, no_text, a_folder])
@pytest.mark.parametrize("more", [False, True])
def test_lost_positions_are_made_again(damage: Any, more: bool, root: Path, dataset: Path) -> None:
    """Also where a shard is damaged as well, which is simulated with them."""
    damage(root / "maps/layout.positions.csv")
    if more:
        shard = next(root.rglob("100_mlux/*/*.zip"))
        shard.write_bytes(b"")
    found = verify.verify(root)
    assert "maps/layout.positions.csv" in {*found.changed, *found.missing}
    did = verify.repair(root, found, 1)
    assert did.count("made again: maps/layout.positions.csv") == 1
    assert not verify.verify(root) and tree(root) == tree(dataset)


def test_a_lost_map_is_still_told(tmp_path: Path) -> None:
    home = folder_of(tmp_path / "home")
    np.save(home / "dcr.npy", np.arange(5.0))
    text = TEXT.replace("{lognormal: {median: 20 Hz, sigma: 1}}", "{file: dcr.npy}")
    (home / "c.yaml").write_text(text)
    made(home / "c.yaml", home / "out")
    shutil.rmtree(home / "out" / "maps")
    with pytest.raises(SpadError, match=r"dark_counts\.rate\.npy: the sensor's map is lost"):
        verify.repair(home / "out", verify.verify(home / "out"), 1)


def test_reconstructions_are_added_to_the_same_dataset(dataset: Path, tmp_path: Path) -> None:
    home = folder_of(tmp_path / "home")
    (home / "c.yaml").write_text(TEXT.replace("[counts]", "[]"))
    made(home / "c.yaml", home / "out")
    factory.add_reconstructions(home / "out", ["counts"], 1)
    assert tree(home / "out") == tree(dataset)


def test_files_of_a_sensor_in_another_folder(tmp_path: Path) -> None:
    """Positions and maps lie beside the sensor's file; workers, which read the resolved config, find them, too."""
    home = folder_of(tmp_path / "home")
    (home / "sensors").mkdir()
    (home / "places.csv").rename(home / "sensors" / "places.csv")
    np.save(home / "sensors" / "dcr.npy", np.arange(5.0))
    text = TEXT.replace("{lognormal: {median: 20 Hz, sigma: 1}}", "{file: dcr.npy}")
    scene, sensor = text[: text.index("sensor:")], text[text.index("sensor:") :]
    (home / "sensors" / "five.yaml").write_text(sensor)
    (home / "c.yaml").write_text(scene + "sensor: sensors/five.yaml\n")
    resolved = config.read(home / "c.yaml").resolved["sensor"]
    assert resolved["layout"]["positions"] == "sensors/places.csv"
    assert resolved["effects"]["dark_counts"]["rate"] == {"file": "sensors/dcr.npy"}
    made(home / "c.yaml", home / "out")
    manifest = json.loads((home / "out" / "manifest.json").read_text())
    assert manifest["config"]["sensor"]["layout"]["positions"] == "maps/layout.positions.csv"
    assert "sensors" not in json.dumps(manifest["config"])
    shutil.rmtree(home / "sensors")
    made(home / "out" / "config.yaml", home / "again")
    assert tree(home / "again") == tree(home / "out")


# --- the SPAD23 ----------------------------------------------------------------------------------------------------


def test_the_spad23_is_a_hexagonal_array() -> None:
    """Rows of 5, 4, 5, 4, 5; the pitch is the width of a regular hexagon of the pixel's area; they touch."""
    layout = config.read(ROOT / "configs" / "spad23.yaml").sensor.layout
    places = layout.positions
    assert places is not None and places.shape == (23, 2)
    pitch = np.sqrt(2 * layout.active_area / np.sqrt(3))
    assert pitch == pytest.approx(23.0e-6, rel=1e-3)
    wanted = [((k - (n - 1) / 2) * pitch, (r - 2) * pitch * np.sqrt(0.75))
              for r, n in enumerate((5, 4, 5, 4, 5)) for k in range(n)]  # fmt: skip
    assert np.abs(places - wanted).max() < 1e-9
    distance = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    touching = (distance > 0) & (distance < 1.2 * pitch)
    assert distance[touching] == pytest.approx(pitch, rel=1e-4)
    # within a row 4 + 3 + 4 + 3 + 4 pairs, and 8 between each two rows
    assert touching.sum() == 2 * (18 + 4 * 8) and touching.sum(axis=1).max() == 6
    assert np.bincount(np.diff(layout.neighbours(1.0).first)).tolist() == np.bincount(touching.sum(axis=1)).tolist()
    assert np.allclose(places.mean(axis=0), 0, atol=1e-12)


def test_the_spad23_meets_its_published_mean(tmp_path: Path) -> None:
    """17.0 kcps; the scatter of 23 pixels' dark counts, and of about 391,000 detections, is far below 2 %."""
    made(ROOT / "configs" / "spad23.yaml", tmp_path / "out", limit=4)
    part = spadmnist.open(tmp_path / "out")["3.457 nW/cm^2", "train"]
    counts = part.tr[:].counts.reshape(4, 23) / 0.1
    assert counts.mean() == pytest.approx(17.0e3, rel=0.02)
    assert part.reconstruction["counts"][0].shape == (1, 23)
