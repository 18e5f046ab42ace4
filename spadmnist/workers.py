"""Workers: other Python processes, what they are told by their environment, and what is left where all were killed.

Arrays for workers are files of a temporary folder, and what workers wait for are semaphores of the system. A process
that is killed together with its workers leaves both. So all of one process bear the name of one folder, which it holds
locked for as long as it lives: the next process of the same user that works, with workers or alone, removes what nobody
holds.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import functools
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from joblib import Parallel

_MEMORY = Path("/dev/shm")  # files that are memory, and the semaphores of Linux
_LEAST = 2 << 30  # bytes of it, from which on arrays are put there
_PREFIX = "spadmnist-workers-"


def processors() -> int:
    """How many processors this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1


@contextlib.contextmanager
def workers(jobs: int, **options: Any) -> Iterator[Parallel]:
    """joblib's `Parallel` with these options, whose workers run no file of the current folder.

    They look for compiled kernels where this process does.
    """
    from joblib import Parallel

    from . import compiled

    clear_once(os.getpid())
    # what libraries warn programmers of is nothing for users; the tracker that cleans up behind workers does so, too
    debugging = os.environ.get("SPADMNIST_DEBUG")
    silence = "ignore:resource_tracker:UserWarning" if debugging else "ignore"
    quiet = {"PYTHONWARNINGS": os.environ.get("PYTHONWARNINGS", silence)}
    with safe_path(), _environment({**quiet, **compiled.for_workers()}):
        place = _own_place(os.getpid()) if jobs != 1 else None
        with Parallel(n_jobs=jobs, temp_folder=place, **options) as parallel:
            yield parallel


# --- what is left of the killed -----------------------------------------------------------------------------------


@functools.cache
def _own_place(process: int) -> str | None:
    """The folder of this process for its workers' arrays. None: the system's."""
    held = next(filter(None, map(_made, _places())), None)
    if held is None:
        return None
    folder, handle = held
    atexit.register(_end, folder, handle, process)  # joblib's own come later, and so are called before it
    if _MEMORY.is_dir():
        from joblib.externals.loky.backend.synchronize import SemLock

        names = SemLock._rand
        SemLock._rand = _Names(folder.name, names.names if isinstance(names, _Names) else names)
    return os.fspath(folder)


class _Names:
    """What semaphores are called: by the folder of their process."""

    def __init__(self, owner: str, names: Iterator[str]):
        self.owner, self.names = owner, names

    def __next__(self) -> str:
        return f"{self.owner}-{next(self.names)}"


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
                    os.close(held)
                    count += 1
    return count


def _places(all_of_them: bool = False) -> Iterator[Path]:
    """Where the folder may lie, as joblib chooses it."""
    if told := os.environ.get("JOBLIB_TEMP_FOLDER"):
        yield Path(told)
    with contextlib.suppress(OSError):
        space = os.statvfs(_MEMORY)
        if all_of_them or space.f_frsize * space.f_bavail > _LEAST:
            yield _MEMORY
    with contextlib.suppress(OSError):  # there is no folder for temporary files
        yield Path(tempfile.gettempdir())


def _made(place: Path) -> tuple[Path, int] | None:
    """A new folder and the handle that holds it; None where it cannot be made or be held."""
    try:
        while True:
            folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=place))
            if (handle := _held(folder)) is not None:
                return folder, handle
            if folder.exists():  # the file system knows no locks
                folder.rmdir()
                return None
    except OSError:
        return None


def _held(folder: Path) -> int | None:
    """A handle that holds a folder of this user alone; None where another process does, or it is no such folder."""
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        facts = os.fstat(handle)
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if facts.st_uid == os.geteuid() and os.path.samestat(facts, os.lstat(folder)):
            return handle
    except OSError:
        pass
    os.close(handle)
    return None


def _end(folder: Path, handle: int, process: int) -> None:
    """The end of the process that the folder belongs to; one that divided from it leaves it alone."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(handle)


def _remove(folder: Path) -> None:
    """A folder that this process holds, and the semaphores of its name."""
    with contextlib.suppress(OSError):
        for entry in list(os.scandir(_MEMORY)):
            if entry.name.startswith("sem.") and f"-{folder.name}-" in entry.name:
                with contextlib.suppress(OSError):
                    os.unlink(entry.path)
    shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def safe_path() -> Iterator[None]:
    """Keep the current folder off the path of every Python process that is started in here.

    `python -m` and `python -c` would put it there, before all libraries, and an empty entry of PYTHONPATH means it. An
    entry that names a folder is asked for, and stays.
    """
    entries = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    with _environment({"PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(filter(None, entries))}):
        yield


@contextlib.contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
