"""A part of a sensor is what the whole chip does there: its maps, draws and light, and what comes from outside."""

from __future__ import annotations

import ast
import json
import re
import shlex
from pathlib import Path
from typing import Any

import commands
import laws
import numpy as np
import pytest

from spadmnist import config, measurement, plugins, sensor_file, twin
from spadmnist.effects import Chip, Conditions, Effect, parameter
from spadmnist.errors import EffectError, InputError
from spadmnist.events import Events, Layout
from spadmnist.inference import candidates
from spadmnist.inference.candidates import on_chip, with_values
from spadmnist.inference.coordinates import Key
from spadmnist.inference.models import InTheDark
from spadmnist.inference.point_process import blur_of
from spadmnist.inference.replicate_cache import entry_name
from spadmnist.plugins import Distribution
from spadmnist.recording import Capture, Light
from spadmnist.sensor import Sensor
from spadmnist.streams import BLOCK, Streams
from spadmnist.testing import _columns, _same, check_effect, strong
from spadmnist.window import Window, parse

OURS = [name for name in Effect.registry if Effect.registry.find(name).__module__.startswith("spadmnist.")]
ALL = ("tr", "str", "qis", "counts")
CLOCK = Conditions(1e-3, 60, 12e-6, 16e-6, 555e-9, bits=2)
GRID = Layout(12, 10, 25e-12, 1.0)
PLACED = Layout(1, 60, 25e-12, 1.0, np.random.Generator(np.random.PCG64(1)).random((60, 2)) * 1e-4)
PARTS = [(GRID, slice(3, 8), slice(6, None)), (GRID, slice(None, 1), slice(2, 3)), (PLACED, slice(None), slice(20, 45))]
PART_NAMES = ["at an edge", "one pixel", "pixels one by one"]
FEW, CHIP = (slice(3, 8), slice(6, None)), 5


def of(name: str, **values: Any) -> Effect:
    made: Effect = Effect.registry.find(name)(**values)
    return made


def chip_with(effect: Effect | None = None, layout: Layout = GRID, rules: str = "device", *more: Effect) -> Sensor:
    """A whole chip, whose parameters are drawn where they can be."""
    usual = [
        of("detection", relative=Distribution("normal", (1.0, 0.1))),
        of("dark_counts", rate=Distribution("lognormal", (5e3, 1.0))),
        of("dead_time", duration=Distribution("normal", (60e-9, 5e-9))),
        of("tdc", resolution=100e-12),
    ]
    known = [e for e in usual if effect is None or e.name != effect.name]
    return Sensor(layout, [*known, *([effect] if effect else []), *more], rules, CHIP, "chip").resolved()


def strongly(name: str) -> Effect:
    """An effect at values at which it shows, drawn over the array where it can be."""
    return of(name, **{key: strong(p) for key, p in Effect.registry.find(name).parameters.items()})


def streams(images: int, name: str = "crop") -> Streams:
    return Streams(1, name, "test", np.arange(images, dtype=np.uint64))


def lit(sensor: Sensor, images: int = 1, photons: float = 2e5) -> np.ndarray:
    return np.full((images, sensor.layout.pixels), photons)


def inside(values: np.ndarray, whole: Sensor, rows: slice, columns: slice) -> np.ndarray:
    """(..., pixels of the window) of (..., pixels)."""
    shape = values.shape[:-1]
    return values.reshape(*shape, *whole.layout.shape)[..., rows, columns].reshape(*shape, -1)


# --- what is fixed: exactly the chip's ------------------------------------------------------------------------------


@pytest.mark.parametrize(("layout", "rows", "columns"), PARTS, ids=PART_NAMES)
@pytest.mark.parametrize("name", OURS)
def test_maps_and_rates_of_a_part_are_the_chips(name: str, layout: Layout, rows: slice, columns: slice) -> None:
    whole = chip_with(strongly(name), layout)
    part = whole.cropped(rows, columns)
    shape = np.empty(layout.shape)[rows, columns].shape
    assert part.layout.shape == shape and part.layout.pixel_area == layout.pixel_area
    for mine, theirs in zip(part.effects, whole.effects, strict=True):
        assert type(mine) is type(theirs)
        for key, declared in mine.parameters.items():
            value, there = getattr(mine, key), getattr(theirs, key)
            if declared.per == "pixel" and np.ndim(there):
                there = inside(there, whole, rows, columns)
            elif declared.per in ("row", "column") and np.ndim(there):
                there = there[rows if declared.per == "row" else columns]
            assert np.array_equal(value, there), f"{mine.name}.{key}"
    assert np.array_equal(part.dead_times, inside(whole.dead_times, whole, rows, columns))
    assert part.tick == whole.tick and part.causes == whole.causes and part.block == whole.block
    for photons, wavelength in ((2e5, 555e-9), (0.0, None)):
        now = Conditions(1e-3, 60, 12e-6, 16e-6, wavelength)
        for one, other in zip(
            (*part.rates(lit(part, 1, photons), now), *part.expected(lit(part, 1, photons), now)),
            (*whole.rates(lit(whole, 1, photons), now), *whole.expected(lit(whole, 1, photons), now)),
            strict=True,
        ):
            assert np.array_equal(one, inside(other, whole, rows, columns))


def test_a_gradient_goes_on_and_begins_nowhere_anew() -> None:
    """1 + x u: the first column of the chip at u = -1/2, the last at 1/2; the part has its right quarter."""
    whole = chip_with(of("illumination_gradient", x=0.8, vignette=0.0), Layout(3, 9, 25e-12, 1.0))
    part = whole.cropped(slice(0, 3), slice(6, 9))
    plain = chip_with(None, Layout(3, 9, 25e-12, 1.0)).cropped(slice(0, 3), slice(6, 9))
    factor = part.rates(lit(part), CLOCK)[1] / plain.rates(lit(plain), CLOCK)[1]
    assert np.allclose(factor.reshape(3, 3), 1 + 0.8 * (np.array([6, 7, 8]) / 8 - 0.5), rtol=1e-12)


def test_light_may_differ_within_the_part_and_goes_on_beyond_it() -> None:
    part = chip_with(of("illumination_gradient", x=0.8)).cropped(*FEW)
    photons = np.linspace(1e4, 1e5, 20)[None]
    flat, uneven = (part.rates(light, CLOCK)[1] for light in (np.ones((1, 20)), photons))
    assert np.allclose(uneven, flat * photons, rtol=1e-12)
    assert part.window is not None
    beyond = np.pad(photons.reshape(5, 4), ((3, 4), (6, 0)), mode="edge")
    assert np.array_equal(part.window.spread(photons), beyond.reshape(1, 120))


def test_widths_of_codes_are_cut_by_pixel_and_shared_ones_stay(tmp_path: Path) -> None:
    each = np.random.Generator(np.random.PCG64(2)).random((120, 7)) + 0.5
    for widths in (each, each[0]):
        part = chip_with(of("tdc_nonlinearity", widths=widths)).cropped(*FEW)
        expected = widths if widths.ndim == 1 else widths.reshape(12, 10, 7)[FEW].reshape(-1, 7)
        assert np.array_equal(part.effect("tdc_nonlinearity").widths, expected)


def test_what_is_drawn_is_the_same_whether_the_sensor_was_resolved_before_or_not() -> None:
    unresolved = Sensor(GRID, [of("dark_counts", rate=Distribution("lognormal", (5e3, 1.0)))], "device", CHIP)
    one, other = unresolved.cropped(*FEW), unresolved.resolved().cropped(*FEW)
    assert np.array_equal(one.rates(lit(one), CLOCK), other.rates(lit(other), CLOCK))


def test_a_part_of_a_part_counts_from_its_corner() -> None:
    whole = chip_with(strongly("blinking_dark_counts"))
    one = whole.cropped(slice(2, 9), slice(3, 9)).cropped(slice(1, 3), slice(-2, None))
    assert str(one.window) == "3:5,7:9"
    assert np.array_equal(
        one.expected(lit(one), CLOCK), whole.cropped(slice(3, 5), slice(7, 9)).expected(lit(one), CLOCK)
    )


def test_another_chip_of_its_kind_draws_for_the_whole_array() -> None:
    whole = chip_with(strongly("blinking_dark_counts"))
    part, other = on_chip(whole.cropped(*FEW), 9), on_chip(whole, 9)
    assert np.array_equal(part.expected(lit(part), CLOCK)[0], inside(other.expected(lit(other), CLOCK)[0], other, *FEW))
    assert not np.array_equal(part.expected(lit(part), CLOCK), whole.cropped(*FEW).expected(lit(part), CLOCK))


# --- what is drawn --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rules", ["paper", "device"])
@pytest.mark.parametrize("name", OURS)
def test_a_window_of_everything_is_the_sensor_itself_bit_for_bit(name: str, rules: str) -> None:
    """As `cropped` gives it, and by the way that parts take."""
    whole = chip_with(strongly(name), rules=rules)
    assert whole.cropped(slice(None), slice(0, 10)) is whole
    through = whole._seen_in(Window.of((12, 10), slice(None), slice(None)))
    images = max(2, whole.block)
    for causes in (False, True):
        photons, own = lit(whole, images), streams(images)
        made = whole.expose(photons, CLOCK, own, ALL, staged=True, causes=causes)
        _same(through.expose(photons, CLOCK, own, ALL, causes=causes), made, f"causes: {causes}")
    counter = Conditions(1e-3, 60, 12e-6, 16e-6, 555e-9, bits=3, counting="counter")
    made = whole.expose(photons, counter, own, ALL, staged=True)
    _same(through.expose(photons, counter, own, ALL), made, "counters")


@pytest.mark.parametrize("rules", ["paper", "device"])
@pytest.mark.parametrize("name", OURS)
def test_a_part_is_made_again_alike_and_image_by_image(name: str, rules: str) -> None:
    part = chip_with(strongly(name), rules=rules).cropped(*FEW)
    images = 2 * part.block if part.block > 1 else 3
    together = part.expose(lit(part, images), CLOCK, streams(images), ALL)
    for start in range(0, images, part.block):
        some = np.arange(start, start + part.block, dtype=np.uint64)
        alone = part.expose(lit(part, part.block), CLOCK, streams(1).of(some), ALL)
        _same(alone, together.images(start, start + part.block), "alone")
    known = _columns(part.expose(lit(part, images), CLOCK, streams(images), ALL, causes=True))
    assert all(np.array_equal(known[key], column) for key, column in _columns(together).items())


def test_each_pixel_has_the_mean_of_its_place_on_the_chip() -> None:
    """Poisson totals of 20 pixels against the whole chip's rates; false alarms: 1e-6 in all."""
    patterns = [of(f"{line}_pattern", gain=Distribution("normal", (1.0, 0.3))) for line in ("row", "column")]
    gradient = of("illumination_gradient", x=1.0, y=-0.6, vignette=0.2)
    dark = of("dark_counts", rate=Distribution("lognormal", (2e4, 1.0)))
    whole = Sensor(GRID, [of("detection"), dark, gradient, *patterns], "device", CHIP).resolved()
    part = whole.cropped(*FEW)
    expected = inside(whole.rates(lit(whole), CLOCK)[0][0], whole, *FEW) * CLOCK.exposure * 400
    counts = part.expose(lit(part, 400), CLOCK, streams(400), ("tr",)).counts
    assert counts is not None
    for total, mean in zip(counts.reshape(400, 20).sum(axis=0), expected, strict=True):
        laws.poisson_mean(int(total), float(mean), laws.FALSE_ALARM / 20)


# --- what comes from outside ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("rules", ["paper", "device"])
@pytest.mark.parametrize("layout", [GRID, PLACED], ids=["grid", "pixels one by one"])
def test_a_hot_pixel_beside_the_window_causes_crosstalk_in_it(layout: Layout, rules: str) -> None:
    """Its neighbour's detections: as many as on the whole chip, and many more than it has by itself."""
    crosstalk = of("crosstalk", probability=0.05, reach=1.5)
    rows, columns = (slice(3, 8), slice(6, None)) if layout is GRID else (slice(None), slice(20, 45))
    number = np.arange(layout.pixels).reshape(layout.shape)
    window, places = number[rows, columns].ravel(), layout.places
    apart = np.hypot(*(places[:, None] - places[window][None]).transpose(2, 0, 1))
    apart[window] = np.inf
    hot, target = np.unravel_index(int(np.argmin(apart)), apart.shape)
    assert apart[hot, target] < 1.5 and hot not in window
    rate = np.full(layout.pixels, 1e3)
    rate[hot] = 1e6
    whole = Sensor(layout, [of("dark_counts", rate=rate), crosstalk], rules).resolved()
    part = whole.cropped(rows, columns)
    dark = Conditions(1e-3, 100, 1e-5, 1e-5, None)
    seen, there = (
        one.expose(lit(one, 300, 0.0), dark, streams(300, one.name), ("tr",)).counts for one in (part, whole)
    )
    assert seen is not None and there is not None
    mine = int(seen.reshape(300, -1)[:, target].sum())
    laws.same_poisson(mine, 300, int(there.reshape(300, -1)[:, window[target]].sum()), 300)
    assert mine > 5 * 300  # without the hot one 1 in each image


def test_no_more_pixels_are_simulated_than_can_matter() -> None:
    """By the paper's rules one hop, by a device's two; a shared bus has all pixels, and shows in TR alone."""
    numbers = {}
    effects = {"none": of("afterpulsing"), "near": of("crosstalk"), "bus": strongly("readout_loss")}
    for rules in ("paper", "device"):
        for name, effect in effects.items():
            whole = chip_with(effect, Layout(40, 40, 25e-12, 1.0), rules)
            window = Window.of((40, 40), slice(10, 20), slice(0, 10))
            for readout in ("tr", "qis"):
                numbers[rules, name, readout] = int(whole.lively(window, (readout,)).sum())
    assert numbers == {
        **{(rules, "none", readout): 100 for rules in ("paper", "device") for readout in ("tr", "qis")},
        **{("paper", "near", readout): 12 * 11 for readout in ("tr", "qis")},
        **{("device", "near", readout): 16 * 13 for readout in ("tr", "qis")},
        **{(rules, "bus", "tr"): 1600 for rules in ("paper", "device")},
        **{(rules, "bus", "qis"): 100 for rules in ("paper", "device")},
    }


def test_what_will_be_simulated_is_told_with_the_pixels_around() -> None:
    whole = chip_with(of("readout_loss", service_time=1e-9, queue=64.0))
    part = whole.cropped(*FEW)
    assert part.drawn(lit(part), CLOCK, ("tr",)) == pytest.approx(whole.expected(lit(whole), CLOCK)[0].sum())
    assert part.drawn(lit(part), CLOCK, ("qis",)) == pytest.approx(part.expected(lit(part), CLOCK)[0].sum())


def test_pixels_around_the_window_load_the_bus() -> None:
    """The bus is overloaded by the whole chip, not by the window: it loses there as much as on the whole chip."""
    bus = of("readout_loss", service_time=20e-9, queue=4.0)
    effects = [of("detection"), bus]
    whole = Sensor(GRID, effects, "device").resolved()
    part, alone = whole.cropped(*FEW), Sensor(Layout(5, 4, 25e-12, 1.0), effects, "device").resolved()
    totals = []
    for number, one in enumerate((part, whole, alone)):
        counts = one.expose(lit(one, 200, 2e6), CLOCK, streams(200, str(number)), ("tr",)).counts
        assert counts is not None
        counts = counts.reshape(200, -1)
        totals.append((inside(counts, whole, *FEW) if one is whole else counts).sum(axis=1))
    laws.same_mean(totals[0], totals[1])
    assert totals[2].mean() > 1.5 * totals[0].mean()


# --- effects of others ----------------------------------------------------------------------------------------------


def strangers() -> list[Effect]:
    """Effects of somebody's file, which know of the whole array and nothing of windows."""

    class Stain(Effect, stage="light"):
        """Dust, drawn for the chip, on top of a map."""

        haze = parameter(0.5, "", "share that is lost", bounds=(0, 1), off=0.0, per_pixel=True)

        def made(self, chip: Chip) -> None:
            self._dust = chip.generator().random(chip.layout.pixels) * (np.arange(chip.layout.pixels) > 3)

        def apply(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
            return rate * (1 - np.asarray(self.haze)) * self._dust

    class Lag(Effect, stage="dead_time"):
        """Each pixel is blind for as many ns as its number."""

        def made(self, chip: Chip) -> None:
            self._time = 1e-9 * np.arange(chip.layout.pixels)

        def blind_time(self) -> np.ndarray:
            return self._time

    class Numbers(Effect, stage="timing"):
        """A stamp tells the pixel's number, in units of 10 ns."""

        def apply(self, events: Events, rng: np.random.Generator) -> Events:
            return events.moved(events.pixel * 1e-8)

    class Rungs(Effect, stage="readout"):
        """A count tells the pixel's number."""

        def limit(self, counts: np.ndarray) -> np.ndarray:
            pixels = np.arange(120, dtype=counts.dtype)
            return np.broadcast_to(np.tile(pixels, len(counts) // 120)[:, None], counts.shape).copy()

    class Odd(Effect, stage="arrival"):
        """Dark counts come in odd pixels alone."""

        acts_on = "dark"

        def maximum(self, conditions: Conditions) -> float:
            return 1.0

        def modulate(self, events: Events, conditions: Conditions, rng: np.random.Generator) -> np.ndarray:
            return (events.pixel % 2).astype(np.float64)

    return [Stain(haze=Distribution("normal", (0.3, 0.1))), Lag(), Numbers(), Rungs(), Odd()]


def test_an_effect_that_knows_nothing_of_windows_sees_the_whole_chip() -> None:
    stain, lag, numbers, rungs, odd = strangers()
    whole = Sensor(GRID, [of("dark_counts", rate=5e4), stain, lag, numbers, rungs, odd], "device", CHIP).resolved()
    part = whole.cropped(*FEW)
    number = np.arange(120).reshape(12, 10)[FEW].ravel()
    assert np.array_equal(part.rates(lit(part), CLOCK)[1], inside(whole.rates(lit(whole), CLOCK)[1], whole, *FEW))
    assert np.array_equal(part.effect("stain").haze, inside(whole.effect("stain").haze, whole, *FEW))
    assert np.array_equal(part.dead_times, 1e-9 * number)
    made = part.expose(lit(part, BLOCK), CLOCK, streams(BLOCK), ALL)
    assert made.tr is not None and made.frames is not None and made.frames.first is not None
    assert len(made.tr) > 1000 and np.allclose(made.tr.times, 1e-8 * np.tile(number, BLOCK)[made.tr.rows])
    first = made.frames.first
    assert np.allclose(first.times, 1e-8 * np.tile(number, BLOCK)[first.rows])
    assert made.tally is not None and np.array_equal(made.tally[:, 0], np.tile(number, BLOCK))
    dark = Sensor(GRID, [of("dark_counts", rate=5e4), odd], "device").resolved().cropped(*FEW)
    counts = dark.expose(lit(dark, BLOCK, 0.0), CLOCK, streams(BLOCK), ("tr",)).counts
    assert counts is not None and np.array_equal(counts.reshape(BLOCK, 20).sum(axis=0) > 0, number % 2 == 1)


ACROSS = """
import numpy as np
from spadmnist import Children, Effect

class Across(Effect, stage="correlated"):
    \"""Pixel 0 fires the last one, on the other side of the chip.

    Source: none.
    \"""

    def spawn(self, events, rng):
        parent = np.flatnonzero((events.pixel == 0) & (events.pixels > 1))
        rows = np.searchsorted(events.offsets, parent, side="right") - 1
        return Children(parent, np.full(len(parent), 1e-9), rows + events.pixels - 1)

class Denied(Across, stage="correlated"):
    \"""The same, but it is said to stay near.

    Source: none.
    \"""

    def influence(self):
        return 0.0
"""


def test_correlated_events_of_others_come_from_everywhere_unless_they_say_how_far(tmp_path: Path) -> None:
    (tmp_path / "across.py").write_text(ACROSS)
    plugins.load_file(tmp_path / "across.py")
    rate = np.zeros(120)
    rate[0] = 1e5
    for name, comes in (("across", True), ("denied", False)):
        whole = Sensor(GRID, [of("dark_counts", rate=rate), of(name)], "device").resolved()
        last = whole.cropped(slice(11, 12), slice(9, 10))
        counts = last.expose(lit(last, BLOCK, 0.0), CLOCK, streams(BLOCK), ("tr",)).counts
        assert counts is not None and bool(counts.sum()) is comes
    check_effect("across")
    with pytest.raises(AssertionError, match=r"denied, influence: .* 9\.9 pitches away, but influence\(\) is 0"):
        check_effect("denied")


def test_how_much_stamps_scatter_is_asked_of_the_whole_chip() -> None:
    class Late(Effect, stage="timing"):
        """Every pixel has a delay of its own."""

        counted = True

        def made(self, chip: Chip) -> None:
            self._delay = 1e-12 * np.arange(chip.layout.pixels)

        def apply(self, events: Events, rng: object) -> Events:
            return events.moved(events.times + np.repeat(self._delay, events.counts))

    whole = Sensor(GRID, [of("dark_counts"), Late()], "device").resolved()
    assert blur_of(whole.cropped(*FEW)) == blur_of(whole)


def test_how_far_an_effect_says_to_reach_must_be_a_distance() -> None:
    class Lost(Effect, stage="dark"):
        """Nothing."""

        def apply(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
            return rate

        def influence(self) -> float:
            return -1.0

    part = chip_with(Lost()).cropped(*FEW)
    with pytest.raises(EffectError, match=r"lost: influence must return pitches.* -1"):
        part.expose(lit(part), CLOCK, streams(1), ("tr",))


# --- other values in the window -------------------------------------------------------------------------------------


def test_a_map_of_the_window_leaves_the_rest_of_the_chip_as_it_is() -> None:
    whole = chip_with(of("row_pattern", gain=Distribution("normal", (1.0, 0.1))))
    part, found = whole.cropped(*FEW), np.linspace(1e2, 1e4, 20)
    new = with_values(part, {("dark_counts", "rate"): found, ("row_pattern", "gain"): np.full(5, 2.0)})
    assert new.chip is not None and new.window == part.window
    rate = whole.effect("dark_counts").rate.reshape(12, 10).copy()
    rate[FEW] = found.reshape(5, 4)
    assert np.array_equal(new.chip.effect("dark_counts").rate, rate.ravel())
    gain = whole.effect("row_pattern").gain.copy()
    gain[3:8] = 2.0
    assert np.array_equal(new.chip.effect("row_pattern").gain, gain)
    assert np.array_equal(new.effect("dark_counts").rate, found)
    light = new.rates(lit(new), CLOCK)[1] / part.rates(lit(part), CLOCK)[1]
    before = whole.effect("row_pattern").gain
    assert np.allclose(light.reshape(5, 4), (2.0 / before[3:8])[:, None])
    assert np.array_equal(part.chip.effect("dark_counts").rate, whole.effect("dark_counts").rate)


def test_where_the_chip_has_nothing_else_the_median_of_the_window_stands() -> None:
    part = Sensor(GRID, [of("detection")], "device").resolved().cropped(*FEW)
    found = np.append(np.full(19, 300.0), 1e5)
    new = with_values(part, {("dark_counts", "rate"): found, ("detection", "pdp"): np.full(20, 0.3)})
    assert new.chip is not None
    rate, pdp = new.chip.effect("dark_counts").rate, new.chip.effect("detection").pdp
    assert rate.sum() == found.sum() + 100 * 300.0
    assert np.array_equal(np.unique(pdp), [0.3, 0.5])  # outside as the chip has it: the number that is stated


def test_numbers_are_set_on_the_whole_chip() -> None:
    new = with_values(chip_with().cropped(*FEW), {("dark_counts", "rate"): 70.0})
    assert new.chip is not None and new.chip.effect("dark_counts").rate == 70.0


def test_rates_in_the_dark_are_scaled_in_the_pixels_around_too() -> None:
    """A dark capture is simulated at factors on its rates: the hot pixel beside the window gets them as well."""
    rate = np.full(120, 1e3)
    rate[35] = 1e6  # row 3, column 5
    effects = [of("dark_counts", rate=rate), of("crosstalk", probability=0.05)]
    part = InTheDark.of(Sensor(GRID, effects, "device").resolved().cropped(*FEW))
    now = Conditions(1e-3, 100, 1e-5, 1e-5, None)
    assert np.array_equal(part.rates(lit(part, 1, 3.0), now)[0], np.full((1, 20), 3e3))
    few, many = (part.expose(lit(part, 300, factor), now, streams(300), ("tr",)).counts for factor in (1.0, 3.0))
    assert few is not None and many is not None
    one, three = (int(counts.reshape(300, 20)[:, 0].sum()) for counts in (few, many))
    laws.same_poisson(one, 300, three, 900)
    assert one > 10 * 300


def test_what_is_kept_of_simulations_belongs_to_one_window_of_one_chip() -> None:
    capture = Capture("dark", "tr", Light(), CLOCK)
    whole = chip_with()
    moved = with_values(whole, {("dark_counts", "rate"): whole.effect("dark_counts").rate.copy()})
    moved.effect("dark_counts").rate[0] += 1.0
    parts = [
        whole,
        whole.cropped(slice(0, 5), slice(0, 4)),
        whole.cropped(*FEW),
        whole.cropped(slice(3, 7), slice(5, None)),
        moved.cropped(*FEW),
        Sensor(Layout(5, 4, 25e-12, 1.0), whole.cropped(*FEW).effects, "device", CHIP, "chip", True),
    ]
    assert len({entry_name(part, capture) for part in parts}) == len(parts)
    assert entry_name(whole.cropped(*FEW), capture) == entry_name(chip_with().cropped(*FEW), capture)


def test_a_model_is_never_made_from_a_layout_alone() -> None:
    """It would forget that it is a part of a chip: `Sensor.changed` keeps it."""
    for file in sorted((Path(candidates.__file__).parent).glob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            assert not (isinstance(node, ast.Call) and ast.unparse(node.func) == "Sensor"), f"{file.name}:{node.lineno}"


# --- the words ------------------------------------------------------------------------------------------------------


def test_a_part_is_written_as_python_writes_slices() -> None:
    assert parse("100:150,200:250") == (slice(100, 150), slice(200, 250))
    assert parse(":16, 8:") == (slice(None, 16), slice(8, None))
    whole = chip_with()
    for text, shown in ((":5,-3:", "0:5,7:10"), (":,1:2", "0:12,1:2"), ("-12:-11,0:10", "0:1,0:10")):
        assert str(whole.cropped(*parse(text)).window) == shown


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("3,4", r"--crop 3,4: names no part.*ROW:ROW,COLUMN:COLUMN.*100:150,200:250"),
        ("1:2", "names no part"),
        ("1:2:3,0:4", "names no part"),
        ("a:b,0:4", "names no part"),
        ("", "names no part"),
        ("0:13,0:4", r"crop 0:13,0:4: the rows 0:13 reach beyond the sensor's 12 rows; name a part of 0:12"),
        ("-13:,0:4", "the rows -13: reach beyond"),
        ("0:2,9:11", r"the columns 9:11 reach beyond the sensor's 10 columns; name a part of 0:10"),
        ("5:5,0:4", r"between the rows 5:5 lies none"),
        ("0:2,7:3", r"between the columns 7:3 lies none.*example 0:10"),
        ("-4:2,0:4", r"between the rows -4:2 lies none.*counts from the last one: here \d+:2"),
    ],
)
def test_what_is_no_part_is_told(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        chip_with().cropped(*parse(text))


def test_pixels_one_by_one_have_one_row() -> None:
    with pytest.raises(InputError, match=r"rows 0:5 reach beyond the sensor's 1 row; name a part of 0:1"):
        chip_with(None, PLACED).cropped(slice(0, 5), slice(0, 5))
    part = chip_with(None, PLACED).cropped(slice(0, 1), slice(7, 20))
    assert np.array_equal(part.layout.positions, PLACED.positions[7:20])


def test_a_step_leaves_pixels_out() -> None:
    with pytest.raises(InputError, match=r"rows 0:8:2 leave some out"):
        chip_with().cropped(slice(0, 8, 2), slice(0, 5))


# --- the verbs ------------------------------------------------------------------------------------------------------

SENSOR = """sensor:
  name: large
  rules: device
  chip_seed: 3
  layout: {rows: 64, columns: 64, pixel_area: 25 um^2, fill_factor: 1.0}
  effects:
    detection: {pdp: 0.4}
    dark_counts: {rate: {lognormal: {median: 300 Hz, sigma: 1.0}}}
    illumination_gradient: {x: 0.3}
    crosstalk: {probability: 0.5 %}
    dead_time: {duration: 50 ns}
    tdc: {resolution: 100 ps}
"""
PLAN = """format: spadmnist-measurement/1
name: window
layout: {rows: 16, columns: 16}
captures:
  - {id: dark, file: dark.h5, modality: tr, light: {kind: dark}, exposure: 400 ms}
  - {id: flat, file: flat.h5, modality: qis, frames: 2000, frame_time: 10 us, frame_period: 10 us,
     light: {kind: flat, wavelength: 500 nm, irradiance: 30 nW/cm^2, relative_uncertainty: 0.02}}
"""


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a sensor of 64 x 64 pixels and a measurement of rows 16 to 32, columns 8 to 24, of it."""
    folder = tmp_path_factory.mktemp("crop")
    (folder / "sensor.yaml").write_text(SENSOR)
    (folder / "plan.yaml").write_text(PLAN)
    done = commands.run("simulate", "sensor.yaml", "plan.yaml", "-o", "lab", "--crop", "16:32,8:24", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
def test_a_measured_part_is_compared_with_that_part(lab: Path) -> None:
    """The right part is adequate; the whole is refused, with a line to type; another part fails, by its map."""
    line = ["compare", "sensor.yaml", "lab", "--jobs", "1", "--crop"]
    done = commands.run(*line, "16:32,8:24", "--json", "right.json", "-o", "report", cwd=lab)
    assert done.returncode == 0, done.stdout + done.stderr
    answer = json.loads((lab / "right.json").read_text())
    assert (answer["verdict"], answer["crop"]) == ("adequate", "16:32,8:24")
    assert "large, its rows and columns 16:32,8:24" in (lab / "report" / "index.html").read_text()
    done = commands.run(*line, "0:16,0:16", "--json", "wrong.json", cwd=lab)
    assert done.returncode == 1, done.stdout + done.stderr
    failing = [c["statistic"] for c in json.loads((lab / "wrong.json").read_text())["checks"] if not c["passes"]]
    assert {"pixel_map", "rows"} <= set(failing)


@pytest.mark.parametrize("verb", ["compare", "diagnose", "simulate", "fit"])
def test_without_a_part_the_error_names_it(lab: Path, verb: str) -> None:
    more = {"simulate": ["-o", "never"], "fit": ["-o", "never.yaml", "--free", "dead_time.duration"]}.get(verb, [])
    done = commands.run(verb, "sensor.yaml", "lab", *more, cwd=lab)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    said = " ".join(done.stderr.split())
    assert "16 x 16 pixels, but the sensor 64 x 64" in said and "--crop 0:16,0:16" in said and "corner" in said
    assert "name the sensor that recorded it" in said and "the corner 0,0 is a guess: write yours" in said
    done = commands.run(verb, "sensor.yaml", "lab", *more, "--crop", "60:76,0:16", cwd=lab)
    assert done.returncode == 2 and "the rows 60:76 reach beyond the sensor's 64 rows" in " ".join(done.stderr.split())
    assert not (lab / "never").exists() and not (lab / "never.yaml").exists()


def test_a_larger_measurement_is_no_part(lab: Path) -> None:
    data, sensor = measurement.open(lab / "lab"), config.read_sensor(lab / "sensor.yaml")
    with pytest.raises(InputError) as told:
        data.check_sensor(sensor.cropped(slice(0, 8), slice(0, 32)))
    assert "8 x 32" in str(told.value) and "--crop" not in str(told.value)


def test_the_next_sensor_describes_the_whole_chip(lab: Path, tmp_path: Path) -> None:
    """Read again with the same part it is the model that was found, around the part as well."""
    part = config.read_sensor(lab / "sensor.yaml").cropped(slice(16, 32), slice(8, 24))
    rng = np.random.Generator(np.random.PCG64(4))
    values: dict[Key, Any] = {
        ("dark_counts", "rate"): rng.random(256) * 1e3,
        ("detection", "relative"): 1 + 0.1 * rng.standard_normal(256),
        ("row_pattern", "gain"): 1 + 0.1 * rng.standard_normal(16),
        ("afterpulsing", "probability"): rng.random(256) * 0.01,
        ("afterpulsing", "lifetime"): 30e-9,
        ("dead_time", "duration"): 45e-9,
    }
    out = sensor_file.write(
        sensor_file.original(lab / "sensor.yaml"), tmp_path / "sensor.yaml", values, {}, part.window
    )
    again = config.read_sensor(out).cropped(slice(16, 32), slice(8, 24))
    found = with_values(part, values)
    for one, other in ((again, found), (again.chip, found.chip)):
        assert one is not None and other is not None
        for effect in other.effects:
            for name in effect.parameters:
                assert np.array_equal(getattr(one.effect(effect.name), name), getattr(effect, name)), effect.name
    now = Conditions(1e-3, 60, 12e-6, 16e-6, 500e-9)
    assert np.array_equal(again.expected(lit(again), now), found.expected(lit(found), now))
    whole = config.read_sensor(lab / "sensor.yaml")
    rate = again.chip.effect("dark_counts").rate.reshape(64, 64)
    assert np.array_equal(rate[:16], whole.effect("dark_counts").rate.reshape(64, 64)[:16])


@pytest.mark.slow
def test_a_fit_and_a_diagnosis_say_which_part_they_are_of(tmp_path: Path) -> None:
    """A map is found in a part of 3 x 3 pixels; the new file has it there, and the stated rate elsewhere."""
    few = SENSOR.replace("rows: 64, columns: 64", "rows: 6, columns: 6").replace(
        "    crosstalk: {probability: 0.5 %}\n", ""
    )
    (tmp_path / "truth.yaml").write_text(few)
    stated = few.replace("{lognormal: {median: 300 Hz, sigma: 1.0}}", "300 Hz")
    (tmp_path / "sensor.yaml").write_text(stated)
    dark = "{id: dark, file: dark.h5, modality: tr, light: {kind: dark}, exposure: 1 s}"
    head = PLAN[: PLAN.index("  - ")].replace("rows: 16, columns: 16", "rows: 3, columns: 3")
    (tmp_path / "plan.yaml").write_text(f"{head}  - {dark}\n")
    crop = ["--crop", "2:5,1:4"]
    done = commands.run("simulate", "truth.yaml", "plan.yaml", "-o", "lab", *crop, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    told = ["--jobs", "1", "--json", "answer.json", *crop]
    line = ["fit", "sensor.yaml", "lab", "--per-pixel", "dark_counts.rate", "-o", "next.yaml", *told]
    fitted = commands.run(*line, cwd=tmp_path)
    assert fitted.returncode == 0, fitted.stdout + fitted.stderr
    assert json.loads((tmp_path / "answer.json").read_text())["crop"] == "2:5,1:4"
    assert "of rows and columns 2:5,1:4" in (tmp_path / "next.yaml").read_text()
    found = config.read_sensor(tmp_path / "next.yaml").effect("dark_counts").rate.reshape(6, 6)
    truth = config.read_sensor(tmp_path / "truth.yaml").effect("dark_counts").rate.reshape(6, 6)
    part = np.zeros((6, 6), bool)
    part[2:5, 1:4] = True
    assert np.all(found[~part] == 300.0)
    assert np.all(np.abs(found - truth)[part] < 5 * np.sqrt(truth[part]) + 0.02 * truth[part])
    done = commands.run("diagnose", "next.yaml", "lab", "--quick", "-o", "next", *told, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads((tmp_path / "answer.json").read_text())["crop"] == "2:5,1:4"
    assert "its rows and columns 2:5,1:4" in (tmp_path / "next" / "report.html").read_text()
    assert config.read_sensor(tmp_path / "next" / "sensor.yaml").layout.shape == (6, 6)
    typed = re.search(r"Next: spadmnist (compare next.yaml lab .*) checks", fitted.stdout)
    assert typed, "the next command is about the same part"
    done = commands.run(*shlex.split(typed[1]), "--jobs", "1", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_part_whose_chip_would_not_fit_into_the_memory_is_refused() -> None:
    """A shared bus needs the events of all pixels: 1000 x 1000 of them, of which 2 x 2 were measured."""
    layout = Layout(1000, 1000, 25e-12, 1.0)
    part = (
        Sensor(layout, [of("dark_counts", rate=1e3), of("readout_loss")], "device")
        .resolved()
        .cropped(slice(0, 2), slice(0, 2))
    )
    capture = Capture("long", "tr", Light(), Conditions(1.0, 1, 1.0, 1.0, None))
    with pytest.raises(InputError, match=r"long: would hold 1e\+09 events"):
        twin.model_recordings(part, capture, 0.0, streams(1), np.zeros(1, np.uint64))
