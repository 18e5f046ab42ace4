"""Every error a user can cause: one sentence with the place, the value, what is allowed and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SpadError(Exception):
    """Something could not be done. The message is for the user; the command line prints it and exits with 2."""


class ConfigError(SpadError):
    """One or more mistakes in a config or sensor file, all of them at once (one line each)."""

    def __init__(self, problems: Iterable[str]):
        self.problems = tuple(problems)
        super().__init__("\n".join(self.problems))


class InputError(SpadError):
    """A file that was given (images, maps, a dataset) cannot be used as it is."""


class UnknownName(KeyError):
    """There is nothing of that name. It is shown as its sentence, not in quotes as other KeyErrors are."""

    def __str__(self) -> str:
        return str(self.args[0]) if self.args else ""


class EffectError(SpadError):
    """An effect's own code failed, or returned what no effect may return.

    Attributes:
        plugin: name of the effect or the statistic, where it is known.
    """

    plugin: str = ""


# What says of a model that it cannot be simulated: of a candidate, then, that it is none.
UNABLE = (SpadError, ArithmeticError, ValueError, MemoryError)


def why(error: BaseException) -> str:
    """What an error says, in one line; its kind, where that is not of this program."""
    said = " ".join(str(error).split())
    if isinstance(error, SpadError):
        return said
    return f"{type(error).__name__}: {said}" if said else type(error).__name__


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`" Did you mean dead_time?"`, or an empty string where nothing is near."""
    near = difflib.get_close_matches(str(word), list(known), n=1, cutoff=0.6)
    return f" Did you mean {near[0]}?" if near else ""
