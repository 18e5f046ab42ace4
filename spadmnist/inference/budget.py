"""The budget of a diagnosis: an amount of work, not of time, so that the same seed gives the same answer everywhere.

Work is counted in seconds of two idle cores: the number of recordings times the cost of simulating and reducing one.
The clock only stops a run that takes three times as long.
"""

from __future__ import annotations

import math
import re
import time
from dataclasses import dataclass, field

import numpy as np

from .. import units
from ..errors import InputError
from ..recording import Capture

# s of two idle cores, measured with `rules: device` and all statistics: per detection with a stamp, per detection in
# frames, per bit that is drawn without its events (of those that are rarer, 0 or 1), per pixel of a frame, and per
# recording. They are the work that the budget counts
_STAMP, _IN_FRAMES, _DRAWN_BIT, _PIXEL_FRAME, _RECORDING = 1.5e-7, 5e-8, 1e-8, 1e-9, 2e-3
# a budget in min or h, which the units of sensor files do not have; their length, s
_LONG, _LONG_UNITS = re.compile(r"\s*(\d+\.?\d*|\.\d+)\s*(min|h)\s*", re.ASCII), {"min": 60.0, "h": 3600.0}
# The others are rules of thumb.
# times the budget, by the clock: a longer run ends, because its machine is far slower than two idle cores
_SLOW = 3.0
_ROUNDING = 1e-9  # of the work: what is left of it when as much is subtracted in another order is none
_DEFAULT, _QUICK = 600.0, 180.0  # s: the default budget, and that of a quick diagnosis
# shares of the budget after which no further step, and no further fit or test of the steps, begins; the rest is for
# the fits and tests, and for limits and advice
STEPS, FITS = 0.75, 0.9
ERRORS = 1.25  # share of the budget that the errors of the numbers may take, where the budget has ended their fit


class OutOfBudget(Exception):
    """The budget is spent: the simulation under way has no result."""


@dataclass
class Budget:
    """The work that a diagnosis may do.

    Attributes:
        seconds: the budget, s of two idle cores; infinite for no end.
        until: the share of the budget that may be spent now; infinite for the work that every answer needs.
        spent: work done so far, s of two idle cores.
        began: start of the run on the monotonic clock, s.
        remembered: the part of that work whose result was in a cache, s of two idle cores.
        measured_from: the time, s, and the simulated work from which on the speed of this machine is measured: the
            end of the first work, which also compiles the program.
    """

    seconds: float = math.inf
    until: float = math.inf
    spent: float = 0.0
    began: float = field(default_factory=time.monotonic)
    remembered: float = 0.0
    measured_from: tuple[float, float] | None = None

    @property
    def _simulated(self) -> float:
        done = self.spent - self.remembered
        return done if done > _ROUNDING * self.spent else 0.0

    def spend(self, seconds: float) -> None:
        """Count some work before it is done.

        Args:
            seconds: the work, s of two idle cores.
        Raises:
            OutOfBudget: where it exceeds the share that may be spent now, or the run is late.
        """
        late = time.monotonic() - self.began > _SLOW * self.seconds
        if self.until < math.inf and (self.spent + seconds > self.until * self.seconds or late):
            raise OutOfBudget
        if self._simulated > 0 and self.measured_from is None:
            self.measured_from = time.monotonic(), self._simulated
        self.spent += seconds

    def remember(self, seconds: float) -> None:
        """Count work that was spent as found in a cache, s of two idle cores."""
        self.remembered += seconds

    @property
    def left(self) -> float:
        """Time on this machine until the steps end, s, at most, at the speed so far; infinite without an end."""
        if not self.spent or self.seconds == math.inf:
            return self.seconds
        now = time.monotonic()
        since, done = self.measured_from or (now, self._simulated)
        # at first the speed of two idle cores
        speed = (now - since) / (self._simulated - done) if self._simulated > done else 1.0
        at_this_speed = max(STEPS * self.seconds - self.spent, 0.0) * speed
        return min(at_this_speed, max(_SLOW * self.seconds - (now - self.began), 0.0))


def seconds_of(within: str | float | None, quick: bool) -> float:
    """The budget as users state it, in s.

    Args:
        within: a time with its unit ("3 min"), a number of seconds, "none" for no end, None for the default.
        quick: the default is that of a quick diagnosis.
    Raises:
        InputError: where it is none of these, or no time above 0.
    """
    if within is None:
        return _QUICK if quick else _DEFAULT
    if isinstance(within, str) and within.strip().lower() == "none":
        return math.inf
    if isinstance(within, bool | np.bool_):
        raise InputError(f"within: {within!r} is no time; write a number and h, min or s, for example 10 min")
    stated = _LONG.fullmatch(within) if isinstance(within, str) else None
    try:
        if stated is not None:
            seconds = float(stated[1]) * _LONG_UNITS[stated[2]]
        else:
            seconds = float(units.parse(within, "s")) if isinstance(within, str) else float(within)
    except (TypeError, ValueError):
        seconds = math.nan
    if not seconds > 0:
        raise InputError(
            f"within: {within!r} is not understood; write a number of more than 0 and its unit, h, min or s, for "
            "example 10 min, or none for no end"
        )
    return seconds


def clock(seconds: float) -> str:
    """A time in s as text: 4:10, 1:02:00."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def work_of(capture: Capture, detections: float, pixels: int, by_bits: bool = False) -> float:
    """The work of simulating and reducing one recording of a capture, s of two idle cores.

    Args:
        capture: its modality and its frames decide the cost of the pixels.
        detections: of the whole array.
        pixels: of the array.
        by_bits: the bits of its frames are drawn without their events (`twin.draws_bits`).
    """
    frames = 0 if capture.modality == "tr" else capture.conditions.frames * pixels
    drawn = (_IN_FRAMES if capture.modality in ("qis", "counts") else _STAMP) * detections
    if by_bits:
        drawn = _DRAWN_BIT * min(detections, frames - detections)
    return _RECORDING + drawn + _PIXEL_FRAME * frames
