"""The config with nothing left open, as a dataset keeps it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from .. import plugins, units
from ..effects import Conditions, Effect
from ..readout import READOUTS
from ..section import LATER
from ._reader import _Described
from ._sections import _DEFAULTS, _SECTIONS


def _resolved(
    parts: Mapping[str, Any], described: _Described, methods: tuple[str, ...], conditions: Conditions, base: Path
) -> dict[str, Any]:
    """All defaults filled in and the sensor in place, in a fixed order; numbers stay as they were written.

    What came later than the first program is left out where it stands at its default: entries of the config, of its
    sections (`Section.written`) and parameters of effects (`Parameter.later`).
    """
    recording, model, folder = parts["recording"], described.model, described.reader.base
    time = recording.frame_time.text if recording.frame_time else f"{conditions.frame_time!r} s"
    resolved = {
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
        "recording": recording.model_copy(update=resolved).written(),
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
