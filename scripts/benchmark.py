"""Measure what docs/evidence/benchmark.md claims, on this machine, and print it as a table (`make bench`).

Ratios are taken within one run, the two sides in turn, and the median over the rounds is quoted: the machine's speed
drifts. Nothing here fails because something is slow.

    python scripts/benchmark.py [--images-dir DIR] [--quick] [--output FILE]
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "scripts")]

import algorithm1  # noqa: E402
import plain_numpy  # noqa: E402

import spadmnist  # noqa: E402
from spadmnist import config, dataset, factory, measurement, reconstruct, shard_columns, shard_plan, twin  # noqa: E402
from spadmnist.effects import Conditions, Effect  # noqa: E402
from spadmnist.errors import SpadError  # noqa: E402
from spadmnist.events import Layout  # noqa: E402
from spadmnist.heap import keep_freed_memory  # noqa: E402
from spadmnist.plugins import Distribution  # noqa: E402
from spadmnist.recording import Capture, Light  # noqa: E402
from spadmnist.sensor import Sensor  # noqa: E402
from spadmnist.streams import Streams  # noqa: E402

Row = tuple[str, str, str]


def seconds(call: Callable[[], object]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def against(ours: Callable[[], object], others: list[Callable[[], object]], rounds: int) -> list[float]:
    """Median over rounds of (ours / other) for each other; the two sides in turn."""
    ours()
    for other in others:
        other()
    ratios: list[list[float]] = [[] for _ in others]
    for _ in range(rounds):
        for ratio, other in zip(ratios, others, strict=True):
            ratio.append(seconds(ours) / seconds(other))
    return [statistics.median(r) for r in ratios]


def experiment_at(level: str, images_dir: Path | None, limit: int | None = None):  # type: ignore[no-untyped-def]
    """The paper's dataset at one level, and its images (or drawn digits where MNIST is not at hand)."""
    experiment = config.read(ROOT / "configs" / "spad_mnist.yaml", lux=(level,), limit=limit)
    try:
        return experiment, experiment.load_images(images_dir), "MNIST"
    except SpadError:
        digits = config.read(ROOT / "configs" / "quick.yaml", lux=(level,), limit=limit)
        return digits, digits.load_images(), "drawn digits"


def simulation(images_dir: Path | None, rounds: int) -> list[Row]:
    """One core, no storing: against raw exponentials, plain numpy and the literal algorithm."""
    keep_freed_memory()
    experiment, splits, kind = experiment_at("2560 mlux", images_dir)
    images = splits["train"]
    level = experiment.levels[0]
    n = min(400, len(images))
    pixels = np.ascontiguousarray(images.pixels[:n])
    methods = [reconstruct.find(name) for name in experiment.methods]

    def ours() -> None:
        made = experiment.simulate_block(level, "train", pixels, images.white, 0)
        for method in methods:
            method.image(made, experiment.settings)

    photons = experiment.photons(level, pixels, images.white)
    rates, _ = experiment.sensor.rates(photons, experiment.conditions)
    draws = int(rates.sum() * experiment.conditions.exposure)
    rng = np.random.Generator(np.random.SFC64(1))
    buffer = np.empty(draws // n)

    def floor() -> None:
        for _ in range(n):
            rng.standard_exponential(out=buffer)

    def numpy_batches() -> None:
        for i in range(0, n, 8):
            plain_numpy.simulate(rng, rates[i : i + 8].ravel())

    def staged() -> None:
        numbers = np.arange(n, dtype=np.uint64)
        streams = experiment.streams(level, "train", numbers)
        made = experiment.sensor.expose(photons, experiment.conditions, streams, experiment.readouts, staged=True)
        for method in methods:
            method.image(made, experiment.settings)

    as_device = Sensor(experiment.sensor.layout, experiment.sensor.effects, "device").resolved()

    def device() -> int:
        streams = experiment.streams(level, "train", np.arange(n, dtype=np.uint64))
        made = as_device.expose(photons, experiment.conditions, streams, experiment.readouts)
        return len(made.tr or ())

    def staged_alone() -> None:
        streams = experiment.streams(level, "train", np.arange(n, dtype=np.uint64))
        experiment.sensor.expose(photons, experiment.conditions, streams, experiment.readouts, staged=True)

    to_floor, to_numpy, to_staged = against(ours, [floor, numpy_batches, staged], rounds)
    (device_to_staged,) = against(device, [staged_alone], rounds)
    detection = statistics.median(seconds(device) for _ in range(rounds)) / device()
    source = random.Random(1)
    some = [float(x) for x in photons[0]]

    def literal() -> None:
        for flux in some:
            made = algorithm1.pixel(source, flux, 1e-3, 0.5, 100.0, 50e-9, 0.005, 25e-9, 1e-11, 100, 1e-5)
            algorithm1.inter_photon(made.tr, 0.5, 50e-9, 1e-11)
            algorithm1.str_flux(made.str, 0.5, 1e-5, 1e-11)
            algorithm1.qis_linear(made.qis)

    one = statistics.median(seconds(ours) for _ in range(rounds)) / n
    # the same image on both sides would be one in 400 of ours: compare per candidate event
    events = rates.sum() * experiment.conditions.exposure
    slow = statistics.median(seconds(literal) for _ in range(3)) / (rates[0].sum() * experiment.conditions.exposure)
    name = f"TR, STR, QIS and six reconstructions, 2560 mlux, one core ({kind})"
    return [
        (
            f"{name}, against numpy's SFC64 exponentials for as many draws",
            "<= 2.6x (2.0x AVX-512)",
            f"{to_floor:.2f}x",
        ),
        ("the same: time an image", "", f"{one * 1e6:.0f} us"),
        ("the same, faster than plain numpy in batches", ">= 7x", f"{1 / to_numpy:.1f}x"),
        (
            "the same, faster than the literal algorithm in Python",
            ">= 350x",
            f"{slow * events / (one * n):.0f}x",
        ),
        ("the staged line (serves every sensor) against the fused one", "<= 3.8x", f"{1 / to_staged:.1f}x"),
        (
            "the same sensor under `rules: device`, without reconstructions: time a detection",
            "",
            f"{detection * 1e9:.0f} ns",
        ),
        ("the same, against the staged line of the paper's rules", "", f"{device_to_staged:.1f}x"),
    ]


def effects(rounds: int) -> list[Row]:
    """What each registered effect adds to a TR and QIS recording, one core, at its default values."""
    layout = Layout(28, 28, 25e-12, 1.0)
    conditions = Conditions(1e-3, 100, 1e-5, 1e-5, 555e-9, bits=2)
    photons = np.full((32, layout.pixels), 2.6e5)
    streams = Streams(1, "benchmark", "train", np.arange(len(photons), dtype=np.uint64))
    usual = {"detection": {"pdp": 0.5}, "dark_counts": {"rate": 100.0}, "dead_time": {}, "tdc": {"resolution": 1e-10}}

    def shot(settings: dict[str, dict[str, object]], rules: str) -> Callable[[], int]:
        made = [Effect.registry.find(name)(**values) for name, values in settings.items()]
        sensor = Sensor(layout, made, rules).resolved()
        readouts = ("tr", "qis", "counts")
        return lambda: len(sensor.expose(photons, conditions, streams, readouts, staged=True).tr or ())

    def present(kind: type[Effect]) -> dict[str, object]:
        """Its defaults; what is off by default is set to something."""
        values: dict[str, object] = {}
        for name, p in kind.parameters.items():
            if p.default == p.off and p.off is not None and p.per:
                values[name] = Distribution("normal", (float(p.off), 0.2))
            elif p.default == p.off and p.search is not None:
                low, high = p.search
                values[name] = math.sqrt(low * high) if low > 0 else high / 2
        return values

    rows = []
    for name in Effect.registry:
        with_it = {**usual, name: {**usual.get(name, {}), **present(Effect.registry.find(name))}}
        without = {key: value for key, value in usual.items() if key != name}
        worst = -math.inf
        for rules in ("paper", "device"):
            one, other = shot(without, rules), shot(with_it, rules)
            events = max(one(), other())
            pairs = [(seconds(other), seconds(one)) for _ in range(rounds)]
            worst = max(worst, (min(a for a, _ in pairs) - min(b for _, b in pairs)) / events)
        rows.append(
            (f"effect {name}: what it adds, per event (the slower of both rules)", "<= 15 ns", f"{worst * 1e9:.1f} ns")
        )
    return rows


def reading(images_dir: Path | None, folder: Path) -> list[Row]:
    """One image from the store and from the seed."""
    experiment, splits, _ = experiment_at("2560 mlux", images_dir, limit=2000)
    root = folder / "reading"
    factory.generate(experiment, splits, root, 2)
    rng = np.random.default_rng(1)
    rows = []
    for what, opened, wanted in (
        ("one image's TR stream from the store (Zarr)", spadmnist.open(root), "<= 0.25 ms"),
        ("one image, all readouts, from the seed", dataset.simulated(experiment, images_dir), "<= 0.2 ms"),
    ):
        part = opened["2560 mlux", "train"]
        picks = [int(i) for i in rng.integers(0, len(part), 300)]
        for i in picks[:100]:
            part.tr[i]
        took = sorted(seconds(lambda i=i, part=part: part.tr[i].ticks) for i in picks[100:])
        rows.append((what, wanted, f"{took[100] * 1e3:.2f} ms"))
    return rows


def learning(images_dir: Path | None, folder: Path, quick: bool) -> list[Row]:
    """Training data for PyTorch on one core: read, simulated, and the share that reading has of an epoch of LeNet."""
    try:
        import torch
    except ImportError:
        return [("training data for PyTorch", "", "not measured: PyTorch is not installed")]
    import pickle

    from torch.utils.data import DataLoader

    import spadmnist.torch as st
    from spadmnist.experiments import _lenet

    torch.set_num_threads(1)
    images = 2_000 if quick else 10_000
    rows: list[Row] = []
    opened = None
    for level, wanted in (("2560 mlux", ">= 4,500 images/s"), ("80 mlux", ">= 50,000 images/s")):
        one, splits, _ = experiment_at(level, images_dir, limit=images)
        root = folder / f"learning-{level.split()[0]}"
        factory.generate(one, splits, root, 2)
        part = spadmnist.open(root)[level, "train"]
        opened = opened or part
        took = min(seconds(lambda part=part: sum(1 for _ in st.stream(part))) for _ in range(3))
        rows.append((f"TR events, shuffled stream, {level}, one core", wanted, f"{len(part) / took:,.0f} images/s"))
    assert opened is not None
    fluxes = st.Fluxes(opened)
    batches = DataLoader(fluxes, batch_size=64, shuffle=True)  # type: ignore[var-annotated, arg-type]
    read = min(seconds(lambda: sum(1 for _ in batches)) for _ in range(3)) / len(fluxes)
    rows.append(("fluxes, shuffled, batches of 64, one core", ">= 50,000 images/s", f"{1 / read:,.0f} images/s"))
    data = _lenet.Labelled(opened.reconstruction["counts"].normalised[:], opened.labels[:])
    learned = seconds(lambda: _lenet.train(data, 1, 1)) / len(data.labels)
    rows.append(("an epoch of fluxes: reading against LeNet", "<= 10 %", f"{read / learned:.1%}"))
    originals = [(opened.images[i], int(opened.labels[i])) for i in range(1000)]
    sensor = spadmnist.read_sensor(ROOT / "configs" / "spad_mnist.yaml")
    clock = {"exposure": "1 ms", "frames": 100, "frame_time": "10 us", "frame_period": "10 us"}
    rates = []
    for readout in ("tr", "str", "qis", "counts"):
        made = st.Simulated(originals, sensor, recording=clock, lux="2560 mlux", returns=readout)
        loader = DataLoader(made, batch_size=64, collate_fn=list)  # type: ignore[var-annotated, arg-type]
        best = math.inf
        for epoch in range(3):
            made.set_epoch(epoch)
            best = min(best, seconds(lambda loader=loader: sum(len(batch) for batch in loader)))
        rates.append(f"{readout} {len(originals) / best:,.0f}")
    what = "simulated afresh while training, 2560 mlux, one core, images/s"
    rows.append((what, ">= 5,000 of each readout", ", ".join(rates)))
    sent = max(len(pickle.dumps(one)) for one in (fluxes, st.stream(opened)))
    rows.append(("what a spawned worker is sent", "< 100 kB", f"{sent / 1e3:.0f} kB"))
    return rows


REDUCE = """\
import sys
from spadmnist import config, measurement
from spadmnist.inference.reduction import statistics_for
data = measurement.open(sys.argv[2])
recording = data.recording("flat", config.read_sensor(sys.argv[1]))
for statistic in statistics_for(recording.capture):
    statistic.reduce(recording)
"""


def inference(folder: Path, quick: bool) -> list[Row]:
    """Measurements: comparing one with a model, and reading a very large one."""
    rows: list[Row] = []
    cases = ROOT.parent / "shared" / "challenge"
    os.environ["SPADMNIST_CACHE"] = str(folder / "nulls")
    for case in ("open-tr-null", "open-qis-null"):
        if not (cases / case).is_dir():
            continue
        command = [
            sys.executable,
            "-m",
            "spadmnist.cli",
            "compare",
            str(cases / case / "sensor.yaml"),
            str(cases / case),
        ]
        for what, wanted in (("nothing remembered", "<= 60 s, <= 1.5 GB"), ("its nulls remembered", "")):
            took, peak, _ = run([*command, "--jobs", "2"])
            rows.append((f"compare, {case}, {what}", wanted, f"{took:.0f} s, {peak / 1e9:.2f} GB"))
    if not quick:
        root = folder / "large"
        sensor = config.read_sensor(ROOT / "configs" / "spad512.yaml")
        lit = Light(500e-9, 1.2e-3)  # 120 nW/cm^2
        capture = Capture("flat", "qis", lit, Conditions(1e-2, 10_000, 1e-6, 1e-6, 500e-9))
        flux = twin.photons_at(capture, sensor.layout) or 0.0
        one = np.zeros(1, np.uint64)
        made = twin.model_recordings(sensor, capture, flux, Streams(1, "benchmark", "large", one), one)
        measurement.write(root, "large", sensor.layout, made)
        took, peak, _ = run([sys.executable, "-c", REDUCE, str(ROOT / "configs" / "spad512.yaml"), str(root)])
        what = "all statistics of a capture of 512 x 512 pixels and 10,000 frames, read from disk"
        rows.append((what, "<= 60 s, <= 2 GB", f"{took:.0f} s, {peak / 1e9:.2f} GB"))
    return rows


class Ran(NamedTuple):
    """How a command ran. seconds: by the clock; peak: bytes of its largest process; processor: s, of all of them."""

    seconds: float
    peak: int
    processor: float


def run(arguments: list[str], ok: str = "0") -> Ran:
    """Run a command. Raises SystemExit where it ends with another status."""
    code = (
        "import resource,subprocess,sys,time;t=time.perf_counter();"
        "r=subprocess.run(sys.argv[1:],stdout=subprocess.DEVNULL,stderr=subprocess.DEVNULL).returncode;"
        "t=time.perf_counter()-t;u=resource.getrusage(resource.RUSAGE_CHILDREN);"
        "print(t,u.ru_maxrss,u.ru_utime+u.ru_stime,r)"
    )
    out = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True).stdout
    took, peak, processor, status = out.split()
    if status not in ok:
        raise SystemExit(f"{' '.join(arguments)} failed with exit status {status}")
    return Ran(float(took), int(peak) * (1 if sys.platform == "darwin" else 1024), float(processor))


def floors(manifest: dict, experiment, splits) -> dict[str, float]:  # type: ignore[no-untyped-def,type-arg]
    """Bytes below which no code can store the streams of pixels whose rates are known (Poisson)."""
    tick, exposure = experiment.sensor.tick, experiment.conditions.exposure
    frames, frame_time = experiment.conditions.frames, experiment.conditions.frame_time
    tr = qis = stamps = 0.0
    level = experiment.levels[0]
    for images in splits.values():
        counted = np.bincount(images.pixels[: experiment.wanted(images)].ravel(), minlength=256)
        photons = experiment.photons(level, np.arange(256, dtype=np.uint8)[:, None, None], images.white)[:, 0]
        for number, flux in zip(counted, photons, strict=True):
            mean = (flux * 0.5 + 100.0) * exposure
            # a Poisson number, and the times: mean * log2(exposure / tick) bits less log2 N! for their order
            n = np.arange(int(mean + 12 * math.sqrt(mean) + 30))
            logs = np.array([math.lgamma(k + 1) for k in n])
            p = np.exp(n * math.log(mean) - mean - logs)
            entropy = -(p * (n * math.log(mean) - mean - logs)).sum() / math.log(2)
            tr += number * (entropy + mean * math.log2(exposure / tick) - (p * logs).sum() / math.log(2))
            share = -math.expm1(-mean / frames)
            bernoulli = -share * math.log2(share) - (1 - share) * math.log2(1 - share)
            qis += number * frames * bernoulli
            # the first arrival in a frame that has one: a truncated exponential
            rate = mean / frames
            nats = 1 - math.log(rate / share) - rate * (1 / share - 1)
            stamps += number * frames * share * (nats / math.log(2) + math.log2(frame_time / tick))
    return {"tr": tr / 8, "qis": qis / 8, "str": (qis + stamps) / 8}


def stored(manifest: dict, root: Path) -> dict[str, int]:  # type: ignore[type-arg]
    """Bytes on disk by kind of stream."""
    sizes = {"tr": 0, "qis": 0, "str": 0}
    shards = [name for name in manifest["files"] if name.endswith(".zip")]
    members = [info for name in shards for info in zipfile.ZipFile(root / name).infolist()]
    for kind, parts in (
        ("tr", ("tr/ticks/", "tr/counts/")),
        ("qis", ("frames/bits/",)),
        ("str", ("frames/bits/", "frames/ticks/")),
    ):
        sizes[kind] += sum(info.file_size for info in members if info.filename.startswith(parts))
    return sizes


def whole_runs(images_dir: Path | None, folder: Path, quick: bool) -> list[Row]:
    """The dataset through the command line, two workers."""
    command = [sys.executable, "-m", "spadmnist.cli", "generate", str(ROOT / "configs" / "spad_mnist.yaml")]
    command += ["--images-dir", str(images_dir)] if images_dir else []
    rows: list[Row] = []
    one = run([*command, "-o", str(folder / "one"), "--lux", "2560 mlux", "--limit", "1"])  # as it is typed
    command += ["--jobs", "2"]
    rows.append(("`generate` of one image of each split, cold process", "<= 1.5 s", f"{one.seconds:.1f} s"))
    small = run([*command, "-o", str(folder / "small"), "--lux", "2560 mlux", "--limit", "6000"])
    root = folder / "small" if quick else folder / "bright"
    bright = small if quick else run([*command, "-o", str(root), "--lux", "2560 mlux"])
    experiment, splits, _ = experiment_at("2560 mlux", images_dir, limit=6000 if quick else None)
    manifest = json.loads((root / "manifest.json").read_text())
    n = sum(s["images"] for s in manifest["images"]["splits"].values())
    what = f"{n:,} images at 2560 mlux, everything stored, two workers"
    rows.append((what, "" if quick else "<= 10.7 s", f"{bright.seconds:.1f} s"))
    draws = exponentials(experiment, splits)
    rows.append(("the same, against numpy's exponentials (one core)", "<= 4.0x", f"{bright.seconds / draws:.1f}x"))
    rows.append(("the same, processor time", "" if quick else "<= 20 s", f"{bright.processor:.1f} s"))
    busy = bright.processor / bright.seconds / min(2, os.cpu_count() or 1)
    rows.append(("the same, both cores busy", ">= 95 %", f"{busy:.0%}"))
    train = spadmnist.open(root)["2560 mlux", "train"]
    fluxes = train.reconstruction["counts"][:]
    took = statistics.median(seconds(lambda: train.reconstruction["counts"][:]) for _ in range(5))
    rows.append(("a whole split of fluxes, read", ">= 2 GB/s", f"{fluxes.nbytes / took / 1e9:.1f} GB/s"))
    rows.append(
        (
            "compression and writing against the simulation",
            "<= 3x",
            f"{writing_share(experiment, splits, folder):.1f}x",
        )
    )
    floor, size = floors(manifest, experiment, splits), stored(manifest, root)
    for kind, what, wanted in (
        ("tr", "bytes of TR at 2560 mlux against the entropy of the stream", "<= 1.08x"),
        ("qis", "bytes of QIS against the Bernoulli bound", "<= 1.25x"),
        ("str", "bytes of STR (bits and first stamps) against its floor", "<= 1.10x"),
    ):
        rows.append((what, wanted, f"{size[kind] / floor[kind]:.3f}x"))
    rows.append(("peak memory of a process, 12,000 images", "<= 0.5 GB", f"{small.peak / 1e9:.2f} GB"))
    if not quick:
        rows.append(("peak memory of a process, 70,000 images", "<= 0.5 GB, the same", f"{bright.peak / 1e9:.2f} GB"))
        shutil.rmtree(root)
        took = run([*command, "-o", str(folder / "all")]).seconds
        files = json.loads((folder / "all" / "manifest.json").read_text())["files"]
        size_all = sum(f["bytes"] for f in files.values())
        rows.append((f"all ten levels, 700,000 images ({size_all / 1e9:.1f} GB)", "<= 50 s", f"{took:.0f} s"))
        rows.append(("files of the whole dataset", "<= 3,000", f"{len(files) + 1:,}"))
    return rows


def exponentials(experiment, splits) -> float:  # type: ignore[no-untyped-def]
    """s in which numpy draws as many exponentials (SFC64) as the images of one level need, on one core."""
    rng, level, took = np.random.Generator(np.random.SFC64(1)), experiment.levels[0], 0.0
    for images in splits.values():
        pixels = np.ascontiguousarray(images.pixels[: experiment.wanted(images)])
        some = pixels[:: max(1, len(pixels) // 1000)]
        rates, _ = experiment.sensor.rates(experiment.photons(level, some, images.white), experiment.conditions)
        buffer = np.empty(int(rates.sum() / len(some) * experiment.conditions.exposure))
        draw = [seconds(lambda buffer=buffer: rng.standard_exponential(out=buffer)) for _ in range(500)]
        took += statistics.median(draw) * len(pixels)
    return took


def writing_share(experiment, splits, folder: Path) -> float:  # type: ignore[no-untyped-def]
    """Encoding, hashing, writing and synchronising of a shard, against simulating it; one process, median of ten."""
    root = folder / "shards"
    (root / ".spadmnist" / "tmp").mkdir(parents=True)
    shards = [s for s in shard_plan.shards_of(experiment, splits) if s.level is not None][:14]
    job = factory.job_of(experiment)
    ratios = []
    for shard in shards:
        task = factory.task_of(experiment, job, root, shard, splits[shard.split])
        started = time.perf_counter()
        made = experiment.simulate_block(experiment.levels[0], shard.split, task.pixels, task.white, task.first)
        images = shard_columns.reconstruction_columns(experiment, made, (28, 28))
        middle = time.perf_counter()
        experiment.encoding.write(root, shard.path, shard_columns.stream_columns(made, (28, 28)) | images, {})
        ratios.append((time.perf_counter() - middle) / (middle - started))
    return statistics.median(ratios[4:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--images-dir", type=Path, help="where MNIST lies (else $SPADMNIST_DATA, the cache, a download)"
    )
    parser.add_argument("--quick", action="store_true", help="leave out the runs over 70,000 images")
    parser.add_argument("--output", type=Path, help="write the table there, too")
    arguments = parser.parse_args()
    rounds = 5 if arguments.quick else 11
    folder = Path(tempfile.mkdtemp(prefix="spadmnist-bench-"))
    try:
        rows = simulation(arguments.images_dir, rounds)
        rows += whole_runs(arguments.images_dir, folder, arguments.quick)
        rows += reading(arguments.images_dir, folder)
        rows += effects(rounds)
        rows += learning(arguments.images_dir, folder, arguments.quick)
        rows += inference(folder, arguments.quick)
        run([sys.executable, "-m", "spadmnist.cli", "--help"])
        starts = [run([sys.executable, "-m", "spadmnist.cli", "--help"])[0] for _ in range(rounds)]
        rows.append(("`spadmnist --help`", "< 0.1 s", f"{statistics.median(starts):.3f} s"))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    table = ["| what | to reach | measured |", "| --- | --- | --- |"]
    table += [f"| {what} | {wanted} | {measured} |" for what, wanted, measured in rows]
    print("\n".join(table))
    if arguments.output:
        arguments.output.write_text("\n".join(table) + "\n")


if __name__ == "__main__":
    main()
