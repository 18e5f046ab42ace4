"""Verbs that compare a model with a measurement, diagnose it and fit it."""

from __future__ import annotations

import contextlib
import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..foreign import quoted
from . import _options as options
from . import _terminal as terminal
from ._group import cli

if TYPE_CHECKING:
    from ..inference.results import Diagnosis
    from ..pages import Source
    from ..sensor import Sensor


@cli.verb(120, short_help="Where does a model fail?")
@click.option(
    "--output",
    "-o",
    type=options.Place(),
    metavar="REPORT",
    help="Folder of the report, an HTML page with pictures.",
)
@click.option(
    "--tolerance",
    metavar="X",
    help='Largest deviation that passes, as a share of the detections or of the rate: "0.5 %".',
)
@options.model_and_measurement
def compare(
    sensor: Path,
    measurement: Path,
    json_file: Path | None,
    output: Path | None,
    tolerance: str | None,
    seed: int,
    jobs: int | None,
    cluster: str | None,
    crop: str | None,
    plugin_files: tuple[Path, ...],
) -> None:
    """Compare the model SENSOR with MEASUREMENT: where does it fail, and by how much?

    Every capture is simulated many times. A check fails where the data lie outside the scatter of the simulations. A
    right model fails in one of a hundred comparisons. Exit status: 0 the model is adequate, 1 it fails.

    \b
    spadmnist compare sensor.yaml lab/2025-03-01 -o report
    spadmnist compare sensor.yaml lab/2025-03-01 --tolerance "0.5 %" --json answer.json
    """
    from .. import measurement as measurements
    from .. import units
    from ..errors import InputError
    from ..inference import comparison, next_step

    options.load_plugins(plugin_files)
    smallest = None
    if tolerance is not None:
        try:
            smallest = float(units.parse(tolerance, ""))
        except ValueError as error:
            raise InputError(f"--tolerance: {error}") from None
        if not 0 < smallest < 1:
            raise InputError(f'--tolerance: {tolerance} is not a share of more than 0 and less than 1, like "0.5 %"')
    model, data = options.model_of(sensor, crop), measurements.open(measurement)
    if output is not None:
        from .. import pages

        pages.check_place(output)
    _check_answer(json_file)
    workers = options.workers_of(jobs, cluster)
    with terminal.progress() as progress:
        progress.start("comparing", 100, 0)
        done = [0.0]

        def told(what: str, share: float) -> None:
            progress.advance(max(100 * share - done[0], 0), what)  # what is periodic is simulated once more
            done[0] = max(100 * share, done[0])

        found = comparison.compare(model, data, seed, smallest, workers, progress=told, say=progress.notice)
        progress.stop()
    _write_answer(json_file, comparison.canonical(found))
    what = next_step.after_comparison(found, quoted(sensor), options.again(measurement, plugin_files))
    if output is not None:
        page = pages.comparison(found, output, _source(sensor, measurement, seed, then=what))
        terminal.say(f"Report: {page}")
    terminal.print_lines(f"{comparison.table(found)}\n\nNext: {what}")
    if found.verdict != "adequate":
        sys.exit(1)


@cli.verb(130, short_help="Which physical effect does a model lack?")
@click.option(
    "--output",
    "-o",
    type=options.Place(),
    metavar="FOLDER",
    help="Folder of the report, an HTML page, and of the next sensor.yaml with its maps.",
)
@click.option(
    "--max-steps", type=click.IntRange(1, 12), default=12, metavar="N", help="Largest number of steps.  [default: 12]"
)
@click.option("--quick", is_flag=True, help="Fewer simulations, for a first answer.")
@click.option(
    "--within",
    metavar="TIME",
    help="Budget, as time on two idle cores: 3 min. none: no limit.  [default: 10 min; with --quick 3 min]",
)
@options.model_and_measurement
def diagnose(
    sensor: Path,
    measurement: Path,
    json_file: Path | None,
    output: Path | None,
    max_steps: int,
    quick: bool,
    within: str | None,
    seed: int,
    jobs: int | None,
    cluster: str | None,
    crop: str | None,
    plugin_files: tuple[Path, ...],
) -> None:
    """Find the effects of MEASUREMENT that the model SENSOR lacks, and add them.

    Tried are every registered effect, those of --plugin files included, every listed parameter at another value, and
    every per-pixel parameter as a map. The answer so far is written after each step, so that Ctrl-C keeps it; with -o
    what was simulated is kept as well, and the same command goes on from there to the same answer.

    \b
    spadmnist diagnose sensor.yaml lab/2025-03-01 -o next
    spadmnist diagnose sensor.yaml lab/2025-03-01 --plugin echo.py --json answer.json
    """
    from .. import measurement as measurements
    from .. import sensor_file
    from ..inference import journal, model_selection, next_step, results
    from ..inference.budget import seconds_of

    seconds = seconds_of(within, quick)
    options.load_plugins(plugin_files)
    model, data = options.model_of(sensor, crop), measurements.open(measurement)
    if output is not None:
        from .. import pages

        pages.check_place(output, "diagnosis")
        sensor_file.check_place(sensor, output / "sensor.yaml", (output / pages.FILES["diagnosis"]).exists())
    _check_answer(json_file)
    workers = options.workers_of(jobs, cluster)
    before = None if output is None else journal.Journal(output / journal.FOLDER)
    if before is not None and before.bytes:
        terminal.say(f"Going on: {before.folder} holds {before.bytes / 1e6:.0f} MB of an earlier run's replicates")

    def keep(so_far: Diagnosis) -> None:
        """What is found so far, should the rest be interrupted."""
        if output is not None:
            _write_next(so_far, sensor, output / "sensor.yaml", model)
            pages.diagnosis(so_far, output, _source(sensor, measurement, seed, so_far.file))
        _write_answer(json_file, results.canonical(so_far))

    found = model_selection.diagnose(model, data, seed, max_steps, quick, workers, terminal.say, seconds, keep, before)
    if before is not None and found.finished:
        before.remove()
    elif before is not None and before.bytes:
        kept = f"{before.bytes / 1e6:.0f} MB of replicates"
        terminal.say(f"Not finished: {before.folder} keeps {kept}, from which the next command goes on")
    if output is not None:
        _write_next(found, sensor, output / "sensor.yaml", model)
    new = quoted(found.file or "next/sensor.yaml")
    same = f"-o {quoted(output or 'next')}{' --quick' if quick else ''}"
    what = next_step.after_diagnosis(found, quoted(sensor), options.again(measurement, plugin_files), new, same)
    with contextlib.ExitStack() as last:  # each is done, the last one first, whatever becomes of the others
        if output is not None:
            source = _source(sensor, measurement, seed, found.file, what)
            last.callback(lambda: terminal.say(f"Report: {pages.diagnosis(found, output, source)}"))
        last.callback(lambda: terminal.print_lines(f"{results.table(found)}\n\nNext: {what}"))
        last.callback(lambda: _write_answer(json_file, results.canonical(found)))
    if found.unwritten:
        sys.exit(2)


@cli.verb(140, short_help="Fit parameters of a model.")
@click.option("--output", "-o", type=options.Place(), metavar="NEXT.yaml", required=True, help="Fitted sensor file.")
@click.option("--add", "added", multiple=True, metavar="EFFECT", help="Add EFFECT and fit its parameters. Repeatable.")
@click.option("--free", "freed", multiple=True, metavar="EFFECT.PARAMETER", help="Fit a listed parameter. Repeatable.")
@click.option(
    "--per-pixel",
    "mapped",
    multiple=True,
    metavar="EFFECT.PARAMETER",
    help="Fit a map. Repeatable.",
)
@options.model_and_measurement
def fit(
    sensor: Path,
    measurement: Path,
    output: Path,
    added: tuple[str, ...],
    freed: tuple[str, ...],
    mapped: tuple[str, ...],
    json_file: Path | None,
    seed: int,
    jobs: int | None,
    cluster: str | None,
    crop: str | None,
    plugin_files: tuple[Path, ...],
) -> None:
    """Fit parameters of the model SENSOR to MEASUREMENT, with 95 % intervals.

    \b
    spadmnist fit sensor.yaml lab/2025-03-01 --add crosstalk -o next.yaml
    spadmnist fit sensor.yaml lab --free dead_time.duration --per-pixel detection.pdp -o next.yaml
    """
    from .. import measurement as measurements
    from .. import sensor_file
    from ..inference import named_fit, next_step, results

    options.load_plugins(plugin_files)
    model, data = options.model_of(sensor, crop), measurements.open(measurement)
    sensor_file.check_place(sensor, output)
    _check_answer(json_file)
    workers = options.workers_of(jobs, cluster)
    found = named_fit.fit_named(model, data, added, freed, mapped, seed, workers, progress=terminal.say)
    _write_next(found, sensor, output, model)
    _write_answer(json_file, results.canonical(found))
    what = next_step.after_diagnosis(
        found, quoted(sensor), options.again(measurement, plugin_files), quoted(found.file or output)
    )
    terminal.print_lines(f"{results.table(found)}\n\nNext: {what}")
    if found.unwritten:
        sys.exit(2)


def _source(sensor: Path, measurement: Path, seed: int, following: str | None = None, then: str = "") -> Source:
    """Where a report comes from: the command, the date, the seed, and the files as text."""
    from .. import pages

    files = {f"the sensor, {sensor.name}": sensor, "measurement.yaml": measurement / "measurement.yaml"}
    if following:
        files[f"the next sensor, {Path(following).name}"] = Path(following)
    return pages.source_of(shlex.join(["spadmnist", *sys.argv[1:]]), seed, files, then)


def _write_next(found: Diagnosis, source: Path, out: Path, model: Sensor) -> None:
    """Write the next sensor file. Where that fails the answer says why, and stays."""
    from .. import sensor_file
    from ..inference import results

    try:
        with options.writing(out):
            found.file = str(sensor_file.write(source, out, found.values, results.notes(found), model.window))
    except Exception as error:  # whatever it is, hours of work are not lost for it
        if os.environ.get("SPADMNIST_DEBUG"):
            raise
        found.unwritten = " ".join(str(error).split()) or type(error).__name__
        terminal.say(f"Error: the next sensor file was not written: {found.unwritten}")


_HEAD = 200  # bytes in which an answer says its format


def _check_answer(file: Path | None) -> None:
    """Refuse to put an answer where something else is, before any work is done."""
    from ..errors import InputError

    if file is None or not file.exists():
        return
    if file.is_dir():
        raise InputError(f"--json {file}: is a folder; name a file, for example {file / 'answer.json'}")
    if file.is_file():
        with open(file, "rb") as there:
            head = there.read(_HEAD)
        if head and b'"format": "spadmnist-' not in head:
            raise InputError(
                f"--json {file}: is there already and no answer of this program; it is left alone: name another file"
            )


def _write_answer(file: Path | None, text: str) -> None:
    from .. import disk

    if file is not None:
        with options.writing(file):
            disk.put_file(file, (text + "\n").encode())
