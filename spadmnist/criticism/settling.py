"""Settling: numbers of a model that bring it nearest to a measurement, and how well they are known.

By Gauss's and Newton's method on the residuals of all cells, every point being simulated (`fit`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .candidates import Dial, Key
from .fit import FEW, RATES, Bench, Cell, Sensors, State, stacked

_ASIDE = 0.2  # of a logarithm, to both sides, for a slope
_CLOSE = 0.02  # and no nearer
_TOLD_ASIDE = (0.1, 0.7)  # the same, of slopes that are known but for their size
_TOLD_SIZE = 2.5  # times what they are thought to be, at most
_SAME = 0.35  # of a logarithm, or of where a number is looked for: so far slopes hold
_PROMISING = 0.1  # of the root of what was gained: far less than what tells two candidates apart
_VAIN = 2  # steps in a row, the second one shorter, that gain nothing: what is left is chance
_BLIND = 0.05  # squared slope of a number that nothing tells
_TOLD_BY_OTHERS = 0.3  # of the information on a number, at least, for a capture to be judged by the others


@dataclass
class Settled:
    """Values of some dials: point, covariance of their coordinates, the residuals left, how they follow the dials."""

    dials: tuple[Dial, ...]
    point: np.ndarray
    covariance: np.ndarray
    residuals: dict[Cell, np.ndarray]
    slopes: dict[Cell, np.ndarray]  # (cells, dials)
    square: float
    values: dict[Key, Any]
    phases: dict[tuple[str, Key], float] = field(default_factory=dict)

    def interval(self, i: int) -> tuple[float, float, float]:
        """(value, low, high) of 95 %."""
        dial, half = self.dials[i], 1.96 * math.sqrt(max(float(self.covariance[i, i]), 0.0))
        u = float(self.point[i])
        return dial.value(u), *dial.interval(u - half, u + half)


def point_of(dials: Sequence[Dial], values: Mapping[Key, Any]) -> np.ndarray:
    """The coordinates of some values, one for each dial."""
    return np.array([d.coordinate(float(values[d.key])) for d in dials])


def settle(
    bench: Bench,
    state: State,
    dials: Sequence[Dial],
    values: Mapping[Key, Any],
    sensors_of: Callable[[Mapping[Key, Any]], Sensors],
    rounds: int = 3,
    few: int = FEW,
    stronger: tuple[float, float] = (1.0, 1.0),
    only: Collection[str] = (),
) -> Settled | str:
    """Gauss-Newton on the residuals of all cells, from `values` on; every point is simulated.

    only: of these captures; the others' cells are taken not to follow. stronger: (factor, power). Of what is
    faint, what one `factor` times as strong does is simulated, and taken for factor^power times what it does itself.
    """
    dials = tuple(dials)
    keys = list(state.residuals)
    fixed = dict(values)

    def at(u: np.ndarray) -> dict[Key, Any]:
        return {**fixed, **{d.key: d.value(float(x)) for d, x in zip(dials, u, strict=True)}}

    def evaluate(points: Sequence[np.ndarray]) -> list[np.ndarray | str]:
        found = bench.moved(state, [sensors_of(boosted(at(u))) for u in points], few, only)
        times = stronger[0] ** -stronger[1]
        return [m if isinstance(m, str) else stacked(bench.residuals(state, m, times), keys) for m in found]

    def boosted(values: dict[Key, Any]) -> dict[Key, Any]:
        if stronger[0] == 1:
            return values
        up = {d.key: d.scaled(float(values[d.key]), stronger[0]) for d in dials if d.off is not None}
        return {**values, **up}

    u = point_of(dials, values)
    own = np.concatenate([state.own[k] for k in keys], axis=1)  # (recordings, cells)
    steps = np.array([0.25 if d.log else max(0.05 * (d.high - d.low), 0.02) for d in dials])
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    begun = 0.0
    slopes, there, damping, promised, vain = np.zeros((0, len(dials))), u, 0.0, 0.0, 0
    limit = np.array([1.2 if d.log else 0.5 * (d.high - d.low) for d in dials])
    reach = np.array([_SAME if d.log else _SAME * (d.high - d.low) for d in dials])
    seen = np.ones(len(dials), bool)  # which of the dials anything follows
    for turn in range(2 * rounds):
        # slopes hold for a while: they are found anew where the point has moved on, or did not gain what they promised
        anew = turn == 0 or bool(np.any(np.abs(u - there) > reach))
        found = evaluate([u, *(_aside(dials, u, steps, seen) if anew else [])])
        if isinstance(found[0], str):
            return found[0]
        z = found[0]
        cost = float(z @ z)
        if best is not None and not anew and best[0] - cost < 0.3 * promised:
            if promised < 4:
                break
            found = [z, *evaluate(_aside(dials, u, steps, seen))]
            anew = True
        if anew:
            slopes, there = np.zeros((len(z), len(dials))), u
            slopes[:, seen] = _slopes(found[1:], _aside(dials, u, steps, seen), len(z), np.flatnonzero(seen))
            seen = np.einsum("ij,ij->j", slopes, slopes) >= _BLIND
        if best is None or cost < best[0]:
            best, damping, vain = (cost, u, z), damping / 3, 0
        else:
            damping, vain = max(3 * damping, 1.0), vain + 1
            if vain == _VAIN:
                break
        if not dials:  # whole numbers alone, say, of which each is another model
            break
        cost, u0, z = best
        normal = slopes.T @ slopes
        step = -np.linalg.pinv(normal + damping * np.diag(np.diag(normal)), rcond=1e-8) @ (slopes.T @ z)
        step = step * min(1.0, float(np.min(limit / np.maximum(np.abs(step), 1e-12))))
        u = np.array([d.coordinate(d.value(float(x))) for d, x in zip(dials, u0 + step, strict=True)])
        promised = float(cost - ((z + slopes @ (u - u0)) ** 2).sum())
        error = np.sqrt(np.maximum(np.diag(covariance_of(slopes, own)), 1e-30))
        # never so short that what is taken for noise, or not, makes a slope
        steps = np.clip(8 * error, [0.1 if d.log else 0.02 * (d.high - d.low) for d in dials], 0.5)
        begun = cost if turn == 0 else begun
        if turn and (
            promised < 1.0 + _PROMISING * math.sqrt(max(begun - cost, 0.0)) or np.all(np.abs(u - u0) < 0.3 * error)
        ):
            break
    assert best is not None
    cost, u, z = best
    return Settled(
        dials, u, covariance_of(slopes, own), _split(z, state, keys), _split(slopes, state, keys), cost, at(u)
    )


def _aside(dials: Sequence[Dial], u: np.ndarray, steps: np.ndarray, seen: np.ndarray | None = None) -> list[np.ndarray]:
    """Points to both sides of one, dial by dial: what chance does to the point itself must not be in the slope.

    seen: of which dials.
    """
    out = []
    for i, dial in enumerate(dials):
        if seen is not None and not seen[i]:
            continue
        for h in (steps[i], -steps[i]):
            other = u.copy()
            other[i] = dial.coordinate(dial.value(u[i] + h))
            out.append(other)
    return out


def _slopes(
    found: Sequence[np.ndarray | str],
    places: Sequence[np.ndarray],
    cells: int,
    which: Sequence[int] | np.ndarray | None = None,
) -> np.ndarray:
    """(cells, dials) how residuals follow the dials, from those at points `_aside`; 0 where one could not be made.

    which: the numbers of the dials.
    """
    out = np.zeros((cells, len(places) // 2))
    for i in range(out.shape[1]):
        up, down = found[2 * i], found[2 * i + 1]
        k = i if which is None else which[i]
        apart = places[2 * i][k] - places[2 * i + 1][k]
        if not isinstance(up, str) and not isinstance(down, str) and apart > 0:
            out[:, i] = (up - down) / apart
    return out


def follow(
    bench: Bench,
    state: State,
    dials: Sequence[Dial],
    values: Mapping[Key, Any],
    sensors_of: Callable[[Mapping[Key, Any]], Sensors],
    few: int = FEW,
    errors: Mapping[Key, float] | None = None,
    known: Mapping[Key, Mapping[Cell, np.ndarray]] | None = None,
    before: Settled | None = None,
) -> Settled | str:
    """One step of Gauss and Newton from a state that has these values: as many recordings tell it as the state has.

    Only how the cells follow the numbers is found from a few recordings more. errors: standard deviations of
    coordinates, as far as they are known: about an edge a slope holds no further than it is known. known: slopes of
    which only the size is not known for certain: what chance leaves in the cells of a faint effect hides the rest.
    before: what was settled from a state near by, whose slopes still hold.
    """
    dials = tuple(dials)
    keys = list(state.residuals)
    z, u = stacked(state.residuals, keys), point_of(dials, values)
    own = np.concatenate([state.own[k] for k in keys], axis=1)
    slopes: np.ndarray | str
    if before is not None and before.dials == dials:
        slopes = np.stack([_stacked_slope(state, _of_dial(before, i), keys) for i in range(len(dials))], axis=1)
    else:
        slopes = _slopes_about(bench, state, dials, u, values, sensors_of, few, errors or {}, known or {})
    if isinstance(slopes, str):
        return slopes
    covariance = covariance_of(slopes, own)
    error = np.sqrt(np.minimum(np.diag(covariance), 1.0))
    step = -np.linalg.pinv(slopes.T @ slopes, rcond=1e-10) @ (slopes.T @ z)
    step = np.where(np.isfinite(np.diag(covariance)), np.clip(step, -5 * error, 5 * error), 0.0)  # blind: as it is
    point = np.array([d.coordinate(d.value(float(x))) for d, x in zip(dials, u + step, strict=True)])
    left = z + slopes @ (point - u)
    new = {**values, **{d.key: d.value(float(x)) for d, x in zip(dials, point, strict=True)}}
    return Settled(
        dials, point, covariance, _split(left, state, keys), _split(slopes, state, keys), float(left @ left), new
    )


def _slopes_about(
    bench: Bench,
    state: State,
    dials: Sequence[Dial],
    u: np.ndarray,
    values: Mapping[Key, Any],
    sensors_of: Callable[[Mapping[Key, Any]], Sensors],
    few: int,
    errors: Mapping[Key, float],
    known: Mapping[Key, Mapping[Cell, np.ndarray]],
) -> np.ndarray | str:
    """(cells, dials) how the residuals of a state follow its numbers; arguments as of `follow`."""
    keys = list(state.residuals)
    cells = sum(len(state.residuals[key]) for key in keys)
    h = np.array([_ASIDE if d.log else max(0.05 * (d.high - d.low), 0.02) for d in dials])
    near = np.array([errors.get(d.key, math.inf) for d in dials])
    h = np.minimum(h, np.maximum(8 * near, _CLOSE))
    told = {i: _stacked_slope(state, known[d.key], keys) for i, d in enumerate(dials) if d.key in known}
    for i, slope in told.items():  # so far that it is seen
        h[i] = np.clip(2 / max(math.sqrt(float(slope @ slope)), 1e-9), *_TOLD_ASIDE) * (h[i] / _ASIDE)
    points = _aside(dials, u, h)
    values_there = [{d.key: d.value(float(x)) for d, x in zip(dials, p, strict=True)} for p in points]
    ends: list[np.ndarray | str] = [np.zeros(0)] * len(points)
    for bare in (False, True):
        some = [k for k in range(len(points)) if (k // 2 in told) == bare]
        made = bench.moved(state, [sensors_of(values_there[k]) for k in some], few, kept="all" if bare else "likely")
        for k, m in zip(some, made, strict=True):
            if isinstance(m, str):
                return m
            ends[k] = stacked(bench.residuals(state, m), keys)
    slopes = _slopes(ends, points, cells)
    for i, slope in told.items():
        size = float(slopes[:, i] @ slope) / max(float(slope @ slope), 1e-12)
        slopes[:, i] = slope * np.clip(size, 1 / _TOLD_SIZE, _TOLD_SIZE)
    return slopes


def _of_dial(settled: Settled, i: int) -> dict[Cell, np.ndarray]:
    return {cell: slopes[:, i] for cell, slopes in settled.slopes.items()}


def _stacked_slope(state: State, slope: Mapping[Cell, np.ndarray], keys: Sequence[Cell]) -> np.ndarray:
    """A slope of another state's cells, 0 where this one has others."""
    parts = []
    for key in keys:
        own = slope.get(key)
        size = len(state.residuals[key])
        parts.append(own if own is not None and len(own) == size else np.zeros(size))
    return np.concatenate(parts)


def profiled(
    bench: Bench,
    state: State,
    settled: Settled,
    sensors_of: Callable[[Mapping[Key, Any]], Sensors],
    few: int = FEW,
) -> dict[Key, tuple[float, float]]:
    """Intervals of 95 % by profile: each number is moved until the squares have risen, the others following it.

    Squares of cells that are not independent rise by more than those of independent ones: by as much as the variance
    of the estimate is larger than theirs. Simulated twice for each end, at where it should be and at where it seems.
    """
    slopes = np.concatenate([settled.slopes[k] for k in state.residuals])
    naive, n = np.linalg.pinv(slopes.T @ slopes, rcond=1e-10), len(settled.dials)
    told = [i for i in range(n) if np.isfinite(settled.covariance[i, i]) and naive[i, i] > 0]
    ends = [(i, side) for i in told for side in (-1, 1)]
    goal = np.array([3.84 * settled.covariance[i, i] / naive[i, i] for i, _ in ends])

    def at(i: int, u: float) -> Sensors:
        point = settled.point + naive[:, i] / naive[i, i] * (u - settled.point[i])
        return sensors_of({d.key: d.value(float(x)) for d, x in zip(settled.dials, point, strict=True)})

    def within(i: int, u: float) -> float:
        return settled.dials[i].coordinate(settled.dials[i].value(u))

    def squares(models: Sequence[Sensors]) -> np.ndarray:
        keys, found = list(state.residuals), bench.moved(state, models, few)
        z = [np.full(1, math.nan) if isinstance(m, str) else stacked(bench.residuals(state, m), keys) for m in found]
        return np.array([float(one @ one) for one in z])

    reach = np.array([math.sqrt(3.84 * settled.covariance[i, i]) for i, _ in ends])
    usual = squares([sensors_of({d.key: d.value(float(x)) for d, x in zip(settled.dials, settled.point, strict=True)})])
    for _ in range(2):
        u = [within(i, settled.point[i] + side * h) for (i, side), h in zip(ends, reach, strict=True)]
        rise = squares([at(i, x) for (i, _), x in zip(ends, u, strict=True)]) - usual
        # what rises less at a bound would have gone on
        reach = np.abs(np.array(u) - [settled.point[i] for i, _ in ends])
        more = np.sqrt(goal / np.maximum(np.nan_to_num(rise, nan=1.0), goal / 4))
        reach = reach * np.clip(np.where(np.isnan(rise), 1.0, more), 0.5, 2.0)
    out = [settled.point[i] + side * h for (i, side), h in zip(ends, reach, strict=True)]
    return {settled.dials[i].key: settled.dials[i].interval(out[2 * k], out[2 * k + 1]) for k, i in enumerate(told)}


def alone(residuals: Mapping[Cell, np.ndarray], slopes: Mapping[Cell, np.ndarray]) -> set[str]:
    """Captures without which some number, or what several of them have in common, is hardly told."""
    keys = _alike(residuals, slopes)
    parts = {key: slopes[key].T @ slopes[key] for key in keys}
    if not parts:
        return set()
    values, vectors = np.linalg.eigh(sum(parts.values()))
    told = values > 1e-9 * max(float(values.max(initial=0.0)), 1e-300)
    root = vectors[:, told] / np.sqrt(values[told])
    out = set()
    for id in {key[0] for key in keys} - {""}:
        own = sum(part for key, part in parts.items() if key[0] == id)
        share = np.linalg.eigvalsh(root.T @ own @ root)  # of what is known of each direction
        if share.size and 1 - float(share.max()) < _TOLD_BY_OTHERS:
            out.add(id)
    return out


def _alike(residuals: Mapping[Cell, np.ndarray], slopes: Mapping[Cell, np.ndarray]) -> list[Cell]:
    return [k for k in slopes if k in residuals and len(residuals[k]) == len(slopes[k])]


def unseen(residuals: Mapping[Cell, np.ndarray], slopes: Mapping[Cell, np.ndarray]) -> dict[Cell, np.ndarray]:
    """Residuals of each capture, the numbers being settled without it (to first order).

    Where one capture alone tells a number, each of its cells is judged by what the others of them say. What the numbers
    lack of where the squares are least, a bound say, they lack all the same.
    """
    keys, without = _alike(residuals, slopes), alone(residuals, slopes)
    z, slope = stacked(residuals, keys), np.concatenate([slopes[k] for k in keys])
    normal = slope.T @ slope
    out = dict(residuals)
    ridge = 1e-9 * np.trace(normal) * np.eye(len(normal))
    inverse = np.linalg.pinv(normal + ridge)
    lacking = -inverse @ (slope.T @ z)
    for id in {k[0] for k in keys} - {""}:
        mine = np.concatenate([np.full(len(residuals[k]), k[0] == id) for k in keys])
        own = slope[mine]
        if id in without:
            hat = np.minimum(np.einsum("ij,jk,ik->i", own, inverse, own), 0.9)
            beyond = (z[mine] + own @ lacking) * hat / (1 - hat)
        else:
            # 0 where nothing follows any number
            rest = -np.linalg.pinv(normal - own.T @ own + ridge) @ (slope[~mine].T @ z[~mine])
            beyond = own @ (rest - lacking)
        start = 0
        for key in (k for k in keys if k[0] == id):
            size = len(residuals[key])
            out[key] = residuals[key] + beyond[start : start + size]
            start += size
    return out


def optimism(residuals: Mapping[Cell, np.ndarray], settled: Settled) -> float:
    """By how much the squares are smaller than on captures that the numbers are not settled with; at least 0.

    Of the totals, and of a capture that alone tells a number, it is what chance lets as many numbers gain there: two
    for each (Mallows, Technometrics 15 (1973) 661).
    """
    keys, without = _alike(residuals, settled.slopes), alone(residuals, settled.slopes)
    apart = unseen(residuals, settled.slopes)
    slope = np.concatenate([settled.slopes[k] for k in keys])
    inverse = np.linalg.pinv(slope.T @ slope, rcond=1e-10)
    found = 0.0
    for key in keys:
        if key == RATES or key[0] in without:
            found += 2 * float(np.trace(inverse @ settled.slopes[key].T @ settled.slopes[key]))
        else:
            found += float(apart[key] @ apart[key] - residuals[key] @ residuals[key])
    return max(found, 0.0)


def covariance_of(slopes: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Of the least-squares estimate, the cells scattering as they do in the model's own recordings."""
    solve = np.linalg.pinv(slopes.T @ slopes, rcond=1e-10) @ slopes.T
    estimates = own @ solve.T
    n = len(own)
    # what so many recordings miss by chance: a little wider
    covariance = np.atleast_2d(np.cov(estimates.T)) * (n + 2) / max(n - 2, 1)
    blind = np.einsum("ij,ij->j", slopes, slopes) < _BLIND
    covariance[blind, blind] = np.inf  # nothing tells it
    return covariance


def unexplained_scatter(settled: Settled, state: State) -> np.ndarray:
    """(dials,) by how much wider the cells that tell each number lie about the model than chance has it; at least 1.

    A law that is not quite the sensor's leaves something there, and the number is known no better than that lets it be.
    state: how the model's own recordings scatter.
    Source: White, Econometrica 50 (1982) 1, and the scale factor of the Particle Data Group.
    """
    keys = [k for k, own in state.own.items() if len(settled.slopes.get(k, ())) == own.shape[1]]
    if not keys:
        return np.ones(len(settled.dials))
    slopes, z = np.concatenate([settled.slopes[k] for k in keys]), stacked(settled.residuals, keys)
    usual = np.concatenate([np.mean(state.own[k] ** 2, axis=0) for k in keys])
    inverse = np.linalg.pinv(slopes.T @ slopes, rcond=1e-10)
    weight = (slopes @ inverse) ** 2
    expected, found = weight.T @ usual, weight.T @ z**2
    return np.sqrt(np.maximum(np.divide(found, expected, out=np.ones_like(found), where=expected > 0), 1.0))


def _split(stack: np.ndarray, state: State, keys: Sequence[Cell]) -> dict[Cell, np.ndarray]:
    out, start = {}, 0
    for key in keys:
        size = len(state.residuals[key])
        out[key] = stack[start : start + size]
        start += size
    return out
