"""The images of a part as dask arrays and as an xarray data set: read, or simulated, block by block when computed."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from . import reconstruct
from .errors import SpadError, did_you_mean

if TYPE_CHECKING:
    from .dataset import Part

_BLOCK = 1 << 26  # bytes of a block in memory: 64 MiB, of which dask holds one or two for each processor
_AT_ONCE = 32  # images; a chunk of a shard holds no more


# readouts of one size for every image, by the names they have here: `counts` is a method's, too
_READOUTS = {"qis": "qis", "str": "str", "count_frames": "counts"}
_ABOUT = {
    "qis": "is there a detection in the frame?",
    "str": "time of the first detection since the start of its frame; the frame time where there is none",
    "count_frames": "count frames",
}


def _names(part: Part) -> tuple[str, ...]:
    readouts = (name for name, readout in _READOUTS.items() if readout in part.readouts)
    return ("images", *readouts, *part.reconstruction)


def _field(part: Part, name: str) -> Any:
    return part.reconstruction[name] if name in part.reconstruction else getattr(part, _READOUTS.get(name, name))


def _read(part: Part, name: str, start: int, stop: int) -> np.ndarray:
    return np.asarray(_field(part, name)[start:stop])


def to_dask(part: Part, name: str) -> Any:
    """See `Part.to_dask`."""
    known = _names(part)
    if name not in known:
        raise SpadError(f"{name!r} cannot be one array; there are {', '.join(known)}.{did_you_mean(name, known)}")
    try:
        import dask
        import dask.array
    except ImportError:
        raise SpadError("to_dask: needs dask, which is not installed; pip install 'spadmnist[xarray]'") from None
    first = _read(part, name, 0, 1)
    step = max(1, _BLOCK // max(1, first.nbytes))
    step = step // _AT_ONCE * _AT_ONCE or step
    ends = part.cuts()
    cuts = sorted({*ends, *(at for a, b in pairwise(ends) for at in range(a, b, step))})
    read = dask.delayed(_read, pure=False)
    blocks = [
        dask.array.from_delayed(read(part, name, a, b), (b - a, *first.shape[1:]), first.dtype)
        for a, b in pairwise(cuts)
    ]
    return dask.array.concatenate(blocks)


def to_xarray(part: Part, kind: str, white: float) -> Any:
    """See `Dataset.to_xarray`. kind: `lux` or `irradiance`; white: of the level, lux or W/m^2."""
    try:
        import xarray
    except ImportError:
        raise SpadError("to_xarray: needs xarray, which is not installed; pip install 'spadmnist[xarray]'") from None
    image = ("channel", "y", "x")[-len(part.shape) :]
    data = {}
    for name in _names(part):
        dims = ("image", *image)
        facts: dict[str, Any] = {"long_name": "original image", "units": "1"}
        if name in part.reconstruction:
            method = reconstruct.find(name)
            facts = {"long_name": method.summary().rstrip("."), "units": method.unit}
            normalisation = part.reconstruction[name].normalisation if part.stored else None
            facts |= {} if normalisation is None else {"normalisation": normalisation}
        elif name != "images":
            axis = "count_frame" if name == "count_frames" else "frame"
            dims = ("image", *image[:-2], axis, *image[-2:])
            facts = {"long_name": _ABOUT[name], "units": "s" if name == "str" else "1"}
        data["original" if name == "images" else name] = (dims, to_dask(part, name), facts)
    unit = {"lux": "lx", "irradiance": "W/m^2"}[kind]
    coordinates: dict[str, Any] = {
        "image": ("image", np.arange(len(part)), {"long_name": "number of the image", "units": "1"}),
        kind: ((), white, {"long_name": f"{kind} of white", "units": unit}),
    }
    if part.labels is not None:
        coordinates["label"] = ("image", part.labels, {"long_name": "label", "units": "1"})
    return xarray.Dataset(data, coordinates)
