"""A candidate that cannot be simulated is none, wherever that turns out: the diagnosis goes on, and says so."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labs import bench_of, quiet

import spadmnist as sp
from spadmnist import pages
from spadmnist.effects import DarkCounts, DeadTime, Detection, Tdc
from spadmnist.errors import SpadError
from spadmnist.inference import (
    alternatives,
    experiment_design,
    forward_step,
    map_models,
    model_path,
    model_selection,
    time_blocks,
    trial_fits,
    upper_limits,
)
from spadmnist.inference.candidates import candidates
from spadmnist.inference.capture_replicates import CannotSimulate
from spadmnist.inference.conclusion import Notes
from spadmnist.inference.evaluation import evaluate
from spadmnist.inference.forward_step import best_added, or_as_before
from spadmnist.inference.map_trials import map_trials_of
from spadmnist.inference.model_path import begin, rests_on
from spadmnist.inference.model_selection import diagnose
from spadmnist.inference.replicates import Replicates
from spadmnist.inference.results import Step, Value, canonical, table
from spadmnist.inference.scan import Scan
from spadmnist.inference.setups import rivals
from spadmnist.inference.signature import Signature, signature_of_totals, signatures
from spadmnist.sensor import Sensor

_AFTER = "afterpulsing: {probability: 0.05, lifetime: 30 ns}\n"


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is broken here is simulated, whatever others have."""
    monkeypatch.setenv("SPADMNIST_CACHE", str(tmp_path / "cache"))


class Broken:
    """Sensors that have an effect cannot be simulated from some moment on. armed: is it now?"""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, effect: str, error: BaseException, armed: bool):
        self.armed, self.raised, self.entered = armed, 0, False
        usual = Sensor.expose

        def expose(sensor: Sensor, *given: Any, **named: Any) -> Any:
            own = sensor.effect(effect)
            if self.armed and own is not None:
                self.raised += 1
                raise error
            return usual(sensor, *given, **named)

        monkeypatch.setattr(Sensor, "expose", expose)

    def at(self, monkeypatch: pytest.MonkeyPatch, place: Any, name: str, stays: bool) -> None:
        """Armed in one of the search's stages. stays: and after it."""
        usual: Callable[..., Any] = getattr(place, name)

        def there(*given: Any, **named: Any) -> Any:
            self.armed = self.entered = True
            try:
                return usual(*given, **named)
            finally:
                self.armed = stays

        monkeypatch.setattr(place, name, there)


ERRORS = [SpadError("a cascade does not end"), OverflowError("too large"), ZeroDivisionError(), MemoryError()]


@pytest.mark.parametrize("error", ERRORS, ids=lambda e: type(e).__name__)
def test_a_model_that_cannot_be_simulated_is_told_by_the_bench(error: Exception, lab, monkeypatch) -> None:
    replicates = bench_of(lab(), 8)
    evaluation = evaluate(replicates, {})
    Broken(monkeypatch, "crosstalk", error, armed=True)
    bad = evaluation.sensors.changed({("crosstalk", "probability"): 0.01})
    good = evaluation.sensors.changed({("dead_time", "duration"): 60e-9})
    first, second, third = signatures(replicates, evaluation, [good, bad, good])
    assert isinstance(second, CannotSimulate) and str(second)
    assert isinstance(first, Signature) and isinstance(third, Signature)
    with pytest.raises(SpadError):
        evaluate(replicates, {}, bad)


@pytest.mark.parametrize("error", ERRORS, ids=lambda e: type(e).__name__)
def test_a_closed_form_that_fails_is_told_by_the_bench(error: Exception, lab, monkeypatch) -> None:
    replicates = bench_of(lab(), 8)
    evaluation = evaluate(replicates, {})
    usual = Sensor.expected

    def expected(sensor: Sensor, *given: Any) -> Any:
        if sensor.effect("crosstalk") is not None:
            raise error
        return usual(sensor, *given)

    monkeypatch.setattr(Sensor, "expected", expected)
    bad = evaluation.sensors.changed({("crosstalk", "probability"): 0.01})
    good = evaluation.sensors.changed({("dead_time", "duration"): 60e-9})
    first, second, third = signatures(replicates, evaluation, [good, bad, good])
    assert isinstance(second, CannotSimulate) and str(second)
    assert isinstance(first, Signature) and isinstance(third, Signature)
    with pytest.raises(SpadError):
        signature_of_totals(replicates, evaluation, bad)
    with pytest.raises(SpadError):
        evaluate(replicates, {}, bad)


STAGES: dict[str, tuple[Any, str, bool]] = {
    "scoring": (Scan, "scan", True),
    "looking again": (Scan, "again", True),
    "refining": (forward_step, "fit_trial", True),
    "settling": (trial_fits, "gauss_newton", True),
    "accepting": (forward_step, "accept", True),
    "all together": (model_path, "fit_all", True),
    "taking out": (model_selection, "drop_needless", False),
    "likelihood": (model_selection, "sharpen", False),
    "intervals": (model_selection, "open_ends", False),
    "final comparison": (time_blocks, "measure", False),
    "limits": (upper_limits, "upper_limits", False),
}
SIMULATED_BEFORE = ("accepting", "all together")  # for its evidence: then it is a step, with the values fitted before


def one_in_six(stages: Iterable[str]) -> list[Any]:
    """The stages, the others `long`: each is a diagnosis, and all take the same way out."""
    return [pytest.param(stage, marks=pytest.mark.long if k % 6 else ()) for k, stage in enumerate(stages)]


@pytest.mark.slow
@pytest.mark.parametrize("stage", one_in_six(STAGES))
def test_a_diagnosis_goes_on_without_it(stage: str, lab, monkeypatch, tmp_path) -> None:
    """Afterpulsing is what lacks; at one stage it cannot be simulated any more."""
    sensor, data = lab(f"    {_AFTER}")
    broken = Broken(monkeypatch, "afterpulsing", SpadError("a cascade does not end"), armed=False)
    place, name, stays = STAGES[stage]
    broken.at(monkeypatch, place, name, stays)
    some = [c for c in candidates(sensor) if c.effect in ("afterpulsing", "crosstalk", "dead_time")]
    names = {candidate.effect for candidate in some}
    monkeypatch.setattr(
        Replicates, "candidates", lambda self, model: [c for c in candidates(model) if c.effect in names]
    )
    # of what is explained a quick diagnosis has no limits
    found = diagnose(sensor, data, quick=stage != "limits", max_steps=1, jobs=1)
    told = [e for e in found.untried if e["effect"] == "afterpulsing"]
    assert broken.entered
    if stage not in ("taking out", "likelihood", "intervals", "limits"):  # which may need no recording of it
        assert broken.raised
    assert bool(told) == bool(broken.raised)
    if stays and stage not in SIMULATED_BEFORE:
        assert all(step.candidate.effect != "afterpulsing" for step in found.steps)
    else:
        assert [step.candidate.effect for step in found.steps] == ["afterpulsing"]
    for entry in told:
        assert entry["change"] == "add" and entry["where"] and "a cascade does not end" in entry["why"]
    assert json.loads(canonical(found))["not_tried"] == found.untried
    if told:
        text, page = table(found), pages.diagnosis(found, tmp_path / "page").read_text()
        assert "a cascade does not end" in " ".join(text.split()) and "a cascade does not end" in page


FAILING: dict[str, tuple[Any, str, bool]] = {
    "alternative": (alternatives, "_alternative", True),
    "placebo": (forward_step, "placebo_of", True),
    "chance": (forward_step, "p_of_best", False),
    "evidence": (forward_step, "evidence_of", False),
    "advice": (experiment_design, "between", True),
}


@pytest.mark.slow
@pytest.mark.parametrize("stage", one_in_six(FAILING))
def test_an_answer_is_given_whatever_is_raised_beside_the_steps(stage: str, lab, monkeypatch) -> None:
    """found: is the step that lacks found all the same? What is raised while the best is chosen is laid to that one."""
    sensor, data = lab(f"    {_AFTER}")
    place, name, found_it = FAILING[stage]

    def fails(*_: Any, **__: Any) -> Any:
        raise OverflowError("too large")

    monkeypatch.setattr(place, name, fails)
    usual = candidates
    some = ("afterpulsing", "crosstalk", "dead_time")
    monkeypatch.setattr(Replicates, "candidates", lambda self, model: [c for c in usual(model) if c.effect in some])
    found = diagnose(sensor, data, quick=True, max_steps=1, jobs=1)
    assert [step.candidate.effect for step in found.steps] == (["afterpulsing"] if found_it else [])
    assert found.verdict in (("explained", "confused", "partly_explained") if found_it else ("unexplained",))
    if not found_it:
        assert {e["effect"] for e in found.untried} >= {"afterpulsing"} and found.untried[0]["where"]


def test_a_rival_of_the_set_up_that_has_no_closed_form_is_none(lab, monkeypatch) -> None:
    replicates = bench_of(lab(), 8)
    evaluation, look = evaluate(replicates, {}), Scan(replicates, lambda what: None)
    usual = Sensor.expected

    def expected(sensor: Sensor, *given: Any) -> Any:
        if sensor.effect("crosstalk") is not None:
            raise OverflowError("too large")
        return usual(sensor, *given)

    monkeypatch.setattr(Sensor, "expected", expected)
    assert all(rival.candidate.effect != "crosstalk" for rival in rivals(look, evaluation, 1e6))
    assert {(e["effect"], e["where"]) for e in look.untried} == {("crosstalk", "explaining the totals")}


def test_a_map_that_cannot_be_made_is_none(lab, monkeypatch) -> None:
    replicates = bench_of(lab(), 8)
    evaluation, look = evaluate(replicates, {}), Scan(replicates, lambda what: None)

    def fails(*_: Any) -> Any:
        raise FloatingPointError("no map")

    monkeypatch.setattr(map_models, "models_with_maps", fails)
    assert map_trials_of(look, evaluation, {}) == []
    assert look.untried and all("no map" in entry["why"] for entry in look.untried)
    assert {entry["where"] for entry in look.untried} == {"making a map"}


def test_a_later_step_may_add_what_a_map_needs() -> None:
    """Unequal codes need a converter: their map is tried again once a step has added one, and excluded without it."""
    effects = [Detection(pdp=0.5), DarkCounts(rate=100.0), DeadTime(duration=50e-9)]
    sensor = Sensor(sp.Layout(2, 2, 25e-12, 1.0), effects, rules="device")
    flat = sp.Capture("flat", "tr", exposure=0.1, wavelength=500e-9, irradiance=3e-3, tick=1e-10)
    data = sp.simulate(sensor.changed(effects=[*effects, Tdc(resolution=1e-10)]), [flat], seed=1)
    replicates = bench_of((sensor, data), 8)
    look, converter = quiet(replicates), {("tdc", "resolution"): 1e-10}

    def tried(values: dict[Any, Any]) -> bool:
        evaluation = evaluate(replicates, values)
        map_trials_of(look, evaluation, values)
        return all(entry["effect"] != "tdc_nonlinearity" for entry in look.untried)

    codes = next(c for c in candidates(sensor) if c.effect == "tdc_nonlinearity")
    assert not tried({}) and look.is_excluded(codes)
    look.accepted = [next(c for c in candidates(sensor) if c.name == "add tdc")]
    assert tried(converter) and not look.is_excluded(codes)
    look.accepted = []
    assert look.is_excluded(codes)
    # the map rests on the converter, and jitter on neither
    path = begin(replicates)
    path.values = {**converter, ("tdc_nonlinearity", "widths"): np.array([1.0, 1.2]), ("jitter", "sigma"): 1e-10}
    adds, maps, other = (
        Step(next(c for c in candidates(sensor) if c.name == f"add {name}"), {}, 1.0, 9.0, "")
        for name in ("tdc", "tdc_nonlinearity", "jitter")
    )
    assert [rests_on(one, adds, path) for one in (adds, maps, other)] == [False, True, False]
    assert not rests_on(adds, maps, path) and not rests_on(maps, other, path)


@pytest.mark.slow
def test_what_cannot_be_fitted_as_a_step_is_tried_once(monkeypatch) -> None:
    """A map is made anew for every look: it is excluded from the model that it was added to, lest there be no end."""
    gains = np.exp(np.random.default_rng(2).normal(0, 0.5, 16))
    detection, others = Detection(pdp=0.3), [DarkCounts(rate=100.0), DeadTime(duration=50e-9)]
    sensor = Sensor(sp.Layout(4, 4, 25e-12, 1.0), [detection, *others], rules="device")
    hidden = sensor.changed(effects=[Detection(pdp=0.3, relative=gains), *others])
    flat = sp.Capture("flat", "tr", exposure=0.1, wavelength=500e-9, irradiance=3e-3)
    path, notes, taken = begin(bench_of((sensor, sp.simulate(hidden, [flat], seed=1)), 8)), Notes([], False), []

    def fails(path: Any, best: Any, significance: float) -> Any:
        taken.append(best.candidate.name)
        assert len(taken) < 20
        path.scan.accepted += best.candidates
        raise SpadError("its light has no level")

    monkeypatch.setattr(forward_step, "accept", fails)
    notes.tried = path.scan.scan(path.evaluation)
    best_added(path, notes, path.failed)
    assert "per_pixel detection.pdp" in taken and len(set(taken)) == len(taken)
    assert not path.steps and not path.scan.accepted
    assert any(e["effect"] == "detection" and "no level" in e["why"] for e in path.scan.untried)


@pytest.mark.slow
def test_what_a_later_model_can_do_was_not_left_out(lab, monkeypatch) -> None:
    """A candidate whose first look fails is looked at again under the next model, and stands in `not_tried` no more."""
    path = begin(bench_of(lab(), 8))
    broken = Broken(monkeypatch, "crosstalk", SpadError("a cascade does not end"), armed=True)
    first = path.scan.scan(path.evaluation, everywhere=True)
    assert {(e["effect"], e["where"]) for e in path.scan.untried} == {("crosstalk", "the first look")}
    assert all(one.candidate.effect != "crosstalk" for one in first)
    again = path.scan.scan(path.evaluation, everywhere=True, known=first)
    assert len(path.scan.untried) == 1 and all(one.candidate.effect != "crosstalk" for one in again)
    broken.armed = False
    assert any(one.candidate.effect == "crosstalk" for one in path.scan.scan(path.evaluation, True, known=again))
    assert not path.scan.untried


def test_a_sensor_that_cannot_be_simulated_itself_is_one_error(lab, monkeypatch) -> None:
    sensor, data = lab()
    Broken(monkeypatch, "dead_time", OverflowError("too large"), armed=True)
    with pytest.raises(SpadError, match="too large"):
        diagnose(sensor, data, quick=True, jobs=1)


def test_an_interrupt_ends_a_diagnosis(lab, monkeypatch) -> None:
    replicates = bench_of(lab(), 8)
    evaluation = evaluate(replicates, {})
    Broken(monkeypatch, "crosstalk", KeyboardInterrupt(), armed=True)
    with pytest.raises(KeyboardInterrupt):
        signatures(replicates, evaluation, [evaluation.sensors.changed({("crosstalk", "probability"): 0.01})])


def test_steps_are_as_they_were_where_a_later_stage_fails(lab) -> None:
    """Values and intervals, too, that were written before it failed."""
    replicates = bench_of(lab(), 8)
    path = begin(replicates)
    candidate = next(c for c in candidates(replicates.start) if c.name == "add crosstalk")
    step = Step(candidate, {"probability": Value(0.01, 0.0, 0.02)}, 1.0, 9.0, "")
    path.steps, before = [step], dict(step.values)
    with or_as_before(path, "the intervals"):
        step.values["probability"] = Value(0.5, 0.4, 0.6)
        path.steps = []
        raise OverflowError("too large")
    assert path.steps == [step] and step.values == before
    (told,) = path.scan.untried
    assert told["effect"] == "crosstalk" and told["where"] == "the intervals" and "too large" in told["why"]
