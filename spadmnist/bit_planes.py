"""Loops over bit planes: binary frames, eight to a byte, pixel by pixel or frame by frame, and their stamps."""

# mypy: disable-error-code="no-untyped-def"
# numba takes the types from the calls; the docstrings give them.

from __future__ import annotations

import numpy as np

from .compiled import kernel

_jit = kernel(error_model="numpy", nogil=True)

_SIDE_BY_SIDE = 4096  # pixels whose bits are turned over together: their lines stay in the cache


@_jit
def sums_of_frames(bits, each, out):
    """Add up `each` binary frames after the other: out (rows, count frames) from bits (rows, bytes), high bit first."""
    for row in range(out.shape[0]):
        frame = 0
        for m in range(out.shape[1]):
            total = 0
            for _ in range(each):
                total += (bits[row, frame >> 3] >> (7 - (frame & 7))) & 1
                frame += 1
            out[row, m] = total


@_jit
def add_waits(offsets, stamps, pixels, first, last, of_pixels, of_frames):
    """Add to of_pixels (pixels,) and of_frames (frames,) how long first detections were waited for.

    offsets, stamps, pixels: see `recording.FirstStamps`. In the time from the tick `first` to the end of `last`, a
    stamp being the middle of its tick.
    """
    unit = 1.0 / (last - first + 1)
    frames = of_frames.size
    waited = np.ones((4, of_pixels.size))
    for start in range(0, frames, 4):
        some = min(4, frames - start)
        for k in range(some):
            for i in range(offsets[start + k], offsets[start + k + 1]):
                waited[k, pixels[i]] = (np.int64(stamps[i]) - first + 0.5) * unit
        if some == 4:
            # four sums that do not wait for each other
            a, b, c, d = 0.0, 0.0, 0.0, 0.0
            for p in range(of_pixels.size):
                a += waited[0, p]
                b += waited[1, p]
                c += waited[2, p]
                d += waited[3, p]
                of_pixels[p] = (((of_pixels[p] + waited[0, p]) + waited[1, p]) + waited[2, p]) + waited[3, p]
            of_frames[start] += a
            of_frames[start + 1] += b
            of_frames[start + 2] += c
            of_frames[start + 3] += d
        else:
            for k in range(some):
                total = 0.0
                for p in range(of_pixels.size):
                    total += waited[k, p]
                    of_pixels[p] += waited[k, p]
                of_frames[start + k] += total
        for k in range(some):
            for i in range(offsets[start + k], offsets[start + k + 1]):
                waited[k, pixels[i]] = 1.0


@_jit
def column_sums(packed, columns, out):
    """Add to out (rows * columns,) how often each pixel has a detection.

    packed: (frames, rows, ceil(columns / 8)) uint8, most significant bit first.
    """
    frames, rows, width = packed.shape
    # eight counters of a byte each in one word: 255 frames before one could overflow
    spread = np.empty(256, np.uint64)
    for byte in range(256):
        word = np.uint64(0)
        for bit in range(8):
            word |= np.uint64((byte >> (7 - bit)) & 1) << np.uint64(8 * bit)
        spread[byte] = word
    word = np.empty(width, np.uint64)
    for row in range(rows):
        for start in range(0, frames, 255):
            word[:] = np.uint64(0)
            for f in range(start, min(frames, start + 255)):
                for j in range(width):
                    word[j] += spread[packed[f, row, j]]
            for column in range(columns):
                shift = np.uint64(8 * (column & 7))
                out[row * columns + column] += np.int64((word[column >> 3] >> shift) & np.uint64(255))


@_jit
def frames_first(bits, frames, rows, columns):
    """Turn bits pixel by pixel (rows * columns, ceil(frames / 8)) into frames (frames, rows, ceil(columns / 8))."""
    width = (columns + 7) // 8
    out = np.zeros((frames, rows, width), np.uint8)
    for row in range(rows):
        for j in range(width):
            # 8 pixels x 8 frames at a time: a block of 64 bits turned over
            for byte in range(bits.shape[1]):
                block = np.uint64(0)
                for p in range(8):
                    column = 8 * j + p
                    if column < columns:
                        block |= np.uint64(bits[row * columns + column, byte]) << np.uint64(56 - 8 * p)
                if block:
                    t = (block ^ (block >> np.uint64(7))) & np.uint64(0x00AA00AA00AA00AA)
                    block ^= t ^ (t << np.uint64(7))
                    t = (block ^ (block >> np.uint64(14))) & np.uint64(0x0000CCCC0000CCCC)
                    block ^= t ^ (t << np.uint64(14))
                    t = (block ^ (block >> np.uint64(28))) & np.uint64(0x00000000F0F0F0F0)
                    block ^= t ^ (t << np.uint64(28))
                    for f in range(min(8, frames - 8 * byte)):
                        out[8 * byte + f, row, j] = np.uint8((block >> np.uint64(56 - 8 * f)) & np.uint64(255))
    return out


@_jit
def stamps_by_frame(bits, offsets, ticks, frames):
    """Put stamps, pixel by pixel one for each bit set, in the order of their frames.

    bits: (pixels, bytes), most significant first; offsets: (pixels + 1,) into ticks.
    Returns (offsets (frames + 1,), stamps (stamps,) uint32, pixels (stamps,) int32), those of a frame in their order.
    """
    pixels, width = bits.shape
    ones = np.zeros(256, np.uint64)  # how many bits of a byte are set, and which ones
    which = np.zeros((256, 8), np.uint64)
    for byte in range(256):
        for bit in range(8):
            if (byte >> (7 - bit)) & 1:
                which[byte, ones[byte]] = bit
                ones[byte] += np.uint64(1)
    place = np.zeros(8 * width + 1, np.int64)
    for p in range(pixels):
        for byte in range(width):
            if bits[p, byte]:
                for bit in range(8):
                    place[8 * byte + bit + 1] += (bits[p, byte] >> (7 - bit)) & 1
    for f in range(8 * width):
        place[f + 1] += place[f]
    begins = place[: frames + 1].copy()
    stamps = np.empty(ticks.size, np.uint32)
    whose = np.empty(ticks.size, np.int32)
    frame = np.empty(8 * width + 8, np.uint64)
    for p in range(pixels):
        found = np.uint64(0)
        for byte in range(np.uint64(width)):
            value = bits[p, byte]
            if value:
                for k in range(np.uint64(8)):  # what is too much will be overwritten
                    frame[found + k] = np.uint64(8) * byte + which[value, k]
                found += ones[value]
        begin = np.uint64(offsets[p])
        for k in range(found):
            at = np.uint64(place[frame[k]])
            stamps[at] = ticks[begin + k]
            whose[at] = p
            place[frame[k]] += 1
    return begins, stamps, whose


@_jit
def stamps_of_frames(frames, none):
    """The first stamps of frames (frames, pixels), `none` and above where there is no detection.

    Returns (offsets (frames + 1,), stamps (stamps,) of the type of the frames, pixels (stamps,) int32).
    """
    offsets = np.zeros(frames.shape[0] + 1, np.int64)
    for f in range(frames.shape[0]):
        number = np.int64(0)
        for p in range(frames.shape[1]):
            number += frames[f, p] < none
        offsets[f + 1] = offsets[f] + number
    total = offsets[frames.shape[0]]
    # one more, which what is no stamp may write over
    stamps = np.empty(total + 1, frames.dtype)
    pixels = np.empty(total + 1, np.int32)
    for f in range(frames.shape[0]):
        k = offsets[f]
        if k == offsets[f + 1]:
            continue
        for p in range(frames.shape[1]):
            stamps[k] = frames[f, p]
            pixels[k] = p
            k += frames[f, p] < none
    return offsets, stamps[:total], pixels[:total]


@_jit
def fill_stamps(offsets, stamps, pixels, out):
    """Put first stamps, frame by frame, to their pixels: out (frames, pixels)."""
    for f in range(out.shape[0]):
        for i in range(offsets[f], offsets[f + 1]):
            out[f, pixels[i]] = stamps[i]


@_jit
def bits_first(bits, out):
    """Turn bits pixel by pixel (pixels, bytes), high bit first, into frames: out (frames, pixels) of 0 and 1."""
    frames, pixels = out.shape
    eights = np.empty(min(pixels, _SIDE_BY_SIDE), np.uint8)
    for first in range(0, pixels, eights.size):
        count = np.uint64(min(eights.size, pixels - first))
        for byte in range(bits.shape[1]):
            for p in range(count):
                eights[p] = bits[np.uint64(first) + p, byte]
            for frame in range(8 * byte, min(8 * byte + 8, frames)):
                row, shift = out[frame, first:], np.uint8(7 - (frame & 7))
                for p in range(count):
                    row[p] = (eights[p] >> shift) & np.uint8(1)


@_jit
def stamps_first(bits, offsets, stamps, out):
    """Put stamps pixel by pixel, one for each bit set, into frames: out (frames, pixels); all else in it stays.

    bits: (pixels, bytes), high bit first; offsets: (pixels + 1,) into stamps.
    """
    frames, pixels = out.shape
    place = offsets[:-1].copy()
    most = stamps.size - 1
    # some pixels at a time, which share their lines of the cache
    for first in range(0, pixels, 16):
        for byte in range(bits.shape[1]):
            for p in range(np.uint64(first), np.uint64(min(first + 16, pixels))):
                eight = np.uint64(bits[p, byte])
                if eight == 0:
                    continue
                k = place[p]
                # every place is written, for whether a bit is set is hard to foresee
                for bit in range(min(8, frames - 8 * byte)):
                    one = np.int64((eight >> np.uint64(7 - bit)) & np.uint64(1))
                    frame, stamp = np.uint64(8 * byte + bit), stamps[np.uint64(min(k, most))]
                    before = out[frame, p]
                    out[frame, p] = stamp if one else before
                    k += one
                place[p] = k
