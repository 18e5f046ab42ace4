"""The library: what the verbs do, as functions of Python, and results that show themselves (`answers`).

    import spadmnist as sp

    sensor = sp.read_sensor("sensor.yaml")
    hidden = sensor.with_effect(sp.effects.Crosstalk(probability=0.01))
    lab = sp.simulate(hidden, "lab", seed=1)
    print(sp.compare(sensor, lab))
    found = sp.diagnose(sensor, lab, quick=True)
    found.model, found.save("next")

Sensors and measurements are objects or paths to their files. SI units throughout. What only some of the functions need
is imported by them: `simulate` needs no statistics.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .. import measurement as measurements
from .. import twin, units, window
from ..config import read_sensor
from ..document import path_of
from ..errors import InputError, SpadError
from ..factory import Progress
from ..foreign import quoted
from ..measurement import Measurement
from ..plugins import check_values, discover, load_files
from ..recording import Capture
from ..sensor import Sensor
from ..sensor_file import original
from ..system import processors
from ..workers import Executor

if TYPE_CHECKING:
    from .answers import Comparison, Diagnosis, Fit, Origin

PathLike = str | Path
Crop = str | tuple[slice, slice]
Told = Callable[[str], None] | Progress


def simulate(
    sensor: Sensor | PathLike,
    plan: Measurement | PathLike | Sequence[Capture],
    seed: int = 0,
    *,
    folder: PathLike | None = None,
    crop: Crop | None = None,
    plugins: Sequence[PathLike] | None = (),
    progress: Told | None = None,
) -> Measurement:
    """The captures of a plan as the sensor would have recorded them.

    Args:
        sensor: a `Sensor`, or the path of a sensor file or config.
        plan: a measurement (its data are not read), its path, or `Capture`s.
        seed: of the draws. A capture draws the same whichever others there are.
        folder: where they are written, one after the other; None: they stay in memory.
        crop, plugins, progress: as of `compare`.

    Returns:
        Measurement: the simulated captures; `["flat"]` is the data of one.

    Raises:
        InputError: where the light level of a capture is free, or sensor and plan do not belong together.
        SpadError: where something else lies in the folder, or it cannot be written.
    """
    bar = _bar(progress)
    folder = None if folder is None else path_of(folder, "the folder to write to")
    seed = _seed(seed)
    model = _model(sensor, plugins, crop)
    opened = _plan(plan, model)
    _say_notes(opened, bar.notice)
    if folder is not None:
        return measurements.open(twin.simulate(model, opened, folder, seed, bar))
    made = list(twin.twin(model, opened, seed, bar))
    return measurements.in_memory(opened.name, model.layout, made)


def compare(
    sensor: Sensor | PathLike,
    measurement: Measurement | PathLike,
    seed: int = 0,
    *,
    tolerance: float | None = None,
    crop: Crop | None = None,
    jobs: int | Executor | None = None,
    plugins: Sequence[PathLike] | None = (),
    progress: Told | None = None,
) -> Comparison:
    """The goodness of fit of a model: every statistic of every capture against the model's own scatter.

    Args:
        sensor: the model, a `Sensor` or the path of its file. measurement: a `Measurement` or its path.
        seed: of the model's simulations.
        tolerance: a failing check whose size is smaller (relative) passes, as not material.
        crop: the measured part of the sensor, `"100:150,200:250"` or its slices of rows and columns.
        jobs: workers at a time, or an executor (`spadmnist.cluster.Cluster`); None: one per processor. The result does
            not depend on it.
        plugins: files with effects and statistics of your own; they are run as programs.
        progress: called with a line about what is being done.

    Returns:
        Comparison: verdict, misfit, and every check with its p-value.

    Raises:
        InputError: where sensor and measurement do not belong together.
    """
    from ..inference import comparison
    from .answers import Comparison

    if tolerance is not None:
        number = isinstance(tolerance, int | float | np.number) and not isinstance(tolerance, bool)
        if not (number and 0 < tolerance < 1):
            raise InputError(
                f"tolerance is {tolerance!r}; it is a share of more than 0 and less than 1, 0.005 for 0.5 %"
            )
        tolerance = float(tolerance)
    workers, bar, done = _workers(jobs), _bar(progress), 0.0
    seed = _seed(seed)
    model, data = _model(sensor, plugins, crop), _data(measurement)
    origin = _origin(sensor, data, seed)
    _say_notes(data, bar.notice)

    def told(what: str, share: float) -> None:
        nonlocal done
        bar.advance(max(100 * share - done, 0.0), what)  # what is periodic is simulated once more
        done = max(100 * share, done)

    bar.start("comparing", 100, 0)
    found = comparison.compare(model, data, seed, tolerance, workers, progress=told, say=bar.notice)
    bar.stop()
    return Comparison(**vars(found), origin=origin)


def diagnose(
    sensor: Sensor | PathLike,
    measurement: Measurement | PathLike,
    seed: int = 0,
    *,
    quick: bool = False,
    max_steps: int = 12,
    within: str | float | None = None,
    crop: Crop | None = None,
    jobs: int | Executor | None = None,
    plugins: Sequence[PathLike] | None = (),
    progress: Told | None = None,
    keep: PathLike | None = None,
    on_step: Callable[[Diagnosis], None] | None = None,
) -> Diagnosis:
    """What the model lacks: effects, wrong values and maps, added one by one, each with its 95 % interval.

    Args:
        sensor, measurement, seed, crop, jobs, plugins, progress: as of `compare`.
        quick: fewer simulations, a first answer. max_steps: at most so many steps, 1 to 12.
        within: budget of work as time of two idle cores, "3 min" or s; "none": without end; None: 10 min, quick 3 min.
        keep: a folder that keeps what is simulated until the search is finished. The same call goes on from there to
            the same answer. The diagnosis so far is saved to it after each step, and the answer at the end.
        on_step: called with the diagnosis so far after each step; nothing is then saved to `keep` by itself, and what
            is simulated is kept until the report of the answer is written there.

    Returns:
        Diagnosis: verdict, steps with their fitted values, the sensor with them, what remains unexplained, limits.

    Raises:
        InputError: where sensor and measurement do not belong together.
        SpadError: where something else lies in `keep`.
    """
    from ..inference import model_selection
    from ..inference.budget import seconds_of
    from ..inference.journal import FOLDER, Journal
    from .answers import Diagnosis, check_place

    if not _is_whole(max_steps) or not 1 <= max_steps <= 12:
        raise InputError(f"max_steps is {max_steps!r}; it is a whole number from 1 to 12")
    if not isinstance(quick, bool | np.bool_):
        raise InputError(f"quick is {quick!r}; it is True or False")
    if on_step is not None and not callable(on_step):
        raise InputError(f"on_step is {on_step!r:.80}; it is a function that is called with the diagnosis so far")
    max_steps, quick = int(max_steps), bool(quick)
    keep = None if keep is None else path_of(keep, "the folder to keep it in")
    seconds, workers, say = seconds_of(within, quick), _workers(jobs), _bar(progress).notice
    seed = _seed(seed)
    model, data = _model(sensor, plugins, crop), _data(measurement)
    origin = _origin(sensor, data, seed)
    _say_notes(data, say)
    journal = None
    if keep is not None:
        check_place(keep, origin.sensor)
        journal = Journal(Path(keep) / FOLDER)
        if journal.bytes:
            say(f"Going on: {journal.folder} holds {journal.bytes / 1e6:.0f} MB of an earlier run's replicates")

    def saved(so_far: Diagnosis) -> None:
        """Save the diagnosis so far. An error is reported, and the search goes on."""
        if keep is None:
            return
        try:
            so_far.save(keep)
        except (SpadError, OSError) as error:
            say(f"Error: {error}")

    each = on_step or saved
    found = model_selection.diagnose(
        model,
        data,
        seed,
        max_steps,
        quick,
        workers,
        say,
        seconds,
        lambda so_far: each(Diagnosis(so_far, model, origin)),
        journal,
    )
    answer = Diagnosis(found, model, origin, journal)
    if journal is not None and journal.bytes and not found.finished:
        kept = f"{journal.bytes / 1e6:.0f} MB of replicates"
        say(f"Not finished: {journal.folder} keeps {kept}, from which the next command goes on")
    if on_step is None:
        saved(answer)
    return answer


def fit(
    sensor: Sensor | PathLike,
    measurement: Measurement | PathLike,
    add: Iterable[str] = (),
    free: Iterable[str] = (),
    per_pixel: Iterable[str] = (),
    seed: int = 0,
    *,
    crop: Crop | None = None,
    jobs: int | Executor | None = None,
    plugins: Sequence[PathLike] | None = (),
    progress: Told | None = None,
) -> Fit:
    """Parameters of the model fitted to a measurement, with 95 % intervals.

    Args:
        add: effects that are added and fitted, `"crosstalk"`. free: numbers that are fitted, `"dead_time.duration"`.
        per_pixel: maps that are fitted, `"dark_counts.rate"`.
        sensor, measurement, seed, crop, jobs, plugins, progress: as of `compare`.

    Returns:
        Fit: the fitted values with their intervals and covariance, and the sensor with them.

    Raises:
        InputError: for an effect or parameter that there is not, or that cannot be fitted.
    """
    from ..inference import named_fit
    from .answers import Fit

    lists = _names("add", add), _names("free", free), _names("per_pixel", per_pixel)
    workers, say = _workers(jobs), _bar(progress).notice
    seed = _seed(seed)
    model, data = _model(sensor, plugins, crop), _data(measurement)
    origin = _origin(sensor, data, seed)
    _say_notes(data, say)
    found = named_fit.fit_named(model, data, *lists, seed, workers, say)
    return Fit(found, model, origin)


# ---- what is given to them ----------------------------------------------------------------------------------


def _model(sensor: Sensor | PathLike, files: Sequence[PathLike] | None, crop: Crop | None) -> Sensor:
    load_files(files, "plugins")
    discover()
    if isinstance(sensor, Sensor):
        for effect in sensor.effects:
            check_values(effect)
        if not sensor.layout.pixel_area <= units.LARGEST_PIXEL:  # also where it is not a number
            raise InputError(
                f"the sensor's pixel_area is {sensor.layout.pixel_area!r}; it is in m^2, 25e-12 for 25 um^2, and at "
                f"most {units.show(units.LARGEST_PIXEL, 'm^2')}"
            )
        model = sensor.resolved()
    elif isinstance(sensor, str | os.PathLike):
        model = read_sensor(sensor)
    else:
        raise InputError(f"sensor is of type {type(sensor).__name__}; it is a spadmnist.Sensor or the path of its file")
    if crop is None:
        return model
    ends = window.parse(crop) if isinstance(crop, str) else crop
    if not (isinstance(ends, tuple) and len(ends) == 2 and all(isinstance(part, slice) for part in ends)):
        raise InputError(f'crop is {crop!r}; it is "100:150,200:250" or (slice(100, 150), slice(200, 250))')
    return model.cropped(*ends)


def _say_notes(measurement: Measurement, say: Callable[[str], None]) -> None:
    """Say what is to be known of the captures' descriptions, each thing once."""
    notes: dict[str, list[str]] = {}
    for capture in measurement.captures:
        for note in capture.notes:
            notes.setdefault(note, []).append(capture.id)
    for note, ids in notes.items():
        say(f"Note: {', '.join(map(quoted, ids[:6]))}{', ...' if len(ids) > 6 else ''}: {note}")


def _data(measurement: Measurement | PathLike) -> Measurement:
    if isinstance(measurement, Measurement):
        return measurement
    if isinstance(measurement, str | os.PathLike):
        return measurements.open(measurement)
    raise InputError(
        f"measurement is of type {type(measurement).__name__}; it is a spadmnist.Measurement or its path (of arrays: "
        "Measurement.from_arrays)"
    )


def _names(name: str, given: Iterable[str]) -> tuple[str, ...]:
    """The names in a list. Raises InputError where it is none, or holds anything else."""
    if isinstance(given, str):
        raise InputError(f"{name} is {given!r}; it is a list of names: {name}=[{given!r}]")
    if isinstance(given, Mapping):
        raise InputError(f"{name} is a dictionary; it is a list of names, and their values are fitted: {list(given)!r}")
    names = tuple(given) if isinstance(given, Iterable) else (given,)
    for one in names:
        if not isinstance(one, str):
            raise InputError(f'{name} holds {one!r}; it is a list of names, like "crosstalk" or "dead_time.duration"')
    return names


def _is_whole(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _seed(seed: int) -> int:
    if not _is_whole(seed) or not 0 <= seed < 1 << 63:
        raise InputError(f"seed is {seed!r}; it is a whole number from 0 to 2^63 - 1")
    return int(seed)


def _plan(plan: Measurement | PathLike | Sequence[Capture], model: Sensor) -> Measurement:
    if isinstance(plan, Measurement):
        return plan
    if isinstance(plan, str | os.PathLike):
        return measurements.open(plan, planned=True)
    captures = list(plan) if isinstance(plan, Iterable) else [plan]
    wrong = [one for one in captures if not isinstance(one, Capture)]
    if wrong or not captures:
        raise InputError(f"plan: {wrong[0]!r} is not a capture" if wrong else "plan: has no captures")
    names = [capture.id for capture in captures]
    twice = [id for id in names if names.count(id) > 1]
    if twice:
        raise InputError(f"plan: {twice[0]} is there twice; give each capture a name of its own")
    return measurements.in_memory(model.name or "simulated", model.layout, captures)


def _origin(sensor: Sensor | PathLike, data: Measurement, seed: int) -> Origin:
    from .answers import Origin

    if isinstance(sensor, Sensor):
        return Origin(measurement=data.file, seed=seed)
    path = Path(sensor).absolute()
    if not path.is_file():  # a pipe, which has been read
        return Origin(measurement=data.file, seed=seed)
    return Origin(path, path.read_bytes(), original(path), data.file, seed)


def _workers(jobs: int | Executor | None) -> int | Executor:
    if jobs is None:
        return processors()
    if isinstance(jobs, Executor):
        return jobs
    if not _is_whole(jobs) or jobs < 1:
        raise InputError(f"jobs is {jobs!r}; it is a whole number of at least 1, or None for one worker per processor")
    return int(jobs)


def _bar(told: Told | None) -> Progress:
    """A bar of what is called with lines: with one for each per cent more of the work."""
    if told is None or isinstance(told, Progress):
        return told or Progress()
    if not callable(told):
        raise InputError(f"progress is {told!r}; it is a function that is called with a line, for example print")
    whole, done, last = 1.0, 0.0, ""

    def start(what: str, total: float, begun: float) -> None:
        nonlocal whole, done
        whole, done = total or 1.0, begun

    def advance(work: float, note: str) -> None:
        nonlocal done, last
        done += work
        line = f"{note}: {100 * min(done / whole, 1):.0f} %"
        if line != last:
            told(line)
        last = line

    return Progress(start, advance, notice=told)
