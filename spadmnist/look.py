"""A first look at a capture: the numbers that `inspect` says of it, and whether it seems to have been interrupted."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from . import units
from .events import Events, longest_gap
from .foreign import visible
from .measurement import Measurement
from .recording import Capture, Light, Recording

_CHANCE = 1e-6  # a silence at an end is noted where a constant rate leaves one as long less often
_LONGER = 3  # times the longest silence inside, which the one at an end must exceed: light may come in bursts
_PIECE = 1 << 20  # intervals that are looked at together
_FRAMES_AT_ONCE = 64  # from either end, to begin with


def intervals(events: Events) -> Iterator[np.ndarray]:
    """s between the detections of a pixel, in pieces."""
    stamps = events.times if events.ticks is None else events.ticks
    tick = events.tick or 1.0
    for start in range(0, len(stamps) - 1, _PIECE):
        apart = np.diff(stamps[start : start + _PIECE + 1])
        inside = np.ones(len(apart), bool)
        firsts = events.offsets[np.searchsorted(events.offsets, start + 1) :]
        inside[firsts[firsts <= start + len(apart)] - start - 1] = False
        yield apart[inside] * tick


def look(measurement: Measurement, capture: Capture, recorded: Recording | None) -> dict[str, Any]:
    """Numbers of a capture, for the table and the picture. recorded: its data, None where only the mean is known.

    frames: of the readout, each of `binary_frames` frames of `frame_time` s (counts may be sums of them); None of TR.
    live: s in which detections could be made; rates: 1/s of live time, as they are recorded. hot: pixels with more than
    five times the median, beyond noise; dead: without a detection where the median pixel has 20 or more (None where
    that cannot be told). shortest_interval: s, within a pixel (TR). ones_share: of a pixel's frames. notes: what is to
    be known of the data, an interruption that shows in them among it.
    """
    c = capture.conditions
    counted = capture.modality == "counts"
    summed = c.largest_count if counted and c.counting == "frames" else 1
    row: dict[str, Any] = {
        "capture": capture.id,
        "modality": capture.modality,
        "light": light_text(capture.light),
        "exposure": c.exposure,
        "frames": None if capture.modality == "tr" else c.count_frames if counted else c.frames,
        "binary_frames": None if capture.modality == "tr" else summed,
        "frame_time": None if capture.modality == "tr" else c.frame_time,
        "live": c.exposure if capture.modality == "tr" else c.frames * c.frame_time,
        "pixels": measurement.layout.pixels,
        "mean": capture.mean,
        **dict.fromkeys(("detections", "rate_median", "rate_mean", "rate_min", "rate_max", "empty_pixels")),
        **dict.fromkeys(("hot_pixels", "dead_pixels", "ones_share", "shortest_interval")),
        "notes": [*capture.notes, *measurement.notes.get(capture.id, [])],
    }
    frames = capture.modality in ("qis", "str")
    if capture.mean is not None:
        row |= {"rate_mean": capture.mean / row["live"], "ones_share": capture.mean / c.frames if frames else None}
    if recorded is None:
        return row
    totals = recorded.totals
    median = float(np.median(totals))
    largest = 5 * median
    rates = np.array([median, totals.mean(), totals.min(), totals.max()]) / row["live"]
    row |= {
        "mean": float(totals.mean()),
        "detections": int(totals.sum()),
        **dict(zip(("rate_median", "rate_mean", "rate_min", "rate_max"), map(float, rates), strict=True)),
        "empty_pixels": int((totals == 0).sum()),
        "hot_pixels": int((totals > largest + 5 * np.sqrt(largest) + 10).sum()),
        "dead_pixels": int((totals == 0).sum()) if median >= 20 else None,
    }
    if frames:
        row["ones_share"] = float(totals.mean() / c.frames)
    if recorded.events is not None:
        shortest = [float(piece.min()) for piece in intervals(recorded.events) if len(piece)]
        row["shortest_interval"] = min(shortest, default=None)
    row["notes"] += silences(recorded)
    return row


def light_text(lit: Light) -> str:
    """What fell on the sensor, for people: `500 nm, 3 nW/cm^2`; of a scene its file, too."""
    if lit.wavelength is None:
        return "dark"
    unit = "lux" if lit.kind_of_level == "lux" else "W/m^2"
    level = "level free" if lit.level is None else units.show(lit.level, unit)
    scene = "" if lit.scene is None else f"scene {visible(lit.scene.name)}, "
    return f"{scene}{units.show(lit.wavelength, 'm')}, {level}"


# --- an interruption ----------------------------------------------------------------------------------------------


def silences(recorded: Recording) -> list[str]:
    """Sentences without their full stops: the recording seems to have begun late, or to have broken off.

    The silence before the first detection of all pixels, or behind the last one, is longer than three times the longest
    one between two detections, and less likely than 1e-6 under a constant rate: of N detections anywhere in [0, T) all
    lie before t with the probability (t / T)^N. A time stamp lies anywhere in its tick. Of frames, those with a
    detection take the place of the detections, and their numbers that of the time; frames are read from both ends, and
    no further than they are empty where that is nothing unusual.
    """
    return _silent_frames(recorded) if recorded.events is None else _silent_stamps(recorded, recorded.events)


def _chance(count: int, last: float, end: float) -> float:
    """Of so many moments anywhere in [0, end), how often all lie before `last`. As often all lie behind end - last."""
    return min(last / end, 1.0) ** count


def _is_unusual(quiet: float, inside: float, width: float) -> bool:
    """Is the silence at an end too long? inside: the longest from one moment with a detection to the next one; each
    moment lasts `width`.
    """
    return quiet > _LONGER * (inside - width)


def _silent_stamps(recorded: Recording, events: Events) -> list[str]:
    stamps, tick = (events.times, 1.0) if events.ticks is None else (events.ticks, float(events.tick or 1.0))
    width = 0.0 if events.ticks is None else 1.0
    exposure = recorded.conditions.exposure
    end, count = exposure / tick, len(stamps)
    if count < 2:
        return []
    before, latest = float(stamps.min()), float(stamps.max())
    last = latest + width
    behind = end - last
    if min(_chance(count, end - before, end), _chance(count, last, end)) >= _CHANCE:
        return []
    (inside, _), notes = longest_gap(stamps, before, latest), []
    if _chance(count, end - before, end) < _CHANCE and _is_unusual(before, inside, width):
        notes.append(
            f"nothing was recorded in the first {units.show(before * tick, 's', 3)} of {units.show(exposure, 's', 6)}; "
            "if its clock did not start at 0, import it again with --subtract-start and the --exposure since then"
        )
    if _chance(count, last, end) < _CHANCE and _is_unusual(behind, inside, width):
        # three digits of the shorter one, the silence or what was recorded
        step = 10.0 ** (math.floor(math.log10(min(behind, last) * tick)) - 2)
        at = units.show(math.ceil(last * tick / step) * step, "s", 12)
        notes.append(
            f"nothing was recorded in the last {units.show(behind * tick, 's', 3)} of {units.show(exposure, 's', 6)}; "
            f'if the recording broke off at {at}, import it again with --exposure "{at}"'
        )
    return notes


def _silent_frames(recorded: Recording) -> list[str]:
    end, c = recorded.n_frames, recorded.conditions
    before = _empty(recorded, ((start, min(start + n, end)) for start, n in _pieces(end)))
    behind = _empty(recorded, ((max(end - start - n, 0), end - start) for start, n in _pieces(end)), -1)
    longest = max(before, behind)
    # the frames with a detection are no more than those between the silences, nor than all detections
    for most in (lambda: end - before - behind, lambda: int(recorded.totals.sum())):
        if (count := most()) < 2 or _chance(count, end - longest, end) >= _CHANCE:
            return []
    some = np.concatenate([_with_a_detection(recorded, part) for _, part in recorded.chunks()])
    moments, notes = np.flatnonzero(some), []
    inside = float(np.diff(moments).max(initial=0))
    for quiet, place, advice in (
        (before, "first", "began late, import its last"),
        (behind, "last", "broke off there, import its first"),
    ):
        if _chance(len(moments), end - quiet, end) < _CHANCE and _is_unusual(quiet, inside, 1.0):
            notes.append(
                f"nothing was recorded in the {place} {quiet:,} of {end:,} frames "
                f"({units.show(quiet * c.exposure / end, 's', 3)}); if the recording {advice} {end - quiet:,} frames "
                "alone"
            )
    return notes


def _pieces(end: int) -> Iterator[tuple[int, int]]:
    """Start and length of pieces that double, over so many frames."""
    start, step = 0, _FRAMES_AT_ONCE
    while start < end:
        yield start, step
        start, step = start + step, 2 * step


def _empty(recorded: Recording, pieces: Iterator[tuple[int, int]], direction: int = 1) -> int:
    """How many frames are empty from one end on. direction: 1 from the first frame, -1 from the last."""
    assert recorded.frames is not None
    count = 0
    for start, stop in pieces:
        some = _with_a_detection(recorded, np.asarray(recorded.frames[start:stop]))[::direction]
        if some.any():
            return count + int(some.argmax())
        count += stop - start
    return count


def _with_a_detection(recorded: Recording, frames: np.ndarray) -> np.ndarray:
    """(frames,) Has any pixel a detection?"""
    seen = frames < recorded.none if recorded.modality == "str" else frames
    return np.asarray(seen.reshape(len(frames), -1).any(axis=1))
