"""Compare: where does a model fail, and by how much?

Every statistic of every capture is a check. The model simulates each capture many times (`nulls`), at a light level
that gives as many detections as were measured; a check fails where the measured summary lies outside the model's own
scatter, p-values being corrected for the number of checks (Holm), so that a right model is called wrong once in a
hundred comparisons. Whether those light levels themselves agree with what the measurement states, within its
uncertainty, is a check of its own.
"""

from __future__ import annotations

import itertools
import json
import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import stats

from .. import units
from ..errors import InputError
from ..factory import pool
from ..measurement import Measurement
from ..recording import Capture
from ..sensor import Sensor
from ..statistics import Summary
from .nulls import Judgement, Null
from .recordings import REPLICATES, CaptureNull, model_of, reduced, statistics_for

FALSE_ALARM = 0.01  # of the whole comparison, if the model is right
LEAST_ELASTICITY = 0.01  # of a total that says something of the light
_SHARES = {"light": 0.25, "rate": 0.25}  # of the false alarms that are allowed
SHARE_OF_TOTALS = sum(_SHARES.values())
_REST = 1 - SHARE_OF_TOTALS
_MAP = "pixel_map"
_ENOUGH = 20.0  # detections of a pixel from which on its ratio says something
_LEAST_P = 1e-300  # a p-value is never 0


@dataclass(frozen=True)
class Nuisance:
    """A quantity that the measurement does not know exactly: its fitted value, 95 % interval, and pull in sigmas.

    stated: its standard deviation as the measurement has it.
    """

    capture: str | None
    name: str
    value: float
    low: float
    high: float
    pull: float
    stated: float = 0.0


@dataclass(frozen=True)
class Check:
    """One statistic of one capture. misfit: mean squared standardized residual, 1 being the model's own.

    significant: it lies outside the model's scatter; material: and is larger than the tolerance, so that it fails.
    summary, judgement: what was measured and what the model expects, for pictures; None for checks of totals.
    """

    statistic: str
    capture: str | None
    misfit: float
    p_value: float
    where: str
    size: str
    relative: float
    passes: bool = True
    material: bool = False
    significant: bool = False
    summary: Summary | None = field(default=None, repr=False)
    judgement: Judgement | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Comparison:
    """What `compare` found. verdict: "adequate" or "fails"."""

    sensor: str
    measurement: str
    verdict: str
    misfit: float
    misfit_null_95: float
    nuisances: tuple[Nuisance, ...]
    checks: tuple[Check, ...]
    replicates: int
    tolerance: float | None = None
    false_alarm_rate: float = FALSE_ALARM
    crop: str | None = None  # the part of the sensor that was measured: rows, columns

    @property
    def failing(self) -> list[Check]:
        """Failing checks, the clearest first."""
        return sorted((c for c in self.checks if not c.passes), key=lambda c: (c.p_value, -c.misfit))

    def as_data(self) -> dict[str, Any]:
        """As `formats`: spadmnist-comparison/1."""
        return {
            "format": "spadmnist-comparison/1",
            "verdict": self.verdict,
            "misfit": _plain(self.misfit),
            "misfit_in_sample": _plain(self.misfit),  # no capture is left out
            "misfit_null_95": _plain(self.misfit_null_95),
            "false_alarm_rate": self.false_alarm_rate,
            "replicates": self.replicates,
            "tolerance": self.tolerance,
            **({"crop": self.crop} if self.crop else {}),
            "nuisances": [
                {
                    "capture": n.capture,
                    "name": n.name,
                    **{k: _plain(getattr(n, k)) for k in ("value", "low", "high", "pull")},
                }
                for n in self.nuisances
            ],
            "checks": [
                {
                    "statistic": c.statistic,
                    "capture": c.capture,
                    "misfit": _plain(c.misfit),
                    "p_value": _plain(c.p_value),
                    "passes": c.passes,
                    "material": c.material,
                    "where": c.where,
                    "size": c.size,
                }
                for c in self.checks
            ],
        }


def _plain(value: float) -> float:
    """A finite number of six digits."""
    return float(f"{min(max(value, -1e300), 1e300):.6g}")


# --- the comparison ---------------------------------------------------------------------------------------------


def compare(
    sensor: Sensor,
    measurement: Measurement,
    seed: int = 0,
    tolerance: float | None = None,
    jobs: int = 2,
    replicates: int = REPLICATES,
    progress: Callable[[str, float], None] | None = None,
) -> Comparison:
    """Set a model beside a measurement.

    tolerance: a failing check whose size is smaller passes, as not material. progress: told (what, share done).
    Raises InputError where sensor and measurement do not belong together.
    """
    sensor = sensor.settled()
    measurement.check_sensor(sensor)
    say = progress or (lambda what, share: None)
    checks: list[Check] = []
    judged: list[tuple[float, Null]] = []  # misfit, null of independent cells
    levels: list[tuple[Capture, float, float, float]] = []  # capture, log of the light factor, its error, elasticity
    captures = list(measurement.captures)
    with pool(jobs, "generator") as parallel:
        for k, capture in enumerate(captures):
            say(capture.id, k / len(captures))
            recording = measurement.recording(capture.id, sensor) if capture.mean is None else None
            if recording is not None:
                total = float(recording.totals.sum())
            else:
                total = (capture.mean or 0.0) * sensor.layout.pixels
            seen = capture if recording is None else replace(recording.capture, tick=recording.tick)
            shown = _Share(say, capture.id, k, len(captures), replicates)
            made = model_of(sensor, seen, total, seed, replicates, parallel, shown)
            checks += _level_checks(sensor, capture, total, made, levels)
            if recording is None:
                continue
            for statistic in statistics_for(recording.capture):
                null = made.nulls.get(statistic.name)
                summary = reduced(statistic, recording)
                if null is None or summary is None:
                    continue
                judgement = null.judge(summary.values, total)
                text, relative = summary.size(
                    judgement.worst,
                    float(summary.values[judgement.worst]),
                    float(judgement.expected[judgement.worst]),
                )
                # what a window has because a shorter one has it is not counted again
                single, misfit = null, judgement.misfit
                if summary.nested is not None:
                    single = made.apart[statistic.name]
                    misfit = single.judge(summary.apart().values, total).misfit
                checks.append(
                    Check(
                        statistic.name,
                        capture.id,
                        misfit,
                        judgement.p_value,
                        summary.where(judgement.worst),
                        text,
                        relative,
                        summary=summary,
                        judgement=judgement,
                    )
                )
                if null.law != "exact":
                    judged.append((misfit, single))
    nuisances, common = light_of(levels, captures)
    checks += common
    checks += _between_wavelengths(captures, checks, sensor.layout.columns)
    if not checks:
        raise InputError(
            f"{measurement.source}: nothing here can be compared: of no capture are light and detections known. State "
            "the light (irradiance or illuminance) of a capture, or name the file of one"
        )
    checks = _verdicts([replace(c, p_value=max(c.p_value, _LEAST_P)) for c in checks], tolerance)
    # of means alone there are no statistics: their totals stand in
    squares = [x for x, _ in judged] or [c.misfit for c in checks if c.statistic == "rate"]
    misfit = float(np.mean(squares)) if squares else 1.0
    own = np.mean([null.own / max(null.own.mean(), 1e-30) for _, null in judged], axis=0) if judged else np.ones(1)
    verdict = "adequate" if all(c.passes for c in checks) else "fails"
    return Comparison(
        sensor.name,
        measurement.name,
        verdict,
        misfit,
        float(np.quantile(own, 0.95)),
        tuple(nuisances),
        tuple(checks),
        replicates,
        tolerance,
        crop=str(sensor.window) if sensor.window else None,
    )


def _between_wavelengths(captures: Sequence[Capture], checks: Sequence[Check], columns: int) -> list[Check]:
    """Do the pixels keep their ratios from one wavelength to the next? Of each, the capture with most detections."""
    best: dict[float, tuple[float, Check]] = {}
    for capture in captures:
        wave = capture.light.wavelength
        found = next((c for c in checks if c.capture == capture.id and c.statistic == _MAP), None)
        if wave is None or found is None or found.judgement is None:
            continue
        total = float(found.judgement.expected.sum())
        if wave not in best or total > best[wave][0]:
            best[wave] = total, found
    out = []
    waves = sorted(best)
    for short, long in itertools.pairwise(waves):
        one, other = best[short][1].judgement, best[long][1].judgement
        if one is None or other is None or one.expected.size != other.expected.size or one.expected.min() < _ENOUGH:
            continue
        if other.expected.min() < _ENOUGH:
            continue
        widths = [j.spread / j.expected for j in (one, other)]
        apart = other.residuals * widths[1] - one.residuals * widths[0]
        z = apart / np.hypot(*widths)
        worst = int(np.argmax(np.abs(z)))
        square = float(np.mean(z**2))
        p_sum = float(stats.chi2.sf(square * z.size, z.size))
        p_cell = min(1.0, 2 * z.size * float(stats.norm.sf(abs(float(z[worst])))))
        place = f"row {worst // columns}, column {worst % columns}"
        names = " beside ".join(units.show(wave, "m") for wave in (long, short))
        size = f"{float(apart[worst]):+.2%} in the worst pixel"
        p = min(1.0, 2 * min(p_sum, p_cell))
        out.append(Check("wavelength_ratio", None, square, p, f"{place}, {names}", size, float(apart[worst])))
    return out


@dataclass
class _Share:
    """Says how far the model's recordings are."""

    say: Callable[[str, float], None]
    capture: str
    number: int
    captures: int
    replicates: int
    done: int = 0

    def __call__(self, more: int) -> None:
        self.done += more
        self.say(self.capture, (self.number + self.done / self.replicates) / self.captures)


def _level_checks(
    sensor: Sensor,
    capture: Capture,
    total: float,
    made: CaptureNull,
    levels: list[tuple[Capture, float, float, float]],
) -> list[Check]:
    """The total of a dark capture against the model's; that of a lit one becomes a light level."""
    if made.stated is None:
        return []
    lost = not capture.light.dark and made.drowned(total)
    if not capture.light.dark and not lost:
        level, error, elasticity = made.level_of(max(total, 0.5))
        if elasticity > LEAST_ELASTICITY:
            levels.append((capture, math.log(level / made.stated), error, elasticity))
        return []
    mean = made.total_at(made.stated)
    light = math.hypot(capture.light.relative_uncertainty, capture.light.own_uncertainty)
    z = made.score(total, light if lost else 0.0)
    per = sensor.layout.pixels * capture.conditions.exposure
    size = f"{total / per:.4g} /s in a pixel, {mean / per:.4g} /s expected"
    relative = (total - mean) / max(mean, 1.0)
    p = float(2 * stats.norm.sf(abs(z)))
    where = "all pixels, hardly any light" if lost else "all pixels, no light"
    return [Check("rate", capture.id, z * z, p, where, size, relative)]


def light_of(
    levels: Sequence[tuple[Capture, float, float, float]], captures: Sequence[Capture]
) -> tuple[list[Nuisance], list[Check]]:
    """The common light factor, each capture's own, and whether they are as the measurement states."""
    if not levels:
        return [], []
    x = np.array([log for _, log, _, _ in levels])
    error = np.array([math.hypot(e, c.light.own_uncertainty) for c, _, e, _ in levels])
    error = np.maximum(error, 1e-6)
    common = max(c.light.relative_uncertainty for c, _, _, _ in levels)
    weight = 1 / error**2
    total_weight = weight.sum() + (1 / common**2 if common > 0 else 1e18)
    best = float((weight * x).sum() / total_weight)
    spread = 1 / math.sqrt(total_weight)
    own = float((weight * x).sum() / weight.sum())  # what the captures alone say
    own_error = 1 / math.sqrt(weight.sum())
    pull = own / math.hypot(common, own_error)
    name = "light"
    nuisances = [
        Nuisance(
            None, name, math.exp(best), math.exp(best - 1.96 * spread), math.exp(best + 1.96 * spread), pull, common
        )
    ]
    checks = [
        Check(
            name,
            None,
            pull**2,
            float(2 * stats.norm.sf(abs(pull))),
            "all lit captures",
            f"light {math.expm1(own):+.2%} of what is stated, uncertain by {common:.2%}",
            math.expm1(own),
        )
    ]
    for (capture, log, _, elasticity), e in zip(levels, error, strict=True):
        # the others tell the common factor; without others, or where it is known, what is stated does
        others = weight.sum() - 1 / e**2 + (1 / common**2 if common > 0 else 1e18)
        mean = (float((weight * x).sum()) - log / e**2) / others
        z = (log - mean) / math.sqrt(e**2 + 1 / others)
        if capture.light.own_uncertainty > 0:
            nuisances.append(
                Nuisance(
                    capture.id,
                    name,
                    math.exp(log),
                    math.exp(log - 1.96 * e),
                    math.exp(log + 1.96 * e),
                    z,
                    capture.light.own_uncertainty,
                )
            )
        change = math.expm1((log - mean) * elasticity)
        size = f"{change:+.2%} detections beside the other captures"
        checks.append(Check("rate", capture.id, z * z, float(2 * stats.norm.sf(abs(z))), "all pixels", size, change))
    return nuisances, checks


def _verdicts(checks: Sequence[Check], tolerance: float | None) -> list[Check]:
    """Holm's correction: which checks fail so clearly that a right model shows one only once in a hundred times."""
    # one question about the light, one about the captures' totals, one about all that they contain: a share each, lest
    # a power meter that is off drowns among a hundred statistics
    kinds = [c.statistic if c.statistic in _SHARES else "" for c in checks]
    weights = [_SHARES.get(kind, _REST) / kinds.count(kind) for kind in kinds]
    order = sorted(range(len(checks)), key=lambda i: checks[i].p_value / weights[i])
    failing: set[int] = set()
    left = sum(weights)
    for i in order:
        if checks[i].p_value > FALSE_ALARM * weights[i] / max(left, 1e-12):
            break
        failing.add(i)
        left -= weights[i]
    out = []
    for i, check in enumerate(checks):
        material = i in failing and (tolerance is None or not abs(check.relative) < tolerance)
        out.append(replace(check, passes=not material, material=material, significant=i in failing))
    return out


def canonical(comparison: Comparison) -> str:
    """The answer as JSON."""
    return json.dumps(comparison.as_data(), indent=1, allow_nan=False)


def table(comparison: Comparison) -> str:
    """The answer for a terminal, at most 100 characters wide: verdict, failing checks, light."""
    failing = comparison.failing
    lines = []
    if failing:
        lines.append(f"The model fails {len(failing)} of {len(comparison.checks)} checks. The clearest first:")
        lines.append("")
        for c in failing[:12]:
            head = f"  p = {c.p_value:.1g}"
            text = f"{c.statistic}, {c.capture or 'all captures'}: {c.where}; {c.size}"
            lines += textwrap.wrap(text, 100, initial_indent=f"{head:<13}", subsequent_indent=" " * 13)
        if len(failing) > 12:
            lines.append(f"... and {len(failing) - 12} more (--json FILE or -o REPORT holds all)")
    else:
        lines.append(f"The model is adequate: none of {len(comparison.checks)} checks fails.")
        closest = sorted(comparison.checks, key=lambda c: c.p_value)[:3]
        near = ", ".join(f"{c.statistic} of {c.capture or 'all'} (p = {c.p_value:.2g})" for c in closest)
        lines += textwrap.wrap(f"Nearest to failing: {near}.", 100)
    lines.append("")
    about = (
        f"misfit {comparison.misfit:.4g} (1: the model's own scatter; 95 % of its recordings stay below "
        f"{comparison.misfit_null_95:.4g}); {comparison.replicates} simulations of each capture; a right model is "
        f"called wrong in {comparison.false_alarm_rate:.0%} of comparisons."
    )
    lines += textwrap.wrap(about, 100)
    for n in comparison.nuisances:
        where = n.capture or "all lit captures"
        interval = f"95 %: {n.low:.4f} to {n.high:.4f}"
        told = f"{n.name} of {where}: {n.value:.4f} of what is stated ({interval}), pull {n.pull:+.1f}"
        lines += textwrap.wrap(told, 100)
    return "\n".join(lines)


__all__ = ["Check", "Comparison", "Nuisance", "canonical", "compare", "table"]
