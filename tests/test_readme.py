"""What the README says works: every fenced block as it stands, in order, in a folder as a reader has it."""

from __future__ import annotations

import re
from collections.abc import Iterator

import documents
import pytest
from documents import ROOT, Block, Reader

from spadmnist import experiments
from spadmnist.cli import cli
from spadmnist.experiments import PaperExperiment

README = "README.md"
TEXT = (ROOT / README).read_text()
BLOCKS = documents.blocks(README)


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    with documents.reading(tmp_path_factory.mktemp("readme")) as somebody:
        yield somebody


@pytest.mark.parametrize("block", [pytest.param(b, marks=b.marks, id=b.name) for b in BLOCKS])
def test_a_block_runs_as_it_stands(block: Block, reader: Reader) -> None:
    if block.lacking:
        pytest.skip(block.lacking)
    reader.read(block, BLOCKS)


def test_it_is_a_page() -> None:
    """One screen or three, not a book: what is more stands in docs."""
    assert len(TEXT.splitlines()) <= 150
    assert {block.language for block in BLOCKS} == {"bash", "python"}


def test_what_its_python_reads(reader: Reader) -> None:
    (block,) = (block for block in BLOCKS if "spadmnist.open" in block.text)
    reader.read(block, BLOCKS)
    part = reader.names[README]["part"]
    assert len(part) == 400 and part.reconstruction["counts"][0:64].shape == (64, 28, 28)
    assert (reader.folder / "out.png").stat().st_size > 10_000


def test_its_pictures_are_small_and_described() -> None:
    pictures = re.findall(r"!\[([^\]]*)\]\(([^)]+)\)", TEXT)
    assert len(pictures) == 2
    for words, name in pictures:
        assert len(words) > 20 and 10_000 < (ROOT / name).stat().st_size < 200_000, name


def test_every_verb_and_option_in_a_line_is_there() -> None:
    assert not documents.wrong_verbs(README, options())


def options() -> set[str]:
    """Those of all verbs, and of the experiments."""
    every = {name for verb in cli.commands.values() for p in verb.params for name in (*p.opts, *p.secondary_opts)}
    declared = map(PaperExperiment.registry.find, PaperExperiment.registry)
    return every | {experiments.word(key) for experiment in declared for key in experiment.options}


def test_every_link_to_a_file_is_there() -> None:
    links = set(re.findall(r"\]\(((?!https?:)[^)]+)\)", TEXT))
    assert len(links) > 8 and not [name for name in links if not (ROOT / name).exists()]
