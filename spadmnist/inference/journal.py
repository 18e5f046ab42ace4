"""The journal of a search: the replicates that it has simulated, on disk. The same search, begun again, goes on there.

A search that begins again asks for the same replicates in the same order. What the journal holds is read, the rest is
simulated: the answer is that of a search that was never stopped, bit for bit. The work of replicates that are read
counts as if they had been simulated, because the budget decides what is tried.
"""

from __future__ import annotations

import contextlib
import hashlib
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..sensor import Sensor
from . import replicate_cache
from .capture_replicates import CaptureReplicates
from .reduction import ReducedCapture

FOLDER = ".replicates"  # in the folder of a diagnosis, while it is not finished
# bytes of all entries, beyond which nothing is added, so that a search that goes on simulates more again: the quick
# diagnosis of the tutorial, of two steps, writes 0.3 GB. A rule of thumb
_MOST_BYTES = 2 << 30


class Journal:
    """The replicates of one search, by what they are a function of."""

    def __init__(self, folder: Path):
        """Open the journal in a folder, which need not be there yet."""
        self.folder = folder
        self.bytes = (
            sum(path.stat().st_size for path in folder.glob(f"*{replicate_cache.SUFFIX}")) if self._own() else 0
        )

    @staticmethod
    def name(
        sensors: Iterable[Sensor], seen: ReducedCapture, photons: np.ndarray, numbers: np.ndarray, *more: Any
    ) -> str | None:
        """The name of the replicates of a capture; None where they depend on code that no file holds.

        Args:
            sensors: one for all replicates, or one for each.
            photons: (replicates,) photons/s on a pixel.
            numbers: (replicates,) numbers that seed them.
            more: numbers and words that they depend on as well.
        """
        capture, second = seen.half_of or (seen.capture, None)
        digest = hashlib.sha256(np.asarray(photons, float).tobytes() + np.asarray(numbers, np.uint64).tobytes())
        for sensor in sensors:
            name = replicate_cache.entry_name(sensor, capture, second, seen.early, *more)
            if name is None:
                return None
            digest.update(name.encode())
        return digest.hexdigest()[:32]

    def recall(self, name: str | None) -> CaptureReplicates | None:
        """The replicates of this name; None where the journal has none that are intact."""
        return None if name is None else replicate_cache.read_entry(self.folder, name)

    def keep(self, name: str | None, made: CaptureReplicates) -> None:
        """Add replicates. An error of the disk is ignored: they are simulated again."""
        if name is None or self.bytes > _MOST_BYTES:
            return
        with contextlib.suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True)
            if self._own():
                self.bytes += replicate_cache.write_entry(self.folder, name, made)

    def remove(self) -> None:
        """Remove the journal: the search is finished."""
        if self._own():
            shutil.rmtree(self.folder, ignore_errors=True)

    def _own(self) -> bool:
        """Whether the folder is there, and no link."""
        return self.folder.is_dir() and not self.folder.is_symlink()
