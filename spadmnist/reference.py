"""The reference of effects, statistics and reconstruction methods as text, made from their classes."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Sequence
from typing import Any

from . import effects, units
from .effects import STAGES, Effect
from .foreign import visible
from .plugins import Parameter, Plugin, Registry, source_file
from .readout import READOUTS
from .reconstruct import Method
from .recording import MODALITIES
from .statistics import Statistic
from .statistics.checks import Check

_WIDTH = 100


def effect_list() -> str:
    """Every effect: name, stage, first line of its docstring; in the order of the stages."""
    stages = list(STAGES)
    known: list[type[Effect]] = [Effect.registry.find(name) for name in Effect.registry]
    known.sort(key=lambda cls: (stages.index(cls.stage), cls.name))
    rows = [(cls.name, cls.stage, cls.summary()) for cls in known]
    return listing(("effect", "stage", "what it is"), rows)


def effect_page(name: str) -> str:
    """All about one effect, with the YAML to paste. Raises KeyError with a sentence where there is none."""
    cls: type[Effect] = Effect.registry.find(name)
    facts = [f"stage: {cls.stage}"]
    if cls.after is not None:
        facts.append(f"after {cls.after}")
    acts = [line for way in hooks(cls.stage, cls) for line in textwrap.wrap(" ".join(way), _WIDTH)]
    law = mean_law(cls)
    mean = textwrap.wrap(f"Mean rate after the effect: {law}", _WIDTH) if law else []
    return _page(cls, facts, ["In a config or a sensor file:", "", *effect_yaml(cls)], acts, mean)


def effect_yaml(cls: type[Effect]) -> list[str]:
    """What to paste into a config: the effect with its default values."""
    listed = {key: p for key, p in cls.parameters.items() if p.required or p.default is not None}
    values = ", ".join(f"{key}: {_yaml(declared)}" for key, declared in listed.items())
    return ["  sensor:", "    effects:", f"      {cls.name}: {{{values}}}"]


def hooks(stage: str, cls: type[Effect]) -> list[tuple[str, str]]:
    """(hook, what it receives and returns): those of a stage that a class has, from the table of stages."""
    found, current = [], ""
    for line in (effects.__doc__ or "").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) != 3 or not line.startswith("|"):
            continue
        current = cells[0] or current
        names = re.findall(r"(\w+)\(", cells[1])
        if current == stage and all(hasattr(cls, name) for name in names):
            colon = "" if cells[2].startswith("->") else ":"
            found.append((cells[1].removeprefix("or ") + colon, cells[2]))
    return found


def mean_law(cls: type[Effect]) -> str:
    """The closed form of the mean: what the effect's own `expected_rate` says of itself first, or ""."""
    for owner in cls.__mro__:
        own = vars(owner).get("expected_rate")
        if own is not None:
            return "" if owner is Effect else " ".join((own.__doc__ or "").split("\n\n")[0].split())
    return ""


def method_list() -> str:
    """Every reconstruction method: name, readouts it needs, unit, first line of its docstring; TR first."""
    known: list[type[Method]] = [Method.registry.find(name) for name in Method.registry]
    known.sort(key=lambda cls: ([READOUTS.index(r) for r in cls.readouts()], cls.name))
    rows = [(cls.name, " ".join(cls.readouts()), cls.unit, cls.summary()) for cls in known]
    return listing(("method", "needs", "unit", "what it is"), rows)


def method_page(name: str) -> str:
    """All about one method, with the YAML to paste. Raises KeyError with a sentence where there is none."""
    cls: type[Method] = Method.registry.find(name)
    use = "normalised by the training median" if cls.normalised else "never normalised"
    facts = [f"needs: {', '.join(cls.readouts())}", f"unit: {cls.unit}", use]
    return _page(cls, facts, ["In a config:", "", f"  reconstruct: [{cls.name}]"])


def statistic_list() -> str:
    """Every statistic and check: name, modalities, unit, first line of its docstring; TR first."""
    rows = [(cls.name, " ".join(cls.modalities), cls.unit, cls.summary()) for cls in all_statistics()]
    return listing(("statistic", "modality", "unit", "what it measures"), rows)


def all_statistics() -> list[type[Statistic] | type[Check]]:
    """The statistics, and the checks of a comparison that are none; TR first."""
    known = [registry.find(name) for registry in (Statistic.registry, Check.registry) for name in registry]
    return sorted(known, key=lambda cls: ([MODALITIES.index(m) for m in cls.modalities], cls.name))


def statistic_page(name: str) -> str:
    """All about one statistic or check. Raises KeyError with a sentence where there is none."""
    cls: type[Statistic] | type[Check] = _found("statistic", name)
    light = ["uniform light only, not scenes"] if cls.flat else []
    return _page(cls, [f"modality: {', '.join(cls.modalities)}", f"unit: {cls.unit}", *light], [])


# kind of plug-in -> its registries, the list of all, the page of one
_KINDS: dict[str, tuple[tuple[Registry, ...], Callable[[], str], Callable[[str], str]]] = {
    "effect": ((Effect.registry,), effect_list, effect_page),
    "method": ((Method.registry,), method_list, method_page),
    "statistic": ((Statistic.registry, Check.registry), statistic_list, statistic_page),
}


def _found(kind: str, name: str) -> type[Any]:
    """The class of that name. Raises KeyError with a sentence, that of the first registry, where there is none."""
    first, *others = _KINDS[kind][0]
    return next((registry.find(name) for registry in others if name in registry), None) or first.find(name)


def text(kind: str, name: str | None = None) -> str:
    """The reference of `kind` ("effect", "method" or "statistic") for people: all, or the page of one.

    Raises KeyError with a sentence where there is none of that name.
    """
    _, listed, page = _KINDS[kind]
    return page(name) if name else listed()


def as_data(kind: str, name: str | None = None) -> list[dict[str, Any]] | dict[str, Any]:
    """The reference of `kind` ("effect", "method" or "statistic") for programs: all, or the one of that name.

    Raises KeyError with a sentence where there is none.
    """
    if name:
        return _data(_found(kind, name))
    return [_data(registry.find(known)) for registry in _KINDS[kind][0] for known in registry]


def _data(cls: type[Plugin]) -> dict[str, Any]:
    out: dict[str, Any] = {"name": cls.name, "about": inspect.getdoc(cls)}
    if issubclass(cls, Effect):
        out |= {"stage": cls.stage, "expected_rate": mean_law(cls) or None}
    if issubclass(cls, Statistic | Check):
        out |= {"modalities": list(cls.modalities), "unit": cls.unit}
    if issubclass(cls, Method):
        out |= {"readouts": list(cls.readouts()), "unit": cls.unit, "normalised": cls.normalised}
    facts = ("unit", "about", "symbol", "default", "choices", "bounds", "off", "search")
    ways = ("per", "per_pixel", "by_wavelength", "required")
    out["parameters"] = {key: {f: getattr(p, f) for f in facts + ways} for key, p in cls.parameters.items()}
    return out


def _page(
    cls: type[Plugin], facts: Sequence[str], paste: Sequence[str], acts: Sequence[str] = (), mean: Sequence[str] = ()
) -> str:
    """Name, facts and hooks, the file if it is a user's, docstring, law of the mean, parameters, YAML."""
    head = [cls.name, "; ".join(facts), *acts]
    if cls.__module__.partition(".")[0] != __package__:
        head.append(f"file: {visible(source_file(cls))}")
    blocks = [head, docstring(cls), mean, _parameters(list(cls.parameters.values())), paste]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def docstring(cls: type[Plugin]) -> list[str]:
    """Its paragraphs, filled anew; a law, when it fails, what it shows and a source begin a line of their own."""
    out: list[str] = []
    for number, paragraph in enumerate((inspect.getdoc(cls) or "").split("\n\n")):
        out += [""] if number else []
        for part in re.split(r"\s(?=(?:Law|Fails|Shows|Source): )", paragraph):
            out += textwrap.wrap(" ".join(part.split()), _WIDTH)
    return out


def _parameters(declared: Sequence[Parameter]) -> list[str]:
    """A table, and below each row what the parameter is."""
    rows = [(p.name, p.symbol or "-", *allowed_values(p), varies(p)) for p in declared]
    if not rows:
        return []
    header = ("parameter", "symbol", "unit", "default", "allowed", "off", "search", "may vary by")
    lines = _aligned([header, *rows])
    out = lines[:1]
    for line, parameter in zip(lines[1:], declared, strict=True):
        out += [line, *(f"    {part}" for part in textwrap.wrap(parameter.about, _WIDTH - 4))]
    return out


def allowed_values(declared: Parameter) -> tuple[str, str, str, str, str]:
    """(unit, default, allowed, off, search)."""
    unit = declared.unit or "1"
    if declared.choices:
        return "-", _value(declared, declared.default), declared.allowed(), _value(declared, declared.off), "-"
    if declared.unit == "bool":
        return "-", _value(declared, declared.default), "true or false", _value(declared, declared.off), "-"
    search = "-"
    if declared.search is not None:
        search = " to ".join(_value(declared, edge) for edge in declared.search)
    default = "required" if declared.required else _value(declared, declared.default)
    return unit, default, declared.allowed(), _value(declared, declared.off), search


def varies(declared: Parameter) -> str:
    """What its value may differ by: "pixel", "row", "wavelength", "pixel or wavelength"; "-" for nothing."""
    ways = {declared.per: bool(declared.per), "wavelength": declared.by_wavelength}
    return " or ".join(way for way, can in ways.items() if can) or "-"


def _value(declared: Parameter, value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return value
    return units.show(value, declared.unit, 12)


def _yaml(declared: Parameter) -> str:
    """The default as a config writes it; where there is none, something of the right form."""
    if declared.default is not None:
        return _value(declared, declared.default)
    if declared.per:
        return f"{{file: {declared.name}.npy}}"
    return "true" if declared.unit == "bool" else units.example(declared.unit).removesuffix(" %")


def listing(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose last column is wrapped."""
    left = _aligned([row[:-1] for row in (header, *rows)], pad_last=True)
    indent = len(left[0]) + 2
    out = []
    for start, row in zip(left, (header, *rows), strict=True):
        about = textwrap.wrap(row[-1], _WIDTH - indent) or [""]
        out += [f"{start}  {about[0]}".rstrip(), *(" " * indent + line for line in about[1:])]
    return "\n".join(out)


def _aligned(rows: Sequence[Sequence[str]], pad_last: bool = False) -> list[str]:
    rows = [list(map(visible, row)) for row in rows]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    return lines if pad_last else [line.rstrip() for line in lines]
