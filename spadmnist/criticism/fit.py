"""Fit: a model beside a measurement, and what another model would change of it.

Everything is judged as `compare` judges it. What another value of a parameter would do to a statistic is found by
simulating a few recordings with the same random numbers as the model's own: their difference is nearly free of
scatter, and what is left of it is added to that of the cells.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeVar

import numpy as np
from joblib import Parallel, delayed
from scipy import ndimage, stats

from .. import twin
from ..errors import UNABLE, EffectError, SpadError, why
from ..heap import keep_freed_memory
from ..measurement import Measurement
from ..recording import Capture, Recording
from ..sensor import Sensor
from ..statistics import Summary
from . import recordings
from .candidates import Change, Key, Values, changes, on_chip, with_values
from .edges import Shortest
from .nulls import LEAST_POWER, Null, _standardized, learn, poisson_scores, powers_of
from .shifts import beyond_noise, difference

T = TypeVar("T")
Cell = tuple[str, str]  # capture, statistic
RATES = ("", "rates")  # the block of all captures' totals
_MOST_LIGHT, _MOST_DARK = 1.5, 9.0  # of a logarithm: how far a level is changed to have as many detections
_GOLDEN = (math.sqrt(5) - 1) / 2  # turns, after each of which the next point falls into the widest gap
_LEAST_TOTAL, _NEVER = 5.0, 0.5  # detections that say something; fewer than these are none
_SOME = 0.3  # standard deviations: less says nothing of the size of one
_FAINT = 1e-6  # of the light: none
_SEEN = 1.0  # variance of chance, of what a trace has in a statistic
_WIDEST, _WIDER = 2.3, 0.5  # of the logarithm of two scatters: no more is believed, and so much is no chance
_ALIKE, _FLUCTUATES = 1.5, 3.0  # times the model's own scatter of totals: as wide is another's; one that is far wider
_CHANCE = 2.3e-4  # p-value, to one side, of totals beside the closed form
_SURE_SQUARE = 30.0  # in variances, of what is never chance
_BESIDE = 9  # powers beside one, of which most are no line
FEW = 4  # recordings that tell the difference between two models
_SURELY = 8  # the same of two whose totals do not differ as the closed form has it
Kept = Literal["sure", "likely", "all"]  # of what a few recordings show


def halves_of(id: str) -> tuple[str, str]:
    """What the halves of a capture are called (`Bench.halves`)."""
    return f"{id}, odd blocks", f"{id}, even blocks"


class Fault(str):
    """Why a model cannot be simulated: an effect's own code has failed."""


def _unable(error: BaseException) -> str:
    return (Fault if isinstance(error, EffectError) else str)(why(error))


@dataclass(frozen=True)
class Seen:
    """A capture as it was measured: its detections, of each pixel, and its summaries.

    counts: None where the mean alone is known. last: s, of the last detection that has a stamp of its own. waited:
    (pixels,) of first stamps, frames' worth of time before them. shortest: of time stamps. half_of: the capture that
    this is every other block of time of, and is it the second ones? None where it is all of one.
    """

    capture: Capture
    total: float
    counts: np.ndarray | None
    summaries: Mapping[str, Summary]
    last: float | None = None
    waited: np.ndarray | None = None
    shortest: Shortest | None = None
    half_of: tuple[Capture, bool] | None = None

    @classmethod
    def of(cls, recording: Recording, reduced: bool = True) -> Seen:
        """What is looked at of a recording. reduced: its statistics, too."""
        summaries = {}
        for statistic in recordings.statistics_for(recording.capture) if reduced else ():
            summary = recordings.reduced(statistic, recording)
            if summary is not None:
                summaries[statistic.name] = summary.apart()
        counts = np.asarray(recording.totals, float)
        last = None
        if recording.events is not None and len(recording.events.times):
            last = float(recording.events.times.max())
        waited = None if recording.waited is None else recording.waited[0]
        shortest = Shortest.of(recording)
        capture = replace(recording.capture, tick=recording.tick)
        return cls(capture, float(counts.sum()), counts, summaries, last, waited, shortest)


@dataclass
class Made:
    """Recordings that a model made of one capture. values: (recordings, cells) by statistic."""

    numbers: np.ndarray
    totals: np.ndarray
    values: dict[str, np.ndarray]
    laws: dict[str, tuple[str, np.ndarray | None]]


@dataclass
class State:
    """A model beside the measurement: its nulls, the data's residuals, and those of its own recordings.

    level, expected, law, scatter, stated: as in `compare.CaptureNull`, by capture.
    """

    values: dict[Key, Any]
    sensors: Sensors
    made: dict[str, Made]
    nulls: dict[Cell, Null]
    rates: dict[str, recordings.CaptureNull]
    factors: dict[str, np.ndarray]
    residuals: dict[Cell, np.ndarray]
    own: dict[Cell, np.ndarray]
    exact: list[Cell]
    space: tuple[list[str], np.ndarray, np.ndarray, np.ndarray] | None = None  # see `Bench.rate_space`
    _kept: dict[tuple[Any, ...], Any] = field(default_factory=dict, init=False, repr=False)  # see `once`

    def before(self, cell: Cell, few: int) -> tuple[np.ndarray, np.ndarray]:
        """((few, cells) what the model's first recordings have beyond its expectation, (cells,) its scatter)."""

        def make() -> tuple[np.ndarray, np.ndarray]:
            null, made = self.nulls[cell], self.made[cell[0]]
            beyond = made.values[cell[1]][:few] - null.expected_all(made.totals[:few])[0]
            return beyond, _spread_of(null, made)

        return self.once(("before", cell, few), make)

    @property
    def fluctuates(self) -> bool:
        """Is the light another one in every recording: are their totals far less alike than chance alone has them?"""
        simulated = (self.rates[id] for id in self.made)
        return any(far_wider(r.scatter, 1 / math.sqrt(max(r.expected(r.level), 1.0))) for r in simulated)

    def usual(self, cell: Cell, total: float) -> tuple[np.ndarray, float]:
        """What a statistic's null expects of so many detections, see `Null.expected`."""
        return self.once(("usual", cell, total), lambda: self.nulls[cell].expected(total))

    def square(self, cell: Cell) -> float:
        """Sum of the squared residuals of the data in one statistic."""
        return self.once(("square", cell), lambda: float(self.residuals[cell] @ self.residuals[cell]))

    def once(self, name: tuple[Any, ...], make: Callable[[], T]) -> T:
        """What is made of the state by name: when it is first asked for, then it is kept."""
        if name not in self._kept:
            self._kept[name] = make()
        found: T = self._kept[name]
        return found


@dataclass
class Moved:
    """What another model does: by how much each cell's expectation shifts, in proportion to its strength.

    nothing: it does nothing at all in these captures, whatever its strength. even: what grows with the square of it,
    and so is the same for both signs. fluctuates: are the totals of recordings far less alike than the model's own?
    """

    shifts: dict[Cell, np.ndarray]
    noise: dict[Cell, float]
    logs: dict[str, float]  # of the light that gives as many detections
    nothing: bool = False
    even: Moved | None = None
    fluctuates: bool = False

    def only(self, ids: Collection[str]) -> Moved:
        """The same, seen in some captures alone; of the others, the totals."""
        shifts = {cell: x for cell, x in self.shifts.items() if cell[0] in ids}
        noise = {cell: x for cell, x in self.noise.items() if cell[0] in ids}
        even = None if self.even is None else self.even.only(ids)
        return Moved(shifts, noise, self.logs, self.nothing, even)

    def beside(self, other: Moved, ids: Collection[str]) -> Moved:
        """The same, and what `other` does in some captures of which this says the totals alone."""
        there = other.only(ids)
        logs = {**self.logs, **{id: log for id, log in other.logs.items() if id in ids}}
        even = self.even
        if even is not None or there.even is not None:
            even = (even or Moved({}, {}, {})).beside(there.even or Moved({}, {}, {}), ids)
        shifts, noise = {**self.shifts, **there.shifts}, {**self.noise, **there.noise}
        return Moved(shifts, noise, logs, self.nothing and other.nothing, even)

    def at(self, times: float) -> Moved:
        """What it does at so many times its strength."""
        if self.even is None and times == 1:
            return self
        out = Moved(
            {cell: times * x for cell, x in self.shifts.items()},
            {cell: times**2 * x for cell, x in self.noise.items()},
            {id: times * x for id, x in self.logs.items()},
            self.nothing,
        )
        if self.even is not None:
            for cell, x in self.even.shifts.items():
                out.shifts[cell] = out.shifts.get(cell, 0.0) + times**2 * x
            for id, log in self.even.logs.items():
                out.logs[id] = out.logs.get(id, 0.0) + times**2 * log
        return out

    @staticmethod
    def both(up: Moved, down: Moved, powers: Mapping[Cell, np.ndarray] | None = None, few: int = FEW) -> Moved:
        """Of what a strength does and what its opposite does: the odd part and the even one.

        powers: what cells usually have that are squares of amplitudes. What is added to an amplitude moves them in
        proportion to its strength by what chance had in them already, another chance in each recording; so that is
        none of what it does if so `few` recordings may have made it.
        """

        def half(a: Mapping[Any, Any], b: Mapping[Any, Any], sign: float) -> dict[Any, Any]:
            return {k: 0.5 * (a.get(k, 0.0) + sign * b.get(k, 0.0)) for k in a.keys() | b.keys()}

        noise = half(up.noise, down.noise, 1.0)
        even = Moved(half(up.shifts, down.shifts, 1.0), {}, half(up.logs, down.logs, 1.0))
        odd = half(up.shifts, down.shifts, -1.0)
        for cell in odd.keys() & (powers or {}).keys():
            usual = ndimage.median_filter(powers[cell], _BESIDE)  # type: ignore[index]  # a line's own has a sign
            chance = 2 * usual * np.abs(even.shifts[cell]) / few  # variance of what grows in proportion
            odd[cell] = np.where(odd[cell] ** 2 > _SURE_SQUARE * chance, odd[cell], 0.0)
        scatters = up.fluctuates or down.fluctuates
        return Moved(odd, noise, half(up.logs, down.logs, -1.0), up.nothing and down.nothing, even, scatters)


@dataclass(frozen=True)
class Sensors:
    """A sensor, or one for each capture, or for each recording of it (maps that are not exactly known)."""

    of: Callable[[str, int], Sensor]
    one: Sensor
    alike: bool = True
    typical: Callable[[str], Sensor] | None = None

    def usual(self, capture: str) -> Sensor:
        """The one whose closed forms hold in the mean over what differs from recording to recording."""
        return self.typical(capture) if self.typical else self.of(capture, 0)

    @staticmethod
    def same(sensor: Sensor) -> Sensors:
        """One sensor for every recording of every capture."""
        return Sensors(lambda capture, number: sensor, sensor)

    def under(self, name_of: Callable[[str], str]) -> Sensors:
        """The same sensors for captures that have other names. name_of: other name -> capture."""
        typical = self.typical
        return Sensors(
            lambda capture, number: self.of(name_of(capture), number),
            self.one,
            self.alike,
            None if typical is None else lambda capture: typical(name_of(capture)),
        )

    def changed(
        self, values: Values, phases: Mapping[tuple[str, Key], float] | None = None, chips: bool = False
    ) -> Sensors:
        """These sensors with some values set; phases: those of each capture.

        chips: every recording is of a chip of its own, for which of the pixels it is that chance hit is not known.
        """

        def own(capture: str) -> dict[Key, Any]:
            return {**values, **{key: x for (id, key), x in (phases or {}).items() if id == capture}}

        def of(capture: str, number: int) -> Sensor:
            sensor = self.of(capture, number)
            return with_values(on_chip(sensor, number + 1) if chips else sensor, own(capture))

        def usual(capture: str) -> Sensor:
            return with_values(self.usual(capture), own(capture))

        typical = functools.lru_cache(maxsize=64)(usual)
        known = typical if self.typical or chips else None
        return Sensors(of, with_values(self.one, values), self.alike and not chips, known)


def _task(
    models: Sequence[recordings.Packed],
    capture: Capture,
    photons: np.ndarray,
    numbers: np.ndarray,
    seed: int,
    dead: float,
    hasty: bool = False,
    second: bool | None = None,
) -> Made | str:
    """Recordings of one capture, reduced: the task of a worker. models: one for all, or one for each.

    hasty: without statistics that cost much. second: of every other block of time alone, of the second ones or not.
    """
    keep_freed_memory()
    totals: list[int] = []
    found: dict[str, list[Summary]] = {}
    known = [s for s in recordings.statistics_for(capture) if not (hasty and s.costly)]

    def take(recording: Recording) -> None:
        if second is not None:
            half = recording.every_other(second)
            assert half is not None  # for the measurement's is there
            recording = half
        recording = recording.beside(dead)
        totals.append(int(recording.totals.sum()))
        for statistic in known:
            summary = recordings.reduced(statistic, recording)
            if summary is not None:
                found.setdefault(statistic.name, []).append(summary.apart())

    try:
        for k, model in enumerate(models):
            some = slice(None) if len(models) == 1 else slice(k, k + 1)
            sensor = model.sensor
            if capture.light.dark:
                sensor = recordings.InTheDark.of(sensor)
            for recording in recordings.simulated(sensor, capture, photons[some], numbers[some], seed):
                take(recording)
    except UNABLE as error:
        return _unable(error)
    whole = {n: s for n, s in found.items() if len(s) == len(numbers)}
    return Made(
        numbers,
        np.array(totals, float),
        {n: np.stack([one.values for one in s]).astype(np.float64) for n, s in whole.items()},
        {
            n: (s[0].law, None if s[0].scale is None else np.mean([np.asarray(one.scale) for one in s], axis=0))
            for n, s in whole.items()
        },
    )


class Bench:
    """The measurement, reduced once, and the workers that simulate models of it."""

    def __init__(
        self,
        sensor: Sensor,
        measurement: Measurement,
        seed: int,
        parallel: Parallel,
        replicates: int,
        say: Callable[[str], None] = lambda what: None,
        exposures: Mapping[str, float] | None = None,
        reduced: bool = True,
    ):
        """exposures: s, of captures that were not as long as the measurement states. reduced: with all statistics of
        the captures, without which nothing but their counts can be compared.
        """
        measurement.check_sensor(sensor)
        self.start = sensor.settled()
        self.seed, self.parallel, self.replicates, self.say = seed, parallel, replicates, say
        self.dead = self.start.nominal_dead_time
        self.measurement, self.exposures, self.reduced = measurement, dict(exposures or {}), reduced
        self.seen: dict[str, Seen] = {}
        self.simulations = 0
        for capture in measurement.captures:
            if capture.mean is not None:
                self.seen[capture.id] = Seen(capture, capture.mean * sensor.layout.pixels, None, {})
            else:
                self.seen[capture.id] = Seen.of(self.recording(capture.id), reduced)

    def recording(self, id: str) -> Recording:
        """The data of a capture, as long as they are."""
        recording = self.measurement.recording(id, self.start)
        if id not in self.exposures:
            return recording
        conditions = replace(recording.conditions, exposure=self.exposures[id])
        return replace(recording, capture=replace(recording.capture, conditions=conditions), _kept={})

    def changes(self, sensor: Sensor) -> list[Change]:
        """Every candidate to change a sensor by, as these captures can show it."""
        return changes(sensor, (seen.capture for seen in self.seen.values()))

    def halves(self, ids: Collection[str]) -> Bench:
        """Some captures alone, each as two: its first, third, ... block of time and its second, fourth, ... one.

        Their names are those of `halves_of`. Captures that are too short are not among them.
        """
        other = copy.copy(self)
        other.seen = {}
        for id in (id for id in self.seen if id in ids and self.seen[id].counts is not None):
            whole = self.recording(id)
            parts = [whole.every_other(second) for second in (False, True)]
            for name, part, second in zip(halves_of(id), parts, (False, True), strict=True):
                if part is not None:
                    seen = Seen.of(part, self.reduced)
                    other.seen[name] = replace(seen, half_of=(replace(whole.capture, tick=whole.tick), second))
        return other

    def of_scene(self, id: str) -> bool:
        """Is a capture one of a scene?"""
        return self.seen[id].capture.light.scene is not None

    @property
    def dark(self) -> list[str]:
        """Captures without light."""
        return [id for id, seen in self.seen.items() if seen.capture.light.dark]

    # --- simulating ----------------------------------------------------------------------------------------------

    def simulate(
        self,
        wanted: Sequence[tuple[Sensors, str, np.ndarray, np.ndarray]],
        pieces: int = 1,
        hasty: bool = False,
    ) -> list[Made | str]:
        """Recordings for each of (sensors, capture, photons, numbers), in their order; or why there are none."""
        tasks: list[list[tuple[Any, ...]]] = []
        out: list[Made | str] = [""] * len(wanted)
        for k, (sensors, id, photons, numbers) in enumerate(wanted):
            tasks.append([])
            parts = np.array_split(np.arange(len(numbers)), max(1, min(pieces, len(numbers))))
            capture, second = self.seen[id].half_of or (self.seen[id].capture, None)
            try:
                for part in parts:
                    each = [0] if sensors.alike else [int(numbers[i]) for i in part]
                    models = [recordings.Packed.of(sensors.of(id, number)) for number in each]
                    rest = self.seed, self.dead, hasty, second
                    tasks[k].append((models, capture, photons[part], numbers[part], *rest))
            except UNABLE as error:
                tasks[k], out[k] = [], _unable(error)
        self.simulations += sum(len(numbers) for some, (_, _, _, numbers) in zip(tasks, wanted, strict=True) if some)
        results = iter(list(self.parallel(delayed(_task)(*task) for some in tasks for task in some)))
        for k, some in enumerate(tasks):
            made = [next(results) for _ in some]
            wrong = [p for p in made if isinstance(p, str)]
            if some:
                out[k] = wrong[0] if wrong else _joined([p for p in made if isinstance(p, Made)])
        return out

    def closed_form(self, sensor: Sensor, id: str) -> Callable[[float], float]:
        """Level -> detections of the array in a capture; in the dark the level is a factor on the rates."""
        capture = self.seen[id].capture
        return recordings.closed_form(recordings.InTheDark.of(sensor) if capture.light.dark else sensor, capture)

    def matched(self, state: State, sensor: Sensor, id: str) -> float:
        """By how much the light must differ for a sensor to give as many detections as the state's; 1 where none does.

        Statistics are compared at the same total, and must not be extrapolated to another.
        """
        usual, form = state.rates[id], self.closed_form(sensor, id)
        wanted = math.log(usual.expected(usual.level))
        x = 0.0
        # in the dark all rates are scaled, whatever makes them; light saturates, and is no other light for long
        most = _MOST_DARK if self.seen[id].capture.light.dark else _MOST_LIGHT
        for _ in range(6 + round(2 * most)):
            here = math.log(form(usual.level * math.exp(x)))
            if abs(wanted - here) < 1e-7:
                break
            slope = (math.log(form(usual.level * math.exp(x + 0.01))) - here) / 0.01
            if slope < 0.02:
                return 1.0
            x += max(-0.5, min(0.5, (wanted - here) / slope))
        return math.exp(x) if abs(x) < most else 1.0

    def needed(self, state: State, sensor: Sensor, id: str) -> float:
        """Log of how much the light (dark: the rates) must differ for a sensor to give as many detections."""
        ratio = self.matched(state, sensor, id)
        if ratio != 1.0:
            return math.log(ratio)
        usual = state.rates[id]
        here = usual.expected(usual.level)
        slope = math.log(usual.expected(usual.level * 1.01) / here) / math.log(1.01)
        return -math.log(self.closed_form(sensor, id)(usual.level) / here) / max(slope, 0.05)

    def told(self, state: State, sensors: Sensors) -> Moved:
        """What another model changes of the totals, as the closed forms have it; nothing else. Raises SpadError."""
        try:
            return Moved({}, {}, {id: self.needed(state, sensors.usual(id), id) for id in state.rates})
        except SpadError:
            raise
        except UNABLE as error:
            raise SpadError(why(error)) from error

    def _centre(self, sensor: Sensor, seen: Seen) -> tuple[float, float | None, Callable[[float], float], float]:
        capture = seen.capture
        if capture.light.dark:
            sensor, stated = recordings.InTheDark.of(sensor), 1.0
        else:
            stated = twin.photons_at(capture, sensor.layout)  # type: ignore[assignment]
        expected = recordings.closed_form(sensor, capture)
        centre, half = recordings.levels_about(expected, seen.total, stated, capture)
        return centre, stated, expected, half

    def state(
        self,
        values: Values,
        sensors: Sensors | None = None,
        replicates: int | None = None,
        known: State | None = None,
    ) -> State:
        """Learn what the model makes of every capture, and judge the data by it.

        known: the same model, simulated less often: its recordings are the first of these. Raises SpadError where it
        cannot be simulated.
        """
        try:
            return self._state(values, sensors, replicates, known)
        except SpadError:
            raise
        except UNABLE as error:
            raise SpadError(why(error)) from error

    def _state(self, values: Values, sensors: Sensors | None, replicates: int | None, known: State | None) -> State:
        sensors = sensors or Sensors.same(with_values(self.start, values))
        n = replicates or self.replicates
        there = len(known.own[RATES]) if known else 0
        # evenly spread however many they are, and so are the first of them, and every fourth
        spread = 2 * np.modf((np.arange(n) + 0.5) * _GOLDEN)[0] - 1
        numbers = np.arange(there, n, dtype=np.uint64)
        about, wanted = {}, []
        state = State(dict(values), sensors, {}, {}, {}, {}, {}, {}, [])
        for id, seen in self.seen.items():
            if seen.counts is None:
                state.rates[id], state.factors[id] = recordings.of_mean(sensors.usual(id), seen.capture, seen.total, n)
                continue
            centre, stated, expected, half = self._centre(sensors.usual(id), seen)
            factors = np.exp(half * spread)
            about[id] = centre, stated, expected, factors
            wanted.append((sensors, id, centre * factors[there:], numbers))
        results = self.simulate(wanted, pieces=4)
        for (id, (centre, stated, expected, factors)), made in zip(about.items(), results, strict=True):
            if isinstance(made, str):
                raise SpadError(f"{id}: {made}")
            if known:
                made = _joined([known.made[id], made])
            state.made[id] = made
            law, scatter = recordings.law_of(made.totals, np.array([expected(float(centre * f)) for f in factors]))
            state.rates[id] = recordings.CaptureNull(centre, stated, made.totals, expected, law, scatter, {})
            state.factors[id] = factors
            for name, summary in self.seen[id].summaries.items():
                if name not in made.values:
                    continue
                kind, scale = made.laws[name]
                null = learn([Summary(v, kind, str, recordings.no_size, scale) for v in made.values[name]], made.totals)
                cell = id, name
                state.nulls[cell] = null
                judged = null.judge(summary.values, self.seen[id].total)
                if null.law == "exact":
                    if judged.p_value < 0.5:
                        state.exact.append(cell)
                    continue
                state.residuals[cell] = judged.residuals
                state.own[cell] = _own(null, made, made.values[name])
        state.residuals[RATES] = self.rates(state, {id: math.log(max(s.total, 0.5)) for id, s in self.seen.items()})
        draws = np.random.Generator(np.random.Philox(key=self.seed + 1)).standard_normal(n)
        state.own[RATES] = np.stack([self._own_rates(state, k, float(draws[k])) for k in range(n)])
        return state

    # --- the totals ----------------------------------------------------------------------------------------------

    def _stated(self, state: State) -> list[str]:
        return [
            id
            for id in self.seen
            if state.rates[id].stated is not None and self._told(state.rates[id], self.seen[id].total)
        ]

    @staticmethod
    def _told(null: recordings.CaptureNull, total: float) -> bool:
        """Does a total say something? Of fewer than five that are expected, if more are there."""
        stated = float(null.stated or 1.0)
        # by the closed form: the law of recordings takes none for half a detection
        few = null.expected(stated) >= _NEVER and total >= _LEAST_TOTAL
        return few or null.total_at(stated) >= _LEAST_TOTAL

    def rate_space(self, state: State) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray]:
        """(captures, elasticities, inverse root of the covariance of the log levels, the light's part in it)."""
        if state.space is not None:
            return state.space
        ids = self._stated(state)
        errors, elasticity, common = [], [], []
        for id in ids:
            light = self.seen[id].capture.light
            _, _, slope = state.rates[id].level_of(max(self.seen[id].total, 1.0))
            errors.append(self.level_error(state, id))
            elasticity.append(max(slope, 1e-3))
            common.append(0.0 if light.dark else light.relative_uncertainty)
        c = np.array(common)
        covariance = np.diag(np.array(errors) ** 2) + np.outer(c, c)
        root = np.linalg.inv(np.linalg.cholesky(covariance)) if ids else np.zeros((0, 0))
        state.space = ids, np.array(elasticity), root, c
        return state.space

    def level_error(self, state: State, id: str) -> float:
        """Standard deviation of the log of a capture's level (dark: of its rates), its own uncertainty with it."""
        null, light = state.rates[id], self.seen[id].capture.light
        level, error, slope = null.level_of(max(self.seen[id].total, 1.0))
        if light.dark:
            error = max(error, 1 / math.sqrt(null.total_at(1.0)) / max(slope, 1e-3))
        stated = float(null.stated or 1.0)
        z = self._score(state, id, self.seen[id].total, null.total_at(stated))
        if z is not None:
            level, _, _ = null.level_of(max(self.seen[id].total, 0.5))
            apart = abs(math.log(level / stated))
            error = apart / abs(z) if abs(z) > _SOME else max(error, apart / _SOME)
        return max(math.hypot(error, light.own_uncertainty), 1e-6)

    def _score(self, state: State, id: str, total: float, expected: float) -> float | None:
        """Standard deviations between a total and what is expected; None where the log of a level is as good as normal.

        It is not that of few dark counts, nor where the light is faint beside these.
        """
        null = state.rates[id]
        stated = float(null.stated or 1.0)
        if self.seen[id].capture.light.dark:
            wider = max(1.0, null.scatter * math.sqrt(expected)) if expected >= _LEAST_TOTAL else 1.0
            return float(poisson_scores(np.array([round(total)]), np.array([max(expected, 1e-3)]))[0]) / wider
        if null.drowned(total):
            return null.score(total, mean=expected)
        if null.total_at(_FAINT * stated) < 0.5 * null.total_at(stated):
            return None
        scatter = null.scatter * math.sqrt(1 + 2 / len(null.totals))
        return math.log(max(total, 0.5) / expected) / max(scatter, 1e-9)

    def rates(self, state: State, logs: Mapping[str, float]) -> np.ndarray:
        """Residuals of the totals: independent, 1 wide; the light's common factor is among them."""
        ids, _, root, _ = self.rate_space(state)
        return root @ self.levels(state, ids, logs) if ids else np.zeros(0)

    def levels(self, state: State, ids: Sequence[str], logs: Mapping[str, float]) -> np.ndarray:
        """Logs of the levels (dark: of the rates) that give these totals, relative to what is stated."""
        return np.array(
            [
                math.log(state.rates[id].level_of(math.exp(logs[id]))[0] / float(state.rates[id].stated or 1.0))
                for id in ids
            ]
        )

    def _own_rates(self, state: State, k: int, draw: float) -> np.ndarray:
        ids, slopes, root, common = self.rate_space(state)
        x = []
        for id, slope in zip(ids, slopes, strict=True):
            null = state.rates[id]
            usual = null.law[0] + null.law[1] * math.log(null.expected(float(null.level * state.factors[id][k])))
            z = self._score(state, id, float(null.totals[k]), math.exp(usual))
            if z is not None:
                x.append(z * self.level_error(state, id))
                continue
            x.append((math.log(max(null.totals[k], 0.5)) - usual) / slope)
        return root @ (np.array(x) + draw * common) if ids else np.zeros(0)

    # --- other models beside a state ------------------------------------------------------------------------------

    def moved(
        self,
        state: State,
        models: Sequence[Sensors],
        few: int = FEW,
        only: Collection[str] = (),
        hasty: bool = True,
        kept: Kept = "likely",
        only_of: Sequence[Collection[str]] | None = None,
    ) -> list[Moved | str]:
        """What each of these models would change; or, in a word, why it cannot be simulated.

        few: recordings of each capture; only: of these captures, where there are any; hasty: without statistics that
        cost much; kept: of what the recordings show, what is hardly ever chance (a trace), what is hardly all chance
        (a slope, which would be too small without it), or all. only_of: as `only`, of each model by itself.
        """
        numbers = np.arange(few, dtype=np.uint64)
        ids_of = [[id for id in state.made if not some or id in some] for some in only_of or [only] * len(models)]
        wanted, unable = [], dict[int, str]()
        for k, (sensors, ids) in enumerate(zip(models, ids_of, strict=True)):
            own = []
            try:
                for id in ids:
                    level = state.rates[id].level * self.matched(state, sensors.usual(id), id)
                    own.append((sensors, id, level * state.factors[id][numbers.astype(int)], numbers))
            except UNABLE as error:
                unable[k], own = _unable(error), []
            wanted += own
        simulated = self.simulate(wanted, hasty=hasty)
        if kept == "sure":  # a slope is a difference of the same few recordings
            simulated = self._more_of_doubtful(state, wanted, simulated, hasty)
        results = iter(simulated)
        out: list[Moved | str] = []
        for k, (sensors, ids) in enumerate(zip(models, ids_of, strict=True)):
            if k in unable:
                out.append(unable[k])
                continue
            made = {id: next(results) for id in ids}
            wrong = [m for m in made.values() if isinstance(m, str)]
            try:
                out.append(wrong[0] if wrong else self._moved(state, sensors, made, kept))  # type: ignore[arg-type]
            except UNABLE as error:
                out.append(_unable(error))
        return out

    def _more_of_doubtful(
        self,
        state: State,
        wanted: Sequence[tuple[Sensors, str, np.ndarray, np.ndarray]],
        made: list[Made | str],
        hasty: bool,
    ) -> list[Made | str]:
        """Recordings, and more where the totals of a few are others than the closed form has.

        Light that fluctuates gives other totals in every recording, and two of them may go the same way.
        """
        doubtful, again = [], []
        for k, ((sensors, id, _, numbers), one) in enumerate(zip(wanted, made, strict=True)):
            few = len(numbers) < min(_SURELY, len(state.factors[id])) and sensors.typical is None
            if few and isinstance(one, Made) and _shared(self._apart(state, sensors, id, one), state.rates[id].scatter):
                doubtful.append(k)
        for k in doubtful:
            sensors, id, photons, numbers = wanted[k]
            more = np.arange(len(numbers), min(_SURELY, len(state.factors[id])), dtype=np.uint64)
            level = photons[0] / state.factors[id][0]
            again.append((sensors, id, level * state.factors[id][more.astype(int)], more))
        out = list(made)
        for k, more_of in zip(doubtful, self.simulate(again, hasty=hasty) if again else [], strict=True):
            first = out[k]
            out[k] = _joined([first, more_of]) if isinstance(first, Made) and isinstance(more_of, Made) else more_of
        return out

    def _apart(self, state: State, sensors: Sensors, id: str, made: Made) -> np.ndarray:
        """(recordings,) by how much the logs of a capture's totals are larger than by the closed form."""
        base, some = state.made[id], made.numbers.astype(int)
        apart = np.log(np.maximum(made.totals, 0.5)) - np.log(np.maximum(base.totals[some], 0.5))
        if abs(math.log(self.matched(state, sensors.usual(id), id))) < 1e-12:
            apart += self.needed(state, sensors.usual(id), id)  # no other level gave as many
        return np.asarray(apart)

    def _moved(self, state: State, sensors: Sensors, made: dict[str, Made], kept: Kept) -> Moved | str:
        shifts: dict[Cell, np.ndarray] = {}
        noise: dict[Cell, float] = {}
        logs = {}
        nothing, scattered = True, False
        for id in state.rates.keys() - made.keys():  # not simulated: of a capture's total the closed form tells enough
            logs[id] = self.needed(state, sensors.usual(id), id)
        for id, other in made.items():
            base, some = state.made[id], other.numbers.astype(int)
            assert some[-1] == len(some) - 1  # the model's first ones, beside its own first ones
            usual = state.rates[id]
            logs[id] = self.needed(state, sensors.usual(id), id)
            apart = self._apart(state, sensors, id, other)
            scattered = scattered or far_wider(float(np.std(apart)), usual.scatter)
            if sensors.typical is None:
                slope = usual.level_of(math.exp(math.log(usual.expected(usual.level))))[2]
                logs[id] -= _shared(apart, usual.scatter) / max(slope, 0.05)
            for name, values in other.values.items():
                cell = id, name
                if cell not in state.residuals:
                    continue
                if values.shape[1] != len(state.residuals[cell]):
                    return f"{id}: its {name} has other cells than the measurement's"
                null = state.nulls[cell]
                nothing = nothing and np.array_equal(values, base.values[name][some])
                # chips with odd pixels may have many more detections; so far off no expectation was learnt
                learnt = np.clip(other.totals, base.totals.min(), base.totals.max())
                new = values - null.expected_all(learnt)[0]
                old, spread = state.before(cell, len(some))
                shift, left, beta = difference(new, old, spread)
                if kept != "all":
                    # where the recordings have nothing in common, the null's own chance is in the shift, too
                    chance = left + 3.0 * (1 - beta) / null.recordings
                    usual_here, _ = state.usual(cell, float(base.totals.mean()))
                    shift = beyond_noise(shift, spread, chance, null, usual_here, len(other.totals), kept == "sure")
                if shift.any():
                    shifts[cell], noise[cell] = shift, left
        return Moved(shifts, noise, logs, nothing, fluctuates=scattered)

    def both(self, state: State, up: Moved, down: Moved, few: int) -> Moved:
        """`Moved.both` of what so many recordings of a strength and of its opposite show at this state."""
        powers = {
            cell: state.usual(cell, self.seen[cell[0]].total)[0]
            for cell, null in state.nulls.items()
            if null.law == "exponential"
        }
        return Moved.both(up, down, powers, few)

    def residuals(self, state: State, moved: Moved, times: float = 1.0, noisy: bool = False) -> dict[Cell, np.ndarray]:
        """The data's residuals if the shifts were `times` as large. noisy: their scatter adds to that of the cells."""
        out: dict[Cell, np.ndarray] = {}
        moved = moved.at(times)
        for cell in state.residuals:
            if cell == RATES:
                ids, _, root, _ = self.rate_space(state)
                x = np.array([moved.logs.get(i, 0.0) for i in ids])
                out[cell] = state.residuals[cell] + (root @ x if ids else 0.0)
                continue
            null, seen = state.nulls[cell], self.seen[cell[0]]
            values = seen.summaries[cell[1]].values
            if cell not in moved.shifts:
                out[cell] = state.residuals[cell]
                continue
            usual = state.usual(cell, seen.total)
            out[cell] = _judged(null, values, usual, moved.shifts[cell], moved.noise.get(cell, 0.0) * noisy)
        return out

    def gain(self, state: State, moved: Moved, times: float = 1.0) -> float:
        """By how much the squares of the data's residuals fall if the shifts were `times` as large."""
        found = self.residuals(state, moved, times)
        return sum(state.square(cell) - float(z @ z) for cell, z in found.items() if z is not state.residuals[cell])

    def size(self, state: State, moved: Moved) -> float:
        """Standard deviations of what a model would change."""
        return math.sqrt(square(self.template(state, moved)))

    def judged(self, state: State, cell: Cell, shift: np.ndarray) -> np.ndarray:
        """The data's residuals of one block if its expectation were shifted."""
        seen = self.seen[cell[0]]
        usual = state.usual(cell, seen.total)
        return _judged(state.nulls[cell], seen.summaries[cell[1]].values, usual, shift, 0.0)

    def template(self, state: State, moved: Moved) -> dict[Cell, np.ndarray]:
        """The residuals that a model at this state would see in data of the other."""
        out: dict[Cell, np.ndarray] = {}
        moved = moved.at(1.0)
        for cell in state.residuals:
            if cell == RATES:
                ids, _, root, _ = self.rate_space(state)
                out[cell] = -(root @ np.array([moved.logs.get(i, 0.0) for i in ids])) if ids else np.zeros(0)
                continue
            null = state.nulls[cell]
            shift = moved.shifts.get(cell)
            if shift is None:
                out[cell] = np.zeros(len(state.residuals[cell]))
                continue
            expected, _ = state.usual(cell, self.seen[cell[0]].total)
            scale = null.spread_at(expected)
            if null.law == "exponential":
                out[cell] = shift / np.maximum(expected, 1e-9)
            else:
                out[cell] = shift / np.maximum(scale, 0.5 if null.law == "poisson" else 1e-30)
        return out


def far_wider(scatter: float, usual: float) -> bool:
    """Are totals that scatter so much those of light that is another in every recording? usual: without it."""
    return scatter > _FLUCTUATES * usual


def _shared(apart: np.ndarray, scatter: float) -> float:
    """Mean of some logs of totals beside the closed form, 0 where it may be chance. scatter: of the model's own.

    The closed form has no scatter: where the recordings do not contradict it, it serves. Of few that are about as alike
    as the model's own it is a rule of thumb: some that lie close together by chance are believed, for they are near it.
    """
    n, mean = len(apart), float(np.mean(apart))
    own = float(np.std(apart)) if n > 2 else 0.0
    if own > _ALIKE * scatter and (n >= _SURELY or far_wider(own, scatter)):
        likely = float(stats.t.isf(_CHANCE, n - 1)) * own / math.sqrt(n - 1)
    else:  # a few that have gone the same way by chance lie closer together than others would
        likely = float(stats.norm.isf(_CHANCE)) * min(own or math.inf, _ALIKE * scatter) / math.sqrt(n)
    return mean if abs(mean) > likely else 0.0


def _joined(parts: Sequence[Made]) -> Made:
    names = set.intersection(*(set(p.values) for p in parts))
    return Made(
        np.concatenate([p.numbers for p in parts]),
        np.concatenate([p.totals for p in parts]),
        {n: np.concatenate([p.values[n] for p in parts]) for n in parts[0].values if n in names},
        parts[0].laws,
    )


def _own(null: Null, made: Made, values: np.ndarray) -> np.ndarray:
    """(recordings, cells) residuals of the model's own recordings."""
    expected, leverage = null.expected_all(made.totals)
    close = -np.minimum(leverage, 0.9)[:, None]
    z = _standardized(null.law, values, expected, null.spread, close, null.recordings, null.scaled)
    return np.asarray(z / null.factor)


def _spread_of(null: Null, made: Made) -> np.ndarray:
    expected = null.expected(float(made.totals.mean()))[0]
    return np.maximum(null.spread_at(expected), 0.3 if null.law == "poisson" else 1e-30)


def _judged(
    null: Null, values: np.ndarray, usual: tuple[np.ndarray, float], shift: np.ndarray, noise: float
) -> np.ndarray:
    expected, leverage = usual[0] + shift, usual[1]
    if null.law in ("poisson", "exponential"):
        expected = np.maximum(expected, 0.5 / null.recordings)
    if null.law == "exponential":  # detections by chance alone have their power, whatever else there is
        expected = np.maximum(expected, LEAST_POWER * usual[0])
    z = _standardized(null.law, values, expected, null.spread, leverage + noise, null.recordings, null.scaled)
    return np.asarray(z / null.factor)


def square(residuals: Mapping[Cell, np.ndarray]) -> float:
    """Sum of all squared residuals."""
    return sum(float(z @ z) for z in residuals.values())


def likelier(
    state: State, other: State, trace: Mapping[Cell, np.ndarray] | None = None, fluctuates: bool = False
) -> float:
    """By how much twice the log likelihood of another model is larger, each cell judged by that model's own scatter.

    A model whose cells scatter more has smaller squares whatever is true: the logarithm of the scatter counts. trace:
    of the other model (`Bench.template`); of thousands of cells in which it has none, chance alone would decide.
    fluctuates: is what it does another in every recording? Then cells count that scatter more, and the totals.
    """
    out = 0.0
    for cell in other.residuals.keys() & state.residuals.keys():
        z, there = state.residuals[cell], other.residuals[cell]
        if cell == RATES and fluctuates:
            out += float(z @ z - there @ there) + 2 * (_narrowness(other) - _narrowness(state))
            continue
        seen = trace is None or float(trace[cell] @ trace[cell]) > _SEEN
        if not (seen or fluctuates):
            continue
        if cell not in other.nulls or cell not in state.nulls:
            out += float(z @ z - there @ there)
            continue
        null, new = state.nulls[cell], other.nulls[cell]
        if null.law == "exponential":  # a power scatters as its mean does
            powers, relative = powers_of(z * null.factor), powers_of(there * new.factor)
            fall, wider = 2 * (powers - relative), np.log(powers / relative)
        else:
            fall, wider = z**2 - there**2, np.log(new.breadth / null.breadth)
        # a cell that never moved has no scatter to compare with
        gain = fall - 2 * np.broadcast_to(np.clip(wider, -_WIDEST, _WIDEST), z.shape)
        if fluctuates and trace is not None:
            gain = gain[(seen & (trace[cell] != 0)) | np.broadcast_to(wider > _WIDER, z.shape)]
        out += float(np.sum(gain))
    return out


def _narrowness(state: State) -> float:
    """Log of how narrow the totals' law is."""
    return float(np.linalg.slogdet(state.space[2])[1]) if state.space is not None else 0.0


def stacked(blocks: Mapping[Cell, np.ndarray], keys: Sequence[Cell]) -> np.ndarray:
    """All cells in one line."""
    return np.concatenate([blocks[k] for k in keys]) if keys else np.zeros(0)
