"""Verbs that bring measurements in and out, show them and simulate their twins."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click

from ..foreign import quoted
from . import _options as options
from . import _terminal as terminal
from ._group import Verb, cli


@cli.verb(50, short_help="Show what a dataset or a measurement holds.")
@click.argument("dataset", metavar="DATASET|MEASUREMENT", type=options.Readable())
@click.option(
    "--plot",
    type=options.Place(),
    metavar="FILE.png",
    help="Draw a sheet of images in all readouts and methods, or of maps, rates and intervals of captures.",
)
@options.as_json
def inspect(dataset: Path | str, plot: Path | None, as_json: bool) -> None:
    """Show what DATASET or MEASUREMENT holds. A DATASET is a folder, a zip of it, or its address (https://, s3://).

    Of a dataset, for each light level: detections, empty and saturated pixels, bytes, bits per detection. Of a
    measurement, for each capture: detections, rates, empty, hot and dead pixels, intervals.

    \b
    spadmnist inspect out
    spadmnist inspect out --plot sheet.png
    """
    from .. import dataset as library
    from .. import disk, measurement, pictures, report
    from ..errors import SpadError

    if plot is not None and plot.suffix.lower() != ".png":
        raise SpadError(f"--plot: {plot} is no PNG file; name one that ends in .png")
    if plot is not None and pictures.is_other(plot):
        raise SpadError(f"--plot: {plot} is there and is no PNG picture, and is not written over; name another file")
    root = library.at(dataset)
    if isinstance(root, Path) and measurement.is_measurement(root):
        _inspect_measurement(root, plot, as_json)
        return
    manifest = library.intact_manifest(root)
    if as_json:
        terminal.print_json(
            {
                "levels": report.level_rows(manifest),
                "normalisation": manifest["normalisation"],
                "config": manifest["config"],
            }
        )
    else:
        terminal.print_lines(report.level_table(manifest))
    if plot is not None:
        with disk.writing_file(plot):
            report.sheet(library.stored(root), plot, places=report.places_of(manifest, root))
        terminal.say(f"Drawn: {plot}")


def _inspect_measurement(path: Path, plot: Path | None, as_json: bool) -> None:
    from .. import disk, measurement, report

    opened = measurement.open(path, planned=True)
    looks = report.looks(opened, plot is not None)
    if as_json:
        missing = {"missing": list(opened.missing)} if opened.missing else {}
        terminal.print_json({"measurement": opened.name, "captures": [one.numbers for one in looks], **missing})
    else:
        terminal.print_lines(report.capture_table(opened, looks))
    if opened.missing:
        terminal.say(f"Not recorded yet: {', '.join(opened.missing)}. Next:  spadmnist import FILE -o {quoted(path)}")
    if plot is not None:
        with disk.writing_file(plot):
            report.capture_sheet(opened, looks, plot)
        terminal.say(f"Drawn: {plot}")


@cli.verb(60, short_help="Simulate the captures of a measurement with a model.")
@click.argument("sensor", type=click.Path(path_type=Path))
@click.argument("measurement", type=click.Path(path_type=Path))
@options.output("OUT", "Folder of the simulated measurement.", required=True)
@options.seed("Seed of the simulation.  [default: 0]")
@options.crop
@options.plugin
@options.as_json
def simulate(
    sensor: Path,
    measurement: Path,
    output: Path,
    seed: int,
    crop: str | None,
    plugin_files: tuple[Path, ...],
    as_json: bool,
) -> None:
    """Simulate the captures of MEASUREMENT as SENSOR (a sensor file, or a config) would have recorded them.

    \b
    spadmnist simulate sensor.yaml lab -o twin
    spadmnist inspect twin --plot twin.png
    """
    from .. import library

    options.check_order(sensor, measurement)
    with terminal.progress() as progress:
        made = library.simulate(
            sensor, measurement, seed, folder=output, crop=crop, plugins=plugin_files, progress=progress
        )
    if as_json:
        terminal.print_json({"measurement": str(output), "captures": list(made)})
    else:
        terminal.say(f"Simulated {len(made)} captures: {output}")
        terminal.say(f"Look at them:  spadmnist inspect {quoted(output)} --plot {quoted(f'{output.name}.png')}")


class _ImportCommand(Verb):
    """Its options are those of `import_options.Said`, made of that table when they are asked for."""

    def get_params(self, context: click.Context) -> list[click.Parameter]:
        from .. import import_options

        if all(param.name != "modality" for param in self.params):
            declared = import_options.options().items()
            self.params[-1:-1] = [_import_option(name, one, import_options.about(one)) for name, one in declared]
        return super().get_params(context)


def _import_option(name: str, declared: Any, about: str) -> click.Option:
    words = [f"--{word.replace('_', '-')}" for word in (name, *declared.names)]
    if declared.flag:
        return click.Option([*words, name], is_flag=True, help=about)
    kind: Any = click.STRING
    if declared.whole is not None:
        kind = click.IntRange(*declared.whole)
    elif declared.choices:
        kind = click.Choice(declared.choices)
    elif declared.path:
        kind = click.Path(path_type=Path)
    metavar = declared.metavar or ("N" if declared.whole else "TIME" if declared.unit == "s" else None)
    return click.Option([*words, name], type=kind, default=None, metavar=metavar, help=about)


@cli.verb(80, "import", cls=_ImportCommand, short_help="Make a measurement from files of other programs.")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="FILE...")
@options.output("MEASUREMENT", "Folder of the measurement or plan.")
@click.option("--name", metavar="NAME", help="Name of the measurement.  [default: that of the file or folder]")
@click.option(
    "--light",
    "lights",
    multiple=True,
    metavar="LIGHT",
    help=(
        'Light on the sensor: dark, free (unknown), "500 nm 75.67 nW/cm^2", or a scene, '
        '"image:chart.npy 80 mlux". Once for all files, or once for each.'
    ),
)
@click.option("--capture", "ids", multiple=True, metavar="ID", help="Plan: the capture of a file, once for each file.")
@options.as_json
def import_(
    files: tuple[Path, ...],
    output: Path | None,
    name: str | None,
    lights: tuple[str, ...],
    ids: tuple[str, ...],
    as_json: bool,
    **given: Any,
) -> None:
    """Make a measurement from FILES. Each file is a capture with the name of the file.

    The format is recognised by the content: PicoQuant PTU (T2), Photon-HDF5, plain HDF5 (time and pixel, or frames),
    NumPy .npy and .npz, TIFF, MATLAB 7.3; or by the name: LinoSPAD2 .dat, raw frames .bin (bits; counts with --bits),
    CSV of pixel and time. What a file does not contain is an option. Times have a unit: --exposure "100 ms".

    MEASUREMENT may be a plan: a measurement.yaml whose captures have no files yet. FILES become its captures, by name,
    by --capture, or in order. Light, clock and pixels are those of the plan. A contradiction is an error.

    \b
    spadmnist import t2.ptu -o lab --light free
    spadmnist import dark.npy flat.npy -o lab --frame-time "10 us" --frame-period "10 us" \\
        --light dark --light "500 nm 75.67 nW/cm^2"
    """
    from ..errors import SpadError
    from ..importers import Said, light
    from ..importers.captures import import_files

    if output is None:
        raise SpadError("--output: name the folder of the measurement that is made, for example -o lab")
    said = Said.of(**given)
    shone = [light(text, said.relative_uncertainty) for text in lights]
    with terminal.progress() as progress:
        made = import_files(files, output, said, shone, name, progress, ids)
    if as_json:
        captures = [one.as_data() for one in made.took]
        told = {"measurement": str(made.folder), "captures": captures, "notes": made.notes, "missing": made.missing}
        terminal.print_json(told)
    else:
        for one in made.took:
            terminal.print_lines(one.text())
    for note in made.notes:
        terminal.say(f"Note: {note}.")
    if made.missing:
        terminal.say(f"Still missing: {', '.join(made.missing)}. Next:  spadmnist import FILE -o {quoted(made.folder)}")
    elif not as_json:
        terminal.say(f"Made: {made.folder}. Look at it:  spadmnist inspect {quoted(made.folder)}")


@cli.verb(90, short_help="Write images or captures to files that other programs read.")
@click.argument("dataset", metavar="DATASET|MEASUREMENT", type=click.Path(path_type=Path))
@options.output("OUT", "Folder; or the file of one capture; or, with .npz, the file of one level and split.")
@click.option(
    "--format",
    "format_",
    type=click.Choice(["photon-hdf5", "hdf5", "npz", "npy", "png", "parquet", "webdataset"]),
    help="Captures: photon-hdf5 (stamps), npy (frames), hdf5, npz. Images: npz, png (fluxes), parquet, webdataset.",
)
@click.option("--capture", "ids", multiple=True, metavar="ID", help="Only this capture. Repeatable.")
@click.option("--lux", "levels", multiple=True, metavar="LEVEL", help="Images: only this light level. Repeatable.")
@click.option("--split", "splits", multiple=True, metavar="SPLIT", help="Images: only this split. Repeatable.")
@click.option("--limit", type=click.IntRange(1), metavar="N", help="Images: the first N of each level and split.")
@click.option("--method", "methods", multiple=True, metavar="METHOD", help="Images: only this flux. Repeatable.")
@click.option(
    "--readout",
    "readouts",
    multiple=True,
    type=click.Choice(["tr", "str", "qis", "counts"]),
    help="Dataset: only this readout. Repeatable for images.",
)
@options.plugin
@options.as_json
def export(
    dataset: Path,
    output: Path | None,
    format_: str | None,
    ids: tuple[str, ...],
    levels: tuple[str, ...],
    splits: tuple[str, ...],
    limit: int | None,
    methods: tuple[str, ...],
    readouts: tuple[str, ...],
    plugin_files: tuple[Path, ...],
    as_json: bool,
) -> None:
    """Write the captures of MEASUREMENT (or of a dataset of uniform images), or the images of DATASET, to OUT.

    The file of a capture contains its light and clock, so that `import` restores it; .npy does not. Images are written
    to OUT/<level>/<split>/, a row an image; parquet adds a card and croissant.json.

    \b
    spadmnist export lab -o dark.hdf5 --format photon-hdf5 --capture dark
    spadmnist export out -o rows --format parquet --lux "2560 mlux"
    """
    from .. import exporters, image_exporters
    from .. import measurement as library
    from ..errors import SpadError

    if output is None or format_ is None:
        raise SpadError("--output: name a file or folder and its format, for example -o lab.npz --format npz")
    options.load_plugins(plugin_files)
    choice = image_exporters.Choice(levels, splits, limit, methods, readouts)
    image_exporters.check_source(dataset)
    if image_exporters.is_of_images(dataset, format_, choice):
        if ids:
            raise SpadError(f"--capture: belongs to a measurement, and these are images of {dataset}: leave it out")
        if format_ == "png" and readouts:
            raise SpadError("--readout: png holds flux images alone; leave it out, or take npz, parquet or webdataset")
        with terminal.progress() as progress:
            paths = image_exporters.export(dataset, output, format_, choice, progress)
        kind: Any = image_exporters.ImageTarget.every[format_]
        without_causes = kind.of_fluxes
    else:
        _check_captures(dataset, format_, choice)
        opened = library.open(dataset, readouts[0] if readouts else None)
        with terminal.progress() as progress:
            paths = exporters.export(opened, output, format_, ids, progress)
        kind = exporters.Target.every[format_]
        without_causes = True
        if opened.layout.positions is not None:
            terminal.say(
                "Note: these files do not hold where the pixels lie; to import them again, give --positions FILE.csv."
            )
        if any(capture.light.scene for capture in opened.captures if not ids or capture.id in ids):
            terminal.say(
                "Note: these files do not hold the scene that was seen; to import them again, give --light "
                "image:FILE.npy."
            )
    if without_causes and image_exporters.has_causes(dataset):
        terminal.say(
            "Note: these files do not hold what made each detection (--causes of generate); take the images as npz, "
            "parquet or webdataset."
        )
    if as_json:
        terminal.print_json({"files": [str(path) for path in paths]})
        return
    for line in _by_folder(paths, output):
        terminal.print_line(line)
    terminal.say(f"Made: {output}. In Python:  {kind.opened_by}")


_LISTED = 20  # files that are named one by one; of more, a line for each level and split


def _by_folder(paths: Sequence[Path], out: Path) -> Iterator[str]:
    """The lines that name files; of many, the level and split, and how many lie there."""
    if len(paths) <= _LISTED:
        yield from map(str, paths)
        return
    for parts, number in Counter(path.relative_to(out).parts[:2] for path in paths).items():
        yield f"{out.joinpath(*parts)}: {number:,} files" if number > 1 else str(out.joinpath(*parts))


def _check_captures(source: Path, format_: str, choice: Any) -> None:
    """Refuse what only images of a dataset have."""
    from .. import image_exporters
    from ..errors import SpadError
    from ..exporters import Target
    from ..measurement import is_measurement

    if format_ not in Target.every:
        others = ", ".join(Target.every)
        raise SpadError(f"--format {format_}: holds images of a dataset, and {source} is none; take one of {others}")
    if choice.readouts and is_measurement(source):
        raise SpadError(
            f"--readout: chooses one of a dataset, and {source} is a measurement; choose captures with --capture"
        )
    if choice.named or len(choice.readouts) > 1:
        raise SpadError(
            f"--lux, --split, --limit, --method and several --readout: choose images of a dataset, and as {format_} "
            f"{source} gives captures; leave them out"
        )
    if image_exporters.is_of_images(source, image_exporters.Npz.name, image_exporters.Choice()):
        images = ", ".join(image_exporters.ImageTarget.every)
        raise SpadError(
            f"--format {format_}: holds captures, and {source} is a dataset of images (only one whose source is "
            f"uniform or a chart is a measurement, too); take one of {images}"
        )
