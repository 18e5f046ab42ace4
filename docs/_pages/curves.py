"""How the statistics of `spadmnist.signatures` are drawn: a curve for each, as a function of what is on the x axis.

A curve belongs to one or several blocks of `signatures.BLOCKS`. Where a block has several, or a curve several captures
to be made of, the picture takes the one that the effect changes most. Each is computed from repetitions of a capture,
whose scatter gives its standard error; nothing here knows an effect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spadmnist.signatures import Shots

# capture -> (photons/s on a pixel, exposures of one repetition): the contract's three, and others for `response`
LIGHTS = {
    "dark": (0.0, 8),
    "dimmest": (3e3, 2),
    "dimmer": (15e3, 2),
    "dim": (60e3, 8),
    "medium": (250e3, 2),
    "bright": (1.2e6, 2),
    "brightest": (4e6, 1),
}
SEEN = 6.0  # standard errors at some point, from which on a difference is shown: as in the contract
_GROUPS = 8  # parts of a capture, from whose scatter the standard error comes

_FEW = 20  # pixels that still wait for their next detection, up to which no rate is said

Points = tuple[np.ndarray, np.ndarray]  # x, y


@dataclass(frozen=True)
class Curve:
    """What is drawn of a statistic.

    name: of the quantity, and at: of a place on its x axis, for a title; x, y: what the axes show, (words, unit);
    captures: of which it may be made, each alone, or () where it needs all; log: the axes that are logarithmic; image:
    y belongs to the pixels, row by row.
    """

    name: str
    at: str
    x: tuple[str, str]
    y: tuple[str, str]
    blocks: tuple[str, ...]
    captures: tuple[str, ...]
    of: Callable[..., Points]
    log: str = ""
    image: bool = False


CURVES: list[Curve] = []


@dataclass(frozen=True)
class Drawn:
    """A curve of one capture: y of all repetitions, and its standard error."""

    curve: Curve
    capture: str
    x: np.ndarray
    y: np.ndarray
    error: np.ndarray


def of_block(block: str) -> list[Curve]:
    """The curves that show a block."""
    return [curve for curve in CURVES if block in curve.blocks]


def drawn(curve: Curve, shots: Mapping[str, Shots]) -> list[Drawn]:
    """The curve of each capture that it may be made of."""
    found = []
    for capture in curve.captures or ("",):
        part = {capture: shots[capture]} if capture else dict(shots)
        x, y = curve.of(part[capture] if capture else part)
        each = np.array([curve.of(group[capture] if capture else group)[1] for group in _groups(part)])
        with np.errstate(invalid="ignore"):
            found.append(Drawn(curve, capture, x, y, each.std(axis=0, ddof=1) / np.sqrt(len(each))))
    return found


def significance(one: Drawn, other: Drawn) -> np.ndarray:
    """(points,) by how many standard errors two curves differ; 0 where one has no value."""
    # where neither scatters, as where nothing was counted, the error is taken to be that of the others
    scatter = np.hypot(one.error, other.error)
    typical = np.nanmedian(scatter[scatter > 0]) if np.any(scatter > 0) else 1.0
    with np.errstate(invalid="ignore"):
        return np.nan_to_num((one.y - other.y) / np.maximum(scatter, 0.3 * typical))


def visible(one: Drawn, other: Drawn) -> float:
    """How much of a picture two curves' difference fills, from 0 to about 1; 0 where it is not significant anywhere.

    The mean distance of the curves where they differ by more than 3 standard errors, as a share of the axis' height.
    """
    z = np.abs(significance(one, other))
    if z.max(initial=0.0) <= SEEN:
        return 0.0
    heights = [one.y, other.y]
    if "y" in one.curve.log:
        with np.errstate(divide="ignore", invalid="ignore"):
            heights = [np.where(y > 0, np.log(y), np.nan) for y in heights]
    low, high = (edge([edge(y) for y in heights]) for edge in (np.nanmin, np.nanmax))
    away = np.where(z > 3.0, np.abs(heights[0] - heights[1]), 0.0)
    return float(np.nanmean(away) / max(high - low, 1e-300))


def _groups(shots: Mapping[str, Shots]) -> Iterator[dict[str, Shots]]:
    for k in range(_GROUPS):
        part = {}
        for name, one in shots.items():
            images = len(one.counts) * one.each
            start, stop = (images * edge // _GROUPS for edge in (k, k + 1))
            part[name] = replace(one, recorded=one.recorded.images(start, stop))
        yield part


def _curve(
    name: str,
    at: str,
    x: tuple[str, str],
    y: tuple[str, str],
    blocks: Sequence[str],
    captures: Sequence[str] = (),
    **how: object,
) -> Callable[[Callable[..., Points]], Callable[..., Points]]:
    def known(of: Callable[..., Points]) -> Callable[..., Points]:
        CURVES.append(Curve(name, at, x, y, tuple(blocks), tuple(captures), of, **how))  # type: ignore[arg-type]
        return of

    return known


# --- rates --------------------------------------------------------------------------------------------------------


@_curve(
    "detections per photon, without the dark counts",
    "at {} photons/s",
    ("photons on a pixel", "1/s"),
    ("detections per photon", ""),
    ("level", "linearity"),
    log="x",
)
def response(shots: Mapping[str, Shots]) -> Points:
    light, rates, dark = _by_light(shots)
    return light, (rates - dark) / light


@_curve(
    "rate of a pixel",
    "at {} photons/s",
    ("photons on a pixel", "1/s"),
    ("rate", "1/s"),
    ("level",),
    log="xy",
)
def rate_by_light(shots: Mapping[str, Shots]) -> Points:
    return _by_light(shots)[:2]


def _by_light(shots: Mapping[str, Shots]) -> tuple[np.ndarray, np.ndarray, float]:
    """(photons/s of each lit capture, mean rates of a pixel in 1/s there, mean rate in the dark)."""
    rates = {LIGHTS[name][0]: float(_rates(one).mean()) for name, one in shots.items()}
    dark = rates.pop(0.0)
    return np.array(list(rates)), np.array(list(rates.values())), dark


@_curve(
    "rates of the pixels in the dark",
    "pixel {} by rate",
    ("pixel, by rate", ""),
    ("rate", "1/s"),
    ("dark_level", "dark_map", "outliers"),
    ("dark",),
)
def dark_rates(shots: Shots) -> Points:
    return np.arange(shots.tr.pixels), np.sort(_rates(shots))


@_curve(
    "rates of the pixels", "pixel {} by rate", ("pixel, by rate", ""), ("rate", "1/s"), ("outliers",), ("dim", "bright")
)
def ordered_rates(shots: Shots) -> Points:
    return np.arange(shots.tr.pixels), np.sort(_rates(shots))


@_curve("rate of a pixel", "pixel {}", ("column", ""), ("row", ""), ("map", "surface"), ("dim", "bright"), image=True)
def picture(shots: Shots) -> Points:
    return np.arange(shots.tr.pixels), _rates(shots)


@_curve(
    "mean rate of a row", "row {}", ("row", ""), ("rate relative to the mean", ""), ("rows_columns",), ("dim", "bright")
)
def rows(shots: Shots) -> Points:
    return _profile(shots, 1)


@_curve(
    "mean rate of a column",
    "column {}",
    ("column", ""),
    ("rate relative to the mean", ""),
    ("rows_columns",),
    ("dim", "bright"),
)
def columns(shots: Shots) -> Points:
    return _profile(shots, 0)


@_curve(
    "frames of 10 us by their count",
    "{} counts",
    ("count", ""),
    ("share of the frames", ""),
    ("saturation",),
    ("bright", "brightest"),
    log="y",
)
def counts(shots: Shots) -> Points:
    seen = shots.binned.astype(np.uint32)
    for effect in shots.sensor.at("readout"):
        seen = effect.limit(seen) if hasattr(effect, "limit") else seen
    found = np.bincount(np.minimum(seen.ravel(), 40), minlength=41) / seen.size
    return np.arange(41), np.where(found > 0, found, np.nan)


def _rates(shots: Shots) -> np.ndarray:
    return np.asarray(shots.counts.mean(axis=(0, 1)) / shots.conditions.exposure)


def _profile(shots: Shots, axis: int) -> Points:
    lines = _rates(shots).reshape(shots.sensor.layout.shape).mean(axis=axis)
    return np.arange(len(lines)), lines / lines.mean()


# --- time since the last detection ----------------------------------------------------------------------------------


@_curve(
    "rate of the next detection of the same pixel",
    "{} ns after the last one",
    ("time since the last one", "ns"),
    ("rate", "1/s"),
    ("edge", "intervals"),
    ("bright", "dim"),
)
def hazard(shots: Shots) -> Points:
    return _hazard(shots, np.arange(0, 500, 4.0))


@_curve(
    "rate of the next detection of the same pixel",
    "{} ns after the last one",
    ("time since the last one", "ns"),
    ("rate", "1/s"),
    ("edge",),
    ("bright", "dim"),
)
def hazard_at_the_edge(shots: Shots) -> Points:
    middle = shots.dead_time * 1e9
    if not middle:  # there is no edge
        return np.zeros(1), np.full(1, np.nan)
    return _hazard(shots, np.arange(max(0.0, middle - 6), middle + 8.1, 0.4))


@_curve(
    "rate of the next detection of the same pixel",
    "{} ns after the last one",
    ("time since the last one", "ns"),
    ("rate", "1/s"),
    ("intervals",),
    ("bright", "dim"),
    log="x",
)
def hazard_later(shots: Shots) -> Points:
    return _hazard(shots, np.geomspace(50, 1e5, 40))


def _hazard(shots: Shots, edges: np.ndarray) -> Points:
    """1/s: detections in each bin of time (ns) since the last one over the time for which pixels waited in it."""
    tr, end = shots.tr, shots.conditions.exposure
    same = tr.rows[1:] == tr.rows[:-1]
    ended = np.diff(tr.times)[same] * 1e9
    last = (end - tr.times[np.append(~same, True)] if len(tr.times) else np.zeros(0)) * 1e9
    return _next_one(ended, last, edges)


def _next_one(ended: np.ndarray, open_: np.ndarray, edges: np.ndarray) -> Points:
    waits = np.sort(np.concatenate([ended, open_]))
    sums = np.concatenate([[0.0], np.cumsum(waits)])
    below = np.searchsorted(waits, edges)
    waited = sums[below] + np.maximum(edges, 0.0) * (len(waits) - below)
    seen = np.histogram(ended, edges)[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = np.where(len(waits) - below[:-1] > _FEW, seen / (np.diff(waited) * 1e-9), np.nan)
    return np.sqrt(edges[1:] * edges[:-1]) if edges[0] > 20 else (edges[1:] + edges[:-1]) / 2, rate


@_curve(
    "rate of the next detection of the array",
    "{} ns after the last one",
    ("time since the last one of any pixel", "ns"),
    ("rate", "1/s"),
    ("ceiling",),
    ("bright", "dim"),
)
def hazard_of_array(shots: Shots) -> Points:
    image = shots.tr.rows // shots.tr.pixels
    order = np.argsort(image + shots.tr.times / (2 * shots.conditions.exposure), kind="stable")
    times, image = shots.tr.times[order], image[order]
    ended = np.diff(times)[image[1:] == image[:-1]] * 1e9
    return _next_one(ended, np.zeros(0), np.arange(-0.05, 60.5, 1.0))  # no edge on a stamp


# --- correlations ---------------------------------------------------------------------------------------------------


@_curve(
    "correlation of a pixel with itself",
    "{} us later",
    ("delay", "us"),
    ("g2 - 1", ""),
    ("autocorrelation",),
    ("bright", "dim"),
)
def own_pairs(shots: Shots) -> Points:
    own, _ = _pairs(shots)
    return _lags(shots, own / (shots.binned.mean(axis=(0, 2)) ** 2).sum())


@_curve(
    "correlation of different pixels",
    "{} us apart",
    ("delay", "us"),
    ("g2 - 1", ""),
    ("far_pairs", "neighbours"),
    ("bright", "dim"),
)
def other_pairs(shots: Shots) -> Points:
    own, together = _pairs(shots)
    mean = shots.binned.mean(axis=(0, 2))
    return _lags(shots, (together - own) / (mean.sum() ** 2 - (mean**2).sum()))


def _pairs(shots: Shots) -> tuple[np.ndarray, np.ndarray]:
    """(lags,) mean product of the counts in bins so far apart: of a pixel with itself, of all with all."""
    d = shots.deviation
    whole = d.sum(axis=1)
    bins = d.shape[2]
    far = range(1, bins // 2)
    own = [(d[..., k:] * d[..., :-k]).sum() / (len(d) * (bins - k)) for k in far]
    together = [(whole[..., k:] * whole[..., :-k]).sum() / (len(d) * (bins - k)) for k in far]
    return np.array(own), np.array(together)


def _lags(shots: Shots, values: np.ndarray) -> Points:
    step = shots.conditions.exposure / shots.binned.shape[2]
    return np.arange(1, len(values) + 1) * step * 1e6, values


@_curve(
    "coincidences of neighbours",
    "{} ns apart",
    ("time between the two", "ns"),
    ("pairs per detection", "1/ns"),
    ("neighbours",),
    ("dim", "bright", "dark"),
)
def coincidences(shots: Shots) -> Points:
    layout = shots.sensor.layout
    apart = np.linalg.norm(layout.places[:, None] - layout.places[None], axis=2)
    near = (apart > 0) & (apart < 1.5)
    image, pixel = np.divmod(shots.tr.rows, shots.tr.pixels)
    order = np.argsort(image + shots.tr.times / (2 * shots.conditions.exposure), kind="stable")
    image, pixel, times = image[order], pixel[order], shots.tr.times[order]
    edges = np.arange(-0.05, 41.0, 1.0)  # no edge on a stamp
    found = np.zeros(len(edges) - 1)
    for step in range(1, len(times)):
        between = (times[step:] - times[:-step]) * 1e9
        close = (image[step:] == image[:-step]) & (between < edges[-1])
        if not close.any():
            break
        found += np.histogram(between[close & near[pixel[:-step], pixel[step:]]], edges)[0]
    return (edges[1:] + edges[:-1]) / 2, found / max(len(times), 1)


@_curve(
    "variance over mean of a pixel's counts",
    "in windows of {} us",
    ("window", "us"),
    ("variance / mean", ""),
    ("fano",),
    ("dim", "dark"),
    log="x",
)
def fano(shots: Shots) -> Points:
    widths = (1, 2, 5, 10, 20, 50, 100)
    bins = shots.binned.shape[2]
    seen = [shots.binned.reshape(*shots.binned.shape[:2], bins // w, w).sum(axis=3) for w in widths]
    # of a pixel over all exposures, so that fixed differences between pixels are none of it
    values = [np.mean(v.var(axis=(0, 2), ddof=1)) / v.mean() for v in seen]
    return np.array(widths) * shots.conditions.exposure / bins * 1e6, np.array(values)


@_curve(
    "power spectrum of the array",
    "at {} Hz",
    ("frequency", "Hz"),
    ("power relative to steady light", ""),
    ("spectrum",),
    ("bright",),
    log="xy",
)
def spectrum(shots: Shots) -> Points:
    bins = 4000
    place = np.minimum((shots.tr.times * (bins / shots.conditions.exposure)).astype(int), bins - 1)
    images = len(shots.tr.offsets) // shots.tr.pixels
    series = np.bincount(shots.tr.rows // shots.tr.pixels * bins + place, minlength=images * bins).reshape(-1, bins)
    power = (np.abs(np.fft.rfft(series, axis=1)[:, 1:-1]) ** 2 / np.maximum(series.sum(axis=1, keepdims=True), 1)).mean(
        axis=0
    )
    frequency = np.arange(1, len(power) + 1) / shots.conditions.exposure
    edges = np.unique(np.rint(np.geomspace(1, len(power) + 1, 60)).astype(int))
    # the clock of the frames is a line: a bin of its own
    line = round(shots.conditions.exposure / shots.conditions.frame_period)
    edges = np.unique(np.append(edges, [line, line + 1]))
    sums = [np.add.reduceat(v, edges[:-1] - 1) / np.diff(edges) for v in (frequency, power)]
    return sums[0], sums[1]


@_curve(
    "rate of the array",
    "{} us after the start",
    ("time in the exposure", "us"),
    ("rate relative to the mean", ""),
    ("trend",),
    ("bright", "dim"),
)
def course(shots: Shots) -> Points:
    rate = shots.binned.sum(axis=(0, 1)).reshape(-1, 4).sum(axis=1)
    end = shots.conditions.exposure * 1e6
    return (np.arange(len(rate)) + 0.5) * end / len(rate), rate / rate.mean()


# --- codes and frames -----------------------------------------------------------------------------------------------


@_curve(
    "occurrences of a code",
    "code {} of 140",
    ("code: time stamp modulo 14 ns, in steps of 100 ps", ""),
    ("occurrences relative to the mean", ""),
    ("phase",),
    ("bright",),
)
def codes(shots: Shots) -> Points:
    code = np.rint(shots.tr.times / 100e-12).astype(np.int64) % 140
    seen = np.bincount(code, minlength=140)
    return np.arange(140), seen / seen.mean()


@_curve(
    "first detection in a frame",
    "{} ns after its start",
    ("time in the frame", "ns"),
    ("probability density", "1/ns"),
    ("first",),
    ("bright",),
)
def first(shots: Shots) -> Points:
    frames = shots.recorded.frames
    assert frames is not None and frames.first is not None
    return _in_frame(frames.first.times, len(frames.bits) * frames.frames)


@_curve(
    "first detection in a frame after one with a late detection",
    "{} ns after its start",
    ("time in the frame", "ns"),
    ("probability density", "1/ns"),
    ("frames_lag",),
    ("bright",),
)
def after_late(shots: Shots) -> Points:
    frames = shots.recorded.frames
    assert frames is not None
    stamps = frames.stamps()
    before, now = stamps[:, :-1], stamps[:, 1:]
    late = (before > 0.95 * frames.frame_time) & (before < frames.frame_time)
    follows = now[late]
    return _in_frame(follows[follows < frames.frame_time], len(follows))


@_curve(
    "frames that fire after one that fired",
    "{} frames later",
    ("frames later", ""),
    ("relative to all frames", ""),
    ("frames_lag",),
    ("bright", "dim"),
)
def later_frames(shots: Shots) -> Points:
    frames = shots.recorded.frames
    assert frames is not None
    bits = frames.unpacked().view(bool)
    share = bits.mean(axis=(0, 1))
    lags = np.arange(1, 21)
    both = [(bits[:, k:] & bits[:, :-k]).mean(axis=(0, 1)) for k in lags]
    return lags, np.array([np.sum(b) for b in both]) / np.sum(share**2)


def _in_frame(times: np.ndarray, frames: int) -> Points:
    edges = np.arange(0, 1001.0, 25.0)
    return (edges[1:] + edges[:-1]) / 2, np.histogram(times * 1e9, edges)[0] / max(frames, 1) / np.diff(edges)
