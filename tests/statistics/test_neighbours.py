"""Coincidences of pixels: against literal versions, their law, and what they are made to see."""

from __future__ import annotations

import math
from functools import partial

import null_laws
import numpy as np
import pytest
from simple_sensor import counted, grid, many, one_of_each, qis, qis_of, reduced, sigmas, stamped, str_of, tr, tr_of

from spadmnist import recording as recordings
from spadmnist.events import Layout
from spadmnist.recording import Recording
from spadmnist.statistics import _scores as scores
from spadmnist.statistics._counting import Surplus
from spadmnist.statistics.neighbours import FarPairs, Neighbours

GRID = ["horizontal side neighbours", "vertical side neighbours", "diagonal neighbours, rising"]
GRID += ["diagonal neighbours, falling", "pixels about 2 pitches apart", "pixels about 3 pitches apart"]
HEXAGONS = Layout(
    1, 19, 25e-12, 1.0, np.array([(x + y % 2 / 2, y * 3**0.5 / 2) for y in range(4) for x in range(5)])[:19]
)
EDGES = (0.0, 1e-9, 3e-9, 10e-9, 30e-9, 100e-9)


def classes(layout: Layout) -> dict[str, list[tuple[int, int]]]:
    """Pairs of pixels by class, the first being the left one, or the upper one."""
    found: dict[str, list[tuple[int, int]]] = {}
    for a in range(layout.pixels):
        for b in range(a + 1, layout.pixels):
            dx, dy = layout.places[b] - layout.places[a]
            distance = math.hypot(dx, dy)
            if distance > 3.01:
                name = "far"
            elif layout.positions is not None:
                name = "nearest neighbours" if distance < 1.25 else GRID[4] if distance < 2.25 else GRID[5]
            else:
                name = GRID[4] if distance < 2.5 else GRID[5]
                name = {(1, 0): GRID[0], (0, 1): GRID[1], (-1, 1): GRID[2], (1, 1): GRID[3]}.get((dx, dy), name)
            found.setdefault(name, []).append((a, b))
    return found


def series_of(recording: Recording) -> np.ndarray:
    """(frames, pixels) counts."""
    frames = np.asarray(recording.frames[:])  # type: ignore[index]
    if recording.modality == "qis":
        frames = np.unpackbits(frames, axis=2, count=recording.layout.columns)
    elif recording.modality == "str":
        frames = frames < recording.none
    return frames.reshape(len(frames), -1).astype(np.int64)


def of_frames(series: np.ndarray, pairs: list[tuple[int, int]], lag: int) -> np.ndarray:
    """[products of the first pixel and the second `lag` frames later, what chance makes of them, its variance]."""
    a, b = (series[:, [pair[k] for pair in pairs]] for k in (0, 1))
    spread = (a.var(axis=0, ddof=1) * b.var(axis=0, ddof=1)).sum() * (len(series) - abs(lag))
    early, late = (a[: len(a) - lag], b[lag:]) if lag >= 0 else (a[-lag:], b[:lag])
    about = ((early - a.mean(axis=0)) * (late - b.mean(axis=0))).sum()
    return np.array([(early * late).sum(), (early * late).sum() - about, spread])


def of_stamps(rows: list[np.ndarray], pairs: list[tuple[int, int]], tick: float, end: int) -> np.ndarray:
    """(bins, 3) the same for ticks, by lag; and for the second one being later by less than 30 ns."""
    edges = np.array([max(1, round(edge / tick)) for edge in EDGES[1:]])
    found = np.zeros((len(edges) + 1, 3))
    for a, b in pairs:
        low, high = (np.searchsorted(rows[b], rows[a] + side * edges[-1]) for side in (-1, 1))
        places = np.arange((high - low).sum()) + np.repeat(low - np.cumsum(high - low) + high - low, high - low)
        lag = rows[b][places] - np.repeat(rows[a], high - low)
        found[:-1, 0] += np.histogram(np.abs(lag), [-0.5, *(edges - 0.5)])[0]
        found[-1, 0] += ((lag > 0) & (lag < round(30e-9 / tick))).sum()
        number = [*np.diff([0, *(2 * edges - 1)]), round(30e-9 / tick) - 1]
        found[:, 1] += len(rows[a]) * len(rows[b]) * np.array(number) / end
    found[:, 2] = found[:, 1]
    return found


def scored(recording: Recording, rows: list[np.ndarray]) -> np.ndarray:
    pairs, chance, variance = np.array(rows).T
    mean = np.maximum(variance, 1e-6)
    count = np.maximum(pairs - chance + mean, 0)
    share = scores.shares(np.append(recording.totals, len(pairs)), len(pairs))
    return scores.poisson_score(np.where(mean < 100, np.rint(count), count), mean, share)


def ticks_of(recording: Recording) -> tuple[list[np.ndarray], float]:
    assert recording.events is not None
    tick = recording.tick or 1e-11
    return [np.rint(recording.events.row(p) / tick).astype(np.int64) for p in range(recording.pixels)], tick


@pytest.mark.parametrize(
    "kind",
    [
        "tr",
        pytest.param("tr without ticks", marks=pytest.mark.slow),
        "coarse",
        "hexagons",
        "two rows",
        "crowded",
        "crowded hexagons",
        "several slabs",
    ],
)
def test_stamps_of_a_small_recording(kind: str) -> None:
    more = {
        "coarse": lambda: tr(3, grid(4, 5), 3e5, 2e-3, 50e-9, tick=5e-9),
        "hexagons": lambda: tr(3, HEXAGONS, 2e5, 5e-3, 50e-9),
        "two rows": lambda: tr(3, grid(2, 9), np.geomspace(100, 3e6, 18), 1e-3, 50e-9),
        "several slabs": lambda: tr(3, grid(3, 4), 1e7, 1e-3, 50e-9),
        "crowded": lambda: tr(3, grid(3, 3), 6e8, 5e-6, 0.0, tick=1e-9),
        "crowded hexagons": lambda: tr(3, HEXAGONS, 1e8, 5e-6, 0.0, tick=1e-9),
    }
    recording = more[kind]() if kind in more else one_of_each()[kind]
    rows, tick = ticks_of(recording)
    end = round(recording.conditions.exposure / tick)
    found = classes(recording.layout)
    wanted, names = [], []
    for name in [n for n in ("nearest neighbours", *GRID) if n in found]:
        of_class = of_stamps(rows, found[name], tick, end)
        cells = list(range(6 if "side" in name or "diagonal" in name else 5))
        if kind == "coarse":  # 1 ns and 3 ns are the same tick
            cells.remove(1)
        wanted += [of_class[k] for k in cells]
        names += [name] * len(cells)
    summary = reduced(Neighbours, recording)
    words = [summary.where(cell) for cell in range(len(summary.values))]
    assert len(set(words)) == len(words)  # no two cells have the same words
    by_class: dict[str, list[int]] = {}
    for cell in range(len(names)):
        by_class.setdefault(next(n for n in names if summary.where(cell).startswith(n)), []).append(cell)
    # classes come in the order of distance
    arranged = [row for name in by_class for row, n in zip(wanted, names, strict=True) if n == name]
    # then side neighbours in both directions together, by the lags up to 10 ns
    sides = [name for name in by_class if "side" in name]
    lags = ([0, 2] if kind == "coarse" else [0, 1, 2]) if len(sides) > 1 else []
    arranged += [sum(of_stamps(rows, found[name], tick, end)[k] for name in sides) for k in lags]
    spans = ["0 to 5 ns", "5 to 10 ns"] if kind == "coarse" else ["0 to 1 ns", "1 to 3 ns", "3 to 10 ns"]
    assert words[len(names) :] == [f"side neighbours, {span}" for span, _ in zip(spans, lags, strict=bool(lags))]
    np.testing.assert_allclose(summary.values, scored(recording, arranged), rtol=1e-9)
    if kind == "tr":
        assert summary.where(0) == "horizontal side neighbours, 0 to 1 ns"
        assert summary.where(5) == "horizontal side neighbours, the right-hand one later by up to 30 ns"
        text, number = summary.size(4, float(summary.values[4]), 0.0)
        share = (arranged[4][0] - arranged[4][1]) / recording.totals.sum()
        assert text.startswith(f"{100 * share:.3g} % of detections beyond chance")
        assert math.isclose(number, share, rel_tol=0.1, abs_tol=1e-4)
    if "far" in found:
        far = of_stamps(rows, found["far"], tick, end)[[0, 2, 3, 4] if kind == "coarse" else range(5)]
        np.testing.assert_allclose(
            reduced(FarPairs, recording).values, scored(recording, list(far)), rtol=1e-7, atol=1e-9
        )
    else:
        assert FarPairs().reduce(recording) is None


@pytest.mark.parametrize("kind", ["qis", "str", "counts", "counter", "wide", "hexagons", "narrow"])
def test_frames_of_a_small_recording(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def hexagons() -> Recording:
        plain = qis(3, (300, 1, 19), 0.3)
        return Recording(**{**plain.__dict__, "layout": HEXAGONS, "_kept": {}})

    more = {
        "wide": lambda: qis(3, (60, 3, 133), 0.4),
        "narrow": lambda: qis(3, (60, 40, 2), 0.4),
        "hexagons": hexagons,
    }
    recording = more[kind]() if kind in more else one_of_each()[kind]
    series, found = series_of(recording), classes(recording.layout)
    wanted, later = [], []
    order = ("nearest neighbours", *GRID) if kind != "narrow" else (GRID[0], *GRID[1:])
    summary = reduced(Neighbours, recording)
    words = [summary.where(cell) for cell in range(len(summary.values))]
    order = tuple(dict.fromkeys(n for word in words for n in order if word.startswith(n)))
    sides = [name for name in order if "side" in name]
    for name in order:
        wanted.append(of_frames(series, found[name], 0))
        both = [of_frames(series, found[name], 1), of_frames(series, found[name], -1)]
        later += both if "side" in name or "diagonal" in name else [sum(both)]
    if len(sides) > 1:
        wanted.append(of_frames(series, [pair for name in sides for pair in found[name]], 0))
        assert words[len(wanted) - 1] == "side neighbours, the same frame"
    cells = len(wanted) + len(later)
    if kind == "str":  # and by their stamps, which the next test looks at
        assert len(words) == cells + 5 * len(order) - 2 * len(order) + 1  # of ticks of 10 ns
        near = np.array([*wanted, *later])
        scores_of = Surplus(*np.concatenate([near, np.zeros((len(words) - cells, 3))]).T).scores(recording.totals)
        np.testing.assert_allclose(summary.values[:cells], scores_of[:cells], rtol=1e-7)
    else:
        np.testing.assert_allclose(summary.values, scored(recording, wanted + later), rtol=1e-7)
        assert words[0] == f"{order[0]}, the same frame"
    if kind in ("qis", "wide"):
        assert f"{GRID[0]}, the right-hand one a frame later" in words
        assert f"{GRID[0]}, the right-hand one a frame earlier" in words
    all_pairs = [pair for name, pairs in found.items() for pair in pairs]
    both = of_frames(series, all_pairs, 1) + of_frames(series, all_pairs, -1)
    values = reduced(FarPairs, recording).values
    np.testing.assert_allclose(values, scored(recording, [of_frames(series, found["far"], 0), both]), rtol=1e-6)
    # eight frames at a time give the same
    monkeypatch.setattr(recordings, "_CHUNK", 1)
    again = Recording(**{**recording.__dict__, "_kept": {}})
    assert np.array_equal(reduced(Neighbours, again).values, summary.values)
    assert np.array_equal(reduced(FarPairs, again).values, values)


@pytest.mark.parametrize("kind", ["grid", "few", "hexagons"])
def test_first_stamps_of_a_small_recording(kind: str) -> None:
    shape = {"grid": (400, 5, 6), "few": (400, 12, 13), "hexagons": (400, 1, 19)}[kind]
    recording = stamped(4, shape, 0.02 if kind == "few" else 0.3, tick=1e-9)
    if kind == "hexagons":
        recording = Recording(**{**recording.__dict__, "layout": HEXAGONS, "_kept": {}})
    stamps = np.asarray(recording.frames[:]).reshape(400, -1).astype(np.int64)  # type: ignore[index]
    none = recording.none
    times = np.histogram(stamps[stamps < none] * 64 // none, 64, (0, 64))[0]
    density = 64 / none * ((times / times.sum()) ** 2).sum()
    summary = reduced(Neighbours, recording)
    words = [summary.where(cell) for cell in range(len(summary.values))]
    n = recording.totals
    rows = []
    by_lag = dict.fromkeys(word.rpartition(", ")[0] for word in words if word.endswith(" ns"))
    for name in [name for name in by_lag if name in classes(recording.layout)]:
        for low, high in zip((0, 1, 3, 10, 30), (1, 3, 10, 30, 100), strict=True):
            number = both = 0.0
            for a, b in classes(recording.layout)[name]:
                lag = np.abs(stamps[:, a] - stamps[:, b])
                number += ((lag >= low) & (lag < high) & (stamps[:, a] < none) & (stamps[:, b] < none)).sum()
                both += n[a] * n[b] / 400 * density * (2 * (high - low) - (low == 0))
            assert f"{name}, {low} to {high} ns" in words
            rows.append([number, both, both])
    if kind != "hexagons":
        rows += [np.add(rows[k], rows[5 + k]) for k in range(3)]
        assert words[-3:] == [f"side neighbours, {span} ns" for span in ("0 to 1", "1 to 3", "3 to 10")]
    cells = len(words) - len(rows)
    wanted = Surplus(*np.concatenate([np.zeros((cells, 3)), rows]).T).scores(n)
    np.testing.assert_allclose(summary.values[cells:], wanted[cells:], rtol=1e-9)
    if kind == "grid":  # and the law: chance is what it says
        z = many(Neighbours, partial(stamped, shape=(200, 5, 6), share=0.3, tick=1e-9), 120)
        null_laws.normal(z[:, cells:])


def test_one_pixel_has_no_neighbours() -> None:
    for recording in (tr(1, grid(1, 1), 1e5, 1e-3), qis(1, (100, 1, 1), 0.3)):
        assert Neighbours().reduce(recording) is None and FarPairs().reduce(recording) is None
    for recording in (tr(1, grid(6, 6), 0.0, 1e-3), qis(1, (100, 6, 6), 0.0), qis(1, (100, 6, 6), 1.0)):
        assert np.abs(reduced(Neighbours, recording).values).max() < 5
        assert np.abs(reduced(FarPairs, recording).values).max() < 5


STEADY = {
    "tr": partial(tr, layout=grid(5, 6), rates=3e5, exposure=2e-3, dead_time=50e-9),
    "tr, bright": partial(tr, layout=grid(5, 6), rates=5e6, exposure=1e-4),
    "tr, dim": partial(tr, layout=grid(5, 6), rates=2e3, exposure=1e-2),
    "tr, mixed": partial(tr, layout=HEXAGONS, rates=np.geomspace(1e3, 3e6, 19), exposure=1e-3),
    "qis": partial(qis, shape=(200, 8, 8), share=0.3),
    "qis, bright": partial(qis, shape=(200, 8, 8), share=0.97),
    "qis, dim": partial(qis, shape=(200, 8, 8), share=0.01),
    "qis, mixed": partial(qis, shape=(200, 8, 8), share=np.linspace(0.005, 0.995, 64).reshape(8, 8)),
    "counts": partial(counted, shape=(120, 8, 8), share=0.3),
}


@pytest.mark.parametrize("kind", STEADY)
def test_scores_of_steady_light_are_normal(kind: str) -> None:
    null_laws.normal(many(Neighbours, STEADY[kind], 150))
    null_laws.normal(many(FarPairs, STEADY[kind], 150))


def spread(seed: int, rows: int = 5, columns: int = 6, chance: float = 0.02) -> Recording:
    """Each detection fires the pixel on its right with a chance, up to 3 ns later."""
    rng = np.random.default_rng(seed)
    own = [rng.random(rng.poisson(600)) * 2e-3 for _ in range(rows * columns)]
    all_rows = []
    for p in range(rows * columns):
        more = np.zeros(0)
        if p % columns:
            more = own[p - 1][rng.random(len(own[p - 1])) < chance]
        all_rows.append(np.sort(np.concatenate([own[p], more + rng.random(len(more)) * 3e-9])))
    return tr_of([row[row < 2e-3] for row in all_rows], grid(rows, columns), 2e-3, 1e-10, 50e-9)


def test_light_that_spreads_is_seen_and_its_direction() -> None:
    """2 % of 15,000 detections: 300 pairs of side neighbours, where chance makes 9 within 1 ns and 18 up to 3 ns."""
    found = sigmas(Neighbours, spread(1), STEADY["tr"])
    assert found[0] > 10 and found[1] > 10 and found[5] > 10 and found[-3:-1].min() > 7  # of both directions together
    assert np.abs(found[[2, 3, 4, *range(6, len(found) - 3), -1]]).max() < 5
    assert np.abs(sigmas(FarPairs, spread(1), STEADY["tr"])).max() < 5
    # the law knows of it
    with pytest.raises(AssertionError):
        null_laws.normal(many(Neighbours, partial(spread, chance=2e-3), 100))


def test_frames_that_share_light_are_seen() -> None:
    rng = np.random.default_rng(1)
    bits = rng.random((400, 12, 12)) < 0.2
    bits[:, :, 1:] |= bits[:, :, :-1] & (rng.random((400, 12, 11)) < 0.05)
    steady = partial(qis, shape=(400, 12, 12), share=0.207)
    found = sigmas(Neighbours, qis_of(bits), steady)
    # 5 % of 0.2 * 0.8 of 400 * 132 pairs, against sqrt(0.2^2 0.8^2 * 400 * 132) = 37
    assert (
        found[0] > 7
        and found[6] > 5
        and np.abs(np.delete(found, [0, 6])).max() < 5
        and np.abs(sigmas(FarPairs, qis_of(bits), steady)).max() < 5
    )
    # a light that flickers by 21 % (rms) is common to all pairs, in the same frame and the next
    share = 0.2 * (1 + 0.3 * np.sin(np.arange(400) / 20))[:, None, None]
    found = sigmas(FarPairs, qis(1, (400, 12, 12), share), steady)
    assert found.min() > 10
    summary = reduced(FarPairs, qis(1, (400, 12, 12), share))
    text, number = summary.size(0, float(summary.values[0]), 0.0)
    assert 0.18 < number < 0.24 and "; as of a light that fluctuates by " in text


def test_stamps_in_frames_show_what_frames_cannot() -> None:
    """Pairs within a nanosecond in the same frame: a few of them are enough."""
    recording = stamped(1, (400, 6, 6), 0.3, tick=1e-9)
    stamps = np.asarray(recording.frames[:]).copy()  # type: ignore[index]
    stamps[:8, 2, 3] = stamps[:8, 2, 2] = 1234
    found = sigmas(Neighbours, str_of(stamps, 1e-9), partial(stamped, shape=(400, 6, 6), share=0.3, tick=1e-9))
    words = reduced(Neighbours, recording)
    cell = next(k for k in range(len(found)) if words.where(k) == "horizontal side neighbours, 0 to 1 ns")
    together = next(k for k in range(len(found)) if words.where(k) == "side neighbours, 0 to 1 ns")
    assert found[cell] > 4 and found[together] > 3 and np.abs(np.delete(found, [cell, together])).max() < 5


def test_a_few_pairs_are_seen_together_where_no_direction_shows_them() -> None:
    """Two pairs to the right and two below at each of 0.5, 2 and 6 ns, where chance makes less than one in each."""
    rate, exposure = 2000.0, 0.05
    recording = tr(1, grid(6, 10), rate, exposure)
    assert recording.events is not None
    rows = [list(recording.events.row(p)) for p in range(60)]
    for k, lag in enumerate([0.5e-9] * 4 + [2e-9] * 4 + [6e-9] * 4):
        first = 11 + 3 * k
        rows[first + (1 if k % 2 else 10)].append(float(rows[first][0]) + lag)
    spread = tr_of([np.sort(row) for row in rows], grid(6, 10), exposure, 1e-10, 0.0)
    found = sigmas(Neighbours, spread, partial(tr, layout=grid(6, 10), rates=rate, exposure=exposure))
    words = reduced(Neighbours, recording).where
    cells = {words(k): found[k] for k in range(len(found))}
    for span in ("0 to 1 ns", "1 to 3 ns", "3 to 10 ns"):
        apart = [cells[f"{way} side neighbours, {span}"] for way in ("horizontal", "vertical")]
        assert cells[f"side neighbours, {span}"] > max(*apart, 3.0)
