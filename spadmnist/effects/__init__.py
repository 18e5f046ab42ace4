"""Effects: one class in one file each, at one stage of the line. A file in this folder is found by itself.

A recording is a short line of physics: rates -> one Poisson draw -> avalanches -> recording. The stage of an effect
fixes the order and what its hooks receive:

| stage | the author writes | receives -> returns |
| --- | --- | --- |
| light | apply(rate, conditions) | photons/s, (images, pixels) -> the same |
| detection | apply(rate, conditions) | photons/s -> detections/s |
| dark | apply(rate, conditions) | detections/s -> detections/s |
| arrival | factor(t, conditions), maximum(conditions) | s, (events,) -> factor on the light or on the dark rate |
| | or modulate(events, conditions, rng) | Events -> the same, for what differs by pixel or is drawn |
| gate | open(t, conditions) | s, (events,) -> bool: can the pixel fire? |
| correlated | spawn(events, rng) | Events -> Children |
| dead_time | blind_time() | -> s after a detection, one value or one per pixel |
| | sensitivity(u) | s since the end of the blind time, (n,) -> from 0 to 1, never falling |
| | carried() | -> share of the remaining blind time with which a pixel enters the next frame |
| timing | apply(events, rng) | Events -> Events, with `events.moved(times)` or `events.stamped(ticks, tick)` |
| readout | apply(events, rng) | Events -> Events, with `events.keep(mask)` |
| | limit(counts) | the counts of frames, unsigned -> the same |

An arrival effect acts on the light, or with `acts_on = "dark"` on the dark rate; `maximum` is the largest factor. With
`acts_on = "own"` it brings a rate of its own, `added(conditions)`: 1/s, one value or one per pixel, at its largest.
A timing effect sees TR streams, and the frames' first stamps (STR) with one frame a row, s since its start.
`rng` is a `numpy.random.Generator` of the effect's own for each fixed block of images, or, with `counted = True` on
the class, a `spadmnist.streams.Draws` for the counter-based kernels. An image that is too large to be simulated at once
is simulated part by part, where all effects that draw count their draws and no `influence()` is more than 0.

Every effect may have `made(chip)`: what is fixed when the chip is made (neighbours, which pixels are hit, patterns); it
is called once, after maps are read and distributions drawn. What a hook returns depends on the parameters, on what
`made` fixed and on its arguments alone: one object serves all captures. And `expected_rate(rate, conditions)`, the
closed form of its mean; an arrival effect gets the part of the rate that it acts on, and by default the mean of
`factor` or `open` is taken. And `influence()`, how far its events reach. With `by_pixel = True` on the class, closed
forms of a part of a chip are computed for that part alone: set it where `apply` of rates and `expected_rate` give each
pixel a value that depends on that pixel alone.
"""

from __future__ import annotations

import hashlib
import inspect
import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from .. import plugins
from ..errors import did_you_mean
from ..events import Layout
from ..plugins import ByWavelength, Parameter, Plugin, Registry, parameter
from ..scene import Scene

__all__ = ["STAGES", "ByWavelength", "Chip", "Conditions", "Effect", "Parameter", "parameter"]

# stage -> the hooks of which an effect there must have one (or all of those that are joined by "+")
STAGES: dict[str, tuple[str, ...]] = {
    "light": ("apply",),
    "detection": ("apply",),
    "dark": ("apply",),
    "arrival": ("factor+maximum", "modulate+maximum", "modulate+added"),
    "gate": ("open",),
    "correlated": ("spawn",),
    "dead_time": ("blind_time", "sensitivity", "carried"),
    "timing": ("apply",),
    "readout": ("apply", "limit"),
}

ACTS_ON = ("light", "dark", "own")  # what an arrival effect may vary

# number of times at which the default of `expected_rate` takes its mean. A gate that opens for a third of each of 500
# frames comes out within 2e-3; the light of a capture is rarely known to 1e-2
_TIMES = 1 << 14
_GOLDEN = (math.sqrt(5) - 1) / 2  # of the exposure, the distance of two such times: they are even, and fit no period
_OTHER = math.sqrt(2) - 1  # of a frame, the same within it, independent of the first
_NO_CHANGE = 1e-3  # relative: a default mean nearer to 1 is taken as 1, for the mean of smooth factors has this error


@dataclass(frozen=True)
class Conditions:
    """How a recording is made; every hook on rates and times gets it.

    exposure, frame_time, frame_period: s; frames: their number; wavelength: m, None where no light falls on the sensor.
    scene: the image that the light follows, where it is not the same on all pixels; photons/s are then those of white.
    bits: of the readout `counts`, 0 without it; counting: what a count is, the sum of 2^bits - 1 binary `frames`, or a
    `counter` in each frame, which stops at 2^bits - 1. live: s from the start of each frame in which detections are
    recorded, for expectations (`within_frames`); None: all of the exposure.
    """

    exposure: float
    frames: int
    frame_time: float
    frame_period: float
    wavelength: float | None
    bits: int = 0
    counting: str = "frames"
    scene: Scene | None = None
    live: float | None = None

    def lit(self, photons: np.ndarray) -> tuple[np.ndarray, Conditions]:
        """(photons/s on each pixel, the same conditions without a scene) of (images, pixels) photons/s of white."""
        if self.scene is None:
            return photons, self
        return photons * self.scene.share, replace(self, scene=None)

    @property
    def largest_count(self) -> int:
        """The largest value of the readout `counts`."""
        return (1 << self.bits) - 1

    @property
    def count_frames(self) -> int:
        """How many frames the readout `counts` has."""
        return self.frames if self.counting == "counter" else self.frames // max(1, self.largest_count)

    @property
    def within_frames(self) -> Conditions:
        """The same, of what is recorded within the frames: nothing in the gaps between them."""
        whole = self.live is not None or self.frame_period == self.frame_time
        return self if whole else replace(self, live=self.frame_time)

    @property
    def live_time(self) -> float:
        """The time in which detections are recorded, s."""
        return self.exposure if self.live is None else self.frames * self.live

    def moments(self, number: int) -> np.ndarray:
        """(number,) even moments of the time in which detections are recorded, s since the start."""
        share = np.modf((np.arange(number) + 0.5) * _GOLDEN)[0]
        if self.live is None:
            return self.exposure * share
        within = np.modf((np.arange(number) + 0.5) * _OTHER)[0]
        return np.floor(share * self.frames) * self.frame_period + within * self.live

    @property
    def dark(self) -> bool:
        """No light falls on the sensor."""
        return self.wavelength is None


@dataclass(frozen=True)
class Chip:
    """The sensor that an effect belongs to: its layout, its converter, and its own fixed random numbers.

    tick: s, length of a converter's tick, 0 without one; origin: where the stamp k begins, in ticks from k (0 where
    the converter rounds down, -0.5 where it rounds to the nearest).
    """

    layout: Layout
    seed: int
    effect: str
    tick: float = 0.0
    origin: float = 0.0

    def generator(self, name: str = "") -> np.random.Generator:
        """A generator of what is fixed on this chip: the same numbers each time it is asked for."""
        digest = hashlib.sha256(f"chip/{self.seed}/{self.effect}//{name}".encode()).digest()
        return np.random.Generator(np.random.Philox(key=int.from_bytes(digest[:16], "little")))


@dataclass(frozen=True)
class Mimic:
    """What no effect describes and yet leaves the trace of one: said wherever a diagnosis names that one.

    among: the `Statistic.among` of all statistics in which the two look the same, "" for all there are; capture: what
    would tell. alone: only where one capture shows the two, as a map of one lit capture.
    """

    what: str
    among: str
    capture: str
    alone: bool = False

    def __str__(self) -> str:
        return f"{self.what} would look the same; only {self.capture} tells them apart"


class Effect(Plugin, abstract=True):
    """Base of every effect; see the table of stages above."""

    registry: ClassVar[Registry] = Registry("effect")
    stage: ClassVar[str]
    after: ClassVar[str | None] = None  # the effect of the same stage that comes before this one
    last: ClassVar[bool] = False  # it comes behind all others of its stage
    # light stage: it changes the scene that is seen, before all others; light that is the same everywhere stays so
    of_scene: ClassVar[bool] = False
    counted: ClassVar[bool] = False  # its hook takes a `Draws` instead of a numpy generator
    # its closed forms are those of each pixel by itself, so that a part of a chip needs no other part's
    by_pixel: ClassVar[bool] = False
    acts_on: ClassVar[str] = "light"  # arrival stage: one of `ACTS_ON`
    cause: ClassVar[str] = (
        ""  # dark, arrival ("own") and correlated stage: what its events are called; default: its name
    )
    # which statistics it moves, for the contract tests (`spadmnist.testing`); every other one stays as it is
    moves: ClassVar[tuple[str, ...]] = ()
    # values (SI) with which pictures show it, where those that the contract test chooses show it less well
    shown: ClassVar[dict[str, Any]] = {}
    mimic: ClassVar[Mimic | None] = None
    mimic_of_map: ClassVar[Mimic | None] = None  # of a map of one of its parameters

    # what a search knows of it; by its stage, where it does not say so itself
    on_light: ClassVar[bool] = False  # it acts on the light alone: a common factor is another light level
    is_pattern: ClassVar[bool] = False  # it is a shape over the array, or of the scene
    adds_rate: ClassVar[bool] = False  # it adds events of each pixel, whatever the light
    has_children: ClassVar[bool] = False  # an event causes others, which may cause more: a cascade

    has_mean: ClassVar[bool] = False  # `expected_rate` has the mean of `factor` or `open` to take
    states_mean: ClassVar[bool] = True  # `expected_rate` says what it does to the mean; False: it may change it unsaid

    def __init_subclass__(cls, stage: str | None = None, **keywords: Any):
        plugins.check_names(cls)
        if "__init__" in vars(cls) and not _takes_any_values(vars(cls)["__init__"]):
            raise TypeError(
                f"{cls.__name__}: __init__ does not take the values of its parameters; leave it out: what is worked "
                "out of them belongs into made(self, chip)"
            )
        if cls.acts_on not in ACTS_ON:
            near = did_you_mean(str(cls.acts_on), ACTS_ON)
            raise TypeError(f"{cls.__name__}: acts_on is {cls.acts_on!r}; it is one of {', '.join(ACTS_ON)}.{near}")
        if stage is not None:
            cls.stage = stage
        chosen = getattr(cls, "stage", None)
        if keywords.get("abstract") and chosen is None:
            super().__init_subclass__(**keywords)
            return
        if chosen not in STAGES:
            raise TypeError(f"{cls.__name__}: {chosen!r} is not a stage; the stages are {', '.join(STAGES)}")
        have = {hook for group in STAGES[chosen] for hook in group.split("+") if callable(getattr(cls, hook, None))}
        if not any(set(group.split("+")) <= have for group in STAGES[chosen]):
            ways = " or ".join(group.replace("+", " and ") for group in STAGES[chosen])
            raise TypeError(f"{cls.__name__}: an effect at stage {chosen} must define {ways}")
        if "stage" in vars(cls):  # a subclass without a stage of its own keeps what was declared
            by_stage = {
                "on_light": ("light", "detection"),
                "is_pattern": ("light",),
                "adds_rate": ("dark",),
                "has_children": ("correlated",),
            }
            for name, stages in by_stage.items():
                if name not in vars(cls):
                    setattr(cls, name, chosen in stages)
        cls.has_mean = "open" in have or ("factor" in have and "modulate" not in have)
        changing = {"modulate", "spawn", "blind_time", "sensitivity", "carried"}
        changing |= {"apply"} if chosen == "readout" else set()
        if "states_mean" not in vars(cls):
            cls.states_mean = cls.has_mean or not changing & have or cls.expected_rate is not Effect.expected_rate
        if "spawn" in vars(cls) and "hazard" not in vars(cls):
            cls.hazard = Effect.hazard  # type: ignore[method-assign]  # that of another spawn is not inherited
        super().__init_subclass__(**keywords)
        if not keywords.get("abstract") and not vars(cls).get("cause"):
            cls.cause = cls.name

    def made(self, chip: Chip) -> None:
        """Work out what is fixed for a chip; called once, when all parameters have their values."""

    def expected_rate(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """Mean rate behind this effect (1/s) from that before it; for planning, and for the light of a capture.

        Default: times the mean of `factor`, or of `open`, over the exposure (of `conditions.live`, over that part of
        the frames); unchanged where there is neither.
        """
        if not self.has_mean:
            return rate
        hook = "factor" if self.stage == "arrival" else "open"
        times = conditions.moments(_TIMES)
        mean = float(np.mean(getattr(self, hook)(times, conditions)))
        # what is no mean is refused where the effect acts; a mean of 1 keeps every digit
        return rate if not 0 <= mean < math.inf or abs(mean - 1) < _NO_CHANGE else rate * mean

    @property
    def moves_dark(self) -> bool:
        """Whether events without light (dark counts, or its own) fluctuate with it."""
        return self.stage == "arrival" and self.acts_on != "light"

    @classmethod
    def light_pattern(cls, layout: Layout) -> np.ndarray:
        """The shapes of a pattern over the array, (pixels, shapes): its effect is about a sum of them.

        A search tests whether a map of the pixels has them. Default: slopes along x and y, and the squared distance
        from the middle. A parameter for each row or column has a shape for each, which is not asked here.
        """
        place = layout.centred.T
        return np.stack([*place, (place**2).sum(axis=0)], axis=1)

    def of_pixels(self, hit: np.ndarray) -> dict[str, Any]:
        """The parameters under which exactly these pixels have the effect, of one that hits pixels at random, by name.

        A diagnosis knows from the counts which pixels were hit, and writes their sensor. Default: none, the pixels of
        the sensor that it writes are drawn.

        Args:
            hit: (pixels,) bool.
        """
        return {}

    def hazard(self, pixels: int) -> tuple[np.ndarray, float] | None:
        """What a detection leaves in its own pixel, for the likelihood of time stamps; None: nothing of this form.

        Correlated stage: with a probability p a detection fires its own pixel again, once, after a time with an
        exponential law; and no other pixel.

        Args:
            pixels: of the array.
        Returns:
            (-ln(1 - p), (pixels,) or one number; the mean time in s).
        """
        return None

    def backlog(self) -> float:
        """Detections that it holds and still lets pass when no more come, of the array; its closed form is of a steady
        load. Readout stage. Default: 0.
        """
        return 0.0

    def mean_delay(self) -> float | None:
        """The mean of the exponential time after which an event causes others, s; None: of another law, or unknown.

        Correlated stage; without the dead time, which comes first in the event's own pixel. The closed forms leave out
        what comes while nothing is recorded. Default: that of `hazard`, where there is one.
        """
        law = self.hazard(1) if type(self).hazard is not Effect.hazard else None
        return None if law is None else law[1]

    def in_likelihood(self, stamped: bool, conditions: Conditions, rules: str) -> bool:
        """Whether the exact likelihood of a capture describes this effect at its values.

        Default: by the stage and what is declared there. In the law of stamps each pixel has a rate, a blind time after
        each detection, a `hazard` and a blur; in that of frames each has a mean number of candidates, and no memory.

        Args:
            stamped: the capture has time stamps (TR); otherwise single frames (QIS).
            conditions: of the capture.
            rules: of the sensor, "paper" or "device".
        """
        if self.stage == "gate":  # frames without a gap between them have a mean number, wherever the gate lies
            return not stamped and conditions.frame_time == conditions.frame_period
        if self.stage == "correlated":
            return stamped and rules == "device" and type(self).hazard is not Effect.hazard
        if self.stage == "dead_time" and stamped:
            return not (hasattr(self, "sensitivity") or getattr(self, "extends", False))
        if self.stage == "dead_time":
            return not (hasattr(self, "carried") and self.carried() > 0)
        return self.stage != "arrival" and not (self.stage == "readout" and hasattr(self, "apply"))

    def influence(self) -> float:
        """Pitches up to which what happens in one pixel may change what others record; inf: the whole array.

        Where a part of a chip is looked at (`Sensor.cropped`), so many pixels around it are simulated with it. What is
        less than the truth leaves out what comes from farther away; what is more costs time. Default: inf for
        correlated events and for a readout, which pixels may share, otherwise 0.
        """
        return math.inf if self.stage in ("correlated", "readout") else 0.0


def _takes_any_values(made: Any) -> bool:
    """Whether a function can be called with values by name alone, whichever they are."""
    try:
        _, *given = inspect.signature(made).parameters.values()
    except (TypeError, ValueError):
        return False
    free = [one.kind in (one.VAR_KEYWORD, one.VAR_POSITIONAL) or one.default is not one.empty for one in given]
    return all(free) and any(one.kind is one.VAR_KEYWORD for one in given)


def in_order(effects: list[Effect]) -> list[Effect]:
    """By stage; within a stage first what is `of_scene`, then by name, each behind the one it names in `after`, and at
    the end what is `last`. Where that one is absent, behind the one that it names in its turn.
    """
    stages = list(STAGES)
    present = {e.name for e in effects}
    behind = {e.name: _behind(e, present) for e in effects}
    waiting = sorted(effects, key=lambda e: (stages.index(e.stage), e.last, e.name))
    ordered: list[Effect] = []
    while waiting:
        names = {e.name for e in waiting}
        ready = [e for e in waiting if behind[e.name] not in names - {e.name}] or waiting
        ordered.append(ready[0])
        waiting.remove(ready[0])
    return sorted(ordered, key=lambda e: (stages.index(e.stage), not e.of_scene, e.last))


def _behind(effect: Effect, present: Collection[str]) -> str | None:
    """The name of the nearest effect of a sensor behind which this one stands, by its chain of `after`."""
    name, passed = effect.after, {effect.name}
    while name and name not in present and name not in passed and name in Effect.registry:
        passed.add(name)
        name = Effect.registry.find(name).after
    return name


def __getattr__(name: str) -> Any:
    """The class of an effect by its name, `spadmnist.effects.DarkCounts`, whichever file it stands in."""
    if name.startswith("_"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    plugins.discover()
    known = _classes()
    if name not in known:
        raise AttributeError(f"{name} is not an effect; spadmnist effects lists all.{did_you_mean(name, known)}")
    return known[name]


def __dir__() -> list[str]:
    plugins.discover()
    return sorted([*__all__, *_classes()])


def _classes() -> dict[str, type[Effect]]:
    return {cls.__name__: cls for cls in map(Effect.registry.find, Effect.registry)}
