"""What statistics of frames share: forms of the frames that are kept, or made anew, are the same."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simple_sensor import one_of_each, stamped

from spadmnist import bit_planes
from spadmnist.inference.reduction import statistics_for
from spadmnist.recording import FirstStamps, Recording, StampedFrames
from spadmnist.statistics._frames import add_pixels, first_stamps, frame_sums


def test_first_stamps_are_those_of_the_frames() -> None:
    recording = one_of_each()["str"]
    frames = np.asarray(recording.frames[:]).reshape(recording.n_frames, -1)  # type: ignore[index]
    ((first, found),) = first_stamps(recording)
    frame, pixel = np.nonzero(frames < recording.none)
    assert first == 0 and found.pixels.tolist() == pixel.tolist()
    assert found.stamps.tolist() == frames[frame, pixel].tolist()
    assert np.diff(found.offsets).tolist() == np.bincount(frame, minlength=len(frames)).tolist()


@pytest.mark.parametrize("frames", [1, 100, 600])
def test_sums_of_pixels(frames: int) -> None:
    bits = np.random.default_rng(1).random((frames, 5, 13)) < np.linspace(0, 1, 13)
    totals = np.ones(65, np.int64)
    add_pixels(np.packbits(bits, axis=2), 13, totals)
    assert totals.tolist() == (bits.sum(axis=0).ravel() + 1).tolist()


@pytest.mark.parametrize("frames", [1, 4, 403])
def test_frames_that_are_held_as_their_stamps(frames: int) -> None:
    """They are read like any others, and statistics find in them the same."""
    dense = stamped(3, (frames, 6, 11), 0.2)
    whole = np.asarray(dense.frames[:])  # type: ignore[index]
    found = FirstStamps(*bit_planes.stamps_of_frames(whole.reshape(frames, -1), dense.none))
    held = replace(dense, frames=StampedFrames(found, dense.none, whole.shape), _kept={})
    assert held.frames is not None and held.n_frames == frames
    for part in (slice(None), slice(1, 3), slice(3, 1), slice(-2, None), slice(None, None, -3), slice(2, None, 2)):
        assert np.array_equal(held.frames[part], whole[part]) and held.frames[part].dtype == np.uint32
    assert np.array_equal(held.totals, dense.totals)
    assert (held.waited is None) == (dense.waited is None)
    for statistic in statistics_for(dense.capture):
        summary, wanted = statistic.reduce(held), statistic.reduce(dense)
        assert (summary is None) == (wanted is None)
        assert summary is None or wanted is None or np.array_equal(summary.values, wanted.values), statistic.name


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 9), st.integers(1, 7), st.floats(0, 1), st.integers(0, 2**32 - 1))
def test_how_long_first_detections_were_waited_for(frames: int, pixels: int, share: float, seed: int) -> None:
    """Beside a literal sum, to the last bit."""
    rng = np.random.default_rng(seed)
    stamps = np.where(rng.random((frames, pixels)) < share, rng.integers(3, 900, (frames, pixels)), 1000)
    of_pixels, of_frames = np.zeros(pixels), np.zeros(frames)
    bit_planes.add_waits(*bit_planes.stamps_of_frames(stamps.astype(np.uint32), 1000), 3, 900, of_pixels, of_frames)
    wanted_pixels, wanted_frames = [0.0] * pixels, [0.0] * frames
    for f in range(frames):
        for p in range(pixels):
            waited = (int(stamps[f, p]) - 3 + 0.5) * (1.0 / 898) if stamps[f, p] < 1000 else 1.0
            wanted_pixels[p] += waited
            wanted_frames[f] += waited
    assert of_pixels.tolist() == wanted_pixels and of_frames.tolist() == wanted_frames


def test_frames_are_read_once_where_their_stamps_are_few(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many frames there are: it is a matter of the stamps' bytes."""
    monkeypatch.setattr("spadmnist.recording._CHUNK", 1)
    whole = stamped(3, (403, 6, 11), 0.2)
    size = sum(part.nbytes for _, part in first_stamps(replace(whole, _kept={})))
    for most, times in ((size, 1), (size - 1, 2)):
        monkeypatch.setattr("spadmnist.statistics._frames._SMALL", most)
        shares: list[float] = []
        recording = replace(whole, _kept={}).watched(shares.append)
        once, again = (list(first_stamps(recording)) for _ in range(2))
        assert math.isclose(sum(shares), times, abs_tol=1e-9)
        assert [first for first, _ in once] == [first for first, _ in again] and len(once) > 10
        assert all(np.array_equal(a.stamps, b.stamps) for (_, a), (_, b) in zip(once, again, strict=True))


@pytest.mark.parametrize("kind", ["qis", "str", "counts", "counter"])
def test_what_is_not_kept_makes_no_difference(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = one_of_each()[kind]
    kept = {s.name: s.reduce(recording) for s in statistics_for(recording.capture)}
    monkeypatch.setattr("spadmnist.statistics._frames._SMALL", 0)
    monkeypatch.setattr("spadmnist.recording._CHUNK", 1)
    again = Recording(**{**recording.__dict__, "_kept": {}})
    assert np.array_equal(frame_sums(again), frame_sums(recording))
    for statistic in statistics_for(recording.capture):
        summary, wanted = statistic.reduce(again), kept[statistic.name]
        assert (summary is None) == (wanted is None)
        assert summary is None or wanted is None or np.array_equal(summary.values, wanted.values), statistic.name
    assert not {"bits", "first stamps"} & again._kept.keys()
