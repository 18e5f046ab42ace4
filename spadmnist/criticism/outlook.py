"""Outlook: what would have been seen, and which capture would tell what these cannot."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .. import twin, units
from ..effects import Conditions, Mimic
from ..recording import Capture, Light, Recording
from . import fit, recordings
from .answer import NONLINEARITY, Step, plain
from .candidates import Change
from .chance import along
from .fit import Bench, Moved, Seen, Sensors, State, square
from .search import Search
from .setups import Explanation
from .tried import Tried

_RECORDINGS = 16  # of a capture that nobody has taken yet
_MOST_EVENTS = 6e5  # of it
_LONG = 100.0  # s of a long dark capture
_LONGER = 10.0  # times a capture that is taken again, at most
_MOST_FRAMES = 4.0  # the same of frames, which cost whether they hold anything or not
_ONE_SIDED = 1.645  # 95 %
_CLEARLY, _HARDLY = 15.0, 0.5  # standard deviations of a trace that chance does not hide, and of one that it does
_MOST_OF = 0.9  # of the square of a trace, which so many captures show
_SATURATED = 1000.0  # of a trace that hardly grows any more
_LOOKS = 5  # at other strengths, until that is found


# --- which capture would tell ------------------------------------------------------------------------------------


def advice(search: Search, state: State, found: Change, other: Tried) -> list[dict[str, Any]]:
    """The capture that tells two explanations apart best, with the significance now and then."""
    bench = search.bench
    assert other.sensors is not None
    residuals = other.residuals or {}
    now = math.sqrt(max(square(residuals) - square(state.residuals), 0.0))
    bench.say("which capture would tell")
    best: tuple[float, str] | None = None
    for words, capture, like in _menu(bench, state):
        z = _apart(bench, state.sensors, other.sensors, capture, like)
        if best is None or z > best[0]:
            best = z, words
    if best is None:
        return []
    return [_told(best[1], [found.effect, other.change.effect], now, math.hypot(now, best[0]))]


def _told(words: str, separates: Sequence[str], now: float, then: float) -> dict[str, Any]:
    return {
        "capture": words,
        "separates": list(separates),
        "significance_now": plain(now),
        "significance_then": plain(then),
    }


def _menu(bench: Bench, state: State) -> Iterator[tuple[str, Capture, str]]:
    """(words, a capture that any laboratory can take, which one it resembles)."""
    rates = {}
    for id, seen in bench.seen.items():
        if seen.counts is not None and seen.total > 0:
            rates[id] = seen.total / seen.capture.conditions.exposure
    lit = sorted((id for id in rates if not bench.seen[id].capture.light.dark), key=lambda id: rates[id])
    dark = [id for id in rates if bench.seen[id].capture.light.dark]
    for id in dark[:1]:
        yield from _longer(bench.seen[id].capture, rates[id], "dark", id)
    for id in lit[:1]:
        yield from _longer(bench.seen[id].capture, rates[id], f"{id}", id)
        yield from _brighter(bench, id, rates[id], 0.1)
    if lit:
        yield from _longer(bench.seen[lit[-1]].capture, rates[lit[-1]], f"{lit[-1]}", lit[-1])
        yield from _brighter(bench, lit[-1], rates[lit[-1]], 4.0)


def _longer(capture: Capture, rate: float, words: str, like: str) -> Iterator[tuple[str, Capture, str]]:
    c = capture.conditions
    most = min(_LONG if capture.light.dark else _LONGER * c.exposure, _MOST_EVENTS / rate)
    if most < 1.5 * c.exposure:
        return
    if capture.modality == "tr":
        yield f"{words}, {units.show(most, 's', 3)}", replace(capture, conditions=replace(c, exposure=most)), like
        return
    frames = int(min(most, _MOST_FRAMES * c.exposure) / c.frame_period)
    longer = replace(c, frames=frames, exposure=frames * c.frame_period)
    yield f"{words}, {frames} frames", replace(capture, conditions=longer), like


def _brighter(bench: Bench, id: str, rate: float, times: float) -> Iterator[tuple[str, Capture, str]]:
    capture = bench.seen[id].capture
    level = capture.light.level
    pixels = bench.start.layout.pixels
    if (
        level is None
        or times * rate / pixels * bench.dead > 3
        or times * rate * capture.conditions.exposure > 2 * _MOST_EVENTS
    ):
        return
    words = f"a flat field {'as bright as a tenth of' if times < 1 else f'{times:g} times as bright as'} {id}"
    yield words, replace(capture, light=replace(capture.light, level=level * times)), id


def _apart(bench: Bench, one: Sensors, other: Sensors, capture: Capture, like: str) -> float:
    """Standard deviations by which two models differ in a capture that was not taken."""
    new = copy.copy(bench)
    capture = replace(capture, id=f"{capture.id} again")

    def there(sensors: Sensors) -> Sensors:
        typical = (lambda id: sensors.usual(like)) if sensors.typical else None
        return Sensors(lambda id, number: sensors.of(like, number), sensors.one, sensors.alike, typical)

    first, second = there(one), there(other)
    level = 1.0 if capture.light.dark else twin.photons_at(capture, bench.start.layout) or 0.0
    sensor = first.of(capture.id, 0)
    sensor = recordings.InTheDark.of(sensor) if capture.light.dark else sensor
    number = np.array([10_000], np.uint64)
    made: Recording = next(recordings.simulated(sensor, capture, np.array([level]), number, bench.seed))
    made = replace(made, dead_time=bench.dead, _kept={})
    counts = np.asarray(made.totals, float)
    summaries = {}
    for statistic in recordings.statistics_for(made.modality):
        summary = recordings.reduced(statistic, made)
        if summary is not None:
            summaries[statistic.name] = summary
    new.seen = {capture.id: Seen(made.capture, float(counts.sum()), counts, summaries)}
    state = new.state({}, first, _RECORDINGS)
    (moved,) = new.moved(state, [second], fit.FEW, hasty=False, kept="sure")
    if isinstance(moved, str):
        return 0.0
    return math.sqrt(sum(float(t @ t) for t in new.template(state, moved).values()))


def advice_on_totals(search: Search, state: State, setup: Explanation, other: Tried) -> list[dict[str, Any]]:
    """Which capture tells a set-up from a change of the sensor that explains the same totals, by closed forms."""
    bench = search.bench
    now = math.sqrt(abs(setup.cost - other.cost(state)))
    whole = {id for factor in setup.factors for id in factor.captures}
    log = float(setup.logs[0])
    best: tuple[float, str] | None = None
    model = next(iter(bench.seen.values())).capture
    usual = state.sensors.one
    conditions = replace(_dark(model.conditions), exposure=_LONG)
    tries = [("dark, 100 s", Capture("dark", "tr", Light(), conditions), 0.0)]
    for id, seen in bench.seen.items():
        light = seen.capture.light
        if light.dark or light.level is None:
            continue
        for times in (0.1, 10.0):
            brighter = replace(seen.capture, light=replace(light, level=light.level * times))
            words = f"a flat field {'a tenth' if times < 1 else 'ten times'} as bright as {id}"
            tries.append((words, brighter, log if id in whole else 0.0))
    assert other.sensors is not None
    for words, capture, expected in tries:
        level = 1.0 if capture.light.dark else twin.photons_at(capture, bench.start.layout) or 1.0
        plain_, changed = (
            recordings.closed_form(recordings.InTheDark.of(s) if capture.light.dark else s, capture)(level)
            for s in (usual, other.sensors.usual(model.id))
        )
        apart = abs(math.log(changed / plain_) - expected)
        z = apart / math.sqrt(1 / plain_ + capture.light.own_uncertainty**2 + 1e-6)
        if best is None or z > best[0]:
            best = z, words
    assert best is not None
    return [_told(best[1], [setup.factors[0].quantity, other.change.effect], now, math.hypot(now, best[0]))]


def advice_on_mimic(step: Step, other: Mimic) -> dict[str, Any]:
    """What tells a finding from what looks the same in all that was measured: at least as clearly as it was found."""
    return _told(other.capture, [step.change.effect, other.what], 0.0, step.significance)


def advice_on_brightest(bench: Bench, state: State, setup: Explanation, entry: Mapping[str, Any]) -> dict[str, Any]:
    """What tells a set-up from a nonlinearity: with half of the light, half is left, of a mistake nothing."""
    then = 0.5 * abs(float(setup.logs[0])) / bench.level_error(state, entry["capture"])
    words = f"a flat field half as bright as {entry['capture']}, its light measured anew"
    return _told(words, [entry["quantity"], NONLINEARITY], 0.0, then)


def _dark(conditions: Conditions) -> Conditions:
    return replace(conditions, wavelength=None)


def advice_on_setup(bench: Bench, state: State, entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Which capture tells a light level from an exposure: the same light with another exposure."""
    both: dict[str, dict[str, float]] = {}
    for entry in entries:
        if entry["confused"] and entry["capture"] is not None:
            both.setdefault(entry["capture"], {})[entry["quantity"]] = entry["factor"]["value"]
    able = {id: b for id, b in both.items() if {"light", "exposure"} <= b.keys()}
    if not able:
        return []
    id = max(able, key=lambda i: abs(math.log(able[i]["light"])) / bench.level_error(state, i))
    log = abs(math.log(able[id]["light"]))
    capture = bench.seen[id].capture
    own = capture.conditions.frame_time if capture.modality != "tr" else capture.conditions.exposure
    others = sorted(
        {s.capture.conditions.frame_time for s in bench.seen.values() if s.capture.modality != "tr"} - {own}
    )
    other = others[-1] if others and capture.modality != "tr" else 4 * own
    name = "exposure" if capture.modality == "tr" else "frame time"
    words = f"the light of {id} with a {name} of {units.show(other, 's', 3)}"
    # a light level is the same then; so much too long an exposure counts for less or for more
    then = log * abs(1 - own / other) / bench.level_error(state, id)
    return [_told(words, ["light", "exposure"], 0.0, then)]


# --- what would have been seen -----------------------------------------------------------------------------------


def upper_limits(
    search: Search, state: State, tried: Sequence[Tried]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """(effects with the largest strength that may be there unseen, 95 %; effects that cannot be seen here).

    tried: every candidate as it was looked at in all captures. The weakest limit of its shapes: whatever the shape,
    more would have been seen. How the trace of each grows with its strength is simulated once more.
    """
    bench = search.bench
    shapes: dict[str, list[_Shape]] = {}
    for one in tried:
        change = one.change
        if change.kind != "add" or len(change.strengths) != 1 or change.phases:
            continue
        trace = along(bench, state, one.moved)
        times = (max(trace.data, 0.0) + _ONE_SIDED) / trace.size if trace.size > 0 else math.inf
        shapes.setdefault(change.effect, []).append((times, trace.size, one))
    # a template that saturates does not tell which shape is the weakest
    asked = {
        (name, n): shape
        for name, all_ in shapes.items()
        for n, shape in enumerate(all_)
        if shape is max(all_, key=lambda s: s[0]) or min(s[1] for s in all_) > _SATURATED
    }
    times_of = _at_limit(search, state, asked)
    excluded, hidden = [], []
    for name in shapes:
        limits = [_strength(shape[2], times_of[key]) for key, shape in asked.items() if key[0] == name]
        dial = shapes[name][0][2].change.strengths[0]
        if None in limits:
            hidden.append(name)
        else:
            far = max((x for x in limits if x is not None), key=lambda x: abs(x - (dial.off or 0.0)))
            excluded.append({"effect": name, "parameter": dial.parameter, "upper_limit_95": plain(far)})
    return excluded, [{"effect": name} for name in sorted(hidden)]


# times the strength at which it would be seen if it grew in proportion, the size of its trace, what it is
_Shape = tuple[float, float, Tried]


def _at_limit(search: Search, state: State, weakest: Mapping[tuple[str, int], _Shape]) -> dict[tuple[str, int], float]:
    """Times the strength at which each would just be seen, its trace growing as stronger ones tell.

    Where it stands out clearly, but not by far, the power is measured with which it grows.
    """
    bench = search.bench
    out: dict[tuple[str, int], float] = {}
    open_: dict[tuple[str, int], tuple[float, float, float]] = {}  # strength and size that are known, strength to try
    needed: dict[tuple[str, int], float] = {}
    where: dict[tuple[str, int], tuple[str, ...]] = {}
    for name, (times, size, one) in weakest.items():
        out[name] = times
        if size > 2 * _CLEARLY:
            where[name] = _telling(bench, state, one.moved)
            seen = along(bench, state, one.moved.only(where[name])).size
            needed[name] = times * seen
            open_[name] = 1.0, seen, _CLEARLY / seen
    for _ in range(_LOOKS):
        known = {name: entry for name, entry in open_.items() if _strength(weakest[name][2], entry[2]) is not None}
        if not known:
            break
        models = []
        for name, (_, _, try_) in known.items():
            one = weakest[name][2]
            dial = one.change.strengths[0]
            models.append(state.sensors.changed({**one.values, dial.key: _strength(one, try_)}))
        open_ = {}
        only = [where[name] for name in known]
        for (name, (strong, size, try_)), moved in zip(
            known.items(), bench.moved(state, models, fit.FEW, kept="sure", only_of=only), strict=True
        ):
            there = 0.0 if isinstance(moved, str) else along(bench, state, moved.only(where[name])).size
            power = math.log(max(there, _HARDLY) / size) / math.log(try_ / strong)
            out[name] = try_ * (needed[name] / max(there, _HARDLY)) ** (1 / min(max(power, 0.5), 10.0))
            if there < _CLEARLY / 3:  # it grows faster: a trace that chance hides tells no power
                open_[name] = strong, size, math.sqrt(strong * try_)
            elif there > 6 * _CLEARLY:
                open_[name] = try_, there, try_ * _CLEARLY / there
    return out


def _telling(bench: Bench, state: State, moved: Moved) -> tuple[str, ...]:
    """The captures that show most of what a model changes."""
    told = dict.fromkeys(state.made, 0.0)
    for cell, t in bench.template(state, moved).items():
        if cell[0] in told:
            told[cell[0]] += float(t @ t)
    best = sorted(told, key=lambda id: -told[id])
    so_far = np.cumsum([told[id] for id in best])
    return tuple(best[: 1 + int(np.searchsorted(so_far, _MOST_OF * so_far[-1]))])


def _strength(one: Tried, times: float) -> float | None:
    """So many times the strength of a candidate; None beyond where it is looked for."""
    dial = one.change.strengths[0]
    off = dial.off or 0.0
    value = off + (float(one.values[dial.key]) - off) * times
    inside = math.isfinite(value) and (value <= dial.high if dial.off != dial.high else value >= dial.low)
    return value if inside else None
