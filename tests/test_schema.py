"""The JSON Schema of the files: every good one of the project keeps it, and each kind of mistake is refused."""

from __future__ import annotations

import ast
import copy
import functools
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from spadmnist import config, document, plugins, schema, units
from spadmnist.cli import cli
from spadmnist.effects import Effect
from spadmnist.errors import SpadError

jsonschema = pytest.importorskip("jsonschema")

ROOT = Path(__file__).parents[1]
CONFIGS = ROOT / "configs"
# a file with an effect of its own keeps no schema but that of the program with its plug-in
FILES = [path for path in sorted(CONFIGS.rglob("*.yaml")) if path.name != "truth.yaml"]


@functools.cache
def validator(kind: str) -> Any:
    made = schema.of(kind)
    jsonschema.Draft7Validator.check_schema(made)
    return jsonschema.Draft7Validator(made)


def mistakes(kind: str, value: Any) -> list[str]:
    return [error.message for error in validator(kind).iter_errors(value)]


def read(path: Path) -> Any:
    return document.read(path).value


def kind_of(path: Path) -> str:
    """What the first line says."""
    found = re.fullmatch(
        r"# yaml-language-server: \$schema=(\S*?)(\w+)\.schema\.json", path.read_text().splitlines()[0]
    )
    assert found is not None, f"{path}: the first line names no schema"
    assert (path.parent / found[1]).resolve() == CONFIGS
    return found[2]


# --- good ones ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_a_file_of_the_project_names_its_schema_and_keeps_it(path: Path) -> None:
    assert mistakes(kind_of(path), read(path)) == []


@pytest.mark.parametrize("kind", schema.kinds())
def test_the_schemas_beside_the_configs_are_those_of_the_classes(kind: str) -> None:
    """`spadmnist schema KIND > configs/KIND.schema.json` makes it again."""
    held = json.loads((CONFIGS / schema.file_of(kind)).read_text())
    found = CliRunner().invoke(cli, ["schema", kind])
    assert found.exit_code == 0 and json.loads(found.stdout) == schema.of(kind)
    assert schema.text(kind) == (CONFIGS / schema.file_of(kind)).read_text() and held


def texts() -> Iterator[tuple[str, str]]:
    """(place, text) of whatever in a test may be a config."""
    for path in sorted((ROOT / "tests").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and "recording:" in node.value:
                yield f"{path.name}:{node.lineno}", node.value


@pytest.mark.slow
def test_every_good_config_of_the_tests_keeps_it(tmp_path: Path) -> None:
    good = 0
    for place, text in texts():
        try:
            parsed = document.parse(text, place)
            config.build(parsed, tmp_path)
        except SpadError:
            continue
        assert mistakes("config", parsed.value) == [], place
        good += 1
    assert good > 5


# --- what is refused ---------------------------------------------------------------------------------------------


def quick() -> Any:
    return read(CONFIGS / "quick.yaml")


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield path
    for key, below in value.items() if isinstance(value, dict) else ():
        yield from places(below, (*path, key))


def at(value: Any, path: tuple[Any, ...]) -> Any:
    return functools.reduce(lambda held, key: held[key], path, value)


@pytest.mark.parametrize("path", [p for p in places(quick()) if isinstance(at(quick(), p), dict)], ids=str)
def test_an_unknown_key_is_refused(path: tuple[Any, ...]) -> None:
    wrong = copy.deepcopy(quick())
    at(wrong, path)["no_such_key"] = 1
    assert mistakes("config", wrong)


@pytest.mark.parametrize("path", [p for p in places(quick()) if p], ids=str)
def test_a_wrong_type_is_refused(path: tuple[Any, ...]) -> None:
    """A list of lists is right nowhere."""
    wrong = copy.deepcopy(quick())
    at(wrong, path[:-1])[path[-1]] = [[[]]]
    assert mistakes("config", wrong)


@pytest.mark.parametrize("text", ["50", 50, "50 kg", "50 lux", "-50 ns", "fifty ns", "50 Ns"])
def test_a_wrong_unit_is_refused(text: Any) -> None:
    wrong = quick()
    wrong["recording"]["exposure"] = text
    assert mistakes("config", wrong)


def pairs() -> list[tuple[str, str]]:
    return [(name, key) for name in Effect.registry for key in Effect.registry.find(name).parameters]


@pytest.mark.parametrize(("name", "key"), pairs())
def test_every_parameter_takes_its_unit_and_no_other(name: str, key: str) -> None:
    declared = Effect.registry.find(name).parameters[key]

    def said(value: Any) -> list[str]:
        other = {k: 1 for k, one in Effect.registry.find(name).parameters.items() if one.required and k != key}
        made = quick()
        made["sensor"]["effects"] = {name: {**other, key: value}}
        return mistakes("config", made)

    assert said({"nonsense": 1}) and said([1])
    if declared.choices:
        assert said("nonsense") and not said(declared.choices[0])
    elif declared.unit == "bool":
        assert said("yes") and not said(True)
    else:
        low, high = declared.bounds
        value = next(x for x in (declared.default, declared.off, low, high, 1.0) if isinstance(x, int | float))
        good = units.exact(float(value), declared.unit) if declared.unit else float(value)
        assert not said(good), good
        assert said(f"{value} stone")
        assert bool(said(1.0)) == bool(declared.unit)
        drawn = {"normal": {"mean": good, "sigma": good if low is None or float(value) >= 0 else 0}}
        assert bool(said({"file": "map.npy"})) == (not declared.per)
        assert bool(said(drawn)) == (not declared.per)
        mixed = {"mixture": [{"share": 0.5, **drawn}, {"share": "50 %", **drawn}]}
        assert bool(said(mixed)) == (not declared.per)
        assert said({"mixture": [drawn]}) and said({"normal": {"mean": good}})
        assert bool(said({"500 nm": good, "700 nm": good})) == (not declared.by_wavelength)
        assert said({"500": good})


def test_text_that_the_units_read_keeps_their_pattern() -> None:
    for unit in ("s", "Hz", "m", "m^2", "lux", "W/m^2", "rad", ""):
        pattern = re.compile(units.pattern(unit))
        samples = [
            f"{number}{gap}{u}"
            for number in ("5", "+.5", "-5.", "5e-3")
            for gap in (" ", "")
            for u in (*units.allowed_units(unit).split(", "), "kg", "")
        ] + ["5 µs", "5 μs", "5 µlux", " 5 % ", "5  ns"]
        for text in samples:
            try:
                units.parse(text, unit)
                good = True
            except ValueError:
                good = False
            assert bool(pattern.search(text)) == good, (unit, text)


@pytest.mark.parametrize(
    "change",
    [
        {"captures": []},
        {"format": "spadmnist-measurement/9"},
        {"layout": {"rows": 4}},
        {"captures": [{"id": "a", "modality": "tr", "light": {"kind": "dark"}}]},
        {"captures": [{"id": "a", "modality": "qis", "light": {"kind": "sun"}, "frames": 1, "frame_time": "1 us"}]},
        {"captures": [{"id": "a", "modality": "tr", "light": {"kind": "dark"}, "exposure": "1 ms", "frames": 3}]},
    ],
    ids=str,
)
def test_a_wrong_measurement_is_refused(change: dict[str, Any]) -> None:
    good = read(CONFIGS / "tutorial" / "plan" / "measurement.yaml")
    assert not mistakes("measurement", good) and mistakes("measurement", {**good, **change})


def test_an_effect_of_a_users_own_is_in_it(tmp_path: Path) -> None:
    (tmp_path / "haze_of_tests.py").write_text(
        "from spadmnist import Effect, parameter\n\n\n"
        'class HazeOfTests(Effect, stage="light"):\n    """Haze."""\n\n'
        '    share = parameter(0.1, "", "share", bounds=(0, 1), off=0.0, search=(0.01, 0.9))\n\n'
        "    def apply(self, rate, conditions):\n        return rate\n"
    )
    try:
        found = CliRunner().invoke(cli, ["schema", "sensor", "--plugin", str(tmp_path / "haze_of_tests.py")])
        effects = json.loads(found.stdout)["$defs"]["_Sensor"]["properties"]["effects"]["properties"]
        assert "share" in effects["haze_of_tests"]["properties"]
    finally:
        Effect.registry.classes.pop("haze_of_tests", None)
        plugins._loaded.clear()


def test_another_kind() -> None:
    done = CliRunner().invoke(cli, ["schema", "sensr"])
    assert "sensr is no kind of file" in str(done.exception) and "sensor" in str(done.exception)
