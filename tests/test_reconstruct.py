"""The six reconstructions: by hand, against the literal ones, and every rule for what has no information."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import algorithm1
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from spadmnist import reconstruct
from spadmnist.errors import EffectError
from spadmnist.events import Events
from spadmnist.readout import Recorded
from spadmnist.reconstruct import InterPhoton, Method, Settings, median_of_nonzero, medians_of_nonzero

METHODS = ("counts", "passive_free_running", "inter_photon", "str_flux", "qis_counts", "qis_linear")
PAPER = Settings(pdp=0.5, exposure=1e-3, dead_time=50e-9, tick=10e-12, frames=100, frame_time=10e-6)


def recorded(
    counts: Sequence[int] = (),
    span: Sequence[float] = (),
    ones: Sequence[int] = (),
    waited: Sequence[float] = (),
) -> Recorded:
    return Recorded(
        pixels=1,
        counts=np.array(counts, np.int32),
        span=np.array(span, float),
        ones=np.array(ones, np.int32),
        waited=np.array(waited, float),
    )


def image(name: str, settings_: Settings, data: Recorded) -> tuple[list[float], list[bool]]:
    """What a dataset stores, and which pixels its manifest counts: each of them alone, and all together."""
    method = reconstruct.find(name)
    values, saturated = method.image(data, settings_)
    assert values.dtype == np.float32
    assert np.all(np.isfinite(values)) and np.all(values >= 0) and not np.any(np.signbit(values))
    alone = [method.image(data.images(i, i + 1), settings_) for i in range(len(values))]
    assert np.array_equal(values, [value for one, _ in alone for value in one])
    assert sum(number for _, number in alone) == saturated
    return values.tolist(), [number == 1 for _, number in alone]


def close(values: Iterable[float]) -> list[object]:
    return [pytest.approx(v, rel=1e-6) for v in values]


# ---- what they are ----------------------------------------------------------------------------------------


def test_the_six_methods() -> None:
    assert set(METHODS) <= set(reconstruct.Method.registry)
    units = {name: (reconstruct.find(name).unit, reconstruct.find(name).normalised) for name in METHODS}
    assert units == {
        "counts": ("1/s", True),
        "passive_free_running": ("1/s", True),
        "inter_photon": ("1/s", True),
        "str_flux": ("1/s", True),
        "qis_counts": ("1", False),
        "qis_linear": ("1", False),
    }
    readouts = {name: reconstruct.find(name).readouts() for name in METHODS}
    assert readouts["counts"] == readouts["passive_free_running"] == readouts["inter_photon"] == ("tr",)
    assert readouts["str_flux"] == ("str",)
    assert readouts["qis_counts"] == readouts["qis_linear"] == ("qis",)
    with pytest.raises(KeyError, match="qis_linear"):
        reconstruct.find("qis_liner")


# ---- by hand ----------------------------------------------------------------------------------------------

HAND = Settings(pdp=0.5, exposure=10.0, dead_time=0.5, tick=0.25, frames=4, frame_time=4.0)


def test_counts() -> None:
    """N / (q T); q = 0.5, T = 10."""
    values, saturated = image("counts", HAND, recorded(counts=[0, 1, 7, 40]))
    assert values == close([0, 0.2, 1.4, 8]) and not any(saturated)
    values, _ = image("counts", PAPER, recorded(counts=[131]))
    assert values == close([262_000])


def test_passive_free_running() -> None:
    """N / (q (T - N tau_d)): at 10: 10 / (0.5 * 5) = 4. N_max = 20: stored at 19.5: 19.5 / (0.5 * 0.25) = 156."""
    values, saturated = image("passive_free_running", HAND, recorded(counts=[0, 1, 10, 19, 20, 21, 500]))
    assert values == close([0, 1 / 4.75, 4, 76, 156, 156, 156])
    assert saturated == [False, False, False, False, True, True, True]
    method = reconstruct.find("passive_free_running")
    function = method.estimate(HAND, np.array([19, 20, 21]))
    assert function.tolist() == [76.0, math.inf, math.inf]
    # N_max need not be whole: T / tau_d = 20.5, stored at 20: 20 / (0.5 * 0.25) = 160
    other = Settings(0.5, 10.25, 0.5, 0.25, 4, 4.0)
    assert image("passive_free_running", other, recorded(counts=[20, 21])) == (close([160, 160]), [False, True])
    without = Settings(0.5, 10.0, 0.0, 0.25, 4, 4.0)  # no dead time: as `counts`
    assert image("passive_free_running", without, recorded(counts=[0, 7, 10**6])) == (
        close([0, 1.4, 2e5]),
        [False] * 3,
    )


@pytest.mark.parametrize("exposure", [1e-3, 1e-4, 1e-5, 1e-2, 2e-3])
@pytest.mark.parametrize("dead_time", [50e-9, 100e-9, 25e-9, 1e-6])
def test_passive_free_running_where_a_whole_number_of_dead_times_fills_the_exposure(
    exposure: float, dead_time: float
) -> None:
    """N = T / tau_d leaves no live time: saturated, although T - N tau_d may round to 1e-20 s."""
    most = round(exposure / dead_time)
    assert exposure / dead_time == pytest.approx(most, rel=1e-12)
    one = Settings(0.5, exposure, dead_time, 1e-11, 100, exposure / 100)
    values, saturated = image("passive_free_running", one, recorded(counts=[most - 1, most, most + 1]))
    half = (most - 0.5) / (0.5 * 0.5 * dead_time)
    assert saturated == [False, True, True]
    assert values[1:] == [pytest.approx(half, rel=1e-4)] * 2
    assert values[0] == pytest.approx((most - 1) / (0.5 * dead_time), rel=1e-4)


@pytest.mark.parametrize("most", [0.4, 0.5, 0.75, 1.0])
def test_a_dead_time_as_long_as_the_exposure_gives_no_negative_flux(most: float) -> None:
    """One detection is all there can be: whatever stands for it is a positive, finite number."""
    one = Settings(0.5, 1e-3, 1e-3 / most, 1e-11, 100, 1e-5)
    values, saturated = image("passive_free_running", one, recorded(counts=[0, 1]))
    assert values[0] == 0 and values[1] > 0
    assert saturated == [False, True]


def test_inter_photon() -> None:
    """Stamps 1, 3, 7, tau_d = 0.5, q = 0.5: 2 / (0.5 (6 - 1)) = 0.8."""
    values, saturated = image("inter_photon", HAND, recorded(counts=[0, 1, 3], span=[0, 0, 6]))
    assert values == close([0, 0, 0.8]) and not any(saturated)
    # one dead time apart: the bracket is 0, taken as dt / 2; below 0: (N - 1) dt / 2; above 0, below the bound
    values, saturated = image("inter_photon", HAND, recorded(counts=[2, 3, 6, 2], span=[0.5, 0.75, 2.75, 0.625]))
    assert values == close([1 / (0.5 * 0.125), 2 / (0.5 * 0.25), 5 / (0.5 * 0.625), 1 / (0.5 * 0.125)])
    assert saturated == [True, True, True, False]  # the last one is at the bound, not below it
    without = Settings(1.0, 10.0, 0.0, 0.25, 4, 4.0)
    assert image("inter_photon", without, recorded(counts=[2, 2], span=[0.0, 2.0])) == (
        close([8, 0.5]),
        [True, False],
    )


def test_str_flux() -> None:
    """Stamps 1, none (4), 3, none (4), q = 0.5: 2 / (0.5 * 12) = 1 / 3."""
    values, saturated = image("str_flux", HAND, recorded(ones=[0, 2, 4], waited=[16.0, 12.0, 2.0]))
    assert values == close([0, 1 / 3, 4]) and not any(saturated)
    # every stamp 0: dt / 2 each, 4 / (0.5 * 4 * 0.125)
    assert image("str_flux", HAND, recorded(ones=[4], waited=[0.0])) == (close([16]), [True])


def test_qis_counts() -> None:
    assert image("qis_counts", HAND, recorded(ones=[0, 3, 4])) == ([0, 3, 4], [False] * 3)


def test_qis_linear() -> None:
    """-M ln(1 - S / M); S = M is taken as M - 1/2."""
    values, saturated = image("qis_linear", HAND, recorded(ones=[0, 2, 3, 4]))
    assert values == close([0, 4 * math.log(2), 4 * math.log(4), 4 * math.log(8)])
    assert saturated == [False, False, False, True]
    one = Settings(0.5, 10.0, 0.5, 0.25, 1, 4.0)
    assert image("qis_linear", one, recorded(ones=[0, 1])) == (close([0, math.log(2)]), [False, True])


@pytest.mark.parametrize("name", METHODS)
def test_no_pixels_and_no_detections(name: str) -> None:
    assert image(name, PAPER, recorded()) == ([], [])
    dark = recorded(counts=[0] * 5, span=[0.0] * 5, ones=[0] * 5, waited=[1e-3] * 5)
    assert image(name, PAPER, dark) == ([0.0] * 5, [False] * 5)


# ---- against the literal ones -----------------------------------------------------------------------------


@st.composite
def rows(draw: st.DrawFn) -> tuple[Settings, list[list[int]], list[list[int]]]:
    """Settings, TR stamps and STR stamps (ticks, `none` for no detection) of some pixels."""
    tick = draw(st.sampled_from([1e-11, 1e-9, 0.25]))
    frames = draw(st.sampled_from([1, 3, 8, 100]))
    none = draw(st.sampled_from([2, 7, 1000]))
    frame_time = none * tick
    exposure = frames * frame_time
    dead_time = draw(st.sampled_from([0.0, 0.3, 2.0, 2.5, exposure / tick / 3])) * tick
    pdp = draw(st.sampled_from([0.5, 1.0, 0.2]))
    pixels = draw(st.integers(1, 5))
    tr, stamps = [], []
    for _ in range(pixels):
        gaps = draw(st.lists(st.integers(0, 4 * none), max_size=12))
        running = np.cumsum(gaps) + draw(st.integers(0, 5)) if gaps else np.zeros(0, int)
        tr.append([int(t) for t in running if t <= frames * none])
        waits = st.sampled_from([0, 0, 1, none - 1, none, none])
        stamps.append(draw(st.one_of(st.just([0] * frames), st.lists(waits, min_size=frames, max_size=frames))))
    return Settings(pdp, exposure, dead_time, tick, frames, frame_time), tr, stamps


@settings(max_examples=250, deadline=None, derandomize=True)
@given(rows())
def test_the_literal_reconstructions(case: tuple[Settings, list[list[int]], list[list[int]]]) -> None:
    one, tr, stamps = case
    none = round(one.frame_time / one.tick)
    offsets = np.concatenate([[0], np.cumsum([len(t) for t in tr])]).astype(np.int64)
    ticks = np.array([t for row in tr for t in row], np.uint32)
    events = Events(None, offsets, 1, ticks, one.tick)
    bits = [[int(t < none) for t in row] for row in stamps]
    ones = [sum(row) for row in bits]
    waited = [sum(t for t in row if t < none) * one.tick + row.count(none) * one.frame_time for row in stamps]
    span = [(row[-1] - row[0]) * one.tick if len(row) > 1 else 0.0 for row in tr]
    data = recorded(events.counts.tolist(), span, ones, waited)
    q, dead = one.pdp, one.dead_time
    seconds = [[t * one.tick for t in row] for row in tr]
    waits = [[t * one.tick if t < none else one.frame_time for t in row] for row in stamps]
    numbers = [len(row) for row in tr]
    full = [dead > 0 and n * dead > one.exposure * (1 - 1e-12) for n in numbers]
    expected: dict[str, tuple[list[float], list[bool]]] = {
        "counts": ([algorithm1.counts(n, q, one.exposure) for n in numbers], [False] * len(tr)),
        "inter_photon": (
            [algorithm1.inter_photon(row, q, dead, one.tick) for row in seconds],
            [algorithm1.inter_photon_is_bounded(row, dead, one.tick) for row in seconds],
        ),
        "str_flux": (
            [algorithm1.str_flux(row, q, one.frame_time, one.tick) for row in waits],
            [sum(row) == 0 for row in waits],
        ),
        "qis_counts": ([float(algorithm1.qis_counts(row)) for row in bits], [False] * len(tr)),
        "qis_linear": (
            [algorithm1.qis_linear(row) for row in bits],
            [sum(row) == one.frames for row in bits],
        ),
    }
    if not any(abs(n * dead - one.exposure) < 1e-9 * one.exposure for n in numbers):  # see above
        expected["passive_free_running"] = (
            [algorithm1.stored_passive_free_running(n, q, one.exposure, dead) for n in numbers],
            full,
        )
    for name, (values, saturated) in expected.items():
        got, where = image(name, one, data)
        assert got == close(values), name
        if name != "inter_photon":
            assert where == saturated, name
        else:  # at the bound itself, rounding decides; the value is the same
            for i, row in enumerate(seconds):
                least = (len(row) - 1) * one.tick / 2
                live = row[-1] - row[0] - (len(row) - 1) * dead if row else 0.0
                assert where[i] == saturated[i] or math.isclose(live, least, rel_tol=1e-6), name


def test_large_batches_are_worked_out_in_pieces() -> None:
    """The same numbers whatever lies beside them."""
    rng = np.random.default_rng(3)
    n = 100_000
    counts = rng.poisson(0.7, n)
    span = np.where(counts > 1, rng.random(n) * 1e-3, 0.0)
    ones = np.minimum(rng.poisson(3, n), 100)
    waited = np.where(ones > 0, rng.random(n) * 1e-3, 1e-3)
    big = recorded(counts.tolist(), span.tolist(), ones.tolist(), waited.tolist())
    for name in METHODS:
        whole, saturated = reconstruct.find(name).image(big, PAPER)
        for a, b in ((0, 1), (32_767, 32_769), (99_990, n)):
            part, _ = reconstruct.find(name).image(big.images(a, b), PAPER)
            assert part.tobytes() == whole[a:b].tobytes()
        pieces = [reconstruct.find(name).image(big.images(a, a + 10_000), PAPER) for a in range(0, n, 10_000)]
        assert sum(number for _, number in pieces) == saturated


def test_no_more_is_worked_out_than_there_are_numbers() -> None:
    """Few pixels with many detections each: no table up to the largest count; and the same as in a table."""
    asked: list[int] = []

    class Watched(type(reconstruct.find("counts")), abstract=True):  # type: ignore[misc]
        def estimate(self, settings: Settings, counts: np.ndarray) -> np.ndarray:
            asked.append(counts.size)
            return np.asarray(super().estimate(settings, counts))

    long = Settings(pdp=0.5, exposure=3.6e4, dead_time=50e-9, tick=1e-12, frames=50_000, frame_time=0.72)
    counts = [0, 5, 10**6, 10**5]
    values, _ = Watched().image(recorded(counts=counts), long)
    assert values.tolist() == close([n / 1.8e4 for n in counts]) and max(asked) <= 4
    small = list(range(40_000))
    for name in ("counts", "passive_free_running", "qis_counts", "qis_linear"):
        method = reconstruct.find(name)
        apart = np.concatenate([method.image(recorded(small[i : i + 20_000], ones=small[i : i + 20_000]), long)[0]
                                for i in (0, 20_000)])  # fmt: skip
        assert np.array_equal(apart, method.image(recorded(small, ones=small), long)[0]), name


# ---- a user's method is guarded ----------------------------------------------------------------------------


class Mine(Method, abstract=True):
    """A method that is no one's."""

    name = "mine"
    columns = ("counts",)


def mine(estimate: Any, **more: Any) -> Method:
    """A user's method whose `estimate` is a function of the columns."""
    body = {"estimate": lambda self, settings, *columns: estimate(*columns), **more}
    return type("Mine", (Mine,), body, abstract=True)()  # type: ignore[call-overload, no-any-return]


TWO = ("counts", "span")
LARGE = [40_000, 5, 7]  # no table is made up to so many
WRONG: list[tuple[Any, str]] = [
    (lambda counts: counts[:2] * 1.0, r"float64 of shape \(2,\)"),
    (lambda counts: np.append(counts, 1.0), r"not float64 of shape \(\d+,\)"),
    (lambda counts: counts[:, None] * 1.0, r"not float64 of shape \(\d+, 1\)"),
    (lambda counts: counts.mean(), r"not float64$"),
    (lambda counts: None, "not NoneType"),
    (lambda counts: counts.tolist(), "not list"),
    (lambda counts: counts > 2, r"not bool of shape"),
    (lambda counts: counts * 1j, "not complex128 of shape"),
    (lambda counts: np.ma.masked_less(counts * 1.0, 1), "a masked array"),
]


@pytest.mark.parametrize(("estimate", "says"), WRONG)
@pytest.mark.parametrize("counts", [[0, 3, 200, 1], LARGE])
def test_what_estimate_returns_is_checked(estimate: Any, says: str, counts: list[int]) -> None:
    """Too few values were looked up beyond their end."""
    with pytest.raises(EffectError, match=f"test_reconstruct.py: the method mine: estimate .*{says}"):
        mine(estimate).image(recorded(counts), PAPER)


def test_whole_numbers_are_numbers() -> None:
    for counts in ([0, 3, 200, 1], LARGE):
        image, saturated = mine(lambda n: n * 2).image(recorded(counts), PAPER)
        assert image.dtype == np.float32 and image.tolist() == [2.0 * n for n in counts] and not saturated


def test_the_rules_of_saturated_pixels_are_checked() -> None:
    for counts in ([0, 3], LARGE):
        for answer in (0.5, -1, 10**6, None):
            method = mine(lambda n: n * 1.0, saturated=lambda *_, answer=answer: answer)
            with pytest.raises(EffectError, match=f"the method mine: saturated must say how many .*, not {answer}"):
                method.image(recorded(counts), PAPER)
        method = mine(lambda n: n + np.inf, stored_when_saturated=lambda *_: [1.0, 2.0])
        with pytest.raises(EffectError, match="the method mine: stored_when_saturated must return one number, not "):
            method.image(recorded(counts), PAPER)


def _doubled(counts: np.ndarray, *others: np.ndarray) -> np.ndarray:
    counts *= 2
    return counts.astype(float)


def _spoiled(counts: np.ndarray, span: np.ndarray) -> np.ndarray:
    span[:] = 0
    return counts.astype(float)


def test_what_a_method_is_given_stays() -> None:
    for counts, columns, estimate in (([0, 3], TWO, _doubled), ([0, 3], TWO, _spoiled), (LARGE, TWO[:1], _doubled)):
        data = recorded(counts, [1.5] * len(counts))
        with pytest.raises(EffectError, match=r"the method mine failed: .*it is given is not its own to change"):
            mine(estimate, columns=columns).image(data, PAPER)
        assert data.counts is not None and data.span is not None
        assert data.counts.tolist() == counts and set(data.span) == {1.5}
        data.counts[0] = 1  # and it can be written by others


def test_the_code_of_a_method_fails() -> None:
    for counts in ([0, 3], LARGE):
        with pytest.raises(
            EffectError, match=r"test_reconstruct.py:\d+: the method mine failed: Attrib.*no attribute 'rot'"
        ):
            mine(lambda counts: counts.rot()).image(recorded(counts), PAPER)
        with pytest.raises(EffectError, match="the method mine failed: ZeroDivisionError"):
            mine(lambda n: n * 1.0, saturated=lambda *_: 1 // 0).image(recorded(counts), PAPER)
    with pytest.raises(EffectError, match="the method mine failed: TypeError: mine must define estimate"):
        type("Mine", (Mine,), {}, abstract=True)().image(recorded([1]), PAPER)  # type: ignore[call-overload]


@pytest.mark.parametrize("answer", [np.inf, -np.inf, np.nan, 1e39])
def test_an_image_is_finite(answer: float) -> None:
    for counts, columns in (([0, 3, 7], TWO[:1]), ([0, 3, 7], TWO), (LARGE, TWO[:1])):
        method = mine(lambda n, *_: np.where(n == 7, answer, 1.0), columns=columns)
        place = "counts is 7( and span is 0.5)?; .*stored_when_saturated"
        with pytest.raises(
            EffectError, match=f"test_reconstruct.py: the method mine: its image is not finite.*{place}"
        ):
            method.image(recorded(counts, [0.5] * 3), PAPER)
        assert mine(lambda n, *_: np.where(n == 4, answer, 1.0), columns=columns).image(  # a number that does not occur
            recorded(counts, [0.5] * 3), PAPER
        )[0].tolist() == [1, 1, 1]
    rule = mine(lambda n: np.where(n == 7, np.inf, 1.0), stored_when_saturated=lambda *_: 2)
    assert rule.image(recorded([0, 3, 7]), PAPER)[0].tolist() == [1, 1, 2]


def test_a_method_that_goes_on_from_another_one() -> None:
    """Its own `estimate` counts, also where the other one works out image and saturated pixels at once."""

    class Halved(InterPhoton, abstract=True):
        """Half of it."""

        name = "halved"

        def estimate(self, settings: Settings, counts: np.ndarray, span: np.ndarray) -> np.ndarray:
            return super().estimate(settings, counts, span) / 2

    data = recorded(counts=[2, 3, 6, 2], span=[0.5, 0.75, 2.75, 0.625])
    values, saturated = InterPhoton().image(data, HAND)
    halves, also = Halved().image(data, HAND)
    assert np.array_equal(halves, values / 2) and saturated == also == 3


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        (("countz",), "'countz' is not a column; the columns are counts, span, ones, waited. Did you mean counts"),
        ("counts", r"columns is 'counts', not a tuple.*\('counts',\)"),
        ((), "not a tuple of names"),
        (None, "it has no columns.*the columns are counts, span, ones, waited"),
        ((1,), "1 is not a column"),
    ],
)
def test_the_columns_are_known(columns: Any, says: str) -> None:
    known = set(Method.registry.classes)
    with pytest.raises(TypeError, match=f"Nobodys: .*{says}"):
        type("Nobodys", (Method,), {} if columns is None else {"columns": columns})
    assert set(Method.registry.classes) == known


# ---- the training median ----------------------------------------------------------------------------------


def _cut(values: np.ndarray, cuts: Sequence[int]) -> list[np.ndarray]:
    return np.split(values, sorted(c % (len(values) + 1) for c in cuts))


def _expected_median(values: np.ndarray) -> float | None:
    """numpy's, of the float32 values in double precision."""
    kept = values[values != 0].astype(np.float64)
    return float(np.median(kept)) if len(kept) else None


floats = st.one_of(
    st.just(0.0),
    st.sampled_from([1.0, 2.0, 1.0 + 2.0**-23, 2.0**127, 2.0**-149, 2.0**-126 - 2.0**-149, 65536.0]),
    st.floats(0, 2.0**127, width=32),
)


@settings(max_examples=250, deadline=None, derandomize=True)
@given(
    hnp.arrays(np.float32, st.integers(0, 40), elements=floats),
    st.lists(st.integers(0, 1000), max_size=4),
)
def test_median_of_nonzero(values: np.ndarray, cuts: list[int]) -> None:
    """Odd and even numbers, ties, denormals, nothing but zeros; in any chunks, of any shape."""
    parts = [np.abs(p) for p in _cut(values, cuts)]
    values = np.abs(values)
    assert median_of_nonzero(lambda: iter(parts)) == _expected_median(values)
    if len(values) % 2 == 0:
        assert median_of_nonzero(lambda: [values.reshape(2, -1)]) == _expected_median(values)


@pytest.mark.parametrize("n", [1, 2, 3, 1000, 1001, 70_000])
def test_median_of_nonzero_of_many(n: int) -> None:
    rng = np.random.default_rng(n)
    for values in (
        rng.lognormal(10, 2, n).astype(np.float32),
        rng.poisson(1.5, n).astype(np.float32) / np.float32(0.0005),
        (rng.random(n) < 0.3).astype(np.float32),
        np.float32(1) + rng.random(n).astype(np.float32) * np.float32(2**-16),  # one upper half, many lower
    ):
        for chunk in (1 << 14, 777):
            chunks = [values[i : i + chunk] for i in range(0, n, chunk)]
            assert median_of_nonzero(lambda chunks=chunks: iter(chunks)) == _expected_median(values)  # type: ignore[misc]


def test_medians_of_several_images_at_once() -> None:
    """Each name on its own, also where one has nothing but zeros."""
    rng = np.random.default_rng(4)
    values = {
        "bright": rng.lognormal(10, 2, 3001).astype(np.float32),
        "sparse": (rng.random(3001) < 0.01).astype(np.float32) * np.float32(7.5),
        "dark": np.zeros(3001, np.float32),
    }
    chunks = [{name: v[i : i + 500] for name, v in values.items()} for i in range(0, 3001, 500)]
    assert medians_of_nonzero(lambda: iter(chunks)) == {n: _expected_median(v) for n, v in values.items()}


@pytest.mark.parametrize(("kept", "times"), [(2500, 1), (2499, 2), (0, 2)])
def test_values_are_read_twice_only_where_there_are_too_many(
    kept: int, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reconstruct, "_VALUES_KEPT", kept)
    values = np.random.default_rng(1).lognormal(10, 2, (5, 500)).astype(np.float32)
    read: list[int] = []

    def chunks() -> Iterator[np.ndarray]:
        for i, chunk in enumerate(values):
            read.append(i)
            yield np.append(chunk, np.float32(0))

    assert median_of_nonzero(chunks) == _expected_median(values.ravel())
    assert read == [0, 1, 2, 3, 4] * times


def test_median_of_nothing() -> None:
    assert median_of_nonzero(lambda: []) is None
    assert median_of_nonzero(lambda: [np.zeros(0, np.float32), np.zeros((3, 2), np.float32)]) is None
    assert median_of_nonzero(lambda: [np.array([0, 5, 0], np.float32)]) == 5.0
    assert median_of_nonzero(lambda: [np.array([0, 5], np.float32), np.array([[4]], np.float32)]) == 4.5


@settings(max_examples=250, deadline=None, derandomize=True)
@given(
    hnp.arrays(np.float32, st.integers(0, 40), elements=st.one_of(floats, st.floats(-(2.0**127), 2.0**127, width=32))),
    st.lists(st.integers(0, 1000), max_size=4),
)
def test_median_of_negative_values(values: np.ndarray, cuts: list[int]) -> None:
    """Also of both signs; -0 is zero."""
    for some in (values, -values, np.append(values, np.float32(-0.0))):
        assert median_of_nonzero(lambda some=some: iter(_cut(some, cuts))) == _expected_median(some)  # type: ignore[misc]


def test_median_of_many_negative_values() -> None:
    rng = np.random.default_rng(2)
    for values in (
        rng.normal(1, 5, 70_001).astype(np.float32),
        np.rint(rng.normal(-2, 3, 70_000)).astype(np.float32),
        -1 - rng.random(70_000).astype(np.float32) * np.float32(2**-16),  # one upper half, many lower
    ):
        assert median_of_nonzero(lambda values=values: [values[:777], values[777:]]) == _expected_median(values)  # type: ignore[misc]


def test_a_median_by_which_nothing_can_be_divided() -> None:
    method = mine(lambda n: n * 1.0)
    assert reconstruct.divisor(method, None) is None and reconstruct.divisor(method, 2.5) == 2.5
    for median in (0.0, -2.5):
        with pytest.raises(EffectError, match=f"the method mine: the median .* is {median:g}, .*normalised = False"):
            reconstruct.divisor(method, median)
