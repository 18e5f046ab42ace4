"""A dataset that a program of the past made (data/kept.zip, spadmnist 0.1.0) still belongs to today's.

It stays as it is for ever: what is known of its values stands in data/guard.json under `kept`, and no command rewrites
either. Today's program reads it, simulates the same values from its config, finds it intact, makes damaged files again
byte for byte, and goes on with a run that was killed halfway.
"""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import pytest
from pydantic import create_model
from test_factory import assert_same, make, tree
from test_guard import files_of, known, said_of_files, said_of_values, values_of, versions

from spadmnist import config, images, manifest_file, verify
from spadmnist.errors import SpadError
from spadmnist.section import LATER

HERE = versions()
KEPT = Path(__file__).parent / "data" / "kept.zip"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    with zipfile.ZipFile(KEPT) as archive:
        archive.extractall(tmp_path / "kept")
    return tmp_path / "kept"


@pytest.fixture
def manifest(root: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((root / "manifest.json").read_text())
    return found


def assert_same_but_for_the_seal(root: Path, before: dict[str, bytes | str], manifest: dict[str, Any]) -> None:
    """A manifest that is written today is sealed without versions. All else, and every other file, is what it was."""
    now = json.loads((root / "manifest.json").read_text())
    assert (now.pop("stream"), now.pop("encoding")) == (1, 1)
    assert set(now) - set(manifest) == {"provenance", "provenance_sha256"}
    for key in set(manifest) - {"versions", "sha256"}:
        assert now[key] == manifest[key], key
    (root / "manifest.json").write_bytes(manifest_file.seal(manifest))
    assert_same(root, before)


@pytest.fixture
def same_bytes(root: Path, manifest: dict[str, Any]) -> None:
    """Skips where other libraries than those of then compress otherwise: that is no fault of this program."""
    if all(manifest["versions"][name] == version for name, version in HERE.items()):
        return
    make(root / "config.yaml", root.parent / "anew")
    anew = json.loads((root.parent / "anew" / "manifest.json").read_text())
    outcome, why = said_of_files(files_of(anew), files_of(manifest), HERE, manifest["versions"], "zarr")
    if outcome == "skip":
        pytest.skip(f"kept.zip: {why}")


def test_its_values_are_what_they_were(root: Path) -> None:
    wrong = said_of_values(values_of(root), known()["kept"])
    if wrong:
        pytest.fail(f"kept.zip as it is read: {wrong}", pytrace=False)


def test_its_config_draws_what_it_holds(root: Path) -> None:
    wrong = said_of_values(values_of(root / "config.yaml"), known()["kept"])
    if wrong:
        pytest.fail(f"kept.zip simulated from its config: {wrong}", pytrace=False)


def test_it_is_intact(root: Path) -> None:
    damage = verify.verify(root)
    assert not damage and damage.files == len(tree(root)) == 131


def test_the_same_config_finds_it_finished(root: Path, manifest: dict[str, Any]) -> None:
    before = tree(root)
    outcome = make(own_config(root), root)
    assert (outcome.made, outcome.kept) == (0, 0)
    assert_same(root, before)


class Slanted(images.Digits):
    """The source of its images, with a key that came later."""

    slant: Annotated[int, LATER] = 0


class Leaning(images.Digits):
    """The same with a key that is written at its default."""

    slant: int = 0


@pytest.mark.parametrize("given", ["", "slant: 0\n    "])
def test_a_key_that_came_later_leaves_it_what_it_is(
    given: str, root: Path, manifest: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And a key that is not declared as later would make another dataset of it."""
    file = own_config(root)
    file.write_text(file.read_text().replace("source: digits\n    ", f"source: digits\n    {given}"))
    monkeypatch.setitem(config._SECTIONS, "scene", create_model("Scene", __base__=config._Scene, images=Slanted))
    before = tree(root)
    assert make(file, root).made == 0
    assert_same(root, before)
    monkeypatch.setitem(config._SECTIONS, "scene", create_model("Scene", __base__=config._Scene, images=Leaning))
    with pytest.raises(SpadError, match=r"another dataset: config\.scene\.images\.slant: nothing there, 0 asked for"):
        make(file, root)


# --- damages ------------------------------------------------------------------------------------------------------


def flip(root: Path) -> None:
    path = root / "data.zarr" / "1280_mlux" / "train" / "00000" / "tr" / "ticks" / "c.0"
    content = bytearray(path.read_bytes())
    content[100] ^= 4
    path.write_bytes(content)


def lose_a_shard(root: Path) -> None:
    shutil.rmtree(root / "data.zarr" / "40_mlux" / "test" / "00000")


def lose_the_originals(root: Path) -> None:
    shutil.rmtree(root / "data.zarr" / "images")


def lose_the_config(root: Path) -> None:
    (root / "config.yaml").unlink()


def change_a_group(root: Path) -> None:
    (root / "data.zarr" / "40_mlux" / "zarr.json").write_text("{}")


def lose_the_manifest(root: Path) -> None:
    (root / "manifest.json").unlink()


DAMAGES = (flip, lose_a_shard, lose_the_originals, lose_the_config, change_a_group, lose_the_manifest)


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
def test_what_is_damaged_is_named_and_made_again(
    damage: Callable[[Path], None], root: Path, manifest: dict[str, Any], same_bytes: None
) -> None:
    before = tree(root)
    damage(root)
    hit = {name for name, content in before.items() if tree(root).get(name) != content}
    found = verify.verify(root)
    assert {*found.changed, *found.missing, *found.extra} == hit and hit
    verify.repair(root, found, jobs=1)
    if damage is lose_the_manifest:
        assert_same_but_for_the_seal(root, before, manifest)
    else:
        assert_same(root, before)


# --- a run that was killed ----------------------------------------------------------------------------------------

# what the program of then noted of a run's identity, and the manifest kept of it
PLAN = ("format", "config", "images", "maps", "plugins", "versions")


def own_config(root: Path) -> Path:
    """The dataset's config and maps, in a folder apart."""
    apart = root.parent / "own"
    apart.mkdir()
    shutil.copy(root / "config.yaml", apart)
    shutil.copytree(root / "maps", apart / "maps")
    return apart / "config.yaml"


def as_noted(value: Any) -> str:
    """The notes of a run are JSON as the program of then wrote it."""
    return json.dumps(value, sort_keys=True, indent=1) + "\n"


def kill(root: Path, manifest: dict[str, Any], made: int) -> None:
    """Leave a folder as a run of then did that was killed behind its first so many shards."""
    notes: dict[str, dict[str, Any]] = {}
    for shard in manifest["shards"][:made]:
        path = f"{shard['folder']}/{shard['split']}/{shard['number']:05d}"
        notes[path] = {n: facts for n, facts in manifest["files"].items() if n.startswith(f"data.zarr/{path}/")}
    there = {name for files in notes.values() for name in files}
    for name in tree(root).keys() - there:
        (root / name).unlink()
    for folder in sorted((path for path in root.rglob("*") if path.is_dir()), reverse=True):
        if not any(folder.iterdir()):
            folder.rmdir()
    state = root / ".spadmnist"
    state.mkdir()
    (state / "plan.json").write_text(as_noted({key: manifest[key] for key in PLAN}))
    for path, files in notes.items():
        (state / "shards" / path).parent.mkdir(parents=True, exist_ok=True)
        (state / "shards" / f"{path}.json").write_text(as_noted(files))


@pytest.mark.parametrize("made", [0, 1, 4, 6])
def test_a_run_of_then_is_gone_on_with(made: int, root: Path, manifest: dict[str, Any], same_bytes: None) -> None:
    """By the dataset's own config, whatever was there, to the very same tree."""
    before, config_file = tree(root), own_config(root)
    kill(root, manifest, made)
    assert len(tree(root)) < len(before)
    outcome = make(config_file, root)
    assert (outcome.made, outcome.kept) == (6 - made, made)
    assert_same_but_for_the_seal(root, before, manifest)
