"""Import, export, import: every capture comes back as it was, in every format that can hold it."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spadmnist import exporters, measurement
from spadmnist.effects import Conditions
from spadmnist.events import Events, Layout
from spadmnist.importers import Said
from spadmnist.importers.captures import import_files
from spadmnist.readout import counts_type, no_detection, stamps_for
from spadmnist.recording import Capture, Light, Recording

CHOICES = [(name, m) for name, target in exporters.Target.every.items() for m in target.modalities]

shares = st.sampled_from([0.0, 0.015, 0.05, 1.0]) | st.floats(0, 1)
wavelengths = st.sampled_from([500e-9, 555e-9, 512.3e-9]) | st.floats(1e-7, 2e-6)
levels = st.sampled_from([5e-3, 75.67e-5, 1.234567890123e-3, 0.1]) | st.floats(1e-9, 1e9)
ticks = st.sampled_from([1e-12, 4e-12, 1e-12 / 3, 2.5e-9 / 140, 17.857142857e-12, 1e-9, 1e-8, 0.1]) | st.floats(
    1e-15, 1
)


@st.composite
def lights(draw: st.DrawFn) -> Light:
    uncertain = draw(shares), draw(shares)
    if draw(st.booleans()):
        return Light(None, None, "irradiance", *uncertain)
    kind = draw(st.sampled_from(["irradiance", "lux"]))
    level = draw(st.none() | levels)
    return Light(draw(wavelengths), level, kind if level is not None else "irradiance", *uncertain)


@st.composite
def clocks(draw: st.DrawFn, lit: Light, frames: int) -> Conditions:
    """Of frames: any time, any period that is as long."""
    time = draw(st.sampled_from([1e-5, 1e-6 / 3, 1.1e-5, 10.4e-6]) | st.floats(1e-9, 10))
    period = time * draw(st.sampled_from([1.0, 1.2, 4 / 3]) | st.floats(1, 10))
    return Conditions(frames * period, frames, time, period, lit.wavelength)


@st.composite
def recordings(draw: st.DrawFn, modality: str) -> Recording:
    layout = Layout(draw(st.integers(1, 4)), draw(st.integers(1, 19)), np.nan, np.nan)
    rng = np.random.Generator(np.random.Philox(draw(st.integers(0, 2**32))))
    lit, shape = draw(lights()), layout.shape
    if modality == "tr":
        tick = draw(ticks)
        exposure = tick * draw(st.sampled_from([1.0, 7.5, 1e6 / 3, 2.0**31, 2.0**33, 2.0**52]) | st.floats(1, 1e17))
        end = no_detection(exposure, tick)
        counts = rng.integers(0, draw(st.sampled_from([1, 2, 7])), layout.pixels)  # often a pixel or all have none
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        stamps = rng.integers(0, end, len(counts) and int(offsets[-1]), dtype=np.uint64, endpoint=True)
        stamps[: min(2, len(stamps))] = [0, end][: min(2, len(stamps))]
        rows = [np.sort(stamps[a:b]) for a, b in itertools.pairwise(offsets)]
        kind = stamps_for(end, "stamps")
        joined = np.concatenate([*rows, np.zeros(0, np.uint64)]).astype(kind)
        capture = Capture("one", "tr", lit, Conditions(exposure, 1, exposure, exposure, lit.wavelength))
        return Recording(capture, layout, Events(None, offsets, layout.pixels, joined, tick, end=exposure), None, tick)
    held = draw(st.integers(1, 20))
    clock = draw(clocks(lit, held))
    if modality == "qis":
        bits = rng.random((held, *shape)) < draw(st.sampled_from([0.0, 0.3, 1.0]))
        return Recording(Capture("one", "qis", lit, clock), layout, None, np.packbits(bits, axis=2))
    if modality == "str":
        tick = clock.frame_time / draw(st.sampled_from([1.0, 1.5, 100.0, 2.0**31]) | st.floats(1, 2.0**32 - 2))
        tick = max(tick, 1e-15)
        one = Recording(Capture("one", "str", lit, clock), layout, tick=tick)
        stamps = np.minimum(rng.integers(0, 2 * one.none, (held, *shape)), one.none).astype(np.uint32)
        return replace(one, frames=stamps)
    depth, counting = draw(st.integers(1, 12) | st.just(16)), draw(st.sampled_from(["frames", "counter"]))
    each = (1 << depth) - 1 if counting == "frames" else 1
    frames = held * each
    clock = replace(clock, exposure=frames * clock.frame_period, frames=frames, bits=depth, counting=counting)
    numbers = rng.integers(0, clock.largest_count, (held, *shape), endpoint=True).astype(
        counts_type(clock.largest_count)
    )
    return Recording(Capture("one", "counts", lit, clock), layout, None, numbers)


def what_npy_does_not_say(one: Recording) -> Said:
    c = one.conditions
    framed = Said(frames=one.n_frames, frame_time=c.frame_time, frame_period=c.frame_period, modality=one.modality)
    return replace(
        framed,
        columns=one.layout.columns,
        tick=one.tick,
        packed=one.modality == "qis",
        bits=c.bits or None,
        counting=c.counting if c.bits else None,
    )


def assert_same(one: Recording, two: Recording) -> None:
    assert one.capture == two.capture and one.layout.shape == two.layout.shape and one.tick == two.tick
    if one.events is None or two.events is None:
        assert one.events is two.events is None
        assert np.array_equal(np.asarray(one.frames[:]), np.asarray(two.frames[:]))  # type: ignore[index]
    else:
        assert np.array_equal(one.events.offsets, two.events.offsets)
        assert np.array_equal(one.events.ticks, two.events.ticks)  # type: ignore[arg-type]


@pytest.mark.parametrize(("format", "modality"), CHOICES)
def test_there_and_back_again(tmp_path_factory: pytest.TempPathFactory, format: str, modality: str) -> None:
    @settings(max_examples=25, deadline=None, derandomize=True)
    @given(recordings(modality))
    def check(one: Recording) -> None:
        folder: Path = tmp_path_factory.mktemp("trip")
        measurement.write(folder / "first", "first", one.layout, [one])
        opened = measurement.open(folder / "first")
        assert_same(opened.recording("one"), one)
        (file,) = exporters.export(opened, folder / "out", format)
        said, lit = (what_npy_does_not_say(one), [one.capture.light]) if format == "npy" else (Said(), [])
        again = measurement.open(import_files([file], folder / "second", said, lit).folder)
        assert_same(again.recording("one"), one)
        assert not again.notes["one"]
        (twice,) = exporters.export(again, folder / "out again", format)
        if format != "photon-hdf5":  # which holds the date
            assert file.read_bytes() == twice.read_bytes()

    check()
