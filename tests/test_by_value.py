"""Effects and statistics of a notebook, or of the program itself, reach the workers."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spadmnist as sp
from spadmnist import by_value
from spadmnist.effects import Effect
from spadmnist.errors import EffectError
from spadmnist.inference import replicate_cache
from spadmnist.inference.models import Packed
from spadmnist.plugins import parameter

PROGRAM = '''
import json
import sys

import numpy as np

import spadmnist as sp
from spadmnist.inference.models import Model
from spadmnist.inference.capture_replicates import CaptureReplicates
from spadmnist.inference.replicates import Execution, Replicates
from spadmnist.statistics import Statistic, Summary
from spadmnist.workers import executor

FACTOR = 2.0


def twice(x):
    return FACTOR * x


class Glow(sp.Effect, abstract=True):
    """Light of the chip itself.

    Source: a test.
    """

    def rate_of(self):
        return twice(self.rate)


class GlowOfMain(Glow, stage="dark"):
    """Light of the chip itself, twice.

    Source: a test.
    """

    rate = sp.parameter(1000.0, "Hz", "of the glow", bounds=(0, None), off=0.0, search=(10.0, 1e4))

    def __init__(self, **values):
        super().__init__(**values)  # needs the class itself in a cell

    def apply(self, rate, conditions):
        return rate + self.rate_of()


class OddOnes(Statistic):
    """Detections in odd pixels."""

    modalities = ("qis",)

    def reduce(self, recording):
        odd = float(twice(recording.totals.ravel()[1::2].sum()))
        return Summary(np.array([odd]), "normal", lambda cell: "odd pixels", lambda cell, a, b: ("", 0.0))


def main():
    effects = [sp.effects.Detection(pdp=0.4), sp.effects.DarkCounts(rate=500.0), GlowOfMain(rate=2000.0)]
    model = sp.Sensor(sp.Layout(2, 2, 25e-12, 0.5), effects, rules="device")
    clock = {"frames": 200, "frame_time": 1e-5}
    lab = sp.simulate(model, [sp.Capture("dark", "qis", dark=True, **clock)], seed=1)
    answers = []
    for jobs in (1, 2):
        with executor(jobs) as workers:
            replicates = Replicates(model, lab, 0, Execution(workers), 2)
            wanted = (Model.same(model), "dark", np.ones(2), np.arange(2, dtype=np.uint64))
            found = replicates.simulate([wanted])  # one task: one worker is started
        assert all(isinstance(one, CaptureReplicates) for one in found), found
        answers.append([{name: values.tolist() for name, values in one.values.items()} for one in found])
    print(json.dumps(answers))


if __name__ == "__main__":
    main()
'''


@pytest.mark.slow
def test_classes_of_the_program_itself_work_with_workers(tmp_path: Path) -> None:
    file = tmp_path / "program.py"
    file.write_text(PROGRAM)
    done = subprocess.run([sys.executable, str(file)], capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode == 0, done.stderr
    one, two = json.loads(done.stdout)
    assert one == two
    assert all(len(found["odd_ones"]) == 2 and len(found) > 5 for found in one)


LOCK = threading.Lock()


def held(lock: Any) -> type[Any]:
    """An effect that cannot be packed, for its code holds a lock."""

    class HeldByTest(Effect, stage="dark"):
        """A dark rate.

        Source: a test.
        """

        rate = parameter(1.0, "Hz", "of the dark", bounds=(0, None), off=0.0)

        def apply(self, rate: np.ndarray, conditions: Any) -> np.ndarray:
            with lock:
                return rate + self.rate

    return HeldByTest


def test_what_cannot_be_sent_is_one_sentence_and_works_alone() -> None:
    cls = held(LOCK)
    try:
        layout = sp.Layout(1, 2, 25e-12, 0.5)
        model = sp.Sensor(layout, [sp.effects.Detection(pdp=0.4), cls(rate=3.0)], rules="device")
        with pytest.raises(
            EffectError, match=r"test_by_value.py: the effect held_by_test cannot be sent .*jobs=1"
        ) as error:
            Packed.of(model)
        assert "\n" not in str(error.value)
        alone = Packed.of(model, apart=False).sensor
        assert alone is not model and type(alone.effect("held_by_test")) is cls
    finally:
        del Effect.registry.classes["held_by_test"]


def test_in_its_own_process_a_class_stays_itself() -> None:
    cls = held(None)
    try:
        before = dict(vars(cls))
        for apart in (True, False):
            assert type(by_value.unpacked(by_value.packed(cls(rate=2.0), apart))) is cls
        assert {name: vars(cls)[name] for name in before} == before
    finally:
        del Effect.registry.classes["held_by_test"]


def test_what_depends_on_code_of_no_file_has_no_name_in_the_cache() -> None:
    cls, flat = held(None), sp.Capture("flat", "tr", dark=True, exposure=1e-3)
    try:
        layout = sp.Layout(1, 2, 25e-12, 0.5)
        plain = sp.Sensor(layout, [sp.effects.DarkCounts(rate=3.0)], rules="device")
        own = plain.with_effect(cls())
        assert replicate_cache.entry_name(plain, flat)
        assert replicate_cache.entry_name(own, flat) is None  # a function has made it
        cls.__module__, cls.__qualname__ = "__main__", "Held"
        assert replicate_cache.entry_name(own, flat) is None
        assert replicate_cache.recall(None) is None
        assert replicate_cache.entry_name(plain, flat)
    finally:
        del Effect.registry.classes["held_by_test"]


def test_a_module_that_a_worker_has_not_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    import types

    module = types.ModuleType("glow_of_a_test")
    monkeypatch.setitem(sys.modules, "glow_of_a_test", module)
    module.there = type("There", (), {"__module__": "glow_of_a_test", "__qualname__": "there"})  # type: ignore[attr-defined]
    data = pickle.dumps(module.there)
    monkeypatch.delitem(sys.modules, "glow_of_a_test")
    with pytest.raises(EffectError, match=r"a worker cannot import the module .*glow_of_a_test.*plug-in") as error:
        by_value.unpacked(data)
    assert "\n" not in str(error.value)
