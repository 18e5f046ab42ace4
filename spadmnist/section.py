"""A part of a config as a class, and how a manifest keeps it: keys that come later change no old identity."""

from __future__ import annotations

import functools
from typing import Any

from pydantic import BaseModel, ConfigDict, create_model

from .units import Quantity

# Marks a key that datasets of earlier programs do not name: `key: Annotated[int, LATER] = 0`. Its default does what
# those programs did, and a manifest names it only where it has another value.
LATER = "later"


class Section(BaseModel):
    """Base of every part of a config. What is not declared is refused, and so is what has another type."""

    model_config = ConfigDict(
        strict=True,
        extra="forbid",
        frozen=True,
        validate_default=True,
        allow_inf_nan=False,
        arbitrary_types_allowed=True,
    )

    @classmethod
    def __pydantic_init_subclass__(cls, **keywords: Any) -> None:
        for name, info in cls.model_fields.items():
            if LATER in info.metadata and info.is_required():
                raise TypeError(f"{cls.__name__}.{name} came later, so that old configs lack it: give it a default")

    def written(self) -> dict[str, Any]:
        """What a manifest keeps: every key in its order, defaults filled in, quantities as they were written.

        A key without a value is left out, and so is one that came later and stands at its default, written or not.
        """
        return {
            name: _plain(value)
            for name, info in type(self).model_fields.items()
            if (value := getattr(self, name)) is not None
            and not (LATER in info.metadata and value == _default(type(self), name))
        }


@functools.cache
def _default(kind: type[Section], name: str) -> Any:
    """The default of one key, checked and turned into its type as a written value is."""
    info: Any = kind.model_fields[name]
    alone: Any = create_model("Alone", __config__=Section.model_config, key=(info.annotation, info))
    return alone().key


def _plain(value: Any) -> Any:
    if isinstance(value, Section):
        return value.written()
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, Quantity):  # without a dimension it is a number, unless it is in per cent
        return value.text if value.unit or "%" in value.text else float(value)
    return value
