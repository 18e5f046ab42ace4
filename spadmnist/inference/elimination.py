"""Backward elimination: steps that later ones made needless, and steps that only resemble what is there."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping

import numpy as np

from ..errors import SpadError
from .capture_replicates import CannotSimulate
from .checks import block_checks, failing
from .evaluation import Evaluation, as_compared, log_likelihood_ratio, mean_misfit, square, stacked
from .gauss_newton import Effort, Fit, column_of, gauss_newton
from .joint_fit import LOST, RISEN, SAME, WORTH, fit_all, informing, rise_of, without_fit
from .levels import CLEARLY, LEAST_EVIDENCE, LEAST_FALL, OWN_CELLS
from .light_levels import totals_space, whole_of
from .model_path import ModelPath, keys_of, rests_on
from .models import Model
from .replicates import TOTALS, Cell
from .results import Step, title
from .signature import residuals_at, signatures
from .trial_fits import fit_trial

# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
# of the excess misfit: a single step that explains more is kept, whatever is left in its own cells
_MOSTLY = 0.95
_NOISE = 3.0  # standard deviations of the mean square of as many cells: excess misfit up to this is noise
# steps that explain too little of their own cells, after which no further one is tried: no effect here is the right one
_VAIN = 2
_MOVES = 0.1  # of a step's score in all totals: a capture that has less of it is none whose total it moves
# in chi square: a step is kept if a fit to first order without it is worse by more, far above `_NEEDLESS`; otherwise it
# is fitted again
_NEEDED = 90.0
# in chi square: a step is dropped if the fit without it is worse by less; 3 standard deviations of one number
_NEEDLESS = 9.0


def drop_needless(path: ModelPath) -> None:
    """Drop the steps that are needless in the fit of all coordinates.

    The last one is weighed if the fit of the model that it was added to was a rough one.
    """
    replicates = path.replicates
    last = path.steps[-1]
    # what others rest on comes last: it can be dropped once these are
    for step in sorted(path.steps, key=lambda s: any(rests_on(other, s, path) for other in path.steps)):
        if len(path.steps) < 2 or step.phased or any(rests_on(other, step, path) for other in path.steps):
            continue
        if step is last and not step.on_rough_fit:
            continue
        if step.candidate.carrier:
            if not path.steps[-1].candidate.carrier:  # a later map may be what makes the pixels differ
                drop_unless_missed(path, step)
            continue
        if step.fluctuates or step.chips:  # the squares of residuals do not judge what has a scatter of its own
            drop_unless_missed(path, step)
            continue
        rest = {k: v for k, v in path.values.items() if k not in keys_of(step.candidate, path)}
        chips = any(s.chips for s in path.steps)
        sensors = Model.same(replicates.start).changed(rest, path.scan.phases, chips)
        if any(s.candidate.carrier for s in path.steps):
            continue  # a map would have to be fitted anew
        (signature,) = signatures(replicates, path.evaluation, [sensors])
        if isinstance(signature, CannotSimulate):
            continue
        others = tuple(d for s in path.steps if s is not step for d in s.coordinates)
        z = residuals_at(replicates, path.evaluation, signature)
        now = square(path.evaluation.residuals)
        if path.fit is not None:  # its last step, which promises less than WORTH, is not simulated
            now = max(min(now, square(path.fit.residuals)), now - WORTH)
        loss = square(z) - now
        if loss > LOST and not others:
            continue
        at_first_order = _fitted_anew(path, z, without=step)
        if at_first_order is not None and square(at_first_order) - now > _NEEDED:
            continue
        point = {d.key: rest[d.key] for d in others}
        if others:
            with contextlib.suppress(CannotSimulate):
                effort = Effort(rounds=2, thorough=True)
                loss = gauss_newton(replicates, path.evaluation, others, point, sensors.changed, effort).square - now
        if loss < _NEEDLESS:
            replicates.say(f"{title(step.candidate)} is no longer needed")
            path.steps.remove(step)
            path.scan.accepted.remove(step.candidate)
            path.values = rest
            fit_all(path)
            _fit_from_templates(path)
            path.rung(f"- {title(step.candidate)}")


def drop_unless_missed(path: ModelPath, step: Step) -> None:
    """Drop a step, unless more checks fail without it.

    A fluctuating step also stays where the likelihood is larger with it: its signature may be all that showed it.
    """
    before, failed = path.kept(), len(path.failed)
    path.replicates.say(f"is {title(step.candidate)} still needed?")
    path.steps = [s for s in path.steps if s is not step]
    path.scan.accepted = [c for c in path.scan.accepted if c is not step.candidate]
    kept = set().union(*(keys_of(s.candidate, path) for s in path.steps))
    path.values = {k: x for k, x in path.values.items() if k in kept}
    evaluation = without_fit(path)
    if step.candidate.carrier and _fail_clearly(path, evaluation) > failed:
        path.back_to(before)
        return
    fit_all(path, known=evaluation)
    missed = len(path.failed) > failed
    if (step.fluctuates or step.chips) and not missed:
        template = {cell: step.template.get(cell, np.zeros_like(z)) for cell, z in before[0].residuals.items()}
        missed = log_likelihood_ratio(path.evaluation, before[0], template) > _NEEDLESS
    if missed:
        path.back_to(before)
    else:
        _fit_from_templates(path)
        path.rung(f"- {title(step.candidate)}")


def _fail_clearly(path: ModelPath, evaluation: Evaluation) -> int:
    """The number of checks that fail clearly after the coordinates are fitted anew, to first order.

    It is 0 where the coordinates move so far that the first order does not hold.

    Args:
        evaluation: of the model without a step that has no coordinates of its own.
    """
    residuals = _fitted_anew(path, evaluation.residuals, evaluation)
    if residuals is None:
        return 0
    found = failing(block_checks(path.replicates, evaluation, residuals))
    return sum(block.p < CLEARLY and block.cell not in evaluation.exact for block in found)


def _fitted_anew(
    path: ModelPath,
    residuals: dict[Cell, np.ndarray],
    evaluation: Evaluation | None = None,
    without: Step | None = None,
) -> dict[Cell, np.ndarray] | None:
    """Residuals after the coordinates are fitted anew, to first order; as they are where there are none.

    None where the coordinates move farther than the first order holds.

    Args:
        residuals: (cells,) by block.
        evaluation: the model that they belong to; by default that of the path.
        without: a step whose coordinates are not fitted.
    """
    fit, keys = path.fit, list(residuals)
    held = [d.key for d in without.coordinates] if without is not None else []
    moving = [i for i, d in enumerate(fit.coordinates) if d.key not in held] if fit is not None else []
    if fit is None or not moving:
        return residuals
    slope = np.stack([stacked(column_of(fit, i, evaluation or path.evaluation), keys) for i in moving], axis=1)
    z = stacked(residuals, keys)
    move = np.linalg.pinv(slope, rcond=1e-6) @ z
    if np.any(np.abs(move) > SAME):
        return None
    ends = np.cumsum([len(residuals[k]) for k in keys])[:-1]
    return dict(zip(keys, np.split(z - slope @ move, ends), strict=True))


def _fit_from_templates(path: ModelPath) -> None:
    """Fit the steps that have shapes once more, each from its own templates; kept where the squares fall.

    A shape that was fitted together with the dropped step may lie in another minimum, which no gradient leaves. Both
    models have replicates of their own, so that a fall within their noise is none.
    """
    for step in path.steps:
        if not step.candidate.shapes or step.candidate.carrier or step.phased or step.fluctuates or step.chips:
            continue
        if any(rests_on(other, step, path) for other in path.steps):
            continue
        before, steps = path.kept(), path.steps
        path.steps = [other for other in steps if other is not step]
        path.scan.accepted = [c for c in path.scan.accepted if c is not step.candidate]
        path.values = {k: x for k, x in path.values.items() if k not in keys_of(step.candidate, path)}
        evaluation = without_fit(path)
        found = path.scan.looked_at(evaluation, step.candidate, path.scan.begun(evaluation, step.candidate))
        best = max(found, key=lambda one: one.fall, default=None)
        rest, accepted = path.values, path.scan.accepted
        try:
            if best is not None:
                best = fit_trial(path.replicates, evaluation, best)
                path.steps, path.scan.accepted = steps, [*accepted, step.candidate]
                path.values = {**rest, **best.values}
                fit_all(path)
        except SpadError:  # it cannot be simulated there
            best = None
        if best is None or not _is_better(path, before[0], before[4]):
            path.back_to(before)


def _is_better(path: ModelPath, before: Evaluation, fit: Fit | None) -> bool:
    """Whether the squares are smaller than before, by more than their noise, in the blocks that inform either fit.

    Args:
        before: the evaluation before.
        fit: its fit.
    """
    fits = [one for one in (fit, path.fit) if one is not None]
    blocks = sorted({cell for one in fits for cell in informing(one)}) if fits else list(before.residuals)
    rise, noise = rise_of(before, path.evaluation, blocks)
    return -rise > max(_NEEDLESS, RISEN * noise)


def drop_unexplaining(path: ModelPath, start: Evaluation, totals: bool) -> None:
    """Drop the steps that only resemble what is there, where something remains.

    A step is judged by its own cells, see `left_in_own_cells`; signatures in other cells do not matter.

    Args:
        start: the evaluation without any step.
        totals: the totals belong to the model, not to the set-up.
    """
    while path.steps and any(totals or block.cell[0] for block in path.failed):
        # what one step leaves, another one cannot explain: the worst goes first, and the others are judged again
        left = {id(s): left_by(s, path, totals) for s in path.steps}
        worst = max(path.steps, key=lambda s: left[id(s)])
        now, then = (
            mean_misfit(evaluation.replicate_residuals, evaluation.residuals) for evaluation in (path.evaluation, start)
        )
        worse = now > then and square(path.evaluation.residuals) > square(start.residuals)  # the totals included
        mostly = len(path.steps) == 1 and then - now > _MOSTLY * (then - 1) > 0
        kept = [s for s in path.steps if not (s is worst or rests_on(s, worst, path)) or left[id(worst)] < 1 or mostly]
        if worse:
            kept = []
        if len(kept) == len(path.steps):
            return
        path.nearest += [step for step in path.steps if all(step is not s for s in kept)]
        path.steps = kept
        path.scan.accepted = [c for c in path.scan.accepted if any(c is s.candidate for s in kept)]
        known = set().union(*(keys_of(s.candidate, path) for s in kept))
        path.values = {k: v for k, v in path.values.items() if k in known}
        listed = {effect.name for effect in path.replicates.start.effects}
        periodic = listed | {candidate.effect for candidate in path.scan.accepted}
        path.scan.phases = {at: p for at, p in path.scan.phases.items() if at[1][0] in periodic}
        if kept:
            fit_all(path)
            path.rung("without steps that explain too little")
        else:
            path.evaluation, path.fit = as_compared(path.replicates, start), None


def no_step_explains(path: ModelPath, totals: bool) -> bool:
    """Whether several steps only resemble what is there, so that no effect here is the right one.

    Args:
        totals: see `drop_unexplaining`.
    """
    left = [left_by(step, path, totals) for step in path.steps]
    return len(left) >= _VAIN and bool(path.failed) and all(1 <= x < math.inf for x in left)


def left_by(step: Step, path: ModelPath, totals: bool) -> float:
    """As `left_in_own_cells`, of the path as it is, with data that the step was not fitted to."""
    return left_in_own_cells(step, path.held_out, totals, _has_totals_alone(step, path))


def _has_totals_alone(step: Step, path: ModelPath) -> bool:
    """Whether a step is one of totals, and all else that fails is in captures whose totals it does not move.

    What else fails in a capture may be the cause of its total; what fails in others is not.
    """
    ids, _, root, _ = totals_space(path.replicates, path.evaluation)
    template = step.template.get(TOTALS, np.zeros(0))
    shapes = sum(float(t @ t) for cell, t in step.template.items() if cell != TOTALS)
    if not ids or len(template) != len(ids) or float(template @ template) <= shapes:
        return False
    logs = np.linalg.solve(root, template)  # of the levels
    scores = logs**2 * np.sum(root**2, axis=0)  # by each capture's own total, the others given
    moved = scores > _MOVES * scores.sum()
    own = {whole_of(path.replicates, id) for id, moves in zip(ids, moved, strict=True) if moves}
    fail: set[str] = set()
    for block in path.failed:
        cells = [block.cell] if block.together is None else block.together.cells
        fail |= {whole_of(path.replicates, cell[0]) for cell in cells if cell[0]}
    return not own & fail


def left_in_own_cells(
    step: Step, residuals: Mapping[Cell, np.ndarray], totals: bool, totals_alone: bool = False
) -> float:
    """The excess misfit left in a step's own cells, relative to the most that a finding may leave.

    Its own cells carry most of its expected score. From 1 on the step only resembles what is there.

    Args:
        residuals: (cells,) by block, of data that the step was not fitted to.
        totals: the totals are among its cells.
        totals_alone: nothing else fails in the captures whose totals it moves; they are judged as other cells are.
    """
    cells = [
        (t, residuals[cell], step.before[cell], np.full(len(t), totals_alone or cell != TOTALS))
        for cell, t in step.template.items()
        if (totals or cell != TOTALS)
        and cell in residuals
        and cell in step.before
        and len(t) == len(residuals[cell]) == len(step.before[cell])
    ]
    if not cells:
        return math.inf
    t, now, before, shapes = (np.concatenate(parts) for parts in zip(*cells, strict=True))
    score = t**2
    if score.sum() <= 0:
        return math.inf
    fell = np.where(shapes, before**2 - now**2, 0.0)
    order = np.argsort(-score, kind="stable")
    own = order[: int(np.searchsorted(np.cumsum(score[order]), OWN_CELLS * score.sum())) + 1]
    # the fall of a faint one is in all of its cells; in the others, another step may have made it a rise
    explained = max(float(fell.sum()), float(fell[own].sum()))
    # the cause of another trace in these captures may be the cause of their totals
    if explained < LEAST_EVIDENCE or score[shapes].sum() < 0.5 * score.sum():
        return math.inf
    left, excess = float(np.mean(now[own] ** 2)) - 1, float(np.mean(before[own] ** 2)) - 1
    return left / max((1 - LEAST_FALL) * excess, _NOISE * math.sqrt(2 / len(own)))
