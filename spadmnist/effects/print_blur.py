"""A print that is not sharp."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np

from ..events import Layout
from . import Chip, Conditions, Effect, parameter

_REACH = 4.0  # radii, beyond which a Gaussian is left out: 6e-5 of it


class PrintBlur(Effect, stage="light"):
    """Print and lens blur the scene with a Gaussian.

    Each pixel gets the mean of the blurred scene over its own area. The scene is uniform over each pixel. The Gaussian
    is cut at 4 radii, and its weights add up to 1. Beyond the edge of the scene the light is that of the nearest pixel.
    In a layout with positions the weight of a pixel at distance r is exp(-r^2 / (2 radius^2)). The effect acts on
    scenes under both rules; uniform light does not change.
    Source: no published number; 0.3-2 pixels is what a lens that is focused by eye leaves.
    """

    of_scene = True
    after = "print_tilt"
    shown: ClassVar[dict[str, Any]] = {"radius": 0.6}  # less than the details of the scene
    moves = ("map", "rows_columns", "surface", "level", "outliers", "linearity")

    radius = parameter(
        0.5,
        "",
        "standard deviation of the Gaussian, pixels",
        symbol="s",
        bounds=(0, 100),
        off=0.0,
        search=(0.2, 10),
    )

    def made(self, chip: Chip) -> None:
        self._layout: Layout = chip.layout
        if chip.layout.positions is not None and self.radius:
            away = chip.layout.places[:, None] - chip.layout.places
            squared = (away**2).sum(axis=2)
            weights = np.exp(-squared / (2 * self.radius**2)) * (squared <= (_REACH * self.radius) ** 2)
            self._among = weights / weights.sum(axis=1, keepdims=True)

    def apply(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """sum over rows and columns of rate w(rows away) w(columns away), w(k) = F(k + 1) - 2 F(k) + F(k - 1), where
        F(x) = x Phi(x / s) + s phi(x / s), Phi and phi those of the normal law.
        """
        if not self.radius:
            return rate
        if self._layout.positions is not None:
            return rate @ self._among.T
        images = rate.reshape(len(rate), *self._layout.shape)
        return self._along(self._along(images, 1), 2).reshape(rate.shape)

    def _along(self, images: np.ndarray, axis: int) -> np.ndarray:
        """Blurred along one axis."""
        size = images.shape[axis]
        far = math.ceil(_REACH * self.radius)
        upto = [self._integral(k) for k in range(-1, far + 2)]
        weights = [upto[k + 2] - 2 * upto[k + 1] + upto[k] for k in range(far + 1)]
        whole = weights[0] + 2 * math.fsum(weights[1:])
        places = np.arange(size)
        out = np.zeros_like(images)
        for k in range(-far, far + 1):
            there = np.take(images, np.clip(places + k, 0, size - 1), axis=axis)
            out += weights[abs(k)] / whole * there
        return out

    def _integral(self, x: float) -> float:
        """Of a blurred step up to x, pixels."""
        z = x / self.radius
        step = (1 + math.erf(z / math.sqrt(2))) / 2
        return x * step + self.radius * math.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)

    expected_rate = apply
