"""Score tests: the data's projection on the signature of a candidate, and its p-value.

The p-value is that of a Student t, or of Hotelling's law for several directions. The smallest one over all candidates
is corrected for the number of trials on the same replicates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from ..errors import SpadError
from ..statistics import informant, informing
from . import count_model, map_fits, map_models, pixel_maps
from .candidates import Candidate
from .capture_replicates import CannotSimulate
from .coordinates import Key
from .evaluation import Evaluation, stacked
from .levels import LEAST_P
from .null_distribution import p_of_largest, p_of_scatter
from .replicates import FEW, TOTALS, Cell, Replicates
from .signature import Sampling, Signature, signatures, template_of
from .spectral_lines import Line
from .statistic_maps import p_of_width
from .trial import Trial, shape_of

# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
# of the data's projection on a signature: as much may be the noise of a few replicates, so that a step too faint for
# its cells must explain more than that
_NOISE_SHARE = 0.25
_LITTLE = 0.1  # factor on the strength at which the quadratic part is negligible; the score there is tried, too
_HELD = 0.9  # shrinkage: the weight of the correlation between directions of a candidate, from few replicates
# cells of a statistic whose covariance can be estimated, at most, those of others being taken as independent; folds of
# the replicates, each tested with the covariance of the others
_SMALL, _FOLDS = 32, 4
_LEAST_VARIANCE = 0.3  # the least variance of a cell in the shrunk covariance; a residual has about 1
# the scatter beyond which the cells of a signature are dependent, and its score has the tails of few; the least degrees
# of freedom then
_TOGETHER, _FEWEST = 1.25, 3.0
_Weigh = Callable[[np.ndarray], np.ndarray]  # template (cells,) -> weights (cells,)


@dataclass(frozen=True)
class ScoreTest:
    """A score test, in null standard deviations.

    Attributes:
        size: the expected score of the whole signature.
        data: the score of the data.
        replicates: (replicates,) the scores of the replicates.
        spread: their standard deviation, relative to that of independent cells.
        freedom: degrees of freedom of the t distribution of the score.
    """

    size: float
    data: float
    replicates: np.ndarray
    spread: float
    freedom: float


def p_of_any(
    replicates: Replicates,
    evaluation: Evaluation,
    tried: Sequence[Trial],
    values: dict[Key, Any],
    lines: Sequence[Line],
) -> float:
    """The p-value of the best score of any candidate, maps and lines included, if the model is right.

    Args:
        tried: the trials of the scan.
        values: the values of the model, SI.
        lines: the spectral lines of the data.
    """
    data, replicate_p_values = p_values(replicates, evaluation, tried)
    p = trials_corrected(replicate_p_values, min(data, default=1.0))
    levels = count_model.light_levels_of(replicates, evaluation)
    maps = [
        p_of_map(replicates, evaluation, c, values, levels)
        for c in replicates.candidates(evaluation.sensors.one)
        if c.carrier
    ]
    line_ps = [line.p for line in lines]
    return min(1.0, 3 * min([p, *line_ps, *(q * len(maps) for q in maps)]))


def most_significant(
    replicates: Replicates, evaluation: Evaluation, tried: Sequence[Trial], number: int
) -> list[Trial]:
    """The best trial of each of the most significant candidates by score, up to some number, by p-value."""
    found: list[tuple[float, int]] = []
    for k, one in enumerate(tried):
        ps = [p for p, _ in _p_values_of_group(replicates, evaluation, [one])]
        found += [(min(ps), k)] if ps else []
    best: dict[str, Trial] = {}
    for _, k in sorted(found):
        best.setdefault(tried[k].candidate.name, tried[k])
    return list(best.values())[:number]


def p_of_best(
    replicates: Replicates, evaluation: Evaluation, tried: Sequence[Trial], best: Trial, large: bool = True
) -> tuple[float, float]:
    """(significance of the best trial in standard deviations, p-value with the trials factor of all candidates).

    Args:
        tried: all trials of the scan.
        best: one of them.
        large: the misfit is large, so that the evidence may exceed what the linear signature gives.
    """
    if best.p_value is not None:
        others = sum(c.carrier is not None for c in replicates.candidates(evaluation.sensors.one)) if best.maps else 1
        return float(stats.norm.isf(max(best.p_value, LEAST_P) / 2)), min(1.0, best.p_value * max(others, 1))
    directions = [t for t in tried if _sided(best) and _family(t) == _family(best)]
    _, replicate_p_values = p_values(replicates, evaluation, tried if directions else [best, *tried])
    significance, found, _ = best_direction(replicates, evaluation, best)
    # the noise of a fitted signature, at a small strength, takes nothing from the p-value of a test that was sharper;
    # the significance is that of the fitted one, as of its rivals
    looks = [t for t in tried if t.sharp and t.candidate.name == best.candidate.name and not large]
    sharper = min(p_values(replicates, evaluation, looks)[0], default=1.0)
    if found.size <= 0:
        return 0.0, max(trials_corrected(replicate_p_values, sharper), LEAST_P)
    sides = max(len(best.candidate.strengths) if _sided(best) else 1, 1)
    # no direction by itself may be significant, but all together
    together = min((p for p, _ in _p_values_of_group(replicates, evaluation, directions)), default=1.0)
    significance = max(significance, float(stats.t.isf(max(together, LEAST_P) / 2, found.freedom)))
    if large:  # far from the model the signature is not linear: the evidence itself, in the same units
        significance = max(significance, math.sqrt(max(best.evidence, 0.0) / max(found.spread**2, 0.5)))
    one = float(_p_of_square(significance**2, sides, found.freedom)) / (1 if _two_sided(best) else 2)
    return significance, max(trials_corrected(replicate_p_values, min(one, together, sharper)), LEAST_P)


def explains_its_signature(replicates: Replicates, evaluation: Evaluation, one: Trial) -> bool:
    """Whether the shift of the model by a fitted candidate agrees with the score of the data on its signature.

    The projection of the shift on the signature must lie between 0 and twice the score of the data. The signature is
    that of the trial's strength; at the fitted strength noise may exceed it.
    """
    if one.p_value is not None or one.there is None:
        return True
    _, found, times = best_direction(replicates, evaluation, one)
    keys, least = list(evaluation.residuals), 0.0
    template, there = (
        stacked(template_of(replicates, evaluation, signature), keys)
        for signature in (one.signature.at(times), one.there)
    )
    if one.sensors is not None and not template @ there:
        # so faint that each cell's shift may be noise and is left out; the projection of all shifts is significant
        (whole,) = signatures(replicates, evaluation, [one.sensors], Sampling(few=2 * FEW, kept="all"))
        if not isinstance(whole, CannotSimulate):
            there = stacked(template_of(replicates, evaluation, whole), keys)
            least = _NOISE_SHARE
    fit = found.size * float(template @ there) / max(float(template @ template), 1e-300)
    return abs(fit - found.data) < (1 - least) * abs(found.data)


def p_values(replicates: Replicates, evaluation: Evaluation, tried: Sequence[Trial]) -> tuple[list[float], np.ndarray]:
    """(p-value of each candidate, (replicates,) the smallest p-value in each replicate).

    The directions of one candidate are tested together. A candidate without a signature has none.
    """
    groups: dict[tuple[Any, ...], list[Trial]] = {}
    for n, one in enumerate(tried):
        groups.setdefault(_family(one) if _sided(one) else (n,), []).append(one)
    data: list[float] = []
    least = np.ones(len(evaluation.replicate_residuals[TOTALS]))
    for group in groups.values():
        for p, replicate_p_values in _p_values_of_group(replicates, evaluation, group):
            data.append(p)
            least = np.minimum(least, replicate_p_values)
    return data, least


def _p_values_of_group(
    replicates: Replicates, evaluation: Evaluation, group: Sequence[Trial]
) -> Iterator[tuple[float, np.ndarray]]:
    """As `p_values`, of a candidate or of all directions of one, for each strength with a signature of its own."""
    for times in _strengths(group[0]) if group else ():
        found = [score_test(replicates, evaluation, one.signature.at(times)) for one in group]
        found = [x for x in found if x.size > 0]
        if found:
            yield _hotelling(found, _two_sided(group[0]))


def _family(one: Trial) -> tuple[Any, ...]:
    """What the directions of one candidate share: its name and its shapes."""
    return one.candidate.name, shape_of(one)


def _sided(one: Trial) -> bool:
    """Whether it is one of several directions."""
    return one.candidate.kind == "add" and one.signed and len(one.candidate.strengths) > 1


def _two_sided(one: Trial) -> bool:
    """Whether the signature of the opposite sign is the opposite one, so that the test is two-sided.

    A signature with a quadratic part is not: each sign has a one-sided test of its own.
    """
    return one.signed and (one.signature.even is None or _sided(one))


def _strengths(one: Trial) -> Sequence[float]:
    """Factors on the strength at which the signature is another one.

    With a quadratic part these are a small factor, and both signs.
    """
    if one.signature.even is None:
        return (1.0,)
    return (1.0, _LITTLE) if _two_sided(one) or not one.signed else (1.0, -1.0, _LITTLE, -_LITTLE)


def best_direction(replicates: Replicates, evaluation: Evaluation, one: Trial) -> tuple[float, ScoreTest, float]:
    """(significance, at least 0, score test, factor on the strength) where the score is largest."""
    looks = [(score_test(replicates, evaluation, one.signature.at(x)), x) for x in _strengths(one)]
    significances = [abs(found.data) if _two_sided(one) else max(found.data, 0.0) for found, _ in looks]
    best = max(range(len(looks)), key=lambda k: (significances[k], looks[k][0].data))
    return significances[best], *looks[best]


def _hotelling(found: Sequence[ScoreTest], signed: bool) -> tuple[float, np.ndarray]:
    """(p-value of the scores of several directions, (replicates,) those of the replicates), by Hotelling's test.

    Args:
        found: a score test for each direction.
        signed: the test is two-sided.
    """
    scores = np.stack([x.replicates for x in found], axis=1)
    alike = scores.T @ scores / len(scores)
    alike = _HELD * alike + (1 - _HELD) * np.diag(np.diag(alike))
    np.fill_diagonal(alike, np.maximum(np.diag(alike), 1.0))
    all_ = np.vstack([[x.data for x in found], scores])
    square = np.einsum("ri,ij,rj->r", all_, np.linalg.inv(alike), all_)
    p = _p_of_square(square, len(found), min(x.freedom for x in found))
    if not signed:  # one-sided: a negative score is no evidence
        p = np.where(all_[:, 0] > 0, p / 2, 1.0)
    return float(p[0]), p[1:]


def _p_of_square(square: np.ndarray | float, directions: int, freedom: float) -> np.ndarray:
    """The p-value of a squared score by Hotelling's law; of the t distribution for one direction."""
    second = max(freedom - directions + 1, 1.0)
    return np.asarray(stats.f.sf(np.asarray(square) * second / (directions * freedom), directions, second))


def trials_corrected(replicate_p_values: np.ndarray, least: float) -> float:
    """The p-value of the smallest of many p-values.

    Args:
        replicate_p_values: (replicates,) the smallest p-value in each replicate.
        least: that in the data.
    """
    # trials factor: the effective number of independent tests
    number = max(1 / max(float(replicate_p_values.mean()), 1e-6) - 1, 1.0)
    return float(-np.expm1(number * np.log1p(-min(least, 1 - 1e-12))))


def score_test(
    replicates: Replicates, evaluation: Evaluation, signature: Signature, fitted: np.ndarray | None = None
) -> ScoreTest:
    """The score (matched-filter) test of a signature: the data's projection on it, in null standard deviations.

            z = sum_k v_k' P_k z_k / sd(sum_k v_k' P_k z*_k)

    z_k, v_k: residuals and template of statistic k; z*: residuals of the replicates, cross-fitted in folds; P_k: the
    inverse of the shrunk covariance (Schaefer and Strimmer 2005) for 2 to 32 cells, otherwise the identity. Without a
    signature `size`, `data` and `replicates` are 0.

    Args:
        fitted: an orthonormal basis of what fitted coordinates move, (all cells, rank), in the order of the blocks. The
            residuals have nothing along it, whatever the data were, and so have the weights P_k v_k then.
    """
    template = template_of(replicates, evaluation, signature)
    keys = [k for k, t in template.items() if t.any()]
    many = len(evaluation.replicate_residuals[TOTALS])
    most = float(many - 1)
    if not keys:
        return ScoreTest(size=0.0, data=0.0, replicates=np.zeros(many), spread=1.0, freedom=most)
    moved: dict[Cell, np.ndarray] = {}
    weights: list[dict[Cell, np.ndarray]] = [{} for _ in range(_FOLDS + 1)]  # by all replicates, by those of each fold
    for key in keys:
        null = evaluation.nulls.get(key)
        moved[key] = template[key] if null is None else null.law.scores(template[key])
        for some, weigh in zip(weights, _weightings(evaluation, key), strict=True):
            some[key] = weigh(moved[key])
    if fitted is not None:
        weights = [_without(fitted, some, evaluation.residuals) for some in weights]
        keys = list(evaluation.residuals)
    scores = np.zeros(many)
    size = data = norm = fourth = wild = 0.0
    for key in keys:
        w, *parts = (some[key] for some in weights)
        t = moved.get(key, np.zeros(len(w)))
        for part, own in zip(_folds(many), parts, strict=True):
            scores[part] += evaluation.replicate_residuals[key][part] @ own
        size, data = size + float(t @ w), data + float(evaluation.residuals[key] @ w)
        norm, fourth = norm + float(w @ w), fourth + float(np.sum(w**4))
        wild += float(np.sum(w[~_nearly_normal(replicates, evaluation, key)] ** 4))
    if norm <= 0:
        return ScoreTest(size=0.0, data=0.0, replicates=np.zeros(many), spread=1.0, freedom=most)
    norm = math.sqrt(norm)
    # many cells may scatter less together than independent ones; the score of a single one is not divided by a
    # scatter that rare counts make small
    cells = norm**4 / fourth
    spread = max(float(scores.std(ddof=1)) / norm, 0.5 + 0.5 / math.sqrt(cells))
    # dependent cells may be far out together: the tails are those of few
    few = 2 * norm**4 / max(wild, 1e-300) / spread**2
    freedom = most if spread < _TOGETHER else min(max(few, _FEWEST), most)
    return ScoreTest(
        size=size / norm / spread,
        data=data / norm / spread,
        replicates=scores / norm / spread,
        spread=spread,
        freedom=freedom,
    )


def _without(
    fitted: np.ndarray, weights: Mapping[Cell, np.ndarray], residuals: Mapping[Cell, np.ndarray]
) -> dict[Cell, np.ndarray]:
    """Weights without what lies along a basis of all cells, (cells,) by block."""
    w = np.concatenate([weights.get(key, np.zeros(len(z))) for key, z in residuals.items()])
    w = w - fitted @ (fitted.T @ w)
    ends = np.cumsum([len(z) for z in residuals.values()])[:-1]
    return dict(zip(residuals, np.split(w, ends), strict=True))


def _nearly_normal(replicates: Replicates, evaluation: Evaluation, key: Cell) -> np.ndarray:
    """Which cells are counts of so many events that they are nearly normal, (cells,) bool."""
    null = evaluation.nulls.get(key)
    if null is None:
        return np.zeros(len(evaluation.residuals[key]), bool)
    return null.law.nearly_normal(null.expected(replicates.seen[key[0]].total)[0], null.factor)


def _folds(recordings: int) -> list[slice]:
    """The folds of the replicates; each is tested with the covariance of the others."""
    return [slice(k, None, _FOLDS) for k in range(_FOLDS)]


def _weightings(evaluation: Evaluation, key: Cell) -> list[_Weigh]:
    """Functions template -> weights of a statistic's cells: by all replicates, and by those outside each fold."""
    replicate_residuals = evaluation.replicate_residuals[key]
    many, cells = replicate_residuals.shape
    if key == TOTALS or not 1 < cells <= _SMALL:
        return [lambda t: t] * (_FOLDS + 1)

    def made() -> list[_Weigh]:
        rests = [np.delete(replicate_residuals, np.arange(many)[part], axis=0) for part in _folds(many)]
        return [_inverse_covariance(x) for x in [replicate_residuals, *rests]]

    return evaluation.once(("weights", key), made)


def _inverse_covariance(replicate_residuals: np.ndarray) -> _Weigh:
    """A function template -> weights (cells,), by the inverse of the shrunk covariance.

    Source: Schaefer and Strimmer, Stat. Appl. Genet. Mol. Biol. 4 (2005) 32, for correlations.

    Args:
        replicate_residuals: (replicates, cells) residuals.
    """
    together = replicate_residuals.T @ replicate_residuals / len(replicate_residuals)
    alone = np.maximum(np.diag(together), _LEAST_VARIANCE)
    alike = together / np.sqrt(np.outer(alone, alone))
    np.fill_diagonal(alike, 0.0)
    square, pairs = float(np.sum(alike**2)), len(alike) * (len(alike) - 1)
    by_chance = (pairs - square) / len(replicate_residuals)
    together *= min(max(0.0, 1 - by_chance / max(square, 1e-30)), 1 - 1 / len(replicate_residuals))
    np.fill_diagonal(together, alone)
    inverse = np.linalg.inv(together)
    return lambda t: np.asarray(inverse @ t)


def p_of_map(
    replicates: Replicates,
    evaluation: Evaluation,
    candidate: Candidate,
    values: dict[Key, Any],
    levels: dict[str, float],
) -> float:
    """The p-value of a map: the pixels (rows, columns) differ alike in all captures that could show it.

    Args:
        values: the values of the model, SI.
        levels: light level by capture.
    """
    try:
        information = map_models.information(replicates, values, candidate, levels)
    except (SpadError, np.linalg.LinAlgError):
        return 1.0
    if candidate.informed_by:
        try:
            fitted = map_fits.fit_maps(replicates, values, [candidate], levels)
        except SpadError:
            return 1.0
        return p_of_width(fitted[candidate.carrier])  # type: ignore[index]
    if candidate.blinds:
        return _p_of_blind_times(replicates, evaluation, candidate, values, information)
    name = informant("codes") if candidate.per == "code" else informant("counts")
    total_information = {id: float(x.sum()) for id, x in information.items()}
    cells = [(id, name) for id in total_information if total_information[id] > 0 and (id, name) in evaluation.residuals]
    if cells:
        size = max(len(evaluation.residuals[cell]) for cell in cells)
        cells = [cell for cell in cells if len(evaluation.residuals[cell]) == size]
    if not cells:
        return 1.0
    weight = np.sqrt([total_information[id] for id, _ in cells])
    weight /= math.sqrt(float(weight @ weight))
    z = sum(w * evaluation.residuals[cell] for w, cell in zip(weight, cells, strict=True))
    replicate_residuals = sum(w * evaluation.replicate_residuals[cell] for w, cell in zip(weight, cells, strict=True))
    if candidate.per == "code":
        parts = pixel_maps.code_periods(size)
        return min(1.0, len(parts) * min(p_of_spread(z[part], replicate_residuals[:, part]) for part in parts.values()))
    groups = pixel_maps.groups_of(evaluation.sensors.one, candidate.per)
    if any(replicates.of_scene(id) for id, _ in cells):
        sensitivity = np.sqrt([information[id] for id, _ in cells])
        rows = [[evaluation.replicate_residuals[cell][k] for cell in cells] for k in range(len(replicate_residuals))]
        data, *null = (
            _scores_of_groups(row, sensitivity, groups)
            for row in ([evaluation.residuals[cell] for cell in cells], *rows)
        )
        p = p_of_spread(data, np.stack(null)) if data.size else 1.0
    else:
        count = np.sqrt(np.bincount(groups))
        data = np.bincount(groups, z) / count
        null_data = np.stack([np.bincount(groups, row) / count for row in replicate_residuals])
        p = p_of_spread(data, null_data)
    if candidate.per != "pixel":
        return p
    # with few detections in most pixels, the distribution of the counts is more sensitive than the score of each
    best = max(total_information, key=lambda id: total_information[id])
    laws = [(best, name) for name in informing("distribution") if (best, name) in evaluation.residuals]
    others = [evaluation.nulls[cell].p_value(evaluation.residuals[cell])[0] for cell in laws]
    return min(1.0, 2 * min([p, *(len(laws) * p for p in others)]))


def _scores_of_groups(residuals: Sequence[np.ndarray], sensitivity: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """The score of each value of a map, of unit variance, where anything informs it.

    Args:
        residuals: of captures, (pixels,) each.
        sensitivity: (captures, pixels) slope of a residual on the logarithm of the value: 0 where a scene is black.
        groups: (pixels,) which value each pixel has.
    """
    information = np.bincount(groups, (sensitivity**2).sum(axis=0))
    score = np.bincount(groups, (sensitivity * residuals).sum(axis=0))
    some = information > pixel_maps.NOTHING**-2
    return np.asarray(score[some] / np.sqrt(information[some]))


def _p_of_blind_times(
    replicates: Replicates,
    evaluation: Evaluation,
    candidate: Candidate,
    values: dict[Key, Any],
    information: dict[str, np.ndarray],
) -> float:
    """The p-value of pixels with unlike dead times, the larger of two tests.

    Jitter may explain the scatter of the shortest intervals, afterpulses of some pixels the pairs of short intervals
    in one pixel; neither explains both.

    Args:
        information: (pixels,) by capture.
    """
    every = [(id, name) for id, x in information.items() if x.any() for name in informing("dead times")]
    cells = [cell for cell in every if cell in evaluation.residuals]
    if not cells:
        return 1.0
    try:
        width = map_fits.fit_blind_times(replicates, values, candidate).width
    except SpadError:
        return 1.0
    assert width is not None
    by_edges = float(stats.chi2.sf(width.likelihood_ratio, 1)) / 2 if width.low > 0 else 1.0
    z = np.concatenate([evaluation.residuals[cell] for cell in cells])
    by_pairs = min(1.0, z.size * float(stats.norm.sf(float(z.max()))))
    return max(by_edges, by_pairs)


def p_of_spread(data: np.ndarray, null: np.ndarray) -> float:
    """The p-value of values that differ more than those of the replicates.

    Args:
        data: (values,).
        null: (replicates, values).
    """
    p_sum = p_of_scatter(float(np.mean(data**2)), np.mean(null**2, axis=1), data.size)
    return min(1.0, 2 * min(p_sum, p_of_largest(data, null)))


def sigmas_of(p: float) -> float:
    """The two-sided p-value in standard deviations."""
    return float(stats.norm.isf(max(p, LEAST_P) / 2))
