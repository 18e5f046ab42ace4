"""Illumination that is not even."""

from __future__ import annotations

import numpy as np

from . import Chip, Conditions, Effect, parameter


class IlluminationGradient(Effect, stage="light"):
    """The illumination varies over the array: a slope along x and y, and a loss towards the corners.

    A pixel at (u, v), from -0.5 to 0.5 across the array, gets (1 + x u + y v) (1 - vignette (r / r_max)^2) of the
    light; r is its distance from the middle. A negative slope factor counts as 0. The factor multiplies the light under
    both rules. Dark counts do not change.
    Source: no published number; 0.5-10 % over the array is what a good set-up shows.
    """

    moves = ("surface", "level")

    x = parameter(
        0.05,
        "",
        "relative change from the first to the last column",
        bounds=(-2, 2),
        off=0.0,
        search=(-0.5, 0.5),
    )
    y = parameter(
        0.0,
        "",
        "relative change from the first to the last row",
        bounds=(-2, 2),
        off=0.0,
        search=(-0.5, 0.5),
    )
    vignette = parameter(
        0.0,
        "",
        "relative loss at the farthest corner, quadratic in the distance from the middle",
        bounds=(0, 1),
        off=0.0,
        search=(0, 0.5),
    )

    def made(self, chip: Chip) -> None:
        places, (u, v) = chip.layout.places, chip.layout.centred.T
        from_middle = places - (places.min(axis=0) + places.max(axis=0)) / 2
        squared = (from_middle**2).sum(axis=1)
        farthest = squared.max() or 1.0  # a single pixel has no corners
        slopes = np.maximum(1 + self.x * u + self.y * v, 0.0)
        self._factor = slopes * (1 - self.vignette * (squared / farthest))

    def apply(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """rate (1 + x u + y v) (1 - vignette r^2), u and v from -1/2 to 1/2, r from 0 to 1."""
        return rate * self._factor

    expected_rate = apply
