"""The line of a sensor, stage by stage: from photons to readouts, for any effects.

One Poisson draw of what photons and dark counts start, the gates, the family of events that these may cause, those of
them that fire; then the time stamps, the binary frames and the counters of what fired.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from . import bit_planes, hooks, kernels
from .effects import Conditions
from .errors import SpadError
from .events import Events
from .readout import Frames, Recorded, counts_type, no_detection, summarised, unsigned_for
from .streams import Streams
from .window import Window

if TYPE_CHECKING:
    from .sensor import Sensor

_GENERATIONS = 10_000  # of a cascade, at most
_CHILDREN = 200  # times the events that they come from: more is a cascade without end
_NONE = np.zeros(0)
_NO_EVENT = np.zeros(0, bool)
_NOBODY = np.zeros(0, np.int64)


@dataclass(frozen=True)
class Line:
    """The line of one batch of images.

    Attributes:
        sensor: resolved; the whole of a chip.
        conditions: of the capture.
        streams: the random numbers of these images.
        causes: whether every event says what made it.
        window: the part of the chip that is read out; None: the whole of it.
    """

    sensor: Sensor
    conditions: Conditions
    streams: Streams
    causes: bool = False
    window: Window | None = None

    def run(self, photons: np.ndarray, readouts: Collection[str]) -> Recorded:
        """The recordings of images.

        Args:
            photons: (images, pixels) photons/s on the whole chip.
            readouts: of `tr`, `str`, `qis`, `counts`.
        """
        sensor, conditions, window = self.sensor, self.conditions, self.window
        lively = None if window is None else sensor.lively(window, readouts)
        pixels = photons.shape[1] if window is None else len(window.pixels)
        events = self._open(self._arrivals(photons, lively))
        candidates, parents = self._family(events)
        tr, frames, tally = None, None, None
        counter = "counts" in readouts and conditions.counting == "counter"
        if "tr" in readouts or counter:
            needed = self._needed(candidates)
        if counter:
            counted = self._fired(candidates, parents, needed, self._asleep(candidates.times))
            tally = self._counted(self._seen(counted, len(photons)))
        if "tr" in readouts:
            detected = self._fired(candidates, parents, needed)
            detected.end = conditions.exposure
            for stage in ("timing", "readout"):
                for effect in sensor.at(stage):
                    if hasattr(effect, "apply"):
                        detected = hooks.applied(effect, detected, self.streams)
            tr = _narrow(self._seen(detected, len(photons)), conditions.exposure, "TR stamps")
        if {"str", "qis"} & set(readouts) or ("counts" in readouts and not counter):
            detected = self._fired_in_frames(candidates, parents)
            frames = self._frames(self._seen(detected, len(photons)), "str" in readouts)
            if "counts" in readouts and not counter:
                tally = summed(sensor, frames.bits, conditions, window)
            if not {"str", "qis"} & set(readouts):
                frames = None
        return summarised(pixels, tr, frames, tally)

    def _seen(self, events: Events, images: int) -> Events:
        """The events of the window."""
        if self.window is None:
            return events
        return events.of_rows(self.window.rows(images), len(self.window.pixels))

    # --- what starts an event -----------------------------------------------------------------------------------

    def _arrivals(self, photons: np.ndarray, lively: np.ndarray | None) -> Events:
        """The Poisson draw; what is no constant rate is drawn at its maximum and thinned.

        Args:
            lively: (pixels,) bool, where anything happens at all; None: everywhere.
        """
        sensor, conditions, streams = self.sensor, self.conditions, self.streams
        rate, light = sensor.rates(photons, conditions)
        if lively is not None:
            rate, light = rate * lively, light * lively
        varying = sensor.at("arrival")
        drawn = rate
        # (what it is, its rate) of the parts that vary each in its own way
        parts = [("light", light), ("dark", rate - light)]
        if varying:
            maxima = dict.fromkeys(("light", "dark"), 1.0)
            for effect in varying:
                if effect.acts_on == "own":
                    own = hooks.added(effect, rate.shape, conditions)
                    parts.append((effect.name, own if lively is None else own * lively))
                else:
                    maxima[effect.acts_on] *= hooks.maximum(effect, conditions)
            drawn = np.zeros_like(rate)
            for kind, part in parts:
                drawn += part * maxima.get(kind, 1.0)
        rng = streams.draws("photons and dark counts", 0)
        drawn = np.ascontiguousarray(drawn)
        times, offsets = kernels.arrivals(drawn, conditions.exposure, rng.images, rng.key, rng.place)
        events = Events(times, offsets, rate.shape[1], end=conditions.exposure)
        factors: dict[str, np.ndarray] = {}
        if varying:
            for effect in varying:
                kind = effect.name if effect.acts_on == "own" else effect.acts_on
                factor = hooks.factor(effect, events, conditions, streams)
                factors[kind] = factors[kind] * factor if kind in factors else factor
            now = np.zeros(len(times))
            for kind, part in parts:
                kernels.weigh(now, offsets, part.ravel(), factors.get(kind, _NONE))
            rng = streams.draws("thinning", len(events))
            images = events.image_offsets, rng.images
            kept = kernels.thinned(now, offsets, drawn.ravel(), *images, rng.key, rng.before)
            events = events.keep(kept)
            factors = {kind: factor[kept] for kind, factor in factors.items()} if self.causes else {}
        if self.causes:
            events.cause = self._attributed(events, parts, factors)
            events.parent = np.full(len(events), -1, np.int64)
        return events

    def _attributed(
        self, events: Events, parts: list[tuple[str, np.ndarray]], factors: dict[str, np.ndarray]
    ) -> np.ndarray:
        """(events,) what made each: drawn in proportion to the rates at its time, for the draw does not say."""
        sensor = self.sensor
        shares: list[tuple[str, str, np.ndarray]] = [("photon", "light", parts[0][1])]
        rate = parts[0][1]
        for effect in sensor.at("dark"):
            after = hooks.rate(effect, rate, self.conditions)
            shares.append((effect.cause, "dark", np.maximum(after - rate, 0.0)))
            rate = after
        for effect in sensor.at("arrival"):
            if effect.acts_on == "own":
                part = next(part for kind, part in parts if kind == effect.name)
                shares.append((effect.cause, effect.name, part))
        rng = self.streams.draws("causes", len(events))
        every = np.arange(len(events))
        chance = kernels.uniforms(every, events.image_offsets, rng.images, rng.key, rng.before)
        running = np.zeros((len(shares) + 1, len(events)))
        for i, (_, kind, part) in enumerate(shares):
            running[i + 1] = running[i]
            kernels.weigh(running[i + 1], events.offsets, part.ravel(), factors.get(kind, _NONE))
        # the last one whose share begins at or before the point
        place = chance * running[-1]
        chosen = np.zeros(len(events), np.int64)
        for i in range(1, len(shares)):
            chosen[(place >= running[i]) & (running[i + 1] > running[i])] = i
        codes = np.array([sensor.causes.index(cause) for cause, _, _ in shares], np.uint8)
        return codes[chosen]

    def _open(self, events: Events) -> Events:
        """The events at which a pixel can fire."""
        return events.keep(self._is_open(events.times)) if self.sensor.at("gate") else events

    def _is_open(self, times: np.ndarray) -> np.ndarray:
        mask = np.ones(times.shape, bool)
        for effect in self.sensor.at("gate"):
            mask &= hooks.is_open(effect, times, self.conditions)
        return mask

    # --- what an event causes -------------------------------------------------------------------------------------

    def _family(self, events: Events) -> tuple[Events, np.ndarray]:
        """The events with all that they may cause, and the parent of each (empty where there is none to look at).

        By the paper's rules every event has its children, whether or not it will be recorded, and they have none. By
        a device's, children have children; which of them happen is decided later, when it is known what fires.
        """
        sensor, exposure = self.sensor, self.conditions.exposure
        cascade = sensor.rules == "device"
        correlated = sensor.at("correlated")
        children: list[tuple[np.ndarray, ...]] = []  # times, rows, parents, causes, generation by generation
        current, first, known = events, 0, len(events)  # of which the first is so many in all
        generation = 0
        while correlated and len(current) and (cascade or generation == 0):
            if generation == _GENERATIONS or known > _CHILDREN * (len(events) + _CHILDREN):
                raise SpadError(
                    f"the cascade of avalanches does not end ({known - len(events)} of {len(events)} events in "
                    f"{generation} generations); lower the probabilities of the correlated effects"
                )
            suffix = f"/generation {generation}" if generation else ""
            found = [hooks.spawned(effect, current, sensor.dead_times, self.streams, suffix) for effect in correlated]
            made = [
                np.full(len(t), sensor.causes.index(e.cause)) for (t, _, _), e in zip(found, correlated, strict=True)
            ]
            t, r, p = (np.concatenate(column) for column in zip(*found, strict=True))
            inside = t < exposure
            inside[inside] = self._is_open(t[inside])
            t, r, p, made_by = t[inside], r[inside], p[inside], np.concatenate(made)[inside]
            order, offsets = kernels.row_order(t, r, len(events.offsets) - 1)
            t, r, p, made_by = t[order], r[order], p[order], made_by[order]
            children.append((t, r, first + p, made_by))
            generation += 1
            first = known
            known += len(t)
            current = Events(t, offsets, events.pixels)
        if known == len(events):
            return events, _NOBODY
        times, rows, parents, made_by = (np.concatenate(column) for column in zip(*children, strict=True))
        # what is equally late stays in the order of the generations: the parent first
        order, _ = kernels.row_order(times, rows, len(events.offsets) - 1)
        merged, offsets, before = kernels.merge(events.times, events.offsets, times[order], rows[order])
        out = Events(merged, offsets, events.pixels, end=exposure)
        linked = kernels.relinked(len(events), before, order, parents) if cascade or self.causes else _NOBODY
        if self.causes and events.cause is not None:
            out.cause = np.insert(events.cause, before, made_by[order].astype(np.uint8))
            out.parent = linked
        return out, linked if cascade else _NOBODY

    # --- what fires -----------------------------------------------------------------------------------------------

    def _asleep(self, times: np.ndarray) -> np.ndarray:
        """(events,) bool: do they fall between the frames of a counter, where nothing fires; empty where none does."""
        c = self.conditions
        if self.sensor.rules == "paper" or c.frame_period <= c.frame_time:
            return _NO_EVENT
        return np.asarray(times - np.floor(times / c.frame_period) * c.frame_period >= c.frame_time)

    def _fired(self, events: Events, parents: np.ndarray, needed: np.ndarray, asleep: np.ndarray = _NO_EVENT) -> Events:
        """Those of the candidates that happen: the parent did, and the pixel was neither blind nor asleep.

        Args:
            needed: see `_needed`.
            asleep: (events,) bool, empty where none is.
        """
        sensor = self.sensor
        if not (sensor.soft or sensor.extends or len(parents) or len(asleep)):
            if not sensor.dead_times.any():
                return events
            if events.cause is None:
                kept = kernels.non_paralyzable(events.times, events.offsets, sensor.dead_times)
                return Events(events.times[kept], kernels.take(events.offsets, kept), events.pixels)
        own = events.times, events.offsets, parents, sensor.dead_times, needed, sensor.extends
        return events.keep(kernels.avalanches(*own, 0.0, 0.0, 0.0, asleep))

    def _fired_in_frames(self, events: Events, parents: np.ndarray) -> Events:
        """Those of the candidates that happen in binary frames, each of which begins anew."""
        sensor, c = self.sensor, self.conditions
        if sensor.rules == "paper" and sensor.carried == 0:
            return events
        own = events.times, events.offsets, parents, sensor.dead_times, _NONE, sensor.extends
        return events.keep(kernels.avalanches(*own, c.frame_period, c.frame_time, sensor.carried, _NO_EVENT))

    def _needed(self, events: Events) -> np.ndarray:
        """(events,) s that the pixel must have been awake for each to fire; empty where none needs any.

        A pixel whose sensitivity has come up to S fires with probability S: each event draws a number, and fires if
        the sensitivity has reached it. Only what follows another event closely can find a pixel half awake.
        """
        sensor = self.sensor
        if not sensor.soft:
            return _NONE
        needed = np.zeros(len(events))
        for effect in sensor.soft:
            close = kernels.followers(events.times, events.offsets, sensor.dead_times + hooks.awake_after(effect))
            rng = self.streams.draws(f"{effect.name}/sensitivity", len(events))
            chance = kernels.uniforms(close, events.image_offsets, rng.images, rng.key, rng.before)
            needed[close] = np.maximum(needed[close], hooks.recovered(effect, chance))
        return needed

    # --- what is read out -----------------------------------------------------------------------------------------

    def _counted(self, events: Events) -> np.ndarray:
        """(rows, frames) what a counter in each pixel has at the end of each frame."""
        c = self.conditions
        out = np.zeros((len(events.offsets) - 1, c.frames), counts_type(c.largest_count))
        clock = c.frame_time, c.frame_period
        kernels.counts_in_frames(events.times, events.offsets, *clock, c.largest_count, out)
        return limited(self.sensor, out, self.window)

    def _frames(self, events: Events, stamped: bool) -> Frames:
        c, window, pixels = self.conditions, self.window, events.pixels
        clock = c.frames, c.frame_time, c.frame_period
        if events.cause is not None:
            # the first of each frame alone: then each has its bit and its stamp
            events = events.keep(kernels.first_of_frames(events.times, events.offsets, *clock))
        out = np.empty(len(events) + 1)
        bits, offsets = kernels.frame_readout(events.times, events.offsets, *clock, out)
        first = None
        if stamped:
            stamps = out[: offsets[-1]]
            # a row for each frame: its one stamp stays its own, whatever a timing effect does with it
            rows = Events(stamps, offsets, pixels)
            first = Events(
                stamps,
                np.arange(len(stamps) + 1),
                self.sensor.layout.pixels,
                row_pixel=rows.pixel if window is None else window.pixels[rows.pixel],
                end=c.frame_time,
                image_offsets=rows.image_offsets,
            )
            for effect in self.sensor.at("timing"):
                first = hooks.applied(effect, first, self.streams, "/frames")
            ticks, tick = first.ticks, first.tick
            if ticks is not None and tick is not None:
                # what rounds to the end of the frame would mean 'none'
                ticks = np.minimum(ticks, np.uint64(no_detection(c.frame_time, tick) - 1))
            first = Events(None if ticks is not None else first.times, offsets, pixels, ticks, tick)
            first = _narrow(first, c.frame_time, "STR stamps")
        return Frames(bits, first, c.frames, c.frame_time, pixels, events.cause, events.parent)


def summed(sensor: Sensor, bits: np.ndarray, conditions: Conditions, window: Window | None) -> np.ndarray:
    """Sums of binary frames, (rows, count frames)."""
    most = conditions.largest_count
    out = np.empty((len(bits), conditions.count_frames), counts_type(most))
    bit_planes.sums_of_frames(bits, most, out)
    return limited(sensor, out, window)


def limited(sensor: Sensor, counts: np.ndarray, window: Window | None) -> np.ndarray:
    """Counts (rows, frames) as the readout leaves them."""
    limits = [effect for effect in sensor.at("readout") if hasattr(effect, "limit")]
    if not limits:
        return counts
    if window is not None:
        images = len(counts) // len(window.pixels)
        whole = np.zeros((images * sensor.layout.pixels, counts.shape[1]), counts.dtype)
        whole[window.rows(images)] = counts
        counts = whole
    for effect in limits:
        counts = hooks.limit(effect, counts)
    return counts if window is None else counts[window.rows(images)]


def _narrow(events: Events, end: float, what: str) -> Events:
    """The events with ticks of the narrowest type that holds those until the end."""
    if events.ticks is None or events.tick is None:
        return events
    kind = unsigned_for(end / events.tick, what)
    if len(events.ticks) and int(events.ticks.max()) > np.iinfo(kind).max:
        raise SpadError(f"{what}: a stamp of {int(events.ticks.max())} ticks does not fit {np.dtype(kind)}")
    return events.stamped(events.ticks.astype(kind, copy=False), events.tick)
