"""Which pixels an effect has hit that hits them at random, by their counts.

A simulated chip has such an effect in other pixels than the measured chip. A map of the pixels is therefore fitted with
the pixels that the effect has hit in the data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from .. import plugins
from ..sensor import Sensor
from .candidates import with_values
from .coordinates import Key, Values
from .count_model import CountModel
from .replicates import Replicates

# Where no other reason stands, a value is a rule of thumb: no measurement that is kept chose it.
# expected number of pixels in the array that are taken as hit although they are not: less than one. It is the level of
# the test of each pixel; where a typical hit would not pass it, the counts identify no pixel
_FALSE_HITS = 0.5
_ENOUGH = 0.1  # of what a hit adds in the mean: the least excess of a pixel that is taken as hit
_MOST = 0.4  # share of the pixels: with more of them hit, the median of all is no longer that of the others
_LEVEL = 10.0  # detections of most pixels, from which on their median gives the level and their scatter


@dataclass(frozen=True)
class PixelsHit:
    """The pixels that an effect has hit.

    Attributes:
        hit: (pixels,) bool.
        values: the parameters under which the effect is in exactly these, SI.
    """

    hit: np.ndarray
    values: dict[Key, Any]


def pixels_hit(
    replicates: Replicates, levels: Mapping[str, float], values: Values, effect: str, differ: bool = False
) -> PixelsHit | None:
    """The pixels whose counts show an effect that hits pixels at random; None where the counts do not identify them.

    The median of the pixels gives the level of a capture: pixels that are hit at random hardly move it.

    Args:
        differ: the pixels differ by themselves as well, by a lognormal law: a hit is beyond it.
        levels: light level by capture.
        values: of the model with the effect, SI.
    Raises:
        SpadError: where a user's effect says something else.
    """
    pixels = replicates.start.layout.pixels
    counted = [id for id, seen in replicates.seen.items() if seen.counts is not None]
    sensor = with_values(replicates.start, values)
    if not counted or not of_pixels(sensor, effect, np.zeros(pixels, bool)):
        return None
    without, throughout = (
        with_values(replicates.start, {**values, **of_pixels(sensor, effect, np.full(pixels, hit))})
        for hit in (False, True)
    )
    p, of_a_hit = np.ones(pixels), np.ones(pixels)  # p-values of each pixel, and of one that is hit
    for id in counted:
        line = CountModel(replicates, id, levels[id])
        counts, low, high = replicates.seen[id].counts, line.expected(without), line.expected(throughout)
        assert counts is not None
        wider = 1.0
        if (median := float(np.median(counts))) >= _LEVEL:
            scale = median / float(np.median(low))
            low, high = low * scale, high * scale
            scatter = 1.4826 * float(np.median(np.abs(counts - low)))
            wider = max(scatter**2 / float(np.median(line.variance(low, 0.0))), 1.0)
        more = counts - low > _ENOUGH * (high - low)
        p_here, p_of_hit = line.p_of_more(counts, low, wider), line.p_of_more(high, low, wider)
        if differ and median >= _LEVEL:
            logs = np.log(np.maximum(counts, 0.5) / low)
            width = 1.4826 * float(np.median(np.abs(logs - np.median(logs))))
            beyond, of_hit = logs - np.median(logs), np.log(high / low)
            p_here = np.maximum(p_here, special.ndtr(-beyond / max(width, 1e-9)))
            p_of_hit = np.maximum(p_of_hit, special.ndtr(-of_hit / max(width, 1e-9)))
        p = np.minimum(p, np.where(more, len(counted) * p_here, 1.0))
        of_a_hit = np.minimum(of_a_hit, len(counted) * p_of_hit)
    hit = p < _FALSE_HITS / pixels
    if float(np.median(of_a_hit)) > _FALSE_HITS / pixels or not 0 < float(np.mean(hit)) < _MOST:
        return None
    return PixelsHit(hit, of_pixels(sensor, effect, hit))


def of_pixels(sensor: Sensor, effect: str, hit: np.ndarray) -> dict[Key, Any]:
    """The values under which an effect of the sensor is in exactly these pixels, SI; none where it does not say them.

    Args:
        hit: (pixels,) bool.
    Raises:
        EffectError: where a user's effect fails, or says what it cannot be.
    """
    own = sensor.effect(effect)
    assert own is not None
    with plugins.blaming(type(own)):
        said = own.of_pixels(hit)
        if not isinstance(said, dict) or not said.keys() <= own.parameters.keys():
            raise ValueError(f"of_pixels must be a dict of parameters, {', '.join(own.parameters)}; not {said!r:.80}")
        plugins.check_values(type(own)(**{**{name: getattr(own, name) for name in own.parameters}, **said}))
    return {(effect, name): value for name, value in said.items()}


def drawn_effects(replicates: Replicates, values: Values) -> list[str]:
    """The effects that a model adds to the stated one and whose pixels it draws: nothing says which were hit.

    Args:
        values: of the model, SI.
    """
    added = {effect for effect, _ in values if replicates.start.effect(effect) is None}
    if not added:
        return []
    sensor = with_values(replicates.start, values)
    none = np.zeros(replicates.start.layout.pixels, bool)
    said = {effect: of_pixels(sensor, effect, none) for effect in sorted(added) if sensor.effect(effect) is not None}
    return [effect for effect, own in said.items() if own and not any(np.ndim(values.get(key, 0.0)) for key in own)]


def beside_maps(
    replicates: Replicates, values: Values, carriers: set[Key], levels: Mapping[str, float]
) -> dict[Key, Any]:
    """The values of a model for the fit of maps, SI: an effect that hits pixels at random is in the pixels it has hit.

    These are located by the counts. Where the counts locate none, the effect is in no pixel. The pixels that the model
    draws are not those of the measured chip: a map that is fitted with them takes the effect away there.

    Args:
        values: of the model, SI; carriers: (effect, parameter) of the maps.
        levels: light level by capture.
    """
    without = {key: x for key, x in values.items() if key not in carriers}
    none = np.zeros(replicates.start.layout.pixels, bool)
    out = dict(values)
    for effect in drawn_effects(replicates, without):
        hit = pixels_hit(replicates, levels, without, effect, differ=True)
        out |= of_pixels(with_values(replicates.start, without), effect, none) if hit is None else hit.values
    return out
