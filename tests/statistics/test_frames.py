"""What statistics of frames share: forms of the frames that are kept, or made anew, are the same."""

from __future__ import annotations

import numpy as np
import pytest
from simple_sensor import one_of_each

from spadmnist.inference.replicates import statistics_for
from spadmnist.recording import Recording
from spadmnist.statistics._frames import add_pixels, contiguous, first_stamps, frame_sums


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


def test_frames_in_another_order_of_memory() -> None:
    frames = np.arange(37 * 3 * 5).reshape(3, 5, 37).transpose(2, 0, 1)
    assert contiguous(frames).flags.c_contiguous and np.array_equal(contiguous(frames), frames.reshape(37, 15))


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
