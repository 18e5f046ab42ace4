"""The path of models of a diagnosis: the model so far, its steps, and what each of them adds."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..effects import ByWavelength
from ..errors import SpadError
from ..sensor import Sensor
from ..statistics import informant
from ..units import rounded
from . import count_model, held_out, map_models, pixel_maps
from .candidates import Candidate, with_values
from .checks import BlockCheck, block_checks, failing
from .coordinates import Coordinate, Key
from .count_model import light_levels_of
from .error_budget import HeldMaps, Rung, physical_errors
from .evaluation import Evaluation, mean_misfit
from .evidence import evaluation_of
from .gauss_newton import Fit
from .hit_pixels import PixelsHit, of_pixels, pixels_hit
from .joint_fit import fit_all
from .models import Model
from .phases import evaluate_start
from .replicates import TOTALS, Cell, Replicates
from .results import Step, title
from .scan import Scan
from .signature import IGNORED, captures_showing, template_of
from .trial import Trial

# of a coordinate (a logarithm, mostly): a move by which it is decided whether the coordinate changes the model. Any
# that is not rounded off does
_ASIDE = 0.01
# of the largest mean information of a capture on a map: with less of it, a capture hardly moves the map: this is not
# fitted again for a trial that only such captures show. A rule of thumb
_INFORMS = 0.05


@dataclass
class ModelPath:
    """A diagnosis under way: the evaluation of the model so far.

    Attributes:
        values: of all steps, by (effect, parameter), SI.
        ladder: the error budget so far.
    """

    replicates: Replicates
    scan: Scan
    evaluation: Evaluation
    values: dict[Key, Any]
    steps: list[Step]
    ladder: list[Rung]
    fit: Fit | None = None  # of the coordinates of all steps, with the Jacobian
    nearest: list[Step] = field(default_factory=list)  # steps that only resembled what remains
    finished: bool = True  # no budget has ended it
    no_fit_because: str = ""  # why the coordinates could not be fitted together the last time that they could not
    not_completed: Evaluation | None = None  # the last one of which a fit of all numbers together was not possible
    approximate: bool = False  # the Jacobian of `fit`, or the maps, are those of models near by
    # (pixels,) bool by effect: the pixels that it has hit, of the effects that the model has in exactly these
    located: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def start(self) -> Evaluation:
        """The evaluation of the stated model."""
        return self.ladder[0].evaluation

    @property
    def is_rough(self) -> bool:
        """Whether the last fit was a rough one, or captures have the replicates of another model."""
        return self.approximate or bool(self.evaluation.borrowed)

    @property
    def free(self) -> tuple[Coordinate, ...]:
        """The coordinates of all steps that change the model.

        The share of the pixels that an effect hits does not, where it is known which ones it has hit.
        """
        every = tuple(d for step in self.steps for d in step.coordinates)
        if not self.located:
            return every

        def model(coordinate: Coordinate, by: float) -> dict[Key, Any]:
            at = coordinate.coordinate(float(self.values[coordinate.key]))
            values = {**self.values, coordinate.key: coordinate.value(at + by)}
            return {**values, **self.where(values)}

        def moves(coordinate: Coordinate) -> bool:
            ends = [model(coordinate, by) for by in (-_ASIDE, _ASIDE)]
            return any(not np.array_equal(ends[0][key], ends[1][key]) for key in ends[0])

        return tuple(filter(moves, every))

    def where(self, values: Mapping[Key, Any]) -> dict[Key, Any]:
        """The values under which effects are in the pixels that they have hit, SI; none where these are not known.

        Args:
            values: of the model, SI.
        """
        sensor = with_values(self.replicates.start, values) if self.located else None
        hits = self.located.items()
        return {k: x for effect, hit in hits if sensor for k, x in of_pixels(sensor, effect, hit).items()}

    def model_at(self, evaluation: Evaluation, values: Mapping[Key, Any]) -> Model:
        """The model of an evaluation with some values changed, SI."""
        return evaluation.sensors.changed({**values, **self.where({**self.values, **values})})

    @property
    def held_out(self) -> dict[Cell, np.ndarray]:
        """The residuals of each capture with the coordinates fitted without it, (cells,) by block; see `held_out`."""
        return (
            self.evaluation.residuals
            if self.fit is None
            else held_out.leave_one_capture_out(self.evaluation.residuals, self.fit.jacobian)
        )

    @property
    def failed(self) -> list[BlockCheck]:
        """The checks that fail."""
        return failing(block_checks(self.replicates, self.evaluation, self.evaluation.residuals))

    @property
    def misfit(self) -> float:
        """The misfit on captures that are left out of the fit, as far as there are any; 1 if the model is right."""
        return mean_misfit(self.evaluation.replicate_residuals, self.held_out)

    def kept(self) -> tuple[Any, ...]:
        """A copy of all that a step changes, for `back_to`."""
        own = (self.evaluation, dict(self.values), list(self.steps), list(self.ladder), self.fit)
        fitted = [(step, dict(step.values), step.map) for step in self.steps]  # a fit writes into the steps
        scan = list(self.scan.accepted), dict(self.scan.phases)
        more = dict(self.located), self.approximate, list(self.nearest), self.replicates.unstated
        return (*own, *scan, fitted, *more)

    def back_to(self, kept: tuple[Any, ...]) -> None:
        """Restore the state that `kept` returned."""
        self.evaluation, self.values, self.steps, self.ladder, self.fit = kept[:5]
        self.scan.accepted, self.scan.phases, fitted, self.located, self.approximate, self.nearest = kept[5:-1]
        self.replicates.unstated = kept[-1]
        for step, values, map_ in fitted:
            step.values, step.map = values, map_

    def rung(self, name: str, steps: Sequence[Step] = ()) -> None:
        """Append the model to the error budget.

        Args:
            name: of the row.
            steps: those that the model adds.
        """
        left = self.held_out
        errors = physical_errors(self.replicates, self.evaluation, left, strict=not self.ladder)
        misfit = mean_misfit(self.evaluation.replicate_residuals, left)
        held = [c for c in self.scan.accepted if c.carrier]
        chips = any(step.chips for step in self.steps)
        maps = (
            HeldMaps(values=dict(self.values), held=held, phases=dict(self.scan.phases), chips=chips) if held else None
        )
        for rung in self.ladder[1:]:
            rung.evaluation = rung.evaluation.without_replicates()
        self.ladder.append(
            Rung(
                model=name,
                evaluation=self.evaluation,
                misfit=misfit,
                errors=errors,
                left=left,
                fit=self.fit,
                steps=list(steps),
                maps=maps,
            )
        )

    @property
    def sensor_values(self) -> dict[Key, Any]:
        """The values of one sensor that stands for the model, SI, as its file has them; its pixels are the chip's.

        Numbers are rounded as in the file. A map has the spread of the chip, and what hits pixels at random is in
        those that it has hit.
        """
        maps = {step.candidate.carrier: step.map for step in self.steps if step.candidate.carrier and step.map}
        values = {**self.values, **{key: map_.spread_values() for key, map_ in maps.items() if key in self.values}}
        for step in self.steps:
            found = self.pixels_hit(step)
            values |= {} if found is None else found.values
        return {key: _as_written(x) for key, x in values.items()}

    def locate(self) -> None:
        """Write into each step the pixels that its effect has hit."""
        for step in self.steps:
            found = self.pixels_hit(step)
            step.hit = None if found is None else found.hit

    def pixels_hit(self, step: Step) -> PixelsHit | None:
        """The pixels of the chip that a step's effect has hit; None where that is not known."""
        effect = step.candidate.effect

        def made() -> np.ndarray | None:
            with self.scan.if_possible(step.candidate, "the pixels that it has hit", wholly=False):
                levels = light_levels_of(self.replicates, self.evaluation)
                found = pixels_hit(self.replicates, levels, self.values, effect)
                return None if found is None else found.hit
            return None

        hit = self.located.get(effect)
        if hit is None and step.chips:
            hit = self.evaluation.once(("pixels hit", effect), made)
        if hit is None:
            return None
        with self.scan.if_possible(step.candidate, "the pixels that it has hit", wholly=False):
            sensor = with_values(self.replicates.start, self.values)  # its other values may have moved since
            return PixelsHit(hit, of_pixels(sensor, effect, hit))
        return None

    def can_be(self, effects: Collection[str]) -> bool:
        """Whether the stated sensor can be made with the values that the steps gave to some effects alone."""
        try:
            with_values(self.replicates.start, {key: x for key, x in self.values.items() if key[0] in effects})
        except SpadError:
            return False
        return True

    def last_rung(self) -> None:
        """Replace the last row of the error budget by the model as it is now."""
        last = self.ladder.pop()
        self.rung(last.model, last.steps)


def _as_written(value: Any) -> Any:
    """A value as a sensor file has it; maps are written as they are."""
    if isinstance(value, ByWavelength):
        return ByWavelength(value.wavelengths, tuple(map(rounded, value.values)))
    return rounded(value) if isinstance(value, float) else value


def begin(replicates: Replicates) -> ModelPath:
    """The path with the stated model, the phases of its periodic effects fitted."""
    replicates.say("the model as it is")
    scan = Scan(replicates, replicates.say)
    evaluation, phases = evaluate_start(replicates)
    scan.phases.update(phases)
    path = ModelPath(replicates=replicates, scan=scan, evaluation=evaluation, values={}, steps=[], ladder=[])
    path.rung("start")
    return path


def accept(path: ModelPath, best: Trial, significance: float) -> list[Step]:
    """The steps of the best candidate, which are added to the model; all coordinates are fitted anew.

    Args:
        significance: of the candidate, standard deviations.
    """
    replicates, before = path.replicates, path.evaluation
    roughly = not (best.fluctuates or before.fluctuates) and _moves_no_map(path, best)
    new = [
        Step(
            candidate=candidate,
            values={},
            misfit=0.0,
            significance=significance,
            material=material(best),
            coordinates=best.fit.coordinates if best.fit is not None else (),
            jacobian=best.fit.jacobian if best.fit is not None and best.faint else {},
            template=template_of(replicates, before, best.there or best.signature),
            before=dict(before.residuals),
            phased=bool(best.phases),
            chips=best.chips,
            fluctuates=best.fluctuates,
            intervals=dict(best.intervals),
            on_rough_fit=path.is_rough,
        )
        for candidate in best.candidates
    ]
    path.scan.accepted += best.candidates
    path.scan.phases.update(best.phases)
    path.steps += new
    known = evaluation_of(replicates, before, best) if roughly and best.sensors is not None else None
    if known is None and not any(candidate.carrier for candidate in path.scan.accepted):
        known = best.evaluation
    near = None
    # the first maps, before any coordinate: nothing else moves with them
    if best.maps is not None and path.fit is None and len(best.maps) == len(best.candidates):
        template = template_of(replicates, before, best.signature.at(best.times))
        near = before, captures_showing(template, *IGNORED)
    # the evaluated model has the earlier values where they were simulated, one step before the fitted ones
    path.values = {**(path.values if known is None else before.values), **best.values}
    # all is fitted again once no check fails plainly: until then the columns of the separate fits are good enough
    columns = [] if best.chips or best.fluctuates else [fit for fit in (path.fit, best.fit) if fit is not None]
    fit_all(path, best.fit, known, columns, roughly, near, where_shown=True)
    for step in new:
        if step.map is not None:
            step.material = change_by_map(replicates.start, step.map)
    path.rung("+ " + " + ".join(title(step.candidate) for step in new), new)
    return new


def _moves_no_map(path: ModelPath, best: Trial) -> bool:
    """Whether the maps of the model stay as they are with a trial: the captures that inform them hardly show it."""
    if best.maps is not None:
        return False
    replicates, evaluation = path.replicates, path.evaluation
    template = template_of(replicates, evaluation, (best.there or best.signature).at(best.times))
    levels = count_model.light_levels_of(replicates, evaluation)
    totals = float(template[TOTALS] @ template[TOTALS])
    for candidate in path.scan.accepted:
        if not candidate.carrier:
            continue
        if totals > IGNORED[1] and not pixel_maps.acts_on_light(evaluation.sensors.one, candidate):
            return False  # the mean of the map is that of the totals
        if candidate.per != "code" and not pixel_maps.by_counts(candidate):
            return False
        name = informant("codes") if candidate.per == "code" else informant("counts")
        known = map_models.information(replicates, evaluation.values, candidate, levels)
        most = max(float(np.mean(x)) for x in known.values())
        some = [id for id, x in known.items() if float(np.mean(x)) > _INFORMS * most]
        if sum(float(t @ t) for cell, t in template.items() if cell[0] in some and cell[1] == name) > IGNORED[1]:
            return False
    return True


def material(one: Trial) -> str:
    """The change of the mean rate by a candidate, as text."""
    logs = list(one.signature.at(one.times).logs.values())
    return f"mean rate {100 * math.expm1(-float(np.mean(logs)) if logs else 0.0):+.2f} %"


def change_by_map(sensor: Sensor, map_: pixel_maps.PixelMap) -> str:
    """The change of the mean of a parameter by its map, as text."""
    effect = sensor.effect(map_.carrier[0])
    listed = float(np.mean(np.asarray(getattr(effect, map_.carrier[1], 0.0), float)))
    if listed <= 0:
        return "a map where there was none"
    return f"mean of the map {100 * (float(np.mean(map_.values())) / listed - 1):+.2f} %"


def keys_of(candidate: Candidate, path: ModelPath) -> set[Key]:
    """The parameters that a candidate changes in the model of a path, without those that a later step changes."""
    if candidate.kind == "add":
        later = set().union(*(_own_keys(c) for c in path.scan.accepted if c.kind != "add"))
        return {k for k in path.values if k[0] == candidate.effect and k not in later}
    return _own_keys(candidate)


def _own_keys(candidate: Candidate) -> set[Key]:
    """The parameters of a candidate that adds no effect: the one that names it, and those that come with it."""
    return {(candidate.effect, candidate.parameter or ""), *(d.key for d in candidate.coordinates)}


def rests_on(step: Step, other: Step, path: ModelPath) -> bool:
    """Whether a step changes an effect that the other one has added, or needs that effect in the sensor."""
    effect, needed = step.candidate.effect, other.candidate.effect
    if effect == needed:
        return step is not other and other.candidate.kind == "add"
    return path.can_be({effect, needed}) and not path.can_be({effect})
