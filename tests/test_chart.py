"""Charts of many images, their tiles had back, and images that come several times."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

import spadmnist
from spadmnist import factory, images, manifest_file, tiles, verify
from spadmnist.errors import InputError, SpadError
from spadmnist.images import Array, Chart, Digits, Images, Uniform

CONFIG = """\
seed: 3
scene: {images: IMAGES, lux: [1 lux]}
recording: {exposure: 100 us, frames: 10, frame_time: 10 us, readouts: [qis]}
sensor: {layout: {rows: 40, columns: 50, pixel_area: 25 um^2}, effects: {detection: {pdp: 0.5}}}
output: {format: FORMAT}
"""
OF = "{source: digits, train: 20, test: 8, rows: 8, columns: 8}"
CHART = f"{{source: chart, of: {OF}, count: 6, columns: 4, pitch: 11}}"


def config_in(folder: Path, images: str = CHART, format: str = "zarr") -> Path:
    folder.mkdir(exist_ok=True)
    file = folder / "chart.yaml"
    file.write_text(CONFIG.replace("IMAGES", images).replace("FORMAT", format))
    return file


def made(file: Path, out: Path) -> Path:
    experiment = spadmnist.config.read(file)
    factory.generate(experiment, experiment.load_images(), out, 1)
    return out


def source_of(raw: dict[str, Any]) -> Any:
    return TypeAdapter[Any](images.ImageSource).validate_python(raw)


# --- the chart ----------------------------------------------------------------------------------------------------


def test_a_chart_is_its_tiles_and_black_between_them() -> None:
    of = Digits(train=20, test=8, rows=8, columns=9)
    splits, originals = Chart(of=of, count=6, columns=4, pitch=11).load((40, 50)), of.load((40, 50))
    assert list(splits) == ["train", "test"]
    for split, part in splits.items():
        laid = part.tiles
        assert laid is not None and part.pixels.shape == (1, 40, 50) and part.labels is None and len(laid) == 6
        assert len(set(laid.numbers.tolist())) == 6 and laid.labels is not None
        assert np.array_equal(laid.cut(part.pixels[0]), originals[split].pixels[laid.numbers])
        assert np.array_equal(laid.labels, originals[split].labels[laid.numbers])  # type: ignore[index]
        assert part.pixels.sum(dtype=int) == originals[split].pixels[laid.numbers].sum(dtype=int)
        # in the middle: (40 - 11 - 8) // 2 rows and (50 - 3 * 11 - 9) // 2 columns above and left of them
        assert laid.corners.tolist() == [[10, 4], [10, 15], [10, 26], [10, 37], [21, 4], [21, 15]]
    alike = Chart(of=Digits(train=20, test=20, rows=8, columns=9), count=20).load((40, 50))
    assert len({str(part.tiles.numbers) for part in alike.values() if part.tiles is not None}) == 2


def test_the_chart_of_the_paper_is_the_default() -> None:
    chart = Chart()
    assert (chart.of.source, chart.count, chart.columns, chart.pitch) == ("mnist", 256, None, None)
    corners = tiles.grid(256, None, None, (28, 28))
    assert tiles.grid(3, 2, None, (8, 9)).tolist() == [[0, 0], [0, 9], [8, 0]]
    assert corners.max() == 15 * 28 and len(np.unique(corners, axis=0)) == 256


def test_the_draw_is_a_function_of_the_seed_alone() -> None:
    """The digits of the lottery are datasets' identity: they must never change."""
    assert tiles.drawn(10, 4, (1, 0)).tolist() == tiles.drawn(10, 10, (1, 0)).tolist()[:4]
    assert tiles.drawn(10, 4, (1, 0)).tolist() == DRAWN
    assert sorted(tiles.drawn(10, 10, (7, 1)).tolist()) == list(range(10))
    often = np.bincount([tiles.drawn(5, 1, (seed, 0))[0] for seed in range(2000)], minlength=5)
    assert (abs(often - 400) < 4.9 * np.sqrt(320)).all()  # each alike; false-alarm rate 5e-6 over the five


DRAWN = [3, 5, 2, 9]


def test_colour_and_other_kinds_of_pixels(tmp_path: Path) -> None:
    rgb = np.arange(3 * 3 * 4 * 5, dtype=np.uint16).reshape(3, 3, 4, 5)
    np.save(tmp_path / "rgb.npy", rgb)
    part = Chart(of=Array(path="rgb.npy"), count=3, columns=1).load((12, 7), base=tmp_path)["train"]
    assert part.pixels.shape == (1, 3, 12, 7) and part.pixels.dtype == np.uint16 and part.white == 65535
    assert part.tiles is not None and part.tiles.labels is None
    assert np.array_equal(np.moveaxis(part.tiles.cut(part.pixels), 1, 0)[0], rgb[part.tiles.numbers])


@pytest.mark.parametrize(
    ("chart", "shape", "sentence"),
    [
        ({"count": 9}, (99, 99), r"count: 9 tiles cannot be drawn from the 8 test images of .*; ask for at most 8"),
        ({"count": 4, "pitch": 7}, (99, 99), r"pitch: tiles of 8 x 8 pixels would overlap .*; give at least 8"),
        (
            {"count": 8, "columns": 3},
            (23, 24),
            r"the chart of 8 tiles of 8 x 8 pixels is 24 x 24 pixels .* larger than the sensor's 23 x 24; lower count",
        ),
        ({"count": 8, "columns": 8, "pitch": 10}, (99, 77), r"is 8 x 78 pixels .* larger than the sensor's 99 x 77"),
    ],
)
def test_what_no_chart_can_be(chart: dict[str, Any], shape: tuple[int, int], sentence: str) -> None:
    of = Digits(train=9, test=8, rows=8, columns=8)
    with pytest.raises(InputError, match=sentence):
        Chart(of=of, **chart).load(shape)


def test_a_chart_as_large_as_the_sensor_is_one() -> None:
    part = Chart(of=Digits(train=9, test=0, rows=8, columns=8), count=9).load((24, 24))["train"]
    assert part.tiles is not None and part.tiles.corners.min() == 0 and part.tiles.corners.max() == 16


def test_an_image_of_another_size_has_no_tiles() -> None:
    part = Chart(of=Digits(train=9, test=0, rows=8, columns=8), count=9).load((24, 25))["train"]
    assert part.tiles is not None
    with pytest.raises(SpadError, match=r"24 x 24 pixels is not of this chart, which has 24 x 25"):
        part.tiles.cut(np.zeros((24, 24)))


# --- repetitions --------------------------------------------------------------------------------------------------


def test_every_image_comes_as_often_with_its_label() -> None:
    once, thrice = Digits(train=5, test=2), Digits(train=5, test=2, repetitions=3)
    for split, part in thrice.load((28, 28)).items():
        single = once.load((28, 28))[split]
        assert np.array_equal(part.pixels, np.repeat(single.pixels, 3, axis=0))
        assert part.labels is not None and part.labels.tolist() == np.repeat(single.labels, 3).tolist()
    assert [len(part) for part in thrice.load((28, 28), limit=4).values()] == [4, 4]
    assert np.array_equal(thrice.load((28, 28), limit=4)["train"].pixels, thrice.load((28, 28))["train"].pixels[:4])


def test_repetitions_of_one_image_take_no_memory() -> None:
    chart = Chart(of=Digits(train=9, test=0, rows=8, columns=8), count=9, repetitions=10**6)
    part = chart.load((512, 512))["train"]
    assert len(part) == 10**6 and part.pixels.strides[0] == 0 and part.tiles is not None
    assert part.sha256 != Chart(of=chart.of, count=9).load((512, 512))["train"].sha256
    assert len(Uniform(repetitions=1).load((4, 4))["train"]) == 1


def test_too_many_repetitions_are_refused() -> None:
    with pytest.raises(InputError, match=r"1000000 repetitions of 400 \+ 100 digits .* ask for fewer"):
        Digits(repetitions=10**6).load((28, 28))
    assert len(Digits(repetitions=10**6).load((28, 28), limit=7)["train"]) == 7


def test_a_key_at_its_default_changes_no_identity(tmp_path: Path) -> None:
    digits = "{source: digits, train: 4, test: 2, rows: 40, columns: 50"
    bare, said = (spadmnist.config.read(config_in(tmp_path, digits + more)) for more in ("}", ", repetitions: 1}"))
    assert bare.resolved == said.resolved and "repetitions" not in bare.resolved["scene"]["images"]
    assert factory.identity(bare, bare.load_images()) == factory.identity(said, said.load_images())
    assert "tiles" not in json.dumps(factory.identity(bare, bare.load_images()))


# --- a dataset of charts ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("format", ["zarr", "hdf5"])
def test_tiles_are_had_back_from_a_dataset_and_from_its_config(format: str, tmp_path: Path) -> None:
    repeated = CHART.replace("count", "repetitions: 3, count")
    file = config_in(tmp_path, repeated, format)
    stored, simulated = spadmnist.open(made(file, tmp_path / "out")), spadmnist.open(file)
    for split in ("train", "test"):
        part, other = stored["1 lux", split], simulated["1 lux", split]
        assert len(part) == 3 and part.labels is None
        assert part.tiles.facts() == other.tiles.facts()
        assert np.array_equal(part.tiles.cut(part.images[0]), other.tiles.cut(other.images[2]))
        counts = part.tiles.cut(part.reconstruction["qis_counts"][:])
        assert counts.shape == (6, 3, 8, 8) and counts.sum() == part.reconstruction["qis_counts"][:].sum()
        assert part[1:].tiles.facts() == part.tiles.facts()
        assert spadmnist.concatenate([part, other]).tiles.facts() == part.tiles.facts()
    with pytest.raises(SpadError, match="not of one chart"):
        spadmnist.concatenate([stored["1 lux", "train"], stored["1 lux", "test"]]).tiles  # noqa: B018


def test_images_of_no_chart_have_no_tiles(tmp_path: Path) -> None:
    part = spadmnist.open(config_in(tmp_path, "{source: uniform}"))["1 lux"]
    with pytest.raises(SpadError, match=r"not of one chart; scene\.images of a chart has source: chart"):
        part.tiles  # noqa: B018


def test_a_dataset_of_a_chart_is_verified_and_repaired(tmp_path: Path) -> None:
    file = config_in(tmp_path)
    root = made(file, tmp_path / "out")
    assert not verify.verify(root)
    before = {p: p.read_bytes() for p in root.rglob("*") if p.is_file()}
    hurt = next(p for p in sorted(before) if "1_lux" in str(p) and p.suffix == ".zip")
    hurt.write_bytes(b"x")
    (root / manifest_file.CONFIG).unlink()
    verify.repair(root, verify.verify(root), 1)
    assert {p: p.read_bytes() for p in root.rglob("*") if p.is_file()} == before


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda t: t["corners"].__setitem__(0, [39, 0]), "a tile leads beyond the chart of 40 x 50 pixels"),
        (lambda t: t["labels"].pop(), "there are 5 for 6 tiles"),
        (lambda t: t["numbers"].append(1), "there are 7 for 6 tiles"),
        (lambda t: t.__setitem__("size", [8]), "size"),
    ],
)
def test_a_manifest_that_lies_of_tiles_is_refused(change: Any, sentence: str, tmp_path: Path) -> None:
    root = made(config_in(tmp_path), tmp_path / "out")
    manifest = json.loads((root / manifest_file.MANIFEST).read_text())
    change(manifest["images"]["splits"]["train"]["tiles"])
    assert any(sentence in problem for problem in spadmnist.manifest.problems(manifest, "manifest.json"))


def test_images_are_told_what_they_are_of() -> None:
    part: Images = Chart(of=Digits(train=9, test=0), count=4).load((60, 60))["train"]
    assert part.head(1).tiles is part.tiles and part.repeated(2).tiles is part.tiles
    assert source_of({"source": "chart", "of": {"source": "uniform"}, "count": 1}).describe().startswith("chart of 1")
