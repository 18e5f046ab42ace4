"""Verbs that make data, add to them and keep them whole."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..errors import SpadError
from ..foreign import quoted
from ..system import processors
from . import _options as options
from . import _terminal as terminal
from ._group import cli

if TYPE_CHECKING:
    from ..sensor import Sensor
    from ..verify import Damage


@cli.verb(10, short_help="Make the dataset of a config.")
@click.argument("config", type=click.Path(path_type=Path))
@options.output("OUT", "Folder of the dataset.  [default: the name of the config]")
@click.option(
    "--lux",
    "levels",
    multiple=True,
    metavar="LEVEL",
    help='Only this light level, as the config writes it: --lux "5 mlux". Repeatable.',
)
@click.option(
    "--limit",
    type=click.IntRange(1),
    default=None,
    metavar="N",
    help="Only the first N images of each split.",
)
@options.images_dir()
@options.jobs
@options.cluster
@options.no_shared
@click.option(
    "--part",
    metavar="K/N",
    help="Only every N-th shard, from the K-th on, on any machine that sees OUT. Without it the rest is made.",
)
@options.seed("Seed, in place of that of the config.", default=None)
@click.option(
    "--format",
    "format_",
    type=click.Choice(["zarr", "hdf5"]),
    default=None,
    help="Format, in place of that of the config.",
)
@click.option("--causes", is_flag=True, help="Store the cause and the parent of every detection.")
@click.option("--dry-run", is_flag=True, help="Print photons, bytes, memory and time, and make nothing.")
@options.plugin
@options.as_json
def generate(
    config: Path,
    output: Path | None,
    levels: tuple[str, ...],
    limit: int | None,
    images_dir: Path | None,
    jobs: int | None,
    cluster: str | None,
    no_shared: bool,
    part: str | None,
    seed: int | None,
    format_: str | None,
    causes: bool,
    dry_run: bool,
    plugin_files: tuple[Path, ...],
    as_json: bool,
) -> None:
    """Make the dataset that CONFIG describes.

    The same command again resumes an interrupted run. --lux, --limit, --jobs, --cluster and --causes do not change the
    random numbers of what is made.

    Your own pictures are `source: folder`; spadmnist init writes such a config. The photons of a pixel are
    proportional to its grey level. With `gamma: srgb` the level is first converted from sRGB to linear light: the value
    128 then gets 22 % of white's photons.

    \b
    spadmnist generate configs/quick.yaml -o out
    spadmnist generate configs/spad_mnist.yaml -o full --images-dir ~/mnist
    spadmnist generate configs/spad_mnist.yaml -o dim --lux "5 mlux" --limit 1000
    """
    root = output if output is not None else Path(config.stem)
    from .. import config as configs
    from .. import factory
    from .. import images as sources
    from ..workers import executor

    one = None if part is None else factory.Part.parse(part)
    if dry_run and one is not None:
        raise SpadError("--dry-run: estimates the whole dataset; leave out --part, and divide by the number of parts")
    options.load_plugins(plugin_files)
    experiment = configs.read(config, seed, format_, levels, limit, causes)
    for note in experiment.notes:
        terminal.say(f"Note: {note}")
    with options.workers_of(jobs, cluster, no_shared) as workers:
        # they import their libraries while this process reads images; plug-ins may set what they inherit
        if not (dry_run or plugin_files or factory.few_images(experiment) or (root / "manifest.json").exists()):
            workers.start("spadmnist.factory")
        images = experiment.load_images(images_dir)
        for note in sources.notes(images):
            terminal.say(f"Note: {note}")
        most = factory.most_workers(experiment, images, processors())
        if dry_run:
            from .. import plan

            estimate = plan.estimate(experiment, images, jobs or most)
            if as_json:
                terminal.print_json(estimate)
            else:
                terminal.print_lines(plan.text(estimate, root))
            if there := factory.standing(experiment, images, root):
                terminal.say(f"Note: {there}")
            return
        workers = workers if jobs else workers.limited(most)
        if jobs is None and workers.local and factory.is_small(experiment, images):
            workers = executor(1)
        with terminal.progress() as progress:
            outcome = factory.generate(experiment, images, root, workers, progress, one)
    if as_json:
        terminal.print_json(
            {"dataset": str(root), "made": outcome.made, "kept": outcome.kept, "seconds": outcome.seconds}
        )
        return
    if not outcome.manifest:
        terminal.say(f"Part {one}: made {outcome.made} shards in {terminal.duration(outcome.seconds)}: {root}")
        terminal.say("When all parts are there, the same command without --part makes the dataset whole.")
        return
    from .. import report

    terminal.print_lines(report.level_table(outcome.manifest))
    if outcome.made == 0 and outcome.kept == 0:
        terminal.say("")
        again = f"spadmnist verify {quoted(root)} reads every byte of it"
        terminal.say(f"{root} was complete already; nothing was done. {again}.")
    else:
        kept = f", {outcome.kept} were there already" if outcome.kept else ""
        terminal.say("")
        terminal.say(f"Made {outcome.made} shards in {terminal.duration(outcome.seconds)}{kept}: {root}")
        terminal.say(f"Look at it:  spadmnist inspect {quoted(root)} --plot {quoted(f'{root.name}.png')}")


@cli.verb(20, short_help="Write a first config and sensor, a plan of captures, or the examples.")
@click.argument("folder", type=options.Place())
@click.option("--images", type=click.Path(path_type=Path), metavar="DIR", help="Folder of your own pictures.")
@click.option(
    "--sensor",
    type=click.Choice(["spad23", "spad512", "spad_mnist"]),
    help="Sensor of the config.  [default: spad_mnist]",
)
@click.option("--measurement", is_flag=True, help="Write a plan of captures instead. `import -o FOLDER` fills it.")
@click.option("--examples", is_flag=True, help="Write the configs that come with the program instead.")
@options.as_json
def init(
    folder: Path, images: Path | None, sensor: str | None, measurement: bool, examples: bool, as_json: bool
) -> None:
    """Write FOLDER/config.yaml and FOLDER/sensor.yaml, which run as they are, or FOLDER/measurement.yaml.

    --examples writes the configs that the documentation calls configs/NAME. They come with the program, also where its
    source is not at hand.

    Their JSON Schemas are written to FOLDER, too; an editor completes and checks with them. A config of pictures has
    gamma: srgb, because pictures are not linear in the light: the value 128 then gets 22 % of white's photons.

    \b
    spadmnist init my --images photos --sensor spad512
    spadmnist generate my/config.yaml -o my_dataset
    spadmnist init bench --sensor spad512 --measurement
    spadmnist init configs --examples
    """
    from .. import starting

    if measurement and images is not None:
        raise SpadError("--images: belongs to a config, and a plan of captures has none; leave it or --measurement out")
    if examples and (measurement or images is not None or sensor is not None):
        raise SpadError("--examples: writes the program's examples as they are; leave out what else is asked for")
    chip = sensor or "spad_mnist"
    if examples:
        files = starting.examples()
    else:
        files = starting.measurement(folder, chip) if measurement else starting.dataset(folder, chip, images)
    written = starting.write(folder, files)
    if as_json:
        terminal.print_json({"files": [str(path) for path in written]})
        return
    for path in written:
        terminal.print_line(str(path))
    last = quoted(written[-1])
    if examples:
        terminal.say(f"Begin with:  spadmnist generate {quoted(folder / 'quick.yaml')} -o out")
    elif measurement:
        terminal.say(f"Then fill it:  spadmnist import FILE... -o {quoted(folder)}")
    else:
        terminal.say(f"What it costs:  spadmnist generate {last} --dry-run")
        terminal.say(f"Then:  spadmnist generate {last} -o {quoted(f'{folder.resolve().name}_dataset')}")


@cli.verb(40, "reconstruct", short_help="Make flux images of a dataset or a measurement.")
@click.argument("dataset", metavar="DATASET|MEASUREMENT", type=click.Path(path_type=Path))
@click.option(
    "--method",
    "methods",
    multiple=True,
    metavar="METHOD",
    help="Method of reconstruction. Repeatable.  [default: all that the readouts allow]",
)
@options.output("FOLDER", "Measurement: folder of the images.  [default: NAME-flux, here]")
@click.option(
    "--sensor",
    type=click.Path(path_type=Path),
    metavar="SENSOR",
    help="Measurement: sensor with the PDP and the dead time of the methods.  [default: 1 and 0 s]",
)
@options.crop
@options.jobs
@options.cluster
@options.plugin
@options.as_json
def reconstruct_(
    dataset: Path,
    methods: tuple[str, ...],
    output: Path | None,
    sensor: Path | None,
    crop: str | None,
    jobs: int | None,
    cluster: str | None,
    plugin_files: tuple[Path, ...],
    as_json: bool,
) -> None:
    """Make flux images of the raw streams of DATASET or MEASUREMENT.

    Images of a dataset are added to it. It is then, byte for byte, the dataset of a config that lists these methods.
    Images of a measurement are written to a folder: <capture>.<method>.npy, and sheet.png. Their unit is photons/s with
    SENSOR (a sensor file, or a config), otherwise detections/s.

    \b
    spadmnist reconstruct out --method inter_photon
    spadmnist reconstruct lab --sensor sensor.yaml -o flux
    """
    from .. import factory, measurement, report
    from .. import reconstruct as library

    options.load_plugins(plugin_files)
    for name in methods:
        try:
            library.find(name)
        except KeyError as error:
            raise SpadError(f"--method: {error.args[0]}") from None
    if measurement.is_measurement(dataset):
        for option, value in (("--jobs", jobs), ("--cluster", cluster)):
            if value is not None:
                raise SpadError(
                    f"{option}: belongs to a dataset; the captures of {dataset} are read one by one: leave it out"
                )
        if crop is not None and sensor is None:
            raise SpadError("--crop: is the part of a sensor; give --sensor as well, or leave it out")
        model = None if sensor is None else options.model_of(sensor, crop)
        _reconstruct_measurement(dataset, methods, output, model, as_json)
        return
    for option, given in (("--output", output), ("--sensor", sensor), ("--crop", crop)):
        if given is not None:
            raise SpadError(
                f"{option}: belongs to a measurement, and {dataset} is none; a dataset keeps its images and knows its "
                "sensor: leave it out"
            )
    with options.workers_of(jobs, cluster) as workers, terminal.progress() as progress:
        added, manifest = factory.add_reconstructions(dataset, methods, workers, progress)
    if as_json:
        terminal.print_json({"dataset": str(dataset), "added": added, "normalisation": manifest["normalisation"]})
        return
    if added:
        terminal.say(f"Added to {dataset}: {', '.join(added)}")
    else:
        terminal.say(f"{dataset} holds these reconstructions already; nothing was done.")
    terminal.say("")
    terminal.print_lines(report.level_table(manifest))


def _reconstruct_measurement(
    path: Path, methods: tuple[str, ...], output: Path | None, model: Sensor | None, as_json: bool
) -> None:
    from .. import fluxes, measurement, report

    opened = measurement.open(path)
    folder = output if output is not None else fluxes.place_of(opened)
    fluxes.check_place(folder)
    with terminal.progress() as progress:
        found = fluxes.of_measurement(opened, methods, model, progress)
    fluxes.write(found, folder)
    for note in found.notes:
        terminal.say(f"Note: {note}")
    rows = found.rows()
    if as_json:
        answer = {"measurement": opened.name, "folder": str(folder), "images": rows, "notes": found.notes}
        terminal.print_json(answer)
        return
    terminal.print_lines(report.flux_table(rows))
    terminal.say("")
    terminal.say(f"Made {len(rows)} image{'s' if len(rows) > 1 else ''}: {folder}. Look at {folder / fluxes.SHEET}")


@cli.verb(70, short_help="Compare every byte with the manifest; repair.")
@click.argument("dataset", type=options.Readable(), metavar="DATASET")
@click.option("--repair", is_flag=True, help="Make the damaged files again.")
@options.images_dir("For --repair: folder of the images, if the copy in the dataset is damaged.")
@options.jobs
@options.cluster
@options.no_shared
@options.plugin
@options.as_json
def verify(
    dataset: Path | str,
    repair: bool,
    images_dir: Path | None,
    jobs: int | None,
    cluster: str | None,
    no_shared: bool,
    plugin_files: tuple[Path, ...],
    as_json: bool,
) -> None:
    """Compare every byte of DATASET with its manifest, and name each file that is changed, missing or extra.

    DATASET is a folder, a zip of it, or its address (https://, http://, s3://). Workers make files again (--repair);
    without it the files are read, and --jobs, --cluster, --no-shared and --images-dir are refused.
    Exit status: 0 the dataset is intact, 1 damage was found and not repaired.

    \b
    spadmnist verify out --repair
    spadmnist verify https://example.org/digits
    """
    from .. import dataset as datasets
    from .. import verify as library

    options.load_plugins(plugin_files)
    given = {"--images-dir": images_dir, "--jobs": jobs, "--cluster": cluster, "--no-shared": no_shared or None}
    for option, value in given.items():
        if value is not None and not repair:
            raise SpadError(f"{option}: belongs to --repair, which makes files again; add --repair, or leave it out")
    root = datasets.at(dataset)
    if not isinstance(root, Path):
        if repair:
            raise SpadError(f"--repair: {dataset} is no folder of this machine; repair the folder that it came from")
        with terminal.progress() as progress:
            damage = library.verify(root, progress)
        _say_damage(str(root), damage, damage, [], "bring or make it again", as_json)
        return
    if not repair:
        library.refuse_begun(root)
    with options.workers_of(jobs, cluster, no_shared) as workers, terminal.progress() as progress:
        damage = library.verify(root, progress)
        left, did = damage, []
        if repair:
            did = library.repair(root, damage, workers, images_dir, progress)
            left = library.verify(root, progress) if damage else damage
    _say_damage(str(root), damage, left, did, f"spadmnist verify {quoted(root)} --repair makes them again", as_json)


def _say_damage(dataset: str, damage: Damage, left: Damage, did: list[str], advice: str, as_json: bool) -> None:
    """damage: what was found; left: what is there after `did`. Exits with 1 where something is left."""
    if as_json:
        found = {
            "changed": damage.changed,
            "missing": damage.missing,
            "extra": damage.extra,
            "files": damage.files,
            "bytes": damage.bytes,
        }
        terminal.print_json({"dataset": dataset, **found, "repaired": did, "intact": not left})
    else:
        for kind in ("changed", "missing", "extra"):
            for name in getattr(damage, kind):
                terminal.print_line(f"{kind}: {name}")
        for line in did:
            terminal.print_line(line)
        if not damage:
            read = f"{damage.bytes:,} bytes were read"
            terminal.print_line(f"{dataset}: all {damage.files} files are as they were made; {read}")
        elif not left:
            terminal.print_line(f"{dataset}: repaired; all {left.files} files are as they were made")
        else:
            terminal.print_line(f"{dataset}: {_count(damage)} not as made; {advice}")
    if left:
        sys.exit(1)


def _count(damage: Damage) -> str:
    n = len(damage.changed) + len(damage.missing) + len(damage.extra)
    return f"{n} file is" if n == 1 else f"{n} files are"
