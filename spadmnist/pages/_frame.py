"""The frame of a page: its file, its head and style, numbers in words, and what plug-ins say of themselves."""

from __future__ import annotations

import importlib.metadata
import math
from pathlib import Path
from typing import Any

import jinja2

from .. import disk, units
from ..errors import SpadError
from ..foreign import visible_lines
from ..statistics import Statistic

# kind of page -> its file in the folder
FILES = {"comparison": "index.html", "diagnosis": "report.html", "experiment": "report.html"}

_TOTALS = {
    "light": "The light level of all lit captures together, against what the measurement states.",
    "rate": "The detections of the whole capture.",
}
_CERTAIN = 1e-12  # smaller p-values rest on tails that nobody has seen
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

# --- the file -------------------------------------------------------------------------------------------------------


def write(folder: Path, kind: str, template: str, words: dict[str, Any]) -> Path:
    """Fill the template of a page, which extends "frame", and write it into a folder, made if it is not there.

    A page of that kind that lies there is replaced, whatever else lies there stays as it is. Raises SpadError as
    `check_place` does, or where the file cannot be written.
    """
    check_place(folder, kind)
    environment = jinja2.Environment(
        autoescape=True,
        finalize=_seen,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.DictLoader({"frame": _FRAME, "page": template}),
    )
    environment.filters |= {
        "factor": units.factor,
        "number": number,
        "p": p_value,
        "p_words": p_in_words,
        "percent": percent,
    }
    version = importlib.metadata.version("spadmnist")
    text = environment.get_template("page").render(mark=_mark(kind), version=version, **words)
    page = Path(folder) / FILES[kind]
    disk.put_file(page, text.encode("utf-8", "replace"))
    return page


def _seen(value: object) -> object:
    """What stands in a template's braces, without what moves or turns the text around it."""
    return visible_lines(value) if type(value) is str else value


def check_place(folder: Path, kind: str = "comparison") -> None:
    """Raise SpadError with a sentence where no page may be put, so that it can be said before the work is done."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise SpadError(f"{folder} is a file, but a report is a folder; choose another name with -o")
    page = folder / FILES[kind]
    disk.check_outside(page)
    if page.is_symlink() or page.exists():
        try:
            ours = _mark(kind).encode() in disk.read_file(page, 64 << 20)[:2000]
        except OSError:
            ours = False
        if not ours:
            what = f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"
            raise SpadError(f"{page} is there already and is not from {what}; it is left alone: choose another -o")


def _mark(kind: str) -> str:
    return f'<meta name="generator" content="spadmnist {kind}">'


# --- words ----------------------------------------------------------------------------------------------------------


def title_of(statistic: str) -> str:
    """What a statistic looks at: the first line of its docstring."""
    try:
        return str(Statistic.registry.find(statistic).summary())
    except KeyError:  # the plug-in of a stored comparison may not be at hand
        return _TOTALS.get(statistic, statistic)


def number(value: float) -> str:
    """Three digits or four, large and small ones with a power of ten."""
    if not math.isfinite(value):
        return "beyond all numbers" if value == math.inf else "not a number"
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}·10{str(int(exponent)).translate(SUPERSCRIPT)}"


def p_value(value: float) -> str:
    """A probability, no smaller than what can be told."""
    if not value > _CERTAIN:
        return "not a number" if math.isnan(value) else f"< 10{'-12'.translate(SUPERSCRIPT)}"
    if value >= 0.001:
        return f"{value:.2g}"
    mantissa, exponent = f"{value:.0e}".split("e")
    return f"{mantissa}·10{str(int(exponent)).translate(SUPERSCRIPT)}"


def p_in_words(value: float) -> str:
    """As in a sentence: "p = 0.01"."""
    text = p_value(value)
    return f"p {text}" if text.startswith("<") else f"p = {text}"


def percent(share: float) -> str:
    """A share of 1 in per cent."""
    return f"{100 * share:.3g} %"


# --- the frame ------------------------------------------------------------------------------------------------------

_FRAME = """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
{{ mark | safe }}
<title>{% block title %}{% endblock %}</title>
<style>
:root { color-scheme: light; }
body { margin: 0; background: #fafaf8; color: #1d2329;
  font: 16px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
main { max-width: 1000px; margin: 0 auto; padding: 28px 24px 60px; }
h1 { font-size: 1.75rem; line-height: 1.25; margin: .2rem 0 .5rem; font-weight: 650; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 .7rem; padding-bottom: .25rem; border-bottom: 1px solid #dfe2e4; }
h3 { font-size: 1.02rem; margin: 0 0 .2rem; font-weight: 600; }
h1, h2, h3, p, td, th, dd, dt, figcaption { overflow-wrap: anywhere; }
p { margin: .4rem 0; }
.small { color: #5b6670; font-size: .86rem; }
.verdict { background: #fff; border: 1px solid #dfe2e4; border-left: 7px solid #4b8b62; padding: 14px 20px 12px; }
.verdict.fails { border-left-color: #c0392b; }
.lead { font-size: 1.08rem; }
.facts { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1.4rem; margin: 0; }
.facts dt { color: #5b6670; } .facts dd { margin: 0; }
.card { background: #fff; border: 1px solid #dfe2e4; padding: 14px 18px 10px; margin: 0 0 16px; break-inside: avoid; }
.card img { width: 100%; height: auto; display: block; margin-top: .5rem; }
.size { font-weight: 600; }
.tag { color: #5b6670; font-size: .86rem; }
.tag b { color: #1d2329; font-weight: 600; }
.wide { overflow-x: auto; margin: 0 0 1rem; }
table { border-collapse: collapse; font-size: .84rem; background: #fff; width: 100%; }
th, td { border: 1px solid #dfe2e4; padding: 3px 7px; text-align: left; vertical-align: top; }
thead th { background: #f1f2f1; font-weight: 600; vertical-align: bottom; }
tbody th { font-weight: 400; white-space: nowrap; }
tr { break-inside: avoid; }
.fails { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
td.fails, .key.fails { background: #f0bdb6; font-weight: 600; }
td.passes, .key.passes { background: #e4f0e6; }
td, .key { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
.key { display: inline-block; padding: 0 .5rem; border: 1px solid #dfe2e4; margin-right: .15rem; }
dl.words dt { font-weight: 600; margin-top: .6rem; } dl.words dd { margin: 0; max-width: 46rem; }
{% block style %}{% endblock %}
@media print {
  @page { margin: 14mm; }
  body { background: #fff; font-size: 10pt; } main { max-width: none; padding: 0; }
  h2, h3 { break-after: avoid; } .wide { overflow: visible; } table { font-size: 8pt; }
  h1 { font-size: 16pt; }
}
</style>
</head>
<body>
<main>
<p class="small">{% block kind %}{% endblock %} &middot; spadmnist {{ version }}</p>
{% block body %}{% endblock %}
</main>
</body>
</html>
"""
