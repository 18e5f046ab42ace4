"""Trials of maps: every map whose values differ beyond their noise; patterns before maps."""

from __future__ import annotations

import contextlib
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import plugins
from ..effects import Effect
from ..errors import UNABLE
from ..sensor import Sensor
from ..statistics import informant
from . import count_model, map_models, pixel_maps
from .candidates import Candidate, with_values
from .capture_replicates import CannotSimulate
from .coordinates import Key
from .evaluation import Evaluation, square, stacked
from .evidence import evidence_of
from .hit_pixels import drawn_effects
from .levels import LEAST_EVIDENCE
from .mixed_model import NO_PATTERN, PatternEvidence, evidence_of_scene
from .models import Model
from .replicates import Replicates
from .score_test import p_of_map, sigmas_of
from .signature import Signature, residuals_at, signatures, template_of
from .trial import Trial, is_pattern, of_scene, tie

if TYPE_CHECKING:
    from .scan import Scan

MAKING_A_MAP = "making a map"  # the stage at which a map may fail
# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
# the largest p-value of a map that is tried, and of one with random odd pixels
LEAST_P_OF_MAP, LEAST_P_WITH_ODD_PIXELS = 1e-3, 0.05
# of a logarithm: widths of the pixels' differences that counts do not show, which are tried first; the last but one is
# compared with the candidate's signature
_SIGMAS = (0.003, 0.006, 0.012, 0.024, 0.05, 0.1)
# information on a pixel by its counts, in inverse variances: with more of it, a map is fitted, not drawn
_INFORMED = 50.0
# in chi square: the least evidence for a pattern that says as much as the map (one-sided p of 8e-4 with one number)
_LITTLE = 8.0
_LIKE = 0.4  # cosine of two signatures: below it they are not alike, and no random map is tried
# the least mean square of a map that is tried, relative to its noise: in others all pixels are alike
_LEAST_SPREAD = 0.05


def map_trials_of(
    scan: Scan, evaluation: Evaluation, values: dict[Key, Any], least: float = LEAST_P_OF_MAP
) -> list[Trial]:
    """The trials of maps: of every map whose values differ beyond their noise, and of all that are needed together.

    Args:
        values: the values of the model, SI.
        least: the largest p-value of a map that is tried.
    """
    if scan.only_rates(evaluation):
        return []
    levels = count_model.light_levels_of(scan.replicates, evaluation)
    held = [c for c in scan.accepted if c.carrier]
    wanted = candidate_maps(scan, evaluation)
    groups = [[c] for c in wanted]
    pixels = [c for c in wanted if c.per == "pixel" and pixel_maps.by_counts(c)]
    if len(pixels) > 1 and all(c.per == "pixel" for c in held):
        with contextlib.suppress(*UNABLE):  # each is tried by itself, too
            together = map_models.maps_needed(scan.replicates, values, held, pixels, levels)
            if len(together) > 1:
                groups.insert(0, together)
    out = []
    for group in groups:
        made: tuple[Any, ...] = ()
        with scan.if_possible(group[0], MAKING_A_MAP) if len(group) == 1 else contextlib.suppress(*UNABLE):
            made = map_models.models_with_maps(scan.replicates, values, [*held, *group], levels)
        if not made:
            continue
        sensors, found, mapped = made
        map_ = found[group[0].carrier]  # type: ignore[index]
        spread = float(np.mean((map_.estimate / np.maximum(map_.error, 1e-9)) ** 2))
        if spread < _LEAST_SPREAD:
            continue
        sensors = sensors.changed({}, scan.phases, chips=bool(drawn_effects(scan.replicates, values)))
        p = min(p_of_map(scan.replicates, evaluation, c, values, levels) for c in group)
        if p > least:
            continue
        nothing = Signature({}, {}, {})
        out.append(
            Trial(
                candidate=group[0],
                values=mapped,
                signature=nothing,
                fall=0.0,
                times=1.0,
                sensors=sensors,
                maps=found,
                more=tuple(group[1:]),
                p_value=p,
            )
        )
    return out


def candidate_maps(scan: Scan, evaluation: Evaluation) -> list[Candidate]:
    """Every map that may be tried: of no parameter that an earlier step fits as one number."""
    fit = {coordinate.key for candidate in scan.accepted for coordinate in candidate.coordinates}
    return [c for c in scan.candidates(evaluation.sensors.one) if c.carrier and c.carrier not in fit]


def patterns_first(scan: Scan, evaluation: Evaluation, tried: list[Trial]) -> list[Trial]:
    """The trials, a pattern first where it has evidence given the differences of the pixels; other patterns dropped.

    A few random odd pixels may lie in one row by accident. A pattern with as much evidence as the map is kept as well.
    """
    maps = [
        t
        for t in tried
        if t.maps and t.candidate.per == "pixel" and pixel_maps.acts_on_light(evaluation.sensors.one, t.candidate)
    ]
    patterns = [t for t in tried if is_pattern(t)]
    if not maps or not patterns:
        return tried
    assert maps[0].maps is not None
    free = maps[0].maps[maps[0].candidate.carrier]  # type: ignore[index]
    evidence: dict[str, PatternEvidence] = {}
    shapes: dict[str, np.ndarray] = {}
    for one in patterns:
        with scan.if_possible(one.candidate, "its pattern"):
            if of_scene(one):
                evidence[one.candidate.name] = _evidence_of_scene(
                    scan.replicates, evaluation, one, maps[0].candidate, free
                )
            else:
                shapes[one.candidate.name] = _shapes(evaluation.sensors.one, one.candidate)
    evidence |= pixel_maps.evidence_of_patterns(free, shapes)
    p = maps[0].p_value  # odd pixels, which the mixed model cuts off, are in it

    def is_real(e: PatternEvidence) -> bool:
        own = math.inf if p is None else max(sigmas_of(p) ** 2, e.pixels)
        as_much = own < math.inf and e.alone > own - tie(own)
        return e.given_pixels >= LEAST_EVIDENCE or (as_much and e.alone >= _LITTLE)

    real = [t for t in patterns if is_real(evidence.get(t.candidate.name, NO_PATTERN))]
    rest = [t for t in tried if not is_pattern(t) or any(t is one for one in real)]
    if not rest:
        return rest
    most = next((t for t in rest if not t.chips), rest[0])  # the squares of random odd pixels are those of more scatter
    of_pixels = most.maps is not None and most.candidate.per == "pixel"
    scenes = any(of_scene(t) for t in patterns)
    if real and (most in maps or most in real or (scenes and of_pixels)):
        first = max(real, key=lambda t: evidence[t.candidate.name].given_pixels)
        rest.remove(first)
        rest.insert(0, first)
    return rest


def _shapes(sensor: Sensor, candidate: Candidate) -> np.ndarray:
    """The shapes of a pattern over the array, (pixels, shapes), as its effect declares them; or the line of each pixel.

    Raises:
        EffectError: where a user's effect declares something else.
    """
    if candidate.per:
        return pixel_maps.groups_of(sensor, candidate.per)
    pattern = Effect.registry.find(candidate.effect)
    with plugins.blaming(pattern):
        shapes = np.asarray(pattern.light_pattern(sensor.layout), np.float64)
        if shapes.ndim != 2 or len(shapes) != sensor.layout.pixels or not np.isfinite(shapes).all():
            raise ValueError(f"light_pattern must be finite and ({sensor.layout.pixels}, shapes), not {shapes.shape}")
    return shapes


def _evidence_of_scene(
    replicates: Replicates, evaluation: Evaluation, one: Trial, candidate: Candidate, free: pixel_maps.PixelMap
) -> PatternEvidence:
    """The evidence for a change of the scene; a map of the light is not informed where no light falls.

    Args:
        candidate, free: the map of pixels that it is compared with, and its fit.
    """
    counts = informant("counts")
    ids = [id for id, name in evaluation.residuals if name == counts and replicates.of_scene(id)]
    if not ids:
        return NO_PATTERN
    after = residuals_at(replicates, evaluation, one.signature, one.times)
    levels = count_model.light_levels_of(replicates, evaluation)
    information = map_models.information(replicates, evaluation.values, candidate, levels)
    z, left = (np.stack([x[id, counts] for id in ids]) for x in (evaluation.residuals, after))
    known = np.stack([information[id] for id in ids])
    return evidence_of_scene(z, left, known, free.sigma, len(one.candidate.coordinates))


def random_map_trials(
    scan: Scan, evaluation: Evaluation, values: dict[Key, Any], like: Trial, faint: bool = False
) -> list[Trial]:
    """Trials of random maps that the counts of single pixels do not inform, with the signature of a candidate.

    The pixels of every replicate are drawn anew. A trial is returned if its evidence is a tie with that of `like`.

    Args:
        values: the values of the model, SI.
        like: the fitted trial of the candidate.
        faint: see `Scan.again`.
    """
    levels = count_model.light_levels_of(scan.replicates, evaluation)
    out = []
    for candidate in scan.candidates(evaluation.sensors.one):
        if candidate.per != "pixel" or candidate.carrier is None or candidate.effect == like.candidate.effect:
            continue
        information: Any = None
        with scan.if_possible(candidate, MAKING_A_MAP):
            information = sum(map_models.information(scan.replicates, values, candidate, levels).values())
        if information is None:
            continue
        # the intervals inform each dead time, but jitter may be what scatters them
        if float(np.median(information)) > _INFORMED and not candidate.blinds:
            continue
        best: Trial | None = None
        about, sigmas = 0.0, np.array(_SIGMAS)
        (wide,) = signatures(
            scan.replicates, evaluation, [_with_random_map(evaluation.sensors, candidate, _SIGMAS[-2])]
        )
        if isinstance(wide, CannotSimulate) or _cosine(scan, evaluation, wide, like.signature) < _LIKE:
            continue
        for _ in range(3):  # ever closer to the best width
            models = [_with_random_map(evaluation.sensors, candidate, float(sigma)) for sigma in sigmas]
            for sigma, sensors, signature in zip(
                sigmas, models, signatures(scan.replicates, evaluation, models), strict=True
            ):
                if isinstance(signature, CannotSimulate):
                    continue
                residuals = residuals_at(scan.replicates, evaluation, signature)
                fall = square(evaluation.residuals) - square(residuals)
                one = Trial(
                    candidate=candidate,
                    values={},
                    signature=signature,
                    fall=fall,
                    times=1.0,
                    sensors=sensors,
                    residuals=residuals,
                )
                one = scan._with_score(evaluation, one) if faint else one
                if best is None or one.fall > best.fall:
                    best, about = one, float(sigma)
            if best is None or best.fall < like.evidence / 2:
                break
            sigmas = about * np.exp(math.log(sigmas[1] / sigmas[0]) * np.array([-0.6, -0.3, 0.3, 0.6]))
        if best is None or best.fall < like.evidence / 2:
            continue
        with scan.if_possible(candidate, MAKING_A_MAP):
            best.evidence = best.fall if faint else evidence_of(scan.replicates, evaluation, best)
        if best.evidence > like.evidence - tie(like.evidence):
            out.append(best)
    return out


def _cosine(scan: Scan, evaluation: Evaluation, one: Signature, other: Signature) -> float:
    """The cosine of two signatures, over the statistics in which the other one is not 0."""
    templates = [template_of(scan.replicates, evaluation, signature) for signature in (one, other)]
    keys = [cell for cell in evaluation.residuals if templates[1][cell].any()]
    a, b = (stacked(template, keys) for template in templates)
    return float(a @ b) / max(math.sqrt(float(a @ a) * float(b @ b)), 1e-12)


def _with_random_map(sensors: Model, candidate: Candidate, sigma: float) -> Model:
    """The model with random differences of width `sigma` in the logarithm of a parameter, drawn for each replicate."""
    effect, parameter = candidate.carrier  # type: ignore[misc]

    def of(capture: str, number: int) -> Sensor:
        sensor = sensors.of(capture, number)
        rng = np.random.Generator(np.random.Philox(key=[number, 11]))
        values = np.asarray(getattr(sensor.effect(effect), parameter), np.float64)
        draws = np.exp(sigma * rng.standard_normal(sensor.layout.pixels))
        return with_values(sensor, {(effect, parameter): values * draws})

    return Model(of, sensors.one, alike=False, typical=sensors.mean_sensor)
