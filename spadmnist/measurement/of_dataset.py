"""A dataset of uniform images as a measurement: every image is a capture of its own, a repetition of the others at its
light level.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from .. import config, dataset, recording
from ..document import Document
from ..errors import InputError
from ..events import Layout
from ..images import Uniform
from ..readout import Recorded
from ..recording import MODALITIES, Capture, Light, Recording
from .type import Measurement


def of_dataset(root: Path, readout: str | None) -> Measurement:
    """Every image of every level is a capture: `5 mlux`, or `5 mlux #0`, `5 mlux #1`, ... where there are several.

    readout: which one to take; without it the first of `MODALITIES` that was recorded. Raises InputError where the
    images are not uniform, or the readout was not recorded.
    """
    manifest = dataset.intact_manifest(root)
    experiment = config.build(Document(str(root), manifest["config"]), root)
    uniform = experiment.source
    if not isinstance(uniform, Uniform):
        raise InputError(
            f"{root}: is a dataset of {uniform.describe()}; only one whose source is uniform is a measurement"
        )
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
    captures = []
    for level, _, i in images:
        lit = Light(conditions.wavelength, level.value * uniform.grey / 255, level.kind) if uniform.grey else Light()
        id = f"{level.text} #{i}" if repeated else level.text
        captures.append(Capture(id, chosen, lit, replace(conditions, wavelength=lit.wavelength)))

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
