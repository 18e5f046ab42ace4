"""Options that several verbs have, and what is given with them: plug-ins, a model, a place to write to."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from ..system import processors
from ..workers import Executor, executor
from . import _terminal as terminal

if TYPE_CHECKING:
    from ..sensor import Sensor


F = TypeVar("F", bound=Callable[..., Any])


def plugin(command: F) -> F:
    """`--plugin FILE.py`, as `plugin_files`; see `load_plugins`."""
    return click.option(
        "--plugin",
        "plugin_files",
        multiple=True,
        type=click.Path(path_type=Path),
        metavar="FILE.py",
        help="Load a Python file with your own effects, statistics or methods. It is executed. Repeatable.",
    )(command)


class Place(click.Path):
    """A place to write to. Refused before the work begins where it lies inside a dataset."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        place = super().convert(value, param, ctx)
        from .. import disk

        disk.check_outside(os.fsdecode(place))
        return place


class Readable(click.Path):
    """A dataset to read from: a path, or an address as it stands."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return value if "://" in str(value) else super().convert(value, param, ctx)


def output(metavar: str, about: str, required: bool = False) -> Callable[[F], F]:
    """`--output PLACE`, `-o`; metavar, about: as its help says them."""
    return click.option("--output", "-o", type=Place(), metavar=metavar, required=required, help=about)


def seed(about: str, default: int | None = 0) -> Callable[[F], F]:
    """`--seed N`; about: its help."""
    return click.option("--seed", type=click.IntRange(0, 2**63 - 1), default=default, metavar="N", help=about)


def images_dir(
    about: str = "Folder of the images, in place of the one that the config names, or around it. "
    "Without it MNIST is taken from $SPADMNIST_DATA, or downloaded once.",
) -> Callable[[F], F]:
    """`--images-dir DIR`; about: its help."""
    return click.option("--images-dir", type=click.Path(path_type=Path), metavar="DIR", help=about)


def jobs(command: F) -> F:
    """`--jobs N`."""
    return click.option(
        "--jobs",
        "-j",
        type=click.IntRange(1, 4096),
        default=None,
        metavar="N",
        help="Number of worker processes. The result does not depend on it.  [default: one per processor]",
    )(command)


def cluster(command: F) -> F:
    """`--cluster ADDRESS`; see `workers_of`."""
    return click.option(
        "--cluster",
        metavar="tcp://HOST:PORT",
        help="Give the work to the workers of this dask.distributed scheduler. The result does not depend on it.",
    )(command)


def no_shared(command: F) -> F:
    """`--no-shared`; see `workers_of`."""
    return click.option(
        "--no-shared",
        is_flag=True,
        help="The workers of --cluster do not see the dataset's folder: they send what they make.",
    )(command)


def as_json(command: F) -> F:
    """`--json`, as `as_json`."""
    return click.option("--json", "as_json", is_flag=True, help="Print the answer as JSON.")(command)


def json_file(command: F) -> F:
    """`--json FILE`, as `json_file`."""
    return click.option("--json", "json_file", type=Place(), metavar="FILE", help="Write the answer to FILE as JSON.")(
        command
    )


def crop(command: F) -> F:
    """`--crop ROW:ROW,COLUMN:COLUMN`; see `model_of`."""
    return click.option(
        "--crop",
        metavar="ROW:ROW,COLUMN:COLUMN",
        help="The measured part of SENSOR, as 100:150,200:250; stops are excluded. Its maps are cropped.",
    )(command)


def model_and_measurement(command: F) -> F:
    """The arguments and options of every verb that compares a model with a measurement."""
    path = click.Path(path_type=Path)
    for part in (
        plugin,
        crop,
        cluster,
        jobs,
        seed("Seed of the simulations.  [default: 0]"),
        json_file,
        click.argument("measurement", type=path),
        click.argument("sensor", type=path),
    ):
        command = part(command)
    return command


def workers_of(jobs: int | None, cluster: str | None, no_shared: bool = False) -> Executor:
    """Who does the work: the workers of a cluster, or processes of this machine, by default one per processor."""
    from ..errors import SpadError

    if cluster is None:
        if no_shared:
            raise SpadError("--no-shared: is said of the workers of a cluster; give --cluster as well, or leave it out")
        return executor(jobs or processors())
    if jobs is not None:
        raise SpadError("--jobs: a cluster has the workers that were started there; leave --jobs or --cluster out")
    from ..cluster import Cluster

    return Cluster(cluster, not no_shared, terminal.say)


def load_plugins(plugin_files: tuple[Path, ...]) -> None:
    """Run the files of `--plugin`: their effects and methods are known from then on."""
    from .. import plugins

    for file in plugin_files:
        plugins.load_file(file)


def again(measurement: Path, plugin_files: tuple[Path, ...], crop: str | None) -> str:
    """MEASUREMENT, the part of the sensor and the plug-ins, as the next command names them, quoted for a shell."""
    from ..foreign import quoted

    part = [] if crop is None else [f"--crop={''.join(crop.split())}"]  # it was parsed: numbers, colons and a comma
    return " ".join([quoted(measurement), *part, *(f"--plugin {quoted(file)}" for file in plugin_files)])


def check_order(sensor: Path, measurement: Path) -> None:
    """Raise SpadError where the measurement stands before the sensor."""
    from .. import kinds
    from ..errors import SpadError
    from ..foreign import quoted

    first, second = kinds.at(sensor), kinds.at(measurement)
    swapped = first in (kinds.MEASUREMENT_KIND, kinds.DATASET_KIND) and second in (kinds.SENSOR_KIND, kinds.CONFIG_KIND)
    if swapped:
        verb = click.get_current_context().info_name
        raise SpadError(
            f"{sensor} is {first}, and {measurement} is {second}: the order is SENSOR MEASUREMENT; did you mean: "
            f"spadmnist {verb} {quoted(measurement)} {quoted(sensor)}"
        )


def model_of(sensor: Path, crop: str | None) -> Sensor:
    """The sensor of a file, or the part of it that `--crop` names."""
    from .. import config, window

    model = config.read_sensor(sensor)
    return model if crop is None else model.cropped(*window.parse(crop))
