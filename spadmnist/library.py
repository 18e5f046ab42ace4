"""The library: what the verbs do, as functions of Python, and results that show themselves.

    import spadmnist as sp

    sensor = sp.read_sensor("sensor.yaml")
    hidden = sensor.with_effect(sp.effects.Crosstalk(probability=0.01))
    lab = sp.simulate(hidden, "lab", seed=1)
    print(sp.compare(sensor, lab))
    found = sp.diagnose(sensor, lab, quick=True)
    found.model, found.save("next")

Sensors and measurements are objects or paths to their files. SI units throughout.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from . import measurement as measurements
from . import pages, sensor_file, twin
from .config import read_sensor
from .errors import InputError
from .foreign import html_table
from .inference import candidates, comparison, model_selection, named_fit, results
from .inference.budget import seconds_of
from .inference.results import Value
from .measurement import Measurement
from .plugins import check_values, discover, load_file
from .recording import Capture
from .sensor import Sensor
from .system import processors

if TYPE_CHECKING:
    from matplotlib.figure import Figure

T = TypeVar("T")
PathLike = str | Path
Progress = Callable[[str], None]

_SHOWN = 20  # checks in a notebook's table
_DIGITS = 6  # of a fitted number in a sensor file


def simulate(
    sensor: Sensor | PathLike,
    plan: Measurement | PathLike | Sequence[Capture],
    seed: int = 0,
    *,
    plugins: Sequence[PathLike] = (),
) -> Measurement:
    """The captures of a plan as the sensor would have recorded them, in memory.

    Args:
        sensor: a `Sensor`, or the path of a sensor file or config.
        plan: a measurement (its data are not read), its path, or `Capture`s.
        seed: of the draws. A capture draws the same whichever others there are.
        plugins: files with effects of your own; they are run as programs.

    Raises:
        InputError: where the light level of a capture is free, or sensor and plan do not belong together.
    """
    model = _model(sensor, plugins)
    opened = _plan(plan, model)
    made = list(twin.twin(model, opened, seed))
    return measurements.in_memory(opened.name, model.layout, made)


def compare(
    sensor: Sensor | PathLike,
    measurement: Measurement | PathLike,
    seed: int = 0,
    *,
    tolerance: float | None = None,
    jobs: int | None = None,
    plugins: Sequence[PathLike] = (),
    progress: Progress | None = None,
) -> Comparison:
    """The goodness of fit of a model: every statistic of every capture against the model's own scatter.

    Args:
        sensor: the model, a `Sensor` or the path of its file. measurement: a `Measurement` or its path.
        seed: of the model's simulations. jobs: workers at a time; the result does not depend on it.
        tolerance: a failing check whose size is smaller (relative) passes, as not material.
        progress: called with a line about what is being done.

    Raises:
        InputError: where sensor and measurement do not belong together.
    """
    if tolerance is not None and not 0 < tolerance < 1:
        raise InputError(f"tolerance is {tolerance!r}; it is a share of more than 0 and less than 1, 0.005 for 0.5 %")
    model, data = _model(sensor, plugins), _data(measurement)
    said = None if progress is None else lambda what, share: progress(f"{what}: {share:.0%}")
    found = comparison.compare(model, data, seed, tolerance, jobs or processors(), progress=said)
    return Comparison(**vars(found))


def diagnose(
    sensor: Sensor | PathLike,
    measurement: Measurement | PathLike,
    seed: int = 0,
    *,
    quick: bool = False,
    max_steps: int = 12,
    within: str | float | None = None,
    jobs: int | None = None,
    plugins: Sequence[PathLike] = (),
    progress: Progress | None = None,
) -> Diagnosis:
    """What the model lacks: effects, wrong values and maps, added one by one, each with its 95 % interval.

    Args:
        sensor, measurement, seed, jobs, plugins, progress: as of `compare`.
        quick: fewer simulations, a first answer. max_steps: at most so many steps, 1 to 12.
        within: budget of work as time of two idle cores, "3 min" or s; "none": without end; None: 10 min, quick 3 min.

    Raises:
        InputError: where sensor and measurement do not belong together.
    """
    if isinstance(max_steps, bool) or max_steps not in range(1, 13):
        raise InputError(f"max_steps is {max_steps!r}; it is a whole number from 1 to 12")
    model, data = _model(sensor, plugins), _data(measurement)
    seconds = seconds_of(within, quick)
    found = model_selection.diagnose(model, data, seed, max_steps, quick, jobs or processors(), progress, seconds)
    return Diagnosis(found, model, _file(sensor))


def fit(
    sensor: Sensor | PathLike,
    measurement: Measurement | PathLike,
    add: Iterable[str] = (),
    free: Iterable[str] = (),
    per_pixel: Iterable[str] = (),
    seed: int = 0,
    *,
    jobs: int | None = None,
    plugins: Sequence[PathLike] = (),
    progress: Progress | None = None,
) -> Fit:
    """Parameters of the model fitted to a measurement, with 95 % intervals.

    Args:
        add: effects that are added and fitted, `"crosstalk"`. free: numbers that are fitted, `"dead_time.duration"`.
        per_pixel: maps that are fitted, `"dark_counts.rate"`.
        sensor, measurement, seed, jobs, plugins, progress: as of `compare`.

    Raises:
        InputError: for an effect or parameter that there is not, or that cannot be fitted.
    """
    lists = {"add": add, "free": free, "per_pixel": per_pixel}
    for name, given in lists.items():
        if isinstance(given, str):
            raise InputError(f"{name} is {given!r}; it is a list of names: {name}=[{given!r}]")
    model, data = _model(sensor, plugins), _data(measurement)
    found = named_fit.fit_named(
        model, data, tuple(add), tuple(free), tuple(per_pixel), seed, jobs or processors(), progress
    )
    return Fit(found, model, _file(sensor))


# ---- results ----------------------------------------------------------------------------------------------


class Comparison(comparison.Comparison):
    """The result of `compare`. verdict: `"adequate"` or `"fails"`; misfit: the mean squared standardised residual, 1
    for a right model; checks, failing: of every statistic and capture, the clearest first in `failing`.
    """

    @property
    def misfit_in_sample(self) -> float:
        """The misfit over the captures that the light levels were fitted to, here all of them."""
        return self.misfit

    def to_frame(self) -> Any:
        """A pandas DataFrame, a row a check. Raises InputError where pandas is not installed."""
        return _frame(self.as_data()["checks"])

    def figure(self, i: int = 0) -> Figure:
        """The matplotlib figure of the i-th check with cells, the failing ones first: measured, model, residuals."""
        drawn = [c for c in sorted(self.checks, key=lambda c: (c.passes, c.p_value)) if c.summary is not None]
        return pages.check_figure(_nth(drawn, i, "checks with cells"))

    def save(self, folder: PathLike) -> Path:
        """Write the report, one HTML page, into a folder; the page."""
        pages.check_place(Path(folder))
        return pages.comparison(self, Path(folder))

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

    def __init__(self, found: results.Diagnosis, start: Sensor, source: Path | None):
        self.found = found
        self.start = start
        self._source = source

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

    def figure(self, i: int = 0) -> Figure:
        """The matplotlib figure of the i-th trace: measured, the model before and after, residuals."""
        return pages.trace_figure(_nth(self.found.traces, i, "traces"))

    def save(self, folder: PathLike) -> Path:
        """Write the report and the next `sensor.yaml` with its maps into a folder; the folder.

        Of a sensor that was read from a file the next one is that file, its comments kept.
        """
        place = Path(folder)
        pages.check_place(place, "diagnosis")
        out, ours = place / "sensor.yaml", (place / pages.FILES["diagnosis"]).exists()
        notes = results.notes(self.found)
        if self._source is not None:
            sensor_file.check_place(self._source, out, ours)
            made = sensor_file.write(self._source, out, self.found.values, notes, self.start.window)
        else:
            numbers = {key: _rounded(value) for key, value in self.found.values.items()}
            made = sensor_file.save(candidates.with_values(self.start, numbers), out, notes, ours)
        self.found.file = str(made)
        files = {} if self._source is None else {f"the sensor, {self._source.name}": self._source}
        pages.diagnosis(self.found, place, pages.source_of("", None, files | {"the next sensor, sensor.yaml": made}))
        return place

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
        """False where the budget of work ended the search: the verdict is then that of the steps so far."""
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
        return {f"{e['effect']}.{e['parameter']}": e["upper_limit_95"] for e in self.found.excluded}

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


def _nth(drawn: Sequence[T], i: int, what: str) -> T:
    if isinstance(i, bool) or not isinstance(i, int) or not 0 <= i < len(drawn):
        raise InputError(f"figure {i!r}: there are {len(drawn)} {what}, counted from 0")
    return drawn[i]


# ---- sensors and measurements, or their paths --------------------------------------------------------------


def _model(sensor: Sensor | PathLike, files: Sequence[PathLike]) -> Sensor:
    for file in files:
        load_file(file)
    discover()
    if isinstance(sensor, Sensor):
        for effect in sensor.effects:
            check_values(effect)
        return sensor.resolved()
    return read_sensor(sensor)


def _file(sensor: Sensor | PathLike) -> Path | None:
    return None if isinstance(sensor, Sensor) else Path(sensor)


def _data(measurement: Measurement | PathLike) -> Measurement:
    return measurement if isinstance(measurement, Measurement) else measurements.open(measurement)


def _plan(plan: Measurement | PathLike | Sequence[Capture], model: Sensor) -> Measurement:
    if isinstance(plan, Measurement):
        return plan
    if isinstance(plan, str | os.PathLike):
        return measurements.open(plan, planned=True)
    captures = list(plan)
    wrong = [one for one in captures if not isinstance(one, Capture)]
    if wrong or not captures:
        raise InputError(f"plan: {wrong[0]!r} is not a capture" if wrong else "plan: has no captures")
    return measurements.in_memory(model.name or "simulated", model.layout, captures)
