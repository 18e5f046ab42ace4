"""Large arrays: more than 256 MB lie in a file without a name, and of it only what is looked at lies in memory.

The file is in the folder for temporary files (TMPDIR). The system removes it with the last array that it holds, however
the process ends. All arrays here are C-contiguous.
"""

from __future__ import annotations

import math
import mmap
import os
import tempfile
from collections.abc import Iterator
from typing import IO, Any

import numpy as np

from .errors import SpadError

IN_MEMORY = 1 << 28  # bytes of an array, from which on it lies in a file
_BLOCK = 1 << 25  # bytes that are looked at together: what is in memory of an array in a file
# numbers, of which numpy makes doubles together: a sum in blocks of whole ones is that of all at once, to the last bit
_CAST = 8192


def empty(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array of any content. Raises SpadError where the folder for temporary files has no room for it."""
    kind = np.dtype(dtype)
    size = math.prod(shape) * kind.itemsize
    if size <= IN_MEMORY:
        return np.empty(shape, kind)
    try:
        with tempfile.TemporaryFile(prefix="spadmnist-") as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)  # a file without room would end the process as it is filled
            else:
                file.truncate(size)
            held = mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise SpadError(
            f"{tempfile.gettempdir()}: there is no room for {size / 1e9:.2g} GB of images ({error.strerror}); free "
            "some, or set TMPDIR to a folder of a larger disk"
        ) from error
    return np.ndarray(shape, kind, held)


def release(array: np.ndarray) -> None:
    """Let go of the memory that an array in a file takes; its content stays. Nothing of other arrays."""
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)


def kept_low(array: np.ndarray, fresh: int) -> int:
    """Let go of an array's memory where more bytes of it are fresh than are looked at together; how many are then."""
    if fresh <= _BLOCK:
        return fresh
    release(array)
    return 0


def blocks(array: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """(number of the first, some of the array's items) one after the other; their memory is let go of after each."""
    step = max(1, _BLOCK // max(1, array[:1].nbytes))
    for start in range(0, len(array), step):
        yield start, array[start : start + step]
        release(array)


def filled(out: np.ndarray, stream: IO[bytes]) -> int:
    """Read into an array; how many bytes were there for it."""
    view, at = out.reshape(-1).view(np.uint8), 0
    while at < view.size:
        got = stream.readinto(view[at : at + _BLOCK].data)  # type: ignore[attr-defined]
        if not got:
            break
        at += got
        release(out)
    return at


def converted(array: np.ndarray, dtype: Any) -> np.ndarray:
    """The same numbers as another type, C-contiguous; the array itself where it is that already."""
    if array.nbytes <= IN_MEMORY:
        return np.ascontiguousarray(array, dtype)
    if array.dtype == dtype and array.flags.c_contiguous:
        return array
    out = empty(array.shape, dtype)
    for start, part in blocks(array):
        out[start : start + len(part)] = part
        release(out)
    return out


def copied(array: np.ndarray) -> np.ndarray:
    """A copy."""
    if array.nbytes <= IN_MEMORY:
        return array.copy()
    return repeated(array, 1)


def repeated(array: np.ndarray, times: int) -> np.ndarray:
    """Each item so many times, one after the other, as `np.repeat` has them."""
    if array.nbytes * times <= IN_MEMORY:
        return np.repeat(array, times, axis=0)
    out = empty((len(array) * times, *array.shape[1:]), array.dtype)
    for start, part in blocks(array):
        for i, item in enumerate(part, start):
            out[i * times : (i + 1) * times] = item
            release(out)
    return out


def mean(array: np.ndarray) -> float:
    """The mean of all numbers, as `array.mean(dtype=float)` has it, to the last bit."""
    if array.nbytes <= IN_MEMORY or not array.flags.c_contiguous:
        return float(array.mean(dtype=np.float64))
    flat, total = array.reshape(-1), 0.0
    step = max(1, _BLOCK // array.itemsize // _CAST) * _CAST
    for start in range(0, flat.size, step):
        total = float(np.add.reduce(flat[start : start + step], dtype=np.float64, initial=total))
        release(array)
    return total / flat.size


def range_of(array: np.ndarray) -> tuple[Any, Any]:
    """(the smallest number, the largest); not a number where one is none."""
    if array.nbytes <= IN_MEMORY:
        return array.min(), array.max()
    ends = [(part.min(), part.max()) for _, part in blocks(array)]
    return np.min([low for low, _ in ends]), np.max([high for _, high in ends])
