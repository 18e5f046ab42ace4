"""A shard in another one's place is told from it: no photon is of another level, split or image, and nothing waits."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from commands import run
from test_factory import assert_same, assert_sentence, interrupted, make, tree, write_config

import spadmnist
from spadmnist import factory, shard_plan, verify
from spadmnist.errors import InputError, SpadError
from spadmnist.store import Encoding, encoding

LEVELS = ("40 mlux", "2560 mlux")
METHODS = ("counts", "str_flux")
HERE, THERE = "40_mlux/train/00001", "2560_mlux/train/00001"  # the shard that is lost, and the one in its place


@pytest.fixture(scope="module", autouse=True)
def small_shards() -> Iterator[None]:
    """Ten images a shard, so that a split has several."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shard_plan, "_IMAGES_PER_SHARD", 10)
        yield


@pytest.fixture(scope="module", params=[encoding("zarr"), encoding("hdf5")], ids=str)
def written(request: pytest.FixtureRequest) -> Encoding:
    found: Encoding = request.param
    return found


@pytest.fixture(scope="module")
def made(written: Encoding, tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("made")
    file = write_config(home / "small.yaml", written.format, LEVELS, METHODS, train=20, test=10)
    make(file, home / "out", encoding=written)
    assert place(home / "out", HERE).exists() and place(home / "out", "images/train/00000").exists()
    return home / "out"


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "out")
    return tmp_path / "out"


@contextlib.contextmanager
def at_once() -> Iterator[None]:
    """Whatever waits is interrupted after 60 s."""

    def ring(number: int, frame: Any) -> None:
        raise AssertionError("it waits")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(60)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def place(root: Path, path: str) -> Path:
    """Where a shard lies, of the encoding that the others have."""
    return root / max(Encoding.every.values(), key=lambda one: one.count(root)).location(path)


def remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def copy(source: Path, target: Path) -> None:
    remove(target)
    shutil.copytree(source, target) if source.is_dir() else shutil.copyfile(source, target)


# --- faults -------------------------------------------------------------------------------------------------------


def other_level(root: Path) -> None:
    copy(place(root, THERE), place(root, HERE))


def other_split(root: Path) -> None:
    copy(place(root, "40_mlux/test/00000"), place(root, HERE))


def other_images(root: Path) -> None:
    copy(place(root, "40_mlux/train/00000"), place(root, HERE))


def exchanged(root: Path) -> None:
    place(root, HERE).rename(root / "aside")
    place(root, THERE).rename(place(root, HERE))
    (root / "aside").rename(place(root, THERE))


def renamed(root: Path) -> None:
    remove(place(root, HERE))
    place(root, THERE).rename(place(root, HERE))


def originals(root: Path) -> None:
    copy(place(root, "images/train/00000"), place(root, HERE))


def linked(root: Path) -> None:
    remove(place(root, HERE))
    place(root, HERE).symlink_to(place(root, THERE))


def level_linked(root: Path) -> None:
    folder = place(root, HERE).parents[1]
    shutil.rmtree(folder)
    folder.symlink_to(place(root, THERE).parents[1])


def pipe(root: Path) -> None:
    remove(place(root, HERE))
    os.mkfifo(place(root, HERE))


def listener(root: Path) -> None:
    remove(place(root, HERE))
    with socket.socket(socket.AF_UNIX) as made, contextlib.chdir(place(root, HERE).parent):
        made.bind(place(root, HERE).name)


def device(root: Path) -> None:
    remove(place(root, HERE))
    place(root, HERE).symlink_to("/dev/zero")


def folder(root: Path) -> None:
    remove(place(root, HERE))
    place(root, HERE).mkdir()


FAULTS = [
    other_level,
    other_split,
    other_images,
    exchanged,
    renamed,
    originals,
    linked,
    level_linked,
    pipe,
    listener,
    device,
    folder,
]


def pieces(root: Path) -> dict[str, Callable[[], Any]]:
    """Everything that can be read of a dataset, by image of its first split."""
    part = spadmnist.open(root)["40 mlux", "train"]
    found: dict[str, Callable[[], Any]] = {"labels": lambda: part.labels}
    for i in range(len(part)):
        found |= {
            f"tr {i}": lambda i=i: part.tr[i].ticks,  # type: ignore[misc]
            f"qis {i}": lambda i=i: part.qis[i],  # type: ignore[misc]
            f"str {i}": lambda i=i: part.str[i],  # type: ignore[misc]
            f"images {i}": lambda i=i: part.images[i],  # type: ignore[misc]
            f"counts {i}": lambda i=i: part.reconstruction["counts"][i],  # type: ignore[misc]
        }
    return found


def refused(root: Path, made: Path) -> set[str]:
    """What cannot be read of a damaged dataset; all else is as it was made."""
    expected, lost = pieces(made), set()
    for name, read in pieces(root).items():
        try:
            found = read()
        except InputError as error:
            assert "spadmnist verify" in str(error) and "\n" not in str(error), error
            lost.add(name)
        else:
            assert np.array_equal(found, expected[name]()), name
    return lost


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_a_shard_that_belongs_elsewhere(fault: Callable[[Path], None], root: Path, made: Path) -> None:
    """Readers refuse it and nothing else, verify names it, repair makes it again."""
    fault(root)
    with at_once():
        lost = refused(root, made)
        assert {f"{what} {i}" for what in ("tr", "qis", "str", "counts") for i in range(10, 20)} <= lost
        assert not lost & {"labels", *(f"images {i}" for i in range(20))}
        damage = verify.verify(root)
        assert damage
        with pytest.raises(SpadError, match=r"00001|40_mlux|link"):
            factory.add_reconstructions(root, ["inter_photon"], 1)
        shutil.rmtree(root)
        shutil.copytree(made, root)
        fault(root)
        verify.repair(root, verify.verify(root), 1)
    assert_same(root, tree(made))


@pytest.mark.parametrize("fault", [other_level, pipe, linked], ids=lambda fault: fault.__name__)
def test_the_commands_say_so(fault: Callable[[Path], None], root: Path) -> None:
    fault(root)
    # the sheet shows images of the first shard alone
    if fault is not linked:
        place(root, HERE).rename(root / "lost")
        remove(place(root, "40_mlux/train/00000"))
        (root / "lost").rename(place(root, "40_mlux/train/00000"))
    assert_sentence(run("reconstruct", root, "--method", "inter_photon", "--jobs", 1, timeout=60), "40_mlux/train/0000")
    shutil.rmtree(root / ".spadmnist", ignore_errors=True)
    if fault is not linked:
        result = run("inspect", root, "--plot", root.parent / "sheet.png", timeout=60)
        assert_sentence(result, "40_mlux/train/00000", "spadmnist verify")
    result = run("verify", root, timeout=60)
    assert result.returncode == 1 and "40_mlux/train/0000" in result.stdout


@pytest.mark.parametrize("fault", [other_level, other_images, linked, pipe], ids=lambda fault: fault.__name__)
def test_a_run_goes_on_without_it(fault: Callable[[Path], None], made: Path, tmp_path: Path) -> None:
    """What stands in a shard's place when a run goes on is made anew, where it is not what was made."""
    file, root = made.parent / "small.yaml", tmp_path / "out"
    interrupted(file, root, 6)
    assert place(root, HERE).exists() and place(root, THERE).exists() and not (root / "manifest.json").exists()
    fault(root)
    with at_once():
        make(file, root)
    assert_same(root, tree(made))


def test_a_run_goes_on_without_a_shard_that_was_cut(made: Path, tmp_path: Path) -> None:
    file, root = made.parent / "small.yaml", tmp_path / "out"
    interrupted(file, root, 6)
    victim = max((p for p in [place(root, HERE), *place(root, HERE).rglob("*")] if p.is_file()), key=os.path.getsize)
    os.truncate(victim, victim.stat().st_size // 2)
    make(file, root)
    assert_same(root, tree(made))


# --- parts of shards ----------------------------------------------------------------------------------------------


def test_labels_that_are_lost(root: Path, made: Path) -> None:
    """They are not taken for images that never had any."""
    shard = place(root, "images/train/00000")
    if shard.suffix == ".h5":
        with h5py.File(shard, "a") as file:
            del file["labels"]
    else:
        reader = encoding("zarr").reader(root, "images/train/00000")
        kept = {name: reader.column(name) for name in reader.names if name != "labels"}
        encoding("zarr").write(root, "images/train/00000", kept, reader.attributes)
    assert "labels" in refused(root, made)


@pytest.mark.parametrize("written", [encoding("zarr", 1)], indirect=True, ids=str)
@pytest.mark.parametrize("name", ["tr", "frames", "reconstruction", "tr/counts", "reconstruction/counts"])
def test_arrays_of_another_level(name: str, root: Path, made: Path) -> None:
    copy(place(root, THERE) / name, place(root, HERE) / name)
    lost = refused(root, made)
    wanted = {"tr": "tr", "frames": "qis", "reconstruction": "counts"}[name.partition("/")[0]]
    assert {f"{wanted} {i}" for i in range(10, 20)} <= lost


@pytest.mark.parametrize("written", [encoding("zarr", 1)], indirect=True, ids=str)
@pytest.mark.parametrize("name", ["c.0", "zarr.json"])
def test_a_pipe_in_place_of_an_arrays_file(name: str, root: Path, made: Path) -> None:
    victim = place(root, HERE) / "tr" / "ticks" / name
    victim.unlink()
    os.mkfifo(victim)
    with at_once():
        assert "tr 10" in refused(root, made)
        assert str(victim.relative_to(root)) in verify.verify(root).changed
        verify.repair(root, verify.verify(root), 1)
    assert_same(root, tree(made))


@pytest.mark.parametrize("written", [encoding("hdf5")], indirect=True, ids=str)
@pytest.mark.parametrize("what", ["starts", "lines", "width", "tick", "length", "images"])
def test_a_shard_of_hdf5_that_was_written_anew(what: str, root: Path, made: Path) -> None:
    """Its checksums are right, and what it says is not: a sentence, and no photons."""
    with h5py.File(place(root, HERE), "a") as file:
        if what == "starts":
            file["tr/starts"][...] = file["tr/starts"][...] + 10**6
            file["frames/starts"][...] = file["frames/starts"][...] + 10**6
        elif what == "lines":
            del file["frames/bits"].attrs["lines_per_image"]
        elif what == "width":
            file["frames/bits"].attrs["columns"] = 4
        elif what == "tick":
            file["tr/ticks"].attrs["tick_s"] = 1e-9
        elif what == "length":
            data = file["tr/counts"][:9]
            del file["tr/counts"]
            file["tr/counts"] = data
        else:
            file.attrs["stop"] = 19
    lost = refused(root, made)
    assert "tr 10" in lost if what != "lines" else "qis 10" in lost


def test_a_plan_or_a_record_that_is_a_pipe(made: Path, tmp_path: Path) -> None:
    file, root = made.parent / "small.yaml", tmp_path / "out"
    interrupted(file, root, 6)
    record = root / ".spadmnist" / "shards" / f"{HERE}.json"
    record.unlink(missing_ok=True)
    os.mkfifo(record)
    with at_once():
        make(file, root)
    assert_same(root, tree(made))
    shutil.rmtree(root)
    interrupted(file, root, 6)
    (root / ".spadmnist" / "plan.json").unlink()
    os.mkfifo(root / ".spadmnist" / "plan.json")
    with at_once(), pytest.raises(SpadError, match=r"plan\.json"):
        make(file, root)
