"""Showing: where the trace of a model is to be seen. The rest need neither be simulated nor reduced."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import TypeVar

import numpy as np

T = TypeVar("T")
Shown = Mapping[str, Collection[str] | None]  # captures, and the statistics that are looked at in each; None: all


def showing(trace: Mapping[tuple[str, str], np.ndarray], share: float, most: float = np.inf) -> dict[str, list[str]]:
    """The statistics of captures, as few as can be, that have all but a share of the square of a trace.

    trace: standard deviations by (capture, statistic). most: and all but so much of it, however large it is.
    """
    squares = {cell: float(t @ t) for cell, t in trace.items() if cell[0]}
    out: dict[str, list[str]] = {}
    for id, name in _most_of(squares, min(share * sum(squares.values()), most)):
        out.setdefault(id, []).append(name)
    return out


def captures_showing(trace: Mapping[tuple[str, str], np.ndarray], share: float) -> dict[str, None]:
    """As `showing`, of whole captures."""
    squares: dict[str, float] = {}
    for (id, _), t in trace.items():
        if id:
            squares[id] = squares.get(id, 0.0) + float(t @ t)
    return dict.fromkeys(_most_of(squares, share * sum(squares.values())))


def together(some: Iterable[Mapping[str, Collection[str]]]) -> dict[str, set[str]]:
    """What any of these shows."""
    out: dict[str, set[str]] = {}
    for one in some:
        for id, names in one.items():
            out.setdefault(id, set()).update(names)
    return out


def _most_of(squares: Mapping[T, float], spare: float) -> list[T]:
    """All but the smallest, which together are no more than `spare`."""
    out = []
    for name in sorted(squares, key=lambda name: squares[name]):
        spare -= squares[name]
        if spare < 0:
            out.append(name)
    return out
