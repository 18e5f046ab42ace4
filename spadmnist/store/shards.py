"""What all encodings of a shard have in common: it is written as a whole or not at all, and read by its chunks."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import itertools
import os
import stat
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from .. import system
from ..disk import Files, commit_file, inside, install, put_tree, temporary, workspace, writing
from ..errors import InputError
from ..foreign import quoted
from ..sources import File, Local, NotAFile, Reading, Source
from . import recent
from .chunks import Damaged
from .columns import NAME, Column, check_attributes, check_columns, check_name


class Encoding(ABC):
    """How shards are written: a format and the number of its bytes. A subclass is found by being defined.

    format, number: by which a dataset says how it was written. one_file: is a shard one file? coordinates: does each
    group of a shard hold the numbers and labels of its images? suffix: of a shard's place.
    """

    every: ClassVar[dict[str, Encoding]] = {}
    format: ClassVar[str]
    number: ClassVar[int]
    folder: ClassVar[str] = "data"
    suffix: ClassVar[str] = ""
    one_file: ClassVar[bool] = True
    coordinates: ClassVar[bool] = False
    reads: ClassVar[type[ShardReader]]

    def __init_subclass__(cls) -> None:
        made = cls()
        Encoding.every[str(made)] = made

    def __str__(self) -> str:
        return f"{self.format}/{self.number}"

    def __reduce__(self) -> tuple[Any, ...]:
        return _named, (str(self),)

    # --- where shards lie ---------------------------------------------------------------------------------------------

    def location(self, path: str) -> str:
        """Where a shard lies, relative to the root."""
        for part in path.split("/"):
            check_name(part, path)
        return f"{self.folder}/{path}{self.suffix}"

    def exists(self, root: str | os.PathLike[str], path: str) -> bool:
        """Whether the shard is there. A shard that is there was written to its end."""
        try:
            mode = os.lstat(os.path.join(root, self.location(path))).st_mode
        except (FileNotFoundError, NotADirectoryError):
            return False
        return stat.S_ISREG(mode) if self.one_file else stat.S_ISDIR(mode)

    def are_files_of(self, path: str, files: Any) -> bool:
        """Is this what `write` returns for a shard: its own files alone, the one that tells it there is among them?"""
        place = self.location(path)
        first = place if self.one_file else f"{place}/zarr.json"
        return (
            isinstance(files, dict)
            and first in files
            and all(name == first or (name.startswith(f"{place}/") and not self.one_file) for name in files)
            and all(isinstance(one, dict) and set(one) == {"bytes", "sha256"} for one in files.values())
            and all(type(one["bytes"]) is int and type(one["sha256"]) is str for one in files.values())
        )

    def count(self, root: str | os.PathLike[str]) -> int:
        """How many shards of a dataset lie there, as it seems."""
        folders = Path(root).glob(f"{self.folder}/*/*/*{self.suffix}")
        return sum(path.is_file() == self.one_file for path in folders)

    # --- writing ------------------------------------------------------------------------------------------------------

    @abstractmethod
    def _files(self, columns: Mapping[str, Column], attributes: Mapping[str, Any]) -> dict[str, Iterable[bytes]]:
        """The files of a shard, as `encoded` gives them, of columns and attributes that were checked."""

    def encoded(
        self, path: str, columns: Mapping[str, Column], attributes: Mapping[str, Any]
    ) -> dict[str, Iterable[bytes]]:
        """The files of a shard as pieces of bytes, which are encoded as they are asked for; for `put`."""
        return self._files(check_columns(columns, path), check_attributes(attributes, path))

    def size(self, columns: Mapping[str, Column]) -> int:
        """How many bytes the arrays take on disk."""
        files = self._files(check_columns(columns, "estimate"), {})
        return sum(len(piece) for pieces in files.values() for piece in pieces)

    def put(self, root: str | os.PathLike[str], path: str, files: Mapping[str, Iterable[bytes]], size: int) -> Files:
        """Write the files of a shard; see `write`. size: bytes, about."""
        root, relative = Path(root), self.location(path)
        with (
            writing(root / relative, size),
            workspace(inside(root, ".spadmnist/tmp/x").parent) as work,
        ):
            final = inside(root, relative)
            records = put_tree(work / "new", files)
            install(work / "new" / "shard", final, work / "old")
        return {relative + name.removeprefix("shard"): record for name, record in records.items()}

    def write(
        self,
        root: str | os.PathLike[str],
        path: str,
        columns: Mapping[str, Column],
        attributes: Mapping[str, Any],
    ) -> Files:
        """Write a shard and return size and SHA-256 of its files. A shard that is there already is replaced.

        A column's name may contain "/": `tr/ticks` is the array `ticks` in the group `tr`.
        """
        size = sum(np.asarray(column.data).nbytes for column in columns.values())
        return self.put(root, path, self.encoded(path, columns, attributes), size)

    def append(self, root: str | os.PathLike[str], path: str, columns: Mapping[str, Column]) -> Files:
        """Add arrays to a shard; the files that are new or changed.

        The shard is then, byte for byte, what `write` makes of all columns at once. Arrays of the same name are
        replaced. Where a shard is one file, they appear all at once, else one by one, each of them whole.
        """
        reader = self.reader(root, path)
        everything = {name: reader.column(name) for name in reader.names} | dict(columns)
        return self.write(root, path, everything, reader.attributes)

    def groups(self, groups: Mapping[str, Mapping[str, Any]]) -> dict[str, bytes]:
        """The files of the groups above the shards, relative to the root, where there are any.

        groups: {"": attributes, "5mlux": ..., "5mlux/train": ...}.
        """
        return {}

    def write_groups(self, root: str | os.PathLike[str], groups: Mapping[str, Mapping[str, Any]]) -> Files:
        """Write what `groups` gives."""
        records: Files = {}
        for relative, data in self.groups(groups).items():
            with writing(Path(root) / relative, len(data)):
                final = inside(Path(root), relative)
            records[relative] = commit_file(final, data, temporary(root))
        return records

    # --- reading ------------------------------------------------------------------------------------------------------

    def reader(self, root: str | os.PathLike[str] | Source, path: str, expected: Expected | None = None) -> ShardReader:
        """Reads a shard of the dataset at `root`, a folder or the source that it is read from; see `ShardReader`."""
        return self.reads(self, root if isinstance(root, Source) else Path(root), path, expected)


def _named(name: str) -> Encoding:
    return Encoding.every[name]


@dataclass(frozen=True, eq=False)
class Array:
    """What must be known of an array to read any part of it."""

    file: str  # that holds its chunks, relative to the root
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    dims: tuple[str, ...]
    rows: int  # per chunk
    codec: str
    attributes: dict[str, Any]  # with units and long_name
    places: list[tuple[int, int]]  # offset and length of each chunk in the file
    coordinate: bool = False


@dataclass(frozen=True)
class Expected:
    """What is known of a shard before it is read. It shows that another shard lies in its place.

    attributes: by array, those of the shard itself under ""; None stands for one that must not be there.
    sizes: of dimensions, by name. files: what is known of each file, or None where nothing is; one that is not listed
    does not belong there. growing: a file below the root, by its name: as long as it is there, arrays are added to the
    shard's files, which may then have other sizes; "" for files that nothing is added to.
    """

    attributes: Mapping[str, Mapping[str, Any]]
    sizes: Mapping[str, int]
    files: Files | None = None
    growing: str = ""


_numbers = itertools.count()  # of the readers of this process
_MANY = 8 << 20  # bytes of an array from which on threads decode it; estimated: less takes one core 15 ms at most
_THREADS = 4  # threads that decode at most; not measured beyond two processors


class Missing(InputError):
    """A file of the shard is not there."""


class ShardReader(ABC):
    """Reads arrays of a shard, or parts of them along axis 0.

    expected: what is compared when the shard and its arrays are opened, once for each.
    It keeps descriptions and what `kept` is asked for, never an open file: it may be pickled, and used after a fork.
    """

    def __init__(self, encoding: Encoding, root: Path | Source, path: str, expected: Expected | None = None):
        self.encoding, self.root, self.path = encoding, root, path
        self._source = root if isinstance(root, Source) else Local(root)
        self._expected = expected
        self._place = encoding.location(path)
        self._arrays: dict[str, Array] = {}
        self._kept: dict[str, np.ndarray] = {}
        self._attributes: dict[str, Any] | None = None
        self._names: tuple[str, ...] | None = None
        self._number = next(_numbers)

    def __getstate__(self) -> tuple[Encoding, Path | Source, str, Expected | None]:
        return self.encoding, self.root, self.path, self._expected

    def __setstate__(self, state: tuple[Encoding, Path | Source, str, Expected | None]) -> None:
        self.__init__(*state)  # type: ignore[misc]

    # what an encoding decides
    @abstractmethod
    def _find_names(self) -> Iterable[str]:
        """The arrays of the shard that belongs here."""

    @abstractmethod
    def _find_attributes(self) -> dict[str, Any]:
        """The attributes of the shard, compared with what is expected."""

    @abstractmethod
    def _find(self, name: str) -> Array | None:
        """An array, compared with what is expected; None where there is none of that name."""

    @abstractmethod
    def _decode(self, raw: bytes, array: Array, into: np.ndarray) -> None:
        """Decode a chunk into a contiguous array of bytes of exactly its size. Raises Damaged."""

    def kinds(self, files: Files) -> dict[str, int]:
        """Bytes by kind of data: `tr`, `frames`, ...; `all` where that is not told. files: those of the shard."""
        return {"all": sum(int(facts["bytes"]) for facts in files.values())}

    @property
    def names(self) -> tuple[str, ...]:
        """The arrays, sorted."""
        if self._names is None:
            self._names = tuple(sorted(self._find_names()))
        return self._names

    def has(self, name: str) -> bool:
        """Whether there is such an array. Raises InputError where it was written and is there no more."""
        there = name in self.names
        expected = self._expected
        if not there and expected is not None and expected.files is not None and not expected.growing:
            self._refuse_lost(name, expected.files)
        return there

    def _refuse_lost(self, name: str, known: Files) -> None:
        """Raise InputError where an array that is not there was written."""
        if self._digest(self._place) != known[self._place]["sha256"]:
            raise self._refuse(self._place, f"there is no {name}, and this is not the file that was written")

    def _digest(self, file: str) -> str:
        with contextlib.closing(self._open(file)) as handle:
            return hashlib.file_digest(io.BufferedReader(Reading(handle)), "sha256").hexdigest()

    @property
    def attributes(self) -> dict[str, Any]:
        """The attributes of the shard."""
        if self._attributes is None:
            self._attributes = self._find_attributes()
        return dict(self._attributes)

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
            array.coordinate,
        )

    def read(self, name: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows `start` to `stop` of an array. Only the chunks they lie in are read and decoded."""
        return self.read_each((name, start, self._array(name).shape[0] if stop is None else stop))[0]

    def read_each(self, *wanted: tuple[str, int, int]) -> list[np.ndarray]:
        """Rows of several arrays, each as (name, start, stop); a file in which several lie is opened once."""
        handles: dict[str, File] = {}
        try:
            return [self._rows(handles, *one) for one in wanted]
        finally:
            for handle in handles.values():
                handle.close()

    def _rows(self, handles: dict[str, File], name: str, start: int, stop: int) -> np.ndarray:
        array = self._array(name)
        self._check_rows(array, name, start, stop)
        out = self._room(array, name, start, stop)
        self._fill(handles, name, start, stop, out)
        return out

    def _check_rows(self, array: Array, name: str, start: int, stop: int) -> None:
        if not 0 <= start <= stop <= array.shape[0]:
            raise IndexError(f"{name}: rows {start} to {stop} were asked for; it has rows 0 to {array.shape[0]}")

    def _room(self, array: Array, name: str, start: int, stop: int) -> np.ndarray:
        """An array for so many rows."""
        try:
            return np.empty((stop - start, *array.shape[1:]), array.dtype)
        except MemoryError:
            raise self._too_much(array, name, start, stop) from None

    def _too_much(self, array: Array, name: str, start: int, stop: int) -> InputError:
        return InputError(
            f"{self.root / array.file}: rows {start} to {stop} of {name} need more memory than there is; "
            "read fewer at a time"
        )

    def _fill(self, handles: dict[str, File], name: str, start: int, stop: int, out: np.ndarray) -> None:
        """Read rows into a contiguous array of their shape and type."""
        array = self._array(name)
        rows = array.rows
        try:
            if not out.size:
                return
            flat = out.reshape(-1).view(np.uint8)
            row = out.nbytes // len(out)
            if array.file not in handles:
                handles[array.file] = self._open(array.file)
            handle = handles[array.file]
            first, last = array.places[start // rows], array.places[-(-stop // rows) - 1]
            handle.expect(first[0], last[0] + last[1] - first[0])
            for i in range(start // rows, -(-stop // rows)):
                low, high = max(start, i * rows), min(stop, (i + 1) * rows)
                target = flat[(low - start) * row : (high - start) * row]
                if high - low == rows:
                    self._chunk(handle, array, i, target)
                else:
                    chunk = self._whole_chunk(handle, array, name, i, rows * row)
                    target[:] = chunk[(low - i * rows) * row : (high - i * rows) * row]
        except MemoryError:
            raise self._too_much(array, name, start, stop) from None
        except Damaged as error:
            raise self._refuse(array.file, f"{name}: {error}") from None

    def _whole_chunk(self, handle: File, array: Array, name: str, i: int, size: int) -> np.ndarray:
        """A chunk of so many bytes, of which a part is wanted; see `recent`."""
        held, key = recent.of_size(size), (self._number, name, i, handle.version)
        chunk = held.find(key)
        if chunk is None:
            chunk = np.empty(size, np.uint8)
            self._chunk(handle, array, i, chunk)
            held.keep(key, chunk)
        return chunk

    def kept(self, name: str) -> np.ndarray:
        """A whole array, read once and kept: for small ones by which others are read."""
        if name not in self._kept:
            self._kept[name] = self.read(name)
        return self._kept[name]

    def _chunk(self, handle: File, array: Array, i: int, into: np.ndarray) -> None:
        offset, length = array.places[i]
        try:
            raw = handle.read(offset, length)
            if len(raw) != length:
                raise Damaged("the file ends too early")
            self._decode(raw, array, into)
        except (RuntimeError, ValueError, OSError, zlib.error) as error:
            raise Damaged(f"chunk {i} cannot be decoded ({error})") from None

    def _refuse(self, file: str, problem: str) -> InputError:
        mended = ", and with --repair it makes them again" if isinstance(self._source, Local) else ""
        return InputError(
            f"{self.root / file}: {problem}; the file was changed or damaged: `spadmnist verify "
            f"{quoted(str(self.root))}` names every such file{mended}"
        )

    # what is expected
    def _compare(self, name: str, attributes: Mapping[str, Any], array: Array | None = None) -> None:
        """Attributes and sizes of an array, or of the shard (""), are those that belong here."""
        if self._expected is None:
            return
        place = self._place if self.encoding.one_file else f"{self._place}/{name}".rstrip("/")
        what = f"{name}: its" if name and self.encoding.one_file else "its"
        for key, value in self._expected.attributes.get(name, {}).items():
            found = attributes.get(key)
            if type(found) is not type(value) or found != value:
                raise self._refuse(place, f"{what} {key} is {_said(found)}, and {_said(value)} belongs here")
        for dim, size in zip(array.dims, array.shape, strict=True) if array is not None else ():
            wanted = self._expected.sizes.get(dim, size)
            if size != wanted:
                raise self._refuse(place, f"{what} size along {dim} is {size}, and {wanted} belongs here")

    def _array(self, name: str) -> Array:
        if name not in self._arrays:
            found = self._find(name) if all(map(NAME.fullmatch, name.split("/"))) else None
            if found is None:
                place, known = self.root / self._place, ", ".join(self.names)
                raise InputError(f"{place}: there is no array {name!r}; there are {known}")
            self._arrays[name] = found
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
            return Missing(self._refuse(file, "this file is missing"))
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
            if size != known["bytes"] and not self._is_growing():
                raise self._refuse(file, f"this file has {size} bytes, and it had {known['bytes']}")

    def _is_growing(self) -> bool:
        growing = self._expected.growing if self._expected is not None else ""
        return bool(growing) and isinstance(self.root, Path) and os.path.lexists(self.root / growing)

    def _tail(self, file: str, size: int) -> tuple[bytes, int]:
        """The last `size` bytes of a file (fewer where it is smaller), and its length."""
        handle = self._open(file)
        try:
            return handle.read(max(0, handle.size - size), size), handle.size
        except OSError as error:
            raise self._why_not(file, error) from None
        finally:
            handle.close()


def read_joined(pieces: Sequence[tuple[ShardReader, int, int]], name: str) -> np.ndarray:
    """Rows of an array of several shards, each as (reader, start, stop), one after the other.

    Many rows of a local dataset are decoded by several threads: the codecs release Python's lock. Raises InputError
    where a chunk is damaged, or the type or shape of a row differs between the shards.
    """
    reader, start, stop = pieces[0]
    if len(pieces) == 1:
        return reader.read(name, start, stop)
    like = reader._array(name)
    total = sum(stop - start for _, start, stop in pieces)
    out = reader._room(like, name, 0, total)
    ends = np.cumsum([stop - start for _, start, stop in pieces])

    def fill(piece: tuple[ShardReader, int, int], end: int) -> None:
        reader, start, stop = piece
        array, handles = reader._array(name), dict[str, File]()
        reader._check_rows(array, name, start, stop)
        if (array.dtype, array.shape[1:]) != (like.dtype, like.shape[1:]):
            raise reader._refuse(array.file, f"{name}: its type or shape is not that of the shard before")
        try:
            reader._fill(handles, name, start, stop, out[end - (stop - start) : end])
        finally:
            for handle in handles.values():
                handle.close()

    if out.nbytes < _MANY or not isinstance(reader._source, Local):
        for piece, end in zip(pieces, ends, strict=True):
            fill(piece, end)
        return out
    with ThreadPoolExecutor(min(system.processors(), _THREADS)) as pool:
        for _ in pool.map(fill, pieces, ends):
            pass  # raises what a thread raised
    return out


def _said(value: Any) -> str:
    return "not said" if value is None else repr(value)
