"""A source that is noisy."""

from __future__ import annotations

import math

import numpy as np

from .. import kernels, units
from ..events import Events
from ..streams import Draws
from . import Conditions, Effect, parameter

_MOST_TERMS = 9
_FLIPS = 4e6  # an image that has more of them gets fewer terms
_MOST_FLIPS = 5e7
_WINDOW = 4096  # flips that are looked at together
_FINE = 8  # buckets of time to a flip
_BATCH = 64  # flips that are drawn together: a divisor of the window


@kernels.jit
def levels(
    times: np.ndarray,
    offsets: np.ndarray,
    pixels: int,
    images: np.ndarray,
    key: np.ndarray,
    power: np.ndarray,
    gap: float,
    end: float,
) -> np.ndarray:
    """(events,) the light's power at each event. power: (terms + 1,) that with so many telegraphs up; gap, end: s.

    All telegraphs together flip as a Poisson process, `gap` apart in the mean, and it is any of them that flips.
    Block 0 of an image's draws says where they begin, block k is the k-th flip: the path is the same whatever the
    image's events are.
    """
    out = np.empty(times.size)
    flips = np.empty(_WINDOW)
    before = np.empty(_WINDOW)
    first = np.empty(_FINE * _WINDOW, np.int32)
    place = np.empty(pixels, np.int64)
    waits = np.empty(_BATCH)
    choices = np.empty(_BATCH)
    terms = power.size - 1
    for i in range(images.size):
        place[:] = offsets[i * pixels : (i + 1) * pixels]
        left = offsets[(i + 1) * pixels] - offsets[i * pixels]
        block = np.uint64(0)
        coins, _ = kernels.philox(block, images[i], key[0], key[1], key[2])
        up = 0
        for k in range(terms):
            up += 1 if (coins >> np.uint64(k)) & np.uint64(1) else 0
        now = 0.0
        while left > 0:
            begin = now
            count = 0
            while count == 0 or (count < _WINDOW and now < end):
                for k in range(_BATCH):
                    block += np.uint64(1)
                    a, b = kernels.philox(block, images[i], key[0], key[1], key[2])
                    waits[k] = kernels.exponential(a)
                    choices[k] = kernels.uniform(b) * terms
                for k in range(_BATCH):
                    now += gap * waits[k]
                    flips[count] = now
                    before[count] = power[up]
                    count += 1
                    up += -1 if choices[k] < up else 1
            # `first`: the first flip in a bucket of time or behind it, `_FINE` buckets to a flip. Flips
            # and events find their buckets by one formula: rounding cannot put one on the wrong side of another
            fine = _FINE * count / (now - begin)
            last = _FINE * count - 1
            first[: last + 1] = 0
            for k in range(count):
                first[min(int((flips[k] - begin) * fine), last)] += 1
            earlier = 0
            for k in range(last + 1):
                here = first[k]
                first[k] = earlier
                earlier += here
            for p in range(pixels):
                e = place[p]
                stop = offsets[i * pixels + p + 1]
                while e < stop and times[e] < now:
                    k = first[min(int((times[e] - begin) * fine), last)]
                    while flips[k] <= times[e]:
                        k += 1
                    out[e] = before[k]
                    e += 1
                left -= e - place[p]
                place[p] = e
    return out


class SourceNoise(Effect, stage="arrival"):
    """The power of the light fluctuates, so that photons bunch.

    g2(tau) - 1 = contrast^2 exp(-2 tau / coherence_time). The fluctuation is the same for all pixels and independent in
    every image. The power is 1 plus a sum of independent telegraph processes, each of which flips between two opposite
    values at the rate 1 / coherence_time. Their number is the largest that keeps the power positive, at most 9, and
    less where one exposure would have more than 4e6 flips. The power multiplies the light under both rules. Dark counts
    do not change.
    Source: Mandel and Wolf, Optical Coherence and Quantum Optics (1995), for counts of fluctuating light. No published
    number for a lamp: its coherence time (about 0.2 ps for 5 nm at 500 nm) is too short to be measured; pseudo-thermal
    light and laser noise have 1 us to ms.
    """

    by_pixel = True
    counted = True
    moves = ("far_pairs", "neighbours", "autocorrelation", "spectrum", "fano", "intervals", "frames_lag", "ceiling")
    states_mean = True  # the mean light stays

    contrast = parameter(0.1, "", "relative standard deviation of the power", bounds=(0, 1), off=0.0, search=(1e-3, 1))
    coherence_time = parameter(
        10e-6,
        "s",
        "time after which the correlation of the power is 1/e^2",
        symbol="tau_c",
        bounds=(0, None),
        open_bounds=True,
        search=(1e-6, 1e-2),
    )

    def terms(self, conditions: Conditions) -> int:
        """Number of telegraphs. Raises ValueError where even one flips too often to be simulated."""
        flips = conditions.exposure / self.coherence_time
        if flips > _MOST_FLIPS:
            raise ValueError(
                f"in an exposure of {units.show(conditions.exposure, 's')} the light would change {flips:.1g} times; "
                f"coherence_time must be at least {units.show(conditions.exposure / _MOST_FLIPS, 's')}"
            )
        allowed = max(k for k in range(1, _MOST_TERMS + 1) if self.contrast * math.sqrt(k) <= 1)
        return int(max(1, min(allowed, _FLIPS / flips)))

    def modulate(self, events: Events, conditions: Conditions, rng: Draws) -> np.ndarray:
        if self.contrast == 0 or conditions.dark:
            return np.ones(len(events))
        terms = self.terms(conditions)
        up = np.arange(terms + 1)
        power = np.maximum(1 + self.contrast / math.sqrt(terms) * (2 * up - terms), 0.0)
        gap = self.coherence_time / terms
        return levels(events.times, events.offsets, events.pixels, rng.images, rng.key, power, gap, conditions.exposure)

    def maximum(self, conditions: Conditions) -> float:
        return 1 + self.contrast * math.sqrt(self.terms(conditions)) if self.contrast else 1.0
