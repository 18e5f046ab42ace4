"""A print that hangs askew."""

from __future__ import annotations

import math

import numpy as np

from . import Chip, Conditions, Effect, parameter


class PrintTilt(Effect, stage="light"):
    """A printed chart is rotated in its plane.

    The scene is rotated about the middle of the array and interpolated bilinearly. Beyond the edge of the scene the
    light is that of the nearest pixel. In a layout with positions each pixel gets the light of the nearest one. A
    positive angle rotates from the direction of the columns to that of the rows. The effect acts on scenes under both
    rules; uniform light does not change.
    Source: no published number; a chart that is hung by eye is rotated by 1-3 degrees, 0.02-0.05 rad.
    """

    of_scene = True
    after = "print_contrast"
    moves = ("map", "rows_columns", "surface", "level", "outliers", "linearity")

    angle = parameter(
        0.02,
        "rad",
        "angle of the rotation",
        symbol="a",
        bounds=(-1, 1),
        off=0.0,
        search=(-0.2, 0.2),
    )

    def made(self, chip: Chip) -> None:
        layout, cosine, sine = chip.layout, math.cos(self.angle), math.sin(self.angle)
        places = layout.places
        middle = (places.min(axis=0) + places.max(axis=0)) / 2
        across, down = (places - middle).T
        u, v = across * cosine + down * sine + middle[0], down * cosine - across * sine + middle[1]
        if layout.positions is not None:
            apart = (u[:, None] - places[:, 0]) ** 2 + (v[:, None] - places[:, 1]) ** 2
            self._corners = [(apart.argmin(axis=1), np.ones(layout.pixels))]
            return
        u, v = np.clip(u, 0, layout.columns - 1), np.clip(v, 0, layout.rows - 1)
        left, top = np.floor(u), np.floor(v)
        self._corners = []
        for row, below in ((top, 1 - (v - top)), (np.minimum(top + 1, layout.rows - 1), v - top)):
            for column, beside in ((left, 1 - (u - left)), (np.minimum(left + 1, layout.columns - 1), u - left)):
                self._corners.append(((row * layout.columns + column).astype(np.int64), below * beside))

    def apply(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """rate, read at (u cos(a) + v sin(a), v cos(a) - u sin(a)) from the middle."""
        seen = np.zeros_like(rate)
        for pixel, share in self._corners:
            seen += share * rate[:, pixel]
        return seen

    expected_rate = apply
