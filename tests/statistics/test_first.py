"""First arrivals: against a literal version, their law, and frames that are not what they should be."""

from __future__ import annotations

import itertools
import math
from functools import partial

import laws
import null_laws
import numpy as np
import pytest
from simple_sensor import FRAME, many, reduced, sigmas, stamped, str_of

from spadmnist import recording as recordings
from spadmnist.recording import Recording
from spadmnist.statistics.first import FirstArrivals, FrameEnds, FrameLimits

STEADY = partial(stamped, shape=(500, 8, 8), share=0.3, tick=1e-9)


@pytest.mark.parametrize(("share", "tick"), [(0.3, 1e-9), (0.97, 1e-10), (0.02, 1e-8), (0.3, 1e-12), (0.3, 5e-7)])
def test_a_small_recording(share: float, tick: float, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = stamped(3, (203, 5, 7), share, tick)
    none = round(FRAME / tick)
    stamps = np.asarray(recording.frames[:]).reshape(203, 35).astype(np.int64)  # type: ignore[index]
    coarse = np.rint(np.linspace(0, none, 41))
    edges = np.unique([*np.rint(np.linspace(0, coarse[1], 9)), *coarse])
    counts = np.zeros((3, len(edges) - 1))
    nothing = np.full((1, 35), none)  # before the first frame
    for before, now in itertools.pairwise(np.concatenate([nothing, stamps])):
        for a, b in zip(before, now, strict=True):
            if b < none:
                kind = 0 if a == none else 2 if a >= round(0.9 * none) else 1
                counts[kind, np.searchsorted(edges, b, side="right") - 1] += 1
    summary = reduced(FirstArrivals, recording)
    assert summary.values.tolist() == counts.ravel().tolist()
    if tick == 1e-9:
        assert len(summary.values) == 141
        assert summary.where(46) == "9.75 to 10 us after the start of the frame, after an empty frame"
        assert summary.where(47) == "0 to 31 ns after the start of the frame, after a frame with an early detection"
        assert summary.where(140).endswith("after a frame with a late one")
        assert math.isclose(summary.size(0, 12.0, 10.0)[1], 2 / recording.totals.sum())
    monkeypatch.setattr(recordings, "_CHUNK", 1)
    again = Recording(**{**recording.__dict__, "_kept": {}})
    assert np.array_equal(reduced(FirstArrivals, again).values, summary.values)


def test_the_ends_of_a_small_recording() -> None:
    recording = stamped(3, (203, 5, 7), 0.3, 1e-9)
    stamps = np.asarray(recording.frames[:]).ravel().astype(np.int64)  # type: ignore[index]
    stamps = stamps[stamps < 10_000]
    octaves = 8  # up to 128 ticks, half of a fortieth of the frame
    edges = [0, *(2**k for k in range(octaves))]
    away = [np.histogram(x, [*edges[:-1], edges[-1] - 0.5])[0] for x in (stamps, 9999 - stamps)]
    summary = reduced(FrameEnds, recording)
    assert summary.values.tolist() == np.concatenate(away).tolist()
    assert summary.where(0) == "0 to 1 ns after the start of the frame"
    assert summary.where(octaves + 1) == "1 to 2 ns before the end of the frame"


def test_a_frame_that_ends_a_little_early_is_seen_at_its_end() -> None:
    stamps = np.asarray(STEADY(1).frames[:])  # type: ignore[index]
    found = sigmas(FrameEnds, str_of(np.where(stamps >= 9968, 10_000, stamps), 1e-9), STEADY)
    assert found[8 + 5] < -4 and np.abs(found[:8]).max() < 4 and abs(found[-1]) < 4
    null_laws.poisson(many(FrameEnds, STEADY, 120), 0.9)


def test_the_limits_of_a_small_recording() -> None:
    recording = stamped(3, (203, 5, 7), 0.3, 1e-9)
    stamps = np.asarray(recording.frames[:]).ravel().astype(np.int64)  # type: ignore[index]
    stamps = np.sort(stamps[stamps < 10_000])
    early, late = (stamps <= stamps[0] + 250).sum() / 251, (stamps >= stamps[-1] - 250).sum() / 251
    found = reduced(FrameLimits, recording)
    # part of a tick is left to chance
    quiet = found.values ** (1 / 0.2654) / [early, late]
    assert stamps[0] < quiet[0] < stamps[0] + 1 and 9999 - stamps[-1] < quiet[1] < 10_000 - stamps[-1]
    assert found.where(1) == "the time behind the last detection in any frame"
    assert math.isclose(found.size(1, found.values[1], 0.0)[1], quiet[1] / 10_000)
    # of nothing, and of a handful of detections, nothing is said
    assert FrameLimits().reduce(str_of(np.full((20, 2, 2), 10_000), 1e-9)) is None
    assert FrameLimits().reduce(stamped(3, (100, 5, 7), 0.05, 1e-9)) is None
    again = reduced(FrameLimits, Recording(**{**recording.__dict__, "_kept": {}}))
    assert np.array_equal(again.values, found.values)


@pytest.mark.parametrize(
    ("share", "tick"),
    [
        (0.6, 1e-7),
        *(pytest.param(*x, marks=pytest.mark.slow) for x in ((0.3, 1e-9), (0.3, 1e-12), (0.05, 1e-9))),
    ],
)
def test_the_law_of_the_limits(share: float, tick: float) -> None:
    values = many(FrameLimits, partial(stamped, shape=(500, 8, 8), share=share, tick=tick), 400)
    usual = math.gamma(1.2654)
    spread = math.sqrt(math.gamma(1.5308) - usual**2)
    for cell in values.T:
        assert abs(cell.mean() - usual) < laws.z_bound() * spread / math.sqrt(len(cell)) + 0.02
        assert 0.75 < cell.std() / spread < 1.25
    # a tail that is no longer than the normal law's: 4.1 standard deviations are one in a million
    assert np.abs((values - usual) / spread).max() < 4.2


def test_a_frame_that_ends_three_ticks_early_is_seen_by_its_last_detection() -> None:
    bright = partial(stamped, shape=(4000, 8, 8), share=0.6, tick=1e-9)
    stamps = np.asarray(bright(1).frames[:])  # type: ignore[index]
    whole = many(FrameLimits, bright, 40)
    found, usual = (
        reduced(FrameLimits, str_of(np.where(stamps >= 9998, 10_000, stamps), 1e-9)).values,
        whole.mean(axis=0),
    )
    assert found[1] > whole[:, 1].max() and abs(found[0] - usual[0]) < 4 * whole[:, 0].std()


@pytest.mark.parametrize("share", [0.02, 0.3, 0.97])
def test_law_of_steady_light(share: float) -> None:
    null_laws.poisson(many(FirstArrivals, partial(stamped, shape=(500, 8, 8), share=share, tick=1e-9), 120), 0.9)


def test_the_law_fails_where_detections_are_copied() -> None:
    def copied(seed: int) -> Recording:
        stamps = np.asarray(STEADY(seed).frames[:]).copy()  # type: ignore[index]
        stamps[:, 4:] = stamps[:, :4]
        return str_of(stamps, 1e-9)

    with pytest.raises(AssertionError):
        null_laws.poisson(many(FirstArrivals, copied, 60), 0.9)


def test_a_short_gate_and_what_a_frame_leaves_to_the_next_are_seen() -> None:
    stamps = np.asarray(STEADY(1).frames[:])  # type: ignore[index]
    late = np.where(stamps >= 9000, 10_000, stamps)  # nothing in the last tenth
    found = sigmas(FirstArrivals, str_of(late, 1e-9), STEADY).reshape(3, 47)
    assert found[0, -4:].max() < -8 and found[1, -4:].max() < -4 and found[0, :-4].min() > -5
    # blind for 200 ns after a detection within the last 100 ns of the frame before
    held = stamps.copy()
    held[1:][(stamps[:-1] >= 9900) & (stamps[:-1] < 10_000) & (stamps[1:] < 200)] = 10_000
    found = sigmas(FirstArrivals, str_of(held, 1e-9), STEADY).reshape(3, 47)
    assert np.abs(found[:2]).max() < 5
    # afterpulses of the frame before: 5 % come within 200 ns
    early = np.where(np.random.default_rng(1).random(stamps[1:].shape) < 0.05 * (stamps[:-1] < 10_000), 150, 10_000)
    pulses = stamps.copy()
    pulses[1:] = np.minimum(stamps[1:], early)
    found = sigmas(FirstArrivals, str_of(pulses, 1e-9), STEADY).reshape(3, 47)
    assert found[1, 4] > 10 and np.abs(found[0]).max() < 5


def test_one_frame_is_looked_at_as_well() -> None:
    recording = stamped(3, (1, 40, 40), 0.3, 1e-9)
    summary = reduced(FirstArrivals, recording)
    assert summary.values.sum() == recording.totals.sum() > 300
