"""A plan: a measurement whose captures are described and have yet to be recorded. Files fill it.

What the plan says of light, clock and array is taken; what a user or a file says otherwise is an error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from .. import capture_files, measurement, units
from ..effects import Conditions
from ..errors import InputError, SpadError
from ..import_options import Said, word
from ..measurement import Measurement
from ..recording import Capture, Light
from . import Found
from .names import safe_name

_SAME = 1e-9  # relative difference up to which two times or levels are the same, written in other units
_TIMES = ("exposure", "frame_time", "frame_period")


def read(out: Path) -> Measurement | None:
    """The plan at a place, None where there is none, or one that is complete. Raises ConfigError for its mistakes."""
    if not out.exists() or not measurement.is_measurement(out):
        return None
    found = measurement.open(out, planned=True)
    return found if found.missing else None


def match(plan: Measurement, files: Sequence[Path], ids: Sequence[str]) -> list[Capture]:
    """The capture that each file is: as `ids` say, else by its name, else in order. Raises SpadError."""
    missing = list(plan.missing)
    for id in ids:
        plan.capture(id)  # raises where there is none
        if id not in missing:
            raise SpadError(f"--capture: {id} has its data already, in {plan.source}; remove its file first")
    if ids:
        if len(ids) != len(files) or len(set(ids)) != len(ids):
            raise SpadError(f"--capture: {len(ids)} for {len(files)} files; give one for each file, in their order")
        return [plan.capture(id) for id in ids]
    named = [_named(plan, path) for path in files]
    for path, one in zip(files, named, strict=True):
        if one is not None and named.count(one) > 1:
            raise SpadError(
                f"{path}: is the capture {one} by its name, and so is another file; say which they are with --capture, "
                "one for each file, in their order"
            )
    rest = [id for id in missing if id not in named]
    unnamed = [path for path, id in zip(files, named, strict=True) if id is None]
    if unnamed and len(unnamed) != len(rest):
        are = "capture is" if len(rest) == 1 else "captures are"
        which = f"{len(rest)} {are} missing ({', '.join(rest)})" if rest else "no other capture is missing"
        names = ", ".join(path.name for path in unnamed[:8])
        raise SpadError(
            f"{plan.source}: {names}: not named as a capture is, and {which}; say which captures the files are with "
            "--capture, one for each file, in their order"
        )
    order = iter(rest)
    return [plan.capture(id if id is not None else next(order)) for id in named]


def _named(plan: Measurement, path: Path) -> str | None:
    """The capture that a file is called as, recorded already or not: to the letter, else as its file would be called.

    Raises SpadError where several would be called so.
    """
    ids = [capture.id for capture in plan.captures]
    if path.stem in ids:
        return path.stem
    alike = [id for id in ids if safe_name(id).lower() == safe_name(path.stem).lower()]
    if len(alike) > 1:
        raise SpadError(f"{path}: may be the capture {' or '.join(alike)}; say which it is with --capture")
    return alike[0] if alike else None


def stated(plan: Measurement, capture: Capture) -> dict[str, Any]:
    """What a plan says of a capture, by the names of options and of what files say of themselves; in SI."""
    c, lit = capture.conditions, capture.light
    found: dict[str, Any] = {"modality": capture.modality}
    if plan.layout.positions is None:
        found |= {"rows": plan.layout.rows, "columns": plan.layout.columns}
    if capture.modality == "tr":
        found["exposure"] = c.exposure
    elif capture.modality != "counts":  # of counts the clock may be that of binary frames or of count frames
        found |= {"frames": c.frames, "frame_time": c.frame_time, "frame_period": c.frame_period}
    if c.bits:
        found |= {"bits": c.bits, "counting": c.counting}
    if lit.wavelength is not None:
        found["wavelength"] = lit.wavelength
        if lit.level is not None:
            found[lit.kind_of_level] = lit.level
    return found


def said_with(said: Said, plan: Measurement, capture: Capture) -> Said:
    """What the user says, and for the rest what the plan says. Raises SpadError where the two differ."""
    for name in ("positions", "relative_uncertainty"):
        if getattr(said, name) is not None:
            raise SpadError(f"{word(name)}: the plan says it, {plan.place(capture.id)}; leave out {word(name)}")
    here = stated(plan, capture)
    if capture.modality == "counts" and (said.frame_time is not None or said.frame_period is not None):
        raise SpadError(f"--frame-time: the plan says it, {plan.place(capture.id)}; leave it out")
    for name in said.given:
        if name in here and not _same(getattr(said, name), here[name]):
            raise _contradiction(
                plan, capture, name, here[name], f"{word(name)} says {_shown(name, getattr(said, name))}"
            )
    filled = {
        name: value for name, value in here.items() if hasattr(said, name) and getattr(said, name) in (None, False)
    }
    filled.pop("frames", None)  # the file's number is compared, and told in the plan's words
    return replace(said, **filled)


def check(found: Found, path: Path, said: Said, plan: Measurement, capture: Capture) -> None:
    """Raise SpadError where a file says otherwise of itself; what the user says as well is not the file's to say."""
    here = stated(plan, capture)
    if (found.frames is None) != (capture.modality == "tr"):
        held = "time stamps (tr)" if found.frames is None else "frames"
        raise _contradiction(plan, capture, "modality", capture.modality, f"{path} holds {held}")
    if (found.packed or found.bits) and capture.modality != "qis":
        raise _contradiction(plan, capture, "modality", capture.modality, f"{path} holds bits (qis)")
    for name, value in found.facts.items():
        if name in here and getattr(said, name, None) is None and not _same(value, here[name]):
            where = f" ({found.sources[name]})" if name in found.sources else ""
            raise _contradiction(plan, capture, name, here[name], f"{path} says {_shown(name, value)}{where}")
    lit = {"wavelength", "irradiance", "lux"} & set(found.facts)
    if capture.light.dark and lit:
        raise _contradiction(plan, capture, "light", "dark", f"{path} was recorded in light")
    levels = {"irradiance", "lux"} & lit
    if capture.light.level is not None and levels and capture.light.kind_of_level not in levels:
        (name, *_) = levels
        kind = capture.light.kind_of_level
        raise _contradiction(plan, capture, kind, here[kind], f"{path} gives {name}: {_shown(name, found.facts[name])}")


def clock(found: Found, path: Path, said: Said, plan: Measurement, capture: Capture) -> Conditions:
    """How the capture was recorded, as the plan says. Raises SpadError where the file has another number of frames."""
    c = capture.conditions
    if found.frames is None:
        return c
    held, bits = found.frames.shape[0], 0
    if capture.modality == "counts":
        bits = said.bits or found.facts.get("bits", 0)
        counting = said.counting or found.facts.get("counting", "frames")
        known = capture_files.clock_of_counts(c, held, bits, counting)
        if known is not None:
            return known
    elif held == c.frames:
        return c
    each = f" of {bits} bits" if bits else ""
    raise _contradiction(plan, capture, "frames", c.frames, f"{path} holds {held:,}{each}")


def check_lights(plan: Measurement, lights: Sequence[Light], name: str | None) -> None:
    """Raise SpadError where the command line says what the plan says."""
    if lights:
        raise SpadError(f"--light: the plan says what fell on the sensor, {plan.source}; leave out --light")
    if name is not None:
        raise SpadError(f"--name: the plan is called {plan.name} already; leave out --name")


def _contradiction(plan: Measurement, capture: Capture, name: str, there: Any, here: str) -> SpadError:
    again = ""
    if name in _TIMES:
        again = f", or give {word(name)} {_quoted(_shown(name, there))} where the plan is right"
    return InputError(f"{plan.place(capture.id)}: {name} is {_shown(name, there)}, but {here}; correct the plan{again}")


def _quoted(text: str) -> str:
    return f'"{text}"'


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, (int, float)) and isinstance(other, (int, float)):
        return math.isclose(one, other, rel_tol=_SAME)
    return bool(one == other)


_UNITS: Mapping[str, str] = {"wavelength": "m", "irradiance": "W/m^2", "lux": "lux", **dict.fromkeys(_TIMES, "s")}


def _shown(name: str, value: Any) -> str:
    return (
        units.show(float(value), _UNITS[name], 9)
        if name in _UNITS
        else f"{value:,}"
        if name == "frames"
        else str(value)
    )
