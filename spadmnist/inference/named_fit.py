"""The fit of named parameters: by the exact likelihood where there is one, otherwise by simulation."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from .. import golden
from ..effects import Effect
from ..errors import UNABLE, InputError, did_you_mean
from ..measurement import Measurement
from ..sensor import Sensor
from ..workers import Executor, executor
from . import count_model, counts_in_the_dark, time_blocks
from .candidates import Candidate, candidates
from .capture_replicates import CannotSimulate
from .comparison import comparison_with
from .coordinates import Coordinate, Key, point_of
from .evidence import evidence_of
from .exact_likelihood import MaximumLikelihood, NoLikelihood, likelihood_ratios, maximise, recordings
from .findings import failing_of, nuisances, remainder, traces
from .gauss_newton import JacobianBy, gauss_newton_step, profile_intervals
from .intervals import fit_where_hit, scale_errors
from .joint_fit import complete_fit, completed, edge_errors, fit_all, variances_by_pixels
from .levels import FALL_95, HALF_95, LEAST_P
from .model_path import ModelPath, accept, begin, material
from .replicates import FEW, REPLICATES, Execution, Replicates
from .results import Diagnosis, Step, Value, title
from .score_test import p_of_map
from .signature import Signature, signature_of_totals, template_of
from .trial import Trial, of_other_shapes
from .trial_fits import fit_trial

# how often the search range of a value at its end is made wider, each time by so much; and the factor within which a
# value is at the end. They reach beyond any range by 1e4; rules of thumb
_WIDENINGS, _FURTHER, _AT_END = 4, 10.0, 1.01


def fit_named(
    sensor: Sensor,
    measurement: Measurement,
    add: Sequence[str] = (),
    free: Sequence[str] = (),
    per_pixel: Sequence[str] = (),
    seed: int = 0,
    jobs: int | Executor = 2,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """The fit of what the caller names.

    A map of a dark rate is fitted by the pixels' counts where captures without light inform it
    (`counts_in_the_dark`). Other fits are by the exact likelihood where it describes the model and all its changes,
    otherwise by simulation.

    Args:
        add: names of effects that are added.
        free: "effect.parameter" of listed effects.
        per_pixel: "effect.parameter" of maps.
        seed: of the replicates.
        jobs: number of workers of this machine, or an executor.
        progress: called with a line about what is being done.
    Raises:
        InputError: where there is no such effect or parameter.
    """
    say = progress or (lambda what: None)
    every, listed = candidates(sensor.resolved(), measurement.captures), {e.name for e in sensor.effects}
    wanted = [
        *(named_candidate(every, listed, "add", name, None) for name in add),
        # of a named parameter alone: what comes with it in a search stays as it is listed
        *(replace(named_candidate(every, listed, "set", *_halves(name)), shapes=()) for name in free),
        *(named_candidate(every, listed, "per_pixel", *_halves(name)) for name in per_pixel),
    ]
    if not wanted:
        raise InputError("nothing is to be fitted; name --add EFFECT, --free EFFECT.PARAMETER or --per-pixel ...")
    _check_once(wanted)
    with executor(jobs) as workers:
        workers.greet(golden.answer, None)
        if counts_in_the_dark.may_fit(sensor.resolved(), wanted):
            replicates = Replicates(sensor, measurement, seed, Execution(workers, say), REPLICATES, reduced=False)
            try:
                answer = counts_in_the_dark.fit_by_counts(replicates, measurement, wanted[0])
                say("by the counts in the dark alone; compare checks the new model in all other statistics")
                return answer
            except counts_in_the_dark.OtherwiseInformed as error:
                say(f"not by the counts of dark captures alone: {error}")
        replicates = Replicates(sensor, measurement, seed, Execution(workers, say), REPLICATES)
        path = begin(replicates)
        start, wrong = path.evaluation, bool(path.failed)
        say("fitting " + ", ".join(title(candidate) for candidate in wanted))
        exact: MaximumLikelihood | None = None
        ratios: list[float] = []
        try:
            wanted, exact, ratios = _maximum_likelihood(measurement, replicates, wanted)
        except NoLikelihood as error:  # it holds the recordings, whose memory the replicates need
            ways = sorted({_method(candidate) for candidate in wanted})
            misfit = "" if ways == ["simulation"] else ", the misfit by simulation"
            say(f"by {' and '.join(ways)}{misfit}, for there is no likelihood of {error}")
        if exact is None:
            _by_simulation(path, wanted)
        else:
            _by_likelihood(path, wanted, exact, ratios)
        scale_errors(path)
        null_95 = time_blocks.measure(replicates, path.ladder)
        right = "explained" if wrong else "adequate"
        path.locate()
        in_sample = comparison_with(replicates, path.sensor_values)
        # the sensor file is judged, too: its pixels may be others than those of the model
        fails = path.failed or in_sample.verdict == "fails"
        return Diagnosis(
            sensor=replicates.start.name,
            measurement=measurement.name,
            verdict="partly_explained" if fails else right,
            before=path.ladder[0].misfit,
            after=path.ladder[-1].misfit,
            null_95=null_95,
            nuisances=nuisances(replicates, path.evaluation),
            steps=path.steps,
            setup=[],
            unexplained=remainder(replicates, path.evaluation, path.evaluation.residuals) or failing_of(in_sample),
            ladder=[rung.row for rung in path.ladder],
            advice=[],
            excluded=[],
            traces=traces(replicates, start, path.evaluation, path.steps),
            values=path.sensor_values,
            simulations=replicates.simulations,
            dark=replicates.dark,
            crop=str(replicates.start.window) if replicates.start.window else None,
            covariance=_covariance(path, exact),
            in_sample=in_sample,
            shape=replicates.start.layout.shape,
            asked="fit",
        )


def _maximum_likelihood(
    measurement: Measurement, replicates: Replicates, wanted: list[Candidate]
) -> tuple[list[Candidate], MaximumLikelihood, list[float]]:
    """(the wanted changes, their maximum-likelihood fit to all captures, twice the log-likelihood ratio of each).

    Raises NoLikelihood where there is none.

    The search range of a parameter is where a diagnosis looks for it, and no bound: a value at its end has a wider one.
    """
    if any(capture.mean is not None for capture in measurement.captures):
        raise NoLikelihood("a mean alone")
    totals = {id: seen.detections for id, seen in replicates.seen.items()}
    data = recordings(measurement, replicates.start, totals)
    found = maximise(replicates.start, data, wanted)
    for _ in range(_WIDENINGS):
        wider = [_further(candidate, found) for candidate in wanted]
        if wider == wanted:
            break
        try:
            again = maximise(replicates.start, data, wider)
        except NoLikelihood:  # none so far off
            break
        at_end = [_further(candidate, again) for candidate in wider] != wider
        if at_end and 2 * (again.value - found.value) < FALL_95:
            break  # as good as before: the data do not say how far beyond it lies
        wanted, found = wider, again
    return wanted, found, likelihood_ratios(replicates.start, data, wanted, found)


def _further(candidate: Candidate, found: MaximumLikelihood) -> Candidate:
    """The candidate with wider search ranges of the parameters whose value lies at the end of theirs."""

    def wider(coordinate: Coordinate) -> Coordinate:
        if not coordinate.log or coordinate.lacks or coordinate.key not in found.values:
            return coordinate
        value, (least, most) = found.values[coordinate.key], coordinate.bounds
        low, high = coordinate.low, coordinate.high
        if value <= low * _AT_END:
            low = max(low / _FURTHER, 0.0 if least is None else least)
        if value >= high / _AT_END:
            high = min(high * _FURTHER, math.inf if most is None else most)
        return replace(coordinate, low=low if low > 0 else coordinate.low, high=high)

    strengths, shapes = (tuple(map(wider, some)) for some in (candidate.strengths, candidate.shapes))
    return replace(candidate, strengths=strengths, shapes=shapes)


def _covariance(path: ModelPath, exact: MaximumLikelihood | None) -> tuple[list[str], np.ndarray]:
    """(names "effect.parameter" of the fitted parameters, their covariance in SI).

    Its diagonal is that of the 95 % intervals, taken as symmetric. The correlations are those of the likelihood, or
    of the last fit by simulation.
    """
    free: tuple[Key, ...] = ()
    correlations = np.zeros((0, 0))
    if exact is not None:
        free, correlations = exact.free, exact.correlations
    elif path.fit is not None:
        free, matrix = tuple(coordinate.key for coordinate in path.fit.coordinates), path.fit.covariance
        # of some coordinates the value falls as they rise
        sign = np.array([-1.0 if coordinate.lacks else 1.0 for coordinate in path.fit.coordinates])
        spread = np.sqrt(np.maximum(np.diag(matrix), 1e-300)) * sign
        held = tuple(d.key for step in path.steps for d in step.coordinates if d.key not in free)
        correlations = np.eye(len(free) + len(held))  # what keeps the value of an earlier fit is taken as independent
        with np.errstate(invalid="ignore"):
            known = np.nan_to_num(matrix / np.outer(spread, spread), nan=0.0, posinf=0.0, neginf=0.0)
        np.fill_diagonal(known, 1.0)  # what is not informed has an interval all the same
        correlations[: len(free), : len(free)] = known
        free += held
    results = {
        (s.candidate.effect, name): v for s in path.steps if not s.candidate.carrier for name, v in s.values.items()
    }
    at, errors = [], []
    for i, key in enumerate(free):
        value = results.get(key)
        if value is not None and value.low is not None and value.high is not None:
            at.append(i)
            errors.append((value.high - value.low) / (2 * HALF_95))
    return [".".join(free[i]) for i in at], correlations[np.ix_(at, at)] * np.outer(errors, errors)


def _by_likelihood(
    path: ModelPath, wanted: Sequence[Candidate], exact: MaximumLikelihood, ratios: Sequence[float]
) -> None:
    """Add steps with the maximum-likelihood values; their misfit is that of a simulation.

    Args:
        ratios: twice the log-likelihood ratio of each change.
    """
    replicates, before = path.replicates, path.evaluation
    for candidate, likelihood_ratio in zip(wanted, ratios, strict=True):
        intervals = {d.key: exact.intervals[d.key] for d in candidate.coordinates}
        own = {**dict(candidate.fixed), **{key: exact.values[key] for key in intervals}}
        signature = signature_of_totals(replicates, before, before.sensors.changed(own))
        change = material(Trial(candidate=candidate, values=own, signature=signature, fall=likelihood_ratio, times=1.0))
        step = Step(
            candidate=candidate,
            values={},
            misfit=0.0,
            significance=math.sqrt(max(likelihood_ratio, 0.0)),
            material=change,
            intervals=intervals,
        )
        step.template, step.before = template_of(replicates, before, signature), dict(before.residuals)
        path.steps.append(step)
    path.scan.accepted += wanted
    path.values = {**path.values, **exact.values}
    fit_all(path)
    for step in path.steps:
        step.values = {name: replace(v, method="likelihood") for name, v in step.values.items()}
    path.rung("+ " + " + ".join(title(candidate) for candidate in wanted), path.steps)


def _by_simulation(path: ModelPath, wanted: Sequence[Candidate]) -> None:
    """Add a step for each candidate, maps last; the intervals of all coordinates are by profile."""
    replicates = path.replicates
    for candidate in sorted(wanted, key=lambda c: bool(c.carrier)):
        if candidate.carrier:
            p = p_of_map(
                replicates,
                path.evaluation,
                candidate,
                path.values,
                count_model.light_levels_of(replicates, path.evaluation),
            )
            best = Trial(
                candidate=candidate, values={}, signature=Signature({}, {}, {}), fall=0.0, times=1.0, maps={}, p_value=p
            )
            accept(path, best, float(stats.norm.isf(max(p, LEAST_P) / 2)))
            continue
        best = fit_trial(replicates, path.evaluation, _started(path, candidate), 5)
        best.evidence = evidence_of(replicates, path.evaluation, best)
        if not candidate.coordinates and best.evidence < FALL_95:  # a switch that the data do not turn
            _kept(path, candidate)
            continue
        accept(path, best, math.sqrt(max(best.evidence, 0.0)))
    if path.approximate or path.evaluation.borrowed:
        complete_fit(path)
        path.evaluation = completed(replicates, path.evaluation)  # where not all numbers could be fitted together
        path.last_rung()
    with contextlib.suppress(*UNABLE):  # the fit by other chips stands
        if fit_where_hit(path):
            path.last_rung()
    ends: dict[Key, tuple[float, float]] = {}
    coordinates = path.free
    if coordinates:
        replicates.say("intervals")
        # the values of the evaluation, one step away from the fitted ones
        here = {d.key: path.evaluation.values.get(d.key, path.values[d.key]) for d in coordinates}
        sensors, by = functools.partial(path.model_at, path.evaluation), JacobianBy(2 * FEW, edge_errors(path))
        with contextlib.suppress(CannotSimulate):  # the intervals stay those of the fit
            fit = gauss_newton_step(replicates, path.evaluation, coordinates, here, sensors, by)
            fit = replace(fit, point=point_of(coordinates, path.values))
            ends = profile_intervals(replicates, path.evaluation, fit, sensors, by.few)
    maps = {s.candidate.carrier: s.map for s in path.steps if s.candidate.carrier and s.map is not None}
    for step in path.steps:
        extra = dict(zip([d.key for d in step.coordinates], variances_by_pixels(path, step, maps), strict=True))
        for name, value in step.values.items():
            key = step.candidate.effect, name
            low, high = ends.get(key, (value.low, value.high))
            if key in ends and extra.get(key):
                low, high = _widened(
                    next(d for d in step.coordinates if d.key == key), value.value, ends[key], extra[key]
                )
            if key in ends and key in step.intervals and value.low is not None and value.high is not None:
                low, high = min(ends[key][0], value.low), max(ends[key][1], value.high)  # over all whole numbers
            step.values[name] = replace(value, low=low, high=high, method=_method(step.candidate))


def _method(candidate: Candidate) -> str:
    """What a fit without a likelihood is by: simulation, or of a map what informs each pixel."""
    if not candidate.carrier:
        return "simulation"
    return candidate.informed_by or ("intervals" if candidate.blinds else "counts")


def _widened(coordinate: Coordinate, value: float, ends: tuple[float, float], variance: float) -> tuple[float, float]:
    """An interval with a further variance of its coordinate."""
    middle = coordinate.coordinate(value)
    reach = [math.hypot(coordinate.coordinate(end) - middle, HALF_95 * math.sqrt(variance)) for end in ends]
    return coordinate.interval(middle - max(reach), middle + max(reach))


def _kept(path: ModelPath, candidate: Candidate) -> None:
    """Add a step for a switch that stays as it is listed."""
    values: dict[str, Value] = {}
    for (effect, name), _ in candidate.fixed:
        values[name] = Value(float(getattr(path.replicates.start.effect(effect), name)), None, None)
    path.steps.append(
        Step(candidate=candidate, values=values, misfit=path.misfit, significance=0.0, material="mean rate +0.00 %")
    )
    path.rung(f"{title(candidate)} as it was", path.steps[-1:])


def _started(path: ModelPath, candidate: Candidate) -> Trial:
    """The trial of the template with the largest fall, at its best strength."""
    found = path.scan.looked_at(path.evaluation, candidate, path.scan.begun(path.evaluation, candidate))
    if not found:
        raise InputError(f"{title(candidate)} cannot be simulated in these captures")
    best = max(found, key=lambda t: t.fall)
    return replace(best, others=of_other_shapes(best, sorted(found, key=lambda t: -t.fall))) if best.chips else best


def _check_once(wanted: Sequence[Candidate]) -> None:
    """Raise InputError where two candidates would fit one parameter."""
    known: dict[Key, Candidate] = {}
    for candidate in wanted:
        keys = [candidate.carrier] if candidate.carrier else [d.key for d in candidate.coordinates]
        for key in {*keys, *(key for key, _ in candidate.fixed)}:
            if key in known:
                names = title(known[key]), title(candidate)
                both = "" if names[0] == names[1] else f", as {names[0]} and as {names[1]}, which has a mean of its own"
                raise InputError(f"{'.'.join(key)} would be fitted twice{both}; name it once")
            known[key] = candidate


def _halves(name: str) -> tuple[str, str]:
    effect, dot, parameter = name.partition(".")
    if not dot or not parameter:
        raise InputError(f"{name!r} is not EFFECT.PARAMETER, for example dead_time.duration")
    return effect, parameter


def named_candidate(
    every: Sequence[Candidate], known: Collection[str], kind: str, effect: str, parameter: str | None
) -> Candidate:
    """The candidate that the caller names.

    Args:
        every: all candidates of the sensor and the data.
        known: the effects that the sensor lists.
        kind: "add", "set" or "per_pixel".
        parameter: of a value; None for a whole effect.
    Raises:
        InputError: where there is none; it says which there are.
    """
    listed = effect in known
    for candidate in every:
        if (candidate.kind, candidate.effect) == (kind, effect) and (kind == "add" or candidate.parameter == parameter):
            return candidate
    name = effect + (f".{parameter}" if parameter else "")
    if kind == "add" and listed:
        raise InputError(f"--add {name}: the sensor lists it already; fit its numbers, --free {effect}.PARAMETER")
    if kind == "set" and not listed and effect in Effect.registry:
        raise InputError(f"--free {name}: the sensor does not list {effect}; --add {effect} adds it and fits it")
    able = sorted({c.effect + (f".{c.parameter}" if c.parameter else "") for c in every if c.kind == kind})
    others = f"; those that can: {', '.join(able)}.{did_you_mean(name, able)}" if able else ""
    raise InputError(f"{name} cannot be fitted here{_why_not(kind, effect, parameter, listed)}{others}")


def _why_not(kind: str, effect: str, parameter: str | None, listed: bool) -> str:
    """Why a parameter of a listed effect is no candidate, as far as its declaration states."""
    declared = Effect.registry.find(effect).parameters.get(parameter or "") if listed else None
    if declared is None:
        return ""
    if kind == "set" and Effect.registry.find(effect).on_light:
        return (
            ": a common factor is the same as another light level, which every fit and compare give (light, of what is "
            "stated)"
        )
    if declared.search is None:
        return ": it has no range in which it is looked for"
    if kind == "per_pixel" and declared.per != "pixel":
        return ": it is one number for all pixels"
    return ": its values are a map, a table or a distribution" if kind == "set" else ""
