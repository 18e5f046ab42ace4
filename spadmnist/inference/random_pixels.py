"""Effects that hit pixels at random: fits by the likelihood with their own scatter, and which pixels were hit.

Such an effect hits pixels at random. In units of the scatter of the model without it, the pixels that it has hit in the
data have by far the largest residuals, whatever its strength and time constant. Their squares do not inform these two.
In units of the scatter of the model with the effect these residuals are ordinary. Its shape is therefore chosen by the
quasi-likelihood ratio, and its coordinates are fitted by Gauss-Newton steps from evaluations of the model with the
effect (iteratively reweighted least squares).
Source: McCullagh and Nelder, Generalized Linear Models (1989), 2.5 and 9.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .. import plugins
from ..errors import SpadError
from ..sensor import Sensor
from . import count_model
from .budget import OutOfBudget
from .candidates import with_values
from .coordinates import Key, Values, point_of
from .evaluation import Evaluation, block_checks, evaluate, failing, log_likelihood_ratio, square
from .gauss_newton import Fit, JacobianBy, gauss_newton_step
from .models import Model
from .replicates import FEW, CannotSimulate, Replicates
from .signature import IGNORED, captures_showing, residuals_at, signatures, template_of
from .trial import Trial

# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
_OF_A_SHAPE = 8  # replicates of each capture by which shapes are compared: few, for there may be a dozen shapes
_TURNS = 6  # steps at most; from the nearest of the shapes four were enough for dark counts that blink
_VAIN = 2  # steps in a row without a larger likelihood, after which the rest is noise and the fit ends
# in chi square, for each coordinate: a smaller promised fall is the noise of a Jacobian, and the fit ends
_PROMISED = 5.0
# expected number of pixels in the array that are taken as hit although they are not: less than one. It is the level of
# the test of each pixel; where a typical hit would not pass it, the counts identify no pixel
_FALSE_HITS = 0.5
_ENOUGH = 0.1  # of what a hit adds in the mean: the least excess of a pixel that is taken as hit
_MOST = 0.4  # share of the pixels: with more of them hit, the median of all is no longer that of the others
_LEVEL = 10.0  # detections of most pixels, from which on their median gives the level and their scatter


def fit_by_own_scatter(replicates: Replicates, evaluation: Evaluation, one: Trial) -> Trial:
    """The trial, its coordinates fitted by its own scatter where a check fails at their values; with its evaluation.

    Args:
        one: fitted to the squares under `evaluation`.
    Raises:
        SpadError: where it cannot be simulated.
    """
    assert one.fit is not None and one.sensors is not None
    template = template_of(replicates, evaluation, one.signature)
    tried = [template_of(replicates, evaluation, other.signature.at(other.times)) for other in one.others]
    some = set().union(*(captures_showing(each, *IGNORED) for each in (template, *tried)))

    def evaluated(sensors: Model, number: int | None = None) -> Evaluation:
        return evaluate(replicates, {}, sensors, number, near=(evaluation, some))

    one.evaluation = evaluated(one.sensors)
    if not failing(block_checks(replicates, one.evaluation, one.evaluation.residuals)):
        return one

    def model(values: Mapping[Key, Any]) -> Model:
        return evaluation.sensors.changed(values, one.phases, chips=True)

    def ratio(there: Evaluation) -> float:
        return log_likelihood_ratio(evaluation, there, template)

    coordinates, given = one.fit.coordinates, ratio(one.evaluation)
    here, there = dict(one.values), one.evaluation
    values = _of_the_best_shape(one, lambda values: ratio(evaluated(model(values), _OF_A_SHAPE)))
    if values is not None:
        try:
            other = evaluated(model(values))
            here, there = (values, other) if ratio(other) > given else (here, there)
        except SpadError:
            pass  # with more replicates there is no such model
    best: tuple[float, Evaluation, Fit] | None = None
    vain = 0
    by = JacobianBy(2 * FEW, only=lambda key: some)
    for _ in range(_TURNS):
        try:
            found = gauss_newton_step(replicates, there, coordinates, here, model, by)
            at = replace(found, point=point_of(coordinates, here), values=dict(here), residuals=there.residuals)
            if best is None or ratio(there) > best[0]:
                best, vain = (ratio(there), there, at), 0
            else:
                vain += 1
            if vain == _VAIN or square(there.residuals) - found.square < _PROMISED * len(coordinates):
                break
            here, there = dict(found.values), evaluated(model(found.values))
        except OutOfBudget:
            if best is None:
                raise
            break
        except SpadError:
            break  # the step leads to where no model is
    if best is None:
        return one
    _, there, fit = best
    (signature,) = signatures(replicates, evaluation, [there.sensors], only=some)
    if isinstance(signature, CannotSimulate):
        raise CannotSimulate(str(signature))
    residuals = residuals_at(replicates, evaluation, signature)
    one.evaluation, one.sensors, one.fit = there, there.sensors, replace(fit, square=square(there.residuals))
    one.values, one.times = dict(fit.values), 1.0
    one.signature, one.there, one.residuals = signature, signature, residuals
    one.fall = square(evaluation.residuals) - square(residuals)
    return one


def _of_the_best_shape(one: Trial, ratio: Callable[[Values], float]) -> dict[Key, Any] | None:
    """The values of another shape that is likelier than the fitted one; None where there is none.

    Args:
        ratio: of the likelihoods, by a few replicates of each.
    """
    likeliest: tuple[float, dict[Key, Any] | None] | None = None
    for values in ([dict(one.values)] if one.others else []) + [other.scaled() for other in one.others]:
        try:
            found = ratio(values)
        except SpadError:
            continue  # there is no such model at this strength
        if likeliest is None or found > likeliest[0]:
            likeliest = found, values
    return None if likeliest is None or likeliest[1] == one.values else likeliest[1]


@dataclass(frozen=True)
class PixelsHit:
    """The pixels that an effect has hit.

    Attributes:
        hit: (pixels,) bool.
        values: the parameters under which the effect is in exactly these, SI.
    """

    hit: np.ndarray
    values: dict[Key, Any]


def pixels_hit(replicates: Replicates, evaluation: Evaluation, values: Values, effect: str) -> PixelsHit | None:
    """The pixels whose counts show an effect that hits pixels at random; None where the counts do not identify them.

    The median of the pixels gives the level of a capture: pixels that are hit at random hardly move it.

    Args:
        evaluation: of the model with the effect.
        values: of that model, SI.
    Raises:
        SpadError: where a user's effect says something else.
    """
    pixels = replicates.start.layout.pixels
    counted = [id for id, seen in replicates.seen.items() if seen.counts is not None]
    sensor = with_values(replicates.start, values)
    if not counted or not of_pixels(sensor, effect, np.zeros(pixels, bool)):
        return None
    without, throughout = (
        with_values(replicates.start, {**values, **of_pixels(sensor, effect, np.full(pixels, hit))})
        for hit in (False, True)
    )
    levels = count_model.light_levels_of(replicates, evaluation)
    p, of_a_hit = np.ones(pixels), np.ones(pixels)  # p-values of each pixel, and of one that is hit
    for id in counted:
        line = count_model.CountModel(replicates, id, levels[id])
        counts, low, high = replicates.seen[id].counts, line.expected(without), line.expected(throughout)
        assert counts is not None
        wider = 1.0
        if (median := float(np.median(counts))) >= _LEVEL:
            scale = median / float(np.median(low))
            low, high = low * scale, high * scale
            scatter = 1.4826 * float(np.median(np.abs(counts - low)))
            wider = max(scatter**2 / float(np.median(line.variance(low, 0.0))), 1.0)
        more = counts - low > _ENOUGH * (high - low)
        p = np.minimum(p, np.where(more, len(counted) * line.p_of_more(counts, low, wider), 1.0))
        of_a_hit = np.minimum(of_a_hit, len(counted) * line.p_of_more(high, low, wider))
    hit = p < _FALSE_HITS / pixels
    if float(np.median(of_a_hit)) > _FALSE_HITS / pixels or not 0 < float(np.mean(hit)) < _MOST:
        return None
    return PixelsHit(hit, of_pixels(sensor, effect, hit))


def of_pixels(sensor: Sensor, effect: str, hit: np.ndarray) -> dict[Key, Any]:
    """The values under which an effect of the sensor is in exactly these pixels, SI; none where it does not say them.

    Args:
        hit: (pixels,) bool.
    Raises:
        EffectError: where a user's effect fails, or says what it cannot be.
    """
    own = sensor.effect(effect)
    assert own is not None
    with plugins.blaming(type(own)):
        said = own.of_pixels(hit)
        if not isinstance(said, dict) or not said.keys() <= own.parameters.keys():
            raise ValueError(f"of_pixels must be a dict of parameters, {', '.join(own.parameters)}; not {said!r:.80}")
        plugins.check_values(type(own)(**{**{name: getattr(own, name) for name in own.parameters}, **said}))
    return {(effect, name): value for name, value in said.items()}
