"""A diagnosis within a budget of work; answers that are kept as they come; what follows an answer."""

from __future__ import annotations

import json
import math
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from labs import labs

from spadmnist import twin
from spadmnist.cli import comparing
from spadmnist.effects import Conditions, Effect
from spadmnist.errors import InputError
from spadmnist.events import Layout
from spadmnist.inference import budget, model_selection
from spadmnist.inference.budget import Budget, OutOfBudget, clock, seconds_of, work_of
from spadmnist.inference.candidates import candidates
from spadmnist.inference.comparison import compare
from spadmnist.inference.journal import Journal
from spadmnist.inference.model_selection import diagnose
from spadmnist.inference.next_step import after_comparison, after_diagnosis
from spadmnist.inference.replicates import Execution, Replicates
from spadmnist.inference.results import Diagnosis, canonical, sentence, table
from spadmnist.recording import Capture, Light
from spadmnist.sensor import Sensor
from spadmnist.streams import Streams
from spadmnist.workers import Serial

AFTERPULSING = "    afterpulsing: {probability: 5 %, lifetime: 60 ns}\n"


@pytest.fixture
def lab(tmp_path):
    return labs(tmp_path)


@pytest.fixture
def few(monkeypatch):
    """Two candidates are tried, no others."""
    kinds = ("add afterpulsing", "add crosstalk")
    usual = Replicates.candidates
    monkeypatch.setattr(
        Replicates, "candidates", lambda self, sensor: [c for c in usual(self, sensor) if c.name in kinds]
    )


@pytest.mark.parametrize(
    ("stated", "quick", "seconds"),
    [
        (None, False, 600.0),
        (None, True, 180.0),
        ("3 min", False, 180.0),
        ("1 h", True, 3600.0),
        ("90 s", True, 90.0),
        (45, False, 45.0),
        ("none", True, math.inf),
        (" None ", False, math.inf),
    ],
)
def test_a_budget_as_users_state_it(stated, quick, seconds):
    assert seconds_of(stated, quick) == seconds


@pytest.mark.parametrize("wrong", ["soon", "3", "-1 min", "0 s", 0, -5.0, "3 lux", "10 sec", True and "nan s", [3]])
def test_what_is_no_budget(wrong):
    with pytest.raises(InputError, match=r"within: .* is not understood; .* more than 0 and its unit, h, min or s"):
        seconds_of(wrong, False)


def test_work_is_counted_before_it_is_done():
    one = Budget(10.0, until=0.5)
    one.spend(4.0)
    with pytest.raises(OutOfBudget):
        one.spend(1.5)
    assert one.spent == 4.0  # what was not done is not counted
    one.until = math.inf  # what every answer needs
    one.spend(100.0)
    assert one.spent == 104.0
    Budget().spend(1e9)


def test_bits_without_their_events_are_little_work():
    """Of 32 x 32 pixels and 1,000 frames, those that do not depend on each other."""
    conditions = Conditions(1e-2, 1000, 1e-5, 1e-5, 5e-7)
    qis = Capture("flat", "qis", Light(5e-7, 1e-3), conditions)
    layout = Layout(32, 32, 1e-10, 1.0)
    find = Effect.registry.find
    alone = [find("detection")(pdp=0.5), find("dark_counts")(rate=100.0)]
    tied = [*alone, find("afterpulsing")(probability=0.01)]
    gated = [*alone, find("short_gate")(fraction=0.5)]
    assert twin.draws_bits(Sensor(layout, alone, "device"), qis)
    assert not twin.draws_bits(Sensor(layout, tied, "device"), qis)
    assert not twin.draws_bits(Sensor(layout, gated, "device"), qis)
    assert not twin.draws_bits(Sensor(layout, alone, "device"), replace(qis, modality="tr"))
    bits = 32 * 32 * 1000
    for share in (0.1, 0.9):
        drawn, simulated = (work_of(qis, share * bits, 32 * 32, by_bits) for by_bits in (True, False))
        assert drawn < simulated / 2
    assert math.isclose(work_of(qis, 0.1 * bits, 1024, True), work_of(qis, 0.9 * bits, 1024, True))


def test_frames_in_the_dark_of_a_sensor_without_dark_counts_are_empty():
    """No event is expected of them, and they are drawn all the same."""
    conditions = Conditions(1e-2, 1000, 1e-5, 1e-5, None)
    sensor = Sensor(Layout(4, 4, 1e-10, 1.0), [Effect.registry.find("detection")(pdp=0.5)], "device")
    draws = Streams(0, "dark", "model", np.arange(1, dtype=np.uint64))
    (made,) = twin.model_recordings(sensor, Capture("dark", "qis", Light(), conditions), 0.0, draws, draws.images, True)
    assert made.totals.sum() == 0


def test_the_clock_ends_what_takes_three_times_as_long():
    Budget(10.0, until=1.0, began=time.monotonic() - 29.0).spend(1.0)
    with pytest.raises(OutOfBudget):
        Budget(10.0, until=1.0, began=time.monotonic() - 31.0).spend(1.0)


def test_the_time_left_is_that_of_the_speed_after_the_start(monkeypatch):
    """The first work also compiles the program, which says nothing of the rest."""
    now = [0.0]
    monkeypatch.setattr(budget, "time", SimpleNamespace(monotonic=lambda: now[0]))
    one = Budget(400.0, began=0.0)
    assert one.left == 400.0
    one.spend(10.0)
    now[0] = 100.0
    assert one.left == 290.0  # 300 s of steps at the speed of two idle cores
    one.spend(20.0)
    now[0] = 150.0
    assert one.left == 270.0 * 50 / 20
    one.spend(70.0)
    one.remember(70.0)  # what a cache held took no time
    assert one.left == 200.0 * 50 / 20
    now[0] = 1190.0
    assert one.left == 10.0  # the clock ends it
    assert Budget().left == math.inf
    one = Budget(400.0, began=0.0)
    one.spend(0.1 + 0.2)
    one.remember(0.3)  # but for rounding, as much
    one.spend(1.0)
    assert one.measured_from is None


def test_a_time_as_people_read_it():
    assert [clock(x) for x in (4.4, 250, 3720)] == ["0:04", "4:10", "1:02:00"]


@pytest.mark.slow
def test_a_budget_ends_a_search_and_the_answer_says_so(lab, few, monkeypatch):
    monkeypatch.setattr("spadmnist.inference.budget._SLOW", 1e9)  # work alone ends it, however slow this machine is
    made = lab(AFTERPULSING)
    told: list[str] = []
    answers = [diagnose(*made, quick=True, jobs=1, within=0.5, progress=told.append) for _ in range(2)]
    found = answers[0]
    assert not found.finished and found.verdict == "unexplained" and not found.steps
    assert canonical(answers[0]) == canonical(answers[1])  # work, not time
    data = json.loads(canonical(found))
    assert data["finished"] is False
    assert any(e["effect"] is None and "--within" in e["why"] for e in data["not_tried"])
    assert sentence(found).startswith("not finished") and "--within" in table(found)
    assert "lab -o there --quick --within none" in after_diagnosis(found, "s.yaml", "lab", same="-o there --quick")
    assert "goes on to the end" in after_diagnosis(found) and "begins again" in after_diagnosis(found, kept=False)
    assert any("left)" in line for line in told)


@pytest.mark.slow
@pytest.mark.long
def test_numbers_have_errors_of_their_own_where_the_budget_ends_their_fit(lab, few, monkeypatch):
    """Those of the rough fit are a half of them or less."""
    made = lab(AFTERPULSING + "    crosstalk: {probability: 3 %}\n")
    whole = diagnose(*made, quick=True, jobs=1)

    def ended(path):
        raise OutOfBudget

    monkeypatch.setattr(model_selection, "complete", ended)
    told: list[str] = []
    found = diagnose(*made, quick=True, jobs=1, progress=told.append)
    assert any(line.startswith("the errors of all numbers") for line in told) and not found.finished
    names = [step.candidate.effect for step in found.steps]
    assert set(names) == {"afterpulsing", "crosstalk"} == {step.candidate.effect for step in whole.steps}
    for step in found.steps:
        other = next(s for s in whole.steps if s.candidate.effect == step.candidate.effect)
        one, right = step.values["probability"], other.values["probability"]
        assert one.low < one.value < one.high
        assert 0.7 < np.log(one.high / one.low) / np.log(right.high / right.low) < 3


@pytest.mark.slow
def test_the_answer_is_kept_after_each_step(lab, few):
    kept: list[Diagnosis] = []
    found = diagnose(*lab(AFTERPULSING), quick=True, jobs=1, keep=kept.append)
    assert found.finished and found.verdict == "explained"
    assert [step.candidate.name for step in kept[0].steps] == ["add afterpulsing"] and not kept[0].finished
    for one in [*kept, found]:
        assert json.loads(canonical(one))["format"] == "spadmnist-diagnosis/1"
    (step,) = found.steps
    new = found.in_sample
    assert new is not None and new.verdict == "adequate" and step.candidate.effect == "afterpulsing"


@pytest.mark.slow
def test_misfit_in_sample_is_the_same_in_both_verbs(lab, few):
    """Of the same model and data: both are one evaluation."""
    made = lab()
    one, other = compare(*made, jobs=1), diagnose(*made, jobs=1)
    assert other.verdict == "adequate" and other.in_sample is not None
    assert (one.misfit, one.misfit_null_95) == (other.in_sample.misfit, other.in_sample.misfit_null_95)
    assert json.loads(canonical(other))["misfit_in_sample"] == one.as_data()["misfit_in_sample"]
    assert [c.p_value for c in one.checks] == [c.p_value for c in other.in_sample.checks]
    assert "spadmnist diagnose s.yaml lab" in after_comparison(one, "s.yaml", "lab")
    assert "nothing is missing" in after_diagnosis(other)


def test_all_that_a_sensor_may_lack_is_tried_by_default(lab):
    sensor, _ = lab()
    assert {"add afterpulsing", "add crosstalk"} <= {c.name for c in candidates(sensor.resolved())}


@pytest.mark.slow
def test_a_search_that_was_stopped_goes_on_to_the_same_answer(lab, few, tmp_path, monkeypatch):
    """Stopped after its first step, begun again; an entry that is damaged is simulated again."""

    class Stopped(Exception):
        pass

    def stop(so_far: Diagnosis) -> None:
        raise Stopped

    made, folder = lab(AFTERPULSING), tmp_path / "journal"
    whole = diagnose(*made, quick=True, jobs=1)
    with pytest.raises(Stopped):
        diagnose(*made, quick=True, jobs=1, keep=stop, journal=Journal(folder))
    entries = sorted(folder.glob("*.replicates"))
    held = sum(path.stat().st_size for path in entries)
    assert len(entries) > 10 and Journal(folder).bytes == held
    entries[0].write_bytes(entries[0].read_bytes()[:-1] + b"x")
    again, usual, read = Journal(folder), Journal.recall, []
    monkeypatch.setattr(Journal, "recall", lambda self, name: read.append(usual(self, name)) or read[-1])
    found = diagnose(*made, quick=True, jobs=1, journal=again)
    assert canonical(found) == canonical(whole)
    assert sum(one is not None for one in read) >= len(entries) - 1
    again.remove()
    assert not folder.exists()


def test_what_a_journal_holds_is_of_this_model_capture_light_and_seed(lab):
    sensor, data = lab()
    replicates = Replicates(sensor, data, 0, Execution(Serial()), 4)
    seen, photons, numbers = replicates.seen["flat"], np.full(4, 1e5), np.arange(4, dtype=np.uint64)
    other = sensor.with_values({"dead_time.duration": 51e-9})
    names = [
        Journal.name([sensor], seen, photons, numbers, 0),
        Journal.name([other], seen, photons, numbers, 0),
        Journal.name([sensor, other], seen, photons, numbers, 0),
        Journal.name([sensor], replicates.seen["dark"], photons, numbers, 0),
        Journal.name([sensor], replace(seen, half_of=(seen.capture, True)), photons, numbers, 0),
        Journal.name([sensor], seen, photons * 1.001, numbers, 0),
        Journal.name([sensor], seen, photons, numbers + np.uint64(1), 0),
        Journal.name([sensor], seen, photons, numbers, 1),
    ]
    assert len(set(names)) == len(names) and names[0] == Journal.name([sensor], seen, photons, numbers, 0)


def test_the_command_line_and_the_library_take_as_many_steps():
    """The command line holds the number itself, because the module of the search takes long to import."""
    assert comparing.MAX_STEPS == model_selection.MAX_STEPS
