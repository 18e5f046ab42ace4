"""Expected detections of each pixel in a capture, by the closed forms of the effects, for fits of maps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import stats

from ..sensor import Sensor
from .candidates import with_values
from .closed_forms import events_in_frames, pixel_counts
from .coordinates import Key
from .models import InTheDark
from .replicates import Replicates


class CountModel:
    """The expected detections of each pixel in one capture, by closed forms, for maps.

    In a capture of first stamps, they are the detections in the time before the first stamps.
    """

    def __init__(self, replicates: Replicates, id: str, level: float):
        """The model of a capture.

        Args:
            id: of the capture.
            level: photons/s on a pixel; in the dark a factor on the rates.
        """
        self.seen, self.id, self.level = replicates.seen[id], id, level
        self.conditions = self.seen.capture.conditions
        self.waited = self.seen.waited
        self.frames = not self.seen.capture.counts_events and self.waited is None

    def expected(self, sensor: Sensor) -> np.ndarray:
        """The expected detections of each pixel, (pixels,)."""
        if self.seen.capture.light.dark:
            sensor = InTheDark.of(sensor)
        if self.waited is None:
            return np.maximum(pixel_counts(sensor, self.seen.capture)(self.level), 1e-9)
        events = events_in_frames(sensor, np.full((1, sensor.layout.pixels), self.level), self.conditions)[0]
        return np.asarray(np.maximum(self.waited * events, 1e-9))

    def alone(self, sensor: Sensor) -> np.ndarray:
        """The expected detections of each pixel without those that other pixels cause, (pixels,).

        An effect with values of the pixels stays: a map of them is one of their own.
        """
        own = [
            e
            for e in sensor.effects
            if not 0 < e.influence() < math.inf or any(p.per_pixel for p in e.parameters.values())
        ]
        return self.expected(sensor if len(own) == len(sensor.effects) else sensor.changed(effects=own))

    def log_likelihood(self, expected: np.ndarray) -> np.ndarray:
        """The log-likelihood of the measured counts, (pixels,), up to a constant.

        Args:
            expected: (pixels,) detections.
        """
        counts = self.seen.counts
        assert counts is not None
        if not self.frames:
            return np.asarray(counts * np.log(expected) - expected)
        share = np.clip(expected / self.conditions.frames, 1e-12, 1 - 1e-9)
        return np.asarray(counts * np.log(share) + (self.conditions.frames - counts) * np.log1p(-share))

    def p_of_more(self, counts: np.ndarray, expected: np.ndarray, wider: float) -> np.ndarray:
        """The p-value of as many counts or more, (pixels,).

        Args:
            counts: (pixels,) detections.
            expected: (pixels,) detections.
            wider: variance of the counts relative to that of their law.
        """
        least = np.floor(counts / wider) - 1
        if not self.frames:
            return np.asarray(stats.poisson.sf(least, expected / wider))
        frames = self.conditions.frames
        return np.asarray(stats.binom.sf(least, max(round(frames / wider), 1), np.minimum(expected / frames, 1.0)))

    def saturated(self, counts: np.ndarray) -> bool:
        """Whether half of the pixels have a detection in nearly every frame.

        Args:
            counts: (pixels,) detections.
        """
        return self.frames and float(np.median(counts)) > 0.9 * self.conditions.frames

    def variance(self, n: np.ndarray, dead: float, least: float = 0.25) -> np.ndarray:
        """The variance of the counts, (pixels,).

        Args:
            n: (pixels,) expected detections.
            dead: dead time, s.
            least: of the variance.
        """
        if self.waited is not None:
            return np.maximum(n, least)
        if self.frames:
            return np.maximum(n * (1 - np.minimum(n / self.conditions.frames, 1 - 1e-4)), least)
        live = self.conditions.within_frames.live_time
        return np.maximum(n * (1 - np.minimum(n * dead / live, 0.99)) ** 2, least)


def expected_counts(replicates: Replicates, id: str, evaluation: Any, values: Mapping[Key, Any]) -> np.ndarray:
    """The expected counts of each pixel in a capture with some values changed, (pixels,).

    Of first stamps, in the time that each pixel waited: so they are proportional to the light, too.

    Args:
        values: by (effect, parameter), SI.
    """
    return CountModel(replicates, id, evaluation.rates[id].level).expected(
        with_values(evaluation.sensors.mean_sensor(id), values)
    )


def light_levels_of(replicates: Replicates, evaluation: Any) -> dict[str, float]:
    """The level of each capture; in the dark 1, for the rates as they are."""
    return {id: 1.0 if s.capture.light.dark else evaluation.rates[id].level for id, s in replicates.seen.items()}
