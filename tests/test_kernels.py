"""The kernels: their random numbers against the published generator, their loops against plain Python."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from fractions import Fraction

import laws
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from spadmnist import bit_planes, estimators, kernels, packing
from spadmnist.effects import Conditions, Effect
from spadmnist.effects.afterpulsing import Afterpulsing
from spadmnist.effects.dead_time import DeadTime
from spadmnist.effects.tdc import Tdc
from spadmnist.events import Layout
from spadmnist.sensor import Sensor
from spadmnist.streams import Streams, beginning

KEY = np.array([0xA4093822, 0x299F31D0, 0x03707344], np.uint64)


# ---- random numbers ---------------------------------------------------------------------------------------


def philox(counter: Sequence[int], key: Sequence[int]) -> list[int]:
    """Philox4x32-10 in plain integers, as Salmon, Moraes, Dror and Shaw (SC 2011) write it."""
    x, k = list(counter), list(key)
    for _ in range(10):
        low = [0xD2511F53 * x[0], 0xCD9E8D57 * x[2]]
        x = [
            (low[1] >> 32) ^ x[1] ^ k[0],
            low[1] & 0xFFFFFFFF,
            (low[0] >> 32) ^ x[3] ^ k[1],
            low[0] & 0xFFFFFFFF,
        ]
        k = [(k[0] + 0x9E3779B9) & 0xFFFFFFFF, (k[1] + 0xBB67AE85) & 0xFFFFFFFF]
    return x


def kernel_philox(counter: Sequence[int], key: Sequence[int]) -> list[int]:
    """The kernel's two words, taken apart into the four of the generator.

    Its counter is (block, image low, image high, stream word), least significant word first.
    """
    block, low, high, word = counter
    a, b = kernels._philox(
        np.uint64(block), np.uint64(low | high << 32), np.uint64(key[0]), np.uint64(key[1]), np.uint64(word)
    )
    return [int(a) >> 32, int(a) & 0xFFFFFFFF, int(b) >> 32, int(b) & 0xFFFFFFFF]


KNOWN = [  # Random123's kat_vectors, philox4x32-10
    ([0] * 4, [0] * 2, "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ([0xFFFFFFFF] * 4, [0xFFFFFFFF] * 2, "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    (
        [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
        [0xA4093822, 0x299F31D0],
        "d16cfe09 94fdcceb 5001e420 24126ea1",
    ),
]


@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN)
def test_philox_known_answers(counter: list[int], key: list[int], answer: str) -> None:
    words = [int(word, 16) for word in answer.split()]
    assert philox(counter, key) == words
    assert kernel_philox(counter, key) == words


word32 = st.integers(0, 2**32 - 1)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.tuples(word32, word32, word32, word32), st.tuples(word32, word32))
def test_philox_is_the_plain_one(counter: tuple[int, ...], key: tuple[int, ...]) -> None:
    assert kernel_philox(counter, key) == philox(counter, key)


def _ulps(ours: np.ndarray, x: np.ndarray) -> np.ndarray:
    """How far `ours` lies from the logarithm of the C library, in units of its last place."""
    library = np.array([math.log(value) for value in x.tolist()])
    return np.abs(ours - library) / np.spacing(np.maximum(np.abs(library), np.finfo(float).tiny))


def _near(value: float, steps: int) -> list[float]:
    """The doubles around one."""
    bits = int(np.float64(value).view(np.int64))
    return np.arange(bits - steps, bits + steps + 1).view(np.float64).tolist()


def test_logarithm_within_an_ulp() -> None:
    """The C library is itself within 1 ulp; both are never more than 1 apart."""
    rng = np.random.default_rng(1)
    x = np.concatenate(
        [
            1.0 - rng.random(1_000_000),  # (0, 1]
            np.exp(-700 * rng.random(50_000)),  # every size of an exponent
            1.0 - 2.0 ** (-53 * rng.random(50_000)),  # close to 1, where cancellation would show
            _near(1.0, 300),
            _near(math.sqrt(0.5), 300),  # where the mantissa is split
            _near(0.5, 300),
            _near(0.25 * math.sqrt(2), 300),
            [2.0**-53, 2.0**-1022, 2.0**52, 2.0**1023, math.e],
        ]
    )
    ours = kernels.logarithm(x)
    assert _ulps(ours, x).max() <= 1.0
    assert kernels.logarithm(np.array([1.0]))[0] == 0.0
    powers = np.arange(-1000, 1000, 7)
    two = kernels.logarithm(np.ldexp(1.0, powers))
    assert np.all(np.abs(two - powers * math.log(2)) <= np.spacing(np.maximum(np.abs(two), 1e-300)))


def test_logarithm_is_monotone_where_it_matters() -> None:
    x = np.unique(np.concatenate([_near(1.0, 2000)[:2001], _near(math.sqrt(0.5), 2000)]))
    assert np.all(np.diff(kernels.logarithm(x)) >= 0)


def test_exponential_of_a_word() -> None:
    """-log of an odd multiple of 2^-53, from the word's upper 52 bits: never 0, never infinite."""
    for word in (0, 1, 2**12 - 1, 2**12, 2**63, 2**63 - 1, 2**64 - 1, 0x0123456789ABCDEF):
        u = Fraction(2 * (word >> 12) + 1, 2**53)
        got = kernels._exponential(np.uint64(word))
        # 1 - u may be all there is of it: take the logarithm where it is exact
        exact = -math.log1p(float(u - 1)) if u > Fraction(1, 2) else -math.log(float(u))
        assert got == pytest.approx(exact, rel=3e-16)
    assert kernels._exponential(np.uint64(0)) == pytest.approx(53 * math.log(2))
    assert kernels._exponential(np.uint64(2**64 - 1)) == pytest.approx(2.0**-53, rel=1e-9)


def test_the_order_of_a_stream() -> None:
    """Batch after batch: the first words of its blocks, then the second ones."""
    half = kernels.BATCH // 2
    drawn = kernels.exponentials(2 * kernels.BATCH + 5, np.uint64(2**40 + 3), KEY)
    for i in (0, 1, half - 1, half, 2 * half - 1, 2 * half, 3 * half + 2, 4 * half, 4 * half + 4):
        batch, place = divmod(i, kernels.BATCH)
        words = philox(
            [batch * half + place % half, 3, 2**8, int(KEY[2])],
            [int(KEY[0]), int(KEY[1])],
        )
        high, low = words[2 * (place // half)], words[2 * (place // half) + 1]
        assert drawn[i] == kernels._exponential(np.uint64(high << 32 | low))
    assert np.array_equal(drawn[:100], kernels.exponentials(100, np.uint64(2**40 + 3), KEY))


def test_exponentials_follow_their_law() -> None:
    x = kernels.exponentials(2_000_000, np.uint64(5), KEY)
    assert np.all(np.isfinite(x)) and np.all(x > 0)
    laws.distribution_is(x, lambda t: -np.expm1(-t))
    laws.mean_is(x, 1.0)
    laws.variance_is(x, 1.0)
    laws.mean_is(x < 1e-3, -math.expm1(-1e-3), what="share of short ones")
    laws.mean_is(x > 8, math.exp(-8), what="share of long ones")


def _uncorrelated(a: np.ndarray, b: np.ndarray, what: str) -> None:
    """Two samples of independent standard exponentials: the mean product of (x - 1) is 0."""
    assert not np.array_equal(a, b)
    laws.mean_is((a - 1) * (b - 1), 0.0, alpha=laws.FALSE_ALARM / 30, what=what)
    # and of what hides behind a correlation of 0
    laws.mean_is((a < 0.1) & (b < 0.1), math.expm1(-0.1) ** 2, alpha=laws.FALSE_ALARM / 30, what=what)


def test_streams_are_independent() -> None:
    """Neighbouring images, keys that differ in one bit, words, and draws within one stream."""
    n = 300_000
    x = kernels.exponentials(n, np.uint64(8), KEY)
    for other in (9, 8 + 2**32, 0):
        _uncorrelated(x, kernels.exponentials(n, np.uint64(other), KEY), f"images 8 and {other}")
    for place in range(3):
        key = KEY.copy()
        key[place] ^= np.uint64(1)
        _uncorrelated(x, kernels.exponentials(n, np.uint64(8), key), f"word {place} of the key")
    half, batch = kernels.BATCH // 2, kernels.BATCH
    for lag in (1, 2, half, batch - 1, batch, batch + 1):
        _uncorrelated(x[lag:], x[:-lag], f"lag {lag}")
    first = np.array([kernels.exponentials(1, np.uint64(i), KEY)[0] for i in range(20_000)])
    laws.distribution_is(first, lambda t: -np.expm1(-t), what="first draws of 20,000 images")
    laws.mean_is((first[1:] - 1) * (first[:-1] - 1), 0.0, what="first draws of neighbouring images")


def test_streams_are_named_by_what_they_are_for() -> None:
    numbers = np.arange(3, dtype=np.uint64)
    one = Streams(1, "lux/0x1p+0", "train", numbers)
    assert np.array_equal(one.key("a"), Streams(1, "lux/0x1p+0", "train", numbers[:1]).key("a"))
    keys = [
        one.key("a"),
        one.key("b"),
        Streams(2, "lux/0x1p+0", "train", numbers).key("a"),
        Streams(1, "lux/0x1p+1", "train", numbers).key("a"),
        Streams(1, "lux/0x1p+0", "test", numbers).key("a"),
    ]
    assert len({tuple(key.tolist()) for key in keys}) == len(keys)
    assert all(key.shape == (3,) and key.dtype == np.uint64 and key.max() < 2**32 for key in keys)
    blocks = [Streams(1, "x", "train", np.arange(a, a + 32, dtype=np.uint64)) for a in (0, 32)]
    draws = [block.generator("a").random(5000) for block in blocks]
    assert np.array_equal(draws[0], blocks[0].generator("a").random(5000))
    laws.mean_is((draws[0] - 0.5) * (draws[1] - 0.5), 0.0)


def test_uniforms() -> None:
    image_offsets = np.array([0, 3, 200_000], np.int64)
    images = np.array([4, 5], np.uint64)
    u = kernels.uniforms(np.arange(200_000), image_offsets, images, KEY, 0)
    assert u.min() > 0 and u.max() < 1
    laws.distribution_is(u, lambda t: t)
    assert len(kernels.uniforms(np.zeros(0, np.int64), np.zeros(2, np.int64), images[:1], KEY, 0)) == 0
    second = kernels.uniforms(np.arange(199_997), np.array([0, 199_997]), images[1:], KEY, 0)
    assert np.array_equal(u[3:], second)  # an image alone
    some = np.array([1, 2, 3, 77, 4000])
    assert np.array_equal(kernels.uniforms(some, image_offsets, images, KEY, 0), u[some])  # an event alone


def test_thinned_draws_the_same_for_an_image_alone() -> None:
    rng = np.random.default_rng(8)
    offsets = np.concatenate([[0], np.cumsum(rng.integers(0, 60, 8))])
    rates = rng.uniform(0, 2.0, offsets[-1])
    drawn = np.full(8, 2.0)
    images = np.array([9, 11], np.uint64)
    both = kernels.thinned(rates, offsets, drawn, offsets[::4], images, KEY, 0)
    cut = offsets[4]
    alone = kernels.thinned(rates[cut:], offsets[4:] - cut, drawn[4:], offsets[4::4] - cut, images[1:], KEY, 0)
    assert np.array_equal(both[cut:], alone)
    many = kernels.thinned(
        np.full(100_000, 0.3), np.array([0, 100_000]), np.ones(1), np.array([0, 100_000]), images[:1], KEY, 0
    )
    laws.share_is(int(many.sum()), 100_000, 0.3)


# ---- ragged rows ------------------------------------------------------------------------------------------


@st.composite
def ragged(
    draw: st.DrawFn, most_rows: int = 8, most_events: int = 12, end: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """(times, offsets): sorted rows, some of them empty, some with equal times."""
    rows = draw(st.integers(1, most_rows))
    grid = draw(st.sampled_from([0, 4, 32]))
    values = (
        st.floats(0, end, exclude_max=True, allow_subnormal=False)
        if grid == 0
        else st.integers(0, grid - 1).map(lambda i: i * end / grid)
    )
    columns = [sorted(draw(st.lists(values, max_size=most_events))) for _ in range(rows)]
    offsets = np.concatenate([[0], np.cumsum([len(c) for c in columns])]).astype(np.int64)
    return np.array([t for c in columns for t in c], np.float64), offsets


def rows_of(times: np.ndarray, offsets: np.ndarray) -> list[list]:
    return [times[a:b].tolist() for a, b in itertools.pairwise(offsets)]


@settings(max_examples=120, deadline=None, derandomize=True)
@given(ragged(), st.data())
def test_merge(data: tuple[np.ndarray, np.ndarray], draw: st.DataObject) -> None:
    times, offsets = data
    rows = len(offsets) - 1
    extra_rows = np.array(sorted(draw.draw(st.lists(st.integers(0, rows - 1), max_size=15))), np.int64)
    extra = np.array([draw.draw(st.sampled_from([0.0, 0.25, 0.5, 0.7, 0.99])) for _ in extra_rows], float)
    extra = extra[np.lexsort((extra, extra_rows))]
    merged, new_offsets, ahead = kernels.merge(times, offsets, extra, extra_rows)
    before = rows_of(times, offsets)
    assert rows_of(merged, new_offsets) == [
        sorted(before[row] + extra[extra_rows == row].tolist()) for row in range(rows)
    ]
    origin = np.insert(np.arange(len(times)), ahead, len(times) + np.arange(len(extra)))
    assert np.array_equal(np.flatnonzero(origin >= len(times)), ahead + np.arange(len(extra)))
    assert np.array_equal(np.concatenate([times, extra])[origin], merged)
    same = (np.diff(merged) == 0) & (np.diff(np.repeat(np.arange(rows), np.diff(new_offsets))) == 0)
    assert np.all(origin[1:][same] > origin[:-1][same])  # of equally late ones the further events come behind
    # the parents, told by who they were, are found where they are now
    order = np.array(draw.draw(st.permutations(range(len(extra)))), np.int64)
    total = len(times) + len(extra)
    parents = np.array([draw.draw(st.integers(0, total - 1)) for _ in extra], np.int64)
    linked = kernels.relinked(len(times), ahead, order, parents)
    who = np.where(origin < len(times), origin, 0)
    who[origin >= len(times)] = len(times) + order[origin[origin >= len(times)] - len(times)]
    for k, one in enumerate(who.tolist()):
        assert linked[k] == -1 if one < len(times) else who[linked[k]] == parents[one - len(times)]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 300), st.integers(1, 9), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_the_order_of_rows_and_times(count: int, rows: int, moments: int, seed: int) -> None:
    """That of numpy, equal ones in the order in which they come; of rows with few events and with many."""
    rng = np.random.default_rng(seed)
    row, time = rng.integers(0, rows, count), rng.integers(0, moments, count) / 8
    order, offsets = kernels.row_order(time, row, rows)
    assert order.tolist() == np.lexsort((time, row)).tolist()
    assert np.diff(offsets).tolist() == np.bincount(row, minlength=rows).tolist() and offsets[0] == 0


@settings(max_examples=120, deadline=None, derandomize=True)
@given(ragged(), st.data())
def test_sort_rows_and_kept_offsets(data: tuple[np.ndarray, np.ndarray], draw: st.DataObject) -> None:
    times, offsets = data
    moved = np.array([t + draw.draw(st.sampled_from([-0.3, 0.0, 0.2, 2.0])) for t in times.tolist()])
    order = np.empty(len(times), np.int64)
    out = kernels.sort_rows(moved, offsets, 0.9, order)
    assert rows_of(out, offsets) == [sorted(np.clip(row, 0, 0.9).tolist()) for row in rows_of(moved, offsets)]
    assert np.array_equal(np.clip(moved, 0, 0.9)[order], out)
    assert all(
        sorted(row) == list(range(a, b))
        for row, (a, b) in zip(rows_of(order, offsets), itertools.pairwise(offsets), strict=True)
    )
    assert np.array_equal(kernels.sort_rows(moved, offsets, 0.9, np.empty(0, np.int64)), out)
    mask = np.array([draw.draw(st.booleans()) for _ in times], bool)
    kept = kernels.kept_offsets(mask, offsets)
    assert np.diff(kept).tolist() == [int(mask[a:b].sum()) for a, b in itertools.pairwise(offsets)]


@settings(max_examples=120, deadline=None, derandomize=True)
@given(ragged(), st.lists(st.sampled_from([0.0, 0.03125, 0.1, 0.25, 3.0]), min_size=8, max_size=8))
def test_non_paralyzable_and_take(data: tuple[np.ndarray, np.ndarray], dead: list[float]) -> None:
    """Against the loop of the oracle's kind; `pixels` rows share the dead times, image after image."""
    times, offsets = data
    rows = len(offsets) - 1
    pixels = next(p for p in (4, 3, 2, 1) if rows % p == 0)
    dead_times = np.array(dead[:pixels])
    kept = kernels.non_paralyzable(times, offsets, dead_times)
    expected = []
    for row, events in enumerate(rows_of(times, offsets)):
        last, recorded = -math.inf, []
        for event in events:
            if event - last > dead_times[row % pixels]:
                recorded.append(event)
                last = event
        expected.append(recorded)
    assert rows_of(times[kept], kernels.take(offsets, kept)) == expected


@settings(max_examples=120, deadline=None, derandomize=True)
@given(ragged(), st.sampled_from([np.uint32, np.uint64, np.uint16]))
def test_row_differences_and_back(data: tuple[np.ndarray, np.ndarray], kind: type) -> None:
    times, offsets = data
    values = (times * np.iinfo(kind).max).astype(kind)
    differences = packing.row_differences(values, offsets)
    assert differences.dtype == kind
    for row, plain in zip(rows_of(differences, offsets), rows_of(values, offsets), strict=True):
        assert row == plain[:1] + [b - a for a, b in itertools.pairwise(plain)]
    back = packing.row_sums(differences, offsets)
    assert back.dtype == kind and np.array_equal(back, values)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(ragged(), st.sampled_from([np.uint32, np.uint64]))
def test_row_totals_are_exact(data: tuple[np.ndarray, np.ndarray], kind: type) -> None:
    """Far above 2^32, where the entries' own type would overflow."""
    times, offsets = data
    values = (times * 2**32).astype(kind)
    totals = kernels.row_totals(values, offsets)
    assert totals.tolist() == [float(sum(row)) for row in rows_of(values, offsets)]


@settings(max_examples=100, deadline=None, derandomize=True)
@given(ragged())
def test_spans(data: tuple[np.ndarray, np.ndarray]) -> None:
    times, offsets = data
    counts, span = estimators.spans(times, offsets)
    plain = rows_of(times, offsets)
    assert counts.dtype == np.int32 and counts.tolist() == [len(row) for row in plain]
    assert span.tolist() == [row[-1] - row[0] if len(row) > 1 else 0.0 for row in plain]


@settings(max_examples=250, deadline=None, derandomize=True)
@given(ragged(most_events=20), st.sampled_from([1, 2, 7, 8, 9, 63, 64, 65, 130]), st.sampled_from([1.0, 0.5]))
def test_frame_readout(data: tuple[np.ndarray, np.ndarray], frames: int, live: float) -> None:
    """Frames [f P, f P + T_f): bits, and the first moment of each; between frames there is nothing."""
    times, offsets = data
    period = 2.0**-8  # exact in binary, so that plain Python need not round
    times = times * frames * period
    out = np.empty(len(times) + 1)
    bits, first_offsets = kernels.frame_readout(times, offsets, frames, live * period, period, out)
    assert bits.shape == (len(offsets) - 1, (frames + 7) // 8)
    unpacked = np.unpackbits(bits, axis=1)
    assert not unpacked[:, frames:].any()  # the padding
    for row, events in enumerate(rows_of(times, offsets)):
        inside: dict[int, float] = {}
        for event in events:
            frame = int(event // period)
            if event - frame * period < live * period:
                inside.setdefault(frame, event - frame * period)
        assert np.flatnonzero(unpacked[row]).tolist() == sorted(inside)
        assert out[first_offsets[row] : first_offsets[row + 1]].tolist() == [inside[f] for f in sorted(inside)]


def test_no_moment_falls_between_two_frames_without_a_gap() -> None:
    """Each moment is in one frame and below its length, also where frames x 10 us is no exact double."""
    for frame_time in (10e-6, 1e-6, 3e-7, 1.0):
        for f in range(1, 101):
            moments = [np.nextafter(f * frame_time, 0.0)]
            for _ in range(3):
                moments.append(np.nextafter(moments[-1], 0.0))
            moments = sorted(m for m in moments if m < 100 * frame_time)
            offsets = np.arange(len(moments) + 1)
            out = np.empty(len(moments) + 1)
            bits, stamps = kernels.frame_readout(np.array(moments), offsets, 100, frame_time, frame_time, out)
            # the last moment of all may round up to a frame that does not exist
            assert stamps[-1] == len(moments) or f == 100
            assert np.all(out[: stamps[-1]] < frame_time)
            assert np.all(np.unpackbits(bits, axis=1).sum(axis=1) <= 1)


@settings(max_examples=120, deadline=None, derandomize=True)
@given(hnp.arrays(np.float64, st.integers(0, 30), elements=st.floats(0, 2.0**51)))
def test_nearest_ticks(x: np.ndarray) -> None:
    out = np.empty(len(x), np.uint64)
    kernels.nearest_ticks(x, 1.0, out)
    assert out.tolist() == [round(value) for value in x.tolist()]


@settings(max_examples=300, deadline=None, derandomize=True)
@given(ragged(most_rows=4, most_events=9), st.data())
def test_avalanches_against_a_plain_loop(data: tuple[np.ndarray, np.ndarray], draw: st.DataObject) -> None:
    """One pass over all rows in the order of time says the same as the pass that goes row by row."""
    times, offsets = data
    rows = len(offsets) - 1
    row_of = np.repeat(np.arange(rows), np.diff(offsets))
    n = len(times)
    # in the order of time; what is equally late in its row's order, for a parent stands before its child
    order = sorted(range(n), key=lambda i: (times[i], i))
    parents = np.full(n, -1, np.int64)
    for k, i in enumerate(order):
        # across rows a cause is truly earlier; generations, which order equals, are not part of this test
        earlier = [j for j in order[:k] if times[j] < times[i] or row_of[j] == row_of[i]]
        if earlier and draw.draw(st.integers(0, 2)):
            parents[i] = draw.draw(st.sampled_from(earlier))
    dead = np.array(draw.draw(st.lists(st.sampled_from([0.0, 1 / 64, 0.1, 0.4]), min_size=rows, max_size=rows)))
    period = draw.draw(st.sampled_from([0.0, 1 / 8, 1 / 4]))
    live = period * draw.draw(st.sampled_from([1.0, 0.5]))
    extends = draw.draw(st.booleans())
    carried = draw.draw(st.sampled_from([0.0, 0.5, 1.0]))
    needed = np.array([draw.draw(st.sampled_from([0.0, 0.05, 0.3])) for _ in range(n)])
    fired = np.zeros(n, bool)
    asleep = np.array(
        [draw.draw(st.booleans()) for _ in range(n)] if not period and draw.draw(st.booleans()) else [], bool
    )
    since = dict.fromkeys(range(rows), -math.inf)  # TR: when the blindness began; frames: the last frame that fired
    awake = dict.fromkeys(range(rows), -math.inf)
    for i in order:
        if (len(asleep) and asleep[i]) or (parents[i] >= 0 and not fired[parents[i]]):
            continue
        time, row = float(times[i]), int(row_of[i])
        if period:
            frame = time // period
            fired[i] = time - frame * period < live and frame != since[row] and time >= awake[row]
            if fired[i]:
                since[row] = frame
                start = (frame + 1) * period
                awake[row] = start + carried * max(0.0, time + dead[row] - start) if carried else -math.inf
        elif time - since[row] <= dead[row]:
            since[row] = time if extends else since[row]
        elif time - since[row] - dead[row] >= needed[i]:
            fired[i] = True
            since[row] = time
    got = kernels.avalanches(times, offsets, parents, dead, needed, extends, period, live, carried, asleep)
    assert got.tolist() == fired.tolist()
    if not np.any(parents >= 0) and not needed.any():
        rest = extends, period, live, carried, asleep
        none = kernels.avalanches(times, offsets, parents[:0], dead, needed[:0], *rest)
        assert none.tolist() == fired.tolist()


def test_a_chain_of_causes_may_run_through_all_rows() -> None:
    """Each row waits for the next one's last event: 500 rows deep, and the other way round."""
    rows = 500
    for step in (1, -1):
        times = np.concatenate([[0.1, 0.9 - step * 1e-3 * row] for row in range(rows)]).astype(float)
        offsets = np.arange(0, 2 * rows + 1, 2)
        parents = np.full(2 * rows, -1, np.int64)
        for row in range(rows):
            if 0 <= row + step < rows:
                parents[2 * row + 1] = 2 * (row + step) + 1
        fired = kernels.avalanches(
            times, offsets, parents, np.zeros(rows), np.zeros(0), False, 0.0, 1.0, 0.0, np.zeros(0, bool)
        )
        assert fired.all()
        parents[1 if step == -1 else 2 * rows - 1] = -1


# ---- arrivals and children --------------------------------------------------------------------------------


def plain_arrivals(rates: np.ndarray, exposure: float, image: int, key: np.ndarray) -> list[list[float]]:
    """One unit-rate Poisson process runs along the image; each pixel is rate x exposure long.

    Within a batch of draws an event's place is the difference of running sums, which are summed by fours.
    """
    lengths = (rates * exposure).tolist()
    draws = kernels.exponentials(int(2 * sum(lengths)) + 10 * kernels.BATCH, np.uint64(image), key).tolist()
    batches = []
    for start in range(0, len(draws), kernels.BATCH):
        sums = [0.0]
        for i in range(start, min(start + kernels.BATCH, len(draws)) - 3, 4):
            a, b, c, d = draws[i : i + 4]
            sums += [sums[-1] + part for part in (a, a + b, (a + b) + c, (a + b) + (c + d))]
        batches.append(sums[1:])
    batch, draw, position, walked = 0, 0, batches[0][0], 0.0
    out = []
    for rate, length in zip(rates.tolist(), lengths, strict=True):
        row = []
        while position < length:
            shift = position - batches[batch][draw]
            last = draw + 1
            while last < kernels.BATCH and batches[batch][last] + shift < length:
                last += 1
            places = [s + shift for s in batches[batch][draw:last]]
            row += [min(place * (1 / rate), math.nextafter(exposure, 0.0)) for place in places]
            position, draw = places[-1], last
            if draw < kernels.BATCH:
                position = batches[batch][draw] + shift
                break
            batch, draw = batch + 1, 0
            position += batches[batch][0]
        # the plain sum of the draws, but for rounding
        assert walked + position == pytest.approx(sum(draws[: batch * kernels.BATCH + draw + 1]), rel=1e-11)
        position -= length
        walked += length
        out.append(row)
    return out


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    hnp.arrays(
        np.float64,
        st.tuples(st.integers(1, 3), st.integers(1, 6)),
        elements=st.sampled_from([0.0, 1e-300, 0.5, 3.0, 127.0, 128.0, 129.0, 700.0]),
    ),
    st.sampled_from([1.0, 1e-3]),
)
def test_arrivals_are_one_process_along_the_image(rates: np.ndarray, exposure: float) -> None:
    rates = rates / exposure
    images = np.arange(7, 7 + len(rates), dtype=np.uint64)
    times, offsets = kernels.arrivals(rates, exposure, images, KEY, beginning(len(images)))
    plain = [row for i, image in enumerate(images.tolist()) for row in plain_arrivals(rates[i], exposure, image, KEY)]
    assert rows_of(times, offsets) == plain
    assert np.all(times < exposure)


def test_arrivals_that_do_not_fit_are_drawn_again() -> None:
    """A kernel that is short of room starts afresh and gives the same events."""
    rates = np.array([[0.0, 500.0, 40.0, 0.0, 3000.0]])
    times, offsets = kernels.arrivals(rates, 1.0, np.array([3], np.uint64), KEY, beginning(1))
    buffer, places, distances = np.empty(kernels.BATCH + 1), np.empty(3, np.uint64), np.empty(2)
    for size in (kernels.BATCH + 2, 500, 3700, len(times) + 2 * kernels.BATCH + 2):
        kernels._begin_image(np.uint64(3), KEY, KEY, buffer, places, distances)
        room, bounds = np.empty(size), np.empty(6, np.int64)
        none, empty = np.zeros(5), np.empty(1)
        parents = np.empty(1, np.int64)
        total = kernels._candidates(
            rates[0],
            1.0,
            np.uint64(3),
            KEY,
            none,
            0.0,
            none,
            KEY,
            room,
            bounds,
            buffer,
            places,
            distances,
            parents,
            empty,
        )
        if size < len(times):
            assert total == -1
        else:
            assert total == len(times)
            assert np.array_equal(room[:total], times) and np.array_equal(bounds, offsets)


def plain_children(counts: list[int], hazards: list[float], image: int, key: np.ndarray) -> list[tuple]:
    """(row, index in the row, delay): a unit-rate process along the events, afresh behind each hit."""

    def block(k: int) -> tuple[float, float]:
        words = kernels._philox(np.uint64(k), np.uint64(image), key[0], key[1], key[2])
        return kernels._exponential(np.uint64(words[0])), kernels._exponential(np.uint64(words[1]))

    k = 0
    left = block(k)[0]
    out = []
    for row, (count, hazard) in enumerate(zip(counts, hazards, strict=True)):
        for i in range(count):
            if left < hazard:
                out.append((row, i, block(k)[1]))
                k += 1
                left = block(k)[0]
            elif hazard > 0:
                left -= hazard
    return out


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    st.lists(st.sampled_from([0, 0, 1, 2, 30, 300]), min_size=1, max_size=8),
    st.sampled_from([0.005, 0.3, 0.9, 1.0]),
)
def test_children_are_drawn_event_by_event(counts: list[int], probability: float) -> None:
    """The jumps from one parent to the next give what a draw at each event would (up to rounding)."""
    pixels = len(counts)
    hazard = -math.log1p(-probability) if probability < 1 else math.inf
    hazards = np.array([hazard if p % 3 != 2 else 0.0 for p in range(pixels)])
    offsets = np.concatenate([[0], np.cumsum(counts + counts)]).astype(np.int64)
    images = np.array([1, 2], np.uint64)
    parents, delays = kernels.children(offsets, hazards, images, KEY, beginning(2))
    expected = [
        (int(offsets[i * pixels + row]) + index, delay)
        for i, image in enumerate((1, 2))
        for row, index, delay in plain_children(counts, hazards.tolist(), image, KEY)
    ]
    assert parents.tolist() == [parent for parent, _ in expected]
    assert delays.tolist() == [delay for _, delay in expected]


def test_children_share_and_delays() -> None:
    """Each event has one with the probability, whatever its neighbours do; delays are exponential."""
    rng = np.random.default_rng(2)
    counts = rng.poisson(3.0, 200 * 50)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    probabilities = np.tile([0.005, 0.3, 0.9, 1.0, 0.0], 10)
    with np.errstate(divide="ignore"):
        hazards = -np.log1p(-probabilities)
    parents, delays = kernels.children(offsets, hazards, np.arange(200, dtype=np.uint64), KEY, beginning(200))
    assert np.all(np.diff(parents) > 0)  # at most one each, in order
    pixel = np.repeat(np.arange(len(counts)) % 50, counts)
    has = np.zeros(len(pixel), bool)
    has[parents] = True
    for p in (0.005, 0.3, 0.9, 1.0, 0.0):
        events = has[probabilities[pixel] == p]
        laws.share_is(int(events.sum()), len(events), p, what=f"share with probability {p}")
    together = has[1:] & has[:-1] & (probabilities[pixel[1:]] == 0.3) & (probabilities[pixel[:-1]] == 0.3)
    pairs = (probabilities[pixel[1:]] == 0.3) & (probabilities[pixel[:-1]] == 0.3)
    laws.mean_is(together[pairs], 0.09, what="neighbouring events that both have a child")
    laws.distribution_is(delays, lambda t: -np.expm1(-t), what="delays")


# ---- the fused line where its buffers are too small -------------------------------------------------------


@pytest.mark.parametrize("probability", [0.0, 0.005, 0.9, 1.0])
@pytest.mark.parametrize(
    "expected",
    [
        [0.0, 0.0, 0.0],
        [0.1, 40.0, 0.0, 900.0],
        [2000.0, 15000.0, 3000.0, 0.0, 15000.0, 1.0],  # over the edge of a tile
        [50_000.0],  # one pixel far beyond a tile
    ],
)
def test_paper_line_with_too_little_room(expected: list[float], probability: float) -> None:
    """Where everything has a child there are twice the events that room was made for."""
    exposure, lifetime, tick, frame_time = 1e-3, 3e-6, 1e-11, 1e-5
    rates = np.array([expected, expected[::-1]]) / exposure
    pixels = rates.shape[1]
    dead = np.linspace(0, 2e-6, pixels)
    effects: list[Effect] = [DeadTime(duration=dead), Tdc(resolution=tick)]
    if probability:
        effects.append(Afterpulsing(probability=probability, lifetime=lifetime))
    sensor = Sensor(Layout(1, pixels, 25e-12, 1.0), effects).resolved()
    assert sensor.is_paper_line
    streams = Streams(1, "lux", "train", np.array([5, 6], np.uint64))
    recorded = sensor.expose(
        rates, Conditions(exposure, 100, frame_time, frame_time, 555e-9), streams, ("tr", "str", "qis")
    )
    candidates: list[list[float]] = []
    with np.errstate(divide="ignore"):
        hazards = np.full(pixels, -np.log1p(-probability)).tolist()
    for i, image in enumerate((5, 6)):
        rows = plain_arrivals(rates[i], exposure, image, streams.key("photons and dark counts"))
        families = [list(row) for row in rows]
        counts = [len(row) for row in rows]
        for row, index, delay in plain_children(counts, hazards, image, streams.key("afterpulsing")):
            child = rows[row][index] + (dead[row] + lifetime * delay)
            if child < exposure:
                families[row].append(child)
        candidates += [sorted(family) for family in families]
    bounds = np.concatenate([[0], np.cumsum([len(c) for c in candidates])]).astype(np.int64)
    times = np.array([t for c in candidates for t in c], float)
    kept = kernels.non_paralyzable(times, bounds, dead)
    assert recorded.tr is not None and recorded.frames is not None and recorded.frames.first is not None
    assert np.array_equal(recorded.tr.offsets, kernels.take(bounds, kept))
    assert recorded.tr.ticks is not None and recorded.frames.first.ticks is not None
    assert recorded.tr.ticks.tolist() == [round(t / tick) for t in times[kept].tolist()]
    out = np.empty(len(times) + 1)
    bits, stamped = kernels.frame_readout(times, bounds, 100, frame_time, frame_time, out)
    assert np.array_equal(recorded.frames.bits, bits)
    assert np.array_equal(recorded.frames.first.offsets, stamped)
    stamps = [min(round(t / tick), 10**6 - 1) for t in out[: stamped[-1]].tolist()]
    assert recorded.frames.first.ticks.tolist() == stamps


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 40), st.integers(1, 50), st.floats(0.0, 1.0), st.integers(0, 2**32 - 1))
@example(300, 200, 0.5, 1)  # each byte there is
def test_stamps_in_frames(pixels: int, frames: int, share: float, seed: int) -> None:
    """Beside a literal one; with frames, and pixels, that fill no whole bytes."""
    rng = np.random.default_rng(seed)
    ones = rng.random((pixels, frames)) < share
    offsets = np.concatenate([[0], np.cumsum(ones.sum(axis=1))])
    for kind in (np.uint16, np.uint32):
        ticks = rng.integers(0, 1000, int(offsets[-1])).astype(kind)
        wanted = np.full((pixels, frames), 1000, np.uint32)
        wanted[ones] = ticks
        begins, stamps, whose = bit_planes.stamps_by_frame(np.packbits(ones, axis=1), offsets, ticks, frames)
        frame, pixel = np.nonzero(wanted.T < 1000)
        assert stamps.dtype == np.uint32 and stamps.tolist() == wanted.T[frame, pixel].tolist()
        assert whose.tolist() == pixel.tolist()
        assert np.diff(begins).tolist() == ones.sum(axis=0).tolist()
        again = bit_planes.stamps_of_frames(np.ascontiguousarray(wanted.T), 1000)
        assert all(np.array_equal(*both) for both in zip(again, (begins, stamps, whose), strict=True))
        filled = np.full((frames, pixels), 1000, np.uint32)
        bit_planes.fill_stamps(begins, stamps, whose, filled)
        assert np.array_equal(filled, wanted.T)

        found = np.full((frames, pixels), 1000, np.uint32)
        bit_planes.stamps_first(np.packbits(ones, axis=1), offsets, ticks, found)
        assert np.array_equal(found, wanted.T)
    bits = np.full((frames, pixels), 7, np.uint8)
    bit_planes.bits_first(np.packbits(ones, axis=1), bits)
    assert np.array_equal(bits, ones.T)


@pytest.mark.parametrize("width", [1, 3, 8, 9, 63, 64, 100, 104])
@pytest.mark.parametrize("rows", [1, 2, 28])
def test_packed_rows_lie_next_to_each_other(width: int, rows: int) -> None:
    """As numpy packs them, full and empty rows among them; and back."""
    set_ = np.random.default_rng(width).random((3 * rows, width)) < 0.4
    set_[::3], set_[1::5] = False, True
    bits = np.packbits(set_, axis=1)
    packed = packing.pack_rows(bits, width, rows)
    assert np.array_equal(packed, np.packbits(set_.reshape(3, rows * width), axis=1))
    assert np.array_equal(packing.unpack_rows(packed, width, rows), bits)
