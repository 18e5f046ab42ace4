"""A shard as one HDF5 file, `data/<path>.h5`, with dimension scales as netCDF-4 has them.

HDF5 never touches the disk when a file is made: it crashes on a full one. Reading, it decodes no data: where a chunk
lies is asked of it, and the chunk is decoded here, with its checksum and never to more than its size.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numcodecs.fletcher32 import Fletcher32

from ..errors import SpadError
from ..sources import Reading
from .chunks import Damaged
from .columns import TYPES, Column, group_of, rows_of
from .shards import Array, Encoding, ShardReader

_ONLY_A_DIMENSION = "This is a netCDF dimension but not a netCDF variable."
_FILTERS = [2, 1, 3]  # shuffle, deflate, fletcher32
_SCALE_TYPE = np.dtype(">f4")  # of the data sets that only name a dimension; data are never big-endian here


def _image(columns: Mapping[str, Column], attributes: Mapping[str, Any]) -> bytes:
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
            group = group_of(name)
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
                sets[name].dims[axis].attach_scale(scales[f"{group_of(name)}/{dim}".lstrip("/")])
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


def _decode(raw: bytes, into: np.ndarray, itemsize: int) -> None:
    """Undo fletcher32, deflate and shuffle, without ever making more than the chunk's size of them."""
    if len(raw) < 8:
        raise Damaged("a chunk is too short")
    try:
        deflated = bytes(Fletcher32().decode(raw))
    except (RuntimeError, ValueError):
        raise Damaged("the checksum does not match") from None
    inflate = zlib.decompressobj()
    plain = inflate.decompress(deflated, into.nbytes)
    if len(plain) != into.nbytes or inflate.decompress(inflate.unconsumed_tail, 1) or not inflate.eof:
        raise Damaged(f"a chunk does not have the {into.nbytes} bytes that the array has")
    into[:] = np.frombuffer(plain, np.uint8).reshape(itemsize, -1).T.reshape(-1)


class _Reader(ShardReader):
    def _opened(self) -> None:
        """Read every description in the file, and where each chunk lies in it."""
        import h5py

        if self._attributes is not None:
            return
        handle = self._open(self._place)  # refuses links, and what would keep HDF5 waiting
        arrays: dict[str, Array] = {}
        try:
            # of this machine by HDF5 itself, which is faster
            where = self.root / self._place if isinstance(self.root, Path) else Reading(handle)
            with h5py.File(where, "r", locking=False) as file:
                if file.userblock_size:
                    raise Damaged("it does not begin at its beginning")
                attributes = _get_attributes(file)
                for name, dataset in _walk(file, h5py):
                    arrays[name] = _array(dataset, self._place)
        except Damaged as error:
            raise self._refuse(self._place, str(error)) from None
        except (OSError, RuntimeError, KeyError, OverflowError, ValueError, TypeError, MemoryError) as error:
            if "locking flag" in str(error):
                raise SpadError(
                    f"{self.root}: this program has {self._place} open already, and locked; close it there, or open it "
                    "by h5py.File(FILE, 'r', locking=False)"
                ) from None
            raise self._refuse(self._place, f"HDF5 cannot read it ({error})") from None
        finally:
            handle.close()
        self._compare("", attributes)
        for name, array in arrays.items():
            self._compare(name, array.attributes, array)
        self._arrays, self._attributes = arrays, attributes

    def _find_names(self) -> Iterable[str]:
        self._opened()
        return self._arrays

    def _find_attributes(self) -> dict[str, Any]:
        self._opened()
        return self._attributes or {}

    def _find(self, name: str) -> Array | None:
        self._opened()
        return self._arrays.get(name)

    def _decode(self, raw: bytes, array: Array, into: np.ndarray) -> None:
        _decode(raw, into, array.dtype.itemsize)


class Hdf5(Encoding):
    """An HDF5 file."""

    format, number, suffix, reads = "hdf5", 1, ".h5", _Reader

    def _files(self, columns: Mapping[str, Column], attributes: Mapping[str, Any]) -> dict[str, Iterable[bytes]]:
        return {"shard": [_image(columns, attributes)]}


def _walk(group: Any, h5py: Any, depth: int = 0) -> Iterator[tuple[str, Any]]:
    """The arrays of a file. What leads out of it (or round in circles) is refused, link by link."""
    for name in group:
        where = f"{group.name}/{name}".lstrip("/")
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise Damaged(f"{where} is a link to another place, and only plain data is read")
        node = group[name]
        if isinstance(node, h5py.Group):
            if depth > 8:
                raise Damaged("the groups are nested too deeply")
            yield from _walk(node, h5py, depth + 1)
        elif not isinstance(node, h5py.Dataset) or node.external or node.is_virtual:
            raise Damaged(f"{where} takes its data from elsewhere, and only plain data is read")
        elif node.dtype != _SCALE_TYPE:
            yield where, node


def _array(dataset: Any, file: str) -> Array:
    """The description of one data set, which must be as `_image` makes them."""
    where, shape, dtype = dataset.name.lstrip("/"), dataset.shape, dataset.dtype
    if dtype.name not in TYPES or dtype.byteorder == ">" or not shape:
        raise Damaged(f"{where} is {dtype} with {len(shape or ())} axes, which spadmnist does not write")
    attributes = _get_attributes(dataset)
    if not all(type(attributes.get(key)) is str for key in ("units", "long_name")):
        raise Damaged(f"{where} has no units or no long_name")
    # Read from an attribute, not from the dimension scales, whose library crashes on some damaged files
    dims = tuple(attributes.pop("dimension_names", ()))
    if len(dims) != len(shape) or not all(type(dim) is str for dim in dims):
        raise Damaged(f"{where} has no names for its dimensions")
    rows = rows_of(shape, dtype.itemsize, dataset.chunks[0] if dataset.chunks else None, where)
    places: list[tuple[int, int]] = []
    if math.prod(shape):
        plist = dataset.id.get_create_plist()
        filters = [plist.get_filter(i)[0] for i in range(plist.get_nfilters())]
        if filters != _FILTERS or dataset.chunks != (rows, *shape[1:]):
            raise Damaged(f"{where} is not stored as spadmnist stores it (chunks {dataset.chunks}, filters {filters})")
        found: dict[int, tuple[int, int]] = {}

        def note(chunk: Any) -> None:
            if chunk.filter_mask:
                raise Damaged(f"{where} has a chunk that skips its checksum")
            found[chunk.chunk_offset[0]] = (chunk.byte_offset, chunk.size)

        dataset.id.chunk_iter(note)
        starts = range(0, shape[0], rows)
        length = dataset.file.id.get_filesize()
        if len(found) != len(starts) or any(start not in found for start in starts):
            raise Damaged(f"{where} lacks some of its chunks")
        places = [found[start] for start in starts]
        if any(offset < 0 or offset + size > length for offset, size in places):
            raise Damaged(f"{where} has chunks outside the file")
    return Array(file, shape, dtype, dims, rows, "bits", attributes, places)


def _get_attributes(node: Any) -> dict[str, Any]:
    """Attributes as plain values, without HDF5's own."""
    attributes = {}
    for name in sorted(node.attrs):
        if name in ("CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST"):
            continue
        dtype = node.attrs.get_id(name).dtype
        if dtype.kind not in "Sif":
            raise Damaged(f"attribute {name} of {node.name} is {dtype}, not a number or text of fixed length")
        value = np.asarray(node.attrs[name])
        attributes[name] = (np.strings.decode(value, "utf-8") if dtype.kind == "S" else value).tolist()
    return attributes
