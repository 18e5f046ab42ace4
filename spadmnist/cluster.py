"""A cluster: the workers of a dask.distributed scheduler, as an executor.

The scheduler hands a task to another worker where one dies. What is sent is packed here and unpacked by a worker alone;
the scheduler sees bytes. Before its first task each worker answers a question, whose answer is known here: it must draw
the same numbers and write the same bytes as this machine. Who may speak to the scheduler may run code on its workers:
that is the protocol of dask.distributed, and its address is the user's choice.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import pickle
import queue
import re
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from typing import Any

from .errors import SpadError
from .heap import keep_freed_memory
from .workers import Executor

_ADDRESS = re.compile(r"(tcp|tls|ws|wss|ucx|inproc)://.+")
_CONNECT = 10.0  # s for the scheduler to answer; it is one process, and idle
_NO_WORKER = 60.0  # s without a single worker, after which the run ends; a batch system starts one in less, or not soon
_LOOK = 1.0  # s between two looks at how many workers there are
_FETCH = 5.0  # s for a result to come, before it is asked whether there are workers still
_YOUNG, _SETTLE = 30.0, 2.0  # s: a worker so young waits so long, for a nanny replaces none that dies as it starts
_END = 1.5  # s for the scheduler to take back tasks, and as many to part; Ctrl-C ends all within five


class Cluster(Executor):
    """The workers of a scheduler.

    Args:
        address: of the scheduler, tcp://HOST:PORT or tls://HOST:PORT.
        shared: its workers see the files of this machine under the same names.
        say: called with a sentence where a worker is waited for.
        patience: s to wait for a first worker, or for one where all have gone.
    Raises:
        SpadError: where dask.distributed is not installed, or the address is none.
    """

    chances = 1  # of four workers, on which the scheduler itself tries a task
    local = False

    def __init__(
        self,
        address: str,
        shared: bool = True,
        say: Callable[[str], None] = lambda what: None,
        patience: float = _NO_WORKER,
    ):
        if not _ADDRESS.fullmatch(address):
            raise SpadError(f"--cluster {address}: is no address of a scheduler; write tcp://HOST:PORT")
        try:
            import distributed  # noqa: F401
        except ImportError:
            raise SpadError(
                "--cluster: dask.distributed is not installed here; pip install 'spadmnist[cluster]', or leave it out"
            ) from None
        self.address, self.shared, self._say, self._patience = address, shared, say, patience
        self._client: Any = None
        self._greeting = pickle.dumps(None)
        self._under_way: set[Any] = set()
        self._looked = 0.0
        self._seen = time.monotonic()  # when there was a worker last

    def greet(self, question: Callable[[Any], tuple[str, str]], about: Any) -> None:
        """As `Executor.greet`."""
        self._greeting = pickle.dumps((question, about, question(about)))

    def close(self) -> None:
        """Part from the scheduler."""
        client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(Exception):
                client.close(timeout=_END)

    # --- what an executor is made of ---

    @contextlib.contextmanager
    def _opened(self, number: int) -> Iterator[None]:
        if self._client is None:
            self._client = self._connected()
        self._seen = time.monotonic()
        self._look()
        yield

    def _connected(self) -> Any:
        """A client of the scheduler. Raises SpadError where there is none, or one of another version."""
        import dask
        import distributed

        _hush()
        # a task holds the images of a shard: a graph of such a size is meant
        dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 TB"})
        try:
            client = distributed.Client(self.address, timeout=_CONNECT, set_as_default=False, name="spadmnist")
        except Exception as error:
            raise SpadError(
                f"--cluster {self.address}: no scheduler answers there ({_short(error)}); start one with `dask "
                "scheduler` and name the address that it says"
            ) from None
        _hush()
        try:
            there = client.get_versions()["scheduler"]["packages"].get("distributed")
        except Exception as error:
            there = _short(error)
        if there != distributed.__version__:
            with contextlib.suppress(Exception):
                client.close(timeout=_END)
            raise SpadError(
                f"--cluster {self.address}: the scheduler has dask.distributed {there}, and here is "
                f"{distributed.__version__}; install the same version here and there"
            )
        return client

    def _submit(self, function: Callable[[Any], Any], task: Any) -> Any:
        packed = pickle.dumps((function, task))
        with self._speaking():
            future = self._client.submit(
                _called, self._greeting, packed, key=f"spadmnist-{uuid.uuid4().hex}", pure=False
            )
        self._under_way.add(future)
        return _Future(future, self._look)

    def _next(self, ended: queue.SimpleQueue[Any]) -> Any:
        while True:
            try:
                future = ended.get(timeout=_LOOK)
            except queue.Empty:
                future = None
            if time.monotonic() - self._looked > _LOOK:
                self._look()
            if future is not None:
                self._under_way.discard(future.of)
                return future

    def _look(self) -> None:
        """How many threads are there now? Raises SpadError where there have been none for long."""
        with self._speaking():
            threads = sum(self._client.nthreads().values())
        now = self._looked = time.monotonic()
        self.threads = max(1, threads)
        if threads:
            self._seen = now
        elif now - self._seen > self._patience:
            raise SpadError(
                f"--cluster {self.address}: no worker has come in {self._patience:.0f} s; start some (`dask worker "
                f"{self.address} --nthreads 1`) and type the same command again: what is complete is kept"
            )
        elif now - self._seen < _LOOK / 2:
            self._say(f"No worker is at {self.address} yet; one is waited for, for {self._patience:.0f} s.")

    @contextlib.contextmanager
    def _speaking(self) -> Iterator[None]:
        """Turn what is raised where the scheduler does not answer into a sentence."""
        try:
            yield
        except SpadError:
            raise
        except Exception as error:
            raise self._lost(error) from None

    def _lost(self, error: BaseException) -> SpadError:
        return SpadError(
            f"--cluster {self.address}: the scheduler is gone ({_short(error)}); start it and its workers and type the "
            "same command again: what is complete is kept"
        )

    def _is_death(self, error: BaseException) -> bool:
        from distributed.client import FutureCancelledError
        from distributed.scheduler import KilledWorker

        if isinstance(error, FutureCancelledError):
            raise self._lost(error)
        return isinstance(error, KilledWorker)

    def _end(self) -> None:
        """Take back what has not begun; a worker ends its task of the moment, whose result nobody takes."""
        futures, self._under_way = list(self._under_way), set()
        client = self._client
        if client is not None:
            with contextlib.suppress(Exception):
                client.cancel(futures, force=True)
            self.close()


class _Future:
    """A future of the scheduler's, which calls back with itself."""

    def __init__(self, of: Any, look: Callable[[], None]):
        self.of, self._look = of, look

    def add_done_callback(self, call: Callable[[Any], None]) -> None:
        self.of.add_done_callback(lambda future: call(self))

    def result(self) -> Any:
        """The result, which is fetched from its worker; where that has died meanwhile, the task is done again.

        A connection that breaks on the way is no end: whether the scheduler is there is asked anew.
        """
        while True:
            try:
                result = self.of.result(timeout=_FETCH)
            except (TimeoutError, OSError):
                if self.of.status == "error":  # it is the task's own
                    raise
                self._look()
            else:
                self.of.release()
                return result


def _hush() -> None:
    """dask.distributed writes of every worker that dies; what matters is said here."""
    heads = ("distributed", "tornado", "asyncio")
    for name in [*heads, *(name for name in logging.root.manager.loggerDict if name.split(".")[0] in heads)]:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def _short(error: object) -> str:
    said = " ".join(str(error).split()) or type(error).__name__
    return said if len(said) <= 120 else said[:117] + "..."


# --- in a worker --------------------------------------------------------------------------------------------------

_arrival = threading.Lock()
_welcome: set[bytes] = set()


def _called(greeting: bytes, packed: bytes) -> Any:
    """A task, in a worker that has answered as this machine would."""
    host = socket.gethostname()
    try:
        asked = pickle.loads(greeting)
        function, task = pickle.loads(packed)
    except (ImportError, AttributeError, TypeError) as error:
        raise SpadError(
            f"a worker on {host} has another spadmnist ({_short(error)}); install the same one there"
        ) from None
    with _arrival:
        digest = hashlib.sha256(greeting).digest()
        if digest not in _welcome:
            keep_freed_memory()
            if _age() < _YOUNG:
                time.sleep(_SETTLE)
            if asked is not None:
                _ask(host, *asked)
            _welcome.add(digest)
    return function(task)


def _age() -> float:
    """How long this process has lived, s."""
    import psutil  # distributed brings it

    return time.time() - psutil.Process().create_time()


def _ask(host: str, question: Callable[[Any], tuple[str, str]], about: Any, known: tuple[str, str]) -> None:
    answer = question(about)
    if answer[0] != known[0]:
        raise SpadError(
            f"the worker {os.getpid()} on {host} makes other bytes than this machine: there {answer[1]}; here "
            f"{known[1]}; give it the same versions, or leave it out"
        )
