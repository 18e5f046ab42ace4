"""Pages: what was found, as one HTML file that needs nothing else: no network, no script, no other file.

Names come from users' files, so all text is escaped by the template, every picture is an image of its own, and the
page forbids the browser to fetch or run anything. The same answer gives the same bytes.
"""

from ._comparison import check_figure, comparison, comparison_figures
from ._diagnosis import diagnosis, diagnosis_figures, trace_figure
from ._experiment import Drawing, Story, Table, experiment, markdown
from ._frame import FILES, Source, check_place, source_of

__all__ = [
    "FILES",
    "Drawing",
    "Source",
    "Story",
    "Table",
    "check_figure",
    "check_place",
    "comparison",
    "comparison_figures",
    "diagnosis",
    "diagnosis_figures",
    "experiment",
    "markdown",
    "source_of",
    "trace_figure",
]
