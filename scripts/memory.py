"""Peak memory of the verbs on large files: a file of each kind that `import` reads, and images of each source.

    python scripts/memory.py                    # all kinds, about 400 MB each: half an hour, 3 GB of disk
    python scripts/memory.py "*.h5" a.ptu       # some
    python scripts/memory.py --size 100         # MB
    python scripts/memory.py --inference 99000000       # compare, diagnose and fit of a capture with so many stamps

Each file is made in a temporary folder, and is gone before the next one is made. The table goes to standard output:
the peak resident memory of each verb's largest process, in MB (of `compare` that of all its processes together, shared
pages counted once, as sampled; +: it was ended after the seconds of --compare). Linux only.
"""

from __future__ import annotations

import argparse
import fnmatch
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

PIECE = 1 << 20  # detections, bytes of frames that are made at a time
SIDE = 512  # pixels, of a frame
PIXELS = 64  # of detections
TICKS = 4_000_000_000  # of an exposure: stamps of 4 bytes
DETECTIONS = ["--exposure", "4 s", "--rows", "8", "--columns", "8", "--light", "500 nm 1 nW/cm^2"]
CLOCK = ["--frame-time", "10 us", "--frame-period", "10 us", "--light", "500 nm 1 nW/cm^2"]
SENSOR = """sensor:
  name: large
  rules: device
  layout: {rows: %d, columns: %d, pixel_area: 25 um^2}
  effects:
    detection: {pdp: 0.5}
    dead_time: {duration: 20 ns}
    tdc: {resolution: %s}
"""


# --- files --------------------------------------------------------------------------------------------------------


def _small_files() -> Any:
    """The module of the tests that writes small files of each kind."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    import importfiles

    return importfiles


def detections(count: int, ticks: int = TICKS) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(time, pixel) in the order of time, piece by piece."""
    rng = np.random.Generator(np.random.PCG64(1))
    for start in range(0, count, PIECE):
        n = min(PIECE, count - start)
        low, high = start * ticks // count, (start + n) * ticks // count
        yield np.sort(rng.integers(low, high, n, np.int64)), rng.integers(0, PIXELS, n, np.uint8)


def frames(size: int, shape: tuple[int, ...], most: int, dtype: str) -> Iterator[np.ndarray]:
    """(frames, *shape) numbers up to `most`, piece by piece; `size` bytes in all."""
    rng = np.random.Generator(np.random.PCG64(1))
    each = int(np.prod(shape)) * np.dtype(dtype).itemsize
    step = max(1, (16 * PIECE) // each)
    for start in range(0, size // each, step):
        n = min(step, size // each - start)
        yield rng.integers(0, most, (n, *shape), dtype, endpoint=True)


def hdf5_detections(path: Path, size: int, time: str, pixel: str, names: tuple[str, str], ticks: int = TICKS) -> None:
    count = size // (np.dtype(time).itemsize + np.dtype(pixel).itemsize)
    with h5py.File(path, "w") as file:
        sets = [
            file.create_dataset(name, (count,), kind, chunks=(1 << 16,))
            for name, kind in zip(names, (time, pixel), strict=True)
        ]
        start = 0
        for parts in detections(count, ticks):
            for stored, part in zip(sets, parts, strict=True):
                stored[start : start + len(part)] = part
            start += len(parts[0])
        if "/" in names[0]:
            file["photon_data/timestamps_specs/timestamps_unit"] = 1e-9
            file["setup/num_pixels"] = PIXELS
            file["acquisition_duration"] = 4.0
        else:
            file.attrs["tick"] = 4.0 / ticks


def hdf5_frames(path: Path, size: int, shape: tuple[int, ...], most: int, dtype: str, last: bool = False) -> None:
    """last: the frames are the last axis, as MATLAB stores (rows, columns, frames)."""
    count = size // (int(np.prod(shape)) * np.dtype(dtype).itemsize)
    with h5py.File(path, "w") as file:
        stored = file.create_dataset("frames", (*shape, count) if last else (count, *shape), dtype, chunks=True)
        start = 0
        for part in frames(size, shape, most, dtype):
            if last:
                stored[..., start : start + len(part)] = np.moveaxis(part, 0, -1)
            else:
                stored[start : start + len(part)] = part
            start += len(part)


def bytes_of_frames(path: Path, size: int, shape: tuple[int, ...], most: int, dtype: str) -> None:
    with open(path, "wb") as file:
        for part in frames(size, shape, most, dtype):
            file.write(part.data)


def npy(path: Path, size: int, shape: tuple[int, ...], most: int, dtype: str, fortran: bool = False) -> None:
    """fortran: in that order, so that a frame's numbers lie across the file."""
    count = size // (int(np.prod(shape)) * np.dtype(dtype).itemsize)
    stored = np.lib.format.open_memmap(path, "w+", np.dtype(dtype), (count, *shape), fortran_order=fortran)
    start = 0
    for part in frames(size, shape, most, dtype):
        stored[start : start + len(part)] = part
        start += len(part)


def tif(path: Path, size: int, shape: tuple[int, ...], most: int, dtype: str) -> None:
    import tifffile

    with tifffile.TiffWriter(path) as file:
        for part in frames(size, shape, most, dtype):
            for page in part:
                file.write(page, photometric="minisblack", contiguous=True)


def npz_detections(path: Path, size: int) -> None:
    parts = list(detections(min(size, (1 << 28) - 4096) // 9))
    np.savez(path, time=np.concatenate([t for t, _ in parts]), pixel=np.concatenate([p for _, p in parts]), tick=1e-9)


def npz_frames(path: Path, size: int, dtype: str, most: int) -> None:
    parts = frames(min(size, (1 << 28) - 4096), (SIDE, SIDE), most, dtype)
    np.savez(path, frames=np.concatenate(list(parts)))


def ptu(path: Path, size: int) -> None:
    """T2 records of HydraHarp 2, an overflow where the clock goes round."""
    _small_files().ptu(path, [], declared=0, MeasDesc_GlobalResolution=1e-9)
    at, rounds, written = path.stat().st_size, 0, 0
    with open(path, "r+b") as file:
        file.seek(at)
        for time_, pixel in detections(size // 4, 1 << 31):
            gone = time_ >> 25
            before = np.diff(gone, prepend=rounds)
            rounds = int(gone[-1])
            records = (pixel.astype(np.uint32) % 60 << 25 | (time_ & ((1 << 25) - 1)).astype(np.uint32)).astype("<u4")
            at_overflow = np.flatnonzero(before)
            overflows = (1 << 31 | 63 << 25 | before[at_overflow]).astype("<u4")
            records = np.insert(records, at_overflow, overflows)
            file.write(records.tobytes())
            written += len(records)
    importfiles_header = _small_files().ptu(
        path.with_suffix(".head"), [], declared=written, MeasDesc_GlobalResolution=1e-9
    )
    with open(path, "r+b") as file:
        file.write(importfiles_header.read_bytes())
    importfiles_header.unlink()


def csv(path: Path, size: int) -> None:
    with open(path, "w") as file:
        file.write("pixel,time (ns)\n")
        for time_, pixel in detections(size // 14):
            file.write("".join(f"{p},{t}\n" for p, t in zip(pixel.tolist(), time_.tolist(), strict=True)))


def linospad2(path: Path, size: int) -> None:
    """Cycles of 65 converters with 512 words each, half of them valid, of the firmware 2212b."""
    rng = np.random.Generator(np.random.PCG64(1))
    with open(path, "wb") as file:
        for _ in range(size // (65 * 512 * 4)):
            codes = np.sort(rng.integers(0, 1 << 27, (65, 512), np.uint32), axis=1)
            words = (1 << 31 | rng.integers(0, 4, (65, 512), np.uint32) << 28 | codes).astype("<u4")
            words[:, 256:] = 0
            file.write(words.tobytes())


@dataclass(frozen=True)
class Kind:
    """A large file.

    make: writes about so many bytes; said: what an import must be told. looked: is its measurement looked at, too, and
    exported in these formats? Other kinds give the same measurements. sensor: rows, columns and resolution of one.
    """

    make: Callable[[Path, int], object]
    said: list[str]
    looked: tuple[str, ...] = ()
    sensor: tuple[int, int, str] = (SIDE, SIDE, "1 us")


_TR = (8, 8, "1 ns")
_STAMPS = ("hdf5", "npz", "photon-hdf5")
_FRAMES = ("hdf5", "npz", "npy")
_PACKED = ((SIDE, SIDE // 8), 255, "uint8")
_STR = ["--modality", "str", "--tick", "100 ns"]

KINDS: dict[str, Kind] = {
    "stamps.h5": Kind(
        lambda p, n: hdf5_detections(p, n * 3 // 2, "uint32", "uint16", ("time", "pixel")), DETECTIONS, _STAMPS, _TR
    ),
    "wide-stamps.h5": Kind(
        lambda p, n: hdf5_detections(p, n * 5 // 4, "uint64", "uint16", ("time", "pixel"), 100 * TICKS),
        DETECTIONS,
        _STAMPS,
        (8, 8, "10 ps"),
    ),
    "photons.hdf5": Kind(
        lambda p, n: hdf5_detections(
            p, n * 9 // 4, "int64", "uint8", ("photon_data/timestamps", "photon_data/detectors")
        ),
        DETECTIONS,
    ),
    "a.ptu": Kind(ptu, DETECTIONS),
    "a.csv": Kind(csv, [*DETECTIONS, "--tick", "1 ns"]),
    "a.dat": Kind(
        linospad2,
        ["--firmware", "2212b", "--timestamps", "512", "--cycle", "4 ms", "--light", "500 nm 1 nW/cm^2"],
    ),
    "stamps.npz": Kind(npz_detections, DETECTIONS),
    "bits.h5": Kind(
        lambda p, n: hdf5_frames(p, n, *_PACKED),
        [*CLOCK, "--packed", "--columns", str(SIDE)],
        _FRAMES,
    ),
    "counts.h5": Kind(lambda p, n: hdf5_frames(p, n, (SIDE, SIDE), 15, "uint8"), [*CLOCK, "--bits", "4"], _FRAMES),
    "first-stamps.h5": Kind(
        lambda p, n: hdf5_frames(p, n, (SIDE, SIDE), 100, "uint32"), [*CLOCK, *_STR], _FRAMES, (SIDE, SIDE, "100 ns")
    ),
    "frames-last.h5": Kind(
        lambda p, n: hdf5_frames(p, n, (SIDE, SIDE), 15, "uint8", True), [*CLOCK, "--bits", "4", "--axes", "HWM"]
    ),
    "counts.npy": Kind(lambda p, n: npy(p, n, (SIDE, SIDE), 15, "uint8"), [*CLOCK, "--bits", "4"]),
    "doubles.npy": Kind(lambda p, n: bits_as_doubles(p, n), CLOCK),
    "fortran.npy": Kind(lambda p, n: npy(p, n, (SIDE, SIDE), 15, "uint16", True), [*CLOCK, "--bits", "4"]),
    "frames.npz": Kind(lambda p, n: npz_frames(p, n, "uint8", 15), [*CLOCK, "--bits", "4"]),
    "bits.npz": Kind(lambda p, n: npz_frames(p, n, "uint8", 1), CLOCK),
    "counts.tif": Kind(lambda p, n: tif(p, n, (SIDE, SIDE), 15, "uint8"), [*CLOCK, "--bits", "4"]),
    "bits.bin": Kind(lambda p, n: bytes_of_frames(p, n, *_PACKED), CLOCK),
    "counts.raw": Kind(lambda p, n: bytes_of_frames(p, n, (SIDE, SIDE), 1023, "uint16"), [*CLOCK, "--bits", "10"]),
}


def bits_as_doubles(path: Path, size: int) -> None:
    stored = np.lib.format.open_memmap(path, "w+", np.dtype(float), (size // (8 * SIDE * SIDE), SIDE, SIDE))
    start = 0
    for part in frames(size // 8, (SIDE, SIDE), 1, "uint8"):
        stored[start : start + len(part)] = part
        start += len(part)


# --- memory -------------------------------------------------------------------------------------------------------

# a small process between: of what a process is before it becomes another one, its maker, the peak is counted, too
_MIDDLE = (
    "import os,resource,subprocess,sys;"
    "r=subprocess.run(sys.argv[2:],stdout=subprocess.DEVNULL,stderr=open(sys.argv[1],'w')).returncode;"
    "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss*1024,r)"
)


def peak(arguments: list[str], place: Path, seconds: float = 900.0, ok: tuple[int, ...] = (0,)) -> str:
    """The peak memory of a command of spadmnist in MB: of its largest process, or of all together where it has more.

    seconds: after which it is ended; the peak until then has a mark.
    """
    said = place / "said"
    command = [sys.executable, "-c", _MIDDLE, str(said), sys.executable, "-m", "spadmnist.cli", *arguments]
    environment = {**os.environ, "SPADMNIST_CACHE": str(place / "cache")}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment, start_new_session=True) as run:
        together, begun, cut = 0, time.monotonic(), False
        while run.poll() is None:
            together = max(together, sum(map(_pss, _below(run.pid))))
            time.sleep(0.1)
            if time.monotonic() - begun > seconds:
                cut = True
                os.killpg(run.pid, 9)
                break
        assert run.stdout is not None
        out = run.stdout.read().split()
    most, status = (int(out[0]), int(out[1])) if out else (together, 0)
    if status not in ok:
        return f"refused: {said.read_text().strip().splitlines()[-1]}"
    return f"{max(most, together) / 1e6:,.0f}{'+' * cut}"


def _below(pid: int) -> list[int]:
    """The processes that a process started, and those that they did."""
    try:
        found = [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []
    return [*found, *(two for one in found for two in _below(one))]


def _pss(pid: int) -> int:
    """Bytes of a process, its share of what it shares with others."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:")), 0)


def measured(name: str, kind: Kind, size: int, place: Path, compare: tuple[float, int]) -> dict[str, str]:
    """Peaks by verb. compare: how long it may take, s, and its --jobs."""
    path, lab = place / name, place / "lab"
    subprocess.run([sys.executable, __file__, "--make", name, str(path), "--size", str(size >> 20)], check=True)
    row = {"file": f"{name}, {path.stat().st_size / 1e6:,.0f} MB"}
    row["import"] = peak(["import", str(path), "-o", str(lab), *kind.said], place)
    path.unlink()
    if not kind.looked or not (lab / "measurement.yaml").exists():
        return row
    sensor = place / "sensor.yaml"
    sensor.write_text(SENSOR % kind.sensor)
    row["inspect"] = peak(["inspect", str(lab), "--plot", str(place / "a.png")], place)
    row["reconstruct"] = peak(["reconstruct", str(lab), "--sensor", str(sensor), "-o", str(place / "flux")], place)
    for format_ in kind.looked:
        out = place / f"out-{format_}"
        row[format_] = peak(["export", str(lab), "--format", format_, "-o", str(out)], place)
        shutil.rmtree(out, ignore_errors=True)
    seconds, jobs = compare
    if seconds:
        row["compare"] = peak(["compare", str(sensor), str(lab), "--jobs", str(jobs)], place, seconds, (0, 1))
    return row


# --- inference ----------------------------------------------------------------------------------------------------

LIT = """format: spadmnist-measurement/1
name: large
layout: {rows: 8, columns: 8}
captures:
  - {id: lit, modality: tr, light: {kind: flat, wavelength: 500 nm, irradiance: %g nW/cm^2}, exposure: 4 s}
"""
EACH = 404.4  # nW/cm^2 on 25 um^2 with a PDP of 50 % at 500 nm, by which a pixel has 1e6 detections in 4 s


def inference(count: int, jobs: int, place: Path, within: str) -> dict[str, tuple[str, float]]:
    """(peak, seconds) of each verb on time stamps of a sensor that has afterpulsing, which the model lacks.

    Args:
        count: detections of the capture, about.
        within: the budget of diagnose.
    """
    model, truth, plan, lab = (place / name for name in ("sensor.yaml", "truth.yaml", "plan.yaml", "lab"))
    text = SENSOR % _TR
    model.write_text(text)
    truth.write_text(text + "    afterpulsing: {probability: 1 %, lifetime: 60 ns}\n")
    plan.write_text(LIT % (EACH * count / PIXELS / 1e6))
    peaks = {}
    for name, arguments, ok in (
        ("simulate", ["simulate", str(truth), str(plan), "-o", str(lab)], (0,)),
        ("compare", ["compare", str(model), str(lab), "--jobs", str(jobs)], (0, 1)),
        (
            "fit --add afterpulsing",
            ["fit", str(model), str(lab), "--add", "afterpulsing", "-o", str(place / "next.yaml"), "--jobs", str(jobs)],
            (0,),
        ),
        (
            f"diagnose --quick --within {within}",
            ["diagnose", str(model), str(lab), "--quick", "--within", within, "--jobs", str(jobs)],
            (0, 1),
        ),
    ):
        began = time.monotonic()
        peaks[name] = peak(arguments, place, 3600.0, ok), time.monotonic() - began
    return peaks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=["*"], help=f"which of {', '.join(KINDS)}")
    parser.add_argument("--size", type=int, default=380, help="MiB of a file, about")
    parser.add_argument("--compare", type=float, default=0.0, metavar="SECONDS", help="compare, too, for so long")
    parser.add_argument("--jobs", type=int, default=1, help="of compare, diagnose and fit")
    parser.add_argument("--inference", type=int, metavar="N", help="measure it alone, on a capture of so many stamps")
    parser.add_argument("--within", default="10min", help="the budget of its diagnose")
    parser.add_argument("--make", action="store_true", help=argparse.SUPPRESS)
    said = parser.parse_args()
    if said.make:
        name, path = said.names
        KINDS[name].make(Path(path), said.size << 20)
        return
    if said.inference:
        print("| verb | seconds | peak |\n| --- | --- | --- |", flush=True)
        with tempfile.TemporaryDirectory(prefix="memory-") as place:
            for verb, (most, seconds) in inference(said.inference, said.jobs, Path(place), said.within).items():
                print(f"| {verb} | {seconds:,.0f} | {most} |", flush=True)
        return
    columns = ["file", "import", "inspect", "reconstruct", *dict.fromkeys((*_STAMPS, *_FRAMES)), "compare"]
    print("| " + " | ".join(columns) + " |\n|" + " --- |" * len(columns), flush=True)
    for name, kind in KINDS.items():
        if any(fnmatch.fnmatch(name, wanted) for wanted in said.names):
            with tempfile.TemporaryDirectory(prefix="memory-") as place:
                row = measured(name, kind, said.size << 20, Path(place), (said.compare, said.jobs))
            print("| " + " | ".join(row.get(column, "") for column in columns) + " |", flush=True)


if __name__ == "__main__":
    main()
