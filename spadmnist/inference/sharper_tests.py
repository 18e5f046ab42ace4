"""Sharper score tests: the most significant candidates with more replicates, and at shapes between the templates.

A template of the scan comes from two replicates, at a coarse grid of shapes. Noise and a wrong shape take a part of its
score. Of a lifetime that is 11 % off, a template of the scan expects a score of 3.2, a sharper one 4.5, the true shape
from 32 replicates 5.3.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from .coordinates import Key, is_edge, room_of
from .evaluation import Evaluation
from .replicates import FEW
from .score_test import best_direction, most_significant
from .signature import captures_showing, size_of, template_of
from .trial import BOLDER, Trial, shape_of
from .trial_fits import STRONG

if TYPE_CHECKING:
    from .scan import Scan

# candidates that are simulated again; the first of them at other shapes, too: the time of a test; a rule of thumb
_CANDIDATES = 3
# replicates of each capture: with four times as many the expected score of that lifetime is 9 % larger
_REPLICATES = 2 * FEW
# of the square of a signature: captures that hold no more of it together are not simulated; a rule of thumb
_LEFT_OUT = 0.05


def sharper(scan: Scan, evaluation: Evaluation, tried: Sequence[Trial]) -> list[Trial]:
    """New trials of the most significant candidates, from more replicates; of the first one at more shapes.

    The strength is one that noise does not blur. Edges keep theirs: another strength has another signature. Maps and
    periodic effects have tests of their own; what grows with the square is left out, too.

    Args:
        tried: the trials of the scan.
    """
    out: list[Trial] = []
    linear = [one for one in tried if not one.phases and one.signature.even is None]
    for k, one in enumerate(most_significant(scan.replicates, evaluation, linear, _CANDIDATES)):
        template = template_of(scan.replicates, evaluation, one.signature)
        some = captures_showing(template, _LEFT_OUT)
        shapes = [{}, *(_between(one, linear) if k == 0 else [])]
        values = [{**_at_strength(scan, evaluation, one), **shape} for shape in shapes]
        for new in scan.looked_at(evaluation, one.candidate, values, some, _REPLICATES):
            new.sharp = True
            out.append(new)
    return out


def _at_strength(scan: Scan, evaluation: Evaluation, one: Trial) -> dict[Key, Any]:
    """The values at a strength whose signature noise hardly blurs, in the direction of the data."""
    values = dict(one.values)
    size = size_of(scan.replicates, evaluation, one.signature)
    sign = 1.0
    if one.signed:
        _, found, times = best_direction(scan.replicates, evaluation, one)
        sign = math.copysign(1.0, found.data * times)
    for coordinate in one.candidate.strengths:
        if coordinate.key in values and not is_edge(coordinate) and values[coordinate.key] != coordinate.off:
            at = float(values[coordinate.key])
            room = room_of(coordinate, coordinate.scaled(at, sign))
            factor = min(STRONG / max(size, 1e-9), BOLDER, max(room, 1.0))
            there = coordinate.scaled(at, sign * factor)
            values[coordinate.key] = there if there != coordinate.off else at
    return values


def _between(one: Trial, tried: Sequence[Trial]) -> list[dict[Key, float]]:
    """Shapes half way to the next templates of the same candidate, one shape at a time, on the coordinate's scale."""
    same = [t for t in tried if t.candidate.name == one.candidate.name]
    out = []
    for k, coordinate in enumerate(one.candidate.shapes):
        here = coordinate.coordinate(float(one.values[coordinate.key]))
        others = {coordinate.coordinate(float(t.values[coordinate.key])) for t in same if len(shape_of(t)) > k}
        below, above = [x for x in others if x < here], [x for x in others if x > here]
        ends = [*([max(below)] if below else []), *([min(above)] if above else [])]
        out += [{coordinate.key: coordinate.value((here + end) / 2)} for end in ends]
    return out
