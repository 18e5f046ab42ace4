"""Afterpulsing."""

from __future__ import annotations

import numpy as np

from .. import kernels
from ..events import Children, Events
from ..streams import Draws
from . import Conditions, Effect, parameter


class Afterpulsing(Effect, stage="correlated"):
    """An avalanche fills a trap, and its release fires the same pixel again: at most once, an exponential time later.

    The time counts from the end of the dead time. By the paper's rules every event may have an afterpulse, also one
    that the dead time hides; by a device's, recorded ones alone, afterpulses among them.
    Source: Suonsivu et al., Alg. 1 lines 14-18; probability below 1 % (Table 1), lifetimes from a few to thousands
    of ns.
    """

    counted = True

    probability = parameter(
        0.005,
        "",
        "chance that an avalanche has an afterpulse",
        symbol="P_ap",
        bounds=(0, 1),
        off=0.0,
        search=(1e-4, 0.2),
        per_pixel=True,
    )
    lifetime = parameter(
        25e-9,
        "s",
        "de-trapping lifetime: mean time to the release, after the dead time",
        symbol="tau_bar",
        bounds=(0, None),
        open_bounds=True,
        search=(5e-9, 500e-9),
    )

    def hazards(self, pixels: int) -> np.ndarray:
        """(pixels,) -ln(1 - probability): the same chance, as the stretch of a unit-rate Poisson process."""
        with np.errstate(divide="ignore"):
            return np.ascontiguousarray(np.broadcast_to(-np.log1p(-np.asarray(self.probability)), pixels))

    def spawn(self, events: Events, rng: Draws) -> Children:
        # the release alone: the sensor, which knows the rules, adds the dead time
        parent, delay = kernels.children(events.offsets, self.hazards(events.pixels), rng.images, rng.key)
        return Children(parent, self.lifetime * delay)

    def expected_rate(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        return rate * (1 + np.asarray(self.probability))
