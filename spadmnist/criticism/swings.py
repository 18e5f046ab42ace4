"""Swings: what begins anew in every capture, at any phase and any strength, told by a few phases all round."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .candidates import Key
from .fit import RATES, Bench, Cell, Moved, State

# times the strength of what was simulated: at first, and about the best of these
TIMES = (0.03, 0.1, 0.3, 0.6, 1.0, 1.7, 3.0, 6.0, 10.0)
NEAR = (0.7, 0.85, 1.0, 1.2, 1.4)
_NEARER = (0.92, 0.96, 1.04, 1.08)
_PHASES = 24  # that are looked at
_FINELY = 360  # a whole turn, for the other phase that has the same total
_TURNS = 8  # of them, that are simulated
_MANY = 16  # recordings that tell whether it rises or falls
_SIDES = 9.0  # in chi square: what it must gain in a capture by falling where it rose
_CLOSER = np.linspace(-0.5, 0.5, 9)  # of the step from one to the next


@dataclass(frozen=True)
class Swing:
    """What something that swings does, to second order in its strength x, at the phase p.

    Of each cell (5, cells) and of each capture's light (5,) the amplitudes of what it does:
    x (a cos p + b sin p) + x^2 (c + d cos 2p + e sin 2p).
    """

    shifts: dict[Cell, np.ndarray]
    noise: dict[Cell, float]
    logs: dict[str, np.ndarray]

    @staticmethod
    def of(turned: Sequence[Moved], phases: Sequence[float]) -> Swing:
        """From what it does at the strength 1 and at some phases, evenly all round."""
        solve = np.linalg.pinv(np.stack([_waves(1.0, p) for p in phases]))
        shifts = {}
        for cell in set().union(*(m.shifts for m in turned)):
            size = next(len(m.shifts[cell]) for m in turned if cell in m.shifts)
            shifts[cell] = solve @ np.stack([m.shifts.get(cell, np.zeros(size)) for m in turned])
        noise = {cell: float(np.mean([m.noise.get(cell, 0.0) for m in turned])) / len(turned) for cell in shifts}
        logs = {id: solve @ np.array([m.logs.get(id, 0.0) for m in turned]) for id in turned[0].logs}
        return Swing(shifts, noise, logs)

    def at(self, phases: Mapping[str, float]) -> Moved:
        """What it does with a phase in each capture: what changes its sign with the strength, and what does not."""
        odd, even = Moved({}, dict(self.noise), {}), Moved({}, {}, {})
        for cell, x in self.shifts.items():
            waves = _waves(1.0, phases[cell[0]])
            odd.shifts[cell], even.shifts[cell] = waves[:2] @ x[:2], waves[2:] @ x[2:]
        for id, log in self.logs.items():
            waves = _waves(1.0, phases[id])
            odd.logs[id], even.logs[id] = float(waves[:2] @ log[:2]), float(waves[2:] @ log[2:])
        return Moved(odd.shifts, odd.noise, odd.logs, even=even)

    def mirrored(self, id: str, phase: float, times: float) -> float:
        """The other phase at which a capture has as many detections: it falls where it rose. The same, if none."""
        every = 2 * math.pi * np.arange(_FINELY + 1) / _FINELY + phase
        more = np.array([_waves(times, p) @ self.logs[id] for p in every])
        crossed = np.flatnonzero(np.diff(np.sign(more - more[0])[1:-1])) + 1
        return float(every[crossed[0]]) % (2 * math.pi) if len(crossed) else phase

    def suited(
        self, bench: Bench, state: State, times: Sequence[float] = TIMES
    ) -> tuple[float, float, dict[str, float]]:
        """(gain in chi square, strength, phase of each capture) that bring the data nearest."""
        every = 2 * math.pi * np.arange(_PHASES) / _PHASES
        around = dict.fromkeys(bench.seen, every)
        best = _best(self, bench, state, times, around)
        for closer in (NEAR, _NEARER) if len(times) > 1 else ():
            best = max(best, _best(self, bench, state, [best[1] * x for x in closer], around), key=lambda b: b[0])
        step = 2 * math.pi / _PHASES
        return _best(self, bench, state, [best[1]], {id: p + step * _CLOSER for id, p in best[2].items()})


def turned(bench: Bench, state: State, keys: Sequence[Key], values: Mapping[Key, Any], few: int) -> Swing | str:
    """What swings, at these values and any phase. keys: parameters that are phases; few: recordings of each capture."""
    turns = [2 * math.pi * k / _TURNS for k in range(_TURNS)]
    pairs = [(id, key) for id in bench.seen for key in keys]
    models = [state.sensors.changed(values, dict.fromkeys(pairs, turn)) for turn in turns]
    found = bench.moved(state, models, few, _lit(bench))
    made = [m for m in found if not isinstance(m, str)]
    if len(made) < len(found):
        return next(m for m in found if isinstance(m, str))
    return Swing.of(made, turns)


def sided(
    bench: Bench,
    state: State,
    keys: Sequence[Key],
    values: Mapping[Key, Any],
    phases: Mapping[str, float],
    mirrored: Mapping[str, float],
) -> dict[str, float]:
    """The phase of each capture, or the other one with the same total, where it suits the rest of the capture better.

    A capture far shorter than a swing has one side of it alone: too faint a slope for the few recordings of `turned`.
    keys, values: as there; mirrored: see `Swing.mirrored`.
    """
    pairs = [{(id, key): p for id, p in some.items() for key in keys} for some in (phases, mirrored)]
    left = []
    models = [state.sensors.changed(values, some) for some in pairs]
    for moved in bench.moved(state, models, _MANY, _lit(bench)):
        if isinstance(moved, str):
            return dict(phases)
        squares = dict.fromkeys(phases, 0.0)
        for (id, _), z in bench.residuals(state, moved).items():
            if id in squares:
                squares[id] += float(z @ z)
        left.append(squares)
    return {id: mirrored[id] if left[1][id] < left[0][id] - _SIDES else p for id, p in phases.items()}


def _lit(bench: Bench) -> list[str]:
    return [id for id, seen in bench.seen.items() if not seen.capture.light.dark]


def _waves(x: float, p: float) -> np.ndarray:
    return np.array([x * math.cos(p), x * math.sin(p), x**2, x**2 * math.cos(2 * p), x**2 * math.sin(2 * p)])


def _best(
    swing: Swing, bench: Bench, state: State, times: Sequence[float], around: Mapping[str, np.ndarray]
) -> tuple[float, float, dict[str, float]]:
    """The best of some strengths, each capture having the one of its phases (around) that suits it."""
    ids, _, root, _ = bench.rate_space(state)
    own = {cell: x for cell, x in swing.shifts.items() if cell in state.residuals}
    before = {cell: float(state.residuals[cell] @ state.residuals[cell]) for cell in own}
    rates = state.residuals[RATES]
    best: tuple[float, float, dict[str, float]] | None = None
    for t in times:
        waves = {id: np.stack([_waves(t, float(p)) for p in phases]) for id, phases in around.items()}
        gain = {id: np.zeros(len(phases)) for id, phases in around.items()}
        for cell, x in own.items():
            for k, shift in enumerate(waves[cell[0]] @ x):
                z = bench.judged(state, cell, shift)
                gain[cell[0]][k] += before[cell] - float(z @ z)
        chosen = {id: int(g.argmax()) for id, g in gain.items()}
        logs = {id: waves[id] @ swing.logs.get(id, np.zeros(5)) for id in around}

        def of_totals(chosen: Mapping[str, int], logs: Mapping[str, np.ndarray] = logs) -> float:
            z = rates + root @ np.array([logs[i][chosen[i]] for i in ids]) if ids else rates
            return float(rates @ rates - z @ z)

        for _ in range(3 if ids else 0):  # the totals have the light's common factor: one capture after the other
            for id in ids:
                left = [gain[id][k] + of_totals({**chosen, id: k}) for k in range(len(gain[id]))]
                chosen[id] = int(np.argmax(left))
        whole = of_totals(chosen) + sum(float(gain[id][k]) for id, k in chosen.items())
        if best is None or whole > best[0]:
            best = whole, t, {id: float(around[id][k]) % (2 * math.pi) for id, k in chosen.items()}
    assert best is not None
    return best
