"""Recordings of the simplest of sensors, made with numpy alone: steady light, perhaps a dead time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

from spadmnist.effects import Conditions
from spadmnist.events import Events, Layout
from spadmnist.recording import Capture, Light, Recording
from spadmnist.statistics import Statistic, Summary

FRAME = 1e-5  # s


def grid(rows: int, columns: int) -> Layout:
    return Layout(rows, columns, 25e-12, 1.0)


def capture(modality: str, conditions: Conditions) -> Capture:
    return Capture("flat", modality, Light(500e-9), conditions)


def tr_of(
    rows: list[np.ndarray], layout: Layout, exposure: float, tick: float | None = 1e-10, dead_time: float = 0.0
) -> Recording:
    """From the times (s) of each pixel."""
    offsets = np.concatenate([[0], np.cumsum([len(row) for row in rows])]).astype(np.int64)
    times = np.concatenate(rows) if rows else np.zeros(0)
    conditions = Conditions(exposure, 100, exposure / 100, exposure / 100, 500e-9)
    if tick is None:
        events = Events(times, offsets, layout.pixels, end=exposure)
    else:
        ticks = np.floor(times / tick).astype(np.uint32 if exposure / tick < 2**32 else np.uint64)
        events = Events(None, offsets, layout.pixels, ticks, tick, end=exposure)
    return Recording(capture("tr", conditions), layout, events, None, tick, dead_time)


def tr(
    seed: int,
    layout: Layout,
    rates: np.ndarray | float,
    exposure: float,
    dead_time: float = 0.0,
    change: Callable[[np.ndarray], np.ndarray] | None = None,
    tick: float | None = 1e-10,
) -> Recording:
    """Poisson light at `rates` (1/s, per pixel), then the dead time. change: time (s) -> share that is kept."""
    rng = np.random.default_rng(seed)
    rows = []
    for rate in np.broadcast_to(rates, (layout.pixels,)):
        times = np.sort(rng.random(rng.poisson(rate * exposure)) * exposure)
        if change is not None:
            times = times[rng.random(len(times)) < change(times)]
        rows.append(live(times, dead_time))
    return tr_of(rows, layout, exposure, tick, dead_time)


@njit
def live(times: np.ndarray, dead_time: float) -> np.ndarray:
    """What a dead time lets through."""
    kept = np.empty(times.size)
    n = 0
    for t in times:
        if n == 0 or t - kept[n - 1] >= dead_time:
            kept[n] = t
            n += 1
    return kept[:n].copy()


def qis_of(bits: np.ndarray) -> Recording:
    """From bits (frames, rows, columns)."""
    frames, rows, columns = bits.shape
    conditions = Conditions(frames * FRAME, frames, FRAME, FRAME, 500e-9)
    return Recording(capture("qis", conditions), grid(rows, columns), None, np.packbits(bits, axis=2))


def qis(seed: int, shape: tuple[int, int, int], share: Any) -> Recording:
    """Frames in which each pixel has a detection with a probability `share` (scalar, map, or for every frame)."""
    return qis_of(np.random.default_rng(seed).random(shape) < share)


def str_of(stamps: np.ndarray, tick: float = 1e-8) -> Recording:
    """From stamps (frames, rows, columns), in ticks."""
    frames, rows, columns = stamps.shape
    conditions = Conditions(frames * FRAME, frames, FRAME, FRAME, 500e-9)
    return Recording(capture("str", conditions), grid(rows, columns), None, stamps.astype(np.uint32), tick)


def stamped(seed: int, shape: tuple[int, int, int], share: Any, tick: float = 1e-8) -> Recording:
    """Frames with the first stamp of light that is steady in each; one has a detection with a probability `share`.

    share: scalar, map, or for every frame.
    """
    first = np.random.default_rng(seed).exponential(FRAME / -np.log1p(-np.asarray(share)), shape)
    return str_of(np.minimum(np.floor(first / tick), round(FRAME / tick)), tick)


def waits(frames: np.ndarray, none: int) -> np.ndarray:
    """How long each of the frames waited, of the time between the first stamp of all and the last."""
    first, last = frames[frames < none].min(), frames[frames < none].max()
    return np.where(frames < none, (frames.astype(float) - first + 0.5) / (last - first + 1), 1.0)


def in_equal_times(recording: Recording, axes: tuple[int, ...], blocks: int = 0) -> np.ndarray:
    """Literally: first stamps that there would be if all had waited as long for them. axes: that are summed over.

    blocks: of as many frames each, whose sums are meant.
    """
    frames = np.asarray(recording.frames[:])  # type: ignore[index]
    hit = frames < recording.none
    waited = waits(frames, recording.none)
    if blocks:
        size = len(frames) // blocks
        hit, waited = (x[: blocks * size].reshape(blocks, -1) for x in (hit, waited))
    n, time = hit.sum(axis=axes).ravel(), waited.sum(axis=axes).ravel()
    more = 3 * time.mean() / n.mean()
    found = n * (time.mean() + more) / (time + more)
    return np.rint(found) if n.mean() < 100 else found


def counts_of(values: np.ndarray, bits: int, counting: str = "frames") -> Recording:
    """From counts (frames, rows, columns)."""
    frames, rows, columns = values.shape
    merged = frames * (2**bits - 1 if counting == "frames" else 1)
    conditions = Conditions(merged * FRAME, merged, FRAME, FRAME, 500e-9, bits, counting)
    return Recording(capture("counts", conditions), grid(rows, columns), None, values.astype(np.uint16))


def counted(seed: int, shape: tuple[int, int, int], share: Any, bits: int = 4, counting: str = "frames") -> Recording:
    """Counts: sums of 2^bits - 1 binary frames, or counters that stop there (with half as many expected at 1)."""
    rng, largest = np.random.default_rng(seed), 2**bits - 1
    if counting == "frames":
        return counts_of(rng.binomial(largest, np.broadcast_to(share, shape)), bits, counting)
    return counts_of(np.minimum(rng.poisson(np.broadcast_to(share, shape) * largest / 2), largest), bits, counting)


def one_of_each(seed: int = 1) -> dict[str, Recording]:
    """A small recording of every kind."""
    return {
        "tr": tr(seed, grid(6, 11), 2e5, 3e-3, 50e-9),
        "tr without ticks": tr(seed, grid(6, 11), 2e5, 3e-3, 50e-9, tick=None),
        "qis": qis(seed, (403, 6, 11), 0.2),
        "str": stamped(seed, (403, 6, 11), 0.2),
        "counts": counted(seed, (130, 6, 11), 0.3),
        "counter": counted(seed, (130, 6, 11), 0.3, counting="counter"),
    }


def reduced(statistic: type[Statistic], recording: Recording) -> Summary:
    """The summary, which there must be; its words must be there for every cell."""
    summary = statistic().reduce(recording)
    assert summary is not None
    values = summary.values
    assert values.dtype == np.float64 and values.ndim == 1 and np.isfinite(values).all()
    for cell in {0, len(values) // 2, len(values) - 1}:
        text, number = summary.size(cell, float(values[cell]), float(values.mean()))
        assert text and summary.where(cell) and type(number) is float and np.isfinite(number)
    for name in ("scale", "axis"):
        found = getattr(summary, name)
        assert found is None or found.shape == values.shape
    return summary


def many(statistic: type[Statistic], make: Callable[[int], Recording], number: int, first: int = 1000) -> np.ndarray:
    """(recordings, cells) values of many recordings. make: seed -> recording."""
    found = []
    for seed in range(first, first + number):
        summary = statistic().reduce(make(seed))
        assert summary is not None
        found.append(summary.values)
    return np.array(found)


def sigmas(statistic: type[Statistic], changed: Recording, make: Callable[[int], Recording]) -> np.ndarray:
    """By how many standard deviations of the unchanged recordings (60 of them) each cell of the changed one is off."""
    null = many(statistic, make, 60)
    found = statistic().reduce(changed)
    assert found is not None
    if found.law == "poisson":
        mean = np.maximum(null.mean(axis=0), 0.1)
        return np.asarray(2.0 * (np.sqrt(found.values + 0.375) - np.sqrt(mean + 0.375)))
    return np.asarray((found.values - null.mean(axis=0)) / null.std(axis=0, ddof=1))
