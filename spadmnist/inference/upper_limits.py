"""Upper limits: the largest strength of each effect that was not found, 95 %, by inverting its score test."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from .capture_replicates import CannotSimulate
from .evaluation import Evaluation, stacked
from .gauss_newton import Fit, column_of
from .replicates import FEW, Cell, Replicates
from .results import plain
from .scan import Scan
from .score_test import ScoreTest, score_test
from .signature import Sampling, Signature, captures_showing, odd_and_even, signatures, template_of
from .trial import Trial, shape_of

_BEYOND = 0.05  # probability that a strength above its limit gives a score as small as that of the data
# of a template's norm, least: with less of it beside the fitted coordinates the captures give no limit at all
_LEAST_FREE = 1e-3
# The others are rules of thumb: no measurement that is kept chose them.
# standard deviations of a signature: one that noise does not hide, by which the growth is measured; one that it hides
_CLEARLY, _HARDLY = 15.0, 0.5
# of the square of a signature: the share in captures that are not simulated for its growth
_LEFT_OUT = 0.1
# standard deviations of a signature that hardly grows any more: above it every shape is followed down to its limit
_SATURATED = 1000.0
_LOOKS = 5  # simulations at other strengths, and iterations of a quadratic limit, at most
# (factor on the strength at the limit if the signature were linear, size of the signature, trial)
_Shape = tuple[float, float, Trial]


def upper_limits(
    scan: Scan, evaluation: Evaluation, tried: Sequence[Trial], fit: Fit | None = None
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], list[dict[str, Any]]]:
    """(effects with their 95 % upper limits, effects that these captures cannot show, the others), for the JSON data.

    The others have directions or phases, and no limit is given for them. The limit of an effect is the weakest one
    over its shapes, and where its strength may have either sign, over both signs. The growth of each signature with
    its strength is simulated once more.

    Args:
        tried: the trials of every candidate in all captures.
        fit: the fitted coordinates of the model, which the limits are profiled over; None where nothing was fitted.
    """
    replicates = scan.replicates
    shapes: dict[str, dict[tuple[Any, ...], _Shape]] = {}
    for one in tried:
        candidate = one.candidate
        if candidate.kind != "add" or len(candidate.strengths) != 1 or candidate.phases:
            continue
        test = score_test(replicates, evaluation, one.signature)
        times = _times_at_limit(replicates, evaluation, one, test, fit)
        known = shapes.setdefault(candidate.effect, {})
        # of several strengths, the one with the largest signature
        if shape_of(one) not in known or known[shape_of(one)][1] < test.size:
            known[shape_of(one)] = times, test.size, one
    # a saturated template does not show which shape is the weakest
    asked = {
        (name, n): shape
        for name, all_ in shapes.items()
        for n, shape in enumerate(all_.values())
        if shape is max(all_.values(), key=strength_at_limit) or min(s[1] for s in all_.values()) > _SATURATED
    }
    times_of = _at_limit(scan, evaluation, asked)
    excluded, hidden = [], []
    for name in shapes:
        limits = [_strength(shape[2], times_of[key]) for key, shape in asked.items() if key[0] == name]
        coordinate = next(iter(shapes[name].values()))[2].candidate.strengths[0]
        if None in limits:
            hidden.append(name)
        else:
            far = max((x for x in limits if x is not None), key=lambda x: abs(x - (coordinate.off or 0.0)))
            entry = {"effect": name, "parameter": coordinate.parameter, "upper_limit_95": plain(far)}
            # an effect that vanishes at the upper end of its range: the strength is at least that
            excluded.append(entry | ({"at_least": True} if far < (coordinate.off or 0.0) else {}))
    # periodic effects are looked for in the spectrum, though none is tried where there are no lines; an effect that
    # could not be tried is reported where it failed
    looked = {one.candidate.effect for one in tried}
    failed = {entry["effect"] for entry in scan.untried} - looked
    added = [one for one in scan.replicates.candidates(evaluation.sensors.one) if one.kind == "add"]
    others = {one.effect for one in added if one.phases or one.effect in looked} - shapes.keys() - failed
    return excluded, [{"effect": name} for name in sorted(hidden)], [{"effect": name} for name in sorted(others)]


def strength_at_limit(shape: _Shape) -> float:
    """The distance of the strength from where the effect vanishes, at the limit of one shape."""
    times, _, one = shape
    coordinate = one.candidate.strengths[0]
    return times * abs(float(one.values[coordinate.key]) - (coordinate.off or 0.0))


def _times_at_limit(
    replicates: Replicates, evaluation: Evaluation, one: Trial, test: ScoreTest, fit: Fit | None
) -> float:
    """The factor on the strength of a trial at its upper limit, if the odd part of the signature were linear.

    A strength of either sign has a limit on each side, and the farther one is taken.
    """
    fitted = None if fit is None or not fit.coordinates else _fitted(fit, evaluation)
    if fitted is not None:
        if share_beside(fit, evaluation, template_of(replicates, evaluation, one.signature.at(1.0))) < _LEAST_FREE:
            return math.inf
        test = score_test(replicates, evaluation, one.signature.at(1.0), fitted)
    coordinate = one.candidate.strengths[0]
    signed = coordinate.low < (coordinate.off or 0.0) < coordinate.high
    limits = []
    for sign in (1, -1) if signed else (1,):
        times = linear_limit(test, sign, signed)
        for _ in range(_LOOKS if one.signature.even is not None and math.isfinite(times) else 0):
            # iterated with the root of the factor, because a quadratic signature would oscillate
            there = score_test(replicates, evaluation, one.signature.at(sign * times), fitted)
            times *= math.sqrt(linear_limit(there, 1, signed))
        limits.append(times)
    return max(limits)


def share_beside(fit: Fit | None, evaluation: Evaluation, template: Mapping[Cell, np.ndarray]) -> float:
    """The share of a template's norm that no change of the fitted coordinates imitates, 0 to 1.

    Residuals of a fit have nothing along its Jacobian, whatever the data were: only this share tells of the effect.

    Args:
        template: (cells,) by block.
    """
    if fit is None or not fit.coordinates:
        return 1.0
    keys = list(evaluation.residuals)
    t = stacked({key: template.get(key, np.zeros(len(evaluation.residuals[key]))) for key in keys}, keys)
    basis = _fitted(fit, evaluation)
    rest = t - basis @ (basis.T @ t)
    return min(math.sqrt(float(rest @ rest) / float(t @ t)), 1.0) if t.any() else 1.0


def _fitted(fit: Fit, evaluation: Evaluation) -> np.ndarray:
    """As `_basis_of`, made once."""
    return evaluation.once(("columns of a fit", id(fit)), lambda: _basis_of(fit, evaluation))


def _basis_of(fit: Fit, evaluation: Evaluation) -> np.ndarray:
    """An orthonormal basis of the columns of a fit's Jacobian, (cells, rank)."""
    keys = list(evaluation.residuals)
    columns = [stacked(column_of(fit, i, evaluation), keys) for i in range(len(fit.coordinates))]
    u, size, _ = np.linalg.svd(np.stack(columns, axis=1), full_matrices=False)
    return np.asarray(u[:, size > 1e-8 * max(float(size.max(initial=0.0)), 1e-300)])


def linear_limit(test: ScoreTest, sign: int = 1, signed: bool = False) -> float:
    """The factor on the strength at its upper limit, if the signature were linear.

    Args:
        test: of the signature.
        sign: of the strength, 1 or -1.
        signed: the limit is one of two, on both sides.
    """
    if test.size <= 0:
        return math.inf
    quantile = float(stats.t.isf(_BEYOND / 2 if signed else _BEYOND, test.freedom))
    return (max(sign * test.data, 0.0) + quantile) / test.size


def _at_limit(
    scan: Scan, evaluation: Evaluation, weakest: Mapping[tuple[str, int], _Shape]
) -> dict[tuple[str, int], float]:
    """The factor on the strength at the upper limit of each effect, by the growth of its signature.

    The power of the growth is measured where the signature is clear, but not by far.
    """
    replicates = scan.replicates
    out: dict[tuple[str, int], float] = {}
    # known strength and size of the signature, strength to try
    open_: dict[tuple[str, int], tuple[float, float, float]] = {}
    needed: dict[tuple[str, int], float] = {}
    where: dict[tuple[str, int], list[str]] = {}
    for name, (times, size, one) in weakest.items():
        out[name] = times
        if size > 2 * _CLEARLY and math.isfinite(times):
            where[name] = captures_showing(template_of(replicates, evaluation, one.signature), _LEFT_OUT)
            seen = score_test(replicates, evaluation, one.signature.only(where[name])).size
            here = one.signature if one.signature.even is None else one.signature.at(times)
            needed[name] = score_test(replicates, evaluation, here.only(where[name])).size * (
                times if one.signature.even is None else 1.0
            )
            open_[name] = 1.0, seen, _CLEARLY / seen
    for _ in range(_LOOKS):
        known = {name: entry for name, entry in open_.items() if _strength(weakest[name][2], entry[2]) is not None}
        if not known:
            break
        asked = [(weakest[name][2], try_, where[name]) for name, (_, _, try_) in known.items()]
        open_ = {}
        for (name, (strong, size, try_)), signature in zip(
            known.items(), _as_strong(replicates, evaluation, asked), strict=True
        ):
            there = 0.0 if signature is None else score_test(replicates, evaluation, signature).size
            power = math.log(max(there, _HARDLY) / size) / math.log(try_ / strong)
            out[name] = try_ * (needed[name] / max(there, _HARDLY)) ** (1 / min(max(power, 0.5), 10.0))
            if there < _CLEARLY / 3:  # it grows faster: a signature that noise hides gives no power
                open_[name] = strong, size, math.sqrt(strong * try_)
            elif there > 6 * _CLEARLY:
                open_[name] = try_, there, try_ * _CLEARLY / there
    return out


def _as_strong(
    replicates: Replicates, evaluation: Evaluation, asked: Sequence[tuple[Trial, float, Sequence[str]]]
) -> list[Signature | None]:
    """The signature of each trial at a factor on its strength, in some captures; None where it cannot be simulated.

    A strength that may have either sign is simulated with both.
    """
    models, only, signs = [], [], []
    for one, times, ids in asked:
        coordinate = one.candidate.strengths[0]
        strong = _strength(one, times)
        assert strong is not None  # only such strengths are asked for
        strengths = [strong]
        if (
            one.signature.even is not None and coordinate.low <= -strong <= coordinate.high
        ):  # of both signs: vanishes at 0
            strengths.append(-strong)
        signs.append(len(strengths))
        for value in strengths:
            models.append(evaluation.sensors.changed({**one.values, coordinate.key: value}))
            only.append(ids)
    made = iter(signatures(replicates, evaluation, models, Sampling(kept="sure"), only_of=only))
    out: list[Signature | None] = []
    for (_, _, ids), number in zip(asked, signs, strict=True):
        up, down = next(made), next(made) if number == 2 else None
        if isinstance(up, CannotSimulate) or isinstance(down, CannotSimulate):
            out.append(None)
        else:
            out.append((up if down is None else odd_and_even(replicates, evaluation, up, down, FEW)).only(ids))
    return out


def _strength(one: Trial, times: float) -> float | None:
    """The strength of a trial times a factor, in the parameter's unit; None beyond its search range."""
    coordinate = one.candidate.strengths[0]
    off = coordinate.off or 0.0
    value = off + (float(one.values[coordinate.key]) - off) * times
    inside = math.isfinite(value) and (
        value <= coordinate.high if coordinate.off != coordinate.high else value >= coordinate.low
    )
    return value if inside else None
