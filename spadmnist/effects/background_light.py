"""Background light."""

from __future__ import annotations

import numpy as np

from . import Conditions, Effect, parameter


class BackgroundLight(Effect, stage="dark"):
    """Stray light that reaches the pixels while the shutter is open, whatever the lamp: more detections, evenly.

    It is a rate of detections, so the PDP has no say in it; in a dark capture the shutter is closed and there is
    none. Under both rules it joins the photons and the dark counts in one Poisson process.
    Source: no published number; up to 20 % of the signal is realistic.
    """

    moves = ("linearity", "level")

    rate = parameter(
        100.0,
        "Hz",
        "detections per pixel that stray light causes while the shutter is open",
        bounds=(0, None),
        off=0.0,
        search=(1, 1e5),
    )

    def apply(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """rate + background, where light is let in."""
        return rate if conditions.dark else rate + self.rate

    expected_rate = apply
