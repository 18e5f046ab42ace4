"""Maps: what each pixel's own value is; and closed forms of frames, on which they rest."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import spadmnist
from spadmnist import config, twin
from spadmnist import measurement as measurements
from spadmnist.effects import Conditions, DarkCounts, Detection
from spadmnist.events import Layout
from spadmnist.inference.candidates import candidates, maps_added, with_values
from spadmnist.inference.closed_forms import closed_form
from spadmnist.inference.comparison import compare
from spadmnist.inference.count_model import CountModel, light_levels_of
from spadmnist.inference.evaluation import evaluate
from spadmnist.inference.map_fits import fit_maps
from spadmnist.inference.named_fit import fit_named
from spadmnist.inference.pixel_maps import DOUBT, PixelMap, interval_of_sigma, map_values, odd_pixels, summary
from spadmnist.inference.replicates import Execution, Replicates
from spadmnist.recording import Capture, Light
from spadmnist.sensor import Sensor
from spadmnist.workers import Serial

SIDE, FRAMES = 20, 60_000
SENSOR = f"""sensor:
  name: array
  rules: device
  layout: {{rows: {SIDE}, columns: {SIDE}, pixel_area: 100 um^2, fill_factor: 1.0}}
  effects:
    detection: {{pdp: 0.42}}
    dark_counts: {{rate: 200 Hz}}
"""
CAPTURES = f"""format: spadmnist-measurement/1
name: lab
layout: {{rows: {SIDE}, columns: {SIDE}}}
captures:
  - {{id: dark, file: dark.h5, modality: qis, light: {{kind: dark}}, frames: {FRAMES},
     frame_time: 1 us, frame_period: 1 us}}
"""


def fitted(sensor: Sensor, rates: np.ndarray, folder: Path) -> tuple[Replicates, PixelMap]:
    """(the captures of the folder's plan with these dark rates, reduced; the map fitted to them)."""
    truth = with_values(sensor, {("dark_counts", "rate"): rates})
    plan = measurements.open(folder / "plan.yaml", planned=True)
    data = measurements.open(twin.simulate(truth, plan, folder / "lab", 5))
    replicates = Replicates(sensor, data, 0, Execution(Serial()), 8)
    candidate = next(c for c in candidates(sensor) if c.name == "per_pixel dark_counts.rate")
    return replicates, fit_maps(replicates, {}, [candidate], {"dark": 1.0})["dark_counts", "rate"]


@pytest.mark.parametrize("usual", [20.0, 200.0])
def test_a_few_hot_pixels_are_told_from_many_that_hardly_count(usual: float, tmp_path: Path) -> None:
    """The sensor lists the mean of pixels of which nearly all are quiet, or what most of them have."""
    (tmp_path / "plan.yaml").write_text(CAPTURES)
    (tmp_path / "sensor.yaml").write_text(SENSOR)
    sensor = config.read_sensor(tmp_path / "sensor.yaml").resolved()
    rates = np.full(SIDE * SIDE, usual)
    rates[[3, 77, 150, 256, 300]] = [200.0, 400.0, 2000.0, 9000.0, 60_000.0]
    replicates, map_ = fitted(sensor, rates, tmp_path)
    found = map_.values()
    counts = replicates.seen["dark"].counts
    assert counts is not None
    expected = found * FRAMES * 1e-6
    # 5 sigma of all of them, of what most have, of the hot ones
    assert abs(expected.sum() - counts.sum()) < 5 * np.sqrt(counts.sum())
    assert abs(np.median(found) / usual - 1) < 5 / np.sqrt(usual * SIDE**2 * FRAMES * 1e-6) + 0.02
    hot = rates > 1000
    assert np.all(np.abs(expected[hot] - counts[hot]) < 0.25 * counts[hot])


@pytest.mark.parametrize(("frame", "rate"), [("1 us", 20_000.0), ("100 us", 2000.0), ("100 us", 20_000.0)])
def test_what_a_hot_pixel_causes_in_its_neighbours_is_not_theirs(frame: str, rate: float, tmp_path: Path) -> None:
    """12 or 1200 counts a pixel of its own; a hot pixel causes some more in its side neighbours.

    In the last case it has a detection in 87 % of the frames, and no more avalanches than that cause any.
    """
    (tmp_path / "plan.yaml").write_text(CAPTURES.replace("1 us", frame))
    (tmp_path / "sensor.yaml").write_text(SENSOR + "    crosstalk: {probability: 0.02, diagonal_ratio: 0.0}\n")
    sensor = config.read_sensor(tmp_path / "sensor.yaml").resolved()
    hot = np.array([85, 153, 256, 314])
    beside = np.concatenate([hot - SIDE, hot - 1, hot + 1, hot + SIDE])
    rates = np.full(SIDE * SIDE, 200.0)
    rates[hot] = rate
    replicates, map_ = fitted(sensor, rates, tmp_path)
    found = map_.values()
    counts = replicates.seen["dark"].counts
    assert counts is not None
    expected = CountModel(replicates, "dark", 1.0).expected(with_values(sensor, {("dark_counts", "rate"): found}))
    few = frame == "1 us"
    assert abs(expected.sum() / counts.sum() - 1) < (0.05 if few else 2e-3)
    # 16 pixels of 12 (1200) counts and up to as many that are caused
    own = 16 * (12 if few else 1200)
    assert abs(float(np.mean(found[beside])) / 200 - 1) < 5 * math.sqrt(2 / own)
    assert np.all(np.abs(found[hot] / rates[hot] - 1) < 5 / np.sqrt(counts[hot]) + 0.01)


def test_without_a_capture_in_the_dark_most_pixels_keep_the_listed_rate() -> None:
    """A common dark rate is the same as more light: the level takes it, and the pixels differ by what light shows."""
    layout = Layout(16, 16, 36e-12, 1.0)
    sensor = Sensor(layout, [Detection(pdp=0.444), DarkCounts(rate=200.0)], rules="device")
    rates = np.full(256, 200.0)
    rates[[3, 77, 150, 201]] = 20_000.0
    truth = Sensor(layout, [Detection(pdp=0.444), DarkCounts(rate=rates)], rules="device")
    flat = spadmnist.Capture("flat", "qis", wavelength=500e-9, irradiance=2e-3, frames=2000, frame_time=10e-6)
    for seed in (1, 2):
        data = spadmnist.simulate(truth, [flat], seed=seed)
        replicates = Replicates(sensor, data, 0, Execution(Serial()), 4, reduced=False)
        candidate = next(c for c in candidates(replicates.start) if c.name == "per_pixel dark_counts.rate")
        level = twin.photons_at(data.capture("flat"), layout)
        assert level is not None
        found = fit_maps(replicates, {}, [candidate], {"flat": level})["dark_counts", "rate"].values()
        assert 0.5 < float(np.median(found)) / 200 < 2  # 4 to 20 where the level of the light is not told from it
        # of 1108 counts in the light a hot pixel has 180 more, with an error of 22 of them
        assert np.all(np.abs(found[rates > 1000] / 20_000 - 1) < 5 * 22 / 180)


def test_maps_of_the_dark_rate_and_the_pdp_together() -> None:
    """Dark rates that spread by a factor of ten, of which a typical pixel has one count, in pixels that differ by 4 %.

    The law of the rates is as wide as it is. The file has the fitted values of hot pixels, which are known well: the
    prior of the other map, which informs them, is no prior of theirs.
    """
    draw = np.random.default_rng(512)
    rate = draw.lognormal(np.log(20), 2.27, 32 * 32)
    pdp = 0.444 * draw.normal(1, 0.04, 32 * 32)
    stated, true = (
        Sensor(Layout(32, 32, 36e-12, 1.0), [Detection(pdp=a), DarkCounts(rate=b)], rules="device")
        for a, b in ((0.444, 265.0), (pdp, rate))
    )
    dark = spadmnist.Capture("dark", "qis", dark=True, frames=5000, frame_time=10e-6)
    flat = spadmnist.Capture("flat", "qis", wavelength=500e-9, irradiance=2e-3, frames=2000, frame_time=10e-6)
    data = spadmnist.simulate(true, [dark, flat], seed=1)
    replicates = Replicates(stated, data, 0, Execution(Serial()), 4, reduced=False)
    wanted = [c for c in candidates(replicates.start) if c.kind == "per_pixel"]
    level = twin.photons_at(data.capture("flat"), stated.layout)
    assert level is not None and len(wanted) == 2
    maps = fit_maps(replicates, {}, wanted, {"dark": 1.0, "flat": level})
    found = maps["dark_counts", "rate"]
    values = map_values(found)["sigma"]
    true_width = float(np.std(np.log(rate)))
    assert values.low is not None and values.high is not None
    error = (values.high - values.low) / (2 * 1.96)  # 0.07: 5 of them are a false alarm of 6e-7
    assert abs(values.value - true_width) < 5 * error < 0.4
    own = found.spread_values()
    assert abs(float(np.std(np.log(own))) - true_width) < 0.4
    hot = np.argsort(rate)[-5:]
    assert own[hot] == pytest.approx(found.values()[hot], rel=1e-3)
    assert np.all(np.abs(np.log(own[hot] / rate[hot])) < 5 / np.sqrt(rate[hot] * 0.05))


def test_the_law_of_pixels_that_say_little_each(tmp_path: Path) -> None:
    """2 counts a pixel, of one in ten 12: drawn maps have as many of each kind as the data, whatever the law is."""
    (tmp_path / "plan.yaml").write_text(CAPTURES.replace(str(FRAMES), "10000"))
    (tmp_path / "sensor.yaml").write_text(SENSOR)
    sensor = config.read_sensor(tmp_path / "sensor.yaml").resolved()
    rates = np.full(SIDE * SIDE, 200.0)
    rates[::10] = 1200.0
    replicates, map_ = fitted(sensor, rates, tmp_path)
    counts = replicates.seen["dark"].counts
    assert counts is not None and map_.likely is not None
    rng = np.random.default_rng(6)
    drawn = np.stack([rng.poisson(map_.values(rng.standard_normal(SIDE**2)) * 0.01) for _ in range(200)])
    for least in (1, 5):  # within 4 here; a normal law with long tails has 19 and 17 too few and too many
        seen, usual = int((counts >= least).sum()), float((drawn >= least).sum(axis=1).mean())
        assert abs(seen - usual) < 12
    hot = rates > 1000
    assert float(map_.values()[hot].mean()) > 900 and float(map_.values()[~hot].mean()) < 260


def test_stamps_tell_a_map_where_nearly_every_frame_has_one(tmp_path: Path) -> None:
    """4 photons a frame: 1500 frames tell a pixel to 1 / sqrt(448) by those without a detection, with stamps to 1 /
    sqrt(1473)."""
    (tmp_path / "sensor.yaml").write_text(
        SENSOR.replace("dark_counts: {rate: 200 Hz}", "tdc: {resolution: 1 ns}\n    dead_time: {duration: 4 us}")
    )
    plan = CAPTURES.replace("id: dark, file: dark.h5, modality: qis", "id: flat, file: flat.h5, modality: str")
    plan = plan.replace("1 us", "10 us").replace(str(FRAMES), "1500")
    light = "kind: flat, wavelength: 500 nm, irradiance: 378 nW/cm^2, relative_uncertainty: 0.05"
    (tmp_path / "plan.yaml").write_text(plan.replace("kind: dark", light))
    sensor = config.read_sensor(tmp_path / "sensor.yaml").resolved()
    relative = 1 + 0.1 * np.random.default_rng(3).standard_normal(SIDE * SIDE)
    truth = with_values(sensor, {("detection", "relative"): relative / relative.mean()})
    wanted = measurements.open(tmp_path / "plan.yaml", planned=True)
    data = measurements.open(twin.simulate(truth, wanted, tmp_path / "lab", 5))
    replicates = Replicates(sensor, data, 0, Execution(Serial()), 8)
    share = replicates.seen["flat"].detections / SIDE**2 / 1500
    assert 0.97 < share < 0.99
    candidate = next(c for c in candidates(sensor) if c.name == "per_pixel detection.pdp")
    levels = light_levels_of(replicates, evaluate(replicates, {}))
    map_ = fit_maps(replicates, {}, [candidate], levels)[candidate.carrier]  # type: ignore[index]
    assert np.median(map_.raw_error) == pytest.approx(1 / math.sqrt(1500 * share), rel=0.05)
    apart = map_.raw - np.log(relative / relative.mean())
    pull = (apart - np.median(apart)) / map_.raw_error
    assert abs(np.mean(pull**2) - 1) < 5 * math.sqrt(2 / SIDE**2)
    assert map_.sigma == pytest.approx(0.1, rel=5 / math.sqrt(2 * SIDE**2) + 0.05)


@pytest.mark.parametrize("fraction", [1.0, 0.6])
def test_the_closed_form_of_frames_with_gaps_and_a_gate(fraction: float, tmp_path: Path) -> None:
    (tmp_path / "sensor.yaml").write_text(SENSOR.replace("200 Hz", "100 kHz"))
    gaps = CAPTURES.replace("frame_period: 1 us", "frame_period: 4 us").replace(str(FRAMES), "2000")
    (tmp_path / "plan.yaml").write_text(gaps)
    sensor = with_values(config.read_sensor(tmp_path / "sensor.yaml"), {("short_gate", "fraction"): fraction})
    plan = measurements.open(tmp_path / "plan.yaml", planned=True)
    data = measurements.open(twin.simulate(sensor, plan, tmp_path / "lab", 5))
    expected = closed_form(sensor, data.captures[0])(1e-9)
    total = float(data.recording("dark", sensor).totals.sum())
    # about 45,000 detections; 5 sigma are 2 %, the gate makes 40 %
    assert abs(total / expected - 1) < 5 / np.sqrt(expected)


def test_nobody_knows_exactly_how_wide_pixels_lie() -> None:
    """Draws of a map are as wide as the pixels may be: of 256 that say little each, that is uncertain.

    A ratio beyond 0.7 to 1.4 is a chance of less than 1e-6 for 400 draws. `DOUBT` is what widths of 2,000 maps of
    normal values scatter by; 9 % are five standard errors of that.
    """
    rng, n, sigma, noise = np.random.default_rng(3), 256, 0.012, 0.015
    x = np.random.default_rng(4).standard_normal((2000, n))
    width = 1.4826 * np.median(np.abs(x - np.median(x, axis=1, keepdims=True)), axis=1)
    assert pytest.approx(np.std(width**2) * math.sqrt(n), rel=0.09) == DOUBT
    raw = rng.normal(0, math.hypot(sigma, noise), n)
    share = sigma**2 / (sigma**2 + noise**2)
    error = np.full(n, math.sqrt(share) * noise)
    map_ = PixelMap(("a", "b"), 1.0, np.arange(n), share * raw, error, raw, np.full(n, noise), sigma)

    def widths(doubt: bool) -> np.ndarray:
        draws = [map_.values(rng.standard_normal(n), float(rng.standard_normal()) * doubt) for _ in range(400)]
        return np.var(np.log(draws), axis=1)

    known, doubted = widths(False), widths(True)
    assert np.mean(known) == pytest.approx(sigma**2, rel=0.25)
    # by how much the estimate of a variance scatters, times how the width of a draw follows it
    alone = DOUBT / math.sqrt(n) * (sigma**2 + noise**2)
    bigger, usual = (s**2 / (s**2 + noise**2) for s in (math.sqrt(sigma**2 + alone), sigma))
    follows = float(np.var(raw)) * (bigger**2 - usual**2) + noise**2 * (bigger - usual)
    assert 0.7 < math.sqrt(np.var(doubted) - np.var(known)) / follows < 1.4
    # an odd pixel, from which the prior keeps nothing out, stays where it is
    map_.estimate[7], map_.error[7] = 3.0, noise * (1 - 1e-6)
    for width in (-3.0, 3.0):
        assert math.log(map_.values(np.zeros(n), width)[7]) == pytest.approx(3.0, abs=0.01)
    # where each pixel says where it is, there is no doubt
    clear = PixelMap(("a", "b"), 1.0, np.arange(n), raw, np.full(n, 1e-4), raw, np.full(n, 1e-4), sigma)
    draw = rng.standard_normal(n)
    assert clear.values(draw, 2.0) == pytest.approx(clear.values(draw, 0.0), rel=1e-4)


def placed(raw: np.ndarray, shape: tuple[int, int] | None, noise: float = 0.045) -> PixelMap:
    """A map whose values are the data themselves."""
    error = np.full(raw.size, noise)
    return PixelMap(("a", "b"), 1.0, np.arange(raw.size), raw, error, raw, error, 0.5, shape=shape)


def test_a_dead_pixel_is_odd_however_little_its_few_counts_say() -> None:
    """Its own error is as large as its distance, for nearly nothing was counted: the bulk is not as wide as that.

    The estimates of 63 alike pixels scatter by their noise; the upper end of the interval of their width is 0.025.
    """
    rng = np.random.default_rng(9)
    for dead in (1, 2, 4):
        raw, error = rng.normal(0, 0.03, 64), np.full(64, 0.03)
        raw[:dead], error[:dead] = -9.0, 2.8
        map_ = PixelMap(("a", "b"), 1.0, np.arange(64), raw, error, raw, error, 0.5, shape=(8, 8))
        low, high = odd_pixels(map_)
        assert np.flatnonzero(low).tolist() == list(range(dead)) and not high.any()
        found = map_values(map_)
        assert found["low_fraction"].value == dead / 64
        assert found["sigma"].value < 0.02 and found["sigma"].high < 0.03


@pytest.mark.parametrize("counts", [25, 100, 1000])
def test_of_alike_pixels_few_are_odd(counts: int) -> None:
    """Of 200,000 Poisson counts 6.4 are four sigma below, by a normal law; more than 22 with a chance of 3e-7."""
    n = np.random.default_rng(10).poisson(counts, 200_000)
    raw, error = np.log(np.maximum(n, 0.5) / counts), 1 / np.sqrt(np.maximum(n, 0.5))
    map_ = PixelMap(("a", "b"), 1.0, np.arange(n.size), raw, error, raw, error, 0.5)
    low, _ = odd_pixels(map_)
    assert low.sum() <= 22
    # and what is one of a million is
    raw[0], error[0] = np.log(0.02 if counts == 25 else 0.5), np.sqrt(1 / (counts * (0.02 if counts == 25 else 0.5)))
    assert odd_pixels(PixelMap(("a", "b"), 1.0, np.arange(n.size), raw, error, raw, error, 0.5))[0][0]


@pytest.mark.parametrize("shape", [(1, 256), (256, 1), (32, 32)])
def test_a_hot_pixel_in_light_that_rises_along_the_array_is_odd(shape: tuple[int, int]) -> None:
    """A pixel is compared with those around it: one of three times their rate is no brighter than the far end.

    Of 16,384 others, one is beyond four sigma of all, or five of what is around it. Compared with all, none is odd.
    """
    rng, n = np.random.default_rng(8), math.prod(shape)
    places = np.arange(n) if min(shape) == 1 else np.arange(n) // shape[1] + np.arange(n) % shape[1]
    rising, wrong = np.log(1 + 4 * places / places.max()), 0
    inner = np.flatnonzero(np.isfinite(placed(rising, shape).around[: n // 4]))
    for hot in rng.choice(inner, 16_384 // n):
        raw = rising + rng.normal(0, 0.045, n)
        raw[hot] += math.log(3)
        raw[200] -= 6  # a dead one
        low, high = odd_pixels(placed(raw, shape))
        assert high[hot] and low[200]
        wrong += int(low.sum() + high.sum()) - 2
        assert not odd_pixels(placed(raw, None))[1][hot]
    assert wrong <= 9  # of one, by the Poisson law, 1e-7


@pytest.mark.parametrize("shape", [(1, 256), (16, 16), (32, 32), (3, 64)])
def test_light_that_is_not_even_makes_no_pixel_odd(shape: tuple[int, int]) -> None:
    """A loss to the corners; two converters that differ by a factor of two from column to column."""
    rng, places = np.random.default_rng(9), np.indices(shape)
    y, x = (2 * at / at.max() - 1 if at.max() > 2 else 0.0 * at for at in places)
    for level in (-2 * x**2, -(x**2) - y**2, np.log(2) * (places[1] % 2)):
        odd = 0
        for _ in range(20_000 // math.prod(shape)):
            low, high = odd_pixels(placed((level + rng.normal(0, 0.045, shape)).ravel(), shape))
            odd += int(low.sum() + high.sum())
        assert odd <= 11  # of two in 20,000, by the Poisson law, 1e-6


def test_dead_rows_and_hot_blocks_are_odd_and_do_not_widen_the_rest() -> None:
    """What lies around them is as odd: they are compared with all."""
    for shape, where in (
        ((32, 32), np.s_[10:13]),
        ((32, 32), np.s_[:2]),
        ((32, 32), np.s_[4:8, 4:8]),
        ((1, 256), np.s_[:, 100:116]),
        ((1, 256), np.s_[:, -8:]),
    ):
        for by, share in ((-6.0, "low_fraction"), (4.0, "high_fraction")):
            raw = np.random.default_rng(10).normal(0, 0.1, shape)
            raw[where] += by
            found = summary(placed(raw.ravel(), shape))
            assert found[share] == raw[where].size / raw.size and found["sigma"] == pytest.approx(0.09, abs=0.02)
    # a low one is relative to what it is compared with
    rising = np.log(1 + 4 * np.arange(256) / 255)
    rising[[180, 200, 220]] += math.log(0.5)
    assert summary(placed(rising, (1, 256), 0.01))["low_ratio"] == pytest.approx(0.5, abs=0.02)


ANOTHER = """format: spadmnist-measurement/1
name: lab
layout: {rows: 16, columns: 16}
captures:
  - {id: dark, modality: qis, light: {kind: dark}, frames: 2000, frame_time: 10 us, frame_period: 10 us}
  - {id: flat, modality: qis, frames: 2000, frame_time: 10 us, frame_period: 10 us,
     light: {kind: flat, wavelength: 500 nm, irradiance: 20 nW/cm^2, relative_uncertainty: 5 %}}
"""


def chip(folder: Path, seed: int) -> Sensor:
    text = SENSOR.replace(f"rows: {SIDE}, columns: {SIDE}", "rows: 16, columns: 16")
    text = text.replace("200 Hz", "{lognormal: {median: 20 Hz, sigma: 2.27}}").replace("rules: device", "rules: paper")
    (folder / "sensor.yaml").write_text(text.replace("  layout", f"  chip_seed: {seed}\n  layout"))
    return config.read_sensor(folder / "sensor.yaml")


def test_a_map_of_another_chip_is_a_candidate_until_it_is_fitted(tmp_path: Path) -> None:
    model = chip(tmp_path, 1).resolved()
    name = "per_pixel dark_counts.rate"
    assert name in [c.name for c in candidates(model)]
    fitted = with_values(model, {("dark_counts", "rate"): np.full(256, 30.0)})
    (key,) = maps_added(fitted, model)
    assert key == ("dark_counts", "rate") and maps_added(model, model) == []
    assert name not in [c.name for c in candidates(fitted, (), [key])]


@pytest.mark.slow
@pytest.mark.long
def test_a_camera_has_another_chip_than_the_model(tmp_path: Path) -> None:
    """The dark counts of its pixels are found and fitted; where the model is of that very chip nothing is missing."""
    (tmp_path / "plan.yaml").write_text(ANOTHER)
    truth, model = chip(tmp_path, 2).resolved(), chip(tmp_path, 1)
    plan = measurements.open(tmp_path / "plan.yaml", planned=True)
    data = measurements.open(twin.simulate(truth, plan, tmp_path / "lab", 5))
    found = spadmnist.diagnose(model, data, quick=True, within="none")
    assert found.verdict == "explained" and [s.candidate.name for s in found.steps] == ["per_pixel dark_counts.rate"]
    hot = (rates := np.asarray(truth.effect("dark_counts").rate)) > 2000  # 40 dark counts in each capture
    fitted = np.asarray(found.model.effect("dark_counts").rate)
    assert hot.sum() > 3 and np.all(np.abs(fitted[hot] / rates[hot] - 1) < 0.5)
    assert spadmnist.diagnose(truth, data, quick=True, within="none").verdict == "adequate"


# --- one sensor with the map ----------------------------------------------------------------------------------------


def map_of(raw: np.ndarray, raw_error: float, sigma: float) -> PixelMap:
    """The map of normal logarithms that are known with this error, under the prior that they have."""
    share = sigma**2 / (sigma**2 + raw_error**2)
    error = np.full(raw.size, raw_error * math.sqrt(share))
    known = np.full(raw.size, raw_error)
    return PixelMap(("dark_counts", "rate"), 5.0, np.arange(raw.size), share * raw, error, raw, known, sigma)


@pytest.mark.parametrize("raw_error", [0.02, 0.5, 1.0])
def test_the_values_of_one_sensor_spread_as_the_pixels_do(raw_error: float) -> None:
    """The spread of 10,000 logarithms has a standard error of 0.7 %. Five of them are allowed (false alarms: 6e-7)."""
    rng, sigma = np.random.Generator(np.random.PCG64(8)), 0.5
    true = sigma * rng.standard_normal(10_000)
    map_ = map_of(true + raw_error * rng.standard_normal(true.size), raw_error, sigma)
    means, spread = np.log(map_.values() / 5.0), np.log(map_.spread_values() / 5.0)
    assert np.std(spread) == pytest.approx(sigma, rel=0.036)
    # the means of the posterior spread by the root of the reliability
    assert np.std(means) == pytest.approx(sigma * math.sqrt(sigma**2 / (sigma**2 + raw_error**2)), rel=0.036)
    assert map_.spread_values().sum() == pytest.approx(map_.values().sum())
    apart = [float(np.sqrt(np.mean((x - x.mean() - true) ** 2))) for x in (means, spread)]
    assert apart[0] <= apart[1] < 1.25 * apart[0]
    if raw_error < 0.1:  # what is known well stays as it is
        np.testing.assert_array_equal(map_.spread_values(), map_.values())


def test_a_pixel_that_is_known_well_is_not_moved_by_those_that_are_not() -> None:
    rng, sigma = np.random.Generator(np.random.PCG64(8)), 0.5
    well, poor = map_of(sigma * rng.standard_normal(500), 0.01, sigma), map_of(rng.standard_normal(500), 1.0, sigma)
    fields = ("estimate", "error", "raw", "raw_error")
    both = {name: np.concatenate([getattr(well, name), getattr(poor, name)]) for name in fields}
    map_ = replace(well, group=np.arange(1000), **both)
    np.testing.assert_array_equal(map_.spread_values()[:500], map_.values()[:500])
    assert map_.spread_values().sum() == pytest.approx(map_.values().sum())
    assert np.std(np.log(map_.spread_values()[500:])) > 1.5 * np.std(np.log(map_.values()[500:]))


def test_a_map_of_few_counts_passes_the_comparison_with_its_own_data() -> None:
    """8 dark counts a pixel: with the means of the posterior the model fails, for its pixels are too much alike."""
    side, frames, frame = 32, 4000, 1e-5
    rng = np.random.Generator(np.random.PCG64(5))
    rate = 8.0 / (frames * frame) * np.exp(0.5 * rng.standard_normal(side * side))
    rate[rng.random(side * side) < 0.02] *= 30
    layout = Layout(side, side, 25e-12, 1.0)
    effects = [Detection(pdp=0.4), DarkCounts(rate=float(np.median(rate)))]
    stated = Sensor(layout, effects, "device", name="lab").resolved()
    clock = Conditions(frames * frame, frames, frame, frame, None)
    plan = measurements.in_memory("lab", layout, [Capture("dark", "qis", Light(), clock)])
    truth = with_values(stated, {("dark_counts", "rate"): rate})
    data = measurements.in_memory("lab", layout, list(twin.twin(truth, plan, 1)))
    found = fit_named(stated, data, per_pixel=["dark_counts.rate"], jobs=1)
    (step,) = found.steps
    assert step.map is not None
    np.testing.assert_array_equal(found.values["dark_counts", "rate"], step.map.spread_values())
    verdicts = []
    for values in (step.map.spread_values(), step.map.values()):
        model = with_values(stated, {("dark_counts", "rate"): values})
        verdicts.append(compare(model, data, jobs=1, replicates=32).verdict)
    assert verdicts == ["adequate", "fails"]


@pytest.mark.parametrize("number", [2, 5, 23])
def test_the_interval_of_sigma_covers_for_few_values(number: int) -> None:
    """The share of 4,000 intervals that cover; 5 sigma of it is 0.017, a false alarm of 1e-6."""
    rng, sigma, noise = np.random.default_rng(number), 0.1, 0.03
    values = rng.normal(0, math.hypot(sigma, noise), (4000, number))
    ends = np.array([interval_of_sigma(number, float(x), noise**2) for x in values.var(axis=1, ddof=1)])
    assert np.mean((ends[:, 0] <= sigma) & (sigma <= ends[:, 1])) == pytest.approx(0.95, abs=0.017)


def test_three_pixels_that_differ_have_a_width() -> None:
    map_ = map_of(np.array([-0.2, 0.0, 0.2]), 1e-3, 0.2)
    assert summary(map_)["sigma"] == pytest.approx(0.2, rel=1e-3)
    value = map_values(map_)["sigma"]
    assert value.low is not None and value.high is not None and 0.08 < value.low < 0.2 < value.high
