"""Sensor files: a sensor written as one, and the user's own with what was found written into it, its comments kept."""

from __future__ import annotations

import hashlib
import io
import itertools
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import config, disk, document, units, yaml_edit
from .effects import Effect
from .errors import InputError, SpadError
from .foreign import quoted, visible
from .plugins import ByWavelength, Distribution, MapFile, Parameter, is_from_file, source_file
from .positions import positions_text
from .sensor import Sensor
from .window import Window

Key = tuple[str, str]  # effect, parameter
Notes = Mapping[Key, str]

# The first line of every file that is written here: without it, a file is the user's own.
_OURS = "# Written by spadmnist, which writes it anew when asked to; without this line it is left alone."
_ITS_EFFECT = "# Its effect"  # begins a line about a plug-in, behind the first line


@dataclass(frozen=True)
class Original:
    """The file that describes a sensor, as it was when it was read.

    Attributes:
        path: absolute.
        text: its bytes.
        sensor: what it describes.
    """

    path: Path
    text: bytes
    sensor: Sensor


def original(source: Path) -> Original:
    """The file that describes the sensor of a sensor file or config."""
    path = _described_in(Path(source).absolute())
    return Original(path, path.read_bytes(), config.read_sensor(path))


def check_place(source: Path, out: Path) -> None:
    """Raise InputError where the next sensor file would take the place of one that was not made by `write`."""
    if not out.exists():
        return
    source = _described_in(source)
    if source.exists() and out.samefile(source):
        raise InputError(f"{out} is the sensor file itself, which stays as it is; name another folder or file with -o")
    if out.is_dir():
        raise InputError(f"{out} is a folder; name a file with -o, for example {out / 'next.yaml'}")
    if not _is_ours(out):
        raise InputError(
            f"{out} is there already and no sensor file that a fit or a diagnosis has written; it is left alone: name "
            "another folder or file with -o"
        )


def _described_in(source: Path) -> Path:
    """The file that describes the sensor: `source`, or the one that it names, as a config may."""
    if not source.is_file():
        return source
    raw = document.read(source).value
    named = raw.get("sensor") if isinstance(raw, Mapping) else None
    return source.parent / named if isinstance(named, str) else source


def _is_ours(file: Path) -> bool:
    try:
        return disk.read_file(file, 1 << 24).decode(errors="replace").startswith(_OURS)
    except OSError:  # a link, a pipe and the like are nothing that was written here
        return False


def save(sensor: Sensor, out: Path, notes: Notes | None = None, earlier: set[Path] | None = None) -> Path:
    """Write a sensor as a file, its maps beside it as `.npy`; `out`. Read again it is the same sensor.

    Of a part of a chip the whole chip is written.

    Args:
        notes: what stands behind the line of an effect, as a comment.
        earlier: as of `write`.

    Raises:
        InputError: where something else lies there.
        SpadError: where it cannot be written.
    """
    out = Path(out)
    check_place(Path(os.devnull), out)
    if sensor.chip is not None and sensor.window is not None:
        effects = [sensor._on_chip(effect) for effect in sensor.effects]
        sensor = sensor.chip.changed(effects=effects, name=sensor.name)
    maps: dict[str, bytes] = {}

    def value(effect: Effect, name: str, declared: Parameter) -> Any:
        held = getattr(effect, name)
        if isinstance(held, MapFile):
            return {"file": os.path.relpath(held.path, out.parent.resolve())}
        if isinstance(held, np.ndarray) and held.ndim:
            file, data = _map_file(out, effect.name, name, held.reshape(at.shape) if declared.per_pixel else held)
            maps[file] = data
            return {"file": file}
        return _plain(declared, held)

    at = sensor.layout
    layout: dict[str, Any] = {"rows": at.rows, "columns": at.columns}
    if at.positions is not None:
        layout = {"positions": f"{out.stem}.positions.csv"}
    layout |= {"pixel_area": units.exact(at.pixel_area, "m^2"), "fill_factor": float(at.fill_factor)}
    effects_: dict[str, dict[str, Any]] = {}
    for effect in sensor.effects:
        told = {name: value(effect, name, declared) for name, declared in effect.parameters.items()}
        effects_[effect.name] = {name: x for name, x in told.items() if x is not None}
    head = {"name": sensor.name, "rules": sensor.rules, "chip_seed": int(sensor.chip_seed), "layout": layout}
    edit = yaml_edit.Edit(document.dump({"sensor": {**head, "effects": effects_}}), str(out))
    for (name, parameter), note in (notes or {}).items():
        edit.note(("sensor", "effects", name, parameter), note)
    with disk.writing(out.parent, 0):
        out.parent.mkdir(parents=True, exist_ok=True)
    _put_maps(out, maps, earlier)
    if at.positions is not None:
        disk.put_file(out.parent / layout["positions"], positions_text(at.positions).encode())
    disk.put_file(out, _headed(edit.text(), out).encode())
    config.read_sensor(out)
    _remove_earlier(out, maps, earlier)
    return out


def _map_file(out: Path, effect: str, parameter: str, values: np.ndarray) -> tuple[str, bytes]:
    """(the name of a map file, its bytes). The name holds a digest of the content, so that no map replaces another."""
    held = io.BytesIO()
    np.save(held, values)
    data = held.getvalue()
    return f"{out.stem}.{effect}.{parameter}.{hashlib.sha256(data).hexdigest()[:8]}.npy", data


def _put_maps(out: Path, maps: Mapping[str, bytes], earlier: set[Path] | None) -> None:
    for name, data in maps.items():
        path = out.parent / name
        if earlier is not None and not path.exists():
            earlier.add(path)
        disk.put_file(path, data)


def _remove_earlier(out: Path, maps: Mapping[str, bytes], earlier: set[Path] | None) -> None:
    """Remove the maps of earlier values of a sensor file."""
    for path in list(earlier or ()):
        # its name, the effect, the parameter, the content
        if path.parent == out.parent and path.name.rsplit(".", 4)[0] == out.stem and path.name not in maps:
            path.unlink(missing_ok=True)
            assert earlier is not None
            earlier.remove(path)


def _plain(declared: Parameter, held: Any) -> Any:
    """A value as YAML has it."""
    if held is None or isinstance(held, str):
        return held
    if isinstance(held, bool | np.bool_):
        return bool(held)
    if isinstance(held, ByWavelength):
        pairs = zip(held.wavelengths, held.values, strict=True)
        return {units.exact(at, "m"): _plain(declared, x) for at, x in pairs}
    if isinstance(held, Distribution):
        if held.parts:
            return {"mixture": [{"share": share, **_plain(declared, part)} for share, part in held.parts]}
        names = ("mean", "sigma") if held.kind == "normal" else ("median", "sigma")
        plain = Parameter(0.0, "", "")
        kinds = declared, (declared if held.kind == "normal" else plain)
        numbers = zip(kinds, held.numbers, strict=True)
        return {held.kind: dict(zip(names, (_plain(kind, x) for kind, x in numbers), strict=True))}
    if declared.unit in ("", "bool"):
        return int(held) if float(held).is_integer() and abs(float(held)) < 2**53 else float(held)
    return units.exact(float(held), declared.unit)


def write(
    source: Original,
    out: Path,
    values: Mapping[Key, Any],
    notes: Notes,
    window: Window | None = None,
    earlier: set[Path] | None = None,
) -> Path:
    """Write a sensor file with new values, and its maps into the same folder; `out`.

    Args:
        source: the sensor file that was diagnosed; its comments are kept, but for those of values that are replaced.
        values: (effect, parameter) -> number, switch, table over the wavelength or map.
        notes: what stands behind a line, as a comment.
        window: the part of the sensor that maps are of; elsewhere they are as `source` has them, or at their median
            where it does not.
        earlier: the maps that earlier calls with this set have written; those that the file no longer names are
            removed.

    Raises:
        SpadError: where the file cannot be read again; then none is left there.
    """
    chip = source.sensor
    out.parent.mkdir(parents=True, exist_ok=True)
    edit = yaml_edit.Edit(source.text.decode("utf-8-sig"), str(source.path))
    before, after = source.path.parent.resolve(), out.parent.resolve()
    maps: dict[str, bytes] = {}
    edit.map_texts({"file", "positions"}, lambda name: os.path.relpath(before / name, after))
    head = ("sensor", "effects") if "sensor" in edit.value else ("effects",)
    for (effect, parameter), value in values.items():
        declared = Effect.registry.find(effect).parameters[parameter]
        if isinstance(value, np.ndarray):
            if window is not None:
                value = window.filled(declared, value, getattr(chip.effect(effect), parameter, None))
            shaped = value.reshape(chip.layout.shape) if declared.per_pixel else value
            name, data = _map_file(out, effect, parameter, shaped)
            maps[name] = data
            written: Any = {"file": name}
        elif isinstance(value, bool):
            written = value
        elif isinstance(value, ByWavelength):
            entries = zip(value.wavelengths, value.values, strict=True)
            written = {units.show(at, "m", 9): _number(declared, x) for at, x in entries}
        else:
            written = _number(declared, value)
        edit.set((*head, effect, parameter), written, comment=False)
    for (effect, parameter), note in notes.items():
        if (effect, parameter) in values:
            edit.note((*head, effect, parameter), note)
    _put_maps(out, maps, earlier)
    disk.put_file(out, _headed(edit.text(), out).encode())
    try:
        config.read_sensor(out)
    except SpadError:
        out.unlink()
        raise
    _remove_earlier(out, maps, earlier)
    return out


def _number(declared: Parameter, value: float) -> str | float:
    if declared.unit:
        return units.show(float(value), declared.unit, units.WRITTEN)
    rounded = units.rounded(float(value))
    return int(rounded) if rounded.is_integer() and abs(rounded) < 1e6 else rounded


def _headed(text: str, out: Path) -> str:
    """The text with the first line of such files, and a comment for each effect that comes from a plug-in."""
    end = "\r" if text.partition("\n")[0].endswith("\r") else ""
    lines = text.removesuffix("\n").split("\n")
    if lines[0].rstrip() == _OURS:  # with the comments of an earlier file
        lines = list(itertools.dropwhile(lambda line: line.startswith(_ITS_EFFECT), lines[1:]))
    read = document.parse(text, str(out)).value
    names = read.get("sensor", read).get("effects") or {}
    own = {name: place for name in names if (place := _own_file(Effect.registry.find(name))) is not None}
    files = " ".join(f"--plugin {quoted(file)}" for file in dict.fromkeys(file for file, _ in own.values()))
    command = f"spadmnist compare {quoted(out)} MEASUREMENT {files}"
    needs = [f"{_ITS_EFFECT} {name} {where}. The command with it: {command}" for name, (_, where) in own.items()]
    return "\n".join([*(line + end for line in (_OURS, *needs)), *lines]) + "\n"


def _own_file(cls: type[Effect]) -> tuple[str, str] | None:
    """(the plug-in file of an effect, where the effect is in words); None for one that is there without `--plugin`."""
    if is_from_file(cls):
        file = Path(source_file(cls))
        shown = str(file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file)
        return shown, f"is in the plug-in {visible(shown)}"
    if cls.__module__ == "__main__":
        return f"{cls.name}.py", f"was defined in no file: put its class into one, {cls.name}.py"
    return None
