"""Fits by the exact likelihood of the data, where it has a closed form (`point_process`).

Where the coordinates change no rate, each pixel of each capture has a rate of its own, which is maximized, so that no
map is needed. Otherwise the rates follow from the model, and the light level has the uncertainty that the measurement
states. Intervals are by profile likelihood: twice the log-likelihood falls by 3.84, all else maximized again.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import plugins, twin
from ..effects import Effect
from ..errors import SpadError
from ..measurement import Measurement
from ..recording import Capture, Recording
from ..sensor import Sensor
from .candidates import Candidate, templates, with_values
from .closed_forms import closed_form, level_for
from .coordinates import Coordinate, Key, point_of
from .levels import FALL_95
from .point_process import BYTES_OF_A_GAP, DENSE, MANY, Bits, Law, Stamps, TooManyGaps, blur_of, hazards_of
from .profile_likelihood import by_simplex, maximum, profile_end

# fall of twice the log-likelihood at the ends of a 95 % interval, of an edge sharper than the intervals are dense: its
# law is exponential, not normal, and this is that quantile of chi square with two degrees of freedom
EDGE_FALL = 5.99
# of the log-likelihood: a start that may be lower than the maximum by more is dropped for a search from the templates;
# a rule of thumb
_FAR = 100.0
# of the log-likelihood: a value that is higher by more shows that a maximum is none; a rule of thumb
_HIGHER = 0.05
# maxima, each found on the way along the profiles of the one before, after which there are too many; a rule of thumb
_MAXIMA = 4
_LEAST_SCALE = 1e-3  # of a coordinate: the least distance at which a maximum is looked for; a rule of thumb
_LEFT_OUT = 0.2  # of the time stamps, in pixels with few: with more the model is fitted by simulation; a rule of thumb
# tolerances of `by_simplex`: of its first size, and of the log-likelihood; near enough for a parabola, a rule of thumb
_ROUGH = 0.3, 0.5
# bytes of the time stamps and gaps of all captures, at most; more is fitted by simulation. Chosen so that they and the
# program together take less than `memory.MOST`
_HELD = 800_000_000
_LIKELIHOODS = 2  # plain meaning: that are held at once, of the model, and of the model without a change
# of a lifetime: the blur of the stamps must be smaller, or the model is fitted by simulation; a rule of thumb
_SHARP = 0.1


@dataclass(frozen=True)
class MaximumLikelihood:
    """Maximum-likelihood estimates with 95 % intervals.

    Attributes:
        values, intervals: by (effect, parameter), SI.
        value: of the log-likelihood.
        own: every pixel of every capture had a rate of its own.
        free: the fitted parameters.
        correlations: (n, n) of these, by the curvature at the maximum.
    """

    values: dict[Key, float]
    intervals: dict[Key, tuple[float, float]]
    value: float
    own: bool
    free: tuple[Key, ...]
    correlations: np.ndarray


def not_in_likelihood(sensor: Sensor, capture: Capture) -> str:
    """The name of what a capture's likelihood does not describe of a sensor; "" where it describes all that matters."""
    if capture.mean is not None or capture.modality not in ("tr", "qis"):
        return f"{capture.modality} of {capture.id}" if capture.mean is None else f"the mean of {capture.id}"
    stamped = capture.modality == "tr"
    for effect in sensor.effects:
        with plugins.blaming(type(effect)):
            known = effect.in_likelihood(stamped, capture.conditions, sensor.rules)
        if not (known or _idle(effect)):
            return effect.name
    if not stamped:
        return ""
    blur = blur_of(sensor)
    if blur is None:
        return "the stamps"
    width = math.hypot(sensor.tick / math.sqrt(6), blur)
    lifetimes = {name: lifetime for name, (_, lifetime) in hazards_of(sensor, sensor.layout.pixels).items()}
    return next((name for name, lifetime in lifetimes.items() if width > _SHARP * lifetime), "")


def _idle(effect: Effect) -> bool:
    """Whether an effect is listed at the value at which it vanishes."""
    # a parameter that is off by default is a refinement of the effect: whether that is there, the others say
    offs = {n: p for n, p in effect.parameters.items() if p.off is not None}
    first = {n: p for n, p in offs.items() if p.default != p.off} or offs
    return bool(first) and all(np.all(np.asarray(getattr(effect, n)) == p.off) for n, p in first.items())


class Likelihood:
    """The log-likelihood of a measurement as a function of coordinates; all nuisance parameters are maximized.

    Attributes:
        blur: s, see `blur_of`.
        own: every pixel of every capture has a rate of its own.
    """

    def __init__(
        self, sensor: Sensor, data: Sequence[Recording], coordinates: Sequence[Coordinate], fixed: Mapping[Key, Any]
    ):
        self.sensor, self.coordinates, self.fixed = sensor, tuple(coordinates), dict(fixed)
        most = _most_gaps(data)
        self.laws = [Stamps(r, most[r.capture.id]) if r.modality == "tr" else Bits(r) for r in data]
        captures = [r.capture for r in data]
        self.levels, columns, precision = [], [], []
        common = np.zeros(len(data))
        for i, capture in enumerate(captures):
            light = capture.light
            stated = twin.photons_at(capture, sensor.layout)
            if stated is None:
                total = float(data[i].totals.sum())
                stated = level_for(closed_form(sensor, capture), total, None)
                columns.append(np.eye(len(data))[i])
                precision.append(1e-9)
            elif not light.dark:
                common[i] = light.relative_uncertainty
                if light.own_uncertainty:
                    columns.append(light.own_uncertainty * np.eye(len(data))[i])
                    precision.append(1.0)
            self.levels.append(stated)
        if common.any():
            columns.append(common)
            precision.append(1.0)
        # (captures, nuisance parameters): the derivative of the log levels by the light's deviations, in sigmas
        self.light = np.array(columns).reshape(-1, len(data)).T
        self.precision = np.array(precision)
        self.shifts = np.zeros(len(precision))
        self.highest = -math.inf, np.zeros(len(coordinates))  # the highest value so far, and where

    def sensor_at(self, u: np.ndarray) -> Sensor:
        """The sensor at coordinates (n,)."""
        turned = {d.key: d.value(float(x)) for d, x in zip(self.coordinates, u, strict=True)}
        return with_values(self.sensor, {**self.fixed, **turned})

    def begin(self, u: np.ndarray) -> None:
        """Find out which parts of the model the coordinates change about the start: rates, jitter, dead times.

        Args:
            u: (n,) the start.
        """
        points = [u, *(u + h * np.eye(len(u))[i] for i in range(len(u)) for h in (-0.3, 0.3))]
        sensors = [self.sensor_at(p) for p in points]
        rates = [[law.rates(s, x) for law, x in zip(self.laws, self.levels, strict=True)] for s in sensors]
        self.own = all(np.array_equal(a, b) for one in rates for a, b in zip(one, rates[0], strict=True))
        self.blur = blur_of(sensors[0]) or 0.0
        self.jittered = any(blur_of(s) != self.blur for s in sensors)
        self.edges = [
            any(not np.array_equal(s.dead_times, sensors[0].dead_times) for s in sensors[1 + 2 * i : 3 + 2 * i])
            for i in range(len(u))
        ]

    @property
    def left_out(self) -> float:
        """The share of the time stamps that lie in pixels with few of them, which tell nothing where rates are free."""
        counts = [law.counts for law in self.laws if isinstance(law, Stamps)]
        whole = sum(int(one.sum()) for one in counts)
        return sum(int(one[one < MANY].sum()) for one in counts) / max(whole, 1)

    def fall(self, i: int, u: np.ndarray) -> float:
        """The fall of twice the log-likelihood at the ends of a coordinate's 95 % interval.

        Where the intervals do not resolve the edge, its law is that of the shortest one.

        Args:
            i: index of the coordinate.
            u: (n,) coordinates.
        """
        if not self.edges[i]:
            return FALL_95
        dead = self.sensor_at(u).dead_times
        return FALL_95 if sum(law.near_edge(dead, self.blur) for law in self.laws) > DENSE else EDGE_FALL

    def __call__(self, u: np.ndarray) -> float:
        sensor = self.sensor_at(u)
        blur = (blur_of(sensor) or 0.0) if self.jittered else self.blur
        parts = [law.of(sensor, blur, self.own) for law in self.laws]
        value = sum(value for value, _ in parts)
        value = value if self.own else value + self._lit(sensor, [law for _, law in parts])
        if value > self.highest[0]:
            self.highest = value, u.copy()
        return value

    def _lit(self, sensor: Sensor, laws: Sequence[Law]) -> float:
        """The log-likelihood of the rates, the light's nuisance parameters maximized by Newton steps."""
        step, z = 1e-4, self.shifts
        for _ in range(30):
            values, first, second = np.zeros((3, len(laws)))
            for i, (data, law) in enumerate(zip(self.laws, laws, strict=True)):
                x = float(self.light[i] @ z)
                rate, more = (data.rates(sensor, self.levels[i] * math.exp(y)) for y in (x, x + step))
                slope = (more - rate) / step
                value, by_rate, curvature = law(rate)
                values[i] = value.sum()
                first[i], second[i] = by_rate @ slope, curvature @ slope**2
            total = float(values.sum() - 0.5 * self.precision @ z**2)
            if not len(z):
                break
            gradient = self.light.T @ first - self.precision * z
            move = np.linalg.solve(self.light.T @ (second[:, None] * self.light) + np.diag(self.precision), gradient)
            if gradient @ move < 1e-4:
                total += 0.5 * float(gradient @ move)
                break
            z = z + move * min(1.0, 1.0 / float(np.abs(self.light @ move).max()))
        self.shifts = z
        return total


class NoLikelihood(SpadError):
    """There is no exact likelihood of a model for these data. The message names what stands in its way."""


def recordings(measurement: Measurement, sensor: Sensor, seen: Mapping[str, float]) -> list[Recording]:
    """The recordings of some captures for `maximise`.

    Args:
        seen: detections, by capture.
    Raises:
        NoLikelihood: where they are too large to be held at once.
    """
    stamps = sum(seen[c.id] for c in measurement.captures if c.id in seen and c.modality == "tr")
    if 4 * stamps > _HELD:
        raise NoLikelihood(f"{stamps:.3g} time stamps, which are more than the {_HELD / 4:.0e} that are held at once")
    return [measurement.recording(id, sensor) for id in seen]


def _most_gaps(data: Sequence[Recording]) -> dict[str, float]:
    """The gaps that the law of each capture may hold: by the number of its stamps."""
    events = {r.capture.id: r.events for r in data if r.events is not None}
    room = _HELD - sum(one.stamps[0].nbytes for one in events.values())
    each = room / BYTES_OF_A_GAP / _LIKELIHOODS / max(1, sum(map(len, events.values())))
    return {id: max(0.0, each * len(one)) for id, one in events.items()}


def maximise(
    sensor: Sensor,
    data: Sequence[Recording],
    candidates: Sequence[Candidate],
    *,
    start: Mapping[Key, float] | None = None,
    errors: Mapping[Key, float] | None = None,
    mapped: bool = False,
) -> MaximumLikelihood:
    """The maximum-likelihood fit of some changes to recordings.

    Args:
        sensor: the model.
        data: the recordings.
        candidates: the changes whose coordinates are fitted.
        start: values near the best ones; without them, the templates are tried.
        errors: approximate standard errors of coordinates.
        mapped: pixels have rates of their own that are not exactly known; then no coordinate that changes a rate is
            fitted.
    Returns:
        The estimates. A coordinate that the likelihood does not depend on has its search range as interval.
    Raises:
        NoLikelihood: of an effect that is not in the likelihood; of a map, a phase or a switch; and where more time
            stamps are close to each other than are held at once.
    """
    coordinates = tuple(d for candidate in candidates for d in candidate.coordinates)
    fixed = {key: value for candidate in candidates for key, value in candidate.fixed}
    if not coordinates or any(
        candidate.carrier or candidate.phases or not candidate.coordinates for candidate in candidates
    ):
        raise NoLikelihood("a map, a phase or a switch")
    values = {**fixed}
    for candidate in candidates:
        for key, value in templates(candidate)[0].items():
            listed = sensor.effect(key[0])
            values[key] = value if listed is None else getattr(listed, key[1])
    changed = with_values(sensor, values)
    # the start of a listed parameter may be where its effect vanishes; its effect elsewhere must be in the
    # likelihood, too
    elsewhere = with_values(sensor, {**values, **{key: v for c in candidates for key, v in templates(c)[0].items()}})
    for one in data:
        for model in (changed, elsewhere):
            if word := not_in_likelihood(model, one.capture):
                raise NoLikelihood(word)
    with _few_gaps(data):
        return _maximum(Likelihood(sensor, data, coordinates, fixed), data, candidates, values, start, errors, mapped)


@contextlib.contextmanager
def _few_gaps(data: Sequence[Recording]) -> Iterator[None]:
    """Raise NoLikelihood where a law would hold more gaps than it may."""
    try:
        yield
    except TooManyGaps:
        close = sum(len(r.events) for r in data if r.events is not None)
        raise NoLikelihood(f"{close:.3g} time stamps so close to each other") from None


def _maximum(
    function: Likelihood,
    data: Sequence[Recording],
    candidates: Sequence[Candidate],
    values: Mapping[Key, Any],
    start: Mapping[Key, float] | None,
    errors: Mapping[Key, float] | None,
    mapped: bool,
) -> MaximumLikelihood:
    """As `maximise`.

    Args:
        values: of the parameters where nothing better is known.
    """
    coordinates, fixed = function.coordinates, function.fixed
    ends = np.array([d.ends for d in coordinates]).T
    given = {d.key: float(values[d.key]) for d in coordinates}
    widths = {d.key: 0.3 if d.log else 0.1 * (d.ends[1] - d.ends[0]) for d in coordinates}

    def placed(there: Mapping[Key, float]) -> np.ndarray:
        return np.clip([d.coordinate(there[d.key]) for d in coordinates], *ends)

    function.begin(placed({**given, **(start or {})}))
    if mapped and not function.own:
        raise NoLikelihood("maps together with parameters that change the rates")
    if function.own and function.left_out > _LEFT_OUT:
        raise NoLikelihood("pixels with few time stamps each")
    top = None
    if start is not None:
        u, scales = placed({**given, **start}), {**widths, **(errors or {})}
        top = maximum(function, u, np.array([scales[d.key] for d in coordinates]), ends, _FAR)
    if top is None:
        u, scale = placed(given), np.array([widths[d.key] for d in coordinates])
        function.begin(u)
        for candidate in candidates:
            if candidate.kind == "add":
                there = {d.key: d.value(x) for d, x in zip(coordinates, u, strict=True)}
                u = max((placed({**there, **template}) for template in templates(candidate)), key=function)
        _, u = by_simplex(function, u, scale, ends, _ROUGH)
        top = maximum(function, u, scale, ends)
        assert top is not None
    for _ in range(_MAXIMA):
        profiles = [
            [profile_end(function, top, i, sign, function.fall(i, top.u), ends) for sign in (-1, 1)]
            if top.informed[i]
            else list(map(float, ends[:, i]))
            for i in range(len(coordinates))
        ]
        if function.highest[0] < top.value + _HIGHER:
            break
        # this was not the maximum
        top = maximum(function, function.highest[1], top.spreads, ends)
        assert top is not None
    else:
        raise NoLikelihood("several maxima")
    best, u = top.value, top.u
    intervals = {d.key: d.interval(*profile) for d, profile in zip(coordinates, profiles, strict=True)}
    found = {d.key: d.value(float(x)) for d, x in zip(coordinates, u, strict=True)}
    inverse = np.linalg.inv(top.curved)
    # of some coordinates the value falls as they rise
    spread = np.sqrt(np.diag(inverse)) * [-1.0 if d.lacks else 1.0 for d in coordinates]
    return MaximumLikelihood(
        values={**fixed, **found},
        intervals=intervals,
        value=best,
        own=function.own,
        free=tuple(found),
        correlations=inverse / np.outer(spread, spread),
    )


def likelihood_ratios(
    sensor: Sensor, data: Sequence[Recording], candidates: Sequence[Candidate], found: MaximumLikelihood
) -> list[float]:
    """Twice the log-likelihood ratio of each change, the others fitted again without it.

    Args:
        sensor, data, candidates: as in `maximise`, which returned `found`.

    Raises:
        NoLikelihood: where more time stamps are close to each other than are held at once.
    """
    out = []
    for candidate in candidates:
        own = {*dict(candidate.fixed), *(d.key for d in candidate.coordinates)}
        others = [d for other in candidates for d in other.coordinates if d.key not in own]
        fixed = {key: value for other in candidates for key, value in other.fixed if key not in own}
        without = Likelihood(sensor, data, others, fixed)
        u = point_of(others, found.values)
        without.begin(u)
        without.own = found.own
        with _few_gaps(data):
            lower = without(u)
            if others:  # they take up what they can of it
                scales = np.array([max(d.error(*found.intervals[d.key]), _LEAST_SCALE) for d in others])
                ends = np.array([d.ends for d in others]).T
                top = maximum(without, u, scales, ends)
                assert top is not None
                lower = max(top.value, without.highest[0])
        out.append(2 * (found.value - lower))
    return out
