"""A file that a user names is opened without waiting: a pipe, a socket or a device in its place is one sentence."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import COMMAND
from test_factory import write_config
from test_importers import LINO, run, words
from test_shards import at_once

import spadmnist
from spadmnist import config, disk, document, images, measurement, plugins, sensor_file, verify
from spadmnist.errors import InputError, SpadError


def pipe(path: Path) -> None:
    os.mkfifo(path)


def listener(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made, contextlib.chdir(path.parent):
        made.bind(path.name)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    path.mkdir()


@pytest.fixture(params=[pipe, listener, device, folder], ids=lambda make: make.__name__)
def odd(request: pytest.FixtureRequest) -> Callable[[Path], None]:
    made: Callable[[Path], None] = request.param
    return made


def as_sensor(path: Path) -> object:
    file = write_config(path.parent / "a.yaml")
    text = file.read_text()
    file.write_text(text[: text.index("sensor:")] + f"sensor: {path.name}\n")
    return config.read(file)


def as_map(path: Path) -> object:
    file = write_config(path.parent / "a.yaml")
    file.write_text(file.read_text().replace("rate: 100 Hz", f"rate: {{file: {path.name}}}"))
    return config.read(file)


def as_positions(path: Path) -> object:
    file = write_config(path.parent / "a.yaml")
    file.write_text(file.read_text().replace("rows: 8, columns: 8, pixel_area", f"positions: {path.name}, pixel_area"))
    return config.read(file)


def as_picture(path: Path) -> object:
    return images.read_image(path)


def as_calibration(path: Path) -> object:
    file = words(path.parent / "a.dat", [(0, 5, 0, 7)])
    return run(file, replace(LINO, firmware="2212b", tdc=path))


def as_offsets(path: Path) -> object:
    file = words(path.parent / "a.dat", [(0, 5, 0, 7)])
    head = "," + ",".join(map(str, range(140)))
    table = np.c_[np.arange(256), np.tile(np.linspace(0, 2500, 141)[1:], (256, 1))]
    np.savetxt(path.parent / "t.csv", table, delimiter=",", header=head, comments="")
    return run(file, replace(LINO, firmware="2212b", tdc=path.parent / "t.csv", offsets=path))


def as_capture(path: Path) -> object:
    capture = f"{{id: a, file: {path.name}, modality: tr, light: {{kind: dark}}, exposure: 1 s}}"
    text = "format: spadmnist-measurement/1\nname: lab\nlayout: {rows: 2, columns: 2}\n"
    (path.parent / "measurement.yaml").write_text(f"{text}captures: [{capture}]\n")
    return measurement.open(path.parent)


def as_next_sensor(path: Path) -> None:
    sensor_file.check_place(path.parent / "sensor.yaml", path)


USES: list[tuple[Callable[[Path], object], str]] = [
    (config.read, "x.yaml"),
    (config.read_sensor, "x.yaml"),
    (document.read, "x.yaml"),
    (as_sensor, "x.yaml"),
    (as_map, "x.npy"),
    (as_positions, "x.csv"),
    (plugins.load_file, "x.py"),
    (as_picture, "x.png"),
    (run, "x.npy"),
    (as_calibration, "x.csv"),
    (as_offsets, "x.npy"),
    (measurement.open, "x.yaml"),
    (as_capture, "x.h5"),
    (as_next_sensor, "next.yaml"),
]


@pytest.mark.parametrize(("use", "name"), USES, ids=[use.__name__ for use, _ in USES])
def test_what_is_no_file(use: Callable[[Path], object], name: str, odd: Callable[[Path], None], tmp_path: Path) -> None:
    odd(tmp_path / name)
    with at_once(), pytest.raises(SpadError) as caught:
        use(tmp_path / name)
    said = str(caught.value)
    assert (name in said or (odd is device and "/dev/zero" in said)) and "\n" not in said, said


@pytest.mark.parametrize("verb", [spadmnist.open, verify.verify], ids=["open", "verify"])
def test_what_is_no_dataset(verb: Callable[[Path], object], odd: Callable[[Path], None], tmp_path: Path) -> None:
    odd(tmp_path / "out")
    with at_once(), pytest.raises(InputError, match=r"out: is a|out is no"):
        verb(tmp_path / "out")


def test_what_is_said(tmp_path: Path) -> None:
    for make, word in ((pipe, "a pipe"), (listener, "a socket"), (device, "a device")):
        make(tmp_path / make.__name__)
        with at_once(), pytest.raises(InputError, match=f"{make.__name__}: is {word}.*; name a file"):
            disk.opened(tmp_path / make.__name__)
    with pytest.raises(IsADirectoryError):
        disk.opened(tmp_path)
    (tmp_path / "file").write_bytes(b"abc")
    (tmp_path / "link").symlink_to("file")
    with disk.opened(tmp_path / "link") as file:
        assert file.read() == b"abc"


@pytest.mark.slow
@pytest.mark.parametrize("place", ["/dev/stdin", "/dev/fd/0", "/proc/self/fd/0"])
def test_what_is_handed_over_open_may_be_a_pipe(place: str, tmp_path: Path) -> None:
    if not os.path.exists("/".join(place.split("/")[:-1])):
        pytest.skip(f"there is no {place} here")
    text = write_config(tmp_path / "a.yaml").read_text()
    command = [COMMAND, "generate", place, "-o", str(tmp_path / "out"), "--dry-run", "--jobs", "1"]
    result = subprocess.run(command, input=text, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0 and "light level" in result.stdout, result.stderr
