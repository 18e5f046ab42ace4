"""What a model makes of a capture: its recordings, simulated many times, and what is learnt from them.

Every recording is made at a light level that gives about as many detections as were measured: whether that level is
as stated is one question, whether what the capture contains is as the model has it, another.
"""

from __future__ import annotations

import functools
import math
import pickle
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace

import numpy as np
from joblib import Parallel, delayed
from scipy import stats

from .. import plugins, twin
from ..effects import Conditions
from ..heap import keep_freed_memory
from ..recording import Capture, Recording
from ..sensor import Sensor
from ..statistics import Statistic, Summary
from ..streams import Streams
from . import memory
from .candidates import Key, with_values
from .nulls import Null, learn, poisson_scores

REPLICATES = 96
SPREAD = 3.0  # the light of the model's recordings varies by so many standard deviations of its uncertainty
LEAST_SPREAD = 0.01
_MUCH, _MOST_CHANCE = 0.05, 0.7  # of a logarithm, by which a level may seem another by chance
_EVENTS_AT_ONCE = 4_000_000
_DROWNED = 0.5  # of the elasticity at the stated level: where it is less, the light hardly shows
_CLOSED = 5e-4  # relative error of the closed forms, at most


def statistics_for(capture: Capture) -> list[Statistic]:
    """Every registered statistic that makes sense for a capture: of its modality, and of its light."""
    kinds = [Statistic.registry.find(name) for name in Statistic.registry]
    scene = capture.light.scene is not None
    return [kind() for kind in kinds if capture.modality in kind.modalities and not (kind.flat and scene)]


def simulated(
    sensor: Sensor, capture: Capture, photons: np.ndarray, numbers: np.ndarray, seed: int
) -> Iterator[Recording]:
    """The capture as the model makes it, once for each of `numbers`, with so many photons/s (n,) on each pixel.

    In the ticks of the measurement's file, whatever the sensor's own are, for all counting is in these. Yielded one by
    one; only a few of them are in memory together.
    """
    expected, _ = sensor.expected(np.full((1, sensor.layout.pixels), float(photons.max())), capture.conditions)
    step = max(1, int(_EVENTS_AT_ONCE / (float(expected.sum()) + sensor.layout.pixels)))
    for start in range(0, len(numbers), step):
        some = slice(start, start + step)
        streams = Streams(seed, f"capture/{capture.id}", "model", numbers[some])
        for one in twin.model_recordings(sensor, capture, photons[some], streams, numbers[some], direct=True):
            yield one if capture.tick is None else one.on_ticks(capture.tick)


def whatever_phases(
    sensor: Sensor, capture: Capture, photons: np.ndarray, numbers: np.ndarray, seed: int
) -> Iterator[Recording]:
    """As `simulated`; what swings begins somewhere else in every recording, for nobody knows where it was."""
    keys = swinging(sensor)
    if not keys:
        yield from simulated(sensor, capture, photons, numbers, seed)
        return
    for k, number in enumerate(numbers):
        rng = np.random.Generator(np.random.Philox(key=[seed, int(number)]))
        turned = with_values(sensor, {key: 2 * math.pi * rng.random() for key in keys})
        turned = InTheDark.of(turned) if isinstance(sensor, InTheDark) else turned
        yield from simulated(turned, capture, photons[k : k + 1], numbers[k : k + 1], seed)


def swinging(sensor: Sensor) -> list[Key]:
    """Parameters that are phases."""
    return [(e.name, name) for e in sensor.effects for name, p in e.parameters.items() if p.phase]


def still(sensor: Sensor) -> Sensor:
    """The sensor without what swings, as it is in the mean over all phases."""
    names = {name for name, _ in swinging(sensor)}
    if not names:
        return sensor
    rest = [effect for effect in sensor.effects if effect.name not in names]
    return sensor.changed(effects=rest)


class InTheDark(Sensor):
    """A sensor without light whose dark rates are all scaled by what would be the photons/s.

    So a dark capture, too, can be simulated with as many detections as were measured: whether their number is right is
    one question, whether their pattern is, another.
    """

    @staticmethod
    def of(sensor: Sensor) -> Sensor:
        """The same sensor, in the dark."""
        own = {f.name: getattr(sensor, f.name) for f in fields(sensor)}
        return InTheDark(**own | {"chip": None if sensor.chip is None else InTheDark.of(sensor.chip)})

    def rates(self, photons: np.ndarray, conditions: Conditions) -> tuple[np.ndarray, np.ndarray]:
        """The dark rates times the factors that stand for photons."""
        rate, light = super().rates(np.zeros_like(photons), conditions)
        return rate * photons, light * photons


@dataclass(frozen=True)
class CaptureNull:
    """What the model makes of a capture: the null of each statistic, and how the total follows the light.

    level: photons/s on a pixel, in the dark a factor on the rates, about which the recordings were made; stated:
    what the measurement says; totals: (recordings,) the detections of each.
    apart: of statistics with nested cells, the nulls of what is new in each (`Summary.apart`), for the misfit.
    law: log of the total as (offset, slope) of the log of what the closed form `expected` says; scatter: about that.
    """

    level: float
    stated: float | None
    totals: np.ndarray
    expected: Callable[[float], float]
    law: tuple[float, float]
    scatter: float
    nulls: Mapping[str, Null]
    apart: Mapping[str, Null] = field(default_factory=dict)

    def total_at(self, level: float) -> float:
        """Detections of the whole array expected at a level."""
        return math.exp(self.law[0] + self.law[1] * math.log(self.expected(level)))

    def level_of(self, total: float) -> tuple[float, float, float]:
        """(level that gives this total, standard error of its log, elasticity of the total there)."""
        low, high = self.level * 1e-6, self.level * 1e6
        for _ in range(200):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if self.total_at(middle) < total else (low, middle)
        found = math.sqrt(low * high)
        elasticity = self.elasticity_at(found)
        return found, self._scatter / max(elasticity, 1e-3), elasticity

    def elasticity_at(self, level: float) -> float:
        """By how many per cent the total rises where the level rises by one."""
        step = 1.01
        return math.log(self.total_at(level * step) / self.total_at(level / step)) / (2 * math.log(step))

    @property
    def _scatter(self) -> float:
        return self.scatter * math.sqrt(1 + 2 / len(self.totals))

    def drowned(self, total: float) -> bool:
        """Is the total so small that the light would hardly show in it, though it would at the level that is stated?

        Then the level that gives as many says nothing: `score` does.
        """
        if self.stated is None or total >= self.total_at(self.stated):
            return False
        _, _, elasticity = self.level_of(max(total, 0.5))
        return elasticity < _DROWNED * self.elasticity_at(self.stated)

    def score(self, total: float, uncertainty: float = 0.0, mean: float | None = None) -> float:
        """Standard deviations between a total and the stated level's: few detections are not normal.

        uncertainty: relative, of that level. mean: what is expected in place of that level's.
        """
        assert self.stated is not None
        mean = self.total_at(self.stated) if mean is None else mean
        level = uncertainty * self.elasticity_at(self.stated) if uncertainty else 0.0
        wider = max(1.0, math.hypot(self._scatter, level) * math.sqrt(max(mean, 1.0)))
        return float(poisson_scores(np.array([total]), np.array([max(mean, 1e-3)]))[0]) / wider


def law_of(totals: np.ndarray, told: np.ndarray) -> tuple[tuple[float, float], float]:
    """((offset, slope), scatter) of log totals against the closed form's; the slope is near 1, by 2 % or so."""
    x, y = np.log(told), np.log(np.maximum(totals, 0.5))
    apart = x - x.mean()
    beside = y - y.mean() - apart
    noise = float(np.var(beside, ddof=1)) / 0.02**2
    slope = 1 + float(apart @ beside) / (float(apart @ apart) + max(noise, 1e-12))
    offset = float(y.mean() - slope * x.mean())
    return (offset, slope), float(np.std(y - offset - slope * x, ddof=2))


@dataclass(frozen=True)
class Packed:
    """A sensor on its way to a worker, which must have run the user's plug-in files before it can unpack it."""

    files: tuple[str, ...]
    packed: bytes

    @staticmethod
    def of(sensor: Sensor) -> Packed:
        """A sensor, packed."""
        return Packed(tuple(str(path) for path in plugins.loaded_files()), pickle.dumps(sensor))

    @property
    def sensor(self) -> Sensor:
        """The sensor, unpacked."""
        for file in self.files:
            plugins.load_file(file)
        return _unpacked(self.packed)


@functools.lru_cache(maxsize=2)
def _unpacked(packed: bytes) -> Sensor:
    """What this program has packed itself, a moment ago."""
    sensor = pickle.loads(packed)
    assert isinstance(sensor, Sensor)
    return sensor


def _recordings_of(
    model: Packed, capture: Capture, photons: np.ndarray, numbers: np.ndarray, seed: int
) -> tuple[list[int], dict[str, list[Summary]]]:
    """(totals, summaries by statistic) of some of the model's recordings: the task of a worker."""
    keep_freed_memory()
    sensor = model.sensor
    totals: list[int] = []
    found: dict[str, list[Summary]] = {}
    known = statistics_for(capture)
    for recording in whatever_phases(sensor, capture, photons, numbers, seed):
        totals.append(int(recording.totals.sum()))
        for statistic in known:
            summary = reduced(statistic, recording)
            if summary is not None:
                # words and functions stay behind: numbers travel between processes
                bare = Summary(summary.values, summary.law, str, no_size, summary.scale, nested=summary.nested)
                found.setdefault(statistic.name, []).append(bare)
    return totals, found


def no_size(cell: int, measured: float, expected: float) -> tuple[str, float]:
    """Of a summary of which nobody asks for words."""
    return "", 0.0


def reduced(statistic: Statistic, recording: Recording) -> Summary | None:
    """A statistic's summary; an error of a user's own statistic is told with its file and line."""
    try:
        return statistic.reduce(recording)
    except Exception as error:
        if type(statistic).__module__.startswith(f"{__package__.partition('.')[0]}."):
            raise
        raise plugins.blame(statistic, error) from error


def levels_about(
    expected: Callable[[float], float], total: float, stated: float | None, capture: Capture
) -> tuple[float, float]:
    """(level about which a capture is simulated, how far to both sides, of its logarithm).

    expected: level -> detections; total: of the measurement.
    It lies inside, or beside by no more than chance where detections are many.
    """
    centre = level_for(expected, total, stated)
    half = max(LEAST_SPREAD, SPREAD * math.hypot(capture.light.relative_uncertainty, capture.light.own_uncertainty))
    if stated is not None:
        chance = min(4 / math.sqrt(max(expected(stated), 1.0)), _MOST_CHANCE)
        if total == 0 or abs(math.log(centre / stated)) < half + chance:
            # the same recordings then serve every measurement of this model. Where detections are many, their own
            # scatter reaches as far as the data
            return stated, half + chance if chance > _MUCH else half
    return centre, half


def model_of(
    sensor: Sensor,
    capture: Capture,
    total: float,
    seed: int,
    replicates: int,
    parallel: Parallel,
    told: Callable[[int], None],
) -> CaptureNull:
    """Simulate a capture many times and learn its nulls. total: detections measured, to find a level that is free."""
    if capture.mean is not None:
        told(replicates)
        return of_mean(sensor, capture, total, replicates)[0]
    if capture.light.dark:
        sensor = InTheDark.of(sensor)
        stated: float | None = 1.0
    else:
        stated = twin.photons_at(capture, sensor.layout)
    usual = still(sensor)
    expected = closed_form(InTheDark.of(usual) if capture.light.dark else usual, capture)
    centre, half = levels_about(expected, total, stated, capture)
    entry = memory.name_of(sensor, capture, centre, half, seed, replicates) if centre == stated else ""
    known = memory.recall(entry) if entry else None
    if known is not None:
        told(replicates)
        (offset, slope, scatter), array = known[0]["law"], known[0]["totals"]
        return CaptureNull(centre, stated, array, expected, (float(offset), float(slope)), float(scatter), *known[1:])
    numbers = np.arange(replicates, dtype=np.uint64)
    # evenly spread, in an order that has nothing to do with the number
    order = np.random.Generator(np.random.SFC64(replicates)).permutation(replicates)
    factors = np.exp(half * np.linspace(-1, 1, replicates)[order])
    tasks = np.array_split(numbers, max(1, min(replicates // 4, 24))) if sensor.block == 1 else [numbers]
    packed = Packed.of(sensor)
    results = parallel(
        delayed(_recordings_of)(packed, capture, centre * factors[part.astype(int)], part, seed) for part in tasks
    )
    totals: list[int] = []
    found: dict[str, list[Summary]] = {}
    for part_totals, part_found in results:
        totals += part_totals
        for name, summaries in part_found.items():
            found.setdefault(name, []).extend(summaries)
        told(len(part_totals))
    array = np.array(totals, float)
    whole = {name: summaries for name, summaries in found.items() if len(summaries) == replicates}
    nulls = {name: learn(summaries, array) for name, summaries in whole.items()}
    nested = {
        name: [s.apart() for s in summaries] for name, summaries in whole.items() if summaries[0].nested is not None
    }
    apart = {name: learn(summaries, array) for name, summaries in nested.items()}
    law, scatter = law_of(array, np.array([expected(float(centre * f)) for f in factors]))
    if entry:
        memory.keep(entry, {"law": np.array([*law, scatter]), "totals": array}, nulls, apart)
    return CaptureNull(centre, stated, array, expected, law, scatter, nulls, apart)


def of_mean(sensor: Sensor, capture: Capture, total: float, replicates: int) -> tuple[CaptureNull, np.ndarray]:
    """(what the model makes of a capture whose mean alone is known, (replicates,) factors on its level).

    By the effects' closed forms, without a simulation: as uncertain as chance, the last digit of the mean and the
    closed forms make it.
    """
    dark = capture.light.dark
    stated = 1.0 if dark else twin.photons_at(capture, sensor.layout)
    expected = closed_form(InTheDark.of(sensor) if dark else sensor, capture)
    level = stated if stated is not None else level_for(expected, total, None)
    mean = max(expected(level), 1e-9)
    share = 1.0 if capture.counts_events else 1 - min(mean / sensor.layout.pixels / capture.conditions.frames, 1.0)
    digits, usual = total / sensor.layout.pixels, mean / sensor.layout.pixels
    rounding = _last_digit(digits) / math.sqrt(12) / max(digits, usual)
    scatter = math.sqrt(share / mean + rounding**2 + _CLOSED**2)
    normal = stats.norm.ppf((np.arange(replicates) + 0.5) / replicates)
    order = np.random.Generator(np.random.SFC64(replicates)).permutation(replicates)
    totals = mean * np.exp(scatter * normal[order])
    return CaptureNull(level, stated, totals, expected, (0.0, 1.0), scatter, {}), np.ones(replicates)


def _last_digit(value: float) -> float:
    """The step in which a number as written can change: 0.1 of 2.6, 1 of 470."""
    text = f"{value:.10g}"
    return 10.0 ** -len(text.partition(".")[2]) if "." in text else 1.0


def closed_form(sensor: Sensor, capture: Capture) -> Callable[[float], float]:
    """Level -> detections of the whole array, as the effects' closed forms have it."""
    conditions = capture.conditions

    @functools.lru_cache(maxsize=4096)
    def detections(level: float) -> float:
        light = np.full((1, sensor.layout.pixels), level)
        if capture.counts_events:
            return max(float(sensor.expected(light, conditions)[1].sum()), 1e-9)
        return max(float(conditions.frames * in_frames(sensor, light, conditions).sum()), 1e-9)

    return detections


def in_frames(sensor: Sensor, light: np.ndarray, conditions: Conditions) -> np.ndarray:
    """(images, pixels) share of frames with a detection; light: photons/s, of that shape."""
    # as if there were no gaps between frames: nothing is recorded in them
    live = replace(conditions, frame_period=conditions.frame_time, exposure=conditions.frames * conditions.frame_time)
    candidates, _ = sensor.expected(light, live)
    return np.asarray(-np.expm1(-candidates / conditions.frames))


def level_for(expected: Callable[[float], float], total: float, stated: float | None) -> float:
    """The level at which so many detections are expected; the stated one where none does."""
    low, high = 1e-6, 1e12
    for _ in range(100):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if expected(middle) < total else (low, middle)
    found = math.sqrt(low * high)
    return found if 1e-5 < found < 1e11 else stated or 1.0
