"""The pictures of pages: what was measured beside what a model expects, as images that a page holds in itself."""

from __future__ import annotations

import base64
import io
import math
import re
import textwrap
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import units
from ..foreign import visible
from ..statistics import Statistic, Summary
from ._frame import SUPERSCRIPT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 9.6  # inches; a page is as wide
_DPI = 150
MEASURED, MODEL, BAND, WORST = "#1d2329", "#2f6ea5", "#bcd6ec", "#c0392b"
BEFORE = "#d98a1f"  # an earlier model
ROUGH, SMOOTH = "#5b6670", "#e3e6e8"
_FEW_CELLS = 40  # without an axis, up to here each with its own words
_POINTS = 150  # more cells are drawn as steps
_VECTOR = 400  # more cells are drawn in points of the screen
_STEPS = 1500  # still more are a cloud of dots
_DRAWN = 100_000
_LARGEST_MAP = 192
_NOTHING = -1e3  # the logarithm of none measured: beyond every scale
COVERED = 1.96  # sigmas to either side: 95 %
OWN = "95 % of its own scatter"

_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "spadmnist",
    "text.parse_math": False,
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": ROUGH,
    "axes.labelcolor": MEASURED,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-4, 5),
    "xtick.color": ROUGH,
    "ytick.color": ROUGH,
    "grid.color": SMOOTH,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}


@dataclass(frozen=True)
class Picture:
    """source: a data URI; note: what a reader needs to know beside the general words on pictures."""

    source: str
    alternative: str
    note: str = ""


@dataclass(frozen=True)
class Cells:
    """A summary beside what a model expects: (cells,) each, finite. worst: the clearest cell.

    before, earlier: what an earlier model expected, and its residuals, where two models are set side by side.
    """

    statistic: str
    summary: Summary
    expected: np.ndarray
    spread: np.ndarray
    residuals: np.ndarray
    worst: int
    before: np.ndarray | None = None
    earlier: np.ndarray | None = None

    @property
    def measured(self) -> np.ndarray:
        """(cells,) what was found."""
        return finite(self.summary.values)

    @property
    def models(self) -> list[np.ndarray]:
        """(cells,) what each model expects, the last one first."""
        return [self.expected] if self.before is None else [self.expected, self.before]


def finite(values: np.ndarray) -> np.ndarray:
    """(cells,) without what cannot be drawn."""
    return np.nan_to_num(np.asarray(values, np.float64), nan=0.0, posinf=1e300, neginf=-1e300).ravel()


def drawn(draw: Any, *arguments: Any, raster: bool = False) -> str:
    """The data URI of a figure that a function draws: the same for the same, whatever the user's settings."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    buffer = io.BytesIO()
    # letters that the font lacks are the reader's browser's to find, or boxes: nothing to warn of
    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        figure = Figure(dpi=_DPI, facecolor="white")
        draw(figure, *arguments)
        if raster:
            FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None, "Creation Time": None})
        else:
            FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
    kind = "png" if raster else "svg+xml"
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def picture(cells: Cells, words: str) -> Picture:
    """Measured beside simulated, cell by cell, and how far they are apart; words: for who cannot see it."""
    draw, n, note = _drawing(cells.summary), cells.summary.values.size, ""
    if draw is _draw_maps:
        factor = _merged(cells.summary.shape or (1, 1))
        note = f"Each point stands for {factor} x {factor} pixels, by the most deviating of them." if factor > 1 else ""
    elif draw is _draw_series and n > _DRAWN:
        note = f"Of {n:,} cells {_DRAWN:,} are drawn, evenly spread, those that deviate most among them."
    return Picture(drawn(draw, cells, raster=draw is _draw_series and n > _VECTOR), words, note)


def figure_of(cells: Cells) -> Figure:
    """The same drawing as a matplotlib figure, in the style of the pages, for a notebook or a paper."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        figure = Figure(facecolor="white")
        _drawing(cells.summary)(figure, cells)
        return figure


def _drawing(summary: Summary) -> Callable[[Figure, Cells], None]:
    """How a summary is drawn: as maps, by the names of its cells, or along its axis."""
    shape = summary.shape
    if shape is not None and min(shape) > 1 and math.prod(shape) == summary.values.size:
        return _draw_maps
    return _draw_named if _axis_of(summary)[0] is None else _draw_series


def _axis_of(summary: Summary) -> tuple[np.ndarray | None, str, bool]:
    """(what is on the horizontal axis, its label, whether it is logarithmic); None where cells have names instead."""
    n = summary.values.size
    axis = summary.axis
    usable = axis is not None and np.shape(axis) == (n,) and n > 1 and bool(np.isfinite(axis).all())
    if usable and axis is not None:
        rising = np.diff(axis)
        if (rising > 0).all() or (rising < 0).all():
            return np.asarray(axis, np.float64), visible(summary.label), summary.log and bool((axis > 0).all())
    if n <= _FEW_CELLS:
        return None, "", False
    return np.arange(n, dtype=np.float64), f"cell, 0 to {n - 1}", False


def _edges(axis: np.ndarray, log: bool) -> np.ndarray:
    """(cells + 1,) where the cell about each point ends, half-way to the next one."""
    x = np.log(axis) if log else axis
    middle = (x[1:] + x[:-1]) / 2
    edges = np.concatenate([[2 * x[0] - middle[0]], middle, [2 * x[-1] - middle[-1]]])
    return np.exp(edges) if log else edges


def _band(law: str, expected: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Between which values 95 % of the model's own recordings lie."""
    if law == "exponential":
        return -math.log(0.975) * expected, -math.log(0.025) * expected
    low, high = expected - COVERED * spread, expected + COVERED * spread
    return (np.maximum(low, 0.0), high) if law == "poisson" else (low, high)


def _logarithmic(law: str, both: np.ndarray) -> bool:
    """Do the values span so much that only powers of ten show them all?"""
    positive = both[both > 0]
    if not positive.size or (both < 0).any() or (law == "normal" and positive.size < both.size):
        return False
    return float(positive.max()) > (1000 if law == "normal" else 100) * float(positive.min())


def _draw_series(figure: Figure, cells: Cells) -> None:
    """Cells along an axis: measured and simulated above, residuals below."""
    axis, label, log = _axis_of(cells.summary)
    assert axis is not None
    law, measured, worst = cells.summary.law, cells.measured, cells.worst
    clearest = cells.residuals if cells.earlier is None else cells.earlier
    at_worst = (axis[worst], measured[worst], clearest[worst])
    some = np.argsort(axis)  # from left to right
    if axis.size > _DRAWN:
        some = some[_thinned(clearest[some], _DRAWN)]
    axis, measured, spread = axis[some], measured[some], cells.spread[some]
    models = [expected[some] for expected in cells.models]
    residuals = [z[some] for z in (cells.residuals, cells.earlier) if z is not None]
    edges = _edges(axis, log)
    exact = law == "exact"
    figure.set_size_inches(WIDTH, 2.6 if exact else 3.9)
    heights = [1.0] if exact else [2.1, 1.0]
    panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    upper, last = panels[0], panels[-1]

    floor = _value_scale(upper, law, measured, np.concatenate(models))
    low, high = (np.maximum(values, floor) for values in _band(law, models[0], spread))
    shown = np.maximum(measured, floor)
    even = np.linspace(0, axis.size - 1, min(axis.size, _STEPS)).astype(np.int64)
    steps = axis.size <= _STEPS
    if not exact and steps:
        upper.stairs(high, edges, baseline=low, fill=True, color=BAND, label=OWN)
    elif not exact:
        upper.fill_between(axis[even], low[even], high[even], color=BAND, linewidth=0, label=OWN)
    for expected, line in reversed(list(zip(models, _lines(cells), strict=True))):
        if steps:
            upper.stairs(np.maximum(expected, floor), edges, baseline=None, **line)
        else:
            upper.plot(axis[even], np.maximum(expected, floor)[even], zorder=4, **line)
    if axis.size <= _POINTS:
        there = measured >= floor
        upper.plot(axis[there], shown[there], "o", color=MEASURED, markersize=3.2, label="measured", zorder=3)
        if not there.all():
            style: dict[str, Any] = {"color": MEASURED, "markersize": 4, "zorder": 3, "clip_on": False}
            upper.plot(axis[~there], shown[~there], "v", label="measured, below the scale", **style)
    elif steps:
        upper.stairs(shown, edges, baseline=None, color=MEASURED, linewidth=0.7, label="measured", zorder=3)
    else:
        upper.plot(axis, shown, "o", color=MEASURED, markersize=1.1, markeredgewidth=0, zorder=3)
        upper.plot([], [], "o", color=MEASURED, markersize=3.2, label="measured")
    _ring(upper, at_worst[0], max(at_worst[1], floor), label="clearest")
    upper.set_ylabel(_unit_of(cells))
    upper.use_sticky_edges = False
    upper.margins(y=0.06)
    upper.grid(axis="y")
    upper.set_axisbelow(True)
    legend(upper)

    if not exact:
        for z, colour in reversed(list(zip(residuals, (MEASURED, BEFORE), strict=False))):
            if axis.size <= _POINTS:
                last.vlines(axis, 0, z, color=ROUGH if colour == MEASURED else colour, linewidth=1.0)
            last.plot(axis, z, "o", color=colour, markeredgewidth=0, markersize=_dot(axis.size))
        _ring(last, at_worst[0], at_worst[2])
        _residual_scale(last, np.concatenate(residuals))
    last.set_xlim(edges[0], edges[-1])
    if log:
        last.set_xscale("log")
    _horizontal(last, label, log)


def _lines(cells: Cells) -> list[dict[str, Any]]:
    """How each model's line looks, the last one first."""
    if cells.before is None:
        return [{"color": MODEL, "linewidth": 1.2, "label": "simulated"}]
    return [
        {"color": MODEL, "linewidth": 1.4, "label": "model after"},
        {"color": BEFORE, "linewidth": 1.4, "label": "model before"},
    ]


def _dot(cells: int) -> float:
    return 3.6 if cells <= _POINTS else 1.8 if cells <= _STEPS else 1.1


def _ring(axes: Axes, x: float, y: float, size: float = 9.0, label: str | None = None) -> None:
    """Where it is clearest."""
    axes.plot([x], [y], "o", markersize=size, markerfacecolor="none", color=WORST, label=label, zorder=5, clip_on=False)


def _thinned(residuals: np.ndarray, most: int) -> np.ndarray:
    """Which cells are drawn of too many: evenly spread ones, and those few that deviate most."""
    deviating = np.argsort(-np.abs(residuals), kind="stable")[: most // 100]
    even = np.linspace(0, residuals.size - 1, most - most // 100).astype(np.int64)
    return np.union1d(deviating, even)


def _draw_named(figure: Figure, cells: Cells) -> None:
    """Cells without an axis, each with its own words: measured and simulated to the left, residuals to the right."""
    law, measured, worst = cells.summary.law, cells.measured, cells.worst
    names = ["\n".join(textwrap.wrap(shortened(_where(cells.summary, k), 128), 64)) for k in range(measured.size)]
    heights = np.array([0.1 + 0.13 * (name.count("\n") + 1) for name in names])  # inches
    rows = np.cumsum(heights) - heights / 2
    exact = law == "exact"
    figure.set_size_inches(WIDTH, 1.0 + heights.sum())
    widths = [1.0] if exact else [1.5, 1.0]
    panels = figure.subplots(1, len(widths), sharey=True, width_ratios=widths, squeeze=False)[0]
    left, right = panels[0], panels[-1]

    floor = _value_scale(left, law, measured, np.concatenate(cells.models), vertical=False)
    low, high, shown = (np.maximum(x, floor) for x in (*_band(law, cells.expected, cells.spread), measured))
    if not exact:
        left.barh(rows, high - low, left=low, height=0.15, color=BAND, label=OWN)
    for expected, line in reversed(list(zip(cells.models, _lines(cells), strict=True))):
        left.vlines(np.maximum(expected, floor), rows - 0.075, rows + 0.075, **{**line, "linewidth": 1.6})
    left.plot(shown, rows, "o", color=MEASURED, markersize=4.5, label="measured", zorder=3, clip_on=False)
    _ring(left, shown[worst], rows[worst], 10.0, "clearest")
    left.set_yticks(rows, names, fontsize=8.2)
    left.set_ylim(heights.sum(), 0)
    left.set_xlabel(_unit_of(cells))
    left.grid(axis="x")
    left.set_axisbelow(True)
    left.use_sticky_edges = False
    left.margins(x=0.06)
    legend(left)
    if not exact:
        residuals = [z for z in (cells.residuals, cells.earlier) if z is not None]
        for z, colour in reversed(list(zip(residuals, (MEASURED, BEFORE), strict=False))):
            right.hlines(rows, 0, z, color=ROUGH if colour == MEASURED else colour, linewidth=1.2)
            right.plot(z, rows, "o", color=colour, markersize=4.5)
        _ring(right, residuals[-1][worst], rows[worst], 10.0)
        right.tick_params(axis="y", length=0)
        _residual_scale(right, np.concatenate(residuals), vertical=False)


def _draw_maps(figure: Figure, cells: Cells) -> None:
    """Measured over simulated (or measured, where a ratio says nothing), and residuals, pixel by pixel.

    Of two models: the ratios above, the residuals below, the earlier one to the left.
    """
    from matplotlib import colormaps
    from matplotlib.colors import Normalize
    from matplotlib.ticker import FuncFormatter

    measured, worst = cells.measured, cells.worst
    shape = cells.summary.shape
    assert shape is not None
    rows, columns = shape
    counts = cells.summary.law in ("poisson", "exponential") and bool((measured >= 0).all())
    ratios = [_log_ratio(measured, m) for m in reversed(cells.models)] if counts and cells.expected.any() else []
    residuals = [z for z in (cells.earlier, cells.residuals) if z is not None]
    two = len(residuals) > 1
    panels: list[tuple[np.ndarray, tuple[float, float], str, str]] = []
    if ratios:
        usual = np.abs(ratios[0][np.isfinite(ratios[0]) & (ratios[0] > _NOTHING)])
        high = float(np.clip(np.quantile(usual, 0.99) if usual.size else 0.0, math.log(1.002), math.log(100)))
        titles = ("measured / model before", "measured / model after") if two else ("measured / simulated",)
        panels += [(ratio, (-high, high), title, "PuOr_r") for ratio, title in zip(ratios, titles, strict=True)]
    elif not two:
        low, high = (float(value) for value in np.quantile(measured, [0.005, 0.995]))
        low, high = (low, high) if high > low else (low - 1.0, high + 1.0)
        panels += [(measured, (low, high), f"measured, {_unit_of(cells)}".removesuffix(", value"), "viridis")]
    deviation = float(np.clip(np.quantile(np.abs(residuals[0]), 0.995), 4.0, 40.0))
    titles = ("residuals before, sigmas", "residuals after, sigmas") if two else ("residuals, sigmas",)
    panels += [(z, (-deviation, deviation), title, "RdBu_r") for z, title in zip(residuals, titles, strict=True)]
    factor = _merged(shape)
    tall = 2.2 if columns > 4 * rows else min(4.6, 0.9 + 3.6 * max(0.35, rows / columns))
    figure.set_size_inches(WIDTH, tall * len(panels) / 2)
    drawn_on = figure.subplots(len(panels) // 2, 2, sharex=True, sharey=True, squeeze=False)
    for panel, (values, span, words, colours) in zip(drawn_on.ravel(), panels, strict=True):
        image = panel.imshow(
            _enlarged(_largest_of(values.reshape(rows, columns), factor)),
            cmap=colormaps[colours].with_extremes(bad=SMOOTH),
            norm=Normalize(*span),
            extent=(-0.5, columns - 0.5, rows - 0.5, -0.5),
            aspect="auto" if max(rows, columns) > 4 * min(rows, columns) else "equal",
            interpolation="none",
        )
        written = FuncFormatter(lambda value, _: f"{math.exp(value):.3g}") if colours == "PuOr_r" else None
        bar = figure.colorbar(image, ax=panel, extend="both", shrink=0.92, pad=0.02, format=written)
        if written is not None:
            bar.set_ticks(np.linspace(*span, 5).tolist())
        bar.outline.set_visible(False)
        panel.set_title(words, fontsize=9.5)
        for colour, width in (("white", 3.0), ("black", 1.3)):  # on light and dark
            place = [worst % columns], [worst // columns]
            ring: dict[str, Any] = {"markersize": 12, "markerfacecolor": "none", "clip_on": False}
            panel.plot(*place, "o", markeredgecolor=colour, markeredgewidth=width, **ring)
        panel.tick_params(length=2)
        panel.xaxis.get_major_locator().set_params(integer=True)
        panel.yaxis.get_major_locator().set_params(integer=True)
    for panel in drawn_on[-1]:
        panel.set_xlabel("column")
    for panel in drawn_on[:, 0]:
        panel.set_ylabel("row")


def _log_ratio(measured: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """(cells,) logarithm of measured over expected; not a number where nothing is expected."""
    with np.errstate(all="ignore"):
        ratio = np.log(measured / np.where(expected > 0, expected, np.nan))
    return np.where(np.isneginf(ratio), _NOTHING, ratio)


def _enlarged(picture: np.ndarray) -> np.ndarray:
    """Many points for each of few, so that a printer that smooths pictures leaves them sharp."""
    times = max(1, 2 * _LARGEST_MAP // max(picture.shape))
    return picture.repeat(times, axis=0).repeat(times, axis=1)


def _merged(shape: tuple[int, int]) -> int:
    """How many pixels a point of a map stands for, along each side."""
    return -(-max(shape) // _LARGEST_MAP)


def _largest_of(values: np.ndarray, factor: int) -> np.ndarray:
    """A map by squares of factor x factor pixels, each with the value furthest from 0: one odd pixel still shows."""
    for axis in (0, 1) if factor > 1 else ():
        filled = np.nan_to_num(values)
        starts = np.arange(0, values.shape[axis], factor)
        high, low = np.maximum.reduceat(filled, starts, axis), np.minimum.reduceat(filled, starts, axis)
        values = np.where(high >= -low, high, low)
    return values


def legend(axes: Axes) -> None:
    """Above the picture, what is measured first."""
    handles, labels = axes.get_legend_handles_labels()
    first = ("measured", "found", "model before", "simulated", "model after", OWN)
    entries = sorted(
        zip(labels, handles, strict=True),
        key=lambda entry: next((k for k, word in enumerate(first) if entry[0].startswith(word)), len(first)),
    )
    axes.legend(
        [handle for _, handle in entries],
        [label for label, _ in entries],
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=len(entries),
        borderaxespad=0.1,
        handlelength=1.4,
        columnspacing=1.4,
    )


def _value_scale(axes: Axes, law: str, measured: np.ndarray, expected: np.ndarray, vertical: bool = True) -> float:
    """Set the scale of the values; below what nothing can be drawn."""
    both = np.concatenate([measured, expected])
    if not _logarithmic(law, both):
        return -math.inf
    least = float(expected.min()) / 50 if law == "exponential" else 0.0  # chance makes some as small as you like
    floor = max(float(both[both > 0].min()), float(both.max()) * 1e-9, least) / 2
    (axes.set_yscale if vertical else axes.set_xscale)("log")
    (axes.set_ylim if vertical else axes.set_xlim)(floor * 0.9, float(both.max()) * 2)
    powers(axes.yaxis if vertical else axes.xaxis)
    return floor


def _residual_scale(axes: Axes, residuals: np.ndarray, vertical: bool = True) -> None:
    """Sigmas about 0, with what a right model hardly exceeds; large ones are pressed together."""
    largest = float(np.abs(residuals).max())
    low, high = (1.2 * max(4.0, float(side.max())) for side in (-residuals, residuals))
    span, line = (axes.axhspan, axes.axhline) if vertical else (axes.axvspan, axes.axvline)
    span(-COVERED, COVERED, color=BAND, linewidth=0, zorder=0)
    line(0, color=MODEL, linewidth=1.2, zorder=1)
    if largest > 25:
        (axes.set_yscale if vertical else axes.set_xscale)("symlog", linthresh=10)
        powers = [10.0**k for k in range(1, 301)] if largest > 90 else [10.0, 30.0]
        inside = [power for power in powers if power <= max(low, high)]
        inside = inside[:: -(-len(inside) // 3)]
        marks = [m for m in (*(-power for power in reversed(inside)), 0.0, *inside) if -low <= m <= high]
        set_marks = axes.set_yticks if vertical else axes.set_xticks
        set_marks(marks, [f"{'−' if m < 0 else ''}{_power(abs(m))}" for m in marks])
        set_marks([], minor=True)
        low, high = (1.3 * side if side > 10 else side for side in (low, high))
    (axes.set_ylim if vertical else axes.set_xlim)(-low, high)
    (axes.set_ylabel if vertical else axes.set_xlabel)("residual, sigmas")


def _horizontal(axes: Axes, label: str, log: bool) -> None:
    """The horizontal axis with its label; times and the like as 10 ns, 1 us."""
    from matplotlib.ticker import EngFormatter, FuncFormatter, NullFormatter

    known = re.fullmatch(r"(.*?)(?:,\s*|\s*\()(s|Hz|m)\)?", label)
    if known is not None:
        label, unit = known[1], known[2]
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: units.show(x, unit, 3) if x else "0"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        if unit == "m":
            axes.xaxis.set_major_formatter(EngFormatter(unit))
    elif log:
        powers(axes.xaxis)
    axes.set_xlabel(shortened(label, 100))


def powers(axis: Any) -> None:
    """Ticks as powers of ten."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axis.set_major_formatter(FuncFormatter(lambda value, _: _power(value)))
    axis.set_minor_formatter(NullFormatter())


def _power(value: float) -> str:
    """A round number; large and small ones as a power of ten."""
    if value == 0 or 1e-3 <= value < 1e5:
        return f"{value:g}"
    mantissa, exponent = f"{value:.0e}".split("e")
    power = f"10{str(int(exponent)).translate(SUPERSCRIPT)}"
    return power if mantissa == "1" else f"{mantissa}·{power}"


def _unit_of(cells: Cells) -> str:
    """What is on the axis of the values."""
    try:
        unit = Statistic.registry.find(cells.statistic).unit
    except KeyError:
        unit = "1"
    if unit != "1":
        return shortened(unit, 40)
    return {"poisson": "count", "exponential": "power"}.get(cells.summary.law, "value")


def _where(summary: Summary, cell: int) -> str:
    try:
        return str(summary.where(cell))
    except Exception:  # of a user's own statistic: the page is worth more than one name
        return f"cell {cell}"


def shortened(text: str, most: int) -> str:
    """Text without its middle where it is too long for a picture; the page has it whole."""
    text = visible(text)
    return text if len(text) <= most else f"{text[: (most - 1) // 2]}…{text[-(most // 2) :]}"
