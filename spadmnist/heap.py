"""What the C library does with memory that is freed."""

from __future__ import annotations

import contextlib
import ctypes

_MMAP_THRESHOLD, _TRIM_THRESHOLD, _TOP_PAD = -3, -1, -2  # as mallopt calls them


def keep_freed_memory() -> None:
    """Ask the C library to keep what is freed for what comes next instead of returning it to the system.

    Fresh pages cost more than the simulation that fills them. Only where the library is glibc.
    """
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(_MMAP_THRESHOLD, 1 << 25)  # at its largest
        libc.mallopt(_TRIM_THRESHOLD, 1 << 29)
        libc.mallopt(_TOP_PAD, 1 << 28)  # address space, of which pages are taken as they are needed
