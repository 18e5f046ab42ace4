"""The store: what is written is read back, by others as well; what is damaged or hostile is refused."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import pickle
import random
import resource
import shutil
import signal
import struct
import subprocess
import sys
import textwrap
import time
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path

import h5py
import numcodecs.blosc
import numcodecs.zstd
import numpy as np
import pytest
import xarray as xr
import zarr
from zarr.core.group import GroupMetadata
from zarr.core.metadata.v3 import ArrayV3Metadata
from zarr.storage import ZipStore

from spadmnist import disk
from spadmnist.errors import InputError, SpadError
from spadmnist.store import Column, Encoding, ShardReader, chunks, encoding, shards
from spadmnist.store.hdf5 import _decode as decode_hdf5

ENCODINGS = list(Encoding.every.values())
CONTAINER, FOLDER, HDF5 = encoding("zarr", 2), encoding("zarr", 1), encoding("hdf5", 1)
IMAGE = ("image", "y", "x")


def some_columns(images: int = 7, seed: int = 1) -> dict[str, Column]:
    """A small shard with one array of every kind; some chunks are zeros, the last ones are not full."""
    rng = np.random.default_rng(seed)
    counts = rng.poisson(3, (images, 4, 5)).astype(np.uint16)
    counts[:2] = 0
    total = int(counts.sum())
    offsets = np.concatenate([[0], np.cumsum(counts.sum(axis=(1, 2)))]).astype(np.uint64)
    return {
        "tr/ticks": Column(
            rng.exponential(1e6, total).astype(np.uint32),
            ("event",),
            "10 ps",
            "detection times",
            "ticks",
            50,
            {"tick": 1e-11, "coding": "difference to the detection before, in the pixel"},
        ),
        "tr/counts": Column(counts, IMAGE, "1", "detections of a pixel", "counts", 2),
        "tr/offsets": Column(offsets, ("offset",), "1", "first detection of an image", "floats"),
        "frames/bits": Column(
            rng.integers(0, 2, (images, 4, 5, 13), dtype=np.uint8), (*IMAGE, "byte"), "1", "frames", "bits", 3
        ),
        "frames/first": Column(np.zeros(0, np.uint32), ("first_event",), "10 ps", "first ones", "ticks", 50),
        "index": Column(np.arange(images, dtype=np.int64), ("image",), "1", "place in the split", "floats"),
    }


def more_columns(images: int = 7, seed: int = 2) -> dict[str, Column]:
    rng = np.random.default_rng(seed)
    return {
        "reconstruction/counts": Column(
            rng.random((images, 4, 5)).astype(np.float32), IMAGE, "1/s", "flux", "floats", 4
        ),
        "reconstruction/exact": Column(rng.random((images, 4, 5)), IMAGE, "1/s", "flux", "floats"),
        "frames/sum": Column(np.ones((images, 4, 5), np.int8), IMAGE, "1", "ones", "bits"),
    }


ATTRIBUTES = {"lux": 2.56, "images": 7, "range": [0, 7], "readouts": ["tr", "qis"], "level": "2560 mlux"}


def tree(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def members(place: Path) -> dict[str, bytes]:
    """The files of a shard: a folder, or a zip."""
    if place.is_dir():
        return tree(place)
    with zipfile.ZipFile(place) as zipped:
        return {info.filename: zipped.read(info) for info in zipped.infolist()}


def digests(root: Path) -> dict[str, dict[str, object]]:
    return {name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()} for name, data in tree(root).items()}


def check(reader: ShardReader, columns: dict[str, Column]) -> None:
    assert reader.names == tuple(sorted(columns))
    for name, column in columns.items():
        data = reader.read(name)
        assert data.dtype == column.data.dtype and data.shape == column.data.shape
        assert np.array_equal(data, column.data)
        assert (reader.dims(name), reader.unit(name)) == (column.dims, column.unit)
        assert (reader.about(name), reader.array_attributes(name)) == (column.about, dict(column.attributes))
        length = len(column.data)
        for start, stop in [(0, 0), (length // 3, length // 2), (length // 2, length), (length, length)]:
            assert np.array_equal(reader.read(name, start, stop), column.data[start:stop])


# --- round trips -------------------------------------------------------------------------------------------
@pytest.mark.parametrize("format", ENCODINGS, ids=str)
def test_what_is_written_is_read_back(tmp_path: Path, format: Encoding) -> None:
    columns = some_columns() | more_columns()
    assert not format.exists(tmp_path, "5mlux/train/0000")
    files = format.write(tmp_path, "5mlux/train/0000", columns, ATTRIBUTES)
    assert format.exists(tmp_path, "5mlux/train/0000")
    assert files == digests(tmp_path)
    assert list(disk.temporary(tmp_path).iterdir()) == []
    reader = format.reader(tmp_path, "5mlux/train/0000")
    check(reader, columns)
    assert reader.attributes == ATTRIBUTES
    check(pickle.loads(pickle.dumps(reader)), columns)
    with pytest.raises(InputError, match=r"there is no array 'tr/tick'; there are .*tr/ticks"):
        reader.read("tr/tick")
    with pytest.raises(IndexError, match="rows 3 to 900 were asked for; it has rows 0 to"):
        reader.read("tr/ticks", 3, 900)


@pytest.mark.parametrize("format", ENCODINGS, ids=str)
@pytest.mark.parametrize("threads", [False, True])
def test_rows_of_several_shards_are_joined(
    tmp_path: Path, format: Encoding, threads: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By one thread or by several. A damaged chunk and another type are errors in both."""
    monkeypatch.setattr(shards, "_MANY", 0 if threads else 1 << 60)
    made = {f"a/b/{i}": some_columns(7 + i, i) | more_columns(7 + i, 2 + i) for i in range(5)}
    for path, columns in made.items():
        format.write(tmp_path, path, columns, {})
    readers = [format.reader(tmp_path, path) for path in made]
    pieces = [(reader, i % 3, 7 + i - i % 2) for i, reader in enumerate(readers)]
    for name in ("reconstruction/exact", "tr/counts", "index"):
        wanted = np.concatenate([reader.read(name, start, stop) for reader, start, stop in pieces])
        for some in (pieces, pieces[:1]):
            found = shards.read_joined(some, name)
            assert found.dtype == wanted.dtype and np.array_equal(found, wanted[: len(found)])

    other = made["a/b/3"] | {"index": replace(made["a/b/3"]["index"], data=np.arange(10, dtype=np.int32))}
    format.write(tmp_path, "a/b/3", other, {})
    pieces[3] = format.reader(tmp_path, "a/b/3"), 0, 5
    with pytest.raises(InputError, match="index: its type or shape is not that of the shard before"):
        shards.read_joined(pieces, "index")

    array = readers[4]._array("reconstruction/exact")
    offset, length = array.places[-1]
    data = bytearray((tmp_path / array.file).read_bytes())
    data[offset + length // 2] ^= 1
    (tmp_path / array.file).write_bytes(data)
    with pytest.raises(InputError, match=r"reconstruction/exact: .*(cannot be decoded|checksum)"):
        shards.read_joined(pieces[:3] + pieces[4:], "reconstruction/exact")


@pytest.mark.parametrize("format", ENCODINGS, ids=str)
@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint64", "int64", "float32", "float64", ">u4"])
@pytest.mark.parametrize("shape", [(0,), (1,), (10,), (12, 2), (0, 3), (4, 0)])
def test_types_and_shapes(tmp_path: Path, format: Encoding, dtype: str, shape: tuple[int, ...]) -> None:
    data = np.random.default_rng(3).integers(0, 200, shape).astype(dtype)
    if dtype == "uint64" and data.size:
        data.flat[0] = 2**64 - 1
    columns = {
        f"{codec}/a": Column(
            data,
            ("a", "b")[: len(shape)] if codec != "ticks" else ("p", "q")[: len(shape)],
            "1",
            "numbers",
            codec,
            4,
        )
        for codec in ("ticks", "counts", "bits", "floats")
        if codec == "ticks" or len(shape) == 1
    }
    format.write(tmp_path, "s", columns, {})
    reader = format.reader(tmp_path, "s")
    for name in columns:
        assert np.array_equal(reader.read(name), data)
        assert reader.shape(name) == shape


def opened(place: Path) -> Path | ZipStore:
    """A shard for zarr-python."""
    return place if place.is_dir() else ZipStore(place)


@pytest.mark.parametrize("format", [CONTAINER, FOLDER], ids=str)
def test_zarr_python_reads_the_same(tmp_path: Path, format: Encoding) -> None:
    columns = some_columns() | more_columns()
    format.write(tmp_path, "5mlux/train/0000", columns, ATTRIBUTES)
    place = tmp_path / format.location("5mlux/train/0000")
    group = zarr.open_group(opened(place), mode="r", use_consolidated=False)
    assert dict(group.attrs) == ATTRIBUTES
    for name, column in columns.items():
        array = group[name]
        assert isinstance(array, zarr.Array)
        assert np.array_equal(array[...], column.data) and array.dtype == column.data.dtype
        assert array.metadata.dimension_names == column.dims  # type: ignore[union-attr]
        assert dict(array.attrs) == {**column.attributes, "units": column.unit, "long_name": column.about}


@pytest.mark.parametrize("format", [CONTAINER, FOLDER], ids=str)
def test_metadata_is_what_zarr_python_itself_would_write(tmp_path: Path, format: Encoding) -> None:
    format.write(tmp_path, "s", some_columns() | more_columns(), ATTRIBUTES)
    for name, text in members(tmp_path / format.location("s")).items():
        if not name.endswith("zarr.json"):
            continue
        document = json.loads(text)
        if document["node_type"] == "group":
            within = document.pop("consolidated_metadata", None)  # which repeats the others
            assert GroupMetadata.from_dict(dict(document)).to_dict() == document
            assert (within is not None) == (format is CONTAINER and name == "zarr.json")
            continue
        again = json.loads(json.dumps(ArrayV3Metadata.from_dict(dict(document)).to_dict()))
        if document["data_type"] in ("uint8", "int8"):  # one byte has no order: zarr-python leaves that out
            for codecs in (d["codecs"][0]["configuration"]["codecs"] for d in (document, again)):
                codecs[0].pop("configuration", None)
        assert again == document


def test_xarray_opens_it_without_a_warning(tmp_path: Path) -> None:
    columns = some_columns() | more_columns()
    groups: dict[str, dict[str, object]] = {
        "": {"title": "a dataset"},
        "5mlux": {"lux": 0.005},
        "5mlux/train": {},
    }
    files = FOLDER.write_groups(tmp_path, groups)
    for i in range(2):
        files |= FOLDER.write(tmp_path, f"5mlux/train/000{i}", columns, ATTRIBUTES)
    assert files == digests(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole = xr.open_datatree(tmp_path / "data.zarr", engine="zarr", consolidated=False)
        assert whole.attrs == {"title": "a dataset"} and whole["5mlux"].attrs == {"lux": 0.005}
        for name, column in columns.items():
            array = whole[f"5mlux/train/0001/{name}"]
            assert np.array_equal(array, column.data) and array.dims == column.dims
            assert array.attrs["units"] == column.unit and array.attrs["long_name"] == column.about
        part = xr.open_zarr(tmp_path / "data.zarr/5mlux/train/0000/tr", consolidated=False)
        assert np.array_equal(part.ticks, columns["tr/ticks"].data)


def test_hdf5_has_dimension_scales(tmp_path: Path) -> None:
    columns = some_columns() | more_columns()
    HDF5.write(tmp_path, "s", columns, ATTRIBUTES)
    with h5py.File(tmp_path / "data/s.h5") as file:
        assert file.attrs["level"] == b"2560 mlux" and list(file.attrs["readouts"]) == [b"tr", b"qis"]
        for name, column in columns.items():
            assert np.array_equal(file[name][...], column.data)
            assert file[name].attrs["units"].decode() == column.unit
            assert not column.data.size or file[name].fletcher32
            if name == "index":
                continue
            for axis, dim in zip(file[name].dims, column.dims, strict=True):
                assert axis[0].name.rpartition("/")[2] == dim


def test_xarray_opens_hdf5_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("h5netcdf", reason="xarray reads HDF5 with h5netcdf, which is not installed")
    columns = some_columns() | more_columns()
    HDF5.write(tmp_path, "s", columns, ATTRIBUTES)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        part = xr.open_dataset(tmp_path / "data/s.h5", engine="h5netcdf", group="tr")
        assert part.counts.dims == IMAGE and np.array_equal(part.ticks, columns["tr/ticks"].data)


# --- the same bytes ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("format", ENCODINGS, ids=str)
def test_same_input_same_bytes(tmp_path: Path, format: Encoding) -> None:
    """In another process, with other thread counts, a second later and in another order of the columns."""
    program = textwrap.dedent(
        """
        import sys
        sys.path.insert(0, sys.argv[1])
        from test_store import ATTRIBUTES, some_columns
        from spadmnist.store import Encoding
        columns = some_columns(300)
        if sys.argv[4] == "reversed":
            columns = dict(reversed(columns.items()))
        Encoding.every[sys.argv[3]].write(sys.argv[2], "s", columns, ATTRIBUTES)
        """
    )
    format.write(tmp_path / "here", "s", some_columns(300), ATTRIBUTES)
    time.sleep(1.1)
    for threads, order in (("1", "as is"), ("4", "reversed")):
        command = [
            sys.executable,
            "-c",
            program,
            str(Path(__file__).parent),
            str(tmp_path / threads),
            str(format),
            order,
        ]
        environment = os.environ | {"BLOSC_NTHREADS": threads, "TZ": "Asia/Tokyo"}
        subprocess.run(command, env=environment, check=True)
        assert tree(tmp_path / threads) == tree(tmp_path / "here")


@pytest.mark.parametrize("format", ENCODINGS, ids=str)
def test_appending_is_writing_all_at_once(tmp_path: Path, format: Encoding) -> None:
    first, more = some_columns(), more_columns()
    format.write(tmp_path / "once", "s", first | more, ATTRIBUTES)
    files = format.write(tmp_path / "twice", "s", first, ATTRIBUTES)
    files |= format.append(tmp_path / "twice", "s", more)
    assert tree(tmp_path / "twice") == tree(tmp_path / "once")
    assert files == digests(tmp_path / "twice")
    format.append(tmp_path / "twice", "s", more)  # again: the same is replaced by the same
    assert tree(tmp_path / "twice") == tree(tmp_path / "once")
    assert list(disk.temporary(tmp_path / "twice").iterdir()) == []
    with pytest.raises(ValueError, match=r"dimension 'image' has size 7 in .* and 9 in"):
        format.append(tmp_path / "twice", "s", {"frames/other": more_columns(9)["frames/sum"]})


@pytest.mark.parametrize("format", ENCODINGS, ids=str)
def test_writing_again_replaces(tmp_path: Path, format: Encoding) -> None:
    format.write(tmp_path / "a", "s", some_columns(9) | more_columns(9), {})
    format.write(tmp_path / "a", "s", some_columns(), {})
    format.write(tmp_path / "b", "s", some_columns(), {})
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


# --- what cannot be stored ---------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"data": np.zeros(3, complex)}, "complex128"),
        ({"data": np.float64(1)}, "0 axes"),
        ({"dims": ("a", "b")}, "one name per axis"),
        ({"unit": "seconds since 1970"}, "calendar time"),
        ({"unit": "seconds"}, "calendar time"),
        ({"about": ""}, "say in `about`"),
        ({"codec": "zip"}, "'zip' is not a codec; choose one of ticks"),
        ({"rows_per_chunk": 0}, "must be 1 or more"),
        ({"attributes": {"units": "s"}}, "meaning of its own"),
        ({"attributes": {"x": float("nan")}}, "allowed are text"),
        ({"attributes": {"x": {}}}, "allowed are text"),
        ({"attributes": {"x": [1, "a"]}}, "allowed are text"),
        ({"attributes": {"x": True}}, "allowed are text"),
    ],
)
def test_a_column_that_cannot_be_stored(tmp_path: Path, change: dict[str, object], message: str) -> None:
    fields: dict[str, object] = {
        "data": np.zeros(3),
        "dims": ("a",),
        "unit": "1",
        "about": "x",
        "codec": "floats",
    }
    with pytest.raises(ValueError, match=message):
        FOLDER.write(tmp_path, "s", {"x": Column(**(fields | change))}, {})  # type: ignore[arg-type]
    assert tree(tmp_path) == {}


def test_names_that_cannot_be_stored(tmp_path: Path) -> None:
    good = Column(np.zeros(3), ("a",), "1", "x", "floats")
    for name in ("", "..", "a/../b", "/a", ".a", "a//b", "zarr.json", "a\nb", "a.", "ä"):
        with pytest.raises(ValueError, match="cannot be a name on disk"):
            FOLDER.write(tmp_path, "s", {name: good}, {})
        with pytest.raises(ValueError, match="cannot be a name on disk"):
            FOLDER.write(tmp_path, name, {"x": good}, {})
    for columns in (
        {"a": Column(np.zeros((3, 3)), ("a", "b"), "1", "x", "floats")},
        {"x": good, "x/y": good},
    ):
        with pytest.raises(ValueError, match="rename one of them"):
            FOLDER.write(tmp_path, "s", columns, {})
    with pytest.raises(InputError, match="'tiff' is not a format; choose one of zarr, hdf5"):
        encoding("tiff")


# --- damage ------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("format", ENCODINGS, ids=str)
def test_random_damage_never_gives_wrong_data(tmp_path: Path, format: Encoding) -> None:
    """Flipped bits, cut files and missing files: reading refuses, or gives exactly what was written; the hash
    shows it in any case."""
    columns = some_columns() | more_columns()
    files = format.write(tmp_path, "s", columns, ATTRIBUTES)
    rng = random.Random(4)
    refused = 0
    for trial in range(400):
        name = rng.choice(sorted(files))
        path = tmp_path / name
        before = path.read_bytes()
        if trial % 10 == 0:
            path.unlink()
        elif trial % 10 == 1:
            path.write_bytes(before[: rng.randrange(len(before))])
        else:
            damaged = bytearray(before)
            damaged[rng.randrange(len(before))] ^= 1 << rng.randrange(8)
            path.write_bytes(damaged)
        assert not path.exists() or hashlib.sha256(path.read_bytes()).hexdigest() != files[name]["sha256"]
        try:
            reader = format.reader(tmp_path, "s")
            for column in reader.names:
                data = reader.read(column)
                assert column not in columns or np.array_equal(data, columns[column].data)
        except InputError as error:
            refused += 1
            assert "spadmnist verify" in str(error) and str(tmp_path) in str(error)
        path.write_bytes(before)
    check(format.reader(tmp_path, "s"), columns)
    # The others hit what no reader looks at: texts, padding, and in a small HDF5 file mostly empty space.
    assert refused > (200 if format is FOLDER else 100)


@pytest.mark.parametrize("format", ENCODINGS, ids=str)
def test_every_flip_in_data_is_refused(tmp_path: Path, format: Encoding) -> None:
    column = Column(np.arange(1000, dtype=np.uint32), ("event",), "10 ps", "times", "ticks", 400)
    files = format.write(tmp_path, "s", {"a": column}, {})
    path = tmp_path / next(name for name in files if not name.endswith(".json"))
    before = path.read_bytes()
    places = [(at, size) for at, size in format.reader(tmp_path, "s")._array("a").places]
    reader = format.reader(tmp_path, "s")
    reader.read("a")
    for at, size in places:
        for position in range(at, at + size, 7):
            damaged = bytearray(before)
            damaged[position] ^= 1 << (position % 8)
            path.write_bytes(damaged)
            with pytest.raises(InputError, match=r"a: .*; the file was changed or damaged: `spadmnist verify"):
                reader.read("a")


@pytest.mark.parametrize("format", ENCODINGS, ids=str)
def test_links_are_refused(tmp_path: Path, format: Encoding) -> None:
    format.write(tmp_path / "out", "a/s", some_columns(), {})
    where = tmp_path / "out" / format.folder
    inside = ["a/s.zarr.zip", "a"] if format is CONTAINER else ["a/s.h5", "a"]
    if format is FOLDER:
        inside = ["a/s/tr/ticks/c.0", "a/s/tr/ticks", "a/s/tr", "a/s", "a"]
    for name in inside:
        shutil.move(where / name, tmp_path / "elsewhere")
        (where / name).symlink_to(tmp_path / "elsewhere")
        with pytest.raises(InputError, match="symbolic link"):
            format.reader(tmp_path / "out", "a/s").read("tr/ticks")
        if name == "a":
            with pytest.raises(SpadError, match="symbolic link"):
                format.write(tmp_path / "out", "a/t", some_columns(), {})
        (where / name).unlink()
        shutil.move(tmp_path / "elsewhere", where / name)
    format.reader(tmp_path / "out", "a/s").read("tr/ticks")
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious/file").touch()
    shutil.rmtree(disk.temporary(tmp_path / "out"))
    disk.temporary(tmp_path / "out").symlink_to(tmp_path / "precious")
    with pytest.raises(SpadError, match="symbolic link"):
        disk.sweep(disk.temporary(tmp_path / "out"))
    assert (tmp_path / "precious/file").exists()


def bomb(kind: str) -> tuple[bytes, str]:
    """A valid chunk of 1 GiB of zeros in a few kB (the array says: 4,000 bytes), and its codec."""
    zeros = np.zeros(1 << 30, np.uint8)
    if kind == "zstd":
        return numcodecs.zstd.compress(zeros, 1, True), "floats"
    packed = numcodecs.blosc.compress(zeros, b"zstd", 1, numcodecs.blosc.BITSHUFFLE, 0, 4)
    return packed + chunks.crc32c(packed), "ticks"


@pytest.mark.parametrize("kind", ["zstd", "blosc"])
def test_a_bomb_is_refused_before_it_grows(tmp_path: Path, kind: str) -> None:
    chunk, codec = bomb(kind)
    column = Column(np.arange(1000, dtype=np.uint32), ("event",), "1", "numbers", codec)
    FOLDER.write(tmp_path, "s", {"a": column}, {})
    table = struct.pack("<QQ", 0, len(chunk))
    (tmp_path / "data.zarr/s/a/c.0").write_bytes(chunk + table + chunks.crc32c(table))
    program = textwrap.dedent(
        """
        import sys
        from pathlib import Path
        from spadmnist.errors import InputError
        from spadmnist.store import encoding
        reader = encoding("zarr", 1).reader(sys.argv[1], "s")
        try:
            reader.read("a")
        except InputError as error:
            assert "declares 1073741824 bytes where the array has 4000" in str(error), error
            # the process's own peak: getrusage would begin with that of the process that forked it
            status = Path("/proc/self/status").read_text()
            print(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM")))
        """
    )
    ran = subprocess.run([sys.executable, "-c", program, tmp_path], check=True, capture_output=True, text=True)
    assert int(ran.stdout) < 300_000  # kB


def test_an_hdf5_bomb_is_refused_before_it_grows(tmp_path: Path) -> None:
    """A chunk that inflates to more than the data set says."""
    import zlib

    from numcodecs.fletcher32 import Fletcher32

    data = bytes(Fletcher32().encode(zlib.compress(bytes(1 << 26), 1)))
    into = np.empty(4000, np.uint8)
    with pytest.raises(chunks.Damaged, match="does not have the 4000 bytes"):
        decode_hdf5(data, into, 4)


def test_hostile_descriptions_are_refused(tmp_path: Path) -> None:
    column = Column(np.arange(1000, dtype=np.uint32), ("event",), "1", "numbers", "ticks", 100)
    FOLDER.write(tmp_path, "s", {"a": column}, {})
    path = tmp_path / "data.zarr/s/a/zarr.json"
    text = path.read_text()
    document = json.loads(text)
    wrong_values: dict[str, list[object]] = {
        "shape": [[10**15], [-5], [1.5], [True], "x", []],
        "data_type": ["bytes", ["uint32"]],
        "codecs": [[], None],
        "attributes": [{}, None],
        "dimension_names": [[None], ["../x"]],
        "fill_value": [7],
        "extra": [1],
        "storage_transformers": [["x"]],
        "zarr_format": [2],
    }
    for key, value in [(key, value) for key, values in wrong_values.items() for value in values]:
        path.write_text(json.dumps(document | {key: value}))
        with pytest.raises(InputError, match=r"zarr\.json: "):
            FOLDER.reader(tmp_path, "s").read("a")
    for wrong in ("", "[]", "[" * 100_000, "{", "nonsense", "9" * 5000, " " * (2 << 20), '{"shape": NaN}'):
        path.write_text(wrong)
        with pytest.raises(InputError, match=r"zarr\.json: "):
            FOLDER.reader(tmp_path, "s").read("a")
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(InputError, match="not a file"):
        FOLDER.reader(tmp_path, "s").read("a")


def test_hostile_hdf5_is_refused(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    path, secret = tmp_path / "data/s.h5", tmp_path / "secret"
    secret.write_bytes(b"secret" * 100)
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["a"] = np.arange(10)

    def external_storage(file: h5py.File) -> None:
        file.create_dataset("a", (10,), "u1", external=[(str(secret), 0, 10)])

    def external_link(file: h5py.File) -> None:
        file["a"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/a")

    def link_of_a_group(file: h5py.File) -> None:
        file["g"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/")

    def soft_link(file: h5py.File) -> None:
        file["b"] = np.arange(3)
        file["a"] = h5py.SoftLink("/b")

    def virtual(file: h5py.File) -> None:
        layout = h5py.VirtualLayout((10,), "i8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "a", (10,))
        file.create_virtual_dataset("a", layout)

    def circle(file: h5py.File) -> None:
        file.create_group("g")["g"] = file["/"]

    def huge(file: h5py.File) -> None:
        filters = {"chunks": (1 << 20,), "shuffle": True, "compression": 1, "fletcher32": True}
        file.create_dataset("a", (1 << 40,), "u1", **filters)
        file["a"].attrs["dimension_names"] = ["e"]
        file["a"].attrs.update({"units": "1", "long_name": "x"})

    def text(file: h5py.File) -> None:
        file["a"] = "text"

    def no_checksum(file: h5py.File) -> None:
        file["a"] = np.arange(10)

    hostile = (
        external_storage,
        external_link,
        link_of_a_group,
        soft_link,
        virtual,
        circle,
        huge,
        text,
        no_checksum,
    )
    for make in hostile:
        with h5py.File(path, "w") as file:
            make(file)
        with pytest.raises(InputError, match=r"s\.h5: .*spadmnist verify"):
            HDF5.reader(tmp_path, "s").read("a")
    path.write_bytes(b"not HDF5")
    with pytest.raises(InputError, match=r"s\.h5: .*HDF5 cannot read it"):
        HDF5.reader(tmp_path, "s").read("a")


# --- the disk ----------------------------------------------------------------------------------------------
def test_a_file_is_committed_whole(tmp_path: Path) -> None:
    path, tmp = tmp_path / "out/manifest.json", tmp_path / "out/.spadmnist/tmp"
    assert disk.commit_file(path, b"one", tmp) == {
        "bytes": 3, "sha256": hashlib.sha256(b"one").hexdigest()
    }  # fmt: skip
    disk.commit_file(path, b"two", tmp)
    assert path.read_bytes() == b"two" and list(tmp.iterdir()) == []
    (tmp / "left/over").mkdir(parents=True)
    (tmp / "file").touch()
    assert disk.sweep(tmp) == 2 and list(tmp.iterdir()) == []
    assert disk.sweep(tmp_path / "nowhere") == 0


def test_a_file_among_the_users_own_leaves_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "answer.json"
    (tmp_path / ".answer.json.part").write_bytes(b"what a run that was killed left, longer than the new one")
    disk.put_file(path, b"new")
    assert path.read_bytes() == b"new" and os.listdir(tmp_path) == ["answer.json"]
    with pytest.raises(RuntimeError), disk.whole(path, 10) as file:
        file.write(b"half")
        raise RuntimeError
    assert path.read_bytes() == b"new" and os.listdir(tmp_path) == ["answer.json"]
    with disk.whole(path, 10) as file:
        with pytest.raises(SpadError, match="another run is writing it"):
            disk.put_file(path, b"other")
        file.write(b"mine")
    assert path.read_bytes() == b"mine" and os.listdir(tmp_path) == ["answer.json"]


SLOWLY = [pytest.param(one, marks=pytest.mark.slow) for one in (FOLDER, HDF5)]


@pytest.mark.parametrize("format", [CONTAINER, *SLOWLY], ids=str)
def test_kill_9_leaves_none_or_a_whole_one(tmp_path: Path, format: Encoding) -> None:
    program = textwrap.dedent(
        """
        import sys
        sys.path.insert(0, sys.argv[1])
        from test_store import ATTRIBUTES, more_columns, some_columns
        from spadmnist.store import Encoding
        columns, more = some_columns(40), more_columns(40)
        print("ready", flush=True)
        for i in range(100000):
            Encoding.every[sys.argv[3]].write(sys.argv[2], f"s{i % 3}", columns, ATTRIBUTES)
            Encoding.every[sys.argv[3]].append(sys.argv[2], f"s{i % 3}", more)
        """
    )
    columns, more = some_columns(40), more_columns(40)
    rng = random.Random(5)
    whole = 0
    for _ in range(4):
        command = [sys.executable, "-c", program, str(Path(__file__).parent), str(tmp_path), str(format)]
        writer = subprocess.Popen(command, stdout=subprocess.PIPE)
        assert writer.stdout is not None
        writer.stdout.readline()
        time.sleep(rng.uniform(0.02, 0.3))
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        writer.stdout.close()
        for i in range(3):
            if format.exists(tmp_path, f"s{i}"):
                whole += 1
                reader = format.reader(tmp_path, f"s{i}")
                present = {name: c for name, c in (columns | more).items() if name in reader.names}
                assert set(columns) <= set(present)
                check(reader, present)
    assert whole
    disk.sweep(disk.temporary(tmp_path))
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {".spadmnist", format.folder}


def random_shard(size: int) -> dict[str, Column]:
    data = np.random.default_rng(6).integers(0, 2**32, size // 4, dtype=np.uint32)
    return {"a": Column(data, ("event",), "1", "noise", "ticks", 1 << 14)}


@pytest.mark.parametrize("format", ENCODINGS, ids=str)
def test_a_full_disk(tmp_path: Path, format: Encoding) -> None:
    if os.geteuid() != 0:
        pytest.skip("mounting a small tmpfs needs root")
    place = tmp_path / "disk"
    place.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", place], capture_output=True).returncode:
        pytest.skip("mounting a tmpfs is not allowed here")
    try:
        format.write(place, "first", random_shard(200_000), {})
        before = tree(place)
        with pytest.raises(SpadError) as caught:
            format.write(place, "second", random_shard(2_000_000), {})
        assert str(caught.value) == (
            f"{place / format.location('second')}: cannot write up to 2 MB here: "
            "No space left on device; free some space (or choose another place with -o) and type the same "
            "command again; what is complete is kept"
        )
        with pytest.raises(SpadError, match="free some space"):
            format.append(place, "first", {"b": random_shard(2_000_000)["a"]} | random_shard(2_000_000))
        with pytest.raises(SpadError, match="free some space"):
            disk.commit_file(place / "manifest.json", os.urandom(2_000_000), disk.temporary(place))
        assert tree(place) == before and list(disk.temporary(place).iterdir()) == []
        assert not format.exists(place, "second")
    finally:
        subprocess.run(["umount", place], check=True)


@pytest.mark.parametrize("format", ENCODINGS, ids=str)
def test_a_limit_on_file_size(tmp_path: Path, format: Encoding) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(SpadError, match=r"up to 2 MB here: File too large; raise the limit .* is kept"):
            format.write(tmp_path, "s", random_shard(2_000_000), {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not format.exists(tmp_path, "s") and tree(tmp_path) == {}


@pytest.mark.parametrize("code", [errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EIO])
def test_other_failures_of_the_disk(tmp_path: Path, code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(handle: int) -> None:
        raise OSError(code, os.strerror(code))

    (tmp_path / ".spadmnist/tmp").mkdir(parents=True)
    (tmp_path / "data").mkdir()
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(SpadError, match=rf"s\.zarr\.zip: cannot write .*{os.strerror(code)}; .* is kept"):
        CONTAINER.write(tmp_path, "s", some_columns(), {})
    assert tree(tmp_path) == {}


@pytest.mark.parametrize("format", ENCODINGS, ids=str)
def test_all_of_a_shard_is_on_the_disk_before_it_is_in_its_place(
    tmp_path: Path, format: Encoding, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[tuple[str, str]] = []
    sync, rename = os.fsync, os.rename

    def synced(handle: int) -> None:
        path = os.readlink(f"/proc/self/fd/{handle}")
        time.sleep(0.01)
        sync(handle)
        done.append(("sync", path))

    def renamed(old: Path, new: Path) -> None:
        done.append(("rename", str(old)))
        rename(old, new)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "rename", renamed)
    format.write(tmp_path, "s", some_columns(), {})
    at = next(i for i, (what, _) in enumerate(done) if what == "rename")
    new = Path(done[at][1])
    place = tmp_path / format.location("s")
    there = {str(new / path.relative_to(place)) for path in place.rglob("*")} | {str(new)}
    assert there <= {path for what, path in done[:at] if what == "sync"}
    assert [path for what, path in done[at:] if what == "sync"] == [str(place.parent)]
    if format.one_file:  # the file is synchronised once
        assert [path for _, path in done[:at] if path.startswith(str(new.parent))] == [str(new)]


def test_a_name_that_is_too_long(tmp_path: Path) -> None:
    with pytest.raises(SpadError, match="name too long; choose a place with a shorter name"):
        FOLDER.write(tmp_path, "s" * 300, some_columns(), {})


def test_a_reader_works_after_a_fork(tmp_path: Path) -> None:
    columns = some_columns()
    for format in ENCODINGS:
        format.write(tmp_path, "s", columns, {})
        reader = format.reader(tmp_path, "s")
        reader.read("tr/ticks", 0, 3)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # other tests have started threads
            child = os.fork()
        if child == 0:
            try:
                check(reader, columns)
            except BaseException:
                os._exit(1)
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
