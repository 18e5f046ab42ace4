"""The folder of a process: what it needs for a while lies there, and what a killed one left is removed by the next.

A process holds its folder locked for as long as it lives. The next process of the same user that works, with workers or
alone, removes what nobody holds, with the semaphores that bear the folder's name. Workers of this machine put what they
need into the folder of the process that started them.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from . import system

SEMAPHORES = Path("/dev/shm")  # files that are memory, and the semaphores of Linux
_LEAST = 2 << 30  # bytes of it, from which on the folder is put there
_PREFIX = "spadmnist-workers-"
_PLACE = "SPADMNIST_WORKERS"  # names another place for the folder

_lent: dict[int, Path] = {}  # the folder of the process that started this one, by this process


@functools.cache
def own(process: int) -> Path | None:
    """The folder of this process, which is made; None where none can be made or be held."""
    if process in _lent:
        return _lent[process]
    held = next(filter(None, map(_made, _places())), None)
    if held is None:
        return None
    folder, lock = held
    atexit.register(_remove_own, folder, lock, process)
    return folder


def lend(folder: Path | None) -> None:
    """Let this process, a worker, use the folder of another one, which removes it."""
    if folder is not None:
        _lent[os.getpid()] = folder


def temporary(name: str) -> Path:
    """A new folder, which goes with this process at the latest. Raises OSError where there is no place for one."""
    folder = own(os.getpid())
    if folder is not None and not folder.is_dir():  # that of a parent which is no more
        folder = None
    made = Path(tempfile.mkdtemp(prefix=f"{name}-" if folder else f"spadmnist-{name}-", dir=folder))
    if folder is None:
        atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


@functools.cache
def clear_once(process: int) -> None:
    """Remove what killed processes left, the first time that this process asks for it."""
    clear()


def clear() -> int:
    """Remove what processes of this user left that are no more; of how many."""
    count = 0
    for place in dict.fromkeys(_places(all_of_them=True)):
        with contextlib.suppress(OSError):
            for entry in list(os.scandir(place)):
                if entry.name.startswith(_PREFIX) and (held := _held(Path(entry.path))) is not None:
                    _remove(Path(entry.path))
                    held.close()
                    count += 1
    return count


def _places(all_of_them: bool = False) -> Iterator[Path]:
    """Where the folder may lie."""
    if told := os.environ.get(_PLACE):
        yield Path(told)
    with contextlib.suppress(OSError):
        if all_of_them or shutil.disk_usage(SEMAPHORES).free > _LEAST:
            yield SEMAPHORES
    with contextlib.suppress(OSError):  # there is no folder for temporary files
        yield Path(tempfile.gettempdir())


def _made(place: Path) -> tuple[Path, system.Lock] | None:
    """A new folder, and its lock; None where it cannot be made or be held."""
    try:
        while True:
            folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=place))
            if (lock := _held(folder)) is not None:
                return folder, lock
            if folder.exists():  # the file system knows no locks
                folder.rmdir()
                return None
    except OSError:
        return None


def _held(folder: Path) -> system.Lock | None:
    """The lock of a folder of this user; None where another process has it, or it is no such folder."""
    if not system.LOCKS_FOLDERS or folder.is_symlink() or not folder.is_dir():
        return None
    try:
        lock = system.Lock(folder)
    except (OSError, system.Busy):
        return None
    if lock.is_own():
        return lock
    lock.close()
    return None


def _remove_own(folder: Path, lock: system.Lock, process: int) -> None:
    """The end of the process that the folder belongs to; one that divided from it leaves it alone."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
        lock.close()


def _remove(folder: Path) -> None:
    """A folder that this process holds, and the semaphores of its name."""
    with contextlib.suppress(OSError):
        for entry in list(os.scandir(SEMAPHORES)):
            if entry.name.startswith("sem.") and f"-{folder.name}-" in entry.name:
                with contextlib.suppress(OSError):
                    os.unlink(entry.path)
    shutil.rmtree(folder, ignore_errors=True)
