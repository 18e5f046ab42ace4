"""What a sensor might lack: every registered effect, every listed number at another value, every map.

A candidate is a `Change` with its dials: the numbers that settle it. Nothing here names an effect: what can be turned,
and how far, is read from the parameters that the effects declare (`off`, `search`, `per`), those of users' files too.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..effects import Conditions, Effect
from ..errors import UNABLE, SpadError, why
from ..plugins import ByWavelength, Parameter
from ..recording import Capture
from ..sensor import Sensor

Key = tuple[str, str]  # effect, parameter
Values = Mapping[Key, Any]

_SHAPES = 4  # values of a shape that are tried between the ends of where it is looked for
_MOST = 6  # templates of one candidate
_TURNED = 1.02  # times a number, to see what follows it
_BEYOND = 0.3  # of a logarithm, or of where a number is looked for: as far as what is seen within holds
_LEAST = 1e-6  # of where a number is looked for, that it may lack


@dataclass(frozen=True)
class Dial:
    """A number that may be turned: where it is looked for, and whether on a scale of ratios.

    off: where the effect vanishes, None for a shape; if that is the upper end, the scale is that of what lacks.
    whole: there are whole numbers of it only. bounds: beyond which there are none, where it has any.
    """

    effect: str
    parameter: str
    unit: str
    low: float
    high: float
    off: float | None
    whole: bool = False
    bounds: tuple[float | None, float | None] = (None, None)

    @property
    def key(self) -> Key:
        return self.effect, self.parameter

    @property
    def log(self) -> bool:
        return self.low > 0

    @property
    def lacks(self) -> bool:
        """Is what lacks at the upper end what counts?"""
        return self.log and self.off == self.high

    @property
    def ends(self) -> tuple[float, float]:
        """Where its coordinate lies."""
        low, high = sorted((self.coordinate(self.low), self.coordinate(self.high)))
        return low, high

    def coordinate(self, value: float) -> float:
        if self.lacks:
            return math.log(max(self.high - value, _LEAST * (self.high - self.low)))
        return math.log(max(value, 1e-300)) if self.log else value

    def value(self, coordinate: float) -> float:
        return min(max(self._anywhere(coordinate), self.low), self.high)

    def interval(self, low: float, high: float) -> tuple[float, float]:
        """(low, high) of the values between two coordinates.

        Where a number is looked for is no bound of what it may be: the interval ends beyond it if it does so near by.
        """
        low_bound, high_bound = self.bounds
        least = -math.inf if low_bound is None else low_bound
        most = math.inf if high_bound is None else high_bound
        beyond = _BEYOND if self.log else _BEYOND * (self.high - self.low)
        ends = []
        for u in (low, high):
            near = min(max(u, self.ends[0] - beyond), self.ends[1] + beyond)
            ends.append(min(max(self._anywhere(near), least), most))
        return min(ends), max(ends)

    def _anywhere(self, coordinate: float) -> float:
        value = math.exp(min(coordinate, 700.0)) if self.log else coordinate
        value = self.high - value if self.lacks else value
        return float(round(value)) if self.whole else value

    def scaled(self, value: float, factor: float) -> float:
        """The value whose distance from `off` is so many times that of `value`."""
        off = self.off or 0.0
        found = off + (value - off) * factor
        return min(max(float(round(found)) if self.whole else found, self.low), self.high)


@dataclass(frozen=True)
class Change:
    """A way to alter a sensor. kind: "add", "set" or "map"; parameter: of "set" and "map".

    strengths: the dials that make the effect vanish; shapes: those that say what it looks like; phases: parameters
    (in rad) that begin anew in every capture. fixed: what else it sets.
    """

    kind: str
    effect: str
    parameter: str | None
    strengths: tuple[Dial, ...]
    shapes: tuple[Dial, ...] = ()
    phases: tuple[Key, ...] = ()
    fixed: tuple[tuple[Key, Any], ...] = ()
    per: str = ""
    carrier: Key | None = None  # of a map: the parameter that holds it
    relative: bool = False  # the map multiplies
    blinds: bool = False  # the map is how long each pixel is blind: its shortest interval tells that, not its counts

    @property
    def dials(self) -> tuple[Dial, ...]:
        return self.strengths + self.shapes

    @property
    def name(self) -> str:
        return f"{self.kind} {self.effect}" + (f".{self.parameter}" if self.parameter else "")


def with_values(sensor: Sensor, values: Values) -> Sensor:
    """The sensor with some parameters set, effects that it lacks among them. Raises SpadError where there is none."""
    try:
        return _with_values(sensor, values)
    except SpadError:
        raise
    except UNABLE as error:
        raise SpadError(why(error)) from error


def _with_values(sensor: Sensor, values: Values) -> Sensor:
    given: dict[str, dict[str, Any]] = {}
    for (name, parameter), value in values.items():
        given.setdefault(name, {})[parameter] = value
    effects = []
    for effect in sensor.effects:
        own = {name: getattr(effect, name) for name in effect.parameters}
        effects.append(type(effect)(**{**own, **given.pop(effect.name, {})}))
    for name, own in given.items():
        effects.append(Effect.registry.find(name)(**own))
    return sensor.changed(effects=effects)


def on_chip(sensor: Sensor, seed: int) -> Sensor:
    """The sensor as another chip of its kind: what chance decides for each pixel falls otherwise."""
    return sensor.changed(chip_seed=seed)


def chancy(sensor: Sensor) -> bool:
    """Does chance decide what its pixels are like?"""
    second = Conditions(1.0, 1, 1.0, 1.0, None)
    light = np.ones((1, sensor.layout.pixels))
    one, other = (on_chip(sensor, seed).expected(light, second) for seed in (1, 2))
    return not all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def _dial(effect: str, declared: Parameter, off: float | None) -> Dial:
    assert declared.search is not None
    low, high = map(float, declared.search)
    ends = (low, high, float(declared.default))
    whole = not declared.unit and low >= 1 and declared.bounds[0] is not None and all(x == int(x) for x in ends)
    return Dial(effect, declared.name, declared.unit, low, high, off, whole, declared.bounds)


def _numeric(declared: Parameter) -> bool:
    return declared.unit != "bool" and not declared.choices and declared.search is not None


def changes(sensor: Sensor, captures: Iterable[Capture] = ()) -> list[Change]:
    """Every candidate, in the order of names. captures: of which one must be of a scene for what is `of_scene`."""
    scenes = any(capture.light.scene is not None for capture in captures)
    out: list[Change] = []
    listed = {effect.name: effect for effect in sensor.effects}
    for name in Effect.registry:
        kind = Effect.registry.find(name)
        if name not in listed and (scenes or not kind.of_scene):
            out += _additions(name, kind.parameters)
    for name in sorted(listed):
        if listed[name].of_scene and not scenes:
            continue
        out += _settings(listed[name])
        out += _maps(sensor, listed[name])
    return out


def _additions(name: str, parameters: Mapping[str, Parameter]) -> Iterator[Change]:
    wholes = {k: p for k, p in parameters.items() if _numeric(p) and p.per in ("", "pixel")}
    phases = tuple((name, k) for k, p in wholes.items() if p.phase)
    off = {k: p for k, p in wholes.items() if p.off is not None and (name, k) not in phases}
    idle = {k for k, p in off.items() if p.default == p.off}
    shapes = tuple(
        _dial(name, p, None)
        for k, p in wholes.items()
        if k not in off and (name, k) not in phases and p.needs not in idle
    )
    lines = [p for p in parameters.values() if p.per in ("row", "column", "code") and p.off is not None]
    if lines:
        one = lines[0]
        yield Change("add", name, None, (), per=one.per, carrier=(name, one.name), relative=one.off == 1.0)
    if not off:
        return
    signed = {k: p for k, p in off.items() if p.search is not None and p.search[0] < 0}
    kept = signed or dict(itertools.islice(off.items(), 1))
    others = {k: p for k, p in off.items() if k not in kept}
    if signed:  # directions side by side: they may all be there
        strengths = tuple(_dial(name, p, float(p.off or 0)) for p in off.values())
        fixed = tuple(((name, k), float(p.off or 0)) for k, p in off.items())
        yield Change("add", name, None, strengths, shapes, phases, fixed)
        return
    strengths = tuple(_dial(name, p, float(p.off or 0)) for p in kept.values())
    # what is off by itself already is no part of the question, unless the effect vanishes with it
    for p in others.values():
        if p.default == p.off:
            continue
        shapes += (_dial(name, p, None),)
    yield Change("add", name, None, strengths, shapes, phases)


def _settings(effect: Effect) -> Iterator[Change]:
    for name, declared in effect.parameters.items():
        value = getattr(effect, name)
        if declared.unit == "bool" and declared.off is not None:
            yield Change("set", effect.name, name, (), fixed=(((effect.name, name), not value),))
        if not _numeric(declared) or declared.per not in ("", "pixel") or not isinstance(value, (int, float)):
            continue
        if declared.phase or (effect.stage in ("light", "detection") and not effect.of_scene):
            continue  # a common factor on the light is no matter of the sensor
        if declared.unit == "Hz" and any(p.phase for p in effect.parameters.values()):
            continue  # a line that stands elsewhere is another one
        low, high = declared.search  # type: ignore[misc]
        low, high = min(low, value) if value > 0 else low, max(high, value)
        dial = replace(_dial(effect.name, declared, float(value)), low=float(low), high=float(high))
        yield Change("set", effect.name, name, (dial,))


def _maps(sensor: Sensor, effect: Effect) -> Iterator[Change]:
    whole = {k: p for k, p in effect.parameters.items() if p.per_pixel}
    for name, declared in whole.items():
        value = getattr(effect, name)
        multipliers = [k for k, p in whole.items() if p.off == 1.0 and k != name and not p.by_wavelength]
        if declared.off == 1.0 and not declared.by_wavelength and len(whole) > 1:
            continue  # it carries the map of another one
        carrier = multipliers[0] if declared.by_wavelength and multipliers else name
        at = getattr(effect, carrier)
        if isinstance(at, (ByWavelength, bool, np.ndarray)) or isinstance(value, np.ndarray):
            continue
        key = effect.name, carrier
        blinds = declared.unit == "s" and _blinds(sensor, key, value)
        yield Change("per_pixel", effect.name, name, (), per="pixel", carrier=key, relative=True, blinds=blinds)


def _blinds(sensor: Sensor, key: Key, value: float) -> bool:
    """Is a time the sensor's dead time itself, which follows it?"""
    other = value * _TURNED
    follows = sensor.dead_times, with_values(sensor, {key: other}).dead_times
    return value > 0 and all(np.allclose(a, b, rtol=1e-9) for a, b in zip(follows, (value, other), strict=True))


def templates(change: Change) -> list[dict[Key, float]]:
    """The values at which a candidate is tried first: each strength by itself, shapes on a coarse grid."""
    grids = []
    for dial in change.shapes:
        if dial.log:
            count = min(_SHAPES, max(2, round(math.log10(dial.high / dial.low) * 1.5)))
            ends = np.linspace(math.log(dial.low), math.log(dial.high), 2 * count + 1)[1::2]
            grids.append([dial.value(x) for x in ends])
        else:
            grids.append([dial.low + (dial.high - dial.low) * x for x in (0.25, 0.75)])
    shapes: list[tuple[float, ...]] = list(itertools.product(*grids))
    if len(shapes) > _MOST:  # one after the other, the others in their middle
        middle = [g[len(g) // 2] for g in grids]
        shapes = [(*middle[:i], x, *middle[i + 1 :]) for i, g in enumerate(grids) for x in g]
        shapes = list(dict.fromkeys(shapes))[:_MOST]
    out = []
    for shape in shapes:
        about = {d.key: x for d, x in zip(change.shapes, shape, strict=True)}
        for dial in change.strengths:
            out += [{**dict(change.fixed), **about, dial.key: x} for x in first_strengths(dial)]
    return out or [dict(change.fixed)]


def first_strengths(dial: Dial) -> list[float]:
    """Strengths that should show and not saturate: one, or several where little is seen by other signs than much."""
    off, whole = dial.off or 0.0, dial.high - dial.low
    if dial.lacks:
        return [off - x * whole for x in (0.2, 2e-3, 2e-4)]
    if off == dial.high:
        return [off - 0.1 * whole]
    if dial.low < 0:
        return [off + 0.1 * whole]
    if dial.low <= off <= dial.high and off > 0:
        if dial.whole:  # each is another one, and no slope leads there
            near = (dial.value(dial.coordinate(x)) for x in (0.5 * off, max(1.5 * off, off + 1)))
            return [x for x in near if x != off]
        # an edge that has moved is not found by a longer move
        edge = dial.unit == "s" and getattr(Effect.registry.find(dial.effect), "stage", "") == "dead_time"
        moves = (0.1, 0.01, 0.003, -0.003, -0.01, -0.1) if edge else (0.1,)
        return [min(max(off * (1 + x), dial.low), dial.high) for x in moves]
    usual = math.sqrt(dial.low * dial.high) if dial.low > 0 else dial.low + 0.2 * whole
    # a time, too, is an edge, and a short one looks otherwise than part of a long one
    return [usual, math.sqrt(dial.low * usual)] if dial.unit == "s" and dial.low > 0 and dial.off == 0 else [usual]
