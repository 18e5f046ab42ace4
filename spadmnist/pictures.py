"""Pictures of pixels: their values where they lie, on a grid or at places of their own, as a PNG of the same bytes."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import SpadError
from .events import Layout
from .foreign import visible

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 128  # a power of two: a size in points comes out whole
PAGE = "#d6dfec"  # behind pictures in grey: no grey, so that every pixel stands out from it
_PNG = b"\x89PNG\r\n\x1a\n"  # with which a PNG begins
_REACH = 0.5**0.5  # pitches from its centre to where a pixel ends at the latest: the corner of a square
_SAME = 50  # parts of a pitch, to which two steps to a neighbour are the same
_POINTS = 480  # of the longer side of a map of pixels that are no grid
_AROUND = 7  # a pixel and its neighbours in a hexagonal array
_ALONE = 1e-6  # m, the pitch of an array of one pixel
_STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def is_other(path: Path) -> bool:
    """Is there something else than a PNG in a picture's place? An empty file, which somebody made for it, is not."""
    try:
        if not path.is_file():
            return False  # writing it tells why not
        with open(path, "rb") as file:
            return file.read(len(_PNG)) not in (_PNG, b"")
    except OSError:
        return False


def words(text: str) -> str:
    """Text that others wrote, for matplotlib: one line that can be seen, in which no $ begins a formula."""
    return visible(text).replace("$", r"\$")


def pixel_at(places: np.ndarray, side: int) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Which pixel lies at each point of a picture of pixels that are no grid, x to the right and y upward.

    places: (pixels, 2) m; side: points of the longer side. Returns ((height, width) int, -1 beside the pixels; (left,
    right, bottom, top), m). All pixels have one shape, which ends half-way to where any has a neighbour: hexagons in a
    hexagonal array, squares in a square one.
    """
    from scipy.spatial import cKDTree  # takes longer to import than all the rest

    tree = cKDTree(places)
    pitch = _ALONE if len(places) == 1 else float(np.median(tree.query(places, k=2)[0][:, 1]))
    low, high = places.min(axis=0) - _REACH * pitch, places.max(axis=0) + _REACH * pitch
    width, height = np.maximum(np.rint((high - low) / (high - low).max() * side), 1).astype(int)
    x = low[0] + (np.arange(width) + 0.5) * (high[0] - low[0]) / width
    y = high[1] - (np.arange(height) + 0.5) * (high[1] - low[1]) / height
    points = np.stack(np.meshgrid(x, y), axis=-1)
    distance, pixel = tree.query(points)
    inside = distance <= max(_REACH * pitch, (high - low).max() / side)
    aside = points - places[pixel]
    pairs = tree.query_pairs(pitch * (1 + 1 / _SAME), output_type="ndarray")
    steps = np.unique(np.rint((places[pairs[:, 1]] - places[pairs[:, 0]]) / pitch * _SAME), axis=0) / _SAME * pitch
    for step in steps:
        inside &= np.abs(aside @ step) <= step @ step / 2 * (1 + 1 / _SAME)
    return np.where(inside, pixel, -1), (low[0], high[0], low[1], high[1])


def placed(values: np.ndarray, pixel: np.ndarray, empty: Any) -> np.ndarray:
    """(..., height, width, colours) from (..., pixels, colours): values at the points of `pixel_at`, else `empty`."""
    return np.where((pixel >= 0)[..., None], values[..., np.maximum(pixel, 0), :], empty)


def white_of(layout: Layout, values: np.ndarray) -> tuple[float, int]:
    """(what is drawn white where 0 is black, how many pixels are brighter) of (pixels,) values.

    The largest value, but no more than twice the median of a pixel and its neighbours where that is largest (in one of
    a hundred places): a hot pixel stands alone, and what is seen does not. Nor less than twice the median of those that
    are not 0.
    """
    from scipy.ndimage import median_filter
    from scipy.spatial import cKDTree

    some = values[values > 0]
    if not len(some):
        return 1.0, 0
    if layout.positions is None:
        around = median_filter(values.reshape(layout.shape), size=3, mode="nearest")
    else:
        nearest = cKDTree(layout.positions).query(layout.positions, k=min(_AROUND, len(values)))[1]
        around = np.median(values[nearest.reshape(len(values), -1)], axis=1)
    white = min(float(some.max()), 2 * max(float(np.quantile(around, 0.99)), float(np.median(some))))
    return white, int((values > white).sum())


def draw_map(
    axes: Axes, layout: Layout, values: np.ndarray, low: float, high: float, label: str, colours: str = "viridis"
) -> None:
    """Draw (pixels,) values where the pixels lie, and their scale from `low` to `high`, which some may exceed."""
    from matplotlib.ticker import MaxNLocator

    style: dict[str, Any] = {"cmap": colours, "vmin": low, "vmax": high, "interpolation": "nearest"}
    if layout.positions is not None:
        pixel, edges = pixel_at(layout.positions, _POINTS)
        shown = np.ma.masked_array(values[pixel], pixel < 0)
        left, right, bottom, top = (1e6 * edge for edge in edges)
        drawn = axes.imshow(shown, extent=(left, right, bottom, top), **style)
        axes.set(xlabel="um")
    else:
        flat = min(layout.shape) * 8 < max(layout.shape)
        drawn = axes.imshow(values.reshape(layout.shape), aspect="auto" if flat else "equal", **style)
        for axis in (axes.xaxis, axes.yaxis):  # a pixel has a whole number
            axis.set_major_locator(MaxNLocator("auto", steps=[1, 2, 5, 10], integer=True))
    beyond = bool(values.min() < low), bool(values.max() > high)
    extend = {(False, True): "max", (True, False): "min", (True, True): "both"}.get(beyond, "neither")
    axes.figure.colorbar(drawn, ax=axes, shrink=0.9, label=label, extend=extend)


def png(width: float, height: float, draw: Callable[[Figure], None], fitted: bool = True) -> bytes:
    """The PNG of a figure (inches) that `draw` fills: the same bytes for the same, whatever the user's settings.

    fitted: matplotlib makes room for all words, which takes seconds where there are many axes.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained" if fitted else None)
        draw(figure)
        buffer = io.BytesIO()
        FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None, "Creation Time": None})
    return buffer.getvalue()


def save(picture: bytes, path: Path) -> None:
    """Write a picture. Raises SpadError where that cannot be done."""
    try:
        path.write_bytes(picture)
    except OSError as error:
        raise SpadError(f"{path}: the picture cannot be written there ({error.strerror})") from None
