"""Images of a part by any index, smaller parts, and several parts as one."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import spadmnist
from spadmnist import config, factory
from spadmnist.errors import SpadError
from spadmnist.events import Events
from spadmnist.gather import gather, indices_of
from spadmnist.readout import Frames
from spadmnist.sensor import Sensor

CONFIG = """
seed: 3
causes: true
scene:
  images: {source: digits, train: 70, test: 6}
  wavelength: 555 nm
  lux: [20 mlux, 30 lux]
recording: {exposure: 30 us, frames: 3, frame_time: 8 us, frame_period: 10 us, bits: 2,
  readouts: [tr, str, qis, counts]}
sensor:
  rules: device
  layout: {rows: 12, columns: 10, pixel_area: 25 um^2, fill_factor: 1}
  effects: {detection: {pdp: 0.5}, afterpulsing: {probability: 5 %, lifetime: 60 ns}, tdc: {resolution: 1 ns}}
"""
READOUTS = ", bits: 2,\n  readouts: [tr, str, qis, counts]"
FIELDS: dict[str, Callable[[spadmnist.Part], Any]] = {
    "tr": lambda part: part.tr,
    "frames": lambda part: part.frames,
    "qis": lambda part: part.qis,
    "str": lambda part: part.str,
    "counts": lambda part: part.counts,
    "raw": lambda part: part.reconstruction["counts"],
    "normalised": lambda part: part.reconstruction["counts"].normalised,
    "qis_counts": lambda part: part.reconstruction["qis_counts"].normalised,
    "images": lambda part: part.images,
}


def sized(text: str) -> str:
    """The digits of the program have a size of their own."""
    return text.replace("rows: 12, columns: 10", "rows: 28, columns: 28")


@pytest.fixture(scope="module", params=["zarr", "hdf5", "config"])
def opened(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> spadmnist.Dataset:
    folder = tmp_path_factory.mktemp("parts")
    file = folder / "lab.yaml"
    file.write_text(sized(CONFIG))
    if request.param == "config":
        return spadmnist.open(file)
    experiment = config.read(file, format=request.param)
    factory.generate(experiment, experiment.load_images(), folder / "out", 1)
    return spadmnist.open(folder / "out")


@pytest.fixture(scope="module")
def part(opened: spadmnist.Dataset) -> spadmnist.Part:
    return opened["30 lux", "train"]


def same(a: Any, b: Any) -> bool:
    if isinstance(a, Frames):
        assert isinstance(b, Frames)
        whole = (
            np.array_equal(a.bits, b.bits) and np.array_equal(a.parent, b.parent) and np.array_equal(a.cause, b.cause)
        )
        return whole and (a.first is None or same(a.first, b.first))
    if isinstance(a, Events):
        assert isinstance(b, Events)
        names = ("offsets", "ticks", "times", "cause", "parent")
        return a.pixels == b.pixels and all(np.array_equal(getattr(a, n), getattr(b, n)) for n in names)
    return a.dtype == b.dtype and np.array_equal(a, b)


def one_by_one(field: Any, indices: Any) -> Any:
    """The same, put together from single images."""
    if isinstance(field[0], Events | Frames):
        return type(field[0]).join([field[int(i)] for i in indices])
    return np.stack([field[int(i)] for i in indices])


INDICES: list[Any] = [
    slice(3, 40, 7), slice(None, None, -9), slice(60, 5, -11), [5], [3, 1, 2], [69, 0, 33, 34, 0, 0], np.arange(64, 70),
    np.array([-1, 2, -70], np.int8), np.array([7, 3], np.uint64), np.arange(70) % 23 == 2, range(2, 50, 17), (4, 6),
]  # fmt: skip


def test_the_largest_number_is_no_image() -> None:
    for number in (2**64 - 1, 2**63, 70):
        for index in (np.array([number], np.uint64), [number], np.uint64(number)):
            with pytest.raises(IndexError, match=f"image {number} was asked for; there are 70"):
                indices_of(index, 70)
    for wrong in ([1, [2, 3]], np.array(1.5), np.array([0.5])):
        with pytest.raises(IndexError, match="images are chosen by a number"):
            indices_of(wrong, 70)


@pytest.mark.parametrize("name", FIELDS)
def test_any_index_gives_the_images_in_its_order(part: spadmnist.Part, name: str) -> None:
    field = FIELDS[name](part)
    for index in INDICES:
        numbers = np.arange(70)[list(index) if isinstance(index, tuple) else index]
        assert same(field[index], one_by_one(field, numbers)), index
        assert same(FIELDS[name](part[index])[:], field[index]), index


def test_nothing_chosen_has_a_type(part: spadmnist.Part) -> None:
    for index in ([], slice(5, 5), slice(9, 3, 2), np.zeros(70, bool), np.array([], np.int64)):
        assert len(part[index]) == 0
        assert part.qis[index].shape == (0, 3, 28, 28) and part.qis[index].dtype == np.uint8
        assert part.reconstruction["counts"].normalised[index].shape == (0, 28, 28)
        assert len(part.tr[index].offsets) == 1


@pytest.mark.parametrize(
    ("index", "says"),
    [
        (70, "image 70 was asked for; there are 70"),
        ([0, -71], "image -71 was asked for"),
        (np.ones(69, bool), "a mask of 69 was given for 70 images"),
        ([1.5], "chosen by a number"),
        (np.zeros((2, 2), int), "chosen by a number"),
        ("train", "chosen by a number"),
        (1.0, "chosen by a number"),
    ],
)
def test_a_wrong_index_is_a_sentence(part: spadmnist.Part, index: Any, says: str) -> None:
    for thing in (part, part.tr, part.images):
        with pytest.raises(IndexError, match=says):
            thing[index]


def test_an_image_has_what_the_fields_have(part: spadmnist.Part) -> None:
    one = part[-3]
    assert one.index == 67 and one.label == part.labels[67]  # type: ignore[index]
    assert same(one.tr, part.tr[67]) and same(one.frames, part.frames[67])
    assert same(one.qis, part.qis[67]) and same(one.str, part.str[67]) and same(one.counts, part.counts[67])
    assert same(one.image, part.images[67])
    assert same(one.reconstruction("counts"), part.reconstruction["counts"][67])
    assert same(one.reconstruction("counts", normalised=True), part.reconstruction["counts"].normalised[67])
    assert [image.index for image in part] == list(range(70))


def test_a_smaller_part_of_a_smaller_part(part: spadmnist.Part) -> None:
    inner = part[10:60:2][[3, 3, -1]]
    assert len(inner) == 3 and list(inner.labels) == [part.labels[i] for i in (16, 16, 58)]  # type: ignore[index, arg-type]
    assert same(inner.tr[:], one_by_one(part.tr, [16, 16, 58]))
    assert inner.reconstruction["counts"].normalisation == part.reconstruction["counts"].normalisation


def test_several_parts_as_one(opened: spadmnist.Dataset) -> None:
    """Each image is divided by the median of its own level."""
    parts = [opened[level, split] for level in opened.levels for split in ("train", "test")]
    whole = spadmnist.concatenate(parts)
    assert len(whole) == 152 and list(whole.labels) == [x for part in parts for x in part.labels]  # type: ignore[union-attr, arg-type]
    starts = np.cumsum([0, *map(len, parts)])
    chosen = [0, 69, 70, 75, 76, 151, 3]
    for name, get in FIELDS.items():
        whose = [int(np.searchsorted(starts, i, side="right")) - 1 for i in chosen]
        apart = [get(parts[k])[i - starts[k]] for k, i in zip(whose, chosen, strict=True)]
        together = type(apart[0]).join(apart) if isinstance(apart[0], Events | Frames) else np.stack(apart)
        assert same(get(whole)[chosen], together), name
        assert same(get(whole)[60:80], get(spadmnist.concatenate([whole[60:70], whole[70:80]]))[:]), name
    medians = {part.reconstruction["counts"].normalisation for part in parts}
    assert len(medians) == 2
    with pytest.raises(SpadError, match="each light level has a normalisation of its own"):
        _ = whole.reconstruction["counts"].normalisation
    assert spadmnist.concatenate(parts[:2]).reconstruction["counts"].normalisation in medians


def test_what_is_no_one_part_is_refused(opened: spadmnist.Dataset, tmp_path: Path) -> None:
    part = opened["30 lux", "train"]

    def other(*changes: tuple[str, str]) -> spadmnist.Part:
        text = sized(CONFIG)
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        file = tmp_path / "other.yaml"
        file.write_text(text)
        return spadmnist.open(file)["30 lux", "train"]

    with pytest.raises(SpadError, match="give one or more"):
        spadmnist.concatenate([])
    uniform = other(("{source: digits, train: 70, test: 6}", "{source: uniform}"), ("columns: 28", "columns: 20"))
    with pytest.raises(SpadError, match="differ in size"):
        spadmnist.concatenate([part, uniform])
    with pytest.raises(SpadError, match="causes of detections differ"):
        spadmnist.concatenate([part, other(("causes: true", "causes: false"))])
    coarse = spadmnist.concatenate([part, other(("1 ns", "2 ns"))])
    with pytest.raises(SpadError, match="other ticks"):
        coarse.tr[[0, 71]]
    longer = other(("frame_time: 8 us", "frame_time: 9 us"))
    with pytest.raises(SpadError, match="frames of another number, time or size"):
        spadmnist.concatenate([part, longer]).frames[[0, 71]]
    alone = other((READOUTS, ", readouts: [tr]"))
    both = spadmnist.concatenate([part, alone])
    assert both.readouts == ("tr",) and "qis_counts" not in both.reconstruction and "counts" in both.reconstruction
    with pytest.raises(SpadError, match="no readout in common"):
        spadmnist.concatenate([alone, other((READOUTS, ", readouts: [qis]"))])


def test_a_part_is_sent_without_its_images(opened: spadmnist.Dataset) -> None:
    part = opened["30 lux", "train"]
    assert part.labels is not None and part.reconstruction["counts"].normalised[0] is not None
    whole = spadmnist.concatenate([part, opened["20 mlux", "train"]])
    for sent in (part, part[::3], whole):
        packed = pickle.dumps(sent)
        assert len(packed) < 30_000
        back = pickle.loads(packed)
        assert same(back.tr[4], sent.tr[4]) and same(back.images[4], sent.images[4])
        assert same(back.reconstruction["counts"].normalised[[4]], sent.reconstruction["counts"].normalised[[4]])
        assert np.array_equal(back.labels, sent.labels)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.lists(st.integers(-300, 299), max_size=40))
def test_gathering_reads_each_image_once(numbers: list[int]) -> None:
    read: list[int] = []

    def get(start: int, stop: int) -> np.ndarray:
        read.extend(range(start, stop))
        return np.arange(start, stop) * 10

    indices = indices_of(numbers, 300) if numbers else np.array([], np.int64)
    assert isinstance(indices, np.ndarray)
    assert list(gather(get, indices)) == [n % 300 * 10 for n in numbers]
    assert len(read) == len(set(read)) and len(read) <= 32 * max(1, len(set(numbers)))


def test_gathering_reads_little_that_nobody_wants() -> None:
    """Of a strided choice it was all that lies between: 32 times what was asked for, in memory at once."""
    ranges: list[tuple[int, int]] = []

    def get(start: int, stop: int) -> np.ndarray:
        ranges.append((start, stop))
        return np.arange(start, stop)

    for step, block, wanted in ((32, 32, 47), (2, 32, 47), (2, 1, 750), (1, 32, 1), (1, 1, 1)):
        ranges.clear()
        assert np.array_equal(gather(get, np.arange(0, 1500, step), block), np.arange(0, 1500, step))
        assert len(ranges) == wanted
        assert step == 1 or max(stop - start for start, stop in ranges) <= block
    assert sum(stop - start for start, stop in ranges) == 1500


def test_what_is_chosen_is_unpacked_and_simulated_alone(part: spadmnist.Part, monkeypatch: pytest.MonkeyPatch) -> None:
    unpacked: list[int] = []
    simulated: list[int] = []
    for name in ("unpacked", "stamps"):
        kept = getattr(Frames, name)

        def counted(self: Frames, *kind: Any, kept: Any = kept) -> np.ndarray:
            unpacked.append(len(self.bits) // self.pixels)
            return kept(self, *kind)  # type: ignore[no-any-return]

        monkeypatch.setattr(Frames, name, counted)
    expose = Sensor.expose

    def seen(self: Sensor, photons: np.ndarray, *more: Any, **named: Any) -> Any:
        simulated.append(len(photons))
        return expose(self, photons, *more, **named)

    monkeypatch.setattr(Sensor, "expose", seen)
    for read in (lambda: part.qis[::8], lambda: part.str[[3, 60, 30, 3]], lambda: part[::8].qis[:]):
        chosen = read()
        assert unpacked == [len(chosen)] and unpacked.pop()
    assert sum(simulated) == (0 if part.stored else 9 + 3 + 9)


def test_a_name_that_a_dataset_has_not_is_a_sentence() -> None:
    """Shown as it is, not in the quotes of a KeyError."""
    ds = spadmnist.open(config.shipped("quick.yaml"))
    part = ds["2560 mlux", "train"]
    for ask, said in (
        (lambda: part.reconstruction["count"], "'count' is no method of this dataset; there are counts, "),
        (lambda: ds["2560 mlux", "dev"], "'dev' is not a split here; there are train, test"),
        (lambda: ds["7 mlux", "train"], "'7 mlux' is not a light level here."),
    ):
        with pytest.raises(KeyError) as caught:
            ask()
        assert str(caught.value).startswith(said)
    with pytest.raises(KeyError, match="Did you mean counts"):
        part.reconstruction["count"]


def test_a_dataset_is_sent_without_its_images(opened: spadmnist.Dataset) -> None:
    """With parts that were asked for already, and without."""
    first = opened["30 lux", "train"]
    data = pickle.dumps(opened)
    assert len(data) < 100_000
    again = pickle.loads(data)
    assert again.levels == opened.levels and again.splits == opened.splits and repr(again) == repr(opened)
    for level, split in (("30 lux", "train"), ("20 mlux", "test")):
        for name, field in FIELDS.items():
            assert same(field(again[level, split])[2:5], field(opened[level, split])[2:5]), name
    assert np.array_equal(again["30 lux", "train"].labels, first.labels)


def test_a_dataset_is_asked_like_a_mapping(opened: spadmnist.Dataset) -> None:
    assert list(opened) == list(opened.keys()) == ["20 mlux", "30 lux"] and len(opened) == 2
    for key in ("20 mlux", "0.02 lux", ("30 lux", "train"), ("30 lux", "test")):
        assert key in opened, key
    for key in ("5 mlux", "train", ("30 lux", "val"), ("5 mlux", "train"), 0, None, ("30 lux",), ("a", "b", "c")):
        assert key not in opened, key
