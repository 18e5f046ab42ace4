"""What README and the pages in docs say works: every shell, Python and MATLAB block as it stands, in one folder.

The code cells of notebooks are executed by the build (`make docs`), the commands of the tutorial by `test_tutorial.py`.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import commands
import documents
import numpy as np
import pytest
from documents import NOT_RUN, ROOT, Block, Reader

import spadmnist
from spadmnist.photos import srgb_to_light
from spadmnist.testing import check_effect

# scripts and builds write these; the tutorial has a test of its own
_OTHERS = ("challenge.md", "experiments.md", "faults.md", "start/loop.md", "gallery/", "reference/")
PAGES = {
    page: documents.blocks(page)
    for page in ("README.md", *sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md")))
    if not page.removeprefix("docs/").startswith(_OTHERS)
}
BLOCKS = [block for blocks in PAGES.values() for block in blocks]


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    with documents.reading(tmp_path_factory.mktemp("docs")) as somebody:
        yield somebody


@pytest.mark.parametrize(
    "block", [pytest.param(b, marks=b.marks, id=b.name) for b in BLOCKS if b.language not in NOT_RUN]
)
def test_a_block_runs_as_it_stands(block: Block, reader: Reader) -> None:
    if block.lacking:
        pytest.skip(block.lacking)
    reader.read(block, PAGES[block.page])


def test_every_block_has_a_language_that_is_looked_at() -> None:
    strange = [b.place for b in BLOCKS if b.language not in ("bash", "python", "yaml", "matlab", "make", *NOT_RUN)]
    assert not strange and len(PAGES) > 20


def test_every_rule_is_of_a_command() -> None:
    shell = [block for block in BLOCKS if block.language == "bash"]
    there = {command for block in shell for command, _ in documents.commands_of(block)}
    assert documents.RULES.keys() <= there


def test_the_tree_names_every_module() -> None:
    """And every name in it is a file or a folder."""
    (tree,) = (block.text for block in PAGES["docs/house.md"] if block.language == "text")
    for name in re.findall(r"[\w*]+\.py\b|\b\w+/", tree):
        places = [ROOT, *(ROOT / folder for folder in ("spadmnist", "scripts", "tests", "docs"))]
        assert any(list(place.glob(name)) for place in places), f"{name} is not there"
    for path in (ROOT / "spadmnist").glob("*.py"):
        assert path.stem == "__init__" or path.name in tree, f"{path.name} is not in the tree of docs/house.md"


def test_the_effect_of_the_tutorial_keeps_the_contract(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a reader calls it, from a file of this name. It lacks a source, of which the report warns."""
    (block,) = (block for block in documents.blocks("docs/start/loop.md") if block.effect)
    (tmp_path / "echo.py").write_text(block.text)
    monkeypatch.syspath_prepend(tmp_path)
    try:
        report = check_effect(getattr(importlib.import_module("echo"), block.effect))
    finally:
        sys.modules.pop("echo", None)
    assert report.checks["expected rate"] == "kept"
    assert [warning.partition("; ")[2] for warning in report.warnings] == ["add a line Source: ..."]


def test_the_effect_of_the_pages_works(reader: Reader) -> None:
    """Spreading a share of the light evenly keeps the mean and lights the background."""
    (block,) = (b for b in BLOCKS if "class Haze" in b.text)
    reader.read(block, PAGES[block.page])
    page = " ".join((ROOT / block.page).read_text().split())
    command = "spadmnist generate my.yaml --plugin haze.py"
    assert f"`{command}`" in page and "`haze: {share: 30 %}`" in page
    text = (ROOT / "configs" / "quick.yaml").read_text().replace("  effects:", "  effects:\n    haze: {share: 30 %}", 1)
    (reader.folder / "my.yaml").write_text(text)
    done = commands.run(*command.split()[1:], "-o", "hazy", "--limit", "40", cwd=reader.folder)
    assert done.returncode == 0, done.stderr
    hazy = spadmnist.open(reader.folder / "hazy")["2560 mlux", "train"]
    clear = spadmnist.open(ROOT / "configs" / "quick.yaml")["2560 mlux", "train"]
    dark = clear.images[0] == 0
    assert hazy.reconstruction["counts"][0][dark].mean() > 5 * clear.reconstruction["counts"][0][dark].mean()


def test_what_the_python_of_the_readme_reads(reader: Reader, monkeypatch: pytest.MonkeyPatch) -> None:
    (block,) = (block for block in PAGES["README.md"] if "spadmnist.open" in block.text)
    reader.read(block, PAGES[block.page])
    monkeypatch.chdir(reader.folder)
    part = reader.names[block.page]["part"]
    assert len(part) == 400 and part.reconstruction["counts"][0:64].shape == (64, 28, 28)
    assert (reader.folder / "out.png").stat().st_size > 10_000


def test_what_gamma_does_to_the_photons() -> None:
    """A value of 128 gets 22 % of white's photons, and 50 % without gamma, as the pages say."""
    assert f"{srgb_to_light(np.array(128 / 255)):.0%}" == "22%" and f"{128 / 255:.0%}" == "50%"
    for page in ("docs/start/images.md", "docs/howto/images.md"):
        text = " ".join((ROOT / page).read_text().split())
        assert "128 gets 22 % of white's photons" in text, page


# --- what stands in lines of text ---------------------------------------------------------------------------------


@pytest.mark.parametrize("page", [*PAGES, "docs/start/loop.md"])
def test_every_verb_and_option_in_a_line_is_there(page: str) -> None:
    assert not documents.wrong_verbs(page)


def test_every_file_in_a_line_is_there() -> None:
    """Those that are named with their folder."""
    named = {(page, code) for page in PAGES for code in documents.codes_in_lines(page)}
    files = {(p, c) for p, c in named if re.fullmatch(r"(?:configs|docs|scripts|spadmnist|tests)/[\w./]*", c)}
    assert len(files) > 5
    assert not [f"{page}: {code}" for page, code in files if not (ROOT / code).exists()]
