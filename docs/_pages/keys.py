"""The keys of the YAML files, from their JSON Schemas, which are made from the classes that read them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from spadmnist import schema, units

from . import markdown as md

_TITLES = {
    "config": "Keys of a config",
    "sensor": "Keys of a sensor file",
    "measurement": "Keys of a measurement",
}
Node = dict[str, Any]


@dataclass(frozen=True)
class Group:
    """A mapping of a file: where it stands (`scene.images`), which of several it is, and its schema."""

    path: str
    which: str
    node: Node


def page(kind: str) -> str:
    """The page of one kind of file."""
    made = schema.of(kind)
    blocks = [f"`spadmnist schema {kind}` prints the JSON Schema, with which an editor completes and checks."]
    for group in groups(kind):
        if group.path:
            which = f" ({group.which})" if group.which else ""
            blocks.append(f"## `{group.path}`{which}")
        blocks += [md.prose(group.node.get("description", "")), _table(made, group)]
    return md.page(_TITLES.get(kind, f"Keys of a {kind}"), *blocks)


def groups(kind: str) -> Iterator[Group]:
    """Every mapping of a kind of file, a parent before its children. Those of the effects have pages of their own."""
    made = schema.of(kind)
    top = made if "properties" in made else made["anyOf"][0]
    yield from _groups(made, Group("", "", top), set())


def _groups(made: Node, group: Group, known: set[str]) -> Iterator[Group]:
    """A mapping and those in it; one that stands at several places is named at the first."""
    yield group
    for key, node in group.node["properties"].items():
        if key == "effects":
            continue
        path = f"{group.path}.{key}" if group.path else key
        for name, one in _members(made, node):
            inner = f"{path}[]" if _resolved(made, node).get("type") == "array" else path
            if name not in known:
                known.add(name)
                yield from _groups(made, Group(inner, _which(one), one), known)


def _members(made: Node, node: Node) -> Iterator[tuple[str, Node]]:
    """The mappings that may stand at a place, with their names."""
    for one in [node, *node.get("anyOf", []), *node.get("oneOf", []), *([node["items"]] if "items" in node else [])]:
        found = _resolved(made, one)
        if one is not node and ("oneOf" in one or "anyOf" in one):
            yield from _members(made, one)
        elif "properties" in found and "$ref" in one:
            yield one["$ref"].rsplit("/", 1)[1], found


def _which(node: Node) -> str:
    """`source: folder`, where that is what tells a mapping from others at the same place."""
    for key, one in node["properties"].items():
        if "const" in one:
            return f"{key}: {one['const']}"
        if key == "modality":
            return f"{key}: {' or '.join(one['enum'])}"
    return ""


def _table(made: Node, group: Group) -> str:
    required = group.node.get("required", [])
    rows = []
    for key, node in group.node["properties"].items():
        about = md.plain(node.get("description") or _resolved(made, node).get("description", "").split("\n\n")[0])
        if key == "effects":
            about = f"{about}: see the [gallery](../gallery/index.md)"
        default = "required" if key in required else _default(node)
        rows.append([f"`{key}`", about, _form(made, node), default])
    return md.table(("key", "what it is", "value", "default"), rows)


def _default(node: Node) -> str:
    if node.get("default") is None or "const" in node:
        return ""
    value = node["default"]
    shown = str(value).lower() if isinstance(value, bool) else str(value).replace("'", "")
    return md.literal(shown) if shown else "empty"


def _form(made: Node, node: Node) -> str:
    """What a value may be, in words."""
    known = node.get("anyOf") or node.get("oneOf")
    if known:
        forms = [_form(made, one) for one in known if one.get("type") != "null"]
        return " or ".join(dict.fromkeys(form for form in forms if form))
    node = _resolved(made, node)
    if "const" in node:
        return md.literal(str(node["const"]))
    if "enum" in node:
        return " or ".join(md.literal(str(one)) for one in node["enum"])
    if "pattern" in node:
        return _QUANTITIES.get(node["pattern"], "text")
    kind = node.get("type")
    if kind == "array":
        return f"list: {_form(made, node.get('items', {}))}"
    if kind in ("integer", "number"):
        return _range(node, "whole number" if kind == "integer" else "number")
    if kind == "object" or "properties" in node:
        return "mapping"
    return {"boolean": "`true` or `false`", "string": "text"}.get(str(kind), "")


def _range(node: Node, what: str) -> str:
    low, high = node.get("minimum"), node.get("maximum")
    words = [f"from {low:,}" if low is not None else ""]
    if "exclusiveMinimum" in node:
        words.append(f"more than {node['exclusiveMinimum']:,}{' and' if high is not None else ''}")
    words.append("" if high is None else f"{'at most' if 'exclusiveMinimum' in node else 'to'} {high:,}")
    if "exclusiveMaximum" in node:
        high = node["exclusiveMaximum"]
        words.append(f"less than 2^{high.bit_length() - 1}" if high > 10**15 else f"less than {high:,}")
    return " ".join([what, *filter(None, words)])


def _resolved(made: Node, node: Node) -> Node:
    """A schema itself where a reference to it stands."""
    if "$ref" not in node:
        return node
    return {**made["$defs"][node["$ref"].rsplit("/", 1)[1]], **{k: v for k, v in node.items() if k != "$ref"}}


# what the pattern of a quantity means, in words
_QUANTITIES = {
    units.pattern(unit, signed): f"{units.dimension_name(unit)}, as {md.literal(units.example(unit))}"
    for unit in units.known()
    for signed in (True, False)
}


def names(kind: str) -> Iterator[tuple[str, str]]:
    """(path of the mapping, key) of every key of a kind of file."""
    for group in groups(kind):
        for key in group.node["properties"]:
            yield re.sub(r"\[\]", "", group.path), key
