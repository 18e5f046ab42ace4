"""Decoded chunks of which a part was wanted: the last ones of this process. One image is a part of its chunks."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Hashable

import numpy as np

SMALL = 1 << 16  # bytes of a chunk: the counts of 32 images of MNIST have 49 kB
_MOST = 32 << 20  # bytes of small chunks: of 20,000 such images
_MOST_LARGE = 8 << 20  # bytes of others; images that are read in turn share the last one


class Recent:
    """Arrays by key, up to so many bytes; the one that was not asked for the longest goes first."""

    def __init__(self, most: int):
        self._most = most
        self.forget()
        if hasattr(os, "register_at_fork"):  # a lock that another thread held would stay held
            os.register_at_fork(after_in_child=self.forget)

    def forget(self) -> None:
        """Let go of all."""
        self._lock, self._held, self._bytes = threading.Lock(), OrderedDict[Hashable, np.ndarray](), 0

    def find(self, key: Hashable) -> np.ndarray | None:
        """The array of a key, or None. It is not to be written to."""
        with self._lock:
            found = self._held.get(key)
            if found is not None:
                self._held.move_to_end(key)
            return found

    def keep(self, key: Hashable, array: np.ndarray) -> None:
        """Hold an array, unless it is larger than all that may be held."""
        if array.nbytes > self._most:
            return
        array.flags.writeable = False
        with self._lock:
            before = self._held.pop(key, None)
            self._bytes += array.nbytes - (0 if before is None else before.nbytes)
            self._held[key] = array
            while self._bytes > self._most:
                self._bytes -= self._held.popitem(last=False)[1].nbytes


_small, _large = Recent(_MOST), Recent(_MOST_LARGE)  # apart, for large ones would leave no room to small ones


def of_size(size: int) -> Recent:
    """Where chunks of so many bytes are held."""
    return _small if size <= SMALL else _large
