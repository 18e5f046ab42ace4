"""Effects of a user's own file, with a frequency, an edge and a pattern, are searched, fitted and limited like ours."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from labs import Lab

import spadmnist as sp
from spadmnist import plugins
from spadmnist.inference.replicates import Replicates

EFFECTS = '''import numpy as np

from spadmnist import Effect, parameter


class Chopper(Effect, stage="arrival"):
    """A wheel in front of the lamp: the light is brighter and darker in turn, for half a turn each."""

    depth = parameter(0.0, "", "half of the step", bounds=(0, 1), off=0.0, search=(0.01, 0.9))
    rate = parameter(1e3, "Hz", "turns", bounds=(0, None), open_bounds=True, search=(200, 20e3), kind="frequency")
    turn = parameter(0.0, "", "phase in turns", search=(0, 1), kind="phase")

    def factor(self, times, conditions):
        return 1 + self.depth * np.where((self.rate * times + self.turn) % 1.0 < 0.5, 1.0, -1.0)

    def maximum(self, conditions):
        return 1 + self.depth

    def expected_rate(self, rate, conditions):
        return rate


class HalfOpen(Effect, stage="dead_time"):
    """After the dead time a pixel misses a share of what comes, until it is open at once."""

    share = parameter(0.0, "", "share that is missed", bounds=(0, 1), off=0.0, search=(0.02, 1))
    until = parameter(100e-9, "s", "after the dead time", bounds=(0, None), search=(10e-9, 2e-6), kind="edge")

    def sensitivity(self, u):
        return np.where(u < self.until, 1.0 - self.share, 1.0)

    def recovered(self, chance):
        return np.where(chance <= 1.0 - self.share, 0.0, self.until)

    def expected_rate(self, rate, conditions):
        return rate / (1 + rate * self.share * self.until)


class Checkers(Effect, stage="light"):
    """The pixels of one colour of a chequered board see less light."""

    less = parameter(0.0, "", "share that they lose", bounds=(0, 1), off=0.0, search=(0.005, 0.9))

    @classmethod
    def light_pattern(cls, layout):
        rows, columns = np.divmod(np.arange(layout.pixels), layout.columns)
        return ((rows + columns) % 2.0)[:, None]

    def apply(self, rate, conditions):
        rows, columns = np.divmod(np.arange(rate.shape[1]), 4)
        return rate * (1 - self.less * ((rows + columns) % 2))
'''
TRUE = {
    "chopper": {"depth": 0.12, "rate": 1730.0},
    "half_open": {"share": 0.6, "until": 300e-9},
    "checkers": {"less": 0.08},
}


@pytest.fixture
def strangers(tmp_path: Path) -> Iterator[None]:
    file = tmp_path / "strangers.py"
    file.write_text(EFFECTS)
    plugins.load_file(file)
    yield


SHORTEST = "checkers"  # the pattern; the others are `long`


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n == SHORTEST else pytest.mark.long) for n in TRUE])
def test_it_is_found_and_fitted(name: str, lab: Lab, strangers: None) -> None:
    """First, with no other step; its numbers and those of `fit` are the hidden ones (6 standard deviations)."""
    units = {key: declared.unit for key, declared in sp.Effect.registry.find(name).parameters.items()}
    hidden = ", ".join(f"{key}: {value:g} {units[key]}" for key, value in TRUE[name].items())
    stated, data = lab(f"    {name}: {{{hidden}}}\n", light=300, side=4)
    found = sp.diagnose(stated, data, quick=True, jobs=1)
    assert [step.candidate.effect for step in found.steps] == [name], repr(found)
    fitted = sp.fit(stated, data, add=[name], jobs=1)
    for key, true in TRUE[name].items():
        for value in (found.steps[0].values[key], fitted.steps[0].values[key]):
            assert value.low is not None and value.high is not None
            reach = 2.1 * (value.high - value.low)  # 3.1 x 1.96 standard deviations on either side
            assert value.low - reach < true < value.high + reach, (key, value)
            assert value.high - value.low < 0.6 * true, (key, value)


@pytest.mark.slow
def test_it_has_an_upper_limit_where_it_is_not_found(lab: Lab, strangers: None) -> None:
    found = sp.diagnose(*lab(light=300, side=4), quick=True, jobs=1)
    assert found.verdict == "adequate" and not found.steps
    for key, true in {"half_open.share": 0.6, "checkers.less": 0.08}.items():
        assert 0 < found.upper_limits[key] < 0.7 * true, (key, found.upper_limits)
    # periodic ones are looked for where there are lines, and here are none: that is said, of ours as well
    assert {entry["effect"] for entry in found.as_data()["no_limit"]} >= {"chopper", "flicker"}


@pytest.mark.slow
def test_what_no_effect_describes_is_unexplained(lab: Lab, strangers: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """A detector that is less sensitive for 4 us after each detection: what only resembles it is no finding."""
    stated, data = lab("    half_open: {share: 0.3, until: 4 us}\n", light=300, side=4)
    every = Replicates.candidates
    monkeypatch.setattr(
        Replicates, "candidates", lambda self, sensor: [c for c in every(self, sensor) if c.effect not in TRUE]
    )
    found = sp.diagnose(stated, data, quick=True, jobs=1)
    assert found.verdict == "unexplained" and not found.steps, repr(found)
