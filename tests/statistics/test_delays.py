"""Delays between distant pixels: against a literal version, their law, and what they are made to see."""

from __future__ import annotations

from functools import partial

import null_laws
import numpy as np
import pytest
from simple_sensor import grid, many, reduced, tr, tr_of

from spadmnist.recording import Recording
from spadmnist.statistics import _scores as scores
from spadmnist.statistics import delays
from spadmnist.statistics.delays import Delays

ROWS, COLUMNS, EXPOSURE, TICK = 6, 7, 2e-3, 1e-10
STEADY = {
    "steady": partial(tr, layout=grid(ROWS, COLUMNS), rates=3e5, exposure=EXPOSURE, dead_time=50e-9),
    "bright": partial(tr, layout=grid(ROWS, COLUMNS), rates=5e6, exposure=1e-4),
    "dim": partial(tr, layout=grid(ROWS, COLUMNS), rates=2e3, exposure=1e-2),
    "mixed": partial(tr, layout=grid(ROWS, COLUMNS), rates=np.geomspace(1e4, 2e6, ROWS * COLUMNS), exposure=1e-3),
}


def literal(rows: list[np.ndarray], until: int) -> dict[str, tuple[int, float]]:
    """(most pairs in any ns, pairs by chance) of each step; rows: ticks of each pixel, those before `until` count."""
    rows = [row[row < until].astype(np.int64) for row in rows]
    found: dict[str, tuple[np.ndarray, float]] = {}
    for a, first in enumerate(rows):
        for b, second in enumerate(rows):
            down, right = b // COLUMNS - a // COLUMNS, b % COLUMNS - a % COLUMNS
            if down**2 + right**2 <= 9:
                continue
            ways = [f"{abs(right)} to the {'right' if right > 0 else 'left'}"] if right else []
            ways += [f"{abs(down)} {'down' if down > 0 else 'up'}"] if down else []
            lags = (second[:, None] - first[None, :]).ravel()
            counts = np.histogram(lags[lags >= 0], np.arange(0, 3001, 10))[0]
            if b < a:  # of two at the same tick the pixel with the lower number is taken as the earlier one
                counts[0] -= int((lags == 0).sum())
            order = f"{(b - a) % (ROWS * COLUMNS)} pixels further on in the order of read-out"
            for name in (f"a pixel {' and '.join(ways)}", order):
                before, chance = found.get(name, (0, 0.0))
                found[name] = before + counts, chance + len(first) * len(second) * 10 / until
    return {name: (int(counts.max()), chance) for name, (counts, chance) in found.items()}


def rows_of(recording: Recording) -> list[np.ndarray]:
    events = recording.events
    assert events is not None and events.ticks is not None
    return np.split(events.ticks, events.offsets[1:-1])


@pytest.mark.parametrize("kind", STEADY)
def test_scores_are_those_of_a_literal_version(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(delays, "_PAIRS", 20_000)  # so that of many detections the first are looked at
    recording = STEADY[kind](1)
    summary = reduced(Delays, recording)
    end = round(recording.conditions.exposure / TICK)
    number = sum(map(len, rows_of(recording)))
    until = int(np.ceil(end * min(1.0, 20_000 / (number**2 * 3000 / end))))
    wanted = literal(rows_of(recording), until)
    names = [summary.where(cell).partition(", ")[0] for cell in range(len(summary.values))]
    assert set(names) == set(wanted)
    most = np.array([wanted[name][0] for name in names])
    chance = np.array([wanted[name][1] for name in names])
    share = scores.shares(most, most.size)
    assert np.allclose(summary.values, scores.largest_score(most, np.maximum(chance, 1e-6), 300, share), atol=1e-6)


@pytest.mark.parametrize("kind", STEADY)
def test_scores_of_steady_light_are_normal(kind: str) -> None:
    null_laws.normal(many(Delays, STEADY[kind], 100))


def echo(seed: int, share: float, step: int = 20, delay: float = 123e-9) -> Recording:
    """Of each detection a share comes again, so many pixels further on, a fixed time later."""
    rng = np.random.default_rng(seed)
    own = [rng.random(rng.poisson(3e5 * EXPOSURE)) * EXPOSURE for _ in range(ROWS * COLUMNS)]
    late = [row[rng.random(len(row)) < share] + delay for row in own]
    both = [np.sort(np.concatenate([row, late[p - step]])) for p, row in enumerate(own)]
    return tr_of([row[row < EXPOSURE] for row in both], grid(ROWS, COLUMNS), EXPOSURE, TICK, 0.0)


def test_what_comes_again_elsewhere_is_seen_and_where() -> None:
    """1 % of 25,000 detections; within a nanosecond chance makes 7 pairs of such pixels."""
    summary = reduced(Delays, echo(1, 0.01))
    best = int(summary.values.argmax())
    assert summary.values[best] > 10
    assert summary.where(best) == "20 pixels further on in the order of read-out, 123 to 124 ns later"
    text, share = summary.size(best, float(summary.values[best]), 0.0)
    assert " pairs within 1 ns, " in text and 0.008 < share < 0.012
    usual = reduced(Delays, echo(1, 0.0)).values
    assert np.abs(usual).max() < 5.5  # of 140 normal scores


def test_without_a_grid_or_with_very_many_pixels_it_says_nothing() -> None:
    assert Delays().reduce(tr(1, layout=grid(40, 40), rates=1e3, exposure=1e-4)) is None
    assert Delays().reduce(tr(1, layout=grid(2, 2), rates=1e3, exposure=1e-4)) is None
