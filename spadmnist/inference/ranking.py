"""The ranking of fitted trials: each is judged by its own scatter."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import SpadError
from ..statistics import Statistic
from .evaluation import Evaluation, block_checks, evaluate, failing, log_likelihood_ratio
from .levels import LEAST_GAIN, PROMISING
from .replicates import TOTALS
from .score_test import sigmas_of
from .signature import Signature, template_of
from .trial import Trial, is_pattern, tie
from .trial_fits import evaluation_of, optimism

if TYPE_CHECKING:
    from .scan import Scan

_REFINED = 3  # the largest number of trials that are fitted
_MOSTLY = 0.5  # of the squares of a signature
_MOVED = 0.3  # standard deviations: the shift beyond which a cell counts


def worth_fitting(scan: Scan, second: Sequence[Trial]) -> list[Trial]:
    """The trials that may be best when they are fitted.

    With random odd pixels, a map of the pixels is fitted as well, though its small differences are hardly visible
    here. With a map, random odd pixels are fitted as well, though no strength suits each pixel.

    Args:
        second: the trials of the second look, by gain.
    """
    best = max(t.gain for t in second)
    first = second[0]
    out = [first, *(t for t in second[1:] if t.gain > 0.4 * best)][:_REFINED]
    chips, maps = (any(x) for x in zip(*((t.chips, _of_pixels(t)) for t in out), strict=True))
    more = [t for t in second if (chips and _of_pixels(t)) or (maps and t.chips and t.fell > PROMISING)]
    return out + [t for t in more if all(t is not one for one in out)]


def compare_by_squares(scan: Scan, evaluation: Evaluation, refined: Sequence[Trial]) -> None:
    """Set the gains of those trials that may be best by evaluations of their own: few replicates blur an edge.

    They are compared in the cells that one of them moves, so that noise in all others does not decide. Trials whose
    replicates scatter more are left out, because squares do not judge them.
    """
    known = [t for t in refined if t.maps is None and t.residuals is not None and not t.scatters]
    most = max((t.gain for t in known), default=0.0)
    near = [t for t in known if most - t.gain < tie(most)]
    if len(near) < 2:
        return
    costs: dict[int, float] = {}
    evaluations: list[tuple[Trial, Evaluation]] = []
    for one in near:
        with contextlib.suppress(SpadError):  # what cannot be simulated in every capture keeps its gain
            evaluations.append((one, evaluation_of(scan.replicates, one)))
    if len(evaluations) < 2:
        return
    for cell, z in evaluation.residuals.items():
        if any(len(there.residuals.get(cell, ())) != len(z) for _, there in evaluations):
            continue
        moved = np.any([np.abs(one.residuals[cell] - z) > _MOVED for one, _ in evaluations if one.residuals], axis=0)
        for one, there in evaluations:
            left = there.residuals[cell][moved]
            costs[id(one)] = costs.get(id(one), optimism(one)) + float(left @ left)
    best = min((one for one, _ in evaluations), key=lambda one: costs[id(one)])
    for one, _ in evaluations:
        one.gain = best.gain - (costs[id(one)] - costs[id(best)])


def best_of(scan: Scan, refined: Sequence[Trial], merit: Callable[[Trial], Any]) -> Trial:
    """The best of some fitted candidates; a pattern, which is the first, where it gains anything.

    Squares do not decide between random odd pixels and a map, because a map has a parameter for each pixel. The one
    with fewer failing checks is better; with as many, the map is, because random properties of one chip are a map.

    Args:
        merit: trial -> its gain.
    """
    first = refined[0]
    best = first if is_pattern(first) and merit(first) >= LEAST_GAIN else max(refined, key=merit)
    rivals = [t for t in refined if t.chips or _of_pixels(t)]
    if best not in rivals or len({t.chips for t in rivals}) < 2:
        return best
    left = {}
    for one in rivals:
        evaluation = evaluation_of(scan.replicates, one)
        left[id(one)] = len(failing(block_checks(scan.replicates, evaluation, evaluation.residuals)))
    return min(rivals, key=lambda t: (left[id(t)], t.chips, -t.gain))


def least_probable(
    scan: Scan, evaluation: Evaluation, refined: Sequence[Trial], judged: Callable[[Trial], tuple[float, float]]
) -> tuple[Trial, float, float]:
    """(the best of some faint candidates, its significance, its p-value); the smallest p-value decides.

    A pattern that is first stays so. Where random odd pixels are best and counts carry their signature, a map says
    the same with the same p-value.

    Args:
        judged: trial -> (significance, p-value).
    """
    best = refined[0] if is_pattern(refined[0]) else min(refined, key=lambda t: judged(t)[1])
    maps = [t for t in refined if _of_pixels(t)]
    judged_by = best
    if best.chips and maps and _share_of_counts(scan, evaluation, best.signature) > _MOSTLY:
        best = min(maps, key=lambda t: judged(t)[1])
    return best, *judged(judged_by)


def _share_of_counts(scan: Scan, evaluation: Evaluation, signature: Signature) -> float:
    """The share of a signature's square in statistics of counts that compare no detections with each other."""
    squares = {
        cell: float(t @ t) for cell, t in template_of(scan.replicates, evaluation, signature).items() if cell != TOTALS
    }
    counts = sum(x for (_, name), x in squares.items() if Statistic.registry.find(name).among == "")
    return counts / max(sum(squares.values()), 1e-300)


def gain_by_own_scatter(scan: Scan, evaluation: Evaluation, one: Trial) -> float:
    """Twice the log-likelihood ratio of a candidate, each cell by its own model's scatter, where it has a signature."""
    there = evaluate(scan.replicates, {}, evaluation.sensors.changed(one.scaled(), None, True))
    return log_likelihood_ratio(
        evaluation, there, template_of(scan.replicates, evaluation, one.signature.at(one.times))
    )


def _of_pixels(one: Trial) -> bool:
    """Whether it is a map of pixels."""
    return one.maps is not None and one.candidate.per == "pixel"


def gain_against(one: Trial, other: Trial) -> float:
    """The gain of a candidate, for the comparison with another one.

    Against random odd pixels, a map pays the price of its many parameters.
    """
    if not (other.chips and one.maps and one.chance is not None):
        return one.gain
    # maps of earlier steps are left out
    price = sum(one.maps[c.carrier].price for c in one.candidates if c.carrier in one.maps)
    return min(one.gain, max(one.gain - price, sigmas_of(one.chance) ** 2))
