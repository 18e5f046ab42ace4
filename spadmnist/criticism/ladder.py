"""The ladder of errors: one row for each model, its misfit and its physical errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from . import checks
from .answer import Step, plain, title
from .candidates import Change, Key
from .fit import RATES, Bench, Cell, Moved, State
from .settling import Settled
from .tried import Phases, Tried

_CLEAR = 3.5  # standard deviations beyond which a single cell is an error of the model


@dataclass(frozen=True)
class Mapped:
    """What maps of pixels are settled from, beside what data there are: see `mapping.sensors_with`."""

    values: dict[Key, Any]
    held: list[Change]
    phases: Phases
    chips: bool


@dataclass
class Rung:
    """A model of the ladder. left: the residuals by which it is judged; settled: its numbers, where it has any.

    steps: those that it adds. placebo: of an effect that has nothing to do with it, what it sets beside `state`.
    """

    model: str
    state: State = field(repr=False)
    misfit: float
    errors: dict[str, float]
    left: dict[Cell, np.ndarray] = field(repr=False)
    settled: Settled | None = field(default=None, repr=False)
    steps: list[Step] = field(default_factory=list, repr=False)
    maps: Mapped | None = None
    placebo: dict[Key, Any] | None = None

    @property
    def row(self) -> dict[str, Any]:
        """As `formats` has it."""
        placebo = self.placebo is not None
        return {"model": self.model, "misfit": plain(self.misfit), "errors": self.errors, "placebo": placebo}


def errors_of(
    bench: Bench, state: State, residuals: Mapping[Cell, np.ndarray], shift: Moved | None = None
) -> dict[str, float]:
    """Physical errors of a model: relative, 1; the light's own uncertainty and the noise are no errors of the model.

    mean_rate: rms of the captures' rates; linearity: the largest of the lit ones beside the others; map: rms of the
    pixels; intervals: share of the intervals that stand elsewhere; neighbours: share of detections whose neighbours
    fire too often or too seldom. shift: of a model that was not simulated itself.
    """
    ids, slopes, _, common = bench.rate_space(state)
    errors = {"mean_rate": 0.0, "linearity": 0.0}
    if ids:
        logs = {i: math.log(max(s.total, 0.5)) for i, s in bench.seen.items()}
        x = bench.levels(state, ids, logs)
        if shift is not None:
            x = x + np.array([shift.logs.get(i, 0.0) for i in ids])
        lit = np.array([not bench.seen[i].capture.light.dark for i in ids], bool)
        width = float(common.max())
        if lit.any() and width > 0:
            weight = 1 / np.array([bench.level_error(state, i) for i, on in zip(ids, lit, strict=True) if on]) ** 2
            light = float(weight @ x[lit]) / float(weight.sum() + 1 / width**2)
            x = x - light * lit
        errors["mean_rate"] = float(np.sqrt(np.mean((x * slopes) ** 2)))
        if lit.any():
            errors["linearity"] = float(np.max(np.abs((x[lit] - np.median(x[lit])) * slopes[lit])))
    shares: dict[str, list[float]] = {"map": [], "intervals": [], "neighbours": []}
    for cell, z in residuals.items():
        if cell == RATES:
            continue
        id, name = cell
        seen, null = bench.seen[id], state.nulls[cell]
        expected = null.expected(seen.total)[0] + (shift.shifts.get(cell, 0.0) if shift else 0.0)
        values = seen.summaries[name].values
        if name == "pixel_map":
            beyond = max(0.0, float(np.mean(z**2)) - 1) / max(float(np.mean(values)), 1.0)
            shares["map"].append(math.sqrt(beyond))
        elif name == "intervals":
            raw = np.abs(values - expected).sum() - 0.8 * np.sqrt(np.maximum(expected, 0)).sum()
            shares["intervals"].append(max(0.0, float(raw)) / 2 / max(float(values.sum()), 1.0))
        elif name == "neighbours":
            k = int(np.argmax(np.abs(z)))
            far = abs(float(values[k] - expected[k])) if abs(z[k]) > _CLEAR else 0.0
            shares["neighbours"].append(far / max(seen.total, 1.0))
    whole = errors | {k: float(np.mean(v)) if v else 0.0 for k, v in shares.items()}
    return {k: plain(v) for k, v in whole.items()}


def placebo_of(bench: Bench, state: State, tried: Sequence[Tried], best: Tried, named: set[str]) -> Rung | None:
    """What an effect does that has nothing to do with it: as many numbers as the best one, at its best strength.

    named: effects that were found, or are as likely; of the others, the one in the middle of the ranking.
    """
    usable = [
        t for t in tried if t.change.effect not in named and t.change.kind == "add" and (t.moved.shifts or t.moved.logs)
    ]
    alike = [t for t in usable if len(t.change.dials) == len(best.change.dials)] or usable
    if not alike:
        return None
    one = alike[len(alike) // 2]
    times = one.times if one.gain > 0 else 0.0
    residuals = bench.residuals(state, one.moved, times)
    errors = errors_of(bench, state, residuals, one.moved.at(times))
    values = one.scaled() if times else {}
    misfit = checks.misfit(state.own, residuals)
    return Rung(f"placebo: {title(one.change)}", state, misfit, errors, residuals, placebo=values)
