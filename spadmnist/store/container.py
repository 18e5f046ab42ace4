"""A shard as one zip, which holds a Zarr group: encoding 2 of format zarr.

    out/data/<path>.zarr.zip

`zarr.storage.ZipStore` opens it as it is. Members are stored: first the chunks of each array, then what describes the
arrays and groups, last the description of the shard. The last one holds all others (consolidated metadata). It comes
directly before the zip's directory, so that one read of the end of the file gives both.
"""

from __future__ import annotations

import contextlib
import json
import os
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from .. import archive
from ..archive import BadArchive
from ..disk import Files
from ..foreign import from_json
from ..sources import PIECE, File
from .columns import Column, check_columns, check_tree, group_of
from .shards import Array, Encoding
from .zarr import (
    ZarrReader,
    chunk_file,
    chunked,
    described,
    document_of,
    group_document,
    groups_above,
    placed,
    table_size,
)

_LARGEST_JSON = 1 << 22  # bytes of the description of a shard; 30 arrays take 30 kB
_END = 1 << 16  # bytes at the end of a shard that are asked for at once: directory and description of 40 arrays


@dataclass(frozen=True)
class _Part:
    """An array that is written: what describes it, its chunks (None: it has none), and is it a coordinate?"""

    document: dict[str, Any]
    chunks: Iterable[bytes] | None
    coordinate: bool


@dataclass(frozen=True)
class _Content:
    """What a shard says of itself: its attributes, documents of arrays, names of coordinates; and its members."""

    attributes: dict[str, Any]
    arrays: dict[str, dict[str, Any]]
    coordinates: frozenset[str]
    members: dict[str, zipfile.ZipInfo]


class _Reader(ZarrReader):
    _content: _Content | None = None

    def _opened(self) -> _Content:
        """What the shard says of itself, compared with what is expected."""
        if self._content is None:
            with self._reading() as handle:
                content = _content(handle)
            self._compare("", content.attributes)
            self._content = content
        return self._content

    @contextlib.contextmanager
    def _reading(self) -> Iterator[File]:
        """The shard's file. What is found wrong with it is refused by one sentence."""
        with contextlib.closing(self._open(self._place)) as handle:
            try:
                yield handle
            except BadArchive as error:
                raise self._refuse(self._place, f"it {error}") from None
            except ValueError as error:
                raise self._refuse(self._place, str(error)) from None
            except OSError as error:
                raise self._why_not(self._place, error) from None

    def _find_names(self) -> Iterable[str]:
        return self._opened().arrays

    def _find_attributes(self) -> dict[str, Any]:
        return self._opened().attributes

    def _find(self, name: str) -> Array | None:
        content = self._opened()
        if name not in content.arrays:
            return None
        with self._reading() as handle:
            try:
                array = described(name, content.arrays[name], self._place)
                if size := table_size(array):
                    info = content.members[f"{name}/{chunk_file(array.shape)}"]
                    start, length = archive.start(handle, info), info.file_size
                    table = handle.read(start + max(0, length - size), min(size, length))
                    array = placed(array, table, start, length)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
        array = replace(array, coordinate=name in content.coordinates)
        self._compare(name, array.attributes, array)
        return array

    def kinds(self, files: Files) -> dict[str, int]:
        found: dict[str, int] = {}
        for name, info in self._opened().members.items():
            kind = name.split("/")[0]
            found[kind] = found.get(kind, 0) + info.file_size
        rest = sum(int(facts["bytes"]) for facts in files.values()) - sum(found.values())
        return found | {"other": rest}  # what makes a zip of them

    def part(self, name: str) -> _Part:
        """An array as it lies there, to be written again. Its checksum is compared when its chunks are asked for."""
        content, array = self._opened(), self._array(name)
        info = content.members.get(f"{name}/{chunk_file(array.shape)}")
        return _Part(content.arrays[name], None if info is None else self._copied(info), array.coordinate)

    def _copied(self, info: zipfile.ZipInfo) -> Iterator[bytes]:
        with self._reading() as handle:
            start, crc = archive.start(handle, info), 0
            for offset in range(0, info.file_size, PIECE):
                piece = handle.read(start + offset, min(PIECE, info.file_size - offset))
                crc = zlib.crc32(piece, crc)
                yield piece
            if crc != info.CRC:
                raise ValueError(f"{info.filename} is damaged: its checksum does not match")


def _content(handle: File) -> _Content:
    """What a shard says of itself. Raises BadArchive or ValueError where it is not as it is written."""
    handle.expect(max(0, handle.size - _END), min(_END, handle.size))
    members = {info.filename: info for info in archive.members(handle)}
    for info in members.values():
        archive.check_member(info, compressed=False)
    top = members.get("zarr.json")
    if top is None or top.file_size > _LARGEST_JSON:
        raise ValueError("this is not a shard: there is no zarr.json in it, or a very large one")
    text = handle.read(archive.start(handle, top), top.file_size)
    if zlib.crc32(text) != top.CRC:
        raise ValueError("zarr.json is damaged: its checksum does not match")
    try:
        document = from_json(text)
        inner = document["consolidated_metadata"]["metadata"]
        arrays = {name: one for name, one in inner.items() if one["node_type"] == "array"}
        above = {"": document, **{name: inner[name] for name in groups_above(arrays)}}
        named = {group: one["attributes"].get("coordinates", "").split() for group, one in above.items()}
        coordinates = {f"{group}/{name}".lstrip("/") for group, names in named.items() for name in names}
        attributes = {key: value for key, value in document["attributes"].items() if key != "coordinates"}
        expected = {f"{name}/{chunk_file(one['shape'])}" for name, one in arrays.items() if 0 not in one["shape"]}
        documents = _documents(arrays, coordinates, attributes)
    except (KeyError, TypeError, AttributeError, ValueError):
        raise ValueError("zarr.json is not the description of a shard as spadmnist writes it") from None
    if documents[""] != document or expected | set(map(_described_in, documents)) != members.keys():
        raise ValueError("zarr.json does not describe what is there as spadmnist writes it")
    return _Content(attributes, arrays, frozenset(coordinates), members)


def _documents(
    arrays: Mapping[str, dict[str, Any]], coordinates: Iterable[str], attributes: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """What describes a shard, "", and each group and array in it, which the shard's own repeats."""
    of_group: dict[str, list[str]] = {}
    for name in sorted(coordinates):
        of_group.setdefault(group_of(name), []).append(name.rpartition("/")[2])
    said = {group: {"coordinates": " ".join(names)} for group, names in of_group.items()}
    groups = {group: group_document(said.get(group, {})) for group in groups_above(arrays)}
    inner = dict(sorted({**groups, **arrays}.items()))
    top = group_document({**attributes, **said.get("", {})})
    top["consolidated_metadata"] = {"kind": "inline", "must_understand": False, "metadata": inner}
    return {**inner, "": top}


def _described_in(name: str) -> str:
    return f"{name}/zarr.json".lstrip("/")


def _shard(parts: Mapping[str, _Part], attributes: Mapping[str, Any]) -> Iterator[bytes]:
    """The bytes of a shard."""
    parts = dict(sorted(parts.items()))
    files = {
        f"{name}/{chunk_file(part.document['shape'])}": part.chunks
        for name, part in parts.items()
        if part.chunks is not None
    }
    coordinates = [name for name, part in parts.items() if part.coordinate]
    documents = _documents({name: part.document for name, part in parts.items()}, coordinates, attributes)
    described = {_described_in(name): [_json(document)] for name, document in documents.items()}
    return archive.written({**files, **described})


def _json(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()


def _part(column: Column) -> _Part:
    """Of a checked column."""
    chunks = chunked(column.data, column.rows_per_chunk or 1, column.codec) if column.data.size else None
    return _Part(document_of(column), chunks, column.coordinate)


class Container(Encoding):
    """A Zarr group in a zip."""

    format, number, suffix, coordinates, reads = "zarr", 2, ".zarr.zip", True, _Reader

    def _files(self, columns: Mapping[str, Column], attributes: Mapping[str, Any]) -> dict[str, Iterable[bytes]]:
        return {"shard": _shard({name: _part(column) for name, column in columns.items()}, attributes)}

    def size(self, columns: Mapping[str, Column]) -> int:
        """Without what describes them, which does not grow with them."""
        parts = [_part(column) for column in check_columns(columns, "estimate").values()]
        return sum(len(piece) for part in parts for piece in part.chunks or ())

    def append(self, root: str | os.PathLike[str], path: str, columns: Mapping[str, Column]) -> Files:
        reader = self.reader(root, path)
        assert isinstance(reader, _Reader)
        checked = check_columns(columns, path)
        kept = [name for name in reader.names if name not in checked]
        shapes = {name: (reader.dims(name), reader.shape(name)) for name in kept}
        check_tree({name: (column.dims, column.data.shape) for name, column in checked.items()} | shapes, path)
        parts = {name: reader.part(name) for name in kept} | {name: _part(c) for name, c in checked.items()}
        size = sum(column.data.nbytes for column in checked.values())
        return self.put(root, path, {"shard": _shard(parts, reader.attributes)}, size)
