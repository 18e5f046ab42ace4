"""What experiments beside a camera share: the imperfections of a chip, and the light at which a mean comes out."""

from __future__ import annotations

from collections.abc import Callable

from scipy.optimize import brentq

from ..errors import InputError
from ..plugins import Distribution

# The chip of an imitation, beside the dark counts of its config. The paper gives no numbers for "pixel-wise PDP
# variation" and "lazy pixels"; these make histograms like its own (scripts/paper_failure.py).
SPREAD = 0.04  # standard deviation of the PDP, relative
LAZY, LAZY_PDP = 0.02, (0.55, 0.14)  # share of lazy pixels; mean and standard deviation of the PDP left to them
RATE = "dark_counts.rate"


def imperfections(pdp: float) -> dict[str, dict[str, Distribution]]:
    """Values for `Sensor.with_values` by imperfection, of a sensor whose nominal PDP is `pdp`."""
    whole, lazy = Distribution("normal", (1.0, 0.0)), Distribution("normal", LAZY_PDP)
    return {
        f"PDP spread, {100 * SPREAD:g} %": {"detection.pdp": Distribution("normal", (pdp, SPREAD * pdp))},
        f"lazy pixels, {100 * LAZY:g} %": {
            "detection.relative": Distribution("mixture", parts=((1 - LAZY, whole), (LAZY, lazy)))
        },
    }


def light_of_mean(mean_at: Callable[[float], float], mean: float, place: str) -> float:
    """The light, in the unit of `mean_at`'s argument, at which `mean_at` gives a mean count.

    mean_at: a sensor's mean count in such light, which grows with it. Raises InputError with the `place` where no light
    would do.
    """

    def excess(light: float) -> float:
        return mean_at(light) - mean

    most = 1.0
    while excess(most) < 0 and most < 1e9:
        most *= 10
    if excess(0.0) >= 0 or excess(most) < 0:
        raise InputError(
            f"{place}: its mean count is {mean:.4g}, the sensor has {excess(0.0) + mean:.4g} in the dark and "
            f"{excess(most) + mean:.4g} in the brightest light, so its light cannot be told; correct the capture, or "
            "add one in the dark"
        )
    return float(brentq(excess, 0.0, most, xtol=1e-9))
