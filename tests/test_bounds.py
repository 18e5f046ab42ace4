"""What a file or a config declares is compared with what can be held, before any memory or time is taken for it."""

from __future__ import annotations

import gc
import struct
import subprocess
import sys
import tracemalloc
import weakref
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_factory import write_config

from spadmnist import (
    capture_files,
    config,
    events,
    exporters,
    factory,
    look,
    measurement,
    plan,
    report,
    shard_plan,
    store,
    system,
)
from spadmnist.disk import Files
from spadmnist.effects import Conditions
from spadmnist.errors import ConfigError, InputError
from spadmnist.events import Events, Layout
from spadmnist.experiment import Level
from spadmnist.import_options import Said
from spadmnist.importers import detections, light
from spadmnist.importers.captures import import_files
from spadmnist.importers.frames import Npz, Tif
from spadmnist.inference.reduction import statistics_for
from spadmnist.readout import Recorded
from spadmnist.recording import Capture, Light, Recording
from spadmnist.shard_plan import Shard
from spadmnist.statistics import _order
from spadmnist.statistics.integrity import Gaps

CAPTURES = """format: spadmnist-measurement/1
name: lab
layout: {rows: 2, columns: 2}
captures:
  - {id: dark, file: dark.h5, modality: tr, light: {kind: dark}, exposure: EXPOSURE}
"""
CHUNK = 1 << 18


def bomb(folder: Path, size: int, exposure: str = "1 s", **filters: Any) -> Path:
    """A measurement of 1,000 detections; the first chunk of `time` unpacks to `size` bytes."""
    folder.mkdir()
    (folder / "measurement.yaml").write_text(CAPTURES.replace("EXPOSURE", exposure))
    with h5py.File(folder / "dark.h5", "w") as file:
        file.attrs["tick"] = 1e-9
        file["pixel"] = np.zeros(1000, np.uint16)
        made = {"chunks": (CHUNK,), "maxshape": (None,), **(filters or {"compression": "gzip"})}
        time = file.create_dataset("time", (1000,), np.uint32, **made)
        if filters:
            time[:] = np.arange(1000)
        else:
            packer = zlib.compressobj(9)
            zeros = bytes(1 << 20)
            packed = b"".join(packer.compress(zeros) for _ in range(size >> 20)) + packer.flush()
            time.id.write_direct_chunk((0,), packed)
    return folder


@pytest.mark.slow
def test_a_chunk_unpacks_to_no_more_than_its_shape(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"dark\.h5: time has a chunk that unpacks to more than the 1,048,576 bytes"):
        measurement.open(bomb(tmp_path / "lab", 512 << 20)).recording("dark")
    whole = measurement.open(bomb(tmp_path / "whole", CHUNK * 4)).recording("dark")
    assert whole.events is not None and len(whole.events) == 1000


@pytest.mark.slow
def test_a_bomb_takes_no_memory(tmp_path: Path) -> None:
    bomb(tmp_path / "lab", 2 << 30)
    program = (
        "import resource, sys\nfrom pathlib import Path\nfrom spadmnist import measurement\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "try:\n    measurement.open(Path(sys.argv[1])).recording('dark')\n"
        "except Exception as error:\n    print(type(error).__name__)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    told = subprocess.run([sys.executable, "-c", program, str(tmp_path / "lab")], capture_output=True, text=True)
    kind, grown = told.stdout.split()
    assert kind == "InputError" and int(grown) < 200 << 10, told.stdout  # kB


def test_what_is_packed_twice_is_refused(tmp_path: Path) -> None:
    folder = bomb(tmp_path / "lab", 0, compression="lzf")
    made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    made.set_chunk((1000,))
    made.set_deflate(9)
    made.set_deflate(9)
    with h5py.File(folder / "dark.h5", "r+") as file:
        del file["time"]
        space = h5py.h5s.create_simple((1000,))
        h5py.h5d.create(file.id, b"time", h5py.h5t.NATIVE_UINT32, space, made)
        file["time"][:] = np.arange(1000)
    with pytest.raises(InputError, match="time is packed 2 times over"):
        measurement.open(folder).recording("dark")


@settings(max_examples=60, deadline=None)
@given(st.binary(min_size=1, max_size=60), st.integers(1, 300), st.booleans())
def test_the_size_of_what_lzf_packs_is_counted(some: bytes, times: int, summed: bool) -> None:
    data = np.frombuffer(some * times, np.uint8)
    with h5py.File("x", "w", driver="core", backing_store=False) as file:
        made = file.create_dataset("a", data.shape, np.uint8, chunks=data.shape, compression="lzf", fletcher32=summed)
        made[:] = data
        skipped, raw = made.id.read_direct_chunk((0,))
    if not skipped:
        assert capture_files._unpacked(raw[: len(raw) - 4 * summed], 32000, data.size) == data.size


# --- memory ---------------------------------------------------------------------------------------------------------

STAMPS = 1 << 20  # detections, of 4 bytes each where they lie in memory


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A measurement of so many detections in the order of time, of 4 pixels."""
    folder = tmp_path_factory.mktemp("many")
    (folder / "measurement.yaml").write_text(CAPTURES.replace("EXPOSURE", "1 s"))
    with h5py.File(folder / "dark.h5", "w") as file:
        file.attrs["tick"] = 1e-9
        rng = np.random.Generator(np.random.PCG64(1))
        file.create_dataset("time", data=np.sort(rng.integers(0, 10**9, STAMPS, np.uint32)), chunks=(1 << 12,))
        file.create_dataset("pixel", data=rng.integers(0, 4, STAMPS, np.uint16), chunks=(1 << 12,))
    return folder


def _exported(format: str) -> Callable[[Path, Path], object]:
    suffix = exporters.Target.every[format].suffix
    return lambda lab, out: exporters.export(measurement.open(lab), out / f"a{suffix}", format)


def _imported(lab: Path, out: Path) -> object:
    return import_files([lab / "dark.h5"], out / "made", Said(exposure=1.0), [light("dark")])


def _looked(lab: Path, out: Path) -> object:
    return report.looks(measurement.open(lab), True)


def _gaps(lab: Path, out: Path) -> object:
    return Gaps().reduce(measurement.open(lab).recording("dark"))


DONE: dict[str, Callable[[Path, Path], object]] = {
    "read": lambda lab, out: measurement.open(lab).recording("dark"),
    "inspect": _looked,
    "gaps": _gaps,
    "import": _imported,
    **{f"export {format}": _exported(format) for format in ("hdf5", "npz", "photon-hdf5")},
}


@pytest.mark.slow
@pytest.mark.parametrize("what", DONE)
def test_a_detection_costs_its_stamp(what: str, many: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Counted by tracemalloc, what numpy takes and a little more; the same was done once before, to compile kernels.

    Pieces are small here, so that what grows with the number of detections shows: 4 bytes and less than one.
    """
    for module in (capture_files, exporters, detections, look):
        monkeypatch.setattr(module, "_PIECE", 1 << 12)
    monkeypatch.setattr(detections, "_KEPT", 0)
    monkeypatch.setattr(events, "_BINS", 1 << 14)
    places = tmp_path / "first", tmp_path / "second"
    for place in places:
        place.mkdir()
    DONE[what](many, places[0])
    tracemalloc.start()
    DONE[what](many, places[1])
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 4.9 * STAMPS, most / STAMPS


def stamped(bursts: bool = False, positions: bool = False) -> Recording:
    """6,000 detections of 35 pixels in 4 ms, a third of them in 300 ns."""
    rng = np.random.Generator(np.random.PCG64(3))
    pixels, exposure, tick = 35, 4e-3, 1e-9
    places = rng.random((pixels, 2)) * 1e-4 if positions else None
    layout = Layout(1, pixels, 1.0, 1.0, places) if positions else Layout(7, 5, 1.0, 1.0)
    stamps, pixel = rng.integers(0, 4_000_000, 6000), rng.integers(0, pixels, 6000)
    if bursts:
        stamps[:2000] = rng.integers(1_000_000, 1_000_300, 2000)
    rows = np.concatenate([[0], np.cumsum(np.bincount(pixel, minlength=pixels))])
    ticks = stamps[np.lexsort((stamps, pixel))].astype(np.uint32)
    capture = Capture("a", "tr", Light(500e-9, 1.0), Conditions(exposure, 1, exposure, exposure, 500e-9))
    return Recording(capture, layout, Events(None, rows, pixels, ticks, tick, end=exposure), None, tick, 20e-9)


@pytest.mark.parametrize("positions", [False, True])
@pytest.mark.parametrize("bursts", [False, True])
def test_detections_piece_by_piece_are_reduced_alike(
    bursts: bool, positions: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By every statistic, whatever the pieces."""
    recording = stamped(bursts, positions)
    kinds = [kind for kind in statistics_for(recording.capture) if type(kind).__module__.startswith("spadmnist.")]
    whole = [kind.reduce(recording) for kind in kinds]
    monkeypatch.setattr(_order, "_MOST_HELD", 0)
    monkeypatch.setattr(_order, "_AT_ONCE", 64)
    for piece in (100, 1500):
        monkeypatch.setattr(_order, "_PIECE", piece)
        fresh = replace(recording, _kept={})
        for kind, before in zip(kinds, whole, strict=True):
            after = kind.reduce(fresh)
            assert (before is None) == (after is None), kind.name
            assert before is None or np.array_equal(before.values, after.values, equal_nan=True), kind.name


def test_a_summary_holds_no_recording() -> None:
    recording = stamped()
    held = [kind.reduce(recording) for kind in statistics_for(recording.capture)]
    there = weakref.ref(recording)
    del recording
    gc.collect()
    assert there() is None and len(held) > 10


def test_the_stamps_of_an_image_in_parts_are_held_once() -> None:
    pixels, each = 32, 1 << 15

    def parts() -> Iterator[Recorded]:
        for k in range(pixels):
            ticks = np.arange(k, k + each, dtype=np.uint32)
            yield Recorded(1, Events(None, np.array([0, each]), 1, ticks, 1e-9), np.array([each]), np.array([1.0]))

    Recorded.joined_pixels(parts(), pixels)
    tracemalloc.start()
    made = Recorded.joined_pixels(parts(), pixels).tr
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert made is not None and made.ticks is not None and len(made) == made.ticks.size == pixels * each
    assert (made.ticks.reshape(pixels, each)[:, 0] == np.arange(pixels)).all() and made.ticks.dtype == np.uint32
    assert most < 1.2 * made.ticks.nbytes, most / made.ticks.nbytes


def test_more_detections_than_can_be_held_are_refused(many: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capture_files, "MOST_STAMPS", 4 * STAMPS - 4)
    with pytest.raises(InputError, match=r"dark\.h5: has 1,048,576 detections, which take 4 MB .* cut the recording"):
        measurement.open(many)
    with pytest.raises(InputError, match=r"dark\.h5: has 1,048,576 detections, which take 4 MB"):
        _imported(many, many / "out")


# --- configs ------------------------------------------------------------------------------------------------------

SENSOR = """sensor:
  name: large
  rules: device
  layout: {rows: 8, columns: 8, pixel_area: 25 um^2}
  effects:
    detection: {pdp: 0.5}
    dead_time: {duration: 50 ns}
    tdc: {resolution: 10 ps}
"""


def refused(folder: Path, *changes: tuple[str, str], more: str = "") -> str:
    text = SENSOR
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "sensor.yaml").write_text(text + more)
    with pytest.raises(ConfigError) as error:
        config.read_sensor(folder / "sensor.yaml")
    (problem,) = error.value.problems
    return problem


def test_a_sensor_of_too_many_pixels_is_refused(tmp_path: Path) -> None:
    said = refused(tmp_path, ("rows: 8, columns: 8", "rows: 10000, columns: 10000"))
    assert "sensor.yaml:4: sensor.layout: 10000 x 10000 pixels are more than the 16,777,216" in said


def test_neighbours_are_looked_for_within_the_array(tmp_path: Path) -> None:
    near, far = (Layout(8, 5, 1.0, 1.0).neighbours(reach) for reach in (20.0, 1e9))
    assert np.array_equal(near.step, far.step) and len(near.step) == 15 * 9 - 1
    said = refused(
        tmp_path,
        ("rows: 8, columns: 8", "rows: 4000, columns: 4000"),
        more="    crosstalk: {probability: 0.01 %, reach: 1000000}\n",
    )
    assert "sensor.effects" in said and "63,984,001 neighbours, more than the 16,777,216" in said
    places = np.stack([np.arange(6000.0), np.zeros(6000)], axis=1)
    with pytest.raises(InputError, match=r"35,994,000|36,000,000"):
        Layout(1, 6000, 1.0, 1.0, places).neighbours(1e6)


@pytest.mark.parametrize("probability", ["20 %", "100 %"])
def test_a_cascade_without_end_is_refused(tmp_path: Path, probability: str) -> None:
    said = refused(tmp_path, more=f"    crosstalk: {{probability: {probability}, diagonal_ratio: 1}}\n")
    assert "sensor.yaml:9: sensor.effects.crosstalk: " in said and "a cascade never ends" in said
    # what the paper's rules cause goes no further
    paper = SENSOR.replace("device", "paper") + f"    crosstalk: {{probability: {probability}, diagonal_ratio: 1}}\n"
    (tmp_path / "paper.yaml").write_text(paper)
    config.read_sensor(tmp_path / "paper.yaml")


@pytest.mark.parametrize(
    ("effect", "value"), [("readout_loss: {queue: 2.5}", "not 2.5"), ("short_gate: {fraction: 0}", "more than 0")]
)
def test_what_an_effect_refuses_is_said_at_its_line_without_a_place_in_the_program(
    tmp_path: Path, effect: str, value: str
) -> None:
    said = refused(tmp_path, more=f"    {effect}\n")
    name = effect.partition(":")[0]
    assert f"sensor.yaml:9: sensor.effects.{name}: the effect {name}: " in said and value in said
    assert ".py" not in said and "Error" not in said


def test_a_map_is_compared_before_it_is_read(tmp_path: Path) -> None:
    """10^12 entries are declared, and the file is as long as that, with nothing in it."""
    with open(tmp_path / "map.npy", "wb") as file:
        np.lib.format.write_array_header_1_0(file, {"shape": (10**6, 10**6), "fortran_order": False, "descr": "<f8"})
        file.truncate(file.tell() + 8 * 10**12)
    said = refused(tmp_path, more="    dark_counts: {rate: {file: map.npy}}\n")
    assert "sensor.yaml:9: sensor.effects.dark_counts.rate: " in said and "(1000000, 1000000)" in said


def test_levels_are_not_compared_with_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    many, asked = 500, []
    folder = Level.folder.fget  # type: ignore[attr-defined]
    monkeypatch.setattr(Level, "folder", property(lambda level: asked.append(level) or folder(level)))
    levels = ", ".join(f"{i + 1} mlux" for i in range(many))
    (tmp_path / "many.yaml").write_text(
        f"seed: 1\nscene: {{images: {{source: uniform, grey: 255}}, lux: [{levels}]}}\n"
        "recording: {exposure: 1 us, readouts: [tr]}\n" + SENSOR
    )
    assert len(config.read(tmp_path / "many.yaml").levels) == many and len(asked) <= 2 * many
    text = (tmp_path / "many.yaml").read_text()
    (tmp_path / "many.yaml").write_text(text.replace("[1 mlux, 2 mlux", "[1 mlux, 1000 ulux"))
    with pytest.raises(ConfigError, match=r"scene\.lux\[1\]: 1000 ulux is the level 1 mlux again; list it once"):
        config.read(tmp_path / "many.yaml")


@pytest.mark.parametrize("encoding", store.Encoding.every.values(), ids=str)
def test_every_file_has_its_shard(encoding: store.Encoding) -> None:
    shards = [Shard("5 mlux", folder, split, k, 0, 1) for folder in ("a", "ab") for split in ("x", "y") for k in (0, 1)]
    files: Files = {name: {} for name in ("spadmnist.yaml", "data.zarr/zarr.json", "data.zarr/a/zarr.json")}
    for shard in shards:
        place = encoding.location(shard.path)
        names = [place] if encoding.one_file else [f"{place}/zarr.json", f"{place}/tr/c.0"]
        files |= {name: {} for name in names}
    found = shard_plan.files_by_shard(files, encoding)
    for shard in shards:
        place = encoding.location(shard.path)
        assert list(found[place]) == [n for n in files if n == place or n.startswith(f"{place}/")]
        assert found[place]


def test_what_does_not_fit_into_memory_is_refused_alike_before_and_in_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = write_config(tmp_path / "small.yaml", "zarr", ("5 mlux",), train=40, test=6)
    experiment = config.read(file)
    images = experiment.load_images(None)
    each = plan.estimate(experiment, images, 2)["memory_per_worker"]
    for there, jobs, do in ((each * 3 // 2, 2, "give --jobs 1"), (each // 2, 1, "lower the frames")):
        monkeypatch.setattr(system, "memory", lambda there=there: there)
        said = []
        for act in (
            lambda jobs=jobs: plan.estimate(experiment, images, jobs),
            lambda jobs=jobs: factory.generate(experiment, images, tmp_path / "out", jobs),
        ):
            with pytest.raises(InputError, match=do) as error:
                act()
            said.append(str(error.value))
        assert said[0] == said[1] and not (tmp_path / "out").exists()
    monkeypatch.setattr(system, "memory", lambda: each)
    assert plan.estimate(experiment, images, 1)["memory_per_worker"] == each


def test_the_limit_of_a_process_is_what_is_there() -> None:
    limit = 3 << 30
    program = (
        f"import resource\nfrom spadmnist import system\nresource.setrlimit(resource.RLIMIT_AS, ({limit}, {limit}))\n"
        "print(system.memory())\n"
    )
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert 0 < int(told) <= limit


# --- files of other programs --------------------------------------------------------------------------------------


def test_an_archive_that_is_read_whole_is_small(tmp_path: Path) -> None:
    file = tmp_path / "a.npz"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("frames.npy", "w") as member:
        header = {"shape": (300, 1024, 1024), "fortran_order": False, "descr": "|u1"}
        np.lib.format.write_array_header_1_0(member, header)
        for _ in range(300):
            member.write(bytes(1 << 20))
    assert file.stat().st_size < 1 << 20
    with pytest.raises(InputError, match=r"a\.npz: unpacks to 314,572,928 bytes, more than the 268,435,456"):
        Npz.read(file, Said())


def test_a_page_unpacks_to_no_more_than_it_has(tmp_path: Path) -> None:
    tifffile = pytest.importorskip("tifffile", reason="tifffile is not installed")
    packer = zlib.compressobj(9)
    zeros = bytes(1 << 20)
    packed = b"".join(packer.compress(zeros) for _ in range(300)) + packer.flush()
    for name, data in (("bomb.tif", packed), ("whole.tif", zlib.compress(bytes(64)))):
        tags = [(256, 4, 8), (257, 4, 8), (258, 3, 8), (259, 3, 8), (262, 3, 1), (273, 4, 0), (277, 3, 1), (278, 4, 8)]
        tags.append((279, 4, len(data)))
        at = 8 + 2 + 12 * len(tags) + 4
        with open(tmp_path / name, "wb") as file:
            file.write(b"II*\0" + struct.pack("<IH", 8, len(tags)))
            for tag, kind, value in tags:
                file.write(struct.pack("<HHII", tag, kind, 1, at if tag == 273 else value))
            file.write(struct.pack("<I", 0) + data)
        assert tifffile.TiffFile(tmp_path / name).pages[0].shape == (8, 8)
    with pytest.raises(InputError, match=r"bomb\.tif: a page unpacks to more than its 64 bytes"):
        Tif.read(tmp_path / "bomb.tif", Said()).frames[0:1]  # type: ignore[index]
    assert not Tif.read(tmp_path / "whole.tif", Said()).frames[0:1].any()  # type: ignore[index]
