"""Sensors on their way to a worker: packed with the user's own classes, which the worker may have no file of.

An effect or a statistic that is defined in a notebook, or in the program itself (`__main__`), is sent as its code, by
cloudpickle. What stands in a module that can be imported is sent by its name. A worker unpacks what its parent sends
it, and nothing else; nothing of this is ever written to a file.
"""

from __future__ import annotations

import io
import pickle
import types
from collections.abc import Callable, Mapping
from typing import Any

import cloudpickle

from .errors import EffectError
from .plugins import Plugin, source_file

_classes: dict[str, type[Plugin]] = {}  # by the number that cloudpickle gives a class: those sent, and those that came
_came: set[type[Plugin]] = set()


def packed(value: Any, apart: bool = True) -> bytes:
    """The bytes of a value, with the classes in it that are in no module.

    Args:
        apart: they are unpacked in another process. In this one a class is itself, and no code is packed.

    Raises:
        EffectError: where a class cannot be packed.
    """
    with io.BytesIO() as file:
        pickler = _Pickler(file)
        pickler.apart = apart
        try:
            pickler.dump(value)
        except EffectError:
            raise
        except Exception as error:  # pickling raises nearly anything
            raise _refused(pickler.last, error) from error
        return file.getvalue()


def unpacked(data: bytes) -> Any:
    """The value of `packed`; its classes are registered. For bytes of this process or its parent alone.

    Raises:
        EffectError: where a module with one of its classes is not here.
    """
    try:
        return pickle.loads(data)
    except (ImportError, AttributeError) as error:
        raise EffectError(
            f"a worker cannot import the module of an effect or a statistic ({error}); install it, or give its file "
            'as a plug-in: plugins=["FILE.py"]'
        ) from None


def _refused(cls: type[Plugin] | None, error: Exception) -> EffectError:
    what = "the model" if cls is None else f"{source_file(cls)}: the {cls.registry.kind} {cls.name}"
    return EffectError(
        f"{what} cannot be sent to workers ({' '.join(str(error).split()) or type(error).__name__}); give its class "
        'in a file of its own as a plug-in, plugins=["FILE.py"], or work with jobs=1'
    )


class _Pickler(cloudpickle.Pickler):
    """cloudpickle, but a plug-in's class is made anew without the rules of its declaration, then filled."""

    apart = True
    last: type[Plugin] | None = None  # the class that is being packed

    def reducer_override(self, value: Any) -> Any:
        reduced = super().reducer_override(value)
        if reduced is NotImplemented or not (isinstance(value, type) and issubclass(value, Plugin)):
            return reduced
        _, (made_by, name, bases, body, number, _), state, _, _, fill = reduced
        _classes.setdefault(number, value)
        self.last = value
        if not self.apart:
            return _itself, (number,)
        return _empty, (made_by, name, bases, body, number), (fill, state), None, None, _filled


def _itself(number: str) -> type[Plugin]:
    """The class of that number, in the process that has packed it."""
    return _classes[number]


def _empty(made_by: type, name: str, bases: tuple[type, ...], body: Mapping[str, Any], number: str) -> type[Plugin]:
    """The class of that number; where it is new here, without anything in it."""
    if number not in _classes:
        declared = {"metaclass": made_by, "abstract": True}
        made = types.new_class(name, bases, declared, lambda own: own.update(body))
        _classes[number] = made
        _came.add(made)
    return _classes[number]


def _filled(cls: type[Plugin], state: tuple[Callable[[type, Any], Any], Any]) -> None:
    """Give a class that came what it has; one of this process has it."""
    if cls in _came:
        fill, own = state
        fill(cls, own)
        if "name" in vars(cls):  # what is abstract has none
            cls.registry.add(cls)
