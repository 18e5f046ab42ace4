"""The page of the answers: the classes of what the library gives, found by the annotations of its public names."""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import re
import sys
from collections.abc import Iterator
from typing import Any

import spadmnist

from . import markdown as md
from . import modules, objects

_GIVEN = ("__getitem__", "__iter__")  # what a reader gets of an object without naming an attribute


def page() -> str:
    """The page of the answers."""
    blocks = [
        "What the functions of [the library](library.md) return, what its objects give, and what these answers hold. "
        "Numbers are in SI units. The library makes these objects, so that no constructor is shown."
    ]
    for cls, places in classes().items():
        of = ", ".join(md.literal(place) for place in places)
        blocks += [f"## {cls.__name__}", f"`{cls.__module__}.{cls.__name__}`, from {of}.", *objects.described(cls)]
    return md.page("Answers of the library", *blocks)


def classes() -> dict[type[Any], list[str]]:
    """The classes without a section elsewhere that public names lead to, and where each of them is met.

    Of a function what it returns; of a class what indexing it gives, its properties, and the attributes that its
    docstring explains; of a class that is found here its methods, too.
    """
    names = [name for name in spadmnist.__all__ if not inspect.ismodule(getattr(spadmnist, name))]
    public = {f"sp.{name}": getattr(spadmnist, name) for name in names}
    elsewhere = {id(one) for one in [*public.values(), *modules.described()]}
    found: dict[type[Any], list[str]] = {}

    def follow(place: str, annotation: Any, module: str) -> None:
        for cls in _classes_in(annotation, module):
            if id(cls) in elsewhere or cls.__name__.startswith("_"):
                continue
            known = cls in found
            where = found.setdefault(cls, [])
            if place not in where and not place.startswith(f"{cls.__name__}."):
                where.append(place)
            if not known:
                for key, one, its in _attributes(cls, methods=True):
                    follow(f"{cls.__name__}{key}", one, its)

    for name, one in sorted(public.items(), key=lambda item: _is_made(item[0])):
        if not inspect.isclass(one):
            follow(name, one.__annotations__.get("return"), one.__module__)
        else:
            for key, annotation, module in _attributes(one, methods=False):
                follow(f"{name}{key}", annotation, module)
    return found


def _is_made(place: str) -> bool:
    """Is it what makes an object, and no verb?"""
    return place.partition(".")[2][0].isupper()


def _attributes(cls: type[Any], methods: bool) -> Iterator[tuple[str, Any, str]]:
    """(`.name`, annotation, module of it) of what an object gives."""
    for key in (*_GIVEN, *objects.public(cls)):
        value = inspect.getattr_static(cls, key, None)
        function = objects.plain(value)
        if inspect.isfunction(function) and (methods or key in _GIVEN or not inspect.isfunction(value)):
            yield ("[...]" if key in _GIVEN else f".{key}"), function.__annotations__.get("return"), function.__module__
    doc = inspect.getdoc(cls) or ""
    for owner in cls.__mro__:
        for key, annotation in vars(owner).get("__annotations__", {}).items():
            if re.search(rf"\b{key}(?:, \w+)*:", doc):
                yield f".{key}", annotation, owner.__module__


def _classes_in(annotation: Any, module: str) -> Iterator[type[Any]]:
    """The classes of the package that an annotation names, as text in a module."""
    if not isinstance(annotation, str):
        return
    for node in ast.walk(ast.parse(annotation, mode="eval")):
        if isinstance(node, ast.Name | ast.Attribute):
            first, *others = ast.unparse(node).split(".")
            found = _names(module).get(first)
            for name in others:
                found = getattr(found, name, None)
            if inspect.isclass(found) and found.__module__.startswith("spadmnist"):
                yield found


@functools.cache
def _names(module: str) -> dict[str, Any]:
    """The names of a module, those that it imports for its annotations alone among them."""
    there = sys.modules[module]
    found = dict(vars(there))
    for node in ast.parse(inspect.getsource(there)).body:
        if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            continue
        for line in (line for line in node.body if isinstance(line, ast.ImportFrom) and line.level):
            source = importlib.import_module("." * line.level + (line.module or ""), there.__package__)
            found |= {one.asname or one.name: getattr(source, one.name) for one in line.names}
    return found
