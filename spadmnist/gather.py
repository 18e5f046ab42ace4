"""Images in any order, out of data that are read in ranges."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .events import Events
from .readout import Frames

# images of a block, of which all from the first to the last that is wanted are read in one range, and no more: a chunk
# holds 32, and what lies between them is unpacked with it anyway
BLOCK = 32

_CHOSEN_BY = "images are chosen by a number, a slice, a list or array of numbers, or a mask"


def indices_of(index: Any, length: int) -> int | range | np.ndarray:
    """What an index means among `length` images: a number, a range (of a slice), or (n,) int64 (of several numbers).

    Several are a list, or an array or tensor of one axis.
    Negative numbers count from the end; a mask is (length,) bool. Raises IndexError with a sentence.
    """
    if isinstance(index, slice):
        return range(*index.indices(length))
    if isinstance(index, range):
        index = np.arange(index.start, index.stop, index.step)
    if not isinstance(index, Sequence | np.ndarray) and hasattr(index, "__index__") and not getattr(index, "ndim", 0):
        try:
            one = operator.index(index)
        except TypeError:  # a tensor of one number that is not whole
            raise IndexError(_CHOSEN_BY) from None
        if not -length <= one < length:
            raise IndexError(f"image {one} was asked for; there are {length}")
        return one % length
    try:
        found = np.asarray(index)
    except (TypeError, ValueError):  # a ragged list, or a tensor that lies elsewhere than in memory
        raise IndexError(_CHOSEN_BY) from None
    if found.ndim == 0 and found.dtype.kind in "iu":
        return indices_of(int(found), length)
    if found.ndim == 1 and found.dtype == bool:
        if len(found) != length:
            raise IndexError(f"a mask of {len(found)} was given for {length} images; give one value for each")
        return np.flatnonzero(found)
    if found.ndim != 1 or (len(found) and found.dtype.kind not in "iu"):
        raise IndexError(_CHOSEN_BY)
    outside = found[(found < -length) | (found >= length)]
    if len(outside):
        raise IndexError(f"image {outside[0]} was asked for; there are {length}")
    found = found.astype(np.int64)  # only now: the largest of uint64 would be the last image
    return np.where(found < 0, found + length, found)


def gather(get: Callable[[int, int], Any], indices: np.ndarray, block: int = BLOCK) -> Any:
    """The images `indices`, in that order, of what `get(start, stop)` reads: arrays by image, `Events` or `Frames`.

    Each image is read once, and neighbours in one range. What nobody wants is read only where it lies between two that
    are wanted in a block of so many images, and thrown away block by block.
    """
    if not len(indices):
        return get(0, 0)
    wanted, back = np.unique(indices, return_inverse=True)
    parts = []
    apart = (np.diff(wanted) > 1) & (np.diff(wanted // block) > 0)
    for run in np.split(wanted, np.flatnonzero(apart) + 1):
        first, stop = int(run[0]), int(run[-1]) + 1
        piece = get(first, stop)
        parts.append(piece if len(run) == stop - first else take(piece, run - first))
    found = join(parts)
    return found if np.array_equal(back, np.arange(len(wanted))) else take(found, back)


def take(value: Any, images: np.ndarray) -> Any:
    """Some images of a batch, in any order, repeated or not."""
    return value.take(images) if isinstance(value, Events | Frames) else value[images]


def join(parts: Sequence[Any]) -> Any:
    """Several batches, one after the other."""
    if len(parts) == 1:
        return parts[0]
    if isinstance(parts[0], Events | Frames):
        return type(parts[0]).join(list(parts))
    return np.concatenate(parts)
