"""Patterns and pixels that differ at random, in one mixed model."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from spadmnist.inference.mixed_model import (
    NO_PATTERN,
    PatternEvidence,
    _log_likelihood,
    evidence_of_patterns,
    evidence_of_scene,
)
from spadmnist.inference.pixel_maps import PixelMap
from spadmnist.inference.pixel_maps import evidence_of_patterns as in_a_map

SIDE, NOISE = 16, 0.004
N = SIDE**2
DOWN = np.repeat(np.linspace(-0.5, 0.5, SIDE), SIDE)
ALONG = np.tile(np.linspace(-0.5, 0.5, SIDE), SIDE)
GRADIENT = np.stack([ALONG, DOWN, ALONG**2 + DOWN**2], axis=1)
ROWS = np.repeat(np.arange(SIDE), SIDE)
PATTERNS = {"gradient": GRADIENT, "rows": ROWS, "columns": np.tile(np.arange(SIDE), SIDE)}


def told(rng: np.random.Generator, light: np.ndarray, spread: float = 0.0) -> dict[str, PatternEvidence]:
    raw = np.log(light) + spread * rng.standard_normal(N) + NOISE * rng.standard_normal(N)
    raw[[5, 100]] = [-3.0, 2.0]  # odd pixels make no pattern
    error = np.full(N, NOISE)
    return in_a_map(PixelMap(("a", "b"), 1.0, np.arange(N), raw, error, raw, error, 0.01), PATTERNS)


@pytest.mark.parametrize("slope", [0.02, 0.25])
@pytest.mark.parametrize("spread", [0.0, 0.01])
def test_a_gradient_is_a_gradient_and_no_pattern_of_rows(slope: float, spread: float) -> None:
    """However clear it is, and where pixels differ as well: evidence of a fixed seed, beside 0 within a few."""
    rng = np.random.default_rng(8)
    found = told(rng, 1 + slope * DOWN, spread)
    assert found["gradient"].beside > 20 and found["gradient"].beside > found["rows"].beside + 5
    assert found["columns"].beside < 6
    found = told(rng, 1 + slope * rng.standard_normal(SIDE)[ROWS] / 3, spread)
    assert found["rows"].beside > 12 and found["rows"].beside > found["gradient"].beside + 5


def test_what_chance_has_of_patterns_has_no_evidence() -> None:
    """Of 100 maps whose pixels differ, none has evidence of 12 for a pattern: 18 in chi square, 3 numbers (4e-4)."""
    rng = np.random.default_rng(5)
    found = [told(rng, np.ones(N), 0.05) for _ in range(100)]
    for name in PATTERNS:
        evidence = np.array([one[name].beside for one in found])
        assert evidence.max() < 12 and np.mean(evidence) < 0, name
        # over pixels that are all alike it has some of what differs, and far less than pixels that differ
        alone, pixels = (np.array([getattr(one[name], of) for one in found]) for of in ("alone", "pixels"))
        assert np.median(alone) > 12 and np.all(alone < 0.9 * pixels), name


def test_the_likelihood_is_that_of_the_normal_law() -> None:
    """The covariance is never made; here it is, of 12 pixels in 3 groups."""
    rng = np.random.default_rng(2)
    groups, variance, of_group = np.arange(12) % 3, rng.uniform(0.5, 2.0, 12), 0.7
    y, design = rng.standard_normal(12), np.stack([np.ones(12), rng.standard_normal(12)], axis=1)
    covariance = np.diag(variance) + of_group * (groups[:, None] == groups)
    inverse = np.linalg.inv(covariance)
    coefficients = np.linalg.solve(design.T @ inverse @ design, design.T @ inverse @ y)
    expected = stats.multivariate_normal(design @ coefficients, covariance).logpdf(y) + 6 * math.log(2 * math.pi)
    assert _log_likelihood(y, variance, design, groups, of_group) == pytest.approx(expected, rel=1e-9)
    alone = stats.norm(0, np.sqrt(variance)).logpdf(y - y @ (1 / variance) / (1 / variance).sum()).sum()
    alone += 6 * math.log(2 * math.pi)
    assert _log_likelihood(y, variance, np.ones((12, 1)), None, 0.0) == pytest.approx(alone, rel=1e-9)


def test_groups_of_one_pixel_are_the_map_itself() -> None:
    y, error = np.arange(5.0), np.ones(5)
    found = evidence_of_patterns(y, error, {"each": np.arange(5), "two": np.arange(5) % 2})
    assert found["each"] is NO_PATTERN and math.isfinite(found["two"].beside)
    assert evidence_of_patterns(y[:2], error[:2], {"two": np.arange(2)}) == {"two": NO_PATTERN}


def test_what_a_scene_takes_from_residuals_is_beyond_what_it_leaves() -> None:
    """p-values of what is chance are even from 0 to 1, and two odd pixels do not hide what is there."""
    rng = np.random.Generator(np.random.PCG64(3))
    known = np.stack([rng.exponential(100.0, 200), rng.exponential(30.0, 200)])
    slopes = np.sqrt(known)
    shape = slopes + rng.standard_normal((2, 200))  # most where the pixels scatter most
    chances = []
    for _ in range(400):
        z = rng.standard_normal((2, 200)) + slopes * 0.3 * rng.standard_normal(200)
        wide = np.linalg.inv(np.eye(2) + 0.09 * slopes.T[:, :, None] * slopes.T[:, None, :])
        times = np.einsum("cp,pcd,dp", shape, wide, z) / np.einsum("cp,pcd,dp", shape, wide, shape)
        evidence = evidence_of_scene(z, z - times * shape, known, 0.3, 1).beside
        chances.append(stats.f.sf(evidence + 2, 1, 399))
    # by Kolmogorov's law, below 2.7 / sqrt(400) but for once in a million times
    assert np.max(np.abs(np.sort(chances) - (np.arange(400) + 0.5) / 400)) < 2.7 / 20
    odd = np.where(np.arange(200) < 2, 500.0, 0.0)
    z = rng.standard_normal((2, 200)) + slopes * 0.3 * rng.standard_normal(200)
    assert evidence_of_scene(z + 0.3 * shape + odd, z + odd, known, 0.3, 1).beside > 12
    assert evidence_of_scene(np.ones((1, 2)), np.ones((1, 2)), np.ones((1, 2)), 0.3, 2) is NO_PATTERN
