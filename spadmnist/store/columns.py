"""The arrays of a shard: what they say of themselves, and what of that can be stored."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from .chunks import CODECS

ROWS_OF_TICKS = 1 << 16  # per chunk of a flat axis: 256 KiB of uint32, 0.1 ms to decode
LARGEST_CHUNK = 1 << 28  # bytes; what one chunk may take in memory, when written and when read
TYPES = ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64")
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+ -]*(?<![. ])")

# HDF5's own attributes, and those that xarray takes for instructions.
_RESERVED = {"units", "long_name", "dimension_names", "CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST"}
_RESERVED |= {"_FillValue", "missing_value", "scale_factor", "add_offset", "calendar", "coordinates", "dtype"}
_TIME_WORDS = {"days", "hours", "minutes", "seconds", "milliseconds", "microseconds", "nanoseconds"}


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
    coordinate: bool = False  # xarray takes it for a coordinate of its group, where the encoding says so


def smaller(columns: Mapping[str, Column]) -> dict[str, Column]:
    """The columns in fewer bytes, which take longer to make."""
    small = {codec: name for codec in CODECS if (name := f"{codec}, small") in CODECS}
    return {name: replace(column, codec=small.get(column.codec, column.codec)) for name, column in columns.items()}


def is_name(name: str) -> bool:
    """May it name a folder, a file or an array of a store?"""
    return bool(NAME.fullmatch(name)) and name != "zarr.json"


def check_name(name: str, where: str) -> None:
    """Raise ValueError where `is_name` says no."""
    if not is_name(name):
        raise ValueError(
            f"{where!r}: {name!r} cannot be a name on disk; use letters, digits and _ . + - inside, "
            "beginning with a letter or a digit"
        )


def check_columns(columns: Mapping[str, Column], path: str) -> dict[str, Column]:
    """The columns by name, little-endian and contiguous; ValueError where one cannot be stored."""
    checked = {}
    for name, column in sorted(columns.items()):
        where = f"{path}: column {name!r}"
        for part in name.split("/"):
            check_name(part, name)
        data = np.asarray(column.data)
        if data.dtype.name not in TYPES or data.ndim == 0:
            raise ValueError(
                f"{where} is {data.dtype} with {data.ndim} axes; allowed: {', '.join(TYPES)}, with an axis"
            )
        if len(column.dims) != data.ndim or len(set(column.dims)) != data.ndim:
            raise ValueError(f"{where} has {data.ndim} axes but dims {column.dims}; give one name per axis")
        for dim in column.dims:
            check_name(dim, f"{name}: dims")
        if column.codec not in CODECS:
            raise ValueError(f"{where}: {column.codec!r} is not a codec; choose one of {', '.join(CODECS)}")
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
            rows_of(data.shape, data.itemsize, column.rows_per_chunk, where),
            {**check_attributes(column.attributes, where), "units": column.unit, "long_name": column.about},
            column.coordinate,
        )
    check_tree({name: (column.dims, column.data.shape) for name, column in checked.items()}, path)
    return checked


def check_tree(shapes: Mapping[str, tuple[tuple[str, ...], tuple[int, ...]]], path: str) -> None:
    """No array lies in an array; in a group a dimension has one size, and its name is no other array's."""
    for name in shapes:
        inner = next((other for other in shapes if other.startswith(f"{name}/")), None)
        if inner:
            raise ValueError(f"{path}: {name!r} is an array, so {inner!r} cannot lie in it; rename one of them")
    sizes: dict[tuple[str, str], tuple[int, str]] = {}
    for name, (dims, shape) in sorted(shapes.items()):
        for dim, size in zip(dims, shape, strict=True):
            known, first = sizes.setdefault((group_of(name), dim), (size, name))
            if known != size:
                raise ValueError(
                    f"{path}: dimension {dim!r} has size {known} in {first!r} and {size} in {name!r}; within "
                    "a group one name has one size: rename one of them"
                )
    for name, (dims, _) in shapes.items():
        last = name.rpartition("/")[2]
        if (group_of(name), last) in sizes and dims != (last,):
            raise ValueError(f"{path}: {name!r} has the name of a dimension but other axes {dims}; rename one of them")


def group_of(name: str) -> str:
    """The group that an array lies in; "" is the shard."""
    return name.rpartition("/")[0]


def check_attributes(attributes: Mapping[str, Any], where: str) -> dict[str, Any]:
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


def rows_of(shape: tuple[int, ...], itemsize: int, wanted: int | None, where: str) -> int:
    """Rows of a chunk: as wanted, but not more than there are (and 1 for an empty array)."""
    row = math.prod(max(size, 1) for size in shape[1:]) * itemsize
    if row > LARGEST_CHUNK:
        raise ValueError(
            f"{where}: one row has {row} bytes, more than a chunk may have ({LARGEST_CHUNK}); split the array"
        )
    return max(1, min(wanted or shape[0], shape[0], LARGEST_CHUNK // row))
