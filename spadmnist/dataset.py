"""What a dataset holds, and how it is read.

    out/manifest.json                      every file with its size and SHA-256, and its own digest
    out/config.yaml                        the config with nothing left open
    out/maps/                              maps of the sensor that came from files
    out/data/images/<split>/<shard>...     the original images and labels
    out/data/<level>/<split>/<shard>...    streams and reconstructions

`open` reads a finished dataset, or simulates one on demand from its config: bit for bit the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, overload

import numpy as np

from . import config, document, lazy, plugins, reconstruct, remote
from .disk import Files
from .errors import InputError, SpadError, UnknownName, did_you_mean
from .events import Events
from .experiment import Experiment, Level, level_of
from .gather import BLOCK, gather, indices_of, join
from .images import Images, cache_folder
from .manifest_file import CONFIG, encoding_in, intact_manifest
from .readout import Frames, Recorded
from .reconstruct import medians_of_nonzero
from .shard_columns import OnReading, image_of, read_frames, read_tr
from .shard_plan import Likeness, Shard, files_by_shard
from .sources import Source
from .store import Encoding, ShardReader, read_joined
from .tiles import Tiles, of_facts

# --- reading ------------------------------------------------------------------------------------------------------

T = TypeVar("T")
str_ = str  # within `Part` the name is a readout's


class _Backend(Protocol):
    """Where a part's data come from; ranges are of images.

    Attributes:
        block: images that are read, or simulated, with each other anyway.
    """

    block: int

    def recorded(self, start: int, stop: int, what: str) -> Any: ...

    def reconstruction(self, method: str, start: int, stop: int) -> np.ndarray: ...

    def normalisation(self, method: str) -> float | None: ...

    def divisors(self, method: str, start: int, stop: int) -> np.ndarray | None: ...

    def originals(self, start: int, stop: int) -> np.ndarray: ...

    def labels(self) -> np.ndarray | None: ...

    def tiles(self) -> Tiles | None: ...

    def cuts(self, length: int, most: int) -> list[int]: ...


class Field(Generic[T]):
    """One kind of data of a part, by image: `[i]`, `[a:b:step]`, `[[3, 1, 2]]`, an array of numbers or a mask.

    What is asked for is read, or simulated, then. Of one number it gives the data of that image, otherwise those of
    several images, (images, ...) of arrays. It has a length and can be iterated over.
    """

    def __init__(
        self,
        length: int,
        get: Callable[[int, int], Any],
        one: Callable[[Any], Any],
        block: int,
        unpacked: Callable[[Any], Any] | None = None,
    ):
        self._length = length
        self._get = get
        self._one = one
        self._block = block
        self._unpacked = unpacked or _same

    def __len__(self) -> int:
        return self._length

    @overload
    def __getitem__(self, index: int) -> T: ...

    @overload
    def __getitem__(self, index: slice | range | Sequence[int] | np.ndarray) -> Any: ...

    def __getitem__(self, index: Any) -> Any:
        found = indices_of(index, self._length)
        if isinstance(found, int):
            return self._one(self._unpacked(self._get(found, found + 1)))
        if isinstance(found, range) and found.step == 1:
            return self._unpacked(self._get(found.start, max(found.start, found.stop)))
        return self._unpacked(gather(self._get, np.asarray(found), self._block))

    def __iter__(self) -> Iterator[T]:
        for i in range(self._length):
            yield self[i]


def _same(value: Any) -> Any:
    return value


def _first(value: Any) -> Any:
    return value[0]


class Reconstruction(Field[np.ndarray]):
    """Flux images of one method, a `Field`: `[i]` is (rows, columns) float32, raw, in the unit of the method."""

    def __init__(self, length: int, backend: _Backend, method: str):
        self._backend = backend
        self.method = method
        super().__init__(length, partial(backend.reconstruction, method), _first, backend.block)

    @cached_property
    def normalisation(self) -> float | None:
        """The median of the non-zero pixels of the training split; None where the method is not normalised.

        Raises SpadError for images of several levels, each of which has its own.
        """
        return self._backend.normalisation(self.method)

    @property
    def normalised(self) -> Field[np.ndarray]:
        """The same divided by `normalisation`, 1; raw where the method is not normalised."""
        return Field(self._length, self._divided, _first, self._block)

    def _divided(self, start: int, stop: int) -> np.ndarray:
        raw = self._backend.reconstruction(self.method, start, stop)
        by = self._backend.divisors(self.method, start, stop)
        return raw if by is None else raw / by.reshape(-1, *[1] * (raw.ndim - 1))


class Image:
    """One image of a part: its streams and fluxes, read, or simulated, as they are asked for.

    Attributes:
        index: its number in the part.
    """

    def __init__(self, part: Part, index: int):
        self._part = part
        self.index = index

    def __repr__(self) -> str:
        return f"Image({self.index} of {self._part!r})"

    @property
    def label(self) -> int | None:
        """Its label; None where the source has none."""
        return None if self._part.labels is None else int(self._part.labels[self.index])

    @property
    def image(self) -> np.ndarray:
        """The original, as the source has it: (rows, columns) uint8, uint16 or float32."""
        return self._part.images[self.index]

    @property
    def tr(self) -> Events:
        """TR: the detections of its pixels as `spadmnist.Events`, row by row."""
        return self._part.tr[self.index]

    @property
    def frames(self) -> Frames:
        """QIS and STR as they are stored, bits packed."""
        return self._part.frames[self.index]

    @property
    def counts(self) -> np.ndarray:
        """(count frames, rows, columns) unsigned: the readout `counts`."""
        return self._part.counts[self.index]

    @property
    def qis(self) -> np.ndarray:
        """(frames, rows, columns) uint8, 0 or 1."""
        return self._part.qis[self.index]

    @property
    def str(self) -> np.ndarray:
        """(frames, rows, columns) float64, s since the start of the frame; the frame time without a detection."""
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

    `part[i]` is one image, `part[a:b]` a smaller part. Colour adds a leading channel axis to each image.

    Attributes:
        images: the originals, a `Field`.
        reconstruction: flux images by method, a `Reconstruction` each.
        readouts: what was recorded, of `tr`, `str`, `qis`, `counts`.
        shape: of an image, (rows, columns), or (channels, rows, columns).
        stored: read from a dataset, or simulated when it is asked for.
        causes: what the numbers in `Events.cause` mean, where the causes were asked for.
    """

    images: Field[np.ndarray]
    reconstruction: Mapping[str_, Reconstruction]
    readouts: tuple[str_, ...]
    shape: tuple[int, ...]
    stored: bool
    causes: tuple[str_, ...]

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
        self.reconstruction = _ByMethod({name: Reconstruction(length, backend, name) for name in methods})
        self.images = Field(length, backend.originals, _first, backend.block)

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
        """(images,) uint8; None where the source has none."""
        return self._backend.labels()

    def to_dask(self, name: str_) -> Any:
        """A dask array of all images, image first, of which nothing is read until it is computed (extra `xarray`).

        name: `images`, a readout (`qis`: 0 or 1, `str`: s, `count_frames`: the readout `counts`) or a method of
        reconstruction (its unit). Raises SpadError where there is no such data or no dask.
        """
        return lazy.to_dask(self, name)

    @property
    def tiles(self) -> Tiles:
        """The tiles of the chart that these images are of: `tiles.cut(image)`, `tiles.labels`.

        Raises SpadError where they are of none, or of several.
        """
        found = self._backend.tiles()
        if found is None:
            raise SpadError("these images are not of one chart; scene.images of a chart has source: chart")
        return found

    @property
    def frames(self) -> Field[Frames]:
        """QIS and STR as they are stored: bits packed, and the stamps of those that are set."""
        what: Any = "str" if "str" in self.readouts else "qis"
        return self.packed(what)

    @property
    def tr(self) -> Field[Events]:
        """TR: `Events` of an image's pixels, row by row."""
        return self.packed("tr")

    @property
    def counts(self) -> Field[np.ndarray]:
        """The readout `counts`: (count frames, rows, columns) unsigned."""
        return self.of_frames("counts")

    @property
    def qis(self) -> Field[np.ndarray]:
        """QIS: (frames, rows, columns) uint8, 0 or 1."""
        return self.of_frames("qis")

    @property
    def str(self) -> Field[np.ndarray]:
        """STR: (frames, rows, columns) float64, s since the start of the frame; the frame time without a detection."""
        return self.of_frames("str")

    def packed(self, readout: Any) -> Field[Any]:
        """A readout as it is stored: `Events` of TR, `Frames` of QIS and STR; of counts (images, pixels, count frames).

        Raises SpadError where it was not recorded.
        """
        if readout not in self.readouts:
            raise SpadError(f"{readout} was not recorded here; there are {', '.join(self.readouts)}")
        return Field(self._length, partial(self._backend.recorded, what=readout), _same, self._backend.block)

    def unpacked(self, readout: Any, packed: Any, kind: type[np.floating] = np.float64) -> np.ndarray:
        """Frames of several images, (images, frames, rows, columns), of `packed`; of colour the channel leads them.

        kind: of stamps (s), which are floats.
        """
        if readout == "counts":
            dense = packed.reshape(len(packed), *self.shape, packed.shape[-1])
            # behind the image (and its channel): the frames, then rows and columns
            return np.moveaxis(dense, -1, len(self.shape) - 1)
        dense = packed.unpacked() if readout == "qis" else packed.stamps(kind)
        n, frames, _ = dense.shape
        dense = dense.reshape(n, frames, *self.shape)
        # colour: the channel leads, then frames, rows, columns
        return np.moveaxis(dense, 2, 1) if len(self.shape) == 3 else dense

    def of_frames(self, readout: Any, kind: type[np.floating] = np.float64) -> Field[np.ndarray]:
        """A readout of frames, unpacked after its images were gathered. kind: of stamps (s)."""
        packed = self.packed(readout)
        return Field(self._length, packed._get, _first, packed._block, partial(self.unpacked, readout, kind=kind))


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
        """Their names, "train" and "test" for one."""
        return tuple(self._splits)

    def __len__(self) -> int:
        """Number of light levels."""
        return len(self._levels)

    def keys(self) -> tuple[str, ...]:
        """The light levels, as a mapping has them: `levels`."""
        return self.levels

    def __iter__(self) -> Iterator[str]:
        """The light levels, as written in the config."""
        return iter(self.levels)

    def __contains__(self, key: object) -> bool:
        """Is there a light level, or a split at a light level (`("5 mlux", "train")`)?"""
        level, split = key if isinstance(key, tuple) and len(key) == 2 else (key, None)
        try:
            return isinstance(level, str) and bool(level_of(self._levels, level)) and split in (None, *self._splits)
        except UnknownName:
            return False

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
        if isinstance(key, tuple) and len(key) != 2:
            raise UnknownName(f"{key!r} is not a part; give a level and a split, ds['5 mlux', 'train']")
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

    block = BLOCK

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


class _Scene:
    """An experiment and its images, which another process reads again when it needs them."""

    def __init__(self, experiment: Experiment, images_dir: Path | None):
        self.experiment = experiment
        self._images_dir = images_dir

    def __getstate__(self) -> dict[str, Any]:
        """Without the images."""
        return {key: value for key, value in self.__dict__.items() if key != "splits"}

    @cached_property
    def splits(self) -> Mapping[str, Images]:
        return self.experiment.load_images(self._images_dir)

    def part(self, level: Level, split: str) -> Part:
        """One that is simulated when it is asked for."""
        one, images = self.experiment, self.splits[split]
        names = one.sensor.causes if one.causes else ()
        backend, shape = _Simulated(self, level, split), images.pixels.shape[1:]
        return Part(one.wanted(images), backend, False, one.readouts, one.methods, shape, names)


class _Simulated:
    """A part that is made when it is asked for; the last range is kept."""

    def __init__(self, scene: _Scene, level: Level, split: str):
        self._scene = scene
        self._experiment = scene.experiment
        self.block = scene.experiment.sensor.block
        self._level = level
        self._split = split
        self._last: tuple[tuple[int, int], Recorded] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Without what was made last; with the normalisations where they are known."""
        return {**self.__dict__, "_last": None}

    @property
    def _splits(self) -> Mapping[str, Images]:
        return self._scene.splits

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
        one = reconstruct.find(method)
        return reconstruct.divisor(one, self._normalisations[method]) if one.normalised else None

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
        self.block = inner.block

    def _read(self, get: Callable[[int, int], Any], start: int, stop: int) -> Any:
        chosen = self._indices[start:stop]
        if isinstance(chosen, range) and chosen.step == 1:
            return get(chosen.start, max(chosen.start, chosen.stop))
        return gather(get, np.asarray(chosen, np.int64), self.block)

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
        self.block = min(backend.block for backend in self._parts)
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
    plugin: Sequence[str | Path] | None = (),
    cache: str | Path | None = None,
) -> Dataset:
    """Open a dataset: its folder, a zip of it, or its address (`https://`, `http://`, `s3://`: extra `remote`).

    Of a config file every image is simulated when it is asked for. images_dir: where the images of a config are looked
    for; plugin: files with effects that a config names; cache: folder for what was read from an address, default
    `$SPADMNIST_CACHE` or the system's place for it. Raises InputError or ConfigError with a sentence.
    """
    plugins.load_files(plugin, "plugin")
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
    scene = _Scene(experiment, images_dir)
    sizes = {split: experiment.wanted(images) for split, images in scene.splits.items()}
    return Dataset(experiment.levels, sizes, scene.part, experiment.name)


@dataclass(frozen=True)
class _Store:
    """A finished dataset, of which only the manifest was read."""

    root: Path | Source
    manifest: Mapping[str, Any]
    shards: Sequence[Shard]
    encoding: Encoding
    files: Mapping[str, Files]
    like: Likeness
    made: OnReading | None

    def part(self, level: Level, split: str) -> Part:
        """One that is read when it is asked for."""
        mine = [s for s in self.shards if s.level == level.text and s.split == split]
        originals = [s for s in self.shards if s.level is None and s.split == split]
        manifest, like, shape = self.manifest, self.like, self.like.shape
        of_split = manifest["images"]["splits"][split]
        facts = {
            "shape": shape,
            "pixels": int(np.prod(shape)),
            "tick": like.tick,
            "frames": like.frames,
            "frame_time": manifest["settings"]["frame_time"],
            "normalisation": manifest["normalisation"][level.text],
            "tiles": of_split.get("tiles"),
            "size": shape[-2:],
        }
        backend = _Stored(self.root, self.encoding, mine, originals, self.files, like, facts, self.made)
        readouts, methods = manifest["config"]["recording"]["readouts"], manifest["config"]["reconstruct"]
        return Part(of_split["images"], backend, True, readouts, methods, shape, manifest.get("causes", ()))


def stored(root: Path | Source) -> Dataset:
    """A finished dataset. Only its manifest is read here; checksums are compared as the data are read."""
    manifest = intact_manifest(root)
    levels = [Level(x["text"], x["kind"], x["value"]) for x in manifest["levels"]]
    shards = [Shard(**x) for x in manifest["shards"]]
    like = Likeness.of(manifest)
    encoding = encoding_in(manifest, root)
    files, made = files_by_shard(manifest["files"], encoding), _on_reading(root, manifest, like)
    store = _Store(root, manifest, shards, encoding, files, like, made)
    order = dict.fromkeys(shard.split for shard in shards)
    sizes = {split: manifest["images"]["splits"][split]["images"] for split in order}
    return Dataset(levels, sizes, store.part, str(root))


def _on_reading(root: Path | Source, manifest: Mapping[str, Any], like: Likeness) -> OnReading | None:
    """What makes the fluxes of a dataset that stores none.

    Colour needs the sensor, which decides how many of each channel's photons are detected: raises ConfigError where it
    has an effect that is not known here, and InputError where the dataset is no folder.
    """
    kept, settings = manifest["config"], reconstruct.Settings(**manifest["settings"])
    if kept["output"].get("reconstructions") != "on_reading":
        return None
    if not isinstance(kept["scene"]["wavelength"], list):
        image = partial(image_of, settings)
        return OnReading(image, int(np.prod(like.shape)), like.tick, like.frames, settings.frame_time)
    if isinstance(root, Source):
        raise InputError(
            f"{root}: its flux images are in colour and are made when they are read, which needs the dataset's folder; "
            "bring it here and open that"
        )
    return OnReading.of(config.build(document.parse(document.dump(kept), str(root / CONFIG)), root), like)


__all__ = ["Dataset", "Files", "Part", "open"]
