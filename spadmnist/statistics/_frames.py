"""What statistics of frames share: bits as words, common ones, first stamps, moments of the pixels, ones of the frames.

Frames are read once and kept in the form that the statistics take where that is small; otherwise they are read, and
brought into it, a piece at a time and every time anew.
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ..kernels import inline, jit
from ..recording import FirstStamps, Recording, StampedFrames

_MANY = 100.0  # counts for which whole numbers are no matter
_SMALL = 2**26  # bytes of a form of the frames, up to which it is kept with the recording


def _kept(recording: Recording, name: str, make: Callable[[], Iterator[tuple[int, Any]]]) -> Iterator[tuple[int, Any]]:
    """What `make` yields, which is kept if it turns out to be small."""
    known = recording._kept.get(name)
    if known is not None:
        yield from known  # type: ignore[misc]
        return
    held: list[tuple[int, Any]] = []
    size = 0
    for first, part in make():
        size += part.nbytes
        if size <= _SMALL:
            held.append((first, part))
        else:
            held.clear()
        yield first, part
    if size <= _SMALL:
        recording._kept[name] = held


def first_stamps(recording: Recording) -> Iterator[tuple[int, FirstStamps]]:
    """As `recording.stamped`: (number of the first frame, first stamps of some frames), but kept where it is small."""
    if isinstance(recording.frames, StampedFrames):
        return recording.stamped()
    return _kept(recording, "first stamps", recording.stamped)


def in_equal_times(counts: np.ndarray, waited: np.ndarray) -> np.ndarray:
    """Detections if all had waited as long as they do in the mean; few of them are whole numbers.

    They scatter like Poisson counts of their size. As if each had three detections' time more than it has: a handful in
    saturation is no normal variable, and so it weighs less.
    """
    usual, mean = float(waited.mean()), float(counts.mean())
    more = 3.0 * usual / max(mean, 1e-9)
    found = np.asarray(counts * ((usual + more) / (waited + more)))
    return found if mean >= _MANY else np.rint(found)


def bits(recording: Recording) -> Iterator[tuple[int, np.ndarray]]:
    """As `recording.bits`: (number of the first frame, (frames, rows, bytes) uint8), but kept where it is small."""
    if recording.modality == "qis":
        return recording.bits()
    return _kept(recording, "bits", lambda: _of_stamps(recording) if recording.modality == "str" else recording.bits())


def _of_stamps(recording: Recording) -> Iterator[tuple[int, np.ndarray]]:
    columns = recording.layout.columns
    for first, found in first_stamps(recording):
        out = np.zeros((len(found.offsets) - 1, recording.layout.rows, -(-columns // 8)), np.uint8)
        place = np.arange(recording.pixels, dtype=np.int32)
        row, column = np.divmod(place, columns)
        _set(
            found.offsets, found.pixels, row * out.shape[2] + column // 8, 128 >> column % 8, out.reshape(len(out), -1)
        )
        yield first, out


@jit
def _set(offsets, pixels, byte, bit, out):
    for f in range(out.shape[0]):
        for i in range(offsets[f], offsets[f + 1]):
            out[f, byte[pixels[i]]] |= np.uint8(bit[pixels[i]])


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
        # totals are those of the recording: its frames are read once for both
        totals = None if "totals" in recording._kept else np.zeros(recording.pixels, np.int64)
        if recording.modality == "counts":
            for first, part in recording.chunks():
                flat = part.reshape(len(part), -1)
                out[first : first + len(part)] = flat.sum(axis=1, dtype=np.int64)
                if totals is not None:
                    totals += flat.sum(axis=0, dtype=np.int64)
        else:
            for first, part in bits(recording):
                _ones(as_words(part), out[first : first + len(part)])
                if totals is not None:
                    add_pixels(part, recording.layout.columns, totals)
        recording._kept["frame_sums"] = out
        if totals is not None:
            recording._kept["totals"] = totals
    return recording._kept["frame_sums"]  # type: ignore[return-value]


def add_pixels(packed: np.ndarray, columns: int, out: np.ndarray) -> None:
    """Add to out (pixels,) int64 how often each pixel has a detection in packed frames (frames, rows, bytes)."""
    words = as_words(packed)
    sums = np.zeros((words.shape[1], 64), np.int64)
    pixel_sums(words, sums)
    out += by_pixel(sums, packed.shape[1:], columns)


def by_pixel(of_bits: np.ndarray, shape: tuple[int, ...], columns: int) -> np.ndarray:
    """(pixels,) of what belongs to the bits of words (words, 64), see `as_words`; shape: rows, bytes of a frame."""
    rows, width = shape
    by_byte = of_bits.reshape(-1, 8)[: rows * width, ::-1]  # the first pixel of a byte is its highest bit
    return by_byte.reshape(rows, 8 * width)[:, :columns].ravel()


@jit
def pixel_sums(words, sums):
    """Add to sums (words, 64) how often each bit is set, from the lowest to the highest."""
    frames, size = words.shape
    each = np.uint64(0x0101010101010101)
    held = np.zeros((8, size), np.uint64)  # eight counters of a byte each in one word
    for first in range(0, frames, 255):
        held[:] = np.uint64(0)
        for f in range(first, min(first + 255, frames)):
            for bit in range(8):
                for w in range(size):
                    held[bit, w] += (words[f, w] >> np.uint64(bit)) & each
        for w in range(size):
            for byte in range(8):
                for bit in range(8):
                    sums[w, 8 * byte + bit] += np.int64((held[bit, w] >> np.uint64(8 * byte)) & np.uint64(255))


@jit
def _ones(words, out):
    for f in range(words.shape[0]):
        out[f] = count_ones(words[f], words[f])
