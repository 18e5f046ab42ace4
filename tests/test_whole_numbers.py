"""Whole numbers of steps: the reach of crosstalk, which no gradient finds."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

import spadmnist as sp
from spadmnist.inference.candidates import candidates, templates

PHOTON = 6.62607015e-34 * 299792458.0 / 500e-9  # J
PIXEL = 25e-12  # m^2
NEAR = {"probability": 0.01, "diagonal_ratio": 0.2, "delay": 1e-9}


def sensor(*more: sp.effects.Effect) -> sp.Sensor:
    effects = [
        sp.effects.Detection(pdp=0.3),
        sp.effects.DeadTime(duration=50e-9),
        sp.effects.DarkCounts(rate=200.0),
        sp.effects.Tdc(resolution=1e-10),
        *more,
    ]
    return sp.Sensor(sp.Layout(16, 16, PIXEL, 1.0), effects, rules="device")


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("listed", [True, False])
def test_crosstalk_that_reaches_far_is_found_with_its_reach(listed: bool) -> None:
    """1 % in a neighbour, and 0.2 % / d to six pitches; to a bare sensor a near crosstalk is added first."""
    far = sensor(sp.effects.Crosstalk(**NEAR, reach=6.0, far_ratio=0.2))
    light = {"wavelength": 500e-9, "irradiance": 2e3 / 0.3 * PHOTON / PIXEL, "relative_uncertainty": 0.02}
    captures = [sp.Capture("dark", "tr", dark=True, exposure=1.0), sp.Capture("flat", "tr", exposure=0.1, **light)]
    model = sensor(sp.effects.Crosstalk(**NEAR)) if listed else sensor()
    found = sp.diagnose(model, sp.simulate(far, captures, seed=1), quick=True, within="none")
    assert found.verdict == "explained"
    names = ["set crosstalk.far_ratio"] if listed else ["add crosstalk", "set crosstalk.far_ratio"]
    assert [step.candidate.name for step in found.steps] == names
    values = found.steps[-1].values
    assert values["reach"].value == 6 and values["far_ratio"].value == pytest.approx(0.2, rel=0.15)
    assert found.model.effect("crosstalk").probability == pytest.approx(0.01, rel=0.06)


def test_a_resolution_is_searched_in_whole_multiples_and_parts_of_what_is_listed() -> None:
    effects = [sp.effects.Detection(pdp=0.4), sp.effects.DarkCounts(rate=100.0), sp.effects.Tdc(resolution=1e-10)]
    sensor = sp.Sensor(sp.Layout(2, 2, 25e-12, 1.0), effects, rules="device")
    plan = [sp.Capture("flat", "tr", wavelength=500e-9, irradiance=1e-3, exposure=1e-3)]
    captures = sp.simulate(sensor, plan, seed=1).captures
    (found,) = (c for c in candidates(sensor, captures) if c.name == "set tdc.resolution")
    (coordinate,) = found.strengths
    ticks = [x * 1e10 for one in templates(found) for x in one.values()]
    assert ticks == pytest.approx([2, 5, 0.5])
    assert coordinate.rounded(2.4e-10) == pytest.approx(2e-10) and coordinate.rounded(0.3e-10) == pytest.approx(
        1e-10 / 3
    )
    ladder = [0.25e-10, 1e-10 / 3, 0.5e-10, 1e-10, 2e-10, 3e-10]
    for low, high in itertools.pairwise(ladder):
        assert coordinate.next_whole(low, 1) == pytest.approx(high)
        assert coordinate.next_whole(high, -1) == pytest.approx(low)


@pytest.mark.slow
def test_a_clock_that_is_coarser_than_the_files_ticks_is_no_map_of_codes() -> None:
    """Stamps of 200 ps in ticks of 100 ps: every other code never comes."""
    effects = [sp.effects.Detection(pdp=0.4), sp.effects.DarkCounts(rate=100.0), sp.effects.Tdc(resolution=2e-10)]
    sensor = sp.Sensor(sp.Layout(4, 4, 25e-12, 1.0), effects, rules="device")
    plan = [sp.Capture("flat", "tr", wavelength=500e-9, irradiance=1e-3, exposure=10e-3, relative_uncertainty=0.02)]
    made = sp.simulate(sensor, plan, seed=1)
    events = made.recording("flat").events
    pixels = np.repeat(np.arange(16), np.diff(events.offsets))
    light: dict[str, Any] = {"wavelength": 500e-9, "irradiance": 1e-3, "relative_uncertainty": 0.02}
    fine = sp.Capture("flat", "tr", exposure=10e-3, tick=1e-10, **light)
    real = sp.Measurement.from_arrays(sensor.layout, {fine: (2 * events.ticks, pixels)})
    found = sp.diagnose(sensor.with_values({"tdc.resolution": 1e-10}), real, quick=True, jobs=2)
    assert found.verdict == "explained" and [s.candidate.name for s in found.steps] == ["set tdc.resolution"]
    assert found.steps[0].values["resolution"].value == pytest.approx(2e-10)
