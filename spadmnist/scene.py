"""Scenes: an image that the light on the sensor follows, as a chart in front of the camera."""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from . import disk
from .errors import InputError
from .image_files import HEAD, another, read_npy

if TYPE_CHECKING:
    from .tiles import Tiles

_LARGEST = 1 << 30  # bytes of a scene's file


@dataclass(frozen=True)
class Scene:
    """What share of white each pixel sees; scenes of the same values are equal.

    Attributes:
        name: of its file.
        stored: (rows, columns) as it lies there, uint8 (white 255) or float (0 to 1), read-only.
        sha256: digest of the values.
        tiles: of the chart that it is; None where they are not known.
    """

    name: str = field(compare=False)
    stored: np.ndarray = field(repr=False, compare=False)
    sha256: str = field(default="", init=False)
    tiles: Tiles | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        view = np.ascontiguousarray(self.stored).view()
        view.flags.writeable = False
        digest = hashlib.sha256(f"{view.shape}".encode())
        object.__setattr__(self, "stored", view)
        digest.update(self.share.tobytes())
        object.__setattr__(self, "sha256", digest.hexdigest())

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        rows, columns = self.stored.shape
        return rows, columns

    @property
    def share(self) -> np.ndarray:
        """(pixels,) float64, of the light of white, from 0 to 1."""
        white = 255.0 if self.stored.dtype == np.uint8 else 1.0
        return self.stored.ravel().astype(np.float64) / white

    def file(self) -> bytes:
        """Its file: the same bytes for the same array."""
        out = io.BytesIO()
        np.save(out, self.stored, allow_pickle=False)
        return out.getvalue()


def read(path: Path) -> Scene:
    """The scene of a `.npy` file: (rows, columns), uint8 with white 255 or floats from 0 to 1.

    Raises InputError with the file and what to do.
    """
    try:
        with disk.opened(path) as file:
            head = file.read(HEAD)
            size = file.seek(0, io.SEEK_END)
            file.seek(0)
            if not head.startswith(b"\x93NUMPY"):
                raise another(path, head, "a .npy file; store the image by np.save")
            if size > _LARGEST:
                raise InputError(f"{path}: is larger than {_LARGEST >> 20} MiB; a scene has an entry for each pixel")
            stored = read_npy(file, size, str(path))
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; the scene is read from there") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); a scene is a .npy file") from None
    if stored.ndim != 2 or not stored.size:
        raise InputError(
            f"{path}: its shape is {stored.shape}; a scene is one grey image, (rows, columns), for each pixel an entry"
        )
    if stored.dtype != np.uint8 and stored.dtype.kind != "f":
        raise InputError(f"{path}: holds {stored.dtype}; store uint8 (white is 255) or floats from 0 (black) to 1")
    inside = (stored >= 0) & (stored <= 255)
    if stored.dtype.kind == "f":
        inside = (stored >= 0) & (stored <= 1)
    if not inside.all():
        row, column = (int(x) for x in np.argwhere(~inside)[0])
        raise InputError(
            f"{path}: has {stored[row, column]:g} in row {row}, column {column}; the light of a scene is from 0 "
            "(black) to 1 (white), linear"
        )
    if not stored.any():
        raise InputError(f"{path}: is black all over; write light: {{kind: dark}}, or give an image with light in it")
    return Scene(path.name, stored.astype(np.float64) if stored.dtype.kind == "f" else stored)
