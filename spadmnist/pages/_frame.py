"""The frame of a page: its file, head, style and contents, where it comes from, numbers in words."""

from __future__ import annotations

import datetime
import importlib.metadata
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2

from .. import disk, units
from ..errors import SpadError
from ..foreign import visible_lines
from ..statistics import Statistic
from ..statistics.checks import Check

# kind of page -> its file in the folder
FILES = {"comparison": "index.html", "diagnosis": "report.html", "experiment": "report.html"}

_CERTAIN = 1e-12  # smaller p-values rest on tails that nobody has seen
_LONGEST = 60_000  # characters of a file that a page holds
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Source:
    """Where a page comes from. command: as it was typed; date: of the day; seed: of the simulations.

    files: what each file is -> its text, such as the sensor and the measurement.yaml; then: the next step, with the
    names that the command has.
    """

    command: str = ""
    date: str = ""
    seed: int | None = None
    files: Mapping[str, str] = field(default_factory=dict)
    then: str = ""

    @property
    def shown(self) -> list[tuple[str, str]]:
        """The files, a very long one without its end."""
        cut = f"\n... (the first {_LONGEST:,} characters)"
        return [(name, text[:_LONGEST] + cut * (len(text) > _LONGEST)) for name, text in self.files.items()]


def source_of(command: str, seed: int | None, files: Mapping[str, Path | bytes], then: str = "") -> Source:
    """Where a page comes from, today. What cannot be read as text is left out.

    Args:
        files: what each is -> its path, or its bytes.
    """
    texts = {}
    for name, held in files.items():
        try:
            texts[name] = (held if isinstance(held, bytes) else disk.read_file(held, 16 << 20)).decode()
        except (OSError, UnicodeDecodeError, SpadError):
            continue
    return Source(command, datetime.date.today().isoformat(), seed, texts, then)


# --- the file -------------------------------------------------------------------------------------------------------


def write(folder: Path, kind: str, template: str, words: dict[str, Any], source: Source | None = None) -> Path:
    """Fill the template of a page, which extends "frame", and write it into a folder, made if it is not there.

    Its headings become the contents at its top.

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
    words = words | {"mark": _mark(kind), "version": version, "source": source or Source()}
    text = _with_contents(environment.get_template("page").render(words))
    page = Path(folder) / FILES[kind]
    disk.put_file(page, text.encode("utf-8", "replace"))
    return page


def _with_contents(text: str) -> str:
    """The page with its second headings as contents, which lead to them."""
    titles: list[str] = []

    def placed(heading: re.Match[str]) -> str:
        titles.append(heading[1])
        return f'<span class="part" id="part-{len(titles)}"></span>{heading[0]}'

    text = re.sub(r"<h2>(.*?)</h2>", placed, text)
    links = "".join(f'<li><a href="#part-{k}">{title}</a></li>' for k, title in enumerate(titles, 1))
    return text.replace(_CONTENTS, f'<nav><ul class="contents">{links}</ul></nav>' if len(titles) > 2 else "", 1)


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
    for registry in (Check.registry, Statistic.registry):
        if statistic in registry:
            return str(registry.find(statistic).summary())
    return statistic  # the plug-in of a stored comparison may not be at hand


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

_CONTENTS = "<!-- contents -->"
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
:root { color-scheme: light dark; --page: #fafaf8; --card: #ffffff; --ink: #1d2329; --soft: #5b6670; --line: #dfe2e4;
  --head: #f1f2f1; --good: #4b8b62; --bad: #c0392b; --open: #d98a1f; --link: #2f6ea5;
  --fails: #f0bdb6; --passes: #e4f0e6; --small: #f6e0ae; --low: #faf3d3; --lowish: #f3f6e4; }
@media screen and (prefers-color-scheme: dark) {
  :root { --page: #14171a; --card: #1c2024; --ink: #e4e7ea; --soft: #a3adb6; --line: #363c42; --head: #262b30;
    --good: #6db487; --bad: #e5766a; --open: #e3a44d; --link: #82b6e4;
    --fails: #6b2c26; --passes: #203a29; --small: #5a4718; --low: #3d381f; --lowish: #2b3223; }
  img { filter: invert(1) hue-rotate(180deg); }
}
body { margin: 0; background: var(--page); color: var(--ink);
  font: 16px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
main { max-width: 1000px; margin: 0 auto; padding: 28px 24px 60px; }
h1 { font-size: 1.75rem; line-height: 1.25; margin: .2rem 0 .5rem; font-weight: 650; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 .7rem; padding-bottom: .25rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1.02rem; margin: 0 0 .2rem; font-weight: 600; }
h1, h2, h3, p, td, th, dd, dt, li, summary, figcaption { overflow-wrap: anywhere; }
p { margin: .4rem 0; }
a { color: var(--link); }
.small { color: var(--soft); font-size: .86rem; }
.verdict { background: var(--card); border: 1px solid var(--line); border-left: 7px solid var(--good);
  padding: 14px 20px 12px; }
.verdict.fails { border-left-color: var(--bad); }
.lead { font-size: 1.08rem; }
.contents { display: flex; flex-wrap: wrap; gap: .15rem 1.2rem; list-style: none; padding: 0; margin: .9rem 0 0;
  font-size: .92rem; }
.facts { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1.4rem; margin: 0; }
.facts dt { color: var(--soft); } .facts dd { margin: 0; }
.card { background: var(--card); border: 1px solid var(--line); padding: 14px 18px 10px; margin: 0 0 16px;
  break-inside: avoid; }
.card img { width: 100%; height: auto; display: block; margin-top: .5rem; }
.pan { overflow-x: auto; }
.size { font-weight: 600; }
.tag { color: var(--soft); font-size: .86rem; }
.tag b { color: var(--ink); font-weight: 600; }
.wide { overflow-x: auto; margin: 0 0 1rem; }
details { margin: .5rem 0 1rem; } summary { cursor: pointer; color: var(--link); }
details > :not(summary) { margin-top: .5rem; }
pre { background: var(--card); border: 1px solid var(--line); padding: 10px 12px; overflow-x: auto; margin: .5rem 0;
  font: .82rem/1.45 ui-monospace, "DejaVu Sans Mono", monospace; }
table { border-collapse: collapse; font-size: .84rem; background: var(--card); width: 100%; }
th, td { border: 1px solid var(--line); padding: 3px 7px; text-align: left; vertical-align: top; }
thead th { background: var(--head); font-weight: 600; vertical-align: bottom; }
tbody th { font-weight: 400; white-space: nowrap; }
tr { break-inside: avoid; }
.fails { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
td.fails, .key.fails { background: var(--fails); font-weight: 600; }
td.passes, .key.passes { background: var(--passes); }
td, .key { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
.key { display: inline-block; padding: 0 .5rem; border: 1px solid var(--line); margin-right: .15rem; }
dl.words dt { font-weight: 600; margin-top: .6rem; } dl.words dd { margin: 0; max-width: 46rem; }
{% block style %}{% endblock %}
@media (max-width: 600px) {
  main { padding: 16px 12px 40px; }
  h1 { font-size: 1.3rem; } .lead { font-size: 1rem; }
  .verdict { padding: 12px 12px 10px; }
  .facts { grid-template-columns: minmax(0, 1fr); } .facts dd { margin-bottom: .4rem; }
  .card { padding: 12px 12px 8px; }
  .pan img { width: 640px; max-width: none; }
}
@media print {
  @page { margin: 14mm; }
  body { background: #fff; font-size: 10pt; } main { max-width: none; padding: 0; }
  h2, h3 { break-after: avoid; } .wide { overflow: visible; } table { font-size: 8pt; }
  h1 { font-size: 16pt; } nav { display: none; }
}
</style>
</head>
<body>
<main>
<p class="small">{% block kind %}{% endblock %} &middot; spadmnist {{ version }}\
{% if source.date %} &middot; {{ source.date }}{% endif %}</p>
{% block body %}{% endblock %}
{% if source.command or source.seed is not none or source.shown %}
<h2>How it was made</h2>
<dl class="facts">
{% if source.command %}<dt>command</dt><dd><code>{{ source.command }}</code></dd>{% endif %}

{% if source.date %}<dt>date</dt><dd>{{ source.date }}</dd>{% endif %}

{% if source.seed is not none %}<dt>seed</dt><dd>{{ source.seed }}</dd>{% endif %}

<dt>version</dt><dd>spadmnist {{ version }}</dd>
</dl>
{% for name, text in source.shown %}
<details><summary>{{ name }}</summary><pre>{{ text }}</pre></details>
{% endfor %}
{% endif %}
</main>
</body>
</html>
"""
