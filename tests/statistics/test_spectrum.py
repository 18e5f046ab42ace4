"""The power spectrum: against a literal version, its law, and a light that flickers."""

from __future__ import annotations

import math
from functools import partial

import laws
import numpy as np
import pytest
from simple_sensor import FRAME, counted, grid, many, one_of_each, qis, reduced, tr, waits

from spadmnist import recording as recordings
from spadmnist.recording import Recording
from spadmnist.statistics.spectrum import Spectrum


def series_of(recording: Recording) -> tuple[np.ndarray, float]:
    """(detections in each step, s from one to the next)."""
    if recording.events is not None:
        tick = recording.tick or 1e-11
        width = max(round(5e-6 / tick), math.ceil(recording.conditions.exposure / tick / 65536))
        stamps = np.rint(recording.events.times / tick).astype(np.int64)
        bins = round(recording.conditions.exposure / tick) // width
        return np.bincount(stamps // width, minlength=bins)[:bins], width * tick
    frames = np.asarray(recording.frames[:])  # type: ignore[index]
    if recording.modality == "qis":
        frames = np.unpackbits(frames, axis=2, count=recording.layout.columns)
    elif recording.modality == "str":
        hit = frames < recording.none
        waited = waits(frames, recording.none)
        frames = hit - hit.sum() / waited.sum() * (waited - waited.mean())
    together = 15 if recording.modality == "counts" and recording.conditions.counting == "frames" else 1
    return frames.reshape(len(frames), -1).sum(axis=1, dtype=frames.dtype), together * FRAME


@pytest.mark.parametrize("kind", ["tr", "tr without ticks", "qis", "str", "counts", "counter"])
def test_a_small_recording(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = one_of_each()[kind]
    series, step = series_of(recording)
    summary = reduced(Spectrum, recording)
    # as many steps as make a quick transform: 600, 400 of 403, 128 of 130
    steps = max(n for n in range(1, len(series) + 1) if max_factor(n) <= 5)
    k = np.arange(1, (steps + 1) // 2)
    power = np.abs(np.exp(-2j * np.pi * np.outer(k, np.arange(steps)) / steps) @ series[:steps]) ** 2
    np.testing.assert_allclose(summary.values, power / power.mean(), rtol=1e-6)
    np.testing.assert_allclose(summary.axis, k / (steps * step))
    assert summary.where(9) == "3.333 kHz" or kind != "tr"
    if recording.events is None:
        monkeypatch.setattr(recordings, "_CHUNK", 1)
        again = Recording(**{**recording.__dict__, "_kept": {}})
        assert np.array_equal(reduced(Spectrum, again).values, summary.values)


def max_factor(n: int) -> int:
    """The largest prime factor."""
    found = 1
    for p in range(2, n + 1):
        while n % p == 0:
            n, found = n // p, p
    return found


def test_long_captures_are_taken_in_larger_steps() -> None:
    summary = reduced(Spectrum, qis(1, (150_000, 1, 2), 0.2))
    assert len(summary.values) == 24_999 and summary.axis is not None
    assert math.isclose(summary.axis[0], 1 / (50_000 * 3 * FRAME))
    summary = reduced(Spectrum, tr(1, grid(1, 2), 1e3, 2.0))
    assert 32_000 < len(summary.values) < 32_768 and math.isclose(summary.axis[0], 0.5, rel_tol=0.02)  # type: ignore[index]


def test_nothing_to_say() -> None:
    assert Spectrum().reduce(tr(1, grid(2, 2), 1e6, 2e-5)) is None and Spectrum().reduce(qis(1, (8, 4, 4), 0.5)) is None
    for empty in (tr(1, grid(2, 2), 0.0, 1e-3), qis(1, (100, 4, 4), 0.0), qis(1, (100, 4, 4), 1.0)):
        assert reduced(Spectrum, empty).values.tolist() == [1.0] * len(reduced(Spectrum, empty).values)


STEADY = {
    "tr": partial(tr, layout=grid(4, 6), rates=4e5, exposure=5e-3, dead_time=50e-9),
    "tr, dim": partial(tr, layout=grid(4, 6), rates=2e3, exposure=5e-3),
    "qis": partial(qis, shape=(400, 8, 8), share=0.3),
    "counts": partial(counted, shape=(400, 8, 8), share=0.3),
}


@pytest.mark.parametrize("kind", STEADY)
def test_power_is_exponential(kind: str) -> None:
    values = many(Spectrum, STEADY[kind], 100)
    means = values.mean(axis=0)
    assert np.abs(means - 1).max() < laws.z_bound(laws.FALSE_ALARM / means.size) / math.sqrt(100) * 1.3
    laws.distribution_is(values[:, ::4], lambda x: -np.expm1(-x))
    assert values.max() < -math.log(laws.FALSE_ALARM / values.size)


def test_flicker_is_seen_at_its_frequency_and_with_its_size() -> None:
    """8 % at 2 kHz in 48,000 detections: a power of (0.04 * 48,000)^2 / 48,000 = 77 times the mean."""

    def flicker(t: np.ndarray) -> np.ndarray:
        return (1 + 0.08 * np.sin(2 * np.pi * 2e3 * t)) / 1.08

    changed = tr(1, grid(4, 6), 4.32e5, 5e-3, change=flicker)
    summary = reduced(Spectrum, changed)
    cell = int(np.argmax(summary.values))
    assert summary.where(cell) == "2 kHz" and 50 < summary.values[cell] < 110
    text, amplitude = summary.size(cell, float(summary.values[cell]), 1.0)
    assert 0.065 < amplitude < 0.095 and text.startswith(f"{100 * amplitude:.3g} % modulation")
    assert np.delete(summary.values, cell).max() < 15
    text, amplitude = summary.size(3, 0.01, 1.0)
    assert amplitude < 0 and text.startswith("power 0.01, 1 expected")
    with pytest.raises(AssertionError):
        flickering = partial(tr, layout=grid(4, 6), rates=4.32e5, exposure=5e-3, change=flicker)
        laws.distribution_is(many(Spectrum, flickering, 100)[:, ::3], lambda x: -np.expm1(-x))
