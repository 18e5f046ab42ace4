"""What a dataset holds, for people: the table of its light levels, and a sheet of its pictures.

matplotlib is imported only where a picture is drawn.
"""

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

from . import config as configs
from . import dataset as datasets
from . import look, pictures, reconstruct, units
from .dataset import Dataset, Part
from .errors import SpadError
from .events import Events
from .foreign import visible
from .measurement import Measurement
from .readout import Frames
from .recording import Capture, Recording

_WIDTH = 100  # characters of a table

# --- the table ----------------------------------------------------------------------------------------------


def level_rows(manifest: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One row per light level and split, in the config's order; a number that was not recorded is None.

    detections: of TR, or of the count frames where there is no TR. mean_per_pixel, empty_share: the same, or where
    there is neither, of the frames with a detection. causes: detections of each cause, where the causes were stored.
    ones, density: frames of a pixel with a detection, and their share.
    saturated_pixels, saturated_total: by method, and their sum.
    bytes, bytes_by_kind: on disk, without the original images.
    bits_per_detection: of TR, None where the format does not tell the bytes of TR apart.
    """
    frames = manifest["settings"]["frames"]
    rows = []
    for level in manifest["levels"]:
        for split in _splits(manifest):
            row = {"level": level["text"], "kind": level["kind"], "value": level["value"], "split": split}
            rows.append(row | _numbers(manifest["statistics"][level["text"]][split], frames))
    return rows


def _splits(manifest: Mapping[str, Any]) -> list[str]:
    """In the config's order, which the manifest's shards keep and its sorted names do not."""
    return list(dict.fromkeys(shard.split for shard in datasets.shards_in(manifest)))


def _numbers(facts: Mapping[str, Any], frames: int) -> dict[str, Any]:
    """What `level_rows` says of some images, from what the manifest's `statistics` holds of them."""
    tr, framed = facts.get("tr") or facts.get("counts"), facts.get("frames")
    detections = tr["detections"] if tr else None
    ones = framed["detections"] if framed else None
    pixels, by_kind = facts["pixels"], facts["bytes"]
    return {
        "images": facts["images"],
        "pixels": pixels,
        "detections": detections,
        "mean_per_pixel": _ratio(detections if tr else ones, pixels),
        "empty_share": _ratio((tr or framed or {}).get("empty_pixels"), pixels),
        **({"causes": dict(facts["causes"])} if "causes" in facts else {}),
        "ones": ones,
        "density": _ratio(ones, pixels * frames),
        "saturated_pixels": dict(facts["saturated_pixels"]),
        "saturated_total": sum(facts["saturated_pixels"].values()),
        "bytes": sum(by_kind.values()),
        "bytes_by_kind": dict(by_kind),
        "bits_per_detection": _ratio(8 * by_kind["tr"] if "tr" in by_kind else None, detections),
    }


def _ratio(part: int | None, whole: int | None) -> float | None:
    return part / whole if part is not None and whole else None


def level_table(manifest: Mapping[str, Any], by_split: bool = False) -> str:
    """What a dataset is, its light levels (one row each, or one for each split), and its normalisation.

    At most 100 characters wide.
    """
    blocks = [_about(manifest), _levels(manifest, by_split)]
    blocks += [_saturated(manifest), _causes(manifest), _normalisation(manifest)]
    return "\n\n".join(block for block in blocks if block)


def _about(manifest: Mapping[str, Any]) -> str:
    config, images = manifest["config"], manifest["images"]
    sensor, recording = config["sensor"], config["recording"]
    each = " and ".join(f"{images['splits'][split]['images']:,} {split}" for split in _splits(manifest))
    size = " x ".join(str(n) for n in images["shape"])
    levels = f"{len(manifest['levels'])} light level{'s' if len(manifest['levels']) > 1 else ''}"
    stored = sum(facts["bytes"] for facts in manifest["files"].values()) + len(datasets.seal(dict(manifest)))
    framed = ""
    if set(recording["readouts"]) & {"str", "qis"}:
        framed = f", {recording['frames']:,} frames of {recording['frame_time']}"
    facts = {
        "images": f"{each}, {size} pixels, at {levels}",
        "sensor": f"{sensor['name'] or 'unnamed'}, rules: {sensor['rules']}",
        "recording": f"{recording['exposure']}{framed}; {', '.join(recording['readouts'])}",
        "seed": str(manifest["seed"]),
        "stored": f"{_bytes(stored)} in {len(manifest['files']) + 1:,} files, {config['output']['format']}",
    }
    return _facts(facts)


def _facts(facts: Mapping[str, str]) -> str:
    return "\n".join(f"{name:<9}  {visible(text)}" for name, text in facts.items())


_HEADER = ("level", "images", "detections", "mean", "empty", "ones", "density", "saturated", "size", "bits")
_LEGEND = """\
mean: detections per pixel of an image; of STR and QIS alone, frames with one. empty: pixels without
any. ones: frames of a pixel with a detection. density: their share. size: without the originals.
bits: stored per detection of TR."""


def _levels(manifest: Mapping[str, Any], by_split: bool) -> str:
    frames = manifest["settings"]["frames"]
    rows: list[Sequence[str]] = []
    for level in manifest["levels"]:
        splits = manifest["statistics"][level["text"]]
        if by_split:
            rows.append((level["text"], *[""] * (len(_HEADER) - 1)))
            rows += [(f"  {split}", *_cells(_numbers(splits[split], frames))) for split in _splits(manifest)]
        else:
            rows.append((level["text"], *_cells(_numbers(_summed(list(splits.values())), frames))))
    return f"{aligned(_HEADER, rows)}\n\n{_LEGEND}"


def _cells(numbers: Mapping[str, Any]) -> list[str]:
    bits = numbers["bits_per_detection"]
    return [
        _integer(numbers["images"]),
        _integer(numbers["detections"]),
        _number(numbers["mean_per_pixel"]),
        _percent(numbers["empty_share"]),
        _integer(numbers["ones"]),
        _percent(numbers["density"]),
        _integer(numbers["saturated_total"]),
        _bytes(numbers["bytes"]),
        "-" if bits is None else f"{bits:.1f}",
    ]


def _summed(parts: Sequence[Any]) -> Any:
    """Numbers under the same names added up, at every depth."""
    if not isinstance(parts[0], Mapping):
        return sum(parts)
    names = dict.fromkeys(name for part in parts for name in part)
    return {name: _summed([part[name] for part in parts if name in part]) for name in names}


def _saturated(manifest: Mapping[str, Any]) -> str:
    totals = _summed([row["saturated_pixels"] for row in level_rows(manifest)])
    named = [f"{method} {pixels:,}" for method, pixels in totals.items() if pixels]
    if not named:
        return ""
    return _wrapped(
        "saturated: pixels for which the formula of a method has no finite answer, so that a rule of the "
        f"method stands in ({', '.join(named)}; spadmnist methods NAME tells the rule)."
    )


def _causes(manifest: Mapping[str, Any]) -> str:
    """Share of the detections that each cause has, by level."""
    if not {"tr", "str", "qis"} & set(manifest["config"]["recording"]["readouts"]) or "causes" not in manifest:
        return ""
    names = manifest["causes"]
    rows = []
    for level in manifest["levels"]:
        facts = _summed(list(manifest["statistics"][level["text"]].values()))
        total = sum(facts["causes"].values())
        rows.append([level["text"], *(_percent(_ratio(facts["causes"][name], total)) for name in names)])
    readout = "TR" if "tr" in manifest["config"]["recording"]["readouts"] else "the frames"
    return f"causes: what made the detections of {readout}\n{aligned(['level', *names], rows)}"


def _normalisation(manifest: Mapping[str, Any]) -> str:
    medians = manifest["normalisation"]
    methods = [m for m in manifest["config"]["reconstruct"] if any(m in known for known in medians.values())]
    if not methods:
        return ""
    levels = [level["text"] for level in manifest["levels"]]
    rows = [[level, *(_number(medians[level].get(method)) for method in methods)] for level in levels]
    title = f"normalisation: the median of all non-zero pixels of the {_splits(manifest)[0]} split, photons/s"
    return f"{title}\n{aligned(['level', *methods], rows)}"


def aligned(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """First column to the left, the others to the right; more columns than fit go into a table below."""
    header, rows = list(map(visible, header)), [list(map(visible, row)) for row in rows]
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    groups: list[list[int]] = [[]]
    for i in range(1, len(header)):
        if groups[-1] and widths[0] + sum(widths[k] + 2 for k in (*groups[-1], i)) > _WIDTH:
            groups.append([])
        groups[-1].append(i)
    tables = []
    for group in groups:
        lines = [
            row[0].ljust(widths[0]) + "".join("  " + row[i].rjust(widths[i]) for i in group) for row in (header, *rows)
        ]
        tables.append("\n".join(line.rstrip() for line in lines))
    return "\n\n".join(tables)


def _wrapped(text: str) -> str:
    return "\n".join(textwrap.wrap(text, _WIDTH))


def _integer(value: float | None) -> str:
    return "-" if value is None else f"{value:,.0f}"


def _number(value: float | None) -> str:
    """Four digits, never in powers of ten."""
    if value is None:
        return "-"
    if value == 0:
        return "0"
    if value >= 1000:
        return f"{value:,.0f}"
    decimals = 4 if value < 1 else 3 - int(math.log10(value))
    return f"{value:.{decimals}f}"


def _percent(share: float | None) -> str:
    if share is None:
        return "-"
    return f"{100 * share:.1f} %" if share >= 0.0995 else f"{100 * share:.2g} %"


def _bytes(size: float) -> str:
    """`1.2 MB`, in powers of 1000."""
    units_left = ["TB", "GB", "MB", "kB", "B"]
    while size >= 999.5 and len(units_left) > 1:
        size /= 1000
        units_left.pop()
    unit = units_left[-1]
    return f"{size:.0f} {unit}" if unit == "B" or size >= 99.95 else f"{size:.1f} {unit}"


# --- the sheet ----------------------------------------------------------------------------------------------

_CLIP = 20.0  # normalised fluxes end here, as in the paper's figure of reconstructions
_SMALL, _LARGE = 168, 256  # points of the picture: images are magnified up to one, and reduced to the other
_LARGE_IMAGE = 128  # pixels; a larger image stands alone in its cell
_PIXELS_AT_HAND = 1 << 18  # for a median, where the whole training split would have to be simulated
_LETTER = 6.4  # points that one of the small print takes, at the most usual
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


def places_of(manifest: Mapping[str, Any], root: Path) -> np.ndarray | None:
    """(pixels, 2) m, where the pixels of a dataset's sensor lie; None on a grid. Raises InputError as the file's."""
    file = manifest["config"]["sensor"]["layout"].get("positions")
    return None if file is None else configs.read_positions(root / file)


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
    return reconstruct.median_of_nonzero(lambda: [some])


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
    cells = [_Cell("original", "grey level", *_grey(shown.originals))]
    if shown.first is not None and shown.counts is not None:
        caption = f"{_number(float(shown.counts.mean()))} detections/pixel"
        cells.append(_Cell("TR", "time of the first detection", _in_colours(shown.first, times), caption))
    if shown.bits is not None and shown.ones is not None:
        caption = f"{_percent(float(shown.bits.mean()))} ones"
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
        white = min(usual if 0 < 4 * usual < largest else largest, clip)
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
        caption = f"white: {white:.4g}, mean {float(values.mean(dtype=np.float64)):.3g}"
    return _bytes_of(rgb), caption


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


# --- measurements -------------------------------------------------------------------------------------------

_MOST_CAPTURES = 16  # of a picture
_BINS = 200  # of the course of a capture
_PER_DECADE = 10  # bins of intervals


@dataclass(frozen=True)
class Look:
    """What is shown of a capture. numbers: see `look.look`; the others only for a picture, of what was recorded.

    totals: (pixels,) detections; intervals: (edges, s; counts) of TR; course: (time, s; ones or counts of a frame,
    their standard error) of frames.
    """

    capture: Capture
    numbers: dict[str, Any]
    totals: np.ndarray | None = None
    intervals: tuple[np.ndarray, np.ndarray] | None = None
    course: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None


def looks(measurement: Measurement, drawn: bool) -> list[Look]:
    """Read the captures, one after the other. drawn: for a picture, too."""
    found = []
    for i, capture in enumerate(measurement.captures):
        unknown = capture.mean is not None or capture.id in measurement.missing
        recorded = None if unknown else measurement.recording(capture.id)
        numbers = look.look(measurement, capture, recorded)
        if recorded is None or not drawn or i >= _MOST_CAPTURES:
            found.append(Look(capture, numbers))
        elif recorded.events is not None:
            found.append(Look(capture, numbers, recorded.totals, _histogram_of_intervals(recorded)))
        else:
            found.append(Look(capture, numbers, recorded.totals, None, _course(recorded)))
    return found


def _histogram_of_intervals(recorded: Recording) -> tuple[np.ndarray, np.ndarray]:
    assert recorded.events is not None
    exposure, tick = recorded.conditions.exposure, recorded.events.tick or 1e-12
    decades = math.log10(exposure / tick)
    edges = tick * 10 ** np.linspace(0, decades, max(2, round(_PER_DECADE * decades) + 1))
    # edges between ticks, so that each bin holds the whole ones it covers
    edges = np.unique(np.round(edges / tick)) * tick - tick / 2
    counts = np.zeros(len(edges) - 1, np.int64)
    for piece in look.intervals(recorded.events):
        counts += np.histogram(piece, edges)[0]
    return edges, counts


def _course(recorded: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    sums = []
    for _, part in recorded.chunks():
        if recorded.modality == "qis":
            part = np.bitwise_count(part)
        elif recorded.modality == "str":
            part = part < recorded.none
        sums.append(part.reshape(len(part), -1).sum(axis=1, dtype=np.int64))
    whole = np.concatenate(sums).astype(float)
    starts = np.unique(np.linspace(0, len(whole), min(_BINS, len(whole)), endpoint=False).astype(int))
    sizes = np.diff([*starts, len(whole)])
    means = np.add.reduceat(whole, starts) / sizes
    time = (starts + sizes / 2) * recorded.conditions.exposure / len(whole)
    each = recorded.totals / len(whole)
    variance = each.sum() if recorded.modality == "counts" else (each * (1 - each)).sum()
    return time, means, np.sqrt(variance / sizes)


def capture_table(measurement: Measurement, looks: Sequence[Look]) -> str:
    """What a measurement is, and its captures (one row each). At most 100 characters wide."""
    layout = measurement.layout
    places = ", at places of their own" if layout.positions is not None else ""
    facts = {
        "name": measurement.name,
        "pixels": f"{layout.rows} x {layout.columns}{places}",
        "captures": f"{len(looks)}",
    }
    head = ("capture", "modality", "light", "recorded", "detections", "a pixel", "ones")
    made, seen = [], []
    for one in looks:
        n = one.numbers
        row = (_short(n["capture"]), n["modality"], n["light"], _recorded(n), _integer(n["detections"]))
        made.append((*row, _number(n["mean"]), _percent(n["ones_share"])))
        if n["detections"] is not None:
            rates = [units.show(n[f"rate_{what}"], "Hz", 3) for what in ("median", "min", "max")]
            odd = [_integer(n[f"{what}_pixels"]) for what in ("empty", "dead", "hot")]
            shortest = n["shortest_interval"]
            seen.append((row[0], *rates, *odd, "-" if shortest is None else units.show(shortest, "s")))
    blocks = [_facts(facts), aligned(head, made)]
    if seen:
        blocks += [aligned(_LOOK_HEADER, seen), _LOOK_LEGEND]
    blocks += [_wrapped(f"{one.capture.id}: {note}.") for one in looks for note in one.numbers["notes"]]
    return "\n\n".join(blocks)


_LOOK_HEADER = ("capture", "median rate", "min", "max", "empty", "dead", "hot", "shortest interval")
_LOOK_LEGEND = """\
a pixel: mean detections. ones: frames with a detection. rates: of a pixel, as recorded, while it is
live. empty: pixels without a detection. dead: those, where the median pixel has 20 or more.
hot: more than 5 times the median, beyond noise. shortest interval: within a pixel."""


def flux_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Flux images (see `fluxes.Fluxes.rows`), one row each, and what the methods were told of their captures."""
    made, told = [], {}
    for row in rows:
        numbers = (_number(row[what]) for what in ("mean", "median", "min", "max"))
        made.append((_short(row["capture"]), row["method"], *numbers, _integer(row["saturated_pixels"]), row["unit"]))
        clock = (units.show(row[what], "s") for what in ("time", "dead_time"))
        told[row["capture"]] = (_short(row["capture"]), row["modality"], f"{row['pdp']:.4g}", *clock)
    head = ("capture", "method", "mean", "median", "min", "max", "saturated", "unit")
    blocks = [aligned(head, made), aligned(("capture", "modality", "q", "T", "dead time"), list(told.values()))]
    return "\n\n".join([*blocks, _FLUX_LEGEND])


_FLUX_LEGEND = """\
mean to max: over the pixels. saturated: pixels in which a rule stands in for the formula of the
method (spadmnist methods NAME tells it). q: nominal PDP. T: exposure, or frames x frame time."""


def _short(text: str, most: int = 24) -> str:
    text = visible(text)
    return text if len(text) <= most else f"{text[: most - 3]}..."


def _recorded(numbers: Mapping[str, Any]) -> str:
    if numbers["frames"] is None:
        return units.show(numbers["exposure"], "s")
    frames = f"{numbers['frames']:,} x {units.show(numbers['frame_time'], 's')}"
    if numbers["binary_frames"] == 1:
        return frames
    frames = f"{numbers['frames']:,} x {numbers['binary_frames']:,} x {units.show(numbers['frame_time'], 's')}"
    return f"{frames} = {units.show(numbers['live'], 's')}"


def capture_sheet(measurement: Measurement, looks: Sequence[Look], path: str | Path) -> None:
    """Draw a PNG with a row for each capture: the map of rates, their histogram, and intervals (TR) or the course of
    the frames. Raises SpadError where it cannot be written, or where there are no data.
    """
    shown = [one for one in looks if one.totals is not None]
    if not shown:
        raise SpadError(f"{measurement.source}: of no capture are there data to draw; only means are known")
    pictures.save(_draw_captures(measurement, shown, len(looks)), Path(path))


def _draw_captures(measurement: Measurement, looks: Sequence[Look], captures: int) -> bytes:
    def draw(figure: Any) -> None:
        rest = f", {len(looks)} of {captures} captures" if len(looks) < captures else ""
        figure.suptitle(
            f"{pictures.words(_short(measurement.name, 80))}: {_size_of(measurement)} pixels{rest}", fontsize=13
        )
        cells = figure.subplots(len(looks), 3, squeeze=False, width_ratios=(1, 1.2, 1.6))
        for row, one in zip(cells, looks, strict=True):
            _rate_map(row[0], measurement, one)
            _rate_histogram(row[1], one)
            if one.intervals is not None:
                _interval_plot(row[2], one)
            else:
                _course_plot(row[2], one)

    return pictures.png(13, 0.9 + 2.7 * len(looks), draw)


def _size_of(measurement: Measurement) -> str:
    return f"{measurement.layout.rows} x {measurement.layout.columns}"


def _rate_map(axes: Any, measurement: Measurement, one: Look) -> None:
    assert one.totals is not None
    rates = one.totals / one.numbers["live"]
    # a few hot or dead pixels must not take the colours from the rest
    below, median, above = np.quantile(rates, [0.16, 0.5, 0.84])
    spread = max(float(above - below) / 2, 1 / one.numbers["live"])
    low, high = max(float(rates.min()), median - 4 * spread), min(float(rates.max()), median + 4 * spread)
    high = max(high, low + spread)  # where all pixels are alike, as without any detection
    scale, unit = _scaled(float(high))
    name = pictures.words(_short(one.capture.id))
    axes.set_title(f"{name}: {one.numbers['light']}, {_recorded(one.numbers)}", loc="left")
    label = f"detections / pixel, {unit}"
    pictures.draw_map(axes, measurement.layout, rates * scale, low * scale, high * scale, label)


def _scaled(value: float) -> tuple[float, str]:
    """(factor, unit) that bring a rate in Hz between 1 and 1000."""
    unit = units.show(value, "Hz", 17).split()[1] if value > 0 else "Hz"
    return 1 / float(units.parse(f"1 {unit}", "Hz")), unit


def _rate_histogram(axes: Any, one: Look) -> None:
    """Of detections a pixel, in bins of whole numbers, beside the law if all pixels were alike."""
    from scipy.special import gammaln, xlog1py, xlogy

    assert one.totals is not None
    totals, live, frames = one.totals, one.numbers["live"], one.numbers["frames"]
    binary = one.capture.modality in ("qis", "str")
    median = float(np.median(totals))
    inner = totals[totals <= 3 * median + 20]
    usual = inner[np.abs(inner - median) <= 5 * math.sqrt(median * (1 - median / frames if binary else 1) + 1)]
    mean = float(usual.mean())
    low, high = int(inner.min()), int(inner.max())
    bins = int(np.clip(2 * math.sqrt(len(inner)), 12, 50))
    width = max(1, -(-(high - low + 1) // bins))
    edges = np.arange(low, high + width + 1, width)
    scale, unit = _scaled(high / live)
    to_rate = scale / live
    axes.stairs(np.histogram(inner, edges)[0], (edges - 0.5) * to_rate, fill=True, color="0.75", label="pixels")
    n = np.arange(edges[0], edges[-1])
    if binary:
        p = min(mean / frames, 1.0)
        n = np.minimum(n, frames)
        ways = gammaln(frames + 1) - gammaln(n + 1) - gammaln(frames - n + 1)
        law, name = np.exp(ways + xlogy(n, p) + xlog1py(frames - n, -p)), "binomial law"
    else:
        law, name = np.exp(xlogy(n, mean) - mean - gammaln(n + 1)), "Poisson law"
    sums = np.add.reduceat(law, edges[:-1] - edges[0]) * len(usual)
    axes.stairs(sums, (edges - 0.5) * to_rate, color="tab:orange", label=f"{name}, equal pixels")
    beyond = len(totals) - len(inner)
    more = f" ({beyond:,} beyond)" if beyond else ""
    axes.margins(y=0.3)  # room for the legend
    axes.set(xlabel=f"detections of a pixel, {unit}{more}", ylabel="pixels")
    if low == 0:  # half of the bar of no detections lies below
        axes.set_xlim(left=0)
    axes.legend(frameon=False, fontsize=7, loc="upper right")


def _interval_plot(axes: Any, one: Look) -> None:
    assert one.intervals is not None and one.totals is not None
    edges, counts = one.intervals
    exposure = one.numbers["exposure"]
    if not counts.sum():
        axes.text(0.5, 0.5, "no two detections in a pixel", ha="center", transform=axes.transAxes)
        axes.set_axis_off()
        return
    widths = np.diff(edges)
    axes.stairs(counts / widths, np.maximum(edges, 1e-15), color="tab:blue", label="intervals of a pixel")
    # each pixel steady at its own rate, and nothing else
    expected = np.zeros(len(counts))
    for total, pixels in zip(*np.unique(one.totals, return_counts=True), strict=True):
        if total > 1:
            expected += pixels * (total - 1) * -np.diff(np.exp(-total / exposure * edges))
    axes.stairs(expected / widths, np.maximum(edges, 1e-15), color="tab:orange", label="steady light, no dead time")
    shortest = one.numbers["shortest_interval"]
    if shortest:
        axes.axvline(
            shortest, color="0.6", linewidth=0.8, linestyle=":", label=f"shortest: {units.show(shortest, 's')}"
        )
    some = counts > 0
    low, high = float((counts / widths)[some].min()), float(max((counts / widths).max(), (expected / widths).max()))
    right = edges[1:][some].max()
    axes.set(xscale="log", yscale="log", ylim=(low / 2, high * 2 * (high / low) ** 0.25))
    axes.set(xlim=(max(edges[0], (shortest or 0) / 5), right), xlabel="interval, s", ylabel="intervals / s")
    axes.legend(frameon=False, fontsize=7, loc="upper right")


def _course_plot(axes: Any, one: Look) -> None:
    assert one.course is not None
    time, means, errors = one.course
    # where frames are all alike, the errors are 0 and the means the same
    mean = float(np.average(means, weights=errors**-2) if (errors > 0).all() else means.mean())
    factor = next(f for f, _ in _TIMES if time[-1] * f >= 1 or f == _TIMES[-1][0])
    unit = dict(_TIMES)[factor]
    axes.fill_between(time * factor, mean - 2 * errors, mean + 2 * errors, color="0.88", label="2 standard errors")
    axes.plot(time * factor, means, color="tab:blue", linewidth=0.9)
    what = "counts" if one.capture.modality == "counts" else "ones"
    axes.margins(y=0.2)
    axes.set(xlabel=f"time, {unit}", ylabel=f"{what} of a frame", ylim=(max(0.0, axes.get_ylim()[0]), None))
    axes.legend(frameon=False, fontsize=7, loc="upper right")


_TIMES = ((1.0, "s"), (1e3, "ms"), (1e6, "us"), (1e9, "ns"))
