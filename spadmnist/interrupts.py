"""Ctrl-C and SIGTERM: a sentence and an end within seconds, whenever they come.

Before a verb begins and after it has ended nothing is under way, and the program leaves at once. In between the signal
is raised as KeyboardInterrupt, so that what is under way is tidied up. Where that takes too long, or a library has
swallowed it, the program leaves all the same: whatever is written appears by one rename, and the next run clears the
rest.
"""

# This comes before everything that takes time to import, in which Ctrl-C would be a traceback: `os` and `sys` are there
# already, and `_signal`, of which `signal` is made, is part of the interpreter.
import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    import signal as _signal
    from types import FrameType
else:
    import _signal

_STATUS = {int(_signal.SIGINT): 130, int(_signal.SIGTERM): 143}  # what a shell makes of the end by that signal
_SECONDS = 4.0  # for tidying up, before the program leaves all the same
_TWICE = 0.5  # s, in which one key press may come twice: to the program, and to its group
_SENTENCE = "Interrupted. What is complete is kept: the same command goes on from there."

_came: list[tuple[int, float]] = []  # (signal, time in s) of the first one
_under_way = False


def install() -> None:
    """Answer the signals from now on, at once. One that the caller lets the program ignore stays ignored."""
    for number in _STATUS:
        if _signal.getsignal(number) != _signal.SIG_IGN:
            _signal.signal(number, _answer)
    sys.unraisablehook = _unraisable


def under_way(now: bool) -> None:
    """Is there something to tidy up? Then a signal is raised as KeyboardInterrupt, otherwise it ends the program."""
    global _under_way
    _under_way = now


def came() -> bool:
    """Has a signal come? Then whatever was raised since is a consequence of it."""
    return bool(_came)


def status() -> int:
    """The exit status after an interruption, which is said."""
    number = _came[0][0] if _came else int(_signal.SIGINT)
    if number == _signal.SIGINT:
        _say()
    return _STATUS[number]


def _answer(number: int, frame: "FrameType | None") -> None:
    import time

    now = time.monotonic()
    if _came and now - _came[0][1] < _TWICE:
        return
    first = not _came
    if first:
        _came.append((number, now))
    if not first or not _under_way:
        _leave()
    _leave_later()
    raise KeyboardInterrupt


def _leave_later() -> None:
    import threading

    timer = threading.Timer(_SECONDS, _leave)
    timer.daemon = True
    try:
        timer.start()
    except RuntimeError:  # no thread is to be had
        return


def _leave() -> None:
    """The end of the process, whatever is under way; its workers end with it."""
    os._exit(status())


def _unraisable(about: "sys.UnraisableHookArgs") -> None:
    """A signal that came in a callback, from which nothing can be raised, is answered here."""
    if isinstance(about.exc_value, KeyboardInterrupt) and _came:
        _leave()
    sys.__unraisablehook__(about)


def _say() -> None:
    try:
        os.write(2, f"\n{_SENTENCE}\n".encode())
    except OSError:  # closed, or its reader has gone
        return
