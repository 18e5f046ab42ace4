"""An echo that no capture shows by itself: the same cell of all captures together is a check of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy import stats

from spadmnist import config, twin
from spadmnist import measurement as measurements
from spadmnist.inference.comparison import compare
from spadmnist.inference.evaluation import BlockCheck, failing
from spadmnist.inference.null_distribution import Null, learn
from spadmnist.inference.repeated_cells import repeated
from spadmnist.inference.replicates import no_size
from spadmnist.measurement import Measurement
from spadmnist.recording import Recording
from spadmnist.statistics import Summary

NAME, CELLS, REPLICATES, CAPTURES = "fine_intervals", 400, 64, 5
SENSOR = """sensor:
  name: fibre
  rules: device
  layout: {rows: 2, columns: 2, pixel_area: 100 um^2, fill_factor: 1.0}
  effects:
    detection: {pdp: 0.5}
    dark_counts: {rate: 100 Hz}
    dead_time: {duration: 50 ns}
    tdc: {resolution: 100 ps}
"""
FLAT = """  - {id: flat-ID, file: flat-ID.h5, modality: tr, exposure: 20 ms,
     light: {kind: flat, wavelength: 500 nm, irradiance: 200 nW/cm^2, relative_uncertainty: 0.02}}
"""


def counted(rng: np.random.Generator, more: int = 0, axes: int = 1) -> dict[Any, Any]:
    """The checks of five captures with four counts in each cell, and some more in cell 100 of each."""
    nulls, own, residuals, seen = {}, {}, {}, {}
    for k in range(CAPTURES):
        cell, totals = (f"flat-{k}", NAME), 1000 + rng.standard_normal(REPLICATES)
        values = rng.poisson(4.0, (REPLICATES + 1, CELLS)).astype(float)
        values[-1, 100] += more
        summaries = [Summary(v, "poisson", str, lambda *_: ("", 0.0)) for v in values[:-1]]
        null = nulls[cell] = learn(summaries, totals)
        residuals[cell] = null.residuals(values[-1], *null.expected(1000.0))
        expected, leverage = null.expected_all(totals)
        own[cell] = null.residuals(values[:-1], expected, -leverage[:, None])
        axis = np.arange(CELLS) + float(k % axes)
        seen[cell[0]] = SimpleNamespace(total=1000 + (k == 3), summaries={NAME: SimpleNamespace(axis=axis)})
    alone = min(null.p_value(residuals[cell])[0] for cell, null in nulls.items())
    found = repeated(SimpleNamespace(seen=seen), nulls, own, residuals)
    return {"found": found, "alone": alone, "residuals": residuals}


def test_what_each_capture_hides_all_of_them_show() -> None:
    made = counted(np.random.default_rng(1), 9)
    (check,) = made["found"]
    assert made["alone"] > 1e-3 and check.p < 1e-8 and check.worst == 100 and check.captures == CAPTURES
    assert check.cell == ("flat-3", NAME)  # the one with the most detections
    assert made["residuals"][check.clearest][100] == max(z[100] for z in made["residuals"].values())


def test_captures_with_other_cells_are_not_taken_together() -> None:
    """Of five captures three have one set of cells and two another one."""
    found = counted(np.random.default_rng(1), 6, axes=2)["found"]
    assert sorted(check.captures for check in found) == [2, 3]
    assert counted(np.random.default_rng(1), 6, axes=5)["found"] == []


def test_p_values_of_a_right_model_are_no_smaller_than_uniform() -> None:
    """60 right models; false alarms: 1e-6 for each level."""
    rng = np.random.default_rng(2)
    p = np.array([check.p for _ in range(60) for check in counted(rng)["found"]])
    for level in (0.5, 0.1, 0.01):
        assert (p < level).sum() <= stats.binom.isf(1e-6, p.size, level)


def test_two_tests_of_one_check_count_as_two() -> None:
    """Of 100 tests the least p-value may be 1e-4 where the allowed rate of false alarms is 1 %."""
    checks = [BlockCheck(("flat", f"check {k}"), 0.5, 0, 1.0) for k in range(98)]
    for p, fails in ((0.99e-4, True), (1.01e-4, False)):
        assert bool(failing([*checks, BlockCheck(("flat", NAME), p, 0, 4.0, tests=2)], 0.01)) == fails
    assert failing([*checks, BlockCheck(("flat", NAME), 1.0005e-4, 0, 4.0)], 0.01)  # as one it would fail


def with_echo(recording: Recording, share: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(ticks, pixels) of a recording, of which a share comes back after 249 ns."""
    assert recording.events is not None and recording.events.ticks is not None
    ticks, pixels = [], []
    for pixel in range(recording.pixels):
        own = recording.events.ticks[slice(*recording.events.offsets[pixel : pixel + 2])].astype(np.int64)
        back = own[rng.random(own.size) < share] + 2490
        ticks.append(np.concatenate([own, back]))
        pixels.append(np.full(ticks[-1].size, pixel))
    return np.concatenate(ticks), np.concatenate(pixels)


def test_compare_finds_an_echo_that_no_capture_shows_by_itself(tmp_path: Path) -> None:
    layout = "format: spadmnist-measurement/1\nname: lab\nlayout: {rows: 2, columns: 2}\ncaptures:\n"
    (tmp_path / "plan.yaml").write_text(layout + "".join(FLAT.replace("ID", str(k)) for k in range(5)))
    (tmp_path / "sensor.yaml").write_text(SENSOR)
    sensor = config.read_sensor(tmp_path / "sensor.yaml")
    plan = measurements.open(tmp_path / "plan.yaml", planned=True)
    lab = measurements.open(twin.simulate(sensor, plan, tmp_path / "lab", 1))
    rng = np.random.default_rng(3)
    arrays = {replace(c, tick=1e-10): with_echo(lab.recording(c.id), 5e-4, rng) for c in lab.captures}
    found = compare(sensor, Measurement.from_arrays(lab.layout, arrays), replicates=32, jobs=1)
    (failed,) = found.failing
    assert failed.statistic == NAME and failed.where == "intervals of 249 to 250 ns, alike in 5 captures"
    assert compare(sensor, lab, replicates=32, jobs=1).verdict == "adequate"


def test_what_must_never_be_and_yet_is_in_a_model_is_a_rare_event_of_it() -> None:
    """Frames that repeat where the light goes out: other replicates have other numbers of them."""
    rng = np.random.default_rng(5)

    def null_of(numbers: np.ndarray) -> Null:
        return learn([Summary(np.array([x]), "exact", str, no_size) for x in numbers], np.full(len(numbers), 1e4))

    dark = null_of(rng.poisson(400.0, 96).astype(float))
    p = [dark.judge(np.array([x]), 1e4).p_value for x in (402.0, 440.0, 800.0)]
    assert p[0] > 0.1 and p[1] > 1e-3 and p[2] < 1e-9
    never = null_of(np.zeros(96))
    assert never.judge(np.array([1.0]), 1e4).p_value < 1e-9 and never.judge(np.array([0.0]), 1e4).p_value == 1.0
    once = null_of(np.append(np.zeros(95), 1.0))
    assert once.judge(np.array([1.0]), 1e4).p_value > 1e-3
