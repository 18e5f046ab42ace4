"""A sensor: pixels, effects and a chip; and the line from photons to readouts.

`Sensor.expose` is the whole simulation. There are two ways through it, which give the same events bit for bit: the
staged line takes a batch through one stage after the other and serves every sensor; where a sensor has nothing
beyond the paper's line, `kernels.paper_line` does the same, image by image, in one go.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from . import bit_planes, kernels, units
from .effects import Chip, Conditions, Effect, in_order
from .effects.afterpulsing import Afterpulsing
from .effects.dead_time import DeadTime
from .effects.tdc import Tdc
from .errors import EffectError, InputError, SpadError, did_you_mean
from .events import Children, Events, Layout
from .foreign import html_table, visible
from .plugins import blame, check_values, described, resolve, source_file
from .readout import Frames, Recorded, counts_type, no_detection, summarised, unsigned_for
from .streams import BLOCK, Draws, Streams
from .window import Window

BYTES_PER_EVENT = 50  # of what is simulated at once (measured: 20 to 70, by the effects that there are)
_EVENTS_AT_ONCE = 200_000  # expected events of a sub-batch: its buffers stay in the processor's cache
_MOST_AT_ONCE = 1e8  # expected events that are simulated at once: 4 GB of memory, and more with every effect there is
_MOST_EVENTS = 2e9  # of an image that is simulated part by part
_EVENTS_OF_A_PART = 4e6  # expected events of an image from which on it is simulated part by part, and of each part
_GENERATIONS = 10_000
_CHILDREN = 200  # times the events that they come from: more is a cascade without end
_NONE = np.zeros(0)
_NO_EVENT = np.zeros(0, bool)
RULES = "paper", "device"  # what an event may cause: as in the paper, or as in a real pixel
_NOBODY = np.zeros(0, np.int64)
_HOPS = 2  # from pixel to pixel, in a cascade: what comes into a window by more of them is left out


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
            self._call(effect, "made", Chip(self.layout, self.chip_seed, effect.name, tick, origin))
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
        for key, value in values.items():
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
        return [e for e in self.effects if not e.counted and _draws(e)]

    @cached_property
    def dead_times(self) -> np.ndarray:
        """(pixels,) s during which a pixel is blind after a detection; 0 without a dead time."""
        if self.chip is not None and self.window is not None:
            return self.chip.dead_times[self.window.pixels] if self._apart is None else self._apart.dead_times
        longest = np.zeros(self.layout.pixels)
        for effect in self.at("dead_time"):
            if not hasattr(effect, "blind_time"):
                continue
            blind = np.asarray(self._call(effect, "blind_time"))
            if blind.shape not in ((), longest.shape) or blind.dtype.kind not in "fiu" or not np.all(blind >= 0):
                raise _wrong(effect, f"blind_time must return seconds, one value or {len(longest)}, not negative")
            longest = np.maximum(longest, blind)
        return longest

    @cached_property
    def causes(self) -> tuple[str, ...]:
        """What can make an event, in the order of the numbers in `Events.cause`; the first is a photon."""
        makers = (e for e in self.effects if e.stage in ("dark", "correlated") or e.acts_on == "own")
        return tuple(dict.fromkeys(["photon", *(e.cause for e in makers)]))

    @cached_property
    def _converter(self) -> tuple[float, float] | None:
        """(tick s, origin in ticks) as the last effect that turns times into numbers says, or None."""
        told = [self._call(e, "converter") for e in self.at("timing") if hasattr(e, "converter")]
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

    def expected(
        self, photons: np.ndarray, conditions: Conditions, stamped: bool = True
    ) -> tuple[np.ndarray, np.ndarray]:
        """Expected (candidates before the dead time, recorded detections) per pixel; shapes as `photons`.

        stamped: time stamps are recorded, of which a readout may lose some; otherwise each pixel counts for itself.
        """
        photons, conditions = conditions.lit(photons)
        if self.chip is not None and self.window is not None:
            if self._apart is not None:
                return self._apart.expected(photons, conditions, stamped)
            there = self.chip.expected(self.window.spread(photons), conditions, stamped)
            return there[0][:, self.window.pixels], there[1][:, self.window.pixels]
        rate, light = self.rates(photons, conditions)
        dark = rate - light
        for effect in self.at("arrival"):
            if effect.acts_on == "light":
                light = self._call(effect, "expected_rate", light, conditions)
            else:
                dark = self._call(effect, "expected_rate", dark, conditions)
        rate = light + dark if self.at("arrival") else rate
        for stage in ("gate", "correlated"):
            for effect in self.at(stage):
                rate = self._call(effect, "expected_rate", rate, conditions)
        candidates = rate
        for stage in ("dead_time", "timing", "readout") if stamped else ("dead_time",):
            for effect in self.at(stage):
                rate = self._call(effect, "expected_rate", rate, conditions)
        return candidates * conditions.live_time, rate * conditions.live_time

    def caused(self) -> dict[str, float]:
        """Events that come directly of one event, averaged over the array, by the effect that makes them."""
        one = np.ones((1, self.layout.pixels))
        clock = Conditions(1.0, 1, 1.0, 1.0, None)
        return {e.name: float(np.mean(self._call(e, "expected_rate", one, clock))) - 1 for e in self.at("correlated")}

    def drawn(self, photons: np.ndarray, conditions: Conditions, readouts: Collection[str]) -> float:
        """Expected candidates that `expose` has at once for such images, those around a part of a chip among them."""
        photons, conditions = conditions.lit(photons)
        if self.chip is None or self.window is None:
            return float(self.expected(photons, conditions)[0].sum())
        there, _ = self.chip.expected(self.window.spread(photons), conditions)
        return float(there[:, self.chip._lively(self.window, readouts)].sum())

    def _lively(self, window: Window, readouts: Collection[str]) -> np.ndarray:
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
            hooks = [hook for hook, readout in acting.items() if readout in readouts and hasattr(effect, hook)]
            if effect.stage == "readout" and not hooks:
                continue
            reach = self._call(effect, "influence")
            if not isinstance(reach, (int, float, np.floating)) or not reach >= 0:
                raise _wrong(effect, f"influence must return pitches, not negative, or inf; it returns {reach!r}")
            yield effect, float(reach)

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
                parts.append(line._staged(light, conditions, own, readouts, causes, self.window))
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
        made = (line._staged(light, conditions, streams, readouts, causes, piece) for piece in pieces)
        return Recorded.joined_pixels(made, photons.shape[1])

    @cached_property
    def is_paper_line(self) -> bool:
        """By the paper's rules, nothing follows the Poisson draw but afterpulsing, a dead time and a converter."""
        later = [e for e in self.effects if e.stage not in ("light", "detection", "dark")]
        kinds = [type(e) for e in later]
        plain = not self._extends and (self._converter is None or self._converter[1] == -0.5)
        known = set(kinds) <= {Afterpulsing, DeadTime, Tdc} and len(set(kinds)) == len(kinds)
        return self.rules == "paper" and known and plain

    @cached_property
    def _extends(self) -> bool:
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
            tally = self._summed(bits, conditions, None) if "counts" in readouts else None
            if not {"str", "qis"} & set(readouts):
                return Recorded(pixels, recorded.tr, recorded.counts, recorded.span, tally=tally)
            recorded = Recorded(pixels, recorded.tr, recorded.counts, recorded.span, frames, ones, waits, tally)
        return recorded

    def _staged(
        self,
        photons: np.ndarray,
        conditions: Conditions,
        streams: Streams,
        readouts: Collection[str],
        causes: bool,
        window: Window | None,
    ) -> Recorded:
        """The line, stage by stage; of a window alone where there is one, for photons on the whole chip."""

        def seen(events: Events) -> Events:
            return events if window is None else events.of_rows(window.rows(len(photons)), len(window.pixels))

        lively = None if window is None else self._lively(window, readouts)
        pixels = photons.shape[1] if window is None else len(window.pixels)
        events = self._gate(self._arrivals(photons, conditions, streams, causes, lively), conditions)
        candidates, parents = self._family(events, conditions, streams, causes)
        tr, frames, tally = None, None, None
        counter = "counts" in readouts and conditions.counting == "counter"
        if "tr" in readouts or counter:
            needed = self._needed(candidates, streams)
        if counter:
            asleep = self._asleep(candidates.times, conditions)
            counted = self._fired(candidates, parents, needed, asleep)
            tally = self._counted(seen(counted), conditions, window)
        if "tr" in readouts:
            detected = self._fired(candidates, parents, needed)
            detected.end = conditions.exposure
            for stage in ("timing", "readout"):
                for effect in self.at(stage):
                    if hasattr(effect, "apply"):
                        detected = self._apply(effect, detected, streams)
            tr = self._narrow(seen(detected), conditions.exposure, "TR stamps")
        if {"str", "qis"} & set(readouts) or ("counts" in readouts and not counter):
            detected = self._fired_in_frames(candidates, parents, conditions)
            frames = self._frames(seen(detected), conditions, streams, "str" in readouts, window)
            if "counts" in readouts and not counter:
                tally = self._summed(frames.bits, conditions, window)
            if not {"str", "qis"} & set(readouts):
                frames = None
        return summarised(pixels, tr, frames, tally)

    def _summed(self, bits: np.ndarray, conditions: Conditions, window: Window | None) -> np.ndarray:
        """(rows, count frames) sums of binary frames."""
        most = conditions.largest_count
        out = np.empty((len(bits), conditions.count_frames), counts_type(most))
        bit_planes.sums_of_frames(bits, most, out)
        return self._limited(out, window)

    def _counted(self, events: Events, conditions: Conditions, window: Window | None) -> np.ndarray:
        """(rows, frames) what a counter in each pixel has at the end of each frame."""
        most = conditions.largest_count
        out = np.zeros((len(events.offsets) - 1, conditions.frames), counts_type(most))
        clock = conditions.frame_time, conditions.frame_period
        kernels.counts_in_frames(events.times, events.offsets, *clock, most, out)
        return self._limited(out, window)

    def full_counts(self, conditions: Conditions) -> np.ndarray:
        """The largest count of each pixel in a count frame, (pixels,)."""
        most = conditions.largest_count
        counts = np.full((self.layout.pixels, 1), most, counts_type(most))
        return np.asarray(self._limited(counts, None)[:, 0], np.float64)

    def _limited(self, counts: np.ndarray, window: Window | None) -> np.ndarray:
        limits = [effect for effect in self.at("readout") if hasattr(effect, "limit")]
        if not limits:
            return counts
        if window is not None:
            images = len(counts) // len(window.pixels)
            whole = np.zeros((images * self.layout.pixels, counts.shape[1]), counts.dtype)
            whole[window.rows(images)] = counts
            counts = whole
        for effect in limits:
            after = self._call(effect, "limit", counts)
            if not isinstance(after, np.ndarray) or (after.shape, after.dtype) != (counts.shape, counts.dtype):
                raise _wrong(effect, f"limit must return counts of shape {counts.shape} and type {counts.dtype}")
            counts = after
        return counts if window is None else counts[window.rows(images)]

    def _arrivals(
        self, photons: np.ndarray, conditions: Conditions, streams: Streams, causes: bool, lively: np.ndarray | None
    ) -> Events:
        """The Poisson draw; what is no constant rate is drawn at its maximum and thinned.

        lively: (pixels,) bool, where anything happens at all; None: everywhere.
        """
        rate, light = self.rates(photons, conditions)
        if lively is not None:
            rate, light = rate * lively, light * lively
        varying = self.at("arrival")
        drawn = rate
        # (what it is, its rate) of the parts that vary each in its own way
        parts = [("light", light), ("dark", rate - light)]
        if varying:
            maxima = dict.fromkeys(("light", "dark"), 1.0)
            for effect in varying:
                if effect.acts_on == "own":
                    added = np.asarray(self._call(effect, "added", conditions), np.float64)
                    good = added.shape in ((), rate.shape[1:]) and bool(np.all((added >= 0) & (added < np.inf)))
                    if not good:
                        raise _wrong(effect, f"added must return 1/s, one value or {rate.shape[1]}, not negative")
                    own = np.broadcast_to(added, rate.shape)
                    parts.append((effect.name, own if lively is None else own * lively))
                else:
                    maxima[effect.acts_on] *= self._maximum(effect, conditions)
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
                factor = self._factor(effect, events, conditions, streams)
                factors[kind] = factors[kind] * factor if kind in factors else factor
            now = np.zeros(len(times))
            for kind, part in parts:
                kernels.weigh(now, offsets, part.ravel(), factors.get(kind, _NONE))
            rng = streams.draws("thinning", len(events))
            images = events.image_offsets, rng.images
            kept = kernels.thinned(now, offsets, drawn.ravel(), *images, rng.key, rng.before)
            events = events.keep(kept)
            factors = {kind: factor[kept] for kind, factor in factors.items()} if causes else {}
        if causes:
            events.cause = self._attributed(events, photons, parts, factors, conditions, streams)
            events.parent = np.full(len(events), -1, np.int64)
        return events

    def _maximum(self, effect: Effect, conditions: Conditions) -> float:
        top = self._call(effect, "maximum", conditions)
        if not isinstance(top, (int, float, np.floating)) or not 0 <= top < np.inf:
            raise _wrong(effect, f"maximum must return one finite number, not negative; it returns {top!r}")
        return float(top)

    def _factor(self, effect: Effect, events: Events, conditions: Conditions, streams: Streams) -> np.ndarray:
        """(events,) what an arrival effect multiplies its part of the rate by."""
        if hasattr(effect, "modulate"):
            rng = self._rng(effect, streams, events)
            factor = np.asarray(self._call(effect, "modulate", events, conditions, rng))
        else:
            factor = np.asarray(self._call(effect, "factor", events.times, conditions))
        hook = "modulate" if hasattr(effect, "modulate") else "factor"
        shape = events.times.shape
        if factor.shape not in ((), shape) or factor.dtype.kind not in "fiub":
            raise _wrong(effect, f"{hook} must return one number per time, {shape}, not {factor.shape}")
        top = 1.0 if effect.acts_on == "own" else self._maximum(effect, conditions)
        if factor.size and not (factor.min() >= 0 and factor.max() <= top * (1 + 1e-9)):
            raise _wrong(effect, f"{hook} must lie between 0 and the maximum it states, {top:g}")
        return np.ascontiguousarray(np.broadcast_to(factor, shape), np.float64)

    def _attributed(
        self,
        events: Events,
        photons: np.ndarray,
        parts: list[tuple[str, np.ndarray]],
        factors: dict[str, np.ndarray],
        conditions: Conditions,
        streams: Streams,
    ) -> np.ndarray:
        """(events,) what made each: drawn in proportion to the rates at its time, for the draw does not say."""
        shares: list[tuple[str, str, np.ndarray]] = [("photon", "light", parts[0][1])]
        rate = parts[0][1]
        for effect in self.at("dark"):
            after = self._rate(effect, rate, conditions)
            shares.append((effect.cause, "dark", np.maximum(after - rate, 0.0)))
            rate = after
        for effect in self.at("arrival"):
            if effect.acts_on == "own":
                part = next(part for kind, part in parts if kind == effect.name)
                shares.append((effect.cause, effect.name, part))
        rng = streams.draws("causes", len(events))
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
        codes = np.array([self.causes.index(cause) for cause, _, _ in shares], np.uint8)
        return codes[chosen]

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
        self, effect: Effect, events: Events, streams: Streams, suffix: str
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(times, rows, parents) of an effect's children; in the parent's own pixel the dead time comes first."""
        children = self._call(effect, "spawn", events, self._rng(effect, streams, events, suffix))
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
        dead_times = self.dead_times[home % events.pixels]
        times = events.times[parent] + (np.where(rows == home, dead_times, 0.0) + delay)
        return times, rows, parent

    def _family(
        self, events: Events, conditions: Conditions, streams: Streams, causes: bool
    ) -> tuple[Events, np.ndarray]:
        """The events with all that they may cause, and the parent of each (empty where there is none to look at).

        By the paper's rules every event has its children, whether or not it will be recorded, and they have none. By
        a device's, children have children; which of them happen is decided later, when it is known what fires.
        """
        cascade = self.rules == "device"
        correlated = self.at("correlated")
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
            found = [self._spawn(effect, current, streams, suffix) for effect in correlated]
            made = [np.full(len(t), self.causes.index(e.cause)) for (t, _, _), e in zip(found, correlated, strict=True)]
            t, r, p = (np.concatenate(column) for column in zip(*found, strict=True))
            inside = t < conditions.exposure
            inside[inside] = self._open(t[inside], conditions)
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
        out = Events(merged, offsets, events.pixels, end=conditions.exposure)
        linked = kernels.relinked(len(events), before, order, parents) if cascade or causes else _NOBODY
        if causes and events.cause is not None:
            out.cause = np.insert(events.cause, before, made_by[order].astype(np.uint8))
            out.parent = linked
        return out, linked if cascade else _NOBODY

    def _asleep(self, times: np.ndarray, conditions: Conditions) -> np.ndarray:
        """(events,) bool: do they fall between the frames of a counter, where nothing fires; empty where none does."""
        if self.rules == "paper" or conditions.frame_period <= conditions.frame_time:
            return _NO_EVENT
        return times - np.floor(times / conditions.frame_period) * conditions.frame_period >= conditions.frame_time

    def _fired(self, events: Events, parents: np.ndarray, needed: np.ndarray, asleep: np.ndarray = _NO_EVENT) -> Events:
        """Those of the candidates that happen: the parent did, and the pixel was neither blind nor asleep.

        needed: see `_needed`; asleep: (events,) bool, empty where none is.
        """
        if not (self.soft or self._extends or len(parents) or len(asleep)):
            if not self.dead_times.any():
                return events
            if events.cause is None:
                kept = kernels.non_paralyzable(events.times, events.offsets, self.dead_times)
                return Events(events.times[kept], kernels.take(events.offsets, kept), events.pixels)
        own = events.times, events.offsets, parents, self.dead_times, needed, self._extends
        return events.keep(kernels.avalanches(*own, 0.0, 0.0, 0.0, asleep))

    def _fired_in_frames(self, events: Events, parents: np.ndarray, conditions: Conditions) -> Events:
        """Those of the candidates that happen in binary frames, each of which begins anew."""
        if self.rules == "paper" and self._carried == 0:
            return events
        own = events.times, events.offsets, parents, self.dead_times, _NONE, self._extends
        clock = conditions.frame_period, conditions.frame_time, self._carried
        return events.keep(kernels.avalanches(*own, *clock, _NO_EVENT))

    @cached_property
    def soft(self) -> list[Effect]:
        """The effects that let a pixel wake up slowly."""
        return [e for e in self.at("dead_time") if hasattr(e, "sensitivity")]

    @cached_property
    def _carried(self) -> float:
        """Share of the remaining blind time with which a pixel enters the next frame."""
        shares = [(e, self._call(e, "carried")) for e in self.at("dead_time") if hasattr(e, "carried")]
        for effect, share in shares:
            if not isinstance(share, (int, float, np.floating)) or not 0 <= share <= 1:
                raise _wrong(effect, f"carried must return a share from 0 to 1, not {share!r}")
        return max((float(share) for _, share in shares), default=0.0)

    def _needed(self, events: Events, streams: Streams) -> np.ndarray:
        """(events,) s that the pixel must have been awake for each to fire; empty where none needs any.

        A pixel whose sensitivity has come up to S fires with probability S: each event draws a number, and fires if
        the sensitivity has reached it. Only what follows another event closely can find a pixel half awake.
        """
        if not self.soft:
            return _NONE
        needed = np.zeros(len(events))
        for effect in self.soft:
            longest = float(self._recovered(effect, np.array([1 - 2.0**-53]))[0])
            close = kernels.followers(events.times, events.offsets, self.dead_times + longest)
            rng = streams.draws(f"{effect.name}/sensitivity", len(events))
            chance = kernels.uniforms(close, events.image_offsets, rng.images, rng.key, rng.before)
            needed[close] = np.maximum(needed[close], self._recovered(effect, chance))
        return needed

    def _recovered(self, effect: Effect, chance: np.ndarray) -> np.ndarray:
        """s after the blind time at which an effect's sensitivity reaches `chance`."""
        if hasattr(effect, "recovered"):
            out = np.asarray(self._call(effect, "recovered", chance), np.float64)
            if out.shape != chance.shape or not np.all(out >= 0):
                raise _wrong(effect, f"recovered must return seconds, {chance.shape}, not negative")
            return out
        # by bisection on a scale that reaches from a femtosecond to an hour
        low, high = np.zeros(chance.shape), np.full(chance.shape, 3600.0)
        for step in range(120):
            middle = np.sqrt(np.maximum(low, 1e-15) * high) if step < 60 else (low + high) / 2
            value = np.asarray(self._call(effect, "sensitivity", middle))
            if value.shape != chance.shape or not np.all((value >= 0) & (value <= 1)):
                raise _wrong(effect, f"sensitivity must return numbers from 0 to 1, {chance.shape}")
            reached = value >= chance
            high = np.where(reached, middle, high)
            low = np.where(reached, low, middle)
        return high

    def _frames(
        self, events: Events, conditions: Conditions, streams: Streams, stamped: bool, window: Window | None
    ) -> Frames:
        pixels = events.pixels
        if events.cause is not None:
            # the first of each frame alone: then each has its bit and its stamp
            events = events.keep(kernels.first_of_frames(events.times, events.offsets, *_clock(conditions)))
        out = np.empty(len(events) + 1)
        bits, offsets = kernels.frame_readout(
            events.times,
            events.offsets,
            *_clock(conditions),
            out,
        )
        first = None
        if stamped:
            stamps = out[: offsets[-1]]
            # a row for each frame: its one stamp stays its own, whatever a timing effect does with it
            rows = Events(stamps, offsets, pixels)
            first = Events(
                stamps,
                np.arange(len(stamps) + 1),
                self.layout.pixels,
                row_pixel=rows.pixel if window is None else window.pixels[rows.pixel],
                end=conditions.frame_time,
                image_offsets=rows.image_offsets,
            )
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
        frames, frame_time = conditions.frames, conditions.frame_time
        return Frames(bits, first, frames, frame_time, pixels, events.cause, events.parent)

    def _narrow(self, events: Events, end: float, what: str) -> Events:
        if events.ticks is None or events.tick is None:
            return events
        kind = unsigned_for(end / events.tick, what)
        if len(events.ticks) and int(events.ticks.max()) > np.iinfo(kind).max:
            raise SpadError(f"{what}: a stamp of {int(events.ticks.max())} ticks does not fit {np.dtype(kind)}")
        return events.stamped(events.ticks.astype(kind, copy=False), events.tick)

    # --- calling effects ------------------------------------------------------------------------------------------

    def _rng(self, effect: Effect, streams: Streams, events: Events, suffix: str = "") -> Any:
        name = effect.name + suffix
        return streams.draws(name, len(events)) if effect.counted else streams.generator(name)

    def _call(self, effect: Effect, hook: str, *arguments: Any) -> Any:
        method: Callable[..., Any] = getattr(effect, hook)
        try:
            return method(*arguments)
        except (SpadError, InputError):
            raise
        except Exception as error:
            raise blame(type(effect), error) from error

    def _apply(self, effect: Effect, events: Events, streams: Streams, suffix: str = "") -> Events:
        """A hook from Events to Events; what it returns is checked where it is not one of our own kernels."""
        rng = self._rng(effect, streams, events, suffix)
        return self._checked(effect, self._call(effect, "apply", events, rng), events)

    def _checked(self, effect: Effect, after: Any, events: Events) -> Events:
        if not effect.counted:
            end = events.end
            if end is not None and len(events):  # a clock that rounds to the nearest tick may have reached the end
                end = max(end, float(np.nextafter(events.times.max(), np.inf)))
            wrong = after.problem(end) if isinstance(after, Events) else f"it is a {type(after).__name__}, not Events"
            if not wrong and len(after.offsets) != len(events.offsets):
                wrong = f"it has {len(after.offsets) - 1} rows, not {len(events.offsets) - 1}"
            if not wrong and events.cause is not None and (after.cause is None or len(after.cause) != len(after)):
                wrong = "the causes of the events are gone; use events.keep, events.moved or events.stamped"
            if wrong:
                raise _wrong(effect, f"what apply returns cannot be used: {wrong}")
        return after


def _clock(conditions: Conditions) -> tuple[int, float, float]:
    return conditions.frames, conditions.frame_time, conditions.frame_period


def _wrong(effect: Effect, what: str) -> EffectError:
    return EffectError(f"{source_file(type(effect))}: the effect {effect.name}: {what}")


def _draws(effect: Effect) -> bool:
    """Does an effect's hook take random numbers?"""
    return effect.stage in ("correlated", "timing", "readout") or hasattr(effect, "modulate")


def _end(after: Events, events: Events) -> float | None:
    """Where the times must end; a stamp may be rounded up to it."""
    return None if after.ticks is not None else events.end
