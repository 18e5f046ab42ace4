"""The maximum of a likelihood within bounds, and its profile: where it has fallen by a given amount.

The search is by parabolas where the likelihood is nearly one, by a simplex where it has jumps, ridges, or coordinates
that it does not depend on.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from .bounded_step import bounded_step

# of the log-likelihood: with a smaller change it does not depend on a coordinate, which then has no interval; far below
# what moves an interval, a rule of thumb
_NOTHING = 1e-5
_TINY = 1e-9  # of a coordinate: no distance, but rounding; any well above 1e-16 and far below an interval does


def by_simplex(
    function: Callable[[np.ndarray], float],
    start: np.ndarray,
    scales: np.ndarray,
    ends: np.ndarray,
    exact: tuple[float, float] = (0.02, 0.003),
) -> tuple[float, np.ndarray]:
    """(largest value of a function, where it is), by a simplex (Nelder-Mead) within bounds.

    Args:
        start: (n,) coordinates.
        scales: (n,) the size of the first simplex.
        ends: (2, n) bounds.
        exact: tolerances, as a share of `scales` and as a difference of values.
    """
    if not len(start):
        return function(start), start
    units = 1 / scales
    inward = np.where(start + scales > ends[1], -scales, scales)
    corners = np.clip(np.vstack([start, start + np.diag(inward)]), *ends)
    found = optimize.minimize(
        lambda u: -function(u / units),
        start * units,
        method="Nelder-Mead",
        bounds=(ends * units).T,
        options={"initial_simplex": corners * units, "xatol": exact[0], "fatol": exact[1], "maxfev": 80 * len(start)},
    )
    return -float(found.fun), np.asarray(found.x) / units


def crossing(
    fallen: Callable[[float], float], wanted: float, first: float, room: float, near: float
) -> tuple[float, float, float]:
    """The place where a nearly quadratic function, 0 at 0, reaches `wanted`: (last place, its value there, estimate).

    It is by secants of the function's root, and by bisection where it jumps.

    Args:
        fallen: the function.
        first: the first place.
        room: the farthest place.
        near: relative tolerance of the root.
    """
    low, at_low, high, at_high = 0.0, 0.0, math.inf, math.inf
    x, sides, halves = min(first, room), 0, False
    for _ in range(40):
        fall = fallen(x)
        root = math.sqrt(max(fall, 0.0) / wanted)
        if root < 1 and x >= room:
            return room, fall, room
        sides = sides + 1 if (root < 1) == (sides > 0) and sides else 1
        if root < 1:
            low, at_low, sides = x, root, abs(sides)
        else:
            high, at_high, sides = x, root, -abs(sides)
        if high == math.inf:
            # a coordinate without any effect may never reach it
            guess = room if abs(fall) < _NOTHING else x * min(1 / max(root, 0.25), 4.0)
        else:
            guess = low + (high - low) * (1 - at_low) / (at_high - at_low)
        if abs(root - 1) < near or high - low < 0.02 * high or high < _TINY:
            return x, fall, min(guess, room)
        halves = halves or (abs(sides) > 2 and high < math.inf)
        if halves:
            guess = 0.1 * high if low == 0 else math.sqrt(low * high)
        x = min(guess, room)
    return x, fall, x


@dataclass
class Maximum:
    """A maximum of a function, with the parabola there.

    Attributes:
        value: of the function; u: (n,) where it is.
        jacobian: (n,) gradient of the function.
        curved: (n, n) minus the second derivatives.
        informed: (n,) bool, whether the function depends on the coordinate.
    """

    value: float
    u: np.ndarray
    jacobian: np.ndarray
    curved: np.ndarray
    informed: np.ndarray

    @property
    def spreads(self) -> np.ndarray:
        """The distance of each coordinate at which the function has fallen by 1/2, the others fixed, (n,)."""
        return 1 / np.sqrt(np.diag(self.curved))


def _parabola(
    function: Callable[[np.ndarray], float], u: np.ndarray, value: float, scales: np.ndarray, ends: np.ndarray
) -> Maximum:
    """The parabola of a function by points where it has fallen by about 1/2.

    Args:
        scales: (n,) the first distances.
        ends: (2, n) bounds.
    """
    n = len(u)
    units = np.eye(n)
    gradient, curved, informed = np.zeros(n), np.eye(n), np.ones(n, bool)
    seen = []
    for i in range(n):

        def fallen(sign: float, x: float, i: int = i) -> float:
            return value - function(u + sign * x * units[i])

        points: list[tuple[float, float]] = []
        first = float(scales[i])
        for sign in (-1, 1):
            room = abs(float(ends[(sign + 1) // 2, i] - u[i]))
            if room > _TINY:
                x, fall, _ = crossing(functools.partial(fallen, sign), 0.5, first, room, 0.5)
                points.append((sign * x, fall))
                first = x if fall > _NOTHING else first
        informed[i] = any(abs(fall) > _NOTHING for _, fall in points)
        if not informed[i]:
            seen.append((0.0, 0.0))
            continue
        if len(points) == 1:
            points.append((0.5 * points[0][0], fallen(0.5, points[0][0])))
        (a, at_a), (b, at_b) = points
        half = (at_a / a - at_b / b) / (a - b)
        gradient[i] = half * a - at_a / a
        curved[i, i] = 2 * half if half > 0 else 1 / max(abs(a), abs(b)) ** 2
        seen.append(min(points, key=lambda p: abs(p[1] - 0.5)))
    for i, j in itertools.combinations(np.flatnonzero(informed).tolist(), 2):
        (x, at_x), (y, at_y) = seen[i], seen[j]
        both = value - function(u + x * units[i] + y * units[j])
        curved[i, j] = curved[j, i] = (both - at_x - at_y) / (x * y)
    # positive definite, although the coordinates may be strongly correlated
    root = np.sqrt(np.diag(curved))
    sizes, axes = np.linalg.eigh(curved / np.outer(root, root))
    return Maximum(
        value=value,
        u=u,
        jacobian=gradient,
        curved=(axes * np.maximum(sizes, 0.01)) @ axes.T * np.outer(root, root),
        informed=informed,
    )


def maximum(
    function: Callable[[np.ndarray], float],
    u: np.ndarray,
    scales: np.ndarray,
    ends: np.ndarray,
    most: float = math.inf,
) -> Maximum | None:
    """The maximum of a function, by parabolas, or by a simplex where they fail.

    Args:
        u: (n,) the start.
        scales: (n,) typical distances.
        ends: (2, n) bounds.
        most: None is returned where the maximum may be higher than the start by more.
    """
    value = function(u)
    for _ in range(8):
        top = _parabola(function, u, value, scales, ends)
        some = top.informed
        move = bounded_step(top.jacobian, top.curved, u, ends, some)
        if 0.5 * top.jacobian @ move > most:
            return None
        # far away it is no parabola
        move *= min(1.0, 4.0 / max(float(np.max(np.abs(move) / np.maximum(scales, top.spreads))), 1e-9))
        there = u + move
        hoped = float(top.jacobian @ move - 0.5 * move @ top.curved @ move)
        gained = (function(there) if np.any(move) else value) - value
        if gained > 0:
            value, u = value + gained, there
        if gained < 0.5 * hoped and hoped > 0.02:
            higher, rest = by_simplex(_some(function, u, some), u[some], top.spreads[some], ends[:, some])
            gained = higher - value
            if gained > 0:
                value, u = higher, u.copy()
                u[some] = rest
        elif hoped < 0.05:
            break
        scales = np.where(some, np.maximum(top.spreads, _TINY), scales)
        if gained < 0.01:
            break
    return replace(top, value=value, u=u)


def _some(function: Callable[[np.ndarray], float], u: np.ndarray, some: np.ndarray) -> Callable[[np.ndarray], float]:
    """The function of some coordinates, the others fixed."""

    def of(rest: np.ndarray) -> float:
        there = u.copy()
        there[some] = rest
        return function(there)

    return of


def profile_end(
    function: Callable[[np.ndarray], float], top: Maximum, i: int, sign: int, fall: float, ends: np.ndarray
) -> float:
    """The coordinate at which twice the log-likelihood has fallen by `fall`, the others maximized again.

    It is the bound where that is nearer.

    Args:
        top: the maximum.
        i: index of the coordinate; sign: the side.
        ends: (2, n) bounds.
    """
    u, curved = top.u, top.curved
    others = top.informed & (np.arange(len(u)) != i)
    steps = 0.4 * np.minimum(top.spreads, ends[1] - ends[0])
    # how the others follow, so far as is known
    ridge = -np.linalg.solve(curved[np.ix_(others, others)], curved[others, i])
    wide = 1 / math.sqrt(curved[i, i] + curved[i, others] @ ridge)

    def fallen(x: float) -> float:
        nonlocal ridge
        there = u.copy()
        there[i] += sign * x
        there[others] = np.clip(u[others] + sign * x * ridge, *ends[:, others])
        value = function(there)
        for _ in range(3):
            gradient = np.zeros(len(u))
            for j in np.flatnonzero(others):
                step = steps[j] if there[j] + steps[j] <= ends[1, j] else -steps[j]
                aside = there.copy()
                aside[j] += step
                gradient[j] = (function(aside) - value) / step + 0.5 * curved[j, j] * step
            move = bounded_step(gradient, curved, there, ends, others)
            next_ = there + move
            hoped = float(gradient @ move - 0.5 * move @ curved @ move)
            if hoped < 0.01:
                break
            gained = function(next_) - value
            if gained > 0:
                value, there = value + gained, next_
            if gained < 0.5 * hoped and hoped > 0.04:
                some = _some(function, there, others)
                value, there[others] = by_simplex(some, there[others], 0.3 * top.spreads[others], ends[:, others])
                break
            if hoped < 0.1:
                break
        ridge = sign * (there - u)[others] / x
        return top.value - value

    room = abs(float(ends[(sign + 1) // 2, i] - u[i]))
    if room < _TINY:
        return float(u[i] + sign * room)
    return float(u[i] + sign * crossing(fallen, 0.5 * fall, wide * math.sqrt(fall), room, 0.08)[2])
