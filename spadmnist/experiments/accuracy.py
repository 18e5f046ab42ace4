"""The paper's figure of accuracies: LeNet on flux images, by method and light level."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .. import config, dataset, factory, reconstruct
from ..dataset import Part
from ..errors import SpadError, did_you_mean
from ..experiment import Level, level_of
from ..pages import Drawing, Story, Table
from ..reconstruct import Method
from . import PaperExperiment, Plan, Setting, Task, _lenet, option
from ._lenet import Labelled

CONFIG = "spad_mnist.yaml"
ORIGINAL = "mnist"  # the originals, as a method
CLIPPED = "inter_photon"  # the method whose inputs are so large that --clip makes a difference
EARLY = 3  # epochs after which the tables say how far a network has come
SEED = 1  # of the first weights and of the order of the images
# less of everything: a network learns enough to tell the methods apart at three levels
QUICK_LEVELS, QUICK_IMAGES, QUICK_EPOCHS = ("5 mlux", "80 mlux", "2560 mlux"), 10_000, 5
PAPER = "99.22 %"  # paper, section "Classification on synthetic data": LeNet on the original MNIST
_ZOOM = 0.95  # accuracies from here on are in the inset


class Accuracy(PaperExperiment):
    """How well does LeNet read digits from the flux images of each method, in less and less light?

    A network is trained for each of the six reconstructions at each light level of SPAD-MNIST (60,000 images; 10
    epochs, batches of 64, Adam with a learning rate of 0.001), and classifies the 10,000 test images. The originals,
    MNIST itself, are the reference. All images are divided by the median of the non-zero training pixels but those of
    QIS, as the paper does. Every network begins with the same weights and sees the images in the same order.

    The dataset is made in OUT/dataset (12 GB; 1 GB with --quick, which takes three levels, 10,000 images of each split
    and 5 epochs). It needs PyTorch. Source: Suonsivu et al., section "Classification on synthetic data".
    """

    lux = option((), "Only this light level (repeatable).", several=True, metavar="LEVEL")
    method = option((), "Only this reconstruction (repeatable).", several=True, metavar="METHOD")
    clip = option(
        20.0,
        f"Train on {CLIPPED} a second time, with inputs that end at X; 0: not.  [default: 20, where the paper's "
        "pictures end]",
        bounds=(0, None),
    )

    def prepare(self, setting: Setting) -> Plan:
        _lenet.check_torch(self.name)
        experiment = config.read(config.shipped(CONFIG), limit=QUICK_IMAGES if setting.quick else None)
        if setting.quick:
            experiment = experiment.with_levels(QUICK_LEVELS)
        methods = self._chosen_methods(experiment.methods)
        levels = self._chosen_levels(experiment.levels)
        if self.clip != type(self).clip and CLIPPED not in methods:
            raise SpadError(f"--clip: is of {CLIPPED}, which --method leaves out; leave out one of the two")
        images = experiment.load_images(setting.images_dir)
        root = setting.out / "dataset"
        made = factory.generate(experiment, images, root, setting.jobs, setting.progress)
        epochs = QUICK_EPOCHS if setting.quick else _lenet.EPOCHS
        common = {
            "digest": made.manifest["sha256"],
            "seed": SEED,
            "epochs": epochs,
            "n": experiment.wanted(images["test"]),
            "train": experiment.wanted(images["train"]),
        }
        asked: list[tuple[str, Level | None, float | None]] = [(ORIGINAL, None, None)]
        for level in (one for one in experiment.levels if one.text in levels):
            for method in methods:
                asked.append((method, level, None))
                asked += [(method, level, self.clip)] if method == CLIPPED and self.clip else []
        first = experiment.levels[0]  # the originals are the same at all of them
        return Plan(common, [_task(*one, (str(root), (one[1] or first).text, epochs)) for one in asked])

    def _chosen_methods(self, there: Sequence[str]) -> list[str]:
        for name in self.method:
            if name not in there:
                raise SpadError(
                    f"--method: {name} is not a method here.{did_you_mean(name, there)} There are {', '.join(there)}"
                )
        return [name for name in there if not self.method or name in self.method]

    def _chosen_levels(self, there: Sequence[Level]) -> list[str]:
        try:
            return [level_of(there, text).text for text in self.lux] or [level.text for level in there]
        except KeyError as error:
            raise SpadError(f"--lux: {error.args[0]}") from None

    def measure(self, task: Task) -> dict[str, Any]:
        root, level, epochs = task.given
        started = time.monotonic()
        opened = dataset.open(root)
        train, test = (
            _labelled(opened[level, "train"], opened[level, split], task.about["method"], task.about["clip"])
            for split in ("train", "test")
        )
        found: dict[str, float] = {}

        def tested(net: Any, epoch: int) -> None:
            if epoch in (EARLY, epochs):
                found[str(epoch)] = _lenet.accuracy(net, test)

        _lenet.train(train, epochs, SEED, tested)
        accuracy = found[str(epochs)]
        return {
            "accuracy": accuracy,
            "error": math.sqrt(accuracy * (1 - accuracy) / len(test.labels)),
            "after_epochs": found,
            "largest": float(train.images.max()),
            "inputs": hashlib.sha256(train.images.data).hexdigest(),
            "seconds": round(time.monotonic() - started, 1),
        }

    def tell(self, result: Mapping[str, Any]) -> str:
        at = "" if result["level"] is None else f" at {result['level']}"
        return f"{_name(result)}{at}: {_percent(result)}"

    def rows(self, results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        columns = ("method", "clip", "level", "lux", "accuracy", "error", "n", "train", "epochs", "seed")
        return [{name: result[name] for name in columns} for result in _sorted(results)]

    def story(self, results: Sequence[Mapping[str, Any]]) -> Story:
        return _Curves(results).story()


def _task(method: str, level: Level | None, clip: float | None, given: Any) -> Task:
    name = method if clip is None else f"{method}_to_{clip:g}"
    of = {"level": None, "lux": None} if level is None else {"level": level.text, "lux": level.value}
    return Task(
        name if level is None else f"{name}-{level.folder}", {"method": method, "clip": clip, **of}, given=given
    )


# --- what a network is given --------------------------------------------------------------------------------------


def _labelled(train: Part, part: Part, method: str, clip: float | None) -> Labelled:
    """The images of a part, as a network is given them. train: the training split, whose median they are divided by."""
    assert part.labels is not None
    if method == ORIGINAL:
        median = reconstruct.median_of_nonzero(lambda: [train.images[:].astype(np.float32)])
        images = part.images[:].astype(np.float32) / np.float32(median or 1.0)
    else:
        images = part.reconstruction[method].normalised[:]
    if clip is not None:
        images = np.minimum(images, np.float32(clip))
    return Labelled(np.ascontiguousarray(images, np.float32), part.labels)


# --- what is shown ------------------------------------------------------------------------------------------------


def _name(result: Mapping[str, Any]) -> str:
    if result["method"] == ORIGINAL:
        return "MNIST"
    return result["method"] if result["clip"] is None else f"{result['method']}, inputs up to {result['clip']:g}"


def _percent(result: Mapping[str, Any]) -> str:
    return f"{100 * result['accuracy']:.2f} ± {100 * result['error']:.2f} %"


def _points(share: float) -> str:
    return f"{100 * share:.2f} percentage points"


def _sorted(results: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """MNIST first; then method after method, in the order of their readouts, the dimmest level first."""
    methods = sorted(Method.registry, key=lambda name: (reconstruct.find(name).columns, name))

    def place(result: Mapping[str, Any]) -> tuple[int, float, float]:
        method = result["method"]
        return (-1 if method == ORIGINAL else methods.index(method)), result["clip"] or 0.0, result["lux"] or 0.0

    return sorted(results, key=place)


class _Curves:
    """The results by curve (a method, perhaps clipped) and level."""

    def __init__(self, results: Sequence[Mapping[str, Any]]):
        self.results = _sorted(results)
        self.original = next((one for one in self.results if one["method"] == ORIGINAL), None)
        self.curves: dict[str, dict[str, Mapping[str, Any]]] = {}
        for one in self.results:
            if one["level"] is not None:
                self.curves.setdefault(_name(one), {})[one["level"]] = one
        lux = {one["level"]: one["lux"] for one in self.results if one["level"] is not None}
        self.levels = sorted(lux, key=lambda level: lux[level])
        self.lux = [lux[level] for level in self.levels]

    def story(self) -> Story:
        one = self.results[0]
        facts = {
            "network": _lenet.WORDS,
            "training": f"{one['train']:,} images, {one['epochs']} epochs, batches of {_lenet.BATCH}, Adam with a "
            f"learning rate of {_lenet.RATE:g}, seed {one['seed']}; tested with the mean of the last epoch's weights",
            "test": f"{one['n']:,} images that no network was trained on",
            "errors": "one binomial standard deviation of the test images; another seed moves an accuracy as well",
            "dataset": f"{CONFIG}, manifest sealed {one['digest'][:16]}",
            "results": f"{len(self.results)}",
        }
        parts: list[Table | Drawing] = []
        if self.curves:
            parts = [self._drawing(), self._table()]
        parts += [self._beside_the_paper(), *self._clipped()]
        return Story("Accuracy of LeNet on flux images", self._answer(), self._lead(), facts, parts)

    def _answer(self) -> str:
        words = [] if self.original is None else [f"{_percent(self.original)} of MNIST"]
        for level in dict.fromkeys((*self.levels[-1:], *self.levels[:1])):
            found = [100 * curve[level]["accuracy"] for curve in self.curves.values() if level in curve]
            span = f"{min(found):.1f} to {max(found):.1f} %" if len(found) > 1 else f"{found[0]:.1f} %"
            words.append(f"{span} at {level}")
        return "LeNet reads " + ", ".join(words)

    def _lead(self) -> list[str]:
        said = ["A network of its own for each reconstruction and light level."]
        if self.results[0]["epochs"] < _lenet.EPOCHS:
            said.append("These are quick results: fewer levels, images and epochs than the paper has.")
        plain = self.curves.get(CLIPPED, {})
        for curve in self.curves.values():
            both = [level for level in self.levels if level in plain and level in curve and curve[level]["clip"]]
            if both:
                level = max(both, key=lambda x: abs(curve[x]["accuracy"] - plain[x]["accuracy"]))
                said.append(
                    f"Where the inputs of {CLIPPED} end at {curve[level]['clip']:g} instead of "
                    f"{plain[level]['largest']:.2g}, its accuracy at {level} is {_percent(curve[level])} instead of "
                    f"{_percent(plain[level])}: of all levels there it makes the largest difference."
                )
        return said

    def _table(self) -> Table:
        header = ["accuracy, %", *self.levels]
        rows = [
            [name, *(f"{100 * curve[x]['accuracy']:.2f}" if x in curve else "-" for x in self.levels)]
            for name, curve in self.curves.items()
        ]
        worst = max(one["error"] for one in self.results)
        return Table(
            "Accuracies", header, rows, f"The binomial error is at most {_points(worst)}; it stands in the CSV."
        )

    def _others(self, level: str) -> list[float]:
        """Accuracies of all methods but the one that the paper sets apart."""
        return [
            curve[level]["accuracy"]
            for curve in self.curves.values()
            if level in curve and curve[level]["method"] != CLIPPED
        ]

    def _beside_the_paper(self) -> Table:
        rows = []
        if self.original is not None:
            rows.append(["LeNet on MNIST", PAPER, _percent(self.original)])
        spans = {level: self._others(level) for level in self.levels}
        wide = max(spans, key=lambda x: max(spans[x], default=0) - min(spans[x], default=0), default=None)
        if wide is not None and len(spans[wide]) > 1:
            widest = _points(max(spans[wide]) - min(spans[wide]))
            words = f'all methods but {CLIPPED} are "closely overlapping"'
            rows.append([words, "no number", f"at most {widest} apart, at {wide}"])
        plain = self.curves.get(CLIPPED, {})
        said = (
            f'{CLIPPED} "struggles at extreme low lux levels"',
            f'even at higher levels {CLIPPED} "is lower than others"',
        )
        for level, words in zip((*self.levels[:1], *self.levels[-1:]), said, strict=False):
            if level in plain and self._others(level):
                least = min(self._others(level)) - plain[level]["accuracy"]
                rows.append([words, "no number", f"{_points(least)} below the least of the others at {level}"])
        note = (
            "The paper gives its curves as a figure only: its text has no numbers of them, and what one reads off a "
            "figure is approximate, so none stands here."
        )
        return Table("Beside the paper", ["what the paper says", "paper", "here"], rows, note)

    def _clipped(self) -> list[Table]:
        """What becomes of the method whose inputs are so large, and what clipping them does."""
        names = [name for name, curve in self.curves.items() if next(iter(curve.values()))["method"] == CLIPPED]
        if not names:
            return []
        epochs = sorted(self.results[0]["after_epochs"], key=int)
        header = ["level", "largest input"]
        for name in names:
            ends = next(iter(self.curves[name].values()))["clip"]
            what = "as they are" if ends is None else f"up to {ends:g}"
            header += [f"{what}, {n} epochs" for n in epochs]
        rows = []
        for level in self.levels:
            there = [self.curves[name].get(level) for name in names]
            plain = self.curves.get(CLIPPED, {}).get(level)
            cells = ["-" if one is None else f"{100 * one['after_epochs'][n]:.2f}" for one in there for n in epochs]
            rows.append([level, "-" if plain is None else f"{plain['largest']:.2g}", *cells])
        note = (
            f"Two detections close together make {CLIPPED} estimate a flux as large as their interval is short: inputs "
            "far beyond 1, the median. A network must first learn to bear them, unless they are clipped."
        )
        return [Table(f"What clipping the inputs of {CLIPPED} does: accuracy, %", header, rows, note)]

    def _drawing(self) -> Drawing:
        words = (
            "Accuracy of LeNet over the light level, a curve for each method; beside it the high accuracies, enlarged"
        )
        note = (
            "Bars are binomial errors; the dashed line is MNIST itself. The light level is that of white on the sensor."
        )
        return Drawing("accuracy", "Accuracy by light level", words, (9.6, 5.2), self._draw, note)

    def _draw(self, figure: Any) -> None:
        high = [one for one in self.results if one["lux"] and one["accuracy"] >= _ZOOM]
        # the paper's inset, beside the curves, where it hides none
        axes = figure.subplots(1, 2 if high else 1, squeeze=False, width_ratios=[3, 2] if high else [1])[0]
        for one in axes:
            self._draw_curves(one)
        axes[0].set(ylabel="accuracy, %", ylim=(0, 102))
        if high:
            top = max(one["accuracy"] for one in [*high, *([] if self.original is None else [self.original])])
            axes[1].set(title=f"{100 * _ZOOM:.0f} % and more", ylim=(100 * _ZOOM, 100 * top + 0.3))
            axes[1].set_xlim(min(one["lux"] for one in high) / 1.2, max(self.lux) * 1.2)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)

    def _draw_curves(self, axes: Any) -> None:
        for number, (name, curve) in enumerate(self.curves.items()):
            shown = [curve[level] for level in self.levels if level in curve]
            axes.errorbar(
                [one["lux"] for one in shown],
                [100 * one["accuracy"] for one in shown],
                [100 * one["error"] for one in shown],
                color=f"C{number}",
                marker="osv^Dx*P"[number % 8],
                markersize=4.5,
                linewidth=1.2,
                linestyle="-" if shown[0]["clip"] is None else "--",
                label=name,
            )
        if self.original is not None:
            label = f"MNIST: {100 * self.original['accuracy']:.2f} %"
            axes.axhline(100 * self.original["accuracy"], color="black", linestyle="--", linewidth=1, label=label)
        axes.set_xscale("log")
        axes.set_xticks(self.lux, self.levels, rotation=40, ha="right")
        axes.minorticks_off()
        axes.grid(True, color="#e3e6e8", linewidth=0.6)
