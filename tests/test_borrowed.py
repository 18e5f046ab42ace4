"""Replicates that are borrowed from another model, and statistics that are left out, where no candidate shows."""

from __future__ import annotations

import numpy as np
import pytest
from labs import CROSSTALK, DURATION, bench_of, given, labs, taken

from spadmnist.inference.evaluation import evaluate
from spadmnist.inference.evidence import evaluation_of
from spadmnist.inference.joint_fit import complete_fit, completed
from spadmnist.inference.model_path import begin
from spadmnist.inference.replicates import TOTALS
from spadmnist.inference.signature import Sampling, Signature, captures_informing, signatures, statistics_showing
from spadmnist.statistics import informant

RATE = ("dark_counts", "rate")


@pytest.fixture
def lab(tmp_path):
    return labs(tmp_path)


@pytest.mark.slow
def test_only_the_captures_that_show_a_change_are_simulated(lab) -> None:
    """The others have the replicates of the model without it, at the level that gives as many detections."""
    replicates = bench_of(lab("    crosstalk: {probability: 3 %}\n"), 16)
    base = evaluate(replicates, {})
    values = {CROSSTALK: 0.03}
    sensors = base.sensors.changed(values)
    done = replicates.simulations
    some = evaluate(replicates, values, sensors, near=(base, ["dark"]))
    assert replicates.simulations - done == 16
    assert some.borrowed == {"flat"} and some.made["flat"].totals is not base.made["dark"].totals
    np.testing.assert_array_equal(some.made["flat"].totals, base.made["flat"].totals)
    # the light level of the borrowed replicates is that at which this model gives their totals
    rate = some.rates["flat"]
    assert rate.expected(rate.level) == pytest.approx(base.rates["flat"].expected(base.rates["flat"].level), rel=1e-4)
    assert rate.level < base.rates["flat"].level  # crosstalk adds detections
    whole = evaluate(replicates, values, sensors)
    for cell, z in whole.residuals.items():
        if cell[0] == "dark":
            np.testing.assert_array_equal(some.residuals[cell], z)
    # the totals are judged at the stated light of this model: by the closed forms where nothing was simulated
    noise = np.sqrt(2 / 16) * np.ones(len(whole.residuals[TOTALS]))
    assert np.all(np.abs(some.residuals[TOTALS] - whole.residuals[TOTALS]) < 5 * noise)
    # with replicates of its own it is the evaluation of this model, and nothing is simulated twice
    done = replicates.simulations
    own = completed(replicates, some)
    assert not own.borrowed and replicates.simulations - done == 16
    for cell, z in whole.residuals.items():
        np.testing.assert_array_equal(own.residuals[cell], z)
    assert completed(replicates, own) is own


def test_what_changes_the_mean_unsaid_borrows_nothing(lab, monkeypatch) -> None:
    """The total of such a model is known from its own replicates alone."""
    replicates = bench_of(lab(), 16)
    base = evaluate(replicates, {})
    sensors = base.sensors.changed({DURATION: 60e-9})
    monkeypatch.setattr(type(sensors.one.effect("dead_time")), "states_mean", False)
    assert not evaluate(replicates, {}, sensors, near=(base, [])).borrowed


@pytest.mark.slow
def test_a_step_is_weighed_where_it_shows_and_complete_before_the_end(lab) -> None:
    """More dark counts are the same pattern in the dark; it is simulated when all numbers are fitted together."""
    made = lab("", light=400)
    sensor, data = made
    replicates = bench_of((sensor.with_values({"dark_counts.rate": 50.0}), data), 16)
    path = begin(replicates)
    one = given(path, "set dark_counts.rate", {RATE: 100.0}, fitted=True)
    weighed = evaluation_of(replicates, path.evaluation, one)
    assert "dark" in weighed.borrowed
    taken(path, "set dark_counts.rate", {RATE: 100.0})
    assert "dark" in path.evaluation.borrowed
    complete_fit(path)
    assert not path.evaluation.borrowed and not path.approximate
    value = path.steps[0].values["rate"]
    assert value.low is not None and value.high is not None
    fresh = evaluate(replicates, path.evaluation.values, path.evaluation.sensors)
    for cell, z in fresh.residuals.items():
        np.testing.assert_allclose(path.evaluation.residuals[cell], z, atol=1e-9)


def test_only_the_statistics_that_are_named_are_reduced(lab) -> None:
    """They have the same shifts; the others have none, and the budget is charged for less."""
    replicates = bench_of(lab("    crosstalk: {probability: 10 %}\n"), 16)
    base = evaluate(replicates, {})
    model = base.sensors.changed({CROSSTALK: 0.1})
    spent = replicates.budget.spent
    (whole,) = signatures(replicates, base, [model])
    full, spent = replicates.budget.spent - spent, replicates.budget.spent
    (some,) = signatures(replicates, base, [model], Sampling(names=["neighbours", "spacing"]))
    assert isinstance(whole, Signature) and isinstance(some, Signature)
    assert {name for _, name in some.shifts} <= {"neighbours", "spacing"} < {name for _, name in whole.shifts}
    for cell, shift in some.shifts.items():
        np.testing.assert_array_equal(shift, whole.shifts[cell])
    assert some.logs == whole.logs
    assert 0.4 * full < replicates.budget.spent - spent < 0.6 * full


def test_the_statistics_and_captures_that_show_a_trial(lab) -> None:
    replicates = bench_of(lab(), 16)
    base = evaluate(replicates, {})
    template = {cell: np.zeros(len(z)) for cell, z in base.residuals.items()}
    assert statistics_showing(template, 0.01) == [] == captures_informing(replicates, base, template)
    template["dark", "intervals"][0], template["flat", informant("counts")][0] = 10.0, 2.0
    assert statistics_showing(template, 0.01, 4.0) == [informant("counts"), "intervals"]
    assert statistics_showing(template, 0.2) == ["intervals"]
    # the dark capture has few detections and most of the square
    assert captures_informing(replicates, base, template) == ["dark"]
    template["flat", informant("counts")][0] = 12.0
    assert set(captures_informing(replicates, base, template)) == {"dark", "flat"}
