"""The command line: each verb a few lines over the library. The only module that prints or exits.

What a program reads goes to standard output, everything else to standard error. Exit status: 0 done; 1 the answer is
'no'; 2 it could not be done; 130 interrupted. Imports stand inside the verbs, so that `--help` needs neither numpy
nor numba.
"""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import shlex
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from . import interrupts
from .foreign import quoted, short, visible, visible_lines
from .workers import processors, safe_path

if TYPE_CHECKING:
    from .experiments import PaperExperiment
    from .factory import Progress
    from .inference.results import Diagnosis
    from .pages import Source
    from .sensor import Sensor

F = TypeVar("F", bound=Callable[..., Any])


class _Verbs(click.Group):
    """Verbs in the order of a day's work, not of the alphabet."""

    def list_commands(self, context: click.Context) -> list[str]:
        return list(self.commands)


@click.group(
    cls=_Verbs,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Begin with:  spadmnist generate configs/quick.yaml -o out  and then  spadmnist inspect out --plot out.png",
)
@click.version_option(package_name="spadmnist", message="%(package)s %(version)s")
def cli() -> None:
    """What a single-photon (SPAD) camera would have recorded.

    A config (YAML) names images, light levels, a sensor and its effects; `generate` makes the dataset: time stamps
    (TR), first time stamps of frames (STR), 1-bit frames (QIS), and flux images made from them.
    """
    _check_limits()


def _plugin(command: F) -> F:
    return click.option(
        "--plugin",
        "plugin_files",
        multiple=True,
        type=click.Path(path_type=Path),
        metavar="FILE.py",
        help="Load a file with effects or methods of your own (it is run as a program; repeatable).",
    )(command)


class _Place(click.Path):
    """A place to write to. Refused before the work begins where it lies inside a dataset."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        place = super().convert(value, param, ctx)
        from . import disk

        disk.check_outside(os.fsdecode(place))
        return place


def _jobs(command: F) -> F:
    return click.option(
        "--jobs",
        "-j",
        type=click.IntRange(1, 4096),
        default=None,
        metavar="N",
        help="Workers at a time. The result does not depend on it.  [default: one per processor]",
    )(command)


def _json(command: F) -> F:
    return click.option("--json", "as_json", is_flag=True, help="Print JSON, for programs.")(command)


def _crop(command: F) -> F:
    return click.option(
        "--crop",
        metavar="ROW:ROW,COLUMN:COLUMN",
        help="The part of SENSOR that was measured, stops excluded, as 100:150,200:250: its own maps, cut.",
    )(command)


def _beside(command: F) -> F:
    """What every verb has that sets a model beside a measurement."""
    path = click.Path(path_type=Path)
    for part in (
        _plugin,
        _crop,
        _jobs,
        click.option(
            "--seed",
            type=click.IntRange(0, 2**63 - 1),
            default=0,
            metavar="N",
            help="Of the simulations.  [default: 0]",
        ),
        click.option("--json", "json_file", type=_Place(), metavar="FILE", help="Write the answer there, as JSON."),
        click.argument("measurement", type=path),
        click.argument("sensor", type=path),
    ):
        command = part(command)
    return command


@cli.command(short_help="Make the dataset of a config.")
@click.argument("config", type=click.Path(path_type=Path))
@click.option(
    "--output",
    "-o",
    type=_Place(),
    metavar="OUT",
    help="Folder of the dataset.  [default: the config's name]",
)
@click.option(
    "--lux",
    "levels",
    multiple=True,
    metavar="LEVEL",
    help='Only this light level, as the config writes it: --lux "5 mlux" (repeatable).',
)
@click.option(
    "--limit",
    type=click.IntRange(1),
    default=None,
    metavar="N",
    help="Only the first N images of each split.",
)
@click.option(
    "--images-dir",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Where the images lie. Without it MNIST is looked for in $SPADMNIST_DATA, then downloaded once.",
)
@_jobs
@click.option(
    "--seed",
    type=click.IntRange(0, 2**63 - 1),
    default=None,
    metavar="N",
    help="Another seed than the config's.",
)
@click.option(
    "--format",
    "format_",
    type=click.Choice(["zarr", "hdf5"]),
    default=None,
    help="Another format than the config's.",
)
@click.option("--causes", is_flag=True, help="Store of every detection what made it, and its parent.")
@click.option("--dry-run", is_flag=True, help="Say photons, bytes, memory and time, and make nothing.")
@_plugin
@_json
def generate(
    config: Path,
    output: Path | None,
    levels: tuple[str, ...],
    limit: int | None,
    images_dir: Path | None,
    jobs: int | None,
    seed: int | None,
    format_: str | None,
    causes: bool,
    dry_run: bool,
    plugin_files: tuple[Path, ...],
    as_json: bool,
) -> None:
    """Make the dataset that CONFIG describes.

    The same command again goes on where an interrupted run stopped. --lux, --limit, --jobs and --causes change no
    drawn value of what is made.

    Pictures of your own are `source: folder` (spadmnist init writes such a config). A pixel's photons follow its grey
    level. With `gamma: srgb` the level is first taken back from sRGB to light: half of white gets 21 % of its photons.

    \b
    spadmnist generate configs/quick.yaml -o out
    spadmnist generate configs/spad_mnist.yaml -o full --images-dir ~/mnist
    spadmnist generate configs/spad_mnist.yaml -o dim --lux "5 mlux" --limit 1000
    """
    from . import config as configs
    from . import factory
    from . import images as sources

    _load(plugin_files)
    experiment = configs.read(config, seed, format_, levels, limit, causes)
    for note in experiment.notes:
        _say(f"Note: {note}")
    images = experiment.load_images(images_dir)
    for note in sources.notes(images):
        _say(f"Note: {note}")
    root = output if output is not None else Path(config.stem)
    workers = jobs or factory.most_workers(experiment, images, processors())
    if dry_run:
        from . import plan

        estimate = plan.estimate(experiment, images, workers)
        if as_json:
            _print_json(estimate)
        else:
            _print_lines(plan.text(estimate, root))
        return
    with _terminal() as progress:
        outcome = factory.generate(experiment, images, root, workers, progress)
    if as_json:
        _print_json({"dataset": str(root), "made": outcome.made, "kept": outcome.kept, "seconds": outcome.seconds})
        return
    from . import report

    _print_lines(report.level_table(outcome.manifest))
    if outcome.made == 0 and outcome.kept == 0:
        _say("")
        again = f"spadmnist verify {quoted(root)} reads every byte of it"
        _say(f"{root} was complete already; nothing was done. {again}.")
    else:
        kept = f", {outcome.kept} were there already" if outcome.kept else ""
        _say("")
        _say(f"Made {outcome.made} shards in {_duration(outcome.seconds)}{kept}: {root}")
        _say(f"Look at it:  spadmnist inspect {quoted(root)} --plot {quoted(f'{root.name}.png')}")


@cli.command(short_help="Begin: a config and a sensor, or a plan for a bench, every line explained.")
@click.argument("folder", type=_Place())
@click.option("--images", type=click.Path(path_type=Path), metavar="DIR", help="A folder of pictures of your own.")
@click.option(
    "--sensor",
    type=click.Choice(["spad23", "spad512", "spad_mnist"]),
    default="spad_mnist",
    help="The sensor to begin with.  [default: spad_mnist]",
)
@click.option("--measurement", is_flag=True, help="A plan of captures instead, which `import -o FOLDER` fills.")
@_json
def init(folder: Path, images: Path | None, sensor: str, measurement: bool, as_json: bool) -> None:
    """Write FOLDER/config.yaml and FOLDER/sensor.yaml, which run as they are, or FOLDER/measurement.yaml.

    Beside them lie their JSON Schemas, with which an editor completes and checks. A config for pictures has gamma:
    srgb. Light is linear and pictures are not: a value of half of white then gets 21 % of white's photons.

    \b
    spadmnist init my --images photos --sensor spad512
    spadmnist generate my/config.yaml -o my_dataset
    spadmnist init bench --sensor spad512 --measurement
    """
    from . import starting
    from .errors import SpadError

    if measurement and images is not None:
        raise SpadError("--images: belongs to a config, and a plan of captures has none; leave it or --measurement out")
    files = starting.measurement(folder, sensor) if measurement else starting.dataset(folder, sensor, images)
    written = starting.write(folder, files)
    if as_json:
        _print_json({"files": [str(path) for path in written]})
        return
    for path in written:
        _print(str(path))
    last = quoted(written[-1])
    if measurement:
        _say(f"Then fill it:  spadmnist import FILE... -o {quoted(folder)}")
    else:
        _say(f"What it costs:  spadmnist generate {last} --dry-run")
        _say(f"Then:  spadmnist generate {last} -o {quoted(f'{folder.resolve().name}_dataset')}")


@cli.command("schema", short_help="Print the JSON Schema of the YAML files, for editors.")
@click.argument("kind", required=False, default="config")
@_plugin
def schema_(kind: str, plugin_files: tuple[Path, ...]) -> None:
    """Print the JSON Schema of a config, made from the classes; or, KIND being sensor or measurement, that of theirs.

    An editor that knows YAML completes and checks with it, where the first line of the file names the schema's:

    \b
    spadmnist schema > config.schema.json
    # yaml-language-server: $schema=config.schema.json
    """
    from . import schema

    _load(plugin_files)
    _print_lines(schema.text(kind).rstrip("\n"))


@cli.command("reconstruct", short_help="Make flux images of a dataset or a measurement.")
@click.argument("dataset", metavar="DATASET|MEASUREMENT", type=click.Path(path_type=Path))
@click.option(
    "--method",
    "methods",
    multiple=True,
    metavar="METHOD",
    help="A method (repeatable).  [default: all that the readouts allow]",
)
@click.option(
    "--output",
    "-o",
    type=_Place(),
    metavar="FOLDER",
    help="Of a measurement: folder of its images.  [default: NAME-flux, here]",
)
@click.option(
    "--sensor",
    type=click.Path(path_type=Path),
    metavar="SENSOR",
    help="Of a measurement: whose PDP and dead time the methods are told.  [default: 1, and 0 s]",
)
@_crop
@_jobs
@_plugin
@_json
def reconstruct_(
    dataset: Path,
    methods: tuple[str, ...],
    output: Path | None,
    sensor: Path | None,
    crop: str | None,
    jobs: int | None,
    plugin_files: tuple[Path, ...],
    as_json: bool,
) -> None:
    """Make flux images from the raw streams of DATASET, and add them to it; or from the captures of MEASUREMENT, and
    write them to a folder: <capture>.<method>.npy, and sheet.png.

    The dataset is then, byte for byte, what `generate` makes of a config that lists these methods. A measurement's
    images are photons/s where SENSOR (a sensor file, or a config) is given, otherwise detections/s.

    \b
    spadmnist reconstruct out --method inter_photon
    spadmnist reconstruct lab --sensor sensor.yaml -o flux
    """
    from . import factory, measurement, report
    from . import reconstruct as library
    from .errors import SpadError

    _load(plugin_files)
    for name in methods:
        try:
            library.find(name)
        except KeyError as error:
            raise SpadError(f"--method: {error.args[0]}") from None
    if measurement.is_measurement(dataset):
        if jobs is not None:
            raise SpadError(
                f"--jobs: belongs to a dataset; the captures of {dataset} are read one by one: leave it out"
            )
        if crop is not None and sensor is None:
            raise SpadError("--crop: is the part of a sensor; give --sensor as well, or leave it out")
        model = None if sensor is None else _model(sensor, crop)
        _reconstruct_measurement(dataset, methods, output, model, as_json)
        return
    for option, given in (("--output", output), ("--sensor", sensor), ("--crop", crop)):
        if given is not None:
            raise SpadError(
                f"{option}: belongs to a measurement, and {dataset} is none; a dataset keeps its images and knows its "
                "sensor: leave it out"
            )
    with _terminal() as progress:
        added, manifest = factory.add_reconstructions(dataset, methods, jobs or processors(), progress)
    if as_json:
        _print_json({"dataset": str(dataset), "added": added, "normalisation": manifest["normalisation"]})
        return
    if added:
        _say(f"Added to {dataset}: {', '.join(added)}")
    else:
        _say(f"{dataset} holds these reconstructions already; nothing was done.")
    _say("")
    _print_lines(report.level_table(manifest))


def _reconstruct_measurement(
    path: Path, methods: tuple[str, ...], output: Path | None, model: Sensor | None, as_json: bool
) -> None:
    from . import fluxes, measurement, report

    opened = measurement.open(path)
    folder = output if output is not None else fluxes.place_of(opened)
    fluxes.check_place(folder)
    with _terminal() as progress:
        found = fluxes.of_measurement(opened, methods, model, progress)
    fluxes.write(found, folder)
    for note in found.notes:
        _say(f"Note: {note}")
    rows = found.rows()
    if as_json:
        answer = {"measurement": opened.name, "folder": str(folder), "images": rows, "notes": found.notes}
        _print_json(answer)
        return
    _print_lines(report.flux_table(rows))
    _say("")
    _say(f"Made {len(rows)} image{'s' if len(rows) > 1 else ''}: {folder}. Look at {folder / fluxes.SHEET}")


@cli.command(short_help="Say and show what a dataset or a measurement holds.")
@click.argument("dataset", metavar="DATASET|MEASUREMENT", type=click.Path(path_type=Path))
@click.option(
    "--plot",
    type=_Place(),
    metavar="FILE.png",
    help="Draw a sheet: images in all readouts and methods, or maps, rates and intervals of captures.",
)
@_json
def inspect(dataset: Path, plot: Path | None, as_json: bool) -> None:
    """Say what DATASET holds: per light level detections, empty and saturated pixels, bytes, bits per detection; or
    MEASUREMENT: per capture detections, rates, empty, hot and dead pixels, intervals.

    \b
    spadmnist inspect out
    spadmnist inspect out --plot sheet.png
    """
    from . import dataset as library
    from . import measurement, report
    from .errors import SpadError

    if plot is not None and plot.suffix.lower() != ".png":
        raise SpadError(f"--plot: {plot} is no PNG file; name one that ends in .png")
    if measurement.is_measurement(dataset):
        _inspect_measurement(dataset, plot, as_json)
        return
    manifest = library.intact_manifest(dataset)
    if as_json:
        _print_json(
            {
                "levels": report.level_rows(manifest),
                "normalisation": manifest["normalisation"],
                "config": manifest["config"],
            }
        )
    else:
        _print_lines(report.level_table(manifest))
    if plot is not None:
        with _writing(plot):
            report.sheet(library.open(dataset), plot, places=report.places_of(manifest, dataset))
        _say(f"Drawn: {plot}")


def _inspect_measurement(path: Path, plot: Path | None, as_json: bool) -> None:
    from . import measurement, report

    opened = measurement.open(path, planned=True)
    looks = report.looks(opened, plot is not None)
    if as_json:
        missing = {"missing": list(opened.missing)} if opened.missing else {}
        _print_json({"measurement": opened.name, "captures": [one.numbers for one in looks], **missing})
    else:
        _print_lines(report.capture_table(opened, looks))
    if opened.missing:
        _say(f"Not recorded yet: {', '.join(opened.missing)}. Next:  spadmnist import FILE -o {quoted(path)}")
    if plot is not None:
        with _writing(plot):
            report.capture_sheet(opened, looks, plot)
        _say(f"Drawn: {plot}")


@cli.command(short_help="Make the model's twin of a measurement.")
@click.argument("sensor", type=click.Path(path_type=Path))
@click.argument("measurement", type=click.Path(path_type=Path))
@click.option(
    "--output",
    "-o",
    type=_Place(),
    metavar="OUT",
    required=True,
    help="Folder of the twin, which is a measurement too.",
)
@click.option(
    "--seed", type=click.IntRange(0, 2**63 - 1), default=0, metavar="N", help="Seed of the draws.  [default: 0]"
)
@_crop
@_plugin
@_json
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
    from . import measurement as library
    from . import twin

    _load(plugin_files)
    model = _model(sensor, crop)
    opened = library.open(measurement, planned=True)
    with _terminal() as progress:
        twin.simulate(model, opened, output, seed, progress)
    if as_json:
        _print_json({"measurement": str(output), "captures": [c.id for c in opened.captures]})
    else:
        _say(f"Simulated {len(opened.captures)} captures: {output}")
        _say(f"Look at them:  spadmnist inspect {quoted(output)} --plot {quoted(f'{output.name}.png')}")


@cli.command(short_help="Compare every byte with the manifest; repair.")
@click.argument("dataset", type=click.Path(path_type=Path))
@click.option("--repair", is_flag=True, help="Make exactly the damaged files again.")
@click.option(
    "--images-dir",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="For --repair: where the images lie, if the dataset's own copy is damaged.",
)
@_jobs
@_plugin
@_json
def verify(
    dataset: Path,
    repair: bool,
    images_dir: Path | None,
    jobs: int | None,
    plugin_files: tuple[Path, ...],
    as_json: bool,
) -> None:
    """Compare every byte of DATASET with its manifest; name each file that is changed, missing or extra.

    Exit status 0: as it was made; 1: damage was found (and not repaired).
    """
    from . import verify as library

    _load(plugin_files)
    with _terminal() as progress:
        damage = library.verify(dataset, progress)
        left, did = damage, []
        if repair:
            did = library.repair(dataset, damage, jobs or processors(), images_dir, progress)
            left = library.verify(dataset, progress) if damage else damage
    if as_json:
        found = {
            "changed": damage.changed,
            "missing": damage.missing,
            "extra": damage.extra,
            "files": damage.files,
        }
        _print_json({"dataset": str(dataset), **found, "repaired": did, "intact": not left})
    else:
        for kind in ("changed", "missing", "extra"):
            for name in getattr(damage, kind):
                _print(f"{kind}: {name}")
        for line in did:
            _print(line)
        if not damage:
            _print(f"{dataset}: all {damage.files} files are as they were made")
        elif not left:
            _print(f"{dataset}: repaired; all {left.files} files are as they were made")
        else:
            again = f"spadmnist verify {quoted(dataset)} --repair makes them again"
            _print(f"{dataset}: {_count(damage)} not as made; {again}")
    if left:
        sys.exit(1)


def _count(damage: Any) -> str:
    n = len(damage.changed) + len(damage.missing) + len(damage.extra)
    return f"{n} file is" if n == 1 else f"{n} files are"


class _ImportCommand(click.Command):
    """Its options are those of `import_options.Said`, made of that table when they are asked for."""

    def get_params(self, context: click.Context) -> list[click.Parameter]:
        from . import import_options

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


@cli.command("import", cls=_ImportCommand, short_help="Make a measurement of files that other programs wrote.")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="FILE...")
@click.option("--output", "-o", type=_Place(), metavar="MEASUREMENT", help="Its folder.")
@click.option("--name", metavar="NAME", help="Of the measurement.  [default: that of the file or folder]")
@click.option(
    "--light",
    "lights",
    multiple=True,
    metavar="LIGHT",
    help=(
        'What fell on the sensor: dark, free (unknown), "500 nm 75.67 nW/cm^2", or a scene, '
        '"image:chart.npy 80 mlux". Once for all files, or once for each.'
    ),
)
@click.option(
    "--capture", "ids", multiple=True, metavar="ID", help="Of a plan: the capture that a file is, once for each file."
)
@_json
def import_(
    files: tuple[Path, ...],
    output: Path | None,
    name: str | None,
    lights: tuple[str, ...],
    ids: tuple[str, ...],
    as_json: bool,
    **given: Any,
) -> None:
    """Make a measurement of FILES, each a capture that is named as its file.

    The kind of a file is found by its content: PicoQuant PTU (T2), Photon-HDF5, plain HDF5 (time and pixel, or frames),
    NumPy .npy and .npz, TIFF, MATLAB 7.3; or by its name: LinoSPAD2 .dat, raw frames .bin (bits; counts with --bits),
    CSV of pixel and time. What no file says is asked for. Times are written with their unit: --exposure "100 ms".

    Where MEASUREMENT is a plan, a measurement.yaml whose captures have no files yet, FILES become its captures: by
    name, by --capture, or in order. Light, clock and pixels are then the plan's, and a contradiction is an error.

    \b
    spadmnist import t2.ptu -o lab --light free
    spadmnist import dark.npy flat.npy -o lab --frame-time "10 us" --frame-period "10 us" \\
        --light dark --light "500 nm 75.67 nW/cm^2"
    """
    from .errors import SpadError
    from .importers import Said, light
    from .importers.captures import import_files

    if output is None:
        raise SpadError("--output: name the folder of the measurement that is made, for example -o lab")
    said = Said.of(**given)
    shone = [light(text, said.relative_uncertainty) for text in lights]
    with _terminal() as progress:
        made = import_files(files, output, said, shone, name, progress, ids)
    if as_json:
        captures = [one.as_data() for one in made.took]
        told = {"measurement": str(made.folder), "captures": captures, "notes": made.notes, "missing": made.missing}
        _print_json(told)
    else:
        for one in made.took:
            _print_lines(one.text())
    for note in made.notes:
        _say(f"Note: {note}.")
    if made.missing:
        _say(f"Still missing: {', '.join(made.missing)}. Next:  spadmnist import FILE -o {quoted(made.folder)}")
    elif not as_json:
        _say(f"Made: {made.folder}. Look at it:  spadmnist inspect {quoted(made.folder)}")


@cli.command(short_help="Write images or captures to files that other programs read.")
@click.argument("dataset", metavar="DATASET|MEASUREMENT", type=click.Path(path_type=Path))
@click.option(
    "--output",
    "-o",
    type=_Place(),
    metavar="OUT",
    help="A folder, or a file for one capture, or (.npz) for one level and split.",
)
@click.option(
    "--format",
    "format_",
    type=click.Choice(["photon-hdf5", "hdf5", "npz", "npy", "png", "parquet", "webdataset"]),
    help="Captures: photon-hdf5 (stamps), npy (frames), hdf5, npz. Images: npz, png (fluxes), parquet, webdataset.",
)
@click.option("--capture", "ids", multiple=True, metavar="ID", help="Only this capture (repeatable).")
@click.option("--lux", "levels", multiple=True, metavar="LEVEL", help="Of images: only this light level (repeatable).")
@click.option("--split", "splits", multiple=True, metavar="SPLIT", help="Of images: only this split (repeatable).")
@click.option("--limit", type=click.IntRange(1), metavar="N", help="Of images: the first N of each level and split.")
@click.option("--method", "methods", multiple=True, metavar="METHOD", help="Of images: only this flux (repeatable).")
@click.option(
    "--readout",
    "readouts",
    multiple=True,
    type=click.Choice(["tr", "str", "qis", "counts"]),
    help="Of a dataset: only this readout (of images repeatable).",
)
@_json
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
    as_json: bool,
) -> None:
    """Write the captures of MEASUREMENT (or of a dataset of uniform images), or the images of DATASET, to OUT.

    Files of captures say how each was recorded, so that `import` gives it back as it was; .npy alone does not. Of
    images, OUT holds <level>/<split>/ as the dataset does, a row an image; parquet has a card and croissant.json.

    \b
    spadmnist export lab -o dark.hdf5 --format photon-hdf5 --capture dark
    spadmnist export out -o rows --format parquet --lux "2560 mlux"
    """
    from . import exporters, image_exporters
    from . import measurement as library
    from .errors import SpadError

    if output is None or format_ is None:
        raise SpadError("--output: name a file or folder and its format, for example -o lab.npz --format npz")
    choice = image_exporters.Choice(levels, splits, limit, methods, readouts)
    if image_exporters.is_of_images(dataset, format_, choice):
        if ids:
            raise SpadError(f"--capture: belongs to a measurement, and these are images of {dataset}: leave it out")
        if format_ == "png" and readouts:
            raise SpadError("--readout: png holds flux images alone; leave it out, or take npz, parquet or webdataset")
        with _terminal() as progress:
            paths = image_exporters.export(dataset, output, format_, choice, progress)
    else:
        _check_captures(dataset, format_, choice)
        opened = library.open(dataset, readouts[0] if readouts else None)
        with _terminal() as progress:
            paths = exporters.export(opened, output, format_, ids, progress)
        if opened.layout.positions is not None:
            _say("Note: these files do not hold where the pixels lie; to import them again, give --positions FILE.csv.")
        if any(capture.light.scene for capture in opened.captures if not ids or capture.id in ids):
            _say(
                "Note: these files do not hold the scene that was seen; to import them again, give --light "
                "image:FILE.npy."
            )
    if as_json:
        _print_json({"files": [str(path) for path in paths]})
        return
    for path in paths:
        _print(str(path))


def _check_captures(source: Path, format_: str, choice: Any) -> None:
    """Refuse what only images of a dataset have."""
    from .errors import SpadError
    from .exporters import Target

    if format_ not in Target.every:
        others = ", ".join(Target.every)
        raise SpadError(f"--format {format_}: holds images of a dataset, and {source} is none; take one of {others}")
    if choice.named or len(choice.readouts) > 1:
        raise SpadError(
            f"--lux, --split, --limit, --method and several --readout: choose images of a dataset, and as {format_} "
            f"{source} gives captures; leave them out"
        )


@cli.command("effects", short_help="List physical effects, describe one, or begin one of your own.")
@click.argument("name", required=False)
@click.option("--new", metavar="NAME", help="Write NAME.py here: an effect of your own that works at once.")
@click.option("--stage", metavar="STAGE", help="For --new: where on the line it acts.  [default: dark]")
@_plugin
@_json
def effects_(
    name: str | None, new: str | None, stage: str | None, plugin_files: tuple[Path, ...], as_json: bool
) -> None:
    """List the physical effects, or describe NAME with its parameters and the YAML to paste.

    \b
    spadmnist effects
    spadmnist effects dead_time
    spadmnist effects --new light_leak --stage dark
    """
    from .errors import SpadError

    if new is None and stage is not None:
        raise SpadError("--stage: belongs to --new NAME, which writes an effect of that stage")
    if new is not None and name is not None:
        raise SpadError(f"--new: give either {name}, to read about it, or --new {new}")
    _load(plugin_files)
    if new is not None:
        _begin_effect(new, stage, as_json)
    else:
        _describe("effect", name, as_json)


def _begin_effect(name: str, stage: str | None, as_json: bool) -> None:
    from . import plugins, reference, template
    from .effects import Effect

    path = template.create(name, template.STAGE if stage is None else stage, Path())
    plugins.load_file(path)
    cls = Effect.registry.find(name)
    if as_json:
        _print_json({"file": str(path), "effect": name, "stage": cls.stage})
        return
    lines = [f"Wrote {path}, an effect of the stage {cls.stage} that works as it is. Read about it:", ""]
    lines += [f"  spadmnist effects {name} --plugin {quoted(path)}", "", "Put it into a config, say my.yaml:", ""]
    lines += [*reference.effect_yaml(cls), "", "And simulate it:", ""]
    for line in [*lines, f"  spadmnist generate my.yaml -o out --plugin {quoted(path)}"]:
        _print(line)


@cli.command("statistics", short_help="List what measurements are compared by, or describe one.")
@click.argument("name", required=False)
@_plugin
@_json
def statistics_(name: str | None, plugin_files: tuple[Path, ...], as_json: bool) -> None:
    """List the statistics by which models and measurements are compared, or describe NAME with its law.

    \b
    spadmnist statistics
    spadmnist statistics neighbours
    """
    _load(plugin_files)
    _describe("statistic", name, as_json)


@cli.command(short_help="Where does a model fail?")
@click.option(
    "--output",
    "-o",
    type=_Place(),
    metavar="REPORT",
    help="Folder for a report: one HTML page with pictures.",
)
@click.option(
    "--tolerance",
    metavar="X",
    help='What is smaller does not matter: "0.5 %" of the detections or of the rate.',
)
@_beside
def compare(
    sensor: Path,
    measurement: Path,
    json_file: Path | None,
    output: Path | None,
    tolerance: str | None,
    seed: int,
    jobs: int | None,
    crop: str | None,
    plugin_files: tuple[Path, ...],
) -> None:
    """Compare the model SENSOR with MEASUREMENT: where does it fail, and by how much?

    Every capture is simulated many times. A check fails where the data lie outside what the model itself scatters; a
    right model is called wrong once in a hundred comparisons. Exit status: 0 the model is adequate, 1 it fails.

    \b
    spadmnist compare sensor.yaml lab/2025-03-01 -o report
    spadmnist compare sensor.yaml lab/2025-03-01 --tolerance "0.5 %" --json answer.json
    """
    from . import measurement as measurements
    from . import units
    from .errors import InputError
    from .inference import comparison, next_step

    _load(plugin_files)
    smallest = None
    if tolerance is not None:
        try:
            smallest = float(units.parse(tolerance, ""))
        except ValueError as error:
            raise InputError(f"--tolerance: {error}") from None
        if not 0 < smallest < 1:
            raise InputError(f'--tolerance: {tolerance} is not a share of more than 0 and less than 1, like "0.5 %"')
    model, data = _model(sensor, crop), measurements.open(measurement)
    if output is not None:
        from . import pages

        pages.check_place(output)
    _check_answer(json_file)
    with _terminal() as progress:
        progress.start("comparing", 100, 0)
        done = [0.0]

        def told(what: str, share: float) -> None:
            progress.advance(max(100 * share - done[0], 0), what)  # what is periodic is simulated once more
            done[0] = max(100 * share, done[0])

        found = comparison.compare(model, data, seed, smallest, jobs or processors(), progress=told)
        progress.stop()
    _write_answer(json_file, comparison.canonical(found))
    what = next_step.after_comparison(found, quoted(sensor), quoted(measurement))
    if output is not None:
        page = pages.comparison(found, output, _source(sensor, measurement, seed, then=what))
        _say(f"Report: {page}")
    _print_lines(f"{comparison.table(found)}\n\nNext: {what}")
    if found.verdict != "adequate":
        sys.exit(1)


@cli.command(short_help="Which physical effect does a model lack?")
@click.option(
    "--output",
    "-o",
    type=_Place(),
    metavar="FOLDER",
    help="Folder for the report, an HTML page, and for the next sensor.yaml with its maps.",
)
@click.option(
    "--max-steps", type=click.IntRange(1, 12), default=12, metavar="N", help="At most so many.  [default: 12]"
)
@click.option("--quick", is_flag=True, help="Fewer simulations: a first answer.")
@click.option(
    "--within",
    metavar="TIME",
    help="Budget of work, as time of two idle cores: 3 min; none, for no end.  [default: 10 min; with --quick 3 min]",
)
@_beside
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
    crop: str | None,
    plugin_files: tuple[Path, ...],
) -> None:
    """Find the effects that the model SENSOR lacks by MEASUREMENT, and add them one by one.

    Every registered effect is tried, those of --plugin files too, every listed number at another value, every
    per-pixel parameter as a map. After each step the answer so far is written, so that Ctrl-C leaves it.

    \b
    spadmnist diagnose sensor.yaml lab/2025-03-01 -o next
    spadmnist diagnose sensor.yaml lab/2025-03-01 --plugin echo.py --json answer.json
    """
    from . import measurement as measurements
    from . import sensor_file
    from .inference import model_selection, next_step, results
    from .inference.budget import seconds_of

    seconds = seconds_of(within, quick)
    _load(plugin_files)
    model, data = _model(sensor, crop), measurements.open(measurement)
    if output is not None:
        from . import pages

        pages.check_place(output, "diagnosis")
        sensor_file.check_place(sensor, output / "sensor.yaml", (output / pages.FILES["diagnosis"]).exists())
    _check_answer(json_file)

    def keep(so_far: Diagnosis) -> None:
        """What is found so far, should the rest be interrupted."""
        if output is not None:
            _write_next(so_far, sensor, output / "sensor.yaml", model)
            pages.diagnosis(so_far, output, _source(sensor, measurement, seed, so_far.file))
        _write_answer(json_file, results.canonical(so_far))

    found = model_selection.diagnose(
        model, data, seed, max_steps, quick, jobs or processors(), progress=_say, within=seconds, keep=keep
    )
    if output is not None:
        _write_next(found, sensor, output / "sensor.yaml", model)
    new = quoted(found.file or "next/sensor.yaml")
    what = next_step.after_diagnosis(found, quoted(sensor), quoted(measurement), new)
    with contextlib.ExitStack() as last:  # each is done, the last one first, whatever becomes of the others
        if output is not None:
            source = _source(sensor, measurement, seed, found.file, what)
            last.callback(lambda: _say(f"Report: {pages.diagnosis(found, output, source)}"))
        last.callback(lambda: _print_lines(f"{results.table(found)}\n\nNext: {what}"))
        last.callback(lambda: _write_answer(json_file, results.canonical(found)))
    if found.unwritten:
        sys.exit(2)


@cli.command(short_help="Fit parameters of a model.")
@click.option("--output", "-o", type=_Place(), metavar="NEXT.yaml", required=True, help="New file.")
@click.option("--add", "added", multiple=True, metavar="EFFECT", help="Add an effect and fit it.")
@click.option("--free", "freed", multiple=True, metavar="EFFECT.PARAMETER", help="Fit a parameter.")
@click.option("--per-pixel", "mapped", multiple=True, metavar="EFFECT.PARAMETER", help="Fit a map.")
@_beside
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
    crop: str | None,
    plugin_files: tuple[Path, ...],
) -> None:
    """Fit parameters of the model SENSOR against MEASUREMENT, with 95 % intervals.

    \b
    spadmnist fit sensor.yaml lab/2025-03-01 --add crosstalk -o next.yaml
    spadmnist fit sensor.yaml lab --free dead_time.duration --per-pixel detection.pdp -o next.yaml
    """
    from . import measurement as measurements
    from . import sensor_file
    from .inference import named_fit, next_step, results

    _load(plugin_files)
    model, data = _model(sensor, crop), measurements.open(measurement)
    sensor_file.check_place(sensor, output)
    _check_answer(json_file)
    found = named_fit.fit_named(model, data, added, freed, mapped, seed, jobs or processors(), progress=_say)
    _write_next(found, sensor, output, model)
    _write_answer(json_file, results.canonical(found))
    what = next_step.after_diagnosis(found, quoted(sensor), quoted(measurement), quoted(found.file or output))
    _print_lines(f"{results.table(found)}\n\nNext: {what}")
    if found.unwritten:
        sys.exit(2)


def _source(sensor: Path, measurement: Path, seed: int, following: str | None = None, then: str = "") -> Source:
    """Where a report comes from: the command, the date, the seed, and the files as text."""
    from . import pages

    files = {f"the sensor, {sensor.name}": sensor, "measurement.yaml": measurement / "measurement.yaml"}
    if following:
        files[f"the next sensor, {Path(following).name}"] = Path(following)
    return pages.source_of(shlex.join(["spadmnist", *sys.argv[1:]]), seed, files, then)


def _write_next(found: Diagnosis, source: Path, out: Path, model: Sensor) -> None:
    """Write the next sensor file. Where that fails the answer says why, and stays."""
    from . import sensor_file
    from .inference import results

    try:
        with _writing(out):
            found.file = str(sensor_file.write(source, out, found.values, results.notes(found), model.window))
    except Exception as error:  # whatever it is, hours of work are not lost for it
        if os.environ.get("SPADMNIST_DEBUG"):
            raise
        found.unwritten = " ".join(str(error).split()) or type(error).__name__
        _say(f"Error: the next sensor file was not written: {found.unwritten}")


def _model(sensor: Path, crop: str | None) -> Sensor:
    """The sensor of a file, or the part of it that was measured."""
    from . import config, window

    model = config.read_sensor(sensor)
    return model if crop is None else model.cropped(*window.parse(crop))


def _check_answer(file: Path | None) -> None:
    """Refuse to put an answer where something else is, before any work is done."""
    from .errors import InputError

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
    from . import disk

    if file is not None:
        with _writing(file):
            disk.put_file(file, (text + "\n").encode())


@cli.command("methods", short_help="List flux reconstructions, or describe one.")
@click.argument("name", required=False)
@_plugin
@_json
def methods_(name: str | None, plugin_files: tuple[Path, ...], as_json: bool) -> None:
    """List the flux reconstructions, or describe NAME with its formula and rules.

    \b
    spadmnist methods
    spadmnist methods inter_photon
    """
    _load(plugin_files)
    _describe("method", name, as_json)


class _ExperimentCommand(click.Command):
    """Beside its own options it has those of the experiment that is named, once it is named."""

    def parse_args(self, context: click.Context, args: list[str]) -> list[str]:
        if any(not word.startswith("-") for word in args):
            from .experiments import PaperExperiment
            from .experiments import word as option

            registry = PaperExperiment.registry
            named = [registry.find(word) for word in args if word in list(registry)]
            for key, one in {key: one for cls in named for key, one in cls.options.items()}.items():
                kind = click.STRING if one.several else click.FLOAT
                words = [option(key), f"own_{key}"]
                added = click.Option(words, type=kind, multiple=one.several, metavar=one.metavar, help=one.about)
                context.meta.setdefault(_OWN, []).append(added)
        return super().parse_args(context, args)

    def get_params(self, context: click.Context) -> list[click.Parameter]:
        return [*super().get_params(context), *context.meta.get(_OWN, [])]


_OWN = "spadmnist.options"  # where a context keeps the options of an experiment


@cli.command("experiment", cls=_ExperimentCommand, short_help="Do an experiment of the paper again.")
@click.argument("name", required=False)
@click.option(
    "--output",
    "-o",
    type=_Place(),
    metavar="OUT",
    help="Folder of the data, the results and the page.",
)
@click.option("--quick", is_flag=True, help="Less of everything: a first answer in minutes.")
@click.option(
    "--images-dir",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Where the images lie. Without it MNIST is looked for in $SPADMNIST_DATA, then downloaded once.",
)
@_jobs
@_json
def experiment_(
    name: str | None,
    output: Path | None,
    quick: bool,
    images_dir: Path | None,
    jobs: int | None,
    as_json: bool,
    **own: Any,
) -> None:
    """List the experiments of the paper; with NAME describe one and its own options; with OUT do it.

    The same command again goes on where an interrupted run stopped. OUT then holds report.html, the pictures, and the
    results, a file each and as one table.

    \b
    spadmnist experiment
    spadmnist experiment accuracy -o accuracy --quick
    """
    from . import experiments
    from .errors import SpadError

    values = {key.removeprefix("own_"): value for key, value in own.items() if value not in (None, ())}
    try:
        if name is not None and output is not None:
            _do_experiment(
                experiments.PaperExperiment.registry.find(name)(**values), output, quick, images_dir, jobs, as_json
            )
            return
        given = {"--quick": quick, "--images-dir": images_dir, "--jobs": jobs, "--output": output, **values}
        for key, value in given.items():
            if value:
                option = key if key.startswith("--") else experiments.word(key)
                raise SpadError(
                    f"{option}: says how an experiment is done; give its name and a folder, too, for example "
                    "spadmnist experiment accuracy -o accuracy"
                )
        if as_json:
            _print_json(experiments.as_data(name))
        else:
            _print_lines(experiments.text(name))
    except KeyError as error:
        raise SpadError(str(error.args[0])) from None


def _do_experiment(
    experiment: PaperExperiment, output: Path, quick: bool, images_dir: Path | None, jobs: int | None, as_json: bool
) -> None:
    from . import experiments

    with _terminal() as progress:
        setting = experiments.Setting(output, quick, images_dir, jobs or processors(), progress)
        done = experiments.run(experiment, setting)
    if as_json:
        answer = {"experiment": experiment.name, "folder": str(output), "made": done.made, "kept": done.kept}
        _print_json({**answer, "seconds": done.seconds, "results": done.results})
        return
    _print_lines(experiments.answer(done.story))
    _say("")
    kept = f", {done.kept} were there already" if done.kept else ""
    _say(f"Got {done.made} results in {_duration(done.seconds)}{kept}. Report: {done.page}")


def _describe(kind: str, name: str | None, as_json: bool) -> None:
    """The reference, made from the classes."""
    from . import reference
    from .errors import SpadError

    try:
        if as_json:
            _print_json(reference.as_data(kind, name))
        else:
            _print_lines(reference.text(kind, name))
    except KeyError as error:
        raise SpadError(str(error.args[0])) from None


# --- talking to people --------------------------------------------------------------------------------------------


# Nothing else in this module writes: names and texts of files never reach a terminal as they are.


def _say(text: str) -> None:
    """One line, for people."""
    # where nobody can be told there is nothing to do about it
    with contextlib.suppress(OSError, ValueError):
        click.echo(visible(short(text)), err=True)


def _print(text: str) -> None:
    """One line that a program may read."""
    click.echo(visible(text))


def _print_lines(text: str) -> None:
    """A table or a page: who made it has seen to it that only its own lines end."""
    click.echo(visible_lines(text))


def _print_json(answer: Any) -> None:
    """All but DEL is escaped by itself."""
    click.echo(json.dumps(answer).replace("\x7f", "\\u007f"))


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min"


_HEAD = 200  # bytes in which an answer says its format
_MISTAKES = 30  # of a file, said one a line; a screen holds them


def _load(plugin_files: tuple[Path, ...]) -> None:
    from . import plugins

    for file in plugin_files:
        plugins.load_file(file)


class _writing:
    """Turn a failure to write a file into a sentence."""

    def __init__(self, path: Path):
        self.path = path

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        from .errors import SpadError

        if isinstance(error, OSError):
            raise SpadError(f"{self.path}: cannot be written ({error.strerror or error}); name another file") from None


class _terminal:
    """A progress bar on standard error, where that is a terminal."""

    def __enter__(self) -> Progress:
        from tqdm import tqdm

        from .factory import Progress

        tqdm.monitor_interval = 0  # no thread that watches the bar

        bar: list[Any] = []

        def start(what: str, total: float, done: float) -> None:
            bar.append(
                tqdm(
                    total=total,
                    initial=done,
                    desc=visible(what),
                    disable=None,
                    leave=False,
                    bar_format="{desc} {percentage:3.0f}%|{bar}| {elapsed}, {remaining} left{postfix}",
                )
            )

        def advance(work: float, note: str) -> None:
            bar[-1].set_postfix_str(visible(note), refresh=False)
            bar[-1].update(work)

        def stop() -> None:
            while bar:
                bar.pop().close()

        self._stop = stop
        return Progress(start, advance, stop, _say)

    def __exit__(self, *_: object) -> None:
        self._stop()


# --- the way out --------------------------------------------------------------------------------------------------


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit: one clear sentence and no traceback for whatever a user can cause."""
    _open_streams()
    interrupts.install()
    try:
        with safe_path(), warnings.catch_warnings():
            # libraries warn programmers; what a user should know is said in a sentence. Tests raise what numpy warns of
            if not os.environ.get("SPADMNIST_DEBUG") and not sys.warnoptions:
                warnings.simplefilter("ignore")
            status = _run(arguments)
    except KeyboardInterrupt:  # between the verb and its end
        status = interrupts.status()
    sys.exit(status)


def _open_streams() -> None:
    """A stream that the caller has closed leads nowhere, for workers too: a file opened later would take its place."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:  # the lowest number that is free is this one
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115


def _run(arguments: list[str] | None) -> int:
    try:
        interrupts.under_way(True)
        result = cli.main(arguments, prog_name="spadmnist", standalone_mode=False)
        sys.stdout.flush()
        return result if isinstance(result, int) else 0
    except (click.Abort, KeyboardInterrupt):
        return interrupts.status()
    except Exception as error:
        return interrupts.status() if interrupts.came() else _failed(error)
    finally:
        interrupts.under_way(False)


def _failed(error: Exception) -> int:
    """The exit status after an error, which is said."""
    from .errors import ConfigError, SpadError

    if isinstance(error, click.exceptions.Exit):
        return error.exit_code
    if isinstance(error, BrokenPipeError):
        # the reader has gone; there is nobody left to tell
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    if isinstance(error, click.ClickException):
        shown, words = io.StringIO(), error.format_message()
        error.show(shown)
        for line in shown.getvalue().replace(words, visible(words)).rstrip("\n").split("\n"):
            _say(line)
    elif isinstance(error, ConfigError):
        for problem in error.problems[:_MISTAKES]:
            _say(f"Error: {problem}")
        if len(error.problems) > _MISTAKES:
            _say(f"Error: there are {len(error.problems) - _MISTAKES:,} mistakes more; correct these first")
    elif isinstance(error, SpadError):
        _say(f"Error: {error}")
    elif isinstance(error, MemoryError):
        _say("Error: there is not enough memory; give fewer --jobs or smaller images")
    elif _is_alone(error):
        _say(f"Error: {_ALONE}")
    elif isinstance(error, OSError):
        _say(f"Error: {error.filename or 'the system'}: {error.strerror or error}")
    elif os.environ.get("SPADMNIST_DEBUG"):
        raise error
    else:
        _say(
            "Error: this should not have happened, and is a fault of the program: "
            f"{type(error).__name__}: {' '.join(str(error).split())}"
        )
        _say("SPADMNIST_DEBUG=1 shows where; please report it.")
    return 2


# --- threads and processes ----------------------------------------------------------------------------------------

_ALONE = (
    "the system lets this program have no further thread or process (it counts all of this user's); end other "
    "programs, raise the limits (ulimit -u, ulimit -v), or give fewer --jobs"
)
_LEAST_SPACE = 600  # MB of addresses that numpy, scipy and numba take before anything is simulated
_OWN_THREADS = 3  # to speak to workers, to write, to tell that time passes
_MOST_THREADS = 64  # of numpy's linear algebra, and again of scipy's, as they are built


def _is_alone(error: BaseException | None) -> bool:
    """Did the system refuse a thread (which Python tells by words alone) or a process? Then what follows fails, too."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.EAGAIN, errno.ENOMEM) and error.filename is None:
            return True
        if isinstance(error, RuntimeError) and "can't start new thread" in str(error):
            return True
        error = error.__context__
    return False


def _check_limits() -> None:
    """Refuse limits under which numpy cannot be imported: it waits for ever, or ends the program as Ctrl-C would."""
    import resource
    import threading

    from .errors import SpadError

    space, _ = resource.getrlimit(resource.RLIMIT_AS)
    if space != resource.RLIM_INFINITY and space < _LEAST_SPACE * 1_000_000:
        raise SpadError(
            f"only {space / 1e6:.0f} MB of addresses are allowed (ulimit -v), and the program needs {_LEAST_SPACE} MB "
            "to begin with; raise that limit"
        )
    told = [os.environ.get(name, "") for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")]
    each = min(processors(), _MOST_THREADS, *(int(text) for text in told if text.isdecimal() and int(text) > 0))
    end = threading.Event()
    started = []
    try:
        for _ in range(2 * (each - 1) + _OWN_THREADS):
            thread = threading.Thread(target=end.wait, daemon=True)
            thread.start()
            started.append(thread)
    finally:
        end.set()
        for thread in started:
            thread.join()


if __name__ == "__main__":
    main()
