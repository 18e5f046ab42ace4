"""Stacks of frames: NumPy, TIFF, raw bits."""

from __future__ import annotations

import json
import lzma
import math
import re
import weakref
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .. import image_files
from ..capture_files import DEFLATE_GAIN, deflated_size
from ..errors import InputError
from ..foreign import visible
from ..import_options import BITS, STACKS
from ..recording import MODALITIES
from . import (
    FACTS,
    GZIP,
    LARGEST_PIECE,
    WORDS,
    Format,
    Found,
    Said,
    ask,
    damaged,
    facts,
    frames_in_file,
    heard,
    holds_detections,
    in_words,
    is_packed,
    library,
    one_axis,
    refuse_fine_times,
    whole,
)
from .detections import Detections
from .stacks import arranged, cut

_COUNTED = 1 << 20  # bytes that are unpacked at a time, to be counted
_LZMA_MEMORY = 1 << 27  # bytes that LZMA may take to unpack: its largest usual dictionary has half of them
_FRAMES = tuple(name for name in MODALITIES if name != "tr")
_ARRAYS = ("time", "pixel", "frames")
_LONGEST_WORD = 4096  # bytes of a member that is a word, its header included


class Npy(Format):
    """A stack of frames as a NumPy array (frames, rows, columns); with --packed eight columns are a byte.

    With --axes HWM it is (rows, columns, frames). Numbers are whole, also where they are stored as floats.
    """

    about = "NumPy .npy"
    begins = (b"\x93NUMPY",)
    modalities = _FRAMES
    takes = (BITS, STACKS)

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """Mapped only to read its header: pages that are mapped would count as memory."""
        try:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
            plain, shape, dtype, at = array.flags.c_contiguous, array.shape, array.dtype, array.offset
        except Exception as error:  # the header is a Python literal, and its reader raises nearly anything
            raise damaged(path, error) from None
        if len(shape) != 3 or dtype.kind not in "iubf":
            raise InputError(f"{path}: holds {dtype} of the shape {shape}; store whole numbers (frames, rows, columns)")
        if path.stat().st_size != at + math.prod(shape) * dtype.itemsize:
            raise InputError(f"{path}: is longer than the {shape} {dtype} that it declares; store it again by np.save")
        if said.packed and not plain:
            raise InputError(f"{path}: packed bits are stored in Fortran order; store them in C order")
        dtype = np.dtype(np.uint8) if dtype.kind == "b" else dtype
        letters = "MHW" if said.packed else said.axes or "MHW"
        stored, letters = (shape, letters) if plain else (shape[::-1], letters[::-1])
        rest = tuple(n for n, axis in zip(stored, letters, strict=True) if axis != "M")
        if letters[0] == "M":
            get = frames_in_file(path, at, dtype, stored).get
        else:

            def get(start: int, stop: int) -> np.ndarray:
                mapped = np.memmap(path, dtype, "r", at, stored)  # closed at once: mapped pages count as memory
                return np.array(mapped[cut(letters, start, stop)])

        if math.prod(rest) * dtype.itemsize > LARGEST_PIECE:
            raise InputError(f"{path}: a frame has {rest[0]} x {rest[1]} pixels; that is more than can be read")
        stack = arranged(stored, dtype, letters, get)
        return Found(frames=stack, bits=array.dtype.kind == "b", packed=said.packed)


class Npz(Format):
    """A NumPy archive of time and pixel, or of frames, and of what it says of itself by the names of `FACTS` and
    `WORDS`, as `export` writes it.

    It is read whole: for a large stack HDF5 or .npy is better.
    """

    about = "NumPy .npz"
    begins = (b"PK\x03\x04",)
    takes = (BITS, STACKS)

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """Each array's declared size is compared with what the file can hold."""
        try:
            with zipfile.ZipFile(path) as archive:
                held = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
                size, parts = path.stat().st_size, {}
                declared = sum(held[name].file_size for name in _ARRAYS if name in held)
                if declared > LARGEST_PIECE:
                    raise InputError(
                        f"{path}: unpacks to {declared:,} bytes, more than the {LARGEST_PIECE:,} that are read whole; "
                        "store HDF5 or .npy, which are read piece by piece"
                    )
                for name in (*FACTS, *_ARRAYS):
                    if name in held:
                        parts[name] = image_files.read_member(archive, held[name], size, f"{path}: {name}")
                words = {name: _word(archive, held[name], path) for name in WORDS if name in held}
        except (zipfile.BadZipFile, OSError, RuntimeError, ValueError, NotImplementedError) as error:
            raise damaged(path, error) from None
        for name in set(FACTS) & set(parts):
            if parts[name].size != 1:
                raise InputError(f"{path}: its {name} has the shape {parts[name].shape}; store one number")
        known = facts(path, lambda name: parts[name].item() if name in parts else None)
        plain = {name: part for name, part in parts.items() if name not in FACTS and part.dtype.kind in "iubf"}
        sources = dict.fromkeys(known, "the file")
        stacked = "frames" in plain and plain["frames"].ndim == 3
        others = sorted(set(held) - {*FACTS, *WORDS, *_ARRAYS})
        row = ", ".join(visible(name)[:40] for name in others[:8]) + ", ..." * (len(others) > 8)
        notes = (
            f"holds {row} as well, which was not read; what is read besides the data is {', '.join((*FACTS, *WORDS))}",
        ) * bool(others)
        if stacked and not holds_detections(path, plain, stacked, said.modality or words.get("modality")):
            frames = plain["frames"]
            known |= in_words(path, words.get, False, known)
            packed = is_packed(path, frames.shape, known, said)
            letters = "MHW" if packed else said.axes or "MHW"
            stack = arranged(frames.shape, frames.dtype, letters, lambda a, b: frames[cut(letters, a, b)])
            bits = frames.dtype.kind == "b"
            return Found(known, frames=stack, bits=bits, packed=packed, sources=sources, notes=notes)
        if {"time", "pixel"} <= set(plain):
            refuse_fine_times(path, held)
            known |= in_words(path, words.get, True, known)
            time, pixel = (whole(one_axis(plain[name], name, path), name, path) for name in ("time", "pixel"))
            return Found(known, Detections.of(path, pixel, time), sources=sources, notes=notes)
        there = ", ".join(visible(name) for name in sorted(held)[:8])[:200]
        raise InputError(
            f"{path}: holds {there}; it needs whole numbers time and pixel, or frames (frames, rows, columns)"
        )


def _word(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path) -> str:
    """A text of an archive. Raises InputError where a member is none, or a long one."""
    name = info.filename.removesuffix(".npy")
    wanted = InputError(f"{path}: its {name} is no word; store one of {', '.join(WORDS[name])}")
    if info.file_size > _LONGEST_WORD or info.flag_bits & 1:
        raise wanted
    with archive.open(info) as stream:
        try:
            found = np.lib.format.read_array(stream, allow_pickle=False)
        except Exception:  # the header is a Python literal, and its reader raises nearly anything
            raise wanted from None
    if found.dtype.kind not in "US" or found.size != 1:
        raise wanted
    word = found.item()
    return word.decode("utf-8", "replace") if isinstance(word, bytes) else str(word)


class Tif(Format):
    """A stack of frames as a TIFF file, a page each; with --packed a page's bytes are eight columns each.

    With --axes HWM a page is a row of pixels, as (columns, frames).
    """

    about = "TIFF"
    modalities = _FRAMES
    takes = (BITS, STACKS)
    begins = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """Pages only: series, which may lie in other files, are not looked at."""
        tifffile = library(path, "tifffile", "tif")
        try:
            with heard("tifffile"):
                file = tifffile.TiffFile(path)
                weakref.finalize(file, file.filehandle.close)
                first, count = file.pages[0], len(file.pages)
                shape, dtype = tuple(map(int, first.shape)), first.dtype
                declared, axes = int((file.imagej_metadata or {}).get("images", 1)), _axes(file)
                white_is_0 = first.photometric == tifffile.PHOTOMETRIC.MINISWHITE
        except Exception as error:  # damaged files make it raise nearly anything
            raise damaged(path, error) from None
        several = {name: size for name, size in axes.sizes.items() if size > 1}
        if len(several) > 1 or "channels" in several:
            held = " and ".join(f"{size} {name}" for name, size in several.items() if name != "frames")
            raise InputError(
                f"{path}: has {held} ({axes.of}), one after the other; store each by itself, or, where they are "
                "frames, store it with frames (axes TYX)"
            )
        if len(shape) != 2 or dtype is None or dtype.kind not in "iubf" or declared > count:
            raise InputError(
                f"{path}: its {count} pages are {dtype} of the shape {shape}; store a page of whole numbers, rows x "
                "columns, for each frame"
            )
        if math.prod(shape) * dtype.itemsize > LARGEST_PIECE:
            raise InputError(f"{path}: a page has {shape[0]} x {shape[1]} pixels; that is more than can be read")

        letters = "MHW" if said.packed else said.axes or "MHW"

        def get(start: int, stop: int) -> np.ndarray:
            pages, *part = cut(letters, start, stop)
            numbers = range(count)[pages]
            out = np.empty((len(numbers), *(len(range(n)[some]) for n, some in zip(shape, part, strict=True))), dtype)
            try:
                with heard("tifffile"):
                    for i, number in enumerate(numbers):
                        page = file.pages[number]
                        if page.shape != shape or page.dtype != dtype:
                            raise ValueError(f"page {number} is {page.dtype} {page.shape}, unlike the first")
                        _check_page(file, page, path)
                        out[i] = page.asarray()[*part]
            except InputError:
                raise
            except Exception as error:
                if "imagecodecs" in str(error):
                    raise InputError(
                        f"{path}: is packed as {page.compression.name}, which the package imagecodecs reads; it is not "
                        "installed; pip install imagecodecs, or store it in another way"
                    ) from None
                raise damaged(path, error) from None
            return out

        notes = ("its pages show 0 as white; the numbers are taken as they stand, 0 as no detection",) * white_is_0
        stack = arranged((count, *shape), dtype, letters, get)
        return Found(frames=stack, bits=dtype.kind == "b", packed=said.packed, notes=notes)


@dataclass(frozen=True)
class _Axes:
    """What the pages of a TIFF file are, as its description says: how many of each. of: who wrote the description."""

    of: str = ""
    sizes: Mapping[str, int] = field(default_factory=dict)


_LETTERS = {"T": "frames", "C": "channels", "Z": "slices"}  # of axes in a description


def _axes(file: Any) -> _Axes:
    """The axes of an open TIFF file besides rows and columns, by its first page alone: series may lie in other files.

    Raises ValueError for a description that cannot be read.
    """
    if of_imagej := file.imagej_metadata:
        return _Axes("ImageJ", {name: int(of_imagej.get(name, 1)) for name in ("frames", "channels", "slices")})
    first = file.pages[0]
    if first.is_ome:
        images = re.findall(r"<(?:\w+:)?Pixels\s[^>]*>", first.description)
        sizes = [dict(re.findall(r"""\bSize([TCZ])\s*=\s*["'](\d{1,9})["']""", image)) for image in images]
        most = {_LETTERS[key]: max((int(one.get(key, 1)) for one in sizes), default=1) for key in "TCZ"}
        return _Axes("OME", {"images": len(images), **most})
    described = [text for text in (first.description, first.description1) if text.startswith('{"shape":')]
    if described:
        told = json.loads(described[0])
        shape, letters = told["shape"], str(told.get("axes", ""))
        letters = letters if len(letters) == len(shape) else "?" * len(shape)
        outer = list(zip(letters, shape, strict=True))[: -len(first.shape)]
        return _Axes("tifffile", {_LETTERS.get(one, f"of axis {i}"): int(size) for i, (one, size) in enumerate(outer)})
    return _Axes()


def _check_page(file: Any, page: Any, path: Path) -> None:
    """Raise InputError where a part of a page unpacks to more than the page has.

    Only what tifffile unpacks by itself asks for that: imagecodecs, which does the rest, is told how much there is.
    """
    name = page.compression.name.removeprefix("ADOBE_")
    gain, unpacked_size = _UNPACKED.get(name, (0, deflated_size))
    for start, size in zip(page.dataoffsets, page.databytecounts, strict=True):
        if size * gain > LARGEST_PIECE:
            file.filehandle.seek(start)
            if unpacked_size(file.filehandle.read(size), page.nbytes) > page.nbytes:
                raise InputError(
                    f"{path}: a page unpacks to more than its {page.nbytes:,} bytes; the file is damaged or hostile: "
                    "write it again"
                )


def _lzma_size(raw: bytes, most: int) -> int:
    """As `deflated_size`, of LZMA, one stream after the other. What is cut short is told where it is read."""
    size, unpacker = 0, lzma.LZMADecompressor(memlimit=_LZMA_MEMORY)
    while size <= most:
        made = len(unpacker.decompress(raw, _COUNTED))
        size, raw = size + made, b""
        if unpacker.eof:
            raw, unpacker = unpacker.unused_data, lzma.LZMADecompressor(memlimit=_LZMA_MEMORY)
        if not raw and not made:
            break
    return size


def _packbits_size(raw: bytes, most: int) -> int:
    """As `deflated_size`, of PackBits: a byte below 128 begins so many bytes and one, one above repeats the next."""
    at = size = 0
    while at < len(raw) and size <= most:
        code = raw[at]
        size += code + 1 if code < 128 else (257 - code) * (code > 128)
        at += code + 2 if code < 128 else 1 + (code > 128)
    return size


# By codec: by at most which factor it shrinks anything, and how much a part unpacks to, counted in little memory.
_UNPACKED: dict[str, tuple[int, Callable[[bytes, int], int]]] = {
    "DEFLATE": (DEFLATE_GAIN, deflated_size),
    "LZMA": (1 << 14, _lzma_size),
    "PACKBITS": (64, _packbits_size),
}


_LOOKED_AT = 1 << 24  # bytes at the beginning of a file by which its form is doubted
_SURE = 20  # values other than 0 among them: fewer look odd by chance


def _odd_bytes(some: np.ndarray, counts: bool) -> tuple[str, ...]:
    """A note where frames look as if they were stored in another way than they are read."""
    values = some[some > 0]
    if len(values) < _SURE:
        return ()
    if not counts and np.all(values == 1):
        return ("each of its bytes is 0 or 1; if they are a byte for each pixel, not eight pixels, add --bits 1",)
    if counts and some.itemsize == 2 and np.all(values % 256 == 0):
        return ("each of its counts is a multiple of 256; if the high byte stands first, store the low one first",)
    return ()


class Raw(Format):
    """Raw frames as a camera's memory holds them, 512 x 512 where nothing else is said, row after row.

    Bits, eight columns to a byte, the high bit the left pixel (--bit-order little: the low bit); with --bits counts of
    so many bits, a byte each (--bits 1: 0 or 1), above 8 bits two with the low byte first. Four bytes `DONE` at the
    end, which a transfer over the network leaves, are passed over. Frames are not turned.

    Source: public readers of the SPAD512 and SPAD512S agree on this order; no document of its maker was at hand.
    """

    about = "raw frames .bin"
    ends = (".bin", ".raw")
    modalities = ("qis", "counts")
    takes = (BITS,)
    binary = True

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """The number of frames follows from the size."""
        counts = said.modality == "counts" or (said.bits is not None and said.modality is None)
        if counts and said.bits is None:
            raise ask(path, ["bits"])
        if counts and said.packed:
            raise InputError(f"{path}: bits, eight to a byte, are no counts; leave out --packed or --bits")
        rows, columns, size = said.rows or 512, said.columns or 512, path.stat().st_size
        if not counts and columns % 8:
            raise InputError(f"--columns: {columns} do not fill whole bytes; raw frames have a multiple of 8 columns")
        shape: tuple[int, ...] = (rows, columns // 8)
        dtype: np.dtype[Any] = np.dtype(np.uint8)
        if counts:
            dtype, shape = np.dtype("<u2" if (said.bits or 0) > 8 else np.uint8), (rows, columns)
        each = math.prod(shape) * dtype.itemsize
        if each > LARGEST_PIECE:
            raise InputError(f"{path}: a frame of {rows} x {columns} pixels is more than can be read; give others")
        with open(path, "rb") as file:
            packed = file.read(3) == GZIP
            file.seek(max(0, size - 4))
            size -= 4 if size % each == 4 % each and file.read(4) == b"DONE" else 0
        if size == 0 or size % each:
            what = f"counts of {said.bits} bits" if counts else "bits"
            raise InputError(
                f"{path}: {size:,} bytes are no whole frames of {rows} x {columns} {what} ({each:,} bytes each); "
                "give --height and --width, --bits where they are counts, or copy it again"
            )
        stack = frames_in_file(path, 0, dtype, (size // each, *shape))
        sized = f"{rows} x {columns} " + ("as said" if said.rows and said.columns else "where nothing else is said")
        sources = dict.fromkeys(("rows", "columns"), sized)
        notes = ("begins as a file that gzip packed; if it is one, unpack it and import what comes out",) * packed
        notes += _odd_bytes(stack.get(0, max(1, min(size // each, _LOOKED_AT // each))), counts)
        known = {"rows": rows, "columns": columns}
        return Found(known, frames=stack, bits=not counts, packed=not counts, sources=sources, notes=notes)
