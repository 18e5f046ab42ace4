"""LinoSPAD2, a line of 256 pixels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .. import disk, image_files, units
from ..errors import InputError
from ..import_options import LINOSPAD2
from . import PICOSECOND, Format, Found, Said, Stack, ask, frames_in_file
from .detections import Detections, Pieces

_CLOCK, _CODES = 2500, 140  # ps, codes in it
_AT_ONCE = 1 << 20  # words, of which each takes 60 bytes as it is worked out
_LARGEST_TABLE = 1 << 24  # bytes of a calibration
_LONGEST_OFFSET = 1e9  # ps


class LinoSpad2(Format):
    """LinoSPAD2: 32-bit little-endian words of 256 pixels, cycle after cycle.

    A word: bit 31, it is valid; bits 28-29, the pixel's address at its converter; bits 0-27, codes since the start of
    the cycle, 140 to a clock of 2.5 ns. A cycle of the firmware 2212 has --timestamps words of each of 65 converters,
    one after the other, the last of which belongs to no pixel. Pixel at converter k with address a: 4 k + a (2212b, in
    blocks), k + 64 a (2212s, with skips). 2208: so many words of each pixel, and no address.
    Calibrated: 2500 ps * (word // 140) + tdc[pixel, word % 140] + offset[pixel], rounded to --tick (1 ps); without
    --tdc the codes are kept as ticks of 2.5 ns / 140.

    The cycles are joined without the pauses between them, which the file does not hold.

    Source: the daplis package (github.com/rngKomorebi/daplis), unpack.py, calibrate.py and delta_t.py, and, for 2208,
    github.com/sevaedmi/LinoSPAD2; read there, not tried on a recording of the sensor.
    """

    about = "LinoSPAD2 .dat"
    ends = (".dat",)
    modalities = ("tr",)
    takes = (LINOSPAD2,)
    binary = True

    @classmethod
    def read(cls, path: Path, said: Said) -> Found:
        """The firmware may also stand in the name of the calibration, as in TDC_NL11_#33_2212b.csv."""
        named = [name for name in ("2212b", "2212s", "2208") if said.tdc is not None and name in said.tdc.stem]
        firmware = said.firmware or (named[0] if named else None)
        if named and firmware not in named:
            raise InputError(
                f"{said.tdc}: is of the firmware {named[0]} by its name, not of {firmware}; give another --tdc"
            )
        known = {"firmware": firmware, "timestamps": said.timestamps, "cycle": said.cycle}
        if missing := [name for name, value in known.items() if value is None]:
            raise ask(path, missing)
        assert said.timestamps is not None and said.cycle is not None
        lines, kept = (256, 256) if firmware == "2208" else (65, 64)  # so many lists of words, of which these are kept
        size, each = path.stat().st_size, lines * said.timestamps
        cycles = size // (4 * each)
        if size % (4 * each):
            raise InputError(
                f"{path}: {size:,} bytes are no whole cycles of {lines} x {said.timestamps} words; give another "
                "--timestamps (recordings with absolute time stamps are not read)"
            )
        if said.offsets is not None and said.tdc is None:
            raise InputError("--offsets: they are added to calibrated time stamps; give --tdc as well")
        ends, uncalibrated = (None, 0) if said.tdc is None else _calibration(said.tdc)
        offsets = np.zeros(256) if said.offsets is None else _offsets(said.offsets)
        tick = _CLOCK / _CODES * PICOSECOND if ends is None else said.tick or PICOSECOND
        length = round(said.cycle / tick)
        if abs(said.cycle / tick - length) > 1e-6 * max(1.0, 1e-6 * length):
            raise InputError(
                f"--cycle: {units.show(said.cycle, 's')} is no whole number of ticks of {units.show(tick, 's')}"
            )
        if cycles * length >= 1 << 63:
            raise InputError(
                f"--cycle: {cycles:,} cycles of {units.show(said.cycle, 's')} have more ticks of "
                f"{units.show(tick, 's')} than can be counted; give another --cycle or --tick"
            )
        words = frames_in_file(path, 0, "<u4", (cycles * lines, 1, said.timestamps))
        recording = _Recording(path, words, lines, kept, str(firmware), tick, length, ends, offsets)
        found = Detections(path, recording.pieces)
        if said.tick is not None and ends is None:
            raise InputError("--tick: without --tdc the ticks are the codes; give --tdc as well, or leave out --tick")
        outside, full = recording.outside, recording.full
        notes = [f"{cycles:,} cycles were joined; the pauses between them are not in the file"]
        if ends is None:
            listed = f"tdc: {{resolution: {units.show(tick, 's', 17)}, rounding: floor}}"
            notes.append(
                f"its stamps are codes of unequal width; with {listed} in the sensor file the widths are fitted"
            )
        if uncalibrated:
            notes.append(f"{uncalibrated} pixels are not calibrated by --tdc; their codes are taken as equally long")
        if full:
            times = f"{full:,} of {kept * cycles:,} times"
            notes.append(f"{times} a converter was full, and blind for the rest of its cycle")
        left_out = (f"{outside:,} time stamps that lie outside their cycle",) if outside else ()
        facts = {"tick": tick, "exposure": cycles * said.cycle, "rows": 1, "columns": 256}
        sources = {"exposure": f"{cycles:,} cycles", "tick": "--tdc" if ends is not None else "its codes"}
        return Found(facts, found, notes=tuple(notes), left_out=left_out, sources=sources)


@dataclass
class _Recording:
    """The lists of words of a file, `lines` of them to a cycle, of which the first `kept` are of pixels.

    words: (lists, 1, words); tick: s; length: of a cycle, in ticks; ends: see `_calibration`, None without; offsets:
    (256,) ps. outside, full: time stamps outside their cycle and full lists, when all were read.
    """

    path: Path
    words: Stack
    lines: int
    kept: int
    firmware: str
    tick: float
    length: int
    ends: np.ndarray | None
    offsets: np.ndarray
    outside: int = 0
    full: int = 0

    def pieces(self) -> Pieces:
        """(pixel, ticks), some lists after the other. Raises InputError where a list cannot be one."""
        self.outside = self.full = 0
        step = max(1, _AT_ONCE // self.words.shape[2])
        for first in range(0, self.words.shape[0], step):
            some = self.words[first : first + step][:, 0]
            cycle, line = np.divmod(np.arange(first, first + len(some)), self.lines)
            of_pixels = line < self.kept
            some, cycle, line = some[of_pixels], cycle[of_pixels], line[of_pixels]
            valid = some >> 31 == 1
            self.full += int(valid.all(axis=1).sum())
            behind = valid[:, 1:] & ~valid[:, :-1]
            if behind.any():
                bad, word_ = (int(x) for x in np.argwhere(behind)[0])
                raise InputError(
                    f"{self.path}: in cycle {cycle[bad]} of the list {line[bad]} a time stands behind an empty word "
                    f"(at {word_ + 1}), where none can; give another --timestamps or --firmware"
                )
            row, _ = np.nonzero(valid)
            cycle, line, word = cycle[row], line[row], some[valid].astype(np.int64)
            address, codes = word >> 28 & 3, word & 0xFFFFFFF
            pixel = {"2212b": 4 * line + address, "2212s": line + 64 * address}.get(self.firmware, line)
            if self.ends is not None:
                time = codes // _CODES * _CLOCK + self.ends[pixel, codes % _CODES] + self.offsets[pixel]
                codes = np.rint(time * (PICOSECOND / self.tick)).astype(np.int64)
            inside = (codes >= 0) & (codes < self.length)
            self.outside += int((~inside).sum())
            yield pixel[inside].astype(np.uint8), (codes + cycle * self.length)[inside].astype(np.uint64)


def _calibration(path: Path) -> tuple[np.ndarray, int]:
    """((256, 140) ps, the end of each code; pixels that were not calibrated (all zero), whose codes are equal)."""
    try:
        with disk.opened(path) as file:
            if path.stat().st_size > _LARGEST_TABLE:
                raise ValueError("it is too large")
            table = np.loadtxt(file, delimiter=",", skiprows=1, ndmin=2)
        if table.shape != (256, 1 + _CODES) or (table[:, 0] != np.arange(256)).any():
            raise ValueError(f"it holds {table.shape[0]} x {table.shape[1]} numbers")
        ends = table[:, 1:]
        if not ((ends >= 0) & (ends <= _CLOCK + 1e-6)).all() or (np.diff(ends, axis=1) < 0).any():
            raise ValueError("its times do not rise from 0 to 2500 ps")
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: is no calibration of codes ({image_files.reason(error)}); it has a line of headings, then for "
            "each of 256 pixels its number and 140 times in ps"
        ) from None
    without = ~ends.any(axis=1)
    ends[without] = np.arange(1, 1 + _CODES) * (_CLOCK / _CODES)
    return ends, int(without.sum())


def _offsets(path: Path) -> np.ndarray:
    try:
        with disk.opened(path) as file:
            found = image_files.read_npy(file, path.stat().st_size, str(path))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); name another file") from None
    if found.shape != (256,) or not (np.abs(found) < _LONGEST_OFFSET).all():
        raise InputError(f"{path}: has the shape {found.shape}; offsets are 256 numbers in ps, each less than 1 ms")
    return found.astype(np.float64)
