"""Fit: maps from counts, steps on residuals, what the caller may name."""

from __future__ import annotations

import numpy as np
import pytest
from joblib import Parallel

from spadmnist import config
from spadmnist import measurement as measurements
from spadmnist.criticism import candidates, diagnose, fit, mapping
from spadmnist.effects import Conditions
from spadmnist.errors import InputError
from spadmnist.recording import Capture, Light
from spadmnist.streams import Streams
from spadmnist.twin import model_recordings

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
    hidden = candidates.with_values(sensor, {("detection", "relative"): map_, ("dead_time", "duration"): 60e-9})
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
    from dataclasses import replace

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


def test_a_dead_time_is_settled_and_a_map_found(tmp_path, made):
    sensor, captures, map_ = made
    data = measured(tmp_path, sensor, captures)
    with Parallel(n_jobs=1) as parallel:
        bench = fit.Bench(sensor, data, 0, parallel, 16)
        state = bench.state({})
        change = next(c for c in candidates.changes(sensor) if c.name == "per_pixel detection.pdp")
        levels = mapping.levels_of(bench, state)
        found = mapping.settle_maps(bench, {}, [change], levels)[change.carrier]
        assert np.corrcoef(found.estimate, np.log(map_))[0, 1] > 0.95
        assert mapping.summary(found)["sigma"] == pytest.approx(0.1, rel=0.35)
        length = next(c for c in candidates.changes(sensor) if c.name == "set dead_time.duration")
        values = {("dead_time", "duration"): 55e-9}
        settled = fit.settle(
            bench, state, length.dials, values, lambda v: fit.Sensors.same(candidates.with_values(sensor, v))
        )
    value, low, high = settled.interval(0)
    assert abs(value - 60e-9) < max(2e-9, high - low)


def test_what_cannot_be_settled_is_told(tmp_path, made):
    sensor, captures, _ = made
    data = measured(tmp_path, sensor, captures)
    with pytest.raises(InputError, match="crosstalk"):
        diagnose.fitted(sensor, data, add=["cross"])
    with pytest.raises(InputError, match=r"EFFECT\.PARAMETER"):
        diagnose.fitted(sensor, data, free=["dead_time"])
    with pytest.raises(InputError, match="nothing is to be settled"):
        diagnose.fitted(sensor, data)
