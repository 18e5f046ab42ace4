"""Replicates: recordings that a model makes of each capture, with common random numbers.

Each replicate is simulated at a light level that gives about as many detections as were measured. The replicate of
one number draws the same random numbers in every model, so that differences between models are nearly free of noise.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from .. import twin
from ..errors import UNABLE, InputError
from ..foreign import quoted
from ..measurement import Measurement
from ..recording import Capture, Recording
from ..sensor import Sensor
from ..statistics import Summary
from ..streams import Streams
from ..workers import Executor
from . import memory, replicate_cache
from .budget import Budget, work_of
from .candidates import Candidate, candidates, maps_added
from .capture_replicates import CannotSimulate, CaptureReplicates, joined
from .journal import Journal
from .models import InTheDark, Model, Packed
from .reduction import ReducedCapture, check_cells, halves_of, statistics_for, summaries_of, total_of

T = TypeVar("T")
Cell = tuple[str, str]  # (capture, statistic)
TOTALS = ("", "rates")  # the block of the totals of all captures
# replicates of each capture that give the difference between two models: with the same random numbers it has little
# noise. A rule of thumb
FEW = 4
# replicates of each capture, by default: the noise of null distributions against the time; a rule of thumb
REPLICATES = 96
# detections and bits of frames, of which a replicate takes little memory: that of fewer is not counted; a rule of thumb
_FEW_EVENTS = 100_000
# of the work of a recording: its simulation; the rest are its statistics. Measured: 40 of 200 to 320 ns a detection in
# time stamps (0.13 to 0.24), 100 to 220 of 270 to 350 ns in first stamps (0.3 to 0.63); a value between the two. It
# decides what the budget counts where some statistics are reduced
_SIMULATING = 0.4
# replicates whose scales are averaged, however many there are, so that more of them change no scale; a rule of thumb
_SCALES = 8


@dataclass(frozen=True)
class _Task:
    """What a worker simulates: replicates of one capture.

    Attributes:
        models: one for all replicates, or one for each.
        photons: (replicates,) photons/s on each pixel.
        numbers: (replicates,) numbers that seed each of them.
        dead: dead time for the reduction, s.
        hasty: without costly statistics.
        names: of the statistics; all where it is empty.
        second: of a half, whether it is of the second, fourth, ... blocks of time; None for a whole capture.
        early: ticks of a frame whose first stamps are counted in the total; None where all are.
        cells: of the statistics of the measured capture, their number.
    """

    models: Sequence[Packed]
    capture: Capture
    photons: np.ndarray
    numbers: np.ndarray
    seed: int
    dead: float
    hasty: bool
    names: Collection[str]
    second: bool | None
    early: int | None
    cells: Mapping[str, int]


def _simulate(task: _Task) -> CaptureReplicates | CannotSimulate:
    """The replicates of one capture, reduced, in a worker."""
    capture, photons, numbers = task.capture, task.photons, task.numbers
    totals: list[float] = []
    found: dict[str, list[Summary]] = {}
    task.models[0].sensor  # noqa: B018  # the user's own statistics come with it
    known = [
        s for s in statistics_for(capture) if not (task.hasty and s.costly) and (not task.names or s.name in task.names)
    ]

    def take(recording: Recording) -> None:
        if task.second is not None:
            half = recording.every_other(task.second)
            assert half is not None  # the measurement's own half is there
            recording = half
        recording = recording.beside(task.dead)
        totals.append(total_of(recording, task.early))
        for name, summary in summaries_of(known, recording).items():
            others = found.setdefault(name, [])
            check_cells(name, summary, task.cells.get(name) or (others or [summary])[0].values.size, capture)
            others.append(summary)

    try:
        for k, model in enumerate(task.models):
            some = slice(None) if len(task.models) == 1 else slice(k, k + 1)
            sensor = model.sensor
            if capture.light.dark:
                sensor = InTheDark.of(sensor)
            for recording in simulated(sensor, capture, photons[some], numbers[some], task.seed):
                take(recording)
                del recording  # before the next one is made
    except UNABLE as error:
        return CannotSimulate.because(error)
    whole = {n: s for n, s in found.items() if len(s) == len(numbers)}
    return CaptureReplicates(
        numbers=numbers,
        totals=np.array(totals, float),
        values={n: np.stack([one.values for one in s]).astype(np.float64) for n, s in whole.items()},
        laws={
            n: (s[0].law, None if s[0].scale is None else np.mean([np.asarray(x.scale) for x in s[:_SCALES]], axis=0))
            for n, s in whole.items()
        },
    )


@dataclass(frozen=True)
class Execution:
    """Workers, budget and callbacks of the simulations.

    Attributes:
        say: called with what is being done.
        progress: called with a capture and the share of the simulations under way that is done.
        budget: of work; the default has no end.
        journal: what was simulated before, and is not simulated again.
    """

    workers: Executor
    say: Callable[[str], None] = lambda what: None
    progress: Callable[[str, float], None] = lambda capture, share: None
    budget: Budget = field(default_factory=Budget)
    journal: Journal | None = None


class Replicates:
    """The measurement, reduced once, and the workers that simulate models of it."""

    def __init__(
        self,
        sensor: Sensor,
        measurement: Measurement,
        seed: int,
        execution: Execution,
        number: int,
        exposures: Mapping[str, float] | None = None,
        reduced: bool = True,
    ):
        """Reduce the measurement.

        Args:
            sensor: the stated model, which the measurement must fit.
            number: replicates of each capture.
            exposures: s, of captures whose exposure is not what the measurement states.
            reduced: with all statistics of the captures; without them only counts can be compared.
        """
        measurement.check_sensor(sensor)
        self.start = sensor.resolved()
        self.seed, self.number, self.workers = seed, number, execution.workers
        self.say, self.progress = execution.say, execution.progress
        self.budget, self.journal = execution.budget, execution.journal
        self.dead = self.start.nominal_dead_time
        self.measurement, self.exposures, self.reduced = measurement, dict(exposures or {}), reduced
        self.seen: dict[str, ReducedCapture] = {}
        self.simulations = 0
        # captures whose stated level is wrong, as the set-up explains the totals: their totals are not compared
        self.unstated: frozenset[str] = frozenset()
        self.faint: frozenset[str] | None = None  # see `evaluation.faint_captures`
        self._reported: set[int] = set()  # numbers of workers that were reported
        for capture in measurement.captures:
            if capture.mean is not None:
                self.seen[capture.id] = ReducedCapture(
                    capture=capture, total=capture.mean * sensor.layout.pixels, counts=None, summaries={}
                )
                continue
            recording = self.recording(capture.id)
            total = float(recording.totals.sum())
            if reduced:  # its replicates have as many detections: what is too large is refused before it is reduced
                needed = memory.replicate_bytes(self.start, recording.capture, total, total)
                memory.check(self.start, recording.capture, needed)
            found = self.seen[capture.id] = ReducedCapture.of(recording, reduced)
            del recording  # before the next one is read
            same = [id for id, other in self.seen.items() if other is not found and found.is_copy(other)]
            if same and not found.is_full(self.start):
                raise InputError(
                    f"{measurement.place(capture.id)}: has the same detections as {quoted(same[0])}, one by one; one "
                    "recording would count as two: leave one of the captures out, or put its own file there"
                )

    def recording(self, id: str) -> Recording:
        """The recording of a capture, with its corrected exposure where there is one."""
        recording = self.measurement.recording(id, self.start)
        if id not in self.exposures:
            return recording
        conditions = replace(recording.conditions, exposure=self.exposures[id])
        return replace(recording, capture=replace(recording.capture, conditions=conditions), _kept={})

    def of_model(self, sensor: Sensor, number: int | None = None) -> Replicates:
        """The measurement for another model, reduced as a comparison with that one reduces it.

        Args:
            number: of replicates of each capture; by default as many as here.
        """
        own, number = sensor.resolved(), number or self.number
        if (own.nominal_dead_time, own.tick) == (self.dead, self.start.tick):  # what the reduction takes of a sensor
            other = copy.copy(self)
            other.start, other.simulations, other.number, other.faint = own, 0, number, None
            return other
        by = Execution(
            workers=self.workers, say=self.say, progress=self.progress, budget=self.budget, journal=self.journal
        )
        return Replicates(sensor, self.measurement, self.seed, by, number, self.exposures, self.reduced)

    def candidates(self, sensor: Sensor) -> list[Candidate]:
        """Every candidate of a sensor that these captures can show."""
        captures = (seen.capture for seen in self.seen.values())
        return candidates(sensor, captures, maps_added(sensor, self.start))

    def halves(self, ids: Collection[str]) -> Replicates:
        """Some captures alone, each as two: its blocks of time 1, 3, ... and its blocks 2, 4, ...

        Their names are those of `halves_of`. Captures that are too short are left out.
        """
        other = copy.copy(self)
        other.seen = {}
        for id in (id for id in self.seen if id in ids and self.seen[id].counts is not None):
            whole = self.recording(id)
            for name, second in zip(halves_of(id), (False, True), strict=True):
                part = whole.every_other(second)  # one after the other, so that only one of them is held
                if part is not None:
                    seen = ReducedCapture.of(part, self.reduced)
                    other.seen[name] = replace(seen, half_of=(replace(whole.capture, tick=whole.tick), second))
        return other

    def of_scene(self, id: str) -> bool:
        """Whether a capture is one of a scene."""
        return self.seen[id].capture.light.scene is not None

    @property
    def dark(self) -> list[str]:
        """The captures without light."""
        return [id for id, seen in self.seen.items() if seen.capture.light.dark]

    def _bytes(self, sensor: Sensor, id: str, photons: np.ndarray) -> float:
        """Bytes of one replicate of a capture; 0 where they are few whatever the sensor.

        Raises:
            InputError: where a replicate takes more than one worker may.
        """
        seen = self.seen[id]
        capture, second = seen.half_of or (seen.capture, None)
        frames = 0 if capture.modality == "tr" else capture.conditions.frames * self.start.layout.pixels
        if seen.detections + frames < _FEW_EVENTS:
            return 0.0
        sensor = InTheDark.of(sensor) if capture.light.dark else sensor
        needed = memory.bytes_with(sensor, capture, float(photons.max()), second is not None)
        memory.check(sensor, capture, needed)
        return needed

    def _limited(self, needed: float) -> Executor:
        """The workers, as many as may make replicates that take so many bytes at the same time."""
        number = memory.workers_at_once(needed, self.workers.threads)
        workers = self.workers.limited(number)
        if workers.threads < self.workers.threads and workers.threads not in self._reported:
            self._reported.add(workers.threads)
            self.say(
                f"{workers.threads} of {self.workers.threads} workers are used at a time: a simulated recording of the "
                f"largest capture takes about {needed / 1e9:.2g} GB of memory"
            )
        return workers

    def charge(self, sensor: Sensor, id: str, number: int) -> None:
        """Spend the work of replicates that are remembered: an answer does not depend on what is in the cache."""
        work = number * self.work_of(sensor, id)
        self.budget.spend(work)
        self.budget.remember(work)
        self.simulations += number

    def work_of(self, sensor: Sensor, id: str) -> float:
        """The work of one replicate of a capture, s of two idle cores."""
        seen = self.seen[id]
        capture = seen.capture if seen.half_of is None else seen.half_of[0]
        whole = 1 if seen.half_of is None else 2  # for a half the whole is simulated
        return work_of(capture, whole * seen.detections, self.start.layout.pixels, twin.draws_bits(sensor, capture))

    # --- simulating ----------------------------------------------------------------------------------------------

    def simulate(
        self,
        wanted: Sequence[tuple[Model, str, np.ndarray, np.ndarray]],
        pieces: int = 1,
        hasty: bool = False,
        names: Sequence[Collection[str]] | None = None,
        remember: Sequence[bool] | None = None,
    ) -> list[CaptureReplicates | CannotSimulate]:
        """The replicates of each (model, capture, photons, numbers), in their order.

        Args:
            wanted: photons in photons/s on a pixel, (replicates,); numbers (replicates,).
            pieces: number of tasks for each capture.
            hasty: without costly statistics.
            names: of each, the statistics that are reduced; all where it is empty.
            remember: of each, whether it is a first look at a candidate of the stated model, which is kept on disk.
        Raises:
            OutOfBudget: where the budget does not allow them.
        """
        tasks: list[list[_Task]] = []
        out: list[CaptureReplicates | CannotSimulate] = [CannotSimulate()] * len(wanted)
        some_of, cached = names or [()] * len(wanted), remember or [False] * len(wanted)
        entries: list[str | None] = [None] * len(wanted)
        most, work = 0.0, [0.0] * len(wanted)  # bytes of a replicate; s of two idle cores
        for k, (model, id, photons, numbers) in enumerate(wanted):
            tasks.append([])
            parts = np.array_split(np.arange(len(numbers)), max(1, min(pieces, len(numbers))))
            capture, second = self.seen[id].half_of or (self.seen[id].capture, None)
            cells = {name: summary.values.size for name, summary in self.seen[id].summaries.items()}
            try:
                sensors = [model.of(id, int(number)) for number in ([0] if model.alike else numbers)]
                if self.journal is not None or cached[k]:
                    more = self.seed, self.dead, pieces, hasty, sorted(cells.items()), *sorted(some_of[k])
                    entries[k] = Journal.name(sensors, self.seen[id], photons, numbers, *more)
                if len(numbers):
                    most = max(most, self._bytes(sensors[0], id, photons))
                    work[k] = len(numbers) * self.work_of(sensors[0], id) * _share_of_work(capture, some_of[k])
                packed = [Packed.of(sensor, self.workers.apart) for sensor in sensors]
                del sensors  # there may be many, with a map each
                for part in parts:
                    tasks[k].append(
                        _Task(
                            models=packed if model.alike else [packed[i] for i in part],
                            capture=capture,
                            photons=photons[part],
                            numbers=numbers[part],
                            seed=self.seed,
                            dead=self.dead,
                            hasty=hasty,
                            names=some_of[k],
                            second=second,
                            early=self.seen[id].early,
                            cells=cells,
                        )
                    )
            except UNABLE as error:
                tasks[k], out[k] = [], CannotSimulate.because(error)
        self.budget.spend(sum(work))
        found = 0.0  # of the work
        self.simulations += sum(len(numbers) for some, (_, _, _, numbers) in zip(tasks, wanted, strict=True) if some)
        for k, some in enumerate(tasks):
            before = self.journal.recall(entries[k]) if some and self.journal else None
            if some and before is None and cached[k]:
                before = replicate_cache.recall(entries[k], replicate_cache.LOOKS)
            if before is not None:
                tasks[k], out[k] = [], before
                found += work[k]
        self.budget.remember(found)
        owners = [k for k, some in enumerate(tasks) for _ in some]
        given = {f"replicates of {wanted[k][1]} ({n + 1} of {len(owners)})": n for n, k in enumerate(owners)}
        every = [task for some in tasks for task in some]
        simulated: dict[int, dict[int, CaptureReplicates | CannotSimulate]] = {k: {} for k in owners}
        count = 0

        def done(key: str, one: CaptureReplicates | CannotSimulate) -> None:
            nonlocal count
            n, count = given[key], count + 1
            k = owners[n]
            simulated[k][n] = one
            self.progress(wanted[k][1], count / len(owners))
            if len(simulated[k]) == len(tasks[k]):
                out[k] = whole = _whole([part for _, part in sorted(simulated.pop(k).items())])
                if self.journal and isinstance(whole, CaptureReplicates):
                    self.journal.keep(entries[k], whole)
                if cached[k] and isinstance(whole, CaptureReplicates):
                    replicate_cache.keep(entries[k], whole, replicate_cache.LOOKS)

        self._limited(most).run(_simulate, lambda keys: (every[given[key]] for key in keys), list(given), done)
        if any(cached[k] for k in owners):
            replicate_cache.make_room()
        return out


def _share_of_work(capture: Capture, names: Collection[str]) -> float:
    """The share of the work of a recording that it takes with some of its statistics alone; 1 where none are named."""
    known = statistics_for(capture)
    share = sum(one.name in names for one in known) / max(len(known), 1)
    return _SIMULATING + (1 - _SIMULATING) * share if names else 1.0


def _whole(parts: Sequence[CaptureReplicates | CannotSimulate]) -> CaptureReplicates | CannotSimulate:
    """The parts of one capture together; the error of one of them where there is one."""
    wrong = [part for part in parts if isinstance(part, CannotSimulate)]
    return wrong[0] if wrong else joined([part for part in parts if isinstance(part, CaptureReplicates)])


def simulated(
    sensor: Sensor, capture: Capture, photons: np.ndarray, numbers: np.ndarray, seed: int
) -> Iterator[Recording]:
    """The recordings of a capture that a model makes, one for each number.

    They are on the ticks of the measurement's file, whatever the sensor's own are, because all counting is in these.
    They are yielded one by one; only a few of them are in memory together.

    Args:
        photons: (replicates,) photons/s on each pixel.
        numbers: (replicates,) numbers that seed each recording.
    """
    expected, _ = sensor.expected(np.full((1, sensor.layout.pixels), float(photons.max())), capture.conditions)
    step = max(1, int(memory.EVENTS_AT_ONCE / (float(expected.sum()) + sensor.layout.pixels)))
    for start in range(0, len(numbers), step):
        some = slice(start, start + step)
        streams = Streams(seed, f"capture/{capture.id}", "model", numbers[some])
        made = twin.model_recordings(sensor, capture, photons[some], streams, numbers[some], direct=True)
        while made:
            yield made.pop(0) if capture.tick is None else made.pop(0).on_ticks(capture.tick)


def no_size(cell: int, measured: float, expected: float) -> tuple[str, float]:
    """No words: for a summary whose words are not needed."""
    return "", 0.0
