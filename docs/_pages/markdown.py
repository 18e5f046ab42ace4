"""Text of the classes as Markdown (MyST)."""

from __future__ import annotations

import re
from collections.abc import Sequence

MARK = "% Made from the classes at each build: what is written here is lost.\n"


def page(title: str, *blocks: str) -> str:
    """A whole page: a title and its blocks, an empty line between them."""
    return "\n".join([MARK, f"# {title}", "", "\n\n".join(block for block in blocks if block), ""])


def plain(text: str) -> str:
    """Text that Markdown leaves as it is; what stands in backticks stays code."""
    parts = re.split(r"(`[^`\n]+`)", text)
    return "".join(part if i % 2 else re.sub(r"([\\*_<>$\[\]{}|#])", r"\\\1", part) for i, part in enumerate(parts))


def paragraphs(doc: str | None) -> list[str]:
    """The paragraphs of a docstring, each one line; what begins a law or a source begins a paragraph of its own.

    Indented lines, as those of a program, stay a block; `Args:` and its like become a list.
    """
    found: list[str] = []
    for block in _blocks((doc or "").strip("\n")):
        lines = block.split("\n")
        if re.fullmatch(r"(Args|Returns|Raises|Attributes|Yields):", lines[0].strip()):
            found += _section(lines)
        elif _indented(block):
            found.append("```text\n" + "\n".join(line[4:] for line in lines) + "\n```")
        elif lines[0].startswith("|"):
            found.append("\n".join(lines))
        else:
            for part in re.split(r"\s(?=(?:Law|Fails|Shows|Source): )", " ".join(block.split())):
                head, colon, rest = part.partition(": ")
                known = head in ("Law", "Fails", "Shows", "Source") and colon
                found.append(f"**{head}.** {plain(rest)}" if known else plain(part))
    return [one for one in found if one]


def _blocks(text: str) -> list[str]:
    """What empty lines separate; an indented block goes on behind an empty line."""
    found: list[str] = []
    for block in (one for one in re.split(r"\n\s*\n", text) if one.strip()):
        if found and _indented(found[-1]) and _indented(block):
            found[-1] += f"\n\n{block}"
        else:
            found.append(block)
    return found


def _indented(block: str) -> bool:
    return all(line.startswith("    ") for line in block.split("\n") if line)


def _section(lines: Sequence[str]) -> list[str]:
    """A section of a docstring, `Args:`, with an entry for each name; then what stands behind it."""
    title = lines[0].strip().removesuffix(":")
    after = next((i for i, line in enumerate(lines[1:], 1) if not line.startswith("    ")), len(lines))
    entries: list[str] = []
    for line in lines[1:after]:
        if entries and (line.startswith("        ") or title in ("Returns", "Yields")):
            entries[-1] += f" {line.strip()}"
        else:
            entries.append(line.strip())
    shown = "\n".join(f"- {plain(entry)}" for entry in entries)
    return [f"**{title}**\n\n{shown}", *paragraphs("\n".join(lines[after:]))]


def prose(doc: str | None) -> str:
    """A docstring as Markdown."""
    return "\n\n".join(paragraphs(doc))


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table; its cells are Markdown already."""
    if not rows:
        return ""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(' '.join(cell.split()) for cell in line)} |" for line in lines)


def code(text: str, language: str = "") -> str:
    """A block of code."""
    return f"```{language}\n{text.rstrip()}\n```"


def literal(text: str) -> str:
    """Inline code, also in the cell of a table."""
    return f"`{text}`".replace("|", "\\|") if text else ""


def toctree(names: Sequence[str]) -> str:
    """Where the pages of a chapter stand in the contents."""
    return "\n".join(["```{toctree}", ":maxdepth: 1", ":hidden:", "", *names, "```"])
