"""Patterns and pixels that differ at random, in one mixed model."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from spadmnist.inference.mixed_model import (
    NO_PATTERN,
    PatternEvidence,
    evidence_of_patterns,
    evidence_of_scene,
    log_likelihood_of_values,
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
    assert found["gradient"].given_pixels > 20 and found["gradient"].given_pixels > found["rows"].given_pixels + 5
    assert found["columns"].given_pixels < 6
    found = told(rng, 1 + slope * rng.standard_normal(SIDE)[ROWS] / 3, spread)
    assert found["rows"].given_pixels > 12 and found["rows"].given_pixels > found["gradient"].given_pixels + 5


@pytest.mark.slow
def test_what_chance_has_of_patterns_has_no_evidence() -> None:
    """Of 100 maps whose pixels differ, none has evidence of 12 for a pattern: 18 in chi square, 3 numbers (4e-4)."""
    rng = np.random.default_rng(5)
    found = [told(rng, np.ones(N), 0.05) for _ in range(100)]
    for name in PATTERNS:
        evidence = np.array([one[name].given_pixels for one in found])
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
    assert log_likelihood_of_values(y, variance, design, groups, of_group) == pytest.approx(expected, rel=1e-9)
    alone = stats.norm(0, np.sqrt(variance)).logpdf(y - y @ (1 / variance) / (1 / variance).sum()).sum()
    alone += 6 * math.log(2 * math.pi)
    assert log_likelihood_of_values(y, variance, np.ones((12, 1)), None, 0.0) == pytest.approx(alone, rel=1e-9)


def test_what_is_no_pattern_has_no_evidence() -> None:
    """One group, groups of a pixel each, shapes that are constant, and as many shapes as pixels."""
    y, error = np.arange(8.0), np.ones(8)
    none = {"each": np.arange(8), "one": np.zeros(8, int), "even": np.ones((8, 2)), "many": np.eye(8)[:, 1:]}
    found = evidence_of_patterns(y, error, {**none, "two": np.arange(8) % 2})
    assert all(found[name] is NO_PATTERN for name in none) and math.isfinite(found["two"].given_pixels)
    assert evidence_of_patterns(y[:2], error[:2], {"two": np.arange(2)}) == {"two": NO_PATTERN}


def test_the_unit_of_a_shape_does_not_matter() -> None:
    """Nor do shapes that say the same twice, nor a pixel of which nothing is known."""
    rng = np.random.default_rng(1)
    y, error = 1 + 0.05 * DOWN + NOISE * rng.standard_normal(N), np.full(N, NOISE)
    units = np.array([1e8, 1e-8, 1.0])
    shapes = {"as it is": GRADIENT, "scaled": GRADIENT * units, "twice": np.hstack([GRADIENT, 3 * GRADIENT])}
    found = evidence_of_patterns(y, error, shapes)
    assert found["as it is"].given_pixels > 100
    for name in shapes:
        assert found[name].given_pixels == pytest.approx(found["as it is"].given_pixels, abs=1e-3), name
    y[3], error[3] = 1e9, math.inf
    assert evidence_of_patterns(y, error, shapes)["scaled"].given_pixels == pytest.approx(
        found["scaled"].given_pixels, rel=0.05
    )


@pytest.mark.parametrize("shape", [(1, 4), (2, 2), (2, 3), (3, 3)])
def test_few_pixels_are_no_gradient_by_chance(shape: tuple[int, int]) -> None:
    """Of 200 arrays 12 in chi square are for a gradient in at most 4, which is one in a hundred and two sigma."""
    rng = np.random.default_rng(6)
    down, along = (x.ravel() / 4 for x in np.indices(shape))
    gradient = np.stack([along, down, along**2 + down**2], axis=1)
    values = 1 + 0.05 * rng.standard_normal((200, down.size))
    found = [evidence_of_patterns(y, np.full(y.size, NOISE), {"it": gradient})["it"].given_pixels for y in values]
    assert sum(one >= 12 for one in found) <= 4


def test_a_pattern_of_few_counts_is_not_cut_off() -> None:
    """Most pixels have none, so that most of them are alike: their noise says how far the others are from them."""
    rng = np.random.default_rng(4)
    counts = rng.poisson(np.where(ROWS % 4 == 0, 1.5, 0.2)).astype(float)
    found = evidence_of_patterns(counts, np.full(N, math.sqrt(counts.mean())), {"rows": ROWS})
    assert found["rows"].given_pixels > 12


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
        evidence = evidence_of_scene(z, z - times * shape, known, 0.3, 1).given_pixels
        chances.append(stats.f.sf(evidence + 2, 1, 399))
    # by Kolmogorov's law, below 2.7 / sqrt(400) but for once in a million times
    assert np.max(np.abs(np.sort(chances) - (np.arange(400) + 0.5) / 400)) < 2.7 / 20
    odd = np.where(np.arange(200) < 2, 500.0, 0.0)
    z = rng.standard_normal((2, 200)) + slopes * 0.3 * rng.standard_normal(200)
    assert evidence_of_scene(z + 0.3 * shape + odd, z + odd, known, 0.3, 1).given_pixels > 12
    assert evidence_of_scene(np.ones((1, 2)), np.ones((1, 2)), np.ones((1, 2)), 0.3, 2) is NO_PATTERN
