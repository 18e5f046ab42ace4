"""Maps: how many detections each pixel, row and column has, and how the pixels differ."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from ..events import Layout
from . import Recording, Statistic, Summary
from ._counting import per_cent, root_of, whole
from ._frames import in_equal_times
from ._scores import Pairs, number_at, pooled_score, shares
from ._series import has_data, slots_of_frame

_ALL = ("tr", "str", "qis", "counts")
_BELOW, _ABOVE = (0.25, 0.5, 0.75), (1.33, 2.0, 4.0, 10.0)
_BLIND = 0.9  # share of blind time up to which a dead time's law is followed
_TAIL = 16  # pixels in a tail, at least


class _Counting:
    """The law of a pixel's number of detections in a capture, as far as the conditions fix it.

    counts: (pixels,) float, its detections; of first stamps those that it would have had if it had waited for them as
    long as all do (see `Recording.waited`). slots: that a pixel can fill at most (binomial); blind: share of the
    exposure that one detection takes from it; waited: frames that pixels waited in the mean, 0 where that is unknown.
    """

    def __init__(self, recording: Recording):
        conditions = recording.conditions
        self.counts = recording.totals.astype(np.float64)
        self.slots, self.blind, self.waited, self.frames = np.inf, 0.0, 0.0, recording.n_frames
        if recording.waited is not None:
            self.counts = in_equal_times(self.counts, recording.waited[0])
            self.waited = float(recording.waited[0].mean())
            return
        if recording.events is None:
            self.slots = recording.n_frames * slots_of_frame(recording)
        if not np.isfinite(self.slots):
            live = conditions.exposure if recording.events is not None else recording.n_frames * conditions.frame_time
            self.blind = recording.dead_time / live

    @property
    def what(self) -> str:
        """The words for `counts`: brought to an equal time they may be more than there are frames."""
        return "detections in an equal time of waiting" if self.waited else "detections"

    def as_poisson(self, counts: np.ndarray) -> np.ndarray:
        """Numbers that scatter like Poisson counts of their size; a few detections stay as they are.

        Twice the root of it has the spread 1: that of a binomial number is an arcsine (Anscombe, Biometrika 35, 1948),
        that of one with a dead time, variance n (1 - n blind)^2 (Mueller, NIM 112, 1973), an inverse hyperbolic
        tangent, that of a rate by first stamps see `_steadied`. Three slots more than there are: the few that are left
        free in saturation are no normal variable, and so they weigh less.
        """
        if self.waited:
            return np.asarray(self.frames * np.interp(counts / self.waited, *_steadied()) ** 2)
        if np.isfinite(self.slots):
            return np.asarray((self.slots + 3.0) * np.arcsin(np.sqrt(counts / (self.slots + 3.0))) ** 2)
        if self.blind <= 0:
            return np.asarray(counts, np.float64)
        root = np.sqrt(counts * self.blind)
        edge = np.sqrt(_BLIND)
        beyond = np.maximum(root - edge, 0.0) / (1.0 - _BLIND)
        return np.asarray((np.arctanh(np.minimum(root, edge)) + beyond) ** 2 / self.blind)

    def detections(self, value: float) -> float:
        """The inverse of `as_poisson`."""
        value = max(0.0, value)
        if self.waited:
            photons, roots = _steadied()
            return float(self.waited * np.interp(np.sqrt(value / self.frames), roots, photons))
        if np.isfinite(self.slots):
            return float((self.slots + 3.0) * np.sin(min(np.sqrt(value / (self.slots + 3.0)), np.pi / 2)) ** 2)
        if self.blind <= 0:
            return value
        root, edge = np.sqrt(value * self.blind), np.arctanh(np.sqrt(_BLIND))
        return float((np.tanh(min(root, edge)) + max(root - edge, 0.0) * (1.0 - _BLIND)) ** 2 / self.blind)

    def variance(self, counts: np.ndarray) -> np.ndarray:
        """What counting alone scatters."""
        if self.waited:  # as much as the detections that there were, of the frames
            told = -self.frames * np.expm1(-counts / self.waited)
            return np.asarray(counts**2 / np.maximum(told, 1e-9))
        if np.isfinite(self.slots):
            return np.asarray(counts * (1.0 - counts / self.slots))
        return np.asarray(counts * (1.0 - np.minimum(counts * self.blind, _BLIND)) ** 2)

    def rates(self, counts: np.ndarray) -> np.ndarray:
        """What would have been detected without saturation and dead time, per pixel over the capture.

        With a slot and a half more than there are, so that a full pixel has a rate, too.
        """
        if np.isfinite(self.slots):
            return -self.slots * np.log((self.slots - np.minimum(counts, self.slots) + 1.5) / (self.slots + 1.5))
        return np.asarray(counts / (1.0 - np.minimum(counts * self.blind, 0.95)))


@lru_cache(maxsize=1)
def _steadied() -> tuple[np.ndarray, np.ndarray]:
    """(photons in a frame, the root of what scatters like Poisson counts, per frame): of rates by first stamps.

    Of F frames F (1 - exp(-x)) have a detection, and so the relative variance of x is one over it. A number F s^2 has
    as much variance as it has size where s' = sqrt(1 - exp(-x)) / (2 x).
    """
    x = np.geomspace(1e-8, 1e6, 20_000)
    slope = np.sqrt(-np.expm1(-x)) / 2.0  # per logarithm of x
    between = (slope[1:] + slope[:-1]) / 2.0 * np.diff(np.log(x))
    roots = np.sqrt(x[0]) + np.concatenate([[0.0], np.cumsum(between)])
    return np.concatenate([[0.0], x]), np.concatenate([[0.0], roots])


def place_of(layout: Layout, pixel: int) -> str:
    """Where a pixel lies, for people; rows and columns count from 0."""
    if layout.positions is None:
        return f"row {pixel // layout.columns}, column {pixel % layout.columns}"
    x, y = layout.positions[pixel] * 1e6
    return f"pixel {pixel} at x = {x:.4g} um, y = {y:.4g} um"


class PixelMap(Statistic):
    """Detections of each pixel.

    Law: Poisson. Frames make counts binomial and a dead time shortens the exposure, so counts are first transformed to
    the scatter of Poisson counts; small counts stay as they are. First stamps: a pixel whose stamps come early has
    waited less, so its detections are scaled to an equal time of waiting. Thus stamps determine the rate where frames
    without a detection are few.
    Shows: pixels with another PDP, hot and dead pixels, gradients and patterns, crosstalk around hot pixels.
    Source: photon response and dark signal non-uniformity, EMVA standard 1288.
    """

    modalities = _ALL
    informs = "counts"
    specific = 2
    unit = "1"

    error = "map"

    @classmethod
    def physical_error(
        cls, measured: np.ndarray, expected: np.ndarray, residuals: np.ndarray, detections: float
    ) -> float:
        """The rms error of the pixels' rates."""
        beyond = max(0.0, float(np.mean(residuals**2)) - 1) / max(float(np.mean(measured)), 1.0)
        return math.sqrt(beyond)

    def reduce(self, recording: Recording) -> Summary | None:
        if not has_data(recording):
            return None
        law, layout = _Counting(recording), recording.layout

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            found, wanted = law.detections(measured), law.detections(expected)
            return f"{whole(found)} {law.what}, {whole(wanted)} expected", float((found - wanted) / max(wanted, 1.0))

        return Summary(
            np.rint(law.as_poisson(law.counts)),
            "poisson",
            lambda cell: place_of(layout, cell),
            size,
            axis=np.arange(layout.pixels, dtype=np.float64),
            label="pixel",
            shape=layout.shape if layout.positions is None else None,
            rate=lambda value: float(law.rates(np.array(law.detections(value)))),
        )


def _lines(recording: Recording, axis: int) -> Summary | None:
    """Sums over the rows (axis 0 of the result) or the columns (axis 1) of a grid."""
    layout = recording.layout
    if not has_data(recording) or layout.positions is not None or min(layout.shape) < 2:
        return None
    law = _Counting(recording)
    per_line = layout.shape[1 - axis]
    name = ("row", "column")[axis]

    def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
        found, wanted = (per_line * law.detections(value / per_line) for value in (measured, expected))
        share = float((found - wanted) / max(wanted, 1.0))
        return f"{whole(found)} {law.what}, {whole(wanted)} expected ({per_cent(share)})", share

    values = law.as_poisson(law.counts).reshape(layout.shape).sum(axis=1 - axis)
    cells = np.arange(layout.shape[axis], dtype=np.float64)
    return Summary(np.rint(values), "poisson", lambda cell: f"{name} {cell}", size, axis=cells, label=name)


class Rows(Statistic):
    """Detections of each row of a grid.

    Law: Poisson, for sums of the pixels' numbers (see `pixel_map`).
    Shows: row patterns, a gradient, a rolling shutter, rows that are read out late.
    """

    modalities = _ALL
    specific = 3
    pools = ("pixel_map",)
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        return _lines(recording, 0)


class Columns(Statistic):
    """Detections of each column of a grid.

    Law: Poisson, for sums of the pixels' numbers (see `pixel_map`).
    Shows: column patterns, a gradient, columns whose readout differs.
    """

    modalities = _ALL
    specific = 3
    pools = ("pixel_map",)
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        return _lines(recording, 1)


_TERMS: tuple[tuple[str, Callable[[np.ndarray, np.ndarray], np.ndarray]], ...] = (
    ("gradient from the first to the last column (x)", lambda x, y: x),
    ("gradient from the first to the last row (y)", lambda x, y: y),
    ("rise from the middle to the edges along x", lambda x, y: 4.0 * x * x),
    ("rise from the middle to the corners along the diagonal (xy)", lambda x, y: 4.0 * x * y),
    ("rise from the middle to the edges along y", lambda x, y: 4.0 * y * y),
)


class _Basis:
    """1 and those terms that the places of an array tell apart: functions (1 + terms, pixels), and their names."""

    def __init__(self, layout: Layout):
        x, y = layout.centred.T
        functions = np.stack([np.ones(layout.pixels), *(term(x, y) for _, term in _TERMS)])
        products = functions @ functions.T
        taken = [0]
        for k in range(1, len(functions)):
            tried = [*taken, k]
            if np.linalg.eigvalsh(products[np.ix_(tried, tried)])[0] > 1e-6 * layout.pixels:
                taken = tried
        self.functions = functions[taken]
        self.inverse = np.linalg.inv(products[np.ix_(taken, taken)])
        self.names = [_TERMS[k - 1][0] for k in taken[1:]]

    def fit(self, values: np.ndarray) -> np.ndarray:
        """Coefficients of the least squares."""
        return np.asarray(self.inverse @ (self.functions @ values))


@lru_cache(maxsize=4)
def _basis_of(rows: int, columns: int, positions: bytes | None) -> _Basis:
    places = None if positions is None else np.frombuffer(positions).reshape(-1, 2)
    return _Basis(Layout(rows, columns, 1.0, 1.0, places))


def _basis(layout: Layout) -> _Basis:
    """It is made once for all recordings of an array."""
    positions = None if layout.positions is None else np.asarray(layout.positions, np.float64).tobytes()
    return _basis_of(layout.rows, layout.columns, positions)


class Surface(Statistic):
    """Gradient and curvature of the map: a polynomial in x, y, x2, xy, y2, relative to the mean rate.

    Cells: each coefficient is the relative change over the array: from edge to edge for x and y, from the middle to the
    edge for the others. Rates are corrected for saturation and dead time, so that a gradient is the same at every light
    level.
    Law: normal, for sums over the array.
    Shows: illumination gradients, vignetting, a temperature gradient in the dark. PDP spread hardly shows.
    """

    modalities = _ALL
    specific = 3
    pools = ("pixel_map",)
    flat = True
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        basis = _basis(recording.layout)
        names = basis.names
        if not has_data(recording) or not names:
            return None
        law = _Counting(recording)
        rates = law.rates(law.counts)
        mean = rates.mean()
        fitted = basis.fit(rates / mean if mean > 0 else np.ones_like(rates))

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            text = f"{per_cent(measured)} of the mean rate, {per_cent(expected)} expected"
            return text, float(measured - expected)

        return Summary(fitted[1:], "normal", lambda cell: names[cell], size)


def _dithered(recording: Recording) -> tuple[np.ndarray, float]:
    """(sorted rates of the pixels, mean without the lowest and the highest tenth, at least 2).

    Every count is spread over (-1/2, 1/2) about itself: whole numbers would jump over a threshold all at once.
    """
    law = _Counting(recording)
    rates = np.sort(law.rates(law.counts + shares(recording.totals, recording.pixels) - 0.5))
    tenth = -(-rates.size // 10)
    return rates, max(2.0, float(rates[tenth : rates.size - tenth].mean()))


class Outliers(Statistic):
    """Number of pixels far below or above the typical pixel.

    Cells: below 1/4, 1/2 and 3/4, and above 1.33, 2, 4 and 10 times the typical pixel: the mean without the lowest and
    the highest tenth of the pixels (at least two detections). Rates are corrected for saturation and dead
    time.
    Law: Poisson where counting noise decides; pixels that a map puts there scatter less.
    Shows: lazy and dead pixels (below), hot pixels (above), a PDP spread of tens of per cent.
    """

    modalities = _ALL
    informs = "distribution"
    pools = ("pixel_map",)
    flat = True
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        if not has_data(recording) or recording.pixels < 4:
            return None
        rates, middle = _dithered(recording)
        low = np.searchsorted(rates, np.array(_BELOW) * middle)
        high = rates.size - np.searchsorted(rates, np.array(_ABOVE) * middle)
        edges = [f"below {level:g}" for level in _BELOW] + [f"above {level:g}" for level in _ABOVE]

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            return f"{measured:g} pixels, {whole(expected)} expected", float((measured - expected) / rates.size)

        return Summary(
            np.concatenate([low, high]).astype(np.float64),
            "poisson",
            lambda cell: f"pixels {edges[cell]} times the typical pixel",
            size,
        )


class Tails(Statistic):
    """Mean rate of the lowest and of the highest pixels relative to the typical pixel.

    Cells: the lowest and the highest quarter, twelfth, and so on by threes, of at least 16 pixels each. The typical
    pixel is the mean without the lowest and the highest tenth (at least two detections). Rates are corrected for
    saturation and dead time.
    Law: normal, for means of many pixels. Of the highest pixels the logarithm is taken, because they are skewed.
    Shows: PDP spread (both sides), lazy pixels (low side), a spread of dark count rates or hot pixels (high side).
    """

    modalities = _ALL
    informs = "distribution"
    pools = ("pixel_map",)
    flat = True
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        pixels = recording.pixels
        sizes = [many for k in range(12) if (many := pixels // (4 * 3**k)) >= _TAIL]
        if not has_data(recording) or not sizes:
            return None
        rates, middle = _dithered(recording)
        upto = np.concatenate([[0.0], np.cumsum(rates)])
        low = [upto[many] / many for many in sizes]
        high = [(upto[-1] - upto[-1 - many]) / many for many in sizes]
        values = np.append(np.array(low) / middle, np.log(np.maximum(np.array(high[::-1]) / middle, 1e-3)))
        names = [f"the lowest {many} of {pixels} pixels" for many in sizes]
        names += [f"the highest {many} of {pixels} pixels" for many in sizes[::-1]]

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            if cell >= len(sizes):
                measured, expected = np.exp(measured), np.exp(expected)
            return f"{measured:.4g} times the typical pixel, {expected:.4g} expected", float(measured - expected)

        return Summary(values, "normal", lambda cell: names[cell], size)


class Spread(Statistic):
    """Variance of the map beyond its counting noise.

    Cells: of the map as it is, and of the map without its surface (see `surface`). A gradient shows in the first only.
    Law: normal, as the score of the variance among equal pixels (the index of dispersion of the counts).
    Shows: PDP spread, hot and lazy pixels, patterns; the first cell also a gradient.
    Source: index of dispersion (Fisher, Biometrics 6, 1950).
    """

    modalities = _ALL
    informs = "distribution"
    pools = ("pixel_map",)
    flat = True
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        pixels, layout = recording.pixels, recording.layout
        basis = _basis(layout)
        free = pixels - np.array([1, len(basis.functions)])
        if not has_data(recording) or free[1] < 8:
            return None
        counting = _Counting(recording)
        counts = counting.counts
        mean = float(counts.mean())
        smooth = basis.fit(counts - mean) @ basis.functions
        squares = np.array([((counts - mean) ** 2).sum(), ((counts - mean - smooth) ** 2).sum()])
        noise = float(counting.variance(counts).mean())
        # as pairs of detections (or of free slots, where these are fewer) in the same pixel
        few = min(mean, counting.slots - mean)
        known = pixels * few * (few - 1.0) / 2.0
        shape = (1.0 - 2.0 * mean / counting.slots) ** 2 + 2.0 * noise - 4.0 / pixels
        variance = free * noise**2 / 2.0 * max(0.0, 1.0 - 1.0 / max(1.0, pixels * few))
        laws = [
            Pairs(np.maximum(known + f * noise / 2.0, 0.0), v, v * max(shape, 1e-3))
            for f, v in zip(free, variance, strict=True)
        ]
        share = shares(recording.totals, 2)
        scores = [pooled_score(known + s / 2.0, law, u) for s, law, u in zip(squares, laws, share, strict=True)]

        def relative(cell: int, score: float) -> float:
            """Relative variance between pixels beyond noise."""
            law = laws[cell]
            pairs = number_at(score, lambda number, part: pooled_score(number, law, part), float(law.mean))
            excess = 2.0 * (pairs - known) / free[cell] - noise
            return float(excess / mean**2) if mean > 0 else 0.0

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            found, wanted = relative(cell, measured), relative(cell, expected)
            shown = [per_cent(root_of(variance)) for variance in (found, wanted)]
            return "pixels differ by {} beyond counting noise, {} expected".format(*shown), root_of(found - wanted)

        names = ("differences between pixels", "differences between pixels, smooth part removed")
        return Summary(np.array(scores), "normal", lambda cell: names[cell], size)
