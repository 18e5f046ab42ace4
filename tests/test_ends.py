"""How the program ends: by Ctrl-C whenever it comes, without threads, with closed streams, with a killed worker."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from labs import labs
from test_factory import alive, descendants, wait_for, workers, write_config

from spadmnist import disk
from spadmnist.cli import _limits, _run
from spadmnist.errors import SpadError
from spadmnist.inference.capture_replicates import CaptureReplicates
from spadmnist.inference.replicate_cache import keep, recall

START = [sys.executable, "-c", "from spadmnist.start import main; main()"]
SENTENCE = "Interrupted. What is complete is kept: the same command goes on from there."


def started(*arguments: object, **options: Any) -> psutil.Popen:
    """The program in a process group of its own."""
    return psutil.Popen(
        [*START, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **options,
    )


def ended(process: psutil.Popen) -> tuple[int, str]:
    """(exit status, standard error), within 5 s; nothing is left of the process and its workers."""
    family = descendants(process)
    try:
        _, said = process.communicate(timeout=5)
        assert wait_for(lambda: not alive(family), 3), alive(family)
        return process.returncode, said
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def test_the_console_script_begins_with_the_signals() -> None:
    """And that module imports nothing before them: what is loaded is the package's first lines, and they."""
    file = Path(__file__).parents[1] / "pyproject.toml"
    assert tomllib.loads(file.read_text())["project"]["scripts"]["spadmnist"] == "spadmnist.start:main"
    code = "import spadmnist.start, sys; print(*sys.modules)"
    said: Any = {"capture_output": True, "text": True, "check": True}
    loaded = subprocess.run([sys.executable, "-c", code], **said).stdout.split()
    bare = subprocess.run([sys.executable, "-c", "import sys; print(*sys.modules)"], **said).stdout.split()
    assert set(loaded) - set(bare) == {"spadmnist", "spadmnist.start", "spadmnist.interrupts"}


@pytest.mark.parametrize("where", ["click", "numpy", "numba"])
def test_ctrl_c_while_something_is_imported(where: str, tmp_path: Path) -> None:
    """A library that interrupts the program when it is imported, and swallows what comes of it as libraries do."""
    (tmp_path / where).mkdir()
    (tmp_path / where / "__init__.py").write_text(
        "import os, signal, time\ntry:\n    os.kill(os.getpid(), signal.SIGINT)\n    time.sleep(1)\n"
        "except BaseException as error:\n    raise ImportError('a library') from error\n"
    )
    file = write_config(tmp_path / "c.yaml")
    env = {**os.environ, "PYTHONPATH": str(tmp_path)}
    assert ended_with(started("generate", file, "-o", tmp_path / "out", env=env)) == (130, SENTENCE)


def ended_with(process: psutil.Popen) -> tuple[int, str]:
    time.sleep(0.1)
    process.wait(20)
    status, said = ended(process)
    return status, said.strip()


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_in_the_final_moves_or_in_a_callback(number: int, status: int) -> None:
    final = "import atexit, os, time\natexit.register(lambda: (os.kill(os.getpid(), {n}), time.sleep(9)))\n"
    callback = (
        "import os, spadmnist.cli._limits as c\nclass A:\n    def __del__(self): os.kill(os.getpid(), {n})\n"
        "c.check = A\n"
    )
    for code in (final, callback):
        code = code.format(n=int(number)) + "from spadmnist.start import main; main()"
        done = subprocess.run(
            [sys.executable, "-c", code, "effects"], capture_output=True, text=True, timeout=20, check=False
        )
        assert (done.returncode, done.stderr.strip()) == (status, SENTENCE if status == 130 else "")


def test_what_does_not_end_is_left_all_the_same() -> None:
    code = (
        "import os, time, spadmnist.cli._limits as c\ndef stuck():\n    try:\n        os.kill(os.getpid(), 2)\n"
        "    finally:\n        time.sleep(60)\nc.check = stuck\nfrom spadmnist.start import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", code, "effects"], capture_output=True, text=True, timeout=20)
    assert (done.returncode, done.stderr.strip()) == (130, SENTENCE)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["generate", "diagnose"])
def test_ctrl_c_while_workers_start(command: str, tmp_path: Path) -> None:
    """They import for a second, in which Ctrl-C is not theirs to answer."""
    process = begun(command, tmp_path)
    assert wait_for(lambda: len(workers(process)) == 2, 30)
    time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)
    status, said = ended(process)
    assert status == 130 and said.strip().endswith(SENTENCE)
    assert "File" not in said and "Error" not in said, said


def begun(command: str, tmp_path: Path) -> psutil.Popen:
    if command == "generate":
        return started("generate", write_config(tmp_path / "c.yaml"), "-o", tmp_path / "out", "--jobs", 2)
    (tmp_path / "labs").mkdir()
    labs(tmp_path / "labs")(dead=80)
    place = tmp_path / "labs" / "0"
    more = ["-o", tmp_path / "report"] if command == "diagnose" else []
    env = {**os.environ, "SPADMNIST_CACHE": str(tmp_path / "cache")}  # with nulls that are kept no worker would start
    return started(command, place / "sensor.yaml", place / "lab", "--jobs", 2, *more, env=env)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["compare", "diagnose"])
def test_a_worker_killed_while_it_starts_is_replaced(command: str, tmp_path: Path) -> None:
    process = begun(command, tmp_path)
    assert wait_for(lambda: bool(workers(process)), 30)
    first = workers(process)
    first[0].kill()
    assert wait_for(lambda: len({one.pid for one in workers(process)} - {one.pid for one in first}) == 2, 60)
    os.killpg(process.pid, signal.SIGINT)
    status, said = ended(process)
    assert status == 130 and "Error" not in said, said


def test_no_thread_is_to_be_had(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refused)
    assert _run(["effects"]) == 2
    said = capsys.readouterr().err
    assert said == f"Error: {_limits.ALONE}\n"


def test_no_process_is_to_be_had(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second worker's; the first one is not left behind."""
    from loky import get_reusable_executor
    from loky.backend import popen_loky_posix

    get_reusable_executor(max_workers=1).shutdown(wait=True)  # idle workers of another test would do this one's work
    launch, launched = popen_loky_posix.Popen._launch, []

    def refused(self: Any, process: Any) -> None:
        if launched:
            raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")
        launch(self, process)
        launched.append(self.pid)

    monkeypatch.setattr(popen_loky_posix.Popen, "_launch", refused)
    file = write_config(tmp_path / "c.yaml")
    assert _run(["generate", str(file), "-o", str(tmp_path / "out"), "--jobs", "2"]) == 2
    assert capsys.readouterr().err.endswith(f"Error: {_limits.ALONE}\n")
    assert len(launched) == 1 and not psutil.pid_exists(launched[0])


def test_too_few_addresses() -> None:
    """With these scipy would wait for ever."""
    done = subprocess.run(
        ["sh", "-c", 'ulimit -v 400000; exec "$@"', "sh", *START, "effects"], capture_output=True, text=True, timeout=20
    )
    assert done.returncode == 2 and done.stderr.startswith("Error: only 410 MB of addresses"), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("closed", ["2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_workers_do_not_mind_closed_streams(closed: str, tmp_path: Path) -> None:
    file = write_config(tmp_path / "c.yaml")
    command = f'"$@" {closed}'
    done = subprocess.run(
        ["sh", "-c", command, "sh", *START, "generate", file, "-o", tmp_path / "out", "--jobs", "2"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["shards"]


# --- what a killed run leaves -------------------------------------------------------------------------------------


def test_half_an_export_is_cleared_by_the_next_one_and_a_living_writer_keeps_its_own(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from spadmnist import disk\n"
        "with disk.whole(Path(sys.argv[1]), 4) as file:\n    file.write(b'half'); file.flush()\n"
        "    print(flush=True)\n    sys.stdin.read()\n"
    )
    path = tmp_path / "a[1].npz"

    def writer() -> subprocess.Popen[str]:
        begun = subprocess.Popen(
            [sys.executable, "-c", code, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert begun.stdout is not None and begun.stdout.readline() == "\n"
        return begun

    killed = writer()
    killed.kill()
    killed.communicate()
    (half,) = tmp_path.iterdir()
    assert half.read_bytes() == b"half"
    (tmp_path / ".other.npz.part").touch()
    living = writer()
    with pytest.raises(SpadError, match="another run is writing it"):
        disk.put_file(path, b"all")
    living.communicate("")
    assert {file.name for file in tmp_path.iterdir()} == {"a[1].npz", ".other.npz.part"}
    disk.put_file(path, b"all")
    assert {file.name for file in tmp_path.iterdir()} == {"a[1].npz", ".other.npz.part"} and path.read_bytes() == b"all"


@pytest.mark.parametrize("at", [3, 0.3, 0.6, 0.9, 0.999])
def test_damaged_replicates_are_not_taken(at: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One bit anywhere; also where the archive itself has no digest of it."""
    monkeypatch.setattr("spadmnist.inference.replicate_cache.nulls_folder", lambda: tmp_path)
    values = {"map": np.arange(40.0).reshape(8, 5), "spread": np.full((8, 2), 0.5)}
    laws = {"map": ("poisson", None), "spread": ("normal", np.ones(2))}
    one = CaptureReplicates(np.arange(8, dtype=np.uint64), np.arange(8.0), values, laws)
    keep("entry", one)
    file = tmp_path / "entry.replicates"
    whole = file.read_bytes()
    found = recall("entry")
    assert found is not None and all(np.array_equal(found.values[name], x) for name, x in values.items())
    assert found.laws["map"] == ("poisson", None) and np.array_equal(found.laws["spread"][1], np.ones(2))
    assert found.values["map"].dtype == np.float64 and np.array_equal(found.first(3).totals, [0.0, 1.0, 2.0])
    place = int(at if at >= 1 else at * len(whole))
    file.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
    assert recall("entry") is None
    file.write_bytes(whole[:place])
    assert recall("entry") is None
    keep("entry", one)
    assert file.read_bytes() == whole and [path.name for path in tmp_path.iterdir()] == ["entry.replicates"]
