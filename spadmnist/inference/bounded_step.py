"""The highest point of a parabola within bounds."""

from __future__ import annotations

import numpy as np

_TINY = 1e-9  # of the distance at which the parabola has fallen by 1/2: rounding
_SINGULAR = 1e-10  # of the largest curvature, in these distances: a smaller one is rounding, along which nothing moves


def bounded_step(
    gradient: np.ndarray, curved: np.ndarray, u: np.ndarray, ends: np.ndarray, free: np.ndarray
) -> np.ndarray:
    """The step from a point within bounds to the highest point of a parabola, (n,).

    A coordinate stays at its bound while the parabola rises beyond it. The others are maximized with it held.
    Source: Nocedal and Wright, Numerical Optimization (2006), algorithm 16.3 (active sets).

    Args:
        gradient: (n,) of the parabola at the point.
        curved: (n, n) minus its second derivatives, positive semidefinite.
        u: (n,) the point.
        ends: (2, n) bounds.
        free: (n,) bool, which coordinates may move.
    """
    step, room = np.zeros(len(u)), np.stack([np.minimum(ends[0] - u, 0.0), np.maximum(ends[1] - u, 0.0)])
    moving, root = free.copy(), np.sqrt(np.diag(curved))
    root = np.where(root > 0, root, 1.0)  # curvatures of coordinates may differ by many powers of ten
    for _ in range(10 * len(u) + 10):
        slope = gradient - curved @ step
        move = np.zeros(len(u))
        if moving.any():
            units = root[moving]
            scaled = curved[np.ix_(moving, moving)] / np.outer(units, units)
            move[moving] = np.linalg.pinv(scaled, rcond=_SINGULAR, hermitian=True) @ (slope[moving] / units) / units
        # as far as the first bound
        reach = np.where(move > 0, room[1] - step, room[0] - step)
        shares = np.divide(reach, move, out=np.full(len(u), np.inf), where=np.abs(move) * root > _TINY)
        share = min(1.0, float(max(shares.min(initial=np.inf), 0.0)))
        step = np.clip(step + share * move, *room)
        if share < 1.0:
            first = int(np.argmin(shares))
            step[first], moving[first] = room[int(move[first] > 0), first], False
            continue
        # a coordinate at a bound from which the parabola rises inwards moves again, the steepest one first
        slope = gradient - curved @ step
        inwards = np.where(step <= room[0], slope, -slope) / root * (free & ~moving)
        steepest = int(np.argmax(inwards))
        if inwards[steepest] <= _TINY * (1.0 + np.abs(gradient / root).max(initial=0.0)):
            break
        moving[steepest] = True
    return step
