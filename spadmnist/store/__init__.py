"""Named arrays with units and dimension names on disk, in Zarr v3 or HDF5. It knows nothing of photons.

A *shard* is a set of arrays that one task writes and owns. How it is written is an `Encoding`, one a module, found by
being there:

    container   out/data/<path>.zarr.zip     zarr/2: a Zarr group in one zip;  <path> is, for example, 5mlux/train/0000
    folder      out/data.zarr/<path>/...     zarr/1: a Zarr group, a folder of files; what there is of it stays so
    hdf5        out/data/<path>.h5           hdf5/1: one HDF5 file
                out/.spadmnist/tmp/          whatever is not complete yet

**Commit.** Everything is written under a name in `.spadmnist/tmp`, synchronised to the disk, and then appears
in its place by one rename. Whoever is killed, and whenever, leaves a whole shard or none.

**Integrity.** Every chunk carries a checksum that is compared when it is read, and every file's SHA-256 is
returned to the caller, who lists it. The bytes are a function of the content alone: no time, no thread count.
"""

from __future__ import annotations

from ..errors import InputError
from . import container, folder, hdf5
from .columns import ROWS_OF_TICKS, Column, is_name, smaller
from .shards import Encoding, Expected, ShardReader, read_joined

FORMATS = tuple(dict.fromkeys(one.format for one in Encoding.every.values()))


def encodings(format: str) -> list[Encoding]:
    """Those of a format, the newest first."""
    found = [one for one in Encoding.every.values() if one.format == format]
    return sorted(found, key=lambda one: -one.number)


def encoding(format: str, number: int | None = None) -> Encoding:
    """The encoding of a format by its number; without one the newest, which new datasets have.

    Raises InputError where there is none.
    """
    known = encodings(format)
    for one in known:
        if number in (None, one.number):
            return one
    if not known:
        raise InputError(f"{format!r} is not a format; choose one of {', '.join(FORMATS)}")
    numbers = ", ".join(str(one.number) for one in reversed(known))
    raise InputError(
        f"encoding {number} of format {format} is not known; this program knows {numbers}: install a newer spadmnist"
    )


__all__ = [
    "FORMATS",
    "ROWS_OF_TICKS",
    "Column",
    "Encoding",
    "Expected",
    "ShardReader",
    "container",
    "encoding",
    "encodings",
    "folder",
    "hdf5",
    "is_name",
    "read_joined",
    "smaller",
]
