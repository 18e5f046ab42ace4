"""Workers: what calls a function for many tasks, one by one, at once, or on a cluster.

An `Executor` is one of three: `Serial` (this process), `Loky` (processes of this machine), `cluster.Cluster` (the
workers of a dask.distributed scheduler). They keep one contract, that of `Executor.run`: the loop over the tasks stands
here once, and an executor says how a task is handed to a worker, and which errors mean that the worker died.

Processes that were killed together with their workers leave semaphores of the system. So all of one process bear the
name of its folder (`leftovers`), and go with what else a killed one left.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import math
import os
import queue
import re
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from . import leftovers, system
from .errors import SpadError

Make = Callable[[Sequence[Any]], Iterator[Any]]  # keys -> the task of each, made when it is called for
Done = Callable[[Any, Any], None]  # called with a key and its result

_IDLE = 300  # s without a task, after which a worker ends; a verb's next tasks come sooner
_IN_A_ROW = 3  # deaths, without a result between, after which workers are taken to die of whatever they are given
_AHEAD = 8  # workers at most that are started before it is known how many tasks there are; the others come with these
_STATUS = re.compile(r"\b[A-Z]+\((-?\d+)\)")  # how loky says that a worker ended: EXIT(1); a signal is negative
# the variables by which libraries are told how many threads they may use
_THREADS = (
    *(f"{name}_NUM_THREADS" for name in ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMBA", "NUMEXPR")),
    "VECLIB_MAXIMUM_THREADS",
)

# loky ends a worker that has grown by 300 MB and starts another one; here workers keep freed memory on purpose
_NO_LEAK = {"LOKY_MAX_MEMORY_LEAK_SIZE": os.environ.get("LOKY_MAX_MEMORY_LEAK_SIZE", "1e18")}  # bytes


def executor(jobs: int | Executor) -> Executor:
    """The executor that works with so many processes of this machine; one that is an executor already is returned."""
    if isinstance(jobs, Executor):
        return jobs
    return Serial() if jobs == 1 else Loky(jobs)


# --- the contract -------------------------------------------------------------------------------------------------


class Executor:
    """Calls a function for many tasks.

    A subclass defines `_opened`, `_submit`, `_is_death` and `_end`, or `run` itself.

    Attributes:
        threads: how many tasks are done at a time.
        chances: how often a task may be lost with its worker before it is tried alone.
        local: its workers are processes of this machine.
        shared: its workers see the files of this machine.
        apart: its workers are other processes.
    """

    threads = 1
    chances = 3
    local = True
    shared = True
    apart = True

    def run(self, function: Callable[[Any], Any], make: Make, keys: Sequence[Any], done: Done) -> None:
        """Call `function` on the task of every key, and `done(key, result)` for each, as they end.

        A task that is lost with its worker is tried again, at last alone: one that kills its worker each time is named
        when all others are done. Whatever a task or `done` raises, and Ctrl-C, is passed on at once; then no worker of
        this machine is left at work.

        Args:
            function: of a module, where workers find it.
            make: makes the tasks of keys, which are called for one by one: twice as many as there are threads.
            keys: they name the tasks in messages; each is there once.
            done: is called in this process, once for each key.
        Raises:
            SpadError: where a task kills its worker, or there are no workers any more.
        """
        with self._opened(len(keys)):
            try:
                self._all(function, make, keys, done)
            except BaseException:
                self._end()
                raise

    def greet(self, question: Callable[[Any], tuple[str, str]], about: Any) -> None:
        """Ask each worker of another machine first; one that answers otherwise than this process gets no task.

        Args:
            question: of a module; it answers a digest and, in words, by what it was made.
            about: what it is asked, which can be hashed.
        """

    def start(self, module: str) -> None:
        """Start workers of this machine, which import a module until tasks come. Nothing is waited for.

        Within `with`, an error before the first task ends them.
        """

    def limited(self, most: int) -> Executor:
        """The executor that does at most so many tasks at a time on this machine; other machines have their own."""
        return self

    def close(self) -> None:
        """Let go of the workers of other machines."""

    def __enter__(self) -> Executor:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- the loop ---

    def _all(self, function: Callable[[Any], Any], make: Make, keys: Sequence[Any], done: Done) -> None:
        deaths: Counter[Any] = Counter()
        waiting, alone, hopeless, any_done = list(keys), [], False, False

        def counted(key: Any, result: Any) -> None:
            nonlocal any_done
            any_done = True
            done(key, result)

        while waiting and not hopeless:
            patience: float = _IN_A_ROW * 2 * self.threads
            lost, waiting = self._pass(function, make, waiting, counted, lambda: 2 * self.threads, patience)
            hopeless = bool(waiting)
            deaths.update(lost.keys())
            alone += [key for key in lost if deaths[key] >= self.chances]
            waiting += [key for key in lost if deaths[key] < self.chances]
        patience = _IN_A_ROW if hopeless else math.inf
        killers, left = self._pass(function, make, [*waiting, *alone], counted, lambda: 1, patience)
        if killers:
            by_itself = self._by_itself(killers.values())
            if by_itself and not any_done:
                raise SpadError(
                    f"every worker of this machine {by_itself}, and nothing was made; give --jobs 1, which needs no "
                    "workers, or see that this user may read and run this Python and its packages"
                )
            rest = "what is complete is kept" if left else "all else is complete"
            cure = "mend what ends it" if by_itself else "free some memory or give fewer --jobs"
            raise SpadError(
                f"a worker died each time it made {', '.join(map(str, killers))} ({by_itself or 'out of memory?'}); "
                f"{rest}: {cure}, and type the same command again"
            )

    def _pass(
        self,
        function: Callable[[Any], Any],
        make: Make,
        keys: Sequence[Any],
        done: Done,
        window: Callable[[], int],
        patience: float,
    ) -> tuple[dict[Any, Exception], list[Any]]:
        """Try each key once; (those lost with their workers and what was raised, those that were not tried).

        Args:
            window: how many tasks are handed out at a time.
            patience: how many may be lost in a row before no more is tried.
        """
        left, tasks, in_a_row = deque(keys), make(keys), 0
        lost: dict[Any, Exception] = {}
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        under_way: dict[Any, Any] = {}
        while True:
            while left and in_a_row < patience and len(under_way) < window():
                future = self._submit(function, next(tasks))
                under_way[future] = left.popleft()
                future.add_done_callback(ended.put)
            if not under_way:
                return lost, list(left)
            future = self._next(ended)
            key = under_way.pop(future)
            try:
                result = future.result()
            except Exception as error:
                if not self._is_death(error):
                    raise
                in_a_row += 1
                lost[key] = error
                continue
            in_a_row = 0
            done(key, result)

    # --- what an executor is made of ---

    def _opened(self, number: int) -> contextlib.AbstractContextManager[None]:
        """Within it `number` tasks are submitted."""
        return contextlib.nullcontext()

    def _submit(self, function: Callable[[Any], Any], task: Any) -> Any:
        """A future, with `add_done_callback` and `result`, of a task handed to a worker."""
        raise NotImplementedError

    def _next(self, ended: queue.SimpleQueue[Any]) -> Any:
        """The next future that has ended; it is waited for."""
        return ended.get()

    def _is_death(self, error: BaseException) -> bool:
        """Does what a future raised say that its worker died?"""
        raise NotImplementedError

    def _by_itself(self, deaths: Iterable[Exception]) -> str:
        """In words, how workers ended of which none was killed; empty where one was, or where it is not known."""
        return ""

    def _end(self) -> None:
        """End what is under way."""


# --- on this machine ----------------------------------------------------------------------------------------------


class Serial(Executor):
    """One task after the other, in this process."""

    apart = False

    def run(self, function: Callable[[Any], Any], make: Make, keys: Sequence[Any], done: Done) -> None:
        """As `Executor.run`; a task that kills takes this process with it."""
        from .heap import keep_freed_memory

        leftovers.clear_once(os.getpid())
        keep_freed_memory()
        for key, task in zip(keys, make(keys), strict=True):
            done(key, function(task))


class Loky(Executor):
    """Processes of this machine, which idle for a while after a run and are there for the next one.

    They run no file of the current folder, look for compiled kernels where this process does, leave Ctrl-C to it, and
    die with it.
    """

    def __init__(self, jobs: int):
        self.threads = jobs
        self._started = 0

    def limited(self, most: int) -> Executor:
        # fewer workers are other ones; those that are too many end as the first task is given to the others
        return self if most >= self.threads else Loky(max(1, most))

    def start(self, module: str) -> None:
        """As `Executor.start`; one that cannot be started is missed by the first task, which says so."""
        few = min(self.threads, _AHEAD)
        with contextlib.suppress(OSError, RuntimeError), self._opened(few):
            for _ in range(few):
                self._submit(_imported, module)

    def __exit__(self, *raised: object) -> None:
        if self._started and raised[0] is not None:
            self._end()

    @contextlib.contextmanager
    def _opened(self, number: int) -> Iterator[None]:
        from . import compiled

        # what libraries warn programmers of is nothing for users; the tracker that cleans up behind workers warns, too
        debugging = os.environ.get("SPADMNIST_DEBUG")
        silence = "ignore:resource_tracker:UserWarning" if debugging else "ignore"
        quiet = {"PYTHONWARNINGS": os.environ.get("PYTHONWARNINGS", silence)}
        with safe_path(), _environment({**quiet, **compiled.for_workers()}):
            leftovers.clear_once(os.getpid())
            _name_semaphores(os.getpid())
            self._started = max(self._started, min(self.threads, number))
            # a worker that ends when it is idle, as it should, while a task comes: loky starts another one
            warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
            # and one that it takes to leak, where it keeps freed memory: of a loky that does not know _NO_LEAK
            warnings.filterwarnings("ignore", "A worker was restarted while some jobs", UserWarning)
            # those that were started before are still importing while more of them are asked for
            warnings.filterwarnings("ignore", "Trying to resize an executor with running jobs", UserWarning)
            yield

    def _submit(self, function: Callable[[Any], Any], task: Any) -> Any:
        import multiprocessing.resource_tracker

        from loky import get_reusable_executor
        from loky.backend import resource_tracker

        for tracker in (resource_tracker, multiprocessing.resource_tracker):  # may unblock the signal as they start
            tracker.ensure_running()
        each = str(max(1, system.processors() // self.threads))
        options: dict[str, Any] = {
            "timeout": _IDLE,
            "initializer": _start_worker,
            "initargs": (os.getpid(), leftovers.own(os.getpid())),
            "env": {**{name: os.environ.get(name, each) for name in _THREADS}, **_NO_LEAK},
        }
        # workers, which this may start, never see Ctrl-C: not while they import what they need, either
        with system.without_interrupt():
            while True:
                try:
                    return get_reusable_executor(self._started, **options).submit(function, task)
                except Exception as error:
                    if not self._is_death(error):  # of another task, just now: the next workers are new ones
                        raise

    def _is_death(self, error: BaseException) -> bool:
        from loky.process_executor import TerminatedWorkerError

        return isinstance(error, TerminatedWorkerError)

    def _by_itself(self, deaths: Iterable[Exception]) -> str:
        statuses = {int(status) for death in deaths for status in _STATUS.findall(str(death))}
        if not statuses or min(statuses) < 0:  # a negative one is a signal
            return ""
        return f"ended by itself with status {', '.join(map(str, sorted(statuses)))}"

    def _end(self) -> None:
        import multiprocessing

        from loky import get_reusable_executor
        from loky.backend.process import LokyProcess

        with contextlib.suppress(OSError, RuntimeError):  # where no process or thread could be started
            get_reusable_executor(reuse=True).shutdown(wait=True, kill_workers=True)
        for process in multiprocessing.active_children():
            if isinstance(process, LokyProcess) and process.pid is not None:  # started before the one that could not be
                system.kill(process.pid)
                process.join()


def _imported(module: str) -> None:
    importlib.import_module(module)


def _start_worker(parent: int, folder: Path | None) -> None:
    """Leave Ctrl-C to the parent, and die with it: an orphan must not go on writing. folder: of the parent."""
    import signal

    from .heap import keep_freed_memory

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    system.end_with(parent)
    leftovers.lend(folder)
    keep_freed_memory()


# --- semaphores ---------------------------------------------------------------------------------------------------


@functools.cache
def _name_semaphores(process: int) -> None:
    """Give the semaphores of this process the name of its folder; where that cannot be made, they keep theirs."""
    folder = leftovers.own(process)
    if folder is not None and leftovers.SEMAPHORES.is_dir():
        from loky.backend.synchronize import SemLock

        names = SemLock._rand
        SemLock._rand = _Names(folder.name, names.names if isinstance(names, _Names) else names)


class _Names:
    """What semaphores are called: by the folder of their process."""

    def __init__(self, owner: str, names: Iterator[str]):
        self.owner, self.names = owner, names

    def __next__(self) -> str:
        return f"{self.owner}-{next(self.names)}"


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
