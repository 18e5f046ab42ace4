"""A large file is synchronised while it is still being made; an error of that ends the write."""

from __future__ import annotations

import errno
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from spadmnist import disk, system
from spadmnist.errors import SpadError

PIECE = bytes(1 << 20)
PIECES = 3 * disk._SYNC_EVERY // len(PIECE)


def test_a_large_file_is_synchronised_before_it_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []
    real, begun = system.synchronise, threading.Event()

    def watched(path: Path) -> None:
        if path.is_file():
            sizes.append(path.stat().st_size)
        begun.set()
        real(path)

    def pieces() -> Iterator[bytes]:
        yield from [PIECE] * (PIECES - 1)
        assert begun.wait(20), "nothing was synchronised before the last piece"
        yield PIECE

    monkeypatch.setattr(system, "synchronise", watched)
    made = disk.put_tree(tmp_path / "new", {"shard": pieces()})
    assert made["shard"]["bytes"] == PIECES * len(PIECE) == sizes[-1], "the whole file is synchronised at the end"
    assert sizes[0] < sizes[-1]


def test_an_early_synchronisation_that_fails_ends_the_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, calls = system.synchronise, []

    def broken_once(path: Path) -> None:
        calls.append(path)
        if len(calls) == 1:  # the system reports an error of a file once
            raise OSError(errno.EIO, "Input/output error")
        real(path)

    monkeypatch.setattr(system, "synchronise", broken_once)
    with pytest.raises(SpadError, match="Input/output error"), disk.writing(tmp_path / "new", 1):
        disk.put_tree(tmp_path / "new", {"shard": iter([PIECE] * PIECES)})
    assert len(calls) > 1
