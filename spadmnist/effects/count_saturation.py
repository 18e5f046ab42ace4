"""Counters that are full."""

from __future__ import annotations

import numpy as np

from . import Chip, Effect, parameter


class CountSaturation(Effect, stage="readout"):
    """The counter of a pixel stops at its largest number, 2^bits - 1.

    The effect acts on the counts of frames, the same under both rules, and not on time stamps. Counts pile up at the
    largest number. The sum of binary frames does not pile up: its law is binomial.
    Source: counters of 1-12 bit; no published number.
    """

    by_pixel = True
    counted = True
    moves = ("saturation",)

    bits = parameter(8.0, "", "number of bits of the counter", bounds=(1, 32), search=(1, 16))

    def made(self, chip: Chip) -> None:
        if self.bits != int(self.bits):
            raise ValueError(f"bits is a whole number, not {self.bits:g}")

    def influence(self) -> float:
        """Every pixel has a counter of its own."""
        return 0.0

    def limit(self, counts: np.ndarray) -> np.ndarray:
        return np.minimum(counts, min(2 ** int(self.bits) - 1, np.iinfo(counts.dtype).max))
