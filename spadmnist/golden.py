"""The golden shard: a small fixed simulation, by whose bytes one knows what draws and writes the same as this program.

Two machines that make the same golden shard of a config make the same dataset of it, whatever the versions of their
libraries; one that makes another golden shard would make another dataset.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import math
import platform
from functools import lru_cache
from pathlib import Path

import numpy as np

from . import __version__, config, dataset, plugins, reconstruct, store
from .experiment import Experiment
from .images import Images

IMAGES = 16
_EVENTS = 1e6  # detections that all of them have at most: a tenth of a second
_BYTES = 1 << 26  # bytes of their streams at most, as of a shard; a large array has fewer images
_LIBRARIES = ("numpy", "numba", "zarr", "numcodecs", "h5py")


def versions() -> dict[str, str]:
    """Versions of this program and of the libraries that could decide the bytes of a dataset."""
    return {"spadmnist": __version__} | {name: importlib.metadata.version(name) for name in _LIBRARIES}


@lru_cache(maxsize=1)
def processor() -> str:
    """The processor of this machine, by its name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def made_by() -> str:
    """By what golden shards are made here, in words."""
    named = ", ".join(f"{name} {version}" for name, version in versions().items())
    return f"{named}, Python {platform.python_version()}, {processor()}"


def has_golden(experiment: Experiment) -> bool:
    """Whether a config has a golden shard: not where the user's own code is run, for images that nobody asked for."""
    used = [*experiment.sensor.effects, *map(reconstruct.find, experiment.methods)]
    return experiment.sensor.block == 1 and not any(plugins.is_from_file(type(one)) for one in used)


def digest(experiment: Experiment) -> str:
    """The SHA-256 of the golden shard of a config.

    It is of 16 images of noise, which the config does not decide, at its last light level, by its sensor, readouts,
    methods and format. They are dimmed where they would hold too many detections, and fewer where they are large.
    """
    channels = (len(experiment.wavelengths),) if experiment.wavelengths else ()
    shape = (*channels, *experiment.sensor.layout.shape)
    level = experiment.levels[-1]
    # noise that no library draws
    noise = hashlib.shake_256(b"golden").digest(IMAGES * math.prod(shape))
    pixels = np.frombuffer(noise, np.uint8).reshape(IMAGES, *shape)
    events, size = dataset.expected_per_image(experiment, level, Images(pixels, None, 255.0))
    white = 255.0 * max(1.0, events * IMAGES / _EVENTS)
    pixels = pixels[: max(1, min(IMAGES, int(_BYTES / size)))]
    made = experiment.simulate_block(level, "golden", pixels, white, 0)
    columns = dataset.stream_columns(made, shape) | dataset.reconstruction_columns(experiment, made, shape)
    files = store.encoded("golden", columns, {}, experiment.format)
    sums = hashlib.sha256()
    for name, pieces in sorted(files.items()):
        data = b"".join(pieces)
        sums.update(f"{name} {len(data)}\n".encode() + data)
    return sums.hexdigest()


@lru_cache(maxsize=1)
def _quick() -> str:
    return digest(config.read(config.shipped("quick.yaml")))


def answer(about: object) -> tuple[str, str]:
    """(digest of the golden shard of the config that is shipped, by what it was made); see `Executor.greet`."""
    return _quick(), made_by()
