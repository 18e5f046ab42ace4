"""Results of `diagnose` and `fit`: steps, verdict, error budget; as JSON, for a terminal, for the next sensor file."""

from __future__ import annotations

import dataclasses
import datetime
import json
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import units
from ..effects import Effect, Mimic
from ..foreign import visible
from ..statistics import Statistic, Summary
from .candidates import Candidate
from .comparison import Comparison, words_in_sample
from .coordinates import Coordinate, Key
from .deviations import LISTED, listed
from .replicates import Cell

if TYPE_CHECKING:
    from .pixel_maps import PixelMap

# the values of a map, by name, in words
OF_A_MAP = {
    "sigma": "relative spread of the bulk of the pixels",
    "low_fraction": "share of pixels that lie far below all others, or those around them",
    "low_ratio": "mean of the low ones, relative to what they are compared with",
    "high_fraction": "share of pixels that lie far above all others, or those around them",
}
NONLINEARITY = "a nonlinearity of the sensor that no effect here has"  # words of verdicts and advice
# what remains, in words, by what a statistic compares (`Statistic.among`)
_WHO = {
    "far": "it is correlated between distant pixels",
    "neighbours": "it is correlated between neighbouring pixels",
    "pixel": "it stays within a pixel",
    "array": "it is common to the whole array",
}


def plain(value: float) -> float:
    """A finite number of six digits."""
    return float(f"{min(max(value, -1e300), 1e300):.6g}")


def columns(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """The lines of a table, its columns aligned."""
    rows = [tuple(map(visible, row)) for row in rows]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]


@dataclass(frozen=True)
class Value:
    """A fitted value with its 95 % confidence interval, in SI units.

    Attributes:
        value: the estimate.
        low, high: the ends of the interval; None where there is none.
        unit: of all three, such as "s" or "Hz"; "" for a pure number.
        method: of a fit, how it was estimated: "likelihood" (exact), "simulation", "counts" or "intervals" (of maps),
            or the name of the statistic that informs a map; "" in a diagnosis.
    """

    value: float
    low: float | None
    high: float | None
    unit: str = ""
    method: str = ""

    def as_data(self) -> dict[str, Any]:
        """Value, ends of its interval, unit and method, for JSON."""
        out: dict[str, Any] = {"value": plain(self.value)}
        if self.low is not None and self.high is not None:
            out |= {"low": plain(self.low), "high": plain(self.high)}
        return out | {"unit": self.unit} | ({"method": self.method} if self.method else {})


@dataclass
class Step:
    """A change of the model that was accepted, with its fitted values.

    Attributes:
        values: the fitted values by name, each a `Value`. The names are those of the parameters. Of a map they are
            statistics of its values over the pixels: `sigma` (relative spread of the bulk), `low_fraction` and
            `high_fraction` (shares of pixels far below and far above all others, or those around them), `low_ratio`
            (mean of the low ones, relative to what they are compared with).
        misfit: of the model with this step, on held-out captures: mean squared standardised residual, 1 for a right
            model.
        significance: of the improvement, in standard deviations.
        material: the change of the mean rate, in words.
        alternatives: other changes that explain the same residuals. Each has `change`, `effect`, `parameter` and
            `misfit`; `effect` is None where no effect describes it, and `what` says what it is.
        in_sensor: False where the next sensor does not have it, because the set-up explains the totals as well.
    """

    candidate: Candidate
    values: dict[str, Value]
    misfit: float
    significance: float
    material: str
    alternatives: list[dict[str, Any]] = field(default_factory=list)
    coordinates: tuple[Coordinate, ...] = ()
    phased: bool = False  # it has a phase in each capture
    chips: bool = False  # it affects random pixels, which differ from replicate to replicate
    fluctuates: bool = False  # its totals scatter far more than those of the model without it
    # 95 % intervals of coordinates that the fit does not hold, by (effect, parameter), SI
    intervals: dict[Key, tuple[float, float]] = field(default_factory=dict)
    # (cells,) by block, under the model before it: its expected residuals, and the residuals of the data
    template: dict[Cell, np.ndarray] = field(default_factory=dict, repr=False)
    before: dict[Cell, np.ndarray] = field(default_factory=dict, repr=False)
    # (cells, coordinates) by block, where the effect is faint
    jacobian: dict[Cell, np.ndarray] = field(default_factory=dict, repr=False)
    map: PixelMap | None = field(default=None, repr=False)  # of a candidate per pixel, row, column or code
    hit: np.ndarray | None = field(default=None, repr=False)  # (pixels,) bool: which ones an effect has hit at random
    on_rough_fit: bool = False  # it was added to a model whose numbers were not all fitted together
    in_sensor: bool = True

    @property
    def change(self) -> str:
        """What kind of change: "add" (an effect that the model lacks), "set" (another value) or "per_pixel" (a map)."""
        return self.candidate.kind

    @property
    def effect(self) -> str:
        """The name of the effect."""
        return self.candidate.effect

    @property
    def parameter(self) -> str | None:
        """The name of the parameter that has another value or a map; None where an effect is added."""
        return self.candidate.parameter

    @property
    def where(self) -> str:
        """In how many pixels an effect that hits pixels at random was detected, as text; "" for all other steps."""
        if self.hit is None:
            return ""
        return f"detected in {self.hit.sum():,} of {self.hit.size:,} pixels, which the sensor file contains"

    def __repr__(self) -> str:
        numbers = ", ".join(f"{name} {shown(v)}" for name, v in self.values.items())
        return f"<{title(self.candidate)}: {numbers}>" if numbers else f"<{title(self.candidate)}>"

    def as_data(self) -> dict[str, Any]:
        """The step as an entry of `steps` in the JSON data."""
        return {
            "change": self.change,
            "effect": self.effect,
            "parameter": self.parameter,
            "values": {name: v.as_data() for name, v in self.values.items()},
            "misfit": plain(self.misfit),
            "significance": plain(self.significance),
            "material": self.material,
            "alternatives": self.alternatives,
        } | ({} if self.in_sensor else {"in_sensor": False})


@dataclass(frozen=True)
class Trace:
    """A check before and after, for a picture.

    Attributes:
        size: of its clearest deviation from the first model, in words; where: that cell; worst: its number. Of a check
            of several cells together (a contrast), the cell that stands for them.
        deviation: the number of its group (`deviations`), 0 the clearest; first: it names the group.
        step: the number of the step that moves it most, None where none does.
        before, after: (cells,) the expectation of each model.
        spread: (cells,) the scatter of the last model.
        residuals_before, residuals_after: (cells,).
    """

    statistic: str
    capture: str
    summary: Summary
    before: np.ndarray
    after: np.ndarray
    spread: np.ndarray
    residuals_before: np.ndarray
    residuals_after: np.ndarray
    where: str = ""
    size: str = ""
    deviation: int = 0
    first: bool = True
    step: int | None = None
    worst: int | None = None


@dataclass
class Diagnosis:
    """The result of `diagnose` or `fit`; see `formats`."""

    sensor: str
    measurement: str
    verdict: str
    before: float
    after: float
    null_95: float
    nuisances: list[dict[str, Any]]
    steps: list[Step]
    setup: list[dict[str, Any]]
    unexplained: list[dict[str, Any]]
    ladder: list[dict[str, Any]]
    advice: list[dict[str, Any]]
    excluded: list[dict[str, Any]]
    invisible: list[dict[str, Any]] = field(default_factory=list)
    unlimited: list[dict[str, Any]] = field(default_factory=list)  # effects without a finding and without a limit
    traces: list[Trace] = field(default_factory=list, repr=False)
    values: dict[Key, Any] = field(default_factory=dict, repr=False)
    file: str | None = None
    simulations: int = 0
    dark: list[str] = field(default_factory=list)  # captures without light
    crop: str | None = None  # the part of the sensor that was measured: rows, columns
    untried: list[dict[str, Any]] = field(default_factory=list)  # candidates that cannot be simulated
    # (names "effect.parameter" of the fitted parameters, their covariance in SI) of a fit
    covariance: tuple[list[str], np.ndarray] = field(default_factory=lambda: ([], np.zeros((0, 0))), repr=False)
    asked: str = "diagnosis"  # or "fit"
    in_sample: Comparison | None = field(default=None, repr=False)  # of the model with all steps, to all captures
    finished: bool = True  # False: a budget ended it, and the verdict is that of what was done
    shape: tuple[int, int] | None = None  # rows, columns of the measured pixels
    unwritten: str = ""  # why there is no next sensor file where one was wanted
    compared: str = ""  # what alone was compared with the model, in words; "" for all statistics
    stopped: bool = False  # the largest number of steps ended the search
    or_setup: bool = False  # the last step explains the totals as well as `setup` does, and is in no sensor file
    shared: tuple[str, ...] = ()  # captures whose wrong level that step needs as well
    faulty: str = ""  # in words, the captures of which the set-up explains the totals
    bent: bool = False  # a nonlinearity that no effect here has may explain them as well

    def as_data(self) -> dict[str, Any]:
        """The result as JSON data: `formats`, spadmnist-diagnosis/1 or spadmnist-fit/1."""
        return {
            "format": f"spadmnist-{self.asked}/1",
            "verdict": self.verdict,
            "finished": self.finished,
            **({"crop": self.crop} if self.crop else {}),
            "misfit": {"before": plain(self.before), "after": plain(self.after)},
            "misfit_in_sample": None if self.in_sample is None else plain(self.in_sample.misfit),
            "misfit_null_95": plain(self.null_95),
            "nuisances": self.nuisances,
            "steps": [step.as_data() for step in self.steps],
            "setup": self.setup,
            "unexplained": self.unexplained,
            "ladder": self.ladder,
            "advice": self.advice,
            "excluded": self.excluded,
            "not_identifiable": self.invisible,
            "no_limit": self.unlimited,
            "not_tried": self.untried,
            "sensor": self.file,
            **({"not_written": self.unwritten} if self.unwritten else {}),
            **({"compared": self.compared} if self.compared else {}),
        }


def title(candidate: Candidate) -> str:
    """The name of a candidate: of the effect, or of the parameter."""
    if candidate.kind == "add":
        return candidate.effect
    return f"{candidate.effect}.{candidate.parameter}" + (" per pixel" if candidate.kind == "per_pixel" else "")


def mechanism(found: Sequence[Mapping[str, Any]], dark: Sequence[str]) -> str:
    """One sentence on the kind of mechanism that remains unexplained.

    Args:
        found: the entries of what remains.
        dark: captures without light.
    """
    kinds = {Statistic.registry.find(str(r["statistic"])).among for r in found if r["statistic"] in Statistic.registry}
    who = next((words for kind, words in _WHO.items() if kind in kinds), "it is in the rates and maps")
    if not dark:
        return who
    in_dark, in_light = (any((r["capture"] in dark) is side for r in found) for side in (True, False))
    lit = "it is in the dark captures, too" if in_dark else "it is in the lit captures alone"
    return f"{who}; {lit if in_light else 'it is in the dark captures'}"


def mimic(candidate: Candidate) -> Mimic | None:
    """The mimic of a candidate: what no effect describes and has the same signature; None where none is known."""
    if candidate.effect not in Effect.registry or candidate.kind == "set":
        return None
    effect = Effect.registry.find(candidate.effect)
    return effect.mimic if candidate.kind == "add" else effect.mimic_of_map


def canonical(found: Diagnosis) -> str:
    """The result as JSON text."""
    return json.dumps(found.as_data(), indent=1, allow_nan=False)


def table(found: Diagnosis) -> str:
    """The result as text for a terminal: the verdict, the steps, the ladder."""
    lines = [*textwrap.wrap(opening(found, found.verdict.upper().replace("_", " ")), 100), ""]
    for number, step in enumerate(found.steps, 1):
        words = {name: f"{about}:" for name, about in OF_A_MAP.items()} if step.candidate.carrier else {}
        parts = [f"{words.get(name, name)} {shown(v)}" for name, v in told(step)]
        text = f"{number}. {title(step.candidate)}: {', '.join(parts)}; {step.significance:.1f} sigma, {step.material}"
        text += "".join(sorted({f", by {v.method}" for v in step.values.values() if v.method}))
        text += f"; {step.where}" if step.where else ""
        lines += textwrap.wrap(text, 100, subsequent_indent="   ")
        but = mimic(step.candidate)
        lines += textwrap.wrap(str(but or ""), 100, initial_indent="   But: ", subsequent_indent="   ")
    for entry in found.setup:
        f = entry["factor"]
        where = entry["capture"] or "all"
        either = " (or)" if entry["confused"] else ""
        lines.append(
            f"set-up{either}: {entry['quantity']} of {where} x {units.factor(f['value'])} "
            f"(95 % interval {units.factor(f['low'])} to {units.factor(f['high'])})"
        )
    if found.steps or found.setup:
        lines.append("")
    if found.in_sample is not None:
        lines += [*textwrap.wrap(words_in_sample(found.in_sample), 100), ""]
    names = dict.fromkeys(("mean_rate", "map", "linearity", "intervals", "neighbours"))
    names |= dict.fromkeys(name for row in found.ladder for name in row["errors"])  # of the user's own statistics
    rows: list[tuple[str, ...]] = [("model", "held-out misfit", *(n.replace("_", " ") + " %" for n in names))]
    for row in found.ladder:
        rows.append((row["model"], f"{row['misfit']:.3f}", *(error_of(row, n) for n in names)))
    rows.append(("noise floor (95 %)", f"{found.null_95:.3f}", *("" for _ in names)))
    lines += columns(rows)
    if found.unexplained:
        lines += ["", "What remains, the clearest first:"]
        groups = remaining(found)
        for k, (first, *others) in enumerate(groups[:LISTED], 1):
            text = f"{_found_in(first)} ({first['statistic']}, {first['significance']:.1f} sigma)"
            lines += textwrap.wrap(text, 100, initial_indent=f"{k:>3}. ", subsequent_indent="     ")
            if others:
                also = f"also in {listed((r['statistic'], r['capture']) for r in others)}"
                lines += textwrap.wrap(also, 100, initial_indent="     ", subsequent_indent="     ")
        if len(groups) > LISTED:
            lines.append(f"... and {len(groups) - LISTED} more (--json FILE or the report holds them)")
        near = nearest(found)
        if near:
            text = f"Nearest, but it explains too little of its own cells: {', '.join(near)}."
            lines += textwrap.wrap(text, 100)
    for one in found.advice:
        text = (
            f"To separate {' from '.join(one['separates'])}: take {one['capture']} "
            f"(now {one['significance_now']:.1f} sigma, then {one['significance_then']:.1f})."
        )
        lines += ["", *textwrap.wrap(text, 100)]
    if found.excluded:
        lines += ["", "Not found; 95 % upper limits:"]
        about = [f"{e['effect']}.{e['parameter']} {_limit(e)}" for e in found.excluded]
        lines += textwrap.wrap("; ".join(about), 100, initial_indent="  ", subsequent_indent="  ")
    if found.invisible:
        about = [e["effect"] for e in found.invisible]
        lines += textwrap.wrap(f"This measurement cannot show: {', '.join(about)}.", 100)
    if found.unlimited:
        about = [e["effect"] for e in found.unlimited]
        lines += textwrap.wrap(f"Tried and not found, without a limit: {', '.join(about)}.", 100)
    if found.untried:
        lines += ["", "Not tried:"]
        for e in found.untried:
            text = ", ".join(filter(None, (named(e), str(e["where"])))) + f": {e['why']}"
            lines += textwrap.wrap(text, 100, initial_indent="  ", subsequent_indent="    ")
    if found.unwritten:
        lines += ["", *textwrap.wrap(f"The next sensor file was not written: {found.unwritten}", 100)]
    return "\n".join(lines)


def error_of(row: Mapping[str, Any], name: str) -> str:
    """A physical error of a row of the ladder in per cent; "-" where it was not measured."""
    error = row["errors"].get(name)
    return "-" if error is None else f"{100 * error:.3f}"


def remains(found: Diagnosis) -> str:
    """The clearest deviation that remains, in physical words; "" where nothing does."""
    if not found.unexplained:
        return ""
    first = found.unexplained[0]
    size = "" if first.get("size") else f" ({first['significance']:.1f} sigma)"
    return f"{_found_in(first)}{size} ({first['statistic']})"


def _found_in(entry: Mapping[str, Any]) -> str:
    """Where a check that fails deviates most, in which capture, and by how much, where that has a size."""
    size = f": {entry['size']}" if entry.get("size") else ""
    return f"{entry['where']}, in {entry['capture'] or 'all captures'}{size}"


def remaining(found: Diagnosis) -> list[list[dict[str, Any]]]:
    """The checks that still fail, by the deviation they show: in each group the one that names it first."""
    groups: dict[Any, list[dict[str, Any]]] = {}
    for k, entry in enumerate(found.unexplained):
        groups.setdefault(entry.get("deviation", -k), []).append(entry)
    return list(groups.values())


def nearest(found: Diagnosis) -> list[str]:
    """The names of the candidates that resemble what remains, and explain too little of it."""
    return [named(other) for entry in found.unexplained[:1] for other in entry.get("alternatives", [])]


def named(entry: Mapping[str, Any]) -> str:
    """The name of a candidate in the JSON data, as `title` has it; "" for none."""
    if entry["effect"] is None:
        return ""
    name = str(entry["effect"]) + (f".{entry['parameter']}" if entry["parameter"] else "")
    return name + (" per pixel" if entry["change"] == "per_pixel" else "")


def shown(v: Value) -> str:
    """A value with its unit and its interval as text."""
    text = units.show(v.value, v.unit) if v.unit else f"{v.value:.4g}"
    if v.low is not None and v.high is not None:
        ends = [units.show(x, v.unit) if v.unit else f"{x:.4g}" for x in (v.low, v.high)]
        text += f" ({ends[0]} to {ends[1]})"
    return text


def _limit(entry: Mapping[str, Any]) -> str:
    unit = Effect.registry.find(entry["effect"]).parameters[entry["parameter"]].unit
    limit = units.show(entry["upper_limit_95"], unit, 2) if unit else f"{entry['upper_limit_95']:.2g}"
    return f"{limit} (at least)" if entry.get("at_least") else limit


def told(step: Step) -> list[tuple[str, Value]]:
    """The fitted values of a step that people are told: of a map without low pixels, not how low these are."""
    none_low = "low_fraction" in step.values and step.values["low_fraction"].value == 0
    return [(name, v) for name, v in step.values.items() if not (none_low and name == "low_ratio")]


def opening(found: Diagnosis, verdict: str) -> str:
    """How an answer begins: with the verdict and its sentence; with NOT FINISHED where a budget ended the search.

    Args:
        verdict: as it is written there.
    """
    begun, _, rest = sentence(found).partition(": ")
    if found.finished:
        return f"{verdict}: {sentence(found)}"
    begun = begun.replace("not finished", "NOT FINISHED", 1)
    return f"{begun}: {rest}" if begun == "NOT FINISHED" else f"{begun}: {verdict}: {rest}"


def sentence(found: Diagnosis) -> str:
    """The verdict in words."""
    if found.compared:
        return f"{_verdict_on(found)} Only {found.compared} were compared with the model, no other statistic."
    return _verdict_on(found)


def _verdict_on(found: Diagnosis) -> str:
    if not found.finished and found.verdict == "unexplained":
        what = f" What differs: {remains(found)}." if found.unexplained else ""
        fitted = " and ".join(title(s.candidate) for s in found.steps)
        so_far = f"the rest was explained; fitted so far: {fitted}" if fitted else "an explanation was found"
        return f"not finished: the budget ended before {so_far}.{what}"
    if not found.finished and found.verdict == "adequate" and not found.steps:
        ended = ", ".join(str(e["where"]) for e in found.untried if e["effect"] is None)
        return f"not finished: no check fails; the budget ended before all was done: {ended}."
    if not found.finished:
        so_far = "the verdict is that of the steps so far" if found.steps else "so far"
        return f"not finished; {so_far}: {_verdict_on(dataclasses.replace(found, finished=True))}"
    fitted = " and ".join(title(s.candidate) for s in found.steps)
    if found.verdict == "adequate" and found.steps:
        return f"{fitted}: fitted. No check failed before, and none fails now."
    if found.verdict == "adequate":
        return "nothing is missing that this measurement could show."
    if found.verdict == "setup":
        return "the set-up explains the deviations; nothing here asks for a change of the sensor."
    if found.verdict == "explained":
        either = f"{found.faulty}, or {NONLINEARITY}," if found.bent else found.faulty
        totals = f", and the set-up of {either} those of the totals" if found.faulty else ""
        return f"{fitted} explain{'s' if len(found.steps) == 1 else ''} the deviations of the model{totals}."
    if found.verdict == "confused" and found.setup and not found.steps:
        where = found.setup[0]["capture"] or "all captures"
        return f"the set-up of {where}, or {NONLINEARITY}: it is the brightest capture."
    if found.verdict == "confused" and found.or_setup:
        *earlier, last = [title(s.candidate) for s in found.steps]
        either = f"the {found.setup[0]['quantity']} of {found.setup[0]['capture'] or 'all captures'}, or {last}"
        if " and " in found.faulty:
            either = f"the set-up of {found.faulty}, or {last}"
        if found.shared:
            either += f" with the set-up of {' and '.join(found.shared)}"
        besides = f"; besides, {' and '.join(earlier)} was found" if earlier else ""
        return f"{either}: each explains the totals, and the sensor file has neither{besides}."
    if found.verdict == "confused":
        return f"{fitted}, or another effect with the same signature in this measurement."
    if found.verdict == "partly_explained":
        what = remains(found)
        rest = f"What remains: {what}." if what else "Some checks still fail."
        rest += " The search ended at its largest number of steps." if found.stopped else ""
        return f"{fitted} {'explains' if len(found.steps) == 1 else 'explain'} a part of the deviations. {rest}"
    what = f": {remains(found)}" if found.unexplained else ""
    return f"no known effect explains what differs{what}. {mechanism(found.unexplained, found.dark).capitalize()}."


def notes(found: Diagnosis) -> dict[Key, str]:
    """The comments on the new lines of the next sensor file, by (effect, parameter): data and 95 % intervals."""
    out: dict[Key, str] = {}
    today = datetime.date.today().isoformat()
    for step in found.steps:
        parts = []
        for name, v in step.values.items():
            if v.low is not None and v.high is not None:
                ends = [units.show(x, v.unit) if v.unit else f"{x:.4g}" for x in (v.low, v.high)]
                parts.append(f"{name} {ends[0]} to {ends[1]} (95 %)")
        part = f" of rows and columns {found.crop}" if found.crop else ""
        text = f"from {found.measurement}{part}, {today}" + (f": {', '.join(parts)}" if parts else "")
        changed = step.candidate
        keys = [key for key in found.values if key[0] == changed.effect]
        if changed.kind != "add":  # another step may have changed another number of the same effect
            own = changed.carrier[1] if changed.carrier else changed.parameter
            keys = [key for key in keys if key[1] == own]
        for key in keys:
            out[key] = text
    return out
