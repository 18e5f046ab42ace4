"""Statistical assertions, each with a false-alarm rate.

Every assertion computes a two-sided p-value, returns it, and fails where it is below `alpha`: it calls a
right program wrong with probability `alpha`, over the draw of the seed. Seeds in tests are fixed: what passes
once passes always. A test with n assertions has n times the rate.

| assertion | its p-value | values, at least |
| --- | --- | --- |
| `poisson_mean`, `same_poisson`, `share_is`, `same_share` | exact for discrete data: conservative | 1 |
| `distribution_is`, `same_distribution` | Kolmogorov and Smirnov; conservative with ties | 50 |
| `histogram_is`, `same_histogram` | deviance, Williams' correction, bins that expect 10 | 20 |
| `mean_is`, `same_mean` | Student's t with Hall's correction for skewness | 100 |
| `same_variance` | variances to the power that makes them normal | 100, both 1000 |
| `variance_is` | `mean_is` of the squared deviations | 1000 |

`test_laws.py` shows for each that p-values are uniform, or larger, where nothing is wrong. Further out, in
1e5 to 4e5 replications of the tests of means and variances on normal, exponential and Poisson data, p < 1e-5
came 0 to 3 times as often as it should; a plain t-test on 100 exponential values: 34 times.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

FALSE_ALARM = 1e-6

_SPARSE = 10.0  # a histogram's bins are merged until each expects this many in the smaller sample


def z_bound(alpha: float = FALSE_ALARM) -> float:
    """How many standard deviations a normal variable exceeds, on either side, with probability `alpha`."""
    return float(stats.norm.isf(alpha / 2))


# ---- one sample against a known law -----------------------------------------------------------------------


def poisson_mean(total: int, expected: float, alpha: float = FALSE_ALARM, what: str = "Poisson total") -> float:
    """`total` was drawn from a Poisson law of mean `expected` (exact)."""
    law = stats.poisson(expected)
    p = _two_tails(law.cdf(total), law.sf(total - 1))
    return _judge(p, alpha, what, f"{total}", f"{expected:.6g} ± {math.sqrt(expected):.3g}")


def share_is(successes: int, trials: int, probability: float, alpha: float = FALSE_ALARM, what: str = "share") -> float:
    """`successes` were drawn from a binomial law (exact)."""
    law = stats.binom(trials, probability)
    p = _two_tails(law.cdf(successes), law.sf(successes - 1))
    return _judge(p, alpha, what, f"{successes} of {trials}", f"{trials * probability:.6g} ± {law.std():.3g}")


def mean_is(
    values: ArrayLike, expected: float, alpha: float = FALSE_ALARM, what: str = "mean", error: float = 0.0
) -> float:
    """Independent `values` have the mean `expected`, itself known to a standard error `error`."""
    x = _sample(values, 100)
    mean, variance, third = _moments(x)
    difference = mean - expected
    p = _mean_p(difference, variance / x.size + error**2, third / x.size**2, x.size - 1.0)
    return _judge(p, alpha, what, f"{mean:.6g} ± {math.sqrt(variance / x.size):.2g}", f"{expected:.6g}")


def variance_is(values: ArrayLike, expected: float, alpha: float = FALSE_ALARM, what: str = "variance") -> float:
    """Independent `values` have the variance `expected`."""
    x = _sample(values, 1000)
    squares = (x - x.mean()) ** 2 * (x.size / (x.size - 1))
    return mean_is(squares, expected, alpha, what)


def distribution_is(
    values: ArrayLike,
    cdf: Callable[[NDArray[np.float64]], ArrayLike],
    alpha: float = FALSE_ALARM,
    what: str = "distribution",
) -> float:
    """Independent continuous `values` follow `cdf` (Kolmogorov and Smirnov)."""
    x = np.sort(_sample(values, 50))
    law = np.asarray(cdf(x), dtype=float)
    steps = np.arange(x.size + 1) / x.size
    distance = float(max((steps[1:] - law).max(), (law - steps[:-1]).max()))
    p = float(stats.kstwo.sf(distance, x.size))
    return _judge(p, alpha, what, f"distance {distance:.4g} from the law, {x.size} values", _ks_bound(x.size, alpha))


def histogram_is(
    values: ArrayLike,
    pmf: Callable[[NDArray[np.int64]], ArrayLike],
    alpha: float = FALSE_ALARM,
    what: str = "histogram",
) -> float:
    """Independent `values` 0, 1, 2, ... follow the probabilities `pmf` (deviance; sparse bins merged)."""
    x = _whole(values)
    top = int(x.max()) + 1
    while True:  # enough of the law to hold everything but 1e-12 of it, which joins the last bin
        probability = np.asarray(pmf(np.arange(top + 1)), dtype=float)
        if probability.sum() > 1 - 1e-12 or top > 1_000_000:
            break
        top *= 2
    if not np.all(probability >= 0) or not probability.sum() < 1 + 1e-9:
        raise ValueError(f"{what}: these are no probabilities; their sum is {probability.sum():.6g}")
    observed = np.bincount(x, minlength=probability.size).astype(float)
    never = np.flatnonzero((observed > 0) & (probability[: observed.size] == 0))
    if never.size:
        return _judge(0.0, alpha, what, f"{observed[never[0]]:.0f} times {never[0]}", "none, by the law")
    probability[-1] += max(0.0, 1 - probability.sum())
    expected = probability * x.size
    bins = _merge(expected)
    observed, expected = _fold(observed, bins), _fold(expected, bins)
    freedom = expected.size - 1
    if freedom == 0 and np.count_nonzero(probability) > 1:
        raise ValueError(f"{what}: the law has all values in one bin, so that nothing is tested")
    if freedom == 0:  # one value alone, which all have
        return _judge(1.0, alpha, what, "one value", "one value")
    deviance = 2 * float(_xlogy(observed, observed / expected).sum())
    williams = 1 + (float((x.size / expected).sum()) - 1) / (6 * x.size * freedom)
    p = float(stats.chi2.sf(deviance / williams, freedom))
    return _judge(p, alpha, what, f"deviance {deviance:.4g}", _chi2_bound(freedom, alpha))


# ---- two samples of the same law --------------------------------------------------------------------------


def same_poisson(
    total_a: int,
    exposure_a: float,
    total_b: int,
    exposure_b: float,
    alpha: float = FALSE_ALARM,
    what: str = "Poisson rate",
) -> float:
    """Two Poisson totals have one rate per exposure (exact: given the sum, a total is binomial)."""
    law = stats.binom(total_a + total_b, exposure_a / (exposure_a + exposure_b))
    p = _two_tails(law.cdf(total_a), law.sf(total_a - 1))
    return _judge(p, alpha, what, f"{total_a}", f"{law.mean():.6g} ± {law.std():.3g} by the other sample")


def same_share(
    successes_a: int,
    trials_a: int,
    successes_b: int,
    trials_b: int,
    alpha: float = FALSE_ALARM,
    what: str = "share",
) -> float:
    """Two binomial numbers have one probability (exact: Fisher's hypergeometric law)."""
    law = stats.hypergeom(trials_a + trials_b, successes_a + successes_b, trials_a)
    p = _two_tails(law.cdf(successes_a), law.sf(successes_a - 1))
    expected = f"{law.mean():.6g} ± {law.std():.3g} by the other sample"
    return _judge(p, alpha, what, f"{successes_a} of {trials_a}", expected)


def same_mean(a: ArrayLike, b: ArrayLike, alpha: float = FALSE_ALARM, what: str = "means") -> float:
    """Two samples have one mean; their variances may differ (Welch)."""
    x, y = _sample(a, 100), _sample(b, 100)
    mean_x, variance_x, third_x = _moments(x)
    mean_y, variance_y, third_y = _moments(y)
    part_x, part_y = variance_x / x.size, variance_y / y.size
    squared_error = part_x + part_y
    freedom = math.inf
    if squared_error > 0:
        freedom = squared_error**2 / (part_x**2 / (x.size - 1) + part_y**2 / (y.size - 1))
    p = _mean_p(mean_x - mean_y, squared_error, third_x / x.size**2 - third_y / y.size**2, freedom)
    return _judge(p, alpha, what, f"{mean_x:.6g} ± {math.sqrt(part_x):.2g}", f"{mean_y:.6g} ± {math.sqrt(part_y):.2g}")


def same_variance(a: ArrayLike, b: ArrayLike, alpha: float = FALSE_ALARM, what: str = "variances") -> float:
    """Two samples of one shape have one variance; the shape's moments are taken from both together."""
    x, y = _sample(a, 100), _sample(b, 100)
    if x.size + y.size < 1000:
        raise ValueError(f"{x.size} and {y.size} values are too few for this test; it needs 1000 together")
    variance_x, variance_y = float(x.var(ddof=1)), float(y.var(ddof=1))
    p, error = _variances_p(x - x.mean(), y - y.mean())
    return _judge(p, alpha, what, f"{variance_x:.6g}", f"{variance_y:.6g} within ± {error:.2g} of itself")


def same_histogram(a: ArrayLike, b: ArrayLike, alpha: float = FALSE_ALARM, what: str = "histograms") -> float:
    """Two samples of 0, 1, 2, ... have one law (deviance of the 2 x k table; sparse bins merged)."""
    x, y = _whole(a), _whole(b)
    top = int(max(x.max(), y.max())) + 1
    table = np.array([np.bincount(x, minlength=top), np.bincount(y, minlength=top)], dtype=float)
    pooled = table.sum(axis=0)
    bins = _merge(pooled * (min(x.size, y.size) / pooled.sum()))
    table = np.array([_fold(row, bins) for row in table])
    rows, columns, total = table.sum(axis=1), table.sum(axis=0), float(table.sum())
    freedom = columns.size - 1
    if freedom == 0:
        return _judge(1.0, alpha, what, "one bin", "one bin")
    expected = np.outer(rows, columns) / total
    deviance = 2 * float(_xlogy(table, table / expected).sum())
    spread = (float((total / rows).sum()) - 1) * (float((total / columns).sum()) - 1)
    p = float(stats.chi2.sf(deviance / (1 + spread / (6 * total * freedom)), freedom))
    return _judge(p, alpha, what, f"deviance {deviance:.4g}", _chi2_bound(freedom, alpha))


def same_distribution(a: ArrayLike, b: ArrayLike, alpha: float = FALSE_ALARM, what: str = "distributions") -> float:
    """Two continuous samples have one law (Kolmogorov and Smirnov, asymptotic)."""
    x, y = np.sort(_sample(a, 50)), np.sort(_sample(b, 50))
    both = np.concatenate([x, y])
    apart = np.searchsorted(x, both, side="right") / x.size - np.searchsorted(y, both, side="right") / y.size
    distance = float(np.abs(apart).max())
    size = x.size * y.size / (x.size + y.size)
    p = float(stats.kstwo.sf(distance, max(1, round(size))))
    observed = f"distance {distance:.4g} between {x.size} and {y.size} values"
    return _judge(p, alpha, what, observed, _ks_bound(size, alpha))


# ---- the pieces -------------------------------------------------------------------------------------------


def _judge(p: float, alpha: float, what: str, observed: str, expected: str) -> float:
    p = float(p)
    if not p >= alpha:  # a NaN fails too
        raise AssertionError(
            f"{what}: observed {observed}, expected {expected}; p = {p:.3g} is below the bound {alpha:.3g}"
        )
    return p


def _two_tails(lower: float, upper: float) -> float:
    return float(np.minimum(1.0, 2 * np.minimum(lower, upper)))  # a NaN stays one, and `_judge` refuses it


def _sample(values: ArrayLike, least: int) -> NDArray[np.float64]:
    x = np.asarray(values, dtype=float).ravel()
    if x.size < least:
        raise ValueError(f"{x.size} values are too few for this test; it needs {least}")
    return x


def _whole(values: ArrayLike) -> NDArray[np.int64]:
    x = _sample(values, 20)
    whole = x.astype(np.int64)
    if (whole != x).any() or whole.min() < 0:
        raise ValueError("a histogram of counts needs whole numbers from 0")
    return whole


def _moments(x: NDArray[np.float64]) -> tuple[float, float, float]:
    """Mean, variance (n - 1) and third central moment."""
    mean = float(x.mean())
    centred = x - mean
    return mean, float(centred @ centred) / (x.size - 1), float((centred**3).mean())


def _mean_p(difference: float, squared_error: float, third: float, freedom: float) -> float:
    """Student's t of a difference of means, made symmetric by Hall's cubic of its skewness."""
    if not squared_error > 0:
        return 1.0 if difference == 0 else 0.0
    error = math.sqrt(squared_error)
    t = difference / error
    skewness = third / error**3
    t = t + skewness * t**2 / 3 + skewness**2 * t**3 / 27 + skewness / 6
    return 2 * float(stats.t.sf(abs(t), freedom) if math.isfinite(freedom) else stats.norm.sf(abs(t)))


def _variances_p(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """p-value of two centred samples' variances, and the standard error of their log ratio.

    With z standardised, n var(s^2) = E z^4 - 1 and n^2 k3(s^2) = E z^6 - 3 E z^4 - 6 (E z^3)^2 + 2;
    a variance to the power 1 - k3 / (3 var^2) is not skewed (for normal data 1/3: Wilson and Hilferty).
    """
    variance_x, variance_y = float(x @ x) / (x.size - 1), float(y @ y) / (y.size - 1)
    if variance_x == variance_y:
        return 1.0, 0.0
    both = np.concatenate([x, y])
    pooled = float(both @ both) / (both.size - 2)
    z = both / math.sqrt(float(both @ both) / both.size)
    z2 = z * z
    spread = float((z2 * z2).mean()) - 1
    if not spread > 0:
        return 0.0, 0.0
    third = float((z2 * z2 * z2).mean()) - 3 * (spread + 1) - 6 * float((z2 * z).mean()) ** 2 + 2
    power = min(max(1 - third / (3 * spread**2), -1.0), 1.0)
    if abs(power) < 1e-3:
        power = 1e-3  # the logarithm

    def transformed(variance: float, size: int) -> float:
        if variance == 0 and power < 0:
            return -math.inf
        return ((variance / pooled) ** power - 1) / power - (power - 1) / 2 * spread / size

    error = math.sqrt(spread * (1 / x.size + 1 / y.size))
    apart = transformed(variance_x, x.size) - transformed(variance_y, y.size)
    return 2 * float(stats.norm.sf(abs(apart) / error)), error


def _merge(expected: NDArray[np.float64]) -> NDArray[np.int64]:
    """The first index of each merged bin: neighbours join until each bin expects enough."""
    starts, gathered = [0], 0.0
    for i, value in enumerate(expected[:-1]):
        gathered += value
        if gathered >= _SPARSE:
            starts.append(i + 1)
            gathered = 0.0
    if len(starts) > 1 and gathered + expected[-1] < _SPARSE:
        starts.pop()  # the last bin is too thin: it joins the one before
    return np.array(starts)


def _fold(row: NDArray[np.float64], starts: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.add.reduceat(row, starts)


def _xlogy(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return x * np.log(np.where(x > 0, y, 1.0))


def _ks_bound(size: float, alpha: float) -> str:
    bound = math.sqrt(math.log(2 / alpha) / (2 * size)) if alpha > 0 else math.inf
    return f"below about {bound:.4g}"


def _chi2_bound(freedom: int, alpha: float) -> str:
    return f"below {stats.chi2.isf(alpha, freedom):.4g} ({freedom} degrees of freedom)"
