"""The law of a population of traps, which the afterpulsing effects share."""

from __future__ import annotations

from typing import Any

import numpy as np

from .. import kernels
from ..events import Children, Events
from ..streams import Draws
from . import Conditions, Effect


class Traps(Effect, stage="correlated", abstract=True):
    """An avalanche fills a trap, and its release fires the same pixel again: at most once, an exponential time later.

    A subclass declares the parameters `probability` and `lifetime`.
    """

    by_pixel = True
    counted = True
    probability: Any
    lifetime: Any

    def hazards(self, pixels: int) -> np.ndarray:
        """(pixels,) -ln(1 - probability): the same chance, as the stretch of a unit-rate Poisson process."""
        with np.errstate(divide="ignore"):
            return np.ascontiguousarray(np.broadcast_to(-np.log1p(-np.asarray(self.probability)), pixels))

    def spawn(self, events: Events, rng: Draws) -> Children:
        """The releases alone: the sensor, which knows the rules, adds the dead time."""
        parent, delay = kernels.children(events.offsets, self.hazards(events.pixels), rng.images, rng.key, rng.place)
        return Children(parent, self.lifetime * delay)

    def hazard(self, pixels: int) -> tuple[np.ndarray, float]:
        """(`hazards`, the lifetime)."""
        return self.hazards(pixels), float(self.lifetime)

    def mean_delay(self) -> float:
        """The lifetime, s."""
        return float(self.lifetime)

    def influence(self) -> float:
        """A trap fires its own pixel alone."""
        return 0.0

    def expected_rate(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """rate (1 + probability)."""
        return rate * (1 + np.asarray(self.probability))
