"""Maps of dark rates from counts in the dark, in closed form, without simulation.

Where captures without light inform a map of a dark rate, and nothing couples the pixels, the counts of each pixel are
a sufficient statistic. The misfit is that of the counts alone: one half of the blocks of time is judged by a map of
the other half.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from .. import twin
from ..effects import Effect
from ..errors import SpadError
from ..measurement import Measurement
from ..sensor import Sensor
from ..statistics import informant
from . import count_model, map_fits, map_models, pixel_maps
from .candidates import Candidate, with_values
from .closed_forms import CLOSED, closed_form, error_by_causes, level_for
from .laws import poisson_scores
from .levels import LEAST_P
from .model_path import change_by_map
from .pixel_maps import map_values
from .replicates import Replicates
from .results import Diagnosis, Step, title

# p-value below which a misfit is significant, of the stated model or of that with the map; a rule of thumb
_SURE = 1e-3
# factor by which the errors of a map may raise the misfit of a right map beyond that; a rule of thumb
_WIDER = 1.1
# counts, the least variance of a pixel: a pixel with hardly any count is not judged by one detection. A rule of thumb
_LEAST_VARIANCE = 0.05
_MOST_CAUSED = 0.9  # further detections of each, at most: with more of them no law of counts holds
_LEAST_MEAN = 1e-2  # of a misfit, the least mean: where a model gives no counts at all, a misfit stays a finite number
# share of the information on a map in lit captures that is neglected, at most: with more of it, models are simulated; a
# rule of thumb
_LIT = 0.02


def may_fit(sensor: Sensor, wanted: Sequence[Candidate]) -> bool:
    """Whether the fit is one map of a dark rate, of a sensor whose pixels do not couple."""
    candidate = wanted[0]
    if len(wanted) > 1 or not candidate.carrier or candidate.per != "pixel" or not pixel_maps.by_counts(candidate):
        return False
    return Effect.registry.find(candidate.effect).adds_rate and not any(map(_couples, (sensor.chip or sensor).effects))


def _couples(effect: Effect) -> bool:
    """Whether counts in the dark depend on more than a pixel's own rate: an effect reaches others, or fluctuates."""
    return effect.influence() > 0 or effect.moves_dark


class OtherwiseInformed(SpadError):
    """The counts in the dark alone do not fit a map. The message says why."""


def fit_by_counts(replicates: Replicates, measurement: Measurement, candidate: Candidate) -> Diagnosis:
    """The fit of the map by counts in the dark.

    Args:
        replicates: its captures need no summaries.
        candidate: the map.
    Raises:
        OtherwiseInformed: where there are no such counts, or other captures inform the map as well.
    """
    assert candidate.carrier is not None
    dark = [id for id, seen in replicates.seen.items() if seen.capture.light.dark and seen.counts is not None]
    if not dark:
        raise OtherwiseInformed("no dark capture with data")
    levels = {id: 1.0 if id in replicates.dark else _level(replicates, id) for id in replicates.seen}
    map_ = map_fits.fit_maps(replicates, {}, [candidate], levels, dark)[candidate.carrier]
    information = map_models.information(replicates, {candidate.carrier: map_.values()}, candidate, levels)
    whole = np.maximum(np.sum(list(information.values()), axis=0), 1e-12)
    if float(np.mean(np.sum([information[id] for id in dark], axis=0) / whole)) < 1 - _LIT:
        raise OtherwiseInformed("lit captures inform the map as well")
    return _answer(replicates, measurement, candidate, map_, dark)


def _level(replicates: Replicates, id: str) -> float:
    """The light level of a lit capture, photons/s: the stated one, or that of its total."""
    seen = replicates.seen[id]
    stated = twin.photons_at(seen.capture, replicates.start.layout)
    if stated is not None:
        return stated
    return level_for(closed_form(replicates.start, seen.counted), seen.total, None)


@dataclass(frozen=True)
class _Judged:
    """The errors of a model in the counts of captures: misfit, relative errors of the mean rate and of the map.

    Attributes:
        misfit: the mean square of the pixels' deviations, relative to what it is if the model is right.
        variance: of the misfit, if the model is right.
        p_of_totals: the p-value of the totals of the captures, which are to the misfit what all pixels have in common.
    """

    misfit: float
    mean_rate: float
    map: float
    variance: float
    p_of_totals: float

    def quantile(self, p: float) -> float:
        """The misfit that a right model exceeds with a probability of p."""
        return float(stats.gamma.isf(p, 1 / self.variance, scale=self.variance))

    def p_value(self, wider: float = 1.0) -> float:
        """The p-value of misfit and totals together: the smaller of the two, of two tests.

        Args:
            wider: factor by which the misfit of a right model may exceed 1.
        """
        p = float(stats.gamma.sf(self.misfit / wider, 1 / self.variance, scale=self.variance))
        return min(2 * min(p, self.p_of_totals), 1.0)

    def significance(self, wider: float = 1.0) -> float:
        """That p-value in standard deviations."""
        return float(stats.norm.isf(max(self.p_value(wider), LEAST_P) / 2))

    def row(self, model: str) -> dict[str, Any]:
        errors = {"mean_rate": self.mean_rate, "map": self.map}
        return {"model": model, "misfit": self.misfit, "errors": errors, "placebo": False}


def _judge(replicates: Replicates, ids: Sequence[str], sensor: Sensor, errors: np.ndarray | float = 0.0) -> _Judged:
    """The errors of a model in the counts of dark captures.

    Args:
        errors: (pixels,) relative, of the sensor's rates.
    """
    squares, totals, excess, means, variances, scores = [], [], [], [], [], []
    for id in ids:
        line = count_model.CountModel(replicates, id, 1.0)
        expected, counts = line.expected(sensor), line.seen.counts
        assert counts is not None
        # each detection causes further ones of its pixel, and these do, too: a branching process widens the counts
        caused = sum(sensor.caused().values()) if line.seen.capture.counts_events else 0.0
        own = line.variance(expected, replicates.dead, 0.0) / (1 - min(caused, _MOST_CAUSED)) ** 2
        variance = np.maximum(own + (errors * expected) ** 2, _LEAST_VARIANCE)
        apart = counts - expected
        squares.append(apart**2 / variance)
        share = (own + (errors * expected) ** 2) / variance
        means.append(share)
        variances.append(2 * share**2 + own / variance**2)  # the fourth moment of a Poisson count
        total, mean_total = float(counts.sum()), float(expected.sum())
        # a map of other counts has the errors of their total, and the closed forms theirs
        known = max(float(np.sum((errors * expected) ** 2)), mean_total) if np.any(errors) else 0.0
        unsure = CLOSED**2 + error_by_causes(sensor, line.seen.capture) ** 2
        wider = (float(own.sum()) + known + unsure * mean_total**2) / max(mean_total, 1e-300)
        score = float(poisson_scores(np.array([total]), np.array([mean_total]))[0])
        scores.append(score / math.sqrt(max(wider, 1.0)))
        totals.append(abs(max(total, 0.5) / mean_total - 1) if abs(score) > 1 else 0.0)
        excess.append(math.sqrt(max(float(np.mean(apart**2 - own)), 0.0)) / max(float(expected.mean()), 1e-12))
    mean = max(float(np.mean(means)), _LEAST_MEAN)
    spread = float(np.mean(variances)) / np.size(variances) / mean**2
    p_of_totals = float(stats.chi2.sf(float(np.square(scores).sum()), len(scores)))
    return _Judged(
        misfit=float(np.mean(squares)) / mean,
        mean_rate=float(np.mean(totals)),
        map=float(np.mean(excess)),
        variance=spread,
        p_of_totals=p_of_totals,
    )


def _answer(
    replicates: Replicates,
    measurement: Measurement,
    candidate: Candidate,
    map_: pixel_maps.PixelMap,
    dark: Sequence[str],
) -> Diagnosis:
    assert candidate.carrier is not None
    start = _judge(replicates, dark, replicates.start)
    halves = replicates.halves(dark)
    if halves.seen:  # the second half of each capture by the first
        first = [id for k, id in enumerate(halves.seen) if k % 2 == 0]
        part = map_fits.fit_maps(halves, {}, [candidate], dict.fromkeys(halves.seen, 1.0), first)[candidate.carrier]
        others = [id for id in halves.seen if id not in first]
        found = _judge(halves, others, with_values(replicates.start, {candidate.carrier: part.values()}), part.error)
    else:
        found = _judge(replicates, dark, with_values(replicates.start, {candidate.carrier: map_.values()}), map_.error)
    rest: list[dict[str, Any]] = []
    if found.p_value(_WIDER) < _SURE:  # the rates differ between blocks of time
        clear = found.significance(_WIDER)
        where = "pixels of one half of the blocks of time, by a map of the other"
        rest.append({"statistic": informant("counts"), "capture": dark[0], "significance": clear, "where": where})
    right = "explained" if start.p_value() < _SURE else "adequate"
    results = {name: replace(value, method="counts") for name, value in map_values(map_).items()}
    step = Step(
        candidate=candidate,
        values=results,
        misfit=found.misfit,
        significance=start.significance(),
        material=change_by_map(replicates.start, map_),
    )
    step.map = map_
    return Diagnosis(
        sensor=replicates.start.name,
        measurement=measurement.name,
        verdict="partly_explained" if rest else right,
        before=start.misfit,
        after=found.misfit,
        null_95=start.quantile(0.05),
        nuisances=[],
        steps=[step],
        setup=[],
        unexplained=rest,
        ladder=[start.row("start"), found.row(f"+ {title(candidate)}")],
        advice=[],
        excluded=[],
        values={candidate.carrier: map_.spread_values()},
        shape=replicates.start.layout.shape,
        asked="fit",
        dark=replicates.dark,
        crop=str(replicates.start.window) if replicates.start.window else None,
        compared="the counts in the dark",
    )
