"""The odd pixels of a fitted map: the map as a picture, and hot and lazy pixels as a CSV file next to the page."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .. import disk, units
from ..effects import Effect
from ..errors import SpadError
from ..inference.pixel_maps import odd_pixels
from ..inference.results import Diagnosis, Step, title
from . import _figures as figures
from ._figures import WIDTH, Picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LISTED = 40  # odd pixels in the page; the file has all
_FILE = "odd_pixels-{}.csv"  # the list of a map, by the name of its step
_HEAD = ("row", "column", "value", "unit", "relative_to_median", "relative_to_reference", "kind")
_EARLIER = ",".join(_HEAD[:5])  # how lists begin, those of earlier versions included
_HIGH, _LOW = "high", "low"


@dataclass(frozen=True)
class OddPixel:
    """where: of the pixel; value: with its unit; ratio: to what it is compared with; kind: "high" or "low"."""

    where: str
    value: str
    ratio: float
    kind: str


@dataclass(frozen=True)
class OddPixels:
    """The odd pixels of a map, the oddest first.

    table: what the file holds; number: of the odd ones; figure: the picture as a matplotlib figure.
    """

    file: str
    picture: Picture
    sentence: str
    number: int
    rows: Sequence[OddPixel]
    table: Sequence[tuple[object, ...]]
    figure: Callable[[], Figure]


def odd_pixels_of(found: Diagnosis, step: Step) -> OddPixels | None:
    """The odd pixels of a step that is a map of pixels, None of any other step."""
    fitted, carrier, shape = step.map, step.candidate.carrier, found.shape
    if step.candidate.kind != "per_pixel" or fitted is None or carrier is None or shape is None:
        return None
    values = np.ravel(fitted.values())  # the best estimate of each, which the sensor file lets differ more
    if values.size != shape[0] * shape[1] or not np.isfinite(values).all():
        return None
    low, high = odd_pixels(fitted)
    if low.size != values.size:
        return None
    unit = Effect.registry.find(carrier[0]).parameters[carrier[1]].unit if carrier[0] in Effect.registry else ""
    middle = float(np.median(values))
    ratios = values / middle if middle > 0 else np.full(values.size, np.nan)
    near = np.exp(fitted.estimate - fitted.odd[2])  # relative to all, or to the pixels around it
    odd = np.flatnonzero(low | high)
    odd = odd[np.argsort(-np.abs(np.log(np.maximum(near[odd], 1e-9))), kind="stable")]
    table = [
        (
            int(k // shape[1]),
            int(k % shape[1]),
            float(f"{values[k]:.6g}"),
            unit,
            float(f"{ratios[k]:.5g}"),
            float(f"{near[k]:.5g}"),
            _HIGH if high[k] else _LOW,
        )
        for k in odd
    ]
    rows = [
        OddPixel(f"row {row}, column {column}", _shown(value, unit), ratio, kind)
        for row, column, value, _, _, ratio, kind in table[:_LISTED]
    ]
    name = title(step.candidate).removesuffix(" per pixel")
    words = f"Map of {name}: the fitted value of each pixel, relative to the median"
    drawing = ratios.reshape(shape), _shown(middle, unit), odd
    picture = Picture(figures.drawn(_draw_map, *drawing), words)
    sentence = (
        f"{int(high.sum())} of {values.size:,} pixels lie far above the others, or those around them, "
        f"and {int(low.sum())} far below; the median is {_shown(middle, unit)}."
    )
    file = _FILE.format(re.sub(r"[^a-z0-9_]+", "-", name.lower()))
    return OddPixels(file, picture, sentence, odd.size, rows, table, partial(figures.figure_by, _draw_map, *drawing))


def write_lists(maps: Collection[OddPixels], folder: Path) -> None:
    """Write the odd pixels of each map as a CSV file; those of an earlier page are removed.

    Raises:
        SpadError: where another file has the name of one.
    """
    for odd in maps:
        path, text = Path(folder) / odd.file, io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(_HEAD)
        writer.writerows(odd.table)
        if (path.is_symlink() or path.exists()) and not _is_list(path):
            raise SpadError(
                f"{path} is there already and is not a list of odd pixels; it is left alone: choose another -o"
            )
        disk.put_file(path, text.getvalue().encode())
    written = {odd.file for odd in maps}
    for path in Path(folder).glob(_FILE.format("*")):
        if path.name not in written and _is_list(path):
            path.unlink()


def _is_list(path: Path) -> bool:
    """Whether a file is a list of odd pixels."""
    return path.is_file() and not path.is_symlink() and disk.read_file(path, 1 << 30).startswith(_EARLIER.encode())


def _shown(value: float, unit: str) -> str:
    return units.show(value, unit, 4) if unit and units.is_known(unit) else f"{value:.4g}"


def _draw_map(figure: Figure, ratios: np.ndarray, middle: str, odd: np.ndarray) -> None:
    """The map relative to its median, on a logarithmic scale, the odd pixels ringed; a line of pixels as dots."""
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import FuncFormatter

    rows, columns = ratios.shape
    positive = np.maximum(np.nan_to_num(ratios, nan=1.0), 1e-3)
    if min(rows, columns) == 1:
        figure.set_size_inches(WIDTH, 2.8)
        axes = figure.subplots()
        line = positive.ravel()
        axes.plot(np.arange(line.size), line, "o", color=figures.MEASURED, markersize=3, label="fitted value")
        axes.plot(odd, line[odd], "o", color=figures.WORST, markersize=7, markerfacecolor="none", label="odd pixel")
        axes.set_yscale("log")
        figures.powers(axes.yaxis)
        axes.set_xlabel("pixel")
        axes.set_ylabel(f"value / median ({middle})")
        axes.grid(axis="y")
        figures.legend(axes)
        return
    span = float(np.clip(np.quantile(np.abs(np.log(positive)), 0.995), np.log(1.02), np.log(100)))
    figure.set_size_inches(WIDTH, min(5.2, 0.9 + 4.2 * max(0.35, rows / columns)))
    axes = figure.subplots()
    image = axes.imshow(
        positive,
        cmap=colormaps["PuOr_r"],
        norm=LogNorm(np.exp(-span), np.exp(span)),
        aspect="auto" if max(rows, columns) > 4 * min(rows, columns) else "equal",
        interpolation="none",
    )
    bar = figure.colorbar(image, ax=axes, extend="both", shrink=0.92, pad=0.02)
    bar.set_ticks(np.exp(np.linspace(-span, span, 5)).tolist())
    bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    bar.ax.minorticks_off()
    bar.outline.set_visible(False)
    bar.set_label(f"value / median ({middle})")
    if odd.size and odd.size <= _LISTED:
        axes.plot(odd % columns, odd // columns, "o", markersize=9, markerfacecolor="none", color=figures.WORST)
    axes.set_xlabel("column")
    axes.set_ylabel("row")
    axes.locator_params(integer=True)
