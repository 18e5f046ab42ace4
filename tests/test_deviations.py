"""Failing checks in groups: each deviation once, named by its most specific check."""

from __future__ import annotations

import numpy as np
import pytest

import spadmnist as sp
from spadmnist.effects import Effect
from spadmnist.inference import comparison
from spadmnist.inference.deviations import Deviation, deviations, excess
from spadmnist.statistics import Statistic, Summary

SENSOR = """sensor:
  name: small
  rules: device
  layout: {rows: 4, columns: 4, pixel_area: 100 um^2, fill_factor: 1.0}
  effects:
    detection: {pdp: 0.42}
    dark_counts: {rate: 100 Hz}
    dead_time: {duration: 50 ns}
    tdc: {resolution: 100 ps}
"""


def one(statistic: str, excess: float, capture: str = "flat", where: str = "here", **more: float) -> Deviation:
    residuals = np.zeros(3)
    return Deviation(statistic, capture, excess, int(more.get("worst", 5)), where, more.get("size", 0.01), residuals)


def names(found: list[Deviation], passing: set[tuple[str | None, str]] | None = None) -> list[list[str]]:
    return [[found[i].statistic for i in members] for members in deviations(found, passing or set())]


# --- the rule -------------------------------------------------------------------------------------------------------


def test_a_sum_shows_what_its_cells_show_and_the_cells_name_it() -> None:
    assert names([one("multiplicity", 90.0), one("neighbours", 100.0)]) == [["neighbours", "multiplicity"]]
    assert names([one("trend", 90.0), one("spectrum", 80.0)]) == [["spectrum", "trend"]]


def test_a_sum_with_much_more_than_its_cells_stands_for_itself() -> None:
    assert names([one("multiplicity", 200.0), one("neighbours", 100.0)]) == [["multiplicity"], ["neighbours"]]
    # beyond 20 sigma the laws have no common measure
    assert names([one("multiplicity", 9000.0), one("neighbours", 500.0)]) == [["neighbours", "multiplicity"]]


def test_what_passes_between_two_checks_is_no_bridge() -> None:
    found = [one("neighbours", 100.0), one("spectrum", 300.0)]
    assert names(found) == [["spectrum", "neighbours"]]  # pairs of distant pixels were not measured
    assert names(found, {("flat", "far_pairs")}) == [["spectrum"], ["neighbours"]]


def test_the_rows_name_what_lies_along_them_and_the_pixels_everything_else() -> None:
    assert names([one("rows", 90.0), one("pixel_map", 100.0)]) == [["rows", "pixel_map"]]
    assert names([one("rows", 4000.0), one("pixel_map", 9000.0)]) == [["pixel_map", "rows"]]


def test_one_period_in_a_capture_is_a_drift() -> None:
    assert names([one("trend", 90.0), one("spectrum", 85.0, worst=0)]) == [["trend", "spectrum"]]


def test_a_statistic_in_several_captures_is_one_deviation_where_the_place_is_the_same() -> None:
    found = [one("spectrum", 90.0, "a", "100 Hz"), one("spectrum", 50.0, "b", "100 Hz")]
    assert names(found) == [["spectrum", "spectrum"]]
    found[1] = one("spectrum", 50.0, "b", "3 kHz")
    assert names(found) == [["spectrum"], ["spectrum"]]
    by_axis = [Deviation("spectrum", id, 50.0, 5, id, 0.1, np.zeros(0), at) for id, at in (("a", 99.0), ("b", 102.0))]
    assert names(by_axis) == [["spectrum", "spectrum"]]
    alike = [
        Deviation("pixel_map", id, 50.0, 0, id, 0.1, np.array([3.0, 1.0, x])) for id, x in (("a", 2.0), ("b", 1.0))
    ]
    assert names(alike) == [["pixel_map", "pixel_map"]]
    alike[1] = Deviation("pixel_map", "b", 50.0, 0, "b", 0.1, np.array([-3.0, 1.0, 2.0]))
    assert names(alike) == [["pixel_map"], ["pixel_map"]]


def test_ties_go_to_the_larger_size_and_totals_name_nothing() -> None:
    found = [one("rows", 100.0, size=0.01), one("columns", 100.0, size=0.3), one("pixel_map", 120.0)]
    assert names(found)[0][0] == "columns"
    assert names([one("rate", 500.0), one("of_a_plug_in", 500.0), one("neighbours", 450.0)])[0] == ["neighbours"]


def test_the_excess_is_that_of_all_cells_or_of_the_largest() -> None:
    z = np.array([3.0, 0.0, 0.0, 0.0])
    summary = Summary(z, "normal", str, lambda *_: ("", 0.0))
    assert excess(summary, np.zeros(4), z) == 9.0
    assert excess(summary, np.zeros(4), np.full(4, 3.0)) == 32.0
    line = Summary(np.array([1.0, 50.0]), "exponential", str, lambda *_: ("", 0.0))
    assert excess(line, np.ones(2), np.zeros(2)) == pytest.approx(2 * (49 - np.log(50)))
    assert excess(summary, np.zeros(0), np.zeros(0)) == 0.0


def test_what_a_statistic_pools_is_a_statistic_and_never_itself() -> None:
    for name in Statistic.registry:
        kind = Statistic.registry.find(name)
        assert set(kind.pools) <= set(Statistic.registry), name
        assert 0 <= kind.specific <= 3, name
        seen, more = set(), set(kind.pools)
        while more:
            seen |= more
            more = {p for q in more for p in Statistic.registry.find(q).pools} - seen
        assert name not in seen, name


# --- of simulated data ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("effect", "values", "statistics", "where"),
    [
        ("crosstalk", {"probability": 0.02}, {"neighbours"}, "side neighbours, 0 to 1 ns"),
        ("flicker", {"amplitude": 0.15, "frequency": 500.0}, {"spectrum"}, "500 Hz"),
        (
            "afterpulsing",
            {"probability": 0.04, "lifetime": 25e-9},
            {"edge_intervals", "fine_intervals"},
            "intervals of",
        ),
        ("dead_time", {"duration": 100e-9}, {"edge_intervals", "fine_intervals", "intervals"}, "intervals of"),
    ],
)
def test_a_simulated_effect_is_named_by_its_physics(
    tmp_path_factory: pytest.TempPathFactory, effect: str, values: dict[str, float], statistics: set[str], where: str
) -> None:
    folder = tmp_path_factory.mktemp("lab")
    (folder / "sensor.yaml").write_text(SENSOR)
    model = sp.read_sensor(folder / "sensor.yaml")
    if model.effect(effect) is None:
        truth = model.with_effect(Effect.registry.find(effect)(**values))
    else:
        truth = model.with_values({f"{effect}.{name}": value for name, value in values.items()})
    plan = [sp.Capture("flat", "tr", wavelength=500e-9, irradiance=1e-3, exposure=20e-3, relative_uncertainty=0.02)]
    lab = sp.simulate(truth, plan, seed=3)
    found = comparison.compare(model, lab, 0, jobs=1, replicates=32)
    groups = [group for group in found.deviations if group[0].statistic not in ("rate", "light")]
    first = groups[0][0]
    assert first.statistic in statistics and where in first.where
    assert found.worst is found.deviations[0][0]
    # the other checks of that trace are behind it
    assert len(groups) <= 2 and len(groups[0]) >= len(found.failing) - 3
    text = comparison.table(found)
    assert " ".join(text.split()).startswith(f"The model fails {len(found.failing)} of")
    assert comparison.found_in(found.worst) in " ".join(text.split())
