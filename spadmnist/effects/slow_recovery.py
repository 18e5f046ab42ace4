"""Slow recovery after the dead time."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from .. import kernels
from . import Conditions, Effect, parameter


class SlowRecovery(Effect, stage="dead_time"):
    """After the dead time the sensitivity of a pixel recovers as 1 - exp(-u / time constant).

    u is the time since the end of the dead time. A photon, a dark count, an afterpulse or crosstalk fires the pixel
    with the sensitivity at its time; otherwise it is lost without a trace. The effect acts on TR streams and counters.
    In binary frames a pixel is fully recharged at the start of each. With a = lambda tau_r the mean interval is tau_d +
    tau_r e^a a^-a gamma(a, a) (lower incomplete gamma function). The closed form below does not know tau_d. It is of
    first order in rate x time constant: each interval is longer by tau_r, which is the upper bound.
    Source: Krause and Walenta, arXiv 2507.10361; typical 1-50 ns.
    """

    by_pixel = True
    shown: ClassVar[dict[str, Any]] = {"time_constant": 3e-9}  # the whole climb behind the dead time
    moves = ("edge", "intervals", "linearity", "fano", "level")

    time_constant = parameter(
        5e-9,
        "s",
        "time constant of the recharge; 0 s: full sensitivity at once",
        symbol="tau_r",
        bounds=(0, None),
        off=0.0,
        search=(0.1e-9, 200e-9),
        kind="edge",
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
