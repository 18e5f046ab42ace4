"""Maxima: the largest value of a function of a few coordinates within bounds, and where it has fallen by so much.

Parabolas where it is one nearly, a simplex where it is not; a likelihood has jumps, ridges and numbers that it does not
depend on.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

_NOTHING = 1e-5  # of the function: it does not depend on that coordinate
_TINY = 1e-9  # of a coordinate


def climbed(
    function: Callable[[np.ndarray], float],
    start: np.ndarray,
    scales: np.ndarray,
    ends: np.ndarray,
    exact: tuple[float, float] = (0.02, 0.003),
) -> tuple[float, np.ndarray]:
    """(largest value, where) of a function, by a simplex that begins as large as `scales`; ends: (2, n) bounds.

    exact: to which share of `scales`, and to which difference of values, it is found.
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


def reached(
    fallen: Callable[[float], float], wanted: float, first: float, room: float, near: float
) -> tuple[float, float, float]:
    """Where what is 0 at 0 and about quadratic comes to `wanted`: (where it was seen last, what it was there, guess).

    By secants of its root; by halves where it jumps. first: where to look first; room: the farthest; near: by which
    share of its root a point may be off.
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
            # a number of which nothing is seen may never be
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
class Top:
    """A largest value of a function, where it is, and the parabola there.

    slopes: (n,) of the function; curved: (n, n) minus its second derivatives; tells: (n,) whether it changes at all.
    """

    value: float
    u: np.ndarray
    slopes: np.ndarray
    curved: np.ndarray
    tells: np.ndarray

    @property
    def spreads(self) -> np.ndarray:
        """(n,) how far each coordinate goes until the function has fallen by 1/2, the others staying."""
        return 1 / np.sqrt(np.diag(self.curved))


def _parabola(
    function: Callable[[np.ndarray], float], u: np.ndarray, value: float, scales: np.ndarray, ends: np.ndarray
) -> Top:
    """By points at which the function has fallen by about 1/2; scales: (n,) where they are looked for first."""
    n = len(u)
    units = np.eye(n)
    slopes, curved, tells = np.zeros(n), np.eye(n), np.ones(n, bool)
    seen = []
    for i in range(n):

        def fallen(sign: float, x: float, i: int = i) -> float:
            return value - function(u + sign * x * units[i])

        points: list[tuple[float, float]] = []
        first = float(scales[i])
        for sign in (-1, 1):
            room = abs(float(ends[(sign + 1) // 2, i] - u[i]))
            if room > _TINY:
                x, fall, _ = reached(functools.partial(fallen, sign), 0.5, first, room, 0.5)
                points.append((sign * x, fall))
                first = x if fall > _NOTHING else first
        tells[i] = any(abs(fall) > _NOTHING for _, fall in points)
        if not tells[i]:
            seen.append((0.0, 0.0))
            continue
        if len(points) == 1:
            points.append((0.5 * points[0][0], fallen(0.5, points[0][0])))
        (a, at_a), (b, at_b) = points
        half = (at_a / a - at_b / b) / (a - b)
        slopes[i] = half * a - at_a / a
        curved[i, i] = 2 * half if half > 0 else 1 / max(abs(a), abs(b)) ** 2
        seen.append(min(points, key=lambda p: abs(p[1] - 0.5)))
    for i, j in itertools.combinations(np.flatnonzero(tells).tolist(), 2):
        (x, at_x), (y, at_y) = seen[i], seen[j]
        both = value - function(u + x * units[i] + y * units[j])
        curved[i, j] = curved[j, i] = (both - at_x - at_y) / (x * y)
    # it is a maximum that is looked for; the dials may be much alike
    root = np.sqrt(np.diag(curved))
    sizes, axes = np.linalg.eigh(curved / np.outer(root, root))
    return Top(value, u, slopes, (axes * np.maximum(sizes, 0.01)) @ axes.T * np.outer(root, root), tells)


def _move(slopes: np.ndarray, curved: np.ndarray, free: np.ndarray, u: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """(n,) to the top of a parabola, of some coordinates; one that would leave its bounds stays at them."""
    move, free = np.zeros(len(u)), free.copy()
    while free.any():
        held = slopes - curved[:, ~free] @ move[~free]
        move[free] = np.linalg.solve(curved[np.ix_(free, free)], held[free])
        inside = np.clip(u + move, *ends) - u
        out = free & (np.abs(inside - move) > _TINY)
        move = inside
        if not out.any():
            break
        free &= ~out
    return move


def topped(
    function: Callable[[np.ndarray], float],
    u: np.ndarray,
    scales: np.ndarray,
    ends: np.ndarray,
    most: float = math.inf,
) -> Top | None:
    """The maximum of a function: by parabolas, and where it is none by a simplex. None: it may be higher by `most`."""
    value = function(u)
    for _ in range(8):
        top = _parabola(function, u, value, scales, ends)
        some = top.tells
        move = _move(top.slopes, top.curved, some, u, ends)
        if 0.5 * top.slopes @ move > most:
            return None
        # far away it is no parabola
        move *= min(1.0, 4.0 / max(float(np.max(np.abs(move) / np.maximum(scales, top.spreads))), 1e-9))
        there = u + move
        hoped = float(top.slopes @ move - 0.5 * move @ top.curved @ move)
        gained = (function(there) if np.any(move) else value) - value
        if gained > 0:
            value, u = value + gained, there
        if gained < 0.5 * hoped and hoped > 0.02:
            higher, rest = climbed(_some(function, u, some), u[some], top.spreads[some], ends[:, some])
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
    """A function of some coordinates, the others staying."""

    def of(rest: np.ndarray) -> float:
        there = u.copy()
        there[some] = rest
        return function(there)

    return of


def profile(
    function: Callable[[np.ndarray], float], top: Top, i: int, sign: int, fall: float, ends: np.ndarray
) -> float:
    """Coordinate at which twice the logarithm has fallen by so much, all others maximised anew; at most the bound."""
    u, curved = top.u, top.curved
    others = top.tells & (np.arange(len(u)) != i)
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
            slopes = np.zeros(len(u))
            for j in np.flatnonzero(others):
                step = steps[j] if there[j] + steps[j] <= ends[1, j] else -steps[j]
                beside = there.copy()
                beside[j] += step
                slopes[j] = (function(beside) - value) / step + 0.5 * curved[j, j] * step
            move = _move(slopes, curved, others, there, ends)
            next_ = there + move
            hoped = float(slopes @ move - 0.5 * move @ curved @ move)
            if hoped < 0.01:
                break
            gained = function(next_) - value
            if gained > 0:
                value, there = value + gained, next_
            if gained < 0.5 * hoped and hoped > 0.04:
                some = _some(function, there, others)
                value, there[others] = climbed(some, there[others], 0.3 * top.spreads[others], ends[:, others])
                break
            if hoped < 0.1:
                break
        ridge = sign * (there - u)[others] / x
        return top.value - value

    room = abs(float(ends[(sign + 1) // 2, i] - u[i]))
    if room < _TINY:
        return float(u[i] + sign * room)
    return float(u[i] + sign * reached(fallen, 0.5 * fall, wide * math.sqrt(fall), room, 0.08)[2])
