"""Diagnose: which physical effect does a model lack? Add it, settle it, watch the error fall.

Only where a model fails (as `compare` judges) are candidates tried: every registered effect that it lacks, every
listed number at another value, every map (`candidates`). A few simulated recordings tell what each would change; those
that come closest are settled (`search`), the best is added, everything is settled anew, and so on until nothing is
left. What the set-up explains is no matter of the sensor (`setups`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from joblib import Parallel
from scipy import stats

from ..errors import InputError
from ..measurement import Measurement
from ..sensor import Sensor
from . import compare as comparing
from . import fit, likelihood, mapping, outlook, recordings, setups
from .answer import Diagnosis, Step, Trace, Value, plain, title
from .candidates import Change, Key, changes
from .fit import RATES, Bench, Cell, Moved, Sensors, Settled, State, stacked
from .ladder import errors_of, placebo_row, row
from .search import ALIKE, Search, Tried, is_pattern

_LEAST_P = 1e-300
_AGAIN = 2  # times that the numbers are settled anew beside the model with the effect
_QUICK = 32  # recordings of each capture by which `quick` judges
_LEAST_GAIN = 12.0  # in chi square, of a step
_TRACE = 5e-4  # p-value of a trace that is followed where no check fails by itself
_TRACE_GAIN = 20.0  # and what such a step must be worth in chi square
_WORTH = 6.0  # in chi square: beyond it a settled model is simulated anew
_LEFT = 0.15  # of the squared residuals of its own cells, a step leaves less
_NEEDLESS = 9.0  # a step whose loss costs less is dropped


@dataclass
class _Course:
    """A diagnosis under way: the model so far beside the data."""

    bench: Bench
    search: Search
    state: State
    values: dict[Key, Any]
    steps: list[Step]
    ladder: list[dict[str, Any]]
    judged: dict[Cell, np.ndarray] | None = None  # residuals of each capture by parameters settled without it

    @property
    def failed(self) -> list[fit.Block]:
        return fit.failing(fit.blocks(self.bench, self.state, self.state.residuals))

    @property
    def misfit(self) -> float:
        return fit.misfit(self.state, self.judged or self.state.residuals)

    def kept(self) -> tuple[Any, ...]:
        """All that a step changes."""
        own = (self.state, dict(self.values), list(self.steps), list(self.ladder), self.judged)
        return (*own, list(self.search.accepted), dict(self.search.phases))

    def back_to(self, kept: tuple[Any, ...]) -> None:
        """As it was before a step."""
        self.state, self.values, self.steps, self.ladder, self.judged = kept[:5]
        self.search.accepted, self.search.phases = kept[5:]

    def rung(self, name: str) -> None:
        errors = errors_of(self.bench, self.state, self.judged or self.state.residuals)
        self.ladder.append(row(name, self.misfit, errors))


def diagnose(
    sensor: Sensor,
    measurement: Measurement,
    seed: int = 0,
    max_steps: int = 4,
    quick: bool = False,
    jobs: int = 2,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Find what a model lacks. quick: fewer simulations. progress: told what is being done.

    Raises InputError where sensor and measurement do not belong together.
    """
    say = progress or (lambda what: None)
    with Parallel(n_jobs=jobs) as parallel:
        bench = Bench(sensor, measurement, seed, parallel, _QUICK if quick else recordings.REPLICATES, say)
        short = setups.stopped_early(bench)
        if short:
            exposures = {id: bench.seen[id].capture.conditions.exposure * share for id, (share, _) in short.items()}
            bench = Bench(sensor, measurement, seed, parallel, bench.replicates, say, exposures)
        return _diagnosed(bench, measurement, max_steps, quick, short)


def _begun(bench: Bench) -> _Course:
    bench.say("the model as it is")
    search = Search(bench, bench.say)
    state = bench.state({})
    keys = recordings.swinging(bench.start)
    if keys:  # what swings begins anew in every capture
        turns = search.turns(keys)
        turned = bench.moved(state, [state.sensors.changed({}, t) for t in turns], fit.FEW)
        if not any(isinstance(m, str) for m in turned):
            *_, phases = search.best_phases(state, turned, turns, (1.0,))  # type: ignore[arg-type]
            state = bench.state({}, state.sensors.changed({}, phases))
            search.phases.update(phases)
    course = _Course(bench, search, state, {}, [], [])
    course.rung("start")
    return course


def _diagnosed(
    bench: Bench, measurement: Measurement, max_steps: int, quick: bool, short: Mapping[str, tuple[float, float]]
) -> Diagnosis:
    course = _begun(bench)
    search, start = course.search, course.state
    setup: list[dict[str, Any]] = []
    advice: list[dict[str, Any]] = []
    rival: Tried | None = None
    for id, (share, error) in short.items():
        told = {"value": plain(share), "low": plain(share - 1.96 * error), "high": plain(share + 1.96 * error)}
        setup.append({"capture": id, "quantity": "exposure", "factor": told, "confused": False})
    explained = bool(short)  # is what fails in the totals the set-up's?
    placebo: dict[str, Any] | None = None
    tried: list[Tried] = []
    while len(course.steps) < max_steps:
        failed = course.failed
        number = len(course.steps) + 1
        if not failed:
            # no check fails by itself: does any candidate's whole trace stand out?
            bench.say(f"step {number}: no check fails; looking for the trace of every candidate")
            tried = search.scan(course.state, everywhere=True, known=tried)
            if search.chance(course.state, tried, course.values) > _TRACE:
                break
        if failed and all(b.cell[0] == "" for b in failed):
            found, others, wanted = _by_setup(course)
            if found:
                setup += found
                explained = True
                if others:
                    rival = others[0]
                advice += wanted
                break
        if failed:
            first = ", ".join(" of ".join(b.cell[::-1]).removesuffix(" of ") for b in failed[:4])
            bench.say(f"step {number}: {len(failed)} checks fail ({first}); trying every candidate")
            tried = search.scan(course.state)
        held = {d.key for s in course.steps for d in s.dials}  # settled anew with every step: no finding of their own
        tried = [t for t in tried if t.change.kind != "set" or not held & {d.key for d in t.change.dials}]
        bench.say(f"step {number}: the best of them on all captures")
        second = search.structured(course.state, search.again(course.state, course.values, tried))
        if not second:
            break
        worth = search.worth(second)
        bench.say(f"step {number}: settling " + ", ".join(title(t.change) for t in worth))
        refined = [search.refine(course.state, one) for one in worth]
        best = refined[0] if is_pattern(refined[0]) else max(refined, key=lambda t: t.gain)
        significance, p = search.calibrated(course.state, tried, best)
        if p > (comparing.FALSE_ALARM if failed else _TRACE) or best.gain < (_LEAST_GAIN if failed else _TRACE_GAIN):
            break
        before, earlier = course.state, course.kept()
        fell = course.misfit
        new = _accept(course, best, significance)
        if best.maps is None and not best.phases:
            unseen = search.scattered(before, course.values, best)
            refined, second = refined + unseen, second + unseen
        new[0].alternatives = _alternatives(bench, before, best, refined, second)
        named = {s.change.effect for s in course.steps} | {a["effect"] for a in new[0].alternatives}
        placebo = placebo or placebo_row(bench, before, tried, best, named)
        if not failed and course.failed:
            course.back_to(earlier)  # nothing was wrong before, now something is
            break
        if failed and fell - course.misfit < 0.05 * (fell - 1):
            if course.misfit > fell:
                course.back_to(earlier)
            break
    if course.steps:
        _drop_needless(course)
        _drop_mimics(course, start)
    left = course.failed
    if left and explained and all(b.cell[0] == "" for b in left):
        left = []
    verdict = _verdict(course, left, bool(setup), rival)
    if not course.steps:
        course.state, course.judged, course.values = start, None, {}
        course.ladder = course.ladder[:1] if verdict != "unexplained" else course.ladder
    if verdict == "explained":
        near = [a for a in course.steps[-1].alternatives if a.get("confused")]
        if near:
            verdict = "confused"
            advice += outlook.advice(course.search, course.state, course.steps[-1].change, near[0]["tried"])
    if rival is not None:
        step = _rival_step(course, rival)
        course.steps.append(step)
    for step in course.steps:
        for other in step.alternatives:
            other.pop("confused", None)
            other.pop("tried", None)
    if placebo:
        course.ladder.insert(1, placebo)
    excluded: list[dict[str, Any]] = []
    invisible: list[dict[str, Any]] = []
    if verdict == "adequate" or (verdict == "explained" and not quick):
        bench.say("what would have been seen")
        excluded, invisible = outlook.upper_limits(course.search, course.state, tried)
    remains = verdict in ("unexplained", "partly_explained")
    return Diagnosis(
        bench.start.name,
        measurement.name,
        verdict,
        fit.misfit(start, start.residuals),
        course.misfit,
        fit.usual_misfit(start),
        _nuisances(bench, course.state),
        course.steps,
        setup,
        _remainder(bench, course.state, course.state.residuals) if remains else [],
        course.ladder,
        advice,
        excluded,
        invisible,
        _traces(bench, start, course.state),
        course.values,
        None,
        bench.simulations,
        bench.dark,
    )


def _verdict(course: _Course, left: Sequence[fit.Block], setup: bool, rival: Tried | None) -> str:
    if rival is not None:
        return "confused"
    if left:
        return "partly_explained" if course.steps else "unexplained"
    if course.steps:
        return "explained"
    return "setup" if setup else "adequate"


def _by_setup(course: _Course) -> tuple[list[dict[str, Any]], list[Tried], list[dict[str, Any]]]:
    """(entries, changes of the sensor that cannot be told from them, what would): of failing totals."""
    bench, state = course.bench, course.state
    likely = setups.explanations(bench, state)
    cost = likely[0].cost if likely else float(state.residuals[RATES] @ state.residuals[RATES])
    others = setups.rivals(course.search, state, cost)
    if not likely:
        return [], [], []
    own = others[0].cost(state) if others else math.inf
    if own < cost - setups.ALIKE:
        return [], [], []  # the sensor explains it better
    near = [e for e in likely if e.cost < cost + setups.ALIKE and len(e.factors) == len(likely[0].factors)]
    found = setups.entries(bench, state, near)
    if own < cost + setups.ALIKE:
        found = [{**entry, "confused": True} for entry in found]
        return found, others, outlook.advice_on_totals(course.search, state, likely[0], others[0])
    return found, [], outlook.advice_on_setup(bench, state, found)


def _rival_step(course: _Course, rival: Tried) -> Step:
    dial = rival.change.strengths[0]
    low, high = rival.intervals.get(dial.key, (None, None))
    value = Value(float(rival.values[dial.key]), low, high, dial.unit)
    left = fit.misfit(course.state, rival.residuals or course.state.residuals)
    return Step(rival.change, {dial.parameter: value}, left, math.sqrt(max(rival.gain, 0.0)), "all rates alike")


# --- a step -----------------------------------------------------------------------------------------------------


def _accept(course: _Course, best: Tried, significance: float) -> list[Step]:
    """Add the best candidate to the model, settle everything anew beside the data."""
    bench, before = course.bench, course.state
    new = [
        Step(
            change,
            {},
            0.0,
            significance,
            _material(best),
            dials=best.settled.dials if best.settled is not None and not best.faint else (),
            template=bench.template(before, best.moved),
            before=dict(before.residuals),
            phased=bool(best.phases),
            chips=best.chips,
            intervals=dict(best.intervals),
        )
        for change in best.changes
    ]
    course.search.accepted += best.changes
    course.search.phases.update(best.phases)
    course.steps += new
    course.values = {**course.values, **best.values}
    _settle_all(course, best.settled)
    if best.faint and best.settled is not None:
        for i, dial in enumerate(best.settled.dials):
            new[0].values[dial.parameter] = Value(*best.settled.interval(i), dial.unit)
    for step in new:
        step.misfit = course.misfit
    course.rung("+ " + " + ".join(title(step.change) for step in new))
    return new


def _settle_all(course: _Course, settled: Settled | None = None) -> None:
    """The model with all its steps beside the data: maps, then all numbers together. settled: those of the last."""
    bench, search = course.bench, course.search
    sensors, maps = _model(course)
    state = bench.state(course.values, sensors)
    dials = tuple(d for step in course.steps for d in step.dials)
    errors = _errors(course, settled)
    if settled is not None and settled.dials != dials:
        settled = None
    for step in course.steps:
        if step.phased:
            keys = _keys_of(step, course)
            own = {k: v for k, v in course.values.items() if k in keys}
            known = {pair: x for pair, x in search.phases.items() if pair[1] in step.change.phases}
            one = Tried(step.change, own, Moved({}, {}, {}), 0.0, 1.0, phases=known)
            course.values = {**course.values, **search.tuned(state, one, own, (math.pi / 4,))}
            search.phases.update(one.phases)
            step.intervals.update(one.intervals)
            sensors, maps = _model(course)
            state = bench.state(course.values, sensors)
    # from where it nearly is right: the scatter of the cells is that of the model with the effect
    for turn in range(_AGAIN + 1 if dials else 0):
        here = {d.key: course.values[d.key] for d in dials}
        closer = fit.follow(bench, state, dials, here, state.sensors.changed, 2 * fit.FEW, errors)
        if isinstance(closer, str):
            break
        settled = closer
        if turn == _AGAIN or search.square(state.residuals) - closer.square < _WORTH:
            break
        before = course.values, sensors, maps, state
        course.values = {**course.values, **closer.values}
        sensors, maps = _model(course)
        state = bench.state(course.values, sensors)
        if search.square(state.residuals) > search.square(before[3].residuals):
            # a line or an edge: slopes do not lead further
            course.values, sensors, maps, state = before
            settled = replace(settled, point=fit.point_of(dials, here))
            break
    course.state = state
    if settled is not None and dials:
        point, covariance = settled.point, settled.covariance
        course.judged = _unseen(state, settled)
        place = {d.key: i for i, d in enumerate(settled.dials)}
        for step in course.steps:
            for dial in step.dials:
                i = place[dial.key]
                half, u = 1.96 * math.sqrt(max(float(covariance[i, i]), 0.0)), float(point[i])
                step.values[dial.parameter] = Value(dial.value(u), *dial.interval(u - half, u + half), dial.unit)
                course.values[dial.key] = dial.value(u)
    else:
        course.judged = None
    for step in course.steps:
        if step.change.carrier and step.change.carrier in maps:
            step.values = _map_values(maps[step.change.carrier])
        for (effect, name), (low, high) in step.intervals.items():
            unit = next(d.unit for d in step.change.dials if d.key == (effect, name))
            step.values[name] = Value(float(course.values[effect, name]), low, high, unit)
        for (_, name), value in step.change.fixed:
            if name not in step.values and isinstance(value, (bool, int, float)):
                step.values[name] = Value(float(value), None, None)


def _errors(course: _Course, settled: Settled | None) -> dict[Key, float]:
    """Standard deviations of the coordinates of what is settled already."""
    out = {}
    for step in course.steps:
        for dial in step.dials:
            v = step.values.get(dial.parameter)
            if v is not None and v.low is not None and v.high is not None:
                out[dial.key] = abs(dial.coordinate(v.high) - dial.coordinate(v.low)) / (2 * 1.96)
    if settled is not None:
        out |= {d.key: math.sqrt(max(float(settled.covariance[i, i]), 0.0)) for i, d in enumerate(settled.dials)}
    return out


def _model(course: _Course) -> tuple[Sensors, dict[Key, mapping.Map]]:
    """The model with all its steps, its maps settled to the data."""
    bench, search = course.bench, course.search
    held = [c for c in search.accepted if c.carrier]
    chips = any(step.chips for step in course.steps)
    if not held:
        return Sensors.same(bench.start).changed(course.values, search.phases, chips), {}
    levels = mapping.levels_of(bench, course.state)
    sensors, maps, course.values = mapping.sensors_with(bench, course.values, held, levels)
    return sensors.changed({}, search.phases, chips), maps


def _map_values(map_: mapping.Map) -> dict[str, Value]:
    told = {name: Value(number, None, None) for name, number in mapping.summary(map_).items()}
    sigma, noise = told["sigma"].value, float(np.median(map_.raw_error))
    # of a variance, which is what remains of the differences without the noise
    half = 1.96 * (sigma**2 + noise**2) * math.sqrt(2 / len(map_.raw))
    ends = [math.sqrt(max(sigma**2 + k * half, 0.0)) for k in (-1, 1)]
    told["sigma"] = Value(sigma, ends[0], ends[1])
    for name in ("low_fraction", "high_fraction"):
        n, k = len(map_.raw), told[name].value * len(map_.raw)
        low = float(stats.beta.ppf(0.025, k, n - k + 1)) if k > 0 else 0.0
        high = float(stats.beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
        told[name] = Value(told[name].value, low, high)
    return told


def _material(one: Tried) -> str:
    logs = [x * one.times for x in one.moved.logs.values()]
    return f"mean rate {math.expm1(-float(np.mean(logs)) if logs else 0.0):+.2%}"


def _stacked(state: State, settled: Settled) -> tuple[list[Cell], np.ndarray, np.ndarray]:
    keys = [k for k in settled.slopes if k in state.residuals and len(state.residuals[k]) == len(settled.slopes[k])]
    return keys, stacked(state.residuals, keys), np.concatenate([settled.slopes[k] for k in keys])


def _unseen(state: State, settled: Settled) -> dict[Cell, np.ndarray]:
    """Residuals of each capture, the numbers being settled without it (to first order).

    Where one capture alone tells a number, each of its cells is judged by what the others of them say.
    """
    keys, z, slopes = _stacked(state, settled)
    normal = slopes.T @ slopes
    out = dict(state.residuals)
    ridge = 1e-9 * np.trace(normal) * np.eye(len(normal))
    for id in {k[0] for k in keys}:
        mine = np.concatenate([np.full(len(state.residuals[k]), k[0] == id) for k in keys])
        rest = normal - slopes[mine].T @ slopes[mine]
        alone = bool(np.any(np.diag(rest) < 0.3 * np.diag(normal)))
        start = 0
        if not alone:
            shift = -np.linalg.solve(rest + ridge, slopes[~mine].T @ z[~mine])
        hat = np.einsum("ij,jk,ik->i", slopes, np.linalg.inv(normal + ridge), slopes)
        for key in keys:
            size = len(state.residuals[key])
            part = slice(start, start + size)
            start += size
            if key[0] == id and key != RATES:
                out[key] = z[part] / (1 - np.minimum(hat[part], 0.9)) if alone else z[part] + slopes[part] @ shift
    return out


def _drop_needless(course: _Course) -> None:
    """Steps that later ones made superfluous are taken out again."""
    bench = course.bench
    for step in list(course.steps[:-1]):
        if step.change.carrier or len(course.steps) < 2 or step.phased:
            continue
        rest = {k: v for k, v in course.values.items() if k not in _keys_of(step, course)}
        sensors = Sensors.same(bench.start).changed(rest, course.search.phases)
        if any(s.change.carrier for s in course.steps):
            continue  # a map would have to be settled anew
        (moved,) = bench.moved(course.state, [sensors], fit.FEW)
        if isinstance(moved, str):
            continue
        others = tuple(d for s in course.steps if s is not step for d in s.dials)
        z = bench.residuals(course.state, moved)
        loss = course.search.square(z) - course.search.square(course.state.residuals)
        if loss > 30 and not others:
            continue
        point = {d.key: rest[d.key] for d in others}
        closer = fit.settle(bench, course.state, others, point, sensors.changed, 2) if others else None
        if isinstance(closer, Settled):
            loss = closer.square - course.search.square(course.state.residuals)
        if loss < _NEEDLESS:
            bench.say(f"{title(step.change)} is no longer needed")
            course.steps.remove(step)
            course.search.accepted.remove(step.change)
            course.values = rest
            _settle_all(course)
            course.rung(f"- {title(step.change)}")


def _keys_of(step: Step, course: _Course) -> set[Key]:
    if step.change.kind == "add":
        return {k for k in course.values if k[0] == step.change.effect}
    return {(step.change.effect, step.change.parameter or "")}


def _drop_mimics(course: _Course, start: State) -> None:
    """Where something remains, steps that only happen to look like it are no findings.

    The cells that a step speaks of must be in order with it; and of totals alone, whatever remains may be the cause.
    """
    while course.steps and course.failed:
        # what one step leaves another one cannot explain: the worst goes first, and the others are looked at again
        left = {id(s): _left_of_own(s, course.state) for s in course.steps}
        worst = max(course.steps, key=lambda s: left[id(s)])
        kept = [s for s in course.steps if s is not worst or left[id(s)] < 1]
        if fit.misfit(course.state, course.state.residuals) > fit.misfit(start, start.residuals):
            kept = []
        if len(kept) == len(course.steps):
            return
        course.steps = kept
        course.search.accepted = [c for c in course.search.accepted if any(c is s.change for s in kept)]
        known = set().union(*(_keys_of(s, course) for s in kept))
        course.values = {k: v for k, v in course.values.items() if k in known}
        if kept:
            _settle_all(course)
            course.rung("without what only looks alike")


def _left_of_own(step: Step, state: State) -> float:
    """What is left of the cells that a step speaks of; from 1 on it only happens to look like what is there."""
    weight, after, before, shape, shapes = 0.0, 0.0, 0.0, 0.0, 0.0
    for cell, t in step.template.items():
        z, old = state.residuals.get(cell), step.before.get(cell)
        if z is None or old is None or len(z) != len(t) or len(old) != len(t):
            continue
        w = t**2
        weight, after, before = weight + float(w.sum()), after + float(w @ z**2), before + float(w @ old**2)
        if cell != RATES:
            shape, shapes = shape + float(old @ old - z @ z), shapes + float(w.sum())
    # of totals alone, whatever remains may be the cause
    if weight <= 0 or shape < _LEAST_GAIN or shapes < 0.5 * weight:
        return math.inf
    return after / weight / max(4.0, _LEFT * before / weight)


def _alternatives(
    bench: Bench, state: State, best: Tried, refined: Sequence[Tried], second: Sequence[Tried]
) -> list[dict[str, Any]]:
    """The other candidates, with the misfit that each leaves."""
    out: list[dict[str, Any]] = []
    for one in second:
        if (
            one is best
            or one.change in best.changes
            or any(o["effect"] == one.change.effect and o["parameter"] == one.change.parameter for o in out)
        ):
            continue
        residuals = one.residuals or bench.residuals(state, one.moved, one.times, noisy=True)
        checks = fit.blocks(bench, state, residuals)
        alike = one.residuals is not None and best.gain - one.gain < ALIKE and not fit.failing(checks)
        out.append(
            {
                "change": one.change.kind,
                "effect": one.change.effect,
                "parameter": one.change.parameter,
                "misfit": plain(fit.misfit(state, residuals)),
                "confused": alike,
                "tried": one,
            }
        )
    return out[:4]


# --- what is told -----------------------------------------------------------------------------------------------


def _remainder(bench: Bench, state: State, residuals: Mapping[Cell, np.ndarray]) -> list[dict[str, Any]]:
    """What nothing explains: where, how large, and what kind of mechanism leaves such a trace."""
    out = []
    for block in fit.failing(fit.blocks(bench, state, residuals))[:20]:
        id, name = block.cell
        if id == "":
            ids, *_ = bench.rate_space(state)
            which = ids[block.worst] if block.worst < len(ids) else None
            out.append(
                {"statistic": "rate", "capture": which, "significance": plain(abs(block.z)), "where": "all pixels"}
            )
            continue
        summary = bench.seen[id].summaries[name]
        out.append(
            {
                "statistic": name,
                "capture": id,
                "significance": plain(max(abs(block.z), float(stats.norm.isf(max(block.p, _LEAST_P) / 2)))),
                "where": summary.where(block.worst),
            }
        )
    return out


def _traces(bench: Bench, start: State, last: State) -> list[Trace]:
    """The clearest checks of the model as it was, as it was and as it is now."""
    out: list[Trace] = []
    for block in fit.failing(fit.blocks(bench, start, start.residuals)):
        id, name = block.cell
        if id == "" or block.cell not in last.nulls or start.nulls[block.cell].law == "exact":
            continue
        if any(t.statistic == name for t in out):
            continue
        seen = bench.seen[id]
        summary, null = seen.summaries[name], last.nulls[block.cell]
        now = null.expected(seen.total)[0]
        out.append(
            Trace(
                name,
                id,
                summary,
                start.nulls[block.cell].expected(seen.total)[0],
                now,
                null.spread_at(now),
                start.residuals[block.cell],
                last.residuals[block.cell],
            )
        )
        if len(out) == 4:
            break
    return out


def _nuisances(bench: Bench, state: State) -> list[dict[str, Any]]:
    levels: list[tuple[Any, float, float, float]] = []
    for id, seen in bench.seen.items():
        null = state.rates[id]
        if seen.capture.light.dark or null.stated is None:
            continue
        level, error, elasticity = null.level_of(seen.total)
        levels.append((seen.capture, math.log(level / null.stated), error, elasticity))
    found, _ = comparing.light_of(levels, [s.capture for s in bench.seen.values()])
    return [
        {"capture": n.capture, "name": n.name, **{k: plain(getattr(n, k)) for k in ("value", "low", "high", "pull")}}
        for n in found
    ]


# --- settling what the caller names -----------------------------------------------------------------------------


def fitted(
    sensor: Sensor,
    measurement: Measurement,
    add: Sequence[str] = (),
    free: Sequence[str] = (),
    per_pixel: Sequence[str] = (),
    seed: int = 0,
    jobs: int = 2,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Settle what the caller names: whole effects (`add`), "effect.parameter" (`free`), and maps (`per_pixel`).

    By the exact likelihood where all that is asked for and all that the sensor has is in it, otherwise by simulation.
    Raises InputError where there is no such effect or parameter.
    """
    say = progress or (lambda what: None)
    every = changes(sensor.settled())
    wanted = [
        *(_named(every, "add", name, None) for name in add),
        *(_named(every, "set", *_halves(name)) for name in free),
        *(_named(every, "per_pixel", *_halves(name)) for name in per_pixel),
    ]
    if not wanted:
        raise InputError("nothing is to be settled; name --add EFFECT, --free EFFECT.PARAMETER or --per-pixel ...")
    with Parallel(n_jobs=jobs) as parallel:
        bench = Bench(sensor, measurement, seed, parallel, recordings.REPLICATES, say)
        course = _begun(bench)
        start, before = course.state, course.misfit
        say("settling " + ", ".join(title(change) for change in wanted))
        data = [measurement.recording(c.id, bench.start) for c in measurement.captures if c.mean is None]
        exact = likelihood.settled(bench.start, data, wanted) if len(data) == len(bench.seen) else "a mean alone"
        if isinstance(exact, str):
            say(f"by simulation, for there is no likelihood of {exact}")
            _by_simulation(course, wanted)
        else:
            _by_likelihood(course, wanted, exact)
        left = course.failed
        return Diagnosis(
            bench.start.name,
            measurement.name,
            "partly_explained" if left else "explained",
            before,
            course.misfit,
            fit.usual_misfit(start),
            _nuisances(bench, course.state),
            course.steps,
            [],
            _remainder(bench, course.state, course.state.residuals),
            course.ladder,
            [],
            [],
            [],
            _traces(bench, start, course.state),
            course.values,
            None,
            bench.simulations,
            bench.dark,
        )


def _by_likelihood(course: _Course, wanted: Sequence[Change], exact: likelihood.Exact) -> None:
    """Steps with these numbers; their misfit is found as that of all others."""
    bench, before = course.bench, course.state
    for change, gain in zip(wanted, exact.gains, strict=True):
        intervals = {d.key: exact.intervals[d.key] for d in change.dials}
        own = {**dict(change.fixed), **{key: exact.values[key] for key in intervals}}
        moved = bench.told(before, before.sensors.changed(own))
        material = _material(Tried(change, own, moved, gain, 1.0))
        step = Step(change, {}, 0.0, math.sqrt(max(gain, 0.0)), material, intervals=intervals)
        step.template, step.before = bench.template(before, moved), dict(before.residuals)
        course.steps.append(step)
    course.search.accepted += wanted
    course.values = {**course.values, **exact.values}
    _settle_all(course)
    for step in course.steps:
        step.misfit = course.misfit
        step.values = {name: replace(v, method="likelihood") for name, v in step.values.items()}
    course.rung("+ " + " + ".join(title(change) for change in wanted))


def _by_simulation(course: _Course, wanted: Sequence[Change]) -> None:
    """A step for each, maps last; then the intervals of all numbers by profile."""
    bench = course.bench
    for change in sorted(wanted, key=lambda c: bool(c.carrier)):
        if change.carrier:
            best = Tried(change, {}, Moved({}, {}, {}), 0.0, 1.0, maps={})
        else:
            best = course.search.refine(course.state, _started(course, change), 5)
        _accept(course, best, math.sqrt(max(best.gain, 0.0)))
    ends: dict[Key, tuple[float, float]] = {}
    dials = tuple(d for step in course.steps for d in step.dials)
    if dials:
        bench.say("intervals")
        # the state's own numbers, from which the settled ones are one step away
        here = {d.key: course.state.values.get(d.key, course.values[d.key]) for d in dials}
        sensors, few = course.state.sensors.changed, 2 * fit.FEW
        settled = fit.follow(bench, course.state, dials, here, sensors, few, _errors(course, None))
        if isinstance(settled, Settled):
            settled = replace(settled, point=fit.point_of(dials, course.values))
            ends = fit.profiled(bench, course.state, settled, sensors, few)
    for step in course.steps:
        for name, value in step.values.items():
            low, high = ends.get((step.change.effect, name), (value.low, value.high))
            how = "counts" if step.change.carrier else "simulation"
            step.values[name] = replace(value, low=low, high=high, method=how)


def _started(course: _Course, change: Change) -> Tried:
    """The template of a change that comes nearest, at the strength that suits it."""
    found = course.search.looked_at(course.state, change, course.search.begun(course.state, change))
    if not found:
        raise InputError(f"{title(change)} cannot be simulated in these captures")
    return max(found, key=lambda t: t.gain)


def _halves(name: str) -> tuple[str, str]:
    effect, dot, parameter = name.partition(".")
    if not dot or not parameter:
        raise InputError(f"{name!r} is not EFFECT.PARAMETER, for example dead_time.duration")
    return effect, parameter


def _named(every: Sequence[Change], kind: str, effect: str, parameter: str | None) -> Change:
    for change in every:
        if (change.kind, change.effect) == (kind, effect) and (kind == "add" or change.parameter == parameter):
            return change
    name = effect + (f".{parameter}" if parameter else "")
    able = sorted({c.effect + (f".{c.parameter}" if c.parameter else "") for c in every if c.kind == kind})
    raise InputError(f"{name} cannot be settled here; those that can: {', '.join(able)}")
