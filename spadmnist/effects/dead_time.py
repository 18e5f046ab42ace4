"""Dead time."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from . import Conditions, Effect, parameter


class DeadTime(Effect, stage="dead_time"):
    """A pixel is blind after a detection, while it is quenched and recharged.

    Non-paralyzable: a lost event does not extend the dead time. Paralyzable (passive quenching): a lost event starts
    the dead time anew. Dead time acts on TR streams and counters. In binary frames the paper applies none (its Table
    2). Under `rules: device` a pixel fires once a frame, and its afterpulses are delayed by the dead time.
    Source: Suonsivu et al., Alg. 1 lines 24-29; typical 1-100 ns (Table 1). Paralyzable: r = lambda exp(-lambda tau_d),
    Knoll, Radiation Detection and Measurement, ch. 4.
    """

    by_pixel = True
    moves = ("edge", "intervals", "linearity", "fano", "level", "ceiling")
    shown: ClassVar[dict[str, Any]] = {"duration": 100e-9}  # the same in all pixels: a sharp edge

    duration = parameter(
        50e-9,
        "s",
        "dead time after a detection",
        symbol="tau_d",
        bounds=(0, None),
        off=0.0,
        search=(1e-9, 1e-6),
        per_pixel=True,
        kind="edge",
    )
    paralyzable = parameter(False, "bool", "a lost event starts the dead time anew", off=False)

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
