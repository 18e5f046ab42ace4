"""The verb that does the experiments of the paper again."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..system import processors
from . import _options as options
from . import _terminal as terminal
from ._group import Verb, cli

if TYPE_CHECKING:
    from ..experiments import PaperExperiment


class _ExperimentCommand(Verb):
    """Beside its own options it has those of the experiment that is named, once it is named."""

    def parse_args(self, context: click.Context, args: list[str]) -> list[str]:
        if any(not word.startswith("-") for word in args):
            from ..experiments import PaperExperiment
            from ..experiments import word as option

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


@cli.verb(160, "experiment", cls=_ExperimentCommand, short_help="Repeat an experiment of the paper.")
@click.argument("name", required=False)
@options.output("OUT", "Folder of the data, the results and the report.")
@click.option("--quick", is_flag=True, help="Fewer images and epochs, for a first answer in minutes.")
@options.images_dir()
@options.jobs
@options.as_json
def experiment_(
    name: str | None,
    output: Path | None,
    quick: bool,
    images_dir: Path | None,
    jobs: int | None,
    as_json: bool,
    **own: Any,
) -> None:
    """List the experiments of the paper. With NAME describe one and its own options; with OUT run it.

    The same command again resumes an interrupted run. OUT contains report.html, the pictures, and the results, each
    in a file and all in one table.

    \b
    spadmnist experiment
    spadmnist experiment accuracy -o accuracy --quick
    """
    from .. import experiments
    from ..errors import SpadError

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
            terminal.print_json(experiments.as_data(name))
        else:
            terminal.print_lines(experiments.text(name))
    except KeyError as error:
        raise SpadError(str(error.args[0])) from None


def _do_experiment(
    experiment: PaperExperiment, output: Path, quick: bool, images_dir: Path | None, jobs: int | None, as_json: bool
) -> None:
    from .. import experiments

    with terminal.progress() as progress:
        setting = experiments.Setting(output, quick, images_dir, jobs or processors(), progress)
        done = experiments.run(experiment, setting)
    if as_json:
        answer = {"experiment": experiment.name, "folder": str(output), "made": done.made, "kept": done.kept}
        terminal.print_json({**answer, "seconds": done.seconds, "results": done.results})
        return
    terminal.print_lines(experiments.answer(done.story))
    terminal.say("")
    kept = f", {done.kept} were there already" if done.kept else ""
    terminal.say(f"Got {done.made} results in {terminal.duration(done.seconds)}{kept}. Report: {done.page}")
