"""The mean number of detections of a pixel with a dead time and a gate that opens once in each frame."""

from __future__ import annotations

import numpy as np

from .effects import Conditions

# dead times in an opening: beyond it the mean is the asymptotic one, off by a part of one count; a rule of thumb
_MANY = 20.0
_TABLE = 1024  # rates of a table, and pixels from which on it is made: within 2e-4 over four decades
_POINTS = 256  # moments of an opening over which a mean is taken; a rule of thumb


def detected(
    rate: np.ndarray, steady: np.ndarray, opening: np.ndarray, conditions: Conditions, extends: bool
) -> np.ndarray:
    """The detections while the gate is open, 1/s, in the shape of the rates.

    If the dead time is shorter than the closed time, every opening begins with a live pixel. Its detections are then a
    renewal process, whose dead time follows from the steady rates. If the dead time is longer, their number is that of
    the mean rate over the frame, and at most that of a live pixel; the tests allow 6 % against the simulation. Where
    events extend the dead time, both cases are exact after many frames. The start of an exposure is left out: its
    pixels are alive, and few frames, with a dead time as long as they are, count more (10 % was seen).
    Source: Cox, Renewal Theory (1962), ch. 4; for long openings its asymptotic mean.

    Args:
        rate: 1/s of events while the gate is open, (images, pixels).
        steady: 1/s of detections at that rate without a gate.
        opening: s that the gate is open in each frame.
        extends: an event within a dead time begins it anew.
    """
    rate, steady, opening = np.broadcast_arrays(rate, steady, opening)
    out, lost = np.array(steady), (steady > 0) & (steady < rate) & (opening > 0)
    if not lost.any():
        return out
    r, g, period = rate[lost], opening[lost], conditions.exposure / conditions.frames
    dead = np.log(r / steady[lost]) / r if extends else 1 / steady[lost] - 1 / r
    alike = all(np.ptp(one) <= 1e-9 * one.max() for one in (dead, g))
    if alike and len(r) > _TABLE:  # a curve of the rate alone
        rates = np.geomspace(r.min(), r.max() * (1 + 1e-12), _TABLE)
        curve = _counted(rates, np.full(_TABLE, dead[0]), np.full(_TABLE, g[0]), period, extends)
        number = np.exp(np.interp(np.log(r), np.log(rates), np.log(np.maximum(curve, 1e-300))))
    else:
        number = _counted(r, dead, g, period, extends)
    out[lost] = number / g
    return out


def _counted(rate: np.ndarray, dead: np.ndarray, opening: np.ndarray, period: float, extends: bool) -> np.ndarray:
    """The mean number of detections of an opening, (pixels,)."""
    late = dead > period - opening
    if extends:
        number = -np.expm1(-rate * np.minimum(opening, dead))
        number += rate * np.exp(-rate * dead) * np.maximum(opening - dead, 0.0)
        number[late] = _where_events_extend(rate[late], dead[late], opening[late], period)
        return number
    number = _of_an_opening(rate, dead, opening)
    averaged = rate * opening / (1 + rate * dead * opening / period)
    return np.where(late, np.minimum(number, averaged), number)


def _where_events_extend(rate: np.ndarray, dead: np.ndarray, opening: np.ndarray, period: float) -> np.ndarray:
    """The mean number of detections of an opening after many others, (pixels,): events with none shortly before."""
    number = np.zeros(len(rate))
    for share in (np.arange(_POINTS) + 0.5) / _POINTS:
        since = share * opening
        left = np.maximum(dead - since, 0.0)  # of the dead time, before this opening
        whole, rest = np.divmod(left, period)
        seen = np.minimum(since, dead) + whole * opening + np.maximum(rest - (period - opening), 0.0)
        number += rate * opening * np.exp(-rate * seen) / _POINTS
    return number


def _of_an_opening(rate: np.ndarray, dead: np.ndarray, opening: np.ndarray) -> np.ndarray:
    """The mean number of detections of a pixel that begins alive, (pixels,)."""
    from scipy import special

    mean = dead + 1 / rate
    number = (opening - 1 / rate) / mean + 0.5 * (1 + 1 / (rate * mean) ** 2)
    few = opening < _MANY * dead
    if few.any():
        r, tau, left = rate[few], dead[few], opening[few]
        exact, k = np.zeros(len(r)), 1
        while np.any(left > 0):
            exact += special.gammainc(k, r * np.maximum(left, 0.0))
            left, k = left - tau, k + 1
        number[few] = exact
    return np.maximum(number, 0.0)


def again(opening: float, period: float, least: np.ndarray, mean: float) -> np.ndarray:
    """The chances that what follows an event of an opening falls into one, that of a later frame as well, (n,).

    Args:
        opening: s that the gate is open in each frame, in one piece; the event is anywhere in it.
        period: s of a frame.
        least: (n,) s that it is later at least.
        mean: s, of the exponential time that comes on top.
    """
    chance = np.zeros(len(least))
    if not 0 < opening < period:
        return chance + 1.0
    for share in (np.arange(_POINTS) + 0.5) / _POINTS:
        # of a delay the rest by whole frames counts, which has the exponential law, cut at a frame
        later = -mean * np.log1p(share * np.expm1(-period / mean)) if mean > 0 else 0.0
        rest = np.mod(later + least, period)
        chance += np.maximum(1 - rest / opening, 0.0) + np.maximum(1 - (period - rest) / opening, 0.0)
    return chance / _POINTS


def before_the_end(least: np.ndarray, mean: float, exposure: float) -> np.ndarray:
    """The shares of what follows events of an exposure that come before its end, (n,); see `again`."""
    left = np.maximum(exposure - least, 0.0)
    lost = mean * -np.expm1(-left / mean) if mean > 0 else 0.0
    return np.asarray((left - lost) / exposure)
