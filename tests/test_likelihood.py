"""Likelihood: numbers and intervals against truth, over many data sets; what it does not know; the laws themselves."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import integrate, stats

from spadmnist import config, plugins
from spadmnist.effects import Conditions, Effect, ShortGate
from spadmnist.inference.candidates import Candidate, candidates, with_values
from spadmnist.inference.coordinates import Key
from spadmnist.inference.exact_likelihood import (
    Likelihood,
    MaximumLikelihood,
    NoLikelihood,
    likelihood_ratios,
    maximise,
    not_in_likelihood,
)
from spadmnist.inference.point_process import FOLLOWS, LAST, followed_gaps, hazards_of, likelihood_of_rates
from spadmnist.inference.profile_likelihood import crossing, maximum
from spadmnist.light import photons_from_irradiance
from spadmnist.recording import Capture, Light, Recording
from spadmnist.sensor import Sensor
from spadmnist.streams import Streams
from spadmnist.twin import model_recordings

SENSOR = """sensor:
  name: small
  rules: device
  layout: {rows: 4, columns: 4, pixel_area: 25 um^2, fill_factor: 1.0}
  effects:
    detection: {pdp: 0.42}
    dark_counts: {rate: 100 Hz}
    dead_time: {duration: 50 ns}
    afterpulsing: {probability: 0.5 %, lifetime: 25 ns}
    tdc: {resolution: 500 ps}
"""
DEAD, CHANCE, LIFETIME = ("dead_time", "duration"), ("afterpulsing", "probability"), ("afterpulsing", "lifetime")
RATE = ("dark_counts", "rate")
TRUTH = {DEAD: 60e-9, CHANCE: 0.02}
SETS = 100
# an interval of 95 % misses 5 of 100; more than 11, or fewer than 0, is chance once in 230 times
MOST = int(stats.binom.isf(0.005, SETS, 0.05))


@pytest.fixture
def sensor(tmp_path: Path) -> Sensor:
    file = tmp_path / "sensor.yaml"
    file.write_text(SENSOR)
    return config.read_sensor(file).resolved()


def lit(sensor: Sensor, modality: str, photons: float, conditions: Conditions, uncertainty: float = 0.0) -> Capture:
    """A capture that states so many photons/s on a pixel; 0: dark."""
    if not photons:
        return Capture("dark", modality, Light(), conditions)
    level = photons / photons_from_irradiance(1.0, sensor.layout.active_area, 500e-9)
    return Capture("lit", modality, Light(500e-9, level, "irradiance", uncertainty), conditions)


def stamps(sensor: Sensor, exposure: float, photons: float, sets: int) -> list[Recording]:
    wave = 500e-9 if photons else None
    capture = lit(sensor, "tr", photons, Conditions(exposure, 1, exposure, exposure, wave))
    images = np.arange(sets, dtype=np.uint64)
    return model_recordings(sensor, capture, np.full(sets, photons), Streams(11, "likelihood", "data", images), images)


def bits(sensor: Sensor, frames: int, photons: Sequence[float], stated: float) -> list[Recording]:
    """Data sets under light that is not quite as stated."""
    wave = 500e-9 if stated else None
    capture = lit(sensor, "qis", stated, Conditions(frames * 1e-5, frames, 1e-5, 1e-5, wave), 0.02)
    images = np.arange(len(photons), dtype=np.uint64)
    streams = Streams(12, f"likelihood/{stated}", "data", images)
    return model_recordings(sensor, capture, np.array(photons), streams, images)


def named(sensor: Sensor, *names: str) -> list[Candidate]:
    return [next(c for c in candidates(sensor) if c.name == name) for name in names]


def found(sensor: Sensor, data: Sequence[Recording], *names: str) -> MaximumLikelihood:
    exact = maximise(sensor, data, named(sensor, *names))
    assert isinstance(exact, MaximumLikelihood), exact
    return exact


def check(answers: Sequence[MaximumLikelihood], key: Key, truth: float, coverage: bool = True) -> None:
    """Values scatter about the truth as their intervals say, and the intervals miss it as often as they should."""
    values = np.array([a.values[key] for a in answers])
    ends = np.array([a.intervals[key] for a in answers])
    assert np.all((ends[:, 0] <= values) & (values <= ends[:, 1]))
    error = np.diff(ends, axis=1).mean() / 3.92
    assert abs(values.mean() - truth) < 3.5 * error / math.sqrt(len(values))
    assert error / 1.35 < values.std() < 1.35 * error
    missed = int(np.sum((truth < ends[:, 0]) | (truth > ends[:, 1])))
    assert missed <= MOST, f"{missed} of {len(values)} intervals miss the {key}"


@pytest.mark.slow
def test_dead_time_and_afterpulsing_are_covered(sensor: Sensor) -> None:
    hidden = with_values(sensor, TRUTH)
    # no two pixels need be alike: each has a rate of its own
    map_ = {("detection", "relative"): np.linspace(0.6, 1.4, 16)}
    data = stamps(with_values(hidden, map_), 3e-4, 2e6, SETS)
    assert 3000 < np.mean([r.totals.sum() for r in data]) < 5000
    answers = [found(sensor, [one], "set dead_time.duration", "set afterpulsing.probability") for one in data]
    for key, truth in TRUTH.items():
        check(answers, key, truth)


def test_many_pixels_with_few_events_each_do_not_hide_afterpulses(tmp_path: Path) -> None:
    """A rate for each of 4,096 pixels, maximized, would be 6 standard errors of the probability. False alarms: 1e-6."""
    text = SENSOR.replace("rows: 4, columns: 4", "rows: 64, columns: 64").replace("rate: 100 Hz", "rate: 20 kHz")
    text = text.replace("afterpulsing: {probability: 0.5 %, lifetime: 25 ns}", "slow_afterpulsing: {lifetime: 20 us}")
    (tmp_path / "sensor.yaml").write_text(text)
    slow = config.read_sensor(tmp_path / "sensor.yaml").resolved()
    key = ("slow_afterpulsing", "probability")
    hidden = with_values(slow, {key: 0.02})
    capture = Capture("dark", "tr", Light(), Conditions(4e-3, 1, 4e-3, 4e-3, None))
    one = np.zeros(1, np.uint64)
    (data,) = model_recordings(hidden, capture, np.zeros(1), Streams(11, "pixels", "data", one), one)
    (wanted,) = named(slow, "set slow_afterpulsing.probability")
    exact = maximise(slow, [data], [replace(wanted, shapes=())])
    low, high = exact.intervals[key]
    assert abs(exact.values[key] - 0.02) < 4.9 * (high - low) / 3.92


def test_pixels_with_few_events_each_have_no_likelihood_of_their_own_rates(sensor: Sensor) -> None:
    """Of two events in a pixel, what a trap has caused depends on how the rates of the pixels are distributed."""
    (data,) = stamps(with_values(sensor, {RATE: 1000.0, CHANCE: 0.02}), 2e-3, 0.0, 1)
    with pytest.raises(NoLikelihood, match="pixels with few time stamps each"):
        maximise(sensor, [data], [replace(*named(sensor, "set afterpulsing.probability"), shapes=())])


def test_what_another_change_can_take_up_is_no_evidence(sensor: Sensor) -> None:
    """The likelihood ratio of an absent effect, fitted together with a parameter that correlates with it."""
    truth = with_values(sensor, {CHANCE: 0.02, LIFETIME: 400e-9, RATE: 5000.0})
    model = with_values(truth, {CHANCE: 0.01})
    listed = replace(*named(model, "set afterpulsing.probability"), shapes=())
    added = named(model, "add slow_afterpulsing")
    for data in stamps(truth, 0.64, 0.0, 3):
        both = maximise(model, [data], [listed, *added])
        alone = maximise(model, [data], [listed])
        ratios = likelihood_ratios(model, [data], [listed, *added], both)
        assert ratios[1] == pytest.approx(2 * (both.value - alone.value), abs=0.3)


@pytest.mark.slow
def test_a_rate_is_covered_with_its_light(sensor: Sensor) -> None:
    truth = 3000.0
    hidden = with_values(sensor, {RATE: truth, CHANCE: 0.0})
    model = with_values(sensor, {CHANCE: 0.0})
    light = 2e4 * np.exp(0.02 * np.random.default_rng(3).standard_normal(SETS))
    pairs = zip(bits(hidden, 300, np.zeros(SETS), 0.0), bits(hidden, 300, light, 2e4), strict=True)
    answers = [found(model, pair, "set dark_counts.rate") for pair in pairs]
    check(answers, RATE, truth)
    # bright light informs dark counts only if it is known how bright it is
    width = np.mean([math.log(a.intervals[RATE][1] / a.intervals[RATE][0]) for a in answers]) / 3.92
    seen = 16 * 300 * -math.expm1(-truth * 1e-5)
    assert width == pytest.approx(1 / math.sqrt(seen), rel=0.15)


def test_an_effect_that_is_missing_is_added(sensor: Sensor) -> None:
    """With its lifetime."""
    rest = [e for e in sensor.effects if e.name not in CHANCE]
    without = Sensor(sensor.layout, rest, sensor.rules, sensor.chip_seed, sensor.name)
    hidden = with_values(without, {CHANCE: 0.05, LIFETIME: 60e-9})
    data = stamps(hidden, 5e-3, 1e6, 1)
    exact = found(without, data, "add afterpulsing")
    for key, truth in ((CHANCE, 0.05), (LIFETIME, 60e-9)):
        low, high = exact.intervals[key]
        assert low < truth < high < 1.5 * low
    assert likelihood_ratios(without, data, named(without, "add afterpulsing"), exact)[0] > 100


DEEP_LEVEL = """import numpy as np

from spadmnist import Effect, parameter
from spadmnist.events import Children


class DeepLevel(Effect, stage="correlated"):
    "A carrier that is released later fires its pixel again."

    share = parameter(0.0, "", "chance", bounds=(0, 1), off=0.0, search=(1e-4, 0.5))
    age = parameter(60e-9, "s", "mean time", bounds=(0, None), search=(1e-9, 1e-6))

    def spawn(self, events, rng):
        parent = np.flatnonzero(rng.random(len(events)) < self.share)
        return Children(parent, rng.exponential(self.age, len(parent)))

    def hazard(self, pixels):
        return np.full(pixels, -np.log1p(-self.share)), self.age
"""


def test_a_users_effect_that_says_its_hazard_has_a_likelihood(sensor: Sensor, tmp_path: Path) -> None:
    (tmp_path / "deep_level.py").write_text(DEEP_LEVEL)
    plugins.load_file(tmp_path / "deep_level.py")
    rest = [e for e in sensor.effects if e.name not in CHANCE]
    without = Sensor(sensor.layout, rest, sensor.rules, sensor.chip_seed, sensor.name)
    share, age = ("deep_level", "share"), ("deep_level", "age")
    data = stamps(with_values(without, {share: 0.05, age: 60e-9}), 5e-3, 1e6, 1)
    exact = found(without, data, "add deep_level")
    for key, truth in ((share, 0.05), (age, 60e-9)):
        low, high = exact.intervals[key]
        assert low < truth < high < 1.5 * low
    # one number stands for every pixel; a map of them is no matter
    (tmp_path / "level.py").write_text(DEEP_LEVEL.replace("DeepLevel", "Level").replace("np.full(pixels, ", "("))
    plugins.load_file(tmp_path / "level.py")
    mapped = with_values(sensor, {CHANCE: np.linspace(0.0, 0.1, 16)})
    for model, name in ((with_values(without, {("level", "share"): 0.05}), "level"), (mapped, CHANCE[0])):
        left = hazards_of(model, 16)[name][0]
        assert left.shape == (16,) and not not_in_likelihood(model, data[0].capture)
    # a subclass whose events come otherwise does not inherit the hazard
    known = Effect.registry.find("deep_level")
    other = type("ShallowLevel", (known,), {"spawn": lambda self, events, rng: None, "__doc__": "Another one."})
    assert known(share=0.1).hazard(1) is not None and other(share=0.1).hazard(1) is None  # type: ignore[attr-defined]
    assert not other(share=0.1).in_likelihood(True, data[0].capture.conditions, "device")  # type: ignore[attr-defined]


def test_traps_that_outlive_the_next_detection(sensor: Sensor) -> None:
    rest = [e for e in sensor.effects if e.name not in CHANCE]
    without = Sensor(sensor.layout, rest, sensor.rules, sensor.chip_seed, sensor.name)
    keys = ("slow_afterpulsing", "probability"), ("slow_afterpulsing", "lifetime")
    hidden = with_values(without, {keys[0]: 0.1, keys[1]: 3e-6})
    exact = found(without, stamps(hidden, 1e-2, 4e5, 1), "add slow_afterpulsing")
    for key, truth in zip(keys, (0.1, 3e-6), strict=True):
        low, high = exact.intervals[key]
        assert low < truth < high < 1.7 * low


def test_an_edge_that_jitter_blurs(sensor: Sensor) -> None:
    jitter = ("jitter", "sigma")
    hidden = with_values(sensor, {jitter: 400e-12, DEAD: 52e-9})
    model = with_values(sensor, {jitter: 300e-12})
    exact = found(model, stamps(hidden, 4e-3, 4e6, 1), "set dead_time.duration", "set jitter.sigma")
    for key, truth in ((DEAD, 52e-9), (jitter, 400e-12)):
        low, high = exact.intervals[key]
        assert low < truth < high
        assert high - low < 400e-12


def test_nothing_is_told_where_nothing_happened(sensor: Sensor) -> None:
    """An interval ends where there is no effect, and where the number is no longer looked for."""
    (empty,) = stamps(sensor, 1e-6, 0.0, 1)
    exact = found(sensor, [empty], "set afterpulsing.probability")
    assert exact.intervals[CHANCE] == pytest.approx((0.0, 0.2))


def counted(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Where the likelihood is asked for from now on."""
    asked: list[np.ndarray] = []
    value = Likelihood.__call__

    def call(self: Likelihood, u: np.ndarray) -> float:
        asked.append(u)
        return value(self, u)

    monkeypatch.setattr(Likelihood, "__call__", call)
    return asked


@pytest.mark.parametrize("off", [0.5, 2.0, 40.0])
def test_a_start_saves_time_and_changes_nothing(sensor: Sensor, monkeypatch: pytest.MonkeyPatch, off: float) -> None:
    """Even where it is none."""
    rest = [e for e in sensor.effects if e.name not in CHANCE]
    without = Sensor(sensor.layout, rest, sensor.rules, sensor.chip_seed, sensor.name)
    hidden = with_values(without, {CHANCE: 0.05, LIFETIME: 60e-9, DEAD: 52e-9})
    data = stamps(hidden, 5e-3, 1e6, 1)
    candidates = named(without, "add afterpulsing", "set dead_time.duration")
    asked = counted(monkeypatch)
    exact = maximise(without, data, candidates)
    assert isinstance(exact, MaximumLikelihood)
    alone = len(asked)
    coordinates = {d.key: d for candidate in candidates for d in candidate.coordinates}
    ends = {key: [coordinates[key].coordinate(x) for x in interval] for key, interval in exact.intervals.items()}
    errors = {key: (high - low) / 3.92 for key, (low, high) in ends.items()}
    start = {key: d.value(d.coordinate(exact.values[key]) - off * errors[key]) for key, d in coordinates.items()}
    again = maximise(without, data, candidates, start=start, errors=errors)
    assert isinstance(again, MaximumLikelihood)
    assert len(asked) - alone < (0.7 if off < 10 else 2.0) * alone
    for key, d in coordinates.items():
        assert abs(d.coordinate(again.values[key]) - d.coordinate(exact.values[key])) < 0.2 * errors[key]
        assert [d.coordinate(x) for x in again.intervals[key]] == pytest.approx(ends[key], abs=0.05 * errors[key])


def test_a_number_that_nothing_follows_is_left_alone(sensor: Sensor) -> None:
    """A tail without weight."""
    bounds = np.array([[-5.0, -5.0], [5.0, 5.0]])
    top = maximum(lambda u: -(u[0] ** 2), np.array([1.0, 1.0]), np.ones(2), bounds)
    assert top is not None
    assert top.informed.tolist() == [True, False]
    assert top.u == pytest.approx([0.0, 1.0], abs=1e-6)
    model = with_values(sensor, {("jitter", "sigma"): 300e-12})
    hidden = with_values(model, {DEAD: 52e-9})
    data = stamps(hidden, 4e-3, 4e6, 1)
    alone = found(model, data, "set dead_time.duration")
    both = found(model, data, "set dead_time.duration", "set jitter.tail")
    (coordinate,) = named(model, "set jitter.tail")[0].coordinates
    assert both.intervals[coordinate.key] == pytest.approx((coordinate.low, coordinate.high))
    assert both.intervals[DEAD] == pytest.approx(alone.intervals[DEAD], rel=1e-5)


@pytest.mark.parametrize("first", [1e-4, 1.0, 30.0])
@pytest.mark.parametrize(
    ("fallen", "where"),
    [
        (lambda x: x**2, math.sqrt(2)),
        (lambda x: (x - 1) ** 2 - 1, 1 + math.sqrt(3)),  # it rises first
        (lambda x: 0.1 * x + 1e6 * (x > 0.7), 0.7),  # it jumps
        (lambda x: 1e-3 * x, 50.0),  # it never comes to it
        (lambda x: 0.0, 50.0),
    ],
)
def test_where_a_fall_comes_to_so_much(fallen: Callable[[float], float], where: float, first: float) -> None:
    asked = []

    def of(x: float) -> float:
        asked.append(x)
        return fallen(x)

    assert crossing(of, 2.0, first, 50.0, 0.01)[2] == pytest.approx(where, rel=0.02)
    assert len(asked) < 25


@pytest.mark.parametrize("history", [[1e-6], [1e-6, 1.07e-6], [1e-6, 1.07e-6, 1.6e-6]])
def test_the_chances_of_what_follows_add_up(history: list[float]) -> None:
    """The next detection comes at some time, or not before the end."""
    dead, chance, lifetime, rate = np.array([50e-9]), np.array([[0.3]]), np.array([80e-9]), np.array([3e5])

    def density(end: float, *later: float) -> float:
        times = np.array([*history, *later])
        # every gap is followed: those between, then the one to the end; none comes before the first
        gaps, kinds = np.diff([*times, end]), np.array([*[FOLLOWS] * (len(times) - 1), 0], np.uint8)
        kinds = np.roll(kinds, 1)
        kinds[-1] |= LAST
        offsets, counts = np.array([0, len(gaps)]), np.array([len(times)])
        hazard, used = np.zeros(len(gaps)), np.zeros(1, np.int64)
        pixel = dead, chance, lifetime, rate
        base, awake = followed_gaps((gaps, kinds, offsets), (counts, end), pixel, (500e-12, 0.0), (hazard, used))
        rest = hazard, offsets, used, counts, awake
        return math.exp(float(base[0] + likelihood_of_rates(*rest, rate)[0][0]))

    last, end = history[-1], history[-1] + 3e-6
    grid = last + np.concatenate([np.linspace(49e-9, 51e-9, 801), np.geomspace(51.01e-9, 3e-6, 3001)])
    whole = integrate.trapezoid([density(x, x) for x in grid], grid) + density(end)
    assert whole == pytest.approx(density(last), rel=2e-3)


@pytest.mark.parametrize(
    ("values", "modality", "word"),
    [
        ({}, "tr", ""),
        ({("crosstalk", "probability"): 0.01}, "tr", "crosstalk"),
        ({("crosstalk", "probability"): 0.0}, "tr", ""),
        ({("slow_recovery", "time_constant"): 5e-9}, "tr", "slow_recovery"),
        ({("dead_time", "paralyzable"): True}, "tr", "dead_time"),
        ({("flicker", "amplitude"): 0.1}, "tr", "flicker"),
        ({("flicker", "amplitude"): 0.1}, "qis", "flicker"),
        ({("short_gate", "fraction"): 0.9}, "tr", "short_gate"),
        ({("readout_loss", "service_time"): 1e-7}, "tr", "readout_loss"),
        ({("jitter", "sigma"): 1e-9}, "tr", ""),
        ({("jitter", "sigma"): 1e-10, ("jitter", "tail_weight"): 0.1, ("jitter", "tail"): 1e-9}, "tr", "the stamps"),
        ({("tdc", "resolution"): 1e-8}, "tr", "afterpulsing"),
        ({}, "qis", "afterpulsing"),
        ({CHANCE: 0.0}, "qis", ""),
        ({CHANCE: 0.0, ("short_gate", "fraction"): 0.9}, "qis", ""),
        ({CHANCE: 0.0, ("frame_carry_over", "share"): 1.0}, "qis", "frame_carry_over"),
        ({}, "str", "str of lit"),
    ],
)
def test_what_it_does_not_know(sensor: Sensor, values: dict[Key, float], modality: str, word: str) -> None:
    capture = lit(sensor, modality, 1e5, Conditions(1e-3, 100, 1e-5, 1e-5, 500e-9))
    assert not_in_likelihood(with_values(sensor, values), capture) == word


def test_neither_the_traps_of_the_papers_rules_nor_a_mean(sensor: Sensor) -> None:
    capture = lit(sensor, "tr", 1e5, Conditions(1e-3, 100, 1e-5, 1e-5, 500e-9))
    paper = Sensor(sensor.layout, sensor.effects, "paper", sensor.chip_seed, sensor.name)
    assert not_in_likelihood(paper.resolved(), capture) == "afterpulsing"
    assert not_in_likelihood(sensor, replace(capture, mean=3.0)) == "the mean of lit"


def test_maps_and_switches_have_none(sensor: Sensor) -> None:
    (data,) = stamps(sensor, 1e-4, 1e5, 1)
    for name in ("per_pixel detection.pdp", "set dead_time.paralyzable"):
        with pytest.raises(NoLikelihood):
            maximise(sensor, [data], named(sensor, name))
    with pytest.raises(NoLikelihood, match=r"^crosstalk$"):
        maximise(sensor, [data], named(sensor, "add crosstalk"))


def test_the_covariance_of_a_gate_has_the_sign_of_its_values(sensor: Sensor) -> None:
    """The coordinate of a fraction that is off at 1 falls as it rises; a wider gate means fewer dark counts."""
    plain = with_values(sensor.without("afterpulsing"), {("dark_counts", "rate"): 5e4})
    gated = plain.with_effect(ShortGate(fraction=0.7))
    data = bits(gated, 3000, [5e5], 5e5) + bits(gated, 3000, [0.0], 0.0)
    wanted = named(plain, "add short_gate", "set dark_counts.rate")
    exact = maximise(plain, data, wanted)
    assert isinstance(exact, MaximumLikelihood)
    at = [exact.free.index(key) for key in (("short_gate", "fraction"), ("dark_counts", "rate"))]
    assert abs(exact.values["short_gate", "fraction"] - 0.7) < 0.1 and exact.correlations[at[0], at[1]] < -0.05
