"""Pictures as users have them: of any size and kind, on a background or none, turned, in sRGB."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from pydantic import TypeAdapter

from spadmnist import config, document
from spadmnist import images as module
from spadmnist.cli import cli
from spadmnist.errors import ConfigError, InputError
from spadmnist.images import Folder, Images, ImageSource
from spadmnist.photos import Making, srgb_to_light

RNG = np.random.Generator(np.random.Philox(5))
GREY = RNG.integers(0, 256, (6, 9), np.uint8)
RGB = RNG.integers(0, 256, (6, 9, 3), np.uint8)
DEEP = RNG.integers(0, 65536, (6, 9)).astype(np.uint16)


def save(path: Path, array: np.ndarray, mode: str | None = None, **options: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(array)
    (image.convert(mode) if mode else image).save(path, **options)


def load(root: Path, **options: Any) -> Images:
    return Folder(path=root.name, **options).load((1, 1), base=root.parent)["train"]


def light_of(values: np.ndarray) -> np.ndarray:
    """sRGB to light, value by value, as the standard writes it."""
    found = [v / 255 / 12.92 if v / 255 <= 0.04045 else ((v / 255 + 0.055) / 1.055) ** 2.4 for v in values.ravel()]
    return np.array(found).reshape(values.shape)


def luminance(light: np.ndarray) -> np.ndarray:
    """(rows, columns, 3) -> (rows, columns), Rec. 709."""
    return light @ np.array([0.2126, 0.7152, 0.0722])


# --- light -------------------------------------------------------------------------------------------------------


def test_srgb_is_taken_back_to_light(tmp_path: Path) -> None:
    """Every value of eight bits has a level of its own, and half of white is 21 % of the light."""
    ramp = np.arange(256, dtype=np.uint8).reshape(16, 16)
    save(tmp_path / "f" / "a.png", ramp)
    part = load(tmp_path / "f", gamma="srgb")
    assert part.pixels.dtype == np.uint16 and part.white == 65535
    assert np.abs(part.pixels[0] / part.white - light_of(ramp)).max() < 1 / 65535
    assert len(np.unique(part.pixels)) == 256 and part.pixels.max() == 65535
    assert srgb_to_light(np.array([0.5]))[0] == pytest.approx(0.2140, abs=1e-4)
    assert np.array_equal(load(tmp_path / "f", gamma="linear").pixels[0], ramp)


def test_white_is_the_light_of_its_level(tmp_path: Path) -> None:
    save(tmp_path / "f" / "a.png", np.array([[0, 100, 200]], np.uint8))
    part = load(tmp_path / "f", gamma="srgb", white=200)
    assert part.pixels[0].tolist() == [[0, round(65535 * float(srgb_to_light(np.array(0.5)))), 65535]]
    with pytest.raises(InputError, match=r"grey level 200, but white is 150"):
        load(tmp_path / "f", gamma="srgb", white=150)


def test_grey_is_the_luminance_of_light(tmp_path: Path) -> None:
    save(tmp_path / "f" / "a.png", RGB)
    part = load(tmp_path / "f", grey=True, gamma="srgb")
    assert part.pixels.shape == (1, 6, 9)
    assert np.abs(part.pixels[0] / 65535 - luminance(light_of(RGB))).max() < 1.5 / 65535
    linear = load(tmp_path / "f", grey=True)
    assert linear.pixels.dtype == np.uint8 and np.abs(linear.pixels[0] - luminance(RGB)).max() <= 0.501
    assert load(tmp_path / "f", gamma="srgb").pixels.shape == (1, 3, 6, 9)


def test_grey_and_colour_of_8_and_16_bits_in_one_folder(tmp_path: Path) -> None:
    save(tmp_path / "f" / "a.png", RGB)
    save(tmp_path / "f" / "b.png", GREY)
    save(tmp_path / "f" / "c.png", DEEP)
    with pytest.raises(InputError, match="set resize, or grey"):
        load(tmp_path / "f")
    part = load(tmp_path / "f", grey=True, gamma="srgb")
    assert part.pixels.shape == (3, 6, 9)
    assert np.abs(part.pixels[2] / 65535 - srgb_to_light(DEEP / 65535)).max() < 1.5 / 65535


def test_sixteen_bits_stay_sixteen(tmp_path: Path) -> None:
    save(tmp_path / "f" / "a.png", np.full((8, 8), 40001, np.uint16))
    part = load(tmp_path / "f", resize=4)
    assert part.pixels.dtype == np.uint16 and part.white == 65535 and (part.pixels == 40001).all()


# --- size --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fit", ["crop", "pad", "stretch"])
def test_size(tmp_path: Path, fit: str) -> None:
    """A picture whose left half is black: where the edge lies tells how it was fitted. The picture is 2 : 1."""
    halves = np.zeros((40, 80), np.uint8)
    halves[:, 40:] = 240
    save(tmp_path / "f" / "a.png", halves)
    image = load(tmp_path / "f", resize=20, fit=fit).pixels[0]
    assert image.shape == (20, 20) and image.max() == 240
    middle = image[10]
    assert (middle[:9] == 0).all() and (middle[11:] == 240).all()
    rows = image[:, 15]
    assert (rows[6:14] == 240).all()
    assert (rows[:4] == (0 if fit == "pad" else 240)).all() and (rows[-4:] == (0 if fit == "pad" else 240)).all()


def test_crop_keeps_the_middle_and_stretch_keeps_all(tmp_path: Path) -> None:
    columns = np.repeat(np.arange(0, 240, 3, dtype=np.uint8)[None], 40, axis=0)  # 40 x 80, 0 to 237
    save(tmp_path / "f" / "a.png", columns)
    cut, whole = (
        load(tmp_path / "f", resize=[20, 20], fit=fit).pixels[0, 10].astype(int) for fit in ("crop", "stretch")
    )
    assert abs(cut[0] - 61) <= 1 and abs(cut[-1] - 176) <= 1  # the middle half, means of two columns
    assert whole[0] < 8 and whole[-1] > 229


@given(
    st.sampled_from(["crop", "pad", "stretch"]),
    st.tuples(st.integers(1, 40), st.integers(1, 40)),
    st.tuples(st.integers(1, 40), st.integers(1, 40)),
    st.integers(0, 255),
)
@settings(max_examples=60, deadline=None)
def test_even_light_stays_even(fit: str, held: tuple[int, int], wanted: tuple[int, int], grey: int) -> None:
    """Whatever the sizes: an even picture is even, but for the black that `pad` puts around it."""
    made = Making(wanted, fit).image(np.full(held, grey, np.uint8), None, 255.0)
    assert made.shape == wanted and made.dtype == np.uint8
    assert set(np.unique(made)) <= ({0, grey} if fit == "pad" else {grey}) and (made == grey).any()


@given(st.integers(0, 2**32 - 1), st.tuples(st.integers(1, 30), st.integers(1, 30)))
@settings(max_examples=40, deadline=None)
def test_no_light_is_invented(seed: int, wanted: tuple[int, int]) -> None:
    pixels = np.random.Generator(np.random.Philox(seed)).integers(40, 200, (3, 17, 23), np.uint8)
    made = Making(wanted, "stretch").image(pixels, None, 255.0)
    assert made.shape == (3, *wanted) and made.min() >= pixels.min() and made.max() <= pixels.max()


def test_light_is_averaged_not_values(tmp_path: Path) -> None:
    """A fine pattern of black and white is half of white's light; the mean of its values would say 21 %."""
    fine = (np.indices((64, 64)).sum(axis=0) % 2 * 255).astype(np.uint8)
    save(tmp_path / "f" / "a.png", fine)
    part = load(tmp_path / "f", resize=8, gamma="srgb")
    assert np.abs(part.pixels[0, 1:-1, 1:-1] / 65535 - 0.5).max() < 0.02


def test_pictures_of_many_sizes(tmp_path: Path) -> None:
    for i, size in enumerate([(3, 4), (50, 20), (7, 7)]):
        save(tmp_path / "f" / f"{i}.png", np.full(size, 10 * i, np.uint8))
    with pytest.raises(InputError, match="set resize"):
        load(tmp_path / "f")
    assert [image.max() for image in load(tmp_path / "f", resize=[5, 6]).pixels] == [0, 10, 20]


# --- what stands in a picture ------------------------------------------------------------------------------------


def test_transparent_parts_are_black(tmp_path: Path) -> None:
    alpha = np.arange(54, dtype=np.uint8).reshape(6, 9) * 4
    save(tmp_path / "f" / "a.png", np.dstack([RGB, alpha]))
    save(tmp_path / "f" / "b.png", RGB)
    part = load(tmp_path / "f")
    over = RGB.transpose(2, 0, 1) * (alpha / 255)
    assert part.pixels.dtype == np.uint8 and np.abs(part.pixels[0] - over).max() <= 0.501
    assert np.array_equal(part.pixels[1], RGB.transpose(2, 0, 1)) and part.transparent == 1
    lit = load(tmp_path / "f", gamma="srgb")
    assert np.abs(lit.pixels[0] / 65535 - light_of(RGB).transpose(2, 0, 1) * (alpha / 255)).max() < 1.5 / 65535


def test_a_transparent_grey_level_is_black(tmp_path: Path) -> None:
    save(tmp_path / "f" / "a.png", np.arange(12, dtype=np.uint8).reshape(3, 4), transparency=5)
    assert load(tmp_path / "f").pixels.ravel().tolist() == [0, 1, 2, 3, 4, 0, 6, 7, 8, 9, 10, 11]


def test_exif_turns_where_it_is_asked_for(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was held upright: turn by 90 degrees, clockwise
    save(tmp_path / "f" / "a.png", GREY, exif=exif)
    assert np.array_equal(load(tmp_path / "f").pixels[0], GREY)
    assert np.array_equal(load(tmp_path / "f", exif=True).pixels[0], np.rot90(GREY, -1))


# --- what is said ------------------------------------------------------------------------------------------------


def test_labels_and_what_was_left_out_are_said(tmp_path: Path) -> None:
    root = tmp_path / "f"
    for i in range(14):
        save(root / f"c{i:02d}" / "a.png", np.dstack([RGB, GREY]) if i < 2 else RGB)
    (root / "notes.txt").write_text("no image")
    said = module.notes({"train": load(root)})
    assert said[0].startswith("the labels are the class folders: 0 c00, 1 c01") and said[0].endswith(
        "11 c11 and 2 more"
    )
    assert said[1:] == [
        "1 file of the folder is no image and is left out",
        "2 pictures have transparent parts, which are black",
    ]


def test_pictures_beside_the_splits_are_said_apart(tmp_path: Path) -> None:
    root = tmp_path / "f"
    for name in ("train/ant/a.png", "test/b.png", "val/1.png", "val/2.png", "val/bee/3.png", "cover.png"):
        save(root / name, GREY)
    (root / "train" / "notes.txt").write_text("no image")
    said = module.notes(module.Folder(path="f").load((3, 4), base=tmp_path))
    assert said == [
        "the labels are the class folders: 0 ant",
        "the test images lie in no class folders, and have no labels",
        "1 picture is in the folder itself, and neither in train/ nor in test/: left out",
        "3 pictures are in val/, which is neither train nor test, and left out",
        "1 file of the folder is no image and is left out",
    ]


def test_a_folder_in_a_config(tmp_path: Path) -> None:
    """From photographs to a dataset; the labels are said."""
    for name, size in (("ant/a.png", (30, 40)), ("bee/b.png", (50, 20))):
        save(tmp_path / "photos" / name, np.full((*size, 3), 200, np.uint8))
    (tmp_path / "a.yaml").write_text(
        "seed: 1\n"
        "scene: {images: {source: folder, path: photos, resize: 8, grey: true, gamma: srgb}, lux: [80 mlux]}\n"
        "recording: {exposure: 1 ms, readouts: [tr]}\n"
        "sensor: {layout: {rows: 8, columns: 8, pixel_area: 25 um^2}, effects: {detection: {pdp: 0.5}}}\n"
    )
    done = CliRunner().invoke(cli, ["generate", str(tmp_path / "a.yaml"), "-o", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    assert "the labels are the class folders: 0 ant, 1 bee" in done.output
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    held = manifest["config"]["scene"]["images"]
    assert held == {"source": "folder", "path": "photos", "resize": [8, 8], "grey": True, "gamma": "srgb"}
    assert manifest["images"]["dtype"] == "uint16" and manifest["images"]["white"] == 65535


def test_a_dataset_is_repaired_from_a_folder_that_moved(tmp_path: Path) -> None:
    """The config names it by an absolute path; --images-dir stands for that."""
    for i in range(3):
        save(tmp_path / "photos" / f"{i}.png", GREY)
    (tmp_path / "a.yaml").write_text(
        "seed: 1\n"
        f"scene: {{images: {{source: folder, path: {tmp_path / 'photos'}}}, lux: [80 mlux]}}\n"
        "recording: {exposure: 1 ms, readouts: [tr]}\n"
        "sensor: {layout: {rows: 6, columns: 9, pixel_area: 25 um^2}, effects: {detection: {pdp: 0.5}}}\n"
    )
    out = tmp_path / "out"
    assert CliRunner().invoke(cli, ["generate", str(tmp_path / "a.yaml"), "-o", str(out)]).exit_code == 0
    (tmp_path / "photos").rename(tmp_path / "moved")
    lost = [path for path in out.glob("data/**/*") if path.is_file()]
    before = [path.read_bytes() for path in lost]
    for path in lost:
        path.unlink()
    repair = ["verify", str(out), "--repair"]
    done = CliRunner().invoke(cli, repair)
    assert isinstance(done.exception, InputError) and "there is no folder" in str(done.exception)
    assert CliRunner().invoke(cli, [*repair, "--images-dir", str(tmp_path / "moved")]).exit_code == 0
    assert [path.read_bytes() for path in lost] == before


# --- mistakes ----------------------------------------------------------------------------------------------------


def problems(images: str) -> list[str]:
    text = (
        f"seed: 1\nscene:\n  images: {images}\n  lux: [5 mlux]\nrecording: {{exposure: 1 ms, readouts: [tr]}}\n"
        "sensor: {layout: {rows: 8, columns: 8, pixel_area: 25 um^2}, effects: {detection: {}}}\n"
    )
    with pytest.raises(ConfigError) as caught:
        config.build(document.parse(text, "lab.yaml"), Path())
    return list(caught.value.problems)


@pytest.mark.parametrize(
    ("keys", "parts"),
    [
        ("resize: 0", ["lab.yaml:3: scene.images.resize", "0 is not a size", "[rows, columns]"]),
        ("resize: [8]", ["resize", "[8] is not a size"]),
        ("resize: [8, 8.0]", ["resize", "is not a size"]),
        ("resize: 8 um", ["resize", "is not a size"]),
        ("resize: true", ["resize", "True is not a size"]),
        ("resize: 100000", ["resize", "together at most"]),
        ("resize: 8, fit: cut", ["fit", "'cut' is not one of crop, pad, stretch"]),
        ("fit: pad", ["scene.images", "fit says how", "add resize"]),
        ("gamma: 2.2", ["gamma", "2.2 is not one of linear, srgb"]),
        ("grey: 1", ["grey", "1 is not possible", "true or false"]),
        ("exif: yes", ["exif", "'yes' is not possible", "true or false"]),
    ],
)
def test_mistakes(keys: str, parts: list[str]) -> None:
    (said,) = problems(f"{{source: folder, path: photos, {keys}}}")
    for part in parts:
        assert part in said, said


@pytest.mark.parametrize("key", ["resize: 8", "gamma: srgb", "exif: true", "fit: pad"])
@pytest.mark.parametrize("source", ["mnist", "idx", "array", "digits"])
def test_other_sources_refuse_what_is_a_folders(source: str, key: str) -> None:
    more = {"idx": ", train_images: a", "array": ", path: a"}.get(source, "")
    (said,) = problems(f"{{source: {source}{more}, {key}}}")
    assert "belongs to the source folder" in said and f"this is {source}" in said


def test_one_size_has_one_identity() -> None:
    kinds = [
        TypeAdapter(ImageSource).validate_python({"source": "folder", "path": "a", "resize": r}) for r in (8, [8, 8])
    ]
    assert kinds[0].written() == kinds[1].written()
    plain = TypeAdapter(ImageSource).validate_python(
        {"source": "folder", "path": "a", "gamma": "linear", "exif": False}
    )
    assert plain.written() == {"source": "folder", "path": "a"}


def test_a_folder_of_the_wrong_size_is_told_of_resize(tmp_path: Path) -> None:
    save(tmp_path / "f" / "a.png", GREY)
    with pytest.raises(InputError, match=r"resize: \[8, 7\]"):
        module.check_size({"train": load(tmp_path / "f")}, (8, 7), "sensor.layout")
