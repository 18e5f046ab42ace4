"""The cache of replicates on disk: of a model as it is stated, and of its candidates where they are tried first.

A comparison of another measurement of the same plan then costs one reduction. A diagnosis of it costs its fits.

The name of an entry is a digest of everything that it is a function of: sensor, capture, light, seed, the program's
own sources and the user's plug-ins. An entry ends with the digest of its content. An entry that cannot be read, or is
damaged, is simulated again. Where there are too many, first looks are removed first, and the oldest first.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import time
from pathlib import Path
from typing import Any

import numpy as np

from .. import disk, plugins, system
from ..compiled import digest_of_sources
from ..foreign import from_json
from ..images import cache_folder
from ..recording import Capture
from ..sensor import Sensor
from . import own_code
from .capture_replicates import CaptureReplicates
from .reduction import own_statistics

SUFFIX = ".replicates"  # of the name of an entry's file
LOOKS = ".looks"  # the same of an entry that is a first look at a candidate
# bytes of all entries together, and their number: more are removed, and simulated anew. A plan of four captures with
# 1.5 million time stamps has some 200 entries, 120 MB together. Rules of thumb
_MOST_BYTES, _MOST_ENTRIES = 1 << 30, 4096
_LARGEST = 1 << 28  # bytes of one entry that is read or written, at most: a quarter of all; a rule of thumb
_SWEPT_AFTER = 1 << 27  # bytes that one process writes before it counts all entries: an eighth of all; a rule of thumb
_UNFINISHED = 86_400.0  # s: a file that a killed process left unfinished is removed after so long; a rule of thumb
_NUMBERS = re.compile(r"[<>|=][fiu][1248]")  # the types of arrays in an entry
_written = 0  # bytes that this process has written since it counted all entries


def entry_name(sensor: Sensor, capture: Capture, *more: Any) -> str | None:
    """The name of the cache entry of a capture under a model; None where it depends on code that no file holds.

    Args:
        more: numbers and words that the replicates depend on as well.
    """
    code = own_code.digested({cls for cls in [*map(type, sensor.effects), *own_statistics()] if plugins.is_own(cls)})
    if code is None:
        return None
    digest = hashlib.sha256(digest_of_sources().encode())
    for part in code:
        digest.update(b"%d " % len(part) + part)
    # of a part of a chip: the whole chip, whose other pixels may matter, and the part's place
    chip = sensor.chip or sensor
    places = None if chip.layout.positions is None else chip.layout.positions.tobytes()
    digest.update(repr((chip.layout, places, chip.rules, chip.chip_seed, sensor.window, capture, more)).encode())
    for effect in chip.effects:
        digest.update(effect.name.encode())
        for name in effect.parameters:
            digest.update(name.encode() + _bytes_of(getattr(effect, name)))
    return digest.hexdigest()[:32]


def _bytes_of(value: Any) -> bytes:
    """A parameter's value as bytes. The text of anything like an array leaves numbers out."""
    if not np.ndim(value):
        return repr(value).encode()
    array = np.ascontiguousarray(value)
    return repr((array.dtype.str, array.shape)).encode() + array.tobytes()


def recall(name: str | None, suffix: str = SUFFIX) -> CaptureReplicates | None:
    """The replicates of an entry; None where no such entry can be read."""
    if name is None:
        return None
    found = read_entry(nulls_folder(), name, suffix)
    if found is not None:
        with contextlib.suppress(OSError):
            os.utime(nulls_folder() / f"{name}{suffix}")
    return found


def keep(name: str | None, made: CaptureReplicates, suffix: str = SUFFIX) -> None:
    """Write an entry. An error of the disk is ignored: no result depends on it."""
    global _written
    if name is None:
        return
    with contextlib.suppress(OSError):  # what is not in the cache is simulated again
        nulls_folder().mkdir(parents=True, exist_ok=True)
        _written += write_entry(nulls_folder(), name, made, suffix)
    if _written > _SWEPT_AFTER:
        make_room()


def read_entry(folder: Path, name: str, suffix: str = SUFFIX) -> CaptureReplicates | None:
    """The replicates of an entry of a folder; None where it has none that is intact and has this name."""
    try:
        return unpacked(disk.read_file(folder / f"{name}{suffix}", _LARGEST), name)
    except OSError:
        return None


def write_entry(folder: Path, name: str, made: CaptureReplicates, suffix: str = SUFFIX) -> int:
    """Write an entry, there as a whole or not at all; its digest tells what a power cut left of it.

    Returns:
        Bytes; 0 of one that is too large, which is not written.
    Raises:
        OSError: where it cannot be written.
    """
    data = packed(made, name)
    if len(data) > _LARGEST:
        return 0
    part = folder / f".{name}.{os.getpid()}.part"  # of another process that writes the same entry it is another file
    try:
        flags = system.WRITE | os.O_CREAT | os.O_TRUNC | system.NO_LINK | system.NO_WAIT
        with open(os.open(part, flags, 0o666), "wb") as file:
            file.write(data)
        os.replace(part, folder / f"{name}{suffix}")
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise
    return len(data)


def packed(made: CaptureReplicates, name: str) -> bytes:
    """Replicates as the bytes of an entry: a line of JSON that says what follows, the arrays, and a digest of all."""
    arrays = {"numbers": made.numbers, "totals": made.totals}
    for statistic, (_, scale) in made.laws.items():
        arrays[f"values/{statistic}"] = _narrow(made.values[statistic])
        if scale is not None:
            arrays[f"scale/{statistic}"] = scale
    facts = {
        "name": name,
        "laws": {statistic: law for statistic, (law, _) in made.laws.items()},
        "arrays": {name: [x.dtype.str, list(x.shape)] for name, x in arrays.items()},
    }
    data = b"".join([json.dumps(facts).encode(), b"\n", *(np.ascontiguousarray(x).tobytes() for x in arrays.values())])
    return data + hashlib.sha256(data).digest()


def unpacked(data: bytes, name: str) -> CaptureReplicates | None:
    """The replicates that an entry's bytes hold; None where they are damaged, or those of an entry of another name."""
    try:
        head, rest = _intact(data)
        facts, arrays, at = from_json(head), {}, 0
        if facts["name"] != name:
            return None
        for key, (kind, shape) in facts["arrays"].items():
            if not _NUMBERS.fullmatch(kind):
                return None
            number = math.prod(shape)
            arrays[key] = np.frombuffer(rest, np.dtype(kind), number, at).reshape(shape).copy()
            at += arrays[key].nbytes
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
    """Remove what is over the most that is kept. An error of the disk is ignored: no result depends on it."""
    global _written
    _written = 0
    found: list[tuple[bool, float, int, str]] = []  # (first look, age, bytes, path)
    with contextlib.suppress(OSError), os.scandir(nulls_folder()) as entries:
        for entry in entries:
            with contextlib.suppress(OSError):
                facts = entry.stat(follow_symlinks=False)
                age = time.time() - facts.st_mtime
                if not entry.name.startswith("."):  # those of earlier programs, too
                    found.append((entry.name.endswith(LOOKS), age, facts.st_size, entry.path))
                elif entry.name.endswith(".part") and age > _UNFINISHED:
                    os.unlink(entry.path)
    total = 0
    for number, (_, _, size, path) in enumerate(sorted(found)):
        total += size
        if total > _MOST_BYTES or number >= _MOST_ENTRIES:
            with contextlib.suppress(OSError):
                os.unlink(path)


def nulls_folder() -> Path:
    """Where summaries of replicates are kept from one command to the next."""
    return cache_folder() / "nulls"
