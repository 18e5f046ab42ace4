"""Photon detection probability."""

from __future__ import annotations

import numpy as np

from ..plugins import ByWavelength
from . import Conditions, Effect, Mimic, parameter

# of the PDP times `relative`, in the median: more is a map in other units. Factors of up to 2 are tried, of any PDP
_MOST = 2.0


class Detection(Effect, stage="detection"):
    """A photon starts an avalanche with the probability PDP.

    PDP is the quantum efficiency times the triggering probability. Keeping each photon with probability q turns a
    Poisson process into one of q times the rate, so the thinning is exact.
    Source: Suonsivu et al., Alg. 1 lines 6-9; typical 30-70 % at the peak (Table 1).
    """

    by_pixel = True
    mimic_of_map = Mimic("light that is not uniform", "", "a capture with the lamp or the sensor moved", alone=True)
    moves = ("map", "rows_columns", "surface", "level", "outliers")

    pdp = parameter(
        0.5,
        "",
        "photon detection probability",
        symbol="q",
        bounds=(0, 1),
        off=1.0,
        search=(0.01, 1),
        per_pixel=True,
        by_wavelength=True,
    )
    relative = parameter(
        1.0,
        "",
        "factor that multiplies the PDP",
        bounds=(0, None),
        off=1.0,
        search=(0, 2),
        per_pixel=True,
    )

    def made(self, chip: object) -> None:
        pdps = self.pdp.values if isinstance(self.pdp, ByWavelength) else (self.pdp,)
        typical = max(float(np.median(np.asarray(one) * self.relative)) for one in pdps)
        if typical > _MOST:
            raise ValueError(
                f"the PDP times relative is {typical:.3g} in the median; it is a share of the photons, and relative is "
                "1 in a typical pixel: divide a measured map by its median"
            )

    def pdp_at(self, wavelength: float | None) -> np.ndarray:
        """PDP at a wavelength (m): one value, or one per pixel."""
        if isinstance(self.pdp, ByWavelength):
            return np.asarray(0.0 if wavelength is None else self.pdp.at(wavelength))
        return np.asarray(self.pdp)

    def apply(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """rate * PDP."""
        return rate * np.minimum(self.pdp_at(conditions.wavelength) * self.relative, 1.0)

    expected_rate = apply
