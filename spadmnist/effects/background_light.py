"""Background light."""

from __future__ import annotations

import numpy as np

from . import Conditions, Effect, parameter


class BackgroundLight(Effect, stage="dark"):
    """Stray light adds detections at a constant rate while the shutter is open.

    The rate is one of detections: the PDP does not change it. A dark capture has none, because its shutter is closed.
    Under both rules the rate joins photons and dark counts in one Poisson process.
    Source: no published number; up to 20 % of the signal is realistic.
    """

    by_pixel = True
    moves = ("linearity", "level")

    rate = parameter(
        100.0,
        "Hz",
        "rate of detections of a pixel by stray light",
        bounds=(0, None),
        off=0.0,
        search=(1, 1e5),
    )

    def apply(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """rate + background, where light is let in."""
        return rate if conditions.dark else rate + self.rate

    expected_rate = apply
