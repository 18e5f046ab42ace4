"""Sets for PyTorch: the same values as `part`, in every order and start method; each image once; fresh photons."""

from __future__ import annotations

import dataclasses
import io
import itertools
import pickle
import subprocess
import sys
from collections.abc import Sequence
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spadmnist
from spadmnist import config, factory, grids
from spadmnist.errors import ConfigError, SpadError
from spadmnist.events import Events
from spadmnist.readout import Frames

torch = pytest.importorskip("torch", reason="PyTorch is not installed")
from torch.utils.data import DataLoader  # noqa: E402

import spadmnist.torch as st  # noqa: E402

N = 70
CONFIG = """
seed: 3
scene:
  images: {source: digits, train: 70, test: 6}
  wavelength: 555 nm
  lux: [2 lux, 30 lux]
recording: {exposure: 30 us, frames: 3, frame_time: 8 us, frame_period: 10 us, bits: 2, readouts: READOUTS}
sensor:
  rules: paper
  layout: {rows: 28, columns: 28, pixel_area: 25 um^2, fill_factor: 1}
  effects: {detection: {pdp: 0.5}, dead_time: {duration: 50 ns}, tdc: {resolution: 1 ns}}
"""
RECORDING = {"exposure": "30 us", "frames": 3, "frame_time": "8 us", "frame_period": "10 us"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("torch")
    (root / "lab.yaml").write_text(CONFIG.replace("READOUTS", "[tr, str, qis, counts]"))
    # small shards, so that there is something to shuffle
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("spadmnist.shard_plan._IMAGES_PER_SHARD", 10)
        experiment = config.read(root / "lab.yaml")
        factory.generate(experiment, experiment.load_images(), root / "out", 1)
    return root


@pytest.fixture(scope="module")
def dataset(folder: Path) -> spadmnist.Dataset:
    return spadmnist.open(folder / "out")


@pytest.fixture(scope="module")
def part(dataset: spadmnist.Dataset) -> spadmnist.Part:
    return dataset["30 lux", "train"]


def expected(part: spadmnist.Part, kind: str, i: int) -> np.ndarray:
    if kind == "events":
        return part.tr[i].times
    if kind == "fluxes":
        return part.reconstruction["counts"].normalised[i][None]
    return np.asarray(getattr(part, kind)[i])


def sets(part: spadmnist.Part) -> dict[str, Any]:
    frames = {name: st.Frames(part, name) for name in ("qis", "str", "counts")}
    return {"fluxes": st.Fluxes(part), "events": st.Events(part), **frames}


def values(item: Any) -> np.ndarray:
    return np.asarray(item.times if isinstance(item, Events) else item)


def identity(items: Sequence[Any]) -> Sequence[Any]:
    return items


# --- sets by index ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stored", [True, False])
def test_items_are_those_of_the_part(part: spadmnist.Part, folder: Path, stored: bool) -> None:
    part = part if stored else spadmnist.open(folder / "lab.yaml")["30 lux", "train"]
    for kind, made in sets(part).items():
        assert len(made) == N
        for indices in ([0, 1, 2], [69, 3, 33, 3], [12]):
            items = made.__getitems__(indices)
            assert len(items) == len(indices)
            for i, (item, label) in zip(indices, items, strict=True):
                right = expected(part, kind, i)
                right = right.astype({"str": np.float32, "counts": np.int32}.get(kind, right.dtype))
                assert np.array_equal(values(item), right) and values(item).dtype == right.dtype, (kind, i)
                assert type(label) is int and label == part.labels[i]  # type: ignore[index]
        assert np.array_equal(values(made[5][0]), values(made.__getitems__([5])[0][0]))


def test_fluxes_beyond_memory_are_read_as_they_are_asked_for(
    part: spadmnist.Part, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = st.Fluxes(part, "passive_free_running", normalised=False)
    monkeypatch.setattr(st, "_IN_MEMORY", 1000)
    read = st.Fluxes(part, "passive_free_running", normalised=False)
    assert kept._kept is not None and read._kept is None
    order = [9, 3, 69, 0]
    for (a, _), (b, _) in zip(kept.__getitems__(order), read.__getitems__(order), strict=True):
        assert torch.equal(a, b)
    assert read._kept is None


def test_images_without_labels(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    text = CONFIG.replace("READOUTS", "[tr, str, qis, counts]").replace(
        "{source: digits, train: 70, test: 6}", "{source: uniform, repetitions: 4}"
    )
    file.write_text(text)
    assert [label for _, label in st.Events(spadmnist.open(file)["2 lux"]).__getitems__([0, 2])] == [-1, -1]


WORKERS = [
    pytest.param("fork", False, id="fork"),
    pytest.param("fork", True, id="fork, kept"),
    pytest.param("spawn", True, id="spawn, kept", marks=pytest.mark.slow),
    pytest.param("forkserver", False, id="forkserver", marks=[pytest.mark.slow, pytest.mark.long]),
]


@pytest.mark.parametrize(("method", "persistent"), WORKERS)
def test_workers_give_the_same(part: spadmnist.Part, method: str, persistent: bool) -> None:
    for made, collate in ((st.Fluxes(part), None), (st.Events(part), st.collate_packed)):
        loader = DataLoader(
            made, batch_size=16, num_workers=2, multiprocessing_context=method, persistent_workers=persistent,
            collate_fn=collate, sampler=list(reversed(range(N))),
        )  # fmt: skip
        alone = DataLoader(made, batch_size=16, collate_fn=collate, sampler=list(reversed(range(N))))
        for _ in range(2):
            for a, b in zip(loader, alone, strict=True):
                assert all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


class Mine(torch.utils.data.Dataset[Any]):
    """A set of somebody's that holds a whole dataset."""

    def __init__(self, held: spadmnist.Dataset):
        self.held = held

    def __len__(self) -> int:
        return 4

    def __getitem__(self, i: int) -> Any:
        return torch.from_numpy(self.held["30 lux", "train"].reconstruction["counts"][i])


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_a_dataset_in_a_set_of_ones_own(folder: Path, part: spadmnist.Part, method: str) -> None:
    for place in ("out", "lab.yaml"):
        loader = DataLoader(Mine(spadmnist.open(folder / place)), num_workers=1, multiprocessing_context=method)
        for i, item in enumerate(loader):
            assert np.array_equal(item[0].numpy(), part.reconstruction["counts"][i])


def test_tensors_choose_images(part: spadmnist.Part) -> None:
    for index in (torch.tensor([3, 1, 2]), torch.tensor([5]), torch.arange(N) % 23 == 2):
        assert np.array_equal(part.images[index], part.images[index.numpy()])
    assert np.array_equal(part.images[torch.tensor(3)], part.images[3])
    for wrong in (torch.tensor([1.5, 2.0]), torch.tensor(1.5), torch.zeros((2, 2), dtype=torch.int64)):
        with pytest.raises(IndexError, match="images are chosen by a number"):
            part.images[wrong]


def test_a_worker_is_sent_kilobytes(folder: Path, part: spadmnist.Part) -> None:
    simulated = spadmnist.open(folder / "lab.yaml")["30 lux", "train"]
    for one in (part, simulated, spadmnist.concatenate([part, part])):
        for made in (*sets(one).values(), st.stream(one), st.stream(one, "fluxes")):
            buffer = io.BytesIO()
            ForkingPickler(buffer, pickle.HIGHEST_PROTOCOL).dump(made)
            assert buffer.tell() < 100_000


# --- batches and transforms ---------------------------------------------------------------------------------------


def test_collates(part: spadmnist.Part) -> None:
    items = st.Events(part).__getitems__([4, 0, 9])
    packed, padded, nested = st.collate_packed(items), st.collate_padded(items), st.collate_nested(items)
    assert packed.labels.tolist() == padded.labels.tolist() == nested.labels.tolist() == [x for _, x in items]
    assert padded.times.shape == padded.mask.shape == (3, max(len(e) for e, _ in items))
    for k, (events, _) in enumerate(items):
        cut = slice(int(packed.offsets[k]), int(packed.offsets[k + 1]))
        for times, pixel in (
            (packed.times[cut], packed.pixel[cut]),
            (padded.times[k][padded.mask[k]], padded.pixel[k][padded.mask[k]]),
            (nested.times[k], nested.pixel[k]),
        ):
            assert np.array_equal(times, events.times) and np.array_equal(pixel, events.pixel)
    assert not padded.times[~padded.mask].any() and not padded.pixel[~padded.mask].any()
    with pytest.raises(SpadError, match="Tensor are no events"):
        st.collate_packed(st.Fluxes(part).__getitems__([0]))


def by_hand(rows: list[list[float]], pixels: int = 2) -> Events:
    return Events(np.concatenate([[], *rows]), np.cumsum([0, *map(len, rows)]), pixels)


def test_frames_of_events_by_hand() -> None:
    events = by_hand([[0.0, 0.24, 0.25, 0.99], []])
    assert st.ToFrames((1, 2), 4, 1.0)(events).tolist() == [[[2, 0]], [[1, 0]], [[0, 0]], [[1, 0]]]
    assert st.ToFrames((1, 2), 4, 1.0, binary=True)(events)[0].tolist() == [[1, 0]]
    two = st.ToFrames((1, 2), 1, 1.0)(by_hand([[0.5], [], [], [0.1, 0.2]]))
    assert two.shape == (2, 1, 1, 2) and two.ravel().tolist() == [1, 0, 0, 2]
    colour = st.ToFrames((3, 1, 1), 2, 1.0)(by_hand([[0.1], [0.6], []], 3))
    assert colour.shape == (3, 2, 1, 1) and colour.reshape(3, 2).tolist() == [[1, 0], [0, 1], [0, 0]]


def test_voxels_by_hand() -> None:
    """Four bins, whose middles lie at 1/8, 3/8, 5/8 and 7/8."""
    grid = st.ToVoxelGrid((1, 2), 4, 1.0)
    one = grid(by_hand([[0.0, 1 / 8, 1 / 4, 0.99], [0.6]]))[:, 0]
    assert one[:, 0].tolist() == [2.5, 0.5, 0.0, 1.0]
    assert np.allclose(one[:, 1], [0, 0.1, 0.9, 0])
    assert st.ToVoxelGrid((1, 2), 1, 1.0)(by_hand([[0.1, 0.9], []])).ravel().tolist() == [2, 0]


def test_a_time_surface_by_hand() -> None:
    surface = st.ToTimeSurface((1, 2), 0.5, 1.0, bins=2)(by_hand([[0.1, 0.4, 0.75], []]))
    assert np.allclose(surface[:, 0, 0], np.exp([-0.1 / 0.5, -0.25 / 0.5])) and not surface[:, 0, 1].any()


def test_frames_of_events_are_the_counts(part: spadmnist.Part) -> None:
    """Added up over the bins: the detections of each pixel."""
    events = part.tr[7]
    for transform in (st.ToFrames((28, 28), 10, 30e-6), st.ToVoxelGrid((28, 28), 10, 30e-6)):
        assert np.allclose(transform(events).sum(0).ravel(), events.counts, atol=1e-3)


@pytest.mark.parametrize("make", [st.ToFrames, st.ToVoxelGrid, lambda s, n, e: st.ToTimeSurface(s, 1.0, e, n)])
def test_events_beyond_the_exposure_are_a_mistake(part: spadmnist.Part, make: Any) -> None:
    """Of an exposure that is too short by its unit no bin would tell; a stamp at its end, rounded, is none."""
    with pytest.raises(SpadError, match=r"exposure: 3e-06 s is not that of the events, which lie between .* s and "):
        make((28, 28), 5, 3e-6)(part.tr[7])
    with pytest.raises(SpadError, match="give the time that was recorded"):
        make((1, 2), 5, 1.0)(by_hand([[-0.1, 0.5], []]))
    assert make((1, 2), 5, 1.0)(by_hand([[np.nextafter(1.0, 2.0)], []])).shape == (5, 1, 2)
    assert not make((1, 2), 5, 1.0)(by_hand([[], []])).any()


def test_structured_events(part: spadmnist.Part) -> None:
    events = part.tr[7]
    made = st.ToStructured(28)(events)
    assert made.dtype.names == ("x", "y", "t", "p") and made["p"].all() and (np.diff(made["t"]) >= 0).all()
    order = np.lexsort((events.ticks, events.pixel))  # type: ignore[arg-type]
    again = np.lexsort((made["t"], made["y"] * 28 + made["x"]))
    assert np.array_equal(made["t"][again], events.ticks[order])  # type: ignore[index]
    assert np.array_equal((made["y"] * 28 + made["x"])[again], events.pixel[order])
    assert np.array_equal(grids.structured(events, 28, 1e-9)["t"], made["t"])
    with pytest.raises(SpadError, match="no converter's ticks; give the unit"):
        grids.structured(by_hand([[0.1], []]), 2)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: st.ToFrames((28,), 10, 1.0), r"is no image; give \(rows, columns\)"),
        (lambda: st.ToFrames((28, 28), 0, 1.0), "number of bins is 0"),
        (lambda: st.ToFrames((28, 28), 2, np.nan), "exposure: nan s"),
        (lambda: st.ToTimeSurface((28, 28), -1.0, 1.0), "tau: -1.0 s"),
        (lambda: st.ToFrames((3, 3), 2, 1.0)(by_hand([[], []])), "has 9 pixels, but the events are of images of 2"),
    ],
)
def test_wrong_transforms_are_sentences(make: Any, says: str) -> None:
    with pytest.raises(SpadError, match=says):
        make()


def test_a_transform_in_a_set(part: spadmnist.Part) -> None:
    made = st.Events(part, st.ToFrames((28, 28), 5, 30e-6))
    batch, labels = next(iter(DataLoader(made, batch_size=8)))
    assert batch.shape == (8, 5, 28, 28) and len(labels) == 8


# --- the stream ---------------------------------------------------------------------------------------------------


def marks(part: spadmnist.Part) -> dict[bytes, int]:
    """Which image an item's fluxes are."""
    found = {part.reconstruction["counts"].normalised[i].tobytes(): i for i in range(len(part))}
    assert len(found) == len(part)
    return found


def numbers(part: spadmnist.Part, stream: Any, workers: int = 0, **more: Any) -> list[int]:
    known = marks(part)
    loader = DataLoader(stream, batch_size=None, num_workers=workers, **more)
    return [known[item[0].numpy().tobytes()] for item, _ in loader]


@pytest.mark.filterwarnings("ignore:This DataLoader will create 3 worker")
@pytest.mark.parametrize("workers", [0, 1, 3])
@pytest.mark.parametrize("world", [1, 2, 4])
def test_a_stream_holds_each_image_once(part: spadmnist.Part, workers: int, world: int) -> None:
    apart = []
    for rank in range(world):
        stream = st.stream(part, "fluxes", seed=5, rank=rank, world=world)
        apart.append(numbers(part, stream, workers))
        assert len(apart[-1]) == len(stream)
        if workers < 3:
            assert numbers(part, stream, workers) == apart[-1]  # the same again
    assert sorted(itertools.chain(*apart)) == list(range(N))
    assert max(map(len, apart)) - min(map(len, apart)) <= 1


def test_a_stream_is_shuffled_and_differs_between_epochs_and_seeds(part: spadmnist.Part) -> None:
    stream = st.stream(part, "fluxes", seed=5)
    first = numbers(part, stream)
    stream.set_epoch(1)
    second = numbers(part, stream)
    stream.set_epoch(0)
    assert first != sorted(first) and second != first and numbers(part, stream) == first
    assert numbers(part, st.stream(part, "fluxes", seed=6)) != first
    # more than within its shard: of the first 10, some lie in another shard than the very first
    assert len({i // 10 for i in first[:10]}) > 1
    assert len({i // 10 for i in numbers(part, st.stream(part, "fluxes", seed=5, buffer=1))[:10]}) == 1


def test_an_epoch_reaches_workers_that_are_kept(part: spadmnist.Part) -> None:
    stream = st.stream(part, "fluxes", seed=5)
    loader = DataLoader(stream, batch_size=None, num_workers=2, persistent_workers=True)
    known, orders = marks(part), []
    for epoch in (0, 1, 0):
        stream.set_epoch(epoch)
        orders.append([known[item[0].numpy().tobytes()] for item, _ in loader])
    assert orders[0] == orders[2] != orders[1] and sorted(orders[1]) == list(range(N))


@pytest.mark.parametrize("kind", ["events", "fluxes", "qis", "str", "counts"])
def test_what_a_stream_gives(part: spadmnist.Part, kind: str) -> None:
    known, labels = marks(part), part.labels
    order = numbers(part, st.stream(part, "fluxes", seed=2))
    assert known and labels is not None
    what = ("frames", kind) if kind in ("qis", "str", "counts") else (kind, None)
    for (item, label), i in zip(st.stream(part, *what, seed=2), order, strict=True):
        right = expected(part, kind, i)
        assert np.array_equal(values(item), right.astype(values(item).dtype)) and label == labels[i]


@pytest.mark.parametrize("readout", ["qis", "str"])
def test_a_stream_unpacks_frames_one_by_one(
    part: spadmnist.Part, readout: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four shards of frames, unpacked, take hundreds of times what they take as they are stored."""
    sizes, name = [], {"qis": "unpacked", "str": "stamps"}[readout]
    kept = getattr(Frames, name)

    def counted(self: Frames, *kind: Any) -> np.ndarray:
        sizes.append(len(self.bits) // self.pixels)
        return kept(self, *kind)  # type: ignore[no-any-return]

    monkeypatch.setattr(Frames, name, counted)
    assert len(list(itertools.islice(st.stream(part, "frames", readout), 12))) == 12 and sizes == [1] * 12


@pytest.mark.parametrize("after", [0, 1, 10, 41, 69, 70])
def test_a_stream_goes_on_where_it_stopped(part: spadmnist.Part, after: int) -> None:
    whole = numbers(part, st.stream(part, "fluxes", seed=5))
    known = marks(part)
    one = st.stream(part, "fluxes", seed=5)
    begun = [known[item[0].numpy().tobytes()] for item, _ in itertools.islice(one, after)]
    state = pickle.loads(pickle.dumps(one.state_dict()))
    other = st.stream(part, "fluxes", seed=5)
    other.load_state_dict(state)
    assert begun + [known[item[0].numpy().tobytes()] for item, _ in other] == whole
    assert [known[item[0].numpy().tobytes()] for item, _ in other] == whole  # the pass after it is whole
    with pytest.raises(SpadError, match="of seed 5, but this stream has 6"):
        st.stream(part, "fluxes", seed=6).load_state_dict(state)


def test_a_state_is_of_one_stream(part: spadmnist.Part) -> None:
    """Nothing that changes the order, or what the items are, passes for the same."""
    made = st.stream(part, "fluxes", seed=5)
    state = dict(itertools.islice(((k, made.state_dict()) for k, _ in enumerate(made)), 12))[11]
    assert state["done"] == 12
    half = part[: N // 2]
    for other, name in (
        (st.stream(part, "fluxes", seed=5, buffer=1), "buffer 4, but this stream has 1"),
        (st.stream(half, "fluxes", seed=5), f"length {N}, but this stream has {N // 2}"),
        (st.stream(part, "events", seed=5), "kind fluxes, but this stream has events"),
        (st.stream(part, "fluxes", "passive_free_running", seed=5), "method counts, but this stream has passive"),
        (st.stream(part[::-1], "fluxes", seed=5), "shards"),
        (st.stream(part, "fluxes", seed=5, rank=0, world=2), "consumers 1, but this stream has 2"),
    ):
        with pytest.raises(SpadError, match=f"the state is of {name}.*; make the stream as"):
            other.load_state_dict(state)
    del state["buffer"]
    with pytest.raises(SpadError, match="the state says no buffer"):
        made.load_state_dict(state)


def begun(stream: Any, items: int) -> dict[str, Any]:
    """The state of a stream, of which that many were taken."""
    for _ in itertools.islice(stream, items):
        pass
    return dict(stream.state_dict())


@pytest.mark.parametrize("persistent", [False, True])
def test_a_state_goes_on_with_the_workers_that_it_is_of(part: spadmnist.Part, persistent: bool) -> None:
    """Of others it would leave images out and give some twice, in each epoch: it is refused."""
    whole = numbers(part, st.stream(part, "fluxes", seed=5))
    stream = st.stream(part, "fluxes", seed=5)
    state, known = begun(stream, 12), marks(part)
    two = DataLoader(stream, batch_size=None, num_workers=2, persistent_workers=persistent)
    stream.load_state_dict(state)
    with pytest.raises(SpadError, match="state that was loaded is of consumer 0 of 1, but this is consumer"):
        list(two)
    two = DataLoader(stream, batch_size=None, num_workers=2, persistent_workers=persistent)
    for epoch in (1, 0):  # what the state says of another epoch is nothing to these
        stream.set_epoch(epoch)
        assert sorted(known[item[0].numpy().tobytes()] for item, _ in two) == list(range(N))
    stream.load_state_dict(begun(st.stream(part, "fluxes", seed=5), 0))  # of the beginning: any number of workers
    assert len(list(two)) == N
    one = DataLoader(stream, batch_size=None, num_workers=1, persistent_workers=persistent)
    for left in (whole, whole[12:], whole):  # the pass before, the one that goes on, and the one after it
        if left is not whole:
            stream.load_state_dict(state)
        assert [known[item[0].numpy().tobytes()] for item, _ in one] == left


def test_a_state_is_of_its_epoch_alone(part: spadmnist.Part) -> None:
    stream = st.stream(part, "fluxes", seed=5)
    stream.load_state_dict(begun(stream, 12))
    stream.set_epoch(1)
    assert sorted(numbers(part, stream)) == list(range(N))
    stream.set_epoch(2)
    assert stream.state_dict()["epoch"] == 2 and stream.state_dict()["done"] == 0
    whole = numbers(part, stream)
    half = iter(stream)
    known = marks(part)
    first = [known[item[0].numpy().tobytes()] for item, _ in itertools.islice(half, 12)]
    stream.set_epoch(3)  # from the next pass on
    assert first + [known[item[0].numpy().tobytes()] for item, _ in half] == whole


def test_outside_of_its_workers_a_stream_has_no_state(part: spadmnist.Part) -> None:
    stream = st.stream(part, "fluxes", seed=5)
    for _ in itertools.islice(DataLoader(stream, batch_size=4, num_workers=2), 3):
        pass
    with pytest.raises(SpadError, match="iterated by workers, each of which has a state of its own; take it there"):
        stream.state_dict()
    stream.set_epoch(1)
    assert stream.state_dict()["done"] == 0
    assert begun(stream, 5)["done"] == 5


class Telling(torch.utils.data.IterableDataset[Any]):
    """Does in each worker what torchdata's StatefulDataLoader does there: it gives a state, and takes one."""

    def __init__(self, stream: Any, states: dict[int, Any]):
        self.stream, self.states = stream, states

    def __iter__(self) -> Any:
        worker = torch.utils.data.get_worker_info().id
        if worker in self.states:
            self.stream.load_state_dict(self.states[worker])
        for item, _ in self.stream:
            yield worker, item, self.stream.state_dict()


def test_each_worker_goes_on_from_its_own_state(part: spadmnist.Part) -> None:
    known, states, first, rest = marks(part), {}, [], []
    made = st.stream(part, "fluxes", seed=5)
    loader = DataLoader(Telling(made, {}), batch_size=None, num_workers=2)
    for worker, item, state in itertools.islice(loader, 25):
        first.append(known[item[0].numpy().tobytes()])
        states[worker] = state
    made = st.stream(part, "fluxes", seed=5)
    for _, item, _ in DataLoader(Telling(made, states), batch_size=None, num_workers=2):
        rest.append(known[item[0].numpy().tobytes()])
    assert len(first) == 25 and sorted(first + rest) == list(range(N))


def test_a_stream_of_several_levels_and_of_a_config(dataset: spadmnist.Dataset, folder: Path) -> None:
    whole = spadmnist.concatenate([dataset[level, "train"] for level in dataset.levels])
    assert sorted(numbers(whole, st.stream(whole, "fluxes"))) == list(range(2 * N))
    simulated = spadmnist.open(folder / "lab.yaml")["30 lux", "train"]
    assert sorted(numbers(simulated[::2], st.stream(simulated[::2], "fluxes"))) == list(range(N // 2))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda p: st.stream(p, "photons"), "kind: 'photons' is not possible; it is events, fluxes or frames"),
        (lambda p: st.stream(p, rank=2, world=2), "rank: 2 of 2"),
        (lambda p: st.stream(p, "events", method="counts"), "events have none"),
        (lambda p: st.stream(p, "fluxes", method="none"), "'none' is no reconstruction of this part; there are counts"),
        (lambda p: st.stream(p, buffer=0), "buffer: 0"),
        (lambda p: st.stream(p, "fluxes", transform=len), "transform: is called with events, and kind='fluxes' has"),
        (lambda p: st.stream(p, "frames", transform=len), "take kind='events', or leave transform out"),
        (lambda p: st.stream(p, transform="frames"), "transform: is 'frames'; it is a function of events"),
        (lambda p: st.Events(p, transform=3), "transform: is 3; it is a function of events"),
        (lambda p: st.stream(p).set_epoch(-1), "epoch: -1"),
        (lambda p: st.Frames(p, "tr"), "'tr' is no readout of frames"),
        (lambda p: st.Fluxes(p, "none"), "'none' is no reconstruction"),
    ],
)
def test_wrong_wishes_are_sentences(part: spadmnist.Part, make: Any, says: str) -> None:
    with pytest.raises(SpadError, match=says):
        make(part)


# --- images that are simulated ------------------------------------------------------------------------------------


class Pictures:
    """A map-style set of somebody's."""

    def __init__(self, images: np.ndarray, labels: np.ndarray | None = None):
        self.images, self.labels = images, labels

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, i: int) -> Any:
        return self.images[i] if self.labels is None else (self.images[i], self.labels[i])


@pytest.fixture(scope="module")
def pictures(part: spadmnist.Part) -> Pictures:
    assert part.labels is not None
    return Pictures(part.images[:], part.labels)


@pytest.fixture(scope="module")
def sensor(folder: Path) -> Any:
    return spadmnist.read_sensor(folder / "lab.yaml")


def simulated(pictures: Any, sensor: Any, returns: str = "counts", **more: Any) -> st.Simulated:
    return st.Simulated(
        pictures, sensor, **{"recording": RECORDING, "lux": "30 lux", "seed": 3, "returns": returns, **more}
    )


@pytest.mark.parametrize("returns", ["counts", "passive_free_running", "qis_counts", "str_flux", "tr", "qis", "str"])
def test_the_first_epoch_is_that_of_generate(part: spadmnist.Part, pictures: Any, sensor: Any, returns: str) -> None:
    made = simulated(pictures, sensor, returns)
    for i, (item, label) in zip([4, 60, 0], made.__getitems__([4, 60, 0]), strict=True):
        if returns in ("tr", "qis", "str"):
            right = expected(part, {"tr": "events"}.get(returns, returns), i)
        else:
            right = part.reconstruction[returns][i][None]
        assert np.array_equal(values(item), right.astype(values(item).dtype)), i
        assert label == part.labels[i]  # type: ignore[index]


@pytest.mark.parametrize("recording", [{"bits": 2}, {"bits": 2, "readouts": ["tr", "counts"]}])
def test_counts_are_the_readout_where_the_recording_has_them(
    part: spadmnist.Part, pictures: Any, sensor: Any, recording: Any
) -> None:
    made = simulated(pictures, sensor, "counts", recording={**RECORDING, **recording})
    for i, (item, _) in zip([4, 60, 0], made.__getitems__([4, 60, 0]), strict=True):
        assert item.dtype == torch.int32 and np.array_equal(values(item), part.counts[i]), i


def test_counts_in_colour_are_the_readout(pictures: Any, sensor: Any) -> None:
    colour = np.stack([pictures.images[0], 255 - pictures.images[0]])
    item = simulated([colour], sensor, recording={**RECORDING, "bits": 2})[0][0]
    assert item.shape == (2, 1, 28, 28) and item[1].sum() > item[0].sum() > 0


def test_readouts_that_a_recording_lists_are_kept(pictures: Any, sensor: Any) -> None:
    made = simulated(pictures, sensor, "qis", recording={**RECORDING, "readouts": ["tr", "qis"]})
    assert made.experiment.readouts == ("tr", "qis")
    assert torch.equal(made[3][0], simulated(pictures, sensor, "qis")[3][0])


FLOATS = """
seed: 3
scene: {images: {source: array, path: images.npy}, wavelength: WAVELENGTH, lux: [30 lux]}
recording: {exposure: 30 us, readouts: [tr]}
sensor:
  layout: {rows: 28, columns: 28, pixel_area: 25 um^2, fill_factor: 1}
  effects: {detection: {pdp: 0.5}}
"""


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("wavelength", [["555 nm"], ["600 nm", "550 nm", "500 nm"]])
def test_floats_are_those_of_the_array_source(
    pictures: Any, tmp_path: Path, kind: type[np.floating], wavelength: list[str]
) -> None:
    """To the last digit of times that no converter rounds."""
    shades = pictures.images[:4] / 255.0
    images = (shades if len(wavelength) == 1 else np.stack([shades, shades[::-1], 1 - shades], axis=1)).astype(kind)
    np.save(tmp_path / "images.npy", images)
    file = tmp_path / "lab.yaml"
    file.write_text(FLOATS.replace("WAVELENGTH", wavelength[0] if len(wavelength) == 1 else f"{wavelength}"))
    part = spadmnist.open(file)["30 lux", "train"]
    light = wavelength[0] if len(wavelength) == 1 else wavelength
    more = {"recording": {"exposure": "30 us"}, "wavelength": light}
    made = simulated(images, spadmnist.read_sensor(file), "tr", **more)
    for i, (item, _) in enumerate(made.__getitems__(range(4))):
        assert len(item) > 1000 and np.array_equal(item.times, part.tr[i].times), i
    if len(wavelength) == 1:  # beside an image of another kind, too
        beside = simulated([images[0], pictures.images[1]], spadmnist.read_sensor(file), "tr", **more)
        assert np.array_equal(beside.__getitems__([0, 1])[0][0].times, part.tr[0].times)


def test_no_stamp_becomes_none_in_single_precision(tmp_path: Path) -> None:
    """Frames of 1 ms and ticks of 10 ps: as a float32 the last tick would be the frame time."""
    file = tmp_path / "lab.yaml"
    text = CONFIG.replace("READOUTS", "[str]").replace(", bits: 2", "").replace("resolution: 1 ns", "resolution: 10 ps")
    text = text.replace("exposure: 30 us, frames: 3, frame_time: 8 us, frame_period: 10 us", "RECORDING")
    clock = {"exposure": "3 ms", "frames": 3, "frame_time": "1 ms", "frame_period": "1 ms"}
    file.write_text(text.replace("RECORDING", ", ".join(f"{k}: {v}" for k, v in clock.items())))
    part = spadmnist.open(file)["2 lux", "train"][:1]
    frames = part.frames[0]
    assert frames.first is not None and frames.first.tick == 1e-11 and frames.first.ticks is not None
    late = frames.first.stamped(np.full_like(frames.first.ticks, 10**8 - 1), 1e-11)
    rounded = dataclasses.replace(frames, first=late).stamps(np.float32)
    assert np.array_equal(rounded < np.float32(1e-3), frames.unpacked() == 1) and (rounded < 1e-3).any()
    item, _ = st.Frames(part, "str")[0]
    assert np.array_equal(item.numpy(), np.minimum(part.str[0].astype(np.float32), np.float32(1e-3)))


BLUR = '''
from spadmnist import Effect, parameter

class Blur(Effect):
    """A jitter of a program that does not count its draws. Source: none, of a test."""

    stage = "timing"
    width = parameter(1e-9, "s", "width of the jitter", bounds=(0, None), off=0.0)

    def apply(self, events, rng):
        return events.moved(events.times + self.width * rng.random(len(events)))
'''


def test_blocks_are_simulated_whole(tmp_path: Path) -> None:
    """Where an effect draws for 32 images at once, image i is that of `generate` all the same."""
    file = tmp_path / "lab.yaml"
    (tmp_path / "blur.py").write_text(BLUR)
    text = CONFIG.replace("READOUTS", "[tr]").replace(", bits: 2", "").replace("rules: paper", "rules: device")
    file.write_text(text.replace("resolution: 1 ns}}", "resolution: 1 ns}, blur: {width: 5 ns}}"))
    part = spadmnist.open(file, plugin=[tmp_path / "blur.py"])["30 lux", "train"]
    sensor = spadmnist.read_sensor(file)
    assert sensor.block == 32
    made = st.Simulated(
        Pictures(part.images[:]), sensor, recording={"exposure": "30 us"}, lux="30 lux", seed=3, returns="tr"
    )
    for i, (item, label) in zip([65, 2, 40], made.__getitems__([65, 2, 40]), strict=True):
        assert np.array_equal(item.times, part.tr[i].times) and label == -1


@pytest.mark.parametrize(("method", "persistent"), WORKERS)
def test_no_two_epochs_share_a_draw(pictures: Any, sensor: Any, method: str, persistent: bool) -> None:
    """Nor do two workers: white images, so that any two that are alike share their draws."""
    white = Pictures(np.full((40, 28, 28), 255, np.uint8))
    made = simulated(white, sensor, "tr")
    loader = DataLoader(
        made, batch_size=4, num_workers=2, multiprocessing_context=method, persistent_workers=persistent,
        collate_fn=identity, shuffle=True,
    )  # fmt: skip
    found = set()
    for epoch in range(3):
        made.set_epoch(epoch)
        found |= {item.times.tobytes() for batch in loader for item, _ in batch}
    assert len(found) == 3 * 40


def test_a_second_pass_needs_another_epoch(pictures: Any, sensor: Any) -> None:
    made = simulated(pictures, sensor)
    loader = DataLoader(made, batch_size=10)
    first = torch.cat([x for x, _ in loader])
    with pytest.raises(SpadError, match=r"simulated in epoch 0 already.*call set_epoch\(1\)"):
        list(loader)
    made.set_epoch(1)
    assert not torch.equal(torch.cat([x for x, _ in loader]), first)
    made.set_epoch(0)
    assert torch.equal(torch.cat([x for x, _ in loader]), first)
    # what a worker has drawn the others know, those of the next pass among them
    apart = simulated(pictures, sensor)
    assert torch.equal(torch.cat([x for x, _ in DataLoader(apart, batch_size=10, num_workers=1)]), first)
    with pytest.raises(SpadError, match="simulated in epoch 0 already"):
        apart.__getitems__([3])


def test_a_range_of_light(sensor: Any) -> None:
    """Each image has a level of its own, in each epoch another; evenly on a logarithmic scale."""
    white = Pictures(np.full((400, 28, 28), 255, np.uint8))
    made = simulated(white, sensor, lux=(0.5, 50.0))
    levels = made._levels(np.arange(400), 0)
    assert levels.min() >= 0.5 and levels.max() <= 50
    from scipy import stats

    share = np.log(levels / 0.5) / np.log(100)
    assert stats.kstest(share, "uniform").pvalue > 1e-6
    assert len(set(levels) | set(made._levels(np.arange(400), 1))) == 800
    fluxes = torch.stack([x for x, _ in made.__getitems__(range(400))]).mean((1, 2, 3)).numpy()
    alone = simulated(white, sensor, lux="50 lux")
    per_lux = alone[0][0].mean().item() / 50
    # the flux of counts falls below the light where the dead time takes its share: 50 ns at up to 1e6 photons/s
    assert np.corrcoef(np.log(fluxes), np.log(levels))[0, 1] > 0.999
    assert np.all(fluxes < 1.3 * per_lux * levels) and np.all(fluxes > 0.7 * per_lux * levels)


def test_images_of_any_kind(pictures: Any, sensor: Any) -> None:
    """PIL's, floats from 0 to 1, tensors with a channel: the same photons for the same grey levels."""
    from PIL import Image

    grey = pictures.images[:6]
    kinds = [
        grey, [Image.fromarray(x) for x in grey], torch.from_numpy(grey)[:, None], torch.from_numpy(grey / 255.0),
        [(x, 3) for x in grey],
    ]  # fmt: skip
    found = [torch.stack([x for x, _ in simulated(kind, sensor).__getitems__(range(6))]) for kind in kinds]
    assert all(torch.equal(one, found[0]) for one in found[1:])
    bits = simulated((grey > 128), sensor)[0][0]
    assert torch.equal(bits, simulated((grey > 128).astype(np.uint8) * 255, sensor)[0][0])
    colour = simulated(np.stack([grey] * 3, axis=1), sensor)[0][0]
    assert colour.shape == (3, 28, 28) and not torch.equal(colour[0], colour[1])
    assert torch.equal(simulated(np.stack([grey] * 3, axis=-1), sensor)[0][0], colour)


@pytest.mark.parametrize("lux", ["30 lux", (0.5, 50.0)])
def test_each_image_has_its_own_white(sensor: Any, pictures: Any, lux: Any) -> None:
    """Of several kinds together each is what it is alone, to the last photon."""
    from PIL import Image

    grey = pictures.images[0]
    deep = grey.astype(np.uint16) * 257
    kinds = [grey, grey / 255.0, deep, torch.from_numpy(grey)[None], Image.fromarray(grey), Image.fromarray(deep)]
    together = simulated(kinds, sensor, lux=lux).__getitems__(range(6))
    alone = [simulated(kinds, sensor, lux=lux)[i][0] for i in range(6)]
    assert all(torch.equal(one, right) for (one, _), right in zip(together, alone, strict=True))
    means = np.array([one.mean().item() for one in alone])
    if lux == "30 lux":
        assert means.max() < 1.1 * means.min()


def test_pictures_are_read_as_those_of_a_folder(sensor: Any, tmp_path: Path) -> None:
    """Palettes are their colours, what is transparent is black, 16 bits stay."""
    from PIL import Image

    from spadmnist.images import Folder

    grey = np.full((28, 28), 200, np.uint8)
    grey[:3] = 40
    rgb = np.stack([grey, grey // 2, 255 - grey], -1)
    clear = np.dstack([rgb, np.where(grey > 100, 0, 255).astype(np.uint8)])
    palette = Image.fromarray(grey).quantize(4)
    see_through = Image.fromarray(rgb).quantize(4)
    see_through.info["transparency"] = 0
    shown = {
        "palette": palette, "colours": Image.fromarray(rgb).quantize(4), "clear": Image.fromarray(clear),
        "see_through": see_through, "bits": Image.fromarray(grey > 100),
        "deep": Image.fromarray(grey.astype(np.uint16) * 200),
        "grey_clear": Image.fromarray(np.dstack([grey, clear[..., 3]])),
    }  # fmt: skip
    for name, picture in shown.items():
        (tmp_path / name).mkdir()
        picture.save(tmp_path / name / "a.png")
        read = Folder(path=str(tmp_path / name)).load((28, 28))["train"]
        right = simulated(read.pixels, sensor)[0][0]
        assert torch.equal(simulated([picture], sensor)[0][0], right), name
        with Image.open(tmp_path / name / "a.png") as opened:
            assert torch.equal(simulated([opened], sensor)[0][0], right), name
    assert torch.equal(simulated([palette], sensor)[0][0], simulated(grey[None], sensor)[0][0])
    assert torch.equal(
        simulated(clear[None], sensor)[0][0], simulated([Image.fromarray(clear)], sensor)[0][0]
    )  # as an array, too
    for mode in ("CMYK", "HSV", "YCbCr", "LAB", "F"):
        picture = Image.new(mode, (28, 28))
        with pytest.raises(SpadError, match=f"image 0: it has pixels of the kind {mode}; convert it to.*give an array"):
            simulated([picture], sensor)[0]
    with pytest.raises(SpadError, match="image 0: four channels of float64"):
        simulated([clear / 255.0], sensor)[0]
    with pytest.raises(SpadError, match="image 1 is of 3 channels, but image 0 grey; convert all to one kind"):
        simulated([grey, rgb], sensor).__getitems__([0, 1])


def test_an_index_is_a_whole_number(part: spadmnist.Part, sensor: Any, pictures: Any) -> None:
    for made in (*sets(part).values(), simulated(pictures, sensor)):
        for wrong in (1.7, np.float64(2), "1"):
            with pytest.raises(IndexError, match="images are chosen by a number"):
                made[wrong]
        with pytest.raises(IndexError, match=f"image {N} was asked for; there are {N}"):
            made[N]


@pytest.mark.parametrize(
    ("images", "more", "error", "says"),
    [
        (np.zeros((2, 20, 28), np.uint8), {}, SpadError, "images are 20 x 28 pixels, but the sensor 28 x 28"),
        (np.full((2, 28, 28), 2.0), {}, SpadError, "is not from 0 to 1"),
        (np.zeros((2, 28, 28), np.int64), {}, SpadError, "give uint8, uint16, or floats"),
        (np.zeros((2, 28, 28), np.uint8), {"returns": "photons"}, SpadError, "neither a readout nor a reconstruction"),
        (
            np.zeros((2, 28, 28), np.uint8),
            {"returns": ["qis"]},
            SpadError,
            "there are tr, str, qis, counts, inter_photon",
        ),
        (np.zeros((2, 28, 28), np.uint8), {"recording": 3}, SpadError, "recording: is 3; it is a mapping"),
        (
            np.zeros((2, 28, 28), np.uint8),
            {"returns": "qis", "recording": {**RECORDING, "readouts": ["tr"]}},
            SpadError,
            "recording: its readouts are tr, but returns='qis' needs qis; add it to them, or leave readouts out",
        ),
        (
            np.zeros((2, 28, 28), np.uint8),
            {"recording": {**RECORDING, "bits": 2, "readouts": ["tr"]}},
            SpadError,
            r"returns='counts' \(the readout, as the recording has bits\) needs counts",
        ),
        (
            np.zeros((2, 28, 28), np.uint8),
            {"returns": "tr", "recording": {**RECORDING, "readouts": "tr"}},
            ConfigError,
            "readouts",
        ),
        (np.zeros((2, 28, 28), np.uint8), {"returns": "qis", "scale": 2.0}, SpadError, "scale: divides a reconstruc"),
        (np.zeros((2, 28, 28), np.uint8), {"scale": 0}, SpadError, "scale: is 0; it is a number of more than 0"),
        (np.zeros((2, 28, 28), np.uint8), {"scale": True}, SpadError, "scale: is True"),
        (np.zeros((2, 28, 28), np.uint8), {"transform": len}, SpadError, "transform: is called with events, and ret"),
        (np.zeros((2, 28, 28), np.uint8), {"returns": "tr", "transform": 3}, SpadError, "transform: is 3; it is a fun"),
        (np.zeros((2, 28, 28), np.uint8), {"lux": (1, 2, 3)}, SpadError, "give one level, or"),
        (np.zeros((2, 28, 28), np.uint8), {"lux": (2.0, 1.0)}, SpadError, r"is not below"),
        (np.zeros((2, 28, 28), np.uint8), {"lux": "5 nm"}, ConfigError, "lux"),
        (np.zeros((2, 28, 28), np.uint8), {"recording": {}}, ConfigError, "exposure"),
        (np.zeros((2, 28, 28), np.uint8), {"recording": {"exposure": "1 ms"}, "returns": "qis"}, ConfigError, "frames"),
    ],
)
def test_what_cannot_be_simulated_is_a_sentence(
    images: Any, more: Any, error: type[Exception], says: str, sensor: Any
) -> None:
    with pytest.raises(error, match=says):
        simulated(images, sensor, **more)[0]


# --- without torch ------------------------------------------------------------------------------------------------


def test_nothing_else_imports_torch() -> None:
    code = (
        "import sys, spadmnist; spadmnist.concatenate, spadmnist.read_sensor, spadmnist.Sensor; import spadmnist.cli; "
    )
    code += "print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_without_torch_it_says_what_to_install() -> None:
    code = "import sys; sys.modules['torch'] = None; import spadmnist.torch"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "pip install 'spadmnist[train]'" in done.stderr.splitlines()[-1]
