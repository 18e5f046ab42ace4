"""What files hold, as the captures of one measurement: the same for every kind of file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from .. import config, measurement, units
from ..effects import Conditions
from ..errors import InputError, SpadError
from ..factory import Progress
from ..import_options import options, without_effect, word
from ..recording import Capture, Light, Recording
from . import FACTS, Found, Said, ask, pixels, recognise, stacks
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
        parts = [f"{self.detections:,} detections"]
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
        lines = [f"{capture.id}: {capture.modality}, {head}, {', '.join(parts)}; from {self.file} ({self.kind})"]
        return "\n".join([*lines, *(f"  left out: {what}" for what in self.left_out)])

    def _from(self, name: str) -> str:
        return f" ({self.sources[name]})" if name in self.sources else ""


@dataclass(frozen=True)
class Imported:
    """What was made of some files: the folder, the captures in their order, and what is to be known of the files."""

    folder: Path
    captures: tuple[Capture, ...]
    notes: tuple[str, ...]
    took: tuple[Took, ...] = ()


_MOST_COUNTED = 12  # pixels whose detections are listed one by one


def import_files(
    files: Sequence[Path],
    out: Path,
    said: Said,
    lights: Sequence[Light] = (),
    name: str | None = None,
    progress: Progress | None = None,
) -> Imported:
    """Make a measurement of files, a capture each. lights: one for all files, or one for each, in their order.

    The files are read twice, so that one at a time is in memory: first to know the pixels and to ask for what is
    missing, then to be written. Raises InputError with a sentence.
    """
    if len(lights) not in (0, 1, len(files)):
        raise SpadError(f"--light: {len(lights)} for {len(files)} files; give it once, or once for each file in order")
    if said.relative_uncertainty is not None and lights and all(lit.level is None for lit in lights):
        raise SpadError("--relative-uncertainty: belongs to a light with a level, as in 500 nm 5 nW/cm^2; leave it out")
    kinds = [recognise(path) for path in files]
    _check_options(files, said, [(kind, kind.modalities, None) for kind in kinds])
    sizes = [path.stat().st_size for path in files]
    progress = progress or Progress()
    progress.start("importing", 2.0 * sum(sizes), 0.0)
    captures: list[Capture] = []
    notes: list[str] = []
    shapes: list[tuple[int, int]] = []
    channels, found, held = Channels(), Found(), []
    for i, (path, kind) in enumerate(zip(files, kinds, strict=True)):
        found = kind.read(path, said)
        modality = stacks.modality(path, found, said)
        held.append((kind, (modality,), found.packed))
        lit = lights[min(i, len(lights) - 1)] if lights else None
        captures.append(_capture(path, found, said, modality, lit, captures))
        notes += [f"{path}: {note}" for note in (*found.notes, *stacks.axes_note(found, said))]
        shape = _shape(path, found, said)
        if shape is not None:
            shapes.append(shape)
            if shape != shapes[0]:
                raise InputError(f"{path}: has {_by(shape)} pixels, others {_by(shapes[0])}; import it by itself")
        if found.channel is not None:
            channels.add(path, found)
        progress.advance(sizes[i], path.name)
    _check_options(files, said, held)
    places = None if said.positions is None else config.read_positions(said.positions)
    array = pixels.array(files[0], said, shapes, channels, places)
    if array.channels is not None and array.channels != tuple(range(array.layout.pixels)):
        several = len(array.channels) > 1
        are = "s {} are the pixels, in this order" if several else " {} is the pixel"
        notes.append(f"the channel{are.format(channels.called(array.channels))}")
    took: list[Took] = []

    def recordings() -> Iterator[Recording]:
        for path, kind, size, capture in zip(files, kinds, sizes, captures, strict=True):

            def told(share: float, size: int = size, name: str = path.name) -> None:
                progress.advance(size * share, name)

            again = found if len(files) == 1 else kind.read(path, said)
            sources = _sources(again, said, capture)
            if again.frames is None:
                placed = pixels.events(path, again, said, capture, array, channels)
                yield placed.recording
                told(1.0)
                notes.extend(f"{path}: {note}" for note in placed.notes)
                totals = placed.recording.totals
                few = tuple(map(int, totals)) if len(totals) <= _MOST_COUNTED else None
                left_out = (*again.left_out, *placed.left_out)
                count, tick = int(totals.sum()), placed.recording.tick
            else:
                made, seen = stacks.recording(path, again, said, capture, array.layout)
                yield made.watched(told)
                notes.extend(f"{path}: {note}" for note in seen.notes())
                few, left_out, count, tick = None, again.left_out, seen.detections, made.tick
            took.append(Took(path, kind.about, capture, array.layout.shape, count, few, tick, sources, left_out))

    default = files[0].stem if len(files) == 1 else out.resolve().name
    measurement.write(out, name or safe_name(default), array.layout, recordings(), captures)
    if said.relative_uncertainty is None and (levels := [lit for lit in lights if lit.level is not None]):
        share = levels[0].relative_uncertainty
        notes.append(
            f"the light's level is taken as good to {share:.1%} (one standard deviation); --relative-uncertainty tells"
        )
    return Imported(out, tuple(captures), tuple(notes), tuple(took))


def _check_options(files: Sequence[Path], said: Said, held: Sequence[tuple[Any, Sequence[str], bool | None]]) -> None:
    """Raise SpadError for an option that has an effect on none of the files.

    held: of each file its kind, what it holds or may hold, and whether its frames are packed bits.
    """
    for name in said.given:
        alone = replace(Said(), **{name: getattr(said, name)})
        reasons = [without_effect(alone, kind, modalities, packed) for kind, modalities, packed in held]
        if all(reasons):
            raise SpadError(f"{files[0]}: {reasons[0]}")


def _sources(found: Found, said: Said, capture: Capture) -> dict[str, str]:
    """Where tick, exposure, times of frames and the shape come from."""
    sources = dict(found.sources)
    for name in ("tick", "exposure", "frame_time", "frame_period", "rows", "columns"):
        if getattr(said, name) is not None and not (name == "tick" and "tick" in sources):
            sources[name] = word(name)
    return {name: where for name, where in sources.items() if name in (*FACTS, *options())}


def safe_name(text: str, taken: Sequence[str] = ()) -> str:
    """A name for a capture and its file, unlike those that are taken, whatever the file system thinks of case."""
    stem = name = re.sub(r"[^A-Za-z0-9.+-]+", "_", text).strip("_.")[:80] or "capture"
    n = 1
    while name.lower() in {one.lower() for one in taken}:
        n += 1
        name = f"{stem}-{n}"
    return name


def _by(shape: Sequence[int]) -> str:
    return " x ".join(map(str, shape))


# --- how it was recorded ------------------------------------------------------------------------------------------


def _capture(
    path: Path, found: Found, said: Said, modality: str, lit: Light | None, before: Sequence[Capture]
) -> Capture:
    """What the user says, else what the file says, else a question."""
    told = {key: value for key in FACTS if (value := getattr(said, key, None)) is not None}
    known = {**found.facts, **told}
    if said.tick is not None and found.facts.get("tick", said.tick) != said.tick:
        raise InputError(f"{path}: has ticks of {units.show(found.facts['tick'], 's')}; leave out --tick")
    missing = ["exposure"] if modality == "tr" else ["frame_time", "frame_period"]
    missing += {"tr": ["tick"], "str": ["tick"], "counts": ["bits"]}.get(modality, [])
    missing = [key for key in missing if key not in known]
    if lit is None and "relative_uncertainty" in found.facts:
        kind = "lux" if "lux" in known else "irradiance"
        uncertain = known["relative_uncertainty"], known.get("own_uncertainty", 0.0)
        lit = Light(known.get("wavelength"), known.get(kind), kind, *uncertain)
    if missing or lit is None:
        raise ask(path, missing + ["light"] * (lit is None))
    if said.relative_uncertainty is not None and lit.level is not None:
        lit = replace(lit, relative_uncertainty=said.relative_uncertainty)
    if found.frames is None:
        exposure = known["exposure"]
        clock = Conditions(exposure, 1, exposure, exposure, lit.wavelength)
    else:
        bits = known["bits"] if modality == "counts" else 0
        counter = said.counting == "counter" if said.counting else known.get("counter") == 1
        counting = "counter" if counter and bits else "frames"
        if not 0 <= bits <= 16:
            raise InputError(f"{path}: counts of {bits} bits are not possible; give --bits from 1 to 16")
        held, each = found.frames.shape[0], 1 if counting == "counter" or not bits else (1 << bits) - 1
        frames, time, period = held * each, known["frame_time"], known["frame_period"]
        if not held:
            raise InputError(f"{path}: holds no frame; name another file")
        if said.frames not in (None, held, frames):
            of = f" of {each:,} binary frames each" if each > 1 else ""
            raise InputError(f"{path}: holds {held:,} frames{of}, not {said.frames:,}; leave out --frames")
        if time > period * (1 + 1e-12):
            times = units.show(time, "s"), units.show(period, "s")
            raise InputError(f"{path}: a frame of {times[0]} does not fit into the frame period of {times[1]}")
        clock = Conditions(frames * period, frames, time, period, lit.wavelength, bits, counting)
    return Capture(safe_name(path.stem, [one.id for one in before]), modality, lit, clock)


def _shape(path: Path, found: Found, said: Said) -> tuple[int, int] | None:
    """Rows and columns as the user or the file says; None where the channels in use are to become pixels."""
    rows, columns = (getattr(said, key) or found.facts.get(key) for key in ("rows", "columns"))
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
