"""A sensor: pixels, effects and a chip; and the line from photons to readouts.

`Sensor.expose` is the whole simulation. There are two ways through it, which give the same events bit for bit: the
staged line takes a batch through one stage after the other and serves every sensor; where a sensor has nothing
beyond the paper's line, `kernels.paper_line` does the same, image by image, in one go.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from . import kernels
from .effects import Conditions, Effect, in_order
from .effects.afterpulsing import Afterpulsing
from .effects.dead_time import DeadTime
from .effects.tdc import Tdc
from .errors import EffectError, InputError, SpadError
from .events import Children, Events, Layout
from .plugins import blame, settle, source_file
from .readout import Frames, Recorded, no_detection, summarised, unsigned_for
from .streams import BLOCK, Draws, Streams

_EVENTS_AT_ONCE = 200_000  # expected events of a sub-batch: its buffers stay in the processor's cache
_GENERATIONS = 10_000


@dataclass
class Sensor:
    """Layout, effects and chip seed. The effects' values may still be distributions and files; see `settled`.

    rules: `paper` or `device` (physics of the readouts: what fills traps, and what a frame sees).
    """

    layout: Layout
    effects: list[Effect]
    rules: str = "paper"
    chip_seed: int = 0
    name: str = ""
    _settled: bool = field(default=False, repr=False)

    def settled(self) -> Sensor:
        """The same sensor with every map read and every distribution drawn. Raises InputError for a bad map."""
        if self._settled:
            return self
        effects = [
            type(effect)(**{name: self.settle(effect, name) for name in effect.parameters})
            for effect in in_order(self.effects)
        ]
        return Sensor(self.layout, effects, self.rules, self.chip_seed, self.name, True)

    def settle(self, effect: Effect, name: str) -> Any:
        """The value of one parameter: a map is read, a distribution is drawn. Raises InputError for a bad map."""
        key = f"chip/{self.chip_seed}/{effect.name}/{name}"
        return settle(effect.parameters[name], getattr(effect, name), self.layout.shape, key)

    def at(self, stage: str) -> list[Effect]:
        """The effects of one stage, in order."""
        return [e for e in self.effects if e.stage == stage]

    def effect(self, name: str) -> Effect | None:
        """The effect of that name, or None."""
        return next((e for e in self.effects if e.name == name), None)

    @cached_property
    def block(self) -> int:
        """Images that must be simulated together: 1, or `BLOCK` where an effect does not count its draws."""
        return 1 if all(e.counted or not _draws(e) for e in self.effects) else BLOCK

    @cached_property
    def dead_times(self) -> np.ndarray:
        """(pixels,) s during which a pixel is blind after a detection; 0 without a dead time."""
        longest = np.zeros(self.layout.pixels)
        for effect in self.at("dead_time"):
            blind = np.asarray(self._call(effect, "blind_time"))
            if blind.shape not in ((), longest.shape) or blind.dtype.kind not in "fiu" or not np.all(blind >= 0):
                raise _wrong(effect, f"blind_time must return seconds, one value or {len(longest)}, not negative")
            longest = np.maximum(longest, blind)
        return longest

    @cached_property
    def tick(self) -> float:
        """Length of a converter's tick, s; 0 without one. Found out by an empty batch that passes the timing stage."""
        none = np.zeros(0, np.uint64)
        probe = Events(np.zeros(0), np.zeros(1, np.int64), self.layout.pixels)
        for effect in self.at("timing"):
            rng = Draws(np.zeros(3, np.uint64), none) if effect.counted else np.random.Generator(np.random.SFC64(0))
            probe = self._checked(effect, self._call(effect, "apply", probe, rng), probe)
        return probe.tick or 0.0

    def nominal_pdp(self, wavelength: float | None) -> float:
        """The PDP that an estimator is told: the datasheet's, so the median where it varies over the array."""
        effect = self.effect("detection")
        return 1.0 if effect is None else float(np.median(effect.pdp_at(wavelength)))  # type: ignore[attr-defined]

    @cached_property
    def nominal_dead_time(self) -> float:
        """The dead time that an estimator is told, s: the median where it varies over the array."""
        return float(np.median(self.dead_times))

    # --- rates ---------------------------------------------------------------------------------------------------

    def rates(self, photons: np.ndarray, conditions: Conditions) -> tuple[np.ndarray, np.ndarray]:
        """(rate of all avalanches' seeds, the light's part), 1/s, from photons/s; each (images, pixels)."""
        rate = photons
        for stage in ("light", "detection"):
            for effect in self.at(stage):
                rate = self._rate(effect, rate, conditions)
        light = rate
        for effect in self.at("dark"):
            rate = self._rate(effect, rate, conditions)
        return rate, light

    def _rate(self, effect: Effect, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        after = self._call(effect, "apply", rate, conditions)
        if not isinstance(after, np.ndarray) or after.shape != rate.shape or after.dtype != np.float64:
            what = f"{after.dtype} of shape {after.shape}" if isinstance(after, np.ndarray) else type(after).__name__
            raise _wrong(effect, f"apply must return float64 rates of shape {rate.shape}, not {what}")
        if after.size and not 0 <= after.min() <= after.max() < np.inf:
            raise _wrong(effect, "apply returns a rate that is negative or not finite")
        return after

    def expected(self, photons: np.ndarray, conditions: Conditions) -> tuple[np.ndarray, np.ndarray]:
        """Expected (candidates before the dead time, recorded detections) per pixel; shapes as `photons`."""
        rate, _ = self.rates(photons, conditions)
        for stage in ("arrival", "gate", "correlated"):
            for effect in self.at(stage):
                rate = effect.expected_rate(rate, conditions)
        candidates = rate
        for stage in ("dead_time", "timing", "readout"):
            for effect in self.at(stage):
                rate = effect.expected_rate(rate, conditions)
        return candidates * conditions.exposure, rate * conditions.exposure

    # --- simulation ----------------------------------------------------------------------------------------------

    def expose(
        self,
        photons: np.ndarray,
        conditions: Conditions,
        streams: Streams,
        readouts: Collection[str],
        staged: bool = False,
    ) -> Recorded:
        """Simulate images.

        photons: (images, pixels of the layout) photons/s on each pixel's active area (a colour image is one image a
        channel); streams: of the same images; readouts: of `tr`, `str`, `qis`. Where `block` is more than 1 the
        images are whole blocks. staged: take the staged line even where the fused one would serve.

        Raises EffectError where an effect's own code fails or returns what it must not.
        """
        if not self._settled:
            return self.settled().expose(photons, conditions, streams, readouts, staged)
        if photons.ndim != 2 or photons.shape[1] != self.layout.pixels or len(photons) != len(streams.images):
            raise ValueError(
                f"photons of shape {photons.shape} for {len(streams.images)} images of {self.layout.pixels} pixels"
            )
        if self.is_paper_line and not staged and (self.tick > 0 or set(readouts) == {"qis"}):
            return self._fused(photons, conditions, streams, readouts)
        step = self.block
        if step == 1:
            brightest = float(photons.mean()) * conditions.exposure * photons.shape[1]
            step = max(1, min(256, int(_EVENTS_AT_ONCE / (brightest + photons.shape[1]))))
        parts = [
            self._staged(photons[i : i + step], conditions, streams.of(streams.images[i : i + step]), readouts)
            for i in range(0, len(photons), step)
        ]
        return Recorded.join(parts)

    @cached_property
    def is_paper_line(self) -> bool:
        """By the paper's rules, nothing follows the Poisson draw but afterpulsing, a dead time and a converter."""
        later = [e for e in self.effects if e.stage not in ("light", "detection", "dark")]
        kinds = [type(e) for e in later]
        return self.rules == "paper" and set(kinds) <= {Afterpulsing, DeadTime, Tdc} and len(set(kinds)) == len(kinds)

    def _fused(
        self, photons: np.ndarray, conditions: Conditions, streams: Streams, readouts: Collection[str]
    ) -> Recorded:
        pixels = photons.shape[1]
        rate, _ = self.rates(photons, conditions)
        trap = self.effect("afterpulsing")
        tick = self.tick
        none = no_detection(conditions.frame_time, tick) if tick > 0 else 1
        stamped = unsigned_for(conditions.exposure / tick, "TR stamps") if tick > 0 else np.uint32
        framed = "str" in readouts or "qis" in readouts
        ticks, offsets, counts, span, bits, first, first_offsets, ones, waited = kernels.paper_line(
            np.ascontiguousarray(rate),
            conditions.exposure,
            streams.images,
            streams.key("photons and dark counts"),
            trap.hazards(pixels) if isinstance(trap, Afterpulsing) else np.zeros(pixels),
            trap.lifetime if isinstance(trap, Afterpulsing) else 0.0,
            streams.key("afterpulsing"),
            self.dead_times,
            tick,
            conditions.frames,
            conditions.frame_time,
            conditions.frame_period,
            none,
            "tr" in readouts,
            framed,
            "str" in readouts,
            np.empty(0, stamped),
            np.empty(0, unsigned_for(none, "STR stamps") if tick > 0 else np.float64),
        )
        recorded = Recorded(pixels)
        if "tr" in readouts:
            recorded = Recorded(pixels, Events(None, offsets, pixels, ticks, tick), counts, span)
        if framed:
            stamps = Events(None, first_offsets, pixels, first, tick) if "str" in readouts else None
            frames = Frames(bits, stamps, conditions.frames, conditions.frame_time, pixels)
            waits = waited if "str" in readouts else None
            recorded = Recorded(pixels, recorded.tr, recorded.counts, recorded.span, frames, ones, waits)
        return recorded

    def _staged(
        self, photons: np.ndarray, conditions: Conditions, streams: Streams, readouts: Collection[str]
    ) -> Recorded:
        rate, light = self.rates(photons, conditions)
        pixels = photons.shape[1]
        events = self._arrivals(rate, light, conditions, streams)
        events = self._gate(events, conditions)
        dead_times = np.tile(self.dead_times, len(photons))
        framed = "str" in readouts or "qis" in readouts
        if self.rules == "paper":
            candidates = self._with_children(events, conditions, streams, dead_times)
            detected = candidates
            if "tr" in readouts and dead_times.any():
                kept = kernels.non_paralyzable(candidates.times, candidates.offsets, dead_times[:pixels])
                detected = Events(candidates.times[kept], kernels.take(candidates.offsets, kept), pixels)
        else:
            latent = self._latent(events, conditions, streams, dead_times)
            detected = latent.fired(dead_times, conditions, frames=False) if "tr" in readouts else events
            candidates = latent.fired(dead_times, conditions, frames=True) if framed else events
        tr, frames = None, None
        if "tr" in readouts:
            for stage in ("timing", "readout"):
                for effect in self.at(stage):
                    detected = self._apply(effect, detected, streams)
            tr = self._narrow(detected, conditions.exposure, "TR stamps")
        if framed:
            frames = self._frames(candidates, conditions, streams, "str" in readouts)
        return summarised(pixels, tr, frames)

    def _arrivals(self, rate: np.ndarray, light: np.ndarray, conditions: Conditions, streams: Streams) -> Events:
        """The Poisson draw; what is no constant rate is drawn at its maximum and thinned."""
        pixels = rate.shape[1]
        varying = self.at("arrival")
        if not varying:
            key = streams.key("photons and dark counts")
            times, offsets = kernels.arrivals(np.ascontiguousarray(rate), conditions.exposure, streams.images, key)
            return Events(times, offsets, pixels)
        parts = {"light": light, "dark": rate - light}
        largest: dict[str, float] = {}
        most = dict(parts)
        for effect in varying:
            top = self._call(effect, "maximum", conditions)
            if not isinstance(top, (int, float, np.floating)) or not 0 <= top < np.inf:
                raise _wrong(effect, f"maximum must return one finite number, not negative; it returns {top!r}")
            largest[effect.name] = float(top)
            most[effect.acts_on] = most[effect.acts_on] * float(top)
        drawn = most["light"] + most["dark"]
        key = streams.key("photons and dark counts")
        times, offsets = kernels.arrivals(np.ascontiguousarray(drawn), conditions.exposure, streams.images, key)
        events = Events(times, offsets, pixels)
        rows = events.rows
        now = {kind: part.ravel()[rows] for kind, part in parts.items()}
        for effect in varying:
            factor = np.asarray(self._call(effect, "factor", times, conditions))
            if factor.shape not in ((), times.shape) or factor.dtype.kind not in "fiu":
                raise _wrong(effect, f"factor must return one number per time, {times.shape}, not {factor.shape}")
            top = largest[effect.name]
            if not np.all((factor >= 0) & (factor <= top * (1 + 1e-9))):
                raise _wrong(effect, f"factor must lie between 0 and the maximum it states, {top:g}")
            now[effect.acts_on] = now[effect.acts_on] * factor
        share = (now["light"] + now["dark"]) / drawn.ravel()[rows]
        chance = kernels.uniforms(offsets, pixels, streams.images, streams.key("thinning"))
        return events.keep(chance < share)

    def _gate(self, events: Events, conditions: Conditions) -> Events:
        return events.keep(self._open(events.times, conditions)) if self.at("gate") else events

    def _open(self, times: np.ndarray, conditions: Conditions) -> np.ndarray:
        """(events,) bool: can a pixel fire at these times?"""
        mask = np.ones(times.shape, bool)
        for effect in self.at("gate"):
            one = np.asarray(self._call(effect, "open", times, conditions))
            if one.dtype != bool or one.shape != times.shape:
                raise _wrong(effect, f"open must return one bool per time, {times.shape}, not {one.dtype} {one.shape}")
            mask &= one
        return mask

    def _spawn(
        self, effect: Effect, events: Events, streams: Streams, dead_times: np.ndarray, suffix: str = ""
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(times, rows, parents) of an effect's children; in the parent's own pixel the dead time comes first."""
        children = self._call(effect, "spawn", events, self._rng(effect, streams, suffix))
        if not isinstance(children, Children):
            raise _wrong(effect, f"spawn must return Children, not {type(children).__name__}")
        parent, delay = np.asarray(children.parent), np.asarray(children.delay, np.float64)
        good = parent.ndim == 1 and parent.shape == delay.shape and (parent.dtype.kind in "iu" or not len(parent))
        if not good or (len(parent) and (parent.min() < 0 or parent.max() >= len(events) or not np.all(delay >= 0))):
            raise _wrong(
                effect, f"children need a parent among the {len(events)} events and a delay that is not negative"
            )
        parent = parent.astype(np.int64)
        home = np.searchsorted(events.offsets, parent, side="right") - 1
        rows = home
        if children.row is not None:
            rows = np.asarray(children.row)
            if (
                rows.shape != home.shape
                or rows.dtype.kind not in "iu"
                or np.any(rows // events.pixels != home // events.pixels)
            ):
                raise _wrong(effect, "the row of a child must be a whole number, and a pixel of its parent's own image")
            rows = rows.astype(np.int64)
        times = events.times[parent] + (np.where(rows == home, dead_times[home], 0.0) + delay)
        return times, rows, parent

    def _with_children(
        self, events: Events, conditions: Conditions, streams: Streams, dead_times: np.ndarray
    ) -> Events:
        """Rules of the paper: every event has its children, whether or not it will be recorded; they have none."""
        times, rows = [], []
        for effect in self.at("correlated"):
            t, r, _ = self._spawn(effect, events, streams, dead_times)
            inside = t < conditions.exposure
            times.append(t[inside])
            rows.append(r[inside])
        if not times or not sum(map(len, times)):
            return events
        extra, extra_rows = np.concatenate(times), np.concatenate(rows).astype(np.int64)
        order = np.argsort(extra_rows, kind="stable")
        merged, offsets, _ = kernels.merge(events.times, events.offsets, extra[order], extra_rows[order])
        return self._gate(Events(merged, offsets, events.pixels), conditions)

    def _latent(self, events: Events, conditions: Conditions, streams: Streams, dead_times: np.ndarray) -> _Latent:
        """Rules of a device: everything that may happen, generation after generation."""
        rows = len(events.offsets) - 1
        times, row_of, parents = [events.times], [events.rows], [np.full(len(events), -1, np.int64)]
        current, index = events, np.arange(len(events))
        known = len(events)
        for generation in range(_GENERATIONS):
            found = [
                self._spawn(effect, current, streams, dead_times, f"/generation {generation}" if generation else "")
                for effect in self.at("correlated")
            ]
            if not found:
                break
            t, r, p = (np.concatenate(column) for column in zip(*found, strict=True))
            inside = (t < conditions.exposure) & self._open(t, conditions)
            t, r, p = t[inside], r[inside], p[inside]
            if not len(t):
                break
            order = np.lexsort((t, r))
            t, r, p = t[order], r[order], p[order]
            times.append(t)
            row_of.append(r)
            parents.append(index[p])
            index = known + np.arange(len(t))
            known += len(t)
            offsets = np.concatenate([[0], np.cumsum(np.bincount(r, minlength=rows))]).astype(np.int64)
            current = Events(t, offsets, events.pixels)
        else:
            raise SpadError(
                f"the cascade of avalanches does not end ({_GENERATIONS} generations); "
                "lower the probabilities of the correlated effects"
            )
        return _Latent(np.concatenate(times), np.concatenate(row_of), np.concatenate(parents), rows, events.pixels)

    def _frames(self, events: Events, conditions: Conditions, streams: Streams, stamped: bool) -> Frames:
        pixels = events.pixels
        out = np.empty(len(events) + 1)
        bits, offsets = kernels.frame_readout(
            events.times,
            events.offsets,
            conditions.frames,
            conditions.frame_time,
            conditions.frame_period,
            out,
        )
        first = None
        if stamped:
            stamps = out[: offsets[-1]]
            # a row for each frame: its one stamp stays its own, whatever a timing effect does with it
            pixel = Events(stamps, offsets, pixels).pixel
            first = Events(stamps, np.arange(len(stamps) + 1), pixels, row_pixel=pixel)
            for effect in self.at("timing"):
                first = self._apply(effect, first, streams, "/frames")
            if len(first) != len(stamps):
                raise _wrong(self.at("timing")[-1], "apply must not add or remove stamps")
            ticks, tick = first.ticks, first.tick
            if ticks is not None and tick is not None:
                # what rounds to the end of the frame would mean 'none'
                ticks = np.minimum(ticks, np.uint64(no_detection(conditions.frame_time, tick) - 1))
            first = Events(None if ticks is not None else first.times, offsets, pixels, ticks, tick)
            first = self._narrow(first, conditions.frame_time, "STR stamps")
        return Frames(bits, first, conditions.frames, conditions.frame_time, pixels)

    def _narrow(self, events: Events, end: float, what: str) -> Events:
        if events.ticks is None or events.tick is None:
            return events
        kind = unsigned_for(end / events.tick, what)
        if len(events.ticks) and int(events.ticks.max()) > np.iinfo(kind).max:
            raise SpadError(f"{what}: a stamp of {int(events.ticks.max())} ticks does not fit {np.dtype(kind)}")
        return Events(None, events.offsets, events.pixels, events.ticks.astype(kind, copy=False), events.tick)

    # --- calling effects ------------------------------------------------------------------------------------------

    def _rng(self, effect: Effect, streams: Streams, suffix: str = "") -> Any:
        name = effect.name + suffix
        return Draws(streams.key(name), streams.images) if effect.counted else streams.generator(name)

    def _call(self, effect: Effect, hook: str, *arguments: Any) -> Any:
        method: Callable[..., Any] = getattr(effect, hook)
        try:
            return method(*arguments)
        except (SpadError, InputError):
            raise
        except Exception as error:
            raise blame(effect, error) from error

    def _apply(self, effect: Effect, events: Events, streams: Streams, suffix: str = "") -> Events:
        """A hook from Events to Events; what it returns is checked where it is not one of our own kernels."""
        return self._checked(effect, self._call(effect, "apply", events, self._rng(effect, streams, suffix)), events)

    def _checked(self, effect: Effect, after: Any, events: Events) -> Events:
        if not effect.counted:
            wrong = after.problem() if isinstance(after, Events) else f"it is a {type(after).__name__}, not Events"
            if not wrong and len(after.offsets) != len(events.offsets):
                wrong = f"it has {len(after.offsets) - 1} rows, not {len(events.offsets) - 1}"
            if wrong:
                raise _wrong(effect, f"what apply returns cannot be used: {wrong}")
        return after


@dataclass(frozen=True)
class _Latent:
    """Avalanches that may happen, with the one that would cause each (-1: none)."""

    times: np.ndarray
    rows: np.ndarray
    parents: np.ndarray
    n_rows: int
    pixels: int

    def fired(self, dead_times: np.ndarray, conditions: Conditions, frames: bool) -> Events:
        """Those that happen: the parent did, and the pixel was not blind."""
        # a cause lies in the same image, and earlier: one pass in time order, image by image
        order = np.lexsort((self.times, self.rows // self.pixels))
        period = conditions.frame_period if frames else 0.0
        fired = kernels.avalanches(
            self.times, self.rows, self.parents, order, dead_times, period, conditions.frame_time
        )
        times, rows = self.times[fired], self.rows[fired]
        sort = np.lexsort((times, rows))
        offsets = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=self.n_rows))]).astype(np.int64)
        return Events(times[sort], offsets, self.pixels)


def _wrong(effect: Effect, what: str) -> EffectError:
    return EffectError(f"{source_file(type(effect))}: the effect {effect.name}: {what}")


def _draws(effect: Effect) -> bool:
    """Does an effect's hook take random numbers?"""
    return effect.stage in ("correlated", "timing", "readout")
