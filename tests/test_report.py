"""The level table says what the arrays hold; the sheet is a picture, and always the same one."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import spadmnist
from spadmnist import config, dataset, document, factory, report
from spadmnist.dataset import Dataset
from spadmnist.errors import SpadError
from spadmnist.report import _sheet

CONFIG = """
seed: 3
scene:
  images: {images}
  wavelength: 555 nm
  lux: {lux}
recording: {{exposure: 1 ms, frames: 100, frame_time: 10 us, frame_period: 10 us, readouts: {readouts}}}
sensor:
  name: test sensor
  rules: paper
  layout: {{rows: {rows}, columns: {columns}, pixel_area: 25 um^2}}
  effects:
    detection: {{pdp: 0.5}}
    dark_counts: {{rate: 100 Hz}}
    dead_time: {{duration: 50 ns}}
    tdc: {{resolution: 10 ps}}
output: {{format: {format}}}
"""
DIGITS = "{source: digits, train: 12, test: 5}"


def text_of(
    images: str = DIGITS,
    lux: str = "[2560 mlux, 40 mlux]",
    readouts: str = "[tr, str, qis]",
    shape: tuple[int, int] = (28, 28),
    format: str = "zarr",
) -> str:
    rows, columns = shape
    return CONFIG.format(images=images, lux=lux, readouts=readouts, rows=rows, columns=columns, format=format)


def simulated(base: Path, **values: Any) -> Dataset:
    return dataset.simulated(config.build(document.parse(text_of(**values), "test"), base))


def generated(root: Path, **values: Any) -> dict[str, Any]:
    experiment = config.build(document.parse(text_of(**values), "test"), root.parent)
    return factory.generate(experiment, experiment.load_images(), root, 1).manifest


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    root = tmp_path_factory.mktemp("report") / "out"
    return root, generated(root)


def picture(ds: Dataset, path: Path, **options: Any) -> np.ndarray:
    report.sheet(ds, path, **options)
    with Image.open(path) as image:
        assert image.format == "PNG"
        assert not image.info.keys() - {"dpi"}  # no time, no version
        return np.asarray(image.convert("RGB"))


# --- the table ----------------------------------------------------------------------------------------------


def test_rows_are_what_the_arrays_hold(made: tuple[Path, dict[str, Any]]) -> None:
    root, manifest = made
    ds = spadmnist.open(root)
    rows = report.level_rows(manifest)
    names = [(row["level"], row["split"]) for row in rows]
    assert names == [(level, split) for level in ("2560 mlux", "40 mlux") for split in ("train", "test")]
    for row in rows:
        part = ds[row["level"], row["split"]]
        counts = part.tr[:].counts
        ones = part.qis[:]
        assert row["images"] == len(part)
        assert row["pixels"] == counts.size
        assert row["detections"] == counts.sum()
        assert row["mean_per_pixel"] == pytest.approx(counts.mean(), rel=1e-12)
        assert row["empty_share"] == pytest.approx((counts == 0).mean(), rel=1e-12)
        assert row["ones"] == ones.sum()
        assert row["density"] == pytest.approx(ones.mean(), rel=1e-12)
        assert row["saturated_total"] == sum(row["saturated_pixels"].values())
        assert row["bytes"] == sum(row["bytes_by_kind"].values())
        folder = root / "data" / row["level"].replace(" ", "_") / row["split"]
        members = [info for file in folder.iterdir() for info in zipfile.ZipFile(file).infolist()]
        tr = sum(info.file_size for info in members if info.filename.startswith("tr/"))
        assert row["bytes"] == sum(file.stat().st_size for file in folder.iterdir())
        assert row["bits_per_detection"] == pytest.approx(8 * tr / counts.sum(), rel=1e-12)
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows


def test_the_table_sums_the_splits_and_fits_a_terminal(made: tuple[Path, dict[str, Any]]) -> None:
    root, manifest = made
    table = report.level_table(manifest)
    both = [row for row in report.level_rows(manifest) if row["level"] == "2560 mlux"]
    line = next(x for x in table.splitlines() if x.startswith("2560 mlux"))
    assert f"{sum(row['detections'] for row in both):,}" in line
    assert f"{sum(row['ones'] for row in both):,}" in line
    assert "12 train and 5 test" in table
    files = [f for f in root.rglob("*") if f.is_file()]
    assert f"in {len(files):,} files, zarr" in table
    for text in (table, report.level_table(manifest, by_split=True)):
        assert all(len(line) <= 100 and line == line.rstrip() for line in text.splitlines())
    for value in manifest["normalisation"]["2560 mlux"].values():
        assert f"{value:,.0f}" in table


def test_saturated_pixels_are_explained_where_there_are_any(made: tuple[Path, dict[str, Any]]) -> None:
    manifest = json.loads(json.dumps(made[1]))
    assert "saturated:" not in report.level_table(manifest)
    manifest["statistics"]["40 mlux"]["test"]["saturated_pixels"]["inter_photon"] = 1234
    table = report.level_table(manifest)
    assert "saturated: " in table
    assert "inter_photon 1,234;" in table


def test_a_large_dataset_still_fits(made: tuple[Path, dict[str, Any]]) -> None:
    def times(value: Any, factor: int) -> Any:
        if isinstance(value, dict):
            return {key: times(item, factor) for key, item in value.items()}
        return value * factor

    manifest = {**made[1], "statistics": times(made[1]["statistics"], 70_000 // 17)}
    assert all(len(line) <= 100 for line in report.level_table(manifest).splitlines())
    assert all(len(line) <= 100 for line in report.level_table(manifest, by_split=True).splitlines())


@pytest.mark.parametrize(("readouts", "absent"), [("[qis]", "detections"), ("[tr]", "ones")])
def test_what_was_not_recorded_is_none(tmp_path: Path, readouts: str, absent: str) -> None:
    manifest = generated(tmp_path / "out", readouts=readouts, lux="[40 mlux]", format="hdf5")
    rows = report.level_rows(manifest)
    assert all(row[absent] is None for row in rows)
    assert all(row["bits_per_detection"] is None for row in rows)  # one file a shard: not told apart
    assert " - " in report.level_table(manifest)


def test_the_mean_of_frames_is_that_of_frames_with_a_detection(tmp_path: Path) -> None:
    """The mean count per pixel that papers state of QIS; with TR the mean is that of its detections."""
    manifest = generated(tmp_path / "qis", readouts="[qis]", lux="[2560 mlux]")
    (row, _), frames = report.level_rows(manifest), spadmnist.open(tmp_path / "qis")["2560 mlux", "train"].qis[:]
    assert row["mean_per_pixel"] == pytest.approx(frames.sum(axis=1).mean(), rel=1e-12) and row["detections"] is None
    both = generated(tmp_path / "both", readouts="[tr, qis]", lux="[2560 mlux]")
    (row, _), events = report.level_rows(both), spadmnist.open(tmp_path / "both")["2560 mlux", "train"].tr[:]
    assert row["mean_per_pixel"] == pytest.approx(events.counts.mean(), rel=1e-12)
    assert row["mean_per_pixel"] > row["ones"] / row["pixels"]
    for made, what in ((manifest, "ones"), (both, "detections")):
        rows = report.level_rows(made)
        mean = sum(row[what] for row in rows) / sum(row["pixels"] for row in rows)
        line = next(x for x in report.level_table(made).splitlines() if x.startswith("2560 mlux"))
        assert f" {mean:#.4g} " in line


# --- the sheet ----------------------------------------------------------------------------------------------


def test_the_sheet_is_the_same_from_disk_and_from_the_config(made: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    stored = picture(spadmnist.open(made[0]), tmp_path / "stored.png")
    again = picture(simulated(tmp_path), tmp_path / "simulated.png")
    assert np.array_equal(stored, again)
    assert (tmp_path / "stored.png").read_bytes() == (tmp_path / "simulated.png").read_bytes()


def test_the_users_settings_change_nothing(made: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    import matplotlib

    report.sheet(spadmnist.open(made[0]), tmp_path / "plain.png")
    with matplotlib.rc_context({"font.family": "serif", "text.color": "red", "savefig.dpi": 300}):
        report.sheet(spadmnist.open(made[0]), tmp_path / "styled.png")
        assert matplotlib.rcParams["text.color"] == "red"
    assert (tmp_path / "plain.png").read_bytes() == (tmp_path / "styled.png").read_bytes()


def test_rows_go_from_dark_to_bright_and_hold_the_originals(tmp_path: Path) -> None:
    ds = simulated(tmp_path)
    page = picture(ds, tmp_path / "both.png", count=1)
    one = picture(ds, tmp_path / "one.png", levels=["2560 mlux"], count=1)
    cell = 168  # 28 pixels, six points each
    assert page.shape[0] - one.shape[0] == cell + _sheet._CAPTION
    x = _left_edge(one)
    original = one[_sheet._TOP :: 6, x::6][:28, :28]
    shown = ds["2560 mlux", "train"].images[0]
    assert np.array_equal(original, np.repeat(np.round(shown / shown.max() * 255)[..., None], 3, -1))
    bright = page[_sheet._TOP + cell + _sheet._CAPTION :][:cell, x : x + cell]
    assert np.array_equal(bright, one[_sheet._TOP :][:cell, x : x + cell])
    assert len(np.unique(one.reshape(-1, 3), axis=0)) > 100


def _left_edge(page: np.ndarray) -> int:
    """Where the first cell begins: the first column that is black from the top of the cells on."""
    inside = page[_sheet._TOP : _sheet._TOP + 12]
    return int(np.flatnonzero((inside == 0).all(axis=(0, 2)))[0])


def test_different_labels_are_shown(tmp_path: Path) -> None:
    part = simulated(tmp_path)["40 mlux", "train"]
    assert part.labels is not None
    indices = _sheet._different(part, 6)
    assert len({int(part.labels[i]) for i in indices}) == 6
    assert len(_sheet._different(part, 100)) == 12


@pytest.mark.parametrize("readouts", ["[tr]", "[str]", "[qis]"])
def test_missing_readouts_are_left_out(tmp_path: Path, readouts: str) -> None:
    part = picture(simulated(tmp_path, readouts=readouts), tmp_path / "part.png", count=1)
    full = picture(simulated(tmp_path), tmp_path / "full.png", count=1)
    assert part.shape[1] < full.shape[1]


@pytest.mark.parametrize("shape", [(1, 23), (40, 3), (16, 16)])
def test_uniform_light_without_labels_on_any_shape(tmp_path: Path, shape: tuple[int, int]) -> None:
    ds = simulated(tmp_path, images="{source: uniform, repetitions: 3}", shape=shape)
    assert ds["40 mlux"].labels is None
    assert picture(ds, tmp_path / "uniform.png").std() > 5


def test_darkness_is_drawn(tmp_path: Path) -> None:
    text = text_of(images="{source: uniform, repetitions: 2, grey: 0}", shape=(4, 4))
    text = text.replace("rate: 100 Hz", "rate: 0 Hz")
    ds = dataset.simulated(config.build(document.parse(text, "dark"), tmp_path))
    picture(ds, tmp_path / "dark.png")


@pytest.mark.parametrize(("channels", "size"), [(3, (20, 30)), (2, (9, 9)), (1, (200, 300))])
def test_colour_and_large_images(tmp_path: Path, channels: int, size: tuple[int, int]) -> None:
    rows, columns = size
    rng = np.random.default_rng(1)
    pixels = rng.integers(0, 256, (2, channels, rows, columns)).astype(np.uint8)
    np.save(tmp_path / "images.npy", pixels if channels > 1 else pixels[:, 0])
    ds = simulated(tmp_path, images="{source: array, path: images.npy}", shape=size)
    page = picture(ds, tmp_path / "colour.png")
    inside = page[_sheet._TOP : _sheet._TOP + 100, 110:200].astype(int)
    assert (np.ptp(inside, axis=2).max() > 100) == (channels == 3)


def test_means_over_squares_and_their_smaller_edges() -> None:
    image = np.arange(15, dtype=np.uint8).reshape(1, 3, 5, 1) * 10
    reduced = _sheet._reduced(image, 2)[0, :, :, 0]
    assert reduced.tolist() == [[30, 50, 65], [105, 125, 140]]


def test_the_scale_of_times_is_round() -> None:
    times = np.array([1.3e-6, 0.97e-3, np.inf])
    assert _sheet._time_scale([times]) == pytest.approx((1e-6, 1e-3))
    assert _sheet._time_scale([np.array([3e-6])]) == pytest.approx((5e-7, 5e-6))
    assert _sheet._time_scale([np.array([np.inf])]) is None
    assert _sheet._time_scale([]) is None


def test_a_level_or_a_place_that_is_not_there(tmp_path: Path) -> None:
    ds = simulated(tmp_path)
    with pytest.raises(KeyError, match="7 mlux"):
        report.sheet(ds, tmp_path / "x.png", levels=["7 mlux"])
    with pytest.raises(SpadError, match="cannot be written"):
        report.sheet(ds, tmp_path / "nowhere" / "x.png", count=1)


def test_the_bytes_are_a_png(tmp_path: Path) -> None:
    report.sheet(simulated(tmp_path), tmp_path / "x.png")
    raw = (tmp_path / "x.png").read_bytes()
    assert b"tEXt" not in raw
    Image.open(io.BytesIO(raw)).verify()
