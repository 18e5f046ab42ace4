"""A first look at a capture: its numbers, for a table and for a picture."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from .. import units
from ..events import Events
from ..recording import Capture, Light, Recording
from .type import Measurement


def intervals(events: Events) -> Iterator[np.ndarray]:
    """s between the detections of a pixel, in pieces."""
    stamps = events.times if events.ticks is None else events.ticks
    tick = events.tick or 1.0
    piece = 1 << 20
    for start in range(0, len(stamps) - 1, piece):
        apart = np.diff(stamps[start : start + piece + 1])
        inside = np.ones(len(apart), bool)
        firsts = events.offsets[np.searchsorted(events.offsets, start + 1) :]
        inside[firsts[firsts <= start + len(apart)] - start - 1] = False
        yield apart[inside] * tick


def look(measurement: Measurement, capture: Capture, recorded: Recording | None) -> dict[str, Any]:
    """Numbers of a capture, for the table and the picture. recorded: its data, None where only the mean is known.

    live: s in which detections could be made; rates: 1/s of live time, as they are recorded. hot: pixels with more than
    five times the median, beyond noise; dead: without a detection where the median pixel has 20 or more (None where
    that cannot be told). shortest_interval: s, within a pixel (TR). ones_share: of a pixel's frames.
    """
    c = capture.conditions
    counted = capture.modality == "counts"
    row: dict[str, Any] = {
        "capture": capture.id,
        "modality": capture.modality,
        "light": _light_text(capture.light),
        "exposure": c.exposure,
        "frames": None if capture.modality == "tr" else c.count_frames if counted else c.frames,
        "frame_time": None if capture.modality == "tr" else c.frame_time,
        "live": c.exposure if capture.modality == "tr" else c.frames * c.frame_time,
        "pixels": measurement.layout.pixels,
        "mean": capture.mean,
        **dict.fromkeys(("detections", "rate_median", "rate_mean", "rate_min", "rate_max", "empty_pixels")),
        **dict.fromkeys(("hot_pixels", "dead_pixels", "ones_share", "shortest_interval")),
        "notes": list(measurement.notes.get(capture.id, [])),
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
    return row


def _light_text(lit: Light) -> str:
    if lit.wavelength is None:
        return "dark"
    unit = "lux" if lit.kind_of_level == "lux" else "W/m^2"
    level = "level free" if lit.level is None else units.show(lit.level, unit)
    return f"{units.show(lit.wavelength, 'm')}, {level}"
