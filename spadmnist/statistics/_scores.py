"""Normal scores: where a number lies in the law that it follows if nothing is at work, as a standard normal variable.

A number of pairs or of detections that is a whole number and often small is no normal variable. Its score is: of the
probability below it and a random share of its own, the normal quantile (Dunn and Smyth, J. Comput. Graph. Stat. 5,
1996). The share is a function of the recording, different for every one. With it a number that carries no information
is a score like any other, and one that is nearly always 0 has no spread that is too small.

The laws here hold where detections fall where they like, given how many there are: boxes (blocks of time, pixels) are
equal, each with `slots` places that can be taken once (frames), or with any number (`inf`: times).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ..kernels import inline, jit

_FEW = 128  # up to so many detections the law of their pairs is worked out exactly
_THIN = 0.1  # and if they fill less than this share of the slots, so that slots hardly matter
_SPARSE = 30.0  # expectations below it are no normal variable
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


@inline
def _mixed(word):  # type: ignore[no-untyped-def]
    """64 well mixed bits for a word (Steele, Lea and Flood, SplitMix64, 2014)."""
    z = (word ^ (word >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def shares(of: np.ndarray, size: int) -> np.ndarray:
    """(size,) numbers in (0, 1), as good as random, that are a function of the whole numbers `of`."""
    return np.asarray(_shares(of.ravel().astype(np.uint64), size))


@jit
def _shares(of, size):  # type: ignore[no-untyped-def]
    seed = np.uint64(0)
    for i in range(of.size):
        seed ^= _mixed(of[i] + np.uint64(i + 1) * _GOLDEN)
    out = np.empty(size)
    for i in range(size):
        word = _mixed(np.uint64(i + 1) * _GOLDEN + seed)
        out[i] = (np.float64(word >> np.uint64(12)) + 0.5) * 2.0**-52
    return out


def poisson_score(count: np.ndarray | float, mean: np.ndarray | float, share: np.ndarray | float) -> np.ndarray:
    """Score of Poisson counts. Below a mean of 30 by the exact law, above by that of Wilson and Hilferty (1931)."""
    count, mean, share = np.broadcast_arrays(np.asarray(count, np.float64), np.asarray(mean, np.float64), share)
    score = np.array(wilson_hilferty(count + share, mean))
    few = mean < _SPARSE
    if few.any():
        exact = _exact_score(count[few], mean[few], share[few])
        score[few] = np.where(np.abs(exact) < 6.7, exact, score[few])
    return score


def _poisson_score_of_one(count: float, mean: float, share: float) -> float:
    """`poisson_score` of one number: much quicker, for it is needed for every cell of every recording."""
    exact = float(_exact_score(count, mean, share)) if mean < _SPARSE else math.inf
    return exact if abs(exact) < 6.7 else float(wilson_hilferty(count + share, mean))


def wilson_hilferty(count: Any, mean: Any) -> Any:
    """Score of a count of Poisson law with its share added, a number or an array, for means that are not small."""
    return 3.0 * np.sqrt(count) * (1.0 - 1.0 / (9.0 * count) - np.cbrt(mean / count))


def _exact_score(count: Any, mean: Any, share: Any) -> np.ndarray:
    """Score of Poisson counts, numbers or arrays, by the exact law."""
    from scipy import special

    own = np.exp(special.xlogy(count, mean) - mean - special.gammaln(count + 1.0))
    lower = np.where(count > 0, special.pdtr(count - 1.0, mean), 0.0) + share * own
    return _from_tails(lower, special.pdtrc(count, mean) + (1.0 - share) * own)


def largest_score(largest: np.ndarray, mean: np.ndarray, number: int, share: np.ndarray) -> np.ndarray:
    """Score of the largest of so many independent Poisson counts of the same mean."""
    from scipy import special

    k, m = np.asarray(largest, np.float64), np.asarray(mean, np.float64)

    def beyond(count: np.ndarray) -> np.ndarray:
        """Chance that one of them is larger."""
        tail = np.where(count < 0, 1.0, special.pdtrc(np.maximum(count, 0.0), m))
        return np.asarray(-np.expm1(number * np.log1p(-np.minimum(tail, 1.0 - 1e-16))))

    upper, least = beyond(k), beyond(k - 1.0)
    own = least - upper
    tails = 1.0 - least + share * own, upper + (1.0 - share) * own
    return _from_tails(np.maximum(tails[0], 1e-300), np.maximum(tails[1], 1e-300))


def _from_tails(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Normal quantile from the probabilities below and above, the smaller of which is the more precise."""
    from scipy import special

    return np.where(lower < upper, special.ndtri(lower), -special.ndtri(upper))


class Pairs(NamedTuple):
    """The law of the number of pairs of detections that share a box: mean, variance, third cumulant; any shape."""

    mean: np.ndarray
    variance: np.ndarray
    third: np.ndarray

    def pooled(self, times: np.ndarray) -> Pairs:
        """The law of the sum of independent numbers. times: how often there is each of them."""
        return Pairs(*(np.asarray((part * times).sum()) for part in self))


def nested(laws: Sequence[Pairs]) -> np.ndarray:
    """(laws,) correlation of the score of each number of pairs with that of the one before, whose pairs are among them.

    What is new in the larger number is independent of the smaller one. Of few pairs a part of the score is chance.
    """
    variance = np.array([float(law.variance) for law in laws])
    told = np.sqrt(_told_by_count(np.array([float(law.mean) for law in laws])))
    shared = np.sqrt(np.divide(variance[:-1], variance[1:], out=np.zeros(len(laws) - 1), where=variance[1:] > 0))
    return np.append(0.0, np.minimum(shared * told[:-1] * told[1:], 0.99))


def _told_by_count(means: np.ndarray) -> np.ndarray:
    """Of the variance of the scores of Poisson counts, what the count itself makes; the rest is its random share."""
    from scipy import special

    out = np.ones(len(means))
    few = means < _SPARSE
    if few.any():
        k, mean = np.arange(100), means[few, None]
        own = np.exp(special.xlogy(k, mean) - mean - special.gammaln(k + 1.0))
        upto = np.cumsum(np.column_stack([np.zeros(len(mean)), own]), axis=1)
        at = special.ndtri(np.clip(upto, 1e-300, 1.0 - 1e-16))
        terms = np.diff(np.exp(-(at**2) / 2.0), axis=1) ** 2 / np.maximum(own, 1e-300)
        out[few] = np.sum(terms, axis=1) / (2.0 * np.pi)
    return out


def pairs_law(detections: np.ndarray, boxes: int, slots: float = np.inf) -> Pairs:
    """Law of the pairs within `boxes` equal boxes, given the number of detections.

    Mean and variance are exact, and with `slots` = inf the third cumulant, too: indicators of pairs are independent
    but for triangles (index of dispersion: Fisher 1950, Haldane 1937). Otherwise it is made up of its limits for few
    and for many detections.
    """
    n = np.asarray(detections, np.float64)
    all_pairs = n * (n - 1.0) / 2.0
    if not np.isfinite(slots):
        q = 1.0 / boxes
        variance = all_pairs * q * (1.0 - q)
        return Pairs(all_pairs * q, variance, variance * (1.0 - 2.0 * q + 2.0 * np.maximum(n - 2.0, 0.0) * q))
    places = boxes * slots
    p = n / places
    within = boxes * slots * (slots - 1.0) / 2.0 * (1.0 - (slots - 1.0) / max(1.0, places - 1.0))
    drawn = n * (n - 1.0) / (places * max(1.0, places - 1.0))
    left = (places - n) * (places - n - 1.0) / (max(1.0, places - 2.0) * max(1.0, places - 3.0))
    variance = within * drawn * left
    thirds = np.maximum(n - 2.0, 0.0) * np.maximum(places - n - 2.0, 0.0) / places**2  # p (1 - p), of what is left
    shape = (1.0 - 2.0 * p) ** 2 + 2.0 * (slots - 2.0) * thirds
    return Pairs(all_pairs * (slots - 1.0) / max(1.0, places - 1.0), variance, variance * np.maximum(shape, 1e-3))


def unequal_pairs_law(number: float, chances: np.ndarray) -> Pairs:
    """Law of the pairs within boxes, given the number of detections. chances: of each box, 1 in all.

    Mean and variance are exact. The third cumulant is exact for equal boxes; what others add to it is that of Poisson
    numbers: it is good to some per cent where no box has most of the pairs.
    """
    p = np.asarray(chances, np.float64)
    second, cubes = float((p**2).sum()), float((p**3).sum())
    two = number * (number - 1.0)
    three = two * max(0.0, number - 2.0)
    alone = two * second * (1.0 - second) / 2.0
    variance = alone + three * max(0.0, cubes - second**2)
    third = alone * (1.0 - 2.0 * second + 2.0 * max(0.0, number - 2.0) * second)
    if three > 0:
        third += (_third_of_poisson(number * p) - number**2 * second / 2.0 - number**3 * second**2) * three / number**3
    return Pairs(*(np.asarray(x) for x in (two * second / 2.0, variance, max(third, 1e-3 * variance))))


def _third_of_poisson(m: np.ndarray) -> float:
    """Third cumulant of the sum of n (n - 1) / 2 - c n, n being Poisson of mean m, c the slope of the pairs on the sum
    of n. The joint cumulants of pairs and numbers are derivatives of m^2 / 2; where all m are alike it is m^2 / 2 + m^3
    of each.
    """
    c = float((m**2).sum() / m.sum())
    terms = m**2 / 2 + 4 * m**3 + 4 * m**4 - 3 * c * (m**2 + 3 * m**3) + 6 * c**2 * m**2 - c**3 * m
    return float(terms.sum())


def gamma_score(number: np.ndarray | float, law: Pairs) -> np.ndarray:
    """Score by the gamma law with the same three cumulants, by its cube root (Wilson and Hilferty). Never infinite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(law.variance > 0, _cube_root_score(number, *law), 0.0))


def _cube_root_score(number: Any, mean: Any, variance: Any, third: Any) -> Any:
    """`gamma_score` of a number or an array, where variance and third cumulant are more than 0."""
    shape = 4.0 * variance**3 / third**2
    ratio = 1.0 + (number - mean) * third / (2.0 * variance**2)
    return 3.0 * np.sqrt(shape) * (np.cbrt(ratio) - 1.0 + 1.0 / (9.0 * shape))


def number_at(score: float, scores: Callable[[float, float], float], mean: float) -> float:
    """The number, whole or not, that has a score. scores: (whole number, share) -> score, rising with both."""

    def at(number: float) -> float:
        whole = math.floor(number + 0.5)
        return scores(float(whole), min(max(number + 0.5 - whole, 1e-9), 1.0 - 1e-9))

    low, high = 0.0, max(1.0, 2.0 * mean)
    while at(high) < score and high < 1e30:
        high *= 2.0
    while high - low > 1e-10 * (1.0 + high):
        middle = (low + high) / 2.0
        low, high = (middle, high) if at(middle) < score else (low, middle)
    return (low + high) / 2.0


def pooled_score(number: float, law: Pairs, share: float) -> float:
    """Score of a pooled number of pairs: Poisson where few are expected and they do not come in clumps.

    Where they do, it is the gamma law's of whole numbers, and all of it that lies below 0 belongs to 0.
    """
    from scipy import special

    mean, variance, third = (float(part) for part in law)
    if mean < _SPARSE and third <= 1.2 * variance:
        return _poisson_score_of_one(max(0.0, float(round(number))), mean, share)
    above = number + share - 0.5
    if third == 0:
        return (above - mean) / math.sqrt(variance) if variance > 0 else 0.0
    score = float(_cube_root_score(above, mean, variance, third)) if variance > 0 else 0.0
    if mean >= _SPARSE:
        return score
    shape, scale = 4.0 * variance**3 / third**2, 2.0 * variance / third
    # from where the law begins, in its scale; plain numbers, for this is called for every cell
    upto = max(shape + (number + 0.5 - mean) * scale, 0.0)
    from_ = max(shape + (number - 0.5 - mean) * scale, 0.0) if number > 0 else 0.0
    lower = float((1.0 - share) * special.gammainc(shape, from_) + share * special.gammainc(shape, upto))
    upper = float((1.0 - share) * special.gammaincc(shape, from_) + share * special.gammaincc(shape, upto))
    exact = float(special.ndtri(lower) if lower < upper else -special.ndtri(upper))
    return exact if abs(exact) < 6.7 else math.copysign(max(abs(score), 6.7), exact)


def pair_scores(
    pairs: np.ndarray, detections: np.ndarray, boxes: int, slots: float, share: np.ndarray
) -> tuple[np.ndarray, Pairs]:
    """(scores of the pairs in equal boxes, their laws): for every pixel, exact up to 128 detections (or gaps).

    Where more than half of the slots are taken, the pairs of slots that are free are counted: the same number but for
    a constant.
    """
    pairs, detections = minority(pairs, detections, boxes, slots)
    law = pairs_law(detections, boxes, slots)
    few = (detections <= _FEW) & (detections <= _THIN * boxes * slots)
    if not few.any():
        return gamma_score(pairs + share - 0.5, law), law
    lower, own, upper = _pairs_of_few(boxes)
    n, u = detections[few].astype(np.intp), share[few]
    k = np.minimum(pairs[few], own.shape[1] - 1).astype(np.intp)
    below, above = lower[n, k] + u * own[n, k], upper[n, k] + (1.0 - u) * own[n, k]
    exact = _from_tails(np.maximum(below, 1e-12), np.maximum(above, 1e-12))
    # the table is for slots without end; where they end, mean and spread are less, the score's but half as much
    if np.isfinite(slots):
        ends, here = pairs_law(n, boxes), Pairs(*(part[few] for part in law))
        steady = here.variance <= 0
        variance = np.where(steady, 1.0, here.variance)
        ends_variance = np.where(steady, 1.0, ends.variance)
        exact += np.where(steady, 0.0, (ends.mean - here.mean) / np.sqrt(ends_variance))
        exact *= (ends_variance / variance) ** 0.25
    score = np.empty(len(pairs))
    score[few] = exact
    rest = ~few
    rest[few] = np.minimum(below, above) < 1e-11  # beyond the precision of the table
    by_gamma = gamma_score((pairs + share - 0.5)[rest], Pairs(*(part[rest] for part in law)))
    beyond = few[rest]
    by_gamma[beyond] = np.copysign(np.maximum(np.abs(by_gamma[beyond]), 6.7), by_gamma[beyond])
    score[rest] = by_gamma
    return score, law


def minority(
    pairs: np.ndarray | float, detections: np.ndarray, boxes: int, slots: float
) -> tuple[np.ndarray, np.ndarray]:
    """(pairs, number) of the slots that are taken, or of those that are free where these are fewer."""
    detections = np.asarray(detections, np.float64)
    if not np.isfinite(slots):
        return np.asarray(pairs, np.float64), detections
    free = boxes * slots - detections
    of_free = pairs + boxes * slots * (slots - 1.0) / 2.0 - (slots - 1.0) * detections
    more = free < detections
    return np.where(more, of_free, pairs), np.where(more, free, detections)


@lru_cache(maxsize=8)
def _pairs_of_few(boxes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Probabilities (detections 0 to 128, pairs 0 to 2047) of fewer pairs, of so many, and of more."""
    size = 2048  # more pairs than have a chance above 1e-15 in 16 boxes or more: nothing comes around the corner
    k = np.arange(_FEW + 1)
    frequency = np.exp(-2j * np.pi / size * np.arange(size // 2 + 1))
    one = frequency[None, :] ** (k * (k - 1) // 2)[:, None]  # all in one box
    total, done = one, 1
    for bit in bin(boxes)[3:]:
        total, done = _together(total, done, total, done), 2 * done
        if bit == "1":
            total, done = _together(total, done, one, 1), done + 1
    own = np.maximum(np.fft.irfft(total, size, axis=1), 0.0)
    own[own < 1e-15] = 0.0
    upto = np.cumsum(own, axis=1)
    down = np.cumsum(own[:, ::-1], axis=1)[:, ::-1]
    return upto - own, own, down - own


def _together(a: np.ndarray, boxes_a: int, b: np.ndarray, boxes_b: int) -> np.ndarray:
    """Characteristic functions over the detections in boxes_a + boxes_b boxes: a binomial number falls in the first."""
    from scipy import stats

    out = np.empty_like(a)
    for n in range(_FEW + 1):
        k = np.arange(n + 1)
        split = stats.binom.pmf(k, n, boxes_a / (boxes_a + boxes_b))
        out[n] = np.einsum("k,kw,kw->w", split, a[k], b[n - k])
    return out
