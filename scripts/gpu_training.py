"""How fast data that trains reaches a GPU: stored fluxes and fresh photons, by number of workers. Without one: the CPU.

python scripts/gpu_training.py
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.utils.data import DataLoader

import spadmnist
import spadmnist.torch as st
from spadmnist import config, factory
from spadmnist.experiments import _lenet

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "configs" / "quick.yaml"
RECORDING = {"exposure": "1 ms", "frames": 100, "frame_time": "10 us", "frame_period": "10 us"}
TIMES = 60  # that the drawn digits of the config are shown: 24,000 images an epoch
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def trained(what: str, images: Any, batch: int, workers: int) -> None:
    """One epoch of LeNet, and a line: images a second, and the share of the time in which data were waited for."""
    network = _lenet.network((28, 28)).to(DEVICE)
    optimiser = torch.optim.Adam(network.parameters(), 1e-3)
    loader: Any = DataLoader(images, batch, shuffle=True, num_workers=workers, pin_memory=DEVICE.type == "cuda")
    began = before = time.perf_counter()
    waited = 0.0
    for fluxes, labels in loader:
        waited += time.perf_counter() - before
        optimiser.zero_grad()
        seen = network(fluxes.to(DEVICE, non_blocking=True))
        nn.functional.cross_entropy(seen, labels.to(DEVICE, non_blocking=True)).backward()
        optimiser.step()
        before = time.perf_counter()
    if DEVICE.type == "cuda":
        torch.cuda.synchronize()
    took = time.perf_counter() - began
    print(
        f"| {what}, batches of {batch}, {workers} workers | {len(images) / took:,.0f} images/s | {waited / took:.0%} |",
        flush=True,
    )


def main() -> None:
    """Print the table."""
    name = torch.cuda.get_device_name() if DEVICE.type == "cuda" else "no GPU"
    print(f"{name}, {os.cpu_count()} processors, PyTorch {torch.__version__}\n")
    print("| training LeNet on | speed | waiting for data |\n| --- | --- | --- |")
    torch.zeros(1, device=DEVICE)  # CUDA is at work before the loader forks its workers, as in a training script
    with tempfile.TemporaryDirectory() as folder:
        experiment = config.read(CONFIG, lux=("2560 mlux",))
        factory.generate(experiment, experiment.load_images(), Path(folder) / "data", 2)
        part = spadmnist.open(Path(folder) / "data")["2560 mlux", "train"]
        flux = part.reconstruction["counts"]
        stored = st.Fluxes(spadmnist.concatenate([part] * TIMES))
        originals = list(zip(part.images[:], part.labels, strict=True)) * TIMES
        fresh = st.Simulated(
            originals,
            spadmnist.read_sensor(CONFIG),
            recording=RECORDING,
            lux=(5e-3, 2.56),
            scale=flux.normalisation or 1.0,
        )
        trained("fresh photons (the first run compiles)", fresh, 64, 0)
        for workers in (0, 4, 14):
            fresh.set_epoch(workers + 1)
            trained("fresh photons", fresh, 64, workers)
            trained("stored fluxes", stored, 64, workers)
            trained("stored fluxes", stored, 1024, workers)


if __name__ == "__main__":
    main()
