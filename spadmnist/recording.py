"""Recording: what a sensor handed out in one capture, simulated or measured, with the conditions it was made under.

Simulated and measured data are the same type, so that no statistic can know which it looks at.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from . import bit_planes, light
from .effects import Conditions
from .errors import InputError
from .events import Events, Layout, SealedEvents, read_only
from .readout import Recorded, no_detection, unsigned_for
from .scene import Scene
from .units import show

T = TypeVar("T")

MODALITIES = ("tr", "str", "qis", "counts")
_FEW_TICKS = 64  # between the first stamp and the last: a rate changes within one
# detections, at most, whose ticks are widened: they take 34 MB then, far less than what simulates as many
_WIDENED = 1 << 22
# s: the ticks in which a file holds times that have none: converters have 10 ps and more
FINEST = 1e-12
_EVENTS_AT_ONCE = 1 << 20  # detections whose arithmetic needs further memory
_CHUNK = 16 * 2**20  # bytes of frames that are looked at together
_BLOCKS = (16, 8, 4)  # of time, of which every other one makes half a capture: as many as lose no more than this
_LOSS = 0.1
# In ticks: after it every period of a converter's clock that is looked for begins anew.
COMMON_PERIOD = 2**8 * 3 * 5**3 * 7


@dataclass(frozen=True)
class Light:
    """What fell on the sensor during a capture.

    Attributes:
        wavelength: m; None in a dark capture.
        level: irradiance in W/m^2 or illuminance in lux, as `kind_of_level` says; None where it is not known.
        kind_of_level: "irradiance" or "lux".
        relative_uncertainty: relative standard uncertainty of the light's calibration, common to all captures.
        own_uncertainty: that of this capture alone, relative.
        scene: the image that the light follows, whose white has that level; None where it is the same on all pixels.
    """

    wavelength: float | None = None
    level: float | None = None
    kind_of_level: str = "irradiance"
    relative_uncertainty: float = 0.0
    own_uncertainty: float = 0.0
    scene: Scene | None = None

    @property
    def dark(self) -> bool:
        """No light falls on the sensor."""
        return self.wavelength is None


@dataclass(frozen=True)
class Capture:
    """One entry of a measurement: how it was made.

    Attributes:
        id: its name.
        modality: "tr", "str", "qis" or "counts".
        light: what fell on the sensor, a `Light`.
        conditions: exposure, frames and wavelength, a `spadmnist.Conditions`.
        mean: detections per pixel over the capture where that alone is known; otherwise None.
        tick: s, in which stamps are written; None where they are written as the converter gives them.
    """

    id: str
    modality: str
    light: Light
    conditions: Conditions
    mean: float | None = None
    tick: float | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be known of its description before it is used."""
        lit = self.light
        if lit.level is None or lit.wavelength is None or lit.kind_of_level != "lux":
            return ()
        note = light.of_lux(lit.wavelength)
        return () if note is None else (note,)

    @property
    def counts_events(self) -> bool:
        """Is every detection counted, and not the frames that have one?"""
        return self.modality == "tr" or (self.modality == "counts" and self.conditions.counting == "counter")


class FirstStamps(NamedTuple):
    """First stamps (STR) of some frames, frame by frame and in the order of the pixels.

    offsets: (frames + 1,); stamps: (stamps,) ticks since the start of their frame; pixels: (stamps,) int32.
    """

    offsets: np.ndarray
    stamps: np.ndarray
    pixels: np.ndarray

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return sum(array.nbytes for array in self)

    def of(self, start: int, stop: int) -> FirstStamps:
        """Those of the frames from `start` to `stop`."""
        some = slice(int(self.offsets[start]), int(self.offsets[stop]))
        return FirstStamps(self.offsets[start : stop + 1] - some.start, self.stamps[some], self.pixels[some])


class FrameSource(Protocol):
    """Frames on disk or in memory, read in pieces."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(frames, rows, bytes per row) where bits are packed (QIS), otherwise (frames, rows, columns)."""
        ...

    def __getitem__(self, part: slice) -> np.ndarray: ...


@dataclass(frozen=True)
class Recording:
    """Data of one capture.

    TR: events, one row per pixel. Frames: QIS packed along the columns, most significant bit first, (frames, rows,
    ceil(columns / 8)) uint8; STR (frames, rows, columns) unsigned ticks since the start of the frame, `none` where
    there is no detection; counts (frames, rows, columns) unsigned. tick: s, of the stamps, None where they are seconds.
    dead_time: s, what the sensor's description states (its median), so that statistics know where to look; it is the
    same for data and model. untimed: the ticks of TR are those of a file alone, which holds times that had none.
    """

    capture: Capture
    layout: Layout
    events: Events | None = None
    frames: FrameSource | None = None
    tick: float | None = None
    dead_time: float = 0.0
    _kept: dict[str, object] = field(default_factory=dict, repr=False, compare=False)
    untimed: bool = False

    @property
    def modality(self) -> str:
        return self.capture.modality

    @property
    def conditions(self) -> Conditions:
        return self.capture.conditions

    @property
    def pixels(self) -> int:
        return self.layout.pixels

    @property
    def none(self) -> int:
        """The stamp that means 'no detection' (STR)."""
        return no_detection(self.conditions.frame_time, self.tick or 1.0)

    @property
    def n_frames(self) -> int:
        """Frames of this readout (count frames for `counts`)."""
        return 0 if self.frames is None else self.frames.shape[0]

    def pieces(self) -> Iterator[tuple[int, int]]:
        """(number of the first frame, of the one behind the last) of as many as are looked at together."""
        assert self.frames is not None
        size = int(np.prod(self.frames.shape[1:])) * (1 if self.modality == "qis" else 4)
        step = max(8, _CHUNK // max(1, size))
        for start in range(0, self.n_frames, step):
            yield start, min(start + step, self.n_frames)

    def chunks(self) -> Iterator[tuple[int, np.ndarray]]:
        """(number of the first frame, frames) piece by piece, so that a large capture never lies in memory whole."""
        assert self.frames is not None
        for start, stop in self.pieces():
            yield start, np.asarray(self.frames[start:stop])

    def stamped(self) -> Iterator[tuple[int, FirstStamps]]:
        """(number of the first frame, first stamps of some frames) piece by piece, for STR."""
        assert self.frames is not None
        for start, stop in self.pieces():
            if isinstance(self.frames, StampedFrames):
                yield start, self.frames.found.of(start, stop)
            else:
                flat = np.ascontiguousarray(self.frames[start:stop]).reshape(stop - start, -1)
                yield start, FirstStamps(*bit_planes.stamps_of_frames(flat, self.none))

    def bits(self) -> Iterator[tuple[int, np.ndarray]]:
        """(number of the first frame, (frames, rows, ceil(columns / 8)) uint8): which pixels have a detection.

        For QIS and STR, and for counts (at least one).
        """
        for start, part in self.chunks():
            if self.modality == "qis":
                yield start, part
            else:
                yield start, np.packbits(part < self.none if self.modality == "str" else part > 0, axis=2)

    @property
    def totals(self) -> np.ndarray:
        """(pixels,) detections of each pixel (counts of all frames for `counts`)."""
        return self.kept("totals", self._totals)

    @property
    def waited(self) -> tuple[np.ndarray, np.ndarray] | None:
        """STR: how long (each pixel, (pixels,); the array in each frame, (frames,)) waited for first detections.

        In frames, of which counts what lies between the first and the last of all stamps: a gate may leave no more. A
        frame without a detection is waited through to its end. Of steady light, the detections and this time tell all
        that the stamps do: their ratio is the rate, with the relative variance of so many detections, where frames
        without are few and tell less. None where ticks are too long to tell it, and of other data.
        """
        return self.kept("waited", self._waited) if self.modality == "str" else None

    def _waited(self) -> tuple[np.ndarray, np.ndarray] | None:
        first, last = self.none, -1
        for _, found in self.stamped():
            if len(found.stamps):
                first, last = min(first, int(found.stamps.min())), max(last, int(found.stamps.max()))
        if last - first < _FEW_TICKS:
            return None
        of_pixels, of_frames = np.zeros(self.pixels), np.zeros(self.n_frames)
        for start, found in self.stamped():
            bit_planes.add_waits(*found, first, last, of_pixels, of_frames[start : start + len(found.offsets) - 1])
        return of_pixels, of_frames

    def kept(self, name: str, make: Callable[[], T]) -> T:
        """What is computed of the data by name: made when it is first asked for, then kept with them."""
        if name not in self._kept:
            self._kept[name] = make()
        return self._kept[name]  # type: ignore[return-value]

    def _totals(self) -> np.ndarray:
        if self.events is not None:
            return np.asarray(self.events.counts)
        out = np.zeros(self.pixels, np.int64)
        if self.modality == "counts":
            for _, part in self.chunks():
                out += part.reshape(len(part), -1).sum(axis=0, dtype=np.int64)
            return out
        for _, packed in self.bits():
            bit_planes.column_sums(np.ascontiguousarray(packed), self.layout.columns, out)
        return out

    def named(self, capture: Capture) -> Recording:
        """The same data under another entry."""
        return replace(self, capture=capture)

    def beside(self, dead_time: float) -> Recording:
        """The same data, beside another sensor's dead time."""
        still = {name: x for name, x in self._kept.items() if name in ("totals", "waited")}
        return replace(self, dead_time=dead_time, _kept=still)

    def sealed(self) -> Recording:
        """The same data for somebody else's code, which cannot change them."""
        events = None if self.events is None else SealedEvents(self.events)
        frames = read_only(self.frames) if isinstance(self.frames, np.ndarray) else self.frames
        kept = {name: read_only(x) if isinstance(x, np.ndarray) else x for name, x in self._kept.items()}
        return replace(self, events=events, frames=frames, _kept=kept | {"totals": read_only(self.totals)})

    def widened(self) -> Recording:
        """The same data with ticks of time stamps of 64 bits, of which kernels are compiled for one type alone.

        Of very many detections they stay as they are.
        """
        events = self.events
        if events is None or events.ticks is None or len(events) > _WIDENED:
            return self
        ticks = events.ticks.astype(np.uint64, copy=False)
        return self if ticks is events.ticks else replace(self, events=events.stamped(ticks, float(events.tick or 0)))

    def on_ticks(self, tick: float) -> Recording:
        """The same stamps as a file has them that counts in other ticks (s): rounded down."""
        if self.modality not in ("tr", "str") or (
            self.tick is not None and math.isclose(self.tick, tick, rel_tol=1e-9)
        ):
            return self
        if self.events is not None:
            end = no_detection(self.conditions.exposure, tick)
            ticks = np.empty(len(self.events), unsigned_for(end, "time stamps"))
            for part in _pieces(len(ticks)):
                ticks[part] = whole_ticks(self.events.times_of(part) / tick, end - 1)
            events = Events(None, self.events.offsets, self.pixels, ticks, tick, end=self.conditions.exposure)
            return replace(self, events=events, tick=tick, untimed=False, _kept={})
        assert self.frames is not None and self.tick is not None
        none = no_detection(self.conditions.frame_time, tick)
        frames = np.empty(self.frames.shape, unsigned_for(none, "time stamps"))
        for start, stamps in self.chunks():
            whole = whole_ticks(stamps * (self.tick / tick), none - 1)
            frames[start : start + len(stamps)] = np.where(stamps == self.none, none, whole)
        return replace(self, frames=frames, tick=tick, _kept={})

    def by_clock(self, tick: float) -> Recording:
        """TR without ticks of its own on those of a sensor's converter (s; 0: it has none); any other as it is.

        The times are first those that a file would hold, so that a capture is the same before it is saved and after.
        """
        if self.events is None or not (self.tick is None or self.untimed):
            return self
        held = self.on_ticks(FINEST)
        return held.on_ticks(tick) if tick else held

    def every_other(self, second: bool) -> Recording | None:
        """Every other block of time, one after the other, as a capture half as long; None where it is too short.

        Of up to 16 blocks the first and all odd ones, or (`second`) the even ones. A block has whole ticks, and whole
        periods of the converter's clock where that does not leave much of the capture's end to neither.
        """
        c = self.conditions
        if self.frames is not None:
            n = self.n_frames
            if n < 2:
                return None
            blocks = next((b for b in (*_BLOCKS, 2) if n // b * b > (1 - _LOSS) * n), min(_BLOCKS[0], n) // 2 * 2)
            frames = _EveryOther(self.frames, self.n_frames // blocks, blocks // 2, second)
            share = c.frames // self.n_frames * frames.shape[0]  # of which each count frame is a sum
            half = replace(c, frames=share, exposure=share * c.frame_period)
            return replace(self, capture=replace(self.capture, conditions=half), frames=frames, _kept={})
        assert self.events is not None
        stamps: np.ndarray = self.events.times if self.events.ticks is None else self.events.ticks
        blocks, length = _BLOCKS[0], c.exposure / _BLOCKS[0]
        if self.events.ticks is not None:
            assert self.tick is not None
            blocks, length = _in_ticks(c.exposure / self.tick)
        if not length:
            return None
        kept = np.empty(len(stamps), bool)
        for part in _pieces(len(stamps)):
            block = stamps[part] // length
            kept[part] = (block % 2 == second) & (block < blocks)
        some = self.events.keep(kept)
        moved: np.ndarray = some.times if some.ticks is None else some.ticks
        for part in _pieces(len(moved)):
            number = moved[part] // length // 2
            moved[part] -= ((number + second) * length).astype(moved.dtype)
        end = blocks // 2 * length * (1.0 if self.events.ticks is None else float(self.tick or 1.0))
        if self.events.ticks is None:
            events = Events(moved, some.offsets, self.pixels, end=end)
        else:
            events = Events(None, some.offsets, self.pixels, moved, self.tick, end=end)
        half = replace(c, exposure=end, frame_time=end, frame_period=end)
        return replace(self, capture=replace(self.capture, conditions=half), events=events, _kept={})

    def watched(self, read: Callable[[float], None]) -> Recording:
        """The same data; `read` is told which share of the frames is read, each time."""
        return self if self.frames is None else replace(self, frames=_Watched(self.frames, read))


def _pieces(count: int) -> Iterator[slice]:
    """So many detections, some after the other."""
    return (slice(start, min(start + _EVENTS_AT_ONCE, count)) for start in range(0, count, _EVENTS_AT_ONCE))


def _in_ticks(exposure: float) -> tuple[int, int]:
    """(blocks, length of each, in ticks)."""
    for blocks in _BLOCKS:
        length = int(exposure / blocks) // COMMON_PERIOD * COMMON_PERIOD
        if length * blocks > (1 - _LOSS) * exposure:
            return blocks, length
    return _BLOCKS[0], int(exposure / _BLOCKS[0])


def whole_ticks(stamps: np.ndarray, last: int) -> np.ndarray:
    """Stamps rounded down to whole ticks: what a product of two numbers lacks of one is none."""
    return np.minimum(np.floor(stamps + np.maximum(1e-6, 4 * np.spacing(stamps))), last)


@dataclass(frozen=True)
class StampedFrames:
    """Frames that are held as their first stamps (STR), and filled where they are read.

    none: the stamp where there is no detection; shape: (frames, rows, columns).
    """

    found: FirstStamps
    none: int
    shape: tuple[int, int, int]

    def __getitem__(self, part: slice) -> np.ndarray:
        """(frames, rows, columns) uint32."""
        start, stop, step = part.indices(self.shape[0])
        first, last = (start, max(start, stop)) if step > 0 else (min(start, stop) + 1, start + 1)
        out = np.full((max(0, last - first), self.shape[1] * self.shape[2]), self.none, np.uint32)
        if len(out):
            bit_planes.fill_stamps(*self.found.of(first, last), out)
        return out.reshape(-1, *self.shape[1:])[::step]


@dataclass(frozen=True)
class _EveryOther:
    """Of each two blocks of `length` frames one, `blocks` in all."""

    frames: FrameSource
    length: int
    blocks: int
    second: bool

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.length * self.blocks, *self.frames.shape[1:])

    def __getitem__(self, part: slice) -> np.ndarray:
        numbers = np.arange(*part.indices(self.shape[0]))
        if not len(numbers):
            return np.asarray(self.frames[0:0])
        whole = numbers + (numbers // self.length + self.second) * self.length
        first = int(whole.min())
        return np.asarray(self.frames[first : int(whole.max()) + 1])[whole - first]


@dataclass(frozen=True)
class _Watched:
    """Frames that tell when they are read."""

    frames: FrameSource
    read: Callable[[float], None]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.frames.shape

    def __getitem__(self, part: slice) -> np.ndarray:
        out = self.frames[part]
        self.read(len(out) / max(1, self.shape[0]))
        return out


def of_image(recorded: Recorded, image: int, capture: Capture, layout: Layout, dead_time: float) -> Recording:
    """One simulated image as the recording of a capture. recorded: with the readout that the capture asks for."""
    one = recorded.images(image, image + 1)
    if capture.modality == "tr":
        assert one.tr is not None
        return Recording(capture, layout, one.tr, None, one.tr.tick, dead_time)
    rows, columns = layout.shape
    if capture.modality == "counts":
        assert one.tally is not None
        return Recording(capture, layout, None, one.tally.T.reshape(-1, rows, columns), None, dead_time)
    assert one.frames is not None
    if capture.modality == "qis":
        packed = bit_planes.frames_first(one.frames.bits, one.frames.frames, rows, columns)
        return Recording(capture, layout, None, packed, None, dead_time)
    first = one.frames.first
    assert first is not None
    if first.tick is None or first.ticks is None:
        raise ValueError("STR without a converter cannot be a recording: stamps are whole ticks")
    none = no_detection(capture.conditions.frame_time, first.tick)
    if none >= 1 << 32:
        frame, tick = (show(x, "s") for x in (capture.conditions.frame_time, first.tick))
        raise InputError(f"{capture.id}: STR stamps of {tick} in frames of {frame} need more than 32 bits")
    found = FirstStamps(*bit_planes.stamps_by_frame(one.frames.bits, first.offsets, first.ticks, one.frames.frames))
    frames = StampedFrames(found, none, (one.frames.frames, rows, columns))
    totals: dict[str, object] = {"totals": np.diff(first.offsets)}
    return Recording(capture, layout, None, frames, first.tick, dead_time, totals)
