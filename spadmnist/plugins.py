"""Plug-ins: a class in a file that declares its own parameters. Putting the file there is the registration.

`Plugin` is the base of effects (`spadmnist.effects.Effect`) and of reconstruction methods
(`spadmnist.reconstruct.Method`). A subclass of one of those is known by its name in snake case as soon as its file
has been imported: by `discover` (the package's own places and the entry points of group `spadmnist.plugins`) or by
`load_file` (`--plugin FILE.py`). There is no list of them anywhere.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.abc
import importlib.metadata
import importlib.util
import inspect
import io
import os
import pkgutil
import re
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from . import disk, imported, leftovers, units
from .errors import EffectError, InputError, UnknownName, did_you_mean

PLACES = ("spadmnist.effects", "spadmnist.reconstruct", "spadmnist.statistics")  # packages or modules
ENTRY_POINTS = "spadmnist.plugins"
PER = ("", "pixel", "row", "column", "code")  # what a parameter may have a value for each of


# --- parameters ---------------------------------------------------------------------------------------------------


# How a search and a fit move a parameter:
#   smooth     by gradients
#   time       by gradients where it is a shape; as a strength in steps, for no signature is proportional to it
#   edge       a time at which something begins or ends at once: also in steps of a few thousandths
#   count      from one whole number to the next
#   multiple   where it is listed, from one whole multiple or whole part of that to the next; else as a time
#   frequency  of a line, in Hz: it is tried where the data have one
#   phase      of a line: another one in each capture
#   switch     yes or no
KINDS = ("smooth", "time", "edge", "count", "multiple", "frequency", "phase", "switch")


@dataclass(frozen=True)
class Parameter:
    """What an effect says of one of its parameters. Numbers are SI; `unit` is that of `spadmnist.units`."""

    default: Any
    unit: str
    about: str
    symbol: str = ""
    bounds: tuple[float | None, float | None] = (None, None)
    open_bounds: bool = False  # the bounds themselves are not allowed
    off: float | bool | None = None
    search: tuple[float, float] | None = None
    per: str = ""  # "pixel", "row", "column" or "code" (see `PER`): it may be a map or a distribution
    by_wavelength: bool = False
    choices: tuple[str, ...] = ()
    required: bool = False
    needs: str = ""  # the parameter without which this one does nothing
    later: bool = False  # datasets of earlier programs do not name it
    kind: str = ""  # how a search and a fit move it (see `KINDS`); "" until its class is made
    informed_by: str = ""  # the statistic that tells its value in each pixel; "": the counts
    name: str = ""

    @property
    def per_pixel(self) -> bool:
        """It may vary from pixel to pixel."""
        return self.per == "pixel"

    def allowed(self) -> str:
        """`"between 0 and 1"`, for people."""
        if self.choices:
            return " or ".join(self.choices)
        low, high = self.bounds
        edge = "more than" if self.open_bounds else "at least"
        if low is not None and high is not None:
            return f"between {units.show(low, self.unit)} and {units.show(high, self.unit)}"
        if low is not None:
            return f"{edge} {units.show(low, self.unit)}"
        if high is not None:
            return f"at most {units.show(high, self.unit)}"
        return "any number"

    def check(self, value: float, written: str | None = None) -> None:
        """Raises ValueError where a value lies outside the bounds. written: as the user wrote it."""
        low, high = self.bounds
        outside = (low is not None and (value < low or (self.open_bounds and value == low))) or (
            high is not None and (value > high or (self.open_bounds and value == high))
        )
        if outside or not np.isfinite(value):
            shown = written if written is not None else units.show(value, self.unit)
            raise ValueError(f"{shown} is not possible; {self.name} is {self.allowed()}")


def parameter(
    default: Any,
    unit: str,
    about: str,
    *,
    symbol: str = "",
    bounds: tuple[float | None, float | None] = (None, None),
    open_bounds: bool = False,
    off: float | bool | None = None,
    search: tuple[float, float] | None = None,
    per_pixel: bool = False,
    per: str = "",
    by_wavelength: bool = False,
    choices: tuple[str, ...] = (),
    required: bool = False,
    needs: str = "",
    later: bool = False,
    kind: str = "",
    informed_by: str = "",
) -> Any:
    """Declare a parameter in the body of a plug-in's class.

    unit: an SI unit of `spadmnist.units` (`"s"`, `"Hz"`, `""`, ...) or `"bool"`; default, bounds, off, search: SI.
    off: the value at which the effect vanishes. bounds: what is possible. search: where a fit looks.
    per_pixel: it may be a map from a file or a distribution; per: the same over "row", "column" or "code" (of a
    converter; the effect declares a parameter `period`, their number) instead of "pixel". by_wavelength: it may be a
    table over the wavelength. choices: the words that are allowed, where it is no number. needs: another parameter,
    without which this one does nothing. later: datasets have been made with this effect before it had this parameter,
    whose default does what was done then: a manifest names it only where it has another value. kind: how a search and a
    fit move it, one of `KINDS`; default: what `_kind_of` makes of the unit. informed_by: the statistic whose
    `unit_likelihood` tells the value in each pixel, for maps; default: the counts of the pixels.
    """
    per = "pixel" if per_pixel else per
    if per not in PER:
        raise TypeError(f"{per!r} is none of {', '.join(repr(one) for one in PER)}")
    if choices and default not in choices:
        raise TypeError(f"{default!r} is none of the choices {', '.join(choices)}")
    if unit != "bool" and not units.is_known(unit):
        known = next((si for si in units.known() if unit in units.allowed_units(si).split(", ")), None)
        how = (
            f"write {known!r}, and all numbers in it"
            if known
            else f"the units are {', '.join(filter(None, units.known()))}"
        )
        raise TypeError(f"{unit!r} is not an SI unit that is known here; {how}")
    for what, pair in (("bounds", bounds), ("search", search)):
        pairs = isinstance(pair, tuple | list) and len(pair) == 2
        ends = [end for end in pair if end is not None] if pairs and pair is not None else []
        numbers = all(isinstance(end, int | float | np.number) for end in ends)
        if pair is not None and not (pairs and numbers and (what == "bounds" or len(ends) == 2)):
            raise TypeError(f"{about}: {what} is {pair!r}; it is two numbers, (least, most)")
        if len(ends) == 2 and ends[0] > ends[1]:
            raise TypeError(f"{about}: {what} is {pair!r}; the least number comes first")
    if kind not in ("", *KINDS):
        raise TypeError(f"{kind!r} is none of the kinds {', '.join(KINDS)}")
    if informed_by and per != "pixel":
        raise TypeError(f"{about}: informed_by is of maps over pixels: give per_pixel=True")
    if later and required:
        raise TypeError(f"{about}: it came later, so that old configs lack it: it cannot be required")
    return Parameter(
        *(default, unit, about, symbol, bounds, open_bounds, off, search, per),
        *(by_wavelength, choices, required, needs, later, kind, informed_by),
    )


def _kind_of(one: Parameter, others: Iterable[Parameter]) -> str:
    """The kind of a parameter that declares none, by its unit; others: all parameters of the effect."""
    if one.unit == "bool":
        return "switch"
    if _is_angle(one):
        return "phase"
    if one.unit == "Hz" and any(map(_is_angle, others)):
        return "frequency"
    if one.unit == "s":
        return "time"
    if one.search is not None and not one.unit and one.search[0] >= 1 and one.bounds[0] is not None:
        return "count" if all(x == int(x) for x in (*one.search, one.default)) else "smooth"
    return "smooth"


def _is_angle(one: Parameter) -> bool:
    """Whether it says where in its swing something is: without it the effect is no weaker."""
    return one.kind == "phase" or (not one.kind and one.unit == "rad" and one.off is None)


# --- values as a config gives them --------------------------------------------------------------------------------


@dataclass(frozen=True)
class ByWavelength:
    """A table over the wavelength (m, ascending), interpolated linearly between its entries."""

    wavelengths: tuple[float, ...]
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.wavelengths) != len(self.values) or not len(self.values):
            raise InputError(
                f"a table over the wavelength has {len(self.wavelengths)} wavelengths and {len(self.values)} values; "
                "it needs one for each"
            )
        if any(b <= a for a, b in zip(self.wavelengths, self.wavelengths[1:], strict=False)):
            raise InputError(f"the wavelengths {list(self.wavelengths)} of a table do not ascend; sort its entries")

    def at(self, wavelength: float) -> float:
        """Raises InputError outside the table."""
        if not self.wavelengths[0] <= wavelength <= self.wavelengths[-1]:
            raise InputError(
                f"the wavelength {units.show(wavelength, 'm')} lies outside the table, which goes from "
                f"{units.show(self.wavelengths[0], 'm')} to {units.show(self.wavelengths[-1], 'm')}; "
                "add an entry for it to the table"
            )
        return float(np.interp(wavelength, self.wavelengths, self.values))


@dataclass(frozen=True)
class MapFile:
    """One value per pixel (row, column, code) from a `.npy` file."""

    path: Path


@dataclass(frozen=True)
class Distribution:
    """Drawn once for a chip: `normal` (mean, sigma), `lognormal` (median, sigma), or a `mixture` of shares."""

    kind: str
    numbers: tuple[float, ...] = ()
    parts: tuple[tuple[float, Distribution], ...] = ()

    def draw(self, rng: np.random.Generator, pixels: int) -> np.ndarray:
        """(pixels,) values in SI."""
        if self.kind == "normal":
            return rng.normal(self.numbers[0], self.numbers[1], pixels)
        if self.kind == "lognormal":
            return self.numbers[0] * np.exp(self.numbers[1] * rng.standard_normal(pixels))
        which = np.searchsorted(np.cumsum([share for share, _ in self.parts]), rng.random(pixels), side="right")
        drawn = np.stack([part.draw(rng, pixels) for _, part in self.parts])
        return drawn[np.minimum(which, len(self.parts) - 1), np.arange(pixels)]


_LARGEST_MAP = 1 << 24  # entries of a map: 128 MiB
_DISTRIBUTIONS = {"normal": ("mean", "sigma"), "lognormal": ("median", "sigma")}

Problem = Callable[[tuple[Any, ...], str], None]  # (path below the value, sentence)


def read_value(declared: Parameter, raw: Any, base: Path, problem: Problem) -> Any:
    """Turn a config's value into a float, bool, `ByWavelength`, `MapFile` or `Distribution`.

    base: the folder of the config file. Every mistake goes to `problem`; then None is returned.
    """
    if declared.choices:
        if raw in declared.choices:
            return raw
        problem((), f"{raw!r} is not possible; {declared.name} is {declared.allowed()}")
        return None
    if declared.unit == "bool":
        if isinstance(raw, bool):
            return raw
        problem((), f"{raw!r} is not a switch; write true or false")
        return None
    if isinstance(raw, Mapping):
        return _read_mapping(declared, raw, base, problem)
    return _read_number(declared, raw, (), problem)


def _read_number(declared: Parameter, raw: Any, path: tuple[Any, ...], problem: Problem) -> float | None:
    try:
        value = units.parse(raw, declared.unit)
        declared.check(value, value.text)
    except ValueError as error:
        problem(path, str(error))
        return None
    return float(value)


def _read_mapping(declared: Parameter, raw: Mapping[Any, Any], base: Path, problem: Problem) -> Any:
    keys = set(raw)
    if keys == {"file"}:
        if not declared.per:
            problem((), f"{declared.name} is one number for the whole array; a map is not allowed here")
            return None
        if not isinstance(raw["file"], str):
            problem(("file",), f"{raw['file']!r} is not a file name")
            return None
        return MapFile((base / raw["file"]).resolve())
    if keys & {"normal", "lognormal", "mixture"}:
        if not declared.per:
            problem((), f"{declared.name} is one number for the whole array; a distribution is not allowed here")
            return None
        return _read_distribution(declared, raw, (), problem)
    if declared.by_wavelength:
        return _read_table(declared, raw, problem)
    forms = ["one value"]
    if declared.per:
        forms += [
            "{file: map.npy}",
            "{normal: {mean, sigma}}",
            "{lognormal: {median, sigma}}",
            "{mixture: [...]}",
        ]
    problem((), f"{dict(raw)!r} is none of the forms that {declared.name} takes: {', '.join(forms)}")
    return None


def _read_table(declared: Parameter, raw: Mapping[Any, Any], problem: Problem) -> ByWavelength | None:
    entries = []
    good = bool(raw)
    if not raw:
        problem((), "the table is empty; write for example {500 nm: 0.42, 700 nm: 0.16}")
    for key, value in raw.items():
        try:
            wavelength = units.parse(key, "m")
        except ValueError as error:
            problem((key,), f"{error} (a table goes over the wavelength)")
            good = False
            continue
        number = _read_number(declared, value, (key,), problem)
        good = good and number is not None
        entries.append((float(wavelength), number or 0.0))
    entries.sort()
    if good and len({w for w, _ in entries}) < len(entries):
        problem((), "a wavelength stands in the table twice")
        good = False
    return ByWavelength(tuple(w for w, _ in entries), tuple(v for _, v in entries)) if good else None


def _read_distribution(declared: Parameter, raw: Any, path: tuple[Any, ...], problem: Problem) -> Distribution | None:
    kinds = [k for k in raw if k in (*_DISTRIBUTIONS, "mixture")] if isinstance(raw, Mapping) else []
    extra = [k for k in raw if k not in (*kinds, "share")] if isinstance(raw, Mapping) else []
    if len(kinds) != 1 or extra:
        problem(path, f"{raw!r} is not a distribution; write one of normal, lognormal, mixture")
        return None
    kind = kinds[0]
    body = raw[kind]
    if kind == "mixture":
        return _read_mixture(declared, body, (*path, kind), problem)
    names = _DISTRIBUTIONS[kind]
    if not isinstance(body, Mapping) or set(body) != set(names):
        problem((*path, kind), f"{body!r} does not give {' and '.join(names)}, which {kind} needs")
        return None
    centre = _read_number(declared, body[names[0]], (*path, kind, names[0]), problem)
    width = Parameter(0.0, "" if kind == "lognormal" else declared.unit, "", bounds=(0, None), name="sigma")
    sigma = _read_number(width, body["sigma"], (*path, kind, "sigma"), problem)
    return None if centre is None or sigma is None else Distribution(kind, (centre, sigma))


def _read_mixture(declared: Parameter, body: Any, path: tuple[Any, ...], problem: Problem) -> Distribution | None:
    if not isinstance(body, list) or not body:
        problem(path, "a mixture is a list of distributions, each with its share")
        return None
    share_of = Parameter(0.0, "", "", bounds=(0, 1), name="share")
    parts = []
    for i, item in enumerate(body):
        if not isinstance(item, Mapping) or "share" not in item:
            problem((*path, i), "each part of a mixture needs a share, for example {share: 0.03, normal: {...}}")
            return None
        share = _read_number(share_of, item["share"], (*path, i, "share"), problem)
        part = _read_distribution(declared, item, (*path, i), problem)
        if share is None or part is None:
            return None
        parts.append((share, part))
    total = sum(share for share, _ in parts)
    if abs(total - 1) > 1e-9:
        problem(path, f"the shares add up to {total:g}, not to 1")
        return None
    return Distribution("mixture", (), tuple(parts))


def resolve(declared: Parameter, value: Any, shapes: tuple[tuple[int, ...], ...], key: str) -> Any:
    """The value an effect computes with: a float, a bool, a word, a `ByWavelength`, or a float64 array.

    shapes: those that a map may have; a distribution is drawn for the first of them. Maps are returned in the shape
    they have, but one value a pixel always as (pixels,). key: what a distribution is drawn from (chip seed, effect and
    parameter in one string). Drawn values outside the bounds are set to the bound. Raises InputError where a map is
    unreadable, or a map or an array is of another shape or out of bounds, or where a distribution has no finite values.
    """
    if isinstance(value, Distribution):
        digest = hashlib.sha256(key.encode()).digest()
        rng = np.random.Generator(np.random.Philox(key=int.from_bytes(digest[:16], "little")))
        low, high = declared.bounds
        with np.errstate(over="ignore", invalid="ignore"):
            drawn = np.clip(value.draw(rng, int(np.prod(shapes[0]))), low, high)
        if not np.all(np.isfinite(drawn)):
            raise InputError(
                f"the distribution of {declared.name} is so wide that it has no finite values; lower sigma"
            )
        return drawn
    if isinstance(value, MapFile):
        values = _read_map(declared, value.path, shapes)
        return values.ravel() if declared.per_pixel else values
    if declared.per and np.ndim(value):
        values = np.asarray(value, np.float64)
        if not _fits(values.shape, shapes):
            wanted = f"it needs one number for each {declared.per}: {_words(shapes)}"
            *_, owner, name = key.split("/")
            raise InputError(f"the effect {owner}: {name} is an array of shape {values.shape}; {wanted}")
        return values.ravel() if declared.per_pixel else value
    return value


def _words(shapes: tuple[tuple[int, ...], ...]) -> str:
    return " or ".join(str(shape).replace("-1", "n") for shape in shapes)


def _read_map(declared: Parameter, path: Path, shapes: tuple[tuple[int, ...], ...]) -> np.ndarray:
    try:
        with disk.opened(path):  # a regular file, and no wait for it
            values = np.load(path, mmap_mode="r", allow_pickle=False)  # no memory before its shape is known to be right
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {declared.name} takes its map from there") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or 'it is damaged'})") from None
    except Exception:  # the header is a Python literal, and its reader raises nearly anything
        raise InputError(f"{path}: is not a .npy file of plain numbers; write the map with numpy.save") from None
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu" or not _fits(values.shape, shapes):
        what = f"{values.dtype} of shape {values.shape}" if isinstance(values, np.ndarray) else "an archive"
        wanted = _words(shapes)
        raise InputError(f"{path}: is {what}, but {declared.name} needs one number for each {declared.per}: {wanted}")
    if values.size > _LARGEST_MAP:
        raise InputError(f"{path}: has {values.size:,} entries; a map may have {_LARGEST_MAP:,}: take fewer")
    values = np.array(values, np.float64)
    flat = values.ravel()
    for index in np.flatnonzero(~np.isfinite(flat))[:1]:
        raise InputError(
            f"{path}: entry {index} of the map is {flat[index]}; every {declared.per} needs a finite number"
        )
    for index in (int(flat.argmin()), int(flat.argmax())):
        try:
            declared.check(float(flat[index]))
        except ValueError as error:
            raise InputError(f"{path}: entry {index} of the map: {error}") from None
    return values


def _fits(shape: tuple[int, ...], shapes: tuple[tuple[int, ...], ...]) -> bool:
    """Is it one of these? -1 stands for any size but 0."""
    return any(
        len(shape) == len(one)
        and all(size == wanted or (wanted == -1 and size > 0) for size, wanted in zip(shape, one, strict=True))
        for one in shapes
    )


# --- plug-ins -----------------------------------------------------------------------------------------------------


_registries: list[Registry] = []


@dataclass
class Registry:
    """The classes of one kind, by name. verb: the command that lists them; from_files: --plugin loads more."""

    kind: str
    classes: dict[str, type[Plugin]] = field(default_factory=dict)
    verb: str = ""
    from_files: bool = True

    def __post_init__(self) -> None:
        _registries.append(self)

    def __iter__(self) -> Iterator[str]:
        discover()
        return iter(sorted(self.classes))

    def find(self, name: str) -> type[Any]:
        """Raises KeyError with a sentence where there is none of that name."""
        discover()
        if name not in self.classes:
            near = did_you_mean(name, self.classes)
            own = "; --plugin FILE.py loads one of your own" if self.from_files and not near else ""
            raise UnknownName(
                f"{name} is not {'an' if self.kind[0] in 'aeiou' else 'a'} {self.kind}."
                f"{near} (spadmnist {self.verb or self.kind + 's'} lists all{own})"
            )
        return self.classes[name]

    def add(self, cls: type[Plugin]) -> None:
        known = self.classes.get(cls.name)
        if known is not None and source_file(known) != source_file(cls):
            raise EffectError(
                f"{source_file(cls)}: the {self.kind} {cls.name} is already there, in {source_file(known)}; "
                "give the class another name"
            )
        self.classes[cls.name] = cls


class Plugin:
    """Base of everything that a user can add in one file."""

    registry: ClassVar[Registry]
    name: ClassVar[str]
    parameters: ClassVar[dict[str, Parameter]] = {}

    def __init_subclass__(cls, abstract: bool = False, **keywords: Any):
        super().__init_subclass__(**keywords)
        check_names(cls)
        declared = dict(cls.parameters)
        for key, value in list(vars(cls).items()):
            if isinstance(value, Parameter):
                declared[key] = Parameter(**{**value.__dict__, "name": key})
                setattr(cls, key, value.default)
        for key, p in declared.items():
            if p.needs and p.needs not in declared and not abstract:
                near = did_you_mean(p.needs, declared) or f" They are {', '.join(declared)}."
                raise TypeError(f"{cls.__name__}: {key} needs {p.needs!r}, which is none of its parameters.{near}")
        kinds = {key: p.kind or _kind_of(p, declared.values()) for key, p in declared.items()}
        cls.parameters = {key: replace(p, kind=kinds[key]) for key, p in declared.items()}
        if not abstract:
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()
            cls.registry.add(cls)

    def __init__(self, **values: Any):
        for key, value in values.items():
            if key not in self.parameters:
                hint = did_you_mean(key, self.parameters) or f" It has {', '.join(self.parameters) or 'none'}."
                raise TypeError(f"{self.name} has no parameter {key}.{hint}")
            setattr(self, key, value)

    @classmethod
    def summary(cls) -> str:
        """The first line of the docstring."""
        return (inspect.cleandoc(cls.__doc__) if cls.__doc__ else "(no description)").split("\n")[0]


def check_names(cls: type[Plugin]) -> None:
    """Raise TypeError where a parameter in the body of a class takes the name of something else of its bases."""
    for key, value in vars(cls).items():
        if not isinstance(value, Parameter):
            continue
        for base in cls.__mro__[1:]:
            # what a base merely announces is a parameter of each of its subclasses
            taken = key in vars(base) or "ClassVar" in str(inspect.get_annotations(base).get(key, ""))
            if taken and key not in getattr(base, "parameters", {}):
                raise TypeError(
                    f"{cls.__name__}: a parameter cannot be called {key}, which is something else of every "
                    f"{cls.registry.kind}; take another name"
                )


def check_values(plugin: Plugin) -> None:
    """Raise InputError where a parameter has a value that is not possible: numbers, arrays and tables of them."""
    for name, declared in plugin.parameters.items():
        value, place = getattr(plugin, name), f"{plugin.name}.{name}"
        if declared.required and value is None:
            raise InputError(f"{place} is missing; it is {declared.about}")
        if value is None or isinstance(value, MapFile | Distribution):
            continue
        if declared.choices:
            if value not in declared.choices:
                raise InputError(f"{place} is {value!r}; it is {declared.allowed()}")
            continue
        if declared.unit == "bool":
            if not isinstance(value, bool | np.bool_):
                raise InputError(f"{place} is {value!r}; it is True or False")
            continue
        if isinstance(value, Mapping):
            how = "a map of the pixels is an array"
            if declared.by_wavelength:
                how = "a table over the wavelength is spadmnist.effects.ByWavelength((500e-9, 700e-9), (0.4, 0.2))"
            raise InputError(f"{place} is {value!r:.80}; in Python it is a number, and {how}")
        if np.ma.is_masked(value):
            raise InputError(f"{place} has masked pixels, which have no value; give each one (array.filled)")
        numbers = np.asarray(value.values if isinstance(value, ByWavelength) else value)
        if numbers.dtype.kind not in "fiu":
            raise InputError(f"{place} is {value!r}; it is a number in {declared.unit or 'units of 1'}")
        if numbers.ndim and not declared.per and not isinstance(value, ByWavelength):
            raise InputError(f"{place} is one number for all pixels, not an array")
        for end in (numbers.min(), numbers.max()) if numbers.size else ():
            try:
                declared.check(float(end))
            except ValueError as error:
                raise InputError(f"{plugin.name}: {error}") from None


def described(declared: Parameter, value: Any) -> str:
    """A value with its unit in a few words: a number, a table over the wavelength, a map by its median and range."""

    def number(x: float) -> str:
        return units.show(float(x), declared.unit) if declared.unit not in ("", "bool") else f"{float(x):.4g}"

    if value is None:
        return "-"
    if isinstance(value, Mapping | complex):  # no value, as `check_values` says
        return f"{value!r:.80}"
    if isinstance(value, ByWavelength):
        pairs = zip(value.wavelengths, value.values, strict=True)
        return ", ".join(f"{units.show(at, 'm')}: {number(x)}" for at, x in pairs)
    if isinstance(value, MapFile):
        return f"map {value.path.name}"
    if isinstance(value, Distribution):
        if value.parts:
            return "mixture of " + " and ".join(f"{share:.3g} {described(declared, one)}" for share, one in value.parts)
        names = _DISTRIBUTIONS[value.kind]
        first, second = value.numbers
        spread = f"{second:.4g}" if value.kind == "lognormal" else number(second)
        return f"{value.kind}, {names[0]} {number(first)}, {names[1]} {spread}"
    if isinstance(value, bool | np.bool_ | str):
        return str(value).lower() if not isinstance(value, str) else value
    if np.ndim(value):
        flat = np.asarray(value, float)
        per = declared.per or "pixel"
        return f"per {per}: median {number(np.median(flat))}, {number(flat.min())} to {number(flat.max())}"
    return number(value)


def source_file(cls: type) -> str:
    """The file in which a class stands."""
    module = sys.modules.get(cls.__module__)
    return getattr(module, "__file__", None) or "<interactive>"


IMPORTED = time.time()  # s since the epoch: before any class of the user's could be made
_discovered = False
_MODULE = "spadmnist_plugin_"  # how the modules of such files are named
_loaded: dict[Path, str] = {}
_imports: dict[Path, tuple[imported.Own, ...]] = {}  # of each of these files
_packages: dict[str, tuple[str, str] | None] = {}  # of each plug-in package: its distribution and that one's version


def discover() -> None:
    """Import every module of the package's plug-in folders, and what is installed under the entry point."""
    global _discovered
    if _discovered:
        return
    for place in PLACES:
        import_folder(place)
    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS):
        try:
            entry.load()
        except Exception as error:
            raise EffectError(
                f"the installed plug-in {entry.name} ({entry.value}) cannot be loaded: "
                f"{type(error).__name__}: {error}; mend it or uninstall it"
            ) from error
        dist = entry.dist
        _packages[entry.module.partition(".")[0]] = None if dist is None else (dist.name, dist.version)
    _discovered = True


def import_folder(place: str) -> None:
    """Import a package and every module in it, or a module: what is defined there is known from then on."""
    package = importlib.import_module(place)
    for module in pkgutil.iter_modules(getattr(package, "__path__", [])):
        importlib.import_module(f"{place}.{module.name}")


class _Read(importlib.abc.SourceLoader):
    """Runs the very text whose digest a manifest holds, and leaves no compiled file beside the user's own."""

    def __init__(self, file: str, text: str):
        self.file, self.text = file, text

    def get_filename(self, fullname: str) -> str:
        return self.file

    def get_data(self, path: str | bytes) -> bytes:
        if path != self.file:
            raise FileNotFoundError(path)
        return self.text.encode()


def load_files(paths: Sequence[str | Path] | None, name: str) -> None:
    """Run a user's plug-in files, each once; None: none. name: of the argument, for the message.

    Raises InputError for what is no list of files, EffectError as `load_file`.
    """
    if isinstance(paths, str | os.PathLike):
        raise InputError(f"{name} is {str(paths)!r}; it is a list of files: {name}=[{str(paths)!r}]")
    if paths is not None and not isinstance(paths, Iterable):
        raise InputError(f"{name} is {paths!r:.80}; it is a list of files: {name}=['my_effect.py']")
    for path in paths or ():
        if not isinstance(path, str | os.PathLike):
            raise InputError(f"{name} holds {path!r:.80}; it is a list of files: {name}=['my_effect.py']")
        load_file(path)


def load_file(path: str | Path) -> None:
    """Run a user's plug-in file (`--plugin FILE.py`), once. Raises EffectError with file and line."""
    discover()
    file = Path(path).resolve()
    if file in _loaded:
        return
    try:
        with io.TextIOWrapper(disk.opened(path), encoding="utf-8") as opened:
            text = opened.read()
    except InputError as error:
        raise EffectError(str(error)) from None
    except (OSError, UnicodeDecodeError) as error:
        if not file.exists():
            raise EffectError(
                f"{path}: no such file; name the plug-in's, or begin one: spadmnist effects --new NAME"
            ) from None
        why = error.strerror if isinstance(error, OSError) else "it is no text in UTF-8"
        raise EffectError(f"{path}: the plug-in cannot be read ({why}); name a Python file") from None
    digest = hashlib.sha256(text.encode()).hexdigest()
    name = f"{_MODULE}{file.stem}_{digest[:12]}"
    if file.suffix != ".py":
        raise EffectError(f"{path}: a plug-in is a Python file; its name ends in .py")
    loader = _Read(str(file), text)
    spec = importlib.util.spec_from_file_location(name, file, loader=loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    before = set(sys.modules)
    try:
        loader.exec_module(module)
    except BaseException as error:
        del sys.modules[name]
        for registry in _registries:
            for known in [k for k, cls in registry.classes.items() if cls.__module__ == name]:
                del registry.classes[known]
        if isinstance(error, (EffectError, KeyboardInterrupt)):
            raise
        raise EffectError(f"{_place(error, file)}: the plug-in cannot be loaded: {_what(error)}") from error
    kinds = {cls for registry in _registries for cls in registry.classes.values()}
    if not any(isinstance(one, type) and one in kinds for one in vars(module).values()):
        del sys.modules[name]
        raise EffectError(
            f"{path}: defines no effect, statistic or method, and nothing would come of it; `spadmnist effects --new "
            "NAME` begins an effect"
        )
    ran = [name for name in sys.modules if name not in before and not is_module_of_file(name)]
    _imports[file] = imported.own_modules([*ran, *imported.named(text)])
    _loaded[file] = text


def is_from_file(cls: type) -> bool:
    """Does a class come from a file that `load_file` has loaded?"""
    return is_module_of_file(cls.__module__)


def is_module_of_file(name: str) -> bool:
    """Is it the name of a module that `load_file` has made?"""
    return name.startswith(_MODULE)


def is_built_in(cls: type) -> bool:
    """Does a class come with the package?"""
    return cls.__module__.startswith(f"{__package__}.")


def is_own(cls: type) -> bool:
    """Is a class the user's, and in no file that `load_file` has loaded: in a notebook, a program, another package?"""
    return not is_built_in(cls) and not is_from_file(cls)


def loaded_files() -> dict[Path, str]:
    """The plug-in files loaded by `load_file`, with their texts."""
    return dict(_loaded)


def imports_of(file: Path) -> tuple[imported.Own, ...]:
    """The user's own modules that a plug-in file loaded by `load_file` imports, as they were then."""
    return _imports[file]


def distribution(cls: type) -> tuple[str, str] | None:
    """(distribution, its version) that an installed plug-in came with; None of another one, or where none is known."""
    return _packages.get(cls.__module__.partition(".")[0])


def is_installed(cls: type) -> bool:
    """Does a class come from a package that was found by its entry point?"""
    return cls.__module__.partition(".")[0] in _packages


@dataclass(frozen=True)
class Carried:
    """A plug-in file on its way to a worker, which may not have it; imports: the (file, sha256) of `imports_of`."""

    path: str
    text: str
    imports: tuple[tuple[str, str], ...] = ()


def carried() -> tuple[Carried, ...]:
    """The plug-in files loaded by `load_file`, for workers."""
    return tuple(
        Carried(str(path), text, tuple((one.file, one.sha256) for one in _imports[path]))
        for path, text in _loaded.items()
    )


_arriving = threading.Lock()  # two threads of one worker may be given the same


def load_carried(files: Iterable[Carried]) -> None:
    """Run plug-in files that another process has loaded, each once; what is not here is written into a folder.

    Raises EffectError as `load_file`, where a file needs another one that is not here, or is not the same here.
    """
    with _arriving:
        for file in files:
            if known := next((path for path, text in _loaded.items() if text == file.text), None):
                _check_imports(file, known)
                continue
            try:
                here = Path(file.path).read_text(encoding="utf-8") == file.text
            except (OSError, UnicodeDecodeError):
                here = False
            path = Path(file.path)
            if not here:
                path = leftovers.temporary("plugin") / path.name
                path.write_text(file.text, encoding="utf-8")
            load_file(path)
            _check_imports(file, path.resolve())


def _check_imports(file: Carried, here: Path) -> None:
    """Raise EffectError where a plug-in file imports others here than where it comes from."""
    found = {(one.file, one.sha256) for one in _imports[here]}
    if other := sorted(name for name, _ in found ^ set(file.imports)):
        raise EffectError(
            f"{file.path}: the plug-in imports {other[0]}, which is not the same in a worker on {socket.gethostname()} "
            "as where the run began; leave it as it is while a run goes on, and have the same there"
        )


def blame(cls: type[Plugin], error: BaseException) -> EffectError:
    """An error that a plug-in's own code raised, as a sentence with the plug-in, its file and the line.

    By a ValueError an effect of the package refuses the user's values: then it is its sentence, without a file.
    """
    which = f"the {cls.registry.kind} {cls.name}"
    if is_built_in(cls) and isinstance(error, ValueError) and str(error):
        blamed = EffectError(f"{which}: {error}")
    else:
        blamed = EffectError(f"{_place(error, Path(source_file(cls)))}: {which} failed: {_what(error)}")
    blamed.plugin = cls.name
    return blamed


@contextlib.contextmanager
def blaming(cls: type[Plugin]) -> Iterator[None]:
    """A context in which code of a user's plug-in runs.

    Raises:
        EffectError: where it fails; it names the plug-in, its file and the line.
    """
    try:
        yield
    except Exception as error:
        if is_built_in(cls):
            raise
        raise blame(cls, error) from error


def _what(error: BaseException) -> str:
    said = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    if _CHANGED.search(said):
        said += "; what it is given is not its own to change: write `x = x + more`, not `x += more`, or copy it"
    return said


# what numpy, and `events.SealedEvents`, say where somebody changes what can only be read
_CHANGED = re.compile("read-only|of these events cannot be set")


def _place(error: BaseException, file: Path) -> str:
    if isinstance(error, SyntaxError) and error.lineno:
        return f"{file}:{error.lineno}"
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if Path(f.filename) == file]
    return f"{file}:{lines[-1]}" if lines else str(file)
