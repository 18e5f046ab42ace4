"""Files that are there as a whole or not at all: temporary name, synchronise, one rename, synchronise the folder.

Whoever is killed, and whenever, leaves a whole file or folder in its place, or none. A full disk, a lost permission
and the like become one sentence.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import secrets
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import IO, Any

from . import system
from .errors import InputError, SpadError

_LARGEST_MANIFEST = 1 << 30  # bytes
# bytes of a file after which it is synchronised while the rest is made. Chosen by a file of 36 MiB that grew
# in 0.25 s: the last wait took 60 ms without any such synchronisation, 8 ms with one each 8 MiB, 0.3 ms with 4 or 2 MiB
_SYNC_EVERY = 4 << 20
_SYNCS_AT_ONCE = 4  # threads that synchronise the files of a shard; 8 and 32 were no faster

Files = dict[str, dict[str, Any]]  # path relative to the root -> {"bytes": ..., "sha256": ...}


def temporary(root: str | os.PathLike[str]) -> Path:
    """The folder for what is not complete yet. Its content may be swept when nobody writes."""
    return Path(root) / ".spadmnist" / "tmp"


def commit_file(
    path: str | os.PathLike[str], data: bytes, tmp: str | os.PathLike[str], sync: bool = True
) -> dict[str, Any]:
    """Write one file so that it is there as a whole or not at all; an older one is replaced.

    `tmp` must be on the same file system. sync: False where it may be lost, or be damaged, with the power.
    Returns {"bytes": ..., "sha256": ...}.
    """
    path = Path(path)
    with writing(path, len(data)), workspace(Path(tmp)) as work:
        _make_folder(path.parent)
        record = _put(work / "file", [data])
        if sync:
            system.synchronise(work / "file")
        os.replace(work / "file", path)
        if sync:
            system.synchronise(path.parent)
    return record


def opened(path: str | os.PathLike[str]) -> IO[bytes]:
    """A file that a user named, open for reading. It is never waited for.

    What was handed over open (/dev/stdin, /dev/fd/63) may be a pipe: its writer is at work. Raises InputError for any
    other pipe, a device and a socket, and OSError as `open` does.
    """
    if _HANDED_OVER.fullmatch(os.fspath(path)):
        return open(path, "rb")
    try:
        handle = os.open(path, system.READ | system.NO_WAIT)
    except OSError as error:
        if os.path.isdir(path):  # which some systems do not open
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path)) from None
        if error.errno == errno.ENXIO:  # nobody listens at a socket, or there is no such device
            raise InputError(f"{path}: is a socket or a device, and only a file is read; name a file") from None
        raise
    mode = os.fstat(handle).st_mode
    if stat.S_ISREG(mode):
        return open(handle, "rb")
    os.close(handle)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise InputError(
        f"{path}: is a {'pipe' if stat.S_ISFIFO(mode) else 'device'}, and only a file is read; name a file"
    )


_HANDED_OVER = re.compile(r"/dev/stdin|/dev/fd/[0-9]+|/proc/self/fd/[0-9]+")


def identity(path: str | os.PathLike[str]) -> tuple[Any, ...]:
    """What two paths have in common where they lead to one file: by links of any kind, or written in another way."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return (os.path.abspath(path),)
    return status.st_dev, status.st_ino


def check_outside(place: str | os.PathLike[str]) -> None:
    """Raise SpadError where a place lies inside a dataset, finished or not: that holds its own files alone."""
    for folder in Path(os.path.realpath(place)).parents:
        begun = (folder / ".spadmnist" / "plan.json").exists()
        if begun or _is_manifest(folder / "manifest.json"):
            raise SpadError(
                f"{place}: lies inside the dataset {folder}, which holds its own files alone; choose another -o"
            )


def check_writable(place: str | os.PathLike[str], name: str = "") -> None:
    """Raise SpadError where no file can be made at a place, or in it where it is a folder, before any work is done.

    name: of the option, for the message.
    """
    named = f"{name} {place}".strip()
    try:
        folder = Path(place).absolute()
        if not folder.is_dir():
            folder = folder.parent
        while not folder.exists() and folder != folder.parent:
            folder = folder.parent
        if not folder.is_dir():
            raise SpadError(f"{named}: cannot be written, for {folder} is a file; choose another place")
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise SpadError(f"{named}: cannot be written ({error.strerror or error}); choose another place") from None


def _is_manifest(path: Path) -> bool:
    try:
        return b'"format": "spadmnist-dataset/' in read_file(path, _LARGEST_MANIFEST)
    except OSError:
        return False


@contextlib.contextmanager
def whole(path: str | os.PathLike[str], size: int) -> Iterator[IO[bytes]]:
    """A file among the user's own, to be written piece by piece: there as a whole or not at all; an older one goes.

    size: bytes, about. It grows beside its place under a hidden name that is the same each time, so that a run that
    was killed leaves nothing that the next one does not write over. Raises SpadError where it cannot be written, is
    being written by another run, or would lie inside a dataset.
    """
    path = Path(path)
    check_outside(path)
    part = path.with_name(f".{path.name}.part")
    with writing(path, size):
        _make_folder(path.parent)
        try:
            lock = system.Lock(part)
        except system.Busy:
            raise SpadError(f"{path}: another run is writing it; wait for it, or choose another name with -o") from None
        with lock:
            try:
                flags = system.BOTH | os.O_CREAT | system.NO_LINK | system.NO_WAIT
                with open(os.open(part, flags, 0o666), "r+b") as file:
                    file.truncate(0)
                    yield file
                    file.flush()
                    os.fsync(file.fileno())
                os.replace(part, path)
            finally:
                part.unlink(missing_ok=True)
        system.synchronise(path.parent)


@contextlib.contextmanager
def whole_folder(path: str | os.PathLike[str], size: int, resumed: bool = False) -> Iterator[Path]:
    """A folder among the user's own, to be filled: there as a whole or not at all; see `whole`.

    What is there already is left alone: raises SpadError. resumed: what was begun under the hidden name is there again,
    and stays where it ends with an error.
    """
    path = Path(path)
    check_outside(path)
    taken = SpadError(f"{path}: is there already, and is not written over; remove it, or name another with -o")
    part = path.with_name(f".{path.name}.part")
    with writing(path, size):
        if os.path.lexists(path):
            raise taken
        _make_folder(part)
        try:
            lock = system.Lock(part)
        except system.Busy:
            raise SpadError(f"{path}: another run is writing it; wait for it, or choose another -o") from None
        with lock:
            try:
                if not resumed:
                    _empty(part)
                yield part
                for folder, _, names in os.walk(part):
                    for name in names:
                        system.synchronise(Path(folder, name))
                    system.synchronise(Path(folder))
                try:
                    os.rename(part, path)  # over an empty folder at most
                except OSError as error:
                    if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                        raise taken from None
                    raise
            except BaseException:
                if not resumed:
                    shutil.rmtree(part, ignore_errors=True)
                raise
        system.synchronise(path.parent)


def _empty(folder: Path) -> None:
    for entry in list(os.scandir(folder)):
        shutil.rmtree(entry.path) if entry.is_dir(follow_symlinks=False) else os.unlink(entry.path)


def put_file(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a file among the user's own; see `whole`."""
    with whole(path, len(data)) as file:
        file.write(data)


def read_file(path: str | os.PathLike[str], most: int) -> bytes:
    """A regular file's content. Raises OSError for a link, a pipe and whatever else is no file, or a larger one."""
    handle = os.open(path, system.READ | system.NO_LINK | system.NO_WAIT)
    with open(handle, "rb") as file:
        facts = os.fstat(file.fileno())
        if not stat.S_ISREG(facts.st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file", str(path))
        if facts.st_size > most:
            raise OSError(errno.EFBIG, f"it is larger than {most} bytes", str(path))
        return file.read()


def sweep(tmp: str | os.PathLike[str]) -> int:
    """Remove what interrupted runs left in a temporary folder; how many things that were.

    Only for who holds the lock of the run: another writer's files would go as well.
    """
    count = 0
    if Path(tmp).is_symlink() or Path(tmp).parent.is_symlink():
        raise SpadError(f"{tmp}: there is a symbolic link on the way, and what it leads to is not removed; remove it")
    try:
        entries = list(os.scandir(tmp))
    except FileNotFoundError:
        return 0
    for entry in entries:
        count += 1
        if entry.is_dir(follow_symlinks=False):
            shutil.rmtree(entry.path)
        else:
            os.unlink(entry.path)
    return count


@contextlib.contextmanager
def writing(place: Path, size: int) -> Iterator[None]:
    """Turn what the system says about a failed write into a sentence that helps."""
    try:
        yield
    except OSError as error:
        again = "type the same command again; what is complete is kept"
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            advice = f"free some space (or choose another place with -o) and {again}"
        elif error.errno == errno.EFBIG:
            advice = f"raise the limit of a file's size (ulimit -f) and {again}"
        elif error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
            advice = f"allow writing there (or choose another place with -o) and {again}"
        elif error.errno == errno.ENAMETOOLONG:
            advice = f"choose a place with a shorter name with -o and {again}"
        else:
            advice = f"see to that (or choose another place with -o) and {again}"
        reason = error.strerror or str(error)
        raise SpadError(f"{place}: cannot write up to {amount(size)} here: {reason}; {advice}") from error


@contextlib.contextmanager
def writing_file(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn what the system says about a failed write of one file into a sentence."""
    try:
        yield
    except OSError as error:
        raise SpadError(f"{path}: cannot be written ({error.strerror or error}); name another file") from None


def amount(size: float) -> str:
    """So many bytes in words: `512 bytes`, `3.2 MB`, `15 GB`."""
    if size < 10_000:
        return f"{size:.0f} bytes"
    unit, name = next(((unit, name) for unit, name in ((1e6, "MB"), (1e9, "GB")) if size < 999.5 * unit), (1e12, "TB"))
    return f"{size / unit:.3g} {name}"


@contextlib.contextmanager
def workspace(tmp: Path) -> Iterator[Path]:
    """A new folder of one's own, which is gone afterwards, whatever happens."""
    _make_folder(tmp)
    work = tmp / f"{os.getpid()}-{secrets.token_hex(8)}"
    os.mkdir(work)  # fails where the name exists
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _make_folder(folder: Path) -> None:
    """Make a folder and what is missing above it, so that it outlives a loss of power."""
    if folder.is_dir():
        return
    _make_folder(folder.parent)
    with contextlib.suppress(FileExistsError):  # another worker was faster
        os.mkdir(folder)
    system.synchronise(folder.parent)


def inside(root: Path, relative: str) -> Path:
    """`root / relative`, with the folders above it made, none of which may be a link to somewhere else."""
    folder = root
    for part in relative.split("/")[:-1]:
        folder = folder / part
        _make_folder(folder)
        if folder.is_symlink():
            raise SpadError(f"{folder}: this is a symbolic link; inside a dataset only real folders are written to")
    return root / relative


def _put(path: Path, pieces: Iterable[bytes], begin_syncing: Callable[[Path], None] | None = None) -> dict[str, Any]:
    """Write a new file (not yet synchronised as a whole); its size and SHA-256, taken from memory.

    The pieces come from a generator that compresses them, so that only one at a time is in memory: fresh
    memory for all of them would cost more time than the compression.

    Args:
        begin_syncing: called with the path after every `_SYNC_EVERY` bytes.
    """
    digest, size, handed_over = hashlib.sha256(), 0, 0
    with open(os.open(path, system.WRITE | os.O_CREAT | os.O_EXCL, 0o666), "wb") as file:
        for piece in pieces:
            digest.update(piece)
            size += len(piece)
            file.write(piece)
            if begin_syncing and size - handed_over >= _SYNC_EVERY:
                begin_syncing(path)
                handed_over = size
    return {"bytes": size, "sha256": digest.hexdigest()}


def put_tree(folder: Path, files: Mapping[str, Iterable[bytes]]) -> Files:
    """Write new files below a folder that is made here, and synchronise all that is in it.

    Other threads synchronise a file while the rest of it and the next ones are made, so that the processor does not
    wait for the disk.
    """
    folders = {folder}
    os.mkdir(folder)
    records = {}
    with ThreadPoolExecutor(_SYNCS_AT_ONCE) as pool:
        syncs: list[Future[None]] = []

        def begin_syncing(path: Path) -> None:
            if not syncs or syncs[-1].done():  # a disk that does not keep up is not asked again
                syncs.append(pool.submit(system.synchronise, path))

        for name, pieces in sorted(files.items()):
            path = folder / name
            missing = [parent for parent in path.parents if folder in parent.parents and parent not in folders]
            for parent in reversed(missing):
                os.mkdir(parent)
                folders.add(parent)
            records[name] = _put(path, pieces, begin_syncing)
            syncs.append(pool.submit(system.synchronise, path))
        syncs += [pool.submit(system.synchronise, parent) for parent in folders - {folder}]
        for sync in syncs:
            sync.result()
    return records


def install(new: Path, final: Path, aside: Path) -> None:
    """Rename a folder or file into its place; what stood there goes."""
    try:
        os.rename(new, final)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            raise
        # no full folder is replaced at once, nor a link by a folder; for a moment none is there
        os.rename(final, aside)
        try:
            os.rename(new, final)
        except OSError:
            os.rename(aside, final)
            raise
    system.synchronise(final.parent)
