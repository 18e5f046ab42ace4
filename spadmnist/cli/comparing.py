"""Verbs that compare a model with a measurement, diagnose it and fit it."""

from __future__ import annotations

import contextlib
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
    from ..library.answers import Diagnosis, Fit

MAX_STEPS = 12  # steps of a diagnosis; `inference.model_selection` says it, and takes long to import


@cli.verb(120, short_help="Where does a model fail?")
@options.output("REPORT", "Folder of the report, an HTML page with pictures.")
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
    from .. import disk, library, pages, units
    from ..errors import InputError
    from ..inference import comparison, next_step

    options.check_order(sensor, measurement)
    smallest = None
    if tolerance is not None:
        try:
            smallest = float(units.parse(tolerance, ""))
        except ValueError as error:
            raise InputError(f"--tolerance: {error}") from None
        if not 0 < smallest < 1:
            raise InputError(f'--tolerance: {tolerance} is not a share of more than 0 and less than 1, like "0.5 %"')
    if output is not None:
        pages.check_place(output)
        disk.check_writable(output, "-o")
    _check_answer(json_file, output, *_pages(output))
    with terminal.progress() as progress:
        found = library.compare(
            sensor,
            measurement,
            seed,
            tolerance=smallest,
            crop=crop,
            jobs=options.workers_of(jobs, cluster),
            plugins=plugin_files,
            progress=progress,
        )
    again = options.again(measurement, plugin_files, crop)
    what = next_step.after_comparison(found, quoted(sensor), again, _new_folder(sensor))
    with contextlib.ExitStack() as last:  # each is done, the last one first, whatever becomes of the others
        last.callback(lambda: terminal.print_lines(f"{found}\n\nNext: {what}"))
        if output is not None:
            last.callback(lambda: terminal.say(f"Report: {found.save(output, command=_command(), then=what)}"))
        last.callback(lambda: _write_answer(json_file, comparison.canonical(found)))
    if found.verdict != "adequate":
        sys.exit(1)


@cli.verb(130, short_help="Which physical effect does a model lack?")
@options.output(
    "FOLDER", "Folder of the report, an HTML page, of the next sensor.yaml with its maps, and of answer.json."
)
@click.option(
    "--max-steps",
    type=click.IntRange(1, MAX_STEPS),
    default=MAX_STEPS,
    metavar="N",
    help=f"Largest number of steps.  [default: {MAX_STEPS}]",
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

    It tries every registered effect, those of --plugin files included, every listed parameter at another value, and
    every per-pixel parameter as a map. The answer so far is written after each step, so that Ctrl-C keeps it. With -o
    the simulations are kept as well: the same command then goes on from there, to the same answer.

    \b
    spadmnist diagnose sensor.yaml lab/2025-03-01 -o next
    spadmnist diagnose sensor.yaml lab/2025-03-01 --plugin echo.py --json answer.json
    """
    from .. import disk, library
    from ..inference import next_step, results
    from ..library.answers import ANSWER, SENSOR

    options.check_order(sensor, measurement)
    if output is not None:
        disk.check_writable(output, "-o")
    _check_answer(json_file, output, *_pages(output), *([output / SENSOR] if output else []))

    def keep(so_far: Diagnosis) -> None:
        """What is found so far, should the rest be interrupted."""
        if output is not None:
            _write_sensor(so_far, output / SENSOR)
            so_far.write_answer(output / ANSWER)
            so_far.write_report(output, command=_command())
        _write_answer(json_file, results.canonical(so_far.found))

    found = library.diagnose(
        sensor,
        measurement,
        seed,
        quick=quick,
        max_steps=max_steps,
        within=within,
        crop=crop,
        jobs=options.workers_of(jobs, cluster),
        plugins=plugin_files,
        progress=terminal.say,
        keep=output,
        on_step=keep,
    )
    if output is not None:
        _write_sensor(found, output / SENSOR)
    new = None if found.file is None else quoted(found.file)
    same = f"-o {quoted(output or Path(_new_folder(sensor)))}{' --quick' if quick else ''}"
    same += f" --seed {seed}" if seed else ""
    same += f" --max-steps {max_steps}" if max_steps != MAX_STEPS else ""
    again = options.again(measurement, plugin_files, crop)
    what = next_step.after_diagnosis(found.found, quoted(sensor), again, new, same, output is not None)
    with contextlib.ExitStack() as last:  # each is done, the last one first, whatever becomes of the others
        last.callback(lambda: terminal.print_lines(f"{found}\n\nNext: {what}"))
        if output is not None:
            last.callback(lambda: terminal.say(f"Report: {found.write_report(output, command=_command(), then=what)}"))
            last.callback(lambda: found.write_answer(output / ANSWER))
        last.callback(lambda: _write_answer(json_file, results.canonical(found.found)))
    if found.unwritten:
        sys.exit(2)


@cli.verb(140, short_help="Fit parameters of a model.")
@options.output("NEXT.yaml", "Fitted sensor file.", required=True)
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
    from .. import disk, library, sensor_file
    from ..inference import next_step, results

    options.check_order(sensor, measurement)
    sensor_file.check_place(sensor, output)
    disk.check_writable(output, "-o")
    _check_answer(json_file, output)
    found = library.fit(
        sensor,
        measurement,
        added,
        freed,
        mapped,
        seed,
        crop=crop,
        jobs=options.workers_of(jobs, cluster),
        plugins=plugin_files,
        progress=terminal.say,
    )
    _write_sensor(found, output)
    again = options.again(measurement, plugin_files, crop)
    what = next_step.after_diagnosis(
        found.found, quoted(sensor), again, None if found.file is None else quoted(found.file)
    )
    with contextlib.ExitStack() as last:
        last.callback(lambda: terminal.print_lines(f"{found}\n\nNext: {what}"))
        last.callback(lambda: _write_answer(json_file, results.canonical(found.found)))
    if found.unwritten:
        sys.exit(2)


def _new_folder(sensor: Path) -> str:
    """The folder that a command to type names for a new sensor: "next", or another one where the sensor lies there."""
    folder = sensor if sensor.is_dir() else sensor.parent
    return "next-2" if folder.resolve() == Path("next").resolve() else "next"


def _command() -> str:
    """The command, as it was typed."""
    return shlex.join(["spadmnist", *sys.argv[1:]])


def _write_sensor(found: Diagnosis | Fit, out: Path) -> None:
    if found.write_sensor(out) is None:
        terminal.say(f"Error: the next sensor file was not written: {found.unwritten}")


def _pages(folder: Path | None) -> list[Path]:
    """The pages that a folder may hold."""
    from .. import pages

    return [] if folder is None else [folder / name for name in sorted(set(pages.FILES.values()))]


def _check_answer(file: Path | None, *taken: Path | None) -> None:
    """Refuse to put an answer where something else is, or will be (`taken`), before any work is done."""
    from .. import disk
    from ..errors import InputError
    from ..library.answers import check_answer

    if file is None:
        return
    if any(file.resolve() == place.resolve() for place in taken if place is not None):
        raise InputError(f"--json {file}: is the place of -o, too; name a file, for example {file}.json")
    check_answer(file, "--json")
    disk.check_writable(file, "--json")


def _write_answer(file: Path | None, text: str) -> None:
    from .. import disk

    if file is not None:
        with disk.writing_file(file):
            disk.put_file(file, (text + "\n").encode())
