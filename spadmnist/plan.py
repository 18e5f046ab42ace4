"""What a run will cost, before it runs: photons, bytes, memory and time, from the flux and a small probe."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from . import factory, large, shard_columns, shard_plan
from .experiment import Experiment
from .foreign import visible
from .images import Images

_PROBE = 64  # images a level, at most
_EVENTS = 9e6  # as many as a shard has, expected of them; of a larger image some rows are taken
_NUMBERS = 2**24  # pixels of the images that expectations are taken over, where pixels differ
_AT_ONCE = 2**20  # numbers whose expectations are taken together: a dry run takes no more memory than a run
_BESIDES_ENCODING = 1.6  # hashing, writing and synchronising, against simulating and encoding (measured: 1.3 to 2)


def estimate(experiment: Experiment, splits: Mapping[str, Images], jobs: int) -> dict[str, Any]:
    """Per level and in total: images, photons, detections, bytes, seconds with `jobs` workers, and memory in bytes.

    Photons and detections are expectations over the very images. Bytes and time are scaled up from some images
    that are simulated and encoded here.
    """
    factory.check_volume(experiment, splits)
    shards = shard_plan.shards_of(experiment, splits)
    memory = factory.check_memory(experiment, splits, shards, jobs)
    # compile first, so that the probe times the work alone
    _probe(experiment, experiment.levels[0], next(iter(splits.values())), 1)
    levels = []
    shared = sum(shard.level is not None for shard in shards)
    for level in experiment.levels:
        row: dict[str, Any] = {"level": level.text, "images": 0, "photons": 0.0, "detections": 0.0}
        size = seconds = 0.0
        for images in splits.values():
            n = experiment.wanted(images)
            photons, detections = _expected(experiment, level, images, n)
            probed, took, bytes_ = _probe(experiment, level, images, _PROBE)
            row["images"] += n
            row["photons"] += photons
            row["detections"] += detections
            size += bytes_ / probed * n
            seconds += took / probed * n
        row["bytes"] = int(size)
        row["seconds"] = seconds * _BESIDES_ENCODING / min(jobs, shared)
        levels.append(row)
    total = {key: sum(row[key] for row in levels) for key in ("images", "photons", "detections", "bytes", "seconds")}
    return {"levels": levels, "total": total, "jobs": jobs, "shards": len(shards), "memory_per_worker": memory}


def _expected(experiment: Experiment, level: Any, images: Images, n: int) -> tuple[float, float]:
    """(photons, recorded detections) expected of the first `n` images."""
    pixels = images.pixels[:n]
    if pixels.dtype == np.uint8 and _uniform(experiment) and not experiment.wavelengths:
        # every pixel obeys the same law: the histogram of grey levels says it all
        shown = pixels[:1] if pixels.strides[0] == 0 else pixels
        # image by image: of all of them at once there would be a copy of 8 bytes for each pixel
        counted = sum(np.bincount(image.ravel(), minlength=256) for _, some in large.blocks(shown) for image in some)
        counted = np.asarray(counted) * (n // len(shown))
        photons = experiment.photons(level, np.arange(256, dtype=np.uint8)[:, None, None], images.white)
        everywhere = np.broadcast_to(photons[:, :1], (256, experiment.sensor.layout.pixels))
        recorded = np.concatenate([_seen(experiment, np.array(part))[:, 0].copy() for part in _some_of(everywhere)])
        total = float(counted @ photons[:, 0]) * experiment.conditions.exposure
        return total, float(counted @ recorded)
    step = max(1, n // max(1, min(256, _NUMBERS // pixels[0].size)))
    lit = seen = 0.0
    for part in _some_of(pixels[::step]):
        here = experiment.photons(level, np.ascontiguousarray(part), images.white)
        lit += float(here.sum())
        seen += float(_seen(experiment, here.reshape(-1, experiment.sensor.layout.pixels)).sum())
    share = n / len(pixels[::step])
    return lit * experiment.conditions.exposure * share, seen * share


def _some_of(array: np.ndarray) -> Iterator[np.ndarray]:
    """Some items after the other, as many as little memory holds of their numbers."""
    step = max(1, _AT_ONCE // array[0].size)
    return (array[start : start + step] for start in range(0, len(array), step))


def _seen(experiment: Experiment, photons: np.ndarray) -> np.ndarray:
    """Expected entries of the stream per pixel: detections of TR, else of a counter, else frames with a detection."""
    sensor, c, light = experiment.sensor, experiment.conditions, experiment.seen(photons)
    if "tr" in experiment.readouts:
        return sensor.expected(light, c)[1]
    if c.counting == "counter" and set(experiment.readouts) == {"counts"}:
        counted = sensor.expected(light, c.within_frames, stamped=False)[1]
        return np.minimum(counted, c.count_frames * sensor.full_counts(c))
    return -c.frames * np.expm1(-sensor.expected(light, c.within_frames, first=True)[0] / c.frames)


def _uniform(experiment: Experiment) -> bool:
    return all(
        np.ndim(getattr(effect, name)) == 0 for effect in experiment.sensor.effects for name in effect.parameters
    )


def _probe(experiment: Experiment, level: Any, images: Images, count: int) -> tuple[float, float, int]:
    """(images, seconds to simulate and encode them, bytes); of a large image a share of it."""
    events = shard_plan.expected_per_image(experiment, level, images)[0]
    fit = int(_EVENTS / max(events, 1.0))
    block = experiment.sensor.block
    count = min(max(min(count, fit), block if block > 1 else 0), len(images))
    pixels, share = np.ascontiguousarray(images.pixels[: max(1, count)]), float(count)
    if not count:
        experiment, pixels, share = _rows(experiment, level, pixels, images.white)
    started = time.perf_counter()
    made = experiment.simulate_block(level, "probe", pixels, images.white, 0)
    columns = shard_columns.recorded_columns(experiment, made, pixels.shape[1:])
    size = experiment.encoding.size(columns)
    return share, time.perf_counter() - started, size


def _rows(experiment: Experiment, level: Any, pixels: np.ndarray, white: float) -> tuple[Experiment, np.ndarray, float]:
    """(the experiment with some rows of the sensor alone, their pixels of one image, share of its events).

    The rows are as bright as the image, as nearly as there are any. All of it, where something ties its pixels together
    or the paper's line, which is faster than that of a part of a sensor, makes it.
    """
    sensor = experiment.sensor
    photons = experiment.photons(level, pixels, white).reshape(-1, sensor.layout.pixels)
    events = sensor.expected(photons, experiment.conditions)[0].reshape(-1, *sensor.layout.shape).sum(axis=(0, 2))
    from_frames = bool(experiment.from_frames(photons).any())
    # of the bits of a frame those that are fewer are drawn
    drawn = pixels.size * experiment.conditions.frames / 2 if from_frames else float(events.sum())
    few = max(1, int(_EVENTS / drawn * len(events)))
    fused = sensor.is_paper_line and not from_frames
    if few >= len(events) or fused or sensor.tying(experiment.readouts):
        return experiment, pixels, 1.0
    sums = np.convolve(events, np.ones(few), "valid")
    top = int(np.argmin(np.abs(sums - events.sum() * few / len(events))))
    rows = slice(top, top + few)
    return (
        replace(experiment, sensor=sensor.cropped(rows, slice(None))),
        np.ascontiguousarray(pixels[..., rows, :]),
        float(sums[top] / events.sum()),
    )


def text(estimated: Mapping[str, Any], root: Path) -> str:
    """The estimate for people."""
    lines = [f"{'light level':>14}  {'images':>9}  {'photons':>9}  {'detections':>10}  {'size':>8}  {'time':>8}"]
    for row in [*estimated["levels"], {"level": "all", **estimated["total"]}]:
        lines.append(
            f"{visible(row['level']):>14}  {row['images']:>9,}  {row['photons']:>9.3g}  {row['detections']:>10.4g}  "
            f"{_bytes(row['bytes']):>8}  {_seconds(row['seconds']):>8}"
        )
    jobs = estimated["jobs"]
    lines += [
        "",
        f"{estimated['shards']} shards with {jobs} worker{'s' if jobs > 1 else ''}, "
        f"about {_bytes(estimated['memory_per_worker'])} of memory each. Nothing was made in {visible(root)}.",
        "Photons and detections are expectations; size and time are scaled up from some images simulated just now.",
    ]
    return "\n".join(lines)


def _bytes(n: float) -> str:
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if n >= factor:
            return f"{n / factor:.3g} {unit}"
    return f"{n:.0f} B"


def _seconds(s: float) -> str:
    return f"{s / 60:.1f} min" if s >= 100 else f"{s:.1f} s"
