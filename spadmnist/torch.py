"""Datasets for PyTorch: sets by index, a shuffled stream, transforms of events, and images that are simulated afresh.

    import spadmnist.torch as st
    loader = DataLoader(st.Fluxes(part), batch_size=64, shuffle=True, num_workers=2)

An item is (tensor or `Events`, int label); the label is -1 where the images have none. Nothing here holds an open file:
workers may be forked, spawned or kept. torch is the user's own; it is imported here and where LeNet is
trained (`spadmnist.experiments`), and only when that is asked for.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

try:
    import torch
    from torch.utils.data import Dataset, IterableDataset, default_collate, get_worker_info
except ImportError:
    raise ImportError(
        "spadmnist.torch needs PyTorch, which is not installed: pip install 'spadmnist[train]' (on Linux this takes "
        "gigabytes of CUDA; https://pytorch.org/get-started tells how to install the build for CPUs)"
    ) from None

from . import config, grids, reconstruct
from .dataset import Part
from .errors import SpadError
from .events import Events as EventBatch
from .experiment import Experiment, Level
from .gather import indices_of, join
from .grids import structured
from .image_files import pixels_of
from .photos import Making
from .readout import READOUTS
from .readout import Frames as PackedFrames
from .sensor import Sensor

_IN_MEMORY = 1 << 30  # bytes of fluxes up to which a set is read once and kept: MNIST at five levels
_BUFFER = 4  # pieces whose images a stream shuffles together: shards of at most some 80 MB, held as they are stored
_PIECE = 256  # images of a piece where nothing is stored in shards
_NO_LABEL = -1


# --- sets by index ------------------------------------------------------------------------------------------------


class _Set(Dataset[Any]):
    """Map-style: `[i]` is an item; `__getitems__` gives those of a batch, read by blocks."""

    def __init__(self, part: Part):
        self.part = part

    def __len__(self) -> int:
        return len(self.part)

    def _read(self, indices: np.ndarray) -> Sequence[Any]:
        raise TypeError(f"{type(self).__name__} must define _read")

    def __getitems__(self, indices: Sequence[int]) -> list[tuple[Any, int]]:
        chosen = np.asarray(indices_of(indices, len(self)))
        return list(zip(self._read(chosen), _labels(self.part, chosen), strict=True))

    def __getitem__(self, index: int) -> tuple[Any, int]:
        return self.__getitems__([index])[0]


class Fluxes(_Set):
    """Flux images of a method: items of a (channels, rows, columns) float32 tensor and the label.

    Up to 1 GB of them are read once and kept in memory; more are read as they are asked for.

    Args:
        part: of a dataset, a `spadmnist.Part`.
        method: the reconstruction.
        normalised: divided by the training median of the level, where the method has one.

    Raises:
        SpadError: for a method that the part lacks.
    """

    def __init__(self, part: Part, method: str = "counts", normalised: bool = True):
        super().__init__(part)
        self.method, self.normalised = _method(part, method), normalised
        _ = self._field  # in the parent: a part that is simulated works the median out, once
        self._kept: torch.Tensor | None = None
        self._keeps = len(part) * int(np.prod(part.shape)) * 4 <= _IN_MEMORY
        if self._keeps:
            self._keep()

    @property
    def _field(self) -> Any:
        found = self.part.reconstruction[self.method]
        return found.normalised if self.normalised else found

    def _keep(self) -> torch.Tensor:
        if self._kept is None:
            self._kept = torch.from_numpy(_with_channel(self._field[:], self.part))
        return self._kept

    def __getstate__(self) -> dict[str, Any]:
        """Another process reads the images itself."""
        return {**self.__dict__, "_kept": None}

    def _read(self, indices: np.ndarray) -> Sequence[torch.Tensor]:
        if self._keeps:
            return self._keep()[torch.from_numpy(indices)].unbind()
        return torch.from_numpy(_with_channel(self._field[indices], self.part)).unbind()


class Frames(_Set):
    """Frames: items of a (frames, rows, columns) tensor, colour a leading channel axis, and the label.

    Args:
        part: of a dataset, a `spadmnist.Part`.
        readout: "qis" (uint8, 0 or 1), "str" (float32, s since the start of the frame, the frame time where there is no
            detection) or "counts" (int32).

    Raises:
        SpadError: for a readout that was not recorded.
    """

    def __init__(self, part: Part, readout: str = "qis"):
        super().__init__(part)
        if readout not in ("qis", "str", "counts") or readout not in part.readouts:
            there = ", ".join(r for r in part.readouts if r != "tr") or "none"
            raise SpadError(f"{readout!r} is no readout of frames that was recorded here; there are {there}")
        self.readout = readout

    def _read(self, indices: np.ndarray) -> Sequence[torch.Tensor]:
        return _frames(self.part, self.readout, indices).unbind()


class Events(_Set):
    """Time stamps (TR): items of a `spadmnist.Events` of one image, or what `transform` makes of it, and the label.

    Collate them with `collate_packed`, `collate_padded` or `collate_nested`.

    Args:
        part: of a dataset, a `spadmnist.Part`.
        transform: called with the events of an image, `ToFrames` for one.

    Raises:
        SpadError: where TR was not recorded.
    """

    def __init__(self, part: Part, transform: Callable[[EventBatch], Any] | None = None):
        super().__init__(part)
        _check_transform(transform)
        self.transform = transform
        _ = part.tr  # says so where TR was not recorded

    def _read(self, indices: np.ndarray) -> Sequence[Any]:
        batch = self.part.tr[indices]
        return [_transformed(batch.images(i, i + 1), self.transform) for i in range(len(indices))]


def _method(part: Part, method: str) -> str:
    if method not in part.reconstruction:
        there = ", ".join(part.reconstruction) or "none"
        raise SpadError(f"{method!r} is no reconstruction of this part; there are {there}")
    return method


def _labels(part: Part, indices: np.ndarray) -> list[int]:
    labels = part.labels
    return [_NO_LABEL] * len(indices) if labels is None else [int(x) for x in labels[indices]]


def _with_channel(images: np.ndarray, part: Part) -> np.ndarray:
    return images if len(part.shape) == 3 else images[:, None]


def _frames(part: Part, readout: str, index: Any) -> torch.Tensor:
    return _of_frames(readout, part.of_frames(readout, np.float32)[index])


def _of_frames(readout: str, found: np.ndarray) -> torch.Tensor:
    kind = np.int32 if readout == "counts" else found.dtype
    return torch.from_numpy(np.ascontiguousarray(found.astype(kind, copy=False)))


def _transformed(events: EventBatch, transform: Callable[[EventBatch], Any] | None) -> Any:
    return events if transform is None else transform(events)


def _check_transform(transform: Any, of_events: bool = True, instead: str = "") -> None:
    """Raise SpadError for a transform that is no function, or where there are no events. instead: what to do."""
    if transform is not None and not of_events:
        raise SpadError(f"transform: is called with events, and {instead}, or leave transform out")
    if transform is not None and not callable(transform):
        raise SpadError(f"transform: is {transform!r:.80}; it is a function of events, for example ToFrames(...)")


# --- a shuffled stream --------------------------------------------------------------------------------------------


class Stream(IterableDataset[Any]):
    """What `stream` returns: items in an order of chance, read shard by shard."""

    def __init__(
        self, part: Part, kind: str, method: str | None, seed: int, rank: int, world: int, transform: Any, buffer: int
    ):
        if not 0 <= rank < world:
            raise SpadError(f"rank: {rank} of {world} is not possible; ranks are 0 to {world - 1}")
        if buffer < 1:
            raise SpadError(f"buffer: {buffer} pieces are not possible; give 1 or more")
        self.part, self.kind, self.seed, self.rank, self.world = part, kind, seed, rank, world
        self.transform, self.buffer = transform, buffer
        self._method = method
        self._epoch = _Shared()
        self._by_workers = _Shared()  # 1 where workers make the pass that was begun last
        self._given = _Given()
        self._done, self._at = 0, 0  # items of the pass that this process began last, and its epoch
        self._cuts = part.cuts(_PIECE)
        if kind == "events":
            _ = part.tr
        elif kind == "fluxes":
            self._method = _method(part, method or "counts")
            _ = part.reconstruction[self._method].normalised[:0]
        elif kind == "frames":
            known = [r for r in ("qis", "str", "counts") if r in part.readouts]
            self._method = Frames(part, method or (known or ["qis"])[0]).readout
        else:
            raise SpadError(f"kind: {kind!r} is not possible; it is events, fluxes or frames")
        if kind == "events" and method is not None:
            raise SpadError("method: events have none; leave it out, or take kind='fluxes'")
        _check_transform(transform, kind == "events", f"kind={kind!r} has none; take kind='events'")

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, which gives another order from the next pass on. It reaches workers that are kept."""
        self._epoch.value = epoch
        self._by_workers.value = 0

    def __len__(self) -> int:
        """Items of this rank, over all its workers."""
        total = len(self.part)
        return (self.rank + 1) * total // self.world - self.rank * total // self.world

    def _share(self) -> tuple[int, int]:
        """(which consumer this is, of how many): workers of rank 0 first."""
        info = get_worker_info()
        workers, worker = (1, 0) if info is None else (info.num_workers, info.id)
        return self.rank * workers + worker, self.world * workers

    def _made_of(self) -> dict[str, Any]:
        """All that the order of the items, and what they are, depends on, but for the epoch."""
        consumer, consumers = self._share()
        return {
            "kind": self.kind,
            "method": self._method,
            "length": len(self.part),
            "shards": hashlib.sha256(repr(self._cuts).encode()).hexdigest()[:16],
            "buffer": self.buffer,
            "seed": self.seed,
            "consumer": consumer,
            "consumers": consumers,
        }

    def state_dict(self) -> dict[str, Any]:
        """How far this process has come: kept and given back by `load_state_dict`, the same stream goes on there.

        Each worker has a state of its own, which only that worker can tell. Raises SpadError outside of them.
        """
        if get_worker_info() is None and self._by_workers.value:
            raise SpadError(
                "the stream is iterated by workers, each of which has a state of its own; take it there, as "
                "torchdata's StatefulDataLoader does, or call set_epoch first, for the state of an epoch's beginning"
            )
        epoch = self._epoch.value
        return {**self._made_of(), "epoch": epoch, "done": self._done if self._at == epoch else 0}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was taken, in the next pass if that is of the same epoch.

        Raises SpadError where it is of another stream, worker or rank.
        """
        own = self._made_of()
        if missing := [name for name in (*own, "epoch", "done") if name not in state]:
            raise SpadError(f"the state says no {missing[0]}; give one that state_dict of this version returned")
        for name, value in own.items():
            if state[name] != value:
                raise SpadError(
                    f"the state is of {name} {state[name]}, but this stream has {value}; make the stream as the one "
                    "that the state is of, or begin anew"
                )
        epoch, done = int(state["epoch"]), int(state["done"])
        self._epoch.value, self._done, self._at, self._by_workers.value = epoch, done, epoch, 0
        if get_worker_info() is not None:
            self._given = _Given()  # what a worker is given is for that one alone
        self._given.put(epoch, done, own["consumer"], own["consumers"])

    def _skipped(self, epoch: int) -> int:
        """How many items the pass that begins leaves out: those that the state it goes on from had given.

        Raises SpadError where those were shared out among other workers.
        """
        at, done, *of = self._given.numbers()
        here = self._share()
        if done and at == epoch and tuple(of) != here:
            raise SpadError(
                f"the state that was loaded is of consumer {of[0]} of {of[1]}, but this is consumer {here[0]} of "
                f"{here[1]} (ranks and their workers are counted from 0); iterate with as many workers as when it was "
                "taken, let torchdata's StatefulDataLoader keep a state for each worker, or call set_epoch to begin "
                "another epoch"
            )
        self._given.put()  # the pass after this one is whole
        return done if at == epoch else 0

    def _pieces(self, epoch: int) -> list[tuple[int, int]]:
        """(start, stop) of images of this consumer, in the order of an epoch: whole shards, cut at its two ends.

        The shards follow one another in an order of chance, and each consumer has an equal share of their images.
        """
        consumer, consumers = self._share()
        cuts = self._cuts
        order = self._random(epoch, "order").permutation(len(cuts) - 1)
        total = len(self.part)
        low, high = consumer * total // consumers, (consumer + 1) * total // consumers
        found, at = [], 0
        for k in order:
            start, stop = cuts[k], cuts[k + 1]
            first, last = max(low - at, 0), min(high - at, stop - start)
            if first < last:
                found.append((start + first, start + last))
            at += stop - start
        return found

    def _random(self, epoch: int, *names: Any) -> np.random.Generator:
        text = "/".join(map(str, (self.seed, epoch, *names)))
        words = np.frombuffer(hashlib.sha256(text.encode()).digest(), "<u4")
        return np.random.Generator(np.random.Philox(np.random.SeedSequence(words.tolist())))

    def __iter__(self) -> Iterator[tuple[Any, int]]:
        epoch = self._epoch.value  # of the whole pass, whatever is set meanwhile
        skipped = self._skipped(epoch)
        self._by_workers.value = int(get_worker_info() is not None)
        self._done, self._at = skipped, epoch
        pieces = self._pieces(epoch)
        for k in range(0, len(pieces), self.buffer):
            group = pieces[k : k + self.buffer]
            numbers = np.concatenate([np.arange(*piece) for piece in group])
            if skipped >= len(numbers):
                skipped -= len(numbers)
                continue
            order = self._random(epoch, "buffer", self._share()[0], k).permutation(len(numbers))[skipped:]
            skipped = 0
            items, labels = self._loaded(group), _labels(self.part, numbers)
            for i in order.tolist():
                self._done += 1
                yield items(i), labels[i]

    def _loaded(self, group: Sequence[tuple[int, int]]) -> Callable[[int], Any]:
        ranges = [slice(*piece) for piece in group]
        if self.kind == "events":
            batch = join([self.part.tr[piece] for piece in ranges])
            return lambda i: _transformed(batch.images(i, i + 1), self.transform)
        if self.kind == "fluxes":
            assert self._method is not None
            field = self.part.reconstruction[self._method].normalised
            images = _with_channel(np.concatenate([field[piece] for piece in ranges]), self.part)
            return torch.from_numpy(images).unbind().__getitem__
        assert self._method is not None
        packed, readout = join([self.part.packed(self._method)[piece] for piece in ranges]), self._method
        if isinstance(packed, PackedFrames):
            packed = replace(packed, cause=None, parent=None)

        def item(i: int) -> torch.Tensor:
            one = packed[i : i + 1] if isinstance(packed, np.ndarray) else packed.images(i, i + 1)
            return _of_frames(readout, self.part.unpacked(readout, one, np.float32)[0])

        return item


def stream(
    part: Part,
    kind: str = "events",
    method: str | None = None,
    seed: int = 0,
    rank: int = 0,
    world: int = 1,
    transform: Callable[[EventBatch], Any] | None = None,
    buffer: int = _BUFFER,
) -> Stream:
    """Items of a part in an order of chance, each once over all workers and ranks; an iterable set for a DataLoader.

    The order is a function of the seed, the epoch (`set_epoch`), and the numbers of workers and ranks.

    Args:
        part: of a dataset, a `spadmnist.Part`.
        kind: "events" (items of `Events`), "fluxes" (of `Fluxes`, normalised) or "frames" (of `Frames`).
        method: of fluxes the reconstruction, by default counts; of frames the readout, by default the first of qis,
            str, counts that was recorded.
        seed: of the order.
        rank, world: which of how many processes this is; each gets as many items as another, or one more.
        transform: called with the events of an image.
        buffer: number of shards whose images are shuffled together, and held in memory, frames as they are stored.

    Returns:
        Stream: it iterates over (data, label).

    Raises:
        SpadError: for a kind, method, rank or buffer that is not possible.
    """
    return Stream(part, kind, method, seed, rank, world, transform, buffer)


class _Shared:
    """A whole number that workers see when it is changed, forked or spawned."""

    def __init__(self) -> None:
        self._cell = torch.zeros(1, dtype=torch.int64).share_memory_()

    @property
    def value(self) -> int:
        return int(self._cell[0])

    @value.setter
    def value(self, value: int) -> None:
        if value < 0:
            raise SpadError(f"epoch: {value} is not possible; epochs count from 0")
        self._cell[0] = value


class _Given:
    """A state with which no pass has begun yet, as workers see it, too: those that are kept, forked or spawned."""

    def __init__(self) -> None:
        self._cells = torch.zeros(4, dtype=torch.int64).share_memory_()

    def put(self, epoch: int = 0, done: int = 0, consumer: int = 0, consumers: int = 0) -> None:
        """Give another one; by default none. done: items that it has had; consumer, consumers: of `Stream._share`."""
        self._cells[:] = torch.tensor([epoch, done, consumer, consumers])

    def numbers(self) -> list[int]:
        """[epoch, done, consumer, consumers]; done is 0 where there is none."""
        return [int(x) for x in self._cells]


# --- batches of events --------------------------------------------------------------------------------------------


class Packed(NamedTuple):
    """Events of several images, one after the other.

    Attributes:
        times: (events,) float64, s.
        pixel: (events,) int64, within its image.
        offsets: (images + 1,) int64, where each image's events begin, and the end.
        labels: (images,) int64.
    """

    times: torch.Tensor
    pixel: torch.Tensor
    offsets: torch.Tensor
    labels: torch.Tensor


class Padded(NamedTuple):
    """Events of several images, as many to each as the longest has.

    Attributes:
        times: (images, most) float64, s, 0 behind the last.
        pixel: (images, most) int64, within its image, 0 behind the last.
        mask: (images, most) bool, true where there is an event.
        labels: (images,) int64.
    """

    times: torch.Tensor
    pixel: torch.Tensor
    mask: torch.Tensor
    labels: torch.Tensor


class Nested(NamedTuple):
    """Events of several images as jagged nested tensors.

    Attributes:
        times: (images, events of each) float64, s.
        pixel: (images, events of each) int64, within its image.
        labels: (images,) int64.
    """

    times: torch.Tensor
    pixel: torch.Tensor
    labels: torch.Tensor


def collate_packed(items: Sequence[tuple[EventBatch, int]]) -> Packed:
    """Items of `Events` as one `Packed`. Raises SpadError for items that are no events."""
    events = [one for one, _ in items]
    for one in events:
        if not isinstance(one, EventBatch):
            raise SpadError(f"collate: {type(one).__name__} are no events; leave the transform out, or this collate")
    offsets = np.cumsum([0, *map(len, events)])
    times = torch.from_numpy(np.concatenate([one.times for one in events]))
    pixel = torch.from_numpy(np.concatenate([one.pixel for one in events]))
    return Packed(times, pixel, torch.from_numpy(offsets), torch.tensor([label for _, label in items]))


def collate_padded(items: Sequence[tuple[EventBatch, int]]) -> Padded:
    """Items of `Events` as one `Padded`."""
    packed = collate_packed(items)
    counts = packed.offsets.diff()
    mask = torch.arange(int(counts.max()))[None, :] < counts[:, None]
    times = torch.zeros(mask.shape, dtype=packed.times.dtype)
    pixel = torch.zeros(mask.shape, dtype=packed.pixel.dtype)
    times[mask], pixel[mask] = packed.times, packed.pixel
    return Padded(times, pixel, mask, packed.labels)


def collate_nested(items: Sequence[tuple[EventBatch, int]]) -> Nested:
    """Items of `Events` as one `Nested`."""
    packed = collate_packed(items)
    nested = [torch.nested.nested_tensor_from_jagged(x, packed.offsets) for x in (packed.times, packed.pixel)]
    return Nested(nested[0], nested[1], packed.labels)


# --- transforms of events -----------------------------------------------------------------------------------------


class ToFrames(grids.Frames):
    """Detections in `frames` bins of equal time, as a float32 tensor (frames, rows, columns); as `grids.Frames`."""

    def __call__(self, events: EventBatch) -> torch.Tensor:
        return torch.from_numpy(super().__call__(events))


class ToVoxelGrid(grids.VoxelGrid):
    """Detections shared out between two bins, as a float32 tensor (bins, rows, columns); as `grids.VoxelGrid`."""

    def __call__(self, events: EventBatch) -> torch.Tensor:
        return torch.from_numpy(super().__call__(events))


class ToTimeSurface(grids.TimeSurface):
    """Time since the last detection, fading, as a float32 tensor (bins, rows, columns); as `grids.TimeSurface`."""

    def __call__(self, events: EventBatch) -> torch.Tensor:
        return torch.from_numpy(super().__call__(events))


class ToStructured:
    """The events of an image as a structured array x, y, t, p, which the transforms of tonic take.

    What it returns is that of `grids.structured`.

    Args:
        columns: of the image.
        unit: of t, s; None for whole ticks of the converter.
    """

    def __init__(self, columns: int, unit: float | None = None):
        self.columns, self.unit = columns, unit

    def __call__(self, events: EventBatch) -> np.ndarray:
        return structured(events, self.columns, self.unit)


# --- images that are simulated as they are asked for ----------------------------------------------------------------


class Simulated(Dataset[Any]):
    """Any map-style set of images, seen by a sensor: fresh photons in every epoch, never the same noise twice.

    In epoch 0, at one level, image i is image i of `generate` with the same seed and split. `set_epoch` begins another
    epoch, in workers that are kept, too.

    Args:
        images: items of an image, or of (image, label): PIL images, arrays or tensors of (rows, columns), (channels,
            rows, columns) or PIL's (rows, columns, 3); unsigned integers, or floats from 0 to 1. PIL images are read
            as a folder's pictures are: palettes are their colours, what is transparent is black.
        sensor: as `read_sensor` gives it.
        recording: a mapping, as in a config. `readouts` may be left out: then what `returns` needs is recorded.
        lux: a level (lux, or as "5 mlux"), or (low, high): then each image has a level of its own in each epoch, drawn
            evenly on a logarithmic scale.
        returns: the name of a reconstruction, for items of a float32 tensor (channels, rows, columns); or a readout:
            "tr" (items of `spadmnist.Events`), "qis", "str" or "counts" (tensors as of `Frames`). "counts" is the
            readout where the recording has `bits` or lists `counts` among its readouts, and else the reconstruction.
        split, seed: they name the streams of random numbers.
        wavelength: of the light, m, or as "555 nm".
        scale: a reconstruction is divided by it; a readout has none.
        transform: called with the events of an image; for "tr" alone.

    Raises:
        SpadError: for arguments that are not possible, or do not apply with the others, for images of another size
            than the sensor's, and for an image that is asked for a second time in one epoch.
    """

    def __init__(
        self,
        images: Any,
        sensor: Sensor,
        *,
        recording: Mapping[str, Any],
        lux: Any,
        returns: str = "counts",
        split: str = "train",
        seed: int = 0,
        wavelength: float | str = 555e-9,
        scale: float = 1.0,
        transform: Callable[[EventBatch], Any] | None = None,
    ):
        self.images, self.split, self.returns, self.scale, self.transform = images, split, returns, scale, transform
        levels = list(lux) if isinstance(lux, tuple | list | np.ndarray) else [lux]
        if len(levels) not in (1, 2) or not all(isinstance(one, str | int | float | np.number) for one in levels):
            raise SpadError(f"lux: is {lux!r:.80}; give one level, or (low, high), as 0.005 or '5 mlux'")
        self._method, readouts = _asked_for(returns, recording)
        number = isinstance(scale, int | float | np.number) and not isinstance(scale, bool)
        if not number or not 0 < scale < np.inf:
            raise SpadError(f"scale: is {scale!r:.80}; it is a number of more than 0")
        if self._method is None and scale != 1:
            raise SpadError(f"scale: divides a reconstruction, and returns={returns!r} is a readout; leave scale out")
        _check_transform(transform, self._method is None and returns == "tr", f"returns={returns!r}; take returns='tr'")
        methods = [] if self._method is None else [self._method]
        self.experiment: Experiment = config.of_sensor(
            sensor, {**recording, "readouts": readouts}, levels, wavelength, methods, seed
        )
        self.range = self.experiment.levels if len(levels) == 2 else None
        if self.range and not self.range[0].value < self.range[1].value:
            raise SpadError(f"lux: {self.range[0].text} is not below {self.range[1].text}; give (low, high)")
        self._epoch = _Shared()
        self._seen = torch.zeros(len(images), dtype=torch.uint8).share_memory_()

    def __len__(self) -> int:
        return len(self.images)

    def set_epoch(self, epoch: int) -> None:
        """Begin an epoch, before a pass: all images may be asked for again, and each epoch has its own photons."""
        self._epoch.value = epoch
        self._seen.zero_()

    def __getitem__(self, index: int) -> tuple[Any, int]:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[tuple[Any, int]]:
        chosen = np.asarray(indices_of(indices, len(self)))
        epoch = self._epoch.value
        again = [int(i) for i in chosen if self._seen[int(i)]]
        if again or len(set(chosen.tolist())) < len(chosen):
            raise SpadError(
                f"image {again[0] if again else int(chosen[0])} was simulated in epoch {epoch} already, and would have "
                f"the same noise again; call set_epoch({epoch + 1}) before the next pass"
            )
        self._seen[torch.from_numpy(chosen)] = 1
        block = self.experiment.sensor.block
        if block == 1:
            return self._simulated(chosen, np.arange(len(chosen)), epoch)
        found: dict[int, tuple[Any, int]] = {}
        for first in np.unique(chosen // block) * block:
            mine = chosen[chosen // block * block == first]
            whole = np.arange(first, min(first + block, len(self)))
            found.update(zip(mine.tolist(), self._simulated(whole, mine - first, epoch), strict=True))
        return [found[int(i)] for i in chosen]

    def _simulated(self, numbers: np.ndarray, wanted: np.ndarray, epoch: int) -> list[tuple[Any, int]]:
        """The items `wanted` of the images `numbers`: one block, or any where the sensor has none."""
        shown = [_image(self.images[int(i)], f"image {i}") for i in numbers]
        layout, first = self.experiment.sensor.layout, shown[0].pixels
        for i, one in zip(numbers, shown, strict=True):
            if one.pixels.shape[-2:] != layout.shape:
                size = " x ".join(map(str, one.pixels.shape[-2:]))
                raise SpadError(
                    f"the images are {size} pixels, but the sensor {layout.rows} x {layout.columns}; resize them"
                )
            if one.pixels.shape != first.shape:
                raise SpadError(
                    f"image {i} is {_kind(one.pixels)}, but image {numbers[0]} {_kind(first)}; convert all to one kind"
                )
        if self.experiment.sensor.block > 1:
            return self._together(numbers, shown, wanted, epoch)
        # light is worked out as exactly as its pixels are held: each kind for itself, as it is alone
        kinds = [(one.pixels.dtype, one.white) for one in shown]
        found: dict[int, tuple[Any, int]] = {}
        for kind in dict.fromkeys(kinds):
            mine = np.array([i for i, its in enumerate(kinds) if its == kind])
            some = self._together(numbers[mine], [shown[i] for i in mine], np.arange(len(mine)), epoch)
            found.update(zip(mine.tolist(), some, strict=True))
        return [found[int(i)] for i in wanted]

    def _together(
        self, numbers: np.ndarray, shown: Sequence[_Shown], wanted: np.ndarray, epoch: int
    ) -> list[tuple[Any, int]]:
        """The items `wanted` of images that are simulated in one go; numbers: theirs."""
        layout, first = self.experiment.sensor.layout, shown[0].pixels
        # in the first epoch the streams are those of `generate`
        split = self.split if epoch == 0 else f"{self.split}/epoch {epoch}"
        images, level = [one.pixels for one in shown], self.experiment.levels[0]
        if self.range is not None:
            brightest = self.range[1]
            level = Level(f"{self.range[0].text} to {brightest.text}", "lux", brightest.value)
            split = f"{split}/{self.range[0].key}"
            shares = self._levels(numbers, epoch) / brightest.value
            images = [image * share for image, share in zip(images, shares, strict=True)]
        white = shown[0].white
        if any(one.white != white for one in shown):
            images, white = [image / one.white for image, one in zip(images, shown, strict=True)], 1.0
        made = self.experiment.simulate_numbered(level, split, np.stack(images), white, numbers)
        labels = [shown[int(i)].label for i in wanted]
        channels = first.shape[:-2]
        if self._method is not None:
            values, _ = self.experiment.image(reconstruct.find(self._method), made)
            images = values.reshape(len(numbers), *(channels or (1,)), *layout.shape)[wanted] / np.float32(self.scale)
            return list(zip(torch.from_numpy(images).unbind(), labels, strict=True))
        if self.returns == "tr":
            assert made.tr is not None
            batch = made.tr
            return [
                (_transformed(batch.images(int(i), int(i) + 1), self.transform), label)
                for i, label in zip(wanted, labels, strict=True)
            ]
        if self.returns == "counts":
            assert made.tally is not None
            dense, kind = np.moveaxis(made.tally.reshape(len(numbers), made.pixels, -1), -1, 1), np.int32
        else:
            assert made.frames is not None
            dense = made.frames.unpacked() if self.returns == "qis" else made.frames.stamps(np.float32)
            kind = dense.dtype.type
        dense = dense.reshape(*dense.shape[:2], *channels, *layout.shape)
        dense = np.moveaxis(dense, 2, 1) if channels else dense
        dense = dense if len(wanted) == len(dense) and (wanted[1:] > wanted[:-1]).all() else dense[wanted]
        frames = torch.from_numpy(np.ascontiguousarray(dense.astype(kind, copy=False)))
        return list(zip(frames.unbind(), labels, strict=True))

    def _levels(self, numbers: np.ndarray, epoch: int) -> np.ndarray:
        """(n,) lux of each image in this epoch."""
        assert self.range is not None
        low, high = (level.value for level in self.range)
        out = np.empty(len(numbers))
        for k, number in enumerate(numbers.tolist()):
            text = f"{self.experiment.seed}/{self.split}/{epoch}/{number}/lux"
            word = int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")
            out[k] = low * (high / low) ** (word / 2**64)
        return out


def _asked_for(returns: str, recording: Mapping[str, Any]) -> tuple[str | None, Any]:
    """(the reconstruction, None for a readout; the readouts that are recorded). Raises SpadError with a sentence.

    A name that is both is the readout where the recording says anything of it: its bits, or its name among `readouts`.
    """
    known = dict.fromkeys([*READOUTS, *reconstruct.Method.registry])
    if not isinstance(returns, str) or returns not in known:
        raise SpadError(f"returns: {returns!r} is neither a readout nor a reconstruction; there are {', '.join(known)}")
    if not isinstance(recording, Mapping):
        raise SpadError(f"recording: is {recording!r:.80}; it is a mapping as in a config, {{'exposure': '1 ms', ...}}")
    given = recording.get("readouts")
    listed = list(given) if isinstance(given, list | tuple) else []
    is_both = returns in READOUTS and returns in reconstruct.Method.registry
    said = recording.get("bits") is not None or returns in listed
    method = returns if returns not in READOUTS or (is_both and not said) else None
    needed = [returns] if method is None else list(reconstruct.find(method).readouts())
    if given is None:
        return method, needed
    lacking = [name for name in needed if name not in listed]
    if listed and lacking:
        why = " (the readout, as the recording has bits)" if is_both and method is None else ""
        raise SpadError(
            f"recording: its readouts are {', '.join(map(str, listed))}, but returns={returns!r}{why} needs "
            f"{', '.join(lacking)}; add it to them, or leave readouts out"
        )
    return method, listed or given  # the config reader refuses what is no list of readouts


class _Shown(NamedTuple):
    """An item of somebody's set: grey levels, (rows, columns) or (channels, rows, columns); white; label."""

    pixels: np.ndarray
    white: float
    label: int


def _kind(pixels: np.ndarray) -> str:
    return "grey" if pixels.ndim == 2 else f"of {len(pixels)} channels"


def _image(item: Any, place: str) -> _Shown:
    """An item of somebody's set of images; place: what a message calls it. PIL's are read as a folder's pictures."""
    from PIL import Image

    image, label = item if isinstance(item, tuple | list) and len(item) == 2 else (item, _NO_LABEL)
    if isinstance(image, Image.Image):
        array, alpha = pixels_of(image, place, instead="give an array")
    else:
        array, alpha = _plain(image, place)
    if array.dtype == bool:
        array = array.astype(np.uint8) * np.uint8(255)
    if array.dtype in (np.uint8, np.uint16):
        white = float(np.iinfo(array.dtype).max)
        return _Shown(Making().image(array, alpha, white), white, int(label))
    if array.dtype.kind != "f" or not (array.size and array.min() >= 0 and array.max() <= 1):
        raise SpadError(
            f"{place}: an image of {array.dtype} is not from 0 to 1; give uint8, uint16, or floats from 0 to 1"
        )
    return _Shown(array.astype(np.float32), 1.0, int(label))  # as the source `array` holds them


def _plain(image: Any, place: str) -> tuple[np.ndarray, np.ndarray | None]:
    """(rows, columns) or (channels, rows, columns) of an array or tensor; and how opaque it is, where it says so."""
    array, alpha = image.numpy() if isinstance(image, torch.Tensor) else np.asarray(image), None
    if array.ndim == 3 and array.shape[-1] in (3, 4) and not isinstance(image, torch.Tensor):
        if array.shape[-1] == 4 and array.dtype != np.uint8:
            raise SpadError(f"{place}: four channels of {array.dtype} are not taken for RGBA; give uint8, or RGB alone")
        alpha = array[..., 3] if array.shape[-1] == 4 else None
        array = np.moveaxis(array[..., :3], -1, 0)  # PIL's channels come last
    if array.ndim == 3 and len(array) == 1:
        array = array[0]
    if array.ndim not in (2, 3):
        raise SpadError(f"{place}: is an array of {array.ndim} axes; give (rows, columns) or (channels, rows, columns)")
    return array, alpha


__all__ = [
    "Events", "Fluxes", "Frames", "Nested", "Packed", "Padded", "Simulated", "Stream", "ToFrames", "ToStructured",
    "ToTimeSurface", "ToVoxelGrid", "collate_nested", "collate_packed", "collate_padded", "default_collate", "stream",
]  # fmt: skip
