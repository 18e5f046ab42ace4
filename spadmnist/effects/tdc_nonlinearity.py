"""Unequal codes of the time-to-digital converter."""

from __future__ import annotations

import numpy as np

from .. import kernels
from ..events import Events
from . import Chip, Effect, parameter


class TdcNonlinearity(Effect, stage="timing"):
    """The codes of the converter have unequal widths; a code of width 0 is missing.

    A code collects the times within its own width. Widths are in ticks and repeat with the coarse clock. The coarse
    clock is exact, so the widths of each pixel are scaled to add up to their number. The effect moves the time of a
    stamp just before the converter, the same under both rules; only the code is meaningful, not the time between two
    codes.
    Source: code densities of LinoSPAD2 boards (Kulkov, daplis: rms 0.8-0.9 ticks, 13-27 missing codes of 140); in-pixel
    converters 2 % (Villa et al. 2014).
    """

    counted = True
    after = "jitter"
    moves = ("phase", "edge")

    widths = parameter(
        1.0,
        "",
        "width of each code, ticks; 0: a missing code",
        symbol="w_k",
        bounds=(0, None),
        off=1.0,
        search=(0, 6),
        per="code",
    )
    period = parameter(140.0, "", "number of codes in a period of the coarse clock", bounds=(1, 1 << 24))

    def made(self, chip: Chip) -> None:
        if self.period != int(self.period):
            raise ValueError(f"period is a whole number of codes, not {self.period:g}")
        widths = np.atleast_2d(np.asarray(self.widths, np.float64))
        self._tick, self._origin = chip.tick, chip.origin
        self._equal = widths.min() == widths.max() > 0
        if self._equal:
            return
        if chip.tick == 0:
            raise ValueError("unequal codes need an effect that makes ticks (tdc, with a resolution of more than 0 s)")
        if not (np.all(widths >= 0) and np.all(np.isfinite(widths)) and len(widths) in (1, chip.layout.pixels)):
            raise ValueError(f"widths are one row, or one for each of {chip.layout.pixels} pixels, none negative")
        edges = np.pad(np.cumsum(widths, axis=1), ((0, 0), (1, 0)))
        total = edges[:, -1:]
        for pixel in np.flatnonzero(total == 0)[:1]:
            whose = f"of pixel {pixel} " if len(widths) > 1 else ""
            raise ValueError(f"the widths {whose}are all 0; a converter needs a code that is longer")
        codes = widths.shape[1]
        # exactly `codes` at the end, and no missing code gets a width by rounding
        self._edges = np.where(edges == total, codes, np.minimum(edges * (codes / total), codes))
        with np.errstate(divide="ignore"):
            self._per_width = np.where(widths > 0, 1 / np.diff(self._edges), 0.0)
        starts = np.arange(codes * _FINE) / _FINE
        self._first = np.stack([np.searchsorted(row, starts, side="right") - 1 for row in self._edges]).astype(np.int32)

    def apply(self, events: Events, rng: object) -> Events:
        if self._equal:
            return events
        rows = len(events.offsets) - 1
        pixel = np.arange(rows) % events.pixels if events.row_pixel is None else events.row_pixel
        table = pixel if len(self._edges) > 1 else np.zeros(rows, np.int64)
        return events.moved(
            _in_codes(
                events.times,
                events.offsets,
                table,
                self._tick,
                self._origin,
                self._edges,
                self._per_width,
                self._first,
            )
        )


_FINE = 4  # places in a tick from which the search for a code may start
_EDGE = 1e-6  # how near a moved time comes to its code's edges, ticks


@kernels.jit
def _in_codes(times, offsets, table, tick, origin, edges, per_width, first):  # type: ignore[no-untyped-def]
    """Times at which a converter with equal codes shows what one with these `edges` shows at `times`.

    table: (rows,) the row of `edges` (tables, codes + 1), `per_width` and `first` that a row of events takes.
    """
    out = np.empty(times.size)
    codes = edges.shape[1] - 1
    for row in range(offsets.size - 1):
        which = table[row]
        for i in range(np.uint64(offsets[row]), np.uint64(offsets[row + 1])):
            x = times[i] / tick - origin
            # the quotient of a double below a multiple of `codes` is never rounded up to a whole number
            turn = np.floor(x / codes) * codes
            phase = x - turn
            k = first[which, int(phase * _FINE)]
            while edges[which, k + 1] <= phase:
                k += 1
            within = (phase - edges[which, k]) * per_width[which, k]
            # late in a long exposure a double is coarser than the margin
            margin = min(_EDGE + x * 2.0**-50, 0.5)
            out[i] = (turn + k + min(max(within, margin), 1.0 - margin) + origin) * tick
    return out
