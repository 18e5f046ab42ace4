"""HDF5: Photon-HDF5, and plain data sets."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..capture_files import FILTERS, LARGEST_CHUNK_OF_STAMPS, attribute, check_stored, opened, parts
from ..errors import InputError
from ..foreign import visible
from ..import_options import BITS, PLAIN_HDF5, STACKS
from . import (
    HDF5,
    LARGEST_PIECE,
    MOST_CHANNELS,
    MOST_EVENTS,
    Format,
    Found,
    Said,
    facts,
    holds_detections,
    in_words,
    is_packed,
    refuse_fine_times,
    whole,
)
from .detections import Detections, Pieces, check_lengths
from .stacks import arranged, cut

_MARK = (HDF5,)


def _node(file: Any, name: str, path: Path, group: bool | None = False) -> Any:
    """A data set (or group; with None either) of an HDF5 file, reached through no link; None where there is none."""
    import h5py

    node = file
    for part in name.strip("/").split("/"):
        link = node.get(part, getlink=True) if part and isinstance(node, h5py.Group) else None
        if link is None:
            return None
        if not isinstance(link, h5py.HardLink):
            raise InputError(f"{path}: {name} is a link to somewhere else, which is not followed; copy the data in")
        node = node[part]
    is_group = isinstance(node, h5py.Group)
    if (group is not None and is_group != group) or not isinstance(node, (h5py.Group, h5py.Dataset)):
        raise InputError(f"{path}: {name} is not a {'group' if group else 'data set'}; name another")
    if not is_group and (node.is_virtual or node.external):
        raise InputError(f"{path}: the data of {name} lie in another file, which is not read; copy them in")
    return node


def _data_set(file: Any, name: str, path: Path, axes: int = 1) -> Any:
    """A plain data set of whole numbers that is there as a whole."""
    found = _node(file, name, path)
    if found is None:
        inside = name.strip("/").rpartition("/")[0]
        group = _node(file, inside, path, group=None) if inside else file
        keys = [] if group is None or hasattr(group, "shape") else list(group)[:10]
        there = ", ".join(sorted(visible(key)[:40] for key in keys)) or "nothing"
        raise InputError(
            f"{path}: has no data set {name}; there is {there} (--dataset names one of frames, or a group of time and "
            "pixel)"
        )
    line = axes == 1 and found.ndim == 2 and 1 in found.shape  # MATLAB has no arrays of one axis
    if found.dtype.kind not in "iubf" or (found.ndim != axes and not line):
        what = "(frames, rows, columns)" if axes == 3 else "one axis"
        stamps = "; of time stamps name the group that holds time and pixel" if axes == 3 and found.ndim == 1 else ""
        raise InputError(
            f"{path}: {name} is {found.dtype} of the shape {found.shape}; store whole numbers with {what}{stamps}"
        )
    made = found.id.get_create_plist()
    if not {made.get_filter(i)[0] for i in range(made.get_nfilters())} <= FILTERS.keys():
        raise InputError(f"{path}: {name} is packed by a filter that HDF5 itself lacks; store it with gzip")
    taken = math.prod(found.chunks or (1,)) * found.dtype.itemsize
    if taken > (LARGEST_PIECE if axes == 3 else LARGEST_CHUNK_OF_STAMPS) or (axes == 1 and found.size > MOST_EVENTS):
        raise InputError(f"{path}: {name} is stored in larger parts than can be read; store it in smaller ones")
    check_stored(found, name, path)
    return found


def _number(file: Any, name: str, path: Path) -> float:
    """A number that stands in a data set of its own."""
    found = _node(file, name, path)
    if found is None or found.size != 1 or found.dtype.kind not in "iuf":
        raise InputError(f"{path}: {name} is not one number in the file; write it again")
    return float(np.asarray(found[()]).ravel()[0])


def _count_of(stored: Any) -> int:
    """How many numbers a data set holds: of what is empty MATLAB stores the shape in place of the numbers."""
    return 0 if stored.attrs.get("MATLAB_empty") else int(stored.size)


def _numbers(file: Any, name: str, path: Path, part: slice) -> np.ndarray:
    """(n,) some integers of a data set that is plain."""
    stored = _node(file, name, path)
    along = stored.ndim - 1 if stored.shape[0] == 1 else 0
    return whole(np.asarray(stored[(0,) * along + (part,)]).ravel(), name, path, part.start)


def _parts(file: Any, name: str, path: Path) -> Iterator[slice]:
    """All of a data set that is plain and whole, some after the other. Raises InputError for another one."""
    stored = _data_set(file, name, path)
    return parts(_count_of(stored), max(stored.chunks or (1,)))


def _pieces(path: Path, names: Sequence[tuple[str, str]]) -> Pieces:
    """(channel, ticks) of data sets (pixel, time), both as long, one after the other."""
    with opened(path) as file:
        for pixel, time in names:
            for part in _parts(file, time, path):
                yield _numbers(file, pixel, path, part), _numbers(file, time, path, part)


class PhotonHdf5(Format):
    """Photon-HDF5: a detector is a pixel, over all spots; where spots name no detectors, a spot is a pixel.

    Pixels are the detectors that `detectors_specs` or `setup/detectors/id` name, as many as `setup/num_pixels` says;
    what has another number, a marker for example, is left out.

    Source: photon-hdf5.org, version 0.5. What spadmnist exports says how it was recorded in /user/spadmnist.
    """

    about = "Photon-HDF5"
    begins = _MARK
    modalities = ("tr",)

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
            if spots and "photon_data" in file:
                raise InputError(f"{path}: has both photon_data and {groups[0]}; store one of them, or number both")
            for group in groups:
                refuse_fine_times(path, set(_node(file, group, path, group=True) or ()))
            own = _node(file, "user/spadmnist", path, group=True)
            known = {} if own is None else facts(path, lambda name: attribute((own,), name, path))
            sources = dict.fromkeys(known, "user/spadmnist")
            if _node(file, "acquisition_duration", path) is not None:
                known.setdefault("exposure", _number(file, "acquisition_duration", path))
                sources.setdefault("exposure", "acquisition_duration")
            units = {_number(file, f"{group}/timestamps_specs/timestamps_unit", path) for group in groups}
            if len(units) > 1:
                raise InputError(f"{path}: its spots have ticks of several lengths; store each spot in its own file")
            for group in groups:
                _check_rising(file, f"{group}/timestamps", path)
            named = [_check_detectors(file, group, path) for group in groups]
            declared: Sequence[int] | None = None
            notes: list[str] = []
            own_numbers: list[np.ndarray] = []
            starts: list[int] | None = None
            if not any(named):
                _check_spots(file, groups, path)
                pixels: Sequence[int] = range(len(groups))
            elif not all(named):
                raise InputError(
                    f"{path}: only some of its spots name the detector of each detection; store all of them"
                )
            else:
                own_numbers = [_used(file, f"{group}/detectors", path) for group in groups]
                starts, notes = _unlike(own_numbers, _count(file, path), path)
                used = _joined(own_numbers, starts)
                pixels, declared = _pixels(file, groups, used, path)
                if "rows" not in known and said.channels is None:
                    _check_number(file, pixels, used, path)
        known["tick"], sources["tick"] = units.pop(), "timestamps_unit"
        kept = None if declared is None or said.channels is not None else np.array(declared)
        others = _Others()

        def read() -> Pieces:
            return _of_spots(path, groups, own_numbers, starts, kept, others)

        detections = Detections(path, read)
        left_out = []
        if others.count:
            numbers = others.numbers
            row = ", ".join(map(str, numbers[:10])) + (", ..." if len(numbers) > 10 else "")
            left_out.append(f"{others.count:,} entries with the number {row}, no detector's (markers)")
        return Found(
            facts(path, known.get),
            detections,
            pixels=None if "rows" in known else pixels,
            notes=tuple(notes),
            left_out=tuple(left_out),
            sources=sources,
        )


def _check_spots(file: Any, groups: list[str], path: Path) -> None:
    """Raise InputError where spots do not say which of several pixels each detection is of."""
    declared = _count(file, path)
    if declared is not None and declared != len(groups):
        spots = f"its {len(groups)} spots do" if len(groups) > 1 else "it does"
        raise InputError(
            f"{path}: {spots} not say which of the {declared} pixels (setup/num_pixels) each detection is of; store "
            "photon_data/detectors, or correct setup/num_pixels"
        )


class _Others:
    """What is no detector's, when all entries were read."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """None was read yet."""
        self.count, self.numbers = 0, np.zeros(0, np.int64)


def _of_spots(
    path: Path,
    groups: Sequence[str],
    used: Sequence[np.ndarray],
    starts: Sequence[int] | None,
    kept: np.ndarray | None,
    others: _Others,
) -> Pieces:
    """(channel, ticks) of all spots. used, starts: the detectors of each spot, and the channel of the first of them,
    where spots number them anew; where no detectors are named, a spot is a channel. kept: the detectors that are
    pixels, None where all are.
    """
    others.clear()
    with opened(path) as file:
        for spot, group in enumerate(groups):
            for part in _parts(file, f"{group}/timestamps", path):
                time = _unsigned(_numbers(file, f"{group}/timestamps", path, part))
                if not used:
                    yield np.full(len(time), spot, np.uint32), time
                    continue
                channel = _numbers(file, f"{group}/detectors", path, part)
                if starts is not None:
                    channel = np.searchsorted(used[spot], channel) + starts[spot]
                if kept is not None:
                    other = ~np.isin(channel, kept)
                    others.count += int(other.sum())
                    others.numbers = np.union1d(others.numbers, channel[other])
                    channel, time = channel[~other], time[~other]
                yield channel, time


def _used(file: Any, name: str, path: Path) -> np.ndarray:
    """(n,) the numbers that occur in a data set, ascending. Raises InputError where they are too many."""
    found = np.zeros(0, np.int64)
    for part in _parts(file, name, path):
        numbers = np.unique(_numbers(file, name, path, part))
        found = numbers if not len(found) else np.union1d(found, numbers)
        if len(found) > MOST_CHANNELS:
            raise InputError(
                f"{path}: {name} has more than {MOST_CHANNELS:,} different numbers, which are no detectors; write it "
                "again"
            )
    return found


def _unlike(own: list[np.ndarray], declared: int | None, path: Path) -> tuple[list[int] | None, list[str]]:
    """(the channel of the first detector of each spot where each spot counts anew; None where numbers are unique over
    all spots, as the format asks; notes). own: the numbers of each spot. Raises InputError where neither is so.
    """
    every, times = np.unique(np.concatenate(own), return_counts=True)
    if times.max(initial=1) == 1:
        return None, []
    if times.sum() != declared:
        raise InputError(
            f"{path}: the detector {every[times > 1][0]} is of several spots, but numbers are unique over the file; "
            "number them anew, or correct setup/num_pixels"
        )
    starts = np.cumsum([0, *(len(numbers) for numbers in own)])[:-1]
    note = "its spots number their detectors anew; they are the pixels 0, 1, ... spot after spot"
    return list(map(int, starts)), [note]


def _joined(own: list[np.ndarray], starts: list[int] | None) -> np.ndarray:
    """(n,) the channels in use, ascending."""
    if starts is not None:
        return np.arange(sum(map(len, own)))
    return np.unique(np.concatenate(own))


def _check_detectors(file: Any, group: str, path: Path) -> bool:
    """Does a spot name the detector of each entry? Raises InputError where they are not as many."""
    name = f"{group}/detectors"
    if _node(file, name, path) is None:
        return False
    count, found = (_count_of(_data_set(file, key, path)) for key in (f"{group}/timestamps", name))
    if found != count:
        raise InputError(f"{path}: {group} has {count:,} timestamps and {found:,} detectors; it needs as many")
    return True


def _unsigned(times: np.ndarray) -> np.ndarray:
    """Spots may be stored in types of their own."""
    return times.astype(np.int64) if times.dtype.kind == "u" and int(times.max(initial=0)) < 2**63 else times


def _check_rising(file: Any, name: str, path: Path) -> None:
    """Raise InputError where times fall back, which the format forbids: a converter lost an overflow."""
    last: list[np.ndarray] = []
    for part in _parts(file, name, path):
        times = np.concatenate([*last, _numbers(file, name, path, part)])
        earlier = times[1:] < times[:-1]
        if earlier.any():
            at = int(earlier.argmax())
            entry = part.start - len(last) + at + 1
            raise InputError(
                f"{path}: {name} falls back from {times[at]} to {times[at + 1]} at entry {entry:,}; the format asks "
                "for rising times: convert the recording again"
            )
        last = [times[-1:]]


def _pixels(file: Any, groups: list[str], used: np.ndarray, path: Path) -> tuple[Sequence[int], Sequence[int] | None]:
    """(the numbers of the detectors that are pixels, the same where the file lists them, else None).

    Two lists may stand there: what the spots' `detectors_specs` name, and `setup/detectors/id`, which markers may be
    among. That one counts which has as many as `setup/num_pixels` says. used: the channels in use, ascending.
    """
    declared = _count(file, path)
    lists = [sorted(_specified(file, groups, path)), sorted(_identified(file, path))]
    lists = [numbers for numbers in lists if numbers and (declared is None or len(numbers) == declared)]
    if lists:
        return tuple(lists[0]), tuple(lists[0])
    if declared is not None and (not len(used) or 0 <= int(used[0]) <= int(used[-1]) < declared):
        return range(declared), None  # numbered from 0, silent ones too
    return used.tolist(), None


def _count(file: Any, path: Path) -> int | None:
    """What the file says of the number of its pixels. Raises InputError where that is no such number."""
    if _node(file, "setup/num_pixels", path) is None:
        return None
    number = _number(file, "setup/num_pixels", path)
    if not 1 <= number <= MOST_CHANNELS or number != int(number):
        raise InputError(
            f"{path}: setup/num_pixels says {number:.15g}; it is a whole number from 1 to {MOST_CHANNELS:,}: correct it"
        )
    return int(number)


def _specified(file: Any, groups: list[str], path: Path) -> set[int]:
    """The detectors that `detectors_specs` assign to a spectral, polarization or split channel."""
    found: set[int] = set()
    for group in groups:
        specs = _node(file, f"{group}/measurement_specs/detectors_specs", path, group=True)
        for name in specs if specs is not None else ():
            if re.fullmatch(r"(spectral|polarization|split)_ch\d+", name):
                found |= _listed(file, f"{group}/measurement_specs/detectors_specs/{name}", path)
    return found


def _identified(file: Any, path: Path) -> set[int]:
    there = _node(file, "setup/detectors/id", path) is not None
    return _listed(file, "setup/detectors/id", path) if there else set()


def _listed(file: Any, name: str, path: Path) -> set[int]:
    """Numbers that stand in a small data set, one or several."""
    found = _node(file, name, path)
    if found is None or found.dtype.kind not in "iu" or found.ndim > 1 or found.size > _MOST_DETECTORS:
        raise InputError(f"{path}: {name} is no list of detectors; write their numbers there")
    numbers = set(map(int, np.asarray(found[()]).ravel()))
    for wrong in (end for end in (min(numbers, default=0), max(numbers, default=0)) if not 0 <= end < MOST_CHANNELS):
        raise InputError(
            f"{path}: {name} names a detector {wrong}; their numbers are 0 to {MOST_CHANNELS - 1}: correct the file"
        )
    return numbers


_MOST_DETECTORS = 1 << 20


def _check_number(file: Any, pixels: Sequence[int], used: np.ndarray, path: Path) -> None:
    """Raise InputError where the file says that it has another number of pixels."""
    declared = _count(file, path)
    if declared is None or declared == len(pixels):
        return
    if len(used) > declared:
        row = ", ".join(map(str, used[:20]))
        raise InputError(
            f"{path}: setup/num_pixels says {declared} pixels, but detections are of {len(used)} detectors ({row}); "
            "name those that are pixels with --channels"
        )
    raise InputError(
        f"{path}: setup/num_pixels says {declared} pixels, but only {len(used)} detectors have a number; name all that "
        f"are pixels with --channels {','.join(map(str, used[:20]))},..."
    )


def _has_stack(file: Any) -> bool:
    """Are there frames? What is a link, or of another shape, is none."""
    import h5py

    link = file.get("frames", getlink=True)
    return isinstance(link, h5py.HardLink) and getattr(file["frames"], "ndim", 0) == 3


class PlainHdf5(Format):
    """Plain HDF5: the data sets time and pixel, or frames, as a measurement stores them.

    With --dataset it is another data set of frames, or those of a group.
    In a file of MATLAB (7.3) the axes are those that MATLAB shows, and a stack is (rows, columns, frames) unless --axes
    says otherwise.
    """

    about = "plain HDF5"
    begins = _MARK
    takes = (BITS, STACKS, PLAIN_HDF5)

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """Attributes of the file, or of the data set, say how it was recorded, by the names of `FACTS`."""
        name, within, inside = said.dataset or "frames", "", said.dataset is None
        with opened(path) as file:
            group = file
            if said.dataset is not None and hasattr(found := _node(file, name, path, group=None), "keys"):
                group, within, inside = found, f"{name.strip('/')}/", True
                name = f"{within}frames"
            told = said.modality or attribute((group, file) if within else (file,), "modality", path)
            detections = inside and holds_detections(path, set(group), _has_stack(group), told)
            stored = _data_set(file, f"{within}time" if detections else name, path, axes=1 if detections else 3)
            nodes = (stored, group, file) if within else (stored, file)
            known = facts(path, lambda key: attribute(nodes, key, path))
            sources = dict.fromkeys(known, "the file")
            known |= in_words(path, lambda key: attribute(nodes, key, path), detections, known)
            if detections:
                refuse_fine_times(path, set(group))
                pixel, time = f"{within}pixel", f"{within}time"
                check_lengths(path, *(_count_of(_data_set(file, key, path)) for key in (time, pixel)))
                return Found(known, Detections(path, lambda: _pieces(path, [(pixel, time)])), sources=sources)
            shape, dtype = stored.shape, stored.dtype
            matlab = "MATLAB_class" in stored.attrs
        packed = is_packed(path, shape, known, said)
        # MATLAB shows the axes in the opposite order
        letters = "MHW" if packed else (said.axes or "HWM")[::-1] if matlab else said.axes or "MHW"

        def get(start: int, stop: int) -> np.ndarray:
            with opened(path) as file:
                return np.asarray(_data_set(file, name, path, axes=3)[cut(letters, start, stop)])

        notes: tuple[str, ...] = ()
        if matlab and not packed and said.axes is None:
            notes = (
                "as MATLAB shows it, the stack is (rows, columns, frames); --axes MHW says that frames come first",
            )
        bits = dtype.kind == "b"
        frames = arranged(shape, dtype, letters, get)
        own = {"bits": bits, "packed": packed, "arranged": matlab}
        return Found(known, frames=frames, sources=sources, notes=notes, **own)
