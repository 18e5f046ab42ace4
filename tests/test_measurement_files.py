"""The files of captures: what is read is what is in them, and what cannot be read is told."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from measured import (
    COUNTS,
    QIS,
    STR,
    TICK,
    TR,
    bits,
    described,
    events,
    refused,
    stored,
)

from spadmnist import capture_files, measurement
from spadmnist.errors import InputError, SpadError

# --- time stamps --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["time", "pixel", "none"])
@pytest.mark.parametrize("kind", ["<u4", ">u8", "<u8"])
def test_any_order_gives_rows_of_pixels(tmp_path: Path, order: str, kind: str) -> None:
    time, pixel = events(5000)
    chosen = np.argsort(pixel, kind="stable") if order == "pixel" else np.arange(5000)
    if order == "none":
        chosen = np.random.Generator(np.random.PCG64(3)).permutation(5000)
    stored(tmp_path / "a.h5", {"tick": TICK}, time=time[chosen].astype(kind), pixel=pixel[chosen])
    opened = measurement.open(described(tmp_path, TR))
    read = opened.recording("a").events
    assert read is not None and read.ticks is not None and read.problem(1e-3) is None
    assert read.ticks.dtype == np.uint32 and read.tick == TICK and read.end == 1e-3
    for p in range(30):
        assert np.array_equal(read.ticks[read.offsets[p] : read.offsets[p + 1]], time[pixel == p])
    assert bool(opened.notes["a"]) == (order == "none")
    if order == "none":
        assert "were sorted" in opened.notes["a"][0]


def test_a_capture_without_a_detection(tmp_path: Path) -> None:
    none = np.zeros(0, np.uint32)
    stored(tmp_path / "a.h5", {"tick": TICK}, time=none, pixel=none)
    recorded = measurement.open(described(tmp_path, TR)).recording("a")
    assert recorded.totals.tolist() == [0] * 30


def test_a_stamp_may_be_rounded_up_to_the_end_and_no_further(tmp_path: Path) -> None:
    described(tmp_path, TR)
    stored(tmp_path / "a.h5", {"tick": TICK}, time=np.array([10**6], np.uint64), pixel=np.array([0], np.uint8))
    assert measurement.open(tmp_path).recording("a").totals[0] == 1
    stored(tmp_path / "a.h5", {"tick": TICK}, time=np.array([10**6 + 1], np.uint64), pixel=np.array([0], np.uint8))
    refused(lambda: measurement.open(tmp_path).recording("a"), "time[0] is 1000001", "beyond the exposure")


def tr_file(path: Path, **change: Any) -> None:
    """A good TR file, but for what is changed."""
    time, pixel = events()
    with h5py.File(path, "w") as file:
        for name, data in (("time", time), ("pixel", pixel)):
            made = change.get(name, data)
            if callable(made):
                made(file, name, data)
            elif made is not None:
                file.create_dataset(name, data=made)
        for key, value in {"tick": TICK, **change.get("attributes", {})}.items():
            if value is not None:
                file.attrs[key] = value


def external(file: h5py.File, name: str, data: np.ndarray) -> None:
    raw = Path(file.filename).with_suffix(".raw")
    raw.write_bytes(data.tobytes())
    file.create_dataset(name, data.shape, data.dtype, external=[(str(raw), 0, data.nbytes)])


def virtual(file: h5py.File, name: str, data: np.ndarray) -> None:
    other = Path(file.filename).with_suffix(".other.h5")
    stored(other, x=data)
    layout = h5py.VirtualLayout(data.shape, data.dtype)
    layout[:] = h5py.VirtualSource(str(other), "x", data.shape)
    file.create_virtual_dataset(name, layout)


def external_link(file: h5py.File, name: str, data: np.ndarray) -> None:
    other = Path(file.filename).with_suffix(".other.h5")
    stored(other, x=data)
    file[name] = h5py.ExternalLink(str(other), "x")


def soft_link(file: h5py.File, name: str, data: np.ndarray) -> None:
    file["there"] = data
    file[name] = h5py.SoftLink("/there")


def declared(shape: tuple[int, ...], kind: str = "u8") -> Callable[[h5py.File, str, Any], None]:
    def make(file: h5py.File, name: str, _: Any) -> None:
        file.create_dataset(name, shape, kind, chunks=(min(shape[0], 1 << 16), *shape[1:]), compression="gzip")

    return make


TR_FAULTS: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "no time": ({"time": None}, ("has no data set time", "there is pixel")),
    "no tick": ({"attributes": {"tick": None}}, ("lacks the attribute tick", "tick = 1e-10")),
    "tick is text": ({"attributes": {"tick": "1 ns"}}, ("'1 ns'", "number of seconds")),
    "tick is nan": ({"attributes": {"tick": np.nan}}, ("nan", "more than 0")),
    "tick is many": ({"attributes": {"tick": np.ones(3)}}, ("not one number",)),
    "tick in ps": ({"attributes": {"tick": 100.0}}, ("100 s is longer than the 1 ms", "tick is in s")),
    "tick too fine": ({"attributes": {"tick": 1e-30}}, ("1e-30", "more than 0 (1e-18 s)")),
    "modality": ({"attributes": {"modality": "qis"}}, ("'qis'", "is 'tr'")),
    "unequal": ({"time": np.zeros(499, np.uint64)}, ("499", "500", "one for each detection")),
    "pixel out of range": ({"pixel": np.full(500, 30, np.uint16)}, ("pixel[0] is 30", "0 to 29")),
    "beyond the exposure": ({"time": np.full(500, 2**40, np.uint64)}, ("time[0] is 1099511627776",)),
    "signed": ({"time": np.zeros(500, np.int64)}, ("int64", "unsigned integers")),
    "float": ({"time": np.zeros(500)}, ("float64", "unsigned integers")),
    "text": ({"pixel": np.array([b"a"] * 500)}, ("unsigned integers",)),
    "two axes": ({"time": np.zeros((500, 2), np.uint64)}, ("shape (500, 2)",)),
    "booleans": ({"pixel": np.zeros(500, bool)}, ("bool", "unsigned")),
    "a group": ({"time": lambda file, name, _: file.create_group(name)}, ("is a group",)),
    "external storage": ({"time": external}, ("lie in another file",)),
    "virtual": ({"time": virtual}, ("lie in another file",)),
    "external link": ({"time": external_link}, ("is a link", "not followed")),
    "soft link": ({"time": soft_link}, ("is a link", "not followed")),
    "bomb of 2^40": (
        {"time": declared((2**40,)), "pixel": declared((2**40,))},
        ("1,099,511,627,776", "100,663,296 (403 MB)"),
    ),
    "bomb of 512 MiB": ({"time": declared((2**26,)), "pixel": declared((2**26,))}, ("not all of them were written",)),
    "objects": (
        {"time": lambda file, name, _: file.create_dataset(name, (500,), h5py.special_dtype(ref=h5py.Reference))},
        ("unsigned integers",),
    ),
    "ragged": (
        {"time": lambda file, name, _: file.create_dataset(name, (500,), h5py.vlen_dtype(np.uint64))},
        ("unsigned integers",),
    ),
    "scale-offset filter": (
        {"time": lambda file, name, data: file.create_dataset(name, data=data, chunks=(500,), scaleoffset=32)},
        ("filter number 6", "allowed are gzip"),
    ),
    "a huge chunk": (
        {"time": lambda file, name, _: file.create_dataset(name, (2**27,), "u8", chunks=(2**27,))},
        ("chunks of more than 32 MiB",),
    ),
}


@pytest.mark.parametrize("fault", TR_FAULTS)
def test_a_hostile_or_wrong_file_is_one_sentence(tmp_path: Path, fault: str) -> None:
    change, words = TR_FAULTS[fault]
    tr_file(tmp_path / "a.h5", **change)
    described(tmp_path, TR)
    try:
        text = refused(lambda: measurement.open(tmp_path).recording("a"), *words)
    except SpadError as error:  # of the readouts' own words
        text = str(error)
        assert all(word in text for word in words), text
    assert str(tmp_path / "a.h5") in text


def test_no_file_and_what_is_no_file(tmp_path: Path) -> None:
    described(tmp_path, TR)
    refused(lambda: measurement.open(tmp_path), "a.h5: no such file", "spadmnist import FILE --capture a -o")
    (tmp_path / "a.h5").mkdir()
    refused(lambda: measurement.open(tmp_path), "is no file")
    (tmp_path / "a.h5").rmdir()
    (tmp_path / "a.h5").write_text("time,pixel\n1,2\n")
    refused(lambda: measurement.open(tmp_path), "is not an HDF5 file")
    (tmp_path / "a.h5").write_bytes(b"")
    refused(lambda: measurement.open(tmp_path), "is not an HDF5 file")
    refused(lambda: measurement.open(tmp_path / "none"), "no such file")
    (tmp_path / "empty").mkdir()
    refused(lambda: measurement.open(tmp_path / "empty"), "has no measurement.yaml")


def test_several_files_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    second = TR.replace("id: a", "id: b").replace("a.h5", "b.h5")
    refused(lambda: measurement.open(described(tmp_path, TR, second)), "a.h5: no such file", "Nor can b.h5")


def test_names_in_a_file_cannot_write_to_the_terminal(tmp_path: Path) -> None:
    stored(tmp_path / "a.h5", {"tick": TICK}, **{"\x1b[2J\nok": np.zeros(3)})
    text = refused(lambda: measurement.open(described(tmp_path, TR)), "has no data set time")
    assert "\x1b" not in text


@pytest.mark.slow
def test_damaged_files_end_in_a_sentence(tmp_path: Path) -> None:
    """Cut short anywhere, or with changed bytes: an InputError or data, and never another error or an endless loop."""
    described(tmp_path, TR)
    tr_file(tmp_path / "a.h5", attributes={"modality": "tr"})  # text of any length, in a heap
    whole = (tmp_path / "a.h5").read_bytes()
    heap = whole.index(b"GCOL")
    rng = random.Random(5)
    told = 0
    for i in range(200):
        data = bytearray(whole)
        if i % 4 == 0:
            data = data[: rng.randrange(len(data))]
        for _ in range(rng.choice((1, 3)) if i % 4 else 0):
            place = heap + rng.randrange(64) if i % 4 == 1 else rng.randrange(len(data))
            data[place] = rng.choice((0, 255, rng.randrange(256)))
        (tmp_path / "a.h5").write_bytes(data)
        try:
            measurement.open(tmp_path).recording("a")
        except InputError as error:
            assert "\n" not in str(error)
            told += 1
    assert 60 < told < 200


# --- frames -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["packed", "0/1", "bool", "u4"])
def test_bits_packed_or_not(tmp_path: Path, kind: str) -> None:
    dense = bits()
    with h5py.File(tmp_path / "a.h5", "w") as file:
        if kind == "packed":
            file.create_dataset("frames", data=np.packbits(dense, axis=2), chunks=(7, 3, 2), compression="lzf")
            file["frames"].attrs["width"] = 10
        else:
            file["frames"] = dense.astype({"0/1": "u1", "bool": "?", "u4": "u4"}[kind])
    recorded = measurement.open(described(tmp_path, QIS)).recording("a")
    assert np.array_equal(np.concatenate([p for _, p in recorded.bits()]), np.packbits(dense, axis=2))
    assert np.array_equal(recorded.totals, dense.sum(axis=0).ravel())
    assert recorded.frames is not None and np.array_equal(recorded.frames[3:5], np.packbits(dense[3:5], axis=2))


def test_frames_are_read_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pieces that do not fit the chunks give the same frames, and every chunk is read about once."""
    dense = bits(frames=1000)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("frames", data=np.packbits(dense, axis=2), chunks=(64, 3, 2), compression="gzip")
        file["frames"].attrs["width"] = 10
    frames = measurement.open(described(tmp_path, QIS.replace("frames: 20", "frames: 1000"))).recording("a").frames
    assert isinstance(frames, capture_files.StoredFrames)
    monkeypatch.setattr(capture_files, "_KEPT", 0)
    monkeypatch.setattr(capture_files, "_FRAMES_AT_ONCE", 700)
    read: list[int] = []
    original = frames._read
    monkeypatch.setattr(frames, "_read", lambda f, a, b: read.append(b - a) or original(f, a, b))
    got = np.concatenate([frames[i : i + 37] for i in range(0, 1000, 37)])
    assert np.array_equal(got, np.packbits(dense, axis=2)) and sum(read) < 2000
    assert len(frames[5:5]) == 0
    with pytest.raises(ValueError, match="step"):
        frames[::2]


def test_stamps_of_frames(tmp_path: Path) -> None:
    ticks = np.where(bits() == 1, 77, 10_000).astype(np.uint32)
    stored(tmp_path / "a.h5", {"tick": TICK}, frames=ticks)
    recorded = measurement.open(described(tmp_path, STR)).recording("a")
    assert recorded.none == 10_000 and recorded.tick == TICK
    assert np.array_equal(recorded.totals, bits().sum(axis=0).ravel())
    stored(tmp_path / "a.h5", {"tick": TICK}, frames=ticks + 1)
    opened = measurement.open(tmp_path)
    refused(lambda: opened.recording("a").totals, "is 10001", "ends at 10000 ticks")


@pytest.mark.parametrize(
    ("attributes", "frames", "clock"),
    [
        ({"bits": 4}, 20, (300, 10e-6 / 15)),  # the capture's frames are those of the file
        ({"bits": 4, "counting": "frames"}, 300, (300, 10e-6)),  # or the binary ones they sum
        ({"bits": np.uint8(4), "counting": "counter"}, 20, (20, 10e-6)),
    ],
)
def test_counts_know_what_they_count(
    tmp_path: Path, attributes: dict[str, Any], frames: int, clock: tuple[int, float]
) -> None:
    tally = (bits() * 7).astype(np.uint8)
    stored(tmp_path / "a.h5", attributes, frames=tally)
    opened = measurement.open(described(tmp_path, COUNTS.replace("frames: 20", f"frames: {frames}")))
    conditions = opened.captures[0].conditions
    assert (conditions.frames, conditions.bits, conditions.count_frames) == (clock[0], 4, 20)
    assert conditions.frame_time == pytest.approx(clock[1], rel=1e-12)
    recorded = opened.recording("a")
    assert recorded.n_frames == 20 and np.array_equal(recorded.totals, tally.sum(axis=0, dtype=int).ravel())


FRAME_FAULTS: dict[str, tuple[str, dict[str, Any], np.ndarray, dict[str, Any], tuple[str, ...]]] = {
    "too few": (QIS, {}, bits(19), {}, ("holds 19 frames", "says 20")),
    "other array": (QIS, {}, bits(rows=4), {}, ("4 x 10", "3 x 10")),
    "not said to be packed": (QIS, {}, np.packbits(bits(), axis=2), {}, ("width = 10",)),
    "other columns": (QIS, {}, bits(columns=7), {}, ("7 columns", "has 10")),
    "other width": (QIS, {"width": 9}, np.packbits(bits(), axis=2), {}, ("width is 9", "10 columns")),
    "not bits": (QIS, {}, bits() * 2, {}, ("is 2", "0 or 1")),
    "bits beyond the columns": (QIS, {"width": 10}, np.full((20, 3, 2), 255, np.uint8), {}, ("beyond the 10 columns",)),
    "two axes": (QIS, {}, bits()[0], {}, ("2 axes",)),
    "packed as u2": (QIS, {"width": 10}, np.zeros((20, 3, 2), np.uint16), {}, ("uint16", "must be uint8")),
    "no tick": (STR, {}, np.zeros((20, 3, 10), np.uint32), {}, ("lacks the attribute tick",)),
    "no bits": (COUNTS, {}, bits(), {}, ("lacks the attribute bits", "bits = 8")),
    "bits is 40": (COUNTS, {}, bits(), {"bits": 40}, ("bits is 40", "1 to 16")),
    "bits is a fraction": (COUNTS, {}, bits(), {"bits": 2.5}, ("bits is 2.5",)),
    "counting": (COUNTS, {}, bits(), {"bits": 4, "counting": "photons"}, ("'photons'", "frames, counter")),
    "too many counts": (COUNTS, {}, bits() * 16, {"bits": 4}, ("is 16", "count up to 15")),
    "booleans": (COUNTS, {}, bits().astype(bool), {"bits": 1}, ("booleans",)),
    "another number": (COUNTS, {}, bits(21), {"bits": 4}, ("holds 21 frames", "write 21 or, as binary frames, 315")),
}


@pytest.mark.parametrize("fault", FRAME_FAULTS)
def test_frames_that_cannot_be(tmp_path: Path, fault: str) -> None:
    capture, width, data, attributes, words = FRAME_FAULTS[fault]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frames"] = data
        file["frames"].attrs.update(width)
        file.attrs.update(attributes)
    described(tmp_path, capture)
    refused(lambda: measurement.open(tmp_path).recording("a").totals, *words)
