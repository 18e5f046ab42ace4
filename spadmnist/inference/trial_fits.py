"""Fits of the coordinates of one trial."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .capture_replicates import CannotSimulate
from .checks import block_checks, failing
from .coordinates import Coordinate, Key, is_edge, point_of, room_of
from .evaluation import Evaluation, square, stacked
from .gauss_newton import Effort, Fit, covariance_of, gauss_newton
from .phases import NEAR, choose_phase, simulate_phases
from .random_pixels import fit_by_own_scatter
from .replicates import FEW, TOTALS, Cell, Replicates
from .signature import (
    IGNORED,
    Sampling,
    captures_informing,
    captures_showing,
    residuals_at,
    signatures,
    size_of,
    statistics_showing,
    template_of,
)
from .trial import Trial

# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
# of the square of a signature, as a share and in variances: other statistics are left out, unless they fail
_HARDLY = 1e-3, 1.0
_ASIDE = 0.1  # of a logarithm: the step for the derivative of a periodic candidate by its strength
# standard deviations of a signature that noise hardly blurs: fainter effects are simulated at a larger strength
STRONG = 60.0
# of a logarithm: the distances of the probes about a fitted shape or edge, where no gradient leads
_PROBES = (0.1, 0.03, 0.01, 0.003)
_FINE = (0.0015, 0.0007)  # the same, of an edge: it may be known to some 10 ps
_ROUNDS_AFTER_PROBES = 2  # of the strengths' fit at the best probe, see `gauss_newton`; as for a whole number
# of a logarithm: the first distances of an edge; how often they are repeated, at most
_FAR, _MOVES = (0.6, 0.3, 0.15), 6
# powers with which a signature may grow if it is simulated at another strength: about linear to about quadratic
_POWERS = (0.85, 2.3)
# of the square of a signature, in one cell of a spectrum: then it is a line, and is simulated at its own strength
_LINE = 0.25
_LEAST_BOOST = 1.5  # the least factor on the strength for which a stronger simulation is worth it
_PHASE_REPLICATES = 6  # replicates for phases: a periodic model draws other random numbers, so that it has more noise
_NEXT = 0.35, 0.1  # of a whole number's logarithm: the first step to its neighbours, and the shortest
# in chi square: the least fall for another whole number; the rise beyond which one is excluded
_BETTER, EXCLUDED = 2.0, 6.0


def fit_trial(replicates: Replicates, evaluation: Evaluation, one: Trial, rounds: int = 3) -> Trial:
    """The trial with its coordinates fitted, and the fall of the squares there.

    Args:
        rounds: see `gauss_newton`.
    Raises:
        SpadError: where it cannot be simulated.
    """
    if one.maps is not None or not one.candidate.coordinates:
        one.residuals = residuals_at(replicates, evaluation, one.signature, noisy=True)
        return one
    if one.candidate.phases:
        return _fit_phases(replicates, evaluation, one)
    given = one.scaled()
    coordinates = [d for d in one.candidate.coordinates if d.key in given and not d.whole]
    boost, power = boost_of(replicates, evaluation, one, given)
    template = template_of(replicates, evaluation, one.signature.at(one.times))
    # the squares that a faint effect leaves are those of this fit, and a whole number is not fitted again
    if boost > 1 or any(coordinate.whole for coordinate in one.candidate.coordinates):
        some = captures_showing(template, *IGNORED)
    else:
        some = captures_informing(replicates, evaluation, template)
    names = _statistics_of(replicates, evaluation, template) if boost == 1 else []

    def fit(values: Mapping[Key, Any], rounds: int = rounds, coordinates: Sequence[Coordinate] = coordinates) -> Fit:
        return gauss_newton(
            replicates,
            evaluation,
            coordinates,
            values,
            lambda v: evaluation.sensors.changed(v, one.phases, one.chips),
            Effort(rounds, stronger=(boost, power), only=some, names=names),
        )

    found = fit(given)
    for coordinate in one.candidate.coordinates:
        if coordinate.whole and coordinate.key in given:
            found, intervals = fit_whole_number(found, coordinate, lambda v: fit(v, 2))
            one.intervals |= intervals
    if boost == 1 and fails_own_checks(replicates, evaluation, one, found, some):
        probed = fit_by_probes(replicates, evaluation, one, found, some, names)
        found = probed if probed is found else _strengths_anew(one, probed, fit)
    one.faint = boost > 1
    one.sensors = evaluation.sensors.changed(found.values, one.phases, one.chips)
    if not one.faint:  # the signature at the fitted values may differ from that of the trial
        (there,) = signatures(replicates, evaluation, [one.sensors])
        if isinstance(there, CannotSimulate):
            raise CannotSimulate(str(there))
        one.there, residuals = there, residuals_at(replicates, evaluation, there)
        found = replace(found, residuals=residuals, square=square(residuals))
    one.fit, one.values, one.residuals, one.times = found, dict(found.values), found.residuals, 1.0
    one.fall = square(evaluation.residuals) - found.square
    if one.chips and not one.faint and found.coordinates:
        return fit_by_own_scatter(replicates, evaluation, one)
    return one


def _statistics_of(
    replicates: Replicates, evaluation: Evaluation, template: Mapping[tuple[str, str], np.ndarray]
) -> list[str]:
    """The statistics by which a trial is fitted: those that show it, and those that fail.

    At another shape it may show in others than at that of its template.
    """
    checks = failing(block_checks(replicates, evaluation, evaluation.residuals))
    failed = {block.cell[1] for block in checks if block.cell[0]}
    return sorted(failed.union(statistics_showing(template, *_HARDLY)))


def fails_own_checks(
    replicates: Replicates, evaluation: Evaluation, one: Trial, found: Fit, only: Collection[str]
) -> bool:
    """Whether a check fails at the fitted values, of those with a signature.

    Args:
        only: the captures that were simulated in the fit.
    """
    template = template_of(replicates, evaluation, one.signature.at(one.times))
    failed = failing(block_checks(replicates, evaluation, found.residuals))
    own = {TOTALS if block.cell[0] == "" else block.cell for block in failed if block.cell[0] in ("", *only)}
    return any(float(template[cell] @ template[cell]) > 1 for cell in own if cell in template)


def boost_of(
    replicates: Replicates, evaluation: Evaluation, one: Trial, given: Mapping[Key, Any]
) -> tuple[float, float]:
    """(factor by which a faint effect is simulated stronger, power with which its signature grows).

    (1, 1) where there is no such power: an edge moves, and a large effect saturates.
    """
    template = template_of(replicates, evaluation, one.signature.at(one.times))
    size = math.sqrt(sum(float(t @ t) for t in template.values()))
    strengths = [d for d in one.candidate.strengths if d.key in given]
    spectra = [t for cell, t in template.items() if cell in evaluation.nulls and evaluation.nulls[cell].law.spectrum]
    if any(float(np.max(t**2)) > _LINE * size**2 for t in spectra if t.size):
        return 1.0, 1.0  # a line is significant by itself, and no gradient leads to it
    if size > STRONG or one.signature.even or not strengths or any(is_edge(d) for d in strengths):
        return 1.0, 1.0
    room = min(room_of(d, float(given[d.key])) for d in strengths)
    boost = min((STRONG / max(size, 1e-3)) ** (1 / one.power), room)
    if boost < _LEAST_BOOST:
        return 1.0, 1.0
    ups = [{d.key: d.scaled(float(given[d.key]), x) for d in strengths} for x in (boost, math.sqrt(boost))]
    models = [evaluation.sensors.changed({**given, **up}, one.phases, one.chips) for up in ups]
    templates = []
    for signature in signatures(replicates, evaluation, models, Sampling(few=2 * FEW, kept="sure")):
        if isinstance(signature, CannotSimulate):
            return 1.0, 1.0
        templates.append(stacked(template_of(replicates, evaluation, signature), list(evaluation.residuals)))
    far, near = templates
    projection = float(near @ far)  # the projection on the same signature, so that noise is not compared
    power = 2 * math.log(float(far @ far) / projection) / math.log(boost) if projection > 0 else 0.0
    return (boost, power) if _POWERS[0] < power < _POWERS[1] else (1.0, 1.0)


def fit_by_probes(
    replicates: Replicates,
    evaluation: Evaluation,
    one: Trial,
    found: Fit,
    only: Collection[str],
    names: Collection[str] = (),
) -> Fit:
    """The fit, improved by probes near by where no gradient leads: a line, an edge.

    Args:
        only, names: the captures that are simulated, and the statistics that are reduced, as in `gauss_newton`.
    """

    def residuals_of(tries: Sequence[Mapping[Key, Any]]) -> Iterator[dict[Cell, np.ndarray] | None]:
        models = [evaluation.sensors.changed(values, one.phases, one.chips) for values in tries]
        for signature in signatures(replicates, evaluation, models, Sampling(only=only, names=names)):
            if isinstance(signature, CannotSimulate):
                yield None
            else:
                yield residuals_at(replicates, evaluation, signature)

    for coordinate in one.candidate.coordinates:
        if coordinate not in found.coordinates or not coordinate.log:
            continue
        if coordinate in one.candidate.shapes:
            found, _ = _nearest(residuals_of, found, coordinate, _PROBES)
        elif is_edge(coordinate):
            for _ in range(_MOVES):  # an edge is not seen from afar: step by step, long ones first
                found, better = _nearest(residuals_of, found, coordinate, _FAR)
                if not better:
                    break
            for probes in (_PROBES, _FINE):
                found, _ = _nearest(residuals_of, found, coordinate, probes)
    return found


def _strengths_anew(one: Trial, found: Fit, fit: Callable[[Mapping[Key, Any], int, Sequence[Coordinate]], Fit]) -> Fit:
    """The fit with its strengths fitted once more at the shapes and edges of the best probes.

    The strengths before are those of another minimum.

    Args:
        found: the fit at the best probes.
        fit: (values, rounds, coordinates) -> fit of these coordinates.
    """
    moving = [i for i, d in enumerate(found.coordinates) if d not in one.candidate.shapes and not is_edge(d)]
    if not moving:
        return found
    try:
        again = fit(found.values, _ROUNDS_AFTER_PROBES, [found.coordinates[i] for i in moving])
    except CannotSimulate:
        return found
    if again.square >= found.square:
        return found
    jacobian = {cell: x.copy() for cell, x in found.jacobian.items()}
    for cell, x in again.jacobian.items():
        jacobian[cell][:, moving] = x
    return Fit(
        coordinates=found.coordinates,
        point=point_of(found.coordinates, again.values),
        covariance=found.covariance,
        residuals=again.residuals,
        jacobian=jacobian,
        square=again.square,
        values=again.values,
        phases=found.phases,
    )


def _nearest(
    residuals_of: Callable[[Sequence[Mapping[Key, Any]]], Iterable[dict[Cell, np.ndarray] | None]],
    found: Fit,
    coordinate: Coordinate,
    probes: Sequence[float],
) -> tuple[Fit, bool]:
    """(best of the probes on both sides of a coordinate, or the fit itself; whether it is a probe).

    Args:
        residuals_of: values of several models, SI -> residuals of each, (cells,) by block; None where it cannot be
            simulated.
        probes: distances, in the coordinate.
    """
    at, before = float(found.values[coordinate.key]), found
    steps = [s * x for x in probes for s in (-1, 1)]
    tries = [{**found.values, coordinate.key: coordinate.value(coordinate.coordinate(at) + x)} for x in steps]
    best = found.square - 6
    for tried, x, residuals in zip(tries, steps, residuals_of(tries), strict=True):
        if residuals is not None and square(residuals) < best:
            best = square(residuals)
            found = replace(
                found, point=point_of(found.coordinates, tried), residuals=residuals, square=best, values=tried
            )
            i = found.coordinates.index(coordinate)
            # no derivative informed it, so that the distance of the probes bounds its error
            found.covariance[i, i] = min(float(found.covariance[i, i]), (abs(x) / 2) ** 2)
    return found, found is not before


def _fit_phases(replicates: Replicates, evaluation: Evaluation, one: Trial) -> Trial:
    """The trial of a periodic candidate with its strength and its phase in each capture fitted.

    It is simulated at a strength that noise does not hide; a smaller one follows from its signature.
    """
    coordinates = tuple(d for d in one.candidate.strengths if d.key in one.values)
    size, given = size_of(replicates, evaluation, one.signature.at(one.times)), one.scaled()
    room = min(room_of(d, float(given[d.key])) for d in coordinates)
    stronger_by = max(1.0, min(math.sqrt(STRONG / max(size, 1e-9)), room))
    strong = {**given, **{d.key: d.scaled(float(given[d.key]), stronger_by) for d in coordinates}}
    swing = simulate_phases(replicates, evaluation, one.candidate.phases, strong, _PHASE_REPLICATES)
    _, times, found = swing.best_fit(replicates, evaluation, [x / stronger_by for x in (0.5, *NEAR, 2.0)])
    one.values = {**strong, **{d.key: d.scaled(float(strong[d.key]), times) for d in coordinates}}
    mirrored = {id: swing.mirror_phase(id, p, times) for id, p in found.items()}
    found = choose_phase(replicates, evaluation, one.candidate.phases, one.values, found, mirrored)
    signature = swing.at(found)
    one.phases = {(id, key): p for id, p in found.items() for key in one.candidate.phases}
    one.signature = signature.at(times)
    one.times, one.faint = 1.0, True
    one.residuals = residuals = residuals_at(replicates, evaluation, signature, times)
    one.fall = square(evaluation.residuals) - square(residuals)
    one.sensors = evaluation.sensors.changed(one.values, one.phases, one.chips)
    aside = [residuals_at(replicates, evaluation, signature, times * math.exp(h)) for h in (_ASIDE, -_ASIDE)]
    # of one strength, or of several that grow together
    apart = [d.coordinate(d.scaled(float(one.values[d.key]), math.exp(2 * _ASIDE))) for d in coordinates]
    now = point_of(coordinates, one.values)
    jacobian = {
        cell: (aside[0][cell] - aside[1][cell])[:, None] / (np.array(apart) - now)[None, :] / len(coordinates)
        for cell in residuals
    }
    replicate_residuals = np.concatenate([evaluation.replicate_residuals[cell] for cell in residuals], axis=1)
    covariance = covariance_of(np.concatenate(list(jacobian.values())), replicate_residuals)
    one.fit = Fit(
        coordinates=coordinates,
        point=now,
        covariance=covariance,
        residuals=residuals,
        jacobian=jacobian,
        square=square(residuals),
        values=one.values,
    )
    return one


def fit_whole_number(
    found: Fit, coordinate: Coordinate, fit: Callable[[Mapping[Key, Any]], Fit]
) -> tuple[Fit, dict[Key, tuple[float, float]]]:
    """(best fit with a whole number, intervals by coordinate).

    That of the whole number holds the values that the data do not exclude; those of the others hold for any of these.
    No gradient leads from one whole number to the next: its neighbours are tried, ever nearer ones, with all else
    fitted at each.
    """
    best = {float(found.values[coordinate.key]): found}
    squares = {value: one.square for value, one in best.items()}
    begun: dict[float, float] = {}  # the number from which each one was fitted last

    def there(value: float, start: Fit) -> None:
        begun[value] = float(start.values[coordinate.key])
        squares.setdefault(value, math.inf)
        with contextlib.suppress(CannotSimulate):
            one = fit({**start.values, coordinate.key: value})
            if one.square < squares[value]:
                best[value], squares[value] = one, one.square

    step = _NEXT[0]
    while True:
        here = float(found.values[coordinate.key])
        near = {_neighbour(coordinate, here, x) for x in (-step, step)} - {here}
        # a fit from afar may not have converged
        last = step <= 2 * _NEXT[1]
        for x in sorted(x for x in near if x not in squares or (last and begun.get(x) != here)):
            there(x, found)
        ahead = min(best.values(), key=lambda one: one.square)
        if ahead.square < found.square - _BETTER:
            found = ahead
        elif step > _NEXT[1]:
            step /= 2
        else:
            break
    here = float(found.values[coordinate.key])
    excluded = found.square + EXCLUDED * _variance_inflation(found)
    for side in (-1, 1):  # on to the excluded numbers
        step = _NEXT[0]
        while all(side * (x - here) <= 0 or squares[x] <= excluded for x in squares):
            far = max(best, key=lambda x, side=side: side * x)  # type: ignore[misc]
            if (further := _neighbour(coordinate, far, side * step)) in squares:
                break
            there(further, best[far])
            step *= 2
    out = [x for x, square in squares.items() if square > excluded]
    # a range may end between two whole numbers
    low = min(max((coordinate.next_whole(x, 1) for x in out if x < here), default=coordinate.low), here)
    high = max(min((coordinate.next_whole(x, -1) for x in out if x > here), default=coordinate.high), here)
    ends = {coordinate.key: (low, high)}
    for i, other in enumerate(found.coordinates):
        intervals = [
            one.interval(i)[1:] for x, one in best.items() if low <= x <= high and one.coordinates == found.coordinates
        ]
        if len(intervals) > 1:
            ends[other.key] = min(a for a, _ in intervals), max(b for _, b in intervals)
    return found, ends


def _variance_inflation(fit: Fit) -> float:
    """The variance inflation of dependent cells, at least 1, in the mean over the fitted coordinates.

    It is that of `gauss_newton.profile_intervals`.
    """
    jacobian = np.concatenate([np.zeros((0, len(fit.coordinates))), *fit.jacobian.values()])
    naive = np.diag(np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-10))
    wider = np.divide(np.diag(fit.covariance), naive, out=np.ones_like(naive), where=naive > 0)
    wider = wider[np.isfinite(wider)]
    return max(float(np.mean(wider)) if wider.size else 1.0, 1.0)


def _neighbour(coordinate: Coordinate, value: float, step: float) -> float:
    """The whole number at this distance in the logarithm, at least the next one; within its range."""
    other = coordinate.value(coordinate.coordinate(value) + step)
    other = min(other, coordinate.next_whole(value, -1)) if step < 0 else max(other, coordinate.next_whole(value, 1))
    return min(max(other, coordinate.low), coordinate.high)
