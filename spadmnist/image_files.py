"""Image files from anywhere: IDX, NumPy arrays, pictures. Whatever a file contains, the outcome is an array or an
InputError that names the file and what to do: nothing is executed or unpickled, and nothing is read beyond what the
file itself can hold.
"""

from __future__ import annotations

import gzip
import hashlib
import math
import os
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.lib import format as npy

from . import disk, large
from .errors import InputError

MAX_BYTES = 8 * 2**30  # the images of one source; beyond it a header is taken for damaged or hostile
_MAX_DEFLATE = 1032  # deflate, the packing of gzip and zip, gains at most this factor

# Pillow's other formats stay shut: some of them start programs (EPS calls Ghostscript)
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "PPM", "GIF", "WEBP")

HEAD = 16  # bytes by which the kind of a file is told: the longest beginning below
_BEGINNINGS = {  # what a file begins with, and what it is
    b"PK": "a zip archive",
    b"\x89PNG": "a PNG image",
    b"\xff\xd8": "a JPEG image",
    b"GIF8": "a GIF image",
    **dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), "a TIFF image"),
    b"\x93NUMPY": "a NumPy array",
    b"\x89HDF": "an HDF5 file",
    b"MATLAB 5.0 MAT-f": "a MATLAB file of version 5",
    b"MATLAB 7.3 MAT-f": "a MATLAB file of version 7.3",
    b"PQTTTR": "a PicoQuant PTU file",
    b"PAR1": "a Parquet file",
    b"%PDF": "a PDF document",
}
# what packs a single file: its name, and the command that unpacks it and keeps the packed one
_PACKERS = {
    b"\x1f\x8b": ("gzip", "gunzip -k"),
    b"BZh": ("bzip2", "bunzip2 -k"),
    b"\xfd7zXZ\0": ("xz", "unxz -k"),
    b"\x28\xb5\x2f\xfd": ("Zstandard", "unzstd"),
}


def reason(error: Exception) -> str:
    """What another library says is wrong: one line, or only the kind of error where it says too much."""
    text = " ".join(str(error).split())
    return text if 0 < len(text) <= 150 else type(error).__name__


def read_idx(path: Path, ndim: int) -> np.ndarray:
    """The uint8 array of `ndim` dimensions in an IDX file, packed by gzip or not (its content decides).

    Raises InputError for anything but a whole, undamaged file; never reads more than the header declares.
    """
    try:
        with disk.opened(path) as file:
            packed = file.read(2) == b"\x1f\x8b"
            file.seek(0)
            stream = gzip.GzipFile(fileobj=file) if packed else file
            file_bytes = os.fstat(file.fileno()).st_size
            most = file_bytes * _MAX_DEFLATE if packed else file_bytes
            return _read_idx(cast(IO[bytes], stream), ndim, path, most, packed)
    except (gzip.BadGzipFile, zlib.error, EOFError) as error:
        raise InputError(f"{path}: its gzip data are damaged ({reason(error)}); download or copy it again") from error


def _read_idx(stream: IO[bytes], ndim: int, path: Path, most: int, packed: bool) -> np.ndarray:
    """The array in a stream that cannot hold more than `most` bytes. packed: gzip unpacks it."""
    magic = bytes([0, 0, 8, ndim])
    head = stream.read(4 + 4 * ndim)
    if not head:
        raise InputError(f"{path}: the file is empty; download or copy it again")
    if head[:4] != magic:
        wanted = f"an IDX file of unsigned bytes in {ndim} dimension{'s' * (ndim > 1)}"
        begins = f"it would begin with {magic.hex(' ')}"
        head += stream.read(max(0, HEAD - len(head)))
        raise another(path, head, f"{wanted} ({begins}); name the right file", packed)
    if len(head) < 4 + 4 * ndim:
        raise InputError(f"{path}: the file ends inside its header; download or copy it again")
    shape = tuple(int.from_bytes(head[i : i + 4], "big") for i in range(4, len(head), 4))
    declared = f"its header declares {' x '.join(str(n) for n in shape)} bytes"
    size = math.prod(shape)
    if size == 0:
        raise InputError(f"{path}: {declared}, that is nothing; give a file with at least one image")
    if size > MAX_BYTES:
        raise InputError(f"{path}: {declared}, more than the {MAX_BYTES} allowed; the file is damaged")
    if size > most - len(head):
        raise InputError(f"{path}: {declared}, more than the file can hold; download or copy it again")
    data = large.empty((size,), np.uint8)
    if (found := large.filled(data, stream)) < size:
        raise InputError(f"{path}: {declared}, but only {found} follow; download or copy it again")
    # reading past the end also makes gzip check its checksum
    if stream.read(1):
        raise InputError(f"{path}: {declared}, but more follow; the file is damaged or not what it says")
    return data.reshape(shape)


def looks_like(head: bytes, inside_gzip: bool = False) -> str:
    """What a file that begins with `head` is, to stand behind 'this is', with what to do where that is to unpack it.

    inside_gzip: `head` is what gzip unpacked from the beginning of the file.
    """
    for beginning, (name, unpack) in _PACKERS.items():
        if head.startswith(beginning) and not inside_gzip:
            return f"packed by {name}; unpack it ({unpack} FILE)"
        if head.startswith(beginning):
            how = "gzip packed twice" if name == "gzip" else f"{name} packed, and then gzip"
            return f"a file that {how}; unpack it once (gunzip -k FILE)"
    for beginning, kind in _BEGINNINGS.items():
        if head.startswith(beginning):
            return kind
    if head.lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"<"):
        return "an HTML page, perhaps a server's error page"
    if len(head) >= 4 and head[:2] == b"\0\0" and head[2] in (8, 9, 11, 12, 13, 14):
        return f"an IDX file of another kind (type {head[2]:#04x}, {head[3]} dimensions)"
    return f"a file that begins with {head[:4].hex(' ')}" if head else "an empty file"


def another(path: Path, head: bytes, wanted: str, inside_gzip: bool = False) -> InputError:
    """What to say of a file that begins with `head` (see `looks_like`) and is not `wanted`: what, and what to do."""
    rest = "" if head.startswith(tuple(_PACKERS)) else f", not {wanted}"
    return InputError(f"{path}: this is {looks_like(head, inside_gzip)}{rest}")


def idx_sha256(array: np.ndarray) -> str:
    """SHA-256 of the unpacked IDX file that holds the uint8 array: the format leaves no freedom."""
    digest = hashlib.sha256(_idx_header(array))
    digest.update(array.data)
    return digest.hexdigest()


def idx_bytes(array: np.ndarray) -> bytes:
    """The unpacked IDX file that holds the uint8 array."""
    return _idx_header(array) + array.tobytes()


def _idx_header(array: np.ndarray) -> bytes:
    return bytes([0, 0, 8, array.ndim]) + b"".join(n.to_bytes(4, "big") for n in array.shape)


def read_image(path: Path, grey_palettes: bool = True, exif: bool = False) -> tuple[np.ndarray, np.ndarray | None]:
    """One image file: its pixels, (rows, columns) uint8 or uint16 if grey, (3, rows, columns) uint8 in colour; and how
    opaque they are, (rows, columns) uint8 up to 255, or None where all are as opaque as can be.

    A palette is colour unless all colours that the picture uses are greys; grey_palettes=False: then, too. exif: turn
    the picture as its EXIF orientation says. Raises InputError.
    """
    from PIL import Image, UnidentifiedImageError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what is damaged: the picture is read, or refused in a sentence
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        try:
            with disk.opened(path) as file:
                with Image.open(file, formats=_FORMATS) as image:
                    image.verify()  # PNG's checksums, which decoding leaves out
                file.seek(0)
                with Image.open(file, formats=_FORMATS) as image:
                    return pixels_of(image, path, grey_palettes, exif)
        except InputError:
            raise
        except UnidentifiedImageError as error:
            raise InputError(f"{path}: its content is none of {', '.join(_FORMATS)}; replace or remove it") from error
        except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
            raise InputError(
                f"{path}: it declares more than the {Image.MAX_IMAGE_PIXELS} pixels allowed; "
                "make it smaller or remove it"
            ) from error
        # damaged files make decoders raise nearly anything: OSError, SyntaxError, struct.error, ...
        except Exception as error:
            raise InputError(
                f"{path}: it cannot be read as an image ({reason(error)}); replace or remove it"
            ) from error


def pixels_of(
    image: Any, place: object, grey_palettes: bool = True, exif: bool = False, instead: str = "use source array"
) -> tuple[np.ndarray, np.ndarray | None]:
    """What `read_image` returns, of a Pillow image; InputError where it would not be what the image says.

    place: the file, or what else the message names; instead: what there is for images of other kinds.
    """
    from PIL import ImageOps

    # an MPO is a photograph with a preview beside it; in all other formats more frames are more images
    if getattr(image, "n_frames", 1) > 1 and image.format != "MPO":
        raise InputError(f"{place}: it holds {image.n_frames} images; store each in a file of its own")
    mode = image.mode
    # Pillow would quietly drop the lower eight bits
    deep = not mode.startswith("I") and any(";16" in str(tile) for tile in getattr(image, "tile", ()))
    if deep or mode not in ("1", "L", "LA", "I", "I;16", "I;16B", "I;16L", "P", "PA", "RGB", "RGBA"):
        kind = "more than 8 bits per channel" if deep else f"pixels of the kind {mode}"
        raise InputError(f"{place}: it has {kind}; convert it to 8-bit RGB or to 8-bit or 16-bit grey, or {instead}")
    if exif:
        image = ImageOps.exif_transpose(image)
    alpha = None
    if image.has_transparency_data:
        alpha = np.asarray(image.convert("RGBA").getchannel("A"))
        alpha = None if alpha.min() == 255 else alpha
    if mode.startswith("I"):
        pixels = np.asarray(image)
        if pixels.min() < 0 or pixels.max() > 65535:
            raise InputError(f"{place}: its grey levels do not fit into 16 bits; scale them to 0 to 65535")
        return pixels.astype(np.uint16), alpha
    if mode in ("1", "L", "LA"):
        return np.asarray(image.convert("L")), alpha
    colours = np.moveaxis(np.asarray(image.convert("RGB")), -1, 0)
    if grey_palettes and mode in ("P", "PA") and (colours == colours[0]).all():
        return np.ascontiguousarray(colours[0]), alpha
    return colours, alpha


def read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, file_bytes: int, place: str) -> np.ndarray:
    """One array of a `.npz` archive, after its declared size was compared with what the file can hold."""
    if info.flag_bits & 1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InputError(
            f"{place} is encrypted or packed in an unusual way; store it by np.savez or np.savez_compressed"
        )
    if info.file_size > file_bytes * _MAX_DEFLATE:
        raise InputError(f"{place} declares {info.file_size} bytes, more than the file can hold; store it again")
    try:
        with archive.open(info) as stream:
            return read_npy(stream, info.file_size, place)
    except (InputError, MemoryError):
        raise
    except Exception as error:  # as above
        raise InputError(f"{place} is damaged ({reason(error)}); copy or store the file again") from error


def read_npy(stream: IO[bytes], size: int, place: str) -> np.ndarray:
    """The array in a `.npy` stream of `size` bytes; its header is checked against that before it is read."""
    try:
        version = npy.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"format version {version[0]}.{version[1]}, which plain numbers never need")
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran, dtype = read_header(stream)
    # the header is a Python literal, and NumPy's reader of it raises nearly anything when it is damaged
    except Exception as error:
        raise InputError(f"{place}: its header is damaged ({reason(error)}); store it again by np.save") from error
    if dtype.kind not in "biuf":
        raise InputError(f"{place}: it holds {dtype}, not plain numbers; store uint8, uint16 or float32")
    declared, held = math.prod(shape) * dtype.itemsize, size - stream.tell()
    if declared > MAX_BYTES:
        raise InputError(f"{place}: it declares {declared} bytes, {MAX_BYTES} are allowed; store fewer images")
    if declared != held or min(shape, default=0) < 0:
        raise InputError(f"{place}: it declares {shape} {dtype}, {declared} bytes, but {held} follow; store it again")
    if declared > large.IN_MEMORY:
        if fortran:  # an image lies across all of the file
            raise InputError(
                f"{place}: it holds {declared} bytes in the order of Fortran, in which {large.IN_MEMORY} are allowed; "
                "store np.ascontiguousarray(images)"
            )
        out = large.empty(shape, dtype)
        if (found := large.filled(out, stream)) < declared:
            raise InputError(f"{place}: it ends too early (after {found} bytes); store it again by np.save")
        return out
    stream.seek(0)
    try:
        return npy.read_array(stream, allow_pickle=False)
    except ValueError as error:
        raise InputError(f"{place}: it ends too early ({reason(error)}); store it again by np.save") from error
