"""The user's own modules that some code imports: what it does is decided by them as much as by itself.

A module is the user's own where it lies in no folder of the standard library or of installed packages.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.machinery
import importlib.util
import io
import os
import site
import sys
import sysconfig
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Own:
    """A module of the user's own.

    Attributes:
        file: its place by its name, `a/b.py` of the module `a.b`, wherever it lies.
        sha256: of its text, or of its bytes where it has none.
        text: None of a module that is compiled.
    """

    file: str
    sha256: str
    text: str | None


@functools.cache
def installed() -> tuple[str, ...]:
    """The folders of the standard library and of installed packages, each with a separator behind it."""
    found = {sysconfig.get_path(kind) for kind in ("stdlib", "platstdlib", "purelib", "platlib")}
    return tuple(os.path.join(folder, "") for folder in (found | {*site.getsitepackages(), site.getusersitepackages()}))


def own_modules(names: Iterable[str]) -> tuple[Own, ...]:
    """The user's own among some modules, and those that these import, by file. Nothing is run for it."""
    found: dict[str, Own | None] = {}
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        found[name], file = None, _file(name)
        if file is None:
            continue
        try:
            content = Path(file).read_bytes()
        except OSError:  # what is no module may stand among them
            continue
        within = os.path.basename(file)
        base = name.replace(".", "/")
        place = f"{base}/__init__.py" if within == "__init__.py" else base + "".join(Path(file).suffixes[-1:])
        text = _text(content) if file.endswith(".py") else None
        found[name] = Own(place, hashlib.sha256(content if text is None else text.encode()).hexdigest(), text)
        if text is not None:
            waiting += named(text, name if within == "__init__.py" else name.rpartition(".")[0])
    return tuple(sorted((one for one in found.values() if one is not None), key=lambda one: one.file))


def named(text: str, package: str = "") -> set[str]:
    """The names that may be modules in the imports of a text, wherever they stand in it; package: that it is of."""
    try:
        nodes = list(ast.walk(ast.parse(text)))
    except SyntaxError:
        return set()
    found = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            try:
                base = importlib.util.resolve_name(base, package or None)
            except ImportError:  # a text of no package, which would fail there
                continue
            found |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    return {".".join(name.split(".")[:n]) for name in found for n in range(1, name.count(".") + 2)}


def _text(content: bytes) -> str | None:
    try:
        return io.TextIOWrapper(io.BytesIO(content), encoding="utf-8").read()
    except UnicodeDecodeError:
        return None


def _file(name: str) -> str | None:
    """Where one of the user's own modules lies; None of another one, and where there is none."""
    first = name.partition(".")[0]
    if first in sys.stdlib_module_names or first in (__package__, "__main__"):
        return None
    if first != name and _file(first) is None and not _is_open(first):
        return None
    file = getattr(sys.modules.get(name), "__dict__", {}).get("__file__")
    if name not in sys.modules:
        spec = _spec(name)
        file = spec.origin if spec is not None and spec.has_location else None
    return file if isinstance(file, str) and not os.path.abspath(file).startswith(installed()) else None


def _is_open(name: str) -> bool:
    """Is it a package without a file of its own, whose parts may lie anywhere?"""
    spec = _spec(name)
    return spec is not None and spec.origin is None and spec.submodule_search_locations is not None


def _spec(name: str) -> importlib.machinery.ModuleSpec | None:
    """How a module would be found; the packages above it are not run for that, as `importlib.util.find_spec` does."""
    above = name.rpartition(".")[0]
    if not above:
        return importlib.machinery.PathFinder.find_spec(name)
    package = _spec(above)
    places = None if package is None else package.submodule_search_locations
    return None if places is None else importlib.machinery.PathFinder.find_spec(name, list(places))
