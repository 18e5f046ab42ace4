"""Reduction of a recording: its total, the counts of its pixels, and its summaries by every statistic that applies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from .. import plugins
from ..errors import SpadError
from ..recording import Capture, Recording
from ..sensor import Sensor
from ..statistics import Statistic, Summary
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
        return cls(capture, total, counts, summaries, last, waited, shortest, silence=silence, early=early)


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
    with plugins.blaming(type(statistic)):
        found = statistic.reduce(recording)
    if found is None or plugins.is_built_in(type(statistic)):
        return found
    if np.ndim(found.values) != 1 or not np.size(found.values):
        raise SpadError(
            f"{plugins.source_file(type(statistic))}: the statistic {statistic.name} has values of shape "
            f"{np.shape(found.values)} in {recording.capture.id}; they are (cells,), and None says that there are none"
        )
    if not np.isfinite(found.values).all():
        cell = int(np.argmin(np.isfinite(found.values)))
        where = f"cell {cell} of {recording.capture.id}"
        raise SpadError(
            f"{plugins.source_file(type(statistic))}: the statistic {statistic.name} has the value "
            f"{found.values[cell]} in {where}; values are finite numbers, and None says that there are none"
        )
    return found
