"""The mean of an arrival effect or a gate that states none: that of `factor` or `open` over the exposure."""

from __future__ import annotations

import numpy as np
import pytest

from spadmnist.effects import Conditions, Effect, parameter
from spadmnist.effects.source_drift import SourceDrift

CLOCK = Conditions(0.05, 500, 1e-4, 1e-4, 5e-7)


class Droop(Effect, stage="arrival", abstract=True):
    """The light falls from 1 to 1 - depth, with a time constant of a tenth of the exposure."""

    depth = parameter(0.2, "", "share that is lost", off=0.0, search=(0.01, 1))

    def maximum(self, conditions):
        return 1.0

    def factor(self, t, conditions):
        return 1 - self.depth * (1 - np.exp(-t / (0.1 * conditions.exposure)))


class Drawn(Droop, stage="arrival", abstract=True):
    """What it does to the events is drawn: there is no factor to take a mean of."""

    def modulate(self, events, conditions, rng):
        return events


class Shut(Effect, stage="gate", abstract=True):
    """Open for the first third of each frame."""

    share = parameter(1 / 3, "", "share of the frame", off=1.0, search=(0.1, 1))

    def open(self, t, conditions):
        return np.mod(t, conditions.frame_period) < self.share * conditions.frame_period


@pytest.mark.parametrize(
    ("effect", "mean"),
    [
        (Droop(depth=0.2), 1 - 0.2 * (1 - 0.1 * (1 - np.exp(-10)))),
        (Shut(), 1 / 3),  # in step with the frames
        (Drawn(), 1.0),
        (SourceDrift(slope=0.5), 1.0),
    ],
)
def test_the_mean_over_the_exposure(effect: Effect, mean: float) -> None:
    rate = np.array([[2.0, 5.0]])
    np.testing.assert_allclose(effect.expected_rate(rate, CLOCK), mean * rate, rtol=2e-3)


@pytest.mark.parametrize("effect", [Droop(depth=0.0), SourceDrift(slope=0.5), SourceDrift(slope=-1.0)])
def test_a_mean_of_one_changes_no_digit(effect: Effect) -> None:
    rate = np.array([[2.0, 1 / 3]])
    assert np.array_equal(effect.expected_rate(rate, CLOCK), rate)
