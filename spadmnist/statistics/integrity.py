"""Whether the data are whole: frames that repeat, blank frames, stamps that cannot be, silence, full counters."""

# mypy: disable-error-code="no-untyped-def"
# numba takes the types from the calls; the docstrings give them.

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..events import longest_gap
from ..kernels import jit
from ..units import show
from . import Recording, Statistic, Summary
from ._counting import whole
from ._frames import as_words, bits, first_stamps, frame_sums, ones_of
from ._series import has_data, slots_of_frame, stamps

_SURE_CHANCE = 1e-9  # a repeated frame for which all chances of a capture together are less is no chance
_RARE_CHANCE = 1e-3  # one whose own chance is less is rare
_PLAIN = 30.0  # detections per pixel from which a pixel that has none is dead


@jit
def same_as_before(frames, before, first):
    """(frames,) bool: is a frame, or the part of it that was read, the same as the one before?

    frames: (frames, n) of any type; before: (n,) the frame before the first of them; first: there is none.
    """
    count, n = frames.shape
    out = np.zeros(count, np.bool_)
    for f in range(count):
        if f == 0 and first:
            continue
        same = True
        for i in range(n):
            if frames[f, i] != (frames[f - 1, i] if f else before[i]):
                same = False
                break
        out[f] = same
    return out


@jit
def chance_of_bits(frame, likely, log_best, loss, least):
    """Logarithm of the chance of one frame of bits, or anything below `least`.

    frame, likely: (bytes,) uint8, the frame and the most likely one; log_best: the logarithm of that one's chance;
    loss: (8 bytes,) what each bit takes from it that is not as in the likely frame.
    """
    chance = log_best
    for i in range(frame.size):
        different = frame[i] ^ likely[i]
        if different:
            for bit in range(8):
                if (different >> (7 - bit)) & 1:
                    chance -= loss[8 * i + bit]
            if chance < least:
                break
    return chance


@jit
def same_stamps(offsets, stamps, before, same):
    """Put `same` (frames,) to false where a frame has not the stamps of the one before, given the pixels are the same.

    offsets, stamps: see `FirstStamps`; before: the stamps of the frame before the first of them.
    """
    for f in range(same.size):
        if same[f]:
            earlier = stamps[offsets[f - 1] : offsets[f]] if f else before
            for i in range(earlier.size):
                if stamps[offsets[f] + i] != earlier[i]:
                    same[f] = False
                    break


@jit
def chances_of_repeats(frames, same, likely, log_best, loss, least, of_stamp):
    """(frames,) logarithm of the chance of each frame that is the same as the one before, 0 for the others.

    frames: (frames, bytes); same: (frames,) bool; of_stamp: what each detection adds. The rest: see `chance_of_bits`.
    """
    out = np.zeros(same.size)
    for f in range(same.size):
        if same[f] and f > 0 and same[f - 1]:
            out[f] = out[f - 1]  # the same frame once more
        elif same[f]:
            ones = 0
            for i in range(frames.shape[1]):
                ones += ones_of(np.uint64(frames[f, i]))
            out[f] = chance_of_bits(frames[f], likely, log_best, loss, least) + of_stamp * ones
    return out


@jit
def equal_and_late(stamps, offsets, end):
    """(stamps that are equal to the one before in the same row, those behind `end`); rows ascend."""
    equal = 0
    late = 0
    for row in range(offsets.size - 1):
        for i in range(offsets[row], offsets[row + 1]):
            if not stamps[i] <= end:  # one may have been rounded to the end
                late += 1
            if i > offsets[row]:
                equal += stamps[i] == stamps[i - 1]
    return equal, late


class RepeatedFrames(Statistic):
    """Frames equal to the one before that chance does not explain.

    A repetition counts where its probability over the capture, from the pixels' own shares of detections, is below
    1e-9. With few pixels or few detections frames repeat by chance (see `rare_frames`). STR: all stamps are equal.
    Law: exact. There are none, except where the light goes out at times and empty frames follow each other: of such a
    model their number is a Poisson count.
    Shows: frames that were read out or stored twice.
    """

    modalities = ("str", "qis", "counts")
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        if not has_data(recording) or recording.n_frames < 2:
            return None
        frames = recording.n_frames
        number = (_chances_of_repeats(recording) < np.log(_SURE_CHANCE / frames)).sum()

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            text = f"{measured:g} frames are the same as the one before, {whole(expected)} expected"
            return text, float((measured - expected) / frames)

        return Summary(np.array([float(number)]), "exact", lambda cell: "successive frames", size)


def _chances_of_repeats(recording: Recording) -> np.ndarray:
    """Logarithm of the chance of each frame that is the same as the one before, by the pixels' own detections."""
    if "chances of repeats" not in recording._kept:
        found = _repeats_of_counts(recording) if recording.modality == "counts" else _repeats_of_bits(recording)
        recording._kept["chances of repeats"] = np.array(found)
    return recording._kept["chances of repeats"]  # type: ignore[return-value]


def _repeats_of_bits(recording: Recording) -> list[float]:
    """Of frames of bits or of stamps."""
    frames, columns = recording.n_frames, recording.layout.columns
    # of a share a little off 0 and 1, since it is measured
    share = ((recording.totals + 0.5) / (frames + 1.0)).reshape(recording.layout.shape)
    likely = np.packbits(share > 0.5, axis=1)
    missing = 8 * likely.shape[1] - columns
    loss = np.pad(np.abs(np.log(share / (1.0 - share))), ((0, 0), (0, missing))).ravel()
    best = float(np.log(np.maximum(share, 1.0 - share)).sum())
    least = float(np.log(_SURE_CHANCE / frames))
    stamped = recording.modality == "str"
    # a stamp is the same by chance in about one of so many cases
    of_stamp = float(np.log(max(1.0, -np.log(1.0 - share.max())) / recording.none)) if stamped else 0.0
    found: list[float] = []
    before, stamps_before = np.zeros(0, np.uint64), np.zeros(0, np.uint8)
    stamps_of = first_stamps(recording) if stamped else None
    for first, part in bits(recording):
        words = as_words(part)
        same = same_as_before(words, words[0] if first == 0 else before, first == 0)
        before = words[-1].copy()
        if stamps_of is not None:
            offsets, stamps, _ = next(stamps_of)[1]
            same_stamps(offsets, stamps, stamps_before.astype(stamps.dtype), same)
            stamps_before = stamps[offsets[-2] :].copy()
        if same.any():
            flat = np.ascontiguousarray(part).reshape(len(part), -1)
            chances = chances_of_repeats(flat, same, likely.ravel(), best, loss, least, of_stamp)
            found += chances[same].tolist()
    return found


def _repeats_of_counts(recording: Recording) -> list[float]:
    """Of frames of counts."""
    chance_of = _chance_of_counts(recording)
    found: list[float] = []
    before: np.ndarray | None = None
    for _, part in recording.chunks():
        flat = np.ascontiguousarray(part).reshape(len(part), -1)
        same = same_as_before(flat, flat[0] if before is None else before, before is None)
        found += [chance_of(part[f]) for f in np.flatnonzero(same)]
        before = flat[-1].copy()
    return found


def _chance_of_counts(recording: Recording) -> Callable[[np.ndarray], float]:
    """Of a frame of counts: binomial, or Poisson up to where counters are full."""
    from scipy import special

    frames, slots = recording.n_frames, slots_of_frame(recording)
    mean = (recording.totals + 0.5) / (frames + 1.0)
    share = (recording.totals + 0.5) / (frames * slots + 1.0)
    full = recording.conditions.largest_count

    def of_counts(frame: np.ndarray) -> float:
        k = frame.ravel().astype(np.float64)
        if not np.isfinite(slots):
            return float(np.where(k >= full, 0.0, special.xlogy(k, mean) - mean - special.gammaln(k + 1.0)).sum())
        ways = -np.log(slots + 1.0) - special.betaln(slots - k + 1.0, k + 1.0)
        return float((ways + special.xlogy(k, share) + special.xlog1py(slots - k, -share)).sum())

    return of_counts


class RareFrames(Statistic):
    """Frames without any detection, with all pixels full, or equal to the one before at odds below 1 in 1000.

    Dead pixels and pixels that always fire are left out of the first two. `repeated_frames` says how the odds are
    computed.
    Law: Poisson where they are rare; otherwise they scatter less.
    Shows: frames that were lost, overwritten or stored twice; a light source that stops.
    """

    modalities = ("str", "qis", "counts")
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        if not has_data(recording):
            return None
        frames, totals = recording.n_frames, recording.totals
        most = 1 if recording.modality != "counts" else recording.conditions.largest_count
        room = frames * most
        dead = (totals == 0) & (totals.mean() >= _PLAIN)
        stuck = (totals == room) & (room - totals.mean() >= _PLAIN)
        sums = frame_sums(recording)
        empty = (sums == most * int(stuck.sum())).sum()
        full = (sums == most * int((~dead).sum())).sum()
        repeated = (_chances_of_repeats(recording) < np.log(_RARE_CHANCE)).sum()
        names = ("without a detection", "with every pixel full", "the same as the one before")

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            text = f"{measured:g} of {frames} frames, {whole(expected)} expected"
            return text, float((measured - expected) / frames)

        values = np.array([empty, full, repeated], np.float64)
        return Summary(values, "poisson", lambda cell: f"frames {names[cell]}", size)


class EqualStamps(Statistic):
    """Time stamps that occur twice in a pixel, and stamps after the end of the exposure.

    Law: Poisson, for rare events. With a dead time longer than a tick there are none.
    Shows: events that were stored twice; a dead time or an exposure with a wrong value.
    """

    modalities = ("tr",)
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        if not has_data(recording) or recording.events is None:
            return None
        found, unit = stamps(recording)
        equal, late = equal_and_late(found, recording.events.offsets, recording.conditions.exposure / unit)
        events = max(1, len(recording.events))
        names = ("equal stamps of a pixel", "stamps behind the end of the exposure")

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            return f"{measured:g} events, {whole(expected)} expected", float((measured - expected) / events)

        return Summary(np.array([equal, late], np.float64), "poisson", lambda cell: names[cell], size)


class Gaps(Statistic):
    """The longest time without a detection of the whole array.

    Law: normal, as the score of the longest of n + 1 spacings of n random events. It is shorter than x with probability
    exp(-(n + 1) (1 - x)^n), with x as a share of the exposure.
    Shows: a readout that stops or loses data, light that goes out, bunched light.
    Source: longest spacing (Darling, Ann. Math. Stat. 24, 1953).
    """

    modalities = ("tr",)
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        if not has_data(recording) or recording.events is None:
            return None
        from scipy import special

        found, unit = stamps(recording)
        exposure = recording.conditions.exposure
        end = exposure / unit
        gap, events = longest_gap(found, 0.0, end)
        log_expected = np.log(events + 1.0) + events * np.log1p(-min(gap / end, 1.0 - 1e-15))
        expected_longer = np.exp(min(log_expected, 700.0))
        if expected_longer > 0.7:
            score = special.ndtri_exp(-expected_longer)
        else:
            longer = np.log(-np.expm1(-expected_longer)) if log_expected > -700 else log_expected
            score = -special.ndtri_exp(longer)

        def length(value: float) -> float:
            """The gap (s) that has a score; without an event, the exposure."""
            if not events:
                return exposure
            log_of = np.log(np.maximum(-special.log_ndtr(value), 1e-300))
            return float(-np.expm1((log_of - np.log(events + 1.0)) / max(1, events)) * exposure)

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            was, wanted = length(measured), length(expected)
            return f"{show(was, 's')}, {show(wanted, 's')} expected", (was - wanted) / exposure

        # a score is normal by itself: recordings without an event all have the same one, and no scatter
        values, where = np.array([float(score)]), "longest silence of the array"
        return Summary(values, "normal", lambda cell: where, size, np.ones(1))


class FullCounters(Statistic):
    """Counts that are equal to the largest number of the readout.

    Law: Poisson where they are rare; otherwise they scatter less.
    Shows: counters that are full, or that have fewer bits than stated.
    """

    modalities = ("counts",)
    unit = "1"

    def reduce(self, recording: Recording) -> Summary | None:
        if not has_data(recording):
            return None
        largest = recording.conditions.largest_count
        full = sum(int((part >= largest).sum()) for _, part in recording.chunks())
        number = recording.n_frames * recording.pixels

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            return f"{measured:g} of {number} counts, {whole(expected)} expected", float((measured - expected) / number)

        return Summary(np.array([float(full)]), "poisson", lambda cell: f"counts of {largest}", size)
