"""The page of `compare`: where a model fails, by how much, with pictures of the clearest checks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..inference import next_step
from ..inference.comparison import Check, Comparison, headline, others_of
from ..inference.light_levels import Nuisance
from . import _figures as figures
from ._figures import BAND, COVERED, MEASURED, MODEL, WIDTH, WORST, Cells, Picture
from ._frame import Source, title_of, write

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PICTURES = 8  # of deviations; the others stand in a table
_FOLDED = 3  # pictures of further checks of one deviation
_OVERLAID = 4  # further captures in one picture
_NEAREST = 3  # pictures where nothing fails
_ACROSS = 8  # captures side by side in the table of all checks
_MOST = 4000  # checks that are listed, so that the page stays small whatever is compared
_LIGHTS = 24


def comparison(found: Comparison, folder: Path, source: Source | None = None) -> Path:
    """Write the page of a comparison as `index.html` in a folder, which is made if it is not there; its path.

    A page that an earlier comparison left there is replaced, whatever else lies there stays as it is. Raises SpadError
    as `check_place` does, or where the file cannot be written.
    """
    return write(folder, "comparison", _TEMPLATE, _words(found), source)


@dataclass(frozen=True)
class _Card:
    """A deviation, or a check that passes. check: the one that names it; more: the others; folded: their pictures."""

    check: Check
    title: str
    picture: Picture | None
    more: Sequence[Check] = ()
    also: str = ""
    folded: Sequence[tuple[Check, Picture]] = ()


def _words(found: Comparison) -> dict[str, Any]:
    failing, groups = found.failing, found.deviations
    significant = {id(c) for c in found.checks if c.significant}
    immaterial = []
    if found.tolerance is not None:
        immaterial = [c for c in _clearest(found.checks) if c.passes and id(c) in significant]
    nearest = [c for c in _clearest(found.checks) if c.passes and c.summary is not None][:_NEAREST]
    captures = list(dict.fromkeys(c.capture for c in found.checks if c.capture is not None))
    listed = _clearest(found.checks)[:_MOST]
    cards = [_card(group) for group in groups[:_PICTURES]] if groups else [_card([check]) for check in nearest]
    return {
        "found": found,
        "then": next_step.after_comparison(found),
        "headline": headline(found) if found.checks else "",
        "failing": failing,
        "groups": groups,
        "clearest": found.worst if failing else None,
        "immaterial": immaterial,
        "captures": captures,
        "statistics": {c.statistic: title_of(c.statistic) for c in found.checks},
        "light": _light_picture(found.nuisances) if found.nuisances else None,
        "cards": cards,
        "others": [c for group in groups[_PICTURES:] for c in group],
        "matrix": list(_matrix(listed, captures, significant)),
        "listed": listed,
        "judged": lambda check: _judged(check, significant),
    }


def _card(group: Sequence[Check]) -> _Card:
    """One card a deviation: its check with the other captures of that statistic overlaid, pictures of others folded."""
    first = group[0]
    alike = [c for c in group[1:] if c.statistic == first.statistic][:_OVERLAID]
    folded: list[tuple[Check, Picture]] = []
    for check in group[1:]:
        if check.statistic not in {first.statistic, *(c.statistic for c, _ in folded)} and len(folded) < _FOLDED:
            picture = _picture(check)
            folded += [(check, picture)] if picture else []
    return _Card(first, title_of(first.statistic), _picture(first, alike), group[1:], others_of(group), folded)


def _clearest(checks: Iterable[Check]) -> list[Check]:
    return sorted(checks, key=lambda c: (c.p_value, -c.misfit))


def _judged(check: Check, significant: set[int]) -> str:
    if not check.passes:
        return "fails"
    return "small" if id(check) in significant else "passes"


def _matrix(
    checks: Sequence[Check], captures: Sequence[str], significant: set[int]
) -> Iterator[tuple[list[str | None], list[tuple[str, list[tuple[Check, str] | None]]]]]:
    """Tables of (captures, rows): a row is a statistic and its check of each capture, with the colour of its cell."""
    by_place = {(c.statistic, c.capture): c for c in reversed(checks)}
    columns = [capture for capture in captures if any(c.capture == capture for c in checks)]
    all_columns: list[str | None] = [*([None] if any(c.capture is None for c in checks) else []), *columns]
    for start in range(0, len(all_columns), _ACROSS):
        some = all_columns[start : start + _ACROSS]
        rows = []
        for name in sorted({c.statistic for c in checks if c.capture in some}):
            cells = [by_place.get((name, capture)) for capture in some]
            rows.append((name, [None if c is None else (c, _colour(c, significant)) for c in cells]))
        yield some, rows


def _colour(check: Check, significant: set[int]) -> str:
    judged = _judged(check, significant)
    if judged != "passes":
        return judged
    return "low" if check.p_value < 0.01 else "lowish" if check.p_value < 0.05 else "passes"


def check_figure(check: Check) -> Figure:
    """The figure of a check that has cells: measured, expected, residuals."""
    cells = _cells(check)
    assert cells is not None
    return figures.figure_of(cells)


def _picture(check: Check, alike: Sequence[Check] = ()) -> Picture | None:
    """Measured and simulated, cell by cell, and the residuals; alike: of further captures, which are overlaid."""
    cells = _cells(check)
    words = f"{check.statistic} of {check.capture}: measured and simulated. Clearest at {check.where}: {check.size}"
    if cells is None:
        return None
    others = [(str(other.capture), more) for other in alike if (more := _cells(other)) is not None]
    return figures.picture(replace(cells, overlaid=tuple(others)), words)


def _cells(check: Check) -> Cells | None:
    summary, judgement = check.summary, check.judgement
    if summary is None or judgement is None or not np.size(summary.values):
        return None
    spread = np.broadcast_to(figures.finite(judgement.spread), np.shape(summary.values))
    expected, residuals = figures.finite(judgement.expected), figures.finite(judgement.residuals)
    return Cells(
        check.statistic, summary, expected, spread, residuals, int(judgement.worst), name=str(check.capture or "")
    )


def comparison_figures(found: Comparison) -> dict[str, Callable[[], Figure]]:
    """The figures of a comparison that show no check, by name."""
    shown, _ = _lights(found.nuisances)
    return {"light": partial(figures.figure_by, _draw_light, shown)} if shown else {}


def _lights(nuisances: Sequence[Nuisance]) -> tuple[list[Nuisance], str]:
    """(the light levels that are drawn, a note where these are not all)."""
    clearest = sorted(nuisances, key=lambda n: (n.capture is not None, -abs(n.pull)))[:_LIGHTS]
    note = f"Of {len(nuisances)} the {_LIGHTS} with the largest pulls." if len(nuisances) > _LIGHTS else ""
    return [n for n in nuisances if n in clearest], note


def _light_picture(nuisances: Sequence[Nuisance]) -> Picture:
    shown, note = _lights(nuisances)
    return Picture(figures.drawn(_draw_light, shown), "Light of each capture, as a factor on what is stated", note)


def _draw_light(figure: Figure, nuisances: Sequence[Nuisance]) -> None:
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    figure.set_size_inches(WIDTH, 0.95 + 0.3 * len(nuisances))
    axes = figure.subplots()
    rows = np.arange(len(nuisances), dtype=np.float64)
    stated = max((n.stated for n in nuisances if n.capture is None), default=0.0)
    if stated > 0:
        span = math.exp(-COVERED * stated), math.exp(COVERED * stated)
        axes.axvspan(*span, color=BAND, linewidth=0, label=f"as stated, 95 %: within {100 * COVERED * stated:.2g} %")
    axes.axvline(1.0, color=MODEL, linewidth=1.2)
    for row, n in zip(rows, nuisances, strict=True):
        colour = WORST if abs(n.pull) > 3 else MEASURED
        axes.plot([n.low, n.high], [row, row], color=colour, linewidth=1.6)
        axes.plot(
            [n.value], [row], "o", color=colour, markersize=5, label="found, with 95 % interval" if not row else None
        )
        axes.annotate(
            f"pull {n.pull:+.1f}",
            (1.0, row),
            xycoords=("axes fraction", "data"),
            xytext=(6, 0),
            textcoords="offset points",
            va="center",
            color=colour,
        )
    axes.set_yticks(rows, [figures.shortened(n.capture or "all lit captures", 36) for n in nuisances])
    axes.set_ylim(len(nuisances) - 0.4, -0.6)
    axes.margins(x=0.1)
    axes.xaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:.6g}"))
    axes.set_xlabel("light, as a factor on what is stated")
    figures.legend(axes)


# --- the page -------------------------------------------------------------------------------------------------------

_TEMPLATE = """\
{% extends "frame" %}
{% macro table(checks) %}
<div class="wide"><table class="list">
<thead><tr><th>statistic</th><th>capture</th><th>p-value</th><th>misfit</th><th>where it differs most</th>\
<th>size</th></tr></thead>
<tbody>
{% for c in checks %}
{% set verdict = judged(c) %}
<tr><td>{{ c.statistic }}</td><td>{{ c.capture or "all" }}</td>\
<td class="{{ {'fails': 'fails', 'small': 'small-one', 'passes': ''}[verdict] }}">\
{{ {"fails": "✗ ", "small": "≈ ", "passes": ""}[verdict] }}{{ c.p_value | p }}</td>\
<td>{{ c.misfit | number }}</td><td>{{ c.where }}</td><td>{{ c.size }}</td></tr>
{% endfor %}
</tbody></table></div>
{% endmacro %}
{% block title %}{{ found.sensor }} against {{ found.measurement }}: {{ found.verdict }}{% endblock %}
{% block style %}
.light img { width: 100%; height: auto; display: block; margin-top: .5rem; }
.light { background: var(--card); border: 1px solid var(--line); padding: 8px 14px; margin: 0; break-inside: avoid; }
.matrix { width: auto; table-layout: auto; }
.matrix thead th { max-width: 9rem; min-width: 3.6rem; font-weight: 500; }
.matrix td { text-align: center; white-space: nowrap; font-variant-numeric: tabular-nums; }
.list td:nth-child(3), .list td:nth-child(4) { white-space: nowrap; font-variant-numeric: tabular-nums; }
.list th, .lights th, .lights td:not(:first-child) { white-space: nowrap; }
.list td:nth-child(1) { min-width: 9em; } .list td:nth-child(2) { min-width: 6.5em; }
.list td:nth-child(5) { min-width: 14em; } .list td:nth-child(6) { min-width: 16em; }
td.small-one, .key.small-one { background: var(--small); }
td.low, .key.low { background: var(--low); }
td.lowish, .key.lowish { background: var(--lowish); }
{% endblock %}
{% block kind %}Comparison of a model with a measurement{% endblock %}
{% block body %}
<section class="verdict {{ 'fails' if failing else 'adequate' }}">
{% if failing %}
<h1>The model fails {{ failing | length }} of {{ found.checks | length }} checks: {{ clearest.where }}, in \
{{ clearest.capture or "all captures" }}: {{ clearest.size }}.</h1>
<p class="lead">The misfit is <b>{{ found.misfit | number }}</b>; 95 % of the model's own recordings stay below \
{{ found.misfit_null_95 | number }}. The checks show \
{{ "one deviation" if groups | length == 1 else groups | length ~ " deviations" }}, most clearly \
<b>{{ clearest.statistic }}</b> of <b>{{ clearest.capture or "all captures" }}</b> \
({{ clearest.p_value | p_words }}).</p>
{% elif found.checks %}
<h1>The model is adequate: none of {{ found.checks | length }} checks fails\
{{ " beyond the tolerance" if immaterial }}.</h1>
<p class="lead">The misfit is <b>{{ found.misfit | number }}</b>; 95 % of the model's own recordings stay below \
{{ found.misfit_null_95 | number }}{% if immaterial %}; {{ immaterial | length }} \
{{ "differs" if immaterial | length == 1 else "differ" }} by more than chance, but by less than \
{{ found.tolerance | percent }}{% endif %}.</p>
{% else %}
<h1>Nothing could be checked.</h1>
<p class="lead">The measurement has neither data nor a light level that is known.</p>
{% endif %}
{% if found.checks and not failing %}<p>Worst check: {{ headline }}.</p>{% endif %}
<p class="next"><b>Next:</b> {{ source.then or then }}</p>
</section>
<!-- contents -->

{% if failing %}
<h2>Where it fails</h2>
{% elif cards %}
<h2>What came nearest to failing</h2>
{% endif %}
{% if cards %}
<p class="small">Dots are measured; the blue line is the mean of the simulations, and the light blue band holds 95 % of
their scatter. Residuals are the differences in units of that scatter (sigmas); those of further captures are coloured
lines. A ring marks where the residual is largest.</p>
{% endif %}
{% for card in cards %}
<section class="card">
<h3>{% if groups | length > 1 %}{{ loop.index }}. {% endif %}\
{{ card.check.where[:1] | upper }}{{ card.check.where[1:] }}: \
<span class="size">{{ card.check.size }}</span></h3>
<p class="tag"><b>{{ card.check.statistic }}</b> of <b>{{ card.check.capture or "all captures" }}</b> &middot; \
{{ card.check.p_value | p_words }} &middot; misfit {{ card.check.misfit | number }} &middot; {{ card.title }}</p>
{% if card.picture %}
<div class="pan"><img src="{{ card.picture.source }}" alt="{{ card.picture.alternative }}"></div>
{% if card.picture.note %}<p class="small">{{ card.picture.note }}</p>{% endif %}
{% endif %}
{% if card.more %}
<p>The same deviation is in {{ card.also }}.</p>
<details><summary>{{ card.more | length }} more {{ "check" if card.more | length == 1 else "checks" }}</summary>
{{ table(card.more[:40]) }}
{% for check, picture in card.folded %}
<p class="tag"><b>{{ check.statistic }}</b> of <b>{{ check.capture or "all captures" }}</b></p>
<div class="pan"><img src="{{ picture.source }}" alt="{{ picture.alternative }}"></div>
{% endfor %}
</details>
{% endif %}
</section>
{% endfor %}
{% if others %}
<h3>{{ others | length }} more {{ "check fails" if others | length == 1 else "checks fail" }}</h3>
{{ table(others[:20]) }}
{% if others | length > 20 %}
<p class="small">The {{ others | length - 20 }} others stand in the list of all checks.</p>
{% endif %}
{% endif %}

<h2>What was compared</h2>
<dl class="facts">
<dt>model</dt><dd>{{ found.sensor or "a sensor without a name" }}\
{% if found.crop %}, its rows and columns {{ found.crop }} (places count from the first of them){% endif %}</dd>
<dt>measurement</dt><dd>{{ found.measurement }}</dd>
<dt>captures</dt><dd>{{ captures | length }}{% if captures %}: {{ captures[:40] | join(", ") }}\
{{ ", ..." if captures | length > 40 }}{% endif %}</dd>
<dt>checks</dt><dd>{{ found.checks | length }}, of {{ statistics | length }} kinds</dd>
{% if found.not_compared %}<dt>not compared</dt><dd>{% for name, id in found.not_compared %}{{ name }} of {{ id }}\
{{ ", " if not loop.last }}{% endfor %}: some simulations have too few data for that</dd>
{% endif %}\
{% if found.faint %}<dt>by number alone</dt><dd>{{ found.faint | join(", ") }}: so few detections are expected</dd>
{% endif %}\
<dt>simulations</dt><dd>{{ found.replicates }} of each capture, with as many detections as were measured</dd>
<dt>false alarms</dt><dd>a right model is called wrong in {{ found.false_alarm_rate | percent }} of comparisons</dd>
<dt>tolerance</dt><dd>{% if found.tolerance is none %}none: whatever differs by more than chance counts\
{% else %}{{ found.tolerance | percent }}: what is smaller does not count as a failure{% endif %}</dd>
</dl>

{% if light %}
<h2>Light</h2>
<p>The light level has an uncertainty. It is fitted, so that the model gives as many detections as were measured. The
pull is the deviation from the stated level in units of its uncertainty.</p>
<figure class="light"><div class="pan"><img src="{{ light.source }}" alt="{{ light.alternative }}"></div>
{% if light.note %}<figcaption class="small">{{ light.note }}</figcaption>{% endif %}</figure>
<div class="wide"><table class="lights">
<thead><tr><th>light of</th><th>factor on what is stated</th><th>95 % interval</th><th>pull</th></tr></thead>
<tbody>
{% for n in found.nuisances[:200] %}
<tr><td>{{ n.capture or "all lit captures" }}</td><td>{{ "%.4f" | format(n.value) }}</td>\
<td>{{ "%.4f" | format(n.low) }} to {{ "%.4f" | format(n.high) }}</td><td>{{ "%+.1f" | format(n.pull) }}</td></tr>
{% endfor %}
</tbody></table></div>
{% endif %}

{% if immaterial %}
<h2>Real, but smaller than the tolerance</h2>
<p>These differ by more than chance, so something is missing in the model; but they are smaller than \
{{ found.tolerance | percent }}, so it does not matter for the verdict.</p>
{{ table(immaterial[:200]) }}
{% endif %}

{% if found.checks %}
<h2>All checks at a glance</h2>
<p class="small">p-values: <span class="key fails">&#10007; fails</span>\
{% if immaterial %}<span class="key small-one">&asymp; below the tolerance</span>{% endif %}\
<span class="key low">below 0.01</span><span class="key lowish">below 0.05</span>\
<span class="key passes">passes</span>{% if found.checks | length >= 20 %} \
In {{ found.checks | length }} checks of a right model chance alone leaves about \
{{ (found.checks | length * 0.05) | round | int }} below 0.05; that is allowed for.{% endif %}</p>
{% for columns, rows in matrix %}
<div class="wide"><table class="matrix">
<thead><tr><th></th>{% for capture in columns %}\
<th scope="col">{{ capture or "all captures" }}</th>{% endfor %}</tr></thead>
<tbody>
{% for name, cells in rows %}
<tr><th scope="row" title="{{ statistics[name] }}">{{ name }}</th>{% for cell in cells %}\
{% if cell is none %}<td></td>{% else %}<td class="{{ 'small-one' if cell[1] == 'small' else cell[1] }}">\
{{ "✗ " if cell[1] == "fails" }}{{ "≈ " if cell[1] == "small" }}{{ cell[0].p_value | p }}</td>\
{% endif %}{% endfor %}</tr>
{% endfor %}
</tbody></table></div>
{% endfor %}

<h2>All checks, the clearest first</h2>
<details><summary>{{ listed | length }} checks</summary>
{% if listed | length < found.checks | length %}
<p class="small">The {{ listed | length }} clearest of {{ found.checks | length }}; --json FILE holds all.</p>
{% endif %}
{{ table(listed) }}
</details>

<h2>What each statistic looks at</h2>
<details><summary>{{ statistics | length }} statistics</summary>
<dl class="words">
{% for name, title in statistics.items() %}
<dt>{{ name }}</dt><dd>{{ title }}</dd>
{% endfor %}
</dl>
</details>
{% endif %}

<h2>Words</h2>
<details><summary>What the words mean</summary>
<dl class="words">
<dt>model</dt><dd>The sensor as its file describes it, with the effects that are listed there and no others.</dd>
<dt>check</dt><dd>One statistic of one capture: the same numbers are computed from the measured data and from many
simulations of that capture, and compared.</dd>
<dt>deviation</dt><dd>Failing checks that show the same difference between data and model: a sum over cells deviates
where the cells do. It is named by its most specific check.</dd>
<dt>residual, sigma</dt><dd>The difference between measured and simulated, divided by the scatter (standard deviation)
that the simulations show among themselves. Within 2 sigmas lie 95 of 100 numbers if the model is right.</dd>
<dt>misfit</dt><dd>The mean squared residual. 1 is what the model's own simulations have; 4 means that data and model
are typically twice as far apart as chance makes them.</dd>
<dt>p-value</dt><dd>How often a right model would look at least as wrong as this, by chance. A small one means that
chance is no explanation; it does not say how large the difference is. With many checks some small ones are expected,
so a check fails only if its p-value stays small after that is allowed for.</dd>
<dt>size</dt><dd>How large the difference is, in physical units. It tells whether the difference matters to you; the
p-value only tells whether it is there.</dd>
<dt>pull</dt><dd>By how many of its own uncertainties a quantity, here the light, had to be moved from what is stated.
Beyond 3, what is stated should be doubted.</dd>
<dt>tolerance</dt><dd>What is too small to matter (--tolerance). A smaller difference is listed, and does not count as a
failure.</dd>
</dl>
</details>
{% endblock %}
"""
