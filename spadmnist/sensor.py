"""A sensor: pixels, effects and a chip; its expected rates, and its recordings.

`Sensor.expose` is the whole simulation. There are two ways through it, which give the same events bit for bit: the
staged line (`line`) takes a batch through one stage after the other and serves every sensor; where a sensor has nothing
beyond the paper's line, `kernels.paper_line` does the same, image by image, in one go.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from . import gates, hooks, kernels, units
from .effects import Chip, Conditions, Effect, in_order
from .effects.afterpulsing import Afterpulsing
from .effects.dead_time import DeadTime
from .effects.tdc import Tdc
from .errors import InputError, did_you_mean
from .events import Events, Layout
from .foreign import html_table, visible
from .line import Line, limited, summed
from .plugins import check_values, described, resolve
from .readout import Frames, Recorded, counts_type, no_detection, unsigned_for
from .streams import BLOCK, Draws, Streams
from .window import Window

BYTES_PER_EVENT = 50  # of what is simulated at once (measured: 20 to 70, by the effects that there are)
_EVENTS_AT_ONCE = 200_000  # expected events of a sub-batch: its buffers stay in the processor's cache
_MOST_AT_ONCE = 1e8  # expected events that are simulated at once: 4 GB of memory, and more with every effect there is
_MOST_EVENTS = 2e9  # of an image that is simulated part by part
_EVENTS_OF_A_PART = 4e6  # expected events of an image from which on it is simulated part by part, and of each part
_NONE = np.zeros(0)
RULES = "paper", "device"  # what an event may cause: as in the paper, or as in a real pixel
# of a cascade of detections that cause others, in the closed forms, at least and at most; each costs as much time as
# the rest. At least: the third adds 1e-6 where each causes a hundredth. At most: a rule of thumb
_GENERATIONS, _MOST_GENERATIONS = 2, 30
_OF_A_PIXEL = 12  # generations of a cascade in one pixel, which are quick: the same for a part of a chip
_LEFT_OUT = 1e-5  # of the events: so many may come of later generations; a fiftieth of the error of other closed forms
_MOMENTS = 1 << 16  # at which products of factors and gates are averaged: 3e-4 at worst, some ms
_NO_CHANGE = 3e-4  # relative: a product of means is left as it is where that of the moments is nearer; their error
_FEW_FRAMES = 16  # from which on moments are as many in each frame; a rule of thumb
_GOLDEN = (math.sqrt(5) - 1) / 2
_HARDLY = 16  # where gates are open for less than this part of the time, so many times as many moments; a rule of thumb
_HOPS = 2  # from pixel to pixel, in a cascade: what comes into a window by more of them is left out


def factor(effect: Effect, times: np.ndarray, conditions: Conditions) -> np.ndarray:
    """(moments,) the factor of an arrival effect that is a curve; times: (moments,) s since the start."""
    found = np.asarray(hooks.call(effect, "factor", times, conditions), np.float64)
    return np.broadcast_to(np.ravel(found) if found.ndim else found, times.shape)


def _even(conditions: Conditions, number: int) -> np.ndarray:
    """About so many moments of the recorded time, s since the start; as many in each frame, where it has several."""
    c = conditions
    if c.live is None or not _FEW_FRAMES <= c.frames <= _HARDLY * number:
        return c.moments(number)
    each, frame = max(number // c.frames, 1), np.arange(c.frames)[:, None]
    within = (np.arange(each) + np.modf((frame + 0.5) * _GOLDEN)[0]) / each  # in no step with what is periodic
    return np.ravel(frame * c.frame_period + within * c.live)


def _check_effect(effect: object) -> None:
    if not isinstance(effect, Effect):
        what = repr(effect) if isinstance(effect, str | type) else f"an object of type {type(effect).__name__}"
        raise InputError(
            f"{what} is not an effect; give one with its values, for example effects.DarkCounts(rate=100.0)"
        )


@dataclass(repr=False)
class Sensor:
    """Layout, effects and chip seed. The effects' values may still be distributions and files; see `resolved`.

    rules: `paper` or `device` (physics of the readouts: what fills traps, and what a frame sees).
    chip, window: where this is a part of a chip (`cropped`), the whole of it, resolved, and the part.
    """

    layout: Layout
    effects: list[Effect]
    rules: str = "paper"
    chip_seed: int = 0
    name: str = ""
    _resolved: bool = field(default=False, repr=False)
    chip: Sensor | None = field(default=None, repr=False)
    window: Window | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.layout, Layout):
            raise InputError(
                f"layout is {self.layout!r:.80}; it is a spadmnist.Layout(rows, columns, area, fill factor)"
            )
        if self.rules not in RULES:
            known = " or ".join(map(repr, RULES))
            raise InputError(f"rules is {self.rules!r}; it is {known}.{did_you_mean(str(self.rules), RULES)}")
        whole = isinstance(self.chip_seed, int | np.integer) and not isinstance(self.chip_seed, bool)
        if not whole or self.chip_seed < 0:
            raise InputError(f"chip_seed is {self.chip_seed!r}; it is a whole number from 0 on")
        if not isinstance(self.effects, list | tuple):
            raise InputError(
                f"effects is {self.effects!r:.80}; it is a list of effects, [effects.DarkCounts(rate=100)]"
            )
        names: set[str] = set()
        for effect in self.effects:
            _check_effect(effect)
            if effect.name in names:
                raise InputError(f"the sensor lists {effect.name} twice; an effect is listed once")
            names.add(effect.name)

    def __getstate__(self) -> dict[str, Any]:
        """Its fields, without what was computed of them: a worker gets no maps that it does not ask for."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    def resolved(self) -> Sensor:
        """The same sensor with every map read and every distribution drawn. Raises InputError for a bad map."""
        if self._resolved:
            return self
        if self.chip is not None and self.window is not None:
            own = {"rules": self.rules, "chip_seed": self.chip_seed, "name": self.name}
            return self.chip.changed(effects=[self._on_chip(e) for e in self.effects], **own)._seen_in(self.window)
        effects = [
            type(effect)(**{name: self.resolve(effect, name) for name in effect.parameters})
            for effect in in_order(self.effects)
        ]
        sensor = replace(self, effects=effects, _resolved=True)
        for effect in effects:
            tick, origin = sensor._converter or (0.0, 0.0)
            hooks.call(effect, "made", Chip(self.layout, self.chip_seed, effect.name, tick, origin))
        return sensor

    def changed(self, **fields: Any) -> Sensor:
        """The same sensor, or the same part of it, with other `effects` or another `chip_seed`, resolved."""
        return replace(self, **fields, _resolved=False).resolved()

    def with_effect(self, effect: Effect) -> Sensor:
        """The same sensor with one effect more, resolved. Raises InputError where it lists it, or for a wrong value."""
        _check_effect(effect)
        if self.effect(effect.name) is not None:
            named = next(iter(effect.parameters), "parameter")
            raise InputError(
                f"the sensor lists {effect.name} already; another value of it: "
                f'with_values({{"{effect.name}.{named}": ...}})'
            )
        check_values(effect)
        return self.changed(effects=[*self.effects, effect])

    def without(self, effect: str) -> Sensor:
        """The same sensor without an effect, resolved. Raises InputError where it does not list it."""
        self._listed(effect)
        return self.changed(effects=[e for e in self.effects if e.name != effect])

    def with_values(self, values: Mapping[str, Any]) -> Sensor:
        """The same sensor with other values, resolved.

        values: `"effect.parameter"` -> a number in SI, or a map, (pixels,) or (rows, columns). Raises InputError for
        what the sensor does not list, or a value that is not possible.
        """
        given: dict[str, dict[str, Any]] = {}
        example = '{"dark_counts.rate": 250.0}'
        if not isinstance(values, Mapping):
            raise InputError(f"values are {values!r:.80}; they are a dictionary, {example}")
        for key, value in values.items():
            if not isinstance(key, str):
                raise InputError(f'the key {key!r:.80} is no name; write "effect.parameter", {example}')
            name, _, parameter = key.partition(".")
            listed = self._listed(name)
            if parameter not in listed.parameters:
                hint = did_you_mean(parameter, listed.parameters)
                raise InputError(f"{key}: {name} has {', '.join(listed.parameters) or 'no parameters'}.{hint}")
            given.setdefault(name, {})[parameter] = value
        effects = []
        for effect in self.effects:
            own = {name: getattr(effect, name) for name in effect.parameters}
            effects.append(type(effect)(**{**own, **given.get(effect.name, {})}))
            check_values(effects[-1])
        return self.changed(effects=effects)

    def _listed(self, name: str) -> Effect:
        effect = self.effect(name)
        if effect is None:
            known = [e.name for e in self.effects]
            add = "; with_effect adds one" if name in Effect.registry else ""
            raise InputError(f"the sensor lists no {name}, but {', '.join(known)}{add}.{did_you_mean(name, known)}")
        return effect

    def rows(self) -> list[tuple[str, str, str, str]]:
        """(stage, effect, parameter, value with its unit) of every parameter, in the order of the stages."""
        return [
            (effect.stage, effect.name, name, described(declared, getattr(effect, name)))
            for effect in in_order(self.effects)
            for name, declared in effect.parameters.items()
        ] or [("", "no effects", "", "")]

    def _title(self) -> str:
        at = self.layout
        area = (
            "" if np.isnan(at.pixel_area) else f" of {units.show(at.pixel_area, 'm^2')}, fill factor {at.fill_factor:g}"
        )
        part = f", {self.window}" if self.window else ""
        return f"Sensor {self.name or '(no name)'}: {at.rows} x {at.columns} pixels{area}, rules: {self.rules}{part}"

    def __repr__(self) -> str:
        rows = [tuple(map(visible, row)) for row in (("stage", "effect", "parameter", "value"), *self.rows())]
        widths = [max(len(row[i]) for row in rows) for i in range(4)]
        lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        return "\n".join([visible(self._title()), *lines])

    def _repr_html_(self) -> str:
        return html_table(self._title(), ("stage", "effect", "parameter", "value"), self.rows())

    def cropped(self, rows: slice, columns: slice) -> Sensor:
        """The part of the chip in these rows and columns, resolved; of pixels that are listed one by one, of one row.

        Its maps and what is drawn from `chip_seed` are the whole chip's, cut, and all its physics is that of the chip:
        each effect is made for the whole array, sees the rates and events of the whole array, and knows of no window.
        Light and parameters that are stated for the part alone go on beyond its edges, where the chip has none of its
        own (`Window`). Exact are all rates, closed forms and effects that stay in their pixel. Of the pixels around
        the part as many are simulated as can matter (`Effect.influence`; with a shared bus, all): by the paper's rules
        that is exact, too; by a device's, what needs more than 2 hops from pixel to pixel to come into the part is left
        out, about the cube of the chance of one. With the whole chip's rows and columns it is the sensor itself.

        Raises InputError where the rows or columns are none, or reach beyond the sensor.
        """
        window = Window.of(self.layout.shape, rows, columns)
        if window.shape == window.whole:
            return self.resolved()
        chip = self.resolved()
        if chip.chip is not None and chip.window is not None:
            return chip.chip._seen_in(window.within(chip.window))
        return chip._seen_in(window)

    def _seen_in(self, window: Window) -> Sensor:
        """A part of this chip, which is resolved."""
        effects = [window.effect(effect) for effect in self.effects]
        return replace(self, layout=window.layout(self.layout), effects=effects, chip=self, window=window)

    def _on_chip(self, effect: Effect) -> Effect:
        """An effect of the window with its values on the whole chip, which keeps its own elsewhere."""
        assert self.chip is not None and self.window is not None
        there = self.chip.effect(effect.name)
        values = {
            name: self.window.filled(declared, getattr(effect, name), getattr(there, name, None))
            for name, declared in effect.parameters.items()
        }
        return type(effect)(**values)

    def resolve(self, effect: Effect, name: str) -> Any:
        """The value of one parameter: a map is read, a distribution is drawn. Raises InputError for a bad map."""
        key = f"chip/{self.chip_seed}/{effect.name}/{name}"
        rows, columns = self.layout.shape
        pixels = rows * columns
        codes = int(getattr(effect, "period", 1))
        shapes: dict[str, tuple[tuple[int, ...], ...]] = {
            "pixel": ((rows, columns), (pixels,)),
            "row": ((rows,),),
            "column": ((columns,),),
            "code": ((codes,), (-1,), (pixels, -1)),
            "": (),
        }
        declared = effect.parameters[name]
        return resolve(declared, getattr(effect, name), shapes[declared.per], key)

    def at(self, stage: str) -> list[Effect]:
        """The effects of one stage, in order."""
        return [e for e in self.effects if e.stage == stage]

    def effect(self, name: str) -> Effect | None:
        """The effect of that name, or None."""
        return next((e for e in self.effects if e.name == name), None)

    @cached_property
    def _apart(self) -> Sensor | None:
        """A part of a chip as a sensor of its own, whose closed forms are the same, at the cost of its pixels alone;
        None where an effect's closed form needs the whole chip (`Effect.by_pixel`).
        """
        if not all(effect.by_pixel for effect in self.effects):
            return None
        effects = [type(e)(**{name: getattr(e, name) for name in e.parameters}) for e in self.effects]
        return replace(self, effects=effects, chip=None, window=None, _resolved=False).resolved()

    @cached_property
    def block(self) -> int:
        """Images that must be simulated together: 1, or `BLOCK` where an effect does not count its draws."""
        return BLOCK if self.uncounted else 1

    @cached_property
    def uncounted(self) -> list[Effect]:
        """The effects whose hooks take random numbers and do not count them."""
        return [e for e in self.effects if not e.counted and hooks.draws(e)]

    @cached_property
    def dead_times(self) -> np.ndarray:
        """(pixels,) s during which a pixel is blind after a detection; 0 without a dead time."""
        if self.chip is not None and self.window is not None:
            return self.chip.dead_times[self.window.pixels] if self._apart is None else self._apart.dead_times
        longest = np.zeros(self.layout.pixels)
        for effect in self.at("dead_time"):
            if hasattr(effect, "blind_time"):
                longest = np.maximum(longest, hooks.blind_time(effect, len(longest)))
        return longest

    @cached_property
    def causes(self) -> tuple[str, ...]:
        """What can make an event, in the order of the numbers in `Events.cause`; the first is a photon."""
        makers = (e for e in self.effects if e.stage in ("dark", "correlated") or e.acts_on == "own")
        return tuple(dict.fromkeys(["photon", *(e.cause for e in makers)]))

    @cached_property
    def _converter(self) -> tuple[float, float] | None:
        """(tick s, origin in ticks) as the last effect that turns times into numbers says, or None."""
        told = [hooks.call(e, "converter") for e in self.at("timing") if hasattr(e, "converter")]
        return told[-1] if told else None

    @property
    def origin(self) -> float:
        """Where a converter's tick 0 begins, s: minus half a tick where times are rounded to the nearest one."""
        return 0.0 if self._converter is None else self._converter[1] * self._converter[0]

    @cached_property
    def tick(self) -> float:
        """Length of a converter's tick, s; 0 without one.

        Where no effect tells (`converter`), it is found out by an empty batch that passes the timing stage.
        """
        if self._converter is not None:
            return self._converter[0]
        if self.chip is not None:
            return self.chip.tick
        none = np.zeros(0, np.uint64)
        probe = Events(np.zeros(0), np.zeros(1, np.int64), self.layout.pixels)
        for effect in self.at("timing"):
            rng = Draws(np.zeros(3, np.uint64), none) if effect.counted else np.random.Generator(np.random.SFC64(0))
            probe = hooks.checked(effect, hooks.call(effect, "apply", probe, rng), probe)
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
        if not self._resolved:
            return self.resolved().rates(photons, conditions)
        photons, conditions = conditions.lit(photons)
        if self.chip is not None and self.window is not None:
            # by this very rule: one that a subclass has set is upon what it finds here
            if self._apart is not None:
                return Sensor.rates(self._apart, photons, conditions)
            there = Sensor.rates(self.chip, self.window.spread(photons), conditions)
            return there[0][:, self.window.pixels], there[1][:, self.window.pixels]
        rate = photons
        for stage in ("light", "detection"):
            for effect in self.at(stage):
                rate = hooks.rate(effect, rate, conditions)
        light = rate
        for effect in self.at("dark"):
            rate = hooks.rate(effect, rate, conditions)
        return rate, light

    def expected(
        self, photons: np.ndarray, conditions: Conditions, stamped: bool = True, first: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Expected (candidates before the dead time, recorded detections) per pixel; shapes as `photons`.

        stamped: time stamps are recorded, of which a readout may lose some; otherwise each pixel counts for itself.
        first: of each frame the first detection alone is recorded; under `rules: device` it alone reaches other pixels.
        """
        if not self._resolved:
            return self.resolved().expected(photons, conditions, stamped, first)
        photons, conditions = conditions.lit(photons)
        if self.chip is not None and self.window is not None:
            if self._apart is not None:
                return self._apart.expected(photons, conditions, stamped, first)
            there = self.chip.expected(self.window.spread(photons), conditions, stamped, first)
            return there[0][:, self.window.pixels], there[1][:, self.window.pixels]
        rate, light = self.rates(photons, conditions)
        parts = {"light": light, "dark": rate - light, "own": np.zeros_like(rate)}
        for effect in self.at("arrival"):
            parts[effect.acts_on] = hooks.expected(effect, parts[effect.acts_on], conditions)
        together = self._together(conditions)
        parts = {kind: part * together[kind] if kind in together else part for kind, part in parts.items()}
        rate = sum(parts.values()) if self.at("arrival") else rate
        on_average = rate
        for effect in self.at("gate"):
            on_average = hooks.expected(effect, on_average, conditions)
        if "open" in together:
            on_average = on_average * together["open"]
        # Where all detections count, they are those of an opening. Of a frame that records its first event alone, the
        # number of events in it counts.
        opened: np.ndarray | None = None  # the share of the time
        if on_average is not rate:
            opened = np.divide(on_average, rate, out=np.ones_like(rate), where=rate > 0)
        # by a device's rules nothing fires in the gaps between frames: each begins alive, as an opening does
        opening: np.ndarray | None = None  # s in each frame
        if opened is not None or (self.rules == "device" and conditions.live is not None):
            opening = np.asarray((1.0 if opened is None else opened) * conditions.live_time / conditions.frames)
        if first:
            candidates = self._with_children(on_average, opening, conditions, first)
            rate = candidates
            for effect in self.at("dead_time"):
                rate = hooks.expected(effect, rate, conditions)
            opened = None
        elif self.rules == "device" and self.at("correlated"):
            candidates, rate = self._in_cascades(rate, opening, conditions)
        else:
            candidates = self._with_children(rate, opening, conditions, first)
            rate = self._recorded(candidates, opening, conditions)
        for stage in ("timing", "readout") if stamped else ():
            for effect in self.at(stage):
                rate = self._read_out(effect, rate, opened, opening, conditions)
        live = conditions.live_time if opened is None else opened * conditions.live_time
        return candidates * live, rate * live

    def _read_out(
        self,
        effect: Effect,
        rate: np.ndarray,
        opened: np.ndarray | None,
        opening: np.ndarray | None,
        conditions: Conditions,
    ) -> np.ndarray:
        """The detections behind an effect, 1/s while gates are open.

        Of a load of openings it takes what it takes of a steady one, and what it holds at their ends; and no more than
        of the load on average.
        """
        steady = hooks.expected(effect, rate, conditions)
        if effect.backlog() == 0 or opened is None or opening is None:
            return steady
        averaged = hooks.expected(effect, rate * opened, conditions) / np.maximum(opened, 1e-300)
        events = (steady * opening).sum(axis=-1, keepdims=True)
        return np.asarray(np.minimum(averaged, steady * (1 + effect.backlog() / np.maximum(events, 1e-300))))

    @property
    def states_mean(self) -> bool:
        """Whether the closed forms of all effects say what these do to the mean; of a backlog of a gate, roughly."""
        held = self.at("gate") and any(effect.backlog() > 0 for effect in self.effects)
        return not held and all(effect.states_mean for effect in self.effects)

    def _together(self, conditions: Conditions) -> dict[str, float]:
        """The means of products over the products of the means, where more than one effect follows the time.

        Of the factors on the "light" and on the "dark" rate, while all gates are open, and of the gates, "open"; none
        that is 1.
        """
        curves = [e for e in self.at("arrival") if hasattr(e, "factor")]
        if len(curves) + len(self.at("gate")) < 2:
            return {}
        if conditions not in self._products:
            self._products[conditions] = self._means_together(curves, conditions)
        return self._products[conditions]

    @cached_property
    def _products(self) -> dict[Conditions, dict[str, float]]:
        return {}

    def _means_together(self, curves: list[Effect], conditions: Conditions) -> dict[str, float]:
        times, opened = self._moments(conditions, _MOMENTS)
        if not opened.any():
            return {}
        found = {}
        if alone := [float(hooks.is_open(e, times, conditions).mean()) for e in self.at("gate")]:
            found["open"] = float(opened.mean()) / math.prod(alone)
        for kind in ("light", "dark"):
            factors = [factor(e, times, conditions) for e in curves if e.acts_on == kind]
            apart = math.prod(float(one.mean()) for one in factors)
            product = math.prod(factors, start=np.ones(1 if not factors else len(times)))
            if factors and apart > 0:
                found[kind] = float(product[opened].mean()) / apart
        return {kind: by for kind, by in found.items() if abs(by - 1) > _NO_CHANGE}

    def _moments(self, conditions: Conditions, number: int) -> tuple[np.ndarray, np.ndarray]:
        """(even moments of the recorded time, s; whether all gates are open then), more where they hardly ever are."""
        clock = conditions
        if clock.live is None and math.isclose(clock.frames * clock.frame_period, clock.exposure):
            clock = replace(clock, live=clock.frame_period)  # even in each frame
        for more in (1, _HARDLY):
            times = _even(clock, number * more)
            opened = np.ones(len(times), bool)
            for effect in self.at("gate"):
                opened &= hooks.is_open(effect, times, conditions)
            if np.count_nonzero(opened) * _HARDLY >= number:
                break
        return times, opened

    def open_moments(self, conditions: Conditions, number: int) -> np.ndarray:
        """(number,) or fewer even moments at which detections are recorded, s since the start, of open gates."""
        times, opened = self._moments(conditions, number)
        for more in (_HARDLY, _HARDLY**2) if self.at("gate") else ():
            if np.count_nonzero(opened) < number:
                times, opened = self._moments(conditions, number * more)
        times = times[opened] if opened.any() else times
        return (
            times if len(times) <= number else times[(np.modf(np.arange(number) * _GOLDEN)[0] * len(times)).astype(int)]
        )

    def _recorded(self, candidates: np.ndarray, opening: np.ndarray | None, conditions: Conditions) -> np.ndarray:
        """The detections of so many candidates while recorded, 1/s; opening: s of each frame, None without an end."""
        rate = candidates
        for effect in self.at("dead_time"):
            rate = hooks.expected(effect, rate, conditions)
        if opening is not None and self.at("dead_time"):
            rate = gates.detected(candidates, rate, opening, conditions, self.extends)
        return rate

    def _with_children(
        self, rate: np.ndarray, opening: np.ndarray | None, conditions: Conditions, first: bool
    ) -> np.ndarray:
        """The candidates that all events cause, or, of frames, some of them their first ones; 1/s."""
        for effect in self.at("correlated"):
            if self.rules == "device" and 0 < effect.influence() < math.inf:
                more = self._reached(effect, rate, conditions)
            else:
                more = hooks.expected(effect, rate, conditions) - rate
            rate = rate + more * self._staying(effect, opening, conditions)
        return rate

    def _in_cascades(
        self, rate: np.ndarray, opening: np.ndarray | None, conditions: Conditions
    ) -> tuple[np.ndarray, np.ndarray]:
        """(candidates, detections), 1/s, where recorded detections alone cause events, and what they cause does, too.

        A child in its parent's pixel finds it blind less often than others do: the pixel is awake as its time begins.
        That enters as more children, which is exact to the first order in their number.
        """
        local = []
        for effect in self.at("correlated"):
            if effect.influence() < math.inf:
                local.append((effect, self._staying(effect, opening, conditions)))
            else:
                rate = hooks.expected(effect, rate, conditions)
        candidates = counted = rate
        for _ in range(self.generations if local else 0):
            cause = self._recorded(counted, opening, conditions)
            before, candidates, counted = candidates, rate, rate
            for effect, stays in local:
                more = (hooks.expected(effect, cause, conditions) - cause) * stays
                candidates = candidates + more
                counted = counted + more * self._awake(effect, before)
        return candidates, self._recorded(counted, opening, conditions)

    def _awake(self, effect: Effect, rate: np.ndarray) -> np.ndarray | float:
        """How many times as often as others the children of an effect find their pixel awake; rate: of all events.

        A pixel that is awake now is so after an exponential time of mean t with the chance 1 / (1 + rate t (1 -
        exp(-dead time / t))), by the Laplace transform of the renewal equation, and at any time with 1 / (1 + rate dead
        time). Where events extend the dead time both are alike. Source: Cox, Renewal Theory (1962), ch. 7.
        """
        mean = effect.mean_delay()
        if mean is None or effect.influence() > 0 or self.extends or not self.dead_times.any():
            return 1.0
        dead = self.dead_times
        some = mean * -np.expm1(-dead / mean) if mean > 0 else 0.0
        return np.asarray((1 + rate * dead) / (1 + rate * some))

    def _staying(self, effect: Effect, opening: np.ndarray | None, conditions: Conditions) -> np.ndarray | float:
        """The share of an effect's children that fall into a time that is recorded: before the end, into an opening.

        One number, or (pixels,).
        """
        mean = effect.mean_delay()
        if mean is None:
            return 1.0
        least, pixel = np.zeros(1), np.zeros(1, np.int64)
        if effect.influence() == 0:  # of their own pixel, whose dead time comes first
            least, pixel = np.unique(self.dead_times, return_inverse=True)
        stays = gates.before_the_end(least, mean, conditions.exposure)
        if opening is not None and opening.size:
            # a gate is open for as long in all pixels; without any rate it says nothing
            live = float(f"{opening.min():.10g}")
            stays = stays * gates.again(live, conditions.exposure / conditions.frames, least, mean)
        return stays[pixel] if len(least) > 1 else float(stays[0])

    def _reached(self, effect: Effect, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """What an effect causes in other pixels where the first detection of a frame alone causes it; 1/s."""
        frame = conditions.live_time / conditions.frames
        more = np.zeros_like(rate)
        for _ in range(_GENERATIONS):
            cause = -np.expm1(-(rate + more) * frame) / frame
            more = hooks.expected(effect, cause, conditions) - cause
        return more

    @cached_property
    def generations(self) -> int:
        """Generations of a cascade that the closed forms have: what is left out is less than 1e-5 of the events, where
        a detection causes less than 0.7 others, or 0.4 in its own pixel alone.
        """
        if all(effect.influence() == 0 for effect in self.at("correlated")):
            return _OF_A_PIXEL
        caused = min(max(sum(self.caused().values()), 1e-9), 0.99)
        return min(max(math.ceil(math.log(_LEFT_OUT) / math.log(caused)) - 1, _GENERATIONS), _MOST_GENERATIONS)

    def caused(self) -> dict[str, float]:
        """Events that come directly of one event, averaged over the array, by the effect that makes them."""
        one = np.ones((1, self.layout.pixels))
        clock = Conditions(1.0, 1, 1.0, 1.0, None)
        return {e.name: float(np.mean(hooks.expected(e, one, clock))) - 1 for e in self.at("correlated")}

    def drawn(self, photons: np.ndarray, conditions: Conditions, readouts: Collection[str]) -> float:
        """Expected candidates that `expose` has at once for such images, those around a part of a chip among them."""
        photons, conditions = conditions.lit(photons)
        if self.chip is None or self.window is None:
            return float(self.expected(photons, conditions)[0].sum())
        there, _ = self.chip.expected(self.window.spread(photons), conditions)
        return float(there[:, self.chip.lively(self.window, readouts)].sum())

    def lively(self, window: Window, readouts: Collection[str]) -> np.ndarray:
        """(pixels,) bool: which pixels of this chip must be simulated, lest a window of it lack what they do to it."""
        far = {True: 0.0, False: 0.0}  # in a correlated effect's way, and in any other
        for effect, reach in self._reaches(readouts):
            kind = effect.stage == "correlated"
            far[kind] = max(far[kind], reach)
        return window.around(self.layout, far[True] * (_HOPS if self.rules == "device" else 1) + far[False])

    def _reaches(self, readouts: Collection[str]) -> Iterator[tuple[Effect, float]]:
        """Each effect that acts on one of the readouts, and how far (pitches) its events matter."""
        acting = {"apply": "tr", "limit": "counts"}  # by the hook of a readout effect
        for effect in self.effects:
            acts = any(readout in readouts and hasattr(effect, hook) for hook, readout in acting.items())
            if effect.stage == "readout" and not acts:
                continue
            yield effect, hooks.influence(effect)

    def tying(self, readouts: Collection[str]) -> str | None:
        """What ties the pixels together, so that all of an image must be simulated at once; None where nothing does.

        An effect whose events reach other pixels, or one whose draws are not counted: they are drawn for all pixels in
        one go. By its name.
        """
        if self.chip is not None:
            return self.chip.tying(readouts)
        tied = [effect.name for effect, reach in self._reaches(readouts) if reach > 0]
        return next(iter([*tied, *(e.name for e in self.uncounted)]), None)

    def at_once(self, events: float, readouts: Collection[str]) -> float:
        """Expected events that are simulated at once, of an image of so many."""
        return events if self.tying(readouts) else min(events, _EVENTS_OF_A_PART)

    def excess(self, photons: np.ndarray, conditions: Conditions, readouts: Collection[str]) -> str | None:
        """What is too much to be simulated of such images together, as "3e+09 events, more than ..."; None: nothing.

        photons: (images, pixels) photons/s. Too much is what 4 GB of memory do not hold of what is simulated at once:
        all pixels where something ties them together, else one. And what takes minutes, part by part.
        """
        events = self.drawn(photons, conditions, readouts)
        shown = f"{events:.3g} events ({events / photons.size:.3g} a pixel), more than"
        if not events <= _MOST_EVENTS:
            return f"{shown} the {_MOST_EVENTS:.0e} that can be simulated"
        if self.is_paper_line or events <= _MOST_AT_ONCE:
            return None
        if tied := self.tying(readouts):
            how = "draws for all pixels in one go" if tied in [e.name for e in self.uncounted] else "ties all pixels"
            return f"{shown} the {_MOST_AT_ONCE:.0e} that can be simulated at once, as they must: {tied} {how}"
        pixel = float(self.expected(photons, conditions)[0].max())
        if pixel > _MOST_AT_ONCE:
            return f"{pixel:.3g} events in a pixel, more than the {_MOST_AT_ONCE:.0e} that can be simulated at once"
        return None

    # --- simulation ----------------------------------------------------------------------------------------------

    def expose(
        self,
        photons: np.ndarray,
        conditions: Conditions,
        streams: Streams,
        readouts: Collection[str],
        staged: bool = False,
        causes: bool = False,
        most: float | None = None,
    ) -> Recorded:
        """Simulate images.

        photons: (images, pixels of the layout) photons/s on each pixel's active area (a colour image is one image a
        channel); streams: of the same images; readouts: of `tr`, `str`, `qis`, `counts`. Where `block` is more than 1
        the images are whole blocks. staged: take the staged line even where the fused one would serve. causes: say of
        every event what made it (`Events.cause`, `Events.parent`); it changes no event. most: an image of more expected
        events is simulated part by part where nothing ties its pixels together (`tying`); that changes nothing, either.

        Raises EffectError where an effect's own code fails or returns what it must not.
        """
        if not self._resolved:
            return self.resolved().expose(photons, conditions, streams, readouts, staged, causes, most)
        if photons.ndim != 2 or photons.shape[1] != self.layout.pixels or len(photons) != len(streams.images):
            raise ValueError(
                f"photons of shape {photons.shape} for {len(streams.images)} images of {self.layout.pixels} pixels"
            )
        photons, conditions = conditions.lit(photons)
        stamped = bool({"tr", "str"} & set(readouts))
        counter = "counts" in readouts and conditions.counting == "counter"
        part = self.chip is not None
        if self.is_paper_line and not (part or staged or causes or counter or (stamped and self.tick == 0)):
            return self._fused(photons, conditions, streams, readouts)
        line = self.chip or self
        step = self.block
        if step == 1:
            brightest = float(photons.mean()) * conditions.exposure * photons.shape[1] if photons.size else 0.0
            step = max(1, min(256, int(_EVENTS_AT_ONCE / (brightest + line.layout.pixels))))
        tied, most = self.tying(readouts), _EVENTS_OF_A_PART if most is None else most
        parts = []
        for i in range(0, max(1, len(photons)), step):
            some = slice(i, i + step)
            expected = _NONE if tied else self.expected(photons[some], conditions)[0]
            if tied or expected.sum() <= most:
                light = photons[some] if self.window is None else self.window.spread(photons[some])
                own = streams.of(streams.images[some])
                parts.append(Line(line, conditions, own, causes, self.window).run(light, readouts))
                continue
            for image, wanted in zip(range(i, i + step), expected, strict=False):
                own = streams.of(streams.images[image : image + 1])
                parts.append(
                    self._by_parts(photons[image : image + 1], wanted, most, conditions, own, readouts, causes)
                )
        return Recorded.join(parts)

    def _by_parts(
        self,
        photons: np.ndarray,
        expected: np.ndarray,
        most: float,
        conditions: Conditions,
        streams: Streams,
        readouts: Collection[str],
        causes: bool,
    ) -> Recorded:
        """One image, some of its pixels after the other; expected: (pixels,) events, of which a part has `most`."""
        line, window = self.chip or self, self.window or Window.of(self.layout.shape, slice(None), slice(None))
        light = photons if self.window is None else self.window.spread(photons)
        pieces = window.pieces(expected, most)
        made = (Line(line, conditions, streams, causes, piece).run(light, readouts) for piece in pieces)
        return Recorded.joined_pixels(made, photons.shape[1])

    @cached_property
    def is_paper_line(self) -> bool:
        """By the paper's rules, nothing follows the Poisson draw but afterpulsing, a dead time and a converter."""
        later = [e for e in self.effects if e.stage not in ("light", "detection", "dark")]
        kinds = [type(e) for e in later]
        plain = not self.extends and (self._converter is None or self._converter[1] == -0.5)
        known = set(kinds) <= {Afterpulsing, DeadTime, Tdc} and len(set(kinds)) == len(kinds)
        return self.rules == "paper" and known and plain

    @cached_property
    def extends(self) -> bool:
        """Does an event that finds its pixel blind make it blind anew?"""
        return any(getattr(e, "extends", False) for e in self.at("dead_time"))

    def _fused(
        self, photons: np.ndarray, conditions: Conditions, streams: Streams, readouts: Collection[str]
    ) -> Recorded:
        pixels = photons.shape[1]
        rate, _ = self.rates(photons, conditions)
        trap = self.effect("afterpulsing")
        tick = self.tick
        none = no_detection(conditions.frame_time, tick) if tick > 0 else 1
        stamped = unsigned_for(conditions.exposure / tick, "TR stamps") if tick > 0 else np.uint32
        framed = bool({"str", "qis", "counts"} & set(readouts))
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
            tally = summed(self, bits, conditions, None) if "counts" in readouts else None
            if not {"str", "qis"} & set(readouts):
                return Recorded(pixels, recorded.tr, recorded.counts, recorded.span, tally=tally)
            recorded = Recorded(pixels, recorded.tr, recorded.counts, recorded.span, frames, ones, waits, tally)
        return recorded

    def full_counts(self, conditions: Conditions) -> np.ndarray:
        """The largest count of each pixel in a count frame, (pixels,)."""
        most = conditions.largest_count
        counts = np.full((self.layout.pixels, 1), most, counts_type(most))
        return np.asarray(limited(self, counts, None)[:, 0], np.float64)

    @cached_property
    def soft(self) -> list[Effect]:
        """The effects that let a pixel wake up slowly."""
        return [e for e in self.at("dead_time") if hasattr(e, "sensitivity")]

    @cached_property
    def carried(self) -> float:
        """Share of the remaining blind time with which a pixel enters the next frame."""
        shares = [hooks.carried(effect) for effect in self.at("dead_time") if hasattr(effect, "carried")]
        return max(shares, default=0.0)
