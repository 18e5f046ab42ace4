"""The page of the formats: what lies where in a dataset and in a measurement, and the JSON answers.

Files are listed by making a small dataset and a small measurement and looking into them.
"""

from __future__ import annotations

import inspect
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import spadmnist
from spadmnist import capture_files, config, document, factory, shard_plan, store
from spadmnist.inference.candidates import Candidate
from spadmnist.inference.checks import Check
from spadmnist.inference.comparison import Comparison
from spadmnist.inference.light_levels import Nuisance
from spadmnist.inference.results import Diagnosis, Step, Value

from . import markdown as md

# a dataset with everything that one may hold
_DATASET = """
seed: 1
causes: true
scene: {images: {source: digits, train: 2, test: 0, rows: 8, columns: 8}, lux: [1 lux]}
recording:
  {exposure: 300 us, frames: 30, frame_time: 10 us, readouts: [tr, str, qis, counts], bits: 4}
sensor:
  layout: {rows: 8, columns: 8, pixel_area: 25 um^2}
  effects: {detection: {pdp: 0.5}, tdc: {resolution: 10 ps}}
"""

# key of a JSON answer -> what it says; a key that is not here is an error of the build
MEANINGS = {
    "format": "name and number of the format",
    "verdict": "`compare`: `adequate` or `fails`. `diagnose`: `adequate`, `setup`, `explained`, `confused`, "
    "`partly_explained` or `unexplained`. `fit`: `adequate`, `explained` or `partly_explained`",
    "finished": "`false` where the budget of `--within` ended the diagnosis, which then begins with NOT FINISHED: "
    "`unexplained` says nothing yet",
    "misfit": "mean over (statistic, capture) of the mean squared standardised residual; 1 is the model's own scatter",
    "misfit.before": "misfit of the sensor that was given",
    "misfit.after": "misfit of the model that was found, each capture judged by parameters fitted without it",
    "compared": "what alone was compared with the model, where that is not every statistic",
    "misfit_in_sample": "misfit with all captures in the fit, which `compare` has of the next "
    "sensor file (`--quick`: from 32 simulations in place of 96); null: not measured",
    "misfit_null_95": "95 % quantile of the misfit of a right model",
    "false_alarm_rate": "probability that a right model is called wrong",
    "replicates": "simulations of each capture",
    "tolerance": "relative deviation up to which a failing check passes; `null`: none",
    "crop": "the part of the sensor that was measured, where `--crop` was given",
    "nuisances": "light levels that were fitted",
    "nuisances[].capture": "capture; `null`: all captures together",
    "nuisances[].name": "name of the nuisance parameter",
    "nuisances[].value": "fitted value, relative to what the measurement states",
    "nuisances[].low": "lower end of the 95 % interval",
    "nuisances[].high": "upper end of the 95 % interval",
    "nuisances[].pull": "deviation from the stated value, in its standard uncertainties",
    "checks": "one entry for each statistic of each capture",
    "checks[].statistic": "name of the statistic",
    "checks[].capture": "capture; `null`: all captures together",
    "checks[].misfit": "mean squared standardised residual of this check",
    "checks[].p_value": "p-value of this check, before the correction for the number of checks",
    "checks[].passes": "whether the model passes",
    "checks[].material": "whether a significant deviation exceeds the tolerance",
    "checks[].where": "the cell that shows the deviation most, in words",
    "checks[].size": "the deviation there in physical units, in words",
    "steps": "accepted changes of the model, in order",
    "steps[].change": "`add`: an effect that the sensor lacks; `set`: another value; `per_pixel`: a map",
    "steps[].effect": "name of the effect",
    "steps[].parameter": "name of the parameter; `null` for `add`",
    "steps[].values": "fitted values by parameter",
    "steps[].values.*.value": "value, SI",
    "steps[].values.*.low": "lower end of the 95 % interval",
    "steps[].values.*.high": "upper end of the 95 % interval",
    "steps[].values.*.unit": "SI unit",
    "steps[].values.*.method": "how it was estimated: by the exact `likelihood`, by `simulation`, of a map by "
    "`counts`, `intervals` or the statistic that informs it",
    "steps[].misfit": "misfit after this step",
    "steps[].significance": "improvement in standard deviations",
    "steps[].material": "how far the step changes what is recorded, in words; with `in_sensor: false` where "
    "the sensor file lacks the step, because the set-up explains the totals as well",
    "steps[].alternatives": "other changes that explain the same residuals, with their misfit",
    "setup": "errors of the set-up: light level, exposure, wavelength or a leak, with the factor and its interval",
    "unexplained": "significant residuals that no step explains: statistic, capture, place, `nearest` alternatives",
    "ladder": "misfit and errors of each model from the start on; `placebo`: an effect that was not needed",
    "advice": "captures that would separate what is confused, with the significance now and then",
    "not_compared": "checks that were left out, because some simulations have too few data for them",
    "not_compared[].statistic": "name of the statistic",
    "not_compared[].capture": "name of the capture",
    "excluded": "effects that are not there, with the upper limit (95 %) of their strength; with `at_least` where an "
    "effect vanishes at the upper end of its range: then the value is at least that",
    "not_identifiable": "effects that the captures cannot show",
    "no_limit": "effects without a finding and without an upper limit",
    "not_tried": "candidates that were not tried, and why",
    "sensor": "the sensor file that was written; `null` without one",
}


def page() -> str:
    """The page of the formats."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        arrays, measurement = _dataset(place / "dataset"), _measurement(place / "measurement")
    return md.page(
        "Formats",
        "## A dataset",
        "A dataset is a folder. Each light level and split is cut into shards. A shard is one file: a zip that holds "
        "a Zarr v3 group, its members stored, or an HDF5 file. `manifest.json` lists every file with its size and "
        "SHA-256. Its own `sha256` is the identity of the dataset. `stream` and `encoding` number what draws and what "
        "writes the bytes. `provenance` holds the versions by which the dataset was finished. It is no part of the "
        "identity, and has its own digest.",
        "Shards lie in these places. All encodings are read, verified, repaired and gone on with; a new dataset has "
        "the newest of its format.",
        _encodings(),
        "Arrays of a Zarr shard. `image` and `label` are coordinates of each group; other encodings have none.",
        arrays,
        "## A measurement",
        "A measurement is a folder with `measurement.yaml` ([its keys](measurement.md)) and one HDF5 file a capture.",
        _rest_of(capture_files.__doc__),
        "Files that `spadmnist simulate` writes:",
        measurement,
        "## Answers as JSON",
        "`compare --json FILE`, `diagnose --json FILE` and `fit --json FILE` write these.",
        *(block for kind, data in answers().items() for block in (f"### {kind}", _keys(data))),
    )


def _rest_of(doc: str | None) -> str:
    """A module's docstring without its first line."""
    text = inspect.cleandoc(doc or "").partition("\n\n")[2]
    return "\n\n".join(
        block if block.startswith("|") else md.plain(" ".join(block.split())) for block in text.split("\n\n")
    )


# --- files --------------------------------------------------------------------------------------------------------


def _dataset(place: Path) -> str:
    """A table of the arrays of a small dataset."""
    experiment = config.build(document.parse(_DATASET, "config"), Path())
    factory.generate(experiment, experiment.load_images(), place, 1)
    rows = []
    for shard in shard_plan.shards_of(experiment, experiment.load_images()):
        reader = experiment.encoding.reader(place, shard.path)
        for name in reader.names:
            where = f"{shard.folder}/{shard.split}: {name}"
            dims = ", ".join(reader.dims(name))
            facts = (reader.dtype(name).name, f"({dims})", reader.unit(name))
            rows.append([md.literal(where), md.plain(reader.about(name)), *facts])
    return md.table(("array of a shard", "what it is", "type", "dimensions", "unit"), rows)


def _encodings() -> str:
    """A table of the places of shards."""
    rows = []
    for format in store.FORMATS:
        for one in store.encodings(format):
            what = "a folder of files" if not one.one_file else "one file"
            rows.append([format, str(one.number), md.literal(one.location("LEVEL/SPLIT/NUMBER")), what])
    return md.table(("format", "encoding", "place of a shard", ""), rows)


def _measurement(place: Path) -> str:
    """A table of the data sets of small captures, one of each modality."""
    import h5py

    sensor = spadmnist.Sensor(spadmnist.Layout(4, 12, 25e-12, 1.0), [spadmnist.effects.Tdc(resolution=1e-10)])
    framed = {"frames": 30, "frame_time": 1e-5, "lux": 1.0}
    plan = [
        spadmnist.Capture("tr", "tr", lux=1.0, exposure=1e-3),
        *(spadmnist.Capture(name, name, **framed) for name in ("str", "qis")),
        spadmnist.Capture("counts", "counts", bits=4, **framed),
    ]
    spadmnist.simulate(sensor, plan, seed=1).save(str(place))
    rows = []
    for path in sorted(place.glob("*.h5")):
        with h5py.File(path) as file:
            for name, found in file.items():
                attributes = [f"`{key}`" for key in [*file.attrs, *found.attrs] if not key.isupper()]
                shape = " x ".join(map(str, found.shape))
                rows.append([f"`{path.stem}`", f"`{name}`", str(found.dtype), shape, ", ".join(attributes)])
    return md.table(("modality", "data set", "type", "size (30 frames, 4 x 12 pixels)", "attributes"), rows)


# --- answers ------------------------------------------------------------------------------------------------------


def answers() -> dict[str, dict[str, Any]]:
    """An answer of each format, with one entry in each list that has entries of one kind."""
    check = Check("neighbours", "flat", 1.0, 0.5, "side neighbours", "0.2 % of detections", 0.002)
    nuisance = Nuisance(**{name: _any(one) for name, one in inspect.signature(Nuisance).parameters.items()})
    compared = Comparison("sensor", "lab", "adequate", 1.0, 1.2, (nuisance,), (check,), 100, crop="0:8,0:8")
    compared = replace(compared, not_compared=(("frame_limits", "flat"),))
    step = Step(
        Candidate("add", "crosstalk", None, {}), {"probability": Value(0.01, 0.009, 0.011)}, 1.0, 35.0, "rate +2 %"
    )
    told = list(compared.as_data()["nuisances"])
    lists: dict[str, Any] = {name: [] for name in ("setup", "unexplained", "ladder", "advice", "excluded")}
    found = Diagnosis("sensor", "lab", "explained", 60.0, 1.0, 1.2, told, [step], **lists)
    candidate, values = Candidate("per_pixel", "dark_counts", "rate", ()), {"sigma": Value(0.5, 0.4, 0.6, "", "counts")}
    step = Step(candidate, values, 1.0, 20.0, "mean of the map +2 %")
    lists |= {"in_sample": compared, "file": "fitted.yaml", "crop": "0:8,0:8", "compared": "the counts in the dark"}
    fitted = Diagnosis("sensor", "lab", "explained", 4.0, 1.0, 1.2, told, [step], **lists, asked="fit")
    return {data["format"]: data for data in (compared.as_data(), found.as_data(), fitted.as_data())}


def _any(parameter: inspect.Parameter) -> Any:
    return "flat" if "str" in str(parameter.annotation) else 1.0


def keys(data: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, str]]:
    """(path, type of its value) of every key of an answer."""
    for key, value in data.items():
        where = f"{path}{key}"
        yield where, _type(value)
        if isinstance(value, list) and value and isinstance(value[0], dict):
            yield from keys(value[0], f"{where}[].")
        elif isinstance(value, dict) and all(isinstance(one, dict) for one in value.values()):
            yield from keys(next(iter(value.values())), f"{where}.*.")
        elif isinstance(value, dict):
            yield from keys(value, f"{where}.")


def _type(value: Any) -> str:
    names = {bool: "true or false", str: "text", list: "list", dict: "mapping"}
    if value is None:
        return "a value or `null`"
    return names.get(type(value), "number" if isinstance(value, int | float | np.number) else type(value).__name__)


def _keys(data: Mapping[str, Any]) -> str:
    return md.table(("key", "what it says", "type"), [[f"`{key}`", MEANINGS[key], kind] for key, kind in keys(data)])
