"""Does the machine that hands out shards keep up? And what does a scheduler cost against processes of this machine?

    python scripts/scale.py tasks [--tasks 100000] -o build/scale
    python scripts/scale.py executors configs/spad_mnist.yaml --limit 3000 [--rounds 5] -o build/executors

`tasks` makes a dataset of so many shards of one image. Plan, locks, tasks, notes, resume and seal are those of every
run; a stand-in for 1,000 workers does each task in this process, and a task writes one small shard and its note,
unsynchronised. Its time is counted apart. All but the last few shards are made, then the run is taken up and sealed.

`executors` makes the same dataset with two loky processes and with two workers of a dask.distributed scheduler of this
machine, both up and warm, in turn. Only on a quiet machine do its times mean anything.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import math
import resource
import shutil
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from spadmnist import config, disk, document, factory, shard_plan, store
from spadmnist.errors import SpadError
from spadmnist.factory import Progress
from spadmnist.workers import Executor, Loky

WORKERS = 1000  # that the stand-in stands for
LEFT = 10  # shards that are left for the run that goes on
CONFIG = """\
seed: 1
scene: {images: {source: uniform, repetitions: TASKS}, lux: [20 mlux]}
recording: {exposure: 80 us, frames: 8, frame_time: 10 us, readouts: [qis]}
reconstruct: []
output: {format: zarr}
sensor:
  rules: device
  layout: {rows: 8, columns: 8, pixel_area: 25 um^2}
  effects: {detection: {pdp: 0.5}}
"""


# --- tasks --------------------------------------------------------------------------------------------------------


class Stopped(Exception):
    """The run is ended here."""


class StandIn(Executor):
    """Does a task in this process as soon as it is handed out."""

    threads = WORKERS
    local = False  # no memory of this machine is asked for

    def _submit(self, function: Callable[[Any], Any], task: Any) -> Any:
        future: Future[Any] = Future()
        try:
            future.set_result(function(task))
        except Exception as error:
            future.set_exception(error)
        return future

    def _is_death(self, error: BaseException) -> bool:
        return False


class Stub:
    """Stands for `factory.make_shard`: the files of the first shard, with the attributes of each.

    Args:
        most: tasks after which the run is ended.
    """

    def __init__(self, most: float):
        self.most, self.done, self.seconds = most, 0, 0.0
        self.began = self.processor = 0.0
        self._columns: dict[str, store.Column] = {}

    def __call__(self, task: factory.Task) -> disk.Files:
        started = time.perf_counter()
        if not self.began:
            self.began, self.processor = started, time.process_time()
        if self.done == self.most:
            raise Stopped
        self.done += 1
        shard, experiment = task.shard, factory._experiment(task.job)
        if shard.level is None:
            files = REAL(task)
        else:
            if not self._columns:
                self._columns, attributes = factory.shard_content(experiment, task)
                self._told = attributes["statistics"]
            files = self._written(task, experiment.encoding)
        self.seconds += time.perf_counter() - started
        return files

    def _written(self, task: factory.Task, encoding: store.Encoding) -> disk.Files:
        path, attributes = task.shard.path, {**task.shard.attributes, "statistics": self._told}
        made: disk.Files = {}
        for name, pieces in encoding.encoded(path, self._columns, attributes).items():
            name, data = encoding.location(path) + name.removeprefix("shard"), b"".join(pieces)
            place = Path(task.root, name)
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(data)
            made[name] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        factory.note(Path(task.root), task.shard, made)
        return made


REAL = factory.make_shard


def tasks(number: int, root: Path) -> Iterator[tuple[str, float]]:
    """Make so many shards but the last few, go on with them, and seal; (name, figure) of each. root: is made."""
    experiment = config.build(document.parse(CONFIG.replace("TASKS", str(number)), "scale.yaml"), Path())
    images = experiment.load_images()
    most, shard_plan._IMAGES_PER_SHARD = shard_plan._IMAGES_PER_SHARD, 1
    try:
        stub = factory.make_shard = Stub(number - LEFT)
        before = time.perf_counter()
        with contextlib.suppress(Stopped):
            factory.generate(experiment, images, root, StandIn())
        yield "s until the first task", stub.began - before
        yield "tasks a second", stub.done / (time.perf_counter() - stub.began - stub.seconds)
        yield "MB at most, so far", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3

        stub, ended = Stub(math.inf), [0.0]
        factory.make_shard = stub
        before, processor = time.perf_counter(), time.process_time()
        stops = Progress(stop=lambda: ended.__setitem__(0, ended[0] or time.perf_counter()))
        kept = factory.generate(experiment, images, root, StandIn(), stops).kept
        yield "s to find its place", stub.began - before
        yield "the same, s of processor", stub.processor - processor
        yield "shards that were kept", kept
        yield "s to seal", time.perf_counter() - ended[0]
        yield "MB at most", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    finally:
        factory.make_shard, shard_plan._IMAGES_PER_SHARD = REAL, most


# --- executors ----------------------------------------------------------------------------------------------------


def executors(file: Path, limit: int, rounds: int, folder: Path, images_dir: Path | None) -> Iterator[str]:
    """Times of both executors in turn, as lines of Markdown. Raises SpadError where the datasets differ."""
    import distributed

    from spadmnist.cluster import Cluster

    experiment = config.read(file, limit=limit)
    images = experiment.load_images(images_dir)
    quiet: dict[str, Any] = {"dashboard_address": None, "host": "127.0.0.1", "silence_logs": 60}
    seconds: dict[str, list[float]] = {}
    seals = set()
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, **quiet) as site,
        Cluster(site.scheduler_address) as cluster,
    ):
        two: dict[str, Executor] = {"loky": Loky(2), "scheduler": cluster}
        for turn in range(rounds + 1):
            for name, workers in two.items():
                root = folder / f"{name}-{turn}"
                started = time.perf_counter()
                seals.add(factory.generate(experiment, images, root, workers).manifest["sha256"])
                if turn:  # the first one warms both
                    seconds.setdefault(name, []).append(time.perf_counter() - started)
                shutil.rmtree(root)
    if len(seals) != 1:
        raise SpadError(f"{file}: the executors made different datasets; report it")
    ratios = [b / a for a, b in zip(seconds["loky"], seconds["scheduler"], strict=True)]
    yield "| executor, two workers | median, s | all, s |"
    yield "| --- | --- | --- |"
    for name, taken in seconds.items():
        yield f"| {name} | {statistics.median(taken):.2f} | {', '.join(f'{one:.2f}' for one in taken)} |"
    yield ""
    yield f"scheduler / loky: {statistics.median(ratios):.3f} (median of {rounds}; to reach: <= 1.15)"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    one = verbs.add_parser("tasks", help="the bookkeeping of many shards")
    one.add_argument("--tasks", type=int, default=100_000)
    two = verbs.add_parser("executors", help="a scheduler of this machine against its processes")
    two.add_argument("config", type=Path)
    two.add_argument("--limit", type=int, default=3000, help="images of each split")
    two.add_argument("--rounds", type=int, default=5)
    two.add_argument("--images-dir", type=Path)
    for verb in (one, two):
        verb.add_argument("-o", "--output", type=Path, required=True, help="a new folder, which is removed at the end")
    asked = parser.parse_args()
    asked.output.mkdir(parents=True)
    try:
        if asked.verb == "tasks":
            print("| of " + f"{asked.tasks:,} tasks | measured |\n| --- | --- |")
            for name, value in tasks(asked.tasks, asked.output / "dataset"):
                print(f"| {name} | {value:,.4g} |", flush=True)
        else:
            for line in executors(asked.config, asked.limit, asked.rounds, asked.output, asked.images_dir):
                print(line)
    finally:
        shutil.rmtree(asked.output, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
