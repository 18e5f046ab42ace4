"""Normal scores of pairs and counts, against laws that are worked out by counting all cases, and by drawing."""

from __future__ import annotations

import itertools
import math

import laws
import numpy as np
import pytest
from scipy import stats

from spadmnist.statistics import _scores as scores


def all_pairs(boxes: int, detections: int) -> np.ndarray:
    """Pairs in the same box for every way to throw so many detections."""
    found = []
    for where in itertools.product(range(boxes), repeat=detections):
        counts = np.bincount(where, minlength=boxes)
        found.append((counts * (counts - 1) // 2).sum())
    return np.array(found, np.float64)


def all_pairs_of_slots(boxes: int, slots: int, detections: int) -> np.ndarray:
    """The same where every slot takes one detection."""
    found = []
    for where in itertools.combinations(range(boxes * slots), detections):
        counts = np.bincount(np.array(where) // slots, minlength=boxes)
        found.append((counts * (counts - 1) // 2).sum())
    return np.array(found, np.float64)


@pytest.mark.parametrize(("boxes", "detections"), [(3, 2), (4, 5), (2, 9), (5, 6)])
def test_moments_of_pairs_are_those_of_all_cases(boxes: int, detections: int) -> None:
    cases = all_pairs(boxes, detections)
    law = scores.pairs_law(np.array(float(detections)), boxes)
    assert np.allclose(law.mean, cases.mean())
    assert np.allclose(law.variance, cases.var())
    assert np.allclose(law.third, ((cases - cases.mean()) ** 3).mean())


@pytest.mark.parametrize(("boxes", "slots", "detections"), [(2, 2, 2), (3, 4, 5), (4, 3, 6), (2, 6, 9), (5, 2, 8)])
def test_moments_of_pairs_in_slots_are_those_of_all_cases(boxes: int, slots: int, detections: int) -> None:
    cases = all_pairs_of_slots(boxes, slots, detections)
    law = scores.pairs_law(np.array(float(detections)), boxes, slots)
    assert np.allclose(law.mean, cases.mean())
    assert np.allclose(law.variance, cases.var())


@pytest.mark.parametrize(("boxes", "detections"), [(4, 5), (2, 9), (5, 6)])
def test_the_table_of_few_is_the_law_of_all_cases(boxes: int, detections: int) -> None:
    cases = all_pairs(boxes, detections)
    lower, own, upper = scores._pairs_of_few(boxes)
    for pairs in range(detections * (detections - 1) // 2 + 1):
        assert math.isclose(own[detections, pairs], (cases == pairs).mean(), abs_tol=1e-12)
        assert math.isclose(lower[detections, pairs], (cases < pairs).mean(), abs_tol=1e-12)
        assert math.isclose(upper[detections, pairs], (cases > pairs).mean(), abs_tol=1e-12)


def test_free_slots_have_the_same_pairs_but_for_a_constant() -> None:
    rng = np.random.default_rng(20)
    taken = rng.random((7, 30)) < 0.8  # 7 boxes of 30 slots
    counts, free = taken.sum(axis=1), (~taken).sum(axis=1)
    pairs, number = scores.minority((counts * (counts - 1) // 2).sum(), np.array(taken.sum()), 7, 30.0)
    assert number == free.sum()
    assert pairs == (free * (free - 1) // 2).sum()


@pytest.mark.parametrize(
    ("detections", "boxes", "slots"),
    [
        (2, 32, np.inf),
        (20, 32, np.inf),
        (100, 32, np.inf),
        (400, 32, np.inf),
        (50, 32, 31),
        (700, 32, 31),
        (985, 32, 31),
    ],
)
def test_scores_of_pairs_are_normal_far_out(detections: int, boxes: int, slots: float) -> None:
    """Far out: 4 standard deviations on either side have 1 in 31,574."""
    rng = np.random.default_rng(20)
    draws = 100_000
    if np.isfinite(slots):
        counts = rng.multivariate_hypergeometric([int(slots)] * boxes, detections, size=draws)
    else:
        counts = rng.multinomial(detections, np.full(boxes, 1 / boxes), size=draws)
    pairs = (counts * (counts - 1) // 2).sum(axis=1)
    found, _ = scores.pair_scores(pairs, np.full(draws, detections), boxes, slots, rng.random(draws))
    assert abs(found.mean()) < 0.03
    assert 0.97 < found.std() < 1.05
    usual = 2 * stats.norm.sf(4) * draws
    assert stats.poisson.sf((np.abs(found) > 4).sum() - 1, 3 * usual) > laws.FALSE_ALARM
    # a law without clumps is too narrow for them, and the test above says so
    if detections == 20:
        wrong = scores.poisson_score(pairs, detections * (detections - 1) / 2 / boxes, rng.random(draws))
        assert stats.poisson.sf((np.abs(wrong) > 4).sum() - 1, 3 * usual) < laws.FALSE_ALARM


@pytest.mark.parametrize("slots", [math.inf, 65])
@pytest.mark.parametrize("detections", [3, 5, 9, 20])
def test_scores_of_few_pairs_of_few_pixels_are_normal(detections: int, slots: float) -> None:
    """Pairs of two pixels in 8 boxes: the law of their scores, by drawing, over all random shares."""
    rng = np.random.default_rng(20)
    draws = (20_000, 2)
    if np.isfinite(slots):
        counts = rng.multivariate_hypergeometric([int(slots)] * 8, detections, size=draws)
    else:
        counts = rng.multinomial(detections, np.full(8, 1 / 8), size=draws)
    pairs, times = np.unique((counts * (counts - 1) // 2).sum(axis=(1, 2)), return_counts=True)
    law = scores.pairs_law(np.array(detections), 8, slots).pooled(np.array(2))
    shares = (np.arange(50) + 0.5) / 50
    found = np.array([[scores.pooled_score(float(n), law, u) for u in shares] for n in pairs])
    weight = np.repeat(times[:, None] / times.sum() / 50, 50, axis=1)
    mean = (weight * found).sum()
    assert abs(mean) < 0.06
    assert abs((weight * (found - mean) ** 2).sum() - 1) < 0.15
    assert weight[np.abs(found) > 4].sum() < 20 * 2 * stats.norm.sf(4)
    assert (np.diff(found.ravel()) >= 0).all()


@pytest.mark.parametrize("mean", [0.01, 0.7, 5.0, 28.0, 33.0, 1e4])
def test_scores_of_counts_are_normal(mean: float) -> None:
    rng = np.random.default_rng(20)
    count = rng.poisson(mean, 50_000)
    found = scores.poisson_score(count, mean, rng.random(count.size))
    laws.distribution_is(found, stats.norm.cdf)
    laws.variance_is(found, 1.0, what=f"scores at a mean of {mean:g}")
    with pytest.raises(AssertionError):  # without the share
        laws.distribution_is(scores.poisson_score(count, mean * 1.02 + 0.05, rng.random(count.size)), stats.norm.cdf)


def test_scores_never_end() -> None:
    huge = scores.poisson_score(np.array([0.0, 1e9]), 1e6, np.array([0.5, 0.5]))
    assert np.isfinite(huge).all() and huge[0] < -200 and huge[1] > 1000
    pairs = np.array([0, 45, 10**9, 20_000])
    detections = np.array([0, 10, 100_000, 300])
    found, _ = scores.pair_scores(pairs, detections, 32, np.inf, np.full(4, 0.5))
    assert np.isfinite(found).all() and abs(found[0]) < 1e-9 and (found[1:] > 6).all()


def test_scores_rise_with_the_pairs() -> None:
    for detections, slots in ((12, np.inf), (90, np.inf), (60, 100.0), (2000, np.inf)):
        pairs = np.arange(detections * (detections - 1) // 2 + 1)[:20_000]
        many = np.full(pairs.size, detections)
        found, _ = scores.pair_scores(pairs, many, 32, slots, np.full(pairs.size, 0.5))
        assert (np.diff(found) >= 0).all()


@pytest.mark.parametrize("law", [(0.01, 0.01, 0.01), (12.0, 11.0, 12.0), (300.0, 250.0, 900.0), (1e9, 1e7, 4e8)])
def test_a_number_is_found_from_its_score(law: tuple[float, float, float]) -> None:
    pairs = scores.Pairs(*(np.array(v) for v in law))

    def scored(number: float, share: float) -> float:
        return scores.pooled_score(number, pairs, share)

    for number in (0.0, 1.0, 7.0, 290.0, 1e9):
        if abs(scored(number, 0.5)) < 6:
            assert math.isclose(
                scores.number_at(scored(number, 0.5), scored, law[0]), number, rel_tol=1e-6, abs_tol=1e-6
            )


def test_shares_are_a_function_of_what_they_are_for() -> None:
    rng = np.random.default_rng(20)
    counts = rng.poisson(3.0, 200)
    found = scores.shares(counts, 50_000)
    assert np.array_equal(found, scores.shares(counts.copy(), 50_000))
    assert found.min() > 0 and found.max() < 1
    laws.distribution_is(found, stats.uniform.cdf)
    other = counts.copy()
    other[17] += 1
    changed = scores.shares(other, 50_000)
    assert abs(np.corrcoef(found, changed)[0, 1]) < 5 / math.sqrt(found.size)
    # the same counts in other pixels are another recording
    assert not np.array_equal(scores.shares(counts[::-1], 100), scores.shares(counts, 100))


@pytest.mark.parametrize("mean", [0.05, 0.3, 2.0, 40.0])
def test_scores_of_few_share_less_than_their_counts(mean: float) -> None:
    """Of few counts a part of the score is chance. Drawn correlations scatter by 0.003; the law is good to 0.005."""
    rng = np.random.default_rng(5)
    one, two = rng.poisson(mean, (2, 100_000)).astype(float)
    z = [scores.poisson_score(n, m, rng.random(n.size)) for n, m in ((one, mean), (one + two, 2 * mean))]
    counted = [scores.Pairs(*(np.asarray(m) for _ in range(3))) for m in (mean, 2 * mean)]
    first, shared = scores.nested(counted)
    assert first == 0 and shared == pytest.approx(np.corrcoef(z)[0, 1], abs=0.02)
