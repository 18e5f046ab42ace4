"""One HDF5 file per capture of a measurement: read with care, since it comes from anywhere, and written.

| modality | data sets | attributes |
| --- | --- | --- |
| tr | `time` (ticks since the start of the exposure), `pixel` (row-major), one entry per detection | `tick` (s) |
| | | `untimed`: 1 where the times had no ticks, and these are the file's alone |
| qis | `frames` (M, rows, ceil(columns / 8)) uint8, packed along columns, high bit first | `width` (columns) |
| | or (M, rows, columns) of 0 and 1 | |
| str | `frames` (M, rows, columns) ticks since the start of the frame; none = ceil(frame time / tick) | `tick` (s) |
| counts | `frames` (M, rows, columns) | `bits`, `counting` (`frames` or `counter`) |
| any | | `capture_id`, where it was written here: a file that has taken another one's place is refused |

Only plain data sets of unsigned integers that lie in the file itself are read: no links, no data of other files, no
filter but HDF5's own. What a file declares is compared with the capture before any memory is taken for it. Frames are
read piece by piece, when they are asked for.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import stat
import zlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from . import units
from .effects import Conditions
from .errors import InputError, SpadError
from .events import Events, Layout
from .foreign import visible
from .kernels import jit
from .readout import counts_type, no_detection, stamps_for, unsigned_for
from .recording import FINEST, Capture, Recording, whole_ticks

_UNTIMED = "untimed"  # attribute of a file of TR: 1 where the ticks are the file's alone
OWNER = "capture_id"  # attribute of a file in a measurement that was written here: which capture it is
# bytes of the stamps of a capture, of 4 bytes each or 8, which lie in memory; the program and all that it needs besides
# to read, look at and write them take up to 0.5 GB (measured), and so a capture costs at most 1 GB
MOST_STAMPS = 3 << 27
_MOST_BITS = 16  # of a count
_LARGEST_CHUNK = 1 << 28  # bytes, of frames
LARGEST_CHUNK_OF_STAMPS = 1 << 25  # bytes: a packed one takes four times as much while it is unpacked
_LARGEST_FRAME = 1 << 28  # bytes
_PIECE = 1 << 20  # events that are read at a time
_FRAMES_AT_ONCE = 1 << 25  # bytes as they are stored
_KEPT = 1 << 26  # bytes: frames that are no more than this are read once and kept
_GZIP, _FLETCHER, _LZF = 1, 3, 32000  # numbers of HDF5's filters
DEFLATE_GAIN = 1032  # by at most this factor deflate shrinks anything
_GAINS = {_GZIP: DEFLATE_GAIN, _LZF: 88}
_UNPACKED = 1 << 28  # bytes that a chunk may unpack to whatever it is: what cannot become more is not looked at
FILTERS = {_GZIP: "gzip", 2: "shuffle", _FLETCHER: "fletcher32", _LZF: "lzf"}
# what h5py raises on damaged files
_DAMAGE = (OSError, RuntimeError, KeyError, ValueError, OverflowError, TypeError, EOFError)


@dataclass(frozen=True)
class _Found:
    """What a file says of itself, checked against its capture."""

    capture: Capture  # with what only the file knows
    tick: float | None = None
    packed: bool = False
    untimed: bool = False


# --- the file -----------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """The HDF5 file; whatever is wrong with it becomes a sentence."""
    import h5py

    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError(f"{path}: is no file; a capture is one HDF5 file")
        if not h5py.is_hdf5(path):
            raise InputError(f"{path}: is not an HDF5 file; write the capture as one, or name another file")
        with h5py.File(path, "r", locking="best-effort", rdcc_nbytes=_FRAMES_AT_ONCE) as file:
            yield file
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; put it there, or name another one") from None
    except PermissionError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); allow it") from None
    except MemoryError:
        raise InputError(f"{path}: needs more memory than there is; cut the capture into several") from None
    except _DAMAGE as error:
        reason = visible(" ".join(str(error).split()))
        raise InputError(
            f"{path}: is damaged, cut short or was never closed ({reason[:120]}); copy it again from where it was made"
        ) from None


def _data_set(file: Any, name: str, path: Path, largest_chunk: int = _LARGEST_CHUNK) -> Any:
    """A plain data set of unsigned integers (or of booleans) in the file itself. largest_chunk: bytes."""
    import h5py

    there = ", ".join(sorted(visible(key)[:40] for key in list(file)[:10])) or "nothing"
    link = file.get(name, getlink=True)
    if link is None:
        raise InputError(f"{path}: has no data set {name}; there is {there}")
    if not isinstance(link, h5py.HardLink):
        raise InputError(f"{path}: {name} is a link to somewhere else, which is not followed; copy the data in")
    found = file[name]
    if not isinstance(found, h5py.Dataset):
        raise InputError(f"{path}: {name} is a {type(found).__name__.lower()}, not a data set")
    if found.is_virtual or found.external:
        raise InputError(f"{path}: the data of {name} lie in another file, which is not read; copy them in")
    if found.dtype.kind not in "ub":
        raise InputError(f"{path}: {name} holds {found.dtype}; unsigned integers are read: store it as uint32 or alike")
    made = found.id.get_create_plist()
    for code in (made.get_filter(i)[0] for i in range(made.get_nfilters())):
        if code not in FILTERS:
            allowed = ", ".join(FILTERS.values())
            raise InputError(f"{path}: {name} is stored with the filter number {code}; allowed are {allowed}")
    if found.chunks is not None and math.prod(found.chunks) * found.dtype.itemsize > largest_chunk:
        raise InputError(
            f"{path}: {name} is stored in chunks of more than {largest_chunk >> 20} MiB; take smaller ones"
        )
    return found


def check_stored(found: Any, name: str, path: Path) -> None:
    """What was declared but never written would be read as zeros."""
    if not found.size:
        return
    if found.chunks is not None:
        wanted = math.prod(-(-n // c) for n, c in zip(found.shape, found.chunks, strict=True))
        whole = found.id.get_num_chunks() == wanted
    else:
        whole = found.id.get_storage_size() >= found.size * found.dtype.itemsize
    if not whole:
        raise InputError(
            f"{path}: {name} declares {found.size:,} values, and not all of them were written; write it again"
        )
    if found.chunks is not None:
        _check_chunks(found, name, path)


def _check_chunks(found: Any, name: str, path: Path) -> None:
    """Raise InputError where a chunk unpacks to more than its shape says: HDF5 would give it all the memory it asks."""
    made = found.id.get_create_plist()
    codes = [made.get_filter(i)[0] for i in range(made.get_nfilters())]
    packers = [i for i, code in enumerate(codes) if code in _GAINS]
    if len(packers) > 1:
        raise InputError(f"{path}: {name} is packed {len(packers)} times over; store it packed once, with gzip")
    sums = 4 * codes.count(_FLETCHER)
    most = math.prod(found.chunks) * found.dtype.itemsize + sums
    large: list[tuple[int, ...]] = []
    unsure: list[tuple[int, ...]] = []

    def look(chunk: Any) -> None:
        if chunk.size > most + most // 100 + 4096:  # what does not shrink may grow a little
            large.append(chunk.chunk_offset)
        packed = packers and not chunk.filter_mask >> packers[0] & 1
        if packed and chunk.size * _GAINS[codes[packers[0]]] > _UNPACKED:
            unsure.append(chunk.chunk_offset)

    found.id.chunk_iter(look)
    for offset in () if large else unsure:
        behind = 4 * codes[packers[0] :].count(_FLETCHER)  # stands behind what is packed
        raw = found.id.read_direct_chunk(offset)[1]
        if _unpacked(raw[: len(raw) - behind], codes[packers[0]], most) > most:
            large.append(offset)
            break
    if large:
        raise InputError(
            f"{path}: {name} has a chunk that unpacks to more than the {most:,} bytes of its shape; the file is "
            "damaged or hostile: write it again"
        )


def _unpacked(raw: bytes, code: int, most: int) -> int:
    """Bytes that a chunk unpacks to, counted up to somewhat more than `most`, in little memory."""
    return deflated_size(raw, most) if code == _GZIP else int(_lzf_size(np.frombuffer(raw, np.uint8)))


def deflated_size(raw: bytes, most: int) -> int:
    """Bytes that deflated data unpack to, counted up to somewhat more than `most`, in little memory."""
    unpacker, size = zlib.decompressobj(), 0
    piece = raw
    while piece and size <= most:
        size += len(unpacker.decompress(piece, _PIECE))
        piece = unpacker.unconsumed_tail
    return size


@jit
def _lzf_size(raw):  # type: ignore[no-untyped-def]
    """LZF: a byte below 32 begins a run of so many bytes and one; another one refers to bytes that came before."""
    size = at = 0
    while at < raw.size:
        control = np.int64(raw[at])
        if control < 32:
            size += control + 1
            at += control + 2
            continue
        length = control >> 5
        at += 1
        if length == 7:
            if at >= raw.size:
                break
            length += np.int64(raw[at])
            at += 1
        size += length + 2
        at += 1
    return size


def attribute(nodes: tuple[Any, ...], name: str, path: Path) -> Any:
    """A number or text that some nodes have, the file and a data set of it; None where none has.

    Raises InputError where it is no such thing, and where they say it differently.
    """
    found = [(node, _value(node, name, path)) for node in nodes if name in node.attrs]
    for node, value in found[1:]:
        first, there = found[0]
        if value != there:
            ends = [f"{there!r:.40} ({_called(first)})", f"{value!r:.40} ({_called(node)})"]
            raise InputError(f"{path}: says its {name} twice, {' and '.join(sorted(ends))}; keep one of them")
    return found[0][1] if found else None


def _called(node: Any) -> str:
    """What a message calls the file, or something in it."""
    name = str(node.name or "").strip("/")
    return visible(name)[:60] if name else "the file"


def _value(node: Any, name: str, path: Path) -> Any:
    """An attribute that is there, a number or text."""
    import h5py

    description = node.attrs.get_id(name)
    text = description.dtype.kind == "S" or h5py.check_string_dtype(description.dtype) is not None
    empty = description.get_space().get_simple_extent_type() == h5py.h5s.NULL
    if empty or math.prod(description.shape) != 1 or not (text or description.dtype.kind in "iuf"):
        raise InputError(f"{path}: the attribute {name} is not one number or one text; write it as that")
    if text and description.dtype.kind == "O":
        _check_heaps(path)
    value = np.asarray(node.attrs[name]).ravel()[0]
    if text:
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
    return value.item()


def _check_heaps(path: Path) -> None:
    """Raise InputError where a heap of text of any length is damaged: HDF5 would follow some of them for ever.

    A heap is `GCOL`, a version, three zeros and its size; then objects, each with a number, its size and what it holds.
    The number 0 is what is free behind them.
    """
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        start = data.find(b"GCOL\x01")
        while start >= 0:
            size = int.from_bytes(data[start + 8 : start + 16], "little")
            at, end = start + 16, start + size
            while at + 16 <= end <= len(data):
                number, held = data[at : at + 2], int.from_bytes(data[at + 8 : at + 16], "little")
                needed = 16 + (held + 7) // 8 * 8 if any(number) else held
                if needed < 16 or at + needed > end:
                    break
                at += needed
            if end - at >= 16 or end < start + 16:
                raise InputError(f"{path}: is damaged (in what it holds of text); copy it again from where it was made")
            start = data.find(b"GCOL\x01", start + 1)


def examine(path: Path, capture: Capture, shape: tuple[int, int]) -> Capture:
    """Compare what a file declares with its capture; the capture with what only the file knows (`counts`).

    shape: rows and columns of the array. Raises InputError with a sentence.
    """
    with opened(path) as file:
        return _found(file, capture, shape, path).capture


def _found(file: Any, capture: Capture, shape: tuple[int, int], path: Path) -> _Found:
    nodes = _nodes(file, "time" if capture.modality == "tr" else "frames")
    said = attribute(nodes, "modality", path)
    if said is not None and said != capture.modality:
        raise InputError(
            f"{path}: says that it is {str(said)[:40]!r}, but the capture {capture.id} is {capture.modality!r}; "
            "correct one of them"
        )
    owner = attribute((file,), OWNER, path)
    if owner is not None and owner != capture.id:
        raise InputError(
            f"{path}: is the file of the capture {str(owner)[:40]!r}, and stands for {capture.id[:40]!r}; put the "
            f"right file there, or, where the capture was renamed, take out the file's attribute {OWNER}"
        )
    if capture.modality == "tr":
        return _found_events(file, nodes, capture, path)
    frames = _data_set(file, "frames", path)
    if frames.ndim != 3:
        raise InputError(f"{path}: frames has {frames.ndim} axes, {frames.shape}; it needs (frames, rows, columns)")
    if capture.modality == "counts":
        found = _found_counts(nodes, frames, capture, path)
    elif capture.modality == "str":
        tick = _tick(nodes, capture.conditions.frame_time, path)
        found = _Found(capture, tick)
    else:
        found = _Found(capture, None, _is_packed(nodes, frames, shape[1], path))
    conditions = found.capture.conditions
    count = conditions.count_frames if capture.modality == "counts" else conditions.frames
    wanted = (count, shape[0], -(-shape[1] // 8) if found.packed else shape[1])
    if frames.shape[1:] != wanted[1:]:
        raise InputError(
            f"{path}: frames are {_by(frames.shape[1:])}, but the array has {_by(shape)} pixels"
            f"{f' ({_by(wanted[1:])} bytes)' if found.packed else ''}; correct the layout or the file"
        )
    if frames.shape[0] != count:
        raise InputError(
            f"{path}: holds {frames.shape[0]:,} frames, but {capture.id} says {count:,}; correct one of them"
        )
    if frames.dtype.kind == "b" and (found.packed or capture.modality != "qis"):
        raise InputError(f"{path}: frames holds booleans; store unsigned integers")
    if math.prod(wanted[1:]) * frames.dtype.itemsize > _LARGEST_FRAME:
        raise InputError(f"{path}: one frame has more than {_LARGEST_FRAME >> 20} MiB; that is more than can be read")
    check_stored(frames, "frames", path)
    return found


def _by(shape: tuple[int, ...]) -> str:
    return " x ".join(str(n) for n in shape)


def _nodes(file: Any, name: str) -> tuple[Any, ...]:
    """What says how a capture was recorded: the file, and its data set of that name where there is one."""
    import h5py

    return (file, file[name]) if isinstance(file.get(name, getlink=True), h5py.HardLink) else (file,)


def _found_events(file: Any, nodes: tuple[Any, ...], capture: Capture, path: Path) -> _Found:
    time, pixel = (_data_set(file, name, path, LARGEST_CHUNK_OF_STAMPS) for name in ("time", "pixel"))
    for name, found in (("time", time), ("pixel", pixel)):
        if found.ndim != 1 or found.dtype.kind != "u":
            raise InputError(f"{path}: {name} is {found.dtype} of shape {found.shape}; it needs one unsigned axis")
    if time.shape != pixel.shape:
        raise InputError(
            f"{path}: time has {len(time):,} entries and pixel {len(pixel):,}; both need one for each detection"
        )
    tick = _tick(nodes, capture.conditions.exposure, path)
    check_number(path, len(time), stamps_type(path, capture.conditions.exposure, tick))
    check_stored(time, "time", path)
    check_stored(pixel, "pixel", path)
    untimed = attribute((file,), _UNTIMED, path)
    if untimed not in (None, 0, 1):
        raise InputError(f"{path}: the attribute {_UNTIMED} is {str(untimed)[:40]!r}; it is 0 or 1")
    return _Found(capture, tick, untimed=bool(untimed))


def stamps_type(path: Path, exposure: float, tick: float) -> np.dtype[Any]:
    """The type that stamps of an exposure (s) are held in; what is rounded up may reach its end. Raises InputError."""
    return np.dtype(stamps_for(no_detection(exposure, tick), f"{path}: time stamps"))


def check_number(path: Path, count: int, kind: np.dtype[Any]) -> None:
    """Raise InputError where so many detections with stamps of this type take too much memory."""
    if count > MOST_STAMPS // kind.itemsize:
        longer = ", or store longer ticks: up to 2^32 in an exposure take half of it" if kind.itemsize > 4 else ""
        raise InputError(
            f"{path}: has {count:,} detections, which take {count * kind.itemsize / 1e6:,.0f} MB of memory; a capture "
            f"may have {MOST_STAMPS // kind.itemsize:,} ({MOST_STAMPS / 1e6:,.0f} MB): cut the recording into several "
            f"captures, each with a shorter exposure{longer}"
        )


def _tick(nodes: tuple[Any, ...], end: float, path: Path) -> float:
    value = attribute(nodes, "tick", path)
    if value is None:
        raise InputError(f"{path}: lacks the attribute tick, the length of a tick in s; write for example tick = 1e-10")
    if isinstance(value, str) or not units.SHORTEST <= value < math.inf:
        raise InputError(
            f"{path}: the attribute tick is {value!r:.40}; it must be a number of seconds, more than 0 "
            f"({units.SHORTEST:g} s), 1e-9 for example"
        )
    if value > end:
        raise InputError(
            f"{path}: a tick of {units.show(value, 's')} is longer than the {units.show(end, 's')} that it divides; "
            "tick is in s"
        )
    stamps_for(end / value, f"{path}: time stamps")
    return float(value)


def _is_packed(nodes: tuple[Any, ...], frames: Any, columns: int, path: Path) -> bool:
    width = attribute(nodes, "width", path)
    if width is None:
        if frames.shape[2] == columns:
            return False
        hint = ""
        if frames.shape[2] == -(-columns // 8):
            hint = f"; if they are packed along columns, write the attribute width = {columns} on frames"
        raise InputError(f"{path}: frames have {frames.shape[2]} columns, but the array has {columns}{hint}")
    if width != columns:
        raise InputError(f"{path}: width is {width}, but the array has {columns} columns; correct one of them")
    if frames.dtype != np.uint8:
        raise InputError(f"{path}: packed frames are {frames.dtype}; they must be uint8")
    return True


def _found_counts(nodes: tuple[Any, ...], frames: Any, capture: Capture, path: Path) -> _Found:
    """Count frames: a capture states the clock of the binary frames that they sum, or that of the count frames."""
    c = capture.conditions
    bits = attribute(nodes, "bits", path)
    counting = attribute(nodes, "counting", path) or "frames"
    if bits is None:
        raise InputError(f"{path}: lacks the attribute bits, of a count; write for example bits = 8")
    if isinstance(bits, (str, float)) or not 1 <= bits <= _MOST_BITS:
        raise InputError(f"{path}: bits is {bits!r}; it must be a whole number from 1 to {_MOST_BITS}")
    if counting not in ("frames", "counter"):
        raise InputError(f"{path}: counting is {str(counting)[:40]!r}; it is one of frames, counter")
    if c.bits and (bits, counting) != (c.bits, c.counting):
        raise InputError(
            f"{path}: its counts have {bits} bits of a {counting}, but the capture {capture.id} says {c.bits} bits of "
            f"a {c.counting}; correct one of them"
        )
    clock = clock_of_counts(c, frames.shape[0], int(bits), str(counting))
    if clock is None:
        each = (1 << bits) - 1 if counting == "frames" else 1
        both = f" or, as binary frames, {frames.shape[0] * each:,}" if each > 1 else ""
        raise InputError(
            f"{path}: holds {frames.shape[0]:,} frames, but the capture {capture.id} says {c.frames:,}; "
            f"write {frames.shape[0]:,}{both}"
        )
    return _Found(replace(capture, conditions=clock))


def clock_of_counts(stated: Conditions, held: int, bits: int, counting: str) -> Conditions | None:
    """The clock of the binary frames of count frames; None where the capture states another number than the file holds.

    stated: the clock of the binary frames that the counts sum, or that of the count frames; held: count frames of the
    file.
    """
    each = (1 << bits) - 1 if counting == "frames" else 1
    clock = stated
    if each > 1 and stated.frames == held:
        times = {name: getattr(stated, name) / each for name in ("frame_time", "frame_period")}
        clock = replace(stated, frames=held * each, **times)
    elif stated.frames != held * each:
        return None
    return replace(clock, bits=bits, counting=counting)


# --- reading ------------------------------------------------------------------------------------------------------


def read(path: Path, capture: Capture, layout: Layout, dead_time: float) -> tuple[Recording, list[str]]:
    """(the recording of a capture, what is to be known of its data). Events are read now, frames when asked for.

    Raises InputError with a sentence.
    """
    with opened(path) as file:
        found = _found(file, capture, layout.shape, path)
        if capture.modality == "tr":
            events, notes = _events(file, found, layout.pixels, path)
            read = Recording(found.capture, layout, events, None, found.tick, dead_time, untimed=found.untimed)
            return read, notes
    frames = StoredFrames(path, found, layout.shape)
    return Recording(found.capture, layout, None, frames, found.tick, dead_time), []


def _events(file: Any, found: _Found, pixels: int, path: Path) -> tuple[Events, list[str]]:
    """Detections as rows of pixels, by counting: two passes, whatever the order in the file."""
    assert found.tick is not None
    exposure = found.capture.conditions.exposure
    end = no_detection(exposure, found.tick)  # what is rounded up may reach it
    time, pixel = file["time"], file["pixel"]

    def pixels_in(part: slice) -> np.ndarray:
        piece = np.asarray(pixel[part])
        if len(piece) and int(piece.max()) >= pixels:
            wrong = part.start + int(np.argmax(piece >= pixels))
            raise InputError(
                f"{path}: pixel[{wrong}] is {pixel[wrong]}, but the array has pixels 0 to {pixels - 1}; "
                "correct the layout or the file"
            )
        return piece.astype(np.uint32, copy=False)

    counts = np.zeros(pixels, np.int64)
    for part in _parts(pixel):
        _count(pixels_in(part), counts)
    rows = Rows(counts, stamps_type(path, exposure, found.tick))
    for part in _parts(time):
        piece = time[part]
        if int(piece.max()) > end:
            wrong = part.start + int(np.argmax(piece > end))
            raise InputError(
                f"{path}: time[{wrong}] is {time[wrong]} ticks of {units.show(found.tick, 's')}, beyond the exposure, "
                f"{units.show(exposure, 's', 9)}; correct tick, the exposure or the file"
            )
        rows.put(pixels_in(part), piece)
    notes = []
    if rows.late:
        notes.append(
            f"{rows.late:,} of {len(time):,} detections stand behind a later one of their own pixel; they were sorted"
        )
    return Events(None, rows.offsets, pixels, rows.ordered(), found.tick, end=exposure), notes


def parts(count: int, each: int) -> Iterator[slice]:
    """So many numbers that are stored in chunks of `each`, in pieces of whole chunks."""
    step = max(_PIECE // each, 1) * each
    return (slice(start, min(start + step, count)) for start in range(0, count, step))


def _parts(stored: Any) -> Iterator[slice]:
    return parts(len(stored), stored.chunks[0] if stored.chunks else 1)


class Rows:
    """Detections that come in any order, piece by piece, put into rows of pixels. counts: (pixels,) int64 of each.

    late: of those that were put, how many are earlier than the one before of their own pixel; back: by how much at
    most, in ticks. Only the stamps, of type `kind`, lie in memory.
    """

    def __init__(self, counts: np.ndarray, kind: np.dtype[Any]):
        self.late = self.back = 0
        self.offsets = np.concatenate([[0], np.cumsum(counts)])
        self._place, self._stamps = self.offsets[:-1].copy(), np.empty(int(self.offsets[-1]), kind)

    def put(self, pixel: np.ndarray, ticks: np.ndarray) -> None:
        """Put some detections behind those that their pixels have. pixel, ticks: (n,). Raises ValueError where there
        are others than were counted.
        """
        for start in range(0, len(ticks), _PIECE):
            part = slice(start, start + _PIECE)
            some = ticks[part].astype(self._stamps.dtype, copy=False), pixel[part].astype(np.uint32, copy=False)
            late, back = _place(*some, self.offsets, self._place, self._stamps)
            if late < 0:
                raise ValueError("it changed while it was read")
            self.late, self.back = self.late + int(late), max(self.back, int(back))

    def ordered(self) -> np.ndarray:
        """(detections,) the stamps, ascending within each row; all were put."""
        if self.late:
            _sort_rows(self._stamps, self.offsets)
        return self._stamps


@jit
def _count(where, counts):  # type: ignore[no-untyped-def]
    for i in range(where.size):
        counts[where[i]] += 1


@jit
def _place(times, where, offsets, place, out):  # type: ignore[no-untyped-def]
    """Put times behind those that their pixels have; how many of them are earlier than the one before, and by how much
    at most. -1 where a pixel has more of them than it has room for.
    """
    late = 0
    back = np.uint64(0)
    for i in range(times.size):
        pixel = where[i]
        at = place[pixel]
        if at >= offsets[pixel + 1]:
            return -1, back
        if at > offsets[pixel] and out[at - 1] > times[i]:
            late += 1
            back = max(back, np.uint64(out[at - 1] - times[i]))
        out[at] = times[i]
        place[pixel] = at + 1
    return late, back


@jit
def _sort_rows(values, offsets):  # type: ignore[no-untyped-def]
    for row in range(offsets.size - 1):
        part = values[offsets[row] : offsets[row + 1]]
        part.sort()


class StoredFrames:
    """Frames of a file, read when they are asked for; see `recording.FrameSource`. Bits are packed along columns.

    It holds no open file: it may be pickled, and used after a fork.
    """

    def __init__(self, path: Path, found: _Found, shape: tuple[int, int]):
        self._path, self._found, self._array = path, found, shape
        c = found.capture.conditions
        modality = found.capture.modality
        count = c.count_frames if modality == "counts" else c.frames
        self.shape = (count, shape[0], -(-shape[1] // 8) if modality == "qis" else shape[1])
        self._kept: tuple[int, np.ndarray] | None = None  # the number of its first frame, frames

    def __repr__(self) -> str:
        return f"StoredFrames({self._path}, {_by(self.shape)})"

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_kept": None}

    def __getitem__(self, part: slice) -> np.ndarray:
        start, stop, step = part.indices(self.shape[0])
        if step != 1:
            raise ValueError("frames are read one after the other; take a step of 1")
        if stop <= start:
            return np.zeros((0, *self.shape[1:]), self._type)
        first, kept = self._kept or (0, np.zeros((0, *self.shape[1:]), self._type))
        if not first <= start < stop <= first + len(kept):
            with opened(self._path) as file:
                frames = _data_set(file, "frames", self._path)
                first, last = self._around(start, stop, frames)
                kept = self._read(frames, first, last)
            self._kept = first, kept
        return kept[start - first : stop - first]

    @property
    def _type(self) -> Any:
        modality = self._found.capture.modality
        largest = self._found.capture.conditions.largest_count
        return {"qis": np.uint8, "str": np.uint32}.get(modality) or counts_type(largest)

    def _around(self, start: int, stop: int, frames: Any) -> tuple[int, int]:
        """Whole chunks, so that none is decoded for each piece of it anew; everything, where that is not much."""
        if math.prod(self.shape) * np.dtype(self._type).itemsize <= _KEPT:
            return 0, self.shape[0]
        rows = frames.chunks[0] if frames.chunks else 1
        return start // rows * rows, min(-(-stop // rows) * rows, self.shape[0])

    def _read(self, frames: Any, first: int, last: int) -> np.ndarray:
        out = np.empty((last - first, *self.shape[1:]), self._type)
        each = math.prod(frames.shape[1:]) * frames.dtype.itemsize
        step = max(1, _FRAMES_AT_ONCE // each)
        if frames.chunks:
            step = max(step // frames.chunks[0], 1) * frames.chunks[0]
        for start in range(first, last, step):
            piece = frames[start : min(start + step, last)]
            self._check(piece, start)
            if self._found.capture.modality == "qis" and not self._found.packed:
                piece = np.packbits(piece, axis=2)
            out[start - first : start - first + len(piece)] = piece
        return out

    def _check(self, piece: np.ndarray, start: int) -> None:
        """Raise InputError where a value is not possible."""
        c = self._found.capture.conditions
        columns = self._array[1]
        modality = self._found.capture.modality
        if self._found.packed:
            if columns % 8 and (piece[:, :, -1] & (0xFF >> columns % 8)).any():
                raise InputError(
                    f"{self._path}: bits beyond the {columns} columns are set; is width right, and the high bit first?"
                )
            return
        if piece.dtype.kind == "b":
            return
        most, why = 1, "a bit is 0 or 1"
        if modality == "str":
            assert self._found.tick is not None
            most = no_detection(c.frame_time, self._found.tick)
            why = f"a frame of {units.show(c.frame_time, 's')} ends at {most} ticks, which means no detection"
        elif modality == "counts":
            most, why = c.largest_count, f"{c.bits} bits count up to {c.largest_count}"
        if int(piece.max()) > most:
            f, row, column = (int(n[0]) for n in np.nonzero(piece > most))
            raise InputError(
                f"{self._path}: frames[{start + f}, {row}, {column}] is {piece[f, row, column]}, but {why}; "
                "correct the capture or the file"
            )


# --- writing ------------------------------------------------------------------------------------------------------


def write(recording: Recording, file: IO[bytes], attributes: Mapping[str, Any] | None = None) -> None:
    """Write a recording as an HDF5 file into a new, empty file, piece by piece: the same bytes for the same recording.

    Detections stand grouped by pixel. Stamps that are no whole ticks are rounded down to ticks of 1 ps. attributes:
    more of them for the file. Raises OSError where the file cannot be written, which then holds anything.
    """

    def fill(made: Any, alive: Callable[[], None]) -> None:
        _put(made, {"modality": recording.modality})
        if recording.events is not None:
            _put_events(made, recording, recording.events, alive)
        else:
            _put_frames(made, recording, alive)
        _put(made, dict(attributes or {}))

    write_hdf5(file, fill)


def size(recording: Recording) -> int:
    """Bytes of a recording's data before they are packed; a file of it is hardly ever larger."""
    if recording.frames is not None:
        return math.prod(recording.frames.shape) * np.asarray(recording.frames[:0]).itemsize
    return 12 * (0 if recording.events is None else len(recording.events))


def write_hdf5(file: IO[bytes], fill: Callable[[Any, Callable[[], None]], None]) -> None:
    """Write an HDF5 file into a new, empty file. fill: called with the open `h5py.File`, and with what it calls now and
    then: it raises where going on makes no sense.

    HDF5 crashes where writing fails, or where a signal makes Python raise while it writes. So it writes to what never
    fails, and in a thread of its own, for signals reach the main thread alone; what went wrong is raised here.
    """
    import h5py

    sink = _Sink(file)

    def alive() -> None:
        if sink.failure is not None:
            raise sink.failure

    def work() -> None:
        with h5py.File(sink, "w", libver=("earliest", "v110")) as made:
            fill(made, alive)

    with ThreadPoolExecutor(1) as thread:
        try:
            thread.submit(work).result()
        except BaseException as error:
            sink.failure = sink.failure or error
    alive()


class _Sink:
    """A file as HDF5 sees it. The first failure is kept and ends the writing, of which HDF5 is not told."""

    def __init__(self, file: IO[bytes]):
        self.failure: BaseException | None = None
        self._file, self._at, self._end = file, 0, 0

    def seek(self, offset: int, whence: int = 0) -> int:
        self._at = offset + (self._end if whence == 2 else 0)
        return self._at

    def tell(self) -> int:
        return self._at

    def write(self, data: Any) -> int:
        self._try(self._file.write, data)
        self._at += len(data)
        self._end = max(self._end, self._at)
        return len(data)

    def read(self, size: int) -> bytes:
        return (self._try(self._file.read, size) or b"").ljust(size, b"\0")

    def truncate(self, size: int) -> int:
        self._try(self._file.truncate, size)
        self._end = size
        return size

    def flush(self) -> None:
        self._try(self._file.flush)

    def _try(self, call: Callable[..., Any], *arguments: Any) -> Any:
        if self.failure is None:
            try:
                self._file.seek(self._at)
                return call(*arguments)
            except BaseException as error:
                self.failure = error
        return None


def _put_events(file: Any, recording: Recording, events: Events, alive: Callable[[], None]) -> None:
    pixels, count, tick = recording.pixels, len(events), events.tick
    kind = np.dtype(np.uint8) if events.ticks is None else events.ticks.dtype
    untimed = recording.untimed or events.ticks is None
    if events.ticks is None or tick is None:
        tick = FINEST
        kind = np.dtype(unsigned_for(recording.conditions.exposure / tick, "time stamps"))
    _put(file, {"tick": tick, "tick_units": "s"} | ({_UNTIMED: np.uint8(1)} if untimed else {}))
    last = no_detection(recording.conditions.exposure, tick) - 1
    about = "time of each detection since the start of the exposure"
    time = _create(file, "time", (count,), kind, min(count, 1 << 16), units.show(tick, "s", 12), about)
    numbers = np.uint16 if pixels <= 1 << 16 else np.uint32
    about = "pixel of each detection, counted row by row"
    pixel = _create(file, "pixel", (count,), numbers, min(count, 1 << 16), "1", about)
    for start in range(0, count, _PIECE):
        alive()
        some = slice(start, min(start + _PIECE, count))
        stamps = whole_ticks(events.times[some] / tick, last) if events.ticks is None else events.ticks[some]
        time[some] = stamps.astype(kind)
        pixel[some] = events.rows_of(some.start, some.stop)


def _put_frames(file: Any, recording: Recording, alive: Callable[[], None]) -> None:
    assert recording.frames is not None
    c, modality = recording.conditions, recording.modality
    largest = max(recording.none, 1) if modality == "str" else c.largest_count
    kind = np.dtype({"qis": np.uint8, "str": np.uint32}.get(modality) or counts_type(largest))
    unit, about = "1", "does a pixel have a detection? Eight columns to a byte, the high bit first"
    if modality == "str":
        assert recording.tick is not None
        if largest >= 1 << 32:
            raise SpadError(f"{recording.capture.id}: stamps of {largest} ticks do not fit 32 bits; coarsen the tick")
        _put(file, {"tick": recording.tick, "tick_units": "s"})
        unit = units.show(recording.tick, "s", 12)
        about = f"first detection since the start of the frame; {largest}: none"
    elif modality == "counts":
        _put(file, {"bits": c.bits, "counting": c.counting})
        about = "detections of a count frame"
    shape = recording.frames.shape
    each = max(1, math.prod(shape[1:]) * kind.itemsize)
    rows = max(1, min(shape[0], (1 << 20) // each))
    frames = _create(file, "frames", shape, kind, rows, unit, about)
    if modality == "qis":
        frames.attrs["width"] = recording.layout.columns
    step = rows * max(1, _FRAMES_AT_ONCE // 2 // (rows * each))  # whole chunks, so that none is packed twice
    for start in range(0, shape[0], step):
        alive()
        frames[start : start + step] = recording.frames[start : min(start + step, shape[0])]


def _create(file: Any, name: str, shape: tuple[int, ...], kind: Any, rows: int, unit: str, about: str) -> Any:
    """An empty data set, packed as every HDF5 program can read it (an empty one has no chunks, and so no filters)."""
    filters: dict[str, Any] = {}
    if math.prod(shape):
        filters = {"chunks": (rows, *shape[1:]), "shuffle": np.dtype(kind).itemsize > 1, "fletcher32": True}
        filters |= {"compression": "gzip", "compression_opts": 1}
    made = file.create_dataset(name, shape, np.dtype(kind).newbyteorder("<"), track_times=False, **filters)
    _put(made, {"units": unit, "long_name": about})
    return made


def _put(node: Any, attributes: dict[str, Any]) -> None:
    """Text of a fixed length: what HDF5 keeps for text of any length makes it hang on some damaged files."""
    import h5py

    for name, value in sorted(attributes.items()):
        if isinstance(value, str):
            kind = h5py.string_dtype("utf-8", max(1, len(value.encode())))
            node.attrs.create(name, np.array(value.encode(), kind), dtype=kind)
        else:
            node.attrs[name] = value
