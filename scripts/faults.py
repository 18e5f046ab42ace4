"""Kills, full disks, damaged data and hostile files by the thousand: is anything lost?

    python scripts/faults.py list
    python scripts/faults.py run -o faults.md                   # all of it
    python scripts/faults.py run "killed*" --sample 40          # of each class at most so many tries, drawn by lot
    python scripts/faults.py run "killed generate zarr" --number 17     # one try again

Survived is a try after which everything is as it must be (the table says what that is). Any other is lost, is listed
with the command that repeats it, and makes the exit status 1.
"""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

sys.path.insert(0, str(Path(__file__).parent))
import faults_hostile
from faults_scenes import CONFIG, METHODS, PLAN, SENSOR, Damaged, Full, Killed, Scene, copied, in_this_process

_SHOWN = 20  # lost tries of a class that are listed
_WHAT = {
    "killed": "killed at each step that changes the disk (SIGKILL; also with half of a write's bytes on it), every "
    "second time the run that goes on is killed, too: every file in its place is whole, reading gives right values or "
    "one sentence, and the same command ends with the bytes of an undisturbed run and nothing else",
    "full": "no space from each step on: one sentence, nothing torn, and with space again the same bytes",
    "damaged": "each file with a flipped bit, cut, emptied, removed, replaced by another one of it or by a "
    "folder: reading gives right values or one sentence; `verify` names the file, `--repair` makes the same bytes",
    "hostile": "changed bytes, numbers and words in files that the program reads: it ends in time and memory, with "
    "status 0 or one sentence",
}


class Class(Protocol):
    """Tries of one kind, numbered from 0."""

    @property
    def name(self) -> str: ...
    @property
    def tries(self) -> int: ...
    def attempt(self, number: int, rng: random.Random, here: Path) -> str:
        """What was lost, in a line; empty where nothing was."""
        ...


@dataclass(frozen=True)
class Lost:
    """A try that was not survived."""

    name: str
    number: int
    wrong: str


@dataclass(frozen=True)
class Row:
    """What came of a class."""

    name: str
    tries: int
    lost: tuple[Lost, ...]


# --- what there is ------------------------------------------------------------------------------------------------


def classes(base: Path, patterns: Sequence[str] = ("*",)) -> list[Class]:
    """The classes of some names (patterns, the first word of which is of the kind); their files are made in `base`."""
    scenes, damaged = _datasets(base), _damaged(base)
    scenes += _measurements(base)
    every: list[Class] = [*(Killed(scene) for scene in scenes), *(Full(scene) for scene in scenes), *damaged]
    if any(fnmatch.fnmatch("hostile", pattern.split(" ")[0]) for pattern in patterns):
        every += faults_hostile.classes(base)
    return [one for one in every if any(fnmatch.fnmatch(one.name, pattern) for pattern in patterns)]


def _datasets(base: Path) -> list[Scene]:
    scenes = []
    one = ("-j", "1")
    for format in ("zarr", "hdf5"):
        home = base / format
        home.mkdir(parents=True)
        (home / "few.yaml").write_text(CONFIG.format(format=format, methods=", ".join(METHODS[:2])))
        (home / "all.yaml").write_text(CONFIG.format(format=format, methods=", ".join(METHODS)))
        for name in ("few", "all"):
            in_this_process("generate", home / f"{name}.yaml", "-o", home / name, *one)

        def begun(what: str, home: Path = home) -> Path:
            start = home / f"start-{what}"
            start.mkdir()
            return start

        start = begun("generate")
        shutil.copy(home / "all.yaml", start)
        scenes.append(Scene(f"generate {format}", ("generate", "all.yaml", "-o", "out", *one), start))
        start = begun("reconstruct")
        shutil.copytree(home / "few", start / "out")
        methods = [word for name in METHODS[2:] for word in ("--method", name)]
        scenes.append(Scene(f"reconstruct {format}", ("reconstruct", "out", *methods, *one), start))
        for what, share in (("repair", 3), ("repair manifest", 0)):
            start = begun(what)
            shutil.copytree(home / "all", start / "out")
            files = sorted(p for p in (start / "out").rglob("*") if p.is_file() and p.name != "manifest.json")
            for n, victim in enumerate(files[::share] if share else []):
                victim.unlink() if n % 2 else victim.write_bytes(b"damaged")
            if not share:
                (start / "out" / "manifest.json").unlink()
                files[-1].write_bytes(b"damaged")
            scenes.append(Scene(f"{what} {format}", ("verify", "out", "--repair", *one), start))
    return scenes


def _damaged(base: Path) -> list[Damaged]:
    lab = base / "lab"
    (base / "sensor.yaml").write_text(SENSOR)
    (base / "plan.yaml").write_text(PLAN)
    in_this_process("simulate", base / "sensor.yaml", base / "plan.yaml", "-o", lab)
    return [
        Damaged("dataset zarr", base / "zarr" / "all", rounds=10),
        Damaged("dataset hdf5", base / "hdf5" / "all", rounds=8),
        Damaged("measurement", lab, rounds=10, dataset=False),
    ]


def _measurements(base: Path) -> list[Scene]:
    start = base / "start-measurement"
    start.mkdir()
    shutil.copytree(base / "lab", start / "lab")
    for name in ("sensor.yaml", "plan.yaml"):
        shutil.copy(base / name, start)
    in_this_process("export", start / "lab", "-o", start / "files", "--format", "hdf5")
    files = [f"files/{name}.h5" for name in ("dark", "flat", "bits", "sums")]
    filled = base / "start-plan"
    copied(start, filled)
    (filled / "out").mkdir()
    shutil.copy(base / "plan.yaml", filled / "out" / "measurement.yaml")
    plan = ("import", files[1], "-o", "out", "--capture", "flat")
    scenes = [
        Scene("simulate", ("simulate", "sensor.yaml", "plan.yaml", "-o", "out"), start),
        Scene("import", ("import", *files, "-o", "out", "--name", "lab"), start),
        Scene("import into a plan", plan, filled, refusable=True),
        Scene("reconstruct measurement", ("reconstruct", "lab", "--method", "counts", "-o", "out"), start),
    ]
    for format in ("hdf5", "npz"):
        words = ("export", "lab", "-o", "out", "--format", format)
        scenes.append(Scene(f"export {format}", words, start, refusable=True))
    words = ("export", "lab", "-o", "out.npy", "--format", "npy", "--capture", "bits")
    return [*scenes, Scene("export npy", words, start, out="out.npy", refusable=True)]


# --- running ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Try:
    index: int  # of the class
    number: int


_base: Path
_classes: list[Class]
_seed: int


@contextlib.contextmanager
def _place() -> Iterator[Path]:
    """A folder that goes again."""
    memory = Path("/dev/shm")  # where a disk is memory nothing waits for it
    base = Path(tempfile.mkdtemp(prefix="faults-", dir=memory if os.access(memory, os.W_OK) else None))
    try:
        yield base
    finally:
        shutil.rmtree(base, ignore_errors=True)


def _attempted(one: _Try) -> Lost | None:
    chosen = _classes[one.index]
    here = _base / f"worker-{os.getpid()}" / "here"
    here.parent.mkdir(exist_ok=True)
    try:
        wrong = chosen.attempt(one.number, random.Random(f"{_seed} {chosen.name} {one.number}"), here)
    except Exception:
        wrong = f"the harness itself: {traceback.format_exc()[-600:]}"
    return Lost(chosen.name, one.number, " ".join(wrong.split())) if wrong else None


def tried(patterns: Sequence[str], seed: int, sample: int | None, jobs: int, number: int | None = None) -> list[Row]:
    """Try what the patterns name; a row for each class."""
    global _base, _classes, _seed
    with _place() as base:
        _base, _seed, _classes = base, seed, classes(base, patterns)
        tries = []
        for index, one in enumerate(_classes):
            numbers: Sequence[int] = range(one.tries)
            if sample is not None and sample < len(numbers):
                numbers = sorted(random.Random(f"{seed} {one.name}").sample(numbers, sample))
            tries += [_Try(index, n) for n in ([number] if number is not None else numbers)]
        found: list[list[Lost]] = [[] for _ in _classes]
        random.Random(seed).shuffle(tries)  # so that no worker has all that take long
        # none of them is ended by SIGTERM: the program's own answer to it is there, and is lost in one just forked
        with ProcessPoolExecutor(jobs, multiprocessing.get_context("fork")) as pool:
            try:
                for n, (one, lost) in enumerate(zip(tries, pool.map(_attempted, tries, chunksize=4), strict=True)):
                    if lost:
                        found[one.index].append(lost)
                    if sys.stderr.isatty():
                        print(f"\r{n + 1} of {len(tries)}, {sum(map(len, found))} lost", end="", file=sys.stderr)
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        counts = [sum(one.index == index for one in tries) for index in range(len(_classes))]
        return [Row(c.name, n, tuple(lost)) for c, n, lost in zip(_classes, counts, found, strict=True)]


# --- saying -------------------------------------------------------------------------------------------------------


def report(rows: Sequence[Row], made_by: str, minutes: float, again: str) -> str:
    """The table, as Markdown."""
    lines = ["# Faults", "", f"`{made_by}`, {minutes:.1f} minutes on {os.cpu_count()} processors.", ""]
    kinds = [kind for kind in _WHAT if any(row.name.startswith(kind) for row in rows)]
    lines += [f"- **{kind}**: {_WHAT[kind]}." for kind in kinds]
    lines += ["", "| class | tries | survived | lost |", "|---|---:|---:|---:|"]
    for row in rows:
        lines.append(f"| {row.name} | {row.tries:,} | {row.tries - len(row.lost):,} | {len(row.lost):,} |")
    for kind in [*kinds, ""] if len(kinds) > 1 else kinds:
        part = [row for row in rows if row.name.startswith(kind)]
        total, lost = sum(row.tries for row in part), sum(len(row.lost) for row in part)
        lines.append(f"| **all {kind}** | {total:,} | {total - lost:,} | {lost:,} |".replace("all **", "all**"))
    if any(row.lost for row in rows):
        lines += ["", "## Lost", ""]
    for row in rows:
        for lost in sorted(row.lost, key=lambda one: one.number)[:_SHOWN]:
            lines.append(f'- `{again} "{lost.name}" --number {lost.number}`: {lost.wrong}')
        if len(row.lost) > _SHOWN:
            lines.append(f"- and {len(row.lost) - _SHOWN} more of {row.name}")
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 0: nothing was lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    verbs.add_parser("list", help="the classes, and how many tries each has")
    runs = verbs.add_parser("run", help="try them")
    runs.add_argument("patterns", nargs="*", default=["*"], metavar="CLASS", help='as list says; "killed*"')
    runs.add_argument("--seed", type=int, default=1)
    runs.add_argument("--sample", type=int, help="of each class at most so many, drawn by lot")
    runs.add_argument("--number", type=int, help="only this try of the class")
    runs.add_argument("--jobs", type=int, default=2, help="tries at a time")
    runs.add_argument("-o", "--output", type=Path, help="write the table there, too")
    given = parser.parse_args(arguments)
    if given.verb == "list":
        with _place() as base:
            for one in classes(base):
                print(f"{one.tries:6}  {one.name}")
        return 0
    began = time.monotonic()
    rows = tried(given.patterns, given.seed, given.sample, given.jobs, given.number)
    if not rows:
        parser.error(f"no class is called so: {', '.join(given.patterns)}; see: python scripts/faults.py list")
    again = f"python scripts/faults.py run --seed {given.seed}"
    words = [f'"{one}"' for one in given.patterns] if given.patterns != ["*"] else []
    words += [f"--{name} {getattr(given, name)}" for name in ("sample", "jobs") if getattr(given, name) is not None]
    text = report(rows, " ".join([again, *words]), (time.monotonic() - began) / 60, again)
    print(text)
    if given.output:
        given.output.parent.mkdir(parents=True, exist_ok=True)
        given.output.write_text(text)
    return int(any(row.lost for row in rows))


if __name__ == "__main__":
    sys.exit(main())
