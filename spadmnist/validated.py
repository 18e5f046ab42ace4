"""What a YAML file says, set against pydantic models: every mistake becomes one sentence with its file and line."""

from __future__ import annotations

import math
import types
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Union, get_args, get_origin

from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import core_schema

from . import units
from .document import Document, Path_
from .errors import did_you_mean

# --- quantities ---------------------------------------------------------------------------------------------------


def written(unit: str, signed: bool = True) -> dict[str, Any]:
    """The JSON Schema of a quantity whose SI unit is `unit`; signed: below 0, too."""
    text = {"type": "string", "pattern": units.pattern(unit, signed)}
    return text if unit else {"anyOf": [{"type": "number"} if signed else {"type": "number", "minimum": 0}, text]}


@dataclass(frozen=True)
class Amount:
    """For `Annotated`: a quantity whose SI unit is `unit`, more than 0 or, with `zero`, at least 0; at most `most`.

    least: the least number above 0 that is meant. within: the range of a quantity of which others are one in another
    unit, mistaken.
    """

    unit: str
    zero: bool = False
    most: float = math.inf
    within: tuple[float, float] | None = None
    least: float = 0.0

    def read(self, raw: object) -> units.Quantity:
        value = units.parse(raw, self.unit)
        if value < 0 or (value == 0 and not self.zero) or value > self.most:
            upper = f" and at most {units.show(self.most, self.unit)}" if self.most < math.inf else ""
            upper = f" and at most {self.most:g} ({100 * self.most:g} %)" if upper and not self.unit else upper
            raise ValueError(f"{value} is not possible; it must be {'at least' if self.zero else 'more than'} 0{upper}")
        if 0 < value < self.least:
            raise ValueError(f"{value} is not possible; it must be at least {self.least:g} {self.unit}".rstrip())
        if self.within is not None and not self.within[0] <= value <= self.within[1]:
            low, high = (units.show(end, self.unit) for end in self.within)
            raise ValueError(f"{value} is no light; its wavelength is {low} to {high}, 500 nm for example")
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return core_schema.no_info_plain_validator_function(self.read)

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        text = written(self.unit, signed=False)
        if self.unit:  # a number and its unit are a text, of which a schema knows no range
            return text
        bare = {"type": "number", "minimum" if self.zero else "exclusiveMinimum": 0}
        bare |= {"maximum": self.most} if self.most < math.inf else {}
        return {"anyOf": [bare, *text["anyOf"][1:]]}


Time = Annotated[units.Quantity, Amount("s", most=units.LONGEST, least=units.SHORTEST)]
Wavelength = Annotated[units.Quantity, Amount("m", within=units.WAVELENGTHS)]
Area = Annotated[units.Quantity, Amount("m^2", most=units.LARGEST_PIXEL)]
Lux = Annotated[units.Quantity, Amount("lux")]
Irradiance = Annotated[units.Quantity, Amount("W/m^2")]
Share = Annotated[units.Quantity, Amount("", most=1)]
Uncertainty = Annotated[units.Quantity, Amount("", zero=True, most=1)]
Mean = Annotated[units.Quantity, Amount("", zero=True)]


# --- reading ------------------------------------------------------------------------------------------------------


@dataclass
class Reader:
    """Reads the parts of one file; every mistake goes to `problems`, which several readers may share.

    base: the folder that names of files refer to; it is the context of every validator.
    """

    source: Document
    base: Path
    problems: list[str] = field(default_factory=list)

    examples: ClassVar[Mapping[str, str]] = {}  # of an entry: what to write where it is missing

    def say(self, path: Path_, sentence: str) -> None:
        """Note a mistake at a place."""
        self.problems.append(f"{self.source.place(path)}: {sentence}")

    def missing(self, name: str) -> str:
        """What is said of a group that lacks an entry."""
        example = f"; write for example {self.examples[name]}" if name in self.examples else ""
        return f"{name} is missing{example}"

    def sections(self, raw: Mapping[str, Any], kinds: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
        """The entries of the file that are well formed, each read by itself: a mistake in one hides none in another.

        kinds: pydantic's, by name; defaults: of the entries that may be left out.
        """
        for key in raw:
            if key not in kinds:
                self._no_entry((key,), kinds)
        found = {}
        for name, kind in kinds.items():
            if name not in raw and name not in defaults:
                self.say((), self.missing(name))
                continue
            value = self.valid(kind, raw.get(name, defaults.get(name)), (name,))
            if value is not None or (name in defaults and raw.get(name) is None):
                found[name] = value
        return found

    def valid(self, kind: Any, raw: Any, path: Path_) -> Any:
        """`raw` as pydantic's `kind`, or None after its mistakes were noted."""
        try:
            return TypeAdapter(_whole(kind)).validate_python(raw, strict=True, context=self.base)
        except ValidationError as error:
            for item in error.errors():
                self._note(item, kind, path)
        except RecursionError:
            self.say(path, "is nested too deeply")
        return None

    def _note(self, item: Any, kind: Any, path: Path_) -> None:
        where = _follow(kind, item["loc"])
        self.problems.append(self._sentence(item, where, path))
        if item["type"].startswith("union_tag"):
            self._note_whichever(item["input"], where, (*path, *where.path))

    def _note_whichever(self, raw: Mapping[Any, Any], where: _Place, path: Path_) -> None:
        """What is wrong with a group whichever member of a union it is, for it does not say so."""
        members = [member.model_fields for member in dict.fromkeys(where.members.values())]
        for name, value in raw.items():
            found = [fields[name] for fields in members if name in fields]
            if not found:
                self._no_entry((*path, name), where.fields)
            elif name != where.discriminator and all(_declared(one) == _declared(found[0]) for one in found):
                self.valid(found[0], value, (*path, name))
        for name in where.fields:
            needed = all(name in fields and fields[name].is_required() for fields in members)
            if needed and name not in raw and name != where.discriminator:
                self.say(path, self.missing(name))

    def _no_entry(self, path: Path_, allowed: Iterable[str]) -> None:
        self.problems.append(f"{self.source.place(path)} is not an entry here.{_allowed(path[-1], allowed)}")

    def _sentence(self, item: Any, where: _Place, path: Path_) -> str:
        full = (*path, *where.path)
        place, value, what = self.source.place(full), item.get("input"), item["type"]
        context, name = item.get("ctx", {}), str(full[-1]) if full else ""
        if what in ("extra_forbidden", "invalid_key"):
            if others := [tag for tag, member in where.members.items() if name in member.model_fields]:
                which = where.discriminator
                return (
                    f"{place}: belongs to the {which} {_or(others)}, and this is {where.tag}; "
                    f"take it out, or correct {which}"
                )
            return f"{place} is not an entry here.{_allowed(name, where.above)}"
        if what == "missing":
            return f"{self.source.place(full[:-1])}: {self.missing(name)}"
        if what == "value_error":
            return f"{place}: {context['error']}"
        if what == "union_tag_not_found":
            return f"{place} needs a {where.discriminator}: one of {', '.join(where.members)}"
        if what in ("literal_error", "union_tag_invalid"):
            tagged = what == "union_tag_invalid"
            words, given = (where.members, context["tag"]) if tagged else (get_args(where.kind), value)
            place = self.source.place((*full, where.discriminator)) if tagged else place
            return f"{place}: {brief(given)} is not one of {', '.join(words)}.{did_you_mean(str(given), words)}"
        return f"{place}: {brief(value)} is not possible; {_expected(what, context, where.fields)}"


# --- where pydantic found a mistake -------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Place:
    """path: as the file has it; kind: of what stands there; above: the entries that the group around it may have.

    members: by tag, of the union that stands there or, where the group around it is one of a union, of that one;
    discriminator: the entry that says which is meant; tag: which it is.
    """

    path: Path_
    kind: Any
    above: Mapping[str, Any]
    members: Mapping[str, type[BaseModel]]
    discriminator: str
    tag: str

    @property
    def fields(self) -> list[str]:
        """The entries that may stand there."""
        members = [self.kind] if hasattr(self.kind, "model_fields") else self.members.values()
        return list(dict.fromkeys(name for member in members for name in member.model_fields))


def _follow(kind: Any, location: Sequence[Any]) -> _Place:
    """Pydantic names the member of a union in the location; the file does not."""
    kind, discriminator = _plain(kind)
    members = _members(kind, discriminator)
    above: Mapping[str, Any] = {}
    path, tag = [], ""
    for part in location:
        if members and not tag:
            kind, tag = members[part], part
            continue
        path.append(part)
        above = getattr(kind, "model_fields", {})
        if part in above or get_origin(kind) is list:
            kind, discriminator = _plain(above[part] if part in above else get_args(kind)[0])
            members, tag = _members(kind, discriminator), ""
        else:
            kind = Any
    return _Place(tuple(path), kind, above, members, discriminator, tag)


def _plain(kind: Any) -> tuple[Any, str]:
    """A kind without what is annotated to it and without None; the discriminator, where it is a union that has one."""
    discriminator = ""
    while True:
        if isinstance(kind, FieldInfo):
            discriminator = str(kind.discriminator or discriminator)
            kind = kind.annotation
        elif get_origin(kind) is Annotated:
            kind, *notes = get_args(kind)
            for note in notes:
                discriminator = str(getattr(note, "discriminator", None) or discriminator)
        elif get_origin(kind) in (Union, types.UnionType) and len(rest := set(get_args(kind)) - {type(None)}) == 1:
            kind = rest.pop()
        else:
            return kind, discriminator


def _whole(kind: Any) -> Any:
    """A type with what a model says of its entry."""
    return Annotated[kind.annotation, kind] if isinstance(kind, FieldInfo) else kind


def _declared(kind: FieldInfo) -> Any:
    return kind.annotation, kind.metadata


def _members(kind: Any, discriminator: str) -> dict[str, type[BaseModel]]:
    if not discriminator:
        return {}
    return {tag: one for one in get_args(kind) for tag in get_args(one.model_fields[discriminator].annotation)}


# --- words --------------------------------------------------------------------------------------------------------


def brief(value: Any) -> str:
    """A value as Python writes it, in at most 60 characters."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _allowed(key: Any, names: Iterable[str]) -> str:
    names = list(names)
    return f"{did_you_mean(str(key), names)} Allowed are {', '.join(names)}"


def _or(words: Sequence[str]) -> str:
    return " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def _expected(what: str, context: Mapping[str, Any], fields: Sequence[str]) -> str:
    """What pydantic's kind of error asks for, in our words."""
    if what in ("greater_than_equal", "greater_than", "less_than_equal", "less_than"):
        bound = next(iter(context.values()))
        words = {"greater_than_equal": "at least", "greater_than": "more than", "less_than_equal": "at most"}
        return f"it must be {words.get(what, 'less than')} {bound}"
    if what == "too_short":
        return "it must have at least one entry"
    names = {
        "int": "a whole number",
        "float": "a number",
        "string": "text",
        "bool": "true or false",
        "list": "a list, [...]",
    }
    for kind, name in names.items():
        if what.startswith(kind):
            return f"it must be {name}"
    if what.startswith(("model", "dict")):
        listed = f" ({', '.join(fields)})" if fields else ""
        return f"it must be a group of entries{listed}"
    return "see the examples in configs/"
