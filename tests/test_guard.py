"""What old datasets stand on: a later program draws the same numbers and writes the same bytes.

Of some datasets data/guard.json keeps digests of what is read from them (another one: a drawn number changed, which
no later program may do) and of their files (another one alone: the encoding changed), with the versions of the
libraries that encode. Where a change is meant, one command takes today's program as right:

    python tests/test_guard.py --rewrite
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import re
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spadmnist
from spadmnist import config, document, factory, plugins
from spadmnist.store import Encoding

ROOT = Path(__file__).parents[1]
KNOWN = Path(__file__).parent / "data" / "guard.json"
MNIST = Path(os.environ.get("SPADMNIST_DATA") or ROOT.parent / "shared" / "mnist")

# every stage by `rules: device`, with patterns, maps and neighbours that are drawn from the chip seed, and the causes
DEVICE = """\
seed: 11
causes: true
scene:
  images: {source: digits, train: 34, test: 3, rows: 12, columns: 10, seed: 5}
  wavelength: 560 nm
  irradiance: [2 nW/cm^2, 0.3 uW/cm^2]
recording:
  exposure: 960 us
  frames: 60
  frame_time: 14 us
  frame_period: 16 us
  readouts: [tr, str, qis, counts]
  bits: 2
reconstruct: [counts, passive_free_running, inter_photon, str_flux, qis_counts, qis_linear]
sensor:
  name: device
  rules: device
  chip_seed: 3
  layout: {rows: 12, columns: 10, pixel_area: 25 um^2, fill_factor: 80 %}
  effects:
    illumination_gradient: {x: 0.1, y: -0.05, vignette: 0.1}
    row_pattern: {gain: {normal: {mean: 1, sigma: 0.05}}}
    column_pattern: {gain: {lognormal: {median: 1, sigma: 0.05}}}
    detection: {pdp: {500 nm: 0.42, 700 nm: 0.16}, relative: {normal: {mean: 1, sigma: 0.1}}}
    dark_counts:
      rate:
        mixture:
          [{share: 0.9, lognormal: {median: 100 Hz, sigma: 0.5}}, {share: 0.1, normal: {mean: 5 kHz, sigma: 1 kHz}}]
    background_light: {rate: 200 Hz}
    flicker: {amplitude: 0.2, frequency: 3 kHz, phase: 1 rad}
    source_drift: {slope: 0.1}
    source_noise: {contrast: 0.2, coherence_time: 20 us}
    blinking_dark_counts: {amplitude: 20 kHz, rate_on: 2 kHz, rate_off: 3 kHz, fraction: 0.3}
    short_gate: {fraction: 0.9, offset: 500 ns}
    afterpulsing: {probability: {lognormal: {median: 2 %, sigma: 0.3}}, lifetime: 30 ns}
    slow_afterpulsing: {probability: 1 %, lifetime: 3 us}
    crosstalk: {probability: 1 %, diagonal_ratio: 0.3, delay: 200 ps, reach: 2.5, far_ratio: 0.1}
    dead_time: {duration: {normal: {mean: 50 ns, sigma: 5 ns}}}
    slow_recovery: {time_constant: 10 ns}
    frame_carry_over: {share: 0.5}
    jitter: {sigma: 80 ps, tail_weight: 0.1, tail: 300 ps}
    tdc_nonlinearity: {widths: {lognormal: {median: 1, sigma: 0.3}}, period: 70}
    tdc: {resolution: 50 ps, rounding: floor}
    readout_loss: {service_time: 20 ns, queue: 4}
    count_saturation: {bits: 1}
"""
# nothing but binary frames, of which no whole number fills a byte
BINARY = """\
seed: 12
scene: {images: {source: digits, train: 40, test: 2, rows: 16, columns: 11}, lux: [0.5 lux, 40 lux]}
recording: {exposure: 505 us, frames: 101, frame_time: 5 us, readouts: [qis]}
reconstruct: [qis_counts, qis_linear]
sensor:
  chip_seed: 4
  layout: {rows: 16, columns: 11, pixel_area: 40 um^2}
  effects:
    row_pattern: {gain: {normal: {mean: 1, sigma: 0.1}}}
    detection: {pdp: {normal: {mean: 0.3, sigma: 0.02}}}
    dark_counts: {rate: {lognormal: {median: 1 kHz, sigma: 1}}}
    flicker: {amplitude: 0.3, frequency: 10 kHz}
    blinking_dark_counts: {amplitude: 50 kHz, rate_on: 5 kHz, rate_off: 5 kHz, fraction: 0.2}
    afterpulsing: {probability: 3 %, lifetime: 80 ns}
    crosstalk: {probability: 2 %}
    dead_time: {duration: 200 ns, paralyzable: true}
    jitter: {sigma: 1 ns}
    readout_loss: {service_time: 3 ns, queue: 8}
"""
# times that no converter turns into ticks, counters, a user's effect, which draws by blocks of images, and all that has
# a default left open: the methods, too
COUNTER = """\
seed: 13
scene: {images: {source: uniform, repetitions: 40, grey: 200}, lux: [10 lux]}
recording: {exposure: 400 us, frames: 8, frame_time: 50 us, readouts: [tr, counts], bits: 3, counting: counter}
sensor:
  layout: {rows: 6, columns: 7, pixel_area: 25 um^2}
  effects:
    detection: {pdp: 0.4}
    dark_counts: {rate: 2 kHz}
    dead_time: {duration: 100 ns}
    jitter: {sigma: 100 ps}
    lossy_bus: {loss: 20 %}
"""
LOSSY_BUS = '''\
from spadmnist import Effect, parameter


class LossyBus(Effect, stage="readout"):
    """Every event is lost with the same chance on its way out."""

    loss = parameter(0.1, "", "chance that an event is lost", bounds=(0, 1), off=0.0)

    def apply(self, events, rng):
        return events.keep(rng.random(len(events)) >= self.loss)
'''


@dataclass(frozen=True)
class Made:
    """A dataset to be made: a shipped config or one that stands above, by the encodings that it is made in (`NAMED`);
    the first images of each split.
    """

    config: str
    formats: tuple[str, ...]
    limit: int | None = None
    mnist: bool = False


DATASETS = {
    "quick": Made("quick.yaml", ("zarr", "zarr/2", "hdf5")),
    "spad_mnist": Made("spad_mnist.yaml", ("zarr",), limit=100, mnist=True),
    "device": Made(DEVICE, ("zarr", "zarr/2", "hdf5")),
    "binary": Made(BINARY, ("hdf5",)),
    "counter": Made(COUNTER, ("zarr", "zarr/2")),
}
# encoding 1 of a format has the format's name, which it had when there was no other
NAMED = {one.format if one.number == 1 else str(one): one for one in Encoding.every.values()}
CASES = [(name, format) for name, made in DATASETS.items() for format in made.formats]


# --- digests ------------------------------------------------------------------------------------------------------

Digests = dict[str, str]  # by part of the dataset: level and array, or kind of file
GROUPS = "groups of arrays"
OURS = {"config.yaml", GROUPS}  # text that no library encodes


@functools.cache
def digests(name: str, format: str) -> tuple[Digests, Digests]:
    """(of what is read, of the files) of a dataset that today's program makes."""
    made, written = DATASETS[name], NAMED[format]
    with tempfile.TemporaryDirectory() as folder:
        if "lossy_bus" in made.config:
            (Path(folder) / "lossy_bus.py").write_text(LOSSY_BUS)
            plugins.load_file(Path(folder) / "lossy_bus.py")
        if made.config.endswith(".yaml"):
            experiment = config.read(ROOT / "configs" / made.config, format=written.format, limit=made.limit)
        else:
            experiment = config.build(document.parse(made.config, name), Path(folder), format=written.format)
        experiment = replace(experiment, encoding=written)
        images = experiment.load_images(MNIST if made.mnist else None)
        manifest = factory.generate(experiment, images, Path(folder) / "out", 1).manifest
        return values_of(Path(folder) / "out"), files_of(manifest)


def values_of(root: Path) -> Digests:
    """By level and kind of data, over all splits."""
    found: dict[str, Any] = defaultdict(hashlib.sha256)
    dataset = spadmnist.open(root)
    for level in dataset.levels:
        for split in dataset.splits:
            part = dataset[level, split]
            for what, value in streams(part):
                add(found[f"{level}: {what}"], value)
            for method, images in part.reconstruction.items():
                add(found[f"{level}: {method}"], images[:])
                add(found[f"{level}: {method}"], repr(images.normalisation))
            add(found["images"], part.images[:])
            add(found["images"], "no labels" if part.labels is None else part.labels)
    return {part: digest.hexdigest()[:16] for part, digest in sorted(found.items())}


def streams(part: spadmnist.Part) -> Iterator[tuple[str, Any]]:
    """Everything that was recorded, in types that do not depend on how it is stored."""
    if "tr" in part.readouts:
        events = part.tr[:]
        stamps = events.times if events.ticks is None else events.ticks.astype(np.uint64)
        yield from (("tr", one) for one in (repr(events.tick), events.offsets.astype(np.int64), stamps))
        if events.cause is not None and events.parent is not None:
            yield "causes", repr(part.causes)
            yield "causes", np.stack([events.cause.astype(np.int64), events.parent.astype(np.int64)])
    for start in range(0, len(part), 32):
        few = slice(start, start + 32)
        if "qis" in part.readouts:
            yield "qis", part.qis[few]
        if "str" in part.readouts:
            yield "str", part.str[few]
        if "counts" in part.readouts:
            yield "counts (readout)", part.counts[few].astype(np.uint64)


def add(digest: Any, value: str | np.ndarray) -> None:
    if isinstance(value, str):
        digest.update(value.encode())
    else:
        digest.update(f"{value.dtype.str} {value.shape}".encode())
        digest.update(np.ascontiguousarray(value))


def files_of(manifest: dict[str, Any]) -> Digests:
    """By array (zarr/1) or level for the shards, else by file. No file of the manifest's list holds a version."""
    found: dict[str, Any] = defaultdict(hashlib.sha256)
    for name, facts in sorted(manifest["files"].items()):
        array = re.fullmatch(r"data\.zarr/([^/]+)/[^/]+/\d{5}/(.+)/(?:zarr\.json|c\.[\d.]+)", name)
        if array:
            part = "originals" if array[1] == "images" else array[2]
        elif name.startswith("data.zarr/"):
            part = GROUPS
        else:
            part = name.split("/")[1] if name.startswith("data/") else name
        found[part].update(f"{name} {facts['sha256']}\n".encode())
    return {part: digest.hexdigest()[:16] for part, digest in sorted(found.items())}


def versions() -> dict[str, str]:
    """Of the libraries that encode."""
    return {name: version for name, version in factory.versions().items() if name != "spadmnist"}


# --- what is known of them ----------------------------------------------------------------------------------------


def known() -> dict[str, Any]:
    return json.loads(KNOWN.read_text())


def differing(ours: Digests, theirs: Digests) -> str:
    """The parts that are not the same: the first few, and how many more."""
    parts = sorted(part for part in ours.keys() | theirs.keys() if ours.get(part) != theirs.get(part))
    return "; ".join(parts[:8]) + (f" and {len(parts) - 8} more" if len(parts) > 8 else "")


def said_of_values(values: Digests, known_values: Digests) -> str:
    """What is wrong with what is read from a dataset; nothing where it is right."""
    changed = differing(values, known_values)
    return changed and (
        f"VALUES changed: {changed}. No old dataset can be made again or resumed: draw what is new from a stream "
        "of its own, so that the old numbers stay"
    )


# The libraries that encode a format: others that differ excuse no byte
ENCODERS = {"zarr": ("numcodecs",), "hdf5": ("h5py",)}


def said_of_files(
    files: Digests, known_files: Digests, now: dict[str, str], then: dict[str, str], format: str
) -> tuple[str, str]:
    """("", ""), or ("fail", why), or ("skip", why) where it may be another library that encodes otherwise."""
    changed = differing(files, known_files)
    if not changed:
        return "", ""
    others = [
        f"{name} {then.get(name)} then, {now.get(name)} now" for name in ENCODERS[format] if now[name] != then.get(name)
    ]
    if others and all(files.get(part) == known_files.get(part) for part in OURS):
        return "skip", f"the bytes of {changed} are others under other libraries: {', '.join(others)}"
    mend = "encode as before, and declare new keys as later (tests/test_later.py)"
    return "fail", f"FILES changed: {changed}. No old dataset can be repaired or resumed: {mend}"


def digests_here(name: str, format: str) -> tuple[Digests, Digests]:
    if DATASETS[name].mnist and not MNIST.is_dir():
        pytest.skip(f"{name}: MNIST is neither in $SPADMNIST_DATA nor in shared/mnist beside the repository")
    return digests(name, format)


@pytest.mark.parametrize(("name", "format"), CASES)
def test_no_drawn_number_has_changed(name: str, format: str) -> None:
    wrong = said_of_values(digests_here(name, format)[0], known()["datasets"][name]["values"])
    if wrong:
        pytest.fail(f"{name} ({format}): {wrong}", pytrace=False)


@pytest.mark.parametrize(("name", "format"), CASES)
def test_no_byte_has_changed(name: str, format: str) -> None:
    """Where the values are others, so are the bytes: then the test of the values says it."""
    values, files = digests_here(name, format)
    if differing(values, known()["datasets"][name]["values"]):
        pytest.skip(f"{name} ({format}): its values changed, and with them its files")
    outcome, why = said_of_files(
        files, known()["datasets"][name]["files"][format], versions(), known()["versions"], format
    )
    if outcome == "skip":
        pytest.skip(f"{name} ({format}): {why}; the values are the same")
    if outcome:
        pytest.fail(f"{name} ({format}): {why}", pytrace=False)


def test_what_is_said_of_a_change() -> None:
    then, now = {"numcodecs": "0.16.6", "h5py": "3.16.0"}, {"numcodecs": "0.17.0", "h5py": "3.16.0"}
    one = {"numcodecs": "0.16.6", "h5py": "3.16.0", "numba": "1"}
    ours = {"5 mlux: tr": "a", "5 mlux: qis": "b"}
    assert said_of_values(ours, dict(ours)) == ""
    for theirs in ({**ours, "5 mlux: tr": "c"}, {"5 mlux: qis": "b"}):  # another value, or none
        assert said_of_values(ours, theirs).startswith("VALUES changed: 5 mlux: tr. ")
        assert said_of_values(theirs, ours).startswith("VALUES changed: 5 mlux: tr. ")
    files = {"tr/ticks": "a", "config.yaml": "b"}
    assert said_of_files(files, dict(files), now, then, "zarr") == ("", "")
    outcome, why = said_of_files(files, {**files, "tr/ticks": "c"}, then, then, "zarr")
    assert outcome == "fail" and why.startswith("FILES changed: tr/ticks. ")
    outcome, why = said_of_files(files, {**files, "tr/ticks": "c"}, now, then, "zarr")
    assert outcome == "skip" and "tr/ticks" in why and "numcodecs 0.16.6 then, 0.17.0 now" in why and "h5py" not in why
    for theirs, format in ((now, "hdf5"), (one, "zarr")):  # of those that encode the format none is another
        assert said_of_files(files, {**files, "tr/ticks": "c"}, theirs, then, format)[0] == "fail"
    # what no library encodes is never theirs
    assert said_of_files(files, {**files, "tr/ticks": "c", "config.yaml": "d"}, now, then, "zarr")[0] == "fail"


def test_another_type_or_shape_is_another_value() -> None:
    different = [np.zeros((2, 3), np.uint8), np.zeros((3, 2), np.uint8), np.zeros(6, np.uint8), np.zeros(6, np.int8)]
    found = set()
    for value in different:
        digest = hashlib.sha256()
        add(digest, value)
        found.add(digest.hexdigest())
    assert len(found) == len(different)


# --- rewriting ----------------------------------------------------------------------------------------------------


def rewrite() -> None:
    """Take what today's program makes as right. What cannot be made here, for want of its images, stays as it is."""
    everything = known()
    datasets = everything["datasets"]
    for name, made in DATASETS.items():
        if made.mnist and not MNIST.is_dir():
            print(f"{name}: there is no MNIST here; left as it is")
            continue
        values = [digests(name, format)[0] for format in made.formats]
        assert all(one == values[0] for one in values), f"{name}: its values are not the same in {made.formats}"
        files = {format: digests(name, format)[1] for format in made.formats}
        datasets[name] = {"values": values[0], "files": files}
    everything["versions"] = versions()
    KNOWN.write_text(json.dumps(everything, indent=1, sort_keys=True) + "\n")
    print(f"{KNOWN}: rewritten")


if __name__ == "__main__":
    if sys.argv[1:] != ["--rewrite"]:
        sys.exit(f"usage: python {sys.argv[0]} --rewrite   (takes what today's program makes as right)")
    rewrite()
