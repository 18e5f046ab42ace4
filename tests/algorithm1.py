"""The paper's Algorithm 1 for one pixel, literally: slow, plain, the oracle of the fast simulator.

Suonsivu et al., Algorithm 1 (`# line n` below is its line n), Table 2 (which steps belong to which modality)
and their six reconstructions. Only `random.Random` and `math`, one number at a time: nothing
here has to be taken on trust. SI units throughout.

What the paper leaves open is read like this:
- events at or after the exposure T do not exist (an afterpulse can fall there);
- every event, also one that the dead time removes later, can have one afterpulse; afterpulses have none;
- TR: an event is recorded when it is more than the dead time after the last recorded one; rounding is last;
- STR and QIS: no dead time; frame f is [f T_f, (f + 1) T_f); in STR, 'no event' is T_f exactly, and a real
  stamp that rounds to T_f is stored one tick earlier;
- TR, STR and QIS are three readouts of the same events.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from random import Random

PLANCK = 6.62607015e-34  # J s, exact
LIGHT_SPEED = 299_792_458.0  # m/s, exact
LUMINOUS_EFFICACY = 683.0  # lm/W, at 555 nm; the paper uses it at every wavelength

_WHOLE_TICK = 1e-6  # ticks: T_f / dt within this of a whole number is that number (10 us / 100 ps in floats)


@dataclass(frozen=True)
class Record:
    """What one pixel gives in one exposure: three readouts, and the events they were made from."""

    tr: list[float]  # s: stamps of the recorded events, rounded to the resolution
    str: list[float]  # s: one per frame, first event from the start of the frame, frame_time where there is none
    qis: list[int]  # one bit per frame
    events: list[float]  # s: the sorted stream before dead time, frames and rounding (after line 19)


# ---- from a grey level to photons (lines 1-2) -------------------------------------------------------------


def photon_flux(
    grey: float,
    white: float,
    reference_lux: float,
    pixel_area: float,
    wavelength: float,
    fill_factor: float = 1.0,
) -> float:
    """Photons/s on a pixel's active area, of a grey level in an image whose `white` is `reference_lux`."""
    lux = grey / white * reference_lux
    power = fill_factor * pixel_area * lux / LUMINOUS_EFFICACY  # line 1: I_W
    return power / (PLANCK * LIGHT_SPEED / wavelength)  # line 2: phi


# ---- the pixel (lines 4-32) -------------------------------------------------------------------------------


def poisson(rng: Random, mean: float) -> int:
    """A Poisson number, right for every mean: how many arrivals of a unit-rate process come before `mean`."""
    number = 0
    arrival = rng.expovariate(1.0)
    while arrival < mean:
        number += 1
        arrival += rng.expovariate(1.0)
    return number


def detection_events(
    rng: Random,
    flux: float,
    exposure: float,
    pdp: float,
    dark_count_rate: float,
    dead_time: float,
    afterpulsing: float,
    lifetime: float,
) -> list[float]:
    """Lines 4-19: the sorted events, common to all modalities. `dead_time` only delays the afterpulses."""
    photons = poisson(rng, flux * exposure)  # line 4
    arrivals = [exposure * rng.random() for _ in range(photons)]  # line 5
    events = []
    for arrival in arrivals:  # line 6
        u = rng.random()  # line 7
        if u < 1 - pdp:  # line 8
            continue  # line 9: not detected
        events.append(arrival)
    dark_counts = poisson(rng, dark_count_rate * exposure)  # line 10
    dark = [exposure * rng.random() for _ in range(dark_counts)]  # line 11
    events = events + dark  # line 12
    number = len(events)  # line 13: fixed here, so an afterpulse has no afterpulse
    for j in range(number):  # line 14
        u = rng.random()  # line 15
        if u < afterpulsing:  # line 16
            delay = lifetime * rng.expovariate(1.0) + dead_time  # line 17
            events.append(events[j] + delay)  # line 18
    events.sort()  # line 19
    return [event for event in events if event < exposure]


def time_resolved(events: Sequence[float], dead_time: float, resolution: float) -> list[float]:
    """Lines 24-32, TR: what a non-paralyzable dead time leaves of the sorted `events`, rounded."""
    recorded: list[float] = []
    last = -math.inf  # lines 24-25: the first event is always recorded
    for event in events:  # line 26
        if event - last > dead_time:  # line 27
            recorded.append(event)  # line 28
            last = event  # line 29
    if resolution > 0:  # line 30
        recorded = [_nearest_tick(event, resolution) * resolution for event in recorded]  # line 31
    return recorded  # line 32


def synchronous(events: Sequence[float], frames: int, frame_time: float, resolution: float) -> list[float]:
    """Lines 20-22, STR: the first event of each frame from the start of the frame, `frame_time` for none."""
    stamps = []
    for f, inside in enumerate(_frames(events, frames, frame_time)):
        if not inside:
            stamps.append(frame_time)
        else:
            stamps.append(_frame_stamp(inside[0] - f * frame_time, frame_time, resolution))
    return stamps


def quanta(events: Sequence[float], frames: int, frame_time: float) -> list[int]:
    """Lines 20-22, QIS: B_f = min(1, number of events in the frame)."""
    return [min(1, len(inside)) for inside in _frames(events, frames, frame_time)]


def pixel(
    rng: Random,
    flux: float,
    exposure: float,
    pdp: float,
    dark_count_rate: float,
    dead_time: float,
    afterpulsing: float,
    lifetime: float,
    resolution: float,
    frames: int,
    frame_time: float,
) -> Record:
    """One pixel under `flux` photons/s for one exposure: TR, STR and QIS of the same events."""
    events = detection_events(
        rng, flux, exposure, pdp, dark_count_rate, dead_time, afterpulsing, lifetime
    )  # lines 4-19
    return Record(
        tr=time_resolved(events, dead_time, resolution),  # lines 23-32
        str=synchronous(events, frames, frame_time, resolution),  # lines 20-22
        qis=quanta(events, frames, frame_time),  # lines 20-22
        events=events,
    )


def _frames(events: Sequence[float], frames: int, frame_time: float) -> list[list[float]]:
    """The sorted events of each frame [f T_f, (f + 1) T_f); an event after the last frame is in none."""
    inside = []
    i = 0
    for f in range(frames):
        here = []
        while i < len(events) and events[i] < (f + 1) * frame_time:
            here.append(events[i])
            i += 1
        inside.append(here)
    return inside


def _frame_stamp(since_start: float, frame_time: float, resolution: float) -> float:
    if resolution > 0:
        none = math.ceil(frame_time / resolution - _WHOLE_TICK)  # the tick that means 'none'
        return min(_nearest_tick(since_start, resolution), none - 1) * resolution
    # not rounded, but f * T_f is a rounded float: T_f itself must go on meaning 'none'
    return min(max(since_start, 0.0), math.nextafter(frame_time, 0.0))


def _nearest_tick(time: float, resolution: float) -> int:
    return max(0, math.floor(time / resolution + 0.5))


# ---- the six reconstructions, for one pixel ---------------------------------------------------------------


def counts(number: int, pdp: float, exposure: float) -> float:
    """Photons/s: N / (q T)."""
    return number / (pdp * exposure)


def passive_free_running(number: int, pdp: float, exposure: float, dead_time: float) -> float:
    """Photons/s: N / (q (T - N tau_d)); saturated, that is T <= N tau_d: infinite."""
    alive = exposure - number * dead_time
    if number == 0:
        return 0.0
    if alive <= 0:
        return math.inf
    return number / (pdp * alive)


def stored_passive_free_running(number: int, pdp: float, exposure: float, dead_time: float) -> float:
    """Photons/s, as a dataset stores it: a saturated pixel has the value at T / tau_d - 1/2."""
    flux = passive_free_running(number, pdp, exposure, dead_time)
    if math.isinf(flux):
        most = exposure / dead_time - 0.5
        return most / (pdp * (exposure - most * dead_time))
    return flux


def inter_photon(stamps: Sequence[float], pdp: float, dead_time: float, resolution: float) -> float:
    """Photons/s: (N - 1) / (q (X_N - X_1 - (N - 1) tau_d)), the bracket at least (N - 1) dt / 2; N < 2: 0.

    Infinite where the bracket is not positive and there is no rounding to bound it by.
    """
    intervals = len(stamps) - 1
    if intervals < 1:
        return 0.0
    alive = stamps[-1] - stamps[0] - intervals * dead_time
    if inter_photon_is_bounded(stamps, dead_time, resolution):
        alive = intervals * resolution / 2
    return intervals / (pdp * alive) if alive > 0 else math.inf


def inter_photon_is_bounded(stamps: Sequence[float], dead_time: float, resolution: float) -> bool:
    """Whether the denominator of `inter_photon` is replaced by its bound: a manifest counts such pixels."""
    intervals = len(stamps) - 1
    if intervals < 1:
        return False
    return stamps[-1] - stamps[0] - intervals * dead_time < intervals * resolution / 2 * (1 - 1e-9)


def str_flux(stamps: Sequence[float], pdp: float, frame_time: float, resolution: float) -> float:
    """Photons/s: frames with a detection / (q sum D_i); where the sum is 0, every D_i is taken as dt / 2."""
    detected = sum(1 for stamp in stamps if stamp != frame_time)
    if detected == 0:
        return 0.0
    waited = math.fsum(stamps)
    if waited == 0:
        waited = len(stamps) * resolution / 2
    return detected / (pdp * waited) if waited > 0 else math.inf


def qis_counts(bits: Sequence[int]) -> int:
    """Frames with a detection."""
    return sum(bits)


def qis_linear(bits: Sequence[int]) -> float:
    """Detections: -M ln(1 - S / M); saturated, that is S = M: at S = M - 1/2."""
    frames = len(bits)
    detected: float = sum(bits)
    if detected == 0:
        return 0.0
    if detected == frames:
        detected = frames - 0.5
    return -frames * math.log(1 - detected / frames)
