"""Captures in files that other programs read. Each says how it was recorded, so that `import` gives the capture back.

One class writes one kind of file (`Target`), and is found by being defined. The places of pixels that are no grid are
not written; an import takes them from --positions.
"""

from __future__ import annotations

import datetime
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np

from . import __version__, capture_files, disk
from .errors import SpadError
from .events import Events
from .factory import Progress
from .importers.names import safe_name
from .measurement import Measurement
from .recording import Recording


def facts(recording: Recording) -> dict[str, float | int]:
    """How a capture was recorded, by the names that `importers.FACTS` knows; in SI."""
    c, lit, layout = recording.conditions, recording.capture.light, recording.layout
    known: dict[str, float | int | None] = {"rows": layout.rows, "columns": layout.columns, "tick": recording.tick}
    if recording.modality == "tr":
        known |= {"exposure": c.exposure}
    else:
        known |= {"frame_time": c.frame_time, "frame_period": c.frame_period}
    if recording.modality == "qis":
        known |= {"width": layout.columns}
    if recording.modality == "counts":
        known |= {"bits": c.bits, "counter": int(c.counting == "counter")}
    if lit.scene is None:  # without its scene, the light of white would be taken for flat light
        known |= {"wavelength": lit.wavelength, lit.kind_of_level: lit.level}
        known |= {"relative_uncertainty": lit.relative_uncertainty, "own_uncertainty": lit.own_uncertainty}
    return {name: value for name, value in known.items() if value is not None}


class Target:
    """Writes one kind of file.

    name: what `--format` calls it; suffix: of its files; opened_by: in Python; modalities: what it holds; again: what
    an import of it must be told, since the file does not say it.
    """

    every: ClassVar[dict[str, type[Target]]] = {}
    name: ClassVar[str]
    suffix: ClassVar[str]
    opened_by: ClassVar[str]
    modalities: ClassVar[tuple[str, ...]] = ("tr", "str", "qis", "counts")

    def __init_subclass__(cls) -> None:
        Target.every[cls.name] = cls

    @classmethod
    def put(cls, recording: Recording, file: IO[bytes]) -> None:
        """Write the capture."""
        raise NotImplementedError


def export(
    measurement: Measurement, out: Path, format: str, ids: tuple[str, ...] = (), progress: Progress | None = None
) -> list[Path]:
    """Write captures (`ids`; all that have data, without them) to a file, or to files in a folder; their paths.

    `out` is a file where it ends as such files do, otherwise a folder; as files of another format end, no new folder
    does. What is there already is not written over.
    Raises SpadError with a sentence.
    """
    target = Target.every[format]
    chosen = [measurement.capture(id) for id in dict.fromkeys(ids)] or [
        c for c in measurement.captures if c.mean is None
    ]
    if not chosen:
        raise SpadError(f"{measurement.source}: of its captures only means are known; there are no data to export")
    ends = {other.suffix: name for name, other in Target.every.items() if other.suffix != target.suffix}
    if out.suffix.lower() in ends and not out.is_dir():
        raise SpadError(
            f"{out} ends as files of the format {ends[out.suffix.lower()]} do; those of {format} end with "
            f"{target.suffix}: name such a file, a folder, or another --format"
        )
    paths = [out]
    if out.suffix.lower() != target.suffix:
        names: list[str] = []
        for capture in chosen:
            names.append(safe_name(capture.id, names))
        paths = [out / f"{name}{target.suffix}" for name in names]
    elif len(chosen) > 1:
        known = ", ".join(capture.id for capture in chosen[:12])
        raise SpadError(f"{out} holds one capture; choose it with --capture ({known}), or name a folder with -o")
    for capture, path in zip(chosen, paths, strict=True):
        if capture.modality not in target.modalities:
            others = ", ".join(name for name, other in Target.every.items() if capture.modality in other.modalities)
            raise SpadError(f"{capture.id} is {capture.modality}, which {format} cannot hold; take one of {others}")
        if path.exists():
            raise SpadError(f"{path}: is there already, and is not written over; remove it, or name another with -o")
    progress = progress or Progress()
    progress.start("exporting", len(chosen), 0.0)
    for capture, path in zip(chosen, paths, strict=True):
        one = measurement.recording(capture.id)

        def told(share: float, id: str = capture.id) -> None:
            progress.advance(share, id)

        with disk.whole(path, capture_files.size(one)) as file:
            target.put(one.watched(told), file)
        if one.frames is None:
            told(1.0)
    return paths


_PIECE = 1 << 20  # detections that are put into a file at a time


def _stamped(recording: Recording) -> tuple[Events, np.ndarray, float]:
    """(the detections, their ticks, s of a tick). Raises SpadError where they have no ticks."""
    events = recording.events
    if events is None or events.ticks is None or events.tick is None:
        raise SpadError(f"{recording.capture.id}: its stamps are no whole ticks; simulate it with a converter (tdc)")
    return events, events.ticks, events.tick


def _numbers(recording: Recording) -> Any:
    """The type of the number of a pixel."""
    return np.dtype(np.uint16 if recording.pixels <= 1 << 16 else np.uint32)


class PlainHdf5(Target):
    """HDF5: time and pixel, or frames, as a measurement stores them, and attributes that say how it was recorded."""

    name = "hdf5"
    suffix = ".h5"
    opened_by = "h5py.File(FILE)"

    @classmethod
    def put(cls, recording: Recording, file: IO[bytes]) -> None:
        """Piece by piece, packed."""
        capture_files.write(recording, file, facts(recording))


class Npz(Target):
    """NumPy archive: time and pixel, or frames (QIS packed along columns, the high bit first), modality and numbers."""

    name = "npz"
    suffix = ".npz"
    opened_by = "numpy.load(FILE)"

    @classmethod
    def put(cls, recording: Recording, file: IO[bytes]) -> None:
        """Stored without a date, so that the same capture gives the same bytes."""
        with zipfile.ZipFile(file, "w") as archive:
            for name, value in {"modality": recording.modality, **facts(recording)}.items():
                cls._member(archive, name, np.asarray(value))
            if recording.events is not None:
                events, ticks, _ = _stamped(recording)
                cls._pieces(archive, "time", ticks.dtype, len(ticks), lambda start, stop: ticks[start:stop])
                cls._pieces(archive, "pixel", _numbers(recording), len(ticks), events.rows_of)
            else:
                with archive.open(zipfile.ZipInfo("frames.npy"), "w", force_zip64=True) as member:
                    _put_frames(recording, member)

    @staticmethod
    def _member(archive: zipfile.ZipFile, name: str, array: np.ndarray) -> None:
        with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
            np.lib.format.write_array(member, array, allow_pickle=False)

    @staticmethod
    def _pieces(
        archive: zipfile.ZipFile, name: str, kind: Any, count: int, get: Callable[[int, int], np.ndarray]
    ) -> None:
        with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
            _put_header(member, kind, (count,))
            for start in range(0, count, _PIECE):
                member.write(np.ascontiguousarray(get(start, min(start + _PIECE, count)), kind).data)


class Npy(Target):
    """NumPy array of frames; QIS: (frames, rows, ceil(columns / 8)) uint8, as np.packbits(bits, axis=2) gives it.

    It does not say how it was recorded: an import is told --packed --columns, --frame-time, ...
    """

    name = "npy"
    suffix = ".npy"
    opened_by = "numpy.load(FILE)"
    modalities = ("qis", "str", "counts")

    @classmethod
    def put(cls, recording: Recording, file: IO[bytes]) -> None:
        """Piece by piece."""
        _put_frames(recording, file)


def _put_header(file: IO[bytes], kind: Any, shape: tuple[int, ...]) -> None:
    """What an `.npy` stream begins with."""
    header = {"descr": np.lib.format.dtype_to_descr(kind), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)


def _put_frames(recording: Recording, file: IO[bytes]) -> None:
    """Frames as an `.npy` stream, piece by piece."""
    assert recording.frames is not None
    kind = np.asarray(recording.frames[0:1]).dtype.newbyteorder("<")
    _put_header(file, kind, recording.frames.shape)
    for _, part in recording.chunks():
        file.write(np.ascontiguousarray(part, kind).data)


class PhotonHdf5(Target):
    """Photon-HDF5 0.5: time stamps in order, with the pixel of each as its detector. Source: photon-hdf5.org."""

    name = "photon-hdf5"
    suffix = ".hdf5"
    opened_by = "h5py.File(FILE)"
    modalities = ("tr",)

    @classmethod
    def put(cls, recording: Recording, file: IO[bytes]) -> None:
        """What the format asks for, each field with the description that it prescribes; our own part in /user."""
        events, ticks, tick = _stamped(recording)
        count, numbers = len(ticks), _numbers(recording)
        lit = recording.capture.light
        values: dict[str, Any] = {
            "acquisition_duration": recording.conditions.exposure,
            "description": recording.capture.id,
            "photon_data/timestamps": np.dtype(np.int64),  # the type of what is put in piece by piece
            "photon_data/timestamps_specs/timestamps_unit": tick,
            "photon_data/detectors": numbers,
            "setup/num_pixels": recording.pixels,
            **dict.fromkeys(_ONE, 1),
            **dict.fromkeys(_NO, 0),
            "setup/excitation_alternated": np.zeros(1, np.int64),
            "identity/creation_time": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d %H:%M:%S}",
            "identity/software": "spadmnist",
            "identity/software_version": __version__,
            **{f"{place}format_name": "Photon-HDF5" for place in ("", "identity/")},
            **{f"{place}format_version": "0.5" for place in ("", "identity/")},
            "identity/format_url": "http://photon-hdf5.org/",
        }
        if lit.wavelength is not None:
            values["setup/excitation_wavelengths"] = np.array([lit.wavelength])

        def fill(made: Any, alive: Callable[[], None]) -> None:
            for name, value in values.items():
                alive()
                pieces = isinstance(value, np.dtype)
                size = count if pieces else np.size(value) if np.ndim(value) else 0
                filters: dict[str, Any] = {}
                if size:
                    filters = {"chunks": (min(size, 1 << 16),), "compression": 1, "shuffle": True}
                if pieces:
                    made.create_dataset(name, (count,), value, track_times=False, **filters)
                    continue
                data = np.bytes_(value) if isinstance(value, str) else value
                made.create_dataset(name, data=data, track_times=False, **filters)
            start = 0
            for stamps, pixel in events.in_time_order(_PIECE):
                alive()
                place = slice(start, start + len(stamps))
                made["photon_data/timestamps"][place] = stamps.astype(np.int64)
                made["photon_data/detectors"][place] = pixel.astype(numbers)
                start = place.stop
            made.create_group("user/spadmnist").attrs.update(facts(recording))
            made.attrs["TITLE"] = np.bytes_(_TITLES["/"])
            made.visititems(
                lambda name, node: node.attrs.update(TITLE=np.bytes_(_TITLES.get(name.split("/")[-1], " ")))
            )
            for name, value in (("format_name", "Photon-HDF5"), ("format_version", "0.5")):
                made.attrs[name] = np.bytes_(value)

        capture_files.write_hdf5(file, fill)


_ONE = tuple(f"setup/num_{what}" for what in ("spots", "spectral_ch", "polarization_ch", "split_ch"))
_NO = ("setup/modulated_excitation", "setup/lifetime")

# prescribed by the format, to the letter
_TITLES = {
    "/": "A file format for photon-counting detector based single-molecule spectroscopy experiments.",
    "acquisition_duration": "Measurement duration in seconds.",
    "description": "A user-defined comment describing the data file.",
    "format_name": "Name of the file format.",
    "format_version": "Version for the Photon-HDF5 format.",
    "format_url": "Official URL for the Photon-HDF5 format.",
    "photon_data": "Group containing arrays of photon-data.",
    "timestamps": "Array of photon timestamps. Units specified in timestamps_units (defined in timestamps_specs/).",
    "detectors": "Array of pixel IDs for each timestamp.",
    "timestamps_specs": "Specifications for timestamps.",
    "timestamps_unit": "Value of 1-unit timestamp-increment in seconds.",
    "setup": "Information about the experimental setup.",
    "num_pixels": "Total number of detector pixels.",
    "num_spots": 'Number of excitation (or detection) "spots" in the sample.',
    "num_spectral_ch": "Number of distinct spectral bands which are acquired.",
    "num_polarization_ch": "Number of distinct polarization states which are acquired.",
    "num_split_ch": "Number of distinct detection channels detecting the same spectral band and polarization. This "
    "value is > 1 when using a non-polarizing beam splitter.",
    "modulated_excitation": "True (i.e. 1) if there is any form of excitation modulation of excitation wavelength (as "
    "in us-ALEX or PAX) or polarization. This field is also True for pulse-interleaved excitation (PIE) or ns-ALEX "
    "measurements.",
    "excitation_alternated": "New in version 0.5. Indicates whether each excitation source is alternated (True, or 1) "
    "or not alternated (False, or 0).",
    "excitation_wavelengths": "List of excitation wavelengths (center wavelength if broad-band) in increasing order "
    "(unit: meter).",
    "lifetime": "True (i.e. 1) if the measurement includes a nanotimes array of photon arrival times with respect to a "
    "laser pulse (as in TCSPC measurements).",
    "identity": "Information about the Photon-HDF5 data file.",
    "creation_time": "Creation time of the current Photon-HDF5 file.",
    "software": "Name of the software used to create the current Photon-HDF5 file.",
    "software_version": "Version of the software used to create current the Photon-HDF5 file.",
}
