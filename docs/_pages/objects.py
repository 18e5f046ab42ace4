"""Classes and functions of the package as Markdown: how they are called, their docstrings, their members."""

from __future__ import annotations

import inspect
import re
import textwrap
from typing import Any

from . import markdown as md


def described(found: Any, call: str = "") -> list[str]:
    """The blocks that describe a class or a function: call, docstring, members.

    Args:
        call: its name as a reader writes it; "" for a class that nobody calls.
    """
    blocks = [md.code(f"{call}{signature(found)}", "python")] if call else []
    blocks.append(md.prose(sections(found)))
    if inspect.isclass(found):
        blocks += [member(found, key) for key in public(found)]
    return blocks


def public(cls: type[Any]) -> list[str]:
    """The public methods and properties that a class of the package defines and explains."""
    found = []
    for key in dir(cls):
        owner = next((one for one in cls.__mro__ if key in vars(one)), object)
        value = inspect.getattr_static(cls, key)
        described = callable(value) or hasattr(plain(value), "__code__")
        if not key.startswith("_") and owner.__module__.startswith("spadmnist") and described:
            found.append(key)
    return found


def plain(value: Any) -> Any:
    """The function behind a method or a property of a class, as `inspect.getattr_static` gives it."""
    return value.fget if isinstance(value, property) else getattr(value, "func", getattr(value, "__func__", value))


def member(cls: type[Any], key: str) -> str:
    """A method or a property with its docstring, as an entry of a list of definitions."""
    value = inspect.getattr_static(cls, key)
    call = "" if isinstance(value, property) or hasattr(value, "func") else signature(plain(value), bound=True)
    text = md.prose(sections(plain(value))) or "See the class."
    return f"`.{key}{call}`\n: {textwrap.indent(text, '  ').strip()}"


def signature(found: Any, bound: bool = False) -> str:
    """As it is called, without types: (sensor, measurement, *, seed=0)."""
    try:
        known = inspect.signature(found)
    except (TypeError, ValueError):
        return ""
    given = list(known.parameters.values())
    if bound and given and given[0].name in ("self", "cls"):
        given = given[1:]
    bare = [_bare(one) for one in given if not one.name.startswith("_")]
    return str(known.replace(parameters=bare, return_annotation=inspect.Signature.empty))


def _bare(parameter: inspect.Parameter) -> inspect.Parameter:
    """The same without its type; a default that Python writes in no other way than <...> is an ellipsis."""
    default = _Ellipsis() if "<" in repr(parameter.default) else parameter.default
    known = parameter.default is not inspect.Parameter.empty
    return parameter.replace(annotation=inspect.Parameter.empty, default=default if known else inspect.Parameter.empty)


class _Ellipsis:
    def __repr__(self) -> str:
        return "..."


def sections(found: Any) -> str:
    """Its docstring, with each of its sections (Args, Returns, Raises) as a paragraph of its own."""
    doc = inspect.getdoc(found) or ""
    return re.sub(r"^(Args|Returns|Raises|Attributes|Yields):\s*$", r"\n\1:", doc, flags=re.MULTILINE)
