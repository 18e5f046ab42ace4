"""A candidate at some values: what it does to a model, and by how much it brings the data nearer."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..effects import Effect
from . import mapping
from .candidates import Change, Dial, Key
from .fit import RATES, Cell, Moved, Sensors, State
from .settling import Settled

Phases = Mapping[tuple[str, Key], float]  # (capture, parameter) -> rad

EACH = 9.0  # in chi square: what a further number must be worth
_RAISED = 12.0  # times as strong is what is tried where a trace is none


@dataclass
class Tried:
    """A candidate at some values: what it does, and by how much it brings the data nearer.

    gain: in chi square; times: the strength, relative to that of `values`, at which it is largest; fell: by how much
    the squares fall, where the gain is another measure; phases: of what begins anew in every capture; intervals: 95 %
    of numbers that `settled` does not hold.
    """

    change: Change
    values: dict[Key, Any]
    moved: Moved
    gain: float
    times: float
    sensors: Sensors | None = None
    fell: float = 0.0
    power: float = 1.0  # what it does grows with this power of its strength
    chance: float | None = None  # p-value, where it is known by itself
    settled: Settled | None = None
    maps: dict[Key, mapping.Map] | None = None
    residuals: dict[Cell, np.ndarray] | None = None
    state: State | None = None  # of this model, where it was needed
    phases: Phases = field(default_factory=dict)
    chips: bool = False  # chance decides which pixels it hits
    faint: bool = False  # settled by what a stronger one does
    more: tuple[Change, ...] = ()  # maps that only make sense together
    intervals: dict[Key, tuple[float, float]] = field(default_factory=dict)
    seen: set[str] = field(default_factory=set)  # captures in which it was simulated
    there: Moved | None = None  # what it does where they are settled

    @property
    def changes(self) -> list[Change]:
        return [self.change, *self.more]

    @property
    def fluctuates(self) -> bool:
        """Is what it does another in every recording?"""
        return self.maps is None and not self.chips and (self.there or self.moved).fluctuates

    @property
    def scatters(self) -> bool:
        """Do its recordings scatter otherwise than the model's own, so that squares of residuals do not judge it?"""
        return self.chips or self.fluctuates

    def cost(self, state: State) -> float:
        """What it leaves of the totals, and what a number costs."""
        left = (self.residuals or state.residuals)[RATES]
        return float(left @ left) + EACH

    @property
    def signed(self) -> bool:
        return any(d.low < 0 or self.change.kind == "set" for d in self.change.strengths)

    def scaled(self) -> dict[Key, Any]:
        """The values at the strength that suits them."""
        out = dict(self.values)
        factor = math.copysign(abs(self.times) ** (1 / self.power), self.times)
        for dial in self.change.strengths:
            if dial.key in out:
                out[dial.key] = dial.scaled(float(out[dial.key]), factor)
        if len(self.change.strengths) > 1:  # directions side by side: the others' share comes from the fit
            out = {**dict(self.change.fixed), **out}
        return out


def is_same(one: Tried, change: Change, tried: Mapping[Key, Any]) -> bool:
    """Is it this change, at these shapes?"""
    return one.change.name == change.name and all(one.values.get(d.key) == tried.get(d.key) for d in change.shapes)


def shape_of(one: Tried) -> tuple[Any, ...]:
    """What tells a candidate's templates apart, but for their strength."""
    return tuple(one.values.get(dial.key) for dial in one.change.shapes)


def weaker(one: Tried) -> dict[Key, Any] | None:
    """The values of an added edge half as far, of a logarithm, from the least that is looked for; None of all else."""
    return _half_way(one, False)


def further(one: Tried) -> dict[Key, Any] | None:
    """As `weaker`, towards the most that is looked for."""
    return _half_way(one, True)


def _half_way(one: Tried, up: bool) -> dict[Key, Any] | None:
    if one.change.kind != "add" or len(one.change.strengths) != 1:
        return None
    dial = one.change.strengths[0]
    value, end = float(one.values[dial.key]), dial.high if up else dial.low
    if dial.off != 0 or not is_edge(dial) or not dial.low > 0 or (value >= end if up else value <= end):
        return None
    return {**one.values, dial.key: math.sqrt(end * value)}


def stronger(one: Tried) -> dict[Key, Any] | None:
    """The values of a candidate at several times its strength, or nothing where it cannot be stronger."""
    out = dict(one.values)
    for dial in one.change.strengths:
        if dial.key in out and one.change.kind == "add" and out[dial.key] != dial.off and not dial.lacks:
            out[dial.key] = dial.scaled(float(out[dial.key]), _RAISED)
    return out if out != one.values else None


def room_of(dial: Dial, value: float) -> float:
    """How much stronger a strength can be."""
    off = dial.off or 0.0
    bound = dial.high if value > off else dial.low
    return (bound - off) / (value - off) if value != off else 1.0


def at_end(one: Tried) -> bool:
    """Does a shape lie at an end of where it is looked for? Then its law is hardly what is there."""
    shapes = {d: one.values.get(d.key) for d in one.change.shapes}
    return any(
        isinstance(x, (int, float)) and any(math.isclose(x, end, rel_tol=1e-6) for end in (d.low, d.high))
        for d, x in shapes.items()
    )


def is_edge(dial: Dial) -> bool:
    """A strength that is a time, or what lacks of one: nothing grows with it in proportion, an edge moves."""
    return dial.lacks or (dial.unit == "s" and dial.off is not None)


def lines_of(change: Change) -> list[Dial]:
    """Frequencies of what swings: known to a fraction of one over the exposure, or not at all."""
    return [d for d in change.shapes if d.unit == "Hz"] if change.phases else []


def of_scene(one: Tried) -> bool:
    """Does it change the scene that is seen?"""
    return bool(getattr(Effect.registry.find(one.change.effect), "of_scene", False))


def is_pattern(one: Tried) -> bool:
    """Rows, columns, or a shape of the light over the array?"""
    change = one.change
    if change.kind != "add":
        return of_scene(one)  # no other number of the light is set
    return change.per in ("row", "column") or getattr(Effect.registry.find(change.effect), "stage", "") == "light"
