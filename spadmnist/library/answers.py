"""Answers of the library: results that show themselves in a notebook, save their reports and make the next sensor."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from .. import disk, pages, sensor_file
from ..document import path_of
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
    """The answer of `compare`: the goodness of fit of a sensor model to a measurement.

    Attributes:
        sensor, measurement: the names of the model and of the measurement.
        verdict: "adequate" where the model passes all checks, otherwise "fails".
        misfit: mean over statistics and captures of the mean squared standardised residual; 1 for a right model.
        misfit_null_95: 95 % quantile of the misfit of a right model.
        checks: every check, a `Check` each: of every statistic of every capture, of the totals, of the light level.
        nuisances: the fitted light levels, a `Nuisance` each.
        replicates: number of simulations of each capture.
        tolerance: relative deviation up to which a significant check passes; None: none.
        false_alarm_rate: probability that a right model fails any check.
        crop: rows and columns of the measured part of the sensor, as text; None for all pixels.
    """

    origin: Origin = field(default=Origin(), compare=False)

    @property
    def misfit_in_sample(self) -> float:
        """The misfit over the captures that the light levels were fitted to, here all of them."""
        return self.misfit

    def to_frame(self) -> Any:
        """The checks as a table.

        Returns:
            pandas.DataFrame, a row a check: statistic, capture, misfit, p_value, passes, material, where, size.

        Raises:
            InputError: where pandas is not installed.
        """
        return _frame(self.as_data()["checks"])

    def figure(self, i: int | str = 0) -> Figure:
        """A figure of the report.

        Args:
            i: the i-th check with cells, counted from 0, the failing ones first: measured, model, residuals. Or
                "light": the light level of each capture, as a factor on what is stated.

        Returns:
            matplotlib.figure.Figure.

        Raises:
            InputError: where there is no such figure.
        """
        if isinstance(i, str):
            return _by_name(pages.comparison_figures(self), i)
        drawn = [c for c in sorted(self.checks, key=lambda c: (c.passes, c.p_value)) if c.summary is not None]
        return pages.check_figure(_nth(drawn, i, "checks with cells"))

    def save(self, folder: PathLike, *, command: str = "", then: str = "") -> Path:
        """Write the report, one HTML page, into a folder.

        Args:
            command: what made it, for the page. then: the next step, for the page.

        Returns:
            The path of the page.

        Raises:
            SpadError: where something else lies there, or it cannot be written.
        """
        return pages.comparison(self, path_of(folder, "the folder of the report"), self.origin.source(command, then))

    def __repr__(self) -> str:
        return comparison.table(self)

    def _repr_html_(self) -> str:
        fails = {False: "fails", True: ""}
        rows = [
            (c.statistic, c.capture or "all", f"{c.p_value:.2g}", f"{c.misfit:.3g}", fails[c.passes], c.where, c.size)
            for c in sorted(self.checks, key=lambda c: (c.passes, c.p_value))[:_SHOWN]
        ]
        title = f"{self.sensor} against {self.measurement}: {self.verdict}, misfit {self.misfit:.4g}"
        title += f"; worst check: {comparison.headline(self)}"
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
        """The verdict on the model with all steps.

        `"adequate"`: the given model fails no check. `"setup"`: a light level, an exposure or a wavelength that is not
        as stated, or a light leak, explains what fails. `"explained"`: with the steps, no check fails. `"confused"`:
        another explanation is as good. `"partly_explained"`: with the steps, some checks still fail. `"unexplained"`:
        no change explains what fails. A fit is `"adequate"`, `"explained"` or `"partly_explained"`.
        """
        return self.found.verdict

    @property
    def steps(self) -> list[results.Step]:
        """The accepted changes of the model, in order, each a `Step`."""
        return self.found.steps

    @property
    def misfit(self) -> dict[str, float]:
        """The misfit on held-out captures, `before` and `after` the steps.

        It is the mean over statistics and captures of the mean squared standardised residual; 1 for a right model.
        """
        return {"before": self.found.before, "after": self.found.after}

    @property
    def misfit_in_sample(self) -> float | None:
        """The misfit of the model with all steps, fitted to all captures; None where it was not simulated."""
        return None if self.found.in_sample is None else self.found.in_sample.misfit

    @property
    def path(self) -> list[dict[str, Any]]:
        """The ladder of models, the given one first.

        Each row has the name of its `model`, its `misfit` on held-out captures, its relative `errors` by name
        (`mean_rate`, `map`, ...), and whether it is the `placebo`, an effect that was not needed.
        """
        return [dict(row) for row in self.found.ladder]

    @property
    def model(self) -> Sensor:
        """The `Sensor` with the fitted values of all steps that are `in_sensor`; the given one where there are none."""
        return candidates.with_values(self.start, self.found.values)

    def as_data(self) -> dict[str, Any]:
        """The answer as the data of its JSON, format `spadmnist-diagnosis/1` or `spadmnist-fit/1`."""
        return self.found.as_data()

    def to_frame(self) -> Any:
        """The fitted values as a table.

        Returns:
            pandas.DataFrame, a row a value: change, effect, parameter, value, low, high, unit, significance.

        Raises:
            InputError: where pandas is not installed.
        """
        rows = [
            {"change": s.candidate.kind, "effect": s.candidate.effect, "parameter": name, "value": v.value}
            | {"low": v.low, "high": v.high, "unit": v.unit, "significance": s.significance}
            for s in self.steps
            for name, v in s.values.items()
        ]
        return _frame(rows)

    def figure(self, i: int | str = 0) -> Figure:
        """A figure of the report.

        Args:
            i: the i-th check that the given model fails, counted from 0: measured, the model before and after,
                residuals. Or "ladder": the misfit of each model; or the name of a step that is a map, such as
                "detection.pdp per pixel".

        Returns:
            matplotlib.figure.Figure.

        Raises:
            InputError: where there is no such figure.
        """
        if isinstance(i, str):
            return _by_name(pages.diagnosis_figures(self.found), i)
        return pages.trace_figure(_nth(self.found.traces, i, "traces"))

    @property
    def file(self) -> Path | None:
        """The path of the next sensor file; None until it is written."""
        return None if self.found.file is None else Path(self.found.file)

    @property
    def unwritten(self) -> str:
        """Why the next sensor file could not be written; `""` where it could, or was not wanted."""
        return self.found.unwritten

    def save(self, folder: PathLike, *, command: str = "", then: str = "") -> Path:
        """Write the report, the next `sensor.yaml` with its maps and `answer.json` into a folder.

        Args:
            command: what made it, for the page. then: the next step, for the page.

        Returns:
            The path of the folder.

        Raises:
            SpadError: where something else lies there, or it cannot be written. Where the sensor file cannot, the
                report is written all the same, and says why.
        """
        place = path_of(folder, "the folder of the report")
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
            The path of the file; None where it cannot be written.
        """
        out, notes, origin = path_of(file, "the sensor file to write"), results.notes(self.found), self.origin
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
        """Write the answer as JSON.

        Returns:
            The path of the file.

        Raises:
            SpadError: where something else lies there, or it cannot be written.
        """
        place = path_of(file, "the file to write")
        check_answer(place)
        with disk.writing_file(place):
            disk.put_file(place, (results.canonical(self.found) + "\n").encode())
        return place

    def write_report(self, folder: PathLike, *, command: str = "", then: str = "") -> Path:
        """Write the report, one HTML page, into a folder. command, then: as of `save`.

        What a finished diagnosis keeps in that folder to go on from is then removed.

        Returns:
            The path of the page.

        Raises:
            SpadError: where something else lies there, or it cannot be written.
        """
        place = path_of(folder, "the folder of the report")
        page = pages.diagnosis(self.found, place, self.origin.source(command, then, self.found.file))
        kept = self.journal
        if kept is not None and self.found.finished and not self.unwritten and kept.folder.parent == place:
            kept.remove()
            self.journal = None
        return page

    def __repr__(self) -> str:
        return results.table(self.found)

    def _repr_html_(self) -> str:
        rows = [
            (results.title(s.candidate), name, results.shown(v), f"{s.significance:.1f}", f"{s.misfit:.4g}")
            for s in self.steps
            for name, v in (results.told(s) or [("", Value(1.0, None, None))])
        ]
        title = results.opening(self.found, self.verdict.replace("_", " "))
        whole = self.found.in_sample
        if whole is not None:
            title += f" {comparison.words_in_sample(whole)}"
        return html_table(title, ("step", "parameter", "value (95 %)", "sigma", "held-out misfit"), rows)


class Diagnosis(_Found):
    """The answer of `diagnose`: the changes that explain how a measurement deviates from a model, and what is left.

    `diagnose` shows the answer so far to `on_step` as an object of this class as well; `finished` is then False.
    """

    @property
    def finished(self) -> bool:
        """False where the budget of work ended the search: the verdict is then that of what was done."""
        return self.found.finished

    @property
    def not_tried(self) -> list[dict[str, Any]]:
        """The candidates that were not tried: `change`, `effect`, `parameter`, `where` and `why` of each.

        Where the budget ended the search, an entry without an effect says `where` it ended.
        """
        return self.found.untried

    @property
    def alternatives(self) -> list[dict[str, Any]]:
        """The other changes that explain the same residuals, of all steps, with the keys of `Step.alternatives`."""
        return [dict(other) for step in self.steps for other in step.alternatives]

    @property
    def upper_limits(self) -> dict[str, float]:
        """The 95 % upper limits of the effects that were not found, SI, by `effect.parameter`.

        They come with the verdict `"adequate"`, and with `"explained"` of a search that is not quick; otherwise there
        are none.
        """
        return self._limits(False)

    @property
    def lower_limits(self) -> dict[str, float]:
        """The 95 % lower limits of parameters at whose upper end the effect vanishes, SI, by `effect.parameter`.

        They come with the same verdicts as `upper_limits`.
        """
        return self._limits(True)

    def _limits(self, lower: bool) -> dict[str, float]:
        held = [e for e in self.found.excluded if bool(e.get("at_least")) is lower]
        return {f"{e['effect']}.{e['parameter']}": e["upper_limit_95"] for e in held}

    @property
    def advice(self) -> list[dict[str, Any]]:
        """The captures that would separate explanations that are confused.

        Each has the `capture` in words, what it `separates`, and with what significance, in standard deviations, now
        (`significance_now`) and with that capture (`significance_then`).
        """
        return self.found.advice

    @property
    def unexplained(self) -> list[dict[str, Any]]:
        """The checks that fail with all steps, those of one `deviation` together, the clearest first.

        Each has `statistic`, `capture` (None: all captures), `significance` in standard deviations, `where` and `size`
        in words, and the number of its `deviation`. The first may have `alternatives`: the changes that are nearest,
        and explain too little.
        """
        return self.found.unexplained

    @property
    def setup(self) -> list[dict[str, Any]]:
        """The errors of the set-up: light levels, exposures, wavelengths or light leaks that are not as stated.

        Each has the `capture` (None: all captures), the `quantity`, its `factor` on what is stated (`value`, and `low`
        and `high`, the ends of the 95 % confidence interval), and whether it is `confused` with another one.
        """
        return self.found.setup


class Fit(_Found):
    """The answer of `fit`: the fitted values of named parameters, with their 95 % confidence intervals.

    Its `steps` are the named changes. `steps[i].values[name].method` is the method by which a value was fitted.
    """

    @property
    def values(self) -> dict[str, float | np.ndarray]:
        """The fitted values by `effect.parameter`, SI: a number, or (pixels,) of a map."""
        return {f"{effect}.{name}": value for (effect, name), value in self.found.values.items()}

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """The 95 % confidence intervals (low, high) by `effect.parameter`, SI.

        Of a map they are those of the statistics of its pixels, `effect.parameter.sigma`. What has none is not here.
        """
        out = {}
        for step in self.steps:
            for name, value in step.values.items():
                if value.low is not None and value.high is not None:
                    key = f"{step.candidate.parameter}.{name}" if step.candidate.kind == "per_pixel" else name
                    out[f"{step.candidate.effect}.{key}"] = (value.low, value.high)
        return out

    @property
    def covariance(self) -> tuple[list[str], np.ndarray]:
        """The covariance matrix of the fitted numbers: (names `effect.parameter`, (n, n) array in SI).

        It is that of the linearised model; its diagonal is that of the confidence intervals, taken as symmetric. Maps
        are not in it.
        """
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
    if isinstance(i, bool) or not isinstance(i, int | np.integer) or not 0 <= i < len(drawn):
        raise InputError(f"figure {i!r}: there are {len(drawn)} {what}, counted from 0")
    return drawn[i]
