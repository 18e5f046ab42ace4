"""How long something may take, whatever else the machine does and whatever earlier tests left in memory."""

import gc
import time
from collections.abc import Iterator
from contextlib import contextmanager

# s of processor time that `_work` takes on an AMD EPYC (Zen 3) that does nothing else; a slower machine gets more time
_USUAL = 0.03


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Processor time of this thread alone, in s: no other thread, no collection of other tests' objects.

    The time is that of the machine of `_USUAL`. The speed of this one is measured before and behind; the slower counts.
    """
    collecting = gc.isenabled()
    gc.disable()
    before, started = _work(), time.thread_time()
    try:
        yield
        took = time.thread_time() - started
    finally:
        if collecting:
            gc.enable()
    took /= max(1.0, max(before, _work()) / _USUAL)
    assert took < seconds, f"{took:.2f} s of processor time, where {seconds:g} s are allowed"


def _work() -> float:
    """The processor time of a fixed number of steps of Python, s."""
    started, total = time.thread_time(), 0
    for k in range(400_000):
        total += k % 7
    return time.thread_time() - started
