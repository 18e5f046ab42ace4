"""The capture in blocks of time: against literal versions, their laws, and what they are made to see."""

from __future__ import annotations

import math
from functools import partial

import laws
import numpy as np
import pytest
from scipy import stats
from simple_sensor import (
    FRAME,
    counted,
    grid,
    in_equal_times,
    many,
    one_of_each,
    qis,
    qis_of,
    reduced,
    sigmas,
    stamped,
    tr,
    tr_of,
)

from spadmnist.recording import Recording
from spadmnist.statistics import _scores as scores
from spadmnist.statistics.slow import HotSeries, SlowSeries, Trend

KINDS = ("tr", "tr without ticks", "qis", "str", "counts", "counter")


def literal_counts(recording: Recording, blocks: int | None = None, merged: int = 1) -> tuple[np.ndarray, float]:
    """((blocks, pixels) detections, slots of a pixel in a block).

    blocks: of equal length, by default 32, or 16 where there are few frames; then so many of them are merged to one.
    """
    if recording.events is not None:
        edges = np.linspace(0, recording.conditions.exposure, (blocks or 32) + 1)
        edges[-1] *= 1 + 1e-12
        rows = [np.histogram(recording.events.row(p), edges)[0] for p in range(recording.pixels)]
        return np.array(rows).T.reshape(-1, merged, recording.pixels).sum(axis=1), math.inf
    frames = np.asarray(recording.frames[:])  # type: ignore[index]
    if recording.modality == "qis":
        frames = np.unpackbits(frames, axis=2, count=recording.layout.columns)
    elif recording.modality == "str":
        frames = frames < round(FRAME / recording.tick)  # type: ignore[operator]
    blocks = blocks or (32 if len(frames) >= 128 else 16)
    size = len(frames) // blocks * merged
    cut = [frames[b * size : (b + 1) * size].reshape(size, -1).sum(axis=0, dtype=int) for b in range(blocks // merged)]
    slots = {"counts": 15 * size, "qis": size, "str": size}[recording.modality]
    return np.array(cut), math.inf if recording.conditions.counting == "counter" else slots


@pytest.mark.parametrize("kind", KINDS)
def test_blocks_of_a_small_recording(kind: str) -> None:
    recording = one_of_each()[kind]
    counts, slots = literal_counts(recording)
    blocks = len(counts)
    sums = in_equal_times(recording, (1,), blocks) if kind == "str" else counts.sum(axis=1)
    shares = scores.shares(sums, blocks)
    assert sums.sum() < slots * blocks * 66 / 2
    wanted = [scores.poisson_score(float(n), float(sums.mean()), u) for n, u in zip(sums, shares, strict=True)]
    summary = reduced(Trend, recording)
    np.testing.assert_allclose(summary.values, np.array(wanted).ravel(), atol=1e-9)
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
    "str, bright": partial(stamped, shape=(320, 8, 8), share=0.97),
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
    p = {"qis": 0.3, "counts": 0.3}.get(kind, 0.0)
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


def test_a_drift_is_seen_by_stamps_where_nearly_every_frame_has_one() -> None:
    """4 % over 1280 frames of 64 pixels with 3.5 photons each: 0.04 / sqrt(12) * sqrt(79,500) = 3.3 sigma, not 2.0."""
    photons = 3.5 * (1 + 0.04 * np.linspace(-0.5, 0.5, 1280)[:, None, None])
    times = np.linspace(-1, 1, 32)

    def drift(make: partial, number: int) -> np.ndarray:
        return many(Trend, make, number) @ times

    shape, share = (1280, 8, 8), -np.expm1(-photons)
    usual = drift(partial(stamped, shape=shape, share=-math.expm1(-3.5)), 200)
    found = (drift(partial(stamped, shape=shape, share=share), 200).mean() - usual.mean()) / usual.std()
    assert abs(found - 3.26) < 5 * math.sqrt(2 / 200 + 3.26**2 / 400)


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


@pytest.mark.parametrize("kind", KINDS)
def test_hot_pixels_of_a_small_recording(kind: str) -> None:
    recording = one_of_each()[kind]
    summary = reduced(HotSeries, recording)
    lengths = (128, 32, 8) if recording.events is not None else (32, 8)  # 403 frames or 130: no 128 blocks of 4
    groups = {2: "2 %", 3: "5 %", 7: "10 %", 13: "20 %"}  # of 66 pixels; two at least
    k = 0
    for hot, part in groups.items():
        for blocks in lengths:
            counts, slots = literal_counts(recording, lengths[0], lengths[0] // blocks)
            assert len(counts) == blocks
            total = counts.sum(axis=0)
            counts = counts[:, [p for _, p in sorted((-n, p) for p, n in enumerate(total))][:hot]]
            pairs = sum(math.comb(int(n), 2) for n in counts.ravel())
            law = scores.pairs_law(counts.sum(axis=0), blocks, slots).pooled(np.ones(hot))
            # whatever the random share of the whole number is
            low, high = (scores.pooled_score(pairs, law, share) for share in (0.0, 1.0))
            assert low - 1e-9 < summary.values[k] < high + 1e-9, (hot, blocks)
            assert summary.where(k).startswith(f"the {part} of pixels with the most detections, in blocks of ")
            text, _ = summary.size(k, float(summary.values[k]), 0.0)
            places = blocks * slots
            taken = counts.sum(axis=0)
            fano = (counts.var(axis=0, ddof=1) * blocks).sum() / (taken * (1 - taken / places)).sum()
            assert math.isclose(float(text.split()[1]), fano, rel_tol=0.02, abs_tol=0.02)
            k += 1
    assert k == len(summary.values)
    if recording.events is not None:
        assert summary.where(1).endswith("of 93.75 us")  # 3 ms in 32 blocks


HOT = np.random.default_rng(3).permutation(256)[:13]  # of 16 x 16 pixels: 5 %


def uneven(cold: float, hot: float) -> np.ndarray:
    """(256,) of unequal pixels, some of which are hot."""
    out = cold * np.random.default_rng(2).uniform(0.6, 1.4, 256)
    out[HOT] = hot
    return out


UNEVEN = {
    "tr": partial(tr, layout=grid(16, 16), rates=uneven(1e5, 4e5), exposure=1e-3),
    "tr, few": partial(tr, layout=grid(16, 16), rates=uneven(2e3, 8e3), exposure=1e-3),
    "qis": partial(qis, shape=(520, 16, 16), share=uneven(0.2, 0.5).reshape(16, 16)),
    "qis, hardly a gap": partial(qis, shape=(520, 16, 16), share=uneven(0.2, 0.998).reshape(16, 16)),
    "qis, few of few pixels": partial(qis, shape=(520, 4, 4), share=0.012),
    "counts": partial(counted, shape=(130, 16, 16), share=uneven(0.1, 0.4).reshape(16, 16)),
}


@pytest.mark.parametrize("kind", UNEVEN)
def test_scores_of_steady_hot_pixels_are_normal(kind: str) -> None:
    """Every cell has a mean of 0, a spread of 1 and the normal law; each with a false-alarm rate of 1e-6."""
    recordings = 150
    found = many(HotSeries, UNEVEN[kind], recordings)
    assert found.shape[1] == {"counts": 8, "qis, few of few pixels": 6}.get(kind, 12)
    for cell, z in enumerate(found.T):
        laws.mean_is(z, 0.0, what=f"cell {cell}")
        laws.distribution_is(z, stats.norm.cdf, what=f"cell {cell}")
        assert abs(z.std(ddof=1) - 1) < laws.z_bound() / math.sqrt(2 * recordings), cell
    assert np.abs(found).max() < laws.z_bound(laws.FALSE_ALARM / found.size)


def blinking(of: str) -> Recording:
    """Hot pixels whose rate is 35 % higher or lower, at random in each of 20 stretches; 200 detections each."""
    on = np.random.default_rng(4).random((20, len(HOT))) < 0.5
    if of == "tr":
        exposure = 1e-3
        whole = tr(3, grid(16, 16), uneven(1e5, 2e5), exposure)
        rows = [whole.events.row(p) for p in range(256)]  # type: ignore[union-attr]
        for k, p in enumerate(HOT):
            kept = np.where(on[:, k], 1.0, 0.65 / 1.35)
            one = tr(
                9 + k, grid(1, 1), 2.7e5, exposure, change=lambda t, kept=kept: kept[(t / exposure * 20).astype(int)]
            )
            rows[p] = one.events.row(0)  # type: ignore[union-attr]
        return tr_of(rows, grid(16, 16), exposure)
    share = np.tile(uneven(0.1, 0.2), (1000, 1))
    share[:, HOT] = np.repeat(np.where(on, 0.27, 0.13), 50, axis=0)
    return qis(3, (1000, 16, 16), share.reshape(1000, 16, 16))


@pytest.mark.parametrize("kind", ["tr", "qis"])
def test_hot_pixels_that_blink_are_seen_where_all_pixels_hide_them(kind: str) -> None:
    steady = {
        "tr": partial(tr, layout=grid(16, 16), rates=uneven(1e5, 2e5), exposure=1e-3),
        "qis": partial(qis, shape=(1000, 16, 16), share=uneven(0.1, 0.2).reshape(16, 16)),
    }[kind]
    recording = blinking(kind)
    found = sigmas(HotSeries, recording, steady)
    assert len(found) == 12 and found[4] > 5.5  # the 5 % that are hot, in 32 blocks
    null = (many(SlowSeries, steady, 60) ** 2).sum(axis=1)
    square = float((reduced(SlowSeries, recording).values ** 2).sum())
    assert (square - null.mean()) / null.std() < 4
    assert np.abs(sigmas(HotSeries, steady(3), steady)).max() < 5


def test_times_and_frames_of_the_same_detections_agree() -> None:
    """Frames so short that hardly one has two detections of a pixel."""
    whole = blinking("tr")
    bits = np.zeros((25600, 256), bool)
    for p in range(256):
        bits[(whole.events.row(p) / 1e-3 * 25600).astype(int), p] = True  # type: ignore[union-attr]
    times, frames = reduced(HotSeries, whole), reduced(HotSeries, qis_of(bits.reshape(-1, 16, 16)))
    assert times.values.max() > 5
    assert np.abs(times.values - frames.values).max() < 0.5
    # 1 ms, and 25,600 frames of 10 us
    assert times.where(4) == "the 5 % of pixels with the most detections, in blocks of 31.25 us"
    assert frames.where(4) == "the 5 % of pixels with the most detections, in blocks of 8 ms"


@pytest.mark.parametrize("kind", ["qis", "str", "counts", "counter"])
@pytest.mark.parametrize("statistic", [Trend, SlowSeries, HotSeries])
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


def test_the_cells_of_hot_pixels_depend_on_the_capture_alone() -> None:
    for layout, cells in ((grid(2, 5), 3), (grid(5, 8), 9), (grid(16, 16), 12)):  # 2; 2, 4 and 8; 5, 13, 26 and 51
        for rate in (0.0, 1e3, 1e6):
            assert len(reduced(HotSeries, tr(1, layout, rate, 1e-3, 50e-9)).values) == cells
    for frames, lengths in ((512, 3), (511, 2), (128, 2), (127, 1), (64, 1)):
        for value in (False, True):
            assert len(reduced(HotSeries, qis_of(np.full((frames, 4, 4), value))).values) == 2 * lengths  # 2 and 3
    assert HotSeries().reduce(qis(1, (63, 4, 4), 0.5)) is None
    assert HotSeries().reduce(tr(1, grid(3, 3), 1e5, 1e-3)) is None
