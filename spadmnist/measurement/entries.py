"""What `measurement.yaml` may say: the models of its entries."""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field, ValidationInfo

from .. import kinds
from ..errors import SpadError
from ..section import Section
from ..validated import Irradiance, Lux, Mean, Time, Uncertainty, Wavelength, brief

FORMAT = "spadmnist-measurement/1"
FILE = kinds.MEASUREMENT

_LONGEST = 100  # characters of a name


def _format(raw: object) -> object:
    if raw != FORMAT:
        raise ValueError(f"{brief(raw)} is not a format that this program reads; write {FORMAT}")
    return raw


def _name(raw: object) -> str:
    if isinstance(raw, str) and 0 < len(raw) <= _LONGEST and raw.isprintable() and raw == raw.strip():
        return raw
    hint = f'; write "{raw}"' if isinstance(raw, (int, float)) and not isinstance(raw, bool) else ""
    raise ValueError(f"{brief(raw)} is not a name: a line of 1 to {_LONGEST} characters{hint}")


def check_name(name: str, place: str = "--name") -> None:
    """Raise SpadError for a name that a measurement, or a capture, cannot have. place: where it was said."""
    try:
        _name(name)
    except ValueError as error:
        raise SpadError(f"{place}: {error}") from None


def _inside(raw: object, info: ValidationInfo) -> str:
    """The name of a file in the measurement's folder (the context), never of one outside."""
    if not isinstance(raw, str) or not raw.strip() or len(raw) > 255 or not raw.isprintable():
        raise ValueError(f"{brief(raw)} is not the name of a file")
    name = PurePosixPath(raw)
    if name.is_absolute() or ".." in name.parts or "\\" in raw or re.match(r"[A-Za-z]:", raw):
        raise ValueError(f"{brief(raw)} leads out of the measurement's folder; put the file there and write its name")
    folder: Any = info.context
    if not Path(os.path.realpath(folder / name)).is_relative_to(os.path.realpath(folder)):
        raise ValueError(f"{brief(raw)} is a link that leads out of the measurement's folder; put the file there")
    return raw


Format = Annotated[Literal[FORMAT], BeforeValidator(_format)]  # type: ignore[valid-type]
Name = Annotated[str, BeforeValidator(_name)]
File = Annotated[str, BeforeValidator(_inside)]


class Array(Section):
    """The pixels: a grid, or a list of positions, which counts as one row."""

    model_config = ConfigDict(
        json_schema_extra={"anyOf": [{"required": ["rows", "columns"]}, {"required": ["positions"]}]}
    )

    rows: int | None = Field(default=None, ge=1, le=100_000, description="rows of the grid")
    columns: int | None = Field(default=None, ge=1, le=100_000, description="columns of the grid")
    positions: File | None = Field(
        default=None, description="CSV file with x, y in um of each pixel, instead of rows and columns"
    )


MOST_FRAMES = 10**12  # binary frames of a capture, of which counts are sums: 11 days of 1 us


_WAVELENGTH = "wavelength of the light; 555 nm without it"


class _Light(Section):
    relative_uncertainty: Uncertainty | None = Field(
        default=None, description="standard uncertainty of the light's calibration, common to all captures; else 0"
    )
    own_uncertainty: Uncertainty | None = Field(
        default=None, description="standard uncertainty of the light of this capture alone; else 0"
    )


class Dark(_Light):
    """No light falls on the sensor."""

    kind: Literal["dark"]


class Flat(_Light):
    """The same light on all pixels. Without irradiance and lux its level is fitted."""

    kind: Literal["flat"]
    wavelength: Wavelength | None = Field(default=None, description=_WAVELENGTH)
    irradiance: Irradiance | None = Field(default=None, description="irradiance of the sensor")
    lux: Lux | None = Field(default=None, description="illuminance of the sensor, instead of irradiance")


class Image(_Light):
    """A scene: the light is proportional to an image. Without irradiance and lux the level of white is fitted."""

    kind: Literal["image"]
    file: File = Field(description="NumPy file of the image: uint8 with white 255, or floats from 0 to 1")
    tiles: File | None = Field(
        default=None,
        description="JSON file of the tiles of a chart: size, [rows, columns]; corners, the first row and column of "
        "each; numbers of the images; labels",
    )
    wavelength: Wavelength | None = Field(default=None, description=_WAVELENGTH)
    irradiance: Irradiance | None = Field(default=None, description="irradiance of the sensor where the image is white")
    lux: Lux | None = Field(default=None, description="illuminance there, instead of irradiance")


class _Capture(Section):
    id: Name = Field(description="name of the capture")
    file: File | None = Field(default=None, description="HDF5 file of the capture; a plan has none")
    mean: Mean | None = Field(
        default=None, description="mean detections of a pixel over the capture, instead of a file"
    )
    light: Annotated[Dark | Flat | Image, Field(discriminator="kind", description="light on the sensor")]


class Stamps(_Capture):
    """Time stamps of all detections."""

    modality: Literal["tr"]
    exposure: Time = Field(description="exposure of the capture")


class _Framed(_Capture):
    frames: int = Field(ge=1, le=MOST_FRAMES, description="number of binary frames")
    frame_time: Time = Field(description="time for which a frame is live")
    frame_period: Time | None = Field(
        default=None, description="time from one frame to the next; the frame time without it"
    )
    exposure: Time | None = Field(default=None, description="frames x frame period; checked")


class Frames(_Framed):
    """Frames: the first time stamp of each pixel (str), or whether there was a detection (qis)."""

    modality: Literal["str", "qis"]


class Counts(_Framed):
    """Frames of counts. The file contains bits and counting as well."""

    modality: Literal["counts"]
    bits: int | None = Field(default=None, ge=1, le=16, description="bits of a count")
    counting: Literal["frames", "counter"] | None = Field(
        default=None, description="a count is the sum of 2^bits - 1 binary frames, or a counter in each frame"
    )


Entry = Annotated[Stamps | Frames | Counts, Field(discriminator="modality")]

# each entry of the file is checked by itself, and so is each of the captures
SECTIONS: dict[str, Any] = {
    "format": Annotated[Format, Field(description="name and number of the format")],
    "name": Annotated[Name, Field(description="name of the measurement")],
    "layout": Array,
    "captures": Annotated[list[Any], Field(min_length=1)],
}
EXAMPLES = {
    "format": f"format: {FORMAT}",
    "layout": "layout: {rows: 16, columns: 16}",
    "rows": "rows: 16",
    "columns": "columns: 16",
    "captures": "captures: [{id: dark, file: dark.h5, modality: tr, light: {kind: dark}, exposure: 100 ms}]",
    "id": "id: dark",
    "light": "light: {kind: dark}",
    "wavelength": "wavelength: 500 nm",
    "file": "file: chart.npy",
    "tiles": "tiles: chart.json",
    "exposure": "exposure: 100 ms",
    "frames": "frames: 1000",
    "frame_time": "frame_time: 10 us",
    "bits": "bits: 8",
}
