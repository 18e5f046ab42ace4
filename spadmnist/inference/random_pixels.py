"""Fits of effects that hit pixels at random, by the likelihood with the scatter of the effect itself.

Which pixels such an effect hits is chance. The squares of residuals under the model without it are those of the few
pixels that the data's chip has, which no strength and no time constant lowers; in units of the scatter that the effect
brings with it they are ordinary. So its shape is chosen by the quasi-likelihood ratio, and its coordinates are fitted
by Gauss-Newton steps from evaluations of the model with the effect (iteratively reweighted least squares).
Source: McCullagh and Nelder, Generalized Linear Models (1989), 2.5 and 9.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from .. import plugins
from ..errors import SpadError
from ..sensor import Sensor
from . import count_model
from .candidates import with_values
from .coordinates import Key, Values, point_of
from .evaluation import Evaluation, block_checks, evaluate, failing, log_likelihood_ratio, square
from .gauss_newton import Fit, gauss_newton_step
from .models import Model
from .replicates import FEW, Replicates
from .signature import residuals_at, signatures, template_of
from .trial import Trial

_OF_A_SHAPE = 8  # replicates of each capture by which shapes are compared: four share what the worst of a few decides
_TURNS = 6  # steps at most; from the nearest of the shapes four were enough for dark counts that blink
_VAIN = 2  # steps in a row without a larger likelihood, after which the rest is noise
_CHANCE = 0.5  # pixels that are taken as hit by chance, in the mean over all: less than one
_PROMISED = 5.0  # in chi square, for each coordinate: a smaller promised fall is the noise of a Jacobian


def fit_by_own_scatter(replicates: Replicates, evaluation: Evaluation, one: Trial) -> Trial:
    """The trial, its coordinates fitted by its own scatter where a check fails at their values; with its evaluation.

    Args:
        one: fitted to the squares under `evaluation`.
    Raises:
        SpadError: where it cannot be simulated.
    """
    assert one.fit is not None and one.sensors is not None
    one.evaluation = evaluate(replicates, {}, one.sensors)
    if not failing(block_checks(replicates, one.evaluation, one.evaluation.residuals)):
        return one
    template = template_of(replicates, evaluation, one.signature)

    def model(values: Mapping[Key, Any]) -> Model:
        return evaluation.sensors.changed(values, one.phases, chips=True)

    def ratio(there: Evaluation) -> float:
        return log_likelihood_ratio(evaluation, there, template)

    coordinates = one.fit.coordinates
    here, there, most = dict(one.values), one.evaluation, ratio(one.evaluation)
    for other in one.others:
        values = other.scaled()
        try:
            few = evaluate(replicates, {}, model(values), _OF_A_SHAPE)
        except SpadError:
            continue  # there is no such model at this strength
        if ratio(few) > most:
            here, there, most = values, few, ratio(few)
    if there is not one.evaluation:
        there = evaluate(replicates, {}, there.sensors, known=there)
    best: tuple[float, Evaluation, Fit] | None = None
    vain = 0
    for _ in range(_TURNS):
        found = gauss_newton_step(replicates, there, coordinates, here, model, 2 * FEW)
        if isinstance(found, str):
            break
        at = replace(found, point=point_of(coordinates, here), values=dict(here), residuals=there.residuals)
        if best is None or ratio(there) > best[0]:
            best, vain = (ratio(there), there, at), 0
        else:
            vain += 1
        if vain == _VAIN or square(there.residuals) - found.square < _PROMISED * len(coordinates):
            break
        try:
            here, there = dict(found.values), evaluate(replicates, {}, model(found.values))
        except SpadError:
            break  # the step leads to where no model is
    if best is None:
        return one
    _, one.evaluation, one.fit = best
    one.fit = replace(one.fit, square=square(one.evaluation.residuals))
    one.values, one.sensors, one.times = dict(one.fit.values), one.evaluation.sensors, 1.0
    (signature,) = signatures(replicates, evaluation, [one.sensors])
    if isinstance(signature, str):
        raise SpadError(signature)
    one.there, one.residuals = signature, residuals_at(replicates, evaluation, signature)
    one.fall = square(evaluation.residuals) - square(one.residuals)
    return one


def pixels_hit(replicates: Replicates, evaluation: Evaluation, values: Values, effect: str) -> np.ndarray | None:
    """The pixels whose counts show an effect that hits pixels at random, (pixels,) bool; None where it does not say.

    Args:
        evaluation: of the model with the effect.
        values: of that model, SI.
    Raises:
        SpadError: where a user's effect says something else.
    """
    pixels = replicates.start.layout.pixels
    none = of_pixels(with_values(replicates.start, values), effect, np.zeros(pixels, bool))
    if not none:
        return None
    without = with_values(replicates.start, {**values, **none})
    levels = count_model.light_levels_of(replicates, evaluation)
    counted = [id for id, seen in replicates.seen.items() if seen.counts is not None]
    p = np.ones(pixels)
    for id in counted:
        line = count_model.CountModel(replicates, id, levels[id])
        p = np.minimum(p, len(counted) * line.p_of_more(line.expected(without)))
    return np.asarray(p < _CHANCE / pixels)


def of_pixels(sensor: Sensor, effect: str, hit: np.ndarray) -> dict[Key, Any]:
    """The values under which an effect of the sensor is in exactly these pixels, SI; none where it does not say them.

    Args:
        hit: (pixels,) bool.
    Raises:
        EffectError: where a user's effect fails.
    """
    own = sensor.effect(effect)
    assert own is not None
    with plugins.blaming(type(own)):
        return {(effect, name): value for name, value in own.of_pixels(hit).items()}
