"""The library: what the verbs do, in Python."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spadmnist as sp
from spadmnist import config, sensor_file, twin
from spadmnist import measurement as measurements
from spadmnist.errors import InputError, SpadError
from spadmnist.inference import results
from spadmnist.inference.candidates import Candidate
from spadmnist.inference.checks import Check
from spadmnist.inference.comparison import headline
from spadmnist.inference.results import Value
from spadmnist.library import answers
from spadmnist.plugins import ByWavelength, Distribution

LIGHT = {"wavelength": 500e-9, "irradiance": 1e-4}  # W/m^2
FLAT = sp.Capture("flat", "qis", **LIGHT, frames=40, frame_time=10e-6)


def sensor(rows: int = 3, columns: int = 5, **more: Any) -> Any:
    effects = [
        sp.effects.Detection(pdp=0.4),
        sp.effects.DarkCounts(rate=2000.0),
        sp.effects.DeadTime(duration=50e-9),
        sp.effects.Tdc(resolution=1e-9),
    ]
    return sp.Sensor(sp.Layout(rows, columns, 25e-12, 0.5), effects, rules="device", **more)


# ---- captures ---------------------------------------------------------------------------------------------

DARK = {"dark": True}
CLOCK = {"frames": 10, "frame_time": 1e-5}


@pytest.mark.parametrize(
    ("modality", "given", "said"),
    [
        ("qiss", {**DARK, **CLOCK}, "'qiss' is not a modality; those are tr, str, qis, counts. Did you mean qis?"),
        ("qis", CLOCK, "says nothing of its light; give dark=True"),
        ("qis", {**CLOCK, **DARK, "lux": 3.0}, "has both dark and lux; keep one"),
        ("qis", {**CLOCK, "irradiance": 1.0}, "give wavelength=500e-9"),
        ("qis", {**CLOCK, **LIGHT, "lux": 1.0}, "has both irradiance and lux; keep one"),
        ("qis", {**CLOCK, "wavelength": 500.0}, r"wavelength is 500.0 m; give it in m, 500e-9 for 500 nm"),
        ("qis", {**CLOCK, **LIGHT, "irradiance": -1.0}, "irradiance is -1.0; it is more than 0; a capture"),
        ("qis", {**CLOCK, **LIGHT, "irradiance": 0.0}, "a capture without light has dark=True"),
        ("qis", {**CLOCK, **LIGHT, "own_uncertainty": None}, "own_uncertainty is None; it is a share from 0"),
        ("qis", {**CLOCK, **LIGHT, "relative_uncertainty": 1.5}, "a share from 0 to less than 1, 0.05 for 5 %"),
        ("qis", {**DARK, "frames": 10}, "QIS needs frames and frame_time"),
        ("qis", {**DARK, **CLOCK, "frames": 2.5}, "frames is 2.5; it is a whole number"),
        ("qis", {**DARK, **CLOCK, "frames": float("nan")}, "frames is nan; it is a whole number"),
        ("qis", {**DARK, **CLOCK, "frames": math.inf}, "frames is inf; it is a whole number"),
        ("counts", {**DARK, **CLOCK, "bits": math.nan}, "bits is nan; of a count it is a whole number"),
        ("qis", {**DARK, **CLOCK, "frame_period": 1e-6}, "does not fit into the frame_period"),
        ("qis", {**DARK, **CLOCK, "exposure": 1.0}, "is not frames x frame_period"),
        ("qis", {**DARK, **CLOCK, "bits": 8}, "bits means nothing for QIS; leave it out"),
        ("tr", DARK, "a TR capture needs its exposure"),
        ("tr", {**DARK, "exposure": 1.0, "frames": 3}, "frames means nothing for TR; leave it out"),
        ("tr", {**DARK, "exposure": -1.0}, "exposure is -1.0; it is more than 0, in s"),
        ("tr", {**DARK, "exposure": 1e300}, r"exposure is 1e\+300 s; a time is from 1e-18 s to 1e\+18 s"),
        ("tr", {**DARK, "exposure": 1e300, "tick": 1e-300}, r"exposure is 1e\+300 s; a time is"),
        ("tr", {**DARK, "exposure": 1.0, "tick": 1e-300}, "tick is 1e-300 s; a time is from 1e-18 s"),
        ("qis", {**DARK, "frames": 1, "frame_time": 1e-19}, "frame_time is 1e-19 s; a time is from 1e-18 s"),
        ("qis", {**DARK, "frames": 10, "frame_time": 1e18}, "frames x frame_period is 1e"),
        ("counts", {**DARK, **CLOCK}, "bits is None; of a count it is a whole number from 1 to 16"),
        ("counts", {**DARK, **CLOCK, "bits": 2}, "10 binary frames do not fill count frames of 3 each; take 9"),
        ("counts", {**DARK, **CLOCK, "bits": 2, "counting": "photons"}, "it is 'frames' or 'counter'"),
    ],
)
def test_what_is_no_capture_is_one_sentence(modality: str, given: dict[str, Any], said: str) -> None:
    with pytest.raises(SpadError, match=said.replace("(", r"\(")) as error:
        sp.Capture("a", modality, **given)
    assert "\n" not in str(error.value) and str(error.value).startswith("Capture 'a':")


def test_a_capture_is_the_one_that_a_file_describes(tmp_path: Path) -> None:
    lab = sp.simulate(
        sensor(),
        [
            sp.Capture("dark", "tr", dark=True, exposure=1e-3),
            FLAT,
            sp.Capture("lux", "counts", lux=5.0, frames=30, frame_time=1e-5, frame_period=2e-5, bits=2),
            sp.Capture(
                "first", "str", **LIGHT, frames=8, frame_time=1e-5, relative_uncertainty=0.02, own_uncertainty=0.01
            ),
        ],
    )
    again = sp.open_measurement(lab.save(tmp_path / "lab"))
    assert [c.light for c in again.captures] == [c.light for c in lab.captures]
    assert [c.conditions for c in again.captures] == [c.conditions for c in lab.captures]
    assert again.captures[2].light.wavelength == 555e-9
    for id in lab:
        mine, its = lab[id], again[id]
        assert np.array_equal(mine.counts, its.counts)
        if mine.capture.modality == "tr":
            assert np.array_equal(mine.events.ticks, its.events.ticks)
        else:
            assert np.array_equal(mine.frames, its.frames) and mine.frames.shape[1:] == (3, 5)
    assert set(np.unique(lab["flat"].frames)) <= {0, 1}
    assert "flat: QIS, 3 x 5 pixels, 40 frames" in repr(lab["flat"])
    assert "<td>dark</td>" in lab._repr_html_() and len(lab) == 4
    with pytest.raises(InputError, match="holds events, not frames"):
        lab["dark"].frames  # noqa: B018
    with pytest.raises(InputError, match=r"has no capture 'flatt'. Did you mean flat\?"):
        lab["flatt"]


def test_simulated_in_memory_is_what_is_written(tmp_path: Path) -> None:
    plan = sp.simulate(sensor(), [FLAT]).save(tmp_path / "plan")
    written = sp.open_measurement(twin.simulate(sensor(), sp.open_measurement(plan), tmp_path / "twin", 3))
    assert np.array_equal(sp.simulate(sensor(), plan, seed=3)["flat"].frames, written["flat"].frames)
    assert not np.array_equal(sp.simulate(sensor(), plan, seed=4)["flat"].frames, written["flat"].frames)
    with pytest.raises(InputError, match="the light level of a is free"):
        sp.simulate(sensor(), [sp.Capture("a", "tr", wavelength=500e-9, exposure=1e-3)])
    with pytest.raises(InputError, match="'a' is not a capture"):
        sp.simulate(sensor(), ["a"])  # type: ignore[list-item]


# ---- arrays -----------------------------------------------------------------------------------------------

STAMPS = sp.Capture("a", "tr", **LIGHT, exposure=1e-3, tick=1e-9)
FIRST = sp.Capture("a", "str", **LIGHT, frames=4, frame_time=1e-5, tick=1e-9)
COUNTS = sp.Capture("a", "counts", **LIGHT, frames=12, frame_time=1e-5, bits=2)


def test_arrays_are_the_data() -> None:
    lab = sp.simulate(sensor(), [FLAT, sp.Capture("tr", "tr", **LIGHT, exposure=1e-3)], seed=2)
    events = lab["tr"].events
    pixels = np.repeat(np.arange(15), np.diff(events.offsets))
    order = np.random.default_rng(0).permutation(len(pixels))  # in whatever order they come
    again = sp.Measurement.from_arrays(
        sensor().layout,
        {
            FLAT: lab["flat"].frames.astype(bool),
            sp.Capture("tr", "tr", **LIGHT, exposure=1e-3, tick=1e-9): (events.times[order], pixels[order]),
            sp.Capture("raw", "tr", **LIGHT, exposure=1e-3): (events.times[order], pixels[order]),
        },
    )
    assert np.array_equal(again["flat"].frames, lab["flat"].frames)
    assert np.array_equal(again["tr"].events.ticks, events.ticks)
    assert np.array_equal(again["tr"].events.offsets, events.offsets)
    assert again["raw"].events.ticks is None and np.array_equal(again["raw"].events.times, events.times)
    seconds = np.full((4, 3, 5), np.nan)
    seconds[0, 0, 0], seconds[1, 2, 4], seconds[2, 0, 0] = 0.0, 7.123e-6, 1e-5
    first = sp.Measurement.from_arrays(sensor().layout, {FIRST: seconds})["a"]
    assert first.none == 10_000 and first.frames[1, 2, 4] == 7123 and first.frames[0, 0, 0] == 0
    assert int((first.frames < first.none).sum()) == 2
    for nothing in (([], []), (np.zeros(0), np.zeros(0))):  # of an empty list numpy makes floats
        assert len(sp.Measurement.from_arrays(sensor().layout, {STAMPS: nothing})[STAMPS.id].events) == 0
    ticks = np.where(np.isfinite(seconds), np.rint(np.nan_to_num(seconds) * 1e9), 10_000).astype(np.int32)
    assert np.array_equal(sp.Measurement.from_arrays(sensor().layout, {FIRST: ticks})["a"].frames, first.frames)


@pytest.mark.parametrize(
    ("capture", "data", "said"),
    [
        (FLAT, np.zeros((39, 3, 5), np.uint8), r"shape \(39, 3, 5\), not \(frames, rows, columns\), \(40, 3, 5\)"),
        (FLAT, np.full((40, 3, 5), 2), "values other than 0 and 1"),
        (FLAT, np.full((40, 3, 5), 0.5), "values other than 0 and 1"),
        (FLAT, np.full((40, 3, 5), np.nan), "values other than 0 and 1"),
        (COUNTS, np.full((4, 3, 5), 4), "no counts of 2 bits, 0 to 3"),
        (COUNTS, np.full((4, 3, 5), -1), "no counts of 2 bits, 0 to 3"),
        (STAMPS, np.zeros(3), r"needs \(times, pixels\)"),
        (STAMPS, (np.zeros(3), np.zeros(2, int)), r"both are \(detections,\)"),
        (STAMPS, (np.zeros(2), np.array([0, 15])), "there are 0 to 14"),
        (STAMPS, (np.zeros(2), np.array([0.0, 1.0])), "they are whole numbers"),
        (STAMPS, (np.array([0.5]), np.array([0])), "from 500 ms to 500 ms, outside the exposure of 1 ms"),
        (STAMPS, (np.array([np.nan]), np.array([0])), "outside the exposure"),
        (STAMPS, (np.array([1.5e-9]), np.array([0])), "no whole ticks of 1e-09 s"),
        (sp.Capture("a", "tr", dark=True, exposure=1.0), (np.array([5]), np.array([0])), "give the Capture its tick"),
        (FIRST, np.full((4, 3, 5), 10_001), "outside a frame, 0 to 10000 ticks"),
        (FIRST, np.full((4, 3, 5), 1.5e-9), "no whole ticks"),
    ],
)
def test_arrays_that_are_not_what_their_capture_says(capture: Any, data: Any, said: str) -> None:
    with pytest.raises(InputError, match=said) as error:
        sp.Measurement.from_arrays(sensor().layout, {capture: data})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", [bool, np.int16, np.float32, np.float64])
def test_binary_frames_of_any_numbers(kind: Any) -> None:
    bits = np.random.default_rng(1).random((40, 3, 5)) < 0.3
    one, other = (sp.Measurement.from_arrays(sensor().layout, {FLAT: x})[FLAT.id] for x in (bits, bits.astype(kind)))
    assert np.array_equal(one.frames, bits) and np.array_equal(other.frames, bits)


def test_a_capture_without_light_says_how_a_free_level_is_written() -> None:
    with pytest.raises(InputError, match="wavelength alone where the level is not known"):
        sp.Capture("x", "tr", exposure=1.0)
    assert sp.Capture("x", "tr", exposure=1.0, wavelength=500e-9).light.level is None


def test_a_line_of_as_many_pixels_as_the_sensor_is_a_table_without_its_shape() -> None:
    line = sp.Measurement.from_arrays(sp.Layout(1, 15, 1e-12, 1.0), {STAMPS: ([], [])})
    with pytest.raises(InputError, match=r"layout has 1 x 15 pixels, .* or import its files again with --rows 3 --col"):
        line.check_layout(sensor().layout)


def test_a_measurement_of_arrays_needs_captures() -> None:
    with pytest.raises(InputError, match="is not a capture; the keys are"):
        sp.Measurement.from_arrays(sensor().layout, {"flat": np.zeros(3)})  # type: ignore[dict-item]
    with pytest.raises(InputError, match="needs a capture"):
        sp.Measurement.from_arrays(sensor().layout, {})


# ---- sensors ----------------------------------------------------------------------------------------------


def test_a_sensor_shows_itself_and_changes() -> None:
    one = sensor(name="lab\x1b[2J")
    assert "lab\\x1b[2J: 3 x 5 pixels of 25 um^2, fill factor 0.5, rules: device" in repr(one)
    assert "dark dark_counts rate 2 kHz" in " ".join(repr(one).split())
    assert "\x1b" not in repr(one) + one._repr_html_()
    more = one.with_effect(sp.effects.Crosstalk(probability=0.01)).with_values({"dark_counts.rate": 250.0})
    assert more.effect("crosstalk").probability == 0.01 and more.effect("dark_counts").rate == 250.0
    assert one.effect("crosstalk") is None and one.effect("dark_counts").rate == 2000.0
    assert more.without("crosstalk").effect("crosstalk") is None
    map_ = np.arange(1.0, 16.0)
    assert "per pixel: median 8 Hz, 1 Hz to 15 Hz" in repr(one.with_values({"dark_counts.rate": map_}))
    as_image = one.with_values({"dark_counts.rate": map_.reshape(3, 5)})
    assert np.array_equal(as_image.effect("dark_counts").rate, map_)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda s: s.with_effect(sp.effects.DarkCounts()),
            "lists dark_counts already; another value of it: with_values",
        ),
        (lambda s: s.with_effect(sp.effects.Crosstalk(probability=2.0)), "probability is between 0 and 1"),
        (lambda s: s.with_values({"dark_count.rate": 1.0}), r"lists no dark_count, .* Did you mean dark_counts\?"),
        (lambda s: s.with_values({"crosstalk.probability": 1.0}), "lists no crosstalk, .*with_effect adds one"),
        (lambda s: s.with_values({"dark_counts.rat": 1.0}), r"dark_counts has rate. Did you mean rate\?"),
        (lambda s: s.with_values({"dark_counts.rate": -1.0}), "-1 Hz is not possible; rate is at least 0 Hz"),
        (lambda s: s.with_values({"dark_counts.rate": "5 Hz"}), "it is a number in Hz"),
        (
            lambda s: s.with_values({"dark_counts.rate": np.ones(3)}),
            r"rate is an array of shape \(3,\); it needs one number",
        ),
        (lambda s: s.with_values({"dead_time.duration": np.nan}), "is not possible"),
        (lambda s: s.with_values({"dead_time.paralyzable": 1.0}), "it is True or False"),
        (lambda s: s.with_values({"tdc.rounding": "up"}), "it is nearest or floor"),
        (lambda s: s.with_values({"detection.pdp": {500e-9: 0.4}}), "ByWavelength"),
        (lambda s: s.with_values({"tdc.resolution": np.ones(15)}), "one number for all pixels"),
        (lambda s: s.with_values({("dark_counts", "rate"): 250.0}), r"key \('dark_counts', 'rate'\) is no name; write"),
        (lambda s: s.with_values([("dark_counts.rate", 250.0)]), "values are .*; they are a dictionary"),
        (lambda s: s.with_values(None), "values are None; they are a dictionary"),
        (lambda s: s.cropped(1, 2), r"rows: 1 is no slice; give slice\(100, 150\)"),
        (lambda s: s.cropped(slice(0, 2), "0:2"), "columns: '0:2' is no slice"),
    ],
)
def test_what_no_sensor_can_have_is_one_sentence(change: Any, said: str) -> None:
    with pytest.raises(InputError, match=said) as error:
        change(sensor())
    assert "\n" not in str(error.value)


def test_an_effect_that_there_is_not() -> None:
    with pytest.raises(AttributeError, match=r"Crostalk is not an effect.* Did you mean Crosstalk\?"):
        sp.effects.Crostalk  # noqa: B018
    assert {"Crosstalk", "Effect"} <= set(dir(sp.effects))


def test_a_sensor_is_saved_and_read_again(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    places = rng.uniform(0, 1e-4, (15, 2))
    layout = sp.Layout(1, 15, 25e-12, 0.5, places)
    effects = [
        sp.effects.Detection(pdp=ByWavelength((500e-9, 700e-9), (1 / 3, 0.16)), relative=rng.uniform(0.9, 1.1, 15)),
        sp.effects.DarkCounts(rate=Distribution("lognormal", (20.0, 1.5))),
        sp.effects.DeadTime(duration=rng.uniform(4e-8, 5e-8, 15), paralyzable=True),
        sp.effects.Tdc(resolution=1e-10 / 3),
    ]
    one = sp.Sensor(layout, effects, rules="device", chip_seed=7, name="a: b # c")
    for made in (one, one.resolved()):
        again = sp.read_sensor(sensor_file.save(made, tmp_path / f"{made._resolved}" / "s.yaml"))
        assert (again.rules, again.chip_seed, again.name) == ("device", 7, "a: b # c")
        assert np.allclose(again.layout.positions, places, rtol=1e-12)
        for effect in one.resolved().effects:
            for name in effect.parameters:
                assert np.all(getattr(again.effect(effect.name), name) == getattr(effect, name)), (effect.name, name)
    with pytest.raises(InputError, match="no sensor file that a fit"):
        (tmp_path / "own.yaml").write_text("mine")
        sensor_file.save(one, tmp_path / "own.yaml")
    part = sensor(4, 4).with_values({"dark_counts.rate": np.arange(1.0, 17.0)}).cropped(slice(1, 3), slice(0, 2))
    chip = config.read_sensor(sensor_file.save(part, tmp_path / "chip.yaml"))
    assert chip.layout.shape == (4, 4) and np.array_equal(chip.effect("dark_counts").rate, np.arange(1.0, 17.0))


# ---- answers ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def asked() -> tuple[Any, Any]:
    """A model and data with afterpulses that it lacks."""
    plan = [
        sp.Capture("dark", "tr", dark=True, exposure=0.1),
        sp.Capture("flat", "tr", **LIGHT, exposure=0.1, relative_uncertainty=0.02),
    ]
    model = sensor(2, 2)
    return model, sp.simulate(
        model.with_effect(sp.effects.Afterpulsing(probability=0.1, lifetime=100e-9)), plan, seed=1
    )


def test_a_comparison_shows_itself(asked: tuple[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gof = sp.compare(*asked, jobs=1)
    assert gof.verdict == "fails" and gof.misfit == gof.misfit_in_sample
    assert "The model fails" in repr(gof) and "<table>" in gof._repr_html_()
    assert gof.figure(0).axes and "<html" in gof.save(tmp_path / "report").read_text()
    with pytest.raises(InputError, match=r"figure 1000: there are .* checks with cells, counted from 0"):
        gof.figure(1000)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match="needs pandas, which is not installed: pip install pandas"):
        gof.to_frame()
    with pytest.raises(InputError, match="tolerance is 5"):
        sp.compare(*asked, tolerance=5)


def compared() -> answers.Comparison:
    """A model that fails one of two checks."""
    checks = (
        Check("rows", "dark", 1.1, 0.4, "row 2", "0.1 % of detections", 0.001),
        Check("neighbours", "flat", 70.0, 1e-9, "1 to 2 ns", "0.5 % of detections", 0.005, passes=False),
    )
    return answers.Comparison("one", "lab", "fails", 8.4321, 1.2, (), checks, 100)


def test_a_comparison_in_a_notebook_names_the_worst_check() -> None:
    gof = compared()
    said = "1 to 2 ns, in flat: 0.5 % of detections (neighbours, p = 1e-09, fails)"
    assert f"<p>one against lab: fails, misfit 8.432; worst check: {said}</p>" in gof._repr_html_()
    assert said in " ".join(repr(gof).split())


@pytest.mark.parametrize("kind", [answers.Diagnosis, answers.Fit])
def test_an_answer_in_a_notebook_tells_the_misfits_apart(kind: type[Any]) -> None:
    """What was held out is a column, what is in sample stands in the title, in the words of the terminal."""
    step = results.Step(
        Candidate("add", "crosstalk", None, ()), {"probability": Value(0.005, 0.004, 0.006)}, 11.2, 35.2, ""
    )
    lists: list[Any] = [[], [step], [], [], [], [], []]
    found = results.Diagnosis("one", "lab", "explained", 61.0, 11.2, 1.2, *lists, in_sample=compared())
    text = kind(found, sensor())._repr_html_()
    assert "<th>sigma</th><th>held-out misfit</th>" in text and "<td>35.2</td><td>11.2</td>" in text
    line = f"In sample, misfit 8.432; worst check: {headline(compared())}."
    assert f"{line}</p>" in text and "0.5 % of detections" in line
    assert line in " ".join(results.table(found).split())
    found.in_sample = None
    assert "sample" not in kind(found, sensor())._repr_html_()


@pytest.mark.slow
def test_a_fit_has_values_intervals_and_covariance(asked: tuple[Any, Any], tmp_path: Path) -> None:
    model, data = asked
    path, source = data.save(tmp_path / "lab"), sensor_file.save(model, tmp_path / "sensor.yaml")
    source.write_text(source.read_text() + "# mine\n")
    fit = sp.fit(str(source), str(path), add=["afterpulsing"], jobs=1)
    for name, true in (("probability", 0.1), ("lifetime", 100e-9)):
        low, high = fit.intervals[f"afterpulsing.{name}"]
        assert low - (high - low) < true < high + (high - low)  # 5.9 standard deviations
        assert low < fit.values[f"afterpulsing.{name}"] < high
        assert getattr(fit.model.effect("afterpulsing"), name) == fit.values[f"afterpulsing.{name}"]
    names, covariance = fit.covariance
    assert sorted(names) == ["afterpulsing.lifetime", "afterpulsing.probability"]
    ends = np.array([fit.intervals[name] for name in names])
    assert np.allclose(np.sqrt(np.diag(covariance)) * 3.92, ends[:, 1] - ends[:, 0])
    assert np.linalg.eigvalsh(covariance / np.outer(*[np.sqrt(np.diag(covariance))] * 2)).min() > 0
    assert fit.misfit["before"] > fit.misfit["after"] and fit.path[0]["model"] == "start"
    fit.save(tmp_path / "next")
    text = (tmp_path / "next" / "sensor.yaml").read_text()
    assert "# mine" in text and (tmp_path / "next" / "report.html").exists()
    again = sp.read_sensor(tmp_path / "next" / "sensor.yaml")
    assert np.isclose(again.effect("afterpulsing").probability, fit.values["afterpulsing.probability"], rtol=1e-5)
    with pytest.raises(InputError, match="it is a list of names"):
        sp.fit(model, data, free="dark_counts.rate")


@pytest.mark.slow
def test_a_diagnosis_gives_the_model_that_it_found(asked: tuple[Any, Any], tmp_path: Path) -> None:
    model, data = asked
    found = sp.diagnose(model, data, quick=True, jobs=1, max_steps=1)
    assert found.finished and found.verdict in ("explained", "confused") and found.steps
    assert found.figure(0).axes and "afterpulsing" in repr(found) + found._repr_html_()
    found.save(tmp_path / "next")
    again = sp.read_sensor(tmp_path / "next" / "sensor.yaml")
    for effect in found.model.effects:
        for name in effect.parameters:
            mine, its = getattr(effect, name), getattr(again.effect(effect.name), name)
            assert its == mine if isinstance(mine, str) else np.allclose(its, mine, rtol=1e-5, atol=0)
    with pytest.raises(InputError, match="max_steps is 0"):
        sp.diagnose(model, data, max_steps=0)


LAB = {FLAT: np.zeros((40, 3, 5), np.uint8)}
# of one capture nothing but the mean is known, and not how bright its light was
UNKNOWN = sp.Capture("mean", "qis", wavelength=500e-9, frames=1000, frame_time=10e-6)
MEAN = measurements.in_memory("mean", sensor().layout, [replace(UNKNOWN, mean=470.0)])


def found_nothing(model: Any) -> answers.Diagnosis:
    lists: list[Any] = [[] for _ in range(7)]
    return answers.Diagnosis(results.Diagnosis("one", "lab", "unexplained", 1.5, 1.5, 1.2, *lists), model)


def test_none_and_numbers_of_numpy_are_taken() -> None:
    lab = sp.Measurement.from_arrays(sensor().layout, LAB)
    taken = {"seed": np.int64(3), "jobs": np.int32(1), "plugins": None}
    gof = sp.compare(sensor(), lab, tolerance=np.float32(0.125), **taken)
    assert gof.tolerance == 0.125 and type(gof.tolerance) is float and type(gof.origin.seed) is int
    assert gof.figure(np.int64(0)).axes
    for more in ({"max_steps": np.int64(3), "quick": np.True_}, {"within": np.float32(20)}):
        with pytest.raises(InputError, match="nothing here can be compared"):  # it is looked at after them
            sp.diagnose(sensor(), MEAN, **taken, **more)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda s, lab: sp.Measurement.from_arrays(s, LAB), "layout is of type Sensor; .*sensor.layout"),
        (lambda s, lab: sp.Measurement.from_arrays(s.layout, LAB[FLAT]), "arrays is of type ndarray; it is a dict"),
        (
            lambda s, lab: sp.Measurement.from_arrays(s.layout, {FLAT: [[1], [1, 0]]}),
            "'flat': has lists of several len",
        ),
        (lambda s, lab: sp.compare(lab, s), "sensor is of type Measurement; it is a spadmnist.Sensor or the path"),
        (lambda s, lab: sp.compare(s, LAB[FLAT]), "measurement is of type ndarray; .*Measurement.from_arrays"),
        (lambda s, lab: sp.compare(s, lab, -1), "seed is -1; it is a whole number from 0"),
        (lambda s, lab: sp.simulate(s, [FLAT], seed=1.5), "seed is 1.5; it is a whole number"),
        (lambda s, lab: sp.compare(s, lab, jobs=0), "jobs is 0; it is a whole number of at least 1"),
        (lambda s, lab: sp.compare(s, lab, tolerance="0.5 %"), "tolerance is '0.5 %'; it is a share"),
        (lambda s, lab: sp.compare(s, lab, plugins="own.py"), r"plugins is 'own.py'; .*plugins=\['own.py'\]"),
        (lambda s, lab: sp.compare(s, lab, plugins=3), r"plugins is 3; it is a list of files: plugins=\['my_eff"),
        (lambda s, lab: sp.simulate(s, [FLAT], plugins=[None]), "plugins holds None; it is a list of files"),
        (lambda s, lab: sp.open("lab.yaml", plugin="own.py"), r"plugin is 'own.py'; .*plugin=\['own.py'\]"),
        (lambda s, lab: sp.open(None), "None is of type NoneType; give the path of a dataset or a config"),
        (lambda s, lab: sp.simulate(s, [FLAT], folder=3), "3 is of type int; give the path of the folder to wr"),
        (lambda s, lab: lab.save(None), "None is of type NoneType; give the path of the folder to write to"),
        (lambda s, lab: compared().save(None), "None is of type NoneType; give the path of the folder of the rep"),
        (lambda s, lab: found_nothing(s).save(None), "give the path of the folder of the report"),
        (lambda s, lab: found_nothing(s).write_report(3), "give the path of the folder of the report"),
        (lambda s, lab: found_nothing(s).write_sensor(None), "give the path of the sensor file to write"),
        (lambda s, lab: found_nothing(s).write_answer(None), "give the path of the file to write"),
        (lambda s, lab: sp.compare(s, MEAN, tolerance=True), "tolerance is True; it is a share"),
        (lambda s, lab: sp.diagnose(s, MEAN, keep=3), "3 is of type int; give the path of the folder to keep"),
        (lambda s, lab: sp.diagnose(s, MEAN, on_step=3), "on_step is 3; it is a function"),
        (lambda s, lab: sp.diagnose(s, MEAN, quick="no"), "quick is 'no'; it is True or False"),
        (lambda s, lab: sp.diagnose(s, MEAN, within=True), "within: True is no time"),
        (lambda s, lab: sp.diagnose(s, MEAN, within=np.True_), "within: .*True.* is no time"),
        (lambda s, lab: sp.diagnose(s, MEAN, max_steps=np.arange(2)), "max_steps is .*; it is a whole number"),
        (lambda s, lab: sp.compare(s, lab, progress=3), "progress is 3; it is a function"),
        (lambda s, lab: sp.compare(s, lab, crop=(0, 1)), r"crop is \(0, 1\); it is \"100:150,200:250\""),
        (lambda s, lab: sp.diagnose(s, lab, crop="0:1,0:2"), "layout has 3 x 5 pixels, but the sensor 1 x 2"),
        (lambda s, lab: sp.fit(s, lab, add=[sp.effects.Crosstalk]), "add holds <class .*; it is a list of names"),
        (lambda s, lab: sp.fit(s, lab, free=None), "free holds None; it is a list of names"),
        (lambda s, lab: s.with_effect("crosstalk"), "'crosstalk' is not an effect; give one with its values"),
        (lambda s, lab: sp.Sensor(s.layout, [sp.effects.Crosstalk]), "Crosstalk'> is not an effect; give one with"),
        (lambda s, lab: sp.simulate(s, 7), "plan: 7 is not a capture"),
        (lambda s, lab: sp.simulate(s, [FLAT, FLAT]), "plan: flat is there twice"),
        (lambda s, lab: sp.diagnose(s, MEAN), "nothing here can be compared: of no capture are light"),
        (lambda s, lab: sp.compare(s, MEAN), "nothing here can be compared: of no capture are light"),
    ],
)
def test_what_the_functions_cannot_take_is_one_sentence(call: Any, said: str) -> None:
    with pytest.raises(InputError, match=said) as error:
        call(sensor(), sp.Measurement.from_arrays(sensor().layout, LAB))
    assert "\n" not in str(error.value)


def test_a_simulation_to_a_folder_is_the_one_in_memory_and_its_progress_is_told(tmp_path: Path) -> None:
    said: list[str] = []
    part = (slice(0, 1), slice(0, 2))
    made = sp.simulate(sensor(), FLAT, 3, folder=tmp_path / "twin", crop="0:1,0:2", progress=said.append)
    assert made.folder == tmp_path / "twin" and made.layout.shape == (1, 2)
    assert np.array_equal(made["flat"].frames, sp.simulate(sensor(), [FLAT], 3, crop=part)["flat"].frames)
    assert said[-1] == "flat: 100 %" and len(set(said)) == len(said)


# ---- a diagnosis that is kept -----------------------------------------------------------------------------


def found_at(monkeypatch: pytest.MonkeyPatch, values: dict[Any, Any], finished: bool = True) -> list[Any]:
    """What `model_selection.diagnose` is called with, in place of which one step and the answer are given."""
    from spadmnist.inference import model_selection, results

    lists: list[Any] = [[], [], [], [], [], [], []]
    called: list[Any] = []

    def diagnose(*given: Any) -> results.Diagnosis:
        called.extend(given)
        keep, journal = given[-2:]
        keep(results.Diagnosis("s", "lab", "partly_explained", 9.0, 5.0, 1.2, *lists, values=values, finished=False))
        if journal is not None:
            journal.folder.mkdir(parents=True)
            journal.bytes = 1
        return results.Diagnosis("s", "lab", "explained", 9.0, 1.0, 1.2, *lists, values=values, finished=finished)

    monkeypatch.setattr(model_selection, "diagnose", diagnose)
    return called


@pytest.mark.parametrize("finished", [True, False])
def test_a_folder_keeps_the_diagnosis_so_far_and_the_answer(
    finished: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from spadmnist.workers import Serial

    said: list[str] = []
    called = found_at(monkeypatch, {("dark_counts", "rate"): 1500.0}, finished)
    lab, keep, workers = sp.Measurement.from_arrays(sensor().layout, LAB), tmp_path / "next", Serial()
    stood: list[str] = []
    sp.diagnose(sensor(), lab, jobs=workers, keep=keep, on_step=lambda so_far: stood.append(so_far.verdict))
    assert stood == ["partly_explained"] and workers in called and not (keep / "report.html").exists()
    found_at(monkeypatch, {("dark_counts", "rate"): 1500.0}, finished)
    (keep / ".replicates").rmdir()  # which is there until the report is written
    found = sp.diagnose(sensor(), lab, 7, keep=keep, progress=said.append)
    assert found.file == keep / "sensor.yaml" and not found.unwritten
    assert sp.read_sensor(found.file).effect("dark_counts").rate == 1500.0
    page = (keep / "report.html").read_text()
    assert "<dt>seed</dt><dd>7</dd>" in page
    assert (keep / ".replicates").exists() is not finished
    assert any(line.startswith("Not finished: ") for line in said) is not finished
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "sensor.yaml").write_text("mine")
    with pytest.raises(InputError, match="it is left alone"):
        sp.diagnose(sensor(), lab, keep=tmp_path / "mine")


def test_an_answer_whose_sensor_cannot_be_written_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found_at(monkeypatch, {})
    lab = sp.Measurement.from_arrays(sensor().layout, LAB)

    def fails(*_: Any, **__: Any) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(sensor_file, "save", fails)
    found = sp.diagnose(sensor(), lab, keep=tmp_path / "kept")  # the search goes on, and its answer is there
    assert "No space left" in found.unwritten and found.file is None
    with pytest.raises(
        SpadError, match=r"the next sensor file was not written: .*No space left on device.*another file"
    ):
        found.save(tmp_path / "next")
    assert "No space left" in (tmp_path / "next" / "report.html").read_text()
    monkeypatch.undo()
    found.save(tmp_path / "next")
    assert found.unwritten == "" and (tmp_path / "next" / "sensor.yaml").exists()


GRID = sp.Layout(4, 8, 25e-12, 0.5)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: sp.Layout(0, 8, 25e-12, 0.5), "rows is 0; it is a whole number of pixels"),
        (lambda: sp.Layout(4, 8.0, 25e-12, 0.5), "columns is 8.0"),  # type: ignore[arg-type]
        (lambda: sp.Layout(4, 8, -1.0, 0.5), "pixel_area is -1.0; it is in m"),
        (lambda: sp.Layout(4, 8, "25 um^2", 0.5), "pixel_area is '25 um"),  # type: ignore[arg-type]
        (lambda: sp.Layout(4, 8, 25e-12, 45.0), "fill_factor is 45.0; it is a share"),
        (lambda: sp.Layout(1, 8, 25e-12, 0.5, np.zeros((5, 2))), r"positions have shape \(5, 2\)"),
        (lambda: sp.Sensor(GRID, [], rules="Device"), "rules is 'Device'; .* Did you mean device"),
        (lambda: sp.Sensor(GRID, [], chip_seed=-1), "chip_seed is -1"),
        (lambda: sp.Sensor(GRID, [], chip_seed=1.5), "chip_seed is 1.5"),  # type: ignore[arg-type]
        (lambda: sp.Sensor((4, 8), []), r"layout is \(4, 8\); it is a spadmnist.Layout"),  # type: ignore[arg-type]
        (lambda: sp.Sensor(GRID, sp.effects.DarkCounts()), "effects is .*; it is a list of effects"),  # type: ignore[arg-type]
        (lambda: sp.Sensor(GRID, [sp.effects.DarkCounts()] * 2), "lists dark_counts twice"),
        (
            lambda: sp.Sensor(GRID, [sp.effects.RowPattern(gain=np.ones(8))]).resolved(),
            r"gain is an array of shape \(8,\); it needs one number for each row: \(4,\)",
        ),
        (
            lambda: sp.Sensor(GRID, [sp.effects.TdcNonlinearity(widths=np.ones((5, 3)))]).resolved(),
            r"widths is an array of shape \(5, 3\); it needs one number for each code",
        ),
        (lambda: sp.Capture("a", "tr", exposure=1.0, wavelength=500.0, lux=1.0), "wavelength is 500.0 m"),
        (lambda: sp.Capture("a", "tr", exposure=1.0, dark="no"), "dark is 'no'; it is True or False"),  # type: ignore[arg-type]
        (
            lambda: sp.Capture("a", "qis", dark=True, frames=2, frame_time=1e-5, counting="counter"),
            "counting means nothing for QIS",
        ),
        (
            lambda: sp.Capture("a", "qis", dark=True, frames=2, frame_time=1e-5, tick=1e-9),
            "tick means nothing for QIS",
        ),
        (lambda: sp.effects.ByWavelength((500e-9, 700e-9), (0.4,)), "2 wavelengths and 1 values"),
        (lambda: sp.effects.ByWavelength((700e-9, 500e-9), (0.4, 0.2)), "do not ascend; sort its entries"),
        (
            lambda: sp.Sensor(GRID, []).with_effect(sp.effects.Detection(pdp={500e-9: 0.4})),
            r"a table over the wavelength is spadmnist.effects.ByWavelength\(",
        ),
        (
            lambda: sp.Sensor(GRID, []).with_effect(sp.effects.DarkCounts(rate={"lognormal": 1.0})),
            "a map of the pixels is an array",
        ),
        (
            lambda: sp.fit(sp.Sensor(GRID, []), "lab", free={"dark_counts.rate": 5.0}),
            "free is a dictionary; it is a list of names",
        ),
    ],
)
def test_what_no_sensor_can_be_is_said_before_anything_is_simulated(make: Any, said: str) -> None:
    with pytest.raises(SpadError, match=said):
        make()


def test_times_in_single_precision_are_taken_where_they_are_known_well_enough() -> None:
    """At 1 s a float has steps of 60 ns: a dead time would vanish."""
    times, pixels = np.array([0.9, 0.95, 0.99], np.float32), np.zeros(3, int)
    for tick in (None, 1e-9):
        capture = sp.Capture("a", "tr", dark=True, exposure=1.0, tick=tick)
        with pytest.raises(SpadError, match=r"times are float32, which says no less than 60 ns apart; give float64"):
            sp.Measurement.from_arrays(GRID, {capture: (times, pixels)})
    short = sp.Capture("a", "tr", dark=True, exposure=1e-6)
    made = sp.Measurement.from_arrays(GRID, {short: (times * np.float32(1e-6), pixels)})
    assert len(made["a"].events) == 3


@pytest.mark.parametrize("modality", ["qis", "tr", "str", "counts"])
def test_one_recording_does_not_count_as_two(modality: str) -> None:
    clock: dict[str, Any] = {"exposure": 4e-3} if modality == "tr" else {"frames": 400, "frame_time": 10e-6}
    bits = {"bits": 4, "counting": "counter"} if modality == "counts" else {}
    one, two, other = (sp.Capture(id, modality, **LIGHT, **clock, **bits) for id in ("one", "two", "other"))
    made = sp.simulate(sensor(), [one, other], seed=3)
    data, its_own = (
        (made[id].events.times, made[id].events.rows) if modality == "tr" else made[id].frames
        for id in ("one", "other")
    )
    if modality == "str":
        one, two, other = (replace(capture, tick=1e-9) for capture in (one, two, other))
    twice = sp.Measurement.from_arrays(sensor().layout, {one: data, other: its_own, two: data})
    with pytest.raises(InputError, match=r"two: has the same detections as one, one by one; .* leave one of the capt"):
        sp.compare(sensor(), twice, jobs=1)


def stamps_of(model: sp.Sensor) -> tuple[sp.Capture, np.ndarray, np.ndarray]:
    """A capture of time stamps, and its arrays."""
    capture = sp.Capture("flat", "tr", **LIGHT, exposure=5e-3)
    events = sp.simulate(model, [capture], seed=1)["flat"].events
    return capture, events.times, events.rows


@pytest.mark.parametrize("kind", [">f8", "longdouble"])
def test_times_of_any_kind_are_compared(kind: str) -> None:
    capture, times, pixels = stamps_of(sensor())
    data = sp.Measurement.from_arrays(sensor().layout, {capture: (times.astype(kind), pixels.astype(">i4"))})
    assert sp.compare(sensor(), data, jobs=1).verdict == "adequate"


@pytest.mark.parametrize("clocked", [True, False])
def test_times_without_ticks_are_compared_alike_before_and_after_they_are_saved(tmp_path: Path, clocked: bool) -> None:
    """Of a file they are in its ticks, which are not those of a converter."""
    dark = sp.Capture("dark", "tr", dark=True, exposure=5e-3)
    rng = np.random.default_rng(4)
    times, pixels = np.sort(rng.uniform(0, 5e-3, 60)), rng.integers(0, 4, 60)
    times[:30] = np.rint(times[:30] / 1e-9) * 1e-9  # as a converter of 1 ns gives them, in s
    model = sensor(2, 2) if clocked else sensor(2, 2).without("tdc")
    lab = sp.Measurement.from_arrays(model.layout, {dark: (times, pixels)})
    again = sp.open_measurement(lab.save(tmp_path / "lab"))
    held, read = (one.recording("dark", model).events for one in (lab, again))
    assert held is not None and read is not None
    assert held.tick == read.tick == (1e-9 if clocked else 1e-12) and np.array_equal(held.times, read.times)
    first, second = (sp.compare(model, one, jobs=1).as_data() for one in (lab, again))
    assert first["checks"] and first == second
    twice = sp.open_measurement(again.save(tmp_path / "again"))
    assert (tmp_path / "again/dark.h5").read_bytes() == (tmp_path / "lab/dark.h5").read_bytes()
    assert twice.recording("dark").untimed and again["dark"].events.tick == 1e-12


def test_a_damaged_mark_of_times_without_ticks_is_a_sentence(tmp_path: Path) -> None:
    import h5py

    dark = sp.Capture("dark", "tr", dark=True, exposure=5e-3)
    folder = sp.Measurement.from_arrays(sensor().layout, {dark: ([1e-3], [2])}).save(tmp_path / "lab")
    with h5py.File(folder / "dark.h5", "r+") as file:
        file.attrs["untimed"] = 7
    with pytest.raises(InputError, match="the attribute untimed is '7'; it is 0 or 1"):
        sp.open_measurement(folder)


def test_what_is_masked_is_no_data() -> None:
    capture, times, pixels = stamps_of(sensor())
    hidden = np.ma.masked_array(times, mask=np.arange(times.size) < 40)
    with pytest.raises(InputError, match=r"flat.*masked entries"):
        sp.Measurement.from_arrays(sensor().layout, {capture: (hidden, pixels)})
    frames = np.ma.masked_array(np.ones((40, 3, 5), bool), mask=np.zeros((40, 3, 5), bool))
    assert sp.Measurement.from_arrays(sensor().layout, {FLAT: frames})["flat"].counts.sum() == 600  # nothing is hidden
    rate = np.ma.masked_array(np.full(15, 1e6), mask=np.arange(15) < 8)
    masked = sp.Sensor(sensor().layout, [sp.effects.DarkCounts(rate=rate)], rules="device")
    with pytest.raises(InputError, match=r"dark_counts\.rate has masked pixels"):
        sp.simulate(masked, [sp.Capture("dark", "tr", dark=True, exposure=1e-3)])


def test_counts_may_be_floats_that_are_whole() -> None:
    capture = sp.Capture("c", "counts", dark=True, frames=45, frame_time=1e-5, bits=4)
    data = sp.Measurement.from_arrays(sensor().layout, {capture: np.full((3, 3, 5), 3.0)})
    assert data["c"].frames.dtype == np.uint8 and data["c"].counts.sum() == 135
    with pytest.raises(InputError, match="no whole numbers"):
        sp.Measurement.from_arrays(sensor().layout, {capture: np.full((3, 3, 5), 3.5)})


@pytest.mark.parametrize("area", [25.0, math.nan])
def test_a_pixel_area_in_another_unit_is_refused(area: float) -> None:
    large = sp.Sensor(sp.Layout(3, 5, area, 1.0), [sp.effects.Detection(pdp=0.4)], rules="device")
    with pytest.raises(InputError, match="it is in m\\^2, 25e-12 for 25 um\\^2, and at most 100 mm\\^2"):
        sp.simulate(large, [FLAT])


def test_a_map_that_is_not_relative_is_refused() -> None:
    """A measured map as it is, in counts; of factors that scatter about 1 some may be beyond what is possible."""
    layout = sensor().layout
    with pytest.raises(SpadError, match="divide a measured map by its median"):
        sp.simulate(sp.Sensor(layout, [sp.effects.Detection(pdp=0.4, relative=np.arange(15.0) + 100)]), [FLAT])
    assert sp.simulate(sp.Sensor(layout, [sp.effects.Detection(pdp=0.9, relative=np.linspace(0.7, 1.3, 15))]), [FLAT])


def test_lux_of_light_that_is_not_green_is_said() -> None:
    said: list[str] = []
    red = sp.Capture("red", "qis", lux=1e-3, wavelength=700e-9, frames=40, frame_time=10e-6)
    sp.simulate(
        sensor(), [red, sp.Capture("green", "qis", lux=1e-3, frames=40, frame_time=10e-6)], progress=said.append
    )
    (note,) = [line for line in said if "lux" in line]
    assert note.startswith("Note: red: lux is turned into power with 683 lm/W, which holds at 555 nm, not at 700 nm")


def test_more_frames_than_memory_holds_is_a_sentence() -> None:
    with pytest.raises(InputError, match=r"f: its 1,000,000,000,000 frames of 3 x 5 pixels take .* shorten it"):
        sp.simulate(sensor(), [sp.Capture("f", "qis", dark=True, frames=10**12, frame_time=1e-5)])


def test_a_value_that_cannot_be_is_shown_all_the_same() -> None:
    assert "{5e-07: 0.4}" in repr(sp.Sensor(sensor().layout, [sp.effects.Detection(pdp={500e-9: 0.4})]))
    for call in (sp.read_sensor, sp.open_measurement):
        with pytest.raises(InputError, match="None is of type NoneType; give the path of"):
            call(None)


@pytest.mark.slow
def test_a_switch_of_which_the_data_say_nothing_stays() -> None:
    """At 150 detections per pixel and second no pixel fires within a dead time."""
    model = sensor()
    capture, times, pixels = stamps_of(model)
    data = sp.Measurement.from_arrays(model.layout, {capture: (times, pixels)})
    found = sp.fit(model, data, free=["dead_time.paralyzable"], jobs=1)
    assert not found.values and not found.model.effect("dead_time").paralyzable
