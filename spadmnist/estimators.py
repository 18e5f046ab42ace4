"""Loops of the flux estimators, one pixel of one image after the other."""

# mypy: disable-error-code="no-untyped-def"
# numba takes the types from the calls; the docstrings give them.

from __future__ import annotations

import numpy as np

from .compiled import kernel

_jit = kernel(error_model="numpy", nogil=True)


@_jit
def spans(times, offsets):
    """(counts (rows,) int32, last minus first entry of each row (rows,) float64; 0 where there are fewer than two)."""
    rows = offsets.size - 1
    counts = np.zeros(rows, np.int32)
    span = np.zeros(rows)
    for row in range(rows):
        n = offsets[row + 1] - offsets[row]
        counts[row] = n
        if n > 1:
            span[row] = times[offsets[row + 1] - 1] - times[offsets[row]]
    return counts, span


@_jit
def lookup(table, indices):
    """`table[indices]`; every index is known to lie inside."""
    out = np.empty(indices.size, table.dtype)
    for i in range(np.uint64(indices.size)):
        out[i] = table[np.uint64(indices[i])]
    return out


@_jit
def inter_photon(counts, span, pdp, dead_time, half_tick):
    """Flux (1/s) of each row from its detections and the time between first and last (s); paper, eq. 4c.

    Returns (float64 fluxes, rows whose live time was taken as `half_tick` per interval).
    """
    out = np.zeros(counts.size)
    bounded = 0
    for i in range(np.uint64(counts.size)):
        if counts[i] >= 2:
            intervals = np.float64(counts[i]) - 1.0
            live = span[i] - intervals * dead_time
            least = intervals * half_tick
            if live < least:
                live = least
                bounded += 1
            out[i] = intervals / (pdp * live)
    return out, bounded


@_jit
def first_photon(ones, waited, pdp, least):
    """Flux (1/s) of each row from its frames with a detection and the time waited (s); paper, eq. 5.

    Returns (float64 fluxes, rows whose waiting time of 0 was taken as `least`).
    """
    out = np.zeros(ones.size)
    bounded = 0
    for i in range(np.uint64(ones.size)):
        if ones[i] > 0:
            time = waited[i]
            if time <= 0.0:
                time = least
                bounded += 1
            out[i] = ones[i] / (pdp * time)
    return out, bounded
