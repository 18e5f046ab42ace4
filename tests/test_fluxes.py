"""Flux images of a measurement: by hand, from a simulated twin, and what the command says and refuses."""

from __future__ import annotations

import io
import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import commands
import laws
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from spadmnist import fluxes, measurement, pictures, plugins, twin
from spadmnist.cli import _terminal, cli
from spadmnist.effects import Conditions
from spadmnist.effects.dead_time import DeadTime
from spadmnist.effects.detection import Detection
from spadmnist.effects.tdc import Tdc
from spadmnist.errors import InputError, SpadError
from spadmnist.events import Events, Layout
from spadmnist.factory import Progress
from spadmnist.plugins import ByWavelength
from spadmnist.recording import Capture, Light, Recording
from spadmnist.sensor import Sensor
from spadmnist.streams import Streams

CASES = Path(__file__).parents[2] / "shared" / "cases"
LAYOUT = Layout(1, 3, 25e-12, 1.0)
LIT = Light(500e-9, 0.75)
SENSOR = Sensor(LAYOUT, [Detection(pdp=0.4), DeadTime(duration=50e-9)], name="test")
YAML = """
sensor:
  layout: {rows: 1, columns: 3, pixel_area: 25 um^2}
  effects: {detection: {pdp: {400 nm: 0.4, 600 nm: 0.4}}, dead_time: {duration: 50 ns}}
"""


def stamped(rows: list[list[int]], id: str = "tr", lit: Light = LIT) -> Recording:
    """1 ms in ticks of 1 ns."""
    offsets = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
    ticks = np.array([stamp for row in rows for stamp in row], np.uint32)
    clock = Conditions(1e-3, 1, 1e-3, 1e-3, lit.wavelength)
    return Recording(Capture(id, "tr", lit, clock), LAYOUT, Events(None, offsets, 3, ticks, 1e-9), None, 1e-9)


def framed(modality: str, frames: np.ndarray, id: str = "", lit: Light = LIT, **more: Any) -> Recording:
    """Frames of 10 us, one each 12 us; stamps in ticks of 1 us, 10 where there is none."""
    binary = len(frames) * (2 ** more["bits"] - 1 if more.get("counting") == "frames" else 1)
    clock = Conditions(binary * 12e-6, binary, 10e-6, 12e-6, lit.wavelength, **more)
    values = np.packbits(frames.astype(np.uint8), axis=2) if modality == "qis" else frames
    tick = 1e-6 if modality == "str" else None
    return Recording(Capture(id or modality, modality, lit, clock), LAYOUT, None, values, tick)


STAMPS = [[], [500], [100, 150, 1150, 900_000]]
FIRST = np.array([[10, 3, 0], [10, 10, 0], [10, 7, 0], [10, 0, 0]], np.uint32)[:, None]
BITS = np.array([[0, 1, 1], [0, 0, 1], [0, 1, 1], [0, 1, 1]], np.uint8)[:, None]
TALLY = np.array([[0, 3, 15], [0, 4, 14]], np.uint8)[:, None]
LAB = [
    stamped(STAMPS),
    framed("str", FIRST),
    framed("qis", BITS),
    framed("counts", TALLY, bits=4, counting="frames"),
    framed("counts", TALLY, "counter", bits=4, counting="counter"),
    stamped(STAMPS, "dark", Light()),
]


@pytest.fixture
def lab(tmp_path: Path) -> measurement.Measurement:
    mean = replace(framed("qis", BITS, "a mean").capture, mean=2.0)
    return measurement.open(measurement.write(tmp_path / "lab", "a lab", LAYOUT, [*LAB, mean]))


def images(found: fluxes.Fluxes) -> dict[tuple[str, str], list[float]]:
    for image in found.images:
        assert image.values.dtype == np.float32 and image.values.shape == (1, 3)
    return {(image.capture.id, image.method): image.values[0].tolist() for image in found.images}


# --- by hand ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sensor", [None, SENSOR], ids=["no sensor", "a sensor"])
def test_the_formulas_on_what_was_recorded(lab: measurement.Measurement, sensor: Sensor | None) -> None:
    """Of frames the time is frames x frame time, not x frame period: 40 us of STR, 2 x 15 x 10 us of counts."""
    q, dead = (1.0, 0.0) if sensor is None else (0.4, 50e-9)
    found = fluxes.of_measurement(lab, (), sensor)

    def of_stamps(q: float) -> dict[str, list[float]]:
        return {
            "counts": [n / (q * 1e-3) for n in (0, 1, 4)],
            "passive_free_running": [n / (q * (1e-3 - n * dead)) for n in (0, 1, 4)],
            "inter_photon": [0, 0, 3 / (q * (899_900e-9 - 3 * dead))],
        }

    def of_counts(time: float) -> dict[str, list[float]]:
        return {
            "counts": [n / (q * time) for n in (0, 7, 29)],
            "passive_free_running": [n / (q * (time - n * dead)) for n in (0, 7, 29)],
        }

    expected = {
        "tr": of_stamps(q),
        # 3 + 7 + 0 us, and 10 us for the frame without any; four stamps of 0 count as half a tick each
        "str": {"str_flux": [0, 3 / (q * 20e-6), 4 / (q * 4 * 0.5e-6)]},
        # S = M counts as M - 1/2
        "qis": {"qis_counts": [0, 3, 4], "qis_linear": [0, 4 * math.log(4), 4 * math.log(8)]},
        "counts": of_counts(2 * 15 * 10e-6),
        "counter": of_counts(2 * 10e-6),
        "dark": of_stamps(1.0),
    }
    got = images(found)
    assert list(dict.fromkeys(id for id, _ in got)) == list(expected)
    assert set(got) == {(id, method) for id, methods in expected.items() for method in methods}
    for id, methods in expected.items():
        for method, values in methods.items():
            assert got[id, method] == pytest.approx(values, rel=1e-6), (id, method)
    saturated = {(image.capture.id, image.method): image.saturated for image in found.images if image.saturated}
    assert saturated == {("str", "str_flux"): 1, ("qis", "qis_linear"): 1}


def test_units_are_said(lab: measurement.Measurement) -> None:
    """Detections where the PDP is not told, and in the dark, where there are no photons."""

    def units_of(found: fluxes.Fluxes) -> dict[str, set[str]]:
        return {c.id: {i.unit for i in found.images if i.capture.id == c.id} for c in lab.captures if c.mean is None}

    without, told = fluxes.of_measurement(lab), fluxes.of_measurement(lab, (), SENSOR)
    lit = ("tr", "str", "counts", "counter")
    assert units_of(without) == {**{id: {"detections/s"} for id in (*lit, "dark")}, "qis": {"1"}}
    assert units_of(told) == {**{id: {"photons/s"} for id in lit}, "dark": {"detections/s"}, "qis": {"1"}}
    mean = "left out, for only the mean is known: a mean"
    assert without.notes == (mean, "no sensor was given: q is 1, the dead time 0, and rates are detections/s")
    assert told.notes == (mean, "no light fell on the sensor, so q is 1 and rates are detections/s: dark")
    assert not any("sensor" in note for note in fluxes.of_measurement(lab, ["qis_counts"]).notes)


def test_the_numbers_of_the_table_are_those_of_the_images(lab: measurement.Measurement) -> None:
    found = fluxes.of_measurement(lab, (), SENSOR)
    for row, image in zip(found.rows(), found.images, strict=True):
        values = image.values.astype(float)
        numbers = [row[key] for key in ("mean", "median", "min", "max")]
        assert numbers == pytest.approx([values.mean(), np.median(values), values.min(), values.max()], rel=1e-6)
        assert row["saturated_pixels"] == image.saturated and row["unit"] == image.unit
        assert row["pdp"] == (1.0 if row["capture"] == "dark" else 0.4) and row["dead_time"] == 50e-9


# --- of what a sensor would have recorded ---------------------------------------------------------------------------


def twin_of(modality: str, photons: float, **more: Any) -> tuple[Sensor, Recording]:
    """400 pixels with a PDP of 0.4, a dead time of 50 ns and a tick of 100 ps, no dark counts."""
    effects = [Detection(pdp=0.4), DeadTime(duration=50e-9), Tdc(resolution=100e-12)]
    sensor = Sensor(Layout(20, 20, 25e-12, 1.0), effects, "device").resolved()
    frames = 1 if modality == "tr" else 3000
    each = 10e-3 if modality == "tr" else 5e-6
    capture = Capture(modality, modality, LIT, Conditions(frames * each, frames, each, each, 500e-9, **more))
    numbers = np.zeros(1, np.uint64)
    return sensor, twin.model_recordings(sensor, capture, photons, Streams(1, "a", "b", numbers), numbers)[0]


@pytest.mark.parametrize(
    ("modality", "method", "more"),
    [
        ("tr", "passive_free_running", {}),
        ("tr", "inter_photon", {}),
        ("str", "str_flux", {}),
        ("counts", "passive_free_running", {"bits": 8, "counting": "counter"}),
    ],
)
def test_a_twin_gives_back_the_flux(tmp_path: Path, modality: str, method: str, more: dict[str, Any]) -> None:
    """The mean over 400 pixels; an estimate from n detections is known to be off by no more than one part in n."""
    photons = 5e5
    sensor, recorded = twin_of(modality, photons, **more)
    opened = measurement.open(measurement.write(tmp_path / "lab", "lab", sensor.layout, [recorded]))
    (image,) = fluxes.of_measurement(opened, [method], sensor).images
    n = float(recorded.totals.mean())
    assert image.unit == "photons/s" and n > 1000
    laws.mean_is(image.values.ravel(), photons, what=method, error=photons / n)


def test_frames_of_a_twin_give_back_the_detections(tmp_path: Path) -> None:
    """-M ln(1 - S / M) of frames of 5 us at 0.4 x 5e5 /s is M."""
    sensor, recorded = twin_of("qis", 5e5)
    opened = measurement.open(measurement.write(tmp_path / "lab", "lab", sensor.layout, [recorded]))
    ones, linear = fluxes.of_measurement(opened, (), sensor).images
    assert (ones.method, linear.method) == ("qis_counts", "qis_linear")
    laws.mean_is(ones.values.ravel(), 3000 * -math.expm1(-1))
    laws.mean_is(linear.values.ravel(), 3000, error=2.0)


# --- what is possible ---------------------------------------------------------------------------------------------


def test_a_method_is_for_some_captures(lab: measurement.Measurement) -> None:
    found = fluxes.of_measurement(lab, ["inter_photon", "counts", "inter_photon"])
    made = [(image.capture.id, image.method) for image in found.images]
    expected = [(id, m) for id in ("tr", "dark") for m in ("inter_photon", "counts")]
    assert sorted(made) == sorted([*expected, ("counts", "counts"), ("counter", "counts")])
    assert found.notes[1:3] == (
        "left out for inter_photon, for str, qis, counts does not allow it: str, qis, counts, counter",
        "left out for counts, for str, qis does not allow it: str, qis",
    )


def test_a_method_that_no_capture_allows(tmp_path: Path) -> None:
    opened = measurement.open(measurement.write(tmp_path / "lab", "lab", LAYOUT, [LAB[2]]))
    with pytest.raises(InputError) as caught:
        fluxes.of_measurement(opened, ["str_flux"])
    assert str(caught.value).endswith("no capture allows str_flux; qis captures allow qis_counts, qis_linear")
    with pytest.raises(KeyError, match="Did you mean qis_counts"):
        fluxes.of_measurement(opened, ["qis_count"])


def test_a_sensor_that_cannot_tell(tmp_path: Path) -> None:
    red = replace(LIT, wavelength=700e-9)
    opened = measurement.open(measurement.write(tmp_path / "lab", "lab", LAYOUT, [stamped(STAMPS, lit=red)]))
    place = "measurement.yaml:[0-9]+: captures.0.: "
    table = ByWavelength((400e-9, 600e-9), (0.4, 0.3))
    with pytest.raises(InputError, match=f"{place}detection.pdp: the wavelength 700 nm lies outside the table"):
        fluxes.of_measurement(opened, (), Sensor(LAYOUT, [Detection(pdp=table)]))
    with pytest.raises(InputError, match=f"{place}the sensor's PDP at 700 nm is 0"):
        fluxes.of_measurement(opened, (), Sensor(LAYOUT, [Detection(pdp=0.0)]))
    with pytest.raises(InputError, match="1 x 3 pixels, but the sensor 2 x 2"):
        fluxes.of_measurement(opened, (), Sensor(Layout(2, 2, 25e-12, 1.0), []))


def test_only_means(tmp_path: Path) -> None:
    mean = replace(LAB[2].capture, mean=2.0)
    opened = measurement.open(measurement.write(tmp_path / "lab", "lab", LAYOUT, [mean]))
    with pytest.raises(InputError, match="only means are known, of which no image can be made"):
        fluxes.of_measurement(opened)


def test_progress_adds_up(lab: measurement.Measurement) -> None:
    totals: list[float] = []
    steps: list[float] = []
    progress = Progress(lambda what, total, done: totals.append(total), lambda work, note: steps.append(work))
    fluxes.of_measurement(lab, (), None, progress)
    assert totals == [6.0] and sum(steps) == pytest.approx(6.0)


METHOD = '''
import numpy as np
from spadmnist.reconstruct import Method


class RootWaited(Method):
    """Square root of the time waited: of STR."""

    columns = ("ones", "waited")
    unit = "1"

    @classmethod
    def readouts(cls):
        return ("str",)

    def estimate(self, settings, ones, waited):
        return np.sqrt(waited / settings.frame_time)
'''


def test_a_method_of_ones_own(lab: measurement.Measurement, tmp_path: Path) -> None:
    (tmp_path / "root.py").write_text(METHOD)
    plugins.load_file(tmp_path / "root.py")
    assert fluxes.allowed("str") == ["root_waited", "str_flux"] and "root_waited" not in fluxes.allowed("qis")
    found = images(fluxes.of_measurement(lab, ["root_waited"]))
    assert found == {("str", "root_waited"): pytest.approx([2, math.sqrt(2), 0])}


# --- files --------------------------------------------------------------------------------------------------------


def test_the_files(lab: measurement.Measurement, tmp_path: Path) -> None:
    found = fluxes.of_measurement(lab)
    out = fluxes.write(found, tmp_path / "deep" / "out")
    assert sorted(p.name for p in out.iterdir()) == sorted([*found.names, "sheet.png"])
    for name, image in zip(found.names, found.images, strict=True):
        assert name == f"{image.capture.id}.{image.method}.npy"
        values = np.load(out / name, allow_pickle=False)
        assert values.dtype == np.float32 and np.array_equal(values, image.values)


def test_names_are_safe_and_no_two_the_same(tmp_path: Path) -> None:
    """As the files of a measurement are named."""
    ids = ("a/b", "A b", "../x", "a_b", "...", "500 nm #1")
    written = measurement.write(tmp_path / "lab", "lab", LAYOUT, [stamped(STAMPS, id) for id in ids])
    found = fluxes.of_measurement(measurement.open(written), ["counts"])
    assert found.names == [f"{path}.counts.npy" for path in ("a_b", "A_b-2", "x", "a_b-3", "capture", "500_nm_1")]
    assert {f"{name.removesuffix('.counts.npy')}.h5" for name in found.names} == {p.name for p in written.glob("*.h5")}


@pytest.mark.slow
def test_nothing_of_others_is_written_over(lab: measurement.Measurement, tmp_path: Path) -> None:
    found, out = fluxes.of_measurement(lab), tmp_path / "out"
    fluxes.write(found, out)
    before = {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in out.iterdir()}
    fluxes.write(found, out)
    assert {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in out.iterdir()} == before
    (out / "notes.txt").write_text("mine")
    (out / "tr.counts.npy").unlink()
    (out / "qis.qis_counts.npy").write_bytes(b"mine")
    with pytest.raises(
        SpadError, match=r"qis.qis_counts.npy: is there already and is another image; nothing was written"
    ):
        fluxes.write(found, out)
    assert not (out / "tr.counts.npy").exists() and (out / "qis.qis_counts.npy").read_bytes() == b"mine"
    (out / "qis.qis_counts.npy").unlink()
    (tmp_path / "elsewhere").write_bytes(before["qis.qis_counts.npy"][0])
    (out / "qis.qis_counts.npy").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(SpadError, match="is there already"):
        fluxes.write(found, out)
    (out / "qis.qis_counts.npy").unlink()
    fluxes.write(found, out)
    assert {p.name: p.read_bytes() for p in out.iterdir()} == {
        **{n: b for n, (b, _) in before.items()},
        "notes.txt": b"mine",
    }


def test_places_that_cannot_be(lab: measurement.Measurement, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SpadError, match="is a file, but images need a folder"):
        fluxes.check_place(tmp_path / "file")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "manifest.json").write_text('{"format": "spadmnist-dataset/1"}')
    with pytest.raises(SpadError, match="lies inside the dataset"):
        fluxes.check_place(tmp_path / "data" / "out")


# --- the sheet ----------------------------------------------------------------------------------------------------


def test_hot_pixels_leave_the_others_to_be_seen() -> None:
    """Steady light and a scene keep their scale; one pixel in twenty that is hot is left out of it."""
    rng = np.random.default_rng(2)
    grid = Layout(40, 40, np.nan, np.nan)
    steady = rng.poisson(1000, 1600).astype(float)
    assert pictures.white_of(grid, steady) == (steady.max(), 0)
    scene = rng.poisson(2, (40, 40)).astype(float)
    scene[10:20, 10:20] = rng.poisson(900, (10, 10))
    assert pictures.white_of(grid, scene.ravel()) == (scene.max(), 0)
    for image, usual in ((steady, 1000), (scene.ravel(), 900), (rng.poisson(0.3, 1600).astype(float), 1)):
        hot = rng.permutation(1600)[:80]
        image[hot] = 1e6
        white, brighter = pictures.white_of(grid, image)
        assert usual <= white <= 2.2 * usual and brighter >= 80
    y, x = np.divmod(np.arange(1600), 40)
    places = np.stack([x + y % 2 / 2, y * 3**0.5 / 2], axis=1) * 1e-5
    white, brighter = pictures.white_of(replace(grid, rows=1, columns=1600, positions=places), steady)
    assert 1000 <= white <= 2200 and brighter == 80
    assert pictures.white_of(grid, np.zeros(1600)) == (1.0, 0)
    assert pictures.white_of(Layout(1, 1, 1, 1), np.array([3.0])) == (3.0, 0)
    assert pictures.white_of(Layout(1, 1, 1, 1, np.zeros((1, 2))), np.array([3.0])) == (3.0, 0)


@pytest.mark.slow
def test_the_sheet_has_a_row_a_capture_and_a_column_a_method(lab: measurement.Measurement, tmp_path: Path) -> None:
    def size(methods: list[str]) -> tuple[int, int]:
        with Image.open(io.BytesIO(fluxes.sheet(fluxes.of_measurement(lab, methods)))) as image:
            image.load()
            return image.size

    one, two, three = size(["qis_counts"]), size(["qis_counts", "qis_linear"]), size(["inter_photon"])
    across, down = (round(inches * pictures.DPI) for inches in fluxes._CELL)
    assert abs(two[0] - one[0] - across) <= 1 and two[1] == one[1]
    assert three[0] == one[0] and abs(three[1] - one[1] - down) <= 1  # of two captures
    found = fluxes.of_measurement(lab)
    assert fluxes.sheet(found) == fluxes.sheet(found)


def test_a_sheet_ends_somewhere(tmp_path: Path) -> None:
    many = [stamped(STAMPS, f"capture {i}") for i in range(20)]
    opened = measurement.open(measurement.write(tmp_path / "lab", "lab", LAYOUT, many))
    found = fluxes.of_measurement(opened, ["counts"])
    with Image.open(io.BytesIO(fluxes.sheet(found))) as image:
        assert len(found.images) == 20 and image.height < 17 * fluxes._CELL[1] * pictures.DPI


# --- the command --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_measurement_from_the_command_line(lab: measurement.Measurement, tmp_path: Path) -> None:
    (tmp_path / "sensor.yaml").write_text(YAML)
    done = commands.run(
        "reconstruct", "lab", "--sensor", "sensor.yaml", "--method", "counts", "--method", "qis_counts", cwd=tmp_path
    )
    assert done.returncode == 0 and "a_lab-flux" in done.stderr
    assert sorted(p.name for p in (tmp_path / "a_lab-flux").iterdir()) == sorted(
        [*(f"{id}.counts.npy" for id in ("tr", "counts", "counter", "dark")), "qis.qis_counts.npy", "sheet.png"]
    )
    lines = done.stdout.splitlines()
    assert max(map(len, lines)) <= 100
    (line,) = [line for line in lines if line.startswith("tr ") and "counts" in line]
    assert line.split() == ["tr", "counts", "4,167", "2,500", "0", "10,000", "0", "photons/s"]
    assert any(line.split() == ["tr", "tr", "0.4", "1", "ms", "50", "ns"] for line in lines)
    assert "Note: left out, for only the mean is known: a mean" in done.stderr
    asked = ("lab/measurement.yaml", "-o", "out", "--json")
    answer = json.loads(commands.run("reconstruct", *asked, cwd=tmp_path).stdout)
    found = fluxes.of_measurement(lab)
    assert answer == {"measurement": "a lab", "folder": "out", "images": found.rows(), "notes": list(found.notes)}
    assert all((tmp_path / "out" / row["file"]).is_file() for row in answer["images"])
    again = commands.run("reconstruct", "lab", "--sensor", "sensor.yaml", "-o", "out", cwd=tmp_path)
    assert again.returncode == 2 and "is there already and is another image" in again.stderr


def test_a_plugin_from_the_command_line(lab: measurement.Measurement, tmp_path: Path) -> None:
    (tmp_path / "root.py").write_text(METHOD)
    asked = ("lab", "-o", "out", "--plugin", "root.py", "--method", "root_waited")
    assert commands.run("reconstruct", *asked, cwd=tmp_path).returncode == 0
    assert np.load(tmp_path / "out" / "str.root_waited.npy")[0] == pytest.approx([2, math.sqrt(2), 0])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("lab", "--jobs", 2), ("--jobs", "dataset", "leave it out")),
        (("lab", "--method", "count"), ("--method", "Did you mean counts?")),
        (("lab", "-o", "sensor.yaml"), ("sensor.yaml is a file", "-o")),
        (("nothing", "-o", "out"), ("--output", "nothing is none", "leave it out")),
        (("nothing", "--sensor", "sensor.yaml"), ("--sensor", "nothing is none", "leave it out")),
        (("lab", "--sensor", "other.yaml"), ("1 x 3 pixels", "1 x 4")),
        (("lab", "--sensor", "missing.yaml"), ("missing.yaml",)),
    ],
)
def test_sentences(
    lab: measurement.Measurement,
    tmp_path: Path,
    arguments: tuple[object, ...],
    words: tuple[str, ...],
) -> None:
    (tmp_path / "sensor.yaml").write_text(YAML)
    (tmp_path / "other.yaml").write_text(YAML.replace("columns: 3", "columns: 4"))
    before = sorted(os.listdir(tmp_path))
    done = commands.run("reconstruct", *arguments, cwd=tmp_path)
    assert done.returncode == 2 and all(word in done.stderr for word in words), done.stderr
    assert len(done.stderr.strip().splitlines()) == 1 and sorted(os.listdir(tmp_path)) == before


def test_the_bar_is_told(lab: measurement.Measurement, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command hands its bar to the library."""
    steps: list[float] = []

    class Told:
        def __enter__(self) -> Progress:
            return Progress(advance=lambda work, note: steps.append(work))

        def __exit__(self, *_: object) -> None:
            pass

    monkeypatch.setattr(_terminal, "progress", Told)
    arguments = ["reconstruct", str(tmp_path / "lab"), "-o", str(tmp_path / "out")]
    assert CliRunner().invoke(cli, arguments).exit_code == 0 and sum(steps) == pytest.approx(6.0)


def test_frames_that_came_from_elsewhere(tmp_path: Path) -> None:
    """Binary frames that are imported; the sum over the frames is what was counted by another program."""
    folder = CASES / "reconstruct-a-measurement"
    if not folder.is_dir():
        pytest.skip("the shared case reconstruct-a-measurement is not here")
    clock = ["--frame-time", "10 us", "--frame-period", "10 us", "--light", "free"]
    done = commands.run("import", folder / "b.npy", "-o", "lab", *clock, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert commands.run("reconstruct", "lab", "--method", "qis_counts", cwd=tmp_path).returncode == 0
    found, right = np.load(tmp_path / "b-flux" / "b.qis_counts.npy"), np.load(folder / "qis_counts.npy")
    assert found.dtype == np.float32 and np.array_equal(found, right) and found.sum() == 176


@pytest.mark.slow
def test_a_part_of_the_sensor_gives_its_own_numbers(tmp_path: Path) -> None:
    """A measured window of a chip whose PDP differs from pixel to pixel: the nominal values of the window."""
    sensor = tmp_path / "chip.yaml"
    sensor.write_text(
        "sensor:\n  rules: device\n  layout: {rows: 8, columns: 16, pixel_area: 25 um^2, fill_factor: 1}\n"
        "  effects: {detection: {pdp: 0.5}, dead_time: {duration: 50 ns}, tdc: {resolution: 1 ns}}\n"
    )
    lab = tmp_path / "lab"
    lab.mkdir()
    (lab / "measurement.yaml").write_text(
        "format: spadmnist-measurement/1\nlayout: {rows: 4, columns: 8}\ncaptures:\n"
        "  - {id: a, modality: tr, exposure: 1 ms, light: {kind: flat, wavelength: 500 nm, irradiance: 1 nW/cm^2}}\n"
    )
    run = commands.run
    window = ("--crop", "2:6,4:12")
    assert run("simulate", sensor, lab, "-o", tmp_path / "twin", *window).returncode == 0
    refused = run("reconstruct", tmp_path / "twin", "--sensor", sensor, "-o", tmp_path / "f")
    assert refused.returncode == 2 and "--crop" in refused.stderr
    made = run(
        "reconstruct", tmp_path / "twin", "--sensor", sensor, *window, "-o", tmp_path / "f", "--method", "counts"
    )
    assert made.returncode == 0, made.stderr
    plain = run("reconstruct", tmp_path / "twin", "-o", tmp_path / "g", "--method", "counts")
    assert plain.returncode == 0
    one, two = (np.load(tmp_path / name / "a.counts.npy") for name in "fg")
    assert np.allclose(one, two / 0.5) and one.shape == (4, 8)
    assert "--crop: is the part of a sensor" in run("reconstruct", tmp_path / "twin", *window).stderr
