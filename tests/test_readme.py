"""README.md is a page: short, with two pictures, and links that lead somewhere. `test_docs.py` runs its blocks."""

from __future__ import annotations

import re
from pathlib import Path

import documents

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text()


def test_it_is_short() -> None:
    """What is more stands in docs."""
    assert len(TEXT.splitlines()) <= 150
    assert {block.language for block in documents.blocks("README.md")} == {"bash", "python"}


def test_the_loop_is_twelve_lines() -> None:
    (block,) = (block for block in documents.blocks("README.md") if "diagnose(" in block.text)
    assert len([line for line in block.text.splitlines() if line]) <= 12


def test_its_pictures_are_small_and_described() -> None:
    pictures = re.findall(r"!\[([^\]]*)\]\(([^)]+)\)", TEXT)
    assert len(pictures) == 2
    for words, name in pictures:
        assert len(words) > 20 and 10_000 < (ROOT / name).stat().st_size < 200_000, name


def test_every_link_to_a_file_is_there() -> None:
    links = set(re.findall(r"\]\(((?!https?:)[^)]+)\)", TEXT))
    assert len(links) > 8 and not [name for name in links if not (ROOT / name).exists()]
