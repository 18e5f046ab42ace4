"""The fit of all coordinates of a model: what noise of the replicates, and lines and edges, do to its steps."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spadmnist.inference import joint_fit
from spadmnist.inference.coordinates import Coordinate, Key
from spadmnist.inference.evaluation import Evaluation
from spadmnist.inference.gauss_newton import Fit

STRENGTH = Coordinate("any", "share", "", 1e-4, 1.0, 0.0)
SHAPE = Coordinate("any", "delay", "s", 1e-9, 1e-6, None)
TRUE = {STRENGTH.key: 0.02, SHAPE.key: 1e-7}
CELLS, REPLICATES, BLOCK = 2000, 32, ("bright", "neighbours")
RNG = np.random.Generator(np.random.PCG64(5))
CHANCE, OWN = RNG.standard_normal(CELLS), RNG.standard_normal((REPLICATES, CELLS))
SLOPE = np.where(np.arange(CELLS) < 100, 3.0, 0.0)[:, None] * [1.0, 0.0]  # a shape to which no gradient leads


def evaluation_at(values: Mapping[Key, Any], extra: np.ndarray) -> Any:
    """Residuals that are linear in the logarithm of the strength; beyond 1 % of the shape a line is missed."""
    apart = np.log(values[STRENGTH.key] / TRUE[STRENGTH.key])
    missed = abs(np.log(values[SHAPE.key] / TRUE[SHAPE.key])) > 0.01
    z = CHANCE + SLOPE[:, 0] * apart + np.where(np.arange(CELLS) >= CELLS - 10, 40.0 * missed, 0.0) + extra
    changed = SimpleNamespace(changed=None)
    own = {BLOCK: OWN}
    return SimpleNamespace(residuals={BLOCK: z}, replicate_residuals=own, values=dict(values), sensors=changed)


def fitted(monkeypatch: pytest.MonkeyPatch, step: float, noise: np.ndarray) -> dict[Key, float]:
    """The values at the evaluation of a fit from half the true strength.

    step: of the shape's logarithm, by each Gauss-Newton step; noise: (cells,) of every evaluation after the first.
    """

    def one_step(replicates: Any, evaluation: Any, coordinates: Any, here: Any, *rest: Any) -> Fit:
        z = evaluation.residuals[BLOCK]
        move = -np.linalg.pinv(SLOPE[:, :1]) @ z
        begun = np.array([d.coordinate(here[d.key]) for d in coordinates])
        u = begun + np.array([float(move[0]), step])
        values = {d.key: d.value(float(x)) for d, x in zip(coordinates, u, strict=True)}
        left = z + SLOPE[:, :1] @ move
        return Fit(coordinates, u, np.eye(2), {BLOCK: left}, {BLOCK: SLOPE}, float(left @ left), values)

    start = {STRENGTH.key: 0.01, SHAPE.key: 1e-7}
    candidate = SimpleNamespace(shapes=(SHAPE,))
    steps = [SimpleNamespace(candidate=candidate)]
    path: Any = SimpleNamespace(replicates=None, values=start, steps=steps, model_at=lambda evaluation, values: None)
    monkeypatch.setattr(joint_fit, "_known_jacobian", lambda path: {})
    monkeypatch.setattr(joint_fit, "_recordings", lambda evaluation: 8)
    monkeypatch.setattr(joint_fit, "model_of", lambda path: (None, {}))
    monkeypatch.setattr(joint_fit, "gauss_newton_step", one_step)
    monkeypatch.setattr(joint_fit, "evaluate", lambda replicates, values, sensors: evaluation_at(values, noise))
    begun = evaluation_at(start, np.zeros(CELLS))
    _, found, _ = joint_fit.repeated_steps(path, begun, {}, (STRENGTH, SHAPE))
    return dict(found.values)


def test_a_rise_of_the_squares_that_is_noise_does_not_end_a_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise of the expectations may raise them by more than the step lowers them."""
    before = CHANCE - SLOPE[:, 0] * np.log(2)
    after = before - SLOPE[:, 0] * float(np.linalg.pinv(SLOPE[:, :1])[0] @ before)
    rest = after[100:]
    risen = 40.0  # in chi square, of which the noise of 32 replicates in 2000 cells has a standard deviation of 25
    noise = np.zeros(CELLS)
    noise[100:] = rest * (np.sqrt(1 + (before @ before - after @ after + risen) / (rest @ rest)) - 1)
    found = fitted(monkeypatch, 0.0, noise)
    assert found[STRENGTH.key] == pytest.approx(TRUE[STRENGTH.key], rel=0.15)  # five standard errors of 1/30


def test_a_strength_is_fitted_beside_a_line_to_which_no_gradient_leads(monkeypatch: pytest.MonkeyPatch) -> None:
    """The delay of an echo is known to a nanosecond, and a derivative over many of them leads away from it."""
    found = fitted(monkeypatch, -0.05, np.zeros(CELLS))
    assert found[SHAPE.key] == pytest.approx(TRUE[SHAPE.key], rel=1e-9)
    assert found[STRENGTH.key] == pytest.approx(TRUE[STRENGTH.key], rel=0.15)  # five standard errors of 1/30


def test_a_line_that_a_step_misses_is_seen_beside_the_noise_of_many_other_cells() -> None:
    """A rise of 160 in the block that informs the delay is noise among 60,000 cells, and none in that block."""
    many = ("bright", "pairs")
    slope = {BLOCK: SLOPE, many: np.zeros((60_000, 2))}
    z = {BLOCK: CHANCE, many: RNG.standard_normal(60_000)}
    missed = {BLOCK: CHANCE.copy(), many: z[many]}
    missed[BLOCK][-10:] += 4.0 * np.sign(CHANCE[-10:])
    own = {BLOCK: OWN, many: RNG.standard_normal((REPLICATES, 60_000))}
    before, after = (Evaluation({}, None, {}, {}, {}, {}, one, own, {}) for one in (z, missed))  # type: ignore[arg-type]
    fit = Fit((STRENGTH, SHAPE), np.zeros(2), np.eye(2), {}, slope, 0.0, {})
    assert joint_fit.informing(fit) == [BLOCK]
    rise, noise = joint_fit.rise_of(before, after, [BLOCK, many])
    assert 160 < rise < 3 * noise
    rise, noise = joint_fit.rise_of(before, after, joint_fit.informing(fit))
    assert rise > 3 * noise


def test_errors_of_their_own_belong_to_the_values(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last step of a rough fit is not simulated: residuals of the evaluation would take it for a misfit."""
    start = {STRENGTH.key: 0.01, SHAPE.key: 1e-7}

    def one_step(replicates: Any, evaluation: Any, coordinates: Any, here: Any, *rest: Any) -> Fit:
        assert here == start
        z, u = evaluation.residuals[BLOCK], np.zeros(2)
        return Fit(coordinates, u, np.eye(2), {BLOCK: z}, {BLOCK: SLOPE}, float(z @ z), dict(here))

    monkeypatch.setattr(joint_fit, "gauss_newton_step", one_step)
    monkeypatch.setattr(joint_fit, "_recordings", lambda evaluation: 8)
    rough = Fit((STRENGTH, SHAPE), np.zeros(2), np.eye(2), {}, {}, 0.0, {})
    path: Any = SimpleNamespace(
        fit=rough, approximate=True, steps=[], values=dict(TRUE), evaluation=evaluation_at(start, np.zeros(CELLS)),
        replicates=SimpleNamespace(say=lambda what: None), model_at=lambda *_: None,
    )  # fmt: skip
    joint_fit.with_own_errors(path)
    np.testing.assert_allclose(path.fit.residuals[BLOCK], CHANCE, atol=1e-9)
    assert path.fit.square == pytest.approx(float(CHANCE @ CHANCE)) and path.fit.values == TRUE
    assert list(path.fit.point) == [STRENGTH.coordinate(0.02), SHAPE.coordinate(1e-7)]
