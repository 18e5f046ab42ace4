"""What a dataset is a function of: config, images, maps, plug-ins, and the numbers of what draws and writes it.

No version of a library is among them. Two programs that know the same numbers make the same bytes, or say that they
cannot (`golden`).
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from . import imported, plugins, reconstruct, store
from .errors import SpadError
from .experiment import Experiment
from .images import Images
from .positions import positions_text

FORMAT = "spadmnist-dataset/1"
STREAM = 1  # raised when any number is drawn otherwise
POSITIONS = "maps/layout.positions.csv"


def identity(experiment: Experiment, splits: Mapping[str, Images]) -> dict[str, Any]:
    """What a dataset is a function of, as a manifest holds it."""
    any_split = next(iter(splits.values()))
    resolved, maps = portable(experiment)
    return {
        "format": FORMAT,
        "stream": STREAM,
        "encoding": experiment.encoding.number,
        "config": resolved,
        "images": {
            "shape": list(any_split.pixels.shape[1:]),
            "dtype": any_split.pixels.dtype.name,
            "white": float(any_split.white),
            "splits": {
                split: {
                    "images": experiment.wanted(images),
                    "sha256": images.head(experiment.wanted(images)).sha256,
                    **({} if images.tiles is None else {"tiles": images.tiles.facts()}),
                }
                for split, images in splits.items()
            },
        },
        "maps": {name: _known_by(name, data) for name, data in maps.items()},
        "plugins": plugin_sources(experiment),
    }


def held(kept: Mapping[str, Any]) -> dict[str, Any]:
    """The identity that a manifest, or the plan of a run, holds; what came before the numbers has the first ones."""
    keys = ("format", "stream", "encoding", "config", "images", "maps", "plugins")
    kept = {"stream": 1, "encoding": 1, **kept}
    return {key: kept.get(key) for key in keys}


def written_as(experiment: Experiment, kept: Mapping[str, Any]) -> Experiment:
    """The experiment with the encoding of what a manifest or a plan holds, which a run goes on with.

    Raises InputError where that one is not known here.
    """
    config = kept.get("config")
    output = config.get("output") if isinstance(config, dict) else None
    if not isinstance(output, dict) or output.get("format") != experiment.format:
        return experiment  # it is another dataset
    return replace(experiment, encoding=store.encoding(experiment.format, held(kept)["encoding"]))


_ELSEWHERE = "choose another folder with -o, or remove it"


def refuse_other(root: Path, wanted: Mapping[str, Any], kept: Mapping[str, Any], do: str = _ELSEWHERE) -> None:
    """Raise SpadError where what a manifest or a plan holds is another identity than the wanted one.

    do: what the user can do then.
    """
    lines = _difference(wanted, held(kept))
    if lines:
        more = f" (and {len(lines) - 4} more)" if len(lines) > 4 else ""
        raise SpadError(f"{root} holds another dataset: {'; '.join(lines[:4])}{more}; {do}")


def plugin_sources(experiment: Experiment) -> list[dict[str, str]]:
    """The files that define the user's own effects and methods of an experiment, whole, and those that they import.

    Of what is installed the distribution and its version stand for its files.
    """
    classes = [type(e) for e in experiment.sensor.effects] + [type(reconstruct.find(m)) for m in experiment.methods]
    used = {plugins.source_file(cls) for cls in classes}
    found, own = [], set(imported.own_modules(cls.__module__ for cls in classes if plugins.is_installed(cls)))
    for path, text in plugins.loaded_files().items():
        if str(path) in used:
            found.append(_source(path.name, hashlib.sha256(text.encode()).hexdigest(), text))
            own |= set(plugins.imports_of(path))
    found += [_source(one.file, one.sha256, one.text) for one in own]
    for name, version in sorted({pair for cls in classes if (pair := plugins.distribution(cls))}):
        found.append({"distribution": name, "version": version})
    return sorted(found, key=lambda one: (one.get("file", ""), one.get("sha256", "")))


def _source(file: str, sha256: str, text: str | None) -> dict[str, str]:
    return {"file": file, "sha256": sha256, **({} if text is None else {"source": text})}


def portable(experiment: Experiment) -> tuple[dict[str, Any], dict[str, bytes]]:
    """(config, map files) that stand on their own: maps and positions from files become files of the dataset."""
    resolved = json.loads(json.dumps(experiment.resolved))
    layout = experiment.sensor.layout
    maps: dict[str, bytes] = {}
    if layout.positions is not None:
        maps[POSITIONS] = positions_text(layout.positions).encode()
        resolved["sensor"]["layout"]["positions"] = POSITIONS
    for name, values in resolved["sensor"]["effects"].items():
        for key, raw in values.items():
            if isinstance(raw, dict) and set(raw) == {"file"}:
                effect = experiment.sensor.effect(name)
                array = np.asarray(getattr(effect, key))
                if effect is not None and effect.parameters[key].per_pixel:
                    array = array.reshape(layout.shape)
                buffer = io.BytesIO()
                np.save(buffer, array)
                maps[f"maps/{name}.{key}.npy"] = buffer.getvalue()
                values[key] = {"file": f"maps/{name}.{key}.npy"}
    return resolved, maps


def _known_by(name: str, data: bytes) -> dict[str, str] | str:
    """What a manifest keeps of a map: its digest; of the positions, which are small, also the text itself."""
    digest = hashlib.sha256(data).hexdigest()
    return {"sha256": digest, "text": data.decode()} if name == POSITIONS else digest


def _difference(ours: Any, theirs: Any, path: str = "") -> list[str]:
    if isinstance(ours, dict) and isinstance(theirs, dict):
        out = []
        for key in sorted(set(ours) | set(theirs)):
            out += _difference(ours.get(key), theirs.get(key), f"{path}.{key}" if path else str(key))
        return out
    return [] if ours == theirs else [f"{path}: {_short(theirs)} there, {_short(ours)} asked for"]


def _short(value: Any) -> str:
    text = "nothing" if value is None else json.dumps(value)
    return text if len(text) <= 70 else text[:67] + "..."
