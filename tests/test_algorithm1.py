"""The oracle itself: hand-worked cases, and the closed forms of the laws that it must follow."""

from __future__ import annotations

import math
from random import Random

import algorithm1
import laws
import numpy as np
import pytest
from algorithm1 import Record
from scipy import special, stats

# The paper's dataset: 1 ms, 50 ns dead time, 0.5 % afterpulsing with 25 ns, 100 dark counts/s, 100 x 10 us.
PAPER = {
    "exposure": 1e-3,
    "pdp": 0.5,
    "dark_count_rate": 100.0,
    "dead_time": 50e-9,
    "afterpulsing": 0.005,
    "lifetime": 25e-9,
    "resolution": 100e-12,
    "frames": 100,
    "frame_time": 10e-6,
}
PLAIN = PAPER | {"pdp": 1.0, "dark_count_rate": 0.0, "afterpulsing": 0.0, "resolution": 0.0}


def _pixels(seed: int, number: int, flux: float, **changes: float) -> list[Record]:
    rng = Random(seed)
    return [algorithm1.pixel(rng, flux, **(PLAIN | changes)) for _ in range(number)]


# ---- light ------------------------------------------------------------------------------------------------


def test_white_at_2560_mlux() -> None:
    """262 photons in 1 ms on 25 um^2 at 555 nm."""
    flux = algorithm1.photon_flux(255, 255, 2.560, 25e-12, 555e-9)
    assert flux == pytest.approx(2.618e5, rel=2e-4)
    assert algorithm1.photon_flux(0, 255, 2.560, 25e-12, 555e-9) == 0
    assert algorithm1.photon_flux(51, 255, 2.560, 25e-12, 555e-9) == pytest.approx(flux / 5)
    assert algorithm1.photon_flux(255, 255, 2.560, 25e-12, 555e-9, fill_factor=0.25) == pytest.approx(flux / 4)
    assert algorithm1.photon_flux(255, 255, 2.560, 25e-12, 1110e-9) == pytest.approx(flux * 2)


# ---- readouts by hand -------------------------------------------------------------------------------------


def test_dead_time_counts_from_the_last_recorded_event() -> None:
    """3 is blocked by 0 and does not block 6 (non-paralyzable); exactly one dead time is still blocked."""
    assert algorithm1.time_resolved([0.0, 3.0, 6.0, 7.0, 11.0, 11.5], 5.0, 0.0) == [0.0, 6.0, 11.5]
    assert algorithm1.time_resolved([0.0, 3.0], 0.0, 0.0) == [0.0, 3.0]
    assert algorithm1.time_resolved([], 5.0, 0.0) == []


def test_stamps_are_rounded_after_the_dead_time() -> None:
    """A gap of 5.4 passes a dead time of 5 and may be 5 after rounding; one of 4.6 is blocked at once."""
    assert algorithm1.time_resolved([1.4, 6.8, 11.4], 5.0, 1.0) == [1.0, 7.0]
    assert algorithm1.time_resolved([0.8, 6.2], 5.0, 1.0) == [1.0, 6.0]
    assert algorithm1.time_resolved([9.8], 5.0, 1.0) == [10.0]  # a TR stamp may round to the exposure


def test_frames_are_half_open_and_have_no_dead_time() -> None:
    events = [0.0, 1.0, 1.5, 2.9999, 4.0, 7.5]
    assert algorithm1.quanta(events, 6, 1.0) == [1, 1, 1, 0, 1, 0]  # 7.5 is after the last frame
    assert algorithm1.synchronous(events, 6, 1.0, 0.0) == pytest.approx([0.0, 0.0, 0.9999, 1.0, 0.0, 1.0])
    assert algorithm1.quanta([0.2, 0.3, 0.4], 1, 1.0) == [1]
    assert algorithm1.synchronous([0.2, 0.3, 0.4], 1, 1.0, 0.0) == [0.2]
    assert algorithm1.quanta([], 3, 1.0) == [0, 0, 0]
    assert algorithm1.synchronous([], 3, 1.0, 0.25) == [1.0, 1.0, 1.0]


def test_a_frame_stamp_never_means_none() -> None:
    """What rounds to the frame time is stored one tick earlier; without rounding it stays below as well."""
    assert algorithm1.synchronous([0.96, 1.9], 2, 1.0, 0.25) == [0.75, 0.75]
    assert algorithm1.synchronous([0.86, 1.88], 2, 1.0, 0.25) == [0.75, 0.75]
    assert algorithm1.synchronous([0.37, 1.38], 2, 1.0, 0.25) == [0.25, 0.5]
    for f in range(100):
        last = math.nextafter((f + 1) * 10e-6, 0.0)
        for resolution in (0.0, 100e-12, 3e-9):  # 3 ns does not divide the frame
            stamps = algorithm1.synchronous([last], 100, 10e-6, resolution)
            assert [stamp < 10e-6 for stamp in stamps] == [i == f for i in range(100)]
            assert stamps[f] > 10e-6 - max(resolution, 1e-15) * (1 + 1e-9)


# ---- reconstructions by hand ------------------------------------------------------------------------------


def test_counts() -> None:
    assert algorithm1.counts(0, 0.5, 1e-3) == 0
    assert algorithm1.counts(131, 0.5, 1e-3) == pytest.approx(262_000)


def test_passive_free_running() -> None:
    """N = 100, q = 0.5, T = 10, tau_d = 0.05: 100 / (0.5 (10 - 5)) = 40; the most that fits is 200."""
    assert algorithm1.passive_free_running(0, 0.5, 10.0, 0.05) == 0
    assert algorithm1.passive_free_running(100, 0.5, 10.0, 0.05) == pytest.approx(40)
    assert algorithm1.passive_free_running(100, 0.5, 10.0, 0.0) == algorithm1.counts(100, 0.5, 10.0)
    assert algorithm1.passive_free_running(201, 0.5, 10.0, 0.05) == math.inf
    assert algorithm1.passive_free_running(20, 0.5, 10.0, 0.5) == math.inf  # the denominator is exactly 0
    assert algorithm1.stored_passive_free_running(100, 0.5, 10.0, 0.05) == pytest.approx(40)
    assert algorithm1.stored_passive_free_running(0, 0.5, 10.0, 0.05) == 0
    # 19.5 / (0.5 (10 - 9.75)) = 156
    assert algorithm1.stored_passive_free_running(20, 0.5, 10.0, 0.5) == pytest.approx(156)
    assert algorithm1.stored_passive_free_running(25, 0.5, 10.0, 0.5) == pytest.approx(156)
    # N_max need not be whole: T / tau_d = 20.5, so at 20: 20 / (0.5 (10.25 - 10)) = 160
    assert algorithm1.stored_passive_free_running(21, 0.5, 10.25, 0.5) == pytest.approx(160)


def test_inter_photon() -> None:
    """Stamps 1, 3, 7, tau_d = 0.5: 2 / (0.5 (6 - 1)) = 0.8."""
    assert algorithm1.inter_photon([], 0.5, 0.5, 0.1) == 0
    assert algorithm1.inter_photon([3.0], 0.5, 0.5, 0.1) == 0
    assert algorithm1.inter_photon([1.0, 3.0, 7.0], 0.5, 0.5, 0.1) == pytest.approx(0.8)
    assert not algorithm1.inter_photon_is_bounded([1.0, 3.0, 7.0], 0.5, 0.1)
    assert not algorithm1.inter_photon_is_bounded([3.0], 0.5, 0.1)
    # one dead time apart, exactly: the bracket is 0, taken as dt / 2 = 0.125; 1 / (0.5 * 0.125) = 16
    assert algorithm1.inter_photon([1.0, 1.5], 0.5, 0.5, 0.25) == pytest.approx(16)
    assert algorithm1.inter_photon_is_bounded([1.0, 1.5], 0.5, 0.25)
    # a dead time that is no multiple of the tick: the bracket is below 0, taken as 2 dt / 2 = 0.25
    assert algorithm1.inter_photon([1.0, 1.5, 2.0], 0.5, 0.55, 0.25) == pytest.approx(16)
    # positive, yet below the bound: 5 intervals of 0.25, a dead time of 0.2: 0.25 < 0.625
    six = [0.25 * i for i in range(6)]
    assert algorithm1.inter_photon(six, 1.0, 0.2, 0.25) == pytest.approx(5 / 0.625)
    assert algorithm1.inter_photon_is_bounded(six, 0.2, 0.25)
    # without dead time, two stamps in one tick
    assert algorithm1.inter_photon([1.0, 1.0], 1.0, 0.0, 0.25) == pytest.approx(8)
    assert algorithm1.inter_photon([1.0, 1.5], 0.5, 0.5, 0.0) == math.inf


def test_str_flux() -> None:
    """Stamps 1, 4 (none), 3 of frames of 4, q = 0.5: 2 / (0.5 * 8) = 0.5."""
    assert algorithm1.str_flux([1.0, 4.0, 3.0], 0.5, 4.0, 0.5) == pytest.approx(0.5)
    assert algorithm1.str_flux([4.0, 4.0], 0.5, 4.0, 0.5) == 0
    assert algorithm1.str_flux([0.0, 4.0], 0.5, 4.0, 0.5) == pytest.approx(0.5)  # a stamp of 0 is a detection
    # every stamp is 0: taken as dt / 2 = 0.25 each; 3 / (0.5 * 0.75) = 8
    assert algorithm1.str_flux([0.0, 0.0, 0.0], 0.5, 4.0, 0.5) == pytest.approx(8)


def test_qis_counts() -> None:
    assert algorithm1.qis_counts([0, 0, 0]) == 0
    assert algorithm1.qis_counts([1, 0, 1, 1]) == 3
    assert algorithm1.qis_counts([1] * 100) == 100


def test_qis_linear() -> None:
    assert algorithm1.qis_linear([0] * 4) == 0
    assert math.copysign(1, algorithm1.qis_linear([0] * 4)) == 1  # not -0.0
    assert algorithm1.qis_linear([1, 0, 1, 0]) == pytest.approx(4 * math.log(2))
    assert algorithm1.qis_linear([1, 1, 1, 0]) == pytest.approx(4 * math.log(4))
    assert algorithm1.qis_linear([1] * 4) == pytest.approx(4 * math.log(8))  # as if 3.5 of 4
    assert algorithm1.qis_linear([1] * 100) == pytest.approx(100 * math.log(200))


# ---- closed forms -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mean", [0.0, 0.05, 1.0, 7.5, 120.0])
def test_poisson_numbers(mean: float) -> None:
    rng = Random(11)
    numbers = [algorithm1.poisson(rng, mean) for _ in range(4000)]
    laws.poisson_mean(sum(numbers), 4000 * mean)
    laws.histogram_is(numbers, lambda k: stats.poisson.pmf(k, mean))


def test_photons_and_dark_counts_are_one_poisson_process() -> None:
    """Rate q phi + phi_d, uniform over the exposure."""
    flux, rate = 4e4, 0.3 * 4e4 + 5e3
    records = _pixels(1, 3000, flux, pdp=0.3, dark_count_rate=5e3)
    numbers = [len(r.events) for r in records]
    laws.poisson_mean(sum(numbers), 3000 * rate * 1e-3)
    laws.histogram_is(numbers, lambda k: stats.poisson.pmf(k, rate * 1e-3))
    laws.distribution_is([t for r in records for t in r.events], lambda t: t / 1e-3, what="event times")


def test_no_light_no_dark_counts_no_events() -> None:
    (record,) = _pixels(2, 1, 0.0)
    assert record == Record(tr=[], str=[10e-6] * 100, qis=[0] * 100, events=[])
    (record,) = _pixels(2, 1, 1e5, pdp=0.0)
    assert record.events == []


def test_afterpulse_delay() -> None:
    """Certain afterpulses of rare events: exactly one child each, at the dead time and an exponential."""
    pairs = [
        r.events for r in _pixels(3, 20_000, 100.0, afterpulsing=1.0, lifetime=300e-9, dead_time=200e-9) if r.events
    ]
    delays = [events[1] - events[0] for events in pairs if len(events) == 2]
    assert len(delays) > 1500
    assert min(delays) > 200e-9 * (1 - 1e-6)
    laws.distribution_is(delays, lambda d: -np.expm1(-(d - 200e-9) / 300e-9), what="afterpulse delays")


@pytest.mark.parametrize(("share", "lifetime"), [(0.05, 25e-9), (0.5, 100e-6), (1.0, 1e-3)])
def test_afterpulse_share(share: float, lifetime: float) -> None:
    """Events: lambda (T + p int_0^(T - tau_d) (1 - exp(-t / tau)) dt), also where many fall after T."""
    rate, exposure, dead = 3e4, 1e-3, 50e-9
    records = _pixels(4, 3000, rate, afterpulsing=share, lifetime=lifetime)
    live = exposure - dead
    children = share * (live + lifetime * math.expm1(-live / lifetime))
    numbers = [len(r.events) for r in records]
    laws.mean_is(numbers, rate * (exposure + children), what="events with afterpulses")
    assert all(t < exposure for r in records for t in r.events)


def test_afterpulses_make_the_counts_wider_than_poisson() -> None:
    """Fano (1 + 3 p) / (1 + p) of all events, each with its child: 1 + 2 p to first order."""
    share, rate = 0.2, 3e4
    records = _pixels(5, 4000, rate, afterpulsing=share)
    numbers = [len(r.events) for r in records]
    laws.variance_is(numbers, rate * 1e-3 * (1 + 3 * share))


def test_a_blocked_event_has_afterpulses_too() -> None:
    """Parents are all events before the dead time: the events do not depend on it but for the delay."""
    rate, dead = 2e7, 50e-9
    records = _pixels(6, 300, rate, exposure=20e-6, frame_time=200e-9, dead_time=dead, afterpulsing=0.1, lifetime=1e-12)
    numbers = [len(r.events) for r in records]
    laws.mean_is(numbers, rate * (20e-6 + 0.1 * (20e-6 - dead - 1e-12)), what="events at x = 1")


@pytest.mark.parametrize("rate", [1e6, 2e7, 2e8])
def test_non_paralyzable_dead_time(rate: float) -> None:
    """P(N >= n) = P(Gamma(n) <= lambda (T - (n - 1) tau_d)); rate lambda / (1 + x), Fano 1 / (1 + x)^2."""
    exposure, dead = 20e-6, 50e-9
    records = _pixels(7, 400, rate, exposure=exposure, frame_time=200e-9, dead_time=dead)
    numbers = np.array([len(r.tr) for r in records])

    def at_least(n: np.ndarray) -> np.ndarray:
        live = np.maximum(exposure - (n - 1) * dead, 0.0)
        return np.where(n == 0, 1.0, special.gammainc(np.maximum(n, 1), rate * live))

    def pmf(n: np.ndarray) -> np.ndarray:
        return at_least(n) - at_least(n + 1)

    laws.histogram_is(numbers, pmf)
    n = np.arange(2000)
    mean = float((n * pmf(n)).sum())
    variance = float(((n - mean) ** 2 * pmf(n)).sum())
    x = rate * dead
    assert mean == pytest.approx(exposure * rate / (1 + x), rel=0.01)  # of the exact law: the edges of 20 us
    assert variance / mean == pytest.approx(1 / (1 + x) ** 2, rel=0.02, abs=3e-4)
    laws.mean_is(numbers, mean, what="recorded detections")
    gaps = np.concatenate([np.diff(r.tr) for r in records])
    assert gaps.min() > dead


def test_intervals_between_recorded_detections() -> None:
    """A dead time and an exponential (long exposures: few intervals are cut by the end)."""
    records = _pixels(8, 5, 2e7, exposure=1e-3)
    gaps = np.concatenate([np.diff(r.tr) for r in records])
    laws.distribution_is(gaps, lambda g: -np.expm1(-2e7 * (g - 50e-9)), what="intervals")


@pytest.mark.parametrize("rate", [1e4, 1e5, 4e5])
def test_qis_and_str_laws(rate: float) -> None:
    """Bits are binomial with 1 - exp(-lambda T_f); first arrivals are exponential, cut at the frame time."""
    records = _pixels(9, 300, rate)
    hit = -math.expm1(-rate * 10e-6)
    sums = [sum(r.qis) for r in records]
    laws.share_is(sum(sums), 300 * 100, hit)
    laws.histogram_is(sums, lambda k: stats.binom.pmf(k, 100, hit))
    stamps = [d for r in records for d in r.str if d < 10e-6]
    assert len(stamps) == sum(sums)
    laws.distribution_is(stamps, lambda d: np.expm1(-rate * d) / math.expm1(-rate * 10e-6), what="first arrivals")


def test_estimators_return_the_flux() -> None:
    """Bright enough that the dead time matters: `counts` misses the flux, the three others find it."""
    flux, pdp, dead = 2e7, 0.5, 50e-9
    records = _pixels(10, 200, flux, pdp=pdp, exposure=100e-6, frame_time=1e-6, dead_time=dead, resolution=1e-10)
    recorded = [len(r.tr) for r in records]
    biased = [algorithm1.counts(n, pdp, 100e-6) for n in recorded]
    laws.mean_is(biased, flux / (1 + pdp * flux * dead), error=flux * 1e-3)
    free_running = [algorithm1.passive_free_running(n, pdp, 100e-6, dead) for n in recorded]
    laws.mean_is(free_running, flux, error=flux * 2e-3)  # both are biased by about 1 / N, N = 670
    between = [algorithm1.inter_photon(r.tr, pdp, dead, 1e-10) for r in records]
    laws.mean_is(between, flux, error=flux * 2e-3)
    first = [algorithm1.str_flux(r.str, pdp, 1e-6, 1e-10) for r in records]
    laws.mean_is(first, flux, error=flux * 1.1e-2)  # about 1 / M, M = 100
    with pytest.raises(AssertionError):
        laws.mean_is(biased, flux)


def test_the_papers_pixel() -> None:
    """White at 2560 mlux: three readouts of the same events, on their grids."""
    flux = algorithm1.photon_flux(255, 255, 2.560, 25e-12, 555e-9)
    rng = Random(12)
    records = [algorithm1.pixel(rng, flux, **PAPER) for _ in range(500)]
    rate = 0.5 * flux + 100
    children = 0.005 * (1e-3 - 50e-9 - 25e-9)
    laws.mean_is([len(r.events) for r in records], rate * (1e-3 + children))
    for r in records:
        assert r.events == sorted(r.events)
        assert r.tr == algorithm1.time_resolved(r.events, 50e-9, 100e-12)
        assert [int(d < 10e-6) for d in r.str] == r.qis
        assert r.qis == [int(any(f * 10e-6 <= t < (f + 1) * 10e-6 for t in r.events)) for f in range(100)]
        for stamp in (*r.tr, *r.str):
            assert stamp / 100e-12 == pytest.approx(round(stamp / 100e-12), abs=1e-6)


def test_one_seed_one_record() -> None:
    a, b = (algorithm1.pixel(Random(5), 1e5, **PAPER) for _ in range(2))
    assert a == b
