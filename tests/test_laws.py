"""Every assertion of `laws` is calibrated where nothing is wrong and fails where something is."""

from __future__ import annotations

import math
from collections.abc import Callable

import laws
import numpy as np
import pytest
from scipy import stats

REPLICATIONS = 2000

Draw = Callable[[np.random.Generator], float]


def _exponential_cdf(x: np.ndarray) -> np.ndarray:
    return -np.expm1(-x)


def _poisson_pmf(mean: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda k: stats.poisson.pmf(k, mean)


# One null replication of each assertion: the p-value of data for which it is true (alpha 0: it never fails).
# The small sample stands for the slow oracle, the large one for the fast implementation.
UNIFORM: dict[str, Draw] = {
    "poisson_mean, many": lambda rng: laws.poisson_mean(rng.poisson(5e4), 5e4, alpha=0),
    "share_is, many": lambda rng: laws.share_is(rng.binomial(100_000, 0.3), 100_000, 0.3, alpha=0),
    "mean_is, exponential": lambda rng: laws.mean_is(rng.exponential(size=100), 1.0, alpha=0),
    "mean_is, Poisson": lambda rng: laws.mean_is(rng.poisson(2.0, 100), 2.0, alpha=0),
    "variance_is, normal": lambda rng: laws.variance_is(rng.normal(size=1000), 1.0, alpha=0),
    "variance_is, Poisson": lambda rng: laws.variance_is(rng.poisson(4.0, 1000), 4.0, alpha=0),
    "distribution_is": lambda rng: laws.distribution_is(rng.exponential(size=100), _exponential_cdf, alpha=0),
    "histogram_is": lambda rng: laws.histogram_is(rng.poisson(3.0, 300), _poisson_pmf(3.0), alpha=0),
    "same_poisson, many": lambda rng: laws.same_poisson(rng.poisson(1e4), 1, rng.poisson(9e4), 9, alpha=0),
    "same_share, many": lambda rng: laws.same_share(
        rng.binomial(20_000, 0.3), 20_000, rng.binomial(90_000, 0.3), 90_000, alpha=0
    ),
    "same_mean, exponential": lambda rng: laws.same_mean(
        rng.exponential(size=100), rng.exponential(size=2000), alpha=0
    ),
    "same_mean, Poisson": lambda rng: laws.same_mean(rng.poisson(1.0, 100), rng.poisson(1.0, 2000), alpha=0),
    "same_mean, other variances": lambda rng: laws.same_mean(rng.normal(0, 3, 100), rng.normal(0, 1, 200), alpha=0),
    "same_variance, normal": lambda rng: laws.same_variance(rng.normal(size=200), rng.normal(size=2000), alpha=0),
    "same_variance, exponential": lambda rng: laws.same_variance(
        rng.exponential(size=200), rng.exponential(size=2000), alpha=0
    ),
    "same_variance, Poisson": lambda rng: laws.same_variance(rng.poisson(2.0, 200), rng.poisson(2.0, 2000), alpha=0),
    "same_histogram": lambda rng: laws.same_histogram(rng.poisson(3.0, 300), rng.poisson(3.0, 5000), alpha=0),
    "same_histogram, equal sizes": lambda rng: laws.same_histogram(
        rng.poisson(9.0, 500), rng.poisson(9.0, 500), alpha=0
    ),
    "same_distribution": lambda rng: laws.same_distribution(
        rng.exponential(size=200), rng.exponential(size=3000), alpha=0
    ),
}

# Discrete data with few values: p-values are larger than uniform, which costs power but raises no alarm.
CONSERVATIVE: dict[str, Draw] = {
    "poisson_mean, few": lambda rng: laws.poisson_mean(rng.poisson(4.0), 4.0, alpha=0),
    "share_is, few": lambda rng: laws.share_is(rng.binomial(50, 0.05), 50, 0.05, alpha=0),
    "same_poisson, few": lambda rng: laws.same_poisson(rng.poisson(4.0), 1, rng.poisson(40.0), 10, alpha=0),
    "same_share, few": lambda rng: laws.same_share(rng.binomial(50, 0.1), 50, rng.binomial(500, 0.1), 500, alpha=0),
    "mean_is, rare": lambda rng: laws.mean_is(rng.poisson(0.2, 100), 0.2, alpha=0),
    "histogram_is, two bins": lambda rng: laws.histogram_is(rng.poisson(0.1, 200), _poisson_pmf(0.1), alpha=0),
    "same_histogram, two bins": lambda rng: laws.same_histogram(rng.poisson(0.1, 200), rng.poisson(0.1, 2000), alpha=0),
    "same_distribution, ties": lambda rng: laws.same_distribution(
        rng.poisson(3.0, 200), rng.poisson(3.0, 2000), alpha=0
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [*UNIFORM, *CONSERVATIVE])
def test_p_values_where_nothing_is_wrong(name: str) -> None:
    """The shares of p-values below 1, 10 and 50 % are within binomial bounds, or below if conservative."""
    rng = np.random.default_rng(20240229)
    draw = UNIFORM.get(name) or CONSERVATIVE[name]
    p = np.array([draw(rng) for _ in range(REPLICATIONS)])
    assert ((p >= 0) & (p <= 1)).all()
    for level in (0.01, 0.1, 0.5):
        law = stats.binom(REPLICATIONS, level)
        below = int((p < level).sum())
        assert below <= law.isf(1e-6), f"{name}: {below} of {REPLICATIONS} p-values are below {level}"
        if name in UNIFORM:
            assert below >= law.ppf(1e-6), f"{name}: only {below} of {REPLICATIONS} p-values are below {level}"


# A fault that each assertion must catch, at the false-alarm rate the tests use.
FAULTS: dict[str, Draw] = {
    "poisson_mean, 3 % more": lambda rng: laws.poisson_mean(rng.poisson(1.03e5), 1e5),
    "poisson_mean, 3 % less": lambda rng: laws.poisson_mean(rng.poisson(0.97e5), 1e5),
    "share_is": lambda rng: laws.share_is(rng.binomial(100_000, 0.31), 100_000, 0.3),
    "mean_is": lambda rng: laws.mean_is(rng.exponential(1.3, size=1000), 1.0),
    "variance_is": lambda rng: laws.variance_is(rng.negative_binomial(4.0, 0.5, 2000), 4.0),
    "distribution_is": lambda rng: laws.distribution_is(rng.gamma(1.6, 1 / 1.6, size=2000), _exponential_cdf),
    "histogram_is": lambda rng: laws.histogram_is(rng.negative_binomial(4.0, 0.5, 2000), _poisson_pmf(4.0)),
    "same_poisson": lambda rng: laws.same_poisson(rng.poisson(1.1e4), 1, rng.poisson(9e4), 9),
    "same_share": lambda rng: laws.same_share(rng.binomial(5000, 0.35), 5000, rng.binomial(90_000, 0.3), 90_000),
    "same_mean": lambda rng: laws.same_mean(rng.poisson(1.2, 2000), rng.poisson(1.0, 20_000)),
    "same_variance": lambda rng: laws.same_variance(rng.normal(0, 1.2, 1000), rng.normal(size=10_000)),
    "same_histogram, same mean": lambda rng: laws.same_histogram(
        rng.negative_binomial(4.0, 0.5, 1000), rng.poisson(4.0, 10_000)
    ),
    "same_distribution, same mean": lambda rng: laws.same_distribution(
        rng.gamma(1.6, 1 / 1.6, size=2000), rng.exponential(size=20_000)
    ),
    "same_distribution, one missing stretch": lambda rng: laws.same_distribution(
        np.fmod(rng.random(2000), 0.9), rng.random(20_000)
    ),
}


@pytest.mark.parametrize("name", list(FAULTS))
def test_a_planted_fault_is_caught(name: str) -> None:
    rng = np.random.default_rng(7)
    with pytest.raises(AssertionError, match=r"observed .*, expected .*; p = .* is below the bound 1e-06"):
        FAULTS[name](rng)


def test_every_assertion_is_calibrated_and_has_a_fault() -> None:
    public = {
        name
        for name, value in vars(laws).items()
        if callable(value) and value.__module__ == laws.__name__ and not name.startswith("_")
    } - {"z_bound"}
    assert {name.split(",")[0] for name in (*UNIFORM, *CONSERVATIVE)} == public
    assert {name.split(",")[0] for name in FAULTS} == public


def test_histogram_at_the_far_tail_exactly() -> None:
    """Two bins, every possible table: the probability of a false alarm at 1e-6 is not far from 1e-6."""
    small, large, share = 200, 2000, 0.05  # ten expected in the thin bin: the sparsest table that is tested
    alarm = 0.0
    b = stats.binom(large, share)
    a = stats.binom(small, share)
    for ones_large in range(int(b.ppf(1e-9)), int(b.isf(1e-9)) + 1, 4):  # every fourth, weighted by four
        y = np.arange(large) < ones_large
        for ones_small in range(0, 45):
            if laws.same_histogram(np.arange(small) < ones_small, y, alpha=0) < laws.FALSE_ALARM:
                alarm += 4 * float(a.pmf(ones_small) * b.pmf(ones_large))
    assert alarm < 3 * laws.FALSE_ALARM


def test_z_bound() -> None:
    assert laws.z_bound(0.05) == pytest.approx(1.959964, abs=1e-6)
    assert laws.z_bound() == pytest.approx(4.891638, abs=1e-6)


def test_exact_p_values_by_hand() -> None:
    assert laws.poisson_mean(0, 1.0, alpha=0) == pytest.approx(2 * math.exp(-1))
    assert laws.share_is(3, 3, 0.5, alpha=0) == pytest.approx(2 / 8)
    assert laws.same_poisson(3, 1.0, 0, 1.0, alpha=0) == pytest.approx(2 / 8)
    assert laws.same_share(2, 2, 0, 2, alpha=0) == pytest.approx(2 / 6)
    assert laws.poisson_mean(0, 0.0) == 1.0


def test_constant_data() -> None:
    """No scatter at all: equal is right, anything else is wrong."""
    ones = np.ones(1000)
    assert laws.mean_is(ones, 1.0) == laws.same_mean(ones, ones) == laws.same_variance(ones, ones) == 1.0
    assert laws.same_histogram(ones, ones) == 1.0
    with pytest.raises(AssertionError):
        laws.mean_is(ones, 1.0 + 1e-9)
    with pytest.raises(AssertionError):
        laws.same_variance(ones, np.arange(1000))


def test_not_a_number_fails() -> None:
    with pytest.raises(AssertionError):
        laws.mean_is(np.full(1000, np.nan), 1.0)


def test_too_few_values_are_refused() -> None:
    for call in (laws.same_mean, laws.same_variance, laws.same_histogram):
        with pytest.raises(ValueError, match="too few"):
            call([1, 2, 3], np.arange(1000))
    with pytest.raises(ValueError, match="whole numbers"):
        laws.same_histogram(np.full(100, 0.5), np.ones(100))


@pytest.mark.parametrize(
    "asked",
    [
        lambda: laws.poisson_mean(5, math.nan),
        lambda: laws.share_is(3, 10, 1.4),
        lambda: laws.share_is(3, 10, -0.2),
        lambda: laws.same_poisson(5, math.nan, 5, 1.0),
        lambda: laws.histogram_is(np.arange(20), lambda k: np.full(k.shape, 0.5)),
        lambda: laws.histogram_is(np.arange(20), lambda k: np.full(k.shape, math.nan)),
        lambda: laws.histogram_is(np.zeros(20), lambda k: (k == 3).astype(float)),
    ],
)
def test_what_is_no_law_passes_nothing(asked: Callable[[], float]) -> None:
    with np.errstate(invalid="ignore"), pytest.raises((AssertionError, ValueError)):
        asked()
