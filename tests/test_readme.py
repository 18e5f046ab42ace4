"""What the README says works: every fenced block as it stands, in order, in a folder as a reader has it.

A shell block is run command by command, a Python block with the names of those before it; of MATLAB each line is
checked against the file that it reads, of the tree each name. `RULES` says which commands are run otherwise, and why.
The blocks of the loop are those that `test_tutorial.py` goes through.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import commands
import h5py
import pytest

import spadmnist
from spadmnist import experiments
from spadmnist.cli import cli
from spadmnist.experiments import PaperExperiment
from spadmnist.testing import check_effect

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
LOOP = README[README.index("### The loop") : README.index("## How fast")]
MNIST = Path(__file__).parents[2] / "shared" / "mnist"

# a command of the README -> what is run in its place (nothing: ""), and why
RULES = {
    "make demo": ("make -o .venv/installed demo", "setting up fetches packages; the program stands in .venv"),
    "make test": ("make -n -o .venv/installed test", "these tests would run themselves"),
    "make challenge": (
        "make -n -o .venv/installed challenge",
        "it takes 90 minutes; test_challenge.py runs the script",
    ),
    "python3 -m venv .venv": ("python3 -m venv --without-pip .venv", "it takes seconds, and nothing is installed"),
    ".venv/bin/pip install -e .": ("", "it fetches packages; the program stands in .venv"),
    "spadmnist generate configs/spad_mnist.yaml -o spad_mnist": (
        "spadmnist generate configs/spad_mnist.yaml -o spad_mnist --limit 2",
        "700,000 images take minutes",
    ),
    "spadmnist experiment accuracy -o accuracy": (
        "spadmnist experiment accuracy",
        "it takes most of an hour; test_experiments.py does a small one, and a quick one on MNIST",
    ),
    "spadmnist experiment captures -o captures": (
        "spadmnist experiment captures",
        "it takes some ten minutes; test_experiment_captures.py does a small one, and a quick one on MNIST",
    ),
    "spadmnist generate configs/spad23.yaml -o lab": (
        "spadmnist generate configs/spad23.yaml -o lab --limit 1",
        "compare and diagnose take a tenth of the time with one capture of ten",
    ),
    "spadmnist diagnose configs/spad23.yaml lab -o next": (
        "spadmnist diagnose configs/spad23.yaml lab -o next --quick",
        "a third of the simulations",
    ),
}


@dataclass(frozen=True)
class Block:
    """A fenced block: the line on which it begins, its language ("" is the shell) and its text."""

    line: int
    language: str
    text: str

    @property
    def effect(self) -> str:
        """The class of the effect that it defines, or nothing."""
        found = re.search(r"^class (\w+)\(Effect\b", self.text, re.M)
        return found[1] if found else ""

    @property
    def marks(self) -> list[pytest.MarkDecorator]:
        """`diagnose` is left to `make verify`: it takes longer than all others."""
        return [pytest.mark.slow] if "spadmnist diagnose" in self.text else []

    @property
    def lacking(self) -> str:
        """What it needs and this machine has not, or nothing."""
        if re.search(r"import torch|\bst\.", self.text) and importlib.util.find_spec("torch") is None:
            return "PyTorch is not installed"
        if "spad_mnist.yaml" in self.text and not MNIST.is_dir():
            return f"MNIST's four files are not in {MNIST}"
        if re.search(r"^make ", self.text, re.M) and shutil.which("make") is None:
            return "make is not installed"
        return ""


def blocks() -> list[Block]:
    found, lines = [], README.splitlines()
    fences = [i for i, line in enumerate(lines) if line.startswith("```")]
    for start, end in zip(fences[::2], fences[1::2], strict=True):
        assert lines[end] == "```", f"README.md:{end + 1} ends no block"
        found.append(Block(start + 1, lines[start][3:], "\n".join(lines[start + 1 : end]) + "\n"))
    return found


BLOCKS = blocks()
# those that are run here
OURS = [block for block in BLOCKS if block.text not in LOOP]


def command_of(line: str) -> str:
    """A line of a shell block without its comment."""
    return re.sub(r"\s+#.*", "", line).strip()


@dataclass
class Reader:
    """Goes through the README from its beginning."""

    folder: Path
    names: dict[str, Any] = field(default_factory=dict)
    done: set[int] = field(default_factory=set)

    def read(self, block: Block) -> None:
        """A block, after all that stand before it; of these none that is slow."""
        for each in OURS[: OURS.index(block) + 1]:
            if each.line in self.done or each.lacking or (each.marks and each != block):
                continue
            with pytest.MonkeyPatch.context() as patch:
                patch.chdir(self.folder)
                {"": self.shell, "python": self.python, "matlab": self.matlab, "text": self.tree}[each.language](each)
            self.done.add(each.line)

    def shell(self, block: Block) -> None:
        for line in filter(None, map(command_of, block.text.splitlines())):
            command, _ = RULES.get(line, (line, ""))
            words = shlex.split(command)
            if words[:1] == ["spadmnist"]:
                done = commands.run(*words[1:], cwd=self.folder, timeout=600)
            else:
                done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=600)
            assert done.returncode == 0, f"README.md:{block.line}: {command}\n{done.stdout}{done.stderr}"

    def python(self, block: Block) -> None:
        if block.effect:
            Path(f"{block.effect.lower()}.py").write_text(block.text)
        else:
            exec(compile(block.text, f"README.md:{block.line}", "exec"), self.names)

    def matlab(self, block: Block) -> None:
        """Every line reads what is there."""
        path = ""
        for line in filter(None, (re.sub(r"\s*%.*", "", line) for line in block.text.splitlines())):
            if name := re.fullmatch(r"file = '(.*)';", line):
                path = name[1]
                assert Path(path).is_file(), path
                continue
            with h5py.File(path) as file:
                if read := re.fullmatch(r"\w+ = h5read\(file, '(.*)'\);", line):
                    assert file[read[1]].size > 0, line
                else:
                    read = re.fullmatch(r"(\w+) = h5readatt\(file, '(.*)', '(.*)'\);", line)
                    assert read is not None, f"{line} is not understood here"
                    assert file[read[2]].attrs[read[3]] > 0, line

    def tree(self, block: Block) -> None:
        """Every name is a file or a folder, and no module is missing."""
        for name in re.findall(r"[\w*]+\.py\b|\b\w+/", block.text):
            places = [ROOT, *(ROOT / folder for folder in ("spadmnist", "scripts", "tests"))]
            assert any(list(place.glob(name)) for place in places), f"{name} is not there"
        for path in (ROOT / "spadmnist").glob("*.py"):
            assert path.stem == "__init__" or path.name in block.text, f"{path.name} is not in the README's tree"


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    """In a folder with what the commands of the README use of the project."""
    folder = tmp_path_factory.mktemp("readme")
    for name in ("Makefile", "pyproject.toml", "scripts"):
        (folder / name).symlink_to(ROOT / name)
    shutil.copytree(ROOT / "configs", folder / "configs")
    (folder / ".venv" / "bin").mkdir(parents=True)
    (folder / ".venv" / "bin" / "spadmnist").symlink_to(commands.COMMAND)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
        patch.setenv("SPADMNIST_CACHE", str(folder / "cache"))
        if MNIST.is_dir():
            patch.setenv("SPADMNIST_DATA", str(MNIST))
        patch.delenv("MAKEFLAGS", raising=False)
        yield Reader(folder)


def name_of(block: Block) -> str:
    return f"line {block.line} {block.language or 'shell'}"


@pytest.mark.parametrize("block", [pytest.param(b, marks=b.marks, id=name_of(b)) for b in OURS])
def test_a_block_runs_as_it_stands(block: Block, reader: Reader) -> None:
    if block.lacking:
        pytest.skip(block.lacking)
    reader.read(block)


def test_no_block_is_left_out() -> None:
    assert README.count("```") == 2 * len(BLOCKS)
    assert {block.language for block in BLOCKS} == {"", "python", "matlab", "text"}
    assert [block.language for block in BLOCKS if block not in OURS] == ["", "python", ""], "the loop is three blocks"


def test_every_rule_is_of_a_command() -> None:
    there = {command_of(line) for block in OURS if not block.language for line in block.text.splitlines()}
    assert RULES.keys() <= there


# --- what the blocks give -----------------------------------------------------------------------------------------


def having(text: str) -> Block:
    (block,) = (block for block in OURS if text in block.text)
    return block


def test_what_the_python_of_the_readme_reads(reader: Reader) -> None:
    reader.read(having("import xarray"))
    part, shard = reader.names["part"], reader.names["shard"]
    assert len(part) == 400 and shard["counts"].shape == (400, 28, 28)
    assert (reader.folder / "out.png").stat().st_size > 10_000


@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="PyTorch is not installed")
def test_the_loader_of_the_readme_loads(reader: Reader, monkeypatch: pytest.MonkeyPatch) -> None:
    reader.read(having("st.Fluxes("))
    monkeypatch.chdir(reader.folder)
    fluxes, labels = next(iter(reader.names["loader"]))
    assert fluxes.shape == (64, 1, 28, 28) and labels.shape == (64,)
    packed, (voxels, _) = next(iter(reader.names["events"])), next(iter(reader.names["voxels"]))
    assert len(packed.offsets) == 65 and voxels.shape == (64, 10, 28, 28)


@pytest.mark.parametrize("block", [pytest.param(b, id=b.effect) for b in BLOCKS if b.effect])
def test_an_effect_of_the_readme_keeps_the_contract(
    block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a reader calls it, from a file of this name. It lacks a source, of which the report warns."""
    module = block.effect.lower()
    (tmp_path / f"{module}.py").write_text(block.text)
    monkeypatch.syspath_prepend(tmp_path)
    try:
        report = check_effect(getattr(importlib.import_module(module), block.effect))
    finally:
        sys.modules.pop(module, None)
    assert report.checks["expected rate"] == ("kept" if "expected_rate" in block.text else "it has none of its own")
    assert [warning.partition("; ")[2] for warning in report.warnings] == ["add a line Source: ..."]


def test_the_effect_of_the_readme_works(reader: Reader) -> None:
    """Spreading a share of the light evenly keeps the mean and lights the background."""
    reader.read(having("class Haze"))
    generate, effects = "spadmnist generate my.yaml --plugin haze.py", "spadmnist effects --plugin haze.py"
    assert all(f"`{command}`" in " ".join(README.split()) for command in (generate, effects, "haze: {share: 30 %}"))
    text = (ROOT / "configs" / "quick.yaml").read_text().replace("  effects:", "  effects:\n    haze: {share: 30 %}", 1)
    (reader.folder / "my.yaml").write_text(text)
    for command in (f"{generate} --limit 40", effects):
        done = commands.run(*command.split()[1:], cwd=reader.folder)
        assert done.returncode == 0, done.stderr
    assert "haze" in done.stdout
    hazy, clear = (spadmnist.open(reader.folder / name)["2560 mlux", "train"] for name in ("my", "out"))
    dark = clear.images[0] == 0
    assert hazy.reconstruction["counts"][0][dark].mean() > 5 * clear.reconstruction["counts"][0][dark].mean()


# --- what stands in lines of text ---------------------------------------------------------------------------------

TEXT = re.sub(r"^```.*?^```$", "", README, flags=re.M | re.S)
IN_LINE = [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", TEXT)]


def test_every_verb_and_option_in_a_line_is_there() -> None:
    every = {name for verb in cli.commands.values() for p in verb.params for name in (*p.opts, *p.secondary_opts)}
    declared = map(PaperExperiment.registry.find, PaperExperiment.registry)
    every |= {experiments.word(key) for experiment in declared for key in experiment.options}
    seen = 0
    for code in IN_LINE:
        words = shlex.split(code) if code.count('"') % 2 == 0 else code.split()
        if words[0] == "spadmnist" and len(words) > 1:
            words = words[1:]
            assert words[0] in cli.commands or words[0].startswith("-"), f"`{code}`: there is no such verb"
        verb = cli.commands.get(words[0])
        if verb is None and not words[0].startswith("-"):
            continue
        known = every if verb is None else {name for p in verb.params for name in p.opts}
        for option in (word for word in words if re.fullmatch(r"--?[a-z][a-z-]*", word)):
            assert option in known | {"--help"}, f"`{code}`: there is no option {option}"
            seen += 1
    assert seen > 15


def test_every_file_in_a_line_is_there() -> None:
    """Those that are named with their folder."""
    named = {code for code in IN_LINE if re.fullmatch(r"(?:configs|docs|scripts|spadmnist|tests)/[\w./]*", code)}
    links = set(re.findall(r"\]\(((?!https?:)[^)]+)\)", README))
    assert len(named) > 5 and links
    assert not [name for name in named | links if not (ROOT / name).exists()]
