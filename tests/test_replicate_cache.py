"""The cache of replicates: no answer depends on what is in it, or on whether it can be used."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labs import bench_of, labs

import spadmnist as sp
from spadmnist import plugins
from spadmnist.effects import DarkCounts, DeadTime, Detection, Effect, RowPattern
from spadmnist.inference import replicate_cache
from spadmnist.inference.capture_replicates import CaptureReplicates
from spadmnist.inference.model_path import begin
from spadmnist.inference.replicate_cache import entry_name, keep, make_room, recall
from spadmnist.recording import Capture
from spadmnist.sensor import Sensor

LOOKS = replicate_cache.LOOKS


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SPADMNIST_CACHE", str(tmp_path / "cache"))
    (tmp_path / "cache" / "nulls").mkdir(parents=True)
    return tmp_path / "cache" / "nulls"


def made(number: int = 2, cells: int = 3) -> CaptureReplicates:
    values = {"map": np.arange(float(number * cells)).reshape(number, cells)}
    numbers = np.arange(number, dtype=np.uint64)
    return CaptureReplicates(numbers=numbers, totals=np.ones(number), values=values, laws={"map": ("poisson", None)})


def bare(*more: Effect) -> Sensor:
    return Sensor(sp.Layout(4, 4, 25e-12, 1.0), [Detection(pdp=0.5), DarkCounts(rate=100.0), *more], rules="device")


def flat() -> Capture:
    return sp.Capture("flat", "tr", exposure=1e-3, wavelength=500e-9, irradiance=3e-3)


# --- entries ------------------------------------------------------------------------------------------------------


def test_an_entry_of_another_name_is_none(folder: Path) -> None:
    keep("one", made())
    keep("look", made(), LOOKS)
    assert recall("one") is not None and recall("look") is None and recall("look", LOOKS) is not None
    (folder / "one.replicates").rename(folder / "two.replicates")
    assert recall("two") is None and recall("one") is None


def test_no_pipe_and_no_large_file_is_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(folder / "pipe.replicates")
    assert recall("pipe") is None
    keep("one", made())
    monkeypatch.setattr(replicate_cache, "_LARGEST", 10)
    assert recall("one") is None
    keep("two", made())
    assert not (folder / "two.replicates").exists()


@pytest.mark.parametrize("kind", ["i4, (", "i4,,", "<c16", "|O", "|b1", "(2,)<f8"])
def test_no_type_but_that_of_numbers_is_read(kind: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An entry with its right digest, which somebody else wrote."""
    usual = replicate_cache.json.dumps
    monkeypatch.setattr(replicate_cache.json, "dumps", lambda facts: usual(facts).replace('"<f8"', f'"{kind}"'))
    keep("one", made())
    monkeypatch.undo()
    assert replicate_cache.unpacked((folder / "one.replicates").read_bytes(), "one") is None


def test_a_link_at_the_place_of_an_unfinished_entry_is_not_followed(folder: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    (folder / f".one.{os.getpid()}.part").symlink_to(mine)
    keep("one", made())
    assert mine.read_text() == "mine" and recall("one") is None


def test_first_looks_make_room_before_the_stated_model(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(4):
        keep(f"stated{k}", made())
        keep(f"look{k}", made(), LOOKS)
        os.utime(folder / f"stated{k}.replicates", (k, k))
        os.utime(folder / f"look{k}.looks", (100 + k, 100 + k))
    (folder / ".killed.7.part").touch()
    os.utime(folder / ".killed.7.part", (5, 5))
    (folder / ".another.8.part").touch()
    monkeypatch.setattr(replicate_cache, "_MOST_ENTRIES", 5)
    make_room()
    left = sorted(path.name for path in folder.iterdir())
    assert left == [".another.8.part", "look3.looks", *(f"stated{k}.replicates" for k in range(4))]
    monkeypatch.setattr(replicate_cache, "_MOST_BYTES", 2 * (folder / "stated0.replicates").stat().st_size)
    make_room()
    assert sorted(path.name for path in folder.iterdir())[1:] == ["stated2.replicates", "stated3.replicates"]


def test_room_is_made_while_much_is_written(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep("one", made())
    size = (folder / "one.replicates").stat().st_size
    monkeypatch.setattr(replicate_cache, "_MOST_BYTES", 10 * size)
    monkeypatch.setattr(replicate_cache, "_SWEPT_AFTER", 3 * size)
    for k in range(40):
        keep(f"look{k}", made(), LOOKS)
        assert sum(path.stat().st_size for path in folder.iterdir()) < 16 * size
    assert recall("one") is not None and recall("look39", LOOKS) is not None


@pytest.mark.parametrize("kind", ["loop", "file", "long", "folder"])
def test_a_cache_that_cannot_be_used_does_not_matter(
    kind: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if kind == "loop":
        (folder / "loop.replicates").symlink_to(folder / "loop.replicates")
    elif kind == "file":
        folder.rmdir()
        folder.touch()
    elif kind == "long":
        monkeypatch.setenv("SPADMNIST_CACHE", "x" * 5000)
    else:
        (folder / "a.replicates").mkdir()
        monkeypatch.setattr(replicate_cache, "_MOST_BYTES", 0)
    keep("one", made())
    make_room()
    begin(bench_of(labs(tmp_path)(), 8))


# --- names --------------------------------------------------------------------------------------------------------


class Frame:
    """What numpy takes for an array, and whose text leaves most of it out."""

    def __init__(self, values: np.ndarray):
        self.values = values

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.asarray(self.values, dtype)

    def __repr__(self) -> str:
        return "Frame(...)"


def test_every_number_of_a_parameter_is_in_the_name(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor, names = bare(RowPattern(gain=np.ones(4))), set()
    pattern = next(effect for effect in sensor.effects if effect.name == "row_pattern")
    odd = np.array([1.0, 1.0, 1.3, 1.0])
    for value in (np.ones(4), odd, Frame(np.ones(4)), Frame(odd), np.ones(4).view(np.int64)):
        object.__setattr__(pattern, "gain", value)
        names.add(entry_name(sensor, flat()))
    assert len(names) == 3  # a frame is the array that it holds


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of a package of the user's, older than this program: an effect, and what it imports."""
    package = tmp_path / "mylab"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "helper.py").write_text("FACTOR = 2.0\n")
    (package / "echo.py").write_text(
        "from spadmnist.effects import Effect, parameter\n"
        "from . import helper\n"
        "class MyEcho(Effect, stage='light'):\n"
        "    '''Twice.'''\n"
        "    share = parameter(0.1, '', 'share', symbol='s', bounds=(0, 1), off=0.0, search=(0.01, 0.5))\n"
        "    def apply(self, rate, conditions):\n"
        "        return rate * helper.FACTOR\n"
    )
    for file in package.iterdir():
        os.utime(file, (1e9, 1e9))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(Effect.registry, "classes", dict(Effect.registry.classes))
    monkeypatch.setattr(plugins, "IMPORTED", 2e9)  # as if the tests were older, too
    for name, module in list(sys.modules.items()):  # of tests before this one, whose files are gone
        if isinstance(file := vars(module).get("__file__"), str) and not os.path.exists(file):
            monkeypatch.delitem(sys.modules, name)
    yield package
    for name in [name for name in sys.modules if name.partition(".")[0] == "mylab"]:
        del sys.modules[name]


def test_what_the_users_code_imports_is_in_the_name(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = bare(importlib.import_module("mylab.echo").MyEcho())
    first = entry_name(sensor, flat())
    assert first is not None and first == entry_name(sensor, flat())
    (own / "helper.py").write_text("FACTOR = 3.0\n")
    os.utime(own / "helper.py", (1.1e9, 1.1e9))
    second = entry_name(sensor, flat())  # of another program, which imports it so
    assert second is not None and second != first
    os.utime(own / "helper.py", (3e9, 3e9))
    assert entry_name(sensor, flat()) is None  # it has changed since it was imported
    assert entry_name(bare(), flat()) is not None  # another sensor does not depend on it
    (own / "helper.py").unlink()
    assert entry_name(sensor, flat()) is None


def test_what_a_function_made_is_in_no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Effect.registry, "classes", dict(Effect.registry.classes))

    class MyTwin(DeadTime):
        """Its own."""

    assert entry_name(bare(MyTwin(duration=50e-9)), flat()) is None
