"""The last values of a diagnosis and their intervals: by the likelihood of the data, scaled by what is left."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..measurement import Measurement
from .candidates import with_values
from .coordinates import Coordinate, Key, Values
from .evaluation import block_checks, evaluate, failing, square
from .exact_likelihood import maximise, not_in_likelihood, recordings
from .gauss_newton import error_scale, gauss_newton_step
from .joint_fit import WORTH, model_of, replicates_of_jacobian, write_values
from .model_path import ModelPath, keys_of
from .models import Model
from .pixel_maps import HALF_95
from .random_pixels import of_pixels
from .replicates import FEW
from .results import Value
from .signature import captures_showing, residuals_at, signatures
from .trial_fits import EXCLUDED, IGNORED

_TURNS = 3  # steps of the fit in the pixels that were hit, which begins near its end
_MOVED = 0.5  # standard deviations: a larger move of a coordinate needs another evaluation


def sharpen(path: ModelPath, measurement: Measurement) -> None:
    """Fit all coordinates by the exact likelihood of the data, where the whole model is in it.

    The fit is not taken where checks fail at its values and another candidate is a tie.
    """
    replicates = path.replicates
    wanted = [step.candidate for step in path.steps if step.coordinates]
    coordinates = [d for step in path.steps for d in step.coordinates]
    if not wanted or len({d.key for d in coordinates}) < len(coordinates) or any(step.phased for step in path.steps):
        return
    captures = [seen.capture for seen in replicates.seen.values()]
    if any(not_in_likelihood(path.evaluation.sensors.one, capture) for capture in captures):
        return
    replicates.say("the likelihood of the data")
    data = recordings(measurement, replicates.start, {id: seen.total for id, seen in replicates.seen.items()})
    if isinstance(data, str):
        return
    own = {key for candidate in wanted for key in keys_of(candidate, path)}
    sensor = with_values(replicates.start, {key: x for key, x in path.values.items() if key not in own})
    start = {d.key: float(path.values[d.key]) for d in coordinates}
    errors = {}
    for step in path.steps:
        for coordinate in step.coordinates:
            v = step.values[coordinate.parameter]
            assert v.low is not None and v.high is not None
            errors[coordinate.key] = abs(coordinate.coordinate(v.high) - coordinate.coordinate(v.low)) / (2 * HALF_95)
    mapped = any(step.candidate.carrier for step in path.steps)
    found = maximise(sensor, data, wanted, start=start, errors=errors, mapped=mapped)
    del data  # the replicates need the memory
    if isinstance(found, str):
        return
    largest_move, failed = 0.0, {block.cell for block in path.failed}
    before = dict(path.values), path.evaluation, [dict(step.values) for step in path.steps]
    for step in path.steps:
        for coordinate in step.coordinates:
            value, (low, high) = found.values[coordinate.key], found.intervals[coordinate.key]
            largest_move = max(
                largest_move,
                abs(coordinate.coordinate(value) - coordinate.coordinate(start[coordinate.key]))
                / errors[coordinate.key],
            )
            step.values[coordinate.parameter] = Value(value, low, high, coordinate.unit, "likelihood")
            path.values[coordinate.key] = value
    if largest_move > _MOVED:
        path.evaluation = evaluate(replicates, path.values, model_of(path)[0])
        rivals = any(other.get("confused") for step in path.steps for other in step.alternatives)
        if rivals and {block.cell for block in path.failed} - failed:
            # of laws that are a tie it knows only one: where that fails, it decides nothing
            path.values, path.evaluation, earlier = before
            for step, values in zip(path.steps, earlier, strict=True):
                step.values = values


def fit_where_hit(path: ModelPath) -> bool:
    """Fit all coordinates once more with effects in the pixels that they have hit; whether that was done.

    In replicates of other chips other pixels are hit, and their scatter hides what the pixels of this chip tell. A
    coordinate that says how many pixels are hit keeps its value. The fit is not taken where another check fails.
    """
    replicates = path.replicates
    hits = {step.candidate.effect: hit.hit for step in path.steps if (hit := path.pixels_hit(step)) is not None}
    if not hits:
        return False
    replicates.say("the numbers of what is in the pixels that were hit")

    def where(values: Values) -> dict[Key, Any]:
        sensor = with_values(replicates.start, values)
        return {key: x for effect, hit in hits.items() for key, x in of_pixels(sensor, effect, hit).items()}

    numbers = {key for key, x in where(path.values).items() if np.ndim(x) == 0}  # the same for any strength
    coordinates = tuple(d for step in path.steps for d in step.coordinates if d.key not in numbers)
    before, best = path.kept(), None
    for _ in range(_TURNS if coordinates else 0):
        here = {d.key: path.values[d.key] for d in coordinates}
        sensors, maps = model_of(path, where(path.values), hits)
        there = evaluate(replicates, path.values, sensors)

        def aside(values: Values, sensors: Model = sensors) -> Model:
            return sensors.changed({**values, **where({**path.values, **values})})

        fit = gauss_newton_step(replicates, there, coordinates, here, aside, replicates_of_jacobian(there))
        if isinstance(fit, str) or (best is not None and square(there.residuals) > square(best[0].residuals)):
            break
        best = there, fit, maps, dict(path.values)
        if square(there.residuals) - fit.square < WORTH:
            break
        path.values = {**path.values, **fit.values}
    failed = {block.cell for block in path.failed}
    if best is None or {b.cell for b in failing(block_checks(replicates, best[0], best[0].residuals))} - failed:
        path.back_to(before)
        return False
    path.evaluation, path.fit, maps, path.values = best
    write_values(path, path.fit, maps)
    return True


def scale_errors(path: ModelPath) -> None:
    """Scale the errors of all fitted values by the misfit of the cells that inform them; see `error_scale`."""
    if path.fit is None:
        return
    wider = error_scale(path.fit, path.evaluation)
    factors = {d.key: float(x) for d, x in zip(path.fit.coordinates, wider, strict=True)}
    for step in path.steps:
        for coordinate in step.coordinates:
            step.values[coordinate.parameter] = _scaled(
                step.values[coordinate.parameter], coordinate, factors.get(coordinate.key, 1.0)
            )


def _scaled(value: Value, coordinate: Coordinate, factor: float) -> Value:
    """The value with an interval `factor` times as wide, in its coordinate."""
    assert value.low is not None and value.high is not None
    u = coordinate.coordinate(value.value)
    ends = [u + factor * (coordinate.coordinate(end) - u) for end in (value.low, value.high)]
    low, high = coordinate.interval(min(ends), max(ends))
    return replace(value, low=low, high=high)


def open_ends(path: ModelPath) -> None:
    """Extend the interval of a shape to an end of its range that the data do not exclude.

    The covariance does not show it.
    """
    tests = []
    for step in path.steps:
        for coordinate in step.coordinates:
            if path.fit is not None and coordinate not in path.fit.coordinates:
                continue  # it keeps the interval that it had before the model had no use for it
            v = step.values[coordinate.parameter]
            if coordinate in step.candidate.shapes and v.low is not None and v.high is not None and not v.method:
                tests += [
                    (step, coordinate, end) for end in (coordinate.low, coordinate.high) if not v.low <= end <= v.high
                ]
    evaluation, replicates = path.evaluation, path.replicates
    models = [evaluation.sensors.changed({coordinate.key: end}) for _, coordinate, end in tests]
    some = [captures_showing(step.template, IGNORED[0]) for step, _, _ in tests]
    now = square(evaluation.residuals)
    for (step, coordinate, end), signature in zip(
        tests, signatures(replicates, evaluation, models, 2 * FEW, only_of=some), strict=True
    ):
        if not isinstance(signature, str) and square(residuals_at(replicates, evaluation, signature)) < now + EXCLUDED:
            v = step.values[coordinate.parameter]
            assert v.low is not None and v.high is not None
            step.values[coordinate.parameter] = replace(v, low=min(v.low, end), high=max(v.high, end))
