"""Light levels: the nuisance parameter of every capture, from its total, by the closed forms of the effects.

The total of a capture gives its level. A separate test compares the level with the stated one, within its
uncertainty.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .. import twin
from ..recording import Capture
from ..sensor import Sensor
from .closed_forms import bisection, closed_form, level_for, most_detections, rising_until
from .laws import poisson_scores
from .models import InTheDark
from .reduction import ReducedCapture
from .replicates import Replicates

if TYPE_CHECKING:
    from .evaluation import Evaluation

# A value without another reason is a rule of thumb: no measurement that is kept chose it.
SPREAD = 3.0  # standard deviations of the stated level: half the range over which the light of the replicates varies
LEAST_SPREAD = 0.01  # of a logarithm: the least half range of the light of the replicates
# of a logarithm: the largest half range by an uncertainty, of 5 %: over a wider one no regression on the total holds
_WIDE = 0.15
_NOISE = 4.0  # standard deviations of the counts: within it a total is the expected one, and the stated level is taken
# of a logarithm: the noise of the counts beyond which it extends the range of the replicates; the most that it counts
_MUCH, _MOST_NOISE = 0.05, 0.7
_DROWNED = 0.5  # of the elasticity at the stated level: below it, the total hardly depends on the light
LEAST_ELASTICITY = 0.01  # the least elasticity of a total that informs the light level
_MOST_LIGHT, _MOST_DARK = 1.5, 9.0  # of a logarithm, lit and dark: the most that a level moves for as many detections
# expected detections: the least that inform the level; below the other, none are expected
_LEAST_TOTAL, _NEVER = 5.0, 0.5
_SOME = 0.3  # standard deviations: a smaller deviation does not determine the error of a level
_FEW_COUNTS = 30.0  # expected detections of a lit capture: the logarithm of fewer is not normal, they have a score
_FAINT = 1e-6  # of the stated light: as good as none, for the total in the dark


@dataclass(frozen=True)
class CaptureNull:
    """The total of a capture under the model, as a function of the light level.

    Attributes:
        level: the level about which the replicates were made: photons/s on a pixel, in the dark a factor on the
            rates.
        stated: the level of the measurement file, in the same unit; None where it states none.
        totals: (replicates,) detections of each.
        expected: level -> detections of the array, by the closed forms.
        law: (offset, slope) of the log of the total as a function of the log of `expected`.
        scatter: standard deviation of the log of the total about that law.
        most: detections that the capture can hold; inf where there is no end to them.
    """

    level: float
    stated: float | None
    totals: np.ndarray
    expected: Callable[[float], float]
    law: tuple[float, float]
    scatter: float
    most: float = math.inf

    def total_at(self, level: float) -> float:
        """Expected detections of the whole array at a level."""
        return math.exp(self.law[0] + self.law[1] * math.log(self.expected(level)))

    def level_of(self, total: float) -> tuple[float, float, float]:
        """(level that gives this total, standard error of its log, elasticity of the total there)."""
        low, high = self.level * 1e-6, self._highest
        found = bisection(self.total_at, total, low, high)
        elasticity = self.elasticity_at(found)
        return found, self._scatter / max(elasticity, 1e-3), elasticity

    @functools.cached_property
    def _highest(self) -> float:
        """The highest level that is looked at: the total may fall beyond a maximum, with a paralyzable dead time."""
        return rising_until(self.expected, self.level * 1e-6, self.level * 1e6)

    def elasticity_at(self, level: float) -> float:
        """Elasticity of the total: d log(total) / d log(level)."""
        step = 1.01
        return math.log(self.total_at(level * step) / self.total_at(level / step)) / (2 * math.log(step))

    @property
    def _scatter(self) -> float:
        return self.scatter * math.sqrt(1 + 2 / len(self.totals))

    @property
    def freedom(self) -> float:
        """Degrees of freedom of `scatter`: the law of the totals has two numbers."""
        return float(max(len(self.totals) - 2, 1))

    @property
    def saturated(self) -> bool:
        """Whether the total does not depend on the light at the stated level: frames, counters or a bus are full."""
        return self.stated is not None and self.elasticity_at(self.stated) < LEAST_ELASTICITY

    def says_nothing(self, total: float) -> bool:
        """Whether a total does not inform the light level: too many detections, too few, or a saturated model.

        The level that gives such a total is meaningless, or far from normal; `score` applies.
        """
        if self.stated is None:
            return False
        stated = self.total_at(self.stated)
        if self.saturated or stated < _FEW_COUNTS:
            return True
        _, _, elasticity = self.level_of(max(total, 0.5))
        if total >= stated:
            return elasticity <= LEAST_ELASTICITY
        return elasticity < _DROWNED * self.elasticity_at(self.stated)

    def score(self, total: float, uncertainty: float = 0.0, mean: float | None = None) -> float:
        """The deviation of a total from the expected one, in standard deviations, as the normal score of its counts.

        Args:
            total: detections.
            uncertainty: relative, of the stated level.
            mean: the expectation; by default that of the stated level.
        """
        assert self.stated is not None
        mean = self.total_at(self.stated) if mean is None else mean
        level = uncertainty * self.elasticity_at(self.stated) if uncertainty else 0.0
        if mean > self.most / 2:  # of what can be full, by what is not full
            free, wanted = max(self.most - total, 0.0), max(self.most - mean, 1e-3)
            made = float(self.totals.mean())
            wider = max(self._scatter * made / math.sqrt(max(self.most - made, 1.0)), 1.0)
            wider = math.hypot(wider, level * mean / math.sqrt(max(wanted, 1.0)))
            return -float(poisson_scores(np.array([free]), np.array([wanted]))[0]) / wider
        if self.saturated:  # a full bus scatters less than counts do, and by a count at least
            return (total - mean) / max(math.hypot(self._scatter, level) * mean, 1.0)
        wider = math.hypot(self.dispersion_at(mean, self._scatter), level * math.sqrt(max(mean, 1.0)))
        return float(poisson_scores(np.array([total]), np.array([max(mean, 1e-3)]))[0]) / max(wider, 1.0)

    def dispersion_at(self, mean: float, scatter: float) -> float:
        """The factor on the scatter of independent events that totals of this mean have; at least 1.

        The replicates may be at another level than the stated one: their scatter is then that of other counts. What two
        such variances do not account for is that of the rate, which stays in proportion.
        """
        here = max(float(self.totals.mean()), 0.5)
        if self.level == self.stated or here > mean:
            return max(1.0, scatter * math.sqrt(max(mean, 1.0)))
        return math.sqrt(max(1.0, scatter**2 * here) + max(scatter**2 - 2 / here, 0.0) * mean)


def law_of(totals: np.ndarray, closed: np.ndarray) -> tuple[tuple[float, float], float]:
    """((offset, slope), scatter) of the regression of log totals on the log of the closed form.

    The slope has a prior of 1 with a standard deviation of 0.02.

    Args:
        totals: (replicates,) detections.
        closed: (replicates,) detections by the closed form.
    """
    x, y = np.log(closed), np.log(np.maximum(totals, 0.5))
    apart = x - x.mean()
    deviation = y - y.mean() - apart
    noise = float(np.var(deviation, ddof=1)) / 0.02**2
    slope = 1 + float(apart @ deviation) / (float(apart @ apart) + max(noise, 1e-12))
    offset = float(y.mean() - slope * x.mean())
    return (offset, slope), float(np.std(y - offset - slope * x, ddof=2))


def levels_about(
    expected: Callable[[float], float], total: float, stated: float | None, capture: Capture, most: float
) -> tuple[float, float]:
    """(level about which a capture is simulated, half the range of its logarithm).

    The measurement's own level lies within that range, or outside by no more than its noise.

    Args:
        expected: level -> detections.
        total: detections of the measurement.
        stated: the stated level; None where there is none.
        most: detections that the capture can hold; inf where there is no end to them.
    """
    centre = level_for(expected, total, stated)
    half = max(LEAST_SPREAD, SPREAD * math.hypot(capture.light.relative_uncertainty, capture.light.own_uncertainty))
    if half > _WIDE * (1 + 1e-9) and total > 0:  # over a wider range no regression on the total holds
        return centre, _WIDE
    if stated is not None:
        wanted = expected(stated)
        noise = min(_NOISE / math.sqrt(max(wanted, 1.0)), _MOST_NOISE)
        # where frames or counters are full a total says little of its light; it is as expected, all the same
        if total == 0 or abs(math.log(centre / stated)) < half + noise or as_expected(capture, total, wanted, most):
            # the same replicates then serve every measurement of this model; where detections are few, their range
            # reaches the data
            return stated, half + noise if noise > _MUCH else half
    return centre, half


def as_expected(capture: Capture, total: float, wanted: float, most: float) -> bool:
    """Whether a total lies within the noise of the expected one.

    In binary frames the noise is that of the rarer ones, with a detection or without.

    Args:
        total, wanted: detections, measured and expected.
        most: detections that the capture can hold.
    """
    free = most - wanted if math.isfinite(most) and not capture.counts_events else wanted
    return abs(total - wanted) < _NOISE * math.sqrt(max(min(free, wanted), 0.0) + 1.0)


@dataclass(frozen=True)
class Nuisance:
    """The estimate of a nuisance parameter, the light level.

    Attributes:
        capture: the name of the capture; None for the factor that all lit captures share.
        name: "light".
        value: the estimate, relative to the stated level; low, high: the ends of its 95 % confidence interval.
        pull: deviation from the stated level, in standard deviations.
        stated: relative standard uncertainty of the level, as the measurement states it.
    """

    capture: str | None
    name: str
    value: float
    low: float
    high: float
    pull: float
    stated: float = 0.0


def expected_total(replicates: Replicates, sensor: Sensor, id: str) -> Callable[[float], float]:
    """The function level -> the total of a capture; in the dark the level is a factor on the rates."""
    capture = replicates.seen[id].counted
    return closed_form(InTheDark.of(sensor) if capture.light.dark else sensor, capture)


def matched_light(replicates: Replicates, evaluation: Evaluation, sensor: Sensor, id: str) -> float:
    """The factor on the light at which a sensor gives as many detections as the evaluated model.

    It is 1 where there is none. Statistics are compared at the same total; they must not be extrapolated to another.
    """
    null, form = evaluation.rates[id], expected_total(replicates, sensor, id)
    wanted = math.log(null.expected(null.level))
    x = 0.0
    # in the dark all rates are scaled; light saturates, so that a large factor is another regime
    most = _MOST_DARK if replicates.seen[id].capture.light.dark else _MOST_LIGHT
    for _ in range(6 + round(2 * most)):
        here = math.log(form(null.level * math.exp(x)))
        if abs(wanted - here) < 1e-7:
            break
        slope = (math.log(form(null.level * math.exp(x + 0.01))) - here) / 0.01
        if slope < 0.02:
            return 1.0
        x += max(-0.5, min(0.5, (wanted - here) / slope))
    return math.exp(x) if abs(x) < most else 1.0


def needed_light(replicates: Replicates, evaluation: Evaluation, sensor: Sensor, id: str) -> float:
    """The log of the factor on the light (dark: on the rates) at which a sensor gives as many detections."""
    ratio = matched_light(replicates, evaluation, sensor, id)
    if ratio != 1.0:
        return math.log(ratio)
    null = evaluation.rates[id]
    here = null.expected(null.level)
    slope = math.log(null.expected(null.level * 1.01) / here) / math.log(1.01)
    return -math.log(expected_total(replicates, sensor, id)(null.level) / here) / max(slope, 0.05)


def central_level(
    replicates: Replicates, sensor: Sensor, seen: ReducedCapture
) -> tuple[float, float | None, Callable[[float], float], float]:
    """(level about which a capture is simulated, stated level, level -> detections, half the range of the log level).

    Args:
        sensor: the sensor whose closed forms hold.
        seen: the reduced capture.
    """
    capture = seen.counted
    if capture.light.dark:
        sensor, stated = InTheDark.of(sensor), 1.0
    else:
        stated = twin.photons_at(capture, sensor.layout)  # type: ignore[assignment]
    expected = closed_form(sensor, capture)
    most = most_detections(capture, sensor.layout.pixels)
    centre, half = levels_about(expected, seen.total, stated, capture, most)
    return centre, stated, expected, half


def _stated(replicates: Replicates, evaluation: Evaluation) -> list[str]:
    return [
        id
        for id in replicates.seen
        if evaluation.rates[id].stated is not None
        and _informative(replicates, evaluation.rates[id], replicates.seen[id].total)
    ]


def _informative(replicates: Replicates, null: CaptureNull, total: float) -> bool:
    """Whether a total informs the level: enough detections are expected, or some are expected and enough are there."""
    stated = float(null.stated or 1.0)
    # by the closed form: the law of the totals counts an empty replicate as half a detection
    few = null.expected(stated) >= _NEVER and total >= _LEAST_TOTAL
    return few or null.total_at(stated) >= _LEAST_TOTAL


def totals_space(
    replicates: Replicates, evaluation: Evaluation
) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray]:
    """(captures, elasticities, inverse root of the covariance of the log levels, the light's part in it).

    The arrays have shapes (captures,), (captures, captures), (captures,).
    """
    if evaluation.space is not None:
        return evaluation.space
    ids, elasticity, c = stated_levels(replicates, evaluation)
    compared = [whole_of(replicates, id) not in replicates.unstated for id in ids]
    ids, elasticity, c = [id for id, yes in zip(ids, compared, strict=True) if yes], elasticity[compared], c[compared]
    errors = np.array([level_error(replicates, evaluation, id) for id in ids])
    root = np.linalg.inv(np.linalg.cholesky(np.diag(errors**2) + np.outer(c, c))) if ids else np.zeros((0, 0))
    evaluation.space = ids, elasticity, root, c
    return evaluation.space


def whole_of(replicates: Replicates, id: str) -> str:
    """The name of a capture, or of that of which it is a half."""
    half_of = replicates.seen[id].half_of
    return id if half_of is None else half_of[0].id


def stated_levels(replicates: Replicates, evaluation: Evaluation) -> tuple[list[str], np.ndarray, np.ndarray]:
    """(captures whose level is stated and informed, elasticities (captures,), the light's part in the errors)."""
    ids = _stated(replicates, evaluation)
    elasticities = [evaluation.rates[id].level_of(max(replicates.seen[id].total, 1.0))[2] for id in ids]
    lights = [replicates.seen[id].capture.light for id in ids]
    common = np.array([0.0 if light.dark else light.relative_uncertainty for light in lights])
    return ids, np.array([max(x, 1e-3) for x in elasticities]), common


def level_error(replicates: Replicates, evaluation: Evaluation, id: str) -> float:
    """The standard deviation of the log of a capture's level (dark: of its rates), its own uncertainty included."""
    null, light = evaluation.rates[id], replicates.seen[id].capture.light
    level, error, slope = null.level_of(max(replicates.seen[id].total, 1.0))
    if light.dark:
        error = max(error, 1 / math.sqrt(null.total_at(1.0)) / max(slope, 1e-3))
    stated = float(null.stated or 1.0)
    z = score_of_total(replicates, evaluation, id, replicates.seen[id].total, null.total_at(stated))
    if z is not None:
        level, _, _ = null.level_of(max(replicates.seen[id].total, 0.5))
        apart = abs(math.log(level / stated))
        error = apart / abs(z) if abs(z) > _SOME else max(error, apart / _SOME)
    return max(math.hypot(error, light.own_uncertainty), 1e-6)


def estimated_errors(
    replicates: Replicates, evaluation: Evaluation, ids: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """(the part of each `level_error` that the scatter of the replicates gives, its degrees of freedom), (captures,).

    A score by the counts' own law is no estimate: its part is 0.
    """
    parts, freedom = [], []
    for id in ids:
        null, seen = evaluation.rates[id], replicates.seen[id]
        by_law = seen.capture.light.dark or null.says_nothing(seen.total)
        error = level_error(replicates, evaluation, id)
        own = seen.capture.light.own_uncertainty
        parts.append(0.0 if by_law else math.sqrt(max(error**2 - own**2, 0.0)))
        freedom.append(null.freedom)
    return np.array(parts), np.array(freedom)


def score_of_total(
    replicates: Replicates, evaluation: Evaluation, id: str, total: float, expected: float
) -> float | None:
    """The deviation of a total in standard deviations; None where the log of the level is normal enough.

    It is not normal for few dark counts, nor where the detections of the light are few compared with the dark ones.
    """
    null = evaluation.rates[id]
    stated = float(null.stated or 1.0)
    if replicates.seen[id].capture.light.dark:
        wider = null.dispersion_at(expected, null.scatter) if expected >= _LEAST_TOTAL else 1.0
        return float(poisson_scores(np.array([round(total)]), np.array([max(expected, 1e-3)]))[0]) / wider
    if null.says_nothing(total):
        return null.score(total, mean=expected)
    if null.total_at(_FAINT * stated) < 0.5 * null.total_at(stated):
        return None
    scatter = null.scatter * math.sqrt(1 + 2 / len(null.totals))
    return math.log(max(total, 0.5) / expected) / max(scatter, 1e-9)


def totals_residuals(replicates: Replicates, evaluation: Evaluation, logs: Mapping[str, float]) -> np.ndarray:
    """The residuals of the totals: independent, of variance 1; the light's common factor is in their covariance.

    Args:
        logs: log of the total, detections, by capture.
    """
    ids, _, root, _ = totals_space(replicates, evaluation)
    return root @ log_levels(replicates, evaluation, ids, logs) if ids else np.zeros(0)


def log_levels(
    replicates: Replicates, evaluation: Evaluation, ids: Sequence[str], logs: Mapping[str, float]
) -> np.ndarray:
    """The logs of the levels (dark: of the rates) that give these totals, relative to the stated ones, (captures,)."""
    return np.array(
        [
            math.log(evaluation.rates[id].level_of(math.exp(logs[id]))[0] / float(evaluation.rates[id].stated or 1.0))
            for id in ids
        ]
    )


def own_totals(replicates: Replicates, evaluation: Evaluation, k: int, draw: float) -> np.ndarray:
    """The residuals of the totals of one replicate, (captures,).

    Args:
        k: the number of the replicate.
        draw: a standard normal number, the deviation of the light's common factor.
    """
    ids, elasticities, root, common = totals_space(replicates, evaluation)
    x = []
    # each capture's light deviates by itself as well
    apart = [replicates.seen[id].capture.light.own_uncertainty for id in ids]
    if any(apart):
        own = np.random.Generator(np.random.Philox(key=[replicates.seed + 2, k])).standard_normal(len(ids)) * apart
    else:
        own = np.zeros(len(ids))
    for id, slope, deviation in zip(ids, elasticities, own, strict=True):
        null = evaluation.rates[id]
        mean_log = null.law[0] + null.law[1] * math.log(null.expected(float(null.level * evaluation.factors[id][k])))
        z = score_of_total(replicates, evaluation, id, float(null.totals[k]), math.exp(mean_log))
        if z is not None:
            x.append(z * level_error(replicates, evaluation, id))
            continue
        x.append((math.log(max(null.totals[k], 0.5)) - mean_log) / slope + deviation)
    return root @ (np.array(x) + draw * common) if ids else np.zeros(0)
