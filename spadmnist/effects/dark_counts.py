"""Dark counts."""

from __future__ import annotations

import numpy as np

from . import Conditions, Effect, parameter


class DarkCounts(Effect, stage="dark"):
    """Avalanches without a photon, mostly thermal: a Poisson process in every pixel.

    The rate is the same in the light and in the dark.
    Source: Suonsivu et al., Alg. 1 lines 10-12; typical 1-1000 Hz (Table 1).
    """

    by_pixel = True
    cause = "dark"
    moves = ("dark_level", "dark_map", "level", "outliers")

    rate = parameter(
        100.0,
        "Hz",
        "dark count rate",
        symbol="phi_d",
        bounds=(0, None),
        off=0.0,
        search=(1, 1e5),
        per_pixel=True,
    )

    def apply(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """rate + DCR."""
        return rate + self.rate

    expected_rate = apply
