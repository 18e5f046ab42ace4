"""Edges: how long each pixel is blind, from its shortest intervals."""

from __future__ import annotations

import math
from pathlib import Path

import laws
import numpy as np
import pytest
from joblib import Parallel

from spadmnist import config, twin
from spadmnist import measurement as measurements
from spadmnist.criticism import chance, edges, mapping
from spadmnist.criticism.candidates import changes, with_values
from spadmnist.criticism.edges import Shortest
from spadmnist.criticism.fit import Bench
from spadmnist.effects import Conditions
from spadmnist.events import Events, Layout
from spadmnist.recording import Capture, Light, Recording

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
    found = Shortest.of(recorded([[0, 900, 1440, 2500], [], [7], [10, 530, 1060, 3000], [5, 605]]))
    assert found is not None
    assert found.intervals * 1e10 == pytest.approx([540, math.inf, math.inf, 520, 600])
    # of 5 ns, one interval of a pixel follows, 10 ticks behind; the others have their share of it
    assert found.density[3] > found.density[0] > found.density[4] > found.density[1] == found.density[2] > 0
    assert found.density[3] == pytest.approx(
        5 / (1 + 4 * 19 / 9) / 5e-9
    )  # 1 + 4, beside 9 / (9 + 9 + 1) that are usual
    assert Shortest.of(recorded([[0, 900]]).beside(0.0)) is None


@pytest.mark.parametrize(("spread", "blur"), [(0.03, 0.0), (0.006, 0.0), (0.006, 0.2e-9), (0.0, 0.2e-9)])
def test_how_wide_the_edges_of_pixels_lie_is_in_its_interval(spread: float, blur: float) -> None:
    """Shortest intervals by the law: later than t behind a blurred edge with the chance exp(-density * passed)."""
    rng, pixels, density = np.random.default_rng(4), 256, 1 / 0.6e-9
    own = DEAD * np.exp(spread * rng.standard_normal(pixels))
    tick = 1e-10
    # of a Poisson process behind each edge the first one, every interval being blurred by itself
    intervals = own[:, None] + np.cumsum(rng.exponential(1 / density, (pixels, 60)), axis=1)
    blurred = intervals + rng.normal(0, blur, intervals.shape) + tick * np.diff(rng.random((pixels, 60, 2)))[:, :, 0]
    least = np.rint(blurred.min(axis=1) / tick) * tick
    found = edges.likely([Shortest(least, np.full(pixels, density), tick)], blur, DEAD)
    assert found is not None
    sigma, low, high = edges.width(*found)
    assert low <= spread <= high and low <= sigma <= high
    assert high - low < 0.35 * spread + 0.005
    if spread:
        weights = found[1] / found[1].sum(axis=1, keepdims=True)
        apart = weights @ found[0] - np.log(own / DEAD)
        # each says no more than its one interval does
        assert np.std(apart) == pytest.approx(1 / density / DEAD, rel=0.35)


def test_pixels_that_tell_nothing_are_no_edges() -> None:
    assert edges.likely([Shortest(np.full(4, math.inf), np.full(4, 1.0), 1e-10)], 0.0, DEAD) is None
    assert edges.likely([Shortest(np.full(4, 60e-9), np.full(4, 1e6), 1e-10)], 0.0, DEAD) is None


@pytest.fixture(scope="module")
def benches(tmp_path_factory: pytest.TempPathFactory) -> dict[float, tuple[Bench, np.ndarray]]:
    """spread -> (bench, how long each pixel is blind)."""
    folder: Path = tmp_path_factory.mktemp("edges")
    (folder / "plan.yaml").write_text(CAPTURES)
    (folder / "sensor.yaml").write_text(SENSOR)
    sensor = config.read_sensor(folder / "sensor.yaml").settled()
    plan = measurements.open(folder / "plan.yaml", planned=True)
    out = {}
    for spread in (0.0, 0.03):
        own = DEAD * np.exp(spread * np.random.default_rng(2).standard_normal(SIDE**2))
        data = twin.simulate(with_values(sensor, {DURATION: own}), plan, folder / f"lab {spread}", 5)
        out[spread] = Bench(sensor, measurements.open(data), 0, Parallel(n_jobs=1), 16), own
    return out


def test_a_map_of_dead_times(benches: dict[float, tuple[Bench, np.ndarray]]) -> None:
    bench, own = benches[0.03]
    change = next(c for c in changes(bench.start) if c.carrier == DURATION)
    assert change.blinds and not mapping.by_counts(change)
    map_ = mapping.settle_maps(bench, {}, [change], {})[DURATION]
    apart = map_.values() / own - 1
    noise = float(np.median(map_.error))
    assert 0.005 < noise < 0.015
    assert np.std(apart) < 1.3 * noise and abs(np.mean(apart)) < laws.z_bound() * noise / SIDE + 1e-3
    # maps that may be true differ from it as it differs from the truth
    rng = np.random.default_rng(3)
    drawn = np.stack([map_.values(rng.standard_normal(SIDE**2)) for _ in range(100)])
    assert np.mean(np.std(drawn / map_.values() - 1, axis=1)) == pytest.approx(np.std(apart), rel=0.25)


def test_the_chance_of_a_map_of_dead_times(benches: dict[float, tuple[Bench, np.ndarray]]) -> None:
    for spread, (bench, _) in benches.items():
        state = bench.state({})
        change = next(c for c in changes(bench.start) if c.carrier == DURATION)
        p = chance.of_map(bench, state, change, {}, mapping.levels_of(bench, state))
        assert p < 1e-6 if spread else p > 1e-4
