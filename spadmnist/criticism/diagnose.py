"""Diagnose: which physical effect does a model lack? Add it, settle it, watch the error fall.

Only where a model fails (as `compare` judges) are candidates tried: every registered effect that it lacks, every
listed number at another value, every map (`candidates`). A few simulated recordings tell what each would change; those
that come closest are settled (`fit`), the best is added, and so on until nothing is left.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from joblib import Parallel
from scipy import stats

from ..errors import InputError, SpadError
from ..measurement import Measurement
from ..sensor import Sensor
from . import compare as comparing
from . import fit, mapping, recordings
from .candidates import Change, Key, changes, templates, with_values
from .fit import RATES, Bench, Cell, Moved, Sensors, Settled, State, stacked

_SCAN = 3  # recordings of each capture for a first look
_SECOND = 6  # candidates that are looked at again
_REFINED = 3  # of these, that are settled
_TIMES = (0.03, 0.1, 0.3, 0.6, 1.0, 1.7, 3.0, 6.0, 10.0)
_LEAST_P = 1e-300
_AGAIN = 2  # times that the numbers are settled anew beside the model with the effect


def _plain(value: float) -> float:
    """A finite number of six digits."""
    return float(f"{min(max(value, -1e300), 1e300):.6g}")


def _columns(rows: Sequence[tuple[str, ...]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]


@dataclass(frozen=True)
class Value:
    """A settled value with its 95 % interval, SI."""

    value: float
    low: float | None
    high: float | None
    unit: str = ""

    def as_data(self) -> dict[str, Any]:
        out: dict[str, Any] = {"value": _plain(self.value)}
        if self.low is not None and self.high is not None:
            out |= {"low": _plain(self.low), "high": _plain(self.high)}
        return out | {"unit": self.unit}


@dataclass
class Step:
    """An accepted change, as `formats` has it."""

    change: Change
    values: dict[str, Value]
    misfit: float
    significance: float
    material: str
    alternatives: list[dict[str, Any]] = field(default_factory=list)
    template: dict[Cell, np.ndarray] = field(default_factory=dict, repr=False)
    before: dict[Cell, np.ndarray] = field(default_factory=dict, repr=False)

    def as_data(self) -> dict[str, Any]:
        kind = "per_pixel" if self.change.kind == "per_pixel" else self.change.kind
        return {
            "change": kind,
            "effect": self.change.effect,
            "parameter": self.change.parameter,
            "values": {name: v.as_data() for name, v in self.values.items()},
            "misfit": _plain(self.misfit),
            "significance": _plain(self.significance),
            "material": self.material,
            "alternatives": self.alternatives,
        }


@dataclass
class Diagnosis:
    """What `diagnose` found; see `formats`."""

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
    values: dict[Key, Any] = field(default_factory=dict, repr=False)
    file: str | None = None
    simulations: int = 0

    def as_data(self) -> dict[str, Any]:
        """As `formats`: spadmnist-diagnosis/1."""
        return {
            "format": "spadmnist-diagnosis/1",
            "verdict": self.verdict,
            "misfit": {"before": _plain(self.before), "after": _plain(self.after)},
            "misfit_null_95": _plain(self.null_95),
            "nuisances": self.nuisances,
            "steps": [step.as_data() for step in self.steps],
            "setup": self.setup,
            "unexplained": self.unexplained,
            "ladder": self.ladder,
            "advice": self.advice,
            "excluded": self.excluded,
            "sensor": self.file,
        }


@dataclass
class _Tried:
    """A candidate at some values: what it does, and by how much it brings the data nearer."""

    change: Change
    values: dict[Key, Any]
    moved: Moved
    gain: float
    times: float
    sensors: Sensors | None = None
    settled: Settled | None = None
    maps: dict[Key, mapping.Map] | None = None
    residuals: dict[Cell, np.ndarray] | None = None


class _Search:
    """The search for what is missing, step by step."""

    def __init__(self, bench: Bench, say: Callable[[str], None]):
        self.bench, self.say = bench, say
        self.accepted: list[Change] = []
        self.phases: dict[tuple[str, Key], float] = {}

    # --- models --------------------------------------------------------------------------------------------------

    def sensors(self, values: Mapping[Key, Any], phases: Sequence[Key] = ()) -> Sensors:
        """The model with these values. phases: of what begins anew in every capture, and every recording."""
        rad = [*phases, *(p for change in self.accepted for p in change.phases)]
        if not rad:
            return Sensors.same(with_values(self.bench.start, values))

        def of(id: str, number: int) -> Sensor:
            known = {p: self.phases.get((id, p)) for p in rad}
            place = list(self.bench.seen).index(id)
            rng = np.random.Generator(np.random.Philox(key=[self.bench.seed + 11, number * 1000 + place]))
            drawn = {p: (2 * math.pi * rng.random() if x is None else x) for p, x in known.items()}
            return with_values(self.bench.start, {**values, **drawn})

        effects = {p[0] for p in rad}
        mean = with_values(self.bench.start, {k: v for k, v in values.items() if k[0] not in effects})
        return Sensors(of, with_values(self.bench.start, values), alike=False, typical=lambda id: mean)

    # --- looking -------------------------------------------------------------------------------------------------

    def square(self, residuals: Mapping[Cell, np.ndarray]) -> float:
        return sum(float(z @ z) for z in residuals.values())

    def line_search(self, state: State, moved: Moved, signed: bool) -> tuple[float, float]:
        """(gain in chi square, times the strength at which it is largest)."""
        now = self.square(state.residuals)
        best = 0.0, 1.0
        for times in [*_TIMES, *([-t for t in _TIMES] if signed else [])]:
            gain = now - self.square(self.bench.residuals(state, moved, times))
            if gain > best[0]:
                best = gain, times
        return best

    def lines(self, state: State) -> list[float]:
        """Frequencies (Hz) that stand out of the data's spectra, the clearest first."""
        found: dict[float, float] = {}
        for (id, name), z in state.residuals.items():
            if (id, name) == RATES or state.nulls[id, name].law != "exponential":
                continue
            axis = self.bench.seen[id].summaries[name].axis
            if axis is None:
                continue
            for cell in np.argsort(z)[-2:]:
                if z[cell] > 5:
                    f = float(axis[cell])
                    near = next((g for g in found if abs(g - f) < 0.1 * f + float(axis[0])), None)
                    found[near or f] = found.get(near or f, 0.0) + float(z[cell])
        return sorted(found, key=lambda f: -found[f])[:3]

    def scan(self, state: State, values: dict[Key, Any]) -> list[_Tried]:
        """Every candidate at its templates, the best first."""
        todo: list[tuple[Change, dict[Key, Any]]] = []
        lines = self.lines(state)
        for change in changes(state.sensors.one):
            if not (change.strengths or change.fixed):
                continue
            tries = templates(change)
            hertz = [d for d in change.shapes if d.unit == "Hz"]
            if change.phases and len(hertz) == 1:
                dial = hertz[0]
                tries = [{**t, dial.key: f} for t in tries[:1] for f in lines if dial.low <= f <= dial.high] + tries
            todo += [(change, t) for t in tries]
        only_rates = all(b.cell[0] == "" for b in fit.failing(fit.blocks(self.bench, state, state.residuals)))
        models, kept = [], []
        for change, tried in todo:
            try:
                models.append(self.sensors({**values, **tried}, change.phases))
                kept.append((change, tried))
            except SpadError:
                continue
        if only_rates:
            found: list[Moved | str] = [self.bench.told(state, m) for m in models]
        else:
            found = self.bench.moved(state, models, _SCAN, only=self.telling(state))
        out = []
        for (change, tried), moved, model in zip(kept, found, models, strict=True):
            if isinstance(moved, str):
                continue
            signed = any(d.low < 0 or change.kind == "set" for d in change.strengths)
            gain, times = self.line_search(state, moved, signed)
            out.append(_Tried(change, tried, moved, gain, times, model))
        return sorted(out, key=lambda t: -t.gain)

    def telling(self, state: State) -> list[str]:
        """Up to three captures that show best what is wrong: a dark one, and those of the largest misfit."""
        own = fit.misfits(state, state.residuals)
        worst: dict[str, float] = {}
        for (id, _), value in own.items():
            worst[id] = worst.get(id, 0.0) + math.log(max(value, 1.0))
        ids = sorted(worst, key=lambda id: -worst[id])
        dark = [id for id in ids if self.bench.seen[id].capture.light.dark][:1]
        return list(dict.fromkeys([*ids[: 3 - len(dark)], *dark]))

    def again(self, state: State, values: dict[Key, Any], tried: list[_Tried]) -> list[_Tried]:
        """The best candidates at the strength that suits them, on all captures; maps beside them."""
        best: list[_Tried] = []
        for one in tried:
            if one.gain > 9 and sum(b.change is one.change for b in best) < (2 if one.change.phases else 1):
                best.append(one)
            if len(best) == _SECOND:
                break
        models: list[Sensors] = []
        about: list[tuple[Change, dict[Key, Any], dict[Key, mapping.Map] | None]] = []
        for one in best:
            scaled = dict(one.values)
            for dial in one.change.strengths:
                if dial.key in scaled:
                    scaled[dial.key] = dial.scaled(float(scaled[dial.key]), one.times)
            if len(one.change.strengths) > 1:  # directions side by side: the others' share comes from the fit
                scaled = {**dict(one.change.fixed), **scaled}
            models.append(self.sensors({**values, **scaled}, one.change.phases))
            about.append((one.change, scaled, None))
        levels = mapping.levels_of(self.bench, state)
        held = [c for c in self.accepted if c.carrier]
        failed = fit.failing(fit.blocks(self.bench, state, state.residuals))
        only_rates = all(b.cell[0] == "" for b in failed)
        for change in changes(state.sensors.one):
            if not change.carrier or only_rates:
                continue
            try:
                sensors, maps, mapped = mapping.sensors_with(self.bench, values, [*held, change], levels)
            except (SpadError, np.linalg.LinAlgError):
                continue
            map_ = maps[change.carrier]
            if map_.sigma < 2e-3 or float(np.mean((map_.estimate / np.maximum(map_.error, 1e-9)) ** 2)) < 0.05:
                continue
            models.append(sensors)
            about.append((change, mapped, maps))
        out = []
        for (change, given, drawn), moved, model in zip(
            about, self.bench.moved(state, models, fit.FEW), models, strict=True
        ):
            if isinstance(moved, str):
                continue
            signed = any(d.low < 0 or change.kind == "set" for d in change.strengths)
            if drawn is None:
                gain, times = self.line_search(state, moved, signed)
            else:
                gain, times = self.square(state.residuals) - self.square(self.bench.residuals(state, moved)), 1.0
            out.append(_Tried(change, given, moved, gain, times, model, maps=drawn))
        return sorted(out, key=lambda t: -t.gain)

    def structured(self, state: State, values: dict[Key, Any], tried: list[_Tried]) -> list[_Tried]:
        """Patterns before maps, but only those that stand out of the map's own scatter."""
        maps = [
            t
            for t in tried
            if t.maps and t.change.per == "pixel" and mapping.bench_light_only(state.sensors.one, t.change)
        ]
        patterns = [t for t in tried if _is_pattern(t, state)]
        if not maps or not patterns:
            return tried
        assert maps[0].maps is not None
        free = maps[0].maps[maps[0].change.carrier]  # type: ignore[index]
        layout = state.sensors.one.layout
        place = layout.centred.T
        radius = (place**2).sum(axis=0)
        designs = {}
        for one in patterns:
            if one.change.per == "row":
                designs[one.change.name] = _indicators(mapping.groups_of(state.sensors.one, "row"))
            elif one.change.per == "column":
                designs[one.change.name] = _indicators(mapping.groups_of(state.sensors.one, "column"))
            else:
                designs[one.change.name] = np.stack([*place, radius], axis=1)
        found = mapping.patterned(free, designs)
        real = [t for t in patterns if found[t.change.name] < 1e-3]
        dropped = [t for t in patterns if t not in real]
        rest = [t for t in tried if t not in dropped]
        if real and rest[0] in maps:
            first = min(real, key=lambda t: found[t.change.name])
            rest.remove(first)
            rest.insert(0, first)
        return rest

    # --- settling ------------------------------------------------------------------------------------------------

    def refine(self, state: State, values: dict[Key, Any], one: _Tried, rounds: int = 3) -> _Tried:
        """Settle the numbers of a candidate."""
        dials = [d for d in one.change.dials if d.key in one.values and not d.whole]
        given = dict(one.values)
        for dial in one.change.strengths:
            if dial.key in given and one.maps is None:
                given[dial.key] = dial.scaled(float(given[dial.key]), one.times)
        if one.maps is not None or not dials:
            one.residuals = self.bench.residuals(state, one.moved, noisy=True)
            return one
        found = fit.settle(
            self.bench,
            state,
            dials,
            given,
            lambda v: self.sensors({**values, **v}, one.change.phases),
            rounds,
        )
        if isinstance(found, str):
            return one
        one.settled, one.values, one.residuals = found, dict(found.values), found.residuals
        one.gain = self.square(state.residuals) - found.square
        return one

    def calibrated(self, state: State, tried: Sequence[_Tried], best: _Tried) -> tuple[float, float]:
        """(significance of the best in standard deviations, p-value of the largest of all candidates')."""
        keys = list(state.residuals)
        z = stacked(state.residuals, keys)
        own = np.concatenate([state.own[k] for k in keys], axis=1)
        largest = np.zeros(len(own))
        scores = 0.0
        for one in [best, *tried]:
            t = stacked(self.bench.template(state, one.moved), keys)
            if not t.any():
                continue
            along = own @ t
            spread = max(float(along.std()), 1e-9)
            largest = np.maximum(largest, np.abs(along) / spread)
            if one is best:
                # what is far outside is no matter of the linear law: the gain itself, in the same measure
                typical = float(np.mean(along**2) / max(float(t @ t), 1e-12))
                scores = max(abs(float(z @ t)) / spread, math.sqrt(max(best.gain, 0.0) / max(typical, 0.5)))
        location, scale = stats.gumbel_r.fit(largest) if np.ptp(largest) > 0 else (3.0, 0.5)
        return scores, max(float(stats.gumbel_r.sf(scores, location, max(scale, 0.25))), _LEAST_P)


def _is_pattern(one: _Tried, state: State) -> bool:
    change = one.change
    if change.kind != "add":
        return False
    if change.per in ("row", "column"):
        return True
    from ..effects import Effect

    return getattr(Effect.registry.find(change.effect), "stage", "") == "light"


def _indicators(groups: np.ndarray) -> np.ndarray:
    one = np.eye(int(groups.max()) + 1)[groups]
    return np.asarray(one[:, 1:])


# --- the set-up -------------------------------------------------------------------------------------------------


def _setup(bench: Bench, state: State) -> tuple[list[dict[str, Any]], float]:
    """(what of the set-up explains the totals, p-value of what it leaves): the simplest that does, or nothing."""
    ids, _, root, _ = bench.rate_space(state)
    if not ids:
        return [], 0.0
    x = bench.levels(state, ids, {i: math.log(max(s.total, 0.5)) for i, s in bench.seen.items()})
    captures = {i: bench.seen[i].capture for i in ids}
    lit = [not captures[i].light.dark for i in ids]
    waves = sorted({float(captures[i].light.wavelength or 0) for i in ids} - {0.0})
    tries: list[tuple[str, str | None, list[str], np.ndarray]] = []
    if any(lit):
        tries.append(("light", None, [i for i, on in zip(ids, lit, strict=True) if on], np.array(lit, float)))
    for wave in waves if len(waves) > 1 else []:
        mask = [captures[i].light.wavelength == wave for i in ids]
        tries.append(("wavelength", None, [i for i, m in zip(ids, mask, strict=True) if m], np.array(mask, float)))
    for k, id in enumerate(ids):
        tries.append(("dark" if captures[id].light.dark else "light", id, [id], np.eye(len(ids))[k]))
    for quantity, _, which, column in tries:
        direction = root @ column
        z = root @ x
        size = float(direction @ z / (direction @ direction))
        left = z - size * direction
        p = float(stats.chi2.sf(left @ left, max(1, len(ids) - 1)))
        if p > comparing.FALSE_ALARM and np.all(np.abs(left) < 4):
            weight = np.linalg.inv(root.T @ root)  # the covariance of the levels
            error = math.sqrt(float(1 / (direction @ direction)))
            del weight
            factor = [math.exp(size + k * error) for k in (0.0, -1.96, 1.96)]
            told = dict(zip(("value", "low", "high"), map(_plain, factor), strict=True))
            return [{"capture": id, "quantity": quantity, "factor": told, "confused": False} for id in which], p
    return [], 0.0


# --- words ------------------------------------------------------------------------------------------------------


def _remainder(bench: Bench, state: State, residuals: Mapping[Cell, np.ndarray]) -> list[dict[str, Any]]:
    """What nothing explains: where, how large, and what kind of mechanism leaves such a trace."""
    out = []
    for block in fit.failing(fit.blocks(bench, state, residuals))[:20]:
        id, name = block.cell
        if id == "":
            ids, *_ = bench.rate_space(state)
            which = ids[block.worst] if block.worst < len(ids) else None
            out.append(
                {"statistic": "rate", "capture": which, "significance": _plain(abs(block.z)), "where": "all pixels"}
            )
            continue
        summary = bench.seen[id].summaries[name]
        out.append(
            {
                "statistic": name,
                "capture": id,
                "significance": _plain(max(abs(block.z), float(stats.norm.isf(max(block.p, 1e-300) / 2)))),
                "where": summary.where(block.worst),
            }
        )
    return out


def mechanism(found: Sequence[Mapping[str, Any]], dark: Sequence[str]) -> str:
    """One sentence on what the remainder does."""
    names = {str(r["statistic"]) for r in found}
    together = names & {"neighbours", "far_pairs", "multiplicity", "spacing", "array_fano"}
    same = names & {"intervals", "edge_intervals", "autocorrelation", "rescaled", "rescaled_lag"}
    if "far_pairs" in names:
        who = "pixels far from each other share it"
    elif "neighbours" in names or together:
        who = "pixels that are close to each other share it"
    elif same:
        who = "it stays in its own pixel"
    else:
        who = "it is a matter of rates and maps"
    in_dark = any(r["capture"] in dark for r in found)
    return f"{who}; {'it is there in the dark, too' if in_dark else 'it shows in light alone'}"


def _errors(bench: Bench, state: State, residuals: Mapping[Cell, np.ndarray], shift: Moved | None) -> dict[str, float]:
    """Physical errors of a model: relative, beyond the noise where that is known."""
    ids, slopes, _, _ = bench.rate_space(state)
    logs = {i: math.log(max(s.total, 0.5)) - (shift.logs.get(i, 0.0) if shift else 0.0) for i, s in bench.seen.items()}
    x = bench.levels(state, ids, logs) if ids else np.zeros(0)
    lit = np.array([not bench.seen[i].capture.light.dark for i in ids], bool)
    apart = x - (x[lit].mean() if lit.any() else 0.0) * lit
    errors = {
        "mean_rate": float(np.sqrt(np.mean((x * slopes) ** 2))) if len(x) else 0.0,
        "linearity": float(np.max(np.abs(apart[lit]))) if lit.any() else 0.0,
    }
    shares: dict[str, list[float]] = {"map": [], "intervals": [], "neighbours": []}
    for cell, z in residuals.items():
        if cell == RATES:
            continue
        id, name = cell
        seen, null = bench.seen[id], state.nulls[cell]
        expected = null.expected(seen.total)[0] + (shift.shifts.get(cell, 0.0) if shift else 0.0)
        values = seen.summaries[name].values
        if name == "pixel_map":
            beyond = max(0.0, float(np.mean(z**2)) - 1) / max(float(np.mean(values)), 1.0)
            shares["map"].append(math.sqrt(beyond))
        elif name == "intervals":
            raw = np.abs(values - expected).sum() - 0.8 * np.sqrt(np.maximum(expected, 0)).sum()
            shares["intervals"].append(max(0.0, float(raw)) / 2 / max(float(values.sum()), 1.0))
        elif name == "neighbours":
            k = int(np.argmax(np.abs(z)))
            far = abs(float(values[k] - expected[k])) if abs(z[k]) > 3.5 else 0.0
            shares["neighbours"].append(far / max(seen.total, 1.0))
    return {k: _plain(v) for k, v in errors.items()} | {
        k: _plain(float(np.mean(v)) if v else 0.0) for k, v in shares.items()
    }


def _nuisances(bench: Bench, state: State) -> list[dict[str, Any]]:
    levels: list[tuple[Any, float, float, float]] = []
    for id, seen in bench.seen.items():
        null = state.rates[id]
        if seen.capture.light.dark or null.stated is None:
            continue
        level, error, elasticity = null.level_of(seen.total)
        levels.append((seen.capture, math.log(level / null.stated), error, elasticity))
    found, _ = comparing.light_of(levels, [s.capture for s in bench.seen.values()])
    return [
        {"capture": n.capture, "name": n.name, **{k: _plain(getattr(n, k)) for k in ("value", "low", "high", "pull")}}
        for n in found
    ]


# --- the diagnosis ----------------------------------------------------------------------------------------------


def diagnose(
    sensor: Sensor,
    measurement: Measurement,
    seed: int = 0,
    max_steps: int = 4,
    quick: bool = False,
    jobs: int = 2,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Find what a model lacks. quick: fewer simulations. progress: told what is being done.

    Raises InputError where sensor and measurement do not belong together.
    """
    say = progress or (lambda what: None)
    with Parallel(n_jobs=jobs) as parallel:
        bench = Bench(sensor, measurement, seed, parallel, 32 if quick else recordings.REPLICATES, say)
        return _diagnosed(bench, measurement, max_steps, quick, say)


def _diagnosed(
    bench: Bench, measurement: Measurement, max_steps: int, quick: bool, say: Callable[[str], None]
) -> Diagnosis:
    search = _Search(bench, say)
    say("the model as it is")
    state = bench.state({})
    start = state
    before = fit.misfit(state, state.residuals)
    null_95 = fit.usual_misfit(state)
    ladder = [_row("start", before, _errors(bench, state, state.residuals, None))]
    setup: list[dict[str, Any]] = []
    steps: list[Step] = []
    values: dict[Key, Any] = {}
    states = [state]
    verdict = ""
    advice: list[dict[str, Any]] = []
    tried: list[_Tried] = []
    for number in range(max_steps):
        failed = fit.failing(fit.blocks(bench, state, state.residuals))
        if not failed:
            break
        if not steps and all(b.cell[0] == "" for b in failed):
            setup, explains = _setup(bench, state)
            if setup:
                verdict = "setup"
                rivals = _rivals(search, state, explains) if len(setup) > 1 else []
                if rivals:
                    verdict, steps = "confused", rivals
                    setup = [{**entry, "confused": True} for entry in setup]
                    names = ["light", *(s.change.effect for s in rivals)]
                    advice.append(
                        {
                            "capture": "dark, 100 s",
                            "separates": names,
                            "significance_now": None,  # not worked out yet
                            "significance_then": None,
                        }
                    )
                break
        first = ", ".join(" of ".join(b.cell[::-1]).removesuffix(" of ") for b in failed[:4])
        say(f"step {number + 1}: {len(failed)} checks fail ({first}); trying every candidate")
        tried = search.scan(state, values)
        say(f"step {number + 1}: the best of them")
        second = search.structured(state, values, search.again(state, values, tried))
        if not second:
            break
        say(f"step {number + 1}: settling " + ", ".join(_title(t.change) for t in _worth(second)))
        refined = [search.refine(state, values, one) for one in _worth(second)]
        best = refined[0] if _is_pattern(refined[0], state) else max(refined, key=lambda t: t.gain)
        significance, p = search.calibrated(state, tried, best)
        if p > comparing.FALSE_ALARM or best.gain < 12:
            break
        template = bench.template(state, best.moved)
        step, values, state = _accepted(search, state, values, best, significance, template)
        own = fit.misfit(state, state.residuals)
        step.misfit = own
        step.alternatives = _alternatives(bench, states[-1], best, refined, second)
        steps.append(step)
        states.append(state)
        ladder.append(_row(f"+ {_title(step.change)}", own, _errors(bench, state, state.residuals, None)))
        if fit.misfit(states[-2], states[-2].residuals) - own < 0.1 * (
            fit.misfit(states[-2], states[-2].residuals) - 1
        ):
            break
    left = fit.failing(fit.blocks(bench, state, state.residuals))
    if not verdict:
        if not steps:
            verdict = "unexplained" if left else "adequate"
        elif not left:
            verdict = "explained"
        else:
            kept = [s for s in steps if _own_cells_clean(s, state)]
            if not kept:
                verdict, steps, values, state = "unexplained", [], {}, start
                left = fit.failing(fit.blocks(bench, state, state.residuals))
            else:
                verdict = "partly_explained"
    if steps and verdict == "explained":
        near = [a for a in steps[-1].alternatives if a.get("confused")]
        if near:
            verdict = "confused"
            advice.append(_advice(bench, steps[-1], near[0]))
    for step in steps:
        for other in step.alternatives:
            other.pop("confused", None)
    if len(states) > 1 and tried:
        ladder.insert(1, _placebo(bench, states, tried, search))
    return Diagnosis(
        bench.start.name,
        measurement.name,
        verdict,
        before,
        fit.misfit(state, state.residuals),
        null_95,
        _nuisances(bench, state),
        steps,
        setup,
        _remainder(bench, state, state.residuals) if verdict in ("unexplained", "partly_explained") else [],
        ladder,
        advice,
        [],
        values,
        None,
        bench.simulations,
    )


def _rivals(search: _Search, state: State, explains: float) -> list[Step]:
    """Changes of the sensor that act on all captures alike, the dark ones too, and explain the totals as well."""
    del explains
    found = []
    for one in search.scan(state, {}):
        logs = [x * one.times for x in one.moved.logs.values()]
        if not one.change.strengths or one.gain < 12 or max(logs) - min(logs) > 0.1 * max(map(abs, logs)):
            continue
        one = search.refine(state, {}, one)
        left = fit.blocks(search.bench, state, one.residuals or {})
        if one.settled is None or fit.failing(left):
            continue
        told = {d.parameter: Value(*one.settled.interval(i), d.unit) for i, d in enumerate(one.settled.dials)}
        squares = fit.misfit(state, one.residuals or {})
        found.append(Step(one.change, told, squares, math.sqrt(one.gain), "all rates alike"))
        break
    return found


def _row(model: str, misfit: float, errors: dict[str, float], placebo: bool = False) -> dict[str, Any]:
    return {"model": model, "misfit": _plain(misfit), "errors": errors, "placebo": placebo}


def _title(change: Change) -> str:
    if change.kind == "add":
        return change.effect
    return f"{change.effect}.{change.parameter}" + (" per pixel" if change.kind == "per_pixel" else "")


def _worth(second: Sequence[_Tried]) -> list[_Tried]:
    """Those that may turn out best when they are settled."""
    best = max(t.gain for t in second)
    first = second[0]
    return [first, *(t for t in second[1:] if t.gain > 0.3 * best)][:_REFINED]


def _accepted(
    search: _Search,
    state: State,
    values: dict[Key, Any],
    best: _Tried,
    significance: float,
    template: dict[Cell, np.ndarray],
) -> tuple[Step, dict[Key, Any], State]:
    """The step, and the model with it beside the data."""
    bench = search.bench
    search.accepted.append(best.change)
    after = {**values, **best.values}
    held = [c for c in search.accepted if c.carrier]
    if held:
        levels = mapping.levels_of(bench, state)
        sensors, maps, after = mapping.sensors_with(bench, after, held, levels)
        new = bench.state(after, sensors)
    else:
        maps = {}
        new = bench.state(after, search.sensors(after))
        # from where it nearly is right: the scatter of the cells is that of the model with the effect
        for _ in range(_AGAIN if best.settled is not None else 0):
            dials = [*best.settled.dials] if best.settled is not None else []
            closer = fit.settle(bench, new, dials, after, search.sensors, 3, 2 * fit.FEW)
            if isinstance(closer, str):
                break
            best.settled = closer
            if search.square(new.residuals) - closer.square < 6:
                break
            after = dict(closer.values)
            new = bench.state(after, search.sensors(after))
    told: dict[str, Value] = {}
    if best.settled is not None:
        point, covariance = _polished(new, best.settled)
        for i, dial in enumerate(best.settled.dials):
            half = 1.96 * math.sqrt(max(float(covariance[i, i]), 0.0))
            u = float(point[i])
            told[dial.parameter] = Value(dial.value(u), dial.value(u - half), dial.value(u + half), dial.unit)
            after[dial.key] = dial.value(u)
    elif best.change.carrier and best.change.carrier in maps:
        for name, number in mapping.summary(maps[best.change.carrier]).items():
            told[name] = Value(number, None, None)
        sigma = told["sigma"].value
        noise = float(np.median(maps[best.change.carrier].raw_error))
        # of a variance, which is what remains of the differences without the noise
        half = 1.96 * (sigma**2 + noise**2) * math.sqrt(2 / len(maps[best.change.carrier].raw))
        ends = [math.sqrt(max(sigma**2 + k * half, 0.0)) for k in (-1, 1)]
        told["sigma"] = Value(sigma, ends[0], ends[1])
    for (_, name), value in best.change.fixed:
        if name not in told and isinstance(value, (bool, int, float)):
            told[name] = Value(float(value), None, None)
    logs = [abs(x) for x in best.moved.logs.values()]
    sign = np.mean(list(best.moved.logs.values())) if logs else 0.0
    step = Step(
        best.change,
        told,
        0.0,
        significance,
        f"mean rate {math.expm1(-float(sign)):+.2%}",
        template=template,
        before=dict(state.residuals),
    )
    return step, after, new


def _polished(state: State, settled: Settled) -> tuple[np.ndarray, np.ndarray]:
    """One more step of the settled dials, on the residuals of a state that many recordings tell."""
    keys = [k for k in settled.slopes if k in state.residuals and len(state.residuals[k]) == len(settled.slopes[k])]
    z, slopes = stacked(state.residuals, keys), np.concatenate([settled.slopes[k] for k in keys])
    own = np.concatenate([state.own[k] for k in keys], axis=1)
    covariance = fit._covariance(slopes, own)
    step = -np.linalg.pinv(slopes.T @ slopes, rcond=1e-10) @ (slopes.T @ z)
    error = np.sqrt(np.diag(covariance))
    return settled.point + np.clip(step, -5 * error, 5 * error), covariance


def _own_cells_clean(step: Step, state: State) -> bool:
    """Are the cells that a step speaks of in order? Otherwise it only happens to look like what is there."""
    weight, after, before = 0.0, 0.0, 0.0
    for cell, t in step.template.items():
        z, old = state.residuals.get(cell), step.before.get(cell)
        if z is None or old is None or len(z) != len(t) or len(old) != len(t):
            continue
        w = t**2
        weight, after, before = weight + float(w.sum()), after + float(w @ z**2), before + float(w @ old**2)
    return weight > 0 and after / weight < max(4.0, 0.05 * before / weight)


def _alternatives(
    bench: Bench, state: State, best: _Tried, refined: Sequence[_Tried], second: Sequence[_Tried]
) -> list[dict[str, Any]]:
    """The other candidates, with the misfit that each leaves."""
    out: list[dict[str, Any]] = []
    for one in second:
        if (
            one is best
            or one.change is best.change
            or any(o["effect"] == one.change.effect and o["parameter"] == one.change.parameter for o in out)
        ):
            continue
        residuals = one.residuals or bench.residuals(state, one.moved, one.times, noisy=True)
        checks = fit.blocks(bench, state, residuals)
        alike = one.residuals is not None and best.gain - one.gain < 8 and not fit.failing(checks)
        out.append(
            {
                "change": one.change.kind,
                "effect": one.change.effect,
                "parameter": one.change.parameter,
                "misfit": _plain(fit.misfit(state, residuals)),
                "confused": alike,
            }
        )
    return out[:4]


def _advice(bench: Bench, step: Step, other: Mapping[str, Any]) -> dict[str, Any]:
    dark = next((s.capture for s in bench.seen.values() if s.capture.light.dark), None)
    longer = "dark, 100 s" if dark is None or dark.conditions.exposure < 50 else "flat, ten times as bright"
    return {
        "capture": longer,
        "separates": [step.change.effect, other["effect"]],
        "significance_now": None,  # not worked out yet
        "significance_then": None,
    }


def _placebo(bench: Bench, states: Sequence[State], tried: Sequence[_Tried], search: _Search) -> dict[str, Any]:
    """A harmless effect: of the candidates, the one in the middle, at its best strength."""
    usable = [t for t in tried if t.moved.shifts or t.moved.logs]
    one = usable[len(usable) * 3 // 4]
    state = states[0] if len(states) == 2 else states[-2]
    residuals = bench.residuals(state, one.moved, one.times if one.gain > 0 else 0.0)
    return _row(
        f"placebo: {_title(one.change)}", fit.misfit(state, residuals), _errors(bench, state, residuals, None), True
    )


def canonical(found: Diagnosis) -> str:
    """The answer as JSON."""
    return json.dumps(found.as_data(), indent=1, allow_nan=False)


def table(found: Diagnosis) -> str:
    """The answer for a terminal: the verdict, the steps, the ladder."""
    from .. import units

    lines = [f"{found.verdict.upper().replace('_', ' ')}: {_sentence(found)}", ""]
    for number, step in enumerate(found.steps, 1):
        parts = []
        for name, v in step.values.items():
            text = units.show(v.value, v.unit) if v.unit else f"{v.value:.4g}"
            if v.low is not None and v.high is not None:
                ends = [units.show(x, v.unit) if v.unit else f"{x:.4g}" for x in (v.low, v.high)]
                text += f" ({ends[0]} to {ends[1]})"
            parts.append(f"{name} {text}")
        lines.append(
            f"{number}. {_title(step.change)}: {', '.join(parts)}; {step.significance:.1f} sigma, {step.material}"
        )
    for entry in found.setup:
        f = entry["factor"]
        where = entry["capture"] or "all"
        lines.append(
            f"set-up: {entry['quantity']} of {where} x {f['value']:.4f} (95 %: {f['low']:.4f} to {f['high']:.4f})"
        )
    if found.steps or found.setup:
        lines.append("")
    names = ("mean_rate", "map", "linearity", "intervals", "neighbours")
    rows: list[tuple[str, ...]] = [("model", "misfit", *(n.replace("_", " ") + " %" for n in names))]
    for row in found.ladder:
        rows.append((row["model"], f"{row['misfit']:.3f}", *(f"{100 * row['errors'].get(n, 0.0):.3f}" for n in names)))
    rows.append(("noise floor (95 %)", f"{found.null_95:.3f}", *("" for _ in names)))
    lines += _columns(rows)
    if found.unexplained:
        lines += ["", "What remains:"]
        lines += _columns(
            [
                (r["statistic"], r["capture"] or "all", f"{r['significance']:.1f} sigma", r["where"])
                for r in found.unexplained[:8]
            ]
        )
    for one in found.advice:
        lines.append(f"To tell {' from '.join(one['separates'])}: take {one['capture']}.")
    return "\n".join(lines)


def _sentence(found: Diagnosis) -> str:
    if found.verdict == "adequate":
        return "nothing is missing that this measurement could show."
    if found.verdict == "setup":
        return "the set-up explains everything, the sensor nothing."
    names = " and ".join(_title(s.change) for s in found.steps)
    if found.verdict == "explained":
        return f"{names} explains what the model lacked."
    if found.verdict == "confused":
        return f"{names}, or something that looks the same here."
    if found.verdict == "partly_explained":
        return f"{names} is missing, and something else remains."
    dark = [r["capture"] for r in found.unexplained if "dark" in str(r["capture"])]
    return f"something is missing that no known effect explains: {mechanism(found.unexplained, dark)}."


def notes(found: Diagnosis) -> dict[Key, str]:
    """What is written behind the new lines of the next sensor file: the data, and the 95 % intervals."""
    from .. import units

    out: dict[Key, str] = {}
    for step in found.steps:
        parts = []
        for name, v in step.values.items():
            if v.low is not None and v.high is not None:
                ends = [units.show(x, v.unit) if v.unit else f"{x:.4g}" for x in (v.low, v.high)]
                parts.append(f"{name} {ends[0]} to {ends[1]} (95 %)")
        text = f"from {found.measurement}" + (f": {', '.join(parts)}" if parts else "")
        keys = [key for key in found.values if key[0] == step.change.effect]
        for key in keys:
            out[key] = text
    return out


def fitted(
    sensor: Sensor,
    measurement: Measurement,
    add: Sequence[str] = (),
    free: Sequence[str] = (),
    per_pixel: Sequence[str] = (),
    seed: int = 0,
    jobs: int = 2,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Settle what the caller names: whole effects (`add`), "effect.parameter" (`free`), and maps (`per_pixel`).

    Raises InputError where there is no such effect or parameter.
    """
    say = progress or (lambda what: None)
    every = changes(sensor.settled())
    wanted = [
        *(_named(every, "add", name, None) for name in add),
        *(_named(every, "set", *_halves(name)) for name in free),
        *(_named(every, "per_pixel", *_halves(name)) for name in per_pixel),
    ]
    if not wanted:
        raise InputError("nothing is to be settled; name --add EFFECT, --free EFFECT.PARAMETER or --per-pixel ...")
    with Parallel(n_jobs=jobs) as parallel:
        bench = Bench(sensor, measurement, seed, parallel, recordings.REPLICATES, say)
        search = _Search(bench, say)
        say("the model as it is")
        state = bench.state({})
        before, start = fit.misfit(state, state.residuals), state
        ladder = [_row("start", before, _errors(bench, state, state.residuals, None))]
        values: dict[Key, Any] = {}
        steps = []
        for change in sorted(wanted, key=lambda c: bool(c.carrier)):
            say(f"settling {_title(change)}")
            if change.carrier:
                best = _Tried(change, {}, Moved({}, {}, {}), 0.0, 1.0, maps={})
            else:
                best = _started(search, state, values, change)
                best = search.refine(state, values, best, 5)
            template = bench.template(state, best.moved)
            step, values, state = _accepted(search, state, values, best, math.sqrt(max(best.gain, 0.0)), template)
            step.misfit = fit.misfit(state, state.residuals)
            steps.append(step)
            ladder.append(_row(f"+ {_title(change)}", step.misfit, _errors(bench, state, state.residuals, None)))
        left = fit.failing(fit.blocks(bench, state, state.residuals))
        return Diagnosis(
            bench.start.name,
            measurement.name,
            "partly_explained" if left else "explained",
            before,
            fit.misfit(state, state.residuals),
            fit.usual_misfit(start),
            _nuisances(bench, state),
            steps,
            [],
            _remainder(bench, state, state.residuals),
            ladder,
            [],
            [],
            values,
            None,
            bench.simulations,
        )


def _started(search: _Search, state: State, values: dict[Key, Any], change: Change) -> _Tried:
    """The template of a change that comes nearest, at the strength that suits it."""
    tries = templates(change)
    models = [search.sensors({**values, **t}, change.phases) for t in tries]
    found = []
    for tried, moved, model in zip(tries, search.bench.moved(state, models, _SCAN), models, strict=True):
        if isinstance(moved, str):
            raise InputError(f"{_title(change)}: {moved}")
        signed = any(d.low < 0 or change.kind == "set" for d in change.strengths)
        found.append(_Tried(change, tried, moved, *search.line_search(state, moved, signed), model))
    return max(found, key=lambda t: t.gain)


def _halves(name: str) -> tuple[str, str]:
    effect, dot, parameter = name.partition(".")
    if not dot or not parameter:
        raise InputError(f"{name!r} is not EFFECT.PARAMETER, for example dead_time.duration")
    return effect, parameter


def _named(every: Sequence[Change], kind: str, effect: str, parameter: str | None) -> Change:
    for change in every:
        if (change.kind, change.effect) == (kind, effect) and (kind == "add" or change.parameter == parameter):
            return change
    name = effect + (f".{parameter}" if parameter else "")
    able = sorted({c.effect + (f".{c.parameter}" if c.parameter else "") for c in every if c.kind == kind})
    raise InputError(f"{name} cannot be settled here; those that can: {', '.join(able)}")
