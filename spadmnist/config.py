"""A config file becomes an `Experiment`.

Every mistake is found before any work starts, all of them at once, each with its file and line, the value, what is
allowed and what to do.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import itertools
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, cast, get_args

import numpy as np
from pydantic import ConfigDict, Field, PlainValidator, WithJsonSchema

from . import disk, document, plugins, reconstruct, units
from .document import Document, Path_
from .effects import Conditions, Effect, in_order
from .errors import ConfigError, InputError, SpadError, did_you_mean
from .events import MOST_PIXELS, Layout
from .experiment import Experiment, Level
from .images import ImageSource
from .readout import READOUTS, no_detection, unsigned_for
from .reconstruct import Method
from .section import LATER, Section
from .sensor import Sensor
from .validated import Area, Irradiance, Lux, Reader, Share, Time, brief, written

_CHANNELS = ("red", "green", "blue")  # of colour images, in their order


def _of_light(raw: object) -> units.Quantity | list[units.Quantity]:
    """A wavelength, or one for each channel of colour images: a list of three, or red, green and blue."""
    if isinstance(raw, Mapping):
        if set(raw) != set(_CHANNELS):
            written = "{red: 620 nm, green: 540 nm, blue: 460 nm}"
            raise ValueError(f"{brief(dict(raw))} is not possible; give red, green and blue, as in {written}")
        raw = [raw[name] for name in _CHANNELS]
    if not isinstance(raw, list):
        return _one_length(raw)
    if len(raw) != len(_CHANNELS):
        raise ValueError(f"{brief(raw)} is not possible; give one wavelength, or one for each of red, green and blue")
    return [_one_length(one) for one in raw]


def _one_length(raw: object) -> units.Quantity:
    value = units.parse(raw, "m")
    if not value > 0:
        raise ValueError(f"{value} is not possible; it must be more than 0")
    return value


_LENGTH = written("m", signed=False)
_LENGTHS = {
    "anyOf": [
        _LENGTH,
        {"type": "array", "items": _LENGTH, "minItems": len(_CHANNELS), "maxItems": len(_CHANNELS)},
        {
            "type": "object",
            "properties": dict.fromkeys(_CHANNELS, _LENGTH),
            "required": list(_CHANNELS),
            "additionalProperties": False,
        },
    ]
}


class _Scene(Section):
    model_config = ConfigDict(json_schema_extra={"oneOf": [{"required": ["lux"]}, {"required": ["irradiance"]}]})

    images: ImageSource
    wavelength: Annotated[Any, PlainValidator(_of_light), WithJsonSchema(_LENGTHS)] = Field(default="555 nm")
    lux: list[Lux] | None = Field(default=None, min_length=1)
    irradiance: list[Irradiance] | None = Field(default=None, min_length=1)

    @property
    def wavelengths(self) -> tuple[units.Quantity, ...]:
        """One, or one for each channel."""
        return tuple(self.wavelength) if isinstance(self.wavelength, list) else (self.wavelength,)


class _Recording(Section):
    exposure: Time
    frames: int | None = Field(default=None, ge=1, le=10**9)
    frame_time: Time | None = None
    frame_period: Time | None = None
    readouts: list[Literal["tr", "str", "qis", "counts"]] = Field(default=["tr", "str", "qis"], min_length=1)
    bits: int | None = Field(default=None, ge=1, le=12)
    counting: Literal["frames", "counter"] | None = None


class _Output(Section):
    format: Literal["zarr", "hdf5"] = "zarr"


class _Layout(Section):
    model_config = ConfigDict(
        json_schema_extra={"oneOf": [{"required": ["rows", "columns"]}, {"required": ["positions"]}]}
    )

    rows: int | None = Field(default=None, ge=1, le=100_000)
    columns: int | None = Field(default=None, ge=1, le=100_000)
    positions: str | None = None  # a CSV file, instead of rows and columns
    pixel_area: Area
    fill_factor: Share = Field(default="1")  # type: ignore[assignment]


class _Sensor(Section):
    name: str = ""
    rules: Literal["paper", "device"] = "paper"
    chip_seed: int = Field(default=0, ge=0, lt=2**63)
    layout: _Layout
    effects: dict[str, Any]  # each is read by what its class declares


# the sections of a config: each is checked by itself, so that a mistake in one hides none in another
_SECTIONS: dict[str, Any] = {
    "seed": Annotated[int, Field(ge=0, lt=2**63)],
    "limit": Annotated[int | None, Field(ge=1), LATER],
    "causes": Annotated[bool, LATER],
    "scene": _Scene,
    "recording": _Recording,
    "reconstruct": list[str] | None,
    "sensor": Any,
    "output": _Output,
}
_DEFAULTS: dict[str, Any] = {"limit": None, "causes": False, "reconstruct": None, "output": {}}
_EXAMPLES = {
    "seed": "seed: 1",
    "scene": "scene: {images: {source: digits}, lux: [5 mlux]}",
    "recording": "recording: {exposure: 1 ms, frames: 100, frame_time: 10 us}",
    "sensor": "sensor: FILE.yaml, or the sensor itself",
    "exposure": "exposure: 1 ms",
    "images": "images: {source: mnist}",
    "layout": "layout: {rows: 28, columns: 28, pixel_area: 25 um^2}",
    "rows": "rows: 28",
    "columns": "columns: 28",
    "pixel_area": "pixel_area: 25 um^2",
    "effects": "effects: {detection: {pdp: 0.5}}",
}


def entries() -> dict[str, tuple[Any, Any]]:
    """The entries of a config by name: pydantic's kind, and the default, `...` where there is none."""
    kinds = {**_SECTIONS, "sensor": str | _Sensor}
    return {name: (kind, _DEFAULTS.get(name, ...)) for name, kind in kinds.items()}


def read(
    path: str | Path,
    seed: int | None = None,
    format: str | None = None,
    lux: tuple[str, ...] = (),
    limit: int | None = None,
    causes: bool = False,
) -> Experiment:
    """Read a config file. `seed`, `format`, `lux`, `limit` and `causes` stand in for the file's own.

    Raises ConfigError with every mistake, or InputError where a file cannot be read.
    """
    source = document.read(Path(path))
    experiment = build(source, Path(path).resolve().parent, seed, format, limit, causes)
    if lux:
        try:
            return experiment.with_levels(lux)
        except KeyError as error:
            raise ConfigError([f"--lux: {error.args[0]}"]) from None
    return experiment


def shipped(name: str) -> Path:
    """A config that comes with the program, such as `spad_mnist.yaml`: in a checkout beside the package, else in it.

    Raises InputError where it is not there.
    """
    package = Path(__file__).parent
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / name).is_file():
            return folder / name
    raise InputError(f"{package}: {name}, which comes with the program, is not there; install the program again")


def problems(raw: Any, name: str) -> list[str]:
    """The mistakes in a config that is written out with nothing left open, a sentence each; name: of its place.

    Types and ranges alone: no file is read, and effects and methods need not be known here.
    """
    if not isinstance(raw, Mapping):
        return [f"{name}: {brief(raw)} is not a config"]
    reader = _Reader(Document(name, raw), Path(), [])
    reader.sections(raw, {**_SECTIONS, "sensor": _Sensor}, _DEFAULTS)
    written = {"recording": ("frames", "frame_time", "readouts"), "sensor": ("name", "rules"), "output": ("format",)}
    for part, keys in written.items():
        for key in keys if not reader.problems else ():
            if raw.get(part, {}).get(key) is None:
                reader.say((part,), reader.missing(key))
    return reader.problems


def read_sensor(path: str | Path) -> Sensor:
    """The sensor of a sensor file or of a config, with every map read and every distribution drawn.

    Raises ConfigError with every mistake, or InputError where a file cannot be read.
    """
    source = document.read(Path(path))
    reader = _Reader(source, Path(path).resolve().parent, [])
    raw: Any = source.value
    place: Path_ = ()
    if isinstance(raw, Mapping) and "sensor" in raw:
        raw, place = raw["sensor"], ("sensor",)
        for key in source.value:
            if key not in _SECTIONS:
                hint = did_you_mean(str(key), _SECTIONS)
                reader.problems.append(f"{source.place((key,))} is not an entry of a sensor file or of a config.{hint}")
    elif not isinstance(raw, Mapping) or not {"layout", "effects"} & set(raw):
        raise ConfigError([f"{source.name}: describes no sensor; it begins with sensor: and has layout and effects"])
    described = reader.sensor(raw, ()) if isinstance(raw, str) else reader.described(raw, place, ())
    if reader.problems or described is None or described.settled is None:
        raise ConfigError(reader.problems)
    return described.settled


def build(
    source: Document,
    base: Path,
    seed: int | None = None,
    format: str | None = None,
    limit: int | None = None,
    causes: bool = False,
) -> Experiment:
    """An Experiment from a parsed config; see `read`. base: the folder that relative paths in it refer to."""
    entries = source.value if isinstance(source.value, Mapping) else {}
    # of a file that has none of a config's entries nothing is quoted: it is perhaps one that nobody may read
    if not entries or not any(key in _SECTIONS or did_you_mean(str(key), _SECTIONS) for key in entries):
        raise ConfigError(
            [f"{source.name}: is not a config; it begins with seed, scene, recording, ... (see configs/)"]
        )
    raw = dict(source.value)
    if seed is not None:
        raw["seed"] = seed
    if limit is not None:
        raw["limit"] = limit
    if causes:
        raw["causes"] = True
    if format is not None:
        output = raw.get("output")
        raw["output"] = {**(output if isinstance(output, Mapping) else {}), "format": format}
    reader = _Reader(source, base, [])
    parts = reader.sections(raw, _SECTIONS, _DEFAULTS)
    scene, recording = parts.get("scene"), parts.get("recording")
    levels = reader.levels(scene) if scene else ()
    conditions = reader.conditions(recording, scene) if recording else None
    methods = reader.methods(parts.get("reconstruct"), recording) if recording else ()
    wavelengths = tuple(map(float, scene.wavelengths)) if scene else ()
    described = reader.sensor(raw["sensor"], wavelengths) if "sensor" in raw else None
    if described and conditions and scene and recording:
        described.check_clock(conditions, recording.readouts, wavelengths)
    if reader.problems or not (described and described.settled and conditions and scene and recording):
        raise ConfigError(reader.problems)
    return Experiment(
        name=source.name,
        resolved=_resolved(parts, described, methods, conditions, base),
        base=base,
        seed=parts["seed"],
        levels=levels,
        source=scene.images,
        conditions=conditions,
        readouts=tuple(r for r in READOUTS if r in recording.readouts),
        methods=methods,
        sensor=described.settled,
        format=parts["output"].format,
        limit=parts["limit"],
        causes=parts["causes"],
        notes=_notes(scene, source),
        wavelengths=wavelengths if len(wavelengths) > 1 else (),
    )


def of_sensor(
    sensor: Sensor, recording: Mapping[str, Any], lux: Sequence[Any], wavelength: Any, methods: Sequence[str], seed: int
) -> Experiment:
    """An Experiment without images of its own. recording: as in a config; lux: levels, in lux or as "5 mlux";
    wavelength alike, or one for each channel; methods: reconstructions.

    Raises ConfigError with every mistake.
    """

    def plain(value: Any, unit: str) -> Any:
        return f"{float(value)!r} {unit}" if isinstance(value, int | float | np.number) else value

    scene = {
        "images": {"source": "uniform"},
        "wavelength": [plain(x, "m") for x in wavelength]
        if isinstance(wavelength, list | tuple)
        else plain(wavelength, "m"),
        "lux": [plain(x, "lux") for x in lux],
    }
    raw = {"scene": scene, "recording": dict(recording), "reconstruct": list(methods)}
    reader = _Reader(document.parse(document.dump(raw), "Simulated"), Path(), [])
    parts = reader.sections(raw, {name: _SECTIONS[name] for name in raw}, {})
    found = parts.get("scene"), parts.get("recording")
    known = reader.levels(found[0]) if found[0] else ()
    conditions = reader.conditions(found[1], found[0]) if found[1] else None
    if found[1]:
        reader.methods(list(methods), found[1])
    if conditions and found[0] and found[1] and not reader.problems:
        _Described(sensor, sensor, cast(Any, None), {}, reader, ("sensor",)).check_clock(
            conditions, found[1].readouts, [float(x) for x in found[0].wavelengths]
        )
    if reader.problems or not (conditions and found[0] and found[1]):
        raise ConfigError(reader.problems)
    readouts = tuple(r for r in READOUTS if r in found[1].readouts)
    made = (seed, known, found[0].images, conditions, readouts, tuple(methods), sensor, "zarr")
    several = tuple(map(float, found[0].wavelengths)) if len(found[0].wavelengths) > 1 else ()
    return Experiment("Simulated", {}, Path(), *made, wavelengths=several)


def _notes(scene: _Scene, source: Document) -> tuple[str, ...]:
    other = next((one for one in scene.wavelengths if abs(one - 555e-9) > 0.5e-9), None)
    if scene.lux and other is not None:
        return (
            f"{source.place(('scene', 'wavelength'))}: lux is turned into power with 683 lm/W, which holds at 555 nm, "
            f"not at {other}; give irradiance where the light is not green",
        )
    return ()


class _Reader(Reader):
    """Reads the parts of one file, a config or a sensor."""

    examples: ClassVar[Mapping[str, str]] = _EXAMPLES

    # --- scene and recording --------------------------------------------------------------------------------------

    def levels(self, scene: _Scene) -> tuple[Level, ...]:
        if (scene.lux is None) == (scene.irradiance is None):
            self.say(
                ("scene",),
                "give the light levels once, as lux: [5 mlux, ...] or as irradiance: [120 nW/cm^2, ...]",
            )
            return ()
        kind = "lux" if scene.lux is not None else "irradiance"
        levels: list[Level] = []
        seen: dict[float | str, int] = {}  # by value and by folder
        for i, value in enumerate(scene.lux or scene.irradiance or []):
            level = Level(value.text, kind, float(value))
            levels.append(level)
            known = levels[min(seen.setdefault(level.value, i), seen.setdefault(level.folder, i))]
            if known is not level:
                self.say(("scene", kind, i), f"{level.text} is the level {known.text} again; list it once")
        return tuple(levels)

    def conditions(self, recording: _Recording, scene: _Scene | None) -> Conditions | None:
        r = recording
        for i, name in enumerate(r.readouts):
            if name in r.readouts[:i]:
                self.say(("recording", "readouts", i), f"{name} is listed twice; keep one")
        framed = sorted({"str", "qis", "counts"} & set(r.readouts))
        if framed and (r.frames is None or r.frame_time is None):
            missing = " and ".join(k for k in ("frames", "frame_time") if getattr(r, k) is None)
            self.say(("recording",), f"{' and '.join(framed)} need{'s' * (len(framed) == 1)} {missing}")
            return None
        frames = r.frames or 1
        frame_time = float(r.frame_time or r.frame_period or r.exposure / frames)
        period = float(r.frame_period or frame_time)
        if frame_time > period * (1 + 1e-12):
            self.say(
                ("recording", "frame_time"),
                f"a frame of {units.show(frame_time, 's')} does not fit into the frame period of "
                f"{units.show(period, 's')}; shorten it or lengthen frame_period",
            )
        if abs(frames * period - r.exposure) > 1e-9 * r.exposure:
            self.say(
                ("recording", "exposure"),
                f"the exposure is frames x frame_period, here {frames} x {units.show(period, 's')} = "
                f"{units.show(frames * period, 's')}, but {r.exposure} is written; correct one of them",
            )
        wavelength = float(scene.wavelengths[0]) if scene else None
        bits, counting = self.counting(r, frames)
        return Conditions(float(r.exposure), frames, frame_time, period, wavelength, bits, counting)

    def counting(self, recording: _Recording, frames: int) -> tuple[int, str]:
        """(bits, what a count is) of the readout `counts`."""
        r = recording
        counting = r.counting or "frames"
        if "counts" not in r.readouts:
            for name in ("bits", "counting"):
                if getattr(r, name) is not None:
                    self.say(("recording", name), "belongs to the readout counts; add it to readouts, or take this out")
            return 0, counting
        if r.bits is None:
            self.say(("recording",), "counts needs bits; write for example bits: 8")
            return 0, counting
        each = 2**r.bits - 1
        if counting == "frames" and frames % each:
            below, above = frames // each * each, -(-frames // each) * each
            near = " or ".join(str(n) for n in (below, above) if n)
            self.say(
                ("recording", "frames"),
                f"{frames} binary frames do not fill whole count frames of {r.bits} bits, each the sum of {each} of "
                f"them; take {near}, or counting: counter",
            )
        return r.bits, counting

    def methods(self, names: list[str] | None, recording: _Recording) -> tuple[str, ...]:
        recorded = set(recording.readouts)
        if names is None:
            return tuple(m for m in Method.registry if set(reconstruct.find(m).readouts()) <= recorded)
        for i, name in enumerate(names):
            try:
                lacking = sorted(set(reconstruct.find(name).readouts()) - recorded)
            except KeyError as error:
                self.say(("reconstruct", i), error.args[0])
                continue
            if lacking:
                what = ", ".join(lacking)
                self.say(("reconstruct", i), f"{name} needs {what}, which recording.readouts lacks; add it there")
            if name in names[:i]:
                self.say(("reconstruct", i), f"{name} is listed twice; keep one")
        return tuple(names)

    # --- sensor ---------------------------------------------------------------------------------------------------

    def sensor(self, raw: Any, wavelengths: Sequence[float]) -> _Described | None:
        """The sensor, from the mapping itself or from the file that it names."""
        if not isinstance(raw, str):
            return self.described(raw, ("sensor",), wavelengths)
        try:
            found = document.read(self.base / raw)
        except ConfigError as error:
            self.problems.extend(error.problems)
            return None
        except InputError as error:
            self.say(("sensor",), str(error))
            return None
        inner = _Reader(found, (self.base / raw).resolve().parent, self.problems)
        if not (isinstance(found.value, Mapping) and "sensor" in found.value):
            return inner.described(found.value, (), wavelengths)
        for key in found.value:
            if key != "sensor":
                inner.problems.append(f"{found.place((key,))} is not an entry of a sensor file; it holds sensor: alone")
        return inner.described(found.value["sensor"], ("sensor",), wavelengths)

    def described(self, raw: Any, path: Path_, wavelengths: Sequence[float]) -> _Described | None:
        """The sensor at `path` with all maps and distributions settled; None after its mistakes were noted.

        wavelengths: of the scene, m, where they are known: tables are looked up there.
        """
        if not isinstance(raw, Mapping):
            self.say(path, f"{brief(raw)} is neither a sensor file's name nor a sensor")
            return None
        model = self.valid(_Sensor, raw, path)
        whole = self.check_array(raw.get("layout"), (*path, "layout"))
        listed = raw.get("effects")
        effects = []
        for name, values in listed.items() if isinstance(listed, Mapping) else ():
            effect = self.effect(name, values, (*path, "effects", name))
            if effect is not None:
                effects.append(effect)
                self.check_tables(effect, wavelengths, (*path, "effects", name))
        layout = self.layout(model.layout, (*path, "layout")) if model is not None and whole else None
        if model is None or layout is None:
            return None
        sensor = Sensor(layout, in_order(effects), model.rules, model.chip_seed, model.name)
        settled = self.settled(sensor, path)
        return _Described(sensor, settled, model, dict(listed or {}), self, path)

    def check_array(self, raw: Any, path: Path_) -> bool:
        """Does a layout say once where its pixels are: by rows and columns, or by positions?"""
        if not isinstance(raw, Mapping):
            return False
        lacking = [name for name in ("rows", "columns") if raw.get(name) is None]
        if raw.get("positions") is not None:
            if len(lacking) < 2:
                self.say(path, "positions stand instead of rows and columns; keep the one or the other")
            return len(lacking) == 2
        if len(lacking) == 2:
            example = f"{_EXAMPLES['rows']}, {_EXAMPLES['columns']}, or positions: FILE.csv (x, y in um)"
            self.say(path, f"rows is missing, and so is columns; write for example {example}")
        elif lacking:
            self.say(path, self.missing(lacking[0]))
        return not lacking

    def layout(self, model: _Layout, path: Path_) -> Layout | None:
        area, share = float(model.pixel_area), float(model.fill_factor)
        if model.positions is None:
            assert model.rows is not None and model.columns is not None
            if model.rows * model.columns > MOST_PIXELS:
                size = f"{model.rows} x {model.columns} pixels"
                self.say(path, f"{size} are more than the {MOST_PIXELS:,} that can be simulated; give fewer")
                return None
            return Layout(model.rows, model.columns, area, share)
        try:
            positions = read_positions(self.base / model.positions)
        except InputError as error:
            self.say((*path, "positions"), str(error))
            return None
        return Layout(1, len(positions), area, share, positions)

    def effect(self, name: Any, values: Any, path: Path_) -> Effect | None:
        try:
            kind = Effect.registry.find(str(name))
        except KeyError as error:
            self.problems.append(f"{self.source.place(path)} {error.args[0].removeprefix(f'{name} ')}")
            return None
        values = {} if values is None else values
        if not isinstance(values, Mapping):
            self.say(path, f"{brief(values)} is not a group of parameters such as {{rate: 100 Hz}}")
            return None
        read: dict[str, Any] = {}
        before = len(self.problems)
        for key, raw in values.items():
            declared = kind.parameters.get(key)
            if declared is None:
                self.problems.append(
                    f"{self.source.place((*path, key))} is not a parameter of {kind.name}."
                    f"{did_you_mean(str(key), kind.parameters)} It has {', '.join(kind.parameters) or 'none'}"
                )
                continue

            meant = did_you_mean(str(raw), declared.choices)

            def problem(below: Path_, sentence: str, key: Any = key, meant: str = meant) -> None:
                self.say((*path, key, *below), f"{sentence}.{meant}" if meant else sentence)

            read[key] = plugins.read_value(declared, raw, self.base, problem)
        for key, declared in kind.parameters.items():
            if declared.required and key not in read:
                self.say(path, f"{kind.name} needs {key} ({declared.about})")
        return kind(**read) if len(self.problems) == before else None

    def check_tables(self, effect: Effect, wavelengths: Sequence[float], path: Path_) -> None:
        for key, wavelength in itertools.product(effect.parameters, wavelengths):
            value = getattr(effect, key)
            if isinstance(value, plugins.ByWavelength):
                try:
                    value.at(wavelength)
                except InputError as error:
                    self.say((*path, key), str(error))

    def settled(self, sensor: Sensor, path: Path_) -> Sensor | None:
        """Every map read and every distribution drawn."""
        before = len(self.problems)
        for effect in sensor.effects:
            for key in effect.parameters:
                try:
                    sensor.settle(effect, key)
                except InputError as error:
                    self.say((*path, "effects", effect.name, key), str(error))
        if len(self.problems) > before:
            return None
        try:
            made = sensor.settled()
            self.check_cascade(made, path)
        except SpadError as error:  # of an effect that looks at what it was given, as its chip is made
            self.say((*path, "effects"), str(error))
        return made if len(self.problems) == before else None

    def check_cascade(self, sensor: Sensor, path: Path_) -> None:
        """By a device's rules what an event causes has causes of its own: on average it must be less than one."""
        caused = sensor.caused()
        total = sum(caused.values())
        if sensor.rules == "device" and total >= 1:
            most = max(caused, key=lambda name: caused[name])
            self.say(
                (*path, "effects", most),
                f"{total:.3g} further events come of each one ({', '.join(caused)}), so that a cascade never ends; by "
                "the rules device they must be less than 1: lower the probability",
            )


@dataclass
class _Described:
    """A sensor (settled: where that went well) and what its file says: the model, the effects as written, and where
    to report mistakes.
    """

    sensor: Sensor
    settled: Sensor | None
    model: _Sensor
    written: dict[str, Any]
    reader: _Reader
    path: Path_

    def check_clock(self, conditions: Conditions, readouts: list[Any], wavelengths: Sequence[float]) -> None:
        """What can only be said of sensor and recording together."""
        # a table that does not reach the wavelength has been told already
        with contextlib.suppress(InputError):
            if self.settled and min(map(self.settled.nominal_pdp, wavelengths)) <= 0:
                pdp = (*self.path, "effects", "detection", "pdp")
                self.reader.say(pdp, "is 0, so that no flux can be estimated; it must be more than 0")
        try:
            tick = (self.settled or self.sensor).tick
        except SpadError:
            if self.settled:
                raise
            return  # what keeps the sensor from being settled has been told
        if tick <= 0:
            return
        converter = self.sensor.at("timing")[-1]
        resolution = (*self.path, "effects", converter.name, next(iter(converter.parameters), ""))
        try:
            unsigned_for(conditions.exposure / tick, "TR stamps")
        except SpadError as error:
            self.reader.say(resolution, str(error))
        if "str" in readouts and no_detection(conditions.frame_time, tick) < 2:
            self.reader.say(
                resolution,
                f"{units.show(tick, 's')} is not finer than the frame time of "
                f"{units.show(conditions.frame_time, 's')}, so that STR could say nothing; take a finer one",
            )


# --- positions ----------------------------------------------------------------------------------------------------

_HEADERS = (["x", "y"], ["x(um)", "y(um)"])
_MOST_POSITIONS = 100_000
_LARGEST_POSITIONS = 1 << 24  # bytes
_FARTHEST = 1.0  # m
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?", re.ASCII)


def read_positions(path: Path) -> np.ndarray:
    """(pixels, 2) m, the centres of pixels, from a CSV file of x and y in um below a line `x,y`.

    Raises InputError with the line.
    """
    rows = csv.reader(io.StringIO(_text_of(path), newline=""), strict=True)
    found: list[tuple[float, float]] = []
    first_of: dict[tuple[int, int], int] = {}
    headed = False
    try:
        for cells in rows:
            place = f"{path}:{rows.line_num}"
            if not any(cell.strip() for cell in cells):
                continue
            if not headed:
                if [re.sub(r"\s", "", units.plain(cell)).lower() for cell in cells] not in _HEADERS:
                    raise InputError(f"{place}: {brief(','.join(cells))} is no header; the first line is x,y (in um)")
                headed = True
                continue
            if len(cells) != 2:
                many = f"{len(cells)} column{'s' * (len(cells) != 1)}"
                raise InputError(f"{place}: has {many}; a line is the x and the y of one pixel, as in 23.0,-11.5")
            x, y = (_micrometres(cell.strip(), place) for cell in cells)
            # two pixels do not lie within a nanometre of each other
            line = first_of.setdefault((round(x * 1e9), round(y * 1e9)), rows.line_num)
            if line != rows.line_num:
                raise InputError(f"{place}: the pixel of line {line} lies at the same place; keep one of the two")
            found.append((x, y))
            if len(found) > _MOST_POSITIONS:
                raise InputError(
                    f"{place}: there are more than {_MOST_POSITIONS} pixels; give fewer, or rows and columns"
                )
    except csv.Error as error:
        raise InputError(
            f"{path}:{rows.line_num}: is not well-formed CSV ({error}); write lines such as 23.0,-11.5"
        ) from None
    if not found:
        raise InputError(f"{path}: names no pixel; write x,y in the first line, and below it a line for each pixel")
    return np.array(found)


def _text_of(path: Path) -> str:
    try:
        raw = disk.read_file(os.path.realpath(path), _LARGEST_POSITIONS)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; the positions of the pixels are read from there") from None
    except OSError as error:
        if error.errno == errno.EFBIG:
            most = f"{_LARGEST_POSITIONS >> 20} MiB; give at most {_MOST_POSITIONS} pixels"
            raise InputError(f"{path}: is larger than {most}") from None
        if error.errno in (errno.EINVAL, errno.EISDIR):
            raise InputError(f"{path}: is no file; positions is the name of a CSV file") from None
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError:
        raise InputError(f"{brief(str(path))} is not the name of a file; positions names a CSV file") from None
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text (byte {error.start}); write a CSV file with x,y in um") from None


def _micrometres(text: str, place: str) -> float:
    """m; exact decimal arithmetic, so that `positions_text` comes back to the same double."""
    if not _NUMBER.fullmatch(text) or len(text) > 60:
        with contextlib.suppress(ValueError):
            if not np.isfinite(float(text)):
                raise InputError(f"{place}: {brief(text)} is not possible; every pixel needs a finite place")
        raise InputError(f"{place}: {brief(text)} is not a number; write x and y in um, as in 23.0,-11.5")
    value = float(Decimal(text).scaleb(-6)) + 0.0
    if abs(value) > _FARTHEST:
        raise InputError(f"{place}: {text} um is not possible; a pixel lies within {_FARTHEST:g} m of the middle")
    return value


def positions_text(positions: np.ndarray) -> str:
    """The CSV file of (pixels, 2) m: the same text for the same numbers, and `read_positions` gives them back."""
    lines = [",".join(format(Decimal(repr(float(v))).scaleb(6).normalize(), "f") for v in row) for row in positions]
    return "\n".join(["x (um),y (um)", *lines]) + "\n"


# --- the config with nothing left open ----------------------------------------------------------------------------


def _resolved(
    parts: Mapping[str, Any], described: _Described, methods: tuple[str, ...], conditions: Conditions, base: Path
) -> dict[str, Any]:
    """All defaults filled in and the sensor in place, in a fixed order; numbers stay as they were written.

    What came later than the first program is left out where it stands at its default: entries of the config, of its
    sections (`Section.written`) and parameters of effects (`Parameter.later`).
    """
    recording, model, folder = parts["recording"], described.model, described.reader.base
    time = recording.frame_time.text if recording.frame_time else f"{conditions.frame_time!r} s"
    settled = {
        "frames": conditions.frames,
        "frame_time": time,
        "frame_period": recording.frame_period.text if recording.frame_period else time,
        "readouts": [r for r in READOUTS if r in recording.readouts],
        "bits": conditions.bits or None,
        "counting": conditions.counting if conditions.bits else None,
    }
    layout = model.layout
    if layout.positions is not None:
        layout = layout.model_copy(update={"positions": _reached(base, folder, layout.positions)})
    listed = described.sensor.effects
    effects = {e.name: _parameters(e, described.written.get(e.name) or {}, base, folder) for e in listed}
    whole = {
        **parts,
        "scene": parts["scene"].written(),
        "recording": recording.model_copy(update=settled).written(),
        "reconstruct": list(methods),
        "sensor": model.model_copy(update={"layout": layout, "effects": effects}).written(),
        "output": parts["output"].written(),
    }
    return {
        name: whole[name]
        for name, kind in _SECTIONS.items()
        if not (LATER in get_args(kind) and whole[name] == _DEFAULTS[name])
    }


def _parameters(effect: Effect, given: Mapping[str, Any], base: Path, folder: Path) -> dict[str, Any]:
    """The parameters of an effect of a sensor file in `folder`, as they were written or at their defaults."""
    return {
        name: _from(base, folder, given[name]) if name in given else _default_text(declared)
        for name, declared in effect.parameters.items()
        if (name in given or declared.default is not None)
        and not (declared.later and getattr(effect, name) == declared.default)
    }


def _from(base: Path, folder: Path, given: Any) -> Any:
    """A parameter as it was written in a sensor file in `folder`; a map's file is named as from `base`."""
    if isinstance(given, Mapping) and set(given) == {"file"}:
        return {"file": _reached(base, folder, given["file"])}
    return given


def _reached(base: Path, folder: Path, file: str) -> str:
    """A file's name, relative to `folder`, as from `base`: a sensor file may lie in another folder than its config."""
    if Path(file).is_absolute() or folder.resolve() == base.resolve():
        return file
    return Path(os.path.relpath(folder.resolve() / file, base.resolve())).as_posix()


def _default_text(declared: plugins.Parameter) -> Any:
    value = declared.default
    if declared.unit in ("", "bool") or isinstance(value, (bool, str)):
        return value
    return units.show(value, declared.unit, 12)
