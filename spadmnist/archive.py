"""Zips: where each member lies in one that is read, and the bytes of one that is written, its members stored.

What is written is a function of the members alone: one date, one kind of system, no data descriptor. ZIP64 stands
where a size, a place or a number of members needs it (APPNOTE.TXT 6.3.10, 4.3).
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping

from .foreign import short
from .sources import File, Reading

_MOST = 0xFFFFFFFF  # bytes: from here on a size or a place is written by ZIP64
_MOST_MEMBERS = 0xFFFF  # from here on their number is
_DATE = (1 << 5) | 1  # 1 January 1980, the first day that a zip can name
_UNIX, _REGULAR = 3, 0o100644 << 16  # a file that all may read, as unzip then makes it


class BadArchive(Exception):
    """What is wrong with a zip, in a few words."""


# --- reading ------------------------------------------------------------------------------------------------------


def members(file: File) -> list[zipfile.ZipInfo]:
    """The members of a zip, without folders. Raises BadArchive where it is no zip, or holds one twice."""
    try:
        with zipfile.ZipFile(Reading(file)) as zipped:
            found = [info for info in zipped.infolist() if not info.is_dir()]
    except (zipfile.BadZipFile, NotImplementedError, ValueError, EOFError, struct.error) as error:
        raise BadArchive(f"cannot be read as a zip ({short(str(error), 200)})") from None
    names: set[str] = set()
    for info in found:
        if info.filename in names:
            raise BadArchive(f"holds {short(info.filename, 200)} twice")
        names.add(info.filename)
    return found


def check_member(info: zipfile.ZipInfo, compressed: bool) -> None:
    """Raise BadArchive where a member is not read. compressed: may it be deflated?"""
    name = short(info.filename, 200)
    if info.flag_bits & 1:
        raise BadArchive(f"{name} is encrypted")
    if info.compress_type != zipfile.ZIP_STORED and not (compressed and info.compress_type == zipfile.ZIP_DEFLATED):
        known = "stored and deflated are" if compressed else "stored is"
        raise BadArchive(f"{name} is compressed by method {info.compress_type}, and {known} read")
    if info.compress_type == zipfile.ZIP_STORED and info.compress_size != info.file_size:
        raise BadArchive(f"{name} has two sizes")


def start(file: File, info: zipfile.ZipInfo) -> int:
    """Where a member's bytes begin. What stands before them has a length of its own. Raises BadArchive."""
    head = file.read(info.header_offset, 30) if info.header_offset >= 0 else b""  # a damaged directory may say so
    begin = info.header_offset + 30 + sum(struct.unpack("<HH", head[26:30])) if len(head) == 30 else 0
    if head[:4] != b"PK\x03\x04" or begin + info.compress_size > file.size:
        raise BadArchive(f"{short(info.filename, 200)} does not lie where the zip says")
    return begin


# --- writing ------------------------------------------------------------------------------------------------------


def written(files: Mapping[str, Iterable[bytes]]) -> Iterator[bytes]:
    """The bytes of a zip of files, in their order. One file at a time is in memory: its checksum stands before it.

    files: by name (ASCII), as pieces that are asked for once.
    """
    offset, directory = 0, b""
    for name, pieces in files.items():
        crc, size, held = 0, 0, []
        for piece in pieces:
            crc = zlib.crc32(piece, crc)
            size += len(piece)
            held.append(piece)
        head = _header(name, crc, size)
        yield head
        yield from held
        directory += _entry(name, crc, size, offset)
        offset += len(head) + size
    yield directory + _end(len(files), len(directory), offset)


def _facts(name: str, crc: int, size: int, extra: bytes) -> bytes:
    """What stands of a member before it and in the directory: flags, method, time, date, checksum, sizes, lengths."""
    said = 0xFFFFFFFF if size >= _MOST else size
    version = 45 if extra else 20
    return struct.pack("<5H3I2H", version, 0, 0, 0, _DATE, crc, said, said, len(name), len(extra))


def _header(name: str, crc: int, size: int) -> bytes:
    extra = struct.pack("<2H2Q", 1, 16, size, size) if size >= _MOST else b""
    return b"PK\x03\x04" + _facts(name, crc, size, extra) + name.encode("ascii") + extra


def _entry(name: str, crc: int, size: int, offset: int) -> bytes:
    large = ([size, size] if size >= _MOST else []) + ([offset] if offset >= _MOST else [])
    extra = struct.pack(f"<2H{len(large)}Q", 1, 8 * len(large), *large) if large else b""
    made = struct.pack("<2B", 45, _UNIX)
    rest = struct.pack("<3H2I", 0, 0, 0, _REGULAR, 0xFFFFFFFF if offset >= _MOST else offset)
    return b"PK\x01\x02" + made + _facts(name, crc, size, extra) + rest + name.encode("ascii") + extra


def _end(count: int, size: int, offset: int) -> bytes:
    """What stands behind the directory of `count` members, which has `size` bytes from `offset` on."""
    large = b""
    if count >= _MOST_MEMBERS or size >= _MOST or offset >= _MOST:
        large = b"PK\x06\x06" + struct.pack("<Q2H2I4Q", 44, 45, 45, 0, 0, count, count, size, offset)
        large += b"PK\x06\x07" + struct.pack("<IQI", 0, offset + size, 1)
        count, size, offset = 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF
    return large + b"PK\x05\x06" + struct.pack("<4H2IH", 0, 0, count, count, size, offset, 0)
