"""The reference: made from the classes, complete, and what it says to paste works."""

from __future__ import annotations

import inspect
import json
import re
from pathlib import Path

import pytest

from spadmnist import config, document, plugins, reference
from spadmnist.effects import STAGES, Effect
from spadmnist.inference import comparison, light_checks
from spadmnist.inference.levels import FALSE_ALARM, SHARE_OF_STATISTICS, SHARES
from spadmnist.reconstruct import Method
from spadmnist.statistics.checks import Check

EFFECTS = list(Effect.registry)
METHODS = list(Method.registry)

PLUGIN = '''
from spadmnist.effects import Effect, parameter

class OddBlemish(Effect, stage="light"):
    """A blemish.

    Source: a test.
    """

    depth = parameter(0.25, "", "how dark it is", bounds=(0, 1), off=0.0, per_pixel=True)
    active = parameter(True, "bool", "is it there?", off=False)
    area = parameter(None, "m^2", "its area", bounds=(0, None), open_bounds=True, required=True)
    edge = parameter("soft", "", "what its rim is like", choices=("soft", "hard"))
    weights = parameter(1.0, "", "one for each row", per="row", by_wavelength=True)

    def apply(self, rate, conditions):
        """Not a law."""
        return rate * (1 - self.depth)

    def expected_rate(self, rate, conditions):
        """r = (1 - depth) * rate, a blemish
        being as deep as that.

        More on it.
        """
        return rate * (1 - self.depth)


class EvenBlemish(OddBlemish, stage="light"):
    """Another blemish."""


class PlainBlemish(Effect, stage="arrival"):
    """A third blemish."""

    pattern = parameter(None, "", "of the rows", per="row", required=True)

    def maximum(self, conditions):
        return 1.0

    def factor(self, t, conditions):
        return 1.0 + 0 * t
'''


@pytest.fixture
def blemish(tmp_path: Path) -> Path:
    """A user's effects, gone again after the test."""
    path = tmp_path / "odd_blemish.py"
    path.write_text(PLUGIN)
    plugins.load_file(path)
    return path


def pasted(page: str, key: str) -> document.Document:
    """The YAML of a page: the indented lines from `key` on."""
    lines = page.splitlines()
    return document.parse("\n".join(lines[lines.index(f"  {key}") :]), "page")


def effect_of(page: str) -> Effect:
    source = pasted(page, "sensor:")
    whole = {
        "seed": 1,
        "scene": {"images": {"source": "uniform"}, "lux": ["1 lux"]},
        "recording": {"exposure": "1 ms", "readouts": ["tr"]},
        "sensor": {**source.value["sensor"], "layout": {"rows": 2, "columns": 3, "pixel_area": "25 um^2"}},
    }
    sensor = config.build(document.Document("pasted", whole), Path()).sensor
    [effect] = sensor.effects
    return effect


@pytest.mark.parametrize("name", EFFECTS)
def test_the_yaml_of_an_effect_is_the_default_effect(name: str) -> None:
    effect = effect_of(reference.effect_page(name))
    assert type(effect) is Effect.registry.find(name)
    for key, declared in effect.parameters.items():
        assert getattr(effect, key) == declared.default


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_page_says_everything_in_a_terminal(name: str) -> None:
    page = reference.effect_page(name)
    cls = Effect.registry.find(name)
    assert page.startswith(f"{name}\nstage: {cls.stage}")
    assert all(" ".join(way) in " ".join(page.split()) for way in reference.hooks(cls.stage, cls))
    assert reference.hooks(cls.stage, cls) and reference.mean_law(cls) in " ".join(page.split())
    assert all(len(line) <= 100 for line in page.splitlines())
    words = " ".join(page.split())
    assert " ".join((cls.__doc__ or "").split()) in words
    for key, declared in cls.parameters.items():
        assert key in words
        assert declared.about in words
        assert declared.symbol in words
        for value in (declared.off, *(declared.search or ())):
            assert reference._value(declared, value) in words
        assert ("true or false" if declared.unit == "bool" else declared.allowed()) in words
    assert not any(line.startswith("file: ") for line in page.splitlines())


def test_the_effects_are_listed_in_the_order_of_their_stages() -> None:
    lines = [line for line in reference.effect_list().splitlines()[1:] if not line.startswith(" ")]
    assert sorted(line.split()[0] for line in lines) == EFFECTS
    stages = [list(STAGES).index(line.split()[1]) for line in lines]
    assert stages == sorted(stages)
    assert all(len(line) <= 100 for line in reference.effect_list().splitlines())
    words = " ".join(reference.effect_list().split())
    assert all(" ".join(Effect.registry.find(name).summary().split()) in words for name in EFFECTS)


def test_a_users_effect_has_its_file_on_the_page(blemish: Path) -> None:
    page = reference.effect_page("odd_blemish")
    assert f"file: {blemish.resolve()}" in page
    assert "true or false" in page
    assert "required" in page
    assert "odd_blemish" in reference.effect_list()
    effect = effect_of(page)
    assert effect.depth == 0.25  # type: ignore[attr-defined]
    assert effect.active is True  # type: ignore[attr-defined]


def test_words_and_what_a_parameter_may_vary_by(blemish: Path) -> None:
    rows = {line.split()[0]: line for line in reference.effect_page("odd_blemish").splitlines() if line.strip()}
    assert rows["edge"].split() == ["edge", "-", "-", "soft", "soft", "or", "hard", "-", "-", "-"]
    assert rows["weights"].endswith("row or wavelength") and rows["depth"].endswith(" pixel")
    assert "edge: soft" in rows["odd_blemish:"]
    assert "plain_blemish: {pattern: {file: pattern.npy}}" in reference.effect_page("plain_blemish")
    data = reference.as_data("effect", "odd_blemish")
    assert isinstance(data, dict)
    facts = json.loads(json.dumps(data))["parameters"]
    assert facts["edge"]["choices"] == ["soft", "hard"] and facts["depth"]["choices"] == []
    assert {key: facts[key]["per"] for key in facts} == {
        "depth": "pixel",
        "active": "",
        "area": "",
        "edge": "",
        "weights": "row",
    }


def test_the_law_of_the_mean_is_the_effect_s_own_word(blemish: Path) -> None:
    law = "r = (1 - depth) * rate, a blemish being as deep as that."
    for name in ("odd_blemish", "even_blemish"):
        assert f"\n\nMean rate after the effect: {law}\n\n" in reference.effect_page(name)
        assert reference.as_data("effect", name)["expected_rate"] == law  # type: ignore[call-overload]
    assert "Mean rate" not in reference.effect_page("plain_blemish")
    assert reference.as_data("effect", "plain_blemish")["expected_rate"] is None  # type: ignore[call-overload]


def test_the_hooks_are_those_of_the_class(blemish: Path) -> None:
    assert reference.effect_page("odd_blemish").splitlines()[2].startswith("apply(rate, conditions): photons/s")
    assert reference.effect_page("plain_blemish").splitlines()[2].startswith("factor(t, conditions), maximum(")


@pytest.mark.parametrize("stage", STAGES)
def test_every_way_to_write_an_effect_is_in_the_table_of_stages(stage: str) -> None:
    """The table that people read, and the one that classes are checked by."""
    for group in STAGES[stage]:
        cls = type("Anything", (), dict.fromkeys(group.split("+"), len))
        told = [hook for hook, _ in reference.hooks(stage, cls)]
        assert any(f"{name}(" in hook for hook in told for name in group.split("+")), group


@pytest.mark.parametrize("name", METHODS)
def test_a_method_page_says_everything_in_a_terminal(name: str) -> None:
    page = reference.method_page(name)
    cls = Method.registry.find(name)
    assert page.startswith(f"{name}\nneeds: {', '.join(cls.readouts())}; unit: {cls.unit}")
    assert ("never normalised" in page.splitlines()[1]) is not cls.normalised
    assert all(len(line) <= 100 for line in page.splitlines())
    assert " ".join((cls.__doc__ or "").split()) in " ".join(page.split())
    assert pasted(page, f"reconstruct: [{name}]").value == {"reconstruct": [name]}


def test_every_method_is_listed() -> None:
    lines = [line for line in reference.method_list().splitlines()[1:] if not line.startswith(" ")]
    assert sorted(line.split()[0] for line in lines) == METHODS


def test_every_name_that_a_comparison_gives_a_check_is_explained() -> None:
    """The names are read off the code that makes the checks; the shares of false alarms are those that it takes."""
    source = inspect.getsource(comparison) + inspect.getsource(light_checks)
    names = set(re.findall(r'Check\(\s*(?:statistic=)?"(\w+)"', source)) | set(SHARES)
    assert names == set(Check.registry)
    listed = reference.statistic_list()
    for name in names:
        page = reference.statistic_page(name)
        words = " ".join(page.split())
        assert page.startswith(f"{name}\nmodality: ") and f"\n{name} " in listed
        share = SHARES.get(name, SHARE_OF_STATISTICS)
        assert f"{share:.0%}".replace("%", " %") in words and f"fails {FALSE_ALARM:.0%}".replace("%", " %") in words
        for begun in ("Law: ", "Fails: ", "Shows: ", "Source: "):
            assert f"\n{begun}" in page, begun
        assert all(len(line) <= 100 for line in page.splitlines())
        assert reference.as_data("statistic", name)["about"] == inspect.getdoc(Check.registry.find(name))  # type: ignore[call-overload]


def test_an_unknown_name_gets_a_suggestion() -> None:
    with pytest.raises(KeyError, match="Did you mean dead_time"):
        reference.effect_page("dead_tme")
    with pytest.raises(KeyError, match="Did you mean counts"):
        reference.method_page("count")
