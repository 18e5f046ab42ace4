"""How long something may take, whatever else the machine does and whatever earlier tests left in memory."""

import gc
import time
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Processor time of this thread alone, in s: no other thread, no collection of other tests' objects."""
    collecting = gc.isenabled()
    gc.disable()
    started = time.thread_time()
    try:
        yield
        took = time.thread_time() - started
    finally:
        if collecting:
            gc.enable()
    assert took < seconds, f"{took:.2f} s of processor time, where {seconds:g} s are allowed"
