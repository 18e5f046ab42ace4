"""The paper's simulation in plain numpy, as fast as numpy makes it: a yardstick for `scripts/benchmark.py`.

A batch of images at once: Poisson numbers, uniform times sorted by one packed key (row + time), a second pass for
the rare events that the dead time may hide, frames by the borders between (row, frame) pairs.
"""

from __future__ import annotations

import numpy as np


def simulate(
    rng: np.random.Generator,
    rates: np.ndarray,
    exposure: float = 1e-3,
    probability: float = 0.005,
    lifetime: float = 25e-9,
    dead_time: float = 50e-9,
    tick: float = 1e-11,
    frames: int = 100,
    pdp: float = 0.5,
) -> dict[str, np.ndarray]:
    """TR, STR, QIS and the six reconstructions of pixels with these detection rates (rows,), 1/s."""
    rows = rates.size
    frame_time = exposure / frames
    numbers = rng.poisson(rates * exposure)
    row = np.repeat(np.arange(rows), numbers)
    key = rng.random(row.size)
    key += row
    key.sort()
    # afterpulses: a few in a thousand, appended and sorted in
    parents = np.flatnonzero(rng.random(key.size) < probability)
    delay = (dead_time + rng.exponential(lifetime, parents.size)) / exposure
    late = key[parents] + delay
    late = late[np.floor(late) == np.floor(key[parents])]
    key = np.sort(np.concatenate([key, late]), kind="stable")
    row = key.astype(np.int64)
    time = (key - row) * exposure

    # frames: the first event of every (row, frame)
    frame = np.minimum((time / frame_time).astype(np.int64), frames - 1)
    place = row * frames + frame
    first = np.flatnonzero(np.diff(place, prepend=-1))
    bits = np.zeros((rows, frames), np.uint8)
    bits.ravel()[place[first]] = 1
    none = round(frame_time / tick)
    stamps = np.minimum(np.rint((time[first] - frame[first] * frame_time) / tick), none - 1).astype(np.uint32)
    ones = np.bincount(row[first], minlength=rows)
    waited = np.bincount(row[first], weights=stamps, minlength=rows) * tick + (frames - ones) * frame_time

    # dead time: only where a gap is short does the order of events matter
    kept = np.ones(time.size, bool)
    short = np.flatnonzero((np.diff(time) <= dead_time) & (np.diff(row) == 0)) + 1
    for i in short:
        j = i - 1
        while not kept[j]:
            j -= 1
        if row[j] == row[i] and time[i] - time[j] <= dead_time:
            kept[i] = False
    ticks = np.rint(time[kept] / tick).astype(np.uint32)
    counts = np.bincount(row[kept], minlength=rows)
    ends = np.cumsum(counts)
    span = np.zeros(rows)
    some = counts > 1
    span[some] = (ticks[ends[some] - 1].astype(np.int64) - ticks[(ends - counts)[some]]) * tick

    with np.errstate(divide="ignore", invalid="ignore"):
        live = np.maximum(span - (counts - 1) * dead_time, np.maximum(counts - 1, 1) * tick / 2)
        share = np.where(ones < frames, 1 - ones / frames, 0.5 / frames)
        images = {
            "counts": counts / (pdp * exposure),
            "passive_free_running": counts / (pdp * (exposure - counts * dead_time)),
            "inter_photon": np.where(some, (counts - 1) / (pdp * live), 0),
            "str_flux": ones / (pdp * waited),
            "qis_counts": ones,
            "qis_linear": -frames * np.log(share),
        }
    packed = np.packbits(bits, axis=1)
    return {"ticks": ticks, "counts": counts, "bits": packed, "stamps": stamps} | {
        name: image.astype(np.float32) for name, image in images.items()
    }
