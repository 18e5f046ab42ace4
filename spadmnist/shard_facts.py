"""What shards say of themselves for the manifest: detections, empty and saturated pixels, bytes by kind of data."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from . import shard_plan, store
from .disk import Files
from .errors import InputError
from .foreign import from_json
from .shard_plan import Likeness, Shard
from .sources import Source


@dataclass(frozen=True)
class Facts:
    """What a shard says of itself for the manifest.

    statistics: `shard_columns.statistics`; saturated: pixels by method, of methods that `statistics` does not name;
    kinds: bytes by kind of data.
    """

    statistics: dict[str, dict[str, int]]
    saturated: dict[str, int]
    kinds: dict[str, int]

    @classmethod
    def noted(cls, found: Any) -> Facts | None:
        """As a note has them; None where it has none, or damaged ones."""
        try:
            facts = cls(**found)
            each = [*facts.statistics.values(), facts.saturated, facts.kinds]
            return facts if all(type(number) is int for numbers in each for number in numbers.values()) else None
        except (TypeError, AttributeError):
            return None


def facts_of(reader: store.ShardReader, methods: Sequence[str], files: Files) -> Facts:
    """The facts of a shard that is there. Raises InputError, KeyError, TypeError or ValueError where it is damaged."""
    told = from_json(reader.attributes["statistics"])
    others = [method for method in methods if method not in told.get("saturated_pixels", ())]
    saturated = {m: int(reader.array_attributes(f"reconstruction/{m}")["saturated_pixels"]) for m in others}
    return Facts(told, saturated, reader.kinds(files))


def statistics_of(
    root: Path | Source,
    encoding: store.Encoding,
    levels: Sequence[str],
    methods: Sequence[str],
    like: Likeness,
    shards: Sequence[Shard],
    files: Files,
    known: Mapping[str, Facts] | None = None,
) -> dict[str, Any]:
    """Per level and split: images, pixels, detections, empty and saturated pixels, bytes by kind of data.

    They are added up from what each shard says of itself. known: the facts of shards that need not be read, by path.
    Raises InputError where another one cannot be read.
    """
    pixels = math.prod(like.shape)
    by_shard = shard_plan.files_by_shard(files, encoding)
    out: dict[str, Any] = {level: {} for level in levels}
    for shard in shards:
        if shard.level is None:
            continue
        total = out[shard.level].setdefault(
            shard.split,
            {"images": 0, "pixels": 0, "saturated_pixels": dict.fromkeys(methods, 0), "bytes": {}},
        )
        total["images"] += shard.stop - shard.start
        total["pixels"] += (shard.stop - shard.start) * pixels
        place = encoding.location(shard.path)
        try:
            facts = (known or {}).get(shard.path)
            if facts is None:
                facts = facts_of(shard.reader(root, encoding, like), methods, by_shard.get(place, {}))
            for readout, numbers in facts.statistics.items():
                sums = total.setdefault(readout, dict.fromkeys(numbers, 0))
                for key, value in numbers.items():
                    sums[key] += value
            for method, number in facts.saturated.items():
                total["saturated_pixels"][method] += number
        except (KeyError, TypeError, ValueError, AttributeError):
            raise InputError(
                f"{root / place}: what it says of its own detections is "
                "damaged; remove it and type the same command again"
            ) from None
        for kind, size in facts.kinds.items():
            kind = kind if kind in ("tr", "frames", "reconstruction", "all") else "other"
            total["bytes"][kind] = total["bytes"].get(kind, 0) + size
    return out
