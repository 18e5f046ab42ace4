"""Whole numbers of steps: the reach of crosstalk, which no gradient finds."""

from __future__ import annotations

import pytest

import spadmnist as sp

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
