"""The comparison of a model with a measurement: residuals and p-values of every statistic of every capture.

The model simulates each capture many times (`replicates`) at a light level that gives as many detections as were
measured. A check fails where the measured summary lies outside the model's own scatter. The p-values are corrected
for the number of checks (Holm), so that a right model fails once in a hundred comparisons. A separate check tests
whether the light levels agree with the stated ones, within their uncertainty.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from .. import golden
from ..errors import InputError
from ..measurement import Measurement
from ..sensor import Sensor
from ..workers import Executor, executor
from .candidates import with_values
from .captures_together import Together, checks_together
from .checks import Check, holm
from .coordinates import Values
from .deviations import LISTED, Deviation, deviations, excess, listed
from .evaluation import Evaluation, faint_captures, mean_misfit, misfit_null_95, misfits
from .levels import FALSE_ALARM, LEAST_P, SHARES
from .light_checks import level_checks, light_of, ratios_between_wavelengths
from .light_levels import Nuisance
from .phases import evaluate_start
from .replicates import REPLICATES, TOTALS, Cell, Execution, Replicates
from .totals_tests import Level


@dataclass(frozen=True)
class Comparison:
    """The result of `compare`.

    Attributes:
        verdict: "adequate" or "fails".
        misfit: the mean over the blocks; misfit_null_95: its 95 % quantile under the null.
        misfit_in_sample: the same number, for no capture is left out.
        replicates: of each capture.
        tolerance: relative; None for none.
        false_alarm_rate: probability that a right model fails.
        crop: the part of the sensor that was measured: rows, columns; None for all of it.
        full: the captures of which nearly every frame or counter is full: they test hardly anything.
        faint: those with so few expected detections that only the total is compared.
        not_compared: (statistic, capture) of what the measurement has and some simulations have too few data for.
    """

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
    crop: str | None = None
    full: tuple[str, ...] = ()
    faint: tuple[str, ...] = ()
    not_compared: tuple[tuple[str, str], ...] = ()

    @property
    def failing(self) -> list[Check]:
        """The failing checks, each a `Check`, the one with the smallest p-value first."""
        return sorted((c for c in self.checks if not c.passes), key=lambda c: (c.p_value, -c.misfit))

    @property
    def deviations(self) -> list[list[Check]]:
        """The failing checks in groups, the clearest group first.

        All checks of a group show the same deviation. Its first check is the one that says most of it.
        """
        failing = self.failing
        passing = {(c.capture, c.statistic) for c in self.checks if c.passes}
        return [[failing[i] for i in members] for members in deviations([_deviation(c) for c in failing], passing)]

    @property
    def worst(self) -> Check:
        """The check that names the clearest deviation; where none fails, that with the smallest p-value."""
        groups = self.deviations
        return groups[0][0] if groups else min(self.checks, key=lambda c: (c.p_value, -c.misfit))

    def as_data(self) -> dict[str, Any]:
        """The answer as the data of its JSON, format `spadmnist-comparison/1`."""
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
            "not_compared": [{"statistic": name, "capture": id} for name, id in self.not_compared],
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


def _deviation(check: Check) -> Deviation:
    """A check as its group needs it; of a total the excess is that of its p-value."""
    beyond = check.excess or float(stats.norm.isf(max(check.p_value, LEAST_P) / 2)) ** 2
    worst, where, residuals, at = 0, check.where, np.zeros(0), None
    if check.judgement is not None and check.summary is not None:
        worst, residuals, axis = check.judgement.worst, check.judgement.residuals, check.summary.axis
        where = check.summary.where(worst)  # the place alone
        at = None if axis is None or check.summary.shape is not None else float(axis[worst])
    return Deviation(
        statistic=check.statistic,
        capture=check.capture,
        excess=beyond,
        worst=worst,
        where=where,
        size=check.relative,
        residuals=residuals,
        at=at,
    )


def _plain(value: float) -> float:
    """A finite number of six digits."""
    return float(f"{min(max(value, -1e300), 1e300):.6g}")


def compare(
    sensor: Sensor,
    measurement: Measurement,
    seed: int = 0,
    tolerance: float | None = None,
    jobs: int | Executor = 2,
    replicates: int = REPLICATES,
    progress: Callable[[str, float], None] | None = None,
    say: Callable[[str], None] = lambda what: None,
) -> Comparison:
    """The goodness of fit of a model to a measurement: every statistic of every capture, and the light levels.

    Args:
        sensor: the model.
        seed: of the replicates.
        tolerance: a failing check with a smaller relative deviation passes, as not material.
        jobs: number of workers of this machine, or an executor.
        replicates: of each capture.
        progress: called with the name of a capture and the share of the work that is done.
        say: called with a line where fewer workers are used than there are.
    Raises:
        InputError: where sensor and measurement do not belong together, nothing can be compared, or a replicate of a
            capture takes too much memory.
    """
    with executor(jobs) as workers:
        workers.greet(golden.answer, None)
        by = Execution(workers, say, progress or (lambda capture, share: None))
        simulations = Replicates(sensor, measurement, seed, by, replicates)
        evaluation, _ = evaluate_start(simulations)
        return comparison_of(simulations, evaluation, tolerance)


def comparison_with(replicates: Replicates, values: Values, number: int | None = None) -> Comparison:
    """The comparison of the sensor with these parameters, as `compare` compares the next sensor file: in sample.

    Args:
        replicates: of the stated model; `compare` has as many of each capture unless the search is a quick one.
        values: by (effect, parameter), SI.
        number: of replicates of each capture; by default as many as the search has.
    """
    own = replicates.of_model(with_values(replicates.start, values), number)
    evaluation, _ = evaluate_start(own)
    replicates.simulations += own.simulations
    return comparison_of(own, evaluation)


def comparison_of(replicates: Replicates, evaluation: Evaluation, tolerance: float | None = None) -> Comparison:
    """The checks of an evaluation, with Holm's correction.

    Args:
        tolerance: see `compare`.
    Raises:
        InputError: where nothing can be compared.
    """
    checks: list[Check] = []
    levels: list[Level] = []
    of_cells = misfits(evaluation.replicate_residuals, evaluation.residuals)
    alone = {cell: evaluation.judgements[cell].p_value for cell in evaluation.residuals if cell != TOTALS}
    together: dict[Cell, list[Together]] = {}
    for one in checks_together(replicates, evaluation, evaluation.residuals, alone):
        together.setdefault(one.clearest, []).append(one)
    for id, seen in replicates.seen.items():
        checks += level_checks(replicates.start, seen.counted, seen.total, evaluation.rates[id], levels)
        for name, summary in seen.summaries.items():
            judged = evaluation.judgements.get((id, name))
            if judged is not None:
                here = together.get((id, name), [])
                least = min(here, key=lambda one: one.p, default=None)
                if least is not None and least.p >= judged.p_value:
                    least = None
                if least is not None:
                    judged = replace(judged, p_value=least.p, worst=least.worst, contrast=least.contrast)
                measured, expected = float(summary.values[judged.worst]), float(judged.expected[judged.worst])
                text, relative = summary.size(judged.worst, measured, expected)
                misfit = of_cells.get((id, name), judged.misfit)
                where = summary.place(judged.worst, judged.contrast)
                p = max(judged.p_value, LEAST_P)
                beyond = excess(summary, judged.expected, judged.residuals)
                if least is not None:
                    where, beyond = where + least.words, max(beyond, least.excess)
                    relative = _relative(replicates, evaluation, least)
                own = Check(
                    statistic=name,
                    capture=id,
                    misfit=misfit,
                    p_value=p,
                    where=where,
                    size=text,
                    relative=relative,
                    excess=beyond,
                    summary=summary,
                    judgement=judged,
                )
                checks.append(replace(own, tests=1 + len(here)))
    captures = [seen.capture for seen in replicates.seen.values()]
    nuisances, common = light_of(levels, captures)
    checks += common
    checks += ratios_between_wavelengths(captures, checks, evaluation.replicate_residuals)
    if not checks:
        raise InputError(nothing_to_compare(replicates))
    checks = holm_corrected([replace(c, p_value=max(c.p_value, LEAST_P)) for c in checks], tolerance)
    sensor = replicates.start
    faint = [id for id in replicates.seen if id in faint_captures(replicates)]
    return Comparison(
        sensor=sensor.name,
        measurement=replicates.measurement.name,
        verdict="adequate" if all(c.passes for c in checks) else "fails",
        misfit=mean_misfit(evaluation.replicate_residuals, evaluation.residuals),
        misfit_null_95=misfit_null_95(evaluation.replicate_residuals),
        nuisances=tuple(nuisances),
        checks=tuple(checks),
        replicates=len(evaluation.replicate_residuals[TOTALS]),
        tolerance=tolerance,
        crop=str(sensor.window) if sensor.window else None,
        full=tuple(id for id, seen in replicates.seen.items() if seen.is_full(sensor)),
        faint=tuple(faint),
        not_compared=tuple(
            (name, id)
            for id, seen in replicates.seen.items()
            for name in seen.summaries
            if id in evaluation.made and id not in faint and (id, name) not in evaluation.nulls
        ),
    )


def _relative(replicates: Replicates, evaluation: Evaluation, check: Together) -> float:
    """The relative deviation of several captures together: the mean of those that deviate alike, or the clearest.

    Contrasts may be of captures with other numbers of cells, in which `worst` is no place: these are left out.
    """
    sizes, number = [], len(evaluation.judgements[check.clearest].expected)
    for cell in check.cells if check.alike else check.cells[:1]:
        if len(evaluation.judgements[cell].expected) != number:
            continue
        summary, expected = replicates.seen[cell[0]].summaries[cell[1]], evaluation.judgements[cell].expected
        sizes.append(summary.size(check.worst, float(summary.values[check.worst]), float(expected[check.worst]))[1])
    return float(np.mean(sizes))


def nothing_to_compare(replicates: Replicates) -> str:
    """The sentence on a measurement of which nothing says whether a model is right."""
    return (
        f"{replicates.measurement.source}: nothing here can be compared: of no capture are light and detections "
        "known. State the light (irradiance or illuminance) of a capture, or name the file of one"
    )


def holm_corrected(checks: Sequence[Check], tolerance: float | None) -> list[Check]:
    """The checks with Holm's correction applied: which of them are significant, material, and fail."""
    # the light, the totals and the statistics have a share each of the false alarms, so that a wrong power meter is
    # not lost among a hundred statistics
    kinds = [c.statistic if c.statistic in SHARES else "" for c in checks]
    failing = holm([c.p_value for c in checks], kinds, [c.tests for c in checks], FALSE_ALARM)
    out = []
    for i, check in enumerate(checks):
        material = i in failing and (tolerance is None or not abs(check.relative) < tolerance)
        out.append(replace(check, passes=not material, material=material, significant=i in failing))
    return out


def canonical(comparison: Comparison) -> str:
    """The result as JSON text."""
    return json.dumps(comparison.as_data(), indent=1, allow_nan=False)


def headline(comparison: Comparison) -> str:
    """The worst check with its physical size as text; the misfit may be blind to it."""
    c = comparison.worst
    passed = "within the tolerance" if c.significant and c.passes else "passes" if c.passes else "fails"
    p = f"p = {c.p_value:.1g}, {passed}"
    return f"{found_in(c)} ({c.statistic}, {p})"


def words_in_sample(comparison: Comparison) -> str:
    """The misfit of a fitted model in all captures, and its worst check, as a sentence."""
    return f"In sample, misfit {comparison.misfit:.3f}; worst check: {headline(comparison)}."


def found_in(check: Check) -> str:
    """Where a check deviates most, in which capture, and by how much."""
    return f"{check.where}, in {check.capture or 'all captures'}: {check.size}"


def others_of(group: Sequence[Check]) -> str:
    """The checks behind the first of a group as text, "multiplicity of flat and dark; spacing of flat"."""
    return listed((check.statistic, check.capture) for check in group[1:])


def table(comparison: Comparison) -> str:
    """The result as text for a terminal, at most 100 characters wide: verdict, failing checks, light."""
    failing, groups, number = comparison.failing, comparison.deviations, len(comparison.checks)
    lines = []
    beyond = "" if comparison.tolerance is None else f" beyond the tolerance of {100 * comparison.tolerance:g} %"
    if failing:
        text = f"The model fails {len(failing)} of {number} checks{beyond}: {headline(comparison)}."
        lines += textwrap.wrap(text, 100)
        if len(failing) > 1:
            lines.append("")
        if len(groups) == 1 and len(failing) > 1:
            lines += textwrap.wrap(f"The same deviation is in {others_of(groups[0])}.", 100)
        elif len(groups) > 1:
            lines += [f"{len(groups)} deviations, the clearest first:", ""]
        for k, group in enumerate(groups[:LISTED] if len(groups) > 1 else [], 1):
            first, also = group[0], others_of(group)
            text = f"{found_in(first)} ({first.statistic}, p = {first.p_value:.1g})"
            lines += textwrap.wrap(text, 100, initial_indent=f"{k:>3}. ", subsequent_indent="     ")
            if also:
                lines += textwrap.wrap(f"also in {also}", 100, initial_indent="     ", subsequent_indent="     ")
        if len(groups) > LISTED:
            lines.append(f"... and {len(groups) - LISTED} more (--json FILE or -o REPORT holds all)")
    else:
        lines.append(f"The model is adequate: none of {number} checks fails{beyond}.")
        more = sum(check.significant for check in comparison.checks)
        if more:
            lines.append(
                f"{more} differ{'s' if more == 1 else ''} by more than chance, and by less than the tolerance."
            )
        closest = sorted(comparison.checks, key=lambda c: c.p_value)[1:3]
        near = ", ".join(f"{c.statistic} of {c.capture or 'all captures'} (p = {c.p_value:.2g})" for c in closest)
        text = f"Worst check: {headline(comparison)}" + (f"; then {near}." if near else ".")
        lines += textwrap.wrap(text, 100)
    lines.append("")
    about = (
        f"Misfit {comparison.misfit:.4g} (1: the model's own scatter; 95 % of its recordings stay below "
        f"{comparison.misfit_null_95:.4g}); {comparison.replicates} simulations of each capture; a right model is "
        f"called wrong in {100 * comparison.false_alarm_rate:.0f} % of comparisons."
    )
    lines += textwrap.wrap(about, 100)
    if comparison.not_compared:
        missing = listed((name, id) for name, id in comparison.not_compared)
        lines += textwrap.wrap(f"Not compared, for some simulations have too few data: {missing}.", 100)
    for n in comparison.nuisances:
        where = n.capture or "all lit captures"
        interval = f"95 % interval {n.low:.4f} to {n.high:.4f}"
        text_of_light = f"{n.name} of {where}: {n.value:.4f} times the stated level ({interval}), pull {n.pull:+.1f}"
        lines += textwrap.wrap(text_of_light, 100)
    return "\n".join(lines)
