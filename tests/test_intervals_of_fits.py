"""Fits whose values or intervals were wrong: each with a truth that a closed form, or a law, tells."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_saturated import FRAME, LIT, PIXEL, irradiance, lit, sensor

import spadmnist as sp
from spadmnist.effects import Effect
from spadmnist.events import Layout
from spadmnist.inference import upper_limits
from spadmnist.inference.candidates import Candidate, candidates
from spadmnist.inference.coordinates import coordinate_of
from spadmnist.inference.evaluation import evaluate
from spadmnist.inference.map_fits import fit_codes
from spadmnist.inference.pixel_maps import code_periods
from spadmnist.inference.replicates import Execution, Replicates
from spadmnist.inference.setups import exposure_factor
from spadmnist.inference.signature import Signature
from spadmnist.inference.trial import Trial
from spadmnist.measurement import in_memory
from spadmnist.workers import Serial


def set_of(model: sp.Sensor, name: str) -> Candidate:
    return next(c for c in candidates(model.resolved()) if c.name == name)


@pytest.mark.parametrize(
    ("effect", "name"),
    [
        (sp.effects.DeadTime(duration=1e-6), "dead_time.duration"),
        (sp.effects.DeadTime(duration=20e-6), "dead_time.duration"),
        (sp.effects.DarkCounts(rate=2e5), "dark_counts.rate"),
        (sp.effects.DarkCounts(rate=1e-4), "dark_counts.rate"),
        (sp.effects.Crosstalk(probability=0.3), "crosstalk.probability"),
    ],
)
def test_a_listed_value_may_rise_and_fall(effect: Effect, name: str) -> None:
    """Also one at the end of its search range, or beyond."""
    effects = [sp.effects.Detection(pdp=0.3), effect]
    (coordinate,) = set_of(sp.Sensor(Layout(2, 2, PIXEL, 1.0), effects, rules="device"), f"set {name}").coordinates
    value = getattr(effect, coordinate.parameter)
    assert coordinate.low <= value / 1.5 and coordinate.high >= 1.5 * value and not coordinate.lacks
    u = coordinate.coordinate(value)
    low, high = coordinate.interval(u - 0.2, u + 0.2)
    assert low < value < high and coordinate.value(u + 0.2) > value


def test_a_listed_value_stays_within_its_bounds() -> None:
    effects = [sp.effects.Detection(pdp=0.3), sp.effects.Crosstalk(probability=1.0)]
    one = set_of(sp.Sensor(Layout(2, 2, PIXEL, 1.0), effects, rules="paper"), "set crosstalk.probability").coordinates[
        0
    ]
    assert one.high == 1.0


@pytest.mark.parametrize(
    ("period", "spread", "detections"),
    [(140, 0.8, 1e6), (140, 0.3, 5e6), (100, 0.1, 1e6), (100, 0.3, 2e5), (256, 0.3, 5e6)],
)
def test_the_period_of_codes_is_found_where_every_p_value_is_0(period: int, spread: float, detections: float) -> None:
    rng = np.random.default_rng(period)
    widths = np.clip(1 + spread * rng.standard_normal(period), 0.01, None)
    drawn = rng.choice(period, int(detections), p=widths / widths.sum()) + period * rng.integers(
        0, 10_000, int(detections)
    )
    values = np.zeros(sum(code_periods(10_000)))
    for other, part in code_periods(10_000).items():
        values[part] = np.bincount(drawn % other, minlength=other)
    seen = SimpleNamespace(summaries={"codes": SimpleNamespace(values=values)})
    candidate = SimpleNamespace(carrier=("tdc_nonlinearity", "widths"))
    found = fit_codes(SimpleNamespace(seen={"flat": seen}), candidate)  # type: ignore[arg-type]
    assert found.raw.size == period
    assert np.corrcoef(found.raw, np.log(widths))[0, 1] > 0.97


def test_the_limit_of_an_effect_is_that_of_its_weakest_shape() -> None:
    """Shapes are simulated at strengths of their own: a factor on one says nothing of a factor on the other."""
    probability = coordinate_of("afterpulsing", Effect.registry.find("afterpulsing").parameters["probability"], 0.0)
    candidate = Candidate("add", "afterpulsing", None, (probability,))

    def shape(strength: float, times: float) -> Any:
        return times, 20.0, Trial(candidate, {probability.key: strength}, Signature({}, {}, {}), 0.0, 1.0)

    fast, slow = shape(0.0045, 1.645 / 20), shape(0.054, 1.645 / 24)
    assert max(fast, slow, key=upper_limits.strength_at_limit) is slow


def means(relative: float, own: float) -> tuple[sp.Sensor, Any]:
    """A capture of which the mean alone is known, so bright that it tells the dead time: 4 events in 200 ns."""
    effects = [sp.effects.Detection(pdp=0.3), sp.effects.DeadTime(duration=180e-9)]
    model = sp.Sensor(Layout(8, 8, PIXEL, 1.0), effects, rules="device")
    rate, light = 2e7, {**LIT, "relative_uncertainty": relative, "own_uncertainty": own}
    capture = sp.Capture("bright", "tr", irradiance=irradiance(rate), exposure=1.0, **light)
    exact = rate / (1 + rate * 200e-9)
    return model, in_memory("means", model.layout, [dataclasses.replace(capture, mean=exact)])


def test_the_light_of_a_capture_is_as_uncertain_by_itself_as_with_all_others() -> None:
    """The dead time by a total under light that is known to 5 %: by hand, for one capture."""
    both = []
    for relative, own in ((0.05, 0.0), (0.0, 0.05)):
        model, data = means(relative, own)
        fit = sp.fit(model, data, free=["dead_time.duration"], jobs=1)
        both.append(fit.intervals["dead_time.duration"])
        assert abs(fit.values["dead_time.duration"] / 200e-9 - 1) < 0.01
    # n = r / (1 + r tau): at the same n, d tau = d(1 / r) = (1 / r) d log r
    half = 1.96 * 0.05 / 2e7
    for low, high in both:
        assert (high - low) / 2 == pytest.approx(half, rel=0.25)


FEW = [(0.6, 1.0, 0.0), (2.5, 0.5, 0.0), (2.5, 1.0, 0.0), (12.0, 1.0, 0.0), (2.5, 0.5, 0.04)]


@pytest.mark.parametrize(("mean", "sigma", "hot"), FEW)
def test_the_width_of_pixels_with_few_counts_is_within_its_interval(mean: float, sigma: float, hot: float) -> None:
    """Dark counts of 1,024 pixels, lognormal. The interval misses once in 20, its double once in 10^4.

    hot: share of pixels with thirty times as many.
    """
    side, exposure = 32, 1.0
    rng = np.random.default_rng(round(10 * mean + 100 * sigma))
    rates = mean / exposure * np.exp(sigma * rng.standard_normal(side**2) - sigma**2 / 2)
    rates *= np.where(rng.random(side**2) < hot, 30.0, 1.0)
    hidden = sensor(side=side, dark=mean / exposure).with_values({"dark_counts.rate": rates})
    data = sp.simulate(hidden, [sp.Capture("dark", "tr", dark=True, exposure=exposure)], seed=3)
    fit = sp.fit(sensor(side=side, dark=mean / exposure), data, per_pixel=["dark_counts.rate"], jobs=1)
    value = fit.steps[0].values["sigma"]
    assert value.low is not None and value.high is not None and value.low < value.value < value.high
    truth = sigma if hot else float(np.std(np.log(rates)))
    assert 2 * value.low - value.value < truth < 2 * value.high - value.value
    assert value.high - value.low < 0.8 * sigma


def test_a_map_of_a_rate_that_is_listed_at_0_is_fitted() -> None:
    rng = np.random.default_rng(4)
    hidden = sensor(dark=1.0).with_values({"dark_counts.rate": rng.uniform(100, 1000, 16)})
    data = sp.simulate(hidden, [sp.Capture("dark", "tr", dark=True, exposure=1.0)], seed=3)
    none = sensor(dark=1.0).with_values({"dark_counts.rate": 0.0})
    fit = sp.fit(none, data, per_pixel=["dark_counts.rate"], jobs=1)
    found = fit.values["dark_counts.rate"]
    assert np.corrcoef(found, hidden.effect("dark_counts").rate)[0, 1] > 0.98


@pytest.mark.slow
@pytest.mark.parametrize("modality", ["qis", "counts"])
def test_an_exposure_is_no_light_level(modality: str) -> None:
    """Frames 10 % longer, half of whose detections are dark counts, or whose dead time is long."""
    dark = 2e4 if modality == "qis" else 100.0
    rate = 2e4 if modality == "qis" else 2e7
    model = sensor(dark=dark, side=8, ticks=False)
    if modality == "counts":
        model = model.with_values({"dead_time.duration": 200e-9})
    more = {"bits": 8, "counting": "counter"} if modality == "counts" else {}
    stated = lit("flat", modality, rate, frames=2000, frame_time=FRAME, **more)
    longer = lit("flat", modality, rate, frames=2000, frame_time=1.1 * FRAME, **more)
    made = sp.simulate(model, [longer], seed=5).recording("flat")
    data = in_memory("longer", model.layout, [dataclasses.replace(made, capture=stated)])
    replicates = Replicates(model, data, 0, Execution(Serial()), 24)
    evaluation = evaluate(replicates, {})
    level, error, _ = evaluation.rates["flat"].level_of(replicates.seen["flat"].total)
    log = math.log(level / float(evaluation.rates["flat"].stated or 1.0))
    assert math.exp(log) > 1.18  # of the light it would be more
    found = exposure_factor(replicates, evaluation, "flat", log, error)
    assert found["value"] == pytest.approx(1.1, abs=0.01)
    assert found["low"] is not None and found["high"] is not None and found["low"] < 1.1 < found["high"]


@pytest.mark.parametrize(("mean", "hidden"), [(0.2, 0.3), (0.05, 0.1)])
def test_few_dark_counts_are_judged_by_their_own_law(mean: float, hidden: float) -> None:
    """Half as many again of 0.2 counts in each of 4,096 pixels: 14 sigma of all of them, and nothing in one."""
    dark = [sp.Capture("dark", "tr", dark=True, exposure=1.0)]
    stated = sensor(side=64, dark=mean)
    fit = sp.fit(
        stated, sp.simulate(sensor(side=64, dark=hidden), dark, seed=1), per_pixel=["dark_counts.rate"], jobs=1
    )
    assert fit.verdict == "explained" and fit.steps[0].significance > 8
    right = [sp.fit(stated, sp.simulate(stated, dark, seed=k), per_pixel=["dark_counts.rate"], jobs=1) for k in (2, 3)]
    assert all(one.verdict == "adequate" and abs(one.steps[0].significance) < 4 for one in right)


def test_afterpulses_of_the_model_are_no_other_dark_rates() -> None:
    after = sp.effects.Afterpulsing(probability=0.05, lifetime=100e-9)
    dark = [sp.Capture("dark", "tr", dark=True, exposure=1.0)]
    stated = sensor(after, side=64, dark=200.0)
    for seed in (1, 2):
        fit = sp.fit(stated, sp.simulate(stated, dark, seed=seed), per_pixel=["dark_counts.rate"], jobs=1)
        assert fit.verdict == "adequate", (fit.misfit, fit.steps[0].significance)
