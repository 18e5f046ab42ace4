"""What fell on the sensor, as the command line says it."""

from __future__ import annotations

import contextlib
import math
import re
from dataclasses import replace
from pathlib import Path

from .. import scene, units
from ..errors import SpadError
from ..import_options import UNCERTAIN
from ..recording import Light

_LIGHT = 'dark, free, "500 nm free", "500 nm 75.67 nW/cm^2", "500 nm 5 mlux" or image:FILE.npy before one of these'
_IMAGE = "image:"
PLAIN_COLOUR = 555e-9  # m, where only lux are given, or nothing


def light(text: str, relative_uncertainty: float | None = None) -> Light:
    """What fell on the sensor, as the command line says it: `dark`, `free`, `500 nm 75.67 nW/cm^2`.

    Of a scene, `image:chart.npy`, the light is that of its white: free, or as it is said behind it; 555 nm stand for a
    wavelength that is not given.
    A level that is free is unknown; where no wavelength is given either, 555 nm stands for it. relative_uncertainty: of
    a level, one standard deviation; `UNCERTAIN` where it is None. Raises SpadError.
    """
    words = " ".join(text.split())
    if words == "dark":
        return Light()
    shown = None
    if words.startswith(_IMAGE):
        file, _, words = words.removeprefix(_IMAGE).partition(" ")
        if not file:
            raise SpadError(f"--light: {text!r} is no light; write {_LIGHT}")
        shown, words = Path(file), words or "free"
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
            raise SpadError(f"--light: {text!r} is no light: {_fault(part)}; write {_LIGHT}")
    shortest, longest = units.WAVELENGTHS
    if not shortest <= found.get("m", PLAIN_COLOUR) <= longest:
        raise SpadError(
            f"--light: {text!r} has a wavelength that is none of light, which is {units.show(shortest, 'm')} to "
            f"{units.show(longest, 'm')}; write {_LIGHT}"
        )
    levels = found.keys() - {"m"}
    unsaid = "W/m^2" in found and "m" not in found and shown is None
    if len(levels) + words.count("free") > 1 or unsaid:
        raise SpadError(f"--light: {text!r} needs a wavelength and one level; write {_LIGHT}")
    level = found.get("W/m^2", found.get("lux"))
    share = 0.0 if level is None else UNCERTAIN if relative_uncertainty is None else relative_uncertainty
    lit = Light(found.get("m", PLAIN_COLOUR), level, "lux" if "lux" in found else "irradiance", share)
    return lit if shown is None else replace(lit, scene=scene.read(shown))


def _fault(part: str) -> str:
    """What is wrong with a part of a light, in words."""
    number = re.match(r"[-+.0-9][-+.0-9eE]*", part)
    if number is None:
        return f"{part!r} is no number with a unit"
    unit = part[number.end() :].strip()
    if not unit:
        return f"{part!r} has no unit"
    for kind in ("m", "W/m^2", "lux"):
        with contextlib.suppress(ValueError):
            units.parse(f"1 {unit}", kind)
            return f"{part!r} is not possible, or there twice"
    return f"{unit!r} is no unit of a wavelength or of light, which are nm, nW/cm^2, W/m^2, lux and the like"
