"""The checks of an evaluation: its goodness of fit.

Every statistic of every capture is a check, and so are the total of each capture and the light. Holm's correction keeps
false alarms to one comparison in a hundred.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..statistics import Summary
from .captures_together import Together, checks_together
from .evaluation import Evaluation
from .levels import FALSE_ALARM, SHARE_OF_STATISTICS, SHARES
from .null_distribution import Judgement
from .replicates import TOTALS, Cell, Replicates
from .totals_tests import tests_of_totals

LIGHT: Cell = ("", "light")  # the check of the light of all lit captures


def holm(p_values: Sequence[float], kinds: Sequence[str], tests: Sequence[int], level: float) -> set[int]:
    """The checks that fail by Holm's correction at a familywise level, each kind with its share of the level.

    Args:
        kinds: of the checks; those that `SHARES` does not have share the rest.
        tests: so many tests each p-value is the smallest of.
        level: probability that a right model fails any.
    """
    of_kind: Counter[str] = Counter()
    for kind, number in zip(kinds, tests, strict=True):
        of_kind[kind] += number
    weights = [SHARES.get(kind, SHARE_OF_STATISTICS) / of_kind[kind] for kind in kinds]
    left = sum(weight * number for weight, number in zip(weights, tests, strict=True))
    out: set[int] = set()
    for i in sorted(range(len(weights)), key=lambda i: p_values[i] / weights[i]):
        if p_values[i] > level * weights[i] / max(left, weights[i]):
            break
        out.add(i)
        left -= weights[i]
    return out


@dataclass(frozen=True)
class Check:
    """One check of a model: a statistic of one capture, the total of detections, or the light level.

    Attributes:
        statistic: its name; "rate" for a total, "light" for the common light level, "wavelength_ratio" for the ratio of
            the pixels' counts between two wavelengths.
        capture: the name of the capture; None where it is of all captures.
        misfit: mean squared standardised residual, relative to that of the model's replicates; 1 for a right model.
        p_value: before the correction for the number of checks.
        passes: the model passes: the deviation is not significant, or within the tolerance.
        significant: the p-value is significant after Holm's correction.
        material: it is significant and exceeds the tolerance, so that the model fails.
        where, size: the cell that shows it most, and the deviation there, in words and physical units.
        relative: that deviation as a share of the detections or of the rate.
    """

    statistic: str
    capture: str | None
    misfit: float
    p_value: float
    where: str
    size: str
    relative: float
    passes: bool = True
    material: bool = False
    significant: bool = False
    excess: float = 0.0  # excess chi square (`deviations.excess`)
    # the measured summary and the model's expectation, for pictures; None for totals
    summary: Summary | None = field(default=None, repr=False)
    judgement: Judgement | None = field(default=None, repr=False)
    tests: int = field(default=1, repr=False)  # the number of tests of which `p_value` is the smallest


@dataclass(frozen=True)
class BlockCheck:
    """A check as the search needs it: a block of cells, or the totals.

    Attributes:
        p: p-value, see `Null.p_value`.
        worst: the cell that shows it most; z: its residual.
        tests: the number of tests of which p is the smallest p-value.
        together: where p is that of several captures together, their check.
        contrast: the index of the contrast, where one decides.
    """

    cell: Cell
    p: float
    worst: int
    z: float
    tests: int = 1
    together: Together | None = None
    contrast: int | None = None

    @property
    def shown(self) -> Cell:
        """The block that shows it: of several captures together, the one in which it is clearest."""
        return self.cell if self.together is None else self.together.clearest


def block_checks(
    replicates: Replicates, evaluation: Evaluation, residuals: Mapping[Cell, np.ndarray]
) -> list[BlockCheck]:
    """The checks of an evaluation with these residuals of the data, by p-value.

    Args:
        residuals: (cells,) by block.
    """
    out, alone = [], dict[Cell, tuple[float, int, int | None]]()
    for cell, z in residuals.items():
        if cell == TOTALS:
            for test in tests_of_totals(replicates, evaluation, z):
                name = LIGHT if test.capture is None else ("", f"rate {test.capture}")
                out.append(BlockCheck(cell=name, p=test.p, worst=test.capture or 0, z=test.z))
        else:
            alone[cell] = evaluation.nulls[cell].p_value(z)
    several: dict[Cell, list[Together]] = {}
    for check in checks_together(replicates, evaluation, residuals, {cell: p for cell, (p, *_) in alone.items()}):
        several.setdefault(check.cell, []).append(check)
    for cell, (p, worst, contrast) in alone.items():
        here = several.get(cell, [])
        least, tests = min(here, key=lambda check: check.p, default=None), 1 + len(here)
        if least is not None and least.p < p:
            out.append(
                BlockCheck(
                    cell=cell,
                    p=least.p,
                    worst=least.worst,
                    z=least.z,
                    tests=tests,
                    together=least,
                    contrast=least.contrast,
                )
            )
        else:
            z_worst = float(residuals[cell][worst])
            out.append(BlockCheck(cell=cell, p=p, worst=worst, z=z_worst, tests=tests, contrast=contrast))
    out += [BlockCheck(cell=cell, p=1e-12, worst=0, z=40.0) for cell in evaluation.exact]
    return sorted(out, key=lambda b: (b.p, -abs(b.z)))


def failing(checks: Sequence[BlockCheck], level: float = FALSE_ALARM) -> list[BlockCheck]:
    """The checks that fail by Holm's correction at a familywise level, by p-value.

    The shares of the level are those of `compare`.

    Args:
        level: probability that a right model fails any.
    """
    kinds = ["" if block.cell[0] else "light" if block.cell == LIGHT else "rate" for block in checks]
    found = holm([block.p for block in checks], kinds, [block.tests for block in checks], level)
    return sorted((checks[i] for i in found), key=lambda block: (block.p, -abs(block.z)))
