"""Numbers and tables as text, at most 100 characters wide."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence

from ..foreign import visible

_WIDTH = 100  # characters of a table


def facts(facts: Mapping[str, str]) -> str:
    """One fact a line, its name before it."""
    return "\n".join(f"{name:<9}  {visible(text)}" for name, text in facts.items())


def aligned(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """First column to the left, the others to the right; more columns than fit go into a table below."""
    header, rows = list(map(visible, header)), [list(map(visible, row)) for row in rows]
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    groups: list[list[int]] = [[]]
    for i in range(1, len(header)):
        if groups[-1] and widths[0] + sum(widths[k] + 2 for k in (*groups[-1], i)) > _WIDTH:
            groups.append([])
        groups[-1].append(i)
    tables = []
    for group in groups:
        lines = [
            row[0].ljust(widths[0]) + "".join("  " + row[i].rjust(widths[i]) for i in group) for row in (header, *rows)
        ]
        tables.append("\n".join(line.rstrip() for line in lines))
    return "\n\n".join(tables)


def wrapped(text: str) -> str:
    """The text in lines of a table's width."""
    return "\n".join(textwrap.wrap(text, _WIDTH))


def integer(value: float | None) -> str:
    """`12,345`; `-` where it is not known."""
    return "-" if value is None else f"{value:,.0f}"


def number(value: float | None) -> str:
    """Four digits, never in powers of ten; `-` where it is not known."""
    if value is None:
        return "-"
    if value == 0:
        return "0"
    if value >= 1000:
        return f"{value:,.0f}"
    decimals = 4 if value < 1 else 3 - int(math.log10(value))
    return f"{value:.{decimals}f}"


def percent(share: float | None) -> str:
    """`12.3 %`, or two digits of less than 10 %; `-` where it is not known."""
    if share is None:
        return "-"
    return f"{100 * share:.1f} %" if share >= 0.0995 else f"{100 * share:.2g} %"


def size(size: float) -> str:
    """`1.2 MB`, in powers of 1000."""
    units_left = ["TB", "GB", "MB", "kB", "B"]
    while size >= 999.5 and len(units_left) > 1:
        size /= 1000
        units_left.pop()
    unit = units_left[-1]
    return f"{size:.0f} {unit}" if unit == "B" or size >= 99.95 else f"{size:.1f} {unit}"


def short(text: str, most: int = 24) -> str:
    """At most so many characters, with dots where some are left out."""
    text = visible(text)
    return text if len(text) <= most else f"{text[: most - 3]}..."
