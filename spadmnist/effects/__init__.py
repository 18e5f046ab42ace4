"""Effects: one class in one file each, at one stage of the line. A file in this folder is found by itself.

A recording is a short line of physics: rates -> one Poisson draw -> avalanches -> recording. The stage of an effect
fixes the order and what its hook receives:

| stage | the author writes | receives -> returns |
| --- | --- | --- |
| light | apply(rate, conditions) | photons/s, (images, pixels) -> the same |
| detection | apply(rate, conditions) | photons/s -> detections/s |
| dark | apply(rate, conditions) | detections/s -> detections/s |
| arrival | factor(t, conditions), maximum(conditions) | s, (events,) -> factor on the light or the dark rate |
| gate | open(t, conditions) | s, (events,) -> bool: can the pixel fire? |
| correlated | spawn(events, rng) | Events -> Children |
| dead_time | blind_time() | -> s after a detection, one value or one per pixel |
| timing | apply(events, rng) | Events -> Events |
| readout | apply(events, rng) | Events -> Events |

An arrival effect acts on the light, or with `acts_on = "dark"` on the dark rate; `maximum` is the largest factor.
A timing effect sees TR streams, and the frames' first stamps (STR) with one frame a row, s since its start.
`rng` is a `numpy.random.Generator` of the effect's own for each fixed block of images, or, with `counted = True` on
the class, a `spadmnist.streams.Draws` for the counter-based kernels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ..plugins import Parameter, Plugin, Registry, parameter

__all__ = ["STAGES", "Conditions", "Effect", "Parameter", "parameter"]

# stage -> the hooks that an effect there must have
STAGES: dict[str, tuple[str, ...]] = {
    "light": ("apply",),
    "detection": ("apply",),
    "dark": ("apply",),
    "arrival": ("factor", "maximum"),
    "gate": ("open",),
    "correlated": ("spawn",),
    "dead_time": ("blind_time",),
    "timing": ("apply",),
    "readout": ("apply",),
}


@dataclass(frozen=True)
class Conditions:
    """How a recording is made; every hook on rates and times gets it.

    exposure, frame_time, frame_period: s; frames: their number; wavelength: m, None where no light falls on the sensor.
    """

    exposure: float
    frames: int
    frame_time: float
    frame_period: float
    wavelength: float | None

    @property
    def dark(self) -> bool:
        """No light falls on the sensor."""
        return self.wavelength is None


class Effect(Plugin, abstract=True):
    """Base of every effect; see the table of stages above."""

    registry: ClassVar[Registry] = Registry("effect")
    stage: ClassVar[str]
    after: ClassVar[str | None] = None  # the effect of the same stage that comes before this one
    last: ClassVar[bool] = False  # it comes behind all others of its stage
    counted: ClassVar[bool] = False  # its hook takes a `Draws` instead of a numpy generator
    acts_on: ClassVar[str] = "light"  # arrival stage: "light" or "dark"

    def __init_subclass__(cls, stage: str | None = None, **keywords: Any):
        if stage is not None:
            cls.stage = stage
        chosen = getattr(cls, "stage", None)
        if chosen not in STAGES:
            raise TypeError(f"{cls.__name__}: {chosen!r} is not a stage; the stages are {', '.join(STAGES)}")
        missing = [hook for hook in STAGES[chosen] if not callable(getattr(cls, hook, None))]
        if missing:
            raise TypeError(f"{cls.__name__}: an effect at stage {chosen} must define {' and '.join(missing)}")
        super().__init_subclass__(**keywords)

    def expected_rate(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """Mean rate behind this effect (1/s) from that before it; for planning. Default: unchanged."""
        return rate


def in_order(effects: list[Effect]) -> list[Effect]:
    """By stage; within a stage by name, each behind the one it names in `after`, and at the end what is `last`."""
    stages = list(STAGES)
    waiting = sorted(effects, key=lambda e: (stages.index(e.stage), e.last, e.name))
    ordered: list[Effect] = []
    while waiting:
        names = {e.name for e in waiting}
        ready = [e for e in waiting if e.after not in names - {e.name}] or waiting
        ordered.append(ready[0])
        waiting.remove(ready[0])
    return sorted(ordered, key=lambda e: (stages.index(e.stage), e.last))
