"""What differs between systems: locks, flags of files, limits, and how a process ends with its parent.

Linux and macOS have all of it. Where a part is absent (Windows), its stand-in is here, and no other module asks.
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
import signal
import stat
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

_fcntl: ModuleType | None
_resource: ModuleType | None
try:
    import fcntl as _fcntl
except ImportError:
    _fcntl = None
try:
    import resource as _resource
except ImportError:
    _resource = None

# Flags of `os.open`; 0 where there is no such flag. READ and WRITE take the bytes as they are.
_BYTES = getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
READ, WRITE, BOTH = os.O_RDONLY | _BYTES, os.O_WRONLY | _BYTES, os.O_RDWR | _BYTES
NO_LINK = getattr(os, "O_NOFOLLOW", 0)
NO_WAIT = getattr(os, "O_NONBLOCK", 0)
_FOLDER = getattr(os, "O_DIRECTORY", 0)
_FOLDERS_OPEN = hasattr(os, "O_DIRECTORY")  # a folder can be opened, locked and synchronised

SHARED_LOCKS = _fcntl is not None  # several processes can hold one lock
LOCKS_FOLDERS = _fcntl is not None and _FOLDERS_OPEN  # whether a folder itself can be locked

_KILL = getattr(signal, "SIGKILL", signal.SIGTERM)  # which is as hard where there is no SIGKILL
_PDEATHSIG = 1  # of prctl: the signal that comes when the parent ends
_LARGE_FILE = 1 << 20  # bytes, from which on a written file is dropped from the page cache


# --- locks --------------------------------------------------------------------------------------------------------


class Busy(Exception):
    """Another process holds the lock."""


class Lock:
    """A file or a folder that this process holds; the system lets go of it where the process is killed.

    With `fcntl` the path itself is locked. Without it, a file in the same folder is locked (filelock); it locks nobody
    out once its process has ended.

    Args:
        path: a folder that is there, or a file, which is made where there is none. A link is refused.
        shared: other processes may hold it as well, if they all say so.
        wait: for who holds it.
    Raises:
        Busy: another process holds it.
        NotImplementedError: it is to be shared, and this system has no such lock.
        OSError: it cannot be opened, or its file system knows no locks.
    """

    def __init__(self, path: Path, shared: bool = False, wait: bool = False):
        self._handle, self._beside = -1, None
        if _fcntl is not None:
            self._handle = _locked(path, shared, wait)
            return
        if shared:
            raise NotImplementedError("this system has no lock that is shared; see SHARED_LOCKS")
        import filelock

        self._beside = filelock.FileLock(path.with_name(f"{path.name}.lock"), timeout=-1 if wait else 0)
        try:
            self._beside.acquire()
        except filelock.Timeout:
            raise Busy(str(path)) from None

    def make_sole(self) -> bool:
        """Make a shared lock one that is held alone. False where others hold it, too."""
        if _fcntl is not None:
            try:
                _fcntl.flock(self._handle, _fcntl.LOCK_EX | _fcntl.LOCK_NB)
            except BlockingIOError:
                return False
        return True

    def is_own(self) -> bool:
        """Does what is held belong to the user of this process?"""
        return self._beside is not None or is_own(os.fstat(self._handle))

    def close(self) -> None:
        """Let go of it."""
        if self._beside is not None:
            self._beside.release()
        elif self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

    def __enter__(self) -> Lock:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _locked(path: Path, shared: bool, wait: bool) -> int:
    """A handle that holds what lies at a path now."""
    assert _fcntl is not None
    kind = (_fcntl.LOCK_SH if shared else _fcntl.LOCK_EX) | (0 if wait else _fcntl.LOCK_NB)
    flags = READ | _FOLDER if path.is_dir() else BOTH | os.O_CREAT | NO_WAIT
    while True:
        handle = os.open(path, flags | NO_LINK, 0o666)
        try:
            _fcntl.flock(handle, kind)
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(handle), os.lstat(path)):
                    return handle
        except BlockingIOError:
            os.close(handle)
            raise Busy(str(path)) from None
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)  # who held it has removed or renamed it meanwhile: what is locked is nobody's lock


# --- files --------------------------------------------------------------------------------------------------------


def is_own(facts: os.stat_result) -> bool:
    """Whether a file or folder is this user's; where files name no user, all of them are."""
    return not hasattr(os, "geteuid") or facts.st_uid == os.geteuid()


def is_private(facts: os.stat_result) -> bool:
    """Whether something is a folder of this user's that is closed to others, as far as its mode can tell."""
    return stat.S_ISDIR(facts.st_mode) and (
        not hasattr(os, "geteuid") or (facts.st_uid == os.geteuid() and not facts.st_mode & 0o077)
    )


def user() -> str:
    """What tells this user's folders from those of others."""
    if hasattr(os, "getuid"):
        return str(os.getuid())
    import getpass

    return getpass.getuser()


def synchronise(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on disk; of folders that cannot be opened nothing is done."""
    if not _FOLDERS_OPEN and path.is_dir():
        return
    handle = os.open(path, READ if _FOLDERS_OPEN else BOTH)  # elsewhere only what can be written is synchronised
    try:
        os.fsync(handle)
        if hasattr(os, "posix_fadvise") and os.fstat(handle).st_size >= _LARGE_FILE:
            # what is safe on disk need not push others' data out of memory; its pages serve the next shard
            os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
    finally:
        os.close(handle)


def open_below(root: Path, parts: list[str], folder: bool = False) -> int:
    """A handle of a file or a folder below `root`, with no link on the way from there.

    Raises OSError where there is a link, or no such thing; of folders too where they cannot be opened.
    """
    if os.open not in os.supports_dir_fd:
        at = root
        for part in parts:
            at = at / part
            if at.is_symlink() or getattr(os.path, "isjunction", lambda at: False)(at):
                raise OSError(f"{at} is a link")
        return os.open(at, READ)
    handle = os.open(root, READ | _FOLDER)
    try:
        for i, part in enumerate(parts):
            kind = _FOLDER if folder or i < len(parts) - 1 else NO_WAIT  # never wait for a pipe
            above, handle = handle, os.open(part, READ | NO_LINK | kind, dir_fd=handle)
            os.close(above)
    except OSError:
        os.close(handle)
        raise
    return handle


def folders_in(root: Path, parts: list[str]) -> list[str]:
    """The names of the folders in a folder below `root`, sorted; see `open_below`."""
    if os.scandir not in os.supports_fd or os.open not in os.supports_dir_fd:
        with os.scandir(root.joinpath(*parts)) as entries:
            return sorted(entry.name for entry in entries if entry.is_dir(follow_symlinks=False))
    handle = open_below(root, parts, True)
    try:
        with os.scandir(handle) as entries:
            return sorted(entry.name for entry in entries if entry.is_dir(follow_symlinks=False))
    finally:
        os.close(handle)


_reading = threading.Lock()


def read_at(handle: int, offset: int, length: int) -> bytes:
    """The bytes of a file from `offset` on; threads may share the handle."""
    if hasattr(os, "pread"):
        return os.pread(handle, length, offset)
    with _reading:
        os.lseek(handle, offset, os.SEEK_SET)
        return os.read(handle, length)


# --- limits -------------------------------------------------------------------------------------------------------


_GROUPS = Path("/sys/fs/cgroup")  # where Linux shows its control groups, and which of them this process is in
_OWN_GROUPS = Path("/proc/self/cgroup")


@functools.lru_cache(maxsize=4)
def _granted(groups: Path, own: Path) -> tuple[float, float]:
    """(processors, bytes of memory) that the control groups of this process grant it; inf where they do not say.

    A container, or a job of a batch system, is such a group. Each group on the way from this process's own to the first
    one can limit it, in version 2 as in version 1.
    """
    processors, memory = [math.inf], [math.inf]
    for line in _words(own).splitlines():
        if line.count(":") < 2:
            continue
        _, kinds, path = line.split(":", 2)  # of version 2 no kinds
        parts = [part for part in path.split("/") if part not in ("", ".", "..")]
        roots = [groups / name for name in (kinds, *kinds.split(","))] if kinds else [groups, groups / "unified"]
        for folder in (root.joinpath(*parts[:n]) for root in roots for n in range(len(parts) + 1)):
            shares = (
                _words(folder / "cpu.max").split(),
                [_words(folder / f"cpu.cfs_{x}_us") for x in ("quota", "period")],
            )
            for quota, period in (map(_number, share) for share in shares if len(share) == 2):
                processors.append(quota / period if period < math.inf else math.inf)
            memory += [_number(_words(folder / name)) for name in ("memory.max", "memory.limit_in_bytes")]
    return min(processors), min(memory)


def _words(file: Path) -> str:
    try:
        return file.read_text()
    except (OSError, ValueError):  # there is no such file, or it is not this user's to read
        return ""


def _number(text: str) -> float:
    """A positive whole number; inf of anything else: `max` and -1 mean no limit."""
    text = text.strip()
    return int(text) if text.isascii() and text.isdecimal() and int(text) else math.inf


def processors() -> int:
    """How many processors this process may use, 1 or more; a part of one that a container has counts as one."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return math.ceil(min(there, _granted(_GROUPS, _OWN_GROUPS)[0]))


def address_space() -> int | None:
    """The limit of this process's addresses, bytes (ulimit -v); None without one."""
    if _resource is None:
        return None
    limit: int = _resource.getrlimit(_resource.RLIMIT_AS)[0]
    return None if limit == _resource.RLIM_INFINITY else limit


def memory() -> int:
    """Bytes that this machine, its container, or the limit of this process, has for all of it."""
    if hasattr(os, "sysconf"):
        whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    else:
        import psutil

        whole = int(psutil.virtual_memory().total)
    limit = address_space()
    whole = whole if limit is None else min(whole, limit)
    return int(min(whole, _granted(_GROUPS, _OWN_GROUPS)[1]))


# --- processes ----------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def without_interrupt() -> Iterator[None]:
    """Keep Ctrl-C from this thread, and from the processes that it starts, in here; where signals can be kept."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with(parent: int) -> None:
    """Let this process end with its parent, where the system can be asked for that (Linux); at once if it has ended."""
    if sys.platform == "linux":
        import ctypes

        with contextlib.suppress(AttributeError):  # a C library without it
            ctypes.CDLL(None).prctl(_PDEATHSIG, _KILL)
    if os.getppid() != parent:
        os._exit(1)


def kill(process: int) -> None:
    """End a process at once; one that has ended already is let be."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(process, _KILL)
