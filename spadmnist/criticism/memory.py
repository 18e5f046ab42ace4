"""Nulls that were learnt before, on disk: another measurement of the same model then costs one reduction.

An entry is named by everything that it is a function of: sensor, capture, light, seed, the program's own source and the
user's plug-ins. An entry ends with the digest of all before it: what cannot be read, or is not what was written, is
learnt again. The oldest entries go when there are too many.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .. import disk, plugins
from ..compiled import digest_of_sources
from ..errors import SpadError
from ..foreign import from_json
from ..images import cache_folder
from ..recording import Capture
from ..sensor import Sensor
from .nulls import Null

_MOST_BYTES = 1 << 30  # of all entries together
_ARRAYS = ("coefficients", "inverse", "spread", "own")
_GROUPS = ("nulls", "apart")
_FACTS = ("law", "middle", "recordings", "factor", "tail", "scaled")


def name_of(sensor: Sensor, capture: Capture, *more: Any) -> str:
    """The name of the entry for a capture of a settled sensor; more: numbers and words that it depends on."""
    digest = hashlib.sha256(digest_of_sources().encode())
    for _, text in sorted(plugins.loaded_files().items()):
        digest.update(text.encode())
    # of a part of a chip the whole of it, whose other pixels may matter, and which part
    chip = sensor.chip or sensor
    places = None if chip.layout.positions is None else chip.layout.positions.tobytes()
    digest.update(repr((chip.layout, places, chip.rules, chip.chip_seed, sensor.window, capture, more)).encode())
    for effect in chip.effects:
        digest.update(effect.name.encode())
        for name in effect.parameters:
            value = getattr(effect, name)
            digest.update(name.encode() + (value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()))
    return digest.hexdigest()[:32]


def recall(name: str) -> tuple[dict[str, np.ndarray], dict[str, Null], dict[str, Null]] | None:
    """(further arrays, nulls by statistic, the same of cells `apart`), or None where no such entry can be read."""
    path = _folder() / f"{name}.npz"
    try:
        with np.load(_intact(path.read_bytes()), allow_pickle=False) as stored:
            arrays = {key: stored[key] for key in stored.files}
        facts = from_json(arrays.pop("facts").tobytes())
        nulls, apart = (
            {
                statistic: Null(**told, **{key: arrays.pop(f"{group}/{statistic}/{key}") for key in _ARRAYS})
                for statistic, told in facts[group].items()
            }
            for group in _GROUPS
        )
        os.utime(path)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None
    return arrays, nulls, apart


def keep(name: str, further: Mapping[str, np.ndarray], nulls: Mapping[str, Null], apart: Mapping[str, Null]) -> None:
    """Put an entry there. Where that is not possible nothing happens."""
    facts: dict[str, dict[str, Any]] = {}
    arrays: dict[str, np.ndarray] = {}
    for group, known in zip(_GROUPS, (nulls, apart), strict=True):
        facts[group] = {statistic: {key: getattr(null, key) for key in _FACTS} for statistic, null in known.items()}
        arrays |= {
            f"{group}/{statistic}/{key}": getattr(null, key) for statistic, null in known.items() for key in _ARRAYS
        }
    header = np.frombuffer(json.dumps(facts).encode(), np.uint8)
    folder = _folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        whole = io.BytesIO()
        np.savez(whole, allow_pickle=False, facts=header, **further, **arrays)
        entry = folder / f"{name}.npz"
        data = whole.getvalue()
        disk.put_file(entry, data + hashlib.sha256(data).digest())
        _make_room(folder)
    except (OSError, SpadError):  # what is not remembered is learnt again
        return


def _intact(data: bytes) -> io.BytesIO:
    """The archive of an entry. Raises ValueError where it is not what was written."""
    size = hashlib.sha256().digest_size
    if hashlib.sha256(data[:-size]).digest() != data[-size:]:
        raise ValueError("damaged")
    return io.BytesIO(data[:-size])


def _make_room(folder: Path) -> None:
    entries = sorted(folder.glob("*.npz"), key=lambda path: path.stat().st_mtime, reverse=True)
    total = 0
    for path in entries:
        total += path.stat().st_size
        if total > _MOST_BYTES:
            path.unlink(missing_ok=True)


def _folder() -> Path:
    return cache_folder() / "nulls"
