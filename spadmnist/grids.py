"""Events as grids, for networks: counts in bins of time, voxels, time surfaces. Compiled; without torch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from .errors import SpadError
from .events import Events

__all__ = ["Frames", "TimeSurface", "VoxelGrid", "structured"]

_ROUNDING = 1e-9  # of the exposure: how far beyond it a stamp may lie that was rounded

_jit = njit(cache=True, error_model="numpy", nogil=True)


class Grid:
    """Base: events of one image, or of several, to a grid of float32.

    shape: of an image, (rows, columns), or (channels, rows, columns); exposure: s, from 0 on. Called with `Events` it
    returns (bins, rows, columns) of one image, with leading axes for several images and for channels. Raises SpadError
    where the events are of another number of pixels, or do not lie within the exposure.
    """

    def __init__(self, shape: Sequence[int], bins: int, exposure: float):
        self.shape, self.bins, self.exposure = tuple(map(int, shape)), int(bins), float(exposure)
        if len(self.shape) not in (2, 3) or min(self.shape) < 1:
            raise SpadError(f"shape: {tuple(shape)} is no image; give (rows, columns) or (channels, rows, columns)")
        if self.bins < 1:
            raise SpadError(f"the number of bins is {bins}; give 1 or more")
        if not 0 < self.exposure < np.inf:
            raise SpadError(f"exposure: {exposure} s is not possible; give the time that was recorded, in s")

    def _into(self, offsets: np.ndarray, times: np.ndarray, out: np.ndarray) -> None:
        """Fill (rows, bins) from the (rows + 1,) offsets of (events,) s."""
        raise TypeError(f"{type(self).__name__} must define _into")

    def __call__(self, events: Events) -> np.ndarray:
        pixels = int(np.prod(self.shape))
        if events.pixels != pixels:
            raise SpadError(
                f"shape: {self.shape} has {pixels} pixels, but the events are of images of {events.pixels}; correct it"
            )
        if len(events.times):
            first, last = float(events.times.min()), float(events.times.max())
            if not (first >= 0 and last <= self.exposure * (1 + _ROUNDING)):
                raise SpadError(
                    f"exposure: {self.exposure:g} s is not that of the events, which lie between {first:g} s and "
                    f"{last:g} s; give the time that was recorded"
                )
        rows = len(events.offsets) - 1
        out = np.zeros((rows, self.bins), np.float32)
        self._into(events.offsets, events.times, out)
        images = np.moveaxis(out.reshape(rows // pixels, *self.shape, self.bins), -1, -3)
        return np.ascontiguousarray(images[0] if rows == pixels else images)


class Frames(Grid):
    """Detections in `frames` bins of equal time.

    Args:
        shape: of an image, (rows, columns), or (channels, rows, columns).
        frames: number of bins.
        exposure: s, from 0 on.
        binary: 1 where there is one or more, as in QIS.

    Called with `Events` it returns (bins, rows, columns) float32 of one image, with leading axes for several images and
    for channels.

    Raises:
        SpadError: for a shape, number or time that is none, and where the events are of another number of pixels, or
            do not lie within the exposure.
    """

    def __init__(self, shape: Sequence[int], frames: int, exposure: float, binary: bool = False):
        super().__init__(shape, frames, exposure)
        self.binary = binary

    def _into(self, offsets: np.ndarray, times: np.ndarray, out: np.ndarray) -> None:
        _count(offsets, times, self.bins / self.exposure, self.binary, out)


class VoxelGrid(Grid):
    """Detections shared out between the two bins whose middles lie around them, in proportion.

    A detection before the first middle, or behind the last one, is that bin's alone. Arguments and result are those of
    `Frames`, `bins` those of `frames`. Source: Zhu et al., Unsupervised event-based learning of optical flow, CVPR
    2019, eq. 1, without polarity.
    """

    def _into(self, offsets: np.ndarray, times: np.ndarray, out: np.ndarray) -> None:
        _share(offsets, times, self.bins / self.exposure, out)


class TimeSurface(Grid):
    """exp(-(t - t_last) / tau) at the ends t of `bins` equal parts of the exposure; 0 before the first detection.

    tau: s. Other arguments and the result are those of `Frames`. Source: Lagorce et al., HOTS, IEEE TPAMI 39 (2017),
    eq. 3, without polarity.
    """

    def __init__(self, shape: Sequence[int], tau: float, exposure: float, bins: int = 1):
        super().__init__(shape, bins, exposure)
        self.tau = float(tau)
        if not 0 < self.tau < np.inf:
            raise SpadError(f"tau: {tau} s is not possible; give the time in which a detection fades, in s")

    def _into(self, offsets: np.ndarray, times: np.ndarray, out: np.ndarray) -> None:
        _fade(offsets, times, self.exposure / self.bins, self.tau, out)


def structured(events: Events, columns: int, unit: float | None = None) -> np.ndarray:
    """The events of one image in order of time, as programs for event cameras take them.

    Args:
        events: of one image.
        columns: of the image.
        unit: of t, s; None for whole ticks of the converter.

    Returns:
        (events,) with the fields x, y, t (int64) and p (bool, always true: a SPAD has no polarity). t is rounded down.
        Channels of colour lie below one another in y.

    Raises:
        SpadError: without a unit for events that have no ticks, and for one that is not possible.
    """
    if unit is None and events.ticks is None:
        raise SpadError("unit: these events have no converter's ticks; give the unit of t in s, for example 1e-6")
    if unit is not None and not 0 < unit < np.inf:
        raise SpadError(f"unit: {unit} s is not possible; give the unit of t in s, for example 1e-6")
    out = np.empty(len(events), [("x", np.int64), ("y", np.int64), ("t", np.int64), ("p", bool)])
    out["y"], out["x"] = np.divmod(events.pixel, columns)
    out["t"] = events.ticks if unit is None else np.floor(events.times / unit * (1 + 1e-12))
    out["p"] = True
    return out[np.argsort(out["t"], kind="stable")]


@_jit
def _count(offsets, times, per_second, binary, out):  # type: ignore[no-untyped-def]
    last = out.shape[1] - 1
    for row in range(len(offsets) - 1):
        for i in range(offsets[row], offsets[row + 1]):
            bin = min(int(times[i] * per_second), last)
            out[row, bin] = np.float32(1.0) if binary else out[row, bin] + np.float32(1.0)


@_jit
def _share(offsets, times, per_second, out):  # type: ignore[no-untyped-def]
    last = out.shape[1] - 1
    for row in range(len(offsets) - 1):
        for i in range(offsets[row], offsets[row + 1]):
            at = min(max(times[i] * per_second - 0.5, 0.0), float(last))
            low = min(int(at), max(last - 1, 0))
            part = np.float32(at - low)
            out[row, low] += np.float32(1.0) - part
            if last > 0:
                out[row, low + 1] += part


@_jit
def _fade(offsets, times, step, tau, out):  # type: ignore[no-untyped-def]
    for row in range(len(offsets) - 1):
        i, stop = offsets[row], offsets[row + 1]
        latest = -1.0
        for bin in range(out.shape[1]):
            end = (bin + 1) * step
            while i < stop and (times[i] <= end or bin == out.shape[1] - 1):
                latest = times[i]
                i += 1
            if latest >= 0:
                out[row, bin] = np.exp(-max(end - latest, 0.0) / tau)
