"""Memory of replicates and of the exact likelihood: the bound in closed form, and what is done where it is passed."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labs import DURATION, bench_of, labs

from spadmnist import twin
from spadmnist.effects import Conditions
from spadmnist.errors import InputError
from spadmnist.inference import exact_likelihood, memory, point_process
from spadmnist.inference.capture_replicates import CannotSimulate
from spadmnist.inference.comparison import compare
from spadmnist.inference.exact_likelihood import NoLikelihood, maximise
from spadmnist.inference.point_process import Stamps
from spadmnist.inference.replicates import Execution, Replicates
from spadmnist.recording import Capture, Light
from spadmnist.sensor import Sensor
from spadmnist.workers import Loky, Serial, executor

STAMPS = 100_663_296  # detections of the largest capture that is read, of 4 bytes each


def stamped(exposure: float = 0.2, tick: float | None = 1e-10) -> Capture:
    return Capture("flat", "tr", Light(5e-7, 1e-3), Conditions(exposure, 1, exposure, exposure, 5e-7), tick=tick)


@pytest.fixture
def sensor(tmp_path: Path) -> Sensor:
    return labs(tmp_path)()[0].resolved()


def test_the_largest_capture_is_within_the_bound_with_one_worker(sensor: Sensor) -> None:
    """The stamps beside what simulates a part of them, or what reduces them: of a whole capture and of a half."""
    whole = memory.replicate_bytes(sensor, stamped(), STAMPS, STAMPS)
    assert whole == 4 * STAMPS + 50 * 4e6
    half = memory.replicate_bytes(sensor, stamped(), STAMPS, STAMPS, half=True)
    assert half == 4 * STAMPS + 8 * 2**24 + STAMPS + 4 * STAMPS / 2
    for needed in (whole, half):
        memory.check(sensor, stamped(), needed)
        assert 0.65e9 + needed <= memory.MOST == 1.5e9
        assert memory.workers_at_once(needed, 2) == 1
    wide = memory.replicate_bytes(sensor, stamped(exposure=1.0), STAMPS / 2, STAMPS / 2)
    assert wide == 8 * STAMPS / 2 + 50 * 4e6
    moved = memory.replicate_bytes(sensor, stamped(tick=1e-9), STAMPS, STAMPS)
    assert moved == 4 * STAMPS + 4 * STAMPS


def test_few_detections_leave_all_workers_at_work(sensor: Sensor) -> None:
    small = memory.replicate_bytes(sensor, stamped(), 1e6, 1e6)
    assert [memory.workers_at_once(small, jobs) for jobs in (1, 2, 16, 64)] == [1, 2, 16, 64]
    large = memory.replicate_bytes(sensor, stamped(), STAMPS, STAMPS)
    at_once = [memory.workers_at_once(large, jobs) for jobs in range(1, 65)]
    assert at_once == sorted(at_once) and at_once[15] == 12 and 0.35e9 + 12 * (0.3e9 + large) <= 16 * 0.75e9


@pytest.mark.parametrize(("modality", "least"), [("qis", 1.0), ("counts", 16.0), ("str", 32.0)])
def test_frames_count_as_they_are_held(sensor: Sensor, modality: str, least: float) -> None:
    """As bits, as counts and their copy, as stamps of 4 bytes in two copies where the ticks are others."""
    c = Conditions(4e6 * 1e-6, 4_000_000, 1e-6, 1e-6, 5e-7, 2, "counter")
    capture = replace(stamped(tick=3e-10), modality=modality, conditions=c)
    bits = c.frames * sensor.layout.pixels / 8
    needed = memory.replicate_bytes(sensor, capture, 1e5, 1e5)
    assert least * bits <= needed <= least * bits + 2 * bits + 74 * 1e5


def test_what_ties_all_pixels_is_simulated_at_once_and_refused(tmp_path: Path) -> None:
    sensor, _ = labs(tmp_path)()
    crosstalk = replace(sensor, effects=[*sensor.effects, _crosstalk(tmp_path)]).resolved()
    needed = memory.replicate_bytes(crosstalk, stamped(), 3e7, 3e7)
    assert needed == 4 * 3e7 + 50 * 3e7
    with pytest.raises(InputError) as error:
        memory.check(crosstalk, stamped(), needed)
    assert str(error.value) == (
        "flat: a simulated recording of it takes about 1.6 GB of memory, and it may take 0.85 GB: cut the recording "
        "into several captures, each with a shorter exposure, or leave crosstalk out, for which all pixels are "
        "simulated at once"
    )


def _crosstalk(tmp_path: Path) -> Any:
    from spadmnist import config

    (tmp_path / "other.yaml").write_text(
        "sensor:\n  name: x\n  layout: {rows: 2, columns: 2, pixel_area: 100 um^2}\n"
        "  effects: {crosstalk: {probability: 0.01}}\n"
    )
    return config.read_sensor(tmp_path / "other.yaml").effects[0]


# --- where the bound is passed --------------------------------------------------------------------------------------


def test_fewer_workers_are_used_and_it_is_said_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a small bound that one worker keeps: one of two is used, and the answer is that of one."""
    monkeypatch.setattr("spadmnist.inference.replicate_cache.recall", lambda name: None)
    sensor, data = labs(tmp_path)(light=2000)
    alone = compare(sensor, data, jobs=1, replicates=4)
    monkeypatch.setattr(memory, "_PROGRAM", 0)
    monkeypatch.setattr(memory, "_WORKER", 1)
    monkeypatch.setattr("spadmnist.inference.replicates._FEW_EVENTS", 0)
    total = max(seen.total for seen in bench_of((sensor, data)).seen.values())
    monkeypatch.setattr(memory, "MOST", int(1.5 * 54 * total))  # a replicate takes 54 bytes of each detection or so
    monkeypatch.setattr(memory, "_EACH", int(0.75 * 54 * total))
    used: list[int] = []

    def run(self: Loky, function: Any, make: Any, keys: Any, done: Any) -> None:
        used.extend([self.threads] if keys else [])
        Serial().run(function, make, keys, done)

    monkeypatch.setattr(Loky, "run", run)
    said: list[str] = []
    found = compare(sensor, data, jobs=2, replicates=4, say=said.append)
    assert set(used) == {1} and found.as_data() == alone.as_data()
    assert len(said) == 1 and said[0].startswith(
        "1 of 2 workers are used at a time: a simulated recording of the largest"
    )
    monkeypatch.setattr(memory, "MOST", int(4 * 54 * total))
    used.clear()
    compare(sensor, data, jobs=2, replicates=4, say=said.append)
    assert set(used) == {2} and len(said) == 1


def test_what_one_worker_cannot_hold_is_refused_before_it_is_reduced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sensor, data = labs(tmp_path)(light=2000)
    monkeypatch.setattr(memory, "MOST", memory._PROGRAM + memory._WORKER + 1000)
    monkeypatch.setattr("spadmnist.inference.replicates.ReducedCapture.of", None)
    with pytest.raises(
        InputError, match=r"^dark: a simulated recording of it takes about .* GB of memory, .*: cut the"
    ):
        Replicates(sensor, data, 0, Execution(Serial()), 4)


def test_a_model_whose_replicates_are_too_large_cannot_be_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stated model is within the bound; one of its changes is not, and its reason is the sentence."""
    replicates = bench_of(labs(tmp_path)(light=2000), 2)
    monkeypatch.setattr("spadmnist.inference.replicates._FEW_EVENTS", 0)
    monkeypatch.setattr(memory, "check", _refuse)
    from spadmnist.inference.models import Model

    numbers = np.arange(2, dtype=np.uint64)
    (made,) = replicates.simulate([(Model.same(replicates.start), "flat", np.full(2, 1e6), numbers)])
    assert isinstance(made, CannotSimulate) and str(made) == "too large"


def _refuse(*_: Any) -> None:
    raise InputError("too large")


def test_an_executor_is_limited_on_this_machine_alone() -> None:
    assert executor(4).limited(2).threads == 2 and executor(2).limited(4).threads == 2
    assert isinstance(executor(4).limited(1), Loky) and executor(4).limited(0).threads == 1
    serial = Serial()
    assert serial.limited(1) is serial


# --- the exact likelihood -------------------------------------------------------------------------------------------


@pytest.fixture
def flat(tmp_path: Path) -> Any:
    sensor, data = labs(tmp_path)(light=200)
    return sensor.resolved(), data.recording("flat", sensor.resolved())


def test_gaps_are_the_same_piece_by_piece(flat: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each gap against its definition, whatever the pieces: also where one ends with a pixel."""
    _, recording = flat
    times, offsets = recording.events.times, recording.events.offsets
    gaps = np.concatenate(
        [np.diff(times[a:b], append=recording.conditions.exposure) for a, b in itertools.pairwise(offsets)]
    )
    last = np.isin(np.arange(len(times)), offsets[1:] - 1)
    reach = float(np.median(gaps))
    for piece in (int(offsets[1]), int(offsets[1]) - 1, 1000, len(times), len(times) + 1):
        monkeypatch.setattr(point_process, "_PIECE", piece)
        law = Stamps(recording)
        law._look(reach / 1.5)
        short = gaps <= law.reach
        follows = np.append(False, (short & ~last)[:-1])
        near, kinds, kept = law.near
        assert np.array_equal(near, gaps[short])
        assert np.array_equal(kinds, (2 * last + follows)[short])
        assert np.array_equal(kept, np.append(0, np.cumsum(short))[offsets])
        blind = np.full(4, 60e-9)
        expected = np.count_nonzero(np.abs(gaps[~last] - 60e-9) <= law.tick + 2e-8)
        assert law.near_edge(blind, 1e-8) == expected > 0


def test_more_gaps_than_are_held_stand_in_the_way(flat: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The recordings and the gaps of two likelihoods; with less than that it is no likelihood, and says so."""
    from spadmnist.inference.candidates import candidates

    sensor, recording = flat
    wanted = [
        c
        for c in candidates(sensor, [recording.capture])
        if (c.effect, c.parameter, c.kind, c.carrier) == (*DURATION, "set", None)
    ]
    law = Stamps(recording)
    law._look(float(sensor.dead_times.max()) + sensor.tick)
    enough = len(recording.events) * 4 + 2 * point_process.BYTES_OF_A_GAP * (len(law.near[0]) + 1) * 4
    monkeypatch.setattr(exact_likelihood, "_HELD", enough)
    assert DURATION in maximise(sensor, [recording], wanted, start={DURATION: 50e-9}).values
    monkeypatch.setattr(exact_likelihood, "_HELD", len(recording.events) * 4)
    with pytest.raises(NoLikelihood) as error:
        maximise(sensor, [recording], wanted, start={DURATION: 50e-9})
    assert str(error.value) == f"{len(recording.events):.3g} time stamps so close to each other"


def test_a_fit_to_more_stamps_than_are_held_is_by_simulation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their files are not read for a likelihood."""
    sensor, data = labs(tmp_path)()
    seen = {c.id: 1e9 for c in data.captures}
    monkeypatch.setattr(type(data), "recording", None)
    with pytest.raises(NoLikelihood, match=r"^2e\+09 time stamps, .* more than the 2e\+08 that are held at once$"):
        exact_likelihood.recordings(data, sensor, seen)


def test_stretches_are_put_into_one_array(tmp_path: Path) -> None:
    """Count frames that sum several frames, the last stretch a shorter one: as many as the capture has."""
    sensor, _ = labs(tmp_path)()
    sensor = sensor.resolved()
    c = Conditions(103e-6, 103, 1e-6, 1e-6, 5e-7, 2, "frames")
    capture = replace(stamped(), modality="counts", conditions=c)
    from spadmnist.streams import Streams

    streams = Streams(0, "here", "there", np.zeros(1, np.uint64))
    made = twin._by_stretches(sensor, capture, np.full(4, 1e6), streams, 30, lambda share: None)
    assert made.frames is not None and made.frames.shape == (c.count_frames, 2, 2) == (34, 2, 2)
    alone = twin._by_stretches(sensor, capture, np.full(4, 1e6), streams, 30, lambda share: None)
    assert np.array_equal(np.asarray(made.frames[:]), np.asarray(alone.frames[:])) and made.totals.sum() > 0
