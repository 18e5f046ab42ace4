"""Findings: what is told of a model beside the data, whatever the verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import stats

from ..effects import Mimic
from ..statistics import Statistic
from . import checks
from . import compare as comparing
from .answer import Step, Trace, mimic, plain
from .fit import Bench, Cell, State

_LEAST_P = 1e-300
_TOLD_APART = 4.0  # standard deviations of a trace where what looks the same elsewhere would leave none


def mimicked(step: Step) -> Mimic | None:
    """What is not in the catalogue and does what this step does, in all that was measured; None where nothing is."""
    other = mimic(step.change)
    if other is None:
        return None
    apart = [t for (_, name), t in step.template.items() if name in _REGISTRY and _among(name) != other.among]
    return other if sum(float(t @ t) for t in apart) < _TOLD_APART**2 else None


_REGISTRY = Statistic.registry


def _among(name: str) -> str:
    return _REGISTRY.find(name).among


def remainder(bench: Bench, state: State, residuals: Mapping[Cell, np.ndarray]) -> list[dict[str, Any]]:
    """What nothing explains: where, how large, and what kind of mechanism leaves such a trace."""
    out = []
    for block in checks.failing(checks.blocks(bench, state, residuals))[:20]:
        id, name = block.cell
        if id == "":
            ids, *_ = bench.rate_space(state)
            which = ids[block.worst] if block.worst < len(ids) else None
            out.append(
                {"statistic": "rate", "capture": which, "significance": plain(abs(block.z)), "where": "all pixels"}
            )
            continue
        summary = bench.seen[id].summaries[name]
        out.append(
            {
                "statistic": name,
                "capture": id,
                "significance": plain(max(abs(block.z), float(stats.norm.isf(max(block.p, _LEAST_P) / 2)))),
                "where": summary.where(block.worst),
            }
        )
    return out


def traces(bench: Bench, start: State, last: State) -> list[Trace]:
    """The clearest checks of the model as it was, as it was and as it is now."""
    out: list[Trace] = []
    for block in checks.failing(checks.blocks(bench, start, start.residuals)):
        id, name = block.cell
        if id == "" or block.cell not in last.nulls or start.nulls[block.cell].law == "exact":
            continue
        if any(t.statistic == name for t in out):
            continue
        seen = bench.seen[id]
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


def nuisances(bench: Bench, state: State) -> list[dict[str, Any]]:
    """The level of the light, and each capture's own part of it, with intervals and pulls."""
    levels: list[tuple[Any, float, float, float]] = []
    for id, seen in bench.seen.items():
        null = state.rates[id]
        if seen.capture.light.dark or null.stated is None:
            continue
        level, error, elasticity = null.level_of(max(seen.total, 0.5))
        if elasticity <= comparing.LEAST_ELASTICITY or null.drowned(seen.total):
            continue  # no light level gives so few
        levels.append((seen.capture, math.log(level / null.stated), error, elasticity))
    found, _ = comparing.light_of(levels, [s.capture for s in bench.seen.values()])
    return [
        {"capture": n.capture, "name": n.name, **{k: plain(getattr(n, k)) for k in ("value", "low", "high", "pull")}}
        for n in found
    ]
