"""The page of the modules that readers import from: those that the pages and the docstrings of public names import."""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import inspect
import re
import sys
from collections.abc import Iterator
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

import spadmnist

from . import markdown as md
from . import objects

ROOT = Path(__file__).parents[2]
# import spadmnist.torch as st; from spadmnist.photos import srgb_to_light; `spadmnist.cluster.Cluster`
_IMPORTED = re.compile(
    r"^\s*import spadmnist\.(?P<whole>\w+)|^\s*from spadmnist\.(?P<of>\w+) import (?P<names>[\w, ]+)"
    r"|\bspadmnist\.(?P<dotted>\w+)\.(?P<name>\w+)",
    re.MULTILINE,
)


def page() -> str:
    """The page of the modules."""
    blocks = ["Modules that are imported by their own names. All else is in `spadmnist`: [the library](library.md)."]
    for name, names in public().items():
        module = imported(name)
        blocks += [f"## {name}", *md.paragraphs(inspect.getdoc(module))]
        for key in names:
            blocks += [f"### {key}", *_described(key, getattr(module, key))]
    return md.page("Modules", *blocks)


def _described(key: str, found: Any) -> list[str]:
    if not callable(found):
        return [md.code(f"{key} = {found!r}", "python")]
    package = found.__module__.partition(".")[0]
    if package != "spadmnist":
        return [f"That of `{package}`."]
    return objects.described(found, key)


@functools.cache
def public() -> dict[str, list[str]]:
    """The public names of each module that has some: all that it says in `__all__`, otherwise those that are imported.

    What is a name of the package itself has its place in the library.
    """
    asked: dict[str, set[str]] = {}
    for text in _texts():
        for found in _IMPORTED.finditer(text):
            module = found["whole"] or found["of"] or found["dotted"]
            names = (found["names"] or found["name"] or "").split(",")
            asked.setdefault(f"spadmnist.{module}", set()).update(name.strip() for name in names)
    known = [getattr(spadmnist, name) for name in spadmnist.__all__]
    out = {}
    for name in sorted(asked):
        if importlib.util.find_spec(name) is None or any(name == getattr(one, "__name__", "") for one in known):
            continue
        module = imported(name)
        there = getattr(module, "__all__", sorted(key for key in asked[name] if hasattr(module, key)))
        names = [key for key in there if not any(getattr(module, key) is one for one in known)]
        if names:
            out[name] = names
    return out


def described() -> Iterator[Any]:
    """Every object that has a section on the page."""
    for name, names in public().items():
        yield from (getattr(imported(name), key) for key in names)


def _texts() -> Iterator[str]:
    """The pages that somebody wrote by hand, and the docstrings of the public names."""
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        text = path.read_text("utf-8")
        if not text.startswith(md.MARK):
            yield text
    for name in spadmnist.__all__:
        yield inspect.getdoc(getattr(spadmnist, name)) or ""


# --- modules that need a package which is not installed ------------------------------------------------------------


@functools.cache
def imported(name: str) -> ModuleType:
    """A module of the package. Where it needs another package that is not installed, a stand-in is there for it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        lacking = _lacking(error)
    with _stand_in(lacking):
        module = importlib.import_module(name)
    del sys.modules[name]  # a later import raises the error that names the missing library
    folder, _, own = name.rpartition(".")
    vars(sys.modules.get(folder, module)).pop(own, None)
    return module


def _lacking(error: ImportError) -> str:
    """The package that is not installed, as an error or the one behind it has it; raises the error where none is."""
    behind: BaseException | None = error
    while behind is not None:
        if isinstance(behind, ModuleNotFoundError) and behind.name:
            return behind.name.partition(".")[0]
        behind = behind.__context__
    raise error


class _Empty(ModuleType):
    """A module in which every name is a class without anything."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        members = {"__module__": self.__name__, "__class_getitem__": classmethod(lambda cls, item: cls)}
        return type(name, (), members)


class _StandIn(MetaPathFinder, Loader):
    """Finds a package that nothing else finds, and whatever is asked for in it, as empty modules."""

    def __init__(self, package: str):
        self.package = package

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        return ModuleSpec(fullname, self, is_package=True) if fullname.partition(".")[0] == self.package else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _Empty(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        pass


@contextlib.contextmanager
def _stand_in(package: str) -> Iterator[None]:
    """For as long as it lasts, a package that is not installed can be imported."""
    last = _StandIn(package)
    sys.meta_path.append(last)
    try:
        yield
    finally:
        sys.meta_path.remove(last)
        for name in [name for name in sys.modules if name.partition(".")[0] == package]:
            del sys.modules[name]
