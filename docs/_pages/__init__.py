"""The chapters gallery and reference of the documentation, made from the classes at each build.

`make(root)` writes `docs/gallery` and `docs/reference` of the repository `root`. A page that is the same as before is
left alone, and one that is no longer made is removed; pages that somebody wrote by hand are left alone.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from . import gallery, reference
from .markdown import MARK

Chapter = Callable[[Path], dict[str, str | bytes]]

CHAPTERS: dict[str, Chapter] = {"gallery": gallery.pages, "reference": reference.pages}


def make(root: Path) -> None:
    """Write the pages of all chapters. root: of the repository."""
    for name, pages in CHAPTERS.items():
        folder = root / "docs" / name
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder, pages(folder))


def _write(folder: Path, made: dict[str, str | bytes]) -> None:
    """Files of a folder by name; `index.md` leads to the pages that are there, those written by hand among them."""
    made = {name: text.encode() if isinstance(text, str) else text for name, text in made.items()}
    for file in sorted(folder.iterdir()):
        if file.name not in made and file.is_file() and _made(file):
            file.unlink()
    for name, data in made.items():
        if not (folder / name).is_file() or (folder / name).read_bytes() != data:
            (folder / name).write_bytes(data)


def _made(file: Path) -> bool:
    """Was it made here?"""
    return file.suffix == ".png" or (file.suffix == ".md" and file.read_text("utf-8").startswith(MARK))
