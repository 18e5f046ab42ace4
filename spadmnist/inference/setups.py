"""Set-up candidates: the laboratory, not the sensor, differs from what is stated.

Only the totals of the captures inform them: a light level beyond its uncertainty, another wavelength or exposure, a
light leak in a dark capture. The simplest one that explains the totals is taken. A change of the sensor that explains
them as simply is a rival.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from .. import twin
from ..errors import UNABLE
from .candidates import templates
from .capture_replicates import CannotSimulate
from .closed_forms import closed_form, level_for
from .evaluation import Evaluation, square, with_totals_anew
from .levels import COST_OF_A_PARAMETER, FALSE_ALARM, HALF_95
from .light_levels import totals_space
from .models import InTheDark
from .replicates import TOTALS, Replicates, simulated
from .results import plain
from .scan import Scan
from .signature import Signature, residuals_at, signature_of_totals, signatures
from .totals_tests import along
from .trial import Trial

TIE = 6.0  # in chi square: explanations nearer than that are a tie, and all are named; a rule of thumb
_VERIFIED = 3  # rivals of the set-up that fit, after which no more are simulated: the time of a step; a rule of thumb
# relative, of the ratio of the PDP at two wavelengths: what a data sheet's curve is read to; a rule of thumb
_PDP_ERROR = 0.01
# of a logarithm: a smaller error of the light, or of the exposure, is no rarer than another wavelength; a rule of thumb
_ORDINARY = 0.25
# of a logarithm: the largest factor on an exposure that is looked for, 1,100; a rule of thumb
_FURTHEST = 7.0
_MOST = 300.0  # of a logarithm: beyond any light; a larger one would overflow a double
# detections missing at the end of a capture that stopped early: by Poisson's law so many are missing by chance with a
# probability of 2e-9
_MISSING = 20.0
# factor by which the end without detections must be longer than any other silence of the capture, and than the end of
# the model's own recordings: bursts and gates end early, too. A rule of thumb; steady captures are far beyond it
_LONGER = 2.0
# standard deviations: the most that a capture deviates from what all others predict once the set-up explains it; a rule
# of thumb
_WITHIN = 4.0
_MODELS = 4  # recordings of the model that are looked at, of captures whose end is empty


@dataclass(frozen=True)
class Factor:
    """A factor of the set-up on the levels of some captures, relative to what is stated.

    Attributes:
        quantity: "light", "dark" or "exposure".
    """

    quantity: str
    captures: tuple[str, ...]
    whole: bool  # one statement about all these captures


@dataclass(frozen=True)
class SetupExplanation:
    """Factors that explain the totals.

    Attributes:
        logs, errors: (factors,) estimates of their logarithms, standard deviations.
        left: (captures,) residuals of the totals.
        largest: the largest deviation of a capture from what all others predict then, standard deviations.
    """

    factors: tuple[Factor, ...]
    logs: np.ndarray
    errors: np.ndarray
    left: np.ndarray
    largest: float = 0.0

    @property
    def p(self) -> float:
        """The p-value of the residuals."""
        freedom = len(self.left) - len(self.factors)
        return float(stats.chi2.sf(float(self.left @ self.left), freedom)) if freedom > 0 else 1.0

    @property
    def cost(self) -> float:
        """The sum of squares of the residuals, plus the cost of the factors, in chi square."""
        return float(self.left @ self.left) + COST_OF_A_PARAMETER * len(self.factors)

    def without(self, factor: Factor) -> SetupExplanation:
        """The same residuals with the other factors alone."""
        kept = [k for k, one in enumerate(self.factors) if one != factor]
        return replace(
            self, factors=tuple(self.factors[k] for k in kept), logs=self.logs[kept], errors=self.errors[kept]
        )

    @property
    def explains(self) -> bool:
        """Whether the totals pass with it: their p-value, and each capture."""
        return self.p > FALSE_ALARM and self.largest < _WITHIN


def explanations(replicates: Replicates, evaluation: Evaluation) -> list[SetupExplanation]:
    """Every explanation of the totals by the set-up alone, by cost."""
    ids, _, root, _ = totals_space(replicates, evaluation)
    if not ids:
        return []
    z = evaluation.residuals[TOTALS]
    captures = {i: replicates.seen[i].capture for i in ids}
    lit = [i for i in ids if not captures[i].light.dark]
    single = [Factor("dark" if captures[i].light.dark else "light", (i,), False) for i in ids]
    shared = [Factor("light", tuple(lit), True)] if len(lit) > 1 else []
    waves = sorted({captures[i].light.wavelength or 0.0 for i in lit})
    for wave in waves if len(waves) > 1 else []:
        shared.append(Factor("light", tuple(i for i in lit if captures[i].light.wavelength == wave), True))
    # of early stamps no longer frame has more
    timed = {
        i: captures[i].conditions.frame_time
        for i in ids
        if captures[i].modality != "tr" and replicates.seen[i].early is None
    }
    clocks = sorted(set(timed.values()))
    for clock in clocks if len(clocks) > 1 else []:
        shared.append(Factor("exposure", tuple(i for i in timed if timed[i] == clock), True))
    shared = [factor for factor in shared if len(factor.captures) > 1]
    tries: list[tuple[Factor, ...]] = [(one,) for one in [*shared, *single]]
    tries += [pair for pair in itertools.combinations([*shared, *single], 2) if not _overlap(pair)]
    if lit:  # any light level in each of them
        tries.append(tuple(f for f in single if f.quantity == "light"))
    found = []
    for factors in dict.fromkeys(tries):
        columns = np.array([[float(i in f.captures) for f in factors] for i in ids])
        design = root @ columns
        if np.linalg.matrix_rank(design) < len(factors):
            continue
        covariance = np.linalg.inv(design.T @ design)
        logs = covariance @ design.T @ z
        left = z - design @ logs
        scores = [score for score, _ in along(root, left, np.eye(len(ids)), np.zeros(len(ids)), np.ones(len(ids)))]
        found.append(
            SetupExplanation(
                factors=factors,
                logs=logs,
                errors=np.sqrt(np.diag(covariance)),
                left=left,
                largest=float(np.max(np.abs(scores))),
            )
        )
    return sorted((e for e in found if e.explains), key=lambda e: e.cost)


def captures_of(likely: Sequence[SetupExplanation]) -> str:
    """The captures of explanations that are a tie, in words: those of one are all needed."""
    every = [" and ".join(dict.fromkeys(id for factor in one.factors for id in factor.captures)) for one in likely]
    return " or ".join(dict.fromkeys(every))


def _overlap(pair: Sequence[Factor]) -> bool:
    a, b = (set(f.captures) for f in pair)
    return a <= b or b <= a


def brightest(replicates: Replicates, one: SetupExplanation) -> str | None:
    """The capture of a set-up explanation, if it is the brightest of several; else None.

    A sensor with another response at the highest rates alone looks the same: a nonlinearity that no effect here has.
    """
    named = {id for factor in one.factors for id in factor.captures}
    rates = {}
    for id, seen in replicates.seen.items():
        if not seen.capture.light.dark:  # frames may have gaps between them
            rates[id] = seen.total / seen.counted.conditions.within_frames.live_time
    most = max(rates, key=lambda id: rates[id], default=None)
    return most if named == {most} and len(rates) > 2 else None


def entries(replicates: Replicates, evaluation: Evaluation, likely: Sequence[SetupExplanation]) -> list[dict[str, Any]]:
    """The entries of set-up explanations for the JSON data; those that are a tie are confused.

    Args:
        likely: the explanations within a tie, the best first.
    """
    out: list[dict[str, Any]] = []
    seen: set[tuple[str | None, str]] = set()
    for number, one in enumerate(likely):
        for factor, log, error in zip(one.factors, one.logs, one.errors, strict=True):
            value, low, high = (plain(math.exp(min(log + k * error, _MOST))) for k in (0.0, -HALF_95, HALF_95))
            for id in factor.captures:
                names = _names(replicates, evaluation, factor, id, float(log), float(error))
                for name in names:
                    if (id, name) in seen:
                        continue
                    seen.add((id, name))
                    factor_of: dict[str, float | None] = {"value": value, "low": low, "high": high}
                    if name == "exposure":
                        factor_of = exposure_factor(replicates, evaluation, id, float(log), float(error))
                    confused = len(likely) > 1 or len(names) > 1
                    out.append({"capture": id, "quantity": name, "factor": factor_of, "confused": confused})
        if number == 0 and one.cost < likely[-1].cost - TIE:
            break
    return out


def exposure_factor(
    replicates: Replicates, evaluation: Evaluation, id: str, log: float, error: float
) -> dict[str, float | None]:
    """The factor on an exposure or a frame time that gives as many detections as one on the level, with its interval.

    Args:
        log, error: of the factor on the level, with its standard error.
    """
    capture, sensor = replicates.seen[id].capture, evaluation.sensors.mean_sensor(id)
    level = float(evaluation.rates[id].stated or evaluation.rates[id].level)
    clock = capture.conditions

    def detections(factor: float) -> float:
        """By the closed forms, of a clock that is `factor` times as long."""
        longer = replace(
            clock,
            exposure=clock.exposure * factor,
            frame_time=clock.frame_time * factor,
            frame_period=clock.frame_period * factor,
        )
        of = InTheDark.of(sensor) if capture.light.dark else sensor
        return closed_form(of, replace(capture, conditions=longer))(level)

    def factor_at(x: float) -> float:
        wanted = evaluation.rates[id].expected(level * math.exp(min(x, _MOST)))
        low, high = -_FURTHEST, _FURTHEST
        for _ in range(50):
            middle = (low + high) / 2
            low, high = (middle, high) if detections(math.exp(middle)) < wanted else (low, middle)
        return math.exp((low + high) / 2)

    value, low, high = (plain(factor_at(log + k * error)) for k in (0.0, -HALF_95, HALF_95))
    return {"value": value, "low": low, "high": high}


def _names(
    replicates: Replicates, evaluation: Evaluation, factor: Factor, id: str, log: float, error: float
) -> list[str]:
    """The quantities that a factor on a capture's level may be.

    It is light or exposure. Where the wavelength of another capture gives that factor, it is this one, and light and
    exposure as well if the factor is one that they often have.
    """
    capture = replicates.seen[id].capture
    if factor.quantity != "light" or (factor.whole and len(factor.captures) > 1):
        return [factor.quantity]
    own = twin.photons_at(capture, evaluation.sensors.one.layout)
    others = ["light", "exposure"] if replicates.seen[id].early is None else ["light"]
    for wave in sorted({s.capture.light.wavelength or 0.0 for s in replicates.seen.values()} - {0.0}):
        if wave == capture.light.wavelength or not own:
            continue
        other = replace(capture, light=replace(capture.light, wavelength=wave))
        there = twin.photons_at(other, evaluation.sensors.one.layout)
        if not there:
            continue
        sensor = evaluation.sensors.one
        ratio = there * sensor.nominal_pdp(wave) / (own * sensor.nominal_pdp(capture.light.wavelength))
        # the error has the uncertainty of the light in it
        if abs(math.log(ratio) - log) < 3 * math.hypot(error, _PDP_ERROR):
            return ["wavelength", *(others if abs(log) < _ORDINARY else [])]
    return others


def rivals(scan: Scan, evaluation: Evaluation, cost: float) -> list[Trial]:
    """The trials of changes of the sensor that explain the totals as simply, by the effects' closed forms.

    Args:
        cost: of the best set-up explanation, in chi square.
    """
    replicates = scan.replicates
    out: list[Trial] = []
    freedom = len(evaluation.residuals[TOTALS])
    for candidate in replicates.candidates(evaluation.sensors.one):
        if not candidate.strengths or candidate.phases or candidate.carrier:
            continue
        # from each template: from the nearest one alone the fit may not converge
        best: tuple[float, Trial] | None = None
        for tried in templates(candidate):
            with scan.if_possible(candidate, "explaining the totals", wholly=False):
                sensors = evaluation.sensors.changed(tried)
                one = Trial(
                    candidate=candidate,
                    values=tried,
                    signature=signature_of_totals(replicates, evaluation, sensors),
                    fall=0.0,
                    times=1.0,
                    sensors=sensors,
                )
                one.fall, one.times = scan.line_search(evaluation, one.signature, one.signed)
                if one.fall < COST_OF_A_PARAMETER:
                    continue
                one = _fitted(scan, evaluation, one)
                left = one.residuals[TOTALS] if one.residuals else evaluation.residuals[TOTALS]
                if best is None or float(left @ left) < best[0]:
                    best = float(left @ left), one
        if best is None:
            continue
        remains, fit = best
        if remains + COST_OF_A_PARAMETER < cost + TIE and stats.chi2.sf(remains, max(1, freedom - 1)) > FALSE_ALARM:
            z = evaluation.residuals[TOTALS]
            fit.fall = float(z @ z) - remains
            out.append(fit)
    out, found = sorted(out, key=lambda t: t.cost(evaluation)), list[Trial]()
    while out and len(found) < _VERIFIED:
        some, out = out[:_VERIFIED], out[_VERIFIED:]
        made = signatures(replicates, evaluation, [t.sensors for t in some if t.sensors is not None])
        found += [t for t, one in zip(some, made, strict=True) if _fits(scan, evaluation, t, one)]
    return found


def rivals_with_a_factor(scan: Scan, evaluation: Evaluation, one: SetupExplanation) -> list[tuple[Trial, Factor]]:
    """Changes of the sensor that replace one of the two factors of a set-up explanation.

    Returns:
        (trial of a change with one strength, the factor that is still needed), by cost.
    """
    replicates = scan.replicates
    out: list[tuple[Trial, Factor]] = []
    for factor in one.factors if len(one.factors) == 2 else ():
        before, replicates.unstated = replicates.unstated, replicates.unstated | set(factor.captures)
        try:
            free = with_totals_anew(replicates, evaluation)
            if free.residuals[TOTALS].size > 1:
                # each level that is freed is a number
                cost = one.cost - COST_OF_A_PARAMETER * len(factor.captures)
                out += [(r, factor) for r in rivals(scan, free, cost) if len(r.candidate.strengths) == 1]
        finally:
            replicates.unstated = before
    return sorted(out, key=lambda pair: pair[0].cost(evaluation))


def _fits(scan: Scan, evaluation: Evaluation, one: Trial, signature: Signature | CannotSimulate) -> bool:
    """Whether the other statistics agree with what explains the totals."""
    if isinstance(signature, CannotSimulate):
        return False
    residuals = residuals_at(scan.replicates, evaluation, signature)
    others = {c: z for c, z in residuals.items() if c != TOTALS}
    before = {c: z for c, z in evaluation.residuals.items() if c != TOTALS}
    return square(others) - square(before) < COST_OF_A_PARAMETER + TIE


def _fitted(scan: Scan, evaluation: Evaluation, one: Trial) -> Trial:
    """The trial with its strength fitted to the totals, by closed forms."""
    coordinate, replicates = one.candidate.strengths[0], scan.replicates
    given = one.scaled()

    def at(x: float) -> tuple[Signature, np.ndarray]:
        signature = signature_of_totals(
            replicates, evaluation, evaluation.sensors.changed({**given, coordinate.key: x})
        )
        return signature, residuals_at(replicates, evaluation, signature)[TOTALS]

    u = coordinate.coordinate(float(given[coordinate.key]))
    ends = coordinate.ends
    span = 0.05 if coordinate.log else 0.01 * (coordinate.high - coordinate.low)
    covariance = 1.0
    for _ in range(8):
        signature, z = at(coordinate.value(u))
        h = span if u + span <= ends[1] else -span
        slope = (at(coordinate.value(u + h))[1] - z) / h
        power = float(slope @ slope)
        if power <= 0:
            return one
        covariance = 1 / power
        step = float(np.clip(-float(slope @ z) / power, -1.0, 1.0))
        u = min(max(u + step, ends[0]), ends[1])
        if abs(step) < 1e-4:
            break
    signature, z = at(coordinate.value(u))
    given[coordinate.key] = coordinate.value(u)
    half = HALF_95 * math.sqrt(covariance)
    residuals = {**evaluation.residuals, TOTALS: z}
    return Trial(
        candidate=one.candidate,
        values=given,
        signature=signature,
        fall=one.fall,
        times=1.0,
        sensors=evaluation.sensors.changed(given),
        residuals=residuals,
        intervals={coordinate.key: coordinate.interval(u - half, u + half)},
    )


def stopped_early(replicates: Replicates) -> dict[str, tuple[float, float]]:
    """The captures that stopped early, by their last detection: (share that was exposed, its standard deviation).

    Their end is without detections for longer than chance, the rest of the capture and the model allow.
    """
    out = {}
    for id, seen in replicates.seen.items():
        if seen.last is None or seen.total < 2:
            continue
        exposure = seen.capture.conditions.exposure
        share = seen.last * (1 + 1 / seen.total) / exposure
        if seen.total * (1 - share) / max(share, 1e-9) <= _MISSING:
            continue
        if exposure - seen.last > _LONGER * max(seen.silence or 0.0, _end_of_model(replicates, id)):
            out[id] = share, share / seen.total
    return out


def _end_of_model(replicates: Replicates, id: str) -> float:
    """The longest time without detections at the end of a few recordings that the stated model makes, s."""
    seen, sensor = replicates.seen[id], replicates.start
    capture = seen.capture
    sensor = InTheDark.of(sensor) if capture.light.dark else sensor
    longest = 0.0
    numbers = np.arange(_MODELS, dtype=np.uint64)
    with contextlib.suppress(*UNABLE):  # a model that cannot be simulated is reported where it is evaluated
        level = level_for(closed_form(sensor, capture), seen.total, 1.0)
        for recording in simulated(sensor, capture, np.full(_MODELS, level), numbers, replicates.seed):
            if recording.events is not None and len(recording.events):
                stamps, unit = recording.events.stamps
                longest = max(longest, capture.conditions.exposure - float(stamps.max() * unit))
    return longest
