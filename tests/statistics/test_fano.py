"""Variance over mean: against literal versions, its law, and what it is made to see."""

from __future__ import annotations

import math
from functools import partial

import laws
import numpy as np
import pytest
from scipy import stats
from simple_sensor import FRAME, counted, grid, many, one_of_each, qis, qis_of, reduced, sigmas, stamped, tr, tr_of

from spadmnist.events import Layout
from spadmnist.recording import Recording
from spadmnist.statistics import Summary
from spadmnist.statistics.fano import ArrayFano, PixelFano, event_pairs, frame_pairs

KINDS = ("tr", "tr without ticks", "qis", "str", "counts", "counter")


def literal_frames(recording: Recording) -> np.ndarray:
    """(frames, pixels) counts."""
    frames = np.asarray(recording.frames[:])  # type: ignore[index]
    if recording.modality == "qis":
        frames = np.unpackbits(frames, axis=2, count=recording.layout.columns)
    elif recording.modality == "str":
        frames = frames < round(FRAME / recording.tick)  # type: ignore[operator]
    return frames.reshape(len(frames), -1).astype(int)


def literal_windows(recording: Recording) -> list[tuple[float, np.ndarray]]:
    """(length s, (windows, pixels) counts) for every window."""
    found = []
    if recording.events is not None:
        windows = 20
        while recording.conditions.exposure / windows >= 0.999e-6:
            edges = np.arange(windows + 1) * recording.conditions.exposure / windows
            edges[-1] *= 1 + 1e-12
            rows = [np.histogram(recording.events.row(p), edges)[0] for p in range(recording.pixels)]
            found.insert(0, (recording.conditions.exposure / windows, np.array(rows).T))
            windows *= 2
        return found
    frames = literal_frames(recording)
    frame = recording.conditions.exposure / len(frames)
    longest = _longest(recording)
    used = frames[: len(frames) // longest * longest]
    size = 1
    while size <= longest:
        found.append((size * frame, used.reshape(-1, size, used.shape[1]).sum(axis=1)))
        size *= 2
    return found


def literal_fano(recording: Recording, pixels: np.ndarray, of_array: bool) -> float:
    """Sum of squares about the mean, of each column or of their sum, over what steady rates have. (windows, pixels)."""
    counts = pixels.sum(axis=1, keepdims=True) if of_array else pixels
    squares = ((counts - counts.mean(axis=0)) ** 2).sum()
    n = len(pixels)
    left, drawn = np.ones(pixels.shape[1]), 1.0
    if recording.modality != "tr" and recording.conditions.counting == "frames":
        places = recording.conditions.frames
        if not of_array:
            places = places // recording.n_frames * (recording.n_frames // _longest(recording) * _longest(recording))
        shares = (recording.totals if of_array else pixels.sum(axis=0)) / places
        left, drawn = 1 - shares, places / (places - 1)
    return squares / ((recording_sum(recording, pixels, of_array) * left).sum() * (1 - 1 / n) * drawn)


def recording_sum(recording: Recording, pixels: np.ndarray, of_array: bool) -> np.ndarray:
    """Detections of each pixel in the windows; of the array by the shares in all frames."""
    if of_array and recording.modality != "tr" and recording.conditions.counting == "frames":
        return recording.totals / recording.n_frames * (recording.n_frames // _longest(recording) * _longest(recording))
    return pixels.sum(axis=0)


def _longest(recording: Recording) -> int:
    """Frames in the longest window."""
    longest = 1
    while recording.n_frames // (2 * longest) >= 20:
        longest *= 2
    return longest


def told(text: str) -> float:
    return float(text.removeprefix("variance ").partition(" times")[0])


@pytest.mark.parametrize("kind", KINDS)
def test_windows_of_a_small_recording(kind: str) -> None:
    recording = one_of_each()[kind]
    windows = literal_windows(recording)
    pixels = windows[1:] if kind in ("qis", "str") else windows  # a frame of one bit has no variance
    for statistic, wanted in ((PixelFano, pixels), (ArrayFano, windows)):
        summary = reduced(statistic, recording)
        assert summary.axis is not None and np.allclose(summary.axis, [length for length, _ in wanted])
        for cell, (_, counts) in enumerate(wanted):
            text, _ = summary.size(cell, float(summary.values[cell]), 0.0)
            # the words have five digits; half a pair of dither may show in the last of them
            fano = literal_fano(recording, counts, statistic is ArrayFano)
            assert math.isclose(told(text), fano, rel_tol=4e-4), (statistic, cell)


@pytest.mark.parametrize("kind", ["tr", "tr without ticks"])
def test_pairs_and_sums_of_events_are_those_of_histograms(kind: str) -> None:
    recording = one_of_each()[kind]
    events = recording.events
    assert events is not None
    stamps, unit = (events.ticks, events.tick) if kind == "tr" else (events.times, 1.0)
    windows = literal_windows(recording)
    shortest = windows[0][0]
    pairs, inside = event_pairs(stamps, events.offsets, unit / shortest, len(windows))
    assert pairs.tolist() == [sum(math.comb(int(n), 2) for n in counts.ravel()) for _, counts in windows]
    assert np.array_equal(inside, windows[0][1].sum(axis=0))
    # those of the whole array, as if they were of one pixel
    together, (number,) = event_pairs(np.sort(stamps), np.array([0, len(stamps)]), unit / shortest, len(windows))
    of_array = [counts.sum(axis=1) for _, counts in windows]
    assert together.tolist() == [sum(math.comb(int(n), 2) for n in counts) for counts in of_array]
    assert number == of_array[0].sum()


@pytest.mark.parametrize(
    ("frames", "rows", "columns", "share"),
    [(45, 3, 5, 0.5), (700, 1, 1, 0.3), (1290, 2, 9, 0.9), (5200, 9, 64, 0.03), (2600, 33, 17, 0.5)],
)
def test_pairs_in_packed_frames_are_those_of_sums(frames: int, rows: int, columns: int, share: float) -> None:
    recording = qis(2, (frames, rows, columns), share)
    windows = literal_windows(recording)
    pairs, detections, used = frame_pairs(recording)
    assert pairs.tolist() == [int((counts * (counts - 1) // 2).sum()) for _, counts in windows]
    assert sorted(detections[detections > 0]) == sorted(windows[0][1].sum(axis=0)[windows[0][1].sum(axis=0) > 0])
    assert used == len(windows[0][1])


def test_pairs_of_a_burst() -> None:
    """Most events of one row in a millionth of the exposure: its pairs are too many to look them up one by one."""
    rng = np.random.default_rng(2)
    rows = [np.sort(np.append(0.3 + rng.random(2000) * 2e-6, rng.random(100))), np.sort(rng.random(300))]
    events = tr_of(rows, grid(1, 2), 1.0, 1e-9).events
    assert events is not None
    levels, ticks = 16, events.ticks.astype(np.float64)  # type: ignore[union-attr]
    factor = 20 * 2**15 * 1e-9
    pairs, inside = event_pairs(events.ticks, events.offsets, factor, levels)
    row = np.repeat([0, 1], np.diff(events.offsets))
    for level in range(levels):
        window = (ticks * factor).astype(np.int64) >> level
        counts = np.unique(np.stack([row, window]), axis=1, return_counts=True)[1]
        assert pairs[level] == (counts * (counts - 1) // 2).sum()
    assert inside.tolist() == [2100, 300]


def test_events_behind_the_exposure_are_left_out() -> None:
    rows = [np.array([1e-6, 2e-4, 9.9e-4, 1.0001e-3, 5e-3])]
    assert event_pairs(tr_of(rows, grid(1, 1), 1e-3).events.ticks, np.array([0, 5]), 1e-10 / 5e-5, 1)[1][0] == 3  # type: ignore[union-attr]


STEADY = {
    "tr": partial(tr, layout=grid(1, 23), rates=3e5, exposure=1e-3),
    "tr, few": partial(tr, layout=grid(8, 8), rates=3e3, exposure=1e-3),
    "one pixel": partial(tr, layout=grid(1, 1), rates=1e6, exposure=1e-3),
    "qis": partial(qis, shape=(400, 8, 8), share=0.3),
    "qis, bright": partial(qis, shape=(400, 8, 8), share=0.98),
    "qis, few": partial(qis, shape=(400, 8, 8), share=0.004),
    "str": partial(stamped, shape=(400, 8, 8), share=0.2),
    "counts": partial(counted, shape=(80, 8, 8), share=0.3),
    "counter": partial(counted, shape=(80, 8, 8), share=0.2, counting="counter"),
}


@pytest.mark.parametrize("kind", STEADY)
@pytest.mark.parametrize("statistic", [PixelFano, ArrayFano])
def test_scores_of_steady_light_are_normal(statistic: type, kind: str) -> None:
    if kind == "one pixel" and statistic is ArrayFano:
        assert ArrayFano().reduce(STEADY[kind](1)) is None
        return
    values = many(statistic, STEADY[kind], 150)
    for cell in values.T:
        laws.mean_is(cell, 0.0)
        laws.distribution_is(cell, stats.norm.cdf)
    assert np.abs(values).max() < 5
    assert abs(values.std() - 1) < 0.08


@pytest.mark.parametrize("kind", ["tr", "tr, few", "qis", "qis, few"])
@pytest.mark.parametrize("statistic", [PixelFano, ArrayFano])
def test_what_is_new_in_a_longer_window_is_independent_of_what_is_in_the_shorter(statistic: type, kind: str) -> None:
    """Of 250 recordings: a correlation above 0.35 of one of 15 pairs of windows comes once in a million times."""
    found = [reduced(statistic, STEADY[kind](seed)) for seed in range(250)]
    nested, apart = (np.array([s.values for s in some]) for some in (found, [s.apart() for s in found]))
    beside = ~np.eye(nested.shape[1], dtype=bool)
    assert np.corrcoef(nested.T)[beside].max() > 0.5
    assert np.abs(np.corrcoef(apart.T)[beside]).max() < 0.35
    assert np.abs(apart.std(axis=0) - 1).max() < 0.25
    assert np.array_equal(apart[:, 0], nested[:, 0])
    assert found[0].apart().where(1).startswith(found[0].where(1))


def test_the_law_is_seen_to_fail() -> None:
    """Light that fluctuates by 20 % from window to window of 50 us."""
    rng = np.random.default_rng(3)
    level = 0.8 + 0.4 * rng.integers(0, 2, (200, 20))

    def noisy(seed: int) -> Recording:
        return tr(seed, grid(1, 23), 3.6e5, 1e-3, change=lambda t: level[seed % 200, (t / 5e-5).astype(int)] / 1.2)

    values = many(ArrayFano, noisy, 150)
    with pytest.raises(AssertionError):
        laws.distribution_is(values[:, -1], stats.norm.cdf)


def afterpulsing(seed: int, layout: Layout, rate: float, exposure: float, probability: float) -> Recording:
    """One child for a share of the detections, 100 ns later on average."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(layout.pixels):
        times = rng.random(rng.poisson(rate * exposure)) * exposure
        parents = times[rng.random(len(times)) < probability]
        children = parents + rng.exponential(1e-7, len(parents))
        rows.append(np.sort(np.concatenate([times, children[children < exposure]])))
    return tr_of(rows, layout, exposure)


def test_afterpulsing_is_seen_at_all_lengths() -> None:
    layout, exposure = grid(8, 8), 4e-3
    recording = afterpulsing(3, layout, 1e5, exposure, 0.03)
    steady = partial(tr, layout=layout, rates=1e5, exposure=exposure)
    found = sigmas(PixelFano, recording, steady)
    # by theory 3 % of 25,600 detections in pairs: beside the root of 2,500 that are there by chance, or 20,000
    assert found[0] > 10 and found[3] > 4
    summary = reduced(PixelFano, recording)
    text, share = summary.size(2, float(summary.values[2]), 0.0)
    assert abs(told(text) - 1.06) < 0.02 and abs(share - 0.03) < 0.01
    assert np.abs(sigmas(PixelFano, tr(5, layout, 1e5, exposure), steady)).max() < 5


def test_flicker_is_seen_in_the_array() -> None:
    """10 % at 10 kHz: variance of the rate 0.005, times the detections in a window that is short beside 100 us."""
    layout, exposure = grid(8, 8), 4e-3
    steady = partial(tr, layout=layout, rates=1e5, exposure=exposure)
    flicker = tr(4, layout, 1.1e5, exposure, change=lambda t: (1 + 0.1 * np.sin(2e4 * np.pi * t)) / 1.1)
    found = sigmas(ArrayFano, flicker, steady)
    summary = reduced(ArrayFano, flicker)
    cell = int(np.argmin(np.abs(summary.axis - 12.5e-6)))  # type: ignore[operator]
    expected = 0.005 * 6.4e6 * summary.axis[cell]  # type: ignore[index]
    assert abs(told(summary.size(cell, float(summary.values[cell]), 0.0)[0]) - 1 - expected) < 0.25 * expected
    assert found[cell] > 4
    # it shows in the sum of all, not in a pixel
    assert np.abs(sigmas(PixelFano, flicker, steady)).max() < 5


def test_a_dead_time_takes_variance_away() -> None:
    layout, exposure, dead_time = grid(8, 8), 1e-3, 100e-9
    recording = tr(3, layout, 2e6, exposure, dead_time)
    summary = reduced(PixelFano, recording)
    # (1 - r tau)^2 with r the rate that is recorded; windows of 12.5 us have 60 detections
    rate = recording.totals.mean() / exposure
    text, _ = summary.size(3, float(summary.values[3]), 0.0)
    assert abs(told(text) - (1 - rate * dead_time) ** 2) < 0.02


def test_frames_that_are_alike_are_seen() -> None:
    """Every bit has a chance of 4 % to be that of the frame before: pairs of frames are alike."""
    rng = np.random.default_rng(3)
    bits = rng.random((2000, 16, 16)) < 0.2
    kept = rng.random(bits.shape) < 0.04
    for f in range(1, len(bits)):
        bits[f][kept[f]] = bits[f - 1][kept[f]]
    steady = partial(qis, shape=(2000, 16, 16), share=0.2)
    found = sigmas(PixelFano, qis_of(bits), steady)
    assert found[0] > 15 and found[1] > 12
    assert np.abs(sigmas(PixelFano, steady(5), steady)).max() < 5


@pytest.mark.parametrize("kind", ["qis", "str", "counts", "counter"])
@pytest.mark.parametrize("statistic", [PixelFano, ArrayFano])
def test_pieces_make_no_difference(statistic: type, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = reduced(statistic, one_of_each()[kind]).values
    monkeypatch.setattr("spadmnist.recording._CHUNK", 100)
    assert np.array_equal(reduced(statistic, one_of_each()[kind]).values, whole)


@pytest.mark.parametrize("statistic", [PixelFano, ArrayFano])
def test_the_cells_do_not_depend_on_the_data(statistic: type) -> None:
    sizes = {len(reduced(statistic, tr(1, grid(4, 3), rate, 1e-3, 50e-9)).values) for rate in (0.0, 1e3, 1e6)}
    assert sizes == {6}
    for value in (False, True):
        reduced(statistic, qis_of(np.full((100, 4, 4), value)))
    assert statistic().reduce(qis(1, (15, 4, 4), 0.5)) is None
    # the shortest exposures have at least one window
    assert len(reduced(statistic, tr(1, grid(2, 2), 1e6, 5e-6)).values) == 1


def test_the_size_of_a_nested_cell_is_that_of_its_whole_score() -> None:
    """Scores of 40 and 40 that share 0.7 of their scatter: the second one's own part is 17, its size that of 40."""
    values = np.array([40.0, 40.0])
    sizes: list[tuple[float, float]] = []

    def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
        sizes.append((measured, expected))
        return "", measured - expected

    summary = Summary(values, "normal", str, size, nested=np.array([0.0, 0.7])).apart()
    own = (40 - 0.7 * 40) / math.sqrt(1 - 0.7**2)
    assert summary.values.tolist() == pytest.approx([40.0, own])
    summary.size(0, 40.0, 1.0)
    summary.size(1, own, 0.0)
    assert sizes[0] == pytest.approx((40.0, 1.0)) and sizes[1] == pytest.approx((40.0, 0.7 * 40))
