"""What files hold, as the captures of one measurement: the same for every kind of file."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import config, measurement, units
from ..effects import Conditions
from ..errors import InputError, SpadError
from ..events import Events, Layout
from ..factory import Progress
from ..readout import counts_type, no_detection, unsigned_for
from ..recording import Capture, Light, Recording
from . import FACTS, MOST_CHANNELS, Found, Said, Stack, ask, recognise

_AT_ONCE = 1 << 24  # bytes of frames, as they are stored


@dataclass(frozen=True)
class Imported:
    """What was made of some files: the folder, the captures in their order, and what is to be known of the files."""

    folder: Path
    captures: tuple[Capture, ...]
    notes: tuple[str, ...]


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
    kinds = [recognise(path) for path in files]
    sizes = [path.stat().st_size for path in files]
    progress = progress or Progress()
    progress.start("importing", 2.0 * sum(sizes), 0.0)
    captures: list[Capture] = []
    notes: list[str] = []
    shapes: list[tuple[int, int]] = []
    used = np.zeros(0, bool)  # the channels
    found = Found()
    for i, (path, kind) in enumerate(zip(files, kinds, strict=True)):
        found = kind.read(path, said)
        captures.append(_capture(path, found, said, lights[min(i, len(lights) - 1)] if lights else None, captures))
        notes += [f"{path}: {note}" for note in found.notes]
        shape = _shape(path, found, said)
        if shape is not None:
            shapes.append(shape)
            if shape != shapes[0]:
                raise InputError(f"{path}: has {_by(shape)} pixels, others {_by(shapes[0])}; import it by itself")
        if found.channel is not None:
            here = np.bincount(_channels(path, found)).astype(bool)
            used = np.pad(used, (0, max(0, len(here) - len(used))))
            used[: len(here)] |= here
        progress.advance(sizes[i], path.name)
    layout = _layout(files[0], said, shapes, int(used.sum()))
    pixel_of = None if shapes or said.positions is not None else np.cumsum(used) - 1
    if pixel_of is not None and not used.all():
        notes.append(f"the channels {', '.join(map(str, np.flatnonzero(used)[:20]))} are the pixels 0, 1, ...")

    def recordings() -> Iterator[Recording]:
        for path, kind, size, capture in zip(files, kinds, sizes, captures, strict=True):

            def told(share: float, size: int = size, name: str = path.name) -> None:
                progress.advance(size * share, name)

            again = found if len(files) == 1 else kind.read(path, said)
            if again.frames is None:
                yield _events(path, again, said, capture, layout, pixel_of)
                told(1.0)
            else:
                yield _frames(path, again, said, capture, layout).watched(told)

    default = files[0].stem if len(files) == 1 else out.resolve().name
    measurement.write(out, name or safe_name(default), layout, recordings(), captures)
    return Imported(out, tuple(captures), tuple(notes))


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


def _capture(path: Path, found: Found, said: Said, lit: Light | None, before: Sequence[Capture]) -> Capture:
    """What the user says, else what the file says, else a question."""
    told = {key: value for key in FACTS if (value := getattr(said, key, None)) is not None}
    known = {**found.facts, **told}
    if said.tick is not None and found.facts.get("tick", said.tick) != said.tick:
        raise InputError(f"{path}: has ticks of {units.show(found.facts['tick'], 's')}; leave out --tick")
    modality = _modality(path, found, said)
    missing = ["exposure"] if modality == "tr" else ["frame_time", "frame_period"]
    missing += {"tr": ["tick"], "str": ["tick"], "counts": ["bits"]}.get(modality, [])
    missing = [key for key in missing if key not in known]
    if lit is None and "relative_uncertainty" in found.facts:
        kind = "lux" if "lux" in known else "irradiance"
        uncertain = known["relative_uncertainty"], known.get("own_uncertainty", 0.0)
        lit = Light(known.get("wavelength"), known.get(kind), kind, *uncertain)
    if missing or lit is None:
        raise ask(path, missing + ["light"] * (lit is None))
    if said.relative_uncertainty is not None:
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


def _modality(path: Path, found: Found, said: Said) -> str:
    """tr, qis, str or counts, from what is there, what is said, and for frames of whole numbers from their values."""
    told = said.modality
    if told is not None and ((found.frames is None) != (told == "tr") or (found.packed and told != "qis")):
        what = "packed bits, which are qis" if found.packed else "frames" if found.frames is not None else "tr"
        raise InputError(f"{path}: holds {what}, and no {told}; leave out --modality")
    if found.frames is None:
        return "tr"
    if told or found.packed or found.bits:
        return told or "qis"
    if said.bits or "bits" in found.facts:
        return "counts"
    if "tick" in found.facts:
        return "str"
    step = max(1, _AT_ONCE // max(1, math.prod(found.frames.shape[1:]) * found.frames.dtype.itemsize))
    for start in range(0, found.frames.shape[0], step):
        if found.frames[start : start + step].max(initial=0) > 1:
            raise InputError(
                f"{path}: holds numbers above 1, so they are no bits; give --bits where they are counts, --modality "
                "str and --tick where they are time stamps, --packed where a byte is eight columns"
            )
    return "qis"


# --- the array ----------------------------------------------------------------------------------------------------


def _shape(path: Path, found: Found, said: Said) -> tuple[int, int] | None:
    """Rows and columns as the user or the file says; None where the channels in use are to become pixels."""
    rows, columns = (getattr(said, key) or found.facts.get(key) for key in ("rows", "columns"))
    if found.frames is None:
        return (rows or 1, columns or 1) if rows or columns else None
    held = found.frames.shape[1:]
    rows, columns = rows or held[0], columns or found.facts.get("width") or held[1] * (8 if found.packed else 1)
    if held != (rows, -(-columns // 8) if found.packed else columns):
        stored = f"{_by(held)}{' bytes' if found.packed else ''}"
        raise InputError(
            f"{path}: its frames are {stored}, not {rows} x {columns} pixels; correct --rows and --columns"
        )
    return rows, columns


def _layout(path: Path, said: Said, shapes: Sequence[tuple[int, int]], channels: int) -> Layout:
    rows, columns = shapes[0] if shapes else (1, channels)
    if said.positions is not None:
        positions = config.read_positions(said.positions)
        if shapes and (rows, columns) != (1, len(positions)):
            raise InputError(f"{said.positions}: names {len(positions)} pixels, but {path} has {rows} x {columns}")
        return Layout(1, len(positions), np.nan, np.nan, positions)
    if not 0 < rows * columns <= MOST_CHANNELS:
        if columns:
            raise InputError(f"{path}: {rows} x {columns} pixels are more than the {MOST_CHANNELS:,} that can be held")
        raise InputError(f"{path}: holds no detection at all; give --rows and --columns to import it nevertheless")
    return Layout(rows, columns, np.nan, np.nan)


def _channels(path: Path, found: Found) -> np.ndarray:
    """The channel of each detection, as numbers that can be indices."""
    channel, ticks = found.channel, found.ticks
    assert channel is not None and ticks is not None
    if channel.shape != ticks.shape:
        raise InputError(f"{path}: has {len(ticks):,} times and {len(channel):,} pixels; it needs as many of both")
    if len(channel) and not 0 <= int(channel.min()) <= int(channel.max()) < MOST_CHANNELS:
        raise InputError(f"{path}: has a channel {channel.max()}; channels are 0 to {MOST_CHANNELS - 1}")
    return channel.astype(np.int64) if channel.dtype.itemsize > 4 or channel.dtype.kind == "b" else channel


# --- the data -----------------------------------------------------------------------------------------------------


def _events(
    path: Path, found: Found, said: Said, capture: Capture, layout: Layout, pixel_of: np.ndarray | None
) -> Recording:
    """Detections as rows of pixels, in time order."""
    channel, ticks, exposure, pixels = _channels(path, found), found.ticks, capture.conditions.exposure, layout.pixels
    tick = found.facts.get("tick", said.tick)
    assert ticks is not None and tick is not None
    pixel = channel if pixel_of is None else pixel_of[channel]
    if len(pixel) and int(pixel.max()) >= pixels:
        raise InputError(
            f"{path}: the channel {pixel.max()} lies beyond the {_by(layout.shape)} pixels; give other --rows and "
            "--columns, or neither, and the channels in use become pixels in their order"
        )
    end = no_detection(exposure, tick)
    if tick > exposure or (len(ticks) and not 0 <= int(ticks.min()) <= int(ticks.max()) <= end):
        low, high = (units.show(float(t) * tick, "s", 9) for t in (ticks.min(initial=0), ticks.max(initial=0)))
        raise InputError(
            f"{path}: its times, in ticks of {units.show(tick, 's')}, reach from {low} to {high}, outside the exposure "
            f"of {units.show(exposure, 's', 9)}; give another --exposure"
        )
    # the stable sort of 16-bit integers counts them
    order = np.argsort(pixel.astype(np.uint16 if pixels <= 1 << 16 else np.uint32), kind="stable")
    offsets = np.concatenate([[0], np.cumsum(np.bincount(pixel, minlength=pixels))]).astype(np.int64)
    ticks = ticks[order].astype(unsigned_for(end, f"{path}: time stamps"))
    earlier = ticks[1:] < ticks[:-1]
    firsts = offsets[1:-1]
    earlier[firsts[(firsts > 0) & (firsts < len(ticks))] - 1] = False
    if earlier.any():
        ticks = ticks[np.lexsort((ticks, np.repeat(np.arange(pixels), np.diff(offsets))))]
    return Recording(capture, layout, Events(None, offsets, pixels, ticks, tick, end=exposure), None, tick)


_MIRRORED = np.packbits(np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1)[:, ::-1], axis=1)[:, 0]


def _frames(path: Path, found: Found, said: Said, capture: Capture, layout: Layout) -> Recording:
    """Frames as a `Recording` has them, read and checked piece by piece."""
    stack, columns, modality, c = found.frames, layout.columns, capture.modality, capture.conditions
    assert stack is not None
    tick = found.facts.get("tick", said.tick) if modality == "str" else None
    most, why = 1, "a bit is 0 or 1"
    kind: np.dtype[Any] = np.dtype(np.uint8)
    if modality == "str":
        most, kind = no_detection(c.frame_time, float(tick or 1.0)), np.dtype(np.uint32)
        why = f"a frame of {units.show(c.frame_time, 's')} ends at {most} ticks, which means no detection"
    elif modality == "counts":
        most, kind = c.largest_count, np.dtype(counts_type(c.largest_count))
        why = f"{c.bits} bits count up to {most}"
    if found.packed and stack.dtype != np.uint8:
        raise InputError(f"{path}: packed frames are {stack.dtype}; store uint8")

    def checked(piece: np.ndarray, start: int) -> np.ndarray:
        if found.packed:
            piece = _MIRRORED[piece] if said.bit_order == "little" else piece
            if columns % 8 and (piece[:, :, -1] & (0xFF >> columns % 8)).any():
                raise InputError(f"{path}: bits beyond the {columns} columns are set; correct --columns or --bit-order")
            return piece
        low, high = int(piece.min(initial=0)), int(piece.max(initial=0))
        if low < 0 or high > most:
            wrong = low if low < 0 else high
            raise InputError(f"{path}: {wrong} stands in the frames from {start} on, but {why}; correct it")
        return np.packbits(piece, axis=2) if modality == "qis" else piece.astype(kind)

    shape = (*stack.shape[:2], -(-columns // 8) if modality == "qis" else columns)
    step = max(1, _AT_ONCE // max(1, math.prod(stack.shape[1:]) * stack.dtype.itemsize))

    def get(start: int, stop: int) -> np.ndarray:
        out = np.empty((stop - start, *shape[1:]), kind)
        for first in range(start, stop, step):
            piece = stack[first : min(first + step, stop)]
            out[first - start : first - start + len(piece)] = checked(piece, first)
        return out

    return Recording(capture, layout, None, Stack(shape, kind, get), tick)
