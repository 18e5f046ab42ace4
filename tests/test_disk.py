"""A large file is synchronised while it is still being made; an error of that ends the write."""

from __future__ import annotations

import errno
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from spadmnist import config, disk, document, factory, system
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


@pytest.mark.parametrize(
    ("size", "words"),
    [(0, "0 bytes"), (9999, "9999 bytes"), (10_000, "0.01 MB"), (3.21e6, "3.21 MB"), (999.4e6, "999 MB"),
     (999.6e6, "1 GB"), (123.4e9, "123 GB"), (5e12, "5 TB")],
)  # fmt: skip
def test_amounts_are_said_in_a_unit_of_their_size(size: float, words: str) -> None:
    assert disk.amount(size) == words


def test_a_nearly_full_disk_is_told_in_amounts_that_tell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = """
seed: 1
scene: {images: {source: digits, train: 200, test: 2, rows: 8, columns: 8}, lux: [20 mlux]}
recording: {exposure: 800 us, frames: 80, frame_time: 10 us, readouts: [qis]}
sensor: {layout: {rows: 8, columns: 8, pixel_area: 25 um^2}, effects: {detection: {pdp: 0.5}}}
"""
    experiment = config.build(document.parse(text, "lab.yaml"), tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda place: shutil._ntuple_diskusage(10**9, 10**9, 2000))  # type: ignore[attr-defined]
    with pytest.raises(SpadError, match=r"about 0\.[0-9]+ MB are still to be written, but only 2000 bytes are free"):
        factory._check_space(tmp_path, experiment, experiment.load_images(), 0)
