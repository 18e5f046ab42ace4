"""Findings on a model, whatever the verdict: what remains unexplained, pictures, light levels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import stats

from ..effects import Mimic
from ..statistics import Statistic
from . import comparison
from .evaluation import Evaluation, block_checks, failing
from .light_levels import LEAST_ELASTICITY, totals_space
from .replicates import Cell, Replicates
from .results import Step, Trace, mimic, plain

_LEAST_P = 1e-300  # a p-value is never 0
_TOLD_APART = 4.0  # standard deviations of a signature in statistics where the mimic has none: with more it is excluded
_REGISTRY = Statistic.registry


def mimicked(step: Step) -> Mimic | None:
    """The mimic of a step that has the same signature in all that was measured; None where there is none."""
    other = mimic(step.candidate)
    if other is None:
        return None
    apart = [t for (_, name), t in step.template.items() if name in _REGISTRY and _among(name) != other.among]
    return other if sum(float(t @ t) for t in apart) < _TOLD_APART**2 else None


def _among(name: str) -> str:
    return _REGISTRY.find(name).among


def remainder(
    replicates: Replicates, evaluation: Evaluation, residuals: Mapping[Cell, np.ndarray]
) -> list[dict[str, Any]]:
    """What remains unexplained, for the JSON data: statistic, capture, significance, place.

    Args:
        residuals: (cells,) by block.
    """
    out = []
    for block in failing(block_checks(replicates, evaluation, residuals))[:20]:
        id, name = block.cell
        if id == "":
            ids, *_ = totals_space(replicates, evaluation)
            which = ids[block.worst] if block.worst < len(ids) else None
            out.append(
                {"statistic": "rate", "capture": which, "significance": plain(abs(block.z)), "where": "all pixels"}
            )
            continue
        summary = replicates.seen[id].summaries[name]
        out.append(
            {
                "statistic": name,
                "capture": id,
                "significance": plain(max(abs(block.z), float(stats.norm.isf(max(block.p, _LEAST_P) / 2)))),
                "where": summary.where(block.worst),
            }
        )
    return out


def traces(replicates: Replicates, start: Evaluation, last: Evaluation) -> list[Trace]:
    """The clearest failing checks of the first model, as it was and as it is, up to four statistics."""
    out: list[Trace] = []
    for block in failing(block_checks(replicates, start, start.residuals)):
        id, name = block.cell
        if id == "" or block.cell not in last.nulls or start.nulls[block.cell].law.exact:
            continue
        if any(t.statistic == name for t in out):
            continue
        seen = replicates.seen[id]
        summary, null = seen.summaries[name], last.nulls[block.cell]
        now = null.expected(seen.total)[0]
        out.append(
            Trace(
                name,
                id,
                summary,
                start.nulls[block.cell].expected(seen.total)[0],
                now,
                null.spread_at(now),
                start.residuals[block.cell],
                last.residuals[block.cell],
            )
        )
        if len(out) == 4:
            break
    return out


def nuisances(replicates: Replicates, evaluation: Evaluation) -> list[dict[str, Any]]:
    """The common light level and each capture's own, with 95 % intervals and pulls, for the JSON data."""
    levels: list[tuple[Any, float, float, float]] = []
    for id, seen in replicates.seen.items():
        null = evaluation.rates[id]
        if seen.capture.light.dark or null.stated is None:
            continue
        level, error, elasticity = null.level_of(max(seen.total, 0.5))
        if elasticity <= LEAST_ELASTICITY or null.drowned(seen.total):
            continue  # no light level gives so few
        levels.append((seen.capture, math.log(level / null.stated), error, elasticity))
    found, _ = comparison.light_of(levels, [s.capture for s in replicates.seen.values()])
    return [
        {"capture": n.capture, "name": n.name, **{k: plain(getattr(n, k)) for k in ("value", "low", "high", "pull")}}
        for n in found
    ]
