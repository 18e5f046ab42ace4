"""The next sensor file, its maps and the files of its folder: none replaces a file of somebody else."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import spadmnist as sp
from spadmnist import cli, measurement, sensor_file
from spadmnist.errors import InputError
from spadmnist.inference import model_selection, results
from spadmnist.inference.candidates import Candidate
from spadmnist.inference.next_step import after_diagnosis
from spadmnist.inference.results import Step, Value
from spadmnist.library import answers
from spadmnist.pages import diagnosis as page_of

SENSOR = """sensor:  # the bench's
  name: small
  layout: {rows: 4, columns: 4, pixel_area: 100 um^2, fill_factor: 0.5}
  effects:
    detection: {pdp: 0.4}
    dark_counts: {rate: 1 kHz}  # of the data sheet
    dead_time: {duration: 50 ns}
    tdc: {resolution: 1 ns}
"""
RATE = ("dark_counts", "rate")
DURATION = ("dead_time", "duration")


def answer(values: dict[Any, Any], verdict: str = "explained", **options: Any) -> results.Diagnosis:
    lists: list[Any] = [[], [], [], [], [], [], []]
    return results.Diagnosis("small", "lab", verdict, 9.0, 1.0, 1.2, *lists, values=values, **options)


def step(kind: str, effect: str, parameter: str | None = None, **values: Value) -> Step:
    return Step(Candidate(kind, effect, parameter, ()), values, 1.0, 9.0, "mean rate +1 %")


@pytest.fixture
def diagnosed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """`sp.diagnose` of a sensor file, whose search is replaced by an answer; what is done meanwhile."""
    monkeypatch.setattr(measurement, "open", lambda path: SimpleNamespace(file=None, captures=()))
    (tmp_path / "sensor.yaml").write_text(SENSOR)

    def diagnose(found: results.Diagnosis, meanwhile: Callable[[], None] = lambda: None, **options: Any) -> Any:
        def search(*_: Any) -> results.Diagnosis:
            meanwhile()
            return found

        monkeypatch.setattr(model_selection, "diagnose", search)
        return sp.diagnose(options.pop("sensor", tmp_path / "sensor.yaml"), "lab", **options)

    return diagnose


def asked(monkeypatch: pytest.MonkeyPatch, folder: Path, found: results.Diagnosis, *options: str) -> Any:
    """`spadmnist diagnose` where this is found."""
    monkeypatch.setattr(model_selection, "diagnose", lambda *_: found)
    (folder / "lab").mkdir(exist_ok=True)
    given = ["diagnose", str(folder / "sensor.yaml"), str(folder / "lab"), *options]
    return CliRunner().invoke(cli.cli, given)


def rates(file: Path) -> np.ndarray:
    return np.asarray(sp.read_sensor(file).resolved().effect("dark_counts").rate)


# --- maps -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("of_file", [True, False])
def test_a_map_never_takes_the_place_of_another_sensors(
    of_file: bool, tmp_path: Path, diagnosed: Callable[..., Any]
) -> None:
    """The first sensor file was renamed; the second has the name that it had."""
    given = {} if of_file else {"sensor": sp.read_sensor(tmp_path / "sensor.yaml")}
    first, second = np.linspace(1.0, 2.0, 16), np.linspace(5.0, 7.0, 16)
    diagnosed(answer({RATE: first}), **given).save(tmp_path / "next")
    renamed = (tmp_path / "next" / "sensor.yaml").rename(tmp_path / "next" / "chip_a.yaml")
    diagnosed(answer({RATE: second}), **given).save(tmp_path / "next")
    assert np.array_equal(rates(renamed), first)
    assert np.array_equal(rates(tmp_path / "next" / "sensor.yaml"), second)


def test_maps_of_earlier_values_of_one_answer_are_removed(tmp_path: Path, diagnosed: Callable[..., Any]) -> None:
    own = tmp_path / "next" / "sensor.dark_counts.rate.0123abcd.npy"
    own.parent.mkdir()
    np.save(own, np.ones(16))
    found = diagnosed(answer({RATE: np.linspace(1.0, 2.0, 16)}))
    for top in (2.0, 3.0, 4.0):
        found.found.values = {RATE: np.linspace(1.0, top, 16)}
        found.save(tmp_path / "next")
        assert len(list(own.parent.glob("*.npy"))) == 2 and own.exists()
        assert np.array_equal(rates(tmp_path / "next" / "sensor.yaml"), found.found.values[RATE])
    found.save(tmp_path / "other")
    found.found.values = {}
    found.save(tmp_path / "next")
    assert list(own.parent.glob("*.npy")) == [own]
    assert np.array_equal(rates(tmp_path / "other" / "sensor.yaml"), np.linspace(1.0, 4.0, 16))


def test_the_maps_of_a_file_with_a_longer_name_stay(tmp_path: Path, diagnosed: Callable[..., Any]) -> None:
    found, values = diagnosed(answer({RATE: np.linspace(1.0, 2.0, 16)})), np.linspace(3.0, 4.0, 16)
    found.write_sensor(tmp_path / "next.1.yaml")
    found.found.values = {RATE: values}
    found.write_sensor(tmp_path / "next.yaml")
    assert np.array_equal(rates(tmp_path / "next.1.yaml"), np.linspace(1.0, 2.0, 16))
    assert np.array_equal(rates(tmp_path / "next.yaml"), values)


def test_lists_of_odd_pixels_of_an_earlier_page_are_removed(tmp_path: Path) -> None:
    head = "row,column,value,unit,relative_to_median,kind\n"
    earlier, own = tmp_path / "odd_pixels-detection-pdp.csv", tmp_path / "odd_pixels-mine.csv"
    earlier.write_text(head + "1,2,3,Hz,4,hot\n")
    own.write_text("mine\n")
    page_of(answer({}), tmp_path)
    assert not earlier.exists() and own.read_text() == "mine\n"


# --- the model that was diagnosed -----------------------------------------------------------------------------------


def test_a_sensor_file_that_changes_meanwhile_changes_no_answer(
    tmp_path: Path, diagnosed: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "sensor.yaml"

    def edited() -> None:
        file.write_text(SENSOR.replace("pdp: 0.4", "pdp: 0.1"))

    monkeypatch.chdir(tmp_path)
    found = diagnosed(answer({DURATION: 55e-9}), edited, sensor="sensor.yaml")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    found.save(tmp_path / "next")
    made = sp.read_sensor(tmp_path / "next" / "sensor.yaml")
    assert made.effect("detection").pdp == found.model.effect("detection").pdp == 0.4
    assert made.effect("dead_time").duration == pytest.approx(55e-9)
    assert "# of the data sheet" in (tmp_path / "next" / "sensor.yaml").read_text()
    assert "pdp: 0.4" in (tmp_path / "next" / "report.html").read_text()


def test_the_comment_of_a_value_that_is_replaced_goes_with_it(tmp_path: Path, diagnosed: Callable[..., Any]) -> None:
    found = diagnosed(answer({RATE: 1200.0}))
    found.save(tmp_path / "next")
    text = (tmp_path / "next" / "sensor.yaml").read_text()
    assert "{rate: 1.2 kHz}" in text and "of the data sheet" not in text and "# the bench's" in text


def test_a_sensor_file_without_its_first_line_is_left_alone_beside_a_report(
    tmp_path: Path, diagnosed: Callable[..., Any]
) -> None:
    out = tmp_path / "next" / "sensor.yaml"
    diagnosed(answer({DURATION: 55e-9}), keep=tmp_path / "next")
    diagnosed(answer({DURATION: 56e-9}), keep=tmp_path / "next")  # it was written by the one before
    own = out.read_text().partition("\n")[2].replace("56 ns", "58 ns")
    out.write_text(own)
    with pytest.raises(InputError, match="it is left alone"):
        diagnosed(answer({DURATION: 57e-9}), keep=tmp_path / "next")
    assert out.read_text() == own and (tmp_path / "next" / "report.html").exists()


def test_each_line_has_the_interval_of_its_own_number(tmp_path: Path, diagnosed: Callable[..., Any]) -> None:
    found = answer({DURATION: 55e-9, ("dead_time", "paralyzable"): True})
    found.steps = [
        step("set", "dead_time", "duration", duration=Value(55e-9, 54e-9, 56e-9, "s")),
        step("set", "dead_time", "paralyzable", paralyzable=Value(1.0, None, None)),
    ]
    notes = results.notes(found)
    assert "54 ns to 56 ns" in notes[DURATION] and "ns" not in notes[("dead_time", "paralyzable")]


# --- what is kept until the answer is written -----------------------------------------------------------------------


@pytest.mark.parametrize("fails", [True, False])
def test_replicates_are_kept_until_the_answer_is_written(
    fails: bool, tmp_path: Path, diagnosed: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = tmp_path / "next" / ".replicates"

    def fail(*_: Any, **__: Any) -> Path:
        raise OSError(28, "No space left on device")

    if fails:
        monkeypatch.setattr(sensor_file, "write", fail)
    found = diagnosed(answer({DURATION: 55e-9}), lambda: kept.mkdir(parents=True), keep=tmp_path / "next")
    assert kept.exists() is fails and bool(found.unwritten) is fails
    monkeypatch.undo()
    found.save(tmp_path / "next")
    assert not kept.exists()


@pytest.mark.parametrize("name", ["sensor.yaml", "report.html", "index.html", ""])
def test_an_answer_as_json_takes_no_place_of_the_folder(
    name: str, tmp_path: Path, diagnosed: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    given = "-o", str(tmp_path / "next"), "--json"
    done = asked(monkeypatch, tmp_path, answer({}), *given, str(tmp_path / "next" / name))
    assert "is the place of -o, too" in str(done.exception)
    assert not (tmp_path / "next").exists()
    done = asked(monkeypatch, tmp_path, answer({}, "adequate"), *given, str(tmp_path / "next" / "answer.json"))
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "next" / "answer.json").read_text())["verdict"] == "adequate"


# --- words ----------------------------------------------------------------------------------------------------------


def test_a_fit_says_what_alone_was_compared() -> None:
    steps = [step("per_pixel", "dark_counts", "rate")]
    for verdict in ("explained", "adequate", "partly_explained"):
        found = answer({}, verdict, asked="fit", compared="the counts in the dark")
        found.steps = steps
        assert "Only the counts in the dark were compared with the model" in results.sentence(found)
        assert found.as_data()["compared"] == "the counts in the dark"
    assert "Only" not in results.sentence(answer({})) and "compared" not in answer({}).as_data()


def test_a_search_without_a_look_says_that_nothing_was_tried() -> None:
    ended = {"change": None, "effect": None, "parameter": None, "where": "step 1", "why": "the budget was spent"}
    said = results.sentence(answer({}, "adequate", finished=False, untried=[ended]))
    assert said == "not finished: no check fails; the budget ended before all was done: step 1."


def test_a_search_that_ended_before_any_step_does_not_speak_of_steps() -> None:
    said = results.sentence(answer({}, "setup", finished=False))
    assert said.startswith("not finished; so far: the set-up explains the deviations")
    found = answer({}, "explained", finished=False)
    found.steps = [step("per_pixel", "dark_counts", "rate")]
    assert results.sentence(found).startswith("not finished; the verdict is that of the steps so far: ")


def test_an_answer_that_is_not_finished_begins_so() -> None:
    ended = {"change": None, "effect": None, "parameter": None, "where": "step 1", "why": "the budget was spent"}
    for verdict in ("unexplained", "adequate"):
        found = answer({}, verdict, finished=False, untried=[ended])
        assert results.table(found).startswith("NOT FINISHED: ") and verdict.upper() not in results.table(found)
        assert results.opening(found, "Word").startswith("NOT FINISHED: ")
    begun = "NOT FINISHED; so far: SETUP: the set-up explains"
    assert results.table(answer({}, "setup", finished=False)).startswith(begun)
    assert results.table(answer({}, "setup")).startswith("SETUP: the set-up explains")
    shown = answers.Diagnosis(answer({}, "unexplained", finished=False), sp.Sensor(sp.Layout(1, 1, 1e-12, 1.0), []))
    assert "<p>NOT FINISHED: the budget ended" in shown._repr_html_()


def test_of_a_map_without_low_pixels_it_is_not_said_how_low_they_are() -> None:
    change = Candidate("per_pixel", "detection", "pdp", (), carrier=("detection", "relative"))
    values = {"sigma": Value(0.04, 0.037, 0.042), "low_fraction": Value(0.0, 0.0, 0.01)}
    values["low_ratio"] = Value(1.0, None, None)

    def said() -> str:
        found = answer({})
        found.steps = [Step(change, values, 1.0, 9.0, "mean of the map +1 %")]
        return " ".join(results.table(found).split())

    assert "relative spread of the bulk of the pixels: 0.04 (0.037 to 0.042)" in said()
    assert "mean of the low ones" not in said()
    values["low_fraction"] = Value(0.01, 0.0, 0.02)
    assert "mean of the low ones, relative to what they are compared with: 1" in said()


def test_the_brightest_capture_may_be_a_nonlinearity_beside_steps_as_well() -> None:
    found = answer({}, "explained", faulty="bright")
    found.steps = [step("per_pixel", "dark_counts", "rate")]
    assert results.sentence(found).endswith("the model, and the set-up of bright those of the totals.")
    found.bent = True
    said = f"the model, and the set-up of bright, or {results.NONLINEARITY}, those of the totals."
    assert results.sentence(found).endswith(said)


def test_the_set_up_or_the_sensor_are_both_named() -> None:
    found = answer({}, "confused", or_setup=True)
    factor = {"value": 0.95, "low": 0.94, "high": 0.96}
    found.setup = [{"capture": "bright", "quantity": "light", "factor": factor, "confused": True}]
    found.steps = [step("add", "short_gate")]
    said = results.sentence(found)
    assert said == "the light of bright, or short_gate: each explains the totals, and the sensor file has neither."
    found.steps = [step("add", "crosstalk"), *found.steps]
    assert results.sentence(found).endswith("the sensor file has neither; besides, crosstalk was found.")


def test_a_tie_with_the_set_up_says_what_to_measure_and_how_to_take_the_sensor() -> None:
    """The new file does not have the tie: to compare it would say nothing."""
    found = answer({}, "confused", or_setup=True)
    factor = {"value": 0.95, "low": 0.94, "high": 0.96}
    found.setup = [
        {"capture": id, "quantity": name, "factor": factor, "confused": True}
        for id in ("dim", "bright")
        for name in ("light", "exposure")
    ]
    found.steps = [step("add", "short_gate")]
    said = after_diagnosis(found, "s.yaml", "lab")
    assert said.startswith("measure the light or exposure of dim and bright again and correct measurement.yaml; if it ")
    assert "spadmnist fit s.yaml lab --add short_gate -o NEXT" in said
    found.steps = [step("add", "crosstalk"), step("set", "dead_time", "duration")]
    assert "spadmnist fit next/sensor.yaml lab --free dead_time.duration" in after_diagnosis(found, "s.yaml", "lab")
    words = {"capture": "a flat field ten times as bright as dim", "separates": ["light", "short_gate"]}
    found.advice = [words | {"significance_now": 0.1, "significance_then": 9.0}]
    said = after_diagnosis(found, "s.yaml", "lab")
    assert said == "take a flat field ten times as bright as dim, add it to the measurement, and diagnose again."
    found.verdict, found.or_setup, found.steps = "setup", False, []
    assert after_diagnosis(found).startswith("measure the light or exposure of dim and bright again, correct")


def test_a_search_that_ended_at_its_largest_number_of_steps_says_so(
    tmp_path: Path, diagnosed: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = answer({DURATION: 55e-9}, "partly_explained", stopped=True)
    found.steps = [step("set", "dead_time", "duration")]
    done = asked(monkeypatch, tmp_path, found, "-o", str(tmp_path / "next"))
    assert "The search ended at its largest number of steps." in " ".join(done.output.split())
    (last,) = (line for line in done.output.splitlines() if line.startswith("Next: "))
    assert f"spadmnist diagnose {tmp_path / 'next' / 'sensor.yaml'} " in last and "effects --new" not in last


@pytest.mark.parametrize(
    ("dark", "captures", "said"),
    [
        ([], ["flat"], ""),
        (["dark"], ["flat"], "; it is in the lit captures alone"),
        (["dark"], ["flat", "dark"], "; it is in the dark captures, too"),
        (["dark"], ["dark"], "; it is in the dark captures"),
    ],
)
def test_what_remains_is_placed_in_captures_that_there_are(dark: list[str], captures: list[str], said: str) -> None:
    entries = [{"statistic": "spacing", "capture": id} for id in captures]
    assert results.mechanism(entries, dark).partition("; ")[2] == said.removeprefix("; ")


def test_limits_are_upper_or_lower(tmp_path: Path, diagnosed: Callable[..., Any]) -> None:
    found = answer({}, "adequate")
    entry = {"effect": "flicker", "parameter": "amplitude", "upper_limit_95": 0.01}
    found.excluded = [
        entry,
        {"effect": "short_gate", "parameter": "fraction", "upper_limit_95": 0.97, "at_least": True},
    ]
    shown = diagnosed(found)
    assert shown.upper_limits == {"flicker.amplitude": 0.01} and shown.lower_limits == {"short_gate.fraction": 0.97}


# --- what is refused before any work --------------------------------------------------------------------------------

FLAT = sp.Capture("flat", "str", wavelength=500e-9, frames=4, frame_time=10e-6, irradiance=0.01, tick=1e-9)


@pytest.mark.parametrize("scale", [1e9, 1e10])
def test_first_stamps_in_another_unit_are_refused(scale: float, tmp_path: Path, diagnosed: Callable[..., Any]) -> None:
    layout, times = (
        sp.read_sensor(tmp_path / "sensor.yaml").layout,
        np.round(np.linspace(1e3, 9e3, 64)).reshape(4, 4, 4) * 1e-9,
    )
    times[0, 0, :3] = 10e-6, np.nan, np.inf  # no detection
    taken = sp.Measurement.from_arrays(layout, {FLAT: times})
    assert np.sum(np.asarray(taken["flat"].frames) == 10_000) == 3
    with pytest.raises(InputError, match=r"a frame takes 1e-05 s; give seconds \(float\) or ticks \(integers\)"):
        sp.Measurement.from_arrays(layout, {FLAT: times * scale})
    with pytest.raises(InputError, match="-inf"):
        sp.Measurement.from_arrays(layout, {FLAT: np.where(times > 8e-6, -np.inf, times)})


@pytest.mark.parametrize(
    "given",
    [
        {"free": ["dark_counts.rate"], "per_pixel": ["dark_counts.rate"]},
        {"free": ["dead_time.duration", "dead_time.duration"]},
        {"add": ["crosstalk", "crosstalk"]},
    ],
)
def test_one_parameter_is_fitted_once(given: dict[str, list[str]], tmp_path: Path) -> None:
    (tmp_path / "sensor.yaml").write_text(SENSOR)
    model = sp.read_sensor(tmp_path / "sensor.yaml")
    lab = sp.simulate(model, [FLAT, sp.Capture("dark", "str", frames=4, frame_time=10e-6, dark=True, tick=1e-9)], 1)
    with pytest.raises(InputError, match=r"would be fitted twice.*; name it once"):
        sp.fit(model, lab, **given)


@pytest.mark.parametrize(
    ("verb", "options", "named"),
    [
        ("compare", ["--json"], "--json"),
        ("diagnose", ["--json"], "--json"),
        ("fit", ["--free", "dark_counts.rate", "-o", "next.yaml", "--json"], "--json"),
        ("compare", ["-o"], "-o"),
        ("diagnose", ["-o"], "-o"),
        ("fit", ["--free", "dark_counts.rate", "-o"], "-o"),
    ],
)
def test_a_place_where_nothing_can_be_written_is_refused_before_the_work(
    verb: str, options: list[str], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("a file, and no folder")
    # neither sensor nor measurement is there: whoever began with them would speak of them
    found = CliRunner().invoke(cli.cli, [verb, "sensor.yaml", "lab", *options, "file/answer"])
    said = f"{named} file/answer: cannot be written, for {tmp_path / 'file'} is a file; choose another place"
    assert str(found.exception) == said and not found.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]
