"""Intervals of a pixel: against literal versions, their laws, and what they are made to see."""

from __future__ import annotations

import math
from functools import partial

import laws
import null_laws
import numpy as np
import pytest
from scipy import stats
from simple_sensor import grid, live, many, one_of_each, reduced, sigmas, tr, tr_of

from spadmnist.recording import Recording
from spadmnist.statistics._counting import whole
from spadmnist.statistics._scores import pairs_law, unequal_pairs_law
from spadmnist.statistics.intervals import (
    EarlyIntervals,
    EdgeIntervals,
    FineIntervals,
    Intervals,
    Rescaled,
    RescaledLag,
)

ALL = (EdgeIntervals, Intervals, FineIntervals, Rescaled, RescaledLag)


def ticks_of(recording: Recording) -> tuple[list[np.ndarray], float]:
    """(the ticks of each pixel, the tick); where there is none it is 10 ps."""
    assert recording.events is not None
    tick = recording.tick or 1e-11
    rows = [recording.events.row(p) for p in range(recording.pixels)]
    return [np.rint(row / tick).astype(np.int64) for row in rows], tick


@pytest.mark.parametrize("kind", ["tr", "tr without ticks"])
def test_intervals_of_a_small_recording(kind: str) -> None:
    recording = one_of_each()[kind]
    rows, tick = ticks_of(recording)
    gaps = np.concatenate([np.diff(row) for row in rows])

    steps = np.rint((40e-9 + 0.5e-9 * np.arange(61)) / tick)
    summary = reduced(EdgeIntervals, recording)
    wanted = [(gaps < steps[0]).sum(), *np.histogram(gaps, steps - 0.5)[0]]
    assert summary.values.tolist() == wanted and summary.values.sum() > 0
    assert summary.where(0) == "intervals below 40 ns" and summary.where(60) == "intervals of 69.5 to 70 ns"

    edges = np.unique(np.rint(np.geomspace(70e-9, 3e-3, 47) / tick))
    summary = reduced(Intervals, recording)
    assert summary.values.tolist() == np.histogram(gaps, [*(edges - 0.5), np.inf])[0].tolist()
    assert summary.where(0).startswith("intervals of 70 to 88") and summary.where(46) == "intervals beyond 3 ms"
    assert summary.size(3, 12.0, 10.0)[1] == 2 / len(np.concatenate(rows))

    fine = np.rint((70e-9 + 1e-9 * np.arange(981)) / tick)
    summary = reduced(FineIntervals, recording)
    assert summary.values.tolist() == np.histogram(gaps, fine - 0.5)[0].tolist() and summary.values.sum() > 0
    assert summary.where(0) == "intervals of 70 to 71 ns" and summary.where(979).startswith("intervals of 1.049")

    # each pixel by its own rate
    counts, sums, products = np.zeros(20), np.zeros(6), np.zeros(6)
    for row in rows:
        gap = np.diff(row) - 50e-9 / tick
        if len(gap) >= 16:
            u = 1 - np.exp(-np.maximum(gap, 0) / gap.mean())
            counts += np.histogram(u, 20, (0, 1))[0]
            for k, lag in enumerate((1, 2, 3, 5, 10, 20)):
                if len(u) > lag:
                    sums[k] += ((u[lag:] - 0.5) * (u[:-lag] - 0.5)).sum()
                    products[k] += len(u) - lag
    assert reduced(Rescaled, recording).values.tolist() == counts.tolist()
    summary = reduced(RescaledLag, recording)
    np.testing.assert_allclose(summary.values, 12 * sums / np.sqrt(products), rtol=1e-9)
    text, difference = summary.size(0, float(summary.values[0]), 0.0)
    assert math.isclose(difference, 12 * sums[0] / products[0]) and text.startswith("correlation ")


def test_early_intervals_of_pixels() -> None:
    """Literally: the pairs in one pixel among as many short intervals that fall on the pixels by lot."""
    rates = np.repeat([1.8e6, 2e6, 2.2e6, 2e7], [12, 6, 5, 1])  # the last is left out: it would have nearly all pairs
    recording = tr(7, grid(4, 6), rates, 1e-3, 50e-9)
    rows, tick = ticks_of(recording)
    n = np.array([len(row) for row in rows])
    rng = np.random.default_rng(1)
    summary = reduced(EarlyIntervals, recording)
    for cell, bound in enumerate((45, 48, 49.5, 50, 51, 55, 70, 150)):
        assert summary.where(cell) == f"intervals below {bound:g} ns, unlike in the pixels"
        number = np.array([(np.diff(row) * tick < (bound - 0.01) * 1e-9).sum() for row in rows])
        pairs = (number[:-1] * (number[:-1] - 1)).sum() / 2
        text, share = summary.size(cell, float(summary.values[cell]), 0.0)
        assert text.startswith(f"{whole(pairs)} pairs in the same pixel of {number.sum()}, ")
        if bound <= 50:
            assert number.sum() == 0 and share == 0 and abs(summary.values[cell]) < 4
            continue
        chance = (-n * np.expm1(-n / (1e-3 - 50e-9 * n) * (bound - 50) * 1e-9))[:-1]
        drawn = rng.multinomial(number[:-1].sum(), chance / chance.sum(), 100_000)
        usual = (drawn * (drawn - 1)).sum(axis=1) / 2
        low, high = stats.norm.ppf([(usual < pairs).mean(), (usual <= pairs).mean()])
        assert low - 0.05 <= summary.values[cell] <= high + 0.05
        assert abs(float(text.split()[-2]) - usual.mean()) < 0.05 * usual.mean() + 0.5


@pytest.mark.parametrize("spread", [0.0, 0.2, 0.5])
@pytest.mark.parametrize("number", [5, 50, 500, 5000])
def test_the_law_of_pairs_in_unequal_boxes(spread: float, number: int) -> None:
    rng = np.random.default_rng(number)
    chances = np.exp(spread * rng.standard_normal(64))
    law = unequal_pairs_law(number, chances / chances.sum())
    drawn = rng.multinomial(number, chances / chances.sum(), 40_000)
    pairs = (drawn * (drawn - 1)).sum(axis=1) / 2
    laws.mean_is(pairs, float(law.mean))
    laws.variance_is(pairs, float(law.variance))
    third = ((pairs - pairs.mean()) ** 3).mean()
    assert 0.7 < third / float(law.third) < 1.4
    if spread == 0:
        equal = pairs_law(np.asarray(number), 64)
        assert math.isclose(law.mean, equal.mean) and math.isclose(law.variance, equal.variance, rel_tol=1e-9)


def test_one_bright_pixel_does_not_hide_the_others() -> None:
    rng = np.random.default_rng(3)
    rows = []
    for pixel, tau in enumerate(50e-9 + 4e-9 * rng.standard_normal(24)):
        rate = 6e6 if pixel == 5 else 2e6
        rows.append(live(np.sort(rng.random(rng.poisson(rate * 1e-3)) * 1e-3), float(tau)))
    found = reduced(EarlyIntervals, tr_of(rows, grid(4, 6), 1e-3, 1e-10, 50e-9))
    assert found.values[1:5].min() > laws.z_bound()


def test_pixels_whose_dead_times_differ_are_seen_and_jitter_is_not() -> None:
    usual = many(EarlyIntervals, BRIGHT, 60)

    def found(recording: Recording) -> np.ndarray:
        return (reduced(EarlyIntervals, recording).values - usual.mean(axis=0)) / usual.std(axis=0, ddof=1).clip(1.0)

    rng = np.random.default_rng(3)
    rows = []
    for tau in 50e-9 + 4e-9 * rng.standard_normal(24):
        rows.append(live(np.sort(rng.random(rng.poisson(2000)) * 1e-3), float(tau)))
    assert found(tr_of(rows, grid(4, 6), 1e-3, 1e-10, 50e-9))[[0, 1, 2, 3, 4, 5]].min() > laws.z_bound()
    blurred = [BRIGHT(8).events.row(p) for p in range(24)]  # type: ignore[union-attr]
    blurred = [np.sort(np.clip(row + 4e-9 * rng.standard_normal(len(row)), 0, 0.999e-3)) for row in blurred]
    jittered = tr_of(blurred, grid(4, 6), 1e-3, 1e-10, 50e-9)
    assert np.abs(found(jittered)).max() < laws.z_bound(laws.FALSE_ALARM / 8)
    assert reduced(EdgeIntervals, jittered).values[:20].sum() > 100

    # and afterpulses that only some pixels have
    some = [with_afterpulses(1, 0.1), DIM(2)]
    mixed = [some[p % 2].events.row(p) for p in range(24)]  # type: ignore[union-attr]
    assert sigmas(EarlyIntervals, tr_of(mixed, grid(4, 6), 2e-2, 1e-10, 50e-9), DIM)[6:].min() > laws.z_bound()
    everywhere = np.abs(sigmas(EarlyIntervals, with_afterpulses(1, 0.1), DIM)[6:]).max()
    assert everywhere < laws.z_bound(laws.FALSE_ALARM / 2)


def test_cells_belong_to_the_conditions() -> None:
    """Not finer than a tick, nothing below 0, and there for recordings without a detection."""
    coarse = [(3e-7, 50e-9, 1), (1e-6, 50e-9, 1), (1e-6, 0.0, 1)]
    for tick, dead_time, cells in ((1e-9, 50e-9, 31), (1e-8, 50e-9, 4), (1e-10, 0.0, 40), (1e-10, 4e-9, 48), *coarse):
        made = [tr(1, grid(1, 4), rate, 1e-3, dead_time, tick=tick) for rate in (0.0, 1e5)]
        for recording in made:
            assert len(reduced(EdgeIntervals, recording).values) == cells
        assert len({len(reduced(Intervals, r).values) for r in made}) == 1
        assert EdgeIntervals().reduce(made[0]).values.sum() == 0  # type: ignore[union-attr]
        assert reduced(Rescaled, made[0]).values.tolist() == [0.0] * 20
        assert len(reduced(RescaledLag, made[0]).values) == 6
        assert EarlyIntervals().reduce(made[0]) is None  # of four pixels
        few = [tr(1, grid(4, 4), rate, 1e-3, dead_time, tick=tick) for rate in (0.0, 1e3, 1e5)]
        early = [EarlyIntervals().reduce(recording) for recording in few]
        assert len({summary and len(summary.values) for summary in early}) == 1
        assert (early[0] is None) == (tick > dead_time + 2e-7)  # nothing is early in so coarse a clock
        assert all(np.isfinite(summary.values).all() for summary in early if summary)
    assert reduced(EdgeIntervals, tr(1, grid(1, 4), 1e5, 1e-3, 0.0)).where(0) == "intervals of 0 to 500 ps"


BRIGHT = partial(tr, layout=grid(4, 6), rates=2e6, exposure=1e-3, dead_time=50e-9)
DIM = partial(tr, layout=grid(4, 6), rates=2e4, exposure=2e-2, dead_time=50e-9)
MIXED = partial(tr, layout=grid(4, 6), rates=np.geomspace(2e2, 2e5, 24), exposure=2e-2, dead_time=50e-9)


UNLIKE = partial(tr, layout=grid(8, 8), rates=1.5e6 * np.geomspace(0.7, 1.4, 64), exposure=1e-3, dead_time=50e-9)


@pytest.mark.parametrize("steady", [BRIGHT, DIM, MIXED, UNLIKE], ids=["bright", "dim", "mixed", "unlike"])
def test_laws_of_steady_light(steady: partial[Recording]) -> None:
    for statistic, least in ((EdgeIntervals, 0.8), (Intervals, 0.6), (Rescaled, 0.9)):
        null_laws.poisson(many(statistic, steady, 120), least)
    lag = many(RescaledLag, steady, 120)
    null_laws.normal(lag, spread=None)
    bound = laws.z_bound(laws.FALSE_ALARM / (2 * lag.shape[1]))
    assert np.abs(np.log(lag.std(axis=0, ddof=1))).max() < bound / math.sqrt(2 * 119)
    assert np.abs(lag.mean(axis=0)).max() < 0.2 + bound / math.sqrt(120)  # the rate is fitted
    # the rate is fitted, so that u is not quite even where a pixel has few intervals; here it is, to 1 %
    share = many(Rescaled, steady, 60).sum(axis=0)
    assert np.abs(share / share.mean() - 1).max() < 5 / math.sqrt(share.mean()) + 0.02
    early = many(EarlyIntervals, steady, 120)
    null_laws.normal(early[:, :6])
    null_laws.normal(early, spread=None)  # of what is not rare there are fewer pairs than go by chance alone


def test_laws_fail_where_detections_come_in_clumps() -> None:
    def clumped(seed: int) -> Recording:
        rng = np.random.default_rng(seed)
        rows = []
        for _ in range(24):
            starts = np.repeat(rng.random(rng.poisson(20)) * 1.9e-2, 20)
            rows.append(live(np.sort(starts + rng.random(len(starts)) * 2e-5), 50e-9))
        return tr_of(rows, grid(4, 6), 2e-2, 1e-10, 50e-9)

    with pytest.raises(AssertionError):
        null_laws.poisson(many(Intervals, clumped, 60))


def with_afterpulses(seed: int, share: float = 0.02, lifetime: float = 30e-9) -> Recording:
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(24):
        times = rng.random(rng.poisson(400)) * 2e-2
        late = times[rng.random(len(times)) < share]
        times = np.sort(np.concatenate([times, late + 50e-9 + rng.exponential(lifetime, len(late))]))
        rows.append(live(times[times < 2e-2], 50e-9))
    return tr_of(rows, grid(4, 6), 2e-2, 1e-10, 50e-9)


def test_afterpulses_and_another_dead_time_are_seen() -> None:
    found = {s: sigmas(s, with_afterpulses(1), DIM) for s in (EdgeIntervals, Intervals, Rescaled)}
    # 9600 detections with 192 afterpulses, of which half come within 20 ns; and none by chance
    assert found[EdgeIntervals][21:].sum() / math.sqrt(40) > 9
    assert found[Intervals][0] > 6 and np.abs(found[Intervals][10:]).max() < 5
    assert found[Rescaled][0] > 5
    longer = tr(1, grid(4, 6), 2e6, 1e-3, 52e-9)
    found = {s: sigmas(s, Recording(**{**longer.__dict__, "dead_time": 50e-9, "_kept": {}}), BRIGHT) for s in ALL[:2]}
    assert found[EdgeIntervals][21:25].max() < -9 and np.abs(found[EdgeIntervals][26:]).max() < 5
    assert np.abs(found[Intervals]).max() < 5


def test_a_pixel_that_blinks_has_intervals_alike() -> None:
    def blinking(t: np.ndarray) -> np.ndarray:
        return np.where(np.floor(t / 1e-3) % 2 == 0, 1.0, 0.5)

    changed = tr(1, grid(4, 6), 2.7e4, 2e-2, 50e-9, change=blinking)
    assert sigmas(RescaledLag, changed, DIM)[:3].min() > 5
