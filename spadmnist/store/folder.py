"""A shard as a folder, which is a Zarr group: encoding 1 of format zarr.

    out/data.zarr/<path>/zarr.json, <array>/zarr.json, <array>/c.0...

A new dataset is written as `container` has it; datasets of this encoding are read, repaired and gone on with for ever.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ..disk import Files, inside, install, put_tree, workspace, writing
from ..foreign import from_json
from .columns import Column, check_attributes, check_columns, check_tree
from .shards import Array, Encoding, Missing
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

_LARGEST_JSON = 1 << 20  # bytes


class _Reader(ZarrReader):
    def _find_names(self) -> Iterator[str]:
        self._compare_shard()
        return self._walk()

    def _compare_shard(self) -> None:
        """The shard is the one that belongs here. Its attributes are read for that, once."""
        if self._expected is not None:
            _ = self.attributes

    def _refuse_lost(self, name: str, known: Files) -> None:
        description = f"{self._place}/{name}/zarr.json"
        if description in known:
            raise self._refuse(description, "this file is missing")

    def _find_attributes(self) -> dict[str, Any]:
        file = f"{self._place}/zarr.json"
        document = self._document(file)
        attributes = document.get("attributes")
        if not isinstance(attributes, dict) or document != group_document(attributes):
            raise self._refuse(file, "this is not a group as spadmnist writes it")
        self._compare("", attributes)
        return attributes

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

    def _walk(self, below: str = "", depth: int = 0) -> Iterator[str]:
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
            yield from self._walk(f"{below}/{name}".lstrip("/"), depth + 1)

    def _find(self, name: str) -> Array | None:
        self._compare_shard()
        try:
            return self._load(name)
        except Missing:
            if name in self.names:
                raise
            return None

    def _load(self, name: str) -> Array:
        file = f"{self._place}/{name}/zarr.json"
        document = self._document(file)
        try:
            array = described(name, document, f"{self._place}/{name}/{chunk_file(document.get('shape') or ())}")
        except (TypeError, ValueError) as error:
            raise self._refuse(file, str(error)) from None
        if table_size(array):
            table, length = self._tail(array.file, table_size(array))
            try:
                array = placed(array, table, 0, length)
            except ValueError as error:
                raise self._refuse(array.file, str(error)) from None
        self._compare(name, array.attributes, array)
        return array

    def kinds(self, files: Files) -> dict[str, int]:
        found: dict[str, int] = {}
        for name, facts in files.items():
            kind = name[len(self._place) :].strip("/").split("/")[0]
            found[kind] = found.get(kind, 0) + int(facts["bytes"])
        return found


class Folder(Encoding):
    """A Zarr group: a folder of files."""

    format, number, folder, one_file, reads = "zarr", 1, "data.zarr", False, _Reader

    def _files(self, columns: Mapping[str, Column], attributes: Mapping[str, Any]) -> dict[str, Iterable[bytes]]:
        files: dict[str, Iterable[bytes]] = {"shard/zarr.json": [_group(attributes)]}
        return files | {f"shard/{name}": pieces for name, pieces in _arrays(columns).items()}

    def append(self, root: str | os.PathLike[str], path: str, columns: Mapping[str, Column]) -> Files:
        root, relative = Path(root), self.location(path)
        reader = self.reader(root, path)
        checked = check_columns(columns, path)
        kept = {name: (reader.dims(name), reader.shape(name)) for name in reader.names if name not in checked}
        check_tree({name: (column.dims, column.data.shape) for name, column in checked.items()} | kept, path)
        files = _arrays(checked)
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

    def groups(self, groups: Mapping[str, Mapping[str, Any]]) -> dict[str, bytes]:
        return {
            f"{self.location(path)}/zarr.json" if path else f"{self.folder}/zarr.json": _group(
                check_attributes(attributes, path or self.folder)
            )
            for path, attributes in groups.items()
        }


def _json(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, indent=2, allow_nan=False).encode()


def _group(attributes: Mapping[str, Any]) -> bytes:
    return _json(group_document(attributes))


def _arrays(columns: Mapping[str, Column]) -> dict[str, Iterable[bytes]]:
    """Every file of checked columns, with the groups between, as pieces of bytes."""
    files: dict[str, Iterable[bytes]] = {f"{group}/zarr.json": [_group({})] for group in groups_above(columns)}
    for name, column in columns.items():
        files[f"{name}/zarr.json"] = [_json(document_of(column))]
        if column.data.size:
            data, rows = column.data, column.rows_per_chunk or 1
            files[f"{name}/{chunk_file(data.shape)}"] = chunked(data, rows, column.codec)
    return files
