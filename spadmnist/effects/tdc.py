"""Time-to-digital converter."""

from __future__ import annotations

import numpy as np

from .. import kernels
from ..events import Events
from . import Effect, parameter


class Tdc(Effect, stage="timing"):
    """Time stamps are rounded to whole ticks of the converter.

    `nearest` rounds to the nearest multiple of the resolution, as in the paper. `floor` rounds down, as a counter of
    ticks does: floor(time / resolution) in double precision.
    Source: Suonsivu et al., Alg. 1 lines 30-32; typical 5-100 ps (Table 1).
    """

    by_pixel = True
    counted = True
    last = True  # whatever else happens to a time stamp happens before it becomes a number
    moves = ("phase", "edge", "ceiling")

    resolution = parameter(
        10e-12,
        "s",
        "length of a tick; 0 s: no rounding",
        symbol="dt",
        bounds=(0, None),
        off=0.0,
        search=(1e-12, 1e-8),
        kind="multiple",  # stamps are whole ticks of the file: those of a coarser clock are whole multiples of them
    )
    rounding = parameter("nearest", "", "rounding to the nearest tick, or down", choices=("nearest", "floor"))

    def converter(self) -> tuple[float, float]:
        """(s, length of a tick; where stamp k begins, in ticks from k)."""
        return float(self.resolution), 0.0 if self.rounding == "floor" else -0.5

    def apply(self, events: Events, rng: object) -> Events:
        if self.resolution == 0:
            return events
        ticks = np.empty(len(events), np.uint64)
        convert = _whole_ticks if self.rounding == "floor" else kernels.nearest_ticks
        convert(events.times, self.resolution, ticks)
        return events.stamped(ticks, float(self.resolution))


@kernels.jit
def _whole_ticks(times, tick, out):  # type: ignore[no-untyped-def]
    """Round down to a multiple of the tick."""
    for i in range(times.size):
        out[i] = kernels._nearest(np.floor(times[i] / tick))
