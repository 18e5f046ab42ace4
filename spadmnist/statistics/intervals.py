"""Intervals between successive detections of a pixel."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math

import numpy as np

from .. import units
from ..kernels import inline, jit
from . import Recording, Statistic, Summary
from ._counting import (
    exposure_in,
    guide,
    logarithmic,
    of_detections,
    place,
    root_of,
    span,
    tick_of,
    whole,
    whole_ticks,
)
from ._scores import number_at, pooled_score, shares, unequal_pairs_law
from ._series import has_data

_BEFORE, _BEHIND = 10e-9, 20e-9  # s: what belongs to the edge, before and behind the dead time
_FINEST = 0.5e-9  # s
_LONGEST = 100e-3  # s
# s: what is counted as early, against the dead time; the last are what a pixel's own afterpulses fill
_EARLY = (-5e-9, -2e-9, -0.5e-9, 0.0, 1e-9, 5e-9, 20e-9, 100e-9)
_FINE, _REACH = 1e-9, 1e-6  # s: steps in which intervals are looked at closely, and how far behind the dead time
_PER_DECADE = 10
_KNOWN = 16  # intervals from which on a pixel's own rate is known well enough
_LEVELS = 20
_LAGS = (1, 2, 3, 5, 10, 20)
_FEWEST_PIXELS, _BRIGHTEST = 16, 2.0  # that can differ; times as many short intervals as usual, in a pixel
_FEWEST = 300  # products from which on a correlation is a normal variable


def _edge(recording: Recording) -> np.ndarray:
    """(bins + 1,) ticks, evenly from 10 ns before the dead time to 20 ns behind it."""
    tick = tick_of(recording)
    step = max(1, math.floor(_FINEST / tick * (1 + 1e-9)))
    first = max(0, round((recording.dead_time - _BEFORE) / tick))
    bins = max(1, round((round((recording.dead_time + _BEHIND) / tick) - first) / step))
    return first + step * np.arange(bins + 1)


class EdgeIntervals(Statistic):
    """Intervals between successive detections of a pixel near the dead time, in steps of 0.5 ns or a tick.

    Cells: from 10 ns before the dead time to 20 ns beyond it, and one for shorter intervals. Pooled over the pixels.
    Law: Poisson, for counts of rare events in one cell each.
    Shows: another dead time, one that differs from pixel to pixel, a paralyzable one, slow recovery (a deficit at
    first), detections at the very end of the dead time, short-lived traps, and jitter, which blurs the edge.
    """

    modalities = ("tr",)
    specific = 3
    among = "pixel"
    unit = "detections"

    def reduce(self, recording: Recording) -> Summary | None:
        """Counts, the first cell being shorter intervals where there can be any."""
        edges = _edge(recording)
        counts = np.zeros(edges.size, np.int64)
        assert recording.events is not None
        stamps, _ = whole_ticks(recording)
        _about_edge(stamps, recording.events.offsets, edges[0], edges[1] - edges[0], counts)
        skipped = 0 if edges[0] > 0 else 1
        seconds = edges * tick_of(recording)

        def where(cell: int) -> str:
            k = cell + skipped
            return f"intervals below {units.show(seconds[0], 's')}" if k == 0 else f"intervals of {_within(seconds, k)}"

        middles = np.concatenate([[seconds[0]], (seconds[1:] + seconds[:-1]) / 2])
        size = of_detections(float(recording.totals.sum()))
        return Summary(
            counts[skipped:].astype(np.float64),
            "poisson",
            where,
            size,
            axis=middles[skipped:],
            label="interval (s)",
        )


class Intervals(Statistic):
    """Intervals between successive detections of a pixel beyond the dead time, in logarithmic bins.

    Cells: from 20 ns beyond the dead time to 100 ms, ten bins to a decade, and one for longer intervals. Pooled over
    the pixels.
    Law: Poisson, for counts of intervals in one cell each. The few cells that hold many of all intervals scatter less.
    Shows: afterpulsing with its lifetimes (an excess that does not depend on the light), slow traps, echoes, source
    noise, and detections that are lost.
    """

    modalities = ("tr",)
    specific = 2
    pools = ("edge_intervals", "fine_intervals", "pixel_map")
    among = "pixel"
    unit = "detections"

    error = "intervals"

    @classmethod
    def physical_error(
        cls, measured: np.ndarray, expected: np.ndarray, residuals: np.ndarray, detections: float
    ) -> float:
        """The share of the intervals that lie in wrong cells."""
        # 0.8: the mean magnitude of a normal variable, in standard deviations
        beyond = np.abs(measured - expected).sum() - 0.8 * np.sqrt(np.maximum(expected, 0)).sum()
        return max(0.0, float(beyond)) / 2 / max(float(measured.sum()), 1.0)

    def reduce(self, recording: Recording) -> Summary | None:
        """Counts; the last cell is all that is longer."""
        tick = tick_of(recording)
        first = int(_edge(recording)[-1])
        edges = logarithmic(first, min(exposure_in(recording, tick), round(_LONGEST / tick)), _PER_DECADE)
        counts = np.zeros(edges.size, np.int64)
        assert recording.events is not None
        stamps, _ = whole_ticks(recording)
        _lengths(stamps, recording.events.offsets, *guide(edges), counts)
        seconds = edges * tick

        def where(cell: int) -> str:
            if cell == edges.size - 1:
                return f"intervals beyond {units.show(seconds[-1], 's')}"
            return f"intervals of {_within(seconds, cell + 1)}"

        axis = np.concatenate([np.sqrt(seconds[1:] * seconds[:-1]), seconds[-1:]])
        size = of_detections(float(recording.totals.sum()))
        return Summary(counts.astype(np.float64), "poisson", where, size, axis=axis, label="interval (s)", log=True)


class FineIntervals(Statistic):
    """Intervals between successive detections of a pixel beyond the dead time, in steps of 1 ns.

    Cells: from 20 ns to 1 us beyond the dead time. Pooled over the pixels. A cell that deviates a little in every
    capture is found by all captures together.
    Law: Poisson, for counts of intervals in one cell each.
    Shows: what returns after a fixed time and is too faint in wider bins: a reflection in a fibre or on a board, the
    period of a nearby clock.
    """

    modalities = ("tr",)
    specific = 3
    pools = ("edge_intervals", "pixel_map")
    among = "pixel"
    unit = "detections"

    def reduce(self, recording: Recording) -> Summary | None:
        """Counts."""
        tick = tick_of(recording)
        step = max(1, round(_FINE / tick))
        first = int(_edge(recording)[-1])
        bins = max(1, round((recording.dead_time + _REACH) / tick - first) // step)
        counts = np.zeros(bins + 1, np.int64)
        assert recording.events is not None
        stamps, _ = whole_ticks(recording)
        _about_edge(stamps, recording.events.offsets, first, step, counts)
        seconds = (first + step * np.arange(bins + 1)) * tick

        def where(cell: int) -> str:
            return f"intervals of {_within(seconds, cell + 1)}"

        size = of_detections(float(recording.totals.sum()))
        middles = (seconds[1:] + seconds[:-1]) / 2
        return Summary(counts[1:].astype(np.float64), "poisson", where, size, axis=middles, label="interval (s)")


class EarlyIntervals(Statistic):
    """Differences between pixels in their shortest intervals: pairs of short intervals in the same pixel.

    Cells: intervals up to 5, 2 and 0.5 ns below the dead time, up to it, and up to 1, 5, 20 and 100 ns beyond it. The
    expected share of a pixel follows from its rate, if all pixels have the same dead time. A pixel with more than twice
    the usual share is left out, because it would have nearly all pairs.
    Law: normal, as the score of the pairs given the number of intervals; Poisson where there are few pairs.
    Shows: a dead time that differs from pixel to pixel, and afterpulsing of some pixels. Jitter blurs the edge of all
    pixels alike, so it does not show.
    Source: index of dispersion (Fisher, Biometrics 6, 1950).
    """

    modalities = ("tr",)
    informs = "dead times"
    specific = 2
    pools = ("edge_intervals", "pixel_map")
    among = "pixel"
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        tick = tick_of(recording)
        bounds = np.unique(np.rint((recording.dead_time + np.array(_EARLY)) / tick).astype(np.int64))
        bounds = bounds[bounds > 0]
        if not has_data(recording) or recording.pixels < _FEWEST_PIXELS or not bounds.size:
            return None
        assert recording.events is not None
        stamps, _ = whole_ticks(recording)
        numbers = np.zeros((bounds.size, recording.pixels), np.int64)
        _up_to(stamps, recording.events.offsets, bounds, numbers)
        numbers = numbers.cumsum(axis=0)

        detections = recording.totals.astype(np.float64)
        live = np.maximum(recording.conditions.exposure - detections * recording.dead_time, detections * tick)
        rates = np.divide(detections, live, out=np.zeros_like(live), where=detections > 0)
        # up to a tick behind the dead time in proportion to the time, then ever fewer of what is left
        behind = np.maximum(bounds * tick - recording.dead_time, tick)
        share = shares(recording.totals, bounds.size)
        laws, pairs, scores = [], [], []
        for number, time, one in zip(numbers, behind, share, strict=True):
            chances = -detections * np.expm1(-rates * time)
            usual = float(np.median(chances[chances > 0])) if chances.any() else 0.0
            kept = (chances > 0) & (chances <= _BRIGHTEST * usual)
            chances, number = chances[kept], number[kept]
            laws.append(unequal_pairs_law(float(number.sum()), chances / max(float(chances.sum()), 1e-300)))
            pairs.append(float((number * (number - 1)).sum()) / 2.0)
            scores.append(pooled_score(pairs[-1], laws[-1], one))

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            law, few = laws[cell], float(numbers[cell].sum())

            def at(score: float) -> float:
                if score == scores[cell]:
                    return pairs[cell]
                return number_at(score, lambda n, part: pooled_score(n, law, part), float(law.mean))

            found, wanted = at(measured), at(expected)
            # by so much do the numbers differ that make the pairs
            change = root_of((found - wanted) / max(float(law.mean), 1.0))
            text = f"{whole(found)} pairs in the same pixel of {few:.0f}, {whole(wanted)} expected"
            return text, few / max(1.0, float(detections.sum())) * min(max(change, -1.0), 1.0)

        seconds = bounds * tick
        return Summary(
            np.array(scores),
            "normal",
            lambda cell: f"intervals below {units.show(seconds[cell], 's')}, unlike in the pixels",
            size,
            axis=seconds,
            label="interval (s)",
        )


class Rescaled(Statistic):
    """Intervals relative to the pixel's own rate: u = 1 - exp(-rate (interval - dead time)), which is uniform.

    Cells: 20 from 0 to 1. Pooled over the pixels. Intervals shorter than the dead time count as 0. The rate is the
    pixel's own, from its intervals. Pixels with fewer than 16 intervals are left out, in the simulations as well, so
    this makes no bias.
    Law: Poisson, a little narrower because the rate is fitted to the same intervals.
    Shows: any departure of a pixel's detections from a Poisson process with dead time, of a known or unknown cause.
    Maps, levels and gradients do not show.
    Source: time rescaling, Brown et al., Neural Computation 14 (2002) 325.
    """

    modalities = ("tr",)
    pools = ("intervals",)
    among = "pixel"
    unit = "detections"

    def reduce(self, recording: Recording) -> Summary | None:
        """Counts of u."""
        counts, _, _ = _rescale(recording)
        size = of_detections(float(recording.totals.sum()))

        def where(cell: int) -> str:
            low, high = (-math.log1p(-min(k / _LEVELS, 1 - 1e-12)) for k in (cell, cell + 1))
            bound = f"{low:.3g} to {high:.3g}" if cell < _LEVELS - 1 else f"more than {low:.3g}"
            return f"intervals of {bound} times the pixel's mean, beyond the dead time"

        axis = (np.arange(_LEVELS) + 0.5) / _LEVELS
        return Summary(counts.astype(np.float64), "poisson", where, size, axis=axis, label="rescaled interval")


class RescaledLag(Statistic):
    """Correlation of a pixel's rescaled intervals (see `rescaled`) 1, 2, 3, 5, 10 and 20 apart.

    Law: normal, with spread 1/sqrt(products), as the mean product of many independent bounded numbers; 0 below 300
    products. Intervals of a Poisson process with dead time are independent.
    Shows: a rate that changes slowly (blinking, drift, source noise), and afterpulses, which come in pairs.
    """

    modalities = ("tr",)
    pools = ("autocorrelation",)
    among = "pixel"
    unit = "standard errors"

    def reduce(self, recording: Recording) -> Summary | None:
        """Correlations in units of their spread."""
        _, sums, products = _rescale(recording)
        spread = 1 / np.sqrt(np.maximum(products, 1))
        values = np.where(products < _FEWEST, 0.0, 12 * sums * spread)

        def where(cell: int) -> str:
            return "an interval and the next" if cell == 0 else f"intervals {_LAGS[cell]} apart"

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            found, usual = float(measured * spread[cell]), float(expected * spread[cell])
            return f"correlation {found:+.3g}, {usual:+.3g} expected", found - usual

        lags = np.array(_LAGS, np.float64)
        return Summary(values, "normal", where, size, np.ones(len(_LAGS)), lags, "intervals apart")


@jit
def _up_to(stamps, offsets, bounds, out):
    """Add to `out` (bounds, rows) the intervals below each bound and not below the one before."""
    for row in range(offsets.size - 1):
        if offsets[row] == offsets[row + 1]:
            continue
        before = np.int64(stamps[offsets[row]])
        for i in range(offsets[row] + 1, offsets[row + 1]):
            now = np.int64(stamps[i])
            gap = now - before
            before = now
            if gap < bounds[-1]:
                k = 0
                while gap >= bounds[k]:
                    k += 1
                out[k, row] += 1


def _within(seconds: np.ndarray, k: int) -> str:
    return span(float(seconds[k - 1]), float(seconds[k]))


@jit
def _about_edge(stamps, offsets, first, step, out):
    """Add to `out` (bins + 1,) the intervals below `first`, and in bins of `step` from there on; what is longer not."""
    bins = out.size - 1
    per_step = 1.0 / step
    for row in range(offsets.size - 1):
        if offsets[row] == offsets[row + 1]:
            continue
        before = np.int64(stamps[offsets[row]])
        for i in range(offsets[row] + 1, offsets[row + 1]):
            now = np.int64(stamps[i])
            # half a tick off the edges, so that rounding is of no matter
            x = (now - before - first + 0.5) * per_step
            before = now
            if x < bins:
                out[np.int64(x) + 1 if x > 0.0 else 0] += 1


@jit
def _lengths(stamps, offsets, edges, start, out):
    """Add to `out` the intervals between `edges`; see `guide`."""
    for row in range(offsets.size - 1):
        if offsets[row] == offsets[row + 1]:
            continue
        before = np.int64(stamps[offsets[row]])
        for i in range(offsets[row] + 1, offsets[row + 1]):
            now = np.int64(stamps[i])
            k = place(now - before, edges, start)
            before = now
            if k >= 0:
                out[k] += 1


def _rescale(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """((levels,) counts of u, (lags,) sums of products of u - 1/2, (lags,) their number)."""
    known = recording._kept.get("rescaled")
    if known is None:
        assert recording.events is not None
        stamps, tick = whole_ticks(recording)
        counts = np.zeros(_LEVELS, np.int64)
        lags = np.array(_LAGS)
        sums, products = np.zeros(len(lags)), np.zeros(len(lags), np.int64)
        dead = recording.dead_time / tick
        _rescaled(stamps, recording.events.offsets, dead, _KNOWN, lags, counts, sums, products)
        known = recording._kept["rescaled"] = counts, sums, products
    return known  # type: ignore[return-value]


@jit
def _rescaled(stamps, offsets, dead, least, lags, counts, sums, products):
    levels = counts.size
    most = 0
    for row in range(offsets.size - 1):
        most = max(most, offsets[row + 1] - offsets[row])
    u = np.empty(most)
    for row in range(offsets.size - 1):
        start, stop = offsets[row], offsets[row + 1]
        n = stop - start - 1
        if n < least:
            continue
        live = np.float64(np.int64(stamps[stop - 1]) - np.int64(stamps[start])) - n * dead
        if live <= 0:
            continue
        rate = n / live
        own = stamps[start:stop]
        for k in range(n):
            gap = np.float64(np.int64(own[k + 1]) - np.int64(own[k])) - dead
            u[k] = rate * max(gap, 0.0)
        for k in range(n):
            u[k] = 1.0 - _exp_of_minus(u[k])
        for k in range(n):
            counts[min(np.int64(u[k] * levels), levels - 1)] += 1
            u[k] -= 0.5
        for m in range(lags.size):
            if n > lags[m]:
                sums[m] += _product(u[lags[m] : n], u[: n - lags[m]])
            products[m] += max(n - lags[m], 0)


@jit
def _product(a, b):
    """The sum of products in eight parts, so that several are taken at a time."""
    parts = np.zeros(8)
    whole = a.size // 8 * 8
    for k in range(0, whole, 8):
        for j in range(8):
            parts[j] += a[k + j] * b[k + j]
    total = parts.sum()
    for k in range(whole, a.size):
        total += a[k] * b[k]
    return total


@inline
def _exp_of_minus(x):
    """exp(-x) to rounding for x >= 0, in plain arithmetic, so that several are taken at a time."""
    x = min(x, 700.0)
    octaves = math.floor(x * 1.4426950408889634 + 0.5)
    # what is left, at most half an octave: a power series
    y = (octaves * 0.693147180369123816490 - x) + octaves * 1.90821492927058770002e-10
    value = 1.0 / 479001600.0
    for k in (39916800.0, 3628800.0, 362880.0, 40320.0, 5040.0, 720.0, 120.0, 24.0, 6.0, 2.0, 1.0, 1.0):
        value = value * y + 1.0 / k
    return value * np.int64((1023 - np.int64(octaves)) << 52).view(np.float64)
