"""Maps of the dark, by how many detections each pixel has: the closed forms of the effects, and no simulation.

Where captures without light tell a map of a dark rate, and nothing couples the pixels, each pixel's counts are all that
there is to know of it. The map is the one that a simulation would be begun with (`mapping`); its misfit is that of the
counts alone, of one half of the blocks of time by a map of the other half.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from .. import twin
from ..effects import Effect
from ..measurement import Measurement
from ..sensor import Sensor
from . import mapping, recordings
from .answer import Diagnosis, Step, title
from .candidates import Change, with_values
from .chance import LEAST_P
from .course import map_values
from .fit import Bench

_SURE = 1e-3  # p-value of a misfit, below which it is one
_WIDER = 1.1  # times, by which afterpulses and what a map leaves open may widen the misfit
_LIT = 0.02  # share of what is known of a map, that lit captures may add and that is done without


def may_settle(sensor: Sensor, wanted: Sequence[Change]) -> bool:
    """Is it one map of a rate in the dark, of a sensor whose pixels have nothing to do with each other's counts?"""
    change = wanted[0]
    if len(wanted) > 1 or not change.carrier or change.per != "pixel" or not mapping.by_counts(change):
        return False
    return Effect.registry.find(change.effect).stage == "dark" and not any(
        map(_couples, (sensor.chip or sensor).effects)
    )


def _couples(effect: Effect) -> bool:
    """Do counts in the dark say more, or less, than a pixel's own rate: does it reach others, or come and go?"""
    return effect.influence() > 0 or (effect.stage == "arrival" and effect.acts_on != "light")


def settled(bench: Bench, measurement: Measurement, change: Change) -> Diagnosis | str:
    """The answer, or what there is beside the counts in the dark that settles the map, too.

    bench: its captures need no summaries.
    """
    assert change.carrier is not None
    dark = [id for id, seen in bench.seen.items() if seen.capture.light.dark and seen.counts is not None]
    if not dark:
        return "no dark capture with data"
    levels = {id: 1.0 if id in bench.dark else _level(bench, id) for id in bench.seen}
    map_ = mapping.settle_maps(bench, {}, [change], levels, dark)[change.carrier]
    told = mapping.information(bench, {change.carrier: map_.values()}, change, levels)
    whole = np.maximum(np.sum(list(told.values()), axis=0), 1e-12)
    if float(np.mean(np.sum([told[id] for id in dark], axis=0) / whole)) < 1 - _LIT:
        return "light in which it shows, too"
    return _answer(bench, measurement, change, map_, dark)


def _level(bench: Bench, id: str) -> float:
    """Photons/s of a lit capture: as it is stated, or as many as its detections ask for."""
    seen = bench.seen[id]
    stated = twin.photons_at(seen.capture, bench.start.layout)
    if stated is not None:
        return stated
    return recordings.level_for(recordings.closed_form(bench.start, seen.capture), seen.total, None)


@dataclass(frozen=True)
class _Judged:
    """How far the counts of captures are from what a model expects: misfit, and in relative terms."""

    misfit: float
    mean_rate: float
    map: float

    def row(self, model: str) -> dict[str, Any]:
        errors = {"mean_rate": self.mean_rate, "map": self.map}
        return {"model": model, "misfit": self.misfit, "errors": errors, "placebo": False}


def _judge(bench: Bench, ids: Sequence[str], sensor: Sensor, errors: np.ndarray | float = 0.0) -> _Judged:
    """Of dark captures. errors: (pixels,) relative, of the rates that the sensor has."""
    squares, totals, excess = [], [], []
    for id in ids:
        line = mapping.Line(bench, id, 1.0)
        expected, counts = line.expected(sensor), line.seen.counts
        assert counts is not None
        variance = line.variance(np.maximum(expected, 0.5), bench.dead)
        apart = counts - expected
        squares.append(apart**2 / (variance + (errors * expected) ** 2))
        totals.append(abs(math.log(max(float(counts.sum()), 0.5) / float(expected.sum()))))
        excess.append(math.sqrt(max(float(np.mean(apart**2 - variance)), 0.0)) / max(float(expected.mean()), 1e-12))
    return _Judged(float(np.mean(squares)), float(np.mean(totals)), float(np.mean(excess)))


def _answer(
    bench: Bench,
    measurement: Measurement,
    change: Change,
    map_: mapping.Map,
    dark: Sequence[str],
) -> Diagnosis:
    assert change.carrier is not None
    start = _judge(bench, dark, bench.start)
    halves = bench.halves(dark)
    if halves.seen:  # of each capture the second half by the first
        first = [id for k, id in enumerate(halves.seen) if k % 2 == 0]
        part = mapping.settle_maps(halves, {}, [change], dict.fromkeys(halves.seen, 1.0), first)[change.carrier]
        others = [id for id in halves.seen if id not in first]
        found = _judge(halves, others, with_values(bench.start, {change.carrier: part.values()}), part.error)
    else:
        found = _judge(bench, dark, with_values(bench.start, {change.carrier: map_.values()}), map_.error)
    free = bench.start.layout.pixels * len(dark)
    usual = float(stats.chi2.ppf(0.95, free) / free)
    likely = float(stats.chi2.ppf(1 - _SURE, free) / free)
    rest: list[dict[str, Any]] = []
    if found.misfit > _WIDER * likely:  # rates that are others in another block of time
        clear = _clear(found.misfit / _WIDER, free)
        where = "pixels of one half of the blocks of time, by a map of the other"
        rest.append({"statistic": "pixel_map", "capture": dark[0], "significance": clear, "where": where})
    right = "explained" if start.misfit > likely else "adequate"
    mean = float(np.mean(map_.values())) / max(float(np.mean(_listed(bench.start, change))), 1e-300)
    told = {name: replace(value, method="counts") for name, value in map_values(map_).items()}
    step = Step(change, told, found.misfit, _clear(start.misfit, free), f"mean of the map {mean - 1:+.2%}")
    return Diagnosis(
        bench.start.name,
        measurement.name,
        "partly_explained" if rest else right,
        start.misfit,
        found.misfit,
        usual,
        [],
        [step],
        [],
        rest,
        [start.row("start"), found.row(f"+ {title(change)}")],
        [],
        [],
        [],
        values={change.carrier: map_.values()},
        dark=bench.dark,
        crop=str(bench.start.window) if bench.start.window else None,
    )


def _clear(misfit: float, free: int) -> float:
    """Significance of a mean of squares, in standard deviations."""
    return float(stats.norm.isf(max(float(stats.chi2.sf(misfit * free, free)), LEAST_P) / 2))


def _listed(sensor: Sensor, change: Change) -> np.ndarray:
    assert change.carrier is not None
    effect = sensor.effect(change.carrier[0])
    return np.asarray(getattr(effect, change.carrier[1], 0.0), float)
