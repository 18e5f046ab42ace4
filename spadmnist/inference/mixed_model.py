"""Pixels that differ at random and patterns over the array, in one linear mixed model.

    y = mu + X b + u_group + u_pixel + e

y: the light that each pixel sees or detects, relative to the others; X: shapes of a pattern with fixed coefficients b;
u_group: one random effect for each row or column; u_pixel: one for each pixel; e: noise of known variance. The
variances of the random effects and b are those of maximum likelihood. So patterns are compared with each other, and
with pixels that differ in addition, by one evidence: twice the log-likelihood ratio less two for each parameter.
Source: Laird and Ware, Biometrics 38 (1982) 963; Akaike, IEEE Trans. Autom. Control 19 (1974) 716.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from .levels import OPTIMISM_OF_A_PARAMETER

# standard deviations from most pixels at which a value is cut off: odd pixels make no pattern; a rule of thumb
_FAR_OFF = 4.0
# of the noise: the least standard deviation of a random effect, which is none; any far below 1 does
_LEAST = 1e-3
# of the spread of all values: standard deviations of a group at which a search starts; rules of thumb
_STARTS = (0.1, 1.0)
_ROUNDING = 1e-9  # relative: smaller differences of a shape are those of rounding; any well above 1e-16 does
_SEARCH = {"xatol": 0.01, "fatol": 0.01, "maxiter": 100}  # of a logarithm, of a log-likelihood: they decide nothing
_LEAST_PIXELS = 3  # fewer have no pattern: a mean and a difference take two


@dataclass(frozen=True)
class PatternEvidence:
    """The evidence for a pattern, in chi square.

    Attributes:
        given_pixels: of pattern and random differences of the pixels, relative to these differences alone.
        alone: of the pattern, relative to equal pixels.
        pixels: of random differences of the pixels, relative to equal pixels.
    """

    given_pixels: float
    alone: float
    pixels: float


# plain meaning: no evidence, where a pattern cannot be judged; any other is more
NO_PATTERN = PatternEvidence(-math.inf, -math.inf, 0.0)


def _clipped(y: np.ndarray, noise: float) -> np.ndarray:
    """The values, those far from most of them cut off, by their scatter or by their noise."""
    middle = float(np.median(y))
    width = max(1.4826 * float(np.median(np.abs(y - middle))), noise)
    return np.clip(y, middle - _FAR_OFF * width, middle + _FAR_OFF * width)


def evidence_of_patterns(
    y: np.ndarray, error: np.ndarray, patterns: Mapping[str, np.ndarray]
) -> dict[str, PatternEvidence]:
    """The evidence for each of some patterns in the values of pixels, by name.

    Args:
        y: (pixels,) relative values, odd ones included.
        error: (pixels,) standard deviation of their noise.
        patterns: (pixels, shapes) of float, with fixed coefficients, without the mean; or (pixels,) of int, the group
            of each pixel, with a random effect for each group.
    """
    known = np.isfinite(error)
    y, error = y[known], np.maximum(error[known], 1e-12)
    if y.size < _LEAST_PIXELS:
        return dict.fromkeys(patterns, NO_PATTERN)
    y, noise = _clipped(y, float(np.median(error))), error**2
    ones = np.ones((y.size, 1))
    nothing, differ = (_most_likely(y, noise, ones, None, pixels) for pixels in (False, True))
    out = {}
    for name, pattern in patterns.items():
        groups, design, number = None, ones, 1
        if pattern.ndim == 1:
            groups = np.unique(pattern[known], return_inverse=True)[1]
            sizes = np.bincount(groups)
            if sizes.size < 2 or sizes.max() == 1:
                out[name] = NO_PATTERN  # of one group, or of each pixel: no differences, or the map itself
                continue
        else:
            design = np.hstack([ones, _orthonormal(pattern[known])])
            number = design.shape[1] - 1
        free = y.size - number - 2
        if number == 0 or free < 1:
            out[name] = NO_PATTERN
            continue
        # of few pixels: Hurvich and Tsai, Biometrika 76 (1989) 297
        price = OPTIMISM_OF_A_PARAMETER * number * y.size / free
        alone, both = (_most_likely(y, noise, design, groups, pixels) for pixels in (False, True))
        out[name] = PatternEvidence(
            2 * (both - differ) - price, 2 * (alone - nothing) - price, 2 * (differ - nothing) - OPTIMISM_OF_A_PARAMETER
        )
    return out


def _orthonormal(shapes: np.ndarray) -> np.ndarray:
    """Columns that span the same differences of pixels, each of mean 0 and mean square 1, whatever their units."""
    apart = shapes - shapes.mean(axis=0)
    largest = np.abs(apart).max(axis=0)
    apart = apart[:, largest > _ROUNDING * np.abs(shapes).max(axis=0)]
    if not apart.size:
        return np.zeros((len(shapes), 0))
    columns, sizes, _ = np.linalg.svd(apart / np.abs(apart).max(axis=0), full_matrices=False)
    return np.asarray(columns[:, sizes > _ROUNDING * sizes[0]] * math.sqrt(len(shapes)))


def evidence_of_scene(
    before: np.ndarray, after: np.ndarray, information: np.ndarray, sigma: float, parameters: int
) -> PatternEvidence:
    """The evidence for what changes the scene, by what its parameters take from the residuals of pixels.

    Its effect on a pixel depends on the scene around it, so that no shape over the array stands for it. Pixels that
    differ by themselves, by `sigma`, are a random effect, for which the residuals are whitened; the scatter of what is
    left is the noise.

    Args:
        before, after: (captures, pixels) residuals without and with the parameters.
        information: (captures, pixels) squared slope of a residual on the logarithm of its pixel's value.
        sigma: standard deviation of a logarithm.
        parameters: their number.
    """
    z, left = (_whitened(x, np.sqrt(information), sigma).ravel() for x in (before, after))
    if z.size <= parameters:
        return NO_PATTERN
    middle = float(np.median(z))
    far = _FAR_OFF * max(1.4826 * float(np.median(np.abs(z - middle))), 1.0)
    z, left = (np.clip(x, middle - far, middle + far) for x in (z, left))
    square = max(float(left @ left), 1e-30)
    fall = (float(z @ z) - square) / (square / (z.size - parameters))
    return PatternEvidence(fall - OPTIMISM_OF_A_PARAMETER * parameters, -math.inf, 0.0)


def _whitened(z: np.ndarray, sensitivity: np.ndarray, sigma: float) -> np.ndarray:
    """(captures, pixels) residuals of unit variance, independent although each pixel differs by `sigma`."""
    square = (sensitivity**2).sum(axis=0)
    projection = (sensitivity * z).sum(axis=0) / np.maximum(square, 1e-300)
    return np.asarray(z - sensitivity * projection * (1 - 1 / np.sqrt(1 + sigma**2 * square)))


def _most_likely(
    y: np.ndarray, noise: np.ndarray, design: np.ndarray, groups: np.ndarray | None, pixels: bool
) -> float:
    """The largest log-likelihood over the variances of the random effects, and over the fixed coefficients.

    Args:
        noise: (pixels,) variances.
        design: (pixels, k) with the mean.
        groups: (pixels,) of int, with random effects; None without.
        pixels: with a random effect of each pixel.
    """
    spread = max(float(np.std(y)), 1e-12)
    low = math.log(_LEAST * math.sqrt(float(np.median(noise))))
    high = math.log(2 * spread + math.exp(low))
    free = pixels + (groups is not None)

    def cost(logs: np.ndarray) -> float:
        variances = [math.exp(2 * min(max(float(x), low), high)) for x in logs]
        of_pixel = variances.pop(0) if pixels else 0.0
        return -log_likelihood_of_values(y, noise + of_pixel, design, groups, variances.pop() if variances else 0.0)

    if not free:
        return -cost(np.zeros(0))
    if free == 1:
        grid = np.linspace(low, high, 25)
        best = grid[int(np.argmin([cost(np.array([x])) for x in grid]))]
        ends = best - (grid[1] - grid[0]), best + (grid[1] - grid[0])
        found = optimize.minimize_scalar(lambda x: cost(np.array([x])), bounds=ends, method="bounded")
        return -float(min(found.fun, cost(np.array([low]))))
    falls = [
        optimize.minimize(cost, np.log([spread, start * spread]), method="Nelder-Mead", options=_SEARCH)
        for start in _STARTS
    ]
    # without either effect, too: no search ends at a bound
    edges = [_most_likely(y, noise, design, groups, False), _most_likely(y, noise, design, None, True)]
    return max([-float(found.fun) for found in falls] + edges)


def log_likelihood_of_values(
    y: np.ndarray, variance: np.ndarray, design: np.ndarray, groups: np.ndarray | None, of_group: float
) -> float:
    """The log-likelihood at the best fixed coefficients, up to a constant.

    Args:
        variance: (pixels,) of noise and pixels together.
        of_group: variance of the random effect of a group.
    """
    which = np.zeros(y.size, np.int64) if groups is None else groups
    precision = np.bincount(which, 1 / variance)
    shrink = of_group / (1 + of_group * precision)

    def weighed(x: np.ndarray) -> np.ndarray:
        """The inverse covariance times the columns, (pixels, columns)."""
        scaled = x / variance[:, None]
        if groups is None:
            return scaled
        sums = np.stack([np.bincount(which, column, precision.size) for column in scaled.T], axis=1)
        return np.asarray(scaled - (shrink[:, None] * sums)[which] / variance[:, None])

    of_design = weighed(design)
    coefficients = np.linalg.lstsq(design.T @ of_design, of_design.T @ y, rcond=None)[0]
    left = y - design @ coefficients
    determinant = float(np.log(variance).sum() + np.log1p(of_group * precision).sum() * (groups is not None))
    return -0.5 * (determinant + float(left @ weighed(left[:, None])[:, 0]))
