"""A fixed pattern of the columns."""

from __future__ import annotations

import numpy as np

from . import Chip, parameter
from ._pattern import Pattern


class ColumnPattern(Pattern, stage="light"):
    """The pixels of a column share a gain: columns are supplied and read out together.

    It multiplies the light that counts, under both rules; dark counts stay as they are. Of pixels that are placed one
    by one each is a column of its own.
    Source: no published number; 0.1-3 % from column to column is realistic.
    """

    moves = ("rows_columns", "surface", "level")

    gain = parameter(1.0, "", "gain of a column", bounds=(0, None), off=1.0, search=(0.5, 1.5), per="column")

    def line(self, chip: Chip) -> np.ndarray:
        return np.arange(chip.layout.pixels) % chip.layout.columns
