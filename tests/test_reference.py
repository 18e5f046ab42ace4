"""The reference: made from the classes, complete, and what it says to paste works."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from spadmnist import config, document, plugins, reference
from spadmnist.effects import STAGES, Effect
from spadmnist.reconstruct import Method

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

    def apply(self, rate, conditions):
        return rate * (1 - self.depth)
'''


@pytest.fixture
def blemish(tmp_path: Path) -> Iterator[Path]:
    """A user's effect, gone again after the test."""
    path = tmp_path / "odd_blemish.py"
    path.write_text(PLUGIN)
    plugins.load_file(path)
    yield path
    del Effect.registry.classes["odd_blemish"]
    del plugins._loaded[path.resolve()]


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
    assert all(len(line) <= 100 for line in page.splitlines())
    words = " ".join(page.split())
    assert " ".join((cls.__doc__ or "").split()) in words
    for key, declared in cls.parameters.items():
        assert key in words
        assert declared.about in words
        assert declared.symbol in words
        assert declared.allowed() in words
    assert "file: " not in page


def test_the_effects_are_listed_in_the_order_of_their_stages() -> None:
    lines = [line for line in reference.effect_list().splitlines()[1:] if not line.startswith(" ")]
    assert sorted(line.split()[0] for line in lines) == EFFECTS
    stages = [list(STAGES).index(line.split()[1]) for line in lines]
    assert stages == sorted(stages)
    assert all(len(line) <= 100 for line in reference.effect_list().splitlines())


def test_a_users_effect_has_its_file_on_the_page(blemish: Path) -> None:
    page = reference.effect_page("odd_blemish")
    assert f"file: {blemish.resolve()}" in page
    assert "true or false" in page
    assert "required" in page
    assert "odd_blemish" in reference.effect_list()
    effect = effect_of(page)
    assert effect.depth == 0.25  # type: ignore[attr-defined]
    assert effect.active is True  # type: ignore[attr-defined]


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


def test_an_unknown_name_gets_a_suggestion() -> None:
    with pytest.raises(KeyError, match="Did you mean dead_time"):
        reference.effect_page("dead_tme")
    with pytest.raises(KeyError, match="Did you mean counts"):
        reference.method_page("count")
