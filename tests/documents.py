"""Fenced blocks of README.md and of the pages in docs, and somebody who goes through them.

A shell block is run command by command, a Python block with the names of those before it in the same page. A block
whose first line is a comment with the name of a file is that file. Of MATLAB each line is checked against the file that
it reads; of a Makefile what it would run is asked. Code cells (`{code-cell}`) are run by the build of the pages; `text`
is output, which nobody runs, and `bibtex` is compared with CITATION.cff (`test_readme.py`). `RULES` says which commands
are run otherwise, and why.
"""

from __future__ import annotations

import ast
import functools
import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import click
import commands
import h5py
import pytest

from spadmnist import document, experiments
from spadmnist.cli import cli
from spadmnist.experiments import PaperExperiment

ROOT = Path(__file__).parents[1]
MNIST = Path(__file__).parents[2] / "shared" / "mnist"
NOT_RUN = ("text", "bibtex")  # languages of blocks
_SLOW = r"^spadmnist (?:diagnose|fit|compare)\b|\b(?:sp|spadmnist)\.diagnose\("

_CLUSTER = "it needs a scheduler and workers, which test_cluster.py starts"
# a command -> what is run in its place (nothing: ""), and why
RULES = {
    "make demo": ("make -o .venv/installed demo", "setting up fetches packages; the program stands in .venv"),
    "make test": ("make -n -o .venv/installed test", "these tests would run themselves"),
    "make verify": ("make -n -o .venv/installed verify", "these tests would run themselves"),
    "make docs": ("make -n -o .venv/installed -o .venv/installed-docs docs", "the build executes all cells"),
    "make profile": ("make -n -o .venv/installed profile", "it takes a minute; test_timeline.py runs the script"),
    'make profile OPTIONS="--limit 20000 --lux all --jobs 4"': (
        'make -n -o .venv/installed profile OPTIONS="--limit 20000 --lux all --jobs 4"',
        "it takes minutes; test_timeline.py runs the script",
    ),
    "python scripts/kill_workers.py configs/spad_mnist.yaml --limit 10000 --kills 100 --workers 3 -o killed": (
        "python scripts/kill_workers.py --help",
        "it takes most of an hour",
    ),
    "make bench": ("make -n -o .venv/installed bench", "it takes minutes of an idle machine"),
    "python scripts/inference_cost.py": ("python scripts/inference_cost.py --help", "it takes a quarter of an hour"),
    "python scripts/memory.py": ("python scripts/memory.py --help", "it makes and reads gigabytes"),
    "make faults": ("make -n -o .venv/installed faults", "it takes up to an hour; test_faults.py runs the script"),
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
    "spadmnist experiment sensors -o sensors": (
        "spadmnist experiment sensors",
        "it takes some minutes; test_experiment_sensors.py does a small one",
    ),
    "dask scheduler --host 127.0.0.1 --port 8786 &": ("", _CLUSTER),
    "dask worker tcp://127.0.0.1:8786 --nworkers 4 --nthreads 1 &": ("", _CLUSTER),
    "spadmnist generate configs/quick.yaml -o out --cluster tcp://127.0.0.1:8786": (
        "spadmnist generate configs/quick.yaml -o out",
        _CLUSTER,
    ),
    "spadmnist generate configs/spad_mnist.yaml -o spad_mnist --cluster tcp://HOST:PORT": ("", _CLUSTER),
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
    """A fenced block: its page and first line, its language and its text."""

    page: str
    line: int
    language: str
    text: str
    needs: frozenset[str] = frozenset()  # packages whose names it uses, imported by blocks above it

    @property
    def place(self) -> str:
        """Where it stands."""
        return f"{self.page}:{self.line}"

    @property
    def name(self) -> str:
        """What its test is called."""
        return f"{self.page.removeprefix('docs/').removesuffix('.md')} {self.line} {self.language}"

    @property
    def file(self) -> str:
        """The file that it is, or nothing."""
        found = re.match(r"# ([\w./]+\.(?:py|yaml))$", self.text, re.M)
        return found[1] if found else ""

    @property
    def effect(self) -> str:
        """The class of the effect that it defines, or nothing."""
        found = re.search(r"^class (\w+)\(Effect\b", self.text, re.M)
        return found[1] if found else ""

    @property
    def marks(self) -> list[pytest.MarkDecorator]:
        """What compares and diagnoses is left to `make verify`: it takes longer than all else."""
        return [pytest.mark.slow] if re.search(_SLOW, self.text, re.M) else []

    @property
    def lacking(self) -> str:
        """What it needs and this machine has not, or nothing."""
        for name in sorted(self.needs | set().union(*self.imports.values())):
            if importlib.util.find_spec(name) is None and not (ROOT / "configs" / f"{name}.py").is_file():
                return f"{name} is not installed"
        if "spad_mnist.yaml" in self.text and not MNIST.is_dir():
            return f"MNIST's four files are not in {MNIST}"
        for program in ("make", "sbatch"):
            used = self.language == program or re.search(rf"(?:^|\(){program} ", self.text, re.M)
            if self.language in ("bash", program) and used and shutil.which(program) is None:
                return f"{program} is not installed"
        return ""

    @property
    def nodes(self) -> list[ast.AST]:
        """Its Python."""
        return list(ast.walk(ast.parse(self.text))) if self.language == "python" else []

    @property
    def imports(self) -> dict[str, set[str]]:
        """The packages that each name which it imports is made of."""
        found = {}
        for node in self.nodes:
            if isinstance(node, ast.Import | ast.ImportFrom):
                for name in node.names:
                    module = name.name if isinstance(node, ast.Import) else str(node.module)
                    own = {"torch"} if module.startswith("spadmnist.torch") else set()
                    found[name.asname or name.name.partition(".")[0]] = own | {module.partition(".")[0]}
        return found


def blocks(page: str) -> list[Block]:
    """The blocks of a page, a path from the root of the project, in order."""
    found, start, language, fence = [], 0, "", ""
    lines = (ROOT / page).read_text().splitlines()
    for number, line in enumerate(lines, 1):
        if fence:
            if line == fence:
                found.append(Block(page, start, language, "\n".join(lines[start : number - 1]) + "\n"))
                fence = ""
        elif opened := re.match(r"(```+)([^`]*)$", line):
            start, fence, language = number, opened[1], opened[2].strip()
    assert not fence, f"{page}:{start} has no end"
    imported: dict[str, set[str]] = {}
    out = []
    for block in (block for block in found if not block.language.startswith("{")):
        used = {node.id for node in block.nodes if isinstance(node, ast.Name)}
        needs = set().union(*(imported[name] for name in used & set(imported)))
        out.append(replace(block, needs=frozenset(needs)))
        imported |= block.imports
    return out


def commands_of(block: Block) -> list[tuple[str, int]]:
    """(command, exit status) of a shell block, without the comments: one that says `exit status 1` tells the status.

    A command that ends with a backslash goes on in the next line.
    """
    found = []
    for line in re.sub(r"\s*\\\n\s*", " ", block.text).splitlines():
        command, _, comment = line.partition(" #")
        status = re.search(r"exit status (\d)", comment)
        if command.strip() and not command.startswith("#"):
            found.append((command.strip(), int(status[1]) if status else 0))
    return found


@dataclass
class Reader:
    """Goes through pages from their beginnings, all in one folder. A command is not run twice."""

    folder: Path
    names: dict[str, dict[str, Any]] = field(default_factory=dict)
    done: set[Block] = field(default_factory=set)
    run: set[str] = field(default_factory=set)

    def read(self, block: Block, page: list[Block]) -> None:
        """A block, after all that stand before it in its page; of these none that is slow."""
        for each in page[: page.index(block) + 1]:
            if each in self.done or each.lacking or (each.marks and each != block and not block.marks):
                continue
            with pytest.MonkeyPatch.context() as patch:
                patch.chdir(self.folder)
                self._take(each)
            self.done.add(each)

    def _take(self, block: Block) -> None:
        if block.file:
            Path(block.file).parent.mkdir(parents=True, exist_ok=True)
            Path(block.file).write_text(block.text)
        elif block.language == "yaml":
            document.parse(block.text, block.place)
        elif block.language not in NOT_RUN:
            takes = {"bash": self._shell, "python": self._python, "matlab": self._matlab, "make": self._make}
            takes[block.language](block)

    def _shell(self, block: Block) -> None:
        for line, status in commands_of(block):
            if line in self.run:
                continue
            command, _ = RULES.get(line, (line, ""))
            words = shlex.split(command)
            if words[:1] == ["spadmnist"]:
                done = commands.run(*words[1:], cwd=self.folder, timeout=900)
            else:
                done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=600)
            assert done.returncode == status, f"{block.place}: {command}\n{done.stdout}{done.stderr}"
            self.run.add(line)

    def _make(self, block: Block) -> None:
        """What its first target would run."""
        done = subprocess.run(["make", "-n", "-f", "-"], input=block.text, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0 and done.stdout, f"{block.place}: {done.stdout}{done.stderr}"

    def _python(self, block: Block) -> None:
        names = self.names.setdefault(block.page, {"__name__": block.page})
        exec(compile(block.text, block.place, "exec"), names)

    def _matlab(self, block: Block) -> None:
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


@contextmanager
def reading(folder: Path) -> Iterator[Reader]:
    """Somebody in a folder with what the commands use of the project."""
    for name in ("Makefile", "pyproject.toml", "scripts", "docs"):
        (folder / name).symlink_to(ROOT / name)
    shutil.copytree(ROOT / "configs", folder / "configs")
    (folder / ".venv" / "bin").mkdir(parents=True)
    (folder / ".venv" / "bin" / "spadmnist").symlink_to(commands.COMMAND)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
        patch.setenv("SPADMNIST_CACHE", str(folder / "cache"))
        patch.syspath_prepend(folder)
        if MNIST.is_dir():
            patch.setenv("SPADMNIST_DATA", str(MNIST))
        patch.delenv("MAKEFLAGS", raising=False)
        yield Reader(folder)


# --- what stands in lines of text ---------------------------------------------------------------------------------


def codes_in_lines(page: str) -> list[str]:
    """What stands between single backquotes in the text of a page."""
    text = re.sub(r"^(```+|:::+).*?^\1$", "", (ROOT / page).read_text(), flags=re.M | re.S)
    return [" ".join(code.split()) for code in re.findall(r"(?<![`}])`([^`]+)`(?!`)", text)]


@functools.cache
def _options() -> tuple[dict[str, set[str]], set[str]]:
    """(verb -> its options, those of all verbs and of the experiments)."""
    context = click.Context(cli, info_name="spadmnist")
    verbs = {}
    for name in cli.list_commands(context):
        command = cli.get_command(context, name)
        assert command is not None
        params = command.get_params(click.Context(command, parent=context, info_name=name))
        verbs[name] = {option for param in params for option in (*param.opts, *param.secondary_opts)}
    declared = map(PaperExperiment.registry.find, PaperExperiment.registry)
    every = {experiments.word(key) for experiment in declared for key in experiment.options}
    return verbs, every.union({"--help", "--version"}, *verbs.values())


def wrong_verbs(page: str) -> list[str]:
    """Sentences about verbs and options in lines of text of a page that are not there."""
    verbs, every = _options()
    found = []
    for code in codes_in_lines(page):
        words = shlex.split(code) if code.count('"') % 2 == 0 else code.split()
        if words[:1] == ["spadmnist"] and len(words) > 1:
            words = words[1:]
            if words[0] not in verbs and not words[0].startswith("-"):
                found.append(f"{page}: `{code}`: there is no such verb")
                continue
        if not words or not (words[0] in verbs or words[0].startswith("--")):
            continue
        there = verbs.get(words[0], every) | {"--help"}
        for option in (word for word in words if re.fullmatch(r"--?[a-z][a-z-]*", word)):
            if option not in there:
                found.append(f"{page}: `{code}`: there is no option {option}")
    return found
