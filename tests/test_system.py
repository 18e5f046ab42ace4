"""Locks whose process is killed, and the program on a system that lacks what Windows lacks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import bare
import pytest

import spadmnist
from spadmnist import config, document, factory, system

KILLS = 500

CONFIG = """\
seed: 1
scene: {images: {source: digits, train: 4, test: 2, rows: 8, columns: 8}, lux: [20 mlux]}
recording: {exposure: 80 us, frames: 8, frame_time: 10 us, readouts: [tr, qis]}
reconstruct: [counts]
sensor:
  rules: device
  layout: {rows: 8, columns: 8, pixel_area: 25 um^2}
  effects: {detection: {pdp: 0.5}, dark_counts: {rate: 100 Hz}, dead_time: {duration: 50 ns}}
"""

BENCH = """\
format: spadmnist-measurement/1
name: bench
layout: {rows: 8, columns: 8}
captures:
  - {id: dark, modality: tr, exposure: 1 ms, light: {kind: dark}}
"""

# every module, then the main job, each of its verbs in this process
JOB = """
import importlib, json, pkgutil
import spadmnist
from spadmnist.cli import cli

done = []
for found in pkgutil.walk_packages(spadmnist.__path__, "spadmnist."):
    if not found.name.endswith("__main__"):
        try:
            importlib.import_module(found.name)
        except ImportError as error:  # what a user brings along, as torch
            if (error.name or "").split(".")[0] in ("spadmnist", "fcntl", "resource", "pwd", "grp", "termios"):
                raise
        done.append(found.name)
for command in COMMANDS:
    try:
        cli(command, standalone_mode=False)
    except SystemExit as end:
        assert not end.code, (command, end.code)
print(json.dumps(done))
"""


def run_bare(folder: Path, program: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "SPADMNIST_CACHE": str(folder / "cache"), "SPADMNIST_DEBUG": "1"}
    return subprocess.run(
        [sys.executable, "-c", bare.PROGRAM + program],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


@pytest.mark.slow
def test_the_main_job_needs_nothing_that_only_some_systems_have(tmp_path: Path) -> None:
    """Every module is imported; the dataset is the one that is made here, byte for byte, and no lock stays."""
    pytest.importorskip("filelock")
    (tmp_path / "lab.yaml").write_text(CONFIG)
    (tmp_path / "bench").mkdir()
    (tmp_path / "bench" / "measurement.yaml").write_text(BENCH)
    commands = [
        ["generate", "lab.yaml", "-o", "bare", "--jobs", "1"],
        ["generate", "lab.yaml", "-o", "bare", "--jobs", "1"],
        ["reconstruct", "bare", "--method", "passive_free_running", "--jobs", "1"],
        ["verify", "bare"],
        ["inspect", "bare"],
        ["inspect", "bare", "--plot", "bare.png"],
        ["simulate", "lab.yaml", "bench", "-o", "twin"],
        ["export", "twin", "-o", "twin.npz", "--format", "npz"],
    ]
    done = run_bare(tmp_path, JOB.replace("COMMANDS", repr(commands)))
    assert done.returncode == 0, done.stderr[-3000:]
    assert "spadmnist.system" in json.loads(done.stdout.splitlines()[-1])
    made = {"lab.yaml", "bare", "bare.png", "bench", "twin", "twin.npz"}
    assert {path.name for path in tmp_path.iterdir()} - {"cache"} == made
    both = CONFIG.replace("[counts]", "[counts, passive_free_running]")
    experiment = config.build(document.parse(both, "lab.yaml"), tmp_path)
    factory.generate(experiment, experiment.load_images(), tmp_path / "here", 1)
    assert files_in(tmp_path / "bare") == files_in(tmp_path / "here")


def files_in(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_a_part_says_where_no_lock_is_shared(tmp_path: Path) -> None:
    (tmp_path / "lab.yaml").write_text(CONFIG)
    asked = ["generate", "lab.yaml", "--part", "1/2", "--jobs", "1"]
    done = run_bare(tmp_path, f"from spadmnist.start import main\nsys.argv[1:] = {asked}\nmain()\n")
    assert done.returncode == 2 and "--part 1/2: this system has no lock that several parts can hold" in done.stderr
    assert "Traceback" not in done.stderr


def test_the_kernels_ask_for_no_attribute_that_numba_may_lack() -> None:
    """`numba.np.arraymath._HAVE_BLAS` is a name of its own, which another numba may have lost."""
    program = (
        "import numba.np.arraymath as a\n"
        "del a._HAVE_BLAS\n"
        "import spadmnist.compiled\n"
        "assert not hasattr(a, '_HAVE_BLAS')\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


# a small process divides sooner than that of the tests
KILLING = """
import os, signal, sys
from pathlib import Path
from spadmnist import config, document, factory, system

place = Path(sys.argv[1])
for _ in range(int(sys.argv[2])):
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        lock = system.Lock(place)
        os.write(writing, b"1")
        signal.pause()
    assert os.read(reading, 1) == b"1"
    try:
        system.Lock(place)
        raise AssertionError("two processes hold it")
    except system.Busy:
        os.kill(child, signal.Signals(9))
    os.waitpid(child, 0)
    os.close(reading)
    os.close(writing)
    system.Lock(place).close()
print("done")
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not divided here")
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_no_kill_leaves_a_lock_that_bars_the_next_one(kind: str, tmp_path: Path) -> None:
    place = tmp_path / "held"
    if kind == "folder":
        place.mkdir()
    command = [sys.executable, "-c", KILLING, str(place), str(KILLS // 2)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "done\n"


def test_a_lock_that_is_shared_is_made_sole_by_the_last(tmp_path: Path) -> None:
    one, other = system.Lock(tmp_path / "lock", shared=True), system.Lock(tmp_path / "lock", shared=True)
    with pytest.raises(system.Busy):
        system.Lock(tmp_path / "lock")
    assert not one.make_sole()
    other.close()
    assert one.make_sole()
    with pytest.raises(system.Busy):
        system.Lock(tmp_path / "lock", shared=True)
    one.close()
    one.close()
    system.Lock(tmp_path / "lock").close()


def test_the_lock_is_of_what_lies_there_now(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that its holder has removed between the opening and the locking is nobody's: the next one is held."""
    place, removed = tmp_path / "lock", []

    def lstat(path: object, kept: object = os.lstat) -> os.stat_result:
        if not removed:
            removed.append(place.unlink())
        return kept(path)  # type: ignore[operator, no-any-return]

    monkeypatch.setattr(os, "lstat", lstat)
    with system.Lock(place):
        assert removed and place.exists()


@pytest.mark.parametrize(
    ("own", "files", "processors", "memory"),
    [
        ("0::/", {"memory.max": "max", "cpu.max": "max 100000"}, 8, 1 << 60),
        ("0::/", {"memory.max": "1000000", "cpu.max": "150000 100000"}, 2, 1000000),
        # the group of a job in that of a user: each of them limits it
        ("0::/user/job", {"user/memory.max": "2000000", "user/job/memory.max": "max", "user/job/cpu.max": "5 10"},
         1, 2000000),
        ("0::/user/job", {"user/memory.max": "2000000", "user/job/memory.max": "3000000", "user/cpu.max": "30 10"},
         3, 2000000),
        ("0::/user/job", {"other/memory.max": "5", "other/cpu.max": "5 10"}, 8, 1 << 60),
        # version 1, inside a container, which sees its own group as the first one
        ("5:memory:/docker/ab\n4:cpu,cpuacct:/docker/ab\n",
         {"memory/memory.limit_in_bytes": "4000000", "cpu,cpuacct/cpu.cfs_quota_us": "300000",
          "cpu,cpuacct/cpu.cfs_period_us": "100000"}, 3, 4000000),
        ("5:memory:/a\n4:cpu:/a\n",
         {"memory/a/memory.limit_in_bytes": "9223372036854771712", "cpu/a/cpu.cfs_quota_us": "-1",
          "cpu/a/cpu.cfs_period_us": "100000"}, 8, 1 << 60),
        ("nonsense\n", {"memory.max": "5"}, 8, 1 << 60),
    ],
)  # fmt: skip
def test_a_container_limits_processors_and_memory(
    own: str, files: dict[str, str], processors: int, memory: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, text in files.items():
        file = tmp_path / "groups" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text + "\n")
    (tmp_path / "own").write_text(own)
    monkeypatch.setattr(system, "_GROUPS", tmp_path / "groups")
    monkeypatch.setattr(system, "_OWN_GROUPS", tmp_path / "own")
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    monkeypatch.setattr(os, "sysconf", lambda name: 1 << 30, raising=False)
    monkeypatch.setattr(system, "address_space", lambda: None)
    assert (system.processors(), system.memory()) == (processors, memory)


def test_one_module_alone_has_what_differs_between_systems() -> None:
    package = Path(spadmnist.__file__).parent
    names = (
        "fcntl",
        "import resource\n",
        "prctl",
        "O_NOFOLLOW",
        "O_DIRECTORY",
        "O_NONBLOCK",
        "dir_fd",
        "getuid",
        "SIGKILL",
    )
    for path in sorted(package.rglob("*.py")):
        found = [name for name in names if name in path.read_text()]
        assert not found or path.name == "system.py", f"{path}: {', '.join(found)}; spadmnist.system has these"
