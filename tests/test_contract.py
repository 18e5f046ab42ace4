"""The contract that every effect and every method keeps; and that it finds what is wrong with others.

Nothing here is drawn anew: all seeds are fixed. What may stay by chance is 5.5 standard errors away, see
`test_what_stays_stays_by_chance`.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spadmnist as sp
from spadmnist import plugins, reference, signatures, template, testing
from spadmnist.effects import STAGES, Effect
from spadmnist.errors import EffectError, SpadError
from spadmnist.inference.reduction import reduce_with
from spadmnist.inference.replicates import simulated
from spadmnist.plugins import Distribution
from spadmnist.reconstruct import Method
from spadmnist.recording import Capture, Light
from spadmnist.statistics import Statistic
from spadmnist.testing import check_effect, check_method, check_statistic

OURS = [name for name in Effect.registry if Effect.registry.find(name).__module__.startswith("spadmnist.")]


def switched() -> list[tuple[str, dict[str, Any]]]:
    """Every effect at each position of each of its switches that is not the default."""
    found: list[tuple[str, dict[str, Any]]] = []
    for name in OURS:
        for key, declared in Effect.registry.find(name).parameters.items():
            words = declared.choices or ((True, False) if declared.unit == "bool" else ())
            found += [(name, {key: word}) for word in words if word != declared.default]
    return found


@pytest.mark.parametrize("name", OURS)
def test_an_effect_keeps_the_contract(name: str) -> None:
    report = check_effect(name)
    assert report.checks["moves"] == "kept", "an effect of ours says what it moves"
    assert not report.warnings, "an effect of ours says where it is known from"
    assert set(report.moved) == set(signatures.BLOCKS)


@pytest.mark.parametrize(("name", "values"), switched(), ids=str)
def test_an_effect_keeps_it_at_every_switch(name: str, values: dict[str, Any]) -> None:
    assert check_effect(name, **values).checks["moves"] == "kept"


@pytest.mark.parametrize("name", list(Method.registry))
def test_a_method_keeps_the_contract(name: str) -> None:
    check_method(name)


def test_a_few_hot_pixels_are_outliers() -> None:
    cold, hot = Distribution("lognormal", (5e3, 0.1)), Distribution("lognormal", (1e5, 0.1))
    report = check_effect("dark_counts", rate=Distribution("mixture", (), ((0.95, cold), (0.05, hot))))
    assert report.moved["outliers"] > testing.MOVED
    assert re.search(r"^    outliers +inf$", str(report), re.M), "not one of 2048 pixels was without them"


def test_strong_values() -> None:
    def value(*args: Any, **how: Any) -> Any:
        return testing.strong(plugins.parameter(*args, "", "what it is", **how))

    assert value(0.1, off=0.0, search=(1e-4, 1.0)) == pytest.approx(0.1)
    assert value(0.1, off=0.0, search=(-0.5, 0.5)) == 0.25
    assert value(1.0, off=1.0, search=(0.5, 1.0)) == 0.75
    assert value(8.0, search=(1, 16)) == 4.0
    assert value(8.0, search=(2, 16)) == 6.0, "a number of things is whole"
    assert value(0.3, search=(0.1, 0.4)) == pytest.approx(0.2)
    assert value(0.7) == 0.7
    assert value(5.0, off=0.0, search=(1e-4, 1.0), per_pixel=True).kind == "lognormal"
    assert value(1.0, off=1.0, search=(0, 2), per="row").numbers == (1.0, 0.25)
    with pytest.raises(AssertionError, match="give one, or declare `search`"):
        value(None, required=True)


# ---- somebody else's effect ----------------------------------------------------------------------------------

HEAD = '''"""Mine."""

import numpy as np

from spadmnist import Children, Effect, Events, parameter

STATE = np.random.Generator(np.random.SFC64(1))


def chance(default=0.02, off=0.0, search=(1e-3, 0.05), **more):
    return parameter(default, "", "chance that it happens", bounds=(0, 1), off=off, search=search, **more)


class {name}(Effect, stage="{stage}"):
    """It happens.

    Source: this test.
    """

'''


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Writes an effect into a file, loads it and gives its name; it is forgotten afterwards."""
    plugins.discover()
    monkeypatch.setattr(Effect.registry, "classes", dict(Effect.registry.classes))
    monkeypatch.setattr(plugins, "_loaded", dict(plugins._loaded))

    def write(body: str, stage: str = "correlated", head: str = HEAD, name: str = "Mine") -> str:
        file = tmp_path / "mine.py"
        file.write_text(head.format(name=name, stage=stage) + body)
        plugins.load_file(file)
        return name.lower()

    return write


ECHO = """
    p = chance()
    moves = ("intervals", "edge", "fano", "frames_lag", "level", "dark_level", "first", "autocorrelation")

    def spawn(self, events, rng):
        parent = np.flatnonzero(rng.random(len(events)) < self.p)
        return Children(parent, rng.exponential(1e-6, len(parent)){row})

    def expected_rate(self, rate, conditions):
        return rate * (1 + self.p)
"""
NEXT_PIXEL = ", events.rows[parent] // events.pixels * events.pixels + (events.rows[parent] + 1) % events.pixels"
LOSS = """
    p = chance(search=(0.01, 0.5))
    moves = ("level", "dark_level")

    def apply(self, events, rng):
        return events.keep({mask})

    def expected_rate(self, rate, conditions):
        return rate * (1 - self.p)
"""


@pytest.mark.parametrize(
    ("stage", "body"),
    [("correlated", ECHO.format(row="")), ("readout", LOSS.format(mask="rng.random(len(events)) >= self.p"))],
    ids=["echo", "loss"],
)
def test_somebody_elses_effect_keeps_it(planted: Any, stage: str, body: str) -> None:
    assert check_effect(planted(body, stage)).checks["moves"] == "kept"


NOBODY = "declarations: after names 'illumination_gradent', which is not an effect. Did you mean illumination_gradient"

# what is wrong -> (stage, body, the check that says so and what it says)
FAULTS = {
    "an echo in the next pixel": (
        "correlated",
        ECHO.format(row=NEXT_PIXEL),
        "moves: neighbours .* must stay|moves: intervals .* must change",
    ),
    "crosstalk in the pixel itself": (
        "correlated",
        ECHO.format(row="").replace('"intervals",', '"neighbours",'),
        "moves: neighbours .* must change",
    ),
    "a jitter that shifts everything": (
        "timing",
        """
    sigma = parameter(2e-8, "s", "time by which it is late", bounds=(0, None), off=0.0, search=(1e-9, 1e-7))
    moves = ("edge",)

    def apply(self, events, rng):
        return events.moved(events.times + self.sigma)
""",
        "moves: edge .* must change",
    ),
    "a jitter that is right, and something else": (
        "timing",
        """
    sigma = parameter(2e-10, "s", "time by which it is late", bounds=(0, None), off=0.0, search=(1e-10, 1e-9))
    moves = ("edge",)

    def apply(self, events, rng):
        return events.moved(events.times + self.sigma * (rng.standard_normal(len(events)) + 50 * (self.sigma > 0)))
""",
        "moves: first .* must stay",
    ),
    "an effect that does nothing": ("light", "    def apply(self, rate, conditions):\n        return rate\n", ""),
    "bright light alone is lost": (
        "light",
        """
    p = chance(search=(0.1, 0.9))
    moves = ("level",)

    def apply(self, rate, conditions):
        return rate * (1 - self.p / (1 + 1e5 / (rate + 1)))
""",
        "moves: linearity .* must stay",
    ),
    "draws from a state of its own": (
        "readout",
        LOSS.format(mask="STATE.random(len(events)) >= self.p"),
        "same stream same result: .* when it is made again",
    ),
    "draws that depend on the batch": (
        "readout",
        "    counted = True\n" + LOSS.format(mask="(np.arange(len(events)) * 0.618) % 1 >= self.p"),
        "same stream same result: .* images that are made together",
    ),
    "what a worker cannot get": (
        "light",
        """
    def made(self, chip):
        self._factor = lambda rate: rate

    def apply(self, rate, conditions):
        return self._factor(rate)
""",
        "same stream same result: .*[pP]ickl",
    ),
    "off is not off": (
        "readout",
        LOSS.format(mask="rng.random(len(events)) >= self.p + 0.01"),
        "off is the identity: .* is not as if it were absent",
    ),
    "stamps before the beginning": (
        "timing",
        """
    counted = True

    def apply(self, events, rng):
        return Events(events.times - 1e-5, events.offsets, events.pixels, row_pixel=events.row_pixel, end=events.end)
""",
        "invariants: ",
    ),
    "stamps out of order": (
        "timing",
        """
    counted = True

    def apply(self, events, rng):
        return Events(events.times[::-1].copy(), events.offsets, events.pixels, row_pixel=events.row_pixel)
""",
        "invariants: TR .* not in order",
    ),
    "no event is one too few": (
        "readout",
        """
    def apply(self, events, rng):
        return events.keep(events.times <= events.times.max())
""",
        "(off|invariants|edge cases).*: .*ValueError",
    ),
    "one pixel is too few": (
        "light",
        """
    def apply(self, rate, conditions):
        rate = rate.copy()
        rate[:, 1] = 0
        return rate
""",
        "edge cases: .*IndexError",
    ),
    "a wrong closed form": (
        "readout",
        LOSS.format(mask="rng.random(len(events)) >= self.p").replace("1 - self.p", "1 - 1.2 * self.p"),
        "expected rate: in the .* expected_rate makes it",
    ),
    "a closed form that is not what it does to the rates": (
        "light",
        """
    p = chance(search=(0.1, 0.9))

    def apply(self, rate, conditions):
        return rate * (1 - self.p)

    def expected_rate(self, rate, conditions):
        return rate * (1 + 5 * self.p)
""",
        "expected rate: in the dim capture apply makes .* in pixel 63, but .* write expected_rate = apply",
    ),
    "a default out of bounds": (
        "light",
        "    p = chance(2.0)\n\n    def apply(self, rate, conditions):\n        return rate\n",
        "declarations: default of p: 2 is not possible",
    ),
    "a range out of bounds": (
        "light",
        "    p = chance(search=(0.5, 2))\n\n    def apply(self, rate, conditions):\n        return rate\n",
        "declarations: search of p: 2 is not possible",
    ),
    "a statistic that is none": (
        "light",
        '    moves = ("levle",)\n\n    def apply(self, rate, conditions):\n        return rate\n',
        "declarations: moves names levle, but the statistics are level",
    ),
}


RATES = """
    def apply(self, rate, conditions):
        return rate * (1 - self.p)
"""
AWAKE = """
    p = chance()

    def sensitivity(self, u):
        return {rises}
"""
FAULTS |= {
    "behind nobody": ("light", f'    after = "illumination_gradent"\n    p = chance()\n{RATES}', NOBODY),
    "behind one of another stage": (
        "light",
        f'    after = "jitter"\n    p = chance()\n{RATES}',
        "declarations: after names jitter, which is of the stage timing, and not of light",
    ),
    "informed by nothing": (
        "light",
        f'    p = chance(per_pixel=True, informed_by="pixel_map_")\n{RATES}',
        "declarations: informed_by of p names 'pixel_map_', which is not .* Did you mean pixel_map",
    ),
    "informed by what tells nothing": (
        "light",
        f'    p = chance(per_pixel=True, informed_by="pixel_map")\n{RATES}',
        "declarations: informed_by of p names 'pixel_map', which defines no unit_likelihood",
    ),
    "a word that moves": (
        "light",
        f'    moves = "level"\n    p = chance()\n{RATES}',
        r"declarations: moves is 'level'; write moves = \('level',\)",
    ),
    "a sensitivity that falls": (
        "dead_time",
        AWAKE.format(rises="np.where(u < 1e-7, 1.0, 1.0 - self.p)"),
        "never falling: sensitivity falls from 1 to .* between .* and 100.* ns; it must never fall",
    ),
    "a hazard of another chance": (
        "correlated",
        ECHO.format(row="") + "\n    def hazard(self, pixels):\n        return 2 * self.p, 1e-6\n",
        r"hazard: of \d+ events \d+ have a child, but by hazard it is",
    ),
    "a hazard of another time": (
        "correlated",
        ECHO.format(row="") + "\n    def hazard(self, pixels):\n        return -np.log1p(-self.p), 5e-6\n",
        "hazard: children come .* after .* but hazard says 5 us",
    ),
    "a hazard in another pixel": (
        "correlated",
        ECHO.format(row=NEXT_PIXEL) + "\n    def hazard(self, pixels):\n        return -np.log1p(-self.p), 1e-6\n",
        "hazard: it has a hazard, but some of its children are in other pixels",
    ),
}


@pytest.mark.parametrize("fault", [name for name, (_, _, says) in FAULTS.items() if says])
def test_a_fault_is_found(fault: str, planted: Any, tmp_path: Path) -> None:
    stage, body, says = FAULTS[fault]
    name = planted(body, stage)
    with pytest.raises(AssertionError) as caught:
        check_effect(name)
    assert re.search(f"^{re.escape(str(tmp_path))}/mine.py: the effect mine, (?:{says})", str(caught.value))
    assert "\n" not in str(caught.value)


def test_what_says_nothing_of_itself_is_only_noted(planted: Any) -> None:
    report = check_effect(planted(FAULTS["an effect that does nothing"][1], "light"))
    assert report.checks["moves"] == "no `moves` is declared; it moved nothing"
    assert not report.warnings and "warning" not in str(report)


def test_a_hazard_that_is_right_keeps_it(planted: Any) -> None:
    body = ECHO.format(row="") + "\n    def hazard(self, pixels):\n        return -np.log1p(-self.p), 1e-6\n"
    assert check_effect(planted(body)).checks["hazard"] == "kept"


@pytest.mark.parametrize(
    ("how", "says"),
    [("off=None", "no parameter has both"), ("search=None", "diagnose never adds it"), ("", "kept")],
)
def test_what_is_never_looked_for_is_noted(how: str, says: str, planted: Any) -> None:
    report = check_effect(planted(f"    p = chance({how})\n{RATES}", "light"))
    assert says in report.checks["is looked for"]


def test_an_effect_without_a_source_is_warned_of(planted: Any, tmp_path: Path) -> None:
    body = "    def apply(self, rate, conditions):\n        return rate\n"
    report = check_effect(planted(body, "light", HEAD.replace("Source:", "From")))
    (warning,) = report.warnings
    assert warning == (
        f"{tmp_path / 'mine.py'}: the effect mine: its docstring does not say where it is known from; "
        "add a line Source: ..."
    )
    assert f"  warning: {warning}" in str(report).splitlines() and report.checks["declarations"] == "kept"


def test_bounds_that_nobody_enforces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plugins.Parameter, "check", lambda self, value, written=None: None)
    with pytest.raises(AssertionError, match=r"bounds: a config takes rate = -1 mHz, out of its bounds"):
        check_effect("dark_counts")


def test_a_parameter_that_it_has_not() -> None:
    with pytest.raises(AssertionError, match="it has no parameter rat"):
        check_effect("dark_counts", rat=1.0)


class Doubtful(Method, abstract=True):
    """A method that is no one's."""

    name = "doubtful"
    columns = ("counts",)
    answer = np.nan

    def estimate(self, settings: Any, counts: np.ndarray) -> np.ndarray:
        return np.where(counts > 500, self.answer, counts + (self.answer == 1))


@pytest.mark.parametrize(
    ("answer", "says"), [(np.nan, "is not finite"), (1.0, "is 1, not 0"), (0.0, ""), (np.inf, "is not finite")]
)
def test_a_method_that_does_not_keep_it(answer: float, says: str) -> None:
    kind = type("Wrong", (Doubtful,), {"answer": answer, "name": "wrong"}, abstract=True)
    if not says:
        return check_method(kind)
    with pytest.raises(AssertionError, match=says):
        check_method(kind)


def _in_place(counts: np.ndarray) -> np.ndarray:
    counts *= 2
    return counts * 1.0


@pytest.mark.parametrize(
    ("columns", "estimate", "says"),
    [
        (("counts",), lambda n: n[:-1] * 1.0, "at 0 photons/s: .*: the method wrong: estimate must return one number"),
        (("counts",), _in_place, "the method wrong failed: .*not its own to change"),
        (("counts",), lambda n: n.rot(), "the method wrong failed: AttributeError"),
        (("counts",), lambda n: np.roll(n, 1) * 1.0, "other company; each value .* of its own pixel's"),
        (("counts",), lambda n: n - n.mean(), "changes with those beside it"),
        (("counts",), lambda n: np.sort(n) * 1.0, "other company"),
        (("counts", "span"), lambda n, span: np.roll(n, 1) * 1.0, "changes with those beside it|other company"),
        (("counts", "span"), lambda n, span: np.sort(n.reshape(-1, 8)).ravel() * 1.0, "other company"),
        (("counts", "span"), lambda n, span: n * 1.0, ""),
    ],
)
def test_a_method_is_given_pixels_one_by_one(columns: tuple[str, ...], estimate: Any, says: str) -> None:
    body = {"estimate": lambda self, settings, *given: estimate(*given), "name": "wrong", "columns": columns}
    kind = type("Wrong", (Doubtful,), body, abstract=True)
    if not says:
        return check_method(kind)
    with pytest.raises(AssertionError, match=says):
        check_method(kind)


# ---- somebody else's statistic -------------------------------------------------------------------------------

STATISTIC = '''"""Mine."""

import random

import numpy as np

from spadmnist.statistics import Statistic, Summary


class Mine(Statistic):
    """Detections in each fifth of the exposure."""

    modalities = ("tr",)

    def reduce(self, recording):
        values = np.histogram(recording.events.times, 5, (0, recording.conditions.exposure))[0].astype(float)
        {line}
        return {returned}
'''
SUMMARY = "Summary({values}, {law!r}, {where}, {size}{more})"
WORDS = {
    "values": "values",
    "law": "poisson",
    "where": "lambda c: f'fifth {c}'",
    "size": "lambda c, m, e: (f'{m - e:.3g} more', abs(m - e) / e)",
    "more": "",
}
# what is wrong -> (what the summary has, a line before it, what is said, whether only the contract's test finds it)
WRONG: dict[str, tuple[dict[str, str], str, str, bool]] = {
    "another law": ({"law": "gaussian"}, "", "has the law 'gaussian' in dark; the laws are poisson, normal", False),
    "a list": ({"values": "list(values)"}, "", "has a list as values", False),
    "words": ({"values": "values.astype(str)"}, "", "has an array of <U32 as values", False),
    "no cells": ({"values": "values[:0]"}, "", r"has values of shape \(0,\) in dark; they are \(cells,\)", False),
    "a table": ({"values": "values[None]"}, "", r"has values of shape \(1, 5\) in dark", False),
    "one number": ({"values": "values.sum()"}, "", "has a float64 as values", False),
    "no number": ({"values": "values * np.nan", "law": "normal"}, "", "has the value nan in cell 0", False),
    "half a count": ({"values": "values + 0.5"}, "", r"cell 0 in dark; by the law poisson they are whole", False),
    "a count below 0": ({"values": "-values - 1"}, "", "by the law poisson they are whole, from 0 on", False),
    "a power below 0": ({"values": "-values - 1", "law": "exponential"}, "", "they are not negative", False),
    "a short scale": ({"law": "normal", "more": ", np.ones(3)"}, "", r"has scale of shape \(3,\)", False),
    "a scale below 0": ({"law": "normal", "more": ", -np.ones(5)"}, "", "has a scale that is negative", False),
    "a short axis": ({"more": ", axis=np.ones(3)"}, "", r"has axis of shape \(3,\) in dark; .* \(5,\)", False),
    "short contrasts": ({"more": ", contrasts=np.ones((1, 3))"}, "", r"has contrasts of shape \(1, 3\)", False),
    "long contrasts": ({"more": ", contrasts=np.ones((2, 5))"}, "", "has contrasts that are not of unit length", False),
    "words as contrasts": ({"more": ", contrasts=[['a']]"}, "", "has contrasts that are no array of numbers", False),
    "nameless contrasts": ({"more": ", contrasts=np.eye(2, 5)"}, "", "has 0 contrast_words", False),
    "another map": ({"more": ", shape=(2, 2)"}, "", r"has the shape \(2, 2\) of a map", False),
    "no place": ({"where": "lambda c: c"}, "", r"says 0 for where\(0\) in dark; it is text", False),
    "few places": ({"where": "lambda c: ('a', 'b')[c]"}, "", r":\d+: .* failed: IndexError", False),
    "a size alone": ({"size": "lambda c, m, e: m - e"}, "", r"says .* for size\(0, .* it is \(text, share", False),
    "other data": ({}, "recording.events.times[:] = 0", r":\d+: .* not its own to change", False),
    "other totals": ({}, "recording.totals[:] = 0", r":\d+: .* not its own to change", False),
    "cells by chance": ({"values": "values[: 2 + len(recording.events) % 3]"}, "", "cells in one recording", True),
    "draws": ({}, "values += np.random.poisson(1.0)", "it finds other values .* no random numbers", True),
    "draws of Python's": (
        {"law": "normal"},
        "values[0] += random.random()",
        "it finds other values .* no random numbers",
        True,
    ),
    "no Poisson": ({"values": "values * 50"}, "", "by the law poisson the variance .* normal is the law", True),
    "not exact": ({"law": "exact"}, "", "its law is exact, but its cells differ", True),
    "nothing": ({}, "return None", "it has nothing to say of any recording", True),
}


def statistic_with(folder: Path, words: dict[str, str], line: str = "pass", returned: str = "") -> type[Statistic]:
    """A statistic of somebody's file."""
    file = folder / "mine.py"
    text = STATISTIC.replace("{returned}", returned or SUMMARY.format(**WORDS | words)).replace(
        "{line}", line or "pass"
    )
    file.write_text(text)
    plugins.load_file(file)
    return Statistic.registry.find("mine")


@pytest.mark.parametrize("wrong", WRONG)
def test_a_fault_of_a_statistic_is_found(wrong: str, tmp_path: Path) -> None:
    words, line, says, _ = WRONG[wrong]
    kind = statistic_with(tmp_path, words, line)
    with pytest.raises(AssertionError, match=rf"^{re.escape(str(tmp_path))}/mine\.py.*{says}") as caught:
        check_statistic(kind)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("wrong", [name for name, (_, _, _, chance) in WRONG.items() if not chance])
def test_a_summary_that_is_none_is_refused_wherever_it_is_used(wrong: str, tmp_path: Path) -> None:
    words, line, says, _ = WRONG[wrong]
    kind = statistic_with(tmp_path, words, line)
    sensor, conditions = testing._sensor(None, "device"), testing._conditions(0.0)
    capture = Capture("dark", "tr", Light(), conditions)
    (recording,) = simulated(sensor, capture, np.zeros(1), np.zeros(1, np.uint64), 1)
    with pytest.raises(SpadError, match=says):
        reduce_with(kind(), recording)
    assert recording.totals.any() and recording.events is not None and recording.events.times.flags.writeable


def test_what_is_no_summary_is_refused(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="returns ndarray in dark; reduce returns a Summary, or None"):
        check_statistic(statistic_with(tmp_path, {}, returned="values"))


def test_a_right_statistic_keeps_the_contract(tmp_path: Path) -> None:
    check_statistic(statistic_with(tmp_path, {}))
    check_statistic("pixel_map")


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ('modalities = "tr"', r"Mine: modalities is 'tr'; it is a tuple of one or more of tr, str, qis, counts: write"),
        ('modalities = ("TR",)', r"modalities is \('TR',\).* Did you mean tr\?"),
        ("modalities = ()", r"modalities is \(\); it is a tuple"),
        ("modalities = 3", "modalities is 3; it is a tuple"),
    ],
)
def test_a_statistic_of_no_readout_is_refused_when_its_class_is_made(line: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(STATISTIC.replace('modalities = ("tr",)', line).replace("{line}", "pass"))
    with pytest.raises(EffectError, match=says):
        plugins.load_file(tmp_path / "mine.py")
    assert reference.statistic_list()


def test_a_statistic_that_reduces_nothing_is_refused_when_its_class_is_made(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(STATISTIC.replace("def reduce", "def reduc").replace("{line}", "pass"))
    with pytest.raises(EffectError, match=r"Mine: a statistic must define reduce\(recording\)"):
        plugins.load_file(tmp_path / "mine.py")


def test_cells_that_depend_on_the_data_are_told_by_name(tmp_path: Path) -> None:
    statistic_with(tmp_path, {"values": "values[: 2 + len(recording.events) % 3]"})
    layout = sp.Layout(4, 4, 25e-12, 1.0)
    sensor = sp.Sensor(layout, [sp.effects.Detection(pdp=0.5), sp.effects.DarkCounts(rate=1e4)], "device")
    dark = sp.simulate(sensor, [sp.Capture("dark", "tr", dark=True, exposure=1e-3)], seed=1)
    with pytest.raises(SpadError, match=r"mine\.py: the statistic mine has \d cells in one recording of dark and \d"):
        sp.compare(sensor, dark, jobs=1)


# ---- slow ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
def test_the_template_keeps_it(stage: str, planted: Any) -> None:
    name = f"mine_{stage}"
    text = template.text(name, stage).replace("{", "{{").replace("}", "}}")
    assert not check_effect(planted("", head=text, name=name)).warnings


@pytest.mark.slow
@pytest.mark.parametrize("name", list(Statistic.registry))
def test_a_statistic_keeps_the_contract(name: str) -> None:
    check_statistic(name)


@pytest.mark.slow
def test_one_call_in_somebodys_own_test(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(HEAD.format(name="Mine", stage="correlated") + ECHO.format(row=""))
    (tmp_path / "test_mine.py").write_text(
        "from mine import Mine\nfrom spadmnist.testing import check_effect\n\n\n"
        "def test_mine():\n    check_effect(Mine)\n\n\n"
        "def test_mine_weak():\n    check_effect(Mine, p=0.0)\n"
    )
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_mine.py"]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST")}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert "1 failed, 1 passed" in done.stdout, done.stdout
    assert re.search(r"AssertionError: .*mine\.py: the effect mine, moves: intervals .* must change", done.stdout)


@pytest.mark.slow
def test_what_stays_stays_by_chance() -> None:
    """Of 24 pairs of the same sensor no statistic moves, and the differences scatter by their standard errors."""
    sensor = testing._sensor(None, "device")
    found = [testing._statistics(sensor, f"null {i}", 32, sensor.nominal_dead_time) for i in range(48)]
    for name in signatures.BLOCKS:
        z = np.array([signatures.significance(a[name], b[name]) for a, b in zip(found[::2], found[1::2], strict=True)])
        # of at most 8 numbers the largest: 24 such have a larger root mean square once in 2e6 (Student's t, drawn)
        assert np.sqrt(np.mean(z**2)) < 2.56 and np.abs(z).max() < testing.STAYED, name
