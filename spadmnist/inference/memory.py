"""Memory of replicates: how much one takes, and how many workers may make one at the same time."""

from __future__ import annotations

import math

import numpy as np

from ..errors import InputError
from ..readout import no_detection
from ..recording import Capture
from ..sensor import BYTES_PER_EVENT, Sensor

# bytes that all processes take together with one worker or two; chosen so that a computer of 4 GB has room for it
MOST = 1_500_000_000
_EACH = MOST // 2  # bytes more for each worker beyond two: who asks for many has the memory for them; a rule of thumb
# bytes of the main process (220 to 350 MB were measured), and of a worker without its replicate: the program and freed
# memory that it keeps (90 to 400 MB were measured). They decide how many workers there are
_PROGRAM, _WORKER = 350_000_000, 300_000_000
# detections that are simulated at a time, in as many replicates as hold them: memory against time, and no result
# depends on it; a rule of thumb
EVENTS_AT_ONCE = 4_000_000
# The rest is how the simulator and the statistics divide their work; they decide the memory of a replicate.
_ORDERED = 1 << 24  # detections whose order in time is held at once, 8 bytes each, as in `statistics._order`
_STRETCH = 1.5e7  # expected events of the frames that are simulated at once, of a large capture: half of that of `twin`


def replicate_bytes(sensor: Sensor, capture: Capture, events: float, recorded: float, half: bool = False) -> float:
    """Bytes of one replicate of a capture while it is simulated and reduced.

    Args:
        events: expected of the simulation, for the whole array.
        recorded: expected detections.
        half: every other block of time is taken out of it.
    """
    c, readouts, pixels = capture.conditions, (capture.modality,), sensor.layout.pixels
    at_once = max(sensor.at_once(events, readouts), min(events, EVENTS_AT_ONCE))
    tick = capture.tick or sensor.tick
    if capture.modality == "tr":
        own, file = (_size(c.exposure, one) * recorded for one in (sensor.tick, tick))
        moved = 0.0 if math.isclose(sensor.tick, tick, rel_tol=1e-9) else file
        cut = recorded + file / 2 if half else 0.0
        # one after the other: simulated, put on the ticks of the file, reduced
        return max(own + BYTES_PER_EVENT * at_once, own + moved, file + 8 * min(recorded, _ORDERED) + cut)
    bits = c.frames * pixels / 8
    large = events > 2 * _STRETCH and not sensor.tying(readouts)
    stretch = min(events, _STRETCH) if large else events  # what is simulated of the frames at once
    scratch, share = BYTES_PER_EVENT * min(at_once, stretch), stretch / max(events, 1.0)
    if capture.modality == "qis":
        return scratch + (1 + share) * bits
    if capture.modality == "counts":
        return scratch + share * bits + 2.0 * c.count_frames * pixels * (1 if c.largest_count < 1 << 8 else 2)
    whole = 4.0 * c.frames * pixels  # stamps of frames as they are read
    copies = large + (not math.isclose(sensor.tick, tick, rel_tol=1e-9))
    return scratch + share * 2 * bits + 24.0 * stretch + copies * whole


def _size(exposure: float, tick: float) -> int:
    """Bytes of a time stamp."""
    return 8 if not tick or no_detection(exposure, tick) >= 1 << 32 else 4


def check(sensor: Sensor, capture: Capture, needed: float) -> None:
    """Raise InputError where a replicate takes more than even one worker may.

    Args:
        needed: bytes, as `replicate_bytes` gives them.
    """
    room = MOST - _PROGRAM - _WORKER
    if needed <= room:
        return
    do = "cut the recording into several captures, each with a shorter exposure"
    if tied := sensor.tying((capture.modality,)):
        do += f", or leave {tied} out, for which all pixels are simulated at once"
    raise InputError(
        f"{capture.id}: a simulated recording of it takes about {needed / 1e9:.2g} GB of memory, and it may take "
        f"{room / 1e9:.2g} GB: {do}"
    )


def workers_at_once(needed: float, jobs: int) -> int:
    """How many of `jobs` workers may make a replicate at the same time; at least one.

    Args:
        needed: bytes of a replicate.
    """
    room = max(MOST, _EACH * jobs) - _PROGRAM
    return max(1, min(jobs, int(room / (_WORKER + needed))))


def bytes_with(sensor: Sensor, capture: Capture, brightest: float, half: bool = False) -> float:
    """As `replicate_bytes`, of a replicate with so much light.

    Args:
        brightest: photons/s on each pixel.
    """
    flux = np.full((1, sensor.layout.pixels), brightest)
    events = sensor.drawn(flux, capture.conditions, (capture.modality,))
    recorded = float(sensor.expected(flux, capture.conditions)[1].sum())
    return replicate_bytes(sensor, capture, events, recorded, half)
