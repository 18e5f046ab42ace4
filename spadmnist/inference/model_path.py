"""The path of models of a diagnosis: the model so far, its steps, and the fit of all their coordinates together."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..effects import Effect
from ..measurement import Measurement
from . import count_model, held_out, map_models, pixel_maps
from .candidates import Candidate, with_values
from .coordinates import Coordinate, Key, is_edge, point_of
from .error_budget import HeldMaps, Rung, physical_errors
from .evaluation import BlockCheck, Evaluation, block_checks, evaluate, failing, mean_misfit, square, stacked
from .exact_likelihood import maximise, not_in_likelihood, recordings
from .gauss_newton import Fit, error_scale, gauss_newton_step
from .models import Model
from .phases import evaluate_start
from .pixel_maps import HALF_95, map_values
from .random_pixels import PixelsHit, pixels_hit
from .replicates import FEW, TOTALS, Cell, Replicates
from .results import Step, Value, title
from .scan import Scan
from .signature import captures_showing, residuals_at, signatures, template_of
from .trial import Trial
from .trial_fits import EXCLUDED, IGNORED

_AGAIN = 4  # further fits of all coordinates at the model with the step
_SAME = 0.35  # of a coordinate: how far a Jacobian holds
_WORTH = 6.0  # in chi square: a fall beyond which the fitted model is simulated
_MANY = 32  # replicates for a Jacobian where they fluctuate
_STEP = 0.01  # of a coordinate: the step for the derivative of the pixels' rates
_MOVED = 0.5  # standard deviations: a larger move of a coordinate needs another evaluation
_RISEN = 3.0  # standard deviations of the noise of the squares: a larger rise ends the fit
_FARTHEST = 1.2  # of a coordinate: the longest step of a strength with the shapes held
_LOST = 30.0  # in chi square: a rise beyond which a fitted step is not taken


@dataclass
class ModelPath:
    """A diagnosis under way: the evaluation of the model so far.

    Attributes:
        values: of all steps, by (effect, parameter), SI.
        ladder: the error budget so far.
    """

    replicates: Replicates
    scan: Scan
    evaluation: Evaluation
    values: dict[Key, Any]
    steps: list[Step]
    ladder: list[Rung]
    fit: Fit | None = None  # of the coordinates of all steps, with the Jacobian
    nearest: list[Step] = field(default_factory=list)  # steps that only resembled what remains
    finished: bool = True  # no budget has ended it

    @property
    def held_out(self) -> dict[Cell, np.ndarray]:
        """The residuals of each capture with the coordinates fitted without it, (cells,) by block; see `held_out`."""
        return (
            self.evaluation.residuals
            if self.fit is None
            else held_out.leave_one_capture_out(self.evaluation.residuals, self.fit.jacobian)
        )

    @property
    def failed(self) -> list[BlockCheck]:
        """The checks that fail."""
        return failing(block_checks(self.replicates, self.evaluation, self.evaluation.residuals))

    @property
    def misfit(self) -> float:
        """The misfit on captures that are left out of the fit, as far as there are any; 1 if the model is right."""
        return mean_misfit(self.evaluation.replicate_residuals, self.held_out)

    def kept(self) -> tuple[Any, ...]:
        """A copy of all that a step changes, for `back_to`."""
        own = (self.evaluation, dict(self.values), list(self.steps), list(self.ladder), self.fit)
        fitted = [(step, dict(step.values), step.map) for step in self.steps]  # a fit writes into the steps
        return (*own, list(self.scan.accepted), dict(self.scan.phases), fitted)

    def back_to(self, kept: tuple[Any, ...]) -> None:
        """Restore the state that `kept` returned."""
        self.evaluation, self.values, self.steps, self.ladder, self.fit = kept[:5]
        self.scan.accepted, self.scan.phases, fitted = kept[5:]
        for step, values, map_ in fitted:
            step.values, step.map = values, map_

    def rung(self, name: str, steps: Sequence[Step] = ()) -> None:
        """Append the model to the error budget.

        Args:
            name: of the row.
            steps: those that the model adds.
        """
        left = self.held_out
        errors = physical_errors(self.replicates, self.evaluation, left, strict=not self.ladder)
        misfit = mean_misfit(self.evaluation.replicate_residuals, left)
        held = [c for c in self.scan.accepted if c.carrier]
        chips = any(step.chips for step in self.steps)
        maps = HeldMaps(dict(self.values), held, dict(self.scan.phases), chips) if held else None
        self.ladder.append(Rung(name, self.evaluation, misfit, errors, left, self.fit, list(steps), maps))

    @property
    def sensor_values(self) -> dict[Key, Any]:
        """The values of one sensor that stands for the model, SI; its pixels are those of the chip.

        A map has the spread of the chip, and what hits pixels at random is in those that it has hit.
        """
        maps = {step.candidate.carrier: step.map for step in self.steps if step.candidate.carrier and step.map}
        values = {**self.values, **{key: map_.spread_values() for key, map_ in maps.items() if key in self.values}}
        for step in self.steps:
            found = self.pixels_hit(step)
            values |= {} if found is None else found.values
        return values

    def locate(self) -> None:
        """Write into each step the pixels that its effect has hit."""
        for step in self.steps:
            found = self.pixels_hit(step)
            step.hit = None if found is None else found.hit

    def pixels_hit(self, step: Step) -> PixelsHit | None:
        """The pixels of the chip that a step's effect has hit; None where that is not known."""

        def made() -> PixelsHit | None:
            with self.scan.if_possible(step.candidate, "the pixels that it has hit", wholly=False):
                return pixels_hit(self.replicates, self.evaluation, self.values, step.candidate.effect)
            return None

        return self.evaluation.once(("pixels hit", step.candidate.effect), made) if step.chips else None

    def last_rung(self) -> None:
        """Replace the last row of the error budget by the model as it is now."""
        last = self.ladder.pop()
        self.rung(last.model, last.steps)


def begin(replicates: Replicates) -> ModelPath:
    """The path with the stated model, the phases of its periodic effects fitted."""
    replicates.say("the model as it is")
    scan = Scan(replicates, replicates.say)
    evaluation, phases = evaluate_start(replicates)
    scan.phases.update(phases)
    path = ModelPath(replicates, scan, evaluation, {}, [], [])
    path.rung("start")
    return path


def accept(path: ModelPath, best: Trial, significance: float) -> list[Step]:
    """The steps of the best candidate, which are added to the model; all coordinates are fitted anew.

    Args:
        significance: of the candidate, standard deviations.
    """
    replicates, before = path.replicates, path.evaluation
    new = [
        Step(
            candidate,
            {},
            0.0,
            significance,
            material(best),
            coordinates=best.fit.coordinates if best.fit is not None else (),
            jacobian=best.fit.jacobian if best.fit is not None and best.faint else {},
            template=template_of(replicates, before, best.there or best.signature),
            before=dict(before.residuals),
            phased=bool(best.phases),
            chips=best.chips,
            fluctuates=best.fluctuates,
            intervals=dict(best.intervals),
        )
        for candidate in best.candidates
    ]
    path.scan.accepted += best.candidates
    path.scan.phases.update(best.phases)
    path.steps += new
    known = best.evaluation if not any(candidate.carrier for candidate in path.scan.accepted) else None
    # the evaluated model has the earlier values where they were simulated, one step before the fitted ones
    path.values = {**(path.values if known is None else before.values), **best.values}
    fit_all(path, best.fit, known)
    path.rung("+ " + " + ".join(title(step.candidate) for step in new), new)
    return new


def fit_all(path: ModelPath, fit: Fit | None = None, known: Evaluation | None = None) -> None:
    """Fit the model with all its steps: the maps, then all coordinates together.

    Args:
        fit: of the coordinates of the last step.
        known: an evaluation of the model with it.
    """
    sensors, maps = _model(path)
    evaluation = replace(known, values=dict(path.values)) if known else evaluate(path.replicates, path.values, sensors)
    coordinates = tuple(d for step in path.steps for d in step.coordinates)
    found: Fit | None = None
    if known is not None and fit is not None and fit.own and fit.coordinates == coordinates:
        found = fit  # by the likelihood, of which squares know nothing
    elif coordinates:
        found, evaluation, maps = _gauss_newton(path, evaluation, maps, coordinates, edge_errors(path, fit))
        found = found or (fit if fit is not None and fit.coordinates == coordinates else None)
    path.evaluation = evaluation
    path.fit = found = found if found is None or found.own else _bounded(path, found)
    _write_values(path, found, maps)


def _gauss_newton(
    path: ModelPath,
    evaluation: Evaluation,
    maps: dict[Key, pixel_maps.PixelMap],
    coordinates: tuple[Coordinate, ...],
    errors: Mapping[Key, float],
) -> tuple[Fit | None, Evaluation, dict[Key, pixel_maps.PixelMap]]:
    """(fit of all coordinates, evaluation of the model, its maps), from values near the best ones.

    The fit is None where the model cannot be simulated around them.
    """
    replicates, known = path.replicates, _known_jacobian(path)
    fit: Fit | None = None
    near: Fit | None = None
    for turn in range(_AGAIN + 1):
        here = {d.key: path.values[d.key] for d in coordinates}
        closer = gauss_newton_step(
            replicates,
            evaluation,
            coordinates,
            here,
            evaluation.sensors.changed,
            _recordings(evaluation),
            errors,
            known,
            near,
        )
        if isinstance(closer, str):
            break
        fit = closer
        if turn == _AGAIN or square(evaluation.residuals) - closer.square < _WORTH:
            break
        before = path.values, maps, evaluation
        for step in (closer, *_strengths_alone(path, closer, evaluation, here)):
            path.values = {**before[0], **step.values}
            sensors, maps = _model(path)
            evaluation = evaluate(replicates, path.values, sensors)
            risen = square(evaluation.residuals) - square(before[2].residuals)
            if risen <= _RISEN * _noise_of_square(before[2]):
                break
        else:  # a line or an edge: the gradient leads no further
            path.values, maps, evaluation = before
            fit = replace(fit, point=point_of(coordinates, here), residuals=evaluation.residuals)
            break
        near = closer if np.all(np.abs(step.point - point_of(coordinates, here)) < _SAME) else None
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


def _noise_of_square(evaluation: Evaluation) -> float:
    """The standard deviation of the sum of squared residuals by the noise of the replicates, between two evaluations.

    Each expectation has the noise of the mean of its replicates, e, which moves the sum by 2 z e.
    """
    keys = [k for k in evaluation.residuals if k in evaluation.replicate_residuals]
    own = np.concatenate([evaluation.replicate_residuals[k] for k in keys], axis=1)
    along = own @ stacked(evaluation.residuals, keys)
    return 2 * math.sqrt(2 / len(own)) * float(np.std(along))


def _recordings(evaluation: Evaluation) -> int:
    """The number of replicates for a Jacobian: more where the light fluctuates."""
    return min(len(evaluation.replicate_residuals[TOTALS]), _MANY) if evaluation.fluctuates else 2 * FEW


def _bounded(path: ModelPath, fit: Fit) -> Fit:
    """The fit, or the evaluated point where the last step of the fit raises the squares: a line, an edge.

    That step was not simulated before.
    """
    replicates, evaluation, coordinates = path.replicates, path.evaluation, fit.coordinates
    there = {d.key: d.value(float(x)) for d, x in zip(coordinates, fit.point, strict=True)}
    (signature,) = signatures(replicates, evaluation, [evaluation.sensors.changed(there)], _recordings(evaluation))
    now = square(evaluation.residuals)
    if isinstance(signature, str) or square(residuals_at(replicates, evaluation, signature)) > now + _LOST:
        return replace(fit, point=point_of(coordinates, path.values), residuals=evaluation.residuals)
    return fit


def _write_values(path: ModelPath, fit: Fit | None, maps: Mapping[Key, pixel_maps.PixelMap]) -> None:
    """Write the fitted values of all steps with their intervals."""
    if fit is not None:
        place = {d.key: i for i, d in enumerate(fit.coordinates)}
        for step in path.steps:
            extra = _of_pixels(path, step, maps)
            for k, coordinate in enumerate(step.coordinates):
                i = place[coordinate.key]
                variance = max(float(fit.covariance[i, i]), 0.0) + extra[k]
                u, half = float(fit.point[i]), HALF_95 * math.sqrt(variance)
                step.values[coordinate.parameter] = Value(
                    coordinate.value(u), *coordinate.interval(u - half, u + half), coordinate.unit
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
            step.values[name] = Value(float(path.values[effect, name]), low, high, unit)
        for (_, name), value in step.candidate.fixed:
            if name not in step.values and isinstance(value, (bool, int, float)):
                step.values[name] = Value(float(value), None, None)


def _of_pixels(path: ModelPath, step: Step, maps: Mapping[Key, pixel_maps.PixelMap]) -> np.ndarray:
    """The variances of a light pattern's coordinates by the differences of the pixels, (coordinates,).

    Random differences of the pixels have a gradient by chance, which is confused with one of the light.
    """
    replicates, one = path.replicates, path.evaluation.sensors.one
    lights = [c for c in path.scan.accepted if c.carrier in maps and pixel_maps.acts_on_light(one, c)]
    lit = [id for id, seen in replicates.seen.items() if seen.counts is not None and not seen.capture.light.dark]
    pattern = Effect.registry.find(step.candidate.effect).is_pattern
    if not (pattern and step.coordinates and lights and lit):
        return np.zeros(len(step.coordinates))
    id = max(lit, key=lambda i: replicates.seen[i].total)
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
                out[coordinate.key] = abs(coordinate.coordinate(v.high) - coordinate.coordinate(v.low)) / (2 * HALF_95)
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


def _model(path: ModelPath) -> tuple[Model, dict[Key, pixel_maps.PixelMap]]:
    """(model with all steps, its maps, fitted to the data)."""
    replicates, scan = path.replicates, path.scan
    held = [c for c in scan.accepted if c.carrier]
    chips = any(step.chips for step in path.steps)
    if not held:
        return Model.same(replicates.start).changed(path.values, scan.phases, chips), {}
    levels = count_model.light_levels_of(replicates, path.evaluation)
    sensors, maps, path.values = map_models.models_with_maps(replicates, path.values, held, levels)
    return sensors.changed({}, scan.phases, chips), maps


def without_fit(path: ModelPath) -> Evaluation:
    """The evaluation of the model with the values as they are; its maps are fitted."""
    sensors, _ = _model(path)
    return evaluate(path.replicates, path.values, sensors)


def material(one: Trial) -> str:
    """The change of the mean rate by a candidate, as text."""
    logs = list(one.signature.at(one.times).logs.values())
    return f"mean rate {100 * math.expm1(-float(np.mean(logs)) if logs else 0.0):+.2f} %"


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
        path.evaluation = evaluate(replicates, path.values, _model(path)[0])
        rivals = any(other.get("confused") for step in path.steps for other in step.alternatives)
        if rivals and {block.cell for block in path.failed} - failed:
            # of laws that are a tie it knows only one: where that fails, it decides nothing
            path.values, path.evaluation, earlier = before
            for step, values in zip(path.steps, earlier, strict=True):
                step.values = values


def keys_of(candidate: Candidate, path: ModelPath) -> set[Key]:
    """The parameters that a candidate changes in the model of a path."""
    if candidate.kind == "add":
        return {k for k in path.values if k[0] == candidate.effect}
    return {(candidate.effect, candidate.parameter or "")}


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
