"""What a real pixel does, as a literal queue of events: slow, plain, the oracle of `rules: device`.

One heap for the whole array, one event at a time. Only what fires fills traps: an avalanche has, with the
afterpulsing probability, one release, at the pixel's dead time and an exponential time after it. A release that
comes while its pixel is blind is lost, and so is everything at or after the end of the exposure.

- TR: after it fires a pixel is blind for its dead time.
- Frames (QIS, STR): a pixel fires at most once in a frame and is live again at the next one; between two frames
  nothing fires; releases cross frames.

SI units.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from random import Random


def avalanches(
    rng: Random,
    rates: Sequence[float],
    exposure: float,
    afterpulsing: float,
    lifetime: float,
    dead_time: float,
    frame_time: float = 0.0,
    frame_period: float = 0.0,
) -> list[list[float]]:
    """When each pixel fires. rates: photons kept and dark counts, 1/s, of each; `frame_period` = 0: TR."""
    queue: list[tuple[float, int, int]] = []
    number = 0
    for pixel, rate in enumerate(rates):
        time = rng.expovariate(rate) if rate > 0 else math.inf
        while time < exposure:
            queue.append((time, number, pixel))
            number += 1
            time += rng.expovariate(rate)
    heapq.heapify(queue)
    fired: list[list[float]] = [[] for _ in rates]
    last_frame = [-1] * len(rates)
    while queue:
        time, _, pixel = heapq.heappop(queue)
        if frame_period > 0:
            frame = int(time // frame_period)
            if time - frame * frame_period >= frame_time or frame == last_frame[pixel]:
                continue
            last_frame[pixel] = frame
        elif fired[pixel] and time - fired[pixel][-1] <= dead_time:
            continue
        fired[pixel].append(time)
        if rng.random() < afterpulsing:
            release = time + dead_time + lifetime * rng.expovariate(1.0)
            if release < exposure:
                heapq.heappush(queue, (release, number, pixel))
                number += 1
    return fired
