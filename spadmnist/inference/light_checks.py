"""The checks that are of no statistic: the light levels, the totals, and the pixels' ratios between wavelengths."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

from .. import units
from ..recording import Capture
from ..sensor import Sensor
from ..statistics import informant
from .checks import Check
from .levels import HALF_95
from .light_levels import LEAST_ELASTICITY, CaptureNull, Nuisance
from .null_distribution import p_of_largest, p_of_scatter
from .replicates import Cell
from .totals_tests import Level, along, directions

_ENOUGH = 20.0  # expected detections of a pixel, from which on its ratio is compared; a rule of thumb
# expectations between which slopes are interpolated; relative: how far to both sides a slope is taken
_POINTS, _ASIDE = 64, 1e-3


def ratios_between_wavelengths(
    captures: Sequence[Capture], checks: Sequence[Check], own: Mapping[Cell, np.ndarray]
) -> list[Check]:
    """The checks of the pixels' ratios between neighbouring wavelengths, of the pixels with enough detections at both.

    Each wavelength has its capture with the most detections. Deviations are those of the rates, of which a factor that
    is the same at both wavelengths drops out.

    Args:
        own: the residuals of the replicates, (replicates, cells), whose scatter pixels have together.
    """
    best: dict[float, tuple[float, Check]] = {}
    counts = informant("counts")
    for capture in captures:
        wave = capture.light.wavelength
        found = next((c for c in checks if c.capture == capture.id and c.statistic == counts), None)
        if wave is None or found is None or found.judgement is None:
            continue
        total = float(found.judgement.expected.sum())
        if wave not in best or total > best[wave][0]:
            best[wave] = total, found
    out = []
    for short, long in itertools.pairwise(sorted(best)):
        pair = [best[wave][1] for wave in (short, long)]
        judged = [check.judgement for check in pair if check.judgement is not None]
        if len({j.expected.size for j in judged}) > 1:
            continue
        some = np.flatnonzero(np.min([j.expected for j in judged], axis=0) >= _ENOUGH)
        if len(some) < 2:
            continue
        # a full pixel says nothing of its rate
        told = np.min([_relative_widths(check, some) for check in pair], axis=0) > 0
        some = some[told]
        if len(some) < 2:
            continue
        widths = [_relative_widths(check, some) for check in pair]
        each = [j.residuals[some] for j in judged]
        replicates = [own[str(check.capture), counts][:, some] for check in pair]
        number = min(map(len, replicates))
        differences = [b * widths[1] - a * widths[0] for a, b in (each, [z[:number] for z in replicates])]
        wide = np.hypot(*widths)
        z, z_own = (difference / wide for difference in differences)
        worst, square, squares = int(np.argmax(np.abs(z))), float(np.mean(z**2)), np.mean(z_own**2, axis=1)
        mean = float(squares.mean())
        p_sum, p_cell = p_of_scatter(square, squares, z.size), p_of_largest(z, z_own)
        names = " over ".join(units.show(wave, "m") for wave in (long, short))
        size = float(differences[0][worst])
        summary = pair[0].summary
        assert summary is not None
        out.append(
            Check(
                statistic="wavelength_ratio",
                capture=None,
                misfit=square / mean,
                p_value=min(1.0, 2 * min(p_sum, p_cell)),
                where=f"{summary.where(int(some[worst]))}, {names}",
                size=f"{100 * size:+.2f} % in the worst pixel",
                relative=size,
            )
        )
    return out


def _relative_widths(check: Check, some: np.ndarray) -> np.ndarray:
    """The scatter of the rates of some pixels of a map of the array, relative, (pixels,)."""
    judged, summary = check.judgement, check.summary
    assert judged is not None and summary is not None
    expected, spread = judged.expected[some], judged.spread[some]
    if summary.rate is None:
        return np.asarray(spread / expected)
    points = np.unique(np.quantile(expected, np.linspace(0, 1, _POINTS)))
    rates = np.array([[summary.rate(value * (1 + h)) for h in (-_ASIDE, _ASIDE)] for value in points.tolist()])
    slopes = np.log(rates[:, 1] / rates[:, 0]) / (2 * _ASIDE)  # d log rate / d log value
    return np.asarray(spread / expected * np.interp(expected, points, slopes))


def level_checks(
    sensor: Sensor,
    capture: Capture,
    total: float,
    made: CaptureNull,
    levels: list[Level],
) -> list[Check]:
    """The check of the total of a dark capture; for a lit one its light level is appended to `levels`."""
    if made.stated is None:
        return []
    lost = not capture.light.dark and made.says_nothing(total)
    if not capture.light.dark and not lost:
        level, error, elasticity = made.level_of(max(total, 0.5))
        if elasticity > LEAST_ELASTICITY:
            log = math.log(level / made.stated)
            levels.append(Level(capture, log, error, elasticity=elasticity, freedom=made.freedom))
            return []
        lost = True
    mean = made.total_at(made.stated)
    light = math.hypot(capture.light.relative_uncertainty, capture.light.own_uncertainty)
    z = made.score(total, light if lost else 0.0)
    per = sensor.layout.pixels * capture.conditions.within_frames.live_time
    size = f"{total / per:.4g} /s in a pixel, {mean / per:.4g} /s expected"
    relative = (total - mean) / max(mean, 1.0)
    p = float(2 * stats.norm.sf(abs(z)))
    where = "all pixels, no light"
    if lost:
        full = made.saturated or total > mean
        where = f"all pixels, {'too much light to count' if full else 'hardly any light'}"
    return [
        Check(statistic="rate", capture=capture.id, misfit=z * z, p_value=p, where=where, size=size, relative=relative)
    ]


def light_of(levels: Sequence[Level], captures: Sequence[Capture]) -> tuple[list[Nuisance], list[Check]]:
    """(nuisance parameters, checks): the common light factor and each capture's own, against the stated levels.

    The factor of a capture is the common one to the power of its relative uncertainty over the largest.

    Args:
        levels: of each lit capture.
        captures: all captures.
    """
    if not levels:
        return [], []
    x = np.array([one.log for one in levels])
    estimated = np.maximum([one.error for one in levels], 1e-6)
    error = np.hypot(estimated, [one.capture.light.own_uncertainty for one in levels])
    uncertain = np.array([one.capture.light.relative_uncertainty for one in levels])
    common = float(uncertain.max())
    follows = uncertain / common if common > 0 else np.ones(len(levels))  # the common factor, to this power
    root = np.linalg.inv(np.linalg.cholesky(np.diag(error**2) + np.outer(uncertain, uncertain)))
    vectors, _ = directions(list(uncertain), [True] * len(levels))
    freedom = np.array([one.freedom for one in levels])
    *of_captures, (pull, p_light) = along(root, root @ x, vectors, estimated, freedom)
    weight = 1 / error**2
    informed = (weight * follows**2).sum()
    total_weight = informed + (1 / common**2 if common > 0 else 1e18)
    projection = float((weight * follows * x).sum())
    best = projection / total_weight
    spread = 1 / math.sqrt(total_weight)
    own = projection / informed  # the estimate of the captures alone, without the stated level
    name = "light"
    low, high = (math.exp(best + k * spread) for k in (-HALF_95, HALF_95))
    nuisances = [Nuisance(capture=None, name=name, value=math.exp(best), low=low, high=high, pull=pull, stated=common)]
    checks = [
        Check(
            statistic=name,
            capture=None,
            misfit=pull**2,
            p_value=p_light,
            where="all lit captures",
            size=f"light {100 * math.expm1(own):+.2f} % relative to the stated level, known to {100 * common:.2f} %",
            relative=math.expm1(own),
        )
    ]
    for (capture, log, _, elasticity, _), e, power, (z, p) in zip(levels, error, follows, of_captures, strict=True):
        # the common factor by the other captures and the stated level
        by_level, by_others = 1 / common**2 if common > 0 else 1e18, informed - power**2 / e**2
        others = by_others + by_level
        mean = power * (projection - power * log / e**2) / others
        if capture.light.own_uncertainty > 0:
            low, high = (math.exp(log + k * e) for k in (-HALF_95, HALF_95))
            stated = capture.light.own_uncertainty
            nuisances.append(
                Nuisance(capture=capture.id, name=name, value=math.exp(log), low=low, high=high, pull=z, stated=stated)
            )
        change = math.expm1((log - mean) * elasticity)
        told = "the other captures" if by_others > by_level else "the stated level"
        size = f"{100 * change:+.2f} % detections relative to {told}"
        checks.append(
            Check(
                statistic="rate",
                capture=capture.id,
                misfit=z * z,
                p_value=p,
                where="all pixels",
                size=size,
                relative=change,
            )
        )
    return nuisances, checks
