"""Goodness of fit is one thing: the totals and the light have the same tests in `compare` and in `diagnose`."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import laws
import numpy as np
import pytest
from scipy import stats

import spadmnist as sp
from spadmnist.inference import comparison
from spadmnist.inference.checks import LIGHT, block_checks
from spadmnist.inference.evaluation import evaluate, misfits
from spadmnist.inference.findings import remainder
from spadmnist.inference.next_step import after_comparison
from spadmnist.inference.null_distribution import learn, replicate_residuals
from spadmnist.inference.replicates import TOTALS, Execution, Replicates
from spadmnist.inference.score_test import score_test
from spadmnist.inference.totals_tests import along
from spadmnist.inference.upper_limits import linear_limit
from spadmnist.statistics import Summary
from spadmnist.workers import Serial

CELL = ("flat", "map")
EFFECTS = [
    sp.effects.Detection(pdp=0.4),
    sp.effects.DarkCounts(rate=100.0),
    sp.effects.DeadTime(duration=50e-9),
]
SENSOR = sp.Sensor(sp.Layout(2, 4, 25e-12, 1.0), EFFECTS, rules="device")


def measured(off: dict[int, float], uncertain: list[float], seed: int = 1, frames: int = 400) -> sp.Measurement:
    """Flat fields whose light is off by these parts, known to these uncertainties, and a dark capture."""

    def plan(factor: Any) -> list[sp.Capture]:
        def lit(k: int) -> dict[str, Any]:
            return {"irradiance": 4e-3 * (1 + 0.05 * k) * factor(k), "relative_uncertainty": uncertain[k]}

        clock: dict[str, Any] = {"frames": frames, "frame_time": 10e-6}
        flat = [sp.Capture(f"c{k}", "qis", wavelength=500e-9, **lit(k), **clock) for k in range(len(uncertain))]
        return [*flat, sp.Capture("dark", "qis", dark=True, **clock)]

    made = sp.simulate(SENSOR, plan(lambda k: 1 + off.get(k, 0.0)), seed=seed)
    return sp.Measurement.from_arrays(SENSOR.layout, {c: made[c.id].frames for c in plan(lambda k: 1.0)})


@pytest.mark.parametrize("uncertain", [[0.0, 0.0, 0.0], [0.05, 0.05, 0.05], [0.05, 0.02, 0.0]])
def test_the_totals_have_the_same_p_values_in_both_verbs(uncertain: list[float]) -> None:
    replicates = Replicates(SENSOR, measured({0: 0.03, 1: 0.01}, uncertain), 0, Execution(Serial()), 24)
    evaluation = evaluate(replicates, {})
    blocks = {block.cell: block for block in block_checks(replicates, evaluation, evaluation.residuals)}
    checks = comparison.comparison_of(replicates, evaluation).checks
    light = next(check for check in checks if check.statistic == "light")
    assert blocks[LIGHT].p == pytest.approx(light.p_value, rel=1e-6)
    for k in range(3):
        (own,) = (check for check in checks if check.statistic == "rate" and check.capture == f"c{k}")
        assert blocks["", f"rate {k}"].p == pytest.approx(own.p_value, rel=1e-6)
        assert np.sign(blocks["", f"rate {k}"].z) == np.sign(own.relative)


def test_the_capture_that_is_off_is_named() -> None:
    """Of light that all share, the first one is off: the others agree with each other, wherever they stand."""
    replicates = Replicates(SENSOR, measured({0: 0.12}, [0.05] * 4), 0, Execution(Serial()), 24)
    evaluation = evaluate(replicates, {})
    found = [entry for entry in remainder(replicates, evaluation, evaluation.residuals) if entry["statistic"] == "rate"]
    assert found and max(found, key=lambda entry: entry["significance"])["capture"] == "c0"


def test_the_order_of_the_captures_is_of_no_account() -> None:
    rng = np.random.default_rng(1)
    error, shared, x = rng.uniform(0.5, 2, 5), rng.uniform(1, 3, 5), rng.standard_normal(5) * 4
    found = []
    for order in ([0, 1, 2, 3, 4], [3, 1, 4, 0, 2]):
        covariance = np.diag(error[order] ** 2) + np.outer(shared[order], shared[order])
        root = np.linalg.inv(np.linalg.cholesky(covariance))
        tests = along(root, root @ x[order], np.eye(5), error[order], np.full(5, 30.0))
        found.append(dict(zip(order, tests, strict=True)))
    for k in range(5):
        assert found[0][k] == pytest.approx(found[1][k], rel=1e-9)
    # the first capture, given the others, by the textbook
    joint = np.diag(error**2) + np.outer(shared, shared)
    mean = joint[0, 1:] @ np.linalg.solve(joint[1:, 1:], x[1:])
    variance = joint[0, 0] - joint[0, 1:] @ np.linalg.solve(joint[1:, 1:], joint[1:, 0])
    assert found[0][0][0] == pytest.approx((x[0] - mean) / np.sqrt(variance), rel=1e-9)


def test_errors_that_are_estimates_have_the_tails_of_students_law() -> None:
    """Scatters of 16 replicates: of 200,000 right totals 60 have p < 3e-4; by the normal law it would be 600."""
    rng = np.random.default_rng(2)
    many, freedom = 200_000, 14
    scatter = np.sqrt(rng.chisquare(freedom, many) / freedom)
    z = rng.standard_normal(many) / scatter
    # the law depends on z alone: p of a grid, interpolated
    grid = np.linspace(0, 12, 200)
    root, one = np.ones((1, 1)), np.ones(1)
    p = [along(root, np.array([x]), np.eye(1), one, np.array([float(freedom)]))[0][1] for x in grid]
    alarms = int(np.sum(np.interp(np.abs(z), grid, p) < 3e-4))
    low, high = stats.binom.isf([1 - laws.FALSE_ALARM, laws.FALSE_ALARM], many, 3e-4)
    assert low <= alarms <= high
    assert along(root, np.array([4.0]), np.eye(1), 0 * one, one)[0][1] == pytest.approx(2 * stats.norm.sf(4))


def test_the_misfit_of_right_models_is_one() -> None:
    """Of a statistic whose scatter the replicates give: the mean over 150 models, each with data of its own."""
    rng = np.random.default_rng(3)

    def summary(values: np.ndarray) -> Summary:
        return Summary(values, "normal", str, lambda *_: ("", 0.0))

    found = []
    for _ in range(150):
        values, totals = rng.standard_normal((16, 200)), rng.normal(1000, 30, 17)
        null = learn([summary(x) for x in values], totals[:16])
        made: Any = SimpleNamespace(totals=totals[:16])
        expected, leverage = null.expected(float(totals[16]))
        z = null.residuals(rng.standard_normal(200), expected, leverage)
        found.append(misfits({CELL: replicate_residuals(null, made, values)}, {CELL: z})[CELL])
    error = np.std(found) / np.sqrt(len(found))
    # it was 1.14, and half of the right models lay above the 95 % point
    assert abs(np.mean(found) - 1) < 5 * error and error < 0.009


@pytest.mark.parametrize("correlation", [0.8, -0.3])
def test_a_limit_beside_a_fit_is_no_weaker_than_its_metric_makes_it(
    monkeypatch: pytest.MonkeyPatch, correlation: float
) -> None:
    """Cells that are correlated, and a fitted number whose signature resembles the effect's, with a cosine of 0.8."""
    rng = np.random.default_rng(4)
    cells, recordings, strength, every = 20, 96, 2.0, 400
    root = np.linalg.cholesky(correlation ** np.abs(np.subtract.outer(range(cells), range(cells))))
    t, column = (np.exp(-0.5 * ((np.arange(cells) - middle) / 3) ** 2) for middle in (8, 11))
    column /= np.linalg.norm(column)
    signature: Any = {CELL: t, TOTALS: np.zeros(0)}
    monkeypatch.setattr("spadmnist.inference.score_test.template_of", lambda replicates, evaluation, its: its)
    bench: Any = SimpleNamespace(seen={"flat": SimpleNamespace(total=1e4)})

    def limit_of(data: np.ndarray, own: np.ndarray, fitted: np.ndarray | None) -> float:
        evaluation: Any = SimpleNamespace(
            residuals={CELL: data, TOTALS: np.zeros(0)},
            replicate_residuals={CELL: own - own.mean(axis=0), TOTALS: np.zeros((recordings, 0))},
            once=lambda name, make: make(),
            nulls={},
        )
        return linear_limit(score_test(bench, evaluation, signature, fitted))

    limits = []
    for _ in range(every):
        own, noise = rng.standard_normal((recordings, cells)) @ root.T, root @ rng.standard_normal(cells)
        data = strength * t + noise
        fitted = data + 3.0 * column
        fitted -= column * (column @ fitted)
        limits.append((limit_of(fitted, own, column[:, None]), limit_of(data, own, None)))
    beside, alone = np.transpose(limits)
    assert np.sum(beside < strength) <= stats.binom.isf(laws.FALSE_ALARM, every, 0.05)
    if correlation < 0:  # of cells that scatter together the score is careful, with a fit and without one
        assert np.sum(beside < strength) >= stats.binom.ppf(laws.FALSE_ALARM, every, 0.05)
    # it was 2.5 times as large beside a fit whose cells are correlated
    assert 1.0 < np.median(beside) / np.median(alone) < 1.35


@pytest.mark.slow
def test_light_that_is_off_in_all_captures_is_the_set_up() -> None:
    """4 % in each of five, known exactly: no capture shows it by itself. `compare` fails, and so does `diagnose`."""
    real = measured(dict.fromkeys(range(5), 0.035), [0.0] * 5, seed=3, frames=300)
    assert sp.compare(SENSOR, real, jobs=1).verdict == "fails"
    found = sp.diagnose(SENSOR, real, quick=True, jobs=1)
    # few afterpulses would give these totals as well, which the answer says
    assert found.verdict in ("setup", "confused")
    light = {entry["capture"] for entry in found.as_data()["setup"] if entry["quantity"] == "light"}
    assert light >= {f"c{k}" for k in range(5)}


def test_a_check_that_some_simulations_have_no_data_for_is_named() -> None:
    replicates = Replicates(SENSOR, measured({}, [0.05]), 0, Execution(Serial()), 16)
    evaluation = evaluate(replicates, {})
    whole = comparison.comparison_of(replicates, evaluation)
    assert whole.not_compared == () and whole.faint == ("dark",)  # 3 dark counts are expected
    cell = "c0", "pixel_map"
    for of_cells in (evaluation.nulls, evaluation.judgements, evaluation.residuals, evaluation.replicate_residuals):
        of_cells.pop(cell)  # type: ignore[attr-defined]
    found = comparison.comparison_of(replicates, evaluation)
    assert found.as_data()["not_compared"] == [{"statistic": "pixel_map", "capture": "c0"}]
    assert "too few data: pixel_map of c0." in comparison.table(found)


def test_of_a_capture_with_hardly_a_detection_the_total_alone_is_compared() -> None:
    """Where the model expects 0.1 detections, one would be any number of sigma in every statistic."""
    faint = sp.Sensor(SENSOR.layout, [sp.effects.Detection(pdp=0.4), sp.effects.DarkCounts(rate=5.0)], rules="device")
    plan = [
        sp.Capture("dark", "tr", dark=True, exposure=2.5e-3),
        sp.Capture("flat", "tr", wavelength=500e-9, irradiance=4e-3, exposure=2.5e-3, relative_uncertainty=0.02),
    ]
    made = (sp.simulate(faint, plan, seed=seed) for seed in range(100))
    data = next(lab for lab in made if lab.recording("dark").totals.sum() == 1)
    found = comparison.compare(faint, data, 0, None, 1, 32)
    assert found.faint == ("dark",) and found.verdict == "adequate"
    assert {check.statistic for check in found.checks if check.capture == "dark"} == {"rate"}
    assert "Of dark so few detections are expected" in after_comparison(found)
