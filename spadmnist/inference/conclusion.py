"""The diagnosis that a search ends with: verdict, steps, what remains unexplained, limits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ..effects import Mimic
from .checks import BlockCheck
from .comparison import Comparison
from .error_budget import Rung
from .evaluation import Evaluation, mean_misfit, misfit_null_95
from .findings import failing_of, levels_of, nuisances, remainder, traces
from .levels import HALF_95
from .model_path import ModelPath
from .results import Diagnosis, Step, Value, plain
from .trial import Trial

# as `upper_limits.upper_limits` returns them
Limits = tuple[list[dict[str, Any]], list[dict[str, Any]], list[dict[str, Any]]]


@dataclass
class Notes:
    """What a diagnosis reports in addition to its steps.

    Attributes:
        setup: entries of the set-up.
        explained: the set-up explains the totals that fail.
        by_totals: the entries that the totals gave.
        faulty: in words, the captures of which the set-up explains the totals.
        taken_back: (`bent`, `advice`) of a set-up that steps explain.
        bent: a nonlinearity that no effect here has may explain them as well.
        advice: captures that would separate explanations.
        rival: a change of the sensor that is a tie with the set-up.
        shared: captures whose wrong level the rival needs as well; none where it explains the totals alone.
        placebo: the row of the placebo.
        tried: the last trials of the candidates.
        looked: the evaluation under which they were tried in all captures.
        second: the trials of the last second look.
        waiting: groups of them that do not compete with the step that was added.
    """

    setup: list[dict[str, Any]]
    explained: bool = False
    by_totals: list[dict[str, Any]] = field(default_factory=list)
    faulty: str = ""
    taken_back: tuple[bool, list[dict[str, Any]]] | None = None
    bent: bool = False
    advice: list[dict[str, Any]] = field(default_factory=list)
    rival: Trial | None = None
    shared: tuple[str, ...] = ()
    placebo: Rung | None = None
    tried: list[Trial] = field(default_factory=list)
    looked: Evaluation | None = None
    second: list[Trial] = field(default_factory=list)
    waiting: list[list[Trial]] = field(default_factory=list)


def left_over(path: ModelPath, notes: Notes) -> list[BlockCheck]:
    """The checks that fail with all steps; none where these are totals that the set-up explains.

    Where the levels that it explains are free, totals that fail are those of other captures.
    """
    left = path.failed
    among = notes.explained and not path.replicates.unstated
    return [] if among and all(b.cell[0] == "" for b in left) else left


def so_far(path: ModelPath, notes: Notes) -> Diagnosis:
    """The diagnosis while the search goes on."""
    verdict = verdict_of(path, left_over(path, notes), notes)
    null_95 = misfit_null_95(path.ladder[0].evaluation.replicate_residuals)
    found = answer(path, notes, verdict, LastLook(path.ladder, null_95))
    found.steps = [replace(step, alternatives=[public(other) for other in step.alternatives]) for step in path.steps]
    found.finished = False
    found.untried = [*found.untried, not_done("further steps", "the search goes on")]
    return found


def unexplained_by(path: ModelPath, in_sample: Comparison | None = None) -> list[dict[str, Any]]:
    """What the steps leave unexplained, for the JSON data; the nearest candidates are alternatives of the first.

    Args:
        in_sample: the comparison of the model, whose failing checks are listed where no other one fails.
    """
    found = remainder(path.replicates, path.evaluation, path.evaluation.residuals) or failing_of(in_sample)
    if found and path.nearest:
        found[0]["alternatives"] = [_nearest(step) for step in path.nearest]
    return found


def _nearest(step: Step) -> dict[str, Any]:
    """The entry of a step that explains too little of its own cells, as an alternative of what is unexplained."""
    c = step.candidate
    misfit = plain(step.misfit)
    return {"change": c.kind, "effect": c.effect, "parameter": c.parameter, "misfit": misfit, "nearest": True}


def public(alternative: dict[str, Any]) -> dict[str, Any]:
    """An alternative as it stands in the JSON data, without what only the search needs."""
    return {key: x for key, x in alternative.items() if key not in ("confused", "tried")}


def not_done(where: str, why: str) -> dict[str, Any]:
    """An entry of `not_tried` that is of no candidate."""
    return {"change": None, "effect": None, "parameter": None, "where": where, "why": why}


@dataclass(frozen=True)
class LastLook:
    """What is measured once there are no further steps.

    Attributes:
        rungs: the rows of the table of steps.
        null_95: 95 % of the misfits of a right model lie below.
        limits: as `upper_limits.upper_limits` returns them.
        in_sample: the comparison of the model with its steps; None where there is none.
    """

    rungs: Sequence[Rung]
    null_95: float
    limits: Limits = field(default_factory=lambda: ([], [], []))
    in_sample: Comparison | None = None


def answer(path: ModelPath, notes: Notes, verdict: str, last: LastLook) -> Diagnosis:
    """The diagnosis.

    Args:
        last: what is measured at the end; of a search that goes on, the rows so far.
    """
    replicates = path.replicates
    remains = verdict in ("unexplained", "partly_explained") or (verdict == "confused" and not path.steps)
    excluded, invisible, unlimited = last.limits
    path.locate()
    return Diagnosis(
        sensor=replicates.start.name,
        measurement=replicates.measurement.name,
        verdict=verdict,
        before=last.rungs[0].misfit,
        after=(path.ladder[-1] if path.steps else path.ladder[0]).misfit,
        null_95=last.null_95,
        # of the last values, where they were compared: the evaluation may be that of values near them
        nuisances=nuisances(replicates, path.evaluation) if last.in_sample is None else levels_of(last.in_sample),
        steps=path.steps,
        setup=notes.setup,
        unexplained=unexplained_by(path, last.in_sample) if remains else [],
        ladder=[rung.row for rung in last.rungs],
        advice=notes.advice,
        excluded=excluded,
        invisible=invisible,
        unlimited=unlimited,
        traces=traces(replicates, path.start, path.evaluation, path.steps),
        values=path.sensor_values,
        simulations=replicates.simulations,
        dark=replicates.dark,
        crop=str(replicates.start.window) if replicates.start.window else None,
        untried=path.scan.untried,
        in_sample=last.in_sample,
        finished=path.finished,
        shape=replicates.start.layout.shape,
    )


def verdict_of(path: ModelPath, left: Sequence[BlockCheck], notes: Notes) -> str:
    """The verdict on the steps so far.

    Args:
        left: the checks that fail with them.
    """
    if notes.rival is not None:
        return "confused"
    if left:
        return "partly_explained" if path.steps else "unexplained"
    if path.steps:
        return "explained"
    if notes.bent:
        return "confused"
    return "setup" if notes.setup else "adequate"


def too_short(short: Mapping[str, tuple[float, float]]) -> list[dict[str, Any]]:
    """The entries of captures that stopped early.

    Args:
        short: (share that was exposed, its standard deviation) by capture.
    """
    out = []
    for id, (share, error) in short.items():
        factor = {"value": plain(share), "low": plain(share - HALF_95 * error), "high": plain(share + HALF_95 * error)}
        out.append({"capture": id, "quantity": "exposure", "factor": factor, "confused": False})
    return out


def rival_step(path: ModelPath, rival: Trial, faulty: str) -> Step:
    """A change of the sensor that explains the totals as well as the set-up does, as a step; it is in no sensor file.

    Args:
        faulty: in words, the captures of which the set-up explains them.
    """
    coordinate = rival.candidate.strengths[0]
    low, high = rival.intervals.get(coordinate.key, (None, None))
    value = Value(value=float(rival.values[coordinate.key]), low=low, high=high, unit=coordinate.unit)
    left = mean_misfit(path.evaluation.replicate_residuals, rival.residuals or path.evaluation.residuals)
    return Step(
        candidate=rival.candidate,
        values={coordinate.parameter: value},
        misfit=left,
        significance=math.sqrt(max(rival.fall, 0.0)),
        material="all rates alike; the sensor file does not have it",
        alternatives=[_outside(f"the set-up of {faulty}", left)],
        in_sensor=False,
    )


def outside(mimic: Mimic, misfit: float) -> dict[str, Any]:
    """A mimic as an alternative."""
    return _outside(mimic.what, misfit)


def _outside(what: str, misfit: float) -> dict[str, Any]:
    """What no effect describes, as an alternative."""
    return {"change": "unknown", "effect": None, "parameter": None, "misfit": plain(misfit), "what": what}
