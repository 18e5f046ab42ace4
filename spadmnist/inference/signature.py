"""Signatures: the shift of every cell that a candidate makes, per unit strength, linear and quadratic.

A signature comes from a few replicates with the same random numbers as the model's own. Their difference is nearly
free of noise; what is left of it is added to the variance of the cells.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import ndimage, stats

from ..errors import UNABLE, SpadError, why
from .capture_replicates import CannotSimulate, CaptureReplicates, joined
from .evaluation import Evaluation, far_wider, square
from .light_levels import matched_light, needed_light, totals_space
from .models import Model
from .null_distribution import residuals_of
from .replicates import FEW, TOTALS, Cell, Replicates
from .shifts import beyond_noise, mean_shift

# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
# factor on the scatter of the model's log totals: up to it, the scatter of another model is taken as the same
_SAME_SCATTER = 1.5
# one-sided p-value (3.5 sigma) below which totals deviate from the closed form, which holds otherwise
_P_TOTALS = 2.3e-4
_SURE_SQUARE = 30.0  # in variances: the square of a shift that is never noise; a smaller one of a power has no sign
_NEIGHBOURS = 9  # neighbouring powers, the median of which holds no line: that of a bin's own noise
# of the square of a signature, as a share and in variances: captures with so little are not simulated
IGNORED = 0.01, 4.0
# of the square of a signature: captures with as much of it give the values of a first fit. With 0.75 a probability and
# a lifetime that one capture hardly tells apart lost 160 of 2970 in chi square
_MOST_OF_IT = 0.95
_SURELY = 8  # replicates of each capture where the totals of a few deviate from the closed form, lest these decide
Kept = Literal["sure", "likely", "all"]  # which shifts are kept of what a few replicates show


@dataclass
class Signature:
    """The signature of a model: the shift of each cell's expectation, proportional to its strength.

    Attributes:
        shifts: (cells,) in the summary's unit, by (capture, statistic).
        noise: variance of the shift relative to the scatter of a replicate, by (capture, statistic).
        nothing: the model changes nothing in these captures, at any strength.
        even: the part that grows with the square of the strength, and is the same for both signs.
        fluctuates: the totals of the replicates scatter far more than the model's own.
    """

    shifts: dict[Cell, np.ndarray]
    noise: dict[Cell, float]
    logs: dict[str, float]  # of the factor on the light that gives as many detections, by capture
    nothing: bool = False
    even: Signature | None = None
    fluctuates: bool = False

    def only(self, ids: Collection[str]) -> Signature:
        """The signature in some captures; of the others, the totals alone."""
        shifts = {cell: x for cell, x in self.shifts.items() if cell[0] in ids}
        noise = {cell: x for cell, x in self.noise.items() if cell[0] in ids}
        even = None if self.even is None else self.even.only(ids)
        return Signature(
            shifts=shifts, noise=noise, logs=self.logs, nothing=self.nothing, even=even, fluctuates=self.fluctuates
        )

    def completed(self, other: Signature, ids: Collection[str]) -> Signature:
        """The signature, completed by that of `other` in captures of which this one has the totals alone."""
        there = other.only(ids)
        logs = {**self.logs, **{id: log for id, log in other.logs.items() if id in ids}}
        even = self.even
        if even is not None or there.even is not None:
            even = (even or Signature({}, {}, {})).completed(there.even or Signature({}, {}, {}), ids)
        shifts, noise = {**self.shifts, **there.shifts}, {**self.noise, **there.noise}
        fluctuates = self.fluctuates or other.fluctuates
        return Signature(
            shifts=shifts,
            noise=noise,
            logs=logs,
            nothing=self.nothing and other.nothing,
            even=even,
            fluctuates=fluctuates,
        )

    def at(self, times: float) -> Signature:
        """The shifts at `times` the strength, as a signature without an even part."""
        if self.even is None and times == 1:
            return self
        out = Signature(
            shifts={cell: times * x for cell, x in self.shifts.items()},
            noise={cell: times**2 * x for cell, x in self.noise.items()},
            logs={id: times * x for id, x in self.logs.items()},
            nothing=self.nothing,
        )
        if self.even is not None:
            for cell, x in self.even.shifts.items():
                out.shifts[cell] = out.shifts.get(cell, 0.0) + times**2 * x
            for id, log in self.even.logs.items():
                out.logs[id] = out.logs.get(id, 0.0) + times**2 * log
        return out

    @staticmethod
    def both(
        up: Signature, down: Signature, powers: Mapping[Cell, np.ndarray] | None = None, few: int = FEW
    ) -> Signature:
        """The signature of a strength and its opposite: the odd part and the even one.

        An effect that adds to an amplitude moves its square in proportion to the strength by what noise had in it
        already, which differs in each replicate. Such a shift is no part of the signature.

        Args:
            up, down: signatures of a strength and of its opposite.
            powers: (cells,) expectation of cells that are squares of amplitudes, by (capture, statistic).
            few: number of replicates.
        """

        def half(a: Mapping[Any, Any], b: Mapping[Any, Any], sign: float) -> dict[Any, Any]:
            return {k: 0.5 * (a.get(k, 0.0) + sign * b.get(k, 0.0)) for k in a.keys() | b.keys()}

        noise = half(up.noise, down.noise, 1.0)
        even = Signature(half(up.shifts, down.shifts, 1.0), {}, half(up.logs, down.logs, 1.0))
        odd = half(up.shifts, down.shifts, -1.0)
        for cell in odd.keys() & (powers or {}).keys():
            typical = ndimage.median_filter(powers[cell], _NEIGHBOURS)  # type: ignore[index]  # a line's own has a sign
            variance = 2 * typical * np.abs(even.shifts[cell]) / few  # of the noise that grows in proportion
            odd[cell] = np.where(odd[cell] ** 2 > _SURE_SQUARE * variance, odd[cell], 0.0)
        scatters = up.fluctuates or down.fluctuates
        return Signature(
            shifts=odd,
            noise=noise,
            logs=half(up.logs, down.logs, -1.0),
            nothing=up.nothing and down.nothing,
            even=even,
            fluctuates=scatters,
        )


def signature_of_totals(replicates: Replicates, evaluation: Evaluation, sensors: Model) -> Signature:
    """The signature in the totals alone, by the closed forms.

    Raises:
        SpadError: where the closed forms cannot be evaluated.
    """
    try:
        return Signature(
            {}, {}, {id: needed_light(replicates, evaluation, sensors.mean_sensor(id), id) for id in evaluation.rates}
        )
    except SpadError:
        raise
    except UNABLE as error:
        raise SpadError(why(error)) from error


@dataclass(frozen=True)
class Sampling:
    """What is simulated of a model for its signature, and what is kept of it.

    Attributes:
        few: replicates of each capture.
        only: the captures that are simulated; all where it is empty.
        names: the statistics that are reduced; all where it is empty.
        hasty: without costly statistics.
        remember: what is simulated of the model as it is stated is kept for other measurements of the plan.
        kept: which shifts are kept. "sure": those that are hardly ever noise (a signature). "likely": those that are
            hardly all noise (a derivative, which would otherwise be too small). "all": all.
    """

    few: int = FEW
    only: Collection[str] = ()
    names: Collection[str] = ()
    hasty: bool = True
    remember: bool = False
    kept: Kept = "likely"


def signatures(
    replicates: Replicates,
    evaluation: Evaluation,
    models: Sequence[Model],
    sampling: Sampling = Sampling(),
    only_of: Sequence[Collection[str]] | None = None,
) -> list[Signature | CannotSimulate]:
    """The signature of each model, or the error that says why it cannot be simulated.

    Args:
        models: the changed models.
        sampling: what is simulated of each of them.
        only_of: as `Sampling.only`, for each model by itself.
    """
    numbers = np.arange(sampling.few, dtype=np.uint64)
    ids_of = [
        [id for id in evaluation.made if not some or id in some] for some in only_of or [sampling.only] * len(models)
    ]
    wanted, unable = [], dict[int, CannotSimulate]()
    stated: list[bool] = []
    for k, (sensors, ids) in enumerate(zip(models, ids_of, strict=True)):
        own = []
        try:
            for id in ids:
                level = evaluation.rates[id].level * matched_light(replicates, evaluation, sensors.mean_sensor(id), id)
                own.append((sensors, id, level * evaluation.factors[id][numbers.astype(int)], numbers))
        except UNABLE as error:
            unable[k], own = CannotSimulate.because(error), []
        wanted += own
        stated += [not evaluation.values and (at := evaluation.rates[id]).level == at.stated for _, id, _, _ in own]
    names = [sampling.names] * len(wanted)
    remember = stated if sampling.remember else None
    simulated = replicates.simulate(wanted, hasty=sampling.hasty, names=names, remember=remember)
    if sampling.kept == "sure":  # a derivative is a difference of the same few replicates and needs no more
        simulated = _more_replicates(replicates, evaluation, wanted, simulated, sampling)
    results = iter(simulated)
    out: list[Signature | CannotSimulate] = []
    for k, (sensors, ids) in enumerate(zip(models, ids_of, strict=True)):
        if k in unable:
            out.append(unable[k])
            continue
        made = {id: next(results) for id in ids}
        try:
            out.append(signature_from(replicates, evaluation, sensors, made, sampling.kept))
        except UNABLE as error:
            out.append(CannotSimulate.because(error))
    return out


def _more_replicates(
    replicates: Replicates,
    evaluation: Evaluation,
    wanted: Sequence[tuple[Model, str, np.ndarray, np.ndarray]],
    made: list[CaptureReplicates | CannotSimulate],
    sampling: Sampling,
) -> list[CaptureReplicates | CannotSimulate]:
    """The replicates, and more of them where the totals of a few deviate from the closed form.

    Light that fluctuates gives another total in every replicate, and a few of them may deviate alike.
    """
    doubtful, again = [], []
    for k, ((sensors, id, _, numbers), one) in enumerate(zip(wanted, made, strict=True)):
        few = len(numbers) < min(_SURELY, len(evaluation.factors[id])) and sensors.typical is None
        if (
            few
            and isinstance(one, CaptureReplicates)
            and mean_deviation(_shift_of_totals(replicates, evaluation, sensors, id, one), evaluation.rates[id].scatter)
        ):
            doubtful.append(k)
    for k in doubtful:
        sensors, id, photons, numbers = wanted[k]
        more = np.arange(len(numbers), min(_SURELY, len(evaluation.factors[id])), dtype=np.uint64)
        level = photons[0] / evaluation.factors[id][0]
        again.append((sensors, id, level * evaluation.factors[id][more.astype(int)], more))
    out = list(made)
    names = [sampling.names] * len(again)
    found = replicates.simulate(again, hasty=sampling.hasty, names=names) if again else []
    for k, more_of in zip(doubtful, found, strict=True):
        first = out[k]
        out[k] = (
            joined([first, more_of])
            if isinstance(first, CaptureReplicates) and isinstance(more_of, CaptureReplicates)
            else more_of
        )
    return out


def _shift_of_totals(
    replicates: Replicates, evaluation: Evaluation, sensors: Model, id: str, made: CaptureReplicates
) -> np.ndarray:
    """The deviation of the log total of each replicate from the closed form, (replicates,)."""
    base, some = evaluation.made[id], made.numbers.astype(int)
    apart = np.log(np.maximum(made.totals, 0.5)) - np.log(np.maximum(base.totals[some], 0.5))
    if abs(math.log(matched_light(replicates, evaluation, sensors.mean_sensor(id), id))) < 1e-12:
        apart += needed_light(replicates, evaluation, sensors.mean_sensor(id), id)  # no other level gave as many
    return np.asarray(apart)


def signature_from(
    replicates: Replicates,
    evaluation: Evaluation,
    sensors: Model,
    made: Mapping[str, CaptureReplicates | CannotSimulate],
    kept: Kept,
) -> Signature:
    """The signature of a model from its replicates.

    Args:
        made: the replicates of some captures; the totals of the others are those of the closed form.
        kept: see `Sampling`.
    Raises:
        CannotSimulate: where a capture could not be simulated.
    """
    shifts: dict[Cell, np.ndarray] = {}
    noise: dict[Cell, float] = {}
    logs = {}
    nothing, scattered = True, False
    for id in evaluation.rates.keys() - made.keys():  # a capture that is not simulated: the closed form gives its total
        logs[id] = needed_light(replicates, evaluation, sensors.mean_sensor(id), id)
    for id, other in made.items():
        if isinstance(other, CannotSimulate):
            raise CannotSimulate(str(other))
        base, some = evaluation.made[id], other.numbers.astype(int)
        assert some[-1] == len(some) - 1  # the first replicates are compared with the first of the model's own
        null_total = evaluation.rates[id]
        logs[id] = needed_light(replicates, evaluation, sensors.mean_sensor(id), id)
        apart = _shift_of_totals(replicates, evaluation, sensors, id, other)
        scattered = scattered or far_wider(float(np.std(apart)), null_total.scatter)
        if sensors.typical is None:
            slope = null_total.level_of(math.exp(math.log(null_total.expected(null_total.level))))[2]
            logs[id] -= mean_deviation(apart, null_total.scatter) / max(slope, 0.05)
        for name, values in other.values.items():
            cell = id, name
            if cell not in evaluation.residuals:
                continue
            if values.shape[1] != len(evaluation.residuals[cell]):
                raise CannotSimulate(f"{id}: its {name} comes out in other bins than those of the measurement")
            null = evaluation.nulls[cell]
            nothing = nothing and np.array_equal(values, base.values[name][some])
            # chips with odd pixels may have many more detections; the expectation holds within the range of the
            # replicates only
            learnt = np.clip(other.totals, base.totals.min(), base.totals.max())
            new = values - null.expected_all(learnt)[0]
            old, spread = evaluation.before(cell, len(some))
            shift, left, beta = mean_shift(new, old, spread)
            if kept != "all":
                # where the replicates share no noise, that of the null distribution is in the shift, too
                noise_here = left + 3.0 * (1 - beta) / null.recordings
                expected_here, _ = evaluation.expected(cell, float(base.totals.mean()))
                shift = beyond_noise(shift, spread, noise_here, null, expected_here, len(other.totals), kept == "sure")
            if shift.any():
                shifts[cell], noise[cell] = shift, left
    return Signature(shifts=shifts, noise=noise, logs=logs, nothing=nothing, fluctuates=scattered)


def odd_and_even(replicates: Replicates, evaluation: Evaluation, up: Signature, down: Signature, few: int) -> Signature:
    """`Signature.both` of a strength and its opposite at this evaluation, from `few` replicates."""
    powers = {
        cell: evaluation.expected(cell, replicates.seen[cell[0]].total)[0]
        for cell, null in evaluation.nulls.items()
        if null.law.spectrum
    }
    return Signature.both(up, down, powers, few)


def residuals_at(
    replicates: Replicates, evaluation: Evaluation, signature: Signature, times: float = 1.0, noisy: bool = False
) -> dict[Cell, np.ndarray]:
    """The residuals of the data if the expectation were shifted by `times` the signature, (cells,) by block.

    Args:
        noisy: the variance of the shifts is added to that of the cells.
    """
    out: dict[Cell, np.ndarray] = {}
    signature = signature.at(times)
    for cell in evaluation.residuals:
        if cell == TOTALS:
            ids, _, root, _ = totals_space(replicates, evaluation)
            x = np.array([signature.logs.get(i, 0.0) for i in ids])
            out[cell] = evaluation.residuals[cell] + (root @ x if ids else 0.0)
            continue
        null, seen = evaluation.nulls[cell], replicates.seen[cell[0]]
        values = seen.summaries[cell[1]].values
        if cell not in signature.shifts:
            out[cell] = evaluation.residuals[cell]
            continue
        unshifted = evaluation.expected(cell, seen.total)
        out[cell] = residuals_of(
            null, values, unshifted, signature.shifts[cell], signature.noise.get(cell, 0.0) * noisy
        )
    return out


def fall_of(replicates: Replicates, evaluation: Evaluation, signature: Signature, times: float = 1.0) -> float:
    """The fall of the squared residuals of the data if the expectation were shifted by `times` the signature."""
    found = residuals_at(replicates, evaluation, signature, times)
    return sum(
        evaluation.square(cell) - float(z @ z) for cell, z in found.items() if z is not evaluation.residuals[cell]
    )


def size_of(replicates: Replicates, evaluation: Evaluation, signature: Signature) -> float:
    """The norm of a signature, in standard deviations."""
    return math.sqrt(square(template_of(replicates, evaluation, signature)))


def residuals_shifted(replicates: Replicates, evaluation: Evaluation, cell: Cell, shift: np.ndarray) -> np.ndarray:
    """The residuals of the data in one block if its expectation were shifted, in the shape of the shift.

    Args:
        shift: (cells,), or (shifts, cells) for several.
    """
    seen = replicates.seen[cell[0]]
    unshifted = evaluation.expected(cell, seen.total)
    return residuals_of(evaluation.nulls[cell], seen.summaries[cell[1]].values, unshifted, shift, 0.0)


def template_of(replicates: Replicates, evaluation: Evaluation, signature: Signature) -> dict[Cell, np.ndarray]:
    """The template of a signature: the expected residuals under this model of data of the other, (cells,) by block."""
    out: dict[Cell, np.ndarray] = {}
    signature = signature.at(1.0)
    for cell in evaluation.residuals:
        if cell == TOTALS:
            ids, _, root, _ = totals_space(replicates, evaluation)
            out[cell] = -(root @ np.array([signature.logs.get(i, 0.0) for i in ids])) if ids else np.zeros(0)
            continue
        null = evaluation.nulls[cell]
        shift = signature.shifts.get(cell)
        if shift is None:
            out[cell] = np.zeros(len(evaluation.residuals[cell]))
            continue
        expected, _ = evaluation.expected(cell, replicates.seen[cell[0]].total)
        out[cell] = null.law.template(shift, expected, null.spread, null.factor)
    return out


def mean_deviation(apart: np.ndarray, scatter: float) -> float:
    """The mean deviation of log totals from the closed form; 0 where it may be noise.

    The closed form has no noise: it holds where the replicates do not contradict it. For a few replicates with about
    the model's own scatter this is a rule of thumb: a few that lie close together by chance lie near the truth as
    well.

    Args:
        apart: (replicates,) deviations.
        scatter: of the model's own log totals.
    """
    n, mean = len(apart), float(np.mean(apart))
    own = float(np.std(apart)) if n > 2 else 0.0
    if own > _SAME_SCATTER * scatter and (n >= _SURELY or far_wider(own, scatter)):
        likely = float(stats.t.isf(_P_TOTALS, n - 1)) * own / math.sqrt(n - 1)
    else:  # a few that deviate alike by chance lie closer together than others would
        likely = float(stats.norm.isf(_P_TOTALS)) * min(own or math.inf, _SAME_SCATTER * scatter) / math.sqrt(n)
    return mean if abs(mean) > likely else 0.0


def captures_showing(template: Mapping[tuple[str, str], np.ndarray], share: float, most: float = np.inf) -> list[str]:
    """The smallest set of captures that holds all but a share of the square of a signature.

    For a Jacobian whole captures are kept: a statistic that hardly shows a parameter still informs it, and intervals
    without it have been too narrow.

    Args:
        template: (cells,) standard deviations, by (capture, statistic).
        share: of the square that may be left out.
        most: the same in variances.
    """
    return _showing(_squares(template), share, most)


def statistics_showing(template: Mapping[tuple[str, str], np.ndarray], share: float, most: float = np.inf) -> list[str]:
    """As `captures_showing`, the smallest set of statistics."""
    squares: dict[str, float] = {}
    for (id, name), t in template.items():
        if id:
            squares[name] = squares.get(name, 0.0) + float(t @ t)
    return _showing(squares, share, most)


def _showing(squares: Mapping[str, float], share: float, most: float) -> list[str]:
    """The smallest set of names that hold all but a share of some squares, or all but `most` in variances."""
    spare = min(share * sum(squares.values()), most)
    out = []
    for id in sorted(squares, key=lambda id: squares[id]):
        spare -= squares[id]
        if spare < 0:
            out.append(id)
    return out


def captures_informing(
    replicates: Replicates, evaluation: Evaluation, template: Mapping[tuple[str, str], np.ndarray]
) -> list[str]:
    """The captures that hold most of the square of a signature for the least work of simulating them.

    Args:
        template: (cells,) standard deviations, by (capture, statistic).
    """
    squares = _squares(template)
    work = {id: replicates.work_of(evaluation.sensors.mean_sensor(id), id) for id in squares}
    wanted, out = _MOST_OF_IT * sum(squares.values()), list[str]()
    for id in sorted(squares, key=lambda id: -squares[id] / work[id]):
        if wanted <= 0:
            break
        out.append(id)
        wanted -= squares[id]
    return out


def _squares(template: Mapping[tuple[str, str], np.ndarray]) -> dict[str, float]:
    """The square of a signature in each capture, without the totals."""
    squares: dict[str, float] = {}
    for (id, _), t in template.items():
        if id:
            squares[id] = squares.get(id, 0.0) + float(t @ t)
    return squares
