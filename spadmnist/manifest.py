"""What a manifest may say: every field with its type and range. A right seal alone does not make it right."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from . import config as configs
from . import store
from .document import Document
from .section import Section
from .validated import Reader, brief

Whole = Annotated[int, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Text = Annotated[str, Field(min_length=1)]


def _inside(name: str) -> str:
    if {"", ".", ".."} & set(name.split("/")) or "\0" in name:
        raise ValueError(f"{brief(name)} leads out of the dataset; it must be the name of a file inside")
    return name


def _on_disk(name: str) -> str:
    if not store.is_name(name):
        raise ValueError(f"{brief(name)} cannot be a name on disk, and shards lie under their names")
    return name


FileName = Annotated[str, AfterValidator(_inside)]
Name = Annotated[str, AfterValidator(_on_disk)]


class _File(Section):
    bytes: Whole
    sha256: Digest


class TileFacts(Section):
    """The tiles of a chart, as `Tiles.facts` has them."""

    size: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=2, max_length=2)]
    corners: Annotated[list[Annotated[list[Whole], Field(min_length=2, max_length=2)]], Field(min_length=1)]
    numbers: list[Whole]
    labels: list[Annotated[int, Field(ge=0, le=255)]] | None = None


class _Split(Section):
    images: Annotated[int, Field(ge=1)]
    sha256: Digest
    tiles: TileFacts | None = None


class _Images(Section):
    shape: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=2, max_length=3)]
    dtype: Literal["uint8", "uint16", "float32"]
    white: Positive
    splits: Annotated[dict[Name, _Split], Field(min_length=1)]


class _Level(Section):
    text: Text
    kind: Literal["lux", "irradiance"]
    value: Positive


class _Settings(Section):
    pdp: Annotated[float, Field(ge=0)]
    exposure: Positive
    dead_time: Annotated[float, Field(ge=0)]
    tick: Annotated[float, Field(ge=0)]
    frames: Annotated[int, Field(ge=1)]
    frame_time: Positive


class _Shard(Section):
    level: Text | None
    folder: Name
    split: Name
    number: Whole
    start: Whole
    stop: Annotated[int, Field(ge=1)]


class _Sums(Section):
    detections: Whole
    empty_pixels: Whole


class _Statistics(Section):
    images: Whole
    pixels: Whole
    saturated_pixels: dict[Text, Whole]
    bytes: dict[Text, Whole]
    tr: _Sums | None = None
    frames: _Sums | None = None
    counts: _Sums | None = None
    causes: dict[Text, Whole] | None = None


_KINDS: dict[str, Any] = {
    "format": str,
    "stream": Annotated[int, Field(ge=1)],
    "encoding": Annotated[int, Field(ge=1)],
    "config": dict[str, Any],
    "images": _Images,
    "maps": dict[FileName, Digest | dict[str, str]],
    "plugins": list[dict[str, str]],
    "provenance": dict[Text, str],
    "provenance_sha256": Digest,
    "versions": dict[str, str],
    "seed": Whole,
    "levels": Annotated[list[_Level], Field(min_length=1)],
    "settings": _Settings,
    "shards": Annotated[list[_Shard], Field(min_length=1)],
    "normalisation": dict[str, dict[str, Positive | None]],
    "causes": list[Text],
    "statistics": dict[str, dict[str, _Statistics]],
    "files": dict[FileName, _File],
    "sha256": Digest,
}
# what spadmnist 0.1.0 sealed, and what stands in its place
_ONCE = {"versions"}
_TODAY = {"stream", "encoding", "provenance", "provenance_sha256"}


def problems(manifest: Mapping[str, Any], name: str) -> list[str]:
    """Every mistake in a manifest, a sentence each; name: of its file.

    First types and ranges. Where these are right, what the parts say of each other: levels and splits are those of the
    config, shards cover the images of each once, and statistics add them up.
    """
    reader = Reader(Document(name, manifest), Path())
    other = _TODAY if "versions" in manifest else _ONCE
    absent = other if "causes" in manifest else other | {"causes"}
    reader.sections(manifest, {key: kind for key, kind in _KINDS.items() if key not in absent}, {})
    if not reader.problems:
        _compare(manifest, reader)
    return reader.problems


def _compare(manifest: Mapping[str, Any], reader: Reader) -> None:
    config, say = manifest["config"], reader.say
    reader.problems += configs.problems(config, f"{reader.source.name}: config")
    if not reader.problems and config.get("reconstruct") is None:
        say(("config", "reconstruct"), "it is missing")
    if reader.problems:
        return
    levels, scene = manifest["levels"], config["scene"]
    texts = [level["text"] for level in levels]
    if texts != scene.get(levels[0]["kind"]) or len({level["kind"] for level in levels}) > 1:
        say(("levels",), "they are not those of the config")
    if manifest["seed"] != config.get("seed"):
        say(("seed",), f"{manifest['seed']} is not the config's, {config.get('seed')}")
    splits, pixels = manifest["images"]["splits"], math.prod(manifest["images"]["shape"])
    ends: dict[tuple[str | None, str], list[int]] = {}
    for i, shard in enumerate(manifest["shards"]):
        which = shard["level"], shard["split"]
        number, start = ends.setdefault(which, [0, 0])
        if shard["split"] not in splits or (shard["level"] is not None and shard["level"] not in texts):
            say(("shards", i), f"{shard['level'] or 'originals'}, {shard['split']} is no level and split here")
        elif (shard["number"], shard["start"]) != (number, start) or shard["stop"] <= start:
            say(("shards", i), f"it does not go on where the one before it ends, at number {number} and image {start}")
        ends[which] = [number + 1, shard["stop"]]
    for split, facts in splits.items():
        if tiles := facts.get("tiles"):
            check_tiles(tiles, manifest["images"]["shape"][-2:], ("images", "splits", split, "tiles"), reader)
    for level in (None, *texts):
        for split, facts in splits.items():
            held = ends.get((level, split), [0, 0])[1]
            if held != facts["images"]:
                what = f"{level or 'originals'}, {split}"
                say(("shards",), f"of {what} they hold {held} images, and there are {facts['images']}")
            if level is None:
                continue
            told = manifest["statistics"].get(level, {}).get(split)
            if told is None:
                say(("statistics", level), f"{split} is missing")
            elif (told["images"], told["pixels"]) != (facts["images"], facts["images"] * pixels):
                wanted = f"{facts['images']} images and {facts['images'] * pixels} pixels"
                say(("statistics", level, split), f"they are not of {wanted}")
            else:
                for method in config["reconstruct"]:
                    if method not in told["saturated_pixels"]:
                        say(("statistics", level, split, "saturated_pixels"), f"{method} is missing")
        if level is not None and level not in manifest["normalisation"]:
            say(("normalisation",), f"{level} is missing")


def check_tiles(tiles: Mapping[str, Any], shape: Sequence[int], path: tuple[str, ...], reader: Reader) -> None:
    """Note where tiles, which are well formed, do not lie on their chart of `shape`, or lack a number or a label."""
    n = len(tiles["corners"])
    for key in ("numbers", "labels"):
        if len(tiles.get(key) or [0] * n) != n:
            reader.say((*path, key), f"there are {len(tiles[key])} for {n} tiles")
    for axis in range(2):
        if max(corner[axis] for corner in tiles["corners"]) + tiles["size"][axis] > shape[axis]:
            reader.say((*path, "corners"), f"a tile leads beyond the chart of {shape[0]} x {shape[1]} pixels")
