"""Showing: which captures show the trace of a model. The rest need not be simulated."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np


def captures_showing(trace: Mapping[tuple[str, str], np.ndarray], share: float, most: float = np.inf) -> list[str]:
    """The captures, as few as can be, that have all but a share of the square of a trace; most: and but so much.

    trace: standard deviations by (capture, statistic). Whole captures: where a statistic hardly shows what a number
    does, it still tells the number, and intervals that leave it out have been too narrow.
    """
    squares: dict[str, float] = {}
    for (id, _), t in trace.items():
        if id:
            squares[id] = squares.get(id, 0.0) + float(t @ t)
    spare = min(share * sum(squares.values()), most)
    out = []
    for id in sorted(squares, key=lambda id: squares[id]):
        spare -= squares[id]
        if spare < 0:
            out.append(id)
    return out
