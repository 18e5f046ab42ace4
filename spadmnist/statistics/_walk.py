"""A walk through the detections of the whole array in the order of time: spacings, crowds, clusters, pairs.

Everything that several statistics need of it is counted in one go, and kept with the recording.
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..events import Layout
from ..kernels import jit
from ..recording import Recording
from ._counting import exposure_in, guide, logarithmic, place, sort_ticks, tick_of, whole_ticks
from ._frames import first_stamps

REACH = 3  # pitches
SIZES = ((2, 2), (3, 3), (4, 4), (5, 8), (9, 16), (17, 0))  # detections in a cluster; 0: any number
RANKS = (2, 4, 8, 16, 32)  # detections that a crowd has after its first one
_SELDOM = (1e-4, 1e-3, 1e-2, 1e-1)  # of all detections: crowds that steady light has so seldom, or more so
_LAGS = (1e-9, 3e-9, 10e-9, 30e-9, 100e-9)  # s
_LATER = 30e-9  # s: up to here one neighbour is asked to fire after the other
_GAPS = (1e-9, 10e-9)  # s
_PER_DECADE = 10
_AT_ONCE = 16384  # events that are sorted together: they fit into the cache
_DEEP = 4  # stamps of a pixel that are held; what is earlier is looked up
_FEW_BACK = 25.0  # detections of the array within the longest lag, up to which all of them are gone through
_RANGES = 8  # of lags, at most: a number that the compiler knows
_SHIFTS = 64  # steps between stamps up to which those of the whole array are compared in turn
_NEVER = -(1 << 62)


@dataclass(frozen=True)
class Near:
    """Pairs of pixels up to 3 pitches apart, in classes.

    names: of the classes; second: of those with a direction, which pixel is the second one, "" for the others; pairs:
    (class, first pixels, second pixels); steps: on a grid the same as (class, columns, rows) to go.
    """

    names: tuple[str, ...]
    second: tuple[str, ...]
    pairs: tuple[tuple[int, np.ndarray, np.ndarray], ...]
    steps: np.ndarray | None

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


_DIRECTIONS = {
    (1, 0): ("horizontal side neighbours", "the right-hand one"),
    (0, 1): ("vertical side neighbours", "the lower one"),
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
    return Near(tuple(names), tuple(second), tuple(pairs), np.array(steps, np.int64) if steps else None)


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
    upto = np.zeros(lags.size, np.int64)
    kinds = np.array([low for low, _ in SIZES])
    # behind the classes of near pixels comes the pixel itself
    found = np.zeros((len(near_by.names) + 1, lags.size), np.int64)
    later = np.zeros(len(near_by.names) + 1, np.int64)
    if recording.events is None:
        for _, part in first_stamps(recording):
            between = gaps(tick), kinds, spacings, clusters
            _through_frames(part.offsets, part.stamps, recording.none, edges, start, *between)
    else:
        stamps, _ = whole_ticks(recording)
        offsets, end = recording.events.offsets, exposure_in(recording, tick)
        spot, stride, first, step, kind, second = around(recording.layout, near_by)
        _through_exposure(
            stamps, offsets, end, edges, start, np.array(RANKS), crowd_edges(recording)[0], gaps(tick), kinds,
            lags, min(latest(tick), int(lags[-1])), spot, stride, first, step, kind, second,
            spacings, crowds, clusters, upto, found, later,
        )  # fmt: skip
    return Walk(spacings, crowds, clusters, np.diff(upto, prepend=0), found[:-1], found[-1], later[:-1])


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


@jit
def _through_exposure(
    stamps, offsets, end, edges, start, ranks, crowded, gaps, kinds, lags, latest,
    spot, stride, first, step, kind, second, spacings, crowds, clusters, upto, found, later,
):  # fmt: skip
    """Walk through all rows' stamps in the order of time, a slab of time after the other.

    edges, start: of spacings, see `guide`; ranks, crowded: of crowds, with their edges; gaps, kinds: of clusters; lags:
    (bins,) ticks; spot, ..., second: see `around`. Adds to spacings, crowds, clusters, upto (bins,) pairs of the array
    that are nearer than each of `lags`, found (classes, bins) pairs of near pixels, later (classes,).
    """
    rows = offsets.size - 1
    total = offsets[rows]
    if total == 0:
        return
    slabs = 1 + total // max(_AT_ONCE, 2 * rows)
    width = end // slabs + 1
    spots = np.int64(0)
    for row in range(rows):
        spots = max(spots, spot[row] + 1 + REACH * (stride + 1))
    bits = 0
    while (np.int64(1) << bits) < spots:
        bits += 1
    top = (np.int64(1) << (62 - bits)) - 1
    row_of = np.full(spots, -1)
    recent = np.full((_DEEP, spots), _NEVER)  # the last stamps that were passed
    latest_at = np.full(_DEEP + 1, _NEVER)  # of all those that ever stood at each depth; the last is held no longer
    passed = np.zeros(spots, np.int64)  # the place of the last one
    for row in range(rows):
        row_of[spot[row]] = row
        passed[spot[row]] = offsets[row] - 1
    position = offsets[:-1].copy()
    raw = np.empty(2 * total // slabs + 1024, np.int64)
    spare = np.empty(0, np.int64)
    ordered = np.empty(0, np.int64)
    times = np.empty(0, np.int64)
    heads = np.empty((2, 2049), np.int64)
    held = 0  # stamps of the slabs before that are near enough to matter
    longest = lags[lags.size - 1]
    back = stride > 0 and np.float64(total) * longest < _FEW_BACK * end
    reach = REACH * (stride + 1)
    entry_of = np.full(2 * reach + 2, step.size)  # of the way from one spot to another; nobody's are the last
    for e in range(step.size if back else 0):
        entry_of[step[e] + reach] = e
    tail = 0  # of them, those that stand before the sorted ones
    runs = np.ones(gaps.size, np.int64)
    last = np.int64(-1)
    past = np.full(ranks[ranks.size - 1], _NEVER)  # the last stamps before a slab
    for slab in range(slabs):
        stop = (slab + 1) * width if slab < slabs - 1 else top
        before = position.copy()
        count = _gather(stamps, offsets, position, stop, spot, bits, raw)
        while count < 0:
            raw = np.empty(2 * raw.size, np.int64)
            position[:] = before
            count = _gather(stamps, offsets, position, stop, spot, bits, raw)
        if spare.size < count:
            spare = np.empty(raw.size, np.int64)
        if ordered.size < tail + count:
            wider = np.empty(tail + raw.size, np.int64)
            wider[:tail] = ordered[:tail]
            ordered = wider
        if times.size < held + count:
            grown = np.empty(held + raw.size, np.int64)
            grown[:held] = times[:held]
            times = grown
        sort_ticks(raw, count, (slab * width) << bits, width << bits, ordered, tail, spare, heads)
        if back:
            _near_pairs_back(ordered, tail, tail + count, bits, lags, latest, entry_of, kind, second, found, later)
        else:
            _near_pairs(
                ordered[:count], bits, stamps, offsets, lags, latest, stride, first, step, kind, second,
                row_of, recent, latest_at, passed, found, later,
            )  # fmt: skip
        for i in range(count):
            times[held + i] = ordered[tail + i] >> bits
        last = _follow(times, held, held + count, last, edges, start, gaps, kinds, runs, spacings, clusters)
        whole = held + count
        _crowds(times[held:whole], past, ranks, crowded, crowds)
        for k in range(lags.size):
            upto[k] += _pairs(times, held, whole, lags[k], np.float64(total) * lags[k] / end)
        oldest = _since(times, 0, whole, stop - longest)
        for i in range(oldest, whole):
            times[i - oldest] = times[i]
        if back:  # as many of those that know their spots
            for i in range(oldest, whole):
                ordered[i - oldest] = ordered[i]
            tail = whole - oldest
        held = whole - oldest
    _finish(kinds, runs, clusters)


@jit
def _gather(stamps, offsets, position, stop, spot, bits, raw):
    """The stamps before `stop`, with their spots in the lower bits; moves `position` on. -1 where there is no room."""
    count = 0
    for row in range(offsets.size - 1):
        i = position[row]
        while i < offsets[row + 1] and np.int64(stamps[i]) < stop:
            i += 1
        if count + i - position[row] > raw.size:
            return -1
        for k in range(position[row], i):
            raw[count] = (np.int64(stamps[k]) << bits) | spot[row]
            count += 1
        position[row] = i
    return count


@jit
def _ranges(lags, latest):
    """(ranges of lags: up to each of these, then so far that nothing is; how many they are)."""
    ranges = np.unique(np.append(lags, np.array([1, latest])))
    limits = np.full(_RANGES, lags[lags.size - 1])
    limits[: ranges.size] = ranges
    return limits, ranges.size


@jit
def _add_ranges(counters, limits, ranges, lags, latest, kind, second, found, later):
    """Add what was counted by entry and range of lags to the classes of near pixels."""
    for e in range(kind.size):
        b = 0
        for k in range(ranges):
            while lags[b] < limits[k]:
                b += 1
            found[kind[e], b] += counters[e, k]
            if second[e] and 1 < limits[k] <= latest:
                later[kind[e]] += counters[e, k]


@jit
def _near_pairs_back(ordered, begin, end, bits, lags, latest, entry_of, kind, second, found, later):
    """As `_near_pairs`, where few stamps are near in time: all of these are gone through.

    ordered: of the stamps before `begin` those that are near enough are there, too; entry_of: see `_through_exposure`.
    """
    mask = (np.int64(1) << bits) - 1
    longest = lags[lags.size - 1]
    limits, ranges = _ranges(lags, latest)
    counters = np.zeros((kind.size + 1, _RANGES + 1), np.int64)
    reach = np.int64(entry_of.size // 2 - 1)
    most = np.uint64(entry_of.size - 1)
    for i in range(begin, end):
        now = ordered[i] >> bits
        here = reach - (ordered[i] & mask)
        j = i - 1
        while j >= 0:
            lag = now - (ordered[j] >> bits)
            if lag >= longest:
                break
            # far ones, which are most, all go to the place behind the last
            way = min(np.uint64(here + (ordered[j] & mask)), most)
            e = entry_of[way]
            if e < kind.size:
                k = np.uint64(0)
                for limit in range(_RANGES):
                    k += np.uint64(lag >= limits[limit])
                counters[e, k] += 1
            j -= 1
    _add_ranges(counters, limits, ranges, lags, latest, kind, second, found, later)


@jit
def _near_pairs(
    ordered, bits, stamps, offsets, lags, latest, stride, first, step, kind, second,
    row_of, recent, latest_at, passed, found, later,
):  # fmt: skip
    """Count the pairs that each stamp makes with earlier ones around it; moves `recent`, ..., `passed` on."""
    mask = (np.int64(1) << bits) - 1
    longest = lags[lags.size - 1]
    limits, ranges = _ranges(lags, latest)
    counters = np.zeros((step.size, _RANGES + 1), np.int64)
    hits = np.empty(step.size + 1, np.int64)
    begin, end, base = np.int64(0), np.int64(step.size), np.int64(0)
    for i in range(ordered.size):
        now = ordered[i] >> bits
        here = ordered[i] & mask
        if now - latest_at[0] < longest:
            if stride > 0:
                base = here
            else:
                begin, end = first[here], first[here + 1]
            depth = 0
            while depth < _DEEP and now - latest_at[depth] < longest:
                # first all entries are gone through, then those that are found: no processor could guess which ones
                some = np.uint64(0)
                for e in range(begin, end):
                    lag = now - recent[depth, np.uint64(base + step[e])]
                    hits[some] = e
                    some += np.uint64(lag < longest)
                for h in range(some):
                    lag = now - recent[depth, np.uint64(base + step[hits[h]])]
                    k = np.uint64(0)
                    for limit in range(_RANGES):
                        k += np.uint64(lag >= limits[limit])
                    counters[np.uint64(hits[h]), k] += 1
                depth += 1
            if now - latest_at[_DEEP] < longest:
                for e in range(begin, end):
                    row = row_of[base + step[e]]
                    if row < 0:
                        continue
                    start, stop = offsets[row], passed[base + step[e]] - _DEEP + 1
                    if stop > start and now - np.int64(stamps[stop - 1]) < longest:
                        _many_before(stamps, start, stop - 1, now, lags, found[kind[e]])
                        if second[e]:
                            until = _since(stamps, start, stop, now - 1)
                            later[kind[e]] += until - _since(stamps, start, until, now - latest)
        for depth in range(_DEEP, 0, -1):
            earlier = recent[depth - 1, here]
            latest_at[depth] = max(latest_at[depth], earlier)
            if depth < _DEEP:
                recent[depth, here] = earlier
        recent[0, here] = now
        latest_at[0] = now
        passed[here] += 1
    _add_ranges(counters, limits, ranges, lags, latest, kind, second, found, later)


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
def _follow(times, begin, end, last, edges, start, gaps, kinds, runs, spacings, clusters):
    """Count spacings and clusters of times in order; last: the one before them, -1 without. Returns the last one."""
    for i in range(begin, end):
        now = times[i]
        if last >= 0:
            apart = now - last
            spacings[place(apart, edges, start) + 1] += 1
            for g in range(gaps.size):
                if apart <= gaps[g]:
                    runs[g] += 1
                elif runs[g] > 1:
                    _end_of_run(kinds, runs[g], clusters[g])
                    runs[g] = 1
        last = now
    return last


@jit
def _crowds(times, past, ranks, crowded, crowds):
    """Count crowds of times in order by how long they last. past: (most,) the times before them, brought up to date."""
    most = past.size
    for i in range(times.size):
        for r in range(ranks.size):
            k = i - ranks[r]
            apart = times[i] - (times[k] if k >= 0 else past[most + k])
            bin = crowded.shape[1]
            while bin > 0 and apart < crowded[r, bin - 1]:
                bin -= 1
            if bin < crowded.shape[1]:
                crowds[r, bin] += 1
    some = min(times.size, most)
    past[: most - some] = past[some:].copy()
    past[most - some :] = times[times.size - some :]


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
    spare = np.empty(most, np.int64)
    times = np.empty(most, np.int64)
    heads = np.empty((2, 2049), np.int64)
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
        sort_ticks(raw, offsets[last] - before, 0, np.int64(last - first) << bits, times, 0, spare, heads)
        for f in range(first, last):
            begin, end = offsets[f] - before, offsets[f + 1] - before
            if end - begin > 1:
                for i in range(begin, end):
                    times[i] &= mask
                _follow(times, begin, end, -1, edges, start, gaps, kinds, runs, spacings, clusters)
                _finish(kinds, runs, clusters)
        first = last
