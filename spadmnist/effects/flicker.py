"""Flicker."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np

from .. import kernels
from . import Conditions, Effect, parameter

# Taylor coefficients of the sine, x^1 to x^19: up to a quarter of a turn the rest is below 1e-15
_TERMS = tuple((-1) ** k / math.factorial(2 * k + 1) for k in range(10))


@kernels.jit
def sine(times: np.ndarray, frequency: float, start: float) -> np.ndarray:
    """The sine of `frequency * times + start` turns: the same bits on every machine, from -1 to 1."""
    out = np.empty(times.size)
    for i in range(times.size):
        turns = frequency * times[i] + start
        turns -= np.floor(turns + 0.5)
        # a sine looks the same backwards from its peak: only the first quarter of a turn is left
        x = 2 * math.pi * (0.25 - abs(0.25 - abs(turns)))
        square = x * x
        value = _TERMS[9]
        for k in range(8, -1, -1):
            value = _TERMS[k] + square * value
        out[i] = math.copysign(min(x * value, 1.0), turns)
    return out


class Flicker(Effect, stage="arrival"):
    """The light oscillates at the frequency of the mains or of the lamp's driver.

    The light is multiplied by 1 + amplitude sin(2 pi frequency t + phase), where t is the time since the start of the
    exposure. The factor is the same for all pixels and under both rules. Dark counts do not change.
    Source: no published number; 100 or 120 Hz and their harmonics, 0.01-10 %, are realistic.
    """

    by_pixel = True
    moves = ("spectrum", "far_pairs", "neighbours", "autocorrelation", "trend")
    shown: ClassVar[dict[str, Any]] = {"frequency": 5e3}  # several periods in an exposure

    amplitude = parameter(
        0.05, "", "relative amplitude of the oscillation", symbol="m", bounds=(0, 1), off=0.0, search=(1e-4, 0.5)
    )
    frequency = parameter(
        100.0, "Hz", "frequency of the oscillation", symbol="f", bounds=(0, None), open_bounds=True, search=(10, 1e5)
    )
    phase = parameter(0.0, "rad", "phase at the start of the exposure", search=(0, 2 * math.pi))

    def factor(self, t: np.ndarray, conditions: Conditions) -> np.ndarray:
        start = math.fmod(self.phase / (2 * math.pi), 1.0)
        return 1 + self.amplitude * sine(np.ravel(t), self.frequency, start).reshape(np.shape(t))

    def maximum(self, conditions: Conditions) -> float:
        return 1 + self.amplitude

    def expected_rate(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """rate (1 + m s(f L) s(n d) / s(d) sin(phase + pi f L + pi (n - 1) d)), s(x) = sin(pi x) / (pi x).

        That is the mean over n frames, each live for L: d is what f times the frame period misses of a whole number.
        Of the whole exposure n is 1, and L is the exposure.
        """
        if conditions.dark:
            return rate
        c, f = conditions, self.frequency
        frames, live = (1, c.exposure) if c.live is None else (c.frames, c.live)
        turns = f * c.frame_period
        turns -= round(turns)
        swing = np.sinc(f * live) * np.sinc(frames * turns) / np.sinc(turns)
        middle = self.phase + math.pi * (f * live + (frames - 1) * turns)
        return rate * (1 + self.amplitude * float(swing) * math.sin(middle))
