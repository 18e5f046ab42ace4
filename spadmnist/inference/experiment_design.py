"""Experiment design: the capture that separates what the captures so far cannot."""

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
from .candidates import Candidate
from .capture_replicates import CannotSimulate
from .closed_forms import closed_form, most_detections
from .evaluation import Evaluation, evaluate, square
from .light_levels import level_error
from .models import InTheDark, Model
from .reduction import ReducedCapture
from .replicates import Replicates, simulated
from .results import NONLINEARITY, Step, plain
from .scan import Scan
from .setups import SetupExplanation
from .signature import Sampling, signatures, template_of
from .trial import Trial

# They decide which captures are advised, and how long the advice takes. All are rules of thumb: no measurement that is
# kept chose them.
_RECORDINGS = 16  # replicates of a capture that was not taken yet
_MOST_EVENTS = 6e5  # detections of a longer capture, at most; a brighter one may have twice as many
_LONG = 100.0  # s of a long dark capture
_LONGER = 10.0  # factor on the exposure of a lit capture that is taken again, at most
_LEAST_COUNTS = 0.5  # detections: the least variance of a count, where captures are compared; a rule of thumb
_CALIBRATED = 1e-3  # relative: the error of the ratio of two captures' light levels; a rule of thumb
_MOST_FRAMES = 4.0  # the same for frames, which cost time even where they are empty


def between(scan: Scan, evaluation: Evaluation, found: Candidate, other: Trial) -> list[dict[str, Any]]:
    """The capture that best separates two explanations, with the significance now and then, for the JSON data.

    Args:
        found: the candidate that was found.
        other: the trial that is a tie with it.
    """
    replicates = scan.replicates
    assert other.sensors is not None
    residuals = other.residuals or {}
    here = evaluation.residuals
    both = [cell for cell, z in residuals.items() if cell in here and len(z) == len(here[cell])]
    apart = square({cell: residuals[cell] for cell in both}) - square({cell: here[cell] for cell in both})
    now = math.sqrt(max(apart, 0.0))
    replicates.say("the capture that would separate the two explanations")
    best: tuple[float, str] | None = None
    for words, capture, like in _menu(replicates, evaluation):
        z = expected_significance(replicates, evaluation, other.sensors, capture, like)
        if best is None or z > best[0]:
            best = z, words
    if best is None:
        return []
    return [_advice(best[1], [found.effect, other.candidate.effect], now, math.hypot(now, best[0]))]


def _advice(words: str, separates: Sequence[str], now: float, then: float) -> dict[str, Any]:
    return {
        "capture": words,
        "separates": list(separates),
        "significance_now": plain(now),
        "significance_then": plain(then),
    }


def _menu(replicates: Replicates, evaluation: Evaluation) -> Iterator[tuple[str, Capture, str]]:
    """(words, a capture that any laboratory can take, the capture that it resembles)."""
    rates = {}
    for id, seen in replicates.seen.items():
        if seen.counts is not None and seen.total > 0:
            rates[id] = seen.detections / seen.capture.conditions.exposure
    lit = sorted((id for id in rates if not replicates.seen[id].capture.light.dark), key=lambda id: rates[id])
    dark = [id for id in rates if replicates.seen[id].capture.light.dark]
    for id in dark[:1]:
        yield from _longer(replicates.seen[id].capture, rates[id], "dark", id)
    for id in lit[:1]:
        yield from _longer(replicates.seen[id].capture, rates[id], f"{id}", id)
        yield from _brighter(replicates, id, rates[id], 0.1)
    if lit:
        yield from _longer(replicates.seen[lit[-1]].capture, rates[lit[-1]], f"{lit[-1]}", lit[-1])
        yield from _brighter(replicates, lit[-1], rates[lit[-1]], 4.0)


def _longer(capture: Capture, rate: float, words: str, like: str) -> Iterator[tuple[str, Capture, str]]:
    c = capture.conditions
    most = min(_LONG if capture.light.dark else _LONGER * c.exposure, _MOST_EVENTS / rate)
    if most < 1.5 * c.exposure:
        return
    if capture.modality == "tr":
        yield f"{words}, {units.show(most, 's', 3)}", replace(capture, conditions=replace(c, exposure=most)), like
        return
    frames = int(min(most, _MOST_FRAMES * c.exposure) / c.frame_period)
    if capture.modality == "counts" and c.counting == "frames":  # whole counts
        frames -= frames % c.largest_count
    longer = replace(c, frames=frames, exposure=frames * c.frame_period)
    yield f"{words}, {frames} frames", replace(capture, conditions=longer), like


def _brighter(replicates: Replicates, id: str, rate: float, times: float) -> Iterator[tuple[str, Capture, str]]:
    capture = replicates.seen[id].capture
    level = capture.light.level
    pixels = replicates.start.layout.pixels
    if (
        level is None
        or times * rate / pixels * replicates.dead > 3
        or times * rate * capture.conditions.exposure > 2 * _MOST_EVENTS
    ):
        return
    words = f"{_seen_in(capture)} {'as bright as a tenth of' if times < 1 else f'{times:g} times as bright as'} {id}"
    yield words, replace(capture, light=replace(capture.light, level=level * times)), id


def expected_significance(
    replicates: Replicates, known: Evaluation, other: Model, capture: Capture, like: str
) -> float:
    """The expected significance of another model in a capture that was not taken, standard deviations."""
    new = copy.copy(replicates)
    capture = replace(capture, id=f"{capture.id} again")

    def there(sensors: Model) -> Model:
        typical = (lambda id: sensors.mean_sensor(like)) if sensors.typical else None
        return Model(
            of=lambda id, number: sensors.of(like, number), one=sensors.one, alike=sensors.alike, typical=typical
        )

    first, second = there(known.sensors), there(other)
    stated = twin.photons_at(capture, replicates.start.layout)
    level = 1.0 if capture.light.dark else stated or known.rates[like].level
    sensor = first.of(capture.id, 0)
    sensor = InTheDark.of(sensor) if capture.light.dark else sensor
    number = np.array([10_000], np.uint64)
    made: Recording = next(simulated(sensor, capture, np.array([level]), number, replicates.seed))
    made = made.beside(replicates.dead)
    new.seen = {capture.id: ReducedCapture.of(made)}
    evaluation = evaluate(new, {}, first, _RECORDINGS)
    (signature,) = signatures(new, evaluation, [second], Sampling(hasty=False, kept="sure"))
    if isinstance(signature, CannotSimulate):
        return 0.0
    return math.sqrt(sum(float(t @ t) for t in template_of(new, evaluation, signature).values()))


def between_totals(scan: Scan, evaluation: Evaluation, setup: SetupExplanation, other: Trial) -> list[dict[str, Any]]:
    """The capture that separates a set-up from a change of the sensor with the same totals, by closed forms."""
    replicates = scan.replicates
    now = math.sqrt(abs(setup.cost - other.cost(evaluation)))
    logs = {id: float(x) for factor, x in zip(setup.factors, setup.logs, strict=True) for id in factor.captures}
    best: tuple[float, str] | None = None
    model = next(iter(replicates.seen.values())).capture
    sensor = evaluation.sensors.one
    clock = replace(model.conditions, exposure=_LONG, frames=1, frame_time=_LONG, frame_period=_LONG, bits=0)
    conditions = _dark(clock)
    tries = [("dark, 100 s", Capture("dark", "tr", Light(), conditions), 0.0)]
    for id, seen in replicates.seen.items():
        light = seen.capture.light
        if light.dark or light.level is None:
            continue
        for times in (0.1, 10.0):
            brighter = replace(seen.capture, light=replace(light, level=light.level * times))
            words = f"{_seen_in(brighter)} {'a tenth' if times < 1 else 'ten times'} as bright as {id}"
            tries.append((words, brighter, logs.get(id, 0.0)))
    assert other.sensors is not None
    for words, capture, log in tries:
        level = 1.0 if capture.light.dark else twin.photons_at(capture, replicates.start.layout) or 1.0
        # the sensor as it is in the light of the set-up, and the other one in the stated light
        either = (sensor, level * math.exp(log)), (other.sensors.mean_sensor(model.id), level)
        some, more = sorted(closed_form(InTheDark.of(s) if capture.light.dark else s, capture)(x) for s, x in either)
        most = most_detections(capture, sensor.layout.pixels)
        free = 1.0 - min(more / most, 1.0) if math.isfinite(most) else 1.0  # frames that are full say nothing
        known = capture.light.own_uncertainty**2 + _CALIBRATED**2
        z = (more - some) / math.sqrt(max(more * free, _LEAST_COUNTS) + known * (more * free) ** 2)
        if best is None or z > best[0]:
            best = z, words
    if best is None or best[0] < 1.0:
        return []  # none of them separates the two
    return [_advice(best[1], [setup.factors[0].quantity, other.candidate.effect], now, math.hypot(now, best[0]))]


def on_mimic(step: Step, other: Mimic) -> dict[str, Any]:
    """The capture that separates a finding from its mimic, at least as clearly as it was found."""
    return _advice(other.capture, [step.candidate.effect, other.what], 0.0, step.significance)


def on_brightest(
    replicates: Replicates, evaluation: Evaluation, setup: SetupExplanation, entry: Mapping[str, Any]
) -> dict[str, Any]:
    """The capture that separates a set-up from a nonlinearity.

    At half the light, half of the nonlinearity is left, and nothing of a wrong light level.
    """
    then = 0.5 * abs(float(setup.logs[0])) / level_error(replicates, evaluation, entry["capture"])
    what = _seen_in(replicates.seen[entry["capture"]].capture)
    words = f"{what} half as bright as {entry['capture']}, its light measured anew"
    return _advice(words, [entry["quantity"], NONLINEARITY], 0.0, then)


def _dark(conditions: Conditions) -> Conditions:
    return replace(conditions, wavelength=None, scene=None)


def _seen_in(capture: Capture) -> str:
    """The light of a capture in words: a flat field or a scene."""
    shown = capture.light.scene
    return "a flat field" if shown is None else f"the scene {visible(shown.name)}"


def on_setup(
    replicates: Replicates, evaluation: Evaluation, entries: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """The capture that separates a light level from an exposure: the same light with another exposure."""
    both: dict[str, dict[str, float]] = {}
    for entry in entries:
        if entry["confused"] and entry["capture"] is not None:
            both.setdefault(entry["capture"], {})[entry["quantity"]] = entry["factor"]["value"]
    able = {id: b for id, b in both.items() if {"light", "exposure"} <= b.keys()}
    if not able:
        return []
    id = max(able, key=lambda i: abs(math.log(able[i]["light"])) / level_error(replicates, evaluation, i))
    log = abs(math.log(able[id]["light"]))
    capture = replicates.seen[id].capture
    own = capture.conditions.frame_time if capture.modality != "tr" else capture.conditions.exposure
    others = sorted(
        {s.capture.conditions.frame_time for s in replicates.seen.values() if s.capture.modality != "tr"} - {own}
    )
    other = others[-1] if others and capture.modality != "tr" else 4 * own
    name = "exposure" if capture.modality == "tr" else "frame time"
    words = f"the light of {id} with a different {name} of {units.show(other, 's', 3)}"
    # a light factor stays the same; a wrong exposure has another weight
    then = log * abs(1 - own / other) / level_error(replicates, evaluation, id)
    return [_advice(words, ["light", "exposure"], 0.0, then)]
