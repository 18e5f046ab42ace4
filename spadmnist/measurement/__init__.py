"""Measurements: captures of one sensor under known light, read from a folder, simulated, and written.

A measurement is a folder with `measurement.yaml` and one HDF5 file per capture (`capture_files`). What a model says of
it is a measurement too: the same captures, simulated. A plan is one whose captures have no files yet. A dataset of
uniform images opens as a measurement.
"""

from __future__ import annotations

from .arrays import Capture, Data, in_memory
from .entries import FILE, FORMAT, check_name
from .reader import is_measurement, open
from .type import Measurement
from .writer import fill, write

open_measurement = open  # its name in the package

__all__ = [
    "FILE", "FORMAT", "Capture", "Data", "Measurement", "check_name", "fill", "in_memory", "is_measurement", "open",
    "open_measurement", "write"
]  # fmt: skip
