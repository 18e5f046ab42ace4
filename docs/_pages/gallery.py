"""The gallery: a page for each effect, made from its class, and an overview by stage."""

from __future__ import annotations

import inspect
from pathlib import Path

from spadmnist import plugins
from spadmnist.effects import STAGES, Effect
from spadmnist.plugins import Parameter
from spadmnist.reference import allowed_values, effect_yaml, hooks, mean_law, varies

from . import markdown as md
from . import pictures
from .pictures import Picture


def effects() -> list[type[Effect]]:
    """Every effect that is registered, in the order of the stages."""
    stages = list(STAGES)
    known: list[type[Effect]] = [Effect.registry.find(name) for name in Effect.registry]
    return sorted(known, key=lambda cls: (stages.index(cls.stage), cls.name))


def pages(folder: Path) -> dict[str, str | bytes]:
    """The files of the chapter by name. folder: where they lie from an earlier time, if they do."""
    made: dict[str, str | bytes] = {}
    shown = {}
    for cls in effects():
        file = folder / f"{cls.name}.png"
        shown[cls.name] = pictures.picture(cls, file)
        made[file.name] = shown[cls.name].png
        made[pictures.thumbnail_of(file).name] = shown[cls.name].thumbnail
        made[f"{cls.name}.md"] = _page(cls, shown[cls.name])
    made["index.md"] = _overview(shown)
    return made


def _overview(shown: dict[str, Picture]) -> str:
    blocks = [
        "An effect is one physical cause. A sensor is a layout and a list of effects; what is not listed is absent. "
        "Each picture shows a small sensor without the effect (grey) and with it (red).",
    ]
    for stage in STAGES:
        known = [cls for cls in effects() if cls.stage == stage]
        rows = [[_thumbnail(cls), f"[`{cls.name}`]({cls.name}.md)", md.plain(cls.summary())] for cls in known]
        if rows:
            blocks += [f"## Stage {stage}", md.table(("", "effect", "what it is"), rows)]
    return md.page("Gallery of effects", *blocks, md.toctree([cls.name for cls in effects()]))


def _thumbnail(cls: type[Effect]) -> str:
    return f"[![{cls.name}]({cls.name}.thumbnail.png)]({cls.name}.md)"


def _page(cls: type[Effect], shown: Picture) -> str:
    return md.page(
        cls.name,
        _facts(cls),
        md.prose(inspect.getdoc(cls)),
        f"**Mean rate.** {md.plain(mean_law(cls))}" if mean_law(cls) else "",
        "## What it does to the statistics",
        *_seen(cls, shown),
        "## Parameters" if cls.parameters else "",
        *_parameters(cls),
        "## In a config or a sensor file",
        md.code("\n".join(line[2:] for line in effect_yaml(cls)), "yaml"),
    )


def _facts(cls: type[Effect]) -> str:
    facts = [f"Stage `{cls.stage}`"]
    facts += [f"after `{cls.after}`"] if cls.after else []
    facts += ["acts on the light of a scene alone"] if cls.of_scene else []
    pixel = [f"`{p.name}`" for p in cls.parameters.values() if p.per == "pixel"]
    facts.append(f"may vary from pixel to pixel: {', '.join(pixel)}" if pixel else "the same for all pixels")
    ways = "; ".join(f"`{call.removesuffix(':')}` {returns}" for call, returns in hooks(cls.stage, cls))
    return f"{'; '.join(facts)}.\n\nHooks: {ways}."


def _seen(cls: type[Effect], shown: Picture) -> list[str]:
    if not shown.says:
        return ["No statistic of the small sensor changes visibly at the values of its contract test."]
    moves = ", ".join(f"`{block}`" for block in cls.moves)
    at = "; ".join(_value(cls.parameters[name], value) for name, value in pictures.values(cls).items())
    return [
        f"![{'; '.join(shown.says)}]({cls.name}.png)",
        " ".join(f"{says}." for says in shown.says),
        f"The picture has {at}. The bands are two standard errors." if at else "The bands are two standard errors.",
        f"Statistics of the contract test that it may change: {moves}." if moves else "",
    ]


def _value(declared: Parameter, value: object) -> str:
    return f"`{declared.name}`: {md.plain(plugins.described(declared, value))}"


def _parameters(cls: type[Effect]) -> list[str]:
    rows = []
    for declared in cls.parameters.values():
        unit, default, allowed, off, search = allowed_values(declared)
        rows.append(
            [f"`{declared.name}`", md.plain(declared.about)]
            + [md.plain(cell) for cell in (unit, default, allowed, off, search, varies(declared))]
        )
    header = ("parameter", "what it is", "unit", "default", "allowed", "off at", "searched", "may vary by")
    return [
        md.table(header, rows),
        "*off at*: the value at which the effect vanishes. *searched*: where `diagnose` and `fit` look for it.",
    ]
