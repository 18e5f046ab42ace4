"""PicoQuant's time tags."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from . import LASER_PULSES, MOST_EVENTS, Format, Found, Said, damaged, facts, heard, library
from .detections import Detections, Pieces

_MOST_TICKS = 1 << 63  # that are added up here
_BLOCK = 1 << 20  # records that are decoded at a time
SYNC = 64  # the number by which the sync input is known here; the inputs of all instruments have smaller ones


@dataclass(frozen=True)
class Layout:
    """How a T2 record of an instrument lies in its 32 bits.

    time: bits of the time, the lowest; channel: bits above them; special: is the highest bit the mark of a record that
    is no detection? wrap: ticks of an overflow; numbered: does an overflow's record say how many there were?
    inputs: how many channels there are, where any other is damage.
    """

    time: int
    channel: int
    special: bool
    wrap: int
    numbered: bool
    inputs: int


_HARP = Layout(time=25, channel=6, special=True, wrap=1 << 25, numbered=True, inputs=63)
# by the record type that a header names
LAYOUTS = {
    0x00010203: Layout(time=28, channel=4, special=False, wrap=210_698_240, numbered=False, inputs=5),  # PicoHarp 300
    0x00010204: Layout(time=25, channel=6, special=True, wrap=33_552_000, numbered=False, inputs=63),  # HydraHarp 1
    0x01010204: _HARP,  # HydraHarp 2
    0x00010205: _HARP,  # TimeHarp 260 N
    0x00010206: _HARP,  # TimeHarp 260 P
    0x00010207: _HARP,  # MultiHarp, PicoHarp 330
}


@dataclass(frozen=True)
class Decoded:
    """T2 records, decoded. channel, ticks: (detections,) the input of each (`SYNC`: the sync input) and its time."""

    channel: np.ndarray
    ticks: np.ndarray
    markers: int
    unknown: int


def decoded(records: np.ndarray | _Records, layout: Layout) -> Iterator[Decoded]:
    """Detections from raw T2 records, a block of them at a time: overflows are added up in 64 bits.

    records: an array of uint32, or what gives one where it is sliced. Raises ValueError where that is not possible.

    Source: PicoQuant, demonstration readers of the "Unified TTTR File Format".
    """
    rounds = 0  # how often the clock has gone round before the block
    for start in range(0, len(records), _BLOCK):
        block = records[start : start + _BLOCK]
        unknown = 0
        time = block & np.uint32((1 << layout.time) - 1)
        channel = (block >> np.uint32(layout.time) & np.uint32((1 << layout.channel) - 1)).astype(np.uint8)
        if layout.special:
            special = block >> np.uint32(31) == 1
            overflow = special & (channel == 63)
            marker = special & (channel > 0) & (channel < 16)
            sync = special & (channel == 0)
            channel[sync] = SYNC
            detection = ~special | sync
            unknown = int((special & ~(overflow | marker | sync)).sum())
        else:
            extra = channel == 15
            overflow = extra & (time & np.uint32(15) == 0)
            marker = extra & ~overflow
            detection = ~extra
            wrong = detection & (channel >= layout.inputs)
            if wrong.any():
                at = int(wrong.argmax())
                raise ValueError(f"record {start + at:,} is of channel {channel[at]}, which is none")
        gone = overflow.astype(np.int64)
        if layout.numbered:
            gone[overflow] = np.maximum(time[overflow], 1)  # early firmware leaves the number 0
        gone = rounds + np.cumsum(gone)
        rounds = int(gone[-1])
        if rounds >= _MOST_TICKS // layout.wrap:
            raise ValueError(f"its clock goes round {rounds:,} times")
        ticks = (gone[detection] * layout.wrap + time[detection]).astype(np.uint64)
        yield Decoded(channel[detection], ticks, int(marker.sum()), unknown)


@dataclass(frozen=True)
class _Records:
    """The records of a file, read where they are sliced."""

    path: Path
    start: int  # bytes
    count: int

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, place: slice) -> np.ndarray:
        first, last, _ = place.indices(self.count)
        return np.fromfile(self.path, "<u4", last - first, offset=self.start + 4 * first)


class Ptu(Format):
    """PicoQuant PTU, T2 mode: every detection with its channel and its time.

    In T2 mode all inputs record alike, the sync input too: where it has detections it is a channel, `sync`, and the
    first pixel. Markers are no detections.

    Source: PicoQuant, "Unified TTTR File Format"; the header is read by ptufile, the records here.
    """

    about = "PicoQuant PTU"
    begins = (b"PQTTTR",)
    modalities = ("tr",)

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """Channels as the instrument counts them; the exposure is how long it ran, in ms, as it says itself."""
        ptufile = library(path, "ptufile", "ptu")
        try:
            with heard("ptufile"), ptufile.PtuFile(path) as file:
                tags, start = dict(file.tags), int(file.record_offset)
        except Exception as error:  # a damaged header makes it raise nearly anything
            raise damaged(path, error) from None
        kind = tags.get("TTResultFormat_TTTRRecType")
        if tags.get("Measurement_Mode") == 3 or _is_t3(kind):
            raise InputError(f"{path}: {LASER_PULSES}")
        if kind not in LAYOUTS:
            raise InputError(f"{path}: has records of the type {kind!r:.40}, which is no T2; record in T2 mode")
        known, sources = _header(path, tags)
        layout, (records, notes) = LAYOUTS[kind], _records(path, tags, start)
        beside = _Beside()
        found = Detections(path, lambda: _pieces(path, records, layout, beside))
        left_out = [f"{beside.markers:,} markers, which are no detections"] if beside.markers else []
        if beside.unknown:
            left_out.append(f"{beside.unknown:,} special records of an unknown kind")
        sync = int(found.counts[SYNC : SYNC + 1].sum())
        if sync and said.channels is None and sync < len(found):
            notes.append(
                f"the sync input has {sync:,} detections and is the first pixel; if they are pulses of a laser, choose "
                "the others with --channels"
            )
        return Found(
            facts(path, known.get),
            found,
            notes=tuple(notes),
            left_out=tuple(left_out),
            names={SYNC: "sync"},
            sources=sources,
        )


def _is_t3(kind: Any) -> bool:
    """T2 and T3 records of an instrument differ in one digit."""
    return isinstance(kind, int) and kind >> 8 & 15 == 3


def _header(path: Path, tags: dict[str, Any]) -> tuple[dict[str, float], dict[str, str]]:
    """(tick and exposure, by which tags they stand there)."""
    tick = tags.get("MeasDesc_GlobalResolution")
    if not isinstance(tick, (int, float)):
        raise InputError(f"{path}: does not say how long a tick is (MeasDesc_GlobalResolution); copy it again")
    known, sources = {"tick": float(tick)}, {"tick": "MeasDesc_GlobalResolution"}
    for name in ("TTResult_StopAfter", "MeasDesc_AcquisitionTime"):
        milliseconds = tags.get(name)
        if isinstance(milliseconds, int) and milliseconds > 0:
            known["exposure"], sources["exposure"] = milliseconds / 1000, name
            break
    return known, sources


def _records(path: Path, tags: dict[str, Any], start: int) -> tuple[_Records, list[str]]:
    """(records, as many as the header declares; all that follow where it was never finished, notes)."""
    declared, held, notes = tags.get("TTResult_NumberOfRecords", 0), (path.stat().st_size - start) // 4, []
    if not isinstance(declared, int) or declared <= 0:
        declared = held
        notes.append("its header was never finished, as of a recording that broke off")
    elif declared < held:
        notes.append(f"{held:,} records follow where its header declares {declared:,}; the rest was not read")
    if declared > held:
        raise InputError(
            f"{path}: declares {declared:,} records, {held:,} follow: it was cut short; copy it again from where "
            f"it was made, or, where that is all there is, write {held} into TTResult_NumberOfRecords of its header"
        )
    if declared > MOST_EVENTS:
        raise InputError(
            f"{path}: has {declared:,} records, more than the {MOST_EVENTS:,} that can be read; cut it into several"
        )
    return _Records(path, start, declared), notes


@dataclass
class _Beside:
    """What stands among the detections, when all records were read."""

    markers: int = 0
    unknown: int = 0


def _pieces(path: Path, records: _Records, layout: Layout, beside: _Beside) -> Pieces:
    """(channel, ticks) piece after piece. Raises InputError where the records are damaged."""
    beside.markers = beside.unknown = count = 0
    last = np.zeros(0, np.uint64)
    try:
        for block in decoded(records, layout):
            _check_order(path, np.concatenate([last, block.ticks]), count - len(last), layout.wrap)
            beside.markers += block.markers
            beside.unknown += block.unknown
            count += len(block.ticks)
            last = block.ticks[-1:] if len(block.ticks) else last
            yield block.channel, block.ticks
    except ValueError as error:
        raise damaged(path, error) from None


def _check_order(path: Path, ticks: np.ndarray, first: int, wrap: int) -> None:
    """Raise InputError where a time falls back by more than half an overflow: one is missing, and all later times are
    wrong. Less is disorder between inputs. first: the number of the first of these detections.
    """
    lost = np.diff(ticks.astype(np.int64)) < -(wrap // 2)
    if lost.any():
        at = int(lost.argmax())
        number = first + at + 1
        raise InputError(
            f"{path}: its times fall back from {ticks[at]:,} to {ticks[at + 1]:,} ticks at detection {number:,}; "
            "records are missing there: copy it again from where it was made"
        )
