"""The other candidates of a step, with the misfit that each leaves; those within a tie of it are called confused."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from .checks import block_checks, failing
from .evaluation import Evaluation, mean_misfit
from .replicates import Replicates
from .results import plain
from .scan import Scan
from .signature import residuals_at
from .trial import Trial, at_end, is_open, tie

# alternatives of a step that its answer names, at most; a rule of thumb
_NAMED = 4
# of the evidence for a shape at the end of its range: a candidate with more is confused with it, because another law
# may be the right one. Slow afterpulsing had been explained as the fast one; the value is a rule of thumb
_ALMOST = 0.8


def alternatives(scan: Scan, evaluation: Evaluation, best: Trial, second: Sequence[Trial]) -> list[dict[str, Any]]:
    """The other candidates with the misfit that each leaves, ties first, for the JSON data."""
    out: list[dict[str, Any]] = []
    for one in second:
        if (
            one is best
            or one.candidate in best.candidates
            or any(o["tried"].candidate.name == one.candidate.name for o in out)
        ):
            continue
        with scan.if_possible(one.candidate, "comparing it with the best", wholly=False):
            out.append(_alternative(scan.replicates, evaluation, best, one))
    return sorted(out, key=lambda other: not other["confused"])[:_NAMED]


def _alternative(replicates: Replicates, evaluation: Evaluation, best: Trial, one: Trial) -> dict[str, Any]:
    residuals = one.residuals or residuals_at(replicates, evaluation, one.signature, one.times, noisy=True)
    judged, left = evaluation, residuals
    if one.evaluation is not None:  # by its own scatter
        judged, left = one.evaluation, one.evaluation.residuals
    failed = failing(block_checks(replicates, judged, left))
    # the evidence for a few odd pixels may be small, because the model with them has wide cells
    most, this = best.evidence, max(one.evidence, one.fall) if one.chips and judged is not evaluation else one.evidence
    near = most - this < tie(most) or (at_end(best) and this > _ALMOST * most)
    # pixels that were hit at random are a map by another name where nothing shows how they change with time. A map of a
    # few odd pixels has much less evidence than its fall: it fits every pixel
    near = near or (best.chips and one.maps is not None and is_open(best) and one.fall > _ALMOST * most)
    return {
        "change": one.candidate.kind,
        "effect": one.candidate.effect,
        "parameter": one.candidate.parameter,
        "misfit": plain(mean_misfit(evaluation.replicate_residuals, residuals)),
        "confused": one.evidence > -math.inf and near and not failed,
        "tried": one,
    }
