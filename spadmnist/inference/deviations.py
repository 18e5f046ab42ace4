"""Failing checks that show one deviation of the data from the model, as groups.

The rule. A statistic declares the statistics whose cells its own are sums of (`Statistic.pools`): clusters of the whole
array contain the pairs of neighbours, the variance of counts contains the spectrum. Projected on a sum, no deviation of
normal cells has a larger excess chi square than in the cells themselves (Cauchy and Schwarz). So a check shows the
same deviation as a failing check of a statistic that it pools, in the same capture, where that one has at least
`LEAST_FALL` of its excess chi square; where it has less, the check has something of its own and stands for itself.
Checks of one statistic in several captures show one deviation where they look at the same place.

A group is named by its most specific check (`Statistic.specific`) of those that have that share of the largest excess;
a sum only if it has that share of what it is a sum of. Ties go to the larger physical size. Limits of the rule: two
effects that move the same cells are one group, and a faint effect in a statistic that a strong one moves is detected
only when the strong one is in the model.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ..statistics import Statistic, Summary
from .laws import law_of
from .levels import LEAST_FALL

# least cosine of the residuals of two captures that look at the same place: with more, two failing checks of a
# statistic without an axis are one deviation; a rule of thumb
_LIKE = 0.5
# chi square, 20 standard deviations: beyond it the scales of different laws have no common measure, and all is certain.
# Deviations are then in the order of how specific their statistics are; a rule of thumb
_CERTAIN = 400.0
LISTED = 8  # deviations that a terminal lists: what fits on a screen
# relative: the most by which two places on an axis differ that are the same, so that two failing checks are one
# deviation; a rule of thumb
_NEAR = 0.1


@dataclass(frozen=True)
class Deviation:
    """A failing check, as its group needs it.

    Attributes:
        statistic, capture: of the check; capture is None where it is of all.
        excess: excess chi square, see `excess`.
        worst: the cell that shows it most; where: that cell in words; at: its place on the axis, if any.
        size: relative deviation of that cell.
        residuals: (cells,) standard deviations; empty for totals.
    """

    statistic: str
    capture: str | None
    excess: float
    worst: int
    where: str
    size: float
    residuals: np.ndarray
    at: float | None = None

    @property
    def specific(self) -> int:
        """`Statistic.specific` of the cell; 0 for totals and for what is not registered."""
        if self.statistic not in Statistic.registry:
            return 0
        kind = Statistic.registry.find(self.statistic)
        return kind.specific if self.worst >= kind.named_from else 0


def excess(summary: Summary, expected: np.ndarray, residuals: np.ndarray) -> float:
    """The excess chi square of a check: that of all cells, or of the largest residual or contrast where that is more.

        max(sum z^2 - n, max z^2, max (c z)^2);  of a power spectrum 2 (r - 1 - log r) of its highest line

    Args:
        expected: (cells,) in the summary's unit. residuals: (cells,) standard deviations z.
        r: power over its expectation, exponentially distributed, of which this is the deviance. c: the patterns of
            the summary that are tested by themselves.
    """
    if not residuals.size:
        return 0.0
    largest = float(np.max(np.abs(residuals))) ** 2
    if summary.contrasts is not None:
        largest = max(largest, float(np.max((np.asarray(summary.contrasts) @ residuals) ** 2)))
    if law_of(summary.law, summary.scale is not None).spectrum:
        ratio = max(1.0, float(np.max(summary.values / np.maximum(expected, 1e-30))))
        return max(largest, 2 * (ratio - 1 - float(np.log(ratio))))
    return max(largest, float(np.sum(residuals**2)) - residuals.size)


def deviations(found: Sequence[Deviation], passing: Collection[tuple[str | None, str]] = ()) -> list[list[int]]:
    """The groups of failing checks, each as indices into `found`: the one that names the group first.

    The groups, the clearest first, and the checks behind the first of each are in the order of their excess.

    Args:
        passing: (capture, statistic) of the checks that pass: what would be seen there, too, is not the cause.
    """
    group = list(range(len(found)))

    def join(a: int, b: int) -> None:
        old, new = group[a], group[b]
        group[:] = [new if g == old else g for g in group]

    for i, one in enumerate(found):
        finer = _finer(one, passing)
        parents = [j for j, other in enumerate(found) if _is(other, one, finer) and _holds(other, one)]
        if parents:
            join(i, max(parents, key=lambda j: (found[j].specific, found[j].excess)))
    for i, one in enumerate(found):
        for j in range(i):
            if one.statistic == found[j].statistic and _same_place(one, found[j]):
                join(i, j)
    out = []
    for number in dict.fromkeys(group):
        members = sorted((i for i, g in enumerate(group) if g == number), key=lambda i: -found[i].excess)
        name = _naming([found[i] for i in members])
        out.append([members[name], *(i for k, i in enumerate(members) if k != name)])
    clear = [max(found[i].excess for i in members) for members in out]
    order = sorted(range(len(out)), key=lambda k: (-min(clear[k], _CERTAIN), -found[out[k][0]].specific, -clear[k]))
    return [out[k] for k in order]


def listed(checks: Iterable[tuple[str, str | None]]) -> str:
    """Checks (statistic, capture) as text, "multiplicity of flat, dark; spacing of flat"."""
    by_statistic: dict[str, list[str]] = {}
    for statistic, capture in checks:
        by_statistic.setdefault(statistic, []).append(capture or "all captures")
    return "; ".join(f"{name} of {', '.join(captures)}" for name, captures in by_statistic.items())


def _holds(one: Deviation, other: Deviation) -> bool:
    """Whether one check has enough excess to be all that another one shows."""
    return min(one.excess, _CERTAIN) >= LEAST_FALL * min(other.excess, _CERTAIN)


def _is(other: Deviation, one: Deviation, statistics: Collection[str]) -> bool:
    return other.capture == one.capture and other.statistic in statistics


def _naming(members: Sequence[Deviation]) -> int:
    """Which check names a group, by the capture that shows it most clearly; members: by excess."""
    here = [k for k, one in enumerate(members) if one.capture == members[0].capture and _holds(one, members[0])]

    def whole(one: Deviation) -> bool:
        """Whether a sum has what the cells that it sums over have."""
        parts = [other for other in members if _is(other, one, _pools(one.statistic))]
        return all(one.excess >= LEAST_FALL * part.excess for part in parts)

    able = [k for k in here if whole(members[k])] or here
    return max(able, key=lambda k: (members[k].specific, abs(members[k].size), members[k].excess))


def _pools(statistic: str) -> tuple[str, ...]:
    return Statistic.registry.find(statistic).pools if statistic in Statistic.registry else ()


def _finer(one: Deviation, passing: Collection[tuple[str | None, str]]) -> set[str]:
    """The statistics that a check pools, and what these pool; no further where one of them passes."""
    out: set[str] = set()
    more = set(_pools(one.statistic))
    while more:
        name = more.pop()
        out.add(name)
        if (one.capture, name) not in passing:
            more |= set(_pools(name)) - out
    return out - {one.statistic}


def _same_place(one: Deviation, other: Deviation) -> bool:
    """Whether checks of one statistic in two captures look at the same place."""
    if one.capture == other.capture or one.where == other.where:
        return True
    if one.at is not None and other.at is not None:
        return abs(one.at - other.at) <= _NEAR * max(abs(one.at), abs(other.at))
    if one.residuals.shape != other.residuals.shape or not one.residuals.size:
        return False
    norms = float(np.linalg.norm(one.residuals) * np.linalg.norm(other.residuals))
    return norms > 0 and float(one.residuals @ other.residuals) > _LIKE * norms
