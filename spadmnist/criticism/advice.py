"""Advice: which capture would tell what those that were taken cannot."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .. import twin, units
from ..effects import Conditions, Mimic
from ..foreign import visible
from ..recording import Capture, Light, Recording
from . import fit, recordings
from .answer import NONLINEARITY, Step, plain
from .candidates import Change
from .fit import Bench, Seen, Sensors, State, square
from .search import Search
from .setups import Explanation
from .tried import Tried

_RECORDINGS = 16  # of a capture that nobody has taken yet
_MOST_EVENTS = 6e5  # of it
_LONG = 100.0  # s of a long dark capture
_LONGER = 10.0  # times a capture that is taken again, at most
_MOST_FRAMES = 4.0  # the same of frames, which cost whether they hold anything or not


def between(search: Search, state: State, found: Change, other: Tried) -> list[dict[str, Any]]:
    """The capture that tells two explanations apart best, with the significance now and then."""
    bench = search.bench
    assert other.sensors is not None
    residuals = other.residuals or {}
    now = math.sqrt(max(square(residuals) - square(state.residuals), 0.0))
    bench.say("which capture would tell")
    best: tuple[float, str] | None = None
    for words, capture, like in _menu(bench, state):
        z = _apart(bench, state, other.sensors, capture, like)
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
    words = f"{_seen_in(capture)} {'as bright as a tenth of' if times < 1 else f'{times:g} times as bright as'} {id}"
    yield words, replace(capture, light=replace(capture.light, level=level * times)), id


def _apart(bench: Bench, known: State, other: Sensors, capture: Capture, like: str) -> float:
    """Standard deviations by which another model differs from a known one in a capture that was not taken."""
    new = copy.copy(bench)
    capture = replace(capture, id=f"{capture.id} again")

    def there(sensors: Sensors) -> Sensors:
        typical = (lambda id: sensors.usual(like)) if sensors.typical else None
        return Sensors(lambda id, number: sensors.of(like, number), sensors.one, sensors.alike, typical)

    first, second = there(known.sensors), there(other)
    stated = twin.photons_at(capture, bench.start.layout)
    level = 1.0 if capture.light.dark else stated or known.rates[like].level
    sensor = first.of(capture.id, 0)
    sensor = recordings.InTheDark.of(sensor) if capture.light.dark else sensor
    number = np.array([10_000], np.uint64)
    made: Recording = next(recordings.simulated(sensor, capture, np.array([level]), number, bench.seed))
    made = made.beside(bench.dead)
    new.seen = {capture.id: Seen.of(made)}
    state = new.state({}, first, _RECORDINGS)
    (moved,) = new.moved(state, [second], fit.FEW, hasty=False, kept="sure")
    if isinstance(moved, str):
        return 0.0
    return math.sqrt(sum(float(t @ t) for t in new.template(state, moved).values()))


def between_totals(search: Search, state: State, setup: Explanation, other: Tried) -> list[dict[str, Any]]:
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
            words = f"{_seen_in(brighter)} {'a tenth' if times < 1 else 'ten times'} as bright as {id}"
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


def on_mimic(step: Step, other: Mimic) -> dict[str, Any]:
    """What tells a finding from what looks the same in all that was measured: at least as clearly as it was found."""
    return _told(other.capture, [step.change.effect, other.what], 0.0, step.significance)


def on_brightest(bench: Bench, state: State, setup: Explanation, entry: Mapping[str, Any]) -> dict[str, Any]:
    """What tells a set-up from a nonlinearity: with half of the light, half is left, of a mistake nothing."""
    then = 0.5 * abs(float(setup.logs[0])) / bench.level_error(state, entry["capture"])
    what = _seen_in(bench.seen[entry["capture"]].capture)
    words = f"{what} half as bright as {entry['capture']}, its light measured anew"
    return _told(words, [entry["quantity"], NONLINEARITY], 0.0, then)


def _dark(conditions: Conditions) -> Conditions:
    return replace(conditions, wavelength=None, scene=None)


def _seen_in(capture: Capture) -> str:
    """What a capture's light falls from, in words."""
    shown = capture.light.scene
    return "a flat field" if shown is None else f"the scene {visible(shown.name)}"


def on_setup(bench: Bench, state: State, entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
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
    words = f"the light of {id} with a different {name} of {units.show(other, 's', 3)}"
    # a light level is the same then; so much too long an exposure counts for less or for more
    then = log * abs(1 - own / other) / bench.level_error(state, id)
    return [_told(words, ["light", "exposure"], 0.0, then)]
