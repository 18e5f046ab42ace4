"""The program itself, to which every verb adds itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from . import _limits as limits


class Verb(click.Command):
    """A verb whose options of one value are given once: of several values the last one would count, in silence."""

    def parse_args(self, context: click.Context, args: list[str]) -> list[str]:
        _, _, given = self.make_parser(context).parse_args(args=list(args))
        for option in dict.fromkeys(given):
            single = isinstance(option, click.Option) and not (option.multiple or option.is_flag or option.count)
            if single and given.count(option) > 1:
                name = max(option.opts, key=len)
                raise click.UsageError(
                    f"{name} is given {given.count(option)} times, and it takes one value; give it once", context
                )
        return super().parse_args(context, args)


class Verbs(click.Group):
    """Verbs in the order of a day's work, not of the alphabet."""

    command_class = Verb

    def __init__(self, *args: Any, **named: Any):
        super().__init__(*args, **named)
        self._hours: dict[str, int] = {}

    def verb(self, hour: int, *args: Any, **named: Any) -> Callable[[Callable[..., Any]], click.Command]:
        """`click.Group.command` of a verb that `--help` lists by its `hour` in a day's work, in steps of ten."""
        made: Callable[[Callable[..., Any]], click.Command] = self.command(*args, **named)

        def add(function: Callable[..., Any]) -> click.Command:
            command = made(function)
            assert command.name is not None
            self._hours[command.name] = hour
            return command

        return add

    def list_commands(self, context: click.Context) -> list[str]:
        return sorted(self.commands, key=self._hours.__getitem__)


@click.group(
    cls=Verbs,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Begin with:  spadmnist init my  and then  spadmnist generate my/config.yaml -o out",
)
@click.version_option(package_name="spadmnist", message="%(package)s %(version)s")
def cli() -> None:
    """What a single-photon (SPAD) camera would have recorded.

    A config (YAML) names images, light levels, a sensor and its effects; `generate` makes the dataset: time stamps
    (TR), first time stamps of frames (STR), 1-bit frames (QIS), and flux images made from them.
    """
    limits.check()
