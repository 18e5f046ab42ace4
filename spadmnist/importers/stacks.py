"""Stacks of frames: which axis is which, what their numbers mean, and frames as a `Recording` has them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import units
from ..errors import InputError
from ..events import Layout
from ..import_options import options
from ..readout import counts_type, no_detection
from ..recording import Capture, Recording
from . import Found, Said, Stack, are_whole, ask, no_whole

_STRIDED_PIECE = 1 << 28  # bytes: of frames that lie across the file each piece reads all of it, so pieces are large


# --- axes -----------------------------------------------------------------------------------------------------------


def arranged(shape: tuple[int, ...], dtype: Any, letters: str, get: Callable[[int, int], np.ndarray]) -> Stack:
    """A stack whose axes are stored in another order.

    shape: as it is stored; letters: what its axes are, of `M` (frames), `H` (rows) and `W` (columns). get: what is
    stored of some frames, with all three axes.
    """
    order = [letters.index(axis) for axis in "MHW"]

    def turned(start: int, stop: int) -> np.ndarray:
        return np.ascontiguousarray(get(start, stop).transpose(order))

    stack = Stack(tuple(shape[i] for i in order), np.dtype(dtype), get if letters == "MHW" else turned)
    return stack if letters[0] == "M" else replace(stack, piece=_STRIDED_PIECE)


def cut(letters: str, start: int, stop: int) -> tuple[slice, ...]:
    """Where some frames lie in an array whose axes are `letters`."""
    return tuple(slice(start, stop) if axis == "M" else slice(None) for axis in letters)


def axes_note(found: Found, said: Said) -> tuple[str, ...]:
    """A note where the frames of a stack are more likely its last axis than its first, and nobody said which."""
    known = "rows" in found.facts or None not in (said.rows, said.columns) or found.arranged
    if found.frames is None or found.packed or said.axes is not None or known:
        return ()
    frames, rows, columns = found.frames.shape
    if min(rows, frames) > 1 and rows != columns and (frames == rows or columns > max(frames, rows)):
        return (
            f"{frames:,} frames of {rows:,} x {columns:,} pixels; if these are {columns:,} frames of {frames:,} x "
            f"{rows:,}, import it with --axes HWM",
        )
    return ()


# --- what the numbers mean ------------------------------------------------------------------------------------------

# what programs write for a detection in a binary image: 1, or white of 8 or 16 bits (ImageJ)
_WHITES = (1, 255, 65535)


def modality(path: Path, found: Found, said: Said) -> str:
    """tr, qis, str or counts, from what is there, what is said, and for frames of whole numbers from their values.

    Raises InputError where that does not tell.
    """
    told, stated = said.modality, found.facts.get("modality")
    if told is not None and ((found.frames is None) != (told == "tr") or (found.packed and told != "qis")):
        what = "packed bits, which are qis" if found.packed else "frames" if found.frames is not None else "tr"
        raise InputError(f"{path}: holds {what}, and no {told}; leave out --modality")
    if stated is not None:
        _check_stated(path, stated, found, said)
    if found.frames is None:
        return "tr"
    if told or stated or found.packed or found.bits:
        return told or stated or "qis"
    if said.bits:
        return "counts"
    of_counts = {"bits", "counting"} & set(found.facts)
    if of_counts and "tick" in found.facts:
        which = " and ".join(sorted(of_counts))
        raise InputError(f"{path}: says its {which}, as of counts, and its tick, as of str; say with --modality which")
    if of_counts:
        return "counts"
    binary = _white(found.frames) is not None
    if binary and "tick" in found.facts:
        raise InputError(
            f"{path}: says its tick, and all its numbers are 0 and 1 (or 255); say with --modality whether they are "
            "str, time stamps, or qis, bits"
        )
    if "tick" in found.facts:
        return "str"
    if not binary:
        raise InputError(
            f"{path}: holds numbers other than 0 and 1 (or 0 and 255), so they are no bits; give --bits where they are "
            "counts, --modality str and --tick where they are time stamps, --packed where a byte is eight columns"
        )
    return "qis"


def _check_stated(path: Path, stated: str, found: Found, said: Said) -> None:
    """Raise InputError where the user, or something else that the file says or holds, contradicts its modality."""
    says = f"{path}: says that its modality is {stated}"
    if said.modality not in (None, stated):
        raise InputError(f"{says}; leave out --modality")
    if stated not in options()["bits"].modalities and said.bits is not None:
        raise InputError(f"{says}, which has no --bits; leave it out")
    if found.packed and stated != "qis":
        raise InputError(f"{says}, but holds packed bits, which are qis; correct it")
    for name in ("bits", "counting", "tick"):
        of, value = options()[name].modalities, found.facts.get(name)
        one_bit = stated == "qis" and name == "bits" and value == 1
        if value is not None and stated not in of and not one_bit and said.modality is None:
            raise InputError(
                f"{says} and its {name} {value}, which only {' and '.join(of)} have; correct it, or add --modality "
                f"{stated}"
            )


def _white(stack: Stack) -> int | None:
    """The number that stands for a detection where all numbers are that or 0; None where there are others."""
    white = 0
    for _, piece in stack.pieces():
        most = piece.max(initial=0)
        if not white:
            white = int(most) if float(most) in _WHITES else 0
        if most not in (0, white) or not ((piece == 0) | (piece == white)).all():
            return None
    return white or 1


# --- frames as a recording ------------------------------------------------------------------------------------------

_MANY = 0.05  # share of time stamps that are equal: more than that at an end of a frame mean that there is no detection
_MIRRORED = np.packbits(np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1)[:, ::-1], axis=1)[:, 0]


@dataclass
class Seen:
    """What was seen of the frames of a capture as they were read, in order: to be told when all are.

    detections: their sum (of counts: of what is counted); white: the number that stands for a detection; others: is
    there a number that is neither 0 nor white of 8 bits? upto: frames seen so far. Of time stamps: zeros: how many are
    0; latest: the last one; at_latest: how many are that one; missed: does one mean that there was no detection?
    """

    modality: str
    detections: int = 0
    white: int = 0
    others: bool = False
    upto: int = 0
    zeros: int = 0
    latest: int = 0
    at_latest: int = 0
    missed: bool = False

    def add(self, start: int, each: np.ndarray) -> bool:
        """Take in the frames from `start` on, once. each: the detections of each frame. Were they new?"""
        if start != self.upto:
            return False
        self.upto = start + len(each)
        self.detections += int(each.sum())
        return True

    def notes(self) -> Iterator[str]:
        """What is to be known of the numbers."""
        if self.modality == "qis" and self.white > 1:
            yield f"0 and {self.white} are read as no detection and a detection"
        if self.modality == "counts" and self.detections and not self.others:
            yield "every count is 0 or 255, as in a binary stack; if it is one, leave out --bits"
        if self.modality == "str" and not self.missed:
            for value, count in ((0, self.zeros), (self.latest, self.at_latest)):
                if count > _MANY * self.detections:
                    yield (
                        f"no time stamp means that there was no detection, and {count:,} of {self.detections:,} are "
                        f"{value}; if that means it, correct --frame-time, or store the ticks of a frame in its place"
                    )
                    break


def recording(path: Path, found: Found, said: Said, capture: Capture, layout: Layout) -> tuple[Recording, Seen]:
    """Frames as a `Recording` has them, read and checked piece by piece. Raises InputError as they are read."""
    stack, columns, kind, c = found.frames, layout.columns, capture.modality, capture.conditions
    assert stack is not None
    tick = found.facts.get("tick", said.tick) if kind == "str" else None
    if kind == "str" and tick is None:
        raise ask(path, ["tick"])
    most, why = 1, "a bit is 0 or 1 (or 255)"
    dtype: np.dtype[Any] = np.dtype(np.uint8)
    if kind == "str":
        most, dtype = no_detection(c.frame_time, float(tick or 1.0)), np.dtype(np.uint32)
        why = f"a frame of {units.show(c.frame_time, 's')} ends at {most} ticks, which means no detection"
    elif kind == "counts":
        most, dtype = c.largest_count, np.dtype(counts_type(c.largest_count))
        why = f"{c.bits} bits count up to {most}"
    if found.packed and stack.dtype != np.uint8:
        raise InputError(f"{path}: packed frames are {stack.dtype}; store uint8, or leave out --packed")
    seen = Seen(kind)

    def wrong(value: Any, start: int) -> InputError:
        return InputError(f"{path}: the frames from {start} on hold {value}, but {why}; correct it")

    def checked(piece: np.ndarray, start: int) -> np.ndarray:
        if found.packed:
            piece = _MIRRORED[piece] if said.bit_order == "little" else piece
            if columns % 8 and (piece[:, :, -1] & (0xFF >> columns % 8)).any():
                raise InputError(f"{path}: bits beyond the {columns} columns are set; correct --columns or --bit-order")
            seen.add(start, np.bitwise_count(piece).sum(axis=(1, 2), dtype=np.int64))
            return piece
        if piece.dtype.kind == "f" and not (fine := are_whole(piece)).all():
            raise InputError(
                f"{path}: the frames from {start} on hold {piece[~fine][0]:g}, {no_whole(piece[~fine][0])}; store "
                "what was recorded"
            )
        low, high = int(piece.min(initial=0)), int(piece.max(initial=0))
        if kind == "qis":
            if high > 1 and high in _WHITES:
                seen.white = seen.white or high
                if not ((piece == 0) | (piece == high)).all():
                    raise wrong(piece[(piece != 0) & (piece != high)][0], start)
            if low < 0 or high not in (0, seen.white or 1):
                raise wrong(low if low < 0 else high, start)
            bits = piece != 0
            seen.white = seen.white or high
            seen.add(start, np.count_nonzero(bits, axis=(1, 2)))
            return np.packbits(bits, axis=2)
        if low < 0 or high > most:
            raise wrong(low if low < 0 else high, start)
        if kind == "str":
            each = np.count_nonzero(piece < most, axis=(1, 2))
            if seen.add(start, each):
                seen.zeros += int(np.count_nonzero(piece == 0))
                seen.missed |= int(each.sum()) < piece.size
                if high >= seen.latest:
                    seen.at_latest = seen.at_latest if high == seen.latest else 0
                    seen.at_latest += int(np.count_nonzero(piece == high))
                    seen.latest = high
        else:
            seen.others = seen.others or bool(((piece != 0) & (piece != 255)).any())
            seen.add(start, piece.sum(axis=(1, 2), dtype=np.float64))
        return piece.astype(dtype)

    shape = (*stack.shape[:2], -(-columns // 8) if kind == "qis" else columns)

    def get(start: int, stop: int) -> np.ndarray:
        out = np.empty((stop - start, *shape[1:]), dtype)
        for first in range(start, stop, stack.step):
            piece = stack[first : min(first + stack.step, stop)]
            out[first - start : first - start + len(piece)] = checked(piece, first)
        return out

    return Recording(capture, layout, None, Stack(shape, dtype, get), tick), seen
