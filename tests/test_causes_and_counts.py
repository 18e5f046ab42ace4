"""Where each detection came from, and the readout `counts`: simulated, stored, read, shown."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import laws
import numpy as np
import pytest

import spadmnist
from spadmnist import config, factory, report
from spadmnist.effects import Conditions, Effect
from spadmnist.errors import ConfigError, SpadError
from spadmnist.events import Layout
from spadmnist.readout import Recorded
from spadmnist.sensor import Sensor
from spadmnist.streams import Streams

EFFECTS: dict[str, dict[str, Any]] = {
    "detection": {"pdp": 0.5},
    "dark_counts": {"rate": 20e3},
    "afterpulsing": {"probability": 0.1, "lifetime": 60e-9},
    "dead_time": {"duration": 50e-9},
    "tdc": {"resolution": 100e-12},
}
CLOCK = Conditions(1.02e-3, 102, 8e-6, 10e-6, 555e-9)


def sensor(rules: str, **more: dict[str, Any]) -> Sensor:
    made = [Effect.registry.find(name)(**values) for name, values in {**EFFECTS, **more}.items()]
    return Sensor(Layout(8, 8, 25e-12, 1.0), made, rules)


def expose(
    one: Sensor, causes: bool, conditions: Conditions = CLOCK, photons: float = 4e5, images: int = 40
) -> Recorded:
    light = np.full((images, one.layout.pixels), photons)
    streams = Streams(7, "x", "train", np.arange(images, dtype=np.uint64))
    readouts = ("tr", "str", "qis", "counts") if conditions.bits else ("tr", "str", "qis")
    return one.expose(light, conditions, streams, readouts, causes=causes)


# --- causes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rules", ["paper", "device"])
def test_asking_for_causes_changes_no_event(rules: str) -> None:
    plain, told = (expose(sensor(rules), causes) for causes in (False, True))
    assert plain.tr and told.tr and plain.frames and told.frames and plain.frames.first and told.frames.first
    assert np.array_equal(plain.tr.ticks, told.tr.ticks) and np.array_equal(plain.tr.offsets, told.tr.offsets)
    assert np.array_equal(plain.frames.bits, told.frames.bits)
    assert np.array_equal(plain.frames.first.ticks, told.frames.first.ticks)
    assert plain.tr.cause is None and plain.frames.cause is None
    assert told.tr.cause is not None and len(told.tr.cause) == len(told.tr)
    assert told.frames.cause is not None and len(told.frames.cause) == len(told.frames.first)
    # batches, and images alone
    one = told.images(3, 4)
    assert one.tr and one.frames
    single = sensor(rules)
    streams = Streams(7, "x", "train", np.array([3], np.uint64))
    alone = single.expose(np.full((1, 64), 4e5), CLOCK, streams, ("tr", "str"), causes=True)
    assert alone.tr and alone.frames
    for a, b in ((one.tr, alone.tr), (one.frames, alone.frames)):
        assert np.array_equal(a.cause, b.cause) and np.array_equal(a.parent, b.parent)


@pytest.mark.parametrize("rules", ["paper", "device"])
def test_causes_have_the_shares_of_their_rates(rules: str) -> None:
    """Photons 200 kHz and dark counts 20 kHz in every pixel; false-alarm rate 1e-6 each."""
    one = sensor(rules)
    assert one.causes == ("photon", "dark", "afterpulse")
    made = expose(one, True)
    assert made.tr and made.tr.cause is not None and made.tr.parent is not None and made.frames
    numbers = np.bincount(made.tr.cause, minlength=3)
    laws.share_is(int(numbers[1]), int(numbers[0] + numbers[1]), 20e3 / 220e3)
    framed = np.bincount(made.frames.cause, minlength=3)
    laws.share_is(int(framed[1]), int(framed[0] + framed[1]), 20e3 / 220e3)
    child = made.tr.cause == 2
    assert np.array_equal(made.tr.parent != -1, child)
    known = made.tr.parent >= 0
    lag = made.tr.times[known] - made.tr.times[made.tr.parent[known]]
    assert lag.min() > 50e-9 - 1e-10 and np.array_equal(made.tr.pixel[known], made.tr.pixel[made.tr.parent[known]])
    if rules == "device":
        assert np.array_equal(known, child)  # only what was recorded fills a trap
        # of every detection a tenth has a child, less what comes to a blind pixel or after the end
        assert 0.085 < child.mean() < 0.1
    else:
        lost = made.tr.parent == -2  # a parent that the dead time hid
        assert 0 < lost.sum() < 0.05 * child.sum()


def test_the_mean_lag_is_dead_time_and_lifetime() -> None:
    """A planted fault, a lifetime that is 5 % longer, is caught."""
    quiet: dict[str, dict[str, Any]] = {"dark_counts": {"rate": 0.0}}

    def lags(lifetime: float) -> np.ndarray:
        made = expose(
            sensor("device", **quiet, afterpulsing={"probability": 0.3, "lifetime": lifetime}), True, photons=5e4
        )
        assert made.tr and made.tr.parent is not None
        child = np.flatnonzero(made.tr.parent >= 0)
        return np.asarray(made.tr.times[child] - made.tr.times[made.tr.parent[child]])

    # a photon that comes first makes the pixel blind to a release: at 25 kHz and 60 ns that is 0.3 % of them
    laws.mean_is(lags(60e-9), 110e-9, error=0.4e-9)
    with pytest.raises(AssertionError):
        laws.mean_is(lags(63e-9), 110e-9, error=0.4e-9)


def test_an_effect_that_loses_the_causes_is_named() -> None:
    from spadmnist.errors import EffectError
    from spadmnist.events import Events

    class Forgetful(Effect, stage="readout"):
        """Makes new events."""

        def apply(self, events: Events, rng: np.random.Generator) -> Events:
            return Events(None, events.offsets, events.pixels, events.ticks, events.tick)

    one = Sensor(Layout(8, 8, 25e-12, 1.0), [*sensor("paper").effects, Forgetful()])
    expose(one, False, images=32)
    with pytest.raises(EffectError, match=r"forgetful.*causes.*events\.keep"):
        expose(one, True, images=32)


# --- counts -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_cascade_without_end_is_refused_before_it_fills_the_memory() -> None:
    """Every avalanche fires 3 others in the mean: 3^n in generation n, on an array that is never wholly blind."""
    many = sensor("device", crosstalk={"probability": 0.6, "delay": 1e-6})
    with pytest.raises(SpadError, match="does not end"):
        expose(many, False, images=1)


def test_counts_are_sums_of_binary_frames() -> None:
    clock = Conditions(1.05e-3, 105, 8e-6, 10e-6, 555e-9, bits=3)
    made = expose(sensor("device"), False, clock)
    assert made.frames and made.tally is not None
    frames = np.unpackbits(made.frames.bits, axis=1, count=105)
    assert np.array_equal(made.tally, frames.reshape(-1, 15, 7).sum(axis=2)) and made.tally.dtype == np.uint8
    assert made.tally.max() == 7
    fused = expose(sensor("paper"), False, clock)
    staged = expose(sensor("paper"), True, clock)
    assert np.array_equal(fused.tally, staged.tally)
    only = sensor("paper").expose(
        np.full((40, 64), 4e5), clock, Streams(7, "x", "train", np.arange(40, dtype=np.uint64)), ("counts",)
    )
    assert only.frames is None and only.tr is None and np.array_equal(only.tally, fused.tally)


@pytest.mark.parametrize("rules", ["paper", "device"])
def test_a_counter_counts_what_is_detected_in_each_frame(rules: str) -> None:
    period = 10e-6 if rules == "paper" else 8e-6  # of a device nothing fires between frames, as time stamps do
    clock = Conditions(102 * period, 102, 8e-6, period, 555e-9, bits=2, counting="counter")
    bare = sensor(rules, tdc={"resolution": 0.0})
    made = expose(bare, False, clock)
    assert made.tr and made.tally is not None
    frame = np.floor(made.tr.times / period).astype(int)
    live = made.tr.times - frame * period < 8e-6
    expected = np.zeros(made.tally.shape, int)
    np.add.at(expected, (made.tr.rows[live], frame[live]), 1)
    assert expected.max() > 3
    assert np.array_equal(made.tally, np.minimum(expected, 3))


CONFIG = """\
seed: 4
scene: {{images: {{source: uniform, repetitions: 5}}, lux: [50 mlux, 2 lux]}}
recording: {{exposure: 1.05 ms, frames: 105, frame_time: 10 us, readouts: [{readouts}]{more}}}
reconstruct: []
sensor:
  rules: device
  layout: {{rows: 4, columns: 6, pixel_area: 25 um^2}}
  effects:
    detection: {{pdp: 0.5}}
    dark_counts: {{rate: 5 kHz}}
    afterpulsing: {{probability: 20 %}}
    dead_time: {{duration: 50 ns}}
    tdc: {{resolution: 100 ps}}
"""


@pytest.fixture(params=["zarr", "hdf5"])
def form(request: pytest.FixtureRequest) -> Iterator[str]:
    yield request.param


@pytest.mark.parametrize("readouts", ["tr, str, qis, counts", "tr, qis", "qis", "counts"])
def test_what_is_stored_is_what_is_simulated(readouts: str, form: str, tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(CONFIG.format(readouts=readouts, more=", bits: 3" if "counts" in readouts else ""))
    experiment = config.read(path, format=form, causes=True)
    outcome = factory.generate(experiment, experiment.load_images(), tmp_path / "out", 1)
    stored, made = spadmnist.open(tmp_path / "out"), spadmnist.open(tmp_path / "out" / "config.yaml")
    for level in stored.levels:
        a, b = stored[level], made[level]
        assert a.causes == b.causes == ("photon", "dark", "afterpulse")
        for part in (slice(0, 5), slice(2, 4), slice(4, 5)):
            if "tr" in readouts:
                for name in ("ticks", "offsets", "cause", "parent"):
                    assert np.array_equal(getattr(a.tr[part], name), getattr(b.tr[part], name))
            if "qis" in readouts:
                for name in ("bits", "cause", "parent"):
                    assert np.array_equal(getattr(a.frames[part], name), getattr(b.frames[part], name))
            if "counts" in readouts:
                assert np.array_equal(a.counts[part], b.counts[part])
                assert a.counts[part].shape[1:] == (15, 4, 6)
                if "qis" in readouts:
                    sums = a.qis[part].reshape(-1, 15, 7, 4, 6).sum(axis=2)
                    assert np.array_equal(a.counts[part], sums)
    table = report.level_table(outcome.manifest)
    assert ("causes: what made the detections" in table) == (readouts != "counts")
    if "tr" in readouts:
        shares = outcome.manifest["statistics"]["2 lux"]["train"]["causes"]
        assert sum(shares.values()) == outcome.manifest["statistics"]["2 lux"]["train"]["tr"]["detections"]
    report.sheet(stored, tmp_path / "sheet.png")
    assert (tmp_path / "sheet.png").stat().st_size > 1000


def test_without_causes_none_are_stored(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(CONFIG.format(readouts="tr, qis", more=""))
    experiment = config.read(path)
    outcome = factory.generate(experiment, experiment.load_images(), tmp_path / "out", 1)
    part = spadmnist.open(tmp_path / "out")["2 lux"]
    assert part.tr[0].cause is None and part.causes == () and "causes" not in outcome.manifest["config"]
    assert "causes:" not in report.level_table(outcome.manifest)


@pytest.mark.parametrize(
    ("readouts", "more", "says"),
    [
        ("counts", "", r"counts needs bits; write for example bits: 8"),
        ("counts", ", bits: 4", r"frames: 105 binary frames do not fill .* take 105|take 90 or 105|do not fill"),
        ("qis", ", bits: 3", r"bits: belongs to the readout counts"),
        ("counts", ", bits: 13", r"bits: 13 is not possible; it must be at most 12"),
        ("counts", ", bits: 3, counting: photons", r"counting: 'photons' is not one of frames, counter"),
    ],
)
def test_mistakes_about_counts(readouts: str, more: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    text = CONFIG.format(readouts=readouts, more=more)
    if "bits: 4" in more:
        text = text.replace("1.05 ms, frames: 105", "1.06 ms, frames: 106")
        says = r"recording.frames: 106 binary frames do not fill whole count frames of 4 bits.*take 105 or 120"
    path.write_text(text)
    with pytest.raises(ConfigError, match=says):
        config.read(path)
