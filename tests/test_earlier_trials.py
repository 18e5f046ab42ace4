"""Trials of an earlier model: which signatures are used again under the next one."""

from __future__ import annotations

from dataclasses import replace

import pytest
from labs import bench_of, taken, wrong_numbers

import spadmnist as sp
from spadmnist.inference.candidates import candidates
from spadmnist.inference.earlier_trials import still_valid, values_differ
from spadmnist.inference.model_path import begin
from spadmnist.inference.signature import Signature

DELAY = "crosstalk", "delay"


@pytest.mark.slow
def test_another_number_of_the_same_effect_is_simulated_anew() -> None:
    """More crosstalk at a delay of 0.1 ns is no more of what the data have, which is at 40 ns."""
    listed = sp.effects.Crosstalk(probability=0.05, delay=1e-10)
    stated, data = wrong_numbers(listed, {"crosstalk.probability": 0.08, "crosstalk.delay": 40e-9}, 0.2)
    path = begin(bench_of((stated, data), 16))
    some = ("set crosstalk.probability", "set crosstalk.delay", "set dead_time.duration")
    path.scan.candidates = lambda sensor: [c for c in candidates(sensor) if c.name in some]  # type: ignore[method-assign]
    first = path.scan.scan(path.evaluation)
    taken(path, "set crosstalk.delay", {DELAY: 40e-9})
    path.scan.accepted = [c for c in candidates(stated.resolved()) if c.name == "set crosstalk.delay"]
    again, anew = (path.scan.scan(path.evaluation, known=known) for known in (first, ()))

    def fall(found: list) -> float:
        return max(t.fall for t in found if t.candidate.name == "set crosstalk.probability")

    assert fall(anew) > 100
    assert fall(again) == pytest.approx(fall(anew), rel=0.2)
    # what was simulated under this model, and what is of another effect, is used again, where the data resemble neither
    for known, kept in ((first, {"set dead_time.duration"}), (again, {"set dead_time.duration", some[0]})):
        faint = [replace(one, signature=Signature({}, {}, {})) for one in known if one.candidate.name != some[1]]
        tries = [(one.candidate, one.values) for one in faint]
        found = still_valid(path.scan, path.evaluation, tries, faint, False)
        assert {one.candidate.name for one in found} == kept


@pytest.mark.parametrize(
    ("one", "other", "differ"),
    [
        (1.0, 1.1, False),
        (1.0, 1.2, True),
        (0.0, 0.0, False),
        (0.0, 1e-12, True),
        (None, None, False),
        (None, 1.0, True),
        (True, False, True),
        ([1.0, 2.0], [1.0, 2.1], False),
        ([1.0, 2.0], [1.0, 3.0], True),
        ([1.0, 2.0], 1.0, True),
        ("a", "b", True),
        ({"a": 1}, {"a": 1}, False),
    ],
)
def test_values_differ_by_more_than_scatter(one: object, other: object, differ: bool) -> None:
    assert values_differ(one, other) is differ
