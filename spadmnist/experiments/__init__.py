"""Experiments of the paper, done again by one command each. A file in this folder is one, found by being there.

    class Accuracy(PaperExperiment):
        \"\"\"How well does a network read digits from flux images, in less and less light? ...\"\"\"

        clip = option(20.0, "Where inputs end.", bounds=(0, None))   # spadmnist experiment accuracy --clip 20

        def prepare(self, setting): ...    # makes or opens the data; what is to be measured, task by task
        def measure(self, task): ...       # one task, in a process of its own; numbers
        def tell(self, result): ...        # one line about a result, as it comes
        def story(self, results): ...      # all results that are there: answer, tables, pictures
        def rows(self, results): ...       # the same as rows of a CSV file

Nothing else is touched. `run` does the rest, the same for all: it spreads the tasks over workers, says how much time is
left, writes each result into a file of its own as soon as it is there, and from all of them the page, the pictures and
the tables. The same command again does what is missing, and nothing twice.

    OUT/results/<key>.json   a result each
    OUT/report.html          the page; OUT/<drawing>.png its pictures
    OUT/<name>.csv           the results as a table; OUT/<name>.md: the page's content for docs/experiments.md

A module whose name begins with an underscore is what several experiments share.
"""

from __future__ import annotations

import csv
import inspect
import io
import json
import math
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from .. import disk, factory, manifest_file, pages, plugins, reference, report
from ..errors import SpadError
from ..factory import Progress
from ..pages import Story, Table
from ..plugins import Plugin, Registry
from ..workers import executor

FORMAT = "spadmnist-result/1"
RESULTS = "results"
_LARGEST = 1 << 20  # bytes of a result
_PAUSE = 60.0  # s between two drawings of the page while results come
_KEY = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]*")


# --- what an experiment declares ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Option:
    """An option of one experiment, beside those that all have.

    default, about: its help. bounds: of a number. several: it is text, and may be given several times; the value is
    a tuple of texts. metavar: how the help calls its value.
    """

    default: Any
    about: str
    bounds: tuple[float | None, float | None] = (None, None)
    several: bool = False
    metavar: str = "X"

    def check(self, name: str, value: float) -> None:
        """Raises SpadError where a number lies outside the bounds."""
        low, high = self.bounds
        if not math.isfinite(value) or (low is not None and value < low) or (high is not None and value > high):
            allowed = [f"{word} {edge:g}" for word, edge in (("at least", low), ("at most", high)) if edge is not None]
            raise SpadError(f"{word(name)}: {value:g} is not possible; give {' and '.join(allowed) or 'a number'}")


def option(
    default: Any,
    about: str,
    *,
    bounds: tuple[float | None, float | None] = (None, None),
    several: bool = False,
    metavar: str = "X",
) -> Any:
    """Declare an option in the body of an experiment's class; see `Option`."""
    return Option(default, about, bounds, several, metavar)


def word(name: str) -> str:
    """How an option is written: `light_levels` -> `--light-levels`."""
    return "--" + name.replace("_", "-")


@dataclass(frozen=True)
class Setting:
    """What a run is told. out: its folder; quick: less of everything, in minutes; jobs: workers at a time."""

    out: Path
    quick: bool = False
    images_dir: Path | None = None
    jobs: int = 1
    progress: Progress = field(default_factory=Progress)


@dataclass(frozen=True)
class Task:
    """One thing to be measured.

    key: the name of its result's file. about: what it is of, in JSON; the result has it, too. work: how long it takes,
    beside other tasks. given: what `measure` needs besides; it goes to a worker.
    """

    key: str
    about: Mapping[str, Any]
    work: float = 1.0
    given: Any = None


@dataclass(frozen=True)
class Plan:
    """What a run measures. common: what all results of one folder share, in JSON (the data's digest, a seed, ...)."""

    common: Mapping[str, Any]
    tasks: Sequence[Task]


class PaperExperiment(Plugin, abstract=True):
    """Base of every experiment. Its docstring is its reference; its first line says what is asked.

    An instance holds the values of the options and nothing else: it is sent to workers.
    """

    registry: ClassVar[Registry] = Registry("experiment", verb="experiment", from_files=False)
    options: ClassVar[dict[str, Option]] = {}

    def __init_subclass__(cls, abstract: bool = False, **keywords: Any):
        declared = dict(cls.options)
        for key, value in list(vars(cls).items()):
            if isinstance(value, Option):
                declared[key] = value
                setattr(cls, key, value.default)
        cls.options = declared
        super().__init_subclass__(abstract=abstract, **keywords)

    def __init__(self, **values: Any):
        """values: of the options. Raises SpadError for one that is not there, or whose value is not possible."""
        for key, value in values.items():
            if key not in self.options:
                raise SpadError(
                    f"{word(key)}: {self.name} has no such option; spadmnist experiment {self.name} lists them"
                )
            if not self.options[key].several:
                self.options[key].check(key, value)
            setattr(self, key, value)

    def prepare(self, setting: Setting) -> Plan:
        """Make or open the data, and say what is to be measured.

        Called first, once, in the main process; what it makes lies in `setting.out` and is gone on with when it was
        interrupted. Raises SpadError with a sentence where the experiment cannot be done: before anything is written,
        as far as that can be known.
        """
        raise NotImplementedError

    def measure(self, task: Task) -> dict[str, Any]:
        """The numbers of one task, in JSON. Called in a worker; they depend on the task alone, never on the others."""
        raise NotImplementedError

    def tell(self, result: Mapping[str, Any]) -> str:
        """One line about a result."""
        raise NotImplementedError

    def story(self, results: Sequence[Mapping[str, Any]]) -> Story:
        """What the results say, some of which may be missing: called while they come, too. There is one at least."""
        raise NotImplementedError

    def rows(self, results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """The results as rows of a table, in order, all with the same columns."""
        raise NotImplementedError


# --- running one --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """What a run did. results: all that are there, each with its key under `key`; story: what they say."""

    page: Path
    results: list[dict[str, Any]]
    made: int
    kept: int
    seconds: float
    story: Story


def run(experiment: PaperExperiment, setting: Setting) -> Outcome:
    """Do an experiment, or go on with it. Raises SpadError with a sentence where that cannot be done.

    No result depends on the number of jobs, nor on where a run was interrupted.
    """
    started = time.monotonic()
    pages.check_place(setting.out, "experiment")
    with factory.locked(setting.out):
        plan = experiment.prepare(setting)
        common = {"format": FORMAT, "experiment": experiment.name, **plan.common}
        results = _read(setting.out, common, setting.progress)
        tasks = {task.key: task for task in plan.tasks}
        for task in plan.tasks:
            if task.key in results:
                _refuse_other(_place(setting.out, task.key), task.about, results[task.key])
        missing = [key for key in tasks if key not in results]
        left = _Left(sum(tasks[key].work for key in missing))
        drawn = time.monotonic()

        def done(key: str, numbers: dict[str, Any]) -> None:
            nonlocal drawn
            results[key] = {**common, **tasks[key].about, **numbers}
            disk.put_file(_place(setting.out, key), manifest_file.canonical(results[key]))
            there = f"{sum(key in results for key in tasks)} of {len(tasks)}"
            setting.progress.notice(f"{there}: {experiment.tell(results[key])}{left.after(tasks[key].work)}")
            if time.monotonic() - drawn > _PAUSE:
                _write(experiment, results, setting.out)
                drawn = time.monotonic()

        if missing:
            workers = executor(min(setting.jobs, len(missing)))
            workers.run(experiment.measure, lambda keys: (tasks[key] for key in keys), missing, done)
        if not results:
            raise SpadError(f"{experiment.name}: nothing was asked for, so there is nothing to show; ask for more")
        page, story = _write(experiment, results, setting.out)
    kept = len(tasks) - len(missing)
    return Outcome(page, _in_order(results), len(missing), kept, time.monotonic() - started, story)


class _Left:
    """How long it takes still, from how long it took so far. work: of all tasks that are missing."""

    def __init__(self, work: float):
        self._work, self._done, self._started = work, 0.0, time.monotonic()

    def after(self, work: float) -> str:
        """Words for what is left when so much more is done; empty at the end."""
        self._done += work
        seconds = (time.monotonic() - self._started) / self._done * (self._work - self._done)
        if self._done >= self._work * (1 - 1e-9):
            return ""
        return f"; {seconds / 60:.0f} min left" if seconds >= 90 else f"; {seconds:.0f} s left"


def _place(out: Path, key: str) -> Path:
    if not _KEY.fullmatch(key):
        raise ValueError(f"{key!r} is no key of a result")
    return out / RESULTS / f"{key}.json"


def _read(out: Path, common: Mapping[str, Any], progress: Progress) -> dict[str, dict[str, Any]]:
    """The results that are there. Raises SpadError where one is of other data, or of another experiment."""
    found = {}
    for path in sorted((out / RESULTS).glob("*.json")):
        try:
            result = json.loads(disk.read_file(path, _LARGEST))
        except (OSError, ValueError, RecursionError):
            result = None
        if not isinstance(result, dict):
            progress.notice(f"{path} cannot be read, and is measured again.")
            continue
        _refuse_other(path, common, result)
        found[path.stem] = result
    return found


def _refuse_other(path: Path, about: Mapping[str, Any], result: Mapping[str, Any]) -> None:
    for name, value in about.items():
        if result.get(name) != value:
            there, asked = (_short(one) for one in (result.get(name), value))
            raise SpadError(
                f"{path}: is another result ({name}: {there} there, {asked} asked for); choose another folder with "
                "-o, or remove it"
            )


def _short(value: Any) -> str:
    text = "nothing" if value is None else str(value)
    return text if len(text) <= 40 else f"{text[:12]}..."


def _in_order(results: Mapping[str, dict[str, Any]]) -> list[dict[str, Any]]:
    return [{"key": key, **results[key]} for key in sorted(results)]


def _write(experiment: PaperExperiment, results: Mapping[str, dict[str, Any]], out: Path) -> tuple[Path, Story]:
    """The page, its pictures and tables, of the results that are there."""
    listed = _in_order(results)
    story, rows = experiment.story(listed), experiment.rows(listed)
    buffer = io.StringIO()
    table = csv.DictWriter(buffer, list(rows[0]), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    disk.put_file(out / f"{experiment.name}.csv", buffer.getvalue().encode())
    disk.put_file(out / f"{experiment.name}.md", pages.markdown(story).encode())
    return pages.experiment(story, out), story


def answer(story: Story) -> str:
    """A story as text: its answer and its first table."""
    tables = [part for part in story.parts if isinstance(part, Table)]
    return "\n\n".join([story.answer, *(f"{t.title}\n{report.aligned(t.header, t.rows)}" for t in tables[:1])])


# --- the reference ------------------------------------------------------------------------------------------------


def text(name: str | None = None) -> str:
    """The list of all experiments, or the page of one. Raises KeyError with a sentence where there is none."""
    if name is None:
        known = [PaperExperiment.registry.find(each) for each in PaperExperiment.registry]
        return reference.listing(("experiment", "what it asks"), [(cls.name, cls.summary()) for cls in known])
    cls: type[PaperExperiment] = PaperExperiment.registry.find(name)
    lines = [cls.name, "", *reference.docstring(cls)]
    if cls.options:
        rows = [(f"{word(key)} {one.metavar}", one.about) for key, one in cls.options.items()]
        lines += ["", reference.listing(("option", "what it does"), rows)]
    return "\n".join([*lines, "", f"spadmnist experiment {cls.name} -o {cls.name}"])


def as_data(name: str | None = None) -> Any:
    """The same for programs: a list, or one."""
    if name is None:
        return [as_data(each) for each in PaperExperiment.registry]
    cls: type[PaperExperiment] = PaperExperiment.registry.find(name)
    options = {key: {"about": one.about, "default": one.default} for key, one in cls.options.items()}
    return {"name": cls.name, "about": inspect.getdoc(cls), "options": options}


plugins.import_folder(__name__)
