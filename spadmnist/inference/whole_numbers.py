"""Whole numbers of steps, fitted anew with all other coordinates free: no gradient leads from one to the next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from .capture_replicates import CannotSimulate
from .coordinates import Coordinate, Key
from .evaluation import square
from .gauss_newton import Effort, Fit, gauss_newton
from .joint_fit import WORTH, fit_all
from .results import Step
from .signature import IGNORED, captures_showing
from .trial_fits import fit_whole_number

if TYPE_CHECKING:
    from .model_path import ModelPath

_ROUNDS = 2  # of the fit of the other coordinates at each number, see `gauss_newton`; as in the fit of a trial


def refit_whole_numbers(path: ModelPath) -> None:
    """Fit the whole numbers of the steps once more, while checks fail.

    A trial has the other steps where they are. A step that has absorbed a part of its effect keeps its whole number
    from where it belongs: the reach of crosstalk beside a probability that stood for all of it.
    """
    for step in path.steps:
        for coordinate in step.candidate.coordinates:
            if coordinate.whole and coordinate.key in path.values and path.failed:
                _refit(path, step, coordinate)


def _refit(path: ModelPath, step: Step, coordinate: Coordinate) -> None:
    replicates, evaluation, others = path.replicates, path.evaluation, path.free
    if coordinate in others or not others:
        return
    only = captures_showing(step.template, *IGNORED)

    def fit(values: Mapping[Key, Any]) -> Fit:
        effort = Effort(_ROUNDS, only=only)
        return gauss_newton(replicates, evaluation, others, values, lambda v: path.model_at(evaluation, v), effort)

    here = {d.key: path.values[d.key] for d in (*others, coordinate)}
    replicates.say(f"{coordinate.effect}.{coordinate.parameter} anew")
    try:
        begun = fit(here)
        found, intervals = fit_whole_number(begun, coordinate, fit)
    except CannotSimulate:
        return
    own = {d.key for d in step.candidate.coordinates}
    intervals = {key: ends for key, ends in intervals.items() if key in own}
    if found.values[coordinate.key] == here[coordinate.key] or begun.square - found.square < WORTH:
        return
    before, squares = path.kept(), square(path.evaluation.residuals)
    path.values = {**path.values, **found.values}
    fit_all(path)
    if path.fit is None or square(path.evaluation.residuals) > squares - WORTH:  # few replicates, of some captures
        path.back_to(before)
    else:
        step.intervals |= intervals
