"""Light: grey levels and irradiance to photons per second on a pixel's active area."""

from __future__ import annotations

PLANCK = 6.62607015e-34  # J s, exact (SI 2019)
SPEED_OF_LIGHT = 299792458.0  # m/s, exact
LUMINOUS_EFFICACY = 683.0  # lm/W at 555 nm (paper, eq. 2)
GREEN = 555e-9  # m, of light of which the efficacy holds
_NEAR = 0.5e-9  # m: a wavelength that is written with three digits


def photon_energy(wavelength: float) -> float:
    """E_ph = h c / lambda (J), wavelength in m (paper, below eq. 3)."""
    return PLANCK * SPEED_OF_LIGHT / wavelength


def of_lux(*wavelengths: float) -> str | None:
    """What is to be known of a level in lux at some wavelengths (m); None where all are 555 nm, where it holds."""
    far = [f"{one * 1e9:.4g} nm" for one in wavelengths if abs(one - GREEN) >= _NEAR]
    if not far:
        return None
    return (
        "lux is turned into power with 683 lm/W, which holds at 555 nm, not at "
        f"{' or '.join(far)}; give irradiance where the light is not green"
    )


def photons_from_lux(lux: float, active_area: float, wavelength: float) -> float:
    """Photons/s on `active_area` (m^2) at an illuminance (lux): eqs. 2 and 3 of the paper."""
    return active_area * lux / LUMINOUS_EFFICACY / photon_energy(wavelength)


def photons_from_irradiance(irradiance: float, active_area: float, wavelength: float) -> float:
    """Photons/s on `active_area` (m^2) at an irradiance (W/m^2)."""
    return active_area * irradiance / photon_energy(wavelength)
