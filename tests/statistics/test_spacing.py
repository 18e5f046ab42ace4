"""The array's detections in the order of time: against literal versions, their laws, and bursts."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import laws
import null_laws
import numpy as np
import pytest
from simple_sensor import grid, many, one_of_each, reduced, sigmas, stamped, str_of, tr, tr_of

from spadmnist import recording as recordings
from spadmnist.events import Events
from spadmnist.recording import Recording
from spadmnist.statistics._counting import guide, logarithmic, place, sort_ticks
from spadmnist.statistics._order import time_order
from spadmnist.statistics._walk import crowd_edges, walk
from spadmnist.statistics.spacing import Crowds, Multiplicity, Spacing

SIZES = (2, 3, 4, 5, 9, 17)


def frames_of(recording: Recording) -> tuple[list[np.ndarray], float]:
    """(ticks in order, of the exposure or of each frame; the tick)."""
    if recording.events is not None:
        tick = recording.tick or 1e-11
        return [np.sort(np.rint(recording.events.times / tick).astype(np.int64))], tick
    assert recording.tick is not None
    frames = np.asarray(recording.frames[:]).reshape(recording.n_frames, -1).astype(np.int64)  # type: ignore[index]
    return [np.sort(frame[frame < recording.none]) for frame in frames], recording.tick


def clusters(frames: list[np.ndarray], gap: int) -> list[int]:
    found = [0] * 6
    for frame in frames:
        for run in np.split(frame, np.flatnonzero(np.diff(frame) > gap) + 1):
            if len(run) > 1:
                found[max(k for k in range(6) if SIZES[k] <= len(run))] += 1
    return found


def crowd(seed: int) -> Recording:
    """More than is sorted at a time, unevenly, with many at the same tick."""
    rng = np.random.default_rng(seed)
    rows = [np.sort(rng.random(9000) ** 3 * 1e-3) for _ in range(25)]
    rows[7] = np.sort(np.concatenate([rows[7], np.full(3000, 5e-4), 2e-4 + rng.random(40_000) * 1e-9]))
    return tr_of(rows, grid(5, 5), 1e-3, 1e-10)


@pytest.mark.parametrize("kind", ["tr", "tr without ticks", "str", "crowd", "coarse"])
def test_a_small_recording(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    more = {"crowd": lambda: crowd(1), "coarse": lambda: tr(2, grid(4, 4), 2e6, 1e-4, tick=2e-8)}
    recording = more[kind]() if kind in more else one_of_each()[kind]
    frames, tick = frames_of(recording)
    gaps = np.concatenate([np.diff(frame) for frame in frames])
    longest = recording.none if kind == "str" else round(recording.conditions.exposure / tick)
    edges = logarithmic(1, longest, 10)
    summary = reduced(Spacing, recording)
    wanted = [(gaps == 0).sum(), *np.histogram(gaps, [*(edges - 0.5), np.inf])[0]]
    assert summary.values.tolist() == wanted
    assert summary.where(0) == "the whole array, two at the same tick"
    found = reduced(Multiplicity, recording)
    wide = [max(1, round(gap / tick)) for gap in (1e-9, 10e-9)]
    assert found.values.tolist() == [n for gap in wide for n in clusters(frames, gap)]
    if kind == "str":
        monkeypatch.setattr(recordings, "_CHUNK", 1)
        assert np.array_equal(reduced(Spacing, one_of_each()[kind]).values, summary.values)
    else:
        pairs = [
            (np.arange(len(t)) - np.searchsorted(t, t - lag, side="right")).sum() for t in frames for lag in lags(tick)
        ]
        assert np.cumsum(walk(recording).pairs).tolist() == pairs
        (times,) = frames
        edges, chance = crowd_edges(recording)
        for rank, upto, number in zip((2, 4, 8, 16, 32), edges, walk(recording).crowds, strict=True):
            assert number.tolist() == np.histogram(times[rank:] - times[:-rank], [0, *(upto - 0.5)])[0].tolist()
        if kind == "tr":
            assert np.sum(chance, axis=1) == pytest.approx(0.1 * recording.totals.sum(), rel=0.05)
    if kind == "tr":
        text = "clusters of 5 to 8 detections of the whole array, each within 10 ns of the next"
        assert found.where(9) == text and found.size(9, 2.0, 1.0)[1] == 5 / recording.totals.sum()


def lags(tick: float) -> list[int]:
    return sorted({max(1, round(lag / tick)) for lag in (1e-9, 3e-9, 10e-9, 30e-9, 100e-9)})


def test_nothing_to_say() -> None:
    assert Spacing().reduce(tr(1, grid(1, 1), 1e5, 1e-3)) is None
    for number in range(5):  # fewer than any crowd has, or just as many as the smallest
        few = tr_of([np.arange(number) * 1e-8, np.zeros(0)], grid(1, 2), 1e-3, 1e-10)
        assert walk(few).crowds.sum() == max(0, number - 2) + max(0, number - 4)
        assert np.abs(reduced(Crowds, few).values).max() < (6 if number else 4)
    assert Crowds().reduce(tr(1, grid(1, 1), 1e5, 1e-3)) is None
    for empty in (tr(1, grid(2, 2), 0.0, 1e-3), str_of(np.full((50, 2, 2), 1000))):
        assert reduced(Spacing, empty).values.sum() == 0 and reduced(Multiplicity, empty).values.sum() == 0


def test_bins_are_found_at_once() -> None:
    edges = logarithmic(1, 10**9, 10)
    fence, start = guide(edges)
    numbers = np.unique(np.concatenate([np.arange(2000), edges, edges - 1, np.geomspace(1, 1e12, 5000).astype(int)]))
    assert [place.py_func(np.int64(n), fence, start) for n in numbers] == (
        np.searchsorted(edges, numbers, side="right") - 1
    ).tolist()
    with pytest.raises(ValueError, match="too close"):
        guide(np.array([1000, 1001, 1002]))


def test_sorting() -> None:
    rng = np.random.default_rng(1)
    for count in (0, 1, 400, 5000, 70_000):
        for raw in (rng.integers(0, 1 << 40, count), rng.integers(5, 90, count), np.arange(count)[::-1] - (1 << 30)):
            out = np.full(count + 3, -7)
            sort_ticks(raw.astype(np.int64), count, 0, 1 << 40, out, 3)
            assert np.array_equal(out[3:], np.sort(raw)) and (out[:3] == -7).all()


@pytest.mark.parametrize("rates", [0.0, 3e4, 3e6])
def test_the_order_of_time(rates: float) -> None:
    """Of many pixels, of some in which stamps are not in order, and of stamps behind the end."""
    recording = tr(3, grid(7, 9), rates, 5e-3, tick=1e-10)
    ticks = np.asarray(recording.events.ticks).astype(np.int64)  # type: ignore[union-attr]
    pixels = recording.events.pixel  # type: ignore[union-attr]
    for change in (0, 1 << 30, -7):
        changed = ticks.copy()
        changed[3::50] = abs(changed[3::50] + change)
        events = Events(None, recording.events.offsets, 63, changed.astype(np.uint64), 1e-10)  # type: ignore[union-attr]
        words, bits = time_order(replace(recording, events=events, _kept={}))
        wanted = sorted(zip(changed.tolist(), pixels.tolist(), strict=True))
        assert [(int(w) >> bits, int(w) & ((1 << bits) - 1)) for w in words] == wanted


STEADY = {
    "tr": partial(tr, layout=grid(5, 6), rates=3e5, exposure=2e-3, dead_time=50e-9),
    "tr, bright": partial(tr, layout=grid(5, 6), rates=1e7, exposure=1e-4),
    "tr, dim": partial(tr, layout=grid(5, 6), rates=2e3, exposure=1e-2),
    "str": partial(stamped, shape=(300, 8, 8), share=0.2, tick=1e-10),
}


@pytest.mark.parametrize("kind", STEADY)
def test_laws_of_steady_light(kind: str) -> None:
    null_laws.poisson(many(Spacing, STEADY[kind], 120), 0.6)
    null_laws.poisson(many(Multiplicity, STEADY[kind], 120), 0.7)
    if kind != "str":
        scores = many(Crowds, STEADY[kind], 120)
        null_laws.normal(scores, spread=None)
        if kind != "tr":  # without a dead time nothing but chance is at work
            bound = laws.z_bound(laws.FALSE_ALARM / 20)
            assert np.abs(scores.mean(axis=0)).max() < (bound + 1.0) / np.sqrt(120)
            assert np.abs(np.log(scores.std(axis=0))).max() < bound / np.sqrt(2 * 119) + 0.05


def test_crowds_of_few_detections_have_no_tail() -> None:
    """Crowds come in clumps: where half of one is expected, ten of 33 detections are nothing rare.

    5,000 detections of steady light, 600 times: the largest score of each cell in units of its spread. That of a normal
    variable is above 5.8 with a chance of 600 x 20 x 3.3e-9 = 4e-5; independent numbers of this mean have 8.
    """
    scores = many(Crowds, partial(tr, layout=grid(5, 6), rates=1.67e5, exposure=1e-3), 600)
    assert (scores.max(axis=0) - scores.mean(axis=0)).max() < 5.8 * scores.std(axis=0).max()
    assert ((scores.max(axis=0) - scores.mean(axis=0)) / scores.std(axis=0)).max() < 5.8


def behind_a_bus(seed: int, service: float, places: int) -> Recording:
    """What is left of steady light where one event is served at a time, and those that find no place are lost."""
    whole = STEADY["tr, bright"](seed)
    assert whole.events is not None
    rows = [whole.events.row(p) for p in range(30)]
    order = sorted((t, p) for p, row in enumerate(rows) for t in row)
    left: list[list[float]] = [[] for _ in rows]
    served: list[float] = []
    for t, p in order:
        served = [end for end in served if end > t]
        if len(served) < places:
            served.append((served[-1] if served else t) + service)
            left[p].append(t)
    return tr_of([np.array(row) for row in left], grid(5, 6), 1e-4, whole.tick)


def test_a_queue_that_is_full_is_seen() -> None:
    """300 million events/s, each 1.5 ns on the bus, four places: of 30,000 detections one in 200 is lost."""
    queued = partial(behind_a_bus, service=1.5e-9, places=4)
    lost = 1 - queued(0).totals.sum() / STEADY["tr, bright"](0).totals.sum()
    assert 0.003 < lost < 0.01
    assert np.abs(sigmas(Spacing, queued(0), STEADY["tr, bright"])).max() < 4.5
    crowds = sigmas(Crowds, queued(0), STEADY["tr, bright"])
    summary = reduced(Crowds, queued(0))
    worst = int(np.argmin(crowds))
    assert crowds[worst] < -4.5
    assert summary.where(worst).startswith(("5 successive", "9 successive"))
    assert summary.size(worst, summary.values[worst], 0.0)[1] < 0


def bursts(seed: int, number: int = 3) -> Recording:
    rng = np.random.default_rng(seed)
    rows = [rng.random(rng.poisson(600)) * 2e-3 for _ in range(30)]
    for _ in range(number):
        at = rng.random() * 1.9e-3
        for p in rng.choice(30, 12, replace=False):
            rows[p] = np.append(rows[p], at + rng.random() * 1e-9)
    return tr_of([np.sort(row) for row in rows], grid(5, 6), 2e-3, 1e-10, 50e-9)


def test_bursts_are_seen() -> None:
    """Three bursts of 12 pixels among 18,000 detections; by chance there are none."""
    assert many(Multiplicity, STEADY["tr"], 60)[:, [4, 5, 10, 11]].sum() == 0
    summary = reduced(Multiplicity, bursts(1))
    assert summary.values[4] == 3 and summary.values[10] == 3
    assert summary.size(4, 3.0, 0.0)[0] == "3 clusters, 0 expected"
    assert sigmas(Multiplicity, bursts(1), STEADY["tr"])[4] > 2
    # among all spacings they are not many
    assert np.abs(sigmas(Spacing, bursts(1), STEADY["tr"])).max() < 5
    with pytest.raises(AssertionError):
        null_laws.poisson(many(Spacing, lambda seed: bursts(seed, 10 * (seed % 2)), 120), 0.6)
