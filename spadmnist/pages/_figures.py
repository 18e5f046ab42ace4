"""The pictures of pages: the measured data and what a model expects, as images that a page holds in itself."""

from __future__ import annotations

import base64
import io
import math
import re
import textwrap
import warnings
from collections.abc import Callable, Sequence
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
OTHERS = ("#7a5ea8", "#3b8a7a", "#a8577e", "#7d7433")  # further captures
ROUGH, SMOOTH = "#5b6670", "#e3e6e8"
_FEW_CELLS = 400  # without an axis, up to here each with its own words
_POINTS = 150  # more cells are drawn as steps
_ZOOMED = 70  # more cells are drawn about the clearest one, with all residuals in a strip below
_SIDE = 25  # cells to either side of the clearest one
_NAMES = 16  # cells with words of their own, about the clearest one
_VECTOR = 1500  # more cells are drawn in points of the screen
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
    "axes.facecolor": "none",
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
    """source: a data URI; note: what a reader needs to know in addition to the general words on pictures."""

    source: str
    alternative: str
    note: str = ""


@dataclass(frozen=True)
class Cells:
    """A summary and what a model expects: (cells,) each, finite. worst: the clearest cell.

    before, earlier: what an earlier model expected, and its residuals, where two models are compared.
    overlaid: the same statistic of further captures, of which the residuals are drawn, by name.
    """

    statistic: str
    summary: Summary
    expected: np.ndarray
    spread: np.ndarray
    residuals: np.ndarray
    worst: int
    before: np.ndarray | None = None
    earlier: np.ndarray | None = None
    overlaid: tuple[tuple[str, Cells], ...] = ()
    name: str = ""  # of the capture

    @property
    def clearest(self) -> np.ndarray:
        """(cells,) residuals of the first model."""
        return self.residuals if self.earlier is None else self.earlier

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
        figure = Figure(dpi=_DPI, facecolor="none")  # the page is behind it, light or dark
        draw(figure, *arguments)
        if raster:
            FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None, "Creation Time": None})
        else:
            FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
    kind = "png" if raster else "svg+xml"
    data = buffer.getvalue() if raster else _numbered(buffer.getvalue())
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def _numbered(svg: bytes) -> bytes:
    """The drawing with its names counted: as matplotlib gives them they depend on the last digit of a layout."""
    numbers: dict[bytes, bytes] = {}

    def number(name: re.Match[bytes]) -> bytes:
        return name[1] + numbers.setdefault(name[2], b"%b%d" % (name[2][:1], len(numbers)))

    return re.sub(rb'(\bid="|"url\(#|"#)([a-z][0-9a-f]{10})(?=["\)])', number, svg)


def picture(cells: Cells, words: str) -> Picture:
    """Measured and simulated, cell by cell, and the residuals; words: for who cannot see it."""
    draw, n, note = _drawing(cells.summary), cells.summary.values.size, ""
    if draw is _draw_maps:
        factor = _merged(cells.summary.shape or (1, 1))
        note = f"Each point stands for {factor} x {factor} pixels, by the most deviating of them." if factor > 1 else ""
    elif draw is _draw_series and n > _ZOOMED:
        note = f"The clearest place of {n:,} cells; the strip below has the residuals of "
        note += "all." if n <= _DRAWN else f"{_DRAWN:,}, evenly spread, those that deviate most among them."
    elif draw is _draw_named and n > _NAMES:
        note = f"The {_NAMES} cells about the clearest of {n}."
    return Picture(drawn(draw, cells), words, note)


def figure_of(cells: Cells) -> Figure:
    """The same drawing as a matplotlib figure, in the style of the pages, for a notebook or a paper."""
    return figure_by(_drawing(cells.summary), cells)


def figure_by(draw: Callable[..., None], *arguments: Any) -> Figure:
    """What `draw(figure, *arguments)` draws, as a matplotlib figure in the style of the pages."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        figure = Figure(facecolor="white")
        draw(figure, *arguments)
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
    """Cells along an axis about the clearest one: measured and simulated, residuals; of many, all residuals below."""
    axis, label, log = _axis_of(cells.summary)
    assert axis is not None
    order = np.argsort(axis)  # from left to right
    edges = _edges(axis[order], log)
    at = int(np.flatnonzero(order == cells.worst)[0])
    low, high = 0, axis.size
    zoomed = axis.size > _ZOOMED
    if zoomed:
        low = min(max(at - _SIDE, 0), axis.size - 2 * _SIDE - 1)
        high = low + 2 * _SIDE + 1
    shown, ends = order[low:high], edges[low : high + 1]
    exact = cells.summary.law == "exact"
    heights = [1.0] if exact else [2.1, 1.1, 0.6] if zoomed else [2.1, 1.1]
    figure.set_size_inches(WIDTH, 2.6 if exact else 4.9 if zoomed else 4.1)
    panels = figure.subplots(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    _draw_values(panels[0], cells, axis, shown, ends)
    for panel in panels[: 1 if exact else 2]:
        panel.set_xlim(ends[0], ends[-1])
        if log:
            panel.set_xscale("log")
    if not exact:
        panels[0].tick_params(labelbottom=False)
        panels[0].tick_params(axis="x", which="minor", labelbottom=False)
        _draw_residuals(panels[1], cells, axis, shown)
    _horizontal(panels[0 if exact else 1], label, log)
    if zoomed and not exact:
        _draw_strip(panels[2], cells, axis[order], order, ends)
        if log:
            panels[2].set_xscale("log")
        _horizontal(panels[2], label, log)
    if not exact:
        panels[0].set_xlabel("")
        for tick in panels[0].get_xticklabels(which="both"):
            tick.set_visible(False)


def _draw_values(upper: Axes, cells: Cells, axis: np.ndarray, shown: np.ndarray, edges: np.ndarray) -> None:
    """What was measured and what the models expect in some cells, in the unit of the sentence where that has one."""
    law = cells.summary.law
    spread, models = cells.spread[shown], [expected[shown] for expected in cells.models]
    measured, (low, high) = cells.measured[shown], _band(law, models[0], spread)
    unit = _unit_of(cells)
    said = _as_said(cells, shown, [measured, *models, low, high])
    if said is not None:
        (measured, *models, low, high), unit = said
        law = "normal"
    floor = _value_scale(upper, law, measured, np.concatenate(models))
    low, high, drawn_at = (np.maximum(values, floor) for values in (low, high, measured))
    if law != "exact":
        upper.stairs(high, edges, baseline=low, fill=True, color=BAND, label=OWN)
    for expected, line in reversed(list(zip(models, _lines(cells), strict=True))):
        upper.stairs(np.maximum(expected, floor), edges, baseline=None, **line)
    there = measured >= floor
    name = f"measured, {shortened(cells.name, 30)}" if cells.overlaid and cells.name else "measured"
    upper.plot(axis[shown][there], drawn_at[there], "o", color=MEASURED, markersize=3.2, label=name, zorder=3)
    if not there.all():
        style: dict[str, Any] = {"color": MEASURED, "markersize": 4, "zorder": 3, "clip_on": False}
        upper.plot(axis[shown][~there], drawn_at[~there], "v", label="measured, below the scale", **style)
    _ring(upper, axis[cells.worst], float(drawn_at[shown == cells.worst][0]), label="clearest")
    upper.set_ylabel("\n".join(textwrap.wrap(unit, 26)))
    upper.use_sticky_edges = False
    upper.margins(y=0.06)
    upper.grid(axis="y")
    upper.set_axisbelow(True)
    legend(upper)


def _draw_residuals(lower: Axes, cells: Cells, axis: np.ndarray, shown: np.ndarray) -> None:
    """The residuals of some cells, those of further captures in colours, and what they are at the clearest place."""
    both = [(z[shown], c) for z, c in ((cells.residuals, MEASURED), (cells.earlier, BEFORE)) if z is not None]
    every = [z for z, _ in both]
    for (name, other), colour in zip(cells.overlaid, OTHERS, strict=False):
        there, _, _ = _axis_of(other.summary)
        if there is None:
            continue
        inside = (there >= axis[shown].min()) & (there <= axis[shown].max())
        values = other.clearest[inside]
        lower.plot(there[inside], values, "-", color=colour, linewidth=1.0, label=shortened(name, 30), zorder=2)
        every.append(values)
    for z, colour in reversed(both):
        lower.vlines(axis[shown], 0, z, color=ROUGH if colour == MEASURED else colour, linewidth=1.0)
        lower.plot(axis[shown], z, "o", color=colour, markeredgewidth=0, markersize=3.6)
    _ring(lower, axis[cells.worst], float(cells.clearest[cells.worst]))
    lower.set_title(_in_numbers(cells), loc="left", fontsize=9, color=MEASURED)
    if cells.overlaid:
        lower.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, borderaxespad=0.1, fontsize=8.5)
    _residual_scale(lower, np.concatenate(every))


def _in_numbers(cells: Cells) -> str:
    """The residual at the clearest place, of both models where there are two."""
    now = f"{float(cells.residuals[cells.worst]):+.1f} sigma"
    if cells.earlier is None:
        return f"residual at the ring: {now}"
    return f"residual at the ring: {float(cells.earlier[cells.worst]):+.1f} sigma before, {now} after"


def _draw_strip(strip: Axes, cells: Cells, axis: np.ndarray, order: np.ndarray, zoom: np.ndarray) -> None:
    """The residuals of all cells, and which of them are shown above."""
    clearest = cells.clearest[order]
    some = _thinned(clearest, _DRAWN) if axis.size > _DRAWN else np.arange(axis.size)
    strip.axvspan(zoom[0], zoom[-1], color=BAND, linewidth=0, zorder=0)
    for z, colour in (
        (cells.residuals[order], MEASURED),
        (clearest, BEFORE if cells.earlier is not None else MEASURED),
    ):
        strip.plot(
            axis[some],
            z[some],
            "o",
            color=colour,
            markersize=_dot(axis.size),
            markeredgewidth=0,
            rasterized=axis.size > _VECTOR,
        )
    strip.axhline(0, color=MODEL, linewidth=0.8)
    strip.margins(x=0.01)
    strip.set_ylabel("all, sigmas")


# "2.54 times that of a steady rate, 0.936 expected": what was found, its words, what was expected
_SAID = re.compile(
    r"([-+]?\d[\d.]*(?:e[-+]?\d+)?)( %)?([^,;\d]*), ([-+]?\d[\d.]*(?:e[-+]?\d+)?)( %)?( [a-z]+)? expected"
)


def _as_said(cells: Cells, shown: np.ndarray, values: Sequence[np.ndarray]) -> tuple[list[np.ndarray], str] | None:
    """(values in the numbers that the sentence of a check has, their unit); None where the cells are in it already.

    Scores, in standard deviations, are said in physical units; `Summary.size` has them in words.
    """
    if cells.summary.law != "normal":
        return None
    out, units = [], set()
    try:
        for number, some in enumerate(values):
            # what was found is said of the measurement; what a model expects stands behind it
            found = [
                _SAID.search(cells.summary.size(int(k), float(m), float(m if number == 0 else x))[0])
                for k, x, m in zip(shown, some, cells.measured[shown], strict=True)
            ]
            if not all(found):
                return None
            out.append(np.array([float(one[1 if number == 0 else 4]) for one in found if one]))
            units |= {f"{one[2] or ''}{one[3]}".strip() for one in found if one}
            # of two units the numbers are on no common scale: "980 ns, 1.02 us expected"
            if len(units) > 1 or any(one[2] != one[5] or (one[6] or one[3]) != one[3] for one in found if one):
                return None
    except Exception:  # of a user's own statistic: the page is worth more than one scale
        return None
    (unit,) = units
    return (out, shortened(unit, 60)) if np.isfinite(np.concatenate(out)).all() else None


def _lines(cells: Cells) -> list[dict[str, Any]]:
    """How each model's line looks, the last one first."""
    if cells.before is None:
        return [{"color": MODEL, "linewidth": 1.2, "label": "simulated"}]
    return [
        {"color": MODEL, "linewidth": 1.4, "label": "model after"},
        {"color": BEFORE, "linewidth": 1.4, "label": "model before"},
    ]


def _dot(cells: int) -> float:
    return 3.0 if cells <= _POINTS else 1.8 if cells <= _VECTOR else 1.1


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
    law, worst, n = cells.summary.law, cells.worst, cells.measured.size
    first = min(max(worst - _NAMES // 2, 0), max(n - _NAMES, 0))
    shown = np.arange(first, min(first + _NAMES, n))
    names = ["\n".join(textwrap.wrap(shortened(_where(cells.summary, int(k)), 128), 64)) for k in shown]
    heights = np.array([0.1 + 0.13 * (name.count("\n") + 1) for name in names])  # inches
    rows = np.cumsum(heights) - heights / 2
    here = int(np.flatnonzero(shown == worst)[0])
    exact = law == "exact"
    figure.set_size_inches(WIDTH, 1.15 + heights.sum())
    widths = [1.0] if exact else [1.5, 1.0]
    panels = figure.subplots(1, len(widths), sharey=True, width_ratios=widths, squeeze=False)[0]
    left, right = panels[0], panels[-1]

    measured, models, unit = cells.measured[shown], [model[shown] for model in cells.models], _unit_of(cells)
    low, high = _band(law, models[0], cells.spread[shown])
    said = _as_said(cells, shown, [measured, *models, low, high])
    if said is not None:
        (measured, *models, low, high), unit = said
    floor = _value_scale(left, law, measured, np.concatenate(models), vertical=False)
    low, high, values = (np.maximum(x, floor) for x in (low, high, measured))
    if not exact:
        left.barh(rows, high - low, left=low, height=0.15, color=BAND, label=OWN)
    for expected, line in reversed(list(zip(models, _lines(cells), strict=True))):
        left.vlines(np.maximum(expected, floor), rows - 0.075, rows + 0.075, **{**line, "linewidth": 1.6})
    left.plot(values, rows, "o", color=MEASURED, markersize=4.5, label="measured", zorder=3, clip_on=False)
    _ring(left, values[here], rows[here], 10.0, "clearest")
    left.set_yticks(rows, names, fontsize=8.2)
    left.set_ylim(heights.sum(), 0)
    left.set_xlabel(unit)
    left.grid(axis="x")
    left.set_axisbelow(True)
    left.use_sticky_edges = False
    left.margins(x=0.06)
    legend(left)
    if not exact:
        residuals = [z[shown] for z in (cells.residuals, cells.earlier) if z is not None]
        every = list(residuals)
        for (name, other), colour in zip(cells.overlaid, OTHERS, strict=False):
            if other.residuals.size == n:
                right.plot(other.clearest[shown], rows, "d", color=colour, markersize=4, label=shortened(name, 24))
                every.append(other.clearest[shown])
        for z, colour in reversed(list(zip(residuals, (MEASURED, BEFORE), strict=False))):
            right.hlines(rows, 0, z, color=ROUGH if colour == MEASURED else colour, linewidth=1.2)
            right.plot(z, rows, "o", color=colour, markersize=4.5)
        _ring(right, residuals[-1][here], rows[here], 10.0)
        right.tick_params(axis="y", length=0)
        _residual_scale(right, np.concatenate(every), vertical=False)
        if len(every) > len(residuals):
            right.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.1, fontsize=8.5)


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
        sizes = np.abs(ratios[0][np.isfinite(ratios[0]) & (ratios[0] > _NOTHING)])
        high = float(np.clip(np.quantile(sizes, 0.99) if sizes.size else 0.0, math.log(1.002), math.log(100)))
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
            bar.set_ticks(np.linspace(*span, 5).tolist())  # ratios of counts
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
