"""Generate a dataset on a cluster of this machine while its workers are killed at random; is its seal the same?

    python scripts/kill_workers.py configs/spad_mnist.yaml --limit 3000 --kills 100 -o killed

A worker is killed every few seconds, as long as another one lives, until so many have been or the dataset is there.
First the same dataset is made without a cluster. Exit status 1 where the two differ.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import distributed

from spadmnist import dataset


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
    with distributed.LocalCluster(
        n_workers=asked.workers, threads_per_worker=1, dashboard_address=None, host="127.0.0.1", silence_logs=60
    ) as site:
        kills, over = [0], threading.Event()
        killer = threading.Thread(target=kill, args=(site, kills, over, asked))
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
    seals = [dataset.intact_manifest(root)["sha256"] for root in (alone, killed)]
    same = seals[0] == seals[1]
    print(f"{kills[0]} workers killed in {seconds:.0f} s; {'the same seal' if same else f'other seals: {seals}'}")
    return 0 if same else 1


def kill(site: distributed.LocalCluster, kills: list[int], over: threading.Event, asked: argparse.Namespace) -> None:
    """Kill a worker now and then, until it is over; kills: how many."""
    rng = random.Random(asked.seed)
    while kills[0] < asked.kills and not over.wait(rng.expovariate(1 / asked.every)):
        # a nanny whose worker dies as it starts replaces none and leaves: another comes, as a batch system sends one
        site.scale(asked.workers)
        begun = [nanny.process for nanny in site.workers.values() if nanny.process]
        there = [process.pid for process in begun if process.pid and process.status.name == "running"]
        if len(there) > 1:
            with contextlib.suppress(ProcessLookupError):
                os.kill(rng.choice(there), signal.SIGKILL)
                kills[0] += 1


if __name__ == "__main__":
    sys.exit(main())
