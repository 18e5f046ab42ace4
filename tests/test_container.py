"""A shard in a zip: others open it, its bytes are a function of content alone, and what is wrong with it is refused."""

from __future__ import annotations

import json
import shutil
import struct
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from test_factory import METHODS, assert_same, interrupted, make, tree, write_config
from test_store import ATTRIBUTES, check, members, more_columns, some_columns
from zarr.storage import ZipStore

import spadmnist
from spadmnist import archive, config, factory, manifest_file, shard_columns, shard_plan, verify
from spadmnist.errors import InputError, SpadError
from spadmnist.sources import Local
from spadmnist.store import Column, encoding

CONTAINER, FOLDER = encoding("zarr", 2), encoding("zarr", 1)
FEW = {"levels": ("2560 mlux",), "train": 40, "test": 4}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("made")
    make(write_config(home / "small.yaml", **FEW), home / "out")  # type: ignore[arg-type]
    return home / "out"


def shards(root: Path, place: str) -> list[Path]:
    return sorted((root / "data" / place).glob("*.zip"))


# --- others -------------------------------------------------------------------------------------------------------


def test_xarray_selects_by_label(made: Path) -> None:
    part = spadmnist.open(made)["2560 mlux", "train"]
    wanted = part.reconstruction["counts"][part.labels == 3]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        stores = [ZipStore(path) for path in shards(made, "2560_mlux/train")]
        fluxes = xr.open_mfdataset(stores, engine="zarr", group="reconstruction")
        threes = fluxes["counts"].sel(image=fluxes["label"] == 3)
        assert len(wanted) and np.array_equal(threes, wanted)
        assert threes["image"].values.tolist() == np.flatnonzero(part.labels == 3).tolist()
        for group in ("tr", "frames"):
            opened = xr.open_zarr(stores[0], group=group)
            assert {"image", "label"} == set(opened.coords) and np.array_equal(opened["label"], part.labels)
        originals = xr.open_zarr(ZipStore(shards(made, "images/train")[0]))
        assert set(originals.coords) == {"image", "labels"} and np.array_equal(originals["pixels"], part.images[:])
        tree = xr.open_datatree(stores[0], engine="zarr")
        assert tree["tr"].ds.coords["image"].size == len(part)


def test_images_are_numbered_through_the_split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shard_plan, "_IMAGES_PER_SHARD", 32)
    make(write_config(tmp_path / "small.yaml", **FEW), tmp_path / "out")  # type: ignore[arg-type]
    stores = [ZipStore(path) for path in shards(tmp_path / "out", "2560_mlux/train")]
    fluxes = xr.open_mfdataset(stores, engine="zarr", group="reconstruction")
    assert len(stores) == 2 and fluxes["image"].values.tolist() == list(range(40))
    assert np.array_equal(fluxes["label"], spadmnist.open(tmp_path / "out")["2560 mlux", "train"].labels)


def test_images_without_labels_have_numbers_alone(tmp_path: Path) -> None:
    text = write_config(tmp_path / "small.yaml").read_text()
    plain = "images: {source: uniform, repetitions: 3, grey: 200}"
    start, end = text.index("images: {"), text.index("}") + 1
    (tmp_path / "small.yaml").write_text(text[:start] + plain + text[end:])
    make(tmp_path / "small.yaml", tmp_path / "out")
    (split,) = spadmnist.open(tmp_path / "out").splits
    opened = xr.open_zarr(ZipStore(shards(tmp_path / "out", f"5_mlux/{split}")[0]), group="tr")
    assert set(opened.coords) == {"image"}


def test_an_array_cannot_have_the_name_of_a_coordinate() -> None:
    labels = np.zeros(3, np.uint8)
    assert set(shard_columns.coordinate_columns(["tr/ticks"], range(3), labels)) == {"tr/image", "tr/label"}
    with pytest.raises(InputError, match="reconstruction/label: is the name of a coordinate"):
        shard_columns.coordinate_columns(["reconstruction/label"], range(3), labels)


# --- bytes --------------------------------------------------------------------------------------------------------


def test_members_are_stored_in_their_order(tmp_path: Path) -> None:
    CONTAINER.write(tmp_path, "s", some_columns(), ATTRIBUTES)
    with zipfile.ZipFile(tmp_path / CONTAINER.location("s")) as shard:
        assert shard.testzip() is None
        infos = shard.infolist()
    names = [info.filename for info in infos]
    chunks = [name for name in names if not name.endswith("zarr.json")]
    assert names[: len(chunks)] == chunks == sorted(chunks) and names[-1] == "zarr.json"
    for info in infos:
        assert (info.compress_type, info.flag_bits) == (zipfile.ZIP_STORED, 0)
        assert (info.date_time, info.create_system) == ((1980, 1, 1, 0, 0, 0), 3)


def test_the_description_repeats_all_others(tmp_path: Path) -> None:
    CONTAINER.write(tmp_path, "s", some_columns(), ATTRIBUTES)
    held = members(tmp_path / CONTAINER.location("s"))
    within = json.loads(held["zarr.json"])["consolidated_metadata"]["metadata"]
    others = {name.removesuffix("/zarr.json"): json.loads(text) for name, text in held.items() if "/zarr.json" in name}
    assert within == others


def test_zip64_where_sizes_and_numbers_need_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """At limits that a test can reach: sizes, places, the number of members."""
    files = {f"{n}/c.0": [bytes([n]) * 300, b"x" * n] for n in range(5)}
    for limit, most in ((200, 1 << 16), (700, 1 << 16), (0xFFFFFFFF, 3)):
        monkeypatch.setattr(archive, "_MOST", limit)
        monkeypatch.setattr(archive, "_MOST_MEMBERS", most)
        path = tmp_path / "large.zip"
        path.write_bytes(b"".join(archive.written({name: iter(pieces) for name, pieces in files.items()})))
        assert b"PK\x06\x06" in path.read_bytes()
        with zipfile.ZipFile(path) as large:
            assert large.testzip() is None
            assert {name: large.read(name) for name in large.namelist()} == {n: b"".join(p) for n, p in files.items()}
        handle = Local(tmp_path).open("large.zip")
        for info in archive.members(handle):
            assert handle.read(archive.start(handle, info), 300) == files[info.filename][0]
        handle.close()


# --- what is wrong with one ---------------------------------------------------------------------------------------


def test_a_hostile_zip_is_refused(tmp_path: Path) -> None:
    CONTAINER.write(tmp_path, "s", some_columns(), ATTRIBUTES)
    path = tmp_path / CONTAINER.location("s")
    held, document = members(path), json.loads(members(path)["zarr.json"])

    def refused(files: dict[str, bytes], says: str, method: int = zipfile.ZIP_STORED) -> None:
        with zipfile.ZipFile(path, "w", method) as zipped:
            for name, data in files.items():
                zipped.writestr(name, data)
        with pytest.raises(InputError, match=rf"s\.zarr\.zip: .*{says}.*spadmnist verify"):
            CONTAINER.reader(tmp_path, "s").read("tr/ticks")

    refused(held, "is compressed by method 8", zipfile.ZIP_DEFLATED)
    refused({name: data for name, data in held.items() if name != "zarr.json"}, "no zarr.json in it")
    refused({name: data for name, data in held.items() if name != "tr/ticks/c.0"}, "does not describe what is there")
    refused({**held, "tr/more": b""}, "does not describe what is there")
    for wrong in (b"{", b"[]", b"{}", b"[" * 100_000, b"9" * 5000):
        refused({**held, "zarr.json": wrong}, "not the description of a shard")
    inner = document["consolidated_metadata"]["metadata"]
    inner["tr/ticks"]["shape"] = [10**15]
    refused({**held, "zarr.json": json.dumps(document).encode()}, "tr/ticks: ")
    del inner["tr"]
    refused({**held, "zarr.json": json.dumps(document).encode()}, "not the description of a shard")
    refused({**held, "tr/ticks/c.0": held["tr/ticks/c.0"][:-1]}, "tr/ticks: its table of chunks is damaged")
    CONTAINER.write(tmp_path, "s", some_columns(), ATTRIBUTES)
    content = path.read_bytes()
    end = content.rindex(b"PK\x05\x06") + 16  # where the directory begins: later than that, members lie before the file
    at = struct.unpack_from("<I", content, end)[0] + 10**6
    path.write_bytes(content[:end] + struct.pack("<I", at) + content[end + 4 :])
    with pytest.raises(InputError, match=r"s\.zarr\.zip: .*spadmnist verify"):
        CONTAINER.reader(tmp_path, "s").read("tr/ticks")
    for data in (b"", b"PK", bytes(1000), struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 9, 9, 9, 9, 0)):
        path.write_bytes(data)
        with pytest.raises(InputError, match="cannot be read as a zip"):
            CONTAINER.reader(tmp_path, "s").read("tr/ticks")


def test_damage_is_not_copied_when_arrays_are_added(tmp_path: Path) -> None:
    """What is added must not vouch for what was damaged before."""
    CONTAINER.write(tmp_path, "s", some_columns(), ATTRIBUTES)
    path = tmp_path / CONTAINER.location("s")
    content = bytearray(path.read_bytes())
    content[CONTAINER.reader(tmp_path, "s")._array("tr/ticks").places[0][0] + 20] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"tr/ticks/c\.0 is damaged: its checksum does not match"):
        CONTAINER.append(tmp_path, "s", more_columns())
    assert path.read_bytes() == content


def test_coordinates_are_read_back(tmp_path: Path) -> None:
    label = Column(np.arange(7, dtype=np.uint8), ("image",), "1", "label", "counts", coordinate=True)
    columns = {**some_columns(), "tr/label": label, "label": label}
    CONTAINER.write(tmp_path / "a", "s", columns, ATTRIBUTES)
    reader = CONTAINER.reader(tmp_path / "a", "s")
    check(reader, columns)
    assert reader.attributes == ATTRIBUTES
    again = {name: reader.column(name) for name in reader.names}
    assert {name for name, column in again.items() if column.coordinate} == {"label", "tr/label"}
    CONTAINER.write(tmp_path / "b", "s", again, reader.attributes)
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


# --- datasets of encoding 1 ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("older")
    make(write_config(home / "small.yaml", **FEW), home / "out", encoding=FOLDER)  # type: ignore[arg-type]
    return home / "out"


def test_the_values_are_the_same(made: Path, older: Path) -> None:
    one, other = (spadmnist.open(root)["2560 mlux", "train"] for root in (made, older))
    assert np.array_equal(one.tr[:].ticks, other.tr[:].ticks) and np.array_equal(one.str[:], other.str[:])
    assert np.array_equal(one.images[:], other.images[:]) and np.array_equal(one.labels, other.labels)
    for method in METHODS:
        assert np.array_equal(one.reconstruction[method][:], other.reconstruction[method][:])
    assert (older / "data.zarr").is_dir() and not (older / "data").exists()


def test_a_run_goes_on_in_the_encoding_that_it_began_with(older: Path, tmp_path: Path) -> None:
    file, root = older.parent / "small.yaml", tmp_path / "out"
    before = tree(older)
    shutil.copytree(older, root)
    assert (make(file, root).made, tree(root)) == (0, before)  # it is finished
    shutil.rmtree(root)
    experiment = replace(config.read(file), encoding=FOLDER)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(config, "read", lambda *given, **options: experiment)
        interrupted(file, root, 1)
    assert make(file, root).kept
    assert_same(root, before)


def test_it_is_repaired_and_reconstructed_to_its_own_bytes(older: Path, tmp_path: Path) -> None:
    root, before = tmp_path / "out", tree(older)
    shutil.copytree(older, root)
    next((root / "data.zarr" / "2560_mlux").rglob("c.0")).write_bytes(b"x")
    (root / "manifest.json").unlink()
    verify.repair(root, verify.verify(root), 1)
    assert_same(root, before)
    some = write_config(tmp_path / "some.yaml", methods=METHODS[:2], **FEW)  # type: ignore[arg-type]
    make(some, tmp_path / "some", encoding=FOLDER)
    factory.add_reconstructions(tmp_path / "some", METHODS[2:], 1)
    assert_same(tmp_path / "some", before)


def test_an_encoding_of_a_later_program_is_named(made: Path, tmp_path: Path) -> None:
    root = tmp_path / "out"
    shutil.copytree(made, root)
    manifest = {**json.loads((root / "manifest.json").read_text()), "encoding": 3}
    (root / "manifest.json").write_bytes(manifest_file.seal(manifest))
    says = r"manifest\.json: encoding 3 of format zarr is not known; .* 1, 2: install a newer spadmnist"
    for read in (spadmnist.open, lambda place: factory.add_reconstructions(place, METHODS, 1)):
        with pytest.raises(InputError, match=says):
            read(root)
    with pytest.raises(SpadError, match="encoding 3 of format zarr is not known"):
        make(made.parent / "small.yaml", root)
