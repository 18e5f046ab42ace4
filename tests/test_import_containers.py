"""HDF5 behind user blocks, MATLAB, gzip, axes, numbers and clocks: what is in a file is read as it is meant."""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from importfiles import CLOCK, DARK, SECOND, back, bits, hdf5, matlab, photon_hdf5, refusal, run, save

from spadmnist import capture_files, measurement
from spadmnist.effects import Conditions
from spadmnist.errors import InputError, SpadError
from spadmnist.events import Layout
from spadmnist.import_options import MOST_ROWS
from spadmnist.importers import Said, Stack, stacks
from spadmnist.importers.captures import Imported, import_files
from spadmnist.recording import Capture, Light

CASES = Path(__file__).parents[2] / "shared" / "cases"
COUNTS = np.random.Generator(np.random.Philox(4)).integers(0, 16, (7, 4, 5)).astype(np.uint8)
FOUR_BITS = replace(CLOCK, bits=4)


def frames(made: Imported, id: str | None = None) -> np.ndarray:
    """(frames, rows, columns), bits unpacked."""
    one = back(made, id)
    assert one.frames is not None
    stored = np.asarray(one.frames[:])
    return np.unpackbits(stored, axis=2, count=one.layout.columns) if one.modality == "qis" else stored


# --- where HDF5 begins --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("block", [0, 512, 1024, 2048, 4096, 1 << 16])
@pytest.mark.parametrize("filled", [b"", b"MATLAB 7.3 MAT-file", b"\x93NUMPY", b"\x1f\x8b\x08", b"II*\0", b"PQTTTR"])
def test_user_blocks(tmp_path: Path, block: int, filled: bytes) -> None:
    """What stands before it does not count, whatever it looks like."""
    file = hdf5(tmp_path / "a.h5", None, block, frames=bits())
    data = bytearray(file.read_bytes())
    data[: len(filled) if block else 0] = filled if block else b""
    file.write_bytes(data)
    assert np.array_equal(frames(run(file, CLOCK)), bits())


@pytest.mark.parametrize("block", [512, 4096])
def test_photons_behind_a_user_block(tmp_path: Path, block: int) -> None:
    photons = photon_hdf5(tmp_path / "a.hdf5", {"photon_data": ([5, 7], [1, 0])})
    with h5py.File(photons) as file, h5py.File(tmp_path / "b.hdf5", "w", userblock_size=block) as other:
        for name in file:
            file.copy(name, other)
    assert list(back(run(tmp_path / "b.hdf5", Said())).totals) == [1, 1]


def test_a_signature_at_another_place_is_none(tmp_path: Path) -> None:
    data = hdf5(tmp_path / "a.h5", frames=bits()).read_bytes()
    (tmp_path / "b.h5").write_bytes(bytes(100) + data)
    assert "what can be imported is" in refusal(tmp_path / "b.h5", CLOCK)


# --- MATLAB -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [float, bool, np.uint8, np.int32, np.float32])
@pytest.mark.parametrize("axes", [None, "HWM", "MHW"])
def test_a_stack_of_matlab(tmp_path: Path, kind: Any, axes: str | None) -> None:
    """As MATLAB shows it: (rows, columns, frames), unless --axes says otherwise."""
    shown = bits() if axes == "MHW" else bits().transpose(1, 2, 0)
    made = run(matlab(tmp_path / "a.mat", frames=shown.astype(kind)), replace(CLOCK, axes=axes))
    assert np.array_equal(frames(made), bits())
    assert any("--axes MHW says that frames come first" in note for note in made.notes) == (axes is None)


def test_counts_of_matlab(tmp_path: Path) -> None:
    made = run(matlab(tmp_path / "a.mat", frames=COUNTS.transpose(1, 2, 0) * 1.0), FOUR_BITS)
    assert np.array_equal(frames(made), COUNTS)
    made = import_files(
        [matlab(tmp_path / "b.mat", deep=COUNTS.transpose(1, 2, 0))],
        tmp_path / "deep",
        replace(FOUR_BITS, dataset="deep"),
        DARK,
    )
    assert np.array_equal(frames(made), COUNTS)


@pytest.mark.parametrize("column", [True, False])
def test_times_of_matlab(tmp_path: Path, column: bool) -> None:
    """Doubles, as N x 1 or 1 x N."""
    time, pixel = np.array([3.0, 9.0, 2.0**53 - 1]), np.array([1.0, 0.0, 1.0])
    shape = (-1, 1) if column else (1, -1)
    file = matlab(tmp_path / "a.mat", time=time.reshape(shape), pixel=pixel.reshape(shape))
    one = back(run(file, replace(SECOND, tick=1e-12, exposure=1e5)))
    assert one.events is not None and one.events.ticks is not None
    assert [int(t) for t in one.events.ticks] == [9, 3, 2**53 - 1] and list(one.totals) == [1, 2]


def test_nothing_of_matlab(tmp_path: Path) -> None:
    """Of an empty array MATLAB stores the shape, 0 and 0, which are no detections."""
    file = matlab(tmp_path / "a.mat", time=np.zeros((0, 0)), pixel=np.zeros((0, 0)))
    assert "holds no detection at all" in refusal(file, replace(SECOND, tick=1e-9))
    assert back(run(file, replace(SECOND, tick=1e-9, rows=2))).totals.tolist() == [0, 0]


@pytest.mark.parametrize(
    ("variables", "says"),
    [
        ({"time": np.array([1.0, 2.5]), "pixel": np.array([0.0, 1.0])}, "time[1] is 2.5, which is no whole number"),
        ({"time": np.array([1.0, 1e16]), "pixel": np.array([0.0, 1.0])}, "float64 does not tell from the next"),
        ({"time": np.array([1, 123456789], np.float32), "pixel": np.zeros(2)}, "float32 does not tell from the next"),
        ({"time": np.ones((2, 3)), "pixel": np.ones((2, 3))}, "store whole numbers with one axis"),
        ({"time": np.ones(3)}, "has no data set pixel"),
        ({"time": np.ones(3), "pixel": np.ones(2)}, "has 3 times and 2 pixels"),
        ({"frames": np.ones((3, 4))}, "store whole numbers with (frames, rows, columns)"),
        ({"x": np.ones(3)}, "has no data set frames; there is x"),
    ],
)
def test_matlab_is_refused(tmp_path: Path, variables: dict[str, Any], says: str) -> None:
    said = replace(SECOND, tick=1e-9) if "time" in variables else CLOCK
    assert says in refusal(matlab(tmp_path / "a.mat", **variables), said)


def test_an_older_file_of_matlab(tmp_path: Path) -> None:
    head = b"MATLAB 5.0 MAT-file, Platform: GLNXA64, Created on: Mon Mar  3 10:00:00 2025"
    (tmp_path / "a.mat").write_bytes(head.ljust(124) + b"\0\1IM" + bytes(100))
    text = refusal(tmp_path / "a.mat", CLOCK)
    assert "is a MATLAB file older than 7.3; save it again with save(..., '-v7.3')" in text


# --- gzip ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["a.csv.gz", "a.csv", "a.npy.gz", "a.npy", "a.gz", "a", "a.tif", "a.h5", "a.ptu", "o'c.csv"]
)
def test_what_gzip_packed(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(gzip.compress(b"pixel,time (ps)\n0,1\n"))
    text = refusal(tmp_path / name)
    assert "is packed by gzip; unpack it (gunzip -k " in text and "twice" not in text
    assert name != "o'c.csv" or "gunzip -k 'o'\"'\"'c.csv'" in text


def test_the_case_of_gzip(tmp_path: Path) -> None:
    if not CASES.is_dir():
        pytest.skip("needs the small files of the cases")
    for file in sorted((CASES / "packed-once").glob("*.gz")):
        with pytest.raises(SpadError, match="is packed by gzip; unpack it"):
            import_files([file], tmp_path / "no", replace(CLOCK, exposure=1.0), DARK)


# --- ticks --------------------------------------------------------------------------------------------------------

Write = Callable[[Path, Any], None]
TICKS = [0.0, -1e-9, 5e-324, 1e-300, 1e19, float("inf"), float("-inf"), float("nan")]
TIMES = {"time": np.array([1, 2], np.uint32), "pixel": np.array([0, 1], np.uint8)}


def _tick_npz(path: Path, tick: Any) -> None:
    np.savez(path, tick=tick, **TIMES)


def _tick_h5(path: Path, tick: Any) -> None:
    hdf5(path, {"tick": tick}, **TIMES)


def _tick_of_time(path: Path, tick: Any) -> None:
    with h5py.File(hdf5(path, **TIMES), "r+") as file:
        file["time"].attrs["tick"] = tick


def _tick_photons(path: Path, tick: Any) -> None:
    photon_hdf5(path, {"photon_data": ([1, 2], [0, 1])}, tick)


def _tick_str(path: Path, tick: Any) -> None:
    hdf5(path, {"tick": tick}, frames=COUNTS)


@pytest.mark.parametrize("tick", TICKS)
@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.npz", _tick_npz),
        ("a.h5", _tick_h5),
        ("b.h5", _tick_of_time),
        ("c.h5", _tick_str),
        ("a.hdf5", _tick_photons),
    ],
)
def test_a_tick_that_is_not_possible(tmp_path: Path, name: str, write: Write, tick: float) -> None:
    write(tmp_path / name, tick)
    said = CLOCK if name == "c.h5" else SECOND
    text = refusal(tmp_path / name, said)
    assert f"says that its tick is {tick}, which is not possible" in text
    assert "which is not possible" in refusal(tmp_path / name, replace(said, tick=1e-9))  # no option hides it


@pytest.mark.parametrize("tick", [np.array([1e-9, 2e-9]), np.zeros(0), "1 ns", np.array(b"x"), 1e-9 + 0j])
@pytest.mark.parametrize(("name", "write"), [("a.npz", _tick_npz), ("a.h5", _tick_h5)])
def test_a_tick_that_is_no_number(tmp_path: Path, name: str, write: Write, tick: Any) -> None:
    write(tmp_path / name, tick)
    for said in (SECOND, replace(SECOND, tick=1e-9)):
        assert "tick" in refusal(tmp_path / name, said)


@pytest.mark.parametrize("tick", TICKS)
def test_the_tick_of_a_capture(tmp_path: Path, tick: float) -> None:
    """As a measurement stores it."""
    path = hdf5(tmp_path / "a.h5", {"tick": tick}, **TIMES)
    capture = Capture("a", "tr", Light(), Conditions(1.0, 1, 1.0, 1.0, None))
    with pytest.raises(InputError, match=r"tick"):
        capture_files.read(path, capture, Layout(1, 2, np.nan, np.nan), 0.0)


@pytest.mark.parametrize("name", ["relative_uncertainty", "own_uncertainty"])
@pytest.mark.parametrize("share", [-0.1, 1.1, 1e18, float("nan")])
def test_shares_that_are_not_possible(tmp_path: Path, name: str, share: float) -> None:
    hdf5(tmp_path / "a.h5", {"tick": 1e-9, name: share}, **TIMES)
    assert f"says that its {name} is {share}, which is not possible" in refusal(tmp_path / "a.h5")
    lit = hdf5(tmp_path / "b.h5", {"tick": 1e-9, "relative_uncertainty": 1e-30, "own_uncertainty": 1.0}, **TIMES)
    assert run(lit, SECOND, ()).captures[0].light == Light(None, None, "irradiance", 1e-30, 1.0)


def test_more_pixels_than_a_measurement_holds(tmp_path: Path) -> None:
    """What is written can be opened."""
    hdf5(tmp_path / "a.h5", {"tick": 1e-9}, **TIMES)
    made = import_files([tmp_path / "a.h5"], tmp_path / "most", replace(SECOND, columns=MOST_ROWS), DARK)
    assert measurement.open(made.folder).layout.shape == (1, MOST_ROWS)
    hdf5(tmp_path / "b.h5", {"tick": 1e-9, "columns": MOST_ROWS + 1}, **TIMES)
    assert f"1 x {MOST_ROWS + 1} pixels are more than the 16,777,216" in refusal(tmp_path / "b.h5")
    assert "4097 x 4097 pixels are more" in refusal(tmp_path / "a.h5", replace(SECOND, rows=4097, columns=4097))
    used = np.arange(MOST_ROWS + 1, dtype=np.uint32)  # each of them a pixel
    hdf5(tmp_path / "c.h5", {"tick": 1e-9}, time=np.zeros(len(used), np.uint32), pixel=used)
    assert f"1 x {MOST_ROWS + 1} pixels are more than" in refusal(tmp_path / "c.h5")


@pytest.mark.parametrize("name", ["exposure", "wavelength", "frame_time"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf"), 1e300])
def test_other_facts_that_are_not_possible(tmp_path: Path, name: str, value: float) -> None:
    hdf5(tmp_path / "a.h5", {"tick": 1e-9, name: value}, **TIMES)
    assert f"says that its {name} is {value}, which is not possible" in refusal(tmp_path / "a.h5")


@pytest.mark.parametrize(
    ("name", "value"), [("rows", 2.5), ("columns", 0), ("bits", -3), ("width", 10.5), ("bits", 40)]
)
def test_numbers_that_are_not_whole(tmp_path: Path, name: str, value: float) -> None:
    hdf5(tmp_path / "a.h5", {name: value}, frames=COUNTS)
    assert name in refusal(tmp_path / "a.h5", CLOCK)


# --- what a file says beside ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.h5", "a.npz"])
def test_detections_and_frames_in_one_file(tmp_path: Path, name: str) -> None:
    both = {**TIMES, "frames": bits()}
    if name == "a.npz":
        np.savez(tmp_path / name, tick=1e-9, **both)
    else:
        hdf5(tmp_path / name, {"tick": 1e-9}, **both)
    said = replace(CLOCK, exposure=1.0)
    assert "holds detections (time, pixel) and frames; say with --modality" in refusal(tmp_path / name, SECOND)
    assert list(back(run(tmp_path / name, replace(SECOND, modality="tr"))).totals) == [1, 1]
    with pytest.raises(SpadError, match="--exposure does not apply to qis"):
        import_files([tmp_path / name], tmp_path / "no", replace(said, modality="qis"), DARK)
    made = import_files([tmp_path / name], tmp_path / "qis", replace(CLOCK, modality="qis"), DARK)
    assert np.array_equal(frames(made), bits())


def test_times_of_frames_are_no_detections(tmp_path: Path) -> None:
    """A camera's file holds when each frame was taken, a number of frames may be called so."""
    file = hdf5(tmp_path / "a.h5", frames=bits(), time=np.arange(20.0) / 7)
    assert np.array_equal(frames(run(file, CLOCK)), bits())
    file = hdf5(tmp_path / "b.h5", {"tick": 1e-9}, frames=20, **TIMES)
    assert list(back(import_files([file], tmp_path / "tr", SECOND, DARK)).totals) == [1, 1]


def test_names_of_what_a_file_holds_stay_on_one_line(tmp_path: Path) -> None:
    name = "a\n\x1b[31mb"
    hdf5(tmp_path / "a.h5", **{name: bits()})
    np.savez(tmp_path / "a.npz", **{name: bits()})
    for file in ("a.h5", "a.npz"):
        text = refusal(tmp_path / file, CLOCK)
        assert r"a\x0a\x1b[31mb" in text and text.isprintable()


def test_a_width_that_is_not_the_columns(tmp_path: Path) -> None:
    facts = {"width": 16, "rows": 3, "columns": 11}
    hdf5(tmp_path / "a.h5", facts, frames=np.packbits(bits(), axis=2))
    np.savez(tmp_path / "a.npz", frames=np.packbits(bits(), axis=2), **facts)  # type: ignore[arg-type]
    for file in ("a.h5", "a.npz"):
        assert "says that it has 11 columns and a width of 16" in refusal(tmp_path / file, CLOCK)


def test_a_width_of_numbers(tmp_path: Path) -> None:
    """A file may say the width of frames that are not packed."""
    for name, file in (("a", hdf5(tmp_path / "a.h5", {"width": 11}, frames=bits())), ("b", tmp_path / "b.npz")):
        np.savez(tmp_path / "b.npz", frames=bits(), width=11)
        assert np.array_equal(frames(import_files([file], tmp_path / name, CLOCK, DARK)), bits())
    narrow = hdf5(tmp_path / "c.h5", {"width": 1}, frames=np.packbits(bits(columns=1), axis=2))
    assert np.array_equal(frames(import_files([narrow], tmp_path / "c", CLOCK, DARK)), bits(columns=1))


def test_the_tick_of_a_data_set(tmp_path: Path) -> None:
    _tick_of_time(tmp_path / "a.h5", 2e-9)
    assert "has ticks of 2 ns; leave out --tick" in refusal(tmp_path / "a.h5", replace(SECOND, tick=1e-9))
    assert back(run(tmp_path / "a.h5")).tick == 2e-9


# --- clocks -------------------------------------------------------------------------------------------------------


def late(path: Path, kind: Any, start: int) -> Path:
    times = np.array([start + 700, start, start + 90_000], kind)
    np.savez(path, time=times, pixel=np.array([0, 1, 1]), tick=1e-9)
    return path


@pytest.mark.parametrize(
    ("kind", "start"),
    [
        (np.int64, 7_000_000_000),
        (np.uint64, 2**63),
        (np.int32, -2_000_000_000),
        (np.float64, 2.0**52),
        (np.int64, -(2**62)),
    ],
)
def test_a_clock_that_does_not_start_at_0(tmp_path: Path, kind: Any, start: int) -> None:
    file = late(tmp_path / "a.npz", kind, int(start))
    text = refusal(file)
    assert "outside the exposure of 1 s; if its clock does not start at 0, give --subtract-start" in text
    made = run(file, replace(SECOND, subtract_start=True))
    one = back(made)
    assert one.events is not None and one.events.ticks is not None
    assert [int(t) for t in one.events.ticks] == [700, 0, 90_000]
    assert any("its clock is counted from the first detection, at" in note for note in made.notes)


@pytest.mark.parametrize("kind", [np.int8, np.int16, np.int32])
def test_differences_do_not_wrap(tmp_path: Path, kind: Any) -> None:
    """A short type's first and last number are further apart than it can tell."""
    low, high = np.iinfo(kind).min, np.iinfo(kind).max
    np.savez(tmp_path / "a.npz", time=np.array([high, low], kind), pixel=np.array([0, 0]), tick=1e-12)
    one = back(run(tmp_path / "a.npz", replace(SECOND, subtract_start=True)))
    assert one.events is not None and [int(t) for t in one.events.ticks] == [0, high - low]  # type: ignore[union-attr]


def test_a_clock_that_starts_at_0(tmp_path: Path) -> None:
    file = late(tmp_path / "a.npz", np.int64, 0)
    one, two = run(file), import_files([file], tmp_path / "two", replace(SECOND, subtract_start=True), DARK)
    assert np.array_equal(back(one).events.ticks, back(two).events.ticks)  # type: ignore[union-attr, arg-type]
    far = "outside the exposure of 10 us; give another --exposure"
    (tmp_path / "b").mkdir()
    assert far in refusal(late(tmp_path / "b" / "a.npz", np.int64, 0), Said(exposure=1e-5))
    assert far in refusal(late(tmp_path / "b" / "a.npz", np.int64, 0), Said(exposure=1e-5, subtract_start=True))


@pytest.mark.parametrize(
    ("low", "high", "says"),
    [
        (0.0, 1.0, ""),
        (0.0, 0.6, "nothing was recorded in the last 40"),
        (0.5, 1.0, "nothing was recorded in the first 50"),
        (0.9, 0.93, "nothing was recorded in the first 90"),
        (0.0, 0.97, ""),  # by chance
    ],
)
def test_silence_at_the_ends(tmp_path: Path, low: float, high: float, says: str) -> None:
    """A rate over the whole exposure would be wrong. 400 detections: the silence that is told is of 6 % and more."""
    time = np.linspace(low + 1e-3, high - 1e-3, 400) * 1e9
    np.savez(tmp_path / "a.npz", time=np.rint(time).astype(np.int64), pixel=np.arange(400) % 3, tick=1e-9)
    made = run(tmp_path / "a.npz")
    assert any(says in note for note in made.notes) if says else not made.notes


def test_the_case_of_a_clock(tmp_path: Path) -> None:
    if not CASES.is_dir():
        pytest.skip("needs the small files of the cases")
    file = CASES / "clock-does-not-start-at-0" / "tags.csv"
    with pytest.raises(SpadError, match=r"reach from 7\.00001556 s to 7\.00099966 s.*give --subtract-start"):
        import_files([file], tmp_path / "no", Said(exposure=1e-3), DARK)
    one = back(import_files([file], tmp_path / "a", Said(exposure=1e-3, subtract_start=True), DARK))
    assert list(one.totals) == [25, 25]
    made = import_files([file], tmp_path / "b", Said(exposure=7.002), DARK)
    assert any("nothing was recorded in the first 7 s of 7.002 s" in note for note in made.notes)


# --- what numbers mean --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "white"),
    [
        (np.uint8, 1),
        (np.uint8, 255),
        (np.uint16, 255),
        (np.uint16, 65535),
        (np.int32, 255),
        (np.int64, 65535),
        (np.float32, 1),
        (np.float64, 1),
        (np.float64, 255),
        (np.float16, 1),
        (">u2", 65535),
        (bool, 1),
    ],
)
@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.h5", "a.tif"])
def test_bits_in_numbers(tmp_path: Path, kind: Any, white: int, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Stack, "step", 3)
    array = bits()
    array[:5] = False  # the first pieces do not tell which number it is
    said = replace(CLOCK, dataset="deep/er/stack" if name == "a.h5" else None)
    made = run(save(tmp_path / name, array.astype(kind) * np.array(white, kind)), said)
    assert made.captures[0].modality == "qis" and np.array_equal(frames(made), array)
    told = f"0 and {white} are read as no detection and a detection"
    assert any(told in note for note in made.notes) == (white > 1)
    assert made.took[0].detections == array.sum()


@pytest.mark.parametrize(
    "numbers", [[0, 2], [0, 1, 255], [1, 255], [0, 128], [0, 254], [0, 255, 65535], [0, 1, 2], [-1, 0, 1]]
)
def test_other_numbers_are_no_bits(tmp_path: Path, numbers: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Told that they are, they are refused as they are read, in whatever frame they stand."""
    monkeypatch.setattr(Stack, "step", 2)
    array = np.zeros((9, 2, 2), np.int32)
    array.flat[-len(numbers) :] = numbers
    array[0, 0, 0] = numbers[-1]
    text = refusal(save(tmp_path / "a.npy", array), CLOCK)
    assert "holds numbers other than 0 and 1 (or 0 and 255), so they are no bits" in text
    assert "but a bit is 0 or 1 (or 255); correct it" in refusal(tmp_path / "a.npy", replace(CLOCK, modality="qis"))


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int64, np.float32, np.float64, np.float16, ">i4"])
@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.h5", "a.tif"])
def test_counts_in_numbers(tmp_path: Path, kind: Any, name: str) -> None:
    said = replace(FOUR_BITS, dataset="deep/er/stack" if name == "a.h5" else None)
    made = run(save(tmp_path / name, COUNTS.astype(kind)), said)
    assert np.array_equal(frames(made), COUNTS) and made.took[0].detections == COUNTS.sum()
    high = refusal_elsewhere(save(tmp_path / name, (COUNTS + 1).astype(kind)), said, tmp_path / "no")
    assert "the frames from 0 on hold 16, but 4 bits count up to 15" in high


def refusal_elsewhere(file: Path, said: Said, out: Path) -> str:
    with pytest.raises(SpadError) as caught:
        import_files([file], out, said, DARK)
    return str(caught.value)


@pytest.mark.parametrize(
    ("value", "kind", "says"),
    [
        (0.5, float, "the frames from 0 on hold 0.5, which is no whole number"),
        (np.nan, float, "on hold nan"),
        (np.inf, float, "on hold inf"),
        (-np.inf, np.float32, "on hold -inf"),
        (2050, np.float16, "which float16 does not tell from the next whole number"),
        (-1, np.int8, "the frames from 0 on hold -1, but 12 bits count up to 4095"),
        (4096, np.uint16, "on hold 4096"),
        (2**62, np.int64, "on hold 4611686018427387904"),
    ],
)
@pytest.mark.parametrize("modality", ["counts", "str", "qis", None])
def test_numbers_that_are_no_counts(tmp_path: Path, value: Any, kind: Any, says: str, modality: str | None) -> None:
    array = np.zeros((4, 2, 3), kind)
    array[2, 1, 0] = value
    said = replace(CLOCK, modality=modality, bits=12 if modality == "counts" else None)
    said = replace(said, tick=1e-8 if modality == "str" else None)
    text = refusal(save(tmp_path / "a.npy", array), said)
    if modality == "counts":
        assert says in text
    elif modality is None:
        assert "are no bits" in text
    else:
        assert "the frames from" in text


@pytest.mark.parametrize(("none", "frame_time", "told"), [(100, 10e-6, False), (0, 10e-6, True), (100, 12e-6, True)])
def test_time_stamps_without_a_stamp_for_none(
    tmp_path: Path, none: int, frame_time: float, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where 0, or the end of a shorter frame, means that there was no detection, each would be one."""
    monkeypatch.setattr(Stack, "step", 3)
    array = np.where(bits(), np.random.Generator(np.random.Philox(1)).integers(0, 100, (20, 3, 11)), none)
    made = run(save(tmp_path / "a.npy", array), replace(CLOCK, modality="str", tick=1e-7, frame_time=frame_time))
    count = np.count_nonzero(array == none)
    says = f"no time stamp means that there was no detection, and {count} of {array.size} are {none}; if that means it"
    assert any(says in note for note in made.notes) == told
    assert made.took[0].detections == (array.size if told else bits().sum())


def test_time_stamps_of_bright_light(tmp_path: Path) -> None:
    """Every frame has a detection, at any time in it: nothing is said."""
    array = np.random.Generator(np.random.Philox(1)).integers(0, 100, (20, 3, 11))
    assert not run(save(tmp_path / "a.npy", array), replace(CLOCK, modality="str", tick=1e-7)).notes


@pytest.mark.parametrize("kind", ["qis", "counts", "packed", "str"])
@pytest.mark.parametrize(
    ("first", "last", "says"),
    [(0, 100, ""), (0, 60, "the last 40 of 100 frames"), (30, 100, "the first 30 of 100 frames")],
)
def test_frames_that_were_never_recorded(
    tmp_path: Path, kind: str, first: int, last: int, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Stack, "step", 7)
    array = bits(100)
    array[:first] = array[last:] = False
    stored = {"packed": np.packbits(array, axis=2), "str": np.where(array, 5, 100)}.get(kind, array.astype(np.uint8))
    said = replace(CLOCK, packed=kind == "packed", bits=3 if kind == "counts" else None)
    said = replace(said, columns=11, **({"modality": "str", "tick": 1e-7} if kind == "str" else {}))
    made = run(save(tmp_path / "a.npy", stored), said)
    assert any(f"nothing was recorded in {says}" in note for note in made.notes) if says else not made.notes


# --- raw ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bit_depth", [2, 8, 9, 12, 16])
@pytest.mark.parametrize("suffix", [".bin", ".raw"])
def test_raw_counts(tmp_path: Path, bit_depth: int, suffix: str) -> None:
    """A byte each, above 8 bits two, the low one first."""
    rng = np.random.Generator(np.random.Philox(bit_depth))
    array = rng.integers(0, 1 << bit_depth, (6, 4, 5)).astype("<u2" if bit_depth > 8 else np.uint8)
    (tmp_path / f"a{suffix}").write_bytes(array.tobytes())
    made = run(tmp_path / f"a{suffix}", replace(CLOCK, bits=bit_depth, rows=4, columns=5))
    assert np.array_equal(frames(made), array) and made.captures[0].conditions.bits == bit_depth


@pytest.mark.parametrize(("rows", "columns"), [(1, 8), (2, 8), (3, 8), (4, 8), (4, 16), (5, 16)])
@pytest.mark.parametrize("tail", [b"", b"DONE"])
def test_what_a_transfer_leaves_at_the_end(tmp_path: Path, rows: int, columns: int, tail: bytes) -> None:
    """However many bytes a frame has."""
    array = bits(5, rows, columns)
    (tmp_path / "a.bin").write_bytes(np.packbits(array, axis=2).tobytes() + tail)
    assert np.array_equal(frames(run(tmp_path / "a.bin", replace(CLOCK, rows=rows, columns=columns))), array)


@pytest.mark.parametrize(
    ("dtype", "most", "said", "note"),
    [
        (np.uint8, 1, {}, "each of its bytes is 0 or 1; .* add --bits 1"),
        (np.uint8, 1, {"bits": 1}, ""),
        (">u2", 9, {"bits": 12}, "each of its counts is a multiple of 256"),
        ("<u2", 9, {"bits": 12}, ""),
        (np.uint8, 255, {}, ""),
    ],
)
def test_raw_frames_of_another_form_are_doubted(tmp_path: Path, dtype: Any, most: int, said: Any, note: str) -> None:
    frames = np.random.default_rng(1).integers(0, most + 1, (40, 8, 8)).astype(dtype)
    (tmp_path / "a.raw").write_bytes(frames.tobytes())
    clock = replace(CLOCK, rows=8, columns=8, **said)
    found = import_files([tmp_path / "a.raw"], tmp_path / "out", clock, DARK)
    assert bool(found.notes) == bool(note) and re.search(note, "".join(found.notes))
    if said == {"bits": 1}:
        assert measurement.open(tmp_path / "out")["a"].counts.sum() == frames.sum()


@pytest.mark.parametrize(
    ("size", "said", "says"),
    [
        (24, {"rows": 3, "columns": 16, "modality": "counts"}, "does not say how many bits a count has"),
        (24, {"rows": 3, "columns": 16, "bits": 1}, "no whole frames of 3 x 16 counts of 1 bits (48 bytes each)"),
        (24, {"rows": 3, "columns": 16, "bits": 8, "packed": True}, "leave out --packed or --bits"),
        (25, {"rows": 3, "columns": 16}, "no whole frames of 3 x 16 bits (6 bytes each)"),
        (25, {"rows": 3, "columns": 4, "bits": 12}, "no whole frames of 3 x 4 counts of 12 bits (24 bytes each)"),
        (4, {"rows": 3, "columns": 16}, "no whole frames"),
        (24, {"rows": 3, "columns": 16, "bits": 8, "modality": "qis"}, "--bits does not apply to qis"),
        (24, {"rows": 10**6, "columns": 10**6}, "is more than can be read"),
    ],
)
def test_raw_is_refused(tmp_path: Path, size: int, said: dict[str, Any], says: str) -> None:
    (tmp_path / "a.bin").write_bytes(bytes(size))
    assert says in refusal(tmp_path / "a.bin", replace(CLOCK, **said))


@pytest.mark.parametrize(
    ("name", "depth", "right"), [("counts8.bin", 8, "right.npy"), ("counts12.raw", 12, "right12.npy")]
)
def test_the_case_of_raw_counts(tmp_path: Path, name: str, depth: int, right: str) -> None:
    folder = CASES / "raw-counts-8-bit"
    if not folder.is_dir():
        pytest.skip("needs the small files of the cases")
    made = import_files([folder / name], tmp_path / "made", replace(CLOCK, rows=8, columns=16, bits=depth), DARK)
    assert np.array_equal(frames(made), np.load(folder / right))


# --- TIFF ---------------------------------------------------------------------------------------------------------


def tif(path: Path, array: np.ndarray, **more: Any) -> Path:
    pytest.importorskip("tifffile").imwrite(path, array, **{"photometric": "minisblack", **more})
    return path


@pytest.mark.parametrize("order", ["big", "little"])
def test_packed_tiff(tmp_path: Path, order: Any) -> None:
    packed = np.packbits(bits(), axis=2, bitorder=order)
    said = replace(CLOCK, packed=True, columns=11, bit_order=order)
    assert np.array_equal(frames(run(tif(tmp_path / "a.tif", packed), said)), bits())
    (tmp_path / "b").mkdir()
    text = refusal(tif(tmp_path / "b" / "a.tif", packed.astype(np.uint16)), said)
    assert "packed frames are uint16; store uint8, or leave out --packed" in text


def test_the_case_of_packed_tiff(tmp_path: Path) -> None:
    folder = CASES / "option-without-effect"
    if not folder.is_dir():
        pytest.skip("needs the small files of the cases")
    pytest.importorskip("tifffile")
    said = replace(CLOCK, packed=True, columns=16)
    made = import_files([folder / "packed.tif"], tmp_path / "packed", said, DARK)
    assert np.array_equal(frames(made), np.load(folder / "b.npy"))


@pytest.mark.parametrize("more", [{}, {"compression": "zlib"}, {"bigtiff": True}, {"byteorder": ">"}, {"imagej": True}])
def test_tiff_as_programs_write_it(tmp_path: Path, more: dict[str, Any]) -> None:
    array = bits().astype(np.uint8) * 255
    more = {**more, "metadata": {"axes": "TYX"}} if "imagej" in more else more
    assert np.array_equal(frames(run(tif(tmp_path / "a.tif", array, **more), CLOCK)), bits())


def test_tiff_of_single_bits(tmp_path: Path) -> None:
    from PIL import Image

    pages = [Image.fromarray((page * 255).astype(np.uint8)).convert("1") for page in bits()]
    pages[0].save(tmp_path / "a.tif", save_all=True, append_images=pages[1:])
    assert np.array_equal(frames(run(tmp_path / "a.tif", CLOCK)), bits())


def test_tiff_that_shows_0_as_white(tmp_path: Path) -> None:
    made = run(tif(tmp_path / "a.tif", bits().astype(np.uint8) * 255, photometric="miniswhite"), CLOCK)
    assert any("its pages show 0 as white" in note for note in made.notes) and np.array_equal(frames(made), bits())


def test_tiff_of_ome_with_one_axis(tmp_path: Path) -> None:
    array = bits().astype(np.uint8) * 255
    for axes in ("TYX", "ZYX"):
        (tmp_path / axes).mkdir()
        path = tif(tmp_path / axes / "a.ome.tif", array, metadata={"axes": axes})
        assert np.array_equal(frames(run(path, CLOCK)), bits())


def test_tiff_is_refused(tmp_path: Path) -> None:
    tifffile = pytest.importorskip("tifffile")
    channels = np.zeros((3, 2, 4, 5), np.uint8)
    several = tif(tmp_path / "a.tif", channels, imagej=True, metadata={"axes": "TCYX"})
    assert "has 2 channels (ImageJ), one after the other" in refusal(several, CLOCK)
    slices = tif(tmp_path / "d.tif", channels, imagej=True, metadata={"axes": "TZYX"})
    assert "has 2 slices (ImageJ), one after the other" in refusal(slices, CLOCK)
    several = tif(tmp_path / "a.ome.tif", channels, metadata={"axes": "TCYX"})
    assert "has 2 channels (OME), one after the other" in refusal(several, CLOCK)
    with tifffile.TiffWriter(tmp_path / "e.ome.tif") as file:
        for _ in range(2):
            file.write(channels[:, 0], photometric="minisblack", metadata={"axes": "TYX"})
    assert "has 2 images (OME), one after the other" in refusal(tmp_path / "e.ome.tif", CLOCK)
    several = tif(tmp_path / "f.tif", channels)
    assert "has 3 of axis 0 and 2 of axis 1 (tifffile), one after the other" in refusal(several, CLOCK)
    several = tif(tmp_path / "g.tif", channels[0], metadata={"axes": "CYX"})
    assert "has 2 channels (tifffile), one after the other" in refusal(several, CLOCK)
    colour = tif(tmp_path / "b.tif", np.zeros((3, 4, 5, 3), np.uint8), photometric="rgb")
    assert "store a page of whole numbers" in refusal(colour, CLOCK)
    from PIL import Image

    pages = [Image.fromarray(page.astype(np.uint8)) for page in bits()]
    pages[0].save(tmp_path / "c.tif", save_all=True, append_images=pages[1:], compression="tiff_lzw")
    try:
        text = refusal(tmp_path / "c.tif", CLOCK)
    except pytest.fail.Exception:
        pytest.importorskip("imagecodecs")
    else:
        assert "is packed as LZW, which the package imagecodecs reads; it is not installed" in text


# --- axes ---------------------------------------------------------------------------------------------------------


def stored(path: Path, array: np.ndarray) -> Path:
    """Under the name `deep/er/stack` in HDF5."""
    if path.suffix == ".tif":
        return tif(path, np.ascontiguousarray(array), metadata=None)
    return save(path, array)


@pytest.mark.parametrize("step", [1, 3, 1000])
@pytest.mark.parametrize("kind", [np.uint8, ">u2", np.float64, bool])
@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("axes", ["HWM", "MHW", None])
@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.h5", "a.tif"])
def test_axes(
    tmp_path: Path, name: str, axes: str | None, order: Any, kind: Any, step: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against NumPy's transposes, in pieces of so many frames."""
    if name == "a.tif" and kind is bool:
        kind = np.uint16
    monkeypatch.setattr(Stack, "step", step)
    array = (bits(7, 4, 5) if kind is bool else COUNTS).astype(kind)
    shown = np.array(array.transpose(1, 2, 0) if axes == "HWM" else array, order=order)
    said = replace(CLOCK if kind is bool else FOUR_BITS, axes=axes)
    said = replace(said, dataset="deep/er/stack" if name == "a.h5" else None)
    made = run(stored(tmp_path / name, shown), said)
    assert back(made).layout.shape == (4, 5) and np.array_equal(frames(made), array)


def test_pieces_of_frames_that_lie_across(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each piece reads the whole file, so pieces are large."""
    np.save(tmp_path / "a.npy", np.ascontiguousarray(COUNTS.transpose(1, 2, 0)))
    monkeypatch.setattr(stacks, "_STRIDED_PIECE", 2 * 4 * 5)
    seen: list[int] = []
    pieces = Stack.pieces

    def watched(self: Stack) -> Any:
        seen.append(self.step)
        return pieces(self)

    monkeypatch.setattr(Stack, "pieces", watched)
    made = run(tmp_path / "a.npy", replace(CLOCK, axes="HWM", modality="str", tick=1e-7))
    assert np.array_equal(frames(made), COUNTS)
    assert stacks.arranged((4, 5, 7), np.uint8, "HWM", lambda a, b: COUNTS).step == 2
    assert stacks.arranged((7, 4, 5), np.uint8, "MHW", lambda a, b: COUNTS).step > 1000


@pytest.mark.parametrize(
    ("shape", "said", "told"),
    [
        ((12, 10, 100), {}, True),
        ((10, 10, 100), {}, True),
        ((32, 32, 8), {}, True),  # frames == rows
        ((100, 12, 10), {}, False),
        ((5, 4, 4), {}, False),
        ((1, 4, 100), {}, False),
        ((12, 10, 100), {"axes": "MHW"}, False),
        ((12, 10, 100), {"rows": 10, "columns": 100}, False),
    ],
)
@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.h5", "a.tif"])
def test_a_stack_whose_last_axis_may_be_its_frames(
    tmp_path: Path, shape: tuple[int, int, int], said: dict[str, Any], told: bool, name: str
) -> None:
    given = replace(CLOCK, **said, dataset="deep/er/stack" if name == "a.h5" else None)
    file = stored(tmp_path / name, bits(*shape).astype(np.uint8))
    made = run(file, given)
    notes = [note for note in made.notes if "import it with --axes HWM" in note]
    assert bool(notes) == told
    if told:  # and so it can be
        again = import_files([file], tmp_path / "again", replace(given, axes="HWM"), DARK)
        assert np.array_equal(frames(again), bits(*shape).transpose(2, 0, 1)) and not again.notes


def test_rows_and_columns_tell_which_axis_is_which(tmp_path: Path) -> None:
    file = stored(tmp_path / "a.npy", bits(12, 10, 100))
    text = refusal(file, replace(CLOCK, rows=12, columns=10))
    assert "its frames are 10 x 100, not 12 x 10 pixels; its frames are the last axis: give --axes HWM" in text
    made = run(file, replace(CLOCK, rows=12, columns=10, axes="HWM"))
    assert np.array_equal(frames(made), bits(12, 10, 100).transpose(2, 0, 1))


def test_a_file_that_says_its_pixels_is_not_doubted(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", frames=bits(12, 10, 100), rows=10, columns=100)
    assert not run(tmp_path / "a.npz", CLOCK).notes


def test_the_case_of_axes(tmp_path: Path) -> None:
    file = CASES / "axes-h-w-m" / "hwm.npy"
    if not file.exists():
        pytest.skip("needs the small files of the cases")
    made = import_files([file], tmp_path / "a", CLOCK, DARK)
    assert any("if these are 100 frames of 12 x 10, import it with --axes HWM" in note for note in made.notes)
    made = import_files([file], tmp_path / "b", replace(CLOCK, axes="HWM"), DARK)
    opened = measurement.open(made.folder)
    assert opened.layout.shape == (12, 10) and made.took[0].frames == 100
    assert np.array_equal(frames(made), np.load(file).transpose(2, 0, 1))
