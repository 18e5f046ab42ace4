"""What fell on the sensor, as the command line says it."""

from __future__ import annotations

import math
import re

from .. import units
from ..errors import SpadError
from ..import_options import UNCERTAIN
from ..recording import Light

_LIGHT = 'dark, free, "500 nm free", "500 nm 75.67 nW/cm^2" or "500 nm 5 mlux"'
PLAIN_COLOUR = 555e-9  # m, where only lux are given, or nothing
_SHORTEST_WAVE, _LONGEST_WAVE = 10e-9, 100e-6  # m: what is beyond is another unit, mistaken


def light(text: str, relative_uncertainty: float | None = None) -> Light:
    """What fell on the sensor, as the command line says it: `dark`, `free`, `500 nm 75.67 nW/cm^2`.

    A level that is free is unknown; where no wavelength is given either, 555 nm stands for it. relative_uncertainty: of
    a level, one standard deviation; `UNCERTAIN` where it is None. Raises SpadError.
    """
    words = " ".join(text.split())
    if words == "dark":
        return Light()
    found: dict[str, float] = {}
    for part in re.findall(r"free|[-+.0-9][-+.0-9eE]*\s?[^\s0-9]\S*|\S+", words) or [""]:
        if part == "free":
            continue
        for unit in ("m", "W/m^2", "lux"):
            try:
                value = float(units.parse(part, unit))
            except ValueError:
                continue
            if 0 < value < math.inf and unit not in found:
                found[unit] = value
                break
        else:
            raise SpadError(f"--light: {text!r} is no light; write {_LIGHT}")
    if not _SHORTEST_WAVE <= found.get("m", PLAIN_COLOUR) <= _LONGEST_WAVE:
        raise SpadError(
            f"--light: {text!r} has a wavelength that is none of light, which is {units.show(_SHORTEST_WAVE, 'm')} to "
            f"{units.show(_LONGEST_WAVE, 'm')}; write {_LIGHT}"
        )
    levels = found.keys() - {"m"}
    if len(levels) + words.count("free") > 1 or ("W/m^2" in found and "m" not in found):
        raise SpadError(f"--light: {text!r} needs a wavelength and one level; write {_LIGHT}")
    level = found.get("W/m^2", found.get("lux"))
    share = 0.0 if level is None else UNCERTAIN if relative_uncertainty is None else relative_uncertainty
    return Light(found.get("m", PLAIN_COLOUR), level, "lux" if "lux" in found else "irradiance", share)
