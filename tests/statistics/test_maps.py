"""Maps: against literal versions, their laws, and what they are made to see."""

from __future__ import annotations

import math
from functools import partial

import laws
import numpy as np
import pytest
from scipy import integrate, stats
from simple_sensor import (
    counted,
    grid,
    in_equal_times,
    many,
    one_of_each,
    qis,
    qis_of,
    reduced,
    sigmas,
    stamped,
    str_of,
    tr,
    tr_of,
    waits,
)

from spadmnist.events import Layout
from spadmnist.recording import Recording
from spadmnist.statistics.maps import Columns, Outliers, PixelMap, Rows, Spread, Surface, Tails

ALL = (PixelMap, Rows, Columns, Surface, Outliers, Tails, Spread)
KINDS = ("tr", "qis", "str", "counts", "counter")


def slots_of(recording: Recording) -> float:
    """Detections that a pixel can have."""
    conditions = recording.conditions
    if recording.modality == "tr" or conditions.counting == "counter":
        return math.inf
    return conditions.frames


def literal_number(recording: Recording, count: float) -> float:
    """The number that scatters like a Poisson count of its size."""
    slots = slots_of(recording)
    if recording.modality == "str":
        photons = count / waits(np.asarray(recording.frames[:]), recording.none).sum(axis=0).mean()  # type: ignore[index]
        root, _ = integrate.quad(lambda z: math.sqrt(-math.expm1(-z * z)) / z, 0, math.sqrt(photons))
        return slots * root**2
    if math.isfinite(slots):
        return (slots + 3) * math.asin(math.sqrt(count / (slots + 3))) ** 2
    if recording.dead_time == 0:
        return count
    blind = recording.dead_time / recording.conditions.exposure
    assert count * blind < 0.9
    return math.atanh(math.sqrt(count * blind)) ** 2 / blind


@pytest.mark.parametrize("kind", KINDS)
def test_maps_of_a_small_recording(kind: str) -> None:
    recording = one_of_each()[kind]
    counts = in_equal_times(recording, (0,)) if kind == "str" else recording.totals
    numbers = np.array([literal_number(recording, float(n)) for n in counts]).reshape(6, 11)
    assert np.allclose(reduced(PixelMap, recording).values, np.rint(numbers).ravel(), atol=1e-9)
    assert np.allclose(reduced(Rows, recording).values, np.rint([sum(row) for row in numbers]), atol=1e-9)
    assert np.allclose(reduced(Columns, recording).values, np.rint([sum(column) for column in numbers.T]), atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_number_says_how_many_detections_it_stands_for(kind: str) -> None:
    recording = one_of_each()[kind]
    summary = reduced(PixelMap, recording)
    for pixel in (0, 17, 65):
        found = int(recording.totals[pixel])
        text, share = summary.size(pixel, literal_number(recording, found), literal_number(recording, 2))
        what = "detections in an equal time of waiting" if kind == "str" else "detections"
        assert text == f"{found} {what}, 2 expected"
        assert math.isclose(share, (found - 2) / 2, rel_tol=1e-6 if kind == "str" else 1e-9)  # by a table
        assert summary.where(pixel) == f"row {pixel // 11}, column {pixel % 11}"


def test_few_detections_stay_what_they_are() -> None:
    recording = qis(1, (5000, 4, 4), 1e-3)
    assert np.array_equal(reduced(PixelMap, recording).values, recording.totals)


def literal_rates(recording: Recording) -> list[float]:
    slots = slots_of(recording)
    if math.isfinite(slots):
        return [-slots * math.log((slots - n + 1.5) / (slots + 1.5)) for n in recording.totals]
    blind = recording.dead_time / recording.conditions.exposure
    return [n / (1 - n * blind) for n in recording.totals]


@pytest.mark.parametrize("kind", ["tr", "qis"])
def test_the_surface_is_a_fit_of_a_polynomial(kind: str) -> None:
    recording = one_of_each()[kind]
    rates = np.array(literal_rates(recording))
    terms = []
    for pixel in range(66):
        y, x = pixel // 11 / 5 - 0.5, pixel % 11 / 10 - 0.5
        terms.append([1, x, y, 4 * x * x, 4 * x * y, 4 * y * y])
    wanted = np.linalg.lstsq(np.array(terms), rates / rates.mean(), rcond=None)[0][1:]
    assert np.allclose(reduced(Surface, recording).values, wanted, rtol=1e-9)


@pytest.mark.parametrize(
    ("layout", "terms"),
    [(grid(1, 1), 0), (grid(1, 2), 1), (grid(1, 8), 2), (grid(8, 1), 2), (grid(2, 2), 3), (grid(4, 4), 5)],
)
def test_the_surface_has_the_terms_that_an_array_can_tell(layout: Layout, terms: int) -> None:
    summary = Surface().reduce(tr(1, layout, 1e5, 1e-3))
    assert (0 if summary is None else len(summary.values)) == terms


def test_positions_are_places() -> None:
    places = np.random.default_rng(3).random((40, 2)) * [80e-6, 40e-6]
    layout = Layout(1, 40, 25e-12, 1.0, places)
    rate = 3e5 * (1 + 0.5 * (places[:, 1] - places[:, 1].mean()) / np.ptp(places[:, 1]))
    recording = tr(1, layout, rate, 10e-3)
    summary = reduced(Surface, recording)
    assert len(summary.values) == 5 and abs(summary.values[1] - 0.5) < 0.15 and abs(summary.values[0]) < 0.15
    assert "(y)" in summary.where(1)
    x, y = places[7] * 1e6
    assert reduced(PixelMap, recording).where(7) == f"pixel 7 at x = {x:.4g} um, y = {y:.4g} um"
    assert reduced(PixelMap, recording).shape is None
    assert Rows().reduce(recording) is None and Columns().reduce(recording) is None


def test_outliers_and_tails_of_a_plain_array() -> None:
    """Far from all noise, where rounding does not matter."""
    counts = np.full(100, 1000)
    counts[:7] = [100, 200, 400, 600, 700, 1, 0]
    counts[-4:] = [1500, 3000, 5000, 20000]
    rows = [np.linspace(0, 0.99, n) for n in counts]
    recording = tr_of(rows, grid(10, 10), 1.0)
    assert reduced(Outliers, recording).values.tolist() == [4, 5, 7, 4, 3, 2, 1]
    summary = reduced(Tails, recording)
    order = np.sort(counts)
    wanted = [order[:25].mean() / 1000, np.log(order[-25:].mean() / 1000)]
    assert np.allclose(summary.values, wanted, atol=1e-3)
    text, number = summary.size(1, float(summary.values[1]), 0.0)
    assert (
        text.startswith(f"{order[-25:].mean() / 1000:.3g}"[:3]) and abs(number - (order[-25:].mean() / 1000 - 1)) < 2e-3
    )


def test_the_spread_is_told_as_a_share_of_the_mean() -> None:
    rng = np.random.default_rng(2)
    x = np.arange(1024) % 32 / 31 - 0.5
    rate = 1e6 * (1 + 0.06 * rng.standard_normal(1024) + 0.4 * x)
    recording = tr(1, grid(32, 32), rate, 2e-3)
    summary = reduced(Spread, recording)
    sizes = [summary.size(cell, float(summary.values[cell]), 0.0)[1] for cell in range(2)]
    assert abs(sizes[1] - 0.06) < 0.004
    assert abs(sizes[0] - math.hypot(0.06, 0.4 / math.sqrt(12))) < 0.01
    # literally: variance of the counts less their mean
    counts = recording.totals
    assert abs(sizes[0] - math.sqrt(counts.var(ddof=1) - counts.mean()) / counts.mean()) < 1e-3


STEADY = {
    "tr": partial(tr, layout=grid(8, 8), rates=1.5e6, exposure=2e-3, dead_time=50e-9),
    "tr, few": partial(tr, layout=grid(16, 16), rates=1e3, exposure=2e-3),
    "qis": partial(qis, shape=(300, 8, 8), share=0.4),
    "qis, bright": partial(qis, shape=(300, 8, 8), share=0.9),
    "qis, few": partial(qis, shape=(300, 8, 8), share=0.01),
    "str": partial(stamped, shape=(300, 8, 8), share=0.3),
    "str, bright": partial(stamped, shape=(300, 8, 8), share=0.95),
    "counts": partial(counted, shape=(60, 8, 8), share=0.4),
    "counter": partial(counted, shape=(60, 8, 8), share=0.4, counting="counter"),
}


@pytest.mark.parametrize("kind", STEADY)
def test_the_numbers_of_pixels_are_poisson(kind: str) -> None:
    """Variance as large as the mean, whatever the light; and far out no more than a Poisson law has."""
    values = many(PixelMap, STEADY[kind], 60)
    mean = values.mean()
    # three slots more than there are make full pixels scatter less: here 30 are free of 300; so does waiting for three
    # detections more, where waiting is what scatters
    less = {"qis, bright": 30 / 33, "str, bright": (1 + 0.95 * 3 / 285) ** -2}.get(kind, 1.0)
    laws.variance_is(values, mean * less, what=kind)
    lower = stats.poisson.cdf(values, mean)
    upper = stats.poisson.sf(values - 1, mean)
    assert min(lower.min(), upper.min()) > laws.FALSE_ALARM / values.size
    if kind in ("tr", "qis", "qis, bright", "str, bright", "counts"):  # of plain counts it does not hold
        plain = np.array([STEADY[kind](seed).totals for seed in range(1000, 1060)], np.float64)
        with pytest.raises(AssertionError):
            laws.variance_is(plain, plain.mean())


def test_pixels_that_are_not_alike_scatter_alike_by_their_stamps() -> None:
    """0.1, 1, 4 and 12 photons a frame: of a plain ratio the brightest would have three times the variance."""
    photons = np.repeat([0.1, 1.0, 4.0, 12.0], 16).reshape(8, 8)
    values = many(PixelMap, partial(stamped, shape=(1000, 8, 8), share=-np.expm1(-photons)), 100)
    for number in np.unique(photons):
        laws.variance_is(some := values[:, photons.ravel() == number], some.mean(), what=str(number))


def test_a_gate_leaves_the_stamps_what_they_tell() -> None:
    """Live from 40 % of a frame on: waited is there only, and a pixel of 10 % more light has 10 % more."""
    first = stamped(3, (1500, 8, 8), -np.expm1(-4.0 * np.where(np.arange(64).reshape(8, 8) < 32, 1.1, 1.0)))
    frames = np.asarray(first.frames[:])  # type: ignore[index]
    gated = str_of(np.where(frames < 1000, 400 + frames * 6 // 10, 1000))
    for recording in (first, gated):
        tails = reduced(Surface, recording)
        assert tails.where(1).endswith("(y)")
        # a step from 1.05 to 0.95 has as a line 1.5 times its height
        assert abs(tails.values[1] + 0.15 / 1.05) < 5 * math.sqrt(12 / 96_000)
    ticks = str_of(frames // 250, 250e-8)  # of which hardly any frame goes through one
    assert ticks.none == 4 and ticks.waited is None and first.waited is not None
    assert np.array_equal(reduced(PixelMap, ticks).values, reduced(PixelMap, qis_of(frames < 1000)).values)


@pytest.mark.parametrize("kind", ["tr", "qis", "qis, few", "tr, few", "str, bright"])
@pytest.mark.parametrize("statistic", [Surface, Spread, Tails])
def test_shapes_of_the_map_are_normal(statistic: type, kind: str) -> None:
    values = many(statistic, STEADY[kind], 150)
    for cell in values.T:
        z = (cell - cell.mean()) / cell.std(ddof=1)
        assert np.abs(z).max() < 5.2 and abs(stats.skew(z)) < 0.9
    if statistic is Spread:
        laws.mean_is(values[:, 0], 0.0)
        laws.distribution_is(values[:, 0], stats.norm.cdf)
        laws.distribution_is(values[:, 1], stats.norm.cdf)
    if statistic is Surface:
        for cell in values.T:
            laws.mean_is(cell, 0.0)


def test_outliers_are_no_more_than_poisson() -> None:
    for kind in ("tr, few", "qis, few", "qis"):
        values = many(Outliers, STEADY[kind], 150)
        ratio = values.var(axis=0, ddof=1) / np.maximum(values.mean(axis=0), 1e-9)
        # 5 standard errors of a variance of Poisson numbers
        error = np.sqrt((2 + 1 / np.maximum(values.mean(axis=0), 1e-3)) / len(values))
        assert (ratio < 1 + 5 * error).all()


# effect: (relative rates of 256 pixels with 1000 detections each, by how many sigmas each statistic moves at least)
SEEN = {
    "PDP spread of 5 %": (lambda rng: 1 + 0.05 * rng.standard_normal(256), {Spread: 14, Tails: 10, PixelMap: 5}),
    "lazy pixels, 3 %": (
        lambda rng: np.where(rng.random(256) < 0.03, 0.4, 1.0),
        {Outliers: 5, Tails: 40, PixelMap: 20},
    ),
    "hot pixels, 3 %": (lambda rng: np.where(rng.random(256) < 0.03, 5.0, 1.0), {Outliers: 5, Tails: 99, PixelMap: 60}),
    "a gradient of 5 %": (lambda rng: 1 + 0.05 * (np.arange(256) % 16 / 15 - 0.5), {Surface: 6}),
    "rows, 2 %": (lambda rng: 1 + np.repeat(0.02 * rng.standard_normal(16), 16), {Rows: 5}),
}


@pytest.mark.parametrize("effect", SEEN)
def test_maps_see_what_they_are_made_for(effect: str) -> None:
    change, wanted = SEEN[effect]
    layout, exposure = grid(16, 16), 1e-3
    shape = change(np.random.default_rng(5))
    steady = partial(tr, layout=layout, rates=1e6, exposure=exposure)
    recording = tr(7, layout, 1e6 * shape, exposure)
    for statistic, least in wanted.items():
        assert np.abs(sigmas(statistic, recording, steady)).max() > least, statistic.name
    # and an array that is as it should be moves nothing
    plain = tr(8, layout, 1e6, exposure)
    for statistic in wanted:
        assert np.abs(sigmas(statistic, plain, steady)).max() < 5


def test_stamps_tell_pixels_apart_where_nearly_every_frame_has_one() -> None:
    """3 % of spread in 1500 frames with 3.5 photons each, of 256 pixels.

    Frames without a detection tell a rate to 1 / sqrt(570), with the stamps to 1 / sqrt(1455): by chi squared 0.03^2 *
    256 * these numbers / sqrt(2 * 256), 5.8 and 14.8 standard deviations; as a normal score that is 5.2 and 11.5.
    """
    rate = 3.5 * (1 + 0.03 * np.random.default_rng(5).standard_normal((16, 16)))
    shape = (1500, 16, 16)
    stamps = stamped(7, shape, -np.expm1(-rate))
    bits = qis_of(np.asarray(stamps.frames[:]) < stamps.none)  # type: ignore[index]
    (found, _) = sigmas(Spread, stamps, partial(stamped, shape=shape, share=-np.expm1(-3.5)))
    (less, _) = sigmas(Spread, bits, partial(qis, shape=shape, share=-np.expm1(-3.5)))
    assert found > 8 > less > 2
    text, size = reduced(Spread, stamps).size(0, float(reduced(Spread, stamps).values[0]), 0.0)
    assert abs(size - float(np.std(rate / 3.5))) < 0.01, text


def test_a_gradient_is_not_a_spread_of_pixels() -> None:
    layout = grid(16, 16)
    shape = 1 + 0.2 * (np.arange(256) // 16 / 15 - 0.5)
    found = sigmas(Spread, tr(7, layout, 1e6 * shape, 2e-3), partial(tr, layout=layout, rates=1e6, exposure=2e-3))
    assert found[0] > 20 and abs(found[1]) < 5


@pytest.mark.parametrize("kind", ["qis", "str", "counts"])
@pytest.mark.parametrize("statistic", ALL)
def test_pieces_make_no_difference(statistic: type, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = reduced(statistic, one_of_each()[kind]).values
    monkeypatch.setattr("spadmnist.recording._CHUNK", 100)
    assert np.array_equal(reduced(statistic, one_of_each()[kind]).values, whole)


@pytest.mark.parametrize("statistic", ALL)
def test_the_cells_do_not_depend_on_the_data(statistic: type) -> None:
    for layout in (grid(16, 16), grid(1, 1), grid(1, 23), grid(3, 2)):
        cells = set()
        for rate in (0.0, 1e3, 1e6):
            summary = statistic().reduce(tr(1, layout, rate, 1e-3, 50e-9))
            cells.add(None if summary is None else len(summary.values))
        assert len(cells) == 1
    full = qis_of(np.ones((100, 16, 16), bool))
    empty = qis_of(np.zeros((100, 16, 16), bool))
    assert reduced(statistic, full).values.shape == reduced(statistic, empty).values.shape
