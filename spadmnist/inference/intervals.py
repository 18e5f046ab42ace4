"""The final values of a diagnosis and their intervals: by the exact likelihood, errors scaled by the misfit left."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from ..errors import UNABLE
from ..measurement import Measurement
from .candidates import with_values
from .capture_replicates import CannotSimulate
from .coordinates import Coordinate, Key
from .evaluation import evaluate, square
from .exact_likelihood import NoLikelihood, maximise, not_in_likelihood, recordings
from .gauss_newton import Fit, error_scale
from .joint_fit import fit_all, model_of
from .model_path import ModelPath, keys_of
from .replicates import FEW
from .results import Value
from .signature import IGNORED, Sampling, captures_showing, residuals_at, signatures
from .trial_fits import EXCLUDED

# standard deviations: a larger move of a coordinate by the exact likelihood needs another evaluation; a rule of thumb
_MOVED = 0.5


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
    own = {key for candidate in wanted for key in keys_of(candidate, path)}
    sensor = with_values(replicates.start, {key: x for key, x in path.values.items() if key not in own})
    start = {d.key: float(path.values[d.key]) for d in coordinates}
    errors = {}
    for step in path.steps:
        for coordinate in step.coordinates:
            v = step.values[coordinate.parameter]
            assert v.low is not None and v.high is not None
            errors[coordinate.key] = coordinate.error(v.low, v.high)
    mapped = any(step.candidate.carrier for step in path.steps)
    try:
        data = recordings(measurement, replicates.start, {id: seen.detections for id, seen in replicates.seen.items()})
        found = maximise(sensor, data, wanted, start=start, errors=errors, mapped=mapped)
    except NoLikelihood:
        return
    del data  # the replicates need the memory
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
            step.values[coordinate.parameter] = Value(
                value=value, low=low, high=high, unit=coordinate.unit, method="likelihood"
            )
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
    """Fit the model once more, with effects that hit pixels at random in the pixels that they have hit.

    Replicates of other chips have the effect in other pixels. Their scatter hides what the pixels of this chip show. A
    coordinate that changes nothing here, the share of the pixels, keeps its value and its interval. A model with a map
    of pixels is left as it is: the map is fitted beside the pixels that were hit. The fit is not taken where a check
    fails that passed before, or fails more clearly.

    Returns:
        Whether the fit was taken.

    Raises:
        SpadError: where the model cannot be simulated; the path is as it was.
    """
    hits = {step.candidate.effect: hit.hit for step in path.steps if (hit := path.pixels_hit(step)) is not None}
    if not hits or any(candidate.carrier for candidate in path.scan.accepted):
        return False
    path.replicates.say("fitting in the pixels that were hit")
    before, failed = path.kept(), {block.cell: block.p for block in path.failed}
    try:
        path.located = hits
        free = path.free
        scale_errors(path, {d.key for step in path.steps for d in step.coordinates if d not in free})
        fit_all(path)
    except UNABLE:
        path.back_to(before)
        raise
    if any(block.p < failed.get(block.cell, 1.0) for block in path.failed):
        path.back_to(before)
        return False
    return True


def scale_errors(path: ModelPath, only: Collection[Key] | None = None) -> None:
    """Scale the errors of the values of the last fit by the misfit of the cells that inform them; see `error_scale`.

    Args:
        only: the coordinates; all where it is None.
    """
    if path.fit is None:
        return
    wider = error_scale(path.fit, path.evaluation)
    factors = {d.key: float(x) for d, x in zip(path.fit.coordinates, wider, strict=True)}
    for step in path.steps:
        for coordinate in step.coordinates:
            if only is not None and coordinate.key not in only:
                continue
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

    The covariance does not show it. The other numbers of the fit follow, as they do along its valley.
    """
    tests, free = [], path.free
    for step in path.steps:
        for coordinate in step.coordinates:
            if coordinate not in free:
                continue  # it does not change the model, so that no end of its range is excluded
            v = step.values[coordinate.parameter]
            if coordinate in step.candidate.shapes and v.low is not None and v.high is not None and not v.method:
                tests += [
                    (step, coordinate, end) for end in (coordinate.low, coordinate.high) if not v.low <= end <= v.high
                ]
    evaluation, replicates = path.evaluation, path.replicates
    models = [path.model_at(evaluation, _along(path.fit, coordinate, end)) for _, coordinate, end in tests]
    some = [captures_showing(step.template, IGNORED[0]) for step, _, _ in tests]
    now = square(evaluation.residuals)
    for (step, coordinate, end), signature in zip(
        tests, signatures(replicates, evaluation, models, Sampling(few=2 * FEW), only_of=some), strict=True
    ):
        if isinstance(signature, CannotSimulate):
            continue
        if square(residuals_at(replicates, evaluation, signature)) < now + EXCLUDED * _inflation(path.fit, coordinate):
            v = step.values[coordinate.parameter]
            assert v.low is not None and v.high is not None
            step.values[coordinate.parameter] = replace(v, low=min(v.low, end), high=max(v.high, end))


def _naive(fit: Fit) -> np.ndarray:
    """The covariance of a fit if its cells were independent, (coordinates, coordinates)."""
    jacobian = np.concatenate([np.zeros((0, len(fit.coordinates))), *fit.jacobian.values()])
    return np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-10)


def _along(fit: Fit | None, coordinate: Coordinate, end: float) -> dict[Key, float]:
    """The values with one coordinate held at an end of its range and the others of the fit maximized again."""
    if fit is None or coordinate not in fit.coordinates:
        return {coordinate.key: end}
    i, naive = fit.coordinates.index(coordinate), _naive(fit)
    if not naive[i, i] > 0:
        return {coordinate.key: end}
    point = fit.point + naive[:, i] / naive[i, i] * (coordinate.coordinate(end) - fit.point[i])
    values = {d.key: d.value(float(x)) for d, x in zip(fit.coordinates, point, strict=True)}
    return {**values, coordinate.key: end}


def _inflation(fit: Fit | None, coordinate: Coordinate) -> float:
    """The factor by which the squares of dependent cells rise more than those of independent ones, at least 1."""
    if fit is None or coordinate not in fit.coordinates:
        return 1.0
    i, naive = fit.coordinates.index(coordinate), _naive(fit)
    wider = fit.covariance[i, i] / naive[i, i] if naive[i, i] > 0 else 1.0
    return max(float(wider), 1.0) if np.isfinite(wider) else 1.0
