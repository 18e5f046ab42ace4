"""Spectral lines: frequencies at which the data have more power than the model, with standard errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, special, stats

from .evaluation import Evaluation
from .null_distribution import Null
from .replicates import TOTALS, Replicates

# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
# p-value of a line, with the trials factor of all frequencies: periodic effects are tried only where there is one
_CLEAR = 1e-3
_MOST = 2  # the largest number of lines: each periodic effect is tried at all of them
# bins of the shortest capture: the least distance of two lines; nearer ones are one line that leaks
_APART = 2.5
# bins to each side that are averaged for the model's mean; standard deviations beyond which it has a line itself
_NEIGHBOURS, _OWN = 12, 3.0
# bins to each side that a line leaks into; standard deviations beyond which the bins around are raised
_NEXT, _RAISED = 2, 3.0
# bins of the average of the data, relative to the bin: without those that it leaks into
_AROUND = [d for d in range(-_NEIGHBOURS, _NEIGHBOURS + 1) if abs(d) > _NEXT]
_OTHERS = 2  # the largest neighbouring bins, which may be another line, are left out
# bins to both sides within which the frequency is fitted; grid points, 200 to a bin
_WITHIN, _PLACES = 1.2, 481
# grid points within a standard deviation of the frequency, at least: with 3 the width of a normal law on the grid is
# right within 1e-6. A sharper line has a finer grid, of so many standard deviations and points to both sides
_WITHIN_ERROR, _TO_SIDES, _FINER = 3.0, 6.0, 60
_ZOOMS = 8  # finer grids at most: each is 10 times as fine or more, far beyond the digits of a frequency
_STRENGTHS = np.linspace(0.7, 1.1, 17)  # factors on the amplitude in the data, a part of which is noise
# the least number of periods in the longest capture; with fewer it is a drift, whose powers are those of a line near 0:
# a drift of Z 12.7 had been explained as a flicker of 0.6 periods
_LEAST_PERIODS = 1.5
_SIGN = 2.0  # standard deviations of a bin that informs the frequency: spectra with less are left out of its fit


@dataclass(frozen=True)
class Line:
    """A spectral line.

    Attributes:
        frequency, error: Hz, with its standard deviation.
        log_p: log p-value, with the trials factor of all frequencies.
    """

    frequency: float
    error: float
    log_p: float

    @property
    def p(self) -> float:
        """The p-value, with the trials factor of all frequencies; at least 1e-300."""
        return math.exp(max(self.log_p, -690.0))


@dataclass(frozen=True)
class CaptureSpectrum:
    """The spectrum of one capture.

    Attributes:
        power: (bins,) in the statistic's unit; z: (bins,) residuals.
        surprise: (bins,) -log p.
        step: Hz from bin to bin; the first bin is at `step`.
        dark: the capture has no light.
    """

    power: np.ndarray
    z: np.ndarray
    surprise: np.ndarray
    step: float
    dark: bool

    def bins(self, frequency: np.ndarray) -> np.ndarray:
        """The bin of each frequency, -1 where there is none."""
        k = np.rint(frequency / self.step).astype(np.int64) - 1
        return np.where((k >= 0) & (k < self.z.size), k, -1)


def spectral_lines(replicates: Replicates, evaluation: Evaluation) -> list[Line]:
    """The spectral lines of the data under a model, by p-value.

    The bins at a frequency are combined by the product of their p-values (Fisher's method), because a periodic lamp
    is periodic in every capture.
    """
    spectra = []
    for (id, name), z in evaluation.residuals.items():
        if (id, name) == TOTALS or not evaluation.nulls[id, name].law.spectrum:
            continue
        summary = replicates.seen[id].summaries[name]
        if summary.axis is None or len(z) < 3:
            continue
        step = float(summary.axis[1] - summary.axis[0])
        surprise = _surprise(
            evaluation.nulls[id, name], np.asarray(summary.values, float), z, replicates.seen[id].total
        )
        dark = replicates.seen[id].capture.light.dark
        spectra.append(
            CaptureSpectrum(power=np.asarray(summary.values, float), z=z, surprise=surprise, step=step, dark=dark)
        )
    groups = [[s] for s in spectra]
    lit = [s for s in spectra if not s.dark]
    if len(lit) > 1:
        groups.insert(0, lit)
    found: list[Line] = []
    for group in groups:
        found += _in(group, len(groups))
    kept: list[Line] = []
    for line in sorted(found, key=lambda one: one.log_p):
        apart = _APART * max(s.step for s in spectra)
        if all(abs(line.frequency - other.frequency) > apart for other in kept):
            kept.append(line)
    return kept[:_MOST]


def _surprise(null: Null, power: np.ndarray, z: np.ndarray, total: float) -> np.ndarray:
    """-log p of each bin, (bins,).

    The mean of the model's replicates in a bin is replaced by that of its neighbours, unless the model has a line
    there. Where the data are raised all around, a line must exceed that level: a lamp that fluctuates has no line.
    """
    expected, _ = null.expected(total)
    smooth = ndimage.uniform_filter1d(expected, 2 * _NEIGHBOURS + 1, mode="nearest")
    own = expected > smooth * (1 + _OWN / math.sqrt(null.recordings))
    many = null.recordings * 2 * _NEIGHBOURS
    ratio = power / np.maximum(smooth, 1e-30)
    level, sure = _around(ratio)
    raised = level > 1 + _RAISED / np.sqrt(sure)
    alone = np.where(own, -stats.norm.logsf(z), many * np.log1p(ratio / many))
    beyond = power / np.maximum(np.where(own, expected, smooth), 1e-30) / np.maximum(level, 1.0)
    return np.where(raised, sure * np.log1p(beyond / sure), alone)


def _around(ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(mean of the bins on both sides of each bin without the largest ones, number of bins in it), (bins,) each.

    Of n exponential values the i-th smallest has the mean 1/n + 1/(n - 1) + ... of i terms.
    """
    padded = np.pad(ratio, _NEIGHBOURS, constant_values=np.nan)
    around = np.sort(
        [padded[_NEIGHBOURS + d : _NEIGHBOURS + d + ratio.size] for d in _AROUND], axis=0
    )  # nan are sorted last
    number = np.sum(np.isfinite(around), axis=0)
    kept = np.maximum(number - _OTHERS, 1)
    ratios = np.ones(len(_AROUND) + 1)
    for n in range(_OTHERS + 1, ratios.size):
        ratios[n] = np.cumsum(1 / np.arange(n, _OTHERS, -1.0)).mean()
    total = np.nansum(np.where(np.arange(len(_AROUND))[:, None] < kept, around, 0.0), axis=0)
    return total / kept / ratios[number], kept


def _in(group: Sequence[CaptureSpectrum], groups: int) -> list[Line]:
    """The lines of some spectra together.

    Args:
        groups: the number of such groups, for the trials factor.
    """
    step = min(s.step for s in group)
    grid = step * np.arange(1, max(round(s.z.size * s.step / step) for s in group) + 1)
    total, number = np.zeros(grid.size), np.zeros(grid.size)
    for s in group:
        bins = s.bins(grid)
        total += np.where(bins >= 0, s.surprise[bins], 0.0)
        number += bins >= 0
    tail = stats.gamma.logsf(total, np.maximum(number, 1.0))
    # beyond the range of a double, by the asymptotic exponential tail
    log_p = np.where(np.isfinite(tail), tail, -total) + math.log(grid.size * groups)
    out: list[Line] = []
    for k in np.argsort(log_p)[: 2 * _MOST]:
        if log_p[k] > math.log(_CLEAR):
            break
        line = fitted_line(group, float(grid[k]), float(log_p[k]))
        if line.frequency >= _LEAST_PERIODS * step:
            out.append(line)
    return out


def fitted_line(group: Sequence[CaptureSpectrum], about: float, log_p: float) -> Line:
    """The line at a frequency, fitted by the likelihood of the powers about it in all spectra that show it."""
    step = min(s.step for s in group)
    cells = [(s, int(s.bins(np.array([about]))[0])) for s in group]
    cells = [(s, cell) for s, cell in cells if cell >= 0 and s.z[cell] >= _SIGN]
    if not cells:
        return Line(about, step, log_p)
    grid = about + step * np.linspace(-_WITHIN, _WITHIN, _PLACES)
    mean = error = 0.0
    for _ in range(_ZOOMS):
        grid = grid[grid > 0]
        total = sum(_likelihood(s.power, cell, grid / s.step) for s, cell in cells)
        weights = np.exp(total - np.max(total))
        mean = float(np.average(grid, weights=weights))
        error = float(np.sqrt(np.average((grid - mean) ** 2, weights=weights)))
        apart = float(grid[1] - grid[0])
        if error > _WITHIN_ERROR * apart:
            break
        half = _TO_SIDES * max(error, apart)
        grid = grid[int(np.argmax(weights))] + half * np.linspace(-1.0, 1.0, 2 * _FINER + 1)
    return Line(mean, error, log_p)


def _likelihood(power: np.ndarray, cell: int, places: np.ndarray) -> np.ndarray:
    """The log-likelihood of the powers about a bin, (places,), for the best line at each place.

    A line leaks into the neighbouring bins with the amplitude sin(pi x) / (pi x) of its distance x. Noise has a mean
    power of 1; a power to which a line adds S is distributed as exp(-P - S) I0(2 sqrt(P S)) (Rice, Bell Syst. Tech.
    J. 24 (1945) 46).
    """
    cells = np.arange(max(cell - _NEXT, 0), min(cell + _NEXT + 1, power.size))
    seen = np.sqrt(power[cells])
    leak = np.abs(np.sinc(places[:, None] - (cells + 1)))
    suits = (leak @ seen) / (leak**2).sum(axis=1)
    best = np.full(places.size, -np.inf)
    for factor in _STRENGTHS:
        amplitude = factor * suits[:, None] * leak
        x = 2 * seen * amplitude
        value = (np.log(special.i0e(x)) + x - amplitude**2).sum(axis=1)
        best = np.maximum(best, value)
    return best
