"""What `output` of a config may ask for: fewer bytes, and fluxes that are made when they are read."""

from __future__ import annotations

import pickle
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import pytest
import zarr
from test_factory import assert_same, make, tree, write_config
from zarr.storage import ZipStore

import spadmnist
from spadmnist import config, factory, manifest_file, verify
from spadmnist.errors import ConfigError, InputError, SpadError

ON_READING = "reconstructions: on_reading"
SMALL = "compression: small"
GREY = "{source: digits, train: 40, test: 9, rows: 8, columns: 8}"


def file_of(folder: Path, output: Sequence[str], format: str = "zarr", colour: bool = False) -> Path:
    """A config of few images, with these entries under `output`."""
    file = write_config(folder / "some.yaml", format, ("5 mlux", "2560 mlux"), train=40, test=9)
    text = file.read_text().replace(f"format: {format}", ", ".join([f"format: {format}", *output]))
    if colour:
        np.save(folder / "colour.npy", np.random.default_rng(1).integers(0, 256, (12, 3, 8, 8), np.uint8))
        text = text.replace(GREY, "{source: array, path: colour.npy}")
        text = text.replace("lux: [", "wavelength: [620 nm, 540 nm, 460 nm]\n  lux: [")
        text = text.replace("{pdp: 0.5}", "{pdp: {460 nm: 0.2, 540 nm: 0.5, 620 nm: 0.35}}")
    file.write_text(text)
    return file


def made(folder: Path, *output: str, format: str = "zarr", colour: bool = False) -> Path:
    folder.mkdir()
    make(file_of(folder, output, format, colour), folder / "out")
    return folder / "out"


@pytest.mark.parametrize(
    ("output", "format", "colour"),
    [
        ([SMALL], "zarr", False),
        ([ON_READING], "zarr", False),
        ([ON_READING], "hdf5", False),
        ([ON_READING, SMALL], "zarr", True),
    ],
    ids=["small", "on reading", "hdf5", "colour"],
)
def test_the_values_are_those_of_any_other_dataset(
    output: list[str], format: str, colour: bool, tmp_path: Path
) -> None:
    places = made(tmp_path / "stored", format=format, colour=colour), tmp_path / "other" / "out"
    made(tmp_path / "other", *output, format=format, colour=colour)
    stored, other = map(spadmnist.open, places)
    for level in stored.levels:
        for split in stored.splits:
            one, two = stored[level, split], pickle.loads(pickle.dumps(other[level, split]))
            for name, fluxes in one.reconstruction.items():
                same = two.reconstruction[name]
                assert same[:].dtype == np.float32
                for index in (slice(None), 3, slice(4, 4), slice(2, 5), [8, 0]):
                    assert np.array_equal(fluxes[index], same[index]) and fluxes[index].shape == same[index].shape
                assert fluxes.normalisation == same.normalisation
            assert np.array_equal(one.tr[:].ticks, two.tr[:].ticks)
            assert np.array_equal(one.frames[:].first.ticks, two.frames[:].first.ticks)
            assert np.array_equal(one.qis[:], two.qis[:])
    said = [manifest_file.read_manifest(place)[0] for place in places]
    for level, splits in said[0]["statistics"].items():
        for split, facts in splits.items():
            assert {**facts, "bytes": 0} == {**said[1]["statistics"][level][split], "bytes": 0}
    if format == "zarr":
        kinds = [manifest["statistics"]["2560 mlux"]["train"]["bytes"] for manifest in said]
        assert ["reconstruction" in one for one in kinds] == [True, ON_READING not in output]
    assert not verify.verify(places[1])


def test_a_manifest_names_neither_where_it_is_as_before(tmp_path: Path) -> None:
    root = made(tmp_path / "stored", "compression: fast", "reconstructions: stored")
    assert manifest_file.read_manifest(root)[0]["config"]["output"] == {"format": "zarr"}


def test_small_is_smaller_and_zarr_opens_it(tmp_path: Path) -> None:
    roots = made(tmp_path / "fast"), made(tmp_path / "small", SMALL)
    fast, small = (sum(f["bytes"] for f in manifest_file.read_manifest(root)[0]["files"].values()) for root in roots)
    assert small < 0.99 * fast
    places = [root / "data/2560_mlux/train/00000.zarr.zip" for root in roots]
    shards = [zarr.open_group(ZipStore(place), mode="r") for place in places]
    for name in ("tr/ticks", "frames/ticks", "frames/bits", "reconstruction/str_flux"):
        one, two = (shard[name][:] for shard in shards)
        assert len(one) and np.array_equal(one, two)
        described = [zipfile.ZipFile(place).read(f"{name}/zarr.json") for place in places]
        assert described[0] != described[1], f"{name} is compressed as in any other dataset"


@pytest.mark.parametrize("output", [[ON_READING], [SMALL]])
def test_what_is_lost_is_made_again(output: list[str], tmp_path: Path) -> None:
    root = made(tmp_path / "made", *output)
    before = tree(root)
    (root / "data/2560_mlux/train/00000.zarr.zip").unlink()
    (root / "data/images/train/00000.zarr.zip").write_bytes(b"{}")
    verify.repair(root, verify.verify(root), 1)
    assert_same(root, before)


def test_methods_are_added_to_a_small_dataset_as_if_they_had_been_asked_for(tmp_path: Path) -> None:
    root = made(tmp_path / "all", SMALL)
    (tmp_path / "some").mkdir()
    file = file_of(tmp_path / "some", [SMALL])
    file.write_text(file.read_text().replace("inter_photon, str_flux, qis_counts, qis_linear", "inter_photon"))
    make(file, tmp_path / "some" / "out")
    factory.add_reconstructions(tmp_path / "some" / "out", ("str_flux", "qis_counts", "qis_linear"), 1)
    assert_same(tmp_path / "some" / "out", tree(root))


def test_none_is_added_where_they_are_made_on_reading(tmp_path: Path) -> None:
    root = made(tmp_path / "made", ON_READING)
    with pytest.raises(InputError, match=r"on_reading.*make the dataset anew"):
        factory.add_reconstructions(root, ("counts",), 1)


def test_hdf5_has_one_compression(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="compression: small is for format: zarr"):
        config.read(file_of(tmp_path, [SMALL], "hdf5"))


METHOD = '''
from spadmnist.reconstruct import Method


class Halved(Method):
    """Half of the counts."""

    columns = ("counts",)

    def estimate(self, settings, counts):
        return counts / 2.0
'''


def test_a_method_of_ones_own_that_is_made_on_reading_is_exported(tmp_path: Path) -> None:
    """By a program that has not loaded it before."""
    (tmp_path / "halved.py").write_text(METHOD)
    (tmp_path / "set").mkdir()
    file = file_of(tmp_path / "set", [ON_READING])
    file.write_text(file.read_text().replace("reconstruct: [", "reconstruct: [halved, "))
    own = ["--plugin", str(tmp_path / "halved.py")]
    out, rows = str(tmp_path / "out"), str(tmp_path / "rows")
    for words in (
        ["generate", str(file), "-o", out, "-j", "1", *own],
        ["export", out, "-o", rows, "--format", "npz", "--limit", "1", "--method", "halved", *own],
    ):
        done = subprocess.run([sys.executable, "-m", "spadmnist", *words], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    assert list((tmp_path / "rows").rglob("*.npz"))


def test_a_file_that_is_open_already_is_not_called_damaged(tmp_path: Path) -> None:
    place = made(tmp_path / "open", format="hdf5")
    with (
        h5py.File(place / "data" / "5_mlux" / "train" / "00000.h5", "r"),
        pytest.raises(SpadError, match=r"open already, and locked; .*locking=F"),
    ):
        for level in spadmnist.open(place).levels:
            spadmnist.open(place)[level, "train"].tr[0]
