"""What `measurement.yaml` may say: the models of its entries."""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field, ValidationInfo

from ..errors import SpadError
from ..section import Section
from ..validated import Irradiance, Length, Lux, Mean, Time, Uncertainty, brief

FORMAT = "spadmnist-measurement/1"
FILE = "measurement.yaml"

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
    """`layout`: rows and columns, or the places of the pixels in a CSV file, which count as one row."""

    model_config = ConfigDict(
        json_schema_extra={"anyOf": [{"required": ["rows", "columns"]}, {"required": ["positions"]}]}
    )

    rows: int | None = Field(default=None, ge=1, le=100_000)
    columns: int | None = Field(default=None, ge=1, le=100_000)
    positions: File | None = None


MOST_FRAMES = 10**12  # binary frames of a capture, of which counts are sums: 11 days of 1 us


class _Light(Section):
    relative_uncertainty: Uncertainty | None = None
    own_uncertainty: Uncertainty | None = None


class Dark(_Light):
    """No light falls on the sensor."""

    kind: Literal["dark"]


class Flat(_Light):
    """The same light on all pixels. Without irradiance and lux its level is free."""

    kind: Literal["flat"]
    wavelength: Length | None = None
    irradiance: Irradiance | None = None
    lux: Lux | None = None


class Image(_Light):
    """An image that the light follows: a scene. Without irradiance and lux the level of its white is free.

    tiles: a JSON file that says where the tiles of a chart lie: size, [rows, columns]; corners, of each its first row
    and column; numbers, of the images that they are; labels, where there are any.
    """

    kind: Literal["image"]
    file: File
    tiles: File | None = None
    wavelength: Length | None = None
    irradiance: Irradiance | None = None
    lux: Lux | None = None


class _Capture(Section):
    id: Name
    file: File | None = None
    mean: Mean | None = None
    light: Annotated[Dark | Flat | Image, Field(discriminator="kind")]


class Stamps(_Capture):
    """Time stamps of all detections."""

    modality: Literal["tr"]
    exposure: Time


class _Framed(_Capture):
    frames: int = Field(ge=1, le=MOST_FRAMES)
    frame_time: Time
    frame_period: Time | None = None
    exposure: Time | None = None


class Frames(_Framed):
    """Frames, each with the first detection of a pixel, or whether there was one."""

    modality: Literal["str", "qis"]


class Counts(_Framed):
    """Frames of counts; a file says itself what is counted."""

    modality: Literal["counts"]
    bits: int | None = Field(default=None, ge=1, le=16)
    counting: Literal["frames", "counter"] | None = None


Entry = Annotated[Stamps | Frames | Counts, Field(discriminator="modality")]

# each entry of the file is checked by itself, and so is each of the captures
SECTIONS: dict[str, Any] = {
    "format": Format,
    "name": Name,
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
