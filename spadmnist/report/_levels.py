"""The table of a dataset: what it is, its light levels, its normalisation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..manifest_file import seal, shards_in
from . import _text as text


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
    return list(dict.fromkeys(shard.split for shard in shards_in(manifest)))


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
    stored = sum(facts["bytes"] for facts in manifest["files"].values()) + len(seal(dict(manifest)))
    framed = ""
    if set(recording["readouts"]) & {"str", "qis"}:
        framed = f", {recording['frames']:,} frames of {recording['frame_time']}"
    facts = {
        "images": f"{each}, {size} pixels, at {levels}",
        "sensor": f"{sensor['name'] or 'unnamed'}, rules: {sensor['rules']}",
        "recording": f"{recording['exposure']}{framed}; {', '.join(recording['readouts'])}",
        "seed": str(manifest["seed"]),
        "stored": f"{text.size(stored)} in {len(manifest['files']) + 1:,} files, {config['output']['format']}",
    }
    return text.facts(facts)


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
    return f"{text.aligned(_HEADER, rows)}\n\n{_LEGEND}"


def _cells(numbers: Mapping[str, Any]) -> list[str]:
    bits = numbers["bits_per_detection"]
    return [
        text.integer(numbers["images"]),
        text.integer(numbers["detections"]),
        text.number(numbers["mean_per_pixel"]),
        text.percent(numbers["empty_share"]),
        text.integer(numbers["ones"]),
        text.percent(numbers["density"]),
        text.integer(numbers["saturated_total"]),
        text.size(numbers["bytes"]),
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
    return text.wrapped(
        "saturated: pixels for which the formula of a method has no finite answer, so that a rule of the "
        f"method stands in ({', '.join(named)}; spadmnist methods NAME states the rule)."
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
        rows.append([level["text"], *(text.percent(_ratio(facts["causes"][name], total)) for name in names)])
    readout = "TR" if "tr" in manifest["config"]["recording"]["readouts"] else "the frames"
    return f"causes: what made the detections of {readout}\n{text.aligned(['level', *names], rows)}"


def _normalisation(manifest: Mapping[str, Any]) -> str:
    medians = manifest["normalisation"]
    methods = [m for m in manifest["config"]["reconstruct"] if any(m in known for known in medians.values())]
    if not methods:
        return ""
    levels = [level["text"] for level in manifest["levels"]]
    rows = [[level, *(text.number(medians[level].get(method)) for method in methods)] for level in levels]
    title = f"normalisation: the median of all non-zero pixels of the {_splits(manifest)[0]} split, photons/s"
    return f"{title}\n{text.aligned(['level', *methods], rows)}"
