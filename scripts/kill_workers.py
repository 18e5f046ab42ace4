"""Generate a dataset on a cluster of this machine while its workers are killed at random; is its seal the same?

    python scripts/kill_workers.py configs/spad_mnist.yaml --limit 3000 --kills 100 -o killed

A worker is killed every few seconds, as long as another one is at the scheduler, until so many have been or the dataset
is there. Each is a `dask worker` without a nanny, and another is started in its place at once, as a batch system does:
a nanny gives up where its worker dies as it starts. First the same dataset is made without a cluster. Exit status 1
where the two differ.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import threading
import time
from pathlib import Path

import distributed

from spadmnist import manifest_file


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, help="a new folder for both datasets")
    parser.add_argument("--limit", type=int, default=1000, help="images of each split")
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--every", type=float, default=2.5, help="mean seconds between two kills")
    parser.add_argument("--seed", type=int, default=0, help="of the times and the victims")
    asked = parser.parse_args()
    asked.output.mkdir()
    alone, killed = asked.output / "alone", asked.output / "killed"
    command = [sys.executable, "-m", "spadmnist", "generate", str(asked.config), "--limit", str(asked.limit), "-o"]
    subprocess.run([*command, str(alone)], check=True, stdout=subprocess.DEVNULL)
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address=None, host="127.0.0.1", silence_logs=60) as site,
        Workers(site, asked.workers) as workers,
    ):
        kills, over = [0], threading.Event()
        killer = threading.Thread(target=kill, args=(workers, kills, over, asked))
        started = time.monotonic()
        killer.start()
        try:
            run = subprocess.run(
                [*command, str(killed), "--cluster", site.scheduler_address], stdout=subprocess.DEVNULL, check=False
            )
        finally:
            over.set()
            killer.join()
    seconds = time.monotonic() - started
    if kills[0] < asked.kills:
        print(f"Only {kills[0]} of {asked.kills} workers were killed: take more images, or a shorter --every")
    if run.returncode:
        print(f"After {kills[0]} kills in {seconds:.0f} s the run ended with status {run.returncode}")
        return 1
    seals = [manifest_file.intact_manifest(root)["sha256"] for root in (alone, killed)]
    same = seals[0] == seals[1]
    print(f"{kills[0]} workers killed in {seconds:.0f} s; {'the same seal' if same else f'other seals: {seals}'}")
    return 0 if same else 1


class Workers:
    """So many workers of a scheduler, each a process of its own; within a `with` block."""

    def __init__(self, site: distributed.LocalCluster, number: int):
        self._site, self._number, self._begun = site, number, 0
        self._alive: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Workers:
        self.fill()
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._alive.values():
            process.kill()
            process.wait()

    def fill(self) -> None:
        """Start a worker for each that has ended."""
        self._alive = {name: process for name, process in self._alive.items() if process.poll() is None}
        while len(self._alive) < self._number:
            self._begun += 1
            name = f"worker-{self._begun}"
            command = [sys.executable, "-m", "dask", "worker", self._site.scheduler_address, "--name", name]
            options = ["--nthreads", "1", "--no-nanny", "--no-dashboard"]
            quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            self._alive[name] = subprocess.Popen([*command, *options], **quiet)

    def there(self) -> list[subprocess.Popen[bytes]]:
        """Those that have come to the scheduler."""
        names = {worker.name for worker in list(self._site.scheduler.workers.values())}
        return [process for name, process in self._alive.items() if name in names and process.poll() is None]


def kill(workers: Workers, kills: list[int], over: threading.Event, asked: argparse.Namespace) -> None:
    """Kill a worker now and then, until it is over, and keep up their number; kills: how many."""
    rng = random.Random(asked.seed)
    while not over.wait(rng.expovariate(1 / asked.every)):
        there = workers.there()
        if kills[0] < asked.kills and len(there) > 1:
            victim = rng.choice(there)
            victim.kill()
            victim.wait()
            kills[0] += 1
        workers.fill()


if __name__ == "__main__":
    sys.exit(main())
