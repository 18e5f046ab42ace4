"""A fixed pattern of the rows."""

from __future__ import annotations

import numpy as np

from . import Chip, parameter
from ._pattern import Pattern


class RowPattern(Pattern, stage="light"):
    """The pixels of a row share a gain.

    The gain multiplies the light under both rules. Dark counts do not change. Rows are supplied and switched together.
    In a layout with positions all pixels lie in one row.
    Source: no published number; 0.1-3 % from row to row is realistic.
    """

    moves = ("rows_columns", "surface", "level")

    gain = parameter(1.0, "", "gain of a row", bounds=(0, None), off=1.0, search=(0.5, 1.5), per="row")

    def line(self, chip: Chip) -> np.ndarray:
        return np.arange(chip.layout.pixels) // chip.layout.columns
