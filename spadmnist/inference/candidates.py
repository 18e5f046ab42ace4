"""Candidates: every one-step change of a model.

A candidate adds an effect that the sensor lacks, sets a listed parameter to another value, or makes it a map. No
effect is named here. The declarations of the effects (`off`, `search`, `per`) say which parameters are free, and in
which range; those of plug-ins do as well.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..effects import Conditions, Effect
from ..errors import UNABLE, SpadError, why
from ..plugins import ByWavelength, Parameter
from ..recording import Capture
from ..sensor import Sensor
from .coordinates import Coordinate, Key, Values, coordinate_of, is_edge

# the largest number of values of a shape within its search range: how near a template is to the true shape, against the
# time of a scan; a rule of thumb
_SHAPES = 4
_MULTIPLES = (2, 5, 0.5)  # of what is listed: the first ones that are tried of a multiple; the fit finds the others
_MOST = 6  # the largest number of templates per strength of one candidate: the time of a scan; a rule of thumb
# factor by which the search range reaches beyond a listed value at its end or outside, so that this may rise and fall;
# a rule of thumb
_BEYOND = 3.0
# factor by which the search range of a listed strength reaches further down than that of an added one: the data may
# show nothing of it. Of a dark rate the end is a count in 17 pixel-minutes; a rule of thumb
_FEWER = 1e3
_TURNED = 1.02  # factor on a parameter, to test whether the dead times follow it; any that is not rounded off does


@dataclass(frozen=True)
class Candidate:
    """A one-step change of a sensor.

    Attributes:
        kind: "add", "set" or "per_pixel".
        effect, parameter: what is changed; the parameter is None where a whole effect is added.
        strengths: the coordinates at whose `off` the effect vanishes.
        shapes: the other free coordinates of the effect.
        phases: parameters in rad whose value is another one in every capture.
        fixed: the values of other parameters that it sets.
        per: what the values of a map belong to: "pixel", "row", "column" or "code".
    """

    kind: str
    effect: str
    parameter: str | None
    strengths: tuple[Coordinate, ...]
    shapes: tuple[Coordinate, ...] = ()
    phases: tuple[Key, ...] = ()
    fixed: tuple[tuple[Key, Any], ...] = ()
    per: str = ""
    carrier: Key | None = None  # of a map: the parameter that holds it
    relative: bool = False  # the map multiplies
    blinds: bool = False  # a map of dead times: the shortest intervals inform it, the counts do not
    informed_by: str = ""  # the statistic that informs a map instead of the counts

    @property
    def coordinates(self) -> tuple[Coordinate, ...]:
        """The free coordinates: strengths, then shapes."""
        return self.strengths + self.shapes

    @property
    def name(self) -> str:
        """Kind, effect and parameter as text, such as "set dead_time.duration"; unique among the candidates."""
        return f"{self.kind} {self.effect}" + (f".{self.parameter}" if self.parameter else "")


def with_values(sensor: Sensor, values: Values) -> Sensor:
    """The sensor with some parameters set; an effect that it lacks is added.

    Args:
        values: parameters by (effect, parameter), SI units.
    Raises:
        SpadError: where no such sensor exists.
    """
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
    """The sensor as another chip of its kind: the random properties of the pixels are drawn anew with `seed`."""
    return sensor.changed(chip_seed=seed)


def has_random_pixels(sensor: Sensor) -> bool:
    """Whether some properties of the pixels are random, so that another chip has other expected counts."""
    second = Conditions(1.0, 1, 1.0, 1.0, None)
    light = np.ones((1, sensor.layout.pixels))
    one, other = (on_chip(sensor, seed).expected(light, second) for seed in (1, 2))
    return not all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def _numeric(declared: Parameter) -> bool:
    return declared.kind != "switch" and not declared.choices and declared.search is not None


def candidates(sensor: Sensor, captures: Iterable[Capture] = (), fitted: Collection[Key] = ()) -> list[Candidate]:
    """Every candidate of a sensor, in the order of the effects' names.

    Args:
        sensor: the model to change.
        captures: an effect that is `of_scene` is a candidate only where one of these is of a scene.
        fitted: the parameters whose values are maps that these captures gave. Another map, of a file or of another
            chip, may be wrong here.
    """
    scenes = any(capture.light.scene is not None for capture in captures)
    out: list[Candidate] = []
    listed = {effect.name: effect for effect in sensor.effects}
    for name in Effect.registry:
        kind = Effect.registry.find(name)
        if name not in listed and (scenes or not kind.of_scene):
            out += _additions(name, kind.parameters)
    for name in sorted(listed):
        if listed[name].of_scene and not scenes:
            continue
        out += _settings(listed[name])
        out += _maps(sensor, listed[name], fitted)
    return out


def _additions(name: str, parameters: Mapping[str, Parameter]) -> Iterator[Candidate]:
    wholes = {k: p for k, p in parameters.items() if _numeric(p) and p.per in ("", "pixel")}
    phases = tuple((name, k) for k, p in parameters.items() if p.kind == "phase")  # all round: none needs a range
    off = {k: p for k, p in wholes.items() if p.off is not None and (name, k) not in phases}
    idle = {k for k, p in off.items() if p.default == p.off}
    shapes = tuple(
        coordinate_of(name, p, None)
        for k, p in wholes.items()
        if k not in off and (name, k) not in phases and p.needs not in idle
    )
    lines = [p for p in parameters.values() if p.per in ("row", "column", "code") and p.off is not None]
    if lines:
        one = lines[0]
        yield Candidate(
            kind="add",
            effect=name,
            parameter=None,
            strengths=(),
            per=one.per,
            carrier=(name, one.name),
            relative=one.off == 1.0,
        )
    if not off:
        return
    signed = {k: p for k, p in off.items() if p.search is not None and p.search[0] < 0}
    kept = signed or dict(itertools.islice(off.items(), 1))
    others = {k: p for k, p in off.items() if k not in kept}
    if signed:  # components of one vector: all of them may be there
        strengths = tuple(coordinate_of(name, p, float(p.off or 0)) for p in off.values())
        fixed = tuple(((name, k), float(p.off or 0)) for k, p in off.items())
        yield Candidate(
            kind="add", effect=name, parameter=None, strengths=strengths, shapes=shapes, phases=phases, fixed=fixed
        )
        return
    strengths = tuple(coordinate_of(name, p, float(p.off or 0)) for p in kept.values())
    # a parameter that is off by default is no shape
    for p in others.values():
        if p.default == p.off:
            continue
        shapes += (coordinate_of(name, p, None),)
    yield Candidate(kind="add", effect=name, parameter=None, strengths=strengths, shapes=shapes, phases=phases)


def _settings(effect: Effect) -> Iterator[Candidate]:
    for name, declared in effect.parameters.items():
        value = getattr(effect, name)
        if declared.kind == "switch" and declared.off is not None:
            yield Candidate(
                kind="set", effect=effect.name, parameter=name, strengths=(), fixed=(((effect.name, name), not value),)
            )
        if not _numeric(declared) or declared.per not in ("", "pixel") or not isinstance(value, (int, float)):
            continue
        if declared.kind == "phase" or (effect.on_light and not effect.of_scene):
            continue  # a common factor on the light belongs to the light level, not to the sensor
        if declared.kind == "frequency":
            continue  # a periodic effect at another frequency is another candidate
        low, high = _about(value, declared)
        coordinate = replace(coordinate_of(effect.name, declared, float(value)), low=float(low), high=float(high))
        # what does nothing without this parameter has had no value so far
        idle = [p for p in effect.parameters.values() if p.needs == name and _numeric(p) and p.per in ("", "pixel")]
        shapes = tuple(coordinate_of(effect.name, p, None) for p in idle) if value == declared.off else ()
        yield Candidate(kind="set", effect=effect.name, parameter=name, strengths=(coordinate,), shapes=shapes)


def _about(value: float, declared: Parameter) -> tuple[float, float]:
    """The search range of a listed value: it may fall, and it may rise, within its bounds."""
    low, high = declared.search  # type: ignore[misc]
    least, most = declared.bounds
    if 0 < value <= low:
        low = value / _BEYOND if low > 0 else low
    if declared.kind == "smooth" and declared.off == 0 < low:
        low /= _FEWER
    if value >= high:
        high = value * _BEYOND
    low = low if least is None else max(low, min(least, value))
    return min(low, value) if value > 0 else low, high if most is None else max(min(high, most), value)


def _maps(sensor: Sensor, effect: Effect, fitted: Collection[Key]) -> Iterator[Candidate]:
    whole = {k: p for k, p in effect.parameters.items() if p.per_pixel}
    for name, declared in whole.items():
        value = getattr(effect, name)
        multipliers = [k for k, p in whole.items() if p.off == 1.0 and k != name and not p.by_wavelength]
        if declared.off == 1.0 and not declared.by_wavelength and len(whole) > 1:
            continue  # it carries the map of another parameter
        carrier = multipliers[0] if declared.by_wavelength and multipliers else name
        at = getattr(effect, carrier)
        key = effect.name, carrier
        if isinstance(at, (ByWavelength, bool)) or key in fitted:
            continue
        blinds = not declared.informed_by and declared.kind in ("time", "edge") and _blinds(sensor, key, value)
        own = declared.informed_by
        yield Candidate(
            kind="per_pixel",
            effect=effect.name,
            parameter=name,
            strengths=(),
            per="pixel",
            carrier=key,
            relative=True,
            blinds=blinds,
            informed_by=own,
        )


def maps_added(sensor: Sensor, start: Sensor) -> list[Key]:
    """The parameters of a sensor whose values are maps that `start` lacks."""
    return [
        (effect.name, name)
        for effect in sensor.effects
        for name in effect.parameters
        if np.ndim(at := getattr(effect, name)) and not np.array_equal(getattr(start.effect(effect.name), name, 0), at)
    ]


def _blinds(sensor: Sensor, key: Key, value: float | np.ndarray) -> bool:
    """Whether a parameter is the sensor's dead time itself: the dead times equal it and follow it."""
    other = value * _TURNED
    follows = sensor.dead_times, with_values(sensor, {key: other}).dead_times
    return bool(np.all(value > 0)) and all(
        np.allclose(a, b, rtol=1e-9) for a, b in zip(follows, (value, other), strict=True)
    )


def templates(candidate: Candidate) -> list[dict[Key, float]]:
    """The values at which a candidate is tried first: each strength by itself, the shapes on a coarse grid.

    Returns:
        Parameter values, SI units, one mapping for each trial.
    """
    grids = []
    for coordinate in candidate.shapes:
        if coordinate.log:
            count = min(_SHAPES, max(2, round(math.log10(coordinate.high / coordinate.low) * 1.5)))
            ends = np.linspace(math.log(coordinate.low), math.log(coordinate.high), 2 * count + 1)[1::2]
            grids.append([coordinate.value(x) for x in ends])
        else:
            grids.append([coordinate.low + (coordinate.high - coordinate.low) * x for x in (0.25, 0.75)])
    shapes: list[tuple[float, ...]] = list(itertools.product(*grids))
    if len(shapes) > _MOST:  # too many combinations: one shape varies at a time, the others at the middle of their grid
        middle = [g[len(g) // 2] for g in grids]
        shapes = [(*middle[:i], x, *middle[i + 1 :]) for i, g in enumerate(grids) for x in g]
        shapes = list(dict.fromkeys(shapes))[:_MOST]
    out = []
    for shape in shapes:
        about = {d.key: x for d, x in zip(candidate.shapes, shape, strict=True)}
        for coordinate in candidate.strengths:
            out += [{**dict(candidate.fixed), **about, coordinate.key: x} for x in first_strengths(coordinate)]
    return out or [dict(candidate.fixed)]


def first_strengths(coordinate: Coordinate) -> list[float]:
    """Strengths whose signature should be visible and not saturated, in the parameter's unit.

    There are several where a small change has another signature than a large one.
    """
    off, whole = coordinate.off or 0.0, coordinate.high - coordinate.low
    if coordinate.lacks:
        return [off - x * whole for x in (0.2, 2e-3, 2e-4)]
    if off == coordinate.high:
        return [off - 0.1 * whole]
    if coordinate.low < 0:
        return [off + 0.1 * whole]
    if coordinate.low <= off <= coordinate.high and off > 0:
        if coordinate.kind == "multiple":  # each is another model: no gradient leads to it
            return [x for x in (off * k for k in _MULTIPLES) if coordinate.low <= x <= coordinate.high]
        if coordinate.whole:
            near = (coordinate.value(coordinate.coordinate(x)) for x in (0.5 * off, max(1.5 * off, off + 1)))
            return [x for x in near if x != off]
        # a short move of an edge is not found by a longer one
        moves = (0.1, 0.01, 0.003, -0.003, -0.01, -0.1) if coordinate.kind == "edge" else (0.1,)
        return [min(max(off * (1 + x), coordinate.low), coordinate.high) for x in moves]
    typical = math.sqrt(coordinate.low * coordinate.high) if coordinate.low > 0 else coordinate.low + 0.2 * whole
    # a time is an edge, too: a short one has another signature than a part of a long one
    return (
        [typical, math.sqrt(coordinate.low * typical)]
        if is_edge(coordinate) and coordinate.low > 0 and coordinate.off == 0
        else [typical]
    )
