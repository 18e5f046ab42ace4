"""Threads and processes: whether the system lets the program have as many as it needs."""

from __future__ import annotations

import errno
import os

from ..system import address_space, processors

ALONE = (
    "the system lets this program have no further thread or process (it counts all of this user's); end other "
    "programs, raise the limits (ulimit -u, ulimit -v), or give fewer --jobs"
)
_LEAST_SPACE = 600  # MB of addresses that numpy, scipy and numba take before anything is simulated
_OWN_THREADS = 3  # to speak to workers, to write, to tell that time passes
_MOST_THREADS = 64  # of numpy's linear algebra, and again of scipy's, as they are built


def is_alone(error: BaseException | None) -> bool:
    """Whether the system refused a thread (which Python reports by its message alone) or a process."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.EAGAIN, errno.ENOMEM) and error.filename is None:
            return True
        if isinstance(error, RuntimeError) and "can't start new thread" in str(error):
            return True
        error = error.__context__
    return False


def check() -> None:
    """Refuse limits under which numpy cannot be imported: it waits for ever, or ends the program as Ctrl-C would."""
    import threading

    from ..errors import SpadError

    space = address_space()
    if space is not None and space < _LEAST_SPACE * 1_000_000:
        raise SpadError(
            f"only {space / 1e6:.0f} MB of addresses are allowed (ulimit -v), and the program needs {_LEAST_SPACE} MB "
            "to begin with; raise that limit"
        )
    told = [os.environ.get(name, "") for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")]
    each = min(processors(), _MOST_THREADS, *(int(text) for text in told if text.isdecimal() and int(text) > 0))
    end = threading.Event()
    started = []
    try:
        for _ in range(2 * (each - 1) + _OWN_THREADS):
            thread = threading.Thread(target=end.wait, daemon=True)
            thread.start()
            started.append(thread)
    finally:
        end.set()
        for thread in started:
            thread.join()
