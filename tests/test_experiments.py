"""Experiments: a file is all that one needs; a run goes on where it stopped; every mistake is a sentence.

The accuracies themselves are looked at by a quick run on MNIST, which is slow.
"""

from __future__ import annotations

import csv
import importlib.util
import json
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run as command
from test_factory import assert_sentence, tree

from spadmnist import config, experiments
from spadmnist.errors import SpadError
from spadmnist.experiments import PaperExperiment, Plan, Setting, Task, accuracy, option
from spadmnist.experiments.accuracy import Accuracy
from spadmnist.factory import Progress
from spadmnist.pages import Drawing, Story, Table

ROOT = Path(__file__).parents[1]
MNIST = ROOT.parent / "shared" / "mnist"
with_torch = pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="PyTorch is not installed")
SMALL = """\
seed: 3
scene:
  images: {source: digits, train: 200, test: 40}
  lux: [5 mlux, 2560 mlux]
recording: {exposure: 1 ms, frames: 100, frame_time: 10 us, readouts: [tr, str, qis]}
reconstruct: [counts, inter_photon, str_flux, qis_counts]
sensor:
  layout: {rows: 28, columns: 28, pixel_area: 25 um^2}
  effects: {detection: {pdp: 0.5}, dark_counts: {rate: 100 Hz}, dead_time: {duration: 50 ns}, tdc: {resolution: 10 ps}}
"""


# --- the frame, by an experiment of one file ----------------------------------------------------------------------


class Squares(PaperExperiment):
    """What are the squares of the first numbers?

    Each is measured by itself.
    """

    up_to = option(3.0, "The last number.", bounds=(1, 9))
    add = option((), "One more number.", several=True, metavar="N")

    def prepare(self, setting: Setting) -> Plan:
        numbers = [*range(1, int(self.up_to) + 1), *map(int, self.add)]
        return Plan({"quick": setting.quick}, [Task(f"n{n}", {"number": n}, work=n, given=n) for n in numbers])

    def measure(self, task: Task) -> dict[str, Any]:
        if task.given == 4:
            raise SpadError("4 cannot be squared; leave it out")
        return {"square": task.given**2}

    def tell(self, result: Mapping[str, Any]) -> str:
        return f"{result['number']} -> {result['square']}"

    def rows(self, results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        return [{"number": one["number"], "square": one["square"]} for one in results]

    def story(self, results: Sequence[Mapping[str, Any]]) -> Story:
        def draw(figure: Any) -> None:
            figure.subplots().plot([one["number"] for one in results], [one["square"] for one in results])

        cells = [[str(one["number"]), str(one["square"])] for one in results]
        table = Table("<squares>", ["number", "a|b"], cells, "a note")
        parts = [table, Drawing("parabola", "A picture", "a parabola", (4.0, 3.0), draw)]
        return Story("Squares", f"{len(results)} squares", ["Nothing else."], {"method": "by hand"}, parts)


def told() -> tuple[Progress, list[str]]:
    said: list[str] = []
    return Progress(notice=said.append), said


def files(root: Path) -> dict[str, bytes | str]:
    """What lies in a run's folder, without its dataset, and results without how long they took."""
    found = {name: content for name, content in tree(root).items() if not name.startswith("dataset")}
    return {n: re.sub(rb'"seconds": [\d.]+', b"", c) if isinstance(c, bytes) else c for n, c in found.items()}


def test_one_class_is_all_that_an_experiment_needs(tmp_path: Path) -> None:
    progress, said = told()
    done = experiments.run(Squares(), Setting(tmp_path / "out", progress=progress))
    assert (done.made, done.kept) == (3, 0) and [one["square"] for one in done.results] == [1, 4, 9]
    assert [line.partition(";")[0] for line in said] == ["1 of 3: 1 -> 1", "2 of 3: 2 -> 4", "3 of 3: 3 -> 9"]
    assert said[0].endswith(" s left") and "left" not in said[-1]
    there = tree(tmp_path / "out")
    results = [f"results/n{n}.json" for n in (1, 2, 3)]
    assert sorted(there) == sorted([*results, "parabola.png", "report.html", "squares.csv", "squares.md"])
    assert json.loads(there["results/n3.json"]) == {
        "format": "spadmnist-result/1", "experiment": "squares", "quick": False, "number": 3, "square": 9,
    }  # fmt: skip
    assert there["squares.csv"] == b"number,square\n1,1\n2,4\n3,9\n"
    page, text = (str(there[name], "utf-8") for name in ("report.html", "squares.md"))  # type: ignore[call-overload]
    assert "&lt;squares&gt;" in page and "<squares>" not in page and page.count("data:image/png;base64,") == 1
    assert "default-src 'none'" in page and "3 squares" in page and "by hand" in page and "a note" in page
    assert "| number | a\\|b |\n| --- | --: |\n| 1 | 1 |" in text and "![a parabola](parabola.png)" in text
    assert experiments.answer(done.story).splitlines()[-1].split() == ["3", "9"]


def test_a_run_goes_on_where_it_stopped(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(SpadError, match="4 cannot be squared"):
        experiments.run(Squares(up_to=6.0), Setting(out))
    assert sorted(path.stem for path in (out / "results").iterdir()) == ["n1", "n2", "n3"]
    (out / "results" / "n2.json").write_text("{")
    before = (out / "results" / "n1.json").stat().st_mtime_ns
    progress, said = told()
    done = experiments.run(Squares(add=("7",)), Setting(out, progress=progress))
    assert (done.made, done.kept) == (2, 2) and "n2.json cannot be read, and is measured again" in said[0]
    assert (out / "results" / "n1.json").stat().st_mtime_ns == before
    # what an earlier run was asked for besides is shown, too
    done = experiments.run(Squares(up_to=1.0), Setting(out))
    assert (done.made, done.kept) == (0, 1) and [one["number"] for one in done.results] == [1, 2, 3, 7]
    experiments.run(Squares(add=("7",)), Setting(tmp_path / "at once"))
    assert files(out) == files(tmp_path / "at once")


def test_results_of_something_else_are_left_alone(tmp_path: Path) -> None:
    out = tmp_path / "out"
    experiments.run(Squares(), Setting(out))
    before = tree(out)
    with pytest.raises(SpadError, match=r"n1.json: is another result \(quick: False there, True asked for\); choose"):
        experiments.run(Squares(), Setting(out, quick=True))
    (out / "results" / "n1.json").write_text(json.dumps({"format": "x"}))
    with pytest.raises(SpadError, match="format: x there, spadmnist-result/1 asked for"):
        experiments.run(Squares(), Setting(out))
    (out / "results" / "n1.json").write_bytes(before["results/n2.json"])  # type: ignore[arg-type]
    with pytest.raises(SpadError, match="number: 2 there, 1 asked for"):
        experiments.run(Squares(), Setting(out))
    (out / "results" / "n1.json").write_bytes(before["results/n1.json"])  # type: ignore[arg-type]
    assert tree(out) == before


def test_a_folder_that_is_none_of_a_run_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "report.html").write_text("mine")
    for out, why in ((tmp_path / "file", "is a file"), (tmp_path, "is not from an experiment")):
        with pytest.raises(SpadError, match=why):
            experiments.run(Squares(), Setting(out))
    assert sorted(tree(tmp_path)) == ["file", "report.html"]


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"up_to": 10.0}, "--up-to: 10 is not possible; give at least 1 and at most 9"),
        ({"up_to": float("nan")}, "--up-to: nan is not possible"),
        ({"down_to": 1.0}, "--down-to: squares has no such option; spadmnist experiment squares lists them"),
    ],
)
def test_an_option_that_is_wrong(values: dict[str, Any], says: str) -> None:
    with pytest.raises(SpadError, match=re.escape(says)):
        Squares(**values)


def test_an_experiment_describes_itself() -> None:
    assert {"accuracy", "squares"} <= set(PaperExperiment.registry)
    assert "squares     What are the squares of the first numbers?" in experiments.text()
    page = experiments.text("squares")
    assert "Each is measured by itself." in page and "--add N" in page and "The last number." in page
    assert experiments.as_data("squares")["options"]["up_to"] == {"about": "The last number.", "default": 3.0}
    with pytest.raises(KeyError, match=r"Did you mean squares\? \(spadmnist experiment lists all\)"):
        experiments.text("square")


def test_results_are_put_into_the_documentation(tmp_path: Path) -> None:
    experiments.run(Squares(), Setting(tmp_path / "out"))
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text("# Page\n<!-- squares: begin -->\nold | text\n<!-- squares: end -->\nthe end\n")
    script = [sys.executable, ROOT / "scripts" / "experiments.py", "--page", page]
    for _ in range(2):
        subprocess.run([*script, tmp_path / "out"], check=True, capture_output=True)
    text = page.read_text()
    assert text.startswith("# Page\n<!-- squares: begin -->\n**3 squares**") and text.endswith("end -->\nthe end\n")
    assert "old" not in text and "![a parabola](squares-parabola.png)" in text and text.count("| 2 | 4 |") == 1
    picture = (tmp_path / "docs" / "squares-parabola.png").read_bytes()
    assert picture == (tmp_path / "out" / "parabola.png").read_bytes()
    page.write_text("nothing")
    done = subprocess.run([*script, tmp_path / "out"], capture_output=True, text=True)
    assert done.returncode == 1 and "has no place for squares" in done.stderr and page.read_text() == "nothing"
    done = subprocess.run([*script, tmp_path / "docs" / "none"], capture_output=True, text=True)
    assert done.returncode == 1 and "holds no results" in done.stderr


def test_the_documentation_has_a_place_for_each_experiment() -> None:
    text = (ROOT / "docs" / "experiments.md").read_text()
    for name in set(PaperExperiment.registry) - {"squares"}:
        assert f"<!-- {name}: begin -->\n" in text and f"<!-- {name}: end -->" in text, name


# --- accuracy, on digits that are drawn here ----------------------------------------------------------------------


@pytest.fixture
def digits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A place for runs on a small dataset, of one epoch."""
    (tmp_path / "small.yaml").write_text(SMALL)
    monkeypatch.setattr(config, "shipped", lambda name: tmp_path / "small.yaml")
    monkeypatch.setattr(accuracy._lenet, "EPOCHS", 2)
    return tmp_path


@with_torch
def test_accuracies_of_every_method_and_level(digits: Path) -> None:
    done = experiments.run(Accuracy(), Setting(digits / "out"))
    keys = {f"{m}-{x}" for m in ("counts", "inter_photon", "str_flux", "qis_counts") for x in ("5_mlux", "2560_mlux")}
    keys |= {"mnist", "inter_photon_to_20-5_mlux", "inter_photon_to_20-2560_mlux"}
    results = {one["key"]: one for one in done.results}
    assert results.keys() == keys
    seal = json.loads((digits / "out" / "dataset" / "manifest.json").read_text())["sha256"]
    for one in results.values():
        assert one["digest"] == seal and one["n"] == 40 and one["train"] == 200 and one["epochs"] == 2
        assert one["after_epochs"] == {"2": one["accuracy"]} and 0 <= one["accuracy"] <= 1 and one["seconds"] >= 0
        assert one["error"] == pytest.approx((one["accuracy"] * (1 - one["accuracy"]) / 40) ** 0.5)
    # each network had images of its own: none was given those of another method, level or normalisation
    assert len({one["inputs"] for one in results.values()}) == len(results)
    assert results["inter_photon_to_20-5_mlux"]["largest"] == 20 < results["inter_photon-5_mlux"]["largest"]
    assert results["qis_counts-2560_mlux"]["largest"] <= 100 and results["qis_counts-5_mlux"]["largest"] < 10
    with open(digits / "out" / "accuracy.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(results) and rows[0]["method"] == "mnist"
    assert float(rows[1]["accuracy"]) == results["counts-5_mlux"]["accuracy"]
    page = done.page.read_text()
    assert "99.22 %" in page and "its text has no numbers of them" in page and "inter_photon, inputs up to 20" in page
    again = experiments.run(Accuracy(), Setting(digits / "out"))
    assert (again.made, again.kept) == (0, len(keys))


@pytest.mark.slow
@with_torch
def test_two_workers_find_the_same(digits: Path) -> None:
    """And so does a run that was interrupted."""
    chosen = Accuracy(lux=("2.56 lux",), method=("counts", "qis_counts"))
    one = experiments.run(chosen, Setting(digits / "one", jobs=1))
    assert [x["key"] for x in one.results] == ["counts-2560_mlux", "mnist", "qis_counts-2560_mlux"]
    experiments.run(Accuracy(lux=("2560 mlux",), method=("counts",)), Setting(digits / "two", jobs=1))
    (digits / "two" / "results" / "mnist.json").unlink()
    two = experiments.run(chosen, Setting(digits / "two", jobs=2))
    assert (two.made, two.kept) == (2, 1)
    assert files(digits / "one") == files(digits / "two")


@with_torch
def test_the_networks_input_is_the_normalised_image(digits: Path) -> None:
    made = experiments.run(Accuracy(method=("counts",)), Setting(digits / "out")).results
    import hashlib

    import spadmnist

    part = spadmnist.open(digits / "out" / "dataset")["2560 mlux", "train"]
    by_key = {one["key"]: one["inputs"] for one in made}
    fluxes = np.ascontiguousarray(part.reconstruction["counts"].normalised[:], np.float32)
    assert by_key["counts-2560_mlux"] == hashlib.sha256(fluxes.data).hexdigest()
    grey = part.images[:].astype(np.float32)
    assert by_key["mnist"] == hashlib.sha256((grey / np.median(grey[grey > 0])).data).hexdigest()


@with_torch
@pytest.mark.parametrize(
    ("values", "says"),
    [
        (
            {"method": ("count",)},
            "--method: count is not a method here. Did you mean counts? There are counts, inter_ph",
        ),
        ({"lux": ("7 mlux",)}, "--lux: '7 mlux' is not a light level here"),
        ({"clip": 5.0, "method": ("counts",)}, "--clip: is of inter_photon, which --method leaves out"),
    ],
)
def test_what_is_not_there(values: dict[str, Any], says: str, digits: Path) -> None:
    with pytest.raises(SpadError, match=re.escape(says)):
        experiments.run(Accuracy(**values), Setting(digits / "out"))
    assert not (digits / "out").exists()


@with_torch
def test_results_of_another_dataset(digits: Path) -> None:
    chosen = Accuracy(method=("counts",), lux=("5 mlux",))
    experiments.run(chosen, Setting(digits / "out"))
    (digits / "small.yaml").write_text(SMALL.replace("seed: 3", "seed: 4"))
    with pytest.raises(SpadError, match=r"holds another dataset: config.seed: 3 there, 4 asked for"):
        experiments.run(chosen, Setting(digits / "out"))
    (digits / "out" / "dataset").rename(digits / "old")
    with pytest.raises(SpadError, match=r"counts-5_mlux.json: is another result \(digest: .{12}\.\.\. there"):
        experiments.run(chosen, Setting(digits / "out"))


def test_without_torch_it_says_what_to_install(digits: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "spadmnist.torch", raising=False)
    monkeypatch.delattr("spadmnist.torch", raising=False)
    with pytest.raises(SpadError, match=r"^accuracy: .* pip install 'spadmnist\[train\]'") as said:
        experiments.run(Accuracy(), Setting(digits / "out"))
    assert "\n" not in str(said.value) and not (digits / "out").exists()


def test_the_config_of_the_experiment_is_shipped() -> None:
    assert config.read(config.shipped(accuracy.CONFIG)).methods
    with pytest.raises(SpadError, match=r"nothing.yaml, which comes with the program, is not there"):
        config.shipped("nothing.yaml")


# --- by the command line ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_lists_and_describes() -> None:
    listed, page = command("experiment"), command("experiment", "accuracy")
    assert listed.returncode == page.returncode == 0 and listed.stderr == page.stderr == ""
    assert re.search(r"^accuracy +How well does LeNet", listed.stdout, re.M)
    for word in ("--clip X", "--lux LEVEL", "--method METHOD", "Source: Suonsivu"):
        assert word in page.stdout
    told = json.loads(command("experiment", "accuracy", "--json").stdout)
    assert told["name"] == "accuracy" and told["options"]["clip"]["default"] == 20.0
    help = command("experiment", "accuracy", "--help").stdout
    assert "--clip X" in help and "--quick" in help and "--clip" not in command("experiment", "--help").stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["acuracy", "-o", "out"], "acuracy is not an experiment. Did you mean accuracy?"),
        (["accuracy", "--clip", "2"], "--clip: says how an experiment is done"),
        (["-o", "out"], "--output: says how an experiment is done"),
        (["accuracy", "--quick"], "--quick: says how"),
        (["accuracy", "-o", "out", "--clip", "-1"], "--clip: -1 is not possible; give at least 0"),
        (["accuracy", "-o", "out", "--clpi", "1"], "No such option '--clpi'"),
        (["accuracy", "-o", "out", "--jobs", "0"], "--jobs"),
    ],
)
def test_wrong_words(words: list[str], says: str, tmp_path: Path) -> None:
    done = command("experiment", *words, cwd=tmp_path)
    assert_sentence(done, says)
    assert done.stdout == "" and tree(tmp_path) == {}


# --- the accuracies themselves ------------------------------------------------------------------------------------

COUNTING = ("counts", "passive_free_running", "str_flux", "qis_counts", "qis_linear")
# per cent, of all methods that count; how far they may lie apart
ACCURACIES = {"5 mlux": (50, 64, 4), "80 mlux": (94, 97.8, 1.5), "2560 mlux": (95, 99, 1.5)}
# of the inputs at 2560 mlux: fluxes over their median, and frames, of which there are 100
LARGEST = {
    **dict.fromkeys(("counts", "passive_free_running", "str_flux"), (2.5, 5)),
    **{"qis_counts": (80, 100), "qis_linear": (150, 531), "clipped": (20, 20), "inter_photon": (1e4, 1e9)},
}


def judge(results: Sequence[Mapping[str, Any]]) -> None:
    """Is each method, at each level, as it is wherever it works?

    A network is the same for the same sums; other processors add in another order, which moves an accuracy by about
    its binomial error (0.5 at 57 %, 0.2 at 96 %): the bounds lie six of them and more to either side.
    """
    found = {(one["method"] if one["clip"] is None else "clipped", one["level"]): one for one in results}
    assert len(found) == len(results) == 22
    assert len({one["inputs"] for one in results}) == len(results), "two networks were given the same"
    assert 95 < 100 * found["mnist", None]["accuracy"] < 98.4
    for level, (low, high, apart) in ACCURACIES.items():
        counting = {method: 100 * found[method, level]["accuracy"] for method in COUNTING}
        assert low < min(counting.values()) and max(counting.values()) < high, (level, counting)
        assert max(counting.values()) - min(counting.values()) < apart, (level, counting)
        plain, clipped = (100 * found[method, level]["accuracy"] for method in ("inter_photon", "clipped"))
        assert plain < clipped < min(counting.values()), (level, plain, clipped, counting)
    for method, (least, most) in LARGEST.items():
        assert least <= found[method, "2560 mlux"]["largest"] <= most, (method, found[method, "2560 mlux"]["largest"])


@with_torch
@pytest.mark.slow
@pytest.mark.long
@pytest.mark.skipif(not MNIST.is_dir(), reason=f"MNIST's four files are not in {MNIST}")
def test_a_quick_run_on_mnist(tmp_path: Path) -> None:
    words = ["--quick", "--images-dir", MNIST, "--json"]
    done = command("experiment", "accuracy", "-o", tmp_path / "out", *words, timeout=3600)
    assert done.returncode == 0, done.stderr
    judge(json.loads(done.stdout)["results"])


@with_torch
def test_training_leaves_threads_and_random_numbers_as_they_were() -> None:
    import torch

    rng = np.random.Generator(np.random.SFC64(1))
    data = accuracy.Labelled(rng.random((100, 28, 28), np.float32), np.arange(100) % 10)
    torch.manual_seed(5)
    threads, before = torch.get_num_threads(), torch.random.get_rng_state()
    first = accuracy._lenet.train(data, 1, 2)
    torch.manual_seed(6)
    second = accuracy._lenet.train(data, 1, 2)
    torch.manual_seed(5)
    assert torch.get_num_threads() == threads and torch.equal(torch.random.get_rng_state(), before)
    pairs = zip(first.parameters(), second.parameters(), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)
    other = accuracy._lenet.train(data, 1, 3)
    assert not torch.equal(next(iter(first.parameters())), next(iter(other.parameters())))


@with_torch
def test_the_weights_are_the_mean_of_the_last_epoch() -> None:
    """Of two steps: the first is what an epoch of half as many images ends with."""
    import torch

    rng = np.random.Generator(np.random.SFC64(1))
    images, labels = rng.random((128, 28, 28), np.float32), np.arange(128) % 10
    order = torch.randperm(128, generator=torch.Generator().manual_seed(4)).numpy()
    train = accuracy._lenet.train
    both = train(accuracy.Labelled(images, labels), 1, 4)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            torch,
            "_foreach_lerp_",
            lambda means, weights, share: [a.copy_(b) for a, b in zip(means, weights, strict=True)],
        )
        last = train(accuracy.Labelled(images, labels), 1, 4)
        patch.setattr(torch, "randperm", lambda n, generator: torch.arange(n))
        first = train(accuracy.Labelled(images[order[:64]], labels[order[:64]]), 1, 4)
    for a, b, mean in zip(first.parameters(), last.parameters(), both.parameters(), strict=True):
        assert torch.allclose(mean, (a + b) / 2, atol=1e-6) and not torch.equal(a, b)
