"""The paper's comparison of its simulator with two sensors: the pixels of a SPAD23, histograms of a SPAD512."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from .. import config, manifest_file, measurement, pictures, twin
from ..effects import Conditions
from ..errors import InputError
from ..experiment import Experiment
from ..light import photons_from_irradiance
from ..measurement import Measurement
from ..pages import Drawing, Story, Table
from ..recording import Capture, Light
from ..sensor import Sensor
from ..streams import Streams
from . import PaperExperiment, Plan, Setting, Task, _chip, option

SEED = 1  # of the twin and of the simulation
MEASURED, SIMULATED, DARK = "measured", "simulated", "dark"  # names of curves
INPUTS = "The means are inputs: one light level is solved for each."
QUICK_SIDE, QUICK_CAPTURES = 64, 3  # rows and columns of the part of a chip; captures of a panel
_NANOWATT = 1e-5  # W/m^2 in one nW/cm^2
_BINS = 3000  # of a histogram, from one count to all frames, each wider by the same factor; whole counts at least
_SAME_COLOUR = 5e-9  # m, by which the wavelength of a capture may differ from a panel's: light has some width itself
_SAME = 1e-6  # by which clocks may differ: they are written with few digits
_LEAST = 8  # pixels of a bin as it is drawn, but for empty ones and the last
_COLOURS = {MEASURED: "C1", SIMULATED: "C0", DARK: "0.55"}


@dataclass(frozen=True)
class Panel:
    """One comparison of the paper.

    file: its config; irradiance: nW/cm^2, as the paper prints it; measured, simulated, dark: the paper's means, counts
    a pixel, of time stamps counts per second.
    """

    key: str
    title: str
    file: str
    irradiance: float
    measured: float
    simulated: float
    dark: float | None = None


PANELS = (
    Panel("spad23-500nm", "SPAD23, 500 nm", "spad23.yaml", 3, 17.0e3, 17.0e3),
    Panel("spad23-700nm", "SPAD23, 700 nm", "spad23_700nm.yaml", 0.8, 2.28e3, 2.27e3),
    Panel("spad512-500nm-low", "SPAD512, 500 nm, low", "spad512.yaml", 120, 470, 457, 2.6),
    Panel("spad512-700nm-low", "SPAD512, 700 nm, low", "spad512_700nm_low.yaml", 20, 62, 60, 2.6),
    Panel("spad512-500nm-high", "SPAD512, 500 nm, high", "spad512_500nm_high.yaml", 1200, 9715, 9740),
    Panel("spad512-700nm-high", "SPAD512, 700 nm, high", "spad512_700nm_high.yaml", 200, 4011, 4184),
)


class Sensors(PaperExperiment):
    """Does the simulator give what two real sensors record in uniform light?

    The count rate of each pixel of a SPAD23 at 500 and 700 nm, with its scatter over 10 captures of 100 ms; and
    histograms of a SPAD512's counts in 10,000 binary frames, at both wavelengths, in low and in high light, with the
    counts in the dark. The simulation is the paper's model: all pixels have one PDP, and each has the dark count rate
    that was measured in the dark. Light is solved for: its mean is the paper's, or that of the captures. A table tells
    what the light levels give that the paper prints, by formula, without solving.

    Without captures a twin stands in for each sensor: a simulated chip with unlike, lazy and hot pixels. With
    --captures LAB the captures of LAB stand where they have a panel's pixels, wavelength and clock, and the twin where
    they have none. --quick takes a part of the chip of 64 x 64 pixels, and 3 captures of 100 ms; it takes as many
    frames, since the means are of so many.
    Source: Suonsivu et al., section "Simulator validation".
    """

    captures = option(
        (), "A measurement of either sensor, instead of its twin (repeatable).", several=True, metavar="LAB"
    )

    def prepare(self, setting: Setting) -> Plan:
        experiments = {panel.key: config.read(config.shipped(panel.file)) for panel in PANELS}
        found = _found([measurement.open(lab) for lab in self.captures], experiments)
        common = {
            "digest": _digest([one.resolved for one in experiments.values()]),
            "captures": _digest([one.digest for one in found.values()]) if self.captures else None,
            "quick": setting.quick,
            "seed": SEED,
        }
        tasks = []
        for panel in PANELS:
            bench = _Bench(panel, setting.quick, found.get(panel.key))
            c = experiments[panel.key].conditions
            # drawing bits takes as long as there are ones, or zeros; there are few time stamps
            bits = min(panel.measured, c.frames - panel.measured) if c.frames > 1 else 0
            work = 100 + (0 if setting.quick else bits)
            tasks.append(Task(panel.key, {"panel": panel.title}, work, bench))
        return Plan(common, tasks)

    def measure(self, task: Task) -> dict[str, Any]:
        started = time.monotonic()
        return {**task.given.compare(), "seconds": round(time.monotonic() - started, 1)}

    def tell(self, result: Mapping[str, Any]) -> str:
        means = [f"{name} {_number(one['mean'])}" for name, one in result["curves"].items()]
        return f"{result['panel']}, {result['unit']}: {', '.join(means)}"

    def rows(self, results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        return [
            {
                "panel": result["panel"],
                "curve": name,
                "unit": result["unit"],
                "source": _source(result, name),
                "mean": one["mean"],
                "error": one["error"],
                "closed_form": one["closed_form"],
                "median": one["median"],
                "largest": one["largest"],
                "nW_per_cm2": one["irradiance"],
                "paper": result["paper"][name],
                "pixels": result["pixels"],
                "captures": one["captures"],
                "seed": result["seed"],
            }
            for result in _in_order(results)
            for name, one in result["curves"].items()
        ]

    def story(self, results: Sequence[Mapping[str, Any]]) -> Story:
        return _story(_in_order(results))


# --- captures of a sensor -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Found:
    """What measurements have of a panel: (captures, pixels) detections in light, and in the dark where there are any.

    place: for messages.
    """

    place: str
    lit: np.ndarray
    dark: np.ndarray | None

    @property
    def digest(self) -> str:
        parts = [one.astype("<i8").tobytes() for one in (self.lit, self.dark) if one is not None]
        return hashlib.sha256(b"/".join(parts)).hexdigest()


def _found(labs: Sequence[Measurement], experiments: Mapping[str, Experiment]) -> dict[str, _Found]:
    """By panel, what there is of it. Raises InputError for a measurement that has nothing of any."""
    lit: dict[str, list[tuple[str, Light, np.ndarray]]] = {}
    dark: dict[str, list[np.ndarray]] = {}
    for lab in labs:
        used = False
        for capture in lab.captures:
            for key, one in experiments.items():
                if lab.layout.shape != one.sensor.layout.shape or not _fits(capture, one):
                    continue
                totals = lab.recording(capture.id, one.sensor).totals
                if capture.light.dark:
                    dark.setdefault(key, []).append(totals)
                else:
                    lit.setdefault(key, []).append((lab.place(capture.id), capture.light, totals))
                    used = True
        if not used:
            wanted = "; ".join(_clock(one.sensor, one.readouts[0], one.conditions) for one in experiments.values())
            raise InputError(f"{lab.source}: has no capture in uniform light like one of the paper's; record {wanted}")
    for each in lit.values():
        place, light, _ = each[0]
        for other, its, _ in each[1:]:
            if (its.level, its.kind_of_level) != (light.level, light.kind_of_level):
                raise InputError(
                    f"{other}: has another light level than {place}, which is of the same panel; give captures of one "
                    "level for each wavelength and frame time"
                )
    return {
        key: _Found(each[0][0], np.array([t for *_, t in each]), np.array(dark[key]) if key in dark else None)
        for key, each in lit.items()
    }


def _fits(capture: Capture, one: Experiment) -> bool:
    """Is a capture of uniform light, or in the dark, made as a panel's are?"""
    c, clock, light = capture.conditions, one.conditions, capture.light
    assert clock.wavelength is not None
    pairs = [(c.exposure, clock.exposure)]
    if capture.modality != "tr":
        pairs += [(c.frame_time, clock.frame_time), (c.frames, clock.frames)]
    return (
        capture.modality == one.readouts[0]
        and capture.mean is None
        and light.scene is None
        and (light.wavelength is None or abs(light.wavelength - clock.wavelength) < _SAME_COLOUR)
        and all(math.isclose(a, b, rel_tol=_SAME) for a, b in pairs)
    )


def _clock(sensor: Sensor, modality: str, c: Conditions) -> str:
    assert c.wavelength is not None
    frames = "" if modality == "tr" else f", {c.frames:,} frames of {c.frame_time * 1e6:g} us"
    pixels = f"{sensor.layout.rows} x {sensor.layout.columns} pixels"
    return f"{modality.upper()} of {pixels} at {c.wavelength * 1e9:.0f} nm, {c.exposure * 1e3:g} ms{frames}"


# --- a comparison -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Bench:
    """How a panel's results come about, small enough to be sent to a worker."""

    panel: Panel
    quick: bool = False
    found: _Found | None = field(default=None, compare=False)

    def compare(self) -> dict[str, Any]:
        """The numbers of the panel, in JSON."""
        one = config.read(config.shipped(self.panel.file))
        c, modality, sensor = one.conditions, one.readouts[0], one.sensor.resolved()
        assert c.wavelength is not None
        positions = sensor.layout.positions
        most = QUICK_SIDE if self.quick and positions is None else max(sensor.layout.shape)
        rows, columns = (slice(0, min(n, most)) for n in sensor.layout.shape)
        part, dark = sensor.cropped(rows, columns), replace(c, wavelength=None)
        captures = min(one.source.repetitions, QUICK_CAPTURES) if self.quick else one.source.repetitions
        # counts a pixel -> the paper's unit
        unit, scale = ("cps", 1 / c.exposure) if modality == "tr" else ("counts", 1.0)
        curves: dict[str, _Curve] = {}
        if self.found is None:
            chip = twin_of(sensor, c.wavelength).cropped(rows, columns)
            wanted = self.panel.simulated / scale
            level = solved(chip, modality, c, self.panel.measured / scale, self.panel.title)
            curves[MEASURED] = self._curve(MEASURED, chip, modality, c, level, captures)
            curves[DARK] = self._curve(DARK, chip, modality, dark, 0.0, captures)
            place = self.panel.title
        else:
            cut = np.arange(sensor.layout.pixels).reshape(sensor.layout.shape)[rows, columns].ravel()
            curves[MEASURED] = _Curve(self.found.lit[:, cut])
            if self.found.dark is not None:
                curves[DARK] = _Curve(self.found.dark[:, cut])
            wanted, place = curves[MEASURED].mean, self.found.place
        if DARK in curves:
            part = part.with_values({_chip.RATE: dark_rates(part, modality, dark, curves[DARK].totals)})
        level = solved(part, modality, c, wanted, place)
        curves[SIMULATED] = self._curve(SIMULATED, part, modality, c, level, captures)
        printed = closed_form(sensor, modality, c, self.panel.irradiance).mean() * scale
        return {
            "unit": unit,
            "twin": self.found is None,
            "pixels": part.layout.pixels,
            "frames": c.frames if unit == "counts" else None,
            "exposure": c.exposure,
            "places": None if positions is None else positions.tolist(),
            "edges": _edges(c.frames) if unit == "counts" else None,
            "paper": {MEASURED: self.panel.measured, SIMULATED: self.panel.simulated, DARK: self.panel.dark},
            "printed": {"irradiance": self.panel.irradiance, "mean": float(printed)},
            "curves": {
                name: curves[name].numbers(scale, c.frames if unit == "counts" else None)
                for name in (MEASURED, SIMULATED, DARK)
                if name in curves
            },
        }

    def _curve(self, name: str, sensor: Sensor, modality: str, c: Conditions, level: float, captures: int) -> _Curve:
        """A sensor's captures at a light level in nW/cm^2."""
        light = Light() if c.dark else Light(c.wavelength, level * _NANOWATT)
        capture, images = Capture(name, modality, light, c), np.arange(captures, dtype=np.uint64)
        made = twin.model_recordings(
            sensor, capture, _photons(sensor, c, level), Streams(SEED, self.panel.key, name, images), images, True
        )
        expected = closed_form(sensor, modality, c, level)
        return _Curve(np.array([one.totals for one in made]), level, expected)


@dataclass(frozen=True, eq=False)
class _Curve:
    """totals: (captures, pixels) detections. irradiance: nW/cm^2; expected: (pixels,) by formula; of what is drawn."""

    totals: np.ndarray
    irradiance: float | None = None
    expected: np.ndarray | None = None

    @property
    def mean(self) -> float:
        return float(self.totals.mean())

    def numbers(self, scale: float, frames: int | None) -> dict[str, Any]:
        """In JSON; scale: from counts to the unit. frames: of a histogram, None where each pixel is told."""
        each = self.totals.mean(axis=0)
        scatter = each if frames is None else each * (1 - np.minimum(each / frames, 1))  # variance of a pixel's counts
        told: dict[str, Any] = {
            "mean": self.mean * scale,
            "error": math.sqrt(scatter.sum() / len(self.totals)) / len(each) * scale,
            "closed_form": None if self.expected is None else float(self.expected.mean()) * scale,
            "median": float(np.median(self.totals)) * scale,
            "largest": float(self.totals.max()) * scale,
            "irradiance": self.irradiance,
            "captures": len(self.totals),
        }
        if frames is not None:
            return {**told, "histogram": np.histogram(self.totals, _edges(frames))[0].tolist()}
        several = len(self.totals) > 1
        deviation = self.totals.std(axis=0, ddof=1) * scale if several else np.zeros(len(each))
        return {**told, "each": (each * scale).tolist(), "scatter": deviation.tolist()}


def twin_of(sensor: Sensor, wavelength: float) -> Sensor:
    """The sensor with what the paper names: unlike PDPs and lazy pixels. It has hot pixels already."""
    values: dict[str, Any] = {}
    for one in _chip.imperfections(sensor.nominal_pdp(wavelength)).values():
        values |= one
    return sensor.with_values(values)


def _photons(sensor: Sensor, c: Conditions, level: float) -> float:
    """Photons/s on a pixel's active area at a light level in nW/cm^2."""
    if c.wavelength is None:
        return 0.0
    return photons_from_irradiance(level * _NANOWATT, sensor.layout.active_area, c.wavelength)


def closed_form(sensor: Sensor, modality: str, c: Conditions, level: float) -> np.ndarray:
    """(pixels,) expected detections of a capture, or frames with one (QIS), at a light level in nW/cm^2."""
    photons = np.full((1, sensor.layout.pixels), _photons(sensor, c, level))
    candidates, recorded = (one[0] for one in sensor.expected(photons, c))
    if modality == "tr":
        return recorded
    return np.asarray(-c.frames * np.expm1(-candidates / c.exposure * c.frame_time))


def solved(sensor: Sensor, modality: str, c: Conditions, mean: float, place: str) -> float:
    """The light level in nW/cm^2 at which the closed form has a mean. Raises InputError where there is none."""
    return _chip.light_of_mean(lambda level: float(closed_form(sensor, modality, c, level).mean()), mean, place)


def dark_rates(sensor: Sensor, modality: str, c: Conditions, totals: np.ndarray) -> np.ndarray:
    """(pixels,) Hz, the dark count rates of which (captures, pixels) detections in the dark tell."""
    each = totals.mean(axis=0)
    if modality == "tr":
        events = each / (c.exposure - each * sensor.dead_times)
    else:
        events = -np.log1p(-np.minimum(each, c.frames - 0.5) / c.frames) / c.frame_time
    return np.asarray(events / (1 + sum(sensor.caused().values())))


def _edges(frames: int) -> list[float]:
    """Of the bins of a histogram: none, one, ... counts, later several, up to all frames."""
    lower = np.unique(np.rint(np.geomspace(1, frames, _BINS)))
    return [-0.5, *(lower - 0.5).tolist(), frames + 0.5]


def _digest(of: Any) -> str:
    return hashlib.sha256(manifest_file.canonical({"of": of})).hexdigest()


# --- what is shown ------------------------------------------------------------------------------------------------


def _in_order(results: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    order = [panel.title for panel in PANELS]
    return sorted(results, key=lambda one: order.index(one["panel"]))


def _source(result: Mapping[str, Any], curve: str) -> str:
    if curve == SIMULATED:
        return "the paper's model"
    return "twin" if result["twin"] else "captures"


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:,.0f}" if value >= 1000 else f"{value:.4g}"


def _label(result: Mapping[str, Any], curve: str) -> str:
    """A curve's name: a twin is called one."""
    twin_word = " (twin)" if result["twin"] and curve != SIMULATED else ""
    return f"{curve}{twin_word}"


def _story(results: Sequence[Mapping[str, Any]]) -> Story:
    twins = [one["panel"] for one in results if one["twin"]]
    lead = []
    if twins:
        whose = "these panels" if len(twins) == len(results) else "; ".join(twins)
        lead.append(
            f"No sensor took what is called measured in {whose}: a twin stands in, a simulated chip with a PDP spread "
            f"of {100 * _chip.SPREAD:g} %, {100 * _chip.LAZY:g} % lazy pixels, and hot pixels."
        )
    lead.append(INPUTS)
    if results[0]["quick"]:
        lead.append("These are quick results: of a part of the SPAD512, and of few captures of the SPAD23.")
    apart = [abs(one["curves"][SIMULATED]["mean"] / one["curves"][MEASURED]["mean"] - 1) for one in results]
    real = "those of a twin of each sensor" if len(twins) == len(results) else "the measured ones"
    facts = {
        "model": "of spad23_sensor.yaml and spad512_sensor.yaml: one PDP for all pixels, and each pixel's dark count "
        "rate from what was measured in the dark, where there is a capture in the dark",
        "errors": "of a mean: one standard deviation of what is counted, by photon noise",
        "light": "solved by closed form (Sensor.expected): for a twin the measured and the simulated mean are those of "
        "the paper; for captures the simulated mean is theirs",
        "seed": str(results[0]["seed"]),
        "data": f"configs {results[0]['digest'][:16]}",
    }
    parts: list[Table | Drawing] = [_means(results), _unsolved(results)]
    if pixels := [one for one in results if one["unit"] == "cps"]:
        parts.append(_pixels(pixels))
    if panels := [one for one in results if one["unit"] == "counts"]:
        parts.append(_histograms(panels))
    answer = f"The simulated means lie within {100 * max(apart):.1f} % of {real}; the means are inputs"
    return Story("Sensors, measured and simulated", answer, lead, facts, parts)


def _means(results: Sequence[Mapping[str, Any]]) -> Table:
    header = ["mean", "unit", MEASURED, "paper", SIMULATED, "paper", DARK, "paper", "light measured", "light simulated"]
    rows = []
    for one in results:
        row = [one["panel"], one["unit"]]
        for name in (MEASURED, SIMULATED, DARK):
            curve = one["curves"].get(name)
            cell = "-" if curve is None else f"{_number(curve['mean'])} ± {curve['error']:.2g}"
            row += [cell + (" (twin)" if curve and one["twin"] and name != SIMULATED else "")]
            row += [_number(one["paper"][name])]
        row += [_light(one["curves"][name]["irradiance"]) for name in (MEASURED, SIMULATED)]
        rows.append(row)
    return Table(
        "Means", header, rows, f"{INPUTS} So that they agree is no check of the model; shapes and scatter are."
    )


def _light(level: float | None) -> str:
    return "as recorded" if level is None else f"{level:.4g} nW/cm^2"


def _unsolved(results: Sequence[Mapping[str, Any]]) -> Table:
    header = ["without solving", "light, as printed", "unit", "closed form", "paper, simulated", "paper, measured"]
    rows = [
        [
            one["panel"],
            f"{one['printed']['irradiance']:g} nW/cm^2",
            one["unit"],
            _number(one["printed"]["mean"]),
            _number(one["paper"][SIMULATED]),
            _number(one["paper"][MEASURED]),
        ]
        for one in results
    ]
    note = (
        "The mean that follows from the light level that the paper prints, by closed form on the whole chip of the "
        'config. The high levels are the low ones "brighter by a factor of ~10".'
    )
    return Table("What the printed light levels give", header, rows, note)


def _pixels(results: Sequence[Mapping[str, Any]]) -> Drawing:
    def draw(figure: Any) -> None:
        rates = np.array([one["curves"][name]["each"] for one in results for name in (MEASURED, SIMULATED)])
        low, high = max(float(rates.min()), 1.0), max(float(rates.max()), 10.0)
        grid = figure.subplots(len(results), 3, squeeze=False, width_ratios=[1, 1, 1.5])
        for axes, one in zip(grid, results, strict=True):
            pixel, extent = pictures.pixel_at(np.array(one["places"]), 300)
            for map_, name in zip(axes, (MEASURED, SIMULATED), strict=False):
                curve = one["curves"][name]
                values = pictures.placed(np.array(curve["each"])[:, None], pixel, np.nan)[..., 0]
                image = map_.imshow(values, norm="log", vmin=low, vmax=high, extent=extent, cmap="viridis")
                map_.set_title(f"{one['panel']}, {_label(one, name)}\nmean {_number(curve['mean'])} cps", y=1.0)
                map_.set_axis_off()
                axes[2].errorbar(
                    np.arange(len(curve["each"])) + (0.15 if name == SIMULATED else -0.15),
                    curve["each"],
                    curve["scatter"],
                    fmt="os"[name == SIMULATED],
                    markersize=3,
                    linewidth=1,
                    color=_COLOURS[name],
                    label=_label(one, name),
                )
            axes[2].set(yscale="log", ylim=(low / 1.3, high * 1.3), xlabel="pixel", ylabel="cps")
            axes[2].grid(True, which="both", color="#e3e6e8", linewidth=0.6)
            axes[2].legend(frameon=False)
        figure.colorbar(image, ax=grid[:, :2], label="cps", location="bottom", shrink=0.8)
        figure.suptitle(INPUTS)

    captures, ms = results[0]["curves"][MEASURED]["captures"], 1e3 * results[0]["exposure"]
    note = (
        f"Bars are the standard deviation over the captures ({captures} of {ms:g} ms measured). Colours and rates have "
        f"one scale for all panels. {INPUTS}"
    )
    words = "The SPAD23's pixels where they lie, measured beside simulated, and the rate of each with its scatter"
    return Drawing("pixels", "The SPAD23's pixels", words, (10.5, 3.4 * len(results) + 0.8), draw, note)


def _merged(histogram: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(pixels, edges) of a histogram in which bins with few pixels are taken together with the next ones.

    The bin of no counts stays by itself, since a logarithmic axis has no place for it; and so do empty ones before the
    first pixels and after the last.
    """
    ends, there = [0, 1], 0
    held = np.flatnonzero(histogram[1:]) + 1
    first, last = (int(held[0]), int(held[-1]) + 1) if held.size else (1, 1)
    for end, pixels in enumerate(histogram[1:].tolist(), 2):
        there += pixels
        if there >= _LEAST or end <= first or end >= last:
            ends.append(end)
            there = 0
    return np.add.reduceat(histogram, ends[:-1]), edges[ends]


def _histograms(results: Sequence[Mapping[str, Any]]) -> Drawing:
    def draw(figure: Any) -> None:
        grid = figure.subplots(-(-len(results) // 2), 2, squeeze=False).ravel()
        for axes in grid[len(results) :]:
            axes.set_axis_off()
        for axes, one in zip(grid, results, strict=False):
            edges = np.array(one["edges"])
            for name, curve in one["curves"].items():
                pixels, wide = _merged(np.array(curve["histogram"]), edges)
                height = pixels / curve["captures"] / np.diff(wide)
                label = f"{_label(one, name)}, mean {_number(curve['mean'])}"
                axes.stairs(np.where(height > 0, height, np.nan), wide, color=_COLOURS[name], label=label)
            dim = one["paper"][MEASURED] < one["frames"] / 10
            axes.set(title=one["panel"], yscale="log", xscale="log" if dim else "linear")
            axes.set(xlim=(0.5 if dim else -100, one["frames"] * 1.02), xlabel="counts", ylabel="pixels a count")
            axes.set_axisbelow(True)
            axes.grid(True, color="#e3e6e8", linewidth=0.6)
            axes.legend(frameon=False, fontsize=7)
        figure.suptitle(INPUTS)

    one = results[0]
    note = (
        f"Counts of {one['pixels']:,} pixels in {one['frames']:,} frames. Low light has a logarithmic axis of counts, "
        f"which has no place for 0. Where pixels are few, {_LEAST} share a bin. Hot pixels are at the right, "
        f"lazy ones to the left of a peak. {INPUTS}"
    )
    words = "Histograms of the SPAD512's counts per pixel: measured, simulated and in the dark"
    return Drawing("histograms", "The SPAD512's counts", words, (10.5, 3.4 * -(-len(results) // 2)), draw, note)
