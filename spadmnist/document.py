"""YAML as people mean it: version 1.2, duplicate keys refused, and the line of every entry kept for errors.

No tag runs anything; aliases are refused (a few bytes of them can stand for gigabytes).
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from . import disk
from .errors import ConfigError, InputError

_MOST_BYTES = 1 << 20
_DEEPEST = 50
_LONGEST_NUMBER = 60  # characters

Path_ = tuple[Any, ...]


class _Loader(yaml.SafeLoader):
    """PyYAML reads version 1.1, where `1e9` is text, `010` is eight and `on` is true."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012

    def fetch_flow_collection_start(self, TokenClass: Any) -> None:  # PyYAML's name
        """Refuse a bracket too deep as it is met: of nested brackets the time grows with the square."""
        if self.flow_level > _DEEPEST:
            raise _TooDeepError(self.get_mark().line + 1)
        super().fetch_flow_collection_start(TokenClass)


class _TooDeepError(Exception):
    """Brackets are nested too deeply; its argument is the line."""


for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})$"), _first)


@dataclass
class Document:
    """What a YAML file says, and where.

    value: nested dicts, lists, text, numbers, booleans and None; lines: line number of each path.
    """

    name: str
    value: Any
    lines: dict[Path_, int] = field(default_factory=dict)

    def place(self, path: Iterable[Any]) -> str:
        """`lab.yaml:7: sensor.layout.rows`, with the line of the nearest entry that is there."""
        known = tuple(path)
        while known and known not in self.lines:
            known = known[:-1]
        line = self.lines.get(known)
        dotted = ""
        for part in path:
            dotted += f"[{part}]" if isinstance(part, int) else f"{'.' if dotted else ''}{part}"
        where = f"{self.name}:{line}" if line else self.name
        return f"{where}: {dotted}" if dotted else where


def path_of(path: object, what: str) -> Path:
    """The path of a file. Raises InputError where it is none; what: it should be the path of."""
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"{path!r:.80} is of type {type(path).__name__}; give the path of {what}")
    return Path(path)


def read(path: Path) -> Document:
    """Read a YAML file. Raises InputError (cannot be read) or ConfigError (is not well formed), with the line."""
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder; name a YAML file")
        with disk.opened(path) as file:
            raw = file.read(_MOST_BYTES + 1)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {_elsewhere(path)}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    if len(raw) > _MOST_BYTES:
        raise InputError(f"{path}: a config is text of at most 1 MiB; this file is larger")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError([f"{path}: is not UTF-8 text (byte {error.start})"]) from None
    return parse(text, str(path))


def _elsewhere(path: Path) -> str:
    """What to do where a file is not there: the documentation names the program's examples by this folder."""
    if path.parts[:1] == ("configs",):
        return "`spadmnist init configs --examples` writes the examples that come with the program"
    return "name one that is there"


def parse(text: str, name: str) -> Document:
    """Read YAML text; `name` stands for the file in errors."""
    node = _compose(text, name)
    document = Document(name, None)
    problems: list[str] = []
    if node is not None:
        document.value = _value(node, (), document, problems, set())
    if problems:
        raise ConfigError(problems)
    return document


def _compose(text: str, name: str) -> Any:
    try:
        return yaml.compose(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f":{mark.line + 1}" if mark else ""
        raise ConfigError([f"{name}{line}: is not well-formed YAML: {_without_text(error)}"]) from None
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError([f"{name}: is not well-formed YAML: {' '.join(str(error).split())}"]) from None
    except _TooDeepError as error:
        raise ConfigError([f"{name}:{error.args[0]}: is nested more than {_DEEPEST} deep"]) from None
    except RecursionError:
        raise ConfigError([f"{name}: is nested too deeply"]) from None


_QUOTED = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\"""")
_OF_YAML = re.compile(r"<[a-z ]+>|[^\w\s]{1,3}|\\t")  # what the parser names, and signs


def _without_text(error: yaml.MarkedYAMLError) -> str:
    """What the parser says, without what it quotes of the file: that is perhaps none of ours."""
    said = str(error.problem or error.context)
    return " ".join(_QUOTED.sub(lambda m: m[0] if _OF_YAML.fullmatch(m[0][1:-1]) else "", said).split())


def _value(node: Any, path: Path_, document: Document, problems: list[str], seen: set[int]) -> Any:
    line = node.start_mark.line + 1
    document.lines.setdefault(path, line)
    if id(node) in seen:
        problems.append(f"{document.name}:{line}: aliases (*name) are not allowed; write the value again")
        return None
    seen.add(id(node))
    if len(path) > _DEEPEST:
        problems.append(f"{document.name}:{line}: is nested more than {_DEEPEST} deep")
        return None
    usual = f"tag:yaml.org,2002:{'map' if isinstance(node, yaml.MappingNode) else 'seq'}"
    if isinstance(node, yaml.CollectionNode) and node.tag != usual:
        problems.append(f"{document.place(path)}: the tag {node.tag:.60} is not allowed; write plain YAML")
        return None
    if isinstance(node, yaml.MappingNode):
        out: dict[Any, Any] = {}
        first: dict[Any, int] = {}
        for key_node, value_node in node.value:
            key = _scalar(key_node, path, document, problems)
            key_line = key_node.start_mark.line + 1
            if key in first:
                problems.append(
                    f"{document.name}:{key_line}: {_word(key)} stands here a second time (first on line {first[key]}); "
                    "keep one of them"
                )
                continue
            first[key] = key_line
            document.lines[(*path, key)] = key_line
            out[key] = _value(value_node, (*path, key), document, problems, seen)
        return out
    if isinstance(node, yaml.SequenceNode):
        return [_value(item, (*path, i), document, problems, seen) for i, item in enumerate(node.value)]
    return _scalar(node, path, document, problems)


def _word(key: Any) -> str:
    """A key as an error may say it; a line of a file that is no config is no word."""
    return str(key) if re.fullmatch(r"[\w.-]{1,60}", str(key)) else "an entry"


def _scalar(node: Any, path: Path_, document: Document, problems: list[str]) -> Any:
    line = node.start_mark.line + 1
    if not isinstance(node, yaml.ScalarNode):
        problems.append(f"{document.name}:{line}: a key must be plain text")
        return f"<line {line}>"
    kind = node.tag.rpartition(":")[2]
    text = node.value
    plain = node.style is None
    if kind != "str" and node.tag != _Loader("").resolve(yaml.ScalarNode, text, (plain, not plain)):
        problems.append(f"{document.place(path)}: the tag {node.tag} is not allowed; write plain YAML")
        return None
    if kind != "str" and len(text) > _LONGEST_NUMBER:
        problems.append(f"{document.place(path)}: {text[:20]}... is not a number that can be held")
        return None
    try:
        if kind == "null":
            return None
        if kind == "bool":
            return text.lower() == "true"
        if kind == "int":
            return int(text, 0) if text[:2] in ("0o", "0x") else int(text)
        if kind == "float":
            return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
        if kind == "str":
            return text
    except ValueError:
        problems.append(f"{document.place(path)}: {text[:40]!r} is not a number that can be held")
        return None
    problems.append(f"{document.place(path)}: the tag {node.tag} is not allowed; write plain YAML")
    return None


def dump(value: Any) -> str:
    """YAML text of nested dicts, lists and scalars: the same text for the same value, and read back as it was."""
    lines: list[str] = []
    _dump(value, 0, lines)
    return "\n".join(lines) + "\n"


def _dump(value: Any, depth: int, lines: list[str]) -> None:
    indent = "  " * depth
    for key, item in value.items():
        if isinstance(item, dict) and item:
            lines.append(f"{indent}{_text(key)}:")
            _dump(item, depth + 1, lines)
        else:
            lines.append(f"{indent}{_text(key)}: {_flow(item)}")


def _flow(item: Any) -> str:
    if isinstance(item, list):
        return "[" + ", ".join(map(_flow, item)) + "]"
    if isinstance(item, dict):
        return "{" + ", ".join(f"{_text(k)}: {_flow(v)}" for k, v in item.items()) + "}"
    return _text(item)


_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_./^%+ -]*(?<! )")


def _text(item: Any) -> str:
    if item is None:
        return "null"
    if isinstance(item, bool):
        return "true" if item else "false"
    if isinstance(item, float) and not math.isfinite(item):
        return ".nan" if math.isnan(item) else ".inf" if item > 0 else "-.inf"
    if isinstance(item, (int, float)):
        return repr(item)
    plain = _PLAIN.fullmatch(item) and item.lower() not in ("true", "false", "null")
    if plain or re.fullmatch(r"[0-9.]+ [A-Za-z%][A-Za-z0-9^/%]*", item):
        return str(item)
    return '"' + "".join(map(_escaped, item)) + '"'


def _escaped(character: str) -> str:
    """A character inside double quotes; what YAML cannot hold as it is becomes its number."""
    if character in '"\\':
        return "\\" + character
    code = ord(character)
    shown = 0x20 <= code <= 0x7E or 0xA0 <= code <= 0xD7FF or 0xE000 <= code <= 0xFFFD or code >= 0x10000
    if shown and code not in (0x2028, 0x2029, 0xFEFF):
        return character
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


# --- one entry more -----------------------------------------------------------------------------------------------

_BREAK = "\r\n|[\r\n\x85\u2028\u2029]"
_BREAK_BEFORE = re.compile(rf"({_BREAK})\Z")
_REST_OF_LINE = re.compile(rf"[^\r\n\x85\u2028\u2029]*({_BREAK})?")


def insert(text: str, path: Path_, after: Any, key: Any, value: Any, name: str = "the text") -> str:
    """YAML text with one entry more; all else stays as it is: comments, order, quotes, ends of lines.

    path: of a group of entries, as ("captures", 2). The entry `key: value` comes right behind the entry `after` of that
    group, as the group is written: on a line of its own, or within the braces. Where `key` stands there with nothing
    behind it, the value comes there. name: stands for the file in errors.

    Raises ConfigError where the text is not well formed; InputError where it has no such group or no `after`, where
    `key` has a value already, and where an entry cannot be put there in this way.
    """
    read, group = parse(text, name), _compose(text, name)
    held = read.value
    for part in path:
        if part not in (range(len(held)) if isinstance(held, list) else held if isinstance(held, dict) else ()):
            raise InputError(f"{read.place(path)} is not there; name a group of entries")
        group = group.value[part] if isinstance(held, list) else _entries(group)[part][1]
        held = held[part]
    if not isinstance(held, dict) or after not in held:
        raise InputError(f"{read.place(path)} has no entry {after}; name one that it has")
    if held.get(key) is not None:
        raise InputError(f"{read.place((*path, key))} has a value already, {_flow(held[key])}; take it out first")
    made = _with_entry(text, group, after, key, _flow(value))
    before = dict(held)
    held.clear()
    for other, one in before.items():
        held[other] = value if other == key else one
        if other == after and key not in before:
            held[key] = value
    try:
        right = _flow(parse(made, name).value) == _flow(read.value)
    except ConfigError:
        right = False
    if not right:
        entry = f"{_text(key)}: {_flow(value)}"
        raise InputError(f"{read.place(path)} is written so that nothing can be put behind {after}; add {entry} there")
    return made


def _with_entry(text: str, group: Any, after: Any, key: Any, value: str) -> str:
    """In most ways that YAML has of writing a group; who calls must look at the result."""
    entries = _entries(group)
    if key in entries:
        start, end = entries[key][1].start_mark.index, entries[key][1].end_mark.index
        return f"{text[:start]}{'' if end > start else ' '}{value}{text[end:]}"
    entry, at = f"{_text(key)}: {value}", _end(entries[after][1])
    if group.flow_style:
        return f"{text[:at]}, {entry}{text[at:]}"
    entry = " " * min(group.start_mark.column, group.value[0][0].start_mark.column) + entry
    if not _BREAK_BEFORE.search(text[:at]):  # a block of text ends with its line
        rest = _REST_OF_LINE.match(text, at)
        at = rest.end() if rest else at
    if end_of_line := _BREAK_BEFORE.search(text[:at]):
        return f"{text[:at]}{entry}{end_of_line[1]}{text[at:]}"
    first = re.search(_BREAK, text)
    return f"{text}{first[0] if first else chr(10)}{entry}"


def _entries(group: Any) -> dict[Any, tuple[Any, Any]]:
    return {_scalar(name, (), Document("", None), []): (name, held) for name, held in group.value}


def _end(node: Any) -> int:
    """Where the text of a value ends; a block of entries goes on up to what stands behind it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(node, yaml.MappingNode) else last)
    return int(node.end_mark.index)
