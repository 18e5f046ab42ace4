"""Patterns of all cells that are tested by themselves: a drift of the light is lost in a sum of squares."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from labs import bench_of, labs
from scipy import stats

from spadmnist.inference.evaluation import block_checks, evaluate
from spadmnist.inference.null_distribution import Null, learn
from spadmnist.inference.replicates import no_size
from spadmnist.statistics import Summary
from spadmnist.statistics.slow import slow_courses

BLOCKS, REPLICATES = 32, 32
COURSES = slow_courses(BLOCKS)


def null_of(
    rng: np.random.Generator, swing: float, contrasts: np.ndarray | None = COURSES, replicates: int = REPLICATES
) -> Null:
    """The null distribution of a trend whose rise scatters by itself. swing: standard deviations of a cell."""
    values = drawn(rng, swing, replicates)
    own = [Summary(v, "normal", str, no_size, np.ones(BLOCKS)) for v in values]
    return learn(own, 1e6 * (1 + 0.03 * np.linspace(-1, 1, replicates)), contrasts)


def drawn(rng: np.random.Generator, swing: float, number: int) -> np.ndarray:
    """(number, blocks) scores of captures."""
    return rng.standard_normal((number, BLOCKS)) + swing * rng.standard_normal((number, 1)) * COURSES[0]


def test_the_courses_are_orthonormal_and_have_no_mean() -> None:
    for blocks in (16, 32):
        courses = slow_courses(blocks)
        assert courses.shape == (3, blocks)
        np.testing.assert_allclose(courses @ courses.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(courses.sum(axis=1), 0.0, atol=1e-12)
        assert np.all(np.diff(np.abs(np.diff(courses[0]))) < 1e-12)  # a rise


@pytest.mark.parametrize(
    ("swing", "replicates"), [(0.0, 32), (0.7, 32), (4.0, 32), (4.0, 96)], ids=["steady", "a little", "much", "with 96"]
)
def test_p_values_of_a_right_model_are_uniform_or_larger(swing: float, replicates: int) -> None:
    """Also where the light of each capture drifts by itself, and totals vary. False-alarm rate 1e-6."""
    rng = np.random.Generator(np.random.PCG64(3))
    ps = [null_of(rng, swing, replicates=replicates).judge(drawn(rng, swing, 1)[0], 1e6).p_value for _ in range(3000)]
    for bound in (0.5, 0.1, 0.01, 1e-3, 1e-4):
        few = int(np.sum(np.array(ps) < bound))
        assert stats.binom.sf(few - 1, len(ps), bound) > 1e-6, (bound, few)


def test_a_drift_that_no_block_shows_is_found() -> None:
    """A rise of 7 standard deviations: most captures fail at 1e-4, of which most pass without the contrasts."""
    rng = np.random.Generator(np.random.PCG64(4))
    found, missed, ends = 0, 0, 0
    for _ in range(100):
        z = drawn(rng, 0.0, 1)[0] + 7.0 * COURSES[0]
        judged = null_of(rng, 0.0).judge(z, 1e6)
        found += judged.p_value < 1e-4
        missed += null_of(rng, 0.0, None).judge(z, 1e6).p_value > 1e-4
        if judged.p_value < 1e-4:
            ends += judged.worst < 8 or judged.worst >= 24
    # a rise is clearest at an end
    assert found >= 80 and missed >= 50 and ends > 0.85 * found, (found, missed, ends)


@pytest.mark.parametrize(("slope", "fails"), [(0.0, False), (-0.09, True)])
def test_a_drift_of_the_light_fails_in_the_trend(tmp_path: Path, slope: float, fails: bool) -> None:
    """Of 7 standard deviations. The model has no drift."""
    replicates = bench_of(labs(tmp_path)(f"    source_drift: {{slope: {slope}}}\n", light=900), 32)
    evaluation = evaluate(replicates, {})
    by_cell = {block.cell: block.p for block in block_checks(replicates, evaluation, evaluation.residuals)}
    assert (by_cell["flat", "trend"] < 1e-4) is fails
    assert replicates.seen["flat"].total == pytest.approx(72_750, rel=0.01)  # 0.09 sqrt(72,750 / 12) = 7.0
