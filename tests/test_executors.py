"""The contract of an executor, for each of them: this process, processes of this machine, a cluster, and a stand-in.

The stand-in does tasks in this process as soon as they are handed out; for it a task that kills is one that says so.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from loky.backend.process import LokyProcess

from spadmnist.errors import SpadError
from spadmnist.workers import Executor, Loky, Serial

sys.path.append(str(Path(__file__).parents[1] / "scripts"))
import scale


class Death(Exception):
    """A worker of the stand-in has died."""


class StandIn(scale.StandIn):
    threads = 4
    local = Executor.local

    def _is_death(self, error: BaseException) -> bool:
        return isinstance(error, Death)


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    distributed = pytest.importorskip("distributed", reason="the cluster's library is not installed")
    dask = pytest.importorskip("dask")
    quiet = {"silence_logs": 60, "dashboard_address": None, "host": "127.0.0.1"}
    # a task is lost with its second worker, and not with its fourth: a test need not wait for as many to start again
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, **quiet) as cluster,
    ):
        yield cluster.scheduler_address


@pytest.fixture(params=["serial", "loky", pytest.param("cluster", marks=pytest.mark.slow), "stand-in"])
def workers(request: pytest.FixtureRequest) -> Iterator[Executor]:
    if request.param == "cluster":
        from spadmnist.cluster import Cluster

        found: Executor = Cluster(request.getfixturevalue("scheduler"))
    else:
        found = {"serial": Serial, "loky": lambda: Loky(2), "stand-in": StandIn}[request.param]()
    with found:
        yield found


def kill(where: int) -> None:
    """Kill this process; in that of the test itself, say so."""
    if os.getpid() == where:
        raise Death
    os.kill(os.getpid(), signal.SIGKILL)


# --- tasks --------------------------------------------------------------------------------------------------------


def square(number: int) -> int:
    return number * number


def fail_at_three(number: int) -> int:
    if number == 3:
        raise SpadError("three is not possible")
    if number == 10:
        time.sleep(20)
    return number


def kill_once(task: tuple[int, str, int]) -> int:
    number, marker, here = task
    if number == 2:
        try:
            os.close(os.open(marker, os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            return number
        kill(here)
    return number


def kill_at_two(task: tuple[int, int]) -> int:
    if task[0] == 2:
        kill(task[1])
    return task[0]


def kill_always(here: int) -> None:
    kill(here)


# --- the contract -------------------------------------------------------------------------------------------------


def test_each_key_is_done_once_and_tasks_are_made_as_they_are_called_for(workers: Executor) -> None:
    made, found = [0], {}
    most = 0

    def make(keys: Any) -> Iterator[int]:
        for key in keys:
            made[0] += 1
            yield int(key)

    def done(key: str, result: int) -> None:
        nonlocal most
        assert key not in found
        found[key] = result
        most = max(most, made[0] - len(found) + 1)

    workers.run(square, make, [str(n) for n in range(50)], done)
    assert found == {str(n): n * n for n in range(50)}
    assert most <= 2 * workers.threads
    workers.run(square, make, [], done)  # of nothing, nothing


def test_an_error_of_a_task_ends_the_run_at_once(workers: Executor) -> None:
    """The same error, though another task takes 20 seconds still."""
    done: dict[int, int] = {}
    keys = [3] if isinstance(workers, Serial | StandIn) else [10, 3, *range(20, 40)]
    started = time.monotonic()
    with pytest.raises(SpadError, match=r"^three is not possible$"):
        workers.run(fail_at_three, iter, keys, done.__setitem__)
    assert time.monotonic() - started < 15
    assert 10 not in done and 3 not in done
    again: dict[int, int] = {}
    workers.run(square, iter, [5], again.__setitem__)  # and they can be worked with again
    assert again == {5: 25}


def test_an_error_with_a_result_is_passed_on(workers: Executor) -> None:
    def done(key: int, result: int) -> None:
        raise ZeroDivisionError(key)

    with pytest.raises(ZeroDivisionError, match="7"):
        workers.run(square, iter, [7], done)


def test_what_a_dead_worker_lost_is_done_by_another(workers: Executor, tmp_path: Path) -> None:
    if isinstance(workers, Serial):
        pytest.skip("it has no worker that could die alone")
    found: dict[int, int] = {}
    marker, here = str(tmp_path / "marker"), os.getpid()
    workers.run(kill_once, lambda keys: ((key, marker, here) for key in keys), range(12), found.__setitem__)
    assert os.path.exists(marker) and found == {n: n for n in range(12)}


def test_a_task_that_kills_is_named_when_all_others_are_done(workers: Executor) -> None:
    if isinstance(workers, Serial):
        pytest.skip("it has no worker that could die alone")
    found: dict[int, int] = {}
    with pytest.raises(SpadError, match=r"a worker died each time it made 2 .*all else is complete"):
        workers.run(kill_at_two, lambda keys: ((key, os.getpid()) for key in keys), range(8), found.__setitem__)
    assert found == {n: n for n in range(8) if n != 2}


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["loky", "stand-in"], indirect=True)
def test_where_all_workers_die_not_every_task_is_tried(workers: Executor) -> None:
    tried = 0

    def make(keys: Any) -> Iterator[int]:
        nonlocal tried
        for _ in keys:
            tried += 1
            yield os.getpid()

    with pytest.raises(SpadError, match=r"a worker died each time it made .*what is complete is kept"):
        workers.run(kill_always, make, range(1000), lambda key, result: None)
    assert tried < 50


@pytest.mark.skipif(os.name != "posix", reason="a worker is started by what sys.executable names")
def test_workers_that_cannot_start_are_not_blamed_on_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    Loky(2)._end()  # those that are there
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(SpadError, match=r"every worker .* status 1, and nothing was made; give --jobs 1"):
        Loky(2).run(square, iter, range(4), lambda key, result: None)


@pytest.mark.slow
def test_a_task_that_ends_its_worker_is_not_blamed_on_memory() -> None:
    with pytest.raises(SpadError, match=r"each time it made 2 \(ended by itself with status 3\); all else is complete"):
        Loky(2).run(leave_at_two, iter, range(4), lambda key, result: None)


@pytest.mark.slow
def test_a_worker_that_keeps_memory_is_no_leak(recwarn: pytest.WarningsRecorder) -> None:
    Loky(1)._end()
    found: dict[int, tuple[int, int]] = {}
    Loky(1).run(memory_of, iter, range(6), found.__setitem__)
    assert len({process for process, _ in found.values()}) == 1 and not [str(w.message) for w in recwarn.list]


# --- scale --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_hundred_thousand_tasks() -> None:
    """More than 500 a second, in less than 1 GB more than the tests before have taken."""
    found: dict[int, int] = {}
    started, before = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # KiB
    StandIn().run(square, iter, range(100_000), found.__setitem__)
    assert time.monotonic() - started < 200
    assert len(found) == 100_000 and resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1 << 20


def memory_of(number: int) -> tuple[int, int]:
    """(this process, bytes that it holds from now on)."""
    held.append(b"x" * (400 << 20) if number == 2 else b"")  # what a worker had before is not counted
    time.sleep(1.2)  # loky looks once a second
    return os.getpid(), sum(map(len, held))


held: list[bytes] = []


def leave_at_two(number: int) -> None:
    if number == 2:
        os._exit(3)


def which(_: object) -> int:
    time.sleep(0.05)
    return os.getpid()


def test_workers_that_are_started_ahead_do_the_tasks_and_end_with_an_error() -> None:
    def alive() -> set[int | None]:
        return {one.pid for one in multiprocessing.active_children() if isinstance(one, LokyProcess)}

    Loky(2)._end()  # what other tests have left
    with pytest.raises(SpadError, match="before"), Loky(2) as workers:
        workers.start("spadmnist.no_such_module")  # its own error is that of the task that needs it
        started = alive()
        assert len(started) == 2
        by: list[int] = []
        workers.run(which, iter, range(6), lambda key, result: by.append(result))
        assert set(by) <= started and alive() == started
        raise SpadError("before any task")
    assert not alive()
