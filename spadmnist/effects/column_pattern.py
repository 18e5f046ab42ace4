"""A fixed pattern of the columns."""

from __future__ import annotations

import numpy as np

from . import Chip, parameter
from ._pattern import Pattern


class ColumnPattern(Pattern, stage="light"):
    """The pixels of a column share a gain.

    The gain multiplies the light under both rules. Dark counts do not change. Columns are supplied and read out
    together. In a layout with positions each pixel is a column.
    Source: no published number; 0.1-3 % from column to column is realistic.
    """

    moves = ("rows_columns", "surface", "level")

    gain = parameter(1.0, "", "gain of a column", bounds=(0, None), off=1.0, search=(0.5, 1.5), per="column")

    def line(self, chip: Chip) -> np.ndarray:
        return np.arange(chip.layout.pixels) % chip.layout.columns
