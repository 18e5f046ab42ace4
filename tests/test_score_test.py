"""Is it chance? p-values of traces, of cells that scatter together, of several directions, of many candidates."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import laws
import numpy as np
import pytest
from scipy import stats

from spadmnist.inference.laws import Poisson
from spadmnist.inference.replicates import TOTALS
from spadmnist.inference.score_test import p_values, score_test, trials_corrected

RECORDINGS, CELL = 32, ("flat", "windows")
REPLICATES: Any = SimpleNamespace(seen={"flat": SimpleNamespace(total=1.0)})


@pytest.fixture(autouse=True)
def signatures_are_templates(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "spadmnist.inference.score_test.template_of", lambda replicates, evaluation, signature: signature
    )


def model(rng: np.random.Generator, cells: int, common: float, recordings: int = RECORDINGS) -> Any:
    """An evaluation with one statistic of which all cells have something in common."""

    def draw(n: int) -> np.ndarray:
        return common * rng.standard_normal((n, 1)) + rng.standard_normal((n, cells))

    own = draw(recordings)
    own -= own.mean(axis=0)
    own[:] *= np.sqrt(recordings / (recordings - 1))
    return SimpleNamespace(
        residuals={CELL: draw(1)[0], TOTALS: np.zeros(0)},
        replicate_residuals={CELL: own, TOTALS: np.zeros((recordings, 0))},
        once=lambda name, make: make(),
        nulls={},
    )


def candidate(trace: np.ndarray, name: str, signed: bool = True, directions: int = 1) -> Any:
    template = {CELL: trace, TOTALS: np.zeros(0)}
    signature = type("Trace", (dict,), {"even": None, "at": lambda self, times: self})(template)
    candidate = SimpleNamespace(name=name, kind="add", strengths=[None] * directions, shapes=())
    return SimpleNamespace(candidate=candidate, signature=signature, signed=signed, values={})


def p_of(evaluation: Any, tried: list[Any]) -> float:
    data, own = p_values(REPLICATES, evaluation, tried)
    return trials_corrected(own, min(data))


@pytest.mark.slow
def test_p_values_of_many_candidates_are_no_smaller_than_uniform_and_not_far_larger() -> None:
    """Of cells that scatter together and few recordings. More than so many below 0.05 and 0.01 once in a million.

    They are larger than uniform ones by a factor of two at most.
    """
    rng = np.random.default_rng(1)
    found = []
    for _ in range(600):
        evaluation = model(rng, 12, 1.0)
        traces = [np.abs(rng.standard_normal(12)) + 0.3 for _ in range(8)]
        found.append(p_of(evaluation, [candidate(t, str(k), signed=bool(k % 2)) for k, t in enumerate(traces)]))
    for level in (0.05, 0.01):
        assert np.sum(np.array(found) < level) <= stats.binom.isf(laws.FALSE_ALARM, len(found), level)
    assert np.sum(np.array(found) < 0.1) >= stats.binom.ppf(laws.FALSE_ALARM, len(found), 0.05)
    assert np.sum(np.array(found) < 0.5) > 150


def test_cells_that_scatter_together_hide_less_than_they_seem_to() -> None:
    """A trace across what they have in common stands out; by the cells alone it would drown in it."""
    rng = np.random.default_rng(2)
    trace = np.r_[np.full(4, 3.0), np.zeros(8)]
    p, size = [], []
    for _ in range(40):
        evaluation = model(rng, 12, 3.0, 128)
        evaluation.residuals[CELL] = evaluation.residuals[CELL] + trace
        found = score_test(REPLICATES, evaluation, candidate(trace, "one").signature)
        p.append(p_of(evaluation, [candidate(trace, "one")]))
        size.append(found.size)
    # 6 standard deviations of four cells, of which the part in common is known from the others; plainly 6 / 6.1
    assert 3.0 < np.median(size) < 6.5 and np.median(p) < 1e-3


def test_cells_that_only_seem_to_scatter_together_lose_nothing() -> None:
    """Thirty recordings of twelve independent cells: what they seem to have in common is not taken for it."""
    rng = np.random.default_rng(6)
    found = []
    for _ in range(300):
        evaluation, trace = model(rng, 12, 0.0), rng.standard_normal(12)
        evaluation.residuals[CELL] = evaluation.residuals[CELL] + 6 * trace / np.sqrt(trace @ trace)
        found.append(score_test(REPLICATES, evaluation, candidate(trace, "one").signature).data)
    # 6 if it were known that they are independent; 5.3 by what these recordings say, half believed; its error is 0.07
    assert 5.65 < np.mean(found) < 6.15


def test_directions_are_judged_together() -> None:
    """3 standard deviations along each of two directions are more than 3 along one, and two chances to be so."""
    rng = np.random.default_rng(3)
    evaluation = model(rng, 40, 0.0, 128)
    along = [np.eye(40)[0] * 10, np.eye(40)[1] * 10]
    evaluation.residuals[CELL] = np.r_[3.0, 3.0, np.zeros(38)]
    one = p_of(evaluation, [candidate(along[0], "one")])
    both = p_of(evaluation, [candidate(t, "two", directions=2) for t in along])
    apart = p_of(evaluation, [candidate(t, str(k)) for k, t in enumerate(along)])
    assert both < one < apart < 0.05 and one > 1e-3


def test_less_than_nothing_is_none_of_what_can_only_be_there() -> None:
    rng = np.random.default_rng(4)
    evaluation = model(rng, 10, 0.0)
    evaluation.residuals[CELL] = np.full(10, -4.0)
    assert p_of(evaluation, [candidate(np.ones(10), "one", signed=False)]) > 0.99
    assert p_of(evaluation, [candidate(np.ones(10), "one", signed=True)]) < 1e-4


def test_what_goes_together_has_the_tails_of_few() -> None:
    evaluation = model(np.random.default_rng(5), 14, 2.0, 32)
    evaluation.replicate_residuals[CELL] = np.repeat(evaluation.replicate_residuals[CELL][:, :1], 14, axis=1) / 2
    chance_of = score_test(REPLICATES, evaluation, candidate(np.ones(14), "one").signature)
    assert chance_of.freedom < 31
    # numbers of many events have no such tails, whatever they have in common
    for events, few in ((5.0, True), (1000.0, False)):
        null = SimpleNamespace(law=Poisson(), factor=1.0, expected=lambda total, n=events: (np.full(14, n), 0.0))
        evaluation.nulls = {CELL: null}
        assert (score_test(REPLICATES, evaluation, candidate(np.ones(14), "one").signature).freedom < 31) == few
