"""Power spectrum of the whole array."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from .. import units
from ..kernels import jit
from . import Recording, Statistic, Summary
from ._counting import exposure_in, per_cent, whole_ticks
from ._frames import frame_sums

_MOST = 65536  # bins
_FINEST = 5e-6  # s
_LEAST = 16  # bins


class Spectrum(Statistic):
    """Power spectrum of the detections of the whole array, at all frequencies.

    Time stamps: at most 65,536 bins of at least 5 us. Frames: each is a bin, or several together where there are more.
    The power is relative to its mean over all frequencies, so neither the light level nor a loss at all frequencies
    shows. Frequency zero is left out.
    Law: exponential (chi squared with 2 degrees of freedom), because amplitudes are sums over very many detections.
    Shows: flicker or a clock (a line); drift, source noise and blinking pixels (an excess at low frequencies).
    Source: Leahy et al., Astrophys. J. 266 (1983) 160.
    """

    modalities = ("tr", "str", "qis", "counts")
    specific = 3
    named_from = 1  # one period in the capture is a drift as well as a line
    among = "array"
    unit = "mean power"

    def reduce(self, recording: Recording) -> Summary | None:
        """Power relative to its mean."""
        series, step = _series(recording)
        bins = _quick(len(series))
        if bins < _LEAST:
            return None
        total = float(series[:bins].sum())
        from scipy import fft

        power = np.abs(fft.rfft(series[:bins].astype(np.float64))[1:]) ** 2
        if bins % 2 == 0:
            power = power[:-1]  # the last one is real: another law
        mean = float(power.mean())
        values = power / mean if mean > 0 else np.ones_like(power)
        frequency = np.arange(1, len(values) + 1) / (bins * step)

        def where(cell: int) -> str:
            return units.show(float(frequency[cell]), "Hz")

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            beyond = (measured - expected) * mean
            amplitude = 2 * math.sqrt(abs(beyond)) / max(total, 1.0)
            if beyond < 0:
                return f"power {measured:.3g}, {expected:.3g} expected (of the mean power)", -amplitude
            return f"{per_cent(amplitude)} modulation ({measured:.4g} times the mean power)", amplitude

        return Summary(values, "exponential", where, size, axis=frequency, label="frequency (Hz)", log=True)


def _series(recording: Recording) -> tuple[np.ndarray, float]:
    """((bins,) detections of the array, s from one bin to the next); of first stamps in equal times of waiting."""
    conditions = recording.conditions
    if recording.events is None:
        sums = frame_sums(recording)
        if recording.waited is not None:  # what stamps tell, too: the score of the rate, to first order
            waited = recording.waited[1]
            sums = sums - sums.sum() / waited.sum() * (waited - waited.mean())
        together = conditions.largest_count if recording.modality == "counts" and conditions.counting == "frames" else 1
        step = conditions.frame_period * together
        some = -(-len(sums) // _MOST)
        if some > 1:
            sums = sums[: len(sums) // some * some].reshape(-1, some).sum(axis=1)
        return sums, step * some
    stamps, tick = whole_ticks(recording)
    end = exposure_in(recording, tick)
    width = max(1, round(_FINEST / tick), -(-end // _MOST))
    out = np.zeros(end // width, np.int64)
    _bin(stamps, recording.events.offsets, 1.0 / width, out)
    return out, width * tick


@lru_cache(maxsize=64)
def _quick(bins: int) -> int:
    """The largest number up to `bins` for which a Fourier transform is quick."""
    from scipy import fft

    while bins > 1 and fft.next_fast_len(bins, real=True) != bins:
        bins -= 1
    return bins


@jit
def _bin(stamps, offsets, per_bin, out):
    for i in range(offsets[0], offsets[offsets.size - 1]):
        # half a tick off the edges, so that rounding is of no matter
        b = np.int64((np.float64(stamps[i]) + 0.5) * per_bin)
        if b < out.size:
            out[b] += 1
