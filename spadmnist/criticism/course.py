"""A diagnosis under way: the model so far beside the data, and the steps that change it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from ..effects import Effect
from ..measurement import Measurement
from . import checks, fit, likelihood, mapping, recordings, settling
from .answer import Step, Value, title
from .candidates import Change, Dial, Key, with_values
from .fit import RATES, Bench, Cell, Sensors, State, likelier, square
from .ladder import Mapped, Rung, errors_of
from .refining import EXCLUDED, UNSEEN
from .search import Search
from .settling import Settled
from .showing import captures_showing
from .swings import sided, turned
from .tried import Tried, is_edge

_AGAIN = 2  # times that the numbers are settled anew beside the model with the effect
_SAME = 0.35  # of a coordinate: so far slopes hold
_WORTH = 6.0  # in chi square: beyond it a settled model is simulated anew
LEAST_GAIN = 12.0  # in chi square, of a step
_MOSTLY = 0.95  # of what was wrong: what explains so much is no look-alike, whatever its law leaves
_LEFT = 0.15  # of the squared residuals of its own cells, a step leaves less
_HALF = 1.96  # standard deviations: half of an interval of 95 %
_MOVED = 0.5  # standard deviations, beyond which a model is another one
_LOST = 30.0  # in chi square: what costs so much is no step to the better
_MANY = 32  # recordings that are not alike, of which slopes are made
_STEP = 0.01  # of a coordinate, for how the pixels' light follows it
_VAIN = 2  # steps that only look like what is there
_NEEDLESS = 9.0  # a step whose loss costs less is dropped


@dataclass
class Course:
    """A diagnosis under way: the model so far beside the data."""

    bench: Bench
    search: Search
    state: State
    values: dict[Key, Any]
    steps: list[Step]
    ladder: list[Rung]
    settled: Settled | None = None  # the numbers of all steps, with how the cells follow them

    @property
    def judged(self) -> dict[Cell, np.ndarray]:
        """Residuals of each capture, the numbers being settled without it as far as there are others."""
        return (
            self.state.residuals if self.settled is None else settling.unseen(self.state.residuals, self.settled.slopes)
        )

    @property
    def failed(self) -> list[checks.Block]:
        """The checks that a right model would hardly fail."""
        return checks.failing(checks.blocks(self.bench, self.state, self.state.residuals))

    @property
    def misfit(self) -> float:
        """On captures that the numbers were not settled with, as far as there are any; 1 is noise."""
        return checks.misfit(self.state.own, self.judged)

    def kept(self) -> tuple[Any, ...]:
        """All that a step changes."""
        own = (self.state, dict(self.values), list(self.steps), list(self.ladder), self.settled)
        return (*own, list(self.search.accepted), dict(self.search.phases))

    def back_to(self, kept: tuple[Any, ...]) -> None:
        """As it was before a step."""
        self.state, self.values, self.steps, self.ladder, self.settled = kept[:5]
        self.search.accepted, self.search.phases = kept[5:]

    def rung(self, name: str, steps: Sequence[Step] = ()) -> None:
        """A row more in the ladder of errors: the model as it is now. steps: those that it adds."""
        left = self.judged
        errors = errors_of(self.bench, self.state, left)
        misfit = checks.misfit(self.state.own, left)
        held = [c for c in self.search.accepted if c.carrier]
        chips = any(step.chips for step in self.steps)
        maps = Mapped(dict(self.values), held, dict(self.search.phases), chips) if held else None
        self.ladder.append(Rung(name, self.state, misfit, errors, left, self.settled, list(steps), maps))

    def last_rung(self) -> None:
        """The last row anew: a closer look or the likelihood may have changed what it says."""
        last = self.ladder.pop()
        self.rung(last.model, last.steps)


def begun(bench: Bench) -> Course:
    """The model as it is stated, the phases of what swings settled."""
    bench.say("the model as it is")
    search = Search(bench, bench.say)
    state = bench.state({})
    keys = recordings.swinging(bench.start)
    if keys:  # what swings begins anew in every capture
        swing = turned(bench, state, keys, {}, fit.FEW)
        if not isinstance(swing, str):
            *_, found = swing.suited(bench, state, [1.0])
            mirrored = {id: swing.mirrored(id, p, 1.0) for id, p in found.items()}
            found = sided(bench, state, keys, {}, found, mirrored)
            search.phases.update({(id, key): p for id, p in found.items() for key in keys})
            state = bench.state({}, state.sensors.changed({}, search.phases))
    course = Course(bench, search, state, {}, [], [])
    course.rung("start")
    return course


def accept(course: Course, best: Tried, significance: float) -> list[Step]:
    """Add the best candidate to the model, settle everything anew beside the data."""
    bench, before = course.bench, course.state
    new = [
        Step(
            change,
            {},
            0.0,
            significance,
            material(best),
            dials=best.settled.dials if best.settled is not None else (),
            slopes=best.settled.slopes if best.settled is not None and best.faint else {},
            template=bench.template(before, best.there or best.moved),
            before=dict(before.residuals),
            phased=bool(best.phases),
            chips=best.chips,
            fluctuates=best.fluctuates,
            intervals=dict(best.intervals),
        )
        for change in best.changes
    ]
    course.search.accepted += best.changes
    course.search.phases.update(best.phases)
    course.steps += new
    known = best.state if not any(change.carrier for change in course.search.accepted) else None
    # a model that has been simulated has the earlier numbers where they were simulated, a last step short of settled
    course.values = {**(course.values if known is None else before.values), **best.values}
    settle_all(course, best.settled, known)
    course.rung("+ " + " + ".join(title(step.change) for step in new), new)
    return new


def settle_all(course: Course, settled: Settled | None = None, known: State | None = None) -> None:
    """The model with all its steps beside the data: maps, then all numbers together.

    settled: the numbers of the last step; known: the model with it, where it has been simulated already.
    """
    sensors, maps = _model(course)
    state = replace(known, values=dict(course.values)) if known else course.bench.state(course.values, sensors)
    dials = tuple(d for step in course.steps for d in step.dials)
    found: Settled | None = None
    if dials:
        found, state, maps = _followed(course, state, maps, dials, errors_known(course, settled))
        found = found or (settled if settled is not None and settled.dials == dials else None)
    course.state = state
    course.settled = found = None if found is None else _held(course, found)
    _written(course, found, maps)


def _followed(
    course: Course, state: State, maps: dict[Key, mapping.Map], dials: tuple[Dial, ...], errors: Mapping[Key, float]
) -> tuple[Settled | None, State, dict[Key, mapping.Map]]:
    """(numbers settled from where they nearly are right, the model there, its maps): the scatter is that model's own.

    None where they cannot be followed.
    """
    bench, slopes = course.bench, _slopes_known(course)
    settled: Settled | None = None
    near: Settled | None = None
    for turn in range(_AGAIN + 1):
        here = {d.key: course.values[d.key] for d in dials}
        closer = settling.follow(
            bench, state, dials, here, state.sensors.changed, _recordings(state), errors, slopes, near
        )
        if isinstance(closer, str):
            break
        settled = closer
        if turn == _AGAIN or square(state.residuals) - closer.square < _WORTH:
            break
        near = closer if np.all(np.abs(closer.point - settling.point_of(dials, here)) < _SAME) else None
        before = course.values, maps, state
        course.values = {**course.values, **closer.values}
        sensors, maps = _model(course)
        state = bench.state(course.values, sensors)
        if square(state.residuals) > square(before[2].residuals):
            # a line or an edge: slopes do not lead further
            course.values, maps, state = before
            settled = replace(settled, point=settling.point_of(dials, here), residuals=state.residuals)
            break
    return settled, state, maps


def _recordings(state: State) -> int:
    """How many recordings tell how the cells follow the numbers: many of a lamp that is another one in each."""
    return min(len(state.own[RATES]), _MANY) if state.fluctuates else 2 * fit.FEW


def _held(course: Course, settled: Settled) -> Settled:
    """The last step of all was not simulated: it is not taken where it loses a line or an edge, as no slope knows."""
    bench, state, dials = course.bench, course.state, settled.dials
    there = {d.key: d.value(float(x)) for d, x in zip(dials, settled.point, strict=True)}
    (moved,) = bench.moved(state, [state.sensors.changed(there)], _recordings(state))
    now = square(state.residuals)
    if isinstance(moved, str) or square(bench.residuals(state, moved)) > now + _LOST:
        return replace(settled, point=settling.point_of(dials, course.values), residuals=state.residuals)
    return settled


def _written(course: Course, settled: Settled | None, maps: Mapping[Key, mapping.Map]) -> None:
    """The values of all steps, as they were settled, with their intervals."""
    if settled is not None:
        place = {d.key: i for i, d in enumerate(settled.dials)}
        for step in course.steps:
            beside = _of_pixels(course, step, maps)
            for k, dial in enumerate(step.dials):
                i = place[dial.key]
                variance = max(float(settled.covariance[i, i]), 0.0) + beside[k]
                u, half = float(settled.point[i]), _HALF * math.sqrt(variance)
                step.values[dial.parameter] = Value(dial.value(u), *dial.interval(u - half, u + half), dial.unit)
                course.values[dial.key] = dial.value(u)
    for step in course.steps:
        if step.change.carrier and step.change.carrier in maps:
            step.values = map_values(maps[step.change.carrier])
        for (effect, name), (low, high) in step.intervals.items():
            unit = next(d.unit for d in step.change.dials if d.key == (effect, name))
            own = step.values.get(name) if any(d.key == (effect, name) for d in step.dials) else None
            if own is not None and own.low is not None and own.high is not None:
                # wherever a whole number beside it may be; if later steps have moved it, that is of no use
                inside = low <= own.value <= high
                low, high = (min(low, own.low), max(high, own.high)) if inside else (own.low, own.high)
            step.values[name] = Value(float(course.values[effect, name]), low, high, unit)
        for (_, name), value in step.change.fixed:
            if name not in step.values and isinstance(value, (bool, int, float)):
                step.values[name] = Value(float(value), None, None)


def _of_pixels(course: Course, step: Step, maps: Mapping[Key, mapping.Map]) -> np.ndarray:
    """(dials,) variances of a light pattern's coordinates that pixels which differ by themselves make.

    They have by chance a slope of their own, which no measurement tells from one of the light.
    """
    bench, one = course.bench, course.state.sensors.one
    lights = [c for c in course.search.accepted if c.carrier in maps and mapping.bench_light_only(one, c)]
    lit = [id for id, seen in bench.seen.items() if seen.counts is not None and not seen.capture.light.dark]
    pattern = getattr(Effect.registry.find(step.change.effect), "stage", "") == "light"
    if not (pattern and step.dials and lights and lit):
        return np.zeros(len(step.dials))
    id = max(lit, key=lambda i: bench.seen[i].total)
    slopes = []
    for dial in step.dials:
        u = dial.coordinate(float(course.values[dial.key]))
        ends = [dial.coordinate(dial.value(u + h)) for h in (_STEP, -_STEP)]
        rates = [mapping.expected(bench, id, course.state, {dial.key: dial.value(end)}) for end in ends]
        slope = (np.log(rates[0]) - np.log(rates[1])) / max(ends[0] - ends[1], 1e-12)
        slopes.append(slope - slope.mean())
    design = np.stack(slopes, axis=1)
    sigma = max(maps[c.carrier].sigma for c in lights if c.carrier)
    return sigma**2 * np.diag(np.linalg.pinv(design.T @ design, rcond=1e-6, hermitian=True))


def errors_known(course: Course, settled: Settled | None = None) -> dict[Key, float]:
    """Standard deviations of the coordinates of edges that are settled already: they have slopes close by only.

    All else is followed over longer ways, lest chance hides how.
    """
    out = {}
    for step in course.steps:
        for dial in filter(is_edge, step.dials):
            v = step.values.get(dial.parameter)
            if v is not None and v.low is not None and v.high is not None:
                out[dial.key] = abs(dial.coordinate(v.high) - dial.coordinate(v.low)) / (2 * _HALF)
    if settled is not None:
        spread = np.sqrt(np.maximum(np.diag(settled.covariance), 0.0))
        out |= {d.key: float(x) for d, x in zip(settled.dials, spread, strict=True) if is_edge(d)}
    return out


def open_ends(course: Course) -> None:
    """Where the data do not exclude an end of a shape's range, its interval goes that far: slopes do not see it."""
    tests = []
    for step in course.steps:
        for dial in step.dials:
            v = step.values[dial.parameter]
            if dial in step.change.shapes and v.low is not None and v.high is not None and not v.method:
                tests += [(step, dial, end) for end in (dial.low, dial.high) if not v.low <= end <= v.high]
    state, bench = course.state, course.bench
    models = [state.sensors.changed({dial.key: end}) for _, dial, end in tests]
    some = [captures_showing(step.template, UNSEEN[0]) for step, _, _ in tests]
    now = square(state.residuals)
    for (step, dial, end), moved in zip(tests, bench.moved(state, models, 2 * fit.FEW, only_of=some), strict=True):
        if not isinstance(moved, str) and square(bench.residuals(state, moved)) < now + EXCLUDED:
            v = step.values[dial.parameter]
            assert v.low is not None and v.high is not None
            step.values[dial.parameter] = replace(v, low=min(v.low, end), high=max(v.high, end))


def settle_exactly(course: Course, measurement: Measurement) -> None:
    """All numbers by the likelihood of the data themselves, where all that the model has is in it.

    Not where checks fail at its numbers and another step would do as well.
    """
    bench = course.bench
    wanted = [step.change for step in course.steps if step.dials]
    dials = [d for step in course.steps for d in step.dials]
    if not wanted or len({d.key for d in dials}) < len(dials) or any(step.phased for step in course.steps):
        return
    captures = [seen.capture for seen in bench.seen.values()]
    if any(likelihood.unknown(course.state.sensors.one, capture) for capture in captures):
        return
    bench.say("the likelihood of the data")
    data = [measurement.recording(capture.id, bench.start) for capture in captures]
    own = {key for change in wanted for key in _keys_of(change, course)}
    sensor = with_values(bench.start, {key: x for key, x in course.values.items() if key not in own})
    start = {d.key: float(course.values[d.key]) for d in dials}
    errors = {}
    for step in course.steps:
        for dial in step.dials:
            v = step.values[dial.parameter]
            assert v.low is not None and v.high is not None
            errors[dial.key] = abs(dial.coordinate(v.high) - dial.coordinate(v.low)) / (2 * _HALF)
    mapped = any(step.change.carrier for step in course.steps)
    found = likelihood.settled(sensor, data, wanted, start=start, errors=errors, mapped=mapped)
    if isinstance(found, str):
        return
    moved, failed = 0.0, {block.cell for block in course.failed}
    before = dict(course.values), course.state, [dict(step.values) for step in course.steps]
    for step in course.steps:
        for dial in step.dials:
            value, (low, high) = found.values[dial.key], found.intervals[dial.key]
            moved = max(moved, abs(dial.coordinate(value) - dial.coordinate(start[dial.key])) / errors[dial.key])
            step.values[dial.parameter] = Value(value, low, high, dial.unit, "likelihood")
            course.values[dial.key] = value
    if moved > _MOVED:
        course.state = bench.state(course.values, _model(course)[0])
        rivals = any(other.get("confused") for step in course.steps for other in step.alternatives)
        if rivals and {block.cell for block in course.failed} - failed:
            # of laws that are as good it knows only one: where that fails, it decides nothing
            course.values, course.state, earlier = before
            for step, usual in zip(course.steps, earlier, strict=True):
                step.values = usual


def widen(course: Course) -> None:
    """No number is known better than what its law leaves unexplained in the cells that tell it."""
    if course.settled is None:
        return
    wider = settling.unexplained_scatter(course.settled, course.state)
    factors = {d.key: float(x) for d, x in zip(course.settled.dials, wider, strict=True)}
    for step in course.steps:
        for dial in step.dials:
            step.values[dial.parameter] = _widened(step.values[dial.parameter], dial, factors.get(dial.key, 1.0))


def _widened(value: Value, dial: Dial, factor: float) -> Value:
    """The value with an interval so many times as wide, in its coordinate."""
    assert value.low is not None and value.high is not None
    u = dial.coordinate(value.value)
    ends = [u + factor * (dial.coordinate(end) - u) for end in (value.low, value.high)]
    low, high = dial.interval(min(ends), max(ends))
    return replace(value, low=low, high=high)


def _slopes_known(course: Course) -> dict[Key, dict[Cell, np.ndarray]]:
    """How the cells follow the numbers of faint effects, as stronger ones have told."""
    out: dict[Key, dict[Cell, np.ndarray]] = {}
    for step in course.steps:
        for i, dial in enumerate(step.dials if step.slopes else ()):
            out[dial.key] = {cell: x[:, i] for cell, x in step.slopes.items()}
    return out


def _model(course: Course) -> tuple[Sensors, dict[Key, mapping.Map]]:
    """The model with all its steps, its maps settled to the data."""
    bench, search = course.bench, course.search
    held = [c for c in search.accepted if c.carrier]
    chips = any(step.chips for step in course.steps)
    if not held:
        return Sensors.same(bench.start).changed(course.values, search.phases, chips), {}
    levels = mapping.levels_of(bench, course.state)
    sensors, maps, course.values = mapping.sensors_with(bench, course.values, held, levels)
    return sensors.changed({}, search.phases, chips), maps


def map_values(map_: mapping.Map) -> dict[str, Value]:
    """What is said of a map in the answer, with intervals of 95 %."""
    told = {name: Value(number, None, None) for name, number in mapping.summary(map_).items()}
    sigma, noise = told["sigma"].value, float(np.median(map_.raw_error))
    # of a variance, which is what remains of the differences without the noise
    half = _HALF * (sigma**2 + noise**2) * math.sqrt(2 / len(map_.raw))
    ends = [math.sqrt(max(sigma**2 + k * half, 0.0)) for k in (-1, 1)]
    told["sigma"] = Value(sigma, ends[0], ends[1])
    if map_.width is not None:
        told["sigma"] = Value(map_.width.sigma, map_.width.low, map_.width.high)
    for name in ("low_fraction", "high_fraction"):
        n, k = len(map_.raw), told[name].value * len(map_.raw)
        low = float(stats.beta.ppf(0.025, k, n - k + 1)) if k > 0 else 0.0
        high = float(stats.beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
        told[name] = Value(told[name].value, low, high)
    ratio, error = mapping.low_ratio(map_)
    if math.isfinite(error):  # without lazy ones there is no ratio of theirs
        told["low_ratio"] = Value(ratio, max(ratio - _HALF * error, 0.0), ratio + _HALF * error)
    return told


def material(one: Tried) -> str:
    """What a candidate changes of the mean rate, for people."""
    logs = list(one.moved.at(one.times).logs.values())
    return f"mean rate {math.expm1(-float(np.mean(logs)) if logs else 0.0):+.2%}"


def drop_needless(course: Course) -> None:
    """Steps that later ones made superfluous are taken out again."""
    bench = course.bench
    for step in list(course.steps[:-1]):
        if len(course.steps) < 2 or step.phased:
            continue
        if step.change.carrier:
            if not course.steps[-1].change.carrier:  # which may be what makes the pixels differ
                _drop_unless_missed(course, step)
            continue
        if step.fluctuates:  # squares of residuals that are as wide as with it do not miss it
            _drop_unless_missed(course, step)
            continue
        rest = {k: v for k, v in course.values.items() if k not in _keys_of(step.change, course)}
        sensors = Sensors.same(bench.start).changed(rest, course.search.phases)
        if any(s.change.carrier for s in course.steps):
            continue  # a map would have to be settled anew
        (moved,) = bench.moved(course.state, [sensors], fit.FEW)
        if isinstance(moved, str):
            continue
        others = tuple(d for s in course.steps if s is not step for d in s.dials)
        z = bench.residuals(course.state, moved)
        loss = square(z) - square(course.state.residuals)
        if loss > 30 and not others:
            continue
        point = {d.key: rest[d.key] for d in others}
        closer = settling.settle(bench, course.state, others, point, sensors.changed, 2) if others else None
        if isinstance(closer, Settled):
            loss = closer.square - square(course.state.residuals)
        if loss < _NEEDLESS:
            bench.say(f"{title(step.change)} is no longer needed")
            course.steps.remove(step)
            course.search.accepted.remove(step.change)
            course.values = rest
            settle_all(course)
            course.rung(f"- {title(step.change)}")


def _drop_unless_missed(course: Course, step: Step) -> None:
    """Take a step out again, unless some check fails without it that does not with it.

    Light that fluctuates stays where it is likelier, too: if no check failed, its trace is all that has told it.
    """
    before, failed = course.kept(), len(course.failed)
    course.bench.say(f"is {title(step.change)} still needed?")
    course.steps = [s for s in course.steps if s is not step]
    course.search.accepted = [c for c in course.search.accepted if c is not step.change]
    kept = set().union(*(_keys_of(s.change, course) for s in course.steps))
    course.values = {k: x for k, x in course.values.items() if k in kept}
    settle_all(course)
    missed = len(course.failed) > failed
    if step.fluctuates and not missed:
        trace = {cell: step.template.get(cell, np.zeros_like(z)) for cell, z in before[0].residuals.items()}
        missed = likelier(course.state, before[0], trace, fluctuates=True) > _NEEDLESS
    if missed:
        course.back_to(before)
    else:
        course.rung(f"- {title(step.change)}")


def _keys_of(change: Change, course: Course) -> set[Key]:
    if change.kind == "add":
        return {k for k in course.values if k[0] == change.effect}
    return {(change.effect, change.parameter or "")}


def drop_mimics(course: Course, start: State, totals: bool) -> None:
    """Where something remains, steps that only happen to look like it are no findings.

    The cells that a step speaks of must be in order with it; and of totals alone, whatever remains may be the cause.
    start: the model without any; totals: are they a matter of the model, and not of the set-up?
    """
    while course.steps and any(totals or block.cell[0] for block in course.failed):
        # what one step leaves another one cannot explain: the worst goes first, and the others are looked at again
        left = {id(s): _left_of_own(s, course.state, totals) for s in course.steps}
        worst = max(course.steps, key=lambda s: left[id(s)])
        now, then = (checks.misfit(state.own, state.residuals) for state in (course.state, start))
        mostly = len(course.steps) == 1 and then - now > _MOSTLY * (then - 1) > 0
        kept = [s for s in course.steps if s is not worst or left[id(s)] < 1 or mostly]
        if now > then:
            kept = []
        if len(kept) == len(course.steps):
            return
        course.steps = kept
        course.search.accepted = [c for c in course.search.accepted if any(c is s.change for s in kept)]
        known = set().union(*(_keys_of(s.change, course) for s in kept))
        course.values = {k: v for k, v in course.values.items() if k in known}
        listed = {effect.name for effect in course.bench.start.effects}
        swinging = listed | {change.effect for change in course.search.accepted}
        course.search.phases = {at: p for at, p in course.search.phases.items() if at[1][0] in swinging}
        if kept:
            settle_all(course)
            course.rung("without what only looks alike")
        else:
            course.state, course.settled = start, None


def in_vain(course: Course, totals: bool) -> bool:
    """Do several steps only happen to look like what is there? Then nothing of the catalogue does, and more are no use.

    totals: see `drop_mimics`.
    """
    left = [_left_of_own(step, course.state, totals) for step in course.steps]
    return len(left) >= _VAIN and bool(course.failed) and all(1 <= x < math.inf for x in left)


def _left_of_own(step: Step, state: State, totals: bool) -> float:
    """What is left of the cells that a step speaks of; from 1 on it only happens to look like what is there.

    totals: are they among them?
    """
    weight, after, before, shape, shapes = 0.0, 0.0, 0.0, 0.0, 0.0
    for cell, t in step.template.items():
        z, old = state.residuals.get(cell), step.before.get(cell)
        if z is None or old is None or len(z) != len(t) or len(old) != len(t) or (cell == RATES and not totals):
            continue
        w = t**2
        weight, after, before = weight + float(w.sum()), after + float(w @ z**2), before + float(w @ old**2)
        if cell != RATES:
            shape, shapes = shape + float(old @ old - z @ z), shapes + float(w.sum())
    # of totals alone, whatever remains may be the cause
    if weight <= 0 or shape < LEAST_GAIN or shapes < 0.5 * weight:
        return math.inf
    return after / weight / max(4.0, _LEFT * before / weight)
