"""How Sphinx builds these pages: `make docs`, or `sphinx-build -W docs build/docs`.

The pages of the chapters gallery and reference are made from the classes of the package at each build. Code cells of
pages that are notebooks are executed, and their results kept in build/docs-cells until a cell changes.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs"))

import spadmnist  # noqa: E402

project = "spadmnist"
author = "The spadmnist developers"
copyright = author
release = version = spadmnist.__version__

extensions = ["myst_nb"]
exclude_patterns = ["_pages"]

smartquotes = False  # it makes one dash of the two that an option begins with

html_theme = "furo"
html_title = f"spadmnist {release}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_copy_source = False
html_show_sphinx = False
pygments_style = "friendly"
pygments_dark_style = "monokai"

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "build" / "docs-cells")
nb_execution_timeout = 1200  # s, of one cell: the longest takes under a minute of two idle cores
if tags.has("two"):  # noqa: F821  Sphinx's own name here; `make docs-two`
    nb_execution_excludepatterns = ["notebooks/effect.md"]  # the longest of the three
nb_execution_raise_on_error = True
nb_execution_in_temp = True  # what a cell writes is gone with the build
nb_merge_streams = True
nb_output_stderr = "warn"  # a warning in a cell is one of the build


def make_pages(app: Any) -> None:
    """Write what is made from the classes, before Sphinx looks for pages."""
    import _pages

    _pages.make(ROOT)


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("builder-inited", make_pages)
