"""Dead time."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from . import Conditions, Effect, parameter


class DeadTime(Effect, stage="dead_time"):
    """After a detection the pixel is blind while it is quenched and recharged; what comes then is lost.

    Non-paralyzable: a lost event does not prolong the blindness. Paralyzable (passive quenching): what comes while
    the pixel is blind is lost as well, and the blindness begins anew. It acts on TR streams. In frames the paper
    applies none (its Table 2); under `rules: device` a pixel fires once a frame, and its afterpulses wait for the
    dead time.
    Source: Suonsivu et al., Alg. 1 lines 24-29; typical 1-100 ns (Table 1). Paralyzable: r = lambda exp(-lambda
    tau_d), Knoll, Radiation Detection and Measurement, ch. 4.
    """

    moves = ("edge", "intervals", "linearity", "fano", "level", "ceiling")
    shown: ClassVar[dict[str, Any]] = {"duration": 100e-9}  # the same in all pixels: a sharp edge

    duration = parameter(
        50e-9,
        "s",
        "time after a detection during which the pixel is blind",
        symbol="tau_d",
        bounds=(0, None),
        off=0.0,
        search=(1e-9, 1e-6),
        per_pixel=True,
    )
    paralyzable = parameter(False, "bool", "what comes while the pixel is blind makes it blind anew", off=False)

    @property
    def extends(self) -> bool:
        """Does a lost event prolong the blindness?"""
        return bool(self.paralyzable)

    def blind_time(self) -> np.ndarray:
        """s: one value, or one per pixel."""
        return np.asarray(self.duration)

    def expected_rate(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """rate / (1 + rate tau_d); paralyzable: rate exp(-rate tau_d)."""
        expected = rate * self.blind_time()
        return rate * np.exp(-expected) if self.extends else rate / (1 + expected)
