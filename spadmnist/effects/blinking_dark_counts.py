"""Dark counts that blink."""

from __future__ import annotations

from typing import Any

import numpy as np

from .. import kernels
from ..events import Events
from ..streams import Draws
from . import Chip, Conditions, Effect, parameter


@kernels.jit
def is_on(
    times: np.ndarray,
    offsets: np.ndarray,
    pixels: int,
    hit: np.ndarray,
    images: np.ndarray,
    key: np.ndarray,
    rate: float,
    on: float,
) -> np.ndarray:
    """(events,) 1 where the defect of a pixel, one of `hit`, is on; 0 where it is off or there is none.

    A telegraph with the rates on * rate and (1 - on) * rate is one that at points of a Poisson process of `rate` is
    drawn afresh, on with probability `on`. That process has no memory: of the points between two events only
    whether there is one counts, and the next one is drawn behind the event. So an event costs one draw at most.

    Draw k of a pixel in an image has the counter (k, image, stream word + pixel modulo 2^32). A row has fewer than
    2^32 events and an image fewer than 2^32 pixels, so no two draws of this effect share a counter; other effects
    draw under other keys.
    """
    out = np.zeros(times.size)
    for i in range(images.size):
        for p in hit:
            word = (key[2] + np.uint64(p)) & np.uint64(0xFFFFFFFF)
            block = np.uint64(0)
            fresh = -1.0
            state = 0.0
            for e in range(offsets[i * pixels + p], offsets[i * pixels + p + 1]):
                if times[e] >= fresh:
                    a, b = kernels.philox(block, images[i], key[0], key[1], word)
                    block += np.uint64(1)
                    state = 1.0 if kernels.uniform(a) < on else 0.0
                    fresh = times[e] + kernels.exponential(b) / rate
                out[e] = state
    return out


class BlinkingDarkCounts(Effect, stage="arrival"):
    """Some pixels have a defect that switches on and off and adds dark counts while it is on.

    Each pixel has a defect with probability `fraction`, drawn when the chip is made. A defect is a telegraph process
    with two states. It is in equilibrium when an exposure begins, and independent in every image and pixel. Its dark
    counts join the others under both rules, in the light and in the dark.
    Source: random telegraph signals of SPADs, Sci. Rep. (2021) s41598-021-87962-w, Table 3: 37-84 % of the pixels after
    irradiation, few without; 0.1-10 times the dark count rate, for 10 ms to 1000 s.
    """

    counted = True
    acts_on = "own"
    moves = ("fano", "dark_map", "dark_level", "level", "outliers")

    amplitude = parameter(
        1000.0,
        "Hz",
        "dark count rate added while the defect is on",
        bounds=(0, None),
        off=0.0,
        search=(1, 1e5),
        per_pixel=True,
    )
    rate_on = parameter(10.0, "Hz", "rate of switching on", bounds=(0, None), open_bounds=True, search=(0.01, 1e4))
    rate_off = parameter(10.0, "Hz", "rate of switching off", bounds=(0, None), open_bounds=True, search=(0.01, 1e4))
    fraction = parameter(0.05, "", "share of the pixels that have a defect", bounds=(0, 1), off=0.0, search=(0.001, 1))

    def made(self, chip: Chip) -> None:
        hit = chip.generator().random(chip.layout.pixels) < self.fraction
        self._added = np.where(hit, self.amplitude, 0.0)
        self._hit = np.flatnonzero(self._added)

    def of_pixels(self, hit: np.ndarray) -> dict[str, Any]:
        """The amplitude in these pixels, none in the others."""
        return {"amplitude": np.where(hit, self.amplitude, 0.0), "fraction": 1.0}

    @property
    def on(self) -> float:
        """Share of the time for which a defect is on."""
        return self.rate_on / (self.rate_on + self.rate_off)

    def added(self, conditions: Conditions) -> np.ndarray:
        return self._added

    def modulate(self, events: Events, conditions: Conditions, rng: Draws) -> np.ndarray:
        rate = self.rate_on + self.rate_off
        return is_on(events.times, events.offsets, events.pixels, self._hit, rng.images, rng.key, rate, self.on)

    def expected_rate(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """rate + amplitude rate_on / (rate_on + rate_off) in a pixel that blinks."""
        return rate + self._added * self.on
