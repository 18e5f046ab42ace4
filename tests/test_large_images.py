"""Images too large to be simulated at once: part by part, bit for bit the same, or frames without their events."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import commands
import laws
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

import spadmnist.sensor
from spadmnist import config, document, experiment, factory, kernels, plan, shard_plan, standing, streams, twin
from spadmnist.effects import Conditions, Effect
from spadmnist.errors import InputError
from spadmnist.events import Events, Layout
from spadmnist.experiment import Experiment
from spadmnist.images import Images
from spadmnist.line import Line
from spadmnist.plugins import Distribution
from spadmnist.readout import Recorded
from spadmnist.recording import Capture, Light
from spadmnist.sensor import Sensor
from spadmnist.streams import Draws, Streams
from spadmnist.testing import _same, check_effect, strong
from spadmnist.window import Window

CONFIGS = Path(__file__).parents[1] / "configs"
ALL = ("tr", "str", "qis", "counts")
SUMMED = Conditions(1e-3, 60, 12e-6, 16e-6, 555e-9, bits=2)
COUNTER = Conditions(1e-3, 60, 12e-6, 16e-6, 555e-9, bits=3, counting="counter")
GRID = Layout(12, 10, 25e-12, 1.0)
PLACED = Layout(1, 60, 25e-12, 1.0, np.random.Generator(np.random.PCG64(1)).random((60, 2)) * 1e-4)


def of(name: str, **values: Any) -> Effect:
    made: Effect = Effect.registry.find(name)(**values)
    return made


def strongly(name: str) -> Effect:
    return of(name, **{key: strong(p) for key, p in Effect.registry.find(name).parameters.items()})


def hot_pixels() -> Effect:
    rate = np.full(120, 1e3)
    rate[[3, 40, 41, 119]] = 2e6
    return of("dark_counts", rate=rate)


EVERY = [name for name in Effect.registry if Effect.registry.find(name).__module__.startswith("spadmnist.")]
SENSORS: dict[str, list[Effect]] = {
    "no coupling": [of("detection"), of("tdc")],
    "dead time": [of("detection"), of("dead_time", duration=Distribution("normal", (60e-9, 5e-9))), of("tdc")],
    "paralyzable": [of("detection"), of("dead_time", paralyzable=True), of("slow_recovery")],
    "hot pixels": [of("detection", relative=Distribution("normal", (1.0, 0.1))), hot_pixels(), of("tdc")],
    "gradient": [of("detection"), of("illumination_gradient", x=0.8, y=-0.5), of("tdc")],
    "traps": [of("detection"), of("afterpulsing", probability=0.1), of("slow_afterpulsing", probability=0.3)],
    "crosstalk": [of("detection"), of("crosstalk", probability=0.05), of("tdc")],
    "readout loss": [of("detection"), of("readout_loss", service_time=20e-9, queue=4.0), of("tdc")],
    "all but what ties": [strongly(name) for name in EVERY if name not in ("crosstalk", "readout_loss")],
}
TIED = {"crosstalk": "crosstalk", "readout loss": "readout_loss"}


def drawn(images: int, name: str = "large") -> Streams:
    return Streams(1, name, "test", np.arange(images, dtype=np.uint64))


def exposed(sensor: Sensor, conditions: Conditions, readouts: Collection[str], **how: Any) -> Recorded:
    """Two images, brighter from one pixel to the next, the second one darker."""
    photons = np.outer([2e5, 1e5], np.linspace(0.1, 1.9, sensor.layout.pixels))
    return sensor.expose(photons, conditions, drawn(2), readouts, staged=True, **how)


def parts_of(monkeypatch: pytest.MonkeyPatch, make: Callable[[], Any]) -> tuple[Any, int]:
    """(what is made, in how many goes through the line)."""
    goes = 0
    line = Line.run

    def counting(*arguments: Any) -> Recorded:
        nonlocal goes
        goes += 1
        return line(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Line, "run", counting)
        return make(), goes


# --- part by part ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("causes", [False, True], ids=["", "causes"])
@pytest.mark.parametrize("rules", ["paper", "device"])
@pytest.mark.parametrize("name", SENSORS)
def test_parts_are_the_uncut_image_bit_for_bit(
    monkeypatch: pytest.MonkeyPatch, name: str, rules: str, causes: bool
) -> None:
    """By rows, and by less than a row; where an effect ties the pixels together, there is one part."""
    sensor = Sensor(GRID, SENSORS[name], rules, 5).resolved()
    for conditions in (SUMMED, COUNTER):
        whole = exposed(sensor, conditions, ALL, causes=causes)
        for most, least in ((2500.0, 2), (150.0, 20)):
            made, goes = parts_of(
                monkeypatch, lambda c=conditions, m=most: exposed(sensor, c, ALL, causes=causes, most=m)
            )
            _same(made, whole, f"{name}, {rules}, parts of {most:g}")
            assert goes == 1 if name in TIED else goes >= least


@pytest.mark.parametrize("rules", ["paper", "device"])
def test_parts_of_pixels_one_by_one_and_of_a_part_of_a_chip(monkeypatch: pytest.MonkeyPatch, rules: str) -> None:
    placed = Sensor(PLACED, SENSORS["all but what ties"], rules, 5).resolved()
    part = Sensor(GRID, SENSORS["all but what ties"], rules, 5).resolved().cropped(slice(3, 8), slice(6, None))
    for sensor in (placed, part):
        whole = exposed(sensor, SUMMED, ALL)
        made, goes = parts_of(monkeypatch, lambda s=sensor: exposed(s, SUMMED, ALL, most=150.0))
        _same(made, whole, str(sensor.layout.shape))
        assert goes > 10


@pytest.mark.parametrize("lost", ["before", "place"])
def test_a_stream_that_begins_anew_in_each_part_is_noticed(monkeypatch: pytest.MonkeyPatch, lost: str) -> None:
    sensor = Sensor(GRID, SENSORS["all but what ties"], "device", 5).resolved()
    whole = exposed(sensor, SUMMED, ALL)
    original = Streams.draws

    def forgetful(self: Streams, name: str, events: int) -> Draws:
        found = original(self, name, events)
        forgotten = {"before": 0} if lost == "before" else {"place": streams.beginning(1)}
        return replace(found, **forgotten)

    monkeypatch.setattr(Streams, "draws", forgetful)
    with pytest.raises(AssertionError):
        _same(exposed(sensor, SUMMED, ALL, most=2500.0), whole, "parts")


@pytest.mark.slow
def test_an_effect_that_does_not_count_on_is_told_by_the_contract() -> None:
    class Careless(Effect, stage="timing"):
        """Moves stamps, by numbers that begin anew in each part.

        Source: this test.
        """

        counted = True

        def apply(self, events: Events, rng: Draws) -> Events:
            every = np.arange(len(events))
            late = kernels.uniforms(every, events.image_offsets, rng.images, rng.key, 0)
            return events.moved(events.times + 1e-9 * late)

    with pytest.raises(AssertionError, match=r"careless.*part by part \(rng\.before and rng\.place"):
        check_effect(Careless)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    st.integers(1, 6),
    st.integers(1, 6),
    st.lists(st.floats(0, 10), min_size=36, max_size=36),
    st.sampled_from([0.0, 1.0, 9.0, 40.0, 1e9]),
)
def test_pieces_are_all_pixels_in_order(rows: int, columns: int, weights: list[float], most: float) -> None:
    window = Window.of((8, 9), slice(1, 1 + rows), slice(2, 2 + columns))
    weight = np.array(weights[: rows * columns])
    pieces = list(window.pieces(weight, most))
    assert np.array_equal(np.concatenate([piece.pixels for piece in pieces]), window.pixels)
    place = {pixel: i for i, pixel in enumerate(window.pixels.tolist())}
    for piece in pieces:
        heavy = sum(weight[place[pixel]] for pixel in piece.pixels.tolist())
        assert piece.pixels.size == 1 or (piece.pixels.size and heavy <= most * (1 + 1e-12))


def test_what_ties_pixels_together_is_what_an_effect_declares() -> None:
    class Stranger(Effect, stage="readout"):
        """Draws by blocks of images."""

        def apply(self, events: Events, rng: Any) -> Events:
            return events

        def influence(self) -> float:
            return 0.0

    def tying(effect: Effect, *readouts: str) -> str | None:
        return Sensor(GRID, [of("detection"), effect], "device").resolved().tying(readouts)

    assert tying(of("crosstalk"), "qis") == tying(of("crosstalk"), "tr") == "crosstalk"
    assert tying(of("crosstalk", probability=0.0), "tr") is None
    assert tying(of("readout_loss"), "tr", "qis") == "readout_loss"
    assert tying(of("readout_loss", service_time=0.0), "tr") is None
    assert tying(of("readout_loss"), "qis", "str", "counts") is None  # it acts on TR alone
    assert tying(of("count_saturation"), *ALL) is None
    assert tying(of("source_noise"), *ALL) is None  # the same light for all pixels, whatever they detect
    assert tying(Stranger(), "tr") == "stranger"
    said = Sensor(GRID, [Stranger()], "device").resolved().excess(np.full((1, 120), 1e9), SUMMED, ("tr",))
    assert said is not None and said.endswith("as they must: stranger draws for all pixels in one go")


# --- how large an image may be --------------------------------------------------------------------------------------

SENSOR = """\
seed: 1
scene: {images: {source: uniform, repetitions: 1}, wavelength: 555 nm, lux: [LUX]}
recording: {exposure: 1 ms, frames: 100, frame_time: 10 us, readouts: [READOUTS]}
reconstruct: []
sensor:
  rules: device
  layout: {rows: ROWS, columns: COLUMNS, pixel_area: 25 um^2}
  effects:
    detection: {pdp: 0.5}
    dark_counts: {rate: 100 Hz}
    dead_time: {duration: 50 ns}
    tdc: {resolution: 10 ps}
"""


def built(
    more: str = "", lux: str = "100 lux", readouts: str = "tr", shape: tuple[int, int] = (480, 640), **how: Any
) -> Experiment:
    """An experiment of one white image; more: lines of effects."""
    text = SENSOR.replace("LUX", lux).replace("READOUTS", readouts)
    text = text.replace("ROWS", str(shape[0])).replace("COLUMNS", str(shape[1]))
    return config.build(document.parse(text + more, "lab.yaml"), Path(), **how)


def refused(made: Experiment, grey: float = 0.5) -> str:
    with pytest.raises(InputError) as told:
        made.check_volume(grey, 1)
    said = str(told.value)
    assert said.startswith(("lab.yaml: one image at ", "lab.yaml: an image at ")) and "\n" not in said
    return said


def test_a_photo_and_a_native_sensor_may_be_simulated() -> None:
    """480 x 640 pixels in 100 lux, and 512 x 512: hundreds of millions of events, as nothing ties pixels together."""
    for shape in ((480, 640), (512, 512)):
        for readouts in ("tr", "qis", "tr, qis"):
            built("    afterpulsing: {probability: 1 %}\n", readouts=readouts, shape=shape).check_volume(0.5, 1)


def test_what_ties_the_pixels_is_named_where_they_are_too_many() -> None:
    said = refused(built("    crosstalk: {probability: 0.1 %}\n"))
    assert "more than the 1e+08 that can be simulated at once, as they must: crosstalk ties all pixels" in said
    assert "lower the light, the dark count rate or the exposure" in said
    assert "readout_loss ties" in refused(built("    readout_loss: {service_time: 1 ns}\n"))
    built("    readout_loss: {service_time: 1 ns}\n", readouts="qis").check_volume(0.5, 1)
    built("    crosstalk: {probability: 0.1 %}\n", lux="10 lux").check_volume(0.5, 1)  # few enough
    assert "more than the 2e+09 that can be simulated" in refused(built(lux="1000 lux"))
    assert "1.64e+08 events in a pixel, more than the 1e+08" in refused(built(lux="6400000 lux", shape=(1, 8)))


def test_frames_that_depend_on_each_other_are_not_drawn_alone() -> None:
    bright = {"lux": "1000 lux", "readouts": "qis"}
    built(**bright).check_volume(0.5, 1)
    assert "lower the light" in refused(built("    afterpulsing: {probability: 1 %}\n", **bright))
    assert "lower the light" in refused(built("    flicker: {amplitude: 0.1}\n", **bright))
    assert "leave out --causes" in refused(built(causes=True, **bright))
    assert "lower the light" in refused(built(lux="1000 lux", readouts="qis, str"))
    assert "events in a pixel" in refused(built(lux="6400000 lux", shape=(1, 8), readouts="qis"))


def bright_text() -> str:
    """The config of the paper's dim capture in its bright light, its sensor written out in it."""
    text = (CONFIGS / "spad512.yaml").read_text().replace("115.62 nW/cm^2", "906.5 nW/cm^2")
    lines = [line for line in text.splitlines() if not line.startswith("sensor:")]
    return "\n".join([*lines, (CONFIGS / "spad512_sensor.yaml").read_text()])


def test_causes_of_the_papers_bright_capture_are_refused_in_one_sentence(tmp_path: Path) -> None:
    text = bright_text().replace("exposure: 10 ms", "exposure: 100 ms").replace(" 1 us ", " 10 us ")
    (tmp_path / "bright.yaml").write_text(text)
    made = config.read(tmp_path / "bright.yaml")
    factory.check_volume(made, made.load_images())
    done = commands.run("generate", "bright.yaml", "-o", "out", "--causes", cwd=tmp_path)
    said = " ".join(done.stderr.split())
    assert done.returncode == 2 and "Traceback" not in said and not (tmp_path / "out").exists()
    assert "an image at 906.5 nW/cm^2 would hold more than 2e+09 events; its frames are drawn without them" in said
    assert "leave out --causes" in said


def test_a_capture_of_many_detections_is_simulated_where_nothing_ties_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """The limits made small: TR of more events than are simulated at once, the same as before."""
    sensor = Sensor(GRID, SENSORS["traps"], "device", 5).resolved()
    capture = Capture("long", "tr", Light(), SUMMED)
    images = np.zeros(1, np.uint64)
    (whole,) = twin.model_recordings(sensor, capture, 2e5, drawn(1), images)
    monkeypatch.setattr(spadmnist.sensor, "_MOST_AT_ONCE", 1000.0)
    monkeypatch.setattr(spadmnist.sensor, "_EVENTS_OF_A_PART", 500.0)
    parts, goes = parts_of(monkeypatch, lambda: twin.model_recordings(sensor, capture, 2e5, drawn(1), images)[0])
    assert goes > 10
    assert len(whole.events) > 5000 and np.array_equal(whole.events.times, parts.events.times)
    tied = Sensor(GRID, SENSORS["crosstalk"], "device", 5).resolved()
    with pytest.raises(InputError, match=r"long: would hold 1\.\d+e\+04 events.*crosstalk ties all pixels; shorten it"):
        twin.model_recordings(tied, capture, 2e5, drawn(1), images)


# --- frames drawn without events ------------------------------------------------------------------------------------

BINARY = """\
seed: 3
scene: {images: {source: uniform, repetitions: 4}, wavelength: 500 nm, irradiance: [LIGHT]}
recording: {exposure: 30.03 ms, frames: 3003, frame_time: 9 us, frame_period: 10 us, readouts: [qis]}
reconstruct: [qis_counts]
sensor:
  rules: RULES
  chip_seed: 4
  layout: {rows: 6, columns: 11, pixel_area: 36 um^2}
  effects:
    illumination_gradient: {x: 0.6}
    detection: {pdp: 0.444}
    dark_counts: {rate: {lognormal: {median: 300 Hz, sigma: 1.0}}}
    dead_time: {duration: 50 ns}
"""


def binary(light: str, rules: str) -> Experiment:
    text = BINARY.replace("LIGHT", light).replace("RULES", rules)
    return config.build(document.parse(text, "binary.yaml"), Path())


def frames_of(made: Experiment, images: int = 4) -> np.ndarray:
    """(images, frames, pixels) 0 or 1"""
    shown = made.load_images()["test" if "test" in made.load_images() else "train"]
    recorded = made.simulate(made.levels[0], "train", shown, 0, images)
    assert recorded.frames is not None and recorded.ones is not None and recorded.tr is None
    found = recorded.frames.unpacked()
    assert np.array_equal(found.sum(axis=1, dtype=int).ravel(), recorded.ones)
    return found


def directly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take every image for one whose frames are drawn without events, some of its rows after the other."""
    monkeypatch.setattr(experiment, "_FROM_FRAMES", 10.0)
    monkeypatch.setattr(standing, "_DRAWS_AT_ONCE", 100.0)


@pytest.mark.parametrize("rules", ["paper", "device"])
@pytest.mark.parametrize("light", ["3 nW/cm^2", "90 nW/cm^2", "900 nW/cm^2"])
def test_frames_drawn_without_events_follow_the_sensors_law(
    monkeypatch: pytest.MonkeyPatch, rules: str, light: str
) -> None:
    """Sparse and dense: every pixel's share, the number in a frame, and pairs of frames and of pixels that follow."""
    made = binary(light, rules)
    staged = frames_of(made)
    directly(monkeypatch)
    direct = frames_of(binary(light, rules))
    assert not np.array_equal(staged, direct)
    c = made.conditions
    rate = made.sensor.rates(np.full((1, 66), made.white(made.levels[0])), c)[0][0]
    chance = -np.expm1(-rate * c.frame_time)
    alpha = laws.FALSE_ALARM / 132
    trials = 4 * c.frames
    for pixel in range(66):
        ones = [int(found[:, :, pixel].sum()) for found in (staged, direct)]
        laws.share_is(ones[1], trials, chance[pixel], alpha, f"pixel {pixel}")
        laws.same_share(ones[0], trials, ones[1], trials, alpha, f"pixel {pixel}")
    laws.same_histogram(*(found.sum(axis=2, dtype=int) for found in (staged, direct)))
    for axis in (1, 2):
        step = (slice(None),) * axis
        both = [found[(*step, slice(1, None))] & found[(*step, slice(None, -1))] for found in (staged, direct)]
        laws.same_share(int(both[0].sum()), both[0].size, int(both[1].sum()), both[1].size, what=f"pairs along {axis}")
    if light != "3 nW/cm^2":  # seen to fail, in light of 3 % more
        with pytest.raises(AssertionError):
            laws.share_is(int(direct.sum()), direct.size, float(-np.expm1(-1.03 * rate * c.frame_time).mean()))


def test_frames_behind_a_gate_are_not_drawn_without_their_events(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their pixels are blind for a part of each frame: of a gate of a tenth, as many detections as by events."""
    gated = BINARY.replace("    dead_time", "    short_gate: {fraction: 0.1}\n    dead_time")
    text = gated.replace("LIGHT", "900 nW/cm^2").replace("RULES", "device")
    ones = []
    for direct in (False, True):
        if direct:
            directly(monkeypatch)
        made = config.build(document.parse(text, "binary.yaml"), Path())
        ones.append(int(frames_of(made).sum()))
    assert ones[0] == ones[1] > 1000


@pytest.mark.parametrize(
    "recorded",
    [
        "exposure: 300.3 ms, frames: 3003, frame_time: 9 us, frame_period: 100 us, readouts: [qis]",
        "exposure: 30.03 ms, frames: 91, frame_time: 330 us, readouts: [counts], bits: 12, counting: counter",
        "exposure: 30.03 ms, frames: 91, frame_time: 330 us, readouts: [counts], bits: 6, counting: counter",
    ],
)
def test_the_estimate_is_of_what_is_recorded(recorded: str) -> None:
    """Nothing in the gaps of frames, all counts of a counter, and none beyond its last; within 2 % of what is made."""
    before = "exposure: 30.03 ms, frames: 3003, frame_time: 9 us, frame_period: 10 us, readouts: [qis]"
    text = BINARY.replace("LIGHT", "900 nW/cm^2").replace("RULES", "device").replace(before, recorded)
    if "counts" in recorded:
        text = text.replace("reconstruct: [qis_counts]\n", "")
    made = config.build(document.parse(text, "binary.yaml"), Path())
    images = made.load_images()
    found = made.simulate(made.levels[0], "train", images["train"], 0, 4)
    seen = found.ones.sum() if found.tally is None else found.tally.sum()
    assert plan.estimate(made, images, 1)["total"]["detections"] == pytest.approx(float(seen), rel=0.02)


def test_frames_drawn_without_events_have_the_papers_bright_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    """9,740 of 10,000 frames of 10 us: 906.5 nW/cm^2 at 500 nm on 36 um^2, PDP 44.4 %; binomial counts."""
    directly(monkeypatch)
    text = (
        bright_text()
        .replace("exposure: 10 ms", "exposure: 100 ms")
        .replace(" 1 us ", " 10 us ")
        .replace(" 512 ", " 24 ")
    )
    made = config.build(document.parse(text, "bright.yaml"), Path())
    assert made.sensor.layout.shape == (24, 24) and made.conditions.frames == 10_000
    found = made.simulate(made.levels[0], "train", made.load_images()["train"], 0, 1)
    assert found.ones is not None and abs(float(found.ones.mean()) - 9740) < 5
    rate = made.sensor.rates(np.full((1, 576), made.white(made.levels[0])), made.conditions)[0][0]
    quiet = rate < 1.001 * np.median(rate)  # a pixel of few dark counts has the light's share
    laws.histogram_is(10_000 - found.ones[quiet], lambda k: stats.binom.pmf(k, 10_000, np.exp(-np.median(rate) * 1e-5)))


def test_which_images_are_drawn_so_depends_on_each_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dark ones stay as they are, bright ones do not change with those beside them."""
    made = binary("90 nW/cm^2", "device")
    pixels = np.full((3, 6, 11), 255, np.uint8)
    pixels[1] = 10
    before = made.simulate_block(made.levels[0], "train", pixels, 255.0, 0)
    events = made.sensor.expected(made.photons(made.levels[0], pixels, 255.0).reshape(3, -1), made.conditions)[0]
    monkeypatch.setattr(experiment, "_FROM_FRAMES", float(events[0].sum()) / 2)
    after = made.simulate_block(made.levels[0], "train", pixels, 255.0, 0)
    _same(after.images(1, 2), before.images(1, 2), "the dark one")
    assert not np.array_equal(after.images(0, 1).frames.bits, before.images(0, 1).frames.bits)
    with pytest.raises(InputError, match="leave out --causes"):  # which change no drawn value
        replace(made, causes=True).simulate_block(made.levels[0], "train", pixels, 255.0, 0)
    for i in range(3):
        alone = made.simulate(made.levels[0], "train", Images(pixels, None, 255.0), i, i + 1)
        _same(alone, after.images(i, i + 1), f"image {i}")


@pytest.mark.parametrize(("readouts", "large"), [("tr", False), ("qis", True), ("qis", False)])
def test_the_estimate_of_a_large_image_rests_on_some_of_its_rows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, readouts: str, large: bool
) -> None:
    """Bytes as they are made, photons and detections as expected; of events and of frames without them."""
    made = built(lux="2 lux", readouts=readouts, shape=(64, 400))
    images = made.load_images()
    monkeypatch.setattr(experiment, "_FROM_FRAMES", 10.0 if large else 1e12)
    looked = []
    simulate = Experiment.simulate_block

    def seen(self: Experiment, *arguments: Any) -> Recorded:
        looked.append(self.sensor.layout.shape)
        return simulate(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(plan, "_EVENTS", 4e5)
        patch.setattr(Experiment, "simulate_block", seen)
        told = plan.estimate(made, images, 2)["total"]
    assert looked and all(2 < rows < 60 and columns == 400 for rows, columns in looked), looked
    done = factory.generate(made, images, tmp_path / "out", 1).manifest
    size = sum(facts["bytes"] for name, facts in done["files"].items() if "_lux" in name)
    assert told["bytes"] == pytest.approx(size, rel=0.05) and size > 300_000
    (found,) = done["statistics"][made.levels[0].text].values()
    seen_there = found["tr" if readouts == "tr" else "frames"]["detections"]
    assert told["detections"] == pytest.approx(seen_there, rel=0.02)


def test_memory_that_is_told_counts_what_is_simulated_at_once() -> None:
    """4e6 events of a part, where an image has parts; with crosstalk all of them."""
    parts, tied, few = (
        built(lux="10 lux", readouts="qis"),
        built("    crosstalk: {probability: 0.1 %}\n", lux="10 lux", readouts="qis"),
        built(lux="10 mlux", readouts="qis"),
    )

    def memory(made: Experiment) -> int:
        images = made.load_images()
        return factory.memory_per_worker(made, images, shard_plan.shards_of(made, images))

    events = float(tied.sensor.expected(np.full((1, 480 * 640), tied.white(tied.levels[0])), tied.conditions)[0].sum())
    assert memory(tied) - memory(parts) == pytest.approx(50 * (events - 4e6), rel=0.01)
    assert 1e8 < memory(parts) - memory(few) < 50 * 4e6
