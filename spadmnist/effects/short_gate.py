"""A gate that is shorter than the frame."""

from __future__ import annotations

import numpy as np

from .. import kernels
from . import Conditions, Effect, parameter


class ShortGate(Effect, stage="gate"):
    """The pixel is live during a part of each frame only.

    It is live while offset <= t < offset + fraction * frame time, where t is the time since the frame began. The part
    of the gate beyond the end of the frame is lost. The gate acts under both rules and on TR streams as well, whose
    clock has the same frames; without frames the exposure is one frame. With fraction 1 and offset 0 there is no gate:
    TR streams are live between frames as well. All rates, dark count rates included, are
    multiplied by the live share.
    Source: gates open and close late, 0.25-0.34 ns from pixel to pixel in SwissSPAD2 (Ulku et al. 2019), shortest gate
    5.75 ns; for a fixed error, 0.2-20 ns a frame by experience, no published number.
    """

    by_pixel = True
    moves = (
        "first",
        "spectrum",
        "level",
        "dark_level",
        "ceiling",
        "intervals",
        "edge",
        "far_pairs",
        "neighbours",
        "frames_lag",
        "linearity",  # where little of a frame is left, the dead time is a larger part of it
    )

    fraction = parameter(
        1.0,
        "",
        "share of the nominal frame during which the pixel is live",
        bounds=(0, 1),
        off=1.0,
        search=(0.1, 1),
    )
    offset = parameter(
        0.0,
        "s",
        "delay of the gate from the start of the frame",
        bounds=(0, None),
        off=0.0,
        search=(1e-10, 1e-6),
    )

    def made(self, chip: object) -> None:
        if self.fraction == 0:
            raise ValueError("a fraction of 0 leaves nothing; it is more than 0")

    def open(self, t: np.ndarray, conditions: Conditions) -> np.ndarray:
        if self.fraction == 1 and self.offset == 0:
            return np.ones(t.shape, np.bool_)
        return _live(t, conditions.frame_period, self.offset, self._end(conditions))

    def _end(self, conditions: Conditions) -> float:
        """s since the start of the frame."""
        return min(self.offset + self.fraction * conditions.frame_time, conditions.frame_time)

    def expected_rate(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """rate * live time of a frame / frame period (of `conditions.live`, the share of that part of a frame)."""
        if self.fraction == 1 and self.offset == 0:
            return rate
        whole = conditions.frame_period if conditions.live is None else conditions.live
        end = self._end(conditions) if conditions.live is None else min(self._end(conditions), conditions.live)
        return rate * (max(end - self.offset, 0.0) / whole)


@kernels.jit
def _live(times, frame_period, start, end):  # type: ignore[no-untyped-def]
    """(events,) bool: is it so long after the start of its frame? By the arithmetic that puts events into frames."""
    out = np.empty(times.size, np.bool_)
    for i in range(times.size):
        _, since = kernels._frame_of(times[i], frame_period)
        out[i] = (since >= start) & (since < end)
    return out
