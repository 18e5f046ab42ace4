"""Text that others wrote: as it may be shown (on a terminal, in a page, in a command to paste), and JSON of it.

The name of a file or of a sensor may hold characters that move the cursor, end a line or turn the order of what
follows. Nothing that cannot be seen is passed on as it is.
"""

from __future__ import annotations

import html
import json
import os
import shlex
from collections.abc import Iterable, Sequence
from typing import Any

_DEEPEST = 64  # groups within groups of JSON: a config has at most 50, and stands in a manifest
_GROUPS = {dict, list}  # of JSON
_TOO_DEEP = f"it is nested more than {_DEEPEST} deep"
_LONGEST_LINE = 2000  # characters of a line for people; names of files and of captures fit


def visible(text: object) -> str:
    r"""One line, in which every character that cannot be printed stands as its number: ESC as `\x1b`.

    These are control characters, ends of lines, marks of direction, blanks other than a space, and bytes of a file's
    name that are no text.
    """
    shown = str(text)
    return shown if shown.isprintable() else "".join(map(_seen, shown))


def visible_lines(text: str) -> str:
    r"""As `visible`, of several lines: only `\n` ends one."""
    return "\n".join(map(visible, text.split("\n")))


def short(text: str, most: int = _LONGEST_LINE) -> str:
    """Text without its middle where it has more characters than a line for people may: it quotes something endless."""
    half = (most - 5) // 2
    return text if len(text) <= most else f"{text[:half]} ... {text[-half:]}"


def from_json(text: str | bytes) -> Any:
    """What JSON of a file says. Raises ValueError, with a short reason, where it is none or is nested too deeply."""
    try:
        value = json.loads(text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    except ValueError:
        raise ValueError("it is not JSON") from None
    level = [value] if type(value) in _GROUPS else []
    for _ in range(_DEEPEST + 1):
        if not level:
            return value
        inside = [group.values() if type(group) is dict else group for group in level]
        level = [held for group in inside for held in group if type(held) in _GROUPS]
    raise ValueError(_TOO_DEEP)


def quoted(word: str | os.PathLike[str]) -> str:
    """A word of a command to paste into a shell, where it stands for itself: a path, or what a user has named."""
    text = str(word)
    if text.startswith("-"):
        text = f"./{text}"
    if text.isprintable():
        return shlex.quote(text)
    # what a shell calls ANSI-C quoting takes bytes by their numbers
    escapes = {"'": "\\'", "\\": "\\\\"}
    return "$'" + "".join(escapes.get(c) or (c if c.isprintable() else _bytes_of(c)) for c in text) + "'"


def html_table(title: str, head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table for a notebook, everything in it escaped."""

    def line(cells: Sequence[object], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(visible(cell))}</{tag}>" for cell in cells) + "</tr>"

    body = "".join(line(row, "td") for row in rows)
    return f"<div><p>{html.escape(visible(title))}</p><table>{line(head, 'th')}{body}</table></div>"


def _seen(character: str) -> str:
    if character.isprintable():
        return character
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:  # a byte of a name that is no text, as Python holds it
        code -= 0xDC00
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def _bytes_of(character: str) -> str:
    try:
        held = os.fsencode(character)
    except UnicodeEncodeError:  # half of a character: no file's name
        held = character.encode("utf-8", "surrogatepass")
    return "".join(f"\\x{byte:02x}" for byte in held)
