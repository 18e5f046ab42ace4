"""The highest point of a parabola within bounds."""

from __future__ import annotations

import numpy as np

_TINY = 1e-9  # of a coordinate: no distance, but rounding
_SINGULAR = 1e-10  # of the largest curvature: a smaller one is rounding, and nothing moves along it


def bounded_step(
    gradient: np.ndarray, curved: np.ndarray, u: np.ndarray, ends: np.ndarray, free: np.ndarray
) -> np.ndarray:
    """The step from a point within bounds to the highest point of a parabola, (n,).

    A coordinate that reaches a bound stays there while the parabola rises beyond it, and the others have their best
    values beside it.
    Source: Nocedal and Wright, Numerical Optimization (2006), algorithm 16.3 (active sets).

    Args:
        gradient: (n,) of the parabola at the point.
        curved: (n, n) minus its second derivatives, positive semidefinite.
        u: (n,) the point.
        ends: (2, n) bounds.
        free: (n,) bool, which coordinates may move.
    """
    step, room = np.zeros(len(u)), np.stack([np.minimum(ends[0] - u, 0.0), np.maximum(ends[1] - u, 0.0)])
    moving = free.copy()
    for _ in range(10 * len(u) + 10):
        slope = gradient - curved @ step
        move = np.zeros(len(u))
        if moving.any():
            move[moving] = (
                np.linalg.pinv(curved[np.ix_(moving, moving)], rcond=_SINGULAR, hermitian=True) @ slope[moving]
            )
        # as far as the first bound
        reach = np.where(move > 0, room[1] - step, room[0] - step)
        shares = np.divide(reach, move, out=np.full(len(u), np.inf), where=np.abs(move) > _TINY)
        share = min(1.0, float(max(shares.min(initial=np.inf), 0.0)))
        step = np.clip(step + share * move, *room)
        if share < 1.0:
            moving[int(np.argmin(shares))] = False
            continue
        # a coordinate at a bound from which the parabola rises inwards moves again, the steepest one first
        slope = gradient - curved @ step
        inwards = np.where(step <= room[0] + _TINY, slope, -slope) * (free & ~moving)
        steepest = int(np.argmax(inwards))
        if inwards[steepest] <= _TINY * (1.0 + np.abs(gradient).max(initial=0.0)):
            break
        moving[steepest] = True
    return step
