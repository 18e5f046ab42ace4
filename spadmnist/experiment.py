"""An experiment: scene, recording, sensor, reconstructions; everything that decides what a dataset contains."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from . import estimators, light, standing, units
from .effects import Conditions
from .errors import InputError, UnknownName
from .images import Images, check_size
from .readout import Recorded
from .reconstruct import Method, Settings
from .sensor import Sensor
from .store import Encoding
from .streams import Streams

_FROM_FRAMES = 2e9  # expected events of an image from which on its frames are drawn without them, if they stand alone
_MOST_OF_A_ROW = 2e8  # bits of a row of pixels that are drawn so: half of them are drawn at once
_MOST_BYTES = 4 * 2**30  # of one image on disk


@dataclass(frozen=True)
class Level:
    """One light level: white in lux (`kind` "lux") or in W/m^2 ("irradiance"), as written and in SI."""

    text: str
    kind: str
    value: float

    @property
    def folder(self) -> str:
        """Its name on disk: `5 mlux` -> `5_mlux`, `5 µlux` -> `5_ulux`, `120 nW/cm^2` -> `120_nW_per_cm2`."""
        text = re.sub(r"^\+?(?=\.)", "0", units.plain(self.text).lstrip("+")).replace("/", "_per_").replace("^", "")
        return re.sub(r"[^A-Za-z0-9.+-]+", "_", text).strip("_")

    @property
    def key(self) -> str:
        """What its random numbers are keyed by: the value, however it is written."""
        return f"{self.kind}/{float(self.value).hex()}"


def level_of(levels: Sequence[Level], text: str) -> Level:
    """The one of the levels that is written as `text`, or has its value. Raises KeyError with a sentence."""
    for level in levels:
        if level.text == text:
            return level
    for level in levels:
        try:
            if units.parse(text, "lux" if level.kind == "lux" else "W/m^2") == level.value:
                return level
        except ValueError:
            continue
    known = [x.text for x in levels]
    near = next((x for x in known if x.split()[0] == str(text).strip()), None)
    hint = f' Did you mean "{near}"?' if near else ""  # a level that is written alike is another amount of light
    raise UnknownName(f"{text!r} is not a light level here.{hint} There are {', '.join(known)}")


@dataclass(frozen=True)
class Experiment:
    """Everything that decides what a dataset contains, besides the images.

    resolved: the config with all defaults filled in and the sensor in place, as text and numbers: what a manifest
    keeps. base: the folder that relative paths refer to; name: the file, for messages; encoding: how shards are
    written; limit: images of each split; small: fewer bytes, more slowly; on_reading: reconstructions are not stored,
    but made when they are read; causes: say of every detection what made it; wavelengths: m, of each channel of colour
    images, where they differ (the first is that of `conditions`).
    """

    name: str
    resolved: dict[str, Any]
    base: Path
    seed: int
    levels: tuple[Level, ...]
    source: Any
    conditions: Conditions
    readouts: tuple[str, ...]
    methods: tuple[str, ...]
    sensor: Sensor
    encoding: Encoding
    small: bool = False
    on_reading: bool = False
    limit: int | None = None
    causes: bool = False
    notes: tuple[str, ...] = ()
    wavelengths: tuple[float, ...] = ()
    _photons: dict[tuple[str, int], float] = field(default_factory=dict, repr=False, compare=False)

    @property
    def format(self) -> str:
        """Of the shards."""
        return self.encoding.format

    # --- light ---------------------------------------------------------------------------------------------------

    def white(self, level: Level, channel: int = 0) -> float:
        """Photons/s on the active area of a white pixel, in a channel of colour images."""
        if (level.text, channel) not in self._photons:
            convert = light.photons_from_lux if level.kind == "lux" else light.photons_from_irradiance
            wavelength = self.wavelengths[channel] if self.wavelengths else self.conditions.wavelength
            assert wavelength is not None
            area = self.sensor.layout.active_area
            self._photons[level.text, channel] = convert(level.value, area, wavelength)
        return self._photons[level.text, channel]

    def photons(self, level: Level, pixels: np.ndarray, white: float) -> np.ndarray:
        """(images, channels * rows * columns) photons/s from grey levels: linear, white at the level."""
        flat = pixels.reshape(len(pixels), -1)
        if self.wavelengths:
            each = flat.reshape(len(flat), len(self.wavelengths), -1) / white
            whites = np.array([self.white(level, channel) for channel in range(len(self.wavelengths))])
            return (each * whites[:, None]).reshape(flat.shape)
        if flat.dtype == np.uint8:
            # a table is the same arithmetic, once for each of the 256 grey levels
            return estimators.lookup(np.arange(256) / white * self.white(level), flat.ravel()).reshape(flat.shape)
        return flat / white * self.white(level)

    def seen(self, photons: np.ndarray) -> np.ndarray:
        """(channel images, pixels) photons/s at the first channel's wavelength that are detected as often as these.

        Detection thins light, so that photons of another wavelength count as many as are detected of them.
        """
        if not self.wavelengths:
            return photons
        return (photons.reshape(-1, len(self.wavelengths), photons.shape[1]) * self._worth).reshape(photons.shape)

    @cached_property
    def _worth(self) -> np.ndarray:
        """(channels, pixels) detections that a photon of each channel's wavelength makes, beside the first one's."""
        found = []
        for wavelength in self.wavelengths:
            rate = np.ones((1, self.sensor.layout.pixels))
            for effect in self.sensor.at("detection"):
                rate = effect.apply(rate, replace(self.conditions, wavelength=wavelength))  # type: ignore[attr-defined]
            found.append(rate[0])
        return np.stack(found) / np.where(found[0] > 0, found[0], 1.0)

    def level(self, text: str) -> Level:
        """The level written as `text`, or of the same value. Raises KeyError with a sentence."""
        found = self._by_text.get(text)
        return level_of(self.levels, text) if found is None else found

    @cached_property
    def _by_text(self) -> dict[str, Level]:
        return {level.text: level for level in self.levels}

    # --- images --------------------------------------------------------------------------------------------------

    def load_images(self, images_dir: Path | None = None) -> dict[str, Images]:
        """The splits that the config names, "train" first, checked against the sensor's layout.

        Where an effect draws by blocks of images, a `limit` does not cut a block: `wanted` says how many are meant.
        """
        limit = None if self.limit is None else -(-self.limit // self.sensor.block) * self.sensor.block
        splits = self.source.load(self.sensor.layout.shape, images_dir, self.base, limit)
        check_size(splits, self.sensor.layout.shape, "sensor.layout")
        for images in splits.values():
            self._check_channels(images.pixels)
        return splits

    def _check_channels(self, pixels: np.ndarray) -> None:
        """Raise InputError where images have not the channels that there are wavelengths of."""
        channels = pixels.shape[1] if pixels.ndim == 4 else 1
        if self.wavelengths and channels != len(self.wavelengths):
            held = "grey" if pixels.ndim == 3 else f"of {channels} channels"
            raise InputError(
                f"scene.wavelength: has {len(self.wavelengths)} wavelengths, one for each channel, but the images are "
                f"{held}; give one wavelength, or images in colour"
            )

    def wanted(self, images: Images) -> int:
        """How many of a split's images belong to the dataset."""
        return len(images) if self.limit is None else min(self.limit, len(images))

    # --- simulation ----------------------------------------------------------------------------------------------

    def streams(self, level: Level, split: str, images: np.ndarray) -> Streams:
        return Streams(self.seed, level.key, split, images)

    def simulate(self, level: Level, split: str, images: Images, start: int, stop: int) -> Recorded:
        """What the sensor records of `images[start:stop]` of a whole split: the same bytes however it is cut.

        Where an effect draws by blocks of images, the whole blocks around them are simulated.
        """
        if stop <= start:
            return self.simulate(level, split, images, 0, 1).images(0, 0)
        block = self.sensor.block
        first, last = start // block * block, min(-(-stop // block) * block, len(images))
        return self.simulate_block(level, split, images.pixels[first:last], images.white, first).images(
            start - first, stop - first
        )

    def simulate_block(self, level: Level, split: str, pixels: np.ndarray, white: float, first: int) -> Recorded:
        """As `simulate`, for the images `pixels` whose first has the index `first` (a multiple of the block)."""
        return self.simulate_numbered(level, split, pixels, white, np.arange(first, first + len(pixels)))

    def simulate_numbered(
        self, level: Level, split: str, pixels: np.ndarray, white: float, images: np.ndarray
    ) -> Recorded:
        """As `simulate`, for images whose indices are `images`: any, or one whole block where the sensor has blocks."""
        channels = pixels[0].size // self.sensor.layout.pixels
        self._check_channels(pixels)
        # each channel is an image of its own to the sensor
        numbers = (images[:, None] * channels + np.arange(channels)).reshape(-1).astype(np.uint64)
        photons = self.seen(self.photons(level, pixels, white).reshape(len(numbers), -1))
        streams = self.streams(level, split, numbers)
        large = self.from_frames(photons)
        if not large.any():
            made = self.sensor.expose(photons, self.conditions, streams, self.readouts, causes=self.causes)
            return made.grouped(channels)
        if self.causes:
            raise self._no_causes(level)
        parts = []
        for i, one in enumerate(large):
            own = streams.of(streams.images[i : i + 1])
            if one:
                parts.append(standing.recorded(self.sensor, self.conditions, photons[i], own))
            else:
                parts.append(self.sensor.expose(photons[i : i + 1], self.conditions, own, self.readouts))
        return Recorded.join(parts).grouped(channels)

    def _no_causes(self, level: Level) -> InputError:
        return InputError(
            f"{self.name}: an image at {level.text} would hold more than {_FROM_FRAMES:.0e} events; its frames are "
            "drawn without them, and have no causes: leave out --causes, or lower the light or the exposure"
        )

    @cached_property
    def _frames_alone(self) -> bool:
        """Is there nothing but binary frames that stand alone and are live whole?"""
        c = self.conditions
        if set(self.readouts) != {"qis"} or self.sensor.layout.columns * c.frames > _MOST_OF_A_ROW:
            return False
        half = max(1, c.frames // 2)
        return standing.by_bits(self.sensor, c, replace(c, frames=half, exposure=half * c.frame_period))

    def from_frames(self, photons: np.ndarray) -> np.ndarray:
        """(images,) bool: which images hold so many events that their frames are drawn without them?

        Those whose whole image does, where the sensor is a part of a chip. photons: (images, pixels) photons/s.
        """
        if not self._frames_alone:
            return np.zeros(len(photons), bool)
        chip, window = self.sensor.chip or self.sensor, self.sensor.window
        light = photons if window is None else window.spread(photons)
        events = chip.expected(light, self.conditions)[0].sum(axis=1)
        return np.asarray(events > _FROM_FRAMES)

    def image(self, method: Method, recorded: Recorded) -> tuple[np.ndarray, int]:
        """As `Method.image`, of images in colour each channel with the PDP at its own wavelength."""
        if not self.wavelengths:
            return method.image(recorded, self.settings)
        planes = len(self.wavelengths)
        values, saturated = [], 0
        for channel, wavelength in enumerate(self.wavelengths):
            settings = replace(self.settings, pdp=self.sensor.nominal_pdp(wavelength))
            one, bounded = method.image(recorded.plane(channel, planes), settings)
            values.append(one.reshape(-1, recorded.pixels // planes))
            saturated += bounded
        return np.stack(values, axis=1).ravel(), saturated

    @cached_property
    def settings(self) -> Settings:
        """What the reconstructions are told, at the wavelength of the conditions."""
        c = self.conditions
        return Settings(
            self.sensor.nominal_pdp(c.wavelength),
            c.exposure,
            self.sensor.nominal_dead_time,
            self.sensor.tick,
            c.frames,
            c.frame_time,
        )

    def with_levels(self, texts: tuple[str, ...]) -> Experiment:
        """The same with some of the light levels only, in the config's order. Raises KeyError with a sentence."""
        chosen = {self.level(text).text for text in texts}
        levels = tuple(x for x in self.levels if x.text in chosen)
        scene = {**self.resolved["scene"], levels[0].kind: [x.text for x in levels]}
        return replace(self, levels=levels, resolved={**self.resolved, "scene": scene})

    def with_methods(self, names: tuple[str, ...]) -> Experiment:
        """The same with these reconstructions."""
        return replace(self, methods=names, resolved={**self.resolved, "reconstruct": list(names)})

    def check_volume(self, mean_grey: float, channels: int) -> None:
        """Raise InputError where one image holds more than can be simulated. mean_grey: from 0 to 1."""
        brightest = max(self.levels, key=self.white)
        pixels = self.sensor.layout.pixels * channels
        photons = np.full((channels, self.sensor.layout.pixels), self.white(brightest) * mean_grey)
        if self.wavelengths:
            even = np.full((1, channels, *self.sensor.layout.shape), mean_grey)
            photons = self.seen(self.photons(brightest, even, 1.0).reshape(channels, -1))
        excess = self.sensor.excess(photons, self.conditions, self.readouts)
        if excess and not self.from_frames(photons).any():
            raise InputError(
                f"{self.name}: one image at {brightest.text} would hold {excess}; lower the light, the dark count "
                "rate or the exposure"
            )
        if excess and self.causes:
            raise self._no_causes(brightest)
        candidates, _ = self.sensor.expected(photons, self.conditions)
        events = float(candidates.sum())
        stored = pixels * self.conditions.frames / 8 if set(self.readouts) & {"qis", "str"} else 0
        stored += 4 * events * len(set(self.readouts) & {"tr", "str"})
        if "counts" in self.readouts:
            stored += 2 * pixels * self.conditions.count_frames
        if stored > _MOST_BYTES:
            raise InputError(
                f"{self.name}: one image at {brightest.text} would take {stored / 2**30:.1f} GiB, more than "
                f"the {_MOST_BYTES / 2**30:.0f} GiB that one may; lower the frames, the exposure or the light"
            )
