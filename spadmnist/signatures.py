"""What a sensor's events look like: statistics by which the contract (`testing`) sees what an effect changes.

They are computed from three captures of steady light, each many exposures of the same scene, so that the scatter from
one repetition to the next is known without any model. Where a statistic is a shape, the level is taken out of it.

The statistics of `compare` (`statistics/`) are others: they reduce one recording whose light is inferred from it, so
that an effect changes most of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .effects import Conditions
from .events import Events, Layout
from .readout import Recorded
from .sensor import Sensor

# the statistics, and what each looks at; TR unless it says something else
BLOCKS = {
    "level": "mean rate in dim light",
    "map": "fixed differences from pixel to pixel in dim light less the dark, beyond lines and a smooth surface",
    "rows_columns": "fixed differences from row to row and column to column, likewise, beyond a smooth surface",
    "surface": "a smooth (cubic) surface over the array, likewise",
    "outliers": "pixels far outside the spread of the others, dark or lit",
    "dark_level": "mean rate in the dark",
    "dark_map": "fixed differences from pixel to pixel in the dark",
    "linearity": "bright light against dim, without the dead time's and the dark counts' parts",
    "fano": "variance over mean of counts, in windows of an exposure and from one to the next, in the dark and dim",
    "edge": "intervals shorter than the dead time and just beyond it, against the rate a little later",
    "intervals": "longer intervals, against a constant rate",
    "autocorrelation": "a pixel's counts against its later ones in the same exposure",
    "neighbours": "coincidences and common changes of neighbouring pixels",
    "far_pairs": "the same of pixels that are farther apart",
    "spectrum": "the array's rate by frequency, and at the frames' clock",
    "trend": "mean time of detections within the exposure",
    "phase": "density of the converter's codes",
    "first": "STR: the first arrival within a frame",
    "frames_lag": "QIS: a frame against the next ones",
    "ceiling": "how closely events of the whole array follow each other",
    "saturation": "how many counts are as large as the largest",
}
_BINS = 100  # of an exposure
_NEAR = 1.5  # pitches to a neighbour, at most
_TOGETHER = 20e-9  # s between the two of a coincidence, at most
_TURN = (100e-12, 5040)  # s, a code; codes in which every period up to 10, and many a longer one, has its whole turns
# s from the end of the dead time: the windows of "edge", and of "intervals"
_WINDOWS = np.array([-1, -0.25e-9, 0.25e-9, 2e-9, 5e-9, 20e-9, 100e-9, 500e-9, 2.5e-6, 12.5e-6])
_EDGE, _LATER = 5, 6


@dataclass
class Shots:
    """One capture: many exposures, `each` of them a repetition. dead_time: s, as the sensor is thought to have."""

    recorded: Recorded
    sensor: Sensor
    conditions: Conditions
    each: int
    dead_time: float

    @property
    def tr(self) -> Events:
        assert self.recorded.tr is not None
        return self.recorded.tr

    @cached_property
    def counts(self) -> np.ndarray:
        """(repetitions, each, pixels)."""
        return self.tr.counts.reshape(-1, self.each, self.tr.pixels)

    @cached_property
    def rate(self) -> np.ndarray:
        """(repetitions, pixels) 1/s of the time in which the pixel is not blind."""
        detections = self.counts.sum(axis=1)
        return detections / np.maximum(self.each * self.conditions.exposure - detections * self.dead_time, 1e-9)

    @cached_property
    def binned(self) -> np.ndarray:
        """(images, pixels, bins) counts."""
        rows = len(self.tr.offsets) - 1
        bins = np.minimum((self.tr.times * (_BINS / self.conditions.exposure)).astype(int), _BINS - 1)
        return np.bincount(self.tr.rows * _BINS + bins, minlength=rows * _BINS).reshape(-1, self.tr.pixels, _BINS)

    @cached_property
    def deviation(self) -> np.ndarray:
        """(images, pixels, bins) counts less their mean over the exposure."""
        return self.binned - self.binned.mean(axis=2, keepdims=True)

    def repeated(self, values: np.ndarray) -> np.ndarray:
        """(repetitions, ...) sums of what there is one of for each image."""
        return values.reshape(-1, self.each, *values.shape[1:]).sum(axis=1)


def statistics(dark: Shots, dim: Shots, bright: Shots) -> dict[str, np.ndarray]:
    """Each block's numbers, (repetitions,) or (repetitions, k), from three captures; see `BLOCKS`."""
    levels = [shots.rate.mean(axis=1) for shots in (dark, dim, bright)]
    surface, lines, rest = _patterns(dim.sensor.layout)
    light = dim.counts - dark.counts
    lags = ((1, 1), (2, 4), (5, 15))
    near, far = _together(bright)
    windows = [_intervals(shots) for shots in (dim, bright)]
    coincident = [_coincidences(shots) for shots in (dark, dim)]
    return {
        "level": levels[1],
        "dark_level": levels[0],
        "linearity": _ratio(levels[2] - levels[0], levels[1] - levels[0]),
        "map": _fixed(light, rest),
        "rows_columns": _fixed(light, lines),
        "surface": _fixed(light, surface),
        "dark_map": _fixed(dark.counts, np.eye(dark.tr.pixels)),
        "outliers": np.concatenate([_outliers(shots) for shots in (dark, dim, bright)], axis=1),
        "fano": np.concatenate([_fano(shots) for shots in (dark, dim)], axis=1),
        "edge": windows[1][:, :_EDGE],
        "intervals": np.concatenate([shares[:, _EDGE:] for shares in windows], axis=1),
        "autocorrelation": np.stack([_echo(shots, *lag) for shots in (dim, bright) for lag in lags], axis=1),
        "neighbours": np.stack([near, *(pair[0] for pair in coincident)], axis=1),
        "far_pairs": np.stack([far, *(pair[1] for pair in coincident)], axis=1),
        "spectrum": _spectrum(bright),
        "trend": np.stack([_mean_time(shots) for shots in (dim, bright)], axis=1),
        "phase": _codes(bright),
        "first": _first(bright),
        "frames_lag": np.column_stack([_successive(dim), _successive(bright), _late_and_early(bright)]),
        "ceiling": _ceiling(bright),
        "saturation": _at_most(bright),
    }


def significance(one: np.ndarray, other: np.ndarray) -> float:
    """By how many standard errors the means over the repetitions differ; of several numbers, the largest.

    A number that one of the two does not have (NaN) says nothing.
    """
    a, b = (values.reshape(len(values), -1) for values in (one, other))
    difference = a.mean(axis=0) - b.mean(axis=0)
    error = np.sqrt(a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b))
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.nan_to_num(np.where(difference == 0, 0.0, difference / error), posinf=np.inf, neginf=-np.inf)
    return float(z[np.abs(z).argmax()])


def _ratio(above: np.ndarray, below: np.ndarray, nothing: float = 0.0) -> np.ndarray:
    """above / below, or `nothing` where there is nothing to divide by."""
    return np.divide(above, below, out=np.full(np.broadcast(above, below).shape, nothing), where=below > 0)


def _patterns(layout: Layout) -> list[np.ndarray]:
    """Projections (pixels, pixels) on a cubic surface, on lines beyond it, and on what is left besides the mean."""
    (x, y), pixels = layout.centred.T, layout.pixels
    smooth = [x**i * y**j for i in range(4) for j in range(4 - i) if i + j]
    lines = [np.arange(pixels) // layout.columns == row for row in range(layout.rows)]
    lines += [np.arange(pixels) % layout.columns == column for column in range(layout.columns)]
    left = np.eye(pixels) - 1 / pixels
    found = []
    for shapes in (smooth, lines):
        left_over = left @ np.array(shapes, float).T
        u, size, _ = np.linalg.svd(left_over, full_matrices=False)
        u = u[:, size > 1e-9]
        found.append(u @ u.T)
        left = left - u @ u.T
    return [*found, left]


def _fixed(counts: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """(repetitions,) relative variance over the pixels, along a pattern, that two halves of a repetition share."""
    repetitions, _, pixels = counts.shape
    halves = counts.reshape(repetitions, 2, -1, pixels).sum(axis=2)
    a, b = np.moveaxis(_ratio(halves, halves.mean(axis=2, keepdims=True), 1.0) - 1, 1, 0)
    return np.mean((a @ pattern) * b, axis=1)


def _outliers(shots: Shots) -> np.ndarray:
    """(repetitions, 2) share of the pixels far below and far above the median."""
    detections = shots.counts.sum(axis=1)
    middle = np.median(detections, axis=1, keepdims=True)
    spread = 1.5 * np.median(np.abs(detections - middle), axis=1, keepdims=True)
    away = (detections - middle) / np.maximum(spread, np.sqrt(middle + 1))
    return np.stack([(away < -6).mean(axis=1), (away > 6).mean(axis=1)], axis=1)


def _fano(shots: Shots) -> np.ndarray:
    """(repetitions, 3) variance over mean of a pixel's counts: in a bin, in ten, and of whole exposures."""
    found = []
    for width in (1, 10):
        wide = shots.binned.reshape(*shots.binned.shape[:2], -1, width).sum(axis=3)
        sums = [shots.repeated(v.sum(axis=1)) for v in (wide.var(axis=2, ddof=1), wide.mean(axis=2))]
        found.append(_ratio(sums[0], sums[1], np.nan))
    whole = shots.counts
    found.append(_ratio(whole.var(axis=1, ddof=1).sum(axis=1), whole.mean(axis=1).sum(axis=1), np.nan))
    return np.stack(found, axis=1)


def _intervals(shots: Shots) -> np.ndarray:
    """(repetitions, windows) share of the intervals in each window, less that of a constant rate.

    At the edge it is the rate at which intervals end a little later, so that slow changes have no say there.
    """
    rows = shots.tr.rows
    inside = rows[1:] == rows[:-1]
    beyond = (np.diff(shots.tr.times) - shots.dead_time)[inside]
    repetition = rows[1:][inside] // (shots.tr.pixels * shots.each)
    windows = len(_WINDOWS) + 1
    place = repetition * windows + np.searchsorted(_WINDOWS, beyond, side="right")
    seen = np.bincount(place, minlength=len(shots.counts) * windows).reshape(-1, windows)[:, 1:-1]
    # the spacings of n places drawn evenly from what the dead times leave of the exposure
    n = shots.counts[..., None]
    free = np.maximum(shots.conditions.exposure - (n - 1) * shots.dead_time, 1e-9)
    survive = np.maximum(1 - np.maximum(_WINDOWS, 0.0) / free, 0.0) ** n
    told = (np.maximum(n - 1, 0) * (survive[..., :-1] - survive[..., 1:])).sum(axis=(1, 2))
    told[:, :_EDGE] *= _ratio(seen[:, [_LATER]], told[:, [_LATER]])
    return _ratio(seen - told, shots.counts.sum(axis=(1, 2))[:, None])


def _echo(shots: Shots, least: int, most: int) -> np.ndarray:
    """(repetitions,) correlation of a pixel's counts with those `least` to `most` bins later."""
    d = shots.deviation
    products = np.sum([(d[..., lag:] * d[..., :-lag]).sum(axis=(1, 2)) for lag in range(least, most + 1)], axis=0)
    return _ratio(shots.repeated(products), shots.repeated((d**2).sum(axis=(1, 2))))


def _neighbours(layout: Layout) -> np.ndarray:
    """(pixels, pixels) 1 where two are neighbours."""
    apart = np.linalg.norm(layout.places[:, None] - layout.places[None], axis=2)
    return ((apart > 0) & (apart <= _NEAR)).astype(float)


def _together(shots: Shots) -> tuple[np.ndarray, np.ndarray]:
    """(repetitions,) each: correlation of the counts of neighbours, and of other pairs, bin by bin."""
    near = _neighbours(shots.sensor.layout)
    far = 1 - np.eye(len(near)) - near
    products = shots.repeated(shots.deviation @ shots.deviation.transpose(0, 2, 1))
    own = np.trace(products, axis1=1, axis2=2) / len(near)
    a, b = (_ratio((products * pairs).sum(axis=(1, 2)) / pairs.sum(), own) for pairs in (near, far))
    return a, b


def _in_time(shots: Shots) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(image, pixel, time) of all events, image after image, each in the order of time."""
    image, pixel = np.divmod(shots.tr.rows, shots.tr.pixels)
    order = np.argsort(image + shots.tr.times / (2 * shots.conditions.exposure), kind="stable")
    return image[order], pixel[order], shots.tr.times[order]


def _coincidences(shots: Shots) -> tuple[np.ndarray, np.ndarray]:
    """(repetitions,) each: pairs of events at once in neighbours, and in other pixels, per event, less chance ones."""
    near = _neighbours(shots.sensor.layout)
    image, pixel, time = _in_time(shots)
    first, second = [np.zeros(0, int)], [np.zeros(0, int)]
    for step in range(1, len(time)):
        at_once = np.flatnonzero((time[step:] - time[:-step] < _TOGETHER) & (image[step:] == image[:-step]))
        if not len(at_once):
            break
        first.append(at_once)
        second.append(at_once + step)
    before, after = np.concatenate(first), np.concatenate(second)
    total = shots.rate.sum(axis=1)
    found = []
    for pairs in (near, 1 - np.eye(len(near)) - near):
        weights = pairs[pixel[before], pixel[after]]
        seen = np.bincount(image[before] // shots.each, weights=weights, minlength=len(total))
        chance = _TOGETHER * _ratio(((shots.rate @ pairs) * shots.rate).sum(axis=1), total)
        found.append(_ratio(seen, shots.counts.sum(axis=(1, 2))) - chance)
    return found[0], found[1]


def _spectrum(shots: Shots) -> np.ndarray:
    """(repetitions, 6) share of the array's fluctuations in bands of frequency; the line of the frames' clock."""
    power = np.abs(np.fft.rfft(shots.binned.sum(axis=1), axis=1)[:, 1:]) ** 2
    bands = [power[:, a:b].mean(axis=1) for a, b in ((0, 1), (1, 2), (2, 5), (5, 15), (15, 50))]
    phase = ((shots.tr.times / shots.conditions.frame_period) % 1 * 16).astype(int)
    image = shots.tr.rows // shots.tr.pixels
    clock = np.bincount(image * 16 + phase, minlength=len(power) * 16).reshape(-1, 16)
    line = _ratio(np.abs(np.fft.rfft(clock, axis=1)[:, 1]) ** 2, clock.sum(axis=1))
    found = [_ratio(shots.repeated(band), shots.repeated(power.mean(axis=1))) for band in bands]
    return np.stack([*found, shots.repeated(line)], axis=1)


def _mean_time(shots: Shots) -> np.ndarray:
    """(repetitions,) mean time of the detections in an exposure, in exposures from its middle."""
    running = np.concatenate([[0], np.cumsum(shots.tr.times / shots.conditions.exposure - 0.5)])
    edges = shots.tr.image_offsets[:: shots.each]
    return _ratio(running[edges[1:]] - running[edges[:-1]], np.diff(edges))


def _codes(shots: Shots) -> np.ndarray:
    """(repetitions,) relative variance of the codes' density that two halves of a repetition share."""
    width, codes = _TURN
    code = np.rint(shots.tr.times / width).astype(np.int64) % codes
    half = shots.tr.rows // (shots.tr.pixels * shots.each // 2)
    seen = np.bincount(half * codes + code, minlength=2 * len(shots.counts) * codes).reshape(-1, 2, codes)
    a, b = np.moveaxis(_ratio(seen, seen.mean(axis=2, keepdims=True), 1.0) - 1, 1, 0)
    return np.mean(a * b, axis=1)


def _first(shots: Shots) -> np.ndarray:
    """(repetitions, 4) share of the first arrivals in parts of the frame, less that of a constant rate."""
    frames = shots.recorded.frames
    assert frames is not None and frames.first is not None
    edges = np.array([0, 0.02, 0.1, 0.4, 1])
    fired = shots.repeated(frames.detections.counts.reshape(-1, shots.tr.pixels))
    many = shots.each * frames.frames
    rate = -np.log1p(-np.minimum(fired, many - 0.5) / many)
    survive = np.exp(-rate[..., None] * edges)
    told = many * (survive[..., :-1] - survive[..., 1:]).sum(axis=1)
    part = np.searchsorted(edges, frames.first.times / frames.frame_time, side="right") - 1
    repetition = frames.first.rows // (shots.tr.pixels * shots.each)
    shape = (len(fired), 4)
    seen = np.bincount(repetition * 4 + part, minlength=shape[0] * 4).reshape(shape)
    return _ratio(seen - told, fired.sum(axis=1)[:, None])


def _successive(shots: Shots) -> np.ndarray:
    """(repetitions, 2) correlation of a pixel's frame with the next one, and with the one after it."""
    frames = shots.recorded.frames
    assert frames is not None
    bits = frames.unpacked().view(bool)
    return np.stack([_follows(shots, bits, bits, lag) for lag in (1, 2)], axis=1)


def _late_and_early(shots: Shots) -> np.ndarray:
    """(repetitions,) correlation of late stamps in a frame with early ones in the next."""
    frames = shots.recorded.frames
    assert frames is not None
    stamps = frames.stamps()
    early, late = stamps < 0.1 * frames.frame_time, stamps > 0.9 * frames.frame_time
    return _follows(shots, late & (stamps < frames.frame_time), early, 1)


def _follows(shots: Shots, one: np.ndarray, other: np.ndarray, lag: int) -> np.ndarray:
    """(repetitions,) correlation of what is true of a frame with what is true of one `lag` frames later."""
    both = shots.repeated((one[:, :-lag] & other[:, lag:]).mean(axis=1)) / shots.each
    a, b = (shots.repeated(which.mean(axis=1)) / shots.each for which in (one, other))
    return _ratio((both - a * b).sum(axis=1), np.sqrt((a * (1 - a)).sum(axis=1) * (b * (1 - b)).sum(axis=1)))


def _ceiling(shots: Shots) -> np.ndarray:
    """(repetitions,) share of the array's events that another one follows within 3 ns, less that by chance."""
    image = shots.tr.rows // shots.tr.pixels
    scale = 1 / (2 * shots.conditions.exposure)
    place = np.sort(image + shots.tr.times * scale)
    close = np.diff(place) < 3e-9 * scale
    events = shots.counts.sum(axis=(1, 2))
    seen = np.bincount(place[1:][close].astype(int) // shots.each, minlength=len(events))
    return _ratio(seen, events) + np.expm1(-3e-9 * events / (shots.each * shots.conditions.exposure))


def _at_most(shots: Shots) -> np.ndarray:
    """(repetitions,) how many counts, as a counter shows them, are as large as the largest."""
    counts = shots.binned.astype(np.uint32)
    for effect in shots.sensor.at("readout"):
        counts = effect.limit(counts) if hasattr(effect, "limit") else counts
    counts = counts.reshape(len(shots.counts), -1)
    return (counts == counts.max(axis=1, keepdims=True)).mean(axis=1)
