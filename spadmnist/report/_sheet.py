"""A sheet of pictures of a dataset: some images in all readouts and reconstructions."""

from __future__ import annotations

import io
import itertools
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import pictures, reconstruct, units
from ..dataset import Dataset, Part
from ..errors import SpadError
from ..events import Events
from ..positions import LARGEST_POSITIONS, positions_in, read_positions
from ..readout import Frames
from ..sources import Source
from ._text import number, percent

_CLIP = 20.0  # normalised fluxes end here, as in the paper's figure of reconstructions
_SMALL, _LARGE = 168, 256  # points of the picture: images are magnified up to one, and reduced to the other
_LARGE_IMAGE = 128  # pixels; a larger image stands alone in its cell
_PIXELS_AT_HAND = 1 << 18  # for a median, where the whole training split would have to be simulated
_LETTER = 6.4  # points: typical width of a letter of the small print
_TOP, _GAP, _CAPTION, _LINE = 92, 16, 34, 18  # above the cells, between them, below each; small print
_PAGE = tuple(bytes.fromhex(pictures.PAGE[1:]))


@dataclass(frozen=True)
class _Shown:
    """The chosen images at one light level, or one image without the leading axis; None: was not recorded.

    fluxes: by method, divided by the median where the method is normalised.
    counts: detections of TR; first: s, time of the first one, infinite without one.
    bits: first frame of QIS; ones: sum of its frames.
    waited: s until the first detection of STR, or to the frame's end, mean over frames of `frame_time` s.
    tally: first frame of the readout `counts`.
    """

    originals: np.ndarray
    fluxes: dict[str, np.ndarray]
    counts: np.ndarray | None = None
    first: np.ndarray | None = None
    bits: np.ndarray | None = None
    ones: np.ndarray | None = None
    waited: np.ndarray | None = None
    tally: np.ndarray | None = None
    frame_time: float = 0.0

    @staticmethod
    def stacked(singles: Sequence[_Shown]) -> _Shown:
        def together(name: str) -> Any:
            values = [getattr(single, name) for single in singles]
            return None if values[0] is None else np.stack(values)

        names = ("originals", "counts", "first", "bits", "ones", "waited", "tally")
        stacks = {name: together(name) for name in names}
        fluxes = {method: np.stack([one.fluxes[method] for one in singles]) for method in singles[0].fluxes}
        return _Shown(fluxes=fluxes, frame_time=singles[0].frame_time, **stacks)


@dataclass(frozen=True)
class _Cell:
    """A cell of the sheet. pixels: (images, rows, columns, 3) uint8; caption: its scale in words."""

    title: str
    subtitle: str
    pixels: np.ndarray
    caption: str


def places_of(manifest: Mapping[str, Any], root: Path | Source) -> np.ndarray | None:
    """(pixels, 2) m, where the pixels of a dataset's sensor lie; None on a grid. Raises InputError as the file's."""
    file = manifest["config"]["sensor"]["layout"].get("positions")
    if file is None:
        return None
    if isinstance(root, Source):
        return positions_in(root.document(file, LARGEST_POSITIONS), root / file)
    return read_positions(root / file)


def sheet(
    dataset: Dataset,
    path: str | Path,
    levels: Sequence[str] | None = None,
    count: int | None = None,
    places: np.ndarray | None = None,
) -> None:
    """Draw some training images in all readouts and reconstructions, a row for each light level, as a PNG.

    levels: as written in the config, all by default. count: images in a cell, with different labels as far as
    there are; by default four, or one where they are large. places: (pixels, 2) m, where pixels lie that are no grid.
    Raises KeyError with a sentence where there is no such level, SpadError where the picture cannot be written.
    """
    brightness = dict(zip(dataset.levels, _brightness(dataset), strict=True))
    split = "train" if "train" in dataset.splits else dataset.splits[0]
    parts = {level: dataset[level, split] for level in levels or dataset.levels}
    parts = dict(sorted(parts.items(), key=lambda item: brightness[item[0]]))
    one = next(iter(parts.values()))
    indices = _different(one, count)
    shown = {level: _show(part, indices) for level, part in parts.items()}
    times = _time_scale([s.first for s in shown.values() if s.first is not None])
    rows = {level: _cells_of(s, times) for level, s in shown.items()}
    if places is not None:
        pixel, _ = pictures.pixel_at(places, _LARGE // math.ceil(math.sqrt(len(indices))))
        page = np.array(_PAGE, np.uint8)
        for cells in rows.values():
            cells[:] = [replace(c, pixels=pictures.placed(c.pixels[:, 0], pixel, page)) for c in cells]
    which = f"{split} image{'s' if len(indices) > 1 else ''} {', '.join(map(str, indices))}"
    if one.labels is not None:
        which += f" (label{'s' if len(indices) > 1 else ''} {', '.join(str(one.labels[i]) for i in indices)})"
    pictures.save(_draw(rows, which, _basis(one, split), times), Path(path))


def _brightness(dataset: Dataset) -> tuple[float, ...]:
    try:
        return dataset.lux
    except SpadError:
        return dataset.irradiance


def _different(part: Part, count: int | None) -> list[int]:
    """Which images to show: the first of each label; where there are too few, the first of the others."""
    if count is None:
        count = 1 if max(part.shape[-2:]) > _LARGE_IMAGE else 4
    firsts = [] if part.labels is None else sorted(np.unique(part.labels, return_index=True)[1].tolist())
    others = (i for i in range(len(part)) if i not in firsts)
    return sorted(itertools.islice(itertools.chain(firsts, others), max(1, count)))


def _show(part: Part, indices: Sequence[int]) -> _Shown:
    """One image after the other, so that never more than one is in memory as a stream."""
    medians = {method: _median(part, method) for method in part.reconstruction}
    return _Shown.stacked([_show_one(part, i, medians) for i in indices])


def _show_one(part: Part, index: int, medians: Mapping[str, float | None]) -> _Shown:
    readouts: dict[str, Any] = {}
    if "tr" in part.readouts:
        events = part.tr[index]
        readouts["counts"] = events.counts.reshape(part.shape)
        readouts["first"] = _first_times(events).reshape(part.shape)
    if "qis" in part.readouts or "str" in part.readouts:
        frames = part.frames[index]  # packed: unpacked, those of a large sensor would fill the memory
        readouts["frame_time"] = frames.frame_time
        if "qis" in part.readouts:
            readouts["bits"] = (frames.bits[:, 0] >> 7).reshape(part.shape)
            readouts["ones"] = np.bitwise_count(frames.bits).sum(axis=1, dtype=np.int64).reshape(part.shape)
        if "str" in part.readouts:
            readouts["waited"] = _mean_wait(frames).reshape(part.shape)
    if "counts" in part.readouts:
        readouts["tally"] = part.counts[index][..., 0, :, :]
    fluxes = {}
    for method, median in medians.items():
        fluxes[method] = part.reconstruction[method][index] / np.float32(median or 1)
    return _Shown(part.images[index], fluxes, **readouts)


def _first_times(events: Events) -> np.ndarray:
    """(rows,) s, infinite where there is no detection; no other stamp becomes a time."""
    out = np.full(len(events.offsets) - 1, np.inf)
    some = events.counts > 0
    starts = events.offsets[:-1][some]
    out[some] = events.times[starts] if events.ticks is None else events.ticks[starts] * events.tick
    return out


def _mean_wait(frames: Frames) -> np.ndarray:
    """(pixels,) s, from the start of a frame to its first detection, or to its end where there is none."""
    assert frames.first is not None
    until = np.concatenate([[0.0], np.cumsum(frames.first.times)])[frames.first.offsets]
    empty = frames.frames - frames.first.counts
    return (np.diff(until) + empty * frames.frame_time) / frames.frames


def _at_hand(part: Part) -> int:
    """How many training images a median rests on: all, unless all would have to be simulated for it."""
    if part.stored:
        return len(part)
    return min(len(part), max(1, _PIXELS_AT_HAND // math.prod(part.shape)))


def _median(part: Part, method: str) -> float | None:
    if not reconstruct.find(method).normalised:
        return None
    if _at_hand(part) == len(part):
        return part.reconstruction[method].normalisation
    some = part.reconstruction[method][: _at_hand(part)]
    return reconstruct.divisor(reconstruct.find(method), reconstruct.median_of_nonzero(lambda: [some]))


def _basis(part: Part, split: str) -> str | None:
    """What the medians rest on, for the foot of the sheet; None where nothing is normalised."""
    if not any(reconstruct.find(method).normalised for method in part.reconstruction):
        return None
    n = _at_hand(part)
    if n == len(part):
        return f"all {n:,} {split} images"
    return f"{n:,} of the {len(part):,} {split} images (the dataset's own median is over all)"


# --- from numbers to colours


def _time_scale(first: Sequence[np.ndarray]) -> tuple[float, float] | None:
    """(shortest, longest) time of the colour scale, s, round numbers; None without any detection."""
    times = np.concatenate([np.ravel(f) for f in first]) if first else np.zeros(0)
    times = times[np.isfinite(times) & (times > 0)]
    if not len(times):
        return None
    high = _round(float(times.max()), up=True)
    return min(_round(float(np.quantile(times, 0.01, method="lower")), up=False), high / 10), high


def _round(value: float, up: bool) -> float:
    """The next 1, 2 or 5 times a power of ten."""
    decade = 10.0 ** math.floor(math.log10(value))
    steps = [step * decade for step in (1, 2, 5, 10)]
    tolerance = 1e-9 * decade
    if up:
        return next(step for step in steps if step >= value - tolerance)
    return next(step for step in reversed(steps) if step <= value + tolerance)


def _cells_of(shown: _Shown, times: tuple[float, float] | None) -> list[_Cell]:
    """The cells of one row."""
    of = "grey level, of 16 bits" if shown.originals.dtype == np.uint16 else "grey level"
    cells = [_Cell("original", of, *_grey(shown.originals))]
    if shown.first is not None and shown.counts is not None:
        caption = f"{number(float(shown.counts.mean()))} detections/pixel"
        cells.append(_Cell("TR", "time of the first detection", _in_colours(shown.first, times), caption))
    if shown.bits is not None and shown.ones is not None:
        caption = f"{percent(float(shown.bits.mean()))} ones"
        cells.append(_Cell("QIS, first frame", "white is 1", _grey(shown.bits, white=1)[0], caption))
        if "qis_counts" not in shown.fluxes:  # which is the same
            cells.append(_Cell("QIS, sum", "frames with a detection", *_grey(shown.ones)))
    if shown.waited is not None:
        none, shortest = shown.frame_time, float(shown.waited.min())
        caption = f"white: {units.show(shortest, 's')}" if shortest < none else "no detection"
        subtitle = f"mean wait, black: {units.show(none, 's')}"
        cells.append(_Cell("STR, first arrival", subtitle, _grey(none - shown.waited)[0], caption))
    if shown.tally is not None:
        cells.append(_Cell("counts, first frame", "detections of a count frame", *_grey(shown.tally)))
    for name, flux in shown.fluxes.items():
        method = reconstruct.find(name)
        needs = " ".join(method.readouts()).upper()
        if method.normalised:
            cells.append(_Cell(name, f"{needs}: flux / median", *_grey(flux, clip=_CLIP)))
        else:
            cells.append(_Cell(name, f"{needs}: not normalised", *_grey(flux)))
    return cells


def _grey(values: np.ndarray, white: float | None = None, clip: float = math.inf) -> tuple[np.ndarray, str]:
    """(RGB, caption) from 0, black, to `white`: by default the largest value up to `clip` or, where a few outliers
    would leave all else in the dark, the value that one in 200 exceeds.

    Three channels are red, green and blue; of another number of them the mean is shown.
    """
    largest = float(values.max())
    if white is None:
        usual = float(np.quantile(values, 0.995))
        white = min(usual if 0 < 2 * usual < largest else largest, clip)
    scaled = np.clip(values / white, 0, 1) if white > 0 else np.zeros(values.shape)
    if values.ndim == 4 and values.shape[1] == 3:
        rgb = np.moveaxis(scaled, 1, -1)
    else:
        grey = scaled.mean(axis=1) if values.ndim == 4 else scaled
        rgb = np.repeat(grey[..., None], 3, axis=-1)
    caption = "all 0"
    if largest > white > 0:
        caption = f"white: {white:.4g} (max {f'{largest:,.0f}' if largest < 1e7 else f'{largest:.0e}'})"
    elif white > 0:
        mean = float(values.mean(dtype=np.float64))
        caption = f"white: {_plain(white, 4)}, mean {_plain(mean, 3)}"
    return _bytes_of(rgb), caption


def _plain(value: float, digits: int) -> str:
    """A number of a caption: grey levels of 16 bits are no powers of ten."""
    return f"{value:,.0f}" if 1000 <= value < 1e6 else f"{value:.{digits}g}"


def _in_colours(first: np.ndarray, times: tuple[float, float] | None) -> np.ndarray:
    """RGB of first detections, over the channels where there are any: early is bright, none is black."""
    earliest = first.min(axis=1) if first.ndim == 4 else first
    if times is None:
        return np.zeros((*earliest.shape, 3), np.uint8)
    low, high = times
    late = np.log(np.clip(earliest, low, high) / low) / math.log(high / low)
    return np.where(np.isfinite(earliest)[..., None], _colours(late), np.uint8(0))


def _colours(late: np.ndarray) -> np.ndarray:
    """RGB of the time scale, from 0 (early, bright) to 1; the darkest part of the map is left to 'none'."""
    from matplotlib import colormaps

    return _bytes_of(colormaps["plasma"](1 - 0.9 * late)[..., :3])


def _bytes_of(scaled: np.ndarray) -> np.ndarray:
    return (scaled * 255 + 0.5).astype(np.uint8)


# --- from colours to a page


def _arranged(images: np.ndarray) -> tuple[int, int, int]:
    """(images side by side, points a pixel takes, pixels a point takes); one of the latter two is 1."""
    n, rows, columns, _ = images.shape
    sides = {across: max(across * columns, -(-n // across) * rows) for across in range(1, n + 1)}
    across = min(sides, key=lambda k: sides[k])
    side = sides[across]
    zoom = next((z for z in (-(-_SMALL // side), _SMALL // side) if 1 <= z <= _LARGE // side), 1)
    return across, zoom, -(-side // _LARGE)


def _mosaic(images: np.ndarray) -> np.ndarray:
    """(height, width, 3): the images side by side, in whole points per pixel or whole pixels per point."""
    n = len(images)
    across, zoom, factor = _arranged(images)
    images = (_reduced(images, factor) if factor > 1 else images).repeat(zoom, axis=1).repeat(zoom, axis=2)
    _, height, width, _ = images.shape
    page = np.full((-(-n // across) * (height + 2) - 2, across * (width + 2) - 2, 3), _PAGE, np.uint8)
    for i, image in enumerate(images):
        y, x = i // across * (height + 2), i % across * (width + 2)
        page[y : y + height, x : x + width] = image
    return page


def _reduced(images: np.ndarray, factor: int) -> np.ndarray:
    """Means over squares of factor x factor pixels; smaller at the edges."""
    sums = images.astype(np.float64)
    for axis in (1, 2):
        starts = np.arange(0, sums.shape[axis], factor)
        sizes = np.diff([*starts, sums.shape[axis]])
        sums = np.add.reduceat(sums, starts, axis=axis) / np.expand_dims(sizes, [0, *{1, 2, 3} - {axis}])
    return (sums + 0.5).astype(np.uint8)


def _draw(
    rows: Mapping[str, Sequence[_Cell]], which: str, basis: str | None, times: tuple[float, float] | None
) -> bytes:
    """The sheet as a PNG: the same bytes for the same cells, whatever the user's settings of matplotlib."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    pages = {level: [_mosaic(cell.pixels) for cell in cells] for level, cells in rows.items()}
    columns = next(iter(rows.values()))
    height, width = next(iter(pages.values()))[0].shape[:2]
    # a bold letter is about 8 points wide, one of the small print 6
    wide = max(width, 160, *(8 * len(cell.title) for cell in columns))
    left = 32 + 8 * max(map(len, rows))
    full = left + len(columns) * (wide + _GAP) + _GAP
    foot = ["Grey runs from 0, black, to the value below the cell, white, if the head says nothing else."]
    if basis is not None:
        foot.append(
            f"Fluxes are divided by the median of the non-zero pixels of {basis}; what is above {_CLIP:g} is drawn "
            f"as {_CLIP:g}. Where a few outliers would darken the rest, white is below the maximum that is named."
        )
    _, _, factor = _arranged(columns[0].pixels)
    if factor > 1:
        foot.append(f"Every point is the mean of {factor} x {factor} pixels.")
    foot = [line for words in foot for line in textwrap.wrap(words, int((full - left) / _LETTER))]
    lines = len(foot) + (times is not None)
    tall = _TOP + len(rows) * (height + _CAPTION) + _LINE * lines + 2 * _GAP
    if max(full, tall) >= 1 << 16:
        raise SpadError(f"a sheet of {len(rows)} light levels is too large for a picture; name fewer levels")

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        figure = Figure(figsize=(full / pictures.DPI, tall / pictures.DPI), dpi=pictures.DPI, facecolor=pictures.PAGE)

        def text(x: int, y: int, words: str, size: int = 11, color: str = "0.25", **style: Any) -> None:
            points = size * 72 / pictures.DPI
            figure.text(x / full, 1 - y / tall, pictures.words(words), fontsize=points, color=color, va="top", **style)

        def picture(x: int, y: int, pixels: np.ndarray) -> None:
            figure.figimage(pixels, x, tall - y - len(pixels))

        text(16, 16, f"Each row is one light level; each cell shows {which}.", 14, "black")
        for k, cell in enumerate(columns):
            text(left + k * (wide + _GAP), _TOP - 40, cell.title, 12, "black", weight="bold")
            text(left + k * (wide + _GAP), _TOP - 22, cell.subtitle)
        for r, (level, cells) in enumerate(rows.items()):
            y = _TOP + r * (height + _CAPTION)
            text(16, y + height // 2 - 7, level, 12, "black", weight="bold")
            for k, cell in enumerate(cells):
                picture(left + k * (wide + _GAP), y, pages[level][k])
                text(left + k * (wide + _GAP), y + height + 4, cell.caption)

        y = tall - _LINE * lines - _GAP
        for line, words in enumerate(foot):
            text(left, y + _LINE * line, words)
        if times is not None:
            y += _LINE * len(foot)
            text(left, y, "TR, first detection:")
            bar = np.broadcast_to(_colours(np.linspace(0, 1, 240)), (12, 240, 3))
            text(left + 125, y, units.show(times[0], "s"))
            picture(left + 175, y, bar)
            text(left + 423, y, f"{units.show(times[1], 's')} (logarithmic); none: black")
        buffer = io.BytesIO()
        FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None, "Creation Time": None})
    return buffer.getvalue()
