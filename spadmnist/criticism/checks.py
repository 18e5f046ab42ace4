"""Checks: does a model fail beside the data, and by how much?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from . import compare as comparing
from .fit import RATES, Bench, Cell, State


def misfits(own: Mapping[Cell, np.ndarray], residuals: Mapping[Cell, np.ndarray]) -> dict[Cell, float]:
    """Mean squared residual of each block, 1 being the model's own. own: (recordings, cells) residuals of these."""
    return {
        cell: float(np.mean(z**2)) / max(float(np.mean(own[cell] ** 2)), 0.05)
        for cell, z in residuals.items()
        if cell != RATES and len(z)
    }


def misfit(own: Mapping[Cell, np.ndarray], residuals: Mapping[Cell, np.ndarray]) -> float:
    """Mean over the blocks; where only means were measured, of their totals."""
    all_ = list(misfits(own, residuals).values())
    if not all_ and len(residuals[RATES]):
        return float(np.mean(residuals[RATES] ** 2))
    return float(np.mean(all_)) if all_ else 1.0


def usual_misfit(own: Mapping[Cell, np.ndarray]) -> float:
    """Below it are 95 % of the model's own recordings: of as many as there are of every capture."""
    squares = [np.mean(z**2, axis=1) for cell, z in own.items() if cell != RATES]
    if not squares:
        return 1.2
    n = min(map(len, squares))
    return float(np.quantile(np.mean([x[:n] / max(x[:n].mean(), 1e-30) for x in squares], axis=0), 0.95))


@dataclass(frozen=True)
class Block:
    """A check: a block of cells, or the totals. p: two-sided, of its sum or its worst cell."""

    cell: Cell
    p: float
    worst: int
    z: float


def blocks(bench: Bench, state: State, residuals: Mapping[Cell, np.ndarray]) -> list[Block]:
    """The checks of a state, judged with these residuals of the data, the clearest first."""
    out = []
    for cell, z in residuals.items():
        if cell == RATES:
            out += [Block(("", f"rate {k}"), float(2 * stats.norm.sf(abs(v))), k, float(v)) for k, v in enumerate(z)]
            continue
        p, worst = state.nulls[cell].chance(z)
        out.append(Block(cell, p, worst, float(z[worst])))
    out += [Block(cell, 1e-12, 0, 40.0) for cell in state.exact]
    return sorted(out, key=lambda b: (b.p, -abs(b.z)))


def failing(checks: Sequence[Block], level: float = comparing.FALSE_ALARM) -> list[Block]:
    """Those that a right model would show once in a hundred times (Holm), the clearest first.

    The totals together have as large a share of these as `compare` gives them, and all else has the rest.
    """
    totals = sum(block.cell[0] == "" for block in checks)
    others = len(checks) - totals
    share = comparing.SHARE_OF_TOTALS if totals and others else float(bool(totals))
    weights = [share / totals if block.cell[0] == "" else (1 - share) / others for block in checks]
    out, left = [], 1.0
    for block, weight in sorted(zip(checks, weights, strict=True), key=lambda pair: pair[0].p / pair[1]):
        if block.p > level * weight / max(left, weight):
            break
        out.append(block)
        left -= weight
    return sorted(out, key=lambda block: (block.p, -abs(block.z)))
