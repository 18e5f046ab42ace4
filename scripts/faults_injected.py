"""Runs a command in a process that divides from this one, and that is killed, or whose disk is full, at its k-th step.

A step is an operation that changes what is on the disk. A write has two: nothing of its bytes is written yet, and half
of them are. The process has everything imported already, so that a try costs milliseconds.
"""

from __future__ import annotations

import builtins
import contextlib
import errno
import io
import mmap
import os
import resource
import select
import signal
import struct
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spadmnist import cli

_CHANGES = ("mkdir", "rename", "replace", "unlink", "remove", "rmdir", "link", "symlink", "fsync", "truncate")
_TAKES_SPACE = ("mkdir", "link", "symlink")
_BROKEN = 99  # exit status of a process in which something was raised that no command lets out
SECONDS = 10.0  # of the processor that a command may take; where nothing is wrong it takes some tenths of one
_WAITED = 10  # times as long by the clock: a busy machine gives a process a tenth of a processor, or less


@dataclass(frozen=True)
class Fault:
    """What happens at step `at`, counted from 1. kind: killed; full: from then on nothing new can be written."""

    kind: str
    at: int


@dataclass(frozen=True)
class End:
    """How a process ended. status: as a shell has it, negative for a signal; None: it took too long. steps: those that
    it came to.
    """

    status: int | None
    out: str
    err: str
    steps: int

    @property
    def killed(self) -> bool:
        """By the fault."""
        return self.status == -signal.SIGKILL

    def wrong(self, *allowed: int) -> str:
        """What is wrong with this end: no allowed status, or no sentence with status 2; empty: nothing."""
        if self.status is None:
            return f"does not end within {SECONDS:g} s of the processor"
        for word in ("Traceback", "fault of the program"):
            if word in self.err:
                return f"status {self.status}: {self.err.strip()[-600:]}"
        if self.status not in allowed:
            return f"status {self.status}: {(self.err.strip() or 'it says nothing')[-600:]}"
        if self.status == 2:
            said = [line for line in self.err.splitlines() if not line.startswith(("Note: ", "Usage: ", "Try "))]
            said = [line for line in said if line]
            if not said or not all(line.startswith("Error: ") and line.isprintable() for line in said):
                return f"its refusal is no sentence: {self.err.strip()!r}"
        return ""


def run(
    action: Callable[[], int | None],
    folder: Path,
    fault: Fault | None = None,
    seconds: float = SECONDS,
    memory: int | None = None,
) -> End:
    """Call `action` in a process of its own, in a folder. memory: bytes of address space that it may take beside those
    of this process.
    """
    counted = mmap.mmap(-1, 8)
    outputs = [os.memfd_create(name) for name in ("out", "err")]
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        status = _BROKEN
        try:
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            os.dup2(outputs[0], 1)
            os.dup2(outputs[1], 2)
            sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
            os.chdir(folder)
            if memory is not None:
                resource.setrlimit(resource.RLIMIT_AS, (_address_space() + memory,) * 2)
            _Steps(fault, counted).watch()
            status = action() or 0
        except SystemExit as stop:
            status = stop.code if isinstance(stop.code, int) else 0 if stop.code is None else _BROKEN
        except BaseException:
            traceback.print_exc()
        finally:
            with contextlib.suppress(Exception):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(status)
    status = _wait(child, seconds)
    texts = []
    for handle in outputs:
        with open(handle, "rb") as file:
            file.seek(0)
            texts.append(file.read().decode(errors="replace"))
    return End(status, *texts, struct.unpack("q", counted[:])[0])


def command(*arguments: object) -> Callable[[], int | None]:
    """`spadmnist ARGUMENTS` as an action."""
    return lambda: cli.main([str(one) for one in arguments])


def _wait(child: int, seconds: float) -> int | None:
    """The status of a process; None after so many seconds of the processor, or `_WAITED` times as many by the clock."""
    handle, began, ready = os.pidfd_open(child), time.monotonic(), False
    while not ready and _processor_time(child) < seconds and time.monotonic() - began < _WAITED * seconds:
        ready = bool(select.select([handle], [], [], 1.0)[0])
    os.close(handle)
    if not ready:
        os.kill(child, signal.SIGKILL)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return status if ready else None


def _processor_time(child: int) -> float:
    """s of the processor that a process has taken, with all its threads."""
    used = Path(f"/proc/{child}/stat").read_bytes().rpartition(b")")[2].split()[11:13]
    return sum(map(int, used)) / os.sysconf("SC_CLK_TCK")


def _address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


class _Steps:
    """Counts the operations on the disk of this process, and lets one of them go wrong."""

    def __init__(self, fault: Fault | None, counted: mmap.mmap):
        self.kind, self.at = (fault.kind, fault.at) if fault else ("", 0)
        self.count, self.counted = 0, counted

    def step(self, takes_space: bool = False) -> None:
        """Say that one begins. Raises OSError where it needs space and there is none."""
        self.count += 1
        self.counted[:] = struct.pack("q", self.count)
        if self.kind == "killed" and self.count == self.at:
            os.kill(os.getpid(), signal.SIGKILL)
        if self.kind == "full" and self.count >= self.at and takes_space:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def write(self, put: Callable[[memoryview], int], data: Any) -> int:
        """Put bytes in a file, in two halves. Returns how many were written: where the disk is full, perhaps half."""
        view = memoryview(data).cast("B")
        self.step(takes_space=True)
        half = put(view[: len(view) // 2]) if len(view) > 1 else 0
        try:
            self.step(takes_space=True)
        except OSError:
            if half:
                return half
            raise
        return half + put(view[half:])

    def watch(self) -> None:
        """From now on everything of this process that writes a file or changes a folder is counted."""
        for name in _CHANGES:
            setattr(os, name, self._counted(getattr(os, name), name in _TAKES_SPACE))
        steps, opened, real_open, put = self, os.open, builtins.open, os.write

        class Raw(io.FileIO):
            def write(self, data: Any) -> int:
                return steps.write(super().write, data)

        def open_handle(path: Any, flags: int, *more: Any, **named: Any) -> int:
            if flags & os.O_CREAT:
                steps.step()
            return opened(path, flags, *more, **named)

        def open_file(
            file: Any,
            mode: str = "r",
            buffering: int = -1,
            encoding: str | None = None,
            errors: str | None = None,
            newline: str | None = None,
            closefd: bool = True,
            opener: Any = None,
        ) -> Any:
            if not set(mode) & set("wax+"):
                return real_open(file, mode, buffering, encoding, errors, newline, closefd, opener)
            if not isinstance(file, int) and opener is None:
                steps.step()
            raw = Raw(file, mode.replace("b", "").replace("t", ""), closefd, opener)
            if buffering == 0:
                return raw
            whole = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
            return whole if "b" in mode else io.TextIOWrapper(whole, encoding, errors, newline)

        os.open = open_handle
        os.write = lambda handle, data: steps.write(lambda piece: put(handle, piece), data)
        builtins.open = io.open = open_file  # type: ignore[assignment]

    def _counted(self, real: Callable[..., Any], takes_space: bool) -> Callable[..., Any]:
        def step(*arguments: Any, **options: Any) -> Any:
            self.step(takes_space)
            return real(*arguments, **options)

        return step
