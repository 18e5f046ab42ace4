"""The terminal: the one place that writes to it. Names and texts of files never reach it as they are."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from typing import TYPE_CHECKING, Any

import click

from ..foreign import short, visible, visible_lines

if TYPE_CHECKING:
    from ..factory import Progress


def say(text: str) -> None:
    """One line, for people."""
    # where nobody can be told there is nothing to do about it
    with contextlib.suppress(OSError, ValueError):
        click.echo(visible(short(text)), err=True)


def print_line(text: str) -> None:
    """One line that a program may read."""
    click.echo(visible(text))


def print_lines(text: str) -> None:
    """A table or a page: who made it has seen to it that only its own lines end."""
    click.echo(visible_lines(text))


def print_json(answer: Any) -> None:
    """All but DEL is escaped by itself."""
    click.echo(json.dumps(answer).replace("\x7f", "\\u007f"))


def duration(seconds: float) -> str:
    """`4.2 s`, or `3.5 min` where it is two minutes or more."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min"


_KNOWN_SHARE = 0.02  # of the work; with less done the first, slow part (start of workers, compiling) is the estimate
_KNOWN_AFTER = (2.0, 30.0)  # s: no time left is shown before the first; after the second it is, however little is done


_UNKNOWN = "estimating"  # in place of the time left, until it is known


def time_left(done: float, rest: float, elapsed: float) -> str:
    """`3.5 min left`, from the mean rate so far; `estimating` before enough is known. Times in s."""
    soon, late = _KNOWN_AFTER
    share = done / (done + rest) if done > 0 else 0.0
    if share > 0 and (elapsed >= late or (elapsed >= soon and share >= _KNOWN_SHARE)):
        return f"{duration(rest * elapsed / done)} left"
    return _UNKNOWN


# s from one line of a log to the next: until the time left is known, and then. Often enough to see that a run goes on,
# and few lines for one of hours; a rule of thumb
_LOG_EVERY = (10.0, 30.0)


class _Log:
    """In place of a bar, where standard error is no terminal: now and then a line with the time left."""

    def __init__(self, what: str, total: float, done: float):
        self.what, self.total, self.done = what, total, done
        self.began = time.monotonic()
        # the end of the first work and what was done then: the start of workers and compiling say nothing of the rest
        self.first: tuple[float, float] | None = None
        self.due = self.began + _LOG_EVERY[0]

    def update(self, work: float) -> None:
        self.done += work
        now = time.monotonic()
        since, before = self.first = self.first or (now, self.done)
        if now < self.due or self.done >= self.total:
            return
        left = time_left(self.done - before, self.total - self.done, now - since)
        say(f"{self.what} {self.done / self.total:.0%}, {duration(now - self.began)}, {left}")
        self.due = now + _LOG_EVERY[left != _UNKNOWN]

    def set_postfix_str(self, note: str, refresh: bool) -> None:
        """A line has room for the time alone."""

    def close(self) -> None:
        """Nothing is left on the screen."""


def _is_terminal() -> bool:
    """Whether standard error is one; what a program put in its place may not know."""
    try:
        return bool(sys.stderr.isatty())
    except (AttributeError, OSError, ValueError):
        return False


class progress:
    """A progress bar on standard error where that is a terminal, otherwise a line now and then."""

    def __enter__(self) -> Progress:
        from tqdm import tqdm

        from ..factory import Progress

        tqdm.monitor_interval = 0  # no thread that watches the bar

        class Bar(tqdm):
            @property
            def format_dict(self) -> dict[str, Any]:
                known = super().format_dict
                done, rest = known["n"] - known["initial"], known["total"] - known["n"]
                return {**known, "left": time_left(done, rest, known["elapsed"])}

        bar: list[Any] = []
        terminal = _is_terminal()

        def start(what: str, total: float, done: float) -> None:
            if not terminal:
                bar.append(_Log(what, total, done))
                return
            bar.append(
                Bar(
                    total=total,
                    initial=done,
                    desc=visible(what),
                    leave=False,
                    bar_format="{desc} {percentage:3.0f}%|{bar}| {elapsed}, {left}{postfix}",
                )
            )

        def advance(work: float, note: str) -> None:
            bar[-1].set_postfix_str(visible(note), refresh=False)
            bar[-1].update(work)

        def stop() -> None:
            while bar:
                bar.pop().close()

        self._stop = stop
        return Progress(start, advance, stop, say)

    def __exit__(self, *_: object) -> None:
        self._stop()
