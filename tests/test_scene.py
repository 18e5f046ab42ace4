"""Captures of a scene: read, imported, simulated, compared, inspected, exported, with the light that follows it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import laws
import numpy as np
import pytest
from click.testing import CliRunner, Result
from measured import described, device, stored, tree
from scipy import stats

from spadmnist import cli, config, factory, look, measurement, scene, tiles, twin
from spadmnist.effects import Conditions
from spadmnist.effects.detection import Detection
from spadmnist.errors import InputError, SpadError
from spadmnist.events import Layout
from spadmnist.inference.comparison import compare
from spadmnist.inference.reduction import statistics_for
from spadmnist.recording import Capture, Light, Recording
from spadmnist.scene import Scene
from spadmnist.sensor import Sensor
from spadmnist.streams import Streams

SEEN = np.array([[0, 51, 102, 255], [255, 0, 153, 204], [51, 51, 0, 255]], np.uint8)
LAYOUT = "{rows: 3, columns: 4}"
QIS = "modality: qis, frames: 40, frame_time: 10 us"


def run(*words: str) -> Result:
    return CliRunner().invoke(cli.cli, list(words))


def refused(call: Callable[[], object], *parts: str) -> None:
    with pytest.raises(SpadError) as error:
        call()
    for part in parts:
        assert part in str(error.value)


def lab(folder: Path, light: str = "lux: 1 lux", shown: np.ndarray = SEEN, layout: str = LAYOUT) -> Path:
    """A plan of one capture of a scene."""
    folder.mkdir(exist_ok=True)
    np.save(folder / "chart.npy", shown)
    kind = f"kind: image, file: chart.npy{', ' * bool(light)}{light}"
    return described(folder, f"{{id: a, file: a.h5, light: {{{kind}}}, {QIS}}}", layout=layout)


def opened(folder: Path) -> measurement.Measurement:
    return measurement.open(folder, planned=True)


# --- the scene ----------------------------------------------------------------------------------------------------


def test_the_light_of_a_pixel_is_its_share_of_white(tmp_path: Path) -> None:
    (capture,) = opened(lab(tmp_path, "lux: 2 lux, relative_uncertainty: 0.1")).captures
    assert capture.light.scene is not None and capture.light.scene == capture.conditions.scene
    assert (capture.light.wavelength, capture.light.level, capture.light.kind_of_level) == (555e-9, 2.0, "lux")
    assert capture.light.relative_uncertainty == 0.1
    sensor = Sensor(Layout(3, 4, 25e-12, 1.0), [Detection(pdp=0.5)]).resolved()
    white = twin.photons_at(capture, sensor.layout)
    rates, _ = sensor.rates(np.full((2, 12), white), capture.conditions)
    assert white is not None and np.allclose(rates, 0.5 * white * SEEN.ravel() / 255, rtol=1e-15)
    expected, _ = sensor.expected(np.full((1, 12), white), capture.conditions)
    assert np.allclose(expected[0], rates[0] * capture.conditions.exposure, rtol=1e-15)


def test_floats_and_bytes_of_the_same_light_are_the_same_scene(tmp_path: Path) -> None:
    np.save(tmp_path / "bytes.npy", SEEN)
    np.save(tmp_path / "floats.npy", SEEN / 255.0)
    np.save(tmp_path / "other.npy", SEEN[::-1])
    one, same, other = (scene.read(tmp_path / f"{name}.npy") for name in ("bytes", "floats", "other"))
    assert one == same != other and hash(one) == hash(same)
    assert scene.read(tmp_path / "bytes.npy").file() == (tmp_path / "bytes.npy").read_bytes()


@pytest.mark.parametrize(
    ("light", "wavelength", "level"),
    [
        ("", 555e-9, None),
        ("wavelength: 500 nm", 500e-9, None),
        ("irradiance: 3 nW/cm^2", 555e-9, 3e-5),
        ("irradiance: 3 nW/cm^2, wavelength: 0.7 um", 700e-9, 3e-5),
    ],
)
def test_a_level_may_be_free_and_a_wavelength_unsaid(
    light: str, wavelength: float, level: float | None, tmp_path: Path
) -> None:
    (capture,) = opened(lab(tmp_path, light)).captures
    assert capture.light.wavelength == wavelength == capture.conditions.wavelength
    assert capture.light.level == (None if level is None else pytest.approx(level))


@pytest.mark.parametrize(
    ("shown", "parts"),
    [
        (SEEN[:2], ("measurement.yaml:5: captures[0].light.file", "2 x 4 pixels, but the layout 3 x 4", "size")),
        (SEEN[None], ("chart.npy", "(1, 3, 4)", "one grey image, (rows, columns)")),
        (SEEN.astype(np.int32), ("holds int32", "uint8")),
        (SEEN.astype(float), ("has 51 in row 0, column 1", "from 0 (black) to 1")),
        (np.where(SEEN == 51, np.nan, 0.5), ("has nan in row 0, column 1",)),
        (-1.0 * SEEN, ("has -51 in row 0, column 1",)),
        (0 * SEEN, ("black all over", "kind: dark")),
    ],
)
def test_what_is_no_scene_is_said_in_one_sentence(shown: np.ndarray, parts: tuple[str, ...], tmp_path: Path) -> None:
    refused(lambda: opened(lab(tmp_path, shown=shown)), *parts)


@pytest.mark.parametrize(
    ("light", "part"),
    [
        ("{kind: image, file: none.npy}", "none.npy: there is no such file; the scene is read from there"),
        ("{kind: image}", "file: chart.npy"),
        ("{kind: image, file: ../chart.npy}", "leads out of the measurement's folder"),
        ("{kind: image, file: words.npy}", "a .npy file; store the image by np.save"),
        ("{kind: image, file: chart.npy, lux: 1 lux, irradiance: 1 nW/cm^2}", "both irradiance and lux"),
        ("{kind: flat, file: chart.npy, lux: 1 lux}", "file"),
    ],
)
def test_what_a_light_of_an_image_cannot_say(light: str, part: str, tmp_path: Path) -> None:
    (tmp_path / "words.npy").write_text("white\n")
    np.save(tmp_path / "chart.npy", SEEN)
    refused(lambda: opened(described(tmp_path, f"{{id: a, light: {light}, {QIS}}}", layout=LAYOUT)), part)


# --- simulated and written ----------------------------------------------------------------------------------------


def large() -> tuple[Sensor, np.ndarray]:
    """A sensor of 12 x 10 pixels and a scene of it with every share."""
    seen = np.random.Generator(np.random.PCG64(5)).permutation(np.linspace(0, 1, 120)).reshape(12, 10)
    return Sensor(Layout(12, 10, 25e-12, 1.0), [Detection(pdp=0.5), *device().effects[1:]], "device").resolved(), seen


@pytest.mark.parametrize("modality", ["tr", "str", "qis", "counts"])
def test_a_twin_of_a_scene_follows_it(modality: str) -> None:
    """Each pixel's detections are those of its own light; a scene that is turned by a half is told from it."""
    sensor, seen = large()
    shown = Scene("chart.npy", seen)
    conditions = Conditions(0.02, 2000, 1e-5, 1e-5, 555e-9, 4 if modality == "counts" else 0, "counter", shown)
    capture = Capture("a", modality, Light(555e-9, 1.0, "lux", scene=shown), conditions)
    white = twin.photons_at(capture, sensor.layout)
    assert white is not None
    images = np.arange(20, dtype=np.uint64)
    made = twin.model_recordings(sensor, capture, white, Streams(3, "x", "model", images), images)
    totals = np.sum([one.totals for one in made], axis=0)

    def judge(told: Scene) -> None:
        plain = replace(conditions, scene=told)
        candidates, recorded = sensor.expected(np.full((1, 120), white), plain)
        mean = recorded[0] if capture.counts_events else 2000 * -np.expm1(-candidates[0] / 2000)
        z = (totals - 20 * mean) / np.sqrt(20 * mean * (1 if capture.counts_events else 1 - mean / 2000))
        square = stats.chi2(120)
        assert 2 * min(square.cdf((z**2).sum()), square.sf((z**2).sum())) > laws.FALSE_ALARM
        assert abs(z.sum()) < laws.z_bound() * np.sqrt(120)

    judge(shown)
    with pytest.raises(AssertionError):
        judge(Scene("chart.npy", seen[::-1, ::-1]))


def test_a_twin_is_written_with_its_scene_and_read_again(tmp_path: Path) -> None:
    plan = opened(lab(tmp_path / "plan"))
    sensor = Sensor(Layout(3, 4, 25e-12, 1.0), [Detection(pdp=0.5)], "device").resolved()
    twin.simulate(sensor, plan, tmp_path / "twin", seed=1)
    made = measurement.open(tmp_path / "twin")
    assert made.captures == plan.captures and sorted(p.name for p in (tmp_path / "twin").iterdir()) == [
        "a.h5",
        "chart.npy",
        "measurement.yaml",
    ]
    assert (tmp_path / "twin" / "chart.npy").read_bytes() == (tmp_path / "plan" / "chart.npy").read_bytes()
    assert not made.recording("a").totals[SEEN.ravel() == 0].any()
    twin.simulate(sensor, plan, tmp_path / "twin", seed=1)  # the same again is there already
    refused(lambda: twin.simulate(sensor, opened(lab(tmp_path / "free", "")), tmp_path / "x"), "level of a is free")


def test_scenes_of_the_same_name_lie_side_by_side(tmp_path: Path) -> None:
    sensor = Sensor(Layout(3, 4, 25e-12, 1.0), [Detection(pdp=0.5)], "device").resolved()
    base = opened(lab(tmp_path / "plan")).captures[0]
    shown = [Scene("chart.npy", SEEN), Scene("Chart.npy", SEEN[::-1]), Scene("chart.npy", SEEN)]
    captures = [
        replace(base, id=str(i), light=replace(base.light, scene=s), conditions=replace(base.conditions, scene=s))
        for i, s in enumerate(shown)
    ]
    made: list[Recording | Capture] = []
    for one in captures:
        images = np.zeros(1, np.uint64)
        made += twin.model_recordings(sensor, one, 1e5, Streams(1, one.id, "x", images), images)
    measurement.write(tmp_path / "lab", "lab", sensor.layout, made, captures)
    assert sorted(p.name for p in (tmp_path / "lab").glob("*.npy")) == ["Chart-2.npy", "chart.npy"]
    assert [c.light.scene for c in measurement.open(tmp_path / "lab").captures] == shown


def test_a_part_of_a_chip_sees_the_scene_of_the_part() -> None:
    sensor, seen = large()
    part = sensor.cropped(slice(4, 8), slice(2, 9))
    shown = Scene("part.npy", seen[4:8, 2:9])
    conditions = Conditions(0.02, 2000, 1e-5, 1e-5, 555e-9, scene=shown)
    whole, _ = sensor.rates(np.full((1, 120), 1e5), replace(conditions, scene=Scene("whole.npy", seen)))
    rates, _ = part.rates(np.full((1, 28), 1e5), conditions)
    assert np.array_equal(rates.reshape(4, 7), whole.reshape(12, 10)[4:8, 2:9])
    images = np.arange(2, dtype=np.uint64)
    made = part.expose(np.full((2, 28), 1e5), conditions, Streams(1, "x", "y", images), ("tr",))
    assert made.tr is not None and made.tr.counts.sum() > 500


# --- imported, looked at, exported --------------------------------------------------------------------------------


def frames(path: Path) -> Path:
    np.save(path, np.random.Generator(np.random.PCG64(1)).integers(0, 2, (40, 3, 4)).astype(np.uint8))
    return path


@pytest.mark.parametrize(
    ("light", "wavelength", "level", "kind"),
    [
        ("", 555e-9, None, "irradiance"),
        (" free", 555e-9, None, "irradiance"),
        (" 80 mlux", 555e-9, 0.08, "lux"),
        (" 500 nm 80 mlux", 500e-9, 0.08, "lux"),
        (" 3 nW/cm^2", 555e-9, 3e-5, "irradiance"),
        (" 700 nm free", 700e-9, None, "irradiance"),
    ],
)
def test_a_scene_is_imported_by_its_light(
    light: str, wavelength: float, level: float | None, kind: str, tmp_path: Path
) -> None:
    np.save(tmp_path / "chart.npy", SEEN)
    file, out = frames(tmp_path / "a.npy"), tmp_path / "lab"
    clock = ("--frame-time", "10 us", "--frame-period", "10 us")
    done = run("import", str(file), "-o", str(out), *clock, "--light", f"image:{tmp_path / 'chart.npy'}{light}")
    assert done.exit_code == 0, done.output
    (capture,) = measurement.open(out).captures
    lit = capture.light
    assert lit.scene == Scene("chart.npy", SEEN) and lit.wavelength == pytest.approx(wavelength)
    assert lit.level == (None if level is None else pytest.approx(level)) and lit.kind_of_level == kind
    assert lit.relative_uncertainty == (0.0 if level is None else 0.05)


def test_a_plan_of_a_scene_is_filled(tmp_path: Path) -> None:
    folder = lab(tmp_path / "plan")
    done = run("import", str(frames(tmp_path / "a.npy")), "-o", str(folder))
    assert done.exit_code == 0, done.output
    made = measurement.open(folder)
    assert made.captures[0].light.scene is not None and made.recording("a").totals.sum() > 0


@pytest.mark.parametrize(
    ("light", "part"),
    [
        ("image:none.npy", "none.npy: there is no such file"),
        ("image:", "is no light"),
        ("image:chart.npy dark", "is no light"),
        ("image:small.npy", "small.npy has 2 x 4 pixels, but a.npy has 3 x 4"),
        ("image:chart.npy 80 furlongs", "is no light: 'furlongs' is no unit of a wavelength or of light"),
        ("500 nm 8 uW/cmm", "'uW/cmm' is no unit of a wavelength or of light"),
        ("500 nm 8", "'8' has no unit"),
        ("500 nm 700 nm", "'700 nm' is not possible, or there twice"),
    ],
)
def test_a_scene_that_cannot_be_imported(
    light: str, part: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("chart.npy", SEEN)
    np.save("small.npy", SEEN[:2])
    frames(Path("a.npy"))
    done = run("import", "a.npy", "-o", "lab", "--frame-time", "10 us", "--frame-period", "10 us", "--light", light)
    assert done.exit_code != 0 and not Path("lab").exists()
    assert part in str(done.exception or done.output) or part in done.output


def test_a_scene_is_named_and_its_export_says_what_it_lacks(tmp_path: Path) -> None:
    folder = lab(tmp_path / "lab")
    stored(folder / "a.h5", frames=np.ones((40, 3, 4), np.uint8))
    (capture,) = measurement.open(folder).captures
    assert look.light_text(capture.light) == "scene chart.npy, 555 nm, 1 lux"
    shown = run("inspect", str(folder))
    assert shown.exit_code == 0 and "chart.npy" in shown.output
    done = run("export", str(folder), "-o", str(tmp_path / "a.npz"), "--format", "npz")
    assert done.exit_code == 0 and "do not hold the scene" in done.output
    # without its scene the level would be taken for that of flat light: an import asks
    again = run("import", str(tmp_path / "a.npz"), "-o", str(tmp_path / "again"))
    assert again.exit_code != 0 and "what fell on the sensor" in str(again.exception or again.output)


# --- compared -----------------------------------------------------------------------------------------------------

PLAN = """{{id: a, file: a.h5, modality: {modality}, light: {{kind: image, file: chart.npy{light}}},
     frames: 600, frame_time: 10 us}}"""


def measured(folder: Path, seen: np.ndarray, light: str, seed: int, modality: str = "qis") -> measurement.Measurement:
    """What a sensor makes of a scene."""
    sensor, _ = large()
    folder.mkdir()
    np.save(folder / "chart.npy", seen)
    plan = described(folder, PLAN.format(modality=modality, light=light), layout="{rows: 12, columns: 10}")
    twin.simulate(sensor, opened(plan), folder / "twin", seed=seed)
    return measurement.open(folder / "twin")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPADMNIST_CACHE", str(tmp_path / "cache"))


@pytest.mark.slow
def test_a_right_model_of_a_scene_is_adequate_and_another_scene_is_not(tmp_path: Path) -> None:
    """A model is called wrong in 1 % of comparisons; the seed is fixed."""
    sensor, seen = large()
    lit = ", lux: 1 lux, relative_uncertainty: 0.05"
    data = measured(tmp_path / "a", seen, lit, seed=4)
    right = compare(sensor, data, jobs=1)
    assert right.verdict == "adequate" and "pixel_map" in {c.statistic for c in right.checks}
    assert not {c.statistic for c in right.checks} & {"surface", "spread", "tails", "outliers"}
    (capture,) = data.captures
    turned = Scene("chart.npy", seen[:, ::-1])
    other = replace(
        capture,
        light=replace(capture.light, scene=turned),
        conditions=replace(capture.conditions, scene=turned),
    )
    recording = data.recording("a", sensor)
    wrong = replace(data, captures=(other,))
    wrong._read = lambda index, layout, dead_time: (recording.named(other), [])
    found = compare(sensor, wrong, jobs=1)
    assert found.verdict == "fails" and "pixel_map" in {c.statistic for c in found.failing}


def test_a_free_level_of_a_scene_is_fitted(tmp_path: Path) -> None:
    """The data are of 1 lux; where the plan says nothing of it, the map is compared at the level that fits."""
    sensor, seen = large()
    data = measured(tmp_path / "a", seen, ", lux: 1 lux", seed=4)
    (capture,) = data.captures
    free = replace(data, captures=(replace(capture, light=replace(capture.light, level=None)),))
    recording = data.recording("a", sensor)
    free._read = lambda index, layout, dead_time: (recording.named(free.captures[0]), [])
    found = compare(sensor, free, jobs=1)
    assert found.verdict == "adequate" and not found.nuisances


def test_flat_statistics_are_not_asked_of_a_scene() -> None:
    lit = Light(555e-9, 1.0, "lux")
    capture = Capture("a", "qis", lit, Conditions(0.02, 2000, 1e-5, 1e-5, 555e-9))
    seen = replace(capture, light=replace(lit, scene=Scene("chart.npy", SEEN)))
    flat, of_scene = ({s.name for s in statistics_for(one)} for one in (capture, seen))
    assert flat - of_scene == {"surface", "spread", "tails", "outliers"} and not of_scene - flat


# --- a dataset of a chart -----------------------------------------------------------------------------------------

CONFIG = """\
seed: 3
scene: {images: {source: SOURCE}, lux: [1 lux]}
recording: {exposure: 4 ms, frames: 400, frame_time: 10 us, readouts: [qis]}
sensor: {layout: {rows: 18, columns: 18, pixel_area: 25 um^2}, effects: {detection: {pdp: 0.5}}}
"""


def dataset_of(folder: Path, source: str) -> tuple[Any, Path]:
    (folder / "chart.yaml").write_text(CONFIG.replace("SOURCE", source))
    experiment = config.read(folder / "chart.yaml")
    factory.generate(experiment, experiment.load_images(), folder / "out", 1)
    return experiment, folder / "out"


@pytest.mark.slow
def test_a_dataset_of_a_chart_is_a_measurement_of_its_scene(tmp_path: Path) -> None:
    digits = "{source: digits, train: 9, test: 9, rows: 9, columns: 9}"
    experiment, root = dataset_of(tmp_path, f"chart, of: {digits}, count: 4, repetitions: 2")
    data = measurement.open(root)
    assert [c.id for c in data.captures] == [f"1 lux {split} #{i}" for split in ("train", "test") for i in (0, 1)]
    charts = experiment.load_images()
    for capture in data.captures:
        assert capture.light.scene == Scene("x", charts[capture.id.split()[2]].pixels[0])
    assert compare(experiment.sensor, data, jobs=1).verdict == "adequate"


def test_the_tiles_of_a_chart_go_with_its_measurement(tmp_path: Path) -> None:
    """From the dataset to a twin of it, to a copy, and to a plan; each split has its own."""
    digits = "{source: digits, train: 9, test: 9, rows: 9, columns: 9}"
    experiment, root = dataset_of(tmp_path, f"chart, of: {digits}, count: 4")
    charts = experiment.load_images()
    twin.simulate(experiment.sensor, measurement.open(root), tmp_path / "twin", seed=1)
    measurement.open(tmp_path / "twin").save(tmp_path / "copy")
    assert sorted(p.name for p in (tmp_path / "copy").glob("*.json")) == ["test.json", "train.json"]
    assert tree(tmp_path / "twin") == tree(tmp_path / "copy")
    for folder in (root, tmp_path / "twin", tmp_path / "copy"):
        data = measurement.open(folder)
        for capture in data.captures:
            chart = charts[capture.id.split()[2]]
            laid = data[capture.id].tiles
            assert chart.tiles is not None and laid.facts() == chart.tiles.facts() and laid.shape == (18, 18)
            assert capture.light.scene == Scene("x", chart.pixels[0])  # the same scene, whatever is known of its tiles
            assert np.array_equal(laid.cut(chart.pixels[0]), chart.tiles.cut(chart.pixels[0]))


TILES = {"size": [2, 2], "corners": [[0, 0], [1, 2]], "numbers": [4, 7], "labels": [3, 1]}


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"corners": [[0, 0], [2, 2]]}, "chart.json: corners: a tile leads beyond the chart of 3 x 4 pixels"),
        ({"labels": [3]}, "chart.json: labels: there are 1 for 2 tiles"),
        ({"labels": [3, 256]}, "chart.json: labels[1]: 256 is not possible; it must be at most 255"),
        ({"numbers": None}, "chart.json: numbers: None is not possible; it must be a list"),
        ({"size": [2, 0]}, "chart.json: size[1]: 0 is not possible; it must be at least 1"),
        (
            {"places": []},
            "chart.json: places is not an entry here. Did you mean labels? Allowed are size, corners, numbers, lab",
        ),
        (None, "chart.json: cannot be read (it is not JSON); the tiles of a chart are a JSON file"),
    ],
)
def test_tiles_that_are_none(changed: dict[str, Any] | None, sentence: str, tmp_path: Path) -> None:
    folder = lab(tmp_path / "lab", "tiles: chart.json")
    (folder / "chart.json").write_text("tiles" if changed is None else json.dumps({**TILES, **changed}))
    refused(lambda: opened(folder), sentence)


def test_tiles_of_a_lab_are_read_and_missing_ones_said(tmp_path: Path) -> None:
    folder = lab(tmp_path / "lab", "tiles: chart.json")
    refused(
        lambda: opened(folder), "measurement.yaml:5: captures[0].light.tiles", "chart.json: cannot be read (No such"
    )
    (folder / "chart.json").write_text(json.dumps(TILES))
    stored(folder / "a.h5", frames=np.ones((40, 3, 4), np.uint8))
    laid = measurement.open(folder)["a"].tiles
    assert (
        laid.labels is not None
        and laid.labels.tolist() == [3, 1]
        and laid.cut(SEEN)[1].tolist() == [[153, 204], [0, 255]]
    )
    stored(lab(tmp_path / "bare") / "a.h5", frames=np.ones((40, 3, 4), np.uint8))
    refused(lambda: measurement.open(tmp_path / "bare")["a"].tiles, "a: says nothing of tiles", "tiles: chart.json}")


def test_charts_alike_with_other_tiles_keep_them_apart(tmp_path: Path) -> None:
    base = opened(lab(tmp_path / "plan")).captures[0]
    laid = [tiles.of_facts({**TILES, "labels": labels}, (3, 4)) for labels in ([3, 1], [5, 5], [3, 1])]
    shown = [Scene("chart.npy", SEEN, one) for one in [*laid, None]]
    captures = [
        replace(
            base, id=str(i), light=replace(base.light, scene=s), conditions=replace(base.conditions, scene=s), mean=9
        )
        for i, s in enumerate(shown)
    ]
    measurement.write(tmp_path / "lab", "lab", Layout(3, 4, 25e-12, 1.0), captures, captures)
    assert {p.name for p in (tmp_path / "lab").iterdir()} == {
        "chart.npy", "chart.json", "chart-2.json", "measurement.yaml"
    }  # fmt: skip
    read = [c.light.scene.tiles for c in measurement.open(tmp_path / "lab").captures]  # type: ignore[union-attr]
    assert [None if t is None else t.facts() for t in read] == [*(t.facts() for t in laid), None]


def test_a_dataset_of_other_images_is_none(tmp_path: Path) -> None:
    _, root = dataset_of(tmp_path, "digits, train: 2, test: 0, rows: 18, columns: 18")
    with pytest.raises(InputError, match="only one whose source is uniform or a chart is a measurement"):
        measurement.open(root)
