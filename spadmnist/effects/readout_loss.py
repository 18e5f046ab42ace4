"""Loss on a shared readout bus."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np

from .. import kernels
from ..events import Events
from . import Chip, Conditions, Effect, parameter


class ReadoutLoss(Effect, stage="readout"):
    """All pixels share one bus; an event that finds its queue full is lost.

    The bus serves one event at a time, in the order of the stamps, and takes `service_time` for each. Events with equal
    stamps are served in the order of the pixels. At most `queue` events are in the system, the one in service included.
    An event that arrives while `queue` events are in the system is lost. The bus is empty when an exposure begins.
    Stamps do not change. The effect acts on TR streams, the same under both rules.
    Source: arbiters of event-driven arrays, for example 333 million events/s for 16 pixels (Aguenounon et al. 2021);
    ceilings from 1e6 to 1e9 events/s for an array. The finite queue is a plain model, no published number.
    """

    counted = True
    shown: ClassVar[dict[str, Any]] = {"service_time": 30e-9, "queue": 2.0}  # bright light just fills the bus
    moves = ("ceiling", "linearity", "far_pairs", "neighbours", "edge", "intervals", "spectrum", "trend")

    service_time = parameter(
        10e-9,
        "s",
        "time for which one event occupies the bus",
        symbol="t_bus",
        bounds=(0, None),
        off=0.0,
        search=(1e-9, 1e-6),
    )
    queue = parameter(16.0, "", "events that wait or are in service, at most", bounds=(1, None), search=(1, 256))

    def made(self, chip: Chip) -> None:
        if self.queue != int(self.queue):
            raise ValueError(f"queue is a whole number of events, not {self.queue:g}")

    def apply(self, events: Events, rng: object) -> Events:
        if self.service_time == 0:
            return events
        return events.keep(_served(events.times, events.image_offsets, self.service_time, self.queue))

    def influence(self) -> float:
        """All pixels share the bus: those around a window load it, too."""
        return math.inf if self.service_time else 0.0

    def backlog(self) -> float:
        """What waits in a full queue."""
        return float(self.queue) - 1 if self.service_time else 0.0

    def expected_rate(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """What a queue with Poisson arrivals and a fixed time of service takes (M/D/1/K), once it is in equilibrium.

        Source: Gross and Harris, Fundamentals of Queueing Theory, on M/G/1/K.
        """
        loads = self.service_time * rate.sum(axis=-1, keepdims=True)
        taken = [_taken(float(load), self.queue) for load in loads.ravel()]
        return rate * np.reshape(taken, loads.shape)


_MOST_LOAD = 30.0  # arrivals in a time of service: beyond it the bus is never free
_MOST_QUEUE = 512  # a longer queue is full only where the load is above 1, or hardly below


def _taken(load: float, queue: float) -> float:
    """The share of arrivals that the bus takes, at a load of so many arrivals in a time of service."""
    if load == 0:
        return 1.0
    if load > _MOST_LOAD or queue > _MOST_QUEUE:
        return min(1.0, 1 / load)
    # of the chain at the departures: from how many are left behind, what crosses each level upwards crosses it back
    room = int(queue)
    number = np.arange(1, room + 60 + int(load + 12 * math.sqrt(load)))
    arriving = np.exp(number * math.log(load) - load - np.cumsum(np.log(number)))
    more = np.cumsum(arriving[::-1])[::-1][:room]  # P(more than k arrive during a service), k from 0
    left = np.zeros(room)
    left[0] = 1.0
    for i in range(room - 1):
        left[i + 1] = (left[0] * more[i] + left[1 : i + 1] @ more[i:0:-1]) * math.exp(load)
        if left[i + 1] > _LARGE:
            left /= _LARGE
    share = 1 / (float(left[0] / left.sum()) + load)
    return share if share < 1 - _NO_LOSS else 1.0


_NO_LOSS = 1e-12  # a smaller share is that of rounding
_LARGE = 1e200  # no number becomes larger
_CROWD = 64  # events in a bucket from which on it is sorted by merging


@kernels.jit
def _served(times, image_offsets, service_time, queue):  # type: ignore[no-untyped-def]
    """(events,) bool: does the bus take it?"""
    taken = np.empty(times.size, np.bool_)
    most = 1
    for i in range(image_offsets.size - 1):
        most = max(most, image_offsets[i + 1] - image_offsets[i])
    room = np.int64(min(queue, np.float64(most)))
    leaves = np.empty(room)  # when each of the last ones taken leaves, in a ring
    begin = np.empty(most + 2, np.int32)
    index = np.empty(most, np.int32)
    moment = np.empty(most)
    for i in range(image_offsets.size - 1):
        start = image_offsets[i]
        count = image_offsets[i + 1] - start
        _in_time_order(times[start : start + count], begin, index, moment)
        leaves[:] = -np.inf
        last = -np.inf
        oldest = 0
        for j in range(count):
            time = moment[j]
            free = leaves[oldest] <= time
            taken[start + index[j]] = free
            if free:
                last = max(time, last) + service_time
                leaves[oldest] = last
                oldest += 1
                if oldest == room:
                    oldest = 0
    return taken


@kernels.jit
def _in_time_order(times, begin, index, moment):  # type: ignore[no-untyped-def]
    """Fill `moment` with the times in ascending order and `index` with their places, equal ones in theirs.

    A bucket for each event: times spread over an exposure fill them evenly, and little is left to sort within one.
    """
    count = times.size
    if count == 0:
        return
    low = times.min()
    extent = times.max() - low
    scale = (count - 1) / extent if extent > 1e-30 else 0.0  # no division that overflows
    begin[: count + 1] = 0
    for j in range(count):
        begin[int((times[j] - low) * scale) + 1] += 1
    for b in range(count):
        begin[b + 1] += begin[b]
    for j in range(count):
        b = int((times[j] - low) * scale)
        moment[begin[b]] = times[j]
        index[begin[b]] = j
        begin[b] += 1
    # now begin[b] is where bucket b ends
    start = 0
    for b in range(count):
        end = begin[b]
        if end - start > _CROWD:
            order = np.argsort(moment[start:end], kind="mergesort")
            moment[start:end] = moment[start:end][order]
            index[start:end] = index[start:end][order]
        start = end
    for j in range(1, count):
        time = moment[j]
        if moment[j - 1] > time:
            from_where = index[j]
            place = j
            while place > 0 and moment[place - 1] > time:
                moment[place] = moment[place - 1]
                index[place] = index[place - 1]
                place -= 1
            moment[place] = time
            index[place] = from_where
