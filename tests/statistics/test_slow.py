"""The capture in blocks of time: against literal versions, their laws, and what they are made to see."""

from __future__ import annotations

import math
from functools import partial

import laws
import numpy as np
import pytest
from scipy import stats
from simple_sensor import FRAME, counted, grid, many, one_of_each, qis, qis_of, reduced, sigmas, stamped, tr, tr_of

from spadmnist.recording import Recording
from spadmnist.statistics import _scores as scores
from spadmnist.statistics.slow import SlowSeries, Trend

KINDS = ("tr", "tr without ticks", "qis", "str", "counts", "counter")


def literal_counts(recording: Recording) -> tuple[np.ndarray, float]:
    """((blocks, pixels) detections, slots of a pixel in a block)."""
    if recording.events is not None:
        edges = np.linspace(0, recording.conditions.exposure, 33)
        edges[-1] *= 1 + 1e-12
        rows = [np.histogram(recording.events.row(p), edges)[0] for p in range(recording.pixels)]
        return np.array(rows).T, math.inf
    frames = np.asarray(recording.frames[:])  # type: ignore[index]
    if recording.modality == "qis":
        frames = np.unpackbits(frames, axis=2, count=recording.layout.columns)
    elif recording.modality == "str":
        frames = frames < round(FRAME / recording.tick)  # type: ignore[operator]
    blocks = 32 if len(frames) >= 128 else 16
    size = len(frames) // blocks
    cut = [frames[b * size : (b + 1) * size].reshape(size, -1).sum(axis=0, dtype=int) for b in range(blocks)]
    slots = {"counts": 15 * size, "qis": size, "str": size}[recording.modality]
    return np.array(cut), math.inf if recording.conditions.counting == "counter" else slots


@pytest.mark.parametrize("kind", KINDS)
def test_blocks_of_a_small_recording(kind: str) -> None:
    recording = one_of_each()[kind]
    counts, slots = literal_counts(recording)
    blocks = len(counts)
    sums = counts.sum(axis=1)
    shares = scores.shares(sums, blocks)
    assert sums.sum() < slots * blocks * 66 / 2
    wanted = [scores.poisson_score(float(n), float(sums.mean()), u) for n, u in zip(sums, shares, strict=True)]
    summary = reduced(Trend, recording)
    assert np.array_equal(summary.values, np.array(wanted).ravel())
    # and the words say what the numbers were
    length = recording.conditions.exposure / 32 if recording.events is not None else None
    if length:
        assert summary.where(3).startswith(f"{3 * length * 1e6:.4g} to {4 * length * 1e6:.4g} us")
    assert math.isclose(summary.size(3, float(summary.values[3]), 0.0)[1], sums[3] / sums.mean() - 1, abs_tol=4e-3)

    inside = counts.sum(axis=0)
    pairs = np.array([sum(math.comb(int(n), 2) for n in pixel) for pixel in counts.T])
    summary = reduced(SlowSeries, recording)
    wanted_scores, _ = scores.pair_scores(pairs, inside, blocks, slots, scores.shares(inside, 66))
    assert np.array_equal(summary.values, wanted_scores)
    pixel = int(np.argmax(np.abs(summary.values)))
    text, _ = summary.size(pixel, float(summary.values[pixel]), 0.0)
    p = inside[pixel] / blocks / slots
    fano = counts[:, pixel].var(ddof=1) / counts[:, pixel].mean() / (1 - p)
    found = float(text.partition(" times")[0].rpartition(" ")[2])
    assert math.isclose(found, fano, rel_tol=0.02, abs_tol=0.02)


def test_saturated_frames_are_told_by_the_slots_that_are_free() -> None:
    recording = qis(1, (640, 8, 8), 0.98)
    counts, slots = literal_counts(recording)
    free = slots - counts
    summary = reduced(Trend, recording)
    wanted = -scores.poisson_score(free.sum(axis=1), float(free.sum() / 32), scores.shares(counts.sum(axis=1), 32))
    assert np.array_equal(summary.values, wanted)
    relative = counts[5].sum() / counts.sum() * 32 - 1
    assert math.isclose(summary.size(5, float(summary.values[5]), 0.0)[1], relative, abs_tol=1e-3)


STEADY = {
    "tr": partial(tr, layout=grid(1, 23), rates=4e5, exposure=1e-3, dead_time=50e-9),
    "tr, few": partial(tr, layout=grid(16, 16), rates=1.6e3, exposure=2e-3),
    "qis": partial(qis, shape=(320, 8, 8), share=0.3),
    "qis, bright": partial(qis, shape=(320, 8, 8), share=0.97),
    "qis, few": partial(qis, shape=(320, 16, 16), share=0.01),
    "str": partial(stamped, shape=(320, 8, 8), share=0.2),
    "counts": partial(counted, shape=(80, 8, 8), share=0.3),
}


@pytest.mark.parametrize("kind", STEADY)
def test_scores_of_steady_light_are_normal(kind: str) -> None:
    slow = many(SlowSeries, STEADY[kind], 100)
    shift = 0.2 if kind == "tr" else 0.06  # a dead time leaves a little less variance
    assert abs(slow.mean()) < shift and abs(slow.std() - 1) < 0.03
    usual = 2 * stats.norm.sf(4) * slow.size
    assert stats.poisson.sf((np.abs(slow) > 4).sum() - 1, 2 * usual) > laws.FALSE_ALARM
    trend = many(Trend, STEADY[kind], 100)
    z = trend / trend.std()  # all blocks have the same spread
    assert np.abs(z.std(axis=0) - 1).max() < 5 / math.sqrt(2 * 100)
    laws.distribution_is(z[:, ::3], stats.norm.cdf)
    assert np.abs(z).max() < 5
    p = {"qis": 0.3, "str": 0.2, "counts": 0.3}.get(kind, 0.0)
    assert abs(trend.std() - math.sqrt((1 - p) * (1 - 1 / 32))) < 0.06
    # light that drifts by 20 % is no steady light, and the law says so
    if kind == "qis":
        drift = partial(qis, shape=(320, 8, 8), share=np.linspace(0.27, 0.33, 320)[:, None, None])
        with pytest.raises(AssertionError):
            laws.distribution_is((many(Trend, drift, 100) / trend.std())[:, ::3], stats.norm.cdf)


def test_a_drift_is_seen() -> None:
    """10 % over a capture of 90,000 detections: by theory 0.1 / sqrt(12) * sqrt(90,000) = 8.7 standard deviations."""
    layout, exposure = grid(8, 8), 1e-3
    steady = partial(tr, layout=layout, rates=1.4e6, exposure=exposure)
    drift = tr(5, layout, 1.47e6, exposure, change=lambda t: 0.9 + 0.1 * t / exposure)
    found = sigmas(Trend, drift, steady)
    times = np.linspace(-1, 1, 32)
    assert found @ times / np.sqrt(times @ times) > 6
    assert np.abs(sigmas(Trend, tr(6, layout, 1.4e6, exposure), steady)).max() < 5


def test_a_gap_in_the_readout_is_seen() -> None:
    layout, exposure = grid(8, 8), 1e-3
    steady = partial(tr, layout=layout, rates=1e5, exposure=exposure)
    gap = tr(5, layout, 1e5, exposure, change=lambda t: (np.abs(t - 0.51e-3) > 15e-6).astype(float))
    found = sigmas(Trend, gap, steady)
    assert int(np.argmin(found)) == 16 and found[16] < -10


@pytest.mark.parametrize("kind", ["tr", "qis"])
def test_blinking_pixels_are_seen_and_no_others(kind: str) -> None:
    """Two pixels of 64 that are twice as bright half of the time; 100 detections each."""
    rng = np.random.default_rng(4)
    on = np.repeat(rng.random((10, 2)) < 0.5, 64, axis=0)  # (time, pixel)
    hit = [5, 40]
    if kind == "tr":
        exposure = 1e-3
        steady = partial(tr, layout=grid(8, 8), rates=1e5, exposure=exposure)
        recording = steady(3)
        blink = [
            tr(9 + k, grid(1, 1), 2e5, exposure, change=lambda t, k=k: on[(t / exposure * 640).astype(int), k] + 0.0)
            for k in range(2)
        ]
        rows = [recording.events.row(p) for p in range(64)]  # type: ignore[union-attr]
        for p, one in zip(hit, blink, strict=True):
            rows[p] = one.events.row(0)  # type: ignore[union-attr]
        blinking = tr_of(rows, grid(8, 8), exposure)
    else:
        steady = partial(qis, shape=(640, 8, 8), share=0.15)
        share = np.full((640, 8, 8), 0.15)
        for k, p in enumerate(hit):
            share[:, p // 8, p % 8] = 0.3 * on[:, k]
        blinking = qis(3, (640, 8, 8), share)
    found = sigmas(SlowSeries, blinking, steady)
    assert found[hit].min() > 6
    found[hit] = 0
    assert np.abs(found).max() < 5


@pytest.mark.parametrize("kind", ["qis", "str", "counts", "counter"])
@pytest.mark.parametrize("statistic", [Trend, SlowSeries])
def test_pieces_make_no_difference(statistic: type, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = reduced(statistic, one_of_each()[kind]).values
    monkeypatch.setattr("spadmnist.recording._CHUNK", 100)
    assert np.array_equal(reduced(statistic, one_of_each()[kind]).values, whole)


@pytest.mark.parametrize("statistic", [Trend, SlowSeries])
def test_the_cells_do_not_depend_on_the_data(statistic: type) -> None:
    for layout in (grid(1, 1), grid(4, 3)):
        sizes = {len(reduced(statistic, tr(1, layout, rate, 1e-3, 50e-9)).values) for rate in (0.0, 1e3, 1e6)}
        assert len(sizes) == 1
    for value in (False, True):
        reduced(statistic, qis_of(np.full((100, 4, 4), value)))
    assert statistic().reduce(qis(1, (40, 4, 4), 0.5)) is None
