"""The evidence for a candidate: the one measure by which fitted models are compared, in chi square.

        E = 2 log(L' / L) - 2 p

L, L': quasi-likelihood of the data under the model, and under the model with the candidate, each by its own scatter;
p: the effective number of parameters that were fitted. Squares of residuals alone do not compare models of different
scatter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from ..statistics import Statistic
from . import held_out
from .evaluation import Evaluation, evaluate, log_likelihood_ratio, stacked
from .levels import OPTIMISM_OF_A_PARAMETER, PROMISING
from .replicates import TOTALS, Replicates
from .score_test import sigmas_of
from .signature import IGNORED, Signature, captures_showing, residuals_at, template_of
from .trial import Trial, is_pattern

# the largest number of trials that are fitted, random odd pixels and their map not counted; the share of the largest
# fall of the squares below which none is. Guesses: as much as a fit costs, and what nonlinearity makes of a prediction
_FITTED, NEAR = 3, 0.4
# share of a trial's score that remains once another trial is in the model: from it on, the two do not compete and are
# steps of their own; a rule of thumb
_UNMOVED = 0.9
# of the squares of a signature: the plain meaning of "it lies in counts"; a map is then as clear as odd pixels
_MOSTLY = 0.5


def evidence_of(replicates: Replicates, evaluation: Evaluation, one: Trial) -> float:
    """The evidence for a fitted trial, in chi square.

    Three ways lead to the likelihood ratio, each where its noise is least. A map has a likelihood of its own, in which
    its values are a random effect. A faint effect changes no scatter, and its own replicates would hide it: the
    squares fall as its signature, simulated stronger, says. All others are simulated as they are, where they show.

    Raises:
        SpadError: where the model with it cannot be simulated.
    """
    if one.maps is not None:
        return _evidence_of_map(one)
    if one.faint and not (one.chips or one.fluctuates):
        return one.fall - optimism(one)
    template = template_of(replicates, evaluation, (one.there or one.signature).at(one.times))
    return log_likelihood_ratio(evaluation, evaluation_of(replicates, evaluation, one), template) - optimism(one)


def _evidence_of_map(one: Trial) -> float:
    """The fall of the squares less the price of the values, or the squared significance of its own test, the larger."""
    assert one.maps is not None
    # maps of earlier steps are left out
    price = sum(one.maps[c.carrier].price for c in one.candidates if c.carrier in one.maps)
    # the squares hardly show small differences of many pixels; those of edges they do
    own = 0.0 if one.p_value is None or one.candidate.blinds else sigmas_of(one.p_value) ** 2
    return max(one.fall - price, own)


def optimism(one: Trial) -> float:
    """The optimism of a fitted trial, in chi square: the part of the fall that is due to the fit to the same data."""
    phases = OPTIMISM_OF_A_PARAMETER * len(one.phases)
    if one.fit is None or one.residuals is None:
        return phases
    if one.fluctuates:  # the light of each capture is another draw: leaving a capture out does not test the fit
        return phases + OPTIMISM_OF_A_PARAMETER * len(one.fit.coordinates)
    return phases + held_out.optimism(one.fit.residuals, one.fit)


def evaluation_of(replicates: Replicates, evaluation: Evaluation, one: Trial) -> Evaluation:
    """The evaluation of a trial's model, made once; captures that do not show the trial are not simulated.

    Args:
        evaluation: of the model without the trial.
    """
    if one.evaluation is None:
        assert one.sensors is not None
        template = template_of(replicates, evaluation, (one.there or one.signature).at(one.times))
        # a change of the scatter alone is in no template
        whole = one.fluctuates or one.chips or one.fit is None
        near = None if whole else (evaluation, captures_showing(template, *IGNORED))
        one.evaluation = evaluate(replicates, {}, one.sensors, near=near)
    return one.evaluation


def worth_fitting(second: Sequence[Trial], faint: bool = False) -> list[Trial]:
    """The trials that may be best when they are fitted; at least one, if there is any.

    The fall that random odd pixels predict is that of a model with more scatter: it excludes no other trial. Together
    with them a map of the pixels is fitted, although its small differences hardly lower the squares; together with a
    map, random odd pixels are, although no single strength fits each pixel.

    Args:
        second: the trials of the second look, by the fall of the squares; a pattern may be first.
        faint: no check fails, so that the falls are squares of scores, which no scatter makes larger.
    """
    odd = [] if faint else [t for t in second if t.chips]
    rivals = [t for t in second if all(t is not one for one in odd)]
    most = max((t.fall for t in rivals), default=0.0)
    out = [t for k, t in enumerate(rivals) if k == 0 or t.fall > NEAR * most][:_FITTED]
    maps = any(map(is_map_of_pixels, out))
    out += [t for t in odd if t.fall > PROMISING and (maps or t.fall > NEAR * most)]
    chips = any(t.chips for t in out)
    more = [t for t in second if (chips and is_map_of_pixels(t)) or (faint and maps and t.chips and t.fall > PROMISING)]
    return (out + [t for t in more if all(t is not one for one in out)]) or list(second[:1])


def competing(replicates: Replicates, evaluation: Evaluation, trials: Sequence[Trial]) -> list[list[Trial]]:
    """Groups of trials that compete with each other, in the order of their first trials.

    Two trials compete if one of them explains a part of what the other one explains. Trials that compete with the same
    trial are in one group. Maps and patterns compete with each other. Random odd pixels and fluctuating light have a
    scatter of their own, so that squares do not say what they explain: they compete with all trials. Each group is
    fitted by itself, because a later step finds what does not compete with an earlier one.
    """
    groups: list[list[Trial]] = []
    for one in trials:
        own = [g for g in groups if any(_compete(replicates, evaluation, one, other) for other in g)]
        if not own:
            groups.append([one])
            continue
        own[0] += [*(other for group in own[1:] for other in group), one]
        groups = [g for g in groups if all(g is not other for other in own[1:])]
    return groups


def apart_from(
    replicates: Replicates, evaluation: Evaluation, seen: Sequence[Trial], second: Sequence[Trial]
) -> list[Trial]:
    """The trials of the second look that explain another trace than those that were fitted, and promise enough."""
    return [
        one
        for one in second
        if one.fall > PROMISING
        and all(one is not other and not _compete(replicates, evaluation, one, other) for other in seen)
    ]


def leads(best: Trial, others: Sequence[Sequence[Trial]]) -> bool:
    """Whether no trial of other groups promises so much more that it may be the better step."""
    return best.evidence >= NEAR * max((one.fall for group in others for one in group), default=-math.inf)


def _compete(replicates: Replicates, evaluation: Evaluation, one: Trial, other: Trial) -> bool:
    """Whether the score of either trial falls once the other one is in the model."""
    if (
        one.chips
        or other.chips
        or one.fluctuates
        or other.fluctuates
        or (_over_the_array(one) and _over_the_array(other))
    ):
        return True
    keys = list(evaluation.residuals)
    z = stacked(evaluation.residuals, keys)
    templates = [stacked(template_of(replicates, evaluation, t.signature.at(t.times)), keys) for t in (one, other)]
    left = [stacked(residuals_at(replicates, evaluation, t.signature, t.times), keys) for t in (one, other)]
    scores = [(float(z @ t), float(rest @ t)) for t, rest in zip(templates, reversed(left), strict=True)]
    return any(after * before <= _UNMOVED * before**2 for before, after in scores)


def _over_the_array(one: Trial) -> bool:
    """Whether it is a map, or a pattern over the array."""
    return one.maps is not None or is_pattern(one)


def best_of(
    fitted: Sequence[Trial],
    merit: Callable[[Trial], float],
    pattern: Trial | None = None,
    margin: Callable[[float], float] = lambda merit: 0.0,
) -> Trial:
    """The fitted trial with the most merit; a pattern with evidence given a map of the pixels precedes all others.

    Where pixels differ in addition to a pattern, a map fits better than the pattern, but does not name the cause. Of
    equals a map of pixels is taken, and also in a tie with random odd pixels: it states which pixels differ, not why.

    Args:
        merit: the evidence; or what falls with the p-value, where no check fails.
        pattern: the one that `patterns_first` found, if any.
        margin: merit of the best -> the difference within which a map is as good as random odd pixels.
    """
    if pattern is not None and any(t is pattern for t in fitted):
        return pattern
    best = max(fitted, key=lambda t: (merit(t), is_map_of_pixels(t)))
    maps = [t for t in fitted if is_map_of_pixels(t) and merit(best) - merit(t) < margin(merit(best))]
    return max(maps, key=merit) if best.chips and maps else best


def judge_maps_by_odd_pixels(
    replicates: Replicates, evaluation: Evaluation, fitted: Sequence[Trial], judged: dict[int, tuple[float, float]]
) -> None:
    """Give a faint map of pixels the p-value of random odd pixels, where that is smaller.

    Where the signature of the odd pixels lies in counts that compare no detections with each other, their score is a
    sharper test of the same map.

    Args:
        judged: (significance, p-value) by the trial's id.
    """
    for odd in (t for t in fitted if t.chips):
        if share_of_counts(replicates, evaluation, odd.signature) > _MOSTLY:
            for one in filter(is_map_of_pixels, fitted):
                judged[id(one)] = min(judged[id(one)], judged[id(odd)], key=lambda x: x[1])


def share_of_counts(replicates: Replicates, evaluation: Evaluation, signature: Signature) -> float:
    """The share of a signature's square in statistics of counts that compare no detections with each other."""
    squares = {
        cell: float(t @ t) for cell, t in template_of(replicates, evaluation, signature).items() if cell != TOTALS
    }
    counts = sum(x for (_, name), x in squares.items() if Statistic.registry.find(name).among == "")
    return counts / max(sum(squares.values()), 1e-300)


def is_map_of_pixels(one: Trial) -> bool:
    """Whether it is a map of pixels."""
    return one.maps is not None and one.candidate.per == "pixel"
