"""Pixels that are hit at random, or a map of them: what tells the two apart is how the pixels change with time."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spadmnist.inference import alternatives as module
from spadmnist.inference.alternatives import alternatives
from spadmnist.inference.coordinates import Coordinate
from spadmnist.inference.gauss_newton import Fit
from spadmnist.inference.trial import Trial, is_open

STRENGTH = Coordinate("any", "amplitude", "Hz", 1.0, 1e5, 0.0)
RATE = Coordinate("any", "rate", "Hz", 1e-2, 1e4, None)


def trial(rate: float, error: float, **more: Any) -> Trial:
    """A fitted trial of an effect with a strength and the rate of its switching; error: of the rate's logarithm."""
    candidate: Any = SimpleNamespace(shapes=(RATE,), kind="add", effect="any", parameter=None, name="add any")
    point = np.array([STRENGTH.coordinate(100.0), RATE.coordinate(rate)])
    values = {STRENGTH.key: 100.0, RATE.key: rate}
    fit = Fit((STRENGTH, RATE), point, np.diag([9.0, error**2]), {}, {}, 0.0, values)
    return Trial(candidate, values, None, 0.0, 1.0, fit=fit, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("rate", "error", "open_"),
    [(10.0, 0.5, False), (1e3, 2.0, True), (0.1, 2.0, True), (10.0, 6.0, True), (1e4, 0.1, True)],
)
def test_a_shape_is_open_where_its_interval_reaches_an_end(rate: float, error: float, open_: bool) -> None:
    """Of its own range; how well the strength is known does not matter."""
    assert is_open(trial(rate, error)) is open_


def test_a_trial_without_a_fit_is_not_open() -> None:
    one = trial(10.0, 6.0)
    one.fit = None
    assert not is_open(one)


@pytest.mark.parametrize(
    ("error", "chips", "fall", "failing", "confused"),
    [
        (6.0, True, 290.0, False, True),  # hot pixels that had been "explained" by dark counts that blink
        (0.5, True, 290.0, False, False),  # they are seen to switch
        (6.0, False, 290.0, False, False),  # it is not in random pixels
        (6.0, True, 150.0, False, False),  # the map explains less
        (6.0, True, 290.0, True, False),  # the map leaves a deviation
    ],
)
def test_random_pixels_are_confused_with_a_map_unless_they_are_seen_to_change(
    monkeypatch: pytest.MonkeyPatch, error: float, chips: bool, fall: float, failing: bool, confused: bool
) -> None:
    best = trial(1e3, error, chips=chips, evidence=236.0)
    other = trial(10.0, 0.5, maps={"any": None}, evidence=22.0, residuals={("dark", "pixel_map"): np.zeros(1)})
    of_map: Any = SimpleNamespace(kind="per_pixel", effect="dark_counts", parameter="rate", name="a map")
    other.candidate = of_map
    other.fall = fall
    monkeypatch.setattr(module, "block_checks", lambda *_: [])
    monkeypatch.setattr(module, "failing", lambda checks: [1] if failing else [])
    monkeypatch.setattr(module, "mean_misfit", lambda *_: 1.0)
    scan: Any = SimpleNamespace(replicates=None, if_possible=lambda *_, **__: contextlib.nullcontext())
    evaluation: Any = SimpleNamespace(replicate_residuals={("dark", "pixel_map"): np.zeros(1)})
    (found,) = alternatives(scan, evaluation, best, [other])
    assert found["confused"] is confused
