"""Image sources: what they give, and one clear sentence for everything that a file can have wrong."""

from __future__ import annotations

import bz2
import gzip
import hashlib
import http.server
import io
import lzma
import math
import os
import struct
import subprocess
import sys
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numcodecs
import numpy as np
import pytest
import scipy.io
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pace import within
from PIL import Image
from pydantic import TypeAdapter, ValidationError

from spadmnist import image_files
from spadmnist import images as module
from spadmnist.errors import InputError
from spadmnist.image_files import read_idx
from spadmnist.images import (
    Array,
    Chart,
    Digits,
    Folder,
    Idx,
    Images,
    ImageSource,
    Mnist,
    Uniform,
    check_size,
)

SHAPE = (28, 28)
MNIST = Path(__file__).parents[2] / "shared" / "mnist"
needs_mnist = pytest.mark.skipif(
    not (MNIST / "train-images-idx3-ubyte.gz").is_file(), reason=f"MNIST's four files are not in {MNIST}"
)


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No test sees the user's data or cache, or the network."""
    monkeypatch.delenv("SPADMNIST_DATA", raising=False)
    monkeypatch.delenv("SPADMNIST_CACHE", raising=False)
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda project: str(tmp_path / "cache" / project))
    monkeypatch.setattr(module, "MNIST_MIRRORS", ("http://127.0.0.1:9/a/", "http://127.0.0.1:9/b/"))


def refused(load: Callable[[], Any], *parts: object) -> str:
    """The message of the InputError that `load` raises: one line that has all the parts in it."""
    with pytest.raises(InputError) as caught:
        load()
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert str(part) in message, message
    return message


# --- Images ---------------------------------------------------------------------------------------------


def some(n: int = 5) -> Images:
    pixels = np.arange(n * 6, dtype=np.uint8).reshape(n, 2, 3)
    return Images(pixels, np.arange(n, dtype=np.uint8), 255.0, names=tuple("abcdefgh"[:n]))


def test_images_are_read_only_and_leave_the_given_array_alone() -> None:
    pixels = np.zeros((2, 3, 4), np.uint8)
    part = Images(pixels, None, 255.0)
    pixels[0] = 1
    with pytest.raises(ValueError):
        part.pixels[0] = 2
    assert (len(part), part.size) == (2, (3, 4))


def test_head() -> None:
    part = some().head(2)
    assert len(part) == 2 and part.names == ("a", "b")
    assert part.labels is not None and part.labels.tolist() == [0, 1]
    assert some().head(None).sha256 == some().sha256 == some().head(9).sha256


def test_identity_depends_on_everything() -> None:
    part = some()
    others = [
        some(4),
        Images(part.pixels, None, 255.0),
        Images(part.pixels, part.labels + np.uint8(1), 255.0),  # type: ignore[operator]
        Images(part.pixels.reshape(5, 3, 2), part.labels, 255.0),
        Images(part.pixels.astype(np.uint16), part.labels, 255.0),
    ]
    assert len({part.sha256, *(other.sha256 for other in others)}) == 6


@pytest.mark.parametrize("bad", [np.zeros((2, 2), np.uint8), np.zeros((2, 2, 2), np.int64)])
def test_images_of_a_wrong_type_are_a_programming_error(bad: np.ndarray) -> None:
    with pytest.raises(ValueError):
        Images(bad, None, 1.0)
    with pytest.raises(ValueError):
        Images(np.zeros((2, 2, 2), np.uint8), np.zeros(3, np.uint8), 1.0)


def test_check_size() -> None:
    check_size({"train": some()}, (2, 3), "config.yaml: scene.images")
    refused(
        lambda: check_size({"train": some()}, (28, 28), "config.yaml: scene.images"),
        *("config.yaml: scene.images", "2 x 3", "28 x 28", "sensor.layout"),
    )
    last = Images(np.zeros((5, 28, 28, 3), np.uint8), None, 255.0)
    refused(lambda: check_size({"train": last}, (28, 28), "c.yaml"), "moveaxis")


# --- config ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("config", "kind"),
    [
        ({"source": "mnist"}, Mnist),
        ({"source": "idx", "train_images": "a"}, Idx),
        ({"source": "folder", "path": "a", "white": 255}, Folder),
        ({"source": "array", "path": "a.npy"}, Array),
        ({"source": "digits", "train": 3}, Digits),
        ({"source": "uniform"}, Uniform),
        ({"source": "chart", "of": {"source": "digits"}}, Chart),
    ],
)
def test_union(config: dict[str, Any], kind: type) -> None:
    source: Any = TypeAdapter[Any](ImageSource).validate_python(config)
    assert source.describe()
    assert type(source) is kind
    with pytest.raises(ValidationError):
        TypeAdapter[Any](ImageSource).validate_python({**config, "surprise": 1})


@pytest.mark.parametrize(
    "config",
    [
        {"source": "mnits"},
        {"source": "folder", "path": "a", "white": math.nan},
        {"source": "folder", "path": "a", "white": 0},
        {"source": "digits", "train": "3"},
        {"source": "digits", "train": True},
        {"source": "digits", "rows": 0},
        {"source": "uniform", "grey": 256},
        {"source": "uniform", "repetitions": 0},
        {"source": "idx", "train_images": ""},
    ],
)
def test_values_out_of_range(config: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        TypeAdapter[Any](ImageSource).validate_python(config)


def test_limit_and_images_dir() -> None:
    refused(lambda: Uniform().load(SHAPE, limit=0), "0", "1 or more")
    refused(lambda: Uniform().load(SHAPE, Path("/no/such")), "/no/such", "--images-dir")
    refused(lambda: Folder(path="a" * 5000).load(SHAPE), "aaaa", "check the path")


# --- IDX ------------------------------------------------------------------------------------------------


def idx(array: np.ndarray) -> bytes:
    return bytes([0, 0, 8, array.ndim]) + struct.pack(f">{array.ndim}I", *array.shape) + array.tobytes()


PIXELS = np.random.Generator(np.random.PCG64(1)).integers(0, 256, (3, 4, 5)).astype(np.uint8)
LABELS = np.array([2, 0, 1], np.uint8)
GOOD = idx(PIXELS)
PACKED = gzip.compress(GOOD, mtime=0)


@pytest.mark.parametrize("data", [GOOD, PACKED])
def test_read_idx(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "x").write_bytes(data)
    assert np.array_equal(read_idx(tmp_path / "x", 3), PIXELS)


def header(*shape: int) -> bytes:
    return bytes([0, 0, 8, 3]) + struct.pack(">3I", *shape)


@pytest.mark.parametrize(
    ("data", "parts"),
    [
        pytest.param(b"", ["empty", "download"], id="empty"),
        pytest.param(b"PK\x03\x04....", ["zip archive", "name the right file"], id="zip"),
        pytest.param(b"\n<!DOCTYPE html><html>", ["HTML page", "name the right file"], id="html"),
        pytest.param(b"\x89PNG\r\n", ["PNG"], id="png"),
        pytest.param(b"hello, world", ["68 65 6c 6c"], id="text"),
        pytest.param(
            gzip.compress(PACKED), ["gzip packed twice", "unpack it once (gunzip -k FILE)"], id="packed twice"
        ),
        pytest.param(gzip.compress(lzma.compress(GOOD)), ["xz packed, and then gzip", "unpack"], id="xz in gzip"),
        pytest.param(bz2.compress(GOOD), ["is packed by bzip2; unpack it (bunzip2 -k FILE)"], id="bzip2"),
        pytest.param(gzip.compress(b"MATLAB 5.0 MAT-file"), ["MATLAB file of version 5, not an IDX file"], id="matlab"),
        pytest.param(idx(LABELS), ["another kind", "1 dim"], id="labels as images"),
        pytest.param(GOOD[:9], ["ends inside its header"], id="short header"),
        pytest.param(GOOD[:-1], ["3 x 4 x 5", "more than the file can hold", "again"], id="truncated"),
        pytest.param(GOOD + b"!", ["3 x 4 x 5", "but more follow"], id="extra"),
        pytest.param(header(2**32 - 1, 2**32 - 1, 2**32 - 1), ["4294967295", "allowed"], id="2^96 bytes"),
        pytest.param(header(0, 28, 28), ["0 x 28 x 28", "at least one"], id="nothing"),
        pytest.param(PACKED[:-12], ["gzip data are damaged"], id="truncated gzip"),
        pytest.param(PACKED[:30] + b"\xff\xff\xff" + PACKED[33:], ["gzip data are damaged"], id="flipped gzip"),
        pytest.param(PACKED[:-8] + b"\0" * 8, ["gzip data are damaged"], id="wrong checksum"),
        pytest.param(gzip.compress(header(9, 28, 28) + b"12"), ["only 2 follow"], id="short inside gzip"),
        pytest.param(gzip.compress(header(8000, 999, 999)), ["more than the file can hold"], id="memory bomb"),
        pytest.param(PACKED + b"junk", ["gzip data are damaged"], id="junk after gzip"),
    ],
)
def test_bad_idx(tmp_path: Path, data: bytes, parts: list[str]) -> None:
    path = tmp_path / "x-ubyte.gz"
    path.write_bytes(data)
    refused(lambda: read_idx(path, 3), path, *parts)


def test_a_short_head_names_its_file(tmp_path: Path) -> None:
    """The header of labels is shorter than the beginning by which a file is told."""
    (tmp_path / "x").write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64")
    refused(lambda: read_idx(tmp_path / "x", 1), "this is a MATLAB file of version 7.3, not an IDX file")


def test_gzip_bomb_stops_at_the_declared_size(tmp_path: Path) -> None:
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    bomb = packer.compress(header(1, 1, 1)) + b"".join(packer.compress(bytes(2**20)) for _ in range(100))
    (tmp_path / "bomb").write_bytes(bomb + packer.flush())
    with within(0.1):  # 100 MB would take longer
        refused(lambda: read_idx(tmp_path / "bomb", 3), "bomb", "more follow")


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    base=st.sampled_from([GOOD, PACKED]),
    edits=st.lists(st.tuples(st.integers(0, 99), st.binary(max_size=3), st.integers(0, 3)), max_size=3),
)
def test_mutated_idx_is_refused_or_right(tmp_path: Path, base: bytes, edits: list[tuple[int, bytes, int]]) -> None:
    """Never another exception, and what comes out is what an honest reading of the bytes gives."""
    data = base
    for at, new, removed in edits:
        data = data[:at] + new + data[at + removed :]
    path = tmp_path / "mutated"
    path.write_bytes(data)
    try:
        array = read_idx(path, 3)
    except InputError as error:
        assert str(path) in str(error)
    else:
        assert idx(array) == (gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data)


def write(folder: Path, **arrays: np.ndarray) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, array in arrays.items():
        (folder / name).write_bytes(idx(array))


def test_idx_source(tmp_path: Path) -> None:
    write(tmp_path, a=PIXELS, b=LABELS, c=PIXELS[:2])
    source = Idx(train_images="a", train_labels="b", test_images="c")
    splits = source.load(SHAPE, base=tmp_path)
    assert list(splits) == ["train", "test"]
    assert np.array_equal(splits["train"].pixels, PIXELS) and splits["train"].white == 255
    assert splits["train"].labels is not None and splits["train"].labels.tolist() == [2, 0, 1]
    assert splits["test"].labels is None
    limited = source.load(SHAPE, base=tmp_path, limit=2)
    assert [len(part) for part in limited.values()] == [2, 2]
    turned = Idx(train_images="a", transpose=True).load(SHAPE, base=tmp_path)["train"].pixels
    assert np.array_equal(turned, PIXELS.swapaxes(1, 2)) and turned.flags.c_contiguous


def test_where_idx_files_are_looked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, name in enumerate(("base", "data", "given")):
        write(tmp_path / name, a=np.full((1, 2, 2), number, np.uint8))
    write(tmp_path / "base", only_here=PIXELS)

    def level(**where: Any) -> int:
        return int(Idx(train_images="a").load(SHAPE, base=tmp_path / "base", **where)["train"].pixels[0, 0, 0])

    assert level() == 0
    monkeypatch.setenv("SPADMNIST_DATA", str(tmp_path / "data"))
    assert level() == 1
    assert level(images_dir=tmp_path / "given") == 2
    assert len(Idx(train_images="only_here").load(SHAPE, base=tmp_path / "base")["train"]) == 3
    refused(
        lambda: Idx(train_images="b").load(SHAPE, base=tmp_path / "base"),
        *(tmp_path / "data" / "b", tmp_path / "base" / "b", "--images-dir"),
    )
    monkeypatch.setenv("SPADMNIST_DATA", "/no/such")
    refused(level, "SPADMNIST_DATA=/no/such", "correct the variable")


def test_idx_files_that_do_not_belong_together(tmp_path: Path) -> None:
    write(tmp_path, a=PIXELS, b=LABELS[:2])
    refused(
        lambda: Idx(train_images="a", train_labels="b").load(SHAPE, base=tmp_path),
        *(tmp_path / "b", "2 labels", tmp_path / "a", "3 images", "belong together"),
    )
    refused(lambda: Idx(train_images="a", test_labels="b").load(SHAPE, base=tmp_path), "give test_images")
    refused(lambda: Idx(train_images=".").load(SHAPE, base=tmp_path), "no file", tmp_path)


# --- MNIST ----------------------------------------------------------------------------------------------


@needs_mnist
def test_mnist() -> None:
    splits = Mnist().load(SHAPE, MNIST)
    train, test = splits["train"], splits["test"]
    assert list(splits) == ["train", "test"]
    assert (train.pixels.shape, test.pixels.shape) == ((60000, 28, 28), (10000, 28, 28))
    assert train.labels is not None and train.labels[:5].tolist() == [5, 0, 4, 1, 9]
    assert train.describe() == "60000 images of 28 x 28, uint8, 10 classes"
    both = np.concatenate([train.pixels, test.pixels])
    assert round(float(both.mean()), 3) == 33.386 and round(float((both == 0).mean()), 4) == 0.8086


@needs_mnist
def test_mnist_by_environment_and_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPADMNIST_DATA", str(MNIST))
    splits = Mnist().load(SHAPE, limit=7)
    assert [len(part) for part in splits.values()] == [7, 7]
    assert splits["train"].pixels.base is None or splits["train"].pixels.base.nbytes < 10**5


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> dict[str, bytes]:
    """Four small files in MNIST's place: their names without .gz, and what is in them unpacked."""
    arrays = [PIXELS, LABELS, PIXELS[:2], LABELS[:2]]
    files = {name: idx(array) for name, array in zip(module.MNIST_SHA256, arrays, strict=True)}
    digests = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    monkeypatch.setattr(module, "MNIST_SHA256", digests)
    return files


def put(files: dict[str, bytes], folder: Path, rename: Callable[[str], str] = str, pack: bool = False) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (folder / rename(name)).write_bytes(gzip.compress(data) if pack else data)


@pytest.mark.parametrize("pack", [False, True])
@pytest.mark.parametrize("dot", [False, True])
@pytest.mark.parametrize("below", ["", "MNIST/raw"])
def test_names_of_mnist(tiny: dict[str, bytes], tmp_path: Path, pack: bool, dot: bool, below: str) -> None:
    def rename(name: str) -> str:
        return (name.replace("-idx", ".idx") if dot else name) + ".gz" * pack

    put(tiny, tmp_path / "d" / below, rename, pack)
    splits = Mnist().load(SHAPE, tmp_path / "d")
    assert [len(part) for part in splits.values()] == [3, 2]


def test_missing_files_of_a_given_folder_are_not_downloaded(tiny: dict[str, bytes], tmp_path: Path) -> None:
    put(tiny, tmp_path / "d")
    (tmp_path / "d" / "t10k-labels-idx1-ubyte").unlink()
    (tmp_path / "d" / "train-labels-idx1-ubyte").unlink()
    message = refused(
        lambda: Mnist().load(SHAPE, tmp_path / "d"),
        *(tmp_path / "d", "t10k-labels-idx1-ubyte", "train-labels-idx1-ubyte", "leave --images-dir out"),
    )
    assert "train-images" not in message and not (tmp_path / "cache").exists()


def test_what_is_packed_is_unpacked_once(
    tiny: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(tiny, tmp_path / "d", lambda name: f"{name}.gz", pack=True)
    first = Mnist().load(SHAPE, tmp_path / "d")
    kept = tmp_path / "cache" / "spadmnist" / "unpacked"
    assert kept.stat().st_mode & 0o777 == 0o700
    assert sorted(path.read_bytes() for path in kept.iterdir()) == sorted(tiny.values())
    read: list[str] = []
    monkeypatch.setattr(module, "read_idx", lambda path, ndim: [read.append(path.suffix), read_idx(path, ndim)][1])
    assert Mnist().load(SHAPE, tmp_path / "d")["train"].sha256 == first["train"].sha256
    assert read == [""] * 4

    # a damaged copy is made again
    damaged = next(kept.glob("train-images*"))
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"?")
    assert Mnist().load(SHAPE, tmp_path / "d")["train"].sha256 == first["train"].sha256
    assert damaged.read_bytes() == tiny["train-images-idx3-ubyte"]

    # another file of the same name is no MNIST, whatever is kept
    path = tmp_path / "d" / "train-images-idx3-ubyte.gz"
    path.write_bytes(gzip.compress(idx(PIXELS[::-1].copy())))
    refused(lambda: Mnist().load(SHAPE, tmp_path / "d"), path, "source: idx")


def test_without_a_cache_what_is_packed_is_read_all_the_same(tiny: dict[str, bytes], tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("not a folder")
    put(tiny, tmp_path / "d", lambda name: f"{name}.gz", pack=True)
    assert len(Mnist().load(SHAPE, tmp_path / "d")["train"]) == 3


@needs_mnist
def test_nothing_of_a_download_is_imported_for_files_that_are_there(tmp_path: Path) -> None:
    code = "import sys; from spadmnist.images import Mnist; Mnist().load((28, 28), limit=1); print(*sys.modules)"
    environment = {**os.environ, "SPADMNIST_DATA": str(MNIST), "XDG_CACHE_HOME": str(tmp_path)}
    environment.pop("SPADMNIST_CACHE", None)
    said = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert not {"pooch", "requests", "urllib3", "charset_normalizer"} & set(said.stdout.split())


def test_another_digest(tiny: dict[str, bytes], tmp_path: Path) -> None:
    put(tiny, tmp_path / "d")
    other = idx(PIXELS[::-1].copy())
    path = tmp_path / "d" / "train-images-idx3-ubyte"
    path.write_bytes(other)
    expected = module.MNIST_SHA256["train-images-idx3-ubyte"]
    refused(
        lambda: Mnist().load(SHAPE, tmp_path / "d"),
        *(path, hashlib.sha256(other).hexdigest(), expected, "source: idx"),
    )


class Mirrors(http.server.ThreadingHTTPServer):
    """Serves `pages` (path -> body) on a port of its own, and notes what was asked for."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.pages: dict[str, bytes] = {}
        self.asked: list[str] = []

    def url(self, name: str) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/{name}/"


class Handler(http.server.BaseHTTPRequestHandler):
    server: Mirrors

    def do_GET(self) -> None:
        self.server.asked.append(self.path)
        body = self.server.pages.get(self.path)
        self.send_response(404 if body is None else 200)
        self.end_headers()
        self.wfile.write(body or b"")

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture
def mirrors(monkeypatch: pytest.MonkeyPatch) -> Iterator[Mirrors]:
    """Two mirrors, `first` and `second`; no proxy stands between."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with Mirrors() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        monkeypatch.setattr(module, "MNIST_MIRRORS", (server.url("first"), server.url("second")))
        yield server
        server.shutdown()
        thread.join()


FIRST = [
    pytest.param(lambda data: None, id="404"),
    pytest.param(lambda data: b"", id="empty"),
    pytest.param(lambda data: b"<html>Sorry</html>", id="html"),
    pytest.param(lambda data: gzip.compress(data)[:-9], id="cut off"),
    pytest.param(lambda data: gzip.compress(data[:-1] + b"?"), id="changed"),
    pytest.param(lambda data: bytes(10**6), id="far too much"),
]


@pytest.mark.parametrize("spoil", FIRST)
def test_the_second_mirror_helps(
    tiny: dict[str, bytes],
    mirrors: Mirrors,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    spoil: Callable[[bytes], bytes | None],
) -> None:
    monkeypatch.setattr(module, "_MNIST_MAX_BYTES", 10**5)
    for name, data in tiny.items():
        bad = spoil(data)
        if bad is not None:
            mirrors.pages[f"/first/{name}.gz"] = bad
        mirrors.pages[f"/second/{name}.gz"] = gzip.compress(data)
    splits = Mnist().load(SHAPE)
    assert np.array_equal(splits["train"].pixels, PIXELS) and len(splits["test"]) == 2
    cache = tmp_path / "cache" / "spadmnist" / "mnist"
    assert sorted(path.name for path in cache.iterdir()) == sorted(f"{name}.gz" for name in tiny)

    # the second time nothing is asked for, unless the cache is damaged
    mirrors.asked.clear()
    assert Mnist().load(SHAPE)["train"].sha256 == splits["train"].sha256
    assert not mirrors.asked
    (cache / "t10k-labels-idx1-ubyte.gz").write_bytes(b"damage")
    assert Mnist().load(SHAPE)["test"].sha256 == splits["test"].sha256
    assert set(mirrors.asked) == {
        "/first/t10k-labels-idx1-ubyte.gz",
        "/second/t10k-labels-idx1-ubyte.gz",
    }


def test_all_mirrors_wrong(tiny: dict[str, bytes], mirrors: Mirrors) -> None:
    mirrors.pages["/second/train-images-idx3-ubyte.gz"] = b"<html>"
    refused(lambda: Mnist().load(SHAPE), mirrors.url("first"), "404", mirrors.url("second"), "sends another file")


def test_offline(tiny: dict[str, bytes], tmp_path: Path) -> None:
    refused(
        lambda: Mnist().load(SHAPE),
        *("train-images-idx3-ubyte.gz", "any mirror", "127.0.0.1:9/a/", "127.0.0.1:9/b/"),
        *("--images-dir", "SPADMNIST_DATA"),
    )
    assert not list((tmp_path / "cache" / "spadmnist" / "mnist").iterdir())


def test_data_folder_without_mnist_falls_back_to_the_cache(
    tiny: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(tiny, tmp_path / "cache" / "spadmnist" / "mnist", lambda name: f"{name}.gz", pack=True)
    (tmp_path / "data").mkdir()
    monkeypatch.setenv("SPADMNIST_DATA", str(tmp_path / "data"))
    assert len(Mnist().load(SHAPE)["train"]) == 3


def test_a_cache_that_cannot_be_written(tiny: dict[str, bytes], tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("not a folder")
    refused(lambda: Mnist().load(SHAPE), tmp_path / "cache", "check the path")


# --- folders --------------------------------------------------------------------------------------------


def save(path: Path, array: np.ndarray, mode: str | None = None, **options: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(array)
    (image.convert(mode) if mode else image).save(path, **options)


GREY = np.arange(12, dtype=np.uint8).reshape(3, 4)
RGB = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)


def load_folder(root: Path, limit: int | None = None, **options: Any) -> dict[str, Images]:
    return Folder(path=root.name, **options).load(SHAPE, base=root.parent, limit=limit)


def test_flat_folder(tmp_path: Path) -> None:
    root = tmp_path / "f"
    for i, name in enumerate(["b.png", "a.tif", "B.bmp", "c.pgm", "d.PNG"]):
        save(root / name, GREY + np.uint8(i))
    for name in (".hidden.png", ".git/x.png", "notes.txt"):
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).write_text("no image")
    # formats that would start other programs are not images here
    (root / "e.eps").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 4 3\n")
    splits = load_folder(root)
    part = splits["train"]
    assert list(splits) == ["train"]
    assert part.names == ("B.bmp", "a.tif", "b.png", "c.pgm", "d.PNG")
    assert part.pixels[:, 0, 0].tolist() == [2, 1, 0, 3, 4]
    assert (part.labels, part.label_names, part.white, part.ignored) == (None, None, 255.0, 2)
    assert "2 files that are not images" in part.describe()


def test_classes_and_splits(tmp_path: Path) -> None:
    root = tmp_path / "f"
    for i, name in enumerate(["train/cat/2.png", "train/ant/1.png", "train/cat/deep/0.png", "test/bee/0.png"]):
        save(root / name, GREY + np.uint8(i))
    save(root / "val/cat/0.png", GREY)
    splits = load_folder(root)
    train, test = splits["train"], splits["test"]
    assert train.names == ("train/ant/1.png", "train/cat/2.png", "train/cat/deep/0.png")
    assert train.label_names == test.label_names == ("ant", "bee", "cat")
    assert train.labels is not None and train.labels.tolist() == [0, 2, 2]
    assert (train.ignored, train.unused, test.unused) == (0, {"val": 1}, {})
    assert "1 image in neither train nor test left out" in train.describe()
    assert test.labels is not None and test.labels.tolist() == [1]
    assert list(load_folder(tmp_path / "f" / "val")) == ["train"]


def test_limit_decodes_no_more(tmp_path: Path) -> None:
    save(tmp_path / "f" / "x" / "a.png", GREY)
    (tmp_path / "f" / "y").mkdir()
    (tmp_path / "f" / "y" / "b.png").write_bytes(b"broken")
    part = load_folder(tmp_path / "f", limit=1)["train"]
    assert len(part) == 1 and part.label_names == ("x", "y")


def test_kinds_of_pixels(tmp_path: Path) -> None:
    deep = GREY.astype(np.uint16) * 5000
    opaque = np.dstack([RGB, np.full((3, 4), 255, np.uint8)])
    cases: list[tuple[str, np.ndarray, str | None, np.ndarray]] = [
        ("16.png", deep, None, deep),
        ("16.tif", deep, None, deep),
        ("1.png", GREY > 5, None, np.where(GREY > 5, 255, 0)),
        ("rgb.png", RGB, None, RGB.transpose(2, 0, 1)),
        ("rgba.png", opaque, None, RGB.transpose(2, 0, 1)),
        ("la.png", GREY, "LA", GREY),
        ("p.png", GREY, "P", GREY),
        ("p.bmp", GREY, "P", GREY),
        ("p.tif", GREY, "P", GREY),
        ("l.gif", GREY, None, GREY),
        ("p.gif", GREY, "P", GREY),
        ("1.gif", GREY > 5, None, np.where(GREY > 5, 255, 0)),
        ("grey_rgb.png", np.dstack([GREY] * 3), None, np.stack([GREY] * 3)),
    ]
    for name, array, mode, expected in cases:
        root = tmp_path / name.replace(".", "-")
        save(root / name, array, mode)
        part = load_folder(root)["train"]
        assert np.array_equal(part.pixels[0], expected), name
        assert part.pixels.flags.c_contiguous and part.pixels.dtype == (
            np.uint16 if name.startswith("16") else np.uint8
        )
    (tmp_path / "16-pgm").mkdir()
    (tmp_path / "16-pgm" / "x.pgm").write_bytes(b"P5 4 3 65535\n" + deep.astype(">u2").tobytes())
    assert np.array_equal(load_folder(tmp_path / "16-pgm")["train"].pixels[0], deep)
    assert load_folder(tmp_path / "16-png")["train"].white == 65535
    assert load_folder(tmp_path / "16-png", white=60000)["train"].white == 60000


def palette(path: Path, colours: np.ndarray, indices: np.ndarray, **options: Any) -> np.ndarray:
    """Writes a picture with a palette (colours: (n, 3) uint8); returns what it shows, (3, rows, columns)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(indices.astype(np.uint8), "L")
    image.putpalette(colours.astype(np.uint8).tobytes())
    image.save(path, **options)
    return colours.astype(np.uint8)[indices].transpose(2, 0, 1)


GREYS = np.stack([np.arange(12) * 20] * 3, axis=1)[::-1]  # in another order than the levels
COLOURS = np.concatenate([GREYS, [[250, 0, 0]]])
INDICES = np.arange(12).reshape(3, 4)


@pytest.mark.parametrize("suffix", ["png", "gif", "bmp", "tif"])
def test_a_palette_is_grey_where_all_colours_used_are(tmp_path: Path, suffix: str) -> None:
    """Whatever else the palette holds; one pixel in colour makes a picture in colour."""
    for name, colours, indices in (("g", GREYS, INDICES), ("h", COLOURS, INDICES), ("c", COLOURS, INDICES + 1)):
        shown = palette(tmp_path / name / f"a.{suffix}", colours, indices)
        part = load_folder(tmp_path / name)["train"]
        assert np.array_equal(part.pixels[0], shown if name == "c" else shown[0]) and part.white == 255
        assert part.pixels.dtype == np.uint8 and part.pixels.flags.c_contiguous


def test_grey_pictures_with_and_without_palettes_in_one_folder(tmp_path: Path) -> None:
    save(tmp_path / "f" / "a.png", GREY)
    shown = palette(tmp_path / "f" / "b.gif", GREYS, INDICES)
    palette(tmp_path / "f" / "c.png", COLOURS, INDICES)
    save(tmp_path / "f" / "d.gif", GREY)
    pixels = load_folder(tmp_path / "f")["train"].pixels
    assert np.array_equal(pixels, [GREY, shown[0], shown[0], GREY])
    save(tmp_path / "f" / "e.png", RGB)
    refused(lambda: load_folder(tmp_path / "f"), tmp_path / "f" / "e.png", "8-bit colour", "but a.png is", "8-bit grey")


@pytest.mark.parametrize(
    "names",
    [
        ("train/a.gif", "train/b.gif"),
        ("train/b.gif", "train/a.gif"),
        ("train/a.gif", "test/b.gif"),
        ("test/a.gif", "train/b.gif"),
    ],
)
def test_a_picture_without_colour_among_pictures_in_colour(tmp_path: Path, names: tuple[str, str]) -> None:
    """It stays as colour as the others, whichever comes first."""
    grey = palette(tmp_path / "f" / names[0], GREYS, INDICES)
    colour = palette(tmp_path / "f" / names[1], COLOURS, INDICES + 1)
    splits = load_folder(tmp_path / "f")
    found = {n: x for part in splits.values() for n, x in zip(part.names or (), part.pixels, strict=True)}
    assert np.array_equal(found[names[0]], grey) and np.array_equal(found[names[1]], colour)


@pytest.mark.parametrize("suffix", ["png", "gif"])
def test_a_grey_palette_with_a_transparent_colour(tmp_path: Path, suffix: str) -> None:
    """Black where the picture shows it."""
    shown = palette(tmp_path / "f" / f"a.{suffix}", COLOURS, INDICES, transparency=3)
    part = load_folder(tmp_path / "f")["train"]
    assert np.array_equal(part.pixels[0], np.where(INDICES == 3, 0, shown[0])) and part.transparent == 1
    palette(tmp_path / "g" / f"a.{suffix}", COLOURS, INDICES, transparency=12)
    assert load_folder(tmp_path / "g")["train"].pixels.shape == (1, 3, 4)


def png(columns: int, rows: int, depth: int, kind: int, data: bytes) -> bytes:
    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    start = struct.pack(">IIBBBBB", columns, rows, depth, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", start) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def animation() -> bytes:
    file = io.BytesIO()
    frames = [Image.fromarray(GREY * np.uint8(k)) for k in (5, 20)]
    frames[0].save(file, "GIF", save_all=True, append_images=frames[1:])
    return file.getvalue()


def as_tiff(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(array).save(file, "TIFF")
    return file.getvalue()


WHOLE = png(40, 30, 8, 0, np.arange(30 * 41, dtype=np.uint16).astype(np.uint8).reshape(30, 41).tobytes())


@pytest.mark.parametrize(
    ("data", "parts"),
    [
        pytest.param(b"", ["none of PNG", "replace or remove"], id="empty"),
        pytest.param(b"<html>", ["none of PNG", "replace or remove"], id="html"),
        pytest.param(WHOLE[:50], ["cannot be read"], id="truncated"),
        pytest.param(WHOLE[:45] + b"\0\0\0" + WHOLE[48:], ["cannot be read"], id="changed"),
        pytest.param(png(4, 3, 8, 0, b""), ["cannot be read"], id="no data"),
        pytest.param(png(20000, 20000, 8, 0, b""), ["pixels allowed", "smaller"], id="400 Mpx"),
        pytest.param(png(10000, 10000, 8, 0, b""), ["pixels allowed", "smaller"], id="100 Mpx"),
        pytest.param(png(4, 3, 16, 2, bytes(75)), ["more than 8 bits", "8-bit RGB"], id="16-bit colour"),
        pytest.param(animation(), ["2 images", "file of its own"], id="animation"),
        pytest.param(as_tiff(GREY / np.float32(9)), ["kind F", "source array"], id="floats"),
        pytest.param(as_tiff(GREY.astype(np.int32) - 1), ["16 bits", "scale"], id="negative"),
        pytest.param(as_tiff(np.array([[70000]], np.int32)), ["16 bits", "scale"], id="32 bits"),
        pytest.param(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 4 3\n", ["none of PNG"], id="EPS"),
    ],
)
def test_bad_image_file(tmp_path: Path, data: bytes, parts: list[str]) -> None:
    (tmp_path / "f").mkdir()
    (tmp_path / "f" / "bad.png").write_bytes(data)
    refused(lambda: load_folder(tmp_path / "f"), tmp_path / "f" / "bad.png", *parts)


def test_of_a_damaged_picture_nothing_but_the_sentence_is_said(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    whole = as_tiff(GREY)
    (tmp_path / "f").mkdir()
    refusals = 0
    for size in range(8, len(whole), 7):  # Pillow warns of tags that lie beyond the end
        (tmp_path / "f" / "bad.tif").write_bytes(whole[:size])
        try:
            load_folder(tmp_path / "f")
        except InputError:
            refusals += 1
    assert refusals >= 5 and not recwarn.list


@pytest.mark.parametrize(
    ("array", "parts"),
    [
        (GREY.T, ["4 x 3", "3 x 4"]),
        (RGB, ["8-bit colour", "8-bit grey"]),
        (GREY.astype(np.uint16), ["16-bit grey", "8-bit grey"]),
    ],
)
def test_images_that_differ(tmp_path: Path, array: np.ndarray, parts: list[str]) -> None:
    save(tmp_path / "f" / "a.png", GREY)
    save(tmp_path / "f" / "b.png", array)
    save(tmp_path / "f" / "c.png", array)
    refused(lambda: load_folder(tmp_path / "f"), tmp_path / "f" / "b.png", "but a.png is", "convert", *parts)


def test_splits_that_differ(tmp_path: Path) -> None:
    save(tmp_path / "f" / "train" / "a.png", GREY)
    save(tmp_path / "f" / "test" / "a.png", RGB)
    refused(lambda: load_folder(tmp_path / "f"), "folder f", "(3, 4)", "(3, 3, 4)", "both splits")
    palette(tmp_path / "f" / "train" / "b.gif", GREYS, INDICES)
    refused(lambda: load_folder(tmp_path / "f"), "folder f", "(3, 4)", "(3, 3, 4)", "both splits")


def test_brighter_than_white(tmp_path: Path) -> None:
    save(tmp_path / "f" / "a.png", GREY)
    refused(lambda: load_folder(tmp_path / "f", white=10), "a.png", "grey level 11", "white is 10", "raise white")


def test_folders_that_cannot_be_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "f"
    refused(lambda: load_folder(root), "no folder", root, "give --images-dir DIR")
    root.mkdir()
    refused(lambda: load_folder(root), root, "no image", ".png")
    save(root / "test" / "a.png", GREY)
    refused(lambda: load_folder(root), root, "no folder train", root / "test")
    save(root / "train" / "x" / "a.png", GREY)
    save(root / "train" / "b.png", GREY)
    refused(lambda: load_folder(root), root / "train" / "b.png", "beside class folders", "move it")
    (root / "train" / "b.png").unlink()
    (root / "test" / "a.png").unlink()
    refused(lambda: load_folder(root), root / "test", "no image")
    (root / "train" / "loop").symlink_to(root)
    refused(lambda: load_folder(root), "loop", "link", "remove")
    (root / "train" / "loop").unlink()
    save(root / "test" / "a.png", GREY)
    monkeypatch.setattr(image_files, "MAX_BYTES", 5)
    refused(lambda: load_folder(root), root, "5 bytes allowed", "--limit")


def test_too_many_classes(tmp_path: Path) -> None:
    for i in range(257):
        (tmp_path / "f" / str(i)).mkdir(parents=True)
        (tmp_path / "f" / str(i) / "a.png").write_bytes(WHOLE)
    refused(lambda: load_folder(tmp_path / "f"), tmp_path / "f", "257", "256", "merge")


def test_file_name_that_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "f").mkdir()
    try:
        (tmp_path / "f" / "\udcff.png").write_bytes(WHOLE)
    except OSError:
        pytest.skip("this file system takes no such name")
    refused(lambda: load_folder(tmp_path / "f"), tmp_path / "f", "udcff", "rename").encode()


def test_a_given_folder_stands_for_the_path(tmp_path: Path) -> None:
    """It is the folder that the config names, or the one that this lies in: moved, too."""
    for i, name in enumerate(("f1", "given/f1", "moved")):
        save(tmp_path / name / "a.png", GREY + np.uint8(i))

    def level(path: str, given: str) -> int:
        return int(Folder(path=path).load(SHAPE, tmp_path / given, tmp_path)["train"].pixels[0, 0, 0])

    assert level("f1", "f1") == 0 and level("f1", "given") == 1 and level("f1", "moved") == 2
    assert level(str(tmp_path / "f1"), "moved") == level(str(tmp_path / "gone"), "moved") == 2


def test_a_given_folder_holds_the_files_of_absolute_paths(tmp_path: Path) -> None:
    (tmp_path / "moved").mkdir()
    np.save(tmp_path / "a.npy", GREY[None])
    np.save(tmp_path / "moved" / "a.npy", GREY[None] + np.uint8(1))
    source = Array(path=str(tmp_path / "a.npy"))
    assert source.load(SHAPE)["train"].pixels[0, 0, 0] == 0
    assert source.load(SHAPE, tmp_path / "moved")["train"].pixels[0, 0, 0] == 1
    (tmp_path / "empty").mkdir()
    refused(lambda: source.load(SHAPE, tmp_path / "empty"), tmp_path / "empty" / "a.npy", "--images-dir")


@pytest.mark.parametrize("source", [Digits(train=2, test=1), Uniform(), Chart(of=Digits(train=2, test=0), count=1)])
def test_what_is_made_here_refuses_a_folder(source: Any, tmp_path: Path) -> None:
    refused(lambda: source.load(SHAPE, tmp_path), "--images-dir", tmp_path, "made here", "leave it out")


# --- arrays ---------------------------------------------------------------------------------------------


def load_array(path: Path, limit: int | None = None, **options: Any) -> dict[str, Images]:
    return Array(path=path.name, **options).load(SHAPE, base=path.parent, limit=limit)


@pytest.mark.parametrize(
    ("array", "options", "dtype", "white"),
    [
        (PIXELS, {}, np.uint8, 255.0),
        (PIXELS.astype(">u2"), {}, np.uint16, 65535.0),
        (PIXELS.astype(np.uint16), {"white": 4095}, np.uint16, 4095.0),
        (PIXELS / 255, {}, np.float32, 1.0),
        ((PIXELS / 255).astype(np.float16), {}, np.float32, 1.0),
        (PIXELS.astype(float), {"white": 255}, np.float32, 255.0),
        (PIXELS.astype(np.int64), {"white": 255}, np.uint8, 255.0),
        (PIXELS.astype(np.int64) * 257, {"white": 65535}, np.uint16, 65535.0),
        (PIXELS[:, None].repeat(3, axis=1), {}, np.uint8, 255.0),
        (np.asfortranarray(PIXELS), {}, np.uint8, 255.0),
    ],
)
def test_npy(tmp_path: Path, array: np.ndarray, options: dict[str, Any], dtype: type, white: float) -> None:
    path = tmp_path / "x.npy"
    np.save(path, array)
    splits = load_array(path, **options)
    part = splits["train"]
    assert list(splits) == ["train"]
    assert (part.pixels.dtype, part.white, part.labels) == (dtype, white, None)
    assert np.array_equal(part.pixels, array.astype(dtype)) and part.pixels.flags.c_contiguous
    assert len(load_array(path, limit=2, **options)["train"]) == 2


def test_npy_of_truth_values(tmp_path: Path) -> None:
    np.save(tmp_path / "x.npy", PIXELS > 99)
    assert np.array_equal(load_array(tmp_path / "x.npy")["train"].pixels, np.where(PIXELS > 99, 255, 0))


@pytest.mark.parametrize(
    "names",
    [
        ("train_images", "train_labels", "test_images", "test_labels"),
        ("x_train", "y_train", "x_test", "y_test"),
        ("images", "labels"),
        ("images",),
    ],
)
@pytest.mark.parametrize("save_npz", [np.savez, np.savez_compressed])
def test_npz(tmp_path: Path, names: tuple[str, ...], save_npz: Callable[..., None]) -> None:
    arrays = dict(zip(names, (PIXELS, LABELS.astype(np.int64)[:, None], PIXELS[:2], LABELS[:2]), strict=False))
    save_npz(tmp_path / "x.npz", extra=np.zeros(3), **arrays)
    splits = load_array(tmp_path / "x.npz")
    assert list(splits) == (["train", "test"] if len(names) == 4 else ["train"])
    labels = splits["train"].labels
    assert (labels is None) == (len(names) == 1)
    assert labels is None or (labels.dtype == np.uint8 and np.array_equal(labels, LABELS))


def changed(at: tuple[int, ...], value: float, dtype: Any = float) -> np.ndarray:
    array = np.zeros((3, 4, 5), dtype)
    array[at] = value
    return array


class Trap:
    """If this were unpickled, the test would fail."""

    def __reduce__(self) -> tuple[Any, ...]:
        return pytest.fail, ("a pickle was executed",)


@pytest.mark.parametrize(
    ("array", "parts"),
    [
        pytest.param(changed((1, 2, 3), np.nan), ["image 1", "nan", "0 to 1"], id="NaN"),
        pytest.param(changed((2, 0, 0), np.inf), ["image 2", "inf"], id="inf"),
        pytest.param(changed((2, 0, 0), -0.5), ["image 2", "-0.5"], id="negative"),
        pytest.param(changed((1, 0, 0), 254), ["image 1", "254", "0 to 1", "set white"], id="above white"),
        pytest.param(changed((1, 0, 0), 3, int), ["int64", "set white"], id="int64"),
        pytest.param(np.zeros((4, 5)), ["(4, 5)", "(n, rows, columns)"], id="2-d"),
        pytest.param(np.zeros((1, 1, 1, 4, 5)), ["(1, 1, 1, 4, 5)"], id="5-d"),
        pytest.param(np.zeros((0, 4, 5)), ["(0, 4, 5)", "at least one"], id="no image"),
        pytest.param(np.zeros((3, 4, 0)), ["(3, 4, 0)", "at least one"], id="no column"),
        pytest.param(np.zeros((3, 4, 5), complex), ["complex128", "plain numbers"], id="complex"),
        pytest.param(np.array([[["a"]]]), ["<U1", "plain numbers"], id="text"),
        pytest.param(np.array([[[Trap()]]], object), ["object", "plain numbers"], id="pickle"),
    ],
)
@pytest.mark.parametrize("suffix", ["npy", "npz"])
def test_bad_array(tmp_path: Path, array: np.ndarray, parts: list[str], suffix: str) -> None:
    path = tmp_path / f"x.{suffix}"
    if suffix == "npy":
        np.save(path, array, allow_pickle=True)
    else:
        np.savez(path, images=array)
    refused(lambda: load_array(path), path, *parts)


def test_integers_out_of_range(tmp_path: Path) -> None:
    np.save(tmp_path / "x.npy", changed((1, 0, 0), 70000, int))
    refused(lambda: load_array(tmp_path / "x.npy", white=100000), "image 1", "70000", "65535")
    np.save(tmp_path / "x.npy", changed((1, 0, 0), -1, int))
    refused(lambda: load_array(tmp_path / "x.npy", white=255), "image 1", "-1", "0 to 255")


def npy_bytes(array: np.ndarray = PIXELS) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def declaring(shape: str, dtype: str = "|u1") -> bytes:
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}}}".encode()
    text = text.ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def zipped(data: bytes, name: str = "images.npy", packing: int = zipfile.ZIP_DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", packing) as archive:
        archive.writestr(name, data)
    return file.getvalue()


def encrypted() -> bytes:
    """The flag alone makes a reader ask for the password."""
    data = bytearray(zipped(npy_bytes()))
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    return bytes(data)


def boasting() -> bytes:
    """An archive whose directory declares 8 GiB less a little for its small member."""
    data = bytearray(zipped(declaring(f"({2**32 - 200}, 1, 1)")))
    at = data.index(b"PK\x01\x02") + 24
    data[at : at + 4] = struct.pack("<I", 2**32 - 72)
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "parts"),
    [
        pytest.param(b"", ["empty", "np.save"], id="empty"),
        pytest.param(b"<html></html>", ["HTML", "np.save"], id="html"),
        pytest.param(b"\x89HDF\r\n\x1a\n", ["HDF5", "np.save"], id="hdf5"),
        pytest.param(gzip.compress(npy_bytes()), ["is packed by gzip; unpack it (gunzip -k FILE)"], id="gzip"),
        pytest.param(npy_bytes()[:-1], ["60 bytes, but 59 follow", "store it again"], id="truncated"),
        pytest.param(npy_bytes() + b"!", ["60 bytes, but 61 follow", "store it again"], id="extra"),
        pytest.param(npy_bytes()[:20], ["header is damaged"], id="cut header"),
        pytest.param(declaring("(10**9,)"), ["header is damaged"], id="expression"),
        pytest.param(declaring("(" + "1, " * 9999 + ")"), ["header is damaged (ValueError)"], id="long header"),
        pytest.param(declaring("(("), ["header is damaged"], id="syntax"),
        pytest.param(declaring("(-2, -3, 1)"), ["(-2, -3, 1)", "store it again"], id="negative shape"),
        pytest.param(declaring("(99999999999, 28, 28)"), ["declares", "allowed", "fewer"], id="absurd"),
        pytest.param(declaring("(9999, 999, 99)"), ["but 0 follow"], id="more than the file"),
        pytest.param(b"\x93NUMPY\x03\x00" + npy_bytes()[8:], ["3.0"], id="version 3"),
        pytest.param(zipped(b"hello"), ["images", "header is damaged"], id="no npy in zip"),
        pytest.param(zipped(npy_bytes())[:-30], ["archive is damaged", "again"], id="cut zip"),
        pytest.param(zipped(npy_bytes()[:-1]), ["images", "but 59 follow"], id="truncated in zip"),
        pytest.param(zipped(npy_bytes(), "pictures.npy"), ["holds pictures", "x_train"], id="other names"),
        pytest.param(zipped(npy_bytes(), packing=zipfile.ZIP_LZMA), ["unusual"], id="lzma"),
        pytest.param(encrypted(), ["encrypted", "np.savez"], id="encrypted"),
        pytest.param(boasting(), ["more than the file can hold"], id="zip bomb"),
    ],
)
def test_damaged_array_file(tmp_path: Path, data: bytes, parts: list[str]) -> None:
    path = tmp_path / "x.npy"
    path.write_bytes(data)
    refused(lambda: load_array(path), path, *parts)


PACKERS: dict[str, Callable[[bytes], bytes]] = {
    **{"gzip": gzip.compress, "bzip2": bz2.compress, "xz": lzma.compress},
    "Zstandard": lambda data: bytes(numcodecs.Zstd().encode(data)),
}


@pytest.mark.parametrize("packer", PACKERS)
def test_what_is_packed_is_told_to_be_unpacked(tmp_path: Path, packer: str) -> None:
    """And nothing else: it may be the right file."""
    path = tmp_path / "x.npy.packed"
    path.write_bytes(PACKERS[packer](npy_bytes()))
    message = refused(lambda: load_array(path), f"{path}: this is packed by {packer}; unpack it (")
    assert "twice" not in message and "np.save" not in message
    path.write_bytes(PACKERS[packer](idx(LABELS)))
    if packer == "gzip":
        assert np.array_equal(read_idx(path, 1), LABELS)
    else:
        refused(lambda: read_idx(path, 1), f"{path}: this is packed by {packer}; unpack it (")


HEADS = {
    "an HDF5 file": [b"\x89HDF\r\n\x1a\n\0\0"],
    "a MATLAB file of version 5": [b"MATLAB 5.0 MAT-file, Platform: PCWIN64, Created on"],
    "a MATLAB file of version 7.3": [b"MATLAB 7.3 MAT-file, Platform: GLNXA64"],
    "a TIFF image": [b"II*\0\x08\0\0\0", b"MM\0*\0\0\0\x08", b"II+\0\x08\0\0\0", b"MM\0+\0\x08\0\0"],
    "a PicoQuant PTU file": [b"PQTTTR\0\x001.0.00\0\0"],
    "a Parquet file": [b"PAR1\x15\x04\x15\x10"],
    "a GIF image": [b"GIF89a", b"GIF87a"],
    "packed by gzip; unpack it (gunzip -k FILE)": [PACKERS["gzip"](b"1")],
    "packed by bzip2; unpack it (bunzip2 -k FILE)": [PACKERS["bzip2"](b"1")],
    "packed by xz; unpack it (unxz -k FILE)": [PACKERS["xz"](b"1")],
    "packed by Zstandard; unpack it (unzstd FILE)": [PACKERS["Zstandard"](b"1")],
    "an empty file": [b""],
}


@pytest.mark.parametrize("seems", HEADS)
def test_a_file_is_named_by_its_first_bytes(seems: str) -> None:
    for data in HEADS[seems]:
        assert image_files.looks_like(data[: image_files.HEAD]) == seems


def test_real_files_are_named(tmp_path: Path) -> None:
    """As other libraries write them."""
    scipy.io.savemat(tmp_path / "a.mat", {"a": PIXELS})
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["a"] = PIXELS
    Image.fromarray(GREY).save(tmp_path / "a.tif")
    tifffile.imwrite(tmp_path / "b.tif", GREY, bigtiff=True, byteorder=">")
    for name, seems in (("a.mat", "a MATLAB file"), ("a.h5", "an HDF5"), ("a.tif", "a TIFF"), ("b.tif", "a TIFF")):
        refused(lambda name=name: load_array(tmp_path / name), f"this is {seems}", "not a .npy or .npz file", "np.save")


def test_zip_that_unpacks_to_too_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.savez_compressed(tmp_path / "x.npz", images=PIXELS, labels=LABELS)
    monkeypatch.setattr(image_files, "MAX_BYTES", 300)
    refused(lambda: load_array(tmp_path / "x.npz"), tmp_path / "x.npz", "300 bytes allowed", "fewer")


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    base=st.sampled_from([npy_bytes(), zipped(npy_bytes()), zipped(npy_bytes(), packing=zipfile.ZIP_STORED)]),
    edits=st.lists(st.tuples(st.integers(0, 400), st.binary(max_size=3), st.integers(0, 3)), max_size=3),
)
def test_mutated_array_file_is_refused_or_read(
    tmp_path: Path, base: bytes, edits: list[tuple[int, bytes, int]]
) -> None:
    data = base
    for at, new, removed in edits:
        data = data[:at] + new + data[at + removed :]
    path = tmp_path / "mutated"
    path.write_bytes(data)
    try:
        assert len(load_array(path, white=255)["train"])
    except InputError as error:
        assert str(path) in str(error)


@pytest.mark.parametrize(
    ("labels", "parts"),
    [
        (LABELS[:2], ["2 labels", "3 images"]),
        (np.array([0, 1, 256]), ["label 256", "0 to 255"]),
        (np.array([0, -1, 2]), ["label -1", "0 to 255"]),
        (np.array([0.0, 1.0, 2.0]), ["float64", "one integer per image"]),
        (np.eye(3, dtype=int), ["(3, 3)", "one integer per image"]),
    ],
)
def test_bad_labels(tmp_path: Path, labels: np.ndarray, parts: list[str]) -> None:
    np.savez(tmp_path / "x.npz", images=PIXELS, labels=labels)
    refused(lambda: load_array(tmp_path / "x.npz"), tmp_path / "x.npz", "labels", *parts)


# --- digits and uniform ---------------------------------------------------------------------------------


def test_digits_depend_on_seed_split_and_index_alone() -> None:
    many = Digits(train=30, test=20).load(SHAPE)
    few = Digits(train=12, test=3).load(SHAPE)
    limited = Digits(train=30, test=20).load(SHAPE, limit=12)
    for split, n in (("train", 12), ("test", 3)):
        assert np.array_equal(many[split].pixels[:n], few[split].pixels)
        assert many[split].head(n).sha256 == limited[split].head(n).sha256
    assert not np.array_equal(many["train"].pixels[:20], many["test"].pixels)
    assert Digits(train=30, seed=2).load(SHAPE)["train"].sha256 != many["train"].sha256
    assert list(Digits(train=1, test=0).load(SHAPE)) == ["train"]


def test_digits_look_like_mnist() -> None:
    with within(2):
        part = Digits().load(SHAPE)["train"]
    assert part.pixels.shape == (400, 28, 28) and part.labels is not None
    assert part.labels[:11].tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 0]
    # MNIST: 19.1 % of the pixels are lit, mean grey 33.4, and the margin is dark
    assert 0.17 < (part.pixels > 0).mean() < 0.21
    assert 29 < part.pixels.mean() < 36
    assert part.pixels[:, [0, -1]].max() == part.pixels[:, :, [0, -1]].max() == 0


def test_digits_can_be_told_apart() -> None:
    """The mean digit of each class, made from the training images, recognises nearly all others."""
    splits = Digits(train=400, test=200).load(SHAPE)
    train, test = (splits[split].pixels.reshape(-1, 784).astype(float) for split in ("train", "test"))
    means = np.stack([train[k::10].mean(axis=0) for k in range(10)])
    guess = ((test[:, None] - means) ** 2).sum(axis=2).argmin(axis=1)
    assert (guess == np.arange(200) % 10).mean() > 0.9


def test_digits_of_other_sizes() -> None:
    part = Digits(train=3, test=0, rows=16, columns=40).load(SHAPE)["train"]
    assert part.size == (16, 40) and (part.pixels.max(axis=(1, 2)) == 255).all()
    refused(lambda: Digits(train=10**6, rows=4096, columns=4096).load(SHAPE), "1000000 digits", "allowed", "fewer")


def test_digits_are_the_same_everywhere() -> None:
    """Drawn elsewhere, by other versions, these must be the same bytes: datasets are identified by them."""
    assert (
        Digits(train=20, test=0).load(SHAPE)["train"].sha256
        == "6c35b78580eb8da74adeffd2c79a37b46f3d2e979d7de96bd7bb2213be993bc3"
    )


def test_uniform_takes_no_memory() -> None:
    part = Uniform(repetitions=10**6, grey=128).load((512, 512))["train"]
    assert (len(part), part.size, part.labels, part.white) == (10**6, (512, 512), None, 255.0)
    assert part.pixels[999_999].flags.c_contiguous and (part.pixels[5] == 128).all()
    digests = {
        part.sha256,
        part.head(3).sha256,
        Uniform(repetitions=10**6, grey=129).load((512, 512))["train"].sha256,
        Uniform(repetitions=10**6, grey=128).load((256, 1024))["train"].sha256,
    }
    assert len(digests) == 4
    limited = Uniform(repetitions=10**6, grey=128).load((512, 512), limit=3)["train"]
    assert limited.sha256 == part.head(3).sha256
