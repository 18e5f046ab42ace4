"""The cache of replicates on disk: of a model as it is stated, and of its candidates where they are tried first.

Another measurement of the same plan then costs one reduction, and what its own search asks for.

The name of an entry is a digest of everything that it is a function of: sensor, capture, light, seed, the program's
own sources and the user's plug-ins. An entry ends with the digest of its content. An entry that cannot be read, or is
damaged, is simulated again. The oldest entries are removed when there are too many.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from .. import plugins
from ..compiled import digest_of_sources
from ..foreign import from_json
from ..images import cache_folder
from ..recording import Capture
from ..sensor import Sensor
from .capture_replicates import CaptureReplicates
from .reduction import own_statistics

SUFFIX = ".replicates"  # of the name of an entry's file
# bytes of all entries together, and their number: the oldest of more are removed, and simulated anew. Some 200 entries
# of 120 MB are those of four captures with 1.5 million time stamps. Rules of thumb
_MOST_BYTES, _MOST_ENTRIES = 1 << 30, 4096


def entry_name(sensor: Sensor, capture: Capture, *more: Any) -> str | None:
    """The name of the cache entry of a capture under a model; None where it depends on code that no file holds.

    Args:
        more: numbers and words that the replicates depend on as well.
    """
    own = {cls for cls in [*map(type, sensor.effects), *own_statistics()] if plugins.is_own(cls)}
    texts = [_text(plugins.source_file(cls)) for cls in sorted(own, key=lambda cls: cls.__module__)]
    # a notebook has no file; what a function makes depends on what it was called with
    if any(cls.__module__ == "__main__" or "<locals>" in cls.__qualname__ for cls in own) or None in texts:
        return None
    digest = hashlib.sha256(digest_of_sources().encode())
    for _, text in sorted(plugins.loaded_files().items()):
        digest.update(text.encode())
    digest.update("".join(filter(None, texts)).encode())
    # of a part of a chip: the whole chip, whose other pixels may matter, and the part's place
    chip = sensor.chip or sensor
    places = None if chip.layout.positions is None else chip.layout.positions.tobytes()
    digest.update(repr((chip.layout, places, chip.rules, chip.chip_seed, sensor.window, capture, more)).encode())
    for effect in chip.effects:
        digest.update(effect.name.encode())
        for name in effect.parameters:
            value = getattr(effect, name)
            digest.update(name.encode() + (value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()))
    return digest.hexdigest()[:32]


@functools.cache
def _text(file: str) -> str | None:
    """The text of a module, as it was when this process first needed it; None where it cannot be read."""
    try:
        return Path(file).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return None


def recall(name: str | None) -> CaptureReplicates | None:
    """The replicates of an entry; None where no such entry can be read."""
    if name is None:
        return None
    path = nulls_folder() / f"{name}{SUFFIX}"
    try:
        found = unpacked(path.read_bytes())
        os.utime(path)
    except OSError:
        return None
    return found


def keep(name: str | None, made: CaptureReplicates) -> None:
    """Write an entry; `make_room` is for the caller. An error of the disk is ignored: no result depends on it."""
    if name is None:
        return
    with contextlib.suppress(OSError):  # what is not in the cache is simulated again
        nulls_folder().mkdir(parents=True, exist_ok=True)
        write_entry(nulls_folder(), name, packed(made))


def write_entry(folder: Path, name: str, data: bytes) -> None:
    """Write an entry, there as a whole or not at all; its digest tells what a power cut left of it.

    Raises:
        OSError: where it cannot be written.
    """
    part = folder / f"{name}.{os.getpid()}.part"  # of another process that writes the same entry it is another file
    try:
        part.write_bytes(data)
        os.replace(part, folder / f"{name}{SUFFIX}")
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise


def packed(made: CaptureReplicates) -> bytes:
    """Replicates as the bytes of an entry: a line of JSON that says what follows, the arrays, and a digest of all."""
    arrays = {"numbers": made.numbers, "totals": made.totals}
    for statistic, (_, scale) in made.laws.items():
        arrays[f"values/{statistic}"] = _narrow(made.values[statistic])
        if scale is not None:
            arrays[f"scale/{statistic}"] = scale
    facts = {
        "laws": {statistic: law for statistic, (law, _) in made.laws.items()},
        "arrays": {name: [x.dtype.str, list(x.shape)] for name, x in arrays.items()},
    }
    data = b"".join([json.dumps(facts).encode(), b"\n", *(np.ascontiguousarray(x).tobytes() for x in arrays.values())])
    return data + hashlib.sha256(data).digest()


def unpacked(data: bytes) -> CaptureReplicates | None:
    """The replicates that an entry's bytes hold; None where they are damaged."""
    try:
        head, rest = _intact(data)
        facts, arrays, at = from_json(head), {}, 0
        for name, (kind, shape) in facts["arrays"].items():
            number = math.prod(shape)
            arrays[name] = np.frombuffer(rest, np.dtype(kind), number, at).reshape(shape).copy()
            at += arrays[name].nbytes
        laws = {statistic: (str(law), arrays.get(f"scale/{statistic}")) for statistic, law in facts["laws"].items()}
        values = {statistic: arrays[f"values/{statistic}"].astype(np.float64, copy=False) for statistic in laws}
        return CaptureReplicates(numbers=arrays["numbers"], totals=arrays["totals"], values=values, laws=laws)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError):
        return None


def _narrow(values: np.ndarray) -> np.ndarray:
    """The same numbers; whole ones as unsigned integers of as few bytes as hold them."""
    if values.size and float(values.min()) >= 0 and float(values.max()) < 2**32:
        whole = values.astype(np.min_scalar_type(int(values.max())))
        return whole if np.array_equal(whole, values) else values
    return values


def _intact(data: bytes) -> tuple[bytes, memoryview]:
    """(the line that says what follows, the arrays) of an entry.

    Raises:
        ValueError: where its digest is not that of its content.
    """
    size = hashlib.sha256().digest_size
    whole = memoryview(data)[:-size]
    if hashlib.sha256(whole).digest() != data[-size:]:
        raise ValueError("damaged")
    end = data.index(b"\n")
    return data[:end], whole[end + 1 :]


def make_room() -> None:
    """Remove the oldest entries beyond the most that are kept."""
    facts = {}
    for path in nulls_folder().glob("[!.]*"):  # those of earlier programs, too, and none that is being written
        with contextlib.suppress(FileNotFoundError):
            facts[path] = path.stat()
    total = 0
    for number, path in enumerate(sorted(facts, key=lambda path: facts[path].st_mtime, reverse=True)):
        total += facts[path].st_size
        if total > _MOST_BYTES or number >= _MOST_ENTRIES:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


def nulls_folder() -> Path:
    """Where summaries of replicates are kept from one command to the next."""
    return cache_folder() / "nulls"
