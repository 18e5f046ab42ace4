"""Findings on a model, whatever the verdict: what remains unexplained, pictures, light levels."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from ..effects import Mimic
from ..recording import Capture
from ..statistics import Statistic
from . import comparison
from .checks import LIGHT, BlockCheck, block_checks, failing
from .deviations import Deviation, deviations, excess
from .evaluation import Evaluation
from .levels import LEAST_P
from .light_checks import light_of
from .light_levels import LEAST_ELASTICITY, Nuisance, totals_space
from .replicates import Cell, Replicates
from .results import Step, Trace, mimic, plain
from .totals_tests import Level

# deviations that have pictures, and captures of each, at most: the length of a page; rules of thumb
_PICTURES, _CAPTURES = 6, 4
# sum of squares of a signature in a check, in variances, above which a picture names the step as what moves it: 3
# standard deviations of one number, a rule of thumb
_MOVED = 9.0
_ENTRIES = 20  # checks that are listed as unexplained, at most: the length of an answer; a rule of thumb
# standard deviations of a signature in statistics where the mimic has none: with more it is excluded; a rule of thumb
_SEPARATED = 4.0
_REGISTRY = Statistic.registry


def mimicked(step: Step, captures: Iterable[Capture]) -> Mimic | None:
    """The mimic of a step that has the same signature in all that was measured; None where there is none.

    Args:
        captures: that were measured.
    """
    other = mimic(step.candidate)
    if other is None or (other.alone and sum(not capture.light.dark for capture in captures) != 1):
        return None
    if not other.among:
        return other
    apart = [t for (_, name), t in step.template.items() if name in _REGISTRY and _among(name) != other.among]
    return other if sum(float(t @ t) for t in apart) < _SEPARATED**2 else None


def _among(name: str) -> str:
    return _REGISTRY.find(name).among


def remainder(
    replicates: Replicates, evaluation: Evaluation, residuals: Mapping[Cell, np.ndarray]
) -> list[dict[str, Any]]:
    """What remains unexplained, for the JSON data: statistic, capture, significance, place, size.

    The entries are in groups that show one deviation each (`deviations`), the one that names it first.

    Args:
        residuals: (cells,) by block.
    """
    failed, passing = _shown(block_checks(replicates, evaluation, residuals))
    seen = [_failed(replicates, evaluation, residuals, block) for block in failed]
    groups = deviations([one for one, _ in seen], passing)
    out, each = [], max(_ENTRIES // max(len(groups), 1), 1)  # of each deviation some, and the first of all
    for number, members in enumerate(groups, 1):
        for i in members[:each]:
            one, size = seen[i]
            significance = max(abs(failed[i].z), float(stats.norm.isf(max(failed[i].p, LEAST_P) / 2)))
            entry = {"statistic": one.statistic, "capture": one.capture, "significance": plain(significance)}
            out.append(entry | {"where": one.where + _words(failed[i]), "size": size, "deviation": number})
    return out


def _failed(
    replicates: Replicates, evaluation: Evaluation, residuals: Mapping[Cell, np.ndarray], block: BlockCheck
) -> tuple[Deviation, str]:
    """(a failing check as its group needs it, its size in words)."""
    id, name = block.cell
    if id == "":
        ids, *_ = totals_space(replicates, evaluation)
        light = block.cell == LIGHT
        return Deviation(
            statistic="light" if light else "rate",
            capture=None if light else ids[block.worst],
            excess=block.z**2,
            worst=0,
            where="all lit captures" if light else "all pixels",
            size=0.0,
            residuals=np.zeros(0),
        ), ""
    cell = block.shown
    id, seen = cell[0], replicates.seen[cell[0]]
    summary, z = seen.summaries[name], residuals.get(cell, np.zeros(0))
    expected, _ = evaluation.expected(cell, seen.total)
    text, relative = summary.size(block.worst, float(summary.values[block.worst]), float(expected[block.worst]))
    at = None if summary.axis is None or summary.shape is not None else float(summary.axis[block.worst])
    beyond = excess(summary, expected, z) if z.size else block.z**2
    if block.together is not None:
        beyond = max(beyond, block.together.excess)
    return Deviation(
        statistic=name,
        capture=id,
        excess=beyond,
        worst=block.worst,
        where=summary.place(block.worst, block.contrast),
        size=relative,
        residuals=z,
        at=at,
    ), text


def _words(block: BlockCheck) -> str:
    """The words behind a place where several captures together deviate."""
    return block.together.words if block.together is not None else ""


def _shown(checks: Sequence[BlockCheck]) -> tuple[list[BlockCheck], set[Cell]]:
    """(failing checks, each block once; the blocks that show none of them)."""
    failed: dict[Cell, BlockCheck] = {}
    for block in failing(checks):
        failed.setdefault(block.shown, block)  # the one with the smallest p-value
    return list(failed.values()), {block.cell for block in checks} - failed.keys()


def failing_of(found: comparison.Comparison | None) -> list[dict[str, Any]]:
    """The failing checks of a comparison as `remainder` lists them, each a deviation of its own; none of None."""
    checks = [] if found is None else sorted(found.failing, key=lambda check: check.p_value)
    return [
        {
            "statistic": check.statistic,
            "capture": check.capture,
            "significance": plain(float(stats.norm.isf(check.p_value / 2))),
            "where": check.where,
            "size": check.size,
            "deviation": number,
        }
        for number, check in enumerate(checks, 1)
    ]


def traces(replicates: Replicates, start: Evaluation, last: Evaluation, steps: Sequence[Step] = ()) -> list[Trace]:
    """The failing checks of the stated model under that model and under the last one, for figures.

    Of each group of failing checks (`deviations`), the clearest first: the check that names the group, and the checks
    of the same statistic in other captures.

    Args:
        start, last: the evaluations of the stated model and of the last one.
        steps: the steps between them.
    """
    failed, passing = _shown(block_checks(replicates, start, start.residuals))
    failed = [b for b in failed if b.cell[0] and b.shown in start.residuals and b.shown in last.residuals]
    seen = [_failed(replicates, start, start.residuals, block) for block in failed]
    out: list[Trace] = []
    for number, members in enumerate(deviations([one for one, _ in seen], passing)[:_PICTURES]):
        alike = [i for i in members if seen[i][0].statistic == seen[members[0]][0].statistic][:_CAPTURES]
        for i in alike:
            (id, name), (one, size) = failed[i].shown, seen[i]
            total, null = replicates.seen[id].total, last.nulls[id, name]
            now = null.expected(total)[0]
            moved = [float(np.sum(step.template.get((id, name), np.zeros(1)) ** 2)) for step in steps]
            out.append(
                Trace(
                    statistic=name,
                    capture=id,
                    summary=replicates.seen[id].summaries[name],
                    before=start.nulls[id, name].expected(total)[0],
                    after=now,
                    spread=null.spread_at(now),
                    residuals_before=start.residuals[id, name],
                    residuals_after=last.residuals[id, name],
                    where=one.where + _words(failed[i]),
                    size=size,
                    deviation=number,
                    first=i == members[0],
                    step=int(np.argmax(moved)) if moved and max(moved) > _MOVED else None,
                    worst=one.worst,
                )
            )
    return out


def nuisances(replicates: Replicates, evaluation: Evaluation) -> list[dict[str, Any]]:
    """The common light level and each capture's own, with 95 % intervals and pulls, for the JSON data."""
    levels: list[Level] = []
    for id, seen in replicates.seen.items():
        null = evaluation.rates[id]
        if seen.capture.light.dark or null.stated is None:
            continue
        level, error, elasticity = null.level_of(max(seen.total, 0.5))
        if elasticity <= LEAST_ELASTICITY or null.says_nothing(seen.total):
            continue  # no light level gives so few
        log = math.log(level / null.stated)
        levels.append(Level(seen.capture, log, error, elasticity=elasticity, freedom=null.freedom))
    found, _ = light_of(levels, [s.capture for s in replicates.seen.values()])
    return _as_data(found)


def levels_of(found: comparison.Comparison) -> list[dict[str, Any]]:
    """The light levels of a comparison, for the JSON data."""
    return _as_data(found.nuisances)


def _as_data(found: Sequence[Nuisance]) -> list[dict[str, Any]]:
    return [
        {"capture": n.capture, "name": n.name, **{k: plain(getattr(n, k)) for k in ("value", "low", "high", "pull")}}
        for n in found
    ]
