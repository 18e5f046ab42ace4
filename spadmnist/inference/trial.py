"""A trial: a candidate at some values, its signature, the fall of the squares that it predicts, and its evidence."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..effects import Effect
from . import pixel_maps
from .candidates import Candidate
from .coordinates import Coordinate, Key, is_edge
from .evaluation import Evaluation
from .gauss_newton import Fit
from .levels import COST_OF_A_PARAMETER, HALF_95, PROMISING
from .models import Model
from .replicates import TOTALS, Cell
from .signature import Signature

Phases = Mapping[tuple[str, Key], float]  # (capture, parameter) -> rad
# times the strength of a faint signature, to simulate its shape, which noise hides; a rule of thumb
BOLDER = 3.0
_RAISED = 12.0  # the factor on a strength without a signature for another trial; a rule of thumb
# in chi square, constant and per root of the evidence: two candidates nearer than that are a tie, because a few
# replicates blur the difference; rules of thumb
_TIE, _BLURRED = 8.0, 0.3


@dataclass
class Trial:
    """A candidate at some values, with its signature.

    Attributes:
        values: by (effect, parameter), SI.
        fall: of the squared residuals at the best strength, as the signature predicts, in chi square, less 2 for a
            phase; of a map at least the square of what its own test says. It chooses what is fitted. Where no check
            fails, the square of the score stands for it until the trial is fitted.
        times: the factor on the strength of `values` at which the fall is largest.
        evidence: of the fitted trial, in chi square, see `evidence`; the one measure by which models are compared.
        phases: fitted to each capture.
        intervals: 95 % intervals of coordinates that `fit` does not hold.
    """

    candidate: Candidate
    values: dict[Key, Any]
    signature: Signature
    fall: float
    times: float
    sensors: Model | None = None
    evidence: float = -math.inf
    power: float = 1.0  # the signature grows with this power of the strength
    p_value: float | None = None  # p-value, where a test of its own gives it
    fit: Fit | None = None
    maps: dict[Key, pixel_maps.PixelMap] | None = None
    residuals: dict[Cell, np.ndarray] | None = None
    evaluation: Evaluation | None = None  # of this model, where it was needed
    phases: Phases = field(default_factory=dict)
    chips: bool = False  # the pixels that it affects are random
    size: float = 0.0  # of the signature under the model with which it was simulated, standard deviations
    faint: bool = False  # fitted by the signature of a stronger one
    more: tuple[Candidate, ...] = ()  # maps that only make sense together
    intervals: dict[Key, tuple[float, float]] = field(default_factory=dict)
    sharp: bool = False  # its signature comes from more replicates, see `sharper_tests`
    seen: set[str] = field(default_factory=set)  # captures in which it was simulated
    there: Signature | None = None  # the signature at the fitted values
    others: tuple[Trial, ...] = ()  # of other shapes, where the squares do not determine the best shape

    @property
    def candidates(self) -> list[Candidate]:
        """The candidate, and the maps that are fitted with it."""
        return [self.candidate, *self.more]

    @property
    def fluctuates(self) -> bool:
        """Whether its effect differs from replicate to replicate."""
        return self.maps is None and not self.chips and (self.there or self.signature).fluctuates

    def cost(self, evaluation: Evaluation) -> float:
        """The squares that it leaves in the totals, plus the cost of a free parameter."""
        left = (self.residuals or evaluation.residuals)[TOTALS]
        return float(left @ left) + COST_OF_A_PARAMETER

    @property
    def signed(self) -> bool:
        """Whether its strength may have either sign."""
        return any(d.low < 0 or self.candidate.kind == "set" for d in self.candidate.strengths)

    def scaled(self) -> dict[Key, Any]:
        """The values at the best strength, SI."""
        out = dict(self.values)
        factor = math.copysign(abs(self.times) ** (1 / self.power), self.times)
        for coordinate in self.candidate.strengths:
            if coordinate.key in out:
                out[coordinate.key] = coordinate.scaled(float(out[coordinate.key]), factor)
        # components of one vector: the others are fixed at first, and fitted later
        if len(self.candidate.strengths) > 1:
            out = {**dict(self.candidate.fixed), **out}
        return out


def is_same(one: Trial, candidate: Candidate, tried: Mapping[Key, Any]) -> bool:
    """Whether a trial is of this candidate, at the same shapes as in `tried`."""
    return one.candidate.name == candidate.name and all(
        one.values.get(d.key) == tried.get(d.key) for d in candidate.shapes
    )


def shape_of(one: Trial) -> tuple[Any, ...]:
    """The values of the shapes, in which the templates of a candidate differ."""
    return tuple(one.values.get(coordinate.key) for coordinate in one.candidate.shapes)


def faint_of_other_shape(best: Trial, tried: Sequence[Trial]) -> list[Trial]:
    """The best trial of another shape that was simulated far below its best strength; none where there is no such.

    Noise hides a part of a faint signature: the fall that it predicts is too small, that of a strong one is not.

    Args:
        best: the best trial of a candidate.
        tried: all trials of that candidate, by the fall.
    """
    others = (t for t in tried if shape_of(t) != shape_of(best) and abs(t.times) > BOLDER and t.fall > PROMISING)
    return list(others)[:1]


def of_other_shapes(best: Trial, tried: Sequence[Trial]) -> tuple[Trial, ...]:
    """The best trial of the same candidate at each other shape.

    Args:
        tried: all trials, by the fall.
    """
    out = {shape_of(best): best}
    for one in tried:
        if one.candidate.name == best.candidate.name:
            out.setdefault(shape_of(one), one)
    return tuple(out.values())[1:]


def among(tried: Sequence[Trial], candidate: Candidate, values: Mapping[Key, Any]) -> bool:
    """Whether a candidate has been tried at these values."""
    return any(t.candidate.name == candidate.name and t.values == values for t in tried)


def weaker(one: Trial) -> dict[Key, Any] | None:
    """The values of an added edge half way, in the logarithm, to the low end of its range; None for all else."""
    return _half_way(one, False)


def further(one: Trial) -> dict[Key, Any] | None:
    """As `weaker`, towards the high end of the range."""
    return _half_way(one, True)


def _half_way(one: Trial, up: bool) -> dict[Key, Any] | None:
    if one.candidate.kind != "add" or len(one.candidate.strengths) != 1:
        return None
    coordinate = one.candidate.strengths[0]
    value, end = float(one.values[coordinate.key]), coordinate.high if up else coordinate.low
    if (
        coordinate.off != 0
        or not is_edge(coordinate)
        or not coordinate.low > 0
        or (value >= end if up else value <= end)
    ):
        return None
    return {**one.values, coordinate.key: math.sqrt(end * value)}


def stronger(one: Trial) -> dict[Key, Any] | None:
    """The values of a trial at several times its strength; None where it cannot be stronger.

    A listed edge is not moved that far: it has another signature there.
    """
    out = dict(one.values)
    for coordinate in one.candidate.strengths:
        movable = one.candidate.kind == "add" or not (coordinate.whole or coordinate.kind == "edge")
        if coordinate.key in out and movable and out[coordinate.key] != coordinate.off and not coordinate.lacks:
            out[coordinate.key] = coordinate.scaled(float(out[coordinate.key]), _RAISED)
    return out if out != one.values else None


def at_end(one: Trial) -> bool:
    """Whether a shape is at an end of its range, so that its law is hardly the right one."""
    shapes = {d: one.values.get(d.key) for d in one.candidate.shapes}
    return any(
        isinstance(x, (int, float)) and any(math.isclose(x, end, rel_tol=1e-6) for end in (d.low, d.high))
        for d, x in shapes.items()
    )


def is_open(one: Trial) -> bool:
    """Whether the data do not exclude an end of the range of a fitted shape, by its 95 % interval."""
    if one.fit is None:
        return False
    shapes, errors = set(one.candidate.shapes), np.sqrt(np.maximum(np.diag(one.fit.covariance), 0.0))
    for coordinate, u, error in zip(one.fit.coordinates, one.fit.point, errors, strict=True):
        ends = sorted(coordinate.coordinate(end) for end in (coordinate.low, coordinate.high))
        if coordinate in shapes and not ends[0] < u - HALF_95 * error < u + HALF_95 * error < ends[1]:
            return True
    return False


def frequencies_of(candidate: Candidate) -> list[Coordinate]:
    """The frequencies of a periodic candidate; one over the exposure is their resolution."""
    return [d for d in candidate.shapes if d.kind == "frequency"]


def of_scene(one: Trial) -> bool:
    """Whether it changes the scene that is seen."""
    return bool(getattr(Effect.registry.find(one.candidate.effect), "of_scene", False))


def is_pattern(one: Trial) -> bool:
    """Whether it is a pattern: rows, columns, or a shape of the light over the array."""
    candidate = one.candidate
    if candidate.kind != "add":
        return of_scene(one)  # no other parameter of the light is set
    return candidate.per in ("row", "column") or Effect.registry.find(candidate.effect).is_pattern


def tie(evidence: float) -> float:
    """The difference of evidence, in chi square, within which two candidates are a tie."""
    return _TIE + _BLURRED * math.sqrt(max(evidence, 0.0))
