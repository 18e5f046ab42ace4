"""Files whose bytes were changed, and options that nobody would give: a measurement that holds, or one sentence."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from importfiles import DARK, SAMPLES, Sample, made_of

from spadmnist import importers, measurement
from spadmnist.errors import SpadError
from spadmnist.import_options import options
from spadmnist.importers import Said
from spadmnist.importers.captures import import_files
from spadmnist.readout import no_detection

KINDS = sorted({sample.kind for sample in SAMPLES})
EACH = 50  # mutations of a kind, over its samples
_HEADER = 600  # bytes, of which most kinds have a header


def holds(folder: Path) -> None:
    """What was written can be opened, and every stamp lies within its exposure, every number in its range."""
    opened = measurement.open(folder)
    for capture in opened.captures:
        one = opened.recording(capture.id)
        c = one.conditions
        assert c.exposure > 0 and one.layout.shape == opened.layout.shape
        if one.events is not None:
            assert one.events.ticks is not None and one.tick is not None and one.tick > 0
            assert int(one.events.ticks.max(initial=0)) <= no_detection(c.exposure, one.tick)
            assert len(one.events.offsets) == one.pixels + 1 and one.events.offsets[-1] == len(one.events)
            assert all((np.diff(one.events.row(p)) >= 0).all() for p in np.flatnonzero(one.totals)[:100])
            assert not opened.notes[capture.id]
        else:
            assert one.frames is not None
            stored = np.asarray(one.frames[:])
            assert len(stored) == one.n_frames > 0
            most = {"qis": 255, "str": one.none if one.modality == "str" else 0}.get(one.modality, c.largest_count)
            assert int(stored.max(initial=0)) <= most


def outcome(file: Path, said: Said, out: Path) -> bool:
    """Was it taken?"""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            import_files([file], out, said, DARK)
    except SpadError as error:
        text = str(error)
        assert "\n" not in text and text.isprintable() and 20 < len(text) < 700
        assert not (out / "measurement.yaml").exists()
        return False
    holds(out)
    return True


# --- bytes --------------------------------------------------------------------------------------------------------

Change = Callable[[bytearray, np.random.Generator], None]


def _other_bytes(data: bytearray, rng: np.random.Generator) -> None:
    for at in rng.integers(0, min(len(data), _HEADER), int(rng.integers(1, 4))):
        data[at] = int(rng.integers(256))


def _other_bits(data: bytearray, rng: np.random.Generator) -> None:
    for at in rng.integers(0, len(data), int(rng.integers(1, 4))):
        data[at] ^= 1 << int(rng.integers(8))


def _extreme_bytes(data: bytearray, rng: np.random.Generator) -> None:
    at = int(rng.integers(0, min(len(data), _HEADER)))
    data[at : at + 8] = bytes([int(rng.choice([0, 127, 128, 255]))]) * len(data[at : at + 8])


def _cut_short(data: bytearray, rng: np.random.Generator) -> None:
    del data[int(rng.integers(len(data))) :]


def _cut_out(data: bytearray, rng: np.random.Generator) -> None:
    at = int(rng.integers(len(data)))
    del data[at : at + int(rng.integers(1, 9))]


def _twice(data: bytearray, rng: np.random.Generator) -> None:
    at, size = int(rng.integers(len(data))), int(rng.integers(1, 40))
    data[at:at] = data[at : at + size]


CHANGES: tuple[Change, ...] = (_other_bytes, _other_bits, _extreme_bytes, _cut_short, _cut_out, _twice)


@pytest.mark.parametrize("kind", KINDS)
def test_changed_bytes(tmp_path: Path, kind: str) -> None:
    rng = np.random.Generator(np.random.Philox(KINDS.index(kind)))
    samples = [sample for sample in SAMPLES if sample.kind == kind]
    files = [made_of(sample, tmp_path / "good") for sample in samples]
    outcomes = []
    for n in range(EACH):
        sample, data = samples[n % len(samples)], bytearray(files[n % len(samples)].read_bytes())
        CHANGES[n // len(samples) % len(CHANGES)](data, rng)
        changed = tmp_path / sample.name
        changed.write_bytes(data)
        outcomes.append(outcome(changed, sample.said, tmp_path / f"made{n}"))
    assert sum(outcomes) < EACH  # some are found, others are harmless, but not to an archive with checksums
    assert sum(outcomes) > 0 or kind == "Npz"


# --- options ------------------------------------------------------------------------------------------------------

NUMBERS = (1, 2, 3, 7, 8, 11, 16, 20, 4095, 10**5)
TIMES = (1e-18, 1e-12, 1e-9, 3.7e-8, 1e-5, 1.2e-5, 4e-3, 1.0, 1e3, 1e18)
CHANNELS = (("0",), ("1", "0"), ("sync",), ("2", "9", "1"), ("16777215",), ("99999999",), ("sync", "0", "1", "2"))


def _some_value(name: str, folder: Path, rng: np.random.Generator) -> Any:
    option = options()[name]
    if option.flag:
        return True
    if option.choices:
        return str(rng.choice(option.choices))
    if option.whole is not None:
        allowed = [n for n in (*NUMBERS, *option.whole) if option.whole[0] <= n <= option.whole[1]]
        return int(rng.choice(allowed))
    if option.unit is not None:
        return float(rng.choice(TIMES if option.unit else (0.0, 0.1, 1.0)))
    if option.path:
        return folder / str(rng.choice(["none", "text", "array.npy", "places.csv"]))
    if name == "channels":
        return CHANNELS[int(rng.integers(len(CHANNELS)))]
    return str(rng.choice(["frames", "time", "/", ".."]))


@pytest.mark.parametrize("kind", KINDS)
def test_any_options(tmp_path: Path, kind: str) -> None:
    """Those that apply to the kind, and now and then one that does not, whatever they say."""
    rng = np.random.Generator(np.random.Philox(100 + KINDS.index(kind)))
    (tmp_path / "text").write_text("x\n1,2\n")
    (tmp_path / "places.csv").write_text("x,y\n0,0\n23,0\n11.5,20\n")
    np.save(tmp_path / "array.npy", np.linspace(-5000, 5000, 256))
    samples = [sample for sample in SAMPLES if sample.kind == kind]
    files = [made_of(sample, tmp_path / "good") for sample in samples]
    taken = 0
    for n in range(2 * EACH):
        sample, file = samples[n % len(samples)], files[n % len(samples)]
        names = [name for name, option in options().items() if _applies(sample, option) or rng.random() < 0.02]
        chosen = rng.choice(names, int(rng.integers(1, 4)), replace=False)
        given = {str(name): _some_value(str(name), tmp_path, rng) for name in chosen}
        taken += outcome(file, replace(sample.said, **given), tmp_path / f"made{n}")
    assert 0 < taken < 2 * EACH


def _applies(sample: Sample, option: Any) -> bool:
    kind = next(kind for kind in importers.formats() if kind.__name__ == sample.kind)
    return sample.modality in option.modalities and (not option.own or option.own in kind.takes)
