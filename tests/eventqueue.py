"""What a real pixel does, as a literal queue of events: slow, plain, the oracle of `rules: device`.

One heap for the whole array, one event at a time. Only what fires fills traps and sends out light: an avalanche has,
with its probability, one release of each population of traps, at the pixel's dead time and an exponential time
after it; and it sends an event, an exponential time later, to each pixel on its list with that pixel's probability.
What comes while its pixel is blind or its gate is shut is lost, and so is everything at or after the end of the
exposure.

- TR: after it fires a pixel is blind for its dead time; a paralyzable one is so anew after each event that it loses
  by this. A pixel that has been live again for u fires with the chance 1 - exp(-u / recovery).
- Frames (QIS, STR): a pixel that fires is blind to the end of the frame, and for a share `carried` of what is then
  left of its dead time; it is as sensitive as ever afterwards. Between two frames nothing fires; releases cross them.

SI units.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Sequence
from random import Random


def avalanches(
    rng: Random,
    rates: Sequence[float],
    exposure: float,
    afterpulsing: float,
    lifetime: float,
    dead_time: float | Sequence[float],
    frame_time: float = 0.0,
    frame_period: float = 0.0,
    *,
    slow_afterpulsing: float = 0.0,
    slow_lifetime: float = 0.0,
    crosstalk: Sequence[Sequence[tuple[int, float]]] | None = None,
    delay: float = 0.0,
    paralyzable: bool = False,
    recovery: float = 0.0,
    carried: float = 0.0,
    live: Callable[[float], bool] | None = None,
) -> list[list[float]]:
    """When each pixel fires. rates: photons kept and dark counts, 1/s, of each; `frame_period` = 0: TR.

    crosstalk: for each pixel, whom it fires (pixel, probability), after `delay` in the mean; live: can a pixel fire
    at this time?
    """
    pixels = range(len(rates))
    dead_times = [dead_time] * len(rates) if isinstance(dead_time, int | float) else list(dead_time)
    queue: list[tuple[float, int, int]] = []
    number = 0
    for pixel in pixels:
        time = rng.expovariate(rates[pixel]) if rates[pixel] > 0 else math.inf
        while time < exposure:
            queue.append((time, number, pixel))
            number += 1
            time += rng.expovariate(rates[pixel])
    heapq.heapify(queue)
    fired: list[list[float]] = [[] for _ in pixels]
    blind_until = [-math.inf for _ in pixels]
    while queue:
        time, _, pixel = heapq.heappop(queue)
        frame = int(time // frame_period) if frame_period > 0 else 0
        if frame_period > 0 and time - frame * frame_period >= frame_time:
            continue
        if live is not None and not live(time):
            continue
        if time <= blind_until[pixel]:
            if paralyzable and frame_period == 0:
                blind_until[pixel] = time + dead_times[pixel]
            continue
        if recovery > 0 and frame_period == 0:
            awake = time - blind_until[pixel]
            if rng.random() >= 1 - math.exp(-awake / recovery):
                continue
        fired[pixel].append(time)
        blind_until[pixel] = time + dead_times[pixel]
        if frame_period > 0:
            start = (frame + 1) * frame_period
            blind_until[pixel] = start + carried * max(0.0, blind_until[pixel] - start)
        children: list[tuple[float, int]] = []
        if rng.random() < afterpulsing:
            children.append((time + dead_times[pixel] + lifetime * rng.expovariate(1.0), pixel))
        if rng.random() < slow_afterpulsing:
            children.append((time + dead_times[pixel] + slow_lifetime * rng.expovariate(1.0), pixel))
        for target, probability in crosstalk[pixel] if crosstalk else ():
            if rng.random() < probability:
                children.append((time + delay * rng.expovariate(1.0), target))
        for when, target in children:
            if when < exposure:
                heapq.heappush(queue, (when, number, target))
                number += 1
    return fired
