"""Verify and repair: every damage is found and named, and what is repaired is what was made, byte for byte."""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run
from test_factory import (
    METHODS,
    Stop,
    assert_same,
    assert_sentence,
    make,
    tree,
    write_config,
)

import spadmnist
from spadmnist import factory, manifest_file, verify
from spadmnist.cli import cli
from spadmnist.errors import SpadError
from spadmnist.factory import Progress
from spadmnist.store import encoding


@pytest.fixture(scope="module", params=["zarr", pytest.param("hdf5", marks=pytest.mark.slow)])
def format(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def made(format: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset that stays as it is."""
    home = tmp_path_factory.mktemp(f"made-{format}")
    make(write_config(home / "small.yaml", format, ("5 mlux", "2560 mlux"), train=20, test=6), home / "out")
    return home / "out"


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    """A copy of it to be damaged."""
    shutil.copytree(made, tmp_path / "out")
    return tmp_path / "out"


def named(damage: verify.Damage) -> set[str]:
    return {*damage.changed, *damage.missing, *damage.extra}


# --- damages ------------------------------------------------------------------------------------------------------


def flip(root: Path, name: str, rng: random.Random) -> set[str]:
    content = bytearray((root / name).read_bytes())
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    (root / name).write_bytes(content)
    return {name}


def truncate(root: Path, name: str, rng: random.Random) -> set[str]:
    os.truncate(root / name, rng.randrange((root / name).stat().st_size))
    return {name}


def lengthen(root: Path, name: str, rng: random.Random) -> set[str]:
    with open(root / name, "ab") as file:
        file.write(rng.randbytes(rng.randint(1, 9)))
    return {name}


def delete(root: Path, name: str, rng: random.Random) -> set[str]:
    (root / name).unlink()
    return {name}


def swap(root: Path, name: str, rng: random.Random) -> set[str]:
    """With a file of other content."""
    here = (root / name).read_bytes()
    # manifest and config in each other's place are both lost; see below
    both = {"manifest.json", "config.yaml"}
    others = [n for n in sorted(tree(root)) if (root / n).read_bytes() != here and {n, name} != both]
    other = rng.choice(others)
    (root / name).write_bytes((root / other).read_bytes())
    (root / other).write_bytes(here)
    return {name, other}


def extra(root: Path, name: str, rng: random.Random) -> set[str]:
    added = (root / name).parent / f"notes-{rng.randrange(1000)}.txt"
    added.write_text("mine")
    return {str(added.relative_to(root))}


def link(root: Path, name: str, rng: random.Random) -> set[str]:
    """A symbolic link to the very content."""
    shutil.move(root / name, root.parent / "elsewhere")
    (root / name).symlink_to(root.parent / "elsewhere")
    return {name}


def dangling(root: Path, name: str, rng: random.Random) -> set[str]:
    (root / name).unlink()
    (root / name).symlink_to("nowhere")
    return {name}


DAMAGES = (flip, truncate, lengthen, delete, swap, extra, link, dangling)


def damaged_and_repaired(made: Path, work: Path, count: int, seed: int) -> None:
    """`count` damages, one to three at a time, each found, named and repaired."""
    rng = random.Random(seed)
    expected = tree(made)
    names = sorted(expected)
    special = [n for n in names if n.endswith(("manifest.json", "config.yaml"))]
    wrong: list[str] = []
    for trial in range(count):
        root = work / "out"
        for path in work.iterdir():
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        shutil.copytree(made, root)
        kind = DAMAGES[trial % len(DAMAGES)]
        name = ("manifest.json", "config.yaml", rng.choice(special), *rng.choices(names, k=5))[trial // 8 % 8]
        what = f"{trial}: {kind.__name__} {name}"
        try:
            hit = kind(root, name, rng)
            if rng.random() < 0.3 and kind is not link and "manifest.json" not in hit:
                other = rng.choice([n for n in names if n not in hit and n != "manifest.json"])
                hit |= delete(root, other, rng)
                what += f", delete {other}"
            before = tree(root)
            damage = verify.verify(root)
            assert damage, "not found"
            # nothing can be said of the rest where there is no manifest to say it
            expect = {"manifest.json"} if "manifest.json" in hit else hit
            assert expect <= named(damage), f"not named: {hit - named(damage)}"
            if "manifest.json" not in hit:
                assert named(damage) == hit, f"named too much: {named(damage) - hit}"
            assert tree(root) == before, "verify changed something"
            did = verify.repair(root, damage, 1)
            assert did, "says nothing"
            assert_same(root, expected)
            if kind is extra:
                beside = root.parent / "out.extra" / next(n for n in hit if n not in expected)
                assert beside.read_text() == "mine"
        except (AssertionError, Exception) as error:
            wrong.append(f"{what}: {type(error).__name__}: {error}".splitlines()[0])
    assert not wrong, "\n".join([f"{len(wrong)} of {count}", *wrong[:30]])


@pytest.mark.slow
def test_many_damages(made: Path, tmp_path: Path) -> None:
    """Each kind at each kind of place once; damages by the hundred are those of `make faults`."""
    damaged_and_repaired(made, tmp_path, len(DAMAGES) * 8, seed=2)


def test_the_command(root: Path, made: Path) -> None:
    victim = random.Random(3).choice(sorted(n for n in tree(root) if n.startswith("data")))
    flip(root, victim, random.Random(3))
    found = run("verify", root)
    assert found.returncode == 1 and victim in found.stdout and "--repair" in found.stdout, found
    as_json = run("verify", root, "--json")
    assert as_json.returncode == 1
    assert json.loads(as_json.stdout)["changed"] == [victim] and not json.loads(as_json.stdout)["intact"]
    repaired = run("verify", root, "--repair", "--jobs", 1)
    assert repaired.returncode == 0 and victim in repaired.stdout, repaired
    assert_same(root, tree(made))
    again = run("verify", root)
    assert again.returncode == 0 and f"all {len(tree(root))} files" in again.stdout, again


def test_only_the_damaged_files_are_written(root: Path, made: Path) -> None:
    names = sorted(tree(root))
    victims = {n for n in names if n.startswith("data") and "train/00000" in n and "5_mlux" in n}
    victim = sorted(victims)[0]
    before = {n: (root / n).stat().st_ino for n in names}
    (root / victim).write_bytes(b"x")
    verify.repair(root, verify.verify(root), 1)
    after = {n: (root / n).stat().st_ino for n in names}
    assert {n for n in names if before[n] != after[n]} <= {victim}
    assert_same(root, tree(made))


@pytest.mark.parametrize(
    "key", ["files", "shards", "config", "bytes", "sha256", "normalisation", "images", "stream", "provenance"]
)
def test_every_entry_of_the_manifest_may_be_damaged(key: str, root: Path, made: Path) -> None:
    """It is still JSON, and an entry has another name."""
    text = (root / "manifest.json").read_text()
    assert f'"{key}":' in text
    (root / "manifest.json").write_text(text.replace(f'"{key}":', f'"{key[:-1]}~":', 1))
    damage = verify.verify(root)
    assert "manifest.json" in damage.changed
    verify.repair(root, damage, 1)
    assert_same(root, tree(made))


def test_a_name_in_the_manifest_may_be_damaged(root: Path, made: Path) -> None:
    """The file of that name is then no stranger that is moved away."""
    name = sorted(n for n in tree(root) if n.startswith("data"))[-1]
    text = (root / "manifest.json").read_text()
    (root / "manifest.json").write_text(text.replace(f'"{name}"', f'"{name[:-1]}~"', 1))
    damage = verify.verify(root)
    assert "manifest.json" in damage.changed
    verify.repair(root, damage, 1)
    assert_same(root, tree(made))
    assert not (root.parent / "out.extra").exists()


def test_flips_all_over_the_manifest(root: Path, made: Path) -> None:
    rng = random.Random(4)
    content = (made / "manifest.json").read_bytes()
    wrong = []
    for _ in range(300):
        damaged = bytearray(content)
        at, bit = rng.randrange(len(content)), rng.randrange(8)
        damaged[at] ^= 1 << bit
        (root / "manifest.json").write_bytes(damaged)
        try:
            assert "manifest.json" in named(verify.verify(root)), "not found"
        except (AssertionError, Exception) as error:
            wrong.append(f"byte {at} bit {bit}: {type(error).__name__}: {error}".splitlines()[0])
    assert not wrong, "\n".join([f"{len(wrong)} of 300", *wrong[:10]])


@pytest.mark.parametrize(
    "value", ["[]", "{}", "null", "3", "", "\x00" * 50, '{"format": "spadmnist-dataset/1"}', "[" * 99999]
)
def test_a_manifest_that_is_something_else(value: str, root: Path, made: Path) -> None:
    (root / "manifest.json").write_text(value)
    damage = verify.verify(root)
    assert named(damage) == {"manifest.json"} or "manifest.json" in damage.changed
    verify.repair(root, damage, 1)
    assert_same(root, tree(made))


def test_a_manifest_cannot_make_verify_wait(root: Path) -> None:
    (root / "manifest.json").unlink()
    os.mkfifo(root / "manifest.json")
    result = run("verify", root, timeout=10)
    assert result.returncode in (1, 2) and "manifest.json" in result.stdout + result.stderr


def test_names_in_a_manifest_lead_nowhere_else(root: Path, tmp_path: Path) -> None:
    """A hostile manifest, sealed as it should be, lists a file outside."""
    from spadmnist import manifest_file

    (tmp_path / "precious").write_text("mine")
    manifest, _ = manifest_file.read_manifest(root)
    manifest["files"]["../precious"] = {"bytes": 4, "sha256": "0" * 64}
    (root / "manifest.json").write_bytes(manifest_file.seal(manifest))
    damage = verify.verify(root)
    assert damage and "precious" not in " ".join(named(damage) - {"../precious"})
    with contextlib.suppress(SpadError):
        verify.repair(root, damage, 1)
    assert (tmp_path / "precious").read_text() == "mine"


# --- what was lost ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_lost_manifest(root: Path, made: Path) -> None:
    (root / "manifest.json").unlink()
    result = run("verify", root)
    assert result.returncode == 1 and "missing: manifest.json" in result.stdout
    repaired = run("verify", root, "--repair")
    assert repaired.returncode == 0, repaired
    assert_same(root, tree(made))


def test_a_lost_manifest_and_damaged_data(root: Path, made: Path) -> None:
    (root / "manifest.json").unlink()
    rng = random.Random(5)
    for victim in rng.sample(sorted(n for n in tree(root) if n.startswith("data")), 5):
        flip(root, victim, rng)
    verify.repair(root, verify.verify(root), 1)
    assert_same(root, tree(made))


def test_a_lost_manifest_and_an_extra_file(root: Path, made: Path) -> None:
    """The file is moved beside, as with a manifest."""
    (root / "manifest.json").unlink()
    (root / "notes.txt").write_text("mine")
    result = run("verify", root, "--repair")
    assert result.returncode == 0, result
    assert_same(root, tree(made))
    assert (root.parent / "out.extra" / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("manifest", ["missing", "damaged"])
def test_a_lost_manifest_and_a_lost_config(manifest: str, root: Path) -> None:
    """It was a dataset: damage is found, and what repair cannot do is said."""
    (root / "config.yaml").unlink()
    if manifest == "missing":
        (root / "manifest.json").unlink()
    else:
        (root / "manifest.json").write_text("{")
    before = tree(root)
    result = run("verify", root)
    assert result.returncode == 1, result
    assert "manifest.json" in result.stdout and "config.yaml" in result.stdout
    repaired = run("verify", root, "--repair")
    assert_sentence(repaired, "config")
    assert_same(root, before)


@pytest.mark.slow
def test_a_folder_that_never_was_a_dataset(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "manifest.json").write_text('{"files": {}}')
    (tmp_path / "file").touch()
    for name in ("empty", "foreign", "file", "nothing"):
        for options in ([], ["--repair"], ["--json"]):
            result = run("verify", tmp_path / name, *options)
            assert_sentence(result, name)
            assert result.stdout == "" and len(result.stderr.splitlines()) == 1
    assert sorted(tree(tmp_path)) == ["empty", "file", "foreign/manifest.json"]


def test_an_unfinished_dataset(made: Path, tmp_path: Path) -> None:
    stop = iter(range(2))

    def advance(work: float, note: str) -> None:
        if next(stop, None) is None:
            raise Stop

    with pytest.raises(Stop):
        make(made.parent / "small.yaml", tmp_path / "out", progress=Progress(advance=advance))
    assert_sentence(run("verify", tmp_path / "out"), "not finished")


# --- folders and links --------------------------------------------------------------------------------------------


def a_folder(root: Path) -> Path:
    return next(root.glob("data*")) / "5_mlux" / "train"


def test_a_folder_that_became_a_link(root: Path, made: Path) -> None:
    """Repair writes nothing to where the link leads."""
    folder = a_folder(root)
    shutil.move(folder, root.parent / "elsewhere")
    folder.symlink_to(root.parent / "elsewhere")
    victim = next(p for p in (root.parent / "elsewhere").rglob("*") if p.is_file())
    victim.write_bytes(b"mine")
    before = tree(root.parent / "elsewhere")
    damage = verify.verify(root)
    assert damage.missing and damage.extra == (str(folder.relative_to(root)),)
    verify.repair(root, damage, 1)
    assert_same(root.parent / "elsewhere", before)
    assert_same(root, tree(made))


def test_a_folder_that_became_a_file(root: Path, made: Path) -> None:
    shutil.rmtree(a_folder(root))
    a_folder(root).write_text("mine")
    damage = verify.verify(root)
    assert damage.missing
    verify.repair(root, damage, 1)
    assert_same(root, tree(made))


@pytest.mark.parametrize("name", ["config.yaml", "manifest.json", "data"])
def test_a_file_that_became_a_folder(name: str, root: Path, made: Path) -> None:
    victim = next(p for p in a_folder(root).rglob("*") if p.is_file()) if name == "data" else root / name
    victim.unlink()
    victim.mkdir()
    damage = verify.verify(root)
    assert str(victim.relative_to(root)) in named(damage)
    verify.repair(root, damage, 1)
    assert_same(root, tree(made))


def test_a_lost_tree(root: Path, made: Path) -> None:
    shutil.rmtree(next(root.glob("data*")))
    verify.repair(root, verify.verify(root), 2)
    assert_same(root, tree(made))


PLANTED = "5_mlux/train/00000"


def made_elsewhere(root: Path, plant: bool = False) -> None:
    """Let a dataset be that of other versions, which may have made another flux image."""
    manifest = json.loads((root / "manifest.json").read_text())
    manifest["provenance"]["numpy"] = "1.0"
    if plant:
        encoding = manifest_file.encoding_in(manifest, root)
        column = encoding.reader(root, PLANTED).column("reconstruction/counts")
        other = replace(column, data=column.data + np.float32(1))
        manifest["files"] |= encoding.append(root, PLANTED, {"reconstruction/counts": other})
        shutil.rmtree(root / ".spadmnist")
    (root / "manifest.json").write_bytes(manifest_file.seal(manifest))


def a_file(root: Path) -> str:
    """That of the planted shard."""
    return next(name for name in tree(root) if PLANTED in name)


def test_other_versions_repair(root: Path, made: Path) -> None:
    made_elsewhere(root)
    before, name = tree(root), a_file(root)
    (root / name).unlink()
    verify.repair(root, verify.verify(root), 1)
    assert_same(root, before)


def test_other_versions_that_make_other_bytes_do_not_repair(root: Path) -> None:
    name = a_file(root)
    made_elsewhere(root, plant=True)
    (root / name).unlink()
    with pytest.raises(SpadError, match=rf"{name}: this machine makes other bytes .*here .*python.*there .*numpy 1\.0"):
        verify.repair(root, verify.verify(root), 1)
    assert not (root / name).exists()


def test_other_versions_that_make_other_bytes_do_not_reconstruct(few: dict[int, Path], tmp_path: Path) -> None:
    for plant in (False, True):
        root = tmp_path / f"out-{plant}"
        shutil.copytree(few[2], root)
        made_elsewhere(root, plant)
        before = tree(root)
        if plant:
            with pytest.raises(SpadError, match=r"this machine makes other bytes .*there .*numpy 1\.0"):
                factory.add_reconstructions(root, METHODS[2:3], 1)
            assert {name: content for name, content in tree(root).items() if ".spadmnist" not in name} == before
        else:
            factory.add_reconstructions(root, METHODS[2:3], 1)


def test_versions_are_no_part_of_what_a_dataset_is(root: Path) -> None:
    """They stand beside the seal, and a changed one is still found."""
    manifest = json.loads((root / "manifest.json").read_text())
    newest = encoding(manifest["config"]["output"]["format"]).number
    assert (manifest["stream"], manifest["encoding"]) == (1, newest) and "versions" not in manifest
    assert manifest["provenance"].items() > factory.versions().items()
    made_elsewhere(root)
    assert json.loads((root / "manifest.json").read_text())["sha256"] == manifest["sha256"]
    assert not verify.verify(root)
    (root / "manifest.json").write_text((root / "manifest.json").read_text().replace('"1.0"', '"1.1"'))
    assert verify.verify(root).changed == ("manifest.json",)


def test_data_of_another_dataset_are_not_put_in(root: Path, tmp_path: Path) -> None:
    """With other images than the manifest's, repair says so and changes nothing."""
    images = next(root.glob("data*/images"))
    shutil.rmtree(images)
    config = json.loads((root / "manifest.json").read_text())["config"]
    assert config["scene"]["images"]["source"] == "digits"
    before = tree(root)
    damage = verify.verify(root)
    with pytest.MonkeyPatch.context() as patch:
        from spadmnist.experiment import Experiment

        load = Experiment.load_images

        def other(self: Any, images_dir: Path | None = None) -> Any:
            splits = load(self, images_dir)
            return {split: replace(images, pixels=255 - images.pixels) for split, images in splits.items()}

        patch.setattr(Experiment, "load_images", other)
        with pytest.raises(SpadError, match="images"):
            verify.repair(root, damage, 1)
    assert_same(root, before)


# --- reconstruct --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def few(made: Path, format: str, tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Datasets of fewer methods, by how many."""
    home = tmp_path_factory.mktemp(f"few-{format}")
    out = {}
    for n in (0, 2):
        file = write_config(home / f"{n}.yaml", format, ("5 mlux", "2560 mlux"), METHODS[:n], train=20, test=6)
        make(file, home / f"out{n}")
        out[n] = home / f"out{n}"
    return out


@pytest.mark.parametrize("n", [0, 2])
@pytest.mark.parametrize("jobs", [1, 2])
def test_reconstruct_makes_what_generate_makes(
    n: int, jobs: int, few: dict[int, Path], made: Path, tmp_path: Path
) -> None:
    shutil.copytree(few[n], tmp_path / "out")
    added, _ = factory.add_reconstructions(tmp_path / "out", METHODS[n:], jobs)
    assert added == list(METHODS[n:])
    assert_same(tmp_path / "out", tree(made))
    assert factory.add_reconstructions(tmp_path / "out", METHODS[n:], jobs)[0] == []
    assert_same(tmp_path / "out", tree(made))


@pytest.mark.slow
def test_reconstruct_by_command_one_after_the_other(few: dict[int, Path], made: Path, tmp_path: Path) -> None:
    shutil.copytree(few[2], tmp_path / "out")
    for chosen in (METHODS[2:4], METHODS[4:]):
        options = [word for method in chosen for word in ("--method", method)]
        result = run("reconstruct", tmp_path / "out", *options, "--jobs", 1, "--json")
        assert result.returncode == 0, result.stderr
        assert json.loads(result.stdout)["added"] == list(chosen)
    assert_same(tmp_path / "out", tree(made))


@pytest.mark.parametrize("after", [1, 3])
def test_an_interrupted_reconstruct_goes_on(after: int, few: dict[int, Path], made: Path, tmp_path: Path) -> None:
    root = tmp_path / "out"
    shutil.copytree(few[2], root)
    stop = iter(range(after))

    def advance(work: float, note: str) -> None:
        if next(stop, None) is None:
            raise Stop

    with pytest.raises(Stop):
        factory.add_reconstructions(root, METHODS[2:], 1, Progress(advance=advance))
    # it can still be read, and what was there is as it was
    part, complete = spadmnist.open(root)["5 mlux", "train"], spadmnist.open(made)["5 mlux", "train"]
    assert list(part.reconstruction) == list(METHODS[:2])
    assert (part.reconstruction["counts"][:] == complete.reconstruction["counts"][:]).all()
    with pytest.raises(SpadError, match="another dataset"):
        factory.add_reconstructions(root, METHODS[3:4], 1)
    factory.add_reconstructions(root, METHODS[2:], 1)
    assert_same(root, tree(made))


def interrupted_reconstruct(finished: Path, root: Path, shards: int) -> Path:
    """A copy of a dataset, to so many of whose shards a method was added."""
    shutil.copytree(finished, root)
    stop = iter(range(shards))

    def advance(work: float, note: str) -> None:
        if next(stop, None) is None:
            raise Stop

    with pytest.raises(Stop):
        factory.add_reconstructions(root, METHODS[2:], 1, Progress(advance=advance))
    return root


def test_repair_after_an_interrupted_reconstruct(few: dict[int, Path], tmp_path: Path) -> None:
    """The dataset is again what it was before."""
    root = interrupted_reconstruct(few[2], tmp_path / "out", 1)
    damage = verify.verify(root)
    assert damage
    verify.repair(root, damage, 1)
    assert_same(root, tree(few[2]))


def test_verify_of_an_interrupted_reconstruct_says_how_it_goes_on(few: dict[int, Path], tmp_path: Path) -> None:
    """Nothing there is damaged. What is in its state is nobody's loss either."""
    root = interrupted_reconstruct(few[2], tmp_path / "out", 1)
    with pytest.raises(SpadError, match=r"are being added to it; `spadmnist reconstruct \S+ .*` goes on where"):
        cli(["verify", str(root)], standalone_mode=False)
    assert all(not name.startswith(".spadmnist") for name in verify.verify(root).extra)
    cli(["verify", str(root), "--repair"], standalone_mode=False)
    cli(["verify", str(root)], standalone_mode=False)
    assert_same(root, tree(few[2]))


def test_reconstruct_of_damaged_data_is_refused(few: dict[int, Path], made: Path, tmp_path: Path) -> None:
    """Or the damage is where it does not count, and the result is as it should be."""
    expected = tree(made)
    for at in (0.3, 0.5, 0.7):
        root = tmp_path / f"out{at}"
        shutil.copytree(few[2], root)
        for victim in [p for p in a_folder(root).rglob("*") if "frames/bits/c" in str(p) or p.suffix == ".h5"]:
            content = bytearray(victim.read_bytes())
            content[int(len(content) * at)] ^= 255
            victim.write_bytes(content)
        options = [word for method in METHODS[2:] for word in ("--method", method)]
        result = run("reconstruct", root, "--jobs", 1, *options)
        if result.returncode == 0 and (root / "data").exists():
            assert_same(root, expected)
        else:
            assert_sentence(result, "train/00000")


def shards_at(root: Path, level: str = "5_mlux") -> list[Path]:
    """The shards of a light level."""
    return sorted(path for path in (root / "data" / level).rglob("0*") if path.is_file())


def test_reconstruct_does_not_vouch_for_a_shard_of_another_dataset(few: dict[int, Path], tmp_path: Path) -> None:
    """Nor for one that is missing; nothing is changed then."""
    root, other = tmp_path / "out", tmp_path / "other"
    shutil.copytree(few[2], root)
    make(few[2].parent / "2.yaml", other, seed=4)
    shutil.copyfile(shards_at(other)[-1], shards_at(root)[-1])
    before, damage = tree(root), verify.verify(root)
    again = r"spadmnist verify .* --repair"
    with pytest.raises(SpadError, match=again):
        factory.add_reconstructions(root, METHODS[2:3], 1)
    assert verify.verify(root).changed == damage.changed == (str(shards_at(root)[-1].relative_to(root)),)
    assert_same(root, before)
    shards_at(root, "2560_mlux")[-1].unlink()
    before = tree(root)
    with pytest.raises(SpadError, match=again):
        factory.add_reconstructions(root, METHODS[2:3], 1)
    assert_same(root, before)
    verify.repair(root, verify.verify(root), 1)
    assert_same(root, tree(few[2]))


def test_reconstruct_compares_more_than_the_size(
    few: dict[int, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, other = tmp_path / "out", tmp_path / "other"
    shutil.copytree(few[2], root)
    make(few[2].parent / "2.yaml", other, seed=4)
    shutil.copyfile(shards_at(other)[-1], shards_at(root)[-1])
    monkeypatch.setattr(manifest_file, "check_there", lambda *_: None)  # as if it had the same size
    with pytest.raises(SpadError, match=r"this is not the file that was made.*spadmnist verify .* --repair"):
        factory.add_reconstructions(root, METHODS[2:3], 1)
    verify.repair(root, verify.verify(root), 1)
    assert_same(root, tree(few[2]))


@pytest.mark.parametrize("n", [0, 2])
def test_a_shard_that_was_added_to_and_not_noted_is_known(
    n: int, few: dict[int, Path], made: Path, tmp_path: Path
) -> None:
    """Killed between the shard and its note: the same command goes on."""
    root = tmp_path / "out"
    shutil.copytree(few[n], root)
    note, levels = factory.note, []

    def killed(root: Path, shard: Any, *more: Any) -> None:
        levels.append(shard.level)
        if len([level for level in levels if level is not None]) == 2:
            raise Stop
        note(root, shard, *more)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Stop):
        patch.setattr(factory, "note", killed)
        factory.add_reconstructions(root, METHODS[n:], 1)
    factory.add_reconstructions(root, METHODS[n:], 1)
    assert_same(root, tree(made))


@pytest.fixture
def begun(few: dict[int, Path], tmp_path: Path) -> Path:
    """A dataset to some of whose shards a method was added."""
    return interrupted_reconstruct(few[2], tmp_path / "begun", 2)


def test_no_other_command_ends_an_interrupted_reconstruct(begun: Path, few: dict[int, Path], made: Path) -> None:
    before, chosen = tree(begun), " ".join(f"--method {name}" for name in METHODS[2:])
    again = rf"`spadmnist reconstruct \S+ {chosen}` goes on"
    for file in (few[2].parent / "2.yaml", made.parent / "small.yaml"):
        with pytest.raises(SpadError, match=again):
            make(file, begun)
    for name in (METHODS[0], METHODS[3]):
        with pytest.raises(SpadError, match=again):
            factory.add_reconstructions(begun, [name], 1)
    with pytest.raises(SpadError, match=r"holds another dataset: config\.seed"):
        make(few[2].parent / "2.yaml", begun, seed=4)
    assert_same(begun, before)
    factory.add_reconstructions(begun, METHODS[2:], 1)
    assert_same(begun, tree(made))


def test_an_interrupted_reconstruct_does_not_vouch_for_what_was_changed_meanwhile(
    begun: Path, few: dict[int, Path]
) -> None:
    shard = shards_at(begun)[0]
    assert shard.read_bytes() != shards_at(few[2])[0].read_bytes()
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 1
    shard.write_bytes(content)
    with pytest.raises(SpadError, match=r"spadmnist verify .* --repair"):
        factory.add_reconstructions(begun, METHODS[2:], 1)
    verify.repair(begun, verify.verify(begun), 1)
    assert_same(begun, tree(few[2]))


def test_a_shard_of_another_dataset_is_not_read_as_its_own(few: dict[int, Path], tmp_path: Path) -> None:
    root, other = tmp_path / "out", tmp_path / "other"
    shutil.copytree(few[2], root)
    make(few[2].parent / "2.yaml", other, seed=4)
    mine, theirs = shards_at(root)[-1], shards_at(other)[-1]
    if mine.stat().st_size == theirs.stat().st_size:
        pytest.skip("they have one size")
    opened = spadmnist.open(root)
    shutil.copyfile(theirs, mine)
    with pytest.raises(SpadError, match=rf"this file has {theirs.stat().st_size} bytes, and it had"):
        opened["5 mlux", "train"].reconstruction["counts"][:]
    assert_sentence(run("export", root, "-o", tmp_path / "e", "--format", "png"), "spadmnist verify")


def test_damage_that_reconstruct_does_not_read_stays_visible(few: dict[int, Path], tmp_path: Path) -> None:
    """The new manifest must not vouch for what was damaged before."""
    root = tmp_path / "out"
    shutil.copytree(few[2], root)
    victim = next(p for p in next(root.glob("data*/images")).rglob("*") if p.is_file())
    content = bytearray(victim.read_bytes())
    content[len(content) // 2] ^= 1
    victim.write_bytes(content)
    (root / "config.yaml").write_text("x")
    factory.add_reconstructions(root, METHODS[2:3], 1)
    assert str(victim.relative_to(root)) in verify.verify(root).changed


@pytest.mark.parametrize(
    "option", [("--jobs", "1"), ("--cluster", "tcp://host:1"), ("--no-shared",), ("--images-dir", ".")]
)
def test_what_repair_alone_takes_is_refused_without_it(tmp_path: Path, option: tuple[str, ...]) -> None:
    found = run("verify", tmp_path, *option)
    assert found.returncode == 2 and f"{option[0]}: belongs to --repair" in found.stderr, found
