"""First arrivals in frames."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from .. import units
from ..kernels import jit
from . import Recording, Statistic, Summary
from ._counting import of_detections, span
from ._frames import first_stamps
from ._scores import shares

_BINS = 40
_FINE = 8  # parts of the first of them, about what is carried over from the frame before
_AFTER = ("after an empty frame", "after a frame with an early detection", "after a frame with a late one")
_LATE = 0.9  # of a frame
_FEW = 10  # detections near an end: of fewer nothing is said
_NORMAL = 0.2654  # power of an exponential variable that is as good as normal


class FirstArrivals(Statistic):
    """First detections by their time in the frame, by what the pixel did in the frame before.

    Cells: 40 to a frame, the first of them in eight parts; separately for frames after an empty one, after an early
    detection, and after one in the last tenth of the frame. Pooled over the pixels.
    Law: Poisson, for counts of rare events. Their sum is the number of frames with a detection. Their shape is an
    exponential that the frame cuts off. Both depend on the rate, and they agree where the frame has its stated length.
    Shows: pixels that are live for a part of the frame (nothing at its beginning or end), what a frame leaves to the
    next (dead time: a deficit after a late detection; afterpulses: an excess), and light that changes within a frame.
    """

    modalities = ("str",)
    specific = 2
    unit = "detections"

    def reduce(self, recording: Recording) -> Summary | None:
        """Counts by the time in the frame, for the three kinds of frames one after the other."""
        tick = recording.tick or 1.0
        edges = _edges(recording.none)
        counts = np.zeros((len(_AFTER), edges.size - 1), np.int64)
        kind, last = np.zeros(recording.pixels, np.int8), np.full(recording.pixels, -1)
        bin_of = np.zeros(0, np.uint8)
        if recording.none <= 1 << 22:
            bin_of = np.repeat(np.arange(edges.size - 1, dtype=np.uint8), np.diff(edges))
        late = round(_LATE * recording.none)
        for first, found in first_stamps(recording):
            _arrivals(*found, first, late, edges, bin_of, kind, last, counts)
        cells = edges.size - 1
        seconds = edges * tick

        def where(cell: int) -> str:
            kind, k = divmod(cell, cells)
            return f"{span(seconds[k], seconds[k + 1])} after the start of the frame, {_AFTER[kind]}"

        size = of_detections(float(recording.totals.sum()))
        axis = np.tile((seconds[1:] + seconds[:-1]) / 2, len(_AFTER))
        return Summary(counts.ravel().astype(np.float64), "poisson", where, size, axis=axis, label="time in frame (s)")


class FrameEnds(Statistic):
    """First detections near the beginning and the end of a frame, by their distance in ticks: 1, 2, 4, 8, ...

    Cells: up to a fortieth of a frame. Pooled over the pixels.
    Law: Poisson.
    Shows: the first and the last nanoseconds of a frame in which pixels are not live.
    """

    modalities = ("str",)
    specific = 2
    unit = "detections"

    def reduce(self, recording: Recording) -> Summary | None:
        """Counts from the beginning on, and then from the end back."""
        none = int(recording.none)
        octaves = int(np.log2(max(none / _BINS, 1.0))) + 1
        counts = np.zeros((2, octaves), np.int64)
        for _, (_, stamps, _) in first_stamps(recording):
            _near_ends(stamps, none, counts)
        seconds = np.concatenate([[0.0], 2.0 ** np.arange(octaves)]) * (recording.tick or 1.0)

        def where(cell: int) -> str:
            end, k = divmod(cell, octaves)
            return f"{span(seconds[k], seconds[k + 1])} {('after the start', 'before the end')[end]} of the frame"

        size = of_detections(float(recording.totals.sum()))
        return Summary(counts.ravel().astype(np.float64), "poisson", where, size)


class FrameLimits(Statistic):
    """Time at the beginning and at the end of a frame in which no pixel ever fires.

    The ticks before the first detection of all frames, and after the last one, times the detections per tick in the
    adjacent fortieth of a frame.
    Law: normal. In steady light with many detections the product is exponential with mean 1; its power 0.2654 is nearly
    normal (Weibull's law of that power has hardly any skewness). The place of a detection within its tick is drawn at
    random, so that ticks make no steps.
    Shows: a gate that opens late or closes early by less than a bin.
    """

    modalities = ("str",)
    specific = 2
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        """(2,) at the beginning, at the end; None of a capture that has hardly a detection at either."""
        none, tick = int(recording.none), recording.tick or 1.0
        ends = none, -1
        for _, (_, stamps, _) in first_stamps(recording):
            if len(stamps):
                ends = min(ends[0], int(stamps.min())), max(ends[1], int(stamps.max()))
        reach = max(none // _BINS, 1)
        near, alike = np.zeros(2), np.zeros(2)
        for _, (_, stamps, _) in first_stamps(recording):
            near += np.count_nonzero(stamps <= ends[0] + reach), np.count_nonzero(stamps >= ends[1] - reach)
            alike += np.count_nonzero(stamps == ends[0]), np.count_nonzero(stamps == ends[1])
        if near.min() < _FEW:
            return None
        density = near / (reach + 1.0)
        # the first of those that share its tick, at a time of its own within it
        within = -np.expm1(np.log1p(-shares(np.asarray(recording.totals), 2)) / alike)
        quiet = np.array([ends[0], none - 1 - ends[1]]) + within

        def where(cell: int) -> str:
            return f"the time {('before the first', 'behind the last')[cell]} detection in any frame"

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            found, usual = (max(x, 0.0) ** (1 / _NORMAL) / float(density[cell]) for x in (measured, expected))
            text = f"{units.show(found * tick, 's')}, {units.show(usual * tick, 's')} expected"
            return text, (found - usual) / none

        return Summary((density * quiet) ** _NORMAL, "normal", where, size)


def _edges(none: int) -> np.ndarray:
    """(cells + 1,) ticks."""
    coarse = np.rint(np.linspace(0, none, _BINS + 1))
    fine = np.rint(np.linspace(0, coarse[1], _FINE + 1))
    return np.unique(np.concatenate([fine, coarse])).astype(np.int64)


@jit
def _near_ends(stamps, none, counts):
    """Add to `counts` (2, octaves) the ticks to the beginning and to the end of the frame."""
    octaves = counts.shape[1]
    for stamp in stamps:
        at = np.int64(stamp)
        for end, away in enumerate((at, none - 1 - at)):
            if away >> (octaves - 1) > 0:  # as most are
                continue
            k = 0
            while away > 0 and k < octaves:
                away >>= 1
                k += 1
            if k < octaves:
                counts[end, k] += 1


@jit
def _arrivals(offsets, stamps, pixels, first, late, edges, bin_of, kind, last, counts):
    """Add first stamps to `counts` (kinds, cells). The others: see `FirstStamps`.

    first: number of the first frame; bin_of: (none,) cell of each tick, or empty where there are too many of them;
    kind, last: (pixels,) of the last frame with a detection, 1 or 2 as it is early or late, and its number.
    """
    for f in range(offsets.size - 1):
        frame = first + f
        for i in range(offsets[f], offsets[f + 1]):
            stamp, p = np.int64(stamps[i]), pixels[i]
            k = bin_of[stamp] if bin_of.size else np.searchsorted(edges, stamp, side="right") - 1
            # before the first frame there was none
            counts[kind[p] if frame > 0 and last[p] == frame - 1 else 0, k] += 1
            kind[p] = 2 if stamp >= late else 1
            last[p] = frame
