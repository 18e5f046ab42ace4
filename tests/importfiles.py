"""Small files of other programs, and what an import makes of them: for tests."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from spadmnist import measurement
from spadmnist.errors import SpadError
from spadmnist.importers import Said
from spadmnist.importers.captures import Imported, import_files
from spadmnist.recording import Light, Recording

DARK = [Light()]
CLOCK = Said(frame_time=10e-6, frame_period=12e-6)
SECOND = Said(exposure=1.0)


def run(files: Path | list[Path], said: Said = SECOND, lights: Any = DARK, **more: Any) -> Imported:
    """Import next to the files."""
    listed = files if isinstance(files, list) else [files]
    return import_files(listed, listed[0].parent / "made", said, lights, **more)


def back(made: Imported, id: str | None = None) -> Recording:
    opened = measurement.open(made.folder)
    return opened.recording(id or opened.captures[0].id)


def refusal(files: Path | list[Path], said: Said = SECOND, lights: Any = DARK) -> str:
    """The one sentence of a refusal; nothing that looks like a measurement is left behind."""
    listed = files if isinstance(files, list) else [files]
    with pytest.raises(SpadError) as caught:
        run(listed, said, lights)
    assert not (listed[0].parent / "made" / "measurement.yaml").exists()
    text = str(caught.value)
    assert "\n" not in text and len(text) < 600
    return text


HYDRAHARP_T2, HYDRAHARP_T3, PICOHARP_T2, MULTIHARP_T2 = 0x01010204, 0x01010304, 0x00010203, 0x00010207
HYDRAHARP_1_T2, TIMEHARP_N_T2, TIMEHARP_P_T2 = 0x00010204, 0x00010205, 0x00010206
EVERY_T2 = (PICOHARP_T2, HYDRAHARP_1_T2, HYDRAHARP_T2, TIMEHARP_N_T2, TIMEHARP_P_T2, MULTIHARP_T2)


def ptu(
    path: Path,
    records: list[int] | np.ndarray,
    kind: int = HYDRAHARP_T2,
    mode: int = 2,
    declared: int | None = None,
    **tags: float | None,
) -> Path:
    """A small PTU file, by hand: a header of tags, then 32-bit records. tags: other values than the usual; None: left
    out.
    """

    def tag(name: str, value: float) -> bytes:
        code, packed = (0x20000008, "<d") if isinstance(value, float) else (0x10000008, "<q")
        return struct.pack("<32siI", name.encode(), -1, code) + struct.pack(packed, value)

    usual: dict[str, float | None] = {
        "Measurement_Mode": mode,
        "TTResultFormat_TTTRRecType": kind,
        "TTResultFormat_BitsPerRecord": 32,
        "TTResult_StopAfter": 2000,
        "TTResult_NumberOfRecords": len(records) if declared is None else declared,
        "MeasDesc_GlobalResolution": 1e-12,
        "MeasDesc_Resolution": 1e-12,
    }
    body = b"".join(tag(name, value) for name, value in {**usual, **tags}.items() if value is not None)
    body += struct.pack("<32siI", b"Header_End", -1, 0xFFFF0008) + bytes(8)
    path.write_bytes(b"PQTTTR\0\0" + b"1.0.00\0\0" + body + np.asarray(records, np.uint32).astype("<u4").tobytes())
    return path


def t2(channel: int, time: int, special: bool = False) -> int:
    return special << 31 | channel << 25 | time


def bits(frames: int = 20, rows: int = 3, columns: int = 11) -> np.ndarray:
    return np.random.Generator(np.random.Philox(frames)).random((frames, rows, columns)) < 0.3


def save(path: Path, array: np.ndarray) -> Path:
    """A stack of frames, as its name says."""
    if path.suffix == ".npy":
        np.save(path, array)
    elif path.suffix == ".npz":
        np.savez(path, frames=array)
    elif path.suffix == ".tif":
        pytest.importorskip("tifffile").imwrite(path, array, photometric="minisblack")
    else:
        with h5py.File(path, "w") as file:
            file["deep/er/stack"] = array
    return path


def photon_hdf5(path: Path, groups: dict[str, tuple[Any, Any]], unit: float = 1e-8) -> Path:
    with h5py.File(path, "w") as file:
        for name, (times, detectors) in groups.items():
            file[f"{name}/timestamps"] = np.asarray(times, np.int64)
            file[f"{name}/timestamps_specs/timestamps_unit"] = unit
            if detectors is not None:
                file[f"{name}/detectors"] = np.asarray(detectors, np.uint8)
        file["acquisition_duration"] = 0.5
    return path


def hdf5(path: Path, attributes: dict[str, Any] | None = None, userblock: int = 0, **sets: Any) -> Path:
    """Plain HDF5, behind so many bytes of something else."""
    with h5py.File(path, "w", userblock_size=userblock) as file:
        for name, value in sets.items():
            file[name] = value
        file.attrs.update(attributes or {})
    return path


def matlab(path: Path, **variables: np.ndarray) -> Path:
    """As MATLAB 7.3 saves variables: axes reversed, behind a line of text; of what is empty the shape is stored."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            value = np.atleast_2d(value)
            kind = {"b": "logical", "f": "double"}.get(value.dtype.kind, str(value.dtype))
            stored = value.T.astype(np.uint8) if kind == "logical" else value.T
            file[name] = stored if value.size else np.array(value.shape, np.uint64)
            file[name].attrs["MATLAB_class"] = np.bytes_(kind)
            if kind == "logical":
                file[name].attrs["MATLAB_int_decode"] = np.int32(1)
            if not value.size:
                file[name].attrs["MATLAB_empty"] = np.uint8(1)
    text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Mon Mar  3 10:00:00 2025 HDF5 schema 1.00 ."
    data = path.read_bytes()
    path.write_bytes((text.ljust(124) + b"\0\2IM").ljust(512, b"\0") + data[512:])
    return path


# --- a small file of every kind -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sample:
    """A small file: its name, the kind that reads it, what it holds, how it is written and what an import must be told.

    packed: are its frames packed bits?
    """

    name: str
    kind: str
    modality: str
    make: Callable[[Path], Any]
    said: Said
    packed: bool = False

    def __str__(self) -> str:
        return f"{self.kind}-{self.name}"


TIME, PIXEL = np.array([700, 150, 200, 90_000, 450], np.uint32), np.array([1, 0, 2, 1, 0], np.uint8)
_BITS, _RNG = bits(), np.random.Generator(np.random.Philox(7))
_PACKED = np.packbits(_BITS, axis=2)
_COUNTS = _RNG.integers(0, 16, (20, 3, 11)).astype(np.uint8)
_STAMPS = _RNG.integers(0, 101, (20, 3, 11)).astype(np.uint16)
_LINES = "".join(f"{p},{t}\n" for p, t in zip(PIXEL, TIME, strict=True))
_TAGGED = replace(SECOND, tick=1e-9)
_FOUR_BITS, _STR = replace(CLOCK, bits=4), replace(CLOCK, modality="str", tick=1e-7)
_RAW, _GRID = replace(CLOCK, rows=3, columns=16), replace(SECOND, rows=2, columns=3)
_LINO = Said(firmware="2212b", timestamps=4, cycle=4e-3)


def _tagged(path: Path) -> None:
    ptu(path, [t2(0, 300, True), t2(2, 400), t2(3, 450, True), t2(63, 2, True), t2(0, 100), t2(1, 200)])


def _photons(path: Path) -> None:
    photon_hdf5(path, {"photon_data": ([5, 7, 9, 30], [2, 0, 2, 1])})


def _words(path: Path) -> None:
    words = np.zeros((2, 65, 4), "<u4")
    words[0, 5, 0], words[1, 63, 0], words[1, 2, 0] = 1 << 31 | 2 << 28 | 281, 1 << 31 | 3 << 28 | 7, 1 << 31 | 9
    path.write_bytes(words.tobytes())


SAMPLES = [
    Sample("a.ptu", "Ptu", "tr", _tagged, Said()),
    Sample("a.hdf5", "PhotonHdf5", "tr", _photons, Said()),
    Sample("tr.h5", "PlainHdf5", "tr", lambda p: hdf5(p, {"tick": 1e-9}, time=TIME, pixel=PIXEL), SECOND),
    Sample("tr.mat", "PlainHdf5", "tr", lambda p: matlab(p, time=TIME * 1.0, pixel=PIXEL * 1.0), _TAGGED),
    Sample("qis.h5", "PlainHdf5", "qis", lambda p: hdf5(p, frames=_BITS), CLOCK),
    Sample("width.h5", "PlainHdf5", "qis", lambda p: hdf5(p, {"width": 11}, frames=_PACKED), CLOCK, True),
    Sample("qis.mat", "PlainHdf5", "qis", lambda p: matlab(p, frames=_BITS.transpose(1, 2, 0) * 1.0), CLOCK),
    Sample("counts.h5", "PlainHdf5", "counts", lambda p: hdf5(p, {"bits": 4}, frames=_COUNTS), CLOCK),
    Sample("str.h5", "PlainHdf5", "str", lambda p: hdf5(p, {"tick": 1e-7}, frames=_STAMPS), CLOCK),
    Sample("qis.npy", "Npy", "qis", lambda p: np.save(p, _BITS.astype(np.uint8)), CLOCK),
    Sample("packed.npy", "Npy", "qis", lambda p: np.save(p, _PACKED), replace(CLOCK, packed=True, columns=11), True),
    Sample("counts.npy", "Npy", "counts", lambda p: np.save(p, _COUNTS), _FOUR_BITS),
    Sample("str.npy", "Npy", "str", lambda p: np.save(p, np.asfortranarray(_STAMPS)), _STR),
    Sample("tr.npz", "Npz", "tr", lambda p: np.savez(p, time=TIME, pixel=PIXEL, tick=1e-9), SECOND),
    Sample("qis.npz", "Npz", "qis", lambda p: np.savez(p, frames=_BITS), CLOCK),
    Sample("width.npz", "Npz", "qis", lambda p: np.savez(p, frames=_PACKED, width=11), CLOCK, True),
    Sample("counts.npz", "Npz", "counts", lambda p: np.savez(p, frames=_COUNTS, bits=4, counter=1), CLOCK),
    Sample("str.npz", "Npz", "str", lambda p: np.savez(p, frames=_STAMPS, tick=1e-7), CLOCK),
    Sample("qis.tif", "Tif", "qis", lambda p: save(p, _BITS.astype(np.uint8) * 255), CLOCK),
    Sample("packed.tif", "Tif", "qis", lambda p: save(p, _PACKED), replace(CLOCK, packed=True, columns=11), True),
    Sample("counts.tif", "Tif", "counts", lambda p: save(p, _COUNTS), _FOUR_BITS),
    Sample("str.tif", "Tif", "str", lambda p: save(p, _STAMPS), _STR),
    Sample("qis.bin", "Raw", "qis", lambda p: p.write_bytes(np.packbits(bits(20, 3, 16), axis=2)), _RAW, True),
    Sample("counts.raw", "Raw", "counts", lambda p: p.write_bytes(_COUNTS), replace(_RAW, columns=11, bits=4)),
    Sample("a.csv", "Table", "tr", lambda p: p.write_text("pixel,time (ns)\n" + _LINES), SECOND),
    Sample("xy.csv", "Table", "tr", lambda p: p.write_text("x,y,time (ns)\n0,1,7\n2,0,1\n"), _GRID),
    Sample("a.dat", "LinoSpad2", "tr", _words, _LINO),
]
every_sample = pytest.mark.parametrize("sample", SAMPLES, ids=str)


def made_of(sample: Sample, folder: Path) -> Path:
    """Write the file of a sample."""
    if sample.kind in ("Ptu", "Tif"):
        pytest.importorskip({"Ptu": "ptufile", "Tif": "tifffile"}[sample.kind])
    folder.mkdir(parents=True, exist_ok=True)
    sample.make(folder / sample.name)
    return folder / sample.name


def refusal_of(call: Any, *arguments: Any, **named: Any) -> str:
    """The one sentence with which a call is refused."""
    with pytest.raises(SpadError) as caught:
        call(*arguments, **named)
    text = str(caught.value)
    assert "\n" not in text and len(text) < 600
    return text
