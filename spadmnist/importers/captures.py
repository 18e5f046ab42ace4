"""What files hold, as the captures of one measurement: the same for every kind of file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from .. import disk, look, measurement, units
from ..effects import Conditions
from ..errors import InputError, SpadError
from ..factory import Progress
from ..foreign import visible
from ..import_options import UNCERTAIN, without_effect, word
from ..measurement.entries import MOST_FRAMES
from ..positions import read_positions
from ..recording import Capture, Light, Recording
from . import FACTS, Format, Found, Said, ask, lights, pixels, plan, recognise, stacks
from .names import safe_name
from .pixels import Channels


@dataclass(frozen=True)
class Took:
    """What was taken of one file.

    file, kind: where it is from, and what kind of file that is; recording facts in SI; detections: their number (of
    frames: those with one, of counts: their sum), None where it was not counted. sources: where tick, exposure, frame
    time and shape come from, by name. left_out: what of the file is in no pixel.
    """

    file: Path
    kind: str
    capture: Capture
    shape: tuple[int, int]
    detections: int
    of_pixels: tuple[int, ...] | None
    tick: float | None
    sources: Mapping[str, str]
    left_out: tuple[str, ...] = ()

    @property
    def frames(self) -> int | None:
        """Frames of the file; None for time stamps."""
        c = self.capture.conditions
        return None if self.capture.modality == "tr" else c.count_frames if c.bits else c.frames

    def as_data(self) -> dict[str, Any]:
        """For programs: numbers in SI."""
        c, capture = self.capture.conditions, self.capture
        framed = capture.modality != "tr"
        return {
            "id": capture.id,
            "modality": capture.modality,
            "file": str(self.file),
            "format": self.kind,
            "rows": self.shape[0],
            "columns": self.shape[1],
            "pixels": self.shape[0] * self.shape[1],
            "detections": self.detections,
            "tick": self.tick,
            "exposure": c.exposure,
            "frames": self.frames,
            "frame_time": c.frame_time if framed else None,
            "frame_period": c.frame_period if framed else None,
            "bits": c.bits or None,
            "counting": c.counting if c.bits else None,
            "sources": dict(self.sources),
            "left_out": list(self.left_out),
        }

    def text(self) -> str:
        """For people: what it is, then a line of what was left out."""
        c, capture = self.capture.conditions, self.capture
        array = f"{self.shape[0]:,} x {self.shape[1]:,} pixels"
        parts = [f"{self.detections:,} detection{'s' * (self.detections != 1)}"]
        if self.of_pixels is not None and len(self.of_pixels) > 1:
            parts[0] += f" ({', '.join(f'{n:,}' for n in self.of_pixels)})"
        if self.frames is None:
            head = array
            parts.append(f"exposure {units.show(c.exposure, 's', 9)}{self._from('exposure')}")
        else:
            head = f"{self.frames:,} frames of {array}{self._from('rows')}"
            each = c.largest_count if c.bits and c.counting == "frames" else 1
            if c.bits:
                head += f", {c.bits} bits"
            what = f"{self.frames:,} x {each:,}" if each > 1 else f"{self.frames:,}"
            parts.append(f"exposure {units.show(c.exposure, 's', 9)} ({what} x {units.show(c.frame_period, 's', 9)})")
            parts.append(f"frame time {units.show(c.frame_time, 's', 9)}{self._from('frame_time')}")
        if self.tick is not None:
            parts.append(f"ticks of {units.show(self.tick, 's', 6)}{self._from('tick')}")
        lines = [
            f"{capture.id}: {capture.modality}, {head}, {', '.join(parts)}; from {visible(self.file)} ({self.kind})"
        ]
        return "\n".join([*lines, *(f"  left out: {visible(what)}" for what in self.left_out)])

    def _from(self, name: str) -> str:
        return f" ({self.sources[name]})" if name in self.sources else ""


@dataclass(frozen=True)
class Imported:
    """What was made of some files: the folder, the captures in their order, and what is to be known of the files.

    missing: captures of a plan that have yet to be recorded.
    """

    folder: Path
    captures: tuple[Capture, ...]
    notes: tuple[str, ...]
    took: tuple[Took, ...] = ()
    missing: tuple[str, ...] = ()


_MOST_COUNTED = 12  # pixels whose detections are listed one by one


def import_files(
    files: Sequence[Path],
    out: Path,
    said: Said,
    lights: Sequence[Light] = (),
    name: str | None = None,
    progress: Progress | None = None,
    ids: Sequence[str] = (),
) -> Imported:
    """Make a measurement of files, a capture each. lights: one for all files, or one for each, in their order.

    Where `out` is a plan (see `plan`), the files are its captures: those named by `ids`, one for each file, else those
    called as the files are, else those that are missing, in order.

    The files are read twice, so that one at a time is in memory: first to know the pixels and to ask for what is
    missing, then to be written. Raises InputError with a sentence.
    """
    if name is not None:
        measurement.check_name(name)
    if len(lights) not in (0, 1, len(files)):
        raise SpadError(f"--light: {len(lights)} for {len(files)} files; give it once, or once for each file in order")
    if said.relative_uncertainty is not None and lights and all(lit.level is None for lit in lights):
        raise SpadError("--relative-uncertainty: belongs to a light with a level, as in 500 nm 5 nW/cm^2; leave it out")
    planned = plan.read(out)
    if planned is None and ids:
        raise SpadError(f"--capture: {out} is no plan with captures that are missing; leave out --capture")
    _check_twice(files)
    progress = progress or Progress()
    ones = _matched(files, said, planned, lights, name, ids)
    _check_options([(one.path, one.kind, one.kind.modalities, None) for one in ones], said)
    progress.start("importing", 2.0 * sum(one.size for one in ones), 0.0)
    notes: list[str] = []
    shapes: list[tuple[int, int]] = []
    channels = Channels()
    for one in ones:
        found = one.read()
        others = [other.capture for other in ones if other.capture]
        one.capture = _capture(one, found, said, planned, others, notes)
        of_file = (*found.notes, *stacks.axes_note(found, one.said), *one.capture.notes)
        notes += [f"{one.path}: {note}" for note in of_file]
        shape = _shape(one.path, found, one.said)
        if shape is not None:
            shapes.append(shape)
            if shape != shapes[0]:
                raise InputError(f"{one.path}: has {_by(shape)} pixels, others {_by(shapes[0])}; import it by itself")
        if found.detections is not None:
            channels.add(one.path, found)
        one.found = found if len(ones) == 1 else None
        progress.advance(one.size, one.path.name)
    _check_options([(one.path, one.kind, (one.made.modality,), one.packed) for one in ones], said)
    places = None if said.positions is None else read_positions(said.positions)
    if planned is not None:
        places = planned.layout.positions
    array = pixels.array(files[0], said, shapes, channels, places)
    for one in ones:
        shown = one.made.light.scene
        if shown is not None and shown.shape != array.layout.shape:
            sizes = f"{_by(shown.shape)} pixels, but {one.path} has {_by(array.layout.shape)}"
            raise InputError(f"--light: the scene {shown.name} has {sizes}; give an image of the sensor's size")
    if array.channels is not None and array.channels != tuple(range(array.layout.pixels)):
        several = len(array.channels) > 1
        are = "s {} are the pixels, in this order" if several else " {} is the pixel"
        notes.append(f"the channel{are.format(channels.called(array.channels))}")
    took: list[Took] = []
    captures = [one.made for one in ones]
    recordings = _recordings(ones, said, array, channels, progress, took, notes)
    if planned is not None:
        measurement.fill(planned, recordings)
        return Imported(out, tuple(captures), tuple(notes), tuple(took), measurement.open(out, planned=True).missing)
    default = files[0].stem if len(files) == 1 else out.resolve().name
    measurement.write(out, name or safe_name(default), array.layout, recordings, captures)
    if said.relative_uncertainty is None and (levels := [lit for lit in lights if lit.level is not None]):
        share = levels[0].relative_uncertainty
        notes.append(_uncertain_note(None, share))
    return Imported(out, tuple(captures), tuple(notes), tuple(took))


@dataclass
class _One:
    """A file on its way to be a capture.

    said: what the user says, and what the plan says where there is one; light: as the command line says it, target: the
    capture of the plan. capture, packed: known when the file has been read once. found: kept where it is the only file.
    """

    path: Path
    kind: type[Format]
    said: Said
    light: Light | None = None
    target: Capture | None = None
    capture: Capture | None = None
    packed: bool = False
    found: Found | None = None

    @property
    def size(self) -> int:
        """Bytes."""
        return self.path.stat().st_size

    @property
    def made(self) -> Capture:
        """The capture that the file is."""
        assert self.capture is not None
        return self.capture

    def read(self) -> Found:
        """What the file holds."""
        if self.found is not None:
            return self.found
        found = self.kind.read(self.path, self.said)
        self.packed = found.packed
        return found


def _matched(
    files: Sequence[Path],
    said: Said,
    planned: measurement.Measurement | None,
    lights: Sequence[Light],
    name: str | None,
    ids: Sequence[str],
) -> list[_One]:
    """Each file with its kind, its light, and its capture of the plan."""
    kinds = [recognise(path) for path in files]
    if planned is None:
        lit = [lights[min(i, len(lights) - 1)] if lights else None for i in range(len(files))]
        return [_One(*one) for one in zip(files, kinds, [said] * len(files), lit, strict=True)]
    plan.check_lights(planned, lights, name)
    targets = plan.match(planned, files, ids)
    return [
        _One(path, kind, plan.said_with(said, planned, target), target.light, target)
        for path, kind, target in zip(files, kinds, targets, strict=True)
    ]


def _check_twice(files: Sequence[Path]) -> None:
    """Raise SpadError where two of the files are one: a recording is one capture."""
    first: dict[Any, int] = {}
    for i, path in enumerate(files):
        if (at := first.setdefault(disk.identity(path), i)) != i:
            raise SpadError(f"{path}: is the same file as {files[at]}, and a recording is one capture; name it once")


def _recordings(
    ones: Sequence[_One],
    said: Said,
    array: pixels.Array,
    channels: Channels,
    progress: Progress,
    took: list[Took],
    notes: list[str],
) -> Iterator[Recording]:
    """The data of each file. What was taken of it, and what is to be known, is added to `took` and `notes`."""
    for one in ones:

        def told(share: float, size: int = one.size, name: str = one.path.name) -> None:
            progress.advance(size * share, name)

        found, shape = one.read(), array.layout.shape
        if found.frames is None:
            placed = pixels.events(one.path, found, one.said, one.made, array, channels)
            made, more = placed.recording, tuple(placed.notes)
            yield made
            told(1.0)
            count, left_out = int(made.totals.sum()), (*found.left_out, *placed.left_out)
        else:
            made, seen = stacks.recording(one.path, found, one.said, one.made, array.layout)
            yield made.watched(told)
            count, left_out, more = seen.detections, found.left_out, tuple(seen.notes())
        notes.extend(f"{one.path}: {note}" for note in (*more, *look.silences(made)))
        few = None
        if made.events is not None and array.layout.pixels <= _MOST_COUNTED:
            few = tuple(map(int, made.totals))
        sources = _sources(found, said, one)
        took.append(Took(one.path, one.kind.about, one.made, shape, count, few, made.tick, sources, left_out))


def _check_options(held: Sequence[tuple[Path, type[Format], Sequence[str], bool | None]], said: Said) -> None:
    """Raise SpadError for an option that has an effect on none of the files.

    held: of each file its kind, what it holds or may hold, and whether its frames are packed bits.
    """
    for name in said.given:
        alone = replace(Said(), **{name: getattr(said, name)})
        reasons = [without_effect(alone, kind, modalities, packed) for _, kind, modalities, packed in held]
        if all(reasons):
            raise SpadError(f"{held[0][0]}: {reasons[0]}")


def _sources(found: Found, said: Said, one: _One) -> dict[str, str]:
    """Where tick, exposure, times of frames and the shape come from."""
    sources = dict(found.sources)
    for name in ("tick", "exposure", "frame_time", "frame_period", "rows", "columns"):
        if getattr(said, name) is not None and not (name == "tick" and "tick" in sources):
            sources[name] = word(name)
        elif one.target is not None and getattr(one.said, name) is not None:
            sources[name] = "the plan"
    return sources


def _by(shape: Sequence[int]) -> str:
    return " x ".join(map(str, shape))


# --- how it was recorded ------------------------------------------------------------------------------------------


def _capture(
    one: _One,
    found: Found,
    said: Said,
    planned: measurement.Measurement | None,
    before: Sequence[Capture],
    notes: list[str],
) -> Capture:
    """The capture that a file is: as the plan says, where there is one."""
    if planned is not None and one.target is not None:
        plan.check(found, one.path, said, planned, one.target)
        modality = stacks.modality(one.path, found, one.said)
        if modality == "counts" and not one.said.bits and "bits" not in found.facts:
            raise ask(one.path, ["bits"])
        if found.facts.get("tick", one.said.tick) is None and modality in ("tr", "str"):
            raise ask(one.path, ["tick"])
        return replace(one.target, conditions=plan.clock(found, one.path, one.said, planned, one.target))
    modality = stacks.modality(one.path, found, one.said)
    return _described(one.path, found, one.said, modality, one.light, before, notes)


def _described(
    path: Path,
    found: Found,
    said: Said,
    modality: str,
    lit: Light | None,
    before: Sequence[Capture],
    notes: list[str],
) -> Capture:
    """What the user says, else what the file says, else a question. What the two say unlike goes to `notes`."""
    told = {key: value for key in FACTS if (value := getattr(said, key, None)) is not None}
    known = {**found.facts, **told}
    if said.tick is not None and found.facts.get("tick", said.tick) != said.tick:
        raise InputError(f"{path}: has ticks of {units.show(found.facts['tick'], 's')}; leave out --tick")
    for key in ("bits",) if said.channels is not None else ("rows", "columns", "bits"):
        if getattr(said, key) is not None and found.facts.get(key, getattr(said, key)) != getattr(said, key):
            raise InputError(f"{path}: says that its {key} are {found.facts[key]}; leave out {word(key)}")
    if said.counting is not None and (there := found.facts.get("counting", said.counting)) != said.counting:
        raise InputError(f"{path}: says that its counting is {there}; leave out --counting")
    for key in ("exposure", "frame_time", "frame_period"):
        if key in told and not math.isclose(found.facts.get(key, told[key]), told[key], rel_tol=1e-9):
            there = units.show(found.facts[key], "s", 9)
            notes.append(
                f"{path}: says that its {key} is {there}; {word(key)} is taken, {units.show(told[key], 's', 9)}"
            )
    missing = ["exposure"] if modality == "tr" else ["frame_time", "frame_period"]
    missing += {"tr": ["tick"], "str": ["tick"], "counts": ["bits"]}.get(modality, [])
    missing = [key for key in missing if key not in known]
    described = lit is None  # by the file
    own = _light(path, found, notes if lit is None and said.relative_uncertainty is None else [])
    if lit is not None and own is not None and not _alike(lit, own):
        notes.append(f"{path}: says that its light is {look.light_text(own)}; --light is taken")
    lit = own if lit is None else lit
    if missing or lit is None:
        raise ask(path, missing + ["light"] * (lit is None))
    if said.relative_uncertainty is not None and lit.level is None and described:
        raise InputError(f"{path}: --relative-uncertainty belongs to a light with a level; leave it out")
    if said.relative_uncertainty is not None and lit.level is not None:
        lit = replace(lit, relative_uncertainty=said.relative_uncertainty)
    if found.frames is None:
        exposure = known["exposure"]
        clock = Conditions(exposure, 1, exposure, exposure, lit.wavelength, scene=lit.scene)
    else:
        bits = known["bits"] if modality == "counts" else 0
        counting = (said.counting or known.get("counting", "frames")) if bits else "frames"
        if not 0 <= bits <= 16:
            raise InputError(f"{path}: counts of {bits} bits are not possible; give --bits from 1 to 16")
        held, each = found.frames.shape[0], 1 if counting == "counter" or not bits else (1 << bits) - 1
        frames, time, period = held * each, known["frame_time"], known["frame_period"]
        if frames > MOST_FRAMES:
            raise InputError(
                f"{path}: {held:,} counts of {bits} bits are sums of {frames:,} binary frames, more than the "
                f"{MOST_FRAMES:,} that a capture may have; cut it into several, or give --counting counter"
            )
        if not held:
            raise InputError(f"{path}: holds no frame; name another file")
        if said.frames not in (None, held, frames):
            of = f" of {each:,} binary frames each" if each > 1 else ""
            raise InputError(f"{path}: holds {held:,} frames{of}, not {said.frames:,}; leave out --frames")
        if time > period * (1 + 1e-12):
            times = units.show(time, "s"), units.show(period, "s")
            raise InputError(f"{path}: a frame of {times[0]} does not fit into the frame period of {times[1]}")
        if frames * period > units.LONGEST:
            raise InputError(
                f"{path}: {frames:,} frames with a period of {units.show(period, 's')} last more than "
                f"{units.LONGEST:g} s; correct --frame-period"
            )
        clock = Conditions(frames * period, frames, time, period, lit.wavelength, bits, counting, lit.scene)
    return Capture(safe_name(path.stem, [one.id for one in before]), modality, lit, clock)


def _light(path: Path, found: Found, notes: list[str]) -> Light | None:
    """The light that a file gives, None where it gives none. Raises InputError where it is no one light."""
    known = found.facts
    levels = [kind for kind in ("lux", "irradiance") if kind in known]
    if len(levels) == 2:
        raise InputError(f"{path}: gives the light as lux and as irradiance; keep one of the two")
    uncertain = known.get("relative_uncertainty"), known.get("own_uncertainty", 0.0)
    if not levels:
        if "wavelength" not in known and uncertain[0] is None:
            return None
        return Light(known.get("wavelength"), None, "irradiance", uncertain[0] or 0.0, uncertain[1])
    kind = levels[0]
    wavelength = known.get("wavelength", lights.PLAIN_COLOUR if kind == "lux" else None)
    if wavelength is None:
        raise InputError(
            f'{path}: gives an irradiance and no wavelength; add --light, for example "500 nm '
            f'{units.show(known[kind], "W/m^2", 9)}"'
        )
    if uncertain[0] is None:
        notes.append(_uncertain_note(path, UNCERTAIN))
    return Light(wavelength, known[kind], kind, UNCERTAIN if uncertain[0] is None else uncertain[0], uncertain[1])


def _uncertain_note(path: Path | None, share: float) -> str:
    where = "" if path is None else f"{path}: "
    return (
        f"{where}the light's level is taken as good to {100 * share:.1f} % (one standard deviation); give "
        "--relative-uncertainty where you know better"
    )


def _alike(one: Light, other: Light) -> bool:
    """Are they one light, as far as both say?"""
    same = one.dark == other.dark
    for a, b in ((one.wavelength, other.wavelength), (one.level, other.level)):
        same = same and (a is None or b is None or math.isclose(a, b, rel_tol=1e-9))
    return same and (None in (one.level, other.level) or one.kind_of_level == other.kind_of_level)


def _shape(path: Path, found: Found, said: Said) -> tuple[int, int] | None:
    """Rows and columns as the user or the file says; None where the channels in use are to become pixels."""
    # of channels that the user chooses the file does not know how they lie
    known = {} if found.frames is None and said.channels is not None else found.facts
    rows, columns = (getattr(said, key) or known.get(key) for key in ("rows", "columns"))
    if found.frames is None:
        return (rows or 1, columns or 1) if rows or columns else None
    held = found.frames.shape[1:]
    rows, columns = rows or held[0], columns or found.facts.get("width") or held[1] * (8 if found.packed else 1)
    if held != (rows, -(-columns // 8) if found.packed else columns):
        stored = f"{_by(held)}{' bytes' if found.packed else ''}"
        frames = found.frames.shape[0]
        turned = said.axes is None and not found.packed and (frames, held[0]) == (rows, columns)
        advice = "its frames are the last axis: give --axes HWM" if turned else "correct --rows and --columns"
        raise InputError(f"{path}: its frames are {stored}, not {rows} x {columns} pixels; {advice}")
    return rows, columns
