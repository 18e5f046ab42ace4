"""A cluster makes the same bytes as this machine, whoever dies, and says in one sentence what is wrong with it."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from commands import run
from labs import labs
from test_factory import METHODS, assert_same, assert_sentence, descendants, make, tree, wait_for, write_config

from spadmnist import config, factory, golden, plugins, verify
from spadmnist.errors import SpadError
from spadmnist.inference.comparison import canonical, compare
from spadmnist.store import Encoding
from spadmnist.workers import Serial

distributed = pytest.importorskip("distributed", reason="the cluster's library is not installed")
from spadmnist.cluster import Cluster, _Future  # noqa: E402

pytestmark = pytest.mark.slow
FREE = "tcp://127.0.0.1:9"  # the port of `discard`, where no scheduler is


class Site:
    """A scheduler and workers in processes of their own, as a site would have them."""

    def __init__(self, workers: int, threads: int = 1, options: tuple[str, ...] = ()):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{port}"
        self.scheduler = self._started("scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
        self.workers = [
            self._started("worker", self.address, "--nthreads", str(threads), "--no-dashboard", *options)
            for _ in range(workers)
        ]

    def _started(self, *words: str) -> psutil.Popen:
        command = [sys.executable, "-m", "distributed.cli.dask_" + words[0], *words[1:]]
        return psutil.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)

    def processes(self) -> list[psutil.Process]:
        """Those that do tasks."""
        return [child for nanny in self.workers for child in descendants(nanny) if "spawn_main" in str(child.cmdline())]

    def end(self) -> None:
        for process in (*self.workers, self.scheduler):
            for one in (*descendants(process), process):
                try:
                    one.kill()
                except psutil.NoSuchProcess:
                    continue
            process.wait(10)


@pytest.fixture(scope="module")
def site() -> Iterator[Site]:
    found = Site(workers=2)
    yield found
    found.end()


@pytest.fixture
def cluster(site: Site) -> Iterator[Cluster]:
    with Cluster(site.address) as found:
        yield found


def on(cluster: Cluster, file: Path, root: Path, **more: Any) -> factory.Outcome:
    experiment = config.read(file)
    return factory.generate(experiment, experiment.load_images(), root, cluster, **more)


# --- the same bytes -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(config, dataset made in this process)."""
    home = tmp_path_factory.mktemp("many")
    file = write_config(home / "many.yaml", train=300, test=40)
    make(file, home / "out")
    return file, home / "out"


def test_a_cluster_makes_the_same_bytes(many: tuple[Path, Path], cluster: Cluster, tmp_path: Path) -> None:
    on(cluster, many[0], tmp_path / "out")
    assert_same(tmp_path / "out", tree(many[1]))


def test_workers_that_share_no_files_send_the_same_bytes(
    many: tuple[Path, Path], site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = []
    put = Encoding.put
    monkeypatch.setattr(Encoding, "put", lambda *given: sent.append(given[2]) or put(*given))
    with Cluster(site.address, shared=False) as apart:
        on(apart, many[0], tmp_path / "out")
    assert_same(tmp_path / "out", tree(many[1]))
    assert len(sent) == len(json.loads((many[1] / "manifest.json").read_text())["shards"])


def test_reconstruct_and_repair_on_a_cluster(many: tuple[Path, Path], cluster: Cluster, tmp_path: Path) -> None:
    few = write_config(tmp_path / "few.yaml", methods=METHODS[:2], train=300, test=40)
    on(cluster, few, tmp_path / "out")
    factory.add_reconstructions(tmp_path / "out", METHODS[2:], cluster)
    assert_same(tmp_path / "out", tree(many[1]))
    hurt = next((tmp_path / "out" / "data").rglob("*.zip"))
    hurt.write_bytes(b"damaged")
    assert verify.repair(tmp_path / "out", verify.verify(tmp_path / "out"), cluster)
    assert_same(tmp_path / "out", tree(many[1]))


def test_workers_with_threads(many: tuple[Path, Path], tmp_path: Path) -> None:
    site = Site(workers=1, threads=3)
    try:
        with Cluster(site.address) as cluster:
            on(cluster, many[0], tmp_path / "out")
    finally:
        site.end()
    assert_same(tmp_path / "out", tree(many[1]))


def test_workers_killed_at_random(tmp_path: Path) -> None:
    """Every half second or so; more than a minute of this, with 100 kills, is scripts/kill_workers.py."""
    file = write_config(tmp_path / "c.yaml", levels=("5 mlux", "40 mlux", "160 mlux"), train=1500, test=300)
    make(file, tmp_path / "expected")
    site, rng, over = Site(workers=3), random.Random(1), threading.Event()
    killed = []

    def kill() -> None:
        while not over.wait(0.3 + rng.random()) and len(killed) < 4:
            if len(there := site.processes()) > 1:
                victim = rng.choice(there)
                killed.append(victim.pid)
                victim.kill()

    try:
        with Cluster(site.address) as cluster:
            assert wait_for(lambda: len(site.processes()) == 3, 60)
            killer = threading.Thread(target=kill)
            killer.start()
            try:
                on(cluster, file, tmp_path / "out")
            finally:
                over.set()
                killer.join()
    finally:
        site.end()
    assert killed
    assert_same(tmp_path / "out", tree(tmp_path / "expected"))


TENTH = '''
import numpy as np
from spadmnist import Effect
from spadmnist.events import Children

class Tenth(Effect, stage="correlated"):
    """A tenth of the detections have a child."""

    def spawn(self, events, rng):
        parent = np.flatnonzero(rng.random(len(events)) < 0.1)
        return Children(parent, np.full(len(parent), 1e-7))
'''


def test_plug_ins_and_maps_are_carried_along(cluster: Cluster, tmp_path: Path) -> None:
    """The worker finds neither the plug-in nor the map: both are gone when it begins."""
    import numpy as np

    (tmp_path / "tenth.py").write_text(TENTH)
    np.save(tmp_path / "map.npy", np.linspace(0.5, 1.5, 64).reshape(8, 8))
    text = write_config(tmp_path / "c.yaml", more="    tenth: {}\n").read_text()
    text = text.replace("  name: small\n", "  name: small\n  rules: device\n")
    text = text.replace("{pdp: 0.5}", "{pdp: 0.5, relative: {file: map.npy}}")
    (tmp_path / "c.yaml").write_text(text)
    plugins.load_file(tmp_path / "tenth.py")
    experiment = config.read(tmp_path / "c.yaml")
    factory.generate(experiment, experiment.load_images(), tmp_path / "expected", Serial())
    for name in ("tenth.py", "map.npy"):
        (tmp_path / name).rename(tmp_path / f"{name}.away")
    factory.generate(experiment, experiment.load_images(), tmp_path / "out", cluster)
    assert_same(tmp_path / "out", tree(tmp_path / "expected"))


def test_a_comparison_on_a_cluster_is_the_same(cluster: Cluster, tmp_path: Path) -> None:
    sensor, data = labs(tmp_path)()
    alone, there = (canonical(compare(sensor, data, jobs=workers, replicates=16)) for workers in (1, cluster))
    assert alone == there


# --- bad input ----------------------------------------------------------------------------------------------------


def test_no_scheduler_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("spadmnist.cluster._CONNECT", 1.0)
    with pytest.raises(SpadError, match=r"no scheduler answers there"):
        Cluster(FREE).run(abs, iter, [1], print)
    with pytest.raises(SpadError, match=r"is no address of a scheduler"):
        Cluster("127.0.0.1")


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--cluster", FREE], "no scheduler answers there"),
        (["--cluster", "8786"], "is no address of a scheduler; write tcp://HOST:PORT"),
        (["--cluster", FREE, "--jobs", "2"], "--jobs: a cluster has the workers that were started there"),
        (["--no-shared"], "--no-shared: is said of the workers of a cluster"),
    ],
)
def test_the_command_line_says_it_in_one_sentence(more: list[str], said: str, tmp_path: Path) -> None:
    assert_sentence(run("generate", write_config(tmp_path / "c.yaml"), "-o", tmp_path / "out", *more), said)
    assert not (tmp_path / "out" / "data").exists()


def test_the_command_line_makes_the_same_bytes(many: tuple[Path, Path], site: Site, tmp_path: Path) -> None:
    result = run("generate", many[0], "-o", tmp_path / "out", "--cluster", site.address)
    assert result.returncode == 0, result.stderr
    assert_same(tmp_path / "out", tree(many[1]))


def test_a_scheduler_of_another_version(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distributed, "__version__", "2020.1.0")
    with pytest.raises(SpadError, match=r"the scheduler has dask.distributed .* and here is 2020.1.0"):
        Cluster(site.address).run(abs, iter, [1], print)


def test_no_worker_comes() -> None:
    site, said = Site(workers=0), []
    try:
        assert wait_for(lambda: _listens(site.address), 60)
        with pytest.raises(SpadError, match=r"no worker has come in 3 s"), Cluster(site.address, True, said.append, 3):
            Cluster(site.address, True, said.append, 3).run(abs, iter, [1], print)
    finally:
        site.end()
    assert len(said) == 1 and "is waited for" in said[0]


def _listens(address: str) -> bool:
    host, _, port = address.removeprefix("tcp://").partition(":")
    with socket.socket() as asking:
        return asking.connect_ex((host, int(port))) == 0


def test_a_worker_that_makes_other_bytes_is_refused(
    many: tuple[Path, Path], cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here the answer of this machine is another; libraries and processors are named, and nothing is made."""
    monkeypatch.setattr(factory.golden, "digest", lambda experiment: "0" * 64)
    with pytest.raises(
        SpadError, match=r"makes other bytes than this machine: there .*numpy .*; here .*numpy "
    ) as told:
        on(cluster, many[0], tmp_path / "out")
    assert golden.processor() in str(told.value)
    assert not (tmp_path / "out" / "data").exists()


def test_a_worker_without_the_shared_folder(
    many: tuple[Path, Path], cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It looks for the file of this run where there is none."""
    elsewhere = factory.Run(str(tmp_path / "elsewhere" / ".spadmnist" / "run"), "token")
    monkeypatch.setattr(factory, "running", lambda root, workers: contextlib.nullcontext(elsewhere))
    with pytest.raises(SpadError, match=r"does not see this run in .*elsewhere.*--no-shared"):
        on(cluster, many[0], tmp_path / "out")


def test_a_scheduler_that_dies_in_the_middle(tmp_path: Path) -> None:
    """What is complete is kept; the same command makes the rest."""
    file = write_config(tmp_path / "c.yaml", levels=("160 mlux", "640 mlux", "2560 mlux"), train=600, test=100)
    site = Site(workers=1)
    noted = tmp_path / "out" / ".spadmnist" / "shards"

    def kill() -> None:
        wait_for(lambda: len(list(noted.rglob("*.json"))) >= 3, 120)
        site.scheduler.kill()

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        with pytest.raises(SpadError, match=r"the scheduler is gone .*what is complete is kept"):
            on(Cluster(site.address), file, tmp_path / "out")
    finally:
        killer.join()
        site.end()
    outcome = make(file, tmp_path / "out")
    assert outcome.kept >= 3 and outcome.made


def test_a_connection_that_breaks_under_a_result_is_no_error_of_the_task() -> None:
    """What is there is fetched again; where the scheduler is gone, looking for it says so."""

    class Fetched:
        status = "finished"

        def __init__(self, *outcomes: Any):
            self.outcomes = list(outcomes)

        def result(self, timeout: float) -> Any:
            outcome = self.outcomes.pop(0)
            if isinstance(outcome, Exception):
                raise outcome
            return outcome

        def release(self) -> None:
            pass

    looks: list[int] = []
    broken = ConnectionResetError(104, "reset by peer")
    assert _Future(Fetched(broken, TimeoutError(), 7), lambda: looks.append(1)).result() == 7
    assert len(looks) == 2

    def gone() -> None:
        raise SpadError("the scheduler is gone")

    with pytest.raises(SpadError, match="the scheduler is gone"):
        _Future(Fetched(broken), gone).result()
    own = Fetched(FileNotFoundError(2, "no such map"))
    own.status = "error"
    with pytest.raises(FileNotFoundError):
        _Future(own, gone).result()


def test_ctrl_c_ends_within_five_seconds(many: tuple[Path, Path], site: Site, tmp_path: Path) -> None:
    code = (  # where the tests run in the background of a shell, SIGINT is ignored
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from spadmnist import interrupts; interrupts.install(); interrupts.under_way(True)\n"
        "from spadmnist.cluster import Cluster\nimport time\n"
        "print('ready', flush=True)\n"
        "try:\n    Cluster(sys.argv[1]).run(time.sleep, iter, [60, 61], print)\n"
        "except KeyboardInterrupt:\n    sys.exit(interrupts.status())\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code, site.address], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    time.sleep(8)
    started = time.monotonic()
    os.kill(process.pid, signal.SIGINT)
    assert process.wait(30) == 130
    assert time.monotonic() - started < 5.5
