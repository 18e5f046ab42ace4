"""The golden shard: by its known digests a run under other versions knows that it makes the same bytes.

spadmnist/golden.json holds the digests of the configs that are shipped. Where a change of them is meant, the number of
the stream or of the encoding is raised, and one command takes today's program as right:

    python tests/test_golden.py --rewrite
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from spadmnist import config, document, golden
from spadmnist.errors import SpadError
from spadmnist.experiment import Experiment
from spadmnist.store import Encoding, encoding

CONFIGS = sorted(path.name for path in config.shipped("quick.yaml").parent.glob("*.yaml"))


def experiments() -> dict[str, Experiment]:
    """Every config that is shipped, in each encoding."""
    found = {}
    for name in CONFIGS:
        if not name.endswith("_sensor.yaml"):
            for one in Encoding.every.values():
                made = config.read(config.shipped(name), format=one.format)
                found[f"{name} {one}"] = replace(made, encoding=one)
    return found


QUICKLY = ("quick.yaml", "spad23.yaml")


@pytest.mark.parametrize(
    "name",
    [name if name.split()[0] in QUICKLY else pytest.param(name, marks=pytest.mark.slow) for name in experiments()],
)
def test_the_golden_shard_is_the_known_one(name: str) -> None:
    assert golden.check(experiments()[name]), f"{name} is not known: `python tests/test_golden.py --rewrite` notes it"


def quick(change: str = "", to: str = "", **options: Any) -> Experiment:
    text = config.shipped("quick.yaml").read_text()
    assert change in text
    return config.build(document.parse(text.replace(change, to), "lab.yaml"), Path(), **options)


@pytest.mark.parametrize(
    "same",
    [
        quick(seed=2),
        quick(limit=3),
        quick("{source: digits, train: 400,", "{source: digits, train: 40,"),
        quick("lux: [5 mlux, ", "lux: ["),
    ],
)
def test_images_light_and_seed_make_no_other_golden_shard(same: Experiment) -> None:
    assert golden.key(same) == golden.key(quick())


def test_what_is_not_known_is_told_from_what_is(monkeypatch: pytest.MonkeyPatch) -> None:
    other = quick("rate: 100 Hz", "rate: 101 Hz")
    assert golden.key(other) != golden.key(quick()) != golden.key(quick(format="hdf5"))
    assert golden.check(quick()) and not golden.check(other)
    # what is tried where nothing is known
    assert golden.key(golden._shipped(encoding("hdf5"))) == golden.key(quick(format="hdf5"))
    older = replace(quick(), encoding=encoding("zarr", 1))
    assert golden.key(older) != golden.key(quick()) and golden.check(older)
    planted = dict.fromkeys(golden.known()["digests"], "0" * 64)
    monkeypatch.setattr(golden, "known", lambda: {"digests": planted, "versions": {"numpy": "1.0", "h5py": "2.0"}})
    for experiment in (quick(), other):
        with pytest.raises(SpadError) as told:
            golden.check(experiment)
        said = str(told.value)
        assert golden.processor() in said and "there numpy 1.0, h5py 2.0" in said and "\n" not in said
        assert f"numpy {golden.versions()['numpy']}" in said and "python" in said


def rewrite() -> None:
    digests = {golden.key(one): golden.digest(one) for one in experiments().values()}
    libraries = {name: version for name, version in golden.versions().items() if name != "spadmnist"}
    text = json.dumps({"versions": libraries, "digests": digests}, indent=1, sort_keys=True)
    golden.KNOWN.write_text(text + "\n")
    print(f"{golden.KNOWN}: rewritten")


if __name__ == "__main__":
    if sys.argv[1:] != ["--rewrite"]:
        sys.exit(f"usage: python {sys.argv[0]} --rewrite   (takes what today's program makes as right)")
    rewrite()
