"""Measurements: what is read is what is in the files, what cannot be read is told, and what is written comes back."""

from __future__ import annotations

import contextlib
import itertools
import json
import random
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import laws
import numpy as np
import pytest
from click.testing import CliRunner

import spadmnist
import spadmnist.cli as command_line
from spadmnist import capture_files, config, document, factory, look, measurement, report, twin
from spadmnist.cli import cli, main
from spadmnist.criticism import compare
from spadmnist.effects import Conditions
from spadmnist.effects.dark_counts import DarkCounts
from spadmnist.effects.dead_time import DeadTime
from spadmnist.effects.detection import Detection
from spadmnist.effects.flicker import Flicker
from spadmnist.effects.short_gate import ShortGate
from spadmnist.effects.tdc import Tdc
from spadmnist.errors import ConfigError, InputError, SpadError
from spadmnist.events import Layout
from spadmnist.measurement import Measurement
from spadmnist.plugins import ByWavelength
from spadmnist.recording import Capture, Light, Recording
from spadmnist.sensor import Sensor
from spadmnist.streams import Streams

CHALLENGE = Path(__file__).parents[2] / "shared" / "challenge"
CASES = sorted(p.name for p in CHALLENGE.glob("open-*") if p.is_dir())

FORMAT = "format: spadmnist-measurement/1"
TR = "{id: a, file: a.h5, modality: tr, light: {kind: dark}, exposure: 1 ms}"
QIS = "{id: a, file: a.h5, modality: qis, light: {kind: dark}, frames: 20, frame_time: 10 us}"
STR = "{id: a, file: a.h5, modality: str, light: {kind: dark}, frames: 20, frame_time: 10 us}"
COUNTS = "{id: a, file: a.h5, modality: counts, light: {kind: dark}, frames: 20, frame_time: 10 us}"
TICK = 1e-9


def described(folder: Path, *captures: str, layout: str = "{rows: 3, columns: 10}", name: str = "lab") -> Path:
    """A folder with a `measurement.yaml`."""
    listed = "".join(f"  - {capture}\n" for capture in captures)
    (folder / "measurement.yaml").write_text(f"{FORMAT}\nname: {name}\nlayout: {layout}\ncaptures:\n{listed}")
    return folder


def stored(path: Path, attributes: dict[str, Any] | None = None, **data: np.ndarray) -> Path:
    """An HDF5 file as a lab would write it."""
    with h5py.File(path, "w") as file:
        for name, values in data.items():
            file.create_dataset(name, data=values)
        file.attrs.update(attributes or {})
    return path


def events(n: int = 500, pixels: int = 30, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """(ticks, pixels) in time order, a million ticks at most."""
    rng = np.random.Generator(np.random.PCG64(seed))
    return np.sort(rng.integers(0, 10**6, n)).astype(np.uint64), rng.integers(0, pixels, n).astype(np.uint16)


def bits(frames: int = 20, rows: int = 3, columns: int = 10, seed: int = 1) -> np.ndarray:
    rng = np.random.Generator(np.random.PCG64(seed))
    return (rng.random((frames, rows, columns)) < 0.3).astype(np.uint8)


def refused(call: Callable[[], object], *words: str) -> str:
    """The one sentence of an InputError, which has these words."""
    with pytest.raises(InputError) as caught:
        call()
    text = str(caught.value)
    assert "\n" not in text and len(text) < 600, text
    for word in words:
        assert word in text, text
    return text


# --- the measurements of the challenge ----------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
def test_the_challenge_is_read_as_a_few_lines_of_h5py_read_it(case: str) -> None:
    opened = measurement.open(CHALLENGE / case)
    sensor = config.read_sensor(CHALLENGE / case / "sensor.yaml")
    assert opened.name == case and opened.layout.shape == sensor.layout.shape
    for capture in opened.captures:
        recorded = opened.recording(capture.id, sensor)
        assert recorded.dead_time == sensor.nominal_dead_time and not opened.notes[capture.id]
        with h5py.File(CHALLENGE / case / f"{capture.id}.h5") as file:
            if capture.modality == "tr":
                time, pixel = file["time"][:], file["pixel"][:]
                order = np.argsort(pixel, kind="stable")
                assert recorded.events is not None and recorded.tick == 1e-10
                assert np.array_equal(recorded.events.ticks, time[order])
                assert np.array_equal(recorded.totals, np.bincount(pixel, minlength=recorded.pixels))
                continue
            frames = file["frames"][:]
        assert recorded.n_frames == capture.conditions.frames == len(frames)
        dense = frames < recorded.none
        if capture.modality == "qis":
            dense = np.unpackbits(frames, axis=2, count=recorded.layout.columns)
        assert np.array_equal(recorded.totals, dense.sum(axis=0, dtype=np.int64).ravel())
        assert np.array_equal(np.concatenate([part for _, part in recorded.chunks()]), frames)


@pytest.mark.skipif(not CASES, reason="the challenge is not at hand")
def test_light_and_clock_of_the_challenge() -> None:
    opened = measurement.open(CHALLENGE / "open-tr-null" / "measurement.yaml")
    capture = opened.capture("flat-20k")
    assert capture.light == Light(500e-9, 0.000756741, "irradiance", 0.015, 0.0)
    assert capture.conditions == Conditions(0.06, 1, 0.06, 0.06, 500e-9)
    assert opened.capture("dark").light.dark and opened.capture("dark").conditions.dark
    framed = measurement.open(CHALLENGE / "open-str-null").capture("flat-low").conditions
    assert framed == Conditions(4000 * 10e-6, 4000, 10e-6, 10e-6, 500e-9)


# --- measurement.yaml ---------------------------------------------------------------------------------------------


def test_every_mistake_is_told_at_once_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "measurement.yaml").write_text(
        """format: spadmnist-measurement/2
naem: x
layout: {rows: 0, columns: 16}
captures:
  - id: dark
    file: ../dark.h5
    modality: qsi
    light: {kind: dark, wavelength: 500 nm}
    exposure: 100
  - id: dark
    file: b.h5
    modality: qis
    light: {kind: flat, irradiance: 5 mlux, relative_uncertainty: 3}
    frames: 10
    frame_tme: 10 us
    exposre: 1 ms
  - id: c
    modality: tr
    light: {kind: flat, wavelength: 500 nm, irradiance: 1 nW/cm^2, lux: 1 lux}
    exposure: -1 ms
    frames: 10
  - 7
"""
    )
    with pytest.raises(ConfigError) as caught:
        measurement.open(tmp_path)
    problems = [p.removeprefix(f"{tmp_path}/") for p in caught.value.problems]
    expected = [
        ":1: format: 'spadmnist-measurement/2' is not a format that this program reads",
        ":2: naem is not an entry here. Did you mean name?",
        ":3: layout.rows: 0 is not possible",
        ":6: captures[0].file: '../dark.h5' leads out of the measurement's folder",
        ":7: captures[0].modality: 'qsi' is not one of tr, str, qis, counts. Did you mean qis?",
        ":8: captures[0].light.wavelength: belongs to light, and this capture is dark",
        ":10: captures[1].id: dark is that of captures[0]",
        ":13: captures[1].light.irradiance: '5 mlux' is not an irradiance",
        ":13: captures[1].light.relative_uncertainty: 3 is not possible",
        ":13: captures[1].light: wavelength is missing",
        ":15: captures[1].frame_tme is not an entry of a capture. Did you mean frame_time?",
        ":16: captures[1].exposre is not an entry of a capture. Did you mean exposure?",
        ":10: captures[1]: frame_time is missing; write for example frame_time: 10 us",
        ":17: captures[2]: has neither file nor mean",
        ":19: captures[2].light: has both irradiance and lux",
        ":20: captures[2].exposure: -1 ms is not possible",
        ":21: captures[2].frames: belongs to frames; a tr capture has an exposure",
        ":22: captures[3]: 7 is not possible; it must be a group of entries",
    ]
    for one in expected:
        assert any(p.startswith(f"measurement.yaml{one}") for p in problems), one
    assert len(problems) == len(expected), problems


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("seed: 1\nscene: {}\n", "is not a measurement; it begins with format"),
        ("[1, 2]\n", "is not a measurement"),
        (f"{FORMAT}\nlayout: {{rows: 1, columns: 1}}\ncaptures: []\n", "a list with at least one capture"),
        (f"{FORMAT}\nlayout: {{rows: 1}}\ncaptures: [{TR}]\n", "columns is missing"),
        (f"{FORMAT}\nlayout: {{rows: 90000, columns: 90000}}\ncaptures: [{TR}]\n", "more than the 16,777,216"),
        (f"{FORMAT}\nlayout: {{positions: /etc/passwd}}\ncaptures: [{TR}]\n", "leads out of"),
        (f"{FORMAT}\nlayout: {{rows: 1, columns: 1}}\ncaptures:\n  - &x {TR}\n  - *x\n", "aliases"),
        (f"{FORMAT}\nname: 7\nlayout: {{rows: 1, columns: 1}}\ncaptures: [{TR}]\n", 'write "7"'),
    ],
)
def test_what_is_no_measurement(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "measurement.yaml").write_text(text)
    with pytest.raises(ConfigError, match=words.replace("[", r"\[")) as caught:
        measurement.open(tmp_path)
    assert len(caught.value.problems) == 1


@pytest.mark.parametrize("name", ["/etc/passwd", "../a.h5", "x/../../a.h5", "C:a.h5", "..\\a.h5", "", "a\nb.h5"])
def test_a_file_stays_in_the_folder(tmp_path: Path, name: str) -> None:
    described(tmp_path, TR.replace("a.h5", json.dumps(name)))
    with pytest.raises(ConfigError, match=r"captures\[0\]\.file"):
        measurement.open(tmp_path)


def test_a_link_out_of_the_folder_is_not_followed(tmp_path: Path) -> None:
    time, pixel = events()
    stored(tmp_path / "outside.h5", {"tick": TICK}, time=time, pixel=pixel)
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "a.h5").symlink_to(tmp_path / "outside.h5")
    with pytest.raises(ConfigError, match="link that leads out"):
        measurement.open(described(tmp_path / "lab", TR))
    (tmp_path / "lab" / "a.h5").unlink()
    (tmp_path / "lab" / "raw").mkdir()
    (tmp_path / "outside.h5").rename(tmp_path / "lab" / "raw" / "b.h5")
    (tmp_path / "lab" / "a.h5").symlink_to(tmp_path / "lab" / "raw" / "b.h5")
    measurement.open(tmp_path / "lab")


def test_free_levels_lux_means_and_uncertainties(tmp_path: Path) -> None:
    opened = measurement.open(
        described(
            tmp_path,
            "{id: free, mean: 470, modality: qis, light: {kind: flat, wavelength: 700 nm}, frames: 1000,"
            " frame_time: 1 us, frame_period: 2 us, exposure: 2 ms}",
            "{id: lux, mean: 0, modality: tr, light: {kind: flat, lux: 5 mlux, relative_uncertainty: 2 %,"
            " own_uncertainty: 0.01}, exposure: 1 s}",
            "{id: counts, mean: 3.5, modality: counts, light: {kind: dark, relative_uncertainty: 0.1}, frames: 30,"
            " frame_time: 1 us, bits: 4}",
        )
    )
    free, lux, counts = opened.captures
    assert free.mean == 470 and free.light.level is None and free.light.wavelength == 700e-9
    assert free.conditions.frame_period == 2e-6 and free.conditions.exposure == 2e-3
    assert lux.light == Light(555e-9, 5e-3, "lux", 0.02, 0.01) and lux.mean == 0
    assert counts.conditions.bits == 4 and counts.conditions.count_frames == 2
    refused(lambda: opened.recording("free"), "only the mean is known")
    refused(lambda: opened.recording("fre"), "Did you mean free?")
    refused(lambda: opened.recording("free", Layout(4, 10, 1e-12, 1.0)), "3 x 10", "4 x 10")


def test_an_exposure_of_frames_must_be_their_sum(tmp_path: Path) -> None:
    described(tmp_path, QIS.replace("frames: 20", "exposure: 1 s, frames: 20"))
    with pytest.raises(ConfigError, match="not frames x frame_period, 200 us"):
        measurement.open(tmp_path)


def test_positions_count_as_one_row(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("x,y\n0,0\n10,0\n5,8.66\n")
    time, pixel = events(pixels=3)
    stored(tmp_path / "a.h5", {"tick": TICK}, time=time, pixel=pixel)
    opened = measurement.open(described(tmp_path, TR, layout="{positions: p.csv}"))
    assert (opened.rows, opened.columns) == (1, 3)
    assert opened.recording("a").layout.neighbours(1).first is not None
    other = Layout(1, 3, 1e-12, 1.0, np.array([[0, 0], [1e-5, 0], [2e-5, 0]]))
    refused(lambda: opened.recording("a", other), "positions are not those of the sensor")
    with pytest.raises(ConfigError, match="3 positions count as 1 x 3, not as 3 x 1"):
        measurement.open(described(tmp_path, TR, layout="{positions: p.csv, rows: 3, columns: 1}"))


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
    "bomb of 2^40": ({"time": declared((2**40,)), "pixel": declared((2**40,))}, ("1,099,511,627,776", "8 GiB")),
    "bomb of 1 GiB": ({"time": declared((2**27,)), "pixel": declared((2**27,))}, ("not all of them were written",)),
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
        ("chunks of more than 256 MiB",),
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
    refused(lambda: measurement.open(tmp_path), "a.h5: no such file")
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


def test_two_runs_cannot_write_to_one_place(tmp_path: Path) -> None:
    sensor = device()

    def second() -> Iterator[Recording | Capture]:
        with pytest.raises(SpadError, match="another run is writing there"):
            measurement.write(tmp_path / "out", "lab", sensor.layout, recordings(sensor))
        yield from recordings(sensor, CAPTURES[:1])

    measurement.write(tmp_path / "out", "lab", sensor.layout, second())


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


# --- writing ------------------------------------------------------------------------------------------------------


def device(*more: Any, rows: int = 4, columns: int = 10, resolution: float = 1e-9) -> Sensor:
    effects = [Detection(pdp=0.4), DarkCounts(rate=1000.0), DeadTime(duration=50e-9), *more]
    if resolution:
        effects.append(Tdc(resolution=resolution))
    return Sensor(Layout(rows, columns, 25e-12, 1.0), effects, "device", name="test").settled()


def one(modality: str, frames: int = 300, level: float | None = 0.01, **more: Any) -> Capture:
    lit = Light() if level is None else Light(500e-9, level, "irradiance", 0.015, 0.002)
    conditions = Conditions(frames * 12e-6, frames, 10e-6, 12e-6, lit.wavelength, **more)
    if modality == "tr":
        conditions = Conditions(3e-3, 1, 3e-3, 3e-3, lit.wavelength)
    return Capture(f"{modality} {'dark' if level is None else 'flat'}", modality, lit, conditions)


CAPTURES = (
    one("tr"),
    one("tr", level=None),
    one("qis"),
    one("str"),
    one("counts", bits=4, counting="frames"),
    replace(one("counts", bits=3, counting="counter"), id="counter"),
    replace(one("qis"), id="mean of qis", mean=17.25),
    replace(one("counts", bits=4, counting="frames"), id="mean: counts", mean=3.0),
)


def recordings(
    sensor: Sensor, captures: tuple[Capture, ...] = CAPTURES, seed: int = 1
) -> Iterator[Recording | Capture]:
    images = np.zeros(1, np.uint64)
    for capture in captures:
        flux = twin.photons_at(capture, sensor.layout)
        assert flux is not None
        streams = Streams(seed, f"capture/{capture.id}", "simulate", images)
        made = twin.model_recordings(sensor, capture, flux, streams, images)[0]
        yield made if capture.mean is None else capture


def tree(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def assert_same_data(a: Recording, b: Recording) -> None:
    assert a.capture == b.capture and a.tick == b.tick and a.dead_time == b.dead_time
    if a.events is not None:
        assert b.events is not None and np.array_equal(a.events.offsets, b.events.offsets)
        assert np.array_equal(a.events.ticks, b.events.ticks) and a.events.ticks.dtype == b.events.ticks.dtype  # type: ignore[union-attr]
        return
    first, second = (np.concatenate([part for _, part in r.chunks()]) for r in (a, b))
    assert first.dtype == second.dtype and np.array_equal(first, second)
    assert np.array_equal(a.totals, b.totals)


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
from test_measurement import Noise, measurement, SpadError
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
    sensor = Sensor(Layout(1, 3, 25e-12, 1.0, places), effects, "device").settled()
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


# --- the model's twin ---------------------------------------------------------------------------------------------


@pytest.mark.skipif(not CASES, reason="the challenge is not at hand")
def test_the_twin_of_the_challenge_has_the_rates_of_the_model_and_of_the_data(tmp_path: Path) -> None:
    folder = CHALLENGE / "open-tr-null"
    sensor = config.read_sensor(folder / "sensor.yaml")
    opened = measurement.open(folder)
    twin.simulate(sensor, opened, tmp_path / "twin", seed=4)
    made = measurement.open(tmp_path / "twin")
    assert made.captures == opened.captures and made.name == opened.name
    for capture in opened.captures:
        flux = twin.photons_at(capture, sensor.layout)
        expected = float(sensor.expected(np.full((1, 256), flux), capture.conditions)[1].sum())
        total = int(made.recording(capture.id, sensor).totals.sum())
        measured = int(opened.recording(capture.id, sensor).totals.sum())
        # a cluster of afterpulses adds to the scatter, a dead time takes from it; the closed form is good to 1e-3
        bound = 5 * np.sqrt(1.02 * expected) + 1e-3 * expected
        assert abs(total - expected) < bound < abs(total - 1.05 * expected), capture.id
        light = 0 if capture.light.dark else 5 * 0.015
        assert abs(measured / total - 1) < light + 5 * np.sqrt(2 / total), capture.id


def test_the_twin_is_a_function_of_sensor_capture_and_seed() -> None:
    sensor = device()
    all_of_them = {r.capture.id: r for r in recordings(sensor) if isinstance(r, Recording)}
    (alone,) = recordings(sensor, CAPTURES[3:4])
    assert isinstance(alone, Recording)
    assert_same_data(all_of_them[alone.capture.id], alone)
    (other,) = recordings(sensor, CAPTURES[3:4], seed=2)
    assert isinstance(other, Recording) and not np.array_equal(other.totals, alone.totals)


def test_many_recordings_are_those_made_one_by_one() -> None:
    sensor = device()
    for capture in CAPTURES[:5]:
        images = np.arange(3, 7, dtype=np.uint64)
        streams = Streams(9, "x", "model", images)
        flux = np.array([1e5, 2e5, 3e5, 0.0])
        many = twin.model_recordings(sensor, capture, flux, streams, images)
        assert [r.totals.sum() > 3000 for r in many] == [True] * 3 + [False]
        for i in range(len(images)):
            (alone,) = twin.model_recordings(sensor, capture, float(flux[i]), streams, images[i : i + 1])
            assert_same_data(many[i], alone)
        assert twin.model_recordings(sensor, capture, 1.0, streams, images[:0]) == []


def large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take every capture for one that is simulated in parts."""
    monkeypatch.setattr(twin, "_AT_ONCE", 2000.0)


def ones_of(sensor: Sensor, capture: Capture, flux: float, seed: int) -> np.ndarray:
    images = np.zeros(1, np.uint64)
    (made,) = twin.model_recordings(sensor, capture, flux, Streams(seed, "x", "model", images), images)
    return np.concatenate([part for _, part in made.chunks()])


@pytest.mark.parametrize("flux", [2e3, 1e5, 4e5])
def test_bits_drawn_by_themselves_follow_the_sensors_law(monkeypatch: pytest.MonkeyPatch, flux: float) -> None:
    """The same share of ones, over frames and pixels, sparse or dense; a light of 5 % more is noticed."""
    sensor, capture = device(), one("qis", frames=3001)
    whole = [ones_of(sensor, capture, flux, seed) for seed in (1, 2, 3)]
    large(monkeypatch)
    parts = [ones_of(sensor, capture, flux, seed) for seed in (4, 5, 6)]
    assert not parts[0][:, :, 1:].astype(int).__and__(0x3F).any()  # nothing beyond the ten columns
    trials = 3 * 3001 * 40

    def ones(found: list[np.ndarray]) -> int:
        return int(sum(np.bitwise_count(f).sum() for f in found))

    laws.same_share(ones(whole), trials, ones(parts), trials)
    laws.share_is(ones(parts), trials, -np.expm1(-(0.4 * flux + 1000) * 10e-6))
    per_frame = [np.bitwise_count(f).sum(axis=(1, 2), dtype=int) for f in parts]
    laws.same_histogram(
        np.concatenate(per_frame), np.concatenate([np.bitwise_count(f).sum((1, 2), int) for f in whole])
    )
    wrong = [ones_of(sensor, capture, flux * 1.05, seed) for seed in (4, 5, 6)]
    if flux > 1e4:
        with pytest.raises(AssertionError):
            laws.same_share(ones(whole), trials, ones(wrong), trials)


@pytest.mark.parametrize("modality", ["qis", "str", "counts", "counter"])
def test_stretches_of_frames_follow_the_sensors_law(monkeypatch: pytest.MonkeyPatch, modality: str) -> None:
    sensor = device(ShortGate(fraction=0.6, offset=1e-6))
    capture = one("counts", 3000, bits=3, counting="counter") if modality == "counter" else one(modality, 3000)
    if modality == "counts":
        capture = one("counts", 2996, bits=3, counting="frames")
    whole = ones_of(sensor, capture, 1e5, 1)
    large(monkeypatch)
    called: list[int] = []
    original = twin._by_stretches
    monkeypatch.setattr(twin, "_by_stretches", lambda *a: called.append(a[4]) or original(*a))
    parts = ones_of(sensor, capture, 1e5, 2)
    assert called and called[0] < capture.conditions.frames / 5 and parts.shape == whole.shape
    if modality == "qis":
        whole, parts = (np.unpackbits(x, axis=2, count=10) for x in (whole, parts))
    bins = 100 if modality == "str" else 1
    laws.same_histogram(parts.ravel() // bins, whole.ravel() // bins)
    for half in (parts[: len(parts) // 2], parts[len(parts) // 2 :]):
        laws.same_histogram(half.ravel() // bins, whole.ravel() // bins)
    wrong = ones_of(device(ShortGate(fraction=0.68, offset=1e-6)), capture, 1e5, 2)  # seen to fail
    wrong = np.unpackbits(wrong, axis=2, count=10) if modality == "qis" else wrong
    with pytest.raises(AssertionError):
        laws.same_histogram(wrong.ravel() // bins, whole.ravel() // bins)


def test_frames_that_depend_on_each_other_are_not_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    capture = one("qis", 3000)
    assert twin._in_parts(device(), capture, 1e5) is not None
    assert twin._in_parts(device(Flicker(amplitude=0.1, frequency=100.0)), capture, 1e5) is None
    assert twin._in_parts(device(), one("tr"), 1e5) is None
    large(monkeypatch)
    monkeypatch.setattr(twin, "_MOST_AT_ONCE", 3000.0)
    images = np.zeros(1, np.uint64)
    streams = Streams(1, "x", "model", images)
    refused(lambda: twin.model_recordings(device(), one("tr"), 1e6, streams, images), "would hold", "shorten it")


def test_a_twin_needs_the_same_pixels_and_a_level(tmp_path: Path) -> None:
    free = "{id: a, mean: 2, modality: qis, light: {kind: flat, wavelength: 500 nm}, frames: 20, frame_time: 10 us}"
    opened = measurement.open(described(tmp_path, free))
    text = refused(lambda: twin.twin(device(rows=3), opened), "level of a is free", "irradiance: 120 nW/cm^2")
    assert "measurement.yaml:5: captures[0]" in text
    refused(lambda: twin.twin(device(), opened), "3 x 10", "4 x 10")


def test_a_wavelength_that_the_sensor_says_nothing_of_is_told_with_its_capture(tmp_path: Path) -> None:
    """The sensor's table ends before it, the second capture's light does not."""
    light = (
        "{{id: {}, mean: 2, modality: qis, light: {{kind: flat, wavelength: {} nm}}, frames: 20, frame_time: 10 us}}"
    )
    opened = measurement.open(described(tmp_path, light.format("a", 500), light.format("b", 900)))
    table = ByWavelength((400e-9, 800e-9), (0.4, 0.1))
    sensor = Sensor(Layout(3, 10, 25e-12, 1.0), [Detection(pdp=table)], "device", name="test")
    for judge in (lambda: opened.check_sensor(sensor), lambda: compare.compare(sensor, opened, jobs=1)):
        text = refused(judge, "detection.pdp: the wavelength 900 nm lies outside the table", "400 nm to 800 nm")
        assert "measurement.yaml:6: captures[1]" in text
    measurement.open(described(tmp_path, light.format("a", 500))).check_sensor(sensor)


def test_a_mean_becomes_a_simulated_mean(tmp_path: Path) -> None:
    text = "{id: a, mean: 2, modality: qis, light: {kind: dark}, frames: 100, frame_time: 10 us}"
    sensor, opened = device(rows=3), measurement.open(described(tmp_path, text))
    for _ in range(2):  # the second time nothing is to be done
        twin.simulate(sensor, opened, tmp_path / "twin", 1)
    (capture,) = measurement.open(tmp_path / "twin").captures
    assert capture.mean is not None and replace(capture, mean=2.0) == opened.captures[0]
    laws.share_is(round(capture.mean * 30), 30 * 100, -np.expm1(-1000 * 10e-6))


# --- datasets -----------------------------------------------------------------------------------------------------

CONFIG = """
seed: 3
scene: {{images: {images}, wavelength: 500 nm, irradiance: [1 uW/cm^2, 20 uW/cm^2]}}
recording: {{exposure: 630 us, frames: 63, frame_time: 10 us, readouts: [tr, str, qis, counts], bits: 3}}
sensor:
  name: chip
  layout: {{rows: 3, columns: 5, pixel_area: 25 um^2}}
  effects: {{detection: {{pdp: 0.5}}, dark_counts: {{rate: 1 kHz}}, tdc: {{resolution: 1 ns}}}}
"""


def dataset_of(root: Path, images: str) -> Path:
    experiment = config.build(document.parse(CONFIG.format(images=images), "test"), root.parent)
    factory.generate(experiment, experiment.load_images(), root, 1)
    return root


def test_a_dataset_of_uniform_images_is_a_measurement(tmp_path: Path) -> None:
    root = dataset_of(tmp_path / "ds", "{source: uniform, repetitions: 2, grey: 51}")
    stored_images = spadmnist.open(root)
    opened = measurement.open(root)
    assert [c.id for c in opened.captures] == [f"{level} uW/cm^2 #{i}" for level in (1, 20) for i in (0, 1)]
    first = opened.captures[0]
    assert first.modality == "tr" and first.light.level == pytest.approx(0.01 * 51 / 255)
    assert first.conditions == Conditions(630e-6, 1, 630e-6, 630e-6, 500e-9)
    part = stored_images["20 uW/cm^2", "train"]
    read = opened.recording("20 uW/cm^2 #1").events
    assert read is not None and np.array_equal(read.ticks, part.tr[1].ticks)  # type: ignore[arg-type]
    qis = measurement.open(root, "qis").recording("20 uW/cm^2 #1")
    assert np.array_equal(np.unpackbits(qis.frames[:], axis=2, count=5), part.qis[1])  # type: ignore[index]
    stamps = measurement.open(root, "str").recording("20 uW/cm^2 #1")
    assert np.allclose(stamps.frames[:] * 1e-9, part.str[1])  # type: ignore[index]
    counts = measurement.open(root, "counts").recording("20 uW/cm^2 #1")
    assert np.array_equal(counts.frames[:], part.counts[1]) and counts.conditions.bits == 3  # type: ignore[index]
    assert opened.recording("1 uW/cm^2 #0", config.read_sensor(root / "config.yaml")).layout.pixels == 15


def test_a_dataset_without_light_is_dark_and_one_of_digits_is_none(tmp_path: Path) -> None:
    dark = measurement.open(dataset_of(tmp_path / "dark", "{source: uniform, repetitions: 1, grey: 0}"))
    assert [c.id for c in dark.captures] == ["1 uW/cm^2", "20 uW/cm^2"]
    assert all(c.light.dark and c.conditions.dark for c in dark.captures)
    text = CONFIG.replace("rows: 3, columns: 5", "rows: 28, columns: 28")
    images = "{source: digits, train: 2, test: 1}"
    experiment = config.build(document.parse(text.format(images=images), "test"), tmp_path)
    factory.generate(experiment, experiment.load_images(), tmp_path / "digits", 1)
    refused(lambda: measurement.open(tmp_path / "digits"), "only one whose source is uniform")
    refused(lambda: measurement.open(tmp_path / "dark", "int"), "int was not recorded")


# --- sensors, looks and the command line --------------------------------------------------------------------------

SENSOR = """
sensor:
  name: chip
  rules: device
  layout: {rows: 4, columns: 10, pixel_area: 25 um^2}
  effects: {detection: {pdp: 0.4}, dark_counts: {rate: 1 kHz}, dead_time: {duration: 50 ns}, tdc: {resolution: 1 ns}}
"""


def test_a_sensor_is_read_from_its_file_or_from_a_config(tmp_path: Path) -> None:
    (tmp_path / "sensor.yaml").write_text(SENSOR)
    (tmp_path / "bare.yaml").write_text("\n".join(line[2:] for line in SENSOR.splitlines()[2:]) + "\n")
    (tmp_path / "config.yaml").write_text("seed: 1\nscene: {images: {source: mnist}}\nsensor: sensor.yaml\n")
    for name in ("sensor", "bare", "config"):
        sensor = config.read_sensor(tmp_path / f"{name}.yaml")
        assert (sensor.name, sensor.rules, sensor.layout.shape) == ("chip", "device", (4, 10))
        assert sensor.nominal_dead_time == 50e-9
    (tmp_path / "wrong.yaml").write_text(SENSOR.replace("pdp: 0.4", "pdp: 2").replace("50 ns", "50") + "sed: 1\n")
    with pytest.raises(ConfigError) as caught:
        config.read_sensor(tmp_path / "wrong.yaml")
    assert len(caught.value.problems) == 3 and any("Did you mean seed?" in p for p in caught.value.problems)
    (tmp_path / "other.yaml").write_text("a: 1\n")
    with pytest.raises(ConfigError, match="describes no sensor"):
        config.read_sensor(tmp_path / "other.yaml")


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    sensor = device()
    return measurement.write(tmp_path / "lab", "lab", sensor.layout, recordings(sensor))


def test_a_look_counts_what_is_odd(lab: Path) -> None:
    opened = measurement.open(lab)
    recorded = opened.recording("tr flat")
    row = look.look(opened, recorded.capture, recorded)
    assert row["detections"] == recorded.totals.sum() and row["hot_pixels"] == 0 and row["dead_pixels"] == 0
    assert 50e-9 <= row["shortest_interval"] < 1e-6 and row["rate_max"] > row["rate_median"] > row["rate_min"]
    assert recorded.events is not None
    found = np.concatenate(list(look.intervals(recorded.events)))
    rows = [np.diff(recorded.events.times[a:b]) for a, b in itertools.pairwise(recorded.events.offsets)]
    assert np.allclose(found, np.concatenate(rows))
    odd = recorded.totals.copy()
    odd[3], odd[4] = 0, 20 * odd[4]
    recorded._kept["totals"] = odd
    row = look.look(opened, recorded.capture, recorded)
    assert (row["hot_pixels"], row["dead_pixels"], row["empty_pixels"]) == (1, 1, 1)


def test_inspect_prints_and_draws(lab: Path, tmp_path: Path) -> None:
    png = tmp_path / "sheet.png"
    result = CliRunner().invoke(cli, ["inspect", str(lab), "--plot", str(png)])
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert max(map(len, lines)) <= 100
    for capture in CAPTURES:
        assert any(line.startswith(capture.id) for line in lines), capture.id
    assert png.read_bytes()[:4] == b"\x89PNG" and png.stat().st_size > 50_000
    first = png.read_bytes()
    opened = measurement.open(lab)
    report.capture_sheet(opened, report.looks(opened, True), png)
    assert png.read_bytes() == first
    found = json.loads(CliRunner().invoke(cli, ["inspect", str(lab / "measurement.yaml"), "--json"]).stdout)
    assert [row["capture"] for row in found["captures"]] == [c.id for c in CAPTURES]
    assert found["captures"][6]["mean"] == 17.25 and found["captures"][6]["detections"] is None


def test_a_sheet_of_means_alone_cannot_be_drawn(tmp_path: Path) -> None:
    opened = measurement.open(described(tmp_path, QIS.replace("file: a.h5", "mean: 3")))
    with pytest.raises(SpadError, match="only means are known"):
        report.capture_sheet(opened, report.looks(opened, True), tmp_path / "x.png")
    assert "3.000" in report.capture_table(opened, report.looks(opened, False))


PAPER = """
format: spadmnist-measurement/1
layout: {rows: 8, columns: 8}
captures:
  - {id: dark, mean: 2.6, modality: qis, light: {kind: dark}, frames: 10000, frame_time: 1 us}
  - {id: 500 low, mean: 470, modality: qis, light: {kind: flat, wavelength: 500 nm, irradiance: 120 nW/cm^2},
     frames: 10000, frame_time: 1 us}
  - {id: 700 low, mean: 62, modality: qis, light: {kind: flat, wavelength: 700 nm, irradiance: 20 nW/cm^2},
     frames: 10000, frame_time: 1 us}
  - {id: dark long, mean: 26, modality: qis, light: {kind: dark}, frames: 10000, frame_time: 10 us}
  - {id: 500 high, mean: 9715, modality: qis, light: {kind: flat, wavelength: 500 nm, irradiance: 885 nW/cm^2},
     frames: 10000, frame_time: 10 us}
  - {id: 700 high, mean: 4011, modality: qis, light: {kind: flat, wavelength: 700 nm, irradiance: 195 nW/cm^2},
     frames: 10000, frame_time: 10 us}
"""
SPAD512 = """
sensor:
  name: SPAD512
  layout: {rows: 8, columns: 8, pixel_area: 36 um^2, fill_factor: 1.0}
  effects: {detection: {pdp: {500 nm: 0.444, 700 nm: 0.207}}, dark_counts: {rate: 260 Hz}}
"""


def test_the_published_means_are_a_measurement(tmp_path: Path) -> None:
    """Only means are known: they are said, and simulated."""
    lab, out = tmp_path / "lab", tmp_path / "twin"
    lab.mkdir()
    (lab / "measurement.yaml").write_text(PAPER)
    (tmp_path / "sensor.yaml").write_text(SPAD512)
    result = CliRunner().invoke(cli, ["inspect", str(lab), "--json"], catch_exceptions=False)
    rows = {row["capture"]: row for row in json.loads(result.stdout)["captures"]}
    assert (rows["500 low"]["ones_share"], rows["500 low"]["rate_mean"]) == pytest.approx((0.047, 47_000))
    assert rows["dark"]["rate_mean"] == pytest.approx(260) and rows["dark"]["detections"] is None
    said = CliRunner().invoke(cli, ["inspect", str(lab)], catch_exceptions=False).stdout
    assert "9,715" in said and "97.2%" in said.replace(" %", "%")
    result = CliRunner().invoke(
        cli, ["simulate", str(tmp_path / "sensor.yaml"), str(lab), "-o", str(out)], catch_exceptions=False
    )
    assert result.exit_code == 0 and [path.name for path in out.iterdir()] == ["measurement.yaml"]
    means = {c.id: c.mean for c in measurement.open(out).captures}
    assert means.pop("dark") == pytest.approx(2.6, rel=0.4)  # 8 x 8 pixels scatter by 8 %
    expected = {"500 low": 472, "700 low": 55, "dark long": 26, "500 high": 9715, "700 high": 4020}
    assert means == pytest.approx(expected, rel=0.12)


def test_simulate_from_the_command_line(
    lab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sensor.yaml").write_text(SENSOR)
    arguments = ["simulate", str(tmp_path / "sensor.yaml"), str(lab), "-o", str(tmp_path / "twin"), "--seed", "5"]
    result = CliRunner().invoke(cli, [*arguments, "--json"])
    assert result.exit_code == 0 and json.loads(result.stdout)["captures"] == [c.id for c in CAPTURES]
    opened, made = measurement.open(lab), measurement.open(tmp_path / "twin")
    assert [replace(c, mean=None) for c in made.captures] == [replace(c, mean=None) for c in opened.captures]
    a, b = (int(m.recording("qis flat").totals.sum()) for m in (opened, made))
    assert a != b and abs(a - b) < 5 * np.sqrt(a + b)
    totals: list[float] = []
    steps: list[float] = []
    progress = factory.Progress(
        lambda what, total, done: totals.append(total), lambda work, note: steps.append(work), lambda: None
    )
    monkeypatch.setattr(command_line, "_terminal", lambda: contextlib.nullcontext(progress))
    arguments[4] = str(tmp_path / "again")
    assert CliRunner().invoke(cli, arguments).exit_code == 0
    assert len(totals) == 1 and sum(steps) == pytest.approx(totals[0]) and len(steps) > len(CAPTURES)
    arguments[4], arguments[-1] = str(tmp_path / "twin"), "6"
    for wrong, words in (
        (arguments, "another sensor or seed"),
        (["simulate", "x.yaml", str(lab), "-o", "y"], "no such file"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(wrong)
        said = capsys.readouterr().err
        assert stop.value.code == 2 and words in said and "Traceback" not in said


def test_the_package_opens_measurements() -> None:
    code = "import spadmnist, sys; spadmnist.open_measurement; print('h5py' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "False", done.stderr
    assert spadmnist.Measurement is Measurement
