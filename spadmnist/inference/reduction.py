"""Reduction of a recording: its total, the counts of its pixels, and its summaries by every statistic that applies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from .. import plugins
from ..errors import SpadError
from ..recording import Capture, Recording
from ..sensor import Sensor
from ..statistics import LAWS, Statistic, Summary
from .blind_times import ShortestIntervals

# in mean times between detections: a longer time after the last detection is compared with the others; one in 20,000
# steady captures is longer
_EMPTY_END = 10.0
# share of frames with a detection above which the early first stamps alone are counted for the light level, and the
# share that is early. For c events in a frame, the number of frames with a detection has the information
# c^2 exp(-c) / (1 - exp(-c)) on log c: 0.47 a frame at 0.95 (c = 3) and falling, 0.64 at 0.75; at most 0.65, at 0.80
_FULL, _EARLY = 0.95, 0.75
_BINS = 1 << 16  # bins of a frame in which first stamps are counted, at most: they take half a megabyte
# detections: a capture with room for fewer is full, and tests hardly anything; a rule of thumb
_FREE = 30.0
# share of frames with a stamp within the early ticks: with more, one tick holds most of the stamps, and their number
# says little of the light. A rule of thumb
_TOO_COARSE = 0.9


def halves_of(id: str) -> tuple[str, str]:
    """The names of the two halves of a capture (`Replicates.halves`)."""
    return f"{id}, odd blocks", f"{id}, even blocks"


@dataclass(frozen=True)
class ReducedCapture:
    """A measured capture, reduced: its total, the counts of its pixels, its summaries.

    Attributes:
        total: detections of the whole array that inform its light level. First stamps of nearly every frame: those
            within `early` ticks.
        counts: (pixels,) detections; None where the mean alone is known.
        summaries: by statistic.
        last: the last detection that has a stamp of its own, s.
        silence: the longest time between two detections of the array, s; None where the last one is near the end.
        waited: (pixels,) of first stamps, the time before them, in frames.
        shortest: the shortest intervals, of time stamps.
        half_of: (the whole capture, whether this is its second, fourth, ... block of time); None where it is no half.
        early: ticks since the start of a frame (`early_ticks`); None where all detections are counted.
    """

    capture: Capture
    total: float
    counts: np.ndarray | None
    summaries: Mapping[str, Summary]
    last: float | None = None
    waited: np.ndarray | None = None
    shortest: ShortestIntervals | None = None
    half_of: tuple[Capture, bool] | None = None
    silence: float | None = None
    early: int | None = None

    @property
    def counted(self) -> Capture:
        """The capture whose detections are the total: of a part of its frames where only early stamps are counted."""
        return counted_of(self.capture, self.early)

    @property
    def detections(self) -> float:
        """Detections of the whole array."""
        return self.total if self.counts is None else float(self.counts.sum())

    def is_full(self, sensor: Sensor) -> bool:
        """Whether so little of it is free that it tests hardly anything; of full first stamps, their times still do."""
        if self.capture.modality not in ("qis", "counts"):
            return False
        c = self.capture.conditions
        room = c.frames * float(sensor.layout.pixels)
        if self.capture.modality == "counts":
            room = c.count_frames * float(sensor.full_counts(c).sum())
        return room - self.detections < min(_FREE, room / 2)

    def is_copy(self, other: ReducedCapture) -> bool:
        """Whether both hold the same detections: enough of them, and every statistic has the same values."""
        mine, theirs = (one.capture.modality for one in (self, other))
        if (mine, self.total, self.last) != (theirs, other.total, other.last):
            return False
        if self.counts is None or other.counts is None or self.detections < _FREE or not self.summaries:
            return False
        pairs = [(mine.values, other.summaries[n].values) for n, mine in self.summaries.items() if n in other.summaries]
        return np.array_equal(self.counts, other.counts) and all(
            np.array_equal(*pair, equal_nan=True) for pair in pairs
        )

    @classmethod
    def of(cls, recording: Recording, reduced: bool = True) -> ReducedCapture:
        """The reduction of a recording.

        Args:
            reduced: with its statistics; without them only the counts are there.
        """
        summaries = summaries_of(statistics_for(recording.capture) if reduced else (), recording)
        counts = np.asarray(recording.totals, float)
        last = silence = None
        if recording.events is not None and len(recording.events):
            stamps, unit = recording.events.stamps
            last = float(stamps.max() * unit)
            if (recording.conditions.exposure - last) * len(stamps) > _EMPTY_END * last:
                silence = float(np.diff(np.sort(stamps)).max(initial=0) * unit)
        waited = None if recording.waited is None else recording.waited[0]
        shortest = ShortestIntervals.of(recording)
        capture = replace(recording.capture, tick=recording.tick)
        early = early_ticks(recording)
        total = total_of(recording, early)
        return cls(
            capture=capture,
            total=total,
            counts=counts,
            summaries=summaries,
            last=last,
            waited=waited,
            shortest=shortest,
            silence=silence,
            early=early,
        )


def early_ticks(recording: Recording) -> int | None:
    """The ticks since the start of a frame within which first stamps are counted for the light level.

    None where their number informs the level, of other data, and where ticks are too long.
    """
    slots = recording.n_frames * recording.pixels
    if recording.modality != "str" or recording.totals.sum() <= _FULL * slots:
        return None
    each = max(recording.none // _BINS, 1)  # ticks
    numbers = np.zeros(-(-recording.none // each), np.int64)
    for _, found in recording.stamped():
        numbers += np.bincount(found.stamps // each, minlength=len(numbers))
    bins = int(np.searchsorted(np.cumsum(numbers), _EARLY * slots)) + 1
    return bins * each if numbers[:bins].sum() < _TOO_COARSE * slots else None


def total_of(recording: Recording, early: int | None) -> float:
    """The detections of the whole array, of first stamps those within so many ticks of their frame."""
    if early is None:
        return float(recording.totals.sum())
    return float(sum(np.count_nonzero(found.stamps < early) for _, found in recording.stamped()))


def counted_of(capture: Capture, early: int | None) -> Capture:
    """The capture of which so many ticks of each frame are counted."""
    if early is None:
        return capture
    assert capture.tick is not None
    return replace(capture, conditions=replace(capture.conditions, live=early * capture.tick))


def statistics_for(capture: Capture) -> list[Statistic]:
    """Every registered statistic that applies to a capture: by its modality, and by its light."""
    kinds = [Statistic.registry.find(name) for name in Statistic.registry]
    scene = capture.light.scene is not None
    return [kind() for kind in kinds if capture.modality in kind.modalities and not (kind.flat and scene)]


def own_statistics() -> list[type[Statistic]]:
    """The statistics of a notebook or of modules of the user's, which stand neither here nor in a plug-in file."""
    known = (Statistic.registry.find(name) for name in Statistic.registry)
    return [cls for cls in known if plugins.is_own(cls)]


def summaries_of(statistics: Iterable[Statistic], recording: Recording) -> dict[str, Summary]:
    """The summaries of a recording by the statistics that apply to it.

    The ticks of its stamps are widened for the statistics here, whose kernels are then compiled for one type; a user's
    own statistic has the recording as it is.
    """
    wide, out = recording.widened(), {}
    for statistic in statistics:
        summary = reduce_with(statistic, wide if plugins.is_built_in(type(statistic)) else recording)
        if summary is not None:
            out[statistic.name] = summary.apart()
    return out


def reduce_with(statistic: Statistic, recording: Recording) -> Summary | None:
    """The summary of a recording by a statistic; None where it does not apply.

    Raises:
        SpadError: where a user's own statistic fails; it names the file and line.
    """
    kind = type(statistic)
    if plugins.is_built_in(kind):
        return statistic.reduce(recording)
    with plugins.blaming(kind):
        found = statistic.reduce(recording.sealed())
        what = None if found is None else _problem(found)
    if what:
        place = f"{plugins.source_file(kind)}: the statistic {statistic.name}"
        raise SpadError(f"{place} {what[0]} in {recording.capture.id}; {what[1]}")
    return found


def _problem(found: Summary) -> tuple[str, str] | None:
    """(what is wrong with what a user's statistic returns, what is right), or None."""
    if not isinstance(found, Summary):
        return f"returns {type(found).__name__}", "reduce returns a Summary, or None where it has nothing to say"
    values, law = found.values, found.law
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu":
        what = f"an array of {values.dtype}" if isinstance(values, np.ndarray) else f"a {type(values).__name__}"
        return f"has {what} as values", "they are a numpy array of numbers, (cells,)"
    if values.ndim != 1 or not values.size:
        return f"has values of shape {values.shape}", "they are (cells,), and None says that there are none"
    if law not in LAWS:
        return f"has the law {law!r}", f"the laws are {', '.join(LAWS)}"
    right, allowed = np.isfinite(values), "values are finite numbers, and None says that there are none"
    if right.all() and law == "poisson":
        right, allowed = (values >= 0) & (values == np.rint(values)), "by the law poisson they are whole, from 0 on"
    elif right.all() and law == "exponential":
        right, allowed = values >= 0, "by the law exponential they are not negative"
    if not right.all():
        cell = int(np.argmin(right))
        return f"has the value {values[cell]} in cell {cell}", allowed
    for name in ("scale", "axis", "nested"):
        column = getattr(found, name)
        if column is not None and np.shape(column) != values.shape:
            return f"has {name} of shape {np.shape(column)}", f"it has a number for each cell, {values.shape}"
    if found.contrasts is not None and (bent := _problem_of_contrasts(found, values.size)):
        return bent
    if found.scale is not None and not np.all((np.asarray(found.scale) >= 0) & (np.asarray(found.scale) < np.inf)):
        return "has a scale that is negative or not finite", "it is the size of the spread of each cell"
    if found.shape is not None and int(np.prod(found.shape)) != values.size:
        return f"has the shape {found.shape} of a map", f"its rows times columns are the cells, {values.size}"
    for cell in sorted({0, values.size - 1}):
        measured = float(values[cell])
        with np.errstate(all="ignore"):  # what is expected of a model may be 0 here alone
            where, size = found.where(cell), found.size(cell, measured, measured or 1.0)
        if not isinstance(where, str):
            return f"says {where!r} for where({cell})", "it is text: what the cell looks at"
        number = isinstance(size, tuple) and len(size) == 2 and isinstance(size[1], float | int | np.number)
        if not number or not isinstance(size[0], str):
            return f"says {size!r} for size({cell}, measured, expected)", "it is (text, share of the detections)"
    return None


def _problem_of_contrasts(found: Summary, cells: int) -> tuple[str, str] | None:
    """(what is wrong with the contrasts of a user's statistic, what is right), or None."""
    right = f"they are (patterns, cells), of {cells} cells, each of unit length and at right angles to the others"
    try:
        patterns = np.asarray(found.contrasts, np.float64)
    except (TypeError, ValueError):
        return "has contrasts that are no array of numbers", right
    if patterns.ndim != 2 or patterns.shape[1] != cells or not len(patterns):
        return f"has contrasts of shape {patterns.shape}", right
    if not np.allclose(patterns @ patterns.T, np.eye(len(patterns)), atol=1e-6):
        return "has contrasts that are not of unit length, or not at right angles", right
    if len(found.contrast_words) != len(patterns):
        return f"has {len(found.contrast_words)} contrast_words", f"each of its {len(patterns)} contrasts has a name"
    return None


def check_cells(name: str, summary: Summary, cells: int, capture: Capture) -> None:
    """Raise SpadError where a summary has another number of cells than another recording of the capture."""
    if summary.values.size != cells:
        kind = Statistic.registry.find(name)
        raise SpadError(
            f"{plugins.source_file(kind)}: the statistic {name} has {cells} cells in one recording of {capture.id} and "
            f"{summary.values.size} in another; their number may depend on the conditions and the layout alone"
        )
