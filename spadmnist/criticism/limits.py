"""Limits: how much of what was not found would have been seen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from . import fit
from .answer import plain
from .chance import Likeness, along
from .fit import Bench, Moved, State
from .search import Search
from .showing import captures_showing
from .tried import Tried, shape_of

_ONE_SIDED = 1.645  # 95 %
_CLEARLY, _HARDLY = 15.0, 0.5  # standard deviations of a trace that chance does not hide, and of one that it does
_UNSEEN = 0.1  # of the square of a trace: how it grows, the rest tells
_SATURATED = 1000.0  # of a trace that hardly grows any more
_LOOKS = 5  # at other strengths, until that is found


def upper_limits(
    search: Search, state: State, tried: Sequence[Tried]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], list[dict[str, Any]]]:
    """(effects with the largest strength that may be there unseen, 95 %; effects that cannot be seen here; the others).

    The others have directions or phases, and no limit is given for them.

    tried: every candidate as it was looked at in all captures. The weakest limit of its shapes: whatever the shape,
    more would have been seen. How the trace of each grows with its strength is simulated once more.
    """
    bench = search.bench
    shapes: dict[str, dict[tuple[Any, ...], _Shape]] = {}
    for one in tried:
        change = one.change
        if change.kind != "add" or len(change.strengths) != 1 or change.phases:
            continue
        trace = along(bench, state, one.moved)
        times = _seen_at(trace)
        for _ in range(_LOOKS if one.moved.even is not None and math.isfinite(times) else 0):
            # where its square is as small as it is; by the root, for with the square alone it would go to and fro
            times *= math.sqrt(_seen_at(along(bench, state, one.moved.at(times))))
        known = shapes.setdefault(change.effect, {})
        if shape_of(one) not in known or known[shape_of(one)][1] < trace.size:  # of several strengths the clearest
            known[shape_of(one)] = times, trace.size, one
    # a template that saturates does not tell which shape is the weakest
    asked = {
        (name, n): shape
        for name, all_ in shapes.items()
        for n, shape in enumerate(all_.values())
        if shape is max(all_.values(), key=lambda s: s[0]) or min(s[1] for s in all_.values()) > _SATURATED
    }
    times_of = _at_limit(search, state, asked)
    excluded, hidden = [], []
    for name in shapes:
        limits = [_strength(shape[2], times_of[key]) for key, shape in asked.items() if key[0] == name]
        dial = next(iter(shapes[name].values()))[2].change.strengths[0]
        if None in limits:
            hidden.append(name)
        else:
            far = max((x for x in limits if x is not None), key=lambda x: abs(x - (dial.off or 0.0)))
            excluded.append({"effect": name, "parameter": dial.parameter, "upper_limit_95": plain(far)})
    looked = {one.change.effect for one in tried}  # what cannot be tried is told where it fails
    every = search.bench.changes(state.sensors.one)
    others = {one.effect for one in every if one.kind == "add"} & looked - shapes.keys()
    return excluded, [{"effect": name} for name in sorted(hidden)], [{"effect": name} for name in sorted(others)]


def _seen_at(trace: Likeness) -> float:
    """Times the strength of a trace at which it would be seen if it grew in proportion."""
    return (max(trace.data, 0.0) + _ONE_SIDED) / trace.size if trace.size > 0 else math.inf


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
    where: dict[tuple[str, int], list[str]] = {}
    for name, (times, size, one) in weakest.items():
        out[name] = times
        if size > 2 * _CLEARLY:
            where[name] = captures_showing(bench.template(state, one.moved), _UNSEEN)
            seen = along(bench, state, one.moved.only(where[name])).size
            here = one.moved if one.moved.even is None else one.moved.at(times)
            needed[name] = along(bench, state, here.only(where[name])).size * (times if one.moved.even is None else 1.0)
            open_[name] = 1.0, seen, _CLEARLY / seen
    for _ in range(_LOOKS):
        known = {name: entry for name, entry in open_.items() if _strength(weakest[name][2], entry[2]) is not None}
        if not known:
            break
        asked = [(weakest[name][2], try_, where[name]) for name, (_, _, try_) in known.items()]
        open_ = {}
        for (name, (strong, size, try_)), moved in zip(known.items(), _as_strong(bench, state, asked), strict=True):
            there = 0.0 if moved is None else along(bench, state, moved).size
            power = math.log(max(there, _HARDLY) / size) / math.log(try_ / strong)
            out[name] = try_ * (needed[name] / max(there, _HARDLY)) ** (1 / min(max(power, 0.5), 10.0))
            if there < _CLEARLY / 3:  # it grows faster: a trace that chance hides tells no power
                open_[name] = strong, size, math.sqrt(strong * try_)
            elif there > 6 * _CLEARLY:
                open_[name] = try_, there, try_ * _CLEARLY / there
    return out


def _as_strong(bench: Bench, state: State, asked: Sequence[tuple[Tried, float, Sequence[str]]]) -> list[Moved | None]:
    """What each does at so many times its strength, in some captures: with both signs, if it may have either."""
    models, only, signs = [], [], []
    for one, times, ids in asked:
        dial = one.change.strengths[0]
        strong = _strength(one, times)
        assert strong is not None  # as it is asked for
        strengths = [strong]
        if one.moved.even is not None and dial.low <= -strong <= dial.high:  # what has either sign vanishes at 0
            strengths.append(-strong)
        signs.append(len(strengths))
        for value in strengths:
            models.append(state.sensors.changed({**one.values, dial.key: value}))
            only.append(ids)
    made = iter(bench.moved(state, models, fit.FEW, kept="sure", only_of=only))
    out: list[Moved | None] = []
    for (_, _, ids), number in zip(asked, signs, strict=True):
        up, down = next(made), next(made) if number == 2 else None
        if isinstance(up, str) or isinstance(down, str):
            out.append(None)
        else:
            out.append((up if down is None else bench.both(state, up, down, fit.FEW)).only(ids))
    return out


def _strength(one: Tried, times: float) -> float | None:
    """So many times the strength of a candidate; None beyond where it is looked for."""
    dial = one.change.strengths[0]
    off = dial.off or 0.0
    value = off + (float(one.values[dial.key]) - off) * times
    inside = math.isfinite(value) and (value <= dial.high if dial.off != dial.high else value >= dial.low)
    return value if inside else None
