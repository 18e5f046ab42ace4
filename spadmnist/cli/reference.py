"""Verbs of the reference, which is made from the classes."""

from __future__ import annotations

from pathlib import Path

import click

from ..foreign import quoted
from . import _options as options
from . import _terminal as terminal
from ._group import cli


@cli.verb(30, "schema", short_help="Print the JSON Schema of the YAML files, for editors.")
@click.argument("kind", required=False, default="config")
@options.plugin
def schema_(kind: str, plugin_files: tuple[Path, ...]) -> None:
    """Print the JSON Schema of the YAML files. KIND is config, sensor or measurement.

    An editor completes and checks a YAML file with it, if the first line of the file names the schema:

    \b
    spadmnist schema > config.schema.json
    # yaml-language-server: $schema=config.schema.json
    """
    from .. import schema

    options.load_plugins(plugin_files)
    terminal.print_lines(schema.text(kind).rstrip("\n"))


@cli.verb(100, "effects", short_help="List physical effects, describe one, or begin your own.")
@click.argument("name", required=False)
@click.option("--new", metavar="NAME", help="Write NAME.py, an effect that works, to be changed.")
@click.option("--stage", metavar="STAGE", help="For --new: stage of the effect.  [default: dark]")
@options.plugin
@options.as_json
def effects_(
    name: str | None, new: str | None, stage: str | None, plugin_files: tuple[Path, ...], as_json: bool
) -> None:
    """List the physical effects, or describe NAME with its parameters and the YAML to paste.

    \b
    spadmnist effects
    spadmnist effects dead_time
    spadmnist effects --new light_leak --stage dark
    """
    from ..errors import SpadError

    if new is None and stage is not None:
        raise SpadError("--stage: belongs to --new NAME, which writes an effect of that stage")
    if new is not None and name is not None:
        raise SpadError(f"--new: give either {name}, to read about it, or --new {new}")
    options.load_plugins(plugin_files)
    if new is not None:
        _begin_effect(new, stage, as_json)
    else:
        _describe("effect", name, as_json)


def _begin_effect(name: str, stage: str | None, as_json: bool) -> None:
    from .. import plugins, reference, template
    from ..effects import Effect

    path = template.create(name, template.STAGE if stage is None else stage, Path())
    plugins.load_file(path)
    cls = Effect.registry.find(name)
    if as_json:
        terminal.print_json({"file": str(path), "effect": name, "stage": cls.stage})
        return
    lines = [f"Wrote {path}, an effect of the stage {cls.stage} that works as it is. Read about it:", ""]
    lines += [f"  spadmnist effects {name} --plugin {quoted(path)}", "", "Put it into a config, say my.yaml:", ""]
    lines += [*reference.effect_yaml(cls), "", "And simulate it:", ""]
    lines += [f"  spadmnist generate my.yaml -o out --plugin {quoted(path)}", ""]
    test = f"from {name} import {cls.__name__}; from spadmnist.testing import check_effect"
    lines += ["When you have changed it, test in Python, in this folder, that it keeps the contract of effects:", ""]
    for line in [*lines, f'  python -c "{test}; print(check_effect({cls.__name__}))"']:
        terminal.print_line(line)


@cli.verb(110, "statistics", short_help="List the statistics of comparisons, or describe one.")
@click.argument("name", required=False)
@options.plugin
@options.as_json
def statistics_(name: str | None, plugin_files: tuple[Path, ...], as_json: bool) -> None:
    """List the statistics by which a model is compared with a measurement, or describe NAME with its law.

    \b
    spadmnist statistics
    spadmnist statistics neighbours
    """
    options.load_plugins(plugin_files)
    _describe("statistic", name, as_json)


@cli.verb(150, "methods", short_help="List flux reconstructions, or describe one.")
@click.argument("name", required=False)
@options.plugin
@options.as_json
def methods_(name: str | None, plugin_files: tuple[Path, ...], as_json: bool) -> None:
    """List the flux reconstructions, or describe NAME with its formula and rules.

    \b
    spadmnist methods
    spadmnist methods inter_photon
    """
    options.load_plugins(plugin_files)
    _describe("method", name, as_json)


def _describe(kind: str, name: str | None, as_json: bool) -> None:
    """The reference, made from the classes."""
    from .. import reference
    from ..errors import SpadError

    try:
        if as_json:
            terminal.print_json(reference.as_data(kind, name))
        else:
            terminal.print_lines(reference.text(kind, name))
    except KeyError as error:
        raise SpadError(str(error.args[0])) from None
