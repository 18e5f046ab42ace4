"""The command line: each verb a few lines over the library. The only package that prints or exits.

A file of verbs in this folder is found by itself; a name with an underscore is of what the verbs share.

What a program reads goes to standard output, everything else to standard error. Exit status: 0 done; 1 the answer is
'no'; 2 it could not be done; 130 interrupted. Imports stand inside the verbs, so that `--help` needs neither numpy
nor numba.
"""

from __future__ import annotations

import importlib
import io
import os
import pkgutil
import sys
import warnings

import click

from .. import interrupts
from ..foreign import visible
from ..workers import safe_path
from . import _limits as limits
from . import _terminal as terminal
from ._group import cli

__all__ = ["cli", "main"]

for _module in pkgutil.iter_modules(__path__):
    if not _module.name.startswith("_"):
        importlib.import_module(f"{__name__}.{_module.name}")

_MISTAKES = 30  # of a file, said one a line; a screen holds them


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit: one clear sentence and no traceback for whatever a user can cause."""
    _open_streams()
    interrupts.install()
    try:
        with safe_path(), warnings.catch_warnings():
            # libraries warn programmers; what a user should know is said in a sentence. Tests raise what numpy warns of
            if not os.environ.get("SPADMNIST_DEBUG") and not sys.warnoptions:
                warnings.simplefilter("ignore")
            status = _run(arguments)
    except KeyboardInterrupt:  # between the verb and its end
        status = interrupts.status()
    sys.exit(status)


def _open_streams() -> None:
    """A stream that the caller has closed leads nowhere, for workers too: a file opened later would take its place."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:  # the lowest number that is free is this one
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115


def _run(arguments: list[str] | None) -> int:
    try:
        interrupts.under_way(True)
        result = cli.main(arguments, prog_name="spadmnist", standalone_mode=False)
        sys.stdout.flush()
        return result if isinstance(result, int) else 0
    except (click.Abort, KeyboardInterrupt):
        return interrupts.status()
    except Exception as error:
        return interrupts.status() if interrupts.came() else _failed(error)
    finally:
        interrupts.under_way(False)


def _failed(error: Exception) -> int:
    """The exit status after an error, which is said."""
    from ..errors import ConfigError, SpadError

    if isinstance(error, click.exceptions.Exit):
        return error.exit_code
    if isinstance(error, BrokenPipeError):
        # the reader has gone; there is nobody left to tell
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        for line in error.format_message().split("\n"):
            terminal.say(line)
    elif isinstance(error, click.ClickException):
        shown, words = io.StringIO(), error.format_message()
        error.show(shown)
        for line in shown.getvalue().replace(words, visible(words)).rstrip("\n").split("\n"):
            terminal.say(line)
    elif isinstance(error, ConfigError):
        for problem in error.problems[:_MISTAKES]:
            terminal.say(f"Error: {problem}")
        if len(error.problems) > _MISTAKES:
            terminal.say(f"Error: there are {len(error.problems) - _MISTAKES:,} mistakes more; correct these first")
    elif isinstance(error, SpadError):
        terminal.say(f"Error: {error}")
    elif isinstance(error, MemoryError):
        terminal.say("Error: there is not enough memory; give fewer --jobs, smaller images or shorter captures")
    elif limits.is_alone(error):
        terminal.say(f"Error: {limits.ALONE}")
    elif isinstance(error, OSError):
        terminal.say(f"Error: {error.filename or 'the system'}: {error.strerror or error}")
    elif os.environ.get("SPADMNIST_DEBUG"):
        raise error
    else:
        terminal.say(
            "Error: this should not have happened, and is a fault of the program: "
            f"{type(error).__name__}: {' '.join(str(error).split())}"
        )
        terminal.say("SPADMNIST_DEBUG=1 shows where; please report it.")
    return 2
