"""Measurements as a lab has them: their descriptions and files, and recordings that a sensor makes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from spadmnist import twin
from spadmnist.effects import Conditions
from spadmnist.effects.dark_counts import DarkCounts
from spadmnist.effects.dead_time import DeadTime
from spadmnist.effects.detection import Detection
from spadmnist.effects.tdc import Tdc
from spadmnist.errors import InputError
from spadmnist.events import Layout
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


def device(*more: Any, rows: int = 4, columns: int = 10, resolution: float = 1e-9) -> Sensor:
    effects = [Detection(pdp=0.4), DarkCounts(rate=1000.0), DeadTime(duration=50e-9), *more]
    if resolution:
        effects.append(Tdc(resolution=resolution))
    return Sensor(Layout(rows, columns, 25e-12, 1.0), effects, "device", name="test").resolved()


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
