"""What is written comes back: whole or not at all, and the same bytes for the same recordings."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from measured import (
    CAPTURES,
    assert_same_data,
    device,
    one,
    recordings,
    refused,
    tree,
)

from spadmnist import measurement, twin
from spadmnist.effects import Conditions
from spadmnist.effects.dark_counts import DarkCounts
from spadmnist.effects.detection import Detection
from spadmnist.effects.tdc import Tdc
from spadmnist.errors import InputError, SpadError
from spadmnist.events import Layout
from spadmnist.recording import Capture, Light, Recording
from spadmnist.sensor import Sensor


def test_two_runs_cannot_write_to_one_place(tmp_path: Path) -> None:
    sensor = device()

    def second() -> Iterator[Recording | Capture]:
        with pytest.raises(SpadError, match="another run is writing there"):
            measurement.write(tmp_path / "out", "lab", sensor.layout, recordings(sensor))
        yield from recordings(sensor, CAPTURES[:1])

    measurement.write(tmp_path / "out", "lab", sensor.layout, second())


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    sensor = device()
    made = list(recordings(sensor))
    measurement.write(tmp_path / "out", "a lab's: name", sensor.layout, iter(made), CAPTURES)
    opened = measurement.open(tmp_path / "out")
    assert opened.name == "a lab's: name" and opened.captures == CAPTURES
    for was in made:
        if isinstance(was, Recording):
            assert was.totals.sum() > 0
            assert_same_data(was, opened.recording(was.capture.id, sensor))
    assert "mean_of_qis.h5" not in tree(tmp_path / "out") and not (tmp_path / "out" / ".spadmnist").exists()


def test_the_bytes_are_a_function_of_the_recordings(tmp_path: Path) -> None:
    sensor = device()
    for name in ("a", "b"):
        measurement.write(tmp_path / name, "lab", sensor.layout, recordings(sensor))
    assert tree(tmp_path / "a") == tree(tmp_path / "b")
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "a").iterdir()}
    measurement.write(tmp_path / "a", "lab", sensor.layout, recordings(sensor), CAPTURES)
    assert before == {p: p.stat().st_mtime_ns for p in (tmp_path / "a").iterdir()}


def test_files_of_units_and_names(tmp_path: Path) -> None:
    sensor = device()
    twice = (CAPTURES[0], replace(CAPTURES[0], id="TR/flat"), replace(CAPTURES[2], id="日本"))
    measurement.write(tmp_path / "out", "lab", sensor.layout, recordings(sensor, twice))
    assert set(tree(tmp_path / "out")) == {"measurement.yaml", "tr_flat.h5", "TR_flat-2.h5", "capture.h5"}
    with h5py.File(tmp_path / "out" / "tr_flat.h5") as file:
        assert file["time"].attrs["units"] == b"1 ns" and file.attrs["modality"] == b"tr"
        assert file.attrs["tick"] == 1e-9 and file["time"].compression == "gzip" and file["time"].fletcher32
    assert [c.id for c in measurement.open(tmp_path / "out").captures] == ["tr flat", "TR/flat", "日本"]


def test_a_folder_with_something_else_is_refused(tmp_path: Path) -> None:
    sensor = device()

    def write(root: Path, seed: int = 1, captures: tuple[Capture, ...] = CAPTURES) -> None:
        measurement.write(root, "lab", sensor.layout, recordings(sensor, captures, seed), captures)

    def untouched() -> Iterator[Recording]:
        raise AssertionError("nothing may be simulated for a place that is refused")
        yield

    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "thesis.txt").write_text("x")
    with pytest.raises(SpadError, match="not empty"):
        measurement.write(tmp_path / "notes", "lab", sensor.layout, untouched(), CAPTURES)
    assert tree(tmp_path / "notes") == {"thesis.txt": b"x"}
    with pytest.raises(SpadError, match="is a file"):
        write(tmp_path / "notes" / "thesis.txt")
    write(tmp_path / "out")
    before = tree(tmp_path / "out")
    with pytest.raises(SpadError, match="another sensor or seed"):
        write(tmp_path / "out", seed=2)
    with pytest.raises(SpadError, match="not empty"):
        write(tmp_path / "out", captures=CAPTURES[:2])
    with pytest.raises(SpadError, match="another measurement"):
        measurement.write(tmp_path / "out", "other name", sensor.layout, recordings(sensor), CAPTURES)
    assert tree(tmp_path / "out") == before


def test_an_interrupted_run_is_finished_by_the_same_command(tmp_path: Path) -> None:
    sensor = device()

    def until(stop: int) -> Iterator[Recording | Capture]:
        for i, made in enumerate(recordings(sensor)):
            if i == stop:
                raise KeyboardInterrupt
            yield made

    measurement.write(tmp_path / "whole", "lab", sensor.layout, recordings(sensor))
    for stop in (0, 3):
        with pytest.raises(KeyboardInterrupt):
            measurement.write(tmp_path / f"{stop}", "lab", sensor.layout, until(stop), CAPTURES)
        assert not (tmp_path / f"{stop}" / "measurement.yaml").exists()
        measurement.write(tmp_path / f"{stop}", "lab", sensor.layout, recordings(sensor), CAPTURES)
        assert tree(tmp_path / f"{stop}") == tree(tmp_path / "whole")


def test_counts_fill_whole_count_frames(tmp_path: Path) -> None:
    """What is written can be opened: a count is the sum of 2^bits - 1 binary frames, so none may be left over."""
    sensor = device()
    for frames, bits_, counting, fine in [
        (301, 1, "frames", True),
        (301, 3, "counter", True),
        (301, 3, "frames", True),
        (300, 3, "frames", False),
        (5, 3, "frames", False),
    ]:
        capture = one("counts", frames, bits=bits_, counting=counting)
        mean = replace(capture, id="mean", mean=2.0)
        root = tmp_path / f"{frames} {bits_} {counting}"
        if fine:
            (made,) = recordings(sensor, (capture,))
            assert isinstance(made, Recording)
            measurement.write(root, "lab", sensor.layout, [made, mean])
            opened = measurement.open(root)
            assert opened.captures == (capture, mean)
            assert_same_data(made, opened.recording(capture.id, sensor))
            continue
        for some in (recordings(sensor, (capture,)), [mean]):
            refused(lambda: measurement.write(root, "lab", sensor.layout, some), "do not fill", "the sum of 7")  # noqa: B023
        before: list[Recording] = []
        refused(
            lambda: measurement.write(tmp_path / "x", "", sensor.layout, before, (capture,)),  # noqa: B023
            f"take {max(7, frames // 7 * 7)}",
        )
        assert not (tmp_path / "x").exists() and tree(root) == {}


class Noise:
    """Frames that cannot be packed, made as they are read."""

    def __init__(self, frames: int, at: Callable[[int], object] = lambda start: None):
        self.shape, self.at = (frames, 256, 32), at

    def __getitem__(self, part: slice) -> np.ndarray:
        start, stop, _ = part.indices(self.shape[0])
        self.at(start)
        return np.random.Generator(np.random.Philox(start)).integers(0, 256, (stop - start, 256, 32), np.uint8)

    def recording(self) -> Recording:
        capture = Capture("noise", "qis", Light(), Conditions(self.shape[0] * 1e-5, self.shape[0], 1e-5, 1e-5, None))
        return Recording(capture, Layout(256, 256, np.nan, np.nan), None, self)


def alone(script: str) -> subprocess.CompletedProcess[str]:
    """Run in a process of its own, which may crash."""
    head = """
import os, resource, signal, sys
from pathlib import Path
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background processes ignore it
sys.path.insert(0, "tests")
from test_measurement_writer import Noise, measurement, SpadError
def write(root, frames=4000, at=lambda start: None):
    made = Noise(frames, at).recording()
    measurement.write(Path(root), "lab", made.layout, [made])
"""
    folder = Path(__file__).parents[1]
    return subprocess.run([sys.executable, "-c", head + script], capture_output=True, text=True, cwd=folder)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="counts in kB")
def test_writing_takes_little_memory(tmp_path: Path) -> None:
    """A file of 131 MB, of which a part is in memory at a time."""
    done = alone(f"""
write({str(tmp_path / "warm")!r}, 10)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
write({str(tmp_path / "out")!r}, 16000)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024)
""")
    assert int(done.stdout) < 100e6 < 131e6 < (tmp_path / "out" / "noise.h5").stat().st_size, done.stderr


@pytest.mark.slow
def test_a_file_that_cannot_be_written_is_a_sentence_and_leaves_nothing(tmp_path: Path) -> None:
    """HDF5 crashes where a write fails: it is not told of it."""
    done = alone(f"""
root = Path({str(tmp_path)!r})
for n, limit in enumerate((10, 3000, 100_000, 5_000_000, 32_000_000)):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    try:
        write(root / str(n))
    except SpadError as error:
        print(error)
""")
    assert done.returncode == 0 and not done.stderr, done.stderr
    said = done.stdout.splitlines()
    assert len(said) == 5 and all("cannot write up to 32.8 MB here: File too large; raise the limit" in s for s in said)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.slow
def test_a_full_disk(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", disk], capture_output=True).returncode:
        pytest.skip("mounting a small tmpfs is not allowed here")
    try:
        done = alone(f"""
try:
    write({str(disk / "out")!r})
except SpadError as error:
    print(error)
""")
        assert done.returncode == 0 and "No space left on device; free some space" in done.stdout, done.stderr
        assert not [path for path in disk.rglob("*") if path.is_file()]
    finally:
        subprocess.run(["umount", disk], check=True)


@pytest.mark.slow
def test_who_is_killed_leaves_no_half_file_and_can_go_on(tmp_path: Path) -> None:
    done = alone(f"""
write({str(tmp_path / "out")!r}, at=lambda start: start > 2000 and os.kill(os.getpid(), signal.SIGKILL))
""")
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert {path.name for path in (tmp_path / "out").iterdir()} == {".spadmnist"}
    for name in ("out", "whole"):
        made = Noise(4000).recording()
        measurement.write(tmp_path / name, "lab", made.layout, [made])
    assert tree(tmp_path / "out") == tree(tmp_path / "whole") and len(tree(tmp_path / "out")) == 2


@pytest.mark.slow
def test_an_interrupt_ends_the_writing(tmp_path: Path) -> None:
    """It comes while HDF5 packs a piece, and calls back; most of the frames are then never read."""
    done = alone(f"""
import threading
read = []
def at(start):
    read.append(start)
    if len(read) == 3:
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    write({str(tmp_path / "out")!r}, 40_000, at)
except KeyboardInterrupt:
    print(max(read))
""")
    assert done.returncode == 0 and not done.stderr and int(done.stdout) < 20_000, done.stderr
    assert tree(tmp_path / "out") == {}


@pytest.mark.slow
def test_an_interrupt_while_hdf5_writes_what_it_kept(tmp_path: Path) -> None:
    """Were it raised in what HDF5 calls, the process would crash."""
    done = alone(f"""
import threading
import time
import numpy as np
from spadmnist import capture_files
noise = np.random.Generator(np.random.Philox(1)).integers(0, 256, 8_000_000, np.uint8)
def fill(made, alive):
    found = made.create_dataset("x", noise.shape, "u1", chunks=(65536,), compression="gzip")
    found[...] = noise
    threading.Timer(0.02, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    with open({str(tmp_path / "x.h5")!r}, "w+b") as file:
        capture_files.write_hdf5(file, fill)
    time.sleep(1)
except KeyboardInterrupt:
    print("interrupted")
""")
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")


def test_the_place_of_a_dataset_that_was_begun_is_refused(tmp_path: Path) -> None:
    (tmp_path / ".spadmnist" / "tmp").mkdir(parents=True)
    (tmp_path / ".spadmnist" / "tmp" / "shard").write_text("x")
    (tmp_path / ".spadmnist" / "lock").touch()
    before = tree(tmp_path)
    with pytest.raises(SpadError, match=r"there is \.spadmnist/lock"):
        measurement.write(tmp_path, "lab", device().layout, recordings(device()))
    assert tree(tmp_path) == before


def test_what_is_computed_of_a_recording_is_kept() -> None:
    made = Noise(10).recording()
    calls: list[int] = []
    for _ in range(2):
        assert made.kept("x", lambda: calls.append(1) or 7) == 7  # type: ignore[func-returns-value]
    shares: list[float] = []
    watched = made.watched(shares.append)
    assert calls == [1] and np.array_equal(watched.totals, made.totals) and sum(shares) == pytest.approx(1.0)


def test_a_measurement_with_positions_comes_back(tmp_path: Path) -> None:
    places = np.array([[0.0, 0.0], [2.3e-5, 0.0], [1.15e-5, 1.9916e-5]])
    effects = [Detection(pdp=0.4), DarkCounts(rate=1e5), Tdc(resolution=1e-9)]
    sensor = Sensor(Layout(1, 3, 25e-12, 1.0, places), effects, "device").resolved()
    measurement.write(tmp_path / "out", "lab", sensor.layout, recordings(sensor, CAPTURES[:2]))
    opened = measurement.open(tmp_path / "out")
    assert np.array_equal(opened.layout.positions, places)  # type: ignore[arg-type]
    opened.recording("tr flat", sensor)


def test_stamps_without_a_converter_are_stored_in_picoseconds(tmp_path: Path) -> None:
    sensor = device(resolution=0)
    (made,) = recordings(sensor, CAPTURES[:1])
    assert isinstance(made, Recording) and made.events is not None and made.events.ticks is None
    measurement.write(tmp_path / "out", "lab", sensor.layout, [made])
    read = measurement.open(tmp_path / "out").recording("tr flat", sensor)
    assert read.events is not None and np.array_equal(read.events.offsets, made.events.offsets)
    assert read.tick == 1e-12 and 0 <= np.max(made.events.times - read.events.times) < 1.001e-12
    refused(lambda: list(recordings(sensor, (CAPTURES[3],))), "add tdc")


def test_a_file_that_took_another_ones_place_is_refused(tmp_path: Path) -> None:
    """Of the same shape, by another capture of the same measurement; a file that does not say whose it is is read."""
    sensor = device()
    captures = [replace(CAPTURES[0], id=id) for id in ("one", "zwei é")]
    root = measurement.write(tmp_path / "lab", "lab", sensor.layout, recordings(sensor, captures))
    first, second = (root / name for name in ("one.h5", "zwei.h5"))
    measurement.open(root)
    before = first.read_bytes()
    first.write_bytes(second.read_bytes())
    with pytest.raises(InputError, match=r"one\.h5: is the file of the capture 'zwei é', and stands for 'one'; put"):
        measurement.open(root)
    with h5py.File(first, "r+") as file:
        del file.attrs["capture_id"]
    assert measurement.open(root).recording("one").totals.sum() > 0
    first.write_bytes(before)
    assert measurement.open(root).recording("one").totals.sum() > 0


@pytest.mark.parametrize("named", [True, False])
def test_a_plan_that_is_simulated_into_its_own_folder_stays_a_plan(named: bool, tmp_path: Path) -> None:
    """The simulation is refused; its files would have stood for the data of the laboratory."""
    file = "file: dark.h5, " if named else ""
    plan = (
        "format: spadmnist-measurement/1\nname: lab\nlayout: {rows: 2, columns: 2}\ncaptures:\n"
        f"  - {{id: dark, {file}modality: qis, light: {{kind: dark}}, frames: 10, frame_time: 10 us}}\n"
    )
    (tmp_path / "measurement.yaml").write_text(plan)
    sensor = Sensor(Layout(2, 2, 25e-12, 1.0), [DarkCounts(rate=1e4)])
    opened = measurement.open(tmp_path, planned=True)
    with pytest.raises(SpadError, match=r"measurement\.yaml: belongs to another .*; choose another folder with -o$"):
        twin.simulate(sensor, opened, tmp_path, 1)
    assert [path.name for path in tmp_path.iterdir() if not path.name.startswith(".")] == ["measurement.yaml"]
    assert (tmp_path / "measurement.yaml").read_text() == plan
