"""Maps of the dark by the pixels' counts: the closed form, with the dead time undone, and no simulation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import laws
import numpy as np
import pytest

from spadmnist import config, measurement, twin
from spadmnist.inference.candidates import candidates, with_values
from spadmnist.inference.counts_in_the_dark import may_fit
from spadmnist.inference.named_fit import fit_named
from spadmnist.inference.pixel_maps import PixelMap, map_values
from spadmnist.inference.replicates import Replicates
from spadmnist.inference.results import Diagnosis
from spadmnist.measurement import Measurement
from spadmnist.sensor import Sensor

SIDE = 24
SENSOR = f"""sensor:
  rules: device
  layout: {{rows: {SIDE}, columns: {SIDE}, pixel_area: 100 um^2, fill_factor: 1.0}}
  effects:
    detection: {{pdp: 0.42}}
    dark_counts: {{rate: 10 kHz}}
    dead_time: {{duration: DEAD ns}}
    tdc: {{resolution: 100 ps}}
"""
PLAN = f"""format: spadmnist-measurement/1
name: lab
layout: {{rows: {SIDE}, columns: {SIDE}}}
captures:
"""
TR = "  - {id: dark, file: dark.h5, modality: tr, light: {kind: dark}, exposure: 20 ms}\n"
QIS = "  - {id: bits, file: bits.h5, modality: qis, light: {kind: dark}, frames: 4000, frame_time: 10 us}\n"
LIT = "  - {id: lit, file: lit.h5, modality: qis, frames: 400, frame_time: 10 us,\n     light: LIGHT}\n"
DIM = LIT.replace("LIGHT", "{kind: flat, wavelength: 500 nm, irradiance: 1 nW/cm^2}")
BRIGHT = LIT.replace("LIGHT", "{kind: flat, wavelength: 500 nm, irradiance: 300 nW/cm^2}")
RATE = ("dark_counts", "rate")
# as those of a bad chip: from 2 kHz to some MHz, where a dead time of 200 ns takes a third
RATES = np.exp(np.random.Generator(np.random.PCG64(4)).normal(np.log(20e3), 1.5, SIDE * SIDE))


def lab(folder: Path, captures: str = TR, dead: int = 200, **hidden: Any) -> tuple[Sensor, Measurement]:
    """(the sensor as it is listed, what one with such rates has recorded)."""
    (folder / "sensor.yaml").write_text(SENSOR.replace("DEAD", str(dead)))
    (folder / "plan.yaml").write_text(PLAN + captures)
    sensor = config.read_sensor(folder / "sensor.yaml").resolved()
    truth = with_values(sensor, {RATE: RATES, **{tuple(key.split("__")): v for key, v in hidden.items()}})  # type: ignore[misc]
    plan = measurement.open(folder / "plan.yaml", planned=True)
    return sensor, measurement.open(twin.simulate(truth, plan, folder / "lab", 3))


@pytest.fixture(autouse=True)
def nothing_is_simulated(monkeypatch: pytest.MonkeyPatch) -> None:
    def simulate(*arguments: Any, **keywords: Any) -> Any:
        raise AssertionError("a model was simulated")

    monkeypatch.setattr(Replicates, "simulate", simulate)


def fit(sensor: Sensor, data: Measurement) -> Diagnosis:
    return fit_named(sensor, data, per_pixel=["dark_counts.rate"], jobs=1)


def map_of(sensor: Sensor, data: Measurement, monkeypatch: pytest.MonkeyPatch) -> PixelMap:
    """The map with its errors."""
    seen: list[PixelMap] = []
    values = map_values
    monkeypatch.setattr(
        "spadmnist.inference.counts_in_the_dark.map_values", lambda map_: seen.append(map_) or values(map_)
    )
    fit(sensor, data)
    return seen[0]


@pytest.mark.parametrize("captures", [TR, QIS])
def test_the_map_is_that_of_the_closed_form(captures: str, tmp_path: Path) -> None:
    """n / (T - n dead time) of time stamps, -ln(1 - n / frames) / frame time of frames."""
    sensor, data = lab(tmp_path, captures)
    found = fit(sensor, data)
    (capture,) = data.captures
    n = data.recording(capture.id).totals.astype(float)
    many = n > 400
    if captures == QIS:
        many &= n < 3000
    closed = n / (0.02 - n * 200e-9) if captures == TR else -np.log1p(-np.minimum(n, 3999) / 4000) / 1e-5
    assert many.sum() > 100 and found.verdict == "explained" and found.steps[0].values["sigma"].method == "counts"
    step = found.steps[0]
    assert (step.change, step.effect, step.parameter) == ("per_pixel", "dark_counts", "rate")
    # what keeps noise out pulls a pixel by a small part of its error
    pulled = np.abs(np.log(found.values[RATE] / closed))[many] * np.sqrt(n[many])
    assert (pulled < 0.3).mean() > 0.9 and pulled.max() < 1
    if captures == TR:  # what the dead time has taken is there
        fast = RATES > 5e5
        assert np.median(closed[fast] / (n[fast] / 0.02)) > 1.1


def test_the_intervals_of_pixels_hold_their_rates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of pixels with 100 counts or more 95 % lie within 1.96 errors; with the dead time left in, far fewer."""
    sensor, data = lab(tmp_path)
    map_ = map_of(sensor, data, monkeypatch)
    n = data.recording("dark").totals
    many = n >= 100
    truth = np.log(RATES / map_.base)
    inside = np.abs(map_.raw - truth)[many] < 1.96 * map_.raw_error[many]
    laws.share_is(int(inside.sum()), int(many.sum()), 0.95)
    fast = RATES > 3e5
    left_in = np.log(n / 0.02 / map_.base)
    assert (np.abs(left_in - truth)[fast] < 1.96 * map_.raw_error[fast]).mean() < 0.3


def test_the_spread_of_the_rates_lies_in_its_interval(tmp_path: Path) -> None:
    sensor, data = lab(tmp_path)
    found = fit(sensor, data)
    sigma = found.steps[0].values["sigma"]
    true = float(np.std(np.log(RATES)))
    assert sigma.low is not None and sigma.high is not None and sigma.low < true < sigma.high < 1.15 * true
    assert found.before > 100 and found.after < 1.2 and found.null_95 < 1.11
    assert [row["model"] for row in found.ladder] == ["start", "+ dark_counts.rate per pixel"]


def test_rates_that_come_and_go_remain(tmp_path: Path) -> None:
    """One half of the blocks of time is no model of the other where pixels blink slowly."""
    blink = {"blinking_dark_counts__amplitude": 2e5, "blinking_dark_counts__fraction": 0.3}
    slow = {"blinking_dark_counts__rate_on": 100.0, "blinking_dark_counts__rate_off": 100.0}
    sensor, data = lab(tmp_path, **blink, **slow)
    found = fit(sensor, data)
    assert found.verdict == "partly_explained" and found.after > 1.5
    (rest,) = found.unexplained
    assert rest["statistic"] == "pixel_map" and rest["capture"] == "dark" and rest["significance"] > 5


# --- where it is taken, and where not -----------------------------------------------------------------------------


def wanted(sensor: Sensor, name: str = "per_pixel dark_counts.rate") -> Any:
    return next(c for c in candidates(sensor) if c.name == name)


@pytest.mark.parametrize(
    ("more", "taken"),
    [
        ({}, True),
        ({("afterpulsing", "probability"): 0.01}, True),
        ({("flicker", "amplitude"): 0.01}, True),  # of the light
        ({("crosstalk", "probability"): 0.01}, False),
        ({("blinking_dark_counts", "amplitude"): 1e4}, False),
        ({("readout_loss", "service_time"): 1e-8}, False),
    ],
)
def test_effects_say_whether_counts_are_a_pixel_s_own(more: Any, taken: bool, tmp_path: Path) -> None:
    (tmp_path / "sensor.yaml").write_text(SENSOR.replace("DEAD", "50"))
    sensor = with_values(config.read_sensor(tmp_path / "sensor.yaml"), more)
    assert may_fit(sensor, [wanted(sensor)]) is taken
    assert not may_fit(sensor, [wanted(sensor, "per_pixel detection.pdp")])
    assert not may_fit(sensor, [wanted(sensor), wanted(sensor, "per_pixel detection.pdp")])


def test_light_that_hardly_tells_is_done_without_and_other_light_is_not(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    sensor, data = lab(tmp_path / "a", TR + BRIGHT, dead=50)
    assert fit(sensor, data).verdict == "explained"
    (tmp_path / "b").mkdir()
    sensor, data = lab(tmp_path / "b", TR + DIM, dead=50)
    with pytest.raises(AssertionError, match="a model was simulated"):
        fit(sensor, data)
    (tmp_path / "c").mkdir()
    sensor, data = lab(tmp_path / "c", DIM, dead=50)
    with pytest.raises(AssertionError, match="a model was simulated"):
        fit(sensor, data)


@pytest.mark.parametrize(("rate", "verdict"), [(10e3, "adequate"), (10.2e3, "explained")])
def test_what_all_pixels_have_in_common_is_seen_in_the_total(rate: float, verdict: str, tmp_path: Path) -> None:
    """2 % more in 576 pixels of 200 counts each: 7 sigma in the total, 1.4 sigma in the squares of the pixels."""
    found = fit(*lab(tmp_path, dark_counts__rate=rate))
    assert found.verdict == verdict and not found.unexplained
    assert (found.steps[0].significance > 5.5) == (verdict == "explained")
    assert found.ladder[0]["misfit"] < 1.2


def test_no_detection_where_none_is_expected_is_no_error_of_the_rate(tmp_path: Path) -> None:
    found = fit(*lab(tmp_path, TR.replace("20 ms", "1 ns"), dark_counts__rate=1e-3))
    assert found.verdict == "adequate" and found.ladder[0]["errors"]["mean_rate"] == 0


@pytest.mark.parametrize(("captures", "probability"), [(TR, 0.05), (QIS, 0.01)])
def test_afterpulses_that_the_closed_form_miscounts_are_no_other_rate(
    captures: str, probability: float, tmp_path: Path
) -> None:
    """The sensor that made the data; without the allowance 3.4 and 5.9 sigma."""
    (tmp_path / "sensor.yaml").write_text(
        SENSOR.replace("DEAD", "200") + f"    afterpulsing: {{probability: {probability}, lifetime: 30 ns}}\n"
    )
    (tmp_path / "plan.yaml").write_text(PLAN + captures)
    sensor = config.read_sensor(tmp_path / "sensor.yaml").resolved()
    plan = measurement.open(tmp_path / "plan.yaml", planned=True)
    found = fit(sensor, measurement.open(twin.simulate(sensor, plan, tmp_path / "lab", 3)))
    assert found.verdict == "adequate"
