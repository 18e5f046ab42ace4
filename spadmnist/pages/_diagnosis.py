"""The page of `diagnose` and `fit`: what is missing, the residuals before and after, the error of each model."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import reference, statistics, units
from ..inference import next_step, results
from ..inference.comparison import headline
from ..inference.deviations import listed
from ..inference.results import Diagnosis, Step, Trace, Value
from . import _figures as figures
from ._figures import MEASURED, ROUGH, Cells, Picture
from ._frame import Source, number, title_of, write
from ._pixels import OddPixels, odd_pixels_of, write_lists

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BROAD, _NARROW = 5.9, 3.8  # inches; the ladder on a broad page, and on a telephone
_FLOOR, _REACHED, _ABOVE, _PLACEBO = "#e3efe6", "#3f7f57", "#c8584c", "#bcc2c6"
_LINE = 14  # letters of a name below a bar
_LETTER = 0.078  # inches that one takes
_MOST = 200  # rows of a table
_HALF = 0.5  # of an error: what falls further has fallen
_BEYOND = 1e4  # sigmas: more are no more than that
_COLUMNS = {
    "mean_rate": "mean rate",
    "map": "map",
    "linearity": "linearity",
    "intervals": "intervals",
    "neighbours": "neighbours",
}
_VERDICTS = {  # the word, and how the page looks
    "adequate": ("Adequate", "good"),
    "explained": ("Explained", "good"),
    "setup": ("Set-up", "open"),
    "confused": ("Confused", "open"),
    "partly_explained": ("Partly explained", "open"),
    "unexplained": ("Unexplained", "fails"),
}
_KINDS = {
    "add": "an effect that the model lacks",
    "set": "a number of the model that is another",
    "per_pixel": "a number of the model that varies from pixel to pixel",
}


def diagnosis(found: Diagnosis, folder: Path, source: Source | None = None) -> Path:
    """Write the page of a diagnosis or a fit as `report.html` in a folder, made if it is not there; its path.

    The odd pixels of each map are listed in a CSV file in the same folder. A page that an earlier diagnosis left there
    is replaced, whatever else lies there stays as it is. Raises SpadError as `check_place` does, or where the file
    cannot be written.
    """
    maps = {k: odd for k, step in enumerate(found.steps) if (odd := odd_pixels_of(found, step)) is not None}
    page = write(folder, "diagnosis", _TEMPLATE, _words(found, maps), source)
    write_lists(maps.values(), folder)
    return page


# --- words ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Number:
    name: str
    value: str
    interval: str
    about: str


@dataclass(frozen=True)
class _Picture:
    """A deviation of the first model. trace: the check that names it; alike: the same in other captures."""

    trace: Trace
    title: str
    before: float
    after: float
    picture: Picture | None
    alike: Sequence[Trace] = ()


@dataclass(frozen=True)
class _Card:
    """A step: what stands above and below its pictures."""

    title: str
    step: Step
    kind: str
    about: str
    numbers: Sequence[_Number]
    pictures: Sequence[_Picture] = ()
    odd: OddPixels | None = None


def _words(found: Diagnosis, maps: Mapping[int, OddPixels]) -> dict[str, Any]:
    word, look = _VERDICTS.get(found.verdict, (found.verdict, "open"))
    ladder = sorted(found.ladder, key=lambda row: bool(row["placebo"]))
    pictures = [_pictured(group) for group in _groups(found.traces)]
    steps = [
        replace(_step(step), pictures=[one for one in pictures if one.trace.step == k], odd=maps.get(k))
        for k, step in enumerate(found.steps)
    ]
    return {
        "found": found,
        "kind": "Fit of a model" if found.asked == "fit" else "Diagnosis of a model",
        "verdict": word,
        "look": look,
        "opening": results.opening(found, word),
        "then": next_step.after_diagnosis(found, new=Path(found.file).name if found.file else "next/sensor.yaml"),
        "headline": headline(found.in_sample) if found.in_sample is not None else "",
        "next": Path(found.file).name if found.file else None,
        "nearest": results.nearest(found),
        "ladder": ladder,
        "broad": _ladder_picture(ladder, found.null_95, _BROAD) if ladder else None,
        "narrow": _ladder_picture(ladder, found.null_95, _NARROW) if ladder else None,
        "columns": _columns(ladder),
        "error": results.error_of,
        "fallen": _fallen(found),
        "steps": steps,
        "others": [one for one in pictures if one.trace.step is None],
        "remains": [
            (first, title_of(str(first["statistic"])), listed((r["statistic"], r["capture"]) for r in others))
            for first, *others in results.remaining(found)[:_MOST]
        ],
        "mechanism": results.mechanism(found.unexplained, found.dark) if found.unexplained else "",
        "limits": [(e, *_limit(e)) for e in found.excluded[:_MOST]],
        "hidden": [(e["effect"], _about(e["effect"])) for e in found.invisible[:_MOST]],
        "name": _name,
        "named": results.named,
        "about": _about,
    }


def _groups(traces: Sequence[Trace]) -> list[list[Trace]]:
    """The traces of one deviation together, the one that names it first."""
    by_number: dict[int, list[Trace]] = {}
    for trace in traces:
        by_number.setdefault(trace.deviation, []).append(trace)
    return [sorted(some, key=lambda trace: not trace.first) for some in by_number.values()]


def _fallen(found: Diagnosis) -> tuple[str, float, float] | None:
    """(which physical error fell most, from what, to what), where the misfit, which knows no totals, saw nothing.

    None where no error fell to less than a half: then it is no matter of totals.
    """
    rows = [row["errors"] for row in found.ladder if not row["placebo"]]
    if not found.steps or found.before > found.null_95 or len(rows) < 2:
        return None
    first, last = rows[0], rows[-1]
    names = {name: words for name, words in _columns(found.ladder).items() if name in statistics.OTHER_ERRORS}
    most = max(names, key=lambda name: first.get(name, 0.0) - last.get(name, 0.0))
    fell = _HALF * first.get(most, 0.0) > last.get(most, 0.0)
    return (names[most], first[most], last.get(most, 0.0)) if fell else None


def _columns(ladder: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """The errors of the ladder and what they are called, those of the user's own statistics last."""
    every = dict.fromkeys(name for row in ladder for name in row["errors"])
    return _COLUMNS | {name: name.replace("_", " ") for name in every if name not in _COLUMNS}


def _described(effect: str) -> dict[str, Any]:
    """What the reference says of an effect; nothing where it is not at hand."""
    try:
        described = reference.as_data("effect", effect)
    except KeyError:
        return {"about": "", "parameters": {}}
    assert isinstance(described, dict)
    return described


def _about(effect: str) -> str:
    """The first sentence of an effect's docstring."""
    first = " ".join(str(_described(effect)["about"] or "").split("\n\n")[0].replace("`", "").split())
    return re.split(r"(?<=[.!?])\s", first, maxsplit=1)[0]


def _name(entry: Mapping[str, Any]) -> str:
    """What people call an alternative, as `answer.title` does a change."""
    if entry["change"] == "add":
        return str(entry["effect"])
    if entry["effect"] is None:
        return f"{entry['what']}, which the catalogue does not have"
    return f"{entry['effect']}.{entry['parameter']}" + (" per pixel" if entry["change"] == "per_pixel" else "")


def _step(step: Step) -> _Card:
    declared = _described(step.candidate.effect)["parameters"]
    words = results.OF_A_MAP if step.candidate.carrier else {}
    numbers = []
    for name, value in results.told(step):
        own = declared.get(name, {})
        about = words.get(name, own.get("about", ""))
        numbers.append(_Number(name, *_shown(value, own.get("unit", "")), about))
    about = _about(step.candidate.effect)
    if step.candidate.parameter in declared:
        about = f"{step.candidate.parameter}: {declared[step.candidate.parameter]['about']}. {about}"
    but = results.mimic(step.candidate)
    about += f" But: {but}." if but else ""
    return _Card(
        results.title(step.candidate), step, _KINDS.get(step.candidate.kind, step.candidate.kind), about, numbers
    )


def _shown(value: Value, declared: str) -> tuple[str, str]:
    """(a value, its 95 % interval) for people."""
    if declared == "bool":
        return ("yes" if value.value else "no"), ""
    interval = ""
    if value.low is not None and value.high is not None:
        interval = f"{_quantity(value.low, value.unit)} to {_quantity(value.high, value.unit)}"
    return _quantity(value.value, value.unit), interval


def _quantity(value: float, unit: str, digits: int = 4) -> str:
    return units.show(value, unit, digits) if unit and units.is_known(unit) else f"{value:.{digits}g}"


def _limit(entry: Mapping[str, Any]) -> tuple[str, str]:
    """(upper limit, what the parameter is)."""
    own = _described(entry["effect"])["parameters"].get(entry["parameter"], {})
    limit = _quantity(entry["upper_limit_95"], own.get("unit", ""), 2)
    return f"at least {limit}" if entry.get("at_least") else limit, own.get("about", "")


# --- pictures -------------------------------------------------------------------------------------------------------


def trace_figure(trace: Trace) -> Figure:
    """The figure of a trace: measured, the model before and after, residuals."""
    return figures.figure_of(_cells(trace))


def _residuals(trace: Trace) -> tuple[np.ndarray, np.ndarray]:
    """(before, after)."""
    both = trace.residuals_before, trace.residuals_after
    earlier, now = (np.clip(figures.finite(z), -_BEYOND, _BEYOND) for z in both)
    return earlier, now


def _cells(trace: Trace) -> Cells:
    earlier, now = _residuals(trace)
    before, after, spread = (figures.finite(values) for values in (trace.before, trace.after, trace.spread))
    worst = int(np.argmax(np.abs(earlier))) if trace.worst is None else trace.worst  # the sentence's own cell
    return Cells(trace.statistic, trace.summary, after, spread, now, worst, before, earlier)


def _pictured(traces: Sequence[Trace]) -> _Picture:
    """The picture of a deviation: the check that names it, with the residuals before of other captures."""
    first = traces[0]
    earlier, now = _residuals(first)
    picture = None
    if now.size:
        words = f"{first.statistic} of {first.capture}: measured, model before, model after"
        others = tuple((trace.capture, _cells(trace)) for trace in traces[1:])
        picture = figures.picture(replace(_cells(first), overlaid=others, name=first.capture), words)
    squares = [float(np.mean(z**2)) if z.size else 0.0 for z in (earlier, now)]
    return _Picture(first, title_of(first.statistic), squares[0], squares[1], picture, traces[1:])


def diagnosis_figures(found: Diagnosis) -> dict[str, Callable[[], Figure]]:
    """The figures of a diagnosis that show no trace, by name: the ladder of errors, and each map of pixels."""
    out: dict[str, Callable[[], Figure]] = {}
    if found.ladder:
        ladder = sorted(found.ladder, key=lambda row: bool(row["placebo"]))
        out["ladder"] = partial(figures.figure_by, _draw_ladder, ladder, found.null_95, _BROAD)
    for step in found.steps:
        odd = odd_pixels_of(found, step)
        if odd is not None:
            out[results.title(step.candidate)] = odd.figure
    return out


def _ladder_picture(rows: Sequence[Mapping[str, Any]], floor: float, width: float) -> Picture:
    words = ", ".join(f"{row['model']}: {number(row['misfit'])}" for row in rows)
    words = f"The ladder of errors: misfit of each model on held-out data. {words}; noise floor: {number(floor)}"
    return Picture(figures.drawn(_draw_ladder, rows, floor, width), words)


def _draw_ladder(figure: Figure, rows: Sequence[Mapping[str, Any]], floor: float, width: float) -> None:
    """Misfits as bars on a logarithmic axis, each fall between two of them; the noise floor; the placebo aside."""
    misfits = np.array([min(max(float(row["misfit"]), 1e-3), 1e12) for row in rows])
    floor = max(floor, 1e-3)
    aside = np.array([bool(row["placebo"]) for row in rows])
    x = np.arange(len(rows)) + 0.3 * aside
    low, high = min(0.5, 0.6 * float(misfits.min()), 0.6 * floor), max(float(misfits.max()), floor)
    high *= (high / low) ** 0.12
    names = [_broken(str(row["model"])) for row in rows]
    longest = max(len(line) for name in names for line in name.split("\n"))
    tight = (width - 1.3) / (float(x[-1]) + 1) < _LETTER * longest
    figure.set_size_inches(width, 4.6 if tight else 3.9)
    axes = figure.subplots()
    axes.set_yscale("log")
    axes.set_ylim(low, high)
    axes.set_xlim(-0.5, float(x[-1]) + 0.5)
    axes.axhspan(low, floor, color=_FLOOR, linewidth=0, zorder=0)
    axes.axhline(floor, color=_REACHED, linewidth=1.2, linestyle=(0, (5, 3)), zorder=3)
    axes.annotate(
        f"noise\nfloor\n{number(floor)}",
        (1.0, floor),
        xycoords=("axes fraction", "data"),
        xytext=(5, 0),
        textcoords="offset points",
        va="center",
        color=_REACHED,
    )
    for at, misfit, placebo in zip(x, misfits, aside, strict=True):
        reached = misfit <= floor
        colour = _PLACEBO if placebo else _REACHED if reached else _ABOVE
        axes.bar(at, misfit - low, bottom=low, width=0.62, color=colour, linewidth=0, zorder=2)
        axes.annotate(
            number(misfit),
            (at, max(misfit, floor) if misfit > 0.6 * floor else misfit),  # not across the line
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            va="bottom",
            color=ROUGH if placebo else _REACHED if reached else MEASURED,
            fontweight="normal" if placebo else "bold",
            fontsize=11,
            zorder=4,
        )
    steps = misfits[~aside]
    for k, (before, after) in enumerate(itertools.pairwise(steps)):
        if math.log(before / max(after, floor)) < 0.18 * math.log(high / low):
            continue  # no room for an arrow
        axes.plot([k + 0.31, k + 1.12], [before, before], color=ROUGH, linewidth=0.8, linestyle=(0, (2, 2)))
        arrow = {"arrowstyle": "-|>", "color": ROUGH, "shrinkA": 0, "shrinkB": 18, "linewidth": 1.1}
        axes.annotate("", (k + 1, max(after, floor)), xytext=(k + 1, before), arrowprops=arrow, zorder=4)
    turned: dict[str, Any] = {}
    if tight:
        names = [figures.shortened(str(row["model"]), 32) for row in rows]
        turned = {"rotation": 40, "ha": "right", "rotation_mode": "anchor"}
    axes.set_xticks(x, names, **turned)
    axes.tick_params(axis="x", length=0, labelcolor=MEASURED)
    axes.set_ylabel("misfit on held-out data")
    figures.powers(axes.yaxis)


def _broken(name: str) -> str:
    """A name in lines that fit below a bar."""
    lines = [""]
    for part in re.split(r"(?<=[ _.:])", figures.shortened(name, 60)):
        if lines[-1] and len(lines[-1] + part.rstrip()) > _LINE:
            lines.append("")
        lines[-1] += part
    return "\n".join(line.strip() for line in lines)


# --- the page -------------------------------------------------------------------------------------------------------

_TEMPLATE = """\
{% extends "frame" %}
{% macro pictured(one) %}
<p><b>{{ one.trace.where[:1] | upper }}{{ one.trace.where[1:] }}</b>\
{% if one.trace.size %}: <span class="size">{{ one.trace.size }}</span>{% endif %}</p>
<p class="tag"><b>{{ one.trace.statistic }}</b> of <b>{{ one.trace.capture or "all captures" }}</b> &middot; \
{{ one.title }} &middot; mean squared residual {{ one.before | number }} before, <b>{{ one.after | number }}</b> after\
{% if one.alike %} &middot; also in {{ one.alike | map(attribute="capture") | join(", ") }}{% endif %}</p>
{% if one.picture %}
<div class="pan"><img src="{{ one.picture.source }}" alt="{{ one.picture.alternative }}"></div>
{% if one.picture.note %}<p class="small">{{ one.picture.note }}</p>{% endif %}
{% endif %}
{% endmacro %}
{% block title %}{{ found.sensor }} against {{ found.measurement }}: {{ "not finished, " if not found.finished }}\
{{ verdict | lower }}{% endblock %}
{% block kind %}{{ kind }} with a measurement{% endblock %}
{% block style %}
main { max-width: 1160px; }
.verdict.open { border-left-color: var(--open); }
.ladder { display: grid; grid-template-columns: minmax(0, 9fr) minmax(0, 12fr); gap: 20px; align-items: start; }
.ladder figure { background: var(--card); border: 1px solid var(--line); padding: 10px 12px; margin: 0; }
.ladder img { width: 100%; height: auto; display: block; }
.ladder .narrow { display: none; }
.rungs td:not(:first-child), .rungs th:not(:first-child) { text-align: right; font-variant-numeric: tabular-nums; }
.rungs td:first-child { min-width: 8.5em; overflow-wrap: break-word; }
.rungs th { overflow-wrap: normal; padding: 3px 5px; } .rungs td:not(:first-child) { white-space: nowrap; }
.rungs .placebo td { color: var(--soft); }
.rungs .floor td { border-top: 2px dashed var(--good); color: var(--good); }
.list th { overflow-wrap: normal; }
.list td:first-child { min-width: 9em; overflow-wrap: break-word; }
.list .figure { white-space: nowrap; font-variant-numeric: tabular-nums; }
.pair { display: grid; grid-template-columns: minmax(0, 6fr) minmax(0, 5fr); gap: 20px; margin-top: .7rem; }
@media (max-width: 1180px) { .ladder { grid-template-columns: minmax(0, 1fr); gap: 12px; } }
@media (max-width: 900px) { .pair { grid-template-columns: minmax(0, 1fr); gap: 12px; } }
@media (max-width: 600px) { .ladder .narrow { display: block; } .ladder .broad { display: none; } }
{% endblock %}
{% block body %}
<section class="verdict {{ look }}">
<h1>{{ opening }}</h1>
<p class="lead">{% if found.steps %}\
The misfit on held-out data {{ "fell" if found.after < found.before else "went" }} from \
<b>{{ found.before | number }}</b> to <b>{{ found.after | number }}</b>\
{% else %}The misfit on held-out data is <b>{{ found.before | number }}</b>{% endif %}; \
a right model stays below {{ found.null_95 | number }} in 95 of 100 measurements.\
{% if fallen %} The misfit does not contain the totals: the error of the {{ fallen[0] }} fell from \
<b>{{ (100 * fallen[1]) | number }} %</b> to <b>{{ (100 * fallen[2]) | number }} %</b>.\
{% elif found.steps and found.before <= found.null_95 %} It was as low before: a mean over everything hardly \
shows what is faint in each statistic, or what only a few of them show.{% endif %}</p>
{% if headline %}<p>In sample, the misfit is {{ found.in_sample.misfit | number }}; worst check: \
{{ headline }}.</p>{% endif %}
<p class="small">{{ found.sensor or "A sensor without a name" }}\
{% if found.crop %}, its rows and columns {{ found.crop }} (places count from the first of them),{% endif %} \
against {{ found.measurement }}\
{% if next %} &middot; the {{ "next" if found.values else "same" }} model is in the file <b>{{ next }}</b>\
{% if not found.values %} (nothing was added){% endif %}{% endif %}\
{% if found.unwritten %} &middot; the next sensor file was not written: {{ found.unwritten }}{% endif %}\
{% if found.simulations %} &middot; {{ "{:,}".format(found.simulations) }} simulated recordings{% endif %}</p>
<p class="next"><b>Next:</b> {{ source.then or then }}</p>
</section>
<!-- contents -->

{% if steps %}
<h2>{{ "What was fitted" if found.asked == "fit" else "What is missing" }}</h2>
<p class="small">In the pictures, dots are measured, orange is the model before all steps, blue the model after them;
the light blue band holds 95 % of its scatter. Below, or to the right, are the residuals of both models in units of
that scatter (sigmas); coloured lines are the residuals before of further captures. A ring marks the clearest place.</p>
{% for card in steps %}
<section class="card">
<h3>{{ loop.index }}. {{ card.title }}</h3>
<p class="tag">{{ card.kind }} &middot; <b>{{ "%.1f" | format(card.step.significance) }} sigma</b> &middot; \
<b>{{ card.step.material }}</b> &middot; \
{% if card.step.where %}{{ card.step.where }} &middot; {% endif %}\
misfit on held-out data with it <b>{{ card.step.misfit | number }}</b></p>
{% if card.about %}<p>{{ card.about }}</p>{% endif %}
<div class="pair">
{% if card.numbers %}
<div class="wide"><table class="list">
<thead><tr><th>parameter</th><th>value, 95 % interval</th></tr></thead>
<tbody>
{% for n in card.numbers %}
<tr><td><b>{{ n.name }}</b>{% if n.about %}<br><span class="small">{{ n.about }}</span>{% endif %}</td>\
<td class="figure"><b>{{ n.value }}</b>{% if n.interval %}<br><span class="small">{{ n.interval }}</span>{% endif %}\
</td></tr>
{% endfor %}
</tbody></table></div>
{% endif %}
{% if card.step.alternatives %}
<div class="wide"><table class="list">
<thead><tr><th>alternative</th><th>in-sample misfit with it</th></tr></thead>
<tbody>
{% for other in card.step.alternatives %}
<tr><td>{{ name(other) }}\
{% if other.effect and about(other.effect) %}<br><span class="small">{{ about(other.effect) }}</span>{% endif %}</td>\
<td class="figure">{{ other.misfit | number }}</td></tr>
{% endfor %}
</tbody></table></div>
{% endif %}
</div>
{% if card.odd %}
<div class="pan"><img src="{{ card.odd.picture.source }}" alt="{{ card.odd.picture.alternative }}"></div>
<p>{{ card.odd.sentence }} <a href="{{ card.odd.file }}">{{ card.odd.file }}</a> lists them.</p>
{% if card.odd.rows %}
<details><summary>{{ card.odd.rows | length }} odd pixels\
{% if card.odd.number > card.odd.rows | length %} of {{ card.odd.number }}{% endif %}</summary>
<div class="wide"><table class="list">
<thead><tr><th>pixel</th><th>value</th><th>relative to the others, or to those around it</th><th>kind</th></tr></thead>
<tbody>
{% for row in card.odd.rows %}
<tr><td>{{ row.where }}</td><td class="figure">{{ row.value }}</td>\
<td class="figure">{{ row.ratio | number }}</td><td>{{ row.kind }}</td></tr>
{% endfor %}
</tbody></table></div>
</details>
{% endif %}
{% endif %}
{% for one in card.pictures[:1] %}
{{ pictured(one) }}
{% endfor %}
{% if card.pictures | length > 1 %}
<details><summary>{{ card.pictures | length - 1 }} more \
{{ "deviation" if card.pictures | length == 2 else "deviations" }}</summary>
{% for one in card.pictures[1:] %}
{{ pictured(one) }}
{% endfor %}
</details>
{% endif %}
</section>
{% endfor %}
{% endif %}

{% if remains %}
<h2>What remains</h2>
<p>{{ mechanism[:1] | upper }}{{ mechanism[1:] }}.</p>
<div class="wide"><table class="list">
<thead><tr><th>deviation, its clearest place and size</th><th>significance</th></tr></thead>
<tbody>
{% for entry, title, others in remains %}
<tr><td>{{ entry.where }}{% if entry.get('size') %}: <b>{{ entry['size'] }}</b>{% endif %}<br>\
<span class="small"><b>{{ entry.statistic }}</b> of <b>{{ entry.capture or "all captures" }}</b> &middot; {{ title }}\
{% if others %}<br>also in {{ others }}{% endif %}</span></td>\
<td class="figure fails">{{ "%.1f" | format(entry.significance) }} sigma</td></tr>
{% endfor %}
</tbody></table></div>
{% if nearest %}<p>Nearest, but it explains too little of its own cells: {{ nearest | join(", ") }}.</p>
{% endif %}
{% endif %}

{% if found.setup or found.nuisances %}
<h2>The set-up</h2>
{% if found.setup %}
<div class="wide"><table class="list">
<thead><tr><th>capture</th><th>what is not as stated</th><th>factor</th><th>95 % interval</th></tr></thead>
<tbody>
{% for entry in found.setup %}
<tr><td>{{ entry.capture or "all" }}</td><td>{{ "or " if entry.confused }}{{ entry.quantity }}</td>\
<td class="figure"><b>{{ entry.factor.value | factor }}</b></td>\
<td class="figure">{{ entry.factor.low | factor }} to {{ entry.factor.high | factor }}</td></tr>
{% endfor %}
</tbody></table></div>
{% if found.setup | selectattr("confused") | list %}
<p class="small">This measurement cannot separate those that begin with "or": \
{{ "of those of one capture, any one" if " and " in found.faulty else "any of them" }} is enough.</p>
{% endif %}
{% endif %}
{% if found.nuisances %}
<p class="small">The light level has an uncertainty and is fitted. The pull is its deviation from the stated level in
units of that uncertainty; beyond 3, the stated level should be doubted.</p>
<div class="wide"><table class="list">
<thead><tr><th>light of</th><th>factor on what is stated</th><th>95 % interval</th><th>pull</th></tr></thead>
<tbody>
{% for n in found.nuisances[:200] %}
<tr><td>{{ n.capture or "all lit captures" }}</td><td class="figure">{{ "%.4f" | format(n.value) }}</td>\
<td class="figure">{{ "%.4f" | format(n.low) }} to {{ "%.4f" | format(n.high) }}</td>\
<td class="figure{{ ' fails' if n.pull | abs > 3 }}">{{ "%+.1f" | format(n.pull) }}</td></tr>
{% endfor %}
</tbody></table></div>
{% endif %}
{% endif %}

{% if found.advice %}
<h2>What to measure next</h2>
{% for one in found.advice %}
<section class="card">
<h3>To separate {{ one.separates | join(" from ") }}: take {{ one.capture }}</h3>
<p class="tag">They differ by <b>{{ "%.1f" | format(one.significance_now) }} sigma</b> now, and would differ by \
<b>{{ "%.1f" | format(one.significance_then) }} sigma</b> with it.</p>
</section>
{% endfor %}
{% endif %}

{% if ladder %}
<h2>The ladder of errors</h2>
<div class="ladder">
<figure><img class="broad" src="{{ broad.source }}" alt="{{ broad.alternative }}">\
<img class="narrow" src="{{ narrow.source }}" alt="{{ narrow.alternative }}"></figure>
<div class="wide"><table class="rungs">
<thead><tr><th>model</th><th>misfit on held-out data</th>\
{% for label in columns.values() %}<th>{{ label }}, %</th>{% endfor %}</tr></thead>
<tbody>
{% for row in ladder %}
<tr{% if row.placebo %} class="placebo"{% endif %}><td>{{ row.model }}</td>\
<td{% if row.misfit <= found.null_95 and not row.placebo %} class="passes"{% endif %}>{{ row.misfit | number }}</td>\
{% for key in columns %}<td>{{ error(row, key) }}</td>{% endfor %}</tr>
{% endfor %}
<tr class="floor"><td>noise floor (95 %)</td><td>{{ found.null_95 | number }}</td>\
{% for key in columns %}<td></td>{% endfor %}</tr>
</tbody></table>
</div>
</div>
<p class="small">The misfit is the mean squared residual on data that the model was not fitted to. Each capture is
judged by parameters fitted to the others. Where one capture alone informs a parameter or a map, it is cut into
alternating blocks of time, and each half is judged by the fit of the other (a misfit of half as many detections is
about half as large); alternatives are judged by whole captures. A bar that reaches the dashed line is as good as a
right model.{% for row in ladder if row.placebo %} The placebo is an unrelated effect at its best strength: as much
falls whatever is added.{% endfor %} The columns are the errors that are left, in physical units; "-" was not
measured.</p>
{% endif %}

{% if others %}
<h2>Further deviations</h2>
{% for one in others %}
<section class="card">
{{ pictured(one) }}
</section>
{% endfor %}
{% endif %}

{% if limits %}
<h2>What is not there</h2>
<details><summary>95 % upper limits of {{ limits | length }} \
{{ "parameter" if limits | length == 1 else "parameters" }}</summary>
<div class="wide"><table class="list">
<thead><tr><th>effect</th><th>parameter</th><th>at most</th></tr></thead>
<tbody>
{% for entry, limit, meaning in limits %}
<tr><td><b>{{ entry.effect }}</b><br><span class="small">{{ about(entry.effect) }}</span></td>\
<td>{{ entry.parameter }}{% if meaning %}<br><span class="small">{{ meaning }}</span>{% endif %}</td>\
<td class="figure"><b>{{ limit }}</b></td></tr>
{% endfor %}
</tbody></table></div>
</details>
{% endif %}

{% if found.untried %}
<h2>What was not tried</h2>
<p class="small">Candidates that could not be simulated there, and what a budget ended.</p>
<div class="wide"><table class="list">
<thead><tr><th>candidate</th><th>where</th><th>why</th></tr></thead>
<tbody>
{% for entry in found.untried %}
<tr><td><b>{{ named(entry) }}</b></td><td>{{ entry.where }}</td><td>{{ entry.why }}</td></tr>
{% endfor %}
</tbody></table></div>
{% endif %}

{% if hidden %}
<h2>What this measurement cannot show</h2>
<details><summary>{{ hidden | length }} {{ "effect" if hidden | length == 1 else "effects" }}</summary>
<dl class="words">
{% for effect, meaning in hidden %}
<dt>{{ effect }}</dt><dd>{{ meaning }}</dd>
{% endfor %}
</dl>
</details>
{% endif %}

<h2>Words</h2>
<details><summary>What the words mean</summary>
<dl class="words">
<dt>residual, sigma</dt><dd>The difference between data and model in units of the model's scatter. Of a step, sigma is
its significance, with the number of candidates allowed for.</dd>
<dt>misfit</dt><dd>The mean squared residual over all statistics of all captures. 1 is what the model's own simulations
have; 4 means that data and model are typically twice as far apart as chance makes them. On held-out data: the model
was fitted to other data. In sample: to the same.</dd>
<dt>noise floor</dt><dd>95 of 100 measurements of a right model have a misfit below this.</dd>
<dt>mean rate, map, linearity, intervals, neighbours</dt><dd>Errors in physical units: the rms error of the captures'
rates; of the pixels' rates; the largest deviation of one light level from the others; the share of intervals between
detections in wrong cells; the share of detections whose neighbours fire too often or too seldom. Others are those of
your own statistics.</dd>
<dt>95 % interval</dt><dd>It contains the true value in 95 of 100 measurements if the fitted model is right. Where
checks still fail, or another law is at work, the true value may lie outside.</dd>
<dt>placebo</dt><dd>An unrelated effect, fitted all the same: as much falls by itself.</dd>
<dt>set-up</dt><dd>Light level, exposure, wavelength, a leak in a dark capture: what the measurement states of itself.
Where it explains everything, the sensor is right.</dd>
</dl>
</details>
{% endblock %}
"""
