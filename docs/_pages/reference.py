"""The reference, made from the classes: verbs, keys of the files, formats, statistics, methods, the library.

What the library returns has the page `answers`, what is imported by itself the page `modules`.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable
from pathlib import Path

import spadmnist
from spadmnist import schema
from spadmnist.reconstruct import Method
from spadmnist.reference import all_statistics
from spadmnist.statistics import Statistic
from spadmnist.statistics.checks import Check

from . import answers, formats, keys, modules, objects, verbs
from . import markdown as md


def pages(folder: Path) -> dict[str, str | bytes]:
    """The files of the chapter by name. folder: in which pages may lie that somebody wrote by hand."""
    made: dict[str, Callable[[], str]] = {"verbs": verbs.page}
    made |= {kind: lambda kind=kind: keys.page(kind) for kind in schema.kinds()}
    made |= {"formats": formats.page, "statistics": statistics, "methods": methods, "library": library}
    made |= {"answers": answers.page, "modules": modules.page}
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
            blocks += [f"## sp.{name}", md.prose(inspect.getdoc(found))]
            continue
        blocks += [f"## sp.{name}", *objects.described(found, f"sp.{name}")]
        if inspect.isclass(found) and issubclass(found, Exception):
            blocks += [_kind(one) for one in vars(sys.modules[found.__module__]).values() if _is_kind(one, found)]
    return md.page("The library", *blocks)


def _is_kind(one: object, of: type[Exception]) -> bool:
    return inspect.isclass(one) and issubclass(one, of) and one is not of


def _kind(error: type[Exception]) -> str:
    """An error that is of a kind of its own, as an entry of a list of definitions."""
    return f"`{error.__module__}.{error.__name__}`\n: {md.plain((inspect.getdoc(error) or '').partition(chr(10))[0])}"
