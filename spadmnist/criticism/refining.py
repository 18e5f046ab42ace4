"""Refining: the numbers of a candidate are settled beside the data, and how well they are known."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..errors import SpadError
from . import checks, fit, settling
from .candidates import Dial, Key
from .fit import RATES, Bench, State, likelier, square, stacked
from .settling import Settled
from .showing import captures_showing
from .swings import NEAR, sided, turned
from .tried import Tried, is_edge, room_of

_ASIDE = 0.1  # of a logarithm, for the slope of what swings
UNSEEN = 0.01, 4.0  # of the square of a trace, by its share and by its size: where so little is, nobody looks
STRONG = 60.0  # standard deviations of a trace that chance hardly blurs
_PROBES = (0.1, 0.03, 0.01, 0.003)  # of a logarithm
_FINE = (0.0015, 0.0007)  # the same, of an edge: it may be known to some 10 ps
_FAR, _MOVES = (0.6, 0.3, 0.15), 6  # of an edge, and how often
_POWERS = (0.85, 2.3)  # with which a trace grows that may be simulated at another strength
_LINE = 0.25  # of the square of a trace, in one cell of a spectrum
_LEAST_BOOST = 1.5  # worth it
_SWINGING = 6  # recordings for phases: what swings has other random numbers than what does not
_NEXT = 0.35, 0.1  # of a whole number's logarithm: the first steps to its neighbours, and no shorter
_EACH = 2.0  # in chi square, of a number that is settled
_BETTER, EXCLUDED = 2.0, 6.0  # in chi square: what a better whole number gains, and what costs so much is none


def refine(bench: Bench, state: State, one: Tried, rounds: int = 3) -> Tried:
    """Settle the numbers of a candidate. Its gain is that on captures that they are not settled with.

    Raises SpadError where it cannot be simulated there.
    """
    if one.maps is not None or not one.change.dials:
        one.residuals = bench.residuals(state, one.moved, noisy=True)
        return one
    if one.change.phases:
        return _swung(bench, state, one)
    given = one.scaled()
    dials = [d for d in one.change.dials if d.key in given and not d.whole]
    boost, power = _boost(bench, state, one, given)
    trace = bench.template(state, one.moved.at(one.times))
    some = captures_showing(trace, *UNSEEN)

    def settled(values: Mapping[Key, Any], rounds: int = rounds) -> Settled | str:
        return settling.settle(
            bench,
            state,
            dials,
            values,
            lambda v: state.sensors.changed(v, one.phases, one.chips),
            rounds,
            stronger=(boost, power),
            only=some,
        )

    found = settled(given)
    if isinstance(found, str):
        raise SpadError(found)
    for dial in one.change.dials:
        if dial.whole and dial.key in given:
            found, intervals = _counted(found, dial, lambda v: settled(v, 2))
            one.intervals |= intervals
    if boost == 1 and _fails_its_own(bench, state, one, found):
        found = _probed(bench, state, one, found, some)
    one.faint = boost > 1
    one.sensors = state.sensors.changed(found.values, one.phases, one.chips)
    if not one.faint:  # there it may do what it did not do where it was tried first
        (there,) = bench.moved(state, [one.sensors])
        if isinstance(there, str):
            raise SpadError(there)
        one.there, residuals = there, bench.residuals(state, there)
        found = replace(found, residuals=residuals, square=square(residuals))
    one.settled, one.values, one.residuals, one.times = found, dict(found.values), found.residuals, 1.0
    one.gain = square(state.residuals) - found.square
    if one.scatters:  # pixels, or recordings, may then differ as they do: no matter of their mean
        with contextlib.suppress(SpadError):  # what cannot be simulated everywhere is judged by its mean
            one.gain = likelier(state, state_of(bench, one), trace, one.fluctuates)
    one.gain -= _EACH * len(dials) if one.fluctuates else optimism(one)
    return one


def optimism(one: Tried) -> float:
    """By how much a settled candidate's squares are smaller than on captures that its numbers are not settled with."""
    if one.settled is None or one.residuals is None:
        return 0.0
    return settling.optimism(one.residuals, one.settled) + 2.0 * len(one.phases)


def state_of(bench: Bench, one: Tried) -> State:
    """The model of a candidate beside the data, each cell judged by that model's own scatter."""
    if one.state is None:
        assert one.sensors is not None
        one.state = bench.state({}, one.sensors)
    return one.state


def _fails_its_own(bench: Bench, state: State, one: Tried, found: Settled) -> bool:
    """Does a check fail, the numbers being settled, of those that the candidate moves at all?"""
    trace = bench.template(state, one.moved.at(one.times))
    failed = checks.failing(checks.blocks(bench, state, found.residuals))
    own = {RATES if block.cell[0] == "" else block.cell for block in failed}
    return any(float(trace[cell] @ trace[cell]) > 1 for cell in own if cell in trace)


def _boost(bench: Bench, state: State, one: Tried, given: Mapping[Key, Any]) -> tuple[float, float]:
    """(how much stronger a faint effect is simulated, the power with which its trace grows).

    1 where that is no power: an edge moves, and much of anything saturates.
    """
    trace = bench.template(state, one.moved.at(one.times))
    size = math.sqrt(sum(float(t @ t) for t in trace.values()))
    strengths = [d for d in one.change.strengths if d.key in given]
    spectra = [t for cell, t in trace.items() if cell in state.nulls and state.nulls[cell].law == "exponential"]
    if any(float(np.max(t**2)) > _LINE * size**2 for t in spectra if t.size):
        return 1.0, 1.0  # a line stands out by itself, and no slope says where
    if size > STRONG or one.moved.even or not strengths or any(is_edge(d) for d in strengths):
        return 1.0, 1.0
    room = min(room_of(d, float(given[d.key])) for d in strengths)
    boost = min((STRONG / max(size, 1e-3)) ** (1 / one.power), room)
    if boost < _LEAST_BOOST:
        return 1.0, 1.0
    ups = [{d.key: d.scaled(float(given[d.key]), x) for d in strengths} for x in (boost, math.sqrt(boost))]
    models = [state.sensors.changed({**given, **up}, one.phases, one.chips) for up in ups]
    traces = []
    for moved in bench.moved(state, models, 2 * fit.FEW, kept="sure"):
        if isinstance(moved, str):
            return 1.0, 1.0
        traces.append(stacked(bench.template(state, moved), list(state.residuals)))
    far, near = traces
    along = float(near @ far)  # of the same trace, lest it is chance that is compared
    power = 2 * math.log(float(far @ far) / along) / math.log(boost) if along > 0 else 0.0
    return (boost, power) if _POWERS[0] < power < _POWERS[1] else (1.0, 1.0)


def _probed(bench: Bench, state: State, one: Tried, found: Settled, only: Collection[str]) -> Settled:
    """Settled numbers, better ones near by being taken where slopes do not lead to them: a line, an edge.

    only: captures that are simulated for it.
    """
    for dial in one.change.dials:
        if dial not in found.dials or not dial.log:
            continue
        if dial in one.change.shapes:
            found, _ = _nearest(bench, state, one, found, dial, _PROBES, only)
        elif is_edge(dial):
            for _ in range(_MOVES):  # a wall is not seen from afar: step by step, first long ones
                found, moved = _nearest(bench, state, one, found, dial, _FAR, only)
                if not moved:
                    break
            for probes in (_PROBES, _FINE):
                found, _ = _nearest(bench, state, one, found, dial, probes, only)
    return found


def _nearest(
    bench: Bench, state: State, one: Tried, found: Settled, dial: Dial, probes: Sequence[float], only: Collection[str]
) -> tuple[Settled, bool]:
    """(the best of the probes to both sides of a number, or what was settled; is it one of the probes?)."""
    at, before = float(found.values[dial.key]), found
    steps = [s * x for x in probes for s in (-1, 1)]
    tries = [{**found.values, dial.key: dial.value(dial.coordinate(at) + x)} for x in steps]
    models = [state.sensors.changed(t, one.phases, one.chips) for t in tries]
    best = found.square - 6
    for tried, x, moved in zip(tries, steps, bench.moved(state, models, fit.FEW, only), strict=True):
        if isinstance(moved, str):
            continue
        residuals = bench.residuals(state, moved)
        if square(residuals) < best:
            best = square(residuals)
            found = replace(
                found, point=settling.point_of(found.dials, tried), residuals=residuals, square=best, values=tried
            )
            i = found.dials.index(dial)
            # no slope told it, so that its neighbours must
            found.covariance[i, i] = min(float(found.covariance[i, i]), (abs(x) / 2) ** 2)
    return found, found is not before


def _swung(bench: Bench, state: State, one: Tried) -> Tried:
    """The strength of what swings, and its phase in each capture.

    It is simulated as strong as chance does not hide it; what it does then tells what less of it does.
    """
    dials = tuple(d for d in one.change.strengths if d.key in one.values)
    size, given = bench.size(state, one.moved.at(one.times)), one.scaled()
    room = min(room_of(d, float(given[d.key])) for d in dials)
    stronger_by = max(1.0, min(math.sqrt(STRONG / max(size, 1e-9)), room))
    strong = {**given, **{d.key: d.scaled(float(given[d.key]), stronger_by) for d in dials}}
    swing = turned(bench, state, one.change.phases, strong, _SWINGING)
    if isinstance(swing, str):
        raise SpadError(swing)
    gain, times, found = swing.suited(bench, state, [x / stronger_by for x in (0.5, *NEAR, 2.0)])
    one.values = {**strong, **{d.key: d.scaled(float(strong[d.key]), times) for d in dials}}
    mirrored = {id: swing.mirrored(id, p, times) for id, p in found.items()}
    found = sided(bench, state, one.change.phases, one.values, found, mirrored)
    moved = swing.at(found)
    one.phases = {(id, key): p for id, p in found.items() for key in one.change.phases}
    one.moved = moved.at(times)
    one.times, one.faint = 1.0, True
    one.residuals = residuals = bench.residuals(state, moved, times)
    one.sensors = state.sensors.changed(one.values, one.phases, one.chips)
    aside = [bench.residuals(state, moved, times * math.exp(h)) for h in (_ASIDE, -_ASIDE)]
    # of one number, or of several that all go up together
    apart = [d.coordinate(d.scaled(float(one.values[d.key]), math.exp(2 * _ASIDE))) for d in dials]
    now = settling.point_of(dials, one.values)
    slopes = {
        cell: (aside[0][cell] - aside[1][cell])[:, None] / (np.array(apart) - now)[None, :] / len(dials)
        for cell in residuals
    }
    own = np.concatenate([state.own[cell] for cell in residuals], axis=1)
    covariance = settling.covariance_of(np.concatenate(list(slopes.values())), own)
    one.settled = Settled(dials, now, covariance, residuals, slopes, square(residuals), one.values)
    one.gain = gain - optimism(one)
    return one


def _counted(
    found: Settled, dial: Dial, settled: Callable[[Mapping[Key, Any]], Settled | str]
) -> tuple[Settled, dict[Key, tuple[float, float]]]:
    """(the best with a whole number settled beside the others, intervals).

    Of the whole number they are the values that the data do not exclude; of the others what holds beside any of these.
    No slope leads from one to the next: from its neighbours, ever nearer ones, all else being settled at each.
    """
    best = {float(found.values[dial.key]): found}
    squares = {value: one.square for value, one in best.items()}
    begun: dict[float, float] = {}  # from which other one each was settled last

    def there(value: float, start: Settled) -> None:
        begun[value] = float(start.values[dial.key])
        one = settled({**start.values, dial.key: value})
        if not isinstance(one, str) and one.square < squares.get(value, math.inf):
            best[value], squares[value] = one, one.square
        squares.setdefault(value, math.inf)

    step = _NEXT[0]
    while True:
        here = float(found.values[dial.key])
        near = {_beside(dial, here, x) for x in (-step, step)} - {here}
        # what was settled from afar may not have come to where it is best
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
    here = float(found.values[dial.key])
    excluded = found.square + EXCLUDED * _dependent(found)
    for side in (-1, 1):  # on to where they do
        step = _NEXT[0]
        while all(side * (x - here) <= 0 or squares[x] <= excluded for x in squares):
            far = max(best, key=lambda x, side=side: side * x)  # type: ignore[misc]
            if (further := _beside(dial, far, side * step)) in squares:
                break
            there(further, best[far])
            step *= 2
    out = [x for x, square in squares.items() if square > excluded]
    low = max((x + 1 for x in out if x < here), default=dial.low)
    high = min((x - 1 for x in out if x > here), default=dial.high)
    ends = {dial.key: (low, high)}
    for i, other in enumerate(found.dials):
        told = [one.interval(i)[1:] for x, one in best.items() if low <= x <= high and one.dials == found.dials]
        if len(told) > 1:
            ends[other.key] = min(a for a, _ in told), max(b for _, b in told)
    return found, ends


def _dependent(settled: Settled) -> float:
    """By how much the squares of cells that depend on each other rise more than those of independent ones; at least 1.

    As `settling.profiled` has it of one number, in the mean of all that are settled.
    """
    slopes = np.concatenate([np.zeros((0, len(settled.dials))), *settled.slopes.values()])
    naive = np.diag(np.linalg.pinv(slopes.T @ slopes, rcond=1e-10))
    wider = np.divide(np.diag(settled.covariance), naive, out=np.ones_like(naive), where=naive > 0)
    wider = wider[np.isfinite(wider)]
    return max(float(np.mean(wider)) if wider.size else 1.0, 1.0)


def _beside(dial: Dial, value: float, step: float) -> float:
    """The whole number so far away, of a logarithm, but at least the next one; at a bound that itself."""
    other = dial.value(dial.coordinate(value) + step)
    other = min(other, value - 1) if step < 0 else max(other, value + 1)
    return min(max(other, dial.low), dial.high)
