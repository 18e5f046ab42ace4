"""Effects on the light and on when things arrive, against closed forms.

Every statistical check is shown to fail where something small is wrong (`fails`); the bounds are those of `laws`.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import laws
import numpy as np
import pytest

from spadmnist import kernels
from spadmnist.effects import Chip, Conditions, Effect, blinking_dark_counts, flicker, source_noise
from spadmnist.effects.background_light import BackgroundLight
from spadmnist.effects.blinking_dark_counts import BlinkingDarkCounts
from spadmnist.effects.column_pattern import ColumnPattern
from spadmnist.effects.dark_counts import DarkCounts
from spadmnist.effects.detection import Detection
from spadmnist.effects.flicker import Flicker
from spadmnist.effects.illumination_gradient import IlluminationGradient
from spadmnist.effects.row_pattern import RowPattern
from spadmnist.effects.source_drift import SourceDrift
from spadmnist.effects.source_noise import SourceNoise
from spadmnist.errors import EffectError
from spadmnist.events import Events, Layout
from spadmnist.plugins import Distribution, MapFile
from spadmnist.sensor import Sensor
from spadmnist.streams import Draws, Streams, beginning

T = 1e-3
LIT = Conditions(T, 100, T / 100, T / 100, 555e-9)
DARK = Conditions(T, 100, T / 100, T / 100, None)
KEY = np.array([11, 22, 33], np.uint64)


def grid(rows: int, columns: int) -> Layout:
    return Layout(rows, columns, 25e-12, 1.0)


def exposed(
    layout: Layout,
    effects: list[Effect],
    photons: float,
    images: int,
    conditions: Conditions = LIT,
    first: int = 0,
    seed: int = 1,
    rules: str = "paper",
) -> Events:
    """What a sensor without dead time records, image after image; photons: 1/s on every pixel."""
    streams = Streams(seed, "lux", "train", np.arange(first, first + images, dtype=np.uint64))
    light = np.full((images, layout.pixels), photons)
    recorded = Sensor(layout, effects, rules, chip_seed=5).expose(light, conditions, streams, ("tr",))
    assert recorded.tr is not None
    return recorded.tr


def counts(events: Events) -> np.ndarray:
    """(images, pixels)"""
    return events.counts.reshape(-1, events.pixels)


def image_of(events: Events) -> np.ndarray:
    """(events,)"""
    return events.rows // events.pixels


def at(times: np.ndarray) -> Events:
    """Events of images of one pixel; times: (images, events of each)."""
    return Events(times.ravel(), np.arange(len(times) + 1) * times.shape[1], 1, end=T)


def draws(images: int, first: int = 0) -> Draws:
    return Draws(KEY, np.arange(first, first + images, dtype=np.uint64))


@contextmanager
def fails() -> Iterator[None]:
    """A statistical assertion that sees what is wrong."""
    with pytest.raises(AssertionError, match="is below the bound"):
        yield


# ---- where the light falls --------------------------------------------------------------------------------


def light_map(effect: Effect, layout: Layout) -> np.ndarray:
    """(pixels,) what the effect multiplies the light by."""
    resolved = Sensor(layout, [effect], chip_seed=5).resolved().effects[0]
    rate = np.full((2, layout.pixels), 3.0)
    after = resolved.apply(rate, LIT)  # type: ignore[attr-defined]
    assert after.shape == rate.shape and np.array_equal(after, resolved.expected_rate(rate, LIT))
    assert np.array_equal(after[0], after[1])
    return after[0] / 3.0


def test_gradient_is_the_formula() -> None:
    slope = light_map(IlluminationGradient(x=0.1, y=-0.4), grid(3, 5)).reshape(3, 5)
    assert slope[1] == pytest.approx([0.95, 0.975, 1.0, 1.025, 1.05])
    assert slope[:, 2] == pytest.approx([1.2, 1.0, 0.8])
    assert slope.mean() == pytest.approx(1.0)
    bowl = light_map(IlluminationGradient(x=0.0, vignette=0.5), grid(3, 5)).reshape(3, 5)
    assert bowl[0, 0] == bowl[2, 4] == pytest.approx(0.5) and bowl[1, 2] == 1.0
    assert bowl[1, 0] == pytest.approx(1 - 0.5 * 4 / 5)  # 2 pitches of the sqrt(5) to a corner
    both = light_map(IlluminationGradient(x=0.1, y=-0.4, vignette=0.5), grid(3, 5)).reshape(3, 5)
    assert both[0, 4] == pytest.approx(1.25 * 0.5)


def test_gradient_over_pixels_that_are_placed_one_by_one() -> None:
    positions = np.array([[0.0, 0.0], [20e-6, 0.0], [10e-6, 10e-6], [0.0, 40e-6]])
    layout = Layout(1, 4, 25e-12, 1.0, positions)
    assert light_map(IlluminationGradient(x=0.2, y=0.0), layout) == pytest.approx([0.9, 1.1, 1.0, 0.9])
    bowl = light_map(IlluminationGradient(x=0.0, vignette=0.8), layout)
    # from the middle of the array (10, 20) um
    assert bowl == pytest.approx([0.2, 0.2, 1 - 0.8 * 100 / 500, 0.2])


@pytest.mark.parametrize("layout", [grid(1, 1), grid(1, 7), grid(7, 1), grid(4, 6)])
def test_the_steepest_gradient_is_never_negative(layout: Layout) -> None:
    factor = light_map(IlluminationGradient(x=-2.0, y=2.0, vignette=1.0), layout)
    assert np.all((factor >= 0) & (factor <= 3)) and np.all(np.isfinite(factor))
    if layout.pixels == 1:
        assert factor[0] == 1.0


def test_patterns_of_lines(tmp_path: Path) -> None:
    np.save(tmp_path / "rows.npy", [0.5, 1.0, 2.0])
    np.save(tmp_path / "columns.npy", [1.0, 0.0, 3.0, 4.0])
    layout = grid(3, 4)
    rows = light_map(RowPattern(gain=MapFile(tmp_path / "rows.npy")), layout).reshape(3, 4)
    assert np.array_equal(rows, np.repeat([[0.5], [1.0], [2.0]], 4, axis=1))
    columns = light_map(ColumnPattern(gain=MapFile(tmp_path / "columns.npy")), layout).reshape(3, 4)
    assert np.array_equal(columns, np.repeat([[1.0, 0.0, 3.0, 4.0]], 3, axis=0))
    for kind in (RowPattern, ColumnPattern):
        assert np.array_equal(light_map(kind(gain=1.5), layout), np.full(12, 1.5))


def test_patterns_are_drawn_for_the_lines() -> None:
    spread = Distribution("normal", (1.0, 0.02))
    rows = light_map(RowPattern(gain=spread), grid(400, 3)).reshape(400, 3)
    columns = light_map(ColumnPattern(gain=spread), grid(3, 400)).reshape(3, 400)
    for lines in (rows, columns.T):
        assert np.all(lines == lines[:, :1]) and len(np.unique(lines[:, 0])) == 400
        laws.mean_is((lines[:, 0] - 1) ** 2, 0.02**2, what="variance of the gain")
    assert not np.array_equal(rows[:, 0], columns[0])
    # of pixels that are placed one by one each is a column of its own, and all are one row
    placed = Layout(1, 9, 25e-12, 1.0, np.random.Generator(np.random.PCG64(1)).random((9, 2)))
    assert len(np.unique(light_map(RowPattern(gain=spread), placed))) == 1
    assert len(np.unique(light_map(ColumnPattern(gain=spread), placed))) == 9


def mean_map(effects: list[Effect], expected: np.ndarray, conditions: Conditions = LIT, photons: float = 1e5) -> None:
    """The pixels of a 4 x 6 array record so much light each, in photons of 50 %."""
    images = 60
    events = exposed(grid(4, 6), [Detection(pdp=0.5), *effects], photons, images, conditions)
    total = counts(events).sum(axis=0)
    alpha = laws.FALSE_ALARM / total.size
    for pixel, mean in enumerate(expected.ravel()):
        laws.poisson_mean(int(total[pixel]), images * T * (0.5 * photons * mean), alpha, f"pixel {pixel}")


GRADIENT = np.outer(1 + 0.2 * np.linspace(-0.5, 0.5, 4), np.ones(6)) + 0.6 * np.linspace(-0.5, 0.5, 6)
LINES = np.array([0.8, 1.0, 1.0, 1.3])


def test_gradient_in_what_is_recorded() -> None:
    mean_map([IlluminationGradient(x=0.6, y=0.2)], GRADIENT)
    with fails():
        mean_map([IlluminationGradient(x=0.2, y=0.6)], GRADIENT)
    with fails():
        mean_map([IlluminationGradient(x=0.6, y=0.2, vignette=0.1)], GRADIENT)


def test_patterns_in_what_is_recorded() -> None:
    columns = np.array([1.2, 1.0, 0.9, 1.0, 0.7, 1.0])
    mean_map([RowPattern(gain=LINES), ColumnPattern(gain=columns)], np.outer(LINES, columns))
    with fails():
        mean_map([RowPattern(gain=LINES[::-1]), ColumnPattern(gain=columns)], np.outer(LINES, columns))


def dark_counts_stay(effects: list[Effect]) -> None:
    events = exposed(grid(4, 6), [*effects, DarkCounts(rate=1e5)], 0.0, 60)
    total, alpha = counts(events).sum(axis=0), laws.FALSE_ALARM / 36
    for pixel in range(24):
        laws.poisson_mean(int(total[pixel]), 60 * T * 1e5, alpha, f"pixel {pixel}")
    early = int((events.times < T / 2).sum())
    laws.share_is(early, len(events), 0.5, alpha, "in the first half")
    images = counts(events).sum(axis=1)
    for image in range(10):
        laws.poisson_mean(int(images[image]), 24 * T * 1e5, alpha, f"image {image}")


def test_what_acts_on_the_light_leaves_dark_counts_alone() -> None:
    lines: list[Effect] = [RowPattern(gain=LINES), ColumnPattern(gain=0.5), IlluminationGradient(x=1.0, vignette=0.5)]
    source: list[Effect] = [
        Flicker(amplitude=1.0, frequency=500.0),
        SourceDrift(slope=2.0),
        SourceNoise(contrast=1.0, coherence_time=T),
    ]
    dark_counts_stay(lines + source)
    for effect in source:
        with fails(), pytest.MonkeyPatch.context() as patch:
            patch.setattr(type(effect), "acts_on", "dark")
            dark_counts_stay([effect])


# ---- background light -------------------------------------------------------------------------------------


def test_background_light_comes_in_through_the_shutter(monkeypatch: pytest.MonkeyPatch) -> None:
    lamp_on = (0.5 * 1e5 + 3e4) / (0.5 * 1e5)
    effects: list[Effect] = [BackgroundLight(rate=3e4)]
    mean_map(effects, np.full(24, lamp_on))
    laws.poisson_mean(len(exposed(grid(4, 6), effects, 0.0, 60)), 60 * 24 * T * 3e4, what="lamp off, shutter open")
    assert len(exposed(grid(4, 6), effects, 0.0, 60, DARK)) == 0
    dark = exposed(grid(4, 6), [*effects, DarkCounts(rate=1e4)], 0.0, 60, DARK)
    laws.poisson_mean(len(dark), 60 * 24 * T * 1e4, what="shutter closed")
    monkeypatch.setattr(BackgroundLight, "apply", lambda self, rate, conditions: rate + self.rate)
    with fails():
        dark = exposed(grid(4, 6), [*effects, DarkCounts(rate=1e4)], 0.0, 60, DARK)
        laws.poisson_mean(len(dark), 60 * 24 * T * 1e4, what="shutter closed")


# ---- flicker ----------------------------------------------------------------------------------------------


def test_sine_is_a_sine() -> None:
    turns = np.concatenate([np.linspace(-3, 3, 240_001), np.random.Generator(np.random.PCG64(1)).random(100_000)])
    own = flicker.sine(turns, 1.0, 0.0)
    assert np.abs(own - np.sin(2 * np.pi * turns)).max() < 1e-14
    assert np.abs(own).max() <= 1.0
    later = flicker.sine(turns, 997.0, 0.3)
    assert np.abs(later - np.sin(2 * np.pi * (997.0 * turns + 0.3))).max() < 1e-11  # rounding of 3000 turns


def test_sine_has_the_same_bits_everywhere() -> None:
    """No mathematical library and no SIMD width may show."""
    turns = np.arange(-5000, 5000) * 0.0009765625 * 0.37
    digest = hashlib.sha256(flicker.sine(turns, 3.1, 0.7).astype("<f8").tobytes()).hexdigest()
    assert digest[:16] == "05bd422ad1e9e714"
    one_by_one = [flicker.sine(turns[i : i + 1], 3.1, 0.7)[0] for i in range(100)]
    assert np.array_equal(flicker.sine(turns, 3.1, 0.7)[:100], one_by_one)


def flickers(effect: Flicker, amplitude: float, phase: float, periods: int = 7) -> None:
    """Where in a period the events lie."""
    events = exposed(grid(4, 6), [effect], 5e5, 20)
    y = np.modf(periods * events.times / T)[0]
    law = lambda y: y + amplitude * (math.cos(phase) - np.cos(2 * np.pi * y + phase)) / (2 * np.pi)  # noqa: E731
    laws.distribution_is(y, law, what="phase")


def test_flicker_has_its_amplitude_frequency_and_phase() -> None:
    flickers(Flicker(amplitude=0.3, frequency=7e3, phase=1.1), 0.3, 1.1)
    flickers(Flicker(amplitude=1.0, frequency=7e3, phase=-50.0), 1.0, -50.0)
    for wrong in ({"phase": 1.0}, {"amplitude": 0.28}, {"frequency": 7.05e3}, {"phase": -1.1}):
        with fails():
            flickers(Flicker(**{"amplitude": 0.3, "frequency": 7e3, "phase": 1.1, **wrong}), 0.3, 1.1)


def mean_rate(effect: Effect, planned: Effect | None = None, images: int = 20) -> None:
    """As many events as `expected_rate` says, but for what is no constant of an image."""
    layout = grid(4, 6)
    resolved = Sensor(layout, [planned or effect], chip_seed=5).resolved().effects[0]
    expected = resolved.expected_rate(np.full((1, 24), 5e5), LIT).sum() * T * images
    laws.poisson_mean(len(exposed(layout, [effect], 5e5, images)), expected)


def test_flicker_has_its_mean() -> None:
    for frequency, phase in ((300.0, 0.4), (1e-3, 2.0), (730.0, -1.0), (5e3, 0.3)):
        mean_rate(Flicker(amplitude=0.5, frequency=frequency, phase=phase))
    with fails():
        mean_rate(Flicker(amplitude=0.5, frequency=300.0, phase=0.4), Flicker(amplitude=0.0))
    with fails():
        mean_rate(Flicker(amplitude=0.5, frequency=300.0, phase=0.4), Flicker(amplitude=0.5, frequency=300.0))
    rate = np.ones((1, 3))
    f, p = 730.0, -1.0
    closed = 1 + 0.5 * (math.cos(p) - math.cos(2 * math.pi * f * T + p)) / (2 * math.pi * f * T)
    assert Flicker(amplitude=0.5, frequency=f, phase=p).expected_rate(rate, LIT) == pytest.approx(closed)
    assert np.array_equal(Flicker(amplitude=0.5, frequency=f).expected_rate(rate, DARK), rate)


# ---- drift ------------------------------------------------------------------------------------------------


def drifts(effect: SourceDrift, slope: float) -> None:
    times = exposed(grid(4, 6), [effect], 5e5, 20).times / T
    laws.distribution_is(times, lambda x: x + slope * (x**2 - x) / 2, what="times")


@pytest.mark.parametrize("slope", [0.2, -0.7, 2.0, -2.0])
def test_drift_is_a_slope(slope: float) -> None:
    drifts(SourceDrift(slope=slope), slope)
    mean_rate(SourceDrift(slope=slope))
    with fails():
        drifts(SourceDrift(slope=0.9 * slope if abs(slope) > 0.5 else 0.5 * slope), slope)


def test_the_steepest_drift_begins_or_ends_at_nothing() -> None:
    ends = np.array([0.0, T])
    assert np.array_equal(SourceDrift(slope=2.0).factor(ends, LIT), [0.0, 2.0])
    assert np.array_equal(SourceDrift(slope=-2.0).factor(ends, LIT), [2.0, 0.0])


# ---- noise of the source ----------------------------------------------------------------------------------


def bunched(window: float, coherence_time: float) -> float:
    """Mean of exp(-2 |t - s| / coherence_time) over two moments of a window."""
    x = 2 * window / coherence_time
    return 2 * (x - 1 + math.exp(-x)) / x**2


@pytest.mark.parametrize(
    ("contrast", "terms"),
    [(0.1, 9), (0.25, 9), (1 / 3, 9), (0.35, 8), (1 / math.sqrt(3), 3), (0.6, 2), (0.8, 1), (1.0, 1), (0.0, 9)],
)
def test_as_many_telegraphs_as_the_contrast_allows(contrast: float, terms: int) -> None:
    noise = SourceNoise(contrast=contrast, coherence_time=1e-5)
    assert noise.terms(LIT) == terms
    factor = noise.modulate(at(np.sort(np.random.Generator(np.random.PCG64(1)).random((3, 20_000)) * T)), LIT, draws(3))
    assert factor.min() >= 0 and factor.max() <= noise.maximum(LIT)
    if contrast > 0.5:
        assert len(np.unique(factor)) == terms + 1


def test_what_flips_too_often_is_a_sentence() -> None:
    assert SourceNoise(coherence_time=T / 1e6).terms(LIT) == 4
    assert SourceNoise(coherence_time=T / 4e6).terms(LIT) == 1
    assert SourceNoise(coherence_time=T / 4.9e7).terms(LIT) == 1
    with pytest.raises(EffectError, match=r"the effect source_noise: in an .* coherence_time must be at least 20 ps"):
        exposed(grid(1, 1), [SourceNoise(coherence_time=T / 6e7)], 1e5, 1)


def levels_are_right(noise: SourceNoise, contrast: float, coherence_time: float) -> None:
    """The power at two moments of each image: its law, and how it is correlated."""
    images, terms = 20_000, noise.terms(LIT)
    moments = np.array([0.1, 0.1 + 0.3 * coherence_time / T, 0.1 + coherence_time / T]) * T
    power = noise.modulate(at(np.tile(moments, (images, 1))), LIT, draws(images)).reshape(images, 3)
    alpha = laws.FALSE_ALARM / 5
    up = np.rint(((power - 1) * math.sqrt(terms) / contrast + terms) / 2)
    law = lambda k: np.array([math.comb(terms, int(j)) / 2**terms for j in k])  # noqa: E731
    for moment in (0, 2):
        laws.histogram_is(up[:, moment], law, alpha, "telegraphs that are up")
    for a, b in ((0, 1), (1, 2), (0, 2)):
        g2 = 1 + contrast**2 * math.exp(-2 * (moments[b] - moments[a]) / coherence_time)
        laws.mean_is(1 + (power[:, a] - 1) * (power[:, b] - 1), g2, alpha, "g2")


@pytest.mark.parametrize("contrast", [0.25, 0.6, 1.0])
def test_the_power_of_a_noisy_source(contrast: float) -> None:
    levels_are_right(SourceNoise(contrast=contrast, coherence_time=2e-4), contrast, 2e-4)
    with fails():
        levels_are_right(SourceNoise(contrast=contrast, coherence_time=1.3e-4), contrast, 2e-4)


def test_a_long_path_flips_as_often_as_a_short_one() -> None:
    """100,000 flips are looked at in many windows; a telegraph differs from one moment to the next independently."""
    moments = np.arange(300_000)[None] * (T / 300_000)
    for coherence_time in (T / 1e5, T / 1e3):
        power = SourceNoise(contrast=1.0, coherence_time=coherence_time).modulate(at(moments), LIT, draws(1))
        changes = int((np.diff(power) != 0).sum())
        chance = 0.5 * (1 - math.exp(-2 * T / 300_000 / coherence_time))
        laws.share_is(changes, 299_999, chance, laws.FALSE_ALARM / 2, "changes")
        with fails():
            laws.share_is(changes, 299_999, 1.25 * chance, laws.FALSE_ALARM / 2, "changes")


@pytest.mark.parametrize("flips", [3, 300, 60_000])
def test_the_path_of_an_image_does_not_depend_on_what_is_detected(flips: int) -> None:
    noise = SourceNoise(contrast=0.25, coherence_time=16 * T / flips)
    rng = np.random.Generator(np.random.PCG64(1))
    moments = np.sort(rng.random((3, 5000)) * T)
    power = noise.modulate(at(moments), LIT, draws(3)).reshape(3, 5000)
    some = noise.modulate(at(moments[:, 7::10]), LIT, draws(3)).reshape(3, 500)
    assert np.array_equal(some, power[:, 7::10])
    alone = noise.modulate(at(moments[2:]), LIT, draws(1, first=2))
    assert np.array_equal(alone, power[2])
    # the same image on five pixels
    pixel = rng.integers(0, 5, 5000)
    order = np.argsort(pixel, kind="stable")
    offsets = np.concatenate([[0], np.cumsum(np.bincount(pixel, minlength=5))])
    spread = noise.modulate(Events(moments[1][order], offsets, 5, end=T), LIT, draws(1, first=1))
    assert np.array_equal(spread, power[1][order])


def test_the_path_is_what_its_draws_say() -> None:
    """Step by step, with the time of every flip."""
    terms, gap = 4, T / 40_000
    power = np.arange(terms + 1.0)
    moments = np.sort(np.random.Generator(np.random.PCG64(1)).random(60_000) * T)
    image = np.array([(1 << 40) + 7], np.uint64)
    own = source_noise.levels(moments, np.array([0, 60_000]), 1, image, KEY, power, gap, T)
    words = _words(41_500, image[0])
    up = int(words[0, 0] & np.uint64(15)).bit_count()
    flips = np.cumsum(gap * -kernels.logarithm(_uniforms(words[1:, 0])))
    assert flips[-1] > T
    path = [up]
    for choice in _uniforms(words[1:, 1]) * terms:
        up += -1 if choice < up else 1
        path.append(up)
    assert np.array_equal(own, np.array(path)[np.searchsorted(flips, moments, side="right")])


@kernels.jit
def _words(count, image):  # type: ignore[no-untyped-def]
    out = np.empty((count, 2), np.uint64)
    for k in range(count):
        out[k, 0], out[k, 1] = kernels.philox(np.uint64(k), image, np.uint64(11), np.uint64(22), np.uint64(33))
    return out


def _uniforms(words: np.ndarray) -> np.ndarray:
    return (words >> np.uint64(12)).astype(np.float64) * 2.0**-52 + 2.0**-53


def counts_are_bunched(noise: SourceNoise, contrast: float, coherence_time: float) -> None:
    """Variance of counts against the window, covariance of two pixels, and means at both ends."""
    images, photons = 6000, 1e5
    events = exposed(grid(1, 2), [noise], photons, images)
    image, pixel = image_of(events), events.pixel
    alpha = laws.FALSE_ALARM / 12
    for window in (0.05 * T, 0.3 * T, T):
        one, two = (
            np.bincount(image[(pixel == p) & (events.times < window)], minlength=images).astype(float) for p in (0, 1)
        )
        mean = photons * window
        together = (contrast * mean) ** 2 * bunched(window, coherence_time)
        laws.variance_is(one, mean + together, alpha, f"variance in {window:g} s")
        laws.mean_is((one - mean) * (two - mean), together, alpha, f"covariance in {window:g} s")
        laws.mean_is(one + two, 2 * mean, alpha, f"mean in {window:g} s")
    late = np.bincount(image[events.times >= 0.7 * T], minlength=images)
    laws.mean_is(late, 2 * 0.3 * T * photons, alpha, "mean at the end")
    # images differ
    total = np.bincount(image, minlength=images) - 2 * photons * T
    laws.mean_is(total[0::2] * total[1::2], 0.0, alpha, "covariance of two images")


BUNCHED = [(0.25, 1e-4), (1.0, 5e-4), (0.5, 1e-5)]


@pytest.mark.parametrize(("contrast", "coherence_time"), BUNCHED)
def test_light_of_a_noisy_source_comes_bunched(contrast: float, coherence_time: float) -> None:
    counts_are_bunched(SourceNoise(contrast=contrast, coherence_time=coherence_time), contrast, coherence_time)


def test_bunching_that_is_wrong_is_seen() -> None:
    with fails():
        counts_are_bunched(SourceNoise(contrast=1.0, coherence_time=4e-4), 1.0, 5e-4)
    with fails():
        counts_are_bunched(SourceNoise(contrast=0.9, coherence_time=5e-4), 1.0, 5e-4)
    for contrast, coherence_time in BUNCHED:  # none at all
        with fails():
            counts_are_bunched(SourceNoise(contrast=0.0), contrast, coherence_time)
    with fails(), pytest.MonkeyPatch.context() as patch:  # all images alike
        right = source_noise.levels
        patch.setattr(source_noise, "levels", lambda *a: right(*a[:3], np.zeros_like(a[3]), *a[4:]))
        counts_are_bunched(SourceNoise(contrast=0.25, coherence_time=1e-4), 0.25, 1e-4)


# ---- dark counts that blink -------------------------------------------------------------------------------


def blinking(layout: Layout, **values: float) -> BlinkingDarkCounts:
    effect = Sensor(layout, [BlinkingDarkCounts(**values)], chip_seed=5).resolved().effects[0]
    assert isinstance(effect, BlinkingDarkCounts)
    return effect


def test_some_pixels_blink() -> None:
    layout = grid(100, 100)
    effect = blinking(layout, amplitude=2e3, fraction=0.3, rate_on=3.0, rate_off=1.0)
    added = effect.added(LIT)
    assert added.shape == (10_000,) and set(np.unique(added)) == {0.0, 2e3}
    laws.share_is(int((added > 0).sum()), 10_000, 0.3, what="pixels that blink")
    with fails():
        laws.share_is(int((added > 0).sum()), 10_000, 0.33, what="pixels that blink")
    assert np.array_equal(added, blinking(layout, amplitude=2e3, fraction=0.3).added(LIT))
    rate = np.full((2, 10_000), 7.0)
    assert np.array_equal(effect.expected_rate(rate, DARK), 7.0 + np.tile(added, (2, 1)) * 0.75)
    assert not blinking(layout, fraction=0.0).added(LIT).any()
    varied = BlinkingDarkCounts(amplitude=np.arange(10_000.0), fraction=1.0)
    varied.made(Chip(layout, 5, varied.name))
    assert np.array_equal(varied.added(LIT), np.arange(10_000.0))


def states_are_right(effect: BlinkingDarkCounts, rate_on: float, rate_off: float) -> None:
    """On or off at three moments of each pixel and image."""
    pixels, images = 200, 100
    moments = np.array([0.1, 0.15, 0.6]) * T
    events = Events(np.tile(moments, pixels * images), np.arange(pixels * images + 1) * 3, pixels, end=T)
    state = effect.modulate(events, LIT, draws(images)).reshape(images, pixels, 3)
    assert set(np.unique(state)) == {0.0, 1.0}
    alpha = laws.FALSE_ALARM / 9
    on = rate_on / (rate_on + rate_off)
    for moment in range(3):
        laws.share_is(int(state[..., moment].sum()), state[..., 0].size, on, alpha, "on")
    for a, b in ((0, 1), (1, 2), (0, 2)):
        both = on * (on + (1 - on) * math.exp(-(rate_on + rate_off) * (moments[b] - moments[a])))
        laws.share_is(int((state[..., a] * state[..., b]).sum()), state[..., 0].size, both, alpha, "on twice")
    # pixels and images are independent of one another
    first = state[..., 0]
    laws.share_is(int((first[:, ::2] * first[:, 1::2]).sum()), first.size // 2, on**2, alpha, "two pixels")
    laws.share_is(int((first[::2] * first[1::2]).sum()), first.size // 2, on**2, alpha, "two images")


def test_a_defect_switches_on_and_off() -> None:
    layout = grid(1, 200)
    rates = {"rate_on": 2e3, "rate_off": 6e3}
    states_are_right(blinking(layout, fraction=1.0, **rates), **rates)
    with fails():
        states_are_right(blinking(layout, fraction=1.0, rate_on=6e3, rate_off=2e3), **rates)
    with fails():
        states_are_right(blinking(layout, fraction=1.0, rate_on=3e3, rate_off=9e3), **rates)
    with fails(), pytest.MonkeyPatch.context() as patch:  # all images alike
        right = blinking_dark_counts.is_on
        patch.setattr(blinking_dark_counts, "is_on", lambda *a: right(*a[:4], np.zeros_like(a[4]), *a[5:]))
        states_are_right(blinking(layout, fraction=1.0, **rates), **rates)


def blinks(effect: BlinkingDarkCounts, rate_on: float, rate_off: float, conditions: Conditions) -> None:
    """Counts of pixels and images with a defect of 5e4 Hz: mean, and variance against the window."""
    images, pixels = 40, 300
    events = exposed(grid(1, pixels), [effect], 0.0, images, conditions)
    alpha = laws.FALSE_ALARM / 6
    on, rate = rate_on / (rate_on + rate_off), rate_on + rate_off
    for window in (0.1 * T, 0.4 * T, T):
        seen = np.bincount(events.rows[events.times < window], minlength=images * pixels)
        mean = 5e4 * on * window
        laws.mean_is(seen, mean, alpha, f"mean in {window:g} s")
        extra = (5e4 * window) ** 2 * on * (1 - on) * bunched(window, 2 / rate)
        laws.variance_is(seen, mean + extra, alpha, f"variance in {window:g} s")


@pytest.mark.parametrize("conditions", [LIT, DARK])
def test_blinking_pixels_in_what_is_recorded(conditions: Conditions) -> None:
    rates = {"rate_on": 2e3, "rate_off": 6e3}
    always = {"fraction": 1.0, "amplitude": 5e4}
    blinks(BlinkingDarkCounts(**always, **rates), **rates, conditions=conditions)
    for wrong in ({"rate_on": 4e3, "rate_off": 12e3}, {"rate_on": 2.2e3}, {"amplitude": 5.3e4}):
        with fails():
            blinks(BlinkingDarkCounts(**{**always, **rates, **wrong}), **rates, conditions=conditions)


def test_blinking_is_added_to_what_there_is() -> None:
    """Photons, which the effect sees too, stay a Poisson process; pixels without a defect have nothing else."""
    layout = grid(1, 400)
    effects: list[Effect] = [
        BlinkingDarkCounts(amplitude=1e5, fraction=0.5, rate_on=1e3, rate_off=1e3),
        DarkCounts(rate=2e4),
    ]
    seen = counts(exposed(layout, effects, 3e4, 50))
    hit = blinking(layout, amplitude=1e5, fraction=0.5).added(LIT) > 0
    laws.poisson_mean(int(seen[:, ~hit].sum()), 50 * T * 5e4 * int((~hit).sum()), what="without a defect")
    quiet = seen[:, ~hit].ravel()
    laws.variance_is(quiet, T * 5e4, what="without a defect")
    laws.mean_is(seen[:, hit].ravel(), T * (5e4 + 5e4), what="with a defect")


def test_as_many_pixels_as_one_likes_draw_for_themselves() -> None:
    """The pixel goes into the stream word, which wraps: no two pixels, and no pixel and a later draw, share one."""
    pixels = 5000
    events = Events(np.full(pixels, T / 2), np.arange(pixels + 1), pixels, end=T)
    hit = np.arange(pixels)
    states = [
        blinking_dark_counts.is_on(
            events.times,
            events.offsets,
            pixels,
            hit,
            np.array([3], np.uint64),
            np.array([1, 2, word], np.uint64),
            1.0,
            0.5,
        )
        for word in (2**32 - 2500, 0, 2500)
    ]
    assert np.array_equal(states[0][2500:], states[1][:2500])  # the word wraps
    assert np.array_equal(states[1][2500:], states[2][:2500])
    laws.share_is(int(states[0].sum()), pixels, 0.5)
    laws.share_is(int((states[0][:2500] == states[0][2500:]).sum()), 2500, 0.5)


# ---- all of them ------------------------------------------------------------------------------------------

OFF: list[Effect] = [
    IlluminationGradient(x=0.0, y=0.0, vignette=0.0),
    RowPattern(gain=1.0),
    ColumnPattern(gain=1.0),
    BackgroundLight(rate=0.0),
    Flicker(amplitude=0.0, frequency=300.0, phase=1.0),
    SourceDrift(slope=0.0),
    SourceNoise(contrast=0.0),
    BlinkingDarkCounts(amplitude=0.0, fraction=1.0),
    BlinkingDarkCounts(fraction=0.0),
]
ON: list[Effect] = [
    IlluminationGradient(x=0.5, vignette=0.2),
    RowPattern(gain=Distribution("normal", (1.0, 0.1))),
    ColumnPattern(gain=Distribution("normal", (1.0, 0.1))),
    BackgroundLight(rate=1e3),
    Flicker(amplitude=0.3, frequency=3e3, phase=1.0),
    SourceDrift(slope=0.5),
    SourceNoise(contrast=0.3, coherence_time=1e-4),
    BlinkingDarkCounts(amplitude=3e4, fraction=0.4, rate_on=1e4, rate_off=5e3),
]


@pytest.mark.parametrize("effect", OFF, ids=lambda e: e.name)
def test_off_is_not_there(effect: Effect) -> None:
    layout = grid(3, 4)
    without = exposed(layout, [DarkCounts(rate=1e4)], 5e4, 5)
    switched_off = exposed(layout, [DarkCounts(rate=1e4), effect], 5e4, 5)
    assert np.array_equal(without.times, switched_off.times) and np.array_equal(without.offsets, switched_off.offsets)
    resolved = Sensor(layout, [effect]).resolved().effects[0]
    rate = np.full((1, 12), 7.0)
    assert np.array_equal(resolved.expected_rate(rate, LIT), rate)


@pytest.mark.parametrize("rules", ["paper", "device"])
def test_images_may_be_split_in_any_way(rules: str) -> None:
    layout = grid(4, 5)
    effects = [DarkCounts(rate=1e4), *ON]
    together = exposed(layout, effects, 1e5, 12, rules=rules)
    assert together.problem(T) is None and len(together) > 10_000
    for splits in ([1] * 12, [5, 7], [11, 1]):
        first, times, offsets = 0, [], [np.zeros(1, np.int64)]
        for size in splits:
            part = exposed(layout, effects, 1e5, size, first=first, rules=rules)
            times.append(part.times)
            offsets.append(part.offsets[1:] + offsets[-1][-1])
            first += size
        assert np.concatenate(times).tobytes() == together.times.tobytes()
        assert np.array_equal(np.concatenate(offsets), together.offsets)


def nanoseconds(hook: Callable[[], Any], events: int) -> float:
    """Of the processor per event, at its best."""
    best = math.inf
    for _ in range(5):
        start = time.process_time()
        hook()
        best = min(best, time.process_time() - start)
    return best / events * 1e9


def test_a_hook_takes_a_few_nanoseconds_an_event() -> None:
    """The aim is 15; twice that, since other programs share the processor's cache."""
    layout, images = grid(28, 28), 6
    rates = np.full((images, layout.pixels), 1e5)
    times, offsets = kernels.arrivals(rates, T, np.arange(images, dtype=np.uint64), KEY, beginning(images))
    events = Events(times, offsets, layout.pixels, end=T)
    blinks = [blinking(layout), blinking(layout, fraction=1.0)]
    hooks: dict[str, Callable[[], Any]] = {
        "flicker": lambda: Flicker(amplitude=0.5, frequency=1e4).factor(times, LIT),
        "drift": lambda: SourceDrift().factor(times, LIT),
        "noise": lambda: SourceNoise().modulate(events, LIT, draws(images)),
        "slow noise": lambda: SourceNoise(coherence_time=T).modulate(events, LIT, draws(images)),
        "blinking": lambda: blinks[0].modulate(events, LIT, draws(images)),
        "all blink": lambda: blinks[1].modulate(events, LIT, draws(images)),
    }
    taken = {name: nanoseconds(hook, len(events)) for name, hook in hooks.items()}
    assert max(taken.values()) < 30, taken
