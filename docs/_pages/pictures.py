"""Pictures of what an effect does to the statistics: the contract's sensor with the effect and without it.

The statistics are those that the effect's class says it moves (`Effect.moves`); an effect that says nothing has those
that moved most. The values are those of the contract (`spadmnist.testing.strong`), or what the class asks for
(`shown`). A picture keeps in itself what it was made from, and is made again only where that has changed.
"""

from __future__ import annotations

import hashlib
import inspect
import io
import platform
import textwrap
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from PIL import Image

import spadmnist
from spadmnist import signatures, testing
from spadmnist.effects import Effect

from . import curves
from .curves import Curve, Drawn

LEAST = 0.02  # share of the height of a picture that a difference fills in the mean, to be worth a second one
_REPETITIONS = 8  # of each capture: enough for all that is built in to be seen
_OTHERS = 4  # statistics, of those that an effect names behind the first, that are tried for the second panel
_WITHOUT, _WITH = "0.45", "#c8102e"  # colours of the two curves


@dataclass(frozen=True)
class Panel:
    """One statistic without and with an effect, and how significantly they differ at each point."""

    without: Drawn
    with_: Drawn
    z: np.ndarray
    visible: float


@dataclass(frozen=True)
class Picture:
    """A picture of an effect and its thumbnail, PNG; says: a sentence for each panel, what is seen there."""

    png: bytes
    thumbnail: bytes
    says: tuple[str, ...]


def picture(effect: type[Effect], known: Path) -> Picture:
    """The picture of an effect. known: where an earlier one may lie, and its thumbnail (`thumbnail_of`)."""
    digest = _digest(effect)
    if known.is_file() and thumbnail_of(known).is_file():
        with Image.open(known) as image:
            kept = dict(image.info)
        if kept.get("Source") == digest:
            says = tuple(kept["Description"].split("\n")) if kept["Description"] else ()
            return Picture(known.read_bytes(), thumbnail_of(known).read_bytes(), says)
    panels = _panels(effect)
    says = tuple(map(_sentence, panels))
    about = {"Source": digest, "Description": "\n".join(says)}
    return Picture(_drawn(panels, about), _thumbnail(panels), says)


def thumbnail_of(path: Path) -> Path:
    """Where the thumbnail of a picture lies."""
    return path.with_name(f"{path.stem}.thumbnail.png")


def _digest(effect: type[Effect]) -> str:
    """Of all that decides what a picture shows: the package without its verbs, these pages, the libraries."""
    package, here = Path(spadmnist.__file__).parent, Path(__file__).parent
    files = [*sorted(package.glob("*.py")), *sorted((package / "effects").glob("*.py")), *sorted(here.glob("*.py"))]
    text = hashlib.sha256(inspect.getsource(effect).encode())
    for file in files:
        text.update(file.read_bytes())
    versions = (np.__version__, matplotlib.__version__, platform.machine())
    return hashlib.sha256(f"{text.hexdigest()} {versions}".encode()).hexdigest()


# --- what is seen -------------------------------------------------------------------------------------------------


def values(effect: type[Effect]) -> dict[str, Any]:
    """The values that the picture of an effect has, SI: as strong as in the contract, or what its class asks for."""
    return {name: testing.strong(p) for name, p in effect.parameters.items()} | dict(effect.shown)


def _panels(effect: type[Effect]) -> list[Panel]:
    """The statistic that the effect moves first of all, and another of those that it names; none where none moves."""
    shots = testing.captures(effect, curves.LIGHTS, _REPETITIONS, **effect.shown)
    first, *others = effect.moves or ("",)
    rest = others[:_OTHERS] if first else list(signatures.BLOCKS)
    found = [_best(effect, (first,), shots)] if first else []
    for panel in sorted((_best(effect, (block,), shots) for block in rest), key=lambda panel: -panel.visible):
        names = {known.with_.curve.name for known in found}
        if len(found) < 2 and panel.visible > LEAST and panel.with_.curve.name not in names:
            found.append(panel)
    return [panel for panel in found if panel.visible]


def _best(effect: type[Effect], blocks: tuple[str, ...], shots: dict[str, Any]) -> Panel:
    """Of the curves that show some blocks, the one in which the effect is best seen."""
    panels = []
    for curve in dict.fromkeys(curve for block in blocks for curve in curves.of_block(block)):
        for other, one in zip(_absent(effect, curve), curves.drawn(curve, shots), strict=True):
            panels.append(Panel(other, one, curves.significance(one, other), curves.visible(one, other)))
    return max(panels, key=lambda panel: panel.visible)


def _absent(effect: type[Effect], curve: Curve) -> list[Drawn]:
    """The curve of the sensor without an effect, which is the same for most of them."""
    own = effect.of_scene or effect.name in testing.captured()
    return _reference(effect if own else None, curve)


@cache
def _reference(effect: type[Effect] | None, curve: Curve) -> list[Drawn]:
    return curves.drawn(curve, _absent_shots(effect))


@lru_cache(maxsize=2)
def _absent_shots(effect: type[Effect] | None) -> dict[str, Any]:
    return testing.captures(effect, curves.LIGHTS, _REPETITIONS, absent=True)


def _sentence(panel: Panel) -> str:
    """What is seen: the two values where they differ most."""
    one, other = panel.with_, panel.without
    curve = one.curve
    if curve.image:
        spread = [np.std(v) / np.mean(v) if np.any(v) else 0.0 for v in (one.y, other.y)]
        return f"Rates of the pixels scatter by {_number(100 * spread[0])} % instead of {_number(100 * spread[1])} %"
    at = int(np.abs(panel.z).argmax())
    now, before = (_amount(v.y[at], curve.y[1]) for v in (one, other))
    where = curve.at.format(_number(one.x[at]))
    return f"{curve.name[0].upper()}{curve.name[1:]}, {where}: {now} instead of {before}"


def _amount(value: float, unit: str) -> str:
    """A number with its unit, in words that fit: 637 kHz is said of 1/s as 6.37e5 /s."""
    return f"{_number(value)}{' ' if unit else ''}{unit.replace('1/', '/')}"


def _number(value: float) -> str:
    """Three digits, thousands apart: 605,000, 0.0413."""
    if value == 0 or not np.isfinite(value):
        return "0"
    if abs(value) >= 1000:
        digits = max(0, int(np.floor(np.log10(abs(value)))) - 2)
        return f"{round(value, -digits):,.0f}"
    return f"{value:.3g}" if abs(value) >= 1e-3 else f"{value:.1e}"


# --- drawing ------------------------------------------------------------------------------------------------------


def _drawn(panels: list[Panel], about: dict[str, str]) -> bytes:
    wide = sum(2 if panel.with_.curve.image else 1 for panel in panels)
    figure = Figure(figsize=(4.6 * max(wide, 1), 3.5), layout="constrained")
    subfigures = figure.subfigures(
        1, max(len(panels), 1), squeeze=False, width_ratios=[2 if p.with_.curve.image else 1 for p in panels] or None
    )
    for panel, part in zip(panels, subfigures[0], strict=False):
        part.suptitle(_wrapped(_sentence(panel), 58 if not panel.with_.curve.image else 110), fontsize=9)
        if panel.with_.curve.image:
            _maps(panel, part)
            continue
        axes = part.subplots()
        _lines(panel, axes)
        curve = panel.with_.curve
        axes.set_xlabel(_label(curve.x), fontsize=9)
        axes.set_ylabel(_label(curve.y), fontsize=9)
        axes.tick_params(which="both", labelsize=8)
        axes.legend(fontsize=8, frameon=False)
    return _png(figure, about)


def _thumbnail(panels: list[Panel]) -> bytes:
    figure = Figure(figsize=(2.4, 1.5), layout="constrained")
    axes = figure.subplots()
    axes.set_xticks([])
    axes.set_yticks([])
    if panels and panels[0].with_.curve.image:
        axes.imshow(_grid(panels[0].with_.y), cmap="viridis", aspect="auto")
    elif panels:
        _lines(panels[0], axes, width=2.0)
        axes.tick_params(which="both", bottom=False, left=False, labelbottom=False, labelleft=False)
    return _png(figure, {})


def _lines(panel: Panel, axes: Any, width: float = 1.4) -> None:
    for drawn, colour, name in ((panel.without, _WITHOUT, "without"), (panel.with_, _WITH, "with")):
        style = "." if len(drawn.x) < 12 else ""
        axes.plot(drawn.x, drawn.y, style + "-", color=colour, linewidth=width, label=name)
        low, high = drawn.y - 2 * drawn.error, drawn.y + 2 * drawn.error
        axes.fill_between(drawn.x, low, high, color=colour, alpha=0.2, linewidth=0)
    if "x" in panel.with_.curve.log:
        axes.set_xscale("log")
    if "y" in panel.with_.curve.log:
        axes.set_yscale("log")
        return
    low, high = (edge([edge(panel.with_.y), edge(panel.without.y)]) for edge in (np.nanmin, np.nanmax))
    if 0 <= low < high / 2:
        axes.set_ylim(bottom=0)
    if panel.with_.curve.y[1] == "1/s":
        axes.yaxis.set_major_formatter(EngFormatter(sep=" "))


def _maps(panel: Panel, figure: Any) -> None:
    high = max(panel.with_.y.max(), panel.without.y.max())
    axes = figure.subplots(1, 2)
    for one, drawn, name in zip(axes, (panel.without, panel.with_), ("without", "with"), strict=True):
        shown = one.imshow(_grid(drawn.y), cmap="viridis", vmin=0, vmax=high)
        one.set_title(name, fontsize=9)
        one.set_xlabel(_label(drawn.curve.x), fontsize=9)
        one.set_ylabel(_label(drawn.curve.y), fontsize=9)
        one.tick_params(labelsize=8)
    bar = figure.colorbar(shown, ax=list(axes), format=EngFormatter(sep=" "))
    bar.set_label("rate of a pixel (1/s)", fontsize=9)
    bar.ax.tick_params(labelsize=8)


def _grid(values_: np.ndarray) -> np.ndarray:
    side = round(len(values_) ** 0.5)
    return values_.reshape(side, -1)


def _label(axis: tuple[str, str]) -> str:
    return f"{axis[0]} ({axis[1]})" if axis[1] else axis[0]


def _wrapped(text: str, width: int) -> str:
    return "\n".join(textwrap.wrap(text, width))


def _png(figure: Figure, about: dict[str, str]) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=100, metadata={**about, "Software": None})
    return out.getvalue()
