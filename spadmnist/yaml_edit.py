"""A YAML file that is edited: values set and comments added by ruamel.yaml's round trip, all else as it was.

ruamel.yaml keeps comments, order, quotes and anchors, but writes every line anew in one style. So the text is written
twice, as it is and edited: a line that is the same in both is taken from the file.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from difflib import SequenceMatcher
from typing import Any

from . import document
from .errors import ConfigError

Keys = tuple[str, ...]

_WIDE = 1 << 30  # columns: no line is folded


class Edit:
    """An edit of a YAML text, which is well formed.

    Args:
        text: of the file.
        name: stands for the file in errors.
    Raises:
        ConfigError: where the text is not well formed.
    """

    def __init__(self, text: str, name: str):
        self.value: Any = document.parse(text, name).value
        self._text, self._name = text, name
        self._changes: list[Callable[[Any], None]] = []
        self._notes: dict[Keys, str] = {}
        self._gone: set[Keys] = set()

    def set(self, path: Keys, value: Any, comment: bool = True) -> None:
        """Set an entry, which is added where it is not there.

        path: keys from the top on; a group of entries on the way that is missing or empty is added, on one line.
        value: text, a number, a switch, None, or a mapping of such, which is written on one line.
        comment: keep the comment behind its line; False: it goes with the values that it is of, where all of these are
            replaced by others.
        """
        held = self.value
        for key in path[:-1]:
            if not isinstance(held.get(key), dict):
                held[key] = {}
            held = held[key]
        if not comment and path[-1] in held and held[path[-1]] != value:
            self._gone.add(path)
        held[path[-1]] = value
        self._changes.append(lambda root: _set(root, path, value))

    def note(self, path: Keys, text: str) -> None:
        """Put a comment behind the line of an entry, after one that is there. An entry that is missing has none."""
        self._notes[path] = text

    def map_texts(self, names: Collection[str], new: Callable[[str], str]) -> None:
        """Set the entries of these names, wherever they are text, to `new` of it."""
        for held, key in list(_texts(self.value, names)):
            held[key] = new(held[key])

        def change(root: Any) -> None:
            for held, key in list(_texts(root, names)):
                before = held[key]
                after = new(str(before))
                if after != before:
                    held[key] = _scalar(after) if type(before) is str else type(before)(after)

        self._changes.append(change)

    def text(self) -> str:
        """The text after the edit: its entries are `value` when it is read. Comments are kept where that can be."""
        wanted = document.dump(self.value)
        for made in self._written():
            if document.dump(document.parse(made, self._name).value) == wanted:
                return made
        return wanted

    def _written(self) -> Iterator[str]:
        """The lines of the file with the changes; the same in ruamel's own style."""
        from ruamel.yaml.error import YAMLError

        try:
            text = self._text.replace("\r\n", "\n")
            yaml = _round_trip(text)
            root = yaml.load(text)
            _space_comments(root)
            before = _dumped(yaml, root)
            _drop_comments(root, self._gone)
            for change in self._changes:
                change(root)
            _put_notes(root, self._notes)
            after = _dumped(yaml, root)
        except (YAMLError, ValueError, AttributeError, RecursionError):  # a style that it does not write
            return
        yield "\n".join(_merged(self._text.split("\n"), before.split("\n"), after.split("\n")))
        yield after


def _texts(held: Any, names: Collection[str]) -> Iterator[tuple[Any, Any]]:
    if isinstance(held, dict):
        for key, value in held.items():
            if key in names and isinstance(value, str) and value:
                yield held, key
            yield from _texts(value, names)
    elif isinstance(held, list):
        for value in held:
            yield from _texts(value, names)


# --- the round trip -----------------------------------------------------------------------------------------------


def _round_trip(text: str) -> Any:
    """ruamel.yaml, for which every plain value is text: it is written as it stands there, 010 and yes too."""
    from ruamel.yaml import YAML
    from ruamel.yaml.resolver import VersionedResolver

    class AsItStands(VersionedResolver):
        versioned_resolver: dict[str, Any] = {}  # noqa: RUF012

    yaml = YAML()
    yaml.Resolver = AsItStands
    yaml.preserve_quotes, yaml.width = True, _WIDE
    first = re.search(r"(?m)^( +)[^\s#-]", text)
    step = len(first[1]) if first else 2
    yaml.indent(mapping=step, sequence=step + 2, offset=step)
    yaml.brace_single_entry_mapping_in_flow_sequence = True
    yaml.explicit_start = bool(re.search(r"(?m)^---", text))
    return yaml


def _dumped(yaml: Any, root: Any) -> str:
    out = io.StringIO()
    yaml.dump(root, out)
    return out.getvalue()


def _scalar(value: Any) -> str:
    """A value as the round trip holds it: the text of a plain one, or a text in quotes."""
    from ruamel.yaml.scalarstring import DoubleQuotedScalarString

    if not isinstance(value, str):
        return document.dump({"x": value}).removeprefix("x: ").rstrip("\n")
    try:
        plain = document.parse(f"[{{{value}: {value}}}]", "").value == [{value: value}]
    except ConfigError:
        plain = False
    return value if plain else DoubleQuotedScalarString(value)


def _in_braces(value: Any) -> Any:
    from ruamel.yaml.comments import CommentedMap

    if not isinstance(value, Mapping):
        return _scalar(value)
    made = CommentedMap((_scalar(key), _in_braces(held)) for key, held in value.items())
    made.fa.set_flow_style()
    return made


def _set(root: Any, path: Keys, value: Any) -> None:
    held = root
    for key in path[:-1]:
        if not isinstance(held.get(key), Mapping):
            break
        held = held[key]
    else:
        key = path[-1]
    for name in reversed(path[path.index(key) + 1 :]):
        value = {name: value}
    behind = ""
    if _is_block(held):
        behind = _take_behind(held[key], math.inf) if key in held else _take_behind(held, held.lc.col)
    held[key] = _in_braces(value)
    if behind:
        _put_behind(held, key, "", behind)


def _drop_comments(root: Any, gone: Collection[Keys]) -> None:
    """Take away the comments behind lines of which every value goes."""
    for path in gone:
        held, line = root, None
        for n, key in enumerate(path):
            if not _is_block(held) or key not in held:
                break
            line, held = (held, path[: n + 1]), held[key]
        if line is None:
            continue
        group, at = line
        token = _token(group, at[-1])
        whole = all(any(leaf[: len(one)] == one for one in gone) for leaf in _leaves(group[at[-1]], at))
        if token is not None and whole:
            token.value = "\n" + token.value.partition("\n")[2]


def _leaves(held: Any, path: Keys) -> Iterator[Keys]:
    """The paths of the values within an entry, itself where it is one."""
    if not isinstance(held, Mapping):
        yield path
        return
    for key, value in held.items():
        yield from _leaves(value, (*path, key))


def _put_notes(root: Any, notes: Mapping[Keys, str]) -> None:
    """Each behind the line on which its entry is; once where several entries on a line have the same."""
    on_line: dict[tuple[int, Any], tuple[Any, list[str]]] = {}
    for path, note in notes.items():
        held, place = root, None
        for key in path:
            if _is_block(held):
                place = held, key
            if key not in held:
                place = None
                break
            held = held[key]
        if place is not None:
            _, said = on_line.setdefault((id(place[0]), place[1]), (place[0], []))
            said += [note] if note not in said else []
    for (_, key), (held, said) in on_line.items():
        _put_behind(held, key, "; ".join(said), "")


def _is_block(held: Any) -> bool:
    return hasattr(held, "ca") and hasattr(held, "fa") and not held.fa.flow_style() and bool(held)


def _last(held: Any) -> tuple[Any, Any]:
    """The last entry of a group of entries on lines of their own, within the groups in it too."""
    key = next(reversed(held)) if isinstance(held, Mapping) else len(held) - 1
    return _last(held[key]) if _is_block(held[key]) else (held, key)


def _token(held: Any, key: Any) -> Any:
    """The comment behind an entry and on the lines that follow; None where there is none."""
    found = held.ca.items.get(key)
    at = 2 if isinstance(held, Mapping) else 0
    return found[at] if found and len(found) > at else None


def _take_behind(held: Any, column: float) -> str:
    """Take away what follows a group from the first comment on that begins left of a column.

    It stands before what follows the group: a new last entry must not part them.
    """
    if not _is_block(held):
        return ""
    group, key = _last(held)
    token = _token(group, key)
    if token is None:
        return ""
    first, _, rest = token.value.partition("\n")
    lines = rest.splitlines(keepends=True)
    stay = next((i for i, line in enumerate(lines) if line.strip() and _indent(line) < column), len(lines))
    while stay and not lines[stay - 1].strip():
        stay -= 1
    token.value = "\n".join([first, "".join(lines[:stay])])
    if not token.value.strip():
        del group.ca.items[key]
    return "".join(lines[stay:])


def _put_behind(held: Any, key: Any, note: str, lines: str) -> None:
    """Put a comment at the end of an entry's line, or lines of comment behind it."""
    from ruamel.yaml.error import CommentMark
    from ruamel.yaml.tokens import CommentToken

    token = _token(held, key)
    first, _, rest = (token.value if token else "").partition("\n")
    column = token.start_mark.column if first.strip() else 0
    if note:
        first = f"{first or ' '}{'  ' if first else ''}# {note}"
    made = CommentToken(f"{first}\n{rest}{lines}", CommentMark(column), None)
    held.ca.items.setdefault(key, [None, None, None, None])[2] = made


def _space_comments(held: Any) -> None:
    """Two spaces before a comment behind an entry, where that is now longer; ruamel leaves one."""
    for key in held if isinstance(held, Mapping) else range(len(held)) if isinstance(held, list) else ():
        token = _token(held, key)
        if token is not None and token.value.startswith("#"):
            token.value = f" {token.value}"
            token.start_mark.column = max(0, token.start_mark.column - 1)
        _space_comments(held[key])


# --- lines --------------------------------------------------------------------------------------------------------


def _merged(text: list[str], before: list[str], after: list[str]) -> list[str]:
    """`after`, with the lines of the file where it is as `before`; these are the file's in another style."""
    lines_of = _lines_of(text, before)
    end = "\r" if text[0].endswith("\r") else ""
    out: list[str] = []
    indents: dict[int, int] = {0: 0}  # of `before` -> of the file
    for tag, i, i_end, j, j_end in SequenceMatcher(None, before, after, autojunk=False).get_opcodes():
        for at in range(i, i_end):
            if before[at].strip() and lines_of[at]:
                indents[_indent(before[at])] = _indent(lines_of[at][-1])
        if tag == "equal":
            out += [line for at in range(i, i_end) for line in lines_of[at]]
            continue
        for line in after[j:j_end]:
            depth = _indent(line)
            out.append(" " * indents.get(depth, depth) + line[depth:] + end)
    return out


def _lines_of(text: list[str], before: list[str]) -> list[list[str]]:
    """The lines of the file that each line of `before` stands for."""
    out: list[list[str]] = []
    bare, bare_before = (["".join(line.split()) for line in lines] for lines in (text, before))
    waiting: list[str] = []
    for tag, i, i_end, j, j_end in SequenceMatcher(None, bare, bare_before, autojunk=False).get_opcodes():
        if tag == "equal" or i_end - i == j_end - j:
            out += [[line] for line in text[i:i_end]]
        elif j == j_end:  # only in the file: they go with the line that follows
            waiting = text[i:i_end]
            continue
        else:
            out += [text[i:i_end], *([] for _ in range(j + 1, j_end))]
        out[j][:0], waiting = waiting, []
    if waiting:
        out[-1] += waiting
    return out


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip(" "))
