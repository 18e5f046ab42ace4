"""The JSON Schema of the YAML files, made from the classes that read them, so that an editor completes and checks.

What only several entries together can have wrong is left to the program.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Annotated, Any

from pydantic import Field, create_model

from . import config, plugins
from .effects import Effect
from .errors import InputError, did_you_mean
from .measurement import entries
from .reconstruct import Method
from .section import Section
from .validated import written

_DRAFT = "http://json-schema.org/draft-07/schema#"  # what editors read best
_DISTRIBUTION = "Distribution"


def of(kind: str) -> dict[str, Any]:
    """The schema of a kind of file: `config`, `sensor` or `measurement`. Raises InputError for another.

    Effects and methods are those that are registered, a user's own among them.
    """
    if kind not in _MADE:
        raise InputError(f"{kind} is no kind of file.{did_you_mean(kind, _MADE)} There are {', '.join(_MADE)}")
    made: dict[str, Any] = {"$schema": _DRAFT, **_tidied(_MADE[kind]())}
    return made


def kinds() -> list[str]:
    """The kinds of files that have a schema."""
    return list(_MADE)


def file_of(kind: str) -> str:
    """How the file of a schema is named."""
    return f"{kind}.schema.json"


def text(kind: str) -> str:
    """The schema of a kind of file as JSON, which ends its last line."""
    return json.dumps(of(kind), indent=1) + "\n"


def first_line(kind: str, folder: str = "") -> str:
    """The first line of a YAML file by which an editor finds the schema, that lies in `folder`."""
    return f"# yaml-language-server: $schema={folder}{file_of(kind)}\n"


# --- the three ----------------------------------------------------------------------------------------------------


def _config() -> dict[str, Any]:
    made = _model("Config", config.entries())
    made["properties"]["reconstruct"]["anyOf"][0]["items"] = {"enum": list(Method.registry)}
    return _with_effects(made)


def _sensor() -> dict[str, Any]:
    """`sensor:` and what is in it, or that alone."""
    made = _with_effects(_model("File", {"sensor": config.entries()["sensor"]}))
    alone = {"$ref": "#/$defs/_Sensor"}
    made["properties"]["sensor"] = alone
    return {"$defs": made.pop("$defs"), "anyOf": [made, alone]}


def _measurement() -> dict[str, Any]:
    known: dict[str, Any] = {name: (kind, ...) for name, kind in entries.SECTIONS.items()}
    known |= {
        "name": (entries.SECTIONS["name"], "measurement"),
        "captures": (Annotated[list[entries.Entry], Field(min_length=1, description="the captures")], ...),
    }
    return _model("Measurement", known)


_MADE: dict[str, Callable[[], dict[str, Any]]] = {
    "config": _config,
    "sensor": _sensor,
    "measurement": _measurement,
}


def _model(name: str, fields: dict[str, Any]) -> dict[str, Any]:
    made: Any = create_model(name, __base__=Section, **fields)
    found: dict[str, Any] = made.model_json_schema()
    return found


def _tidied(part: Any) -> Any:
    """Without titles, which say nothing; a member of a union needs the entry that says which it is."""
    if isinstance(part, list):
        return [_tidied(item) for item in part]
    if not isinstance(part, dict):
        return part
    made = {key: _tidied(item) for key, item in part.items() if not (key == "title" and isinstance(item, str))}
    which = made.pop("discriminator", None)
    if which is not None:
        made["required"] = [which["propertyName"]]
    return made


# --- effects ------------------------------------------------------------------------------------------------------


def _with_effects(made: dict[str, Any]) -> dict[str, Any]:
    """A schema in whose definition of a sensor stand the effects that are known."""
    defined = made["$defs"]
    found = {name: Effect.registry.find(name) for name in Effect.registry}
    defined["_Sensor"]["properties"]["effects"] = {
        "type": "object",
        "description": "what the sensor does; an effect that is not listed is absent",
        "properties": {name: _effect(effect) for name, effect in found.items()},
        "additionalProperties": False,
    }
    drawn = {one.unit for effect in found.values() for one in effect.parameters.values() if one.per}
    return {**made, "$defs": {**defined, **{_name(unit): _distribution(unit) for unit in sorted(drawn)}}}


def _effect(effect: type[Effect]) -> dict[str, Any]:
    required = [name for name, declared in effect.parameters.items() if declared.required]
    return {
        "type": "object" if required else ["object", "null"],
        "description": effect.summary(),
        "properties": {name: _parameter(declared) for name, declared in effect.parameters.items()},
        "required": required,
        "additionalProperties": False,
    }


def _parameter(declared: plugins.Parameter) -> dict[str, Any]:
    about = {"description": f"{declared.about}; {declared.allowed()}" if declared.unit != "bool" else declared.about}
    if declared.choices:
        return {"enum": list(declared.choices), **about}
    if declared.unit == "bool":
        return {"type": "boolean", **about}
    low, high = declared.bounds
    number = written(declared.unit, signed=low is None or low < 0)
    if not declared.unit:
        bare: dict[str, Any] = {"type": "number"}
        bare |= {} if low is None else {"exclusiveMinimum" if declared.open_bounds else "minimum": low}
        bare |= {} if high is None else {"exclusiveMaximum" if declared.open_bounds else "maximum": high}
        number = {"anyOf": [bare, number["anyOf"][1]]}
    forms = [number]
    if declared.per:
        forms += [_group({"file": {"type": "string"}}), {"$ref": f"#/$defs/{_name(declared.unit)}"}]
    if declared.by_wavelength:
        at = written("m")["pattern"]
        table = {"patternProperties": {at: number}, "additionalProperties": False, "minProperties": 1}
        forms.append({"type": "object", **table})
    return {**(forms[0] if len(forms) == 1 else {"anyOf": forms}), **about}


def _group(properties: dict[str, Any]) -> dict[str, Any]:
    """Exactly these entries."""
    return {
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def _name(unit: str) -> str:
    """Of the definition of a distribution of values with a unit; a pointer to it is no path."""
    return f"{_DISTRIBUTION} {unit}".strip().replace("/", " per ").replace("^", "").replace(" ", "_")


def _distribution(unit: str) -> dict[str, Any]:
    value, width, share = written(unit), written(unit, signed=False), written("", signed=False)
    part = {"allOf": [{"$ref": f"#/$defs/{_name(unit)}"}, {"required": ["share"]}]}
    kinds = {
        "normal": _group({"mean": value, "sigma": width}),
        "lognormal": _group({"median": value, "sigma": share}),
        "mixture": {"type": "array", "items": part, "minItems": 1},
    }
    return {
        "type": "object",
        "description": "drawn once for a chip, from its chip_seed",
        "properties": {**kinds, "share": share},
        "additionalProperties": False,
        "oneOf": [{"required": [kind]} for kind in kinds],
    }
