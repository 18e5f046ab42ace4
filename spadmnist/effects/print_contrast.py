"""A print whose black is not black."""

from __future__ import annotations

import numpy as np

from . import Conditions, Effect, parameter


class PrintContrast(Effect, stage="light"):
    """The black of a printed chart reflects some of the light: what is black in the scene is dark grey.

    A pixel gets black w + (1 - black) of its light, where w is what the brightest place of the scene gives: its paper.
    It acts on the light of a scene, under both rules; light that is the same on all pixels stays as it is.
    Source: no published number; ink on paper reflects 2-10 % of what paper does.
    """

    of_scene = True
    moves = ("level", "map", "rows_columns", "surface", "outliers", "linearity")

    black = parameter(
        0.05,
        "",
        "reflectance of black beside that of white",
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
