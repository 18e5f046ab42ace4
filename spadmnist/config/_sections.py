"""What the sections of a config, and a sensor file, may hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, PlainValidator, WithJsonSchema

from .. import units
from ..images import ImageSource
from ..section import LATER, Section
from ..validated import Area, Irradiance, Lux, Share, Time, brief, written

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


def _one_length(raw: object) -> units.Quantity:
    value = units.parse(raw, "m")
    if not value > 0:
        raise ValueError(f"{value} is not possible; it must be more than 0")
    return value


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
    model_config = ConfigDict(json_schema_extra={"oneOf": [{"required": ["lux"]}, {"required": ["irradiance"]}]})

    images: ImageSource
    wavelength: Annotated[Any, PlainValidator(_of_light), WithJsonSchema(_LENGTHS)] = Field(default="555 nm")
    lux: list[Lux] | None = Field(default=None, min_length=1)
    irradiance: list[Irradiance] | None = Field(default=None, min_length=1)

    @property
    def wavelengths(self) -> tuple[units.Quantity, ...]:
        """One, or one for each channel."""
        return tuple(self.wavelength) if isinstance(self.wavelength, list) else (self.wavelength,)


class _Recording(Section):
    exposure: Time
    frames: int | None = Field(default=None, ge=1, le=10**9)
    frame_time: Time | None = None
    frame_period: Time | None = None
    readouts: list[Literal["tr", "str", "qis", "counts"]] = Field(default=["tr", "str", "qis"], min_length=1)
    bits: int | None = Field(default=None, ge=1, le=12)
    counting: Literal["frames", "counter"] | None = None


class _Output(Section):
    format: Literal["zarr", "hdf5"] = "zarr"


class _Layout(Section):
    model_config = ConfigDict(
        json_schema_extra={"oneOf": [{"required": ["rows", "columns"]}, {"required": ["positions"]}]}
    )

    rows: int | None = Field(default=None, ge=1, le=100_000)
    columns: int | None = Field(default=None, ge=1, le=100_000)
    positions: str | None = None  # a CSV file, instead of rows and columns
    pixel_area: Area
    fill_factor: Share = Field(default="1")  # type: ignore[assignment]


class _Sensor(Section):
    name: str = ""
    rules: Literal["paper", "device"] = "paper"
    chip_seed: int = Field(default=0, ge=0, lt=2**63)
    layout: _Layout
    effects: dict[str, Any]  # each is read by what its class declares


# the sections of a config: each is checked by itself, so that a mistake in one hides none in another
_SECTIONS: dict[str, Any] = {
    "seed": Annotated[int, Field(ge=0, lt=2**63)],
    "limit": Annotated[int | None, Field(ge=1), LATER],
    "causes": Annotated[bool, LATER],
    "scene": _Scene,
    "recording": _Recording,
    "reconstruct": list[str] | None,
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
