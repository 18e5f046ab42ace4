"""Right models at the ends of what a sensor counts: nothing detected, all frames, counters or the bus full."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import laws
import numpy as np
import pytest

import spadmnist as sp
from spadmnist.effects import Conditions, Effect
from spadmnist.effects.readout_loss import ReadoutLoss, _taken
from spadmnist.events import Layout
from spadmnist.inference import comparison
from spadmnist.inference.light_levels import closed_form, in_counters
from spadmnist.measurement import in_memory
from spadmnist.recording import Capture

PHOTON = 6.62607015e-34 * 299792458.0 / 500e-9  # J
PIXEL = 25e-12  # m^2
LIT = {"wavelength": 500e-9, "relative_uncertainty": 0.02}
FRAME = 10e-6  # s


def sensor(*more: Effect, side: int = 4, dark: float = 100.0, ticks: bool = True) -> sp.Sensor:
    effects: list[Effect] = [sp.effects.Detection(pdp=0.3), sp.effects.DeadTime(duration=50e-9), *more]
    effects += [sp.effects.DarkCounts(rate=dark)] if dark else []
    effects += [sp.effects.Tdc(resolution=1e-10)] if ticks else []
    return sp.Sensor(Layout(side, side, PIXEL, 1.0), effects, rules="device")


def irradiance(rate: float) -> float:
    """W/m^2 that gives a pixel so many detections/s, without a dead time."""
    return rate / 0.3 * PHOTON / PIXEL


def lit(id: str, modality: Any, rate: float, **more: Any) -> Capture:
    return sp.Capture(id, modality, irradiance=irradiance(rate), **LIT, **more)


FRAMES = {"frames": 1000, "frame_time": FRAME}
COUNTER = {**FRAMES, "bits": 4, "counting": "counter"}
BUS = ReadoutLoss(service_time=1e-6, queue=4.0)
RIGHT: dict[str, tuple[sp.Sensor, list[Capture]]] = {
    "no stamp": (
        sensor(dark=0.0),
        [sp.Capture("dark", "tr", dark=True, exposure=1.0), lit("f", "tr", 1e6, exposure=1e-3)],
    ),
    "no frame": (sensor(dark=0.0, ticks=False), [sp.Capture("dark", "qis", dark=True, **FRAMES)]),
    "no first stamp": (sensor(dark=0.0), [sp.Capture("dark", "str", dark=True, **FRAMES)]),
    "every bit is 1": (sensor(ticks=False), [lit("f", "qis", 3e6, **FRAMES)]),
    "8.5 in each frame": (sensor(), [lit("f", "str", 8.5e5, **FRAMES)]),
    "19 in each frame": (sensor(), [lit("f", "str", 1.9e6, **FRAMES)]),
    "counters of 15 with 12": (sensor(ticks=False, side=8), [lit("f", "counts", 1.2e6, **COUNTER)]),
    "counters of 15 with 14": (sensor(ticks=False, side=8), [lit("f", "counts", 2e6, **COUNTER)]),
    "counters of 7": (
        sensor(sp.effects.CountSaturation(bits=3), ticks=False),
        [lit("f", "counts", 6e5, **{**COUNTER, "bits": 8})],
    ),
    "sums of 255 that are full": (
        sensor(ticks=False),
        [lit("f", "counts", 8.5e5, frames=255 * 12, frame_time=FRAME, bits=8)],
    ),
    "a bus at 0.8": (sensor(BUS), [lit("f", "tr", 0.8e6 / 16, exposure=2e-2)]),
    "a bus at 1": (sensor(BUS), [lit("f", "tr", 1e6 / 16, exposure=2e-2)]),
    "a bus at 15": (sensor(BUS), [lit("f", "tr", 15e6 / 16, exposure=1e-3)]),
}


@pytest.mark.parametrize("which", RIGHT)
def test_a_right_model_is_adequate(which: str) -> None:
    """Two measurements of each; all of these models had failed with p below 1e-4. False alarms: 1 % of comparisons."""
    model, captures = RIGHT[which]
    for seed in (1, 2):
        found = comparison.compare(model, sp.simulate(model, captures, seed=seed), 0, None, 1, 48)
        assert found.verdict == "adequate", [(c.statistic, c.capture, c.p_value) for c in found.failing]
        comparison.canonical(found)


@pytest.mark.parametrize("which", ["8.5 in each frame", "counters of 15 with 12", "a bus at 1", "a bus at 15"])
def test_half_of_the_light_is_seen_all_the_same(which: str) -> None:
    model, captures = RIGHT[which]
    dim = [dataclasses.replace(c, light=dataclasses.replace(c.light, level=c.light.level / 2)) for c in captures]
    made = sp.simulate(model, dim, seed=3)
    data = in_memory("dim", model.layout, [dataclasses.replace(made.recording(c.id), capture=c) for c in captures])
    assert comparison.compare(model, data, 0, None, 1, 48).verdict == "fails"


@pytest.mark.parametrize("load", [0.0, 0.1, 0.5, 0.8, 1.0, 1.5, 4.0])
@pytest.mark.parametrize("queue", [1, 2, 4, 64])
def test_what_a_bus_takes_is_its_law(load: float, queue: int) -> None:
    """Erlang's 1 / (1 + load) for one place; otherwise against a literal queue of Poisson arrivals."""
    share = _taken(load, float(queue))
    assert 0 < share <= min(1.0, 1 / load if load else 1.0) + 1e-12
    if queue == 1:
        assert share == pytest.approx(1 / (1 + load), rel=1e-12)
        return
    if not load:
        assert share == 1.0
        return
    rng = np.random.default_rng(round(100 * load) + queue)
    shares = []
    for _ in range(100):
        times, leaves, taken = np.cumsum(rng.exponential(1 / load, 1500)), [], 0
        for time in times.tolist():
            leaves = [t for t in leaves if t > time]
            if len(leaves) < queue:
                leaves.append(max(time, leaves[-1] if leaves else time) + 1)
                taken += 1 if time > times[500] else 0  # in equilibrium
        shares.append(taken / 999)
    laws.mean_is(shares, share, laws.FALSE_ALARM / 28, error=2e-3, what="share")


def test_a_very_long_queue_loses_nothing_below_its_ceiling() -> None:
    assert _taken(0.7, 1e6) == 1.0 and _taken(3.0, 1e6) == pytest.approx(1 / 3) and _taken(1e6, 8.0) == 1e-6
    assert _taken(29.0, 4096.0) == pytest.approx(1 / 29, rel=1e-9)  # numbers that become large do not overflow


@pytest.mark.parametrize("slots", [math.inf, 20.0])
def test_what_full_counters_show_is_its_mean(slots: float) -> None:
    rng = np.random.default_rng(2)
    mean, full = np.array([0.5, 4.0, 9.0, 15.0]), np.array([3.0, 3.0, 10.0, 20.0])
    drawn = rng.poisson(mean, (200_000, 4)) if math.isinf(slots) else rng.binomial(20, mean / 20, (200_000, 4))
    expected = in_counters(mean, full, slots)
    for pixel in range(4):
        laws.mean_is(np.minimum(drawn[:, pixel], full[pixel]), float(expected[pixel]), laws.FALSE_ALARM / 8)


def test_the_closed_form_of_a_full_counter_has_its_elasticity() -> None:
    capture = lit("f", "counts", 1e6, **{**COUNTER, "bits": 3})
    form = closed_form(sensor(ticks=False).resolved(), capture)
    assert form(1e7) == pytest.approx(16 * 1000 * 7, rel=0.01)  # 7 is the most
    assert form(1e3) / form(5e2) == pytest.approx((1e3 * 0.3 + 100) / (5e2 * 0.3 + 100), rel=1e-3)


@pytest.mark.parametrize("kept", [0, 1, 5, 20])
@pytest.mark.parametrize("rate", [0.0, 1e5])
def test_a_capture_with_hardly_a_detection_fails(kept: int, rate: float) -> None:
    """What the model expects and the data lack is a check that fails, not an error of the program."""
    model = sensor(side=8)
    capture = lit("flat", "tr", rate, exposure=1e-3) if rate else sp.Capture("dark", "tr", dark=True, exposure=0.1)
    one = sp.simulate(model, [capture], seed=1).recording(capture.id)
    assert one.events is not None and len(one.events) > 100
    few = one.events.keep(np.arange(len(one.events)) < kept)
    data = in_memory("empty", model.layout, [dataclasses.replace(one, events=few, _kept={})])
    found = comparison.compare(model, data, 0, None, 1, 48)
    assert found.verdict == "fails"
    comparison.canonical(found)


@pytest.mark.parametrize("resolution", [1e-10, 5e-9])
def test_times_in_seconds_are_compared_on_the_ticks_of_the_sensor(resolution: float) -> None:
    model = sensor(ticks=False).with_effect(sp.effects.Tdc(resolution=resolution))
    capture = lit("flat", "tr", 1e5, exposure=2e-3)
    one = sp.simulate(model, [capture], seed=2).recording("flat")
    assert one.events is not None and one.tick == resolution
    pixels = np.repeat(np.arange(16), np.diff(one.events.offsets))
    plain = sp.Capture("flat", "tr", irradiance=irradiance(1e5), exposure=2e-3, **LIT)
    data = sp.Measurement.from_arrays(model.layout, {plain: (one.events.times, pixels)})
    assert np.array_equal(data.recording("flat", model).events.ticks, one.events.ticks)  # type: ignore[union-attr]
    assert comparison.compare(model, data, 0, None, 1, 48).verdict == "adequate"


def test_captures_with_several_uncertainties_are_judged_by_their_own() -> None:
    """Light that is 3 % too bright: of a level that is known exactly it is an error, of one to 5 % it is none."""
    conditions = Conditions(1.0, 1, 1.0, 1.0, 500e-9)

    def level(uncertainty: float) -> tuple[Capture, float, float, float]:
        light = dataclasses.replace(lit("f", "tr", 1e5, exposure=1.0).light, relative_uncertainty=uncertainty)
        return Capture(f"to {uncertainty:g}", "tr", light, conditions), 0.03, 0.005, 1.0

    def p_values(*uncertainties: float) -> list[float]:
        _, checks = comparison.light_of([level(x) for x in uncertainties], [])
        return [check.p_value for check in checks]

    light, known, loose = p_values(0.0, 0.05)
    assert known < 1e-8 and loose > 0.05 and light > 0.05
    assert p_values(0.05, 0.05)[0] > 0.05 and p_values(0.0, 0.0)[0] < 1e-8
    # the covariance of two captures by hand: 0.05^2 and 0.025^2, of which the factor is common
    light, *_ = p_values(0.05, 0.025)
    weight = 1 / 0.005**2
    best = (0.03 + 0.03 * 0.5) / (1 + 0.25)
    z = best / math.hypot(0.05, 1 / math.sqrt(weight * 1.25))
    assert light == pytest.approx(math.erfc(z / math.sqrt(2)), rel=1e-9)
