"""Showing: where the trace of a model is to be seen. The rest need neither be simulated nor reduced."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

Shown = Mapping[str, Collection[str] | None]  # captures, and the statistics that are looked at in each; None: all


def showing(trace: Mapping[tuple[str, str], np.ndarray], share: float, most: float = np.inf) -> dict[str, list[str]]:
    """The statistics of captures, as few as can be, that have all but a share of the square of a trace.

    trace: standard deviations by (capture, statistic). most: and all but so much of it, however large it is.
    """
    squares = {cell: float(t @ t) for cell, t in trace.items() if cell[0]}
    spare = min(share * sum(squares.values()), most)
    out: dict[str, list[str]] = {}
    for cell in sorted(squares, key=lambda cell: squares[cell]):
        spare -= squares[cell]
        if spare < 0:
            out.setdefault(cell[0], []).append(cell[1])
    return out
