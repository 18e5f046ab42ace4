"""What of a few recordings is a shift of another model, and what is chance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from labs import bench_of

from spadmnist.inference.evaluation import evaluate
from spadmnist.inference.laws import Poisson
from spadmnist.inference.null_distribution import Null, learn
from spadmnist.inference.shifts import beyond_noise, mean_shift
from spadmnist.inference.signature import Signature, signature_from
from spadmnist.statistics import Summary

BLOCKS, RECORDINGS = 200, 32
Draw = Callable[[np.random.Generator, int], np.ndarray]


def windows(rng: np.random.Generator, n: int) -> np.ndarray:
    """Twelve numbers that move together, as variances in windows of several lengths do."""
    return rng.standard_normal((n, 1)) + 0.2 * rng.standard_normal((n, 12))


LAWS: dict[str, tuple[str, Draw]] = {
    "three": ("normal", lambda rng, n: rng.standard_normal((n, 3))),
    "many": ("normal", lambda rng, n: rng.standard_normal((n, 200))),
    "windows": ("normal", windows),
    "counts": ("poisson", lambda rng, n: rng.poisson(40.0, (n, 60)).astype(float)),
    "empty": ("poisson", lambda rng, n: rng.poisson(0.02, (n, 800)).astype(float)),
    "spectrum": ("exponential", lambda rng, n: rng.exponential(1.0, (n, 3000))),
}


def learnt(law: str, values: np.ndarray, totals: np.ndarray) -> Null:
    return learn([Summary(row, law, str, lambda *given: ("", 0.0)) for row in values], totals)  # type: ignore[arg-type]


def shift_of(null: Null, values: np.ndarray, base: np.ndarray, few: int) -> np.ndarray:
    expected = null.expected(1000.0)[0]
    spread = np.maximum(null.spread_at(expected), 0.3 if isinstance(null.law, Poisson) else 1e-30)
    shift, left, beta = mean_shift(values - expected, base[:few] - expected, spread)
    chance = left + 3.0 * (1 - beta) / null.recordings
    return beyond_noise(shift, spread, chance, null, expected, few, True)


@pytest.mark.slow
@pytest.mark.parametrize("few", [2, 4])
@pytest.mark.parametrize("name", list(LAWS))
def test_what_chance_makes_of_a_few_recordings_is_no_shift(name: str, few: int) -> None:
    """Each block is a false alarm once in a thousand times at most: more than 5 of 200 once in a million."""
    law, draw = LAWS[name]
    rng = np.random.default_rng(1)
    alarms = 0
    for _ in range(BLOCKS):
        base = draw(rng, RECORDINGS)
        null = learnt(law, base, 1000 + rng.standard_normal(RECORDINGS))
        alarms += bool(shift_of(null, draw(rng, few), base, few).any())
    assert alarms <= 5


@pytest.mark.parametrize("name", list(LAWS))
def test_a_shift_is_told_by_a_few_recordings(name: str) -> None:
    """Four deviations in all cells, whatever chance has in common or not; counts and a line in one alone."""
    law, draw = LAWS[name]
    rng = np.random.default_rng(2)
    base = draw(rng, RECORDINGS)
    null = learnt(law, base, 1000 + rng.standard_normal(RECORDINGS))
    for values in (base[:4], draw(rng, 4)):
        more = values.copy()
        if law == "normal":
            more += 4.0
        elif law == "poisson":
            more[:, 7] += 40.0
        else:
            more[:, 7] += 30.0
        shift = shift_of(null, more, base, 4)
        assert shift.any() and shift[np.argmax(np.abs(shift))] > 2


@pytest.mark.parametrize("few", [2, 4])
def test_what_is_another_in_every_recording_is_no_shift(few: int) -> None:
    """Light that swings at random, three times as much as chance does: no two recordings have the same trend.

    Of 40 such sets 3 and none have a shift; of two replicates a twelfth may have one.
    """
    rng = np.random.default_rng(3)
    base = rng.standard_normal((RECORDINGS, 32))
    null = learnt("normal", base, 1000 + rng.standard_normal(RECORDINGS))
    values = [base[:few] + 3 * rng.standard_normal((few, 32)) for _ in range(40)]
    assert sum(bool(shift_of(null, each, base, few).any()) for each in values) <= {2: 6, 4: 2}[few]
    assert shift_of(null, base[:few] + 3 * rng.standard_normal(32), base, few).all()


def test_no_expectation_is_taken_from_where_none_was_learnt(lab) -> None:
    """A model with three times as many detections in the dark, that no level brings down to as many: as at the most."""
    replicates = bench_of(lab())
    evaluation = evaluate(replicates, {})
    wanted = [
        (evaluation.sensors, id, 3 * evaluation.rates[id].level * evaluation.factors[id][:4], np.arange(4))
        for id in evaluation.made
    ]
    made = dict(zip(evaluation.made, replicates.simulate(wanted), strict=True))
    signature = signature_from(replicates, evaluation, evaluation.sensors, made, "sure")  # type: ignore[arg-type]
    assert isinstance(signature, Signature)
    null, most = evaluation.nulls["dark", "intervals"], evaluation.made["dark"].totals.max()
    (values, usual), few = (made["dark"].values["intervals"], evaluation.made["dark"].values["intervals"]), slice(0, 4)  # type: ignore[union-attr]
    old = usual[few] - np.stack([null.expected(t)[0] for t in evaluation.made["dark"].totals[few]])
    new = (values - null.expected(most)[0]).mean(axis=0)
    shift = signature.shifts["dark", "intervals"]
    seen = shift != 0
    assert seen.any() and np.all(np.abs(shift - new)[seen] <= np.abs(old.mean(axis=0))[seen] + 1e-9)


def test_a_part_of_a_signature_fluctuates_as_the_whole_does() -> None:
    noisy = Signature({("a", "x"): np.ones(2)}, {("a", "x"): 0.1}, {"a": 0.0, "b": 0.0}, fluctuates=True)
    steady = Signature({("b", "x"): np.ones(2)}, {("b", "x"): 0.1}, {"a": 0.0, "b": 0.0})
    assert noisy.only(["a"]).fluctuates and not steady.only(["b"]).fluctuates
    assert steady.completed(noisy, ["a"]).fluctuates and noisy.completed(steady, ["b"]).fluctuates
