"""Named arrays with units and dimension names on disk, in Zarr v3 or HDF5. It knows nothing of photons.

A *shard* is a set of arrays that one task writes and owns: a Zarr group of its own, or one HDF5 file.

    out/data.zarr/<path>/...    format "zarr";  <path> is, for example, 5mlux/train/0000
    out/data/<path>.h5          format "hdf5"
    out/.spadmnist/tmp/         whatever is not complete yet

**Commit.** Everything is written under a name in `.spadmnist/tmp`, synchronised to the disk, and then appears
in its place by one rename. Whoever is killed, and whenever, leaves a whole shard or none.

**Integrity.** Every chunk carries a checksum that is compared when it is read, and every file's SHA-256 is
returned to the caller, who lists it. The bytes are a function of the content alone: no time, no thread count.

**Zarr by hand.** An array is one file in Zarr's sharding layout: compressed chunks along axis 0, then a table
of (offset, length) pairs with its CRC. zarr-python reads it, and so does every program that knows Zarr v3; it
is written and read here without zarr-python, which takes twice the time to write and several times the time
to read one image's part. The reader accepts exactly the layout that the writer makes and nothing else.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import json
import math
import os
import re
import stat
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import google_crc32c
import numcodecs.blosc
import numcodecs.zstd
import numpy as np
from numcodecs.fletcher32 import Fletcher32

from .disk import Files, commit_file, inside, install, put_tree, temporary, workspace, writing
from .errors import InputError
from .foreign import from_json, quoted
from .sources import File, Local, NotAFile, Reading, Source

# One task is one core; with threads of its own Blosc would use more of them without need.
numcodecs.blosc.use_threads = False

FORMATS = ("zarr", "hdf5")
ROWS_OF_TICKS = 1 << 16  # per chunk of a flat axis: 256 KiB of uint32, 0.1 ms to decode

_LARGEST_CHUNK = 1 << 28  # bytes; what one chunk may take in memory, when written and when read
_LARGEST_JSON = 1 << 20  # bytes
_TYPES = ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+ -]*(?<![. ])")

# How the chunks of an array are compressed (measured on 550 images at 2560 mlux: time to encode, size): the kind, its
# compressor, the level, and bytes of a block (0: as the library has it).
_CODECS: dict[str, tuple[str, str, int, int]] = {
    "ticks": ("blosc", "lz4", 5, 0),  # nearly random low bits: 2.5 GB/s, 6 % above the entropy
    "counts": ("blosc", "zstd", 1, 0),  # smaller than level 3 here, in half the time
    "bits": ("zstd", "", 1, 0),  # packed frames; a shuffle would make them larger
    "floats": ("zstd", "", 2, 0),  # few distinct values; a shuffle would hide that
    # in fewer bytes (640 images at 2560 mlux: size and time beside those of the fast ones)
    "ticks, small": ("blosc", "zstd", 1, 1 << 18),  # -2.1 %, 1.8 times; level 3 has 0.1 % less, in twice that time
    "bits, small": ("zstd", "", 9, 0),  # -2.2 %, 6 times; level 12 has 0.1 % less
    "floats, small": ("zstd", "", 5, 0),  # -9 %, 3 times
}
_CRC = {"name": "crc32c"}
_LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}

# HDF5's own attributes, and those that xarray takes for instructions.
_RESERVED = {"units", "long_name", "dimension_names", "CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST"}
_RESERVED |= {"_FillValue", "missing_value", "scale_factor", "add_offset", "calendar", "coordinates", "dtype"}
_TIME_WORDS = {"days", "hours", "minutes", "seconds", "milliseconds", "microseconds", "nanoseconds"}
_ONLY_A_DIMENSION = "This is a netCDF dimension but not a netCDF variable."


@dataclass(frozen=True, eq=False)
class Column:
    """One array of a shard."""

    data: np.ndarray
    dims: tuple[str, ...]  # one name per axis; one name has one size within a group
    unit: str  # "s", "10 ps", "1", "1/s": attribute `units`
    about: str  # what it is, in one line: attribute `long_name`
    codec: str  # "ticks", "counts", "bits" or "floats", or what `smaller` makes of it (HDF5 has one codec for all)
    rows_per_chunk: int | None = None  # along axis 0; None: all in one, as far as a chunk may be large
    attributes: Mapping[str, Any] = field(default_factory=dict)  # text, numbers, lists of them


def smaller(columns: Mapping[str, Column]) -> dict[str, Column]:
    """The columns in fewer bytes, which take longer to make."""
    small = {codec: name for codec in _CODECS if (name := f"{codec}, small") in _CODECS}
    return {name: replace(column, codec=small.get(column.codec, column.codec)) for name, column in columns.items()}


# --- where things are -----------------------------------------------------------------------------
def location(path: str, format: str) -> str:
    """Where a shard lies, relative to the root."""
    _check_format(format)
    for part in path.split("/"):
        _check_name(part, path)
    return f"data.zarr/{path}" if format == "zarr" else f"data/{path}.h5"


def exists(root: str | os.PathLike[str], path: str, format: str) -> bool:
    """Whether the shard is there. A shard that is there was written to its end."""
    try:
        mode = os.lstat(Path(root) / location(path, format)).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return False
    return stat.S_ISDIR(mode) if format == "zarr" else stat.S_ISREG(mode)


def _check_format(format: str) -> None:
    if format not in FORMATS:
        raise ValueError(f"{format!r} is not a format; choose one of {', '.join(FORMATS)}")


def is_name(name: str) -> bool:
    """May it name a folder, a file or an array of a store?"""
    return bool(_NAME.fullmatch(name)) and name != "zarr.json"


def _check_name(name: str, where: str) -> None:
    if not is_name(name):
        raise ValueError(
            f"{where!r}: {name!r} cannot be a name on disk; use letters, digits and _ . + - inside, "
            "beginning with a letter or a digit"
        )


# --- writing: the disk ----------------------------------------------------------------------------


# --- writing: shards ------------------------------------------------------------------------------
def write_shard(
    root: str | os.PathLike[str],
    path: str,
    columns: Mapping[str, Column],
    attributes: Mapping[str, Any],
    format: str,
) -> Files:
    """Write a shard and return size and SHA-256 of its files. A shard that is there already is replaced.

    A column's name may contain "/": `tr/ticks` is the array `ticks` in the group `tr`.
    """
    size = sum(np.asarray(column.data).nbytes for column in columns.values())
    return put_shard(root, path, encoded(path, columns, attributes, format), format, size)


def encoded(
    path: str, columns: Mapping[str, Column], attributes: Mapping[str, Any], format: str
) -> dict[str, Iterable[bytes]]:
    """The files of a shard as pieces of bytes, which are encoded as they are asked for; for `put_shard`."""
    checked = _check_columns(columns, path)
    own = _check_attributes(attributes, path)
    if format == "zarr":
        files: dict[str, Iterable[bytes]] = {"shard/zarr.json": [_group_json(own)]}
        return files | {f"shard/{name}": pieces for name, pieces in _zarr_files(checked).items()}
    return {"shard": [_hdf5_image(checked, own)]}


def put_shard(
    root: str | os.PathLike[str], path: str, files: Mapping[str, Iterable[bytes]], format: str, size: int
) -> Files:
    """Write the files of a shard; see `write_shard`. size: bytes, about."""
    root, relative = Path(root), location(path, format)
    with (
        writing(root / relative, size),
        workspace(inside(root, ".spadmnist/tmp/x").parent) as work,
    ):
        final = inside(root, relative)
        records = put_tree(work / "new", files)
        install(work / "new" / "shard", final, work / "old")
    return {relative + name.removeprefix("shard"): record for name, record in records.items()}


def encoded_size(columns: Mapping[str, Column], format: str) -> int:
    """How many bytes the arrays take on disk."""
    checked = _check_columns(columns, "estimate")
    if format == "zarr":
        return sum(len(piece) for pieces in _zarr_files(checked).values() for piece in pieces)
    return len(_hdf5_image(checked, {}))


def append_columns(root: str | os.PathLike[str], path: str, columns: Mapping[str, Column], format: str) -> Files:
    """Add arrays to a shard; the files that are new or changed.

    The shard is then, byte for byte, what `write_shard` makes of all columns at once. Arrays of the same name
    are replaced. With Zarr they appear one by one, each of them whole; with HDF5 all at once.
    """
    root, relative = Path(root), location(path, format)
    reader = ShardReader(root, path, format)
    if format == "hdf5":
        everything = {name: reader.column(name) for name in reader.names} | dict(columns)
        return write_shard(root, path, everything, reader.attributes, format)
    checked = _check_columns(columns, path)
    kept = {name: (reader.dims(name), reader.shape(name)) for name in reader.names if name not in checked}
    _check_tree({name: (column.dims, column.data.shape) for name, column in checked.items()} | kept, path)
    files = _zarr_files(checked)
    shard = inside(root, f"{relative}/zarr.json").parent
    # What is renamed: the array, or the highest group above it that is not there yet.
    units: dict[str, str] = {}
    for name in checked:
        parts = name.split("/")
        heads = ["/".join(parts[: i + 1]) for i in range(len(parts))]
        units[name] = next((head for head in heads if not (shard / head).is_dir()), name)
    pending = sorted(set(units.values()))
    records: Files = {}
    with (
        writing(root / relative, sum(column.data.nbytes for column in checked.values())),
        workspace(inside(root, ".spadmnist/tmp/x").parent) as work,
    ):
        for i, unit in enumerate(pending):
            mine = {f"unit{file.removeprefix(unit)}": files[file] for file in files if file.startswith(f"{unit}/")}
            written = put_tree(work / f"new{i}", mine)
            records |= {f"{relative}/{unit}{name.removeprefix('unit')}": r for name, r in written.items()}
        for i, unit in enumerate(pending):
            install(work / f"new{i}" / "unit", inside(root, f"{relative}/{unit}"), work / f"old{i}")
    return records


def write_groups(root: str | os.PathLike[str], groups: Mapping[str, Mapping[str, Any]], format: str) -> Files:
    """Write the Zarr groups above the shards: {"": attributes, "5mlux": ..., "5mlux/train": ...}.

    HDF5 has files and folders there, and nothing is written.
    """
    records: Files = {}
    for relative, data in group_files(groups, format).items():
        with writing(Path(root) / relative, len(data)):
            final = inside(Path(root), relative)
        records[relative] = commit_file(final, data, temporary(root))
    return records


def group_files(groups: Mapping[str, Mapping[str, Any]], format: str) -> dict[str, bytes]:
    """What `write_groups` writes: path relative to the root -> content."""
    _check_format(format)
    return {
        f"{location(path, format)}/zarr.json" if path else "data.zarr/zarr.json": _group_json(
            _check_attributes(attributes, path or "data.zarr")
        )
        for path, attributes in (groups.items() if format == "zarr" else ())
    }


def _check_columns(columns: Mapping[str, Column], path: str) -> dict[str, Column]:
    """The columns by name, little-endian and contiguous; ValueError where one cannot be stored."""
    checked = {}
    for name, column in sorted(columns.items()):
        where = f"{path}: column {name!r}"
        for part in name.split("/"):
            _check_name(part, name)
        data = np.asarray(column.data)
        if data.dtype.name not in _TYPES or data.ndim == 0:
            raise ValueError(
                f"{where} is {data.dtype} with {data.ndim} axes; allowed: {', '.join(_TYPES)}, with an axis"
            )
        if len(column.dims) != data.ndim or len(set(column.dims)) != data.ndim:
            raise ValueError(f"{where} has {data.ndim} axes but dims {column.dims}; give one name per axis")
        for dim in column.dims:
            _check_name(dim, f"{name}: dims")
        if column.codec not in _CODECS:
            raise ValueError(f"{where}: {column.codec!r} is not a codec; choose one of {', '.join(_CODECS)}")
        if not column.unit or column.unit in _TIME_WORDS or " since " in column.unit:
            raise ValueError(
                f"{where}: unit {column.unit!r} is empty or would be read as a calendar time; write a symbol "
                'such as "s", "10 ps" or "1"'
            )
        if not column.about:
            raise ValueError(f"{where} has no description; say in `about` what it is")
        if column.rows_per_chunk is not None and column.rows_per_chunk < 1:
            raise ValueError(f"{where}: rows_per_chunk is {column.rows_per_chunk}; it must be 1 or more, or None")
        reserved = sorted(_RESERVED & set(column.attributes))
        if reserved:
            raise ValueError(f"{where}: attribute {reserved[0]!r} has a meaning of its own; choose another name")
        checked[name] = Column(
            np.ascontiguousarray(data, data.dtype.newbyteorder("<")),
            column.dims,
            column.unit,
            column.about,
            column.codec,
            _rows(data.shape, data.itemsize, column.rows_per_chunk, where),
            {**_check_attributes(column.attributes, where), "units": column.unit, "long_name": column.about},
        )
    _check_tree({name: (column.dims, column.data.shape) for name, column in checked.items()}, path)
    return checked


def _check_tree(shapes: Mapping[str, tuple[tuple[str, ...], tuple[int, ...]]], path: str) -> None:
    """No array lies in an array; in a group a dimension has one size, and its name is no other array's."""
    for name in shapes:
        inner = next((other for other in shapes if other.startswith(f"{name}/")), None)
        if inner:
            raise ValueError(f"{path}: {name!r} is an array, so {inner!r} cannot lie in it; rename one of them")
    sizes: dict[tuple[str, str], tuple[int, str]] = {}
    for name, (dims, shape) in sorted(shapes.items()):
        for dim, size in zip(dims, shape, strict=True):
            known, first = sizes.setdefault((_group_of(name), dim), (size, name))
            if known != size:
                raise ValueError(
                    f"{path}: dimension {dim!r} has size {known} in {first!r} and {size} in {name!r}; within "
                    "a group one name has one size: rename one of them"
                )
    for name, (dims, _) in shapes.items():
        last = name.rpartition("/")[2]
        if (_group_of(name), last) in sizes and dims != (last,):
            raise ValueError(f"{path}: {name!r} has the name of a dimension but other axes {dims}; rename one of them")


def _group_of(name: str) -> str:
    return name.rpartition("/")[0]


def _check_attributes(attributes: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The attributes, sorted: text, finite numbers, and lists of one of these, which both formats keep."""

    def plain(value: Any) -> bool:
        if type(value) is int:
            return -(2**63) <= value < 2**63
        return (type(value) is str and "\0" not in value) or (type(value) is float and math.isfinite(value))

    for name, value in attributes.items():
        values = list(value) if isinstance(value, (list, tuple)) else [value]
        if not all(map(plain, values)) or len(set(map(type, values))) > 1:
            raise ValueError(
                f"{where}: attribute {name!r} is {value!r}; allowed are text, int, finite float, "
                "and lists of one of them"
            )
    return {name: list(v) if isinstance(v := attributes[name], tuple) else v for name in sorted(attributes)}


def _rows(shape: tuple[int, ...], itemsize: int, wanted: int | None, where: str) -> int:
    """Rows of a chunk: as wanted, but not more than there are (and 1 for an empty array)."""
    row = math.prod(max(size, 1) for size in shape[1:]) * itemsize
    if row > _LARGEST_CHUNK:
        raise ValueError(
            f"{where}: one row has {row} bytes, more than a chunk may have ({_LARGEST_CHUNK}); split the array"
        )
    return max(1, min(wanted or shape[0], shape[0], _LARGEST_CHUNK // row))


# --- Zarr -----------------------------------------------------------------------------------------
def _json(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, indent=2, allow_nan=False).encode()


def _group_document(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {"attributes": dict(sorted(attributes.items())), "zarr_format": 3, "node_type": "group"}


def _group_json(attributes: Mapping[str, Any]) -> bytes:
    return _json(_group_document(attributes))


def _array_document(
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    dims: tuple[str, ...],
    rows: int,
    codec: str,
    attributes: Mapping[str, Any],
) -> dict[str, Any]:
    """`zarr.json` of an array: one file that holds all chunks."""
    inner = [rows, *(max(size, 1) for size in shape[1:])]
    kind, name, level, block = _CODECS[codec]
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


def _chunk_file(shape: tuple[int, ...]) -> str:
    return "c" + ".0" * len(shape)


def _zarr_files(columns: Mapping[str, Column]) -> dict[str, Iterable[bytes]]:
    """Every file of checked columns, with the groups between, as pieces of bytes."""
    files: dict[str, Iterable[bytes]] = {}
    for name, column in columns.items():
        data, rows = column.data, column.rows_per_chunk or 1
        group = _group_of(name)
        while group:
            files[f"{group}/zarr.json"] = [_group_json({})]
            group = _group_of(group)
        document = _array_document(data.shape, data.dtype, column.dims, rows, column.codec, column.attributes)
        files[f"{name}/zarr.json"] = [_json(document)]
        if data.size:
            files[f"{name}/{_chunk_file(data.shape)}"] = _zarr_chunks(data, rows, column.codec)
    return files


def _zarr_chunks(data: np.ndarray, rows: int, codec: str) -> Iterator[bytes]:
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
        for piece in _encode(chunk, codec):
            yield piece
            offset += len(piece)
        table.append((begin, offset - begin))
    index = np.array(table, "<u8").tobytes()
    yield index
    yield _crc32c(index)


def _crc32c(data: bytes) -> bytes:
    return struct.pack("<I", google_crc32c.value(data))


def _encode(chunk: np.ndarray, codec: str) -> list[bytes]:
    kind, name, level, block = _CODECS[codec]
    if kind == "blosc":
        shuffle = numcodecs.blosc.BITSHUFFLE
        packed = numcodecs.blosc.compress(chunk, name.encode(), level, shuffle, block, chunk.itemsize)
        return [packed, _crc32c(packed)]
    return [numcodecs.zstd.compress(chunk, level, True)]


class _Damaged(Exception):
    """What is wrong with a chunk, in a few words."""


def _decode(raw: bytes, codec: str, into: np.ndarray) -> None:
    """Decode a chunk into a contiguous array of exactly its size.

    The sizes that the chunk declares are compared first: a hostile one cannot make more of itself than that.
    """
    if _CODECS[codec][0] == "blosc":
        packed = raw[:-4]
        if len(raw) < 20 or _crc32c(packed) != raw[-4:]:
            raise _Damaged("the checksum does not match")
        size, _, length = struct.unpack_from("<III", packed, 4)
        if (size, length) != (into.nbytes, len(packed)):
            raise _Damaged(f"a chunk declares {size} bytes where the array has {into.nbytes}")
        numcodecs.blosc.decompress(packed, into)
    else:
        size = _zstd_size(raw)
        if size != into.nbytes:
            raise _Damaged(f"a chunk declares {size} bytes where the array has {into.nbytes}")
        numcodecs.zstd.decompress(raw, into)


def _zstd_size(frame: bytes) -> int:
    """The size that a Zstandard frame declares (RFC 8878, 3.1.1.1); it must also carry a checksum."""
    if len(frame) < 9 or frame[:4] != b"\x28\xb5\x2f\xfd":
        raise _Damaged("a chunk is not a Zstandard frame")
    flags = frame[4]
    single, checksum, dictionary = flags & 0x20, flags & 0x04, flags & 0x03
    width = (1 if single else 0, 2, 4, 8)[flags >> 6]
    start = 5 if single else 6
    if not checksum or dictionary or not width or len(frame) < start + width:
        raise _Damaged("a chunk has no checksum or declares no size")
    return int.from_bytes(frame[start : start + width], "little") + (256 if width == 2 else 0)


# --- HDF5 -----------------------------------------------------------------------------------------
_HDF5_FILTERS = [2, 1, 3]  # shuffle, deflate, fletcher32
_SCALE_TYPE = np.dtype(">f4")  # of the data sets that only name a dimension; data are never big-endian here


def _hdf5_image(columns: Mapping[str, Column], attributes: Mapping[str, Any]) -> bytes:
    """A whole HDF5 file, made in memory: HDF5 itself never touches the disk (it crashes on a full one)."""
    import h5py

    with h5py.File(
        "shard.h5", "w", driver="core", backing_store=False, block_size=1 << 22, libver=("earliest", "v110")
    ) as file:
        _put_attributes(file, attributes)
        sets = {}
        for name in sorted(columns):
            column = columns[name]
            data = column.data
            filters: dict[str, Any] = {}
            if data.size:  # an empty data set has no chunks, and so no filters
                filters = {
                    "chunks": (column.rows_per_chunk, *data.shape[1:]),
                    "shuffle": True,
                    "fletcher32": True,
                }
                filters |= {"compression": "gzip", "compression_opts": 1}
            sets[name] = file.create_dataset(name, data=data, track_times=False, **filters)
            _put_attributes(sets[name], {**column.attributes, "dimension_names": list(column.dims)})
        # Dimension scales as netCDF-4 has them: a data set per dimension, empty where it is a name only.
        scales = {}
        for name in sorted(columns):
            group = _group_of(name)
            for dim, size in zip(columns[name].dims, columns[name].data.shape, strict=True):
                full = f"{group}/{dim}".lstrip("/")
                if full in scales:
                    continue
                if full in sets:
                    sets[full].make_scale(dim)
                    scales[full] = sets[full]
                else:
                    scales[full] = file.create_dataset(full, (size,), _SCALE_TYPE, track_times=False)
                    scales[full].make_scale(f"{_ONLY_A_DIMENSION}{size:10d}")
        for name in sorted(columns):
            if name in scales:
                continue
            for axis, dim in enumerate(columns[name].dims):
                sets[name].dims[axis].attach_scale(scales[f"{_group_of(name)}/{dim}".lstrip("/")])
        file.flush()
        return bytes(file.id.get_file_image())


def _put_attributes(node: Any, attributes: Mapping[str, Any]) -> None:
    """Text has a fixed length: what HDF5 keeps for text of any length makes it hang on some damaged files."""
    import h5py

    for name, value in sorted(attributes.items()):
        texts = [text.encode() for text in (value if isinstance(value, list) else [value]) if isinstance(text, str)]
        if texts:
            dtype = h5py.string_dtype("utf-8", max(1, *map(len, texts)))
            node.attrs.create(name, np.array(texts if isinstance(value, list) else texts[0], dtype), dtype=dtype)
        else:
            node.attrs[name] = value


def _decode_hdf5(raw: bytes, into: np.ndarray, itemsize: int) -> None:
    """Undo fletcher32, deflate and shuffle, without ever making more than the chunk's size of them."""
    if len(raw) < 8:
        raise _Damaged("a chunk is too short")
    try:
        deflated = bytes(Fletcher32().decode(raw))
    except (RuntimeError, ValueError):
        raise _Damaged("the checksum does not match") from None
    inflate = zlib.decompressobj()
    plain = inflate.decompress(deflated, into.nbytes)
    if len(plain) != into.nbytes or inflate.decompress(inflate.unconsumed_tail, 1) or not inflate.eof:
        raise _Damaged(f"a chunk does not have the {into.nbytes} bytes that the array has")
    into[:] = np.frombuffer(plain, np.uint8).reshape(itemsize, -1).T.reshape(-1)


# --- reading --------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Array:
    """What must be known of an array to read any part of it."""

    file: str  # that holds its chunks, relative to the root
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    dims: tuple[str, ...]
    rows: int  # per chunk
    codec: str
    attributes: dict[str, Any]  # with units and long_name
    places: list[tuple[int, int]]  # offset and length of each chunk in the file


@dataclass(frozen=True)
class Expected:
    """What is known of a shard before it is read. Another shard in its place is told by it.

    attributes: by array, those of the shard itself under ""; None stands for one that must not be there.
    sizes: of dimensions, by name. files: what is known of each file, or None where nothing is; one that is not listed
    does not belong there.
    """

    attributes: Mapping[str, Mapping[str, Any]]
    sizes: Mapping[str, int]
    files: Files | None = None


class ShardReader:
    """Reads arrays of a shard, or parts of them along axis 0.

    root: the dataset's folder, or the source that it is read from.
    expected: what is compared when the shard and its arrays are opened, once for each.
    It keeps descriptions, never an open file: it may be pickled, and used after a fork.
    """

    def __init__(self, root: str | os.PathLike[str] | Source, path: str, format: str, expected: Expected | None = None):
        self.root: Path | Source = root if isinstance(root, Source) else Path(root)
        self.path, self.format = path, format
        self._source = self.root if isinstance(self.root, Source) else Local(self.root)
        self._expected = expected
        self._place = location(path, format)
        self._arrays: dict[str, _Array] = {}
        self._attributes: dict[str, Any] | None = None
        self._names: tuple[str, ...] | None = None

    def __getstate__(self) -> tuple[Path | Source, str, str, Expected | None]:
        return self.root, self.path, self.format, self._expected

    def __setstate__(self, state: tuple[Path | Source, str, str, Expected | None]) -> None:
        self.__init__(*state)  # type: ignore[misc]

    @property
    def names(self) -> tuple[str, ...]:
        """The arrays, sorted."""
        if self._names is None:
            if self.format == "zarr":
                self._compare_shard()
                self._names = tuple(sorted(self._walk_zarr()))
            else:
                self._load_hdf5()
        return self._names or ()

    def has(self, name: str) -> bool:
        """Whether there is such an array. Raises InputError where it was written and is there no more."""
        there = name in self.names
        known = None if self._expected is None else self._expected.files
        if there or known is None:
            return there
        description = f"{self._place}/{name}/zarr.json"
        if self.format == "zarr" and description in known:
            raise self._refuse(description, "this file is missing")
        if self.format == "hdf5" and self._digest(self._place) != known[self._place]["sha256"]:
            raise self._refuse(self._place, f"there is no {name}, and this is not the file that was written")
        return False

    def _digest(self, file: str) -> str:
        with contextlib.closing(self._open(file)) as handle:
            return hashlib.file_digest(io.BufferedReader(Reading(handle)), "sha256").hexdigest()

    @property
    def attributes(self) -> dict[str, Any]:
        """The attributes of the shard."""
        if self._attributes is None:
            if self.format == "zarr":
                attributes = self._group_attributes()
                self._compare("", attributes)
                self._attributes = attributes
            else:
                self._load_hdf5()
        return dict(self._attributes or {})

    def shape(self, name: str) -> tuple[int, ...]:
        return self._array(name).shape

    def dtype(self, name: str) -> np.dtype[Any]:
        return self._array(name).dtype

    def dims(self, name: str) -> tuple[str, ...]:
        return self._array(name).dims

    def unit(self, name: str) -> str:
        return str(self._array(name).attributes["units"])

    def about(self, name: str) -> str:
        return str(self._array(name).attributes["long_name"])

    def array_attributes(self, name: str) -> dict[str, Any]:
        """The further attributes of an array."""
        attributes = self._array(name).attributes
        return {key: value for key, value in attributes.items() if key not in ("units", "long_name")}

    def column(self, name: str) -> Column:
        """A whole array, as it was written."""
        array = self._array(name)
        return Column(
            self.read(name),
            array.dims,
            self.unit(name),
            self.about(name),
            array.codec,
            array.rows,
            self.array_attributes(name),
        )

    def read(self, name: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows `start` to `stop` of an array. Only the chunks they lie in are read and decoded."""
        array = self._array(name)
        length, rows = array.shape[0], array.rows
        stop = length if stop is None else stop
        if not 0 <= start <= stop <= length:
            raise IndexError(f"{name}: rows {start} to {stop} were asked for; it has rows 0 to {length}")
        try:
            out = np.empty((stop - start, *array.shape[1:]), array.dtype)
            if not out.size:
                return out
            flat = out.reshape(-1).view(np.uint8)
            row = out.nbytes // len(out)
            handle = self._open(array.file)
            try:
                first, last = array.places[start // rows], array.places[-(-stop // rows) - 1]
                handle.expect(first[0], last[0] + last[1] - first[0])
                for i in range(start // rows, -(-stop // rows)):
                    low, high = max(start, i * rows), min(stop, (i + 1) * rows)
                    target = flat[(low - start) * row : (high - start) * row]
                    if high - low == rows:
                        self._chunk(handle, array, i, target)
                    else:
                        chunk = np.empty(rows * row, np.uint8)
                        self._chunk(handle, array, i, chunk)
                        target[:] = chunk[(low - i * rows) * row : (high - i * rows) * row]
            finally:
                handle.close()
        except MemoryError:
            raise InputError(
                f"{self.root / array.file}: rows {start} to {stop} of {name} need more memory than there is; "
                "read fewer at a time"
            ) from None
        except _Damaged as error:
            raise self._refuse(array.file, f"{name}: {error}") from None
        return out

    def _chunk(self, handle: File, array: _Array, i: int, into: np.ndarray) -> None:
        offset, length = array.places[i]
        try:
            raw = handle.read(offset, length)
            if len(raw) != length:
                raise _Damaged("the file ends too early")
            if self.format == "zarr":
                _decode(raw, array.codec, into)
            else:
                _decode_hdf5(raw, into, array.dtype.itemsize)
        except (RuntimeError, ValueError, OSError, zlib.error) as error:
            raise _Damaged(f"chunk {i} cannot be decoded ({error})") from None

    def _refuse(self, file: str, problem: str) -> InputError:
        mended = ", and with --repair it makes them again" if isinstance(self._source, Local) else ""
        return InputError(
            f"{self.root / file}: {problem}; the file was changed or damaged: `spadmnist verify "
            f"{quoted(str(self.root))}` names every such file{mended}"
        )

    # what is expected
    def _compare_shard(self) -> None:
        """The shard is the one that belongs here. Its attributes are read for that, once."""
        if self._expected is not None:
            _ = self.attributes

    def _compare(self, name: str, attributes: Mapping[str, Any], array: _Array | None = None) -> None:
        """Attributes and sizes of an array, or of the shard (""), are those that belong here."""
        if self._expected is None:
            return
        place = f"{self._place}/{name}".rstrip("/") if self.format == "zarr" else self._place
        what = f"{name}: its" if name and self.format == "hdf5" else "its"
        for key, value in self._expected.attributes.get(name, {}).items():
            found = attributes.get(key)
            if type(found) is not type(value) or found != value:
                raise self._refuse(place, f"{what} {key} is {_said(found)}, and {_said(value)} belongs here")
        for dim, size in zip(array.dims, array.shape, strict=True) if array is not None else ():
            wanted = self._expected.sizes.get(dim, size)
            if size != wanted:
                raise self._refuse(place, f"{what} size along {dim} is {size}, and {wanted} belongs here")

    def _array(self, name: str) -> _Array:
        if name not in self._arrays:
            try:
                if self.format == "hdf5":
                    self._load_hdf5()
                elif all(map(_NAME.fullmatch, name.split("/"))):
                    self._compare_shard()
                    self._arrays[name] = self._load_zarr(name)
            except _Missing:
                if name in self.names:
                    raise
            if name not in self._arrays:
                place, known = self.root / self._place, ", ".join(self.names)
                raise InputError(f"{place}: there is no array {name!r}; there are {known}")
        return self._arrays[name]

    # files
    def _open(self, file: str) -> File:
        """A file for reading, which has the size that is known of it."""
        try:
            handle = self._source.open(file)
        except OSError as error:
            raise self._why_not(file, error) from None
        try:
            self._compare_size(file, handle.size)
        except BaseException:
            handle.close()
            raise
        return handle

    def _why_not(self, file: str, error: OSError) -> Exception:
        """The error to raise, with a sentence; a symbolic link anywhere below the root is refused."""
        if isinstance(error, FileNotFoundError):
            return _Missing(self._refuse(file, "this file is missing"))
        if error.errno in (errno.ELOOP, errno.ENOTDIR):
            return self._refuse(file, "a symbolic link, or a file in place of a folder, is in the way")
        if isinstance(error, NotAFile) or error.errno == errno.ENXIO:
            return self._refuse(file, "this is not a file")
        return InputError(f"{self.root / file}: cannot be read: {error.strerror or error}")

    def _compare_size(self, file: str, size: int) -> None:
        if self._expected is not None and self._expected.files is not None:
            known = self._expected.files.get(file)
            if known is None:
                raise self._refuse(file, "this file does not belong here")
            if size != known["bytes"]:
                raise self._refuse(file, f"this file has {size} bytes, and it had {known['bytes']}")

    def _tail(self, file: str, size: int) -> tuple[bytes, int]:
        """The last `size` bytes of a file (fewer where it is smaller), and its length."""
        handle = self._open(file)
        try:
            return handle.read(max(0, handle.size - size), size), handle.size
        except OSError as error:
            raise self._why_not(file, error) from None
        finally:
            handle.close()

    # Zarr
    def _document(self, file: str) -> dict[str, Any]:
        text, length = self._tail(file, _LARGEST_JSON)
        try:
            if length > _LARGEST_JSON:
                raise ValueError("it is too large")
            document = from_json(text)
            if not isinstance(document, dict):
                raise ValueError("it is not a mapping")
        except ValueError as error:
            raise self._refuse(file, f"this is not a description of an array or group ({error})") from None
        known = None if self._expected is None else self._expected.files
        if known is not None and hashlib.sha256(text).hexdigest() != known[file]["sha256"]:
            raise self._refuse(file, "this description is not the one that was written")
        return document

    def _group_attributes(self) -> dict[str, Any]:
        file = f"{self._place}/zarr.json"
        document = self._document(file)
        attributes = document.get("attributes")
        if not isinstance(attributes, dict) or document != _group_document(attributes):
            raise self._refuse(file, "this is not a group as spadmnist writes it")
        return attributes

    def _walk_zarr(self, below: str = "", depth: int = 0) -> Iterator[str]:
        """The names of the arrays: folders with a `zarr.json` that hold no other folder."""
        place = f"{self._place}/{below}".rstrip("/")
        try:
            folders = self._source.folders(place)
        except OSError as error:
            raise self._why_not(place, error) from None
        if below and not folders:
            yield below
        for name in folders:
            if depth > 8:
                raise self._refuse(f"{self._place}/{below}", "the groups are nested too deeply")
            yield from self._walk_zarr(f"{below}/{name}".lstrip("/"), depth + 1)

    def _load_zarr(self, name: str) -> _Array:
        file = f"{self._place}/{name}/zarr.json"
        document = self._document(file)
        try:
            shape, dims = tuple(document["shape"]), tuple(document["dimension_names"])
            if document["data_type"] not in _TYPES or not shape:
                raise ValueError
            if not all(type(size) is int and 0 <= size < 2**62 for size in shape):
                raise ValueError
            if not all(type(dim) is str and _NAME.fullmatch(dim) for dim in dims) or len(dims) != len(shape):
                raise ValueError
            dtype = np.dtype(document["data_type"]).newbyteorder("<")
            attributes = document["attributes"]
            if not all(type(attributes[key]) is str for key in ("units", "long_name")):
                raise ValueError
            rows = document["codecs"][0]["configuration"]["chunk_shape"][0]
            if type(rows) is not int or rows != _rows(shape, dtype.itemsize, rows, name):
                raise ValueError
            codec = next(
                codec for codec in _CODECS if _array_document(shape, dtype, dims, rows, codec, attributes) == document
            )
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, StopIteration):
            raise self._refuse(file, "this is not an array as spadmnist writes it") from None
        file = f"{self._place}/{name}/{_chunk_file(shape)}"
        places = self._zarr_places(file, -(-shape[0] // rows)) if math.prod(shape) else []
        array = _Array(file, shape, dtype, dims, rows, codec, attributes, places)
        self._compare(name, attributes, array)
        return array

    def _zarr_places(self, file: str, count: int) -> list[tuple[int, int]]:
        """The table at the end of an array's file: the chunks must follow each other without a gap."""
        size = 16 * count + 4
        table, length = self._tail(file, size)
        if len(table) != size or _crc32c(table[:-4]) != table[-4:]:
            raise self._refuse(file, "its table of chunks is damaged")
        places = np.frombuffer(table[:-4], "<u8").reshape(count, 2)
        ends = np.cumsum(places[:, 1])
        if (places[:, 1] > length).any() or (places[:, 0] != ends - places[:, 1]).any() or ends[-1] != length - size:
            raise self._refuse(file, "its table of chunks does not fit the file")
        return [(int(offset), int(size)) for offset, size in places]

    # HDF5
    def _load_hdf5(self) -> None:
        """Read every description in the file, and where each chunk lies in it; HDF5 decodes no data."""
        import h5py

        handle = self._open(self._place)  # refuses links, and what would keep HDF5 waiting
        arrays: dict[str, _Array] = {}
        try:
            # of this machine by HDF5 itself, which is faster
            where = self.root / self._place if isinstance(self.root, Path) else Reading(handle)
            with h5py.File(where, "r", locking=False) as file:
                if file.userblock_size:
                    raise _Damaged("it does not begin at its beginning")
                attributes = _get_attributes(file)
                for name, dataset in _walk_hdf5(file, h5py):
                    arrays[name] = _hdf5_array(dataset, self._place)
        except _Damaged as error:
            raise self._refuse(self._place, str(error)) from None
        except (OSError, RuntimeError, KeyError, OverflowError, ValueError, TypeError, MemoryError) as error:
            raise self._refuse(self._place, f"HDF5 cannot read it ({error})") from None
        finally:
            handle.close()
        self._compare("", attributes)
        for name, array in arrays.items():
            self._compare(name, array.attributes, array)
        self._attributes, self._arrays, self._names = attributes, arrays, tuple(sorted(arrays))


def _said(value: Any) -> str:
    return "not said" if value is None else repr(value)


class _Missing(InputError):
    """A file of the shard is not there."""


def _walk_hdf5(group: Any, h5py: Any, depth: int = 0) -> Iterator[tuple[str, Any]]:
    """The arrays of a file. What leads out of it (or round in circles) is refused, link by link."""
    for name in group:
        where = f"{group.name}/{name}".lstrip("/")
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise _Damaged(f"{where} is a link to another place, and only plain data is read")
        node = group[name]
        if isinstance(node, h5py.Group):
            if depth > 8:
                raise _Damaged("the groups are nested too deeply")
            yield from _walk_hdf5(node, h5py, depth + 1)
        elif not isinstance(node, h5py.Dataset) or node.external or node.is_virtual:
            raise _Damaged(f"{where} takes its data from elsewhere, and only plain data is read")
        elif node.dtype != _SCALE_TYPE:
            yield where, node


def _hdf5_array(dataset: Any, file: str) -> _Array:
    """The description of one data set, which must be as `_hdf5_image` makes them."""
    where, shape, dtype = dataset.name.lstrip("/"), dataset.shape, dataset.dtype
    if dtype.name not in _TYPES or dtype.byteorder == ">" or not shape:
        raise _Damaged(f"{where} is {dtype} with {len(shape or ())} axes, which spadmnist does not write")
    attributes = _get_attributes(dataset)
    if not all(type(attributes.get(key)) is str for key in ("units", "long_name")):
        raise _Damaged(f"{where} has no units or no long_name")
    # The names are text of our own beside the scales: HDF5's library for these crashes on some damaged files.
    dims = tuple(attributes.pop("dimension_names", ()))
    if len(dims) != len(shape) or not all(type(dim) is str for dim in dims):
        raise _Damaged(f"{where} has no names for its dimensions")
    rows = _rows(shape, dtype.itemsize, dataset.chunks[0] if dataset.chunks else None, where)
    places: list[tuple[int, int]] = []
    if math.prod(shape):
        plist = dataset.id.get_create_plist()
        filters = [plist.get_filter(i)[0] for i in range(plist.get_nfilters())]
        if filters != _HDF5_FILTERS or dataset.chunks != (rows, *shape[1:]):
            raise _Damaged(f"{where} is not stored as spadmnist stores it (chunks {dataset.chunks}, filters {filters})")
        found: dict[int, tuple[int, int]] = {}

        def note(chunk: Any) -> None:
            if chunk.filter_mask:
                raise _Damaged(f"{where} has a chunk that skips its checksum")
            found[chunk.chunk_offset[0]] = (chunk.byte_offset, chunk.size)

        dataset.id.chunk_iter(note)
        starts = range(0, shape[0], rows)
        length = dataset.file.id.get_filesize()
        if len(found) != len(starts) or any(start not in found for start in starts):
            raise _Damaged(f"{where} lacks some of its chunks")
        places = [found[start] for start in starts]
        if any(offset < 0 or offset + size > length for offset, size in places):
            raise _Damaged(f"{where} has chunks outside the file")
    return _Array(file, shape, dtype, dims, rows, "bits", attributes, places)


def _get_attributes(node: Any) -> dict[str, Any]:
    """Attributes as plain values, without HDF5's own."""
    attributes = {}
    for name in sorted(node.attrs):
        if name in ("CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST"):
            continue
        dtype = node.attrs.get_id(name).dtype
        if dtype.kind not in "Sif":
            raise _Damaged(f"attribute {name} of {node.name} is {dtype}, not a number or text of fixed length")
        value = np.asarray(node.attrs[name])
        attributes[name] = (np.strings.decode(value, "utf-8") if dtype.kind == "S" else value).tolist()
    return attributes
