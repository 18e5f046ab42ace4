"""A zip of a dataset, read where it lies.

A zip may come from anybody. A member that inflates to more than `_MOST_INFLATED` times its size, one that is encrypted
or stands there twice, and one that does not lie where the zip says are refused.
"""

from __future__ import annotations

import contextlib
import os
import re
import threading
import zipfile
import zlib
from collections import OrderedDict
from pathlib import Path
from typing import Any

from . import archive
from .archive import BadArchive
from .errors import InputError
from .sources import File, Source, Unreadable, tree

_MOST_INFLATED = 200  # times; manifests deflate 4 to 10 times, shards hardly, deflate itself ends at 1032
_FREE = 1 << 20  # bytes that a member may have however well it deflates
_INFLATED = 1 << 28  # bytes of inflated members that stay in memory
_MEMBERS = 1 << 22  # files of a zip; the paper's dataset has a few thousand
_IS_MANIFEST = re.compile(r"([^/]+/)?manifest\.json")


def is_zip(path: Path) -> bool:
    """Is it a file that is a zip by its first bytes, or by its name?"""
    if not path.is_file():
        return False
    try:
        with open(path, "rb") as file:
            return file.read(4) in (b"PK\x03\x04", b"PK\x05\x06") or path.suffix.lower() == ".zip"
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


class _Member(File):
    """Of a zip, as it is stored: a range of the zip's file; all of it where no range is given."""

    def __init__(self, path: Path, start: int = 0, size: int | None = None):
        self._file = open(path, "rb", buffering=0)  # noqa: SIM115 - closed by `close`
        self._start, self.size = start, os.fstat(self._file.fileno()).st_size if size is None else size

    def read(self, offset: int, length: int) -> bytes:
        length = max(0, min(length, self.size - offset))
        return os.pread(self._file.fileno(), length, self._start + offset)

    def close(self) -> None:
        self._file.close()


class _Bytes(File):
    def __init__(self, data: bytes):
        self._data, self.size = data, len(data)

    def read(self, offset: int, length: int) -> bytes:
        return self._data[offset : offset + length]


class Zip(Source):
    """A zip that holds a dataset's folder, or what is in that folder. Members are read where they lie.

    A member that is stored costs what a file costs. One that is deflated is inflated as a whole when it is first read.
    Raises InputError where it is no zip, or one that unpacks to more than it may.
    """

    def __init__(self, path: Path):
        super().__init__(str(path))
        self._path = path
        self._members = self._read()
        self._below = tree(self._members)
        self._inflated: OrderedDict[str, bytes] = OrderedDict()
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_inflated": OrderedDict(), "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _lock=threading.Lock())

    def _read(self) -> dict[str, zipfile.ZipInfo]:
        """The members by their names, below the folder of the manifest."""
        try:
            with contextlib.closing(_Member(self._path)) as file:
                listed = archive.members(file)
        except BadArchive as error:
            raise self._no(str(error)) from None
        except OSError as error:
            raise InputError(f"{self}: cannot be read: {error.strerror or error}") from error
        if len(listed) > _MEMBERS:
            raise self._no(f"has {len(listed):,} files, and at most {_MEMBERS:,} are read")
        tops = sorted((i.filename for i in listed if _IS_MANIFEST.fullmatch(i.filename)), key=lambda name: len(name))
        if not tops:
            raise self._no("is not a zip of a dataset: it has no manifest.json")
        above = tops[0].removesuffix("manifest.json")
        return {i.filename.removeprefix(above): i for i in listed if i.filename.startswith(above)}

    def _no(self, problem: str) -> InputError:
        return InputError(f"{self}: {problem}; give the zip of a folder that spadmnist generate made")

    def _bad(self, problem: str) -> Unreadable:
        return Unreadable(f"{self}: {problem}; the zip was changed or damaged, and is to be made or brought again")

    def open(self, file: str) -> File:
        info = self._members.get(file)
        if info is None:
            raise FileNotFoundError(file)
        try:
            archive.check_member(info, compressed=True)
        except BadArchive as error:
            raise self._bad(str(error)) from None
        if info.compress_type == zipfile.ZIP_STORED:
            return _Member(self._path, self._start(info), info.file_size)
        if info.file_size > _FREE + _MOST_INFLATED * info.compress_size:
            raise self._bad(
                f"{file} inflates {info.compress_size:,} bytes to {info.file_size:,}, and at most {_MOST_INFLATED} "
                "times as many are read"
            )
        with self._lock:
            if file not in self._inflated:
                self._inflated[file] = self._inflate(file, info)
                while len(self._inflated) > 1 and sum(map(len, self._inflated.values())) > _INFLATED:
                    self._inflated.popitem(last=False)
            self._inflated.move_to_end(file)
            return _Bytes(self._inflated[file])

    def _start(self, info: zipfile.ZipInfo) -> int:
        try:
            with contextlib.closing(_Member(self._path)) as file:
                return archive.start(file, info)
        except BadArchive as error:
            raise self._bad(str(error)) from None

    def _inflate(self, file: str, info: zipfile.ZipInfo) -> bytes:
        member = _Member(self._path, self._start(info), info.compress_size)
        try:
            inflate = zlib.decompressobj(-zlib.MAX_WBITS)
            data = inflate.decompress(member.read(0, info.compress_size), info.file_size + 1)
        except zlib.error as error:
            raise self._bad(f"{file} cannot be inflated ({error})") from None
        finally:
            member.close()
        if len(data) != info.file_size or not inflate.eof:
            raise self._bad(f"{file} does not have the {info.file_size:,} bytes that the zip says")
        if zlib.crc32(data) != info.CRC:
            raise self._bad(f"{file} is damaged: its checksum does not match")
        return data

    def names(self) -> set[str]:
        return set(self._members)

    def folders(self, place: str) -> list[str]:
        return sorted(self._below.get(place, ()))

    def document(self, file: str, most: int) -> bytes:
        info = self._members.get(file)
        if info is not None and info.file_size > most:
            raise self.too_large(file, info.file_size, most)
        handle = self.open(file)
        try:
            return handle.read(0, handle.size)
        finally:
            handle.close()
