"""The shards of a dataset: which images each one holds, and what it says of itself."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .disk import Files
from .experiment import Experiment, Level
from .images import Images
from .sources import Source
from .store import Encoding, Expected, ShardReader

PLAN = ".spadmnist/plan.json"  # there as long as a run makes a dataset, or adds to it
_EVENTS_PER_SHARD = 9_000_000
_BYTES_PER_SHARD = 84 * 2**20  # before compression
_IMAGES_PER_SHARD = 4096


@dataclass(frozen=True)
class Shard:
    """Images `start` to `stop` of a split, at a light level or (level None) the originals themselves."""

    level: str | None
    folder: str
    split: str
    number: int
    start: int
    stop: int

    @property
    def path(self) -> str:
        return f"{self.folder}/{self.split}/{self.number:05d}"

    @property
    def attributes(self) -> dict[str, str | int]:
        """The attributes of the shard on disk; no other shard of the dataset has the same."""
        level = {} if self.level is None else {"level": self.level}
        return {"split": self.split, "start": self.start, "stop": self.stop, **level}

    def reader(
        self, root: Path | Source, encoding: Encoding, like: Likeness, files: Mapping[str, Files] | None = None
    ) -> ShardReader:
        """Reads the shard; a file in its place that is not its own is refused.

        files: of each shard, by its place, as `files_by_shard` gives them, where they are known.
        """
        n, pixels, columns = self.stop - self.start, math.prod(like.shape), like.shape[-1]
        bits = {"frames": like.frames, "columns": columns, "lines_per_image": pixels // columns}
        stamps = {"tick_s": like.tick} if like.tick > 0 else {}
        sizes = {"image": n, "event_start": n + 1, "first_event_start": n + 1, "line": n * (pixels // columns)}
        sizes |= {"frame_byte": -(-columns * like.frames // 8), **dict(zip(like.dims, like.shape, strict=True))}
        # a shard that is one file changes while reconstructions are added; its attributes do not
        grows = encoding.one_file and self.level is not None
        expected = Expected(
            {
                "": {"level": None, **self.attributes},
                "frames/bits": bits,
                "tr/ticks": {**stamps, "differences": 1},
                "frames/ticks": stamps,
            },
            sizes,
            None if files is None else files.get(encoding.location(self.path), {}),
            PLAN if grows else "",
        )
        return encoding.reader(root, self.path, expected)


@dataclass(frozen=True)
class Likeness:
    """What all shards of a dataset have in common: the shape of an image, the frames, and the tick (s, 0: none)."""

    shape: tuple[int, ...]
    frames: int
    tick: float

    @classmethod
    def of(cls, manifest: Mapping[str, Any]) -> Likeness:
        """As a manifest has it."""
        settings = manifest["settings"]
        return cls(tuple(manifest["images"]["shape"]), settings["frames"], settings["tick"])

    @property
    def dims(self) -> tuple[str, ...]:
        """Names of the axes of an image."""
        return ("channel", "y", "x")[-len(self.shape) :]


def files_by_shard(files: Files, encoding: Encoding) -> dict[str, Files]:
    """Those of a manifest's files that belong to shards, by the place of the shard."""
    found: dict[str, Files] = {}
    depth = len(encoding.location("folder/split/number").split("/"))
    for name, facts in files.items():
        parts = name.split("/")
        if len(parts) >= depth:
            found.setdefault("/".join(parts[:depth]), {})[name] = facts
    return found


def shards_of(experiment: Experiment, splits: Mapping[str, Images]) -> list[Shard]:
    """Every shard, sized by the events that are expected in it: a function of config and images alone."""
    shards = []
    for split, images in splits.items():
        n = experiment.wanted(images)
        raw = images.pixels[0].nbytes
        shards += _cut(None, "images", split, n, max(1, _BYTES_PER_SHARD // raw))
    for level in experiment.levels:
        for split, images in splits.items():
            n = experiment.wanted(images)
            events, size = expected_per_image(experiment, level, images)
            most = min(_EVENTS_PER_SHARD / max(events, 1), _BYTES_PER_SHARD / size, _IMAGES_PER_SHARD)
            shards += _cut(level.text, level.folder, split, n, max(1, int(most)))
    return shards


def _cut(level: str | None, folder: str, split: str, n: int, most: int) -> list[Shard]:
    # whole blocks of 32 images, so that an effect that draws by blocks is not asked twice
    step = most // 32 * 32 if most >= 32 else most
    return [Shard(level, folder, split, k, a, min(a + step, n)) for k, a in enumerate(range(0, n, step))]


def expected_per_image(experiment: Experiment, level: Level, images: Images) -> tuple[float, float]:
    """(events, bytes before compression) expected of one mean image of a split."""
    n = experiment.wanted(images)
    grey = images.mean(n) / images.white
    pixels = images.pixels[0].size
    photons = np.full((1, pixels), experiment.white(level) * grey)
    if experiment.wavelengths:
        photons = experiment.photons(level, np.full((1, *images.pixels.shape[1:]), grey), 1.0)
    photons = experiment.seen(photons.reshape(-1, experiment.sensor.layout.pixels))
    candidates, recorded = experiment.sensor.expected(photons, experiment.conditions)
    frames = experiment.conditions.frames
    stamped = np.minimum(candidates, frames)
    size = 0.0 if experiment.on_reading else 4.0 * pixels * len(experiment.methods)
    if "tr" in experiment.readouts:
        size += 4 * float(recorded.sum()) + 2 * pixels
    if set(experiment.readouts) & {"str", "qis"}:
        size += pixels * -(-frames // 8)
    if "str" in experiment.readouts:
        size += 4 * float(stamped.sum())
    if "counts" in experiment.readouts:
        size += 2 * pixels * experiment.conditions.count_frames
    if experiment.causes:
        size += 5 * float(recorded.sum() + stamped.sum())
    return float(candidates.sum()), size
