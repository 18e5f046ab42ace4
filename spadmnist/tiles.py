"""Charts: images laid out as tiles on one large image, and cut out of whatever a camera made of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .errors import SpadError


@dataclass(frozen=True, eq=False)
class Tiles:
    """Where the tiles of a chart lie, and which images they are.

    Attributes:
        shape: (rows, columns) of the chart.
        size: (rows, columns) of every tile.
        corners: (n, 2) int64, the first row and the first column of each tile.
        numbers: (n,) int64, which image of its source each tile is, counted from 0.
        labels: (n,) uint8, or None where the source has none.
    """

    shape: tuple[int, int]
    size: tuple[int, int]
    corners: np.ndarray
    numbers: np.ndarray
    labels: np.ndarray | None

    def __len__(self) -> int:
        return len(self.corners)

    def cut(self, image: np.ndarray) -> np.ndarray:
        """(n, ..., rows, columns): the tiles of an array (..., rows, columns) of the chart's size, flux images for one.

        Raises SpadError where the array is of another size.
        """
        image = np.asarray(image)
        if image.shape[-2:] != self.shape:
            sizes = [" x ".join(map(str, shape)) for shape in (image.shape[-2:], self.shape)]
            raise SpadError(f"an image of {sizes[0]} pixels is not of this chart, which has {sizes[1]}")
        rows, columns = self.size
        return np.stack([image[..., a : a + rows, b : b + columns] for a, b in self.corners.tolist()])

    def facts(self) -> dict[str, Any]:
        """As a manifest keeps it; `of_facts` is the way back."""
        labels = {} if self.labels is None else {"labels": self.labels.tolist()}
        return {
            "size": list(self.size),
            "corners": self.corners.tolist(),
            "numbers": self.numbers.tolist(),
            **labels,
        }


def of_facts(facts: Mapping[str, Any], shape: tuple[int, int]) -> Tiles:
    """The tiles of a chart of (rows, columns) `shape` as a manifest has them."""
    rows, columns = facts["size"]
    labels = np.array(facts["labels"], np.uint8) if "labels" in facts else None
    numbers = np.array(facts["numbers"], np.int64)
    return Tiles(shape, (rows, columns), np.array(facts["corners"], np.int64), numbers, labels)


def grid(count: int, columns: int | None, pitch: int | None, size: tuple[int, int]) -> np.ndarray:
    """(count, 2) first rows and columns of tiles of (rows, columns) `size`, row by row, beginning at (0, 0).

    columns: tiles in a row, as many as rows where it is None; pitch: from tile to tile, the tile's own size where it
    is None.
    """
    across = min(count, columns or math.ceil(math.sqrt(count)))
    down, right = (pitch or size[0]), (pitch or size[1])
    places = np.arange(count)
    return np.stack([places // across * down, places % across * right], axis=1)


def lay(pixels: np.ndarray, corners: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """One chart, ([channels,] *shape) like the tiles `pixels` (n, [channels,] rows, columns); black between them."""
    rows, columns = pixels.shape[-2:]
    chart = np.zeros((*pixels.shape[1:-2], *shape), pixels.dtype)
    for tile, (a, b) in zip(pixels, corners.tolist(), strict=True):
        chart[..., a : a + rows, b : b + columns] = tile
    return chart


def drawn(available: int, count: int, key: tuple[int, int]) -> np.ndarray:
    """(count,) int64, `count` of the numbers 0 to `available` - 1, each at most once, in the order they are drawn.

    A function of `key` alone, whatever the version of numpy.
    """
    words = np.random.Philox(key=np.array(key, np.uint64)).random_raw(available)
    return np.argsort(words, kind="stable")[:count]
