"""The sensor: two ways through the line, draws that belong to an image, and the effects of others."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import laws
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spadmnist import config, document
from spadmnist.effects import Conditions, Effect, parameter
from spadmnist.effects.afterpulsing import Afterpulsing
from spadmnist.effects.dark_counts import DarkCounts
from spadmnist.effects.dead_time import DeadTime
from spadmnist.effects.detection import Detection
from spadmnist.effects.tdc import Tdc
from spadmnist.errors import ConfigError, EffectError
from spadmnist.events import Children, Events, Layout
from spadmnist.experiment import Experiment, Level
from spadmnist.hooks import influence
from spadmnist.images import Images
from spadmnist.readout import Recorded, no_detection, unsigned_for
from spadmnist.sensor import Sensor
from spadmnist.streams import BLOCK, Streams

ALL = ("tr", "str", "qis")
PAPER = Conditions(1e-3, 100, 10e-6, 10e-6, 555e-9)


def streams(images: Any, seed: int = 1, level: str = "lux/1", split: str = "train") -> Streams:
    return Streams(seed, level, split, np.asarray(images, np.uint64))


def sensor(pixels: int, *effects: Effect, rules: str = "paper") -> Sensor:
    return Sensor(Layout(1, pixels, 25e-12, 1.0), list(effects), rules).resolved()


def paper_effects(**without: bool) -> list[Effect]:
    effects: list[Effect] = [
        Detection(pdp=0.5),
        DarkCounts(rate=100.0),
        Afterpulsing(probability=0.05, lifetime=25e-9),
        DeadTime(duration=50e-9),
        Tdc(resolution=10e-12),
    ]
    return [e for e in effects if not without.get(e.name)]


def columns(recorded: Recorded) -> dict[str, np.ndarray | None]:
    """Everything of a recording, by name."""
    tr, frames = recorded.tr, recorded.frames
    first = None if frames is None else frames.first
    return {
        "tr.offsets": None if tr is None else tr.offsets,
        "tr.ticks": None if tr is None else tr.ticks,
        "tr.times": None if tr is None else tr.times,
        "counts": recorded.counts,
        "span": recorded.span,
        "bits": None if frames is None else frames.bits,
        "first.offsets": None if first is None else first.offsets,
        "first.ticks": None if first is None else first.ticks,
        "first.times": None if first is None else first.times,
        "ones": recorded.ones,
        "waited": recorded.waited,
    }


def assert_same(a: Recorded, b: Recorded) -> None:
    """Bit for bit, types included."""
    without_str = a.frames is not None and a.frames.first is None
    for (name, x), y in zip(columns(a).items(), columns(b).values(), strict=True):
        if name == "waited" and without_str:
            continue  # see `test_waited_belongs_to_str`
        assert (x is None) == (y is None), name
        if x is not None and y is not None:
            assert x.dtype == y.dtype, name
            assert x.shape == y.shape, name
            assert x.tobytes() == y.tobytes(), name


def assert_sound(recorded: Recorded, conditions: Conditions, tick: float) -> None:
    """What holds for every recording."""
    if recorded.tr is not None:
        tr = recorded.tr
        assert tr.problem() is None
        assert np.all(tr.times <= conditions.exposure + tick / 2)
        assert recorded.counts is not None and np.array_equal(recorded.counts, tr.counts)
    if recorded.frames is not None:
        frames = recorded.frames
        qis = frames.unpacked()
        assert qis.shape == (len(frames.bits) // recorded.pixels, conditions.frames, recorded.pixels)
        assert recorded.ones is not None
        assert np.array_equal(qis.sum(axis=1, dtype=int).ravel(), recorded.ones)
        if frames.first is not None:
            stamps = frames.stamps()
            assert np.array_equal(stamps < conditions.frame_time, qis == 1)
            assert stamps.max(initial=0.0) <= conditions.frame_time and stamps.min(initial=0.0) >= 0
            assert np.array_equal(frames.first.counts, recorded.ones)
            if frames.first.ticks is not None:
                none = no_detection(conditions.frame_time, tick)
                assert frames.first.ticks.max(initial=0) < none
            assert recorded.waited is not None
            assert recorded.waited == pytest.approx(stamps.sum(axis=1).ravel(), rel=1e-9)


# ---- the two lines ----------------------------------------------------------------------------------------


@st.composite
def paper_sensors(draw: st.DrawFn) -> tuple[Sensor, Conditions, np.ndarray, tuple[str, ...]]:
    """A sensor of the paper's line, how it records, photons/s of some images, and readouts."""
    pixels = draw(st.integers(1, 7))
    frames = draw(st.sampled_from([1, 3, 8, 13, 100]))
    exposure = draw(st.sampled_from([1e-3, 2e-5]))
    period = exposure / frames
    live = draw(st.sampled_from([1.0, 0.5, 0.1])) * period
    conditions = Conditions(exposure, frames, live, period, 555e-9)
    maps = True

    def value(options: list[float]) -> Any:
        if maps and draw(st.booleans()):
            return np.array(draw(st.lists(st.sampled_from(options), min_size=pixels, max_size=pixels)))
        return draw(st.sampled_from(options))

    effects: list[Effect] = []
    if draw(st.booleans()):
        effects.append(Detection(pdp=value([0.0, 0.3, 1.0]), relative=value([1.0, 0.5, 2.0])))
    if draw(st.booleans()):
        effects.append(DarkCounts(rate=value([0.0, 100.0, 1e6])))
    if draw(st.booleans()):
        lifetime = draw(st.sampled_from([1e-9, 3e-6, 1e-3]))
        effects.append(Afterpulsing(probability=value([0.0, 0.005, 0.5, 1.0]), lifetime=lifetime))
    if draw(st.booleans()):
        effects.append(DeadTime(duration=value([0.0, 50e-9, 2e-6, 1.0])))
    readouts: tuple[str, ...] = draw(st.sampled_from([ALL, ("tr",), ("qis",), ("str",), ("tr", "qis")]))
    # 1e-14 s: more than 2^32 ticks in a millisecond; live / 7: no whole number of ticks in a frame, coarse
    ticks = [10e-12, 1e-14, live / 7, live / 2]
    if readouts == ("qis",):
        ticks.append(0.0)
    tick = draw(st.sampled_from(ticks))
    if tick:
        effects.append(Tdc(resolution=tick))
    n = draw(st.integers(1, 3))
    bright = draw(st.lists(st.sampled_from([0.0, 0.3, 20.0, 600.0]), min_size=1, max_size=6))
    photons = np.resize(np.array(bright), (n, pixels)) / exposure
    return sensor(pixels, *effects), conditions, photons, readouts


@pytest.mark.slow  # every stage of every readout is compiled for it
@settings(max_examples=120, deadline=None, derandomize=True)
@given(paper_sensors(), st.integers(0, 2**40), st.integers(0, 2**62))
def test_fused_and_staged_lines_agree(case: Any, image: int, seed: int) -> None:
    chip, conditions, photons, readouts = case
    assert chip.is_paper_line
    keys = streams(np.arange(image, image + len(photons)), seed)
    fused = chip.expose(photons, conditions, keys, readouts)
    staged = chip.expose(photons, conditions, keys, readouts, staged=True)
    assert_same(fused, staged)
    assert_sound(fused, conditions, chip.tick)


@pytest.mark.parametrize("staged", [False, True])
@pytest.mark.parametrize("readouts", [("qis",), ("tr", "qis")])
def test_waited_belongs_to_str(readouts: tuple[str, ...], staged: bool) -> None:
    """`Recorded`: a column is None where its readout was not asked for."""
    chip = sensor(4, *paper_effects())
    recorded = chip.expose(np.full((2, 4), 1e5), PAPER, streams([0, 1]), readouts, staged)
    assert recorded.ones is not None and recorded.waited is None


def test_lines_agree_on_a_batch_that_the_staged_line_cuts() -> None:
    chip = sensor(40, *paper_effects())
    photons = np.linspace(0, 4e6, 40)[None, :].repeat(60, axis=0)
    keys = streams(np.arange(60))
    fused = chip.expose(photons, PAPER, keys, ALL)
    assert_same(fused, chip.expose(photons, PAPER, keys, ALL, staged=True))
    assert_sound(fused, PAPER, chip.tick)


MAPS = [
    Detection(pdp=np.array([0.0, 0.5, 1.0, 0.2])),
    Detection(relative=np.array([0.0, 0.5, 1.0, 0.2])),
    DarkCounts(rate=np.array([0.0, 1e3, 1e5, 0.0])),
    Afterpulsing(probability=np.array([0.0, 0.5, 1.0, 0.0]), lifetime=1e-6),
    DeadTime(duration=np.array([0.0, 50e-9, 1e-6, 1e-5])),
]


@pytest.mark.parametrize("mapped", MAPS, ids=lambda e: f"{e.name}-{len(e.__dict__)}")
@pytest.mark.parametrize("rules", ["paper", "device"])
def test_maps_repeat_for_every_channel(mapped: Effect, rules: str) -> None:
    """A channel of a colour image is an image of its own to the sensor: each one meets the same map."""
    others = [e for e in paper_effects() if e.name != mapped.name]
    chip = sensor(4, *others, mapped, rules=rules)
    plane = np.full((6, 4), 2e6)
    keys = streams(np.arange(6))
    colour = chip.expose(plane, PAPER, keys, ALL)
    assert colour.counts is not None and len(colour.counts) == 2 * 12
    assert_same(colour, chip.expose(plane, PAPER, keys, ALL, staged=True))
    assert_same(colour.images(3, 4), chip.expose(plane[3:4], PAPER, streams([3]), ALL))
    grouped = colour.grouped(3)
    assert grouped.tr is not None and grouped.tr.pixels == 12
    assert_same(grouped.images(1, 2), colour.images(3, 6).grouped(3))
    if mapped.name in ("detection", "dark_counts"):
        expected, _ = chip.rates(plane, PAPER)
        # 2e6 photons/s for 1 ms: a live pixel has hundreds of detections, a blind one a dark count at most
        assert np.array_equal(colour.counts.reshape(6, 4) > 20, expected > 1e5)


def test_photons_of_another_size_are_refused() -> None:
    with pytest.raises(ValueError, match="4 pixels"):
        sensor(4, *paper_effects()).expose(np.ones((1, 12)), PAPER, streams([0]), ALL)


# ---- draws belong to an image -----------------------------------------------------------------------------


def experiment(
    effects: str,
    pixels: int = 4,
    rules: str = "paper",
    readouts: str = "[tr, str, qis]",
    rows: int = 1,
    lux: str = "1 lux",
) -> Experiment:
    text = f"""
seed: 3
scene: {{images: {{source: digits, train: 10, test: 0}}, lux: [{lux}]}}
recording: {{exposure: 1 ms, frames: 25, frame_time: 40 us, readouts: {readouts}}}
reconstruct: []
sensor:
  rules: {rules}
  layout: {{rows: {rows}, columns: {pixels}, pixel_area: 25 um^2}}
  effects: {{{effects}}}
"""
    return config.build(document.parse(text, "test.yaml"), Path("."))


PAPER_TEXT = (
    "detection: {pdp: 0.5}, dark_counts: {rate: 100 Hz}, afterpulsing: {probability: 5 %, lifetime: 25 ns}, "
    "dead_time: {duration: 50 ns}, tdc: {resolution: 10 ps}"
)


def grey_images(n: int, rows: int = 1, pixels: int = 4) -> Images:
    grey = (np.arange(n * rows * pixels) * 37 % 256).astype(np.uint8).reshape(n, rows, pixels)
    return Images(grey, None, 255.0)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(cuts=st.lists(st.integers(1, 69), max_size=5, unique=True), rules=st.sampled_from(["paper", "device"]))
def test_any_cut_of_a_batch_is_the_batch(cuts: list[int], rules: str) -> None:
    one = experiment(PAPER_TEXT, rules=rules)
    images = grey_images(70)
    (level,) = one.levels
    whole = one.simulate(level, "train", images, 0, 70)
    bounds = [0, *sorted(cuts), 70]
    parts = [one.simulate(level, "train", images, a, b) for a, b in itertools.pairwise(bounds)]
    assert_same(whole, Recorded.join(parts))
    for a, b, part in zip(bounds[:-1], bounds[1:], parts, strict=True):
        assert_same(whole.images(a, b), part)


@pytest.mark.slow
@pytest.mark.parametrize("rules", ["paper", "device"])
def test_images_alone_and_in_reverse(rules: str) -> None:
    chip = sensor(30, *paper_effects(), rules=rules)
    photons = np.linspace(0, 2e6, 30 * 9).reshape(9, 30)
    numbers = np.array([5, 0, 7, 2**33, 1, 3, 100, 2, 4], np.uint64)
    batch = chip.expose(photons, PAPER, streams(numbers), ALL)
    back = chip.expose(photons[::-1], PAPER, streams(numbers[::-1]), ALL)
    for i in range(9):
        alone = chip.expose(photons[i : i + 1], PAPER, streams(numbers[i : i + 1]), ALL)
        assert_same(batch.images(i, i + 1), alone)
        assert_same(back.images(8 - i, 9 - i), alone)


def _qis(chip: Sensor, keys: Streams, photons: np.ndarray) -> np.ndarray:
    frames = chip.expose(photons, PAPER, keys, ("qis",)).frames
    assert frames is not None
    return frames.unpacked()


def test_readouts_that_are_left_out_change_nothing() -> None:
    chip = sensor(30, *paper_effects())
    photons = np.linspace(0, 2e6, 60).reshape(2, 30)
    everything = columns(chip.expose(photons, PAPER, streams([0, 1]), ALL))
    for readouts in (("tr",), ("qis",), ("str",), ("str", "tr")):
        for staged in (False, True):
            some = columns(chip.expose(photons, PAPER, streams([0, 1]), readouts, staged))
            assert all(
                value.tobytes() == everything[name].tobytes()  # type: ignore[union-attr]
                for name, value in some.items()
                if value is not None and name != "waited"
            )


def test_a_later_effect_does_not_move_the_arrivals() -> None:
    """Dead time, converter, and in frames also where there are no afterpulses; an afterpulse adds events."""
    photons = np.linspace(0, 2e6, 60).reshape(2, 30)
    keys = streams([0, 1])

    def times(*effects: Effect) -> np.ndarray:
        tr = sensor(30, Detection(pdp=0.5), *effects).expose(photons, PAPER, keys, ("tr",)).tr
        assert tr is not None
        return tr.times

    bare = times()
    assert len(bare) > 1000
    kept = times(DeadTime(duration=1e-6))
    assert 0 < len(kept) < len(bare) and set(kept) < set(bare)
    more = times(Afterpulsing(probability=0.2, lifetime=1e-6))
    assert len(more) > len(bare) and set(bare) < set(more)
    rounded = times(Tdc(resolution=1e-9))
    assert rounded == pytest.approx(bare, abs=0.5001e-9)
    both = times(Afterpulsing(probability=0.2, lifetime=1e-6), DeadTime(duration=1e-9))
    assert len(set(both) & set(bare)) > 0.99 * len(bare)
    bits = _qis(sensor(30, Detection(pdp=0.5)), keys, photons)
    later = sensor(30, Detection(pdp=0.5), DeadTime(duration=1e-6), Tdc(resolution=1e-9))
    assert np.array_equal(bits, _qis(later, keys, photons))


def test_draws_depend_on_seed_level_split_and_image() -> None:
    chip = sensor(200, *paper_effects())
    photons = np.full((1, 200), 2e5)
    base = {"images": [4], "seed": 1, "level": "lux/a", "split": "train"}
    recordings = []
    for change in ({}, {"seed": 2}, {"level": "lux/b"}, {"split": "test"}, {"images": [5]}):
        recorded = chip.expose(photons, PAPER, streams(**{**base, **change}), ("tr",))
        assert recorded.tr is not None and recorded.tr.ticks is not None and recorded.counts is not None
        recordings.append(recorded)
    again = chip.expose(photons, PAPER, streams(**base), ("tr",))
    assert_same(recordings[0], again)
    ticks = [set(r.tr.ticks.tolist()) for r in recordings]  # type: ignore[union-attr]
    for i, a in enumerate(ticks):
        for b in ticks[:i]:
            # 20,000 stamps in 1e8 ticks meet by chance 4 times
            assert len(a & b) < 40
    for other in recordings[1:]:
        mean = recordings[0].counts.mean()  # type: ignore[union-attr]
        laws.mean_is((recordings[0].counts - mean) * (other.counts - mean), 0.0)  # type: ignore[operator]


def test_a_level_is_keyed_by_its_value() -> None:
    images = grey_images(3)

    def made(lux: str) -> Recorded:
        one = experiment(PAPER_TEXT, lux=lux)
        return one.simulate(one.levels[0], "train", images, 0, 3)

    reference = made("1 lux")
    for text in ("1000 mlux", "1e3 mlux", "0.001 klux", "1.0 lux", "1000000 ulux"):
        assert_same(reference, made(text))
    one = experiment(PAPER_TEXT)
    photons = one.photons(one.levels[0], images.pixels, 255.0)
    keys = [
        one.streams(Level("x", kind, 1.0), "train", np.arange(3, dtype=np.uint64)) for kind in ("lux", "irradiance")
    ]
    a, b = (one.sensor.expose(photons, one.conditions, key, ("tr",)) for key in keys)
    assert a.tr is not None and b.tr is not None and not np.array_equal(a.tr.times, b.tr.times)


def test_maps_are_drawn_from_the_chip_seed() -> None:
    text = PAPER_TEXT.replace("100 Hz", "{lognormal: {median: 1 kHz, sigma: 1}}")
    one = experiment(text, pixels=4)
    other = replace(one, seed=99)
    dark = one.sensor.effect("dark_counts")
    assert dark is not None and np.ptp(dark.rate) > 0  # type: ignore[attr-defined]
    again = experiment(text + ", ", pixels=4).sensor.effect("dark_counts")
    assert np.array_equal(dark.rate, again.rate)  # type: ignore[attr-defined,union-attr]
    assert other.sensor is one.sensor


def test_stamps_that_round_up_to_a_power_of_two_fit_their_type() -> None:
    """An exposure of 2^32 - 1/4 ticks holds moments that round to 2^32, one too many for 32 bits."""
    assert unsigned_for(2.0**32 - 1, "stamps") is np.uint32
    assert unsigned_for(2.0**32, "stamps") is np.uint64
    largest = 2.0**32 - 0.25
    assert round(largest) <= np.iinfo(unsigned_for(largest, "stamps")).max


# ---- the effects of others --------------------------------------------------------------------------------


@pytest.fixture
def no_trace() -> Iterator[None]:
    """What a test registers is forgotten behind it."""
    list(Effect.registry)  # everything of the package is known before
    before = dict(Effect.registry.classes)
    yield
    Effect.registry.classes.clear()
    Effect.registry.classes.update(before)


def define(stage: str, **members: Any) -> type[Effect]:
    """A stranger's effect `stranger`, uncounted, of the hooks given."""
    return type("Stranger", (Effect,), {"__module__": __name__, **members}, stage=stage)  # type: ignore[call-arg]


def _jitter(self: Any, events: Events, rng: np.random.Generator) -> Events:
    """Earlier by a random time, folded at 0; sorted again within each row."""
    times = np.abs(events.times - self.sigma * rng.exponential(size=len(events)))
    order = np.lexsort((times, events.rows))
    return Events(times[order], events.offsets, events.pixels)


def _jitter_in_place(self: Any, events: Events, rng: np.random.Generator) -> Events:
    return Events(np.abs(events.times - 1e-9 * rng.exponential(size=len(events))), events.offsets, events.pixels)


def _neighbours(self: Any, events: Events, rng: np.random.Generator) -> Children:
    """Crosstalk to the next pixel of the same image."""
    parent = np.flatnonzero(rng.random(len(events)) < 0.2)
    rows = events.rows[parent]
    return Children(parent, np.zeros(len(parent)), rows - rows % events.pixels + (rows + 1) % events.pixels)


STRANGERS: dict[str, dict[str, Any]] = {
    "light": {"apply": lambda self, rate, conditions: rate * np.linspace(0.5, 1.5, rate.shape[-1])},
    "detection": {"apply": lambda self, rate, conditions: rate * 0.9},
    "dark": {"apply": lambda self, rate, conditions: rate + 500.0},
    "arrival": {
        "factor": lambda self, t, conditions: 1 + 0.5 * np.sin(2e4 * t),
        "maximum": lambda self, conditions: 1.5,
    },
    "gate": {"open": lambda self, t, conditions: t % 1e-4 < 0.5e-4},
    "correlated": {"spawn": _neighbours},
    "dead_time": {"blind_time": lambda self: np.asarray(2e-6)},
    "timing": {"apply": _jitter, "sigma": parameter(1e-7, "s", "width")},
    "readout": {"apply": lambda self, events, rng: events.keep(rng.random(len(events)) < 0.7)},
}


@pytest.mark.parametrize("readouts", ["[tr]", "[tr, qis]", "[tr, str, qis]"])
@pytest.mark.parametrize("rules", ["paper", "device"])
@pytest.mark.parametrize("stage", STRANGERS)
@pytest.mark.usefixtures("no_trace")
def test_a_strangers_effect_at_any_stage(stage: str, rules: str, readouts: str) -> None:
    """It does something, makes sound recordings, and any range is the cut of the whole."""
    define(stage, **STRANGERS[stage])
    n = 2 * BLOCK + 10
    images = grey_images(n)
    plain = experiment(PAPER_TEXT, rules=rules, readouts=readouts)
    one = experiment(PAPER_TEXT + ", stranger: {}", rules=rules, readouts=readouts)
    assert not one.sensor.is_paper_line or stage in ("light", "detection", "dark")
    assert one.sensor.block == (BLOCK if stage in ("correlated", "timing", "readout") else 1)
    (level,) = one.levels
    whole = one.simulate(level, "train", images, 0, n)
    assert_sound(whole, one.conditions, one.sensor.tick)
    before = plain.simulate(level, "train", images, 0, n)
    assert before.tr is not None and whole.tr is not None
    assert not np.array_equal(before.tr.times, whole.tr.times)
    for a, b in (
        (0, 1),
        (5, 9),
        (BLOCK - 1, BLOCK + 1),
        (BLOCK, 2 * BLOCK),
        (2 * BLOCK + 3, n),
        (n - 1, n),
        (1, n),
    ):
        assert_same(whole.images(a, b), one.simulate(level, "train", images, a, b))


@pytest.mark.usefixtures("no_trace")
def test_a_strangers_timing_effect_on_str_stamps() -> None:
    """STR stamps count from the start of their frames: each moved a little, they are as sound as before."""
    define("timing", apply=_jitter_in_place)
    one = experiment("detection: {}, stranger: {}", readouts="[str]")
    images = grey_images(BLOCK)
    recorded = one.simulate(one.levels[0], "train", images, 0, BLOCK)
    assert recorded.frames is not None and recorded.frames.first is not None
    assert len(recorded.frames.first) > 1000


@pytest.mark.usefixtures("no_trace")
def test_a_sorting_timing_effect_leaves_str_stamps_in_their_frames() -> None:
    """`Events` are ascending within a row, so that a jitter of 1 ps sorts them: no stamp may change its frame."""
    images = grey_images(BLOCK)
    plain = experiment("detection: {}")
    before = plain.simulate(plain.levels[0], "train", images, 0, BLOCK).frames
    define("timing", **STRANGERS["timing"])
    one = experiment("detection: {}, stranger: {sigma: 1 ps}")
    after = one.simulate(one.levels[0], "train", images, 0, BLOCK).frames
    assert before is not None and after is not None
    assert np.abs(after.stamps() - before.stamps()).max() < 100e-12


@pytest.mark.usefixtures("no_trace")
def test_a_strangers_timing_effect_comes_before_the_converter_whatever_its_name() -> None:
    """Rounding is last: stamps are whole ticks, as `tick` and a dataset's `ticks` say."""
    for name in ("Aaa", "Zzz"):
        members = {"__module__": __name__, **STRANGERS["timing"]}
        type(name, (Effect,), members, stage="timing")  # type: ignore[call-arg]
        one = experiment(f"{PAPER_TEXT}, {name.lower()}: {{}}", readouts="[tr]")
        tr = one.simulate(one.levels[0], "train", grey_images(BLOCK), 0, BLOCK).tr
        assert one.sensor.tick == 10e-12
        assert tr is not None and tr.ticks is not None and tr.tick == 10e-12, name


@pytest.mark.parametrize("stage", STRANGERS)
@pytest.mark.usefixtures("no_trace")
def test_an_earlier_stage_does_not_see_a_later_stranger(stage: str) -> None:
    """A later stage that does nothing leaves the draws of all the earlier ones where they were."""
    identity: dict[str, dict[str, Any]] = {
        "light": {"apply": lambda self, rate, conditions: rate},
        "detection": {"apply": lambda self, rate, conditions: rate},
        "dark": {"apply": lambda self, rate, conditions: rate},
        "arrival": {
            "factor": lambda self, t, conditions: np.ones(len(t)),
            "maximum": lambda self, conditions: 1.0,
        },
        "gate": {"open": lambda self, t, conditions: np.ones(len(t), bool)},
        "correlated": {"spawn": lambda self, events, rng: Children(np.zeros(0, int), rng.random(0))},
        "dead_time": {"blind_time": lambda self: np.zeros(())},
        "timing": {"apply": lambda self, events, rng: events},
        "readout": {"apply": lambda self, events, rng: events},
    }
    define(stage, **identity[stage])
    images = grey_images(BLOCK)
    for rules in ("paper", "device"):
        plain, one = (
            experiment(PAPER_TEXT + more, rules=rules, readouts="[tr, qis]") for more in ("", ", stranger: {}")
        )
        made = [x.simulate(x.levels[0], "train", images, 0, BLOCK) for x in (plain, one)]
        assert_same(*made)


def _raise(*_: Any) -> Any:
    raise ZeroDivisionError("by the stranger")


def _unsorted(self: Any, events: Events, rng: np.random.Generator) -> Events:
    return Events(events.times[::-1].copy(), events.offsets, events.pixels)


def _fewer_rows(self: Any, events: Events, rng: np.random.Generator) -> Events:
    return Events(events.times, events.offsets[[0, -1]], events.pixels)


def _children(**bad: Any) -> Any:
    def spawn(self: Any, events: Events, rng: np.random.Generator) -> Children:
        good: dict[str, Any] = {"parent": np.array([0]), "delay": np.array([1e-9]), "row": None}
        return Children(**{**good, **bad})

    return spawn


def _one_on(offsets: np.ndarray) -> np.ndarray:
    """One event of the second row goes to the first."""
    return (
        np.append(offsets[0], np.append(offsets[1] + (len(offsets) > 2), offsets[2:])) if len(offsets) > 1 else offsets
    )


BAD: list[tuple[str, dict[str, Any], str]] = [
    ("light", {"apply": _raise}, "raises"),
    ("light", {"apply": lambda self, rate, c: None}, "none"),
    ("light", {"apply": lambda self, rate, c: rate[:, :1]}, "shape"),
    ("light", {"apply": lambda self, rate, c: rate * np.nan}, "nan"),
    ("light", {"apply": lambda self, rate, c: rate - 1e9}, "negative"),
    ("detection", {"apply": _raise}, "raises"),
    ("dark", {"apply": lambda self, rate, c: -rate}, "negative"),
    ("dark", {"apply": lambda self, rate, c: rate.ravel()}, "shape"),
    ("arrival", {"factor": _raise, "maximum": lambda self, c: 1.0}, "raises"),
    ("arrival", {"factor": lambda self, t, c: 2.0 + t, "maximum": lambda self, c: 1.0}, "beyond its maximum"),
    ("arrival", {"factor": lambda self, t, c: t * np.nan, "maximum": lambda self, c: 1.0}, "nan"),
    ("arrival", {"factor": lambda self, t, c: t[:-1] * 0, "maximum": lambda self, c: 1.0}, "shape"),
    ("arrival", {"factor": lambda self, t, c: t * 0, "maximum": lambda self, c: -1.0}, "negative maximum"),
    ("gate", {"open": _raise}, "raises"),
    ("gate", {"open": lambda self, t, c: np.ones(len(t))}, "type"),
    ("gate", {"open": lambda self, t, c: np.ones(len(t) + 1, bool)}, "shape"),
    ("correlated", {"spawn": _raise}, "raises"),
    ("correlated", {"spawn": lambda self, events, rng: events}, "type"),
    ("correlated", {"spawn": _children(parent=np.array([-1]))}, "parent before the first"),
    ("correlated", {"spawn": _children(parent=np.array([10**9]))}, "parent behind the last"),
    ("correlated", {"spawn": _children(parent=np.array([0.0]))}, "parent no index"),
    ("correlated", {"spawn": _children(delay=np.array([-1e-9]))}, "before its cause"),
    ("correlated", {"spawn": _children(delay=np.array([np.nan]))}, "nan"),
    ("correlated", {"spawn": _children(delay=np.array([1e-9, 1e-9]))}, "shape"),
    ("correlated", {"spawn": _children(row=np.array([-1]))}, "row before the first"),
    ("correlated", {"spawn": _children(row=np.array([10**6]))}, "row behind the last"),
    ("correlated", {"spawn": _children(row=np.array([0, 1]))}, "rows of another number"),
    ("dead_time", {"blind_time": _raise}, "raises"),
    ("dead_time", {"blind_time": lambda self: np.zeros(3)}, "shape"),
    ("timing", {"apply": _raise}, "raises"),
    ("timing", {"apply": _unsorted}, "unsorted"),
    ("timing", {"apply": lambda self, events, rng: events.times}, "type"),
    ("timing", {"apply": _fewer_rows}, "rows"),
    ("timing", {"apply": lambda self, e, rng: Events(e.times - 1.0, e.offsets, e.pixels)}, "before 0"),
    ("timing", {"apply": lambda self, e, rng: Events(e.times * np.nan, e.offsets, e.pixels)}, "nan"),
    ("timing", {"apply": lambda self, e, rng: e.keep(np.arange(len(e)) % 2 > 0)}, "must not add or remove stamps"),
    (
        "timing",
        {"apply": lambda self, e, rng: Events(e.times * 0, _one_on(e.offsets), e.pixels)},
        "each stamp in its row",
    ),
    ("correlated", {"spawn": _children(parent=np.array([True]))}, "are a mask; give their indices"),
    ("readout", {"apply": _raise}, "raises"),
    ("readout", {"apply": _unsorted}, "unsorted"),
    ("readout", {"apply": lambda self, events, rng: None}, "none"),
    ("readout", {"apply": _fewer_rows}, "rows"),
]


@pytest.mark.parametrize(("stage", "hooks", "wrong"), BAD, ids=[f"{stage}-{wrong}" for stage, _, wrong in BAD])
@pytest.mark.parametrize("rules", ["paper", "device"])
@pytest.mark.usefixtures("no_trace")
def test_a_strangers_mistake_is_named(stage: str, hooks: dict[str, Any], wrong: str, rules: str) -> None:
    """One sentence with the effect and its file."""
    define(stage, **hooks)
    images = grey_images(BLOCK)
    with pytest.raises(EffectError) as caught:
        one = experiment(PAPER_TEXT + ", stranger: {}", rules=rules, readouts="[tr, qis]")
        one.simulate(one.levels[0], "train", images, 0, BLOCK)
    sentence = str(caught.value)
    assert "stranger" in sentence and Path(__file__).name in sentence and "\n" not in sentence
    assert wrong in sentence or len(wrong.split()) < 5  # the words of the longer ones are its own


@pytest.mark.usefixtures("no_trace")
def test_the_effect_that_loses_first_stamps_is_named() -> None:
    """And not the last one of its stage, the converter."""
    define("timing", apply=lambda self, events, rng: events.keep(rng.random(len(events)) < 0.5))
    one = experiment("detection: {}, stranger: {}, tdc: {}", readouts="[str]")
    with pytest.raises(EffectError, match="the effect stranger: apply must not add or remove stamps, but it makes"):
        one.simulate(one.levels[0], "train", grey_images(BLOCK), 0, BLOCK)


@pytest.mark.usefixtures("no_trace")
def test_whole_numbers_of_numpy_are_numbers() -> None:
    define("arrival", factor=lambda self, t, c: np.ones(len(t)), maximum=lambda self, c: np.int64(1))
    one = experiment("detection: {}, stranger: {}", readouts="[tr]")
    assert one.simulate(one.levels[0], "train", grey_images(BLOCK), 0, BLOCK).tr is not None
    define("dead_time", carried=lambda self: np.int64(1), influence=lambda self: np.int64(2))
    one = experiment("detection: {}, dead_time: {}, stranger: {}", readouts="[tr]")
    assert one.sensor.carried == 1.0 and influence(one.sensor.effect("stranger")) == 2.0  # type: ignore[arg-type]


@pytest.mark.usefixtures("no_trace")
def test_a_limit_of_another_type_says_what_it_is() -> None:
    define("readout", limit=lambda self, counts: counts.astype(float))
    one = experiment("detection: {}, stranger: {}", readouts="[counts], bits: 1")
    with pytest.raises(EffectError, match=r"limit must return counts of shape .* and type uint8, not float64 of shape"):
        one.simulate(one.levels[0], "train", grey_images(BLOCK), 0, BLOCK)


@pytest.mark.parametrize(
    ("mean", "says"),
    [
        (lambda rate: None, r"float64 rates of shape \(1, 4\), not NoneType"),
        (lambda rate: float(rate.mean()), r"float64 rates of shape \(1, 4\), not float"),
        (lambda rate: rate.mean(axis=1), r"float64 rates of shape \(1, 4\), not float64 of shape \(1,\)"),
        (lambda rate: rate.astype(np.float32), "not float32"),
        (lambda rate: rate * np.nan, "negative or not finite"),
        (lambda rate: rate - 1e9, "negative or not finite"),
    ],
)
@pytest.mark.parametrize("stage", ["arrival", "gate", "correlated", "dead_time", "timing", "readout"])
@pytest.mark.usefixtures("no_trace")
def test_a_mean_that_is_none_is_named(stage: str, mean: Any, says: str) -> None:
    define(stage, **STRANGERS[stage], expected_rate=lambda self, rate, conditions: mean(rate))
    says = rf"{Path(__file__).name}: the effect stranger: expected_rate .*{says}"
    with pytest.raises((EffectError, ConfigError), match=says):  # of a cascade, a config asks for it
        one = experiment("detection: {pdp: 0.5}, stranger: {}")
        one.sensor.expected(np.full((1, 4), 1e5), one.conditions)


def _in_place(hook: str, operator: Any, by: float) -> Any:
    """A hook that changes its first argument, or the times of the events that this is, and returns it."""

    def changed(self: Any, given: Any, *_: Any) -> Any:
        array = given.times if isinstance(given, Events) else given
        operator(array, by, out=array)
        return given if hook in ("apply", "limit") else np.ones(len(array), bool)

    return {hook: changed} | ({"maximum": lambda self, c: 1.0} if hook in ("factor", "modulate") else {})


def _other_offsets(self: Any, events: Events, rng: np.random.Generator) -> Events:
    events.offsets = events.offsets * 0
    return events


IN_PLACE: list[tuple[str, dict[str, Any]]] = [
    ("light", _in_place("apply", np.multiply, 0.5)),
    ("detection", _in_place("apply", np.multiply, 0.5)),
    ("dark", _in_place("apply", np.add, 1e3)),
    ("arrival", _in_place("factor", np.divide, 1e-3)),
    ("arrival", _in_place("modulate", np.divide, 1e-3)),
    ("gate", _in_place("open", np.fmod, 1e-6)),
    ("correlated", _in_place("spawn", np.add, 1e-6)),
    ("dead_time", _in_place("sensitivity", np.multiply, 1.0)),
    ("timing", _in_place("apply", np.add, 1e-8)),
    ("timing", {"apply": _other_offsets}),
    ("readout", _in_place("apply", np.add, 1e-8)),
    ("readout", _in_place("limit", np.subtract, 1)),
]


@pytest.mark.parametrize(("stage", "hooks"), IN_PLACE, ids=[f"{stage}-{next(iter(h))}" for stage, h in IN_PLACE])
@pytest.mark.usefixtures("no_trace")
def test_a_hook_cannot_change_what_it_is_given(stage: str, hooks: dict[str, Any]) -> None:
    """The rates before an effect, and the times of events, are others' as well: a change of them would be no error."""
    define(stage, **hooks)
    says = rf"{Path(__file__).name}:\d+: the effect stranger failed: .*not its own to change: write `x = x \+ more`"
    with pytest.raises(EffectError, match=says):
        one = experiment("detection: {}, dead_time: {duration: 20 ns}, stranger: {}", readouts="[tr, counts], bits: 1")
        one.simulate(one.levels[0], "train", grey_images(BLOCK), 0, BLOCK)


@pytest.mark.usefixtures("no_trace")
def test_what_a_hook_returns_can_be_written() -> None:
    """Also where it is what it was given, or a view of it: kernels are compiled for arrays that can be written."""
    same = {"apply": lambda self, events, rng: events}
    view = {
        "apply": lambda self, events, rng: Events(events.times[:], events.offsets[:], events.pixels, end=events.end)
    }
    plain, images = experiment("detection: {}", readouts="[tr]"), grey_images(BLOCK)
    before = plain.simulate(plain.levels[0], "train", images, 0, BLOCK)
    for stage, hooks in (("timing", same), ("readout", view), ("light", {"apply": lambda self, rate, c: rate[:]})):
        define(stage, **hooks)
        one = experiment("detection: {}, stranger: {}", readouts="[tr]")
        made = one.simulate(one.levels[0], "train", images, 0, BLOCK)
        assert_same(made, before)
        assert made.tr is not None and type(made.tr) is Events
        assert made.tr.times.flags.writeable and made.tr.offsets.flags.writeable


@pytest.mark.usefixtures("no_trace")
def test_afterpulses_meet_the_gate() -> None:
    """What a gate hides is hidden for the children as well, under both rules."""
    define("gate", open=lambda self, t, conditions: t % 1e-5 < 0.5e-5)
    text = "afterpulsing: {probability: 50 %, lifetime: 3 us}, detection: {}, stranger: {}"
    for rules in ("paper", "device"):
        one = experiment(text, rules=rules, readouts="[tr]")
        tr = one.simulate(one.levels[0], "train", grey_images(20), 0, 20).tr
        assert tr is not None and len(tr) > 1000
        assert np.all(tr.times % 1e-5 < 0.5e-5)


@pytest.mark.usefixtures("no_trace")
def test_an_arrival_factor_has_its_law() -> None:
    """Thinned by cos^2: the distribution over the exposure, and the mean rate."""
    define(
        "arrival",
        factor=lambda self, t, conditions: 2 * np.cos(math.pi * t / 1e-3) ** 2,
        maximum=lambda self, conditions: 2.0,
    )
    chip = sensor(50, Detection(pdp=0.5), DarkCounts(rate=0.0), Effect.registry.find("stranger")())
    tr = chip.expose(np.full((100, 50), 2e5), PAPER, streams(np.arange(100)), ("tr",)).tr
    assert tr is not None
    laws.poisson_mean(len(tr), 100 * 50 * 100)

    def cdf(t: np.ndarray) -> np.ndarray:
        return t / 1e-3 + np.sin(2 * math.pi * t / 1e-3) / (2 * math.pi)

    laws.distribution_is(tr.times, cdf)
