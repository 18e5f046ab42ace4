"""Numba kernels on ragged rows: the counter-based random numbers and the loops over events.

Every kernel is plain IEEE arithmetic without fused or reordered operations (`fastmath` is off) and with its own
logarithm, so that the bytes do not depend on the width of the SIMD unit or on the machine's mathematical library.

A *row* is one pixel of one image. `offsets` has one entry more than there are rows; the events of row `r` are
`times[offsets[r]:offsets[r + 1]]`, ascending. Times are seconds since the start of the exposure.

The per-image functions (leading underscore) are shared: the staged line calls them stage by stage over a batch of
images, `paper_line` calls them image by image so that everything stays in the processor's cache. Both therefore
give the same events, bit for bit.
"""

# mypy: disable-error-code="no-untyped-def"
# numba takes the types from the calls; the docstrings give them.

from __future__ import annotations

from typing import Any

import numpy as np

from .compiled import intrinsic, kernel, types

# `error_model="numpy"` drops the check for division by zero, which would keep LLVM from vectorising.
_jit = kernel(error_model="numpy", nogil=True)
_inline = kernel(error_model="numpy", nogil=True, inline="always")


@intrinsic
def _bits(typingctx: Any, x: Any) -> Any:
    """The 64 bits of a double."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], context.get_value_type(types.uint64))

    return types.uint64(types.float64), codegen


@intrinsic
def _double(typingctx: Any, x: Any) -> Any:
    """The double that has these 64 bits."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], context.get_value_type(types.float64))

    return types.float64(types.uint64), codegen


# --- random numbers ---------------------------------------------------------------------------------------------
# Philox4x32-10 (Salmon, Moraes, Dror, Shaw, SC 2011): a block of 128 random bits is a function of a 64-bit key and a
# 128-bit counter. Here the counter is (block, image low, image high, stream word); see streams.py for the keys.

_TILE = 16384.0  # expected events of the pixels that the fused line takes at a time


BATCH = 128  # exponentials that are made at a time: long enough to fill the SIMD unit, short enough for a dim image

_M0, _M1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_W0, _W1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_MASK = np.uint64(0xFFFFFFFF)
_32 = np.uint64(32)
_12 = np.uint64(12)
_20 = np.uint64(20)
_ONE_BITS = np.uint64(0x3FF0000000000000)
_SQRT_HALF_SHIFT = np.uint64(0x3FF0000000000000 - 0x3FE6A09E00000000)
_SQRT_HALF_BITS = np.uint64(0x3FE6A09E00000000)
_MANTISSA = np.uint64(0x000FFFFFFFFFFFFF)
_MAGIC_BITS = np.uint64(0x4330000000000000)  # 2^52: adding it leaves an integer in the low bits of the mantissa
_MAGIC = 4503599627370496.0
_EIGHT_TO_BYTE = np.uint64(0x8040201008040201)


@_inline
def _philox(block, image, key0, key1, word):
    """Two 64-bit random words for the counter (block, image, word) under the key."""
    c0 = np.uint64(block) & _MASK
    c1 = np.uint64(image) & _MASK
    c2 = np.uint64(image) >> _32
    c3 = np.uint64(word)
    k0 = np.uint64(key0)
    k1 = np.uint64(key1)
    for _ in range(10):
        p0 = _M0 * c0
        p1 = _M1 * c2
        c0, c1, c2, c3 = (p1 >> _32) ^ c1 ^ k0, p1 & _MASK, (p0 >> _32) ^ c3 ^ k1, p0 & _MASK
        k0 = (k0 + _W0) & _MASK
        k1 = (k1 + _W1) & _MASK
    return (c0 << _32) | c1, (c2 << _32) | c3


@_inline
def _log(x):
    """Natural logarithm of a positive, normal double; error below 1 ulp (the algorithm of fdlibm's e_log.c).

    The integer exponent becomes a double by way of 2^52, since SIMD units before AVX-512 cannot convert it.
    """
    ix = _bits(x) + _SQRT_HALF_SHIFT
    k = _double((ix >> np.uint64(52)) | _MAGIC_BITS) - (_MAGIC + 1023.0)
    f = _double((ix & _MANTISSA) + _SQRT_HALF_BITS) - 1.0
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    t1 = w * (3.999999999940941908e-01 + w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01))
    t2 = z * (
        6.666666666666735130e-01
        + w * (2.857142874366239149e-01 + w * (1.818357216161805012e-01 + w * 1.479819860511658591e-01))
    )
    r = t2 + t1
    half_square = 0.5 * f * f
    return k * 6.93147180369123816490e-01 - (
        (half_square - (s * (half_square + r) + k * 1.90821492927058770002e-10)) - f
    )


@_inline
def _uniform(word):
    """A number from (0, 1) from 64 random bits: an odd multiple of 2^-53, so neither 0 nor 1."""
    return _double((word >> _12) | _ONE_BITS) - (1.0 - 1.1102230246251565e-16)


@_inline
def _exponential(word):
    """A standard exponential from 64 random bits; never 0 and never infinite."""
    return -_log(_uniform(word))


# for effects with a kernel of their own
jit, inline = _jit, _inline
philox, uniform, exponential = _philox, _uniform, _exponential


@_jit
def _exponentials(block, image, key0, key1, word, out):
    """Fill `out[:BATCH]` with the exponentials of the blocks from `block` on; `out[BATCH]` becomes +inf, a stop."""
    half = BATCH // 2
    # two loops, each short enough to keep its numbers in the registers of the SIMD unit
    for i in range(half):
        a, b = _philox(np.uint64(block) + np.uint64(i), image, key0, key1, word)
        out[i] = _uniform(a)
        out[half + i] = _uniform(b)
    for i in range(BATCH):
        out[i] = -_log(out[i])
    out[BATCH] = np.inf


@_inline
def _running_sums(draws, sums):
    """The sums of a batch's first 1, 2, ... draws, never descending; +inf behind them, a stop for two vectors.

    By fours, so that not every addition waits for the one before.
    """
    total = 0.0
    for i in range(BATCH // 4):
        two = draws[4 * i] + draws[4 * i + 1]
        third = draws[4 * i + 2]
        four = two + (third + draws[4 * i + 3])
        sums[4 * i] = total + draws[4 * i]
        sums[4 * i + 1] = total + two
        sums[4 * i + 2] = total + (two + third)
        total += four
        sums[4 * i + 3] = total
    sums[BATCH:] = np.inf


@_jit
def exponentials(count, image, key):
    """The first `count` standard exponentials of a stream (float64), as the arrivals of an image use them."""
    out = np.empty(count)
    buffer = np.empty(BATCH + 1)
    block = 0
    for start in range(0, count, BATCH):
        _exponentials(block, image, key[0], key[1], key[2], buffer)
        stop = min(count, start + BATCH)
        out[start:stop] = buffer[: stop - start]
        block += BATCH // 2
    return out


@_jit
def logarithm(x):
    """Natural logarithm of an array of positive doubles: the same bits on every machine."""
    out = np.empty(x.size)
    for i in range(x.size):
        out[i] = _log(x[i])
    return out


# --- arrivals and afterpulses -------------------------------------------------------------------------------------


@_inline
def _child_draws(block, drawn_from, drawn, image, key0, key1, word):
    """A block's (distance, delay) out of a batch, which is drawn where the block is not in it, and its first block.

    The same numbers as drawn one by one, but made by the SIMD unit.
    """
    if np.uint64(block) - np.uint64(drawn_from) >= np.uint64(BATCH // 2):
        _exponentials(block, image, key0, key1, word, drawn)
        drawn_from = block
    place = np.uint64(block) - np.uint64(drawn_from)
    return drawn[place], drawn[place + np.uint64(BATCH // 2)], drawn_from


@_inline
def _row_parents(count, hazard, left, block, drawn_from, drawn, image, key0, key1, word, parents, delays, found):
    """Which of a row's `count` events have a child.

    Each has one with probability 1 - exp(-hazard), independently. Instead of a draw for each event, a unit-rate
    Poisson process runs along the row and on into the next ones; `left` is the distance to its next point. This is
    exact: an event is hit where a point falls into its stretch of length `hazard`, and the process starts afresh
    behind it. Block k of the stream gives the k-th distance and the k-th child's delay (in units of its mean).

    Fills `parents` (indices within the row) and `delays` from `found` on. Returns (left, block, drawn_from, found).
    """
    first = 0
    while first < count:
        stretch = (count - first) * hazard
        if left >= stretch:
            left -= stretch
            break
        index = min(first + int(left / hazard), count - 1)
        parents[found] = index
        _, delays[found], drawn_from = _child_draws(block, drawn_from, drawn, image, key0, key1, word)
        found += 1
        first = index + 1
        block += np.uint64(1)
        left, _, drawn_from = _child_draws(block, drawn_from, drawn, image, key0, key1, word)
    return left, block, drawn_from, found


@_jit
def _begin_image(image, key, child_key, buffer, places, distances):
    """Where the draws of an image start.

    places: (block, the next event's draw in it, child block); distances: to the next event, child.
    """
    _exponentials(np.uint64(0), image, key[0], key[1], key[2], buffer)
    places[0] = 0
    places[1] = 0
    places[2] = 0
    distances[0] = buffer[0]
    a, _ = _philox(np.uint64(0), image, child_key[0], child_key[1], child_key[2])
    distances[1] = _exponential(a)


@_jit
def _candidates(
    rates,
    exposure,
    image,
    key,
    hazards,
    lifetime,
    dead_times,
    child_key,
    times,
    offsets,
    buffer,
    places,
    distances,
    parents,
    delays,
):
    """Draw the next pixels of an image: a Poisson process in each, with its afterpulses among them.

    One unit-rate Poisson process runs along the image, pixel after pixel, each pixel being `rate * exposure` long:
    one exponential an event and none for an empty pixel. The distance is counted from each pixel's own start, so
    that no precision is lost in a large image. Within a pixel an event's place is a difference of the batch's running
    sums, which is exact to 2^-46 of the mean distance: no event waits for the one before to be known.

    Afterpulses (paper, Alg. 1, lines 14-18): each event has one with probability 1 - exp(-hazard), at dead time +
    lifetime * Exp(1) after it; what would fall at or after the exposure's end does not exist.

    Fills `times` and `offsets[:pixels + 1]`; `parents` and `delays` are room for one row's children. Returns the
    number of events, or -1 where they do not fit: the caller makes room and draws these pixels again, which gives
    the same events, since a draw is a function of its place alone. `buffer`, `places` and `distances` hold where the
    draws stand (see `_begin_image`) and are moved on.
    """
    last_moment = np.nextafter(exposure, 0.0)
    if times.size < 2 * BATCH:
        return -1
    room = np.int64(times.size) - BATCH - 33
    child_room = np.int64(parents.size)
    block = places[0]
    draw = places[1]
    child_block = places[2]
    child_draws = np.empty(BATCH + 1)
    drawn_from = child_block - np.uint64(BATCH)  # none are drawn yet
    position = distances[0]
    left = distances[1]
    sums = np.empty(BATCH + 32)
    _running_sums(buffer, sums)
    k = np.uint64(0)
    offsets[0] = 0
    for pixel in range(np.uint64(rates.size)):
        rate = rates[pixel]
        length = rate * exposure
        if position < length:
            start = k
            period = 1.0 / rate
            while position < length:
                # this event and those behind it that lie before the pixel's end, as far as the batch goes
                shift = position - sums[draw]
                stop = draw + np.uint64(1)
                while sums[stop + np.uint64(16)] + shift < length:
                    stop += np.uint64(16)
                more = np.uint64(0)
                for i in range(np.uint64(16)):
                    more += np.uint64(sums[stop + i] + shift < length)
                stop += more
                # in whole vectors: what is too much will be overwritten
                for i in range((stop - draw + np.uint64(31)) & ~np.uint64(31)):
                    # rounding must not push an event to the very end, which does not belong to the exposure
                    times[k + i] = min((sums[draw + i] + shift) * period, last_moment)
                k += stop - draw
                draw = stop
                if draw < BATCH:
                    position = sums[draw] + shift
                    break
                # between two of these at most BATCH events are written, and less than 32 too many
                if np.int64(k) > room:
                    return -1
                position = sums[BATCH - 1] + shift
                block += np.uint64(BATCH // 2)
                _exponentials(block, image, key[0], key[1], key[2], buffer)
                _running_sums(buffer, sums)
                position += sums[0]
                draw = np.uint64(0)
            hazard = hazards[pixel]
            if hazard > 0.0:
                count = np.int64(k - start)
                stretch = count * hazard
                if left >= stretch:
                    left -= stretch
                else:
                    if count > child_room or np.int64(k) + count > room:
                        return -1
                    left, child_block, drawn_from, found = _row_parents(
                        count,
                        hazard,
                        left,
                        child_block,
                        drawn_from,
                        child_draws,
                        image,
                        child_key[0],
                        child_key[1],
                        child_key[2],
                        parents,
                        delays,
                        0,
                    )
                    # the children stand apart until all are known, for their parents' places must stay
                    for child in range(found):
                        parent = start + np.uint64(parents[child])
                        delays[child] = times[parent] + (dead_times[pixel] + lifetime * delays[child])
                    for child in range(found):
                        time = delays[child]
                        if time < exposure:
                            place = start + np.uint64(parents[child]) + np.uint64(1)
                            while place < k and times[place] <= time:
                                place += np.uint64(1)
                            for later in range(k - place):
                                times[k - later] = times[k - later - np.uint64(1)]
                            times[place] = time
                            k += np.uint64(1)
        position -= length
        offsets[pixel + np.uint64(1)] = k
    places[0] = block
    places[1] = draw
    places[2] = child_block
    distances[0] = position
    distances[1] = left
    return np.int64(k)


@_jit
def _expected(rates, exposure):
    total = 0.0
    for p in range(rates.size):
        total += rates[p]
    return total * exposure


@_inline
def _room(expected):
    """Entries that nearly always suffice for so many expected events (what does not fit is drawn again)."""
    return int(1.02 * expected + 8.0 * np.sqrt(expected)) + 2 * BATCH + 64


@_jit
def arrivals(rates, exposure, images, key, place):
    """A Poisson process in every row.

    rates: (images, pixels) 1/s; images: (images,) uint64, the numbers that key the draws; key: (3,) uint64; place:
    (images, 3) where the draws of each image stand (`streams.beginning`), which is moved on: of an image whose pixels
    are drawn in several calls, with a rate of 0 in those of the other calls, the events are those of one call.
    Returns (times (events,) s, offsets (images * pixels + 1,) int64).
    """
    n, pixels = rates.shape
    times = np.empty(_room(_expected(rates.ravel(), exposure)))
    offsets = np.zeros(n * pixels + 1, np.int64)
    buffer = np.empty(BATCH + 1)
    places = np.empty(3, np.uint64)
    distances = np.empty(2)
    none = np.zeros(pixels)
    parents = np.empty(1, np.int64)
    delays = np.empty(1)
    used = 0
    for i in range(n):
        row = i * pixels
        count = -1
        while count < 0:
            _begin_image(images[i], key, key, buffer, places, distances)
            if place[i, 0] >= 0.0:
                places[0] = np.uint64(place[i, 0])
                places[1] = np.uint64(place[i, 1])
                distances[0] = place[i, 2]
                _exponentials(places[0], images[i], key[0], key[1], key[2], buffer)
            count = _candidates(
                rates[i],
                exposure,
                images[i],
                key,
                none,
                0.0,
                none,
                key,
                times[used:],
                offsets[row:],
                buffer,
                places,
                distances,
                parents,
                delays,
            )
            if count < 0:
                times = _grown(times, used, 2 * times.size)
        place[i, 0] = places[0]
        place[i, 1] = places[1]
        place[i, 2] = distances[0]
        for p in range(pixels + 1):
            offsets[row + p] += used
        used += count
    return times[:used], offsets


@_jit
def _grown(array, used, needed):
    """`array`, or a larger copy of its first `used` entries where `needed` do not fit."""
    if needed <= array.size:
        return array
    larger = np.empty(max(needed, 2 * array.size), array.dtype)
    larger[:used] = array[:used]
    return larger


@_jit
def children(offsets, hazards, images, key, place):
    """Which events have a child: each one with probability 1 - exp(-hazard of its pixel).

    offsets: (images * pixels + 1,); hazards: (pixels,); place: (images, 3) where the draws of each image stand, as in
    `arrivals`. Returns (parent (children,) int64, index of the event; delay (children,) in units of its mean), in the
    order of the parents.
    """
    pixels = hazards.size
    parents = np.empty(256, np.int64)
    delays = np.empty(256)
    drawn = np.empty(BATCH + 1)
    found = 0
    for i in range(images.size):
        block = np.uint64(0)
        a, _ = _philox(block, images[i], key[0], key[1], key[2])
        left = _exponential(a)
        if place[i, 0] >= 0.0:
            block = np.uint64(place[i, 0])
            left = place[i, 1]
        drawn_from = block - np.uint64(BATCH)  # none are drawn yet
        for p in range(pixels):
            row = i * pixels + p
            count = offsets[row + 1] - offsets[row]
            stretch = count * hazards[p]
            if hazards[p] > 0.0 and count > 0:
                if left >= stretch:
                    left -= stretch
                    continue
                parents = _grown(parents, found, found + count)
                delays = _grown(delays, found, found + count)
                before = found
                left, block, drawn_from, found = _row_parents(
                    count,
                    hazards[p],
                    left,
                    block,
                    drawn_from,
                    drawn,
                    images[i],
                    key[0],
                    key[1],
                    key[2],
                    parents,
                    delays,
                    found,
                )
                for child in range(before, found):
                    parents[child] += offsets[row]
        place[i, 0] = block
        place[i, 1] = left
    return parents[:found].copy(), delays[:found].copy()


@_jit
def uniforms(events, image_offsets, images, key, before):
    """A number from (0, 1) for each of some events; it depends on the event's place in its image alone.

    events: ascending indices; image_offsets: (images + 1,); before: events of the image that come before these.
    Returns float64 of the size of `events`.
    """
    out = np.empty(events.size)
    i = 0
    for k in range(events.size):
        while events[k] >= image_offsets[i + 1]:
            i += 1
        a, _ = _philox(np.uint64(before + events[k] - image_offsets[i]), images[i], key[0], key[1], key[2])
        out[k] = _uniform(a)
    return out


@_jit
def weigh(total, offsets, rates, factor):
    """Add to each event's `total` the rate of its row times its factor (an empty `factor`: 1)."""
    for row in range(offsets.size - 1):
        rate = rates[row]
        if rate != 0.0:
            if factor.size:
                for i in range(offsets[row], offsets[row + 1]):
                    total[i] += rate * factor[i]
            else:
                for i in range(offsets[row], offsets[row + 1]):
                    total[i] += rate


@_jit
def thinned(rates, offsets, drawn, image_offsets, images, key, before):
    """Which events remain of a Poisson process that was drawn at too high a rate.

    rates: (events,) 1/s, what the rate is at each; drawn: (rows,) 1/s; before: events of the image that come before
    these. Returns (events,) bool.
    """
    kept = np.empty(rates.size, np.bool_)
    pixels = (offsets.size - 1) // max(1, images.size)
    for row in range(offsets.size - 1):
        image = row // pixels
        begin = image_offsets[image] - before
        for i in range(offsets[row], offsets[row + 1]):
            a, _ = _philox(np.uint64(i - begin), images[image], key[0], key[1], key[2])
            kept[i] = _uniform(a) * drawn[row] < rates[i]
    return kept


@_jit
def row_totals(values, offsets):
    """Sum of each row's entries, as float64; that of integers is exact."""
    out = np.zeros(offsets.size - 1)
    for row in range(offsets.size - 1):
        if offsets[row + 1] > offsets[row]:
            total = values[offsets[row]]
            for i in range(offsets[row] + 1, offsets[row + 1]):
                total += values[i]
            out[row] = total
    return out


_FEW_IN_ROW = 64  # up to so many are put in order one by one


@_jit
def row_order(times, rows, count):
    """How to bring events into order: by their rows, by their times within these; what is equal stays in its order.

    rows: (events,) int64, of which there are `count`. Returns (order (events,) int64, offsets (count + 1,) int64).
    """
    offsets = np.zeros(count + 1, np.int64)
    for i in range(rows.size):
        offsets[rows[i] + 1] += 1
    for row in range(count):
        offsets[row + 1] += offsets[row]
    place = offsets[:-1].copy()
    order = np.empty(rows.size, np.int64)
    for i in range(rows.size):
        order[place[rows[i]]] = i
        place[rows[i]] += 1
    for row in range(count):
        begin, end = offsets[row], offsets[row + 1]
        if end - begin > _FEW_IN_ROW:
            some = order[begin:end].copy()
            order[begin:end] = some[np.argsort(times[some], kind="mergesort")]
            continue
        for k in range(begin + 1, end):
            i = order[k]
            at = k
            while at > begin and times[order[at - 1]] > times[i]:
                order[at] = order[at - 1]
                at -= 1
            order[at] = i
    return order, offsets


@_jit
def merge(times, offsets, extra, extra_rows):
    """Sort a few further events into their rows.

    extra: (m,) s, ascending within a row; extra_rows: (m,) int64, ascending. What is equally late comes behind.
    Returns (times, offsets, before): `before` (m,) is how many of `times` stand before each of `extra`, so that
    extra[j] is now at before[j] + j.
    """
    merged = np.empty(times.size + extra.size)
    before = np.empty(extra.size, np.int64)
    done = 0
    for j in range(extra.size):
        # the first event of the row that is later
        low = max(offsets[extra_rows[j]], done)
        high = offsets[extra_rows[j] + 1]
        while low < high:
            middle = (low + high) // 2
            if times[middle] <= extra[j]:
                low = middle + 1
            else:
                high = middle
        for i in range(done, low):
            merged[i + j] = times[i]
        merged[low + j] = extra[j]
        before[j] = low
        done = low
    for i in range(done, times.size):
        merged[i + extra.size] = times[i]
    new_offsets = offsets.copy()
    j = 0
    for row in range(offsets.size - 1):
        while j < extra.size and extra_rows[j] == row:
            j += 1
        new_offsets[row + 1] += j
    return merged, new_offsets, before


@_jit
def relinked(known, before, order, parents):
    """Where the parents of merged children stand.

    known: how many events there were; before: of `merge`; order: (m,) which child each of the merged `extra` was;
    parents: (m,) of each child, i for the event i, known + c for the child c.
    Returns (events,) int64: the parent's place among the merged events, -1 where there is none.
    """
    place = np.empty(order.size, np.int64)
    for j in range(order.size):
        place[order[j]] = before[j] + j
    out = np.full(known + order.size, -1, np.int64)
    for child in range(order.size):
        parent = parents[child]
        if parent < known:
            out[place[child]] = parent + np.searchsorted(before, parent, side="right")
        else:
            out[place[child]] = place[parent - known]
    return out


@_jit
def kept(values, mask):
    """`values[mask]`, without a branch on what is hard to foresee."""
    count = 0
    for i in range(mask.size):
        count += np.int64(mask[i])
    out = np.empty(count + 1, values.dtype)  # one more, which what is not kept may overwrite
    k = np.uint64(0)
    for i in range(np.uint64(mask.size)):
        out[k] = values[i]
        k += np.uint64(mask[i])
    return out[:count]


@_jit
def longest_gap(stamps, start, end, bins, at_once):
    """(longest gap between neighbouring stamps that are not before `start`, start and end taken as stamps; number of
    stamps before `end`; whether a longer one may be hidden within one of the bins).

    Stamps may stand in any order. Two stamps in the same bin are less than a bin apart, so only the gaps between bins
    need to be looked at, `at_once` bins at a time.
    """
    low = np.empty(min(bins, at_once))
    high = np.empty(low.size)
    factor = bins / (end - start)
    count = 0
    longest = 0.0
    last = start
    for begin in range(0, bins, low.size):
        low[:] = np.inf
        high[:] = -np.inf
        count = 0
        for i in range(stamps.size):
            t = np.float64(stamps[i])
            if t < end:
                count += 1
                b = min(np.int64((t - start) * factor), bins - 1) - begin
                if 0 <= b < low.size:
                    low[b] = min(low[b], t)
                    high[b] = max(high[b], t)
        for b in range(low.size):
            if high[b] >= start:
                longest = max(longest, low[b] - last)
                last = high[b]
    longest = max(longest, end - last)
    return longest, count, longest < (end - start) / bins


@_jit
def rows_upto(stamps, offsets, place, stop):
    """(rows,) where each row's stamps from `place` (rows,) on reach `stop`; stamps ascend within a row."""
    out = np.empty(place.size, np.int64)
    for row in range(place.size):
        low = place[row]
        high = offsets[row + 1]
        while low < high:
            middle = (low + high) // 2
            if stamps[middle] < stop:
                low = middle + 1
            else:
                high = middle
        out[row] = low
    return out


@_jit
def between(stamps, first, last, count):
    """(count,) the stamps of all rows from `first` to `last`, both (rows,), row after row."""
    out = np.empty(count, stamps.dtype)
    k = 0
    for row in range(first.size):
        for i in range(first[row], last[row]):
            out[k] = stamps[i]
            k += 1
    return out


@_jit
def kept_offsets(mask, offsets):
    """The offsets of the rows when only the events remain for which `mask` is true."""
    new = np.zeros_like(offsets)
    k = 0
    for row in range(offsets.size - 1):
        for i in range(offsets[row], offsets[row + 1]):
            k += np.int64(mask[i])
        new[row + 1] = k
    return new


@_jit
def sort_rows(times, offsets, last_moment, order):
    """Bring nearly ordered times into order within their rows, each first put into [0, last_moment].

    `order` (events,) int64, or of size 0 where it is not wanted, is filled with where each of them came from.
    Returns the ordered times (float64); equal ones stay in their order.
    """
    out = np.empty(times.size)
    for row in range(offsets.size - 1):
        start = offsets[row]
        for i in range(start, offsets[row + 1]):
            time = min(max(times[i], 0.0), last_moment)
            place = i
            while place > start and out[place - 1] > time:
                out[place] = out[place - 1]
                if order.size:
                    order[place] = order[place - 1]
                place -= 1
            out[place] = time
            if order.size:
                order[place] = i
    return out


# --- the pixel's memory -------------------------------------------------------------------------------------------


@_inline
def _record(times, stamps, start, stop, dead_time, out, used):
    """Append the stamps of a row's events that are more than the dead time after the last one appended.

    Non-paralyzable (paper, lines 24-29): what is not recorded hides nothing.
    """
    last = -np.inf
    for i in range(np.uint64(start), np.uint64(stop)):
        time = times[i]
        if time - last > dead_time:
            out[used] = stamps[i]
            used += np.uint64(1)
            last = time
    return used


@_jit
def non_paralyzable(times, offsets, dead_times):
    """Remove what a non-paralyzable dead time hides. dead_times: (pixels,) s. Returns the kept indices (int64)."""
    pixels = dead_times.size
    indices = np.arange(times.size)
    kept = np.empty(times.size, np.int64)
    k = np.uint64(0)
    for row in range(offsets.size - 1):
        k = _record(times, indices, offsets[row], offsets[row + 1], dead_times[row % pixels], kept, k)
    return kept[: np.int64(k)].copy()


@_jit
def take(offsets, kept):
    """The offsets of the rows when only the events `kept` (ascending indices) remain."""
    new = np.zeros_like(offsets)
    k = 0
    for row in range(offsets.size - 1):
        while k < kept.size and kept[k] < offsets[row + 1]:
            k += 1
        new[row + 1] = k
    return new


@_jit
def followers(times, offsets, within):
    """The events (indices) that come at most `within` (pixels,) s after the one before them in their row."""
    out = np.empty(256, np.int64)
    found = 0
    pixels = within.size
    for row in range(offsets.size - 1):
        limit = within[row % pixels]
        for i in range(offsets[row] + 1, offsets[row + 1]):
            if times[i] - times[i - 1] <= limit:
                out = _grown(out, found, found + 1)
                out[found] = i
                found += 1
    return out[:found].copy()


_OPEN, _LOST, _FIRED = np.uint8(0), np.uint8(1), np.uint8(2)  # what is known of a candidate


@_jit
def _fire_until(times, parents, i, goal, state, blind, needed, extends, asleep, before):
    """Decide a row's candidates from `i` to `goal` (TR), up to the first whose parent is not decided yet.

    before: when the pixel's blindness began. Returns (where it stopped, before).
    """
    i = np.uint64(i)
    goal = np.uint64(goal)
    while i < goal:
        if asleep.size and asleep[i]:
            state[i] = _LOST
            i += np.uint64(1)
            continue
        if parents.size:
            parent = parents[i]
            if parent >= 0:
                cause = state[parent]
                if cause == _OPEN:
                    break
                if cause == _LOST:
                    state[i] = _LOST
                    i += np.uint64(1)
                    continue
        time = times[i]
        since = time - before
        fires = since > blind
        if fires and needed.size:
            fires = since - blind >= needed[i]
        state[i] = _FIRED if fires else _LOST
        if fires or (extends and since <= blind):
            before = time
        i += np.uint64(1)
    return np.int64(i), before


@_jit
def _fire_in_frames(times, parents, i, goal, state, blind, frame_period, frame_time, carried, before, awake):
    """As `_fire_until` for frames: the pixel fires once in each. before: the frame in which it fired last; awake:
    when it is live again. Returns (where it stopped, before, awake).
    """
    i = np.uint64(i)
    goal = np.uint64(goal)
    while i < goal:
        if parents.size:
            parent = parents[i]
            if parent >= 0:
                cause = state[parent]
                if cause == _OPEN:
                    break
                if cause == _LOST:
                    state[i] = _LOST
                    i += np.uint64(1)
                    continue
        time = times[i]
        frame, since = _frame_of(time, frame_period)
        fires = (frame != before) & (since < frame_time) & (time >= awake)
        state[i] = _FIRED if fires else _LOST
        if fires:
            before = frame
            if carried > 0.0:
                start = (frame + 1.0) * frame_period
                awake = start + carried * max(0.0, time + blind - start)
        i += np.uint64(1)
    return np.int64(i), before, awake


@_jit
def avalanches(times, offsets, parents, blind, needed, extends, frame_period, frame_time, carried, asleep):
    """What fires: an event whose parent fired, or that has none, and that does not find its pixel blind.

    times, offsets: candidates, in order within a row; of equally late ones a parent stands before its child.
    parents: (events,) index of the candidate that causes each, not later than it, -1: none (empty: none has one).
    blind: (pixels,) s after a detection; needed: (events,) s that the pixel must have been awake again for this one
    (empty: none needs any). extends: what finds its pixel blind makes it blind anew (paralyzable).
    With `frame_period` > 0 a pixel fires at most once in a frame, the rest of which it is blind, and nothing fires
    between frames; into the next frame it carries a share `carried` of what is left of its blind time. Otherwise
    asleep: (events,) bool, those that find the pixel switched off, and leave no trace (empty: none does).

    A row is gone through in time order. Where a parent lies in another row that is not that far yet, that row comes
    first, up to the parent; since causes come before their effects, this ends.
    Returns (events,) bool.
    """
    rows = offsets.size - 1
    pixels = blind.size
    state = np.zeros(times.size, np.uint8)
    reached = offsets[:-1].copy()
    last = np.full(rows, -np.inf)
    awake = np.full(rows, -np.inf)
    waiting = np.empty(64, np.int64)
    goals = np.empty(64, np.int64)
    for first in range(rows):
        waiting[0] = first
        goals[0] = offsets[first + 1]
        depth = 1
        while depth > 0:
            row = waiting[depth - 1]
            goal = goals[depth - 1]
            i = reached[row]
            dead = blind[row % pixels]
            if frame_period > 0.0:
                i, last[row], awake[row] = _fire_in_frames(
                    times, parents, i, goal, state, dead, frame_period, frame_time, carried, last[row], awake[row]
                )
            else:
                i, last[row] = _fire_until(times, parents, i, goal, state, dead, needed, extends, asleep, last[row])
            reached[row] = i
            depth -= 1
            if i < goal:
                waiting = _grown(waiting, depth + 1, depth + 2)
                goals = _grown(goals, depth + 1, depth + 2)
                waiting[depth + 1] = np.searchsorted(offsets, parents[i], side="right") - 1
                goals[depth + 1] = parents[i] + 1
                depth += 2
    return state == _FIRED


# --- clocks and frames --------------------------------------------------------------------------------------------


@_inline
def _nearest(x):
    """The integer nearest to 0 <= x < 2^52, as uint64 (ties to even)."""
    return _bits(x + _MAGIC) & _MANTISSA


@_inline
def _frame_of(time, frame_period):
    """(frame, seconds since its start) of a moment; the number of the frame is a double."""
    frame = np.floor(time / frame_period)
    since = time - frame * frame_period
    if since < 0.0:
        since = 0.0
    return frame, since


@_jit
def nearest_ticks(times, tick, out):
    """Round to the nearest multiple of the tick (paper, lines 30-32). `out` is unsigned and of the size of `times`."""
    for i in range(times.size):
        out[i] = _nearest(times[i] / tick)


@_inline
def _row_frames(frame, first, start, stop, between, marks, eights, bits, row, out, used):
    """One row's frames from the frame number (from 1 on; 0: in none) and the stamp of each of its events.

    Sets the row's bits (most significant first) and appends the first stamp of each frame that has an event.
    Without a branch on 'is it the first of its frame', which is a coin toss at bright light: what is not the first
    is overwritten by the next, and a frame's mark is set by each of its events. `between`: some event of these rows
    is in no frame; `marks`: see `_no_marks`. Returns (sum of the appended stamps, used).
    """
    if between:
        for i in range(np.uint64(start) + np.uint64(1), np.uint64(stop)):
            frame[i] = max(frame[i], frame[i - np.uint64(1)])
    waited = first[start] - first[start]  # zero of the stamps' own type: the sum of integer ticks is exact
    last = np.uint64(0)
    for i in range(np.uint64(start), np.uint64(stop)):
        f = np.uint64(frame[i])
        stamp = first[i]
        new = np.uint64(f != last)
        out[used] = stamp
        marks[f + np.uint64(7)] = 1
        used += new
        waited += stamp * new
        last = f
    for byte in range(np.uint64(bits.shape[1])):
        # the product's upper byte is made of the eight marks
        bits[row, byte] = (eights[byte + np.uint64(1)] * _EIGHT_TO_BYTE) >> np.uint64(56)
        eights[byte + np.uint64(1)] = 0
    return waited, used


@_inline
def _no_marks(bits):
    """Room for a row's marks, by eights and each: a byte for each frame, from index 8 on; before is for no frame."""
    eights = np.zeros(bits.shape[1] + 1, np.uint64)
    return eights, eights.view(np.uint8)


@_jit
def frame_readout(times, offsets, frames, frame_time, frame_period, out):
    """Bin events into frames: bits, and the first moment (s since its start) of every frame that has an event.

    `out` has room for one more than there are events.
    Returns (bits (rows, ceil(frames / 8)) uint8, offsets of the moments (rows + 1,)).
    """
    rows = offsets.size - 1
    bits = np.zeros((rows, (frames + 7) // 8), np.uint8)
    first_offsets = np.zeros(rows + 1, np.int64)
    longest = 1
    for row in range(rows):
        longest = max(longest, offsets[row + 1] - offsets[row])
    frame = np.empty(longest, np.uint32)
    first = np.empty(longest)
    eights, marks = _no_marks(bits)
    used = np.uint64(0)
    for row in range(rows):
        start = offsets[row]
        count = offsets[row + 1] - start
        if count:
            between = _stamps(times, start, count, frames, frame_time, frame_period, 0.0, 0, frame, first)
            _, used = _row_frames(frame, first, 0, count, between, marks, eights, bits, row, out, used)
        first_offsets[row + 1] = used
    return bits, first_offsets


@_jit
def counts_in_frames(times, offsets, frame_time, frame_period, largest, out):
    """How many events of each row fall into each frame, at most `largest`: out (rows, frames), zeros before."""
    for row in range(offsets.size - 1):
        for i in range(offsets[row], offsets[row + 1]):
            frame, since = _frame_of(times[i], frame_period)
            if since < frame_time and frame < out.shape[1] and out[row, np.int64(frame)] < largest:
                out[row, np.int64(frame)] += 1


@_jit
def first_of_frames(times, offsets, frames, frame_time, frame_period):
    """Which events (events,) bool are the first of their row in a frame; the others `frame_readout` leaves out."""
    kept = np.zeros(times.size, np.bool_)
    for row in range(offsets.size - 1):
        last = -1.0
        for i in range(offsets[row], offsets[row + 1]):
            frame, since = _frame_of(times[i], frame_period)
            if frame > last and since < frame_time and frame < frames:
                kept[i] = True
                last = frame
    return kept


@_inline
def _waited(stamps, ones, frames, frame_time, tick):
    if tick > 0.0:
        return stamps * tick + (frames - ones) * frame_time
    return stamps + (frames - ones) * frame_time


@_jit
def _stamps(times, start, count, frames, frame_time, frame_period, tick, none, frame, first):
    """Frame number (from 1 on; 0: between frames) and stamp of `count` events from `start` on.

    Returns whether any of them is between frames.
    """
    last_frame = np.float64(frames)
    between = np.uint64(0)
    if tick > 0.0:
        most = np.float64(none - 1)
        for i in range(np.uint64(count)):
            f, since = _frame_of(times[np.uint64(start) + i], frame_period)
            # the very last moment may round up to a frame that does not exist
            inside = (since < frame_time) & (f < last_frame)
            frame[i] = _nearest(f + 1.0 if inside else 0.0)
            between |= np.uint64(not inside)
            first[i] = _nearest(min(since / tick, most))
    else:
        for i in range(np.uint64(count)):
            f, since = _frame_of(times[np.uint64(start) + i], frame_period)
            inside = (since < frame_time) & (f < last_frame)
            frame[i] = _nearest(f + 1.0 if inside else 0.0)
            between |= np.uint64(not inside)
            first[i] = since
    return between > 0


# --- the paper's line, image by image -----------------------------------------------------------------------------


@_jit
def paper_line(
    rates,
    exposure,
    images,
    key,
    hazards,
    lifetime,
    child_key,
    dead_times,
    tick,
    frames,
    frame_time,
    frame_period,
    none,
    want_tr,
    want_frames,
    want_stamps,
    ticks,
    firsts,
):
    """Detection to readout under `rules: paper`, for a sensor with nothing but afterpulsing, dead time and a TDC.

    The same per-image functions as the staged line, run one image at a time in buffers that stay in the cache.
    `ticks` and `firsts` are empty arrays that give the types of the stamps. want_stamps: of the frames too (STR).

    Returns (ticks, offsets, counts (rows,) int32, span (rows,) s from the first to the last stamp,
    bits, firsts, first offsets, ones, waited): as `non_paralyzable` + `nearest_ticks` and `frame_readout` give them.
    """
    n, pixels = rates.shape
    rows = n * pixels
    offsets = np.zeros(rows + 1, np.int64)
    first_offsets = np.zeros(rows + 1, np.int64)
    counts = np.zeros(rows, np.int32)
    span = np.zeros(rows)
    ones = np.zeros(rows if want_frames else 0, np.int32)
    waited = np.empty(rows if want_frames else 0)
    bits = np.zeros((rows if want_frames else 0, (frames + 7) // 8), np.uint8)

    everything = _room(_expected(rates.ravel(), exposure))
    if want_tr:
        ticks = np.empty(everything, ticks.dtype)
    if want_stamps:
        firsts = np.empty(everything, firsts.dtype)
    tile_offsets = np.empty(pixels + 1, np.int64)
    buffer = np.empty(BATCH + 1)
    places = np.empty(3, np.uint64)
    distances = np.empty(2)
    times = np.empty(1)
    frame = np.empty(1, np.uint32)
    eights, marks = _no_marks(bits)
    parents = np.empty(1, np.int64)
    delays = np.empty(1)
    used = 0
    first_used = 0
    for i in range(n):
        _begin_image(images[i], key, child_key, buffer, places, distances)
        begin = 0
        while begin < pixels:
            # as many pixels at a time as the cache holds events for
            expected = 0.0
            end = begin
            while end < pixels and (end == begin or expected < _TILE):
                expected += rates[i, end] * exposure
                end += 1
            row = i * pixels + begin
            room = _room(expected)
            buffer_before = buffer.copy()
            places_before = places.copy()
            distances_before = distances.copy()
            total = -1
            while total < 0:
                if times.size < room:
                    times = np.empty(room)
                    frame = np.empty(room, np.uint32)
                    parents = np.empty(room, np.int64)
                    delays = np.empty(room)
                total = _candidates(
                    rates[i, begin:end],
                    exposure,
                    images[i],
                    key,
                    hazards[begin:end],
                    lifetime,
                    dead_times[begin:end],
                    child_key,
                    times,
                    tile_offsets,
                    buffer,
                    places,
                    distances,
                    parents,
                    delays,
                )
                if total < 0:
                    buffer[:] = buffer_before
                    places[:] = places_before
                    distances[:] = distances_before
                    room = 2 * times.size
            tile = tile_offsets[: end - begin + 1]
            if want_tr:
                ticks = _grown(ticks, used, used + total)
                used = _tile_tr(times, tile, dead_times[begin:end], tick, ticks, used, row, offsets, counts, span)
            if want_frames:
                firsts = _grown(firsts, first_used, first_used + total + 1)
                # in place, too: the first stamps of frames move up over the others
                first = firsts[first_used:]
                between = _stamps(times, 0, total, frames, frame_time, frame_period, tick, none, frame, first)
                behind = _tile_frames(
                    frame,
                    first,
                    between,
                    marks,
                    eights,
                    tile,
                    row,
                    frames,
                    frame_time,
                    tick,
                    bits,
                    firsts,
                    first_used,
                    first_offsets,
                    ones,
                    waited,
                )
                if want_stamps:
                    first_used = behind
            begin = end
    return ticks[:used], offsets, counts, span, bits, firsts[:first_used], first_offsets, ones, waited


@_jit
def _tile_tr(times, tile_offsets, dead_times, tick, ticks, used, first_row, offsets, counts, span):
    """The TR readout of some pixels: stamps, then the dead time; appended to `ticks` from `used` on.

    Every event's stamp is put there first, and those that are recorded then move up: in place, for memory is slow.
    """
    stamps = ticks[used:]
    for i in range(np.uint64(tile_offsets[tile_offsets.size - 1])):
        stamps[i] = _nearest(times[i] / tick)
    k = np.uint64(used)
    start = tile_offsets[0]
    for p in range(np.uint64(dead_times.size)):
        row = np.uint64(first_row) + p
        stop = tile_offsets[p + np.uint64(1)]
        if stop > start:
            before = k
            k = _record(times, stamps, start, stop, dead_times[p], ticks, k)
            counts[row] = k - before
            span[row] = (ticks[k - np.uint64(1)] - ticks[before]) * tick
            start = stop
        offsets[row + np.uint64(1)] = k
    return np.int64(k)


@_jit
def _tile_frames(
    frame,
    first,
    between,
    marks,
    eights,
    tile_offsets,
    first_row,
    frames,
    frame_time,
    tick,
    bits,
    firsts,
    used,
    first_offsets,
    ones,
    waited,
):
    """The frames of some pixels, their stamps appended to `firsts` from `used` on."""
    empty = frames * frame_time
    used = np.uint64(used)
    start = tile_offsets[0]
    for p in range(np.uint64(tile_offsets.size - 1)):
        row = np.uint64(first_row) + p
        stop = tile_offsets[p + np.uint64(1)]
        if stop > start:
            before = used
            w, used = _row_frames(frame, first, start, stop, between, marks, eights, bits, row, firsts, used)
            ones[row] = used - before
            waited[row] = _waited(w, np.int64(used - before), frames, frame_time, tick)
            start = stop
        else:
            waited[row] = empty
        first_offsets[row + np.uint64(1)] = used
    return np.int64(used)
