"""The fit of all coordinates and maps of a model together, from values near the best ones."""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from ..effects import Effect
from ..errors import SpadError
from . import count_model, map_models, pixel_maps
from .capture_replicates import CannotSimulate
from .coordinates import Coordinate, Key, is_edge, point_of
from .evaluation import Evaluation, evaluate, square, stacked
from .gauss_newton import Fit, JacobianBy, column_of, gauss_newton_step
from .levels import HALF_95
from .models import Model
from .pixel_maps import map_values
from .replicates import FEW, TOTALS, Cell, Replicates
from .results import Step, Value
from .signature import IGNORED, Sampling, captures_showing, residuals_at, signatures

if TYPE_CHECKING:
    from .model_path import ModelPath

# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
_AGAIN = 4  # iterations: further fits of all coordinates at the model with the step, at most
# of a coordinate as it is (a logarithm, or SI): how far a Jacobian holds; it is simulated anew after a longer step
SAME = 0.35
# in chi square: a fall beyond which the fitted model is simulated; and that beyond which a rough fit does so
WORTH, _WORTH_AT_ONCE = 6.0, 30.0
# of a rough fit: moves at most; and in chi square the promised fall for which a rejected Jacobian is simulated anew
_MOVES, _WORTH_A_JACOBIAN = 2, 300.0
_MANY = 32  # replicates for a Jacobian where they fluctuate, at most: its noise against the time
_STEP = 0.01  # of a coordinate: the step for the derivative of the pixels' rates; they are smooth on a scale of 1
# of the squared norm of a column of the Jacobian: the largest blocks with so much inform a coordinate. Whether the
# squares have risen is judged by these, too: the others have noise only
_INFORMING = 0.99
RISEN = 3.0  # standard deviations of the noise of the squares: a larger rise ends the fit
_FARTHEST = 1.2  # of a coordinate: the longest step of a strength with the shapes held
_KEPT = 0.3  # of a promised fall of the squares: with less of it, a Jacobian of fits near by is not used any more
# in chi square: a rise beyond which the last step, which is not simulated, is not taken. An echo had moved by 0.1 ns
# into the next bin, and its line was lost
LOST = 30.0


def fit_all(
    path: ModelPath,
    fit: Fit | None = None,
    known: Evaluation | None = None,
    columns: Sequence[Fit] = (),
    roughly: bool = False,
    near: tuple[Evaluation, Collection[str]] | None = None,
    where_shown: bool = False,
) -> None:
    """Fit the model with all its steps: the maps, then all coordinates together.

    Args:
        fit: of the coordinates of the last step.
        known: an evaluation of the model with it.
        columns: fits near by that hold a column of the Jacobian for every coordinate together; the Jacobian is made
            of these while the squares fall as it says, and `path.approximate` is set. It is simulated without them.
        roughly: the maps stay as they are, and captures that do not show what has moved are not simulated again, until
            `complete_fit`. `known` is given.
        near: of the model without the last step, see `evaluate`.
        where_shown: the Jacobian is simulated where the steps showed when they were added; this assumes that no
            shape has moved to another minimum since.
    """
    if roughly and known is not None:
        maps = _maps_of(path)
    else:
        sensors, maps = model_of(path)
    if known is not None:
        evaluation = replace(known, values=dict(path.values))
    else:
        evaluation = evaluate(path.replicates, path.values, sensors, near=near)
    coordinates = path.free
    found: Fit | None = None
    path.approximate = False
    if coordinates:
        by = StepsBy(
            errors=edge_errors(path, fit),
            near=_side_by_side(evaluation, coordinates, columns),
            roughly=roughly,
            where_shown=where_shown,
        )
        found, evaluation, maps = repeated_steps(path, evaluation, maps, coordinates, by)
        found = found or (fit if fit is not None and fit.coordinates == coordinates else None)
    path.approximate = path.approximate or (roughly and bool(maps))
    path.evaluation = evaluation
    path.fit = found = None if found is None else bounded(path, found)
    _write_values(path, found or fit, maps)


def complete_fit(path: ModelPath) -> None:
    """Fit the maps and all coordinates together, where the last fit was a rough one, or replicates are borrowed."""
    if not path.is_rough or path.not_completed is path.evaluation:
        return
    path.replicates.say("fitting all numbers together")
    before = path.kept()
    maps = any(candidate.carrier for candidate in path.scan.accepted)
    known = None if maps else completed(path.replicates, path.evaluation)
    path.values = dict(path.values if known is None else known.values)
    columns = [path.fit] if path.fit is not None and not path.approximate else []
    fit_all(path, known=known, columns=columns, where_shown=True)
    path.approximate = False
    if path.fit is None and before[4] is not None:  # the model cannot be simulated around its values
        path.back_to(before)
        path.not_completed = path.evaluation
        for one in (step.candidate for step in path.steps[-1:]):
            where = "the fit of all numbers together; the values are those of an approximate fit"
            path.scan.not_tried(one.kind, one.effect, one.parameter, where, path.no_fit_because)


def with_own_errors(path: ModelPath) -> None:
    """Write the intervals by a Jacobian at the values, where that of the last fit is of models near by.

    Columns of models near by hold the noise of their fits. They seem to inform more than they do: the error of a
    probability of afterpulses was a fifth to a half of that of the fit of all numbers. A Jacobian of few replicates
    lacks what may be noise, so that its errors are too large rather than too small. The values stay.

    Raises:
        CannotSimulate: where the model cannot be simulated around its values.
    """
    if path.fit is None or not path.approximate:
        return
    path.replicates.say("the errors of all numbers")
    evaluation, coordinates = path.evaluation, path.fit.coordinates
    # the last step of a rough fit is not simulated: the evaluation is one step away from the values
    here = {d.key: evaluation.values.get(d.key, path.values[d.key]) for d in coordinates}
    only = functools.partial(_shown, path)
    by = JacobianBy(_recordings(evaluation), edge_errors(path, path.fit), _known_jacobian(path), only=only)
    model = functools.partial(path.model_at, evaluation)
    made = gauss_newton_step(path.replicates, evaluation, coordinates, here, model, by)
    there = {d.key: path.values[d.key] for d in coordinates}
    point = point_of(coordinates, there)
    move = point - point_of(coordinates, here)
    residuals = {cell: z + made.jacobian[cell] @ move for cell, z in evaluation.residuals.items()}
    path.fit = replace(
        made, point=point, residuals=residuals, square=square(residuals), values={**made.values, **there}
    )
    _write_values(path, path.fit, _maps_of(path))


def completed(replicates: Replicates, evaluation: Evaluation) -> Evaluation:
    """The evaluation with replicates of its own in all captures."""
    if not evaluation.borrowed:
        return evaluation
    number = len(evaluation.replicate_residuals[TOTALS])
    return evaluate(replicates, evaluation.values, evaluation.sensors, number, evaluation)


def _side_by_side(evaluation: Evaluation, coordinates: tuple[Coordinate, ...], fits: Sequence[Fit]) -> Fit | None:
    """A fit with the columns of several fits as its Jacobian; None where one of the coordinates is in none of them.

    Of its estimate and its covariance nothing is used.
    """
    columns = []
    for coordinate in coordinates:
        fit = next((fit for fit in fits if coordinate in fit.coordinates), None)
        if fit is None:
            return None
        columns.append(column_of(fit, fit.coordinates.index(coordinate), evaluation))
    jacobian = {cell: np.stack([column[cell] for column in columns], axis=1) for cell in evaluation.residuals}
    n = len(coordinates)
    return Fit(
        coordinates=coordinates,
        point=np.zeros(n),
        covariance=np.full((n, n), np.inf),
        residuals={},
        jacobian=jacobian,
        square=math.inf,
        values={},
    )


@dataclass(frozen=True)
class StepsBy:
    """By what repeated steps find their Jacobians, and what they simulate again.

    Attributes:
        errors: standard deviations of coordinates, as in `JacobianBy`.
        near: a fit whose Jacobian is taken at first.
        roughly, where_shown: see `fit_all`.
    """

    errors: Mapping[Key, float] = field(default_factory=dict)
    near: Fit | None = None
    roughly: bool = False
    where_shown: bool = False


def repeated_steps(
    path: ModelPath,
    evaluation: Evaluation,
    maps: dict[Key, pixel_maps.PixelMap],
    coordinates: tuple[Coordinate, ...],
    by: StepsBy = StepsBy(),
) -> tuple[Fit | None, Evaluation, dict[Key, pixel_maps.PixelMap]]:
    """(fit of all coordinates, evaluation of the model, its maps), from values near the best ones.

    The fit is None where the model cannot be simulated around them.

    Args:
        evaluation, maps: of the model at the start.
        coordinates: what is fitted.
    """
    replicates, known = path.replicates, _known_jacobian(path)
    near, roughly = by.near, by.roughly
    fit: Fit | None = None
    rejected: Fit | None = None  # by known columns, at the values from which they led nowhere
    path.approximate = near is not None
    borrowed_columns = path.approximate  # of `fit`: its Jacobian is that of other models
    turn = -1
    while turn < _AGAIN:
        turn += 1
        here = {d.key: path.values[d.key] for d in coordinates}
        try:
            only = functools.partial(_shown, path) if by.where_shown else lambda key: ()
            jacobian_by = JacobianBy(few=_recordings(evaluation), errors=by.errors, known=known, before=near, only=only)
            model = functools.partial(path.model_at, evaluation)
            closer = gauss_newton_step(replicates, evaluation, coordinates, here, model, jacobian_by)
        except CannotSimulate as error:
            path.no_fit_because = str(error)
            path.approximate = path.approximate or borrowed_columns
            if rejected is not None:
                fit, path.approximate = rejected, True
            break
        fit, borrowed_columns = closer, path.approximate
        promised = square(evaluation.residuals) - closer.square
        if promised < 0:  # a step that was cut short leads uphill
            fit = replace(closer, point=point_of(coordinates, here), residuals=evaluation.residuals)
        later = roughly and path.approximate  # what a Jacobian of other models promises little of can wait
        if turn == (_MOVES if later else _AGAIN) or promised < (_WORTH_AT_ONCE if later else WORTH):
            break
        before = path.values, maps, evaluation
        for step in (closer, *_strengths_alone(path, closer, evaluation, here)):
            path.values = {**before[0], **step.values}
            try:
                if roughly:
                    moved = [d for d, x in zip(coordinates, step.point - point_of(coordinates, here), strict=True) if x]
                    shown = [_shown(path, d.key) for d in moved]
                    some = (before[2], set().union(*shown)) if all(shown) else None
                    sensors = path.model_at(before[2], step.values)
                    evaluation = evaluate(replicates, path.values, sensors, near=some)
                else:
                    sensors, maps = model_of(path)
                    evaluation = evaluate(replicates, path.values, sensors)
            except SpadError:  # there is no such model so far off
                continue
            risen, noise = rise_of(before[2], evaluation, list(evaluation.residuals))
            clearer = rise_of(before[2], evaluation, informing(closer))
            if risen <= RISEN * noise and clearer[0] <= RISEN * clearer[1]:
                break
        else:  # a line or an edge: the gradient leads no further
            path.values, maps, evaluation = before
            if path.approximate and (not roughly or promised > _WORTH_A_JACOBIAN):
                rejected = replace(fit, point=point_of(coordinates, here), residuals=evaluation.residuals)
                path.approximate, near, turn = False, None, -1
                continue
            fit = replace(fit, point=point_of(coordinates, here), residuals=evaluation.residuals)
            break
        if path.approximate and -risen < _KEPT * promised - noise:  # the Jacobian is that of another model
            path.values, maps, evaluation = before
            rejected = replace(fit, point=point_of(coordinates, here), residuals=evaluation.residuals)
            if roughly and promised < _WORTH_A_JACOBIAN:
                fit = rejected
                break
            path.approximate, near, turn = False, None, -1
            continue
        fit, rejected = replace(step, residuals=evaluation.residuals), None
        near = closer if np.all(np.abs(step.point - point_of(coordinates, here)) < SAME) else None
        path.approximate = path.approximate and near is not None
    return fit, evaluation, maps


def _strengths_alone(path: ModelPath, fit: Fit, evaluation: Evaluation, here: Mapping[Key, float]) -> Iterator[Fit]:
    """The step of a fit with its shapes and edges held, to which no gradient leads from afar; none where it is alike.

    Args:
        fit: of a Gauss-Newton step from the evaluation; here: the values of the evaluation, SI.
    """
    shapes = {d.key for step in path.steps for d in step.candidate.shapes}
    moves = [i for i, d in enumerate(fit.coordinates) if d.key not in shapes and not is_edge(d)]
    if not 0 < len(moves) < len(fit.coordinates):
        return
    keys = list(fit.jacobian)
    z, slope = stacked(evaluation.residuals, keys), np.concatenate([fit.jacobian[k][:, moves] for k in keys])
    move = np.clip(-np.linalg.pinv(slope) @ z, -_FARTHEST, _FARTHEST)
    held = dict(here)
    for i, change in zip(moves, move, strict=True):
        coordinate = fit.coordinates[i]
        held[coordinate.key] = coordinate.value(coordinate.coordinate(here[coordinate.key]) + float(change))
    yield replace(fit, point=point_of(fit.coordinates, held), values={**fit.values, **held})


def informing(fit: Fit) -> list[Cell]:
    """The blocks that inform the coordinates of a fit: the others hardly change, and have noise only."""
    blocks: set[Cell] = set()
    for i in range(len(fit.coordinates)):
        norms = {cell: float(x[:, i] @ x[:, i]) for cell, x in fit.jacobian.items()}
        order = sorted(norms, key=lambda cell: -norms[cell])
        sums = np.cumsum([norms[cell] for cell in order])
        blocks.update(order[: int(np.searchsorted(sums, _INFORMING * sums[-1])) + 1] if sums[-1:].any() else ())
    return sorted(blocks)


def rise_of(before: Evaluation, after: Evaluation, keys: Sequence[Cell]) -> tuple[float, float]:
    """(rise of the sum of squared residuals of some blocks, its standard deviation by the noise of the replicates).

    Each expectation has the noise of the mean of its replicates, e, which moves the sum by 2 z e.
    """
    keys = [k for k in keys if k in before.replicate_residuals and k in after.replicate_residuals]
    if not keys:
        return 0.0, 0.0
    rise = square({k: after.residuals[k] for k in keys}) - square({k: before.residuals[k] for k in keys})
    replicate_residuals = np.concatenate([before.replicate_residuals[k] for k in keys], axis=1)
    projection = replicate_residuals @ stacked(before.residuals, keys)
    variance = 1 / len(replicate_residuals) + 1 / len(after.replicate_residuals[keys[0]])
    return rise, 2 * math.sqrt(variance) * float(np.std(projection))


def _recordings(evaluation: Evaluation) -> int:
    """The number of replicates for a Jacobian: more where the light fluctuates."""
    return min(len(evaluation.replicate_residuals[TOTALS]), _MANY) if evaluation.fluctuates else 2 * FEW


def bounded(path: ModelPath, fit: Fit) -> Fit:
    """The fit, or the evaluated point where the last step of the fit raises the squares: a line, an edge.

    That step was not simulated before.
    """
    replicates, evaluation, coordinates = path.replicates, path.evaluation, fit.coordinates
    there = {d.key: d.value(float(x)) for d, x in zip(coordinates, fit.point, strict=True)}
    sampling = Sampling(few=_recordings(evaluation))
    (signature,) = signatures(replicates, evaluation, [path.model_at(evaluation, there)], sampling)
    now = square(evaluation.residuals)
    if isinstance(signature, CannotSimulate) or square(residuals_at(replicates, evaluation, signature)) > now + LOST:
        return replace(fit, point=point_of(coordinates, path.values), residuals=evaluation.residuals)
    return fit


def _maps_of(path: ModelPath) -> dict[Key, pixel_maps.PixelMap]:
    """The maps of the steps, as they were fitted last."""
    return {step.candidate.carrier: step.map for step in path.steps if step.candidate.carrier and step.map}


def _write_values(path: ModelPath, fit: Fit | None, maps: Mapping[Key, pixel_maps.PixelMap]) -> None:
    """Write the fitted values of all steps with their intervals; what is no coordinate of the fit stays."""
    if fit is not None:
        place = {d.key: i for i, d in enumerate(fit.coordinates)}
        for step in path.steps:
            extra = variances_by_pixels(path, step, maps)
            for k, coordinate in enumerate(step.coordinates):
                if (i := place.get(coordinate.key)) is None:
                    continue
                variance = max(float(fit.covariance[i, i]), 0.0) + extra[k]
                u, half = float(fit.point[i]), HALF_95 * math.sqrt(variance)
                low, high = coordinate.interval(u - half, u + half)
                step.values[coordinate.parameter] = Value(
                    value=coordinate.value(u), low=low, high=high, unit=coordinate.unit
                )
                path.values[coordinate.key] = coordinate.value(u)
    for step in path.steps:
        if step.candidate.carrier and step.candidate.carrier in maps:
            step.values = map_values(maps[step.candidate.carrier])
            step.map = maps[step.candidate.carrier]
        for (effect, name), (low, high) in step.intervals.items():
            unit = next(d.unit for d in step.candidate.coordinates if d.key == (effect, name))
            own = step.values.get(name) if any(d.key == (effect, name) for d in step.coordinates) else None
            if own is not None and own.low is not None and own.high is not None:
                # the interval for any value of a whole number; it is of no use where later steps have moved the value
                inside = low <= own.value <= high
                low, high = (min(low, own.low), max(high, own.high)) if inside else (own.low, own.high)
            step.values[name] = Value(value=float(path.values[effect, name]), low=low, high=high, unit=unit)
        for (_, name), value in step.candidate.fixed:
            if name not in step.values and isinstance(value, (bool, int, float)):
                step.values[name] = Value(float(value), None, None)


def variances_by_pixels(path: ModelPath, step: Step, maps: Mapping[Key, pixel_maps.PixelMap]) -> np.ndarray:
    """The variances of a light pattern's coordinates that random differences of the pixels cause, (coordinates,).

    Random differences of the pixels have an accidental gradient, which is degenerate with a gradient of the light.
    """
    replicates, one = path.replicates, path.evaluation.sensors.one
    lights = [c for c in path.scan.accepted if c.carrier in maps and pixel_maps.acts_on_light(one, c)]
    lit = [id for id, seen in replicates.seen.items() if seen.counts is not None and not seen.capture.light.dark]
    pattern = Effect.registry.find(step.candidate.effect).is_pattern
    if not (pattern and step.coordinates and lights and lit):
        return np.zeros(len(step.coordinates))
    id = max(lit, key=lambda i: replicates.seen[i].detections)
    columns = []
    for coordinate in step.coordinates:
        u = coordinate.coordinate(float(path.values[coordinate.key]))
        ends = [coordinate.coordinate(coordinate.value(u + h)) for h in (_STEP, -_STEP)]
        rates = [
            count_model.expected_counts(replicates, id, path.evaluation, {coordinate.key: coordinate.value(end)})
            for end in ends
        ]
        slope = (np.log(rates[0]) - np.log(rates[1])) / max(ends[0] - ends[1], 1e-12)
        columns.append(slope - slope.mean())
    design = np.stack(columns, axis=1)
    sigma = max(maps[c.carrier].sigma for c in lights if c.carrier)
    return sigma**2 * np.diag(np.linalg.pinv(design.T @ design, rcond=1e-6, hermitian=True))


def edge_errors(path: ModelPath, fit: Fit | None = None) -> dict[Key, float]:
    """The standard errors of the coordinates of fitted edges, about which the Jacobian holds at small distances only.

    Other coordinates have a Jacobian over larger distances, with less noise.
    """
    out = {}
    for step in path.steps:
        for coordinate in filter(is_edge, step.coordinates):
            v = step.values.get(coordinate.parameter)
            if v is not None and v.low is not None and v.high is not None:
                out[coordinate.key] = coordinate.error(v.low, v.high)
    if fit is not None:
        spread = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
        out |= {d.key: float(x) for d, x in zip(fit.coordinates, spread, strict=True) if is_edge(d)}
    return out


def _known_jacobian(path: ModelPath) -> dict[Key, dict[Cell, np.ndarray]]:
    """The columns of the Jacobian of faint effects, from stronger ones, (cells,) by block, by coordinate."""
    out: dict[Key, dict[Cell, np.ndarray]] = {}
    for step in path.steps:
        for i, coordinate in enumerate(step.coordinates if step.jacobian else ()):
            out[coordinate.key] = {cell: x[:, i] for cell, x in step.jacobian.items()}
    return out


def _shown(path: ModelPath, key: Key) -> list[str]:
    """The captures that show the step with this coordinate, as it was added; none where that is not known."""
    for step in path.steps:
        said = Effect.registry.find(step.candidate.effect).states_mean and not (step.chips or step.fluctuates)
        if said and any(d.key == key for d in step.coordinates):
            return captures_showing(step.template, *IGNORED)
    return []


def model_of(path: ModelPath) -> tuple[Model, dict[Key, pixel_maps.PixelMap]]:
    """(model with all steps, its maps, fitted to the data)."""
    replicates, scan = path.replicates, path.scan
    held = [c for c in scan.accepted if c.carrier]
    chips = any(step.chips and step.candidate.effect not in path.located for step in path.steps)
    if not held:
        values = {**path.values, **path.where(path.values)}
        return Model.same(replicates.start).changed(values, scan.phases, chips), {}
    levels = count_model.light_levels_of(replicates, path.evaluation)
    where = path.where(path.values)
    sensors, maps, values = map_models.models_with_maps(replicates, {**path.values, **where}, held, levels)
    path.values = {key: path.values.get(key, x) if key in where else x for key, x in values.items()}
    return sensors.changed({}, scan.phases, chips), maps


def without_fit(path: ModelPath) -> Evaluation:
    """The evaluation of the model with the values as they are; its maps are fitted."""
    sensors, _ = model_of(path)
    return evaluate(path.replicates, path.values, sensors)
