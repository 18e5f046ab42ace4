"""What statistics of frames share: bits as words, common ones, moments of the pixels, ones of the frames."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from ..kernels import inline, jit
from ..recording import Recording


def as_words(packed: np.ndarray) -> np.ndarray:
    """(frames, words) uint64 with the bits of packed frames (frames, rows, bytes), in any order, and zeros behind."""
    flat = packed.reshape(len(packed), -1)
    short = -flat.shape[1] % 8
    if short:
        flat = np.pad(flat, ((0, 0), (0, short)))
    return np.ascontiguousarray(flat).view(np.uint64)


@inline
def ones_of(word):
    """How many bits of a word are set."""
    # written as compilers know it: they make one instruction of it
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


@jit
def count_ones(a, b):
    """How many bits are set in both of two arrays of words."""
    total = np.uint64(0)
    for i in range(a.size):
        total += ones_of(a[i] & b[i])
    return np.int64(total)


def moments(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(detections, sum of squared counts, variance of a frame's count) of each pixel (pixels,), of all frames."""
    n = recording.totals.astype(np.float64)
    squares = n if recording.modality != "counts" else _squares(recording)
    frames = recording.n_frames
    return n, squares, np.maximum(squares - n**2 / frames, 0.0) / max(1, frames - 1)


def _squares(recording: Recording) -> np.ndarray:
    if "squares" not in recording._kept:
        out = np.zeros(recording.pixels)
        for _, part in recording.chunks():
            flat = part.reshape(len(part), -1)
            out += np.einsum("fp,fp->p", flat, flat, dtype=np.int64)
        recording._kept["squares"] = out
    return recording._kept["squares"]  # type: ignore[return-value]


def some_frames(recording: Recording, start: int, stop: int) -> np.ndarray:
    """(frames, pixels) counts of the frames from `start` to `stop`, 0 or 1 where they are bits."""
    assert recording.frames is not None
    part = np.asarray(recording.frames[start:stop])
    if recording.modality == "qis":
        part = np.unpackbits(part, axis=2, count=recording.layout.columns)
    elif recording.modality == "str":
        part = part < recording.none
    return part.reshape(len(part), -1)


def at_ends(recording: Recording, weights: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Weighted sums (number,) of the first frames, and of the last ones beginning with the very last."""
    frames = recording.n_frames
    first, last = np.empty(number), np.empty(number)
    for k in range(0, number, 16):
        stop = min(k + 16, number)
        first[k:stop] = some_frames(recording, k, stop).astype(np.float64) @ weights
        last[k:stop] = (some_frames(recording, frames - stop, frames - k).astype(np.float64) @ weights)[::-1]
    return first, last


def frame_sums(recording: Recording) -> np.ndarray:
    """(frames,) int64 detections of the whole array in each frame."""
    if "frame_sums" not in recording._kept:
        out = np.empty(recording.n_frames, np.int64)
        if recording.modality == "counts":
            for first, part in recording.chunks():
                out[first : first + len(part)] = part.reshape(len(part), -1).sum(axis=1, dtype=np.int64)
        else:
            for first, part in recording.bits():
                _ones(as_words(part), out[first : first + len(part)])
        recording._kept["frame_sums"] = out
    return recording._kept["frame_sums"]  # type: ignore[return-value]


@jit
def _ones(words, out):
    for f in range(words.shape[0]):
        out[f] = count_ones(words[f], words[f])
