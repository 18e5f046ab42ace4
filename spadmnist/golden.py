"""The golden shard: a small fixed simulation, by whose bytes one knows what draws and writes the same as this program.

Two machines that make the same golden shard of a config make the same dataset of it, whatever the versions of their
libraries; one that makes another golden shard would make another dataset. golden.json holds the digests of the configs
that are shipped, and the versions that made them.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import math
import platform
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from . import __version__, config, manifest_file, plugins, reconstruct, shard_columns, shard_plan, store
from .errors import SpadError
from .experiment import Experiment, Level
from .identity import STREAM, portable
from .images import Images

KNOWN = Path(__file__).with_suffix(".json")
IMAGES = 16
_EVENTS = 1e6  # detections that all of them have at most: a tenth of a second
_BYTES = 1 << 26  # bytes of their streams at most, as of a shard; a large array has fewer images
_LIGHT = Level("golden", "irradiance", 1e-3)  # W/m^2; the images are dimmed or brightened, so that it decides nothing
_LIBRARIES = ("numpy", "numba", "numcodecs", "h5py")


def versions() -> dict[str, str]:
    """Versions of this program and of the libraries that could decide the bytes of a dataset."""
    return {"spadmnist": __version__} | {name: _version(name) for name in _LIBRARIES}


@lru_cache
def _version(library: str) -> str:
    return importlib.metadata.version(library)  # milliseconds, and asked for with every shard


@lru_cache(maxsize=1)
def processor() -> str:
    """The processor of this machine, by its name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def made_by() -> dict[str, str]:
    """By what shards are made here: versions and the processor."""
    return {**versions(), "python": platform.python_version(), "processor": processor()}


def maker(manifest: Mapping[str, Any]) -> dict[str, str]:
    """By what the dataset of a manifest was finished."""
    found: dict[str, str] = manifest["versions"] if "versions" in manifest else manifest["provenance"]
    return found


def words(made: Mapping[str, str]) -> str:
    """What `made_by` returns, or a part of it, in words."""
    return ", ".join(value if name == "processor" else f"{name} {value}" for name, value in made.items())


def other_bytes(place: object, there: Mapping[str, str] | None) -> SpadError:
    """The error where this machine makes other bytes than those at a place. there: by what they were made, if known."""
    return SpadError(
        f"{place}: this machine makes other bytes than are there, and a dataset holds no two kinds; here "
        f"{words(made_by())}; there {words(there) if there else 'unknown versions'}; install the versions of there, or "
        "make the dataset anew in another folder"
    )


# --- the shard ----------------------------------------------------------------------------------------------------


def has_golden(experiment: Experiment) -> bool:
    """Whether a config has a golden shard: not where the user's own code is run, for images that nobody asked for."""
    used = [*experiment.sensor.effects, *map(reconstruct.find, experiment.methods)]
    return experiment.sensor.block == 1 and not any(plugins.is_from_file(type(one)) for one in used)


def key(experiment: Experiment) -> str:
    """A digest of what the golden shard of a config is a function of: all of it but seed, light level and images."""
    resolved, maps = portable(experiment)
    scene = {name: value for name, value in resolved["scene"].items() if name not in ("images", "lux", "irradiance")}
    kept = {name: value for name, value in resolved.items() if name not in ("seed", "limit")}
    kept |= {"encoding": experiment.encoding.number} if experiment.encoding.number > 1 else {}
    of = {**kept, "scene": scene, "maps": {name: hashlib.sha256(data).hexdigest() for name, data in maps.items()}}
    return hashlib.sha256(manifest_file.canonical(of)).hexdigest()


def digest(experiment: Experiment) -> str:
    """The SHA-256 of the golden shard of a config.

    It is of 16 images of noise, which the config does not decide, by its sensor, readouts, methods and format. They are
    dimmed or brightened to half a million to a million detections, and fewer where they are large.
    """
    channels = (len(experiment.wavelengths),) if experiment.wavelengths else ()
    shape = (*channels, *experiment.sensor.layout.shape)
    experiment = replace(experiment, seed=0)
    # noise that no library draws
    noise = hashlib.shake_256(b"golden").digest(IMAGES * math.prod(shape))
    pixels = np.frombuffer(noise, np.uint8).reshape(IMAGES, *shape)
    events, _ = shard_plan.expected_per_image(experiment, _LIGHT, Images(pixels, None, 255.0))
    white = 255.0 * 2.0 ** math.frexp(events * IMAGES / _EVENTS)[1]  # a power of two: what is left of it is exact
    _, size = shard_plan.expected_per_image(experiment, _LIGHT, Images(pixels, None, white))
    pixels = pixels[: max(1, min(IMAGES, int(_BYTES / size)))]
    made = experiment.simulate_block(_LIGHT, "golden", pixels, white, 0)
    columns = shard_columns.recorded_columns(experiment, made, shape)
    if experiment.encoding.coordinates:
        columns |= shard_columns.coordinate_columns(columns, range(len(pixels)), np.arange(len(pixels), dtype=np.uint8))
    files = experiment.encoding.encoded("golden", columns, {})
    sums = hashlib.sha256()
    for name, pieces in sorted(files.items()):
        data = b"".join(pieces)
        sums.update(f"{name} {len(data)}\n".encode() + data)
    return sums.hexdigest()


# --- what is known of it ------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def known() -> dict[str, Any]:
    """`versions` of the libraries, and `digests`: of golden shards, by the key of their config."""
    found: dict[str, Any] = json.loads(KNOWN.read_text())
    return found


def check(experiment: Experiment) -> bool:
    """Is it known of this config, and not only of quick.yaml in its encoding, that the same bytes are made here?

    Raises SpadError where others are.
    """
    digests = known()["digests"]
    own = has_golden(experiment) and key(experiment) in digests
    tried = experiment if own else _shipped(experiment.encoding)
    if digest(tried) != digests[key(tried)]:
        what = f"{tried.name}: the golden shard of stream {STREAM}, encoding {tried.encoding.number}"
        raise other_bytes(what, known()["versions"])
    return own


def _shipped(encoding: store.Encoding) -> Experiment:
    return replace(config.read(config.shipped("quick.yaml"), format=encoding.format), encoding=encoding)


@lru_cache(maxsize=1)
def _quick() -> str:
    return digest(_shipped(store.encoding("zarr")))


def answer(about: object) -> tuple[str, str]:
    """(digest of the golden shard of the config that is shipped, by what it was made); see `Executor.greet`."""
    return _quick(), words(made_by())
