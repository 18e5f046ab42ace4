"""Pages: what a comparison found, as one HTML file that needs nothing else: no network, no script, no other file.

Names come from users' files, so all text is escaped by the template, every picture is an image of its own, and the
page forbids the browser to fetch or run anything. The same comparison gives the same bytes.
"""

from __future__ import annotations

import base64
import importlib.metadata
import io
import math
import re
import textwrap
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np

from . import dataset, disk, units
from .criticism.compare import Check, Comparison, Nuisance
from .errors import SpadError
from .statistics import Statistic, Summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FILE = "index.html"

_MARK = '<meta name="generator" content="spadmnist comparison">'
_PICTURES = 12  # of failing checks; the others stand in a table
_ALIKE = 3  # of them of one statistic
_NEAREST = 3  # pictures where nothing fails
_ACROSS = 8  # captures side by side in the table of all checks
_MOST = 4000  # checks that are listed, so that the page stays small whatever is compared
_CERTAIN = 1e-12  # smaller p-values rest on tails that nobody has seen

# --- the file -------------------------------------------------------------------------------------------------------


def comparison(found: Comparison, folder: Path) -> Path:
    """Write the page of a comparison as `index.html` in a folder, which is made if it is not there; its path.

    A page that an earlier comparison left there is replaced, whatever else lies there stays as it is. Raises SpadError
    as `check_place` does, or where the file cannot be written.
    """
    check_place(folder)
    page = folder / FILE
    disk.commit_file(page, _page(found).encode("utf-8", "replace"), folder)
    return page


def check_place(folder: Path) -> None:
    """Raise SpadError with a sentence where no page may be put, so that it can be said before the work is done."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise SpadError(f"{folder} is a file, but a report is a folder; choose another name with -o")
    for above in (folder.resolve(), *folder.resolve().parents):
        if (above / dataset.MANIFEST).is_file():
            raise SpadError(f"{folder} lies in the dataset {above}, which holds nothing but its own; choose another -o")
    page = folder / FILE
    if page.is_symlink() or page.exists():
        try:
            ours = _MARK.encode() in disk.read_file(page, 64 << 20)[:2000]
        except OSError:
            ours = False
        if not ours:
            raise SpadError(
                f"{page} is there already and is not from a comparison; it is left alone: choose another -o"
            )


# --- the words ------------------------------------------------------------------------------------------------------

_TOTALS = {
    "light": "The light level of all lit captures together, against what the measurement states.",
    "rate": "The detections of the whole capture.",
}
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class _Picture:
    """source: a data URI; note: what a reader needs to know beside the general words on pictures."""

    source: str
    alternative: str
    note: str = ""


@dataclass(frozen=True)
class _Card:
    check: Check
    title: str
    picture: _Picture | None


def _page(found: Comparison) -> str:
    failing = found.failing
    significant = {id(c) for c in found.checks if c.significant}
    immaterial = []
    if found.tolerance is not None:
        immaterial = [c for c in _clearest(found.checks) if c.passes and id(c) in significant]
    nearest = [c for c in _clearest(found.checks) if c.passes and c.summary is not None][:_NEAREST]
    chosen = _chosen(failing) if failing else nearest
    captures = list(dict.fromkeys(c.capture for c in found.checks if c.capture is not None))
    listed = _clearest(found.checks)[:_MOST]
    words: dict[str, Any] = {
        "found": found,
        "failing": failing,
        "clearest": failing[0] if failing else None,
        "immaterial": immaterial,
        "captures": captures,
        "statistics": {c.statistic: _title(c.statistic) for c in found.checks},
        "light": _light_picture(found.nuisances) if found.nuisances else None,
        "cards": [_Card(c, _title(c.statistic), _picture(c)) for c in chosen],
        "others": [c for c in failing if id(c) not in {id(shown) for shown in chosen}],
        "matrix": list(_matrix(listed, captures, significant)),
        "listed": listed,
        "judged": lambda check: _judged(check, significant),
        "version": importlib.metadata.version("spadmnist"),
    }
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"number": _number, "p": _p, "p_words": _p_in_words, "percent": _percent}
    return environment.from_string(_TEMPLATE).render(mark=_MARK, **words)


def _clearest(checks: Iterable[Check]) -> list[Check]:
    return sorted(checks, key=lambda c: (c.p_value, -c.misfit))


def _chosen(failing: Sequence[Check]) -> list[Check]:
    """Which failing checks are shown: the clearest of every statistic first, then its others, a few of each."""
    ranks: dict[str, int] = {}
    order = []
    for check in failing:
        rank = ranks[check.statistic] = ranks.get(check.statistic, 0) + 1
        if rank <= _ALIKE:
            order.append((rank > 1, check))
    taken = {id(check) for _, check in sorted(order, key=lambda item: item[0])[:_PICTURES]}
    return [check for check in failing if id(check) in taken]


def _title(statistic: str) -> str:
    """What a statistic looks at: the first line of its docstring."""
    try:
        return str(Statistic.registry.find(statistic).summary())
    except KeyError:  # the plug-in of a stored comparison may not be at hand
        return _TOTALS.get(statistic, statistic)


def _judged(check: Check, significant: set[int]) -> str:
    if not check.passes:
        return "fails"
    return "small" if id(check) in significant else "passes"


def _matrix(
    checks: Sequence[Check], captures: Sequence[str], significant: set[int]
) -> Iterator[tuple[list[str | None], list[tuple[str, list[tuple[Check, str] | None]]]]]:
    """Tables of (captures, rows): a row is a statistic and its check of each capture, with the colour of its cell."""
    by_place = {(c.statistic, c.capture): c for c in reversed(checks)}
    columns = [capture for capture in captures if any(c.capture == capture for c in checks)]
    all_columns: list[str | None] = [*([None] if any(c.capture is None for c in checks) else []), *columns]
    for start in range(0, len(all_columns), _ACROSS):
        some = all_columns[start : start + _ACROSS]
        rows = []
        for name in sorted({c.statistic for c in checks if c.capture in some}):
            cells = [by_place.get((name, capture)) for capture in some]
            rows.append((name, [None if c is None else (c, _colour(c, significant)) for c in cells]))
        yield some, rows


def _colour(check: Check, significant: set[int]) -> str:
    judged = _judged(check, significant)
    if judged != "passes":
        return judged
    return "low" if check.p_value < 0.01 else "lowish" if check.p_value < 0.05 else "passes"


def _number(value: float) -> str:
    """Three digits or four, large and small ones with a power of ten."""
    if not math.isfinite(value):
        return "beyond all numbers" if value == math.inf else "not a number"
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}·10{str(int(exponent)).translate(_SUPERSCRIPT)}"


def _p(value: float) -> str:
    if not value > _CERTAIN:
        return "not a number" if math.isnan(value) else f"< 10{'-12'.translate(_SUPERSCRIPT)}"
    if value >= 0.001:
        return f"{value:.2g}"
    mantissa, exponent = f"{value:.0e}".split("e")
    return f"{mantissa}·10{str(int(exponent)).translate(_SUPERSCRIPT)}"


def _p_in_words(value: float) -> str:
    text = _p(value)
    return f"p {text}" if text.startswith("<") else f"p = {text}"


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


# --- the pictures ---------------------------------------------------------------------------------------------------

_WIDTH = 9.6  # inches; a page is as wide
_DPI = 150
_MEASURED, _MODEL, _BAND, _WORST = "#1d2329", "#2f6ea5", "#bcd6ec", "#c0392b"
_ROUGH, _SMOOTH = "#5b6670", "#e3e6e8"
_FEW_CELLS = 40  # without an axis, up to here each with its own words
_POINTS = 150  # more cells are drawn as steps
_VECTOR = 400  # more cells are drawn in points of the screen
_STEPS = 1500  # still more are a cloud of dots
_DRAWN = 100_000
_LARGEST_MAP = 192
_LIGHTS = 24
_COVERED = 1.96  # sigmas to either side: 95 %
_OWN = "95 % of its own scatter"

_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "spadmnist",
    "text.parse_math": False,
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": _ROUGH,
    "axes.labelcolor": _MEASURED,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-4, 5),
    "xtick.color": _ROUGH,
    "ytick.color": _ROUGH,
    "grid.color": _SMOOTH,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}


def _drawn(draw: Any, *arguments: Any, raster: bool = False) -> str:
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


def _picture(check: Check) -> _Picture | None:
    """Measured beside simulated, cell by cell, and how far they are apart."""
    summary, judgement = check.summary, check.judgement
    if summary is None or judgement is None or not np.size(summary.values):
        return None
    words = f"{check.statistic} of {check.capture}: measured and simulated. Clearest at {check.where}: {check.size}"
    shape = summary.shape
    if shape is not None and min(shape) > 1 and math.prod(shape) == summary.values.size:
        factor = _merged(shape)
        note = f"Each point stands for {factor} x {factor} pixels, by the most deviating of them." if factor > 1 else ""
        return _Picture(_drawn(_draw_maps, check), words, note)
    if _axis_of(summary)[0] is None:
        return _Picture(_drawn(_draw_named, check), words)
    n = summary.values.size
    note = ""
    if n > _DRAWN:
        note = f"Of {n:,} cells {_DRAWN:,} are drawn, evenly spread, those that deviate most among them."
    return _Picture(_drawn(_draw_series, check, raster=n > _VECTOR), words, note)


def _parts(check: Check) -> tuple[Summary, np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]:
    """(summary, measured, expected, spread, residuals, the clearest cell) of a check that has them."""
    summary, judgement = check.summary, check.judgement
    assert summary is not None and judgement is not None

    def finite(values: np.ndarray) -> np.ndarray:
        return np.nan_to_num(np.asarray(values, np.float64), nan=0.0, posinf=1e300, neginf=-1e300).ravel()

    spread = np.broadcast_to(finite(judgement.spread), np.shape(summary.values))
    measured, expected, residuals = (finite(v) for v in (summary.values, judgement.expected, judgement.residuals))
    return summary, measured, expected, spread, residuals, int(judgement.worst)


def _axis_of(summary: Summary) -> tuple[np.ndarray | None, str, bool]:
    """(what is on the horizontal axis, its label, whether it is logarithmic); None where cells have names instead."""
    n = summary.values.size
    axis = summary.axis
    usable = axis is not None and np.shape(axis) == (n,) and n > 1 and bool(np.isfinite(axis).all())
    if usable and axis is not None:
        rising = np.diff(axis)
        if (rising > 0).all() or (rising < 0).all():
            return np.asarray(axis, np.float64), _printable(summary.label), summary.log and bool((axis > 0).all())
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
    low, high = expected - _COVERED * spread, expected + _COVERED * spread
    return (np.maximum(low, 0.0), high) if law == "poisson" else (low, high)


def _logarithmic(law: str, measured: np.ndarray, expected: np.ndarray) -> bool:
    """Do the values span so much that only powers of ten show them all?"""
    both = np.concatenate([measured, expected])
    positive = both[both > 0]
    if not positive.size or (both < 0).any() or (law == "normal" and positive.size < both.size):
        return False
    return float(positive.max()) > (1000 if law == "normal" else 100) * float(positive.min())


def _draw_series(figure: Figure, check: Check) -> None:
    """Cells along an axis: measured and simulated above, residuals below."""
    summary, measured, expected, spread, residuals, worst = _parts(check)
    axis, label, log = _axis_of(summary)
    assert axis is not None
    if axis[0] > axis[-1]:  # from left to right
        axis, measured, expected, spread, residuals = (a[::-1] for a in (axis, measured, expected, spread, residuals))
        worst = axis.size - 1 - worst
    at_worst = (axis[worst], measured[worst], residuals[worst])
    if axis.size > _DRAWN:
        some = _thinned(residuals, _DRAWN)
        axis, measured, expected, spread, residuals = (a[some] for a in (axis, measured, expected, spread, residuals))
    edges = _edges(axis, log)
    low, high = _band(summary.law, expected, spread)
    exact = summary.law == "exact"
    figure.set_size_inches(_WIDTH, 2.6 if exact else 3.9)
    heights = [1.0] if exact else [2.1, 1.0]
    panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    upper, last = panels[0], panels[-1]

    floor = _value_scale(upper, summary.law, measured, expected)
    low, high, expected, shown = (np.maximum(values, floor) for values in (low, high, expected, measured))
    if axis.size <= _STEPS:
        if not exact:
            upper.stairs(high, edges, baseline=low, fill=True, color=_BAND, label=_OWN)
        upper.stairs(expected, edges, baseline=None, color=_MODEL, linewidth=1.2, label="simulated")
    else:
        even = np.linspace(0, axis.size - 1, _STEPS).astype(np.int64)
        upper.fill_between(axis[even], low[even], high[even], color=_BAND, linewidth=0, label=_OWN)
        upper.plot(axis[even], expected[even], color=_MODEL, linewidth=1.2, label="simulated", zorder=4)
    if axis.size <= _POINTS:
        there = measured >= floor
        upper.plot(axis[there], shown[there], "o", color=_MEASURED, markersize=3.2, label="measured", zorder=3)
        if not there.all():
            style: dict[str, Any] = {"color": _MEASURED, "markersize": 4, "zorder": 3, "clip_on": False}
            upper.plot(axis[~there], shown[~there], "v", label="measured, below the scale", **style)
    elif axis.size <= _STEPS:
        upper.stairs(shown, edges, baseline=None, color=_MEASURED, linewidth=0.7, label="measured", zorder=3)
    else:
        upper.plot(axis, shown, "o", color=_MEASURED, markersize=1.1, markeredgewidth=0, zorder=3)
        upper.plot([], [], "o", color=_MEASURED, markersize=3.2, label="measured")
    _ring(upper, at_worst[0], max(at_worst[1], floor), label="clearest")
    upper.set_ylabel(_unit_of(check))
    upper.use_sticky_edges = False
    upper.margins(y=0.06)
    upper.grid(axis="y")
    upper.set_axisbelow(True)
    _legend(upper)

    if not exact:
        if axis.size <= _POINTS:
            last.vlines(axis, 0, residuals, color=_ROUGH, linewidth=1.0)
        last.plot(axis, residuals, "o", color=_MEASURED, markeredgewidth=0, markersize=_dot(axis.size))
        _ring(last, at_worst[0], at_worst[2])
        _residual_scale(last, residuals)
    last.set_xlim(edges[0], edges[-1])
    if log:
        last.set_xscale("log")
    _horizontal(last, label, log)


def _dot(cells: int) -> float:
    return 3.6 if cells <= _POINTS else 1.8 if cells <= _STEPS else 1.1


def _ring(axes: Axes, x: float, y: float, size: float = 9.0, label: str | None = None) -> None:
    """Where it is clearest."""
    axes.plot(
        [x], [y], "o", markersize=size, markerfacecolor="none", color=_WORST, label=label, zorder=5, clip_on=False
    )


def _thinned(residuals: np.ndarray, most: int) -> np.ndarray:
    """Which cells are drawn of too many: evenly spread ones, and those few that deviate most."""
    deviating = np.argsort(-np.abs(residuals), kind="stable")[: most // 100]
    even = np.linspace(0, residuals.size - 1, most - most // 100).astype(np.int64)
    return np.union1d(deviating, even)


def _draw_named(figure: Figure, check: Check) -> None:
    """Cells without an axis, each with its own words: measured and simulated to the left, residuals to the right."""
    summary, measured, expected, spread, residuals, worst = _parts(check)
    names = ["\n".join(textwrap.wrap(_shortened(_where(summary, k), 128), 64)) for k in range(measured.size)]
    heights = np.array([0.1 + 0.13 * (name.count("\n") + 1) for name in names])  # inches
    rows = np.cumsum(heights) - heights / 2
    exact = summary.law == "exact"
    figure.set_size_inches(_WIDTH, 1.0 + heights.sum())
    widths = [1.0] if exact else [1.5, 1.0]
    panels = figure.subplots(1, len(widths), sharey=True, width_ratios=widths, squeeze=False)[0]
    left, right = panels[0], panels[-1]

    floor = _value_scale(left, summary.law, measured, expected, vertical=False)
    low, high, expected, shown = (
        np.maximum(values, floor) for values in (*_band(summary.law, expected, spread), expected, measured)
    )
    if not exact:
        left.barh(rows, high - low, left=low, height=0.15, color=_BAND, label=_OWN)
    left.vlines(expected, rows - 0.075, rows + 0.075, color=_MODEL, linewidth=1.6, label="simulated")
    left.plot(shown, rows, "o", color=_MEASURED, markersize=4.5, label="measured", zorder=3, clip_on=False)
    _ring(left, shown[worst], rows[worst], 10.0, "clearest")
    left.set_yticks(rows, names, fontsize=8.2)
    left.set_ylim(heights.sum(), 0)
    left.set_xlabel(_unit_of(check))
    left.grid(axis="x")
    left.set_axisbelow(True)
    left.use_sticky_edges = False
    left.margins(x=0.06)
    _legend(left)
    if not exact:
        right.hlines(rows, 0, residuals, color=_ROUGH, linewidth=1.2)
        right.plot(residuals, rows, "o", color=_MEASURED, markersize=4.5)
        _ring(right, residuals[worst], rows[worst], 10.0)
        right.tick_params(axis="y", length=0)
        _residual_scale(right, residuals, vertical=False)


def _draw_maps(figure: Figure, check: Check) -> None:
    """Measured over simulated (or measured, where a ratio says nothing), and residuals, pixel by pixel."""
    from matplotlib import colormaps
    from matplotlib.colors import Normalize
    from matplotlib.ticker import FuncFormatter

    summary, measured, expected, _, residuals, worst = _parts(check)
    assert summary.shape is not None
    rows, columns = summary.shape
    as_ratio = summary.law in ("poisson", "exponential") and bool((measured >= 0).all() and (expected > 0).any())
    if as_ratio:
        with np.errstate(all="ignore"):
            shown = np.log(measured / np.where(expected > 0, expected, np.nan))
        usual = np.abs(shown[np.isfinite(shown)])
        widest = float(np.quantile(usual, 0.99)) if usual.size else 0.0
        high = float(np.clip(widest, math.log(1.002), math.log(100)))
        low = -high
        shown = np.where(np.isneginf(shown), -1e3, shown)  # none measured: beyond the scale
    else:
        shown = measured
        low, high = (float(value) for value in np.quantile(measured, [0.005, 0.995]))
        low, high = (low, high) if high > low else (low - 1.0, high + 1.0)
    deviation = float(np.clip(np.quantile(np.abs(residuals), 0.995), 4.0, 40.0))
    factor = _merged(summary.shape)
    tall = 2.2 if columns > 4 * rows else min(4.6, 0.9 + 3.6 * max(0.35, rows / columns))
    figure.set_size_inches(_WIDTH, tall)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    title = "measured / simulated" if as_ratio else f"measured, {_unit_of(check)}".removesuffix(", value")
    for panel, values, span, words, colours in (
        (panels[0], shown, (low, high), title, "PuOr_r" if as_ratio else "viridis"),
        (panels[1], residuals, (-deviation, deviation), "residuals, sigmas", "RdBu_r"),
    ):
        image = panel.imshow(
            _enlarged(_largest_of(values.reshape(rows, columns), factor)),
            cmap=colormaps[colours].with_extremes(bad=_SMOOTH),
            norm=Normalize(*span),
            extent=(-0.5, columns - 0.5, rows - 0.5, -0.5),
            aspect="auto" if max(rows, columns) > 4 * min(rows, columns) else "equal",
            interpolation="none",
        )
        written = FuncFormatter(lambda value, _: f"{math.exp(value):.3g}") if colours == "PuOr_r" else None
        bar = figure.colorbar(image, ax=panel, extend="both", shrink=0.92, pad=0.02, format=written)
        if written is not None:
            bar.set_ticks(np.linspace(low, high, 5).tolist())
        bar.outline.set_visible(False)
        panel.set_title(words, fontsize=9.5)
        for colour, width in (("white", 3.0), ("black", 1.3)):  # on light and dark
            place = [worst % columns], [worst // columns]
            ring: dict[str, Any] = {"markersize": 12, "markerfacecolor": "none", "clip_on": False}
            panel.plot(*place, "o", markeredgecolor=colour, markeredgewidth=width, **ring)
        panel.set_xlabel("column")
        panel.tick_params(length=2)
        panel.xaxis.get_major_locator().set_params(integer=True)
        panel.yaxis.get_major_locator().set_params(integer=True)
    panels[0].set_ylabel("row")


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


def _legend(axes: Axes) -> None:
    """Above the picture, what is measured first."""
    handles, labels = axes.get_legend_handles_labels()
    first = ("measured", "found", "simulated", _OWN)
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
    if not _logarithmic(law, measured, expected):
        return -math.inf
    both = np.concatenate([measured, expected])
    least = float(expected.min()) / 50 if law == "exponential" else 0.0  # chance makes some as small as you like
    floor = max(float(both[both > 0].min()), float(both.max()) * 1e-9, least) / 2
    (axes.set_yscale if vertical else axes.set_xscale)("log")
    (axes.set_ylim if vertical else axes.set_xlim)(floor * 0.9, float(both.max()) * 2)
    _powers(axes.yaxis if vertical else axes.xaxis)
    return floor


def _residual_scale(axes: Axes, residuals: np.ndarray, vertical: bool = True) -> None:
    """Sigmas about 0, with what a right model hardly exceeds; large ones are pressed together."""
    largest = float(np.abs(residuals).max())
    low, high = (1.2 * max(4.0, float(side.max())) for side in (-residuals, residuals))
    span, line = (axes.axhspan, axes.axhline) if vertical else (axes.axvspan, axes.axvline)
    span(-_COVERED, _COVERED, color=_BAND, linewidth=0, zorder=0)
    line(0, color=_MODEL, linewidth=1.2, zorder=1)
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
        _powers(axes.xaxis)
    axes.set_xlabel(_shortened(label, 100))


def _powers(axis: Any) -> None:
    """Ticks as powers of ten."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axis.set_major_formatter(FuncFormatter(lambda value, _: _power(value)))
    axis.set_minor_formatter(NullFormatter())


def _power(value: float) -> str:
    """A round number; large and small ones as a power of ten."""
    if value == 0 or 1e-3 <= value < 1e5:
        return f"{value:g}"
    mantissa, exponent = f"{value:.0e}".split("e")
    power = f"10{str(int(exponent)).translate(_SUPERSCRIPT)}"
    return power if mantissa == "1" else f"{mantissa}·{power}"


def _unit_of(check: Check) -> str:
    """What is on the axis of the values."""
    try:
        unit = Statistic.registry.find(check.statistic).unit
    except KeyError:
        unit = "1"
    if unit != "1":
        return _shortened(unit, 40)
    law = check.summary.law if check.summary is not None else ""
    return {"poisson": "count", "exponential": "power"}.get(law, "value")


def _where(summary: Summary, cell: int) -> str:
    try:
        return str(summary.where(cell))
    except Exception:  # of a user's own statistic: the page is worth more than one name
        return f"cell {cell}"


def _shortened(text: str, most: int) -> str:
    """Text without its middle where it is too long for a picture; the page has it whole."""
    text = _printable(text)
    return text if len(text) <= most else f"{text[: (most - 1) // 2]}…{text[-(most // 2) :]}"


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text)


def _light_picture(nuisances: Sequence[Nuisance]) -> _Picture:
    clearest = sorted(nuisances, key=lambda n: (n.capture is not None, -abs(n.pull)))[:_LIGHTS]
    shown = [n for n in nuisances if n in clearest]
    note = f"Of {len(nuisances)} the {_LIGHTS} with the largest pulls." if len(nuisances) > _LIGHTS else ""
    return _Picture(_drawn(_draw_light, shown), "Light of each capture, as a factor on what is stated", note)


def _draw_light(figure: Figure, nuisances: Sequence[Nuisance]) -> None:
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    figure.set_size_inches(_WIDTH, 0.95 + 0.3 * len(nuisances))
    axes = figure.subplots()
    rows = np.arange(len(nuisances), dtype=np.float64)
    stated = max((n.stated for n in nuisances if n.capture is None), default=0.0)
    if stated > 0:
        span = math.exp(-_COVERED * stated), math.exp(_COVERED * stated)
        axes.axvspan(*span, color=_BAND, linewidth=0, label=f"as stated, 95 %: within {100 * _COVERED * stated:.2g} %")
    axes.axvline(1.0, color=_MODEL, linewidth=1.2)
    for row, n in zip(rows, nuisances, strict=True):
        colour = _WORST if abs(n.pull) > 3 else _MEASURED
        axes.plot([n.low, n.high], [row, row], color=colour, linewidth=1.6)
        axes.plot(
            [n.value], [row], "o", color=colour, markersize=5, label="found, with 95 % interval" if not row else None
        )
        axes.annotate(
            f"pull {n.pull:+.1f}",
            (1.0, row),
            xycoords=("axes fraction", "data"),
            xytext=(6, 0),
            textcoords="offset points",
            va="center",
            color=colour,
        )
    axes.set_yticks(rows, [_shortened(n.capture or "all lit captures", 36) for n in nuisances])
    axes.set_ylim(len(nuisances) - 0.4, -0.6)
    axes.margins(x=0.1)
    axes.xaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:.6g}"))
    axes.set_xlabel("light, as a factor on what is stated")
    _legend(axes)


# --- the page -------------------------------------------------------------------------------------------------------

_TEMPLATE = """\
{% macro table(checks) %}
<div class="wide"><table class="list">
<thead><tr><th>statistic</th><th>capture</th><th>p-value</th><th>misfit</th><th>where it differs most</th>\
<th>size</th></tr></thead>
<tbody>
{% for c in checks %}
{% set verdict = judged(c) %}
<tr><td>{{ c.statistic }}</td><td>{{ c.capture or "all" }}</td>\
<td class="{{ {'fails': 'fails', 'small': 'small-one', 'passes': ''}[verdict] }}">\
{{ {"fails": "✗ ", "small": "≈ ", "passes": ""}[verdict] }}{{ c.p_value | p }}</td>\
<td>{{ c.misfit | number }}</td><td>{{ c.where }}</td><td>{{ c.size }}</td></tr>
{% endfor %}
</tbody></table></div>
{% endmacro %}
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
{{ mark | safe }}
<title>{{ found.sensor }} beside {{ found.measurement }}: {{ found.verdict }}</title>
<style>
:root { color-scheme: light; }
body { margin: 0; background: #fafaf8; color: #1d2329;
  font: 16px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
main { max-width: 1000px; margin: 0 auto; padding: 28px 24px 60px; }
h1 { font-size: 1.75rem; line-height: 1.25; margin: .2rem 0 .5rem; font-weight: 650; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 .7rem; padding-bottom: .25rem; border-bottom: 1px solid #dfe2e4; }
h3 { font-size: 1.02rem; margin: 0 0 .2rem; font-weight: 600; }
h1, h2, h3, p, td, th, dd, dt, figcaption { overflow-wrap: anywhere; }
p { margin: .4rem 0; }
.small { color: #5b6670; font-size: .86rem; }
.verdict { background: #fff; border: 1px solid #dfe2e4; border-left: 7px solid #4b8b62; padding: 14px 20px 12px; }
.verdict.fails { border-left-color: #c0392b; }
.lead { font-size: 1.08rem; }
.facts { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1.4rem; margin: 0; }
.facts dt { color: #5b6670; } .facts dd { margin: 0; }
.card { background: #fff; border: 1px solid #dfe2e4; padding: 14px 18px 10px; margin: 0 0 16px; break-inside: avoid; }
.card img, .light img { width: 100%; height: auto; display: block; margin-top: .5rem; }
.light { background: #fff; border: 1px solid #dfe2e4; padding: 8px 14px; margin: 0; break-inside: avoid; }
.size { font-weight: 600; }
.tag { color: #5b6670; font-size: .86rem; }
.tag b { color: #1d2329; font-weight: 600; }
.wide { overflow-x: auto; margin: 0 0 1rem; }
table { border-collapse: collapse; font-size: .84rem; background: #fff; width: 100%; }
th, td { border: 1px solid #dfe2e4; padding: 3px 7px; text-align: left; vertical-align: top; }
thead th { background: #f1f2f1; font-weight: 600; vertical-align: bottom; }
tbody th { font-weight: 400; white-space: nowrap; }
.matrix { width: auto; table-layout: auto; }
.matrix thead th { max-width: 9rem; min-width: 3.6rem; font-weight: 500; }
.matrix td { text-align: center; white-space: nowrap; font-variant-numeric: tabular-nums; }
.list td:nth-child(3), .list td:nth-child(4) { white-space: nowrap; font-variant-numeric: tabular-nums; }
.list th, .lights th, .lights td:not(:first-child) { white-space: nowrap; }
.list td:nth-child(1) { min-width: 9em; } .list td:nth-child(2) { min-width: 6.5em; }
.list td:nth-child(5) { min-width: 14em; } .list td:nth-child(6) { min-width: 16em; }
tr { break-inside: avoid; }
.fails { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
td.fails, .key.fails { background: #f0bdb6; font-weight: 600; }
td.small-one, .key.small-one { background: #f6e0ae; }
td.low, .key.low { background: #faf3d3; }
td.lowish, .key.lowish { background: #f3f6e4; }
td.passes, .key.passes { background: #e4f0e6; }
td, .key { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
.key { display: inline-block; padding: 0 .5rem; border: 1px solid #dfe2e4; margin-right: .15rem; }
dl.words dt { font-weight: 600; margin-top: .6rem; } dl.words dd { margin: 0; max-width: 46rem; }
@media print {
  @page { margin: 14mm; }
  body { background: #fff; font-size: 10pt; } main { max-width: none; padding: 0; }
  h2, h3 { break-after: avoid; } .wide { overflow: visible; } table { font-size: 8pt; }
  h1 { font-size: 16pt; }
}
</style>
</head>
<body>
<main>
<p class="small">Comparison of a model with a measurement &middot; spadmnist {{ version }}</p>
<section class="verdict {{ 'fails' if failing else 'adequate' }}">
{% if failing %}
<h1>The model fails {{ failing | length }} of {{ found.checks | length }} checks,</h1>
<p class="lead">with a misfit of <b>{{ found.misfit | number }}</b> (95 % of its own recordings stay below \
{{ found.misfit_null_95 | number }}), most clearly in <b>{{ clearest.statistic }}</b> of \
<b>{{ clearest.capture or "all captures" }}</b>, {{ clearest.where }}: <b>{{ clearest.size }}</b> \
({{ clearest.p_value | p_words }}).</p>
{% elif found.checks %}
<h1>The model is adequate: none of {{ found.checks | length }} checks fails\
{{ " beyond the tolerance" if immaterial }},</h1>
<p class="lead">with a misfit of <b>{{ found.misfit | number }}</b> (95 % of its own recordings stay below \
{{ found.misfit_null_95 | number }}){% if immaterial %}; {{ immaterial | length }} \
{{ "differs" if immaterial | length == 1 else "differ" }} by more than chance, but by less than \
{{ found.tolerance | percent }}{% endif %}.</p>
{% else %}
<h1>Nothing could be checked,</h1>
<p class="lead">for the measurement has neither data nor a light level that is known.</p>
{% endif %}
</section>

<h2>What was compared</h2>
<dl class="facts">
<dt>model</dt><dd>{{ found.sensor or "a sensor without a name" }}</dd>
<dt>measurement</dt><dd>{{ found.measurement }}</dd>
<dt>captures</dt><dd>{{ captures | length }}{% if captures %}: {{ captures[:40] | join(", ") }}\
{{ ", ..." if captures | length > 40 }}{% endif %}</dd>
<dt>checks</dt><dd>{{ found.checks | length }}, of {{ statistics | length }} kinds</dd>
<dt>simulations</dt><dd>{{ found.replicates }} of each capture, with as many detections as were measured</dd>
<dt>false alarms</dt><dd>a right model is called wrong in {{ found.false_alarm_rate | percent }} of comparisons</dd>
<dt>tolerance</dt><dd>{% if found.tolerance is none %}none: whatever differs by more than chance counts\
{% else %}{{ found.tolerance | percent }}: what is smaller does not count as a failure{% endif %}</dd>
</dl>

{% if light %}
<h2>Light</h2>
<p>How bright it was is known only so well, and so it is adjusted until the model gives as many detections as were
measured: by the factors below. The pull tells whether they agree with what the measurement states.</p>
<figure class="light"><img src="{{ light.source }}" alt="{{ light.alternative }}">
{% if light.note %}<figcaption class="small">{{ light.note }}</figcaption>{% endif %}</figure>
<div class="wide"><table class="lights">
<thead><tr><th>light of</th><th>factor on what is stated</th><th>95 % interval</th><th>pull</th></tr></thead>
<tbody>
{% for n in found.nuisances[:200] %}
<tr><td>{{ n.capture or "all lit captures" }}</td><td>{{ "%.4f" | format(n.value) }}</td>\
<td>{{ "%.4f" | format(n.low) }} to {{ "%.4f" | format(n.high) }}</td><td>{{ "%+.1f" | format(n.pull) }}</td></tr>
{% endfor %}
</tbody></table></div>
{% endif %}

{% if failing %}
<h2>Where it fails, the clearest first</h2>
{% elif cards %}
<h2>What came nearest to failing</h2>
{% endif %}
{% if cards %}
<p class="small">In the pictures, dots or a dark line are measured; the blue line is the mean of the simulations, and
the light blue band holds 95 % of their own scatter. Residuals are the differences in units of that scatter (sigmas).
A ring marks where the difference is clearest. Numbers may be transformed so that their scatter is even; the size
in words is physical.</p>
{% endif %}
{% for card in cards %}
<section class="card">
<h3>{{ card.title }}</h3>
<p class="tag"><b>{{ card.check.statistic }}</b> of <b>{{ card.check.capture or "all captures" }}</b> &middot; \
{{ card.check.p_value | p_words }} &middot; misfit {{ card.check.misfit | number }}</p>
<p>{{ card.check.where[:1] | upper }}{{ card.check.where[1:] }}: <span class="size">{{ card.check.size }}</span></p>
{% if card.picture %}
<img src="{{ card.picture.source }}" alt="{{ card.picture.alternative }}">
{% if card.picture.note %}<p class="small">{{ card.picture.note }}</p>{% endif %}
{% endif %}
</section>
{% endfor %}
{% if others %}
<h3>{{ others | length }} more {{ "check fails" if others | length == 1 else "checks fail" }}</h3>
{{ table(others[:20]) }}
{% if others | length > 20 %}
<p class="small">The {{ others | length - 20 }} others stand in the list of all checks.</p>
{% endif %}
{% endif %}

{% if immaterial %}
<h2>Real, but smaller than the tolerance</h2>
<p>These differ by more than chance, so something is missing in the model; but they are smaller than \
{{ found.tolerance | percent }}, so it does not matter for the verdict.</p>
{{ table(immaterial[:200]) }}
{% endif %}

{% if found.checks %}
<h2>All checks at a glance</h2>
<p class="small">p-values: <span class="key fails">&#10007; fails</span>\
{% if immaterial %}<span class="key small-one">&asymp; below the tolerance</span>{% endif %}\
<span class="key low">below 0.01</span><span class="key lowish">below 0.05</span>\
<span class="key passes">passes</span>{% if found.checks | length >= 20 %} \
In {{ found.checks | length }} checks of a right model chance alone leaves about \
{{ (found.checks | length * 0.05) | round | int }} below 0.05; that is allowed for.{% endif %}</p>
{% for columns, rows in matrix %}
<div class="wide"><table class="matrix">
<thead><tr><th></th>{% for capture in columns %}\
<th scope="col">{{ capture or "all captures" }}</th>{% endfor %}</tr></thead>
<tbody>
{% for name, cells in rows %}
<tr><th scope="row" title="{{ statistics[name] }}">{{ name }}</th>{% for cell in cells %}\
{% if cell is none %}<td></td>{% else %}<td class="{{ 'small-one' if cell[1] == 'small' else cell[1] }}">\
{{ "✗ " if cell[1] == "fails" }}{{ "≈ " if cell[1] == "small" }}{{ cell[0].p_value | p }}</td>\
{% endif %}{% endfor %}</tr>
{% endfor %}
</tbody></table></div>
{% endfor %}

<h2>All checks, the clearest first</h2>
{% if listed | length < found.checks | length %}
<p class="small">The {{ listed | length }} clearest of {{ found.checks | length }}; --json FILE holds all.</p>
{% endif %}
{{ table(listed) }}

<h2>What each statistic looks at</h2>
<dl class="words">
{% for name, title in statistics.items() %}
<dt>{{ name }}</dt><dd>{{ title }}</dd>
{% endfor %}
</dl>
{% endif %}

<h2>Words</h2>
<dl class="words">
<dt>model</dt><dd>The sensor as its file describes it, with the effects that are listed there and no others.</dd>
<dt>check</dt><dd>One statistic of one capture: the same numbers are computed from the measured data and from many
simulations of that capture, and set side by side.</dd>
<dt>residual, sigma</dt><dd>The difference between measured and simulated, divided by the scatter (standard deviation)
that the simulations show among themselves. Within 2 sigmas lie 95 of 100 numbers if the model is right.</dd>
<dt>misfit</dt><dd>The mean squared residual. 1 is what the model's own simulations have; 4 means that data and model
are typically twice as far apart as chance makes them.</dd>
<dt>p-value</dt><dd>How often a right model would look at least as wrong as this, by chance. A small one means that
chance is no explanation; it does not say how large the difference is. With many checks some small ones are expected,
so a check fails only if its p-value stays small after that is allowed for.</dd>
<dt>size</dt><dd>How large the difference is, in physical units. It tells whether the difference matters to you; the
p-value only tells whether it is there.</dd>
<dt>pull</dt><dd>By how many of its own uncertainties a quantity, here the light, had to be moved from what is stated.
Beyond 3, what is stated should be doubted.</dd>
<dt>tolerance</dt><dd>What you said is too small to matter (--tolerance). A difference that is real but smaller is told,
and does not count as a failure.</dd>
</dl>
</main>
</body>
</html>
"""
