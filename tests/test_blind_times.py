"""Edges: how long each pixel is blind, from its shortest intervals."""

from __future__ import annotations

import copy
import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from spadmnist import config, twin
from spadmnist import measurement as measurements
from spadmnist.effects import Conditions, Effect, parameter
from spadmnist.errors import SpadError
from spadmnist.events import Events, Layout
from spadmnist.inference.blind_times import ShortestIntervals, Width, likelihoods, width_of
from spadmnist.inference.candidates import candidates, with_values
from spadmnist.inference.count_model import light_levels_of
from spadmnist.inference.evaluation import evaluate
from spadmnist.inference.map_fits import fit_blind_times, fit_maps
from spadmnist.inference.pixel_maps import by_counts
from spadmnist.inference.replicates import Execution, Replicates
from spadmnist.inference.score_test import p_of_map
from spadmnist.recording import Capture, Light, Recording
from spadmnist.sensor import Sensor
from spadmnist.workers import Serial

SIDE, DEAD = 16, 50e-9
DURATION = ("dead_time", "duration")
SENSOR = f"""sensor:
  name: array
  rules: device
  layout: {{rows: {SIDE}, columns: {SIDE}, pixel_area: 100 um^2, fill_factor: 1.0}}
  effects:
    detection: {{pdp: 0.42}}
    dark_counts: {{rate: 100 Hz}}
    dead_time: {{duration: 50 ns}}
    tdc: {{resolution: 100 ps}}
"""
CAPTURES = f"""format: spadmnist-measurement/1
name: lab
layout: {{rows: {SIDE}, columns: {SIDE}}}
captures:
  - {{id: dark, file: dark.h5, modality: tr, light: {{kind: dark}}, exposure: 20 ms}}
  - {{id: flat, file: flat.h5, modality: tr, exposure: 0.7 ms,
     light: {{kind: flat, wavelength: 500 nm, irradiance: 1500 nW/cm^2, relative_uncertainty: 0.02}}}}
"""


def recorded(pixels: list[list[float]], tick: float = 1e-10) -> Recording:
    """Stamps of each pixel, in ticks, as a capture of one row of pixels."""
    ticks = np.array([t for one in pixels for t in one], np.uint64)
    offsets = np.cumsum([0, *map(len, pixels)]).astype(np.int64)
    layout = Layout(1, len(pixels), 1e-10, 1.0, None)
    capture = Capture("flat", "tr", Light(500e-9, None, "irradiance"), Conditions(1e-3, 1, 1e-3, 1e-3, 500e-9), None)
    return Recording(capture, layout, Events(None, offsets, len(pixels), ticks, tick), None, tick, DEAD)


def test_the_shortest_intervals_of_a_few_pixels() -> None:
    found = ShortestIntervals.of(recorded([[0, 900, 1440, 2500], [], [7], [10, 530, 1060, 3000], [5, 605]]))
    assert found is not None
    assert found.intervals * 1e10 == pytest.approx([540, math.inf, math.inf, 520, 600])
    # of 15 ns, from 5 ns behind the shortest on; where a pixel has none of its own, the array's share of it
    assert found.density[3] > 0 and found.density[1] == found.density[2] == 0
    assert ShortestIntervals.of(recorded([[0, 900]]).beside(0.0)) is None


def fired(
    dead: np.ndarray,
    rate: np.ndarray | float,
    seed: int = 0,
    exposure: float = 0.7e-3,
    jitter: float = 0.0,
    tick: float = 1e-10,
    recharge: float = 0.0,
) -> Recording:
    """Stamps of pixels that are blind for so long after each detection, (pixels,) s, in steady light."""
    rng = np.random.default_rng(seed)
    pixels = []
    for own, light in zip(dead, np.broadcast_to(rate, dead.shape), strict=True):
        number = int(2 * exposure * light + 40)
        times = np.cumsum(own + recharge + rng.exponential(1 / light, number))
        stamps = np.sort(times[times < exposure] + jitter * rng.standard_normal((times < exposure).sum()))
        pixels.append(np.maximum(np.floor(stamps / tick), 0).astype(int).tolist())
    return recorded(pixels, tick)


def width_in(recording: Recording, jitter: float = 0.0) -> Width:
    shortest = ShortestIntervals.of(recording)
    assert shortest is not None
    found = likelihoods([shortest], jitter * math.sqrt(2), DEAD)
    assert found is not None
    return width_of(*found)


def unlike(spread: float, pixels: int = 256, seed: int = 1) -> np.ndarray:
    return DEAD * np.exp(spread * np.random.default_rng(seed).standard_normal(pixels))


@pytest.mark.parametrize(
    ("spread", "jitter", "tick"),
    [
        (0.006, 0.15e-9, 1e-10),
        (0.0, 0.0, 2e-9),
        *(
            pytest.param(*x, marks=pytest.mark.slow)
            for x in (
                (0.03, 0.0, 1e-10),
                (0.006, 0.0, 1e-10),
                (0.0, 0.15e-9, 1e-10),
                (0.0, 0.0, 1e-10),
                (0.02, 0.0, 2e-9),
                (0.02, 0.0, 1e-12),
            )
        ),
    ],
)
def test_how_wide_the_edges_of_pixels_lie_is_in_its_interval(spread: float, jitter: float, tick: float) -> None:
    """From stamps; and their middle is where it is, to a thousandth, whatever the ticks."""
    found = width_in(fired(unlike(spread), 1.5e6, 3, jitter=jitter, tick=tick), jitter)
    own = float(np.std(np.log(unlike(spread) / DEAD)))  # of these pixels
    assert found.low <= own <= found.high and found.low <= found.sigma <= found.high
    assert found.high - found.low < 0.35 * spread + 0.006
    own = float(np.mean(np.log(unlike(spread) / DEAD)))
    assert abs(found.middle - own) < 1.5e-3 + 0.3 * tick / DEAD
    assert (found.likelihood_ratio > 10) == (spread > 0)


def test_a_few_odd_pixels_are_not_the_width_of_all() -> None:
    dead = unlike(0.01)
    dead[[7, 70, 170]] = 0.3 * DEAD, 6 * DEAD, 0.6 * DEAD
    found = width_in(fired(dead, 1.5e6))
    assert found.low < 0.011 and found.high < 0.015
    grid, likely = likelihoods([ShortestIntervals.of(fired(dead, 1.5e6))], 0.0, DEAD)  # type: ignore[list-item, misc]
    weights = likely * width_of(grid, likely).prior
    values = DEAD * np.exp((weights / weights.sum(axis=1, keepdims=True)) @ grid)
    assert values[[7, 70, 170]] == pytest.approx(dead[[7, 70, 170]], rel=0.06)
    assert np.median(values / dead) == pytest.approx(1, abs=2e-3)


def test_a_stamp_that_is_there_twice_is_one_odd_pixel() -> None:
    good = fired(unlike(0.0), 1.5e6)
    assert good.events is not None and good.events.ticks is not None
    stamps = [good.events.ticks[a:b].tolist() for a, b in itertools.pairwise(good.events.offsets)]
    stamps[5].insert(3, stamps[5][3])
    assert width_in(recorded(stamps)).high < 0.004


@pytest.mark.parametrize("seed", range(2))
def test_pixels_that_tell_nothing_make_no_edges(seed: int) -> None:
    """Their shortest intervals lie anywhere, some of them by chance near the listed time."""
    dim = ShortestIntervals.of(fired(np.full(256, DEAD), 2e4, seed, exposure=5e-3))
    assert dim is not None and likelihoods([dim], 0.0, DEAD) is None
    assert likelihoods([ShortestIntervals(np.full(4, math.inf), np.zeros(4), 1e-10)], 0.0, DEAD) is None
    # nor do they move those of others
    rate = np.where(np.arange(256) < 100, 1.5e6, 4e4)
    found = width_in(fired(unlike(0.01), rate, seed))
    assert found.low < 0.01 < found.high + 1e-3 and abs(found.middle) < 5e-3


@pytest.fixture(scope="module")
def benches(tmp_path_factory: pytest.TempPathFactory) -> dict[float, tuple[Replicates, np.ndarray]]:
    """spread -> (bench, how long each pixel is blind)."""
    folder: Path = tmp_path_factory.mktemp("edges")
    (folder / "plan.yaml").write_text(CAPTURES)
    (folder / "sensor.yaml").write_text(SENSOR)
    sensor = config.read_sensor(folder / "sensor.yaml").resolved()
    plan = measurements.open(folder / "plan.yaml", planned=True)
    out = {}
    for spread in (0.0, 0.03):
        own = DEAD * np.exp(spread * np.random.default_rng(2).standard_normal(SIDE**2))
        data = twin.simulate(with_values(sensor, {DURATION: own}), plan, folder / f"lab {spread}", 5)
        out[spread] = Replicates(sensor, measurements.open(data), 0, Execution(Serial()), 16), own
    return out


def test_a_map_of_dead_times(benches: dict[float, tuple[Replicates, np.ndarray]]) -> None:
    replicates, own = benches[0.03]
    candidate = next(c for c in candidates(replicates.start) if c.carrier == DURATION)
    assert candidate.blinds and not by_counts(candidate)
    map_ = fit_maps(replicates, {}, [candidate], {})[DURATION]
    apart = map_.values() / own - 1
    noise = float(np.median(map_.error))
    assert 0.005 < noise < 0.015
    assert np.std(apart) < 1.3 * noise and abs(np.mean(apart)) < 2e-3
    # maps that may be true differ from it as it differs from the truth
    rng = np.random.default_rng(3)
    drawn = np.stack([map_.values(rng.standard_normal(SIDE**2)) for _ in range(100)])
    assert np.mean(np.std(drawn / map_.values() - 1, axis=1)) == pytest.approx(np.std(apart), rel=0.25)


def test_pixels_that_are_alike_have_a_map_of_one_value(benches: dict[float, tuple[Replicates, np.ndarray]]) -> None:
    replicates, _ = benches[0.0]
    candidate = next(c for c in candidates(replicates.start) if c.carrier == DURATION)
    map_ = fit_maps(replicates, {}, [candidate], {})[DURATION]
    drawn = map_.values(np.random.default_rng(3).standard_normal(SIDE**2))
    assert np.median(np.abs(drawn / DEAD - 1)) < 2e-3 and np.median(np.abs(map_.values() / DEAD - 1)) < 2e-3


@pytest.mark.slow
def test_the_chance_of_a_map_of_dead_times(benches: dict[float, tuple[Replicates, np.ndarray]]) -> None:
    for spread, (replicates, _) in benches.items():
        evaluation = evaluate(replicates, {})
        candidate = next(c for c in candidates(replicates.start) if c.carrier == DURATION)
        p = p_of_map(replicates, evaluation, candidate, {}, light_levels_of(replicates, evaluation))
        assert p < 1e-6 if spread else p == 1.0
        # where the model blurs the edge by other laws there is none
        slow = {("slow_recovery", "time_constant"): 5e-9}
        assert p_of_map(replicates, evaluation, candidate, slow, light_levels_of(replicates, evaluation)) == 1.0


def test_a_parameter_of_the_name_of_a_hook_blurs_no_edge(benches: dict[float, tuple[Replicates, np.ndarray]]) -> None:
    class Filtered(Effect, stage="arrival"):
        """A filter with a parameter that is called as the hook of a slow recovery is."""

        sensitivity = parameter(1.0, "", "share that passes", bounds=(0, 1), off=1.0, search=(0.1, 1.0))

        def factor(self, t: np.ndarray, conditions: Conditions) -> np.ndarray:
            return np.full(np.shape(t), self.sensitivity)

        def maximum(self, conditions: Conditions) -> float:
            return float(self.sensitivity)

    stated, _ = benches[0.03]
    replicates = copy.copy(stated)
    effects = [*stated.start.effects, Filtered()]
    replicates.start = Sensor(stated.start.layout, effects, stated.start.rules, 0, "filtered").resolved()
    candidate = next(c for c in candidates(stated.start) if c.carrier == DURATION)
    assert fit_blind_times(replicates, {}, candidate).estimate.size == SIDE**2
    with pytest.raises(SpadError, match="blur them by other laws"):
        fit_blind_times(replicates, {("slow_recovery", "time_constant"): 5e-9}, candidate)


def test_which_times_are_the_dead_time(benches: dict[float, tuple[Replicates, np.ndarray]]) -> None:
    sensor = benches[0.0][0].start
    assert [c.carrier for c in candidates(sensor) if c.blinds] == [DURATION]

    class HoldOff(Effect, stage="dead_time"):
        """Blind for a time by which another one is not seen, and a time that blinds nobody."""

        hold = parameter(10e-9, "s", "blind so long", bounds=(0, None), off=0.0, search=(1e-9, 1e-6), per_pixel=True)
        slope = parameter(1e-9, "s", "of no matter", bounds=(0, None), off=0.0, search=(1e-9, 1e-6), per_pixel=True)

        def blind_time(self) -> np.ndarray:
            return np.asarray(self.hold)

    # the longer of two blindnesses is the one that is seen
    both = Sensor(sensor.layout, [*sensor.effects, HoldOff()], sensor.rules, 0, "two").resolved()
    per_pixel = [c for c in candidates(both) if c.per == "pixel" and c.effect in ("dead_time", "hold_off")]
    assert {c.parameter: c.blinds for c in per_pixel} == {"duration": True, "hold": False, "slope": False}
