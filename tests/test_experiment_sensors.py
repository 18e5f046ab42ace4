"""The experiment `sensors`: means follow the closed form, twins have what the paper names, captures replace them."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spadmnist import config, experiments, measurement, twin
from spadmnist.errors import InputError, SpadError
from spadmnist.experiments import Setting, _chip, sensors
from spadmnist.experiments.sensors import DARK, INPUTS, MEASURED, PANELS, SIMULATED, Sensors
from spadmnist.recording import Capture, Light

SIGMAS = 4.892  # of a normal mean: false-alarm rate 1e-6
# as the shipped configs of the SPAD512, with few pixels
SMALL = """\
seed: 512
scene: {{images: {{source: uniform, repetitions: 1}}, wavelength: {nm} nm, irradiance: [100 nW/cm^2]}}
recording:
  {{exposure: {ms} ms, frames: 10000, frame_time: {us} us, frame_period: {us} us, readouts: [qis]}}
sensor:
  chip_seed: 512
  layout: {{rows: 12, columns: 10, pixel_area: 36 um^2}}
  effects:
    detection: {{pdp: {{500 nm: 0.444, 700 nm: 0.207}}}}
    dark_counts: {{rate: {{lognormal: {{median: 20 Hz, sigma: 1.5}}}}}}
"""


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A place for runs on a SPAD512 of few pixels; the SPAD23 is small as it is."""
    shipped = config.shipped
    for panel in PANELS:
        if panel.file.startswith("spad512"):
            us = 10 if "high" in panel.file else 1
            (tmp_path / panel.file).write_text(SMALL.format(nm=panel.title[9:12], ms=10 * us, us=us))

    def found(name: str) -> Path:
        return tmp_path / name if (tmp_path / name).is_file() else shipped(name)

    monkeypatch.setattr(config, "shipped", found)
    return tmp_path


def bench(key: str, quick: bool = False) -> sensors._Bench:
    return sensors._Bench(next(panel for panel in PANELS if panel.key == key), quick)


def lab_of(folder: Path, key: str, levels: tuple[float, ...], dark: bool = True, **changed: Any) -> Path:
    """Captures of a panel's plain sensor at light levels in nW/cm^2, and one in the dark. changed: of conditions."""
    one = config.read(config.shipped(bench(key).panel.file))
    c = replace(one.conditions, **changed)
    asked = [
        Capture(f"lit-{n}", one.readouts[0], Light(c.wavelength, level * 1e-5), c) for n, level in enumerate(levels)
    ]
    if dark:
        asked.append(Capture("dark", one.readouts[0], Light(), replace(c, wavelength=None)))
    plan = measurement.in_memory("lab", one.sensor.layout, asked)
    return measurement.write(folder, "lab", one.sensor.layout, twin.twin(one.sensor, plan, 7))


# --- formulas -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "mean", "digit"),
    [
        ("spad23-500nm", 14.8e3, 100),
        ("spad23-700nm", 2.27e3, 10),
        ("spad512-500nm-low", 473.8, 0.1),
        ("spad512-700nm-low", 54.9, 0.1),
        ("spad512-500nm-high", 9920, 1),
        ("spad512-700nm-high", 4100, 1),
    ],
)
def test_what_the_printed_light_levels_give(key: str, mean: float, digit: float) -> None:
    """On the shipped sensors, to one of the last digit: the chip's own dark counts have a share in it, and rounding."""
    panel = bench(key).panel
    one = config.read(config.shipped(panel.file))
    scale = 1 / one.conditions.exposure if one.readouts[0] == "tr" else 1
    found = sensors.closed_form(one.sensor.resolved(), one.readouts[0], one.conditions, panel.irradiance).mean() * scale
    assert abs(found - mean) < digit


@pytest.mark.parametrize("key", ["spad23-700nm", "spad512-700nm-high"])
def test_light_and_dark_count_rates_come_back(small: Path, key: str) -> None:
    one = config.read(config.shipped(bench(key).panel.file))
    sensor, modality, c = one.sensor.resolved(), one.readouts[0], one.conditions
    mean = float(sensors.closed_form(sensor, modality, c, 3.5).mean())
    assert sensors.solved(sensor, modality, c, mean, "here") == pytest.approx(3.5, rel=1e-6)
    dark = replace(c, wavelength=None)
    counts = sensors.closed_form(sensor, modality, dark, 0.0)
    rates = sensors.dark_rates(sensor, modality, dark, np.array([counts, counts]))
    assert rates == pytest.approx(sensor.effect("dark_counts").rate, rel=1e-6)  # type: ignore[union-attr]
    with pytest.raises(InputError, match=r"^here: its mean count is 0.* so its light cannot be told; correct the"):
        sensors.solved(sensor, modality, c, 0.0, "here")


def test_bins_hold_every_count() -> None:
    edges = np.array(sensors._edges(10_000))
    assert edges[0] == -0.5 and edges[-1] == 10_000.5 and (np.diff(edges) >= 1).all() and (edges % 1 == 0.5).all()
    assert (np.diff(edges)[:300] == 1).all() and (np.diff(edges)[1:] <= 1 + 0.004 * edges[1:-1]).all()


def test_merged_bins_hold_the_same_pixels() -> None:
    edges = np.array([-0.5, 0.5, 1.5, 2.5, 3.5, 5.5, 9.5, 10.5, 11.5])
    pixels, wide = sensors._merged(np.array([1, 0, 3, 5, 0, 9, 4, 0]), edges)
    assert pixels.tolist() == [1, 0, 8, 9, 4, 0] and wide.tolist() == [-0.5, 0.5, 1.5, 3.5, 9.5, 10.5, 11.5]
    pixels, wide = sensors._merged(np.array([7, 0, 0]), edges[:4])
    assert pixels.tolist() == [7, 0, 0] and wide.tolist() == edges[:4].tolist()


# --- twins --------------------------------------------------------------------------------------------------------


def test_a_twin_has_what_the_paper_names() -> None:
    one = config.read(config.shipped("spad512.yaml"))
    plain = one.sensor.resolved()
    chip = sensors.twin_of(plain, 500e-9)
    b, rate, other = chip.effect("detection"), plain.effect("dark_counts"), chip.effect("dark_counts")
    # of 262,144 pixels; the false-alarm rate of each is below 1e-6
    assert abs(b.pdp.mean() / 0.444 - 1) < 5 * _chip.SPREAD / 512  # type: ignore[union-attr]
    assert abs(b.pdp.std() / 0.444 / _chip.SPREAD - 1) < 5 / 2**0.5 / 512  # type: ignore[union-attr]
    lazy = b.relative[b.relative != 1]  # type: ignore[union-attr]
    assert abs(lazy.size / 512**2 - _chip.LAZY) < 5 * 0.14 / 512
    assert abs(lazy.mean() - _chip.LAZY_PDP[0]) < 5 * _chip.LAZY_PDP[1] / lazy.size**0.5
    assert np.array_equal(rate.rate, other.rate) and rate.rate.max() > 1e5  # type: ignore[union-attr]


def test_means_are_those_of_the_closed_form(small: Path) -> None:
    for panel in PANELS:
        result = sensors._Bench(panel).compare()
        curves = result["curves"]
        assert list(curves) == [MEASURED, SIMULATED, DARK] and result["twin"]
        for name, one in curves.items():
            assert one["error"] > 0
            assert abs(one["mean"] - one["closed_form"]) < SIGMAS * one["error"], (panel.key, name)
        for name in (MEASURED, SIMULATED):  # the means are inputs
            assert curves[name]["closed_form"] == pytest.approx(result["paper"][name], rel=1e-6)
        if result["unit"] == "counts":
            assert all(sum(one["histogram"]) == 120 for one in curves.values())
        else:
            assert all(len(one["each"]) == len(one["scatter"]) == 23 for one in curves.values())
            # the scatter of 10 captures is that of photons: 23 pixels, 207 degrees of freedom, 5 deviations
            one = curves[SIMULATED]
            found = np.mean(np.square(one["scatter"])) * result["exposure"] / one["mean"]
            assert abs(found - 1) < 5 * (2 / 207) ** 0.5


def test_a_quick_run_is_a_part_of_the_same_chip(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensors, "QUICK_SIDE", 6)
    whole, part = (bench("spad512-700nm-low", quick).compare() for quick in (False, True))
    assert (part["pixels"], whole["pixels"]) == (36, 120) and part["printed"] == whole["printed"]
    assert sum(part["curves"][MEASURED]["histogram"]) == 36
    for one in part["curves"].values():
        assert abs(one["mean"] - one["closed_form"]) < SIGMAS * one["error"]
    few = bench("spad23-500nm", True).compare()
    assert few["pixels"] == 23 and {one["captures"] for one in few["curves"].values()} == {sensors.QUICK_CAPTURES}


# --- captures -----------------------------------------------------------------------------------------------------


def test_captures_take_the_twins_place(small: Path) -> None:
    lab, tr = (
        lab_of(small / key, key, (120.0,) if "512" in key else (3.0, 3.0))
        for key in ("spad512-500nm-low", "spad23-500nm")
    )
    done = experiments.run(Sensors(captures=(str(lab), str(tr))), Setting(small / "out"))
    real = {one["key"]: one for one in done.results if not one["twin"]}
    assert sorted(real) == ["spad23-500nm", "spad512-500nm-low"] and len(done.results) == len(PANELS)
    for one, folder in ((real["spad512-500nm-low"], lab), (real["spad23-500nm"], tr)):
        there, scale = measurement.open(folder), 1 if one["unit"] == "counts" else 10
        totals = np.array([there.recording(c.id).totals for c in there.captures if not c.light.dark])
        assert one["curves"][MEASURED]["mean"] == pytest.approx(totals.mean() * scale)
        assert one["curves"][MEASURED]["closed_form"] is None and one["curves"][MEASURED]["captures"] == len(totals)
        assert one["curves"][SIMULATED]["closed_form"] == pytest.approx(totals.mean() * scale, rel=1e-6)
        dark = there.recording("dark").totals.mean() * scale
        assert one["curves"][DARK]["mean"] == pytest.approx(dark)
    page, text = done.page.read_text(), (small / "out" / "sensors.md").read_text()
    for words in (INPUTS, "a twin stands in", "What the printed light levels give", "SPAD512, 700 nm, low"):
        assert words in page and words in text
    lead = next(line for line in text.splitlines() if "a twin stands in" in line)
    assert "SPAD512, 700 nm, low" in lead and "SPAD512, 500 nm, low" not in lead
    with open(small / "out" / "sensors.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * len(PANELS) and {row["source"] for row in rows} == {"twin", "captures", "the paper's model"}
    for name in ("pixels.png", "histograms.png"):
        assert (small / "out" / name).stat().st_size > 10_000
    assert all(path.stat().st_size < 60_000 for path in (small / "out" / "results").iterdir())
    with pytest.raises(SpadError, match=r"is another result \(captures"):
        experiments.run(Sensors(), Setting(small / "out"))


def test_captures_without_a_dark_one(small: Path) -> None:
    lab = measurement.open(lab_of(small / "lab", "spad512-700nm-high", (200.0,), dark=False))
    every = {panel.key: config.read(config.shipped(panel.file)) for panel in PANELS}
    found = sensors._found([lab], every)
    assert list(found) == ["spad512-700nm-high"] and found["spad512-700nm-high"].dark is None
    result = replace(bench("spad512-700nm-high"), found=found["spad512-700nm-high"]).compare()
    assert list(result["curves"]) == [MEASURED, SIMULATED]


def test_captures_that_are_of_no_panel(small: Path) -> None:
    lab = lab_of(small / "other", "spad512-500nm-low", (120.0,), frames=5000, exposure=5e-3)
    with pytest.raises(
        InputError, match=r"has no capture in uniform light like .*QIS of 12 x 10 pixels at 500 nm, 10 ms"
    ):
        Sensors(captures=(str(lab),)).prepare(Setting(small / "out"))
    lab = lab_of(small / "two", "spad512-500nm-low", (120.0, 60.0))
    with pytest.raises(InputError, match=r"lit-1|captures\[1\].*another light level than"):
        Sensors(captures=(str(lab),)).prepare(Setting(small / "out"))
    with pytest.raises(SpadError, match="nowhere"):
        experiments.run(Sensors(captures=(str(small / "nowhere"),)), Setting(small / "out"))
    assert not (small / "out" / "results").exists()
