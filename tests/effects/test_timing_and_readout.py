"""Jitter, the converter and its codes, the gate, the bus and the counter: each against plain Python and its law."""

from __future__ import annotations

import math
from collections import deque
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import laws
import numpy as np
import pytest
from scipy import stats

from spadmnist import kernels
from spadmnist.effects import Chip, Conditions, Effect
from spadmnist.effects.afterpulsing import Afterpulsing
from spadmnist.effects.count_saturation import CountSaturation
from spadmnist.effects.dark_counts import DarkCounts
from spadmnist.effects.dead_time import DeadTime
from spadmnist.effects.jitter import Jitter, normals
from spadmnist.effects.readout_loss import ReadoutLoss
from spadmnist.effects.short_gate import ShortGate
from spadmnist.effects.tdc import Tdc
from spadmnist.effects.tdc_nonlinearity import TdcNonlinearity
from spadmnist.errors import EffectError, InputError
from spadmnist.events import Events, Layout
from spadmnist.plugins import Distribution, MapFile
from spadmnist.readout import Recorded
from spadmnist.sensor import Sensor
from spadmnist.streams import Draws, Streams, beginning

REAL = Path(__file__).resolve().parents[3] / "shared" / "real" / "linospad2_tdc"
ALL = ("tr", "str", "qis")
EXPOSURE = 1e-4
KEY = np.array([11, 22, 33], np.uint64)
FRAMES = Conditions(EXPOSURE, 10, 8e-6, 10e-6, 555e-9)


def draws(images: Any) -> Draws:
    return Draws(KEY, np.asarray(images, np.uint64))


def uniform_light(images: int, pixels: int, rate: float, exposure: float = EXPOSURE, seed: int = 1) -> Events:
    """Poisson events; `cause` and `parent` are marks that show where each of them goes."""
    numbers = np.arange(images, dtype=np.uint64)
    key = np.array([seed, 5, 6], np.uint64)
    times, offsets = kernels.arrivals(np.full((images, pixels), rate), exposure, numbers, key, beginning(images))
    n = len(times)
    cause = np.arange(n).astype(np.uint8)
    return Events(times, offsets, pixels, end=exposure, cause=cause, parent=np.arange(n) - 1)


def apart(events: int, exposure: float = EXPOSURE) -> Events:
    """One event in the middle of each row: no order, no end of the exposure disturbs it."""
    return Events(np.full(events, exposure / 2), np.arange(events + 1), events, end=exposure)


def chip(pixels: int, tick: float = 0.0, origin: float = 0.0) -> Chip:
    return Chip(Layout(1, pixels, 1e-12, 1.0), 1, "", tick, origin)


def sensor(pixels: int, *effects: Effect, rules: str = "paper") -> Sensor:
    return Sensor(Layout(1, pixels, 1e-12, 1.0), list(effects), rules).resolved()


def expose(
    made: Sensor, images: Any, rate: float, conditions: Conditions = FRAMES, readouts: Any = ALL, **how: Any
) -> Recorded:
    numbers = np.asarray(images, np.uint64)
    photons = np.full((len(numbers), made.layout.pixels), rate)
    return made.expose(photons, conditions, Streams(1, "lux/1", "train", numbers), readouts, **how)


# ---- jitter -----------------------------------------------------------------------------------------------


def philox(block: int, image: int, key: list[int]) -> tuple[int, int]:
    """Philox4x32-10 (Salmon et al. 2011), as plain as it gets."""
    mask = 2**32 - 1
    c = [block & mask, image & mask, image >> 32, key[2]]
    k = key[:2]
    for _ in range(10):
        a, b = 0xD2511F53 * c[0], 0xCD9E8D57 * c[2]
        c = [(b >> 32) ^ c[1] ^ k[0], b & mask, (a >> 32) ^ c[3] ^ k[1], a & mask]
        k = [(k[0] + 0x9E3779B9) & mask, (k[1] + 0xBB67AE85) & mask]
    return c[0] << 32 | c[1], c[2] << 32 | c[3]


def test_normals_are_the_inverse_of_the_normal_law() -> None:
    rng = np.random.default_rng(1)
    small = 2.0 ** -np.arange(1, 53) + 2.0**-53
    few = np.array([2.0**-53, 0.075 - 1e-16, 0.075, 0.075 + 1e-16, 0.5 - 2.0**-53, math.exp(-25.0)])
    u = np.concatenate([small, few, rng.random(20_000), rng.random(2000) * 1e-9])
    u = np.concatenate([u, 1 - u])
    u = u[(u < 1) & (u != 0.5)]
    assert np.abs(normals(u) / stats.norm.ppf(u) - 1).max() < 1e-12
    assert normals(np.array([0.5]))[0] == 0
    z = normals(np.array([(w >> 12) * 2.0**-52 + 2.0**-53 for w in (0, 2**64 - 1)]))  # the extremes of a word
    assert z[0] == -z[1] == pytest.approx(stats.norm.ppf(2.0**-53), rel=1e-12)


def test_jitter_is_what_its_words_say() -> None:
    """Event j of image i takes block j: exactly, also behind the first batch of 128 and among events out of order."""
    events = uniform_light(3, 2, 1.5e6)
    images = [4, 2**33 + 1, 0]
    sigma, weight, tail = 40e-9, 0.3, 200e-9
    moved = Jitter(sigma=sigma, tail_weight=weight, tail=tail).apply(events, draws(images))
    key = [int(k) for k in KEY]
    expected, marks, place = [], [], {}
    for row in range(6):
        start = events.offsets[row // 2 * 2]
        found = []
        for i in range(events.offsets[row], events.offsets[row + 1]):
            words = philox(int(i - start), images[row // 2], key)
            u, v = ((word >> 12) * 2.0**-52 + 2.0**-53 for word in words)
            time = events.times[i] + sigma * stats.norm.ppf(u) - (tail * math.log(v / weight) if v < weight else 0.0)
            found.append((min(max(time, 0.0), np.nextafter(EXPOSURE, 0)), i))
        for time, i in sorted(found):
            place[i] = len(expected)
            expected.append(time)
            marks.append(i)
    assert len(events) > 600 and len(moved) == len(events)
    assert moved.times == pytest.approx(expected, rel=1e-12, abs=1e-20)
    assert moved.problem(EXPOSURE) is None and events.problem(EXPOSURE) is None
    assert np.any(np.array(marks) != np.arange(len(events))), "some overtake others"
    assert moved.cause is not None and moved.parent is not None
    assert np.array_equal(moved.cause, np.array(marks).astype(np.uint8))
    assert list(moved.parent) == [place[i - 1] if i else -1 for i in marks]


@pytest.mark.parametrize(("weight", "tail"), [(0.0, 1e-9), (0.2, 400e-12), (1.0, 100e-12)])
def test_delays_follow_their_law(weight: float, tail: float) -> None:
    sigma = 100e-12
    events = apart(40_000)
    late = (Jitter(sigma=sigma, tail_weight=weight, tail=tail).apply(events, draws([7])).times - EXPOSURE / 2) / sigma

    def cdf(x: np.ndarray) -> np.ndarray:
        with_tail = stats.exponnorm(tail / sigma).cdf(x)
        return (1 - weight) * stats.norm.cdf(x) + weight * with_tail

    ratio = tail / sigma
    laws.distribution_is(late, cdf)
    laws.mean_is(late, weight * ratio)
    laws.variance_is(late, 1 + 2 * weight * ratio**2 - (weight * ratio) ** 2)
    for fault in (
        Jitter(sigma=1.1 * sigma, tail_weight=weight, tail=tail),
        Jitter(sigma=sigma, tail_weight=weight * 0.8 + 0.1 * (weight == 0), tail=tail),
    ):
        wrong = (fault.apply(events, draws([7])).times - EXPOSURE / 2) / sigma
        with pytest.raises(AssertionError):
            laws.distribution_is(wrong, cdf)


def test_the_tail_does_not_depend_on_the_core() -> None:
    events = apart(40_000)
    core = Jitter(sigma=1e-9, tail_weight=0.0).apply(events, draws([3])).times - EXPOSURE / 2
    both = Jitter(sigma=1e-9, tail_weight=0.5, tail=1e-9).apply(events, draws([3])).times - EXPOSURE / 2
    late = both - core
    laws.mean_is(core / 1e-9 * (late / 1e-9 - 0.5), 0.0)
    laws.share_is(int((late > 1e-18).sum()), len(late), 0.5)
    laws.distribution_is(late[late > 1e-18] / 1e-9, stats.expon.cdf)
    with pytest.raises(AssertionError):  # the same word for both
        laws.mean_is(core / 1e-9 * (np.abs(core) / 1e-9 + core / 1e-9), 0.0)


def test_an_image_has_its_jitter_alone_and_in_a_batch() -> None:
    jitter = Jitter(sigma=1e-7, tail_weight=0.4, tail=1e-7)
    events = uniform_light(5, 3, 2e6)
    images = np.array([8, 1, 5, 2**40, 7])
    together = jitter.apply(events, draws(images))
    for start, stop in ((0, 1), (1, 4), (4, 5)):
        part = jitter.apply(events.images(start, stop), draws(images[start:stop]))
        whole = together.images(start, stop)
        assert part.times.tobytes() == whole.times.tobytes()
        assert part.cause is not None and whole.cause is not None and part.cause.tobytes() == whole.cause.tobytes()
    swapped = jitter.apply(events.images(0, 1), draws([9]))
    assert swapped.times.tobytes() != together.images(0, 1).times.tobytes()


def test_jitter_of_stamps_that_stand_in_rows_of_their_own() -> None:
    """STR: the draws go by the place in the image, whatever the rows are."""
    events = uniform_light(4, 3, 1e6)
    alone = Events(
        events.times,
        np.arange(len(events) + 1),
        3,
        row_pixel=events.pixel,
        end=EXPOSURE,
        image_offsets=events.image_offsets.copy(),
    )
    jitter = Jitter(sigma=1e-8, tail_weight=0.1, tail=1e-8)
    one, other = jitter.apply(events, draws(range(4))), jitter.apply(alone, draws(range(4)))
    sort = np.lexsort((other.times, events.rows))
    assert np.array_equal(other.times[sort], one.times)
    none = Events(np.zeros(0), np.zeros(7, np.int64), 3, end=EXPOSURE)
    assert len(jitter.apply(none, draws([0, 1]))) == 0


def test_jitter_that_is_off_changes_nothing() -> None:
    events = uniform_light(2, 2, 1e6)
    assert Jitter(sigma=0.0, tail_weight=0.0).apply(events, draws([0, 1])) is events
    tail = Jitter(sigma=0.0, tail_weight=1.0, tail=1e-9).apply(apart(100), draws([0]))
    assert np.all(tail.times > EXPOSURE / 2)


def test_jitter_in_a_recording() -> None:
    effects: list[Effect] = [DarkCounts(rate=1e5), Afterpulsing(probability=0.2), DeadTime(duration=50e-9)]
    jitter = Jitter(sigma=20e-9, tail_weight=0.1, tail=50e-9)
    still, shaken = sensor(4, *effects), sensor(4, *effects, jitter)
    before, after = (expose(s, range(30), 4e5, causes=True) for s in (still, shaken))
    plain = expose(shaken, range(30), 4e5)
    apiece = Recorded.join([expose(shaken, [i], 4e5) for i in range(30)])
    assert plain.tr and apiece.tr and after.tr and before.tr and plain.frames and before.frames and apiece.frames
    assert plain.tr.times.tobytes() == apiece.tr.times.tobytes() == after.tr.times.tobytes()
    assert plain.frames.bits.tobytes() == before.frames.bits.tobytes() == apiece.frames.bits.tobytes()
    assert np.array_equal(plain.counts, before.counts)
    assert np.any(before.tr.times != after.tr.times) and after.tr.problem(EXPOSURE) is None
    assert after.tr.cause is not None and after.tr.parent is not None and before.tr.cause is not None
    trap = shaken.causes.index(Afterpulsing.cause)
    assert np.array_equal(np.sort(before.tr.cause), np.sort(after.tr.cause))
    assert np.array_equal(after.tr.parent != -1, after.tr.cause == trap) and (after.tr.parent >= 0).sum() > 50
    assert plain.frames.first and before.frames.first and apiece.frames.first
    late = plain.frames.first.times - before.frames.first.times
    assert plain.frames.first.times.tobytes() == apiece.frames.first.times.tobytes()
    inside = (before.frames.first.times > 5e-7) & (before.frames.first.times < 7e-6)
    laws.distribution_is(
        late[inside] / 20e-9, lambda x: 0.9 * stats.norm.cdf(x) + 0.1 * stats.exponnorm(2.5).cdf(x), what="STR delays"
    )


# ---- the converter ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [10e-12, 17.857142857142858e-12, 1e-9, 3e-7])
def test_ticks_are_rounded_to_the_nearest_or_down(resolution: float) -> None:
    events = uniform_light(2, 3, 5e6)
    nearest = Tdc(resolution=resolution).apply(events, None)
    down = Tdc(resolution=resolution, rounding="floor").apply(events, None)
    assert nearest.ticks is not None and down.ticks is not None
    assert nearest.ticks.tolist() == [round(t / resolution) for t in events.times.tolist()]
    assert down.ticks.tolist() == [math.floor(t / resolution) for t in events.times.tolist()]
    laws.share_is(int((nearest.ticks != down.ticks).sum()), len(events), 0.5)
    for stamped in (nearest, down):
        assert stamped.tick == resolution and stamped.end == events.end
        assert stamped.cause is events.cause and stamped.parent is events.parent
        assert np.array_equal(stamped.offsets, events.offsets)


def test_a_converter_tells_its_tick_and_where_it_begins() -> None:
    assert Tdc(resolution=1e-9).converter() == (1e-9, -0.5)
    assert Tdc(resolution=1e-9, rounding="floor").converter() == (1e-9, 0.0)
    events = uniform_light(1, 1, 1e6)
    assert Tdc(resolution=0.0, rounding="floor").apply(events, None) is events
    assert Tdc.parameters["rounding"].choices == ("nearest", "floor")


def test_a_counter_of_ticks_in_a_recording() -> None:
    """Half a tick earlier in the mean, in TR and STR, with what lies before the converter as it was."""
    times, ticks = (
        expose(sensor(3, *effects), range(20), 1e6) for effects in ([], [Tdc(resolution=1e-8, rounding="floor")])
    )
    assert times.tr and ticks.tr and times.frames and times.frames.first and ticks.frames and ticks.frames.first
    for exact, whole in ((times.tr, ticks.tr), (times.frames.first, ticks.frames.first)):
        assert whole.ticks is not None and whole.ticks.dtype == np.uint32
        assert whole.ticks.tolist() == [math.floor(t / 1e-8) for t in exact.times.tolist()]


# ---- unequal codes ----------------------------------------------------------------------------------------

TICK = 2500e-12 / 140


def some_widths(shape: tuple[int, ...], seed: int = 1) -> np.ndarray:
    """Codes from missing to several ticks long."""
    return np.maximum(np.random.default_rng(seed).normal(1.0, 0.9, shape), 0.0)


def literal_code(time: float, tick: float, origin: float, widths: np.ndarray) -> int:
    """The tick that a converter of these codes shows, in exact arithmetic."""
    codes = len(widths)
    lengths = [Fraction(float(w)) for w in widths]
    total = sum(lengths)
    x = Fraction(time) / Fraction(tick) - Fraction(origin)
    turns = x // codes
    rest = (x - turns * codes) / codes * total
    for code, length in enumerate(lengths):
        if rest < length:
            return int(turns * codes + code)
        rest -= length
    raise AssertionError("beyond the last code")


@pytest.mark.parametrize("rounding", ["nearest", "floor"])
@pytest.mark.parametrize("kind", ["one row", "a row a pixel", "few codes", "STR"])
def test_codes_are_those_of_the_widths(rounding: str, kind: str) -> None:
    pixels = 3
    tdc = Tdc(resolution=TICK, rounding=rounding)
    widths = some_widths({"one row": (140,), "few codes": (5,)}.get(kind, (pixels, 140)))
    widths[..., 0] = 0  # also the first one and the last ones
    widths[..., -2:] = 0
    effect = TdcNonlinearity(widths=widths)
    effect.made(chip(pixels, *tdc.converter()))
    events = uniform_light(2, pixels, 1e6)
    if kind == "STR":
        images = events.image_offsets.copy()
        rows = np.arange(len(events) + 1)
        events = Events(events.times, rows, pixels, row_pixel=events.pixel, end=EXPOSURE, image_offsets=images)
    moved = effect.apply(events, None)
    ticks = tdc.apply(moved, None).ticks
    assert ticks is not None and moved.problem(EXPOSURE) is None
    pixel = events.pixel
    expected = [
        literal_code(float(t), TICK, tdc.converter()[1], np.atleast_2d(widths)[p if widths.ndim > 1 else 0])
        for t, p in zip(events.times, pixel, strict=True)
    ]
    assert ticks.tolist() == expected
    assert np.any(tdc.apply(events, None).ticks != ticks)
    wrong = TdcNonlinearity(widths=np.roll(widths, 1, axis=-1))
    wrong.made(chip(pixels, *tdc.converter()))
    assert tdc.apply(wrong.apply(events, None), None).ticks.tolist() != expected  # type: ignore[union-attr]


@pytest.mark.parametrize("rounding", ["nearest", "floor"])
@pytest.mark.parametrize(("exposure", "tick"), [(1e-3, 10e-12), (1.0, 10e-12), (2e4, 10e-12)])
def test_the_right_code_late_in_a_long_exposure(rounding: str, exposure: float, tick: float) -> None:
    """Up to 2e15 ticks: doubles there are coarser than the margin that keeps a stamp within its code."""
    tdc = Tdc(resolution=tick, rounding=rounding)
    codes = 7
    widths = np.array([1.0, 0.0, 3.0, 0.25, 0.75, 0.5, 1.5])
    effect = TdcNonlinearity(widths=widths)
    effect.made(chip(1, *tdc.converter()))
    times = np.sort(np.random.default_rng(3).random(3000)) * exposure
    events = Events(times, np.array([0, len(times)]), 1, end=exposure)
    ticks = tdc.apply(effect.apply(events, None), None).ticks
    assert ticks is not None and not np.any(ticks % codes == 1)
    exact = [literal_code(t, tick, tdc.converter()[1], widths) for t in times.tolist()]
    # where a double's step is a large part of a tick, an event within such a step of an edge may go either way: to the
    # next code, and one of them is missing
    step, apart = np.spacing(exposure / tick), np.abs(ticks.astype(np.int64) - np.array(exact, np.int64))
    assert apart.max() <= 2 and np.count_nonzero(apart) <= len(times) * min(0.15, 20 * step)


@pytest.mark.parametrize("codes", [5, 7, 140])
def test_edges_of_codes_belong_to_the_code_that_begins(codes: int) -> None:
    """Moments on the edges and one double off them, in numbers that are exact."""
    tick = 2.0**-36
    widths = np.random.default_rng(codes).integers(0, 5, codes) / 4.0
    widths[:4] = [0.0, 0.25, 0.0, 1.75]
    widths[-1] = codes - widths[:-1].sum()
    if widths[-1] < 0:
        widths = np.repeat([0.5, 1.5], codes // 2)
    tdc = Tdc(resolution=tick, rounding="floor")
    effect = TdcNonlinearity(widths=widths)
    effect.made(chip(1, *tdc.converter()))
    edges = (np.arange(30)[:, None] * codes + np.concatenate([[0.0], np.cumsum(widths)])).ravel()
    times = np.unique(np.concatenate([edges, np.nextafter(edges, 0.0), np.nextafter(edges, np.inf)])) * tick
    events = Events(times, np.array([0, len(times)]), 1, end=1.0)
    ticks = tdc.apply(effect.apply(events, None), None).ticks
    assert ticks is not None and ticks.tolist() == [literal_code(t, tick, 0.0, widths) for t in times.tolist()]


def test_equal_codes_change_nothing() -> None:
    events = uniform_light(2, 2, 1e6)
    for equal in (1.0, 0.5, np.ones(140), np.full((2, 7), 2.0)):
        effect = TdcNonlinearity(widths=equal)
        effect.made(chip(2))
        assert effect.apply(events, None) is events
    tdc = Tdc(resolution=TICK)
    effect = TdcNonlinearity(widths=np.stack([np.ones(140), some_widths((140,))]))
    effect.made(chip(2, *tdc.converter()))
    plain, moved = tdc.apply(events, None), tdc.apply(effect.apply(events, None), None)
    assert plain.ticks is not None and moved.ticks is not None
    first = events.pixel == 0
    assert np.array_equal(plain.ticks[first], moved.ticks[first])
    assert not np.array_equal(plain.ticks[~first], moved.ticks[~first])
    assert moved.cause is not None and np.array_equal(moved.cause, events.cause)  # in order before, in order after
    assert moved.parent is not None and np.array_equal(moved.parent, events.parent)


def test_code_density_is_that_of_the_widths() -> None:
    widths = some_widths((140,), 4)
    effects = [Jitter(sigma=50e-12), TdcNonlinearity(widths=widths), Tdc(resolution=TICK, rounding="floor")]
    recorded = expose(sensor(1, *effects), range(5), 3e8, readouts=("tr",))
    assert recorded.tr is not None and recorded.tr.ticks is not None
    codes = recorded.tr.ticks % 140
    density = widths / widths.sum()
    assert np.all(np.bincount(codes, minlength=140)[widths == 0] == 0) and (widths == 0).sum() > 10
    laws.histogram_is(codes, lambda k: np.where(k < 140, density[np.minimum(k, 139)], 0.0))
    for wrong in (np.ones(140), np.roll(widths, 1), widths[::-1], np.maximum(widths, 0.05)):
        share = wrong / wrong.sum()
        with pytest.raises(AssertionError):
            laws.histogram_is(codes, lambda k, share=share: np.where(k < 140, share[np.minimum(k, 139)], 0.0))


def measured_widths(file: Path) -> np.ndarray:
    """(pixels with data, 140) of a LinoSPAD2 board, in ticks."""
    ends = np.genfromtxt(file, delimiter=",", skip_header=1)[:, 1:]
    return np.diff(ends[ends[:, -1] > 2499], axis=1, prepend=0.0) / (TICK * 1e12)  # one pixel had hardly any data


@pytest.mark.slow
@pytest.mark.parametrize("board", ["TDC_B7d_#28_2212b.csv", "TDC_NL11_#21_2212b.csv", "TDC_NL11_#33_2212b.csv"])
def test_measured_codes_of_a_board(board: str, tmp_path: Path) -> None:
    """Uniform light shows each pixel's measured code density; a converter with equal codes is far from it."""
    if not (REAL / board).is_file():
        pytest.skip("the measured code densities (shared/real) are not here")
    widths = measured_widths(REAL / board)
    pixels = len(widths)
    assert pixels >= 254 and widths.shape[1] == 140 and (widths == 0).sum(axis=1).mean() > 10
    np.save(tmp_path / "widths.npy", widths)
    real = TdcNonlinearity(widths=MapFile(tmp_path / "widths.npy"))
    alpha = laws.FALSE_ALARM / pixels

    def codes_of(*effects: Effect) -> list[np.ndarray]:
        made = sensor(pixels, *effects, Tdc(resolution=TICK))
        recorded = expose(made, [0], 2e7, readouts=("tr",))
        assert recorded.tr is not None and recorded.tr.ticks is not None
        return np.split(recorded.tr.ticks % 140, recorded.tr.offsets[1:-1])

    density = widths / widths.sum(axis=1, keepdims=True)
    simulated, ideal = codes_of(real), codes_of()
    for pixel in range(pixels):

        def law(k: np.ndarray, share: np.ndarray = density[pixel]) -> np.ndarray:
            return np.where(k < 140, share[np.minimum(k, 139)], 0.0)

        missing = density[pixel] == 0
        assert np.bincount(simulated[pixel], minlength=140)[missing].sum() == 0
        laws.histogram_is(simulated[pixel], law, alpha)
        assert laws.histogram_is(ideal[pixel], lambda k: (k < 140) / 140, alpha) >= alpha
        assert laws.histogram_is(ideal[pixel], law, 0.0) < 1e-30
        assert laws.histogram_is(simulated[pixel], lambda k: (k < 140) / 140, 0.0) < 1e-30


def test_codes_drawn_for_a_chip() -> None:
    made = sensor(2, TdcNonlinearity(widths=Distribution("normal", (1.0, 0.3)), period=16.0), Tdc(resolution=1e-9))
    effect = made.effect("tdc_nonlinearity")
    assert effect is not None and effect.widths.shape == (16,)  # type: ignore[attr-defined]
    recorded = expose(made, range(3), 1e7)
    apiece = Recorded.join([expose(made, [i], 1e7) for i in range(3)])
    assert recorded.tr and apiece.tr and recorded.tr.times.tobytes() == apiece.tr.times.tobytes()
    assert len(np.unique(effect.widths)) == 16  # type: ignore[attr-defined]
    share = effect.widths / effect.widths.sum()  # type: ignore[attr-defined]
    laws.histogram_is(recorded.tr.ticks % 16, lambda k: np.where(k < 16, share[np.minimum(k, 15)], 0.0))
    assert [e.name for e in sensor(1, Tdc(), TdcNonlinearity(), Jitter()).effects] == [
        "jitter",
        "tdc_nonlinearity",
        "tdc",
    ]


@pytest.mark.parametrize(
    ("effects", "says"),
    [
        ([TdcNonlinearity(widths=np.array([1.0, 2.0]))], "an effect that makes ticks"),
        ([TdcNonlinearity(widths=np.array([1.0, 2.0])), Tdc(resolution=0.0)], "an effect that makes ticks"),
        ([TdcNonlinearity(widths=np.array([[1.0, 2.0], [0.0, 0.0]])), Tdc()], "pixel 1 are all 0"),
        ([TdcNonlinearity(widths=0.0), Tdc()], "the widths are all 0"),
        ([TdcNonlinearity(widths=np.array([1.0, -2.0])), Tdc()], "none negative"),
        ([TdcNonlinearity(widths=np.ones((3, 4)) * [1, 1, 1, 2]), Tdc()], "needs one number for each code"),
        ([TdcNonlinearity(period=1.5)], "a whole number of codes"),
        ([ReadoutLoss(queue=2.5)], "a whole number of events"),
        ([CountSaturation(bits=7.5)], "a whole number"),
        ([ShortGate(fraction=0.0)], "more than 0"),
    ],
)
def test_a_chip_that_cannot_be(effects: list[Effect], says: str) -> None:
    with pytest.raises((EffectError, InputError), match=says) as caught:
        sensor(2, *effects)
    assert f"the effect {effects[0].name}: " in str(caught.value) and ".py" not in str(caught.value)


# ---- the gate ---------------------------------------------------------------------------------------------


def literally_live(t: float, fraction: float, offset: float, c: Conditions) -> bool:
    since = max(t - math.floor(t / c.frame_period) * c.frame_period, 0.0)
    return offset <= since < offset + fraction * c.frame_time and since < c.frame_time


GATES = [
    (0.5, 0.0, FRAMES),
    (0.7, 1e-6, FRAMES),
    (0.9, 2e-6, FRAMES),  # sticks out of the frame
    (1.0, 1e-6, FRAMES),
    (0.5, 9e-6, FRAMES),  # behind the frame
    (0.3, 4e-5, Conditions(EXPOSURE, 1, EXPOSURE, EXPOSURE, None)),  # no frames
    (0.999, 0.0, Conditions(EXPOSURE, 10, 10e-6, 10e-6, None)),
]


@pytest.mark.parametrize(("fraction", "offset", "conditions"), GATES)
def test_a_gate_is_open_when_it_says(fraction: float, offset: float, conditions: Conditions) -> None:
    gate = ShortGate(fraction=fraction, offset=offset)
    events = uniform_light(3, 4, 3e7)
    period = conditions.frame_period
    edges = np.arange(conditions.frames) * period
    times = np.concatenate([events.times, edges, edges + offset, edges + offset + fraction * conditions.frame_time])
    live = gate.open(times, conditions)
    assert live.dtype == bool and live.tolist() == [
        literally_live(t, fraction, offset, conditions) for t in times.tolist()
    ]
    rate = np.full((3, 4), 3e7)
    expected = gate.expected_rate(rate, conditions).sum() * EXPOSURE
    found = int(gate.open(events.times, conditions).sum())
    laws.poisson_mean(found, expected) if expected else None
    assert found > 0 or offset >= conditions.frame_time
    for wrong in (0.9 * expected, 1.1 * expected) if expected else ():
        with pytest.raises(AssertionError):
            laws.poisson_mean(found, wrong)


def test_a_gate_that_is_off_changes_nothing() -> None:
    gate = ShortGate(fraction=1.0, offset=0.0)
    times = uniform_light(1, 1, 1e7).times
    assert gate.open(times, FRAMES).all(), "between the frames, too"
    rate = np.ones((2, 3))
    assert gate.expected_rate(rate, FRAMES) is rate


@pytest.mark.parametrize("rules", ["paper", "device"])
def test_a_gate_in_a_recording(rules: str) -> None:
    effects: list[Effect] = [DarkCounts(rate=1e5), Afterpulsing(probability=0.3, lifetime=1e-6)]
    gate = ShortGate(fraction=0.6, offset=1e-6)
    gated, free = (
        expose(sensor(5, *effects, *more, rules=rules), range(40), 4e5, causes=True) for more in ([gate], [])
    )
    assert gated.tr and free.tr and gated.frames and gated.frames.first and free.frames and free.frames.first
    assert gate.open(gated.tr.times, FRAMES).all() and not gate.open(free.tr.times, FRAMES).all()
    stamps = gated.frames.first.times
    assert stamps.min() >= 1e-6 and stamps.max() < 1e-6 + 0.6 * 8e-6 < free.frames.first.times.max()
    if rules == "paper":  # each frame's bit by itself: children are rare beyond the parent's own
        dark_and_light = sensor(5, DarkCounts(rate=1e5), gate, rules=rules)
        ones = expose(dark_and_light, range(200), 4e5).ones
        assert ones is not None
        laws.share_is(int(ones.sum()), 200 * 5 * 10, -math.expm1(-5e5 * 0.6 * 8e-6))


# ---- the bus ----------------------------------------------------------------------------------------------


def literal_bus(times: np.ndarray, service_time: float, queue: int) -> np.ndarray:
    """Who is taken, one image: events come one by one, those whose service is over leave first."""
    taken = np.zeros(len(times), bool)
    inside: deque[float] = deque()
    free_at = -math.inf
    for i in sorted(range(len(times)), key=lambda i: times[i]):  # a stable sort
        while inside and inside[0] <= times[i]:
            inside.popleft()
        if len(inside) < queue:
            free_at = max(free_at, times[i]) + service_time
            inside.append(free_at)
            taken[i] = True
    return taken


def literally_taken(events: Events, service_time: float, queue: int) -> np.ndarray:
    images = events.image_offsets
    parts = [events.times[a:b] for a, b in pairwise(images)]
    return np.concatenate([literal_bus(p, service_time, queue) for p in parts])


def crowded(seed: int) -> Events:
    """Events of three images: one in flashes, one empty, one with a single event."""
    rng = np.random.default_rng(seed)
    flashes = rng.integers(0, 3, 1500) * 3e-5 + rng.exponential(2e-9, 1500)
    rows = [np.sort(flashes[:700]), np.sort(flashes[700:]), np.zeros(0), np.zeros(0), np.array([1e-5]), np.zeros(0)]
    offsets = np.cumsum([0, *map(len, rows)])
    n = int(offsets[-1])
    return Events(
        np.concatenate(rows), offsets, 2, end=EXPOSURE, cause=np.arange(n).astype(np.uint8), parent=np.arange(n) - 1
    )


@pytest.mark.parametrize("load", [0.1, 0.9, 1.1, 5.0])
@pytest.mark.parametrize("queue", [1, 2, 16, 10**6])
@pytest.mark.parametrize("kind", ["uniform", "ticks", "flashes", "all at once"])
def test_the_bus_takes_what_a_literal_queue_takes(load: float, queue: int, kind: str) -> None:
    events = crowded(5) if kind == "flashes" else uniform_light(3, 7, 1e6, seed=queue)
    if kind == "ticks":
        events = Tdc(resolution=1e-7).apply(events, None)
    if kind == "all at once":
        events = Events(np.full(len(events), 3e-5), events.offsets, 7, cause=events.cause, parent=events.parent)
    service_time = load / (7 * 1e6)
    bus = ReadoutLoss(service_time=service_time, queue=float(queue))
    kept = bus.apply(events, None)
    taken = literally_taken(events, service_time, queue)
    assert np.array_equal(kept.times, events.times[taken])
    assert kept.tick == events.tick and kept.problem() is None
    assert events.cause is not None and kept.cause is not None and kept.parent is not None
    assert np.array_equal(kept.cause, events.cause[taken])
    new = np.cumsum(taken) - 1
    index = np.flatnonzero(taken)
    assert kept.parent.tolist() == [-1 if i == 0 else int(new[i - 1]) if taken[i - 1] else -2 for i in index]
    if kind == "uniform" and load > 1 and queue < 100:
        faults = [
            literally_taken(events, service_time, queue + 1),
            literally_taken(events, 1.01 * service_time, queue),
            np.concatenate([literal_bus(events.row(r), service_time, queue) for r in range(21)]),  # a bus a pixel
        ]
        assert all(not np.array_equal(taken, fault) for fault in faults)


def test_a_bus_for_one_event_is_a_dead_time_of_the_whole_array() -> None:
    events = uniform_light(6, 9, 1e6)
    service_time = 2e-7
    kept = ReadoutLoss(service_time=service_time, queue=1.0).apply(events, None)
    for image in range(6):
        one = events.images(image, image + 1)
        times = np.sort(one.times)
        free = kernels.non_paralyzable(times, np.array([0, len(times)]), np.array([service_time]))
        assert np.array_equal(np.sort(kept.images(image, image + 1).times), times[free])


def test_the_bus_at_its_limit() -> None:
    """Under a large load it takes one event per service time; far below it loses nothing."""
    events = uniform_light(4, 20, 5e6)
    bus = ReadoutLoss(service_time=1e-7, queue=16.0)
    kept = bus.apply(events, None)
    images = np.diff(kept.image_offsets)
    assert np.all(np.abs(images - (EXPOSURE / 1e-7 + 16)) <= 2)  # the queue's content is read out afterwards
    rate = np.full((4, 20), 5e6)
    assert bus.expected_rate(rate, FRAMES).sum(axis=1) == pytest.approx(1e7)
    assert np.array_equal(ReadoutLoss(service_time=1e-12).expected_rate(rate, FRAMES), rate)
    assert len(ReadoutLoss(service_time=1e-12).apply(events, None)) == len(events)
    none = np.zeros((1, 2))
    assert np.array_equal(bus.expected_rate(none, FRAMES), none)
    off = ReadoutLoss(service_time=0.0)
    assert off.apply(events, None) is events and np.array_equal(off.expected_rate(rate, FRAMES), rate)
    # every pixel loses its share: what is lost does not depend on the place
    shares = kept.counts / events.counts
    laws.same_poisson(int(kept.counts[::2].sum()), 1.0, int(kept.counts[1::2].sum()), 1.0)
    assert shares.std() < 0.1


@pytest.mark.parametrize("load", [0.3, 0.8, 1.5])
def test_a_short_queue_loses_the_share_of_a_queue_with_fixed_service(load: float) -> None:
    """M/D/1/2: a departure leaves nobody where none came during the service, with probability exp(-load).

    From one departure to the next there is a service and, in those cases, the wait for the next event.
    """
    events = uniform_light(40, 10, 1e6)

    def taken_per_window(queue: float) -> np.ndarray:
        kept = ReadoutLoss(service_time=load / 1e7, queue=queue).apply(events, None)
        windows = np.linspace(1e-5, 9e-5, 9)  # behind the start, when the queue is empty
        return np.concatenate([np.histogram(kept.images(i, i + 1).times, windows)[0] for i in range(40)])

    law = 1e7 * 1e-5 / (load + math.exp(-load))
    laws.mean_is(taken_per_window(2.0), law)
    for wrong in (1.0, 3.0):
        with pytest.raises(AssertionError):
            laws.mean_is(taken_per_window(wrong), law)


def test_a_bus_in_a_recording() -> None:
    bus = ReadoutLoss(service_time=5e-8, queue=3.0)
    effects: list[Effect] = [DarkCounts(rate=1e5), Afterpulsing(probability=0.1), Tdc(resolution=1e-9)]
    full, less = (expose(sensor(6, *effects, *more), range(5), 4e6, causes=True) for more in ([], [bus]))
    apiece = Recorded.join([expose(sensor(6, *effects, bus), [i], 4e6) for i in range(5)])
    assert full.tr and less.tr and apiece.tr and full.frames and less.frames
    taken = literally_taken(full.tr, 5e-8, 3)
    assert 0.5 < taken.mean() < 0.95
    assert full.tr.ticks is not None and less.tr.ticks is not None and apiece.tr.ticks is not None
    assert np.array_equal(less.tr.ticks, full.tr.ticks[taken]) and np.array_equal(less.tr.ticks, apiece.tr.ticks)
    assert full.frames.bits.tobytes() == less.frames.bits.tobytes()


# ---- the counter ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.uint32, np.uint64])
@pytest.mark.parametrize("bits", [1.0, 7.0, 8.0, 12.0, 31.0, 32.0])
def test_a_counter_stays_at_its_largest_number(bits: float, kind: Any) -> None:
    effect = CountSaturation(bits=bits)
    effect.made(chip(1))
    top = int(np.iinfo(kind).max)
    numbers = [n for n in (0, 1, 2, 127, 128, 255, 256, 4095, 4096, 2**31, 2**32 - 1, 2**32, 2**40, top) if n <= top]
    counts = np.array(numbers, kind).reshape(1, 1, -1)
    limited = effect.limit(counts)
    assert limited.dtype == kind and limited.shape == counts.shape
    assert limited.ravel().tolist() == [min(n, 2 ** int(bits) - 1) for n in numbers]


def test_full_counters_pile_up_at_the_top() -> None:
    """Poisson counts of a 4-bit counter: the law with all its tail at 15."""
    counts = np.random.default_rng(9).poisson(12.0, 20_000).astype(np.uint16)
    limited = CountSaturation(bits=4.0).limit(counts)
    law = stats.poisson(12.0)
    laws.histogram_is(limited, lambda k: np.where(k < 15, law.pmf(k), np.where(k == 15, law.sf(14), 0.0)))
    with pytest.raises(AssertionError):  # a counter that begins anew
        laws.histogram_is(counts % 16, lambda k: np.where(k < 15, law.pmf(k), np.where(k == 15, law.sf(14), 0.0)))
