"""Small files of other programs, and what an import makes of them: for tests."""

from __future__ import annotations

import struct
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


def ptu(path: Path, records: list[int], kind: int = HYDRAHARP_T2, mode: int = 2, declared: int | None = None) -> Path:
    """A small PTU file, by hand: a header of tags, then 32-bit records."""

    def tag(name: str, code: int, value: bytes) -> bytes:
        return struct.pack("<32siI", name.encode(), -1, code) + value

    whole = {
        "Measurement_Mode": mode,
        "TTResultFormat_TTTRRecType": kind,
        "TTResultFormat_BitsPerRecord": 32,
        "TTResult_StopAfter": 2000,
        "TTResult_NumberOfRecords": len(records) if declared is None else declared,
    }
    body = b"".join(tag(name, 0x10000008, struct.pack("<q", value)) for name, value in whole.items())
    for name in ("MeasDesc_GlobalResolution", "MeasDesc_Resolution"):
        body += tag(name, 0x20000008, struct.pack("<d", 1e-12))
    body += tag("Header_End", 0xFFFF0008, bytes(8))
    path.write_bytes(b"PQTTTR\0\0" + b"1.0.00\0\0" + body + np.array(records, "<u4").tobytes())
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
