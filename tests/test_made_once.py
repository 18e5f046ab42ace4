"""What is made once: the sensors of a model, and the kernels that reduce its recordings; and the tails they lead to."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
from labs import bench_of
from numba.core.registry import CPUDispatcher
from scipy import special, stats

import spadmnist.statistics as statistics
from spadmnist.events import Events
from spadmnist.inference.closed_forms import bisection
from spadmnist.inference.laws import Exponential, Law
from spadmnist.inference.models import Model, Packed
from spadmnist.inference.reduction import ReducedCapture, summaries_of
from spadmnist.inference.replicates import no_size
from spadmnist.recording import Recording
from spadmnist.statistics import Statistic, Summary

RATE, PHASE = ("dark_counts", "rate"), ("flicker", "phase")
FLICKER = "    flicker: {amplitude: 0.1, frequency: 100 Hz, phase: 0.7 rad}\n"
SPREAD = {("detection", "pdp"): "normal 0.4 +- 0.01"}


# --- sensors ---------------------------------------------------------------------------------------------------------


def test_one_sensor_stands_for_all_captures_and_replicates(lab) -> None:
    start, _ = lab()
    model = Model.same(start.resolved()).changed({RATE: 200.0})
    assert model.of("dark", 0) is model.of("flat", 7) is model.one
    assert model.one.effect("dark_counts").rate == 200.0
    further = model.changed({("dead_time", "duration"): 30e-9})
    assert further.of("dark", 0) is further.of("flat", 1)
    assert further.one.effect("dark_counts").rate == 200.0


def test_captures_of_other_phases_have_sensors_of_their_own(lab) -> None:
    start, data = lab(FLICKER)
    found = bench_of((start, data), 2)
    model = Model.same(found.start).changed({("flicker", "amplitude"): 0.1, ("flicker", "frequency"): 100.0})
    turned = model.changed({}, {("dark", PHASE): 0.5, ("flat", PHASE): 1.5})
    assert [turned.of(id, 0).effect("flicker").phase for id in ("dark", "flat")] == [0.5, 1.5]
    assert turned.of("flat", 0) is turned.of("flat", 3)


def test_chips_that_are_not_known_are_another_one_in_each_replicate(lab) -> None:
    start, _ = lab()
    chips = Model.same(start.resolved()).changed({RATE: 200.0}, chips=True)
    assert [chips.of("flat", number).chip_seed for number in (0, 1, 5)] == [1, 2, 6]


# --- kernels ---------------------------------------------------------------------------------------------------------


def compiled() -> dict[str, int]:
    """How many types each kernel of the statistics is compiled for in this process."""
    known = {}
    for name in dir(statistics):
        module = getattr(statistics, name)
        for kernel in vars(module).values() if hasattr(module, "__spec__") else ():
            if isinstance(kernel, CPUDispatcher):
                known[f"{kernel.py_func.__module__}.{kernel.py_func.__name__}"] = len(kernel.signatures)
    return known


def test_stamps_of_short_and_of_long_captures_are_reduced_by_the_same_kernels(lab) -> None:
    start, data = lab(light=400)
    long, short = (data.recording(id, start.resolved()) for id in ("dark", "flat"))
    assert long.events.ticks.dtype == np.uint64
    assert short.events.ticks.dtype == np.uint32
    wide = short.events.stamped(short.events.ticks.astype(np.uint64), short.tick)
    bright = ReducedCapture.of(replace(short, events=wide, _kept={}))
    before = compiled()
    assert before["spadmnist.statistics._walk._through_exposure"] > 0
    again = ReducedCapture.of(short)
    assert compiled() == before
    for name, summary in bright.summaries.items():
        assert np.array_equal(summary.values, again.summaries[name].values), name


def test_widened_stamps_are_the_same_ones(lab) -> None:
    start, data = lab()
    recording = bench_of((start, data), 2).recording("flat")
    wide = recording.widened()
    assert wide.events.ticks.dtype == np.uint64
    assert np.array_equal(wide.events.ticks, recording.events.ticks)
    assert wide.events.tick == recording.events.tick
    assert wide.widened() is wide
    free = replace(recording, events=Events(np.sort(np.random.default_rng(0).random(4)), np.array([0, 4]), 1))
    assert free.widened() is free


def test_a_users_own_statistic_has_the_stamps_as_they_are(lab) -> None:
    class Ticks(Statistic):
        """A statistic of a user's own, which shows the type of the ticks that it is given."""

        modalities = ("tr",)

        def reduce(self, recording: Recording) -> Summary | None:
            assert recording.events is not None and recording.events.ticks is not None
            return Summary(np.array([float(recording.events.ticks.dtype.itemsize)]), "normal", lambda cell: "", no_size)

    recording = bench_of(lab(), 2).recording("flat")
    assert summaries_of([Ticks()], recording)["ticks"].values == [4.0]


def test_a_sensor_is_sent_without_what_was_computed_of_it(lab) -> None:
    start, data = lab(side=8)
    sensor = start.changed()
    assert "dead_times" not in vars(sensor)
    before = Packed.of(sensor).packed
    conditions = data.captures[0].conditions
    sensor.expected(np.full((1, 64), 1e5), conditions)
    assert sensor.nominal_dead_time == 50e-9 and "dead_times" in vars(sensor)
    assert Packed.of(sensor).packed == before
    assert np.array_equal(copy.copy(sensor).dead_times, sensor.dead_times)


# --- tails -----------------------------------------------------------------------------------------------------------


def scores(t: np.ndarray, replicates: int) -> np.ndarray:
    """The residuals of t under a law with a scatter of its own in each cell, of so many replicates."""
    return Law().standardized(t, np.zeros(t.shape), np.ones(t.shape), 0.0, replicates)


@pytest.mark.parametrize("replicates", [5, 16, 64, 1003])
def test_residuals_have_the_tail_of_students_t(replicates: int) -> None:
    t = np.concatenate([np.linspace(-25.0, 25.0, 201), [0.0]])
    tail = stats.t.sf(np.abs(t), replicates - 3)
    assert scores(t, replicates) == pytest.approx(-np.sign(t) * special.ndtri(tail), abs=1e-9)


@pytest.mark.parametrize("replicates", [64, 200, 1003])
def test_residuals_far_beyond_the_range_of_a_double_still_grow(replicates: int) -> None:
    """The logarithm of their tail, -z^2 / 2 about, is that of the density t^-(n - 2) but for a constant."""
    t = np.geomspace(10.0, 1e6, 2000)
    z = scores(t, replicates)
    assert np.isfinite(z).all()
    assert (np.diff(z) > 0).all()
    assert np.diff(z).max() < 0.2 + 2 * np.diff(z)[:5].max()
    assert np.array_equal(scores(-t, replicates), -z)
    last = z[-200:] ** 2 / 2 + np.log(z[-200:])
    assert np.polyfit(np.log(t[-200:]), last, 1)[0] == pytest.approx(replicates - 3, rel=0.005)


# --- light levels ----------------------------------------------------------------------------------------------------


def test_a_level_is_found_to_the_last_digit_and_not_beyond_the_ends() -> None:
    found = bisection(lambda level: 100 * -math.expm1(-level / 50), 70.0, 1e-6, 1e12)
    assert found == pytest.approx(-50 * math.log(0.3), rel=1e-14)
    assert bisection(lambda level: level, 1e9, 1.0, 1e6) == pytest.approx(1e6, rel=1e-15)
    assert bisection(lambda level: level, 1e-9, 1.0, 1e6) == pytest.approx(1.0, rel=1e-15)
    # of a level beyond which nothing changes, the lowest
    assert bisection(lambda level: min(level, 30.0), 30.0, 1e-6, 1e12) == pytest.approx(30.0, rel=1e-14)


def test_residuals_of_what_no_double_can_square_are_numbers() -> None:
    z = scores(np.array([1e160, -1e200, np.inf, 0.0]), 64)
    assert np.isfinite(z).all() and z[0] > 200 and z[1] < -200 and z[3] == 0.0
    power = Exponential().standardized(np.array([1e12]), np.array([0.0]), np.ones(1), 0.0, 64)
    assert np.isfinite(power).all() and power > 30
