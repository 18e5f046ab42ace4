"""What lies at a path: a dataset, a measurement, a sensor file, a config, or a file of another program.

Messages say it where one of them stands in the place of another.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from . import document
from .errors import SpadError
from .foreign import quoted

MANIFEST = "manifest.json"  # in the folder of a dataset
MEASUREMENT = "measurement.yaml"  # in the folder of a measurement
DATASET_KIND, MEASUREMENT_KIND, SENSOR_KIND, CONFIG_KIND = "a dataset", "a measurement", "a sensor file", "a config"

_YAML = (".yaml", ".yml")


def described(raw: Any) -> str:
    """What the entries of a YAML file describe, in words: one of the kinds, or nothing."""
    if not isinstance(raw, Mapping):
        return ""
    if "captures" in raw or str(raw.get("format", "")).startswith("spadmnist-measurement"):
        return MEASUREMENT_KIND
    if "scene" in raw or "recording" in raw:
        return CONFIG_KIND
    return SENSOR_KIND if "sensor" in raw or "effects" in raw else ""


def at(path: Path) -> str:
    """What lies at a path, in words: one of the kinds, or nothing. A pipe is not read."""
    if path.is_dir():
        has = {MANIFEST: DATASET_KIND, MEASUREMENT: MEASUREMENT_KIND}
        return next((kind for name, kind in has.items() if (path / name).is_file()), "")
    with contextlib.suppress(SpadError):
        return described(document.read(path).value) if path.is_file() else ""
    return ""


def is_data(path: Path) -> bool:
    """Is it a file, and neither YAML by its name nor by what it says?"""
    return path.is_file() and path.suffix.lower() not in _YAML and not at(path)


def of_data(path: Path) -> str:
    """What to do with a file of data that was named where a measurement or a dataset is due."""
    folder = path.parent
    with contextlib.suppress(SpadError):
        plan = document.read(folder / MEASUREMENT).value
        captures = plan.get("captures") if isinstance(plan, Mapping) else None
        for capture in captures if isinstance(captures, list) else ():
            if isinstance(capture, Mapping) and capture.get("file") == path.name:
                return f"it is a file of the measurement {folder}: name the folder, {quoted(folder)}"
    return f"a file of another program becomes a measurement by:  spadmnist import {quoted(path)} -o lab"
