"""What a dataset or a measurement holds, for people: tables, and sheets of pictures.

matplotlib is imported only where a picture is drawn.
"""

from ._captures import Look, capture_sheet, capture_table, flux_table, looks
from ._levels import level_rows, level_table
from ._sheet import places_of, sheet
from ._text import aligned

__all__ = [
    "Look",
    "aligned",
    "capture_sheet",
    "capture_table",
    "flux_table",
    "level_rows",
    "level_table",
    "looks",
    "places_of",
    "sheet",
]
