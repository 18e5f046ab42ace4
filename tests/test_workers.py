"""No file of the current folder is run in place of a library: not by the program, not by its workers. And what is left
of workers that were killed is removed.

The decoys have the names of everything that a real run asks for; each says so where it is run.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from commands import COMMAND
from labs import labs
from test_factory import alive, descendants, wait_for

from spadmnist import leftovers
from spadmnist.workers import executor, safe_path

ROOT = Path(__file__).parents[1]
QUICK = ROOT / "configs" / "quick.yaml"

# told of each import in every Python process that has it on its path: (process, name)
WATCH = """
import os, sys

class Watch:
    def find_spec(self, name, path=None, target=None):
        if path is None:
            with open({log!r}, "a") as file:
                file.write(f"{{os.getpid()}} {{name}}\\n")

sys.meta_path.insert(0, Watch())
"""
DECOY = "open({marker!r}, 'a').write(__name__ + '\\n')\n"
PROGRAM = "import sys\nfrom spadmnist.cli import main\nsys.exit(main())\n"


def run(command: list[str], cwd: Path, path: str | None = None) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "SPADMNIST_CACHE": str(cwd / "nulls")}
    environment.pop("PYTHONPATH", None)
    if path is not None:
        environment["PYTHONPATH"] = path
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done


def generate(root: Path) -> list[str]:
    return ["generate", str(QUICK), "-o", str(root), "--limit", "2", "--jobs", "2"]


class Watched:
    """What real runs import, and a measurement to compare with."""

    def __init__(self, folder: Path):
        self.folder, self.log = folder, folder / "log"
        labs(folder)()
        (self.lab,) = (path.parent for path in folder.glob("*/sensor.yaml"))
        self.compare = ["compare", str(self.lab / "sensor.yaml"), str(self.lab / "lab"), "--jobs", "2"]
        self.watch = folder / "watch"
        self.watch.mkdir()
        (self.watch / "sitecustomize.py").write_text(WATCH.format(log=str(self.log)))
        imported = [self.imports([COMMAND, *words]) for words in (self.compare, generate(folder / "made"))]
        self.processes = sum(map(len, imported))
        self.names = {name for run in imported for names in run for name in names} - {"spadmnist", "sitecustomize"}

    def imports(self, command: list[str]) -> list[list[str]]:
        """The modules that each process of a command asks for, in order."""
        self.log.write_text("")
        run(command, self.folder, str(self.watch))
        found: dict[str, list[str]] = {}
        for process, name in map(str.split, self.log.read_text().splitlines()):
            found.setdefault(process, []).append(name)
        return list(found.values())


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Watched:
    return Watched(tmp_path_factory.mktemp("watched"))


@pytest.fixture
def program(tmp_path: Path) -> Path:
    """The command, in a folder of its own and with nothing imported before the package."""
    path = tmp_path / "bin" / "spadmnist"
    path.parent.mkdir()
    path.write_text(PROGRAM)
    return path


def lay_decoys(watched: Watched, folder: Path, command: list[str] | None = None) -> Path:
    """A folder of decoys, without those of what Python imports by itself before the package; where they tell of it."""
    early: set[str] = set()
    if command is not None:
        names = next(names for names in watched.imports([*command, "--version"]) if "spadmnist" in names)
        early = set(names[: names.index("spadmnist")])
    marker = folder.with_name("marker")
    folder.mkdir()
    for name in watched.names - early:
        (folder / f"{name}.py").write_text(DECOY.format(marker=str(marker)))
    return marker


@pytest.mark.slow
def test_the_runs_that_are_watched_have_workers_and_ask_for_what_matters(watched: Watched) -> None:
    assert watched.processes >= 2 * (1 + 2)
    assert {"numpy", "numba", "loky", "psutil", "pickle", "h5py", "typing", "__future__"} <= watched.names


@pytest.mark.slow
def test_compare_runs_nothing_of_the_current_folder(watched: Watched, tmp_path: Path) -> None:
    marker = lay_decoys(watched, tmp_path / "here")
    assert "adequate" in run([COMMAND, *watched.compare], tmp_path / "here").stdout
    assert not marker.exists(), marker.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("module", [["-m", "spadmnist"], ["-Bmspadmnist.cli"]])
def test_a_module_of_the_program_leaves_the_current_folder(module: list[str], watched: Watched, tmp_path: Path) -> None:
    command = [sys.executable, *module]
    marker = lay_decoys(watched, tmp_path / "here", command)
    run([*command, *generate(tmp_path / "out")], tmp_path / "here")
    assert not marker.exists(), marker.read_text()


@pytest.mark.slow
def test_an_empty_entry_of_the_path_is_not_the_current_folder(watched: Watched, program: Path, tmp_path: Path) -> None:
    """As it comes of PYTHONPATH=$PYTHONPATH:/some/folder."""
    command = [sys.executable, str(program)]
    marker = lay_decoys(watched, tmp_path / "here", command)
    run([*command, *generate(tmp_path / "out")], tmp_path / "here", f"{os.pathsep}{tmp_path / 'elsewhere'}")
    assert not marker.exists(), marker.read_text()


LIBRARY = """
import os, sys
from spadmnist import compiled  # numba sets a variable of its own when it is imported
from spadmnist.workers import executor

if __name__ == "__main__":
    before, found = (dict(os.environ), list(sys.path)), {}
    executor(2).run(abs, iter, [-1, -2], found.__setitem__)
    assert found == {-1: 1, -2: 2}, found
    assert (dict(os.environ), sys.path) == before
"""


@pytest.mark.slow
def test_workers_of_a_script_run_nothing_of_the_current_folder(watched: Watched, tmp_path: Path) -> None:
    script = tmp_path / "elsewhere" / "script.py"
    script.parent.mkdir()
    script.write_text(LIBRARY)
    marker = lay_decoys(watched, tmp_path / "here")
    run([sys.executable, str(script)], tmp_path / "here")
    assert not marker.exists(), marker.read_text()


@pytest.mark.parametrize("path", [None, os.pathsep])
@pytest.mark.parametrize("how", [["-c", "import mine"], ["-m", "mine"], ["-m", "package"], ["mine.py"]])
def test_who_imports_the_package_keeps_the_path(how: list[str], path: str | None, tmp_path: Path) -> None:
    text = "import sys\nbefore = list(sys.path)\nimport spadmnist\nassert sys.path == before\nimport sibling\n"
    (tmp_path / "package").mkdir()
    for name in ("mine.py", "package/__init__.py"):  # of a package while Python looks for the module, too
        (tmp_path / name).write_text(text)
    (tmp_path / "package" / "__main__.py").write_text("")
    (tmp_path / "sibling.py").write_text("print('there')\n")
    assert run([sys.executable, *how], tmp_path, path).stdout == "there\n"


PLUGIN = """
import numpy as np
import sibling
from spadmnist import Effect
from spadmnist.events import Children

class Tenth(Effect, stage="correlated"):
    \"\"\"A tenth of the detections have a child.\"\"\"

    def spawn(self, events, rng):
        parent = np.flatnonzero(rng.random(len(events)) < 0.1)
        return Children(parent, np.full(len(parent), sibling.DELAY))
"""


@pytest.mark.slow
@pytest.mark.parametrize("command", [[COMMAND], [sys.executable, "-m", "spadmnist"]])
def test_a_folder_that_is_named_is_asked_for(command: list[str], tmp_path: Path) -> None:
    """So a plug-in finds what lies beside it, in workers too."""
    (tmp_path / "tenth.py").write_text(PLUGIN)
    (tmp_path / "sibling.py").write_text("DELAY = 1e-7\n")
    config = (
        QUICK.read_text().replace("rules: paper ", "rules: device ").replace("  effects:", "  effects:\n    tenth: {}")
    )
    (tmp_path / "config.yaml").write_text(config)
    words = ["generate", "config.yaml", "-o", "out", "--limit", "2", "--jobs", "2", "--plugin", "tenth.py"]
    run([*command, *words], tmp_path, ".")


def test_the_environment_is_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", "lib", "", "."]))
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    before = dict(os.environ)
    with pytest.raises(ZeroDivisionError), safe_path():
        assert os.environ["PYTHONPATH"] == os.pathsep.join(["lib", "."])
        assert os.environ["PYTHONSAFEPATH"] == "1"
        raise ZeroDivisionError
    assert dict(os.environ) == before


# --- what is left of a run that was killed ------------------------------------------------------------------------

HOLDING = """
import sys, time
from spadmnist import leftovers
from spadmnist.workers import executor
executor(2).run(leftovers.temporary, iter, ["plugin", "maps"], lambda key, folder: (folder / "file").touch())
print("ready", flush=True)
if "wait" in sys.argv:
    time.sleep(120)
"""
MEMORY = Path("/dev/shm")


def holding(place: Path, *arguments: str) -> subprocess.Popen[str]:
    """A process whose workers have done something, in a group of its own."""
    environment = {**os.environ, "SPADMNIST_WORKERS": str(place)}
    command = [sys.executable, "-c", HOLDING, *arguments]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    return process


def semaphores(folder: Path) -> list[Path]:
    return list(MEMORY.glob(f"sem.*-{folder.name}-*"))


@pytest.mark.slow
@pytest.mark.skipif(not MEMORY.is_dir(), reason="semaphores are no files here")
def test_the_next_run_removes_what_a_killed_one_left_and_nothing_of_a_living_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed with its workers and with what cleans up behind them; the semaphores bear the name of its folder."""
    others = {process.pid for process in descendants(psutil.Process())}  # of other tests
    killed, living = holding(tmp_path, "wait"), None
    try:
        (left,) = tmp_path.iterdir()
        assert semaphores(left)
        held_by_workers = {path.parent.name.split("-")[0] for path in left.glob("*/file")}
        assert held_by_workers == {"plugin", "maps"}, "workers use the folder of their parent"
        os.killpg(killed.pid, signal.SIGKILL)
        killed.wait(10)
        assert wait_for(lambda: not alive([p for p in descendants(psutil.Process()) if p.pid not in others]), 60)
        (tmp_path / "spadmnist-workers-of-nobody").write_text("no folder")
        (tmp_path / "elsewhere").mkdir()
        (tmp_path / "spadmnist-workers-link").symlink_to(tmp_path / "elsewhere")
        assert semaphores(left) and left.is_dir()

        living = holding(tmp_path, "wait")
        assert not left.exists() and not semaphores(left)
        (own,) = (p for p in tmp_path.glob("spadmnist-workers-*") if p.is_dir() and not p.is_symlink())
        held = semaphores(own)
        assert held

        other = holding(tmp_path)
        other.communicate(timeout=30)
        assert other.returncode == 0
        assert own.is_dir() and semaphores(own) == held
        names = {"spadmnist-workers-of-nobody", "spadmnist-workers-link", "elsewhere", own.name}
        assert {path.name for path in tmp_path.iterdir()} == names, "a run that ends leaves nothing"
    finally:
        for process in filter(None, (killed, living)):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
        monkeypatch.setenv("SPADMNIST_WORKERS", str(tmp_path))
        leftovers.clear()


def test_what_is_anothers_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder of another user, and one that is held; the same is removed when it is ours and nobody's."""
    monkeypatch.setenv("SPADMNIST_WORKERS", str(tmp_path))
    folder = tmp_path / "spadmnist-workers-abcdefgh"
    folder.mkdir()
    with monkeypatch.context() as other:
        other.setattr(os, "geteuid", lambda: os.getuid() + 1)
        leftovers.clear()
        assert folder.is_dir()
    handle = os.open(folder, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    leftovers.clear()
    assert folder.is_dir()
    os.close(handle)
    leftovers.clear()
    assert not folder.exists()


@pytest.mark.skipif(not MEMORY.is_dir(), reason="semaphores are no files here")
def test_a_run_without_workers_removes_it_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the verbs work with --jobs 1."""
    monkeypatch.setenv("SPADMNIST_WORKERS", str(tmp_path))
    folder = tmp_path / f"spadmnist-workers-{os.getpid()}alone"
    folder.mkdir()
    (folder / "array").write_bytes(b"left")
    semaphore = MEMORY / f"sem.loky-1-{folder.name}-abc"
    semaphore.touch()
    leftovers.clear_once.cache_clear()
    try:
        found: dict[int, int] = {}
        executor(1).run(abs, iter, [-1], found.__setitem__)
        assert found == {-1: 1}
        assert not folder.exists() and not semaphore.exists()
    finally:
        semaphore.unlink(missing_ok=True)
