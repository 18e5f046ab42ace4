"""A SPAD array as a literal queue of carriers: the independent generator of the hidden-effect challenge.

It shares no code and no algorithm with the package: one time-ordered heap for the whole array, one carrier at a time,
numpy for random numbers (PCG64), h5py for files. It follows `rules: device`: only what fires fills traps and lights up
neighbours; what comes while its pixel is blind is lost; in frames a pixel fires once, and nothing fires between them.

What is hidden is described as a physicist would who has not read the catalogue: traps are bands of lifetimes with a
Poisson number of releases, crosstalk is a table of chances, a blinking pixel has several defects, a lamp warms up.

    world = World(rows=16, columns=16, active_area=25e-12, pdp={500e-9: 0.42})
    times, pixels = expose(world, Capture("flat", "tr", irradiance=7.5e-4, exposure=0.06), numpy.random.default_rng(1))

SI units.
"""

from __future__ import annotations

import bisect
import heapq
import itertools
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

PLANCK = 6.62607015e-34
LIGHT_SPEED = 299792458.0

# what is in the queue; at equal times the earlier one goes first
SWITCH, LAMP, BURST, CARRIER, PHOTON, DARK = range(6)


@dataclass
class Traps:
    """Carriers that an avalanche leaves behind: released at the dead time and an exponential time after it.

    `single`: at most one release an avalanche (what a data sheet means by its probability); else their number is
    Poisson. Each trap has a lifetime of its own, its logarithm uniform between the two limits.
    """

    mean: float
    shortest: float
    longest: float
    single: bool = False


@dataclass
class Lamp:
    """What the lamp does beside shining. Phases differ from capture to capture."""

    swing: float = 0.0  # relative amplitude of the fundamental; the second harmonic has a tenth of it
    frequency: float = 100.0
    warming: float = 0.0  # relative rise over the capture, an exponential approach; the mean stays
    contrast: float = 0.0  # variance of the level, which jumps at random times and is uniform in between
    hold: float = 1e-4  # mean time between jumps


@dataclass
class World:
    """The chip as it is. Arrays have one entry per pixel, in row-major order."""

    rows: int
    columns: int
    active_area: float
    pdp: dict[float, float]  # at a wavelength
    dark_rate: Any = 0.0
    pdp_factor: Any = 1.0
    illumination: Any = 1.0  # how the lamp's light falls on the array
    lamp: Lamp = field(default_factory=Lamp)
    stray_rate: float = 0.0  # detections of stray light while the shutter is open
    traps: list[Traps] = field(default_factory=list)
    crosstalk: dict[tuple[int, int], float] = field(default_factory=dict)  # (dx, dy): chance
    crosstalk_delay: float = 300e-12  # mean
    crosstalk_order: int = 2  # of the Erlang law of the delay: the sum of so many exponentials, 1 or 2
    dead_time: Any = 0.0
    dead_time_order: int = 0  # k: every blind time is drawn anew from an Erlang law of this order; 0: it is fixed
    paralyzable: bool = False
    recharge: float = 0.0  # the pixel's sensitivity comes back as 1 - exp(-u / recharge)
    carried: float = 0.0  # share of the blind time that goes on in the next frame
    live: float = 1.0  # share of the frame during which a pixel is live
    tick: float = 0.0
    code_widths: Sequence[float] = ()  # of the converter's codes, in ticks, repeating; their sum is their number
    jitter: float = 0.0
    bus_time: float = 0.0  # for which a detection occupies the bus
    bus_places: int = 16  # detections that wait or are served, at most
    defects: list[tuple[int, float, float, float]] = field(default_factory=list)  # pixel, Hz while on, 1/s on, 1/s off
    # nothing of this is in the catalogue
    echo: float = 0.0  # chance that a detection is followed by another one a fixed time later
    echo_delay: float = 180e-9
    echo_step: int = 0  # pixels further on in the read-out order
    bursts: float = 0.0  # 1/s
    burst_size: int = 12  # adjacent pixels, within a nanosecond
    blank_period: float = 0.0  # everything is blind for `blank_time` in every period
    blank_time: float = 0.0
    droop: float = 0.0  # relative loss of PDP for each avalanche that the pixel still remembers
    droop_memory: float = 2e-6
    copied_frames: float = 0.0  # share of the frames that are a copy of the one before

    @property
    def pixels(self) -> int:
        return self.rows * self.columns

    def each(self, value: Any) -> np.ndarray:
        return np.broadcast_to(np.asarray(value, float), (self.pixels,))


@dataclass
class Capture:
    """One capture as it was really made: what the lab notes down may differ."""

    name: str
    modality: str  # tr, str, qis
    wavelength: float = 500e-9
    irradiance: float = 0.0  # W/m^2; 0: the shutter is shut
    exposure: float = 0.0  # tr
    frames: int = 0
    frame_time: float = 0.0
    frame_period: float = 0.0
    leak: float = 0.0  # detections/s that get through the shut shutter

    @property
    def dark(self) -> bool:
        return self.irradiance == 0

    @property
    def length(self) -> float:
        return self.frames * self.frame_period if self.frames else self.exposure


def photon_rate(irradiance: float, wavelength: float, area: float) -> float:
    """Photons/s on `area` (m^2)."""
    return irradiance * area * wavelength / (PLANCK * LIGHT_SPEED)


def expose(world: World, capture: Capture, rng: np.random.Generator) -> tuple[list[float], list[int]]:
    """All avalanches of a capture in the order of time: when (s), and in which pixel."""
    uniform, exponential = _singly(rng.random), _singly(rng.standard_exponential)
    pixels, end = world.pixels, capture.length

    # the rain: photons that will be detected if their pixel is ready, and carriers that come by themselves
    photons = world.each(world.illumination) * world.each(world.pdp_factor)
    if capture.dark:
        photons = photons * 0.0
    else:
        photons = photons * photon_rate(capture.irradiance, capture.wavelength, world.active_area)
        photons = photons * world.pdp[capture.wavelength]
    quiet = world.each(world.dark_rate) + (capture.leak if capture.dark else world.stray_rate)
    by_pixel: list[list[int]] = [[] for _ in range(pixels)]
    for number, (pixel, *_) in enumerate(world.defects):
        by_pixel[pixel].append(number)
    noisiest = quiet.copy()
    for pixel, rate, _, _ in world.defects:
        noisiest[pixel] += rate
    lamp = world.lamp
    lit = lamp.swing > 0 or lamp.warming != 0 or lamp.contrast > 0
    spread = math.sqrt(3 * lamp.contrast)  # half the width of a uniform law of this variance
    top = (1 + 1.1 * lamp.swing) * (1 + abs(lamp.warming)) * (1 + spread)
    phase, second_phase = 2 * math.pi * uniform(), 2 * math.pi * uniform()
    warm = 1.5  # time constants of warming up that a capture lasts
    warm_mean, warm_end = 1 - (1 - math.exp(-warm)) / warm, 1 - math.exp(-warm)
    jump = 1 + spread * (2 * uniform() - 1)
    photon_total, dark_total = float(photons.sum()) * top, float(noisiest.sum())
    hit, pick = _pixels(photons, rng), _pixels(noisiest, rng)

    heap: list[tuple[float, int, int]] = []
    if photon_total > 0:
        heap.append((exponential() / photon_total, PHOTON, hit()))
    if dark_total > 0:
        heap.append((exponential() / dark_total, DARK, pick()))
    if lamp.contrast > 0:
        heap.append((exponential() * lamp.hold, LAMP, 0))
    if world.bursts > 0:
        heap.append((exponential() / world.bursts, BURST, 0))
    on = []
    for number, (_, _, switch_on, switch_off) in enumerate(world.defects):
        on.append(uniform() < switch_on / (switch_on + switch_off))
        heap.append((exponential() / (switch_off if on[number] else switch_on), SWITCH, number))
    heapq.heapify(heap)
    pop, push, replace = heapq.heappop, heapq.heappush, heapq.heapreplace

    ready = [-math.inf] * pixels  # when a pixel can fire again
    dead, still, most = world.each(world.dead_time).tolist(), quiet.tolist(), noisiest.tolist()
    shared, remembered = [0.0] * pixels, [0.0] * pixels  # avalanches that droop remembers, and when that was
    table = list(world.crosstalk.items())
    framed, period, gate = capture.frames > 0, capture.frame_period, world.live * capture.frame_time
    recharge, droop = world.recharge, world.droop
    order = world.dead_time_order
    erlang = _singly(lambda n: rng.standard_gamma(order, n))
    times: list[float] = []
    places: list[int] = []

    while heap:
        t, kind, pixel = heap[0]
        if t >= end:
            break
        if kind == PHOTON:
            replace(heap, (t + exponential() / photon_total, PHOTON, hit()))
            if lit:
                swing = math.sin(2 * math.pi * lamp.frequency * t + phase)
                swing += 0.1 * math.sin(4 * math.pi * lamp.frequency * t + second_phase)
                rise = (1 - math.exp(-warm * t / end) - warm_mean) / warm_end
                if uniform() * top > (1 + lamp.swing * swing) * (1 + lamp.warming * rise) * jump:
                    continue
            if droop:
                level = shared[pixel] * math.exp((remembered[pixel] - t) / world.droop_memory)
                if uniform() < droop * level:
                    continue
        elif kind == DARK:
            replace(heap, (t + exponential() / dark_total, DARK, pick()))
            if by_pixel[pixel]:
                now = still[pixel] + sum(world.defects[number][1] for number in by_pixel[pixel] if on[number])
                if uniform() * most[pixel] > now:
                    continue
        elif kind == CARRIER:
            pop(heap)
        elif kind == SWITCH:
            on[pixel] = not on[pixel]
            replace(heap, (t + exponential() / world.defects[pixel][3 if on[pixel] else 2], SWITCH, pixel))
            continue
        elif kind == LAMP:
            jump = 1 + spread * (2 * uniform() - 1)
            replace(heap, (t + exponential() * lamp.hold, LAMP, 0))
            continue
        else:  # a burst: a square of adjacent pixels
            replace(heap, (t + exponential() / world.bursts, BURST, 0))
            side = math.ceil(math.sqrt(world.burst_size))
            x, y = int(uniform() * (world.columns - side)), int(uniform() * (world.rows - side))
            for k in range(world.burst_size):
                struck = (y + k // side) * world.columns + x + k % side
                push(heap, (t + 1e-9 * uniform(), CARRIER, struck))
            continue

        # a carrier in this pixel: does it fire?
        if framed:
            frame = int(t / period)
            if t - frame * period >= gate:
                continue
        if world.blank_period and t % world.blank_period < world.blank_time:
            continue
        if t <= ready[pixel]:
            if world.paralyzable and not framed:
                ready[pixel] = t + dead[pixel]
            continue
        if recharge and not framed and uniform() < math.exp((ready[pixel] - t) / recharge):
            continue

        # it does
        times.append(t)
        places.append(pixel)
        blind = dead[pixel]
        if order:
            blind *= erlang() / order
        if framed:
            following = (frame + 1) * period
            ready[pixel] = max(following, following + world.carried * (t + blind - following))
        else:
            ready[pixel] = t + blind
        if droop:
            level = shared[pixel] * math.exp((remembered[pixel] - t) / world.droop_memory)
            shared[pixel], remembered[pixel] = level + 1, t
        for traps in world.traps:
            if traps.single:
                releases = 1 if uniform() < traps.mean else 0
            else:
                releases, waited = 0, exponential()
                while waited < traps.mean:
                    releases += 1
                    waited += exponential()
            for _ in range(releases):
                lifetime = traps.shortest
                if traps.longest > traps.shortest:
                    lifetime *= (traps.longest / traps.shortest) ** uniform()
                push(heap, (t + blind + lifetime * exponential(), CARRIER, pixel))
        if table:
            y, x = divmod(pixel, world.columns)
            for (dx, dy), chance in table:
                if uniform() < chance and 0 <= x + dx < world.columns and 0 <= y + dy < world.rows:
                    if world.crosstalk_order == 1:
                        late = world.crosstalk_delay * exponential()
                    else:
                        late = 0.5 * world.crosstalk_delay * (exponential() + exponential())
                    push(heap, (t + late, CARRIER, pixel + dy * world.columns + dx))
        if world.echo and uniform() < world.echo:
            late = world.echo_delay + 1e-9 * (uniform() - 0.5)
            push(heap, (t + late, CARRIER, (pixel + world.echo_step) % pixels))
    return times, places


def stamps(
    world: World, capture: Capture, times: Sequence[float], pixels: Sequence[int], rng: np.random.Generator
) -> tuple[list[int], list[int]]:
    """What a time-resolving array stores of its avalanches: ticks and pixels, in the order of the avalanches."""
    normal = _singly(rng.standard_normal)
    edges = list(itertools.accumulate(world.code_widths, initial=0.0))
    codes = len(world.code_widths)
    served: deque[float] = deque()
    ticks, places = [], []
    for t, pixel in zip(times, pixels, strict=True):
        if world.jitter:
            t = min(max(t + world.jitter * normal(), 0.0), capture.exposure)
        if world.bus_time:
            while served and served[0] <= t:
                served.popleft()
            if len(served) >= world.bus_places:
                continue
            served.append((served[-1] if served else t) + world.bus_time)
        position = t / world.tick + 0.5
        if codes:
            turn = math.floor(position / codes)
            code = bisect.bisect_right(edges, position - turn * codes) - 1
            position = turn * codes + min(code, codes - 1)
        ticks.append(math.floor(position))
        places.append(pixel)
    return ticks, places


def bits(world: World, capture: Capture, times: Sequence[float], pixels: Sequence[int]) -> np.ndarray:
    """(frames, rows, columns) of 0 and 1: which pixels fired in which frame."""
    seen = np.zeros((capture.frames, world.pixels), np.uint8)
    for t, pixel in zip(times, pixels, strict=True):
        seen[int(t / capture.frame_period), pixel] = 1
    return seen.reshape(capture.frames, world.rows, world.columns)


def first_stamps(world: World, capture: Capture, times: Sequence[float], pixels: Sequence[int]) -> np.ndarray:
    """(frames, rows, columns) ticks from the start of the frame to the pixel's avalanche; the whole frame: none."""
    none = math.ceil(capture.frame_time / world.tick - 1e-9)
    edges = list(itertools.accumulate(world.code_widths, initial=0.0))
    codes = len(world.code_widths)
    first = np.full((capture.frames, world.pixels), none, np.uint32)
    for t, pixel in zip(times, pixels, strict=True):
        frame = int(t / capture.frame_period)
        position = (t - frame * capture.frame_period) / world.tick + 0.5
        if codes:
            turn = math.floor(position / codes)
            code = bisect.bisect_right(edges, position - turn * codes) - 1
            position = turn * codes + min(code, codes - 1)
        first[frame, pixel] = min(max(math.floor(position), 0), none - 1)
    return first.reshape(capture.frames, world.rows, world.columns)


def record(world: World, capture: Capture, path: Path, rng: np.random.Generator) -> int:
    """Make the capture and write its file; the number of detections in it."""
    times, pixels = expose(world, capture, rng)
    with h5py.File(path, "w") as file:
        file.attrs["modality"] = capture.modality
        if capture.modality == "tr":
            ticks, places = stamps(world, capture, times, pixels, rng)
            file.attrs["tick"] = world.tick
            # a jittered stamp may pass another one
            order = np.argsort(np.array(ticks, np.uint64), kind="stable")
            for name, values, kind in (("time", ticks, np.uint64), ("pixel", places, np.uint16)):
                file.create_dataset(name, data=np.array(values, kind)[order], compression="gzip", shuffle=True)
            return len(ticks)
        if capture.modality == "str":
            first = first_stamps(world, capture, times, pixels)
            file.attrs["tick"] = world.tick
            file.create_dataset("frames", data=first, compression="gzip", shuffle=True)
            return len(times)
        seen = bits(world, capture, times, pixels)
        for frame in range(1, capture.frames):
            if world.copied_frames and rng.random() < world.copied_frames:
                seen[frame] = seen[frame - 1]
        packed = file.create_dataset("frames", data=np.packbits(seen, axis=2), compression="gzip")
        packed.attrs["width"] = world.columns
        return int(seen.sum())


def _singly(draw: Callable[[int], np.ndarray]) -> Callable[[], float]:
    """Random numbers one by one; numpy draws them by the thousand, which is faster."""

    def numbers() -> Any:
        while True:
            yield from draw(8192).tolist()

    return numbers().__next__


def _pixels(weights: np.ndarray, rng: np.random.Generator) -> Callable[[], int]:
    """Pixels one by one, each as often as its weight says."""
    total = np.cumsum(weights)

    def draw(n: int) -> np.ndarray:
        found = np.searchsorted(total, rng.random(n) * total[-1], side="right")
        return np.minimum(found, len(weights) - 1)

    return _singly(draw)  # type: ignore[return-value]
