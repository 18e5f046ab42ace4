"""Whether data are whole: against literal versions, the laws, and data that were broken on purpose."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import partial

import laws
import numpy as np
import pytest
from scipy import stats
from simple_sensor import (
    capture,
    counted,
    counts_of,
    grid,
    many,
    one_of_each,
    qis,
    qis_of,
    reduced,
    sigmas,
    stamped,
    str_of,
    tr,
    tr_of,
)

from spadmnist import kernels
from spadmnist.effects import Conditions
from spadmnist.effects.dark_counts import DarkCounts
from spadmnist.effects.dead_time import DeadTime
from spadmnist.effects.detection import Detection
from spadmnist.effects.tdc import Tdc
from spadmnist.errors import InputError
from spadmnist.recording import Recording, of_image
from spadmnist.sensor import Sensor
from spadmnist.statistics.fano import ArrayFano, PixelFano
from spadmnist.statistics.integrity import (
    EqualStamps,
    FullCounters,
    Gaps,
    RareFrames,
    RepeatedFrames,
    chance_of_bits,
)
from spadmnist.statistics.maps import PixelMap, Spread, Surface
from spadmnist.statistics.slow import SlowSeries, Trend
from spadmnist.streams import Streams


def bits_of(recording: Recording) -> np.ndarray:
    return np.unpackbits(np.asarray(recording.frames), axis=2, count=recording.layout.columns).astype(bool)


# --- repeated frames ----------------------------------------------------------------------------------------------


def test_the_chance_of_a_frame_is_the_product_over_its_pixels() -> None:
    rng = np.random.default_rng(1)
    share = rng.random(22)
    bits = rng.random(22) < 0.5
    likely = share > 0.5
    best = np.log(np.maximum(share, 1 - share)).sum()
    loss = np.append(np.abs(np.log(share / (1 - share))), [0, 0])
    wanted = np.log(np.where(bits, share, 1 - share)).sum()
    found = chance_of_bits(np.packbits(bits), np.packbits(likely), best, loss, -1e9)
    assert math.isclose(found, wanted, rel_tol=1e-12)
    assert chance_of_bits(np.packbits(bits), np.packbits(likely), best, loss, wanted / 2) < wanted / 2


def literal_repeats(bits: np.ndarray, chance: float) -> int:
    """Frames of bits that are the same as the one before and have a lower chance than this."""
    frames = len(bits)
    share = (bits.sum(axis=0) + 0.5) / (frames + 1)
    found = 0
    for before, frame in itertools.pairwise(bits):
        own = np.log(np.where(frame, share, 1 - share)).sum()
        found += bool((before == frame).all() and own < math.log(chance))
    return found


@pytest.mark.parametrize("share", [0.002, 0.1, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("shape", [(500, 6, 11), (500, 1, 1), (500, 2, 4), (500, 16, 16)])
def test_repeats_are_counted_where_chance_cannot_make_them(shape: tuple[int, int, int], share: float) -> None:
    recording = qis(3, shape, share)
    sure = 1e-9 / shape[0]
    assert reduced(RepeatedFrames, recording).values[0] == literal_repeats(bits_of(recording), sure) == 0
    broken = bits_of(recording)
    for f in (1, 7, 8, 256, 499):
        broken[f] = broken[f - 1]
    wanted = literal_repeats(broken, sure)
    assert reduced(RepeatedFrames, qis_of(broken)).values[0] == wanted
    if (shape[1] == 16 and 0.01 < share < 0.99) or (shape[1] == 6 and share == 0.5):
        assert wanted == 5
    if shape[1] <= 2:
        assert wanted == 0  # a few pixels repeat by themselves
    rare = reduced(RareFrames, qis_of(broken)).values[2]
    assert rare == literal_repeats(broken, 1e-3)
    if shape[1] > 2 and 0.01 < share < 0.99:
        assert rare == 5


def test_rare_repeats_are_poisson() -> None:
    """12 pixels at 0.45: no frame has a chance above 0.55^12 = 0.00077; two are the same with (0.45^2 + 0.55^2)^12."""
    make = partial(qis, shape=(1500, 3, 4), share=0.45)
    values = many(RareFrames, make, 300)[:, 2]
    mean = 1499 * (1 - 2 * 0.45 * 0.55) ** 12
    laws.poisson_mean(int(values.sum()), 300 * mean)
    laws.histogram_is(values.astype(int), stats.poisson(mean).pmf)
    twice = bits_of(make(5))
    twice[50::30] = twice[49::30][: len(twice[50::30])]  # one in 30 is stored twice
    assert sigmas(RareFrames, qis_of(twice), make)[2] > 8
    assert reduced(RepeatedFrames, qis_of(twice)).values[0] == 0  # with so few pixels none of them is beyond all chance


def test_repeated_stamps_and_counts() -> None:
    stamps = np.asarray(stamped(3, (300, 4, 4), 0.3).frames).copy()
    assert reduced(RepeatedFrames, str_of(stamps)).values[0] == 0
    stamps[40] = stamps[39]
    stamps[200] = stamps[199]
    assert reduced(RepeatedFrames, str_of(stamps)).values[0] == 2
    # the same bits are not the same stamps
    stamps[200][stamps[200] < 1000] ^= 1
    assert reduced(RepeatedFrames, str_of(stamps)).values[0] == 1
    for counting in ("frames", "counter"):
        values = np.asarray(counted(3, (300, 5, 5), 0.4, counting=counting).frames).copy()
        assert reduced(RepeatedFrames, counts_of(values, 4, counting)).values[0] == 0
        values[40] = values[39]
        summary = reduced(RepeatedFrames, counts_of(values, 4, counting))
        assert summary.values[0] == 1 and summary.law == "exact"
        assert summary.size(0, 1.0, 0.0) == ("1 frames are the same as the one before, 0 expected", 1 / 300)
    # full counters, and pixels that are always on, repeat by themselves
    full = np.full((300, 5, 5), 15)
    assert reduced(RepeatedFrames, counts_of(full, 4, "counter")).values[0] == 0
    assert reduced(RepeatedFrames, counts_of(full, 4, "frames")).values[0] == 0


# --- blank frames and full counters -------------------------------------------------------------------------------


def test_blank_frames() -> None:
    recording = qis(3, (400, 4, 4), 0.3)
    bits = bits_of(recording)
    assert reduced(RareFrames, recording).values[:2].tolist() == [(~bits.any(axis=(1, 2))).sum(), 0]
    bits[[3, 50]] = False
    bits[[10, 11, 12]] = True
    blank = (~bits.any(axis=(1, 2))).sum()
    assert reduced(RareFrames, qis_of(bits)).values[:2].tolist() == [blank, 3]
    # a dead pixel and one that is always on change nothing
    bits[:, 0, 0] = False
    bits[:, 2, 3] = True
    empty = (bits.sum(axis=(1, 2)) == 1).sum()
    assert reduced(RareFrames, qis_of(bits)).values[:2].tolist() == [empty, 3]
    counts = np.asarray(counted(2, (100, 4, 4), 0.5).frames).copy()
    counts[5], counts[6] = 0, 15
    assert reduced(RareFrames, counts_of(counts, 4)).values.tolist() == [1, 1, 0]


def test_blank_frames_are_at_most_poisson() -> None:
    """0.85^16 of 400 frames are empty: 29.7, with a binomial law that is as good as Poisson."""
    values = many(RareFrames, partial(qis, shape=(400, 4, 4), share=0.15), 200)
    laws.poisson_mean(int(values[:, 0].sum()), 200 * 400 * 0.85**16)
    p = 0.85**16
    assert abs(values[:, 0].var(ddof=1) / (400 * p * (1 - p)) - 1) < 5 * math.sqrt(2 / 200)
    with pytest.raises(AssertionError):
        laws.poisson_mean(int(values[:, 0].sum()), 200 * 400 * 0.86**16)


def test_full_counters() -> None:
    recording = counted(3, (100, 8, 8), 0.8, counting="counter")
    values = np.asarray(recording.frames)
    summary = reduced(FullCounters, recording)
    assert summary.values[0] == (values == 15).sum() > 0
    assert summary.where(0) == "counts of 15"
    numbers = many(FullCounters, partial(counted, shape=(100, 8, 8), share=0.8, counting="counter"), 100)
    mean = 6400 * stats.poisson.sf(14, 6.0)
    laws.poisson_mean(int(numbers.sum()), 100 * mean)
    # a counter with 3 of its 4 bits never is full
    short = counts_of(np.minimum(values, 7), 4, "counter")
    assert sigmas(FullCounters, short, partial(counted, shape=(100, 8, 8), share=0.8, counting="counter"))[0] < -2


# --- stamps -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tick", [1e-10, None])
def test_stamps_that_are_equal_or_late(tick: float | None) -> None:
    times = [np.array([1e-6, 4e-6, 5e-6, 5e-6, 9e-6]), np.array([]), np.array([2e-6, 2e-6, 2e-6, 1.2e-5])]
    recording = tr_of(times, grid(1, 3), 1e-5, tick)
    assert reduced(EqualStamps, recording).values.tolist() == [3, 1]
    rounded = tr_of([np.array([1e-6, 1e-5])], grid(1, 1), 1e-5, tick)  # to the very end, which is not behind it
    assert reduced(EqualStamps, rounded).values.tolist() == [0, 0]
    whole = tr(1, grid(4, 4), 1e6, 1e-3, 50e-9, tick=tick)
    assert reduced(EqualStamps, whole).values.tolist() == [0, 0]


def test_equal_stamps_are_poisson_without_a_dead_time() -> None:
    """n^2 / 2 pairs of a pixel, each with a chance of 1 in 1000."""
    make = partial(tr, layout=grid(1, 8), rates=2e4, exposure=1e-3, tick=1e-6)
    values = many(EqualStamps, make, 200)[:, 0]
    laws.poisson_mean(int(values.sum()), 200 * 8 * 20.0**2 / 2 / 1000 * 0.99)
    laws.histogram_is(values.astype(int), stats.poisson(1.59).pmf)
    with pytest.raises(AssertionError):
        laws.poisson_mean(int(values.sum()), 200 * 8 * 24.0**2 / 2 / 1000)


# --- gaps ---------------------------------------------------------------------------------------------------------


def literal_gap(recording: Recording) -> float:
    """The longest time (s) without an event, the ends of the exposure being events."""
    assert recording.events is not None
    times = recording.events.times
    exposure = recording.conditions.exposure
    return float(np.diff(np.sort(np.concatenate([times[times < exposure], [0.0, exposure]]))).max())


def literal_gap_score(recording: Recording) -> float:
    events = int((recording.events.times < recording.conditions.exposure).sum())  # type: ignore[union-attr]
    x = literal_gap(recording) / recording.conditions.exposure
    return float(stats.norm.ppf(math.exp(-(events + 1) * (1 - x) ** events)))


@pytest.mark.parametrize("rate", [0.0, 300.0, 2e4, 1e6])
@pytest.mark.parametrize("tick", [1e-10, None])
def test_the_longest_gap(rate: float, tick: float | None) -> None:
    recording = tr(3, grid(1, 23), rate, 1e-3, 50e-9, tick=tick)
    summary = reduced(Gaps, recording)
    assert math.isclose(float(summary.values[0]), literal_gap_score(recording), rel_tol=1e-6)
    text, _ = summary.size(0, float(summary.values[0]), 0.0)
    told = float(text.split()[0]) * {"ns": 1e-9, "us": 1e-6, "ms": 1e-3}[text.split()[1].strip(",")]
    assert math.isclose(told, literal_gap(recording), rel_tol=1e-3)


@pytest.mark.parametrize("bins", [1, 3, 50, 1000])
def test_the_longest_gap_is_found_between_bins_or_said_to_be_hidden(bins: int) -> None:
    rng = np.random.default_rng(bins)
    for _ in range(20):
        stamps = rng.random(200) * 1.1
        inside = np.sort(stamps[stamps < 1])
        longest = np.diff(np.concatenate([[0], inside, [1]])).max()
        for at_once in (7, 1 << 10):
            found, count, hidden = kernels.longest_gap(stamps, 0.0, 1.0, bins, at_once)
            assert count == len(inside)
            assert math.isclose(found, longest) or (hidden and found < longest)
            assert hidden == (bins <= 3)


def test_gaps_are_found_where_bins_hide_them() -> None:
    """Events like clockwork: no gap is as long as eight mean ones."""
    recording = tr_of([np.arange(1, 4000) * 1e-7, np.arange(1, 4000) * 1e-7 + 2e-8], grid(1, 2), 4000e-7)
    text, _ = reduced(Gaps, recording).size(0, float(reduced(Gaps, recording).values[0]), 0.0)
    assert text.startswith("99.9 ns")


@pytest.mark.parametrize("rate", [2e3, 1e5])
def test_scores_of_gaps_are_normal(rate: float) -> None:
    values = many(Gaps, partial(tr, layout=grid(1, 23), rates=rate, exposure=1e-3), 300)[:, 0]
    laws.distribution_is(values, stats.norm.cdf)
    assert np.abs(values).max() < 5
    with pytest.raises(AssertionError):  # of the longest as a share of the mean it does not hold
        laws.distribution_is(values + 0.5, stats.norm.cdf)


def test_a_stretch_of_lost_data_is_seen() -> None:
    """2,300 events in 1 ms, 0.43 us apart on average, the longest gap about 3.5 us: 8 us are lost."""
    layout = grid(1, 23)
    steady = partial(tr, layout=layout, rates=1e5, exposure=1e-3)
    lost = tr(9, layout, 1e5, 1e-3, change=lambda t: (np.abs(t - 0.4e-3) > 4e-6).astype(float))
    assert sigmas(Gaps, lost, steady)[0] > 4
    # and very long ones have a score, too
    silent = tr(9, layout, 1e6, 1e-3, change=lambda t: (t > 0.7e-3).astype(float))
    assert 90 < reduced(Gaps, silent).values[0] < 1e4


# --- all ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["qis", "str", "counts", "counter"])
@pytest.mark.parametrize("statistic", [RepeatedFrames, RareFrames])
def test_pieces_make_no_difference(statistic: type, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> Recording:
        recording = one_of_each()[kind]
        frames = np.asarray(recording.frames).copy()
        for f in (5, 8, 16, 17, 24):
            frames[f] = frames[f - 1]
        frames[30] = round(1e-5 / recording.tick) if recording.tick else 0
        return replace(recording, frames=frames, _kept={})

    whole = reduced(statistic, broken()).values
    assert whole.sum() == {(RepeatedFrames, "qis"): 3, (RareFrames, "qis"): 6}.get(
        (statistic, kind), 5 if statistic is RepeatedFrames else 6
    )
    monkeypatch.setattr("spadmnist.recording._CHUNK", 100)
    assert np.array_equal(reduced(statistic, broken()).values, whole)


@pytest.mark.parametrize("statistic", [RepeatedFrames, RareFrames, EqualStamps, Gaps, FullCounters])
def test_empty_and_full_data_have_the_same_cells(statistic: type) -> None:
    cells = set()
    if "tr" in statistic.modalities:
        for rate in (0.0, 1e6):
            cells.add(len(reduced(statistic, tr(1, grid(3, 4), rate, 1e-3, 50e-9)).values))
    for value in (0, 15):
        if "qis" in statistic.modalities:
            cells.add(len(reduced(statistic, qis_of(np.full((50, 3, 4), value > 0))).values))
        if "counts" in statistic.modalities:
            cells.add(len(reduced(statistic, counts_of(np.full((50, 3, 4), value), 4)).values))
    assert len(cells) == 1


def test_stamps_that_need_more_than_32_bits_are_refused() -> None:
    effects = [Detection(pdp=0.4), DeadTime(duration=50e-9), Tdc(resolution=1e-12)]
    sensor = Sensor(grid(2, 2), effects, "device").resolved()
    for frame, fits in ((4.29e-3, True), (4.3e-3, False)):
        conditions = Conditions(3 * frame, 3, frame, frame, 500e-9)
        streams = Streams(1, "level", "train", np.arange(1, dtype=np.uint64))
        recorded = sensor.expose(np.full((1, 4), 1e4), conditions, streams, ["str"])
        if fits:
            found = of_image(recorded, 0, capture("str", conditions), sensor.layout, 0.0)
            frames = np.asarray(found.frames[:])  # type: ignore[index]
            assert found.totals.tolist() == (frames < found.none).reshape(3, -1).sum(axis=0).tolist()
            continue
        with pytest.raises(InputError, match=r"flat: STR stamps of 1 ps in frames of 4\.3 ms need"):
            of_image(recorded, 0, capture("str", conditions), sensor.layout, 0.0)


@pytest.mark.parametrize("modality", [pytest.param("tr", marks=pytest.mark.slow), "qis", "str", "counts"])
def test_what_the_sensor_makes_is_whole(modality: str) -> None:
    """The package's own sensor, with all of its classes for data: nothing is out of order, repeated or silent."""
    effects = [Detection(pdp=0.4), DarkCounts(rate=100.0), DeadTime(duration=50e-9), Tdc(resolution=1e-10)]
    sensor = Sensor(grid(8, 8), effects, "device").resolved()
    conditions = Conditions(4e-3, 400, 1e-5, 1e-5, 500e-9, 3 if modality == "counts" else 0, "counter")
    streams = Streams(1, "level", "train", np.arange(40, dtype=np.uint64))
    recorded = sensor.expose(np.full((40, 64), 5e5), conditions, streams, [modality])
    made = [of_image(recorded, i, capture(modality, conditions), sensor.layout, 50e-9) for i in range(40)]
    for statistic in (RepeatedFrames, RareFrames, EqualStamps, Gaps, FullCounters):
        if modality in statistic.modalities:
            values = many(statistic, lambda seed: made[seed - 1000], 40)
            if reduced(statistic, made[0]).law == "exact":  # there are none
                assert not values.any()
            else:
                assert np.abs(values).max() < 5 or statistic is FullCounters
            assert reduced(statistic, made[0]).values.size == values.shape[1]
    for statistic in (PixelMap, Surface, Spread, Trend, SlowSeries, PixelFano, ArrayFano):
        assert reduced(statistic, made[1]).values.size == reduced(statistic, made[2]).values.size
