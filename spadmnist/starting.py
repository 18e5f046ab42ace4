"""A folder to begin with: a config and a sensor that run as they are, a plan for a bench, or the program's examples."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from . import config, disk, document, images, schema
from .errors import InputError, SpadError
from .image_files import read_image
from .measurement import entries
from .sensor import Sensor

_CONFIG, _SENSOR = "config.yaml", "sensor.yaml"


@dataclass(frozen=True)
class _Begun:
    """A sensor that comes with the program, and how it is used.

    file: where it is described; positions: of its pixels, a file beside; readouts, exposure, lux: of a first dataset.
    """

    file: str
    readouts: str
    exposure: str
    lux: str
    positions: str = ""

    @property
    def framed(self) -> bool:
        return self.readouts != "tr"


_SENSORS = {
    "spad23": _Begun("spad23_sensor.yaml", "tr", "100 ms", "1 mlux, 10 mlux", "spad23_positions.csv"),
    "spad512": _Begun("spad512_sensor.yaml", "qis", "1 ms", "80 mlux, 650 mlux"),
    "spad_mnist": _Begun("spad_mnist.yaml", "tr, str, qis", "1 ms", "80 mlux, 2560 mlux"),
}


def dataset(folder: Path, sensor: str, pictures: Path | None) -> dict[str, str]:
    """The files of a first dataset by name, the config last. pictures: a folder of them.

    Raises InputError where that holds none, or the first cannot be read.
    """
    begun, chip = _SENSORS[sensor], config.read_sensor(config.shipped(_SENSORS[sensor].file))
    files = {schema.file_of(kind): schema.text(kind) for kind in ("config", "sensor")}
    files |= _positions(begun)
    files[_SENSOR] = _sensor(begun)
    files[_CONFIG] = _explained(schema.first_line("config"), _config(folder, begun, chip, pictures))
    return files


def measurement(folder: Path, sensor: str) -> dict[str, str]:
    """The files of a plan of captures by name, the plan last."""
    begun, chip = _SENSORS[sensor], config.read_sensor(config.shipped(_SENSORS[sensor].file))
    files = {schema.file_of("measurement"): schema.text("measurement"), **_positions(begun)}
    files[entries.FILE] = _explained(schema.first_line("measurement"), _plan(folder, begun, chip))
    return files


def examples() -> dict[str, str]:
    """The configs, sensors and the tutorial that come with the program, by name."""
    return {name: path.read_text() for name, path in config.examples().items()}


def write(folder: Path, files: Mapping[str, str]) -> list[Path]:
    """Write the files of a folder; their paths. A file that is there with the same text stays.

    Raises SpadError, before anything is written, where one is there with another text; and where it cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise SpadError(f"{folder}: is a file; name a folder, which is made")
    paths = {folder / name: text.encode() for name, text in files.items()}
    for path, data in paths.items():
        if os.path.lexists(path) and not _is(path, data):
            raise SpadError(f"{path}: is there already, and is not written over; remove it, or name another folder")
    for path, data in paths.items():
        if not os.path.lexists(path):
            disk.put_file(path, data)
    return list(paths)


def _is(path: Path, data: bytes) -> bool:
    try:
        return disk.read_file(path, len(data)) == data
    except OSError:
        return False


# --- texts --------------------------------------------------------------------------------------------------------

_Lines = list[tuple[str, str]]  # what stands there, and what it means

_COLUMN = 36  # characters of a line before its comment, if they will do


def _explained(first: str, lines: _Lines) -> str:
    """A line each; one without text is a comment by itself."""
    made = [f"{text:<{_COLUMN}}  # {about}" if text else f"# {about}".rstrip() for text, about in lines]
    return first + "\n".join(made) + "\n"


def _quoted(text: str) -> str:
    """Text as YAML has it."""
    return document.dump({"text": text}).removeprefix("text: ").rstrip("\n")


def _positions(begun: _Begun) -> dict[str, str]:
    return {begun.positions: config.shipped(begun.positions).read_text()} if begun.positions else {}


def _sensor(begun: _Begun) -> str:
    """The sensor's part of the file that comes with the program, with its comments."""
    text = config.shipped(begun.file).read_text()
    (whole,) = re.findall(r"^sensor:.*\n(?:(?: .*)?\n)*", text, re.M)
    head = (
        f"# A sensor to begin with: the program's {begun.file}. `spadmnist effects NAME` explains one of these.\n"
        '#\n# "paper" below is: Suonsivu et al., Accurate Simulation Pipeline for Passive Single-Photon Imaging.\n\n'
    )
    return f"{schema.first_line('sensor')}{head}{whole.rstrip()}\n"


def _config(folder: Path, begun: _Begun, chip: Sensor, pictures: Path | None) -> _Lines:
    here = folder.name or "config"
    lines = [
        ("", "A first dataset. What it costs, and then the dataset:"),
        ("", ""),
        ("", f"  spadmnist generate {_CONFIG} --dry-run"),
        ("", f"  spadmnist generate {_CONFIG} -o {here}_dataset"),
        ("", ""),
        ("seed: 1", "one seed, the same bytes on every machine"),
        ("scene:", "what the sensor sees"),
        *(_uniform() if chip.layout.positions is not None and pictures is None else []),
    ]
    if pictures is not None:
        lines += _folder(folder, chip, pictures)
    elif chip.layout.positions is None:
        lines += _digits(chip)
    lines += [
        ("  wavelength: 555 nm", "lux are turned into power with 683 lm/W, which holds at 555 nm"),
        (f"  lux: [{begun.lux}]", "light levels, of white on the sensor; a dataset has all images at each"),
        ("recording:", "how long, and what is read out"),
        (f"  exposure: {begun.exposure}", "frames x frame_period" if begun.framed else "of one image"),
    ]
    if begun.framed:
        lines += [
            ("  frames: 100", "binary frames of one image"),
            ("  frame_time: 10 us", "how long a frame is open"),
            ("  frame_period: 10 us", "from one frame to the next; longer where there is a gap"),
        ]
    return [
        *lines,
        (
            f"  readouts: [{begun.readouts}]",
            "tr: time stamps; str: the first of each frame; qis: bits; counts",
        ),
        ("output:", "how it is stored"),
        ("  format: zarr", "zarr, or hdf5 (for MATLAB)"),
        (f"sensor: {_SENSOR}", "its pixels and effects, in a file of their own"),
    ]


def _uniform() -> _Lines:
    return [
        ("  images:", "what is in front of it"),
        ("    source: uniform", "even light; folder: pictures of your own; digits, mnist, idx, array, chart"),
        ("    repetitions: 10", "so many recordings"),
    ]


def _digits(chip: Sensor) -> _Lines:
    large = chip.layout.pixels > 1 << 14
    return [
        ("  images:", "what is in front of it"),
        ("    source: digits", "drawn by the program; folder: pictures of your own; mnist, idx, array, uniform, chart"),
        (f"    train: {10 if large else 400}", "so many to train with"),
        (f"    test: {5 if large else 100}", "so many to test with"),
        (f"    rows: {chip.layout.rows}", "the size of the sensor"),
        (f"    columns: {chip.layout.columns}", "the same"),
    ]


def _folder(folder: Path, chip: Sensor, pictures: Path) -> _Lines:
    """Of pictures as they are: their number and the size of the first stand there."""
    if not pictures.is_dir():
        raise InputError(f"--images {pictures}: there is no such folder; name one with pictures")
    names, _ = images.pictures_in(pictures)
    if not names:
        raise InputError(f"--images {pictures}: there is no picture in it; put some there, or name another folder")
    first, _ = read_image(pictures / names[0], exif=True)
    rows, columns = first.shape[-2:]
    path = _quoted(Path(os.path.relpath(pictures.resolve(), folder.resolve())).as_posix())
    held = f"{len(names)} pictures, the first {rows} x {columns} pixels" if len(names) > 1 else "1 picture"
    size = f"[{chip.layout.rows}, {chip.layout.columns}]"
    return [
        ("  images:", f"what is in front of it: {held}"),
        ("    source: folder", "pictures of your own; folders in it are classes, train and test are splits"),
        (f"    path: {path}", "where they are, seen from this file"),
        (f"    resize: {size}", "rows and columns of the sensor; light is averaged over each pixel"),
        ("    fit: crop", "where the sides differ: crop what is over, pad with black, or stretch"),
        ("    grey: true", "luminance, for no pixel has a colour filter; false: each channel is an image"),
        ("    gamma: srgb", "values back to light: 128 gets 22 % of white's photons; linear: 50 %, as of raw data"),
        ("    exif: true", "turn photographs as the camera was held"),
    ]


def _plan(folder: Path, begun: _Begun, chip: Sensor) -> _Lines:
    name = folder.resolve().name or "bench"
    layout = f"rows: {chip.layout.rows}, columns: {chip.layout.columns}"
    layout = f"positions: {begun.positions}" if begun.positions else layout
    captures = (("dark", ""), ("flat-dim", "1 nW/cm^2"), ("flat-bright", "100 nW/cm^2"))
    clock = [
        ("    frames: 10000", "how many; more frames show smaller effects"),
        ("    frame_time: 10 us", "how long a frame is open"),
        ("    frame_period: 10 us", "from one frame to the next"),
    ]
    lines = [
        ("", "A plan for a bench: record these captures, then"),
        ("", ""),
        ("", f"  spadmnist import FILE... -o {name}"),
        ("", ""),
        ("", "takes each file for the capture whose name it bears (or --capture says), and writes it down here."),
        ("", "What stands here must be what was done: correct light and clock first."),
        ("", ""),
        (f"format: {entries.FORMAT}", "of this file"),
        (f"name: {_quoted(name)}", "of the measurement"),
        (f"layout: {{{layout}}}", "the pixels that are read out"),
        ("captures:", "one dark, some lit, over as wide a range as there is"),
    ]
    for id, level in captures:
        lines += [
            (f"  - id: {id}", "its name, and that of its file"),
            (
                f"    modality: {'qis' if begun.readouts == 'qis' else 'tr'}",
                "tr: time stamps; str, qis, counts: frames",
            ),
            *(clock if begun.readouts == "qis" else [("    exposure: 100 ms", "how long; more light shows more")]),
        ]
        if not level:
            lines.append(("    light: {kind: dark}", "the cap is on"))
            continue
        lines += [
            ("    light:", "what falls on the sensor"),
            ("      kind: flat", "the same on all pixels; image: a scene, with its file"),
            ("      wavelength: 500 nm", "of the lamp"),
            (f"      irradiance: {level}", "as a power meter says; left out: the level is not known"),
            ("      relative_uncertainty: 5 %", "one standard deviation of the meter, common to all captures"),
        ]
    return lines
