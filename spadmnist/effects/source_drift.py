"""A source that drifts."""

from __future__ import annotations

import numpy as np

from . import Conditions, Effect, parameter


class SourceDrift(Effect, stage="arrival"):
    """The light changes linearly over a capture; its mean stays.

    The light is multiplied by 1 + slope (t / T - 1/2), where t is the time since the start of the exposure T. The
    factor is the same for all pixels and under both rules. Dark counts do not change.
    Source: no published number; 0.1-5 % per capture is realistic for plasma and incandescent lamps.
    """

    by_pixel = True
    moves = ("trend", "spectrum", "far_pairs", "neighbours", "autocorrelation", "fano")

    slope = parameter(
        0.02,
        "",
        "relative change over one capture",
        bounds=(-2, 2),
        off=0.0,
        search=(-0.5, 0.5),
    )

    def factor(self, t: np.ndarray, conditions: Conditions) -> np.ndarray:
        # written so that the ends are exactly 0 and 2 at the steepest slope
        return (1 - self.slope / 2) + self.slope * (t / conditions.exposure)

    def maximum(self, conditions: Conditions) -> float:
        return 1 + abs(self.slope) / 2
