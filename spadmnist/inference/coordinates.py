"""Coordinates: the free parameters of a model, each on the scale on which it moves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..plugins import Parameter
from .levels import HALF_95

Key = tuple[str, str]  # (effect, parameter)
Values = Mapping[Key, Any]  # parameter values, SI units
# of a logarithm, or of the search range: how far an interval may extend beyond that range. What is seen within is
# taken to hold so far; a rule of thumb
_BEYOND = 0.3
# of the search range: the least distance to its upper end on the scale of that distance. It keeps the logarithm finite;
# any far below a distance that is fitted does
_LEAST = 1e-6


@dataclass(frozen=True)
class Coordinate:
    """A free parameter of a model, and the scale on which it moves: linear, logarithmic, or the log of a distance.

    Attributes:
        low, high: the search range, in the parameter's unit.
        off: the value at which the effect vanishes; None for a shape. Where it is the upper end of the range, the
            coordinate is the log of the distance to that end.
        kind: how it moves, one of `plugins.KINDS`.
        bounds: the least and the largest value that exist; None where there is no such bound.
        absent: the value of a strength without which there is no effect, whatever is listed; None for a shape.
    """

    effect: str
    parameter: str
    unit: str
    low: float
    high: float
    off: float | None
    kind: str = "smooth"
    bounds: tuple[float | None, float | None] = (None, None)
    absent: float | None = None

    @property
    def key(self) -> Key:
        """(effect, parameter)."""
        return self.effect, self.parameter

    @property
    def whole(self) -> bool:
        """Whether the parameter has whole values only, or whole multiples and whole parts of what is listed."""
        return self.kind == "count" or (self.kind == "multiple" and bool(self.off))

    def next_whole(self, value: float, by: int) -> float:
        """The whole value that is so many further up, or down where negative, in the parameter's unit."""
        if self.kind == "count":
            return value + by
        for _ in range(abs(by)):
            number = round(value / self._unit) if value > 0.999 * self._unit else -round(self._unit / value)
            number += 1 if by > 0 else -1
            number = {0: -2, -1: 1}.get(number, number)  # 1/2, 1, 2
            value = self._unit * number if number > 0 else self._unit / -number
        return value

    @property
    def _unit(self) -> float:
        """That of which whole values are multiples, in the parameter's unit."""
        return float(self.off or 1.0) if self.kind == "multiple" else 1.0

    def rounded(self, value: float) -> float:
        """The nearest value that there is, in the parameter's unit."""
        if not self.whole:
            return value
        if self.kind == "count":
            return float(round(value))
        many = value / self._unit
        return self._unit * round(many) if many >= 1 else self._unit / round(1 / max(many, 1e-12))

    @property
    def log(self) -> bool:
        """Whether the coordinate is the log of the value."""
        return self.low > 0

    @property
    def lacks(self) -> bool:
        """Whether the coordinate is the log of the distance to the upper end of the range."""
        return self.log and self.off == self.high

    @property
    def ends(self) -> tuple[float, float]:
        """The range of the coordinate, (low, high)."""
        low, high = sorted((self.coordinate(self.low), self.coordinate(self.high)))
        return low, high

    def coordinate(self, value: float) -> float:
        """The coordinate of a value in the parameter's unit."""
        if self.lacks:
            return math.log(max(self.high - value, _LEAST * (self.high - self.low)))
        return math.log(max(value, 1e-300)) if self.log else value

    def value(self, coordinate: float) -> float:
        """The value at a coordinate, within the search range, in the parameter's unit."""
        return min(max(self._anywhere(coordinate), self.low), self.high)

    def interval(self, low: float, high: float) -> tuple[float, float]:
        """The interval (low, high) of the values between two coordinates.

        The search range is no bound of the parameter: an interval may end a little beyond it, within `bounds`. One of
        a strength that ends where the range does next to `absent`, or far beyond, ends at `absent`: the data do not
        exclude that there is no effect.
        """
        low_bound, high_bound = self.bounds
        least = -math.inf if low_bound is None else low_bound
        most = math.inf if high_bound is None else high_bound
        beyond = _BEYOND if self.log else _BEYOND * (self.high - self.low)
        ends = []
        for u in (low, high):
            if self.log and self.absent is not None and self.absent < self.low and self._at_least(u):
                ends.append(self.absent)
                continue
            near = min(max(u, self.ends[0] - beyond), self.ends[1] + beyond)
            ends.append(min(max(self._anywhere(near), least), most))
        return min(ends), max(ends)

    def _at_least(self, u: float) -> bool:
        """Whether an end of an interval is that of the range, as a profile's is that does not fall, or far beyond."""
        least = self.ends[0]
        return u <= least - _BEYOND or math.isclose(u, least, rel_tol=0.0, abs_tol=1e-9)

    def error(self, low: float, high: float) -> float:
        """The standard error of the coordinate, of which (low, high) is the 95 % interval in the parameter's unit."""
        ends = (self.coordinate(self.value(self.coordinate(end))) for end in (low, high))
        return abs(next(ends) - next(ends)) / (2 * HALF_95)

    def _anywhere(self, coordinate: float) -> float:
        value = math.exp(min(coordinate, 700.0)) if self.log else coordinate
        value = self.high - value if self.lacks else value
        return self.rounded(value)

    def scaled(self, value: float, factor: float) -> float:
        """The value, within the search range, whose distance from `off` is `factor` times that of `value`."""
        off = self.off or 0.0
        found = off + (value - off) * factor
        return min(max(self.rounded(found), self.low), self.high)


def coordinate_of(effect: str, declared: Parameter, off: float | None) -> Coordinate:
    """The coordinate of a declared parameter with a search range.

    Args:
        effect: the effect's name.
        declared: its declaration; `search` must be there.
        off: the value at which the effect vanishes; None for a shape.
    """
    assert declared.search is not None
    low, high = map(float, declared.search)
    return Coordinate(
        effect=effect,
        parameter=declared.name,
        unit=declared.unit,
        low=low,
        high=high,
        off=off,
        kind=declared.kind,
        bounds=declared.bounds,
        absent=None if off is None else declared.off,
    )


def point_of(coordinates: Sequence[Coordinate], values: Mapping[Key, Any]) -> np.ndarray:
    """The coordinates of parameter values, (coordinates,)."""
    return np.array([d.coordinate(float(values[d.key])) for d in coordinates])


def room_of(coordinate: Coordinate, value: float) -> float:
    """The factor by which the strength can grow until its distance from `off` is that of the end of the range."""
    off = coordinate.off or 0.0
    bound = coordinate.high if value > off else coordinate.low
    return (bound - off) / (value - off) if value != off else 1.0


def is_edge(coordinate: Coordinate) -> bool:
    """Whether a strength is an edge, a time or a distance to its upper end: no signature is proportional to it."""
    times = coordinate.kind in ("time", "edge") or (coordinate.kind == "multiple" and not coordinate.whole)
    return coordinate.lacks or (times and coordinate.off is not None)
