"""The verbs of the command line with all their options, from click."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

import click

from spadmnist.cli import cli

from . import markdown as md


def verbs() -> Iterator[tuple[str, click.Command]]:
    """Every verb by its name, in the order of `spadmnist --help`."""
    context = click.Context(cli, info_name="spadmnist")
    for name in cli.list_commands(context):
        command = cli.get_command(context, name)
        if command is not None and not command.hidden:
            yield name, command


def page() -> str:
    """The page of all verbs."""
    known = dict(verbs())
    rows = [[f"[`{name}`](#{name})", md.plain(one.get_short_help_str(200))] for name, one in known.items()]
    about = [
        "Exit status: 0 done; 1 the answer is 'no' (`compare`: the model fails; `verify`: damage was found); 2 it "
        "could not be done; 130 interrupted. Results go to standard output, everything else to standard error.",
    ]
    return md.page("Verbs", *_help(cli), *about, md.table(("verb", "does"), rows), *map(_verb, known, known.values()))


def _verb(name: str, command: click.Command) -> str:
    context = click.Context(command, parent=click.Context(cli, info_name="spadmnist"), info_name=name)
    usage = " ".join(command.collect_usage_pieces(context))
    blocks = [f"## {name}", md.code(f"spadmnist {name} {usage}", "text"), *_help(command)]
    rows = [[_names(one), md.plain(_about(one))] for one in command.params if isinstance(one, click.Option)]
    return "\n\n".join([*blocks, md.table(("option", "does"), rows)]).rstrip()


def _help(command: click.Command) -> list[str]:
    """The paragraphs of its help; what click keeps in lines is a program."""
    found = []
    for block in (command.help or "").split("\n\n"):
        lines = block.strip("\n").split("\n")
        if lines[0].strip() == "\b":
            found.append(md.code(textwrap.dedent("\n".join(lines[1:])), "text"))
        elif block.strip():
            found.append(md.plain(" ".join(block.split())))
    return found


def _names(option: click.Option) -> str:
    names = ", ".join([*option.opts, *option.secondary_opts])
    if option.is_flag:
        return md.literal(names)
    value = option.metavar or (
        "|".join(option.type.choices) if isinstance(option.type, click.Choice) else option.type.name.upper()
    )
    return md.literal(f"{names} {value}")


def _about(option: click.Option) -> str:
    about = option.help or ""
    repeated = option.multiple and "repeatable" not in about.lower()
    return f"{about} May be given several times." if repeated else about
