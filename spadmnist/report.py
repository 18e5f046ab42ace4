"""What a dataset holds, for people: the table of its light levels, and a sheet of its pictures.

The only module that imports matplotlib, and only where a picture is drawn.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import dataset as datasets
from . import reconstruct, units
from .dataset import Dataset, Part
from .errors import SpadError
from .readout import Frames

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WIDTH = 100  # characters of a table

# --- the table ----------------------------------------------------------------------------------------------------


def level_rows(manifest: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One row per light level and split, in the config's order; a number that was not recorded is None.

    detections, mean_per_pixel, empty_share: of TR (empty_share of the frames where there is no TR); ones, density:
    frames with a detection, and their share of all frames; saturated_pixels: by method, saturated_total: their sum;
    bytes, bytes_by_kind: on disk, without the original images; bits_per_detection: of TR, None where the format does
    not tell the bytes of TR apart.
    """
    frames = manifest["settings"]["frames"]
    rows = []
    for level in manifest["levels"]:
        for split, facts in manifest["statistics"][level["text"]].items():
            row = {"level": level["text"], "kind": level["kind"], "value": level["value"], "split": split}
            rows.append(row | _numbers(facts, frames))
    return rows


def _numbers(facts: Mapping[str, Any], frames: int) -> dict[str, Any]:
    """What `level_rows` says of some images, from what the manifest's `statistics` holds of them."""
    tr, framed = facts.get("tr"), facts.get("frames")
    detections = tr["detections"] if tr else None
    ones = framed["detections"] if framed else None
    pixels, by_kind = facts["pixels"], facts["bytes"]
    return {
        "images": facts["images"],
        "pixels": pixels,
        "detections": detections,
        "mean_per_pixel": _ratio(detections, pixels),
        "empty_share": _ratio((tr or framed or {}).get("empty_pixels"), pixels),
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
    saturated = _saturated(manifest)
    if saturated:
        blocks.append(saturated)
    blocks.append(_normalisation(manifest))
    return "\n\n".join(block for block in blocks if block)


def _about(manifest: Mapping[str, Any]) -> str:
    config, splits = manifest["config"], manifest["images"]["splits"]
    sensor, recording = config["sensor"], config["recording"]
    size = " x ".join(str(n) for n in manifest["images"]["shape"])
    each = " and ".join(f"{facts['images']:,} {split}" for split, facts in splits.items())
    levels = len(manifest["levels"])
    stored = sum(facts["bytes"] for facts in manifest["files"].values()) + len(datasets.seal(dict(manifest)))
    frames = ""
    if set(recording["readouts"]) & {"str", "qis"}:
        frames = f", {recording['frames']:,} frames of {recording['frame_time']}"
    facts = {
        "images": f"{each}, {size}, at {levels} light level{'s' if levels > 1 else ''}",
        "sensor": f"{sensor['name'] or 'without a name'}, rules: {sensor['rules']}",
        "recording": f"{recording['exposure']}{frames}; {', '.join(recording['readouts'])}",
        "seed": str(manifest["seed"]),
        "stored": f"{_bytes(stored)} in {len(manifest['files']) + 1:,} files, {config['output']['format']}",
    }
    return "\n".join(f"{name:<9}  {text}" for name, text in facts.items())


def _levels(manifest: Mapping[str, Any], by_split: bool) -> str:
    frames = manifest["settings"]["frames"]
    header = ["level", "images", "detections", "per pixel", "empty", "ones", "density", "saturated", "size", "bits/det."]
    rows = []
    for level in manifest["levels"]:
        splits = manifest["statistics"][level["text"]]
        groups = splits if by_split else {"": _summed(list(splits.values()))}
        for split, facts in groups.items():
            n = _numbers(facts, frames)
            rows.append(
                [
                    f"{level['text']} {split}".strip(),
                    f"{n['images']:,}",
                    _integer(n["detections"]),
                    _number(n["mean_per_pixel"]),
                    _percent(n["empty_share"]),
                    _integer(n["ones"]),
                    _percent(n["density"]),
                    f"{n['saturated_total']:,}",
                    _bytes(n["bytes"]),
                    "-" if n["bits_per_detection"] is None else f"{n['bits_per_detection']:.1f}",
                ]
            )
    return _aligned(header, rows)


def _summed(parts: Sequence[Any]) -> Any:
    """Numbers of the same names added up, at every depth."""
    if isinstance(parts[0], Mapping):
        return {key: _summed([part[key] for part in parts if key in part]) for key in dict.fromkeys(k for p in parts for k in p)}
    return sum(parts)


def _saturated(manifest: Mapping[str, Any]) -> str:
    totals: dict[str, int] = {}
    for row in level_rows(manifest):
        for method, pixels in row["saturated_pixels"].items():
            totals[method] = totals.get(method, 0) + pixels
    named = ", ".join(f"{method} ({pixels:,})" for method, pixels in totals.items() if pixels)
    return _wrapped(
        f"Saturated are pixels for which a method's formula has no finite answer, so that its rule stands in: {named}. "
        "spadmnist methods NAME says which."
    ) if named else ""


def _normalisation(manifest: Mapping[str, Any]) -> str:
    medians = manifest["normalisation"]
    methods = list(dict.fromkeys(method for by_method in medians.values() for method in by_method))
    if not methods:
        return ""
    rows = [
        [level["text"], *(_integer(medians[level["text"]].get(method)) for method in methods)]
        for level in manifest["levels"]
    ]
    title = _wrapped("Normalisation: the median of the non-zero pixels of the training images, photons/s")
    return f"{title}\n{_aligned(['level', *methods], rows)}"


def _aligned(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """First column to the left, the others to the right; more columns than fit go into a table below."""
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
        tables.append("\n".join(lines))
    return "\n\n".join(tables)


def _wrapped(text: str) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text, _WIDTH))


def _integer(value: float | None) -> str:
    return "-" if value is None else f"{value:,.0f}"


def _number(value: float | None) -> str:
    """Four digits, never in powers of ten."""
    if value is None:
        return "-"
    if value >= 1000:
        return f"{value:,.0f}"
    decimals = 4 if value < 1 else 3 - int(math.log10(value))
    return f"{value:.{decimals}f}"


def _percent(share: float | None) -> str:
    if share is None:
        return "-"
    return f"{100 * share:.1f} %" if share >= 0.0995 or share == 0 else f"{100 * share:.2g} %"


def _bytes(size: float) -> str:
    """`1.2 MB`, in powers of 1000."""
    for unit in ("B", "kB", "MB", "GB"):
        if size < 999.5:
            break
        size /= 1000
    else:
        unit = "TB"
    return f"{size:.0f} {unit}" if unit == "B" or size >= 99.95 else f"{size:.1f} {unit}"
