"""Zarr v3 by hand: what describes an array or a group, and how an array's chunks lie in its file.

An array is one file in Zarr's sharding layout: compressed chunks along axis 0, then a table of (offset, length) pairs
with its CRC. zarr-python reads it, and so does every program that knows Zarr v3; it is written and read here without
zarr-python, which takes twice the time to write and several times the time to read one image's part. The reader
accepts exactly the layout that the writer makes and nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from .chunks import CODECS, crc32c, decode, encode
from .columns import NAME, TYPES, Column, rows_of
from .shards import Array, ShardReader

_CRC = {"name": "crc32c"}
_LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}


class ZarrReader(ShardReader):
    """A reader of arrays whose chunks are compressed as Zarr says."""

    def _decode(self, raw: bytes, array: Array, into: np.ndarray) -> None:
        decode(raw, array.codec, into)


def group_document(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """`zarr.json` of a group."""
    return {"attributes": dict(sorted(attributes.items())), "zarr_format": 3, "node_type": "group"}


def array_document(
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    dims: tuple[str, ...],
    rows: int,
    codec: str,
    attributes: Mapping[str, Any],
) -> dict[str, Any]:
    """`zarr.json` of an array: one file that holds all chunks."""
    inner = [rows, *(max(size, 1) for size in shape[1:])]
    kind, name, level, block = CODECS[codec]
    if kind == "blosc":
        settings = {
            "typesize": dtype.itemsize,
            "cname": name,
            "clevel": level,
            "shuffle": "bitshuffle",
            "blocksize": block,
        }
        compression: list[dict[str, Any]] = [{"name": "blosc", "configuration": settings}, _CRC]
    else:
        compression = [{"name": "zstd", "configuration": {"level": level, "checksum": True}}]
    sharding = {
        "chunk_shape": inner,
        "codecs": [_LITTLE, *compression],
        "index_codecs": [_LITTLE, _CRC],
        "index_location": "end",
    }
    whole = [max(1, -(-shape[0] // rows)) * rows, *inner[1:]]
    return {
        "shape": list(shape),
        "data_type": dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": whole}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},
        "fill_value": 0.0 if dtype.kind == "f" else 0,
        "codecs": [{"name": "sharding_indexed", "configuration": sharding}],
        "attributes": dict(sorted(attributes.items())),
        "dimension_names": list(dims),
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }


def chunk_file(shape: tuple[int, ...]) -> str:
    """The name of the file of an array's chunks."""
    return "c" + ".0" * len(shape)


def document_of(column: Column) -> dict[str, Any]:
    """`array_document` of a checked column."""
    rows = column.rows_per_chunk or 1
    return array_document(column.data.shape, column.data.dtype, column.dims, rows, column.codec, column.attributes)


def groups_above(names: Iterable[str]) -> list[str]:
    """The groups that arrays of these names lie in, besides the shard itself; sorted."""
    return sorted({"/".join(parts[:i]) for name in names if (parts := name.split("/")) for i in range(1, len(parts))})


def chunked(data: np.ndarray, rows: int, codec: str) -> Iterator[bytes]:
    """The file of an array: its chunks one after the other, then the table of (offset, length) and its CRC.

    Every chunk is there, those of zeros as well, so that a missing one cannot pass for zeros. The last one is
    filled up with zeros, since all chunks have one size.
    """
    table, offset = [], 0
    for start in range(0, len(data), rows):
        chunk = data[start : start + rows]
        if len(chunk) < rows:
            chunk = np.concatenate([chunk, np.zeros((rows - len(chunk), *data.shape[1:]), data.dtype)])
        begin = offset
        for piece in encode(chunk, codec):
            yield piece
            offset += len(piece)
        table.append((begin, offset - begin))
    index = np.array(table, "<u8").tobytes()
    yield index
    yield crc32c(index)


def described(name: str, document: Mapping[str, Any], file: str) -> Array:
    """The array that a document describes, without its chunks. Raises ValueError where `array_document` makes none like
    it. file: that holds its chunks."""
    try:
        shape, dims = tuple(document["shape"]), tuple(document["dimension_names"])
        if document["data_type"] not in TYPES or not shape:
            raise ValueError
        if not all(type(size) is int and 0 <= size < 2**62 for size in shape):
            raise ValueError
        if not all(type(dim) is str and NAME.fullmatch(dim) for dim in dims) or len(dims) != len(shape):
            raise ValueError
        dtype = np.dtype(document["data_type"]).newbyteorder("<")
        attributes = document["attributes"]
        if not all(type(attributes[key]) is str for key in ("units", "long_name")):
            raise ValueError
        rows = document["codecs"][0]["configuration"]["chunk_shape"][0]
        if type(rows) is not int or rows != rows_of(shape, dtype.itemsize, rows, name):
            raise ValueError
        codec = next(
            codec for codec in CODECS if array_document(shape, dtype, dims, rows, codec, attributes) == document
        )
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, StopIteration):
        raise ValueError("this is not an array as spadmnist writes it") from None
    return Array(file, shape, dtype, dims, rows, codec, attributes, [])


def table_size(array: Array) -> int:
    """Bytes of the table at the end of an array's chunks; 0 where there are none."""
    return 16 * _chunks(array) + 4 if math.prod(array.shape) else 0


def _chunks(array: Array) -> int:
    return -(-array.shape[0] // array.rows)


def placed(array: Array, table: bytes, start: int, length: int) -> Array:
    """The array with the places of its chunks, which lie from `start` on and must follow each other without a gap.

    length: of chunks and table together. Raises ValueError.
    """
    if len(table) != table_size(array) or crc32c(table[:-4]) != table[-4:]:
        raise ValueError("its table of chunks is damaged")
    places = np.frombuffer(table[:-4], "<u8").reshape(-1, 2)
    ends = np.cumsum(places[:, 1])
    behind = length - len(table)
    if (places[:, 1] > length).any() or (places[:, 0] != ends - places[:, 1]).any() or ends[-1] != behind:
        raise ValueError("its table of chunks does not fit the file")
    return replace(array, places=[(start + int(offset), int(size)) for offset, size in places])
