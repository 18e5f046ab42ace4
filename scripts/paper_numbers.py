"""The paper's numbers that follow from formulas: irradiances of the sensor configs, light of the dataset.

The paper gives rounded light levels and the mean counts of its simulations. `configs/spad23.yaml` and
`configs/spad512.yaml` use the irradiance that gives those means exactly; this script solves for them.

    python scripts/paper_numbers.py
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtri

from spadmnist.light import photons_from_irradiance, photons_from_lux

NANOWATT = 1e-5  # W/m^2 in one nW/cm^2


def spad23(mean_rate: float, wavelength: float, pde: float, dark_rate: float) -> float:
    """Irradiance (W/m^2) at which a SPAD23 pixel records `mean_rate` (1/s): 458 um^2, 50 ns, afterpulsing 0.1 %."""

    def excess(irradiance: float) -> float:
        rate = (photons_from_irradiance(irradiance, 458e-12, wavelength) * pde + dark_rate) * 1.001
        return rate / (1 + rate * 50e-9) - mean_rate

    return float(brentq(excess, 1e-9, 1e-1))


def spad512(mean_count: float, wavelength: float, pdp: float, frame_time: float) -> float:
    """Irradiance (W/m^2) at which the mean of 10,000 binary frames is `mean_count`; 36 um^2, DCR lognormal."""
    share = (np.arange(100_000) + 0.5) / 100_000
    dark = 20.0 * np.exp(2.27 * ndtri(share))

    def excess(irradiance: float) -> float:
        rate = photons_from_irradiance(irradiance, 36e-12, wavelength) * pdp + dark
        return float(-10_000 * np.expm1(-rate * frame_time).mean()) - mean_count

    return float(brentq(excess, 1e-9, 1e2))


def main() -> None:
    white = photons_from_lux(2.56, 25e-12, 555e-9)
    print(f"white at 2560 mlux, 25 um^2, 555 nm: {white:.1f} photons/s, {white * 1e-3 * 0.5:.1f} detected in 1 ms")
    dark = 0.957 * 40 * np.exp(0.5**2 / 2) + 0.043 * 3000 * np.exp(0.3**2 / 2)
    print(f"SPAD23, mean DCR of the config's mixture: {dark:.0f} Hz")
    for mean, wavelength, pde, given in ((17.0e3, 500e-9, 0.422, 3), (2.27e3, 700e-9, 0.162, 0.8)):
        solved = spad23(mean, wavelength, pde, dark) / NANOWATT
        print(f"SPAD23, {wavelength * 1e9:.0f} nm, {mean / 1e3:g} kcps: {solved:.3f} nW/cm^2 (paper: about {given})")
    for mean, wavelength, pdp, frame_time, given in (
        (457, 500e-9, 0.444, 1e-6, "120"),
        (60, 700e-9, 0.207, 1e-6, "20"),
        (9740, 500e-9, 0.444, 10e-6, "10 times brighter"),
        (4184, 700e-9, 0.207, 10e-6, "10 times brighter"),
    ):
        solved = spad512(mean, wavelength, pdp, frame_time) / NANOWATT
        print(
            f"SPAD512, {wavelength * 1e9:.0f} nm, 10,000 x {frame_time * 1e6:.0f} us, mean {mean}: "
            f"{solved:.2f} nW/cm^2 (paper: about {given})"
        )


if __name__ == "__main__":
    main()
