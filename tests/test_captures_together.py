"""What no capture shows by itself: an echo, a lamp that fluctuates. All captures together are checks of their own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from spadmnist import config, twin
from spadmnist import measurement as measurements
from spadmnist.inference.captures_together import Together, checks_together
from spadmnist.inference.checks import BlockCheck, failing
from spadmnist.inference.comparison import compare
from spadmnist.inference.null_distribution import Null, learn
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


class Kept:
    """What `checks_together` needs of an evaluation."""

    def __init__(self, nulls: dict[Any, Null], own: dict[Any, np.ndarray]):
        self.nulls, self.replicate_residuals = nulls, own

    def once(self, name: Any, make: Any) -> Any:
        return make()


def counted(
    rng: np.random.Generator, more: int = 0, axes: int = 1, scatter: float = 0.0, clear: int = 0
) -> dict[Any, Any]:
    """The checks of five captures with four counts in each cell.

    Args:
        more: counts in cell 100 of each.
        axes: so many captures in turn have other cells.
        scatter: relative standard deviation of the mean, with another pattern in each capture.
        clear: counts in cell 100 of the capture with the most detections, besides.
    """
    nulls, own, residuals, seen = {}, {}, {}, {}
    for k in range(CAPTURES):
        cell, totals = (f"flat-{k}", NAME), np.full(REPLICATES, 1000.0)
        values = rng.poisson(4.0, (REPLICATES + 1, CELLS)).astype(float)
        values[-1] = rng.poisson(4.0 * np.maximum(1 + scatter * rng.standard_normal(CELLS), 0.0))
        values[-1, 100] += more + clear * (k == 3)
        summaries = [Summary(v, "poisson", str, lambda *_: ("", 0.0)) for v in values[:-1]]
        null = nulls[cell] = learn(summaries, totals)
        residuals[cell] = null.residuals(values[-1], *null.expected(1000.0))
        expected, leverage = null.expected_all(totals)
        own[cell] = null.residuals(values[:-1], expected, -leverage[:, None])
        axis = np.arange(CELLS) + float(k % axes)
        seen[cell[0]] = SimpleNamespace(total=1000 + (k == 3), summaries={NAME: SimpleNamespace(axis=axis)})
    alone = {cell: null.p_value(residuals[cell])[0] for cell, null in nulls.items()}
    found = checks_together(SimpleNamespace(seen=seen), Kept(nulls, own), residuals, alone)  # type: ignore[arg-type]
    return {"found": found, "alone": min(alone.values()), "residuals": residuals}


def alike(made: dict[Any, Any]) -> list[Together]:
    """The checks of cells that deviate alike."""
    return [check for check in made["found"] if check.alike]


def in_squares(made: dict[Any, Any]) -> list[Together]:
    """The checks of squares."""
    return [check for check in made["found"] if not check.alike]


def test_what_each_capture_hides_all_of_them_show() -> None:
    made = counted(np.random.default_rng(1), 9)
    (check,) = alike(made)
    assert made["alone"] > 1e-3 and check.p < 1e-8 and check.worst == 100 and len(check.cells) == CAPTURES
    assert check.cell == ("flat-3", NAME)  # the one with the most detections
    assert made["residuals"][check.clearest][100] == max(z[100] for z in made["residuals"].values())


def test_captures_with_other_cells_are_not_taken_together() -> None:
    """Of five captures three have one set of cells and two another one. Squares add up whatever the cells are."""
    made = counted(np.random.default_rng(1), 6, axes=2)
    assert sorted(len(check.cells) for check in alike(made)) == [2, 3]
    apart = counted(np.random.default_rng(1), 6, axes=5)
    assert not alike(apart) and [len(check.cells) for check in in_squares(apart)] == [CAPTURES]


def test_what_scatters_in_another_way_in_each_capture_is_found_by_its_squares() -> None:
    made = counted(np.random.default_rng(5), scatter=0.2)
    (check,) = in_squares(made)
    assert made["alone"] > 1e-4 and check.p < 1e-7 and len(check.cells) == CAPTURES and check.excess > 100
    assert min(one.p for one in alike(made)) > 1e-3
    assert check.words == ", the clearest of 5 captures that scatter too much"


def test_a_capture_that_shows_a_deviation_clearly_is_left_out_of_the_others() -> None:
    """What the other captures show together does not hide behind it, and is not made by it."""
    made = counted(np.random.default_rng(1), 9, clear=60)
    (check,) = alike(made)
    assert made["alone"] < 1e-20 and check.p < 1e-6 and len(check.cells) == CAPTURES - 1
    assert check.cell == ("flat-3", NAME) not in check.cells
    none = counted(np.random.default_rng(1), 60)
    assert none["alone"] < 1e-20 and [(check.p, check.cells) for check in none["found"]] == [(1.0, ())] * 2


LAWS: dict[str, tuple[str, Callable[..., np.ndarray], int]] = {
    "poisson": ("poisson", lambda rng, shape: rng.poisson(4.0, shape), 32),
    "rare": ("poisson", lambda rng, shape: rng.poisson(0.02, shape), 32),
    "normal": ("normal", lambda rng, shape: rng.standard_normal(shape), 32),
    "exponential": ("exponential", lambda rng, shape: rng.exponential(1.0, shape), 32),
}


@pytest.mark.slow
@pytest.mark.parametrize("shared", [0.0, 0.9], ids=["", "one chip"])
@pytest.mark.parametrize("name", LAWS)
def test_p_values_of_a_right_model_are_no_smaller_than_uniform(name: str, shared: float) -> None:
    """60 right models, three captures. Captures of one chip scatter more or less together. False alarms: 1e-6 a level.

    Few replicates inform the expectation of many cells, as in a spectrum: their own residuals are a little too small.
    """
    law, draw, number = LAWS[name]
    rng = np.random.default_rng(2)
    p: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(60):
        nulls, own, residuals, seen = {}, {}, {}, {}
        chips = np.exp(shared * 0.15 * rng.standard_normal((number + 1, 1)))
        for k in range(3):
            cell, totals = (f"flat-{k}", NAME), np.full(number, 1000.0)
            values = draw(rng, (number + 1, 600)).astype(float)
            if law == "normal":
                values = values * chips
            summaries = [Summary(v, law, str, no_size) for v in values[:-1]]
            null = nulls[cell] = learn(summaries, totals)
            residuals[cell] = null.residuals(values[-1], *null.expected(1000.0))
            expected, leverage = null.expected_all(totals)
            own[cell] = null.residuals(values[:-1], expected, -leverage[:, None])
            seen[cell[0]] = SimpleNamespace(total=1000, summaries={NAME: SimpleNamespace(axis=None)})
        alone = dict.fromkeys(residuals, 1.0)
        found = checks_together(SimpleNamespace(seen=seen), Kept(nulls, own), residuals, alone)  # type: ignore[arg-type]
        for check in found:
            p[check.alike].append(check.p)
    for values in p.values():
        assert len(values) == 60
        for level in (0.5, 0.1, 0.01):
            assert (np.array(values) < level).sum() <= stats.binom.isf(1e-6, 60, level)


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


@pytest.mark.slow
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
