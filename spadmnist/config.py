"""A config file becomes an `Experiment`: scene, recording, sensor, what to reconstruct, where to put it.

Every mistake is found before any work starts, all of them at once, each with its file and line.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from . import document, light, plugins, reconstruct, units
from .document import Document
from .effects import Conditions, Effect
from .errors import ConfigError, InputError, SpadError, did_you_mean
from .events import Layout
from .images import Images, ImageSource, check_size
from .readout import READOUTS, Recorded, no_detection, unsigned_for
from .reconstruct import Method, Settings
from .sensor import RULES, Sensor
from .streams import Streams

_MOST_EVENTS = 2_000_000_000  # of one image
_MOST_STAGED_EVENTS = 100_000_000  # of one image, where a batch goes through one stage after the other
_MOST_BYTES = 4 * 2**30  # of one image on disk


def _quantity(unit: str) -> Any:
    def read(value: object) -> units.Quantity:
        return units.parse(value, unit)

    return BeforeValidator(read)


def _positive(value: units.Quantity) -> units.Quantity:
    if value <= 0:
        raise ValueError(f"{value} is not possible; it must be more than 0")
    return value


_Q = units.Quantity
_Time = Annotated[_Q, _quantity("s"), AfterValidator(_positive)]
_Length = Annotated[_Q, _quantity("m"), AfterValidator(_positive)]
_Area = Annotated[_Q, _quantity("m^2"), AfterValidator(_positive)]
_Lux = Annotated[_Q, _quantity("lux"), AfterValidator(_positive)]
_Irradiance = Annotated[_Q, _quantity("W/m^2"), AfterValidator(_positive)]


def _share(value: units.Quantity) -> units.Quantity:
    if not 0 < value <= 1:
        raise ValueError(f"{value} is not possible; it must be more than 0 and at most 1 (100 %)")
    return value


_Share = Annotated[_Q, _quantity(""), AfterValidator(_share)]


class _Model(BaseModel):
    model_config = ConfigDict(
        strict=True,
        extra="forbid",
        frozen=True,
        validate_default=True,
        allow_inf_nan=False,
        arbitrary_types_allowed=True,
    )


class _Scene(_Model):
    images: ImageSource
    wavelength: _Length = Field(default="555 nm")  # type: ignore[assignment]
    lux: list[_Lux] | None = Field(default=None, min_length=1)
    irradiance: list[_Irradiance] | None = Field(default=None, min_length=1)


class _Recording(_Model):
    exposure: _Time
    frames: int | None = Field(default=None, ge=1, le=10**9)
    frame_time: _Time | None = None
    frame_period: _Time | None = None
    readouts: list[Literal["tr", "str", "qis"]] = Field(default=["tr", "str", "qis"], min_length=1)


class _Output(_Model):
    format: Literal["zarr", "hdf5"] = "zarr"


class _Layout(_Model):
    rows: int = Field(ge=1, le=100_000)
    columns: int = Field(ge=1, le=100_000)
    pixel_area: _Area
    fill_factor: _Share = Field(default="1")  # type: ignore[assignment]


class _Sensor(_Model):
    name: str = ""
    rules: Literal["paper", "device"] = "paper"
    chip_seed: int = Field(default=0, ge=0, lt=2**63)
    layout: _Layout
    effects: dict[str, dict[str, Any] | None]


class _Config(_Model):
    seed: int = Field(ge=0, lt=2**63)
    limit: int | None = Field(default=None, ge=1)
    scene: _Scene
    recording: _Recording
    reconstruct: list[str] | None = None
    sensor: Any
    output: _Output = Field(default_factory=_Output)


@dataclass(frozen=True)
class Level:
    """One light level: white in lux (`kind` "lux") or in W/m^2 ("irradiance"), as written and in SI."""

    text: str
    kind: str
    value: float

    @property
    def folder(self) -> str:
        """Its name on disk: `5 mlux` -> `5_mlux`, `120 nW/cm^2` -> `120_nW_per_cm2`."""
        return re.sub(r"[^A-Za-z0-9.+-]+", "_", self.text.replace("/", "_per_").replace("^", "")).strip("_")

    @property
    def key(self) -> str:
        """What its random numbers are keyed by: the value, however it is written."""
        return f"{self.kind}/{float(self.value).hex()}"


@dataclass(frozen=True)
class Experiment:
    """Everything that decides what a dataset contains, besides the images.

    resolved: the config with all defaults filled in and the sensor in place, as text and numbers: what a manifest
    keeps. base: the folder that relative paths refer to; name: the file, for messages; limit: images of each split.
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
    format: str
    limit: int | None = None
    notes: tuple[str, ...] = ()
    _photons: dict[str, float] = field(default_factory=dict, repr=False, compare=False)

    # --- light ---------------------------------------------------------------------------------------------------

    def white(self, level: Level) -> float:
        """Photons/s on the active area of a white pixel."""
        if level.text not in self._photons:
            convert = light.photons_from_lux if level.kind == "lux" else light.photons_from_irradiance
            assert self.conditions.wavelength is not None
            area = self.sensor.layout.active_area
            self._photons[level.text] = convert(level.value, area, self.conditions.wavelength)
        return self._photons[level.text]

    def photons(self, level: Level, pixels: np.ndarray, white: float) -> np.ndarray:
        """(images, channels * rows * columns) photons/s from grey levels: linear, white at the level."""
        flat = pixels.reshape(len(pixels), -1)
        if flat.dtype == np.uint8:
            # a table is the same arithmetic, once for each of the 256 grey levels
            return (np.arange(256) / white * self.white(level))[flat]
        return flat / white * self.white(level)

    def level(self, text: str) -> Level:
        """The level written as `text`, or of the same value. Raises KeyError with a sentence."""
        for level in self.levels:
            if level.text == text:
                return level
        for level in self.levels:
            try:
                if units.parse(text, "lux" if level.kind == "lux" else "W/m^2") == level.value:
                    return level
            except ValueError:
                continue
        raise KeyError(f"{text!r} is not a light level here; there are {', '.join(x.text for x in self.levels)}")

    # --- images --------------------------------------------------------------------------------------------------

    def load_images(self, images_dir: Path | None = None) -> dict[str, Images]:
        """The splits that the config names, "train" first, checked against the sensor's layout.

        Where an effect draws by blocks of images, a `limit` does not cut a block: `wanted` says how many are meant.
        """
        limit = None if self.limit is None else -(-self.limit // self.sensor.block) * self.sensor.block
        splits = self.source.load(self.sensor.layout.shape, images_dir, self.base, limit)
        check_size(splits, self.sensor.layout.shape, "sensor.layout")
        return splits

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
        block = self.sensor.block
        first, last = start // block * block, min(-(-stop // block) * block, len(images))
        return self.simulate_block(level, split, images.pixels[first:last], images.white, first).images(
            start - first, stop - first
        )

    def simulate_block(self, level: Level, split: str, pixels: np.ndarray, white: float, first: int) -> Recorded:
        """As `simulate`, for the images `pixels` whose first has the index `first` (a multiple of the block)."""
        channels = pixels[0].size // self.sensor.layout.pixels
        # each channel is an image of its own to the sensor
        numbers = np.arange(first * channels, (first + len(pixels)) * channels, dtype=np.uint64)
        photons = self.photons(level, pixels, white).reshape(len(numbers), -1)
        made = self.sensor.expose(photons, self.conditions, self.streams(level, split, numbers), self.readouts)
        return made.grouped(channels)

    @cached_property
    def settings(self) -> Settings:
        """What the reconstructions are told."""
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
        candidates, _ = self.sensor.expected(photons, self.conditions)
        events = float(candidates.sum())
        most = _MOST_EVENTS if self.sensor.is_paper_line else _MOST_STAGED_EVENTS
        if not events <= most:
            raise InputError(
                f"{self.name}: one image at {brightest.text} would hold {events:.3g} events "
                f"({events / pixels:.3g} a pixel), more than the {most:.0e} that can be simulated at once; "
                "lower the light, the dark count rate or the exposure"
            )
        stored = pixels * self.conditions.frames / 8 if set(self.readouts) & {"qis", "str"} else 0
        stored += 4 * events * len(set(self.readouts) & {"tr", "str"})
        if stored > _MOST_BYTES:
            raise InputError(
                f"{self.name}: one image at {brightest.text} would take {stored / 2**30:.1f} GiB, more than "
                f"the {_MOST_BYTES / 2**30:.0f} GiB that one may; lower the frames, the exposure or the light"
            )


# --- reading ------------------------------------------------------------------------------------------------------


def read(
    path: str | Path,
    seed: int | None = None,
    format: str | None = None,
    lux: tuple[str, ...] = (),
    limit: int | None = None,
) -> Experiment:
    """Read a config file. `seed`, `format`, `lux` and `limit` stand in for the file's own.

    Raises ConfigError with every mistake, or InputError where a file cannot be read.
    """
    source = document.read(Path(path))
    experiment = build(source, Path(path).resolve().parent, seed, format, limit)
    if lux:
        try:
            return experiment.with_levels(lux)
        except KeyError as error:
            raise ConfigError([f"--lux: {error.args[0]}"]) from None
    return experiment


def build(
    source: Document,
    base: Path,
    seed: int | None = None,
    format: str | None = None,
    limit: int | None = None,
) -> Experiment:
    """An Experiment from a parsed config; see `read`."""
    if not isinstance(source.value, Mapping):
        raise ConfigError(
            [f"{source.name}: is not a config; it begins with seed, scene, recording, ... (see configs/)"]
        )
    raw = dict(source.value)
    if seed is not None:
        raw["seed"] = seed
    if limit is not None:
        raw["limit"] = limit
    if format is not None:
        raw["output"] = {**(raw.get("output") or {}), "format": format}
    problems: list[str] = []
    config = _validated(_Config, raw, source, (), problems)
    sensor_source, sensor_base, sensor_path = source, base, ("sensor",)
    if isinstance(raw.get("sensor"), str):
        sensor_source, sensor_base, sensor_path = _sensor_file(raw["sensor"], source, base, problems)
    sensor, sensor_model = None, None
    value = sensor_source.value if sensor_path == () else sensor_source.value.get("sensor")
    if value is not None and not (isinstance(raw.get("sensor"), str) and sensor_source is source):
        sensor, sensor_model = read_sensor(value, sensor_source, sensor_path, sensor_base, problems)
    levels = _levels(config, source, problems)
    conditions = _conditions(config, source, problems)
    methods: tuple[str, ...] = ()
    if config is not None:
        methods = _methods(config, source, problems)
    if problems or config is None or sensor is None or conditions is None or sensor_model is None:
        raise ConfigError(problems)
    sensor = _settled(sensor, sensor_source, sensor_path)
    _check_clock(sensor, conditions, config, source, sensor_source, sensor_path)
    readouts = tuple(r for r in READOUTS if r in config.recording.readouts)
    notes = []
    if config.scene.lux and abs(config.scene.wavelength - 555e-9) > 0.5e-9:
        notes.append(
            f"{source.place(('scene', 'wavelength'))}: lux is turned into power with 683 lm/W, which holds at 555 nm, "
            f"not at {config.scene.wavelength}; give irradiance where the light is not green"
        )
    return Experiment(
        name=source.name,
        resolved=_resolved(config, sensor_model, sensor, source, methods, conditions, readouts),
        base=base,
        seed=config.seed,
        levels=levels,
        source=config.scene.images,
        conditions=conditions,
        readouts=readouts,
        methods=methods,
        sensor=sensor,
        format=config.output.format,
        limit=config.limit,
        notes=tuple(notes),
    )


def _validated(model: type[_Model], raw: Any, source: Document, path: tuple[Any, ...], problems: list[str]) -> Any:
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        for item in error.errors():
            problems.append(_sentence(item, model, source, path))
    except RecursionError:
        problems.append(f"{source.place(path)}: is nested too deeply")
    return None


_SOURCES = ", ".join(one.model_fields["source"].default for one in get_args(get_args(ImageSource)[0]))


def _sentence(item: Any, model: type[_Model], source: Document, path: tuple[Any, ...]) -> str:
    """One pydantic error as a sentence with file, line, path, value and what to do."""
    kind = item["type"]
    location = list(item["loc"])
    # pydantic names the member of a union in the path; the file does not
    if location[:2] == ["scene", "images"] and len(location) > 2:
        del location[2]
    full = (*path, *location)
    place = source.place(full)
    value = item.get("input")
    if kind == "extra_forbidden":
        known = _fields_at(model, location[:-1])
        return f"{place} is not an entry here.{did_you_mean(str(location[-1]), known)}" + (
            f" Allowed are {', '.join(known)}" if known else ""
        )
    if kind == "missing":
        return f"{source.place(full)} is missing"
    if kind == "value_error":
        return f"{place}: {item['ctx']['error']}"
    if kind in ("union_tag_invalid", "literal_error"):
        expected = item["ctx"].get("expected_tags") or item["ctx"].get("expected", "")
        names = re.findall(r"'([^']*)'", expected)
        given = item["ctx"].get("tag", value)
        where = f"{place}.source" if kind == "union_tag_invalid" else place
        return f"{where}: {given!r} is not one of {', '.join(names)}.{did_you_mean(str(given), names)}"
    if kind == "union_tag_not_found":
        return f"{place} needs a source: one of {_SOURCES}"
    message = item["msg"][0].lower() + item["msg"][1:]
    return f"{place}: {_brief(value)} is not possible: {message}"


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _fields_at(model: type[BaseModel], location: list[Any]) -> list[str]:
    """The entries that a part of the config may have."""
    current: Any = model
    for part in location:
        info = getattr(current, "model_fields", {}).get(part)
        if info is None:
            return []
        current = info.annotation
    return list(getattr(current, "model_fields", {}))


def _sensor_file(
    name: str, source: Document, base: Path, problems: list[str]
) -> tuple[Document, Path, tuple[Any, ...]]:
    file = base / name
    try:
        found = document.read(file)
    except ConfigError as error:
        problems.extend(error.problems)
        return source, base, ("sensor",)
    except InputError as error:
        problems.append(f"{source.place(('sensor',))}: {error}")
        return source, base, ("sensor",)
    inner = isinstance(found.value, Mapping) and "sensor" in found.value
    if inner:
        for key in found.value:
            if key != "sensor":
                problems.append(f"{found.place((key,))} is not an entry of a sensor file; it holds sensor: alone")
    return found, file.resolve().parent, ("sensor",) if inner else ()


def read_sensor(
    raw: Any, source: Document, path: tuple[Any, ...], base: Path, problems: list[str]
) -> tuple[Sensor | None, Any]:
    """A sensor (not settled yet) and its model, from the mapping at `path`; every mistake goes to `problems`."""
    if not isinstance(raw, Mapping):
        problems.append(f"{source.place(path)}: {_brief(raw)} is neither a sensor file's name nor a sensor")
        return None, None
    effects: list[Effect] = []
    listed = raw.get("effects")
    if isinstance(listed, Mapping):
        for name, values in listed.items():
            effect = _effect(name, values, source, (*path, "effects", name), base, problems)
            if effect is not None:
                effects.append(effect)
        # its own reading was done above: pydantic need not complain a second time
        listed = {str(name): {} for name in listed}
    model = _validated(_Sensor, {**raw, "effects": listed} if "effects" in raw else raw, source, path, problems)
    if model is None:
        return None, None
    layout = Layout(
        model.layout.rows,
        model.layout.columns,
        float(model.layout.pixel_area),
        float(model.layout.fill_factor),
    )
    assert model.rules in RULES
    return Sensor(layout, effects, model.rules, model.chip_seed, model.name), (
        model,
        raw.get("effects") or {},
    )


def _effect(
    name: Any, values: Any, source: Document, path: tuple[Any, ...], base: Path, problems: list[str]
) -> Effect | None:
    try:
        kind = Effect.registry.find(str(name))
    except KeyError as error:
        problems.append(f"{source.place(path)}: {error.args[0]}")
        return None
    if values is None:
        values = {}
    if not isinstance(values, Mapping):
        problems.append(f"{source.place(path)}: {_brief(values)} is not a list of parameters such as {{rate: 100 Hz}}")
        return None
    settled: dict[str, Any] = {}
    before = len(problems)
    for key, raw in values.items():
        declared = kind.parameters.get(key)
        if declared is None:
            known = ", ".join(kind.parameters) or "none"
            problems.append(
                f"{source.place((*path, key))} is not a parameter of {kind.name}."
                f"{did_you_mean(str(key), kind.parameters)} It has {known}"
            )
            continue

        def problem(below: tuple[Any, ...], sentence: str, key: Any = key) -> None:
            problems.append(f"{source.place((*path, key, *below))}: {sentence}")

        settled[key] = plugins.read_value(declared, raw, base, problem)
    for key, declared in kind.parameters.items():
        if declared.required and key not in settled:
            problems.append(f"{source.place(path)}: {kind.name} needs {key} ({declared.about})")
    return kind(**settled) if len(problems) == before else None


def _settled(sensor: Sensor, source: Document, path: tuple[Any, ...]) -> Sensor:
    try:
        return sensor.settled()
    except InputError as error:
        raise ConfigError([f"{source.place((*path, 'effects'))}: {error}"]) from None


def _levels(config: _Config | None, source: Document, problems: list[str]) -> tuple[Level, ...]:
    if config is None:
        return ()
    scene = config.scene
    if (scene.lux is None) == (scene.irradiance is None):
        problems.append(
            f"{source.place(('scene',))}: give the light levels once, as lux: [5 mlux, ...] or as "
            "irradiance: [120 nW/cm^2, ...]"
        )
        return ()
    kind = "lux" if scene.lux is not None else "irradiance"
    levels: list[Level] = []
    for i, value in enumerate(scene.lux or scene.irradiance or []):
        level = Level(value.text, kind, float(value))
        for known in levels:
            if known.value == level.value or known.folder == level.folder:
                problems.append(
                    f"{source.place(('scene', kind, i))}: {level.text} is the level {known.text} again; list it once"
                )
        levels.append(level)
    return tuple(levels)


def _conditions(config: _Config | None, source: Document, problems: list[str]) -> Conditions | None:
    if config is None:
        return None
    r = config.recording
    framed = set(r.readouts) & {"str", "qis"}
    if framed and (r.frames is None or r.frame_time is None):
        missing = [k for k in ("frames", "frame_time") if getattr(r, k) is None]
        problems.append(
            f"{source.place(('recording',))}: {' and '.join(sorted(framed))} need{'s' if len(framed) == 1 else ''} "
            f"{' and '.join(missing)}"
        )
        return None
    frames = r.frames or 1
    frame_time = float(r.frame_time or r.frame_period or r.exposure / frames)
    period = float(r.frame_period or frame_time)
    if frame_time > period * (1 + 1e-12):
        problems.append(
            f"{source.place(('recording', 'frame_time'))}: a frame of {units.show(frame_time, 's')} does not fit into "
            f"the frame period of {units.show(period, 's')}"
        )
    if abs(frames * period - r.exposure) > 1e-9 * r.exposure:
        problems.append(
            f"{source.place(('recording', 'exposure'))}: the exposure is frames x frame_period, here {frames} x "
            f"{units.show(period, 's')} = {units.show(frames * period, 's')}, but {r.exposure} is written"
        )
    return Conditions(float(r.exposure), frames, frame_time, period, float(config.scene.wavelength))


def _methods(config: _Config, source: Document, problems: list[str]) -> tuple[str, ...]:
    recorded = set(config.recording.readouts)
    if config.reconstruct is None:
        return tuple(m for m in Method.registry if set(reconstruct.find(m).readouts()) <= recorded)
    chosen: list[str] = []
    for i, name in enumerate(config.reconstruct):
        try:
            method = reconstruct.find(name)
        except KeyError as error:
            problems.append(f"{source.place(('reconstruct', i))}: {error.args[0]}")
            continue
        lacking = sorted(set(method.readouts()) - recorded)
        if lacking:
            problems.append(
                f"{source.place(('reconstruct', i))}: {name} needs {', '.join(lacking)}, which recording.readouts lacks"
            )
        if name in chosen:
            problems.append(f"{source.place(('reconstruct', i))}: {name} is listed twice")
        chosen.append(name)
    return tuple(chosen)


def _check_clock(
    sensor: Sensor,
    conditions: Conditions,
    config: _Config,
    source: Document,
    sensor_source: Document,
    sensor_path: tuple[Any, ...],
) -> None:
    """What can only be said of sensor and recording together."""
    place = sensor_source.place((*sensor_path, "effects"))
    problems = []
    try:
        pdp = sensor.nominal_pdp(conditions.wavelength)
        if pdp <= 0:
            problems.append(f"{place}.detection.pdp: is 0, so that no flux can be estimated; it must be more than 0")
    except SpadError as error:
        problems.append(f"{sensor_source.place((*sensor_path, 'effects', 'detection', 'pdp'))}: {error}")
    try:
        if sensor.tick > 0:
            unsigned_for(conditions.exposure / sensor.tick, "TR stamps")
            if no_detection(conditions.frame_time, sensor.tick) < 2 and "str" in config.recording.readouts:
                problems.append(
                    f"{place}.tdc.resolution: {units.show(sensor.tick, 's')} is not finer than the frame time of "
                    f"{units.show(conditions.frame_time, 's')}, so that STR could say nothing"
                )
    except SpadError as error:
        problems.append(f"{place}.tdc.resolution: {error}")
    if problems:
        raise ConfigError(problems)


def _resolved(
    config: _Config,
    sensor_model: Any,
    sensor: Sensor,
    source: Document,
    methods: tuple[str, ...],
    conditions: Conditions,
    readouts: tuple[str, ...],
) -> dict[str, Any]:
    """The config with nothing left open, in a fixed order of entries; numbers stay as they were written."""
    model, raw_effects = sensor_model
    images = config.scene.images.model_dump(exclude_none=True)
    scene: dict[str, Any] = {"images": images, "wavelength": config.scene.wavelength.text}
    if config.scene.lux is not None:
        scene["lux"] = [q.text for q in config.scene.lux]
    else:
        scene["irradiance"] = [q.text for q in config.scene.irradiance or []]
    r = config.recording
    recording = {
        "exposure": r.exposure.text,
        "frames": conditions.frames,
        "frame_time": r.frame_time.text if r.frame_time else f"{conditions.frame_time!r} s",
        "frame_period": (r.frame_period or r.frame_time).text  # type: ignore[union-attr]
        if (r.frame_period or r.frame_time)
        else f"{conditions.frame_period!r} s",
        "readouts": list(readouts),
    }
    effects: dict[str, Any] = {}
    for effect in sensor.effects:
        given = raw_effects.get(effect.name) or {}
        effects[effect.name] = {
            name: given.get(name, _default_text(declared)) for name, declared in effect.parameters.items()
        }
    layout = {
        "rows": model.layout.rows,
        "columns": model.layout.columns,
        "pixel_area": model.layout.pixel_area.text,
        "fill_factor": _plain(model.layout.fill_factor),
    }
    return {
        "seed": config.seed,
        **({"limit": config.limit} if config.limit is not None else {}),
        "scene": scene,
        "recording": recording,
        "reconstruct": list(methods),
        "sensor": {
            "name": model.name,
            "rules": model.rules,
            "chip_seed": model.chip_seed,
            "layout": layout,
            "effects": effects,
        },
        "output": {"format": config.output.format},
    }


def _plain(value: units.Quantity) -> Any:
    """A dimensionless number as it was written: a number, or text with its per cent."""
    return value.text if "%" in value.text else float(value)


def _default_text(declared: plugins.Parameter) -> Any:
    value = declared.default
    if declared.unit in ("", "bool") or isinstance(value, bool):
        return value
    return units.show(value, declared.unit, 12)
