"""Models whose recordings are simulated: one sensor, one for each capture, or one for each replicate."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields

import numpy as np

from .. import by_value, plugins
from ..effects import Conditions
from ..sensor import Sensor
from .candidates import on_chip, with_values
from .coordinates import Key, Values
from .reduction import own_statistics

# pixels, at most, of a sensor that is kept for all captures and replicates: half a megabyte for each map of dead times.
# There may be a hundred models at the same time; a rule of thumb
_SMALL = 1 << 16


@dataclass(frozen=True)
class Model:
    """A model: one sensor, or one for each capture, or one for each replicate (maps that are known with errors).

    Attributes:
        of: (capture, number of a replicate) -> sensor.
        one: a single sensor that stands for all.
        alike: all replicates of a capture have the same sensor.
        typical: capture -> the sensor whose closed forms hold in the mean over the replicates; None where all are
            alike.
    """

    of: Callable[[str, int], Sensor]
    one: Sensor
    alike: bool = True
    typical: Callable[[str], Sensor] | None = None

    def mean_sensor(self, capture: str) -> Sensor:
        """The sensor whose closed forms hold in the mean over the replicates of a capture."""
        return self.typical(capture) if self.typical else self.of(capture, 0)

    @staticmethod
    def same(sensor: Sensor) -> Model:
        """The model of one sensor for every replicate of every capture."""
        return Model(lambda capture, number: sensor, sensor)

    def under(self, name_of: Callable[[str], str]) -> Model:
        """The same sensors for captures of other names.

        Args:
            name_of: new name -> name of the capture here.
        """
        typical = self.typical
        return Model(
            of=lambda capture, number: self.of(name_of(capture), number),
            one=self.one,
            alike=self.alike,
            typical=None if typical is None else lambda capture: typical(name_of(capture)),
        )

    def changed(
        self, values: Values, phases: Mapping[tuple[str, Key], float] | None = None, chips: bool = False
    ) -> Model:
        """The model with some values set in each of its sensors.

        Args:
            values: by (effect, parameter), SI units.
            phases: by (capture, parameter), rad.
            chips: every replicate is of a chip of its own, because the random properties of the pixels are not known.
        """

        known: list[tuple[Sensor, dict[Key, float], Sensor]] = []  # (sensor here, phases, the changed sensor)

        def changed(sensor: Sensor, own: dict[Key, float]) -> Sensor:
            """The changed sensor; of a small one that is alike there is one, which keeps what it has computed."""
            found = next((made for of, with_phases, made in known if of is sensor and with_phases == own), None)
            if found is None:
                found = with_values(sensor, {**values, **own})
                if found.layout.pixels <= _SMALL:
                    known.append((sensor, own, found))
            return found

        def own(capture: str) -> dict[Key, float]:
            return {key: x for (id, key), x in (phases or {}).items() if id == capture}

        def of(capture: str, number: int) -> Sensor:
            sensor = self.of(capture, number)
            if alike:
                return changed(sensor, own(capture))
            return with_values(on_chip(sensor, number + 1) if chips else sensor, {**values, **own(capture)})

        @functools.lru_cache(maxsize=64)
        def typical(capture: str) -> Sensor:
            return with_values(self.mean_sensor(capture), {**values, **own(capture)})

        alike = self.alike and not chips
        return Model(of=of, one=changed(self.one, {}), alike=alike, typical=typical if self.typical or chips else None)


def phase_parameters(sensor: Sensor) -> list[Key]:
    """The parameters of a sensor that are phases."""
    return [(e.name, name) for e in sensor.effects for name, p in e.parameters.items() if p.kind == "phase"]


class InTheDark(Sensor):
    """A sensor without light, whose dark rates are scaled by the number that stands for photons/s.

    A dark capture can so be simulated with as many detections as were measured. The test of their number is then
    separate from the test of their pattern.
    """

    @staticmethod
    def of(sensor: Sensor) -> Sensor:
        """The same sensor, in the dark."""
        own = {f.name: getattr(sensor, f.name) for f in fields(sensor)}
        return InTheDark(**own | {"chip": None if sensor.chip is None else InTheDark.of(sensor.chip)})

    def rates(self, photons: np.ndarray, conditions: Conditions) -> tuple[np.ndarray, np.ndarray]:
        """The dark rates times the factors that stand for photons/s; arrays as in `Sensor.rates`."""
        rate, light = super().rates(np.zeros_like(photons), conditions)
        return rate * photons, light * photons


@dataclass(frozen=True)
class Packed:
    """A sensor on its way to a worker, with the user's own statistics.

    A worker must load the user's plug-in files before it can unpack it.
    """

    files: tuple[plugins.Carried, ...]
    packed: bytes

    @staticmethod
    def of(sensor: Sensor, apart: bool = True) -> Packed:
        """The packed sensor.

        Args:
            apart: it is unpacked in another process.
        Raises:
            EffectError: where a class of the user's cannot be sent there.
        """
        own = own_statistics()
        return Packed(plugins.carried(), by_value.packed((sensor, own), apart))

    @property
    def sensor(self) -> Sensor:
        """The unpacked sensor. The user's plug-in files are run where that has not been done in this process."""
        plugins.load_carried(self.files)
        return _unpacked(self.packed)


@functools.lru_cache(maxsize=2)
def _unpacked(packed: bytes) -> Sensor:
    """The unpacked sensor; only what this program has packed itself is unpacked."""
    sensor, _ = by_value.unpacked(packed)
    assert isinstance(sensor, Sensor)
    return sensor
