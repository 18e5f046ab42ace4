"""The harness of faults: a sample of its tries loses nothing, and a fault that is planted in the program is told."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts"

# what is torn where a file is written in its place
IN_PLACE = """
import contextlib
from spadmnist import disk

@contextlib.contextmanager
def whole(path, size):
    path.parent.mkdir(exist_ok=True)
    with disk.writing(path, size), open(path, "wb") as file:
        yield file

assert callable(disk.whole)
disk.whole = whole
"""
# what is there is kept, and is said to be as it was made
BLIND = """
from spadmnist import verify
assert callable(verify.compare)
verify.compare = lambda source, name, listed: listed["bytes"]
"""
# only where a try is made, so that its files can be made before
RAISES = """
from pathlib import Path
from spadmnist import measurement

real = measurement.open

def opened(path, *more, **named):
    if Path.cwd().name == "here":
        raise KeyError("bits")
    return real(path, *more, **named)

measurement.open = opened
"""
# a program that refuses without a word
SILENT = """
from spadmnist.cli import _terminal
assert callable(_terminal.say)
_terminal.say = lambda text: None
"""


def harness(*arguments: object, planted: str = "") -> subprocess.CompletedProcess[str]:
    """`scripts/faults.py ARGUMENTS`, of a program with other code."""
    code = f"import sys\nsys.path.insert(0, {str(SCRIPTS)!r})\nimport faults\n{planted}\n"
    command = [sys.executable, "-c", f"{code}sys.exit(faults.main(sys.argv[1:]))", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=900)


@pytest.mark.slow
@pytest.mark.parametrize(("classes", "sample"), [(("killed*", "full*"), 5), (("damaged*", "hostile*"), 10)])
def test_a_sample_of_tries_loses_nothing(classes: tuple[str, ...], sample: int) -> None:
    """Two runs: the undisturbed runs of the first, and the data of the second, are made once."""
    done = harness("run", *classes, "--sample", sample, "--seed", 1)
    assert done.returncode == 0, done.stderr[-2000:] + done.stdout[-6000:]


@pytest.mark.slow
def test_where_nothing_is_wrong_nothing_is_lost(tmp_path: Path) -> None:
    done = harness("run", "killed export npy", "full export npy", "--jobs", 1, "-o", tmp_path / "faults.md")
    assert done.returncode == 0, done.stderr + done.stdout
    text = (tmp_path / "faults.md").read_text()
    assert done.stdout.strip() == text.strip() and "## Lost" not in text
    tries, survived = (int(part) for part in text.split("| **all killed** |")[1].split("|")[:2])
    assert tries == survived > 10


@pytest.mark.parametrize(
    ("planted", "what", "says"),
    [
        (IN_PLACE, "killed export npy", "not whole: out.npy"),
        pytest.param(IN_PLACE, "full export npy", "not whole: out.npy", marks=pytest.mark.slow),
        pytest.param(BLIND, "damaged dataset hdf5", "verify: status 0", marks=pytest.mark.slow),
        pytest.param(RAISES, "hostile measurement", "fault of the program: KeyError", marks=pytest.mark.slow),
        pytest.param(SILENT, "full export npy", "its refusal is no sentence", marks=pytest.mark.slow),
    ],
)
def test_a_planted_fault_is_told(planted: str, what: str, says: str) -> None:
    done = harness("run", what, "--sample", 14, "--jobs", 1, planted=planted)
    assert done.returncode == 1, done.stderr + done.stdout
    (told,) = {line.partition("--number")[0] for line in done.stdout.splitlines() if line.startswith("- `python")}
    assert told == f'- `python scripts/faults.py run --seed 1 "{what}" ' and says in done.stdout


@pytest.mark.slow
def test_a_class_that_is_not_there() -> None:
    done = harness("run", "killed nothing")
    assert done.returncode == 2 and "no class is called so" in done.stderr
