"""Slow recovery after the dead time."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from .. import kernels
from . import Conditions, Effect, parameter


class SlowRecovery(Effect, stage="dead_time"):
    """After the dead time the pixel's bias, and with it its sensitivity, climbs back as 1 - exp(-u / time constant).

    u counts from the end of the blind time. Whatever would fire the pixel meanwhile, photon, dark count, afterpulse
    or crosstalk, does so with the sensitivity of that moment, and else leaves no trace. It acts on TR streams; a
    pixel begins every frame recharged.
    With a = lambda tau_r the mean interval is tau_d + tau_r e^a a^-a gamma(a, a) (lower incomplete gamma function).
    Behind the dead time, whose part is no longer known there, the rate is corrected to first order in
    rate x time constant: each interval is longer by tau_r, which is the most that it can be.
    Source: Krause and Walenta, arXiv 2507.10361; typical 1-50 ns.
    """

    shown: ClassVar[dict[str, Any]] = {"time_constant": 3e-9}  # the whole climb behind the dead time
    moves = ("edge", "intervals", "linearity", "fano", "level")

    time_constant = parameter(
        5e-9,
        "s",
        "time constant of the recharge; 0 s: as good as new at once",
        symbol="tau_r",
        bounds=(0, None),
        off=0.0,
        search=(0.1e-9, 200e-9),
    )

    def sensitivity(self, u: np.ndarray) -> np.ndarray:
        """(n,) from 0 to 1; u: (n,) s since the end of the blind time, not negative."""
        return -np.expm1(-u / self.time_constant) if self.time_constant else np.ones_like(u)

    def recovered(self, chance: np.ndarray) -> np.ndarray:
        """(n,) s since the end of the blind time at which the sensitivity reaches `chance` (n,), each from (0, 1)."""
        return -self.time_constant * kernels.logarithm(1 - chance)

    def expected_rate(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """rate / (1 + rate tau_r): first order, and a lower bound."""
        return rate / (1 + rate * self.time_constant)
