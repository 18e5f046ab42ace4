"""spadmnist: what a single-photon camera would have recorded.

Vocabulary, used everywhere in this package:

photon       light that arrives at a pixel's active area; flux: photons per second there
PDP          photon detection probability: the chance that a photon starts an avalanche
avalanche    what fires in a pixel: by a photon, in the dark (dark count rate, DCR), or as a late echo (afterpulse)
detection    an avalanche that is recorded; dead time: how long the pixel is blind after one
event        one entry of a stream
exposure     how long an image is recorded; frame: a slice of it, frame time: how long a frame looks
TR           every detection's time stamp; STR: the first one of each frame; QIS: one bit a frame
effect       one physical cause, in one file, at one stage of the line from photons to readouts
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

# imported when they are first used: `spadmnist --help` needs neither numpy nor numba
_PUBLIC = {
    "open": "dataset",
    "concatenate": "dataset",
    "Dataset": "dataset",
    "Part": "dataset",
    "open_measurement": "measurement",
    "Measurement": "measurement",
    "Events": "events",
    "Layout": "events",
    "Sensor": "sensor",
    "read_sensor": "config",
    "Effect": "effects",
    "Conditions": "effects",
    "parameter": "plugins",
    "Children": "events",
    "SpadError": "errors",
}

__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'spadmnist' has no attribute {name!r}")
    return getattr(import_module(f".{_PUBLIC[name]}", __name__), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
