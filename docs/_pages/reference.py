"""The reference: verbs, keys of the files, formats, statistics, methods and the library, made from the classes."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import spadmnist
from spadmnist import schema
from spadmnist.reconstruct import Method
from spadmnist.reference import all_statistics
from spadmnist.statistics import Statistic
from spadmnist.statistics.checks import Check

from . import formats, keys, verbs
from . import markdown as md


def pages(folder: Path) -> dict[str, str | bytes]:
    """The files of the chapter by name. folder: in which pages may lie that somebody wrote by hand."""
    made: dict[str, Callable[[], str]] = {"verbs": verbs.page}
    made |= {kind: lambda kind=kind: keys.page(kind) for kind in schema.kinds()}
    made |= {"formats": formats.page, "statistics": statistics, "methods": methods, "library": library}
    written: dict[str, str | bytes] = {f"{name}.md": page() for name, page in made.items()}
    others = sorted(file.stem for file in folder.glob("*.md") if not file.read_text("utf-8").startswith(md.MARK))
    names = [*made, *(name for name in others if name != "index")]
    titles = {name: _title(written.get(f"{name}.md") or (folder / f"{name}.md").read_text("utf-8")) for name in names}
    links = "\n".join(f"- [{title}]({name}.md)" for name, title in titles.items())
    written["index.md"] = md.page("Reference", "Made from the classes of the program.", links, md.toctree(names))
    return written


def _title(text: str | bytes) -> str:
    """The first heading of a page."""
    found = re.search(r"^# (.*)$", str(text), re.MULTILINE)
    return found.group(1) if found else ""


# --- statistics and methods ---------------------------------------------------------------------------------------


def statistics() -> str:
    """The page of all statistics: what each is, its law, what it shows, its source."""
    known = all_statistics()
    rows = [[f"[`{c.name}`](#{c.name})", _modalities(c), c.unit, md.plain(c.summary())] for c in known]
    blocks = [
        "A statistic reduces a capture to numbers, its cells. `compare` sets each cell of the measured capture against "
        "the same cell of simulated ones.",
        md.table(("statistic", "modality", "unit", "what it measures"), rows),
    ]
    for cls in known:
        flat = " For light that is the same on all pixels; a scene has none." if cls.flat else ""
        blocks += [f"## {cls.name}", f"Modality: {_modalities(cls)}. Unit: {cls.unit}.{flat}"]
        blocks += md.paragraphs(inspect.getdoc(cls))
    return md.page("Statistics", *blocks)


def _modalities(cls: type[Statistic] | type[Check]) -> str:
    return ", ".join(f"`{m}`" for m in cls.modalities)


def methods() -> str:
    """The page of all reconstruction methods."""
    known: list[type[Method]] = [Method.registry.find(name) for name in Method.registry]
    rows = [[f"[`{c.name}`](#{c.name})", ", ".join(c.readouts()), c.unit, md.plain(c.summary())] for c in known]
    blocks = [md.table(("method", "needs", "unit", "formula"), rows)]
    for cls in known:
        use = "divided by the training median" if cls.normalised else "never normalised"
        needs = ", ".join(f"`{name}`" for name in cls.readouts())
        blocks += [f"## {cls.name}", f"Needs: {needs}. Unit: {cls.unit}. For use it is {use}."]
        blocks += md.paragraphs(inspect.getdoc(cls))
    return md.page("Reconstruction methods", *blocks)


# --- the library --------------------------------------------------------------------------------------------------


def library() -> str:
    """The page of the public names of the package."""
    blocks = [
        md.prose((inspect.getdoc(spadmnist) or "").partition("\n\n")[0]),
        md.code("import spadmnist as sp", "python"),
    ]
    for name in spadmnist.__all__:
        found = getattr(spadmnist, name)
        if inspect.ismodule(found):
            blocks += [f"## sp.{name}", md.prose(inspect.getdoc(found).partition("\n\n")[0])]
            continue
        blocks += [f"## sp.{name}", md.code(f"sp.{name}{_signature(found)}", "python"), md.prose(_doc(found))]
        if inspect.isclass(found):
            blocks += [_member(found, key) for key in _public(found)]
    return md.page("The library", *blocks)


def _public(cls: type[Any]) -> list[str]:
    """The public methods and properties that a class of the package defines and explains."""
    found = []
    for key in dir(cls):
        owner = next((one for one in cls.__mro__ if key in vars(one)), object)
        value = inspect.getattr_static(cls, key)
        described = (
            callable(value) or isinstance(value, property | classmethod | staticmethod) or hasattr(value, "func")
        )
        if not key.startswith("_") and owner.__module__.startswith("spadmnist") and described:
            found.append(key)
    return found


def _member(cls: type[Any], key: str) -> str:
    value = inspect.getattr_static(cls, key)
    plain = value.fget if isinstance(value, property) else getattr(value, "func", getattr(value, "__func__", value))
    doc = " ".join((inspect.getdoc(plain) or "").split("\n\n")[0].split())
    call = "" if isinstance(value, property) or hasattr(value, "func") else _signature(plain, bound=True)
    return f"`.{key}{call}`\n: {md.plain(doc) or 'See the class.'}"


def _signature(found: Any, bound: bool = False) -> str:
    """As it is called, without types: (sensor, measurement, *, seed=0)."""
    try:
        known = inspect.signature(found)
    except (TypeError, ValueError):
        return ""
    given = list(known.parameters.values())
    if bound and given and given[0].name in ("self", "cls"):
        given = given[1:]
    plain = [one.replace(annotation=inspect.Parameter.empty) for one in given if not one.name.startswith("_")]
    text = str(known.replace(parameters=plain, return_annotation=inspect.Signature.empty))
    return re.sub(r"<[^<>]*>", "...", text)


def _doc(found: Any) -> str:
    """Its docstring, with each of its sections (Args, Returns, Raises) as a paragraph of its own."""
    doc = inspect.getdoc(found) or ""
    return re.sub(r"^(Args|Returns|Raises|Attributes|Yields):\s*$", r"\n\1:", doc, flags=re.MULTILINE)
