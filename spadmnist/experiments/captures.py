"""The paper's table of real captures: networks trained on simulated images read a printed chart seen by a SPAD512."""

from __future__ import annotations

import base64
import functools
import hashlib
import math
import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import config, dataset, factory, fluxes, manifest_file, measurement, plugins, tiles, twin
from ..effects import Conditions, Effect
from ..errors import InputError
from ..experiment import Experiment
from ..fluxes import Flux
from ..images import Images
from ..light import photons_from_lux
from ..measurement import Measurement
from ..pages import Drawing, Story, Table
from ..recording import Capture, Light
from ..scene import Scene
from ..sensor import Sensor
from ..tiles import Tiles
from . import PaperExperiment, Plan, Setting, Task, _chip, _lenet, option
from ._lenet import Labelled

DATASET, CHART = "spad_mnist.yaml", "spad512_chart.yaml"
METHOD = "qis_counts"  # paper: "The frames were then summed together"
BRIGHTEST, ALL = "LUX-2560", "LUX-ALL"  # the networks, as the paper calls them
# the paper trains both for 10 epochs; LUX-ALL has ten times the images, and three rounds see each digit 30 times
ALL_EPOCHS = 3
SEED = 1  # of the first weights, of the order of the images and of the imitated captures
QUICK_IMAGES, QUICK_EPOCHS = 10_000, 1
# what the paper gives in table 3: lux -> accuracy in %
PAPER = {
    0.08: {BRIGHTEST: 83.9, ALL: 90.9},
    0.3: {BRIGHTEST: 90.2, ALL: 90.9},
    0.5: {BRIGHTEST: 91.0, ALL: 91.5},
    0.65: {BRIGHTEST: 91.8, ALL: 91.8},
}
SIMULATED, TOGETHER, REAL = "as simulated", "all together", "captured"  # names of rows
_DARK_FRAMES = 1000  # of the capture in the dark: 10 ms, as the paper's
_ALIKE = 1.15  # captures whose light differs by less than this factor are of one level; the paper's differ by 1.3
_SHOWN = 8  # digits in the picture
_AT_ONCE = 4000  # training images that are simulated together: 0.3 GB


class Captures(PaperExperiment):
    """How well do networks that were trained on simulated images read a printed chart, seen by a real camera?

    256 of MNIST's test digits on one chart, before a SPAD512 at four light levels, K = 3 captures of 100 frames each.
    LUX-2560 is trained on the images of SPAD-MNIST's brightest level, LUX-ALL on those of all ten; both are given sums
    of binary frames, as they are. The effective light of each capture is the level at which the simulator's mean count
    is that of the capture.

    Without captures an imitation stands in for them: a simulated chip with hot pixels, unlike PDPs and lazy pixels, and
    a chart as prints are. The tables tell what each of these costs, by itself and all together. OUT/plan is a plan of
    the captures with the chart's image: fill it by `spadmnist import FILE... -o OUT/plan`, then --captures OUT/plan. It
    needs PyTorch and takes some ten minutes; --quick takes 10,000 training images, 1 epoch, and fewer rows.
    Source: Suonsivu et al., section "Experiments on real data".
    """

    captures = option(
        (), "A measurement of the chart, instead of the imitation (repeatable).", several=True, metavar="LAB"
    )

    def prepare(self, setting: Setting) -> Plan:
        _lenet.check_torch(self.name)
        limit = QUICK_IMAGES if setting.quick else None
        bench = _Bench(
            config.shipped(DATASET), config.shipped(CHART), setting.images_dir, limit, self.captures, setting.quick
        )
        made = [(one, one.load_images(setting.images_dir)) for one in (bench.training, bench.chart)]
        common = {
            "digest": _digest([factory.identity(*one) for one in made]),
            "captures": _digest([shot.digest for shot in bench.shots(REAL)]) if self.captures else None,
            "seed": SEED,
            "train": bench.training.wanted(made[0][1]["train"]),
        }
        if not self.captures:
            measurement.write(setting.out / "plan", bench.plan.name, bench.plan.layout, bench.plan.captures)
        levels = sorted(bench.training.levels, key=lambda level: level.value)
        tasks = []
        for network, chosen, epochs in ((BRIGHTEST, levels[-1:], _lenet.EPOCHS), (ALL, levels, ALL_EPOCHS)):
            epochs = QUICK_EPOCHS if setting.quick else epochs
            about = {
                "network": network,
                "levels": [level.text for level in chosen],
                "epochs": epochs,
                "rows": bench.rows,
            }
            tasks.append(Task(network.lower(), about, len(chosen) * epochs, bench))
        return Plan(common, tasks)

    def measure(self, task: Task) -> dict[str, Any]:
        bench, started = task.given, time.monotonic()
        net = _lenet.train(
            _training(bench.training, bench.images_dir, task.about["levels"]), task.about["epochs"], SEED
        )
        found = []
        for row in bench.rows:
            for same in _by_light(bench.shots(row)):
                shares = [_lenet.accuracy(net, shot.labelled) for shot in same]
                mean, n = float(np.mean(shares)), len(same[0].labels)
                found.append(
                    {
                        "row": row,
                        "lux": float(np.mean([shot.lux for shot in same])),
                        "fitted": [shot.fitted for shot in same],
                        "accuracy": mean,
                        "each": shares,
                        # the captures of a level show the same digits, so they do not make it smaller
                        "error": math.sqrt(mean * (1 - mean) / n),
                        "n": n,
                    }
                )
        pictures = bench.pictures() if task.about["network"] == BRIGHTEST else []
        return {"found": found, "pictures": pictures, "seconds": round(time.monotonic() - started, 1)}

    def tell(self, result: Mapping[str, Any]) -> str:
        last = [one for one in result["found"] if one["row"] == result["rows"][-1]]
        return f"{result['network']}, {result['rows'][-1]}: " + ", ".join(
            f"{_percent(one)} at {_mlux(one['lux'])}" for one in last
        )

    def rows(self, results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        out = []
        for result in _sorted(results):
            for one in result["found"]:
                paper = _paper(one["lux"])
                out.append(
                    {
                        "network": result["network"],
                        "row": one["row"],
                        "lux": one["lux"],
                        "fitted_lux": float(np.mean(one["fitted"])),
                        "accuracy": one["accuracy"],
                        "error": one["error"],
                        "n": one["n"],
                        "captures": len(one["each"]),
                        "paper": None if paper is None else round(paper[result["network"]] / 100, 3),
                        "train": result["train"],
                        "epochs": result["epochs"],
                        "seed": result["seed"],
                    }
                )
        return out

    def story(self, results: Sequence[Mapping[str, Any]]) -> Story:
        return _Told(results).story()


# --- the data -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Shot:
    """A capture of the chart. lux: of white, as stated, or else `fitted`; counts: (digits, rows, columns) float32."""

    capture: Capture
    lux: float
    fitted: float
    counts: np.ndarray
    laid: Tiles

    @property
    def labels(self) -> np.ndarray:
        assert self.laid.labels is not None
        return self.laid.labels.astype(np.int64)

    @property
    def labelled(self) -> Labelled:
        return Labelled(self.counts, self.labels)

    @property
    def digest(self) -> str:
        light = f"{self.lux!r} {self.fitted!r} "
        return hashlib.sha256(light.encode() + self.counts.tobytes() + self.labels.tobytes()).hexdigest()


@dataclass(frozen=True)
class _Bench:
    """Where the data come from, small enough to be sent to a worker."""

    dataset: Path
    chart_file: Path
    images_dir: Path | None
    limit: int | None
    labs: tuple[str, ...]
    quick: bool

    def __getstate__(self) -> dict[str, Any]:
        """Without what was read: a worker reads it again."""
        return {name: self.__dict__[name] for name in self.__dataclass_fields__}

    @functools.cached_property
    def training(self) -> Experiment:
        return config.read(self.dataset, limit=self.limit).with_methods((METHOD,))

    @functools.cached_property
    def chart(self) -> Experiment:
        return config.read(self.chart_file)

    @functools.cached_property
    def shown(self) -> Images:
        """The chart, with its tiles."""
        return self.chart.load_images(self.images_dir)["test"]

    @functools.cached_property
    def scene(self) -> Scene:
        return Scene("chart.npy", self.shown.pixels[0], self.shown.tiles)

    @functools.cached_property
    def plan(self) -> Measurement:
        """The captures that the chart's config describes, and one in the dark."""
        clock, scene = self.chart.conditions, self.scene
        dark = replace(
            clock, frames=_DARK_FRAMES, exposure=_DARK_FRAMES * clock.frame_period, wavelength=None, scene=None
        )
        captures = [Capture("dark", "qis", Light(), dark)]
        for level in self.chart.levels:
            lit = Light(clock.wavelength, level.value, level.kind, scene=scene)
            names = [f"{level.folder}-{k + 1}" for k in range(self.chart.source.repetitions)]
            captures += [Capture(name, "qis", lit, replace(clock, scene=scene)) for name in names]
        return measurement.in_memory("chart", self.chart.sensor.layout, captures)

    @functools.cached_property
    def chips(self) -> dict[str, Sensor]:
        """The cameras of the imitation by row, each with one imperfection, the first with none, the last with all."""
        real, clock = self.chart.sensor, self.chart.conditions
        pdp = real.nominal_pdp(clock.wavelength)
        hot = real.rates(np.zeros((1, real.layout.pixels)), clock)[0][0]
        values: dict[str, dict[str, Any]] = {"hot pixels": {_chip.RATE: hot}, **_chip.imperfections(pdp)}
        plain = real.with_values({_chip.RATE: float(np.median(hot))})
        out = {SIMULATED: plain} | {name: plain.with_values(one) for name, one in values.items()}
        every = plain.with_values({key: value for one in values.values() for key, value in one.items()})
        out["the whole chip"] = every
        for cls in map(Effect.registry.find, Effect.registry):
            if getattr(cls, "of_scene", False):  # what a print does, as its file says that prints are
                effect = cls()
                said = [
                    f"{name} {plugins.described(one, getattr(effect, name))}" for name, one in cls.parameters.items()
                ]
                out[f"{cls.name.replace('_', ' ')}, {', '.join(said)}"] = plain.with_effect(effect)
                every = every.with_effect(effect)
        return out | {TOGETHER: every}

    @property
    def rows(self) -> list[str]:
        """What is classified, row by row."""
        if self.labs:
            return [REAL]
        return [SIMULATED, TOGETHER] if self.quick else list(self.chips)

    def shots(self, row: str) -> list[_Shot]:
        """The captures of the chart in a row, in order."""
        if row == REAL:
            labs = [measurement.open(lab) for lab in self.labs]
        else:
            labs = [self.simulated(self.chips[row], self.plan.captures)]
        return [shot for lab in labs for shot in self.cut(lab)]

    def simulated(self, sensor: Sensor, captures: Sequence[Capture]) -> Measurement:
        plan = measurement.in_memory(self.plan.name, sensor.layout, captures)
        return measurement.in_memory(plan.name, sensor.layout, list(twin.twin(sensor, plan, SEED)))

    def cut(self, lab: Measurement) -> list[_Shot]:
        """The captures of a measurement, cut into digits. Raises InputError where it is not one of the chart."""
        model = self.chart.sensor
        lab.check_sensor(model)
        images = fluxes.of_measurement(lab, [METHOD]).images
        dark = [_rates(image) for image in images if image.capture.light.dark]
        if dark:
            model = model.with_values({_chip.RATE: np.mean(dark, axis=0)})
        lit = [image for image in images if image.capture.light.scene is not None]
        if not lit:
            raise InputError(f"{lab.source}: has no QIS capture of a scene; write light: {{kind: image, file: ...}}")
        return [self.shot(lab, image, model) for image in lit]

    def shot(self, lab: Measurement, image: Flux, model: Sensor) -> _Shot:
        capture, frames = image.capture, self.training.conditions.frames
        if capture.conditions.frames != frames:
            raise InputError(
                f"{lab.place(capture.id)}: has {capture.conditions.frames} frames, but the networks are trained on "
                f"sums of {frames}; record {frames} frames"
            )
        place = lab.place(capture.id)
        laid = self.laid(capture, place)
        fitted = effective_light(image, model, place)
        photons = twin.photons_at(capture, model.layout)
        # 12 digits: 300 mlux are 0.3 lux, whichever way they were converted
        stated = None if photons is None else float(f"{photons / _photons_of_a_lux(capture, model):.12g}")
        return _Shot(capture, stated or fitted, fitted, laid.cut(image.values), laid)

    def laid(self, capture: Capture, place: str) -> Tiles:
        """The tiles of a capture's chart with their labels: as it says itself, or those of the experiment's chart."""
        scene, own = capture.light.scene, self.scene
        assert scene is not None and own.tiles is not None
        found = own.tiles if scene.tiles is None and scene == own else scene.tiles
        sizes = [" x ".join(map(str, one.size)) for one in (found or own.tiles, own.tiles)]
        if found is None:
            raise InputError(
                f"{place}: {scene.name} is not the chart of {self.chart.name}, and its light says nothing of tiles; "
                "fill the plan that the imitation leaves in its folder plan, or write light: {..., tiles: FILE.json}"
            )
        if sizes[0] != sizes[1]:
            raise InputError(
                f"{place}: the tiles of {scene.name} are {sizes[0]} pixels, but the networks read {sizes[1]}; show "
                "tiles of that size"
            )
        if found.labels is None or found.labels.max() >= _lenet.CLASSES:
            has = "no labels" if found.labels is None else f"the label {found.labels.max()}"
            raise InputError(
                f"{place}: the tiles of {scene.name} have {has}, but the networks read the digits 0 to "
                f"{_lenet.CLASSES - 1}; write labels, a digit for each tile"
            )
        return found

    def pictures(self) -> list[dict[str, Any]]:
        """The first digits, as originals, and at each level simulated at the light that was fitted, and captured."""
        shots = self.shots(self.rows[-1])
        shown = shots[0].capture.light.scene
        assert shown is not None
        out = [_picture("original", shots[0].laid.cut(np.rint(255 * shown.share.reshape(shown.shape))))]
        for same in _by_light(shots):
            lit = replace(same[0].capture.light, level=same[0].fitted, kind_of_level="lux")
            (image,) = fluxes.of_measurement(
                self.simulated(self.chips[SIMULATED], [replace(same[0].capture, light=lit)]), [METHOD]
            ).images
            at = _mlux(float(np.mean([one.lux for one in same])))
            out.append(_picture(f"{at}, simulated", same[0].laid.cut(image.values)))
            out.append(_picture(f"{at}, captured", same[0].counts))
        return out


def effective_light(image: Flux, sensor: Sensor, place: str) -> float:
    """The lux of white at which a sensor's mean count, of a capture's sum of frames, is the one that was recorded.

    Raises InputError with the `place` where no light would do.
    """
    c, mean = image.capture.conditions, float(image.values.mean(dtype=np.float64))
    white = np.full((1, sensor.layout.pixels), _photons_of_a_lux(image.capture, sensor))
    every, lit = sensor.rates(white, c)  # 1/s; the light's part is in proportion to the light

    def mean_at(lux: float) -> float:
        return float(-np.expm1(-(every + (lux - 1) * lit) * c.frame_time).mean()) * c.frames

    return _chip.light_of_mean(mean_at, mean, place)


def _photons_of_a_lux(capture: Capture, sensor: Sensor) -> float:
    assert capture.light.wavelength is not None
    return photons_from_lux(1.0, sensor.layout.active_area, capture.light.wavelength)


def _rates(dark: Flux) -> np.ndarray:
    """(pixels,) Hz, the dark count rates of which a sum of frames tells."""
    c: Conditions = dark.capture.conditions
    share = np.minimum(dark.values.ravel().astype(np.float64), c.frames - 0.5) / c.frames
    return -np.log1p(-share) / c.frame_time


def _training(experiment: Experiment, images_dir: Path | None, levels: Sequence[str]) -> Labelled:
    """The training images of some light levels, level after level, as sums of frames."""
    made = dataset.simulated(experiment, images_dir)
    parts = [made[level, "train"] for level in levels]
    assert experiment.conditions.frames <= np.iinfo(np.uint8).max
    images = np.empty((sum(map(len, parts)), *parts[0].shape), np.uint8)
    at = 0
    for part in parts:
        for start in range(0, len(part), _AT_ONCE):
            some = part.reconstruction[METHOD][start : start + _AT_ONCE]
            images[at : at + len(some)] = some
            at += len(some)
    return Labelled(images, np.concatenate([np.asarray(part.labels) for part in parts]))


def _by_light(shots: Sequence[_Shot]) -> list[list[_Shot]]:
    """Captures of one light level together, the dimmest first."""
    groups: list[list[_Shot]] = []
    for shot in sorted(shots, key=lambda one: one.lux):
        if not groups or shot.lux > _ALIKE * groups[-1][0].lux:
            groups.append([])
        groups[-1].append(shot)
    return groups


def _digest(of: Any) -> str:
    return hashlib.sha256(manifest_file.canonical({"of": of})).hexdigest()


def _picture(name: str, digits: np.ndarray) -> dict[str, Any]:
    some = digits[:_SHOWN].astype(np.uint8)
    return {"name": name, "shape": list(some.shape), "pixels": base64.b64encode(zlib.compress(some.tobytes())).decode()}


# --- what is shown ------------------------------------------------------------------------------------------------


def _percent(one: Mapping[str, Any]) -> str:
    return f"{100 * one['accuracy']:.1f} ± {100 * one['error']:.1f} %"


def _mlux(lux: float) -> str:
    return f"{1000 * lux:.3g} mlux"


def _paper(lux: float) -> Mapping[str, float] | None:
    """What the paper has at a light level; None where it has none."""
    nearest = min(PAPER, key=lambda one: abs(math.log(one / lux)))
    return PAPER[nearest] if abs(math.log(nearest / lux)) < math.log(_ALIKE) else None


def _sorted(results: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    return sorted(results, key=lambda one: (BRIGHTEST, ALL).index(one["network"]))


class _Told:
    """The results by network, row and light level."""

    def __init__(self, results: Sequence[Mapping[str, Any]]):
        self.results = _sorted(results)
        self.networks = [one["network"] for one in self.results]
        self.row_names: list[str] = self.results[0]["rows"]
        self.last = self.row_names[-1]
        self.real = self.last == REAL
        self.found = {
            (result["network"], one["row"], one["lux"]): one for result in self.results for one in result["found"]
        }
        self.levels = sorted({lux for _, _, lux in self.found})

    def story(self) -> Story:
        one = self.results[0]
        epochs = ", ".join(
            f"{each['network']}: {len(each['levels'])} level{'s' * (len(each['levels']) > 1)} of {each['train']:,} "
            f"images, {each['epochs']} epochs"
            for each in self.results
        )
        n = one["found"][0]["n"]
        facts = {
            "network": _lenet.WORDS,
            "training": f"{epochs}; batches of {_lenet.BATCH}, Adam with a learning rate of {_lenet.RATE:g}, seed "
            f"{one['seed']}; images of {DATASET}, sums of frames ({METHOD}), not normalised",
            "chart": f"{n} images of the test set, {CHART}; each tile is cut out and given to the networks as it is",
            "errors": f"one binomial standard deviation of {n} digits; captures of one level show the same digits",
            "effective light": "of white, at which the data sheet's sensor, with the dark counts of the dark capture, "
            "has the mean count of the capture",
            "data": f"sealed {one['digest'][:16]}",
        }
        parts: list[Table | Drawing] = [self._beside_the_paper()]
        if len(self.row_names) > 1:
            parts += [self._accuracies(), self._costs(), self._light()]
        pictures: list[Any] = next((each["pictures"] for each in self.results if each["pictures"]), [])
        if pictures:
            parts.append(_drawing(pictures, self.real))
        return Story("Networks on captures of a chart", self._answer(), self._lead(), facts, parts)

    def _answer(self) -> str:
        words = []
        for network in reversed(self.networks):
            found = [100 * self.found[network, self.last, lux]["accuracy"] for lux in self.levels]
            words.append(f"{network} reads {min(found):.1f} to {max(found):.1f} %")
        light = (
            f"{_mlux(self.levels[0])} to {_mlux(self.levels[-1])}" if len(self.levels) > 1 else _mlux(self.levels[0])
        )
        return f"At {light}, {' and '.join(words)} of the {'captured' if self.real else 'imitated'} digits"

    def _lead(self) -> list[str]:
        lead = []
        if not self.real:
            lead.append(
                "No camera took these captures: a simulated chip with hot, unlike and lazy pixels stands in for it, "
                "with what a print adds where the catalogue of effects has it."
            )
        if self.results[0]["epochs"] < _lenet.EPOCHS and self.networks[0] == BRIGHTEST:
            lead.append("These are quick results: fewer images, epochs and rows than a whole run has.")
        return lead

    def _beside_the_paper(self) -> Table:
        header = ["white on the sensor", "effective light, fitted"]
        for network in self.networks:
            header += [network, "paper"]
        rows = []
        for lux in self.levels:
            row = [_mlux(lux), _fitted(self.found[self.networks[0], self.last, lux])]
            paper = _paper(lux)
            for network in self.networks:
                row += [_percent(self.found[network, self.last, lux])]
                row += ["-" if paper is None else f"{paper[network]:.1f} %"]
            rows.append(row)
        captured = "captures" if self.real else "imitated captures, all imperfections together"
        return Table(
            f"Accuracy on {captured}",
            header,
            rows,
            "The paper's numbers are of its own captures (table 3), K = 3 each.",
        )

    def _columns(self) -> list[tuple[str, float]]:
        return [(network, lux) for network in self.networks for lux in self.levels]

    def _accuracies(self) -> Table:
        header = ["accuracy, %", *(f"{network}, {_mlux(lux)}" for network, lux in self._columns())]
        rows = [
            [row, *(f"{100 * self.found[network, row, lux]['accuracy']:.1f}" for network, lux in self._columns())]
            for row in self.row_names
        ]
        papers = [_paper(lux) for _, lux in self._columns()]
        cells = [
            "-" if paper is None else f"{paper[network]:.1f}"
            for paper, (network, _) in zip(papers, self._columns(), strict=True)
        ]
        worst = max(one["error"] for one in self.found.values())
        note = (
            f"One imperfection at a time beside none ({SIMULATED}). Digits are cut out where the chart has them: a "
            f"print that hangs askew is not turned back. The binomial error is at most {100 * worst:.1f} %."
        )
        return Table("Accuracy by imperfection", header, [*rows, ["paper, real captures", *cells]], note)

    def _costs(self) -> Table:
        header = ["percentage points lost", *(f"{network}, {_mlux(lux)}" for network, lux in self._columns())]
        rows = []
        for row in self.row_names[1:]:
            lost = [
                self.found[network, SIMULATED, lux]["accuracy"] - self.found[network, row, lux]["accuracy"]
                for network, lux in self._columns()
            ]
            rows.append([row, *(f"{100 * one:+.1f}" for one in lost)])
        return Table(
            "What each imperfection costs",
            header,
            rows,
            f"Beside {SIMULATED}. All rows show the same digits to the same networks, so that differences are smaller "
            "than the errors of the accuracies.",
        )

    def _light(self) -> Table:
        rows = [
            [row, *(_fitted(self.found[self.networks[0], row, lux]) for lux in self.levels)] for row in self.row_names
        ]
        note = (
            "Mean of the captures and their standard deviation. A mean count cannot tell light that black reflects "
            "from brighter white."
        )
        return Table("Effective light, fitted", ["row", *map(_mlux, self.levels)], rows, note)


def _fitted(one: Mapping[str, Any]) -> str:
    fitted = 1000 * np.asarray(one["fitted"])
    spread = f" ± {fitted.std(ddof=1):.1f}" if len(fitted) > 1 else ""
    return f"{fitted.mean():.1f}{spread} mlux"


def _drawing(pictures: Sequence[Mapping[str, Any]], real: bool) -> Drawing:
    def draw(figure: Any) -> None:
        for axes, one in zip(figure.subplots(len(pictures), 1, squeeze=False)[:, 0], pictures, strict=True):
            shape = tuple(one["shape"])
            digits = np.frombuffer(zlib.decompress(base64.b64decode(one["pixels"])), np.uint8).reshape(shape)
            largest = np.maximum(digits.max(axis=(1, 2), keepdims=True), 1)  # paper: "setting the maximum ... to 1"
            corners = tiles.grid(len(digits), len(digits), max(shape[1:]) + 2, (shape[1], shape[2]))
            whole = corners.max(axis=0) + shape[1:]
            axes.imshow(
                tiles.lay(digits / largest, corners, (int(whole[0]), int(whole[1]))), cmap="gray", vmin=0, vmax=1
            )
            axes.set_title(one["name"], loc="left", fontsize=9)
            axes.set_xticks([])
            axes.set_yticks([])

    words = "Digits of the chart: originals, and at each light level simulated and captured"
    note = (
        "Each digit is divided by its largest value, as in the paper's figure: a hot pixel leaves the rest in the dark."
    )
    if not real:
        note += " The captured ones are those of the imitation, with all imperfections."
    return Drawing("digits", "Digits", words, (7.5, 1.1 * len(pictures)), draw, note)
