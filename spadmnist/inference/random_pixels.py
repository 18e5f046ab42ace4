"""Effects that hit pixels at random: fits by the likelihood with their own scatter.

Such an effect hits pixels at random. In units of the scatter of the model without it, the pixels that it has hit in the
data have by far the largest residuals, whatever its strength and time constant. Their squares do not inform these two.
In units of the scatter of the model with the effect these residuals are ordinary. Its shape is therefore chosen by the
quasi-likelihood ratio, and its coordinates are fitted by Gauss-Newton steps from evaluations of the model with the
effect (iteratively reweighted least squares).
Source: McCullagh and Nelder, Generalized Linear Models (1989), 2.5 and 9.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from ..errors import SpadError
from .budget import OutOfBudget
from .capture_replicates import CannotSimulate
from .checks import block_checks, failing
from .coordinates import Key, Values, point_of
from .evaluation import Evaluation, evaluate, log_likelihood_ratio, square
from .gauss_newton import Fit, JacobianBy, gauss_newton_step
from .models import Model
from .replicates import FEW, Replicates
from .signature import IGNORED, Sampling, captures_showing, residuals_at, signatures, template_of
from .trial import Trial

# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
_OF_A_SHAPE = 8  # replicates of each capture by which shapes are compared: few, for there may be a dozen shapes
_TURNS = 6  # steps at most; from the nearest of the shapes four were enough for dark counts that blink
_VAIN = 2  # steps in a row without a larger likelihood, after which the rest is noise and the fit ends
# in chi square, for each coordinate: a smaller promised fall is the noise of a Jacobian, and the fit ends
_PROMISED = 5.0


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
    (signature,) = signatures(replicates, evaluation, [there.sensors], Sampling(only=some))
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
