"""Closed forms of the mean against the simulation where effects meet: gates and dead times, frames and gaps."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import laws
import numpy as np
import pytest

import spadmnist as sp
from spadmnist import plugins
from spadmnist.effects import Conditions
from spadmnist.inference.closed_forms import closed_form, error_by_causes, in_frames
from spadmnist.inference.mean_alone import of_mean
from spadmnist.streams import Streams

PIXELS = 64
effects = sp.effects


def sensor(*some: Any) -> sp.Sensor:
    return sp.Sensor(sp.Layout(8, 8, 25e-12, 1.0), [effects.Detection(pdp=1.0), *some], rules="device")


def made(model: sp.Sensor, conditions: Conditions, photons: float, readout: str, images: int = 1) -> Any:
    light = np.full((images, PIXELS), photons)
    return model.expose(light, conditions, Streams(3, "means", "t", np.arange(images, dtype=np.uint64)), (readout,))


def share_of_frames(model: sp.Sensor, conditions: Conditions, photons: float, images: int = 1) -> tuple[float, int]:
    """(share of frames with a detection, how many frames there were)"""
    found = made(model, conditions, photons, "qis", images).frames.unpacked()
    return float(found.mean()), found.size


@pytest.mark.parametrize("paralyzable", [False, True])
@pytest.mark.parametrize(
    ("frame", "opening", "dead", "rate", "within"),
    [  # ns, 1/s
        (100, 10, 50, 1e8, 0.01),
        (100, 10, 50, 1e9, 0.002),
        (100, 30, 50, 1e8, 0.01),
        (1000, 100, 100, 1e7, 0.01),
        (1000, 500, 100, 1e8, 0.003),
        (10_000, 2000, 100, 1e7, 0.003),
        (100, 60, 50, 1e8, 0.05),  # the dead time outlasts the closed time
        (100, 60, 80, 3e7, 0.06),
    ],
)
def test_what_a_gate_lets_through_beside_a_dead_time(
    frame: float, opening: float, dead: float, rate: float, within: float, paralyzable: bool
) -> None:
    """Of 2,000 frames of 64 pixels; a pixel opens alive where the closed time is longer than the dead time."""
    gated = sensor(
        effects.DeadTime(duration=dead * 1e-9, paralyzable=paralyzable), effects.ShortGate(fraction=opening / frame)
    )
    c = Conditions(2000 * frame * 1e-9, 2000, frame * 1e-9, frame * 1e-9, 500e-9)
    light = np.full((1, PIXELS), rate)
    found = len(made(gated, c, rate, "tr").tr) / PIXELS
    assert gated.expected(light, c)[1].mean() == pytest.approx(found, rel=within)
    events = rate * opening * 1e-9 * 2000
    assert gated.expected(light, c)[0].mean() == pytest.approx(events)
    assert gated.expected(light, c, first=True)[0].mean() == pytest.approx(events)


@pytest.mark.parametrize("paralyzable", [False, True])
def test_a_gate_of_many_pixels_is_that_of_few(paralyzable: bool) -> None:
    """Of many pixels alike but for their light, the means are read off a table."""
    some = [effects.DeadTime(duration=1e-6, paralyzable=paralyzable), effects.ShortGate(fraction=0.95)]
    c = Conditions(1e-3, 100, 10e-6, 10e-6, 500e-9)
    rates = np.geomspace(1e3, 3e7, 64 * 64)
    many = sp.Sensor(sp.Layout(64, 64, 25e-12, 1.0), [effects.Detection(pdp=1.0), *some], rules="device")
    found = many.expected(rates[None], c)[1][0, ::64]
    assert found == pytest.approx(sensor(*some).expected(rates[None, ::64], c)[1][0], rel=3e-4)


def counter_of(frames: int, frame_time: float, rate: float, period: float | None = None, bits: int = 16) -> sp.Capture:
    light = {"wavelength": 500e-9, "irradiance": rate / (25e-12 / 3.97289171e-19)}  # photons/s on a pixel
    clock = {"frames": frames, "frame_time": frame_time, "frame_period": period or frame_time}
    return sp.Capture("one", "counts", **light, **clock, bits=bits, counting="counter")


def total_and_closed_form(
    model: sp.Sensor, capture: sp.Capture, rate: float, images: int = 1
) -> tuple[float, float, float]:
    """(simulated detections of an image, their standard error, those of the closed form).

    By a bound of 5 standard errors a right mean fails with 6e-7.
    """
    found = made(model.resolved(), capture.conditions, rate, capture.modality, images)
    counts = found.counts if capture.modality == "tr" else found.tally
    totals = np.asarray(counts, np.int64).reshape(images, -1).sum(axis=1)
    error = math.sqrt(totals.mean() / images) if images < 9 else totals.std(ddof=1) / math.sqrt(images)
    return float(totals.mean()), float(error), closed_form(model.resolved(), capture)(rate)


@pytest.mark.parametrize("paralyzable", [False, True])
@pytest.mark.parametrize("rules", ["device", "paper"])
@pytest.mark.parametrize(("rate", "gap"), [(1e7, 1e-6), (1e8, 1e-6), (1e8, 0.2e-6)])
def test_frames_of_a_counter_begin_alive_behind_a_gap(rate: float, gap: float, rules: str, paralyzable: bool) -> None:
    """Of 1000 frames of 64 pixels; by the paper's rules pixels fire in the gaps, and the dead time runs on."""
    model = sp.Sensor(
        sp.Layout(8, 8, 25e-12, 1.0),
        [effects.Detection(pdp=1.0), effects.DeadTime(duration=100e-9, paralyzable=paralyzable)],
        rules,
    )
    total, error, expected = total_and_closed_form(model, counter_of(1000, 1e-6, rate, 1e-6 + gap), rate)
    assert expected == pytest.approx(total, abs=5 * error)


def test_a_mean_alone_of_a_light_that_swings_behind_a_gate_is_that_of_the_simulation() -> None:
    """The dead time is that at the rate of each moment."""
    swinging = effects.Flicker(amplitude=0.8, frequency=10_030.0)
    gated = sensor(effects.DeadTime(duration=50e-9), effects.ShortGate(fraction=0.1), swinging)
    capture = counter_of(100, 20e-6, 2e7)
    found = float(sp.simulate(gated, [capture], seed=4)["one"].counts.sum())
    null, _ = of_mean(gated, capture, found, 64)
    assert closed_form(gated, capture)(null.level) > 1.05 * found  # without the correction
    assert float(null.totals.mean()) == pytest.approx(found, rel=0.01)


@pytest.mark.parametrize(("frame_time", "modality"), [(1.0, "counts"), (1.0, "tr"), (1e-2, "counts")])
def test_a_mean_alone_of_a_large_array_takes_seconds(frame_time: float, modality: str) -> None:
    """One frame cannot be cut short; a part of the pixels can, or the correction is left to the scatter."""
    some = [effects.Detection(pdp=1.0), effects.DeadTime(duration=2e-6), effects.SourceNoise(contrast=0.3)]
    large = sp.Sensor(sp.Layout(256, 256, 25e-12, 1.0), some, rules="device")
    capture = counter_of(1, frame_time, 4e4 if frame_time == 1.0 else 1e6)
    if modality == "tr":
        light = {"wavelength": 500e-9, "irradiance": 4e4 / (25e-12 / 3.97289171e-19)}
        capture = sp.Capture("one", "tr", **light, exposure=frame_time)
    started = time.process_time()
    null, _ = of_mean(large, capture, 4e4 * 65536, 64)
    assert time.process_time() - started < 30 and np.all(np.isfinite(null.totals))


def test_a_mean_alone_of_many_stamps_is_corrected_by_few() -> None:
    """Its scatter does not grow with the exposure: a part of that is simulated, however many stamps it has."""
    blinking = effects.BlinkingDarkCounts(fraction=1.0, amplitude=2e5, rate_on=1e5, rate_off=1e5)
    bright = sensor(effects.DarkCounts(rate=1e5), blinking, effects.DeadTime(duration=1e-6))
    for exposure in (0.05, 1.0):
        capture = sp.Capture("dark", "tr", dark=True, exposure=exposure)
        null, _ = of_mean(bright, capture, 1e5 * exposure * PIXELS, 64)
        assert null.dispersion_at(1.0, 0.0) == 1.0 and float(np.std(np.log(null.totals))) < 0.01


@pytest.mark.parametrize("period", [10e-3, 20e-3, 3.3e-3])
def test_flicker_in_frames_is_seen_where_they_are(period: float) -> None:
    """Frames at the frequency of the mains see always the same phase of it."""
    swinging = sensor(effects.Flicker(amplitude=0.3, frequency=100.0, phase=math.pi / 2))
    c = Conditions(200 * period, 200, 10e-6, period, 500e-9)
    share, trials = share_of_frames(swinging, c, 1e4, 10)
    expected = float(in_frames(swinging, np.full((1, PIXELS), 1e4), c).mean())
    laws.share_is(round(share * trials), trials, expected)
    steady = -math.expm1(-0.1)
    assert (abs(expected / steady - 1) > 0.2) == (period != 3.3e-3)


def test_flicker_over_the_whole_exposure_is_the_mean_of_its_curve() -> None:
    slow = effects.Flicker(amplitude=0.5, frequency=7.3, phase=1.1)
    c = Conditions(0.05, 1, 0.05, 0.05, 500e-9)
    times = (np.arange(100_000) + 0.5) / 100_000 * c.exposure
    assert slow.expected_rate(np.ones((1, 1)), c)[0, 0] == pytest.approx(slow.factor(times, c).mean(), rel=1e-9)


GATE = effects.ShortGate(fraction=0.5)
SLOW_TRAPS = effects.SlowAfterpulsing(probability=0.1, lifetime=5e-6)
FEW_TRAPS, BLIND = effects.Afterpulsing(probability=0.02, lifetime=5e-6), effects.DeadTime(duration=50e-9)


def stamps_of(exposure: float, rate: float) -> sp.Capture:
    light = {"wavelength": 500e-9, "irradiance": rate / (25e-12 / 3.97289171e-19)}
    return sp.Capture("one", "tr", **light, exposure=exposure)


@pytest.mark.parametrize(
    ("some", "capture", "rate"),
    [
        ([effects.Flicker(amplitude=0.5, frequency=1e5), GATE], counter_of(100, 1e-5, 1.0), 4e6),
        ([effects.SourceDrift(slope=0.5), GATE], stamps_of(1e-3, 1.0), 4e6),
        ([effects.Flicker(amplitude=1.0, frequency=1e3), effects.SourceDrift(slope=2.0)], stamps_of(1e-3, 1.0), 4e6),
    ],
)
def test_the_mean_of_curves_and_gates_is_that_of_their_product(
    some: list[Any], capture: sp.Capture, rate: float
) -> None:
    """A factor that is large while the gate is open, or with another one."""
    total, error, expected = total_and_closed_form(sensor(*some), capture, rate)
    assert expected == pytest.approx(total, abs=5 * error)


def test_the_mean_of_a_curve_in_many_openings_is_its_integral() -> None:
    """Of a flicker that slips through the frames, and whose mean over the whole exposure is another."""
    flicker, gate = effects.Flicker(amplitude=0.5, frequency=1.0371e5), effects.ShortGate(fraction=0.37)
    for c in (counter_of(300, 1e-5, 1.0).conditions, counter_of(300, 1e-5, 1.0, 3e-5).conditions.within_frames):
        within = (np.arange(500) + 0.5) / 500 * 0.37 * c.frame_time
        times = np.add.outer(np.arange(300) * c.frame_period, within).ravel()
        events = 1e6 * 300 * 0.37 * c.frame_time * flicker.factor(times, c).mean()
        assert sensor(flicker, gate).expected(np.full((1, PIXELS), 1e6), c)[1] == pytest.approx(events, rel=4e-4)


@pytest.mark.parametrize("traps", [FEW_TRAPS, SLOW_TRAPS])
@pytest.mark.parametrize("dead_times", [1.0, 5.0])
def test_detections_alone_fill_traps(traps: Any, dead_times: float) -> None:
    """Of so many events in a dead time, most of which are lost."""
    rate = dead_times / 50e-9
    total, error, expected = total_and_closed_form(sensor(BLIND, traps), stamps_of(1e-3, rate), rate, 10)
    assert expected == pytest.approx(total, abs=5 * error)


def test_short_traps_find_their_pixel_awake_more_often() -> None:
    """Within the error that is stated, a fifth of the square of their number."""
    rate, short = 1 / 50e-9, effects.Afterpulsing(probability=0.1, lifetime=20e-9)
    capture = stamps_of(1e-3, rate)
    total, error, expected = total_and_closed_form(sensor(BLIND, short), capture, rate, 10)
    assert error_by_causes(sensor(BLIND, short).resolved(), capture) == pytest.approx(0.002)
    assert expected == pytest.approx(total, abs=5 * error + 0.002 * total)
    assert abs(sensor(BLIND, SLOW_TRAPS).expected(np.full((1, PIXELS), rate), capture.conditions)[1].sum() - total) > (
        0.01 * total
    )


@pytest.mark.parametrize("rules", ["device", "paper"])
@pytest.mark.parametrize(
    ("causing", "gate", "period"),
    [
        (SLOW_TRAPS, 0.5, 1e-5),
        (effects.Afterpulsing(probability=0.3, lifetime=5e-6), 0.1, 1e-5),
        (SLOW_TRAPS, 1.0, 2e-5),
        (effects.Crosstalk(probability=0.02, delay=1e-6), 0.1, 1e-5),
    ],
)
def test_what_is_caused_while_nothing_is_recorded_is_not_expected(
    causing: Any, gate: float, period: float, rules: str
) -> None:
    """By the paper's rules pixels fire in the gaps between frames, and what comes out of them makes up for the loss."""
    some = [effects.Detection(pdp=1.0), causing, effects.ShortGate(fraction=gate)]
    model = sp.Sensor(sp.Layout(8, 8, 25e-12, 1.0), some, rules)
    total, error, expected = total_and_closed_form(model, counter_of(1000, 1e-5, 1.0, period), 1e6, 10)
    assert expected == pytest.approx(total, abs=5 * error)


@pytest.mark.parametrize(
    ("load", "gate", "within"), [(0.3, 0.5, 0.0), (2.0, 0.1, 0.02), (2.0, 0.5, 0.03), (6.0, 0.5, 0.0)]
)
def test_a_bus_that_empties_while_a_gate_is_closed(load: float, gate: float, within: float) -> None:
    """Of 16 that wait; the closed form is a rough one there, and says so: a mean alone is corrected by simulation."""
    model = sensor(effects.ReadoutLoss(service_time=100e-9, queue=16.0), effects.ShortGate(fraction=gate))
    c, rate = Conditions(1e-3, 100, 10e-6, 10e-6, 500e-9), load / 100e-9 / PIXELS
    found = made(model, c, rate, "tr", 10).counts.sum() / 10
    expected = float(model.resolved().expected(np.full((1, PIXELS), rate), c)[1].sum())
    assert expected == pytest.approx(found, abs=5 * math.sqrt(found / 10) + within * found)
    assert not model.resolved().states_mean and model.resolved().without("short_gate").states_mean


WARMING = '''
import numpy as np
from spadmnist.effects import Effect, parameter


class Zwarming(Effect, stage="arrival"):
    """A part of the dark counts."""

    acts_on = "dark"
    share = parameter(0.5, "", "factor", bounds=(0, 1), off=1.0)

    def factor(self, t, conditions):
        return np.full(np.shape(t), self.share)

    def maximum(self, conditions):
        return 1.0
'''


def test_what_acts_on_dark_counts_leaves_rates_of_other_effects(tmp_path: Path) -> None:
    (tmp_path / "zwarming.py").write_text(WARMING)
    plugins.load_file(tmp_path / "zwarming.py")
    blinking = effects.BlinkingDarkCounts(fraction=1.0, amplitude=1000.0, rate_on=1e4, rate_off=1e4)
    both = sensor(effects.DarkCounts(rate=100.0), blinking, effects.Effect.registry.find("zwarming")())
    c = Conditions(1.0, 1, 1.0, 1.0, None)
    expected = both.expected(np.zeros((1, PIXELS)), c)[0].mean()
    assert expected == pytest.approx(50 + 500)
    assert abs(len(made(both, c, 0.0, "tr").tr) / PIXELS - expected) < 0.05 * expected


def test_dead_times_that_are_carried_over_do_not_say_their_mean() -> None:
    assert not effects.FrameCarryOver.states_mean
    slow = sensor(effects.DeadTime(duration=500e-9), effects.FrameCarryOver(share=1.0))
    capture = sp.Capture(
        "one", "qis", wavelength=500e-9, irradiance=1e6 / (25e-12 / 3.97289171e-19), frames=4000, frame_time=1e-6
    )
    twin = float(sp.simulate(slow, [capture], seed=4)["one"].counts.sum())
    null, _ = of_mean(slow, capture, twin, 64)
    assert closed_form(slow, capture)(null.level) > 1.02 * twin
    assert float(null.totals.mean()) == pytest.approx(twin, rel=5e-3)
