"""HDF5: Photon-HDF5, and plain data sets."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from ..capture_files import FILTERS, attribute, check_stored, opened
from ..errors import InputError
from . import LARGEST_PIECE, MOST_EVENTS, Format, Found, Said, Stack, facts

_MARK = (b"\x89HDF\r\n\x1a\n",)


def _node(file: Any, name: str, path: Path, group: bool = False) -> Any:
    """A data set (or group) of an HDF5 file, reached through no link; None where there is none."""
    import h5py

    node = file
    for part in name.strip("/").split("/"):
        link = node.get(part, getlink=True) if part and isinstance(node, h5py.Group) else None
        if link is None:
            return None
        if not isinstance(link, h5py.HardLink):
            raise InputError(f"{path}: {name} is a link to somewhere else, which is not followed; copy the data in")
        node = node[part]
    if not isinstance(node, h5py.Group if group else h5py.Dataset):
        raise InputError(f"{path}: {name} is not a {'group' if group else 'data set'}; name another")
    if not group and (node.is_virtual or node.external):
        raise InputError(f"{path}: the data of {name} lie in another file, which is not read; copy them in")
    return node


def _data_set(file: Any, name: str, path: Path, axes: int = 1) -> Any:
    """A plain data set of whole numbers that is there as a whole."""
    found = _node(file, name, path)
    if found is None:
        there = ", ".join(sorted(str(key)[:40] for key in list(file)[:10])) or "nothing"
        raise InputError(f"{path}: has no data set {name}; there is {there} (--dataset names one of frames)")
    if found.dtype.kind not in "iub" or found.ndim != axes:
        what = "(frames, rows, columns)" if axes == 3 else "one axis"
        raise InputError(f"{path}: {name} is {found.dtype} of the shape {found.shape}; store whole numbers with {what}")
    made = found.id.get_create_plist()
    if not {made.get_filter(i)[0] for i in range(made.get_nfilters())} <= FILTERS.keys():
        raise InputError(f"{path}: {name} is packed by a filter that HDF5 itself lacks; store it with gzip")
    taken = math.prod(found.chunks or (1,)) * found.dtype.itemsize
    if taken > LARGEST_PIECE or (axes == 1 and len(found) > MOST_EVENTS):
        raise InputError(f"{path}: {name} is stored in larger parts than can be read; store it in smaller ones")
    check_stored(found, name, path)
    return found


def _number(file: Any, name: str, path: Path) -> float:
    """A number that stands in a data set of its own."""
    found = _node(file, name, path)
    if found is None or found.size != 1 or found.dtype.kind not in "iuf":
        raise InputError(f"{path}: {name} is not one number in the file; write it again")
    return float(np.asarray(found[()]).ravel()[0])


class PhotonHdf5(Format):
    """Photon-HDF5: a detector is a pixel; where several spots have photon data of their own, a spot is one.

    Source: photon-hdf5.org, version 0.5. What spadmnist exports says how it was recorded in /user/spadmnist.
    """

    about = "Photon-HDF5"
    begins = _MARK

    @classmethod
    def fits(cls, path: Path, head: bytes) -> bool:
        """The groups of photon data tell it from other HDF5."""
        if not super().fits(path, head):
            return False
        with opened(path) as file:
            return "photon_data" in file or "photon_data0" in file

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """Time stamps in timestamps_unit, detectors as channels."""
        with opened(path) as file:
            spots = sorted(int(m[1]) for key in file if (m := re.fullmatch(r"photon_data(\d{1,6})", key)))
            groups = [f"photon_data{spot}" for spot in spots] or ["photon_data"]
            own = _node(file, "user/spadmnist", path, group=True)
            known = {} if own is None else facts(path, lambda name: attribute((own,), name, path))
            if _node(file, "acquisition_duration", path) is not None:
                known.setdefault("exposure", _number(file, "acquisition_duration", path))
            units = {_number(file, f"{group}/timestamps_specs/timestamps_unit", path) for group in groups}
            if len(units) > 1:
                raise InputError(f"{path}: its spots have ticks of several lengths; store each spot in its own file")
            ticks = [_data_set(file, f"{group}/timestamps", path)[...] for group in groups]
            channels = [np.full(len(times), spot, np.uint32) for spot, times in enumerate(ticks)]
            if not spots and _node(file, "photon_data/detectors", path) is not None:
                channels = [_data_set(file, "photon_data/detectors", path)[...]]
        known |= {"tick": units.pop()} | ({"rows": 1, "columns": len(spots)} if spots else {})
        return Found(facts(path, known.get), np.concatenate(channels), np.concatenate(ticks))


class PlainHdf5(Format):
    """Plain HDF5: the data sets time and pixel, or frames (--dataset names another), as a measurement stores them."""

    about = "plain HDF5"
    begins = _MARK

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """Attributes of the file, or of the data set, say how it was recorded, by the names of `FACTS`."""
        name = said.dataset or "frames"
        with opened(path) as file:
            detections = said.dataset is None and "time" in file
            stored = None if detections else _data_set(file, name, path, axes=3)
            nodes = (file,) if detections else (stored, file)
            known = facts(path, lambda key: attribute(nodes, key, path))
            if attribute(nodes, "counting", path) == "counter":
                known["counter"] = 1
            if stored is None:
                time, pixel = (_data_set(file, key, path)[...] for key in ("time", "pixel"))
                return Found(known, pixel, time)
            shape, dtype = stored.shape, stored.dtype

        def get(start: int, stop: int) -> np.ndarray:
            with opened(path) as file:
                return np.asarray(_data_set(file, name, path, axes=3)[start:stop])

        packed = said.packed or "width" in known
        return Found(known, frames=Stack(shape, dtype, get), bits=dtype.kind == "b", packed=packed)
