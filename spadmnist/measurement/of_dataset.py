"""A dataset of uniform light, or of a chart, as a measurement: every image is a capture of its own, a repetition of the
others at its light level.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from .. import config, dataset, manifest_file, recording
from ..document import Document
from ..errors import InputError
from ..events import Layout
from ..images import Chart, Uniform
from ..readout import Recorded
from ..recording import MODALITIES, Capture, Light, Recording
from ..scene import Scene
from .type import Measurement


def of_dataset(root: Path, readout: str | None) -> Measurement:
    """Every image of every level is a capture: `5 mlux`, or `5 mlux #0`, `5 mlux #1`, ... where there are several.

    Of a chart, the capture is of a scene; where each split is another chart, its name stands before the number.
    readout: which one to take; without it the first of `MODALITIES` that was recorded. Raises InputError where the
    images are neither uniform nor grey charts, or the readout was not recorded.
    """
    manifest = manifest_file.intact_manifest(root)
    experiment = config.build(Document(str(root), manifest["config"]), root)
    source = experiment.source
    if not isinstance(source, Uniform | Chart):
        raise InputError(
            f"{root}: is a dataset of {source.describe()}; only one whose source is uniform or a chart is a measurement"
        )
    if isinstance(source, Chart) and len(manifest["images"]["shape"]) > 2:
        raise InputError(f"{root}: is a dataset of a chart in colour; only that of a grey one is a measurement")
    if readout is not None and readout not in experiment.readouts:
        raise InputError(f"{root}: {readout} was not recorded; there are {', '.join(experiment.readouts)}")
    chosen = readout or next(name for name in MODALITIES if name in experiment.readouts)
    stored = dataset.stored(root)
    images = [(level, split, i) for level in experiment.levels for split in stored.splits for i in _each(stored, split)]
    repeated = len(images) > len(experiment.levels)
    conditions = experiment.conditions
    if chosen != "counts":
        conditions = replace(conditions, bits=0, counting="frames")
    if chosen == "tr":
        exposure = conditions.exposure
        conditions = replace(conditions, frames=1, frame_time=exposure, frame_period=exposure)
    scenes: dict[str, Scene] = {}
    if isinstance(source, Chart):
        white = manifest["images"]["white"]
        for split in stored.splits:
            part = stored[stored.levels[0], split]
            chart = part.images[0]
            seen = chart if chart.dtype == np.uint8 else chart / float(white)
            scenes[split] = Scene(f"{split}.npy", seen, part.tiles)
    captures = []
    for level, split, i in images:
        share = source.grey / 255 if isinstance(source, Uniform) else 1.0
        lit = (
            Light(conditions.wavelength, level.value * share, level.kind, scene=scenes.get(split)) if share else Light()
        )
        id = f"{level.text} #{i}" if repeated else level.text
        if len(scenes) > 1:
            id = f"{level.text} {split} #{i}"
        captures.append(Capture(id, chosen, lit, replace(conditions, wavelength=lit.wavelength, scene=lit.scene)))

    def read(index: int, layout: Layout, dead_time: float) -> tuple[Recording, list[str]]:
        level, split, i = images[index]
        part = stored[level.text, split]
        pixels = layout.pixels
        if chosen == "tr":
            recorded = Recorded(pixels, part.tr[i : i + 1])
        elif chosen == "counts":
            tally = part.counts[i]
            recorded = Recorded(pixels, tally=tally.reshape(len(tally), -1).T)
        else:
            recorded = Recorded(pixels, frames=part.frames[i : i + 1])
        return recording.of_image(recorded, 0, captures[index], layout, dead_time), []

    theirs = experiment.sensor.layout
    layout = Layout(theirs.rows, theirs.columns, np.nan, np.nan, theirs.positions)
    return Measurement(experiment.sensor.name or root.name, layout, tuple(captures), str(root), read)


def _each(stored: dataset.Dataset, split: str) -> range:
    return range(len(stored[stored.levels[0], split]))
