"""The experiment `captures`: a chart that is simulated or measured, its light, its labels, and what stands in a row.

The accuracies themselves are looked at by a quick run on MNIST, which is slow.
"""

from __future__ import annotations

import csv
import importlib.util
import json
import pickle
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run as command

from spadmnist import config, experiments, measurement, tiles, twin
from spadmnist.effects.illumination_gradient import IlluminationGradient
from spadmnist.errors import InputError, SpadError
from spadmnist.experiments import Setting, _chip, captures
from spadmnist.experiments.captures import ALL, BRIGHTEST, REAL, SIMULATED, TOGETHER, Captures
from spadmnist.fluxes import Flux
from spadmnist.measurement import Measurement
from spadmnist.scene import Scene

ROOT = Path(__file__).parents[1]
MNIST = ROOT.parent / "shared" / "mnist"
with_torch = pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="PyTorch is not installed")
CLOCK = "{exposure: 1 ms, frames: 100, frame_time: 10 us, readouts: [qis]}"
SMALL = {
    captures.DATASET: f"""\
seed: 3
scene: {{images: {{source: digits, train: 120, test: 40}}, lux: [80 mlux, 2560 mlux]}}
recording: {CLOCK}
sensor: {{layout: {{rows: 28, columns: 28, pixel_area: 25 um^2}}, effects: {{detection: {{pdp: 0.5}}}}}}
""",
    captures.CHART: f"""\
seed: 4
scene:
  images: {{source: chart, of: {{source: digits, train: 40, test: 40}}, count: 16, repetitions: 2}}
  lux: [300 mlux, 2 lux]
recording: {CLOCK}
sensor:
  layout: {{rows: 116, columns: 120, pixel_area: 36 um^2}}
  effects: {{detection: {{pdp: 0.4}}, dark_counts: {{rate: {{lognormal: {{median: 20 Hz, sigma: 2.27}}}}}}}}
""",
}
PLAIN_ROWS = [SIMULATED, "hot pixels", "PDP spread, 4 %", "lazy pixels, 2 %", "the whole chip"]


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A place for runs on few digits that are drawn here, on a small camera."""
    for name, text in SMALL.items():
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(config, "shipped", lambda name: tmp_path / name)
    monkeypatch.setattr(captures._lenet, "EPOCHS", 2)
    monkeypatch.setattr(captures, "ALL_EPOCHS", 1)
    return tmp_path


def bench_of(folder: Path, *labs: Path) -> captures._Bench:
    names = tuple(map(str, labs))
    return captures._Bench(folder / captures.DATASET, folder / captures.CHART, None, None, names, False)


def lab_of(bench: captures._Bench, folder: Path, row: str = SIMULATED, **changed: Any) -> Path:
    """A folder of captures as a row's chip would have recorded them. changed: of each capture of the chart."""
    chip = bench.chips[row]
    asked = [replace(one, **changed) if one.light.scene is not None else one for one in bench.plan.captures]
    plan = measurement.in_memory("lab", chip.layout, asked)
    return measurement.write(folder, "lab", chip.layout, twin.twin(chip, plan, captures.SEED))


# --- the imitation ------------------------------------------------------------------------------------------------


def test_the_chart_is_cut_into_digits_with_their_labels(small: Path) -> None:
    bench = bench_of(small)
    shots, laid = bench.shots(SIMULATED), bench.shown.tiles
    assert laid is not None and laid.labels is not None
    assert [shot.capture.id for shot in shots] == ["300_mlux-1", "300_mlux-2", "2_lux-1", "2_lux-2"]
    assert [len(same) for same in captures._by_light(shots)] == [2, 2]
    originals = laid.cut(bench.shown.pixels[0])
    for shot in shots:
        assert shot.labels.tolist() == laid.labels.tolist() and shot.counts.shape == (16, 28, 28)
        # each tile is of the digit that its label is of: no other original is more like it
        alike = np.corrcoef(shot.counts.reshape(16, -1), originals.reshape(16, -1))[:16, 16:]
        assert (alike.argmax(axis=1) == np.arange(16)).all()
    assert len({shot.counts.tobytes() for shot in shots}) == 4


def test_a_worker_has_the_same_captures(small: Path) -> None:
    bench = bench_of(small)
    before = [shot.digest for shot in bench.shots(TOGETHER)]
    sent = pickle.dumps(bench)
    assert len(sent) < 2000
    assert [shot.digest for shot in pickle.loads(sent).shots(TOGETHER)] == before


def test_each_row_has_one_imperfection_and_the_last_has_all(small: Path) -> None:
    chips = bench_of(small).chips
    names = list(chips)
    assert names[:5] == PLAIN_ROWS and names[-1] == TOGETHER
    values = {
        name: {(e.name, p): np.asarray(getattr(e, p)) for e in chip.effects for p in e.parameters}
        for name, chip in chips.items()
    }
    plain, every = values[SIMULATED], values[TOGETHER]
    assert all(one.ndim == 0 for one in plain.values())
    rate, pdp, relative = ("dark_counts", "rate"), ("detection", "pdp"), ("detection", "relative")
    for row, key in (("hot pixels", rate), ("PDP spread, 4 %", pdp), ("lazy pixels, 2 %", relative)):
        assert {k for k in plain if not np.array_equal(plain[k], values[row][k])} == {key}
        assert np.array_equal(values[row][key], every[key]) and np.array_equal(
            every[key], values["the whole chip"][key]
        )
    # of 13,920 pixels; five standard deviations, false-alarm rate 6e-7 each
    assert abs(np.median(every[rate]) / 20 - 1) < 5 * 2.27 * 1.2533 / 118 and every[rate].max() > 10_000
    assert abs(every[pdp].std() / 0.4 - _chip.SPREAD) < 5 * _chip.SPREAD / 167
    assert abs((every[relative] != 1).mean() - _chip.LAZY) < 5 * 0.14 / 118
    assert abs(every[relative][every[relative] != 1].mean() - _chip.LAZY_PDP[0]) < 5 * 0.14 / 16


def test_what_a_print_does_is_a_row_by_being_in_the_catalogue(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(IlluminationGradient, "of_scene", True, raising=False)
    chips = bench_of(small).chips
    (name,) = [name for name in chips if name.startswith("illumination gradient, x ")]
    row = chips[name]
    assert {e.name for e in row.effects} - {e.name for e in chips[SIMULATED].effects} == {"illumination_gradient"}
    assert chips[TOGETHER].effect("illumination_gradient") is not None
    assert chips["the whole chip"].effect("illumination_gradient") is None


def test_the_light_is_that_of_the_mean_count(small: Path) -> None:
    """Hot pixels do not change it where a capture in the dark tells of them; lazy pixels take their share."""
    bench = bench_of(small)
    for row, low, high in (("hot pixels", 0.97, 1.03), ("lazy pixels, 2 %", 0.96, 1.0), (SIMULATED, 0.98, 1.02)):
        for shot in bench.shots(row):
            # the mean count of 300 mlux has a standard deviation of 0.5 %, and what is left of the dark one of 1 %
            dim = 0.04 if shot.lux < 1 else 0.0
            assert low - dim < shot.fitted / shot.lux < high + dim, (row, shot.capture.id, shot.fitted)


def test_the_light_of_expected_counts_is_exact(small: Path) -> None:
    bench = bench_of(small)
    capture, sensor = bench.plan.captures[1], bench.chart.sensor
    white = twin.photons_at(capture, sensor.layout)
    assert white is not None
    rate, _ = sensor.rates(np.full((1, sensor.layout.pixels), white), capture.conditions)
    expected = -100 * np.expm1(-rate[0] * 10e-6)
    image = Flux(capture, "qis_counts", "1", expected.reshape(sensor.layout.shape), 0, bench.chart.settings)
    assert captures.effective_light(image, sensor, "here") == pytest.approx(0.3, rel=1e-6)
    for counts in (np.zeros(sensor.layout.shape), np.full(sensor.layout.shape, 100.0)):
        with pytest.raises(InputError, match=r"^here: its mean count is .* so its light cannot be told; correct the"):
            captures.effective_light(replace(image, values=counts), sensor, "here")


def test_what_the_paper_has_at_a_level() -> None:
    paper = [captures._paper(lux) for lux in (0.08, 0.29, 0.5, 0.65, 0.06, 5.0)]
    assert [None if one is None else one[BRIGHTEST] for one in paper] == [83.9, 90.2, 91.0, 91.8, None, None]


# --- captures of a camera -----------------------------------------------------------------------------------------


def test_captures_of_a_lab_are_read_as_the_imitation_is(small: Path) -> None:
    bench = bench_of(small)
    lab = lab_of(bench, small / "lab")
    there, here = bench_of(small, lab).shots(REAL), bench.shots(SIMULATED)
    assert [shot.digest for shot in there] == [shot.digest for shot in here]
    assert bench_of(small, lab).rows == [REAL]


def test_a_free_light_level_is_the_fitted_one(small: Path) -> None:
    lab = lab_of(bench_of(small), small / "lab")
    text = (lab / "measurement.yaml").read_text()
    (lab / "measurement.yaml").write_text(re.sub(r", lux: [^}]+|^ +lux: .+\n", "", text, flags=re.M))
    assert "lux:" not in (lab / "measurement.yaml").read_text()
    shots = bench_of(small, lab).shots(REAL)
    assert all(shot.lux == shot.fitted for shot in shots)
    groups = [{one.capture.id for one in same} for same in captures._by_light(shots)]
    assert groups == [{"300_mlux-1", "300_mlux-2"}, {"2_lux-1", "2_lux-2"}]


def test_captures_that_are_not_of_the_chart(small: Path) -> None:
    bench = bench_of(small)
    chart, laid = bench.plan.captures[1], bench.shown.tiles
    scene = chart.light.scene
    assert scene is not None and laid is not None and scene.tiles is laid
    other = scene.stored.copy()
    other[0, 0] ^= 255

    def of(shown: Scene | None) -> dict[str, Any]:
        return {"light": replace(chart.light, scene=shown), "conditions": replace(chart.conditions, scene=shown)}

    facts = laid.facts()
    small_ones, digits = {**facts, "size": [14, 28]}, facts["labels"]
    eleven = [10, *digits[1:]]
    bare = {key: value for key, value in facts.items() if key != "labels"}
    wrong: list[tuple[dict[str, Any], str]] = [
        (
            of(Scene("other.npy", other)),
            r"other.npy is not the chart of .*, and its light says nothing of tiles; fill the plan",
        ),
        (
            of(Scene("other.npy", other, tiles.of_facts(small_ones, scene.shape))),
            "the tiles of other.npy are 14 x 28 pixels, but the networks read 28 x 28; show tiles of that size",
        ),
        (
            of(Scene("other.npy", other, tiles.of_facts(bare, scene.shape))),
            "the tiles of other.npy have no labels, but the networks read the digits 0 to 9; write labels",
        ),
        (
            of(Scene("other.npy", other, tiles.of_facts({**facts, "labels": eleven}, scene.shape))),
            "the tiles of other.npy have the label 10, but the networks read the digits 0 to 9; write labels",
        ),
        (
            {"conditions": replace(chart.conditions, frames=50, exposure=0.5e-3)},
            "has 50 frames, but the networks are trained on sums of 100; record 100 frames",
        ),
        (of(None), "has no QIS capture of a scene; write light:"),
    ]
    for i, (changed, says) in enumerate(wrong):
        lab = lab_of(bench, small / f"lab{i}", **changed)
        with pytest.raises(InputError, match=says):
            bench_of(small, lab).shots(REAL)


def test_a_chart_of_a_lab_tells_its_own_digits(small: Path) -> None:
    """Half of the tiles, in another order; without tiles the chart is known by its image."""
    bench = bench_of(small)
    chart, laid = bench.plan.captures[1], bench.shown.tiles
    scene = chart.light.scene
    assert scene is not None and laid is not None and laid.labels is not None
    some = [3, 12, 7, 0]
    facts = {name: [one[i] for i in some] if name != "size" else one for name, one in laid.facts().items()}
    theirs = replace(scene, tiles=tiles.of_facts(facts, scene.shape))
    for name, shown, digits in (("own", theirs, laid.labels[some]), ("bare", replace(scene, tiles=None), laid.labels)):
        changed = {"light": replace(chart.light, scene=shown), "conditions": replace(chart.conditions, scene=shown)}
        lab = lab_of(bench, small / name, **changed)
        shots = bench_of(small, lab).shots(REAL)
        assert all(shot.labels.tolist() == digits.tolist() for shot in shots)
        assert all(shot.counts.shape == (len(digits), 28, 28) for shot in shots)
        assert (small / name / "chart.json").exists() == (name == "own")


def test_a_lab_of_other_pixels(small: Path) -> None:
    bench = bench_of(small)
    lab = lab_of(bench, small / "lab")
    text = (small / captures.CHART).read_text()
    (small / captures.CHART).write_text(text.replace("rows: 116", "rows: 117"))
    with pytest.raises(InputError, match=r"layout has 116 x 120 pixels, but the sensor 117 x 120"):
        bench_of(small, lab).shots(REAL)


# --- whole runs ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@with_torch
def test_a_run_and_one_on_captures(small: Path) -> None:
    done = experiments.run(Captures(), Setting(small / "out"))
    by_network = {one["network"]: one for one in done.results}
    assert list(by_network) == [BRIGHTEST, ALL] and by_network[ALL]["levels"] == ["80 mlux", "2560 mlux"]
    assert by_network[BRIGHTEST]["levels"] == ["2560 mlux"] and by_network[BRIGHTEST]["epochs"] == 2
    for one in by_network.values():
        assert one["rows"][:5] == PLAIN_ROWS and one["rows"][-1] == TOGETHER and one["captures"] is None
        assert [(each["row"], each["lux"]) for each in one["found"]] == [
            (row, lux) for row in one["rows"] for lux in (0.3, 2.0)
        ]
        for each in one["found"]:
            assert each["accuracy"] == np.mean(each["each"]) and len(each["each"]) == len(each["fitted"]) == 2
            assert each["error"] == pytest.approx((each["accuracy"] * (1 - each["accuracy"]) / 16) ** 0.5)
    with open(small / "out" / "captures.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * len(by_network[ALL]["rows"])
    assert rows[0]["network"] == BRIGHTEST and rows[0]["paper"] == "0.902" and rows[1]["paper"] == ""
    page, text = done.page.read_text(), (small / "out" / "captures.md").read_text()
    for words in ("90.2 %", "hot pixels", "What each imperfection costs", "No camera took these captures"):
        assert words in page and words in text
    assert (small / "out" / "digits.png").stat().st_size > 10_000
    again = experiments.run(Captures(), Setting(small / "out"))
    assert (again.made, again.kept) == (0, 2)
    # the plan that it leaves, recorded by the very camera of the first row, gives that row
    bench = bench_of(small)
    plan = measurement.open(small / "out" / "plan", planned=True)
    made: list[Any] = list(twin.twin(bench.chips[SIMULATED], plan, captures.SEED))
    measurement.fill(plan, made)
    real = experiments.run(Captures(captures=(str(small / "out" / "plan"),)), Setting(small / "real"))
    for one in real.results:
        same = [each for each in by_network[one["network"]]["found"] if each["row"] == SIMULATED]
        assert one["found"] == [{**each, "row": REAL} for each in same] and one["captures"] is not None
    assert "No camera" not in real.page.read_text() and "captured digits" in real.page.read_text()
    with pytest.raises(SpadError, match="is another result"):
        experiments.run(Captures(captures=(str(small / "out" / "plan"),)), Setting(small / "out"))


@with_torch
def test_a_lab_that_is_not_there(small: Path) -> None:
    with pytest.raises(SpadError, match="nowhere"):
        experiments.run(Captures(captures=(str(small / "nowhere"),)), Setting(small / "out"))
    assert not (small / "out" / "results").exists()


def test_a_plan_is_no_lab_yet(small: Path) -> None:
    bench = bench_of(small)
    plan: Measurement = bench.plan
    measurement.write(small / "plan", plan.name, plan.layout, plan.captures)
    with pytest.raises(InputError, match=r"300_mlux-1|dark"):
        bench_of(small, small / "plan").shots(REAL)


def test_the_configs_of_the_experiment_are_shipped() -> None:
    training, chart = (config.read(config.shipped(name)) for name in (captures.DATASET, captures.CHART))
    assert captures.METHOD in training.methods and training.conditions.frames == chart.conditions.frames == 100
    assert sorted(captures.PAPER) == [level.value for level in chart.levels]
    assert chart.source.repetitions == 3 and chart.source.count == 256
    assert chart.sensor.layout.shape == (512, 512) and isinstance(chart.conditions.wavelength, float)
    assert f"LUX-{max(level.value for level in training.levels) * 1000:g}" == BRIGHTEST and len(training.levels) == 10


def test_the_command_describes_it() -> None:
    page = command("experiment", "captures")
    assert page.returncode == 0 and page.stderr == ""
    for words in ("--captures LAB", "OUT/plan", "Source: Suonsivu"):
        assert words in page.stdout


@with_torch
@pytest.mark.slow
@pytest.mark.skipif(not MNIST.is_dir(), reason=f"MNIST's four files are not in {MNIST}")
def test_a_quick_run_on_mnist(tmp_path: Path) -> None:
    """The bound is what one run gave, 0.96 and more, less five binomial errors of 256 digits."""
    words = ["--quick", "--images-dir", MNIST, "--json"]
    done = command("experiment", "captures", "-o", tmp_path / "out", *words, timeout=1800)
    assert done.returncode == 0, done.stderr
    found = {
        (one["network"], each["row"], each["lux"]): each["accuracy"]
        for one in json.loads(done.stdout)["results"]
        for each in one["found"]
    }
    assert len(found) == 2 * 2 * 4
    for lux in captures.PAPER:
        assert found[ALL, SIMULATED, lux] > 0.89
    # what the paper found: who has seen all levels reads the dimmest one better; hot pixels are what it has not seen
    for row in (SIMULATED, TOGETHER):
        assert found[ALL, row, 0.08] > found[BRIGHTEST, row, 0.08]
    assert found[BRIGHTEST, TOGETHER, 0.08] < found[BRIGHTEST, SIMULATED, 0.08] - 0.1
