"""Pairs of the same pixel: against literal versions, their law, and what they are made to see."""

from __future__ import annotations

import math
from functools import partial

import null_laws
import numpy as np
import pytest
from simple_sensor import counted, grid, live, many, one_of_each, qis, qis_of, reduced, sigmas, stamped, tr, tr_of

from spadmnist import recording as recordings
from spadmnist.recording import Recording
from spadmnist.statistics import _scores as scores
from spadmnist.statistics.autocorrelation import Autocorrelation

LAGS = (1, 2, 3, 5, 10, 20, 50, 100)


def values_of(recording: Recording) -> np.ndarray:
    """(frames, pixels) counts."""
    frames = np.asarray(recording.frames[:])  # type: ignore[index]
    if recording.modality == "qis":
        frames = np.unpackbits(frames, axis=2, count=recording.layout.columns)
    elif recording.modality == "str":
        frames = frames < recording.none
    return frames.reshape(len(frames), -1).astype(np.int64)


def of_frames(series: np.ndarray, lags: tuple[int, ...], bits: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(products (lags,), what chance makes of them, their variance) of counts (frames, pixels)."""
    steps, left = len(series), len(series) - np.array(lags)
    n, mean, spread = series.sum(axis=0), series.mean(axis=0), series.var(axis=0, ddof=1)
    pairs = np.array([(series[lag:] * series[:-lag]).sum() for lag in lags])
    # the covariance about the mean: 0 but for what steps that share a total are opposed to each other
    about = np.array([((series[lag:] - mean) * (series[:-lag] - mean)).sum() for lag in lags])
    squared = (n * (n - 1.0) * (steps - n) * (steps - n - 1) / (steps * (steps - 1)) ** 2).sum()
    if not bits:
        squared = (spread**2 * (n - 1) / np.maximum(n, 1)).sum()
    return pairs, pairs - about - spread.sum() * left / steps, squared * left


def scored(recording: Recording, pairs: np.ndarray, chance: np.ndarray, variance: np.ndarray) -> np.ndarray:
    mean = np.maximum(variance, 1e-6)
    count = np.maximum(pairs - chance + mean, 0)
    share = scores.shares(np.append(recording.totals, len(pairs)), len(pairs))
    return scores.poisson_score(np.where(mean < 100, np.rint(count), count), mean, share)


@pytest.mark.parametrize("kind", ["qis", "str", "counts", "counter"])
def test_frames_of_a_small_recording(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = one_of_each()[kind]
    lags = tuple(lag for lag in LAGS if 2 * lag <= recording.n_frames)
    pairs, chance, variance = of_frames(values_of(recording), lags, kind in ("qis", "str"))
    summary = reduced(Autocorrelation, recording)
    np.testing.assert_allclose(summary.values, scored(recording, pairs, chance, variance), rtol=1e-7)
    assert summary.where(0) == "the same pixel, the next frame" and summary.where(2) == "the same pixel, 3 frames later"
    share = (pairs[2] - chance[2]) / recording.totals.sum()
    assert summary.size(2, float(summary.values[2]), 0.0)[0].startswith(f"{100 * share:.3g} % of detections beyond")
    # eight frames at a time give the same
    monkeypatch.setattr(recordings, "_CHUNK", 1)
    assert np.array_equal(reduced(Autocorrelation, one_of_each()[kind]).values, summary.values)


def literal(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(pairs, chance, variance) of time stamps, every level as a series of boxes."""
    assert recording.events is not None
    tick = recording.tick or 1e-11
    end = round(recording.conditions.exposure / tick)
    box = math.ceil(max(recording.dead_time, 10e-9) / tick / 3 - 1e-6)
    longest = min(round(10e-3 / tick), end // 4)
    levels = int(math.log2(longest / box)) - 2
    boxes = end // box // 2 ** (levels - 1) * 2 ** (levels - 1)
    found = []
    for level in range(levels):
        series = np.zeros((boxes >> level, recording.pixels), np.int64)
        for pixel in range(recording.pixels):
            which = np.rint(recording.events.row(pixel) / tick).astype(np.int64) // box
            np.add.at(series[:, pixel], which[which < boxes] >> level, 1)
        n, total = len(series), series.sum(axis=0)
        pairs = np.array([(series[lag:] * series[:-lag]).sum() for lag in (4, 5, 6, 7)])
        chance = np.array([_chance(series, lag) for lag in (4, 5, 6, 7)])
        found.append((pairs, chance, (total * (total - 1.0)).sum() * (n - np.arange(4, 8)) / n**2))
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))  # type: ignore[return-value]


def _chance(series: np.ndarray, lag: int) -> float:
    """The products less the covariance about the mean, which is -N / n^2 for each of the n boxes with N detections."""
    n, mean = len(series), series.mean(axis=0)
    products = (series[lag:] * series[:-lag]).sum()
    about = ((series[lag:] - mean) * (series[:-lag] - mean)).sum()
    return float(products - about - (mean / n).sum() * (n - lag))


@pytest.mark.parametrize("kind", ["tr", "tr without ticks", "dim", "mixed", "dense"])
def test_stamps_of_a_small_recording(kind: str) -> None:
    more = {
        "dim": lambda: tr(3, grid(3, 4), 3e3, 6e-3, 50e-9),
        "mixed": lambda: tr(3, grid(3, 4), np.geomspace(30, 3e6, 12), 1.3e-3, 50e-9),
        "dense": lambda: tr(3, grid(1, 3), 5e7, 1e-5, 0.0),
    }
    recording = more[kind]() if kind in more else one_of_each()[kind]
    pairs, chance, variance = literal(recording)
    summary = reduced(Autocorrelation, recording)
    np.testing.assert_allclose(summary.values, scored(recording, pairs, chance, variance), rtol=1e-7, atol=1e-9)
    if kind == "tr":
        assert summary.where(0) == "the same pixel, 58.45 to 75.15 ns later"
    # what comes after the exposure is left out
    if kind == "dim":
        rows = [recording.events.row(p) for p in range(12)]  # type: ignore[union-attr]
        late = tr_of([np.append(row, [7e-3, 9e-3]) for row in rows], grid(3, 4), 6e-3, 1e-10, 50e-9)
        same = Autocorrelation().reduce(late)
        assert same is not None and len(same.values) == len(pairs)
        np.testing.assert_allclose(same.values, scored(late, *literal(late)), rtol=1e-7, atol=1e-9)


def test_nothing_to_say() -> None:
    assert Autocorrelation().reduce(tr(1, grid(2, 2), 1e6, 5e-7, 50e-9)) is None
    assert Autocorrelation().reduce(qis(1, (1, 4, 4), 0.5)) is None
    for empty in (tr(1, grid(2, 2), 0.0, 1e-2, 50e-9), qis(1, (200, 4, 4), 0.0), qis(1, (200, 4, 4), 1.0)):
        assert np.abs(reduced(Autocorrelation, empty).values).max() < 5


STEADY = {
    "tr": partial(tr, layout=grid(4, 6), rates=2e5, exposure=2e-3),
    "tr, bright": partial(tr, layout=grid(1, 3), rates=2e6, exposure=4e-4),
    "tr, dim": partial(tr, layout=grid(4, 6), rates=300.0, exposure=4e-2),
    "tr, mixed": partial(tr, layout=grid(3, 4), rates=np.geomspace(1e3, 1e6, 12), exposure=1e-3),
    "qis": partial(qis, shape=(320, 8, 8), share=0.3),
    "qis, bright": partial(qis, shape=(320, 8, 8), share=0.97),
    "qis, dim": partial(qis, shape=(320, 8, 8), share=0.01),
    "qis, mixed": partial(qis, shape=(320, 8, 8), share=np.linspace(0.005, 0.995, 64).reshape(8, 8)),
    "str": partial(stamped, shape=(320, 8, 8), share=0.2),
    "counts": partial(counted, shape=(120, 8, 8), share=0.3),
}


@pytest.mark.parametrize("kind", STEADY)
def test_scores_of_steady_light_are_normal(kind: str) -> None:
    values = many(Autocorrelation, STEADY[kind], 150)
    null_laws.normal(values)


def test_the_law_fails_where_the_light_flickers() -> None:
    def flicker(t: np.ndarray) -> np.ndarray:
        return 0.8 + 0.2 * np.sin(2e4 * t)

    with pytest.raises(AssertionError):
        null_laws.normal(
            many(Autocorrelation, partial(tr, layout=grid(4, 6), rates=2e5, exposure=2e-3, change=flicker), 100)
        )


def test_slow_traps_are_seen_at_their_time() -> None:
    """5 % afterpulses within 4 us: 480 of 9600 detections, some 60 in a cell, where chance makes 100 pairs."""
    rng = np.random.default_rng(1)
    rows = []
    for _ in range(24):
        times = rng.random(rng.poisson(400)) * 2e-2
        late = times[rng.random(len(times)) < 0.05]
        late = late + rng.exponential(4e-6, len(late))
        rows.append(live(np.sort(np.concatenate([times, late])), 50e-9))
    changed = tr_of([row[row < 2e-2] for row in rows], grid(4, 6), 2e-2, 1e-10, 50e-9)
    found = sigmas(Autocorrelation, changed, partial(tr, layout=grid(4, 6), rates=2e4, exposure=2e-2, dead_time=50e-9))
    assert found[12:28].sum() / 4 > 8 and np.abs(found[40:]).max() < 5


def test_a_frame_that_follows_a_frame_is_seen() -> None:
    """A pixel that fires again with 2 % in the next frame: 400 pairs more, where chance scatters by 80."""
    rng = np.random.default_rng(1)
    bits = rng.random((320, 8, 8)) < 0.3
    bits[1:] |= bits[:-1] & (rng.random((319, 8, 8)) < 0.1)
    found = sigmas(Autocorrelation, qis_of(bits), partial(qis, shape=(320, 8, 8), share=0.32))
    assert found[0] > 5 and np.abs(found[1:]).max() < 5
