"""A dataset on a web server or in a bucket, read by HTTP ranges (package obstore, extra `remote`).

**Blocks.** Files are read in blocks of 256 KiB. Blocks are kept in memory, and on disk in the user's cache. The name of
a block on disk holds the dataset's seal and the address, so that another server cannot replace it. A damaged block is
read again from the server. If nothing can be written, there is no cache on disk.

**Trust.** The status of the first answer says whether a server gives ranges. A file whose size is not the manifest's is
refused, and so is a redirect to anything but http(s). The decoder compares each chunk with its checksum.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import secrets
import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import google_crc32c

from . import system
from .document import path_of
from .errors import InputError, SpadError
from .foreign import quoted, short
from .sources import PIECE, File, Source, Unreadable, tree
from .zipped import Zip, is_zip

BLOCK = 1 << 18  # bytes; one image's part of an array is a few times 10 KiB, and 256 KiB take 0.1 s at 20 Mbit/s
_IN_MEMORY = 128  # blocks of a dataset that stay in memory: 32 MiB
_ON_DISK = 1 << 30  # bytes of all blocks in the user's cache
_BETWEEN_TRIMS = 1 << 26  # bytes written before the cache is counted again
_FIRST = 1 << 18  # bytes, of a document whose size is not known yet
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://")
_KEYS = ("AWS_ACCESS_KEY_ID", "AWS_WEB_IDENTITY_TOKEN_FILE", "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI")

_started_in: int | None = None  # the process in which obstore's threads run


def is_url(place: object) -> bool:
    """Does a text name a place on a network?"""
    return isinstance(place, str) and bool(_URL.match(place))


def at(place: str | os.PathLike[str], cache: Path | None = None) -> Path | Source:
    """A place that a user named: a path as it is, or the source of a zip or of a URL. cache: folder of the blocks.

    Raises InputError where a URL is of a kind that is not read.
    """
    if isinstance(place, str) and (scheme := _URL.match(place)):
        if scheme[1].lower() not in _STORES:
            raise InputError(f"{place}: {scheme[1]}:// is not read; give a folder, a zip, or {_kinds()}")
        return Remote(place, cache)
    path = path_of(place, "a dataset or a config")
    return Zip(path) if is_zip(path) else path


def _kinds() -> str:
    return ", ".join(f"{scheme}://" for scheme in _STORES)


class Blocks:
    """Blocks of files on disk, below a folder that is the user's alone. Where that cannot be, nothing is kept."""

    def __init__(self, folder: Path | None, most: int = _ON_DISK):
        self._folder, self._most, self._written = folder, most, _BETWEEN_TRIMS
        if folder is not None:
            try:
                folder.parent.mkdir(parents=True, exist_ok=True)
                with contextlib.suppress(FileExistsError):
                    folder.mkdir(mode=0o700)
                if not system.is_private(folder.lstat()):
                    self._folder = None
            except OSError:
                self._folder = None

    def get(self, name: str) -> bytes | None:
        """A block as it was put, or None."""
        if self._folder is None:
            return None
        try:
            handle = os.open(self._folder / name, system.READ | system.NO_LINK)
            with open(handle, "rb") as file:
                data = file.read(BLOCK + 4)
            os.utime(self._folder / name)  # it is in use
        except OSError:
            return None
        return data[:-4] if len(data) >= 4 and _checksum(data[:-4]) == data[-4:] else None

    def put(self, name: str, data: bytes) -> None:
        """Keep a block under a name `folder/file`. It is there as a whole or not at all."""
        if self._folder is None:
            return
        try:
            self._written += len(data)
            if self._written > _BETWEEN_TRIMS:
                self._written = 0
                self._trim(self._folder)
            place = self._folder / name
            place.parent.mkdir(mode=0o700, exist_ok=True)
            part = place.with_name(f"{place.name}.{secrets.token_hex(8)}.part")
            try:
                with open(os.open(part, system.WRITE | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                    file.write(data + _checksum(data))
                os.replace(part, place)
            finally:
                part.unlink(missing_ok=True)
        except OSError:  # a full disk, for example: no more is kept
            self._folder = None

    def _trim(self, root: Path) -> None:
        """Remove the blocks that were used last the longest ago, until there is room for what comes."""
        found = []
        for folder in os.scandir(root):
            for entry in os.scandir(folder.path) if folder.is_dir(follow_symlinks=False) else ():
                facts = entry.stat(follow_symlinks=False)
                found.append((facts.st_mtime_ns, facts.st_size, entry.path))
        total = sum(size for _, size, _ in found)
        for _, size, path in sorted(found):
            if total <= max(0, self._most - _BETWEEN_TRIMS):
                break
            with contextlib.suppress(FileNotFoundError):  # another process was faster
                os.unlink(path)
            total -= size


def _checksum(data: bytes) -> bytes:
    return google_crc32c.value(data).to_bytes(4, "little")


class _Far(File):
    def __init__(self, source: Remote, file: str, size: int):
        self._source, self._name, self.size = source, file, size

    def read(self, offset: int, length: int) -> bytes:
        length = max(0, min(length, self.size - offset))
        return self._source.part(self._name, self.size, offset, length) if length else b""

    def expect(self, offset: int, length: int) -> None:
        if length < _IN_MEMORY * BLOCK // 2:
            self.read(offset, length)


class Remote(Source):
    """A dataset's folder on a web server or in a bucket, read by ranges. requests, bytes: what that took.

    Raises InputError, from whatever reads, where there is no such host, where the server does not give ranges or sends
    other bytes than the manifest says, and where credentials are missing.
    """

    def __init__(self, url: str, cache: Path | None = None):
        super().__init__(url.rstrip("/"))
        self.ranges = True  # False: files are asked for as a whole, which every server can
        self._store: Any = None
        self._place = urlsplit(self.name)
        self._blocks, self._cache = Blocks(cache), cache
        self._files: Mapping[str, Mapping[str, Any]] = {}
        self._seal = ""
        self._below: dict[str, set[str]] = {}
        self._recent: OrderedDict[tuple[str, int], bytes] = OrderedDict()
        self._lock = threading.Lock()
        if self._place.query or self._place.fragment or self._place.username is not None or not self._place.netloc:
            wanted = "a host and a path, without ?, # and user name"
            raise InputError(f"{self._place.scheme}:// is given {wanted}; this one is {short(self._shown, 300)}")

    @property
    def _shown(self) -> str:
        """The URL without a password."""
        return self._place._replace(netloc=self._place.netloc.rpartition("@")[2]).geturl()

    def __getstate__(self) -> dict[str, Any]:
        state = {**self.__dict__, "_store": None, "_recent": OrderedDict()}
        del state["_lock"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _lock=threading.Lock())

    def hold(self, files: Mapping[str, Mapping[str, Any]], seal: str) -> None:
        self._files, self._seal, self._below = files, seal, tree(files)

    def names(self) -> None:
        return None

    def folders(self, place: str) -> list[str]:
        return sorted(self._below.get(place, ()))

    def open(self, file: str) -> File:
        if file not in self._files:
            raise FileNotFoundError(file)
        return _Far(self, file, int(self._files[file]["bytes"]))

    def part(self, file: str, size: int, offset: int, length: int) -> bytes:
        """Bytes of a file, from blocks; what is missing of them comes by one request."""
        first, last = offset // BLOCK, (offset + length - 1) // BLOCK
        found = {number: self._kept(file, number, size) for number in range(first, last + 1)}
        missing = [number for number, block in found.items() if block is None]
        if missing:
            start, stop = missing[0] * BLOCK, min((missing[-1] + 1) * BLOCK, size)
            data, told = self._get(file, (start, stop))
            if told != size:
                raise self._other(file, told, size)
            for number in range(missing[0], missing[-1] + 1):
                block = data[number * BLOCK - start : (number + 1) * BLOCK - start]
                if found[number] is None:
                    self._blocks.put(self._block(file, number), block)
                found[number] = block
                self._keep(file, number, block)
        joined = b"".join(block for block in found.values() if block is not None)
        return joined[offset - first * BLOCK :][:length]

    def _block(self, file: str, number: int) -> str:
        place = hashlib.sha256(f"{self.name}\0{file}".encode()).hexdigest()
        return f"{self._seal}/{place[:40]}-{number}"

    def _kept(self, file: str, number: int, size: int) -> bytes | None:
        with self._lock:
            if (file, number) in self._recent:
                self._recent.move_to_end((file, number))
                return self._recent[file, number]
        block = self._blocks.get(self._block(file, number))
        if block is None or len(block) != min(BLOCK, size - number * BLOCK):
            return None
        self._keep(file, number, block)
        return block

    def _keep(self, file: str, number: int, block: bytes) -> None:
        with self._lock:
            self._recent[file, number] = block
            while len(self._recent) > _IN_MEMORY:
                self._recent.popitem(last=False)

    def document(self, file: str, most: int) -> bytes:
        if not self.ranges:
            data = b""
            for piece in self.whole(file):
                data += piece
                if len(data) > most:
                    raise self.too_large(file, len(data), most)
            return data
        data, size = self._get(file, (0, _FIRST))
        if size > most:
            raise self.too_large(file, size, most)
        if size > len(data):
            more, told = self._get(file, (len(data), size))
            if told != size:
                raise self._other(file, told, size)
            data += more
        return data

    def whole(self, file: str, start: int = 0) -> Iterator[bytes]:
        """As `Source.whole`, from a byte on; servers without ranges give it from 0.

        It ends soon after what the manifest says.
        """
        most = int(self._files[file]["bytes"]) if file in self._files else None
        self._count(1, 0)
        with self._said(file):
            wanted = {"range": {"offset": start}} if start else None
            stream = iter(self._api().get(self._connected(), file, options=wanted).stream(min_chunk_size=PIECE))
        read = 0
        while most is None or read <= most:
            with self._said(file):
                piece = bytes(next(stream, b""))
            if not piece:
                return
            read += len(piece)
            self._count(0, len(piece))
            yield piece

    def _get(self, file: str, wanted: tuple[int, int]) -> tuple[bytes, int]:
        """(the bytes of a range, as far as the file has them; the size of the file)."""
        self._count(1, 0)
        with self._said(file):
            answer = self._api().get(self._connected(), file, options={"range": wanted})
            size = int(answer.meta["size"])
            data = bytes(answer.bytes())
        self._count(0, len(data))
        if len(data) != min(wanted[1], size) - wanted[0]:
            raise self._other(file, size, wanted[1])
        return data, size

    def _count(self, requests: int, size: int) -> None:
        with self._lock:
            self.requests += requests
            self.bytes += size

    def _other(self, file: str, size: int, wanted: int) -> Unreadable:
        return Unreadable(
            f"{self / file}: has {size:,} bytes, and it had {wanted:,}; the file was changed or is not whole: "
            f"`spadmnist verify {quoted(str(self))}` names every such file"
        )

    # obstore
    def _api(self) -> Any:
        global _started_in
        try:
            import obstore
        except ImportError:
            raise SpadError(
                f"{self}: is read by the package obstore, which is not installed; pip install 'spadmnist[remote]'"
            ) from None
        if _started_in not in (None, os.getpid()):
            raise SpadError(
                f"{self}: was read before this process was forked, and cannot be read here; start workers with "
                "multiprocessing_context='spawn'"
            )
        _started_in = os.getpid()
        return obstore

    def _connected(self) -> Any:
        if self._store is None:
            self._store = _STORES[self._place.scheme.lower()](self.name, self._place)
        return self._store

    @contextlib.contextmanager
    def _said(self, file: str) -> Iterator[None]:
        """Turn what obstore says of a request into a sentence."""
        try:
            yield
        except (SpadError, GeneratorExit):
            raise
        except FileNotFoundError:
            raise FileNotFoundError(file) from None
        except Exception as error:
            raise InputError(f"{self / file}: {self._reason(error)}") from None

    def _reason(self, error: Exception) -> str:
        said = str(error)
        status = re.search(r"status code: (\d+)", said)
        kind = type(error).__name__
        if kind == "NotSupportedError" or "Range request not supported" in said:
            return (
                "the server does not send parts of files (HTTP ranges); bring the dataset with "
                f"spadmnist.fetch({str(self)!r}, sha256=..., to=...), or have it published on one that does"
            )
        if kind in ("PermissionDeniedError", "UnauthenticatedError") or (status and status[1] in ("401", "403")):
            if self._place.scheme.lower() == "s3" and not _has_keys():
                return (
                    "the bucket refuses who comes without credentials; set AWS_ACCESS_KEY_ID and "
                    "AWS_SECRET_ACCESS_KEY, or have the bucket opened"
                )
            return "the server refuses access; check the address and the credentials"
        if status and status[1].startswith("3"):
            return "the server leads to another address that is not http(s), which is not followed; check the address"
        if status and status[1] == "416":
            return "the server has fewer bytes than the manifest says; the file was changed or is not whole"
        if status:
            return f"the server answers with status {status[1]}; try again later, or check the address"
        if "error sending request" in said or "connect" in said.lower():
            return f"{self._place.hostname} cannot be reached; check the address and the network"
        return f"the file cannot be read from there ({short(' '.join(said.splitlines()[:1]), 200)}); try again"


def _has_keys() -> bool:
    return any(os.environ.get(key) for key in _KEYS)


_PATIENCE: dict[str, Any] = {"max_retries": 2, "retry_timeout": timedelta(seconds=60)}


def _client(plain: bool) -> dict[str, Any]:
    """allow_http: only where the address itself is http, so that no redirect leads from https there."""
    return {"allow_http": plain, "connect_timeout": "10s", "timeout": "300s"}


def _http(url: str, place: Any) -> Any:
    from obstore.store import HTTPStore

    return HTTPStore.from_url(url, client_options=_client(place.scheme.lower() == "http"), retry_config=_PATIENCE)


def _s3(url: str, place: Any) -> Any:
    """Without credentials in the environment the bucket is asked as anyone may."""
    from obstore.store import S3Store

    plain = os.environ.get("AWS_ENDPOINT_URL", os.environ.get("AWS_ENDPOINT", "")).startswith("http://")
    config: dict[str, Any] = {} if _has_keys() else {"skip_signature": True}
    if not (os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")):
        config["region"] = "us-east-1"
    prefix = place.path.strip("/") or None
    return S3Store(place.netloc, prefix=prefix, client_options=_client(plain), retry_config=_PATIENCE, **config)


_STORES = {"https": _http, "http": _http, "s3": _s3}
