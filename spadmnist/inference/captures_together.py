"""Deviations that no capture shows by itself: the checks of one statistic in several captures together.

There are three. Cells that deviate alike add up to one normal score each, sum z / sqrt(captures) (Stouffer et al., The
American Soldier 1 (1949) 45): an echo, crosstalk, rows. So do the scores of contrasts, of captures of any length: a
lamp that is brighter at the start of each. What has another pattern in each capture, as a lamp that fluctuates, adds up
in its squares, sum z^2 over the cells of all captures, whose law is a gamma law with their mean and variance. All are
judged against the model's own replicates. A capture that shows a deviation clearly by itself has its own check, and is
left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from .contrasts import Contrasts, p_of_scores
from .levels import CLEARLY
from .null_distribution import Null, p_of_squares, tail_of, widening
from .replicates import TOTALS, Cell, Replicates

if TYPE_CHECKING:
    from .evaluation import Evaluation

_LEAST = 1e-300  # in place of a mean square of 0: near the least number of a double


@dataclass(frozen=True)
class Together:
    """The check of one statistic in several captures together.

    Attributes:
        cell: the block of the capture with the most detections, of all that have the statistic. The check belongs to it
            whatever the data are, so that a check that fails under two models is known as the same.
        p: p-value; 1 where fewer than two captures are left.
        worst: the cell that shows it most; z: its residual, of all captures where they deviate alike.
        cells: the blocks that are taken together, that in which it deviates most first.
        alike: whether the same cells deviate in all captures; otherwise the squares are added.
        excess: excess chi square of all captures.
        contrast: the index of the contrast, where one decides.
    """

    cell: Cell
    p: float = 1.0
    worst: int = 0
    z: float = 0.0
    cells: tuple[Cell, ...] = ()
    alike: bool = True
    excess: float = 0.0
    contrast: int | None = None

    @property
    def clearest(self) -> Cell:
        """The block that deviates most."""
        return self.cells[0] if self.cells else self.cell

    @property
    def words(self) -> str:
        """The words behind a place, for the captures that deviate there."""
        number = len(self.cells)
        if self.alike:
            return f", alike in {number} captures"
        return f", the clearest of {number} captures that scatter too much"


def checks_together(
    replicates: Replicates, evaluation: Evaluation, residuals: Mapping[Cell, np.ndarray], alone: Mapping[Cell, float]
) -> list[Together]:
    """The checks of several captures together: of each statistic one of the squares, and one for each set of cells.

    A statistic with contrasts has one more. The number of checks and the blocks that they belong to depend on the model
    and the plan, not on the data.

    Args:
        residuals: (cells,) of the data, by block.
        alone: p-value of each block by itself.
    """
    out = []
    for by_place, judge in ((True, _alike), (False, _in_squares)):
        for cells in _groups(replicates, residuals, by_place):
            out.append(_judged(replicates, evaluation, cells, residuals, alone, judge))
    for cells in _groups(replicates, residuals, by_place=False):
        sizes = {cell: len(c.patterns) for cell in cells if (c := evaluation.nulls[cell].contrasts) is not None}
        some = [cell for cell, size in sizes.items() if size == next(iter(sizes.values()))]
        if len(some) > 1:
            out.append(_judged(replicates, evaluation, some, residuals, alone, _along_contrasts))
    return out


def _judged(
    replicates: Replicates,
    evaluation: Evaluation,
    cells: list[Cell],
    residuals: Mapping[Cell, np.ndarray],
    alone: Mapping[Cell, float],
    judge: Callable[[Evaluation, Cell, list[Cell], Mapping[Cell, np.ndarray]], Together],
) -> Together:
    """The check of these blocks by one of the three ways, without those that are clear by themselves."""
    host = max(cells, key=lambda cell: replicates.seen[cell[0]].total)
    some = [cell for cell in cells if alone[cell] >= CLEARLY and evaluation.nulls[cell].replicate_squares.any()]
    return judge(evaluation, host, some, residuals) if len(some) > 1 else Together(host)


def _groups(replicates: Replicates, residuals: Mapping[Cell, np.ndarray], by_place: bool) -> list[list[Cell]]:
    """The blocks of each statistic in at least two captures.

    Args:
        by_place: only captures with the same cells are taken together: at the same places, or of equal number where
            they have none.
    """
    groups: dict[tuple[object, ...], list[Cell]] = {}
    for cell, z in residuals.items():
        if cell == TOTALS or not z.size:
            continue
        axis = replicates.seen[cell[0]].summaries[cell[1]].axis
        place = None if axis is None else np.asarray(axis, np.float64).tobytes()
        groups.setdefault((cell[1], z.size, place) if by_place else (cell[1],), []).append(cell)
    return [cells for cells in groups.values() if len(cells) > 1]


def _alike(evaluation: Evaluation, host: Cell, cells: Sequence[Cell], residuals: Mapping[Cell, np.ndarray]) -> Together:
    """The check of cells that deviate alike in several captures."""
    z = _sum([residuals[cell] for cell in cells]) / math.sqrt(len(cells))
    law = evaluation.once(("sums", *cells), lambda: _law_of_sums(evaluation, cells))
    p, worst, contrast = law.p_value(z)
    most = float(z[worst])
    pattern, beyond = np.zeros(z.size), max(most**2, float(z @ z) - z.size)
    pattern[worst] = most
    if law.contrasts is not None and contrast is not None:
        pattern = law.contrasts.clearest(z).pattern
        beyond = max(beyond, float(pattern @ z) ** 2)
    order = sorted(cells, key=lambda cell: -float(pattern @ residuals[cell]))
    return Together(
        cell=host, p=p, worst=worst, z=most, cells=tuple(order), alike=True, excess=beyond, contrast=contrast
    )


def _law_of_sums(evaluation: Evaluation, cells: Sequence[Cell]) -> Null:
    """The null distribution of cells that are summed over captures, from the sums of the replicates."""
    sums = _sum([_of_replicates(evaluation, cell) for cell in cells]) / math.sqrt(len(cells))
    null = evaluation.nulls[cells[0]]
    contrasts = null.contrasts
    if contrasts is not None:
        contrasts = Contrasts.learnt(contrasts.patterns, sums, len(sums) - 1)
    return replace(
        null, replicate_squares=np.mean(sums**2, axis=1), tail=tail_of(sums), recordings=len(sums), contrasts=contrasts
    )


def _of_replicates(evaluation: Evaluation, cell: Cell) -> np.ndarray:
    """The residuals of the replicates, scattering as those of other recordings do, (replicates, cells).

    Each replicate informs its own expectation and scatter: its residuals are too small by a few per cent.
    """
    residuals, null = evaluation.replicate_residuals[cell], evaluation.nulls[cell]
    return residuals * math.sqrt(float(null.replicate_squares.mean()) / max(float(np.mean(residuals**2)), _LEAST))


def _along_contrasts(
    evaluation: Evaluation, host: Cell, cells: Sequence[Cell], residuals: Mapping[Cell, np.ndarray]
) -> Together:
    """The check of contrasts that deviate alike in several captures, whatever the length of their blocks."""
    known = {cell: null.contrasts for cell in cells if (null := evaluation.nulls[cell]).contrasts is not None}
    scores = {cell: contrasts.scores(residuals[cell]) for cell, contrasts in known.items()}

    def scatter_of_sums() -> tuple[np.ndarray, int]:
        own = [contrasts.scores(_of_replicates(evaluation, cell)) for cell, contrasts in known.items()]
        number = min(map(len, own))
        sums = _sum([one[:number] for one in own]) / math.sqrt(len(own))
        return np.maximum(np.sqrt(np.mean(sums**2, axis=0)), 1.0), max(number - 1, 1)

    scatter, freedom = evaluation.once(("contrasts", *cells), scatter_of_sums)
    sums = _sum(list(scores.values())) / math.sqrt(len(scores)) / scatter
    p, k = p_of_scores(sums, freedom)
    order = sorted(known, key=lambda cell: -float(np.sign(sums[k]) * scores[cell][k]))
    first = residuals[order[0]]
    worst = int(np.argmax(np.sign(sums[k]) * known[order[0]].patterns[k] * first))
    return Together(
        cell=host,
        p=p,
        worst=worst,
        z=float(first[worst]),
        cells=tuple(order),
        alike=True,
        excess=float(sums[k]) ** 2,
        contrast=k,
    )


def _in_squares(
    evaluation: Evaluation, host: Cell, cells: Sequence[Cell], residuals: Mapping[Cell, np.ndarray]
) -> Together:
    """The check of the squares of all cells of several captures."""
    square = sum(float(residuals[cell] @ residuals[cell]) for cell in cells)
    sizes = {cell: residuals[cell].size for cell in cells}
    mean, variance = evaluation.once(("squares", *cells), lambda: _moments_of_squares(evaluation, sizes))
    p = p_of_squares(square, mean, variance)
    # the scatter of its cells makes a capture clear, relative to that of other recordings
    order = sorted(
        cells,
        key=lambda cell: -float(np.mean(residuals[cell] ** 2)) / float(evaluation.nulls[cell].replicate_squares.mean()),
    )
    first = residuals[order[0]]
    worst = int(np.argmax(np.abs(first)))
    return Together(
        cell=host,
        p=p,
        worst=worst,
        z=float(first[worst]),
        cells=tuple(order),
        alike=False,
        excess=max(square - mean, 0.0),
    )


def _moments_of_squares(evaluation: Evaluation, sizes: Mapping[Cell, int]) -> tuple[float, float]:
    """(mean, variance) of the sum of squares of several captures; they may share a chip, so that squares rise together.

    Args:
        sizes: number of cells of each block.
    """
    nulls = {cell: evaluation.nulls[cell] for cell in sizes}
    mean = sum(size * nulls[cell].moments_of_squares(size)[0] for cell, size in sizes.items())
    # at least that of independent captures, which the law of their cells bounds
    apart = sum(size**2 * nulls[cell].moments_of_squares(size)[1] for cell, size in sizes.items())
    number = min(len(null.replicate_squares) for null in nulls.values())
    together = _sum([size * nulls[cell].replicate_squares[:number] for cell, size in sizes.items()])
    return mean, max(apart, float(together.var(ddof=1)) * widening(number))


def _sum(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """The sum of arrays, without a copy of all of them."""
    out = arrays[0].copy()
    for array in arrays[1:]:
        out += array
    return out
