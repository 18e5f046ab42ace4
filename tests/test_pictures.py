"""Pixels are drawn where they lie, each in the shape that its neighbours leave it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from spadmnist import config, dataset, document, fluxes, measurement, pictures, report
from spadmnist.cli import cli
from spadmnist.effects import Conditions
from spadmnist.events import Events, Layout
from spadmnist.positions import positions_text
from spadmnist.recording import Capture, Light, Recording
from spadmnist.report import _sheet


def hexagonal(rows: int, columns: int, pitch: float = 23e-6) -> np.ndarray:
    y, x = np.divmod(np.arange(rows * columns), columns)
    return np.stack([(x + y % 2 / 2) * pitch, y * pitch * 3**0.5 / 2], axis=1)


def square(rows: int, columns: int, pitch: float = 23e-6) -> np.ndarray:
    y, x = np.divmod(np.arange(rows * columns), columns)
    return np.stack([x, y], axis=1) * pitch


def at(places: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray, float]:
    """(which pixel each point shows, which one the point at each pixel's centre shows, length of a point)."""
    pixel, (left, right, bottom, top) = pictures.pixel_at(places, side)
    height, width = pixel.shape
    assert max(height, width) == side and (right - left) / width == pytest.approx((top - bottom) / height, rel=0.1)
    x = ((places[:, 0] - left) / (right - left) * width).astype(int)
    y = ((top - places[:, 1]) / (top - bottom) * height).astype(int)
    return pixel, pixel[y, x], (right - left) / width


@pytest.mark.parametrize(
    ("places", "area"),
    [(hexagonal(5, 4), 3**0.5 / 2), (hexagonal(4, 7)[:, ::-1], 3**0.5 / 2), (square(4, 6), 1.0)],
    ids=["hexagons", "hexagons that stand", "squares"],
)
def test_pixels_have_their_shape_where_they_lie(places: np.ndarray, area: float) -> None:
    """A regular hexagon of a pitch takes sqrt(3) / 2 of its square; all pixels alike, those at the edge too."""
    pixel, centres, point = at(places, 600)
    assert np.array_equal(centres, np.arange(len(places)))
    areas = np.bincount(pixel[pixel >= 0], minlength=len(places)) * (point / 23e-6) ** 2
    assert areas == pytest.approx(np.full(len(places), area), rel=0.05)


def test_a_large_array_leaves_no_holes() -> None:
    pixel, _, _ = at(hexagonal(100, 100), 256)
    assert (pixel[8:-8, 8:-8] >= 0).all()


@pytest.mark.parametrize(
    "places",
    [np.zeros((1, 2)), square(1, 9), square(9, 1), np.array([[0, 0], [3, 1], [4, 8], [20, 1]]) * 1e-5],
    ids=["one", "a row", "a column", "anywhere"],
)
def test_every_pixel_is_seen(places: np.ndarray) -> None:
    assert np.array_equal(at(places, 300)[1], np.arange(len(places)))


def test_y_is_upward_and_what_lies_beside_is_empty() -> None:
    pixel, _ = pictures.pixel_at(np.array([[0.0, 0.0], [0.0, 1e-5], [1e-5, 0.0]]), 200)
    colours = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]], np.uint8)
    shown = pictures.placed(np.stack([colours, colours + 100]), pixel, np.uint8(255))
    assert shown.shape == (2, *pixel.shape, 3) and shown.dtype == np.uint8
    assert shown[0, 50, 50].tolist() == [4, 5, 6] and shown[1, 150, 50].tolist() == [101, 102, 103]
    assert shown[0, 150, 150].tolist() == [7, 8, 9] and shown[0, 20, 150].tolist() == [255, 255, 255]


CONFIG = """
seed: 3
scene: {images: {source: array, path: images.npy}, wavelength: 555 nm, lux: [2560 mlux]}
recording: {exposure: 1 ms, readouts: [tr]}
sensor:
  layout: {positions: places.csv, pixel_area: 25 um^2, fill_factor: 1.0}
  effects: {detection: {pdp: 0.5}, tdc: {resolution: 10 ps}}
"""


def test_the_sheet_of_a_dataset_shows_pixels_where_they_lie(tmp_path: Path) -> None:
    places = hexagonal(3, 4)
    (tmp_path / "places.csv").write_text(positions_text(places))
    grey = (np.arange(12) * 23).astype(np.uint8)
    np.save(tmp_path / "images.npy", grey[None, None])
    simulated = dataset.simulated(config.build(document.parse(CONFIG, "test"), tmp_path))
    report.sheet(simulated, tmp_path / "x.png", places=places)
    with Image.open(tmp_path / "x.png") as image:
        page = np.asarray(image.convert("RGB"))
    pixel, _ = pictures.pixel_at(places, _sheet._LARGE)
    white = np.repeat((grey / grey.max() * 255 + 0.5).astype(np.uint8)[:, None], 3, axis=1)
    left = 32 + 8 * len("2560 mlux")
    cell = page[_sheet._TOP :, left:][: pixel.shape[0], : pixel.shape[1]]
    assert np.array_equal(cell, pictures.placed(white, pixel, np.array(_sheet._PAGE, np.uint8)))


def test_inspect_finds_the_places_of_a_dataset(tmp_path: Path) -> None:
    """From the file that the dataset keeps; a grid has none."""
    (tmp_path / "places.csv").write_text(positions_text(hexagonal(3, 4)))
    np.save(tmp_path / "images.npy", np.full((2, 1, 12), 200, np.uint8))
    (tmp_path / "c.yaml").write_text(CONFIG)
    grid = CONFIG.replace("positions: places.csv", "rows: 1, columns: 12")
    (tmp_path / "grid.yaml").write_text(grid)
    sizes = {}
    for name in ("c", "grid"):
        made = CliRunner().invoke(
            cli, ["generate", str(tmp_path / f"{name}.yaml"), "-o", str(tmp_path / name), "-j", "1"]
        )
        assert made.exit_code == 0, made.output
        png = tmp_path / f"{name}.png"
        assert CliRunner().invoke(cli, ["inspect", str(tmp_path / name), "--plot", str(png)]).exit_code == 0
        with Image.open(png) as image:
            sizes[name] = image.size
    assert sizes["c"][1] > sizes["grid"][1] + 50


@pytest.mark.slow
def test_names_are_drawn_as_what_can_be_seen_of_them(tmp_path: Path) -> None:
    """ESC, the end of a line and a mark of direction as their numbers, and no $ begins a formula."""
    layout, offsets = Layout(1, 2, np.nan, np.nan), np.array([0, 2, 3])
    events = Events(None, offsets, 2, np.array([1, 90, 50], np.uint32), 1e-9)
    clock = Conditions(1e-7, 1, 1e-7, 1e-7, None)

    def drawn(name: str, number: int) -> list[bytes]:
        recorded = Recording(Capture("a", "tr", Light(), clock), layout, events, None, 1e-9)
        lab = measurement.open(measurement.write(tmp_path / f"lab{number}", "lab", layout, [recorded]))
        lab = replace(lab, name=name, captures=(replace(lab.captures[0], id=name),))  # as others may make one
        report.capture_sheet(lab, report.looks(lab, True), tmp_path / "x.png")
        return [(tmp_path / "x.png").read_bytes(), fluxes.sheet(fluxes.of_measurement(lab, ("counts",)))]

    assert drawn("a\x1b[2J\n\u202eb", 0) == drawn(r"a\x1b[2J\x0a\u202eb", 1)
    formula, plain = drawn(r"$\frac{$", 2), drawn(r"\frac{", 3)
    assert all(one != other for one, other in zip(formula, plain, strict=True))


def test_a_map_of_a_capture_is_drawn_at_the_places(tmp_path: Path) -> None:
    """As many colours as there are different rates, the brightest and the darkest where their pixels lie."""
    places = hexagonal(2, 3)
    counts = np.array([100, 110, 120, 130, 140, 150])
    offsets = np.concatenate([[0], np.cumsum(counts)])
    ticks = np.concatenate([np.arange(n) * (10**6 // n) for n in counts]).astype(np.uint32)
    clock = Conditions(1e-3, 1, 1e-3, 1e-3, None)
    layout = Layout(1, 6, np.nan, np.nan, places)
    recorded = Recording(Capture("a", "tr", Light(), clock), layout, Events(None, offsets, 6, ticks, 1e-9), None, 1e-9)
    lab = measurement.open(measurement.write(tmp_path / "lab", "lab", layout, [recorded]))
    report.capture_sheet(lab, report.looks(lab, True), tmp_path / "x.png")
    with Image.open(tmp_path / "x.png") as image:
        page = np.asarray(image.convert("RGB"), int)[:, : image.width // 4]
    colours, of, points = np.unique(page.reshape(-1, 3), axis=0, return_inverse=True, return_counts=True)
    areas = [k for k in range(len(colours)) if np.ptp(colours[k]) > 60 and points[k] > 500]
    assert len(areas) == 6
    middle = {k: np.argwhere(of.reshape(page.shape[:2]) == k).mean(axis=0) for k in areas}
    dark, bright = (middle[pick(areas, key=lambda k: int(colours[k, 1]))] for pick in (min, max))
    assert dark[0] > bright[0] + 20 and dark[1] < bright[1] - 60  # the first pixel lies below on the left
