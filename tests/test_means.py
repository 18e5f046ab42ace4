"""Closed forms of the mean against the simulation where effects meet: gates and dead times, frames and gaps."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import laws
import numpy as np
import pytest

import spadmnist as sp
from spadmnist import plugins
from spadmnist.effects import Conditions
from spadmnist.inference.closed_forms import closed_form, in_frames
from spadmnist.inference.mean_alone import of_mean
from spadmnist.streams import Streams

PIXELS = 64
effects = sp.effects


def sensor(*some: Any) -> sp.Sensor:
    return sp.Sensor(sp.Layout(8, 8, 25e-12, 1.0), [effects.Detection(pdp=1.0), *some], rules="device")


def made(model: sp.Sensor, conditions: Conditions, photons: float, readout: str, images: int = 1) -> Any:
    light = np.full((images, PIXELS), photons)
    return model.expose(light, conditions, Streams(3, "means", "t", np.arange(images, dtype=np.uint64)), (readout,))


def share_of_frames(model: sp.Sensor, conditions: Conditions, photons: float, images: int = 1) -> tuple[float, int]:
    """(share of frames with a detection, how many frames there were)"""
    found = made(model, conditions, photons, "qis", images).frames.unpacked()
    return float(found.mean()), found.size


def test_a_dead_time_is_that_at_the_rate_while_the_gate_is_open() -> None:
    """1e7/s in a fifth of each frame, dead for 100 ns: half of the events there, not two thirds of all."""
    gated = sensor(effects.DeadTime(duration=100e-9), effects.ShortGate(fraction=0.2))
    c = Conditions(10e-3, 1000, 10e-6, 10e-6, 500e-9)
    light = np.full((1, PIXELS), 1e7)
    found = len(made(gated, c, 1e7, "tr").tr) / PIXELS
    expected = gated.expected(light, c)[1].mean()
    # a gate opens on a live pixel, which has an eighth of a detection more: renewal theory
    assert abs(found - (expected + 1000 / 8)) < 0.002 * found
    assert gated.expected(light, c)[0].mean() == pytest.approx(2e4)
    assert gated.expected(light, c, first=True)[0].mean() == pytest.approx(2e4)


def test_a_mean_alone_of_a_gated_counter_is_that_of_the_simulation() -> None:
    gated = sensor(effects.DeadTime(duration=100e-9), effects.ShortGate(fraction=0.2))
    light = {"wavelength": 500e-9, "irradiance": 1e7 / (25e-12 / 3.97289171e-19)}  # 1e7 photons/s on a pixel
    capture = sp.Capture("one", "counts", **light, frames=1000, frame_time=10e-6, bits=12, counting="counter")
    twin = sp.simulate(gated, [capture], seed=4)["one"].counts
    null, _ = of_mean(gated, capture, float(twin.sum()), 64)
    assert closed_form(gated, capture)(null.level) < 0.993 * twin.sum()  # without the correction
    assert float(null.totals.mean()) == pytest.approx(float(twin.sum()), rel=2e-3)


@pytest.mark.parametrize("period", [10e-3, 20e-3, 3.3e-3])
def test_flicker_in_frames_is_seen_where_they_are(period: float) -> None:
    """Frames at the frequency of the mains see always the same phase of it."""
    swinging = sensor(effects.Flicker(amplitude=0.3, frequency=100.0, phase=math.pi / 2))
    c = Conditions(200 * period, 200, 10e-6, period, 500e-9)
    share, trials = share_of_frames(swinging, c, 1e4, 10)
    expected = float(in_frames(swinging, np.full((1, PIXELS), 1e4), c).mean())
    laws.share_is(round(share * trials), trials, expected)
    steady = -math.expm1(-0.1)
    assert (abs(expected / steady - 1) > 0.2) == (period != 3.3e-3)


def test_flicker_over_the_whole_exposure_is_the_mean_of_its_curve() -> None:
    slow = effects.Flicker(amplitude=0.5, frequency=7.3, phase=1.1)
    c = Conditions(0.05, 1, 0.05, 0.05, 500e-9)
    times = (np.arange(100_000) + 0.5) / 100_000 * c.exposure
    assert slow.expected_rate(np.ones((1, 1)), c)[0, 0] == pytest.approx(slow.factor(times, c).mean(), rel=1e-9)


WARMING = '''
import numpy as np
from spadmnist.effects import Effect, parameter


class Zwarming(Effect, stage="arrival"):
    """A part of the dark counts."""

    acts_on = "dark"
    share = parameter(0.5, "", "factor", bounds=(0, 1), off=1.0)

    def factor(self, t, conditions):
        return np.full(np.shape(t), self.share)

    def maximum(self, conditions):
        return 1.0
'''


def test_what_acts_on_dark_counts_leaves_rates_of_other_effects(tmp_path: Path) -> None:
    (tmp_path / "zwarming.py").write_text(WARMING)
    plugins.load_file(tmp_path / "zwarming.py")
    blinking = effects.BlinkingDarkCounts(fraction=1.0, amplitude=1000.0, rate_on=1e4, rate_off=1e4)
    both = sensor(effects.DarkCounts(rate=100.0), blinking, effects.Effect.registry.find("zwarming")())
    c = Conditions(1.0, 1, 1.0, 1.0, None)
    expected = both.expected(np.zeros((1, PIXELS)), c)[0].mean()
    assert expected == pytest.approx(50 + 500)
    assert abs(len(made(both, c, 0.0, "tr").tr) / PIXELS - expected) < 0.05 * expected


def test_dead_times_that_are_carried_over_do_not_say_their_mean() -> None:
    assert not effects.FrameCarryOver.states_mean
    slow = sensor(effects.DeadTime(duration=500e-9), effects.FrameCarryOver(share=1.0))
    capture = sp.Capture(
        "one", "qis", wavelength=500e-9, irradiance=1e6 / (25e-12 / 3.97289171e-19), frames=4000, frame_time=1e-6
    )
    twin = float(sp.simulate(slow, [capture], seed=4)["one"].counts.sum())
    null, _ = of_mean(slow, capture, twin, 64)
    assert closed_form(slow, capture)(null.level) > 1.02 * twin
    assert float(null.totals.mean()) == pytest.approx(twin, rel=5e-3)
