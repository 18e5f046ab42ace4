"""One image of a stored shard: its file is opened once, a chunk that images share decoded once, and a change seen."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spadmnist
from spadmnist import config, factory, store
from spadmnist.errors import InputError
from spadmnist.sources import Local
from spadmnist.store import Column, recent, zarr

ROWS = 64


def written(root: Path, format: str, low: int = 0) -> store.ShardReader:
    encoding = store.encoding(format)
    data = np.arange(low, low + 4 * ROWS, dtype=np.uint32)
    encoding.write(root, "a/b/c", {"x/y": Column(data, ("n",), "1", "numbers", "ticks", ROWS)}, {})
    return encoding.reader(root, "a/b/c")


def counted(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str) -> list[str]:
    """The first arguments besides self of the calls of a method."""
    real, calls = getattr(owner, name), []

    def call(*args: Any) -> Any:
        calls.append(str(args[1]))
        return real(*args)

    monkeypatch.setattr(owner, name, call)
    return calls


def test_a_chunk_of_which_parts_are_wanted_is_decoded_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reader = written(tmp_path, "zarr")
    calls = counted(monkeypatch, zarr.ZarrReader, "_decode")
    for i in range(2 * ROWS):
        assert reader.read("x/y", i, i + 1) == [i]
    assert len(calls) == 2
    assert (reader.read("x/y") == np.arange(4 * ROWS)).all() and len(calls) == 6, "whole ones are not held"


@pytest.mark.parametrize("format", store.FORMATS)
def test_a_file_that_was_changed_since_is_read_anew(format: str, tmp_path: Path) -> None:
    reader = written(tmp_path, format)
    assert reader.read("x/y", 3, 4) == [3]
    place = tmp_path / store.encoding(format).location("a/b/c")
    data = bytearray(place.read_bytes())
    offset, length = reader._array("x/y").places[0]
    data[offset + length // 2] ^= 1
    place.write_bytes(data)
    os.utime(place, ns=(1, 1))  # no clock decides
    with pytest.raises(InputError, match="changed or damaged"):
        reader.read("x/y", 3, 4)


def test_readers_of_two_datasets_share_nothing(tmp_path: Path) -> None:
    one, other = written(tmp_path / "1", "zarr"), written(tmp_path / "2", "zarr", 100)
    for path in tmp_path.glob("*/data/a/b/*"):
        os.utime(path, ns=(1, 1))
    assert one.read("x/y", 3, 4) == [3] and other.read("x/y", 3, 4) == [103]


def test_what_is_held_has_a_bound_and_cannot_be_written_to() -> None:
    held = recent.Recent(1000)
    for i in range(50):
        held.keep(i, np.full(90, i, np.uint8))
        held.find(0)  # is asked for each time, and stays
    assert [i for i in range(50) if held.find(i) is not None] == [0, *range(40, 50)]
    held.keep(49, np.zeros(900, np.uint8))
    assert sum(one.nbytes for one in held._held.values()) == held._bytes <= 1000
    held.keep("large", np.zeros(1001, np.uint8))
    assert held.find("large") is None
    with pytest.raises(ValueError, match="read-only"):
        held.find(49)[0] = 1  # type: ignore[index]


def test_one_images_stream_opens_its_file_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    experiment = config.read(config.shipped("quick.yaml"), lux=("2560 mlux",), limit=4)
    factory.generate(experiment, experiment.load_images(), tmp_path / "out", 1)
    part = spadmnist.open(tmp_path / "out")["2560 mlux", "train"]
    first = part.tr[0]
    calls = counted(monkeypatch, Local, "open")
    assert (part.tr[0].ticks == first.ticks).all() and len(part.tr[3].ticks)
    assert calls == ["data/2560_mlux/train/00000.zarr.zip"] * 2
