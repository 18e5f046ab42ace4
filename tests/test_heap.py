"""Freed memory is kept: fresh pages cost more than what fills them."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

SCRIPT = """
import resource, sys
import numpy as np
from spadmnist.heap import keep_freed_memory
if sys.argv[1] == "kept":
    keep_freed_memory()
def some():
    return [np.ones(3_000_000) for _ in range(4)]  # 24 MB each
some()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    some()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_pages_are_taken_once() -> None:
    """Five times 96 MB are 117,000 pages of 4 kB, less where the system gives larger ones."""
    faults = {}
    for how in ("kept", "usual"):
        told = subprocess.run([sys.executable, "-c", SCRIPT, how], capture_output=True, text=True, check=True)
        faults[how] = int(told.stdout)
    assert faults["kept"] < 100 and faults["usual"] > 5 * max(faults["kept"], 1)
