"""Does this program make the same dataset under every Python and all allowed versions of its libraries?

For each Python that is installed, with the oldest and the newest libraries that pyproject.toml allows, an environment
is made, in it one small dataset of all readouts in each format, and of these one table of digests. What could not be
made is said in its row. The same command again goes on; remove the folder to begin anew.

    python scripts/matrix.py -o build/matrix [--python 3.12 ...]
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
PATIENCE = 1800  # s, for one installation or one pair of datasets
STOPS = "stops"
PARTS = ("tr", "str", "qis", "counts", "reconstructions", "zarr", "hdf5")
SHOWN = ("numpy", "numba", "numcodecs", "h5py")

# every stage of the sensor, distributions and all readouts
CONFIG = """\
seed: 1
scene: {images: {source: digits, train: 48, test: 8, rows: 14, columns: 14}, lux: [20 mlux, 2560 mlux]}
recording: {exposure: 960 us, frames: 60, frame_time: 16 us, readouts: [tr, str, qis, counts], bits: 2}
reconstruct: [counts, passive_free_running, inter_photon, str_flux, qis_counts, qis_linear]
sensor:
  rules: device
  chip_seed: 3
  layout: {rows: 14, columns: 14, pixel_area: 25 um^2}
  effects:
    illumination_gradient: {x: 0.1, y: -0.05, vignette: 0.1}
    detection: {pdp: {normal: {mean: 0.5, sigma: 0.05}}}
    dark_counts: {rate: {lognormal: {median: 100 Hz, sigma: 1}}}
    flicker: {amplitude: 0.2, frequency: 3 kHz, phase: 1 rad}
    afterpulsing: {probability: 1 %, lifetime: 30 ns}
    crosstalk: {probability: 1 %}
    dead_time: {duration: 50 ns}
    jitter: {sigma: 80 ps, tail_weight: 0.1, tail: 300 ps}
    tdc: {resolution: 10 ps}
"""


# --- in an environment --------------------------------------------------------------------------------------------


def digests() -> dict[str, str]:
    """Of what is read of the dataset, by readout, and the seals of the dataset, by format."""
    import spadmnist
    from spadmnist import config, factory
    from spadmnist.errors import SpadError

    found = {}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "config.yaml")
        file.write_text(CONFIG)
        for format in ("zarr", "hdf5"):
            experiment = config.read(file, format=format)
            try:
                made = factory.generate(experiment, experiment.load_images(), Path(folder, format), 1)
                found[format] = made.manifest["sha256"]
            except SpadError:  # its golden shard is another one, and so no dataset is made
                found[format] = STOPS
        sums = {part: hashlib.sha256() for part in PARTS[:5]}
        stored = spadmnist.open(Path(folder, "zarr"))
        for part in (stored[level, split] for level in stored.levels for split in stored.splits):
            sums["tr"].update(part.tr[:].offsets.tobytes() + part.tr[:].ticks.tobytes())
            for readout in ("str", "qis", "counts"):
                sums[readout].update(getattr(part, readout)[:].tobytes())
            for images in part.reconstruction.values():
                sums["reconstructions"].update(images[:].tobytes())
    return found | {part: one.hexdigest() for part, one in sums.items()}


def features() -> str:
    """The instructions of this processor that numpy uses beyond those of every processor."""
    from numpy._core import _multiarray_umath as inside

    return " ".join(name for name in inside.__cpu_dispatch__ if inside.__cpu_features__.get(name))


def answer(what: str) -> None:
    from importlib.metadata import version

    if what == "features":
        print(features())
    else:
        print(json.dumps({"versions": {name: version(name) for name in SHOWN}, "digests": digests()}))


# --- environments -------------------------------------------------------------------------------------------------


def interpreter(version: str) -> Path | None:
    """A Python of this version that runs."""
    beside = Path.home().glob(f".pyenv/versions/{version}.*/bin/python")
    for found in (shutil.which(f"python{version}"), *map(str, sorted(beside))):
        if found and f"Python {version}." in ran([found, "--version"]).stdout:
            return Path(found)
    return None


def ran(command: list[str], **variables: str) -> subprocess.CompletedProcess[str]:
    with tempfile.TemporaryFile("w+") as said:
        made = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=said, text=True, timeout=PATIENCE, env=os.environ | variables
        )
        said.seek(0)
        made.stderr = said.read()
    return made


def requirements(libraries: str) -> list[str]:
    """Those of the project: as they stand, or each library at the lowest minor version that is allowed."""
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    return wanted if libraries == "newest" else [re.sub(r">=([\w.]+).*", r"~=\1.0", one) for one in wanted]


def install(python: Path, libraries: str, place: Path) -> str:
    """Make an environment. Why that cannot be done, or nothing."""
    if (place / "installed").exists():
        return ""
    shutil.rmtree(place, ignore_errors=True)
    made = ran([str(python), "-m", "venv", str(place)])
    if made.returncode == 0:
        pip = [str(place / "bin" / "python"), "-m", "pip", "install", "--quiet", "--only-binary", ":all:"]
        made = ran([*pip, *requirements(libraries)])
    if made.returncode:
        shutil.rmtree(place, ignore_errors=True)
        return why(made.stderr)
    (place / "installed").touch()
    return ""


def why(said: str) -> str:
    """The reason in what a program wrote before it ended."""
    if missing := re.search(r"No matching distribution found for (\S+)", said):
        return f"no wheel of {missing[1]}"
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    return re.sub(r"\S*/\S*", "...", lines[-1])[:160] if lines else "it ended without a word"


def row(version: str, libraries: str, folder: Path, plain: bool) -> dict[str, Any]:
    """What came of one environment; plain: with no more instructions than every processor of the kind has."""
    python = interpreter(version)
    if python is None:
        return {"failed": "no interpreter"}
    place = folder / f"{version}-{libraries}"
    if failed := install(python, libraries, place):
        return {"failed": failed}
    own, variables = str(place / "bin" / "python"), {"PYTHONPATH": str(ROOT), "PYTHONNOUSERSITE": "1"}
    variables["NUMBA_CACHE_DIR"] = str(place / ("cache-plain" if plain else "cache"))
    if plain:
        variables["NPY_DISABLE_CPU_FEATURES"] = ran([own, __file__, "--answer", "features"], **variables).stdout.strip()
        variables |= {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    made = ran([own, __file__, "--answer", "digests"], **variables)
    return json.loads(made.stdout) if made.returncode == 0 else {"failed": why(made.stderr)}


# --- the table ----------------------------------------------------------------------------------------------------


def table(rows: dict[str, dict[str, Any]]) -> Iterator[str]:
    """The rows as Markdown; of digests the first eight digits."""
    yield "| Python, libraries | " + " | ".join((*SHOWN, *PARTS)) + " |"
    yield "| --- " * (1 + len(SHOWN) + len(PARTS)) + "|"
    for name, found in rows.items():
        if "failed" in found:
            yield f"| {name} | not run: {found['failed']}" + " |" * (len(SHOWN) + len(PARTS))
        else:
            cells = [found["versions"][one] for one in SHOWN] + [found["digests"][part][:8] for part in PARTS]
            yield f"| {name} | " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("build/matrix"), help="folder of the environments")
    parser.add_argument("--python", action="append", choices=PYTHONS, help="these versions alone")
    parser.add_argument("--answer", choices=("digests", "features"), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.answer:
        return answer(given.answer)
    given.output.mkdir(parents=True, exist_ok=True)
    noted = given.output / "rows.json"
    rows: dict[str, dict[str, Any]] = json.loads(noted.read_text()) if noted.exists() else {}
    for version in given.python or PYTHONS:
        for libraries, plain in (("oldest", False), ("newest", False), ("newest", True)):
            name = f"{version}, {libraries}" + (", plain processor" if plain else "")
            if "digests" not in rows.get(name, {}):
                print(f"{name} ...", file=sys.stderr, flush=True)
                rows[name] = row(version, libraries, given.output.resolve(), plain)
                noted.write_text(json.dumps(rows, indent=1))
    print("\n".join(table(rows)))
    made = [one["digests"] for one in rows.values() if "digests" in one]
    others = [part for part in PARTS if len({one[part] for one in made} - {STOPS}) > 1]
    said = f"other bytes of {', '.join(others)}" if others else "the same bytes wherever a dataset was made"
    print(f"\n{datetime.now(UTC):%Y-%m-%d}: {len(made)} of {len(rows)} environments ran; {said}.")
    sys.exit(1 if others or not made else 0)


if __name__ == "__main__":
    main()
