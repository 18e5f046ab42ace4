"""Detections of the whole array in the order of time: intervals between them, crowds, and clusters."""

from __future__ import annotations

import numpy as np

from . import Recording, Statistic, Summary
from ._counting import of_detections, per_cent, span, tick_of, whole
from ._scores import Pairs, number_at, pooled_score, shares
from ._walk import RANKS, SIZES, crowd_edges, crowd_scatter, gaps, spacing_edges, walk


class Spacing(Statistic):
    """Intervals between successive detections of the whole array.

    Cells: logarithmic bins from one tick on, ten to a decade, and one for equal stamps. First stamps of frames (STR):
    within a frame.
    Law: Poisson, for counts of intervals in one cell each. Cells that hold many of all intervals scatter less.
    Shows: crosstalk and bursts (too many short intervals); a readout that needs time between detections of any pixels
    (too few).
    """

    modalities = ("tr", "str")
    pools = ("multiplicity", "array_fano", "intervals", "autocorrelation")
    among = "array"
    unit = "detections"

    def reduce(self, recording: Recording) -> Summary | None:
        """Counts; the first cell is for intervals of 0."""
        if recording.pixels < 2:
            return None
        edges = spacing_edges(recording)
        values = walk(recording).spacings
        seconds = edges * tick_of(recording)

        def where(cell: int) -> str:
            if cell == 0:
                return "the whole array, two at the same tick"
            if cell == edges.size:
                return f"the whole array, more than {span(0, seconds[-1]).partition(' to ')[2]} apart"
            return f"the whole array, {span(seconds[cell - 1], seconds[cell])} apart"

        axis = np.concatenate([[seconds[0] / 2], np.sqrt(seconds[1:] * seconds[:-1]), seconds[-1:]])
        size = of_detections(float(recording.totals.sum()))
        return Summary(values.astype(np.float64), "poisson", where, size, axis=axis, label="spacing (s)", log=True)


class Crowds(Statistic):
    """Crowds of 3, 5, 9, 17 and 33 successive detections of the whole array by their duration.

    A crowd counts where it is so short that, in steady light of the same total, fewer than one detection in 10,000,
    1000, 100 or 10 ends one.
    Law: normal, as the score of the number of crowds against steady light. Crowds overlap, so they come in clumps of
    geometric size; a gamma law of the same mean, variance and third cumulant describes their number.
    Shows: a readout that falls behind at high rates, with a queue that is soon full (a deficit); bursts and fluctuating
    light (an excess).
    """

    modalities = ("tr",)
    pools = ("multiplicity", "array_fano", "intervals", "autocorrelation")
    among = "array"
    unit = "standard deviations"

    def reduce(self, recording: Recording) -> Summary | None:
        """Scores of the numbers of crowds, size after size."""
        if recording.pixels < 2:
            return None
        tick = tick_of(recording)
        edges, chance = crowd_edges(recording)
        numbers = walk(recording).crowds.ravel().astype(np.float64)
        ratio = np.maximum(crowd_scatter().ravel(), 1.0)
        mean = np.maximum(chance.ravel(), 1e-6)  # a little above 0, for where no crowds are possible
        # clumps of geometric size: E S^2 / E S = ratio, E S^3 / E S = 1.5 ratio^2 - 0.5
        laws = [Pairs(*law) for law in zip(mean, ratio * mean, (1.5 * ratio**2 - 0.5) * mean, strict=True)]
        share = shares(np.append(recording.totals, len(mean)), len(mean))
        scores = [pooled_score(*each) for each in zip(numbers, laws, share, strict=True)]

        def where(cell: int) -> str:
            rank, bin = divmod(cell, edges.shape[1])
            low, high = (edges[rank, bin - 1] if bin else 0) * tick, edges[rank, bin] * tick
            return f"{RANKS[rank] + 1} successive detections of the whole array within {span(low, high)}"

        total = max(float(recording.totals.sum()), 1.0)

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            law = laws[cell]
            usual = number_at(expected, lambda number, part: pooled_score(number, law, part), float(law.mean))
            found, usual = ((float(number) - float(law.mean)) / total for number in (numbers[cell], usual))
            return f"{per_cent(found)} of detections beyond steady light, {per_cent(usual)} expected", found - usual

        return Summary(np.array(scores), "normal", where, size)


class Multiplicity(Statistic):
    """Clusters of detections anywhere on the array, by size, each within 1 ns or 10 ns of the one before.

    Cells: clusters of 2, 3, 4, 5 to 8, 9 to 16 and more detections. First stamps of frames (STR): within a frame.
    Law: Poisson, for rare and independent clusters.
    Shows: bursts of many pixels at once, which are too faint in other statistics.
    """

    modalities = ("tr", "str")
    pools = ("neighbours", "far_pairs")
    among = "neighbours"
    unit = "clusters"

    def reduce(self, recording: Recording) -> Summary | None:
        """Numbers of clusters by size, for both gaps."""
        if recording.pixels < 2:
            return None
        values = walk(recording).clusters
        tick = tick_of(recording)
        within = [span(0, gap * tick).partition(" to ")[2] for gap in gaps(tick)]
        rate = of_detections(float(recording.totals.sum()))

        def where(cell: int) -> str:
            gap, k = divmod(cell, len(SIZES))
            low, high = SIZES[k]
            number = str(low) if low == high else f"{low} to {high}" if high else f"{low} or more"
            return f"clusters of {number} detections of the whole array, each within {within[gap]} of the next"

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            number = SIZES[cell % len(SIZES)][0]
            share = rate(cell, measured * number, expected * number)[1]
            return f"{measured:.0f} clusters, {whole(expected)} expected", share

        return Summary(values.ravel().astype(np.float64), "poisson", where, size)
