"""Patterns of all cells that are tested by themselves: a drift of the light is lost in a sum of squares."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from labs import PHOTON, bench_of, labs
from scipy import stats

import spadmnist as sp
from spadmnist.inference.captures_together import Together, checks_together
from spadmnist.inference.checks import block_checks
from spadmnist.inference.evaluation import evaluate
from spadmnist.inference.null_distribution import Null, learn
from spadmnist.inference.replicates import no_size
from spadmnist.sensor import Sensor
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


@pytest.mark.slow
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
    by_cell = {block.cell: block for block in block_checks(replicates, evaluation, evaluation.residuals)}
    block = by_cell["flat", "trend"]
    assert (block.p < 1e-4) is fails
    if fails:
        summary = replicates.seen["flat"].summaries["trend"]
        assert summary.place(block.worst, block.contrast).startswith("a rise or a fall over the capture, clearest in ")
    assert replicates.seen["flat"].total == pytest.approx(72_750, rel=0.01)  # 0.09 sqrt(72,750 / 12) = 7.0


def together(rng: np.random.Generator, rise: float, swing: float = 0.0) -> tuple[Together, float]:
    """(the check of the contrasts of five captures of unlike length, the least p-value of one by itself)."""
    nulls, own, z, seen = {}, {}, {}, {}
    for k in range(5):
        cell = (f"flat-{k}", "trend")
        nulls[cell] = null_of(rng, swing)
        own[cell] = drawn(rng, swing, REPLICATES)
        z[cell] = drawn(rng, swing, 1)[0] + rise * COURSES[0]
        summaries = {"trend": SimpleNamespace(axis=np.arange(BLOCKS) * (k + 1.0))}
        seen[cell[0]] = SimpleNamespace(total=1e5 + k, summaries=summaries)
    evaluation = SimpleNamespace(nulls=nulls, replicate_residuals=own, once=lambda name, make: make())
    alone = {cell: nulls[cell].p_value(x)[0] for cell, x in z.items()}
    found = checks_together(SimpleNamespace(seen=seen), evaluation, z, alone)  # type: ignore[arg-type]
    assert len(found) == 2 and {check.cell for check in found} == {("flat-4", "trend")}
    return next(check for check in found if check.alike), min(alone.values())


def test_a_drift_that_no_capture_shows_is_found_in_all_together() -> None:
    """A rise of 3 standard deviations in each of five captures, of other lengths: 6.7 together."""
    rng = np.random.Generator(np.random.PCG64(6))
    found = [together(rng, 3.0) for _ in range(40)]
    assert sum(check.p < 1e-4 for check, _ in found) > 30 > 2 > sum(least < 1e-4 for _, least in found)
    assert all(check.words == ", alike in 5 captures" for check, _ in found if check.p < 1e-4 and len(check.cells) == 5)


@pytest.mark.slow
@pytest.mark.parametrize("swing", [0.0, 4.0], ids=["steady", "fluctuating"])
def test_right_models_pass_together(swing: float) -> None:
    """False-alarm rate 1e-6."""
    rng = np.random.Generator(np.random.PCG64(7))
    ps = np.array([together(rng, 0.0, swing)[0].p for _ in range(600)])
    for bound in (0.5, 0.1, 0.01, 1e-3):
        few = int(np.sum(ps < bound))
        assert stats.binom.sf(few - 1, len(ps), bound) > 1e-6, (bound, few)


def test_a_drift_in_captures_with_other_numbers_of_blocks() -> None:
    """Captures of 100 and 110 frames have 16 blocks, that of 200 has 32; all are one check."""
    listed = [sp.effects.Detection(pdp=0.5), sp.effects.DeadTime(duration=50e-9), sp.effects.DarkCounts(rate=100.0)]
    layout = sp.Layout(16, 16, 25e-12, 1.0)
    drifts = Sensor(layout, [*listed, sp.effects.SourceDrift(slope=0.06)], rules="device")
    captures = [
        sp.Capture(
            f"{n} frames", "qis", wavelength=500e-9, irradiance=light * PHOTON / 25e-12, frames=n, frame_time=2e-6,
            frame_period=2e-6, relative_uncertainty=0.05,
        )
        for n, light in ((100, 4e4), (200, 2e5), (110, 4e4))
    ]  # fmt: skip
    found = sp.compare(Sensor(layout, listed, rules="device"), sp.simulate(drifts, captures, seed=3), jobs=1)
    (one,) = [check for check in found.checks if "a rise or a fall" in check.where and "alike in 3" in check.where]
    assert one.capture == "200 frames" and 0 < abs(one.relative) < 0.3
