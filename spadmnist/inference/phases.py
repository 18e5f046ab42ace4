"""Periodic candidates: the phase in each capture, and the strength, that fit the data best."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .candidates import Candidate
from .capture_replicates import CannotSimulate
from .coordinates import Key
from .evaluation import Evaluation, evaluate
from .light_levels import totals_space
from .models import phase_parameters
from .replicates import FEW, TOTALS, Cell, Replicates
from .signature import Sampling, Signature, residuals_at, residuals_shifted, signatures
from .spectral_lines import Line

# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
# factors on the simulated strength that are tried at first
TIMES = (0.03, 0.1, 0.3, 0.6, 1.0, 1.7, 3.0, 6.0, 10.0)
# factors on the best strength so far, pure numbers: a fifth apart, so that they decide the strength within 10 %. They
# choose where a fit begins, in `scan`, too; a rule of thumb
NEAR = (0.7, 0.85, 1.0, 1.2, 1.4)
_NEARER = (0.92, 0.96, 1.04, 1.08)  # factors about the best of `NEAR`: they decide the strength within 4 %
_PHASES = 24  # phases that are tried for each capture
_FINELY = 360  # steps of a whole turn in the search for the other phase of the same total
# phases that are simulated: five amplitudes are fitted to them, so that five are the fewest
_TURNS = 8
# replicates that decide between the two phases of the same total: few hide the drift of a short capture
_MANY = 16
# in chi square: the least fall in a capture for which the other phase is taken; 3 standard deviations of one number
_SIDES = 9.0
_AT_ONCE = 100_000  # cells of several phases that are compared together, 100 bytes each: no result depends on it
_CLOSER = np.linspace(-0.5, 0.5, 9)  # of the step between two phases: the finer grid about the best one


@dataclass(frozen=True)
class PeriodicSignature:
    """The signature of a periodic effect, to second order in its strength x, at the phase p.

            x (a cos p + b sin p) + x^2 (c + d cos 2p + e sin 2p)

    Attributes:
        shifts: (5, cells) the amplitudes a to e of each cell, by (capture, statistic).
        noise: as in `Signature`.
        logs: (5,) the amplitudes of the log of the light, by capture.
    """

    shifts: dict[Cell, np.ndarray]
    noise: dict[Cell, float]
    logs: dict[str, np.ndarray]

    @staticmethod
    def of(turned: Sequence[Signature], phases: Sequence[float]) -> PeriodicSignature:
        """The fit to signatures of strength 1 at some phases.

        Args:
            turned: a signature for each phase.
            phases: rad, evenly spaced over a turn.
        """
        solve = np.linalg.pinv(np.stack([_waves(1.0, p) for p in phases]))
        shifts = {}
        for cell in set().union(*(m.shifts for m in turned)):
            size = next(len(m.shifts[cell]) for m in turned if cell in m.shifts)
            shifts[cell] = solve @ np.stack([m.shifts.get(cell, np.zeros(size)) for m in turned])
        noise = {cell: float(np.mean([m.noise.get(cell, 0.0) for m in turned])) / len(turned) for cell in shifts}
        logs = {id: solve @ np.array([m.logs.get(id, 0.0) for m in turned]) for id in turned[0].logs}
        return PeriodicSignature(shifts, noise, logs)

    def at(self, phases: Mapping[str, float]) -> Signature:
        """The signature with a phase in each capture: its odd and its even part."""
        odd, even = Signature({}, dict(self.noise), {}), Signature({}, {}, {})
        for cell, x in self.shifts.items():
            waves = _waves(1.0, phases[cell[0]])
            odd.shifts[cell], even.shifts[cell] = waves[:2] @ x[:2], waves[2:] @ x[2:]
        for id, log in self.logs.items():
            waves = _waves(1.0, phases[id])
            odd.logs[id], even.logs[id] = float(waves[:2] @ log[:2]), float(waves[2:] @ log[2:])
        return Signature(odd.shifts, odd.noise, odd.logs, even=even)

    def mirror_phase(self, id: str, phase: float, times: float) -> float:
        """The other phase at which a capture has the same total, or the same phase if there is none.

        The rate falls there where it rose.
        """
        every = 2 * math.pi * np.arange(_FINELY + 1) / _FINELY + phase
        more = np.array([_waves(times, p) @ self.logs[id] for p in every])
        crossed = np.flatnonzero(np.diff(np.sign(more - more[0])[1:-1])) + 1
        return float(every[crossed[0]]) % (2 * math.pi) if len(crossed) else phase

    def best_fit(
        self, replicates: Replicates, evaluation: Evaluation, times: Sequence[float] = TIMES
    ) -> tuple[float, float, dict[str, float]]:
        """(fall of the squares in chi square, strength, phase of each capture) of the best fit to the data.

        Args:
            times: strengths to try, relative to the simulated one.
        """
        every = 2 * math.pi * np.arange(_PHASES) / _PHASES
        around = dict.fromkeys(replicates.seen, every)
        best = _best(self, replicates, evaluation, times, around)
        for closer in (NEAR, _NEARER) if len(times) > 1 else ():
            best = max(
                best, _best(self, replicates, evaluation, [best[1] * x for x in closer], around), key=lambda b: b[0]
            )
        step = 2 * math.pi / _PHASES
        return _best(self, replicates, evaluation, [best[1]], {id: p + step * _CLOSER for id, p in best[2].items()})


def simulate_phases(
    replicates: Replicates, evaluation: Evaluation, keys: Sequence[Key], values: Mapping[Key, Any], few: int
) -> PeriodicSignature:
    """The signature of a periodic effect at any phase.

    Args:
        keys: the parameters that are phases.
        values: the other parameters, SI.
        few: replicates of each capture.
    Raises:
        CannotSimulate: where it cannot be simulated at one of the phases.
    """
    turns = [2 * math.pi * k / _TURNS for k in range(_TURNS)]
    pairs = [(id, key) for id in replicates.seen for key in keys]
    models = [evaluation.sensors.changed(values, dict.fromkeys(pairs, turn)) for turn in turns]
    found = signatures(replicates, evaluation, models, Sampling(few=few, only=_lit(replicates)))
    made: list[Signature] = []
    for one in found:
        if isinstance(one, CannotSimulate):
            raise CannotSimulate(str(one))
        made.append(one)
    return PeriodicSignature.of(made, turns)


class PeriodicSignatures:
    """The signatures of periodic candidates; each is simulated once."""

    def __init__(self) -> None:
        # candidate's name, values, replicates
        self._known: list[tuple[str, Mapping[Key, Any], int, PeriodicSignature]] = []

    def signature(
        self,
        replicates: Replicates,
        evaluation: Evaluation,
        candidate: Candidate,
        values: Mapping[Key, Any],
        line: Line | None,
        few: int = FEW,
    ) -> PeriodicSignature:
        """The signature of a candidate at any phase.

        That under an earlier model is used again, also of a frequency that no data distinguish from that of the line:
        it chooses what is fitted, and the fit simulates it anew.

        Args:
            values: SI; line: that of the data at its frequency.
            few: replicates of each capture, at least.
        Raises:
            CannotSimulate: as `simulate_phases`.
        """
        within = {d.key: line.error if line and d.kind == "frequency" else 0.0 for d in candidate.shapes}
        for name, known, number, found in self._known:
            if (name == candidate.name and number >= few) and all(
                known[k] == x or (within.get(k) and abs(known[k] - x) <= within[k]) for k, x in values.items()
            ):
                return found
        made = simulate_phases(replicates, evaluation, candidate.phases, values, few)
        self._known.append((candidate.name, dict(values), few, made))
        return made


def choose_phase(
    replicates: Replicates,
    evaluation: Evaluation,
    keys: Sequence[Key],
    values: Mapping[Key, Any],
    phases: Mapping[str, float],
    mirrored: Mapping[str, float],
) -> dict[str, float]:
    """The phase of each capture, or the other one of the same total where that fits the capture clearly better.

    A capture far shorter than a period sees one flank of it: its drift is too small for the few replicates of
    `simulate_phases`.

    Args:
        keys, values: as there.
        phases, mirrored: rad, by capture; see `PeriodicSignature.mirror_phase`.
    """
    pairs = [{(id, key): p for id, p in some.items() for key in keys} for some in (phases, mirrored)]
    left = []
    models = [evaluation.sensors.changed(values, some) for some in pairs]
    for signature in signatures(replicates, evaluation, models, Sampling(few=_MANY, only=_lit(replicates))):
        if isinstance(signature, CannotSimulate):
            return dict(phases)
        squares = dict.fromkeys(phases, 0.0)
        for (id, _), z in residuals_at(replicates, evaluation, signature).items():
            if id in squares:
                squares[id] += float(z @ z)
        left.append(squares)
    return {id: mirrored[id] if left[1][id] < left[0][id] - _SIDES else p for id, p in phases.items()}


def _lit(replicates: Replicates) -> list[str]:
    return [id for id, seen in replicates.seen.items() if not seen.capture.light.dark]


def _waves(x: float, p: float) -> np.ndarray:
    return np.array([x * math.cos(p), x * math.sin(p), x**2, x**2 * math.cos(2 * p), x**2 * math.sin(2 * p)])


def _best(
    swing: PeriodicSignature,
    replicates: Replicates,
    evaluation: Evaluation,
    times: Sequence[float],
    around: Mapping[str, np.ndarray],
) -> tuple[float, float, dict[str, float]]:
    """(fall of the squares in chi square, strength, phase of each capture) of the best of some strengths and phases.

    Args:
        times: strengths.
        around: (phases,) rad to try, by capture.
    """
    ids, _, root, _ = totals_space(replicates, evaluation)
    shifts = {cell: x for cell, x in swing.shifts.items() if cell in evaluation.residuals}
    before = {cell: float(evaluation.residuals[cell] @ evaluation.residuals[cell]) for cell in shifts}
    rates = evaluation.residuals[TOTALS]
    best: tuple[float, float, dict[str, float]] | None = None
    for t in times:
        waves = {id: np.stack([_waves(t, float(p)) for p in phases]) for id, phases in around.items()}
        falls = {id: np.zeros(len(phases)) for id, phases in around.items()}
        for cell, x in shifts.items():
            some = max(1, _AT_ONCE // x.shape[1])
            for k in range(0, len(waves[cell[0]]), some):
                z = residuals_shifted(replicates, evaluation, cell, waves[cell[0]][k : k + some] @ x)
                falls[cell[0]][k : k + some] += before[cell] - np.einsum("pc,pc->p", z, z)
        chosen = {id: int(fall.argmax()) for id, fall in falls.items()}
        logs = {id: waves[id] @ swing.logs.get(id, np.zeros(5)) for id in around}

        def of_totals(chosen: Mapping[str, int], logs: Mapping[str, np.ndarray] = logs) -> float:
            z = rates + root @ np.array([logs[i][chosen[i]] for i in ids]) if ids else rates
            return float(rates @ rates - z @ z)

        for _ in range(3 if ids else 0):  # the totals share the light's common factor: one capture after the other
            for id in ids:
                left = [falls[id][k] + of_totals({**chosen, id: k}) for k in range(len(falls[id]))]
                chosen[id] = int(np.argmax(left))
        whole = of_totals(chosen) + sum(float(falls[id][k]) for id, k in chosen.items())
        if best is None or whole > best[0]:
            best = whole, t, {id: float(around[id][k]) % (2 * math.pi) for id, k in chosen.items()}
    assert best is not None
    return best


def evaluate_start(replicates: Replicates) -> tuple[Evaluation, dict[tuple[str, Key], float]]:
    """(evaluation of the stated sensor, fitted phases of its periodic effects by (capture, parameter))."""
    evaluation = evaluate(replicates, {}, remember=True)
    keys = phase_parameters(replicates.start)
    if not keys:
        return evaluation, {}
    try:
        swing = simulate_phases(replicates, evaluation, keys, {}, FEW)
    except CannotSimulate:
        return evaluation, {}
    *_, found = swing.best_fit(replicates, evaluation, [1.0])
    mirrored = {id: swing.mirror_phase(id, p, 1.0) for id, p in found.items()}
    found = choose_phase(replicates, evaluation, keys, {}, found, mirrored)
    phases = {(id, key): p for id, p in found.items() for key in keys}
    return evaluate(replicates, {}, evaluation.sensors.changed({}, phases)), phases
