"""A config file becomes an `Experiment`.

Every mistake is found before any work starts, all of them at once, each with its file and line, the value, what is
allowed and what to do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from .. import document, light, store
from ..document import Document, Path_, path_of
from ..errors import ConfigError, InputError, did_you_mean
from ..experiment import Experiment
from ..readout import READOUTS
from ..sensor import Sensor
from ..validated import brief
from ._reader import _Described, _Reader
from ._resolved import _resolved
from ._sections import _DEFAULTS, _SECTIONS, _SENSOR, _Scene, _Sensor


def entries() -> dict[str, tuple[Any, Any]]:
    """The entries of a config by name: pydantic's kind, and the default, `...` where there is none."""
    kinds = {**_SECTIONS, "sensor": _SENSOR}
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
            add = f"add it in {path} under scene, {experiment.levels[0].kind}"
            raise ConfigError([f"--lux: {error.args[0]}; to make another one, {add}"]) from None
    return experiment


def shipped(name: str) -> Path:
    """A config that comes with the program, such as `spad_mnist.yaml`: in a checkout beside the package, else in it.

    Raises InputError where it is not there.
    """
    package = Path(__file__).parents[1]
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / name).is_file():
            return folder / name
    raise InputError(f"{package}: {name}, which comes with the program, is not there; install the program again")


def examples() -> dict[str, Path]:
    """Every file that comes with the program to be used as an example, by its name within their folder."""
    root = shipped("quick.yaml").parent
    files = {path.relative_to(root).as_posix(): path for path in sorted(root.rglob("*")) if path.is_file()}
    return {name: path for name, path in files.items() if "__pycache__" not in path.parts}


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
    path = path_of(path, "a sensor file")
    source = document.read(path)
    reader = _Reader(source, path.resolve().parent, [])
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
    if reader.problems or described is None or described.resolved is None:
        raise ConfigError(reader.problems)
    return described.resolved


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
    if reader.problems or not (described and described.resolved and conditions and scene and recording):
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
        sensor=described.resolved,
        encoding=store.encoding(parts["output"].format),
        small=parts["output"].compression == "small",
        on_reading=parts["output"].reconstructions == "on_reading",
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
    made = (seed, known, found[0].images, conditions, readouts, tuple(methods), sensor, store.encoding("zarr"))
    several = tuple(map(float, found[0].wavelengths)) if len(found[0].wavelengths) > 1 else ()
    return Experiment("Simulated", {}, Path(), *made, wavelengths=several)


def _notes(scene: _Scene, source: Document) -> tuple[str, ...]:
    note = light.of_lux(*map(float, scene.wavelengths)) if scene.lux else None
    return () if note is None else (f"{source.place(('scene', 'wavelength'))}: {note}",)
