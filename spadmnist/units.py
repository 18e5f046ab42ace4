"""Quantities: SI floats inside, `"50 ns"` at the door.

A quantity with a dimension is a number and a unit in one string; a bare number where a unit is needed is an
error that shows what to write. A dimensionless quantity is bare or in per cent. The micro sign, as either of its two
characters, may stand wherever a unit begins with `u`, and `cm2` for `cm^2`: it is kept as `cm^2`.
"""

from __future__ import annotations

import math
import re
from decimal import Decimal

# dimension (named by its SI unit) -> (what people call it, unit -> factor to SI, an example to show)
_DIMENSIONS: dict[str, tuple[str, dict[str, str], str]] = {
    "s": (
        "time",
        {"s": "1", "ms": "1e-3", "us": "1e-6", "ns": "1e-9", "ps": "1e-12"},
        "50 ns",
    ),
    "Hz": ("rate", {"Hz": "1", "mHz": "1e-3", "kHz": "1e3", "MHz": "1e6", "GHz": "1e9"}, "100 Hz"),
    "m": (
        "length",
        {"m": "1", "mm": "1e-3", "um": "1e-6", "nm": "1e-9"},
        "555 nm",
    ),
    "m^2": (
        "area",
        {"m^2": "1", "mm^2": "1e-6", "um^2": "1e-12"},
        "25 um^2",
    ),
    "lux": ("illuminance", {"lux": "1", "mlux": "1e-3", "ulux": "1e-6", "klux": "1e3"}, "5 mlux"),
    "W/m^2": (
        "irradiance",
        {
            "W/m^2": "1",
            "mW/m^2": "1e-3",
            "uW/m^2": "1e-6",
            "W/cm^2": "1e4",
            "mW/cm^2": "10",
            "uW/cm^2": "1e-2",
            "nW/cm^2": "1e-5",
            "pW/cm^2": "1e-8",
        },
        "120 nW/cm^2",
    ),
    "rad": ("angle", {"rad": "1"}, "0.5 rad"),
    "": ("number without a dimension", {"": "1", "%": "1e-2"}, "0.5 %"),
}

_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)\s*(\S*)\s*", re.ASCII)


# the micro sign and the Greek letter that looks like it, where a unit begins
_MICRO = re.compile("(?<![A-Za-z])[\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}](?=[A-Za-z])")
_SQUARE = re.compile("(?<=m)2$")  # of a length, without its caret, where a unit ends

_LONGEST = 60  # characters of a quantity
# digits of a fitted number in a sensor file: a hundred times finer than the smallest error of a fit; a rule of thumb
WRITTEN = 6

# SI units: what a time or a level that a file declares may be; beyond it the number is damaged
SHORTEST, LONGEST = 1e-18, 1e18
WAVELENGTHS = 10e-9, 100e-6  # m, of light: what is beyond is another unit, mistaken
LARGEST_PIXEL = 1e-4  # m^2, its area: more is another unit, mistaken; large single detectors have 1e-6 to 4e-5


class Quantity(float):
    """A finite number in SI units that remembers how it was written (`.text`) and its unit (`.unit`)."""

    text: str
    unit: str

    def __new__(cls, value: float, text: str, unit: str) -> Quantity:
        self = super().__new__(cls, value)
        self.text = text
        self.unit = unit
        return self

    def __getnewargs__(self) -> tuple[float, str, str]:  # type: ignore[override]
        return float(self), self.text, self.unit

    def __str__(self) -> str:
        return self.text


def plain(text: str) -> str:
    """The text with `u` in place of each micro sign at the beginning of a unit: `5 µlux` -> `5 ulux`."""
    return _MICRO.sub("u", text)


def known() -> list[str]:
    """The SI units by which dimensions are named; "" is that of plain numbers."""
    return list(_DIMENSIONS)


def is_known(unit: str) -> bool:
    """Is there a dimension whose SI unit is `unit`?"""
    return unit in _DIMENSIONS


def dimension_name(unit: str) -> str:
    """What people call the dimension whose SI unit is `unit`: `"s"` -> `"time"`."""
    return _DIMENSIONS[unit][0]


def example(unit: str) -> str:
    """A well-formed quantity of the dimension whose SI unit is `unit`."""
    return _DIMENSIONS[unit][2]


def allowed_units(unit: str) -> str:
    """The units one may write for the dimension, in a row."""
    return ", ".join(u for u in _DIMENSIONS[unit][1] if u)


def pattern(unit: str, signed: bool = True) -> str:
    """A regular expression, as JSON Schema has them, of every text that `parse` reads; signed: below 0, too."""
    named = [re.escape(u).replace(r"\^", r"\^?") for u in _DIMENSIONS[unit][1] if u]
    written = "|".join(f"[u\u00b5\u03bc]{u[1:]}" if u[0] == "u" else u for u in named)
    number = r"([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,3})?"
    return rf"^\s*{'[+-]' if signed else '[+]'}?{number}\s*({written}){'' if unit else '?'}\s*$"


def parse(value: object, unit: str) -> Quantity:
    """Read a quantity whose SI unit is `unit` (`"s"`, `"Hz"`, `"m"`, `"m^2"`, `"lux"`, `"W/m^2"`, `""`).

    Raises ValueError with a sentence that says what to write.
    """
    name, units, sample = _DIMENSIONS[unit]
    if isinstance(value, Quantity) and value.unit == unit:
        return value
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise ValueError(f"{value!r} is not {_a(name)}; write {_how(unit, sample)}")
    if isinstance(value, (int, float)):
        if unit:
            raise ValueError(_no_unit(value, unit))
        text = repr(value)
    else:
        text = _SQUARE.sub("^2", value.strip())
        if len(text) > _LONGEST:
            raise ValueError(f"{text[:20]!r}... is not {_a(name)}; write {_how(unit, sample)}")
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise ValueError(f"{value!r} is not {_a(name)}; write {_how(unit, sample)}")
    number, written = match[1], plain(match[2])
    if written not in units:
        if not written:
            raise ValueError(_no_unit(value, unit))
        raise ValueError(f"{value!r} is not {_a(name)}; write {_how(unit, sample)}")
    try:
        # exact decimal arithmetic, so that 1000 mlux and 1 lux are the same double
        si = float(Decimal(number) * Decimal(units[written]))
    except ArithmeticError:
        si = math.inf
    if not math.isfinite(si):
        raise ValueError(f"{value!r} is too large for {_a(name)}")
    return Quantity(si, text, unit)


def _no_unit(value: object, unit: str) -> str:
    name, _, sample = _DIMENSIONS[unit]
    return f'{value!r} has no unit; {_a(name)} is a number and a unit ({allowed_units(unit)}), for example "{sample}"'


def _a(name: str) -> str:
    return f"an {name}" if name[0] in "aeiou" else f"a {name}"


def _how(unit: str, sample: str) -> str:
    if not unit:
        return 'a bare number or per cent, for example 0.005 or "0.5 %"'
    return f'a number and one of {allowed_units(unit)}, for example "{sample}"'


def show(value: float, unit: str, digits: int = 4) -> str:
    """A value in SI, for people: the unit is scaled so that the number lies between 1 and 1000 where it can.

    >>> show(5e-8, "s")
    '50 ns'
    >>> show(36000, "s")
    '36000 s'
    """
    units = {u: float(f) for u, f in _DIMENSIONS[unit][1].items() if u != "%"}
    if unit == "W/m^2":
        units = {u: f for u, f in units.items() if u.endswith("/cm^2")}
    if value == 0 or not math.isfinite(value) or len(units) == 1:
        base = unit if unit in units else next(iter(units), "")
        return f"{value:.{digits}g} {base}".strip()
    by_size = sorted(units.items(), key=lambda item: item[1])
    best = by_size[0]
    for name, factor in by_size:
        number = abs(value) / factor
        if number >= 1 - 1e-9 or float(f"{number:.{digits}g}") >= 1:  # what is rounded to 1000 is 1 of the next unit
            best = (name, factor)
    number = value / best[1]
    rounded = float(f"{number:.{digits}g}")
    plain = 10**digits <= abs(rounded) < 1e7  # `36000 s` and not 3.6e+04
    return f"{rounded:.0f} {best[0]}" if plain else f"{number:.{digits}g} {best[0]}"


def rounded(value: float) -> float:
    """A value in SI as a file that we write has it, with `WRITTEN` digits."""
    return float(f"{value:.{WRITTEN}g}")


def exact(value: float, unit: str) -> str:
    """The shortest text that is read back as exactly this number (SI)."""
    for digits in (6, 9, 12, 15, 17):
        text = show(value, unit, digits)
        if "e" not in text.split()[0] and parse(text, unit) == value:
            return text
    return f"{float(value)!r} {unit}"


def factor(value: float) -> str:
    """A factor for people: 1.0203, 0.00041."""
    return f"{value:.4f}" if value == 0 or abs(value) >= 0.01 else f"{value:.2g}"
