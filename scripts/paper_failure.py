"""The paper's own failure, repeated: a uniform model beside a SPAD512 whose pixels are not alike.

The paper's SPAD512 had "a broader peak in the experiments due to pixel-wise PDP variation", lazy pixels at the left
edge of the histogram and hot ones at the right; its model, "a spatially uniform PDP", had none of them. Here such an
array is recorded by the challenge's generator, which shares no code with the package, with the paper's frames and
light; then `spadmnist diagnose` is asked what the uniform model lacks, and what it says stands beside the truth.

    python scripts/paper_failure.py out                                        # minutes
    python scripts/paper_failure.py out --figure docs/paper-failure.png        # draws it, too

What is in `out` is not made again, but for the picture. `--dark-rate 265` gives the uniform model the mean dark count
rate instead of the median.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parent))
from challenge_generator import Capture, World, bits, expose

SIDE, FRAMES = 48, 10_000  # the real array has 512 x 512 pixels; the paper collects 10,000 frames
AREA, PDP = 36e-12, {500e-9: 0.444, 700e-9: 0.207}  # paper: active area, PDP
DARK_MEDIAN, DARK_MEAN = 20.0, 265.0  # Hz; paper: 265 (20) counts per second mean (median)
POWER_METER = 1.02  # paper: a slight shift "that may be due to uncertainty in the power estimation"
# name, wavelength, irradiance (W/m^2), frame time, share of the frames: irradiances that give the paper's simulated
# means (paper_numbers.py); where nearly every frame has a detection, fewer frames are recorded, for they take longest
CAPTURES = (
    ("dark", 500e-9, 0.0, 1e-6, 1.0),
    ("500nm-low", 500e-9, 115.62e-5, 1e-6, 1.0),
    ("700nm-low", 700e-9, 21.93e-5, 1e-6, 1.0),
    ("700nm-high", 700e-9, 205.5e-5, 10e-6, 1.0),
    ("500nm-high", 500e-9, 906.5e-5, 10e-6, 0.2),
)
PAPER_MEANS = {  # of 10,000 frames: experiment, simulation
    "dark": "2.6",
    "500nm-low": "470, 457",
    "700nm-low": "62, 60",
    "500nm-high": "9715, 9740",
    "700nm-high": "4011, 4184",
}
# what is hidden
SPREAD, LAZY, LAZY_PDP = 0.04, 0.02, (0.3, 0.8)  # of the PDP; share of lazy pixels, and what PDP is left to them
RATE_SPREAD = 1.3  # of the logarithm of the dark count rates
HOT, HOT_RATE, HOT_SPREAD = 0.02, 8000.0, 0.8  # share, median (Hz) and spread of hot pixels: with the others, mean 265
LIGHT_UNCERTAINTY = 0.015
_PART = 500  # frames that are recorded at a time; frames do not depend on each other here


# ---- recording --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Chip:
    """The hidden truth, (pixels,) each in row-major order."""

    pdp_factor: np.ndarray
    dark_rate: np.ndarray  # Hz
    lazy: np.ndarray
    hot: np.ndarray


def hidden_chip(side: int, rng: np.random.Generator) -> Chip:
    """A chip of side x side pixels with PDP spread, lazy pixels (half of them in groups) and hot pixels."""
    pixels = side * side
    factor = 1 + SPREAD * rng.standard_normal(pixels).clip(-3, 3)
    lazy = np.zeros((side, side), bool)
    wanted = max(3, round(LAZY * pixels))
    while lazy.sum() < wanted // 2:  # the paper suspects the excess bias of "those (group of) pixels"
        x, y = rng.integers(0, side - 2, 2)
        lazy[y : y + 3, x : x + 3] = rng.random((3, 3)) < 0.6
    alone = rng.choice(np.flatnonzero(~lazy), max(wanted - int(lazy.sum()), 0), replace=False)
    lazy.flat[alone] = True
    factor[lazy.ravel()] = rng.uniform(*LAZY_PDP, int(lazy.sum()))
    dark = DARK_MEDIAN * np.exp(RATE_SPREAD * rng.standard_normal(pixels))
    hot = np.zeros(pixels, bool)
    hot[rng.choice(pixels, max(3, round(HOT * pixels)), replace=False)] = True
    dark[hot] = HOT_RATE * np.exp(HOT_SPREAD * rng.standard_normal(int(hot.sum())))
    return Chip(factor / factor.mean(), dark * DARK_MEAN / dark.mean(), lazy.ravel(), hot)


def record(
    folder: Path,
    side: int = SIDE,
    frames: int = FRAMES,
    dark_rate: float = DARK_MEDIAN,
    seed: int = 512,
    jobs: int = 1,
) -> Chip:
    """Write `folder`/lab, the measurement, and `folder`/sensor.yaml, the paper's uniform model; the hidden truth.

    dark_rate: of the uniform model (Hz).
    """
    lab = folder / "lab"
    lab.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    chip = hidden_chip(side, rng)
    world = World(side, side, AREA, PDP, dark_rate=chip.dark_rate, pdp_factor=chip.pdp_factor)
    stated = [
        Capture(name, "qis", wavelength, irradiance, frames=round(share * frames), frame_time=frame, frame_period=frame)
        for name, wavelength, irradiance, frame, share in CAPTURES
    ]
    parts = [
        replace(c, irradiance=c.irradiance * POWER_METER, frames=min(_PART, c.frames - begun))
        for c in stated
        for begun in range(0, c.frames, _PART)
    ]
    with ProcessPoolExecutor(jobs) as pool:
        made = pool.map(_recorded, [world] * len(parts), parts, rng.spawn(len(parts)))
        for capture in stated:
            seen = np.concatenate([next(made) for _ in range(0, capture.frames, _PART)])
            with h5py.File(lab / f"{capture.name}.h5", "w") as file:
                file.attrs["modality"] = "qis"
                packed = file.create_dataset("frames", data=seen, compression="gzip")
                packed.attrs["width"] = side
    _write_plan(lab, side, stated)
    sensor = {
        "name": "SPAD512, uniform",
        "rules": "paper",
        "layout": {"rows": side, "columns": side, "pixel_area": f"{AREA * 1e12:g} um^2", "fill_factor": 1.0},
        "effects": {
            "detection": {"pdp": {f"{w * 1e9:.0f} nm": q for w, q in PDP.items()}},
            "dark_counts": {"rate": f"{dark_rate:g} Hz"},
        },
    }
    (folder / "sensor.yaml").write_text(yaml.safe_dump({"sensor": sensor}, sort_keys=False))
    np.savez(folder / "truth.npz", **vars(chip))
    return chip


def _write_plan(folder: Path, side: int, captures: list[Capture]) -> None:
    """measurement.yaml: what the lab notes down."""
    entries = []
    for c in captures:
        light: dict[str, Any] = {"kind": "dark"}
        if not c.dark:
            light = {
                "kind": "flat",
                "wavelength": f"{c.wavelength * 1e9:.0f} nm",
                "irradiance": f"{c.irradiance * 1e5:.6g} nW/cm^2",
                "relative_uncertainty": LIGHT_UNCERTAINTY,
            }
        frame = f"{c.frame_time * 1e6:g} us"
        file = {"id": c.name, "file": f"{c.name}.h5", "modality": c.modality, "light": light}
        entries.append({**file, "frames": c.frames, "frame_time": frame, "frame_period": frame})
    plan = {"format": "spadmnist-measurement/1", "name": "SPAD512-like", "layout": {"rows": side, "columns": side}}
    folder.mkdir(exist_ok=True)
    (folder / "measurement.yaml").write_text(yaml.safe_dump({**plan, "captures": entries}, sort_keys=False))


def _recorded(world: World, capture: Capture, rng: np.random.Generator) -> np.ndarray:
    """(frames, rows, columns / 8) packed bits."""
    return np.packbits(bits(world, capture, *expose(world, capture, rng)), axis=2)


def counts_of(measurement: Path) -> dict[str, np.ndarray]:
    """Frames in which each pixel has fired, (pixels,), for every capture in a measurement's folder."""
    found = {}
    for name, *_ in CAPTURES:
        with h5py.File(measurement / f"{name}.h5") as file:
            frames = file["frames"]
            whole = frames[:]
            if "width" in frames.attrs:
                whole = np.unpackbits(whole, axis=2, count=int(frames.attrs["width"]))
        found[name] = whole.sum(axis=0, dtype=np.int64).ravel()
    return found


@dataclass(frozen=True)
class Shape:
    """A histogram of counts per pixel in four numbers."""

    mean: float
    width: float  # of the peak, in units of the scatter of pixels that are all alike
    low: float  # share of pixels more than four widths below the peak
    high: float  # and above


def shape(counts: np.ndarray, frames: int) -> Shape:
    """counts: (pixels,) frames in which each has fired, of `frames`."""
    peak = float(np.median(counts))
    alike = max(peak * (1 - peak / frames), 1.0) ** 0.5
    quartiles = float(np.subtract(*np.percentile(counts, (75, 25)))) / 1.349
    edge = 4 * max(quartiles, alike)
    low, high = counts < peak - edge, counts > peak + edge
    return Shape(
        float(counts.mean()), float(counts[~(low | high)].std()) / alike, float(low.mean()), float(high.mean())
    )


# ---- what diagnose says -----------------------------------------------------------------------------------


def spadmnist(*words: str | Path) -> None:
    """Run a verb of the package as a user would."""
    command = [sys.executable, "-m", "spadmnist.cli", *map(str, words)]
    subprocess.run(command, check=True, env={"OMP_NUM_THREADS": "1", **os.environ})


def diagnosed(folder: Path, quick: bool = False, jobs: int = 1) -> dict[str, Any]:
    """The answer of `spadmnist diagnose`, which sees the measurement and the uniform model only."""
    answer = folder / "answer.json"
    if not answer.exists():
        more = ["--quick"] if quick else []
        where = ("-o", folder / "next", "--json", answer, "--jobs", str(jobs))
        spadmnist("diagnose", folder / "sensor.yaml", folder / "lab", *where, *more)
    return dict(json.loads(answer.read_text()))


def found(answer: dict[str, Any], effect: str) -> dict[str, dict[str, float]]:
    """Values of the per-pixel map of an effect, {} where diagnose has found none."""
    steps = [s for s in answer["steps"] if s["change"] == "per_pixel" and s["effect"] == effect]
    return dict(steps[-1]["values"]) if steps else {}


def truths(chip: Chip) -> dict[tuple[str, str], float]:
    """(effect, value): what diagnose should say."""
    normal = ~chip.lazy
    middle = float(np.median(chip.pdp_factor))
    return {
        ("detection", "sigma"): float(np.log(chip.pdp_factor[normal]).std()),
        ("detection", "low_fraction"): float(chip.lazy.mean()),
        ("detection", "low_ratio"): float(chip.pdp_factor[chip.lazy].mean()) / middle,
        ("dark_counts", "high_fraction"): float(chip.hot.mean()),
    }


WORDS = {
    ("detection", "sigma"): "PDP, spread of the ordinary pixels",
    ("detection", "low_fraction"): "lazy pixels, share",
    ("detection", "low_ratio"): "lazy pixels, PDP left to them",
    ("dark_counts", "high_fraction"): "hot pixels, share",
}


def table(chip: Chip, answer: dict[str, Any]) -> str:
    """The truth beside the answer."""
    lines = [f"{'':36} {'hidden':>8} {'found':>8}   95 %"]

    def line(words: str, true: float, value: dict[str, float] | None, form: str) -> None:
        if value is None:
            lines.append(f"{words:36} {true:8{form}} {'nothing':>8}")
            return
        told = f"{words:36} {true:8{form}} {value['value']:8{form}}"
        if value.get("low") is not None:
            held = value["low"] <= true <= value["high"]
            told += f"   {value['low']:{form}} to {value['high']:{form}}{'' if held else '   (not within)'}"
        lines.append(told)

    for (effect, name), true in truths(chip).items():
        line(WORDS[effect, name], true, found(answer, effect).get(name), ".2%")
    light = [n for n in answer["nuisances"] if n["name"] == "light" and n["capture"] is None]
    line("light, beside the power meter", POWER_METER, light[0] if light else None, ".4f")
    after, floor = answer["misfit"], answer["misfit_null_95"]
    lines.append(f"verdict: {answer['verdict']}")
    lines.append(f"misfit: {after['before']:.2f} before, {after['after']:.2f} after; noise alone: up to {floor:.2f}")
    return "\n".join(lines)


# ---- both models beside the measurement -------------------------------------------------------------------


def twins(folder: Path, answer: dict[str, Any]) -> dict[str, dict[str, np.ndarray]]:
    """Counts per pixel as measured, of the uniform model, and of the model found at the light that was fitted."""
    if not (folder / "uniform").exists():
        spadmnist("simulate", folder / "sensor.yaml", folder / "lab", "-o", folder / "uniform")
    if not (folder / "found").exists():
        plan = yaml.safe_load((folder / "lab" / "measurement.yaml").read_text())
        for capture in plan["captures"]:
            for nuisance in answer["nuisances"]:
                of_this = nuisance["name"] == "light" and nuisance["capture"] in (None, capture["id"])
                if of_this and "irradiance" in capture["light"]:
                    level = float(capture["light"]["irradiance"].split()[0]) * nuisance["value"]
                    capture["light"]["irradiance"] = f"{level:.6g} nW/cm^2"
        (folder / "fitted").mkdir(exist_ok=True)
        (folder / "fitted" / "measurement.yaml").write_text(yaml.safe_dump(plan, sort_keys=False))
        spadmnist("simulate", folder / "next" / "sensor.yaml", folder / "fitted", "-o", folder / "found")
    return {which: counts_of(folder / which) for which in ("lab", "uniform", "found")}


def histograms(counts: dict[str, dict[str, np.ndarray]], frames: int) -> str:
    """The shape of every histogram, three lines a capture; means are of `frames` frames."""
    names = {"lab": "measured", "uniform": "uniform model", "found": "model found"}
    lines = [
        f"{'capture':12} {'':14} {'mean':>8}  peak's width  far below  far above   paper's mean (experiment, model)"
    ]
    for name, *_, share in CAPTURES:
        for which, of in counts.items():
            s = shape(of[name], round(share * frames))
            told = f"{name if which == 'lab' else '':12} {names[which]:14} {s.mean / share:8.1f}"
            told += f"  {s.width:10.2f} x  {s.low:9.2%}  {s.high:9.2%}"
            lines.append(told + (f"   {PAPER_MEANS[name]}" if which == "lab" else ""))
    return "\n".join(lines)


def draw(file: Path, counts: dict[str, dict[str, np.ndarray]], answer: dict[str, Any], frames: int) -> None:
    """Histograms of counts per pixel, and the ladder of misfit."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import FuncFormatter, NullFormatter

    measured, uniform, better, rough = "#1d2329", "#d98a1f", "#2f6ea5", "#5b6670"
    style: dict[str, Any] = {
        "font.size": 9.5,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.edgecolor": rough,
        "axes.labelcolor": measured,
        "axes.titlesize": 10.5,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "xtick.color": rough,
        "ytick.color": rough,
        "legend.frameon": False,
        "figure.constrained_layout.use": True,
    }
    pixels = len(next(iter(counts["lab"].values())))
    side = round(pixels**0.5)
    looks = {
        "lab": {"fill": True, "color": "#cdd3d8", "label": "measured"},
        "uniform": {"color": uniform, "lw": 1.5, "label": "uniform model"},
        "found": {"color": better, "lw": 1.5, "label": "model found"},
    }

    def histogram(axes: Any, name: str, low: float, high: float, bins: int, log: bool) -> None:
        # whole counts in every bin, equally many
        step = max(1, round((high - low) / bins))
        edges = np.arange(np.floor(low), high + step, step) - 0.5
        most = 0.0
        for which, look in looks.items():
            pixels_of = np.histogram(counts[which][name], edges)[0]
            axes.stairs(np.maximum(pixels_of, 0.4 if log else 0), edges, baseline=0.4 if log else 0, **look)
            most = max(most, float(pixels_of.max()))
        axes.set_xlim(edges[0], edges[-1])
        axes.set_ylim(0, 1.08 * most)
        if log:
            axes.set_yscale("log")
            axes.set_ylim(0.5, 2 * most)
            axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:,.0f}"))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:,.0f}"))
        frame = {n: f for n, _, _, f, _ in CAPTURES}[name]
        axes.set_xlabel(f"counts of a pixel in {frames:,} frames of {frame * 1e6:.0f} us")
        axes.set_ylabel("pixels" + (", logarithmic" if log else ""))

    def note(axes: Any, words: str, x: float) -> None:
        axes.text(x, 0.38, words, color=measured, fontsize=9, ha="center", transform=axes.transAxes)

    def ladder(axes: Any) -> None:
        rows, before = [], ""
        for rung in answer["ladder"]:
            words = plain(rung["model"], before)
            rows.append((words, rung["misfit"], rough if rung["placebo"] else better if before else uniform))
            before = before if rung["placebo"] else rung["model"]
        most, floor = max(misfit for _, misfit, _ in rows), answer["misfit_null_95"]
        axes.axvspan(0.5, floor, color="#e3e6e8", zorder=0)
        axes.set_xscale("log")
        axes.set_xlim(0.85, 1.6 * most)
        axes.set_ylim(len(rows) - 0.6, -0.75)
        for place, (words, misfit, colour) in enumerate(rows):
            axes.plot([0.85, misfit], [place, place], color=colour, lw=1.5, zorder=1)
            axes.scatter([misfit], [place], c=[colour], s=60, zorder=2)
            axes.text(1.08 * floor, place - 0.2, words, color=measured)
            shift = {"xytext": (8, -3), "textcoords": "offset points"}
            axes.annotate(f"{misfit:.3g}", (misfit, place), color=measured, **shift)
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.set_xticks([v for v in (1, 2, 5, 10, 20, 50, 100, 200) if v < 1.6 * most])
        axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel(f"misfit (grey: up to {floor:.2f}, which noise alone explains)")
        axes.set_title("What diagnose adds, and the misfit that is left")

    with pyplot.rc_context(style):
        figure, grid = pyplot.subplots(2, 2, figsize=(10, 6.4))
        bright, dim = counts["lab"]["700nm-high"], counts["lab"]["500nm-low"]
        peak, wide = float(np.median(bright)), np.subtract(*np.percentile(bright, (75, 25))) / 1.349
        histogram(grid[0, 0], "700nm-high", peak - 4 * wide, peak + 4 * wide, 50, log=False)
        grid[0, 0].set_title("Bright light, 700 nm: a broader peak")
        grid[0, 0].legend(loc="upper right", fontsize=9)
        histogram(grid[0, 1], "700nm-high", 0.9 * bright.min(), 1.03 * bright.max(), 80, log=True)
        grid[0, 1].set_title("The same, every pixel: a low shoulder, and hot pixels")
        histogram(grid[1, 0], "500nm-low", 0.8 * dim.min(), min(1.03 * dim.max(), 2.2 * np.median(dim)), 80, log=True)
        grid[1, 0].set_title("Low light, 500 nm")
        for axes in (grid[0, 1], grid[1, 0]):
            note(axes, "lazy pixels", 0.16)
            note(axes, "hot pixels", 0.9)
        ladder(grid[1, 1])
        figure.suptitle(f"Counts of {side} x {side} pixels, as recorded by another simulator, and two models of them")
        file.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(file, dpi=110, metadata={"Software": None})
        pyplot.close(figure)


def plain(model: str, before: str) -> str:
    """What a rung of the ladder adds to the one `before`, in words."""
    if model.startswith("placebo: "):
        return f"placebo, something irrelevant: {model.removeprefix('placebo: ')}"
    if not before:
        return "uniform model, as in the paper"
    added = model.removeprefix(before).strip(" +")
    names = {"detection.pdp per pixel": "PDP", "dark_counts.rate per pixel": "dark count rate"}
    return "+ " + " + ".join(f"{names[part]} of each pixel" if part in names else part for part in added.split(" + "))


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("folder", type=Path, help="where measurement, answer and twins go")
    parser.add_argument("--figure", type=Path, help="draw it there (PNG)")
    parser.add_argument("--side", type=int, default=SIDE, help="pixels along a side (%(default)s)")
    parser.add_argument("--frames", type=int, default=FRAMES, help="of each capture (%(default)s)")
    parser.add_argument("--dark-rate", type=float, default=DARK_MEDIAN, help="Hz, of the uniform model (%(default)g)")
    parser.add_argument("--quick", action="store_true", help="diagnose --quick")
    parser.add_argument("--jobs", "-j", type=int, default=1, help="processes (%(default)s)")
    args = parser.parse_args()
    if not (args.folder / "truth.npz").exists():
        record(args.folder, args.side, args.frames, args.dark_rate, jobs=args.jobs)
    with np.load(args.folder / "truth.npz") as stored:
        chip = Chip(**stored)
    plan = yaml.safe_load((args.folder / "lab" / "measurement.yaml").read_text())
    frames = int(plan["captures"][0]["frames"])
    answer = diagnosed(args.folder, args.quick, args.jobs)
    print(table(chip, answer))
    counts = twins(args.folder, answer)
    print(histograms(counts, frames))
    if args.figure:
        draw(args.figure, counts, answer, frames)


if __name__ == "__main__":
    main()
