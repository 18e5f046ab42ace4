"""Set-up: could the laboratory, not the sensor, be what is other than stated?

Only the totals of the captures tell: a light level beyond its uncertainty, a wavelength or an exposure that is not the
one noted down, a leak in a dark capture. The simplest that explains them is taken; a change of the sensor that would
explain them as simply is a rival.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from .. import twin
from .answer import plain
from .candidates import templates
from .compare import FALSE_ALARM
from .fit import RATES, Bench, Moved, State, square
from .search import Search
from .tried import EACH, Tried

ALIKE = 6.0  # explanations so near each other cannot be told apart
_VERIFIED = 3  # rivals that are simulated
_MOST = 300.0  # of a logarithm: beyond any light
_SILENT = 20.0  # detections that are missing at the end of a capture that stopped early


@dataclass(frozen=True)
class Factor:
    """Something of the set-up that acts on the levels of some captures. ratio: of the value to what is stated."""

    quantity: str
    captures: tuple[str, ...]
    whole: bool  # all lit captures, one after the other, are one statement


@dataclass(frozen=True)
class Explanation:
    """Factors that explain the totals: logs of their values, standard deviations, and what they leave."""

    factors: tuple[Factor, ...]
    logs: np.ndarray
    errors: np.ndarray
    left: np.ndarray

    @property
    def p(self) -> float:
        """Of what is left."""
        freedom = len(self.left) - len(self.factors)
        return float(stats.chi2.sf(float(self.left @ self.left), freedom)) if freedom > 0 else 1.0

    @property
    def cost(self) -> float:
        """What is left, and what the factors cost."""
        return float(self.left @ self.left) + EACH * len(self.factors)

    @property
    def explains(self) -> bool:
        return self.p > FALSE_ALARM and bool(np.all(np.abs(self.left) < 4))


def explanations(bench: Bench, state: State) -> list[Explanation]:
    """Every way in which the set-up alone explains the totals, the simplest first."""
    ids, _, root, _ = bench.rate_space(state)
    if not ids:
        return []
    z = state.residuals[RATES]
    captures = {i: bench.seen[i].capture for i in ids}
    lit = [i for i in ids if not captures[i].light.dark]
    single = [Factor("dark" if captures[i].light.dark else "light", (i,), False) for i in ids]
    shared = [Factor("light", tuple(lit), True)] if len(lit) > 1 else []
    waves = sorted({captures[i].light.wavelength or 0.0 for i in lit})
    for wave in waves if len(waves) > 1 else []:
        shared.append(Factor("light", tuple(i for i in lit if captures[i].light.wavelength == wave), True))
    clocks = sorted({captures[i].conditions.frame_time for i in ids if captures[i].modality != "tr"})
    for clock in clocks if len(clocks) > 1 else []:
        shared.append(Factor("exposure", tuple(i for i in ids if captures[i].conditions.frame_time == clock), True))
    shared = [factor for factor in shared if len(factor.captures) > 1]
    tries: list[tuple[Factor, ...]] = [(one,) for one in [*shared, *single]]
    tries += [pair for pair in itertools.combinations([*shared, *single], 2) if not _overlap(pair)]
    if lit:  # whatever the light was in each of them
        tries.append(tuple(f for f in single if f.quantity == "light"))
    found = []
    for factors in dict.fromkeys(tries):
        columns = np.array([[float(i in f.captures) for f in factors] for i in ids])
        design = root @ columns
        if np.linalg.matrix_rank(design) < len(factors):
            continue
        covariance = np.linalg.inv(design.T @ design)
        logs = covariance @ design.T @ z
        found.append(Explanation(factors, logs, np.sqrt(np.diag(covariance)), z - design @ logs))
    return sorted((e for e in found if e.explains), key=lambda e: e.cost)


def _overlap(pair: Sequence[Factor]) -> bool:
    a, b = (set(f.captures) for f in pair)
    return a <= b or b <= a


def brightest(bench: Bench, one: Explanation) -> str | None:
    """The capture that it is all about, if that is the brightest of several; else None.

    What a sensor does at the highest rates alone looks the same: a nonlinearity that no effect here has.
    """
    named = {id for factor in one.factors for id in factor.captures}
    rates = {}
    for id, seen in bench.seen.items():
        c = seen.capture.conditions
        if not seen.capture.light.dark:  # frames may have gaps between them
            rates[id] = seen.total / (c.exposure if seen.capture.modality == "tr" else c.frames * c.frame_time)
    most = max(rates, key=lambda id: rates[id], default=None)
    return most if named == {most} and len(rates) > 2 else None


def entries(bench: Bench, state: State, likely: Sequence[Explanation]) -> list[dict[str, Any]]:
    """As `formats` has them; what cannot be told apart is marked."""
    out: list[dict[str, Any]] = []
    seen: set[tuple[str | None, str]] = set()
    for number, one in enumerate(likely):
        for factor, log, error in zip(one.factors, one.logs, one.errors, strict=True):
            value, low, high = (plain(math.exp(min(log + k * error, _MOST))) for k in (0.0, -1.96, 1.96))
            for id in factor.captures:
                names = _names(bench, state, factor, id, float(log), float(error))
                for name in names:
                    if (id, name) in seen:
                        continue
                    seen.add((id, name))
                    told = {"value": value, "low": low, "high": high}
                    confused = len(likely) > 1 or len(names) > 1
                    out.append({"capture": id, "quantity": name, "factor": told, "confused": confused})
        if number == 0 and one.cost < likely[-1].cost - ALIKE:
            break
    return out


def _names(bench: Bench, state: State, factor: Factor, id: str, log: float, error: float) -> list[str]:
    """What a factor on a capture's level may be: another wavelength where one fits; a light level or an exposure."""
    capture = bench.seen[id].capture
    if factor.quantity != "light" or (factor.whole and len(factor.captures) > 1):
        return [factor.quantity]
    own = twin.photons_at(capture, state.sensors.one.layout)
    for wave in sorted({s.capture.light.wavelength or 0.0 for s in bench.seen.values()} - {0.0}):
        if wave == capture.light.wavelength or not own:
            continue
        other = replace(capture, light=replace(capture.light, wavelength=wave))
        there = twin.photons_at(other, state.sensors.one.layout)
        if not there:
            continue
        sensor = state.sensors.one
        ratio = there * sensor.nominal_pdp(wave) / (own * sensor.nominal_pdp(capture.light.wavelength))
        if abs(math.log(ratio) - log) < 3 * math.hypot(error, 0.01 + capture.light.relative_uncertainty):
            return ["wavelength"]
    return ["light", "exposure"]


def rivals(search: Search, state: State, cost: float) -> list[Tried]:
    """Changes of the sensor that explain the totals as simply, by the effects' closed forms."""
    bench = search.bench
    out: list[Tried] = []
    freedom = len(state.residuals[RATES])
    for change in bench.changes(state.sensors.one):
        if not change.strengths or change.phases or change.carrier:
            continue
        # from each of its places: from the nearest by proportion it may not lead to where it fits
        best: tuple[float, Tried] | None = None
        for tried in templates(change):
            with search.if_possible(change, "explaining the totals", wholly=False):
                sensors = state.sensors.changed(tried)
                one = Tried(change, tried, bench.told(state, sensors), 0.0, 1.0, sensors)
                one.gain, one.times = search.line_search(state, one.moved, one.signed)
                if one.gain < EACH:
                    continue
                one = _settled(search, state, one)
                left = one.residuals[RATES] if one.residuals else state.residuals[RATES]
                if best is None or float(left @ left) < best[0]:
                    best = float(left @ left), one
        if best is None:
            continue
        remains, settled = best
        if remains + EACH < cost + ALIKE and stats.chi2.sf(remains, max(1, freedom - 1)) > FALSE_ALARM:
            settled.gain = square(state.residuals) - remains
            out.append(settled)
    out = sorted(out, key=lambda t: t.cost(state))[:_VERIFIED]
    models = [t.sensors for t in out if t.sensors is not None]
    return [t for t, moved in zip(out, bench.moved(state, models), strict=True) if _fits(search, state, t, moved)]


def _fits(search: Search, state: State, one: Tried, moved: Moved | str) -> bool:
    """Do the other statistics bear with what explains the totals?"""
    if isinstance(moved, str):
        return False
    residuals = search.bench.residuals(state, moved)
    others = {c: z for c, z in residuals.items() if c != RATES}
    before = {c: z for c, z in state.residuals.items() if c != RATES}
    return square(others) - square(before) < EACH + ALIKE


def _settled(search: Search, state: State, one: Tried) -> Tried:
    """The strength settled by closed forms alone: the totals ask for no simulation."""
    dial, bench = one.change.strengths[0], search.bench
    given = one.scaled()

    def at(x: float) -> tuple[Moved, np.ndarray]:
        moved = bench.told(state, state.sensors.changed({**given, dial.key: x}))
        return moved, bench.residuals(state, moved)[RATES]

    u = dial.coordinate(float(given[dial.key]))
    ends = dial.ends
    span = 0.05 if dial.log else 0.01 * (dial.high - dial.low)
    covariance = 1.0
    for _ in range(8):
        moved, z = at(dial.value(u))
        h = span if u + span <= ends[1] else -span
        slope = (at(dial.value(u + h))[1] - z) / h
        power = float(slope @ slope)
        if power <= 0:
            return one
        covariance = 1 / power
        step = float(np.clip(-float(slope @ z) / power, -1.0, 1.0))
        u = min(max(u + step, ends[0]), ends[1])
        if abs(step) < 1e-4:
            break
    moved, z = at(dial.value(u))
    given[dial.key] = dial.value(u)
    half = 1.96 * math.sqrt(covariance)
    residuals = {**state.residuals, RATES: z}
    return Tried(
        one.change,
        given,
        moved,
        one.gain,
        1.0,
        state.sensors.changed(given),
        residuals=residuals,
        intervals={dial.key: dial.interval(u - half, u + half)},
    )


def stopped_early(bench: Bench) -> dict[str, tuple[float, float]]:
    """Captures whose last detection is too long before their end: (share that was exposed, its standard deviation)."""
    out = {}
    for id, seen in bench.seen.items():
        if seen.last is None or seen.total < 2:
            continue
        share = seen.last * (1 + 1 / seen.total) / seen.capture.conditions.exposure
        if seen.total * (1 - share) / max(share, 1e-9) > _SILENT:
            out[id] = share, share / seen.total
    return out
