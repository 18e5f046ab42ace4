"""Z: what the best test reaches that knows an effect's family and strength, but not the pattern that chance made.

Z^2 is twice the expected log-likelihood ratio of the effect's law against none. A pattern that is drawn (a map, which
pixels blink, a phase) enters by its law, averaged over all that could have been drawn: nobody knows it beforehand, so
no program can be asked for what somebody would see who does. The level of the light is free. These are
signal-to-noise arguments, good to about a third, not refits of every data set.

A lab is a `challenge_cases.Lab`. SI units.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import i0e, logsumexp, ndtri_exp
from scipy.stats import poisson, rice

if TYPE_CHECKING:
    from challenge_cases import Lab


def gain(background: Any, extra: Any) -> Any:
    """Expected log likelihood ratio of a Poisson number with `extra` against one with the background alone."""
    total = background + extra
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(total > 0, total * np.log(total / background), 0.0) - extra


LAGS = np.geomspace(1e-11, 1e-2, 1500)  # s


def followers(lab: Lab, extra: Any, base: Any = 0.0) -> float:
    """Z of an excess hazard `extra` (1/s, at LAGS) that follows each detection, on the rate and `base`."""
    total = 0.0
    for capture in lab.stated:
        rate = lab.rate(capture)
        per_detection = np.trapezoid(gain(rate + base, extra) * np.exp(-rate * LAGS), LAGS)
        total += 2 * lab.pixels * lab.detections(capture) * per_detection
    return math.sqrt(total)


def band(mean: float, shortest: float, longest: float) -> np.ndarray:
    """Hazard (1/s, at LAGS) of releases from traps with lifetimes between two limits."""
    lifetimes = np.geomspace(shortest, longest, 25)
    return mean * np.mean([np.exp(-LAGS / tau) / tau for tau in lifetimes], axis=0)


def later_frames(lab: Lab, mean: float, lifetimes: Iterable[float]) -> float:
    """Z of releases in later frames: frame k after a detection fires more often than others."""
    taus = np.array(list(lifetimes))
    total = 0.0
    for capture in lab.stated:
        x = lab.rate(capture) * capture.frame_time
        fires, k = -math.expm1(-x), np.arange(60)[:, None]
        ratio = capture.frame_time / taus
        share = ((1 - np.exp(-ratio)) ** 2 / ratio * np.exp(-k * ratio)).mean(axis=1)
        total += 2 * lab.pixels * lab.detections(capture) * float(gain(fires, mean * share * (1 - fires)).sum())
    return math.sqrt(total)


def within_frames(lab: Lab, chances: np.ndarray) -> float:
    """Z of crosstalk within frames: pairs at each distance have the correlation 2 c exp(-lambda T_f)."""
    total = 0.0
    for c in lab.stated:
        correlation = 2 * chances * math.exp(-lab.rate(c) * c.frame_time)
        total += 0.5 * lab.pixels * c.frames * float((correlation**2).sum())
    return math.sqrt(total)


def first_followers(lab: Lab, extra: Any, base: Any = 0.0) -> float:
    """Z of an excess hazard `extra` (1/s, at LAGS) of a neighbour behind the first stamp of a pixel in a frame.

    Both stamps are the first of their pixels: the one at t, with the chance exp(-lambda t) that the neighbour has none
    so far, and the neighbour's next one.
    """
    total = 0.0
    for c in lab.stated:
        rate = lab.rate(c)
        first = lab.pixels * c.frames * -math.expm1(-2 * rate * c.frame_time) / 2
        seen = gain(rate + base, extra) * np.exp(-rate * LAGS) * (c.frame_time > LAGS)
        total += 2 * first * float(np.trapezoid(seen, LAGS))
    return math.sqrt(total)


def light_errors(lab: Lab) -> float:
    """1 / (error of one pixel's relative light, from all lit captures together)."""
    return math.sqrt(sum(lab.weight(c) * lab.share(c) ** 2 for c in lab.lit))


def light_map(lab: Lab, relative: np.ndarray) -> float:
    """Square of the Z of a known pattern of the light, the common level left free."""
    return float(((relative / relative.mean() - 1) ** 2).sum()) * light_errors(lab) ** 2


def all_lit(lab: Lab, power: float) -> float:
    """Sum over lit captures of detections * share^2 * power: a known swing of the light with this mean square."""
    return sum(lab.pixels * lab.weight(c) * lab.share(c) ** 2 for c in lab.lit) * power


def random_level(length: float, relative: float, hold: float, weight: float) -> float:
    """Square of the Z of a level that jumps at random, its correlation falling as exp(-t / hold).

    relative: variance of the level over its mean's square; weight: detections in so long a time. Nobody knows when it
    jumps: by the likelihood of the powers of its spectrum (Whittle), but for what the mean alone would tell.
    """
    k = np.arange(1, max(50, math.ceil(5 * length / hold)))
    power = relative * weight * 2 * hold / length / (1 + (2 * np.pi * k * hold / length) ** 2)
    return 2 * float((power - np.log1p(power)).sum())


def edge(lab: Lab, width: float, tick: float) -> float:
    """Z of detections within `width` of the end of the dead time that one model has and the other has not."""
    return math.sqrt(2 * edge_detections(lab, width, tick) * lab.pixels)


def edge_detections(lab: Lab, width: Any, tick: float) -> Any:
    """Detections of one pixel that tell a shift of the edge by `width`, each as one against none.

    Less than there are where the converter's ticks, which blur an interval by about two, are wider than the shift.
    """
    return sum(lab.detections(c) * lab.rate(c) for c in lab.stated) * width**2 / (width + 2 * tick)


# ---- patterns that chance made ----------------------------------------------------------------------------

QUANTILES = (np.arange(16) + 0.5) / 16  # at which expectations over the data are taken
HERMITE, WEIGHTS = np.polynomial.hermite_e.hermegauss(24)
WEIGHTS = WEIGHTS / WEIGHTS.sum()


def normal_pattern(shifts: np.ndarray, spread: float) -> float:
    """Z of shifts (in standard errors, each measured once) drawn from a normal law of this standard deviation."""
    share = spread**2 / (1 + spread**2)
    return _z(float(((shifts**2 + 1) * share - math.log1p(spread**2)).sum()))


def drawn_pattern(shifts: np.ndarray, values: np.ndarray, chances: np.ndarray) -> float:
    """Z of shifts (in standard errors, each measured once) drawn from `values` with these chances."""
    shifts, many = np.unique(shifts, return_counts=True)
    seen = shifts[:, None, None] + HERMITE[None, :, None]
    ratio = logsumexp(seen * values - values**2 / 2, axis=2, b=chances)
    return _z(2 * float(many @ (ratio @ WEIGHTS)))


def drawn_counts(expected: float, factors: np.ndarray, values: np.ndarray, chances: np.ndarray) -> float:
    """Z of Poisson counts whose mean is `expected` without the effect, times `factors` drawn from `values` with it."""
    factors, many = np.unique(factors, return_counts=True)
    seen = poisson.ppf(QUANTILES[None, :], expected * factors[:, None])[:, :, None]
    ratio = logsumexp(seen * np.log(values) - expected * (values - 1), axis=2, b=chances)
    return _z(2 * float(many @ ratio.mean(axis=1)))


def some_of(each: float, chosen: int, pixels: int) -> float:
    """Z of an effect in `chosen` of `pixels`, nobody knows which, each with the log-likelihood ratio `each` expected.

    The ratio is normal, its variance twice its mean: what many small contributions come to.
    """
    share, spread = chosen / pixels, math.sqrt(2 * each)
    with_it, without = each + spread * HERMITE, -each + spread * HERMITE
    ratio = [float(np.logaddexp(math.log1p(-share), math.log(share) + x) @ WEIGHTS) for x in (with_it, without)]
    return _z(2 * (chosen * ratio[0] + (pixels - chosen) * ratio[1]))


def sine(amplitude: float) -> float:
    """Square of the Z of a sine of this amplitude (in standard errors) and known frequency, its phase unknown."""
    seen = rice.ppf(QUANTILES, amplitude)
    return 2 * float((np.log(i0e(amplitude * seen)) + amplitude * seen - amplitude**2 / 2).mean())


def either_sign(amplitude: float) -> float:
    """Square of the Z of a shape of this size (in standard errors) whose sign is unknown."""
    seen = np.abs(amplitude + HERMITE) * amplitude
    ratio = np.logaddexp(seen, -seen) - math.log(2.0) - amplitude**2 / 2
    return 2 * float(ratio @ WEIGHTS)


def _z(twice_log_ratio: float) -> float:
    return math.sqrt(max(twice_log_ratio, 0.0))


def if_any(z: float, number: float) -> float:
    """The Z of rare things, each of which says much: there may be none, and then nobody sees anything."""
    return min(z, max(0.0, -float(ndtri_exp(-number))))
