"""Gauss-Newton fits of the coordinates of a model to the residuals of all cells, with covariance."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .bounded_step import bounded_step
from .capture_replicates import CannotSimulate
from .coordinates import Coordinate, Key, point_of
from .evaluation import Evaluation, stacked
from .levels import FALL_95, HALF_95
from .models import Model
from .replicates import FEW, Cell, Replicates
from .signature import Sampling, residuals_at, signatures

# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
# of a logarithm: the step to both sides for a column of the Jacobian, the longest one; known errors make it shorter
_ASIDE = 0.2
_CLOSE = 0.02  # the least such step, however small the known error
_KNOWN_ASIDE = (0.1, 0.7)  # (least, most) of that step for a column that is known but for its size
_KNOWN_SIZE = 2.5  # the largest factor on the size of a known column, so that noise does not change it further
# of a logarithm, or of the search range: how far a Jacobian holds; beyond it is simulated anew
_SAME = 0.35
# of the root of the fall so far: a smaller promised fall ends the fit; it is far less than what separates two
# candidates
_PROMISING = 0.1
# in chi square: a smaller promised fall asks for no new Jacobian; and the fall that noise alone promises, for each
# further coordinate
_WORTH_ANEW, _NOISE = 4.0, 2.0
_VAIN = 2  # steps in a row without a fall, the second one shorter, after which the rest is noise and the fit ends
# squared norm of a column of the Jacobian below which the coordinate is not informed, with a standard error above 4.5:
# it then stays where it is, and its error is infinite
_BLIND = 0.05


@dataclass
class Fit:
    """A fit of some coordinates.

    Attributes:
        point: (coordinates,) the estimate.
        covariance: (coordinates, coordinates); infinite for a coordinate that is not informed.
        residuals: (cells,) at the estimate, by block.
        square: the sum of their squares.
        values: all values at the estimate, SI.
        phases: by (capture, parameter), rad.
    """

    coordinates: tuple[Coordinate, ...]
    point: np.ndarray
    covariance: np.ndarray
    residuals: dict[Cell, np.ndarray]
    jacobian: dict[Cell, np.ndarray]  # of the residuals, (cells, coordinates), by block
    square: float
    values: dict[Key, Any]
    phases: dict[tuple[str, Key], float] = field(default_factory=dict)

    def interval(self, i: int) -> tuple[float, float, float]:
        """(value, low, high) of a coordinate: the estimate and its 95 % interval, in the parameter's unit."""
        coordinate, half = self.coordinates[i], HALF_95 * math.sqrt(max(float(self.covariance[i, i]), 0.0))
        u = float(self.point[i])
        return coordinate.value(u), *coordinate.interval(u - half, u + half)


@dataclass(frozen=True)
class Effort:
    """How much a Gauss-Newton fit simulates, and of what.

    Attributes:
        rounds: half the number of steps, at most.
        few: replicates of each capture.
        stronger: (factor, power). A faint effect is simulated `factor` times as strong, and its signature divided by
            factor^power.
        only, names: the captures that are simulated, and the statistics that are reduced, all where they are empty;
            all other cells are taken as constant.
        thorough: it goes on where the promised fall may be that of noise.
    """

    rounds: int = 3
    few: int = FEW
    stronger: tuple[float, float] = (1.0, 1.0)
    only: Collection[str] = ()
    names: Collection[str] = ()
    thorough: bool = False


def gauss_newton(
    replicates: Replicates,
    evaluation: Evaluation,
    coordinates: Sequence[Coordinate],
    values: Mapping[Key, Any],
    sensors_of: Callable[[Mapping[Key, Any]], Model],
    effort: Effort = Effort(),
) -> Fit:
    """A Gauss-Newton fit to the residuals of all cells, damped.

    Every point is simulated.

    Args:
        coordinates: what is fitted.
        values: the start, SI; the other values stay.
        sensors_of: values -> model.
    Raises:
        CannotSimulate: where the model cannot be simulated on the way.
    """
    coordinates = tuple(coordinates)
    keys = list(evaluation.residuals)
    fixed = dict(values)
    factor = effort.stronger[0]

    def at(u: np.ndarray) -> dict[Key, Any]:
        return {**fixed, **{d.key: d.value(float(x)) for d, x in zip(coordinates, u, strict=True)}}

    def evaluate(points: Sequence[np.ndarray]) -> list[np.ndarray | CannotSimulate]:
        models = [sensors_of(boosted(at(u))) for u in points]
        sampling = Sampling(few=effort.few, only=effort.only, names=effort.names)
        found = signatures(replicates, evaluation, models, sampling)
        times = factor ** -effort.stronger[1]
        return [
            m if isinstance(m, CannotSimulate) else stacked(residuals_at(replicates, evaluation, m, times), keys)
            for m in found
        ]

    def boosted(values: dict[Key, Any]) -> dict[Key, Any]:
        if factor == 1:
            return values
        up = {d.key: d.scaled(float(values[d.key]), factor) for d in coordinates if d.off is not None}
        return {**values, **up}

    u = point_of(coordinates, values)
    replicate_residuals = np.concatenate([evaluation.replicate_residuals[k] for k in keys], axis=1)
    steps = np.array([0.25 if d.log else max(0.05 * (d.high - d.low), 0.02) for d in coordinates])
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    begun, noise = 0.0, 0.0 if effort.thorough else _NOISE * max(len(coordinates) - 1, 0)
    jacobian, there, damping, promised, vain = np.zeros((0, len(coordinates))), u, 0.0, 0.0, 0
    limit = np.array([1.2 if d.log else 0.5 * (d.high - d.low) for d in coordinates])
    reach = np.array([_SAME if d.log else _SAME * (d.high - d.low) for d in coordinates])
    seen = np.ones(len(coordinates), bool)  # which coordinates are informed
    for turn in range(2 * effort.rounds):
        # a Jacobian holds for a while: it is made anew where the point has moved on, or the fall was less than
        # promised
        anew = turn == 0 or bool(np.any(np.abs(u - there) > reach))
        found = evaluate([u, *(_points_aside(coordinates, u, steps, seen) if anew else [])])
        z = found[0]
        if isinstance(z, CannotSimulate):
            raise CannotSimulate(str(z))
        cost = float(z @ z)
        if best is not None and not anew and best[0] - cost < 0.3 * promised:
            if promised < _WORTH_ANEW + noise:
                break
            found = [z, *evaluate(_points_aside(coordinates, u, steps, seen))]
            anew = True
        if anew:
            jacobian, there = np.zeros((len(z), len(coordinates))), u
            jacobian[:, seen] = _differences(
                found[1:], _points_aside(coordinates, u, steps, seen), len(z), np.flatnonzero(seen)
            )
            seen = np.einsum("ij,ij->j", jacobian, jacobian) >= _BLIND
        if best is None or cost < best[0]:
            best, damping, vain = (cost, u, z), damping / 3, 0
        else:
            damping, vain = max(3 * damping, 1.0), vain + 1
            if vain == _VAIN:
                break
        if not coordinates:  # with whole numbers alone there is no gradient
            break
        cost, u0, z = best
        normal = jacobian.T @ jacobian
        step = _downhill(normal + damping * np.diag(np.diag(normal)), jacobian.T @ z, coordinates, u0)
        step = step * min(1.0, float(np.min(limit / np.maximum(np.abs(step), 1e-12))))
        u = np.array([d.coordinate(d.value(float(x))) for d, x in zip(coordinates, u0 + step, strict=True)])
        promised = float(cost - ((z + jacobian @ (u - u0)) ** 2).sum())
        error = np.sqrt(np.maximum(np.diag(covariance_of(jacobian, replicate_residuals)), 1e-30))
        # never so short that the threshold for noise appears as a derivative
        steps = np.clip(8 * error, [0.1 if d.log else 0.02 * (d.high - d.low) for d in coordinates], 0.5)
        begun = cost if turn == 0 else begun
        if turn and (
            promised < 1.0 + noise + _PROMISING * math.sqrt(max(begun - cost, 0.0))
            or np.all(np.abs(u - u0) < 0.3 * error)
        ):
            break
    assert best is not None
    cost, u, z = best
    return Fit(
        coordinates=coordinates,
        point=u,
        covariance=covariance_of(jacobian, replicate_residuals),
        residuals=_split(z, evaluation, keys),
        jacobian=_split(jacobian, evaluation, keys),
        square=cost,
        values=at(u),
    )


def _downhill(normal: np.ndarray, gradient: np.ndarray, coordinates: Sequence[Coordinate], u: np.ndarray) -> np.ndarray:
    """The step to the least squares within the search ranges, (coordinates,); one that is not informed stays.

    Args:
        normal: J^T J; gradient: J^T z.
        u: (coordinates,) the point.
    """
    ends = np.array([d.ends for d in coordinates]).reshape(-1, 2).T
    return bounded_step(-gradient, normal, u, ends, np.diag(normal) >= _BLIND)


def _points_aside(
    coordinates: Sequence[Coordinate], u: np.ndarray, steps: np.ndarray, seen: np.ndarray | None = None
) -> list[np.ndarray]:
    """Points to both sides of a point, coordinate by coordinate: (coordinates,) each.

    The point itself is not used: its noise is none of the derivative's.

    Args:
        steps: (coordinates,) the distance of each.
        seen: (coordinates,) bool, which coordinates; all by default.
    """
    out = []
    for i, coordinate in enumerate(coordinates):
        if seen is not None and not seen[i]:
            continue
        for h in (steps[i], -steps[i]):
            other = u.copy()
            other[i] = coordinate.coordinate(coordinate.value(u[i] + h))
            out.append(other)
    return out


def _differences(
    found: Sequence[np.ndarray | CannotSimulate],
    places: Sequence[np.ndarray],
    cells: int,
    which: Sequence[int] | np.ndarray | None = None,
) -> np.ndarray:
    """The Jacobian of the residuals by central differences, (cells, coordinates); 0 without a simulation.

    Args:
        found: residuals (cells,) at the points of `_points_aside`.
        places: those points.
        which: the indices of the coordinates.
    """
    out = np.zeros((cells, len(places) // 2))
    for i in range(out.shape[1]):
        up, down = found[2 * i], found[2 * i + 1]
        k = i if which is None else which[i]
        apart = places[2 * i][k] - places[2 * i + 1][k]
        if not isinstance(up, CannotSimulate) and not isinstance(down, CannotSimulate) and apart > 0:
            out[:, i] = (up - down) / apart
    return out


@dataclass(frozen=True)
class JacobianBy:
    """By what a Jacobian is found.

    Attributes:
        few: replicates of each capture.
        errors: standard deviations of coordinates, as far as they are known; a Jacobian at an edge holds no further.
        known: columns, (cells,) by block, of which only the size is uncertain; the noise of a faint effect hides its
            shape.
        before: a fit from an evaluation near by, whose Jacobian still holds.
        only: the captures that are simulated for the column of a coordinate; all where it is empty. The column is 0 in
            the others.
    """

    few: int = FEW
    errors: Mapping[Key, float] = field(default_factory=dict)
    known: Mapping[Key, Mapping[Cell, np.ndarray]] = field(default_factory=dict)
    before: Fit | None = None
    only: Callable[[Key], Collection[str]] = lambda key: ()


def gauss_newton_step(
    replicates: Replicates,
    evaluation: Evaluation,
    coordinates: Sequence[Coordinate],
    values: Mapping[Key, Any],
    sensors_of: Callable[[Mapping[Key, Any]], Model],
    by: JacobianBy | None = None,
) -> Fit:
    """One Gauss-Newton step from an evaluation, with its full number of replicates.

    Only the Jacobian is from a few more replicates.

    Args:
        values: the values of the evaluation, SI.
        sensors_of: values -> model.
        by: by what the Jacobian is found.
    Raises:
        CannotSimulate: where a model for the Jacobian cannot be simulated.
    """
    coordinates, by = tuple(coordinates), by or JacobianBy()
    keys = list(evaluation.residuals)
    z, u = stacked(evaluation.residuals, keys), point_of(coordinates, values)
    replicate_residuals = np.concatenate([evaluation.replicate_residuals[k] for k in keys], axis=1)
    if by.before is not None and by.before.coordinates == coordinates:
        columns = [stacked(column_of(by.before, i, evaluation), keys) for i in range(len(coordinates))]
        jacobian = np.stack(columns, axis=1)
    else:
        jacobian = _jacobian(replicates, evaluation, coordinates, u, sensors_of, by)
    covariance = covariance_of(jacobian, replicate_residuals)
    error = np.sqrt(np.minimum(np.diag(covariance), 1.0))
    step = _downhill(jacobian.T @ jacobian, jacobian.T @ z, coordinates, u)
    # a coordinate that is not informed stays
    step = np.where(np.isfinite(np.diag(covariance)), np.clip(step, -5 * error, 5 * error), 0.0)
    point = np.array([d.coordinate(d.value(float(x))) for d, x in zip(coordinates, u + step, strict=True)])
    left = z + jacobian @ (point - u)
    new = {**values, **{d.key: d.value(float(x)) for d, x in zip(coordinates, point, strict=True)}}
    return Fit(
        coordinates=coordinates,
        point=point,
        covariance=covariance,
        residuals=_split(left, evaluation, keys),
        jacobian=_split(jacobian, evaluation, keys),
        square=float(left @ left),
        values=new,
    )


def _jacobian(
    replicates: Replicates,
    evaluation: Evaluation,
    coordinates: Sequence[Coordinate],
    u: np.ndarray,
    sensors_of: Callable[[Mapping[Key, Any]], Model],
    by: JacobianBy,
) -> np.ndarray:
    """The Jacobian of the residuals at an evaluation, (cells, coordinates).

    Args:
        u: (coordinates,) the point of the evaluation; the others as in `gauss_newton_step`.
    """
    keys = list(evaluation.residuals)
    cells = sum(len(evaluation.residuals[key]) for key in keys)
    h = np.array([_ASIDE if d.log else max(0.05 * (d.high - d.low), 0.02) for d in coordinates])
    near = np.array([by.errors.get(d.key, math.inf) for d in coordinates])
    h = np.minimum(h, np.maximum(8 * near, _CLOSE))
    known = [d.key in by.known for d in coordinates]
    # the size of a known column is compared with all of it
    only = [() if one else by.only(d.key) for d, one in zip(coordinates, known, strict=True)]
    every = [(i, by.known[d.key]) for i, d in enumerate(coordinates) if known[i]]
    columns = {i: stacked(_column(slope, evaluation), keys) for i, slope in every}
    for i, slope in columns.items():  # so far that the shift is visible
        h[i] = np.clip(2 / max(math.sqrt(float(slope @ slope)), 1e-9), *_KNOWN_ASIDE) * (h[i] / _ASIDE)
    points = _points_aside(coordinates, u, h)
    values_there = [{d.key: d.value(float(x)) for d, x in zip(coordinates, p, strict=True)} for p in points]
    ends: list[np.ndarray | CannotSimulate] = [np.zeros(0)] * len(points)
    for bare in (False, True):
        some = [k for k in range(len(points)) if (k // 2 in columns) == bare]
        made = signatures(
            replicates,
            evaluation,
            [sensors_of(values_there[k]) for k in some],
            Sampling(few=by.few, kept="all" if bare else "likely"),
            only_of=[only[k // 2] for k in some],
        )
        for k, m in zip(some, made, strict=True):
            if isinstance(m, CannotSimulate):
                raise CannotSimulate(str(m))
            ends[k] = stacked(residuals_at(replicates, evaluation, m), keys)
    jacobian = _differences(ends, points, cells)
    for i, slope in columns.items():
        size = float(jacobian[:, i] @ slope) / max(float(slope @ slope), 1e-12)
        jacobian[:, i] = slope * np.clip(size, 1 / _KNOWN_SIZE, _KNOWN_SIZE)
    return jacobian


def column_of(fit: Fit, i: int, evaluation: Evaluation) -> dict[Cell, np.ndarray]:
    """A column of a fit's Jacobian, (cells,) by block; 0 in blocks that have other cells under this evaluation."""
    return _column({cell: jacobian[:, i] for cell, jacobian in fit.jacobian.items()}, evaluation)


def _column(slope: Mapping[Cell, np.ndarray], evaluation: Evaluation) -> dict[Cell, np.ndarray]:
    out = {}
    for key, residuals in evaluation.residuals.items():
        column = slope.get(key)
        out[key] = column if column is not None and len(column) == len(residuals) else np.zeros(len(residuals))
    return out


def profile_intervals(
    replicates: Replicates,
    evaluation: Evaluation,
    fit: Fit,
    sensors_of: Callable[[Mapping[Key, Any]], Model],
    few: int = FEW,
) -> dict[Key, tuple[float, float]]:
    """The 95 % intervals by profile: a coordinate is moved until the squares have risen enough, the others follow.

    Squares of dependent cells rise by more than those of independent ones: by the ratio of the estimate's variance to
    its naive one. Each end is simulated twice, where the covariance puts it and where the first rise puts it.

    Returns:
        (low, high) by (effect, parameter), in its unit.
    """
    jacobian = np.concatenate([fit.jacobian[k] for k in evaluation.residuals])
    naive, n = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-10), len(fit.coordinates)
    informed = [i for i in range(n) if np.isfinite(fit.covariance[i, i]) and naive[i, i] > 0]
    ends = [(i, side) for i in informed for side in (-1, 1)]
    goal = np.array([FALL_95 * fit.covariance[i, i] / naive[i, i] for i, _ in ends])

    def at(i: int, u: float) -> Model:
        point = fit.point + naive[:, i] / naive[i, i] * (u - fit.point[i])
        return sensors_of({d.key: d.value(float(x)) for d, x in zip(fit.coordinates, point, strict=True)})

    def within(i: int, u: float) -> float:
        return fit.coordinates[i].coordinate(fit.coordinates[i].value(u))

    def squares(models: Sequence[Model]) -> np.ndarray:
        keys, found = list(evaluation.residuals), signatures(replicates, evaluation, models, Sampling(few=few))
        z = [
            np.full(1, math.nan)
            if isinstance(m, CannotSimulate)
            else stacked(residuals_at(replicates, evaluation, m), keys)
            for m in found
        ]
        return np.array([float(one @ one) for one in z])

    reach = np.array([math.sqrt(FALL_95 * fit.covariance[i, i]) for i, _ in ends])
    least = squares([sensors_of({d.key: d.value(float(x)) for d, x in zip(fit.coordinates, fit.point, strict=True)})])
    for _ in range(2):
        u = [within(i, fit.point[i] + side * h) for (i, side), h in zip(ends, reach, strict=True)]
        rise = squares([at(i, x) for (i, _), x in zip(ends, u, strict=True)]) - least
        # what rises less at a bound would have gone on
        reach = np.abs(np.array(u) - [fit.point[i] for i, _ in ends])
        more = np.sqrt(goal / np.maximum(np.nan_to_num(rise, nan=1.0), goal / 4))
        reach = reach * np.clip(np.where(np.isnan(rise), 1.0, more), 0.5, 2.0)
    out = [fit.point[i] + side * h for (i, side), h in zip(ends, reach, strict=True)]
    return {
        fit.coordinates[i].key: fit.coordinates[i].interval(out[2 * k], out[2 * k + 1]) for k, i in enumerate(informed)
    }


def covariance_of(jacobian: np.ndarray, replicate_residuals: np.ndarray) -> np.ndarray:
    """The covariance of the least-squares estimate (sandwich), (coordinates, coordinates).

    The cells scatter as they do in the model's replicates. A coordinate that is not informed has an infinite
    variance.

    Args:
        jacobian: (cells, coordinates).
        replicate_residuals: (replicates, cells) residuals.
    """
    solve = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-10) @ jacobian.T
    estimates = replicate_residuals @ solve.T
    n = len(replicate_residuals)
    # a little wider, for the finite number of replicates
    covariance = np.atleast_2d(np.cov(estimates.T)) * (n + 2) / max(n - 2, 1)
    blind = np.einsum("ij,ij->j", jacobian, jacobian) < _BLIND
    covariance[blind, blind] = np.inf  # not informed
    return covariance


def error_scale(fit: Fit, evaluation: Evaluation) -> np.ndarray:
    """The factor by which the standard error of each coordinate is too small, (coordinates,), at least 1.

    It compares the residuals of the cells that inform a coordinate with those of the replicates. A law that is not
    quite the sensor's leaves residuals there, and the estimate is no better than they allow.
    Source: White, Econometrica 50 (1982) 1, and the scale factor of the Particle Data Group.

    Args:
        evaluation: its replicates give the scatter.
    """
    keys = [k for k, z in evaluation.replicate_residuals.items() if len(fit.jacobian.get(k, ())) == z.shape[1]]
    if not keys:
        return np.ones(len(fit.coordinates))
    jacobian, z = np.concatenate([fit.jacobian[k] for k in keys]), stacked(fit.residuals, keys)
    mean_squares = np.concatenate([np.mean(evaluation.replicate_residuals[k] ** 2, axis=0) for k in keys])
    inverse = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-10)
    weight = (jacobian @ inverse) ** 2
    expected, found = weight.T @ mean_squares, weight.T @ z**2
    return np.sqrt(np.maximum(np.divide(found, expected, out=np.ones_like(found), where=expected > 0), 1.0))


def _split(stack: np.ndarray, evaluation: Evaluation, keys: Sequence[Cell]) -> dict[Cell, np.ndarray]:
    out, start = {}, 0
    for key in keys:
        size = len(evaluation.residuals[key])
        out[key] = stack[start : start + size]
        start += size
    return out
