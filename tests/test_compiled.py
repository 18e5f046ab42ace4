"""Compiled kernels: where they are kept, who may touch them, and when they are out of date."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import pytest

from spadmnist import compiled, packing

PACKAGE = Path(compiled.__file__).parent
NOWHERE = "/dev/null/nowhere"  # what nobody can make, whoever runs the tests


@pytest.fixture(autouse=True)
def asked_anew(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.delenv(compiled.WORKERS, raising=False)
    compiled.folder.cache_clear()
    yield
    compiled.folder.cache_clear()


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """The three places, in a folder that is the test's own."""
    monkeypatch.setattr(compiled, "_places", lambda: iter(found.values()))
    found = {name: tmp_path / name for name in ("asked", "own", "temporary")}
    return found


def test_kernels_are_not_kept_beside_the_program() -> None:
    place = packing.row_sums.stats.cache_path
    assert Path(place).parent == compiled.folder()
    assert not Path(place).is_relative_to(PACKAGE)


def test_a_users_own_functions_go_where_numba_has_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    compiled.kernel()(lambda x: x)
    assert str(tmp_path) == numba.config.CACHE_DIR


def test_the_first_place_that_can_be_had(places: dict[str, Path]) -> None:
    for name, place in places.items():
        compiled.folder.cache_clear()
        found = compiled.folder()
        assert found is not None and found.parent == place, name
        assert found.stat().st_mode & 0o777 == 0o700
        shutil.rmtree(place)
        place.write_text("no folder")


@pytest.mark.parametrize("mode", [0o755, 0o720, 0o701])
def test_a_folder_that_is_open_to_others_is_not_used(mode: int, places: dict[str, Path]) -> None:
    first = compiled.folder()
    assert first is not None
    first.chmod(mode)
    compiled.folder.cache_clear()
    second = compiled.folder()
    assert second is not None and second.parent == places["own"]


def test_a_folder_of_another_user_is_not_used(places: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    first = compiled.folder()
    assert first is not None
    compiled.folder.cache_clear()
    family, user = compiled._family(), os.geteuid()
    monkeypatch.setattr(compiled, "_family", lambda: family)
    monkeypatch.setattr(os, "geteuid", lambda: user + 1)
    assert compiled.folder() is None


def test_a_link_is_not_followed(places: dict[str, Path], tmp_path: Path) -> None:
    first = compiled.folder()
    assert first is not None
    first.rename(tmp_path / "target")
    first.symlink_to(tmp_path / "target")
    compiled.folder.cache_clear()
    second = compiled.folder()
    assert second is not None and second.parent == places["own"]


def test_no_place_is_said_once_and_the_kernels_work(
    places: dict[str, Path], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for place in places.values():
        place.write_text("no folder")

    @compiled.kernel()
    def doubled(x: float) -> float:
        return 2 * x

    compiled.kernel()(lambda x: x)
    assert doubled(3.0) == 6.0
    assert doubled.stats.cache_path is None
    assert ["cannot be kept" in record.message for record in caplog.records] == [True]
    # workers are told, and say nothing
    monkeypatch.setenv(*next(iter(compiled.for_workers().items())))
    compiled.folder.cache_clear()
    places["asked"].unlink()
    assert compiled.folder() is None
    assert len(caplog.records) == 1


def test_workers_look_where_their_parent_does(places: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    places["asked"].write_text("no folder")
    found = compiled.folder()
    monkeypatch.setenv(*next(iter(compiled.for_workers().items())))
    places["asked"].unlink()
    compiled.folder.cache_clear()
    assert compiled.folder() == found is not None


def test_folders_that_nobody_has_used_for_long_are_removed(places: dict[str, Path], tmp_path: Path) -> None:
    place = places["asked"]
    old, used, other = (place / f"{compiled._family()}{name}" for name in ("0123", "4567", "89ab"))
    for folder in (old, used, place / "of-somebody-else", tmp_path / "target"):
        folder.mkdir(parents=True)
        (folder / "file").write_text("")
    other.symlink_to(tmp_path / "target")
    for folder in (old, place / "of-somebody-else", other, tmp_path / "target"):
        os.utime(folder, times=(0, time.time() - 31 * 86400), follow_symlinks=False)
    os.utime(used, times=(0, time.time() - 29 * 86400))
    found = compiled.folder()
    assert found is not None
    assert {path.name for path in place.iterdir()} == {found.name, used.name, "of-somebody-else", other.name}
    assert (tmp_path / "target" / "file").exists()


def test_a_folder_that_is_used_stays(places: dict[str, Path]) -> None:
    found = compiled.folder()
    assert found is not None
    os.utime(found, times=(0, 0))
    compiled.folder.cache_clear()
    assert compiled.folder() == found
    assert found.stat().st_mtime > time.time() - 3600


# --- other interpreters -------------------------------------------------------------------------------------------


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """The package in a folder in which nothing can be written beside it, whoever runs the tests."""
    root = tmp_path / "installed"
    shutil.copytree(PACKAGE, root / "spadmnist", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in [root / "spadmnist", *(p for p in (root / "spadmnist").rglob("*") if p.is_dir())]:
        (folder / "__pycache__").write_text("no folder")
    return root


WHERE = "from spadmnist import compiled, kernels, packing; print(compiled.folder())"


def where(copied: Path, **more: str) -> tuple[str, str]:
    """What a new interpreter says: (the folder, standard error)."""
    kept = {k: v for k, v in os.environ.items() if k not in {"HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR", "TMPDIR"}}
    done = subprocess.run(
        [sys.executable, "-c", WHERE],
        env={**kept, "PYTHONPATH": str(copied), **more},
        cwd=copied,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip(), done.stderr


def test_no_home_and_no_right_to_write_beside_the_program(copied: Path, tmp_path: Path) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    told, said = where(copied, HOME=NOWHERE, TMPDIR=str(temporary))
    assert (Path(told).parent, said) == (temporary, "")
    home = tmp_path / "missing"
    told, said = where(copied, HOME=str(home), TMPDIR=str(temporary))
    assert (Path(told).parent, said, home.exists()) == (temporary, "", False)


def test_a_home_that_nobody_knows_is_not_the_current_folder(copied: Path, tmp_path: Path) -> None:
    """`~` stays as it is where the user has no entry in the system's list."""
    told, said = where(copied, HOME="~", TMPDIR=str(tmp_path))
    assert (Path(told).parent, said, (copied / "~").exists()) == (tmp_path, "", False)


def test_a_home_and_what_is_asked_for_come_first(copied: Path, tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    assert Path(where(copied, HOME=str(home))[0]).is_relative_to(home)
    asked = tmp_path / "asked" / "deep"
    assert Path(where(copied, HOME=str(home), NUMBA_CACHE_DIR=str(asked))[0]).parent == asked


@pytest.mark.slow
def test_a_change_in_any_file_makes_another_folder(copied: Path, tmp_path: Path) -> None:
    """A kernel that calls one of another file would else be the old one."""
    before, _ = where(copied, NUMBA_CACHE_DIR=str(tmp_path / "asked"))
    assert where(copied, NUMBA_CACHE_DIR=str(tmp_path / "asked"))[0] == before
    with open(copied / "spadmnist" / "effects" / "tdc.py", "a") as file:
        file.write("\n")
    assert where(copied, NUMBA_CACHE_DIR=str(tmp_path / "asked"))[0] != before


# --- what is said -------------------------------------------------------------------------------------------------


def test_what_is_compiled_is_told_and_what_is_there_is_not(
    places: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiled, "_SILENCE", 0.0)
    said: list[str] = []
    for hits in (0, 1):  # a second dispatcher finds what the first has kept
        total = compiled.kernel()(packing.row_sums.py_func)
        with compiled.compiling(lambda: said.append("compiling")):
            total(np.zeros(3), np.array([0, 3]))
        assert sum(total.stats.cache_hits.values()) == hits
        assert said == ["compiling"]


def test_a_moment_of_compiling_and_what_is_not_kept_need_no_word(
    places: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    with compiled.compiling(lambda: said.append("compiling")):
        compiled.kernel()(lambda x: x + 1)(1)
        monkeypatch.setattr(compiled, "_SILENCE", 0.0)
        numba.njit(lambda x: x + 1)(1)
    assert said == []


def test_kernels_start_without_linear_algebra_and_leave_it_to_those_who_call_for_it() -> None:
    code = """if True:
        import sys
        import spadmnist.kernels
        print("scipy.linalg" in sys.modules)
        import numba, numpy as np
        print(numba.njit(lambda a: a.dot(a))(np.array([3.0, 4.0])), "scipy.linalg" in sys.modules)
        from numba.np import arraymath
        print(arraymath._HAVE_BLAS)
    """
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert said.stdout.split() == ["False", "25.0", "True", "True"]
