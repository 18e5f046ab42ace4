"""Answers of the library: results that show themselves in a notebook, save their reports and make the next sensor."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from .. import disk, pages, sensor_file
from ..errors import InputError, SpadError
from ..foreign import html_table
from ..inference import candidates, comparison, results
from ..inference.results import Value
from ..sensor import Sensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..inference.journal import Journal

T = TypeVar("T")
PathLike = str | Path

SENSOR = "sensor.yaml"  # the next sensor file, in the folder of a diagnosis
ANSWER = "answer.json"  # the answer, in the same folder
_HEAD = 200  # bytes in which an answer says its format
_SHOWN = 20  # checks in a notebook's table
_DIGITS = 6  # of a fitted number in a sensor file


@dataclass(frozen=True)
class Origin:
    """Where an answer comes from.

    Attributes:
        sensor: the sensor file or config that was read; None where the model was an object.
        text: its bytes.
        described: the file that describes the sensor: `sensor`, or the one that it names.
        measurement: the `measurement.yaml` that was read; None where the data were an object.
        seed: of the simulations.
        maps: the map files that this answer has written for its sensor files.
    """

    sensor: Path | None = None
    text: bytes = b""
    described: sensor_file.Original | None = None
    measurement: Path | None = None
    seed: int = 0
    maps: set[Path] = field(default_factory=set, compare=False)

    def source(self, command: str = "", then: str = "", following: str | None = None) -> pages.Source:
        """What a report says of how it was made.

        Args:
            command: as it was typed. then: the next step, in words. following: the next sensor file.
        """
        named = {
            "measurement.yaml": self.measurement,
            "the next sensor": None if following is None else Path(following),
        }
        files: dict[str, Path | bytes] = {}
        if self.sensor is not None:
            files[f"the sensor, {self.sensor.name}"] = self.text
        for what, path in named.items():
            if path is not None:
                files[what if what == path.name else f"{what}, {path.name}"] = path
        return pages.source_of(command, self.seed, files, then)


def check_place(folder: PathLike, sensor: Path | None) -> None:
    """Raise SpadError where the report or the next sensor file of a diagnosis would take the place of something else.

    Args:
        sensor: the sensor file that was read, if any.
    """
    place = Path(folder)
    pages.check_place(place, "diagnosis")
    sensor_file.check_place(Path(os.devnull) if sensor is None else sensor, place / SENSOR)
    check_answer(place / ANSWER)


def check_answer(file: PathLike, name: str = "") -> None:
    """Raise InputError where an answer as JSON would take the place of something else.

    Args:
        name: of the option, for the message.
    """
    place, named = Path(file), f"{name} {file}".strip()
    if not place.exists() and not place.is_symlink():
        return
    if place.is_dir():
        raise InputError(f"{named}: is a folder; name a file, for example {place / ANSWER}")
    if not place.is_file() or place.is_symlink():
        raise InputError(f"{named}: is a link, a pipe or a device, and is left alone; name a file")
    with open(place, "rb") as there:
        head = there.read(_HEAD)
    if head and b'"format": "spadmnist-' not in head:
        raise InputError(f"{named}: exists, and is no answer of this program; it is left alone: name another file")


@dataclass(frozen=True, repr=False)
class Comparison(comparison.Comparison):
    """The result of `compare`. verdict: `"adequate"` or `"fails"`; misfit: the mean squared standardised residual, 1
    for a right model; checks, failing: of every statistic and capture, the clearest first in `failing`.
    """

    origin: Origin = field(default=Origin(), compare=False)

    @property
    def misfit_in_sample(self) -> float:
        """The misfit over the captures that the light levels were fitted to, here all of them."""
        return self.misfit

    def to_frame(self) -> Any:
        """A pandas DataFrame, a row a check. Raises InputError where pandas is not installed."""
        return _frame(self.as_data()["checks"])

    def figure(self, i: int | str = 0) -> Figure:
        """A matplotlib figure of the page.

        Args:
            i: the i-th check with cells, the failing ones first: measured, model, residuals. Or "light": the light
                level of each capture, as a factor on what is stated.

        Raises:
            InputError: where there is no such figure.
        """
        if isinstance(i, str):
            return _by_name(pages.comparison_figures(self), i)
        drawn = [c for c in sorted(self.checks, key=lambda c: (c.passes, c.p_value)) if c.summary is not None]
        return pages.check_figure(_nth(drawn, i, "checks with cells"))

    def save(self, folder: PathLike, *, command: str = "", then: str = "") -> Path:
        """Write the report, one HTML page, into a folder; the page.

        Args:
            command: what made it, for the page. then: the next step, for the page.

        Raises:
            SpadError: where something else lies there, or it cannot be written.
        """
        return pages.comparison(self, Path(folder), self.origin.source(command, then))

    def __repr__(self) -> str:
        return comparison.table(self)

    def _repr_html_(self) -> str:
        fails = {False: "fails", True: ""}
        rows = [
            (c.statistic, c.capture or "all", f"{c.p_value:.2g}", f"{c.misfit:.3g}", fails[c.passes], c.where, c.size)
            for c in sorted(self.checks, key=lambda c: (c.passes, c.p_value))[:_SHOWN]
        ]
        title = f"{self.sensor} against {self.measurement}: {self.verdict}, misfit {self.misfit:.4g}"
        return html_table(title, ("statistic", "capture", "p", "misfit", "", "where", "size"), rows)


class _Found:
    """What `diagnose` and `fit` share: steps and the model that they make."""

    def __init__(
        self, found: results.Diagnosis, start: Sensor, origin: Origin | None = None, journal: Journal | None = None
    ):
        self.found = found
        self.start = start
        self.origin = origin or Origin()
        self.journal = journal

    @property
    def verdict(self) -> str:
        """`"adequate"`, `"setup"`, `"explained"`, `"confused"`, `"partly_explained"` or `"unexplained"`."""
        return self.found.verdict

    @property
    def steps(self) -> list[results.Step]:
        """The accepted changes, in order: `change`, `values`, `misfit`, `significance`, `alternatives`."""
        return self.found.steps

    @property
    def misfit(self) -> dict[str, float]:
        """Held out: `before` and `after` the steps."""
        return {"before": self.found.before, "after": self.found.after}

    @property
    def misfit_in_sample(self) -> float | None:
        """The misfit of the model with all steps over all captures; None where it was not simulated."""
        return None if self.found.in_sample is None else self.found.in_sample.misfit

    @property
    def path(self) -> list[dict[str, Any]]:
        """The ladder of models: `model`, `misfit`, `errors` of each, the first one the model that was given."""
        return [dict(row) for row in self.found.ladder]

    @property
    def model(self) -> Sensor:
        """The sensor with what was found; the one that was given where nothing was."""
        return candidates.with_values(self.start, self.found.values)

    def as_data(self) -> dict[str, Any]:
        """The answer as JSON has it."""
        return self.found.as_data()

    def to_frame(self) -> Any:
        """A pandas DataFrame, a row a fitted value. Raises InputError where pandas is not installed."""
        rows = [
            {"change": s.candidate.kind, "effect": s.candidate.effect, "parameter": name, "value": v.value}
            | {"low": v.low, "high": v.high, "unit": v.unit, "significance": s.significance}
            for s in self.steps
            for name, v in s.values.items()
        ]
        return _frame(rows)

    def figure(self, i: int | str = 0) -> Figure:
        """A matplotlib figure of the page.

        Args:
            i: the i-th trace: measured, the model before and after, residuals. Or "ladder": the misfit of each model;
                or the name of a step that is a map, "detection.pdp per pixel".

        Raises:
            InputError: where there is no such figure.
        """
        if isinstance(i, str):
            return _by_name(pages.diagnosis_figures(self.found), i)
        return pages.trace_figure(_nth(self.found.traces, i, "traces"))

    @property
    def file(self) -> Path | None:
        """The next sensor file, once it is written."""
        return None if self.found.file is None else Path(self.found.file)

    @property
    def unwritten(self) -> str:
        """Why the next sensor file could not be written; `""` where it could, or was not wanted."""
        return self.found.unwritten

    def save(self, folder: PathLike, *, command: str = "", then: str = "") -> Path:
        """Write the report, the next `sensor.yaml` with its maps and `answer.json` into a folder; the folder.

        Args:
            command: what made it, for the page. then: the next step, for the page.

        Raises:
            SpadError: where something else lies there, or it cannot be written. Where the sensor file cannot, the
                report is written all the same, and says why.
        """
        place = Path(folder)
        check_place(place, self.origin.sensor)
        self.write_sensor(place / SENSOR)
        self.write_answer(place / ANSWER)
        self.write_report(place, command=command, then=then)
        if self.unwritten:
            raise SpadError(f"the next sensor file was not written: {self.unwritten}")
        return place

    def write_sensor(self, file: PathLike) -> Path | None:
        """Write the next sensor file, and its maps into the same folder.

        A sensor that was read from a file keeps the comments of that file. Where nothing can be written, `unwritten`
        says why, and the answer is kept.

        Returns:
            The file; None where it cannot be written.
        """
        out, notes, origin = Path(file), results.notes(self.found), self.origin
        self.found.file, self.found.unwritten = None, ""
        try:
            with disk.writing_file(out):
                sensor_file.check_place(origin.sensor or Path(os.devnull), out)
                values, start = self.found.values, self.start
                if origin.described is not None:
                    made = sensor_file.write(origin.described, out, values, notes, start.window, origin.maps)
                else:
                    numbers = {key: _rounded(value) for key, value in values.items()}
                    made = sensor_file.save(candidates.with_values(start, numbers), out, notes, origin.maps)
        except Exception as error:
            if os.environ.get("SPADMNIST_DEBUG"):
                raise
            self.found.unwritten = " ".join(str(error).split()) or type(error).__name__
            return None
        self.found.file = str(made)
        return made

    def write_answer(self, file: PathLike) -> Path:
        """Write the answer as JSON; the file.

        Raises:
            SpadError: where something else lies there, or it cannot be written.
        """
        check_answer(file)
        with disk.writing_file(Path(file)):
            disk.put_file(Path(file), (results.canonical(self.found) + "\n").encode())
        return Path(file)

    def write_report(self, folder: PathLike, *, command: str = "", then: str = "") -> Path:
        """Write the report, one HTML page, into a folder; the page. command, then: as of `save`.

        What a finished diagnosis keeps in that folder to go on from is then removed.

        Raises:
            SpadError: where something else lies there, or it cannot be written.
        """
        page = pages.diagnosis(self.found, Path(folder), self.origin.source(command, then, self.found.file))
        kept = self.journal
        if kept is not None and self.found.finished and not self.unwritten and kept.folder.parent == Path(folder):
            kept.remove()
            self.journal = None
        return page

    def __repr__(self) -> str:
        return results.table(self.found)

    def _repr_html_(self) -> str:
        rows = [
            (results.title(s.candidate), name, results.shown(v), f"{s.significance:.1f}", f"{s.misfit:.4g}")
            for s in self.steps
            for name, v in (s.values.items() or [("", Value(1.0, None, None))])
        ]
        title = f"{self.verdict.replace('_', ' ')}: {results.sentence(self.found)}"
        return html_table(title, ("step", "parameter", "value (95 %)", "sigma", "misfit"), rows)


class Diagnosis(_Found):
    """The result of `diagnose`."""

    @property
    def finished(self) -> bool:
        """False where the budget of work ended the search: the verdict is then that of what was done."""
        return self.found.finished

    @property
    def not_tried(self) -> list[dict[str, Any]]:
        """The candidates that could not be simulated, with why."""
        return self.found.untried

    @property
    def alternatives(self) -> list[dict[str, Any]]:
        """What looks alike, of all steps."""
        return [dict(other) for step in self.steps for other in step.alternatives]

    @property
    def upper_limits(self) -> dict[str, float]:
        """`effect.parameter` -> 95 % upper limit (SI) of effects that would have been seen."""
        return self._limits(False)

    @property
    def lower_limits(self) -> dict[str, float]:
        """`effect.parameter` -> 95 % lower limit (SI) of what would have been seen, were it less: of a share of 1."""
        return self._limits(True)

    def _limits(self, lower: bool) -> dict[str, float]:
        held = [e for e in self.found.excluded if bool(e.get("at_least")) is lower]
        return {f"{e['effect']}.{e['parameter']}": e["upper_limit_95"] for e in held}

    @property
    def advice(self) -> list[dict[str, Any]]:
        """The captures that would tell apart what is confused."""
        return self.found.advice

    @property
    def unexplained(self) -> list[dict[str, Any]]:
        """The checks that still fail: statistic, capture, significance, where."""
        return self.found.unexplained

    @property
    def setup(self) -> list[dict[str, Any]]:
        """What is wrong in the set-up: capture, quantity, factor."""
        return self.found.setup


class Fit(_Found):
    """The result of `fit`."""

    @property
    def values(self) -> dict[str, float | np.ndarray]:
        """`effect.parameter` -> fitted value, SI; of a map (pixels,)."""
        return {f"{effect}.{name}": value for (effect, name), value in self.found.values.items()}

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """`effect.parameter` -> 95 % interval, SI; of a map the statistics of its spread, `effect.parameter.sigma`."""
        out = {}
        for step in self.steps:
            for name, value in step.values.items():
                if value.low is not None and value.high is not None:
                    key = f"{step.candidate.parameter}.{name}" if step.candidate.kind == "per_pixel" else name
                    out[f"{step.candidate.effect}.{key}"] = (value.low, value.high)
        return out

    @property
    def covariance(self) -> tuple[list[str], np.ndarray]:
        """(names, (n, n) covariance of the numbers in SI, linearised); of a fit by maps alone it is empty."""
        return self.found.covariance


def _frame(rows: Sequence[Mapping[str, Any]]) -> Any:
    try:
        import pandas  # type: ignore[import-untyped]
    except ImportError:
        raise InputError("a DataFrame needs pandas, which is not installed: pip install pandas") from None
    return pandas.DataFrame(list(rows))


def _rounded(value: Any) -> Any:
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value


def _by_name(drawn: Mapping[str, Callable[[], Figure]], name: str) -> Figure:
    if name not in drawn:
        known = f"there are {', '.join(drawn)}" if drawn else "there are none with a name"
        raise InputError(f"figure {name!r}: is none of this answer; {known}, or a number from 0")
    return drawn[name]()


def _nth(drawn: Sequence[T], i: int, what: str) -> T:
    if not drawn:
        raise InputError(f"figure {i!r}: there are no {what} to draw")
    if isinstance(i, bool) or not isinstance(i, int) or not 0 <= i < len(drawn):
        raise InputError(f"figure {i!r}: there are {len(drawn)} {what}, counted from 0")
    return drawn[i]
