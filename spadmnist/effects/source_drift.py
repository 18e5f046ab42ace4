"""A source that drifts."""

from __future__ import annotations

import numpy as np

from . import Conditions, Effect, parameter


class SourceDrift(Effect, stage="arrival"):
    """The lamp grows brighter or fainter at an even pace over a capture, about its middle: the mean stays.

    The light is multiplied by 1 + slope (t / T - 1/2), t from 0 to the end T of the exposure, under both rules and
    for all pixels alike; dark counts stay as they are.
    Source: no published number; 0.1-5 % per capture is realistic for plasma and incandescent lamps.
    """

    moves = ("trend", "spectrum", "far_pairs", "neighbours", "autocorrelation", "fano")

    slope = parameter(
        0.02,
        "",
        "relative change over one capture, about its middle",
        bounds=(-2, 2),
        off=0.0,
        search=(-0.5, 0.5),
    )

    def factor(self, t: np.ndarray, conditions: Conditions) -> np.ndarray:
        # written so that the ends are exactly 0 and 2 at the steepest slope
        return (1 - self.slope / 2) + self.slope * (t / conditions.exposure)

    def maximum(self, conditions: Conditions) -> float:
        return 1 + abs(self.slope) / 2
