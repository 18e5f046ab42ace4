"""A dataset: what it holds, where it lies, and how it is read.

    out/manifest.json                      every file with its size and SHA-256, and its own digest
    out/config.yaml                        the config with nothing left open
    out/maps/                              maps of the sensor that came from files
    out/data/images/<split>/<shard>...     the original images and labels
    out/data/<level>/<split>/<shard>...    streams and reconstructions

`open` reads a finished dataset, or simulates one on demand from its config: bit for bit the same.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, overload

import numpy as np

from . import config, disk, document, kernels, lazy, plugins, reconstruct, remote, store, units
from . import manifest as manifests
from .disk import Files
from .errors import InputError, SpadError, UnknownName, did_you_mean
from .events import Events
from .experiment import Experiment, Level, level_of
from .foreign import from_json, quoted, short
from .gather import gather, indices_of, join
from .identity import FORMAT, held
from .images import Images, cache_folder
from .readout import Frames, Recorded, summarised
from .reconstruct import medians_of_nonzero
from .sources import Source
from .store import Column, Encoding, Expected, ShardReader, read_joined
from .tiles import Tiles, of_facts

_LARGEST_MANIFEST = 1 << 30  # bytes
_LONGEST_SENTENCE = 600  # characters of one mistake in a manifest, which may quote endless names
MANIFEST = "manifest.json"
CONFIG = "config.yaml"
STATE = ".spadmnist"

_EVENTS_PER_SHARD = 9_000_000
_BYTES_PER_SHARD = 84 * 2**20  # before compression
_IMAGES_PER_SHARD = 4096
_BYTES_PER_CHUNK = 4 * 2**20
_IMAGES_PER_CHUNK = 32  # one image is read in 0.1 ms, and twice as many would compress only 0.5 % better


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
        """What a shard says of itself on disk, by which it is told from any other of the dataset."""
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
        # a shard that is one file changes where reconstructions are added; its attributes do not
        known = files if not encoding.one_file or self.level is None else None
        expected = Expected(
            {
                "": {"level": None, **self.attributes},
                "frames/bits": bits,
                "tr/ticks": {**stamps, "differences": 1},
                "frames/ticks": stamps,
            },
            sizes,
            None if known is None else known.get(encoding.location(self.path), {}),
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


# --- what a shard holds -------------------------------------------------------------------------------------------


def image_columns(images: Images, start: int, stop: int) -> dict[str, Column]:
    """The originals."""
    pixels = np.ascontiguousarray(images.pixels[start:stop])
    dims = ("image", "channel", "y", "x")[: pixels.ndim] if pixels.ndim == 4 else ("image", "y", "x")
    columns = {
        "pixels": Column(
            pixels,
            dims,
            "1",
            "original image",
            "counts",
            _per_chunk(pixels[:1].nbytes),
            {"white": float(images.white)},
        )
    }
    return columns if images.labels is None else columns | {"labels": _labels(images.labels[start:stop])}


def _labels(labels: np.ndarray) -> Column:
    return Column(np.ascontiguousarray(labels), ("image",), "1", "label", "counts", coordinate=True)


def shard_columns(experiment: Experiment, recorded: Recorded, shape: tuple[int, ...]) -> dict[str, Column]:
    """What is drawn and made for a shard of a light level; shape: as in `stream_columns`."""
    columns = stream_columns(recorded, shape)
    columns = store.smaller(columns) if experiment.small else columns
    return columns if experiment.on_reading else columns | reconstruction_columns(experiment, recorded, shape)


def coordinate_columns(columns: Iterable[str], numbers: range, labels: np.ndarray | None) -> dict[str, Column]:
    """`image` and `label` for each group that arrays of a shard lie in, which xarray takes for coordinates.

    columns: names of the arrays; numbers: of the images within the split; labels: where there are any. Raises
    InputError where an array has such a name already.
    """
    image = Column(np.array(numbers, np.int64), ("image",), "1", "number of the image in its split", "counts")
    found = {"image": image} if labels is None else {"image": image, "label": _labels(labels)}
    groups = {name.rpartition("/")[0] for name in columns}
    made = {f"{group}/{name}".lstrip("/"): column for group in groups for name, column in found.items()}
    if taken := sorted(made.keys() & set(columns)):
        raise InputError(f"{taken[0]}: is the name of a coordinate in every group of a shard; choose another name")
    return made


def stream_columns(recorded: Recorded, shape: tuple[int, ...]) -> dict[str, Column]:
    """The raw streams; shape: of one image, (rows, columns) or (channels, rows, columns)."""
    dims = ("image", "y", "x") if len(shape) == 2 else ("image", "channel", "y", "x")
    per_image = int(np.prod(shape))
    columns: dict[str, Column] = {}
    if recorded.tr is not None:
        columns |= _ragged(recorded.tr, "tr", "event", "since the start of the exposure", dims, shape, True)
        columns |= _cause_columns(recorded.tr, "tr", "event")
    if recorded.frames is not None:
        f = recorded.frames
        # a line is a row of pixels: its bits lie next to each other, and a large sensor is cut between lines
        lines = _packed(f.bits, f.frames, shape[-1])
        columns["frames/bits"] = Column(
            lines,
            ("line", "frame_byte"),
            "1",
            "QIS: is there a detection? A line of pixels each; one bit per frame, pixel after pixel, high bit first",
            "bits",
            _lines_per_chunk(lines.shape[1], per_image // shape[-1]),
            {
                "frames": f.frames,
                "columns": shape[-1],
                "lines_per_image": per_image // shape[-1],
                "bitorder": "big",
            },
        )
        if f.first is not None:
            columns |= _ragged(f.first, "frames", "first_event", "since the start of its frame", dims, shape, False)
        if f.cause is not None:
            columns |= _cause_columns(f.detections, "frames", "first_event")
    if recorded.tally is not None:
        columns["counts/frames"] = Column(
            recorded.tally.reshape(-1, *shape, recorded.tally.shape[1]),
            (*dims, "count_frame"),
            "1",
            "count frames of each pixel",
            "counts",
            _per_chunk(recorded.tally[0].nbytes * per_image),
        )
    return columns


def _cause_columns(events: Events, group: str, axis: str) -> dict[str, Column]:
    """What made each detection, where that was asked for; parents count from the start of their image."""
    if events.cause is None or events.parent is None:
        return {}
    starts = np.repeat(events.image_offsets[:-1], np.diff(events.image_offsets))
    parent = np.where(events.parent >= 0, events.parent - starts, events.parent).astype(np.int32)
    names = "a number of the manifest's list of causes"
    about = "which detection of its image caused it; -1: none, -2: one that was not recorded"
    return {
        f"{group}/cause": Column(events.cause, (axis,), "1", f"what made it: {names}", "counts", store.ROWS_OF_TICKS),
        f"{group}/parent": Column(parent, (axis,), "1", about, "counts", store.ROWS_OF_TICKS),
    }


def _read_causes(reader: ShardReader, group: str, start: int, stop: int, events: Events) -> None:
    """Give the events of some images their causes, where the shard has them."""
    if not reader.has(f"{group}/cause"):
        return
    if reader.has(f"{group}/starts"):
        first, last = (int(x) for x in reader.kept(f"{group}/starts")[[start, stop]])
    else:
        bits = reader.array_attributes("frames/bits")
        before = reader.read("frames/bits", 0, start * bits["lines_per_image"])
        first = int(np.bitwise_count(before).sum(dtype=np.int64))
        last = first + len(events)
    _check_stamps(reader, f"{group}/cause", first, last, len(events))
    events.cause = reader.read(f"{group}/cause", first, last)
    parent = reader.read(f"{group}/parent", first, last).astype(np.int64)
    starts = np.repeat(events.image_offsets[:-1], np.diff(events.image_offsets))
    events.parent = np.where(parent >= 0, parent + starts, parent)


def _packed(bits: np.ndarray, frames: int, columns: int) -> np.ndarray:
    """(lines, ceil(columns * frames / 8)) uint8 from (rows, ceil(frames / 8))."""
    if frames % 8 == 0:
        return bits.reshape(-1, columns * frames // 8)
    return kernels.pack_rows(bits, frames, columns)


def _per_chunk(size: int) -> int:
    """How many entries of so many bytes go into a chunk."""
    return int(max(1, min(_IMAGES_PER_CHUNK, _BYTES_PER_CHUNK // max(1, size))))


def _lines_per_chunk(size: int, per_image: int) -> int:
    """Whole images where they are small, else as many lines of `size` bytes as fit."""
    if size * per_image <= _BYTES_PER_CHUNK:
        return _per_chunk(size * per_image) * per_image
    return int(max(1, _BYTES_PER_CHUNK // size))


def _ragged(
    events: Events,
    group: str,
    axis: str,
    since: str,
    dims: tuple[str, ...],
    shape: tuple[int, ...],
    counted: bool,
) -> dict[str, Column]:
    """The stamps of a stream and where each image's begin.

    TR stamps are stored as differences within a pixel, which compress better, with the count of each pixel. STR
    stamps follow the bits of the frames, which say to which frame each belongs.
    """
    starts = events.offsets[:: events.pixels]
    name = "ticks" if events.ticks is not None else "times"
    values = events.ticks if events.ticks is not None else events.times
    about = f"time {since}, pixel after pixel"
    attributes: dict[str, Any] = {}
    unit = "s"
    if events.ticks is not None and events.tick is not None:
        unit = units.show(events.tick, "s", 12)
        attributes = {"tick_s": events.tick}
        if counted:
            values = kernels.row_differences(values, events.offsets)
            about += "; each pixel's first stamp, then differences"
            attributes["differences"] = 1
    columns = {
        f"{group}/{name}": Column(values, (axis,), unit, about, "ticks", store.ROWS_OF_TICKS, attributes),
        f"{group}/starts": Column(
            starts.astype(np.uint64),
            (f"{axis}_start",),
            "1",
            "where each image's stamps begin, and the end",
            "counts",
        ),
    }
    if counted:
        counts = events.counts
        kind = np.uint16 if not len(counts) or counts.max() < 2**16 else np.uint32
        columns[f"{group}/counts"] = Column(
            counts.astype(kind).reshape(-1, *shape),
            dims,
            "1",
            "recorded detections",
            "counts",
            _per_chunk(4 * events.pixels),
        )
    return columns


def reconstruction_columns(
    experiment: Experiment, recorded: Recorded, shape: tuple[int, ...], names: Sequence[str] | None = None
) -> dict[str, Column]:
    """Flux images by the config's methods (or `names`)."""
    dims = ("image", "y", "x") if len(shape) == 2 else ("image", "channel", "y", "x")
    columns = {}
    for name in experiment.methods if names is None else names:
        method = reconstruct.find(name)
        values, saturated = experiment.image(method, recorded)
        columns[f"reconstruction/{name}"] = Column(
            values.reshape(-1, *shape),
            dims,
            method.unit,
            method.summary().rstrip("."),
            "floats",
            _per_chunk(4 * int(np.prod(shape))),
            {"saturated_pixels": saturated},
        )
    return store.smaller(columns) if experiment.small else columns


def read_shard(reader: ShardReader, experiment: Experiment) -> tuple[Recorded, tuple[int, ...]]:
    """(the streams of a whole shard with their sums, shape of an image)."""
    tr, frames = None, None
    c = experiment.conditions
    if "tr" in experiment.readouts:
        n, *shape = reader.shape("tr/counts")
    elif "counts" in experiment.readouts:
        n, *shape = reader.shape("counts/frames")[:-1]
    else:
        lines = reader.array_attributes("frames/bits")["lines_per_image"]
        n = reader.shape("frames/bits")[0] // lines
        shape = list(experiment.sensor.layout.shape)
        shape = [lines // shape[0], *shape] if lines > shape[0] else shape
    pixels = int(np.prod(shape))
    if "tr" in experiment.readouts:
        tr = read_tr(reader, 0, n, pixels, experiment.sensor.tick)
    if set(experiment.readouts) & {"str", "qis"}:
        stamped = "str" in experiment.readouts
        frames = read_frames(reader, 0, n, pixels, experiment.sensor.tick, c.frames, c.frame_time, stamped)
    tally = None
    if "counts" in experiment.readouts:
        tally = reader.read("counts/frames").reshape(n * pixels, -1)
    return summarised(pixels, tr, frames, tally), tuple(shape)


@dataclass(frozen=True)
class OnReading:
    """Makes the fluxes of stored images from their streams: bit for bit those that would have been stored.

    image: as `Experiment.image`; pixels: of an image, of all channels; tick, frame_time: s.
    """

    image: Callable[[reconstruct.Method, Recorded], tuple[np.ndarray, int]]
    pixels: int
    tick: float
    frames: int
    frame_time: float

    @classmethod
    def of(cls, experiment: Experiment, like: Likeness) -> OnReading:
        """Those of an experiment's dataset."""
        c = experiment.conditions
        return cls(experiment.image, int(np.prod(like.shape)), like.tick, c.frames, c.frame_time)

    def fluxes(self, reader: ShardReader, name: str, start: int, stop: int) -> np.ndarray:
        """(images, pixels) float32 by the method `name`. Of the streams only what it needs is read."""
        method = reconstruct.find(name)
        values, _ = self.image(method, self._sums(reader, set(method.columns), start, stop))
        return values.reshape(stop - start, self.pixels)

    def _sums(self, reader: ShardReader, columns: set[str], start: int, stop: int) -> Recorded:
        tr, frames = None, None
        if columns == {"counts"}:
            counts = reader.read("tr/counts", start, stop).reshape(-1).astype(np.int32)
            return Recorded(self.pixels, counts=counts)
        if columns & {"counts", "span"}:
            tr = read_tr(reader, start, stop, self.pixels, self.tick)
        if columns & {"ones", "waited"}:
            stamped, facts = "waited" in columns, (self.tick, self.frames, self.frame_time)
            frames = read_frames(reader, start, stop, self.pixels, *facts, stamped)
        return summarised(self.pixels, tr, frames)


def _image(settings: reconstruct.Settings, method: reconstruct.Method, recorded: Recorded) -> tuple[np.ndarray, int]:
    return method.image(recorded, settings)


def read_tr(reader: ShardReader, start: int, stop: int, pixels: int, tick: float) -> Events:
    """The TR stream of some images of a shard."""
    events = _read_ragged(reader, "tr", start, stop, None, pixels, tick)
    _read_causes(reader, "tr", start, stop, events)
    return events


def read_frames(
    reader: ShardReader,
    start: int,
    stop: int,
    pixels: int,
    tick: float,
    frames: int,
    frame_time: float,
    stamped: bool,
) -> Frames:
    """The frames of some images of a shard; stamped: with the first stamps (STR)."""
    facts = reader.array_attributes("frames/bits")
    lines = reader.read("frames/bits", start * facts["lines_per_image"], stop * facts["lines_per_image"])
    whole_bytes = frames % 8 == 0
    bits = lines.reshape(-1, frames // 8) if whole_bytes else kernels.unpack_rows(lines, frames, facts["columns"])
    first = None
    if stamped:
        counts = np.bitwise_count(bits).sum(axis=1, dtype=np.int64)
        first = _read_ragged(reader, "frames", start, stop, counts, pixels, tick)
    found = Frames(bits, first, frames, frame_time, pixels)
    if not reader.has("frames/cause"):
        return found
    made = found.detections
    _read_causes(reader, "frames", start, stop, made)
    return Frames(bits, first, frames, frame_time, pixels, made.cause, made.parent)


def _read_ragged(
    reader: ShardReader, group: str, start: int, stop: int, counts: np.ndarray | None, pixels: int, tick: float
) -> Events:
    """The stamps of some images. counts: stamps of each pixel; None: they are read, too."""
    stamps = f"{group}/{'ticks' if tick > 0 else 'times'}"
    first, last = (int(x) for x in reader.kept(f"{group}/starts")[[start, stop]])
    if not 0 <= first <= last <= reader.shape(stamps)[0]:
        raise _disagreement(reader)
    wanted = (
        [(stamps, first, last)] if counts is not None else [(f"{group}/counts", start, stop), (stamps, first, last)]
    )
    *read, values = reader.read_each(*wanted)
    counts = read[0].reshape(-1) if counts is None else counts
    offsets = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=offsets[1:])
    if last - first != offsets[-1]:
        raise _disagreement(reader)
    if tick > 0:
        ticks = kernels.row_sums(values, offsets) if group == "tr" else values
        return Events(None, offsets, pixels, ticks, tick)
    return Events(values, offsets, pixels)


def _check_stamps(reader: ShardReader, name: str, first: int, last: int, count: int) -> None:
    """Raise InputError unless an array holds the entries `first` to `last`, which are `count`."""
    if last - first != count or not 0 <= first <= last <= reader.shape(name)[0]:
        raise _disagreement(reader)


def _disagreement(reader: ShardReader) -> InputError:
    return InputError(
        f"{reader.root / reader.path}: counts and stamps disagree; "
        f"spadmnist verify {quoted(str(reader.root))} says more"
    )


def statistics(experiment: Experiment, recorded: Recorded) -> dict[str, Any]:
    """What the manifest adds up over shards: per readout detections and empty pixels, and the number of detections
    of each cause (in TR; where there is none, in the frames); also the saturated pixels by method, where no fluxes are
    stored that say it.
    """
    out: dict[str, Any] = {}
    causes = experiment.sensor.causes
    tallied = None if recorded.tally is None else recorded.tally.sum(axis=1, dtype=np.int64)
    for readout, column in (("tr", recorded.counts), ("frames", recorded.ones), ("counts", tallied)):
        if column is not None:
            out[readout] = {
                "detections": int(column.sum(dtype=np.int64)),
                "empty_pixels": int(np.count_nonzero(column == 0)),
            }
    made = recorded.frames if recorded.tr is None else recorded.tr
    if made is not None and made.cause is not None:
        out["causes"] = dict(zip(causes, np.bincount(made.cause, minlength=len(causes)).tolist(), strict=True))
    if experiment.on_reading:
        methods = {name: reconstruct.find(name) for name in experiment.methods}
        out["saturated_pixels"] = {name: experiment.image(method, recorded)[1] for name, method in methods.items()}
    return out


# --- the manifest -------------------------------------------------------------------------------------------------


def canonical(value: Any) -> bytes:
    """JSON with sorted keys: the same bytes for the same value."""
    return (json.dumps(value, sort_keys=True, indent=1, ensure_ascii=True, allow_nan=False) + "\n").encode()


def seal(manifest: Mapping[str, Any]) -> bytes:
    """The manifest as bytes, with the digest of what the dataset is under `sha256`.

    Under `provenance` stands by what it was finished. It does not belong to what the dataset is, and has a digest of
    its own, `provenance_sha256`.
    """
    apart = ("sha256", "provenance", "provenance_sha256")
    body = {key: value for key, value in manifest.items() if key not in apart}
    sealed = {**body, "sha256": _digest(body)}
    if "provenance" in manifest:
        made_by = manifest["provenance"]
        sealed |= {"provenance": made_by, "provenance_sha256": _digest(made_by)}
    return canonical(sealed)


def _digest(value: Any) -> str:
    return hashlib.sha256(canonical(value)).hexdigest()


def read_manifest(root: Path | Source) -> tuple[dict[str, Any], bool]:
    """(manifest, is every byte of it as it was sealed?). Raises InputError where there is none to read."""
    path, mended = root / MANIFEST, ""
    if isinstance(root, Source):
        raw = _manifest_of(root)
    else:
        raw, mended = _manifest_in(root), f"; spadmnist verify {quoted(root)} --repair makes it again"
    try:
        manifest = from_json(raw)
        intact = isinstance(manifest, dict) and seal(manifest) == raw
    except ValueError as error:
        raise InputError(f"{path}: is damaged ({error}){mended}") from None
    if not isinstance(manifest, dict) or not str(manifest.get("format", "")).startswith("spadmnist-dataset/"):
        raise InputError(f"{path}: is not the manifest of a spadmnist dataset")
    if manifest["format"] != FORMAT:
        raise InputError(f"{path}: has format {manifest['format']}; this program reads {FORMAT}")
    if intact and (wrong := manifests.problems(manifest, str(path))):
        said = "; ".join(short(sentence, _LONGEST_SENTENCE) for sentence in wrong[:4])
        more = f" (and {len(wrong) - 4} more)" if len(wrong) > 4 else ""
        raise InputError(f"{said}{more}{mended}")
    if intact and isinstance(root, Source):
        root.hold(manifest["files"], manifest["sha256"])
    return manifest, intact


def _manifest_in(root: Path) -> bytes:
    path = root / MANIFEST
    if root.exists() and not root.is_dir():
        raise InputError(f"{root} is no folder; a dataset is a folder (spadmnist generate makes one from a config)")
    try:
        return disk.read_file(path, _LARGEST_MANIFEST)
    except FileNotFoundError:
        if (root / STATE).is_dir():
            raise InputError(
                f"{root} is not finished: type the command that makes it again, and it goes on where it stopped"
            ) from None
        if not root.exists():
            raise InputError(f"{root}: there is no such folder") from None
        raise InputError(f"{root} is not a dataset: it has no {MANIFEST}") from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); spadmnist verify {quoted(root)} says more"
        ) from None


def _manifest_of(source: Source) -> bytes:
    try:
        return source.document(MANIFEST, _LARGEST_MANIFEST)
    except FileNotFoundError:
        raise InputError(
            f"{source}: there is no {MANIFEST}; give the address of a dataset's folder, in which it lies"
        ) from None


def intact_manifest(root: Path | Source) -> dict[str, Any]:
    """The manifest as it was sealed. Raises InputError where it is not."""
    manifest, intact = read_manifest(root)
    if not intact:
        mended = "" if isinstance(root, Source) else f"; spadmnist verify {quoted(root)} --repair makes it again"
        raise InputError(f"{root / MANIFEST}: was changed{mended}")
    return manifest


# --- reading ------------------------------------------------------------------------------------------------------

T = TypeVar("T")
str_ = str  # within `Part` the name is a readout's


class _Backend(Protocol):
    """Where a part's data come from; ranges are of images."""

    def recorded(self, start: int, stop: int, what: str) -> Any: ...

    def reconstruction(self, method: str, start: int, stop: int) -> np.ndarray: ...

    def normalisation(self, method: str) -> float | None: ...

    def divisors(self, method: str, start: int, stop: int) -> np.ndarray | None: ...

    def originals(self, start: int, stop: int) -> np.ndarray: ...

    def labels(self) -> np.ndarray | None: ...

    def tiles(self) -> Tiles | None: ...

    def cuts(self, length: int, most: int) -> list[int]: ...


class Field(Generic[T]):
    """One kind of data of a part, by image: `[i]`, `[a:b:step]`, `[[3, 1, 2]]`, an array of numbers or a mask."""

    def __init__(self, length: int, get: Callable[[int, int], Any], one: Callable[[Any], Any]):
        self._length = length
        self._get = get
        self._one = one

    def __len__(self) -> int:
        return self._length

    @overload
    def __getitem__(self, index: int) -> T: ...

    @overload
    def __getitem__(self, index: slice | range | Sequence[int] | np.ndarray) -> Any: ...

    def __getitem__(self, index: Any) -> Any:
        found = indices_of(index, self._length)
        if isinstance(found, int):
            return self._one(self._get(found, found + 1))
        if isinstance(found, range) and found.step == 1:
            return self._get(found.start, max(found.start, found.stop))
        return gather(self._get, np.asarray(found))

    def __iter__(self) -> Iterator[T]:
        for i in range(self._length):
            yield self[i]


def _same(value: Any) -> Any:
    return value


def _first(value: Any) -> Any:
    return value[0]


class Reconstruction(Field[np.ndarray]):
    """Images of one method: `[i]` raw, (rows, columns) float32; `.normalised[i]` divided by `.normalisation`."""

    def __init__(self, length: int, backend: _Backend, method: str):
        self._backend = backend
        self.method = method
        super().__init__(length, partial(backend.reconstruction, method), _first)

    @cached_property
    def normalisation(self) -> float | None:
        """The median of the non-zero pixels of the training split; None where the method is not normalised.

        Raises SpadError for images of several levels, each of which has its own.
        """
        return self._backend.normalisation(self.method)

    @property
    def normalised(self) -> Field[np.ndarray]:
        return Field(self._length, self._divided, _first)

    def _divided(self, start: int, stop: int) -> np.ndarray:
        raw = self._backend.reconstruction(self.method, start, stop)
        by = self._backend.divisors(self.method, start, stop)
        return raw if by is None else raw / by.reshape(-1, *[1] * (raw.ndim - 1))


class Image:
    """One image of a part: its streams and fluxes, read as they are asked for; see `Part`.

    index: its number in the part; label: int, or None where the source has none; image: the 8-bit original.
    """

    def __init__(self, part: Part, index: int):
        self._part = part
        self.index = index

    def __repr__(self) -> str:
        return f"Image({self.index} of {self._part!r})"

    @property
    def label(self) -> int | None:
        return None if self._part.labels is None else int(self._part.labels[self.index])

    @property
    def image(self) -> np.ndarray:
        return self._part.images[self.index]

    @property
    def tr(self) -> Events:
        return self._part.tr[self.index]

    @property
    def frames(self) -> Frames:
        return self._part.frames[self.index]

    @property
    def counts(self) -> np.ndarray:
        return self._part.counts[self.index]

    @property
    def qis(self) -> np.ndarray:
        return self._part.qis[self.index]

    @property
    def str(self) -> np.ndarray:
        return self._part.str[self.index]

    def reconstruction(self, method: Any, normalised: bool = False) -> np.ndarray:
        """(rows, columns) float32: the flux by a method, divided by the training median where it is asked for."""
        field = self._part.reconstruction[method]
        return (field.normalised if normalised else field)[self.index]


class _ByMethod(dict[str, "Reconstruction"]):
    """The fluxes by method. Another name raises UnknownName."""

    def __missing__(self, name: str) -> Reconstruction:
        there = ", ".join(self) or "none"
        raise UnknownName(f"{name!r} is no method of this dataset; there are {there}.{did_you_mean(str(name), self)}")


class Part:
    """One split at one light level. Nothing of it needs the whole split in memory.

    tr: `Events` of an image's pixels, row by row; qis: (frames, rows, columns) uint8; str: (frames, rows, columns)
    float64, s, the frame time where there is no detection; reconstruction: by method; images: the originals;
    labels: (n,) uint8, or None where the source has none; tiles: of charts, `part.tiles.cut(image)` and
    `part.tiles.labels`; readouts: what was recorded; stored: read from a dataset, or simulated when it is asked for.
    Colour adds a leading channel axis. causes: what the numbers in `Events.cause` mean, where the causes were asked
    for.
    """

    def __init__(
        self,
        length: int,
        backend: _Backend,
        stored: bool,
        readouts: Sequence[str],
        methods: Sequence[str],
        shape: tuple[int, ...],
        causes: Sequence[str] = (),
    ):
        self._length = length
        self._backend = backend
        self.causes = tuple(causes)
        self.stored = stored
        self.readouts = tuple(readouts)
        self.shape = shape
        self.reconstruction: Mapping[str, Reconstruction] = _ByMethod(
            {name: Reconstruction(length, backend, name) for name in methods}
        )
        self.images: Field[np.ndarray] = Field(length, backend.originals, _first)

    def __len__(self) -> int:
        return self._length

    @overload
    def __getitem__(self, index: int) -> Image: ...

    @overload
    def __getitem__(self, index: slice | range | Sequence[int] | np.ndarray) -> Part: ...

    def __getitem__(self, index: Any) -> Image | Part:
        """An image with all that is known of it; of a slice, a list, an array of numbers or a mask: a smaller part."""
        found = indices_of(index, self._length)
        if isinstance(found, int):
            return Image(self, found)
        return self._of(_Chosen(self._backend, found), len(found))

    def __iter__(self) -> Iterator[Image]:
        return (Image(self, i) for i in range(self._length))

    def cuts(self, most: int = 1 << 62) -> list[int]:
        """Where reading may be cut: 0, the ends of shards, and the last image. Else no more than `most` apart."""
        return self._backend.cuts(self._length, most)

    def _of(self, backend: _Backend, length: int, stored: bool | None = None) -> Part:
        """The like, of other images."""
        stored = self.stored if stored is None else stored
        return Part(length, backend, stored, self.readouts, tuple(self.reconstruction), self.shape, self.causes)

    def __getstate__(self) -> dict[str_, Any]:
        """Labels are read again where the part is sent to."""
        return {key: value for key, value in self.__dict__.items() if key != "labels"}

    def __repr__(self) -> str:
        return f"Part({self._length} images of {self.shape}, {', '.join(self.readouts)})"

    @cached_property
    def labels(self) -> np.ndarray | None:
        return self._backend.labels()

    def to_dask(self, name: str_) -> Any:
        """A dask array of all images, image first, of which nothing is read until it is computed (extra `xarray`).

        name: `images`, a readout (`qis`: 0 or 1, `str`: s, `count_frames`: the readout `counts`) or a method of
        reconstruction (its unit). Raises SpadError where there is no such data or no dask.
        """
        return lazy.to_dask(self, name)

    @property
    def tiles(self) -> Tiles:
        """The tiles of the chart that these images are of. Raises SpadError where they are of none, or of several."""
        found = self._backend.tiles()
        if found is None:
            raise SpadError("these images are not of one chart; scene.images of a chart has source: chart")
        return found

    @property
    def frames(self) -> Field[Frames]:
        """QIS and STR as they are stored: bits packed, and the stamps of those that are set."""
        what: Any = "str" if "str" in self.readouts else "qis"
        self._recorded(what)
        return Field(self._length, partial(self._backend.recorded, what=what), _same)

    @property
    def tr(self) -> Field[Events]:
        self._recorded("tr")
        return Field(self._length, partial(self._backend.recorded, what="tr"), _same)

    @property
    def counts(self) -> Field[np.ndarray]:
        """The readout `counts`: (count frames, rows, columns) unsigned."""
        self._recorded("counts")
        return Field(self._length, self._tally, _first)

    def _tally(self, start: int, stop: int) -> np.ndarray:
        rows = self._backend.recorded(start, stop, "counts")
        dense = rows.reshape(stop - start, *self.shape, rows.shape[-1])
        # behind the image (and its channel): the frames, then rows and columns
        return np.moveaxis(dense, -1, len(self.shape) - 1)

    @property
    def qis(self) -> Field[np.ndarray]:
        self._recorded("qis")
        return Field(self._length, partial(self._frames, what="qis", unpack=Frames.unpacked), _first)

    @property
    def str(self) -> Field[np.ndarray]:
        self._recorded("str")
        return Field(self._length, partial(self._frames, what="str", unpack=Frames.stamps), _first)

    def _frames(self, start: int, stop: int, what: Any, unpack: Callable[[Frames], np.ndarray]) -> np.ndarray:
        dense = unpack(self._backend.recorded(start, stop, what))
        n, frames, _ = dense.shape
        dense = dense.reshape(n, frames, *self.shape)
        # colour: the channel leads, then frames, rows, columns
        return np.moveaxis(dense, 2, 1) if len(self.shape) == 3 else dense

    def _recorded(self, readout: Any) -> None:
        if readout not in self.readouts:
            raise SpadError(f"{readout} was not recorded here; there are {', '.join(self.readouts)}")


class Dataset:
    """Light levels, each with its splits: `dataset["5 mlux", "train"]`; see `open`."""

    def __init__(
        self,
        levels: Sequence[Level],
        splits: Mapping[str, int],
        part: Callable[[Level, Any], Part],
        source: str,
    ):
        self._levels = tuple(levels)
        self._splits = dict(splits)
        self._part = part
        self._source = source
        self._parts: dict[tuple[str, str], Part] = {}

    @property
    def levels(self) -> tuple[str, ...]:
        """As written in the config."""
        return tuple(level.text for level in self._levels)

    @property
    def lux(self) -> tuple[float, ...]:
        """White of each level in lux. Raises SpadError where the levels are irradiances (see `irradiance`)."""
        return self._values("lux")

    @property
    def irradiance(self) -> tuple[float, ...]:
        """White of each level in W/m^2. Raises SpadError where the levels are lux."""
        return self._values("irradiance")

    def _values(self, kind: str) -> tuple[float, ...]:
        if self._levels[0].kind != kind:
            raise SpadError(f"the light levels here are given as {self._levels[0].kind}, not as {kind}")
        return tuple(level.value for level in self._levels)

    @property
    def splits(self) -> tuple[str, ...]:
        return tuple(self._splits)

    def __len__(self) -> int:
        """Number of light levels."""
        return len(self._levels)

    def __repr__(self) -> str:
        sizes = ", ".join(f"{n} {split}" for split, n in self._splits.items())
        return f"Dataset({self._source}: {sizes}; {', '.join(self.levels)})"

    def to_xarray(self, level: str, split: str | None = None) -> Any:
        """An xarray.Dataset of one split at one level, read where it is computed (extra `xarray`).

        Coordinates: `image` (its number), `label` where there are labels, and `lux` (or `irradiance`, W/m^2).
        Variables: `original`, each method, and the readouts of one size for every image: `qis` (0 or 1), `str` (s) and
        `count_frames` (the readout `counts`).
        """
        found = level_of(self._levels, level)
        part = self[level] if split is None else self[level, split]
        return lazy.to_xarray(part, found.kind, found.value)

    def __getitem__(self, key: str | tuple[str, str]) -> Part:
        level_text, split = key if isinstance(key, tuple) else (key, None)
        level = level_of(self._levels, level_text)
        if split is None:
            if len(self._splits) > 1:
                names = " and ".join(self._splits)
                raise UnknownName(f"there are the splits {names}; say which, for example ds[{level_text!r}, 'train']")
            split = next(iter(self._splits))
        if split not in self._splits:
            raise UnknownName(f"{split!r} is not a split here; there are {', '.join(self._splits)}")
        if (level.text, split) not in self._parts:
            self._parts[level.text, split] = self._part(level, split)
        return self._parts[level.text, split]


class _Stored:
    """A part of a finished dataset."""

    def __init__(
        self,
        root: Path | Source,
        encoding: Encoding,
        shards: Sequence[Shard],
        originals: Sequence[Shard],
        files: Mapping[str, Files],
        like: Likeness,
        facts: dict[str, Any],
        on_reading: OnReading | None,
    ):
        self._on_reading = on_reading
        self._shards = [(s.start, s.stop, s.reader(root, encoding, like, files)) for s in shards]
        self._originals = [(s.start, s.stop, s.reader(root, encoding, like, files)) for s in originals]
        self._facts = facts

    def _pieces(self, shards: Any, start: int, stop: int) -> Iterator[tuple[ShardReader, int, int]]:
        if start == stop and shards:  # an empty range still has a type
            yield shards[0][2], 0, 0
        for first, last, reader in shards:
            if first < stop and last > start and start < stop:
                yield reader, max(start, first) - first, min(stop, last) - first

    def recorded(self, start: int, stop: int, what: str) -> Any:
        parts = [self._read(reader, a, b, what) for reader, a, b in self._pieces(self._shards, start, stop)]
        if what == "tr":
            return Events.join(parts)
        return _joined(parts) if what == "counts" else Frames.join(parts)

    def _read(self, reader: ShardReader, start: int, stop: int, what: str) -> Any:
        f = self._facts
        if what == "tr":
            return read_tr(reader, start, stop, f["pixels"], f["tick"])
        if what == "counts":
            return reader.read("counts/frames", start, stop).reshape(stop - start, f["pixels"], -1)
        return read_frames(reader, start, stop, f["pixels"], f["tick"], f["frames"], f["frame_time"], what == "str")

    def reconstruction(self, method: str, start: int, stop: int) -> np.ndarray:
        pieces, made = self._pieces(self._shards, start, stop), self._on_reading
        if made is None:
            return read_joined(list(pieces), f"reconstruction/{method}")
        fluxes = _joined([made.fluxes(reader, method, a, b) for reader, a, b in pieces])
        return fluxes.reshape(-1, *self._facts["shape"])

    def normalisation(self, method: str) -> float | None:
        return self._facts["normalisation"].get(method)

    def divisors(self, method: str, start: int, stop: int) -> np.ndarray | None:
        return _alike(self.normalisation(method), start, stop)

    def originals(self, start: int, stop: int) -> np.ndarray:
        return read_joined(list(self._pieces(self._originals, start, stop)), "pixels")

    def labels(self) -> np.ndarray | None:
        if not self._originals[0][2].has("labels"):
            return None
        return np.concatenate([reader.read("labels") for _, _, reader in self._originals])

    def tiles(self) -> Tiles | None:
        facts = self._facts["tiles"]
        return None if facts is None else of_facts(facts, self._facts["size"])

    def cuts(self, length: int, most: int) -> list[int]:
        return [start for start, _, _ in self._shards] + [length]


def _even_cuts(length: int, most: int) -> list[int]:
    return [*range(0, length, max(1, min(most, length or 1))), length]


def _alike(normalisation: float | None, start: int, stop: int) -> np.ndarray | None:
    return None if normalisation is None else np.full(stop - start, np.float32(normalisation))


def _joined(arrays: list[np.ndarray]) -> np.ndarray:
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


class _Simulated:
    """A part that is made when it is asked for; the last range is kept."""

    def __init__(
        self, experiment: Experiment, level: Level, split: str, splits: Mapping[str, Images], images_dir: Path | None
    ):
        self._experiment = experiment
        self._level = level
        self._split = split
        self._splits = splits
        self._images_dir = images_dir  # another process reads the images there again
        self._last: tuple[tuple[int, int], Recorded] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Without the images; with the normalisations where they are known."""
        return {key: value for key, value in self.__dict__.items() if key not in ("_splits", "_last")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _last=None)
        self._splits = self._experiment.load_images(self._images_dir)

    def _make(self, start: int, stop: int) -> Recorded:
        if self._last is None or self._last[0] != (start, stop):
            images = self._splits[self._split]
            self._last = (
                (start, stop),
                self._experiment.simulate(self._level, self._split, images, start, stop),
            )
        return self._last[1]

    def recorded(self, start: int, stop: int, what: str) -> Any:
        made = self._make(start, stop)
        if what == "counts" and made.tally is not None:
            return made.tally.reshape(stop - start, -1, made.tally.shape[-1])
        return made.tr if what == "tr" else made.frames

    def reconstruction(self, method: str, start: int, stop: int) -> np.ndarray:
        values, _ = self._experiment.image(reconstruct.find(method), self._make(start, stop))
        return values.reshape(-1, *self._splits[self._split].pixels.shape[1:])

    @cached_property
    def _normalisations(self) -> dict[str, float | None]:
        """All methods in one go: the training split is simulated twice, whatever their number."""
        split = next(iter(self._splits))
        images = self._splits[split]
        methods = {name: reconstruct.find(name) for name in self._experiment.methods}
        wanted = self._experiment.wanted(images)

        def chunks() -> Iterator[dict[str, np.ndarray]]:
            for start in range(0, wanted, 256):
                made = self._experiment.simulate(self._level, split, images, start, min(start + 256, wanted))
                image = self._experiment.image
                yield {name: image(m, made)[0] for name, m in methods.items() if m.normalised}

        return medians_of_nonzero(chunks)

    def normalisation(self, method: str) -> float | None:
        return self._normalisations[method] if reconstruct.find(method).normalised else None

    def divisors(self, method: str, start: int, stop: int) -> np.ndarray | None:
        return _alike(self.normalisation(method), start, stop)

    def originals(self, start: int, stop: int) -> np.ndarray:
        return self._splits[self._split].pixels[start:stop]

    def labels(self) -> np.ndarray | None:
        labels = self._splits[self._split].labels
        return None if labels is None else labels[: self._experiment.wanted(self._splits[self._split])]

    def tiles(self) -> Tiles | None:
        return self._splits[self._split].tiles

    def cuts(self, length: int, most: int) -> list[int]:
        return _even_cuts(length, most)


class _Chosen:
    """Some images of a part."""

    def __init__(self, inner: _Backend, indices: range | np.ndarray):
        self._inner, self._indices = inner, indices

    def _read(self, get: Callable[[int, int], Any], start: int, stop: int) -> Any:
        chosen = self._indices[start:stop]
        if isinstance(chosen, range) and chosen.step == 1:
            return get(chosen.start, max(chosen.start, chosen.stop))
        return gather(get, np.asarray(chosen, np.int64))

    def recorded(self, start: int, stop: int, what: str) -> Any:
        return self._read(partial(self._inner.recorded, what=what), start, stop)

    def reconstruction(self, method: str, start: int, stop: int) -> np.ndarray:
        return np.asarray(self._read(partial(self._inner.reconstruction, method), start, stop))

    def normalisation(self, method: str) -> float | None:
        return self._inner.normalisation(method)

    def divisors(self, method: str, start: int, stop: int) -> np.ndarray | None:
        chosen = np.asarray(self._indices[start:stop], np.int64)
        if not len(chosen):
            return None
        found = self._inner.divisors(method, int(chosen.min()), int(chosen.max()) + 1)
        return None if found is None else found[chosen - chosen.min()]

    def originals(self, start: int, stop: int) -> np.ndarray:
        return np.asarray(self._read(self._inner.originals, start, stop))

    def labels(self) -> np.ndarray | None:
        labels = self._inner.labels()
        return None if labels is None else labels[np.asarray(self._indices, np.int64)]

    def tiles(self) -> Tiles | None:
        return self._inner.tiles()

    def cuts(self, length: int, most: int) -> list[int]:
        return _even_cuts(length, most)


class _Concatenated:
    """The images of several parts, one after the other."""

    def __init__(self, parts: Sequence[tuple[_Backend, int]]):
        self._parts = [backend for backend, _ in parts]
        self._starts = np.cumsum([0, *(length for _, length in parts)])

    def _pieces(self, start: int, stop: int) -> list[tuple[_Backend, int, int]]:
        found = [
            (backend, int(max(start, low) - low), int(min(stop, high) - low))
            for backend, low, high in zip(self._parts, self._starts, self._starts[1:], strict=False)
            if low < stop and start < high
        ]
        return found or [(self._parts[0], 0, 0)]

    def recorded(self, start: int, stop: int, what: str) -> Any:
        return join([backend.recorded(a, b, what) for backend, a, b in self._pieces(start, stop)])

    def reconstruction(self, method: str, start: int, stop: int) -> np.ndarray:
        return np.asarray(join([backend.reconstruction(method, a, b) for backend, a, b in self._pieces(start, stop)]))

    def normalisation(self, method: str) -> float | None:
        found = {backend.normalisation(method) for backend in self._parts}
        if len(found) > 1:
            raise SpadError(f"{method}: each light level has a normalisation of its own; .normalised divides by it")
        return found.pop()

    def divisors(self, method: str, start: int, stop: int) -> np.ndarray | None:
        found = [(backend.divisors(method, a, b), b - a) for backend, a, b in self._pieces(start, stop)]
        if all(by is None for by, _ in found):
            return None
        return np.concatenate([np.ones(n, np.float32) if by is None else by for by, n in found])

    def originals(self, start: int, stop: int) -> np.ndarray:
        return np.asarray(join([backend.originals(a, b) for backend, a, b in self._pieces(start, stop)]))

    def labels(self) -> np.ndarray | None:
        found = [backend.labels() for backend in self._parts]
        known = [labels for labels in found if labels is not None]
        return np.concatenate(known) if len(known) == len(found) else None

    def tiles(self) -> Tiles | None:
        """Those of a chart that all parts show."""
        found = [backend.tiles() for backend in self._parts]
        facts = [None if tiles is None else tiles.facts() for tiles in found]
        return found[0] if all(one == facts[0] for one in facts) else None

    def cuts(self, length: int, most: int) -> list[int]:
        sizes = np.diff(self._starts).tolist()
        inner = [backend.cuts(n, most) for backend, n in zip(self._parts, sizes, strict=True)]
        return [int(start) + cut for start, cuts in zip(self._starts, inner, strict=False) for cut in cuts[:-1]] + [
            length
        ]


def concatenate(parts: Sequence[Part]) -> Part:
    """One part of the images of several, one after the other: of other light levels, splits or datasets.

    It has the readouts and methods that all of them have; `normalised` divides each image by the median of its own
    level. Raises SpadError where their images differ in size, or nothing is in all of them.
    """
    parts = list(parts)
    if not parts:
        raise SpadError("there is no part to concatenate; give one or more")
    first = parts[0]
    for part in parts:
        if part.shape != first.shape:
            raise SpadError(
                f"images of {part.shape} and of {first.shape} differ in size; concatenate those of one size"
            )
        if part.causes != first.causes:
            raise SpadError("the causes of detections differ between the parts; concatenate those of one sensor")
    readouts = [name for name in first.readouts if all(name in part.readouts for part in parts)]
    methods = [name for name in first.reconstruction if all(name in part.reconstruction for part in parts)]
    if not readouts:
        raise SpadError("the parts have no readout in common; concatenate those that were recorded alike")
    backend = _Concatenated([(part._backend, len(part)) for part in parts])
    stored = all(part.stored for part in parts)
    return Part(sum(map(len, parts)), backend, stored, readouts, methods, first.shape, first.causes)


def open(
    path: str | Path,
    images_dir: str | Path | None = None,
    plugin: Sequence[str | Path] = (),
    cache: str | Path | None = None,
) -> Dataset:
    """Open a dataset: its folder, a zip of it, or its address (`https://`, `http://`, `s3://`: extra `remote`).

    Of a config file every image is simulated when it is asked for. images_dir: where the images of a config are looked
    for; plugin: files with effects that a config names; cache: folder for what was read from an address, default
    `$SPADMNIST_CACHE` or the system's place for it. Raises InputError or ConfigError with a sentence.
    """
    for file in plugin:
        plugins.load_file(file)
    root = at(path, cache)
    if isinstance(root, Source):
        return stored(root)
    if not root.exists():
        raise InputError(f"{root}: there is no such dataset or config file")
    if not root.is_dir():
        return simulated(config.read(root), Path(images_dir) if images_dir is not None else None)
    return stored(root)


def at(path: str | Path, cache: str | Path | None = None) -> Path | Source:
    """A place that a user named: a path, or the source that a zip or an address is; cache: see `open`."""
    if not remote.is_url(path):
        return remote.at(path)
    return remote.at(path, (cache_folder() if cache is None else Path(cache)) / "remote")


def simulated(experiment: Experiment, images_dir: Path | None = None) -> Dataset:
    """The dataset of an experiment, made on demand."""
    splits = experiment.load_images(images_dir)
    any_split = next(iter(splits.values()))
    shape = any_split.pixels.shape[1:]

    def part(level: Level, split: str) -> Part:
        backend = _Simulated(experiment, level, split, splits, images_dir)
        length = experiment.wanted(splits[split])
        names = experiment.sensor.causes if experiment.causes else ()
        return Part(length, backend, False, experiment.readouts, experiment.methods, shape, names)

    sizes = {split: experiment.wanted(images) for split, images in splits.items()}
    return Dataset(experiment.levels, sizes, part, experiment.name)


def stored(root: Path | Source) -> Dataset:
    """A finished dataset. Only its manifest is read here; checksums are compared as the data are read."""
    manifest = intact_manifest(root)
    levels = [Level(x["text"], x["kind"], x["value"]) for x in manifest["levels"]]
    shards = [Shard(**x) for x in manifest["shards"]]
    like = Likeness.of(manifest)
    shape, encoding = like.shape, encoding_in(manifest, root)
    files = files_by_shard(manifest["files"], encoding)
    facts = {
        "shape": shape,
        "pixels": int(np.prod(shape)),
        "tick": like.tick,
        "frames": like.frames,
        "frame_time": manifest["settings"]["frame_time"],
    }

    made = _on_reading(root, manifest, like)

    def part(level: Level, split: str) -> Part:
        mine = [s for s in shards if s.level == level.text and s.split == split]
        originals = [s for s in shards if s.level is None and s.split == split]
        own = {**facts, "normalisation": manifest["normalisation"][level.text]}
        own |= {"tiles": manifest["images"]["splits"][split].get("tiles"), "size": shape[-2:]}
        backend = _Stored(root, encoding, mine, originals, files, like, own, made)
        readouts, methods = manifest["config"]["recording"]["readouts"], manifest["config"]["reconstruct"]
        length = manifest["images"]["splits"][split]["images"]
        return Part(length, backend, True, readouts, methods, shape, manifest.get("causes", ()))

    order = dict.fromkeys(shard.split for shard in shards)
    sizes = {split: manifest["images"]["splits"][split]["images"] for split in order}
    return Dataset(levels, sizes, part, str(root))


def _on_reading(root: Path | Source, manifest: Mapping[str, Any], like: Likeness) -> OnReading | None:
    """What makes the fluxes of a dataset that stores none.

    Colour needs the sensor, which decides how many of each channel's photons are detected: raises ConfigError where it
    has an effect that is not known here, and InputError where the dataset is no folder.
    """
    kept, settings = manifest["config"], reconstruct.Settings(**manifest["settings"])
    if kept["output"].get("reconstructions") != "on_reading":
        return None
    if not isinstance(kept["scene"]["wavelength"], list):
        image = partial(_image, settings)
        return OnReading(image, int(np.prod(like.shape)), like.tick, like.frames, settings.frame_time)
    if isinstance(root, Source):
        raise InputError(
            f"{root}: its flux images are in colour and are made when they are read, which needs the dataset's folder; "
            "bring it here and open that"
        )
    return OnReading.of(config.build(document.parse(document.dump(kept), str(root / CONFIG)), root), like)


def encoding_in(manifest: Mapping[str, Any], root: Path | Source) -> Encoding:
    """How the shards of a dataset are written. Raises InputError where this program does not know it."""
    try:
        return store.encoding(manifest["config"]["output"]["format"], held(manifest)["encoding"])
    except InputError as error:
        raise InputError(f"{root / MANIFEST}: {error}") from None


def shards_in(manifest: Mapping[str, Any]) -> list[Shard]:
    """The shards that a manifest lists."""
    return [Shard(**x) for x in manifest["shards"]]


__all__ = ["Dataset", "Files", "Part", "open"]
