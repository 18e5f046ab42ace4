"""Stacks of frames: NumPy, TIFF, raw bits."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path

import numpy as np

from .. import image_files
from ..errors import InputError
from . import FACTS, LARGEST_PIECE, Format, Found, Said, Stack, damaged, facts, frames_in_file, heard, library


class Npy(Format):
    """A stack of frames as a NumPy array (frames, rows, columns); with --packed eight columns are a byte."""

    about = "NumPy .npy"
    begins = (b"\x93NUMPY",)

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """Mapped only to read its header: pages that are mapped would count as memory."""
        try:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
            plain, shape, dtype, at = array.flags.c_contiguous, array.shape, array.dtype, array.offset
        except Exception as error:  # the header is a Python literal, and its reader raises nearly anything
            raise damaged(path, error) from None
        if not plain or len(shape) != 3 or dtype.kind not in "iub":
            raise InputError(
                f"{path}: holds {dtype} of the shape {shape}{'' if plain else ' in Fortran order'}; "
                "store whole numbers (frames, rows, columns) in C order"
            )
        if path.stat().st_size != at + math.prod(shape) * dtype.itemsize:
            raise InputError(f"{path}: is longer than the {shape} {dtype} that it declares; store it again by np.save")
        stack = frames_in_file(path, at, np.uint8 if dtype.kind == "b" else dtype, shape)
        return Found(frames=stack, bits=dtype.kind == "b", packed=said.packed)


class Npz(Format):
    """A NumPy archive of time and pixel, or of frames, and of numbers by the names of `FACTS`, as `export` writes it.

    It is read whole: for a large stack HDF5 or .npy is better.
    """

    about = "NumPy .npz"
    begins = (b"PK\x03\x04",)

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """Each array's declared size is compared with what the file can hold."""
        try:
            with zipfile.ZipFile(path) as archive:
                held = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
                size, parts = path.stat().st_size, {}
                for name in (*FACTS, "time", "pixel", "frames"):
                    if name in held:
                        parts[name] = image_files.read_member(archive, held[name], size, f"{path}: {name}")
        except (zipfile.BadZipFile, OSError, RuntimeError, ValueError, NotImplementedError) as error:
            raise damaged(path, error) from None
        known = facts(path, lambda name: parts[name].item() if name in parts and parts[name].size == 1 else None)
        whole = {name: part for name, part in parts.items() if name not in FACTS and part.dtype.kind in "iub"}
        if "frames" in whole and whole["frames"].ndim == 3:
            frames = whole["frames"]
            stack = Stack(frames.shape, frames.dtype, lambda start, stop: frames[start:stop])
            packed = said.packed or "width" in known
            return Found(known, frames=stack, bits=frames.dtype.kind == "b", packed=packed)
        if {"time", "pixel"} <= set(whole):
            return Found(known, whole["pixel"].ravel(), whole["time"].ravel())
        there = ", ".join(sorted(held)[:8])[:200]
        raise InputError(
            f"{path}: holds {there}; it needs whole numbers time and pixel, or frames (frames, rows, columns)"
        )


class Tif(Format):
    """A stack of frames as a TIFF file, a page each."""

    about = "TIFF"
    begins = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """Pages only: series, which may lie in other files, are not looked at."""
        tifffile = library(path, "tifffile", "tif")
        try:
            with heard("tifffile"):
                file = tifffile.TiffFile(path)
                first, count = file.pages[0], len(file.pages)
                shape, dtype = first.shape, first.dtype
                declared = int((file.imagej_metadata or {}).get("images", 1))
        except Exception as error:  # damaged files make it raise nearly anything
            raise damaged(path, error) from None
        if len(shape) != 2 or dtype is None or dtype.kind not in "iub" or declared > count:
            raise InputError(
                f"{path}: its {count} pages are {dtype} of the shape {shape}; store a page of whole numbers, rows x "
                "columns, for each frame"
            )
        if math.prod(shape) * dtype.itemsize > LARGEST_PIECE:
            raise InputError(f"{path}: a page has {shape[0]} x {shape[1]} pixels; that is more than can be read")

        def get(start: int, stop: int) -> np.ndarray:
            out = np.empty((stop - start, *shape), dtype)
            try:
                with heard("tifffile"):
                    for i in range(start, stop):
                        page = file.pages[i]
                        if page.shape != shape or page.dtype != dtype:
                            raise ValueError(f"page {i} is {page.dtype} {page.shape}, unlike the first")
                        out[i - start] = page.asarray()
            except Exception as error:
                raise damaged(path, error) from None
            return out

        return Found(frames=Stack((count, *shape), dtype, get), bits=dtype.kind == "b")


class Raw(Format):
    """1-bit frames as a camera's memory holds them, 512 x 512 where nothing else is said, row after row.

    The high bit is the left pixel (--bit-order little: the low bit). Four bytes `DONE` at the end, which a transfer
    over the network leaves, are passed over. Frames are not turned.

    Source: public readers of the SPAD512 agree on this order; no document of its maker was at hand.
    """

    about = "raw 1-bit frames .bin"
    ends = (".bin", ".raw")

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """The number of frames follows from the size."""
        rows, columns, size = said.rows or 512, said.columns or 512, path.stat().st_size
        each = rows * columns // 8
        if columns % 8:
            raise InputError(f"--columns: {columns} do not fill whole bytes; raw frames have a multiple of 8 columns")
        with open(path, "rb") as file:
            file.seek(max(0, size - 4))
            size -= 4 if size % each == 4 and file.read(4) == b"DONE" else 0
        if size == 0 or size % each:
            raise InputError(
                f"{path}: {size:,} bytes are no whole frames of {rows} x {columns} bits ({each:,} bytes each); "
                "give --height and --width, or copy it again"
            )
        stack = frames_in_file(path, 0, np.uint8, (size // each, rows, columns // 8))
        return Found({"rows": rows, "columns": columns}, frames=stack, bits=True, packed=True)
