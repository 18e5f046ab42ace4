"""Where the bytes of a dataset lie: a folder, a zip, a web server (http, https) or a bucket (s3).

A *source* gives any range of any file of a dataset. Who reads a shard asks for what its chunks need and nothing else:

    Local      a folder of this machine: here
    Zip        a zip of a dataset, its members stored or deflated: `zipped`
    Remote     a web server or a bucket, by HTTP ranges: `remote`

Nothing that a source gives is executed or unpickled.
"""

from __future__ import annotations

import hashlib
import io
import os
import stat
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from . import system
from .errors import InputError

PIECE = 1 << 22  # bytes, of a file that is read from its beginning to its end


class File(ABC):
    """A file that is open for reading.

    size: bytes; version: another one where the file was written to or replaced, as far as the source can tell.
    """

    size: int
    version: Any = None

    @abstractmethod
    def read(self, offset: int, length: int) -> bytes:
        """The bytes from `offset` on; fewer where the file ends."""

    def expect(self, offset: int, length: int) -> None:  # noqa: B027 - where a range costs nothing, nothing is done
        """These bytes are about to be read, piece by piece: where each request takes time, one brings them all."""

    def close(self) -> None:  # noqa: B027 - what holds nothing has nothing to close
        """Give back what is held for it."""


class Source(ABC):
    """A dataset's files by their names below its root. It is shown like a folder: `source / name`, `str(source)`."""

    def __init__(self, name: str):
        self.name = name
        self.requests = 0  # answered, or refused, by a server
        self.bytes = 0  # that were read, or came from afar

    def __str__(self) -> str:
        return self.name

    def __truediv__(self, name: str) -> str:
        return f"{self.name}/{name}"

    @abstractmethod
    def open(self, file: str) -> File:
        """A file. Raises FileNotFoundError where there is none, OSError or InputError where it cannot be read."""

    @abstractmethod
    def names(self) -> set[str] | None:
        """All files, or None where that is not told."""

    @abstractmethod
    def folders(self, place: str) -> list[str]:
        """The folders in a folder, sorted."""

    @abstractmethod
    def document(self, file: str, most: int) -> bytes:
        """A small file as a whole. Raises InputError where it has more than `most` bytes."""

    def whole(self, file: str) -> Iterator[bytes]:
        """A file from its beginning to its end, in pieces."""
        handle = self.open(file)
        try:
            for offset in range(0, handle.size, PIECE):
                yield handle.read(offset, min(PIECE, handle.size - offset))
        finally:
            handle.close()

    def hold(self, files: Mapping[str, Mapping[str, Any]], seal: str) -> None:  # noqa: B027 - who lists needs it not
        """What the manifest says of the files, and its seal."""

    def too_large(self, file: str, size: int, most: int) -> InputError:
        return InputError(f"{self / file}: has {size:,} bytes, and at most {most:,} are read; it is no dataset's")


class Reading(io.RawIOBase):
    """A file of a source as a Python file, for libraries that read one."""

    def __init__(self, file: File):
        self._file, self._at = file, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = max(0, offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._file.size}[whence])
        return self._at

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        length = min(len(view), max(0, self._file.size - self._at))
        found = self._file.read(self._at, length) if length else b""
        view[: len(found)] = found
        self._at += len(found)
        return len(found)


# --- a folder -----------------------------------------------------------------------------------------------------


class _LocalFile(File):
    __slots__ = ("_handle", "size", "version")

    def __init__(self, handle: int, status: os.stat_result):
        self._handle, self.size = handle, status.st_size
        self.version = status.st_ino, status.st_mtime_ns

    def read(self, offset: int, length: int) -> bytes:
        return system.read_at(self._handle, offset, length)

    def close(self) -> None:
        os.close(self._handle)


class Local(Source):
    """A folder of this machine. A symbolic link anywhere below it is refused."""

    def __init__(self, root: Path):
        super().__init__(str(root))
        self._root = root

    def open(self, file: str) -> File:
        handle = system.open_below(self._root, file.split("/"))
        try:
            status = os.fstat(handle)
            if not stat.S_ISREG(status.st_mode):
                raise NotAFile
        except BaseException:
            os.close(handle)
            raise
        return _LocalFile(handle, status)

    def names(self) -> set[str]:
        found = set()
        for folder, folders, files in os.walk(self._root):
            for name in files + [f for f in folders if os.path.islink(os.path.join(folder, f))]:
                found.add(os.path.relpath(os.path.join(folder, name), self._root).replace(os.sep, "/"))
        return found

    def folders(self, place: str) -> list[str]:
        return system.folders_in(self._root, place.split("/"))

    def document(self, file: str, most: int) -> bytes:
        handle = self.open(file)
        try:
            if handle.size > most:
                raise self.too_large(file, handle.size, most)
            return handle.read(0, handle.size)
        finally:
            handle.close()


class Unreadable(InputError):
    """A file that is not what its source, or the manifest, says of it."""


class NotAFile(OSError):
    """A pipe, a device, a socket or a folder in place of a file."""


OTHER, ABSENT = -1, -2


def compare(source: Source, name: str, listed: Mapping[str, Any]) -> int:
    """The bytes of a file that has the size and SHA-256 that are listed of it, else OTHER or ABSENT.

    A link is OTHER, wherever it leads. Raises InputError where the file cannot be reached.
    """
    digest, size = hashlib.sha256(), 0
    try:
        for piece in source.whole(name):
            digest.update(piece)
            size += len(piece)
            if size > listed["bytes"]:
                return OTHER
    except FileNotFoundError:
        return ABSENT
    except (OSError, Unreadable):
        return OTHER
    return size if size == listed["bytes"] and digest.hexdigest() == listed["sha256"] else OTHER


def is_as_listed(root: Path, name: str, listed: Mapping[str, Any]) -> bool:
    """Is a file below a folder the one whose size and SHA-256 are listed? A link is not, wherever it leads."""
    return compare(Local(root), name, listed) >= 0


def tree(names: Iterable[str]) -> dict[str, set[str]]:
    """The folders in each folder, of files by their names."""
    found: dict[str, set[str]] = {}
    for name in names:
        folder = name.rpartition("/")[0]
        while folder:
            above, _, own = folder.rpartition("/")
            if own in found.setdefault(above, set()):
                break
            found[above].add(own)
            folder = above
    return found
