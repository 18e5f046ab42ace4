"""Time-to-digital converter."""

from __future__ import annotations

import numpy as np

from .. import kernels
from ..events import Events
from . import Effect, parameter


class Tdc(Effect, stage="timing"):
    """Time stamps are whole ticks of the converter: each is rounded to the nearest multiple of the resolution.

    Source: Suonsivu et al., Alg. 1 lines 30-32; typical 5-100 ps (Table 1).
    """

    counted = True
    last = True  # whatever else happens to a time stamp happens before it becomes a number

    resolution = parameter(
        10e-12,
        "s",
        "length of a tick; 0 s: not rounded",
        symbol="dt",
        bounds=(0, None),
        off=0.0,
        search=(1e-12, 1e-8),
    )

    def apply(self, events: Events, rng: object) -> Events:
        if self.resolution == 0:
            return events
        ticks = np.empty(len(events), np.uint64)
        kernels.nearest_ticks(events.times, self.resolution, ticks)
        return Events(None, events.offsets, events.pixels, ticks, float(self.resolution))
