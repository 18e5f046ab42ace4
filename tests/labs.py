"""A tiny array of time stamps, dark and lit, whose stated sensor lacks something; and steps of a diagnosis of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import spadmnist as sp
from spadmnist import config, twin
from spadmnist import measurement as measurements
from spadmnist.effects import Effect
from spadmnist.inference.candidates import Candidate, candidates
from spadmnist.inference.coordinates import Key
from spadmnist.inference.model_path import ModelPath, accept
from spadmnist.inference.replicates import Execution, Replicates
from spadmnist.inference.scan import Scan
from spadmnist.inference.signature import Sampling, Signature, signatures
from spadmnist.inference.trial import Trial
from spadmnist.inference.trial_fits import fit_trial
from spadmnist.measurement import Measurement
from spadmnist.sensor import Sensor
from spadmnist.workers import Serial

SENSOR = """sensor:
  name: tiny
  rules: device
  layout: {rows: 2, columns: 2, pixel_area: 100 um^2, fill_factor: 1.0}
  effects:
    detection: {pdp: 0.42}
    dark_counts: {rate: 100 Hz}
    dead_time: {duration: DEAD ns}
    tdc: {resolution: 100 ps}
"""
CAPTURES = """format: spadmnist-measurement/1
name: lab
layout: {rows: 2, columns: 2}
captures:
  - {id: dark, file: dark.h5, modality: tr, light: {kind: dark}, exposure: 1 s}
  - {id: flat, file: flat.h5, modality: tr, exposure: 20 ms,
     light: {kind: flat, wavelength: 500 nm, irradiance: 100 nW/cm^2, relative_uncertainty: 0.02}}
"""
PROBABILITY, LIFETIME = ("afterpulsing", "probability"), ("afterpulsing", "lifetime")
DURATION, CROSSTALK = ("dead_time", "duration"), ("crosstalk", "probability")

Lab = Callable[..., tuple[Sensor, Measurement]]


def labs(tmp_path: Path) -> Lab:
    """(effects that the data have more, their dead time in ns, seed, more) -> (the sensor as stated, the data).

    light: nW/cm^2; side: pixels.
    """

    def made(
        extra: str = "", dead: int = 50, seed: int = 0, light: int = 100, side: int = 2
    ) -> tuple[Sensor, Measurement]:
        array = f"rows: {side}, columns: {side}"
        folder = tmp_path / f"{len(list(tmp_path.iterdir()))}"
        folder.mkdir()
        stated = SENSOR.replace("rows: 2, columns: 2", array)
        plan_of = CAPTURES.replace("rows: 2, columns: 2", array).replace("100 nW", f"{light} nW")
        (folder / "plan.yaml").write_text(plan_of)
        (folder / "sensor.yaml").write_text(stated.replace("DEAD", "50"))
        (folder / "truth.yaml").write_text(stated.replace("DEAD", str(dead)) + extra)
        plan = measurements.open(folder / "plan.yaml", planned=True)
        out = twin.simulate(config.read_sensor(folder / "truth.yaml"), plan, folder / "lab", seed)
        return config.read_sensor(folder / "sensor.yaml"), measurements.open(out)

    return made


PHOTON = 6.62607015e-34 * 299792458.0 / 500e-9  # J


def wrong_numbers(listed: Effect, values: dict[str, float], exposure: float) -> tuple[Sensor, Measurement]:
    """(a sensor with an effect, one lit capture of it with other values): by "effect.parameter", SI; exposure: s."""
    effects = [
        sp.effects.Detection(pdp=0.5),
        listed,
        sp.effects.DeadTime(duration=50e-9),
        sp.effects.DarkCounts(rate=100.0),
        sp.effects.Tdc(resolution=1e-10),
    ]
    stated = Sensor(sp.Layout(2, 2, 25e-12, 1.0), effects, rules="device")
    light = {"wavelength": 500e-9, "irradiance": 2e5 * PHOTON / 25e-12, "relative_uncertainty": 0.1}
    flat = sp.Capture("flat", "tr", exposure=exposure, **light)
    return stated, sp.simulate(stated.with_values(values), [flat], seed=1)


def bench_of(made: tuple[Sensor, Measurement], replicates: int = 16) -> Replicates:
    return Replicates(*made, 0, Execution(Serial()), replicates)


def quiet(replicates: Replicates) -> Scan:
    return Scan(replicates, lambda what: None)


def change_of(replicates: Replicates, name: str) -> Candidate:
    return next(c for c in candidates(replicates.start) if c.name == name)


def given(path: ModelPath, name: str, values: dict[Key, Any], fitted: bool) -> Trial:
    """A candidate at some values, or fitted from there."""
    replicates, evaluation = path.replicates, path.evaluation
    candidate = next(c for c in candidates(evaluation.sensors.one) if c.name == name)
    (signature,) = signatures(replicates, evaluation, [evaluation.sensors.changed(values)], Sampling(kept="sure"))
    assert isinstance(signature, Signature)
    one = Trial(candidate, values, signature, 0.0, 1.0)
    return fit_trial(path.replicates, evaluation, one) if fitted else one


def taken(path: ModelPath, name: str, values: dict[Key, Any], fitted: bool = True) -> None:
    accept(path, given(path, name, values, fitted), 1.0)


def names(path: ModelPath) -> list[str]:
    return [step.candidate.name for step in path.steps]
