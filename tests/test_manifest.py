"""A manifest whose seal is right and whose content is wrong: a sentence, and no file that belongs there is moved."""

from __future__ import annotations

import copy
import json
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import pytest
from commands import run
from test_factory import assert_same, assert_sentence, make, tree, write_config

import spadmnist
from spadmnist import cli, disk, manifest, manifest_file, report, verify
from spadmnist.errors import InputError, SpadError
from spadmnist.events import Layout
from spadmnist.measurement import write


@pytest.fixture(scope="module", params=["zarr", "hdf5"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp(f"made-{request.param}")
    levels, methods = ("5 mlux", "2560 mlux"), ("counts", "str_flux")
    make(write_config(home / "small.yaml", request.param, levels, methods, train=10, test=4), home / "out")
    return home / "out"


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "out")
    return tmp_path / "out"


def sealed(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the manifest, and seal it as it should be."""
    found = json.loads((root / "manifest.json").read_bytes())
    change(found)
    (root / "manifest.json").write_bytes(manifest_file.seal(found))


def leaves(value: Any, above: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of every entry, groups as well; of long groups the first two."""
    for key in list(value if isinstance(value, dict) else range(len(value)))[:6]:
        yield (*above, key)
        if isinstance(value[key], dict | list):
            yield from leaves(value[key], (*above, key))


def use(root: Path) -> None:
    """Everything that takes a manifest at its word."""
    found = manifest_file.intact_manifest(root)
    report.level_table(found)
    report.level_rows(found)
    opened = spadmnist.open(root)
    for level in opened.levels:
        for split in opened.splits:
            part = opened[level, split]
            _ = part.labels, part.images[0]
            for readout in part.readouts:
                getattr(part, readout)[0]
            for method in part.reconstruction.values():
                _ = method.normalised[0]


@pytest.mark.slow
def test_every_entry_is_checked(root: Path) -> None:
    """Whatever is left out or put in its place is a sentence, or changes nothing that is read."""
    good = json.loads((root / "manifest.json").read_bytes())
    assert manifest.problems(good, "m") == []
    use(root)
    wrong = []
    rng = random.Random(6)
    values = ["gone", None, "x", -1, [], {}, "{a: " * 1000, json.loads("[" * 300 + "]" * 300)]
    for place in leaves(good):
        for value in rng.sample(values, 3):  # two formats, hundreds of places: each value comes at many
            changed = copy.deepcopy(good)
            group = changed
            for key in place[:-1]:
                group = group[key]
            if value == "gone":
                del group[place[-1]]
            else:
                group[place[-1]] = value
            (root / "manifest.json").write_bytes(manifest_file.seal(changed))
            try:
                use(root)
                verify.verify(root)
            except SpadError as error:
                if "\n" in str(error) or len(str(error)) > 3000:
                    wrong.append(f"{place} {value}: {error}")
            except Exception as error:
                wrong.append(f"{place} {value}: {type(error).__name__}: {error}")
    assert not wrong, "\n".join(wrong[:20])


WRONG: dict[str, Callable[[dict[str, Any]], object]] = {
    "files": lambda m: m["files"].update({"../precious": {"bytes": 4, "sha256": "0" * 64}}),
    "images.splits.train.images": lambda m: m["images"]["splits"]["train"].update(images=0),
    "levels": lambda m: m["levels"].reverse(),
    "seed": lambda m: m.update(seed=9),
    "settings.frames": lambda m: m["settings"].update(frames="100"),
    "shards": lambda m: m["shards"].pop(),
    "shards[2]": lambda m: m["shards"][2].update(start=1),
    "shards[3]": lambda m: m["shards"][3].update(split="other"),
    "statistics.5 mlux.train": lambda m: m["statistics"]["5 mlux"]["train"].update(images=9),
    "normalisation": lambda m: m["normalisation"].pop("5 mlux"),
    "surprise": lambda m: m.update(surprise=1),
}


@pytest.mark.parametrize("place", WRONG)
def test_what_is_wrong_is_said_with_its_place(place: str, root: Path) -> None:
    sealed(root, WRONG[place])
    with pytest.raises(InputError) as caught:
        spadmnist.open(root)
    said = str(caught.value)
    assert f"manifest.json: {place}" in said and "--repair" in said and "\n" not in said, said


def test_all_mistakes_at_once(root: Path) -> None:
    def change(found: dict[str, Any]) -> None:
        found["seed"], found["levels"][0]["value"], found["images"]["dtype"] = "x", -1.0, "complex"

    sealed(root, change)
    with pytest.raises(InputError, match=r"images\.dtype.*seed.*levels\[0\]\.value"):
        spadmnist.open(root)


def test_statistics_that_are_not_those_of_the_shards(root: Path, made: Path) -> None:
    """Readers take them as they are; verify reads every shard anyway."""
    sealed(root, lambda found: found["statistics"]["5 mlux"]["train"]["tr"].update(detections=7))
    damage = verify.verify(root)
    assert damage.changed == ("manifest.json",)
    with pytest.raises(SpadError, match=r"its statistics are not those of its shards; remove manifest\.json"):
        verify.repair(root, damage, 1)
    (root / "manifest.json").unlink()
    verify.repair(root, verify.verify(root), 1)
    assert_same(root, tree(made))


def test_it_is_made_again(root: Path, made: Path) -> None:
    sealed(root, lambda found: found["shards"].pop())
    assert_sentence(run("inspect", root), "manifest.json: shards", "--repair")
    damage = verify.verify(root)
    assert damage.changed == ("manifest.json",)
    verify.repair(root, damage, 1)
    assert_same(root, tree(made))


def unlist_a_shard_file(found: dict[str, Any]) -> object:
    names = [name for name in found["files"] if "5_mlux/train/0" in name]
    return found["files"].pop(names[0])


def unlist_the_config(found: dict[str, Any]) -> object:
    return found["files"].pop("config.yaml")


@pytest.mark.parametrize("change", [unlist_a_shard_file, unlist_the_config], ids=lambda change: change.__name__)
def test_repair_moves_nothing_away_that_the_config_asks_for(
    change: Callable[[dict[str, Any]], object], root: Path, made: Path
) -> None:
    sealed(root, change)
    before = tree(root)
    damage = verify.verify(root)
    assert damage.extra
    with pytest.raises(SpadError, match=r"does not list .*, which its config asks for; remove manifest\.json"):
        verify.repair(root, damage, 1)
    assert_same(root, before)
    (root / "manifest.json").unlink()
    verify.repair(root, verify.verify(root), 1)
    assert_same(root, tree(made))


def test_a_file_that_no_config_asks_for(root: Path) -> None:
    sealed(root, lambda found: found["files"].update({"notes.txt": {"bytes": 4, "sha256": "0" * 64}}))
    damage = verify.verify(root)
    assert damage.missing == ("notes.txt",)
    with pytest.raises(SpadError, match=r"lists notes\.txt, which its config does not ask for"):
        verify.repair(root, damage, 1)


@pytest.mark.parametrize("where", ["inner", "images", "5_mlux/train/inner"])
def test_no_dataset_is_made_inside_another(where: str, root: Path, made: Path) -> None:
    data = root / "data"
    place = root / where if where == "inner" else data / where
    before = tree(root)
    with pytest.raises(SpadError, match=r"lies inside the dataset .*/out,"):
        make(made.parent / "small.yaml", place / "new")
    assert_same(root, before)
    (root.parent / "link").symlink_to(data)
    with pytest.raises(SpadError, match="lies inside the dataset"):
        make(made.parent / "small.yaml", root.parent / "link" / "new")


def test_nothing_else_is_written_inside_a_dataset(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Whatever a verb writes: it is refused before the work begins, whether what is read is there or not."""
    before = tree(root)
    outputs = {
        name: [option for option in verb.params if option.name in ("output", "plot", "json_file")]
        for name, verb in cli.cli.commands.items()
    }
    assert sum(map(len, outputs.values())) > 10
    for name, options in outputs.items():
        for option in options:
            # the name of an experiment is looked at first, for its own options
            given = "accuracy" if name == "experiment" else "x"
            needed = [given] * sum(isinstance(p, click.Argument) for p in cli.cli.commands[name].params)
            for place in (root / "new", root / "images" / "new.x"):
                assert cli._run([name, *needed, option.opts[0], str(place)]) == 2
                assert capsys.readouterr().err.startswith(f"Error: {place}: lies inside the dataset {root}")
    with pytest.raises(SpadError, match="lies inside the dataset"):
        disk.put_file(root / "new.json", b"")
    with pytest.raises(SpadError, match="lies inside the dataset"):
        write(root / "new", "lab", Layout(1, 1, 1e-10, 1.0), [])
    assert_same(root, before)


def test_no_dataset_is_made_inside_an_unfinished_one(root: Path, made: Path) -> None:
    (root / "manifest.json").unlink()
    (root / ".spadmnist").mkdir()
    (root / ".spadmnist" / "plan.json").write_text("{}")
    with pytest.raises(SpadError, match="lies inside the dataset"):
        make(made.parent / "small.yaml", root / "new")


def test_a_manifest_of_something_else_is_no_dataset(made: Path, tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text('{"name": "a web page"}')
    disk.check_outside(tmp_path / "new")
