"""Light that is another in every recording: what a few of them tell of it, and how it is judged."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tinylab import bench_of, change_of

from spadmnist.criticism import course as course_of
from spadmnist.criticism import refining
from spadmnist.criticism.fit import RATES, Moved, likelier
from spadmnist.criticism.tried import Tried

CONTRAST, COHERENCE = ("source_noise", "contrast"), ("source_noise", "coherence_time")
TREND, MANY = ("flat", "trend"), ("flat", "fine_intervals")


def test_totals_that_go_the_same_way_in_two_recordings_are_chance(lab) -> None:
    """The power is 1 in the mean, whatever it is in the two recordings that a first look has."""
    bench = bench_of(lab(light=1000))
    state = bench.state({})
    coherence = [1e-3, 3e-3, 1e-2, 3e-2]  # of an exposure of 20 ms
    models = [state.sensors.changed({CONTRAST: 0.1, COHERENCE: x}) for x in coherence]
    for moved in bench.moved(state, models, 2, kept="sure"):
        assert isinstance(moved, Moved)
        assert moved.fluctuates
        assert all(abs(log) < 1e-6 for log in moved.logs.values())
    # nor are four of them sure of it, of which a slope is made: they are far less alike than the model's own
    for moved in bench.moved(state, models, 4):
        assert isinstance(moved, Moved)
        assert all(abs(log) < 1e-6 for log in moved.logs.values())
    # what adds detections in every recording is none of these
    (moved,) = bench.moved(state, [state.sensors.changed({("afterpulsing", "probability"): 0.1})], 4)
    assert isinstance(moved, Moved)
    assert not moved.fluctuates


def test_what_fluctuates_is_judged_by_how_wide_it_is() -> None:
    """Six numbers and three totals that are three times as wide: -2 log 3 for each, if they are as wide as stated.

    Of a thousand cells that it neither moves nor widens none counts.
    """
    z, totals = np.array([3.0, -4.0, 2.0, 3.5, -2.0, 1.0]), np.array([4.0, -3.0, 2.0])

    def state(width: float, other: float) -> Any:
        null = {TREND: SimpleNamespace(breadth=width, law="normal"), MANY: SimpleNamespace(breadth=1.0, law="normal")}
        left = {TREND: z / width, MANY: np.full(1000, other), RATES: totals / width}
        return SimpleNamespace(nulls=null, residuals=left, space=([], np.ones(3), np.eye(3) / width, np.zeros(3)))

    trace = {TREND: np.zeros(6), MANY: np.zeros(1000), RATES: np.zeros(3)}
    now, there = state(1.0, 1.2), state(3.0, 1.0)
    exact = float(z @ z + totals @ totals) * (1 - 1 / 9) - 2 * 9 * math.log(3)
    assert likelier(now, there, trace, fluctuates=True) == pytest.approx(exact)
    assert likelier(now, there, trace) == 0.0
    # data that are no wider than the model's own do not speak for it
    quiet_now, quiet_there = state(1.0, 1.0), state(3.0, 1.0)
    for one, width in ((quiet_now, 1.0), (quiet_there, 3.0)):
        one.residuals = {TREND: np.ones(6) / width, MANY: np.ones(1000), RATES: np.ones(3) / width}
    assert likelier(quiet_now, quiet_there, trace, fluctuates=True) == pytest.approx(9 * (8 / 9 - 2 * math.log(3)))


def test_a_lamp_that_drifts_about_for_long_is_found_by_its_totals(lab) -> None:
    """Its coherence time is the exposure: all that one recording has of it is another total, which no trace has."""
    noise = "    source_noise: {contrast: 0.2, coherence_time: 40 ms}\n"
    bench = bench_of(lab(noise, light=1000, seed=3))
    state = bench.state({})
    assert float(np.max(np.abs(state.residuals[RATES]))) > 4.0
    values = {CONTRAST: 0.15, COHERENCE: 30e-3}
    (moved,) = bench.moved(state, [state.sensors.changed(values)], 8, kept="sure")
    assert isinstance(moved, Moved)
    one = refining.refine(bench, state, Tried(change_of(bench, "add source_noise"), values, moved, 0.0, 1.0))
    squares = sum(float(z @ z) for z in state.residuals.values())
    fall = squares - sum(float(z @ z) for z in (one.residuals or {}).values())
    assert one.gain > fall + 8.0


def test_numbers_of_a_lamp_that_fluctuates_are_followed_by_all_recordings(lab) -> None:
    """Of any other model a few recordings tell how the cells follow its numbers: they are the same in each."""
    bench = bench_of(lab(light=1000))
    course = course_of.begun(bench)
    assert course_of._recordings(course, course.state) == 8
    noisy = bench.state({CONTRAST: 0.2, COHERENCE: 20e-3})
    assert course_of._recordings(course, noisy) == bench.replicates == 16
