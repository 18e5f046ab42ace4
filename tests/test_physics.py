"""The fast line against the literal algorithm, against closed forms and against a queue of events.

Every check is shown to fail where something small is wrong. Bounds: see `laws`; a comparison of many statistics
shares the false-alarm rate among them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import algorithm1
import eventqueue
import laws
import numpy as np
import pytest
from scipy import special, stats

from spadmnist import config, reconstruct
from spadmnist.effects import Conditions, Effect
from spadmnist.effects.afterpulsing import Afterpulsing
from spadmnist.effects.dark_counts import DarkCounts
from spadmnist.effects.dead_time import DeadTime
from spadmnist.effects.detection import Detection
from spadmnist.effects.tdc import Tdc
from spadmnist.events import Events, Layout
from spadmnist.readout import Recorded
from spadmnist.reconstruct import Settings
from spadmnist.sensor import Sensor
from spadmnist.streams import Streams

PIXELS = 784
METHODS = ("counts", "passive_free_running", "inter_photon", "str_flux", "qis_counts", "qis_linear")
SHARED = laws.FALSE_ALARM / 200  # one comparison of two samples makes fewer than 200 assertions
MNIST = Path(__file__).resolve().parents[1].parent / "shared" / "mnist"


@dataclass(frozen=True)
class Case:
    """One pixel of the paper's dataset, with something changed."""

    flux: float
    pdp: float = 0.5
    dark_count_rate: float = 100.0
    afterpulsing: float = 0.005
    lifetime: float = 25e-9
    dead_time: float = 50e-9
    resolution: float = 10e-12
    exposure: float = 1e-3
    frames: int = 100
    frame_time: float = 10e-6
    rules: str = "paper"

    @property
    def rate(self) -> float:
        """Photons kept and dark counts, 1/s."""
        return self.pdp * self.flux + self.dark_count_rate

    @property
    def conditions(self) -> Conditions:
        return Conditions(self.exposure, self.frames, self.frame_time, self.exposure / self.frames, 555e-9)

    @property
    def settings(self) -> Settings:
        return Settings(self.pdp, self.exposure, self.dead_time, self.resolution, self.frames, self.frame_time)

    def sensor(self) -> Sensor:
        effects: list[Effect] = [Detection(pdp=self.pdp), DarkCounts(rate=self.dark_count_rate)]
        if self.afterpulsing:
            effects.append(Afterpulsing(probability=self.afterpulsing, lifetime=self.lifetime))
        if self.dead_time:
            effects.append(DeadTime(duration=self.dead_time))
        effects.append(Tdc(resolution=self.resolution))
        return Sensor(Layout(28, 28, 25e-12, 1.0), effects, self.rules).resolved()

    def expose(self, first: int, images: int, seed: int, readouts: tuple[str, ...]) -> Recorded:
        streams = Streams(seed, "lux", "train", np.arange(first, first + images, dtype=np.uint64))
        return self.sensor().expose(np.full((images, PIXELS), self.flux), self.conditions, streams, readouts)

    def pixel(self, rng: Random) -> algorithm1.Record:
        return algorithm1.pixel(
            rng,
            self.flux,
            self.exposure,
            self.pdp,
            self.dark_count_rate,
            self.dead_time,
            self.afterpulsing,
            self.lifetime,
            self.resolution,
            self.frames,
            self.frame_time,
        )


# ---- samples of pixels ------------------------------------------------------------------------------------


@dataclass
class Sample:
    """What many equal pixels gave. Every entry of an array is of another pixel, so that they are independent."""

    counts: np.ndarray
    ones: np.ndarray
    waited: np.ndarray  # s
    span: np.ndarray  # s, of pixels with at least two detections
    first: np.ndarray  # s, first arrival, of pixels with a detection
    interval: np.ndarray  # s, from the first detection to the second
    late_interval: np.ndarray  # s, from the last but one to the last, of pixels with at least four
    stamp: np.ndarray  # s, STR: of one frame for each pixel, where there is a detection
    occupancy: np.ndarray  # (frames,) pixels with a detection
    images: dict[str, np.ndarray] = field(default_factory=dict)

    @staticmethod
    def join(parts: list[Sample]) -> Sample:
        def joined(name: str) -> np.ndarray:
            return np.concatenate([getattr(p, name) for p in parts])

        columns = ("counts", "ones", "waited", "span", "first", "interval", "late_interval", "stamp")
        images = {m: np.concatenate([p.images[m] for p in parts]) for m in parts[0].images}
        occupancy = np.sum([p.occupancy for p in parts], axis=0)
        return Sample(*(joined(name) for name in columns), occupancy, images)


def fast_sample(case: Case, images: int, seed: int, at_once: int = 500) -> Sample:
    """By the package."""
    parts = []
    for first in range(0, images, at_once):
        recorded = case.expose(first, min(at_once, images - first), seed, ("tr", "str", "qis"))
        parts.append(_sample_of(case, recorded))
    return Sample.join(parts)


def _sample_of(case: Case, recorded: Recorded) -> Sample:
    tr, frames = recorded.tr, recorded.frames
    assert tr is not None and frames is not None and frames.first is not None
    counts, starts, times = tr.counts, tr.offsets[:-1], tr.times
    bits = np.unpackbits(frames.bits, axis=1, count=case.frames)
    chosen = np.arange(len(bits)) % case.frames
    before = np.where(np.arange(case.frames) < chosen[:, None], bits, 0).sum(axis=1, dtype=np.int64)
    seen = np.flatnonzero(bits[np.arange(len(bits)), chosen])
    stamp = frames.first.times[(frames.first.offsets[:-1] + before)[seen]]
    two, four = np.flatnonzero(counts >= 2), tr.offsets[1:][counts >= 4]
    assert recorded.ones is not None and recorded.waited is not None
    return Sample(
        counts,
        recorded.ones,
        recorded.waited,
        times[starts[two] + counts[two] - 1] - times[starts[two]],
        times[starts[counts > 0]],
        times[starts[two] + 1] - times[starts[two]],
        times[four - 1] - times[four - 2],
        stamp,
        bits.sum(axis=0, dtype=np.int64),
        {m: reconstruct.find(m).image(recorded, case.settings)[0] for m in METHODS},
    )


@cache
def literal_sample(case: Case, pixels: int, seed: int) -> Sample:
    """By the literal algorithm and its own reconstructions; what is planted is compared with the same draws."""
    rng = Random(seed)
    columns: list[list[Any]] = [[] for _ in range(8)]
    occupancy = np.zeros(case.frames, np.int64)
    images: dict[str, list[float]] = {m: [] for m in METHODS}
    for number in range(pixels):
        r = case.pixel(rng)
        n = len(r.tr)
        columns[0].append(n)
        columns[1].append(sum(r.qis))
        columns[2].append(math.fsum(r.str))
        if n:
            columns[4].append(r.tr[0])
        if n >= 2:
            columns[3].append(r.tr[-1] - r.tr[0])
            columns[5].append(r.tr[1] - r.tr[0])
        if n >= 4:
            columns[6].append(r.tr[-1] - r.tr[-2])
        stamp = r.str[number % case.frames]
        if stamp < case.frame_time:
            columns[7].append(stamp)
        for f, bit in enumerate(r.qis):
            if bit:
                occupancy[f] += 1
        q = case.pdp
        images["counts"].append(algorithm1.counts(n, q, case.exposure))
        images["passive_free_running"].append(
            algorithm1.stored_passive_free_running(n, q, case.exposure, case.dead_time)
        )
        images["inter_photon"].append(algorithm1.inter_photon(r.tr, q, case.dead_time, case.resolution))
        images["str_flux"].append(algorithm1.str_flux(r.str, q, case.frame_time, case.resolution))
        images["qis_counts"].append(algorithm1.qis_counts(r.qis))
        images["qis_linear"].append(algorithm1.qis_linear(r.qis))
    return Sample(*(np.array(column) for column in columns), occupancy, {m: np.array(v) for m, v in images.items()})


def assert_same_law(a: Sample, b: Sample) -> None:
    """Counts, QIS sums, frames, first arrivals, intervals, STR stamps, and all six reconstructions."""
    for name in ("counts", "ones"):
        x, y = getattr(a, name), getattr(b, name)
        laws.same_mean(x, y, SHARED, f"mean of {name}")
        laws.same_variance(x, y, SHARED, f"variance of {name}")
        laws.same_histogram(x, y, SHARED, f"histogram of {name}")
    laws.same_mean(a.waited, b.waited, SHARED, "mean of the time waited")
    laws.same_variance(a.waited, b.waited, SHARED, "variance of the time waited")
    for name in ("span", "first", "interval", "late_interval", "stamp"):
        x, y = getattr(a, name), getattr(b, name)
        if min(len(x), len(y)) >= 50:
            laws.same_distribution(x, y, SHARED, name)
    for f, (x, y) in enumerate(zip(a.occupancy.tolist(), b.occupancy.tolist(), strict=True)):
        laws.same_share(x, len(a.counts), y, len(b.counts), SHARED, f"occupancy of frame {f}")
    for name in METHODS:
        x, y = a.images[name], b.images[name]
        laws.same_share(int((x > 0).sum()), len(x), int((y > 0).sum()), len(y), SHARED, f"share of {name} above 0")
        # rounded to the float32 that a dataset stores, so that equal counts give equal values
        laws.same_distribution(x, y.astype(np.float32), SHARED, f"distribution of {name}")
        if name != "inter_photon" or y.min() > 0:  # two detections close together: no finite variance
            laws.same_mean(x, y, SHARED, f"mean of {name}")
            laws.same_variance(x, y, SHARED, f"variance of {name}")


def white(lux: float, grey: float = 255.0) -> float:
    return algorithm1.photon_flux(grey, 255.0, lux, 25e-12, 555e-9)


CASES: dict[str, tuple[Case, int, int]] = {  # case, images of the fast line, pixels of the literal one
    "bright": (Case(white(2.560)), 10, 6000),
    "dim": (Case(white(0.020, 128)), 2200, 60_000),
    "dark": (Case(0.0), 12_900, 60_000),
    "stress": (Case(white(2.560), afterpulsing=0.3, dead_time=2e-6, lifetime=3e-6), 10, 6000),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_fast_line_is_the_literal_algorithm(name: str) -> None:
    case, images, pixels = CASES[name]
    assert images * PIXELS * case.rate * case.exposure >= 1e6
    assert_same_law(fast_sample(case, images, 1), literal_sample(case, pixels, 2))


@pytest.mark.parametrize("name", CASES)
def test_fast_line_is_the_literal_algorithm_in_short(name: str) -> None:
    """As above, a tenth of it."""
    case, images, pixels = CASES[name]
    assert_same_law(fast_sample(case, images // 10, 3), literal_sample(case, pixels // 10, 4))


FAULTS: dict[str, tuple[str, dict[str, Any]]] = {
    "dead time too long": ("stress", {"dead_time": 2.1e-6}),
    "afterpulsing too weak": ("stress", {"afterpulsing": 0.27}),
    "lifetime too long": ("stress", {"lifetime": 5e-6}),
    "PDP too high": ("bright", {"pdp": 0.51}),
    "afterpulsing too strong": ("bright", {"afterpulsing": 0.02}),
    "dark counts too frequent": ("dim", {"dark_count_rate": 120.0}),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_small_fault_breaks_the_comparison(fault: str) -> None:
    name, change = FAULTS[fault]
    case, images, pixels = CASES[name]
    with pytest.raises(AssertionError, match="is below the bound"):
        assert_same_law(fast_sample(replace(case, **change), images, 1), literal_sample(case, pixels, 2))


# ---- one extra event per image ----------------------------------------------------------------------------

# mean grey of MNIST, a fifth of the pixels lit: 105 events per image
FIVE_MLUX = np.where(np.arange(PIXELS) % 5 == 0, white(0.005, 33.386 * 5 * 784 / (5 * 157)), 0.0)


def five_mlux(images: int, seed: int) -> Events:
    """TR of images at 5 mlux."""
    case = Case(0.0)
    streams = Streams(seed, "lux", "train", np.arange(images, dtype=np.uint64))
    photons = np.tile(FIVE_MLUX, (images, 1))
    tr = case.sensor().expose(photons, case.conditions, streams, ("tr",)).tr
    assert tr is not None
    return tr


def one_more_event(events: Events) -> Events:
    """A broken copy: each image has one event too many, as if the draws did not begin with a waiting time."""
    assert events.ticks is not None
    images = (len(events.offsets) - 1) // events.pixels
    first = events.offsets[:-1].reshape(images, -1)[:, 0]
    ticks = np.insert(events.ticks, first, 0)
    rows_before = np.arange(len(events.offsets))
    offsets = events.offsets + -(-rows_before // events.pixels)
    return Events(None, offsets, events.pixels, ticks, events.tick)


def per_image(events: Events) -> np.ndarray:
    return np.diff(events.offsets[:: events.pixels])


def expected_at_five_mlux() -> float:
    """Detections per image; what the dead time costs (lambda tau_d) and what falls after T is in it."""
    case = Case(0.0)
    rate = 0.5 * FIVE_MLUX + 100.0
    live = case.exposure - case.dead_time - case.lifetime
    events = rate * (case.exposure + case.afterpulsing * live)
    return float((events / (1 + rate * case.dead_time)).sum())


def test_one_extra_event_per_image_is_caught() -> None:
    """Against the closed form, with 1.05 million expected events."""
    images = 10_000
    expected = expected_at_five_mlux()
    assert expected == pytest.approx(105, rel=0.01) and images * expected > 1e6
    good = five_mlux(images, 1)
    broken = one_more_event(good)
    assert broken.problem() is None and np.array_equal(per_image(broken), per_image(good) + 1)
    laws.mean_is(per_image(good), expected, what="events per image at 5 mlux")
    with pytest.raises(AssertionError, match="is below the bound"):
        laws.mean_is(per_image(broken), expected, what="events per image at 5 mlux")


@pytest.mark.slow
def test_one_extra_event_per_image_is_caught_by_the_literal_algorithm() -> None:
    rng, case = Random(5), Case(0.0)
    literal = []
    for _ in range(4000):  # images; the lit and the unlit pixels of each are as many equal ones
        total = 0
        for flux in FIVE_MLUX.tolist():
            events = algorithm1.detection_events(
                rng, flux, case.exposure, case.pdp, 100.0, case.dead_time, case.afterpulsing, case.lifetime
            )
            if events:
                total += len(algorithm1.time_resolved(events, case.dead_time, case.resolution))
        literal.append(total)
    good = five_mlux(30_000, 1)
    laws.same_mean(per_image(good), literal, what="events per image at 5 mlux")
    with pytest.raises(AssertionError, match="is below the bound"):
        laws.same_mean(per_image(one_more_event(good)), literal, what="events per image at 5 mlux")


# ---- closed forms -----------------------------------------------------------------------------------------


def sees(check: Callable[[Case], None], case: Case, **fault: Any) -> None:
    """`check` passes on the case, and fails where the simulated one differs a little."""
    check(case)
    with pytest.raises(AssertionError, match="is below the bound"):
        check(replace(case, **fault))


def counts_of(case: Case, images: int, seed: int = 7) -> np.ndarray:
    counts = case.expose(0, images, seed, ("tr",)).counts
    assert counts is not None
    return counts


DEAD = Case(2e6, pdp=1.0, dark_count_rate=0.0, afterpulsing=0.0, dead_time=150e-9)  # x = 0.3


@pytest.mark.parametrize("fault", [{"dead_time": 152e-9}, {"pdp": 0.995}])
@pytest.mark.parametrize("rules", ["paper", "device"])
def test_non_paralyzable_rate_and_fano_factor(fault: dict[str, float], rules: str) -> None:
    """P(N >= n) = P(Gamma(n) <= lambda (T - (n - 1) tau_d)): mean lambda T / (1 + x), Fano 1 / (1 + x)^2."""
    case = replace(DEAD, rules=rules)
    rate, dead, exposure = case.rate, case.dead_time, case.exposure

    def at_least(n: np.ndarray) -> np.ndarray:
        live = np.maximum(exposure - (n - 1) * dead, 0.0)
        return np.where(n == 0, 1.0, special.gammainc(np.maximum(n, 1), rate * live))

    def pmf(n: np.ndarray) -> np.ndarray:
        return at_least(n) - at_least(n + 1)

    n = np.arange(4000)
    mean = float((n * pmf(n)).sum())
    variance = float(((n - mean) ** 2 * pmf(n)).sum())
    assert mean == pytest.approx(rate * exposure / 1.3, rel=1e-4)
    assert variance / mean == pytest.approx(1 / 1.3**2, rel=1e-3)

    def check(one: Case) -> None:
        counts = counts_of(one, 4)
        laws.variance_is(counts, variance, what="variance of the counts")
        laws.histogram_is(counts, pmf, what="counts")
        laws.mean_is(counts, mean, what="mean count")

    sees(check, case, **fault)


def test_fano_factor_with_a_wrong_dead_time_rule() -> None:
    """The variance alone knows a paralyzable pixel from one that is not, at the same mean rate."""
    case = DEAD
    tr = replace(case, dead_time=0.0).expose(0, 6, 8, ("tr",)).tr
    assert tr is not None
    gaps = np.diff(tr.times, prepend=-1.0)
    gaps[tr.offsets[:-1][tr.counts > 0]] = np.inf
    paralyzable = tr.keep(gaps > case.dead_time).counts
    mean = case.rate * case.exposure / 1.3
    laws.variance_is(counts_of(case, 6, 8), mean / 1.3**2 * (1 + 1e-3), what="variance")
    with pytest.raises(AssertionError, match="is below the bound"):
        laws.variance_is(paralyzable, mean / 1.3**2, what="variance")


def test_fano_factor_with_afterpulsing() -> None:
    """Clusters of one and Bernoulli(p): mean lambda T (1 + p), variance lambda T (1 + 3 p): Fano 1 + 2 p."""
    case = Case(4e4, pdp=1.0, dark_count_rate=0.0, afterpulsing=0.1, dead_time=0.0)
    late = case.lifetime / case.exposure  # this share of the children comes after T

    def check(one: Case) -> None:
        counts = counts_of(one, 300)
        laws.mean_is(counts, 40 * (1 + 0.1 * (1 - late)), what="mean with afterpulses")
        laws.variance_is(counts, 40 * (1 + 0.3 * (1 - late)), what="variance with afterpulses")

    sees(check, case, afterpulsing=0.105)
    sees(check, case, flux=4.04e4)


def test_qis_is_binomial() -> None:
    """Each bit with 1 - exp(-lambda T_f), all independent, whatever the dead time."""
    case = Case(1.5e5, afterpulsing=0.0)
    hit = -math.expm1(-case.rate * case.frame_time)

    def check(one: Case) -> None:
        frames = one.expose(0, 100, 9, ("qis",)).frames
        assert frames is not None
        bits = np.unpackbits(frames.bits, axis=1, count=one.frames)
        sums = bits.sum(axis=1)
        laws.share_is(int(sums.sum()), bits.size, hit, what="bits")
        laws.histogram_is(sums, lambda k: stats.binom.pmf(k, one.frames, hit), what="QIS sums")
        for f in range(one.frames):
            laws.share_is(int(bits[:, f].sum()), len(bits), hit, SHARED, f"frame {f}")
        products = ((bits[:, 1:] - hit) * (bits[:, :-1] - hit)).mean(axis=1)
        laws.mean_is(products, 0.0, what="neighbouring frames")

    sees(check, case, pdp=0.503)


def test_first_arrivals_are_exponential() -> None:
    """In the exposure and in every frame, cut at its end."""
    case = Case(4e4, pdp=1.0, dark_count_rate=0.0, afterpulsing=0.0)

    def check(one: Case) -> None:
        recorded = one.expose(0, 400, 10, ("tr", "str"))
        tr, frames = recorded.tr, recorded.frames
        assert tr is not None and frames is not None and frames.first is not None
        first = tr.times[tr.offsets[:-1][tr.counts > 0]]
        laws.distribution_is(
            first, lambda t: np.expm1(-4e4 * t) / math.expm1(-4e4 * one.exposure), what="first arrivals"
        )
        # frames of a Poisson process are independent: all stamps together
        laws.distribution_is(
            frames.first.times,
            lambda t: np.expm1(-4e4 * t) / math.expm1(-4e4 * one.frame_time),
            what="stamps in frames",
        )

    sees(check, case, flux=4.1e4)
    sees(check, case, flux=3.9e4)


def test_afterpulse_share() -> None:
    """Pairs of events closer than w: children p lambda T (1 - exp(-w / tau)), and chance (lambda (1 + p))^2 T w."""
    case = Case(1e4, pdp=1.0, dark_count_rate=0.0, dead_time=0.0)
    window, p = 50e-9, case.afterpulsing
    live = case.exposure
    children = p * case.rate * live * -math.expm1(-window / case.lifetime)
    by_chance = (case.rate * (1 + p)) ** 2 * (live * window - window**2 / 2)

    def check(one: Case) -> None:
        tr = one.expose(0, 1000, 11, ("tr",)).tr
        assert tr is not None
        pairs = np.zeros(len(tr.offsets) - 1)
        rows = tr.rows
        for step in range(1, 6):
            near = (rows[step:] == rows[:-step]) & (tr.times[step:] - tr.times[:-step] < window)
            pairs += np.bincount(rows[step:][near], minlength=len(pairs))
        laws.mean_is(pairs, children + by_chance, what="close pairs")

    sees(check, case, afterpulsing=0.0055)
    sees(check, case, lifetime=35e-9)


@pytest.mark.slow
def test_afterpulses_cross_frames() -> None:
    """QIS, lag-1 correlation: p (tau / T_f) (1 - exp(-T_f / tau))^2 l / (e^l - 1), l = lambda T_f, to order p."""
    p, tau, frame_time = 0.03, 1e-6, 10e-6
    case = Case(1e5, pdp=1.0, dark_count_rate=0.0, afterpulsing=p, lifetime=tau, dead_time=0.0)
    length = case.rate * frame_time
    expected = p * tau / frame_time * math.expm1(-frame_time / tau) ** 2 * length / math.expm1(length)

    def correlation(one: Case) -> np.ndarray:
        """Of each pixel, in units of the variance of a bit."""
        parts = []
        hit = -math.expm1(-length - one.rate * one.afterpulsing * tau)
        for first in range(0, 1000, 250):
            frames = one.expose(first, 250, 12, ("qis",)).frames
            assert frames is not None
            bits = np.unpackbits(frames.bits, axis=1, count=100)[:, 1:]  # no frame before the first
            both = (bits[:, 1:] & bits[:, :-1]).mean(axis=1)
            alone = (bits[:, 1:].mean(axis=1) + bits[:, :-1].mean(axis=1)) * hit
            parts.append((both - alone + hit**2) / (hit * (1 - hit)))
        return np.concatenate(parts)

    right = correlation(case)
    laws.mean_is(right, expected, error=0.06 * expected, what="lag-1 correlation")
    with pytest.raises(AssertionError, match="is below the bound"):
        laws.mean_is(right, 0.0, what="lag-1 correlation")


# ---- rules of a device ------------------------------------------------------------------------------------

DEVICE: dict[str, tuple[Case, int, int]] = {  # case, images of the package, pixels of the queue
    "low flux": (
        Case(1e4, afterpulsing=0.3, dead_time=200e-9, lifetime=3e-6, resolution=1e-12, rules="device"),
        200,
        60_000,
    ),
    "high flux": (
        Case(2e6, afterpulsing=0.3, dead_time=300e-9, lifetime=3e-6, resolution=1e-12, rules="device"),
        2,
        600,
    ),
    "gaps between frames": (
        Case(2e5, afterpulsing=0.5, dead_time=1e-6, lifetime=6e-6, frame_time=6e-6, rules="device"),
        10,
        4000,
    ),
}


@dataclass
class DeviceSample:
    """Independent entries, each of another pixel, except `all_intervals`."""

    counts: np.ndarray
    ones: np.ndarray
    interval: np.ndarray
    late_interval: np.ndarray
    stamps: np.ndarray
    pairs: np.ndarray  # per pixel: frames that fired behind a frame that fired
    short: np.ndarray  # per pixel: intervals below the dead time and a lifetime


def package_sample(case: Case, images: int, seed: int) -> DeviceSample:
    recorded = case.expose(0, images, seed, ("tr", "str", "qis"))
    tr, frames = recorded.tr, recorded.frames
    assert tr is not None and frames is not None and frames.first is not None
    bits = np.unpackbits(frames.bits, axis=1, count=case.frames)
    starts = np.cumsum(bits.ravel()).reshape(bits.shape) - 1
    rows = np.arange(len(bits))
    chosen = rows % case.frames
    seen = bits[rows, chosen].astype(bool)
    bounds = tr.offsets[1:-1]
    gaps = np.diff(tr.times)
    same = np.ones(len(gaps), bool)
    same[bounds[(bounds > 0) & (bounds <= len(gaps))] - 1] = False
    short = np.bincount(tr.rows[1:][same & (gaps < case.dead_time + case.lifetime)], minlength=len(bits))
    return DeviceSample(
        tr.counts,
        bits.sum(axis=1),
        np.diff(tr.times[tr.offsets[:-1][tr.counts >= 2][:, None] + [0, 1]]).ravel(),
        np.diff(tr.times[tr.offsets[1:][tr.counts >= 4][:, None] - [2, 1]]).ravel(),
        frames.first.times[starts[rows, chosen][seen]],
        (bits[:, 1:] & bits[:, :-1]).sum(axis=1),
        short,
    )


@cache
def queue_sample(case: Case, pixels: int, seed: int) -> DeviceSample:
    rng = Random(seed)
    common = ([case.rate] * pixels, case.exposure, case.afterpulsing, case.lifetime, case.dead_time)
    tr = eventqueue.avalanches(rng, *common)
    framed = eventqueue.avalanches(rng, *common, case.frame_time, case.exposure / case.frames)
    period = case.exposure / case.frames
    bits = np.zeros((pixels, case.frames), np.uint8)
    stamps = []
    for pixel, times in enumerate(framed):
        for time in times:
            frame = int(time // period)
            bits[pixel, frame] = 1
            if frame == pixel % case.frames:
                stamps.append(time - frame * period)
    limit = case.dead_time + case.lifetime
    return DeviceSample(
        np.array([len(t) for t in tr]),
        bits.sum(axis=1),
        np.array([t[1] - t[0] for t in tr if len(t) >= 2]),
        np.array([t[-1] - t[-2] for t in tr if len(t) >= 4]),
        np.array(stamps),
        (bits[:, 1:] & bits[:, :-1]).sum(axis=1),
        np.array([sum(b - a < limit for a, b in zip(t, t[1:], strict=False)) for t in tr]),  # noqa: RUF007
    )


def assert_same_device(a: DeviceSample, b: DeviceSample) -> None:
    """Counts of TR and of frames, intervals, STR stamps, and what crosses frames."""
    for name in ("counts", "ones", "pairs", "short"):
        x, y = getattr(a, name), getattr(b, name)
        laws.same_mean(x, y, SHARED, f"mean of {name}")
        if x.size + y.size >= 1000:
            laws.same_variance(x, y, SHARED, f"variance of {name}")
        laws.same_histogram(x, y, SHARED, f"histogram of {name}")
    for name in ("interval", "late_interval", "stamps"):
        x, y = getattr(a, name), getattr(b, name)
        if min(len(x), len(y)) >= 50:
            laws.same_distribution(x, y, SHARED, name)


@pytest.mark.slow
@pytest.mark.parametrize("name", DEVICE)
def test_device_rules_are_the_event_queue(name: str) -> None:
    case, images, pixels = DEVICE[name]
    assert images * PIXELS * case.rate * case.exposure >= 7e5
    assert_same_device(package_sample(case, images, 1), queue_sample(case, pixels, 2))


@pytest.mark.parametrize("name", ["gaps between frames", "low flux"])
def test_device_rules_are_the_event_queue_in_short(name: str) -> None:
    case, images, pixels = DEVICE[name]
    assert_same_device(package_sample(case, images // 10, 3), queue_sample(case, pixels // 10, 4))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("low flux", {"afterpulsing": 0.29}),
        ("low flux", {"rules": "paper"}),  # no cascades
        ("high flux", {"dead_time": 310e-9}),
        ("high flux", {"rules": "paper"}),
        ("gaps between frames", {"lifetime": 7e-6}),
    ],
)
def test_a_small_fault_is_seen_by_the_event_queue(name: str, change: dict[str, Any]) -> None:
    case, images, pixels = DEVICE[name]
    with pytest.raises(AssertionError, match="is below the bound"):
        assert_same_device(package_sample(replace(case, **change), images, 1), queue_sample(case, pixels, 2))


def test_device_cascades_have_their_mean() -> None:
    """At low flux each event has p children in the mean, each of these p again: lambda T / (1 - p)."""
    case = Case(2e3, pdp=1.0, dark_count_rate=0.0, afterpulsing=0.5, lifetime=1e-9, dead_time=1e-9, rules="device")
    counts = counts_of(case, 300)
    laws.mean_is(counts, 2 / (1 - 0.5), error=2e-4, what="events in cascades")
    with pytest.raises(AssertionError, match="is below the bound"):
        laws.mean_is(counts_of(replace(case, rules="paper"), 300), 4.0, error=2e-4, what="events in cascades")


# ---- the ten levels ---------------------------------------------------------------------------------------

# mlux: (TR detections, QIS ones) expected over MNIST's 70,000 images: the exact sum of the Erlang laws of a renewal
# process with the afterpulse-inflated rate, and of the frames' laws, over the histogram of grey levels
TEN_LEVELS = {
    5: (7.3616e6, 7.3187e6),
    10: (9.2077e6, 9.1479e6),
    20: (1.28998e7, 1.27944e7),
    40: (2.02836e7, 2.00395e7),
    80: (3.50492e7, 3.43407e7),
    160: (6.45725e7, 6.22035e7),
    320: (1.235879e8, 1.15096e8),
    640: (2.414942e8, 2.10481e8),
    1280: (4.768094e8, 3.66158e8),
    2560: (9.454613e8, 5.76660e8),
}


def expected_totals(rate: np.ndarray, pixels: np.ndarray) -> tuple[float, float, float, float]:
    """(TR detections, their standard deviation, QIS ones, theirs) of `pixels` pixels of each rate.

    QIS: exact but for the first frame's start: a frame is empty with exp(-lambda (T_f + p E[min(delay, T_f)])),
    delay = tau_d + Exp(tau). TR: the renewal law's closed form lambda T / (1 + x) + x^2 / 2 (1 + x)^2 for the
    inflated rate, and the part of the children that the clustering saves from other events' dead time,
    p lambda^2 T (tau_d - tau (1 - exp(-tau_d / tau))): terms of relative order (p x)^2 and p x^2 are left out.
    """
    exposure, dead, p, tau, frames, frame_time = 1e-3, 50e-9, 0.005, 25e-9, 100, 10e-6
    inflated = rate * (1 + p * (1 - (dead + tau) / exposure))
    x = inflated * dead
    detections = inflated * exposure / (1 + x) + x**2 / (2 * (1 + x) ** 2)
    detections += p * rate**2 * exposure * (dead + tau * math.expm1(-dead / tau))
    spread = rate * exposure * (1 + 3 * p) / (1 + x) ** 3
    delay = dead - tau * math.expm1(-(frame_time - dead) / tau)
    hit = -np.expm1(-rate * (frame_time + p * delay))
    first = -np.expm1(-rate * frame_time)
    ones = (frames - 1) * hit + first
    return (
        float(detections @ pixels),
        math.sqrt(float(spread @ pixels)),
        float(ones @ pixels),
        math.sqrt(float((frames * hit * (1 - hit)) @ pixels)),
    )


@pytest.mark.slow
@pytest.mark.skipif(not MNIST.is_dir(), reason="MNIST is not in shared/mnist beside the repository")
@pytest.mark.parametrize("mlux", TEN_LEVELS)
def test_ten_levels(mlux: int) -> None:
    """All of MNIST: total detections and total QIS ones within 5 sigma, by the table and by the histogram here."""
    one = config.read(Path(__file__).resolve().parents[1] / "configs" / "spad_mnist.yaml")
    one = replace(one, readouts=("tr", "qis"))
    level = one.level(f"{mlux} mlux")
    splits = one.load_images(MNIST)
    histogram = sum(np.bincount(images.pixels.ravel(), minlength=256) for images in splits.values())
    assert sum(len(images) for images in splits.values()) == 70_000
    rate = 0.5 * np.arange(256) / 255.0 * white(mlux * 1e-3) + 100.0
    detections, spread, ones, ones_spread = expected_totals(rate, np.asarray(histogram, float))
    assert detections == pytest.approx(TEN_LEVELS[mlux][0], abs=spread)
    assert ones == pytest.approx(TEN_LEVELS[mlux][1], abs=ones_spread)
    found = found_ones = 0
    for split, images in splits.items():
        for start in range(0, len(images), 2000):
            recorded = one.simulate(level, split, images, start, min(start + 2000, len(images)))
            assert recorded.counts is not None and recorded.ones is not None
            found += int(recorded.counts.sum(dtype=np.int64))
            found_ones += int(recorded.ones.sum(dtype=np.int64))
    for expected, expected_ones in ((detections, ones), TEN_LEVELS[mlux]):
        assert abs(found - expected) < 5 * spread
        assert abs(found_ones - expected_ones) < 5 * ones_spread
    # one event more in every image of the dimmest level is 26 sigma
    assert mlux > 5 or 20 * spread < 70_000
