"""What a shard holds: streams and reconstructions as columns, and back."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import packing, reconstruct, store, units
from .errors import InputError
from .events import Events
from .experiment import Experiment
from .foreign import quoted
from .images import Images
from .readout import Frames, Recorded, summarised
from .shard_plan import Likeness
from .store import Column, ShardReader

_BYTES_PER_CHUNK = 4 * 2**20
_IMAGES_PER_CHUNK = 32  # one image is read in 0.1 ms, and twice as many would compress only 0.5 % better


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


def recorded_columns(experiment: Experiment, recorded: Recorded, shape: tuple[int, ...]) -> dict[str, Column]:
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
    return packing.pack_rows(bits, frames, columns)


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
            values = packing.row_differences(values, events.offsets)
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


def image_of(settings: reconstruct.Settings, method: reconstruct.Method, recorded: Recorded) -> tuple[np.ndarray, int]:
    """(flux image of one method, number of its saturated pixels) of recorded images."""
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
    bits = lines.reshape(-1, frames // 8) if whole_bytes else packing.unpack_rows(lines, frames, facts["columns"])
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
        ticks = packing.row_sums(values, offsets) if group == "tr" else values
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
