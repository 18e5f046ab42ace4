"""What the sections of a config, and a sensor file, may hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, PlainValidator, WithJsonSchema, model_validator

from .. import units
from ..images import ImageSource
from ..section import LATER, Section
from ..validated import Amount, Area, Irradiance, Lux, Share, Time, brief, written

_CHANNELS = ("red", "green", "blue")  # of colour images, in their order


def _of_light(raw: object) -> units.Quantity | list[units.Quantity]:
    """A wavelength, or one for each channel of colour images: a list of three, or red, green and blue."""
    if isinstance(raw, Mapping):
        if set(raw) != set(_CHANNELS):
            written = "{red: 620 nm, green: 540 nm, blue: 460 nm}"
            raise ValueError(f"{brief(dict(raw))} is not possible; give red, green and blue, as in {written}")
        raw = [raw[name] for name in _CHANNELS]
    if not isinstance(raw, list):
        return _one_length(raw)
    if len(raw) != len(_CHANNELS):
        raise ValueError(f"{brief(raw)} is not possible; give one wavelength, or one for each of red, green and blue")
    return [_one_length(one) for one in raw]


_one_length = Amount("m", within=units.WAVELENGTHS).read


_LENGTH = written("m", signed=False)
_LENGTHS = {
    "anyOf": [
        _LENGTH,
        {"type": "array", "items": _LENGTH, "minItems": len(_CHANNELS), "maxItems": len(_CHANNELS)},
        {
            "type": "object",
            "properties": dict.fromkeys(_CHANNELS, _LENGTH),
            "required": list(_CHANNELS),
            "additionalProperties": False,
        },
    ]
}


class _Scene(Section):
    """Images and light levels. The levels are given once, as lux or as irradiance."""

    model_config = ConfigDict(json_schema_extra={"oneOf": [{"required": ["lux"]}, {"required": ["irradiance"]}]})

    images: ImageSource = Field(description="source of the images")
    wavelength: Annotated[Any, PlainValidator(_of_light), WithJsonSchema(_LENGTHS)] = Field(
        default="555 nm", description="wavelength of the light, or of each channel of colour images"
    )
    lux: list[Lux] | None = Field(
        default=None, min_length=1, description="light levels: illuminance of the sensor where the image is white"
    )
    irradiance: list[Irradiance] | None = Field(
        default=None, min_length=1, description="light levels: irradiance of the sensor where the image is white"
    )

    @property
    def wavelengths(self) -> tuple[units.Quantity, ...]:
        """One, or one for each channel."""
        return tuple(self.wavelength) if isinstance(self.wavelength, list) else (self.wavelength,)


class _Recording(Section):
    """Exposure, frames and readouts. The exposure is frames x frame_period."""

    exposure: Time = Field(description="exposure of an image")
    frames: int | None = Field(default=None, ge=1, le=10**9, description="number of frames; needed by str, qis, counts")
    frame_time: Time | None = Field(default=None, description="time for which a frame is live")
    frame_period: Time | None = Field(
        default=None, description="time from one frame to the next; the frame time without it"
    )
    readouts: list[Literal["tr", "str", "qis", "counts"]] = Field(
        default=["tr", "str", "qis"],
        min_length=1,
        description="what is recorded: time stamps, first time stamps of frames, 1-bit frames, count frames",
    )
    bits: int | None = Field(default=None, ge=1, le=12, description="bits of a count; needed by counts")
    counting: Literal["frames", "counter"] | None = Field(
        default=None,
        description="a count is the sum of 2^bits - 1 binary frames, or a counter in each frame; frames without it",
    )


class _Output(Section):
    """The files of the dataset."""

    format: Literal["zarr", "hdf5"] = Field(default="zarr", description="format of the shards")
    compression: Annotated[Literal["fast", "small"], LATER] = Field(
        default="fast", description="fast, or small: 2 to 3 % fewer bytes, which take longer to make; zarr alone has it"
    )
    reconstructions: Annotated[Literal["stored", "on_reading"], LATER] = Field(
        default="stored",
        description="flux images are stored, or made from the streams when spadmnist reads them: other programs then "
        "see the streams alone",
    )

    @model_validator(mode="after")
    def _has_both(self) -> _Output:
        if self.compression == "small" and self.format != "zarr":
            raise ValueError("compression: small is for format: zarr; take one of them out")
        return self


class _Layout(Section):
    """The pixels: a grid, or a list of positions."""

    model_config = ConfigDict(
        json_schema_extra={"oneOf": [{"required": ["rows", "columns"]}, {"required": ["positions"]}]}
    )

    rows: int | None = Field(default=None, ge=1, le=100_000, description="rows of the grid")
    columns: int | None = Field(default=None, ge=1, le=100_000, description="columns of the grid")
    positions: str | None = Field(
        default=None, description="CSV file with x, y in um of each pixel, instead of rows and columns"
    )
    pixel_area: Area = Field(description="area of a pixel")
    fill_factor: Share = Field(  # type: ignore[assignment]
        default="1", description="share of the pixel area that is active"
    )


class _Sensor(Section):
    """A sensor: a layout of pixels and a list of effects."""

    name: str = Field(default="", description="name of the sensor, for reports")
    rules: Literal["paper", "device"] = Field(
        default="paper", description="the paper's Algorithm 1, or a real pixel, which fires once a frame"
    )
    chip_seed: int = Field(default=0, ge=0, lt=2**63, description="seed of what is fixed when the chip is made")
    layout: _Layout
    effects: dict[str, Any]  # each is read by what its class declares


_SENSOR = Annotated[str | _Sensor, Field(description="the sensor, or the file of one")]

# the sections of a config: each is checked by itself, so that a mistake in one hides none in another
_SECTIONS: dict[str, Any] = {
    "seed": Annotated[int, Field(ge=0, lt=2**63, description="seed of all random numbers")],
    "limit": Annotated[int | None, Field(ge=1, description="only the first images of each split"), LATER],
    "causes": Annotated[bool, Field(description="store the cause and the parent of every detection"), LATER],
    "scene": _Scene,
    "recording": _Recording,
    "reconstruct": Annotated[
        list[str] | None, Field(description="methods of flux images; without it all that the readouts allow")
    ],
    "sensor": Any,
    "output": _Output,
}
_DEFAULTS: dict[str, Any] = {"limit": None, "causes": False, "reconstruct": None, "output": {}}
_EXAMPLES = {
    "seed": "seed: 1",
    "scene": "scene: {images: {source: digits}, lux: [5 mlux]}",
    "recording": "recording: {exposure: 1 ms, frames: 100, frame_time: 10 us}",
    "sensor": "sensor: FILE.yaml, or the sensor itself",
    "exposure": "exposure: 1 ms",
    "images": "images: {source: mnist}",
    "layout": "layout: {rows: 28, columns: 28, pixel_area: 25 um^2}",
    "rows": "rows: 28",
    "columns": "columns: 28",
    "pixel_area": "pixel_area: 25 um^2",
    "effects": "effects: {detection: {pdp: 0.5}}",
}
