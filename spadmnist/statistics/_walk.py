"""A walk through the detections of the whole array in the order of time: spacings, crowds, clusters, pairs.

Everything that several statistics need of it is counted in one go, and kept with the recording.
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..events import Layout
from ..kernels import jit
from ..recording import Recording
from ._counting import exposure_in, guide, logarithmic, place, sort_ticks, tick_of, whole_ticks
from ._frames import first_stamps
from ._order import in_time_order

REACH = 3  # pitches
SIZES = ((2, 2), (3, 3), (4, 4), (5, 8), (9, 16), (17, 0))  # detections in a cluster; 0: any number
RANKS = (2, 4, 8, 16, 32)  # detections that a crowd has after its first one
_SELDOM = (1e-4, 1e-3, 1e-2, 1e-1)  # of all detections: crowds that steady light has so seldom, or more so
_LAGS = (1e-9, 3e-9, 10e-9, 30e-9, 100e-9)  # s
_LATER = 30e-9  # s: up to here one neighbour is asked to fire after the other
_GAPS = (1e-9, 10e-9)  # s
_PER_DECADE = 10
_AT_ONCE = 16384  # stamps of frames that are sorted together: they fit into the cache
_BLOCK = 4096  # detections that are gone through together: their times fit into the nearest cache
_DEEP = 4  # stamps of a pixel that are held; what is earlier is looked up
# detections of the array within the longest lag. Where there are fewer, going through all of them beats looking
# at each near pixel: both took 70 ns a detection at 7 of them, in an array of 16 x 16
_FEW_BACK = 6.0
_LONG = 1 << 20  # ticks in the longest lag, up to which the range of each one stands in a table
_RANGES = 8  # of lags, at most: a number that the compiler knows
_SHIFTS = 64  # steps between stamps up to which those of the whole array are compared in turn
_NEVER = -(1 << 62)


@dataclass(frozen=True)
class Near:
    """Pairs of pixels up to 3 pitches apart, in classes.

    names: of the classes; second: of those with a direction, which pixel is the second one, "" for the others; pairs:
    (class, first pixels, second pixels); steps: on a grid the same as (class, columns, rows) to go; sides: the
    classes of side neighbours on a grid.
    """

    names: tuple[str, ...]
    second: tuple[str, ...]
    pairs: tuple[tuple[int, np.ndarray, np.ndarray], ...]
    steps: np.ndarray | None
    sides: tuple[int, ...]

    def sums(self, of_first: np.ndarray, of_second: np.ndarray) -> np.ndarray:
        """(classes,) sums over the pairs of products of what belongs to their pixels, each (pixels,)."""
        out = np.zeros(len(self.names))
        for kind, first, second in self.pairs:
            out[kind] += of_first[first] @ of_second[second]
        return out

    @property
    def number(self) -> int:
        """How many pairs there are."""
        return sum(len(first) for _, first, _ in self.pairs)


SIDES = "side neighbours"  # the words for them
_DIRECTIONS = {
    (1, 0): (f"horizontal {SIDES}", "the right-hand one"),
    (0, 1): (f"vertical {SIDES}", "the lower one"),
    (1, 1): ("diagonal neighbours, falling", "the lower one"),
    (-1, 1): ("diagonal neighbours, rising", "the lower one"),
}


def near(layout: Layout) -> Near:
    """The pairs of near pixels of an array."""
    places = None if layout.positions is None else layout.positions.tobytes()
    return _near(layout.rows, layout.columns, places)


@lru_cache(maxsize=4)
def _near(rows: int, columns: int, places: bytes | None) -> Near:
    positions = None if places is None else np.frombuffer(places).reshape(-1, 2)
    known = Layout(rows, columns, 1.0, 1.0, positions).neighbours(REACH)
    names: list[str] = []
    second: list[str] = []
    pairs = []
    steps = []

    def kind(name: str, other: str = "") -> int:
        if name not in names:
            names.append(name)
            second.append(other)
        return names.index(name)

    if known.first is None:
        pixel = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
        for distance, (dx, dy) in zip(known.distance, known.step, strict=True):
            if dy < 0 or (dy == 0 and dx < 0):
                continue
            far = f"pixels about {2 if distance < 2.5 else 3} pitches apart", ""
            first = pixel[: rows - dy, max(0, -dx) : columns - max(0, dx)].ravel()
            pairs.append((kind(*_DIRECTIONS.get((int(dx), int(dy)), far)), first, first + np.int32(dy * columns + dx)))
            steps.append((pairs[-1][0], dx, dy))
    else:
        a = np.repeat(np.arange(rows * columns), np.diff(known.first))
        b, distance = known.step, known.distance
        bounds = (("nearest neighbours", 0.0, 1.25), ("pixels about 2 pitches apart", 1.25, 2.25))
        for name, low, high in (*bounds, ("pixels about 3 pitches apart", 2.25, np.inf)):
            some = (a < b) & (distance > low) & (distance <= high)
            if some.any():
                pairs.append((kind(name), a[some].astype(np.int32), b[some].astype(np.int32)))
    sides = tuple(k for k, name in enumerate(names) if name.endswith(SIDES))
    return Near(tuple(names), tuple(second), tuple(pairs), np.array(steps, np.int64) if steps else None, sides)


@dataclass(frozen=True)
class Walk:
    """What was counted.

    spacings: (edges + 1,), the first those of 0; crowds: (ranks, bins) detections by how lately the one came that
    stands so many places before them, see `crowd_edges`; clusters: (gaps, sizes); pairs: (bins,) of the
    whole array by lag; near: (classes, bins) the same of near pixels; same: (bins,) of the same pixel; later:
    (classes,) near pairs of which the second pixel is later.
    """

    spacings: np.ndarray
    crowds: np.ndarray
    clusters: np.ndarray
    pairs: np.ndarray
    near: np.ndarray
    same: np.ndarray
    later: np.ndarray


def spacing_edges(recording: Recording) -> np.ndarray:
    """(edges,) ticks, of spacings."""
    tick = tick_of(recording)
    longest = exposure_in(recording, tick) if recording.modality == "tr" else recording.none
    return logarithmic(1, longest, _PER_DECADE)


def crowd_edges(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """((ranks, bins) ticks, (ranks, bins) crowds by chance).

    A crowd belongs to the first bin whose edge it does not reach. The edges belong to the rate that the array has
    itself: no light level is needed, and none changes them beside it. Detections of steady light take a time of a gamma
    law for so many; below an edge in whole ticks they are half a tick below it in the mean.
    """
    from scipy import special

    ranks, tick, total = np.array(RANKS)[:, None], tick_of(recording), float(recording.totals.sum())
    rate = max(total, 1.0) / exposure_in(recording, tick)  # of the array, per tick
    edges = np.maximum(np.rint(special.gammaincinv(ranks, np.array(_SELDOM)) / rate), 1.0)
    share = np.diff(special.gammainc(ranks, (edges - 0.5) * rate), axis=1, prepend=0.0)
    return edges.astype(np.int64), np.maximum(total - ranks, 0.0) * share


@lru_cache(maxsize=1)
def crowd_scatter() -> np.ndarray:
    """(ranks, bins) variance of the number of crowds in steady light, as a multiple of its mean.

    Crowds overlap: those that end at two detections `k` places apart share the intervals between. With g_n a gamma law
    of n, p the chance of a crowd, and q_k(x) that k intervals make one of an interval x,

        variance / mean = 1 - p + 2 sum_k (int g_(r-k)(x) q_k(x)^2 dx - p^2) / p - r^2 (p_(r+1) - p)^2 / p,

    whose last term is there since the total of detections is given. Simulated numbers agree within their noise.
    """
    from scipy import special

    nodes, weights = np.polynomial.legendre.leggauss(64)
    out = np.ones((len(RANKS), len(_SELDOM)))
    for row, rank in enumerate(RANKS):
        edges = np.append(0.0, special.gammaincinv(rank, np.array(_SELDOM)))
        for bin, (low, high) in enumerate(pairwise(edges)):

            def within(n: int, less: np.ndarray | float, low: float = low, high: float = high) -> np.ndarray:
                """Chance that n intervals and `less` are from `low` to `high` long."""
                ends = (special.gammainc(n, np.maximum(end - less, 0.0)) for end in (high, low))
                return np.asarray(next(ends) - next(ends))

            p, more = float(within(rank, 0.0)), float(within(rank + 1, 0.0))
            variance = p - p**2 - (rank * (more - p)) ** 2
            for k in range(1, rank):
                for a, b in ((0.0, low), (low, high)):  # q_k has a corner at `low`
                    x = a + (b - a) * (nodes + 1.0) / 2.0
                    density = np.exp(special.xlogy(rank - k - 1, x) - x - special.gammaln(rank - k))
                    variance += (b - a) * float(weights @ (density * within(k, x) ** 2))
                variance -= 2.0 * p**2
            out[row, bin] = variance / p
    return out


def lag_edges(tick: float) -> np.ndarray:
    """(bins,) ticks: a lag belongs to the first bin whose edge is beyond it."""
    return np.unique([max(1, round(lag / tick)) for lag in _LAGS])


def latest(tick: float) -> int:
    """Ticks: what is later by less counts in `Walk.later`."""
    return max(2, round(_LATER / tick))


def gaps(tick: float) -> np.ndarray:
    """(gaps,) ticks: what is not further apart belongs to one cluster."""
    return np.array([max(1, round(gap / tick)) for gap in _GAPS])


def walk(recording: Recording) -> Walk:
    """Walk through a recording with time stamps, once."""
    known = recording._kept.get("walk")
    if known is None:
        known = recording._kept["walk"] = _through(recording)
    return known  # type: ignore[return-value]


def _through(recording: Recording) -> Walk:
    tick = tick_of(recording)
    edges, start = guide(spacing_edges(recording))
    lags, near_by = lag_edges(tick), near(recording.layout)
    spacings = np.zeros(edges.size, np.int64)
    crowds = np.zeros((len(RANKS), len(_SELDOM)), np.int64)
    clusters = np.zeros((len(_GAPS), len(SIZES)), np.int64)
    kinds = np.array([low for low, _ in SIZES])
    # behind the classes of near pixels comes the pixel itself, and then all pairs there are
    found = np.zeros((len(near_by.names) + 2, lags.size), np.int64)
    later = np.zeros(len(near_by.names) + 2, np.int64)
    if recording.events is None:
        for _, part in first_stamps(recording):
            between = gaps(tick), kinds, spacings, clusters
            _through_frames(part.offsets, part.stamps, recording.none, edges, start, *between)
    else:
        stamps, _ = whole_ticks(recording)
        offsets, end = recording.events.offsets, exposure_in(recording, tick)
        spot, stride, first, step, kind, second = around(recording.layout, near_by)
        ranks, passed = np.array(RANKS), _Passed.none(spot, stride, offsets)
        ranges = _Ranges.of_lags(lags, min(latest(tick), int(lags[-1])))
        for words, bits, new in in_time_order(recording, int(lags[-1]), int(ranks[-1])):
            _through_exposure(
                words, new, bits, stamps, offsets, end, edges, start, ranks, crowd_edges(recording)[0],
                gaps(tick), kinds, lags, ranges, spot, stride, first, step, kind, second,
                passed, spacings, crowds, clusters, found, later,
            )  # fmt: skip
        _finish(kinds, passed.runs, clusters)
    own, every = found[-2:]
    return Walk(spacings, crowds, clusters, every, found[:-2], own, later[:-2])


def around(layout: Layout, near_by: Near) -> tuple[np.ndarray, int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Who is around whom: (spot of each pixel, stride, first, step, kind, second).

    A spot is a place in an array with an empty margin, so that there is one around every pixel. On a grid all spots
    have the same entries: step (entries,) to go, with the class of the pair, and whether the pixel itself is its second
    one (not the one at the other end). With positions, stride is 0: spot p has the entries first[p] to first[p + 1],
    and step is the other spot itself. The pixel itself is the last class.
    """
    own = len(near_by.names)
    if near_by.steps is not None or layout.positions is None:
        stride = layout.columns + 2 * REACH
        rows, columns = np.divmod(np.arange(layout.pixels), layout.columns)
        spot = (rows + REACH) * stride + columns + REACH
        steps = np.zeros((0, 3), np.int64) if near_by.steps is None else near_by.steps
        go = steps[:, 1] + steps[:, 2] * stride
        step, kind = np.concatenate([go, -go, [0]]), np.concatenate([steps[:, 0], steps[:, 0], [own]])
        second = np.concatenate([np.zeros(go.size, bool), np.ones(go.size, bool), [False]])
        return spot, stride, np.zeros(0, np.int64), step, kind, second
    spot = np.arange(layout.pixels)
    a = np.concatenate([*(first for _, first, _ in near_by.pairs), *(second for _, _, second in near_by.pairs), spot])
    b = np.concatenate([*(second for _, _, second in near_by.pairs), *(first for _, first, _ in near_by.pairs), spot])
    classes = np.concatenate([np.full(len(first), kind) for kind, first, _ in near_by.pairs])
    classes = np.concatenate([classes, classes, np.full(spot.size, own)])
    order = np.argsort(a, kind="stable")
    first = np.searchsorted(a[order], np.arange(spot.size + 1))
    return spot, 0, first, b[order].astype(np.int64), classes[order], np.zeros(order.size, bool)


class _Passed(NamedTuple):
    """What is known of the detections that were passed.

    row_of: (spots,) the row at each spot; recent: (deep, spots) the last stamps; newest: (1,) of all; place: (spots,)
    of the last one; runs: (gaps,) how long the cluster is to which the last one belongs.
    """

    row_of: np.ndarray
    recent: np.ndarray
    newest: np.ndarray
    place: np.ndarray
    runs: np.ndarray

    @staticmethod
    def none(spot: np.ndarray, stride: int, offsets: np.ndarray) -> _Passed:
        """Before the first one. spot, stride: see `around`; offsets: of the rows."""
        spots = int(spot.max(initial=-1)) + 1 + REACH * (stride + 1)
        row_of, place = np.full(spots, -1), np.zeros(spots, np.int64)
        row_of[spot], place[spot] = np.arange(len(spot)), offsets[:-1] - 1
        recent, newest = np.full((_DEEP, spots), _NEVER), np.full(1, _NEVER)
        return _Passed(row_of, recent, newest, place, np.ones(len(_GAPS), np.int64))


class _Ranges(NamedTuple):
    """Ranges of lags, each in one bin, and either up to `latest` or beyond it.

    limits: (_RANGES,) ticks that each one does not reach, those behind the last one the longest lag; number: of them;
    of: (longest lag,) uint8, the range of each lag, or none where that would be long; latest: ticks.
    """

    limits: np.ndarray
    number: int
    of: np.ndarray
    latest: int

    @staticmethod
    def of_lags(lags: np.ndarray, latest: int) -> _Ranges:
        """The ranges of some bins. lags: (bins,) ticks; latest: ticks, not beyond the last of these."""
        longest = int(lags[-1])
        some = np.unique(np.append(lags, [1, latest]))
        limits = np.full(_RANGES, longest)
        limits[: some.size] = some
        of = np.searchsorted(some[:-1], np.arange(longest if longest <= _LONG else 0), side="right").astype(np.uint8)
        return _Ranges(limits, some.size, of, latest)


@jit
def _through_exposure(
    words, new, bits, stamps, offsets, end, edges, start, ranks, crowded, gaps, kinds, lags, ranges,
    spot, stride, first, step, kind, second, passed, spacings, crowds, clusters, found, later,
):  # fmt: skip
    """Walk through some detections in the order of time, from the first new one on, some after the others.

    words, bits: see `TimeOrder`; stamps, offsets: all of them, by rows; edges, start: of spacings, see `guide`; ranks,
    crowded: of crowds, with their edges; gaps, kinds: of clusters; lags: (bins,) ticks; ranges: of lags, see `_Ranges`;
    spot, ..., second: see `around`; passed: those before, to which these are added.
    Adds to spacings, crowds, clusters, found (classes, bins) pairs of near pixels, and of all in the last one, later
    (classes,).
    """
    total = offsets[offsets.size - 1]
    longest = lags[lags.size - 1]
    usual = np.float64(total) / end
    back = stride > 0 and usual * longest < _FEW_BACK and longest <= _LONG
    reach = REACH * (stride + 1)
    entry_of = np.full(2 * reach + 2, step.size)  # of the way from one spot to another; nobody's are the last
    for e in range(step.size if back else 0):
        entry_of[step[e] + reach] = e
    most = ranks[ranks.size - 1]
    times = np.empty(2 * _BLOCK, np.int64)
    some = np.empty(_BLOCK, np.int64)
    for begin in range(new, words.size, _BLOCK):
        stop = min(begin + _BLOCK, words.size)
        # with those before that are near enough to matter
        oldest = begin
        if not back:
            oldest = _after(words, bits, begin, (words[begin] >> bits) - longest)
        oldest = max(min(oldest, begin - most), 0)
        if times.size < stop - oldest:
            times = np.empty(2 * (stop - oldest), np.int64)
        for i in range(oldest, stop):
            times[i - oldest] = words[i] >> bits
        held, count = begin - oldest, stop - oldest
        if back:
            _near_pairs_back(words, bits, begin, stop, spot, lags, ranges, entry_of, kind, second, some, found, later)
        else:
            _near_pairs(
                words[begin:stop], bits, stamps, offsets, lags, ranges, spot, stride, first, step, kind, second,
                passed.row_of, passed.recent, passed.newest, passed.place, found, later,
            )  # fmt: skip
            before = np.int64(0)
            for k in range(lags.size):
                nearer = _pairs(times, held, count, lags[k], usual * lags[k])
                found[found.shape[0] - 1, k] += nearer - before
                before = nearer
        _spacings(times, max(held, 1), count, edges, start, spacings)
        _clusters(times, max(held, 1), count, gaps, kinds, passed.runs, some, clusters)
        for r in range(ranks.size):
            i = max(held, ranks[r])
            before = np.int64(0)
            for bin in range(crowded.shape[1] if i < count else 0):
                closer = _nearer(times[i:count], times[i - ranks[r] : count - ranks[r]], crowded[r, bin])
                crowds[r, bin] += closer - before
                before = closer


@jit
def _after(words, bits, end, time):
    """The first of the words before `end` that is later than `time`, looked for from there back."""
    far = 1
    while far < end and (words[end - far] >> bits) > time:
        far *= 2
    low, high = max(end - far, 0), end
    while low < high:
        middle = (low + high) // 2
        if (words[middle] >> bits) > time:
            high = middle
        else:
            low = middle + 1
    return low


@jit
def _add_ranges(counters, ranges, lags, kind, second, found, later):
    """Add what was counted by entry and range of lags to the classes of near pixels."""
    for e in range(kind.size):
        b = 0
        for k in range(ranges.number):
            while lags[b] < ranges.limits[k]:
                b += 1
            found[kind[e], b] += counters[e, k]
            if second[e] and 1 < ranges.limits[k] <= ranges.latest:
                later[kind[e]] += counters[e, k]


@jit
def _near_pairs_back(words, bits, begin, stop, spot, lags, ranges, entry_of, kind, second, some, found, later):
    """As `_near_pairs`, where few detections are near in time: all of these are gone through, and counted.

    words: all of them, of which those from `begin` to `stop` are looked back from; entry_of: see `_through_exposure`;
    some: a buffer for as many.
    """
    mask = (np.int64(1) << bits) - 1
    longest = lags[lags.size - 1]
    range_of = ranges.of
    counters = np.zeros((kind.size + 1, _RANGES + 1), np.int64)
    reach = np.int64(entry_of.size // 2 - 1)
    most = np.uint64(entry_of.size - 1)
    # those that are next to each other, then those next but one that were near enough, and so on until there are none
    left = np.uint64(stop - begin)
    for k in range(left):
        some[k] = begin + np.int64(k)
    step = 0
    while left > 0:
        step += 1
        still = np.uint64(0)
        for k in range(left):
            i = some[k]
            some[still] = i
            apart = (words[i] >> bits) - (words[max(i - step, 0)] >> bits)
            still += np.uint64((i >= step) & (apart < longest))
        left = still
        for k in range(left):
            i = some[k]
            j = i - step
            lag = (words[i] >> bits) - (words[j] >> bits)
            # far ones, which are most, all go to the place behind the last
            way = min(np.uint64(reach - spot[words[i] & mask] + spot[words[j] & mask]), most)
            counters[np.uint64(entry_of[way]), np.uint64(range_of[np.uint64(lag)])] += 1
    _add_ranges(counters, ranges, lags, kind, second, found, later)
    every = found[found.shape[0] - 1]
    for e in range(kind.size + 1):
        b = 0
        for k in range(ranges.number):
            while lags[b] < ranges.limits[k]:
                b += 1
            every[b] += counters[e, k]


@jit
def _near_pairs(
    words, bits, stamps, offsets, lags, ranges, spot, stride, first, step, kind, second,
    row_of, recent, newest, passed, found, later,
):  # fmt: skip
    """Count the pairs that each stamp makes with earlier ones around it; moves `recent`, ..., `passed` on."""
    mask = (np.int64(1) << bits) - 1
    longest = lags[lags.size - 1]
    limits, latest = ranges.limits, ranges.latest
    counters = np.zeros((step.size, _RANGES + 1), np.int64)
    hits = np.empty(step.size + 1, np.int64)
    begin, end, base = np.int64(0), np.int64(step.size), np.int64(0)
    for i in range(words.size):
        now = words[i] >> bits
        here = spot[words[i] & mask]
        if now - newest[0] < longest:
            if stride > 0:
                base = here
            else:
                begin, end = first[here], first[here + 1]
            # first all entries are gone through, then those that are found: no processor could guess which ones
            some = np.uint64(0)
            for e in range(begin, end):
                hits[some] = e
                some += np.uint64(now - recent[0, np.uint64(base + step[e])] < longest)
            depth = 0
            while some > 0 and depth < _DEEP:
                # where the last stamp of a depth is near enough, the one before it may be
                near = some
                some = np.uint64(0)
                for h in range(near):
                    e = hits[h]
                    place = np.uint64(base + step[e])
                    lag = now - recent[depth, place]
                    k = np.uint64(0)
                    for limit in range(_RANGES):
                        k += np.uint64(lag >= limits[limit])
                    counters[np.uint64(e), k] += 1
                    hits[some] = e
                    some += np.uint64(depth == _DEEP - 1 or now - recent[depth + 1, place] < longest)
                depth += 1
            for h in range(some):
                e = hits[h]
                row = row_of[base + step[e]]
                start, stop = offsets[row], passed[base + step[e]] - _DEEP + 1
                if stop > start and now - np.int64(stamps[stop - 1]) < longest:
                    _many_before(stamps, start, stop - 1, now, lags, found[kind[e]])
                    if second[e]:
                        until = _since(stamps, start, stop, now - 1)
                        later[kind[e]] += until - _since(stamps, start, until, now - latest)
        for depth in range(_DEEP - 1, 0, -1):
            recent[depth, here] = recent[depth - 1, here]
        recent[0, here] = now
        newest[0] = now
        passed[here] += 1
    _add_ranges(counters, ranges, lags, kind, second, found, later)


@jit
def _since(stamps, begin, end, time):
    """The first of the stamps from `begin` to `end` that is later than `time`."""
    while begin < end:
        middle = (begin + end) // 2
        if np.int64(stamps[middle]) > time:
            end = middle
        else:
            begin = middle + 1
    return begin


@jit
def _many_before(stamps, begin, k, now, lags, out):
    """Add the stamps from `begin` to `k` to the bins of their lags, however many there are."""
    until = k + 1
    for b in range(lags.size):
        first = _since(stamps, begin, until, now - lags[b])
        out[b] += until - first
        until = first


@jit
def _pairs(times, begin, end, lag, usual):
    """Pairs of times less than `lag` apart, of which the later one is one of begin to end; usual: how many each has."""
    number = np.int64(0)
    if usual < _SHIFTS / 4:
        # those that are next to each other, then those next but one, and so on until there are none
        for k in range(1, _SHIFTS):
            first = max(begin, k)
            some = _nearer(times[first:end], times[first - k : end - k], lag)
            number += some
            if some == 0:
                return number
        number = np.int64(0)
    oldest = _since(times, 0, begin, times[begin] - lag) if begin < end else begin
    # each step goes on in one of the two places, whichever it is: no branch that a processor could guess wrong
    i = begin
    while i < end:
        far = np.int64(times[i] - times[oldest] >= lag)
        number += (1 - far) * (i - oldest)
        oldest += far
        i += 1 - far
    return number


@jit
def _nearer(later, earlier, lag):
    """How many are less than `lag` later."""
    number = np.int64(0)
    for i in range(later.size):
        number += later[i] - earlier[i] < lag
    return number


@jit
def _spacings(times, begin, end, edges, start, spacings):
    """Count the spacings of times in order, from that between `begin` and the one before it."""
    for i in range(begin, end):
        spacings[place(times[i] - times[i - 1], edges, start) + 1] += 1


@jit
def _clusters(times, begin, end, gaps, kinds, runs, some, clusters):
    """Count clusters of times in order. runs: (gaps,) how long the one is to which that before `begin` belongs, which
    is brought up to date; some: (most,) a buffer, of which a time that is close to the one before takes one.
    """
    widest = gaps[gaps.size - 1]
    close = np.uint64(0)
    for i in range(begin, end):
        some[close] = i
        close += np.uint64(times[i] - times[i - 1] <= widest)
    for g in range(gaps.size):
        last = begin - 1
        for k in range(close):
            i = some[k]
            if times[i] - times[i - 1] > gaps[g]:
                continue
            if i > last + 1:
                if runs[g] > 1:
                    _end_of_run(kinds, runs[g], clusters[g])
                runs[g] = 1
            runs[g] += 1
            last = i
        if last < end - 1:
            if runs[g] > 1:
                _end_of_run(kinds, runs[g], clusters[g])
            runs[g] = 1


@jit
def _end_of_run(kinds, length, clusters):
    k = kinds.size - 1
    while kinds[k] > length:
        k -= 1
    clusters[k] += 1


@jit
def _finish(kinds, runs, clusters):
    for g in range(runs.size):
        if runs[g] > 1:
            _end_of_run(kinds, runs[g], clusters[g])
        runs[g] = 1


@jit
def _through_frames(offsets, stamps, none, edges, start, gaps, kinds, spacings, clusters):
    """Spacings and clusters of first stamps, frame by frame; see `FirstStamps`. Some frames are sorted together."""
    bits = 0
    while (np.int64(1) << bits) < none:
        bits += 1
    mask = (np.int64(1) << bits) - 1
    frames = offsets.size - 1
    most = _AT_ONCE
    for f in range(frames):
        most = max(most, offsets[f + 1] - offsets[f])
    raw = np.empty(most, np.int64)
    times = np.empty(most, np.int64)
    some = np.empty(most + 1, np.int64)
    runs = np.ones(gaps.size, np.int64)
    first = 0
    while first < frames:
        last = first + 1
        while last < frames and offsets[last + 1] - offsets[first] <= most:
            last += 1
        before = offsets[first]
        for f in range(first, last):
            for i in range(offsets[f], offsets[f + 1]):
                raw[i - before] = (np.int64(f - first) << bits) | np.int64(stamps[i])
        sort_ticks(raw, offsets[last] - before, 0, np.int64(last - first) << bits, times, 0)
        for f in range(first, last):
            begin, end = offsets[f] - before, offsets[f + 1] - before
            if end - begin > 1:
                for i in range(begin, end):
                    times[i] &= mask
                _spacings(times, begin + 1, end, edges, start, spacings)
                _clusters(times, begin + 1, end, gaps, kinds, runs, some, clusters)
                _finish(kinds, runs, clusters)
        first = last
