"""Fit: maps from counts, steps on residuals, what the caller may name."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from scipy import optimize

import spadmnist as sp
from spadmnist import config
from spadmnist import measurement as measurements
from spadmnist.cli import cli
from spadmnist.effects import Conditions
from spadmnist.errors import InputError
from spadmnist.inference.bounded_step import bounded_step
from spadmnist.inference.candidates import candidates, with_values
from spadmnist.inference.coordinates import Coordinate, point_of
from spadmnist.inference.count_model import light_levels_of
from spadmnist.inference.evaluation import Evaluation, evaluate, square, stacked
from spadmnist.inference.exact_likelihood import NoLikelihood, maximise
from spadmnist.inference.gauss_newton import (
    Effort,
    Fit,
    JacobianBy,
    covariance_of,
    error_scale,
    gauss_newton,
    gauss_newton_step,
    profile_intervals,
)
from spadmnist.inference.held_out import captures_needed, leave_one_capture_out, optimism
from spadmnist.inference.map_fits import fit_maps
from spadmnist.inference.models import Model
from spadmnist.inference.named_fit import fit_named, named_candidate
from spadmnist.inference.pixel_maps import PixelMap, map_values, summary
from spadmnist.inference.replicates import TOTALS, Execution, Replicates
from spadmnist.inference.results import sentence
from spadmnist.recording import Capture, Light
from spadmnist.streams import Streams
from spadmnist.twin import model_recordings
from spadmnist.workers import Serial

SENSOR = """sensor:
  name: small
  rules: device
  layout: {rows: 8, columns: 8, pixel_area: 25 um^2, fill_factor: 1.0}
  effects:
    detection: {pdp: 0.42}
    dark_counts: {rate: 100 Hz}
    dead_time: {duration: 50 ns}
    tdc: {resolution: 100 ps}
"""


@pytest.fixture
def made(tmp_path):
    """(sensor, a measurement of it with another dead time and a map of the PDP)."""
    file = tmp_path / "sensor.yaml"
    file.write_text(SENSOR)
    sensor = config.read_sensor(file)
    map_ = 1 + 0.1 * np.random.default_rng(3).standard_normal(64)
    hidden = with_values(sensor, {("detection", "relative"): map_, ("dead_time", "duration"): 60e-9})
    captures = []
    for id, exposure, level in (("dark", 0.5, None), ("flat", 0.05, 1e5), ("bright", 2e-3, 5e6)):
        wave = None if level is None else 500e-9
        light = Light() if level is None else Light(wave, 1.0, "irradiance", 0.02)
        capture = Capture(id, "tr", light, Conditions(exposure, 1, exposure, exposure, wave))
        images = np.zeros(1, np.uint64)
        streams = Streams(4, f"data/{id}", "data", images)
        captures.append((capture, level, model_recordings(hidden, capture, level or 0.0, streams, images)[0]))
    return sensor, captures, map_


def measured(tmp_path, sensor, captures):
    from spadmnist.light import photons_from_irradiance

    recordings, plans = [], []
    for capture, level, recording in captures:
        if level is not None:
            per = photons_from_irradiance(1.0, sensor.layout.active_area, 500e-9)
            capture = replace(capture, light=replace(capture.light, level=level / per))
            recording = replace(recording, capture=capture)
        plans.append(capture)
        recordings.append(recording)
    return measurements.open(measurements.write(tmp_path / "data", "made", sensor.layout, iter(recordings), plans))


@pytest.mark.slow
def test_a_dead_time_is_fitted_and_a_map_found(tmp_path, made):
    sensor, captures, map_ = made
    data = measured(tmp_path, sensor, captures)
    with Serial() as workers:
        replicates = Replicates(sensor, data, 0, Execution(workers), 16)
        evaluation = evaluate(replicates, {})
        candidate = next(c for c in candidates(sensor) if c.name == "per_pixel detection.pdp")
        levels = light_levels_of(replicates, evaluation)
        found = fit_maps(replicates, {}, [candidate], levels)[candidate.carrier]
        assert np.corrcoef(found.estimate, np.log(map_))[0, 1] > 0.95
        assert summary(found)["sigma"] == pytest.approx(float(np.std(np.log(map_))), rel=0.1)
        length = next(c for c in candidates(sensor) if c.name == "set dead_time.duration")
        values = {("dead_time", "duration"): 55e-9}
        fit = gauss_newton(
            replicates, evaluation, length.coordinates, values, lambda v: Model.same(with_values(sensor, v))
        )
    value, low, high = fit.interval(0)
    assert high - low < 2e-9 and abs(value - 60e-9) < 1.3 * (high - low)  # five standard errors


def test_what_cannot_be_fitted_is_told(tmp_path, made):
    sensor, captures, _ = made
    data = measured(tmp_path, sensor, captures)
    with pytest.raises(InputError, match="crosstalk"):
        fit_named(sensor, data, add=["cross"])
    with pytest.raises(InputError, match=r"EFFECT\.PARAMETER"):
        fit_named(sensor, data, free=["dead_time"])
    with pytest.raises(InputError, match="nothing is to be fitted"):
        fit_named(sensor, data)


def closed_form(monkeypatch, function, asked=None):
    """Models are numbers (a, b), and their residuals a function of them. asked: takes how many each call simulates."""

    def simulated(replicates, evaluation, models, sampling):
        if asked is not None:
            asked.append(len(models))
        return models

    def residuals(replicates, evaluation, model, times=1.0):
        return {("one", "cells"): function(*model.values())}

    monkeypatch.setattr("spadmnist.inference.gauss_newton.signatures", simulated)
    monkeypatch.setattr("spadmnist.inference.gauss_newton.residuals_at", residuals)


def profile_of(monkeypatch, function, jacobian, own, coordinates, point):
    cell = ("one", "cells")
    evaluation = Evaluation({}, None, {}, {}, {}, {}, {cell: np.zeros(len(jacobian))}, {}, {})
    covariance = covariance_of(jacobian, own)
    z = {cell: function(*point)}
    fit = Fit(coordinates, np.array(point), covariance, z, {cell: jacobian}, 0.0, {})
    closed_form(monkeypatch, function)
    return fit, profile_intervals(None, evaluation, fit, lambda values: values)


def test_a_profile_is_the_covariance_where_all_is_linear(monkeypatch):
    """Also where cells are not independent, and where two numbers do nearly the same."""
    rng = np.random.default_rng(5)
    jacobian = np.stack([np.ones(40), np.linspace(0.5, 1.5, 40)], axis=1)
    own = rng.standard_normal((96, 40)) + 0.6 * rng.standard_normal((96, 1))
    data = rng.standard_normal(40)
    data -= jacobian @ np.linalg.lstsq(jacobian, data, rcond=None)[0]
    coordinates = tuple(Coordinate("any", name, "", -20.0, 20.0, 0.0) for name in "ab")
    fit, ends = profile_of(monkeypatch, lambda a, b: data + jacobian @ [a, b], jacobian, own, coordinates, [0.0, 0.0])
    for i, coordinate in enumerate(coordinates):
        assert ends[coordinate.key] == pytest.approx(fit.interval(i)[1:], rel=1e-3)


def test_what_a_law_leaves_in_its_own_cells_makes_its_numbers_less_certain():
    """Of 40 cells the first 20 tell a, the others b; those of a lie three times as wide as chance has it, or less."""
    rng = np.random.default_rng(7)
    cell = ("one", "cells")
    jacobian = np.kron(np.eye(2), np.ones((20, 1)))
    own = rng.standard_normal((96, 40))
    coordinates = tuple(Coordinate("any", name, "", -20.0, 20.0, 0.0) for name in "ab")
    evaluation = Evaluation({}, None, {}, {}, {}, {}, {}, {cell: own}, {})

    def wider(wide_of_a):
        z = np.tile([1.0, -1.0], 20) * np.repeat([wide_of_a, 0.5], 20)
        fit = Fit(coordinates, np.zeros(2), np.eye(2), {cell: z}, {cell: jacobian}, 0.0, {})
        return error_scale(fit, evaluation)

    assert wider(3.0) == pytest.approx([3.0, 1.0], rel=0.05)
    assert wider(0.5).tolist() == [1.0, 1.0]
    nothing = Fit(coordinates, np.zeros(2), np.eye(2), {}, {}, 0.0, {})
    assert error_scale(nothing, evaluation).tolist() == [1.0, 1.0]


def test_what_is_unseen_is_what_numbers_fitted_without_it_leave():
    """Against least squares done anew without each capture, and in one that alone tells a number without each cell."""
    rng = np.random.default_rng(12)
    cells = {("a", "x"): 30, ("b", "x"): 20, ("b", "y"): 10, ("c", "x"): 30, TOTALS: 3}
    jacobian = {cell: rng.standard_normal((n, 2)) for cell, n in cells.items()}
    noise = {cell: rng.standard_normal(n) for cell, n in cells.items()}

    def fit(left_out: str = "") -> np.ndarray:
        keys = [cell for cell in cells if not left_out or cell[0] != left_out]
        return np.linalg.lstsq(np.concatenate([jacobian[k] for k in keys]), -stacked(noise, keys), rcond=None)[0]

    z = {cell: noise[cell] + jacobian[cell] @ fit() for cell in cells}
    found = leave_one_capture_out(z, jacobian)
    for cell in cells:
        without = z[cell] if cell == TOTALS else noise[cell] + jacobian[cell] @ fit(cell[0])
        assert found[cell] == pytest.approx(without, rel=1e-6, abs=1e-9)
    jacobian["a", "x"] *= 9.0
    z = {cell: noise[cell] + jacobian[cell] @ fit() for cell in cells}
    worst = int(np.argmax(np.abs(z["a", "x"])))
    keep = np.arange(30) != worst
    left = np.concatenate([jacobian["a", "x"][keep], *(jacobian[k] for k in cells if k[0] != "a")])
    rest = np.concatenate([noise["a", "x"][keep], *(noise[k] for k in cells if k[0] != "a")])
    alone = noise["a", "x"][worst] - jacobian["a", "x"][worst] @ np.linalg.lstsq(left, rest, rcond=None)[0]
    assert leave_one_capture_out(z, jacobian)["a", "x"][worst] == pytest.approx(alone, rel=1e-6)


def test_numbers_that_are_not_where_the_squares_are_least_gain_nothing_by_that() -> None:
    """At a bound, or fitted half way: what they lack there they lack on captures that are not seen, too."""
    rng = np.random.default_rng(14)
    jacobian = {(id, "x"): rng.standard_normal((50, 2)) for id in "abc"}
    noise = {cell: rng.standard_normal(50) for cell in jacobian}
    keys = list(jacobian)
    best = np.linalg.lstsq(np.concatenate([jacobian[k] for k in keys]), -stacked(noise, keys), rcond=None)[0]
    coordinates = tuple(Coordinate("any", name, "", -20.0, 20.0, 0.0) for name in "ab")
    found = {}
    for lacks in (0.0, 2.0):
        z = {cell: noise[cell] + jacobian[cell] @ (best - lacks) for cell in keys}
        fit = Fit(coordinates, best, np.eye(2), z, jacobian, square(z), {})
        found[lacks] = leave_one_capture_out(z, jacobian)
        assert square(found[lacks]) > square(z) - 1e-9 or lacks
        assert 0 <= optimism(z, fit) < 60
        assert lacks == 0 or square(z) > 500
    for cell in keys:
        assert found[2.0][cell] - found[0.0][cell] == pytest.approx(-2.0 * jacobian[cell].sum(axis=1), rel=1e-6)
    jacobian["a", "x"] = 9.0 * jacobian["a", "x"]  # it alone tells them, cell by cell
    signature = {lacks: {c: noise[c] + jacobian[c] @ (best - lacks) for c in keys} for lacks in (0.0, 2.0)}
    one, other = (leave_one_capture_out(signature[lacks], jacobian)["a", "x"] for lacks in (0.0, 2.0))
    assert other - one == pytest.approx(-2.0 * jacobian["a", "x"].sum(axis=1), rel=1e-6)


def test_what_two_numbers_have_in_common_may_be_told_by_one_capture() -> None:
    """They do nearly the same in one capture, and another one tells them apart: without it nobody would know either."""
    rng = np.random.default_rng(15)
    shape = rng.standard_normal(200)
    near = shape + 0.02 * rng.standard_normal(200)
    apart = np.stack([rng.standard_normal(200), rng.standard_normal(200)], axis=1)
    jacobian = {("a", "x"): np.stack([shape, near], axis=1), ("b", "x"): 0.3 * apart}
    z = {cell: rng.standard_normal(200) for cell in jacobian}
    assert captures_needed(z, jacobian) == {"a", "b"}  # a the sum of both, b their difference
    coordinates = tuple(Coordinate("any", name, "", -20.0, 20.0, 0.0) for name in "ab")
    best = np.linalg.lstsq(np.concatenate(list(jacobian.values())), -stacked(z, list(z)), rcond=None)[0]
    z = {cell: z[cell] + jacobian[cell] @ best for cell in z}
    fit = Fit(coordinates, best, np.eye(2), z, jacobian, square(z), {})
    assert optimism(z, fit) == pytest.approx(4.0, rel=1e-6)  # 1,000 and more if each judged the other
    assert captures_needed(z, {cell: np.zeros((200, 2)) for cell in z}) == captures_needed(z, {}) == set()


def test_numbers_of_one_capture_and_of_totals_cost_as_many() -> None:
    rng = np.random.default_rng(16)
    coordinates = tuple(Coordinate("any", name, "", -20.0, 20.0, 0.0) for name in "abc")
    for cell in (("a", "x"), TOTALS):
        jacobian = {cell: rng.standard_normal((30, 3))}
        z = {cell: rng.standard_normal(30)}
        fit = Fit(coordinates, np.zeros(3), np.eye(3), z, jacobian, square(z), {})
        assert optimism(z, fit) == pytest.approx(6.0, rel=1e-6)


def test_numbers_cost_what_chance_lets_them_gain():
    """Two numbers of three captures alike lower the squares by 2, and raise those of what is unseen by 3 (Stone 1977).

    The mean of 1600 draws scatters by 0.094 (measured): 0.47 away is five times that, 1e-6.
    """
    rng = np.random.default_rng(13)
    shape = rng.standard_normal((40, 2))
    jacobian = {(id, "x"): shape for id in "abc"}
    coordinates = tuple(Coordinate("any", name, "", -20.0, 20.0, 0.0) for name in "ab")
    costs = []
    for _ in range(1600):
        noise = rng.standard_normal((3, 40))
        best = np.linalg.lstsq(shape, -noise.mean(axis=0), rcond=None)[0]
        z = {cell: x + shape @ best for cell, x in zip(jacobian, noise, strict=True)}
        fit = Fit(coordinates, best, np.eye(2), z, jacobian, square(z), {})
        costs.append(optimism(z, fit))
    assert np.mean(costs) == pytest.approx(5.0, abs=0.47)
    assert np.std(costs) / 40 < 0.1


def test_a_profile_is_as_uneven_as_the_model_and_ends_at_a_bound(monkeypatch):
    rng = np.random.default_rng(6)
    own = rng.standard_normal((960, 30))
    coordinate = Coordinate("any", "a", "", -0.3, 5.0, 0.0, bounds=(-0.3, None))
    law = lambda a: np.full(30, np.expm1(a))  # noqa: E731
    fit, ends = profile_of(monkeypatch, law, np.ones((30, 1)), own, (coordinate,), [0.0])
    wide = 1.96 * float(np.sqrt(fit.covariance[0, 0]))
    low, high = ends[coordinate.key]
    assert low == -0.3, "at -0.3 the squares have risen by less"
    assert high == pytest.approx(np.log1p(wide), rel=0.03)
    assert high < 0.9 * wide


@pytest.mark.parametrize(
    ("ends", "bounds", "off", "reach", "expected"),
    [
        ((1e-9, 1e-6), (0, None), 0.0, (math.log(0.9e-9), math.log(1.2e-9)), (0.9e-9, 1.2e-9)),
        (
            (1e-9, 1e-6),
            (0, None),
            0.0,
            (-math.inf, 800.0),
            (0.0, 1e-6 * math.exp(0.3)),
        ),  # nothing tells it, so that it may be absent
        ((1e-9, 1e-6), (0, None), 0.0, (math.log(1e-9), math.log(2e-9)), (0.0, 2e-9)),  # a profile that does not fall
        (
            (1e-9, 1e-6),
            (0, None),
            None,
            (-math.inf, 800.0),
            (1e-9 / math.exp(0.3), 1e-6 * math.exp(0.3)),
        ),  # a shape, which is never absent
        ((1e-2, 1.0), (0, None), 0.0, (math.log(0.5), math.log(1.2)), (0.5, 1.2)),
        ((1e-2, 1.0), (0, None), 0.0, (math.log(0.5), math.log(1.6)), (0.5, math.exp(0.3))),  # no less than that
        ((-0.3, 5.0), (-0.35, None), 0.0, (-0.4, 5.5), (-0.35, 5.5)),
        ((0.1, 1.0), (0, 1), 1.0, (math.log(1e-9), math.log(0.92)), (0.08, 1.0)),  # what lacks
    ],
)
def test_where_a_number_is_looked_for_is_no_bound_of_what_it_may_be(ends, bounds, off, reach, expected):
    coordinate = Coordinate("any", "a", "", *ends, off, bounds=bounds, absent=off)
    assert coordinate.interval(*reach) == pytest.approx(expected)
    assert all(ends[0] <= coordinate.value(u) <= ends[1] for u in reach)


def test_a_number_that_nothing_follows_stays_as_it_is():
    """Of two numbers the cells follow one; the other, of a slope that is hardly one, is not thrown to its bound."""
    rng = np.random.default_rng(8)
    cell = ("one", "cells")
    coordinates = tuple(Coordinate("any", name, "", 1e-4, 0.5, 0.0) for name in "ab")
    jacobian = np.stack([np.full(30, 2.0), np.linspace(-1e-3, 1e-3, 30)], axis=1)
    z = 0.5 * jacobian[:, 0] + rng.standard_normal(30)
    own = {cell: rng.standard_normal((64, 30))}
    evaluation = Evaluation({}, None, {}, {}, {}, {}, {cell: z}, own, {})
    values = {coordinate.key: 0.01 for coordinate in coordinates}
    before = Fit(coordinates, point_of(coordinates, values), np.eye(2), {cell: z}, {cell: jacobian}, 0.0, dict(values))
    found = gauss_newton_step(None, evaluation, coordinates, values, lambda v: v, JacobianBy(before=before))
    assert found.values["any", "b"] == pytest.approx(0.01)
    assert np.log(found.values["any", "a"] / 0.01) == pytest.approx(-0.5, abs=5 * 0.5 / np.sqrt(30))


def test_a_step_within_bounds_is_that_of_a_solver():
    """Of random least squares, whose curvatures differ by many powers of ten, against scipy's bounded solver."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        n = int(rng.integers(1, 7))
        design = rng.standard_normal((n + 3, n)) @ (np.eye(n) + 0.9 * rng.standard_normal((n, n)))
        design *= 10 ** rng.uniform(-3, 3, n)
        wanted = 10 * rng.standard_normal(n + 3)
        ends = np.stack([-rng.exponential(1, n) * (rng.random(n) < 0.8), rng.exponential(1, n)])
        free = np.ones(n, bool)
        found = bounded_step(design.T @ wanted, design.T @ design, np.zeros(n), ends, free)
        bounds = np.minimum(ends[0], -1e-12), ends[1]
        known = optimize.lsq_linear(design, wanted, bounds, method="bvls").x
        squares = [float(((design @ x - wanted) ** 2).sum()) for x in (found, known)]
        assert np.all((ends[0] <= found) & (found <= ends[1]))
        assert squares[0] < squares[1] + 1e-4 * (1 + squares[1])
    assert bounded_step(
        np.array([0.0, 5.0]), np.diag([1e13, 10.0]), np.zeros(2), np.array([[-9.0] * 2, [9.0] * 2]), np.ones(2, bool)
    ) == pytest.approx([0.0, 0.5])


def test_a_number_at_the_end_of_its_range_leaves_the_others_where_they_fit_best():
    """Of two that are correlated; the best value of the first lies four of its errors beyond the end."""
    rng = np.random.default_rng(0)
    lifetime, chance = (
        Coordinate("any", name, "", low, high, off)
        for name, low, high, off in (("lifetime", 5e-9, 5e-7, None), ("probability", 1e-4, 0.1, 0.0))
    )
    one, other = np.linalg.qr(rng.standard_normal((200, 2)))[0].T
    jacobian = np.stack([10 * one, 40 * (0.8 * one + 0.6 * other)], axis=1)
    there = np.array([lifetime.ends[1], math.log(5e-3)])
    beyond = jacobian @ np.array([-0.4, 0.0])  # residuals at `there`
    moved = -float(jacobian[:, 1] @ beyond) / float(jacobian[:, 1] @ jacobian[:, 1])
    cell = ("flat", "intervals")
    values = {lifetime.key: 5e-7, chance.key: math.exp(there[1])}
    evaluation = Evaluation({}, None, {}, {}, {}, {}, {cell: beyond}, {cell: rng.standard_normal((96, 200))}, {})
    before = Fit((lifetime, chance), there, np.eye(2), {cell: beyond}, {cell: jacobian}, 0.0, dict(values))
    found = gauss_newton_step(None, evaluation, (lifetime, chance), values, lambda v: v, JacobianBy(before=before))
    assert found.values[lifetime.key] == pytest.approx(5e-7)
    assert found.point[1] - there[1] == pytest.approx(moved) and found.square < float(beyond @ beyond)


PLAN = """format: spadmnist-measurement/1
name: lab
layout: {rows: 8, columns: 8}
captures:
  - {id: dark, modality: tr, light: {kind: dark}, exposure: 1000 ms, file: dark.h5}
  - {id: flat, modality: tr, exposure: 50 ms, file: flat.h5,
     light: {kind: flat, wavelength: 500 nm, irradiance: 40 nW/cm^2, relative_uncertainty: 0.02}}
  - {id: bright, modality: tr, exposure: 2 ms, file: bright.h5,
     light: {kind: flat, wavelength: 500 nm, irradiance: 4000 nW/cm^2, relative_uncertainty: 0.02}}
"""


def answer_of(tmp_path, sensor, name):
    """(values by parameter, what was printed) of `fit` on the command line."""
    (tmp_path / f"{name}.yaml").write_text(sensor)
    free = ["--free", "dead_time.duration", "--free", "afterpulsing.probability"]
    out = ["-o", str(tmp_path / f"{name}-next.yaml"), "--json", str(tmp_path / f"{name}.json"), "--jobs", "1"]
    done = CliRunner().invoke(cli, ["fit", str(tmp_path / f"{name}.yaml"), str(tmp_path / "data"), *free, *out])
    assert done.exit_code == 0, done.output
    steps = json.loads((tmp_path / f"{name}.json").read_text())["steps"]
    return {key: value for step in steps for key, value in step["values"].items()}, done.output


@pytest.mark.slow
@pytest.mark.long
def test_likelihood_and_simulation_agree_on_the_command_line(tmp_path):
    """The same numbers of the same data; simulated only where the sensor has what the likelihood does not know."""
    start = SENSOR.replace("tdc:", "afterpulsing: {probability: 0.7 %, lifetime: 25 ns}\n    tdc:")
    (tmp_path / "true.yaml").write_text(start.replace("0.7 %", "3 %").replace("50 ns", "60 ns"))
    (tmp_path / "plan").mkdir()
    (tmp_path / "plan" / "measurement.yaml").write_text(PLAN)
    where = [str(tmp_path / name) for name in ("true.yaml", "plan", "data")]
    done = CliRunner().invoke(cli, ["simulate", *where[:2], "-o", where[2], "--seed", "7"])
    assert done.exit_code == 0, done.output
    exact, said = answer_of(tmp_path, start, "exact")
    assert "by likelihood" in said
    other, said = answer_of(
        tmp_path, start.replace("tdc:", "crosstalk: {probability: 0.000001}\n    tdc:"), "simulated"
    )
    assert "there is no likelihood of crosstalk" in said
    for name, truth in (("duration", 60e-9), ("probability", 0.03)):
        one, two = exact[name], other[name]
        assert (one["method"], two["method"]) == ("likelihood", "simulation")
        assert one["low"] < truth < one["high"]
        assert one["low"] < two["high"] and two["low"] < one["high"]
        assert one["high"] - one["low"] < 1.1 * (two["high"] - two["low"])


def test_a_fit_whose_sensor_file_fails_a_check_is_not_explained(tmp_path, made, monkeypatch):
    """Its pixels may be others than those of the fitted model, by which no check fails."""
    sensor, captures, _ = made
    data = measured(tmp_path, with_values(sensor, {("dead_time", "duration"): 60e-9}), captures)
    monkeypatch.setattr("spadmnist.inference.named_fit.REPLICATES", 8)
    found = fit_named(sensor, data, free=["dead_time.duration"], jobs=1)
    assert found.in_sample.verdict == ("fails" if found.verdict == "partly_explained" else "adequate")
    failing = replace(found.in_sample, verdict="fails")
    monkeypatch.setattr("spadmnist.inference.named_fit.comparison_with", lambda *_: failing)
    assert fit_named(sensor, data, free=["dead_time.duration"], jobs=1).verdict == "partly_explained"


def test_a_fit_and_a_comparison_of_its_file_have_one_misfit(tmp_path, lab):
    """The file has six digits of a value; the statistics are those that go with its dead time."""
    sensor, data = lab(dead=56, seed=3)
    found = sp.fit(sensor, data, free=["dead_time.duration"], jobs=1)
    found.save(tmp_path / "next")
    written = sp.read_sensor(tmp_path / "next" / "sensor.yaml")
    assert written.effect("dead_time").duration == found.model.effect("dead_time").duration
    compared = sp.compare(written, data, jobs=1)
    assert found.misfit_in_sample == compared.misfit
    ours, theirs = (
        {(c.capture, c.statistic): c.p_value for c in one.checks} for one in (found.found.in_sample, compared)
    )
    assert ours == theirs


@pytest.mark.slow
def test_a_rate_of_which_nothing_was_seen_may_be_none() -> None:
    """No count in 16 pixel-seconds in the dark: the likelihood falls by 1.92 at 0.12 Hz, and there is no lower end."""

    def sensor(rate: float) -> sp.Sensor:
        effects = [sp.effects.Detection(pdp=0.4), sp.effects.DarkCounts(rate=rate), sp.effects.DeadTime(duration=50e-9)]
        return sp.Sensor(sp.Layout(4, 4, 25e-12, 1.0), [*effects, sp.effects.Tdc(resolution=1e-10)], rules="device")

    flat = sp.Capture("flat", "tr", exposure=0.05, wavelength=500e-9, irradiance=1e-3, relative_uncertainty=0.02)
    data = sp.simulate(sensor(1e-3), [sp.Capture("dark", "tr", exposure=1.0, dark=True), flat], seed=3)
    assert data.recording("dark").totals.sum() == 0
    fitted = sp.fit(sensor(100.0), data, free=["dark_counts.rate"], jobs=1)
    found = sp.diagnose(sensor(100.0), data, quick=True, jobs=1)  # and no map of what was not counted
    assert [step.candidate.name for step in found.steps] == ["set dark_counts.rate"]
    for answer in (fitted, found):
        rate = answer.steps[0].values["rate"]
        assert rate.low == 0 and rate.high == pytest.approx(1.92 / 16, rel=0.02) and rate.value < 0.01


@pytest.mark.slow
@pytest.mark.long
def test_a_switch_that_is_as_it_should_be_stays(tmp_path, made, monkeypatch):
    """The only other place that a switch has is the wrong one."""
    sensor, captures, map_ = made
    sensor = with_values(sensor, {("detection", "relative"): map_, ("dead_time", "duration"): 60e-9})
    monkeypatch.setattr("spadmnist.inference.named_fit.REPLICATES", 8)
    data = measured(tmp_path, sensor, captures)
    found = fit_named(sensor, data, free=["dead_time.paralyzable"], jobs=1)
    assert found.steps[0].values["paralyzable"].value == 0 and not found.values
    assert found.steps[0].significance == 0
    # nothing was wrong, and nothing explained: it was fitted
    assert found.verdict == "adequate" and sentence(found).endswith("No check failed before, and none fails now.")
    blind = with_values(sensor, {("dead_time", "paralyzable"): True})
    found = fit_named(blind, data, free=["dead_time.paralyzable"], jobs=1)
    assert found.steps[0].values["paralyzable"].value == 0
    assert found.values["dead_time", "paralyzable"] is False and found.steps[0].significance > 3


def test_beside_maps_no_number_that_changes_rates_is_fitted_by_likelihood(made):
    """Which takes the pixels' rates for known; of a dead time it need not know them."""
    sensor, captures, _ = made
    data = [recording for _, _, recording in captures]
    every = {candidate.name: candidate for candidate in candidates(sensor.resolved())}
    assert maximise(sensor.resolved(), data, [every["set dead_time.duration"]], mapped=True).free
    with pytest.raises(NoLikelihood, match="maps together with parameters that change the rates"):
        maximise(sensor.resolved(), data, [every["set dark_counts.rate"]], mapped=True)


def test_lazy_pixels_have_an_interval():
    """Of what is left to them, by how much they differ among each other and how well each is known."""
    rng = np.random.default_rng(2)
    error = np.full(400, 0.02)
    logs = 0.01 * rng.standard_normal(400)
    logs[:16] = np.log(0.5) + 0.1 * rng.standard_normal(16)
    pulled = logs * 0.97  # to the others, as a prior does it
    one = PixelMap(("detection", "relative"), 1.0, np.arange(400), pulled, error, logs, error, 0.01)
    told = map_values(one)["low_ratio"]
    assert told.low < 0.5 < told.high
    assert (told.high - told.low) / 2 == pytest.approx(1.96 * told.value * np.std(logs[:16], ddof=1) / 4, rel=1e-3)
    assert told.value == pytest.approx(np.exp(logs[:16]).mean() / np.exp(np.median(logs)), rel=2e-3)
    logs[:16] = pulled[:16] = 0.0
    assert map_values(replace(one))["low_ratio"].low is None


def test_what_gains_nothing_by_slopes_of_its_own_is_not_gone_after(monkeypatch):
    """Squares that every point raises, whatever its slopes promise: two steps in vain are enough."""
    asked = []
    rng = np.random.default_rng(3)
    coordinate = Coordinate("any", "a", "", -20.0, 20.0, 0.0)
    cell = ("one", "cells")

    closed_form(monkeypatch, lambda a: 5 + a + rng.standard_normal(30) * (1 + 3 * len(asked)), asked)
    evaluation = Evaluation({}, None, {}, {}, {}, {}, {cell: np.zeros(30)}, {cell: rng.standard_normal((64, 30))}, {})
    gauss_newton(None, evaluation, [coordinate], {coordinate.key: 0.0}, lambda v: v, Effort(rounds=8))
    assert 1 <= sum(n > 1 for n in asked) <= 4


def test_what_cannot_be_fitted_is_told_with_what_can(made):
    sensor, *_ = made
    known = candidates(sensor.resolved()), {e.name for e in sensor.effects}
    with pytest.raises(
        InputError, match=r"dead_time\.durations cannot be fitted here; .*Did you mean dead_time\.duration\?"
    ):
        named_candidate(*known, "set", "dead_time", "durations")
    with pytest.raises(InputError, match=r"crosstalks cannot be fitted here; .*Did you mean crosstalk\?"):
        named_candidate(*known, "add", "crosstalks", None)
    with pytest.raises(InputError, match=r"detection\.pdp cannot be fitted here: .* the same as another light level"):
        named_candidate(*known, "set", "detection", "pdp")
    with pytest.raises(
        InputError, match=r"--add dead_time: the sensor lists it already; .*--free dead_time\.PARAMETER"
    ):
        named_candidate(*known, "add", "dead_time", None)
    with pytest.raises(InputError, match=r"--free crosstalk\.probability: .* --add crosstalk adds it"):
        named_candidate(*known, "set", "crosstalk", "probability")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "hidden", "stated", "exposure"),
    [
        ("dark_counts.rate", 0.2, 5.0, 500.0),
        ("dark_counts.rate", 1e6, 1e3, 2e-3),
        ("dark_counts.rate", 0.0, 1e3, 1e-4),  # no detection: the data do not say that there is any
        ("dead_time.duration", 5e-6, 0.5e-6, 1.0),
    ],
)
def test_the_range_of_a_search_does_not_bound_a_named_fit(
    name: str, hidden: float, stated: float, exposure: float
) -> None:
    """A rate is looked for from 1 Hz to 100 kHz, a dead time up to 1 us. Five standard errors, false alarms 6e-7."""

    def sensor(value: float) -> sp.Sensor:
        listed = {"dark_counts.rate": 1e4, "dead_time.duration": 50e-9, name: value}
        effects = [
            sp.effects.Detection(pdp=0.3),
            sp.effects.DarkCounts(rate=listed["dark_counts.rate"]),
            sp.effects.DeadTime(duration=listed["dead_time.duration"]),
            sp.effects.Tdc(resolution=1e-10),
        ]
        return sp.Sensor(sp.Layout(4, 4, 25e-12, 1.0), effects, rules="device")

    data = sp.simulate(sensor(hidden), [sp.Capture("dark", "tr", dark=True, exposure=exposure)], seed=1)
    ((found,),) = (step.values.values() for step in sp.fit(sensor(stated), data, free=[name], jobs=1).steps)
    assert found.low is not None and found.high is not None
    if hidden:
        assert abs(found.value - hidden) < 5 / 3.92 * (found.high - found.low) and found.low < found.value < found.high
    else:
        assert found.low == 0 and found.value < 1 and found.high > 1e3
