"""The error budget (ladder): one row for each model, its misfit and its physical errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .. import plugins
from ..errors import EffectError
from ..statistics import Statistic
from .candidates import Candidate
from .coordinates import Key
from .evaluation import Evaluation, mean_misfit
from .gauss_newton import Fit
from .light_levels import level_error, log_levels, stated_levels
from .replicates import TOTALS, Cell, Replicates
from .results import Step, plain, title
from .signature import Signature, residuals_at
from .trial import Phases, Trial

_MOST = 50.0  # of a logarithm, at most: a larger ratio says no more, and would overflow; a rule of thumb


@dataclass(frozen=True)
class HeldMaps:
    """What the maps of pixels are fitted from, besides the data: see `map_models.models_with_maps`."""

    values: dict[Key, Any]
    held: list[Candidate]
    phases: Phases
    chips: bool


@dataclass
class Rung:
    """A row of the error budget.

    Attributes:
        errors: relative, by name; see `physical_errors`.
        left: (cells,) the residuals by which the model is judged, by block.
        fit: of its coordinates, where it has any.
        steps: those that the model adds.
        maps: how its maps are fitted.
        placebo: the values that a placebo sets in the model of `evaluation`; None of all other models.
    """

    model: str
    evaluation: Evaluation = field(repr=False)
    misfit: float
    errors: dict[str, float]
    left: dict[Cell, np.ndarray] = field(repr=False)
    fit: Fit | None = field(default=None, repr=False)
    steps: list[Step] = field(default_factory=list, repr=False)
    maps: HeldMaps | None = None
    placebo: dict[Key, Any] | None = None

    @property
    def row(self) -> dict[str, Any]:
        """The row for the JSON data."""
        placebo = self.placebo is not None
        return {"model": self.model, "misfit": plain(self.misfit), "errors": self.errors, "placebo": placebo}


def physical_errors(
    replicates: Replicates,
    evaluation: Evaluation,
    residuals: Mapping[Cell, np.ndarray],
    shift: Signature | None = None,
    strict: bool = False,
) -> dict[str, float]:
    """The physical errors of a model, relative, by name; of what was not measured there is none.

    The light's uncertainty and the noise are no errors of the model. mean_rate: rms of the captures' rates relative to
    those of the model, less 1, beyond that of their noise. linearity: the largest deviation of a lit capture from the
    median of the other ones, its noise included. The others are those of statistics (`Statistic.physical_error`), in
    the mean over the captures.

    Args:
        residuals: (cells,) by block.
        shift: the signature of a model that was not simulated itself.
        strict: a user's statistic that fails is an error; otherwise its number is left out, because no result of a
            search depends on it.
    Raises:
        EffectError: where a user's statistic fails, if `strict`.
    """
    ids, elasticities, common = stated_levels(replicates, evaluation)
    errors = {}
    if ids:
        logs = {i: math.log(max(s.total, 0.5)) for i, s in replicates.seen.items()}
        x = log_levels(replicates, evaluation, ids, logs)
        if shift is not None:
            x = x + np.array([shift.logs.get(i, 0.0) for i in ids])
        lit = np.array([not replicates.seen[i].capture.light.dark for i in ids], bool)
        width = float(common.max())
        noise = np.array([level_error(replicates, evaluation, i) for i in ids])
        if lit.any() and width > 0:
            weight = 1 / noise[lit] ** 2
            light = float(weight @ x[lit]) / float(weight.sum() + 1 / width**2)
            x = x - light * lit
        errors["mean_rate"] = rms_beyond_noise(relative(x * elasticities), noise * elasticities)
        if lit.sum() > 1:
            errors["linearity"] = float(np.max(np.abs(relative(from_the_others(x[lit]) * elasticities[lit]))))
    shares: dict[str, list[float]] = {}
    for cell, z in residuals.items():
        if cell == TOTALS or not (statistic := Statistic.registry.find(cell[1])).error:
            continue
        seen, null = replicates.seen[cell[0]], evaluation.nulls[cell]
        expected = null.expected(seen.total)[0] + (shift.shifts.get(cell, 0.0) if shift else 0.0)
        try:
            with plugins.blaming(statistic):
                error = float(statistic.physical_error(seen.summaries[cell[1]].values, expected, z, seen.detections))
                if not math.isfinite(error):
                    raise ValueError(f"physical_error must be a finite number, not {error}")
        except EffectError:
            if strict:
                raise
            continue
        shares.setdefault(statistic.error, []).append(error)
    whole = errors | {k: float(np.mean(v)) for k, v in shares.items()}
    return {k: plain(v) for k, v in whole.items()}


def relative(logs: np.ndarray) -> np.ndarray:
    """A deviation measured / expected - 1 of its logarithm."""
    return np.expm1(np.clip(logs, -_MOST, _MOST))


def rms_beyond_noise(deviations: np.ndarray, noise: np.ndarray) -> float:
    """The root mean square of deviations beyond that of their noise, at least 0.

    Args:
        noise: its standard deviation, as `deviations`.
    """
    return math.sqrt(max(float(np.mean(deviations**2 - noise**2)), 0.0))


def from_the_others(values: np.ndarray) -> np.ndarray:
    """The deviation of each of at least two values from the median of the others."""
    return np.array([x - np.median(np.delete(values, i)) for i, x in enumerate(values)])


def placebo_of(
    replicates: Replicates, evaluation: Evaluation, tried: Sequence[Trial], best: Trial, named: set[str]
) -> Rung | None:
    """The row of a placebo: an unrelated effect with as many coordinates as the best one, at its best strength.

    Args:
        named: effects that were found, or are a tie; of the others, the one in the middle of the ranking is taken.
    """
    usable = [
        t
        for t in tried
        if t.candidate.effect not in named and t.candidate.kind == "add" and (t.signature.shifts or t.signature.logs)
    ]
    alike = [t for t in usable if len(t.candidate.coordinates) == len(best.candidate.coordinates)] or usable
    if not alike:
        return None
    one = alike[len(alike) // 2]
    times = one.times if one.fall > 0 else 0.0
    residuals = residuals_at(replicates, evaluation, one.signature, times)
    errors = physical_errors(replicates, evaluation, residuals, one.signature.at(times))
    values = one.scaled() if times else {}
    misfit = mean_misfit(evaluation.replicate_residuals, residuals)
    return Rung(
        model=f"placebo: {title(one.candidate)}",
        evaluation=evaluation,
        misfit=misfit,
        errors=errors,
        left=residuals,
        placebo=values,
    )
