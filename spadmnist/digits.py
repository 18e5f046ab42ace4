"""Digits drawn by the program: strokes with a random hand, so that the first run needs no download."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np


def _arc(x: float, y: float, rx: float, ry: float, start: float, stop: float) -> list[tuple[float, float]]:
    """Points on an ellipse; angles in degrees, clockwise from the right (y points down)."""
    steps = math.ceil(abs(stop - start) / 22)
    angles = [math.radians(start + (stop - start) * i / steps) for i in range(steps + 1)]
    return [(x + rx * math.cos(a), y + ry * math.sin(a)) for a in angles]


@functools.cache
def _glyphs() -> tuple[tuple[np.ndarray, ...], ...]:
    """For each digit the ways to write it, each (segments, 2 ends, x and y) in a box of about 1 x 1."""
    ways: list[list[list[list[tuple[float, float]]]]] = [
        [[_arc(0.5, 0.5, 0.36, 0.5, -100, 260)]],
        [
            [[(0.5, 0.0), (0.5, 1.0)]],
            [[(0.27, 0.24), (0.5, 0.0), (0.5, 1.0)]],
        ],
        [[[*_arc(0.5, 0.28, 0.34, 0.28, 195, 395), (0.5, 0.7), (0.13, 1.0), (0.9, 1.0)]]],
        [[[*_arc(0.46, 0.25, 0.32, 0.25, 205, 445), *_arc(0.46, 0.74, 0.37, 0.26, -85, 150)]]],
        [
            [[(0.66, 1.0), (0.66, 0.0), (0.1, 0.66), (0.92, 0.66)]],
            [[(0.2, 0.03), (0.13, 0.52), (0.8, 0.5)], [(0.8, 0.0), (0.72, 1.0)]],
        ],
        [[[(0.84, 0.0), (0.3, 0.0), (0.22, 0.44), *_arc(0.46, 0.68, 0.36, 0.32, -125, 145)]]],
        [[[(0.68, 0.0), (0.42, 0.2), (0.24, 0.45), *_arc(0.48, 0.71, 0.31, 0.29, 180, 535)]]],
        [
            [[(0.12, 0.02), (0.86, 0.0), (0.6, 0.45), (0.42, 1.0)]],
            [[(0.12, 0.02), (0.86, 0.0), (0.6, 0.45), (0.42, 1.0)], [(0.34, 0.52), (0.82, 0.5)]],
        ],
        [[_arc(0.5, 0.25, 0.29, 0.25, 90, 450), _arc(0.5, 0.75, 0.34, 0.25, -90, 270)]],
        [[[*_arc(0.48, 0.29, 0.31, 0.29, 0, -360), (0.76, 0.6), (0.66, 1.0)]]],
    ]
    return tuple(
        tuple(np.array([ends for stroke in strokes for ends in pairwise(stroke)]) for strokes in digit)
        for digit in ways
    )


def draw_digit(digit: int, key: Sequence[int], rows: int, columns: int) -> np.ndarray:
    """One digit in a hand that `key` decides: (rows, columns) uint8, white (255) on black.

    As in MNIST it is fitted into a centred box of 20/28 of the image.
    """
    # raw bits: their stream never changes with NumPy's version, that of its distributions may
    raw = np.random.Philox(np.random.SeedSequence(tuple(key))).random_raw(16)
    u = iter((raw / 2.0**63 - 1.0).tolist())  # from -1 to 1
    ways = _glyphs()[digit]
    segments = ways[int((next(u) + 1) / 2 * len(ways)) % len(ways)]
    x, y = segments[..., 0] - 0.5, segments[..., 1] - 0.5

    # an unsteady hand: a slow wave along each axis; then width, slant and turn
    x, y = (
        x + 0.05 * next(u) * np.sin(5 * y + 3 * next(u)) + 0.04 * next(u) * np.sin(4 * x + 3 * next(u)),
        y + 0.05 * next(u) * np.sin(5 * x + 3 * next(u)) + 0.03 * next(u) * np.sin(4 * y + 3 * next(u)),
    )
    x = x * (0.86 + 0.16 * next(u)) - y * (0.12 + 0.22 * next(u))
    turn = 0.14 * next(u)
    x, y = x * math.cos(turn) - y * math.sin(turn), x * math.sin(turn) + y * math.cos(turn)

    unit = min(rows, columns) / 28
    radius = unit * (1.15 + 0.4 * next(u))
    box = 20 * unit - 2 * radius
    scale = box / max(np.ptp(x), np.ptp(y))
    x = (x - (x.min() + x.max()) / 2) * scale + (columns - 1) / 2 + 0.8 * unit * next(u)
    y = (y - (y.min() + y.max()) / 2) * scale + (rows - 1) / 2 + 0.8 * unit * next(u)

    column, row = np.arange(columns), np.arange(rows)[:, None]
    nearest = np.full((rows, columns), np.inf)
    for (x0, x1), (y0, y1) in zip(x.tolist(), y.tolist(), strict=True):
        dx, dy = x1 - x0, y1 - y0
        along = ((column - x0) * dx + (row - y0) * dy) / (dx * dx + dy * dy)
        along = np.minimum(np.maximum(along, 0.0), 1.0)
        nearest = np.minimum(nearest, (column - x0 - along * dx) ** 2 + (row - y0 - along * dy) ** 2)
    ink = (radius - np.sqrt(nearest)) / unit / 1.3 + 0.5  # an edge as soft as MNIST's
    return np.rint(255 * np.clip(ink, 0.0, 1.0)).astype(np.uint8)
