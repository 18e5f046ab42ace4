"""Files of other programs in, and out again: small ones of every kind, hostile ones, and a real one."""

from __future__ import annotations

import contextlib
import io
import json
import lzma
import os
import struct
import subprocess
import sys
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from importfiles import (
    CLOCK,
    DARK,
    HYDRAHARP_T3,
    MULTIHARP_T2,
    PICOHARP_T2,
    SECOND,
    back,
    bits,
    photon_hdf5,
    ptu,
    refusal,
    run,
    save,
    t2,
)

import spadmnist as sp
from spadmnist import cli, exporters, image_exporters, importers, measurement
from spadmnist.cli import _terminal
from spadmnist.effects import Conditions
from spadmnist.errors import InputError, SpadError
from spadmnist.events import Events, Layout
from spadmnist.factory import Progress
from spadmnist.importers import Said, frames
from spadmnist.importers.captures import import_files
from spadmnist.importers.detections import Detections
from spadmnist.recording import Capture, Light, Recording

REAL = Path(__file__).parents[2] / "shared" / "real"
# --- PicoQuant PTU ------------------------------------------------------------------------------------------------


def by_hand(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(channel, time in ps) of the photons in a HydraHarp V2 T2 file, without the library."""
    data = path.read_bytes()
    end = data.index(b"Header_End".ljust(32, b"\0")) + 48
    count = struct.unpack_from("<q", data, data.index(b"TTResult_NumberOfRecords".ljust(32, b"\0")) + 40)[0]
    channels, times, overflow = [], [], 0
    for (word,) in struct.iter_unpack("<I", data[end : end + 4 * count]):
        special, channel, time = word >> 31, word >> 25 & 63, word & 0x1FFFFFF
        if special and channel == 63:
            overflow += 33554432 * max(1, time)
        elif not special:
            channels.append(channel)
            times.append(overflow + time)
    return np.array(channels), np.array(times)


def test_ptu(tmp_path: Path) -> None:
    pytest.importorskip("ptufile")
    words = [t2(3, 100), t2(1, 100), t2(63, 2, True), t2(3, 7), t2(0, 8, True), t2(2, 9, True), t2(1, 5)]
    file = ptu(tmp_path / "a b.ptu", words)
    made = run(file, Said())
    one = back(made)
    assert one.capture.id == "a_b" and one.capture.conditions.exposure == 2.0 and one.capture.light.dark
    assert one.events is not None and one.tick == 1e-12 and one.layout.shape == (1, 3)
    channels, times = by_hand(file)
    assert [list(one.events.row(p)) for p in (1, 2)] == [list(np.sort(times[channels == c]) * 1e-12) for c in (1, 3)]
    assert list(one.events.row(0)) == [(2 * 33554432 + 8) * 1e-12]  # of the sync input, which records as the others
    assert made.took[0].left_out == ("1 markers, which are no detections",) and made.took[0].of_pixels == (1, 2, 2)
    assert any("the sync input has 1 detections" in note for note in made.notes)
    assert any("channels sync, 1, 3 are the pixels" in note for note in made.notes)


def test_other_instruments(tmp_path: Path) -> None:
    """The PicoHarp 300 has 4 bits of channel, and overflows in channel 15; the MultiHarp is as the HydraHarp."""
    pytest.importorskip("ptufile")
    pico = [1 << 28 | 100, 15 << 28, 4 << 28 | 7, 15 << 28 | 3]
    one = back(run(ptu(tmp_path / "a.ptu", pico, PICOHARP_T2), Said(rows=1, columns=5)))
    assert one.events is not None and one.events.ticks is not None
    assert list(np.flatnonzero(one.totals)) == [1, 4] and list(one.events.ticks) == [100, 210698240 + 7]
    multi = ptu(tmp_path / "b.ptu", [t2(63, 1, True), t2(0, 5, True), t2(0, 9)], MULTIHARP_T2)
    two = back(import_files([multi], tmp_path / "two", Said(channels=("0",)), DARK))
    assert two.events is not None and two.events.ticks is not None and list(two.events.ticks) == [(1 << 25) + 9]


def test_ptu_on_a_grid_has_its_channels_as_pixels(tmp_path: Path) -> None:
    pytest.importorskip("ptufile")
    file = ptu(tmp_path / "a.ptu", [t2(3, 100), t2(1, 100)])
    assert list(back(run(file, Said(rows=2, columns=2))).totals) == [0, 1, 0, 1]
    (tmp_path / "other").mkdir()
    assert "channel 3" in refusal(ptu(tmp_path / "other" / "a.ptu", [t2(3, 100)]), Said(rows=1, columns=2))


def test_several_files_share_their_channels(tmp_path: Path) -> None:
    """A pixel that is silent in one file is the same pixel in the others."""
    pytest.importorskip("ptufile")
    files = [ptu(tmp_path / "dark.ptu", [t2(2, 9)]), ptu(tmp_path / "flat.ptu", [t2(5, 10), t2(5, 11)])]
    made = run(files, Said(), [Light(), importers.light("500 nm 5 nW/cm^2")])
    assert [list(back(made, id).totals) for id in ("dark", "flat")] == [[1, 0], [0, 2]]
    assert [capture.light.dark for capture in made.captures] == [True, False]


def test_ptu_without_its_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ptufile", None)
    assert "pip install 'spadmnist[ptu]'" in refusal(ptu(tmp_path / "a.ptu", [t2(0, 1)]))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda p: ptu(p, [t2(0, 1)], HYDRAHARP_T3, 3), "T3"),
        (lambda p: ptu(p, [t2(0, 1)], declared=10**12), "declares 1,000,000,000,000 records"),
        (lambda p: p.write_bytes(ptu(p, [t2(0, 1)] * 9).read_bytes()[:-8]), "declares 9 records, 7 follow"),
        (lambda p: p.write_bytes(ptu(p, [t2(0, 1)]).read_bytes()[:200]), "damaged or cut short"),
        (lambda p: p.write_bytes(b"PQTTTR\0\0" + os.urandom(500)), "damaged or cut short"),
        (lambda p: p.write_bytes(b"<html>sorry</html>"), "an HTML page"),
        (lambda p: p.write_bytes(b""), "the file is empty"),
        (lambda p: ptu(p, []), "holds no detection at all"),
    ],
)
def test_hostile_ptu(tmp_path: Path, change: Callable[[Path], Any], says: str) -> None:
    pytest.importorskip("ptufile")
    assert "leave out --tick" in refusal(ptu(tmp_path / "b.ptu", [t2(0, 1)]), Said(tick=1e-9))
    file = tmp_path / "a.ptu"
    change(file)
    assert says in refusal(file, Said())


@pytest.mark.skipif(not REAL.is_dir(), reason="needs the real measurements")
def test_a_real_recording(tmp_path: Path) -> None:
    pytest.importorskip("ptufile")
    file = REAL / "hydraharp_cw" / "v30_t2.ptu"
    made = import_files([file], tmp_path / "made", Said(), [importers.light("free")])
    one = back(made)
    channels, times = by_hand(file)
    assert one.events is not None and one.events.ticks is not None
    assert len(one.events) == len(times) == 305_565 and (channels == 0).all() and one.tick == 1e-12
    assert np.array_equal(one.events.ticks, times)
    assert one.conditions.exposure == 5.0 and one.layout.shape == (1, 1)
    assert np.diff(one.events.ticks.astype(np.int64)).min() == 81_134


# --- tables -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "tick"),
    [
        ("pixel,time (ps)\n1,2500\n0,100\n1,30\n", 1e-12),
        ("\ufeffPixel, Time (ns)\r\n1,2.5\r\n0,0.1\r\n1,0.03", 1e-12),
        ("time (s),pixel\n2.5e-9,1\n1e-10,0\n3e-11,1\n", 10e-12),
    ],
)
def test_a_table(tmp_path: Path, text: str, tick: float) -> None:
    (tmp_path / "a.csv").write_text(text, newline="")
    one = back(run(tmp_path / "a.csv", replace(SECOND, tick=None if tick == 1e-12 else tick)))
    assert one.events is not None and one.tick == tick
    assert list(one.events.offsets) == [0, 1, 3]
    np.testing.assert_allclose(one.events.times, [1e-10, 3e-11, 2.5e-9], rtol=1e-9)


def test_a_table_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from spadmnist.importers import table

    rng = np.random.Generator(np.random.Philox(1))
    pixel, time = rng.integers(0, 9, 500), rng.integers(0, 10**12, 500)
    rows = "".join(f"{p},{t}\n" for p, t in zip(pixel, time, strict=True))
    (tmp_path / "a.csv").write_text("pixel,time (ps)\n" + rows)
    monkeypatch.setattr(table, "_AT_ONCE", 100)
    opened = measurement.open(run(tmp_path / "a.csv", replace(SECOND, rows=3, columns=3)).folder)
    one = opened.recording("a")
    assert not opened.notes["a"]  # it was written in order
    assert one.events is not None and one.events.ticks is not None
    order = np.lexsort((time, pixel))
    assert np.array_equal(one.events.ticks, time[order]) and np.array_equal(one.events.pixel, pixel[order])
    (tmp_path / "a.csv").write_text("pixel,time (ps)\n" + rows[:1000].rpartition("\n")[0] + "\n3,-7\n")
    line = rows[:1000].count("\n") + 2
    with pytest.raises(InputError, match=f"a.csv:{line}: "):
        run(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x,y\n1,2\n", "write pixel,time (ps)"),
        ("pixel,time\n1,2\n", "write pixel,time (ps)"),
        ("pixel,time (parsec)\n1,2\n", "'1 parsec' is not a time"),
        ("pixel,time (ps)\n1,2,3\n", "a pixel and a time"),
        ("pixel,time (ps)\n1,two\n", "could not convert"),
        ("pixel,time (ps)\n1.5,2\n", "a.csv:2: 1.5 at 2 ps"),
        ("pixel,time (ps)\n0,1\n1,nan\n", "a.csv:3: 1 at nan ps"),
        ("pixel,time (ps)\n99999999999,2\n", "is no pixel"),
        ("pixel,time (s)\n1,1e9\n", "2^53"),
        ("pixel,time (s)\n1,1.5\n", "outside the exposure"),
        ("pixel,time (ps)\n" + "1" * 5000, "a line of more than"),
        ("pixel,time (ps)\n", "no detection at all"),
        ("\xff\xfe\0", "is no header"),
    ],
)
def test_hostile_tables(tmp_path: Path, text: str, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from spadmnist.importers import table

    monkeypatch.setattr(table, "_AT_ONCE", 2000)
    (tmp_path / "a.csv").write_text(text)
    assert says in refusal(tmp_path / "a.csv")


# --- LinoSPAD2 ----------------------------------------------------------------------------------------------------

LINO = Said(firmware="2212b", timestamps=3, cycle=4e-3)


def words(path: Path, stamps: list[tuple[int, int, int, int]], cycles: int = 2, timestamps: int = 3) -> Path:
    """Raw words with valid ones at (cycle, converter, address, codes)."""
    made = np.zeros((cycles, 65, timestamps), np.uint32)
    filled: dict[tuple[int, int], int] = {}
    for cycle, converter, address, codes in stamps:
        place = filled.get((cycle, converter), 0)
        made[cycle, converter, place] = 1 << 31 | address << 28 | codes
        filled[cycle, converter] = place + 1
    path.write_bytes(made.astype("<u4").tobytes())
    return path


@pytest.mark.parametrize(("firmware", "pixels"), [("2212b", [4 * 5 + 2, 4 * 63 + 3]), ("2212s", [5 + 128, 63 + 192])])
def test_linospad2_codes(tmp_path: Path, firmware: str, pixels: list[int]) -> None:
    """Without a calibration the codes are the ticks. The 65th converter has no pixel."""
    last = 224_000_000 - 1  # codes in 4 ms
    file = words(
        tmp_path / "a.dat", [(0, 5, 2, 281), (1, 5, 2, 7), (1, 63, 3, last), (1, 63, 3, last + 1), (0, 64, 0, 5)]
    )
    made = run(file, replace(LINO, firmware=firmware))
    one = back(made)
    assert one.events is not None and one.events.ticks is not None and one.layout.shape == (1, 256)
    assert list(np.flatnonzero(one.totals)) == pixels
    assert list(one.events.ticks) == [281, 224_000_007, 224_000_000 + last]
    assert one.tick == pytest.approx(2.5e-9 / 140) and one.conditions.exposure == 8e-3
    assert made.took[0].left_out == ("1 time stamps that lie outside their cycle",)


def test_linospad2_calibrated(tmp_path: Path) -> None:
    ends = np.tile(np.linspace(0, 2500, 141)[1:] ** 2 / 2500, (256, 1))
    ends[21] = 0  # not calibrated
    head = "," + ",".join(map(str, range(140)))
    np.savetxt(tmp_path / "TDC_X_#1_2212s.csv", np.c_[np.arange(256), ends], delimiter=",", header=head, comments="")
    offsets = np.arange(256.0) - 7
    np.save(tmp_path / "o.npy", offsets)
    file = words(
        tmp_path / "a.dat", [(0, 5, 0, 3 * 140 + 11), (1, 21, 0, 140 + 69), (0, 0, 0, 0)] + [(1, 9, 1, 200)] * 3
    )
    said = replace(LINO, firmware=None, tdc=tmp_path / "TDC_X_#1_2212s.csv", offsets=tmp_path / "o.npy")
    made = run(file, said)
    one = back(made)
    assert one.events is not None and one.events.ticks is not None and one.tick == 1e-12
    # what daplis does: 2500 ps a clock, then the end of the code, then the offset
    expected = {
        5: 3 * 2500 + ends[5, 11] - 2,
        21: 4e9 + 2500 + 70 * 2500 / 140 + 14,
        73: 4e9 + 2500 + ends[73, 60] + 66,
    }
    assert sorted(expected) == list(np.flatnonzero(one.totals)) and one.totals[73] == 3
    for pixel, time in expected.items():
        assert one.events.row(pixel)[0] == pytest.approx(round(time) * 1e-12, rel=1e-12)
    # the first word of pixel 0 falls 7 ps before its cycle, but for the end of its code; a converter was full
    assert made.took[0].left_out and any(n.count("1 of 128 times") for n in made.notes)


# (a word, the pixel by line 5 in the firmwares 2212b, 2212s and 2208, codes): bits 31 | 30 | 29 28 | 27 to 0
LINO_WORDS = [
    (0b1_0_00_0000000000000000000000000000, (20, 5, 5), 0),
    (0b1_0_01_0000000000000000000010001011, (21, 69, 5), 139),
    (0b1_0_10_0000000000000000000010001100, (22, 133, 5), 140),
    (0b1_0_11_1111111111111111111111111111, (23, 197, 5), 2**28 - 1),
    (0b1_1_01_0000000000000000000100011001, (21, 69, 5), 281),  # bit 30 is not used
    (0b0_0_11_0000000000000000000000000111, None, 0),  # not valid
    (0b0_1_00_1111111111111111111111111111, None, 0),
]


@pytest.mark.parametrize(("firmware", "lines"), [("2212b", 65), ("2212s", 65), ("2208", 256)])
@pytest.mark.parametrize("calibrated", [False, True])
def test_linospad2_word_by_word(tmp_path: Path, firmware: str, lines: int, calibrated: bool) -> None:
    """As the public readers decode them, one word after the other."""
    which = ("2212b", "2212s", "2208").index(firmware)
    timestamps, cycles, cycle = len(LINO_WORDS), 3, 4.8e-3  # 268,800,000 codes
    stored = [0] * (cycles * lines * timestamps)
    for c in range(cycles):
        at = (c * lines + 5) * timestamps
        stored[at : at + timestamps] = [word for word, _, _ in LINO_WORDS]
    stored[64 * timestamps] = 1 << 31 | 7  # no pixel in 2212
    (tmp_path / "a.dat").write_bytes(struct.pack(f"<{len(stored)}I", *stored))
    ends = np.linspace(0, 2500, 141)[1:] + np.sin(np.arange(256))[:, None]
    ends[:, -1] = 2500
    head = "," + ",".join(map(str, range(140)))
    np.savetxt(tmp_path / "t.csv", np.c_[np.arange(256), ends.clip(0)], delimiter=",", header=head, comments="")

    def seconds(pixel: int, codes: int) -> float:
        if calibrated:
            return ((codes - codes % 140) * 2500 / 140 + float(ends[pixel, codes % 140])) * 1e-12
        return codes * 2.5e-9 / 140

    expected = [(64, seconds(64, 7))] if firmware == "2208" else []
    for c in range(cycles):
        for _, pixels, codes in LINO_WORDS:
            if pixels:
                expected.append((pixels[which], c * cycle + seconds(pixels[which], codes)))
    said = Said(firmware=firmware, timestamps=timestamps, cycle=cycle, tdc=tmp_path / "t.csv" if calibrated else None)
    made = run(tmp_path / "a.dat", said)
    listed = "tdc: {resolution: 17.857142857142858 ps, rounding: floor}"
    assert calibrated != any(listed in note for note in made.notes)
    events = back(made).events
    assert events is not None and events.tick == pytest.approx(1e-12 if calibrated else 17.857142857e-12, rel=1e-10)
    found = sorted(zip(map(int, events.pixel), map(float, events.times), strict=True))
    assert [pixel for pixel, _ in found] == [pixel for pixel, _ in sorted(expected)]
    assert np.abs(np.subtract(found, sorted(expected))[:, 1]).max() < 0.51e-12


def calibration(path: Path, ends: np.ndarray) -> Path:
    head = "," + ",".join(map(str, range(140)))
    np.savetxt(path, np.c_[np.arange(256), ends], delimiter=",", header=head, comments="")
    return path


def test_linospad2_calibrations(tmp_path: Path) -> None:
    """Read as it stands there now; pixels without one are told; the firmware in its name is not contradicted."""
    file = words(tmp_path / "a.dat", [(0, 5, 0, 140 + 70)])
    ends = np.linspace(0, 2500, 141)[1:] * np.ones((256, 1))
    for n, factor in enumerate((0.9, 0.5)):
        table = calibration(tmp_path / "t.csv", ends * factor)
        made = import_files([file], tmp_path / str(n), replace(LINO, tdc=table), DARK)
        one = back(made)
        assert one.events is not None and one.events.times[0] * 1e12 == pytest.approx(
            2500 + ends[0, 70] * factor, abs=1
        )
        assert not any("not calibrated" in note for note in made.notes)
    ends[:3] = 0
    table = calibration(tmp_path / "t.csv", ends)
    made = import_files([file], tmp_path / "some", replace(LINO, tdc=table), DARK)
    assert any("3 pixels are not calibrated by --tdc; their codes are taken as equally long" in n for n in made.notes)
    named = calibration(tmp_path / "TDC_NL11_#33_2212s.csv", ends)
    assert "is of the firmware 2212s by its name, not of 2212b" in refusal(file, replace(LINO, tdc=named))
    made = import_files([file], tmp_path / "named", replace(LINO, tdc=named, firmware=None), DARK)
    assert np.flatnonzero(back(made).totals).tolist() == [5]


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e9, -1e300])
def test_linospad2_offsets_that_are_none(tmp_path: Path, wrong: float) -> None:
    file = words(tmp_path / "a.dat", [(0, 5, 0, 140 + 70)])
    table = calibration(tmp_path / "t.csv", np.linspace(0, 2500, 141)[1:] * np.ones((256, 1)))
    np.save(tmp_path / "o.npy", np.where(np.arange(256) == 7, wrong, 0.0))
    said = replace(LINO, tdc=table, offsets=tmp_path / "o.npy")
    assert "offsets are 256 numbers in ps, each less than 1 ms" in refusal(file, said)


def test_linospad2_cycles_that_are_too_long(tmp_path: Path) -> None:
    file = words(tmp_path / "a.dat", [(0, 5, 0, 7)])
    for cycle in (1e9, 1e18):
        assert "than can be counted; give another --cycle or --tick" in refusal(file, replace(LINO, cycle=cycle))


def test_linospad2_asks(tmp_path: Path) -> None:
    file = words(tmp_path / "a.dat", [])
    said = refusal(file, Said(), [])
    assert all(option in said for option in ("--firmware", "--timestamps", "--cycle"))
    assert "no whole cycles" in refusal(file, replace(LINO, timestamps=7))
    assert "no whole number of ticks" in refusal(file, replace(LINO, cycle=1e-3 + 1e-10))
    assert "--tdc" in refusal(file, replace(LINO, offsets=tmp_path / "o.npy"))
    (tmp_path / "bad.csv").write_text("x\n1,2\n")
    assert "no calibration" in refusal(file, replace(LINO, tdc=tmp_path / "bad.csv"))


@pytest.mark.skipif(not REAL.is_dir(), reason="needs the real measurements")
def test_real_calibrations_of_linospad2(tmp_path: Path) -> None:
    tables = sorted((REAL / "linospad2_tdc").glob("TDC_*.csv"))
    assert tables
    file = words(tmp_path / "a.dat", [(0, k, k % 4, 140 * 1_000_000 + 7 * k) for k in range(64)], 1)
    for i, table in enumerate(tables):
        firmware = "2212b" if "2212b" in table.name else "2212s"
        offsets = table.with_name(table.name.replace("TDC", "Offset").replace(".csv", ".npy"))
        said = Said(timestamps=3, cycle=4e-3, tdc=table, offsets=offsets if offsets.exists() else None)
        one = back(import_files([file], tmp_path / str(i), said, DARK))
        assert one.events is not None and len(one.events) == 64
        at = 2.5e-3 + 0.0
        assert (np.abs(one.events.times - at) < 20e-9).all() and firmware in table.name


# --- frames -------------------------------------------------------------------------------------------------------


STACKS = ["a.npy", "a.npz", "a.tif", "a.h5"]
DEEP = {"a.h5": {"dataset": "deep/er/stack"}}


@pytest.mark.parametrize("name", STACKS)
@pytest.mark.parametrize("kind", [bool, np.uint8, ">i2"])
def test_stacks_of_bits(tmp_path: Path, name: str, kind: Any) -> None:
    if name == "a.tif" and kind is bool:
        kind = np.uint16
    array = bits()
    one = back(run(save(tmp_path / name, array.astype(kind)), replace(CLOCK, **DEEP.get(name, {}))))
    assert one.modality == "qis" and one.layout.shape == (3, 11) and one.frames is not None
    assert np.array_equal(one.frames[:], np.packbits(array, axis=2))
    assert one.conditions == Conditions(20 * 12e-6, 20, 10e-6, 12e-6, None)


@pytest.mark.parametrize("name", STACKS)
def test_stacks_of_counts_and_stamps(tmp_path: Path, name: str) -> None:
    said = replace(CLOCK, **DEEP.get(name, {}))
    array = np.random.Generator(np.random.Philox(2)).integers(0, 16, (6, 4, 5)).astype(np.uint16)
    file = save(tmp_path / name, array)
    text = refusal(file, said)
    assert "--bits" in text and "--modality str" in text and "--packed" in text
    one = back(run(file, replace(said, bits=4, frames=6 * 15)))
    assert one.modality == "counts" and one.frames is not None and np.array_equal(one.frames[:], array)
    assert one.conditions.frames == 90 and one.conditions.counting == "frames" and one.conditions.bits == 4
    other = import_files([file], tmp_path / "counter", replace(said, bits=12, counting="counter"), DARK)
    assert other.captures[0].conditions.frames == 6 and back(other).totals.sum() == array.sum()
    stamps = import_files([file], tmp_path / "str", replace(said, modality="str", tick=10e-6 / 16), DARK)
    assert (back(stamps).none, back(stamps).tick) == (16, 10e-6 / 16)
    assert np.array_equal(back(stamps).frames[:], array)  # type: ignore[index]


@pytest.mark.parametrize("order", ["big", "little"])
def test_packed_npy_and_raw_frames(tmp_path: Path, order: str) -> None:
    array = bits(5, 4, 16)
    packed = np.packbits(array, axis=2, bitorder=order)  # type: ignore[call-overload]
    np.save(tmp_path / "a.npy", packed)
    said = replace(CLOCK, bit_order=order)
    one = back(import_files([tmp_path / "a.npy"], tmp_path / "npy", replace(said, packed=True), DARK))
    for i, tail in enumerate((b"", b"DONE")):
        (tmp_path / "a.bin").write_bytes(packed.tobytes() + tail)
        two = back(import_files([tmp_path / "a.bin"], tmp_path / f"raw{i}", replace(said, rows=4, columns=16), DARK))
        for each in (one, two):
            assert each.layout.shape == (4, 16) and each.modality == "qis" and each.frames is not None
            assert np.array_equal(each.frames[:], np.packbits(array, axis=2))


def test_columns_that_fill_no_byte(tmp_path: Path) -> None:
    array = bits()
    np.save(tmp_path / "a.npy", np.packbits(array, axis=2))
    said = replace(CLOCK, packed=True)
    one = back(run(tmp_path / "a.npy", replace(said, columns=11)))
    assert one.layout.shape == (3, 11) and one.totals.sum() == array.sum()
    np.save(tmp_path / "a.npy", np.packbits(np.ones((2, 3, 12), bool), axis=2))
    with pytest.raises(InputError, match="bits beyond the 11 columns"):
        import_files([tmp_path / "a.npy"], tmp_path / "b", replace(said, columns=11), DARK)


def test_a_raw_file_of_a_spad512(tmp_path: Path) -> None:
    frame = np.zeros((2, 512, 512), bool)
    frame[0, 3, 500] = frame[1, 511, 0] = True
    (tmp_path / "RAW00000.bin").write_bytes(np.packbits(frame, axis=2).tobytes())
    one = back(run(tmp_path / "RAW00000.bin", CLOCK))
    assert list(np.flatnonzero(one.totals)) == [3 * 512 + 500, 511 * 512]


@pytest.mark.parametrize(
    ("name", "change", "said", "says"),
    [
        ("a.npy", lambda p: np.save(p, np.array([{}], object)), CLOCK, "holds Python objects"),
        ("a.npy", lambda p: np.save(p, np.full((2, 3, 4), 0.5)), replace(CLOCK, bits=3), "on hold 0.5"),
        ("a.npy", lambda p: np.save(p, np.full((2, 3, 4), np.nan)), replace(CLOCK, bits=3), "on hold nan"),
        ("a.npy", lambda p: np.save(p, np.zeros((2, 3, 4), complex)), CLOCK, "complex128"),
        ("a.npy", lambda p: np.save(p, np.zeros((2, 3))), CLOCK, "(frames, rows, columns)"),
        ("a.npy", lambda p: np.save(p, np.asfortranarray(bits())), replace(CLOCK, packed=True), "Fortran"),
        ("a.npy", lambda p: p.write_bytes(save(p, bits()).read_bytes()[:-1]), CLOCK, "damaged or cut short"),
        ("a.npy", lambda p: p.write_bytes(save(p, bits()).read_bytes() + b"1"), CLOCK, "longer than"),
        ("a.npy", lambda p: p.write_bytes(b"\x93NUMPY\1\0\x10\0" + b"(" * 16), CLOCK, "damaged"),
        ("a.npy", lambda p: p.write_bytes(huge_npy()), CLOCK, "damaged or cut short"),
        ("a.npy", lambda p: p.write_bytes(b"\x89PNG\r\n\x1a\n"), CLOCK, "this is a PNG image"),
        ("a.npy", lambda p: np.save(p, np.full((2, 3, 4), -1)), CLOCK, "numbers other than 0 and 1"),
        ("a.npy", lambda p: np.save(p, np.full((2, 3, 4), -1)), replace(CLOCK, bits=3), "on hold -1"),
        ("a.npy", lambda p: np.save(p, np.full((2, 3, 4), 9)), replace(CLOCK, bits=3), "on hold 9"),
        ("a.npy", lambda p: np.save(p, np.zeros((0, 3, 4), bool)), CLOCK, "holds no frame"),
        ("a.npy", lambda p: save(p, bits()), replace(CLOCK, rows=4), "not 4 x 11 pixels"),
        ("a.npy", lambda p: save(p, bits()), replace(CLOCK, frames=7), "holds 20 frames"),
        ("a.npy", lambda p: save(p, bits()), replace(CLOCK, modality="tr"), "holds frames, and no tr"),
        ("a.npy", lambda p: save(p, bits()), replace(CLOCK, frame_time=1.0), "does not fit into the frame period"),
        ("a.npy", lambda p: save(p, bits()), Said(), "add --frame-time"),
        ("a.npz", lambda p: p.write_bytes(save(p, bits()).read_bytes()[:-30]), CLOCK, "damaged"),
        ("a.npz", lambda p: np.savez(p, x=1), CLOCK, "holds x; it needs"),
        ("a.npz", lambda p: np.savez(p, frames=np.array([{}])), CLOCK, "not plain numbers"),
        ("a.npz", lambda p: np.savez(p, frames=bits(), exposure=-1), CLOCK, "its exposure is -1"),
        ("a.npz", lambda p: npz_bomb(p), CLOCK, "declares"),
        ("a.tif", lambda p: p.write_bytes(b"II*\0" + bytes(50)), CLOCK, "damaged"),
        ("a.tif", lambda p: p.write_bytes(save(p, bits().astype(np.uint8)).read_bytes()[:300]), CLOCK, "damaged"),
        ("a.tif", lambda p: save(p, np.full((2, 3, 4), 0.5, np.float32)), replace(CLOCK, bits=3), "on hold 0.5"),
        ("a.bin", lambda p: p.write_bytes(bytes(1000)), CLOCK, "no whole frames of 512 x 512 bits"),
        ("a.bin", lambda p: p.write_bytes(bytes(1000)), replace(CLOCK, columns=12), "multiple of 8"),
        ("a.xyz", lambda p: p.write_bytes(b"hello"), CLOCK, "what can be imported is"),
    ],
)
def test_hostile_frames(tmp_path: Path, name: str, change: Callable[[Path], Any], said: Said, says: str) -> None:
    file = tmp_path / name
    if name == "a.tif":
        pytest.importorskip("tifffile")
    change(file)
    assert says in refusal(file, said)


def huge_npy() -> bytes:
    stream = io.BytesIO()
    header = {"descr": "|u1", "fortran_order": False, "shape": (10**9, 512, 512)}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue() + bytes(100)


def npz_bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("frames.npy", huge_npy() + bytes(1000))


def test_a_folder_a_pipe_and_nothing(tmp_path: Path) -> None:
    assert "is no file" in refusal(tmp_path)
    os.mkfifo(tmp_path / "a.npy")
    assert "is no file" in refusal(tmp_path / "a.npy")
    assert "no such file" in refusal(tmp_path / "b.npy")


@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak from /proc")
def test_memory_is_flat(tmp_path: Path) -> None:
    """A stack of 260 MB is read with a small part of it in memory."""
    with open(tmp_path / "a.npy", "wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": (1000, 512, 512)})
        file.truncate(file.tell() + 1000 * 512 * 512)  # zeros, without taking room
    script = f"""
import resource, sys
from pathlib import Path
from spadmnist.importers import Said, light
from spadmnist.importers.captures import import_files
import h5py
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
said = Said(frame_time=1e-5, frame_period=1e-5)
import_files([Path({str(tmp_path / "a.npy")!r})], Path({str(tmp_path / "made")!r}), said, [light("dark")])
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 120, done.stdout


# --- HDF5 ---------------------------------------------------------------------------------------------------------


def test_photon_hdf5(tmp_path: Path) -> None:
    one = back(run(photon_hdf5(tmp_path / "a.hdf5", {"photon_data": ([5, 7, 9], [3, 1, 3])}), Said()))
    assert one.events is not None and one.events.ticks is not None and one.tick == 1e-8
    assert list(one.events.ticks) == [7, 5, 9] and list(one.totals) == [1, 2] and one.conditions.exposure == 0.5


def test_photon_hdf5_of_several_spots(tmp_path: Path) -> None:
    groups = {f"photon_data{spot}": ([spot, 20], None) for spot in range(11)}
    groups["photon_data3"] = ([], None)
    one = back(run(photon_hdf5(tmp_path / "a.hdf5", groups), Said()))
    assert one.layout.shape == (1, 11) and list(one.totals) == [2] * 3 + [0] + [2] * 7
    assert one.events is not None and one.events.row(10)[0] == 10 * 1e-8


def hdf5(path: Path, **sets: Any) -> None:
    with h5py.File(path, "w") as file:
        for name, value in sets.items():
            file[name] = value


def external(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", (1, 4, 4), np.uint8, external=[("/etc/hostname", 0, 16)])


def virtual(path: Path) -> None:
    hdf5(path.with_name("other.h5"), frames=bits())
    layout = h5py.VirtualLayout((20, 3, 11), bool)
    layout[:] = h5py.VirtualSource(path.with_name("other.h5"), "frames", (20, 3, 11))
    with h5py.File(path, "w") as file:
        file.create_virtual_dataset("frames", layout)


def linked(path: Path) -> None:
    """A link in the middle of a path."""
    photon_hdf5(path.with_name("other.h5"), {"photon_data": ([1], [0])})
    with h5py.File(path, "w") as file:
        file["photon_data"] = h5py.ExternalLink(str(path.with_name("other.h5")), "/photon_data")


def declared(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", (10**6, 512, 512), np.uint8, chunks=(1, 512, 512))


def chunked(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", (2000, 512, 1024), np.uint8, chunks=(2000, 512, 1024), compression=1)


@pytest.mark.parametrize(
    ("change", "said", "says"),
    [
        (external, CLOCK, "lie in another file"),
        (virtual, CLOCK, "lie in another file"),
        (linked, SECOND, "a link to somewhere else"),
        (declared, CLOCK, "not all of them were written"),
        (chunked, CLOCK, "in larger parts than can be read"),
        (lambda p: hdf5(p, x=1), CLOCK, "there is x (--dataset"),
        (lambda p: hdf5(p, frames=[1.5]), CLOCK, "store whole numbers"),
        (lambda p: hdf5(p, frames=bits()), replace(CLOCK, dataset="/frames/x"), "has no data set /frames/x"),
        (lambda p: hdf5(p, time=[1, 2], pixel=[0]), replace(SECOND, tick=1e-9), "2 times and 1 pixels"),
        (lambda p: hdf5(p, time=[1, 2], pixel=[0, -1]), replace(SECOND, tick=1e-9), "channels are 0 to"),
        (lambda p: hdf5(p, time=[1, -2], pixel=[0, 1]), replace(SECOND, tick=1e-9), "outside the exposure"),
        (lambda p: hdf5(p, time=[1, 2], pixel=[0, 1]), SECOND, "add --tick"),
        (lambda p: photon_hdf5(p, {"photon_data": ([1], [0])}, unit=np.nan), SECOND, "its tick is nan"),
        (lambda p: photon_hdf5(p, {"photon_data": ([10**8], [0])}), Said(), "--exposure"),
        (lambda p: p.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(1000)), CLOCK, "damaged"),
    ],
)
def test_hostile_hdf5(tmp_path: Path, change: Callable[[Path], Any], said: Said, says: str) -> None:
    change(tmp_path / "a.h5")
    assert says in refusal(tmp_path / "a.h5", said)


# --- what must be asked, how it is said ---------------------------------------------------------------------------


def test_what_no_file_says_is_asked_for_in_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("pixel,time (ps)\n0,1\n")
    said = refusal(tmp_path / "a.csv", Said(), ())
    assert said.count("--") == 2 and '--exposure "100 ms"' in said and "--light dark" in said


@pytest.mark.parametrize(
    ("text", "light"),
    [
        ("dark", Light()),
        ("free", Light(555e-9)),
        ("500 nm free", Light(500e-9)),
        ("0.5um", Light(500e-9)),
        ("500 nm 75.67 nW/cm^2", Light(500e-9, 75.67e-5, "irradiance", 0.05)),
        ("75.67nW/cm^2 500nm", Light(500e-9, 75.67e-5, "irradiance", 0.05)),
        ("5 mlux", Light(555e-9, 5e-3, "lux", 0.05)),
        ("600 nm 5e-3 lux", Light(600e-9, 5e-3, "lux", 0.05)),
    ],
)
def test_light(text: str, light: Light) -> None:
    assert importers.light(text) == light


@pytest.mark.parametrize(
    "text",
    ["", "bright", "5", "500", "dark 5 lux", "-5 lux", "1 W/m^2", "500 nm 400 nm", "1 lux free", "500 nm 3 lux 4 lux"],
)
def test_what_is_no_light(text: str) -> None:
    with pytest.raises(SpadError, match=r"--light: .*write dark, free"):
        importers.light(text)


def test_lights_and_uncertainty(tmp_path: Path) -> None:
    files = [save(tmp_path / name, bits()) for name in ("a.npy", "b.npy", "c.npy")]
    assert "2 for 3 files" in refusal(files, CLOCK, DARK * 2)
    made = run(files, replace(CLOCK, relative_uncertainty=0.015), [importers.light("500 nm 5 lux")])
    assert [capture.light for capture in made.captures] == [Light(500e-9, 5.0, "lux", 0.015)] * 3


def test_names_are_safe_and_unlike(tmp_path: Path) -> None:
    paths = [
        tmp_path / folder / name
        for folder, name in (("x", "a/../b.npy"), ("x", "B.npy"), ("y", "b.npy"), ("x", "##.npy"))
    ]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        (path.parent / ".." / "b.npy").parent.mkdir(exist_ok=True)
        save(path, bits())
    made = import_files(paths, tmp_path / "made", CLOCK, DARK)
    assert [capture.id for capture in made.captures] == ["b", "B-2", "b-3", "capture"]
    assert len(measurement.open(tmp_path / "made").captures) == 4


def test_other_pixels_are_refused(tmp_path: Path) -> None:
    files = [save(tmp_path / "a.npy", bits()), save(tmp_path / "b.npy", bits(columns=12))]
    assert "has 3 x 12 pixels, others 3 x 11" in refusal(files, CLOCK)


def test_places_of_pixels(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("x,y\n0,0\n23,0\n11.5,20\n")
    (tmp_path / "a.csv").write_text("pixel,time (ps)\n2,5\n")
    one = back(run(tmp_path / "a.csv", replace(SECOND, positions=tmp_path / "p.csv")))
    assert list(one.totals) == [0, 0, 1] and one.layout.positions is not None
    said = replace(CLOCK, positions=tmp_path / "p.csv")
    with pytest.raises(InputError, match="names 3 pixels"):
        import_files([save(tmp_path / "b.npy", bits())], tmp_path / "other", said, DARK)


def test_every_kind_is_told_of(tmp_path: Path) -> None:
    """The help is prose; a kind that it leaves out is found here."""
    told = " ".join(CliRunner().invoke(cli.cli, ["import", "--help"]).output.split())
    for kind in importers.formats():
        assert kind.about.removeprefix("NumPy ") in told, kind.about
        assert (kind.__doc__ or "").strip()
    (choice,) = (p.type for p in cli.cli.commands["export"].params if p.name == "format_")
    every = {*exporters.Target.every, *image_exporters.ImageTarget.every}
    assert sorted(choice.choices) == sorted(every)  # type: ignore[attr-defined]


def test_a_new_kind_is_one_class(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importers.Format, "every", list(importers.Format.every))
    importers.formats()

    class Own(importers.Format):
        """One detection a byte."""

        about, ends = "own", (".own",)

        @classmethod
        def read(cls, path: Path, said: Said) -> importers.Found:
            times = np.frombuffer(path.read_bytes(), np.uint8)
            return importers.Found({"tick": 1e-9}, Detections.of(path, np.zeros(len(times), np.uint8), times))

    (tmp_path / "a.own").write_bytes(b"cab")
    one = back(run(tmp_path / "a.own"))
    assert one.events is not None and list(one.events.ticks) == [97, 98, 99]  # type: ignore[arg-type]


# --- there and back -----------------------------------------------------------------------------------------------


def recorded(modality: str) -> Recording:
    """A small capture with awkward numbers: 3 x 11 pixels, light that was calibrated, awkward times."""
    rng = np.random.Generator(np.random.Philox(3))
    layout = Layout(3, 11, np.nan, np.nan)
    lit = Light(512.3e-9, 1.234567890123e-3, "irradiance", 0.015, 0.003)
    if modality == "tr":
        exposure = 0.1 / 3
        counts = rng.integers(0, 9, 33)
        counts[-1] = 0
        offsets = np.concatenate([[0], np.cumsum(counts)])
        ticks = np.concatenate([np.sort(rng.integers(0, int(exposure / 3.7e-12), n)) for n in counts]).astype(np.uint64)
        capture = Capture("one", "tr", lit, Conditions(exposure, 1, exposure, exposure, lit.wavelength))
        return Recording(capture, layout, Events(None, offsets, 33, ticks, 3.7e-12, end=exposure), None, 3.7e-12)
    clock = Conditions(90 * 1.3e-5, 90, 1.1e-5, 1.3e-5, lit.wavelength)
    if modality == "counts":
        clock = replace(clock, bits=4)
        frames = rng.integers(0, 16, (6, 3, 11)).astype(np.uint8)
        return Recording(Capture("one", modality, replace(lit, kind_of_level="lux"), clock), layout, None, frames)
    if modality == "qis":
        return Recording(Capture("one", modality, Light(), replace(clock, wavelength=None)), layout, None,
                         np.packbits(rng.random((90, 3, 11)) < 0.3, axis=2))  # fmt: skip
    one = Recording(Capture("one", modality, replace(lit, level=None), clock), layout, tick=3.3e-10)
    frames = np.minimum(rng.integers(0, 2 * one.none, (90, 3, 11)), one.none).astype(np.uint32)
    return replace(one, frames=frames)


def same(one: Recording, two: Recording) -> None:
    assert (one.capture, one.layout.shape, one.tick) == (two.capture, two.layout.shape, two.tick)
    if one.events is not None and two.events is not None:
        assert np.array_equal(one.events.ticks, two.events.ticks)  # type: ignore[arg-type]
        assert np.array_equal(one.events.offsets, two.events.offsets)
    else:
        assert np.array_equal(one.frames[:], two.frames[:])  # type: ignore[index]


CHOICES = [(name, m) for name, target in exporters.Target.every.items() for m in target.modalities]


@pytest.mark.parametrize(("format", "modality"), CHOICES)
def test_there_and_back(tmp_path: Path, format: str, modality: str) -> None:
    one = recorded(modality)
    measurement.write(tmp_path / "m", "m", one.layout, [one])
    opened = measurement.open(tmp_path / "m")
    same(opened.recording("one"), one)
    (path,) = exporters.export(opened, tmp_path / "out", format)
    said, lights = Said(), []
    if format == "npy":  # which says nothing of how it was recorded
        c = one.conditions
        said = Said(
            frames=len(one.frames[:]), frame_time=c.frame_time, frame_period=c.frame_period, columns=11, tick=one.tick
        )
        said = replace(said, packed=modality == "qis", bits=c.bits or None, modality=modality)
        lights = [one.capture.light]
    made = import_files([path], tmp_path / "back", said, lights)
    same(back(made), one)


def photons(tmp_path: Path) -> Path:
    one = recorded("tr")
    measurement.write(tmp_path / "m", "m", one.layout, [one])
    return exporters.export(measurement.open(tmp_path / "m"), tmp_path / "a.hdf5", "photon-hdf5")[0]


def test_a_photon_hdf5_file(tmp_path: Path) -> None:
    with h5py.File(photons(tmp_path)) as file:
        assert (np.diff(file["photon_data/timestamps"][:]) >= 0).all() and len(file["photon_data/detectors"])
        assert file["setup/num_pixels"][()] == 33 and file["identity/format_version"][()] == b"0.5"
        assert file["acquisition_duration"][()] == 0.1 / 3


@pytest.mark.slow
def test_a_photon_hdf5_file_is_valid(tmp_path: Path) -> None:
    """By the checks of the format's own package (which takes seconds to import)."""
    pytest.importorskip("phconvert")
    check = f"assert_valid_photon_hdf5({str(photons(tmp_path))!r}, require_rootformat=True)"
    script = f"from phconvert.hdf5 import *; {check}"
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_what_is_exported_is_plain(tmp_path: Path) -> None:
    """Numpy alone reads it, and the same capture gives the same bytes."""
    one = recorded("qis")
    measurement.write(tmp_path / "m", "m", one.layout, [one])
    opened = measurement.open(tmp_path / "m")
    for format in ("npy", "npz", "hdf5"):
        (a,), (b,) = (exporters.export(opened, tmp_path / name, format) for name in "ab")
        assert a.read_bytes() == b.read_bytes()
    array = np.load(tmp_path / "a" / "one.npy")
    assert np.unpackbits(array, axis=2, count=11).shape == (90, 3, 11)
    archive = np.load(tmp_path / "a" / "one.npz")
    assert np.array_equal(archive["frames"], array) and archive["frame_time"] == 1.1e-5
    with h5py.File(tmp_path / "a" / "one.h5") as file:
        assert np.array_equal(file["frames"], array) and file.attrs["frame_time"] == 1.1e-5


def test_an_export_has_each_capture_once_and_ends_as_its_format_does(tmp_path: Path) -> None:
    layout = sp.Layout(2, 2, 25e-12, 1.0)
    sensor = sp.Sensor(layout, [sp.effects.DarkCounts(rate=1e4), sp.effects.Tdc(resolution=1e-9)])
    data = sp.simulate(sensor, [sp.Capture("dark", "tr", dark=True, exposure=1e-3)], seed=1)
    assert [path.name for path in exporters.export(data, tmp_path / "out", "npz", ("dark", "dark"))] == ["dark.npz"]
    with pytest.raises(
        SpadError, match=r"x\.hdf5 ends as files of the format photon-hdf5 do; those of hdf5 end with \.h5"
    ):
        exporters.export(data, tmp_path / "x.hdf5", "hdf5")
    coarse = sp.Sensor(layout, [sp.effects.DarkCounts(rate=2e7), sp.effects.Tdc(resolution=100e-9)])
    many = sp.simulate(coarse, [sp.Capture("dark", "tr", dark=True, exposure=1e-3)], seed=1)
    # several detections of a pixel in a tick, as where a tick is longer than the dead time: the file is read again
    assert len(many["dark"].events) > 4 * 10_000  # more than ticks
    many.save(tmp_path / "lab")
    again = measurement.open(tmp_path / "lab")
    assert np.array_equal(again.recording("dark").totals, many.recording("dark").totals)
    for capture in (
        sp.Capture("f", "str", dark=True, frames=10, frame_time=10e-9),
        sp.Capture("f", "tr", dark=True, exposure=10e-9),
    ):
        with pytest.raises(SpadError, match=r"f: the ticks of the sensor, 100 ns, are longer than the 10 ns that they"):
            sp.simulate(coarse, [capture], seed=1)


def test_what_cannot_be_exported(tmp_path: Path) -> None:
    ones = [recorded("tr"), replace(recorded("qis"), capture=replace(recorded("qis").capture, id="two"))]
    measurement.write(tmp_path / "m", "m", ones[0].layout, ones)
    opened = measurement.open(tmp_path / "m")
    for out, format, ids, says in [
        ("a.npz", "npz", (), "holds one capture; choose it with --capture (one, two)"),
        ("a", "npy", (), "one is tr, which npy cannot hold; take one of"),
        ("a", "photon-hdf5", ("two",), "two is qis, which photon-hdf5 cannot hold"),
        ("a", "npz", ("three",), "has no capture 'three'"),
    ]:
        with pytest.raises(SpadError) as caught:
            exporters.export(opened, tmp_path / out, format, ids)
        assert says in str(caught.value) and not (tmp_path / out).exists()
    assert [path.name for path in exporters.export(opened, tmp_path / "a", "npz")] == ["one.npz", "two.npz"]
    with pytest.raises(SpadError, match="is there already"):
        exporters.export(opened, tmp_path / "a", "npz")


@pytest.mark.parametrize(("format", "modality"), CHOICES)
def test_progress_reaches_its_end(tmp_path: Path, format: str, modality: str) -> None:
    """Of an import and of an export, which tell it piece by piece."""
    totals: list[float] = []
    steps: list[float] = []
    progress = Progress(
        lambda what, total, done: totals.append(total), lambda work, note: steps.append(work), lambda: None
    )
    one = recorded(modality)
    measurement.write(tmp_path / "m", "m", one.layout, [one])
    (path,) = exporters.export(measurement.open(tmp_path / "m"), tmp_path / "out", format, (), progress)
    extra = 1 / one.n_frames if format in ("npy", "npz") and one.frames is not None else 0.0  # for the type of the data
    assert totals == [1] and sum(steps) == pytest.approx(1 + extra)
    if format == "hdf5":
        totals.clear(), steps.clear()
        run(path, Said(), [], progress=progress)
        assert totals == [2 * path.stat().st_size] and sum(steps) == pytest.approx(totals[0]) and len(steps) >= 2


# --- the verbs ----------------------------------------------------------------------------------------------------


def test_the_verbs(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def spadmnist(*arguments: Any) -> tuple[int, str, str]:
        status = cli._run([str(one) for one in arguments])
        return status, *capsys.readouterr()

    file, lab = tmp_path / "a.csv", tmp_path / "m"
    file.write_text("pixel,time (ns)\n0,1\n3,2\n")
    given = ["--exposure", "1 ms", "--light", "5 mlux", "--relative-uncertainty", "1.5 %", "--tick", "10 ps"]
    status, told, said = spadmnist("import", file, "-o", lab, *given, "--json")
    assert status == 0, said
    found = json.loads(told)
    (taken,) = found["captures"]
    assert (taken["id"], taken["modality"], taken["detections"], taken["tick"]) == ("a", "tr", 2, 1e-11)
    assert "0, 3 are the pixels" in found["notes"][0]
    opened = measurement.open(lab)
    assert opened.captures[0].light == Light(555e-9, 5e-3, "lux", 0.015) and opened.recording("a").tick == 1e-11
    status, told, said = spadmnist(
        "export", lab, "-o", tmp_path / "b.hdf5", "--format", "photon-hdf5", "--capture", "a"
    )
    assert (status, told.strip()) == (0, str(tmp_path / "b.hdf5")), said
    steps: list[float] = []
    progress = Progress(advance=lambda work, note: steps.append(work))
    monkeypatch.setattr(_terminal, "progress", lambda: contextlib.nullcontext(progress))
    assert spadmnist("export", lab, "-o", tmp_path / "c", "--format", "npz")[0] == 0 and steps == [1]
    for wrong in (["--exposure", "1"], ["--exposure", "-1 ms"], ["--light", "blue"], []):
        status, told, said = spadmnist("import", file, "-o", tmp_path / "n", *wrong)
        assert status == 2 and not told and said.startswith("Error: ") and said.count("\n") == 1


def test_a_refusal_leaves_nothing_of_its_own(tmp_path: Path) -> None:
    """The second file is refused as it is read: what the first one made goes again, what was there stays."""
    good, bad = bits(), bits().astype(np.uint8)
    bad[15] = 7
    files = [save(tmp_path / "a.npy", good), save(tmp_path / "b.npy", bad)]
    said = replace(CLOCK, modality="qis")
    assert "on hold 7" in refusal(files, said)
    assert not (tmp_path / "made").exists()
    (tmp_path / "made").mkdir()
    assert "on hold 7" in refusal(files, said)
    assert list((tmp_path / "made").iterdir()) == []
    save(files[1], good)
    kept = run(files, said).folder
    (kept / "measurement.yaml").unlink()  # as if it had been stopped before the end
    (kept / "b.h5").unlink()
    save(files[1], bad)
    assert "on hold 7" in refusal(files, said)
    assert [path.name for path in kept.iterdir()] == ["a.h5"]


def packbits(data: bytes) -> bytes:
    """Every run of one byte as what repeats it, 128 times at most."""
    return b"".join(
        bytes([257 - len(run), run[0]]) if len(run) > 1 else bytes([0, run[0]])
        for k in range(0, len(data), 128)
        for run in [data[k : k + 128]]
    )


@pytest.mark.parametrize("codec", ["deflate", "lzma", "packbits"])
def test_a_page_that_unpacks_to_more_than_it_has(codec: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever packs it, as far as tifffile unpacks it without being told how much there is."""
    pytest.importorskip("tifffile")
    number, pack = {
        "deflate": (8, zlib.compress),
        "lzma": (34925, lzma.compress),
        "packbits": (32773, packbits),
    }[codec]
    monkeypatch.setattr(frames, "LARGEST_PIECE", 1 << 16)
    monkeypatch.setattr(frames, "_COUNTED", 1 << 10)
    zeros = bytes(64 * 64)
    cases = {"right": [zeros], "bomb": [bytes(1 << 25)], "streams": [zeros, bytes(1 << 20)]}
    for name, parts in cases.items():
        if name == "streams" and codec != "lzma":
            continue
        packed = b"".join(map(pack, parts))
        path = tmp_path / f"{name}.tif"
        # a page of 64 x 64 bytes in one part: sizes, codec, 0 is black, where the part lies, its rows and bytes
        tags = {256: 64, 257: 64, 258: 8, 259: number, 262: 1, 273: 8, 277: 1, 278: 64, 279: len(packed)}
        listed = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
        packed += bytes(len(packed) % 2)
        head = b"II*\0" + struct.pack("<I", 8 + len(packed))
        path.write_bytes(head + packed + struct.pack("<H", len(tags)) + listed + bytes(4))
        read = frames.Tif.read(path, Said())
        assert read.frames is not None
        tracemalloc.start()
        if name == "right":
            assert not read.frames[0:1].any()
        else:
            with pytest.raises(InputError, match=r"a page unpacks to more than its 4,096 bytes"):
                read.frames[0:1]
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert most < 1 << 24, name
