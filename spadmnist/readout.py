"""TR, STR and QIS: what a sensor hands out of one and the same avalanches."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from . import bit_planes, estimators, kernels
from .errors import SpadError
from .events import Events

_BYTES_AT_ONCE = 2**24  # of packed bits that are counted together

READOUTS = ("tr", "str", "qis", "counts")


def unsigned_for(largest: float, what: str) -> type[np.unsignedinteger]:
    """The unsigned type (32 or 64 bits) that holds integers up to `largest`. Raises SpadError where none does."""
    if round(largest) < 2**32:
        return np.uint32
    if round(largest) < 2**52:
        return np.uint64
    raise SpadError(
        f"{what} would reach {largest:.3g} ticks, beyond what a time stamp can hold; "
        "shorten the exposure or take a coarser TDC resolution"
    )


def stamps_for(largest: float, what: str) -> type[np.unsignedinteger]:
    """Like `unsigned_for`, of stamps that are read and not drawn: whole numbers up to 2^63. Seconds made of them are
    doubles, exact to 2^53 ticks and to one part in 10^16 beyond.
    """
    return np.uint64 if 2**52 <= largest < 2**63 else unsigned_for(largest, what)


def no_detection(frame_time: float, tick: float) -> int:
    """The stamp that means 'none' in STR: ceil(frame time / tick), beyond every real stamp."""
    ratio = frame_time / tick
    return round(ratio) if abs(ratio - round(ratio)) < 1e-6 * max(1.0, ratio * 1e-6) else math.ceil(ratio)


@dataclass(frozen=True)
class Frames:
    """Frames of many rows, a row being one pixel of one image.

    Attributes:
        bits: (rows, ceil(frames / 8)) uint8: is there a detection? Most significant bit first.
        first: for each bit set, in order, the first stamp since the start of its frame, as `Events`; None where STR is
            not recorded.
        frames: number of frames.
        frame_time: s.
        pixels: rows per image.
        cause, parent: for each bit set, in order, what made the detection, as in `Events`; None where not asked for.
    """

    bits: np.ndarray
    first: Events | None
    frames: int
    frame_time: float
    pixels: int
    cause: np.ndarray | None = None
    parent: np.ndarray | None = None

    @property
    def detections(self) -> Events:
        """Every bit set as an event of its row: its cause and its parent. The times are empty."""
        ones = _ones(self.bits)
        offsets = np.concatenate([[0], np.cumsum(ones)])
        return Events(np.zeros(int(offsets[-1])), offsets, self.pixels, cause=self.cause, parent=self.parent)

    def unpacked(self) -> np.ndarray:
        """(images, frames, pixels) uint8, 0 or 1: QIS."""
        out = np.empty((len(self.bits) // self.pixels, self.frames, self.pixels), np.uint8)
        for image, rows in enumerate(self._rows(len(out))):
            bit_planes.bits_first(self.bits[rows], out[image])
        return out

    def stamps(self, kind: type[np.floating] = np.float64) -> np.ndarray:
        """(images, frames, pixels), s since the start of the frame; the frame time where there is none: STR.

        kind: of floats. No stamp becomes the frame time where it is rounded to them.
        """
        if self.first is None:
            raise SpadError("STR was not recorded")
        out = np.empty((len(self.bits) // self.pixels, self.frames, self.pixels), kind)
        times, offsets = _below(self.first.times, self.frame_time, kind), self.first.offsets
        for image, rows in enumerate(self._rows(len(out))):
            out[image] = self.frame_time  # just before, so that it is still in the cache
            bit_planes.stamps_first(self.bits[rows], offsets[rows.start : rows.stop + 1], times, out[image])
        return out

    def _rows(self, images: int) -> list[slice]:
        """The rows of each image."""
        return [slice(image * self.pixels, (image + 1) * self.pixels) for image in range(images)]

    def images(self, start: int, stop: int) -> Frames:
        """The images `start` to `stop` alone."""
        rows = slice(start * self.pixels, stop * self.pixels)
        first = None if self.first is None else self.first.images(start, stop)
        cause = parent = None
        if self.cause is not None:
            part = self.detections.images(start, stop)
            cause, parent = part.cause, part.parent
        return Frames(self.bits[rows], first, self.frames, self.frame_time, self.pixels, cause, parent)

    def take(self, images: np.ndarray) -> Frames:
        """Some images, in any order, repeated or not."""
        rows = (np.asarray(images)[:, None] * self.pixels + np.arange(self.pixels)).reshape(-1)
        first = None if self.first is None else self.first.take(images)
        cause = parent = None
        if self.cause is not None:
            part = self.detections.take(images)
            cause, parent = part.cause, part.parent
        return Frames(self.bits[rows], first, self.frames, self.frame_time, self.pixels, cause, parent)

    @staticmethod
    def join(parts: list[Frames]) -> Frames:
        """Several batches, one after the other."""
        if len(parts) == 1:
            return parts[0]
        one = parts[0]
        if len({(p.frames, p.frame_time, p.pixels) for p in parts}) > 1:
            raise SpadError("frames of another number, time or size cannot be joined; read them apart")
        first = None if one.first is None else Events.join([f.first for f in parts if f.first is not None])
        cause = parent = None
        if one.cause is not None:
            made = Events.join([f.detections for f in parts])
            cause, parent = made.cause, made.parent
        bits = np.concatenate([f.bits for f in parts])
        return Frames(bits, first, one.frames, one.frame_time, one.pixels, cause, parent)


@dataclass(frozen=True)
class Recorded:
    """What the sensor made of some images: the streams, and per row what reconstructions need of them.

    counts: recorded detections N; span: s from the first to the last stamp, 0 where N < 2; ones: frames with a
    detection; waited: s, the sum over all frames of the first stamp, or of the frame time where there is none.
    Each (rows,), None where its readout was not asked for. tally: (rows, count frames) unsigned, the readout `counts`.
    """

    pixels: int
    tr: Events | None = None
    counts: np.ndarray | None = None
    span: np.ndarray | None = None
    frames: Frames | None = None
    ones: np.ndarray | None = None
    waited: np.ndarray | None = None
    tally: np.ndarray | None = None

    def images(self, start: int, stop: int) -> Recorded:
        """The images `start` to `stop` alone."""
        rows = slice(start * self.pixels, stop * self.pixels)

        def cut(column: np.ndarray | None) -> np.ndarray | None:
            return None if column is None else column[rows]

        return Recorded(
            self.pixels,
            None if self.tr is None else self.tr.images(start, stop),
            cut(self.counts),
            cut(self.span),
            None if self.frames is None else self.frames.images(start, stop),
            cut(self.ones),
            cut(self.waited),
            cut(self.tally),
        )

    def grouped(self, planes: int) -> Recorded:
        """The same rows with `planes` images taken as one: the channels of a colour image."""
        return self if planes == 1 else self._regrouped(self.pixels * planes)

    def _regrouped(self, pixels: int) -> Recorded:
        tr = None if self.tr is None else self.tr.regrouped(pixels)
        frames = self.frames
        if frames is not None:
            first = None if frames.first is None else frames.first.regrouped(pixels)
            one = frames
            frames = Frames(one.bits, first, one.frames, one.frame_time, pixels, one.cause, one.parent)
        return Recorded(pixels, tr, self.counts, self.span, frames, self.ones, self.waited, self.tally)

    def plane(self, number: int, planes: int) -> Recorded:
        """One channel of images that are grouped of `planes`: what reconstructions need of its rows, no streams."""

        def cut(column: np.ndarray | None) -> np.ndarray | None:
            if column is None:
                return None
            rows = column.reshape(-1, planes, self.pixels // planes, *column.shape[1:])[:, number]
            return rows.reshape(-1, *column.shape[1:])

        counts, span, ones, waited, tally = map(cut, (self.counts, self.span, self.ones, self.waited, self.tally))
        return Recorded(self.pixels // planes, None, counts, span, None, ones, waited, tally)

    @staticmethod
    def joined_pixels(parts: Iterable[Recorded], pixels: int) -> Recorded:
        """One image of its parts, whose pixels follow each other; pixels: their number. What is large is held once."""
        bits, row, rest = np.zeros((0, 0), np.uint8), 0, []
        ticks, used, tick = np.zeros(0, np.uint32), 0, None
        for part in parts:
            if part.frames is not None and part.frames.cause is None:
                found = part.frames.bits
                bits = bits if len(bits) else np.empty((pixels, found.shape[1]), np.uint8)
                bits[row : row + len(found)] = found
                row += len(found)
                part = replace(part, frames=replace(part.frames, bits=np.zeros((len(found), 0), np.uint8)))
            if part.tr is not None and part.tr.ticks is not None and part.tr.cause is None:
                some, tick = part.tr.ticks, part.tr.tick
                ticks = ticks if used else ticks.astype(some.dtype)
                if used + len(some) > len(ticks):  # it grows where it lies
                    ticks.resize(used + len(some) + used // 16, refcheck=False)
                ticks[used : used + len(some)] = some
                used += len(some)
                part = replace(part, tr=part.tr.stamped(some[:0].copy(), float(tick or 0.0)))
            rest.append(part._regrouped(1))
        whole = Recorded.join(rest)._regrouped(pixels)
        if whole.frames is not None and row:
            whole = replace(whole, frames=replace(whole.frames, bits=bits))
        if whole.tr is not None and tick is not None:
            ticks.resize(used, refcheck=False)
            whole = replace(whole, tr=whole.tr.stamped(ticks, tick))
        return whole

    @staticmethod
    def join(parts: list[Recorded]) -> Recorded:
        """Several batches, one after the other."""
        if len(parts) == 1:
            return parts[0]
        one = parts[0]

        def joined(name: str) -> np.ndarray | None:
            return None if getattr(one, name) is None else np.concatenate([getattr(p, name) for p in parts])

        frames = None if one.frames is None else Frames.join([p.frames for p in parts if p.frames is not None])
        tr = None if one.tr is None else Events.join([p.tr for p in parts if p.tr is not None])
        counts, span, tally = joined("counts"), joined("span"), joined("tally")
        return Recorded(one.pixels, tr, counts, span, frames, joined("ones"), joined("waited"), tally)


def summarised(pixels: int, tr: Events | None, frames: Frames | None, tally: np.ndarray | None = None) -> Recorded:
    """The streams with the sums that reconstructions need (`waited` only where STR was recorded)."""
    recorded = Recorded(pixels, tally=tally)
    if tr is not None:
        counts, span = estimators.spans(tr.times if tr.ticks is None else tr.ticks, tr.offsets)
        recorded = Recorded(pixels, tr, counts, span if tr.tick is None else span * tr.tick, tally=tally)
    if frames is None:
        return recorded
    ones = _ones(frames.bits).astype(np.int32)
    waited = None
    if frames.first is not None:
        first = frames.first
        total = kernels.row_totals(first.times if first.ticks is None else first.ticks, first.offsets)
        total = total if first.tick is None else total * first.tick
        waited = total + (frames.frames - ones) * frames.frame_time
    return Recorded(pixels, recorded.tr, recorded.counts, recorded.span, frames, ones, waited, tally)


def _ones(bits: np.ndarray) -> np.ndarray:
    """(rows,) int64 how many bits of each row are set; some rows at a time, as they may fill the memory."""
    step = max(1, _BYTES_AT_ONCE // max(1, bits.shape[1]))
    parts = [np.bitwise_count(bits[i : i + step]).sum(axis=1, dtype=np.int64) for i in range(0, len(bits), step)]
    return np.concatenate([np.zeros(0, np.int64), *parts])


def _below(stamps: np.ndarray, end: float, kind: type[np.floating]) -> np.ndarray:
    """Stamps before `end` as floats of a kind, still before `end` as such a float."""
    if kind is np.float64:
        return stamps.astype(kind, copy=False)
    return np.minimum(stamps.astype(kind), np.nextafter(kind(end), kind(0)))


def counts_type(largest: int) -> type[np.unsignedinteger]:
    """The unsigned type of counts up to `largest`."""
    return np.uint8 if largest < 2**8 else np.uint16
