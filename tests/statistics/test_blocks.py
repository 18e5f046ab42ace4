"""Pairs within blocks of pixels, and silences of blocks: literal versions, laws, shared and full converters."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import null_laws
import numpy as np
import pytest
from click.testing import CliRunner
from simple_sensor import grid, many, one_of_each, reduced, tr, tr_of

from spadmnist import cli, measurement
from spadmnist.events import Layout
from spadmnist.recording import Recording
from spadmnist.statistics import _order
from spadmnist.statistics.blocks import Blocks, Silences
from spadmnist.statistics.neighbours import Neighbours

LINE = grid(1, 32)


def rows_of(recording: Recording) -> list[np.ndarray]:
    """The ticks of each pixel."""
    events = recording.events
    assert events is not None and recording.tick is not None
    ticks = np.rint(events.times / recording.tick).astype(np.int64)
    return [ticks[a:b] for a, b in zip(events.offsets[:-1], events.offsets[1:], strict=True)]


def literal_pairs(recording: Recording, of: Callable[[int, int], bool]) -> list[tuple[int, float]]:
    """(pairs, by chance) of different pixels 1 to 3 and 3 to 10 ns apart, of those that belong to a class."""
    rows, tick = rows_of(recording), recording.tick
    assert tick is not None
    edges = [round(lag / tick) for lag in (1e-9, 3e-9, 10e-9)]
    out = [(0, 0.0)] * 2
    for p in range(len(rows)):
        for q in range(p):
            if not of(q, p):
                continue
            apart = np.abs(rows[p][:, None] - rows[q][None, :])
            for b in range(2):
                lags = 2 * (edges[b + 1] - edges[b])
                chance = apart.size * lags / round(recording.conditions.exposure / tick)
                out[b] = out[b][0] + int(((apart >= edges[b]) & (apart < edges[b + 1])).sum()), out[b][1] + chance
    return out


@pytest.mark.parametrize("pieces", [False, True])
@pytest.mark.parametrize("shape", [(1, 23), (6, 7), (1, 2), (9, 1)])
def test_pairs_are_those_of_the_classes(shape: tuple[int, int], pieces: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if pieces:
        monkeypatch.setattr(_order, "_MOST_HELD", 64)
        monkeypatch.setattr(_order, "_PIECE", 128)
    columns = shape[1]
    recording = tr(4, grid(*shape), 4e6, 1e-5)
    summary = reduced(Blocks, recording)
    classes: dict[str, Callable[[int, int], bool]] = {"pixels 2k and 2k + 1": lambda p, q: p // 2 == q // 2}
    for size in (4, 8, 16, 32, 64):
        classes[f"pixels {size}k to {size}k + {size - 1}, not of one half"] = lambda p, q, size=size: (
            p // size == q // size and p // (size // 2) != q // (size // 2)
        )
    classes["pixels of one row, more than 3 pitches apart"] = lambda p, q: p // columns == q // columns and q - p > 3
    classes["pixels of one column, more than 3 pitches apart"] = lambda p, q: (
        p % columns == q % columns and q - p > 3 * columns
    )
    known = {}
    for name, of in classes.items():
        for apart, (number, chance) in zip(("1 to 3 ns", "3 to 10 ns"), literal_pairs(recording, of), strict=True):
            known[f"{name}, {apart}"] = number, chance
    named = [summary.where(k) for k in range(len(summary.values))]
    several = min(shape) > 1
    assert any("of one row" in name for name in named) is several
    assert len(named) == 2 * ((np.prod(shape) - 1).item().bit_length() + 2 * several)
    for k, name in enumerate(named):
        number, chance = known[name]
        text, _ = summary.size(k, summary.values[k], 0.0)
        assert text.startswith(f"{number} pairs, ") or number >= 10, (name, text, number)
        share = summary.size(k, summary.values[k], 0.0)[1] * recording.totals.sum()
        assert share == pytest.approx(number - chance, abs=0.51 + 1e-3 * chance), name  # few are whole numbers


def literal_silences(recording: Recording, size: int) -> int:
    rows, end = rows_of(recording), round(recording.conditions.exposure / (recording.tick or 1.0))
    blocks = [np.sort(np.concatenate(rows[k : k + size])) for k in range(0, len(rows), size)]
    known = [block for block in blocks if len(block) >= 10]
    found = 0
    for block in known:
        longest = max(np.log(len(block) * len(known) / 5), 3.0) * end / len(block)
        found += int((np.diff(np.concatenate([[0], block, [end]])) > longest).sum())
    return found


@pytest.mark.parametrize("pieces", [False, True])
@pytest.mark.parametrize("shape", [(1, 23), (6, 7), (1, 1)])
def test_silences_are_counted(shape: tuple[int, int], pieces: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if pieces:
        monkeypatch.setattr(_order, "_MOST_HELD", 64)
        monkeypatch.setattr(_order, "_PIECE", 128)
    rates = np.where(np.arange(np.prod(shape)) % 5 == 3, 2e4, 4e6)  # some have too few to be known
    recording = tr(5, grid(*shape), rates, 1e-4)
    found = reduced(Silences, recording).values
    assert [int(n) for n in found] == [literal_silences(recording, 2**k) for k in range(len(found))]
    assert len(found) == (np.prod(shape) - 1).item().bit_length() + 1 and found.sum() > 0


def test_what_is_no_time_stamp_has_none() -> None:
    for kind in ("str", "qis"):
        recording = one_of_each()[kind]
        assert recording.modality not in Blocks.modalities and recording.modality not in Silences.modalities


def test_an_array_without_a_detection() -> None:
    for layout in (LINE, grid(4, 4), Layout(1, 3, 25e-12, 1.0, np.array([[0.0, 0], [1, 0], [0, 1]]))):
        recording = tr_of([np.zeros(0)] * layout.pixels, layout, 1e-3)
        assert np.abs(reduced(Blocks, recording).values).max() < 4
        assert not reduced(Silences, recording).values.any()


def test_steady_light_has_the_laws() -> None:
    """200 recordings of pixels that are unlike, with a dead time."""
    rates = np.random.default_rng(1).lognormal(np.log(2e6), 0.5, 32)
    found = many(Blocks, lambda seed: tr(seed, LINE, rates, 1e-3, 50e-9), 200)
    null_laws.normal(found)
    null_laws.poisson(many(Silences, lambda seed: tr(seed, LINE, rates, 1e-3), 200), least=0.9)


# --- faults ---------------------------------------------------------------------------------------------------------


def blind(recording: Recording, size: int, dead: float) -> Recording:
    """Without what comes so soon after a detection that was written, of another pixel of its block."""
    tick = recording.tick or 1.0
    rows = rows_of(recording)
    kept: list[list[int]] = [[] for _ in rows]
    for first in range(0, len(rows), size):
        block = range(first, min(first + size, len(rows)))
        last, of = -1e300, -1
        for time, pixel in sorted((int(t), p) for p in block for t in rows[p]):
            if pixel == of or time - last >= dead / tick:
                kept[pixel].append(time)
                last, of = time, pixel
    return tr_of([(np.array(k) + 0.5) * tick for k in kept], recording.layout, recording.conditions.exposure, tick)


@pytest.mark.slow
def test_a_shared_converter_is_found_in_its_blocks_alone() -> None:
    """Four pixels to a converter of 7 ns: no pair is nearer in the blocks, and pairs across blocks are as by chance."""
    recording = blind(tr(6, LINE, 2e6, 1e-3), 4, 7e-9)
    summary = reduced(Blocks, recording)
    z = {summary.where(k): float(z) for k, z in enumerate(summary.values)}
    for name in ("pixels 2k and 2k + 1", "pixels 4k to 4k + 3, not of one half"):
        assert z[f"{name}, 1 to 3 ns"] < -8
        (k,) = (k for k in range(len(z)) if summary.where(k) == f"{name}, 1 to 3 ns")
        assert summary.size(k, summary.values[k], 0.0)[0].startswith("0 pairs, ")
    others = [value for name, value in z.items() if name.startswith(("pixels 8k", "pixels 16k", "pixels 32k"))]
    assert len(others) == 6 and max(map(abs, others)) < 5.5
    # and of the side neighbours three of four pairs share one, so that nothing tells which
    assert min(reduced(Neighbours, recording).values) < -8


def test_a_full_converter_is_named_with_its_pixels_and_times() -> None:
    rows = [np.array(row) * 1e-10 for row in rows_of(tr(7, LINE, 5e5, 1e-3))]
    quiet = [t[(t < 0.4e-3) | (t > 0.5e-3)] if p // 4 == 3 else t for p, t in enumerate(rows)]
    right, wrong = (reduced(Silences, tr_of(each, LINE, 1e-3)) for each in (rows, quiet))
    assert max(right.values) < 20
    text = wrong.where(2)
    assert text.startswith("pixels 12 to 15 silent, the longest of blocks of 4: from ")
    begun, end = (float(part.split()[0]) for part in text.rpartition("from ")[2].split(" to "))
    assert 385 < begun <= 400 <= 500 <= end < 515  # us


def test_a_full_converter_is_beyond_the_law() -> None:
    """One block of eight is silent for a tenth of each of ten cycles."""

    def cycled(seed: int) -> Recording:
        rows = [np.array(row) * 1e-10 for row in rows_of(tr(seed, LINE, 5e5, 1e-3))]
        return tr_of([t[t % 1e-4 < 0.9e-4] if p // 4 == 3 else t for p, t in enumerate(rows)], LINE, 1e-3)

    usual = 10 * many(Silences, lambda seed: tr(seed, LINE, 5e5, 1e-3), 30)[:, 2].mean()
    assert 35 < usual < 75
    assert many(Silences, cycled, 10)[:, 2].sum() > usual + 8 * np.sqrt(usual)


REAL = Path(__file__).resolve().parents[3] / "shared" / "real" / "linospad2_a5_36"


@pytest.mark.skipif(not REAL.exists(), reason=f"{REAL} is not there: a capture of a real line of 256 pixels")
def test_a_real_line_whose_pixels_share_converters(tmp_path: Path) -> None:
    """Pixels 4k to 4k + 3 share one, hardly two are within 7 ns; a full one is blind until its 500 us cycle ends."""
    files = {"--tdc": "TDC_A5_#36_2212b.csv", "--offsets": "Offset_A5_#36_2212b.npy"}
    given = [word for option, name in files.items() for word in (option, str(REAL / name))]
    given += ["--firmware", "2212b", "--timestamps", "200", "--cycle", "500 us", "--light", "free"]
    done = CliRunner().invoke(cli.cli, ["import", str(REAL / "capture_2212b.dat"), "-o", str(tmp_path / "lab"), *given])
    assert done.exit_code == 0, done.output
    recording = measurement.open(tmp_path / "lab").recording("capture_2212b")
    pairs = reduced(Blocks, recording)
    found = {pairs.where(k): pairs.size(k, 0.0, 0.0)[0].split()[0] for k in range(len(pairs.values))}
    for name in ("pixels 2k and 2k + 1", "pixels 4k to 4k + 3, not of one half"):
        assert int(found[f"{name}, 1 to 3 ns"]) <= 4  # of 16 and 33 by chance
        assert int(found[f"{name}, 3 to 10 ns"]) < 50  # of 58 and 116
    silent = reduced(Silences, recording)
    first, last = (int(word) for word in re.findall(r"pixels (\d+) to (\d+) silent", silent.where(2))[0])
    assert first % 4 == 0 and last == first + 3 and silent.values[2] > 30 > 3 * silent.values[0]
    end = float(silent.where(2).rpartition(" to ")[2].split()[0])  # ms
    assert end % 0.5 < 0.02
