"""Loops that pack ragged columns and bits for the disk, and unpack them."""

# mypy: disable-error-code="no-untyped-def"
# numba takes the types from the calls; the docstrings give them.

from __future__ import annotations

import numpy as np

from .compiled import kernel

_jit = kernel(error_model="numpy", nogil=True)


@_jit
def row_differences(values, offsets):
    """Each entry minus the one before it in its row; the first of a row as it is. The same type."""
    out = np.empty_like(values)
    for i in range(np.uint64(1), np.uint64(values.size)):
        out[i] = values[i] - values[i - np.uint64(1)]
    for row in range(np.uint64(offsets.size - 1)):
        start = np.uint64(offsets[row])
        if start < np.uint64(offsets[row + np.uint64(1)]):
            out[start] = values[start]
    return out


@_jit
def row_sums(differences, offsets):
    """The inverse of `row_differences`."""
    out = np.empty_like(differences)
    for row in range(offsets.size - 1):
        start = offsets[row]
        stop = offsets[row + 1]
        if stop > start:
            out[start] = differences[start]
            for i in range(start + 1, stop):
                out[i] = out[i - 1] + differences[i]
    return out


@_jit
def pack_rows(bits, width, rows):
    """Put rows of `width` bits next to each other, without the padding to whole bytes at the end of each.

    bits: (n * rows, ceil(width / 8)) uint8, most significant bit first, padding 0.
    Returns (n, ceil(rows * width / 8)) uint8.
    """
    n, each = bits.shape[0] // rows, np.uint64(bits.shape[1])
    size = np.uint64((rows * width + 7) // 8)
    out = np.zeros((n, size), np.uint8)
    for i in range(n):
        line = out[i]
        for r in range(rows):
            row = bits[i * rows + r]
            any_bit = np.uint8(0)
            for j in range(each):
                any_bit |= row[j]
            if not any_bit:
                continue
            start = np.uint64(r * width) >> np.uint64(3)
            right = np.uint8(r * width & 7)
            left = np.uint8(8 - right)
            line[start] |= row[0] >> right
            for j in range(np.uint64(1), each):
                line[start + j] = (row[j - np.uint64(1)] << left) | (row[j] >> right)
            if start + each < size:  # behind the end of the line there is padding alone
                line[start + each] = row[each - np.uint64(1)] << left
    return out


@_jit
def unpack_rows(packed, width, rows):
    """The inverse of `pack_rows`."""
    n, size = packed.shape
    bytes_per_row = (width + 7) // 8
    out = np.zeros((n * rows, bytes_per_row), np.uint8)
    last = np.uint32((255 << (8 * bytes_per_row - width)) & 255)
    for i in range(n):
        for r in range(rows):
            for j in range(bytes_per_row):
                place = r * width + 8 * j
                shift = np.uint32(place & 7)
                first = place >> 3
                word = np.uint32(packed[i, first]) << np.uint32(8)
                if first + 1 < size:
                    word |= np.uint32(packed[i, first + 1])
                out[i * rows + r, j] = (word >> (np.uint32(8) - shift)) & np.uint32(255)
            out[i * rows + r, bytes_per_row - 1] &= last
    return out
