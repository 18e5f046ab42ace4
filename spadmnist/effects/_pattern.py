"""What patterns of lines have in common."""

from __future__ import annotations

import numpy as np

from . import Chip, Conditions, Effect


class Pattern(Effect, stage="light", abstract=True):
    """Every line of pixels, a row or a column, sees the light with a gain of its own."""

    by_pixel = True

    gain: float | np.ndarray

    def line(self, chip: Chip) -> np.ndarray:
        """(pixels,) the line in which each pixel lies."""
        raise NotImplementedError

    def made(self, chip: Chip) -> None:
        gain = np.asarray(self.gain)
        self._factor = gain[self.line(chip)] if gain.ndim else gain

    def apply(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """rate * gain."""
        return rate * self._factor

    expected_rate = apply
