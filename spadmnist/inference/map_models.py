"""Models with maps: captures that inform a map, maps that are needed, each capture under maps made without it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import SpadError
from ..sensor import Sensor
from ..statistics import informant
from . import statistic_maps
from .candidates import Candidate, with_values
from .coordinates import Key, Values
from .count_model import CountModel
from .map_fits import base_of, bounds_of, fit_maps
from .models import Model
from .pixel_maps import ALONE, PixelMap, groups_of, spread_p
from .replicates import Replicates

# p-value of a map that is needed in addition to others: the least needed one is left out above it; a rule of thumb
_NEEDED = 1e-4


def information(
    replicates: Replicates, values: Values, candidate: Candidate, levels: dict[str, float]
) -> dict[str, np.ndarray]:
    """The information of each capture on a map: squared derivatives over variances, (pixels,) or (1,), by capture.

    Args:
        values: the values of the model, SI.
        levels: light level by capture.
    """
    if candidate.per == "code":
        return {
            id: np.array([seen.total * (informant("codes") in seen.summaries)]) for id, seen in replicates.seen.items()
        }
    pixels = replicates.start.layout.pixels
    assert candidate.carrier is not None
    if candidate.informed_by:
        start = with_values(replicates.start, {k: v for k, v in values.items() if k != candidate.carrier})
        bounds = bounds_of(candidate.carrier)
        return statistic_maps.information(replicates, values, candidate, base_of(start, candidate), bounds)
    if candidate.blinds:
        base = base_of(
            with_values(replicates.start, {k: v for k, v in values.items() if k != candidate.carrier}), candidate
        )
        shortest = {id: seen.shortest for id, seen in replicates.seen.items()}
        return {
            id: np.zeros(pixels) if s is None else np.where(s.informs(base), base * s.density, 0.0) ** 2
            for id, s in shortest.items()
        }
    effect = with_values(replicates.start, values).effect(candidate.carrier[0])
    if effect is None:
        now = np.full(int(groups_of(replicates.start, candidate.per).max()) + 1, base_of(replicates.start, candidate))
    else:
        now = np.asarray(getattr(effect, candidate.carrier[1]), np.float64)
        if candidate.per == "pixel":
            now = np.broadcast_to(now, (pixels,))
    start = with_values(replicates.start, {**values, candidate.carrier: now})
    other = with_values(replicates.start, {**values, candidate.carrier: now * 1.02})
    out = {}
    for id, seen in replicates.seen.items():
        if seen.counts is None:
            out[id] = np.zeros(pixels)
            continue
        line = CountModel(replicates, id, levels[id])
        slope = (line.alone(other) - line.alone(start)) / 0.02
        out[id] = slope**2 / line.variance(np.maximum(line.expected(start), 0.5), replicates.dead)
    return out


def captures_needed(
    replicates: Replicates, values: Values, wanted: Sequence[Candidate], levels: dict[str, float]
) -> set[str]:
    """The captures without which one of the maps is hardly informed.

    Args:
        wanted: candidates with a carrier.
        levels: light level by capture.
    """
    needed = [information(replicates, values, candidate, levels) for candidate in wanted]
    shares = [
        {id: one / np.maximum(sum(by_capture.values()), 1e-12) for id, one in by_capture.items()}
        for by_capture in needed
    ]
    return {id for id in replicates.seen if any(float(np.mean(share[id])) > ALONE for share in shares)}


def models_with_maps(
    replicates: Replicates, values: Values, wanted: Sequence[Candidate], levels: dict[str, float], left_out: bool = True
) -> tuple[Model, dict[Key, PixelMap], dict[Key, Any]]:
    """(model with maps, the maps fitted to all captures, the values with these maps).

    The model of each capture has maps that are fitted without it; where it alone informs a parameter, it is used all
    the same. Every replicate has a draw of the posterior of the maps.

    Args:
        wanted: candidates with a carrier.
        levels: light level by capture.
        left_out: the maps of each capture are fitted without it; otherwise all captures have the same maps.
    """
    whole = fit_maps(replicates, values, wanted, levels)
    final = {**values, **{key: m.values() for key, m in whole.items()}}
    needed = captures_needed(replicates, final, wanted, levels)
    maps: dict[str, dict[Key, PixelMap]] = {}
    for id, seen in replicates.seen.items():
        if seen.counts is None or id in needed or not left_out or len(replicates.seen) < 2:
            maps[id] = whole
        else:
            others = [i for i in replicates.seen if i != id]
            try:
                maps[id] = fit_maps(replicates, values, wanted, levels, others)
            except SpadError:  # the other captures do not inform one of the maps
                maps[id] = whole

    def of(id: str, number: int) -> Sensor:
        rng = np.random.Generator(np.random.Philox(key=[replicates.seed + 7, number]))
        drawn = {}
        for key, m in maps[id].items():
            drawn[key] = m.values(rng.standard_normal(len(m.estimate)), float(rng.standard_normal()))
        return with_values(replicates.start, {**values, **drawn})

    def typical(id: str) -> Sensor:
        return with_values(replicates.start, {**values, **{key: m.values() for key, m in maps[id].items()}})

    return Model(of, with_values(replicates.start, final), alike=False, typical=typical), whole, final


def maps_needed(
    replicates: Replicates,
    values: Values,
    held: Sequence[Candidate],
    wanted: Sequence[Candidate],
    levels: dict[str, float],
) -> list[Candidate]:
    """The maps whose pixels differ beyond their noise when all are fitted together, by p-value.

    Args:
        held: maps that the model has already.
        wanted: maps to test.
        levels: light level by capture.
    """
    kept = list(wanted)
    while kept:
        found = fit_maps(replicates, values, [*held, *kept], levels)
        clear = {c: spread_p(found[c.carrier]) for c in kept}  # type: ignore[index]
        least = max(kept, key=lambda c: clear[c])
        if clear[least] < _NEEDED:
            return sorted(kept, key=lambda c: clear[c])
        kept.remove(least)
    return []
