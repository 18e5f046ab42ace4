"""Cells that deviate alike in several captures: what no capture shows by itself, all of them show together.

The residuals of one cell in all captures add up to one normal score, sum z / sqrt(captures). Its p-value is that of any
statistic, against the sums of the model's own replicates. Source: Stouffer et al., The American Soldier 1 (1949) 45.
A statistic says of itself whether its cells repeat (`Statistic.repeats`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..statistics import Statistic
from .null_distribution import Null, tail_of
from .replicates import TOTALS, Cell, Replicates


@dataclass(frozen=True)
class Repeated:
    """The check of one statistic in several captures together.

    Attributes:
        cell: the block of the capture with the most detections. The check belongs to it whatever the data are, so that
            a check that fails under two models is known as the same.
        p: two-sided p-value, of the sum of squares or the worst cell.
        worst: that cell; z: its residual, of all captures.
        clearest: the block in which it deviates most in that direction.
        captures: their number.
    """

    cell: Cell
    p: float
    worst: int
    z: float
    clearest: Cell
    captures: int


def place(where: str, captures: int) -> str:
    """The words for a cell, and in how many captures together it deviates."""
    return where if captures < 2 else f"{where}, alike in {captures} captures"


def repeated(
    replicates: Replicates,
    nulls: Mapping[Cell, Null],
    own: Mapping[Cell, np.ndarray],
    residuals: Mapping[Cell, np.ndarray],
) -> list[Repeated]:
    """The checks of cells that repeat, one for each statistic and set of cells.

    Args:
        nulls: null distribution of each block.
        own: (replicates, cells) residuals of the replicates, by block.
        residuals: (cells,) of the data, by block.
    """
    groups: dict[tuple[str, bytes], list[Cell]] = {}
    for cell in residuals:
        if cell == TOTALS or cell[1] not in Statistic.registry or not Statistic.registry.find(cell[1]).repeats:
            continue
        axis = replicates.seen[cell[0]].summaries[cell[1]].axis
        if axis is not None:  # cells are the same where they lie at the same places
            groups.setdefault((cell[1], axis.tobytes()), []).append(cell)
    out = []
    for cells in groups.values():
        if len(cells) < 2:
            continue
        root = math.sqrt(len(cells))
        z, null = (np.sum([of[cell] for cell in cells], axis=0) / root for of in (residuals, own))
        law = replace(nulls[cells[0]], own=np.mean(null**2, axis=1), tail=tail_of(null), recordings=len(null))
        p, worst = law.p_value(z)
        sign = math.copysign(1.0, float(z[worst]))
        brightest = max(cells, key=lambda cell: replicates.seen[cell[0]].total)
        clearest = max(cells, key=lambda cell: sign * float(residuals[cell][worst]))
        out.append(Repeated(brightest, p, worst, float(z[worst]), clearest, len(cells)))
    return out
