"""A print whose black is not black."""

from __future__ import annotations

import numpy as np

from . import Conditions, Effect, parameter


class PrintContrast(Effect, stage="light"):
    """The black of a printed chart reflects some of the light.

    A pixel with the light L gets black * w + (1 - black) * L, where w is the light of the brightest pixel of the scene.
    The effect acts on scenes under both rules; uniform light does not change.
    Source: no published number; ink on paper reflects 2-10 % of what paper does.
    """

    of_scene = True
    moves = ("level", "map", "rows_columns", "surface", "outliers", "linearity")

    black = parameter(
        0.05,
        "",
        "reflectance of black relative to white",
        symbol="b",
        bounds=(0, 1),
        off=0.0,
        search=(0.002, 0.5),
    )

    def apply(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """b max(rate) + (1 - b) rate."""
        white = rate.max(axis=1, keepdims=True, initial=0.0)
        return self.black * white + (1 - self.black) * rate

    expected_rate = apply
