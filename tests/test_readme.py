"""README.md is a page: short, with two pictures, and links that lead somewhere. `test_docs.py` runs its blocks.

What it asks to be cited is what CITATION.cff says.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import documents
import yaml

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text()


def test_it_is_short() -> None:
    """What is more stands in docs."""
    assert len(TEXT.splitlines()) <= 150
    assert {block.language for block in documents.blocks("README.md")} == {"bash", "python", "bibtex"}


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


# --- what is cited ------------------------------------------------------------------------------------------------


def entries() -> dict[str, dict[str, str]]:
    """The fields of each BibTeX entry, by its title; braces that keep capitals are gone."""
    (block,) = (block for block in documents.blocks("README.md") if block.language == "bibtex")
    found = {}
    for text in re.findall(r"^@\w+\{.*?^\}$", block.text, re.M | re.S):
        fields = re.findall(r"^  (\w+) = \{(.*?)\},$", text, re.M | re.S)
        entry = {key: re.sub(r"^\{(.*)\}$", r"\1", " ".join(value.split())) for key, value in fields}
        found[entry["title"]] = entry
    return found


def named(author: dict[str, str]) -> str:
    """An author of CITATION.cff as BibTeX writes one."""
    return author["name"] if "name" in author else f"{author['family-names']}, {author['given-names']}"


def cited() -> dict[str, Any]:
    return yaml.safe_load((ROOT / "CITATION.cff").read_text())


def test_bibtex_and_citation_say_the_same() -> None:
    """Of the software, the paper and each reference: whatever one of the two says of it, the other one says as well."""
    software = cited()
    works = [software, software["preferred-citation"], *software["references"]]
    found = entries()
    assert {work["title"] for work in works} == set(found)
    for work in works:
        entry = found[work["title"]]
        assert entry["author"] == " and ".join(map(named, work["authors"]))
        for key in ("doi", "url", "version"):
            assert entry.get(key) == work.get(key), f"{work['title']}: {key}"
        assert entry.get("booktitle") == work.get("conference", {}).get("name"), work["title"]
        if work is not software:
            assert entry.get("year") == (str(work["year"]) if "year" in work else None), work["title"]


def test_the_software_is_cited_in_its_version_and_year() -> None:
    """The year is that of its release, and before the first one that of the licence."""
    entry, software = entries()["spadmnist"], cited()
    assert entry["version"] == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    licence = re.search(r"Copyright \(c\) (\d{4})", (ROOT / "LICENSE").read_text())
    assert licence and entry["year"] == str(software.get("date-released", licence[1]))[:4]
