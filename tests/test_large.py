"""Large arrays lie in a file without a name: the same numbers, digests and datasets, in little memory."""

from __future__ import annotations

import gzip
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from spadmnist import config, factory, large
from spadmnist.errors import InputError, SpadError
from spadmnist.image_files import idx_bytes
from spadmnist.images import Array, Digits, Folder, Idx, Images

CONFIG = """
seed: 1
scene: {lux: [100 mlux], images: {source: array, path: images.npy}}
recording: {exposure: 1 ms, frames: 100, frame_time: 10 us, readouts: [tr, qis]}
reconstruct: [counts]
sensor:
  name: small
  layout: {rows: 6, columns: 5, pixel_area: 100 um^2}
  effects: {detection: {pdp: 0.5}, tdc: {resolution: 1 ns}}
"""


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is more than a kilobyte lies in a file, and is looked at some 300 bytes at a time."""
    monkeypatch.setattr(large, "IN_MEMORY", 1000)
    monkeypatch.setattr(large, "_BLOCK", 300)


def in_a_file(array: np.ndarray) -> bool:
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    return base is not None


def numbers(shape: tuple[int, ...], dtype: str) -> np.ndarray:
    rng = np.random.Generator(np.random.PCG64(1))
    return (rng.random(shape) * (1 if dtype[0] == "f" else 200)).astype(dtype)


# --- arrays -----------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("tiny")
@pytest.mark.parametrize("dtype", ["u1", "<u2", "f4", "f8"])
def test_what_is_done_in_pieces_is_what_numpy_does(dtype: str, monkeypatch: pytest.MonkeyPatch) -> None:
    array = numbers((97, 6, 5), dtype)
    for other in ("f4", "u1", dtype):
        assert np.array_equal(large.converted(array, np.dtype(other)), array.astype(other))
    turned = large.converted(array.swapaxes(1, 2), array.dtype)
    assert np.array_equal(turned, array.swapaxes(1, 2)) and turned.flags.c_contiguous and in_a_file(turned)
    assert np.array_equal(large.repeated(array, 3), np.repeat(array, 3, axis=0))
    assert large.range_of(array) == (array.min(), array.max())
    copy = large.copied(array)
    assert np.array_equal(copy, array) and in_a_file(copy)
    array[50, 3, 2] = 0
    assert not np.array_equal(copy, array)


@pytest.mark.parametrize("dtype", ["u1", "<u2", "f4"])
def test_a_mean_in_pieces_is_that_of_all_to_the_last_bit(dtype: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By it the shards are cut: pieces of whole blocks that numpy itself adds up."""
    array = numbers((1000, 8, 100), dtype)
    array = array**30 if dtype == "f4" else array  # so unlike that their sum depends on its order
    whole = float(array.mean(dtype=np.float64))
    monkeypatch.setattr(large, "IN_MEMORY", 1000)
    for block in (1 << 16, 3 << 16, 1 << 20):
        monkeypatch.setattr(large, "_BLOCK", block)
        assert large.mean(array) == whole


@pytest.mark.usefixtures("tiny")
def test_not_a_number_is_seen_in_any_piece() -> None:
    array = numbers((97, 6, 5), "f4")
    array[80, 0, 0] = np.nan
    assert np.isnan(large.range_of(array)).all()


def test_a_disk_that_is_full_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(large, "IN_MEMORY", 1000)

    def full(*_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(SpadError, match=r"no room for 2.1e-06 GB of images \(No space left on device\); free some, or"):
        large.empty((2100,), np.uint8)


# --- sources ----------------------------------------------------------------------------------------------------------


def sources(folder: Path) -> dict[str, Any]:
    images, labels = numbers((40, 6, 5), "u1"), np.arange(40, dtype=np.uint8) % 3
    np.save(folder / "images.npy", images)
    np.save(folder / "floats.npy", numbers((40, 6, 5), "f8"))
    np.save(folder / "bits.npy", images > 100)
    np.savez(folder / "images.npz", x_train=images, y_train=labels, x_test=images[:39].astype("<u2") + 1)
    np.savez_compressed(folder / "packed.npz", images=images, labels=labels)
    (folder / "images.idx").write_bytes(idx_bytes(images))
    (folder / "labels.idx.gz").write_bytes(gzip.compress(idx_bytes(labels)))
    (folder / "images.idx.gz").write_bytes(gzip.compress(idx_bytes(images)))
    for i, image in enumerate(images):
        (folder / "photos" / str(i % 3)).mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(folder / "photos" / str(i % 3) / f"{i}.png")
    files = {"train_images": "images.idx", "train_labels": "labels.idx.gz"}
    return {
        "npy": Array(path="images.npy"),
        "floats": Array(path="floats.npy"),
        "bits": Array(path="bits.npy"),
        "npz": Array(path="packed.npz"),
        "idx": Idx(**files),
        "gzip": Idx(**{**files, "train_images": "images.idx.gz"}, transpose=True),
        "folder": Folder(path="photos"),
        "digits": Digits(train=40, test=0, rows=8, columns=8),
        "repeated": Array(path="images.npy", repetitions=3),
    }


@pytest.mark.parametrize("limit", [None, 38])
def test_every_source_has_the_same_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: int | None) -> None:
    made = sources(tmp_path)
    small = {name: one.load((6, 5), None, tmp_path, limit)["train"] for name, one in made.items()}
    monkeypatch.setattr(large, "IN_MEMORY", 1000)
    monkeypatch.setattr(large, "_BLOCK", 300)
    for name, one in made.items():
        found = one.load((6, 5), None, tmp_path, limit)["train"]
        assert in_a_file(found.pixels) and not in_a_file(small[name].pixels), name
        assert found.pixels.dtype == small[name].pixels.dtype and found.sha256 == small[name].sha256, name
        assert np.array_equal(found.pixels, small[name].pixels) and found.mean(30) == small[name].mean(30), name
        assert not in_a_file(found.some(3, 9)) and np.array_equal(found.some(3, 9), small[name].pixels[3:9]), name


@pytest.mark.usefixtures("tiny")
def test_wrong_values_and_short_files_are_said_as_of_small_ones(tmp_path: Path) -> None:
    images = numbers((40, 6, 5), "f4")
    images[33, 2, 1] = 7
    np.save(tmp_path / "images.npy", images)
    with pytest.raises(InputError, match=r"image 33 \(counted from 0\) has the value 7.0, allowed is 0 to 1"):
        Array(path="images.npy").load((6, 5), None, tmp_path)
    np.save(tmp_path / "images.npy", np.asfortranarray(images))
    with pytest.raises(InputError, match="4800 bytes in the order of Fortran, in which 1000 are allowed; store np"):
        Array(path="images.npy").load((6, 5), None, tmp_path)
    packed = gzip.compress(idx_bytes(numbers((40, 6, 5), "u1"))[:-100])
    (tmp_path / "images.idx").write_bytes(packed)
    with pytest.raises(InputError, match="40 x 6 x 5 bytes, but only 1100 follow"):
        Idx(train_images="images.idx").load((6, 5), None, tmp_path)


def test_the_dataset_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Byte for byte, whether its images lie in memory or in a file."""
    np.save(tmp_path / "images.npy", numbers((40, 6, 5), "u1"))
    (tmp_path / "config.yaml").write_text(CONFIG)

    def made(name: str) -> dict[str, bytes]:
        experiment = config.read(tmp_path / "config.yaml")
        splits = experiment.load_images()
        factory.generate(experiment, splits, tmp_path / name, 1)
        files = sorted(path for path in (tmp_path / name).rglob("*") if path.is_file())
        return {str(path.relative_to(tmp_path / name)): path.read_bytes() for path in files}

    one = made("one")
    monkeypatch.setattr(large, "IN_MEMORY", 1000)
    monkeypatch.setattr(large, "_BLOCK", 300)
    other = made("other")
    assert one == other and len(one) > 3


# --- memory -----------------------------------------------------------------------------------------------------------

_HELD = """
import resource, sys
import numpy as np
from pathlib import Path
from spadmnist import large
from spadmnist.images import Array
large.IN_MEMORY = 1 << 24
large._BLOCK = 1 << 22
def now(): return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
Array(path="one.npy").load((100, 100), None, Path(sys.argv[1]))
before = now()
resource.getrusage(resource.RUSAGE_SELF)
Path("/proc/self/clear_refs").write_text("5")
images = Array(path="images.npy").load((100, 100), None, Path(sys.argv[1]))["train"]
images.sha256, images.mean(len(images)), images.some(3, 9)
peak = next(int(l.split()[1]) * 1024 for l in Path("/proc/self/status").read_text().splitlines() if l[:5] == "VmHWM")
print(peak - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the peak of a process is read from /proc")
def test_large_images_take_little_memory(tmp_path: Path) -> None:
    """Of 100 MB of images at most 40 MB lie in memory at any time, where 17 MB are held whole."""
    np.save(tmp_path / "images.npy", numbers((10000, 100, 100), "u1"))
    np.save(tmp_path / "one.npy", numbers((1, 100, 100), "u1"))
    ran = subprocess.run([sys.executable, "-c", _HELD, str(tmp_path)], capture_output=True, text=True, check=True)
    assert 0 < int(ran.stdout) < 40_000_000


def test_repetitions_of_a_small_set_share_no_memory() -> None:
    images = Images(numbers((2, 6, 5), "u1"), None, 255.0)
    assert np.array_equal(images.repeated(2).pixels, np.repeat(images.pixels, 2, axis=0))


_TAKEN = """
import sys
from pathlib import Path
from spadmnist import config, factory, plan
experiment = config.read(sys.argv[1])
splits = experiment.load_images()
told = plan.estimate(experiment, splits, 1)["memory_per_worker"]
factory.generate(experiment, splits, Path(sys.argv[2]), 1)
peak = next(int(l.split()[1]) * 1024 for l in Path("/proc/self/status").read_text().splitlines() if l[:5] == "VmHWM")
print(told, peak)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the peak of a process is read from /proc")
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["digits", "chart", "photos"])
def test_the_memory_that_is_told_is_what_a_run_takes(tmp_path: Path, kind: str) -> None:
    """The peak of a process that makes a dataset alone is between half of what is told, and all of it."""
    rng = np.random.Generator(np.random.PCG64(1))
    (tmp_path / "photos").mkdir()
    for i in range(8):
        Image.fromarray(rng.integers(0, 256, (480, 640), np.uint8)).save(tmp_path / "photos" / f"{i}.png")
    source, side, lux = {
        "digits": ("{source: digits, train: 3000, test: 0}", (28, 28), "160 mlux"),
        "chart": ("{source: chart, count: 64, of: {source: digits, train: 100, test: 0}}", (512, 512), "160 mlux"),
        "photos": ("{source: folder, path: photos}", (480, 640), "160 mlux"),
    }[kind]
    (tmp_path / "config.yaml").write_text(
        f"seed: 1\nscene: {{lux: [{lux}], images: {source}}}\n"
        "recording: {exposure: 1 ms, frames: 100, frame_time: 10 us, readouts: [tr, str, qis]}\n"
        "reconstruct: [counts, inter_photon]\n"
        f"sensor:\n  name: some\n  layout: {{rows: {side[0]}, columns: {side[1]}, pixel_area: 25 um^2}}\n"
        "  effects: {detection: {pdp: 0.5}, dead_time: {duration: 50 ns}, tdc: {resolution: 10 ps}}\n"
    )
    arguments = [sys.executable, "-c", _TAKEN, str(tmp_path / "config.yaml"), str(tmp_path / "out")]
    subprocess.run([*arguments[:-1], str(tmp_path / "before")], check=True)  # compiles what is not compiled yet
    told, peak = map(int, subprocess.run(arguments, capture_output=True, text=True, check=True).stdout.split())
    assert 0.5 * told < peak < told
