"""The page of an experiment: its answer, its tables and its pictures, whatever the experiment is.

An experiment gives a `Story`, of which this module makes three things that say the same: the page, the Markdown that
goes into the documentation, and the PNG files of its pictures.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import disk, pictures
from ..foreign import visible
from ._frame import write


@dataclass(frozen=True)
class Table:
    """Rows of text below a header, with a title and a note. The first column is to the left, others to the right."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


@dataclass(frozen=True)
class Drawing:
    """A picture that is drawn on a matplotlib figure of `size` (width, height; inches).

    name: of its file, without `.png`; words: what it shows, for who cannot see it.
    """

    name: str
    title: str
    words: str
    size: tuple[float, float]
    draw: Callable[[Any], None]
    note: str = ""


@dataclass(frozen=True)
class Story:
    """What an experiment found.

    kind: what kind of experiment it is; answer: in one line; lead: what else a reader should know first; facts: name ->
    what was done; parts: tables and drawings, in order.
    """

    kind: str
    answer: str
    lead: Sequence[str]
    facts: Mapping[str, str]
    parts: Sequence[Table | Drawing]


@dataclass(frozen=True)
class _Shown:
    """A part of the page: a table, or a picture as a data URI."""

    part: Table | Drawing
    source: str = ""


def experiment(story: Story, folder: Path) -> Path:
    """Write `report.html` and the pictures of a story into a folder, made if it is not there; the page's path.

    Raises SpadError as `check_place` does, and where a file cannot be written.
    """
    shown = []
    for part in story.parts:
        if isinstance(part, Table):
            shown.append(_Shown(part))
            continue
        data = pictures.png(*part.size, part.draw)
        disk.put_file(Path(folder) / f"{part.name}.png", data)
        shown.append(_Shown(part, f"data:image/png;base64,{base64.b64encode(data).decode()}"))
    return write(folder, "experiment", _TEMPLATE, {"story": story, "shown": shown})


def markdown(story: Story) -> str:
    """The same in Markdown; its pictures are the PNG files beside it."""
    blocks = [f"**{visible(story.answer)}**", *map(visible, story.lead)]
    for part in story.parts:
        blocks.append(f"### {visible(part.title)}")
        blocks.append(
            _markdown_table(part) if isinstance(part, Table) else f"![{visible(part.words)}]({part.name}.png)"
        )
        blocks += [visible(part.note)] if part.note else []
    blocks.append("\n".join(f"- {visible(name)}: {visible(text)}" for name, text in story.facts.items()))
    return "\n\n".join(blocks) + "\n"


def _markdown_table(table: Table) -> str:
    rule = ["---", *["--:"] * (len(table.header) - 1)]
    rows = [[visible(cell).replace("|", "\\|") for cell in row] for row in (table.header, rule, *table.rows)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


_TEMPLATE = """\
{% extends "frame" %}
{% block title %}{{ story.kind }}: {{ story.answer }}{% endblock %}
{% block style %}
td, th { font-variant-numeric: tabular-nums; }
td:not(:first-child), thead th:not(:first-child) { text-align: right; }
{% endblock %}
{% block kind %}{{ story.kind }}{% endblock %}
{% block body %}
<section class="verdict">
<h1>{{ story.answer }}</h1>
{% for sentence in story.lead %}
<p class="lead">{{ sentence }}</p>
{% endfor %}
</section>
{% for one in shown %}
<h2>{{ one.part.title }}</h2>
{% if one.source %}
<section class="card"><img src="{{ one.source }}" alt="{{ one.part.words }}"></section>
{% else %}
<div class="wide"><table>
<thead><tr>{% for name in one.part.header %}<th>{{ name }}</th>{% endfor %}</tr></thead>
<tbody>
{% for row in one.part.rows %}
<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}
</tbody></table></div>
{% endif %}
{% if one.part.note %}<p class="small">{{ one.part.note }}</p>{% endif %}
{% endfor %}
<h2>How it was done</h2>
<dl class="facts">
{% for name, text in story.facts.items() %}
<dt>{{ name }}</dt><dd>{{ text }}</dd>
{% endfor %}
</dl>
{% endblock %}
"""
